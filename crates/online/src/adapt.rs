//! The denoiser that updates its own network.

use crate::{
    AdaptConfig, AdaptLoss, Error, PixelSplit, Result, RollBackReason, SplitLoss, SplitRecord, Successor, Update,
    UpdateCounts, UpdateOutcome, accumulate_gradient, adapt_by_splitting,
};
use admm::{BoxError, Call, Denoiser};
use candle_core::{Tensor, Var};
use ndarray::{Array4, ArrayView4, ArrayViewMut4, Axis};
use nets::kernels::Precision;
use nets::train::Adam;
use nets::unrolled::Recipe;
use nets::weights::{Storage, WeightFile, write_safetensors};
use nets::{Network, SelectPrecision};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use sci_forward::Measurement;
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::Path;

/// A denoiser that adapts its network to the measurement that is being solved.
///
/// [`AdaptiveDenoiser::begin_measurement`] says that a measurement begins; the solver calls it as any other denoiser. When the
/// schedule says so, it updates its weights after denoising and denoises again, so that the new weights count in the same
/// iteration. Between updates it is the network itself, with its fast inference, and before the first measurement begins it
/// never updates.
///
/// It learns from [`Call::measurement`], which the solver was given, and needs it: decorators that show a denoiser the video
/// otherwise than the sensor saw it ([`admm::Flips`], [`admm::Tiles`]) go around other denoisers only.
///
/// ```
/// use admm::{Gap, Plan, Stage, Start, run};
/// use nets::{Ffdnet, FfdnetSpec};
/// use online::{AdaptConfig, AdaptiveDenoiser, UpdateSchedule};
/// use sci_forward::{MaskOperator, MaskStack, Measurement, SensingOperator, VideoShape, testing::moving_square};
/// use std::sync::Arc;
///
/// let shape = VideoShape { frames: 4, height: 16, width: 16 };
/// let h = MaskOperator::new(MaskStack::random(shape, 0.5, 0)?);
/// let y = h.forward(moving_square(shape).view());
/// let measurement = Measurement::new(Arc::new(h), y)?;
///
/// let net = Ffdnet::random(FfdnetSpec { width: 8, depth: 3, ..FfdnetSpec::GRAY }, 0)?;
/// let schedule = UpdateSchedule { interval: 2, learning_rate: 1e-3, ..UpdateSchedule::PAPER_FFDNET };
/// let mut denoiser = AdaptiveDenoiser::new(net, AdaptConfig { schedule, ..AdaptConfig::PAPER_FFDNET })?;
/// denoiser.begin_measurement(&measurement)?;
///
/// let plan = Plan::new([Stage { sigma: Some(0.1), iterations: 5 }]);
/// run(&mut Gap::accelerated(&mut denoiser), &measurement, Start::Mean, &plan, &mut ())?;
/// assert_eq!(denoiser.counts().kept, 2); // in iterations 2 and 4
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct AdaptiveDenoiser<N> {
    net: N,
    config: AdaptConfig,
    pretrained: BTreeMap<String, Tensor>,
    /// Measurements begun so far.
    measurements: usize,
    /// Measurements begun since the last reset.
    since_reset: usize,
    /// Updates fired in this measurement.
    fired: usize,
    /// Roll-backs in a row in this measurement.
    refused: usize,
    /// What roll-backs have made of the learning rate.
    rate: f64,
    updates: Vec<Update>,
}

impl<N> std::fmt::Debug for AdaptiveDenoiser<N> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("AdaptiveDenoiser")
            .field("config", &self.config)
            .field("updates", &self.updates)
            .finish_non_exhaustive()
    }
}

