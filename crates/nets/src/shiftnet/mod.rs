//! ShiftNet: a video denoiser of ours for many calls at little cost, a tenth of FastDVDnet's: a small U-shaped network for whole clips, frames
//! mixed by shifts in time, told σ by a constant map.
//!
//! ```text
//! out = x + shuffle(body([unshuffle(x) − ½, σ]))
//! ```
//!
//! # References
//! Zhang, Zuo, Zhang, *FFDNet*, TIP 2018; Lin, Gan, Han, *TSM*, ICCV 2019; Qi et al., *Real-time streaming video
//! denoising with bidirectional buffers*, ACM MM 2022.

mod body;
mod temporal_shift;

use body::{Body, MULTIPLE};

use crate::infer::{Cache, PHASES, join_phases, set_channel, set_phases};
use crate::layers::{Conv, Source};
use crate::network::{Layers, Network, Padding, check_clips, crop, denoise_clip, noise_map};
use crate::weights::WeightFile;
use crate::{Architecture, Error, Result};
use admm::{BoxError, Call, Denoiser};
use candle_core::Tensor;
use candle_nn::ops::{pixel_shuffle, pixel_unshuffle};
use ndarray::{ArrayView4, ArrayViewMut4, Axis};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::path::Path;

/// The middle of the range of frames, which is taken off what the network is shown.
const GRAY: f32 = 0.5;

/// The size of a [`Shiftnet`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ShiftnetSpec {
    /// Colors of a frame: 1 or 3.
    pub channels: usize,
    /// Channels at a half, a quarter and an eighth of the size: multiples of 16 up to 512.
    pub widths: [usize; 3],
    /// Residual blocks at these sizes, at a half and a quarter as many on the way up again: 1 to 16 each.
    pub blocks: [usize; 3],
}

impl ShiftnetSpec {
    pub(crate) fn recognise(file: &WeightFile) -> Option<Self> {
        let (outputs, widths, blocks) = Body::recognise(file)?;
        Some(Self { channels: outputs / PHASES, widths, blocks })
    }

    pub(crate) fn validate(self) -> Result<Self> {
        if self.channels != 1 && self.channels != 3 {
            let legal = "1 (gray) or 3 (RGB)".into();
            return Err(Error::Setting { key: "channels", value: self.channels.to_string(), legal });
        }
        self.body().validate().map(|()| self)
    }

    fn body(self) -> Body {
        let colors = PHASES * self.channels;
        Body { ends: (colors + 1, colors), widths: self.widths, blocks: self.blocks }
    }
}

impl std::fmt::Display for ShiftnetSpec {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let colors = if self.channels == 1 { "gray" } else { "color" };
        let ([a, b, c], [k, l, m]) = (self.widths, self.blocks);
        write!(f, "ShiftNet ({colors}, {a}/{b}/{c} channels, {k}/{l}/{m} blocks)")
    }
}

/// The ShiftNet denoiser.
///
/// Frames whose size is not a multiple of 8 are mirrored at the right and the bottom.
#[derive(Debug, Clone)]
pub struct Shiftnet {
    spec: ShiftnetSpec,
    convs: Vec<Conv>,
    cache: Cache,
}

impl Shiftnet {
    /// Reads a `.safetensors` file, or bundled weights (`bundled:NAME`); the size is recognised from the tensors.
    ///
    /// # Errors
    /// When the file cannot be read, is of another network, or its tensors do not fit together.
    pub fn load(path: &Path) -> Result<Self> {
        Self::from_weights(WeightFile::read(path)?)
    }

    /// Takes the weights of a file that has been read.
    ///
    /// # Errors
    /// When the weights are of another network, or do not fit together.
    pub fn from_weights(file: WeightFile) -> Result<Self> {
        match file.architecture()? {
            Architecture::Shiftnet(spec) => {
                let path = file.path().to_owned();
                let mut source = Source::stored(file.into_tensors());
                let net = Self::build(spec.validate()?, &mut source)?;
                source.finish(&path, &spec.to_string())?;
                Ok(net)
            }
            other => Err(Error::wrong_architecture(file.path(), "ShiftNet", other)),
        }
    }

    /// An untrained network, the same for the same seed; its result is its input.
    ///
    /// # Errors
    /// [`Error::Setting`] for a size out of range.
    pub fn random(spec: ShiftnetSpec, seed: u64) -> Result<Self> {
        let mut net = Self::build(spec.validate()?, &mut Source::Random(&mut ChaCha8Rng::seed_from_u64(seed)))?;
        spec.body().silence(&mut net.convs)?;
        Ok(net)
    }

    fn build(spec: ShiftnetSpec, source: &mut Source<'_>) -> Result<Self> {
        Ok(Self { spec, convs: spec.body().build(source)?, cache: Cache::default() })
    }

    /// Its size.
    pub fn spec(&self) -> ShiftnetSpec {
        self.spec
    }

    /// A clip `[T, C, H, W]` without a tensor in the loop; arguments have been checked.
    fn infer_clip(&mut self, clip: ArrayView4<'_, f32>, sigma: f32, mut out: ArrayViewMut4<'_, f32>) -> Result<()> {
        let (_, channels, height, width) = clip.dim();
        let half = |n: usize| n.next_multiple_of(MULTIPLE) / 2;
        let (half_h, half_w) = (half(height), half(width));
        let body = self.spec.body();
        let (shuffled, plain) = body.results();
        let convs: Vec<&Conv> = self.convs.iter().collect();
        let engine = self.cache.engine(&convs, &shuffled, &plain)?;
        engine.start(half_h, half_w);
        let mut features = Vec::with_capacity(clip.len_of(Axis(0)));
        for frame in clip.outer_iter() {
            let mut shown = engine.image(body.ends.0, half_h, half_w);
            set_phases(&mut shown, 0, frame, Padding::Reflect, GRAY);
            set_channel(&mut shown, PHASES * channels, |_| std::iter::repeat(sigma));
            features.push(engine.conv(0, &shown)?);
            engine.recycle(shown);
        }
        let features = body.between(engine, features)?;
        for ((features, frame), out) in features.into_iter().zip(clip.outer_iter()).zip(out.outer_iter_mut()) {
            let found = engine.conv(convs.len() - 1, &features)?;
            engine.recycle(features);
            join_phases(&found, frame, out, |noisy, found| noisy + found);
            engine.recycle(found);
        }
        Ok(())
    }
}

