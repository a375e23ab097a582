//! The paper's two-stage ADMM for color sensors.

use super::known::Known;
use crate::priors::clip;
use crate::{Call, DataStep, Denoiser, Estimate, PriorError, Progress, Solver, progress};
use ndarray::parallel::prelude::*;
use ndarray::{Array3, Array4, ArrayView4, Axis, Zip};
use sci_forward::Measurement;
use sci_forward::bayer::{CfaPattern, Demosaicer, mosaic_into};

/// How the dual variables are kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Convention {
    /// The paper's public code to the letter. Duals are kept unscaled and move by unit steps whatever ρ and τ are, the RGB dual
    /// enters the denoiser with a minus sign, θ is clipped, and the first `b` step sees the unclipped θ in the place of q:
    ///
    /// ```text
    /// p = θ − b/ρ;  q = p + Hᵀ (y − H p) / (diag(H Hᵀ) + ρ)
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
    /// q = p + Hᵀ (y − H p) / (diag(H Hᵀ) + ρ),  p = T x − b
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
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TwoStageParams {
    /// ρ.
    pub rho: f32,
    /// τ.
    pub tau: f32,
    /// How duals are kept.
    pub convention: Convention,
}

/// Two-stage ADMM: stage one recovers the mosaic video from the measurement, stage two the RGB video from the mosaic.
/// The updates are those of its [`Convention`].
///
/// Where noise of variance n is known of ([`Measurement::with_noise`]), q is the likeliest mosaic: diag(H Hᵀ) + ρ becomes
/// diag(H Hᵀ) + ρ + n / mse(θ), as in [`Admm`](crate::Admm).
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
    kept: Option<Kept>,
}

/// What is kept from one iteration to the next: mosaics `[T, H, W]` and RGB videos `[T, 3, H, W]`.
struct Kept {
    /// Whether no step was taken yet.
    first: bool,
    known: Known,
    /// T x where that closes the loop instead of θ.
    tx: Option<Array3<f32>>,
    q: Array3<f32>,
    b: Array3<f32>,
    /// p before the data step, then q + b, scaled, which is what is demosaicked.
    mosaic: Array3<f32>,
    /// x, then the denoiser's input.
    x: Array4<f32>,
    /// w, where x = v is a constraint.
    w: Option<Array4<f32>>,
}

impl<D: Denoiser, M: Demosaicer> TwoStage<D, M> {
    /// For a sensor with this pattern.
    ///
    /// # Panics
    /// If a parameter is not positive and finite.
    pub fn new(denoiser: D, demosaicer: M, x_step: XStep, cfa: CfaPattern, params: TwoStageParams) -> Self {
        for (name, v) in [("ρ", params.rho), ("τ", params.tau)] {
            assert!(v > 0.0 && v.is_finite(), "{name} = {v} must be finite and greater than 0");
        }
        Self { denoiser, demosaicer, x_step, cfa, params, kept: None }
    }

    fn begin(&self, from: &Estimate) -> Kept {
        let (frames, height, width) = from.sensor.dim();
        let (zeros, rgb) = (Array3::zeros(from.sensor.dim()), Array4::zeros((frames, 3, height, width)));
        let closed_form = self.x_step != XStep::Demosaic;
        let scaled = self.params.convention == Convention::Scaled;
        Kept {
            first: true,
            known: Known::default(),
            tx: (scaled && closed_form).then(|| from.sensor.clone()),
            q: zeros.clone(),
            b: zeros.clone(),
            mosaic: zeros,
            w: (!scaled || closed_form).then(|| rgb.clone()),
            x: rgb,
        }
    }
}

impl TwoStageParams {
    /// How the duals enter the primal updates: `(divisor of b, factor of w)`.
    fn dual_scales(&self) -> (f32, f32) {
        match self.convention {
            Convention::PaperCode => (self.rho, -1.0 / self.tau),
            Convention::Scaled => (1.0, 1.0),
        }
    }
}

impl Kept {
    /// q, and the mosaic q + b that is demosaicked.
    fn data_step(&mut self, measurement: &Measurement, params: TwoStageParams, theta: &Array3<f32>) {
        let (b_scale, _) = params.dual_scales();
        let Self { known, tx, q, b, mosaic, .. } = self;
        let closing = tx.as_ref().unwrap_or(theta);
        Zip::from(&mut *mosaic).and(closing).and(&*b).par_for_each(|p, &closing, &b| *p = closing - b / b_scale);
        let precision = known.precision(measurement, theta.view());
        let step = DataStep { damping: params.rho, precision, ..DataStep::default() };
        step.apply(measurement, mosaic.view(), q.view_mut());
        Zip::from(&mut *mosaic).and(&*q).and(&*b).par_for_each(|m, &q, &b| *m = q + b / b_scale);
    }