impl<N: Network + Denoiser> AdaptiveDenoiser<N> {
    /// Around a network with its pretrained weights.
    ///
    /// # Errors
    /// [`Error::Setting`].
    pub fn new(mut net: N, config: AdaptConfig) -> Result<Self> {
        config.validate()?;
        // That there is something to learn is to be known before a solve.
        net.boxed().make_some_trainable(config.parameters)?;
        net.set_precision(config.precision);
        let pretrained = net.state();
        Ok(Self {
            net,
            config,
            pretrained,
            measurements: 0,
            since_reset: 0,
            fired: 0,
            refused: 0,
            rate: 1.0,
            updates: Vec::new(),
        })
    }

    /// The next calls are those of a solve of this measurement. Weights stay as they are: see [`AdaptiveDenoiser::reset`].
    ///
    /// # Errors
    /// [`Error::Channels`] when the network is not for such a sensor.
    pub fn begin_measurement(&mut self, measurement: &Measurement) -> Result<()> {
        let (expected, found) = (measurement.channels(), self.net.channels());
        if expected != found {
            let sensor = if measurement.cfa().is_some() { "color" } else { "gray" };
            return Err(Error::Channels { network: self.net.describe(), sensor, expected, found });
        }
        (self.measurements, self.since_reset) = (self.measurements + 1, self.since_reset + 1);
        (self.fired, self.refused) = (0, 0);
        Ok(())
    }

    /// Puts the pretrained weights back, byte for byte, and forgets the learning rate. The measurement that begins next counts
    /// as the first of a sequence. The record of updates is kept.
    ///
    /// # Errors
    /// [`Error::Net`]; none that is known.
    pub fn reset(&mut self) -> Result<()> {
        self.net.set_state(&self.pretrained)?;
        (self.since_reset, self.rate) = (0, 1.0);
        Ok(())
    }

    /// Under [`AdaptLoss::Split`]: [`adapt_by_splitting`] from the present weights, to measurements that are to be solved by `recipe` and `successor`; under
    /// the other loss nothing.
    ///
    /// # Errors
    /// As [`adapt_by_splitting`].
    pub fn adapt_by_splitting(
        &mut self,
        measurements: &[Measurement],
        recipe: &Recipe,
        successor: Option<Successor<'_>>,
        watch: &mut dyn FnMut(usize) -> ControlFlow<()>,
    ) -> Result<Option<SplitRecord>>
    where
        N: Clone,
    {
        match &self.config.loss {
            AdaptLoss::Measurement => Ok(None),
            AdaptLoss::Split(split) => {
                adapt_by_splitting(&mut self.net, measurements, recipe, successor, split, watch).map(Some)
            }
        }
    }

    /// The network with its present weights.
    pub fn network(&self) -> &N {
        &self.net
    }

    /// The settings.
    pub fn config(&self) -> &AdaptConfig {
        &self.config
    }

    /// Every update that was due, in order, over all measurements.
    pub fn updates(&self) -> &[Update] {
        &self.updates
    }

    /// How many updates of which kind, over all measurements.
    pub fn counts(&self) -> UpdateCounts {
        UpdateCounts::of(&self.updates)
    }

    /// Writes the present weights under their published names as `.safetensors`, to be loaded as any other weights.
    ///
    /// # Errors
    /// [`Error::Net`] when the file cannot be written.
    pub fn save(&self, path: &Path) -> Result<()> {
        Ok(write_safetensors(path, &self.net.state(), Storage::F32)?)
    }

    /// Takes the weights of a file as the present ones; a reset still goes back to the pretrained ones.
    ///
    /// # Errors
    /// [`Error::Net`] when the file cannot be read or is of another network.
    pub fn load(&mut self, path: &Path) -> Result<()> {
        Ok(self.net.set_state(&WeightFile::read(path)?.into_tensors())?)
    }

    /// Counts updates of the measurement begun last that were made before the program was stopped: they go into the record, and
    /// the learning rate is what their roll-backs made of it. Their weights come by [`AdaptiveDenoiser::load`].
    pub fn take_up(&mut self, updates: &[Update]) {
        let undone = updates.iter().filter(|u| matches!(u.outcome, UpdateOutcome::RolledBack(_)));
        undone.for_each(|_| self.rate *= self.config.roll_back.back_off);
        self.updates.extend_from_slice(updates);
    }

