//! The gradient through consecutive iterations of GAP: a call of the denoiser is taught what helps the calls after it, not only what is
//! near the truth. Training learns from the truth this way, adaptation to a scene from pixels that the solve was not given.
//!
//! In color the gradient goes through Menon's demosaicing as if it were Malvar's, its linear neighbour: both correct the mean of the
//! nearest samples by the curvature of the color that was seen, Menon in one direction and Malvar in both.

use crate::kernels::with_numbers;
use crate::{Error, Network, Result};
use admm::{
    BoxError, Call, Demosaicked, Denoiser, Dimmed, Flips, Gap, Plan, Prior, SolveError, Solver, Stage, Start,
    StopReason, Tv, flipped_axes, run,
};
use candle_core::backprop::GradStore;
use candle_core::{Device, Tensor, Var};
use ndarray::{Array2, Array3, Array4, ArrayView3, ArrayView4, ArrayViewMut4, Axis};
use sci_forward::bayer::{Malvar, Menon, mosaic_adjoint_into, mosaic_into};
use sci_forward::{Demosaicer, Measurement, SensingOperator};
use std::fmt::Display;

/// A solve by GAP with one network, as far as it can be learned from: one call with each σ.
#[derive(Debug, Clone, PartialEq)]
pub struct Recipe {
    /// σ of each call, on the scale of the frames.
    pub sigmas: Vec<f32>,
    /// Whether y1 accumulates what the iterates miss ([`Gap::accelerated`]), or is y.
    pub accelerate: bool,
    /// Iterations of TV, of this weight above 0, that it starts from; nothing starts from the normalised measurement.
    pub start: Option<(usize, f32)>,
    /// Whether the network sees the video another way round in every call ([`Flips`]).
    pub flips: bool,
    /// It sees the video divided by this ([`Dimmed`]), which is above 0.
    pub dim: f32,
}

/// Who makes the first calls of a solve, where another network takes over from it.
#[derive(Clone, Copy)]
pub struct First<'n> {
    /// The network.
    pub network: &'n dyn Network,
    /// How many calls.
    pub calls: usize,
}

/// A network that takes a solve over from another.
pub struct Relay<'d> {
    first: Option<(Box<dyn Network>, usize)>,
    then: &'d mut dyn Network,
}

impl<'d> Relay<'d> {
    /// `then` after the first calls, or in all.
    pub fn new(first: Option<First<'_>>, then: &'d mut dyn Network) -> Self {
        Self { first: first.map(|first| (first.network.boxed(), first.calls)), then }
    }
}

impl Denoiser for Relay<'_> {
    fn name(&self) -> &str {
        "relay"
    }

    fn denoise(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        match &mut self.first {
            Some((first, calls)) if call.iteration < *calls => first.infer(call, noisy, out),
            _ => self.then.infer(call, noisy, out),
        }
    }
}

/// A call of the network in a solve.
#[derive(Debug, Clone)]
pub struct RecordedCall {
    /// What it is given, `[T, C, H, W]`, the right way round.
    pub input: Array4<f32>,
    /// The σ that it is told.
    pub sigma: f32,
    /// Its number, from 0.
    pub iteration: usize,
}

/// A loss, and its gradient for each variable (nothing for those it does not depend on).
#[derive(Debug, Clone)]
pub struct Gradients {
    /// The loss.
    pub loss: f32,
    /// `∂ℓ/∂w`, in the order of the variables.
    pub of_vars: Vec<Option<Vec<f32>>>,
}

impl Gradients {
    pub(crate) fn zero(vars: usize) -> Self {
        Self { loss: 0.0, of_vars: vec![None; vars] }
    }

    /// The mean of some, summed in their order.
    pub fn mean(parts: Vec<Self>) -> Self {
        let mut mean = Self::zero(parts.first().map_or(0, |part| part.of_vars.len()));
        let share = 1.0 / parts.len() as f32;
        parts.into_iter().for_each(|part| mean.add(part, share));
        mean
    }

