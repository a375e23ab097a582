//! Owns training files: how one is read and checked, and where what it names is found.

use std::path::{Path, PathBuf};

use nets::train::TrainConfig;

use crate::table::{ConfigError, Paths, Source, Table, find, find_weights};

/// What checkpoints are called, and what their names begin with.
pub const CHECKPOINT: &str = "checkpoint";

/// A training file that has been read and checked.
#[derive(Debug)]
pub struct Training {
    /// What it says.
    pub config: TrainConfig,
    source: Source,
}

impl Training {
    /// Reads a file with `--set` arguments, and checks every value.
    ///
    /// # Errors
    /// The first mistake.
    pub fn read(path: &Path, arguments: &[String]) -> Result<Self, ConfigError> {
        Self::new(Source::read(path, "training", arguments)?)
    }

    /// Checks the text of a file.
    ///
    /// # Errors
    /// The first mistake.
    pub fn new(source: Source) -> Result<Self, ConfigError> {
        let config: TrainConfig = Table::root(&source, Paths::AsWritten)?.deserialize()?;
        config.validate().map_err(|error| match &error {
            nets::Error::Setting { key, .. } => source.error_at(key, error.to_string()),
            other => source.file_error(other.to_string()),
        })?;
        if config.name.split('.').next().is_some_and(|first| first.eq_ignore_ascii_case(CHECKPOINT)) {
            let legal = "any name but that of the checkpoints, which lie beside the weights";
            return Err(source.error_at("name", format!("`name` = {:?} is not legal; legal: {legal}", config.name)));
        }
        let mut training = Self { config, source };
        if let Some(first) = training.config.iterates.as_mut().and_then(|iterates| iterates.first.as_mut()) {
            first.weights = find_weights(&training.source, "iterates.first.weights", &first.weights)?;
        }
        Ok(training)
    }

    /// The file or folder that a key names, looked up as in experiments.
    ///
    /// # Errors
    /// If there is none.
    pub fn find(&self, key: &str, path: &Path) -> Result<PathBuf, ConfigError> {
        find(&self.source, key, path)
    }

    /// The weights that it begins with, looked up as in experiments; nothing for random ones.
    ///
    /// # Errors
    /// If there are none where they should be.
    pub fn weights(&self) -> Result<Option<PathBuf>, ConfigError> {
        self.config.weights.as_deref().map(|path| find_weights(&self.source, "weights", path)).transpose()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_training_file_of_the_repository_is_legal() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/train");
        let mut names = Vec::new();
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let training = Training::read(&path, &[]).unwrap_or_else(|error| panic!("{error}"));
            assert_eq!(path.file_stem().unwrap(), training.config.name.as_str());
            // Bundled weights are there, others are what another of the files makes.
            match training.config.weights.as_ref().and_then(|w| w.to_str()) {
                Some(name) if name.starts_with("bundled:") => drop(training.weights().unwrap()),
                Some(made) => {
                    let by = made.strip_prefix("runs/train-").and_then(|rest| rest.split_once('/')).unwrap();
                    assert_eq!(by.1, format!("{}.safetensors", by.0));
                    assert!(path.with_file_name(format!("{}.toml", by.0)).is_file(), "{made}");
                }
                None => {}
            }
            names.push(training.config.name);
        }
        assert!(names.iter().any(|name| name == "ffdnet_gray"), "{names:?}");
    }

    fn problem(text: &str) -> String {
        let source = Source::new("t.toml".as_ref(), text, &[], &|_| Err("none".into()));
        source.and_then(Training::new).unwrap_err().to_string()
    }

    #[test]
    fn mistakes_are_told_with_their_key_and_place() {
        let good = "name = 'a'\n[network]\nkind = 'ffdnet'\nchannels = 1\nwidth = 8\ndepth = 3\n\
                    [data]\nphotos = 'p'\nvalidation = 'v'\npatch = 16\nbatch = 1\n[noise]\nsigma = [0, 50]\n\
                    [training]\nsteps = 9\nlearning_rate = 0.1\n";
        for (from, to, needles) in [
            ("steps = 9", "steps = 'many'", ["t.toml:15: ", "`training.steps` = 'many' is not legal"]),
            ("steps = 9\n", "", ["t.toml:14: ", "`training.steps` is missing"]),
            ("steps = 9", "step = 9", ["t.toml:15: ", "unknown key `step`"]),
            ("[0, 50]", "[0, '50']", ["t.toml:13: ", "`noise.sigma.1` = '50' is not legal"]),
            ("[0, 50]", "[50, 0]", ["t.toml:13: ", "noise.sigma = [50, 0]"]),
            ("depth = 3", "depth = 1", ["t.toml:6: ", "network.depth = 1: 2 to 100"]),
            ("name = 'a'", "name = 'Checkpoint.previous'", ["t.toml:1: ", "any name but that of the checkpoints"]),
        ] {
            assert!(good.contains(from), "{from}");
            let problem = problem(&good.replace(from, to));
            assert!(needles.iter().all(|needle| problem.contains(needle)), "{problem}");
        }
    }
}
