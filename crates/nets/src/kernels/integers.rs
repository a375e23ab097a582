//! 16-bit integers in place of f32 numbers, for inference: a product sums two channels at once, in twice as many lanes.
//!
//! Nothing can overflow: pixels are at most `most` (`32,767` or less) by the largest that is read, and an output's filters are scaled so
//! that their sum times `most` stays below 2³¹. Sums are exact; the errors are those of rounding either factor, and other instruction sets
//! give the same sums.

use super::blocked::View;
use super::simd::{LANES, Pairs};
use super::tile::{Out, Run, in_tiles};
use std::ops::Range;

/// Largest 16-bit integer.
const LARGEST: f64 = 32_767.0;

/// What to multiply an output's `count` filters by, to round them for pixels of at most `most`; 0 where all are 0, NaN where one is not finite.
pub(super) fn filter_scale(filters: impl Iterator<Item = f64>, count: usize, most: f64) -> f64 {
    let (sum, largest) = filters.fold((0.0, 0f64), |(sum, largest), u| (sum + u.abs(), largest.max(u.abs())));
    // Rounding adds at most a half to each.
    let most_sum = (f64::from(i32::MAX) / most).floor() - count as f64;
    match sum {
        0.0 => 0.0,
        _ if sum.is_finite() => (LARGEST / largest).min(most_sum / sum),
        _ => f64::NAN,
    }
}

/// What sums are to be multiplied by after that, for pixels of at most 1 that became at most `most`.
pub(super) fn sum_scale(filter_scale: f64, most: f64) -> f32 {
    if filter_scale == 0.0 { 0.0 } else { (1.0 / (most * filter_scale)) as f32 }
}

/// What to multiply pixels by, of which `largest` is the largest, so that none is beyond `most`; 0 where there is next to nothing.
pub(super) fn pixel_scale(largest: f32, most: f64) -> f64 {
    if largest > 1e-30 { most / f64::from(largest) } else { 0.0 }
}

/// A lane of pairs with another number in that place, 0 or 1.
pub(super) fn with_half(pair: f32, place: usize, number: i16) -> f32 {
    let (shift, bits) = (16 * place as u32, u32::from(number as u16));
    f32::from_bits(pair.to_bits() & !(0xffff << shift) | bits << shift)
}

/// The largest |pixel| of these rows and columns of all `channels`; NaN if one is not finite. Lanes beyond the last channel are not looked at.
#[inline(always)]
pub(super) unsafe fn largest<S: Pairs>(src: View, channels: usize, rows: Range<usize>, columns: Range<usize>) -> f32 {
    // SAFETY: the caller gives the pixels; [`MAGNITUDES`] has twice as many lanes.
    unsafe {
        let mut most = S::NO_SUMS;
        let mut b = 0;
        while b * LANES < channels {
            let beyond = LANES.saturating_sub(channels - b * LANES);
            let bits = S::load_pairs(MAGNITUDES.as_ptr().add(beyond).cast());
            let mut y = rows.start;
            while y < rows.end {
                let row = src.ptr.add(b * src.block + y * src.row);
                let mut x = columns.start;
                while x < columns.end {
                    most = S::load(row.add(x * LANES)).larger(bits, most);
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

/// The bits of a magnitude in 16 lanes, then none.
static MAGNITUDES: [i32; 2 * LANES] = {
    let mut bits = [0; 2 * LANES];
    let mut lane = 0;
    while lane < LANES {
        bits[lane] = i32::MAX;
        lane += 1;
    }
    bits
};

/// What becomes of sums.
pub(super) trait Finish<S: Pairs>: Copy {
    /// Of those of vector `v` of a panel.
    unsafe fn finish(self, v: usize, sums: S) -> S;
}

/// `out[t] = finish(Σ_runs Σ_c a[t·STEP + run + c] · w[..][c])` for `count` pixels and `vecs` vectors. Runs are of whole pairs, and `w` holds, for
/// each pair of channels of each run in turn, `vecs` vectors of pairs.
///
/// # Safety
/// As of [`super::tile::product`].
#[inline(always)]
pub(super) unsafe fn product<S: Pairs, const STEP: usize>(
    vecs: usize,
    count: usize,
    a: *const i16,
    runs: &[Run],
    w: *const i16,
    finish: impl Finish<S>,
    out: Out,
) {
    // SAFETY: the caller's contract.
    unsafe {
        if S::VECS == 2 && vecs == 2 {
            split::<S, STEP, 2>(count, a, runs, w, finish, out);
        } else {
            split::<S, STEP, 1>(count, a, runs, w, finish, out);
        }
    }
}

#[inline(always)]
unsafe fn split<S: Pairs, const STEP: usize, const V: usize>(
    count: usize,
    a: *const i16,
    runs: &[Run],
    w: *const i16,
    finish: impl Finish<S>,
    out: Out,
) {
    // SAFETY: the caller's contract, for the pixels from `done` on.
    in_tiles!(S::ROWS, count, |done, ROWS| unsafe {
        let out = Out { ptr: out.ptr.add(done * out.step), ..out };
        tile::<S, STEP, V, ROWS>(a.add(done * STEP), runs, w, finish, out);
    });
}

#[inline(always)]
unsafe fn tile<S: Pairs, const STEP: usize, const V: usize, const R: usize>(
    a: *const i16,
    runs: &[Run],
    mut w: *const i16,
    finish: impl Finish<S>,
    out: Out,
) {
    // SAFETY: the caller's contract.
    unsafe {
        let mut sums = [[S::NO_SUMS; V]; R];
        let mut i = 0;
        while i < runs.len() {
            let run = *runs.get_unchecked(i);
            let mut p = a.add(run.offset);
            let end = p.add(run.len);
            while p < end {
                let mut pairs = [S::NO_SUMS; V];
                let mut v = 0;
                while v < V {
                    pairs[v] = S::load_pairs(w.add(v * 2 * LANES));
                    v += 1;
                }
                let mut r = 0;
                while r < R {
                    let x = S::splat_pair(p.add(r * STEP));
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
            i += 1;
        }
        let mut v = 0;
        while v < V {
            let mut r = 0;
            while r < R {
                finish.finish(v, S::to_single(sums[r][v])).store(out.ptr.add(r * out.step + v * out.vec_step));
                r += 1;
            }
            v += 1;
        }
    }
}

/// As [`entry`](super::simd::entry), of a body over [`Pairs`]. Its safety contract: that of the body, and `isa.multiplies_integers()`.
macro_rules! entry_in_integers {
    ($(#[$doc:meta])* $vis:vis fn $name:ident = $body:ident($($arg:ident: $ty:ty),* $(,)?)) => {
        $(#[$doc])*
        $vis unsafe fn $name(isa: $crate::kernels::isa::Isa, $($arg: $ty),*) {
            #[target_feature(enable = "avx512f,avx512vnni")]
            unsafe fn avx512($($arg: $ty),*) {
                // SAFETY: the features of this function, and the caller's contract.
                unsafe { $body::<$crate::kernels::simd::Avx512>($($arg),*) }
            }
            #[target_feature(enable = "avx2,fma")]
            unsafe fn avx2($($arg: $ty),*) {
                // SAFETY: as above.
                unsafe { $body::<$crate::kernels::simd::Avx2>($($arg),*) }
            }
            // SAFETY: what the instruction set needs is there, which is the caller's promise.
            unsafe {
                match isa {
                    $crate::kernels::isa::Isa::Avx512 => avx512($($arg),*),
                    _ => avx2($($arg),*),
                }
            }
        }
    };
}
pub(super) use entry_in_integers;
