//! The two register tiles that do all multiplications of f32 numbers, direct and Winograd alike.
//!
//! * [`product`]: a row of pixels times a panel of output channels, summed over input channels (and filter taps);
//! * [`outer`]: a few input channels times a panel of output channels, summed over pixels, for the weight gradient.
//!
//! Every output number is one chain of multiply-adds in an order that does not depend on how a row is cut into tiles.

use super::simd::{LANES, Simd};

/// `len` channels that lie `offset` floats after the pixel's first one.
#[derive(Debug, Clone, Copy)]
pub(super) struct Run {
    pub(super) offset: usize,
    pub(super) len: usize,
}

/// Where [`product`] writes: pixel `t`, vector `v` at `ptr + t·step + v·vec_step`.
#[derive(Clone, Copy)]
pub(super) struct Out {
    pub(super) ptr: *mut f32,
    pub(super) step: usize,
    pub(super) vec_step: usize,
}

/// `out[t] = max(init + Σ_runs Σ_c a[t·STEP + run + c] · w[..][c], floor)` for `count` pixels and `vecs` vectors.
///
/// `w` holds, for each channel of each run in turn, `vecs` vectors of output channels; `init` holds `vecs` vectors.
///
/// # Safety
/// All that is read and written must be valid memory, `vecs` in `1..=S::VECS`; `S`'s instruction set is there.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
pub(super) unsafe fn product<S: Simd, const STEP: usize>(
    vecs: usize,
    count: usize,
    a: *const f32,
    runs: &[Run],
    w: *const f32,
    init: *const f32,
    floor: f32,
    out: Out,
) {
    // SAFETY: the caller's contract.
    unsafe {
        if S::VECS == 2 && vecs == 2 {
            split::<S, STEP, 2>(count, a, runs, w, init, floor, out);
        } else {
            split::<S, STEP, 1>(count, a, runs, w, init, floor, out);
        }
    }
}

/// `in_tiles!(most, count, |done, ROWS| tile)` cuts a row of `count` into the fewest tiles of at most `most`, all nearly equal, so that none is too
/// narrow to hide the latency of its adds, and runs `tile` for each, with the number of those before it and, as a constant, its own.
macro_rules! in_tiles {
    ($most:expr, $count:expr, |$done:ident, $rows:ident| $tile:expr) => {{
        let tiles = $count.div_ceil($most);
        let mut $done = 0;
        let mut i = 0;
        while i < tiles {
            let rows = ($count - $done).div_ceil(tiles - i);
            $crate::kernels::tile::in_tiles!(@ rows, $most, $rows, $tile, 1 2 3 4 5 6 7 8 9 10 11 12 13 14);
            $done += rows;
            i += 1;
        }
    }};
    (@ $found:ident, $most:expr, $rows:ident, $tile:expr, $($n:literal)*) => {
        match $found {
            $($n if $n <= $most => {
                const $rows: usize = $n;
                $tile
            })*
            _ => unreachable!("a tile has 1 to {} rows", $most),
        }
    };
}
pub(super) use in_tiles;

#[inline(always)]
unsafe fn split<S: Simd, const STEP: usize, const V: usize>(
    count: usize,
    a: *const f32,
    runs: &[Run],
    w: *const f32,
    init: *const f32,
    floor: f32,
    out: Out,
) {
    // SAFETY: the caller's contract, for the pixels from `done` on.
    in_tiles!(S::ROWS, count, |done, ROWS| unsafe {
        let out = Out { ptr: out.ptr.add(done * out.step), ..out };
        tile::<S, STEP, V, ROWS>(a.add(done * STEP), runs, w, init, floor, out);
    });
}

