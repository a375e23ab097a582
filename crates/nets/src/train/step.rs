//! The training loop's body.

use super::adam::Adam;
use super::blend::blend;
use super::camera;
use super::centre::{Centre, Variables, hold_open, open};
use super::checkpoint::{self, Meta};
use super::config::{CameraConfig, IteratesConfig, NoiseConfig, Optimizer, TrainConfig, TrainingConfig};
use super::data::{TrainData, to_video};
use super::noise::{add_noise, sensor};
use super::revive::{Idle, State};
use crate::layers::Conv;
use crate::unrolled::{Gradients, RecordedCall, tensor};
use crate::weights::{Storage, write_safetensors};
use crate::{Error, Network, Result};
use admm::Call;
use candle_core::{Device, Tensor, Var};
use ndarray::{Array4, ArrayView4, Axis, concatenate, s};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use sci_forward::metrics::psnr;
use sci_forward::{CfaPattern, Measurement};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What a step did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepReport {
    /// Its number, counted from 1.
    pub step: u64,
    /// The loss before it.
    pub loss: f32,
    /// The learning rate.
    pub learning_rate: f64,
    /// Norm of the gradient before it was shortened.
    pub gradient_norm: f64,
    /// Channels that began anew after it, because a ReLU had shut them for every input for a long time.
    pub revived: usize,
}

/// Mean PSNR over the frames of all validation clips.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Score {
    /// σ in 0..255 units; nothing for clips that were reconstructed from a measurement.
    pub sigma: Option<f32>,
    /// PSNR of the result in dB, data range 1.
    pub psnr_db: f64,
}

/// How [`Trainer::resume`] found its state.
#[derive(Debug)]
pub struct Resumed {
    /// The file it was read from.
    pub from: PathBuf,
    /// Why the newest checkpoint was refused, if it was.
    pub refused: Option<Error>,
}

/// Clean clips, what the network sees of them (both `[clips · T, C, P, P]`), σ of each.
struct Batch {
    clean: Tensor,
    seen: Tensor,
    sigmas: Vec<f32>,
}

/// What an update learns from.
enum Lesson {
    /// Noisy clips, or one iterate of a solver.
    Batch(Batch),
    /// Consecutive calls of a solver, and the truth.
    Unrolled { measurement: Box<Measurement>, clean: Array4<f32>, calls: Vec<RecordedCall> },
}

/// One training run.
///
/// ```
/// use nets::train::*;
/// # let frame = |seed: usize| Frame::from_shape_fn((1, 12, 12), |(_, y, x)| ((7 * y + 5 * x + seed) % 97) as u8);
/// let config: TrainConfig = serde_json::from_str(r#"{
///     "name": "tiny",
///     "network": { "kind": "ffdnet", "channels": 1, "width": 4, "depth": 3 },
///     "data": { "photos": "photos", "validation": "validation", "photo_share": 1.0, "patch": 8, "batch": 2 },
///     "noise": { "sigma": [0, 50] },
///     "training": { "steps": 3, "learning_rate": 1e-3 }
/// }"#)?;
/// let data = TrainData { photos: vec![frame(0), frame(1)], validation: vec![vec![frame(2)]], ..Default::default() };
/// let mut trainer = Trainer::new(config, data)?;
/// while !trainer.finished() {
///     assert!(trainer.step()?.loss.is_finite());
/// }
/// assert_eq!(trainer.validate()?.len(), 3);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Trainer {
    config: TrainConfig,
    data: TrainData,
    model: Box<dyn Network>,
    /// Makes the first calls of the solves of [`IteratesConfig`].
    first: Option<Box<dyn Network>>,
    vars: Vec<(String, Var)>,
    adam: Adam,
    average: Vec<Vec<f32>>,
    /// What it began with.
    start: Vec<Vec<f32>>,
    idle: Idle,
    /// Whether it began with random weights.
    random: bool,
    /// The share of the settings' learning rate that is left after divergences.
    rate: f64,
    step: u64,
}

