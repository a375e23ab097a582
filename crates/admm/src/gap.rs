//! Generalised alternating projection.

use crate::{BoxError, DenoiseCx, Denoiser, Problem, Solver};
use ndarray::{Array2, Array3, ArrayView3, ArrayView4, Axis};
use sci_forward::{DataStep, Progress};

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
/// The estimate is `v`, not clipped.
///
/// # References
/// Liao, Li, Carin, *Generalized alternating projection for weighted-ℓ2,1 minimization*, 2014;
/// Yuan, *Generalized alternating projection based total variation minimization for compressive sensing*, 2016.
#[derive(Debug, Clone)]
pub struct Gap<D> {
    denoiser: D,
    momentum: Option<MomentumStart>,
    restarts: bool,
}

impl<D: Denoiser> Gap<D> {
    /// Plain GAP.
    pub fn plain(denoiser: D) -> Self {
        Self { denoiser, momentum: None, restarts: false }
    }

    /// Accelerated GAP with `y1` starting at `y`.
    pub fn accelerated(denoiser: D) -> Self {
        Self::with_momentum(denoiser, MomentumStart::Measurement)
    }

    /// Accelerated GAP with a chosen start of `y1`.
    pub fn with_momentum(denoiser: D, start: MomentumStart) -> Self {
        Self { denoiser, momentum: Some(start), restarts: false }
    }

    /// Lets y1 start anew, at y, with every stage whose σ is less than seven tenths of that before, and between stages with and
    /// without a σ.
    ///
    /// y1 makes up for what the denoiser takes away. A much smaller σ takes less, so that the first iteration with it
    /// overshoots by far (3 dB) without this. Where σ falls little by little there is nothing to make up for.
    pub fn restarting(self) -> Self {
        Self { restarts: true, ..self }
    }
}

/// The least share of its σ that a stage leaves to the next for the momentum to go on.
const GENTLE: f32 = 0.7;

/// The iterates of [`Gap`].
#[derive(Debug)]
pub struct GapState {
    /// The projection x `[T, H, W]` of v, the denoiser's next input.
    x: Array3<f32>,
    /// The denoised v `[T, H, W]`.
    v: Array3<f32>,
    /// v of the iteration before.
    previous: Array3<f32>,
    /// The accumulated measurement y1 `[H, W]`.
    y1: Option<Array2<f32>>,
    /// σ of the last step, if there was one.
    sigma: Option<f32>,
}

impl GapState {
    /// The x of the next iteration from the v of this one. It reads v once for the projection and for how far v has come.
    fn project(&mut self, problem: &Problem<'_>) -> Progress {
        let Self { x, v, previous, y1, .. } = self;
        let previous = Some(previous.view());
        let step = DataStep { momentum: y1.as_mut(), previous, ..DataStep::projection(problem.y()) };
        problem.operator().data_step(step, v.view(), x.view_mut())
    }

    /// Forgets what y1 has accumulated: x is again the projection of v onto the measurement.
    fn restart(&mut self, problem: &Problem<'_>) {
        if let Some(y1) = &mut self.y1 {
            y1.assign(&problem.y());
            problem.operator().data_step(DataStep::projection(problem.y()), self.v.view(), self.x.view_mut());
        }
    }
}

impl<D: Denoiser> Solver for Gap<D> {
    type State = GapState;

    fn denoiser_name(&self) -> &str {
        self.denoiser.name()
    }

    fn init(&mut self, problem: &Problem<'_>, start: Array3<f32>) -> GapState {
        let y1 = self.momentum.map(|start| match start {
            MomentumStart::Zero => Array2::zeros(problem.y().dim()),
            MomentumStart::Measurement => problem.y().to_owned(),
        });
        let zeros = Array3::zeros(start.dim());
        let mut state = GapState { x: zeros.clone(), previous: zeros, v: start, y1, sigma: None };
        state.project(problem);
        state
    }

    fn step(&mut self, problem: &Problem<'_>, cx: &DenoiseCx, state: &mut GapState) -> Result<Progress, BoxError> {
        // TV has no σ: from it to a network, and back, is a new beginning too.
        let anew = |before: f32| cx.sigma < GENTLE * before || (before == 0.0) != (cx.sigma == 0.0);
        if state.sigma.replace(cx.sigma).is_some_and(anew) && self.restarts {
            state.restart(problem);
        }
        let GapState { x, v, previous, .. } = state;
        std::mem::swap(previous, v);
        self.denoiser.denoise(cx, x.view().insert_axis(Axis(1)), v.view_mut().insert_axis(Axis(1)))?;
        Ok(state.project(problem))
    }

    fn estimate<'s>(&self, state: &'s GapState) -> ArrayView3<'s, f32> {
        state.v.view()
    }

    fn previous<'s>(&self, state: &'s GapState) -> ArrayView3<'s, f32> {
        state.previous.view()
    }

    fn rgb<'s>(&'s self, _: &'s GapState) -> Option<ArrayView4<'s, f32>> {
        self.denoiser.rgb()
    }

    /// Plain GAP cannot leave the measurement: every iteration begins with the projection onto it.
    fn back_off(&self, problem: &Problem<'_>, state: &mut GapState, good: Array3<f32>) -> Option<&'static str> {
        state.y1.take()?;
        state.v = good;
        state.project(problem);
        Some("acceleration")
    }
}