#[inline(always)]
unsafe fn tile<S: Simd, const STEP: usize, const V: usize, const R: usize>(
    a: *const f32,
    runs: &[Run],
    mut w: *const f32,
    init: *const f32,
    floor: f32,
    out: Out,
) {
    // SAFETY: the caller's contract.
    unsafe {
        let mut acc = [[S::splat(0.0); V]; R];
        let mut v = 0;
        while v < V {
            let start = S::load(init.add(v * LANES));
            let mut r = 0;
            while r < R {
                acc[r][v] = start;
                r += 1;
            }
            v += 1;
        }
        let mut i = 0;
        while i < runs.len() {
            let run = *runs.get_unchecked(i);
            let mut p = a.add(run.offset);
            let end = p.add(run.len);
            while p < end {
                let mut b = [S::splat(0.0); V];
                let mut v = 0;
                while v < V {
                    b[v] = S::load(w.add(v * LANES));
                    v += 1;
                }
                let mut r = 0;
                while r < R {
                    let x = S::splat(*p.add(r * STEP));
                    let mut v = 0;
                    while v < V {
                        acc[r][v] = x.fma(b[v], acc[r][v]);
                        v += 1;
                    }
                    r += 1;
                }
                w = w.add(V * LANES);
                p = p.add(1);
            }
            i += 1;
        }
        let floor = S::splat(floor);
        let mut r = 0;
        while r < R {
            let mut v = 0;
            while v < V {
                acc[r][v].at_least(floor).store(out.ptr.add(r * out.step + v * out.vec_step));
                v += 1;
            }
            r += 1;
        }
    }
}

/// `acc[c] += Σ_t a[t·STEP + c] · b[t·16]` for `channels` input channels and `vecs` vectors of output channels.
///
/// `b`'s vectors lie `b_vec_step` apart; `acc` holds `vecs` vectors for each channel in turn.
///
/// # Safety
/// All that is read and written must be valid memory, `vecs` in `1..=S::VECS`; `S`'s instruction set is there.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
pub(super) unsafe fn outer<S: Simd, const STEP: usize>(
    vecs: usize,
    channels: usize,
    count: usize,
    a: *const f32,
    b: *const f32,
    b_vec_step: usize,
    acc: *mut f32,
) {
    let mut done = 0;
    while done < channels {
        let rows = (channels - done).min(S::GRAD_ROWS);
        // SAFETY: the caller's contract, for the channels from `done` on.
        unsafe {
            let a = a.add(done);
            let acc = acc.add(done * vecs * LANES);
            macro_rules! by_rows {
                ($v:literal: $($n:literal)*) => {
                    match rows {
                        $($n if $n <= S::GRAD_ROWS => outer_tile::<S, STEP, $v, $n>(count, a, b, b_vec_step, acc),)*
                        _ => unreachable!("a tile has 1 to GRAD_ROWS rows"),
                    }
                };
            }
            if S::VECS == 2 && vecs == 2 {
                by_rows!(2: 1 2 3 4 5 6 7 8);
            } else {
                by_rows!(1: 1 2 3 4 5 6 7 8);
            }
        }
        done += rows;
    }
}

#[inline(always)]
unsafe fn outer_tile<S: Simd, const STEP: usize, const V: usize, const R: usize>(
    count: usize,
    mut a: *const f32,
    mut b: *const f32,
    b_vec_step: usize,
    out: *mut f32,
) {
    // SAFETY: the caller's contract.
    unsafe {
        let mut acc = [[S::splat(0.0); V]; R];
        let mut t = 0;
        while t < count {
            let mut w = [S::splat(0.0); V];
            let mut v = 0;
            while v < V {
                w[v] = S::load(b.add(v * b_vec_step));
                v += 1;
            }
            let mut r = 0;
            while r < R {
                let x = S::splat(*a.add(r));
                let mut v = 0;
                while v < V {
                    acc[r][v] = x.fma(w[v], acc[r][v]);
                    v += 1;
                }
                r += 1;
            }
            a = a.add(STEP);
            b = b.add(LANES);
            t += 1;
        }
        let mut r = 0;
        while r < R {
            let mut v = 0;
            while v < V {
                let p = out.add((r * V + v) * LANES);
                S::load(p).add(acc[r][v]).store(p);
                v += 1;
            }
            r += 1;
        }
    }
}
