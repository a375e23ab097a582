//! The denoiser that updates its own network.

use crate::{
    AdaptConfig, Counts, Error, Outcome, Pixels, Result, RollBack, Snapshot, SplitLoss, Update, accumulate_gradient,
};
use admm::{BoxError, DenoiseCx, Denoiser};
use candle_core::{Tensor, Var};
use ndarray::{Array4, ArrayView4, ArrayViewMut4, Axis, Zip, s};
use nets::kernels::Precision;
use nets::train::Adam;
use nets::weights::{Storage, WeightFile, write_safetensors};
use nets::{Network, Precise};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use std::collections::BTreeMap;
use std::path::Path;

/// A denoiser that adapts its network to the measurement that is being solved.
///
/// [`AdaptiveDenoiser::bind`] tells it the measurement; the solver calls it as any other denoiser. When the schedule
/// says so, it updates its weights after denoising and denoises again, so that the new weights count in the same
/// iteration. Between updates it is the network itself, with its fast inference. Without a measurement it never updates.
///
/// ```
/// use admm::{Gap, Plan, Problem, Stage, Start, run};
/// use nets::{Ffdnet, FfdnetSpec};
/// use online::{AdaptConfig, AdaptiveDenoiser, Schedule, Snapshot};
/// use sci_forward::{MaskOperator, MaskStack, SensingOperator, VideoShape, testing::moving_square};
/// use std::sync::Arc;
///
/// let shape = VideoShape { frames: 4, height: 16, width: 16 };
/// let h = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.5, 0)?));
/// let y = h.forward(moving_square(shape).view());
///
/// let net = Ffdnet::random(FfdnetSpec { width: 8, depth: 3, ..FfdnetSpec::GRAY }, 0)?;
/// let schedule = Schedule { interval: 2, learning_rate: 1e-3, ..Schedule::PAPER_FFDNET };
/// let mut denoiser = AdaptiveDenoiser::new(net, AdaptConfig { schedule, ..AdaptConfig::PAPER_FFDNET })?;
/// denoiser.bind(Snapshot::new(h.clone(), y.view(), None)?)?;
///
/// let plan = Plan::new([Stage { sigma: 0.1, iterations: 5 }]);
/// let mut solver = Gap::accelerated(&mut denoiser);
/// run(&mut solver, &Problem::new(h.as_ref(), y.view())?, Start::Mean, &plan, &mut ())?;
/// assert_eq!(denoiser.counts().kept, 2); // in iterations 2 and 4
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct AdaptiveDenoiser<N> {
    net: N,
    config: AdaptConfig,
    pretrained: BTreeMap<String, Tensor>,
    bound: Option<Bound>,
    /// Measurements bound so far.
    measurements: usize,
    /// Measurements bound since the last reset.
    since_reset: usize,
    /// Updates fired in this measurement.
    fired: usize,
    /// Roll-backs in a row in this measurement.
    refused: usize,
    /// What roll-backs have made of the learning rate.
    rate: f64,
    optimizer: Option<Adam>,
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

/// What the denoiser looks at.
#[derive(Debug)]
struct Bound {
    snapshot: Snapshot,
    pixels: Pixels,
}

impl<N: Network + Denoiser> AdaptiveDenoiser<N> {
    /// Around a network with its pretrained weights.
    ///
    /// # Errors
    /// [`Error::Setting`].
    pub fn new(mut net: N, config: AdaptConfig) -> Result<Self> {
        config.validate()?;
        net.set_precision(config.precision);
        let pretrained = net.state();
        Ok(Self {
            net,
            config,
            pretrained,
            bound: None,
            measurements: 0,
            since_reset: 0,
            fired: 0,
            refused: 0,
            rate: 1.0,
            optimizer: None,
            updates: Vec::new(),
        })
    }

    /// Turns to a measurement. Weights stay as they are: see [`AdaptiveDenoiser::reset`].
    ///
    /// # Errors
    /// [`Error::Channels`] when the network is not for such a sensor.
    pub fn bind(&mut self, snapshot: Snapshot) -> Result<()> {
        let (expected, found) = (snapshot.channels(), self.net.channels());
        if expected != found {
            let sensor = if snapshot.cfa().is_some() { "color" } else { "gray" };
            return Err(Error::Channels { network: self.net.describe(), sensor, expected, found });
        }
        let Self { config, .. } = self;
        let (size, held_out) = (snapshot.shape().image_dim(), config.guard.held_out);
        let pixels = match config.blind {
            None => Pixels::split(size, held_out, config.seed),
            Some(seen) => Pixels::blind(size, held_out, seen, config.seed),
        };
        self.bound = Some(Bound { snapshot, pixels });
        (self.measurements, self.since_reset) = (self.measurements + 1, self.since_reset + 1);
        (self.fired, self.refused) = (0, 0);
        Ok(())
    }

    /// Puts the pretrained weights back, byte for byte, and forgets optimiser and learning rate. The measurement that is
    /// bound next counts as the first of a sequence. The record of updates is kept.
    ///
    /// # Errors
    /// [`Error::Net`]; none that is known.
    pub fn reset(&mut self) -> Result<()> {
        self.net.set_state(&self.pretrained)?;
        (self.since_reset, self.rate, self.optimizer) = (0, 1.0, None);
        Ok(())
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
    pub fn counts(&self) -> Counts {
        Counts::of(&self.updates)
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

    /// The generator of an update: one stream for each iteration of each measurement.
    fn rng(&self, iteration: usize) -> ChaCha8Rng {
        let mut rng = ChaCha8Rng::seed_from_u64(self.config.seed);
        rng.set_stream((self.since_reset as u64) << 32 | (iteration as u64 & 0xffff_ffff));
        rng
    }

    /// An update that is due: `out` is the output of the present weights, and becomes that of the new ones if they stay.
    fn update(
        &mut self,
        bound: &Bound,
        cx: &DenoiseCx,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<()> {
        let mut record = Update {
            measurement: self.measurements - 1,
            iteration: cx.iteration,
            learning_rate: self.config.schedule.learning_rate * self.rate,
            outcome: Outcome::Skipped,
            loss_before: None,
            loss_after: None,
            held_out_before: None,
            held_out_after: None,
        };
        self.fired += 1;
        if self.refused >= self.config.guard.patience {
            self.updates.push(record);
            return Ok(());
        }
        // What the loss looks at: the output itself, or that for the blinded input.
        let blinded = bound.pixels.blinded(noisy);
        let input = blinded.as_ref().map_or(noisy, |blinded| blinded.view());
        let looked_at = blinded.as_ref().map(|blinded| self.denoised(cx, blinded.view())).transpose()?;
        let seen = looked_at.as_ref().map_or(out.view(), |v| v.view());
        let before = bound.pixels.loss(bound.snapshot.residual(seen)?.view());
        // Variables are copies: what is trained leaves these as they are.
        let (weights, optimizer) = (self.net.state(), self.optimizer.clone());
        let tried = self.trial(bound, (cx, record.learning_rate), input, seen, out.view());
        let outcome = tried.and_then(|tried| {
            let Some((v, after)) = tried else { return Ok(Err(RollBack::NotFinite)) };
            record = record.with(before, Some(after));
            if let Some(reason) = objection(before, after) {
                return Ok(Err(reason));
            }
            let v = if blinded.is_some() { self.denoised(cx, noisy)? } else { v };
            Ok(if v.iter().all(|v| v.is_finite()) { Ok(v) } else { Err(RollBack::NotFinite) })
        });
        record = if record.loss_before.is_none() { record.with(before, None) } else { record };
        let restored = !matches!(outcome, Ok(Ok(_)));
        if restored {
            self.optimizer = optimizer;
            self.net.set_state(&weights)?;
        }
        match outcome? {
            Ok(v) => {
                out.assign(&v);
                self.refused = 0;
                record.outcome = Outcome::Kept;
            }
            Err(reason) => {
                self.rate *= self.config.guard.back_off;
                self.refused += 1;
                record.outcome = Outcome::RolledBack(reason);
            }
        }
        self.updates.push(record);
        Ok(())
    }

    /// Trains, and denoises `input` again; nothing when a number was not finite. `before` is the output for `input`,
    /// `target` the output of the iteration so far.
    fn trial(
        &mut self,
        bound: &Bound,
        (cx, learning_rate): (&DenoiseCx, f64),
        input: ArrayView4<'_, f32>,
        before: ArrayView4<'_, f32>,
        target: ArrayView4<'_, f32>,
    ) -> Result<Option<(Array4<f32>, SplitLoss)>> {
        let vars = self.net.make_some_trainable(self.config.parameters)?;
        let trained = vars.iter().map(|(_, var)| var.clone()).collect();
        let kept = self.optimizer.take().filter(|_| self.config.schedule.keep_optimizer);
        let mut adam = match kept {
            Some(mut adam) => {
                adam.rebind(trained);
                adam
            }
            None => Adam::new(trained),
        };
        let mut rng = self.rng(cx.iteration);
        let std = self.config.schedule.input_noise;
        let noisier = (std > 0.0).then(|| renoised(input, std, &mut rng));
        let train_on = noisier.as_ref().map_or(input, |noisier| noisier.view());
        for step in 0..self.config.schedule.steps {
            let known = (step == 0 && std == 0.0).then_some(before);
            let turn = (self.fired - 1) * self.config.schedule.steps + step;
            let grads = self.gradient(bound, (cx, turn), &vars, train_on, known, target, &mut rng)?;
            let grads: Vec<_> = grads.into_iter().map(Some).collect();
            if !adam.apply(&grads, learning_rate, f64::INFINITY)?.is_finite() {
                return Ok(None);
            }
        }
        self.optimizer = self.config.schedule.keep_optimizer.then_some(adam);
        // Constants again, which inference packs once instead of for every frame.
        self.net.set_state(&self.net.state())?;
        let v = self.denoised(cx, input)?;
        let after = bound.pixels.loss(bound.snapshot.residual(v.view())?.view());
        Ok(after.is_finite().then_some((v, after)))
    }

    /// The gradient of the loss with all its terms by each of `vars`, in the turn `turn` through the frames that take turns.
    /// `known` is the output for `input`, if it is known; `target` is the output before the update.
    #[expect(clippy::too_many_arguments, reason = "the state of one update, used once")]
    fn gradient(
        &mut self,
        bound: &Bound,
        (cx, turn): (&DenoiseCx, usize),
        vars: &[(String, Var)],
        input: ArrayView4<'_, f32>,
        known: Option<ArrayView4<'_, f32>>,
        target: ArrayView4<'_, f32>,
        rng: &mut ChaCha8Rng,
    ) -> Result<Vec<Vec<f32>>> {
        let mut sums: Vec<Vec<f32>> = vars.iter().map(|(_, var)| vec![0.0; var.elem_count()]).collect();
        let residual = match known {
            Some(v) => bound.snapshot.residual(v)?,
            None => bound.snapshot.residual(self.denoised(cx, input)?.view())?,
        };
        let mut upstream = bound.snapshot.pull_back(bound.pixels.gradient(residual.view()).view());
        let stride = self.config.schedule.stride.min(upstream.len_of(Axis(0)));
        let others = upstream.outer_iter_mut().enumerate().filter(|(t, _)| t % stride != turn % stride);
        others.for_each(|(_, mut frame)| frame.fill(0.0));
        accumulate_gradient(&self.net, vars, input, cx.sigma, upstream.view(), &mut sums)?;

        let terms = self.config.terms;
        if terms.pseudo_clean > 0.0 {
            let input = renoised(target, cx.sigma, rng);
            self.pull_to(target, input.view(), terms.pseudo_clean, cx, vars, &mut sums)?;
        }
        if terms.equivariance > 0.0 {
            let flip = rng.random_range(0..4);
            self.pull_to(flipped(target, flip), flipped(input, flip), terms.equivariance, cx, vars, &mut sums)?;
        }
        if terms.distance > 0.0 {
            let factor = (2.0 * terms.distance) as f32;
            for ((name, var), sum) in vars.iter().zip(&mut sums) {
                let (now, start) = (var.flatten_all()?.to_vec1::<f32>()?, &self.pretrained[name]);
                let start = start.flatten_all()?.to_vec1::<f32>()?;
                sum.iter_mut()
                    .zip(now.iter().zip(&start))
                    .for_each(|(sum, (now, start))| *sum += factor * (now - start));
            }
        }
        Ok(sums)
    }

    /// Adds the gradient of `weight · mean (f(input) − target)²`.
    fn pull_to(
        &mut self,
        target: ArrayView4<'_, f32>,
        input: ArrayView4<'_, f32>,
        weight: f64,
        cx: &DenoiseCx,
        vars: &[(String, Var)],
        sums: &mut [Vec<f32>],
    ) -> Result<()> {
        let mut upstream = self.denoised(cx, input)?;
        let factor = (2.0 * weight / upstream.len() as f64) as f32;
        Zip::from(&mut upstream).and(target).for_each(|v, &target| *v = factor * (*v - target));
        accumulate_gradient(&self.net, vars, input, cx.sigma, upstream.view(), sums)
    }

    fn denoised(&mut self, cx: &DenoiseCx, noisy: ArrayView4<'_, f32>) -> Result<Array4<f32>> {
        let mut v = Array4::zeros(noisy.dim());
        self.net.denoise(cx, noisy, v.view_mut()).map_err(Error::Denoiser)?;
        Ok(v)
    }
}

/// Why an update is to be undone, unless nothing is held out to judge it.
fn objection(before: SplitLoss, after: SplitLoss) -> Option<RollBack> {
    let (Some(held_before), Some(held_after)) = (before.held_out, after.held_out) else { return None };
    // What was not finite before is not worth keeping either: nothing falls below a NaN.
    let falls = |before: f64, after: f64| after < before;
    match (falls(held_before, held_after), falls(before.loss, after.loss)) {
        (true, true) => None,
        (true, false) => Some(RollBack::Loss),
        (false, _) => Some(RollBack::HeldOut),
    }
}

/// `video + std · n`, `n` standard normal.
fn renoised(video: ArrayView4<'_, f32>, std: f32, rng: &mut ChaCha8Rng) -> Array4<f32> {
    video.mapv(|v| v + std * rng.sample::<f32, _>(StandardNormal))
}

/// Rows, columns, both, or the order of frames reversed.
fn flipped(video: ArrayView4<'_, f32>, flip: u32) -> ArrayView4<'_, f32> {
    match flip {
        0 => video.slice_move(s![.., .., ..;-1, ..]),
        1 => video.slice_move(s![.., .., .., ..;-1]),
        2 => video.slice_move(s![.., .., ..;-1, ..;-1]),
        _ => video.slice_move(s![..;-1, .., .., ..]),
    }
}

impl<N: Network + Denoiser> Precise for AdaptiveDenoiser<N> {
    fn compute_in(&mut self, precision: Precision) {
        self.net.set_inference_precision(precision);
    }
}

impl<N: Network + Denoiser> Denoiser for AdaptiveDenoiser<N> {
    fn name(&self) -> &str {
        self.net.name()
    }

    fn denoise(
        &mut self,
        cx: &DenoiseCx,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        self.net.denoise(cx, noisy, out.view_mut())?;
        let measurement = self.since_reset.saturating_sub(1);
        if !self.config.schedule.due(cx.iteration, measurement, self.fired) {
            return Ok(());
        }
        let Some(bound) = self.bound.take() else { return Ok(()) };
        let updated = self.update(&bound, cx, noisy, out);
        self.bound = Some(bound);
        Ok(updated?)
    }
}
