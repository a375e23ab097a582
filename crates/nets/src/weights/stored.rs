//! Tensors as a file stores them, and the `.safetensors` format.

use candle_core::{DType, Tensor};
use safetensors::SafeTensors;
use std::collections::{BTreeMap, HashMap};

/// Bytes of the header of a `.safetensors` file, at most: those of networks have some ten thousand.
const MOST_HEADER: u64 = 1 << 20;

/// The axes of a weight, at most.
pub(super) const MOST_AXES: usize = 8;

/// Tensors by name.
pub(crate) type Named = BTreeMap<String, Stored>;

/// One tensor.
#[derive(Debug)]
pub(crate) struct Stored {
    /// The type that it is stored in.
    pub(crate) dtype: DType,
    shape: Vec<usize>,
    /// Nothing, if weights cannot be of this type.
    values: Vec<f32>,
}

impl Stored {
    /// From what lies in a file, in row-major order, low bytes first.
    pub(super) fn new(dtype: DType, shape: &[usize], data: &[u8]) -> Result<Self, String> {
        if shape.len() > MOST_AXES || shape.contains(&0) {
            return Err(format!("has {} axes, or one of length 0; weights have 1 to {MOST_AXES}", shape.len()));
        }
        let values = match dtype {
            DType::F32 => each(data, f32::from_le_bytes),
            DType::F64 => each(data, |bytes| f64::from_le_bytes(bytes) as f32),
            DType::F16 => each(data, |bytes| half::f16::from_le_bytes(bytes).to_f32()),
            DType::BF16 => each(data, |bytes| half::bf16::from_le_bytes(bytes).to_f32()),
            _ => Vec::new(),
        };
        Ok(Self { dtype, shape: shape.to_vec(), values })
    }

    /// Whether weights can be of its type.
    pub(super) fn is_float(&self) -> bool {
        matches!(self.dtype, DType::F16 | DType::BF16 | DType::F32 | DType::F64)
    }

    /// The first value that is NaN or infinite.
    pub(crate) fn not_finite(&self) -> Option<f32> {
        self.values.iter().copied().find(|value| !value.is_finite())
    }

    /// As a tensor of f32.
    pub(crate) fn into_tensor(self) -> candle_core::Result<Tensor> {
        Tensor::from_vec(self.values, self.shape, &candle_core::Device::Cpu)
    }
}

fn each<const N: usize>(data: &[u8], number: impl Fn([u8; N]) -> f32) -> Vec<f32> {
    data.as_chunks().0.iter().map(|&bytes| number(bytes)).collect()
}

/// The tensors of a `.safetensors` file, and what it says beside them.
pub(crate) fn read_safetensors(bytes: &[u8]) -> Result<(Named, HashMap<String, String>), String> {
    if let Some(header) = bytes.first_chunk().map(|length| u64::from_le_bytes(*length)).filter(|&n| n > MOST_HEADER) {
        return Err(format!("a header of {header} bytes; those of weights have at most {MOST_HEADER}"));
    }
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(|e| e.to_string())?;
    let file = SafeTensors::deserialize(bytes).map_err(|e| e.to_string())?;
    let mut tensors = BTreeMap::new();
    for (name, view) in file.iter() {
        let named = |why: String| format!("tensor {name} {why}");
        let dtype = DType::try_from(view.dtype()).map_err(|_| named(format!("is of type {:?}", view.dtype())))?;
        tensors.insert(name.to_owned(), Stored::new(dtype, view.shape(), view.data()).map_err(named)?);
    }
    Ok((tensors, header.metadata().clone().unwrap_or_default()))
}
