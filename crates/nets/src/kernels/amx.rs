//! Convolution by its definition on the matrix unit of x86-64 (AMX), which multiplies bf16 numbers and sums in f32.
//!
//! A number is the sum of two bf16 ones, `x = hi + lo` to 17 bits, and a product of three of theirs,
//! `hi·hi + hi·lo + lo·hi`. An image in that form ([`Form::Split`]) has the size of one in f32: for 32 channels one
//! cache line of `hi` and one of `lo`, so that 16 neighbouring pixels are a tile where they lie. Without `lo`
//! ([`Form::Half`]) it has half the size, and a product is one.

use super::blocked::{Form, Pixel, Store, View, ViewMut, ZERO};
use super::geometry::{Panel, Step, Strip, Weights};
use super::scratch::Slot;
use super::simd::LANES;
use super::tile::Run;
use std::arch::asm;
use std::arch::x86_64::*;

/// Channels of a pair of cache lines, and pixels that are worked on together.
pub(super) const PAIR: usize = 2 * LANES;

/// Cache lines of a tile.
const ROWS: usize = 16;

/// A convolution's filters, split, in the order in which they are read.
#[derive(Debug)]
pub(super) struct Amx {
    pairs: usize,
    stride: usize,
    /// Of the images that it is given: [`Form::Split`] or [`Form::Half`].
    pub(super) form: Form,
    panels: Vec<Panel>,
    /// For each panel `[9][pairs][lo, hi][vecs]` (in halves only `hi`) tiles of `[16 pairs of channels][16 outputs][2]`.
    filters: Vec<Pixel>,
}

/// Nearest bf16; ties to even.
fn to_bf16(x: f32) -> u16 {
    if x.is_nan() {
        return 0x7fc0;
    }
    let bits = x.to_bits();
    ((bits + 0x7fff + (bits >> 16 & 1)) >> 16) as u16
}

fn from_bf16(x: u16) -> f32 {
    f32::from_bits(u32::from(x) << 16)
}

impl Amx {
    pub(super) fn new(weights: &Weights<'_>, step: Step, form: Form) -> Self {
        let low: &[bool] = if form == Form::Half { &[false] } else { &[true, false] };
        let parts = low.len();
        let pairs = weights.inputs.div_ceil(PAIR);
        let panels = Panel::cut(weights.outputs, 2);
        let mut filters = vec![ZERO; 9 * pairs * parts * ROWS * weights.outputs.div_ceil(LANES)];
        for &Panel { block: first, vecs } in &panels {
            let panel = 9 * pairs * parts * first;
            for (block, c) in (first..first + vecs).flat_map(|block| (0..pairs * ROWS).map(move |c| (block, 2 * c))) {
                let [even, odd] = [c, c + 1].map(|c| weights.block(block, c));
                for tap in 0..9 {
                    let tile = panel + (tap * pairs + c / PAIR) * parts * vecs + block - first;
                    for (part, &low) in low.iter().enumerate() {
                        let row = (tile + part * vecs) * ROWS + c % PAIR / 2;
                        filters[row] = in_pairs(&even[tap], &odd[tap], low);
                    }
                }
            }
        }
        Self { pairs, stride: if step == Step::Half { 2 } else { 1 }, form, panels, filters }
    }
}

/// Numbers of two channels side by side in bf16, or what rounding takes away from them.
fn in_pairs(even: &Pixel, odd: &Pixel, low: bool) -> Pixel {
    let part = |x: f32| {
        let high = to_bf16(x);
        u32::from(if low { to_bf16(x - from_bf16(high)) } else { high })
    };
    Pixel(std::array::from_fn(|k| f32::from_bits(part(even.0[k]) | part(odd.0[k]) << 16)))
}

/// Shape of the tiles: 8 of 16 rows of 64 bytes.
#[repr(C, align(64))]
pub(super) struct TileConfig {
    palette: u8,
    start_row: u8,
    reserved: [u8; 14],
    row_bytes: [u16; 16],
    rows: [u8; 16],
}

