//! The same with [16-bit integers](super::super::integers), each strip by its largest pixel.

use super::super::blocked::{Pixel, ZERO};
use super::super::geometry::{Step, Strip, Weights};
use super::super::integers::{self, entry_in_integers, filter_scale, pixel_scale, sum_scale, with_half};
use super::super::isa::Isa;
use super::super::scratch::Slot;
use super::super::simd::{LANES, Pairs};
use super::super::tile::Out;
use super::{Direct, Part};

/// The largest pixel: an output's filters may then have a sum of 262,144, some hundred steps for each of many hundreds.
const MOST: f64 = 8_191.0;

/// A convolution's filters, rounded.
#[derive(Debug)]
pub(in super::super) struct Integers {
    inputs: usize,
    step: Step,
    parts: Vec<Part>,
    /// In the order of [`Direct`]'s, of pairs of i16 numbers: those of two inputs for each of 16 outputs.
    filters: Vec<Pixel>,
    /// What a sum is to be multiplied by, and by the largest pixel, for each block of outputs.
    scales: Vec<Pixel>,
}

impl Integers {
    /// Whether there is such a way: each group has whole pairs of inputs.
    pub(in super::super) fn suits(isa: Isa, weights: &Weights<'_>, step: Step) -> bool {
        isa.multiplies_integers() && step != Step::Double && (weights.inputs / weights.groups).is_multiple_of(2)
    }

    pub(in super::super) fn new(weights: &Weights<'_>, step: Step, vecs: usize) -> Self {
        let Direct { mut parts, filters: singles, step } = Direct::new(weights, step, vecs);
        let mut filters = vec![ZERO; singles.len() / 2];
        let mut scales = vec![ZERO; weights.outputs.div_ceil(LANES)];
        for part in &mut parts {
            let (panel, count) = (part.panel, part.taps.iter().map(|tap| tap.run.len).sum());
            let singles = &singles[part.first..][..count * panel.vecs];
            part.first /= 2;
            for v in 0..panel.vecs {
                for k in 0..LANES {
                    let filter = || singles[v..].iter().step_by(panel.vecs).map(|w| f64::from(w.0[k]));
                    let scale = filter_scale(filter(), count, MOST);
                    scales[panel.block + v].0[k] = sum_scale(scale, MOST);
                    for (i, w) in filter().enumerate() {
                        let pair = &mut filters[part.first + i / 2 * panel.vecs + v].0[k];
                        *pair = with_half(*pair, i % 2, (w * scale).round() as i16);
                    }
                }
            }
        }
        Self { inputs: weights.inputs, step, parts, filters, scales }
    }
}

/// Sums times scales and the largest pixel, with bias and floor; scales and biases are those of the panel.
#[derive(Clone, Copy)]
struct Finish<S> {
    scales: *const Pixel,
    bias: *const Pixel,
    most: S,
    floor: S,
}

impl<S: Pairs> integers::Finish<S> for Finish<S> {
    #[inline(always)]
    unsafe fn finish(self, v: usize, sums: S) -> S {
        // SAFETY: there are as many scales and biases as vectors.
        unsafe {
            let scale = S::load(self.scales.add(v).cast()).mul(self.most);
            sums.fma(scale, S::load(self.bias.add(v).cast())).at_least(self.floor)
        }
    }
}

entry_in_integers!(
    /// Convolves a strip. With a pixel that is not finite all of it becomes NaN.
    pub(in super::super) fn forward = forward_strip(
        conv: &Integers, bias: &[Pixel], floor: f32, strip: Strip, slot: &mut Slot,
    )
);

#[inline(always)]
unsafe fn forward_strip<S: Pairs>(conv: &Integers, bias: &[Pixel], floor: f32, strip: Strip, slot: &mut Slot) {
    // SAFETY: the caller's contract.
    unsafe {
        if conv.step == Step::Half {
            forward_by::<S, { 2 * LANES }>(conv, bias, floor, strip, slot);
        } else {
            forward_by::<S, LANES>(conv, bias, floor, strip, slot);
        }
    }
}

#[inline(always)]
unsafe fn forward_by<S: Pairs, const STEP: usize>(
    conv: &Integers,
    bias: &[Pixel],
    floor: f32,
    strip: Strip,
    slot: &mut Slot,
) {
    let (rows, row) = (conv.step.first_row(strip.rows - 1) + 3, strip.src.row);
    let block = rows * row;
    slot.a.grow(conv.inputs.div_ceil(LANES) * block / 2);
    let rounded = slot.a.as_mut_ptr().cast::<i16>();
    // SAFETY: the strip has these rows, and the slot room for them.
    let most = unsafe { round::<S>(conv.inputs, rows, strip, rounded) };
    let mut i = 0;
    while i < conv.parts.len() {
        let Part { panel, ref taps, first, .. } = conv.parts[i];
        slot.runs.clear();
        slot.runs.extend(taps.iter().map(|tap| tap.at(block, row)));
        let mut y = 0;
        while y < strip.rows {
            // SAFETY: output rows below `rows` read input rows that were rounded; `bias`, the filters and their scales have what the panel
            // takes.
            unsafe {
                integers::product::<S, STEP>(
                    panel.vecs,
                    strip.width,
                    rounded.add(y * (STEP / LANES) * row),
                    &slot.runs,
                    conv.filters.as_ptr().add(first).cast(),
                    Finish {
                        scales: conv.scales.as_ptr().add(panel.block),
                        bias: bias.as_ptr().add(panel.block),
                        most: S::splat(most),
                        floor: S::splat(floor),
                    },
                    Out {
                        ptr: strip.dst.ptr.add(panel.block * strip.dst.block + y * strip.dst.row),
                        step: LANES,
                        vec_step: strip.dst.block,
                    },
                );
            }
            y += 1;
        }
        i += 1;
    }
}

/// Rounds the rows of a strip to `to`, block after block; their largest pixel.
#[inline(always)]
unsafe fn round<S: Pairs>(channels: usize, rows: usize, strip: Strip, to: *mut i16) -> f32 {
    let (src, row) = (strip.src, strip.src.row);
    // SAFETY: the caller's contract.
    unsafe {
        let most = integers::largest::<S>(src, channels, 0..rows, 0..row / LANES);
        let scale = S::splat(pixel_scale(most, MOST) as f32);
        let mut b = 0;
        while b * LANES < channels {
            let mut at = 0;
            while at < rows * row {
                S::load(src.ptr.add(b * src.block + at)).mul(scale).store_rounded(to.add(b * rows * row + at));
                at += LANES;
            }
            b += 1;
        }
        most
    }
}
