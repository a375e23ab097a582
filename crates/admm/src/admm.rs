//! The alternating direction method of multipliers with one splitting.

use crate::{BoxError, DenoiseCx, Denoiser, Problem, Solver};
use ndarray::{Array3, ArrayView3, Axis, Zip};
use sci_forward::DataStep;

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
/// # References
/// Boyd et al., *Distributed optimization and statistical learning via ADMM*, 2011; Chan et al., *Plug-and-play ADMM*, 2017.
#[derive(Debug, Clone)]
pub struct Admm<D> {
    denoiser: D,
    gamma: f32,
}

impl<D: Denoiser> Admm<D> {
    /// ADMM with penalty `γ ≥ 0` on `x − θ`, in the unit of `diag(H Hᵀ)`.
    ///
    /// # Panics
    /// If γ is negative or not finite.
    pub fn new(denoiser: D, gamma: f32) -> Self {
        assert!(gamma >= 0.0 && gamma.is_finite(), "γ = {gamma} must be finite and at least 0");
        Self { denoiser, gamma }
    }
}

/// The iterates of [`Admm`], each `[T, H, W]`.
#[derive(Debug)]
pub struct AdmmState {
    x: Array3<f32>,
    theta: Array3<f32>,
    b: Array3<f32>,
}

impl<D: Denoiser> Solver for Admm<D> {
    type State = AdmmState;

    fn denoiser_name(&self) -> &str {
        self.denoiser.name()
    }

    fn init(&mut self, _: &Problem<'_>, start: Array3<f32>) -> AdmmState {
        AdmmState { x: Array3::zeros(start.dim()), b: Array3::zeros(start.dim()), theta: start }
    }

    fn step(&mut self, problem: &Problem<'_>, cx: &DenoiseCx, state: &mut AdmmState) -> Result<(), BoxError> {
        let AdmmState { x, theta, b } = state;
        Zip::from(&mut *x).and(&*theta).and(&*b).par_for_each(|x, &theta, &b| *x = theta + b);
        problem.operator().data_step(DataStep { y: problem.y(), damping: self.gamma, momentum: None }, x.view_mut());
        // x is only needed as x − b from here on: θ is denoised from it, and b ← b − (x − θ) = θ − (x − b).
        Zip::from(&mut *x).and(&*b).par_for_each(|x, &b| *x -= b);
        self.denoiser.denoise(cx, x.view().insert_axis(Axis(1)), theta.view_mut().insert_axis(Axis(1)))?;
        Zip::from(b).and(&*theta).and(&*x).par_for_each(|b, &theta, &x| *b = theta - x);
        Ok(())
    }

    fn estimate<'s>(&self, state: &'s AdmmState) -> ArrayView3<'s, f32> {
        state.theta.view()
    }
}