    fn add(&mut self, other: Self, share: f32) {
        self.loss += share * other.loss;
        for (sum, gradient) in self.of_vars.iter_mut().zip(other.of_vars) {
            let Some(gradient) = gradient else { continue };
            let sum = sum.get_or_insert_with(|| vec![0.0; gradient.len()]);
            sum.iter_mut().zip(gradient).for_each(|(sum, g)| *sum += share * g);
        }
    }

    /// Adds a loss and what was found to be its gradient.
    pub(crate) fn add_found(&mut self, loss: f32, found: &GradStore, vars: &[(String, Var)]) -> Result<()> {
        self.loss += loss;
        for (sum, (_, var)) in self.of_vars.iter_mut().zip(vars) {
            match (sum, found.get(var)) {
                (_, None) => {}
                (none @ None, Some(gradient)) => *none = Some(gradient.flatten_all()?.to_vec1()?),
                (Some(sum), Some(gradient)) => with_numbers(gradient, |gradient| {
                    sum.iter_mut().zip(gradient).for_each(|(sum, g)| *sum += g);
                    Ok(())
                })?,
            }
        }
        Ok(())
    }
}

/// Maps a result `[T, C, H, W]` to its loss, and the gradient by that result.
pub type LossOfResult<'l> = dyn Fn(ArrayView4<'_, f32>) -> Result<(f32, Array4<f32>), BoxError> + 'l;

impl Recipe {
    /// The result `[T, C, H, W]` of all calls; where they diverge, what they came from.
    ///
    /// # Errors
    /// That of the denoiser; [`Error::Data`] when it cannot be solved.
    pub fn solve(&self, measurement: &Measurement, denoiser: &mut dyn Denoiser) -> Result<Array4<f32>> {
        Ok(self.solve_calls(measurement, self.turning(denoiser), self.sigmas.len())?.0)
    }

    /// The same; nothing where they diverge.
    ///
    /// # Errors
    /// As [`Recipe::solve`].
    pub fn solve_to_the_end(
        &self,
        measurement: &Measurement,
        denoiser: &mut dyn Denoiser,
    ) -> Result<Option<Array4<f32>>> {
        let (result, stop) = self.solve_calls(measurement, self.turning(denoiser), self.sigmas.len())?;
        Ok((stop != StopReason::Diverged).then_some(result))
    }

    /// What the denoiser is given in these calls (in order, counted from 0); nothing where the solve diverges before the last.
    ///
    /// # Errors
    /// As [`Recipe::solve`].
    pub fn record(
        &self,
        measurement: &Measurement,
        denoiser: &mut dyn Denoiser,
        calls: Vec<usize>,
    ) -> Result<Option<Vec<RecordedCall>>> {
        let count = calls.last().map_or(0, |last| last + 1);
        let mut recorder = Recorder { denoiser: self.turning(denoiser), calls, seen: Vec::new() };
        self.solve_calls(measurement, Box::new(&mut recorder), count)?;
        Ok((recorder.seen.len() == recorder.calls.len()).then_some(recorder.seen))
    }

