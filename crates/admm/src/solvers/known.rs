//! How well an iterate is known, which sets the damping of the data step where noise is known of.

use crate::progress;
use ndarray::{ArrayView3, Zip};
use sci_forward::Measurement;

/// How well a video v is known, from its residual and the noise: `Σ r² ≈ Σ n + mse · Σ diag(H Hᵀ)` over the open pixels.
///
/// With σ_k² = mse the likeliest video, `argmin_x ‖y − H x‖²/n + ‖x − v‖²/σ_k²`, is the data step damped by n / σ_k², pixel by pixel.
#[derive(Clone, Copy)]
pub(super) struct Known {
    /// 1 / mse; 0 where no noise is known of.
    pub(super) precision: f32,
    /// Whether noise alone would leave as large a residual.
    pub(super) within_noise: bool,
}

/// The least mean square error that a video is taken to have, 52 dB: the residual of one that has nearly as much as the noise alone says no
/// more.
const LEAST_ERROR: f64 = 6e-6;

impl Known {
    /// Of v `[T, H, W]`. It reads v once, and not at all where no noise is known of.
    pub(super) fn of(measurement: &Measurement, v: ArrayView3<'_, f32>) -> Self {
        let Some(variance) = measurement.variance() else { return Self { precision: 0.0, within_noise: false } };
        let gram = measurement.operator().gram();
        let (noise, open) = Zip::from(variance).and(gram).fold((0f64, 0f64), |(noise, open), &n, &gram| {
            if gram > 0.0 { (noise + f64::from(n), open + f64::from(gram)) } else { (noise, open) }
        });
        let residual = progress(measurement, v, v).residual;
        let error = ((residual - noise) / open).max(LEAST_ERROR);
        Self { precision: (1.0 / error) as f32, within_noise: residual <= noise }
    }
}