    /// x of the closed form, from the mosaic q + b, v and w.
    fn closed_form(&mut self, cfa: CfaPattern, params: TwoStageParams, v: ArrayView4<'_, f32>, clip_x: bool) {
        let Self { mosaic, w, x, .. } = self;
        let TwoStageParams { rho, tau, convention } = params;
        // τ v + w in the paper's convention, τ (v − w) in the scaled one.
        let dual = if convention == Convention::PaperCode { 1.0 } else { -tau };
        match w {
            Some(w) => Zip::from(&mut *x).and(v).and(&*w).par_for_each(|x, &v, &w| *x = v + dual / tau * w),
            None => x.assign(&v),
        }
        let weight = rho / (rho + tau);
        x.axis_iter_mut(Axis(0)).into_par_iter().zip(mosaic.axis_iter(Axis(0))).for_each(|(mut x, mosaic)| {
            for (row, samples) in mosaic.outer_iter().enumerate() {
                for (column, &m) in samples.iter().enumerate() {
                    let x = &mut x[[cfa.color_at(row, column) as usize, row, column]];
                    *x += weight * (m - *x);
                }
            }
            if clip_x {
                x.mapv_inplace(clip);
            }
        });
    }

    /// b, after θ, which the paper's convention clips.
    fn b_step(&mut self, convention: Convention, theta: &mut Array3<f32>) {
        let Self { first, tx, q, b, .. } = self;
        match convention {
            Convention::Scaled => {
                let closing = tx.as_ref().unwrap_or(theta);
                Zip::from(b).and(&*q).and(closing).par_for_each(|b, &q, &closing| *b += q - closing);
            }
            Convention::PaperCode => Zip::from(b).and(&*q).and(theta).par_for_each(|b, &q, theta| {
                // In the public code's first iteration q and θ are one array, so that θ before clipping stands for q.
                let q = if *first { *theta } else { q };
                *theta = clip(*theta);
                *b += q - *theta;
            }),
        }
    }
}

impl<D: Denoiser, M: Demosaicer> Solver for TwoStage<D, M> {
    fn start(&mut self, _: &Measurement, from: &Estimate) {
        self.kept = Some(self.begin(from));
    }

    fn step(
        &mut self,
        measurement: &Measurement,
        call: &Call<'_>,
        previous: &Estimate,
        next: &mut Estimate,
    ) -> Result<Progress, PriorError> {
        let mut kept = self.kept.take().unwrap_or_else(|| self.begin(previous));
        let Self { denoiser, demosaicer, cfa, params, .. } = self;
        let (_, w_factor) = params.dual_scales();
        kept.data_step(measurement, *params, &previous.sensor);
        match (self.x_step, &previous.rgb) {
            (XStep::ClosedForm { clip }, Some(v)) if !kept.first => kept.closed_form(*cfa, *params, v.view(), clip),
            _ => demosaicer
                .demosaic(*cfa, kept.mosaic.view(), kept.x.view_mut())
                .map_err(|source| PriorError::demosaicer(demosaicer, source))?,
        }
        let Kept { tx, x, w, .. } = &mut kept;
        if let Some(tx) = tx {
            mosaic_into(*cfa, x.view(), tx.view_mut());
        }
        // The denoiser's input takes the place of x, from which w then has x back.
        if let Some(w) = w {
            Zip::from(&mut *x).and(&*w).par_for_each(|x, &w| *x += w_factor * w);
        }
        let (theta, v) = next.for_rgb();
        denoiser.denoise(call, x.view(), v.view_mut()).map_err(|source| PriorError::denoiser(denoiser, source))?;
        if let Some(w) = w {
            Zip::from(w).and(&*x).and(&*v).par_for_each(|w, &x, &v| *w += (x - w_factor * *w) - v);
        }
        mosaic_into(*cfa, v.view(), theta.view_mut());
        kept.b_step(params.convention, theta);
        kept.first = false;
        self.kept = Some(kept);
        Ok(progress(measurement, next.sensor.view(), previous.sensor.view()))
    }
}