    fn turning<'d>(&self, denoiser: &'d mut dyn Denoiser) -> Box<dyn Denoiser + 'd> {
        let turning: Box<dyn Denoiser> = if self.flips { Box::new(Flips::new(denoiser)) } else { Box::new(denoiser) };
        if self.dim == 1.0 { turning } else { Box::new(Dimmed::new(turning, self.dim)) }
    }

    fn solve_calls(
        &self,
        measurement: &Measurement,
        denoiser: Box<dyn Denoiser + '_>,
        count: usize,
    ) -> Result<(Array4<f32>, StopReason)> {
        let stages: Vec<Stage> =
            self.sigmas[..count].iter().map(|&s| Stage { sigma: Some(s), iterations: 1 }).collect();
        let cfa = measurement.cfa();
        let mut tv = self.start.map(|(iterations, weight)| (iterations, Tv::new(weight).on_sensor(cfa)));
        let start = match &mut tv {
            Some((iterations, prior)) => {
                Start::Warm { prior: &mut **prior, stage: Stage { sigma: None, iterations: *iterations } }
            }
            None => Start::Mean,
        };
        let prior: Box<dyn Prior + '_> = match cfa {
            None => Box::new(denoiser),
            Some(cfa) => Box::new(Demosaicked::new(denoiser, Menon, cfa)),
        };
        let mut solver: Box<dyn Solver + '_> =
            if self.accelerate { Box::new(Gap::accelerated(prior)) } else { Box::new(Gap::plain(prior)) };
        let outcome = run(&mut *solver, measurement, start, &Plan::new(stages), &mut ()).map_err(typed)?;
        // The start, to which a divergence goes back, has no RGB video.
        let result = match (outcome.estimate.rgb, cfa) {
            (Some(rgb), _) => rgb,
            (None, None) => outcome.estimate.sensor.insert_axis(Axis(1)),
            (None, Some(cfa)) => {
                let (frames, height, width) = outcome.estimate.sensor.dim();
                let mut rgb = Array4::zeros((frames, 3, height, width));
                Menon.demosaic(cfa, outcome.estimate.sensor.view(), rgb.view_mut()).map_err(unusable)?;
                rgb
            }
        };
        Ok((result, outcome.stop))
    }

    /// The weighted mean loss of the results of consecutive calls, each of half the weight of the one after it, as the last is what a
    /// user gets, and its gradient for each of `vars`, through the network and the data steps between. Goes backward call by call, each
    /// run again with its graph, so that the memory is that of one.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn gradient(
        &self,
        measurement: &Measurement,
        calls: &[RecordedCall],
        network: &dyn Network,
        vars: &[(String, Var)],
        loss: &LossOfResult<'_>,
    ) -> Result<Gradients> {
        let mut share = 0.5 / (1.0 - 0.5f32.powi(calls.len() as i32));
        let mut total = Gradients::zero(vars.len());
        let mut later: Option<(Array4<f32>, &RecordedCall)> = None;
        let mut to_momentum = Array2::zeros(measurement.shape().image_dim());
        for call in calls.iter().rev() {
            let input = Var::from_tensor(&tensor(call.input.clone())?)?;
            let v = self.denoised(network, &input, call)?;
            let values = Array4::from_shape_vec(v.dims4()?, v.flatten_all()?.to_vec1::<f32>()?).map_err(unusable)?;
            let (own, mut upstream) = loss(values.view()).map_err(unusable)?;
            upstream *= share;
            if let Some((to_input, next)) = later.take() {
                let inactive = inactive(measurement, values.view(), next.input.view());
                upstream += &self.through_iteration(measurement, to_input, &inactive, &mut to_momentum)?;
            }
            let gradients = (v * tensor(upstream)?)?.sum_all()?.backward()?;
            total.add_found(share * own, &gradients, vars)?;
            share *= 0.5;
            if let Some(to_input) = gradients.get(&input) {
                let to_input = to_input.flatten_all()?.to_vec1()?;
                let to_input = Array4::from_shape_vec(input.dims4()?, to_input).map_err(unusable)?;
                later = Some((to_input, call));
            }
        }
        Ok(total)
    }

    /// The result of a call, which sees its input as [`Flips`] turns it, in less light.
    fn denoised(&self, network: &dyn Network, input: &Tensor, call: &RecordedCall) -> Result<Tensor> {
        let axes: Vec<usize> = flipped_axes(call.iteration).filter(|_| self.flips).map(|axis| axis.index()).collect();
        let (less, more) = (f64::from(1.0 / self.dim), f64::from(self.dim));
        Ok((network.forward(&(input * less)?.flip(&axes)?, &[call.sigma])?.flip(&axes)? * more)?)
    }

    /// From the gradient by the input of a call to that by the result of the call before, both `[T, C, H, W]`.
    fn through_iteration(
        &self,
        measurement: &Measurement,
        to_input: Array4<f32>,
        inactive: &[usize],
        to_momentum: &mut Array2<f32>,
    ) -> Result<Array4<f32>> {
        let operator = measurement.operator();
        let Some(cfa) = measurement.cfa() else {
            let to_x = to_input.index_axis(Axis(1), 0);
            return Ok(self.through_projection(operator, to_x, inactive, to_momentum).insert_axis(Axis(1)));
        };
        let mut to_x = Array3::zeros(operator.shape().dim());
        Malvar.adjoint(cfa, to_input.view(), to_x.view_mut()).map_err(unusable)?;
        let to_mosaic = self.through_projection(operator, to_x.view(), inactive, to_momentum);
        let mut to_v = to_input;
        mosaic_adjoint_into(cfa, to_mosaic.view(), to_v.view_mut());
        Ok(to_v)
    }

    /// From `∂ℓ/∂x` of the iterate and `∂ℓ/∂y1` of the accumulated measurement, both after the data step
    ///
    /// ```text
    /// y1 ← y1 + (y − H v);  x ← v + Hᵀ (y1 − H v) / diag(H Hᵀ),
    /// ```
    ///
    /// to `∂ℓ/∂v` and `∂ℓ/∂y1` before it: with `q = H ∂x / diag(H Hᵀ)`, `∂y1 ← ∂y1 + q` and `∂v = ∂x − Hᵀ (q + ∂y1)`. In plain GAP y1 is y, and
    /// `∂v = ∂x − Hᵀ q`. A clipped pixel that v gave enough light is `inactive`: nothing goes through it, nor through its y1.
    fn through_projection(
        &self,
        operator: &dyn SensingOperator,
        to_x: ArrayView3<'_, f32>,
        inactive: &[usize],
        to_y1: &mut Array2<f32>,
    ) -> Array3<f32> {
        let mut q = operator.forward(to_x);
        // Where no mask is open H is zero, and so is what is divided.
        q.zip_mut_with(&operator.gram(), |q, &d| *q = if d > 0.0 { *q / d } else { 0.0 });
        for &pixel in inactive {
            let at = [pixel / q.ncols(), pixel % q.ncols()];
            (q[at], to_y1[at]) = (0.0, 0.0);
        }
        if self.accelerate {
            *to_y1 += &q;
            q += &*to_y1;
        }
        &to_x - &operator.adjoint(q.view())
    }
}

