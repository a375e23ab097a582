//! Generalised alternating projection.

use super::known::Known;
use crate::{Call, DataStep, Estimate, Prior, PriorError, Progress, Solver};
use ndarray::{Array2, Array3};
use sci_forward::Measurement;

/// Where the accumulated measurement `y1` of accelerated GAP starts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MomentumStart {
    /// `y1 = 0`, the reference code: the first step then aims at `y − 2 H x0` instead of `y − H x0`.
    Zero,
    /// `y1 = y`: from a normalised start it needs about half the iterations.
    Measurement,
}

/// Generalised alternating projection: project onto `{x : H x = y}`, then denoise.
///
/// ```text
/// plain        x ← v + Hᵀ (y − H v) / diag(H Hᵀ)                              v ← D_σ(x)
/// accelerated  y1 ← y1 + (y − H v);  x ← v + Hᵀ (y1 − H v) / diag(H Hᵀ)       v ← D_σ(x)
/// ```
///
/// Where noise of variance n is known of ([`Measurement::with_noise`]), x is the likeliest video instead of the projection:
/// diag(H Hᵀ) becomes diag(H Hᵀ) + n / mse(v), the error of v being told by its residual, and y1 adds up that share of y − H v only
/// that the step takes: diag(H Hᵀ) of the divisor. The rest is noise.
///
/// The estimate is `v`, not clipped. On a color sensor x and v are mosaics, and the prior knows an RGB video behind v.
///
/// # References
/// Liao, Li, Carin, *Generalized alternating projection for weighted-ℓ2,1 minimization*, 2014;
/// Yuan, *Generalized alternating projection based total variation minimization for compressive sensing*, 2016.
#[derive(Debug, Clone)]
pub struct Gap<P> {
    prior: P,
    momentum: Option<MomentumStart>,
    restarts: bool,
    known: Known,
    /// The projection x `[T, H, W]` of v, the prior's next input.
    x: Array3<f32>,
    /// The accumulated measurement y1 `[H, W]`.
    y1: Option<Array2<f32>>,
    /// σ of the last step, if there was a step.
    sigma: Option<Option<f32>>,
}

/// The least share of its σ that a stage leaves to the next for the momentum to go on.
const GENTLE: f32 = 0.7;

impl<P: Prior> Gap<P> {
    /// Plain GAP.
    pub fn plain(prior: P) -> Self {
        let x = Array3::zeros((0, 0, 0));
        Self { prior, momentum: None, restarts: false, known: Known::default(), x, y1: None, sigma: None }
    }

    /// Accelerated GAP with `y1` starting at `y`.
    pub fn accelerated(prior: P) -> Self {
        Self::with_momentum(prior, MomentumStart::Measurement)
    }

    /// Accelerated GAP with a chosen start of `y1`.
    pub fn with_momentum(prior: P, start: MomentumStart) -> Self {
        Self { momentum: Some(start), ..Self::plain(prior) }
    }

    /// Lets y1 start anew, at y, with every stage whose σ is less than seven tenths of that before, and between stages with and
    /// without a σ.
    ///
    /// y1 makes up for what the prior takes away. A much smaller σ takes less, so that the first iteration with it
    /// overshoots by far (3 dB) without this. Where σ falls little by little there is nothing to make up for.
    pub fn restarting(self) -> Self {
        Self { restarts: true, ..self }
    }

    /// The x of the next iteration from the v of this one. Without noise it reads v once for the projection and for how far v has come.
    fn project(&mut self, measurement: &Measurement, previous: &Estimate, v: &Estimate) -> Progress {
        let precision = self.known.precision(measurement, v.sensor.view());
        let step = DataStep {
            momentum: self.y1.as_mut(),
            precision,
            previous: Some(previous.sensor.view()),
            ..DataStep::default()
        };
        step.apply(measurement, v.sensor.view(), self.x.view_mut())
    }

    /// Forgets what y1 has accumulated where σ has fallen by far: x is again the projection of v onto the measurement.
    fn restart(&mut self, measurement: &Measurement, sigma: Option<f32>, v: &Estimate) {
        let steep = match (self.sigma.replace(sigma), sigma) {
            (None, _) | (Some(None), None) => false,
            (Some(Some(before)), Some(now)) => now < GENTLE * before,
            // From a prior without a σ to one with it, and back, is a new beginning too.
            (Some(_), _) => true,
        };
        if let Some(y1) = self.y1.as_mut().filter(|_| steep && self.restarts) {
            y1.assign(&measurement.y());
            let step = DataStep { precision: self.known.precision, ..DataStep::default() };
            step.apply(measurement, v.sensor.view(), self.x.view_mut());
        }
    }
}

impl<P: Prior> Solver for Gap<P> {
    fn start(&mut self, measurement: &Measurement, from: &Estimate) {
        self.y1 = self.momentum.map(|start| match start {
            MomentumStart::Zero => Array2::zeros(measurement.y().dim()),
            MomentumStart::Measurement => measurement.y().to_owned(),
        });
        (self.sigma, self.known) = (None, Known::default());
        if self.x.dim() != from.sensor.dim() {
            self.x = Array3::zeros(from.sensor.dim());
        }
        self.project(measurement, from, from);
    }

    fn step(
        &mut self,
        measurement: &Measurement,
        call: &Call<'_>,
        previous: &Estimate,
        next: &mut Estimate,
    ) -> Result<Progress, PriorError> {
        self.restart(measurement, call.sigma, previous);
        self.prior.apply(call, self.x.view(), next)?;
        Ok(self.project(measurement, previous, next))
    }

    /// Plain GAP cannot leave the measurement: every iteration begins with the projection onto it.
    fn back_off(&mut self, measurement: &Measurement, good: &Estimate) -> Option<&'static str> {
        self.y1.take()?;
        self.project(measurement, good, good);
        Some("acceleration")
    }
}
