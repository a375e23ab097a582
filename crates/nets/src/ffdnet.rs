//! FFDNet: a convolutional denoiser that works on the image split into four half-size ones, told σ by a constant map.
//!
//! ```text
//! z = [unshuffle(x), σ] → conv + ReLU → … → conv → shuffle
//! ```
//!
//! Two layouts are published. The authors' own has biases, the map last, and gives the clean
//! image. The other (Tassano's port, which the reference gray pipeline uses) has batch norm, the map first, and gives
//! the noise.
//!
//! # References
//! Zhang, Zuo, Zhang, *FFDNet: toward a fast and flexible solution for CNN based image denoising*, 2018.
//! Tassano, Delon, Veit, *An analysis and implementation of the FFDNet image denoising method*, IPOL 2019.

use crate::infer::{Cache, join_phases, set_channel, set_phases};
use crate::kernels::Conv3x3;
use crate::layers::{Conv, Shift, Source, chain};
use crate::network::{Layers, Network, Padding, Window, check_clips, crop, denoise_clip, noise_map};
use crate::weights::WeightFile;
use crate::{Architecture, Error, Result};
use admm::{BoxError, Call, Denoiser};
use candle_core::Tensor;
use candle_nn::ops::{pixel_shuffle, pixel_unshuffle};
use ndarray::{ArrayView3, ArrayView4, ArrayViewMut3, ArrayViewMut4};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::path::Path;

/// Which of the two published forms a network has.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum FfdnetLayout {
    /// Noise map last, a bias in every layer, output is the clean image. Tensors `model.{0,2,4,…}.{weight,bias}`.
    Direct,
    /// Noise map first, no bias in the first and last layer, output is the noise. Tensors
    /// `intermediate_dncnn.itermediate_dncnn.{0,2,5,8,…}` (sic).
    Residual {
        /// Batch norm in the middle layers; `false` once it is folded into weights and biases.
        batch_norm: bool,
    },
}

/// The size and form of an [`Ffdnet`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct FfdnetSpec {
    /// Colors of the image: 1 or 3.
    pub channels: usize,
    /// Channels of the hidden layers (published: 64 gray, 96 color).
    pub width: usize,
    /// Convolutions, at least 2 (published: 15 gray, 12 color).
    pub depth: usize,
    /// Which form.
    pub layout: FfdnetLayout,
}

const RESIDUAL_PREFIX: &str = "intermediate_dncnn.itermediate_dncnn";

impl FfdnetSpec {
    /// The published gray size: 64 channels, 15 layers.
    pub const GRAY: Self = Self { channels: 1, width: 64, depth: 15, layout: FfdnetLayout::Direct };
    /// The published color size: 96 channels, 12 layers.
    pub const COLOR: Self = Self { channels: 3, width: 96, depth: 12, layout: FfdnetLayout::Direct };

    /// Recognises the network by its tensors: those of an FFDNet have a shape each that tells width, depth and colors.
    pub(crate) fn recognise(file: &WeightFile) -> Option<Self> {
        let residual = file.shapes().any(|(name, _)| name.starts_with(RESIDUAL_PREFIX));
        let batch_norm = file.shapes().any(|(name, _)| name.ends_with("running_mean"));
        let (prefix, step, layout) = if residual {
            // conv, norm, ReLU: layers 2, 5, 8, …; without norm the numbers stay.
            (RESIDUAL_PREFIX, 3, FfdnetLayout::Residual { batch_norm })
        } else {
            ("model", 2, FfdnetLayout::Direct)
        };
        let index = |name: &str| name.strip_prefix(prefix)?.strip_prefix('.')?.strip_suffix(".weight")?.parse().ok();
        let convs = file.shapes().filter(|(_, shape)| shape.len() == 4);
        let last: usize = convs.filter_map(|(name, _)| index(name)).max()?;
        let shape = |i: usize| file.shape(&format!("{prefix}.{i}.weight"));
        let width = shape(0).or(shape(2))?.first().copied()?;
        let channels = shape(last)?.first()?.div_ceil(4);
        Some(Self { channels, width, depth: last.div_ceil(step) + 1, layout })
    }

