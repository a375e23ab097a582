//! Owns file formats, in and out. Nothing here knows about solvers or configs; nothing elsewhere knows a file format.
//!
//! Every reader takes bytes that may be hostile: it returns a typed error, never panics, and never unpacks more than
//! its [`Budget`](samples::Budget) of four times the file's size plus 64 MiB. Formats are told apart by
//! content, not by the file's name.

pub mod defects;
pub mod frames;
pub mod mat;
pub mod npy;
pub mod output;
pub mod recon;
pub mod samples;
pub mod scene;
pub mod video;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::{fs, io};

use samples::Array;

/// Why a file cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReadError {
    /// The operating system's error.
    #[error("{0}")]
    Io(#[source] io::Error),
    /// The bytes break the format's rules, or use a part of it that is not supported.
    #[error("not a readable {format} file: {reason}")]
    Malformed {
        /// The format it was taken for.
        format: &'static str,
        /// The broken rule.
        reason: String,
    },
    /// None of the known formats.
    #[error(
        "unknown format: expected .mat (v5 to v7.3), .npz, .npy, .gif, .y4m, .png, .jpg or a folder of .png or .jpg frames"
    )]
    UnknownFormat,
    /// It would unpack to more than the budget.
    #[error(
        "unpacks to {} MB or more, at most {} MB are accepted for a file of this size; store it uncompressed to lift the limit",
        .needed >> 20, .limit >> 20
    )]
    TooLarge {
        /// Bytes that would be needed, as far as read.
        needed: usize,
        /// Bytes allowed: four times the file plus 64 MiB.
        limit: usize,
    },
    /// A variable of the right name that is not an array of real numbers.
    #[error("variable `{key}` is {what}, expected a real numeric array")]
    NotNumeric {
        /// The variable.
        key: String,
        /// What it is instead.
        what: &'static str,
    },
    /// A folder without frames.
    #[error("folder has no .png or .jpg frames")]
    NoFrames,
}

/// A [`ReadError`] and the file it happened in.
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", .path.display())]
pub struct FileError {
    /// The file or folder.
    pub path: PathBuf,
    /// What is wrong with it.
    pub source: ReadError,
}

impl FileError {
    /// Names the file an error belongs to.
    pub fn new(path: &Path, source: ReadError) -> Self {
        Self { path: path.to_owned(), source }
    }
}

/// The variables of a file: those asked for, and the names of all.
#[derive(Debug, Default)]
pub struct NamedArrays {
    /// Every name in the file, in file order.
    pub names: Vec<String>,
    /// The arrays asked for that exist.
    pub arrays: BTreeMap<String, Array>,
}

/// Reads a whole file.
///
/// # Errors
/// The operating system's error, with the path.
pub fn read_file(path: &Path) -> Result<Vec<u8>, FileError> {
    fs::read(path).map_err(|e| FileError::new(path, ReadError::Io(e)))
}

/// What a file's content is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// MATLAB, v5 to v7.3: several named arrays, axes reversed.
    Mat,
    /// NumPy archive: several named arrays.
    Npz,
    /// One NumPy array.
    Npy,
    /// Animated GIF.
    Gif,
    /// Raw video.
    Y4m,
    /// A single image.
    Png,
    /// A single image.
    Jpeg,
}

impl Format {
    /// Recognises a format by its first bytes.
    ///
    /// # Errors
    /// [`ReadError::UnknownFormat`].
    pub fn of(bytes: &[u8]) -> Result<Self, ReadError> {
        match () {
            () if npy::is_npy(bytes) => Ok(Self::Npy),
            () if npy::is_npz(bytes) => Ok(Self::Npz),
            () if video::is_gif(bytes) => Ok(Self::Gif),
            () if video::is_y4m(bytes) => Ok(Self::Y4m),
            () if bytes.starts_with(b"\x89PNG\r\n\x1a\n") => Ok(Self::Png),
            () if bytes.starts_with(b"\xff\xd8\xff") => Ok(Self::Jpeg),
            () if mat::is_mat(bytes) => Ok(Self::Mat),
            () => Err(ReadError::UnknownFormat),
        }
    }
}

/// Reads a video file's bytes (GIF, Y4M) as `[T, C, H, W]`.
///
/// # Errors
/// [`ReadError`]; [`ReadError::UnknownFormat`] if it is neither.
pub fn read_video(bytes: &[u8]) -> Result<Array, ReadError> {
    match Format::of(bytes)? {
        Format::Gif => video::read_gif(bytes),
        Format::Y4m => video::read_y4m(bytes),
        _ => Err(ReadError::UnknownFormat),
    }
}