impl std::fmt::Debug for Trainer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Trainer").field("config", &self.config).field("step", &self.step).finish_non_exhaustive()
    }
}

/// Steps between measurements of what the layers are given on average.
const CENTRE_EVERY: u64 = 20;

/// Streams of the generator: the steps take the ones from 0.
const VALIDATION_STREAM: u64 = 1 << 63;

/// Frames and largest side of the clips that are reconstructed to validate.
const VALIDATION_FRAMES: usize = 8;
const VALIDATION_SIDE: usize = 256;
/// Noise on measurements that are solved to validate, in 0..255 units.
const NOISE_LEVELS: [Option<f32>; 2] = [None, Some(25.0)];

impl Trainer {
    /// A run at its beginning.
    ///
    /// # Errors
    /// [`Error::Setting`] for a value out of range, [`Error::Data`] for unusable data.
    pub fn new(config: TrainConfig, data: TrainData) -> Result<Self> {
        config.validate()?;
        data.check(config.network.channels(), config.data.photo_share)?;
        let (architecture, ends) = config.network.architecture();
        let mut model = architecture.random(ends, config.seed)?;
        let first = match &config.iterates {
            Some(iterates) => iterates.load_first(config.network.channels())?,
            None => None,
        };
        model.set_precision(config.training.precision);
        let vars = model.make_trainable()?;
        let adam = Adam::new(vars.iter().map(|(_, var)| var.clone()).collect());
        let adam = if config.training.optimizer == Optimizer::Muon { adam.with_muon() } else { adam };
        let start = vars.iter().map(|(_, var)| values(var)).collect::<Result<Vec<_>>>()?;
        let (average, idle) = (start.clone(), Idle::new(&model.convs(), &vars));
        Ok(Self { config, data, model, first, vars, adam, average, start, idle, random: true, rate: 1.0, step: 0 })
    }

    /// Begins with these weights, or those of a smaller network of the kind, instead of random ones, but for the layers of
    /// [`TrainConfig::renew`], which the file may lack.
    ///
    /// # Errors
    /// [`Error::State`] when names or shapes are not those of the network, [`Error::Setting`] when it has no layer of such a name.
    pub fn start_from(&mut self, weights: &BTreeMap<String, Tensor>) -> Result<()> {
        let random = self.model.state();
        if let Some(part) = self.config.renew.iter().find(|part| !random.keys().any(|name| name.contains(&***part))) {
            let legal = "parts of the names of the network's layers".to_owned();
            return Err(Error::Setting { key: "renew", value: part.clone(), legal });
        }
        let renewed = random.into_iter().filter(|(name, _)| self.config.renews(name));
        let mut weights = weights.clone();
        self.model.grow(&mut weights)?;
        self.model.set_state(&weights.into_iter().chain(renewed).collect())?;
        self.vars = self.model.make_trainable()?;
        self.adam.rebind(self.vars.iter().map(|(_, var)| var.clone()).collect());
        self.start = self.vars.iter().map(|(_, var)| values(var)).collect::<Result<_>>()?;
        self.average = self.start.clone();
        self.random = false;
        Ok(())
    }

    /// The settings.
    pub fn config(&self) -> &TrainConfig {
        &self.config
    }

    /// What is trained, with its size.
    pub fn describe(&self) -> String {
        self.model.describe()
    }

    /// Number of trained values.
    pub fn parameter_count(&self) -> usize {
        self.model.parameter_count()
    }

    /// The share of the learning rate of the settings that is left after divergences, 1 without any.
    pub fn rate(&self) -> f64 {
        self.rate
    }

    /// Steps done.
    pub fn steps_done(&self) -> u64 {
        self.step
    }

    /// Whether all steps are done.
    pub fn finished(&self) -> bool {
        self.step >= self.config.training.steps
    }

    /// The generator of a step (or of a validation): the same after a resume as in one go.
    fn rng(&self, stream: u64) -> ChaCha8Rng {
        let mut rng = ChaCha8Rng::seed_from_u64(self.config.seed);
        rng.set_stream(stream);
        rng
    }

