//! Winograd's minimal filtering F(4×4, 3×3): 36 products where the definition has 144.
//!
//! `y = Aᵀ[(G g Gᵀ) ⊙ (Bᵀ d B)]A` for a 6×6 input tile `d`, a 3×3 filter `g` and a 4×4 output tile `y` (Lavin and Gray,
//! "Fast Algorithms for Convolutional Neural Networks", CVPR 2016), with interpolation at 0, ±[`P`], ±[`Q`] and ∞.
//! Summed over input channels, `⊙` is 36 small matrix products. The weight gradient is the adjoint,
//! `∂g = Gᵀ[Σ (Bᵀ d B) ⊙ (A ∂y Aᵀ)]G`, again 36 products.

#[cfg(target_arch = "x86_64")]
mod integers;

#[cfg(target_arch = "x86_64")]
pub(super) use integers::{Integers, forward as forward_in_integers};

use super::blocked::{Pixel, View, ZERO, floats, floats_mut};
use super::geometry::{GradStrip, Panel, Strip, Weights};
use super::scratch::Slot;
use super::simd::{LANES, Simd, entry};
use super::tile::{Out, Run, outer, product};
use multiversion::multiversion;
use rayon::prelude::*;
use std::iter::StepBy;
use std::mem::MaybeUninit;
use std::slice::IterMut;

/// Interpolation points; see `docs/kernels.md` for the choice.
const P: f64 = 0.625;
const Q: f64 = 1.5;

/// Output pixels, and input pixels, on the side of a tile.
pub(super) const TILE: usize = 4;
const SIDE: usize = 6;
const FREQUENCIES: usize = SIDE * SIDE;

/// Rows of G: the filter polynomial at each point, over `Π (point − other points)`.
const G: [[f64; 3]; SIDE] = {
    let (p2, q2) = (P * P, Q * Q);
    let (np, nq) = (2.0 * p2 * (p2 - q2), 2.0 * q2 * (q2 - p2));
    [
        [1.0 / (p2 * q2), 0.0, 0.0],
        [1.0 / np, P / np, p2 / np],
        [1.0 / np, -P / np, p2 / np],
        [1.0 / nq, Q / nq, q2 / nq],
        [1.0 / nq, -Q / nq, q2 / nq],
        [0.0, 0.0, 1.0],
    ]
};

#[inline(always)]
unsafe fn constant<S: Simd>(x: f64) -> S {
    // SAFETY: the instruction set is the caller's promise.
    unsafe { S::splat(x as f32) }
}

/// `Bᵀ d`.
#[inline(always)]
unsafe fn input_1d<S: Simd>(d: [S; SIDE]) -> [S; SIDE] {
    let (p2, q2) = (P * P, Q * Q);
    // SAFETY: the instruction set is the caller's promise.
    unsafe {
        let (minus_p2, minus_q2) = (S::splat(-p2 as f32), S::splat(-q2 as f32));
        let (p, minus_p) = (S::splat(P as f32), S::splat(-P as f32));
        let (q, minus_q) = (S::splat(Q as f32), S::splat(-Q as f32));
        let (product, minus_sum) = (S::splat((p2 * q2) as f32), S::splat(-(p2 + q2) as f32));
        let (even_p, odd_p) = (d[2].fma(minus_q2, d[4]), d[1].fma(minus_q2, d[3]));
        let (even_q, odd_q) = (d[2].fma(minus_p2, d[4]), d[1].fma(minus_p2, d[3]));
        [
            d[0].fma(product, d[2].fma(minus_sum, d[4])),
            odd_p.fma(p, even_p),
            odd_p.fma(minus_p, even_p),
            odd_q.fma(q, even_q),
            odd_q.fma(minus_q, even_q),
            d[1].fma(product, d[3].fma(minus_sum, d[5])),
        ]
    }
}

