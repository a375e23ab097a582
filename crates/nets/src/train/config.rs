//! What a training run is: a plain, checked description that a TOML file maps to one to one.

use crate::kernels::Precision;
use crate::video::Ends;
use crate::{Architecture, DdnetSpec, Error, Experts, FastdvdnetSpec, FfdnetLayout, FfdnetSpec, Result, ShiftnetSpec};
use candle_core::Tensor;
use ndarray::Array4;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

/// A training run. Noise levels are in 0..255 units here, as in every TOML file, and in `[0, 1]` everywhere else.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainConfig {
    /// Name of the run, and of the weights it makes.
    pub name: String,
    /// Seed of everything random: initial weights, crops, motion, noise. Default 0.
    #[serde(default)]
    pub seed: u64,
    /// What is trained.
    pub network: NetworkConfig,
    /// What it is trained on.
    pub data: DataConfig,
    /// Weights to begin with, a file or `bundled:NAME`; random ones without.
    #[serde(default)]
    pub weights: Option<PathBuf>,
    /// Layers that begin anew instead, by a part of their names. Those without a ReLU begin silent, so that a network whose layers were
    /// shut is at first what it was. Default none.
    #[serde(default)]
    pub renew: Vec<String>,
    /// The noise put on its input; this, `iterates` or both: then a step learns from a batch of noisy clips as from one more iterate.
    #[serde(default)]
    pub noise: Option<NoiseConfig>,
    /// What measures the clips of `iterates`.
    pub camera: Option<CameraConfig>,
    /// The solver whose iterates are its input.
    #[serde(default)]
    pub iterates: Option<IteratesConfig>,
    /// How it is trained.
    pub training: TrainingConfig,
    /// How it is watched.
    #[serde(default)]
    pub validation: ValidationConfig,
    /// When it is saved.
    #[serde(default)]
    pub checkpoint: CheckpointConfig,
}

/// The network.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "lowercase", deny_unknown_fields)]
pub enum NetworkConfig {
    /// [`Ffdnet`](crate::Ffdnet), residual layout without batch norm: what is learned is the noise, so that training begins
    /// near the identity instead of having to find it first.
    Ffdnet {
        /// 1 gray, 3 RGB.
        channels: usize,
        /// Channels of the hidden layers, 1 to 1024.
        width: usize,
        /// Convolutions, 2 to 100.
        depth: usize,
    },
    /// [`Fastdvdnet`](crate::Fastdvdnet), biases in place of batch norm.
    Fastdvdnet {
        /// 1 gray, 3 RGB.
        channels: usize,
        /// Channels at full, half and quarter size, each 1 to 1024.
        widths: [usize; 3],
        /// Neighbours of the end frames. Default circular.
        #[serde(default)]
        ends: Ends,
    },
    /// [`Ddnet`](crate::Ddnet).
    Ddnet {
        /// Channels at full, half and quarter size, each 1 to 1024.
        widths: [usize; 3],
        /// Neighbours of the end frames. Default circular.
        #[serde(default)]
        ends: Ends,
    },
    /// [`Shiftnet`](crate::Shiftnet).
    Shiftnet {
        /// 1 gray, 3 RGB.
        channels: usize,
        /// Channels at a half, a quarter and an eighth of the size, multiples of 16 up to 512.
        widths: [usize; 3],
        /// Residual blocks at these sizes, at a half and a quarter as many on the way up again: 1 to 16 each.
        blocks: [usize; 3],
        /// Frames that the first layer sees at once, 1 or 3. Default 1.
        #[serde(default = "one")]
        window: usize,
        /// Where other weights begin: up to three σ in 0..255 units, each lower than the one before. Default none.
        #[serde(default)]
        experts: Experts,
    },
}

impl NetworkConfig {
    /// Colors of a frame: 1 or 3.
    pub fn channels(&self) -> usize {
        match self.architecture().0 {
            Architecture::Ffdnet(FfdnetSpec { channels, .. })
            | Architecture::Fastdvdnet(FastdvdnetSpec { channels, .. })
            | Architecture::Shiftnet(ShiftnetSpec { channels, .. }) => channels,
            Architecture::Ddnet(_) => 3,
        }
    }

