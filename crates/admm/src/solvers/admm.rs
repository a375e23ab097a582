//! The alternating direction method of multipliers with one splitting.

use super::known::Known;
use crate::{Call, DataStep, Estimate, Prior, PriorError, Progress, Solver};
use ndarray::Array3;
use sci_forward::Measurement;

/// ADMM for `min ½‖y − H x‖² + λ g(θ)` subject to `x = θ`, scaled dual `b`:
///
/// ```text
/// x ← (θ + b) + Hᵀ (y − H (θ + b)) / (diag(H Hᵀ) + γ)
/// θ ← D_σ(x − b)
/// b ← b − (x − θ)
/// ```
///
/// The estimate is `θ`, not clipped. `γ = 0` with `b = 0` is plain GAP.
///
/// Where noise of variance n is known of ([`Measurement::with_noise`]), y is not explained more closely than it allows: diag(H Hᵀ) + γ becomes
/// diag(H Hᵀ) + γ + n / mse(θ), the error of θ being told by its residual.
///
/// All that is kept between iterations is `z = x − b`, the prior's input: with it `b = θ − z`, so that the data step and both
/// subtractions are one pass, `z ← θ + Hᵀ (y − H (2θ − z)) / (diag(H Hᵀ) + γ)` (Douglas and Rachford's form of ADMM).
///
/// # References
/// Boyd et al., *Distributed optimization and statistical learning via ADMM*, 2011; Chan et al., *Plug-and-play ADMM*, 2017;
/// Eckstein and Bertsekas, *On the Douglas–Rachford splitting method*, 1992.
#[derive(Debug, Clone)]
pub struct Admm<P> {
    prior: P,
    gamma: f32,
    known: Known,
    /// z `[T, H, W]`, and the memory for the next.
    z: Array3<f32>,
    next_z: Array3<f32>,
}

impl<P: Prior> Admm<P> {
    /// ADMM with penalty `γ ≥ 0` on `x − θ`, in the unit of `diag(H Hᵀ)`.
    ///
    /// # Panics
    /// If γ is negative or not finite.
    pub fn new(prior: P, gamma: f32) -> Self {
        assert!(gamma >= 0.0 && gamma.is_finite(), "γ = {gamma} must be finite and at least 0");
        let (z, next_z) = (Array3::zeros((0, 0, 0)), Array3::zeros((0, 0, 0)));
        Self { prior, gamma, known: Known::default(), z, next_z }
    }

    /// The z after θ, and how far θ has come.
    fn data_step(&mut self, measurement: &Measurement, previous: &Estimate, theta: &Estimate) -> Progress {
        let Self { gamma, known, z, next_z, .. } = self;
        let previous = Some(previous.sensor.view());
        let precision = known.precision(measurement, theta.sensor.view());
        let step = DataStep { damping: *gamma, precision, mirror: Some(z.view()), previous, ..DataStep::default() };
        let progress = step.apply(measurement, theta.sensor.view(), next_z.view_mut());
        std::mem::swap(z, next_z);
        progress
    }
}

impl<P: Prior> Solver for Admm<P> {
    fn start(&mut self, measurement: &Measurement, from: &Estimate) {
        self.known = Known::default();
        // With b = 0 the mirror is θ itself.
        self.z = from.sensor.clone();
        self.next_z = Array3::zeros(from.sensor.dim());
        self.data_step(measurement, from, from);
    }

    fn step(
        &mut self,
        measurement: &Measurement,
        call: &Call<'_>,
        previous: &Estimate,
        next: &mut Estimate,
    ) -> Result<Progress, PriorError> {
        self.prior.apply(call, self.z.view(), next)?;
        Ok(self.data_step(measurement, previous, next))
    }
}
