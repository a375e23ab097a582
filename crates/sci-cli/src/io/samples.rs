//! Owns the one in-memory form every reader produces: a row-major array of 8-bit or floating samples.
//!
//! Files hold a dozen number types; the solvers want `f32`. Eight-bit samples stay eight-bit until a scene is
//! assembled, so that a long video costs a byte a sample, and everything else is converted while it is decoded.

use super::ReadError;

/// Bytes a reader may allocate on top of four times the file's own size.
///
/// Large enough for any single benchmark scene however well it compresses, small enough that a forged header or a
/// decompression bomb cannot exhaust the machine.
pub const BUDGET_SLACK: usize = 64 << 20;

/// What one file may unpack to: four bytes for each of its own plus [`BUDGET_SLACK`].
///
/// The factor is what an uncompressed file of bytes needs when it is widened to `f32`, so a file that holds its data
/// uncompressed is never refused.
#[derive(Clone, Copy, Debug)]
pub struct Budget {
    limit: usize,
    left: usize,
}

impl Budget {
    /// The budget of a file of `len` bytes.
    pub fn for_file(len: usize) -> Self {
        let limit = len.saturating_mul(4).saturating_add(BUDGET_SLACK);
        Self { limit, left: limit }
    }

    /// Bytes not yet claimed.
    pub fn left(&self) -> usize {
        self.left
    }

    /// Claims `count` items of `size` bytes.
    ///
    /// # Errors
    /// [`ReadError::TooLarge`] if that is more than is left (or overflows).
    pub fn claim(&mut self, count: usize, size: usize) -> Result<(), ReadError> {
        let needed = count.checked_mul(size).filter(|&n| n <= self.left);
        match needed {
            Some(n) => {
                self.left -= n;
                Ok(())
            }
            None => Err(ReadError::TooLarge {
                needed: count.saturating_mul(size).saturating_add(self.limit - self.left),
                limit: self.limit,
            }),
        }
    }
}

/// The number type of stored samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum SampleType {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
}

impl SampleType {
    /// Bytes of one sample.
    pub fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }

    /// Whether the samples are whole numbers, which by convention run from 0 to 255.
    pub fn is_integer(self) -> bool {
        !matches!(self, Self::F32 | Self::F64)
    }

    /// Bytes one sample takes once decoded.
    pub fn decoded_size(self) -> usize {
        if self == Self::U8 { 1 } else { 4 }
    }
}

/// Byte order of stored samples.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Endian {
    /// Least significant byte first.
    Little,
    /// Most significant byte first.
    Big,
}

/// Decoded samples.
#[derive(Clone, Debug, PartialEq)]
pub enum Samples {
    /// As stored, 0 to 255.
    Bytes(Vec<u8>),
    /// Everything else, widened or narrowed to `f32`.
    Floats(Vec<f32>),
}

impl Samples {
    /// Number of samples.
    pub fn len(&self) -> usize {
        match self {
            Self::Bytes(v) => v.len(),
            Self::Floats(v) => v.len(),
        }
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The sample at `index` of the row-major order.
    ///
    /// # Panics
    /// If `index` is not below [`Samples::len`].
    pub fn at(&self, index: usize) -> f32 {
        match self {
            Self::Bytes(v) => f32::from(v[index]),
            Self::Floats(v) => v[index],
        }
    }

    /// Decodes raw bytes; a trailing partial sample is ignored.
    pub fn decode(raw: Vec<u8>, kind: SampleType, endian: Endian) -> Self {
        macro_rules! floats {
            ($t:ty) => {
                Self::Floats(
                    raw.chunks_exact(size_of::<$t>())
                        .map(|b| {
                            let b = b.try_into().expect("chunks_exact yields this length");
                            (match endian {
                                Endian::Little => <$t>::from_le_bytes(b),
                                Endian::Big => <$t>::from_be_bytes(b),
                            }) as f32
                        })
                        .collect(),
                )
            };
        }
        match kind {
            SampleType::U8 => Self::Bytes(raw),
            SampleType::I8 => floats!(i8),
            SampleType::I16 => floats!(i16),
            SampleType::U16 => floats!(u16),
            SampleType::I32 => floats!(i32),
            SampleType::U32 => floats!(u32),
            SampleType::I64 => floats!(i64),
            SampleType::U64 => floats!(u64),
            SampleType::F32 => floats!(f32),
            SampleType::F64 => floats!(f64),
        }
    }
}

/// An array as a file stores it: row-major, with the number type it had there.
///
/// # Examples
/// ```
/// use sci_cli::io::samples::{Array, SampleType, Samples};
/// let a = Array::new(vec![2, 1], Samples::Bytes(vec![0, 255]), SampleType::U8).unwrap();
/// assert_eq!(a.shape(), [2, 1]);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Array {
    shape: Vec<usize>,
    samples: Samples,
    stored: SampleType,
}

impl Array {
    /// Joins a shape and its samples.
    ///
    /// # Errors
    /// [`ReadError::Malformed`] if the shape does not hold that many samples.
    pub fn new(shape: Vec<usize>, samples: Samples, stored: SampleType) -> Result<Self, ReadError> {
        match element_count(&shape) {
            Some(n) if n == samples.len() => Ok(Self { shape, samples, stored }),
            _ => Err(ReadError::Malformed {
                format: "array",
                reason: format!("shape {shape:?} does not hold {} samples", samples.len()),
            }),
        }
    }

    /// Row-major shape.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The samples, row-major.
    pub fn samples(&self) -> &Samples {
        &self.samples
    }

    /// The number type in the file.
    pub fn stored(&self) -> SampleType {
        self.stored
    }
}

/// Product of a shape, or `None` where it overflows.
pub fn element_count(shape: &[usize]) -> Option<usize> {
    shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decodes_every_type_in_both_orders() {
        assert_eq!(
            Samples::decode(vec![1, 2, 3, 4], SampleType::U16, Endian::Little),
            Samples::Floats(vec![513.0, 1027.0])
        );
        assert_eq!(
            Samples::decode(vec![1, 2, 3, 4], SampleType::U16, Endian::Big),
            Samples::Floats(vec![258.0, 772.0])
        );
        assert_eq!(
            Samples::decode((-2.5f64).to_be_bytes().to_vec(), SampleType::F64, Endian::Big),
            Samples::Floats(vec![-2.5])
        );
        assert_eq!(Samples::decode(vec![255], SampleType::I8, Endian::Little), Samples::Floats(vec![-1.0]));
    }

    #[test]
    fn budget_refuses_overflowing_claims() {
        let mut budget = Budget::for_file(10);
        assert!(budget.claim(10, 4).is_ok());
        assert!(matches!(
            budget.claim(usize::MAX, 8),
            Err(ReadError::TooLarge { limit, .. }) if limit == 40 + BUDGET_SLACK
        ));
    }
}