    pub(crate) fn validate(self) -> Result<Self> {
        let bad =
            |key, value: usize, legal: &str| Err(Error::Setting { key, value: value.to_string(), legal: legal.into() });
        match self {
            Self { channels, .. } if channels != 1 && channels != 3 => bad("channels", channels, "1 (gray) or 3 (RGB)"),
            Self { width, .. } if !(1..=1024).contains(&width) => bad("width", width, "1 to 1024 channels"),
            Self { depth, .. } if !(2..=100).contains(&depth) => bad("depth", depth, "2 to 100 layers"),
            spec => Ok(spec),
        }
    }

    fn layer(self, source: &mut Source<'_>, i: usize) -> Result<Conv> {
        let (first, last) = (i == 0, i + 1 == self.depth);
        let inputs = if first { 4 * self.channels + 1 } else { self.width };
        let outputs = if last { 4 * self.channels } else { self.width };
        let (name, shift) = match self.layout {
            FfdnetLayout::Direct => (format!("model.{}", 2 * i), Shift::Bias),
            FfdnetLayout::Residual { batch_norm } => {
                let position = (3 * i).saturating_sub(1);
                let shift = match batch_norm {
                    _ if first || last => Shift::Nothing,
                    true => Shift::Norm(format!("{RESIDUAL_PREFIX}.{}", position + 1)),
                    false => Shift::Bias,
                };
                (format!("{RESIDUAL_PREFIX}.{position}"), shift)
            }
        };
        Conv::new(source, name, (inputs, outputs), Conv3x3 { relu: !last, ..Conv3x3::default() }, shift)
    }
}

impl std::fmt::Display for FfdnetSpec {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let colors = if self.channels == 1 { "gray" } else { "color" };
        let layout = match self.layout {
            FfdnetLayout::Direct => "",
            FfdnetLayout::Residual { batch_norm: true } => ", batch norm",
            FfdnetLayout::Residual { batch_norm: false } => ", residual",
        };
        write!(f, "FFDNet ({colors}, {} channels, {} layers{layout})", self.width, self.depth)
    }
}

/// The FFDNet denoiser; each frame of a video on its own.
///
/// Frames of odd size are continued by their last row and column. Trained for σ up to 75/255 (published weights).
#[derive(Debug, Clone)]
pub struct Ffdnet {
    spec: FfdnetSpec,
    layers: Vec<Conv>,
    cache: Cache,
}

impl Ffdnet {
    /// Reads a `.safetensors` or `.pth` file, or bundled weights (`bundled:NAME`); size and layout are recognised from
    /// the tensors.
    ///
    /// # Errors
    /// When the file cannot be read, is of another network, or its tensors do not fit together.
    ///
    /// ```no_run
    /// let net = nets::Ffdnet::load("ffdnet_gray.pth".as_ref())?;
    /// # Ok::<(), nets::Error>(())
    /// ```
    pub fn load(path: &Path) -> Result<Self> {
        Self::from_weights(WeightFile::read(path)?)
    }

    /// Takes the weights of a file that has been read.
    ///
    /// # Errors
    /// When the weights are of another network, or do not fit together.
    pub fn from_weights(file: WeightFile) -> Result<Self> {
        match file.architecture()? {
            Architecture::Ffdnet(spec) => {
                let path = file.path().to_owned();
                let mut source = Source::stored(file.into_tensors());
                let net = Self::build(spec.validate()?, &mut source)?;
                source.finish(&path, &spec.to_string())?;
                Ok(net)
            }
            other => Err(Error::wrong_architecture(file.path(), "FFDNet", other)),
        }
    }

    /// An untrained network, the same for the same seed.
    ///
    /// # Errors
    /// [`Error::Setting`] for a size out of range.
    pub fn random(spec: FfdnetSpec, seed: u64) -> Result<Self> {
        Self::build(spec.validate()?, &mut Source::Random(&mut ChaCha8Rng::seed_from_u64(seed)))
    }

    fn build(spec: FfdnetSpec, source: &mut Source<'_>) -> Result<Self> {
        let layers = (0..spec.depth).map(|i| spec.layer(source, i)).collect::<Result<_>>()?;
        Ok(Self { spec, layers, cache: Cache::default() })
    }

