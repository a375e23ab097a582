//! What can go wrong in this crate.

use crate::Architecture;
use candle_core::DType;
use std::path::{Path, PathBuf};

/// An error of the networks, their weight files or their training.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A file could not be read.
    #[error("{}: cannot be read", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A file could not be written.
    #[error("{}: cannot be written", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The bytes are not what the file's name or contents promise.
    #[error("{}: {reason}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// What does not hold.
        reason: String,
    },
    /// No bundled weights of that name.
    #[error("no bundled weights \"{name}\"; there {}", list_bundled(known))]
    UnknownBundled {
        /// The name asked for.
        name: String,
        /// The names that exist.
        known: Vec<&'static str>,
    },
    /// The tensors of a file are not those of any network known here.
    #[error("{}: no known network has these tensors (FFDNet, FastDVDnet, DDNet and ShiftNet are known); the file has {}", path.display(), list(found))]
    UnknownArchitecture {
        /// The file.
        path: PathBuf,
        /// The names in the file.
        found: Vec<String>,
    },
    /// The file holds the weights of another network.
    #[error("{}: these are weights of {found}, not of {expected}", path.display())]
    WrongArchitecture {
        /// The file.
        path: PathBuf,
        /// The network asked for.
        expected: &'static str,
        /// The network found.
        found: String,
    },
    /// The tensors of a file do not fit the network they belong to.
    #[error("{}: does not hold the weights of {network}: {keys}", path.display())]
    Keys {
        /// The file.
        path: PathBuf,
        /// The network that the file was taken for.
        network: String,
        /// The differences.
        keys: KeyReport,
    },
    /// Tensors given to a network are not its own.
    #[error("these are not the tensors of {network}: {keys}")]
    State {
        /// The network.
        network: String,
        /// The differences.
        keys: KeyReport,
    },
    /// A weight is NaN or infinite.
    #[error("{}: tensor {key} holds {value}: weights must be finite", path.display())]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// The tensor.
        key: String,
        /// The first such value.
        value: f32,
    },
    /// A tensor has a number type that no weight has.
    #[error("{}: tensor {key} is of type {dtype:?}: f16, bf16, f32 and f64 can be read", path.display())]
    DType {
        /// The file.
        path: PathBuf,
        /// The tensor.
        key: String,
        /// Its type.
        dtype: DType,
    },
    /// A video with the wrong number of channels.
    #[error("{network} takes videos of {expected} channel(s), this one has {found}")]
    Channels {
        /// The network.
        network: String,
        /// The number it was trained for.
        expected: usize,
        /// The number given.
        found: usize,
    },
    /// Input and output differ in shape, or a video has no pixels.
    #[error("{what}: expected shape {expected:?}, found {found:?}")]
    Shape {
        /// What has the wrong shape.
        what: &'static str,
        /// The legal shape.
        expected: Vec<usize>,
        /// The shape found.
        found: Vec<usize>,
    },
    /// A noise level outside its range.
    #[error("a noise level of {0}: it must be finite and at least 0 (frames are in [0, 1])")]
    Sigma(f32),
    /// A setting outside its range.
    #[error("{key} = {value}: {legal}")]
    Setting {
        /// The setting.
        key: &'static str,
        /// The value given.
        value: String,
        /// What is legal.
        legal: String,
    },
    /// The training data is unusable.
    #[error("training data: {0}")]
    Data(String),
    /// Training left the finite numbers.
    #[error("training diverged at step {step}: the loss is {loss}")]
    Diverged {
        /// The step.
        step: u64,
        /// The loss there.
        loss: f32,
    },
    /// A convolution kernel refused its arguments.
    #[error(transparent)]
    Kernel(#[from] crate::kernels::KernelError),
    /// A tensor operation failed.
    #[error(transparent)]
    Candle(#[from] candle_core::Error),
}

impl Error {
    pub(crate) fn format(path: &Path, reason: impl Into<String>) -> Self {
        Self::Format { path: path.to_owned(), reason: reason.into() }
    }

    pub(crate) fn wrong_architecture(path: &Path, expected: &'static str, found: Architecture) -> Self {
        Self::WrongArchitecture { path: path.to_owned(), expected, found: found.to_string() }
    }
}

/// How the tensors of a file differ from those that a network expects.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct KeyReport {
    /// Expected, and not in the file.
    pub missing: Vec<String>,
    /// In the file, and not expected.
    pub unexpected: Vec<String>,
    /// `(name, expected shape, found shape)`.
    pub mismatched: Vec<(String, Vec<usize>, Vec<usize>)>,
}

impl KeyReport {
    /// Whether there is no difference.
    pub fn is_empty(&self) -> bool {
        self.missing.is_empty() && self.unexpected.is_empty() && self.mismatched.is_empty()
    }
}

impl std::fmt::Display for KeyReport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut parts = Vec::new();
        if !self.missing.is_empty() {
            parts.push(format!("missing {}", list(&self.missing)));
        }
        if !self.unexpected.is_empty() {
            parts.push(format!("unexpected {}", list(&self.unexpected)));
        }
        if !self.mismatched.is_empty() {
            let shapes: Vec<String> = self
                .mismatched
                .iter()
                .map(|(name, expected, found)| format!("{name} (expected {expected:?}, found {found:?})"))
                .collect();
            parts.push(format!("wrong shape {}", list(&shapes)));
        }
        f.write_str(&parts.join("; "))
    }
}

/// The first few names, and how many more.
fn list(names: &[String]) -> String {
    const SHOWN: usize = 8;
    let shown = names.iter().take(SHOWN).cloned().collect::<Vec<_>>().join(", ");
    match names.len() {
        0 => "none".into(),
        n if n > SHOWN => format!("{shown} and {} more", n - SHOWN),
        _ => shown,
    }
}

fn list_bundled(known: &[&str]) -> String {
    if known.is_empty() { "are none in this build".into() } else { format!("are: {}", known.join(", ")) }
}
