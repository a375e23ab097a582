//! What a solver asks a denoiser: measurements simulated from training clips with new random masks, solved by GAP with the
//! network as it is. An iterate is no clean video with white noise; its error has the structure of the masks.

use super::config::IteratesConfig;
use crate::{Error, Result};
use admm::{BoxError, Demosaicked, DenoiseCx, Denoiser, Flips, Gap, Plan, Problem, SolveError, Stage, Start, run};
use ndarray::{Array2, Array3, Array4, ArrayView4, ArrayViewMut4, Axis};
use rand::{Rng, RngExt};
use sci_forward::bayer::{Menon, mosaic_into};
use sci_forward::{CfaPattern, MaskError, MaskOperator, MaskStack, SensingOperator, VideoShape};

/// Weight of the TV prior in the start: the one of the reference's, and of configurations.
const START_WEIGHT: f32 = 0.1;

/// A call of the denoiser.
pub(super) struct Call {
    /// What it is given, `[T, C, H, W]`, the right way round.
    pub(super) input: Array4<f32>,
    pub(super) sigma: f32,
    pub(super) iteration: usize,
}

/// A measurement and what made it.
#[derive(Clone)]
pub(super) struct Simulated {
    operator: MaskOperator,
    y: Array2<f32>,
    /// The pattern of a color sensor.
    cfa: Option<CfaPattern>,
}

impl Simulated {
    /// A clip `[T, C, H, W]` seen through new masks: binary ones of a density drawn from the range, or, for the share
    /// `gray_masks`, any transmittance; up to the share `holes` of its pixels not measured; color clips through a sensor of one of the four patterns.
    pub(super) fn random(clip: ArrayView4<'_, f32>, settings: &IteratesConfig, rng: &mut impl Rng) -> Result<Self> {
        let (frames, channels, height, width) = clip.dim();
        let shape = VideoShape { frames, height, width };
        let [low, high] = settings.density;
        let density = low + (high - low) * rng.random::<f64>();
        let masks = if rng.random::<f64>() < settings.gray_masks {
            MaskStack::new(Array3::from_shape_simple_fn(shape.dim(), || rng.random()))
        } else {
            MaskStack::random(shape, density, rng.random())
        };
        let unusable = |e: MaskError| Error::Data(e.to_string());
        let mut masks = masks.map_err(unusable)?;
        if settings.holes > 0.0 {
            let share = settings.holes * rng.random::<f64>();
            let measured = Array2::from_shape_simple_fn((height, width), || rng.random::<f64>() >= share);
            masks = masks.restricted_to(measured.view()).map_err(unusable)?;
        }
        let operator = MaskOperator::new(masks);
        let pattern = CfaPattern::ALL[rng.random_range(0..4)];
        let cfa = (channels == 3).then_some(pattern);
        let y = match cfa {
            None => operator.forward(clip.index_axis(Axis(1), 0)),
            Some(cfa) => {
                let mut mosaic = Array3::zeros(shape.dim());
                mosaic_into(cfa, clip, mosaic.view_mut());
                operator.forward(mosaic.view())
            }
        };
        Ok(Self { operator, y, cfa })
    }

    /// H.
    pub(super) fn operator(&self) -> &MaskOperator {
        &self.operator
    }

    /// The pattern of a color sensor.
    pub(super) fn cfa(&self) -> Option<CfaPattern> {
        self.cfa
    }

    /// What the solver gives the denoiser in some of its calls, drawn anew. Iterates of one clip are much
    /// alike, so that few of many clips teach more than all of few.
    ///
    /// # Errors
    /// That of the network.
    pub(super) fn iterates(
        &self,
        settings: &IteratesConfig,
        denoiser: &mut dyn Denoiser,
        rng: &mut impl Rng,
    ) -> Result<Vec<Call>> {
        let mut calls = rand::seq::index::sample(rng, settings.sigmas.len(), settings.calls).into_vec();
        calls.sort_unstable();
        self.record(settings, denoiser, calls)
    }

    /// [`Self::iterates`] of consecutive calls; which is the last is drawn.
    ///
    /// # Errors
    /// That of the network.
    pub(super) fn last_calls(
        &self,
        settings: &IteratesConfig,
        denoiser: &mut dyn Denoiser,
        rng: &mut impl Rng,
    ) -> Result<Vec<Call>> {
        let first = rng.random_range(0..=settings.sigmas.len() - settings.calls);
        self.record(settings, denoiser, (first..first + settings.calls).collect())
    }

    /// The denoiser sees the video another way round in every call, as in the configurations that networks are trained for.
    fn record(&self, settings: &IteratesConfig, denoiser: &mut dyn Denoiser, calls: Vec<usize>) -> Result<Vec<Call>> {
        let last = calls.last().copied().unwrap_or(0);
        let mut recorder = Recorder { denoiser: Flips::new(denoiser), calls, seen: Vec::new() };
        self.solve(&settings.sigmas[..=last], settings.start_iterations, &mut recorder)?;
        Ok(recorder.seen)
    }

    /// Accelerated GAP from a few iterations of TV, or none of them the normalised measurement; one call of the denoiser for
    /// each σ; the result is gray or RGB.
    ///
    /// # Errors
    /// That of the network, if it is one of this crate.
    pub(super) fn solve(
        &self,
        sigmas: &[f32],
        start_iterations: usize,
        denoiser: &mut dyn Denoiser,
    ) -> Result<Array4<f32>> {
        let stages: Vec<Stage> = sigmas.iter().map(|s| Stage { sigma: s / 255.0, iterations: 1 }).collect();
        let plan = Plan::new(stages);
        let problem = Problem::new(&self.operator, self.y.view()).map_err(typed)?;
        let start = match start_iterations {
            0 => Start::Mean,
            iterations => Start::Tv { iterations, weight: START_WEIGHT, bayer: self.cfa.is_some() },
        };
        let outcome = match self.cfa {
            None => run(&mut Gap::accelerated(denoiser), &problem, start, &plan, &mut ()),
            Some(cfa) => {
                let mut gap = Gap::accelerated(Demosaicked::new(denoiser, Menon, cfa));
                run(&mut gap, &problem, start, &plan, &mut ())
            }
        };
        let outcome = outcome.map_err(typed)?;
        Ok(outcome.rgb.unwrap_or_else(|| outcome.estimate.insert_axis(Axis(1))))
    }
}

/// A denoiser that keeps what it is given in these calls (in order). The last of them is not denoised: nothing follows.
struct Recorder<'d> {
    denoiser: Flips<&'d mut dyn Denoiser>,
    calls: Vec<usize>,
    seen: Vec<Call>,
}

impl Denoiser for Recorder<'_> {
    fn name(&self) -> &str {
        "recorder"
    }

    fn denoise(
        &mut self,
        cx: &DenoiseCx,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> std::result::Result<(), BoxError> {
        if self.calls.contains(&cx.iteration) {
            let input = noisy.as_standard_layout().into_owned();
            self.seen.push(Call { input, sigma: cx.sigma, iteration: cx.iteration });
        }
        if self.seen.len() == self.calls.len() {
            out.assign(&noisy);
            return Ok(());
        }
        self.denoiser.denoise(cx, noisy, out)
    }
}

/// The error of this crate that made a solver fail.
fn typed(error: SolveError) -> Error {
    let text = error.to_string();
    let source: Option<BoxError> = match error {
        SolveError::Denoiser { source, .. } => Some(source),
        _ => None,
    };
    source.and_then(|s| s.downcast::<Error>().ok()).map_or(Error::Data(text), |e| *e)
}
