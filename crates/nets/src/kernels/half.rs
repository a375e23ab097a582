//! What training in bf16 does beside [`amx::forward`](super::amx::forward): images of [`Form::Half`], and the gradient by weight as
//! products of matrices over pixels.
//!
//! ```text
//! ∂w[o,i,tap] = Σ_p ∂y[o,p] · x[i, p + tap]
//! ```
//!
//! A product of the matrix unit sums over 32 pixels of a row. On its left it takes 16 output channels of ∂y, each with its 32 pixels in a
//! row: 32 × 32 numbers, transposed. On its right 16 input channels of x in pairs of pixels, once for each of the three columns of
//! taps, as a pair begins at another pixel for each. Where rows are of 16 pixels or fewer, the 32 are those of two rows.

use super::amx::{TILES, rounded, widen};
use super::blocked::{Blocked, Form, Pixel, ZERO};
use super::geometry::{GradStrip, Weights};
use super::scratch::Slot;
use super::simd::LANES;
use std::arch::asm;
use std::arch::x86_64::*;

/// Channels of a block, and pixels of a product.
const HALVES: usize = 2 * LANES;

/// Cache lines of both operands for 32 pixels: 32 channels.
const OPERAND: usize = HALVES;

/// Cache lines of the gradient of 32 × 32 filters at one tap.
const SUMS: usize = HALVES * HALVES / LANES;

/// `half = bf16(single)`, border and all.
///
/// # Safety
/// [`Isa::Amx`](super::isa::Isa::Amx) is available.
///
/// # Panics
/// When the shapes or forms are not those of the two.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub(super) unsafe fn round(single: &Blocked, half: &mut Blocked) {
    assert_eq!((single.form(), half.form(), single.shape()), (Form::Single, Form::Half, half.shape()));
    let (channels, height, width) = single.shape();
    let each = super::blocked::padded(height) * super::blocked::padded(width);
    let (blocks, from) = (single.blocks(), single.pixels());
    for (block, to) in half.pixels_mut().chunks_exact_mut(each).take(channels.div_ceil(HALVES)).enumerate() {
        let used = |first: usize| (1u32 << channels.saturating_sub(first).min(LANES)).wrapping_sub(1) as u16;
        let (first, second) = (used(block * HALVES), used(block * HALVES + LANES));
        let a = &from[2 * block * each..][..each];
        let b = if 2 * block + 1 < blocks { &from[(2 * block + 1) * each..][..each] } else { a };
        for ((to, a), b) in to.iter_mut().zip(a).zip(b) {
            // SAFETY: each is a cache line; lanes beyond the last channel are not read.
            unsafe {
                let a = _mm512_maskz_loadu_ps(first, a.0.as_ptr());
                let b = _mm512_maskz_loadu_ps(second, b.0.as_ptr());
                _mm512_store_si512(to.0.as_mut_ptr().cast(), rounded(a, b));
            }
        }
    }
}

/// Lets a gradient through where the ReLU let its value `y` through.
///
/// # Safety
/// [`Isa::Amx`](super::isa::Isa::Amx) is available.
#[target_feature(enable = "avx512f,avx512bw")]
pub(super) unsafe fn mask(grad: &mut Blocked, y: &Blocked) {
    for (g, y) in grad.pixels_mut().iter_mut().zip(y.pixels()) {
        // SAFETY: each is a cache line. A bf16 number above 0 is one above 0 as an integer.
        unsafe {
            let p = g.0.as_mut_ptr().cast();
            let open = _mm512_cmpgt_epi16_mask(_mm512_load_si512(y.0.as_ptr().cast()), _mm512_setzero_si512());
            _mm512_store_si512(p, _mm512_maskz_mov_epi16(open, _mm512_load_si512(p)));
        }
    }
}

/// `sum += other`, of one shape.
///
/// # Safety
/// [`Isa::Amx`](super::isa::Isa::Amx) is available.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub(super) unsafe fn add(sum: &mut Blocked, other: &Blocked) {
    for (sum, other) in sum.pixels_mut().iter_mut().zip(other.pixels()) {
        // SAFETY: each is a cache line.
        unsafe {
            let p = sum.0.as_mut_ptr().cast();
            let [a, b] = [widen(_mm512_load_si512(p)), widen(_mm512_load_si512(other.0.as_ptr().cast()))];
            _mm512_store_si512(p, rounded(_mm512_add_ps(a.0, b.0), _mm512_add_ps(a.1, b.1)));
        }
    }
}