/// The share of y by which v computed anew with 16-bit numbers may differ.
const ROUNDED: f32 = 4e-3;

/// The clipped pixels at which the data step from v to x, both `[T, C, H, W]`, left v as it was, since it gave them enough light: those whose light
/// has not become more, but for what 16-bit numbers round. Counted through the rows. Their y1 is taken to be y, as it is after some iterations.
fn inactive(measurement: &Measurement, v: ArrayView4<'_, f32>, x: ArrayView4<'_, f32>) -> Vec<usize> {
    let Some(level) = measurement.clip() else { return Vec::new() };
    let light = |video: ArrayView4<'_, f32>| {
        let mut sensor = Array3::zeros(measurement.shape().dim());
        match measurement.cfa() {
            Some(cfa) => mosaic_into(cfa, video, sensor.view_mut()),
            None => sensor.assign(&video.index_axis(Axis(1), 0)),
        }
        measurement.operator().forward(sensor.view())
    };
    let (before, after) = (light(v), light(x));
    let pixels = before.iter().zip(&after).zip(measurement.y()).enumerate();
    pixels.filter(|(_, ((v, x), y))| **y >= level && **x - **v <= ROUNDED * **y).map(|(pixel, _)| pixel).collect()
}

/// A denoiser that keeps what it is given in these calls (in order). The last of them is not denoised: nothing follows.
struct Recorder<'d> {
    denoiser: Box<dyn Denoiser + 'd>,
    calls: Vec<usize>,
    seen: Vec<RecordedCall>,
}