    /// The network, and the neighbours of its end frames.
    pub(super) fn architecture(&self) -> (Architecture, Ends) {
        let residual = FfdnetLayout::Residual { batch_norm: false };
        match *self {
            Self::Ffdnet { channels, width, depth } => {
                (Architecture::Ffdnet(FfdnetSpec { channels, width, depth, layout: residual }), Ends::default())
            }
            Self::Fastdvdnet { channels, widths, ends } => {
                (Architecture::Fastdvdnet(FastdvdnetSpec { channels, widths, batch_norm: false }), ends)
            }
            Self::Ddnet { widths, ends } => (Architecture::Ddnet(DdnetSpec { widths }), ends),
            Self::Shiftnet { channels, widths, blocks, window, experts } => {
                (Architecture::Shiftnet(ShiftnetSpec { channels, window, widths, blocks, experts }), Ends::default())
            }
        }
    }

    /// Checks the network's size.
    fn validate(&self) -> Result<()> {
        // The network knows its keys, not the table that they are in.
        const KEYS: [&str; 7] = [
            "network.channels",
            "network.width",
            "network.widths",
            "network.depth",
            "network.blocks",
            "network.window",
            "network.experts",
        ];
        self.architecture().0.validate().map_err(|error| match error {
            Error::Setting { key, value, legal } => {
                let key = KEYS.into_iter().find(|known| known.ends_with(&format!(".{key}"))).unwrap_or(key);
                Error::Setting { key, value, legal }
            }
            other => other,
        })
    }
}

/// Where the frames are and how training clips are cut from them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    /// A folder of folders of frames.
    pub video: Option<PathBuf>,
    /// A folder of photographs, which a synthetic camera moves into clips.
    pub photos: Option<PathBuf>,
    /// A folder of folders of frames that are never trained on.
    pub validation: PathBuf,
    /// Share of the training clips that is made from photographs, 0 to 1. Default 0.5.
    #[serde(default = "half")]
    pub photo_share: f64,
    /// Side of the square patches in pixels: a multiple of 4, 4 to 1024.
    pub patch: usize,
    /// Frames of a clip, 1 to 64: whole clips go through a video network at once. Default 1.
    #[serde(default = "one")]
    pub frames: usize,
    /// Clips in a batch, 1 to 1024.
    pub batch: usize,
}

/// The noise on the input, white and Gaussian.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoiseConfig {
    /// Range of σ in 0..255 units, one value drawn uniformly for each clip.
    pub sigma: [f32; 2],
}

/// The optimisation: warm-up and cosine decay.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingConfig {
    /// Steps in all, at least 1.
    pub steps: u64,
    /// How weights follow gradients. Default Muon.
    #[serde(default)]
    pub optimizer: Optimizer,
    /// What the layers multiply, on the way there and back and in the solves of [`IteratesConfig`]. Default f32; bf16 takes a third to
    /// two thirds of the time where the processor has a matrix unit, and is f32 elsewhere.
    #[serde(default)]
    pub precision: Precision,
    /// What is minimised. Default L1.
    #[serde(default)]
    pub loss: Loss,
    /// Highest learning rate, above 0 and at most 1.
    pub learning_rate: f64,
    /// Learning rate at the last step, 0 to `learning_rate`. Default 0.
    #[serde(default)]
    pub final_learning_rate: f64,
    /// Steps over which the learning rate rises from 0. Default 0.
    #[serde(default)]
    pub warmup: u64,
    /// Decay per step of the moving average of the weights that is validated and exported, 0 to below 1. Default 0.999.
    #[serde(default = "average")]
    pub average: f64,
    /// How far the exported weights go from those it began with to the moving average, above 0 and at most 1, less only with
    /// [`TrainConfig::weights`]. Half way what is new (noise, other masks) is learned for the most part, and what was known is
    /// hardly lost. Default 1.
    ///
    /// # References
    /// Wortsman et al., *Robust fine-tuning of zero-shot models*, CVPR 2022.
    #[serde(default = "unit")]
    pub blend: f64,
    /// Longest gradient (Euclidean norm over all weights); longer ones are shortened to it. Above 0; default 1.
    #[serde(default = "unit")]
    pub clip_norm: f64,
    /// Steps in a row without a gradient after which a channel begins anew, in the first three quarters of all steps; 0 leaves such
    /// channels shut. Default 100.
    #[serde(default = "hundred")]
    pub revive: u32,
}

/// Training on the iterates of accelerated GAP: each clip is measured through new random masks, and solved with the network as
/// it is; what the denoiser is given in some of the calls, drawn for each clip, makes the update.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IteratesConfig {
    /// Another network that makes the calls before these, as it is; none without.
    #[serde(default)]
    pub first: Option<FirstCalls>,
    /// σ of each iteration in 0..255 units, at least one.
    pub sigmas: Vec<f32>,
    /// Iterations of the start by TV (weight 0.1); 0 starts from the normalised measurement. Default 0.
    #[serde(default)]
    pub start_iterations: usize,
    /// Calls of each clip that are trained on, 1 to the number of `sigmas`. Default 2.
    #[serde(default = "two")]
    pub calls: usize,
    /// Whether those calls follow one another (the last is drawn) and the gradient goes back from each to those before it,
    /// through the solver: a call then learns what helps the next ones. The loss of each weighs half as much as that of the
    /// next. Default false: calls drawn at random, each by itself.
    #[serde(default)]
    pub unrolled: bool,
}