/// `Aᵀ m`.
#[inline(always)]
unsafe fn output_1d<S: Simd>(m: [S; SIDE]) -> [S; TILE] {
    // SAFETY: the instruction set is the caller's promise.
    unsafe {
        let (sum_p, diff_p) = (m[1].add(m[2]), m[1].sub(m[2]));
        let (sum_q, diff_q) = (m[3].add(m[4]), m[3].sub(m[4]));
        [
            m[0].add(sum_p).add(sum_q),
            diff_q.fma(constant::<S>(Q), diff_p.mul(constant::<S>(P))),
            sum_q.fma(constant::<S>(Q * Q), sum_p.mul(constant::<S>(P * P))),
            diff_q.fma(constant::<S>(Q * Q * Q), diff_p.fma(constant::<S>(P * P * P), m[5])),
        ]
    }
}

/// `A y`.
#[inline(always)]
unsafe fn spread_1d<S: Simd>(y: [S; TILE]) -> [S; SIDE] {
    // SAFETY: the instruction set is the caller's promise.
    unsafe {
        let (even_p, odd_p) =
            (y[2].fma(constant::<S>(P * P), y[0]), y[3].fma(constant::<S>(P * P * P), y[1].mul(constant::<S>(P))));
        let (even_q, odd_q) =
            (y[2].fma(constant::<S>(Q * Q), y[0]), y[3].fma(constant::<S>(Q * Q * Q), y[1].mul(constant::<S>(Q))));
        [y[0], even_p.add(odd_p), even_p.sub(odd_p), even_q.add(odd_q), even_q.sub(odd_q), y[3]]
    }
}

/// A row all of which has been written. Rows begin uninitialised: zeroing what AVX2 cannot hold in its registers is a call of `memset`
/// for every tile, half as long as the transform.
#[inline(always)]
unsafe fn written<S: Simd, const N: usize>(row: &[MaybeUninit<S>; N]) -> [S; N] {
    // SAFETY: the caller has written every entry.
    unsafe { row.as_ptr().cast::<[S; N]>().read() }
}

/// Where the frequencies of a block of tiles go: `[36][Cin/16][MAX_TILES][16]`.
trait Frequencies<S>: Copy {
    /// The place of the `i`-th tile.
    unsafe fn tile(self, i: usize) -> Self;
    /// Puts frequency `f` of this tile there.
    unsafe fn put(self, f: usize, v: S);
}

/// As f32 numbers, frequency `f` at `ptr + f·step`.
#[derive(Clone, Copy)]
struct Singles {
    ptr: *mut f32,
    step: usize,
}

impl<S: Simd> Frequencies<S> for Singles {
    #[inline(always)]
    unsafe fn tile(self, i: usize) -> Self {
        // SAFETY: the caller gives the memory.
        Self { ptr: unsafe { self.ptr.add(i * LANES) }, ..self }
    }

    #[inline(always)]
    unsafe fn put(self, f: usize, v: S) {
        // SAFETY: as above.
        unsafe { v.store(self.ptr.add(f * self.step)) }
    }
}

/// `Bᵀ d B` of the 6×6 pixels at `src`.
#[inline(always)]
unsafe fn input_tile<S: Simd>(src: *const f32, row: usize, to: impl Frequencies<S>) {
    // SAFETY: the caller gives the memory of both.
    unsafe {
        let mut t = [[MaybeUninit::<S>::uninit(); SIDE]; SIDE];
        let mut x = 0;
        while x < SIDE {
            let mut d = [S::splat(0.0); SIDE];
            let mut y = 0;
            while y < SIDE {
                d[y] = S::load(src.add(y * row + x * LANES));
                y += 1;
            }
            let d = input_1d(d);
            let mut y = 0;
            while y < SIDE {
                t[y][x].write(d[y]);
                y += 1;
            }
            x += 1;
        }
        let mut y = 0;
        while y < SIDE {
            let v = input_1d(written(&t[y]));
            let mut x = 0;
            while x < SIDE {
                to.put(y * SIDE + x, v[x]);
                x += 1;
            }
            y += 1;
        }
    }
}

/// What is done to a result: `max(scale · x + bias, floor)`.
#[derive(Clone, Copy)]
struct Finish<S> {
    scale: S,
    bias: S,
    floor: S,
}

