//! FastDVDnet: a video denoiser of two U-shaped stages over windows of five frames, told σ by a constant map.
//!
//! ```text
//! y_t = x_t − block₁(x_{t−1}, x_t, x_{t+1}, σ)        out_t = y_t − block₂(y_{t−1}, y_t, y_{t+1}, σ)
//! ```
//!
//! # References
//! Tassano, Delon, Veit, *FastDVDnet: towards real-time deep video denoising without flow estimation*, CVPR 2020.

use crate::layers::{Conv, Source};
use crate::network::{Layers, Network, Padding, Window, check_clips, denoise_clip};
use crate::video::{BlockSpec, Ends, Residual, VideoNet};
use crate::weights::WeightFile;
use crate::{Architecture, Error, Result};
use admm::{BoxError, Call, Denoiser};
use candle_core::Tensor;
use ndarray::{ArrayView4, ArrayViewMut4};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::path::Path;

/// The size of a [`Fastdvdnet`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct FastdvdnetSpec {
    /// Colors of a frame: 1 or 3.
    pub channels: usize,
    /// Channels at full, half and quarter size: 32, 64, 128 in the paper, half of that in the small version.
    pub widths: [usize; 3],
    /// Batch norm after the hidden convolutions, as published; biases in its place once folded, or when trained here.
    pub batch_norm: bool,
}

impl FastdvdnetSpec {
    /// Gray, the paper's width, without batch norm.
    pub const GRAY: Self = Self { channels: 1, widths: [32, 64, 128], batch_norm: false };
    /// Color, the paper's width, without batch norm.
    pub const COLOR: Self = Self { channels: 3, ..Self::GRAY };

    pub(crate) fn recognise(file: &WeightFile) -> Option<Self> {
        let (per_frame, channels, widths, batch_norm) = recognise_blocks(file)?;
        // 3 inputs per frame are a sparse mosaic without a noise map: DDNet.
        (per_frame != 3).then_some(Self { channels, widths, batch_norm })
    }

    pub(crate) fn block(self) -> Result<BlockSpec> {
        let Self { channels, widths, batch_norm } = self;
        if channels != 1 && channels != 3 {
            let legal = "1 (gray) or 3 (RGB)".into();
            return Err(Error::Setting { key: "channels", value: channels.to_string(), legal });
        }
        check_widths(widths)?;
        Ok(BlockSpec { channels, noise_map: true, widths, batch_norm })
    }
}

/// Inputs per frame, colors, widths, batch norm.
pub(crate) fn recognise_blocks(file: &WeightFile) -> Option<(usize, usize, [usize; 3], bool)> {
    let dim = |name: &str, axis: usize| file.shape(&format!("temp1.{name}.weight"))?.get(axis).copied();
    let batch_norm = file.shapes().any(|(name, _)| name.ends_with("running_mean"));
    Some((
        dim("inc.convblock.0", 1)?,
        dim("outc.convblock.3", 0)?,
        [dim("inc.convblock.3", 0)?, dim("downc0.convblock.0", 0)?, dim("downc1.convblock.0", 0)?],
        batch_norm,
    ))
}

pub(crate) fn check_widths(widths: [usize; 3]) -> Result<()> {
    match widths.iter().find(|w| !(1..=1024).contains(*w)) {
        Some(w) => Err(Error::Setting { key: "widths", value: w.to_string(), legal: "each 1 to 1024 channels".into() }),
        None => Ok(()),
    }
}

impl std::fmt::Display for FastdvdnetSpec {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let colors = if self.channels == 1 { "gray" } else { "color" };
        let [a, b, c] = self.widths;
        let norm = if self.batch_norm { ", batch norm" } else { "" };
        write!(f, "FastDVDnet ({colors}, {a}/{b}/{c} channels{norm})")
    }
}

/// The FastDVDnet denoiser.
///
/// Frames whose size is not a multiple of 4 are mirrored at the right and the bottom. Published weights were trained
/// for σ up to 55/255 (color).
#[derive(Debug, Clone)]
pub struct Fastdvdnet {
    spec: FastdvdnetSpec,
    net: VideoNet,
}