/// Puts the pixels of `grad`, the gradient by the result of a convolution of stride 2, at the even rows and columns of `wide`, of the
/// size of its input, among zeros: what follows is as for stride 1.
pub(super) fn widen_stride(grad: &Blocked, wide: &mut Blocked) {
    let ((_, height, width), (_, wide_h, wide_w)) = (grad.shape(), wide.shape());
    let [row, wide_row] = [width, wide_w].map(super::blocked::padded);
    let [each, wide_each] = [super::blocked::padded(height) * row, super::blocked::padded(wide_h) * wide_row];
    wide.pixels_mut().fill(ZERO);
    for block in 0..grad.blocks() {
        for y in 0..height {
            let from = &grad.pixels()[block * each + (y + 1) * row + 1..][..width];
            let to = &mut wide.pixels_mut()[block * wide_each + (2 * y + 1) * wide_row + 1..];
            from.iter().zip(to.iter_mut().step_by(2)).for_each(|(from, to)| *to = *from);
        }
    }
}

/// The gradient by weight, stride 1.
pub(super) struct GradPlan {
    blocks_in: usize,
    blocks_out: usize,
    /// Cache lines of its sums, `[blocks_out][blocks_in][9][out 2][in 2][out 16][in 16]`.
    pub(super) pixels: usize,
}

impl GradPlan {
    pub(super) fn new(inputs: usize, outputs: usize) -> Self {
        let (blocks_in, blocks_out) = (inputs.div_ceil(HALVES), outputs.div_ceil(HALVES));
        Self { blocks_in, blocks_out, pixels: blocks_in * blocks_out * 9 * SUMS }
    }

    /// Cache lines of the sums of the bias.
    pub(super) fn bias_pixels(&self) -> usize {
        2 * self.blocks_out
    }

    /// From the sums to `[Cout, Cin/groups, 3, 3]`.
    pub(super) fn finish(&self, shape: &Weights<'_>, sums: &[Pixel], result: &mut [f32]) {
        for (o, c) in (0..shape.outputs).flat_map(|o| (0..shape.inputs).map(move |c| (o, c))) {
            let Some(first) = shape.index(o, c, 0) else { continue };
            let filters = (o / HALVES * self.blocks_in + c / HALVES) * 9;
            let tile = o % HALVES / LANES * 2 + c % HALVES / LANES;
            for (tap, sum) in result[first..first + 9].iter_mut().enumerate() {
                *sum = sums[(filters + tap) * SUMS + tile * LANES + o % LANES].0[c % LANES];
            }
        }
    }
}

/// A strip, cut into products.
struct Products {
    strip: GradStrip,
    /// Whether a product is of two rows, not of 32 pixels of one.
    two_rows: bool,
    /// Products side by side.
    across: usize,
    count: usize,
    /// Its first operand of the input, in cache lines.
    first: usize,
}

impl Products {
    fn new(strip: GradStrip, first: usize) -> Self {
        let GradStrip { rows, width, .. } = strip;
        let (two_rows, across) = (width <= LANES, width.div_ceil(HALVES));
        let count = if two_rows { rows.div_ceil(2) } else { rows * across };
        Self { strip, two_rows, across, count, first }
    }

    /// Operands of the input for one column of taps: those of the first row of taps, of the second two rows on.
    fn inputs(&self) -> usize {
        (self.strip.rows + 2) * self.across
    }
}

