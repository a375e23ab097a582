//! The reference code's warm start.

use crate::priors::clip;
use crate::{Call, DataStep, Estimate, Prior, PriorError, Progress, Solver, progress};
use ndarray::{Array3, Zip};
use sci_forward::Measurement;

/// γ of the reference code.
const GAMMA: f32 = 0.01;

/// The reference code's warm start: [`Admm`](crate::Admm) with γ = 0.01 and θ clipped to `[0, 1]`, of which the projection x is the estimate.
///
/// ```text
/// θ ← clip(D_σ(x − b));  b ← b − (x − θ)                            not in the first iteration
/// x ← (θ + b) + Hᵀ (y − H (θ + b)) / (diag(H Hᵀ) + γ)
/// ```
///
/// x explains the measurement, which a solver that goes on from it wants; the reference starts it from `Hᵀ y`, with
/// [`Tv`](crate::Tv) of weight 0.1. Any prior will do. See [`Start::Warm`](crate::Start::Warm).
#[derive(Debug, Clone)]
pub struct WarmStart<P> {
    prior: P,
    theta: Estimate,
    b: Array3<f32>,
    /// x − b, the prior's input, then θ + b, from which the data step is taken.
    z: Array3<f32>,
    begun: bool,
}

impl<P: Prior> WarmStart<P> {
    /// With this prior.
    pub fn new(prior: P) -> Self {
        let empty = Array3::zeros((0, 0, 0));
        Self { prior, theta: Estimate::at_sensor(empty.clone()), b: empty.clone(), z: empty, begun: false }
    }
}

impl<P: Prior> Solver for WarmStart<P> {
    fn start(&mut self, _: &Measurement, from: &Estimate) {
        self.theta = Estimate::at_sensor(from.sensor.clone());
        self.b = Array3::zeros(from.sensor.dim());
        self.z = Array3::zeros(from.sensor.dim());
        self.begun = false;
    }

    fn step(
        &mut self,
        measurement: &Measurement,
        call: &Call<'_>,
        previous: &Estimate,
        next: &mut Estimate,
    ) -> Result<Progress, PriorError> {
        let Self { prior, theta, b, z, begun } = self;
        if std::mem::replace(begun, true) {
            Zip::from(&mut *z).and(&previous.sensor).and(&*b).par_for_each(|z, &x, &b| *z = x - b);
            prior.apply(call, z.view(), theta)?;
            Zip::from(&mut theta.sensor).and(&mut *b).and(&*z).par_for_each(|theta, b, &z| {
                *theta = clip(*theta);
                // b − (x − θ) = θ − (x − b).
                *b = *theta - z;
            });
        }
        Zip::from(&mut *z).and(&theta.sensor).and(&*b).par_for_each(|p, &theta, &b| *p = theta + b);
        let step = DataStep { damping: GAMMA, ..DataStep::default() };
        step.apply(measurement, z.view(), next.sensor.view_mut());
        next.rgb = None;
        Ok(progress(measurement, next.sensor.view(), previous.sensor.view()))
    }
}
