//! The paper's two-stage ADMM for color sensors.

use crate::prior::clip;
use crate::{BoxError, DenoiseCx, Denoiser, Problem, Solver};
use ndarray::{Array3, Array4, ArrayView3, ArrayView4, Zip};
use sci_forward::bayer::{CfaPattern, Demosaicer, mosaic_into};
use sci_forward::{DataStep, Progress};

/// How the dual variables are kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Convention {
    /// The paper's public code to the letter. Duals are kept unscaled and move by unit steps whatever ρ and τ are, the RGB dual
    /// enters the denoiser with a minus sign, θ is clipped, and the first `b` step sees the unclipped θ in the place of q:
    ///
    /// ```text
    /// p = θ − b/ρ;  q = p + Hᵀ (y − H p) / (diag(H Hᵀ) + α ρ)
    /// x = demosaic(q + b/ρ)     or     x = (ρ Tᵀq + Tᵀb + τ v + w) / (ρ TᵀT + τ)
    /// v = D_σ(x − w/τ);  θ = clip(T v)
    /// b ← b + (q − θ);  w ← w + (x − v)
    /// ```
    ///
    /// With these signs what the denoiser removes is removed again in the next iteration, and more: `w` has no fixed point but
    /// for a denoiser that changes nothing. A large τ and few iterations keep that small.
    PaperCode,
    /// Scaled ADMM, consistent in its signs. For `min ½‖y − H q‖² + λ g(v)` subject to `q = T x`, `x = v`, with the duals
    /// `b` (divided by ρ) and `w` (divided by τ), the augmented Lagrangian
    /// `½‖y − H q‖² + λ g(v) + ρ/2 ‖q − T x + b‖² + τ/2 ‖x − v + w‖²` is minimised over q, x and v in turn:
    ///
    /// ```text
    /// q = p + Hᵀ (y − H p) / (diag(H Hᵀ) + α ρ),  p = T x − b
    /// x = (ρ Tᵀ(q + b) + τ (v − w)) / (ρ TᵀT + τ)
    /// v = D_σ(x + w)
    /// b ← b + (q − T x);  w ← w + (x − v)
    /// ```
    ///
    /// A demosaicer in the place of the closed form keeps the samples, so that `T x = q + b` and `b` would stay 0, and its x lies
    /// in no relation to v. The loop is then closed by `θ = T v` in the place of `T x`, and `w`, whose constraint is gone, stays 0:
    /// plug-and-play ADMM on the mosaic, with demosaicing, denoising and sampling as one denoiser.
    Scaled,
}

/// How the RGB video x is made from the mosaic.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum XStep {
    /// By the demosaicer (paper, Eq. `deep_dema`).
    Demosaic,
    /// In closed form (paper, Eq. `xv_k+1`, "CFD"), after one first step by the demosaicer.
    ClosedForm {
        /// Whether x is clipped to `[0, 1]`, as the reference code does with FFDNet.
        clip: bool,
    },
}

/// The parameters of [`TwoStage`].
///
/// | Parameter | Reference | Purpose | Range |
/// |---|---|---|---|
/// | `rho` | 1 (FFDNet), 0.55 (FastDVDnet and closed form) | penalty of `q = T x` | > 0 |
/// | `tau` | 100 (10 in closed form) | penalty of `x = v` | > 0 |
/// | `alpha` | 1 | factor of ρ in the data step | > 0 |
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TwoStageParams {
    /// ρ.
    pub rho: f32,
    /// τ.
    pub tau: f32,
    /// α.
    pub alpha: f32,
    /// How duals are kept.
    pub convention: Convention,
}

/// Two-stage ADMM: stage one recovers the mosaic video from the measurement, stage two the RGB video from the mosaic.
/// The updates are those of its [`Convention`].
///
/// The estimate is `θ = T v` (`[T, H, W]`, clipped in the paper's convention), its RGB video is `v`, not clipped.
///
/// # References
/// Wu et al., *Adaptive Deep PnP Algorithm for Video Snapshot Compressive Imaging*, algorithm 1.
pub struct TwoStage<D, M> {
    denoiser: D,
    demosaicer: M,
    x_step: XStep,
    cfa: CfaPattern,
    params: TwoStageParams,
}

/// The iterates of [`TwoStage`], mosaics `[T, H, W]` and RGB videos `[T, 3, H, W]`.
#[derive(Debug)]
pub struct TwoStageState {
    /// θ = T v, the estimate.
    theta: Array3<f32>,
    previous: Array3<f32>,
    /// T x where that closes the loop instead of θ.
    tx: Option<Array3<f32>>,
    q: Array3<f32>,
    b: Array3<f32>,
    /// p before the data step, then q + b, scaled, which is what is demosaicked.
    mosaic: Array3<f32>,
    /// x, then the denoiser's input.
    x: Array4<f32>,
    v: Array4<f32>,
    /// w, where x = v is a constraint.
    w: Option<Array4<f32>>,
}

impl<D: Denoiser, M: Demosaicer> TwoStage<D, M> {
    /// For a sensor with this pattern.
    ///
    /// # Panics
    /// If a parameter is not positive and finite.
    pub fn new(denoiser: D, demosaicer: M, x_step: XStep, cfa: CfaPattern, params: TwoStageParams) -> Self {
        for (name, v) in [("ρ", params.rho), ("τ", params.tau), ("α", params.alpha)] {
            assert!(v > 0.0 && v.is_finite(), "{name} = {v} must be finite and greater than 0");
        }
        Self { denoiser, demosaicer, x_step, cfa, params }
    }

