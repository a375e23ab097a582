//! The alternating direction method of multipliers with one splitting.

use crate::{BoxError, DenoiseCx, Denoiser, Problem, Solver};
use ndarray::{Array3, ArrayView3, ArrayView4, Axis, Zip};
use sci_forward::{DataStep, Progress};

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
    /// θ of the iteration before.
    previous: Array3<f32>,
    b: Array3<f32>,
}

impl<D: Denoiser> Solver for Admm<D> {
    type State = AdmmState;

    fn denoiser_name(&self) -> &str {
        self.denoiser.name()
    }

    fn init(&mut self, _: &Problem<'_>, start: Array3<f32>) -> AdmmState {
        let zeros = Array3::zeros(start.dim());
        AdmmState { x: zeros.clone(), b: zeros.clone(), previous: zeros, theta: start }
    }

    fn step(&mut self, problem: &Problem<'_>, cx: &DenoiseCx, state: &mut AdmmState) -> Result<Progress, BoxError> {
        let AdmmState { x, theta, previous, b } = state;
        std::mem::swap(previous, theta);
        // θ is overwritten at the end of the step; until then its place holds p = θ + b.
        let p = theta;
        Zip::from(&mut *p).and(&*previous).and(&*b).par_for_each(|p, &theta, &b| *p = theta + b);
        let step = DataStep { damping: self.gamma, ..DataStep::projection(problem.y()) };
        problem.operator().data_step(step, p.view(), x.view_mut());
        // x is only needed as x − b from here on: θ is denoised from it, and b ← b − (x − θ) = θ − (x − b).
        Zip::from(&mut *x).and(&*b).par_for_each(|x, &b| *x -= b);
        let theta = p;
        self.denoiser.denoise(cx, x.view().insert_axis(Axis(1)), theta.view_mut().insert_axis(Axis(1)))?;
        Zip::from(b).and(&*theta).and(&*x).par_for_each(|b, &theta, &x| *b = theta - x);
        Ok(problem.operator().progress(problem.y(), theta.view(), previous.view()))
    }

    fn estimate<'s>(&self, state: &'s AdmmState) -> ArrayView3<'s, f32> {
        state.theta.view()
    }

    fn previous<'s>(&self, state: &'s AdmmState) -> ArrayView3<'s, f32> {
        state.previous.view()
    }

    fn rgb<'s>(&'s self, _: &'s AdmmState) -> Option<ArrayView4<'s, f32>> {
        self.denoiser.rgb()
    }
}
