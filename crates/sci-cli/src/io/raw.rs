//! Owns frames as cameras dump them: no header, packed pixels, one frame after the other.
//!
//! Source: GenICam Pixel Format Naming Convention 2.4, sections 6 and 7 ("p": lsb packed; "Packed": GigE Vision).

use super::ReadError;
use super::samples::{Array, Budget, Endian, SampleType, Samples};

/// How pixels are packed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Packing {
    Mono8,
    Mono10p,
    /// Two bytes a pixel, of which ten or twelve bits count.
    Mono10,
    Mono12,
    Mono12p,
    /// Two pixels in three bytes too, but with both low halves in the middle one.
    Mono12Packed,
    Mono16,
}

impl Packing {
    /// All of them, by their names.
    pub const ALL: [(&str, Self); 7] = [
        ("mono8", Self::Mono8),
        ("mono10", Self::Mono10),
        ("mono10p", Self::Mono10p),
        ("mono12", Self::Mono12),
        ("mono12p", Self::Mono12p),
        ("mono12packed", Self::Mono12Packed),
        ("mono16", Self::Mono16),
    ];

    /// Its name.
    pub fn name(self) -> &'static str {
        Self::ALL.iter().find(|(_, p)| *p == self).map_or("", |(name, _)| name)
    }

    /// Bits of a pixel in the file, and those that count.
    fn bits(self) -> (usize, u32) {
        match self {
            Self::Mono8 => (8, 8),
            Self::Mono10p => (10, 10),
            Self::Mono10 => (16, 10),
            Self::Mono12 => (16, 12),
            Self::Mono12p | Self::Mono12Packed => (12, 12),
            Self::Mono16 => (16, 16),
        }
    }
}

/// What a file without a header does not say.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Raw {
    /// How pixels are packed.
    pub packing: Packing,
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
}

/// Reads frames `[T, H, W]`, as many as there are.
///
/// # Errors
/// [`ReadError`] if the bytes are no whole number of frames, none, or more than the budget.
pub fn read(bytes: &[u8], raw: Raw) -> Result<Array, ReadError> {
    let Raw { packing, height, width } = raw;
    let (stored, counted) = packing.bits();
    let pixels = height.saturating_mul(width);
    let frame = pixels.saturating_mul(stored).div_ceil(8);
    let frames = bytes.len().checked_div(frame).unwrap_or(0);
    if frames == 0 || !bytes.len().is_multiple_of(frame) {
        return Err(ReadError::Malformed {
            format: "raw",
            reason: format!(
                "{} bytes are no whole number of {} frames of {height}×{width} pixels (rows × columns), {frame} bytes each; is data.raw right?",
                bytes.len(),
                packing.name()
            ),
        });
    }
    let kind = if stored == 8 { SampleType::U8 } else { SampleType::U16 };
    Budget::for_file(bytes.len()).claim(frames * pixels, kind.decoded_size())?;
    let samples = match packing {
        Packing::Mono8 => Samples::Bytes(bytes.to_vec()),
        Packing::Mono10 | Packing::Mono12 | Packing::Mono16 => {
            Samples::decode(bytes.to_vec(), SampleType::U16, Endian::Little)
        }
        Packing::Mono10p | Packing::Mono12p | Packing::Mono12Packed => {
            let unpack = |frame: &[u8]| -> Vec<f32> { (0..pixels).map(|i| packing.pixel(frame, i).into()).collect() };
            let mut all = Vec::with_capacity(frames * pixels);
            bytes.chunks_exact(frame).for_each(|frame| all.extend(unpack(frame)));
            Samples::Floats(all)
        }
    };
    let array = Array::new(vec![frames, height, width], samples, kind)?;
    Ok(if counted == 16 { array } else { array.with_white(((1u32 << counted) - 1) as f32) })
}

impl Packing {
    /// Pixel `i` of a frame of a packed format.
    fn pixel(self, frame: &[u8], i: usize) -> u16 {
        let byte = |at: usize| u16::from(frame.get(at).copied().unwrap_or(0));
        if self == Self::Mono12Packed {
            let (at, odd) = (i / 2 * 3, i % 2);
            return (byte(at + 2 * odd) << 4) | ((byte(at + 1) >> (4 * odd)) & 15);
        }
        // One stream of bits, the lowest first.
        let bits = self.bits().0;
        let (at, shift) = (i * bits / 8, i * bits % 8);
        ((byte(at) | (byte(at + 1) << 8)) >> shift) & ((1 << bits) - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn values(bytes: &[u8], packing: Packing) -> Vec<f32> {
        let found = read(bytes, Raw { packing, height: 1, width: 2 }).unwrap();
        (0..found.samples().len()).map(|i| found.samples().at(i)).collect()
    }

    #[test]
    fn the_two_packings_of_twelve_bits_differ() {
        // 0xabc and 0x123.
        assert_eq!(values(&[0xbc, 0x3a, 0x12], Packing::Mono12p), [0xabc as f32, 0x123 as f32]);
        assert_eq!(values(&[0xab, 0x3c, 0x12], Packing::Mono12Packed), [0xabc as f32, 0x123 as f32]);
        let found = read(&[0xbc, 0x3a, 0x12], Raw { packing: Packing::Mono12p, height: 1, width: 2 }).unwrap();
        assert_eq!(found.white(), Some(4095.0));
    }

    #[test]
    fn ten_bits_are_one_stream() {
        // 1, 2, 3 and 1023 in five bytes.
        let bits = 1u64 | 2 << 10 | 3 << 20 | 1023 << 30;
        let found = read(&bits.to_le_bytes()[..5], Raw { packing: Packing::Mono10p, height: 2, width: 2 }).unwrap();
        assert_eq!((found.shape(), found.samples()), (&[1, 2, 2][..], &Samples::Floats(vec![1.0, 2.0, 3.0, 1023.0])));
    }

    #[test]
    fn plain_pixels_and_several_frames() {
        assert_eq!(values(&[1, 2, 3, 4], Packing::Mono8), [1.0, 2.0, 3.0, 4.0]);
        assert_eq!(values(&[1, 2, 3, 4], Packing::Mono16), [513.0, 1027.0]);
    }

    #[test]
    fn a_size_that_does_not_fit_is_named() {
        let raw = |height, width| Raw { packing: Packing::Mono12p, height, width };
        let error = read(&[0; 10], raw(1, 4)).unwrap_err().to_string();
        assert!(error.contains("10 bytes") && error.contains("1×4") && error.contains("mono12p"), "{error}");
        assert!(read(&[0; 10], raw(usize::MAX, usize::MAX)).is_err());
        assert!(read(&[], raw(1, 4)).is_err());
        assert!(read(&[0; 10], raw(0, 0)).is_err());
    }
}
