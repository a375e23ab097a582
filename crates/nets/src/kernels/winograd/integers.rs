//! The same with [16-bit integers](super::super::integers). With m, the largest pixel that a block of tiles reads, no frequency of it is beyond
//! `m · Bᵢ · Bⱼ`, where B are the sums of the rows of |Bᵀ|: this becomes the largest integer.

use super::super::blocked::{Pixel, ZERO};
use super::super::geometry::{Panel, Strip, Weights};
use super::super::integers::{self, entry_in_integers, filter_scale, pixel_scale, sum_scale, with_half};
use super::super::isa::Isa;
use super::super::scratch::Slot;
use super::super::simd::{LANES, Pairs};
use super::super::tile::{Out, Run};
use super::{
    FREQUENCIES, Frequencies, MAX_TILES, P, Q, SIDE, TILE, Tiles, filters_of, frequency_step, input_block,
    output_block, transform_filters, transformed_runs,
};
use rayon::prelude::*;

/// The largest transformed pixel.
const MOST: f64 = 32_767.0;

/// Largest |Bᵀ d B| of pixels of at most 1, frequency by frequency.
const REACH: [f64; FREQUENCIES] = {
    let (p2, q2) = (P * P, Q * Q);
    let (end, at_p, at_q) = (1.0 + p2 + q2 + p2 * q2, (1.0 + q2) * (1.0 + P), (1.0 + p2) * (1.0 + Q));
    let rows = [end, at_p, at_p, at_q, at_q, end];
    let mut reach = [0.0; FREQUENCIES];
    let mut f = 0;
    while f < FREQUENCIES {
        reach[f] = rows[f / SIDE] * rows[f % SIDE];
        f += 1;
    }
    reach
};

/// A convolution's filters, transformed and rounded.
#[derive(Debug)]
pub(in super::super) struct Integers {
    inputs: usize,
    panels: Vec<Panel>,
    /// For each panel `[36][Cin/2][vecs]` of pairs of i16 numbers: those of two inputs for each of 16 outputs.
    filters: Vec<Pixel>,
    /// What a sum is to be multiplied by, and by m, for each panel `[36][vecs]`.
    scales: Vec<Pixel>,
    /// Channel blocks of a tile block's transform.
    runs: Vec<Run>,
}

impl Integers {
    /// Whether there is such a way for that many inputs: whole pairs.
    pub(in super::super) fn suits(isa: Isa, inputs: usize) -> bool {
        isa.multiplies_integers() && inputs.is_multiple_of(2)
    }

    fn blocks(&self) -> usize {
        self.inputs.div_ceil(LANES)
    }

    pub(in super::super) fn new(weights: &Weights<'_>, vecs: usize) -> Self {
        let panels = Panel::cut(weights.outputs, vecs);
        let packed: Vec<_> = panels.par_iter().map(|&panel| pack(weights, panel)).collect();
        let (filters, scales): (Vec<_>, Vec<_>) = packed.into_iter().unzip();
        Self {
            inputs: weights.inputs,
            panels,
            filters: filters.concat(),
            scales: scales.concat(),
            runs: transformed_runs(weights.inputs),
        }
    }

    /// Room for the two transforms.
    fn reserve(&self, slot: &mut Slot) {
        slot.a.grow(FREQUENCIES * frequency_step(self.blocks()) / 2);
        slot.b.grow(FREQUENCIES * frequency_step(2));
    }
}

/// The filters of a panel, transformed and rounded, and what sums of them are to be multiplied by.
fn pack(weights: &Weights<'_>, panel: Panel) -> (Vec<Pixel>, Vec<Pixel>) {
    let cin = weights.inputs;
    let mut filters = vec![ZERO; FREQUENCIES * (cin / 2) * panel.vecs];
    let mut scales = vec![ZERO; FREQUENCIES * panel.vecs];
    let mut u = vec![ZERO; FREQUENCIES * cin];
    for v in 0..panel.vecs {
        for c in 0..cin {
            let filter = filters_of(weights, (panel.block + v) * LANES, c);
            transform_filters(&filter, &mut u[c..].iter_mut().step_by(cin));
        }
        for (f, u) in u.chunks_exact(cin).enumerate() {
            for k in 0..LANES {
                let filter = || u.iter().map(|u| f64::from(u.0[k]));
                let scale = filter_scale(filter(), cin, MOST);
                scales[f * panel.vecs + v].0[k] = sum_scale(scale / REACH[f], MOST);
                for (c, u) in filter().enumerate() {
                    let pair = &mut filters[(f * (cin / 2) + c / 2) * panel.vecs + v].0[k];
                    *pair = with_half(*pair, c % 2, (u * scale).round() as i16);
                }
            }
        }
    }
    (filters, scales)
}

