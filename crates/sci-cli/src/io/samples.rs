//! Owns the one in-memory form every reader produces: a row-major array of 8-bit or floating samples.
//!
//! Files hold a dozen number types; the solvers want `f32`. Eight-bit samples stay eight-bit until a scene is
//! assembled, so that a long video costs a byte a sample, and everything else is converted while it is decoded.

use half::f16;

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
    /// As [`Budget::holds`].
    pub fn claim(&mut self, count: usize, size: usize) -> Result<(), ReadError> {
        self.left -= self.holds(count, size)?;
        Ok(())
    }

    /// Gives back bytes that were claimed and are not held any more.
    pub fn release(&mut self, bytes: usize) {
        self.left = (self.left + bytes).min(self.limit);
    }

    /// The bytes of `count` items of `size` bytes, which are not claimed.
    ///
    /// # Errors
    /// [`ReadError::TooLarge`] if that is more than is left (or overflows).
    pub fn holds(&self, count: usize, size: usize) -> Result<usize, ReadError> {
        count.checked_mul(size).filter(|&n| n <= self.left).ok_or_else(|| ReadError::TooLarge {
            needed: count.saturating_mul(size).saturating_add(self.limit - self.left),
            limit: self.limit,
        })
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
    F16,
    F32,
    F64,
}