/// The calls of a solve that another network makes, before those of the network that is trained.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FirstCalls {
    /// Its weights, a file or `bundled:NAME`.
    pub weights: PathBuf,
    /// σ of each of its calls in 0..255 units, at least one.
    pub sigmas: Vec<f32>,
}

/// The simulated camera that measures each clip, drawn anew for each.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// Frames of a measurement, the fewest and the most, drawn for each clip; 1 to 64.
    pub frames: [usize; 2],
    /// Share of open pixels of random, shifting and blocky masks, the least and the most; in (0, 1].
    pub density: [f64; 2],
    /// Kinds of masks, one drawn for each clip; a kind that is named twice comes twice as often. Default random.
    #[serde(default = "random_masks")]
    pub masks: Vec<MaskKind>,
    /// Largest σ of the noise of y in 0..255 units, white and shot noise in any proportion. Default 0.
    #[serde(default)]
    pub noise: f32,
    /// Share of the clips that have such noise; the others have nearly none. Default 0.5.
    #[serde(default = "half")]
    pub noisy: f64,
    /// Share of the sensor's pixels that are not measured, at most; drawn for each clip from 0 to this, 0 to 0.5. A network that has seen
    /// holes stands pixels that are held out or defective. Default 0.
    #[serde(default)]
    pub holes: f64,
    /// Share of the clips whose brightest pixels are clipped. Default 0.
    #[serde(default)]
    pub saturated: f64,
    /// Share of the clips whose masks are told with errors of up to 0.3 pixels, 3 % of gain and a pedestal of 1 %. Default 0.
    #[serde(default)]
    pub mask_errors: f64,
    /// Largest standard deviation of the factors, alike in neighbouring pixels, by which a shifting mask differs from what is told of it;
    /// drawn for each clip from 0 to this, 0 to 0.5. They move with the mask, as dust and uneven prints do. Default 0.
    #[serde(default)]
    pub mask_grain: f32,
}

/// How masks look.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MaskKind {
    /// Each pixel of each frame open or shut at random.
    Random,
    /// One random pattern that moves by one to three pixels a frame, as in cameras.
    Shifting,
    /// Squares of two to four pixels open or shut together.
    Blocky,
    /// The code of each pixel is a row of a Hadamard matrix.
    Hadamard,
    /// Any transmittance, alike in neighbouring pixels.
    Gray,
}

impl MaskKind {
    /// All kinds.
    pub const ALL: [Self; 5] = [Self::Random, Self::Shifting, Self::Blocky, Self::Hadamard, Self::Gray];
}

/// How weights follow gradients; both take the same learning rates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Optimizer {
    /// [`Adam`](super::Adam) for everything.
    Adam,
    /// [`Adam::with_muon`](super::Adam::with_muon): the same accuracy in a quarter of the steps.
    #[default]
    Muon,
}

/// The mean over all values of a function of the error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Loss {
    /// Absolute error.
    #[default]
    L1,
    /// Squared error.
    L2,
    /// Half the logarithm of the mean squared error of a clip (of a batch, where it is not reconstructed), which is PSNR: each clip counts
    /// alike, however hard it is.
    Psnr,
}

/// Keeps the logarithm of [`Loss::Psnr`] finite: 60 dB.
const LEAST_ERROR: f64 = 1e-6;

impl Loss {
    /// The mean over all values of an error.
    pub(super) fn mean(self, error: &Tensor) -> candle_core::Result<Tensor> {
        match self {
            Self::L1 => error.abs()?.mean_all(),
            Self::L2 => error.sqr()?.mean_all(),
            Self::Psnr => (error.sqr()?.mean_all()? + LEAST_ERROR)?.log()? * 0.5,
        }
    }