/// `Aᵀ m A` of frequencies `m + f·step`, finished, to 4×4 pixels at `dst`.
#[inline(always)]
unsafe fn output_tile<S: Simd>(m: *const f32, step: usize, finish: Finish<S>, dst: *mut f32, row: usize) {
    // SAFETY: the caller gives the memory of both.
    unsafe {
        let mut t = [[MaybeUninit::<S>::uninit(); SIDE]; TILE];
        let mut x = 0;
        while x < SIDE {
            let mut d = [S::splat(0.0); SIDE];
            let mut y = 0;
            while y < SIDE {
                d[y] = S::load(m.add((y * SIDE + x) * step));
                y += 1;
            }
            let d = output_1d(d);
            let mut y = 0;
            while y < TILE {
                t[y][x].write(d[y]);
                y += 1;
            }
            x += 1;
        }
        let mut y = 0;
        while y < TILE {
            let v = output_1d(written(&t[y]));
            let mut x = 0;
            while x < TILE {
                v[x].fma(finish.scale, finish.bias).at_least(finish.floor).store(dst.add(y * row + x * LANES));
                x += 1;
            }
            y += 1;
        }
    }
}

/// `A y Aᵀ` of the 4×4 pixels at `src`, frequency `f` to `dst + f·step`.
#[inline(always)]
unsafe fn spread_tile<S: Simd>(src: *const f32, row: usize, dst: *mut f32, step: usize) {
    // SAFETY: the caller gives the memory of both.
    unsafe {
        let mut t = [[MaybeUninit::<S>::uninit(); TILE]; SIDE];
        let mut x = 0;
        while x < TILE {
            let mut d = [S::splat(0.0); TILE];
            let mut y = 0;
            while y < TILE {
                d[y] = S::load(src.add(y * row + x * LANES));
                y += 1;
            }
            let d = spread_1d(d);
            let mut y = 0;
            while y < SIDE {
                t[y][x].write(d[y]);
                y += 1;
            }
            x += 1;
        }
        let mut y = 0;
        while y < SIDE {
            let v = spread_1d(written(&t[y]));
            let mut x = 0;
            while x < SIDE {
                v[x].store(dst.add((y * SIDE + x) * step));
                x += 1;
            }
            y += 1;
        }
    }
}

/// Most tiles transformed at once, so that both transforms of them stay in the second-level cache.
const MAX_TILES: usize = 32;

/// Floats between the frequencies of `blocks` channel blocks. An odd number of cache lines: the 36 lines that a tile's
/// transform touches then fall into different cache sets.
fn frequency_step(blocks: usize) -> usize {
    blocks * MAX_TILES * LANES + if (blocks * MAX_TILES).is_multiple_of(2) { LANES } else { 0 }
}

/// Tiles `first..first + count` of a strip, counted row by row, `across` in a row.
#[derive(Clone, Copy)]
struct Tiles {
    first: usize,
    count: usize,
    across: usize,
}

impl Tiles {
    /// Blocks of nearly equal size, at most [`MAX_TILES`].
    #[inline(always)]
    fn block(rows: usize, width: usize, i: usize) -> Option<Self> {
        let across = width.div_ceil(TILE);
        let total = across * rows.div_ceil(TILE);
        let blocks = total.div_ceil(MAX_TILES);
        let (small, larger) = (total / blocks, total % blocks);
        (i < blocks).then_some(Self {
            first: i * small + i.min(larger),
            count: small + usize::from(i < larger),
            across,
        })
    }

    /// Row and column of the `i`-th tile.
    #[inline(always)]
    fn at(self, i: usize) -> (usize, usize) {
        let k = self.first + i;
        (k / self.across, k % self.across)
    }
}

/// A convolution's filters, transformed.
#[derive(Debug)]
pub(super) struct Winograd {
    input_channels: usize,
    panels: Vec<Panel>,
    /// For each panel `[36][Cin][vecs · 16]`.
    filters: Vec<Pixel>,
    /// Channel blocks of a tile block's transform.
    runs: Vec<Run>,
}

