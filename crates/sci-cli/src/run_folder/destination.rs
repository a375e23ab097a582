//! Owns what may be done to a folder that a user names: nothing is removed or overwritten that a record does not list.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Component, Path, PathBuf};

use super::{RECORD, Refusal};
use crate::record::Record;

/// Refuses a folder that holds something the run reads.
///
/// # Errors
/// [`Refusal`] naming the key and the input.
pub fn refuse_inputs(dir: &Path, inputs: &[(&str, &Path)]) -> Result<(), Refusal> {
    let real = real_path(dir);
    match inputs.iter().find(|(_, input)| real_path(input).starts_with(&real)) {
        None => Ok(()),
        Some((key, input)) => Err(Refusal(format!(
            "--out {}: it holds an input, `{key}` = {}; name another folder, for example {}",
            dir.display(),
            input.display(),
            dir.join("results").display()
        ))),
    }
}

/// A path without links, of which the end need not exist.
fn real_path(path: &Path) -> PathBuf {
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let known = absolute.ancestors().find_map(|a| fs::canonicalize(a).ok().map(|real| (a, real)));
    let Some((ancestor, real)) = known else { return absolute };
    let rest = absolute.strip_prefix(ancestor).unwrap_or(Path::new(""));
    rest.components().fold(real, |mut path, part| {
        match part {
            Component::ParentDir => _ = path.pop(),
            Component::Normal(name) => path.push(name),
            _ => {}
        }
        path
    })
}

/// The files that the record of a folder lists, without the record; none where there is no record.
///
/// # Errors
/// [`Refusal`] if the record cannot be read: it may be another program's.
pub(super) fn listed(dir: &Path) -> Result<BTreeSet<String>, Refusal> {
    let path = dir.join(RECORD);
    if fs::symlink_metadata(&path).is_err() {
        return Ok(BTreeSet::new());
    }
    let refuse = |e: crate::io::FileError| {
        Refusal(format!("{e}; it is not a record of this program, so name another folder with --out"))
    };
    Ok(Record::read(&path).map_err(refuse)?.files.into_iter().filter(|name| can_be_ours(name)).collect())
}

/// Whether a run could have written it: a record that was tampered with must not lead to other folders.
pub(super) fn can_be_ours(name: &str) -> bool {
    let parts: Vec<Component<'_>> = Path::new(name).components().collect();
    let normal = parts.iter().all(|part| matches!(part, Component::Normal(_)));
    let known = ["recon.", "preview.gif", "report.html", "adapted-"].iter().any(|known| name.starts_with(known));
    normal && if parts.len() == 2 { name.starts_with("frames/") } else { parts.len() == 1 && known }
}

/// Refuses a folder where the run would meet a file or folder of its names that is not `ours`.
///
/// # Errors
/// [`Refusal`] naming what is in the way.
pub(super) fn refuse_foreign(dir: &Path, files: &[String], ours: &BTreeSet<String>) -> Result<(), Refusal> {
    let top = |name: &str| name.split('/').next().unwrap_or(name).to_owned();
    let our_tops: BTreeSet<String> = ours.iter().map(|name| top(name)).collect();
    let exists = |name: &str| fs::symlink_metadata(dir.join(name)).is_ok();
    let foreign = files.iter().find_map(|name| {
        let above = top(name);
        if exists(&above) && (!our_tops.contains(&above) || (above != *name && dir.join(&above).is_symlink())) {
            return Some(above);
        }
        (exists(name) && !ours.contains(name)).then(|| name.clone())
    });
    match foreign {
        None => Ok(()),
        // A record of this version lists at least the result.
        Some(name) if exists(RECORD) && ours.is_empty() => Err(Refusal(format!(
            "--out {}: it holds `{name}` and the {RECORD} of an earlier version, which does not list the files of its run; \
             to replace that run remove the folder first, or name another one",
            dir.display()
        ))),
        Some(name) => Err(Refusal(format!(
            "--out {}: it holds `{name}`, which no {RECORD} there lists as the result of a run; move it away or name another folder",
            dir.display()
        ))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_of_results_can_be_ours() {
        for name in ["recon.npy", "recon.tif", "frames/m00_t00.png", "preview.gif", "adapted-0-ffdnet.safetensors"] {
            assert!(can_be_ours(name), "{name}");
        }
        for name in
            ["", ".", "..", "../recon.npy", "/recon.npy", "frames", "frames/../x", "recon./x", "notes.txt", "a/b/c"]
        {
            assert!(!can_be_ours(name), "{name}");
        }
    }

    #[test]
    fn an_input_is_found_through_links_and_dots() {
        let dir = tempfile::tempdir().unwrap();
        let data = dir.path().join("data");
        fs::create_dir(&data).unwrap();
        fs::write(data.join("scene.npz"), "").unwrap();
        let scene = data.join("scene.npz");
        let refused = |out: &Path| refuse_inputs(out, &[("data.path", &scene)]).is_err();
        assert!(refused(&data) && refused(dir.path()) && refused(&dir.path().join("data/new/../.")));
        assert!(!refused(&data.join("out")) && !refused(&dir.path().join("data2")));
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(&data, dir.path().join("link")).unwrap();
            assert!(refused(&dir.path().join("link")) && !refused(&dir.path().join("link/out")));
        }
    }
}