/// Adds the share of some strips to the sums. These are read and written once for all strips, which for deep layers of small
/// pictures is most of the work.
///
/// # Safety
/// [`Isa::Amx`](super::isa::Isa::Amx) is available; both images have the strips, and that of the input 34 pixels beyond its last row.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub(super) unsafe fn weight_grad(
    plan: &GradPlan,
    bias: &mut [Pixel],
    sums: &mut [Pixel],
    strips: &[GradStrip],
    slot: &mut Slot,
) {
    // Cache lines of the input's operands for one column of taps.
    let mut column = 0;
    let cut = |&strip: &GradStrip| {
        let products = Products::new(strip, column);
        column += products.inputs() * OPERAND;
        products
    };
    let strips: Vec<Products> = strips.iter().map(cut).collect();
    let products: usize = strips.iter().map(|strip| strip.count).sum();
    slot.a.grow(plan.blocks_out * products * OPERAND * LANES);
    let of_grad: *mut Pixel = slot.a.as_mut_ptr().cast();
    slot.b.grow(3 * column * LANES);
    let of_input: *mut Pixel = slot.b.as_mut_ptr().cast();
    // SAFETY: the caller's contract; the buffers have what was asked for, `sums` and `bias` what the plan says.
    unsafe {
        for (block, bias) in bias.as_chunks_mut::<2>().0.iter_mut().enumerate() {
            let mut to = of_grad.add(block * products * OPERAND);
            for strip in &strips {
                grad_operands(strip, block, bias, to);
                to = to.add(strip.count * OPERAND);
            }
        }
        asm!("ldtilecfg [{}]", in(reg) &raw const TILES, options(nostack, readonly));
        for block_in in 0..plan.blocks_in {
            for strip in &strips {
                input_operands(strip, block_in, of_input.add(strip.first), column);
            }
            for block_out in 0..plan.blocks_out {
                let sums = sums[(block_out * plan.blocks_in + block_in) * 9 * SUMS..].as_mut_ptr();
                for tap in 0..9 {
                    let a = of_grad.add(block_out * products * OPERAND);
                    multiply(a, of_input.add(tap % 3 * column), tap / 3, &strips, sums.add(tap * SUMS));
                }
            }
        }
        asm!("tilerelease", options(nostack, nomem));
    }
}

/// The left operands of a strip: 32 channels of ∂y, which are added up in `bias` too.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn grad_operands(products: &Products, block: usize, bias: &mut [Pixel; 2], to: *mut Pixel) {
    let &Products { strip: GradStrip { grad, rows, width, .. }, two_rows, across, count, .. } = products;
    for product in 0..count {
        let (y, x) = if two_rows { (2 * product, 0) } else { (product / across, product % across * HALVES) };
        let (second, left) = if two_rows {
            (grad.row, if y + 1 < rows { width } else { 0 })
        } else {
            (LANES * LANES, (width - x).saturating_sub(LANES))
        };
        let counts = [LANES.min(width - x), LANES.min(left)];
        // SAFETY: the caller's contract.
        unsafe {
            let from = grad.ptr.add(block * grad.block + y * grad.row + x * LANES);
            transpose((from, second), counts, bias, to.add(product * OPERAND));
        }
    }
}

/// The right operands of a strip: 32 channels of x, for each column of taps, `column` cache lines apart.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn input_operands(products: &Products, block: usize, to: *mut Pixel, column: usize) {
    let &Products { strip: GradStrip { input, .. }, two_rows, across, .. } = products;
    let second = if two_rows { input.row } else { LANES * LANES };
    for at in 0..products.inputs() {
        let (y, x) = (at / across, at % across * HALVES);
        // SAFETY: the caller's contract.
        unsafe {
            let from = input.ptr.add(block * input.block + y * input.row + x * LANES);
            for dx in 0..3 {
                pairs((from.add(dx * LANES), second), to.add(dx * column + at * OPERAND));
            }
        }
    }
}

/// `sums[o][i] += Σ a[o][p] b[p][i]` for 32 × 32 channels and the pixels of all strips, at one row of taps.
#[inline]
unsafe fn multiply(mut a: *const Pixel, b: *const Pixel, tap_row: usize, strips: &[Products], sums: *mut Pixel) {
    // SAFETY: the caller gives the memory; the tiles are configured.
    unsafe {
        asm!("tileloadd tmm0, [{c} + {t}*1]", "tileloadd tmm1, [{c} + {t}*1 + 1024]",
            "tileloadd tmm2, [{c} + {t}*1 + 2048]", "tileloadd tmm3, [{c} + {t}*1 + 3072]",
            c = in(reg) sums, t = in(reg) 64usize, options(nostack, readonly));
        for strip in strips {
            let mut b = b.add(strip.first + tap_row * strip.across * OPERAND);
            let each = if strip.two_rows { 2 * OPERAND } else { OPERAND };
            for _ in 0..strip.count {
                asm!(
                    "tileloadd tmm4, [{a} + {t}*1]",
                    "tileloadd tmm6, [{b} + {t}*1]",
                    "tileloadd tmm5, [{a} + {t}*1 + 1024]",
                    "tileloadd tmm7, [{b} + {t}*1 + 1024]",
                    "tdpbf16ps tmm0, tmm4, tmm6",
                    "tdpbf16ps tmm1, tmm4, tmm7",
                    "tdpbf16ps tmm2, tmm5, tmm6",
                    "tdpbf16ps tmm3, tmm5, tmm7",
                    a = in(reg) a, b = in(reg) b, t = in(reg) 64usize, options(nostack, readonly),
                );
                (a, b) = (a.add(OPERAND), b.add(each));
            }
        }
        asm!("tilestored [{c} + {t}*1], tmm0", "tilestored [{c} + {t}*1 + 1024], tmm1",
            "tilestored [{c} + {t}*1 + 2048], tmm2", "tilestored [{c} + {t}*1 + 3072], tmm3",
            c = in(reg) sums, t = in(reg) 64usize, options(nostack));
    }
}