    /// How the duals enter the primal updates: `(divisor of b, factor of w)`.
    fn dual_scales(&self) -> (f32, f32) {
        match self.params.convention {
            Convention::PaperCode => (self.params.rho, -1.0 / self.params.tau),
            Convention::Scaled => (1.0, 1.0),
        }
    }

    /// x of the closed form, from the mosaic q + b, v and w.
    fn closed_form(&self, state: &mut TwoStageState, clip_x: bool) {
        let TwoStageState { mosaic, v, w, x, .. } = state;
        let TwoStageParams { rho, tau, convention, .. } = self.params;
        // τ v + w in the paper's convention, τ (v − w) in the scaled one.
        let dual = if convention == Convention::PaperCode { 1.0 } else { -tau };
        match w {
            Some(w) => Zip::from(&mut *x).and(&*v).and(&*w).par_for_each(|x, &v, &w| *x = v + dual / tau * w),
            None => x.assign(v),
        }
        let weight = rho / (rho + tau);
        let cfa = self.cfa;
        for (t, mosaic) in mosaic.outer_iter().enumerate() {
            for ((r, c), &m) in mosaic.indexed_iter() {
                let x = &mut x[[t, cfa.color_at(r, c) as usize, r, c]];
                *x += weight * (m - *x);
            }
        }
        if clip_x {
            x.par_mapv_inplace(clip);
        }
    }
}

impl<D: Denoiser, M: Demosaicer> Solver for TwoStage<D, M> {
    type State = TwoStageState;

    fn denoiser_name(&self) -> &str {
        self.denoiser.name()
    }

    fn init(&mut self, _: &Problem<'_>, start: Array3<f32>) -> TwoStageState {
        let (frames, height, width) = start.dim();
        let (zeros, rgb) = (Array3::zeros(start.dim()), Array4::zeros((frames, 3, height, width)));
        let closed_form = self.x_step != XStep::Demosaic;
        let scaled = self.params.convention == Convention::Scaled;
        TwoStageState {
            tx: (scaled && closed_form).then(|| start.clone()),
            w: (!scaled || closed_form).then(|| rgb.clone()),
            q: zeros.clone(),
            b: zeros.clone(),
            mosaic: zeros.clone(),
            previous: zeros,
            x: rgb.clone(),
            v: rgb,
            theta: start,
        }
    }

    fn step(&mut self, problem: &Problem<'_>, cx: &DenoiseCx, state: &mut TwoStageState) -> Result<Progress, BoxError> {
        let first = cx.iteration == 0;
        let (b_scale, w_factor) = self.dual_scales();
        let TwoStageState { theta, tx, q, b, mosaic, .. } = state;
        let link = tx.as_ref().unwrap_or(theta);
        Zip::from(&mut *mosaic).and(link).and(&*b).par_for_each(|p, &link, &b| *p = link - b / b_scale);
        let damping = self.params.alpha * self.params.rho;
        let step = DataStep { damping, ..DataStep::projection(problem.y()) };
        problem.operator().data_step(step, mosaic.view(), q.view_mut());
        Zip::from(&mut *mosaic).and(&*q).and(&*b).par_for_each(|m, &q, &b| *m = q + b / b_scale);

        match self.x_step {
            XStep::ClosedForm { clip } if !first => self.closed_form(state, clip),
            _ => self.demosaicer.demosaic(self.cfa, state.mosaic.view(), state.x.view_mut())?,
        }
        let TwoStageState { theta, previous, tx, q, b, x, v, w, .. } = state;
        if let Some(tx) = tx {
            mosaic_into(self.cfa, x.view(), tx.view_mut());
        }
        // The denoiser's input takes the place of x, from which w then has x back.
        if let Some(w) = w {
            Zip::from(&mut *x).and(&*w).par_for_each(|x, &w| *x += w_factor * w);
        }
        self.denoiser.denoise(cx, x.view(), v.view_mut())?;
        if let Some(w) = w {
            Zip::from(w).and(&*x).and(&*v).par_for_each(|w, &x, &v| *w += (x - w_factor * *w) - v);
        }
        std::mem::swap(previous, theta);
        mosaic_into(self.cfa, v.view(), theta.view_mut());
        match (self.params.convention, tx) {
            (Convention::Scaled, tx) => {
                let link = tx.as_ref().unwrap_or(theta);
                Zip::from(b).and(&*q).and(link).par_for_each(|b, &q, &link| *b += q - link);
            }
            (Convention::PaperCode, _) => Zip::from(b).and(&*q).and(theta).par_for_each(|b, &q, theta| {
                // In the public code's first iteration q and θ are one array, so that θ before clipping stands for q.
                let q = if first { *theta } else { q };
                *theta = clip(*theta);
                *b += q - *theta;
            }),
        }
        Ok(problem.operator().progress(problem.y(), state.theta.view(), state.previous.view()))
    }

    fn estimate<'s>(&self, state: &'s TwoStageState) -> ArrayView3<'s, f32> {
        state.theta.view()
    }

    fn previous<'s>(&self, state: &'s TwoStageState) -> ArrayView3<'s, f32> {
        state.previous.view()
    }

    fn rgb<'s>(&'s self, state: &'s TwoStageState) -> Option<ArrayView4<'s, f32>> {
        Some(state.v.view())
    }
}