impl Denoiser for Recorder<'_> {
    fn name(&self) -> &str {
        "recorder"
    }

    fn denoise(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> std::result::Result<(), BoxError> {
        if self.calls.contains(&call.iteration) {
            let input = noisy.as_standard_layout().into_owned();
            self.seen.push(RecordedCall { input, sigma: call.required_sigma()?, iteration: call.iteration });
        }
        if self.seen.len() == self.calls.len() {
            out.assign(&noisy);
            return Ok(());
        }
        self.denoiser.denoise(call, noisy, out)
    }
}

/// The error of this crate that made a solver fail.
pub(crate) fn typed(error: SolveError) -> Error {
    let text = error.to_string();
    let source: Option<BoxError> = match error {
        SolveError::Prior { source, .. } => Some(source),
        _ => None,
    };
    source.and_then(|s| s.downcast::<Error>().ok()).map_or(Error::Data(text), |e| *e)
}

pub(crate) fn unusable(error: impl Display) -> Error {
    Error::Data(error.to_string())
}

pub(crate) fn tensor(video: Array4<f32>) -> Result<Tensor> {
    let shape = video.dim();
    Ok(Tensor::from_iter(video, &Device::Cpu)?.reshape(shape)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Ffdnet, FfdnetLayout, FfdnetSpec, Layers};
    use sci_forward::{CfaPattern, MaskOperator, MaskStack, VideoShape};
    use std::sync::Arc;

    /// Along the gradient in the weights the whole loss changes as it says: through the network, the projection and the
    /// accumulated measurement of every call.
    #[test]
    fn the_gradient_is_that_of_the_whole_loss() {
        let clip = Array4::from_shape_fn((3, 1, 12, 12), |(t, _, y, x)| ((7 * t + 5 * y + 3 * x) % 11) as f32 / 11.0);
        for accelerate in [true, false] {
            let (slope, norm) = slope_along_gradient(clip.clone(), accelerate, None);
            assert!((slope - norm).abs() < 0.01 * norm, "slope {slope}, gradient {norm}");
        }
    }

    /// A third of the pixels is clipped: where a video gives them enough light the data step leaves it alone.
    #[test]
    fn the_gradient_knows_which_clipped_pixels_ask_for_more() {
        let clip = Array4::from_shape_fn((3, 1, 12, 12), |(t, _, y, x)| ((7 * t + 5 * y + 3 * x) % 11) as f32 / 11.0);
        for accelerate in [true, false] {
            let (slope, norm) = slope_along_gradient(clip.clone(), accelerate, Some(0.9));
            assert!((slope - norm).abs() < 0.02 * norm, "slope {slope}, gradient {norm}");
        }
    }

    /// In color the demosaicing's part is an approximation.
    #[test]
    fn the_gradient_in_color_is_near_that_of_the_whole_loss() {
        let wave =
            |t: usize, c: usize, y: usize, x: usize| (0.5 * (t + y) as f32 + 0.3 * x as f32 + 0.7 * c as f32).sin();
        let clip = Array4::from_shape_fn((3, 3, 12, 12), |(t, c, y, x)| 0.5 + 0.3 * wave(t, c, y, x));
        let (slope, norm) = slope_along_gradient(clip, true, None);
        assert!((slope - norm).abs() < 0.25 * norm, "slope {slope}, gradient {norm}");
    }

    /// A clip through random masks, a tenth of the pixels not measured, by a sensor that clips at a level.
    fn measured(clip: &Array4<f32>, level: Option<f32>) -> Measurement {
        let (frames, channels, height, width) = clip.dim();
        let shape = VideoShape { frames, height, width };
        let operator = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.5, 2).unwrap()));
        let mut seen = clip.index_axis(Axis(1), 0).to_owned();
        if channels == 3 {
            mosaic_into(CfaPattern::Grbg, clip.view(), seen.view_mut());
        }
        let y = operator.forward(seen.view()).mapv_into(|y| level.map_or(y, |level| y.min(level)));
        let whole = Measurement::new(operator, y).unwrap().with_clip(level);
        let kept = Array2::from_shape_fn((height, width), |(y, x)| (3 * y + x) % 10 > 0);
        whole.with_cfa((channels == 3).then_some(CfaPattern::Grbg)).restricted(kept.view()).unwrap()
    }

    /// How the loss of three calls changes along its gradient by difference, and the gradient's length.
    fn slope_along_gradient(clip: Array4<f32>, accelerate: bool, level: Option<f32>) -> (f64, f64) {
        let channels = clip.len_of(Axis(1));
        let spec = FfdnetSpec { channels, width: 8, depth: 3, layout: FfdnetLayout::Residual { batch_norm: false } };
        let mut net = Ffdnet::random(spec, 1).unwrap();
        let sigmas = [40.0, 30.0, 20.0].map(|sigma| sigma / 255.0).to_vec();
        let recipe = Recipe { sigmas, accelerate, start: None, flips: true, dim: 1.3 };
        let (measurement, vars) = (measured(&clip, level), net.make_trainable().unwrap());
        let squared = |v: ArrayView4<'_, f32>| {
            let error = &v - &clip;
            let count = error.len() as f32;
            Ok((error.iter().map(|e| e * e).sum::<f32>() / count, error * (2.0 / count)))
        };

        let loss_at = |net: &mut Ffdnet| -> f64 {
            let mut seen = Vec::new();
            for call in recipe.record(&measurement, net, vec![0, 1, 2]).unwrap().unwrap() {
                let v = recipe.denoised(net, &tensor(call.input.clone()).unwrap(), &call).unwrap();
                let v = v.flatten_all().unwrap().to_vec1::<f32>().unwrap();
                let squares = v.iter().zip(&clip).map(|(v, clean)| f64::from(v - clean).powi(2));
                seen.push(squares.sum::<f64>() / clip.len() as f64);
            }
            (seen[0] + 2.0 * seen[1] + 4.0 * seen[2]) / 7.0
        };
        let calls = recipe.record(&measurement, &mut net, vec![0, 1, 2]).unwrap().unwrap();
        assert_eq!((calls.len(), calls[0].input.len_of(Axis(0))), (3, 3));
        let before = loss_at(&mut net);
        let found = recipe.gradient(&measurement, &calls, &net, &vars, &squared).unwrap();
        assert!((f64::from(found.loss) - before).abs() < 1e-5 * before, "{} {before}", found.loss);

        // Along the gradient itself: the change is the length of the gradient times the step.
        let gradients: Vec<Vec<f32>> = found.of_vars.into_iter().map(Option::unwrap).collect();
        let norm = gradients.iter().flatten().map(|&g| f64::from(g).powi(2)).sum::<f64>().sqrt();
        let old: Vec<Vec<f32>> = vars.iter().map(|(_, v)| v.flatten_all().unwrap().to_vec1().unwrap()).collect();
        let at = |step: f64| {
            for (((_, var), old), g) in vars.iter().zip(&old).zip(&gradients) {
                let new: Vec<f32> = old.iter().zip(g).map(|(w, g)| w + (step / norm) as f32 * g).collect();
                var.set(&Tensor::from_vec(new, var.shape(), var.device()).unwrap()).unwrap();
            }
            let state = net.state();
            let mut plain = Ffdnet::random(spec, 1).unwrap();
            plain.set_state(&state).unwrap();
            loss_at(&mut plain)
        };
        ((at(1e-2) - at(-1e-2)) / 2e-2, norm)
    }
}