impl Layers for Shiftnet {
    fn describe(&self) -> String {
        self.spec.to_string()
    }

    fn channels(&self) -> usize {
        self.spec.channels
    }

    fn multiply_adds(&self) -> f64 {
        self.spec.body().multiply_adds()
    }

    fn convs(&self) -> Vec<&Conv> {
        self.convs.iter().collect()
    }

    fn convs_mut(&mut self) -> Vec<&mut Conv> {
        self.cache.forget();
        self.convs.iter_mut().collect()
    }
}

impl Network for Shiftnet {
    fn forward(&self, clips: &Tensor, noise: &[f32]) -> Result<Tensor> {
        let (n, _, h, w) = check_clips(self, clips, noise)?;
        let x = pixel_unshuffle(&Padding::Reflect.pad(clips, MULTIPLE)?, 2)?;
        let shown = Tensor::cat(&[&(&x - f64::from(GRAY))?, &noise_map(n, noise, &x)?], 1)?;
        let found = self.spec.body().forward(&self.convs, &shown, n / noise.len())?;
        Ok(crop(&pixel_shuffle(&(x + found)?, 2)?, h, w)?)
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

impl Denoiser for Shiftnet {
    fn name(&self) -> &str {
        "shiftnet"
    }

    fn denoise(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        denoise_clip(self, call, noisy, out, Self::infer_clip)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Device;
    use ndarray::{Array4, concatenate, s};
    use rand::RngExt;

    /// A network no layer of which is silent.
    fn loud(channels: usize) -> Shiftnet {
        let spec = ShiftnetSpec { channels, widths: [16, 32, 16], blocks: [1, 2, 2] };
        let mut net = Shiftnet::random(spec, 1).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        for (_, tensor, _) in net.convs.iter_mut().flat_map(Conv::tensors_mut) {
            let values: Vec<f32> = (0..tensor.elem_count()).map(|_| 0.2 * (rng.random::<f32>() - 0.5)).collect();
            *tensor = Tensor::from_vec(values, tensor.dims(), tensor.device()).unwrap();
        }
        net
    }

    fn clip(dim: (usize, usize, usize, usize), seed: u64) -> Array4<f32> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        Array4::from_shape_simple_fn(dim, || rng.random())
    }

    fn forward(net: &Shiftnet, clips: ArrayView4<'_, f32>, noise: &[f32]) -> Array4<f32> {
        let clips = Tensor::from_iter(clips.iter().copied(), &Device::Cpu).unwrap().reshape(clips.dim()).unwrap();
        let clean = net.forward(&clips, noise).unwrap();
        Array4::from_shape_vec(clips.dims4().unwrap(), clean.flatten_all().unwrap().to_vec1().unwrap()).unwrap()
    }

    fn difference(a: &Array4<f32>, b: &Array4<f32>) -> f32 {
        a.iter().zip(b).fold(0.0, |most, (a, b)| most.max((a - b).abs()))
    }

    #[test]
    fn inference_is_the_differentiable_network_at_any_size() {
        for dim in [(1, 1, 1, 1), (5, 1, 9, 14), (2, 3, 16, 7), (3, 3, 24, 40)] {
            let (mut net, noisy, mut out) = (loud(dim.1), clip(dim, 3), Array4::zeros(dim));
            net.denoise(&Call::new(0.1), noisy.view(), out.view_mut()).unwrap();
            let error = difference(&out, &forward(&net, noisy.view(), &[0.1]));
            assert!(error < 1e-4, "{dim:?}: {error}");
        }
    }

    #[test]
    fn clips_of_a_batch_do_not_see_each_other() {
        let (net, one, other) = (loud(1), clip((3, 1, 8, 16), 4), clip((3, 1, 8, 16), 5));
        let both = concatenate![Axis(0), one, other];
        let alone = concatenate![Axis(0), forward(&net, one.view(), &[0.1]), forward(&net, other.view(), &[0.3])];
        assert!(difference(&forward(&net, both.view(), &[0.1, 0.3]), &alone) < 1e-5);
    }

    #[test]
    fn a_frame_is_seen_by_its_neighbours_and_noise_by_all() {
        let (net, still) = (loud(1), clip((3, 1, 8, 8), 6));
        let result = forward(&net, still.view(), &[0.1]);
        let mut moved = still.clone();
        moved.index_axis_mut(Axis(0), 0).fill(0.0);
        let change = |a: &Array4<f32>| {
            difference(&a.slice(s![2.., .., .., ..]).to_owned(), &result.slice(s![2.., .., .., ..]).to_owned())
        };
        assert!(change(&forward(&net, moved.view(), &[0.1])) > 1e-5);
        assert!(change(&forward(&net, still.view(), &[0.2])) > 1e-5);
    }

    #[test]
    fn an_untrained_network_gives_back_what_it_is_shown() {
        let net = Shiftnet::random(ShiftnetSpec { channels: 1, widths: [16; 3], blocks: [1; 3] }, 0).unwrap();
        let noisy = clip((2, 1, 8, 8), 7);
        assert!(difference(&forward(&net, noisy.view(), &[0.1]), &noisy) < 1e-6);
    }
}
