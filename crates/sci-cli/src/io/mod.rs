//! Owns file formats, in and out. Nothing here knows about solvers or configs; nothing elsewhere knows a file format.
//!
//! Every reader takes bytes that may be hostile: it returns a typed error, never panics, and never unpacks more than
//! its [`Budget`](samples::Budget) of four times the file's size plus 64 MiB (a [`clip`] has a limit of its own). Formats are told
//! apart by content, not by the file's name; only what has no header, [`raw`] frames, must be told what it is.

pub mod clip;
pub mod defects;
pub mod frames;
pub mod hdf5;
pub mod mat;
pub mod npy;
pub mod output;
pub mod raw;
pub mod recon;
pub mod samples;
pub mod scene;
pub mod slab;
pub mod tiff;
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
        "unknown format: expected .mat (v5 to v7.3), .h5, .npz, .npy, .tif, .gif, .y4m, .png, .jpg or a folder of .png, .jpg or .tif frames; frames without a header need data.raw"
    )]
    UnknownFormat,
    /// What Git keeps in the place of a large file.
    #[error(
        "a Git LFS pointer, not the file itself: fetch it with `git lfs pull`, or download it from the page of the repository"
    )]
    LfsPointer,
    /// What a server answered in the place of the file.
    #[error(
        "an HTML page saved under this name, not the file itself: a download that needs a login or a click; open it in a browser to see"
    )]
    HtmlPage,
    /// A clip where there is no program to decode it.
    #[error(
        "an {kind} clip is decoded by ffmpeg, which cannot be started ({source}): install it so that it is on the path, or turn the clip into pictures elsewhere"
    )]
    NoFfmpeg {
        /// The clip's format.
        kind: &'static str,
        /// Why it cannot be started.
        source: io::Error,
    },
    /// A clip of too many or too large frames.
    #[error("the frames of this {kind} clip take more than {} MB: cut it or make it smaller, for example with ffmpeg -t 2 -vf scale=512:-2", .limit >> 20)]
    ClipTooLarge {
        /// The clip's format.
        kind: &'static str,
        /// Bytes allowed.
        limit: usize,
    },
    /// A clip where arrays or pictures are expected.
    #[error(
        "an {kind} clip; measurements and masks are read from arrays and pictures, clips only as the video to simulate from"
    )]
    ClipAsScene {
        /// The clip's format.
        kind: &'static str,
    },
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
    #[error("folder has no .png, .jpg or .tif frames")]
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
    /// HDF5 of others: several named arrays, axes as they mean them.
    Hdf5,
    /// NumPy archive: several named arrays.
    Npz,
    /// One NumPy array.
    Npy,
    /// Pages of pictures.
    Tiff,
    /// Frames without a header, only where it is said that they are.
    Raw,
    /// Compressed video for `ffmpeg`.
    Clip(&'static str),
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
    /// [`ReadError::UnknownFormat`], or what it is instead if that is known to happen.
    pub fn of(bytes: &[u8]) -> Result<Self, ReadError> {
        match () {
            () if tiff::is_tiff(bytes) => Ok(Self::Tiff),
            () if npy::is_npy(bytes) => Ok(Self::Npy),
            () if npy::is_npz(bytes) => Ok(Self::Npz),
            () if video::is_gif(bytes) => Ok(Self::Gif),
            () if video::is_y4m(bytes) => Ok(Self::Y4m),
            () if bytes.starts_with(b"\x89PNG\r\n\x1a\n") => Ok(Self::Png),
            () if bytes.starts_with(b"\xff\xd8\xff") => Ok(Self::Jpeg),
            () if hdf5::is_hdf5(bytes) && !hdf5::is_matlab(bytes) => Ok(Self::Hdf5),
            () if mat::is_mat(bytes) => Ok(Self::Mat),
            () if bytes.starts_with(b"version https://git-lfs.") => Err(ReadError::LfsPointer),
            () if is_html(bytes) => Err(ReadError::HtmlPage),
            () => clip::kind(bytes).map(Self::Clip).ok_or(ReadError::UnknownFormat),
        }
    }
}

fn is_html(bytes: &[u8]) -> bool {
    let text = bytes.trim_ascii_start();
    ["<!doctype html", "<html"]
        .iter()
        .any(|tag| text.get(..tag.len()).is_some_and(|t| t.eq_ignore_ascii_case(tag.as_bytes())))
}

/// Reads the one array of a file without names: a `.npy`, a picture, or a video (as `[T, C, H, W]`).
///
/// # Errors
/// [`ReadError`]; [`ReadError::UnknownFormat`] if it is none of them.
pub fn read_single(bytes: &[u8]) -> Result<Array, ReadError> {
    match Format::of(bytes)? {
        Format::Npy => npy::read_npy(bytes),
        Format::Tiff => tiff::read(bytes),
        Format::Gif => video::read_gif(bytes),
        Format::Y4m => video::read_y4m(bytes),
        Format::Png | Format::Jpeg => frames::read_picture(bytes),
        Format::Clip(kind) => Err(ReadError::ClipAsScene { kind }),
        Format::Mat | Format::Hdf5 | Format::Npz | Format::Raw => Err(ReadError::UnknownFormat),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_downloads_leave_behind_is_called_by_its_name() {
        let of = |bytes: &[u8]| Format::of(bytes).unwrap_err().to_string();
        let pointer = of(b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n");
        assert!(pointer.contains("Git LFS pointer") && pointer.contains("git lfs pull"), "{pointer}");
        for page in ["<!DOCTYPE html><html>", "\n <html lang=en>"] {
            assert!(of(page.as_bytes()).contains("HTML page"), "{}", of(page.as_bytes()));
        }
        assert!(of(b"<htm").contains("unknown format"));
    }

    #[test]
    fn formats_are_told_by_content() {
        assert_eq!(Format::of(b"II*\0....").unwrap(), Format::Tiff);
        assert_eq!(Format::of(b"\x89HDF\r\n\x1a\n....").unwrap(), Format::Hdf5);
        assert_eq!(Format::of(b"\x89HDF\r\n\x1a\n....MATLAB_class").unwrap(), Format::Mat);
        assert_eq!(Format::of(b"\0\0\0\x20ftypisom").unwrap(), Format::Clip("MP4"));
    }
}