pub(super) static TILES: TileConfig = {
    let (mut row_bytes, mut rows) = ([0; 16], [0; 16]);
    let mut i = 0;
    while i < 8 {
        (row_bytes[i], rows[i]) = (64, ROWS as u8);
        i += 1;
    }
    TileConfig { palette: 1, start_row: 0, reserved: [0; 14], row_bytes, rows }
};

/// Results of 32 pixels × 2 blocks of outputs.
type Results = [Pixel; 2 * PAIR];

/// Convolves a strip of a split or halved image.
///
/// # Safety
/// [`Isa::Amx`](super::isa::Isa::Amx) is available; the strip's memory is valid, and that of its input 96 pixels beyond its last row.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub(super) unsafe fn forward(conv: &Amx, bias: &[Pixel], floor: f32, strip: Strip, store: Store, slot: &mut Slot) {
    let Strip { src, dst, rows, width } = strip;
    let parts = if conv.form == Form::Half { 1 } else { 2 };
    // Two tiles of pixels are side by side, or, where a row fills but one, on two rows.
    let (down, right) = if width <= ROWS { (1, 0) } else { (0, ROWS) };
    let second = conv.stride * (down * src.row + right * LANES);
    slot.runs.clear();
    for (tap, pair) in (0..9).flat_map(|tap| (0..conv.pairs).map(move |pair| (tap, pair))) {
        let offset = parts * pair * src.block + tap / 3 * src.row + tap % 3 * LANES;
        slot.runs.push(Run { offset, len: PAIR });
    }
    let mut buffers: [Results; 2] = [[ZERO; 2 * PAIR]; 2];
    let [even, odd] = buffers.each_mut().map(|b| &raw mut *b);
    let mut filters = conv.filters.as_ptr();
    // SAFETY: the caller's contract; `filters` has what each panel takes, `bias` a pixel for each block.
    unsafe {
        asm!("ldtilecfg [{}]", in(reg) &raw const TILES, options(nostack, readonly));
        for &panel in &conv.panels {
            let bias = bias.as_ptr().add(panel.block);
            let place = Place::new(store, panel, conv.panels.len(), floor, dst);
            let multiply = match (panel.vecs, conv.form) {
                (2, Form::Half) => multiply::<2, true>,
                (_, Form::Half) => multiply::<1, true>,
                (2, _) => multiply::<2, false>,
                _ => multiply::<1, false>,
            };
            let mut previous = Pending { place: &place, results: even, tiles: [(0, 0); 2], done: 0 };
            let mut next = odd;
            for y in (0..rows).step_by(1 + down) {
                for x in (0..width).step_by(PAIR) {
                    let a = src.ptr.add(conv.stride * (y * src.row + x * LANES));
                    multiply((a, second), conv.stride, src.block, &slot.runs, filters, bias, next, &mut previous);
                    let results = std::mem::replace(&mut next, previous.results);
                    let tile = |y: usize, x: usize| {
                        let count = if y < rows { ROWS.min(width.saturating_sub(x)) } else { 0 };
                        (y * place.row + x * place.step, count)
                    };
                    previous =
                        Pending { place: &place, results, tiles: [tile(y, x), tile(y + down, x + right)], done: 0 };
                }
            }
            previous.advance(PAIR);
            filters = filters.add(slot.runs.len() * parts * panel.vecs * ROWS);
        }
        asm!("tilerelease", options(nostack, nomem));
    }
}