impl SampleType {
    /// Bytes of one sample.
    pub fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 | Self::F16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }

    /// Whether the samples are whole numbers.
    pub fn is_integer(self) -> bool {
        !matches!(self, Self::F16 | Self::F32 | Self::F64)
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

/// A number as `f32`, rounded to the nearest one.
trait Narrowed {
    fn narrowed(self) -> f32;
}

macro_rules! narrowed {
    ($($t:ty)*) => {$(
        impl Narrowed for $t {
            fn narrowed(self) -> f32 {
                self as f32
            }
        }
    )*};
}

narrowed!(i8 i16 u16 i32 u32 i64 u64 f32 f64);

impl Narrowed for f16 {
    fn narrowed(self) -> f32 {
        self.to_f32()
    }
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

    /// Makes room for more.
    pub fn reserve_exact(&mut self, more: usize) {
        match self {
            Self::Bytes(v) => v.reserve_exact(more),
            Self::Floats(v) => v.reserve_exact(more),
        }
    }

    /// Planes of `size` samples in another order.
    ///
    /// # Panics
    /// If there is no such plane.
    #[must_use]
    pub fn in_order(&self, planes: &[usize], size: usize) -> Self {
        fn pick<T: Copy>(v: &[T], planes: &[usize], size: usize) -> Vec<T> {
            planes.iter().flat_map(|&p| &v[p * size..(p + 1) * size]).copied().collect()
        }
        match self {
            Self::Bytes(v) => Self::Bytes(pick(v, planes, size)),
            Self::Floats(v) => Self::Floats(pick(v, planes, size)),
        }
    }

    /// Appends samples that were stored as the same type.
    pub fn append(&mut self, more: Self) {
        match (self, more) {
            (Self::Bytes(all), Self::Bytes(more)) => all.extend(more),
            (Self::Floats(all), Self::Floats(more)) => all.extend(more),
            (all, more) => {
                let floats = |s: &Self| (0..s.len()).map(|i| s.at(i)).collect::<Vec<f32>>();
                *all = Self::Floats([floats(all), floats(&more)].concat());
            }
        }
    }

    /// The real parts of complex numbers, if all imaginary parts are zero; real and imaginary part take turns.
    pub fn real_parts(&self) -> Option<Self> {
        let Self::Floats(pairs) = self else { return None };
        let (pairs, _) = pairs.as_chunks();
        pairs.iter().all(|&[_, imaginary]| imaginary == 0.0).then(|| Self::Floats(pairs.iter().map(|p| p[0]).collect()))
    }

    /// Decodes raw bytes; a trailing partial sample is ignored.
    pub fn decode(raw: Vec<u8>, kind: SampleType, endian: Endian) -> Self {
        macro_rules! floats {
            ($t:ty) => {
                Self::Floats(
                    raw.chunks_exact(size_of::<$t>())
                        .map(|b| {
                            let b = b.try_into().expect("chunks_exact yields this length");
                            let value = match endian {
                                Endian::Little => <$t>::from_le_bytes(b),
                                Endian::Big => <$t>::from_be_bytes(b),
                            };
                            value.narrowed()
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
            SampleType::F16 => floats!(f16),
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
    white: Option<f32>,
}

impl Array {
    /// Joins a shape and its samples.
    ///
    /// # Errors
    /// [`ReadError::Malformed`] if the shape does not hold that many samples.
    pub fn new(shape: Vec<usize>, samples: Samples, stored: SampleType) -> Result<Self, ReadError> {
        match element_count(&shape) {
            Some(n) if n == samples.len() => Ok(Self { shape, samples, stored, white: None }),
            _ => Err(ReadError::Malformed {
                format: "array",
                reason: format!("shape {shape:?} does not hold {} samples", samples.len()),
            }),
        }
    }

    /// Parts of an array, one after the other along an axis.
    ///
    /// # Panics
    /// If there is no part, or they do not fit together.
    pub fn joined(mut parts: Vec<Self>, axis: usize) -> Self {
        if parts.len() == 1 {
            return parts.remove(0);
        }
        let first = &parts[0];
        let outer: usize = first.shape[..axis].iter().product();
        let inner: usize = first.shape[axis + 1..].iter().product();
        let mut shape = first.shape.clone();
        shape[axis] = parts.iter().map(|part| part.shape[axis]).sum();
        let row = |part: &Self, row: usize| {
            let length = part.shape[axis] * inner;
            part.samples.in_order(&[row], length)
        };
        let mut samples = match first.samples {
            Samples::Bytes(_) => Samples::Bytes(Vec::new()),
            Samples::Floats(_) => Samples::Floats(Vec::new()),
        };
        samples.reserve_exact(shape.iter().product());
        (0..outer).for_each(|k| parts.iter().for_each(|part| samples.append(row(part, k))));
        assert_eq!(samples.len(), shape.iter().product::<usize>(), "parts of one array");
        Self { shape, samples, stored: first.stored, white: first.white }
    }

    /// The arrays of a cell array, all of one size, one after the other along a new first axis.
    ///
    /// # Errors
    /// The first one of `arrays`; [`ReadError::NotNumeric`] if there is none or they differ.
    pub fn stacked(
        key: &str,
        arrays: impl ExactSizeIterator<Item = Result<Self, ReadError>>,
    ) -> Result<Self, ReadError> {
        let unequal = || ReadError::NotNumeric {
            key: key.to_owned(),
            what: "a cell array of arrays that are not all of one size",
        };
        let count = arrays.len();
        let mut all: Option<Self> = None;
        for array in arrays {
            let array = array?;
            match &mut all {
                None => all = Some(array),
                Some(all) if all.shape == array.shape && all.stored == array.stored => {
                    all.samples.append(array.samples)
                }
                Some(_) => return Err(unequal()),
            }
        }
        let all = all.ok_or_else(unequal)?;
        let shape = [&[count], all.shape.as_slice()].concat();
        Self::new(shape, all.samples, all.stored)
    }

    /// Says what white is stored as, where the file tells.
    #[must_use]
    pub fn with_white(self, white: f32) -> Self {
        Self { white: Some(white), ..self }
    }

    /// What white is stored as, if the file tells.
    pub fn white(&self) -> Option<f32> {
        self.white
    }

    /// The same samples in another shape.
    ///
    /// # Errors
    /// [`ReadError::Malformed`] if that shape does not hold as many.
    pub fn reshaped(self, shape: Vec<usize>) -> Result<Self, ReadError> {
        Ok(Self { white: self.white, ..Self::new(shape, self.samples, self.stored)? })
    }

    /// Row-major shape.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The samples, row-major.
    pub fn samples(&self) -> &Samples {
        &self.samples
    }

    /// The samples alone.
    pub fn into_samples(self) -> Samples {
        self.samples
    }

    /// The number type in the file.
    pub fn stored(&self) -> SampleType {
        self.stored
    }
}

/// Product of a shape, or `None` where that of its lengths, those of 0 left out, is more than an array can have.
pub fn element_count(shape: &[usize]) -> Option<usize> {
    let product = shape.iter().filter(|&&d| d != 0).try_fold(1usize, |n, &d| n.checked_mul(d));
    let product = product.filter(|&n| isize::try_from(n).is_ok())?;
    Some(if shape.contains(&0) { 0 } else { product })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_of_an_empty_array_are_counted_too() {
        assert_eq!(element_count(&[2, 3]), Some(6));
        assert_eq!(element_count(&[]), Some(1));
        assert_eq!(element_count(&[2, 0, 3]), Some(0));
        assert_eq!(element_count(&[0, 1 << 40, 1 << 40]), None);
    }

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
    fn halves_and_complex_numbers_without_imaginary_part_become_reals() {
        let halves = [f16::from_f32(0.5), f16::from_f32(-2.0)].iter().flat_map(|h| h.to_le_bytes()).collect();
        let halves = Samples::decode(halves, SampleType::F16, Endian::Little);
        assert_eq!(halves, Samples::Floats(vec![0.5, -2.0]));
        assert_eq!(halves.real_parts(), None);
        assert_eq!(Samples::Floats(vec![3.0, 0.0, 4.0, 0.0]).real_parts(), Some(Samples::Floats(vec![3.0, 4.0])));
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
