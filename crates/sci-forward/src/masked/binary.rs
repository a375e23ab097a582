//! Binary masks, a bit a pixel.

use super::MaskSource;
use crate::{MaskError, MaskStack, VideoShape};
use multiversion::multiversion;

/// Bits of a word.
const WORD: usize = u64::BITS as usize;

/// Masks that are 0 or one other value, stored as a bit a pixel: a 32nd of a [`MaskStack`].
///
/// ```
/// use ndarray::array;
/// use sci_forward::{BinaryMasks, MaskOperator, MaskStack, SensingOperator};
///
/// let masks = MaskStack::new(array![[[0.0, 0.8]], [[0.8, 0.8]]])?;
/// let (packed, stored) = (MaskOperator::new(BinaryMasks::new(&masks)?), MaskOperator::new(masks));
/// let x = array![[[0.1, 0.2]], [[0.3, 0.4]]];
/// assert_eq!(packed.forward(x.view()), stored.forward(x.view()));
/// assert!(BinaryMasks::new(&MaskStack::new(array![[[0.5, 0.8]]])?).is_err());
/// # Ok::<(), sci_forward::MaskError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct BinaryMasks {
    shape: VideoShape,
    /// Row after row of frame after frame, each from a word of its own on, the first column in the lowest bit.
    words: Vec<u64>,
    /// The value of an open pixel.
    open: f32,
}

impl BinaryMasks {
    /// Packs masks whose values are all 0 or all the same.
    ///
    /// # Errors
    /// [`MaskError::NotBinary`] with the first value that is neither 0 nor the first open one.
    pub fn new(masks: &MaskStack) -> Result<Self, MaskError> {
        let shape = masks.shape();
        let open = masks.view().iter().copied().find(|&v| v != 0.0).ok_or(MaskError::AllClosed)?;
        if let Some(&value) = masks.view().iter().find(|&&v| v != 0.0 && v != open) {
            return Err(MaskError::NotBinary { value, open });
        }
        let view = masks.view();
        let rows = view.rows().into_iter().map(|row| row.to_vec());
        let pack = |bits: &[f32]| bits.iter().rev().fold(0, |word, &v| word << 1 | u64::from(v != 0.0));
        let words = rows.flat_map(|row| row.chunks(WORD).map(pack).collect::<Vec<_>>()).collect();
        Ok(Self { shape, words, open })
    }
}

impl MaskSource for BinaryMasks {
    fn shape(&self) -> VideoShape {
        self.shape
    }

    fn fill(&self, frame: usize, row: usize, start: usize, out: &mut [f32]) {
        let VideoShape { frames, height, width } = self.shape;
        assert!(frame < frames && row < height && start + out.len() <= width, "outside the masks of {}", self.shape);
        let words = width.div_ceil(WORD);
        let row = &self.words[(frame * height + row) * words..][..words];
        expand(row, start, self.open, out);
    }
}

/// Writes `open` for each set bit from bit `start` on, and 0 for the others.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn expand(words: &[u64], start: usize, open: f32, out: &mut [f32]) {
    const LANES: usize = 32;
    let bits_at = |bit: usize| {
        let (word, shift) = (bit / WORD, bit % WORD);
        let next = words.get(word + 1).copied().unwrap_or(0);
        // The upper part comes from the next word; two shifts, as one by all 64 bits is not defined.
        ((words[word] >> shift) | (next << 1 << (WORD - 1 - shift))) as u32
    };
    let mut bit = start;
    let (chunks, rest) = out.as_chunks_mut::<LANES>();
    for chunk in chunks {
        let bits = bits_at(bit);
        for (lane, out) in chunk.iter_mut().enumerate() {
            *out = if bits >> lane & 1 == 1 { open } else { 0.0 };
        }
        bit += LANES;
    }
    if !rest.is_empty() {
        let bits = bits_at(bit);
        for (lane, out) in rest.iter_mut().enumerate() {
            *out = if bits >> lane & 1 == 1 { open } else { 0.0 };
        }
    }
}
