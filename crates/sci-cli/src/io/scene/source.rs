//! Owns what lies behind a path: named arrays, or one array without a name.

use std::fs::{self, File};
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

use super::{Keys, SceneError};
use crate::io::raw::{self, Raw};
use crate::io::samples::Array;
use crate::io::{FileError, Format, NamedArrays, ReadError, clip, frames, mat, npy, read_file, read_single};

/// An opened file or folder.
pub(super) struct Source {
    path: PathBuf,
    /// The path, for messages.
    pub(super) file: String,
    content: Content,
}

enum Content {
    /// Arrays as `<name>.npy`.
    Arrays(Vec<String>),
    /// Frames as pictures.
    Pictures,
    /// An archive of NumPy arrays, read as they are needed.
    Archive,
    /// A file of another known format.
    File(Vec<u8>, Format),
    /// A file of which is said what it holds.
    Raw(Vec<u8>, Raw),
    /// Arrays in memory, which are handed on beside it, laid out as in this format.
    Memory(Format),
}

impl Source {
    /// Opens a path; `raw` says what is in a file without a header.
    pub(super) fn open(path: &Path, raw: Option<Raw>) -> Result<Self, SceneError> {
        let content = if path.is_dir() {
            let arrays = arrays_of(path)?;
            if arrays.is_empty() { Content::Pictures } else { Content::Arrays(arrays) }
        } else if raw.is_none() && is_archive(path)? {
            Content::Archive
        } else {
            let bytes = read_file(path)?;
            match (raw, Format::of(&bytes)) {
                // Packed pixels may begin like any format.
                (Some(raw), _) => Content::Raw(bytes, raw),
                (None, format) => Content::File(bytes, format.map_err(|e| FileError::new(path, e))?),
            }
        };
        Ok(Self { path: path.to_owned(), file: path.display().to_string(), content })
    }

    /// Of a scene in memory.
    pub(super) fn memory() -> Self {
        Self::part("arrays".to_owned(), Format::Npy)
    }

    /// Of the part of a file that is in memory.
    pub(super) fn part(file: String, format: Format) -> Self {
        Self { path: PathBuf::from(&file), file, content: Content::Memory(format) }
    }

    /// The format, of the arrays in a folder that of each.
    pub(super) fn format(&self) -> Format {
        match &self.content {
            Content::Arrays(_) => Format::Npy,
            Content::Pictures => Format::Png,
            Content::Archive => Format::Npz,
            Content::File(_, format) | Content::Memory(format) => *format,
            Content::Raw(..) => Format::Raw,
        }
    }

    /// Whether its arrays have names.
    pub(super) fn is_named(&self) -> bool {
        matches!(
            self.content,
            Content::Arrays(_) | Content::Archive | Content::Memory(_) | Content::File(_, Format::Mat | Format::Hdf5)
        )
    }

    /// What it is, for a message.
    pub(super) fn what(&self) -> &'static str {
        match self.content {
            Content::Pictures => "a folder of frames",
            Content::File(_, Format::Png | Format::Jpeg) => "a picture",
            _ => "a single array or video",
        }
    }

    /// The names of its arrays, none of an array without.
    pub(super) fn names(&self) -> Result<Vec<String>, SceneError> {
        match &self.content {
            Content::Arrays(names) => Ok(names.clone()),
            Content::Memory(_) => Ok(Vec::new()),
            _ if self.is_named() => Ok(self.arrays(&[])?.names),
            _ => Ok(Vec::new()),
        }
    }

    /// The arrays of these names that exist.
    pub(super) fn arrays(&self, wanted: &[&str]) -> Result<NamedArrays, SceneError> {
        let error = |e| FileError::new(&self.path, e);
        match &self.content {
            Content::File(bytes, Format::Mat | Format::Hdf5) => Ok(mat::read(bytes, wanted).map_err(error)?),
            Content::Archive => {
                let file = File::open(&self.path).map_err(|e| error(ReadError::Io(e)))?;
                Ok(npy::read_npz(BufReader::new(file), wanted).map_err(error)?)
            }
            Content::Arrays(names) => {
                let mut found = NamedArrays { names: names.clone(), ..NamedArrays::default() };
                for name in names.iter().filter(|n| wanted.contains(&n.as_str())) {
                    let member = self.path.join(format!("{name}.npy"));
                    let array = npy::read_npy(&read_file(&member)?).map_err(|e| FileError::new(&member, e))?;
                    found.arrays.insert(name.clone(), array);
                }
                Ok(found)
            }
            _ => Ok(NamedArrays::default()),
        }
    }

    /// The one array without a name: pictures and videos as `[T, C, H, W]`.
    pub(super) fn single(&self) -> Result<Array, SceneError> {
        match &self.content {
            Content::Pictures => Ok(frames::read(&self.path)?),
            Content::File(bytes, _) => Ok(read_single(bytes).map_err(|e| FileError::new(&self.path, e))?),
            Content::Raw(bytes, raw) => Ok(raw::read(bytes, *raw).map_err(|e| FileError::new(&self.path, e))?),
            Content::Arrays(_) | Content::Archive | Content::Memory(_) => {
                Err(FileError::new(&self.path, ReadError::NoFrames).into())
            }
        }
    }

    /// The array of this name, or the only one: a file with one array says what it is by being there. With its name.
    pub(super) fn array(&self, wanted: &str, part: &'static str) -> Result<(Array, String), SceneError> {
        if !self.is_named() {
            return Ok((self.single()?, wanted.to_owned()));
        }
        let names = self.names()?;
        let name = match names.as_slice() {
            [only] => only.as_str(),
            _ => wanted,
        };
        match self.arrays(&[name])?.arrays.remove(name) {
            Some(array) => Ok((array, name.to_owned())),
            None => Err(self.missing(wanted, part, names)),
        }
    }

    /// As [`Source::single`], and clips too.
    pub(super) fn video(&self) -> Result<Array, SceneError> {
        match self.content {
            Content::File(_, Format::Clip(kind)) => {
                Ok(clip::read(&self.path, kind).map_err(|e| FileError::new(&self.path, e))?)
            }
            _ => self.single(),
        }
    }

    /// That a part is not there.
    pub(super) fn missing(&self, key: &str, part: &'static str, present: Vec<String>) -> SceneError {
        let near = super::names::suggestion(key, &present, &Keys::default());
        SceneError::MissingKey { file: self.file.clone(), key: key.into(), part, near, present }
    }
}

/// Whether a file begins as an archive of NumPy arrays does.
fn is_archive(path: &Path) -> Result<bool, FileError> {
    let mut beginning = Vec::new();
    let read = File::open(path).and_then(|file| file.take(4).read_to_end(&mut beginning));
    read.map_err(|e| FileError::new(path, ReadError::Io(e)))?;
    Ok(npy::is_npz(&beginning))
}

/// The names of the arrays in a folder.
fn arrays_of(folder: &Path) -> Result<Vec<String>, SceneError> {
    let io = |e| FileError::new(folder, ReadError::Io(e));
    let mut names = Vec::new();
    for entry in fs::read_dir(folder).map_err(io)? {
        let path = entry.map_err(io)?.path();
        if path.extension().is_some_and(|e| e == "npy") && path.is_file() {
            names.extend(path.file_stem().map(|stem| stem.to_string_lossy().into_owned()));
        }
    }
    names.sort();
    Ok(names)
}
