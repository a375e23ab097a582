//! How well an iterate is known, which sets the damping of the data step where noise is known of.

use crate::progress;
use ndarray::ArrayView3;
use sci_forward::Measurement;

/// How well the iterates v of a solve are known, by their residuals: the mean square error that would leave as much,
/// `mse = ‖y − H v‖² / Σ diag(H Hᵀ)`, but no less than [`FALL`] of that of the iterate before.
///
/// With σ_k² = mse the likeliest video, `argmin_x ‖y − H x‖²/n + ‖x − v‖²/σ_k²`, is the data step damped by n / σ_k², pixel by pixel.
///
/// The noise is not taken off the residual, as v has taken up a part of it already: what is left beyond the noise says 3 to 20 times
/// too little, and jumps to nothing and back, by which accelerated GAP lost 4 dB. With it the step is never damped by much more than
/// diag(H Hᵀ). `docs/noise.md` has the figures.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Known {
    error: f64,
    /// Of the last iterate.
    pub(super) precision: f32,
}

/// The least mean square error that a video is taken to have, 52 dB.
const LEAST_ERROR: f64 = 6e-6;
/// The least share of the error that an iteration leaves: one small residual does not make a video known.
const FALL: f64 = 0.7;

impl Known {
    /// 1 / mse of the next iterate v `[T, H, W]`; 0 where no noise is known of, and v is not read then.
    pub(super) fn precision(&mut self, measurement: &Measurement, v: ArrayView3<'_, f32>) -> f32 {
        if measurement.variance().is_none() {
            return 0.0;
        }
        let open: f64 = measurement.operator().gram().iter().map(|&gram| f64::from(gram)).sum();
        let error = progress(measurement, v, v).residual / open.max(f64::MIN_POSITIVE);
        self.error = error.max(FALL * self.error).max(LEAST_ERROR);
        self.precision = (1.0 / self.error) as f32;
        self.precision
    }
}