impl Winograd {
    pub(super) fn new(weights: &Weights<'_>, vecs: usize) -> Self {
        let panels = Panel::cut(weights.outputs, vecs);
        let cin = weights.inputs;
        let mut filters = vec![ZERO; FREQUENCIES * cin * weights.outputs.div_ceil(LANES)];
        let mut rest = &mut filters[..];
        let mut jobs = Vec::with_capacity(panels.len());
        for &panel in &panels {
            let (head, tail) = rest.split_at_mut(FREQUENCIES * cin * panel.vecs);
            jobs.push((panel, head));
            rest = tail;
        }
        jobs.into_par_iter().for_each(|(panel, out)| {
            for c in 0..cin {
                for v in 0..panel.vecs {
                    let mut out = out[c * panel.vecs + v..].iter_mut().step_by(cin * panel.vecs);
                    transform_filters(&filters_of(weights, (panel.block + v) * LANES, c), &mut out);
                }
            }
        });
        Self { input_channels: cin, panels, filters, runs: transformed_runs(cin) }
    }

    /// Floats of scratch for the two transforms.
    fn reserve(&self, slot: &mut Slot) {
        let blocks = self.input_channels.div_ceil(LANES);
        slot.a.grow(FREQUENCIES * frequency_step(blocks));
        slot.b.grow(FREQUENCIES * frequency_step(2));
    }
}

fn transformed_runs(channels: usize) -> Vec<Run> {
    (0..channels.div_ceil(LANES))
        .map(|b| Run { offset: b * MAX_TILES * LANES, len: (channels - b * LANES).min(LANES) })
        .collect()
}

/// The filters of 16 output channels from `o` on, input channel `c`, as `[9][16]`.
fn filters_of(weights: &Weights<'_>, o: usize, c: usize) -> [[f64; LANES]; 9] {
    let mut g = [[0.0; LANES]; 9];
    for k in 0..LANES.min(weights.outputs - o) {
        for (tap, g) in g.iter_mut().enumerate() {
            g[k] = f64::from(weights.at(o + k, c, tap));
        }
    }
    g
}

/// `G g Gᵀ`, frequency after frequency to `out`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn transform_filters(g: &[[f64; LANES]; 9], out: &mut StepBy<IterMut<'_, Pixel>>) {
    for by_row in &G {
        let t: [[f64; LANES]; 3] = std::array::from_fn(|x| {
            std::array::from_fn(|k| (0..3).fold(0.0, |sum, y| sum + by_row[y] * g[y * 3 + x][k]))
        });
        for (by_column, out) in G.iter().zip(&mut *out) {
            out.0 = std::array::from_fn(|k| (0..3).fold(0.0, |sum, x| sum + by_column[x] * t[x][k]) as f32);
        }
    }
}

entry!(pub(super) fn forward = forward_strip(
    conv: &Winograd, bias: &[Pixel], floor: f32, strip: Strip, slot: &mut Slot,
));

#[inline(always)]
unsafe fn forward_strip<S: Simd>(conv: &Winograd, bias: &[Pixel], floor: f32, strip: Strip, slot: &mut Slot) {
    conv.reserve(slot);
    let blocks = conv.input_channels.div_ceil(LANES);
    let (v_step, m_step) = (frequency_step(blocks), frequency_step(2));
    let (v, m) = (slot.a.as_mut_ptr(), slot.b.as_mut_ptr());
    let mut i = 0;
    while let Some(tiles) = Tiles::block(strip.rows, strip.width, i) {
        // SAFETY: `reserve` made room for a block of tiles; the strip's memory is the caller's promise.
        unsafe {
            input_block::<S>(strip.src, blocks, tiles, Singles { ptr: v, step: v_step });
            let mut u = conv.filters.as_ptr().cast::<f32>();
            let mut p = 0;
            while p < conv.panels.len() {
                let panel = *conv.panels.get_unchecked(p);
                let mut f = 0;
                while f < FREQUENCIES {
                    product::<S, LANES>(
                        panel.vecs,
                        tiles.count,
                        v.add(f * v_step),
                        &conv.runs,
                        u,
                        NO_BIAS.as_ptr().cast(),
                        f32::NEG_INFINITY,
                        Out { ptr: m.add(f * m_step), step: LANES, vec_step: MAX_TILES * LANES },
                    );
                    u = u.add(conv.input_channels * panel.vecs * LANES);
                    f += 1;
                }
                output_block::<S>(m, m_step, panel, bias, [1.0, floor], tiles, strip);
                p += 1;
            }
        }
        i += 1;
    }
}

static NO_BIAS: [Pixel; 2] = [ZERO; 2];