    /// The mean over all values of an error, and its derivative by each.
    pub(super) fn with_slope(self, error: Array4<f32>) -> (f32, Array4<f32>) {
        let count = error.len().max(1) as f64;
        let of = |e: f32| match self {
            Self::L1 => (e.abs(), if e == 0.0 { 0.0 } else { e.signum() }),
            Self::L2 | Self::Psnr => (e * e, 2.0 * e),
        };
        let mean = error.iter().map(|&e| f64::from(of(e).0)).sum::<f64>() / count;
        let (loss, slope) = match self {
            Self::L1 | Self::L2 => (mean, 1.0),
            Self::Psnr => (0.5 * (mean + LEAST_ERROR).ln(), 0.5 / (mean + LEAST_ERROR)),
        };
        (loss as f32, error.mapv(|e| of(e).1 * (slope / count) as f32))
    }
}

/// PSNR on held-out clips.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ValidationConfig {
    /// Steps between validations, at least 1. Default 1000.
    pub every: u64,
    /// Noise levels in 0..255 units. Default 10, 25, 50.
    pub sigmas: Vec<f32>,
    /// Frames of each clip that count, from the first; at least 1. Default 16.
    pub frames: usize,
}

impl Default for ValidationConfig {
    fn default() -> Self {
        Self { every: 1000, sigmas: vec![10.0, 25.0, 50.0], frames: 16 }
    }
}

/// Saving.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CheckpointConfig {
    /// Steps between checkpoints, at least 1. Default 500.
    pub every: u64,
}

impl Default for CheckpointConfig {
    fn default() -> Self {
        Self { every: 500 }
    }
}

fn half() -> f64 {
    0.5
}
fn one() -> usize {
    1
}
fn two() -> usize {
    2
}
fn average() -> f64 {
    0.999
}
fn random_masks() -> Vec<MaskKind> {
    vec![MaskKind::Random]
}
fn hundred() -> u32 {
    100
}
fn unit() -> f64 {
    1.0
}

impl TrainConfig {
    /// Checks every value against its range.
    ///
    /// # Errors
    /// [`Error::Setting`] for the first value out of range.
    pub fn validate(&self) -> Result<()> {
        let (data, training) = (&self.data, &self.training);
        let named = !self.name.is_empty() && self.name.chars().all(|c| c.is_ascii_alphanumeric() || "_-.".contains(c));
        check(named, "name", &self.name, "letters, digits, '_', '-' and '.'; it becomes a file name")?;
        self.network.validate()?;
        let sources = data.video.is_some() || data.photos.is_some();
        check(sources, "data", "neither video nor photos", "at least one of them must be given")?;
        check((0.0..=1.0).contains(&data.photo_share), "data.photo_share", data.photo_share, "0 to 1")?;
        let patch = (4..=1024).contains(&data.patch) && data.patch % 4 == 0;
        check(patch, "data.patch", data.patch, "a multiple of 4 from 4 to 1024")?;
        check((1..=64).contains(&data.frames), "data.frames", data.frames, "1 to 64")?;
        check((1..=1024).contains(&data.batch), "data.batch", data.batch, "1 to 1024")?;
        let beside = self.renew.is_empty() || self.weights.is_some();
        check(beside, "renew", self.renew.join(", "), "only with weights: without them all layers begin anew")?;
        let legal = "with [iterates], and only then";
        check(self.iterates.is_some() == self.camera.is_some(), "camera", "left out, or not needed", legal)?;
        self.camera.iter().try_for_each(|camera| self.validate_camera(camera))?;
        let lessons = self.noise.is_some() || self.iterates.is_some();
        check(lessons, "noise", "neither [noise] nor [iterates]", "at least one of these tables")?;
        if let Some(NoiseConfig { sigma: [low, high] }) = &self.noise {
            let ordered = level(*low) && level(*high) && low <= high;
            check(ordered, "noise.sigma", format_args!("[{low}, {high}]"), LEVELS)?;
        }
        self.iterates.iter().try_for_each(|iterates| self.validate_iterates(iterates))?;
        check(training.steps >= 1, "training.steps", training.steps, "at least 1")?;
        let rate = training.learning_rate;
        check(rate > 0.0 && rate <= 1.0, "training.learning_rate", rate, "above 0 and at most 1")?;
        let last = training.final_learning_rate;
        check((0.0..=rate).contains(&last), "training.final_learning_rate", last, "0 to training.learning_rate")?;
        check(training.warmup <= training.steps, "training.warmup", training.warmup, "at most training.steps")?;
        check((0.0..1.0).contains(&training.average), "training.average", training.average, "0 to below 1")?;
        let legal = "above 0 and at most 1; 1 without weights and with renew";
        let blend = training.blend == 1.0 || self.weights.is_some() && self.renew.is_empty();
        check(blend && training.blend > 0.0 && training.blend <= 1.0, "training.blend", training.blend, legal)?;
        let clip = training.clip_norm;
        check(clip.is_finite() && clip > 0.0, "training.clip_norm", clip, "above 0 and finite")?;
        check(self.validation.every >= 1, "validation.every", self.validation.every, "at least 1")?;
        check(self.validation.frames >= 1, "validation.frames", self.validation.frames, "at least 1")?;
        for &sigma in &self.validation.sigmas {
            check(level(sigma), "validation.sigmas", sigma, "each 0 to 255")?;
        }
        check(self.checkpoint.every >= 1, "checkpoint.every", self.checkpoint.every, "at least 1")
    }

