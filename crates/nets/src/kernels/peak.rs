//! What the register tile reaches when nothing waits for memory: the yardstick of the benchmarks.

use super::blocked::{Pixel, ZERO};
use super::error::KernelError;
use super::isa::Isa;
use super::simd::{LANES, Simd, entry};
use super::tile::{Out, Run, product};
use rayon::prelude::*;
use std::time::Instant;

/// Matrix product of the peak measurement: pixels, summed channels.
const ROWS: usize = 56;
const DEPTH: usize = 64;

entry!(fn repeat = repeat_product(times: usize, a: &[Pixel], w: &[Pixel], out: &mut [Pixel]));

#[inline(always)]
unsafe fn repeat_product<S: Simd>(times: usize, a: &[Pixel], w: &[Pixel], out: &mut [Pixel]) {
    let mut runs = [Run { offset: 0, len: LANES }; DEPTH / LANES];
    let mut i = 0;
    while i < runs.len() {
        runs[i].offset = i * ROWS * LANES;
        i += 1;
    }
    let init = [ZERO; 2];
    let mut i = 0;
    while i < times {
        // SAFETY: `a` is [DEPTH/16][ROWS][16], `w` [DEPTH][VECS·16], `out` [VECS][ROWS][16].
        unsafe {
            product::<S, LANES>(
                S::VECS,
                ROWS,
                a.as_ptr().cast(),
                &runs,
                w.as_ptr().cast(),
                init.as_ptr().cast(),
                f32::NEG_INFINITY,
                Out { ptr: out.as_mut_ptr().cast(), step: LANES, vec_step: ROWS * LANES },
            );
        }
        i += 1;
    }
}

/// FLOP/s of a 56 × 64 × (16 or 32) product in the first-level cache, on all threads of the current pool at once.
///
/// # Errors
/// [`KernelError::MissingIsa`].
pub fn gemm_peak(isa: Isa) -> Result<f64, KernelError> {
    const TIMES: usize = 20_000;
    let isa = isa.checked()?;
    let threads = rayon::current_num_threads();
    let flop = (2 * TIMES * ROWS * DEPTH * isa.vecs() * LANES * threads) as f64;
    let mut best = f64::INFINITY;
    for _ in 0..5 {
        let start = Instant::now();
        (0..threads).into_par_iter().with_max_len(1).for_each(|_| {
            let a = vec![ZERO; ROWS * DEPTH / LANES];
            let w = vec![ZERO; DEPTH * isa.vecs()];
            let mut out = vec![ZERO; ROWS * isa.vecs()];
            // SAFETY: sizes as `repeat_product` says; `isa` is available.
            unsafe { repeat(isa, TIMES, &a, &w, &mut out) };
            std::hint::black_box(&out);
        });
        best = best.min(start.elapsed().as_secs_f64());
    }
    Ok(flop / best)
}
