//! Pixel shuffle onto an image of twice the size, and its way back: phase `2i + j` of a quarter-size image of four times the
//! channels belongs to the pixels `(2y + i, 2x + j)`.
//!
//! A shuffle takes channel `4c + phase`. Here the outputs of the convolution before it are in the order `[phase][C]` instead,
//! each phase filled up to whole blocks, so that blocks move as they are.

use super::blocked::{Blocked, Form};
use super::simd::LANES;

/// Channels that a phase is filled up to whole multiples of.
pub(crate) fn block(form: Form) -> usize {
    if form == Form::Single { LANES } else { 2 * LANES }
}

/// Filters of `filter` numbers in the order of a shuffle's outputs, put in the order `[phase][C]`, each phase filled up with zeros to
/// whole blocks of `block` channels.
pub(crate) fn by_phase(filters: &[f32], filter: usize, block: usize) -> Vec<f32> {
    let channels = filters.len() / filter / 4;
    let padded = channels.next_multiple_of(block);
    let mut ordered = vec![0.0; 4 * padded * filter];
    for (i, values) in filters.chunks_exact(filter).enumerate() {
        let at = (i % 4 * padded + i / 4) * filter;
        ordered[at..at + filter].copy_from_slice(values);
    }
    ordered
}

/// The way back from [`by_phase`].
pub(super) fn by_channel(ordered: &[f32], filter: usize, filters: &mut [f32]) {
    let padded = ordered.len() / filter / 4;
    for (i, values) in filters.chunks_exact_mut(filter).enumerate() {
        let at = (i % 4 * padded + i / 4) * filter;
        values.copy_from_slice(&ordered[at..at + filter]);
    }
}

/// `image += pixel_shuffle(quarters)`, in f32.
///
/// # Panics
/// When either is in a form of the matrix unit, or their shapes do not fit.
pub(crate) fn add_shuffled(quarters: &Blocked, image: &mut Blocked) {
    let (_, height, width) = quarters.shape();
    assert_eq!((2 * height, 2 * width), (image.shape().1, image.shape().2));
    let blocks = image.blocks();
    for block in 0..blocks {
        for y in 0..height {
            for i in 0..2 {
                let row = image.row_mut(block, 2 * y + i);
                let left = quarters.row(2 * i * blocks + block, y);
                let right = quarters.row((2 * i + 1) * blocks + block, y);
                let pixels = left.as_chunks::<LANES>().0.iter().zip(right.as_chunks::<LANES>().0);
                for (out, (left, right)) in row.as_chunks_mut::<{ 2 * LANES }>().0.iter_mut().zip(pixels) {
                    for k in 0..LANES {
                        out[k] += left[k];
                        out[LANES + k] += right[k];
                    }
                }
            }
        }
    }
}

/// `quarters = pixel_unshuffle(image)`, in any form that both have: the gradient by what was shuffled.
///
/// # Panics
/// When their shapes do not fit.
pub(super) fn unshuffle(image: &Blocked, quarters: &mut Blocked) {
    let (_, height, width) = quarters.shape();
    assert_eq!((image.form(), image.shape().1, image.shape().2), (quarters.form(), 2 * height, 2 * width));
    let blocks = image.blocks();
    for (phase, block) in (0..4).flat_map(|phase| (0..blocks).map(move |block| (phase, block))) {
        for y in 0..height {
            let from = image.pixel_row(block, 2 * y + phase / 2).iter().skip(phase % 2).step_by(2);
            quarters.pixel_row_mut(phase * blocks + block, y).iter_mut().zip(from).for_each(|(to, from)| *to = *from);
        }
    }
}
