//! Folders, weights and programs.

use std::env::{self, consts::EXE_SUFFIX};
use std::path::{Path, PathBuf};
use std::process::Command;

use nets::weights::bundled_sizes;
use nets::{Architecture, Ends, WeightFile};
use serde_json::json;

use super::{Finding, told};
use crate::table::DATA_VARIABLE;

/// The folders in which scenes and weights are looked for, beside that of the experiment and the current one.
pub(super) fn data() -> Finding {
    let name = "data";
    let Some(folder) = env::var_os(DATA_VARIABLE).filter(|v| !v.is_empty()).map(PathBuf::from) else {
        let text = format!(
            "{DATA_VARIABLE} is not set: scenes and weights are looked for beside the experiment and in this folder only"
        );
        return Finding::missing(name, text);
    };
    if !folder.is_dir() {
        return Finding::broken(name, format!("{DATA_VARIABLE} names {}, which is no folder", folder.display()));
    }
    let count = |inner: &str| std::fs::read_dir(folder.join(inner)).map_or(0, Iterator::count);
    let (scenes, weights) = (count("data"), count("weights"));
    let text = format!("{DATA_VARIABLE} = {}: {scenes} files in data, {weights} in weights", folder.display());
    Finding::fine(name, text, json!({ "folder": folder, "data": scenes, "weights": weights }))
}

/// The weights inside the program; each is read and must make a network.
pub(super) fn weights() -> Finding {
    let name = "weights";
    let bundled = bundled_sizes();
    for (bundled, _) in &bundled {
        if let Err(error) = load(bundled) {
            return Finding::broken(name, error.to_string());
        }
    }
    let size = |bytes: usize| told(bytes as u64);
    let list: Vec<String> = bundled.iter().map(|(name, bytes)| format!("{name} {}", size(*bytes))).collect();
    let total = size(bundled.iter().map(|(_, bytes)| bytes).sum());
    let text = format!("{} networks in the program, {total}: {}", bundled.len(), list.join(", "));
    let details = bundled.iter().map(|(name, bytes)| json!({ "name": format!("bundled:{name}"), "bytes": bytes }));
    Finding::fine(name, text, details.collect())
}

/// Whether bundled weights make a network.
fn load(bundled: &str) -> anyhow::Result<()> {
    let weights = WeightFile::read(Path::new(&format!("bundled:{bundled}")))?;
    Architecture::load(weights, Ends::Circular)?;
    Ok(())
}

/// What decodes clips.
pub(super) fn ffmpeg() -> Finding {
    let name = "ffmpeg";
    match Command::new(name).arg("-version").output() {
        Ok(output) if output.status.success() => {
            let words = String::from_utf8_lossy(&output.stdout);
            let version = words.split_whitespace().nth(2).unwrap_or("of unknown version");
            Finding::fine(name, format!("{version}: MP4, AVI and Matroska can be read"), json!({ "version": version }))
        }
        Ok(output) => Finding::broken(name, format!("ffmpeg -version ends with {}", output.status)),
        Err(_) => Finding::missing(name, "none on the PATH: MP4, AVI and Matroska cannot be read, all else can"),
    }
}

/// What shows `report.html`. macOS and Windows come with one.
pub(super) fn browser() -> Finding {
    const NAMES: [&str; 5] = ["xdg-open", "firefox", "chromium", "chromium-browser", "google-chrome"];
    let name = "browser";
    if cfg!(any(windows, target_os = "macos")) {
        return Finding::fine(name, "the system's: it shows report.html", json!({ "program": "the system's" }));
    }
    match NAMES.into_iter().find_map(program) {
        Some(path) => Finding::fine(name, format!("{} shows report.html", path.display()), json!({ "program": path })),
        None => Finding::missing(name, "none on the PATH: copy report.html, one file, to a computer that has one"),
    }
}

/// The program of that name on the `PATH`.
fn program(name: &str) -> Option<PathBuf> {
    let folders = env::var_os("PATH")?;
    env::split_paths(&folders).map(|folder| folder.join(format!("{name}{EXE_SUFFIX}"))).find(|path| path.is_file())
}

/// Whether results can be written.
pub(super) fn results(out: &Path) -> Finding {
    let out = std::path::absolute(out).unwrap_or_else(|_| out.to_owned());
    // It is made by a run; the nearest folder above that is there decides.
    let there = out.ancestors().find(|folder| folder.exists()).unwrap_or(&out);
    writable("results", there, &out)
}

pub(super) fn temporary() -> Finding {
    let folder = env::temp_dir();
    writable("temporary", &folder, &folder)
}

/// Whether a file can be made in `folder`, for the sake of `wanted` in it.
fn writable(name: &'static str, folder: &Path, wanted: &Path) -> Finding {
    match tempfile::tempfile_in(folder) {
        Ok(_) => Finding::fine(name, format!("{} can be written", wanted.display()), json!({ "folder": wanted })),
        Err(error) => Finding::broken(name, format!("{} cannot be written: {error}", wanted.display())),
    }
}