/// `results[pixel][v] = bias + Σ` over the runs of 16 pixels from `a` on and 16 from `second` floats after it on, `low` floats from `hi`
/// to `lo` unless `HALF`.
/// Meanwhile the vector unit puts the previous pixels in their place.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
#[allow(clippy::too_many_arguments)]
unsafe fn multiply<const V: usize, const HALF: bool>(
    (a, second): (*const f32, usize),
    stride: usize,
    low: usize,
    runs: &[Run],
    mut filters: *const Pixel,
    bias: *const Pixel,
    results: *mut Results,
    previous: &mut Pending<'_>,
) {
    let bytes = stride * size_of::<Pixel>();
    let each = PAIR.div_ceil(runs.len());
    // SAFETY: the caller gives the memory; the tiles are configured.
    unsafe {
        // a stride of 0: the same row 16 times
        asm!("tileloadd tmm0, [{b} + {s}*1]", "tileloadd tmm2, [{b} + {s}*1]", b = in(reg) bias, s = in(reg) 0usize,
            options(nostack, readonly));
        if V == 2 {
            asm!("tileloadd tmm1, [{b} + {s}*1 + 64]", "tileloadd tmm3, [{b} + {s}*1 + 64]",
                b = in(reg) bias, s = in(reg) 0usize, options(nostack, readonly));
        }
        for run in runs {
            let p = a.add(run.offset);
            let q = p.add(second);
            if HALF {
                asm!(
                    "tileloadd tmm4, [{p} + {s}*1]",
                    "tileloadd tmm5, [{q} + {s}*1]",
                    "tileloadd tmm6, [{w} + {t}*1]",
                    "tdpbf16ps tmm0, tmm4, tmm6",
                    "tdpbf16ps tmm2, tmm5, tmm6",
                    p = in(reg) p, q = in(reg) q, s = in(reg) bytes, w = in(reg) filters, t = in(reg) 64usize,
                    options(nostack, readonly),
                );
                if V == 2 {
                    asm!(
                        "tileloadd tmm7, [{w} + {t}*1 + 1024]",
                        "tdpbf16ps tmm1, tmm4, tmm7",
                        "tdpbf16ps tmm3, tmm5, tmm7",
                        w = in(reg) filters, t = in(reg) 64usize, options(nostack, readonly),
                    );
                }
            } else if V == 2 {
                asm!(
                    "tileloadd tmm4, [{p} + {s}*1]",
                    "tileloadd tmm5, [{q} + {s}*1]",
                    "tileloadd tmm6, [{w} + {t}*1]",
                    "tileloadd tmm7, [{w} + {t}*1 + 1024]",
                    "tdpbf16ps tmm0, tmm4, tmm6",
                    "tdpbf16ps tmm1, tmm4, tmm7",
                    "tdpbf16ps tmm2, tmm5, tmm6",
                    "tdpbf16ps tmm3, tmm5, tmm7",
                    "tileloadd tmm6, [{w} + {t}*1 + 2048]",
                    "tileloadd tmm7, [{w} + {t}*1 + 3072]",
                    "tdpbf16ps tmm0, tmm4, tmm6",
                    "tdpbf16ps tmm1, tmm4, tmm7",
                    "tdpbf16ps tmm2, tmm5, tmm6",
                    "tdpbf16ps tmm3, tmm5, tmm7",
                    "tileloadd tmm4, [{pl} + {s}*1]",
                    "tileloadd tmm5, [{ql} + {s}*1]",
                    "tdpbf16ps tmm0, tmm4, tmm6",
                    "tdpbf16ps tmm1, tmm4, tmm7",
                    "tdpbf16ps tmm2, tmm5, tmm6",
                    "tdpbf16ps tmm3, tmm5, tmm7",
                    p = in(reg) p, q = in(reg) q, pl = in(reg) p.add(low), ql = in(reg) q.add(low),
                    s = in(reg) bytes, w = in(reg) filters, t = in(reg) 64usize, options(nostack, readonly),
                );
            } else {
                asm!(
                    "tileloadd tmm4, [{p} + {s}*1]",
                    "tileloadd tmm5, [{q} + {s}*1]",
                    "tileloadd tmm6, [{w} + {t}*1]",
                    "tileloadd tmm7, [{w} + {t}*1 + 1024]",
                    "tdpbf16ps tmm0, tmm4, tmm6",
                    "tdpbf16ps tmm2, tmm5, tmm6",
                    "tdpbf16ps tmm0, tmm4, tmm7",
                    "tdpbf16ps tmm2, tmm5, tmm7",
                    "tileloadd tmm4, [{pl} + {s}*1]",
                    "tileloadd tmm5, [{ql} + {s}*1]",
                    "tdpbf16ps tmm0, tmm4, tmm7",
                    "tdpbf16ps tmm2, tmm5, tmm7",
                    p = in(reg) p, q = in(reg) q, pl = in(reg) p.add(low), ql = in(reg) q.add(low),
                    s = in(reg) bytes, w = in(reg) filters, t = in(reg) 64usize, options(nostack, readonly),
                );
            }
            filters = filters.add(if HALF { V * ROWS } else { 2 * V * ROWS });
            previous.advance(each);
        }
        let r = results.cast::<Pixel>();
        asm!("tilestored [{r} + {s}*1], tmm0", "tilestored [{r} + {s}*1 + 2048], tmm2", r = in(reg) r,
            s = in(reg) 2 * size_of::<Pixel>(), options(nostack));
        if V == 2 {
            asm!("tilestored [{r} + {s}*1 + 64], tmm1", "tilestored [{r} + {s}*1 + 2112], tmm3", r = in(reg) r,
                s = in(reg) 2 * size_of::<Pixel>(), options(nostack));
        }
    }
}

