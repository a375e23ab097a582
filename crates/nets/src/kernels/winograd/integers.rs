//! The same with 16-bit integers, for inference: a product sums two channels at once, in twice as many lanes as f32 has.
//!
//! Nothing can overflow. With m, the largest pixel that a block of tiles reads, no frequency of it is beyond `m · Bᵢ · Bⱼ`, where B are the
//! sums of the rows of |Bᵀ|, so that this is 32,767; and the filters of an output at a frequency are scaled so that their sum over the
//! inputs is at most 65,535 less what rounding adds. Sums are exact; the errors are those of rounding either factor, and other
//! instruction sets give the same sums.

use super::super::blocked::{Pixel, ZERO};
use super::super::geometry::{Panel, Strip, Weights};
use super::super::isa::Isa;
use super::super::scratch::Slot;
use super::super::simd::{Avx2, Avx512, LANES, Pairs};
use super::super::tile::{Out, in_tiles};
use super::{
    FREQUENCIES, Frequencies, MAX_TILES, P, Q, SIDE, TILE, Tiles, filters_of, frequency_step, input_block,
    output_block, transform_filters,
};
use rayon::prelude::*;

/// The largest transformed pixel.
const MOST: f64 = 32_767.0;
/// The largest sum of an output's filters at a frequency, in absolute value: `32,768 · 65,535 < 2³¹`.
const MOST_SUM: f64 = 65_535.0;

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
    blocks: usize,
    panels: Vec<Panel>,
    /// For each panel `[36][Cin/2][vecs]` of pairs of i16 numbers: those of two inputs for each of 16 outputs.
    filters: Vec<Pixel>,
    /// What a sum is to be multiplied by, and by m, for each panel `[36][vecs]`.
    scales: Vec<Pixel>,
}

impl Integers {
    /// Whether there is such a way for that many inputs: whole blocks.
    pub(in super::super) fn suits(isa: Isa, inputs: usize) -> bool {
        isa.multiplies_integers() && inputs.is_multiple_of(LANES)
    }

    pub(in super::super) fn new(weights: &Weights<'_>, vecs: usize) -> Self {
        let panels = Panel::cut(weights.outputs, vecs);
        let packed: Vec<_> = panels.par_iter().map(|&panel| pack(weights, panel)).collect();
        let (filters, scales): (Vec<_>, Vec<_>) = packed.into_iter().unzip();
        Self { blocks: weights.inputs / LANES, panels, filters: filters.concat(), scales: scales.concat() }
    }

    /// Room for the two transforms.
    fn reserve(&self, slot: &mut Slot) {
        slot.a.grow(FREQUENCIES * frequency_step(self.blocks) / 2);
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
                let (sum, most) = filter().fold((0.0, 0f64), |(sum, most), u| (sum + u.abs(), most.max(u.abs())));
                let scale = if most > 0.0 { (MOST / most).min((MOST_SUM - cin as f64) / sum) } else { 0.0 };
                scales[f * panel.vecs + v].0[k] = if scale > 0.0 { (REACH[f] / (MOST * scale)) as f32 } else { 0.0 };
                for (c, u) in filter().enumerate() {
                    let pair = &mut filters[(f * (cin / 2) + c / 2) * panel.vecs + v].0[k];
                    *pair = with_half(*pair, c % 2, (u * scale).round() as i16);
                }
            }
        }
    }
    (filters, scales)
}