    /// Noisy clips.
    fn noisy(&self, noise: &NoiseConfig, rng: &mut ChaCha8Rng) -> Result<Batch> {
        let data = &self.config.data;
        let [low, high] = noise.sigma.map(|s| s / 255.0);
        let (mut clean, mut seen, mut sigmas) = (Vec::new(), Vec::new(), Vec::new());
        for _ in 0..data.batch {
            let clip = self.data.clip(rng, data.frames, data.patch, data.photo_share);
            let sigma = low + (high - low) * rng.random::<f32>();
            let mut noisy = clip.clone();
            add_noise(&mut noisy, sigma, rng);
            seen.push(self.seen(noisy));
            clean.push(clip);
            sigmas.push(sigma);
        }
        Ok(Batch { clean: stack(&clean)?, seen: stack(&seen)?, sigmas })
    }

    /// What the network is shown of noisy frames.
    fn seen(&self, noisy: Array4<f32>) -> Array4<f32> {
        if self.model.sees_mosaics() { sensor(noisy.view()) } else { noisy }
    }

    /// Iterates of the solver with the network as it is, each a lesson of its own as clips differ in length; with
    /// `unrolled` a lesson for each clip.
    fn iterates(&self, settings: &IteratesConfig, rng: &mut ChaCha8Rng) -> Result<Vec<Lesson>> {
        let now = self.vars.iter().map(|(name, var)| (name.clone(), var.as_detached_tensor()));
        let mut model = self.frozen(now.collect());
        model.set_inference_precision(self.config.training.precision);
        let seeds: Vec<u64> = (0..self.config.data.batch).map(|_| rng.random()).collect();
        let clip = |seed: u64| {
            let (data, mut rng) = (&self.config.data, ChaCha8Rng::seed_from_u64(seed));
            let [few, many] = self.camera().frames;
            let frames = rng.random_range(few..=many);
            let clip = self.data.clip(&mut rng, frames, data.patch, data.photo_share);
            let pattern = CfaPattern::ALL[rng.random_range(0..4)];
            let measurement = camera::measure(clip.view(), pattern, self.camera(), &mut rng)?;
            let mut model = model.boxed();
            let mut denoiser = settings.relay(self.first.as_deref(), &mut *model);
            let diverged = Error::Diverged { step: self.step + 1, loss: f32::NAN };
            let calls = settings.record(&measurement, &mut denoiser, &mut rng)?.ok_or(diverged)?;
            if settings.unrolled {
                return Ok(vec![Lesson::Unrolled { measurement: Box::new(measurement), clean: clip, calls }]);
            }
            let clean = stack(&[clip])?;
            let lesson = |RecordedCall { input, sigma, .. }| {
                Ok(Lesson::Batch(Batch { clean: clean.clone(), seen: tensor(input)?, sigmas: vec![sigma] }))
            };
            calls.into_iter().map(lesson).collect::<Result<Vec<_>>>()
        };
        let clips = seeds.into_par_iter().map(clip).collect::<Result<Vec<_>>>()?;
        Ok(clips.into_iter().flatten().collect())
    }

    fn camera(&self) -> &CameraConfig {
        self.config.camera.as_ref().expect("validated: iterates have a camera")
    }

    /// One update, by a new batch of noisy clips, by iterates of a solver or by whole solves; by both, if the settings have both.
    ///
    /// # Errors
    /// [`Error::Diverged`] when loss or gradient is not finite: [`Trainer::back_off`] is the way to go on then.
    ///
    /// # Panics
    /// Never: [`Trainer::new`] checked the settings.
    pub fn step(&mut self) -> Result<StepReport> {
        // Stream 0 initialised the weights.
        let mut rng = self.rng(self.step + 1);
        let learning_rate = self.rate * self.config.learning_rate(self.step);
        let mut lessons = match &self.config.iterates {
            Some(iterates) => self.iterates(iterates, &mut rng)?,
            None => Vec::new(),
        };
        if let Some(noise) = &self.config.noise {
            lessons.push(Lesson::Batch(self.noisy(noise, &mut rng)?));
        }
        if self.step == 0 {
            self.open_layers(&lessons[0])?;
        }
        if self.config.training.optimizer == Optimizer::Muon && self.step.is_multiple_of(CENTRE_EVERY) {
            self.find_centres(&lessons[0])?;
        }
        let Gradients { loss, of_vars } = self.gradients(&lessons)?;
        let diverged = Error::Diverged { step: self.step + 1, loss };
        if !loss.is_finite() {
            return Err(diverged);
        }
        let gradient_norm = self.adam.apply(&of_vars, learning_rate, self.config.training.clip_norm)?;
        if !gradient_norm.is_finite() {
            return Err(diverged);
        }
        self.update_average()?;
        self.idle.count(&of_vars);
        let revived = self.revive(&mut rng)?;
        self.step += 1;
        Ok(StepReport { step: self.step, loss, learning_rate, gradient_norm, revived })
    }