/// Transforms the input of a block of tiles.
#[inline(always)]
unsafe fn input_block<S: Simd>(src: View, blocks: usize, tiles: Tiles, to: impl Frequencies<S>) {
    let mut b = 0;
    while b < blocks {
        let mut t = 0;
        while t < tiles.count {
            let (ty, tx) = tiles.at(t);
            // SAFETY: tile (ty, tx) reads padded rows 4ty..4ty+6, which a strip's source has.
            unsafe {
                let pixels = src.ptr.add(b * src.block + ty * TILE * src.row + tx * TILE * LANES);
                input_tile(pixels, src.row, to.tile(b * MAX_TILES + t));
            }
            t += 1;
        }
        b += 1;
    }
}

/// Transforms the products of a panel back, times `scale`; tiles that stick out of the image are cut.
#[inline(always)]
unsafe fn output_block<S: Simd>(
    m: *const f32,
    step: usize,
    panel: Panel,
    bias: &[Pixel],
    [scale, floor]: [f32; 2],
    tiles: Tiles,
    strip: Strip,
) {
    let mut cut = [ZERO; TILE * TILE];
    let mut v = 0;
    while v < panel.vecs {
        // SAFETY: `bias` has a pixel for each output block; a tile's valid pixels are inside the strip.
        unsafe {
            let bias = S::load(bias.as_ptr().add(panel.block + v).cast());
            let finish = Finish { scale: S::splat(scale), bias, floor: S::splat(floor) };
            let mut t = 0;
            while t < tiles.count {
                let (ty, tx) = tiles.at(t);
                let (y0, x0) = (ty * TILE, tx * TILE);
                let src = m.add((v * MAX_TILES + t) * LANES);
                let dst = strip.dst.ptr.add((panel.block + v) * strip.dst.block + y0 * strip.dst.row + x0 * LANES);
                if y0 + TILE <= strip.rows && x0 + TILE <= strip.width {
                    output_tile(src, step, finish, dst, strip.dst.row);
                } else {
                    let whole = cut.as_mut_ptr().cast::<f32>();
                    output_tile(src, step, finish, whole, TILE * LANES);
                    let mut y = 0;
                    while y < TILE.min(strip.rows - y0) {
                        let mut x = 0;
                        while x < TILE.min(strip.width - x0) {
                            S::load(whole.add((y * TILE + x) * LANES)).store(dst.add(y * strip.dst.row + x * LANES));
                            x += 1;
                        }
                        y += 1;
                    }
                }
                t += 1;
            }
        }
        v += 1;
    }
}

/// The weight gradient's sums before their last transform: for each panel `[36][Cin][vecs · 16]`.
#[derive(Debug)]
pub(super) struct GradPlan {
    inputs: usize,
    outputs: usize,
    panels: Vec<Panel>,
    pub(super) pixels: usize,
}

impl GradPlan {
    pub(super) fn new(inputs: usize, outputs: usize, vecs: usize) -> Self {
        Self {
            inputs,
            outputs,
            panels: Panel::cut(outputs, vecs),
            pixels: FREQUENCIES * inputs * outputs.div_ceil(LANES),
        }
    }

    fn reserve(&self, slot: &mut Slot) {
        let (a, b) = (self.inputs.div_ceil(LANES), self.outputs.div_ceil(LANES));
        slot.a.grow(FREQUENCIES * frequency_step(a));
        slot.b.grow(FREQUENCIES * frequency_step(b));
    }

    /// `Gᵀ · sums · G`, to `grad [Cout,Cin,3,3]`.
    pub(super) fn finish(&self, sums: &[Pixel], grad: &mut [f32]) {
        let (cin, cout) = (self.inputs, self.outputs);
        let mut first = 0;
        for panel in &self.panels {
            let sums = &sums[first..first + FREQUENCIES * cin * panel.vecs];
            first += sums.len();
            let o = panel.block * LANES;
            let count = (panel.vecs * LANES).min(cout - o);
            grad[o * cin * 9..(o + count) * cin * 9].par_chunks_mut(LANES * cin * 9).enumerate().for_each(
                |(v, grad)| {
                    for c in 0..cin {
                        let g = transform_back(&sums[c * panel.vecs + v..], cin * panel.vecs);
                        for (k, filter) in grad.chunks_exact_mut(cin * 9).enumerate() {
                            for (tap, g) in g.iter().enumerate() {
                                filter[c * 9 + tap] = g[k] as f32;
                            }
                        }
                    }
                },
            );
        }
    }
}