    /// One frame `[C, H, W]` without a tensor in the loop.
    fn infer_frame(&mut self, frame: ArrayView3<'_, f32>, sigma: f32, out: ArrayViewMut3<'_, f32>) -> Result<()> {
        let residual = matches!(self.spec.layout, FfdnetLayout::Residual { .. });
        let (c, h, w) = frame.dim();
        let (half_h, half_w) = (h.div_ceil(2), w.div_ceil(2));
        let convs: Vec<&Conv> = self.layers.iter().collect();
        let engine = self.cache.engine(&convs, &[], &[])?;
        engine.start(half_h, half_w);
        let mut z = engine.image(4 * c + 1, half_h, half_w);
        set_channel(&mut z, if residual { 0 } else { 4 * c }, |_| std::iter::repeat(sigma));
        set_phases(&mut z, usize::from(residual), frame, Padding::Replicate, 0.0);
        let z = engine.chain(0..self.spec.depth, z)?;
        join_phases(&z, frame, out, |noisy, found| if residual { noisy - found } else { found });
        engine.recycle(z);
        Ok(())
    }

    /// Its size and form.
    pub fn spec(&self) -> FfdnetSpec {
        self.spec
    }
}

impl Layers for Ffdnet {
    fn describe(&self) -> String {
        self.spec.to_string()
    }

    fn channels(&self) -> usize {
        self.spec.channels
    }

    /// All layers work at half the size.
    fn multiply_adds(&self) -> f64 {
        self.layers.iter().map(Conv::multiply_adds).sum::<f64>() / 4.0
    }

    fn convs(&self) -> Vec<&Conv> {
        self.layers.iter().collect()
    }

    fn convs_mut(&mut self) -> Vec<&mut Conv> {
        self.cache.forget();
        self.layers.iter_mut().collect()
    }

    fn fold_batch_norm(&mut self) -> Result<()> {
        if let FfdnetLayout::Residual { batch_norm } = &mut self.spec.layout {
            *batch_norm = false;
            // The first and last layers have neither bias nor norm: folding leaves them as they are.
            for layer in self.convs_mut() {
                layer.fold()?;
            }
        }
        Ok(())
    }
}

impl Network for Ffdnet {
    fn forward(&self, clips: &Tensor, noise: &[f32]) -> Result<Tensor> {
        let (n, _, h, w) = check_clips(self, clips, noise)?;
        // [N, C, H, W] -> [N, 4C, H/2, W/2] -> [N, 4C + 1, H/2, W/2]
        let z = pixel_unshuffle(&Padding::Replicate.pad(clips, 2)?, 2)?;
        let map = noise_map(n, noise, &z)?;
        let residual = matches!(self.spec.layout, FfdnetLayout::Residual { .. });
        let z = if residual { Tensor::cat(&[&map, &z], 1)? } else { Tensor::cat(&[&z, &map], 1)? };
        let z = chain(&self.layers, &[], &z)?;
        let image = crop(&pixel_shuffle(&z, 2)?, h, w)?;
        Ok(if residual { (clips - image)? } else { image })
    }

    /// Each frame on its own.
    fn stages(&self, frames: usize) -> Vec<Vec<Window>> {
        vec![(0..frames).map(|t| Window { inputs: vec![t], outputs: t..t + 1 }).collect()]
    }

    /// One pixel of the half-size images in each layer, and the other pixel of a pair.
    fn reach(&self) -> Option<usize> {
        Some(2 * self.spec.depth + 2)
    }

    fn infer(
        &mut self,
        call: &Call<'_>,
        clip: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        self.denoise(call, clip, out)
    }

    fn boxed(&self) -> Box<dyn Network> {
        Box::new(self.clone())
    }
}

impl Denoiser for Ffdnet {
    fn name(&self) -> &str {
        "ffdnet"
    }

    fn denoise(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> std::result::Result<(), BoxError> {
        denoise_clip(self, call, noisy, out, |net, noisy, sigma, mut out| {
            let mut frames = noisy.outer_iter().zip(out.outer_iter_mut());
            frames.try_for_each(|(frame, out)| net.infer_frame(frame, sigma, out))
        })
    }
}
