//! Weight files: published `.pth`, `.safetensors`, and those bundled with the crate.
//!
//! A file becomes named f32 tensors; a network takes them only when the names and shapes are exactly its own.

mod bundled;
mod pickle;
mod pth;
mod stored;

use crate::{Architecture, Ends, Error, Result};
use candle_core::{DType, Tensor};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

pub use bundled::{bundled_for_iterates, bundled_names, bundled_sizes};
use stored::Named;
pub(crate) use stored::read_safetensors;

/// One tensor of a weight file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TensorSummary {
    /// Its name, without a leading `module.`.
    pub name: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// Its type in the file, such as `F32`.
    pub dtype: String,
}

/// The tensors of a weight file, as f32, by name; a leading `module.` (PyTorch's data-parallel wrapper) is stripped.
#[derive(Debug, Clone)]
pub struct WeightFile {
    path: PathBuf,
    tensors: BTreeMap<String, Tensor>,
    stored: BTreeMap<String, DType>,
}

impl WeightFile {
    /// Reads a file, or bundled weights when the path is `bundled:NAME`. The format is told by the contents.
    ///
    /// # Errors
    /// When the file cannot be read, is cut short, or holds a weight that is not finite.
    pub fn read(path: &Path) -> Result<Self> {
        if let Some(name) = path.to_str().and_then(|p| p.strip_prefix("bundled:")) {
            return Self::parse(path, bundled::bytes(name)?);
        }
        let bytes = std::fs::read(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
        Self::parse(path, &bytes)
    }

    /// Reads the bytes of a file; `path` is for messages.
    ///
    /// # Errors
    /// As [`WeightFile::read`].
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self> {
        let stored = if pth::looks_like(bytes) {
            pth::read(bytes)
        } else {
            read_safetensors(bytes)
                .map(|(tensors, _)| tensors)
                .map_err(|e| format!("neither a .pth nor a whole .safetensors file: {e}"))
        };
        Self::from_stored(path, stored.map_err(|reason| Error::format(path, reason))?)
    }

    fn from_stored(path: &Path, stored: Named) -> Result<Self> {
        let mut file = Self { path: path.to_owned(), tensors: BTreeMap::new(), stored: BTreeMap::new() };
        for (name, tensor) in stored {
            let name = name.strip_prefix("module.").unwrap_or(&name).to_owned();
            if file.stored.insert(name.clone(), tensor.dtype).is_some() {
                return Err(Error::format(
                    path,
                    format!("holds the tensor {name} twice, with and without \"module.\""),
                ));
            }
            if name.ends_with("num_batches_tracked") {
                continue;
            }
            if !tensor.is_float() {
                return Err(Error::DType { path: path.to_owned(), key: name, dtype: tensor.dtype });
            }
            if let Some(value) = tensor.not_finite() {
                return Err(Error::NotFinite { path: path.to_owned(), key: name, value });
            }
            file.tensors.insert(name, tensor.into_tensor()?);
        }
        Ok(file)
    }

    /// Where it came from.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The network that the tensors belong to, told by their names and shapes. That all are there is checked by the
    /// network's `from_weights`.
    ///
    /// # Errors
    /// [`Error::UnknownArchitecture`].
    pub fn architecture(&self) -> Result<Architecture> {
        Architecture::recognise(self).ok_or_else(|| Error::UnknownArchitecture {
            path: self.path.clone(),
            found: self.tensors.keys().cloned().collect(),
        })
    }

    /// Name, shape and stored type of every tensor.
    pub fn summary(&self) -> Vec<TensorSummary> {
        let one = |(name, tensor): (&String, &Tensor)| TensorSummary {
            name: name.clone(),
            shape: tensor.dims().to_vec(),
            dtype: format!("{:?}", self.stored[name]),
        };
        self.tensors.iter().map(one).collect()
    }

    /// Number of values in all tensors, batch norm statistics included.
    pub fn value_count(&self) -> usize {
        self.tensors.values().map(Tensor::elem_count).sum()
    }

    /// The tensors.
    pub fn into_tensors(self) -> BTreeMap<String, Tensor> {
        self.tensors
    }

    pub(crate) fn shapes(&self) -> impl Iterator<Item = (&str, &[usize])> {
        self.tensors.iter().map(|(name, tensor)| (name.as_str(), tensor.dims()))
    }

    pub(crate) fn shape(&self, name: &str) -> Option<&[usize]> {
        self.tensors.get(name).map(Tensor::dims)
    }
}

/// Rewrites a `.pth` or `.safetensors` file as `.safetensors`, on request with batch norm folded into the convolutions.
/// Writing `.pth` is not offered: it would take a pickle writer, and PyTorch reads `.safetensors`.
///
/// # Errors
/// When the input cannot be read as the weights of a known network, or the output cannot be written.
pub fn convert(input: &Path, output: &Path, fold_batch_norm: bool, storage: Storage) -> Result<()> {
    only_safetensors(output)?;
    let mut net = Architecture::load(WeightFile::read(input)?, Ends::Circular)?;
    if fold_batch_norm {
        net.fold_batch_norm()?;
    }
    write_safetensors(output, &net.state(), storage)
}

/// Writes weights that are a share of the way from some to others of the same network: a network that has learned something new has often lost a
/// little of the old, and most of the way has most of both.
///
/// # Errors
/// When a file cannot be read, the networks differ, the share is not from 0 to 1, or the output cannot be written.
///
/// # References
/// Wortsman et al., *Robust fine-tuning of zero-shot models*, CVPR 2022.
pub fn blend(from: &Path, to: &Path, share: f64, output: &Path, storage: Storage) -> Result<()> {
    if !(0.0..=1.0).contains(&share) {
        let legal = "0 to 1".to_owned();
        return Err(Error::Setting { key: "share", value: share.to_string(), legal });
    }
    only_safetensors(output)?;
    let state = |path: &Path| Ok::<_, Error>(Architecture::load(WeightFile::read(path)?, Ends::Circular)?.state());
    let (state, other) = (state(from)?, state(to)?);
    if state.len() != other.len() {
        return Err(Error::format(to, format!("is of another network than {}", from.display())));
    }
    let part = |(name, from_tensor): (String, Tensor)| {
        let to_tensor = other.get(&name).filter(|to| to.dims() == from_tensor.dims());
        let to_tensor =
            to_tensor.ok_or_else(|| Error::format(to, format!("has no {name} like that of {}", from.display())))?;
        Ok((name, (from_tensor.affine(1.0 - share, 0.0)? + to_tensor.affine(share, 0.0)?)?))
    };
    write_safetensors(output, &state.into_iter().map(part).collect::<Result<_>>()?, storage)
}

fn only_safetensors(output: &Path) -> Result<()> {
    if output.extension().is_none_or(|e| e != "safetensors") {
        return Err(Error::format(output, "weights are written as .safetensors only: give the file that extension"));
    }
    Ok(())
}

/// How [`write_safetensors`] stores numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Storage {
    /// 4 bytes a weight, exact.
    #[default]
    F32,
    /// 2 bytes a weight; relative error up to 2⁻¹¹. For files that must be small.
    F16,
}