    fn due(&self, iteration: usize) -> bool {
        let of_sequence = self.since_reset.saturating_sub(1);
        self.config.loss == AdaptLoss::Measurement
            && self.measurements > 0
            && self.config.schedule.due(iteration, of_sequence, self.fired)
    }

    /// An update that is due: `out` is the output of the present weights for `noisy`, and becomes that of the new ones if they
    /// stay.
    fn update(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<Update> {
        let measurement = call.measurement.ok_or(Error::NoMeasurement { iteration: call.iteration })?;
        let learning_rate = self.config.schedule.learning_rate * self.rate;
        let record = Update::skipped(self.measurements.saturating_sub(1), call.iteration, learning_rate);
        self.fired += 1;
        if self.refused >= self.config.roll_back.patience {
            return Ok(record);
        }
        let pixels = PixelSplit::draw(measurement, self.config.roll_back.held_out, self.config.seed);
        let lesson = Lesson { call, measurement, pixels, noisy, learning_rate };
        let before = lesson.loss(out.view())?;
        // Variables are copies: what is trained leaves these as they are.
        let weights = self.net.state();
        let trial = self.trial(&lesson, out.view());
        let objection = match &trial {
            Ok(Some(trial)) => self.objection(before, trial.loss),
            Ok(None) | Err(_) => Some(RollBackReason::NotFinite),
        };
        if objection.is_some() {
            self.net.set_state(&weights)?;
        }
        let trial = trial?;
        let record = record.with(before, trial.as_ref().map(|trial| trial.loss));
        match (objection, trial) {
            (None, Some(trial)) => {
                out.assign(&trial.output);
                self.refused = 0;
                Ok(Update { outcome: UpdateOutcome::Kept, ..record })
            }
            (objection, _) => {
                self.rate *= self.config.roll_back.back_off;
                self.refused += 1;
                let reason = objection.unwrap_or(RollBackReason::NotFinite);
                Ok(Update { outcome: UpdateOutcome::RolledBack(reason), ..record })
            }
        }
    }

    /// Trains, and denoises again; nothing when a number was not finite. `before` is the output so far.
    fn trial(&mut self, lesson: &Lesson<'_>, before: ArrayView4<'_, f32>) -> Result<Option<Trial>> {
        let vars = self.net.make_some_trainable(self.config.parameters)?;
        let mut adam = Adam::new(vars.iter().map(|(_, var)| var.clone()).collect());
        let std = self.config.schedule.input_noise;
        let noisier = (std > 0.0).then(|| with_noise(lesson.noisy, std, &mut self.rng(lesson.call.iteration)));
        let input = noisier.as_ref().map_or(lesson.noisy, |noisier| noisier.view());
        for step in 0..self.config.schedule.steps {
            let known = (step == 0 && std == 0.0).then_some(before);
            let grads = self.gradient(lesson, &vars, input, known, step)?;
            let grads: Vec<_> = grads.into_iter().map(Some).collect();
            if !adam.apply(&grads, lesson.learning_rate, f64::INFINITY)?.is_finite() {
                return Ok(None);
            }
        }
        // Constants again, which inference packs once instead of for every frame.
        self.net.set_state(&self.net.state())?;
        let output = self.denoised(lesson.call, lesson.noisy)?;
        let loss = lesson.loss(output.view())?;
        Ok((loss.is_finite() && output.iter().all(|v| v.is_finite())).then_some(Trial { output, loss }))
    }

    /// The gradient of the loss by each of `vars` in a step of the update, of the frames whose turn it is. `known` is the output
    /// for `input`, if it is known.
    fn gradient(
        &mut self,
        lesson: &Lesson<'_>,
        vars: &[(String, Var)],
        input: ArrayView4<'_, f32>,
        known: Option<ArrayView4<'_, f32>>,
        step: usize,
    ) -> Result<Vec<Vec<f32>>> {
        let residual = match known {
            Some(v) => lesson.measurement.residual(v)?,
            None => lesson.measurement.residual(self.denoised(lesson.call, input)?.view())?,
        };
        let mut upstream = lesson.measurement.pull_back(lesson.pixels.gradient(residual.view()).view());
        let turn = (self.fired - 1) * self.config.schedule.steps + step;
        let stride = self.config.schedule.stride.min(upstream.len_of(Axis(0)));
        let others = upstream.outer_iter_mut().enumerate().filter(|(t, _)| t % stride != turn % stride);
        others.for_each(|(_, mut frame)| frame.fill(0.0));
        let sigma = lesson.call.required_sigma().map_err(Error::Denoiser)?;
        let mut sums: Vec<Vec<f32>> = vars.iter().map(|(_, var)| vec![0.0; var.elem_count()]).collect();
        accumulate_gradient(&self.net, vars, input, sigma, upstream.view(), &mut sums)?;
        Ok(sums)
    }

    /// Why an update is to be undone. Where pixels are to be held out it is never kept without their judgement.
    fn objection(&self, before: SplitLoss, after: SplitLoss) -> Option<RollBackReason> {
        if self.config.roll_back.held_out == 0.0 {
            return None;
        }
        // What was not finite before is not worth keeping either: nothing falls below a NaN.
        let falls = |before: f64, after: f64| after < before;
        let judged = before.held_out.zip(after.held_out);
        if !judged.is_some_and(|(before, after)| falls(before, after)) {
            return Some(RollBackReason::HeldOut);
        }
        (!falls(before.loss, after.loss)).then_some(RollBackReason::Loss)
    }

    /// The generator of an update: one stream for each iteration of each measurement.
    fn rng(&self, iteration: usize) -> ChaCha8Rng {
        let mut rng = ChaCha8Rng::seed_from_u64(self.config.seed);
        rng.set_stream((self.since_reset as u64) << 32 | (iteration as u64 & 0xffff_ffff));
        rng
    }

    fn denoised(&mut self, call: &Call<'_>, noisy: ArrayView4<'_, f32>) -> Result<Array4<f32>> {
        let mut v = Array4::zeros(noisy.dim());
        self.net.denoise(call, noisy, v.view_mut()).map_err(Error::Denoiser)?;
        Ok(v)
    }
}

/// What an update learns from.
struct Lesson<'l> {
    call: &'l Call<'l>,
    measurement: &'l Measurement,
    pixels: PixelSplit,
    /// The input of the network.
    noisy: ArrayView4<'l, f32>,
    learning_rate: f64,
}

impl Lesson<'_> {
    /// Of an output of the network.
    fn loss(&self, output: ArrayView4<'_, f32>) -> Result<SplitLoss> {
        Ok(self.pixels.loss(self.measurement.residual(output)?.view()))
    }
}

/// What the network does after an update, all of it finite.
struct Trial {
    output: Array4<f32>,
    loss: SplitLoss,
}

/// `video + std · n`, `n` standard normal.
fn with_noise(video: ArrayView4<'_, f32>, std: f32, rng: &mut ChaCha8Rng) -> Array4<f32> {
    video.mapv(|v| v + std * rng.sample::<f32, _>(StandardNormal))
}

impl<N: Network + Denoiser> SelectPrecision for AdaptiveDenoiser<N> {
    fn select_precision(&mut self, precision: Precision) {
        self.net.set_inference_precision(precision);
    }
}

impl<N: Network + Denoiser> Denoiser for AdaptiveDenoiser<N> {
    fn name(&self) -> &str {
        self.net.name()
    }

    fn denoise(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        self.net.denoise(call, noisy, out.view_mut())?;
        if self.due(call.iteration) {
            let update = self.update(call, noisy, out)?;
            self.updates.push(update);
        }
        Ok(())
    }
}