    /// Opens layers with random weights, one after another, as each changes what the next is given.
    fn open_layers(&mut self, lesson: &Lesson) -> Result<()> {
        for (i, (weight, bias)) in self.idle.layers().enumerate() {
            if !self.began_anew(weight) {
                continue;
            }
            let renewed = !self.random;
            let watched = self.watched(lesson)?;
            let conv = watched.convs()[i];
            let Some(means) = conv.input_means() else { continue };
            open(conv, means, self.variables(weight, bias), renewed)?;
        }
        self.average = self.vars.iter().map(|(_, var)| values(var)).collect::<Result<_>>()?;
        Ok(())
    }

    /// What each layer is given on average, from what a lesson begins with, and what follows from it.
    fn find_centres(&mut self, lesson: &Lesson) -> Result<()> {
        let watched = self.watched(lesson)?;
        let convs = watched.convs();
        for (i, (weight, bias)) in self.idle.layers().enumerate() {
            let Some(means) = convs[i].input_means() else { continue };
            // What a ReLU lets through is what the next layer is given.
            let made = convs.get(i + 1).and_then(|next| next.input_means());
            if let (Some(made), true) = (made, self.began_anew(weight)) {
                hold_open(convs[i], means, made, self.variables(weight, bias))?;
            }
            self.adam.set_centre(weight, Centre { bias, means: means.to_vec() });
        }
        Ok(())
    }

    /// Whether the layer of this weight began with random values. Others may have ReLUs that are meant to be shut.
    fn began_anew(&self, weight: usize) -> bool {
        self.random || self.config.renews(&self.vars[weight].0)
    }