/// Where a panel's results go: pixel `(y, x)` at `ptr + y·row + x·step`, its second cache line `second` further.
struct Place {
    ptr: *mut f32,
    row: usize,
    step: usize,
    second: usize,
    vecs: usize,
    floor: f32,
    store: Store,
}

impl Place {
    fn new(store: Store, panel: Panel, panels: usize, floor: f32, dst: ViewMut) -> Self {
        let ViewMut { ptr, block, row } = dst;
        let vecs = panel.vecs;
        let (first, row, step) = match store {
            Store::As(Form::Half) => (panel.block / 2 * block, row, LANES),
            Store::As(_) => (panel.block * block, row, LANES),
            Store::AddShuffled(form) => {
                let (pair, each) = (panel.block / 2, panels / 4);
                let (phase, pair) = (pair / each, pair % each);
                let first = if form == Form::Half { pair * block } else { 2 * pair * block };
                (first + phase / 2 * row + phase % 2 * LANES, 2 * row, 2 * LANES)
            }
        };
        Self { ptr: ptr.wrapping_add(first), row, step, second: block, vecs, floor, store }
    }
}

/// Results of two tiles of pixels, of which `done` have been put in their place.
struct Pending<'a> {
    place: &'a Place,
    results: *mut Results,
    /// Where the first pixel of each goes, in floats, and how many of its 16 there are.
    tiles: [(usize, usize); 2],
    done: usize,
}

impl Pending<'_> {
    /// Puts the next `pixels` in their place.
    #[inline]
    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    unsafe fn advance(&mut self, pixels: usize) {
        let &Place { ptr, step, second, vecs, floor, store, .. } = self.place;
        let floor = _mm512_set1_ps(floor);
        let end = PAIR.min(self.done + pixels);
        while self.done < end {
            let ((first, count), i) = (self.tiles[self.done / ROWS], self.done % ROWS);
            if i >= count {
                self.done += 1;
                continue;
            }
            // SAFETY: the caller gives the memory of the pixels; two vectors of results each.
            unsafe {
                let out = ptr.add(first + i * step);
                let values = self.results.cast::<f32>().add(2 * self.done * LANES);
                // MAXPS gives its second operand when one is NaN
                let a = _mm512_max_ps(floor, _mm512_load_ps(values));
                let b = if vecs == 2 {
                    _mm512_max_ps(floor, _mm512_load_ps(values.add(LANES)))
                } else {
                    _mm512_setzero_ps()
                };
                match store {
                    Store::As(Form::Single) => {
                        _mm512_storeu_ps(out, a);
                        if vecs == 2 {
                            _mm512_storeu_ps(out.add(second), b);
                        }
                    }
                    Store::As(Form::Split) => store_split(a, b, out, out.add(second)),
                    Store::As(Form::Half) => _mm512_storeu_si512(out.cast(), rounded(a, b)),
                    Store::AddShuffled(Form::Half) => {
                        let there = widen(_mm512_loadu_si512(out.cast()));
                        let sum = rounded(_mm512_add_ps(a, there.0), _mm512_add_ps(b, there.1));
                        _mm512_storeu_si512(out.cast(), sum);
                    }
                    Store::AddShuffled(_) => {
                        let [high, low] = [out, out.add(second)].map(|p| widen(_mm512_loadu_si512(p.cast())));
                        let a = _mm512_add_ps(a, _mm512_add_ps(high.0, low.0));
                        let b = _mm512_add_ps(b, _mm512_add_ps(high.1, low.1));
                        store_split(a, b, out, out.add(second));
                    }
                }
            }
            self.done += 1;
        }
    }
}