/// 16 pixels of 32 channels, and 16 that begin `second` floats after them, as 16 pairs of pixels of 16 channels, and of the 16 channels
/// after those.
#[inline]
#[target_feature(enable = "avx512f,avx512bw")]
unsafe fn pairs((from, second): (*const f32, usize), to: *mut Pixel) {
    const fn picks(first: u16) -> [u16; HALVES] {
        let (mut all, mut k) = ([0; HALVES], 0);
        while k < LANES {
            (all[2 * k], all[2 * k + 1]) = (first + k as u16, HALVES as u16 + first + k as u16);
            k += 1;
        }
        all
    }
    static PICKS: [[u16; HALVES]; 2] = [picks(0), picks(LANES as u16)];
    // SAFETY: the caller gives 32 pixels on both sides.
    unsafe {
        let [low, high] = [0, 1].map(|i| _mm512_loadu_si512(PICKS[i].as_ptr().cast()));
        for k in 0..LANES {
            let pair = from.add(k / (LANES / 2) * second + 2 * k % LANES * LANES);
            let [p, q] = [pair, pair.add(LANES)].map(|p| _mm512_loadu_si512(p.cast()));
            _mm512_store_si512(to.add(k).cast(), _mm512_permutex2var_epi16(p, low, q));
            _mm512_store_si512(to.add(LANES + k).cast(), _mm512_permutex2var_epi16(p, high, q));
        }
    }
}

/// 16 pixels of 32 channels, and 16 that begin `second` floats after them, as 32 channels of 32 pixels, zeros for those beyond the
/// counts; adds the pixels to `sums`.
#[inline]
#[target_feature(enable = "avx512f,avx512bw")]
unsafe fn transpose((from, second): (*const f32, usize), counts: [usize; 2], sums: &mut [Pixel; 2], to: *mut Pixel) {
    /// What a row takes of itself and of the row `1 << bit` after it, and what that one takes.
    const fn picks(bit: usize, second: bool) -> [u16; HALVES] {
        let (mut all, mut j) = ([0; HALVES], 0);
        while j < HALVES {
            let far = (j >> bit & 1 == 1) != second;
            let column = if far { j ^ (1 << bit) } else { j };
            all[j] = if j >> bit & 1 == 1 { HALVES + column } else { column } as u16;
            j += 1;
        }
        all
    }
    static PICKS: [[[u16; HALVES]; 2]; 5] = {
        let (mut all, mut bit) = ([[[0; HALVES]; 2]; 5], 0);
        while bit < 5 {
            all[bit] = [picks(bit, false), picks(bit, true)];
            bit += 1;
        }
        all
    };
    // SAFETY: the caller gives the pixels and 32 cache lines.
    unsafe {
        let [mut low, mut high] = [0, 1].map(|i| _mm512_load_ps(sums[i].0.as_ptr()));
        let mut rows = [_mm512_setzero_si512(); HALVES];
        for (tile, count) in counts.into_iter().enumerate() {
            for i in 0..count {
                let row = _mm512_loadu_si512(from.add(tile * second + i * LANES).cast());
                rows[tile * LANES + i] = row;
                let (a, b) = widen(row);
                (low, high) = (_mm512_add_ps(low, a), _mm512_add_ps(high, b));
            }
        }
        for (bit, picks) in PICKS.iter().enumerate() {
            let [own, other] = [0, 1].map(|i| _mm512_loadu_si512(picks[i].as_ptr().cast()));
            for i in (0..HALVES).filter(|i| i >> bit & 1 == 0) {
                let (a, b) = (rows[i], rows[i | 1 << bit]);
                rows[i] = _mm512_permutex2var_epi16(a, own, b);
                rows[i | 1 << bit] = _mm512_permutex2var_epi16(a, other, b);
            }
        }
        rows.iter().enumerate().for_each(|(i, row)| _mm512_store_si512(to.add(i).cast(), *row));
        _mm512_store_ps(sums[0].0.as_mut_ptr(), low);
        _mm512_store_ps(sums[1].0.as_mut_ptr(), high);
    }
}
