//! Owns what networks may be spared in a solve, and the count of what they did and were spared.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use admm::{BoxError, Call, Denoiser, Dimmed, Flips, TileCounter, TileCounts, Tiles};
use ndarray::{ArrayView4, ArrayViewMut4};
use nets::kernels::Precision;
use nets::{MixedPrecision, PrecisionCounter, PrecisionCounts, SelectPrecision};
use sci_forward::Measurement;

use super::Inference;

/// Sides of frames that no network has to continue: they work at an eighth of the size at least.
const MULTIPLE: usize = 8;

/// What networks did and were spared in a solve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Work {
    /// The share of the pixels of all calls that was left out.
    pub skipped_tiles: f64,
    /// The share of what networks did that was in bf16 because the solve would not notice.
    pub halved: f64,
    /// Multiply-adds of all calls, in units of 1e9; nothing where no network ran.
    pub gmac: Option<f64>,
}

/// Counts the multiply-adds of networks' calls; clones count together.
#[derive(Clone, Debug, Default)]
pub struct MultiplyAdds(Arc<AtomicU64>);

impl MultiplyAdds {
    /// Counts a call.
    pub fn add(&self, pixels: usize, of_each: f64) {
        self.0.fetch_add((pixels as f64 * of_each).round() as u64, Ordering::Relaxed);
    }

    /// What was counted since the last time, in units of 1e9.
    pub fn take(&self) -> Option<f64> {
        let count = self.0.swap(0, Ordering::Relaxed);
        (count > 0).then_some(count as f64 / 1e9)
    }
}

/// What networks may be spared of a measurement, and what they were.
#[derive(Debug, Default)]
pub struct Saving {
    /// Which tiles stand still; nothing when all are wanted.
    still: Option<Vec<bool>>,
    half_precision: bool,
    tiles: Vec<Arc<TileCounter>>,
    halves: Vec<Arc<PrecisionCounter>>,
    multiply_adds: MultiplyAdds,
}

impl Saving {
    /// For the solve of a measurement.
    pub fn new(tiles: bool, half_precision: bool, measurement: &Measurement, multiply_adds: MultiplyAdds) -> Self {
        let still = tiles.then(|| admm::still(measurement));
        Self { still, half_precision, multiply_adds, ..Self::default() }
    }

    /// A network that takes `multiply_adds` for each pixel of each frame.
    pub(super) fn network<'a, D: SelectPrecision>(
        &mut self,
        net: &'a mut D,
        inference: &Inference,
        multiply_adds: f64,
    ) -> Box<dyn Denoiser + 'a> {
        let mut denoiser: Box<dyn Denoiser + 'a> = if self.half_precision && inference.precision == Precision::F32 {
            let mixed = MixedPrecision::new(net);
            self.halves.push(mixed.counter());
            Box::new(mixed)
        } else {
            Box::new(net)
        };
        denoiser = Box::new(Counted { inner: denoiser, multiply_adds, count: self.multiply_adds.clone() });
        if inference.flips {
            denoiser = Box::new(Flips::new(denoiser).continued_to(MULTIPLE));
        }
        if inference.dim != 1.0 {
            denoiser = Box::new(Dimmed::new(denoiser, inference.dim));
        }
        self.tiles(denoiser)
    }

    /// Any denoiser.
    pub(super) fn tiles<'a>(&mut self, denoiser: impl Denoiser + 'a) -> Box<dyn Denoiser + 'a> {
        let Some(still) = &self.still else { return Box::new(denoiser) };
        let tiles = Tiles::new(denoiser, still);
        self.tiles.push(tiles.counter());
        Box::new(tiles)
    }

    /// What was done, and was not.
    pub fn work(&self) -> Work {
        let (mut tiles, mut halves) = (TileCounts::default(), PrecisionCounts::default());
        for TileCounts { asked, done } in self.tiles.iter().map(|counter| counter.counts()) {
            (tiles.asked, tiles.done) = (tiles.asked + asked, tiles.done + done);
        }
        for PrecisionCounts { asked, halved } in self.halves.iter().map(|counter| counter.counts()) {
            (halves.asked, halves.halved) = (halves.asked + asked, halves.halved + halved);
        }
        Work { skipped_tiles: tiles.skipped(), halved: halves.share(), gmac: self.multiply_adds.take() }
    }
}

/// The decorator that counts what its network is asked for.
struct Counted<'a> {
    inner: Box<dyn Denoiser + 'a>,
    multiply_adds: f64,
    count: MultiplyAdds,
}

impl Denoiser for Counted<'_> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn denoise(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        let (frames, _, height, width) = noisy.dim();
        self.count.add(frames * height * width, self.multiply_adds);
        self.inner.denoise(call, noisy, out)
    }
}