    fn validate_camera(&self, camera: &CameraConfig) -> Result<()> {
        let CameraConfig { frames: [few, many], density: [thin, dense], masks, noise, .. } = camera;
        let CameraConfig { noisy, holes, saturated, mask_errors, mask_grain, .. } = camera;
        let frames = self.data.frames == 1 || self.noise.is_some();
        check(frames, "data.frames", self.data.frames, "left out without [noise]: camera.frames says how many")?;
        let frames = (1..=64).contains(few) && (*few..=64).contains(many);
        check(frames, "camera.frames", format_args!("[{few}, {many}]"), "two numbers from 1 to 64, the lower first")?;
        let density = *thin > 0.0 && thin <= dense && *dense <= 1.0;
        let legal = "two shares above 0 and at most 1, the lower first";
        check(density, "camera.density", format_args!("[{thin}, {dense}]"), legal)?;
        check(!masks.is_empty(), "camera.masks", "none", "at least one kind")?;
        check(level(*noise), "camera.noise", noise, "0 to 255")?;
        check((0.0..=0.5).contains(holes), "camera.holes", holes, "0 to 0.5")?;
        check((0.0..=1.0).contains(saturated), "camera.saturated", saturated, "0 to 1")?;
        check((0.0..=1.0).contains(mask_errors), "camera.mask_errors", mask_errors, "0 to 1")?;
        let moves = *mask_grain == 0.0 || masks.contains(&MaskKind::Shifting);
        let legal = "0 to 0.5; 0 without \"shifting\" in camera.masks";
        check(moves && (0.0..=0.5).contains(mask_grain), "camera.mask_grain", mask_grain, legal)?;
        check((0.0..=1.0).contains(noisy), "camera.noisy", noisy, "0 to 1")
    }

    fn validate_iterates(&self, iterates: &IteratesConfig) -> Result<()> {
        let IteratesConfig { first, sigmas, start_iterations, calls, unrolled: _ } = iterates;
        check(
            !matches!(self.network, NetworkConfig::Ddnet { .. }),
            "iterates",
            "ddnet",
            "ffdnet, fastdvdnet and shiftnet",
        )?;
        let levels = |key, sigmas: &[f32]| {
            let holds = !sigmas.is_empty() && sigmas.iter().all(|&s| level(s));
            check(holds, key, format_args!("{sigmas:?}"), "at least one, each 0 to 255")
        };
        levels("iterates.sigmas", sigmas)?;
        if let Some(first) = first {
            levels("iterates.first.sigmas", &first.sigmas)?;
        }
        check(*start_iterations <= 1000, "iterates.start_iterations", start_iterations, "0 to 1000")?;
        let legal = "1 to the number of iterates.sigmas";
        check((1..=sigmas.len()).contains(calls), "iterates.calls", calls, legal)
    }

    /// Whether a layer, or a variable of one, begins anew.
    pub(super) fn renews(&self, name: &str) -> bool {
        self.renew.iter().any(|part| name.contains(&**part))
    }

    /// The learning rate of a step, counted from 0: a linear rise, then half a cosine.
    pub fn learning_rate(&self, step: u64) -> f64 {
        let TrainingConfig { steps, learning_rate, final_learning_rate, warmup, .. } = self.training;
        if step < warmup {
            return learning_rate * (step + 1) as f64 / warmup as f64;
        }
        let progress = (step - warmup) as f64 / (steps - warmup).saturating_sub(1).max(1) as f64;
        let cosine = 0.5 * (1.0 + (std::f64::consts::PI * progress.min(1.0)).cos());
        final_learning_rate + (learning_rate - final_learning_rate) * cosine
    }
}

const LEVELS: &str = "two levels from 0 to 255, the lower one first";

fn level(sigma: f32) -> bool {
    (0.0..=255.0).contains(&sigma)
}

fn check(holds: bool, key: &'static str, value: impl std::fmt::Display, legal: &str) -> Result<()> {
    if holds { Ok(()) } else { Err(Error::Setting { key, value: value.to_string(), legal: legal.to_owned() }) }
}
