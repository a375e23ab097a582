//! Owns single files on their way to disk: written aside, then moved into place, so that none is ever half-written.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use ndarray::{ArrayView4, Axis};

use super::mat::{Variable, write_v5};
use super::npy;

/// Full scale of the samples in `.mat` files.
pub(super) const MAT_SCALE: f32 = 255.0;

/// Why a result cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write {}: {source}", .path.display())]
pub struct WriteError {
    /// The file or folder.
    pub path: PathBuf,
    /// What happened.
    pub source: Box<dyn std::error::Error + Send + Sync>,
}

impl WriteError {
    /// Names the file an error belongs to.
    pub fn new(path: &Path, source: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> Self {
        Self { path: path.to_owned(), source: source.into() }
    }
}

/// Writes a single file by way of a temporary one beside it.
///
/// # Errors
/// The file system's or `fill`'s error, naming the file.
pub fn write_atomically<E>(
    path: &Path,
    fill: impl FnOnce(&mut BufWriter<&File>) -> Result<(), E>,
) -> Result<(), WriteError>
where
    E: Into<Box<dyn std::error::Error + Send + Sync>>,
{
    let parent = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    fs::create_dir_all(parent).map_err(|e| WriteError::new(path, e))?;
    let temporary = tempfile::Builder::new()
        .prefix(".sci-")
        .suffix(".tmp")
        .tempfile_in(parent)
        .map_err(|e| WriteError::new(path, e))?;
    let mut writer = BufWriter::new(temporary.as_file());
    fill(&mut writer).map_err(|e| WriteError::new(path, e))?;
    writer.flush().map_err(|e| WriteError::new(path, e))?;
    drop(writer);
    make_readable(temporary.as_file()).map_err(|e| WriteError::new(path, e))?;
    temporary.persist(path).map_err(|e| WriteError::new(path, e.error))?;
    Ok(())
}

/// Temporary files are private; a result gets the usual permissions.
fn make_readable(file: &File) -> io::Result<()> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        file.set_permissions(fs::Permissions::from_mode(0o644))?;
    }
    #[cfg(not(unix))]
    let _ = file;
    Ok(())
}

/// Formats of an array file, by its name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ArrayFormat {
    /// One NumPy array.
    Npy,
    /// NumPy archive.
    Npz,
    /// MATLAB v5.
    Mat,
}

impl ArrayFormat {
    /// The format a file's extension asks for.
    pub fn of(path: &Path) -> Option<Self> {
        match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "npy" => Some(Self::Npy),
            "npz" => Some(Self::Npz),
            "mat" => Some(Self::Mat),
            _ => None,
        }
    }

    /// The extension.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Npy => "npy",
            Self::Npz => "npz",
            Self::Mat => "mat",
        }
    }
}

/// A named array to write: `[T, C, H, W]`, and what its white is in a `.mat` file.
#[derive(Clone, Copy, Debug)]
pub struct Part<'a> {
    /// Variable name.
    pub name: &'a str,
    /// The samples.
    pub data: ArrayView4<'a, f32>,
    /// Whether the samples are light (0 to 255 in a `.mat`) or transmittance (unscaled everywhere).
    pub is_light: bool,
}

/// Writes arrays: `.npz` and `.mat` by name, `.npy` the first only. A single channel keeps its axis only as video in `.npy`.
///
/// `.mat` holds MATLAB's `[H, W, T]` (`[H, W, 3, T]` for color), light times 255, as scene files do.
///
/// # Errors
/// The file system's, naming the file.
pub fn write_arrays(path: &Path, format: ArrayFormat, parts: &[Part<'_>]) -> Result<(), WriteError> {
    match format {
        ArrayFormat::Npy => write_atomically(path, |w| match parts.first() {
            Some(part) if part.is_light => npy::write_npy(w, &part.data),
            Some(part) => npy::write_npy(w, &without_single_channel(part.data)),
            None => Ok(()),
        }),
        ArrayFormat::Npz => write_atomically(path, |w| {
            let arrays: Vec<_> = parts.iter().map(|p| (p.name, without_single_channel(p.data))).collect();
            npy::write_npz(w, &arrays)
        }),
        ArrayFormat::Mat => write_atomically(path, |w| for_matlab(parts, |variables| write_v5(w, variables))),
    }
}

fn without_single_channel(data: ArrayView4<'_, f32>) -> ndarray::ArrayViewD<'_, f32> {
    if data.len_of(Axis(1)) == 1 { data.index_axis_move(Axis(1), 0).into_dyn() } else { data.into_dyn() }
}

fn for_matlab<R>(parts: &[Part<'_>], write: impl FnOnce(&[Variable<'_>]) -> R) -> R {
    let owned: Vec<(Vec<usize>, Vec<f32>)> = parts
        .iter()
        .map(|p| {
            let (t, c, h, w) = p.data.dim();
            let size = if c == 1 { vec![h, w, t] } else { vec![h, w, c, t] };
            let scale = if p.is_light { MAT_SCALE } else { 1.0 };
            // Column-major [H, W, C, T] is row-major [T, C, W, H].
            (size, p.data.permuted_axes([0, 1, 3, 2]).iter().map(|x| x * scale).collect())
        })
        .collect();
    let variables: Vec<Variable<'_>> =
        parts.iter().zip(&owned).map(|(p, (size, data))| Variable { name: p.name, size, data }).collect();
    write(&variables)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::mat;
    use ndarray::Array4;

    #[test]
    fn mat_output_reads_back_as_a_scene_part() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("recon.mat");
        let video = Array4::from_shape_fn((2, 1, 3, 4), |(t, _, y, x)| (t * 12 + y * 4 + x) as f32 / 255.0);
        write_arrays(&path, ArrayFormat::Mat, &[Part { name: "orig", data: video.view(), is_light: true }]).unwrap();
        let found = mat::read(&fs::read(&path).unwrap(), &["orig"]).unwrap();
        let orig = &found.arrays["orig"];
        assert_eq!(orig.shape(), [2, 4, 3]);
        assert!((orig.samples().at(1) - 4.0).abs() < 1e-4);
    }
}