    fn variables(&self, weight: usize, bias: Option<usize>) -> Variables<'_> {
        Variables { weight: &self.vars[weight].1, bias: bias.map(|bias| &self.vars[bias].1) }
    }

    /// The model after a pass of a lesson, in which each layer noted the means of what it is given first.
    fn watched(&self, lesson: &Lesson) -> Result<Box<dyn Network>> {
        let mut watched = self.model.boxed();
        watched.convs_mut().into_iter().for_each(Conv::watch);
        match lesson {
            Lesson::Batch(Batch { seen, sigmas, .. }) => drop(watched.forward(seen, sigmas)?),
            // Experts for a lower σ come in later calls.
            Lesson::Unrolled { calls, .. } => {
                for call in calls {
                    watched.forward(&tensor(call.input.clone())?, &[call.sigma])?;
                }
            }
        }
        Ok(watched)
    }

    /// Lets channels that were idle for long begin anew, while there is time for them to learn.
    fn revive(&mut self, rng: &mut ChaCha8Rng) -> Result<usize> {
        let TrainingConfig { revive, steps, .. } = self.config.training;
        if revive == 0 || self.step >= steps / 4 * 3 {
            return Ok(0);
        }
        let state = State { vars: &self.vars, average: &mut self.average, adam: &mut self.adam };
        self.idle.revive(revive, state, rng)
    }

    /// The mean loss of the lessons, and its gradient.
    fn gradients(&self, lessons: &[Lesson]) -> Result<Gradients> {
        Ok(Gradients::mean(lessons.par_iter().map(|lesson| self.gradient(lesson)).collect::<Result<_>>()?))
    }

    fn gradient(&self, lesson: &Lesson) -> Result<Gradients> {
        let loss = self.config.training.loss;
        match lesson {
            Lesson::Unrolled { measurement, clean, calls } => {
                let of_clean = |v: ArrayView4<'_, f32>| Ok(loss.with_slope(&v - &*clean));
                let recipe = self.config.iterates.as_ref().expect("these lessons come of iterates").recipe();
                recipe.gradient(measurement, calls, &*self.model, &self.vars, &of_clean)
            }
            Lesson::Batch(Batch { clean, seen, sigmas }) => {
                let loss = loss.mean(&(self.model.forward(seen, sigmas)? - clean)?)?;
                let mut found = Gradients::zero(self.vars.len());
                found.add_found(loss.to_scalar()?, &loss.backward()?, &self.vars)?;
                Ok(found)
            }
        }
    }

    fn update_average(&mut self) -> Result<()> {
        // Shorter at first, so that the random beginning is forgotten.
        let started = (1 + self.step) as f64 / (10 + self.step) as f64;
        let decay = self.config.training.average.min(started) as f32;
        for ((_, var), average) in self.vars.iter().zip(&mut self.average) {
            for (a, w) in average.iter_mut().zip(values(var)?) {
                *a = decay * *a + (1.0 - decay) * w;
            }
        }
        Ok(())
    }

    /// What a run is for: the averaged weights, or with [`TrainingConfig::blend`] those on the way to them, under their published names.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn weights(&self) -> Result<BTreeMap<String, Tensor>> {
        let mut state = self.model.state();
        blend(&mut state, &self.vars, &self.start, &self.average, self.config.training.blend)?;
        Ok(state)
    }

    /// Writes [`Trainer::weights`] as `.safetensors`.
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn export(&self, path: &Path, storage: Storage) -> Result<()> {
        write_safetensors(path, &self.weights()?, storage)
    }

    /// PSNR of the averaged weights on the first frames of the held-out clips, for each noise level of the settings.
    /// The noise is the same every time.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn validate(&self) -> Result<Vec<Score>> {
        let mut model = self.frozen(self.weights()?);
        if let Some(iterates) = &self.config.iterates {
            return NOISE_LEVELS
                .into_iter()
                .map(|sigma| self.score_reconstruction(&mut *model, iterates, sigma))
                .collect();
        }
        let settings = &self.config.validation;
        let mut scores = Vec::new();
        for &sigma in &settings.sigmas {
            let (mut sum, mut count) = (0.0, 0);
            for (i, clip) in self.data.validation.iter().enumerate() {
                let clean = to_video(clip, settings.frames);
                let mut noisy = clean.clone();
                add_noise(&mut noisy, sigma / 255.0, &mut self.rng(VALIDATION_STREAM + i as u64));
                let mut restored = Array4::zeros(clean.dim());
                let call = Call::new(sigma / 255.0);
                let inferred = model.infer(&call, self.seen(noisy).view(), restored.view_mut());
                inferred.map_err(|e| Error::Data(e.to_string()))?;
                for (clean, restored) in clean.outer_iter().zip(restored.outer_iter()) {
                    sum += frame_psnr(clean, restored);
                    count += 1;
                }
            }
            scores.push(Score { sigma: Some(sigma), psnr_db: sum / f64::from(count) });
        }
        Ok(scores)
    }

    /// PSNR of the middle of each held-out clip, its first frames measured through the same random masks every time, without noise or with that
    /// of a level in 0..255 units.
    fn score_reconstruction(
        &self,
        model: &mut dyn Network,
        settings: &IteratesConfig,
        sigma: Option<f32>,
    ) -> Result<Score> {
        let (mut sum, mut count) = (0.0, 0);
        for (i, clip) in self.data.validation.iter().enumerate() {
            let mut rng = self.rng(VALIDATION_STREAM + i as u64);
            let clean = centre(&to_video(clip, VALIDATION_FRAMES));
            let pattern = CfaPattern::ALL[i % 4];
            let measurement = camera::plain(clean.view(), pattern, sigma.unwrap_or(0.0) / 255.0, &mut rng)?;
            let mut denoiser = settings.relay(self.first.as_deref(), model);
            let restored = settings.recipe().solve(&measurement, &mut denoiser)?;
            for (clean, restored) in clean.outer_iter().zip(restored.outer_iter()) {
                sum += frame_psnr(clean, restored);
                count += 1;
            }
        }
        Ok(Score { sigma, psnr_db: sum / f64::from(count) })
    }

    /// The model with these weights, for inference: constants are packed for the kernels once, not at each call.
    fn frozen(&self, mut weights: BTreeMap<String, Tensor>) -> Box<dyn Network> {
        let mut model = self.model.boxed();
        for conv in model.convs_mut() {
            for (name, tensor, _) in conv.tensors_mut() {
                if let Some(weight) = weights.remove(&name) {
                    *tensor = weight;
                }
            }
        }
        model
    }

    /// Writes a checkpoint; the one that was there is kept as `NAME.previous.safetensors`.
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn save(&self, path: &Path) -> Result<()> {
        let mut tensors = BTreeMap::new();
        let moments = self.adam.state()?;
        for (((name, var), average), (m, v)) in self.vars.iter().zip(&self.average).zip(moments) {
            tensors.insert(format!("weights/{name}"), var.as_detached_tensor());
            tensors.insert(format!("average/{name}"), Tensor::from_slice(average, var.shape(), &Device::Cpu)?);
            tensors.insert(format!("first/{name}"), m);
            tensors.insert(format!("second/{name}"), v);
        }
        if self.config.training.blend < 1.0 {
            for ((name, var), start) in self.vars.iter().zip(&self.start) {
                tensors.insert(format!("start/{name}"), Tensor::from_slice(start, var.shape(), &Device::Cpu)?);
            }
        }
        for (weight, counts) in self.idle.counts() {
            tensors.insert(format!("idle/{}", self.vars[weight].0), Tensor::new(counts, &Device::Cpu)?);
        }
        for (weight, Centre { means, .. }) in self.adam.centres() {
            tensors.insert(format!("means/{}", self.vars[weight].0), Tensor::new(&**means, &Device::Cpu)?);
        }
        let meta = Meta::new(self.step, self.adam.steps(), self.config.clone(), self.random, self.rate);
        checkpoint::write(path, &meta, &tensors)
    }

    /// Continues from a checkpoint, or from the one before it when the newest is damaged.
    ///
    /// # Errors
    /// The newest checkpoint's error when neither can be used, or when it is of a run with other settings.
    pub fn resume(&mut self, path: &Path) -> Result<Resumed> {
        match checkpoint::read(path) {
            Ok(found) => {
                self.restore(path, found)?;
                Ok(Resumed { from: path.to_owned(), refused: None })
            }
            Err(error) => {
                let before = checkpoint::previous(path);
                let Ok(found) = checkpoint::read(&before) else { return Err(error) };
                self.restore(&before, found)?;
                // The next one to be saved would put it in the place of this one.
                let aside = std::fs::rename(path, path.with_extension("refused.safetensors"));
                aside.or_else(missing_is_fine).map_err(|source| Error::Write { path: path.to_owned(), source })?;
                Ok(Resumed { from: before, refused: Some(error) })
            }
        }
    }

    /// After a divergence: continues with half the learning rate, which is saved. Not from the last checkpoint, when the weights may have been
    /// lost already, but from the one before it, if there is one; the last one is given up.
    ///
    /// # Errors
    /// When no checkpoint can be read, or the new one not be written.
    pub fn back_off(&mut self, path: &Path) -> Result<()> {
        let rate = self.rate / 2.0;
        let before = checkpoint::previous(path);
        match checkpoint::read(&before) {
            Ok(found) => {
                self.restore(&before, found)?;
                let given_up = std::fs::remove_file(path).or_else(missing_is_fine);
                given_up.map_err(|source| Error::Write { path: path.to_owned(), source })?;
            }
            Err(_) => self.restore(path, checkpoint::read(path)?)?,
        }
        self.rate = rate;
        self.save(path)
    }

    fn restore(&mut self, path: &Path, (meta, mut tensors): (Meta, BTreeMap<String, Tensor>)) -> Result<()> {
        checkpoint::check_same_run(path, &meta.config, &self.config)?;
        let mut take = |kind: &str, name: &str, shape: &[usize]| -> Result<Vec<f32>> {
            let key = format!("{kind}/{name}");
            let tensor = tensors.remove(&key).filter(|t| t.dims() == shape);
            let tensor = tensor.ok_or_else(|| Error::format(path, format!("{key} is missing or of another shape")))?;
            Ok(tensor.flatten_all()?.to_vec1()?)
        };
        let (mut weights, mut averages, mut moments, mut starts) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for ((name, var), start) in self.vars.iter().zip(&self.start) {
            let shape = var.dims();
            starts.push(if self.config.training.blend < 1.0 { take("start", name, shape)? } else { start.clone() });
            weights.push(take("weights", name, shape)?);
            averages.push(take("average", name, shape)?);
            moments.push((take("first", name, shape)?, take("second", name, shape)?));
        }
        let idle = |(weight, counts): (usize, Vec<f32>)| take("idle", &self.vars[weight].0, &[counts.len()]);
        let idle = self.idle.counts().map(idle).collect::<Result<_>>()?;
        let mut centres = Vec::new();
        for (weight, bias) in self.idle.layers().filter(|_| meta.step > 0) {
            let Some(inputs) = self.adam.centred_inputs(weight) else { continue };
            // What no lesson has reached has none.
            if let Ok(means) = take("means", &self.vars[weight].0, &[inputs]) {
                centres.push((weight, Centre { bias, means }));
            }
        }
        // Only now that all is there does anything change.
        for ((_, var), weights) in self.vars.iter().zip(weights) {
            var.set(&Tensor::from_vec(weights, var.shape(), var.device())?)?;
        }
        (self.average, self.start) = (averages, starts);
        self.idle.restore(idle);
        self.adam.restore(meta.adam_steps, moments);
        centres.into_iter().for_each(|(weight, centre)| self.adam.set_centre(weight, centre));
        self.step = meta.step;
        self.random = meta.random;
        self.rate = meta.rate;
        Ok(())
    }
}