/// Writes tensors to a `.safetensors` file: to a temporary name first, so that the file is never half-written.
///
/// # Errors
/// [`Error::Write`]; [`Error::Format`] for numbers that are too large for [`Storage::F16`].
pub fn write_safetensors(path: &Path, tensors: &BTreeMap<String, Tensor>, storage: Storage) -> Result<()> {
    let dtype = match storage {
        Storage::F32 => DType::F32,
        Storage::F16 => DType::F16,
    };
    let convert = |tensor: &Tensor| -> candle_core::Result<(Tensor, bool)> {
        let stored = tensor.to_dtype(dtype)?;
        let largest: f32 = stored.abs()?.max_all()?.to_dtype(DType::F32)?.to_scalar()?;
        Ok((stored, storage == Storage::F32 || largest.is_finite()))
    };
    let mut converted = Vec::new();
    for (name, tensor) in tensors {
        let (stored, fits) = convert(tensor)?;
        if !fits {
            let why = format!("tensor {name} holds numbers beyond 65504, the largest of f16: it must be stored as f32");
            return Err(Error::format(path, why));
        }
        converted.push((name.as_str(), stored));
    }
    let bytes = safetensors::serialize(converted, None).map_err(|e| Error::format(path, e.to_string()))?;
    write_atomically(path, &bytes, |_| Ok(()))
}

/// Writes to a hidden file beside `path`, then renames; `before` runs between the two. The hidden file has one name, so that a program that
/// is killed again and again does not leave more than one.
pub(crate) fn write_atomically(
    path: &Path,
    bytes: &[u8],
    before: impl FnOnce(&Path) -> std::io::Result<()>,
) -> Result<()> {
    let mut name = std::ffi::OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(".sci-tmp");
    let temporary = path.with_file_name(name);
    let write = || {
        let mut file = std::fs::File::create(&temporary)?;
        std::io::Write::write_all(&mut file, bytes)?;
        file.sync_all()?;
        before(path)?;
        std::fs::rename(&temporary, path)
    };
    write().map_err(|source| Error::Write { path: path.to_owned(), source })
}