impl Fastdvdnet {
    /// Reads a `.safetensors` or `.pth` file, or bundled weights (`bundled:NAME`); the size is recognised from the
    /// tensors.
    ///
    /// # Errors
    /// When the file cannot be read, is of another network, or its tensors do not fit together.
    ///
    /// ```no_run
    /// let net = nets::Fastdvdnet::load("fastdvdnet_color.pth".as_ref(), nets::Ends::Circular)?;
    /// # Ok::<(), nets::Error>(())
    /// ```
    pub fn load(path: &Path, ends: Ends) -> Result<Self> {
        Self::from_weights(WeightFile::read(path)?, ends)
    }

    /// Takes the weights of a file that has been read.
    ///
    /// # Errors
    /// When the weights are of another network, or do not fit together.
    pub fn from_weights(file: WeightFile, ends: Ends) -> Result<Self> {
        match file.architecture()? {
            Architecture::Fastdvdnet(spec) => {
                let path = file.path().to_owned();
                let mut source = Source::stored(file.into_tensors());
                let net = Self::build(spec, ends, &mut source)?;
                source.finish(&path, &spec.to_string())?;
                Ok(net)
            }
            other => Err(Error::wrong_architecture(file.path(), "FastDVDnet", other)),
        }
    }

    /// An untrained network, the same for the same seed.
    ///
    /// # Errors
    /// [`Error::Setting`] for a size out of range.
    pub fn random(spec: FastdvdnetSpec, ends: Ends, seed: u64) -> Result<Self> {
        Self::build(spec, ends, &mut Source::Random(&mut ChaCha8Rng::seed_from_u64(seed)))
    }

    fn build(spec: FastdvdnetSpec, ends: Ends, source: &mut Source<'_>) -> Result<Self> {
        Ok(Self { spec, net: VideoNet::build(spec.block()?, Residual::Subtract, ends, source)? })
    }

    /// Its size.
    pub fn spec(&self) -> FastdvdnetSpec {
        self.spec
    }

    /// What stands for the frames before the first and after the last.
    pub fn set_ends(&mut self, ends: Ends) {
        self.net.ends = ends;
    }
}

impl Layers for Fastdvdnet {
    fn describe(&self) -> String {
        self.spec.to_string()
    }

    fn channels(&self) -> usize {
        self.spec.channels
    }

    fn multiply_adds(&self) -> f64 {
        self.net.multiply_adds()
    }

    fn convs(&self) -> Vec<&Conv> {
        self.net.convs()
    }

    fn convs_mut(&mut self) -> Vec<&mut Conv> {
        self.net.convs_mut()
    }

    fn fold_batch_norm(&mut self) -> Result<()> {
        if std::mem::take(&mut self.spec.batch_norm) {
            for conv in self.convs_mut() {
                conv.fold()?;
            }
        }
        Ok(())
    }
}

impl Network for Fastdvdnet {
    fn forward(&self, clips: &Tensor, noise: &[f32]) -> Result<Tensor> {
        check_clips(self, clips, noise)?;
        Ok(self.net.forward(clips, noise)?)
    }

    /// Triplets through the first block, then triplets of its results through the second.
    fn stages(&self, frames: usize) -> Vec<Vec<Window>> {
        self.net.stages(frames)
    }

    fn forward_window(&self, stage: usize, inputs: &Tensor, noise: f32) -> Result<Tensor> {
        Ok(self.net.forward_window(stage, inputs, noise)?)
    }

    fn padded(&self, clip: &Tensor) -> Result<Tensor> {
        Ok(Padding::Reflect.pad(clip, 4)?)
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

impl Denoiser for Fastdvdnet {
    fn name(&self) -> &str {
        "fastdvdnet"
    }

    fn denoise(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        denoise_clip(self, call, noisy, out, |net, noisy, sigma, out| net.net.infer(noisy, sigma, out))
    }
}