/// The pair with another number in that place.
fn with_half(pair: f32, place: usize, number: i16) -> f32 {
    let (shift, bits) = (16 * place as u32, u32::from(number as u16));
    f32::from_bits(pair.to_bits() & !(0xffff << shift) | bits << shift)
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

/// Convolves a strip. A block of tiles with a pixel that is not finite becomes NaN.
///
/// # Safety
/// That of [`super::forward`], and `isa.multiplies_integers()`.
pub(in super::super) unsafe fn forward(
    isa: Isa,
    conv: &Integers,
    bias: &[Pixel],
    floor: f32,
    strip: Strip,
    slot: &mut Slot,
) {
    #[target_feature(enable = "avx512f,avx512vnni")]
    unsafe fn avx512(conv: &Integers, bias: &[Pixel], floor: f32, strip: Strip, slot: &mut Slot) {
        // SAFETY: the features of this function, and the caller's contract.
        unsafe { forward_strip::<Avx512>(conv, bias, floor, strip, slot) }
    }
    #[target_feature(enable = "avx2,fma")]
    unsafe fn avx2(conv: &Integers, bias: &[Pixel], floor: f32, strip: Strip, slot: &mut Slot) {
        // SAFETY: as above.
        unsafe { forward_strip::<Avx2>(conv, bias, floor, strip, slot) }
    }
    // SAFETY: what the instruction set needs is there, which is the caller's promise.
    unsafe {
        match isa {
            Isa::Avx512 => avx512(conv, bias, floor, strip, slot),
            _ => avx2(conv, bias, floor, strip, slot),
        }
    }
}

#[inline(always)]
unsafe fn forward_strip<S: Pairs>(conv: &Integers, bias: &[Pixel], floor: f32, strip: Strip, slot: &mut Slot) {
    conv.reserve(slot);
    let (v_step, m_step) = (frequency_step(conv.blocks), frequency_step(2));
    let (v, m) = (slot.a.as_mut_ptr().cast::<i16>(), slot.b.as_mut_ptr());
    let mut factors = [ZERO; FREQUENCIES];
    let mut i = 0;
    while let Some(tiles) = Tiles::block(strip.rows, strip.width, i) {
        // SAFETY: `reserve` made room for a block of tiles; the strip's memory is the caller's promise.
        unsafe {
            let most = largest::<S>(strip, conv.blocks, tiles);
            set_factors::<S>(most, &mut factors);
            input_block::<S>(
                strip.src,
                conv.blocks,
                tiles,
                Rounded { ptr: v, step: v_step, factors: factors.as_ptr() },
            );
            let (mut u, mut scales) = (conv.filters.as_ptr(), conv.scales.as_ptr());
            let mut p = 0;
            while p < conv.panels.len() {
                let panel = *conv.panels.get_unchecked(p);
                let mut f = 0;
                while f < FREQUENCIES {
                    let out = Out { ptr: m.add(f * m_step), step: LANES, vec_step: MAX_TILES * LANES };
                    product::<S>(panel.vecs, tiles.count, v.add(f * v_step), conv.blocks, u.cast(), scales.cast(), out);
                    u = u.add(conv.blocks * LANES / 2 * panel.vecs);
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
unsafe fn largest<S: Pairs>(strip: Strip, blocks: usize, tiles: Tiles) -> f32 {
    let (first, last) = (tiles.first / tiles.across, (tiles.first + tiles.count - 1) / tiles.across);
    let one_row = first == last;
    let columns =
        if one_row { tiles.first % tiles.across..tiles.first % tiles.across + tiles.count } else { 0..tiles.across };
    let (left, right) = (columns.start * TILE, columns.end * TILE + SIDE - TILE);
    let (top, bottom) = (first * TILE, last * TILE + SIDE);
    // SAFETY: these are the pixels that the tiles read, and others of their rows.
    unsafe {
        let mut most = S::NO_SUMS;
        let mut b = 0;
        while b < blocks {
            let mut y = top;
            while y < bottom {
                let row = strip.src.ptr.add(b * strip.src.block + y * strip.src.row);
                let mut x = left;
                while x < right {
                    most = S::load(row.add(x * LANES)).magnitude(most);
                    x += 1;
                }
                y += 1;
            }
            b += 1;
        }
        let most = S::largest(most);
        if most.is_finite() { most } else { f32::NAN }
    }
}

/// The factors of frequencies with which none of them is beyond [`MOST`]; 0 where there is nothing.
#[inline(always)]
unsafe fn set_factors<S: Pairs>(most: f32, factors: &mut [Pixel; FREQUENCIES]) {
    let scale = if most > f32::MIN_POSITIVE { MOST / f64::from(most) } else { 0.0 };
    let mut f = 0;
    while f < FREQUENCIES {
        // SAFETY: a factor is 16 floats; the instruction set is the caller's promise.
        unsafe { S::splat((scale / REACH[f]) as f32).store(factors[f].0.as_mut_ptr()) }
        f += 1;
    }
}

/// `out[t] = scale · Σ_c a[t·16 + c] · w[c]` over `blocks` blocks of inputs, for `count` tiles and `vecs` vectors of outputs.
#[inline(always)]
unsafe fn product<S: Pairs>(
    vecs: usize,
    count: usize,
    a: *const i16,
    blocks: usize,
    w: *const i16,
    scale: *const f32,
    out: Out,
) {
    // SAFETY: the caller's contract.
    unsafe {
        if S::VECS == 2 && vecs == 2 {
            split::<S, 2>(count, a, blocks, w, scale, out);
        } else {
            split::<S, 1>(count, a, blocks, w, scale, out);
        }
    }
}

#[inline(always)]
unsafe fn split<S: Pairs, const V: usize>(
    count: usize,
    a: *const i16,
    blocks: usize,
    w: *const i16,
    scale: *const f32,
    out: Out,
) {
    // SAFETY: the caller's contract, for the tiles from `done` on.
    in_tiles!(S::ROWS, count, |done, ROWS| unsafe {
        let out = Out { ptr: out.ptr.add(done * out.step), ..out };
        tile::<S, V, ROWS>(a.add(done * LANES), blocks, w, scale, out);
    });
}

#[inline(always)]
unsafe fn tile<S: Pairs, const V: usize, const R: usize>(
    a: *const i16,
    blocks: usize,
    mut w: *const i16,
    scale: *const f32,
    out: Out,
) {
    // SAFETY: the caller's contract.
    unsafe {
        let mut sums = [[S::NO_SUMS; V]; R];
        let mut b = 0;
        while b < blocks {
            let mut p = a.add(b * MAX_TILES * LANES);
            let end = p.add(LANES);
            while p < end {
                let mut pairs = [S::NO_SUMS; V];
                let mut v = 0;
                while v < V {
                    pairs[v] = S::load_pairs(w.add(v * 2 * LANES));
                    v += 1;
                }
                let mut r = 0;
                while r < R {
                    let x = S::splat_pair(p.add(r * LANES));
                    let mut v = 0;
                    while v < V {
                        sums[r][v] = S::add_products(x, pairs[v], sums[r][v]);
                        v += 1;
                    }
                    r += 1;
                }
                w = w.add(V * 2 * LANES);
                p = p.add(2);
            }
            b += 1;
        }
        let mut v = 0;
        while v < V {
            let scale = S::load(scale.add(v * LANES));
            let mut r = 0;
            while r < R {
                S::to_single(sums[r][v]).mul(scale).store(out.ptr.add(r * out.step + v * out.vec_step));
                r += 1;
            }
            v += 1;
        }
    }
}