/// Rounded to i16 numbers, frequency `f` at `ptr + f·step`, times 16 equal factors.
#[derive(Clone, Copy)]
struct Rounded {
    ptr: *mut i16,
    step: usize,
    factors: *const Pixel,
}

impl<S: Pairs> Frequencies<S> for Rounded {
    #[inline(always)]
    unsafe fn tile(self, i: usize) -> Self {
        // SAFETY: the caller gives the memory.
        Self { ptr: unsafe { self.ptr.add(i * LANES) }, ..self }
    }

    #[inline(always)]
    unsafe fn put(self, f: usize, v: S) {
        // SAFETY: as above; there is a factor for each frequency.
        unsafe { v.mul(S::load(self.factors.add(f).cast())).store_rounded(self.ptr.add(f * self.step)) }
    }
}

/// Sums times what vector `v` of these has for them.
#[derive(Clone, Copy)]
struct Scaled(*const Pixel);

impl<S: Pairs> integers::Finish<S> for Scaled {
    #[inline(always)]
    unsafe fn finish(self, v: usize, sums: S) -> S {
        // SAFETY: there is one for each vector of the panel.
        unsafe { sums.mul(S::load(self.0.add(v).cast())) }
    }
}

entry_in_integers!(
    /// Convolves a strip. A block of tiles with a pixel that is not finite becomes NaN.
    pub(in super::super) fn forward = forward_strip(
        conv: &Integers, bias: &[Pixel], floor: f32, strip: Strip, slot: &mut Slot,
    )
);

#[inline(always)]
unsafe fn forward_strip<S: Pairs>(conv: &Integers, bias: &[Pixel], floor: f32, strip: Strip, slot: &mut Slot) {
    conv.reserve(slot);
    let (v_step, m_step) = (frequency_step(conv.blocks()), frequency_step(2));
    let (v, m) = (slot.a.as_mut_ptr().cast::<i16>(), slot.b.as_mut_ptr());
    let mut factors = [ZERO; FREQUENCIES];
    let mut i = 0;
    while let Some(tiles) = Tiles::block(strip.rows, strip.width, i) {
        // SAFETY: `reserve` made room for a block of tiles; the strip's memory is the caller's promise.
        unsafe {
            let most = largest::<S>(strip, conv.inputs, tiles);
            set_factors::<S>(most, &mut factors);
            input_block::<S>(
                strip.src,
                conv.blocks(),
                tiles,
                Rounded { ptr: v, step: v_step, factors: factors.as_ptr() },
            );
            let (mut u, mut scales) = (conv.filters.as_ptr(), conv.scales.as_ptr());
            let mut p = 0;
            while p < conv.panels.len() {
                let panel = *conv.panels.get_unchecked(p);
                let mut f = 0;
                while f < FREQUENCIES {
                    integers::product::<S, LANES>(
                        panel.vecs,
                        tiles.count,
                        v.add(f * v_step),
                        &conv.runs,
                        u.cast(),
                        Scaled(scales),
                        Out { ptr: m.add(f * m_step), step: LANES, vec_step: MAX_TILES * LANES },
                    );
                    u = u.add(conv.inputs / 2 * panel.vecs);
                    scales = scales.add(panel.vecs);
                    f += 1;
                }
                output_block::<S>(m, m_step, panel, bias, [most, floor], tiles, strip);
                p += 1;
            }
        }
        i += 1;
    }
}

/// The largest |pixel| that a block of tiles reads; NaN if one is not finite.
#[inline(always)]
unsafe fn largest<S: Pairs>(strip: Strip, channels: usize, tiles: Tiles) -> f32 {
    let (first, last) = (tiles.first / tiles.across, (tiles.first + tiles.count - 1) / tiles.across);
    let columns = if first == last {
        tiles.first % tiles.across..tiles.first % tiles.across + tiles.count
    } else {
        0..tiles.across
    };
    let columns = columns.start * TILE..columns.end * TILE + SIDE - TILE;
    // SAFETY: these are the pixels that the tiles read, and others of their rows.
    unsafe { integers::largest::<S>(strip.src, channels, first * TILE..last * TILE + SIDE, columns) }
}

/// The factors of frequencies with which none of them is beyond [`MOST`]; 0 where there is nothing.
#[inline(always)]
unsafe fn set_factors<S: Pairs>(most: f32, factors: &mut [Pixel; FREQUENCIES]) {
    let scale = pixel_scale(most, MOST);
    let mut f = 0;
    while f < FREQUENCIES {
        // SAFETY: a factor is 16 floats; the instruction set is the caller's promise.
        unsafe { S::splat((scale / REACH[f]) as f32).store(factors[f].0.as_mut_ptr()) }
        f += 1;
    }
}
