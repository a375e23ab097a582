//! Owns the experiments that come with the program, so that it works without the repository: `configs/gray`, `color` and `real`.
//!
//! An experiment is named `gray/default`; where a path is meant it is `bundled:gray/default.toml`, as bundled weights are.

use std::path::{Component, Path, PathBuf};

/// What the path of a shipped experiment begins with.
const PREFIX: &str = "bundled:";

macro_rules! shipped {
    ($($name:literal)*) => {
        &[$(($name, include_str!(concat!("../../../configs/", $name, ".toml")))),*]
    };
}

/// Every one, with its text.
const SHIPPED: &[(&str, &str)] = shipped! {
    "color/adaptive" "color/default" "color/desci" "color/desci-fast" "color/fast" "color/fastdvdnet" "color/gap-fastdvdnet" "color/gap-ffdnet" "color/gap-tv" "color/gap-wavelet" "color/refined"
    "color/two-stage-fastdvdnet-ddnet" "color/two-stage-fastdvdnet-ddnet-online-reuse" "color/two-stage-ffdnet"
    "color/two-stage-ffdnet-cfd" "color/two-stage-ffdnet-ddnet" "color/two-stage-ffdnet-fast" "color/two-stage-ffdnet-online"
    "color/two-stage-ffdnet-online-ddnet" "color/two-stage-ffdnet-online-reuse-ddnet"
    "gray/adaptive" "gray/auto" "gray/default" "gray/desci" "gray/desci-fast" "gray/fast" "gray/fastdvdnet" "gray/gap-fastdvdnet" "gray/gap-fastdvdnet-online-reuse" "gray/gap-ffdnet"
    "gray/gap-ffdnet-fast" "gray/gap-ffdnet-online" "gray/gap-tv" "gray/gap-tv-fast" "gray/gap-wavelet" "gray/refined"
    "real/color" "real/gray"
};

/// Their names, such as `gray/default`.
pub fn names() -> impl Iterator<Item = &'static str> {
    SHIPPED.iter().map(|(name, _)| *name)
}

/// Where an experiment is that is told by its file or by its name: the file if there is one, else what was shipped under that name,
/// with or without `.toml` and `configs/`.
pub fn located(path: &Path) -> PathBuf {
    let name = path.strip_prefix("configs").unwrap_or(path).with_extension("");
    let shipped = || names().find(|shipped| name == Path::new(shipped));
    match shipped().filter(|_| !path.exists()) {
        Some(name) => PathBuf::from(format!("{PREFIX}{name}.toml")),
        None => path.to_owned(),
    }
}

/// What may be meant by the path of a file that is not there, for a message: nothing if it is not like a name.
pub fn like(path: &Path) -> String {
    let Some(text) = path.to_str().filter(|text| !text.ends_with(".toml") && !text.contains('\\')) else {
        return String::new();
    };
    let last = |name: &str| name.rsplit_once('/').map_or(name, |(_, last)| last).to_owned();
    let near = |name: &&str| strsim::damerau_levenshtein(name, text) <= 2 || last(name) == text;
    let near: Vec<&str> = names().filter(near).collect();
    if near.is_empty() {
        return format!("; the experiments that come with the program are {}", names().collect::<Vec<_>>().join(", "));
    }
    format!(" (did you mean {}?)", near.join(" or "))
}

/// Whether a path is that of something shipped, not of a file.
pub fn is_shipped(path: &Path) -> bool {
    path.to_str().is_some_and(|path| path.starts_with(PREFIX))
}

/// The text of `bundled:NAME.toml`; nothing if there is none of that name.
pub fn text(path: &Path) -> Option<&'static str> {
    let inner = path.to_str()?.strip_prefix(PREFIX)?;
    // What one extends is named relative to it.
    let mut name = PathBuf::new();
    for part in Path::new(inner).components() {
        if part == Component::ParentDir {
            name.pop()
        } else {
            name.push(part);
            true
        };
    }
    let name = name.with_extension("");
    SHIPPED.iter().find(|(shipped, _)| name == Path::new(shipped)).map(|(_, text)| *text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_experiment_for_users_is_shipped() {
        let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs");
        let mut files: Vec<String> = Vec::new();
        for folder in ["color", "gray", "real"] {
            for entry in std::fs::read_dir(configs.join(folder)).unwrap() {
                files.push(format!("{folder}/{}", entry.unwrap().path().file_stem().unwrap().to_str().unwrap()));
            }
        }
        files.sort();
        assert_eq!(files, names().collect::<Vec<_>>());
    }

    #[test]
    fn an_experiment_is_found_by_its_name_unless_there_is_such_a_file() {
        for told in ["gray/default", "gray/default.toml", "configs/gray/default.toml"] {
            assert_eq!(located(told.as_ref()), Path::new("bundled:gray/default.toml"), "{told}");
        }
        let there = Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml");
        assert_eq!(located(&there), there);
        assert_eq!(located("gray/none".as_ref()), Path::new("gray/none"));
    }

    #[test]
    fn what_one_extends_is_found_beside_it() {
        let default = text("bundled:gray/default.toml".as_ref()).unwrap();
        assert_eq!(text("bundled:real/../gray/default.toml".as_ref()), Some(default));
        assert_eq!(text("bundled:gray/none.toml".as_ref()), None);
        assert_eq!(text("gray/default.toml".as_ref()), None);
    }

    #[test]
    fn a_name_that_is_nearly_one_is_told_what_it_may_mean() {
        assert_eq!(like("gray/fats".as_ref()), " (did you mean gray/fast?)");
        assert_eq!(like("fast".as_ref()), " (did you mean color/fast or gray/fast?)");
        assert!(like("mine".as_ref()).contains("come with the program are") && like("mine.toml".as_ref()).is_empty());
    }
}