/// `Gᵀ u G` of 16 output channels, as `[9][16]`, of frequencies that are `step` apart.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn transform_back(u: &[Pixel], step: usize) -> [[f64; LANES]; 9] {
    let mut g = [[0.0; LANES]; 9];
    for (i, row) in G.iter().enumerate() {
        let mut t = [[0.0; LANES]; 3];
        for (j, column) in G.iter().enumerate() {
            let u = &u[(i * SIDE + j) * step].0;
            for x in 0..3 {
                for k in 0..LANES {
                    t[x][k] += column[x] * f64::from(u[k]);
                }
            }
        }
        for y in 0..3 {
            for x in 0..3 {
                for k in 0..LANES {
                    g[y * 3 + x][k] += row[y] * t[x][k];
                }
            }
        }
    }
    g
}

entry!(pub(super) fn weight_grad = weight_grad_strip(
    plan: &GradPlan, sums: &mut [Pixel], strip: GradStrip, slot: &mut Slot,
));

#[inline(always)]
unsafe fn weight_grad_strip<S: Simd>(plan: &GradPlan, sums: &mut [Pixel], strip: GradStrip, slot: &mut Slot) {
    plan.reserve(slot);
    let (cin, in_blocks) = (plan.inputs, plan.inputs.div_ceil(LANES));
    let out_blocks = plan.outputs.div_ceil(LANES);
    let (v_step, m_step) = (frequency_step(in_blocks), frequency_step(out_blocks));
    let (v, m) = (slot.a.as_mut_ptr(), slot.b.as_mut_ptr());
    let mut i = 0;
    while let Some(tiles) = Tiles::block(strip.rows, strip.width, i) {
        // SAFETY: `reserve` made room for a block of tiles; the strip's memory is the caller's promise.
        unsafe {
            input_block::<S>(strip.input, in_blocks, tiles, Singles { ptr: v, step: v_step });
            spread_block::<S>(strip.grad, out_blocks, tiles, m, m_step);
            let mut acc = sums.as_mut_ptr().cast::<f32>();
            let mut p = 0;
            while p < plan.panels.len() {
                let panel = *plan.panels.get_unchecked(p);
                let mut f = 0;
                while f < FREQUENCIES {
                    let b = m.add(f * m_step + panel.block * MAX_TILES * LANES);
                    let mut c = 0;
                    while c < cin {
                        let channels = LANES.min(cin - c);
                        let a = v.add(f * v_step + c * MAX_TILES);
                        outer::<S, LANES>(panel.vecs, channels, tiles.count, a, b, MAX_TILES * LANES, acc);
                        acc = acc.add(channels * panel.vecs * LANES);
                        c += LANES;
                    }
                    f += 1;
                }
                p += 1;
            }
        }
        i += 1;
    }
}

/// Transforms the output gradient of a block of tiles to `m`: `[36][blocks][MAX_TILES][16]`.
#[inline(always)]
unsafe fn spread_block<S: Simd>(src: View, blocks: usize, tiles: Tiles, m: *mut f32, step: usize) {
    let mut b = 0;
    while b < blocks {
        let mut t = 0;
        while t < tiles.count {
            let (ty, tx) = tiles.at(t);
            // SAFETY: the padded gradient has whole tiles.
            unsafe {
                spread_tile::<S>(
                    src.ptr.add(b * src.block + ty * TILE * src.row + tx * TILE * LANES),
                    src.row,
                    m.add((b * MAX_TILES + t) * LANES),
                    step,
                );
            }
            t += 1;
        }
        b += 1;
    }
}

/// `sum += other`, element by element.
pub(super) fn add(sum: &mut [Pixel], other: &[Pixel]) {
    floats_mut(sum)
        .par_chunks_mut(1 << 14)
        .zip(floats(other).par_chunks(1 << 14))
        .for_each(|(s, o)| s.iter_mut().zip(o).for_each(|(s, o)| *s += o));
}