/// 32 bf16 numbers as f32.
#[inline]
#[target_feature(enable = "avx512f,avx512bw")]
pub(super) fn widen(x: __m512i) -> (__m512, __m512) {
    let half = |x: __m256i| _mm512_castsi512_ps(_mm512_slli_epi32::<16>(_mm512_cvtepu16_epi32(x)));
    (half(_mm512_castsi512_si256(x)), half(_mm512_extracti64x4_epi64::<1>(x)))
}

/// Writes 32 numbers as `hi` and `lo`.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn store_split(a: __m512, b: __m512, high: *mut f32, low: *mut f32) {
    let nearest = rounded(a, b);
    let (high_a, high_b) = widen(nearest);
    let rest = rounded(_mm512_sub_ps(a, high_a), _mm512_sub_ps(b, high_b));
    // SAFETY: the caller gives the memory.
    unsafe {
        _mm512_storeu_si512(high.cast(), nearest);
        _mm512_storeu_si512(low.cast(), rest);
    }
}

/// 32 numbers as bf16.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub(super) fn rounded(a: __m512, b: __m512) -> __m512i {
    // SAFETY: both types are 64 bytes of any content.
    unsafe { std::mem::transmute::<__m512bh, __m512i>(_mm512_cvtne2ps_pbh(b, a)) }
}

/// Splits or halves `count` pixels of `channels` channels in a row; `src` and `dst` may be the same if they are split. Whatever
/// the lanes beyond the last channel hold, zeros stand for it: the matrix unit multiplies them too.
///
/// # Safety
/// [`Isa::Amx`](super::isa::Isa::Amx) is available; `src` has the pixels, `dst` room for them, rounded up to an even number of blocks.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub(super) unsafe fn convert(src: View, channels: usize, count: usize, dst: ViewMut, form: Form) {
    let (src_block, dst_block) = (src.block, dst.block);
    let each = if form == Form::Half { PAIR } else { LANES };
    for c in (0..channels).step_by(PAIR) {
        let used = |from: usize| (1u32 << channels.saturating_sub(from).min(LANES)).wrapping_sub(1) as u16;
        let (first, second) = (used(c), used(c + LANES));
        let (src, dst) = (src.ptr.wrapping_add(c / LANES * src.block), dst.ptr.wrapping_add(c / each * dst.block));
        for i in 0..count {
            // SAFETY: the caller's contract; of a block that `src` lacks nothing is loaded.
            unsafe {
                let (p, out) = (src.add(i * LANES), dst.add(i * LANES));
                let (a, b) =
                    (_mm512_maskz_loadu_ps(first, p), _mm512_maskz_loadu_ps(second, p.wrapping_add(src_block)));
                match form {
                    Form::Half => _mm512_storeu_si512(out.cast(), rounded(a, b)),
                    _ => store_split(a, b, out, out.wrapping_add(dst_block)),
                }
            }
        }
    }
}