fn missing_is_fine(error: std::io::Error) -> std::io::Result<()> {
    if error.kind() == std::io::ErrorKind::NotFound { Ok(()) } else { Err(error) }
}

fn values(var: &Var) -> Result<Vec<f32>> {
    Ok(var.flatten_all()?.to_vec1()?)
}

/// The middle of a video `[T, C, H, W]`, at most [`VALIDATION_SIDE`] high and wide.
fn centre(video: &Array4<f32>) -> Array4<f32> {
    let (_, _, height, width) = video.dim();
    let (h, w) = (height.min(VALIDATION_SIDE), width.min(VALIDATION_SIDE));
    let (y, x) = ((height - h) / 2, (width - w) / 2);
    video.slice(s![.., .., y..y + h, x..x + w]).to_owned()
}

/// Clips of equal shape, one after another.
fn stack(clips: &[Array4<f32>]) -> Result<Tensor> {
    let views: Vec<_> = clips.iter().map(|clip| clip.view()).collect();
    tensor(concatenate(Axis(0), &views).map_err(|e| Error::Data(e.to_string()))?)
}

/// Over all channels of a frame.
fn frame_psnr(clean: ndarray::ArrayView3<'_, f32>, restored: ndarray::ArrayView3<'_, f32>) -> f64 {
    let (c, h, w) = clean.dim();
    let flat = |a: ndarray::ArrayView3<'_, f32>| a.to_shape((c * h, w)).map(|a| a.into_owned());
    match (flat(clean), flat(restored)) {
        (Ok(clean), Ok(restored)) => psnr(clean.view(), restored.view()),
        _ => f64::NAN,
    }
}
