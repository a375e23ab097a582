//! ShiftNet: a video denoiser of ours for many calls at little cost, a sixth of FastDVDnet's: a small U-shaped network for whole clips, frames
//! mixed by shifts in time, told σ by a constant map.
//!
//! ```text
//! out_t = x_t + shuffle(body_σ([u_{t−1}, u_{t+1}, u_t, σ])),   u = unshuffle(x) − ½, 0 beyond the ends
//! ```
//!
//! The body may have other weights for other σ (*experts*): what is left to do in a solve, and how it looks, changes with σ, and more
//! weights cost no time.
//!
//! # References
//! Zhang, Zuo, Zhang, *FFDNet*, TIP 2018; Lin, Gan, Han, *TSM*, ICCV 2019; Qi et al., *Real-time streaming video
//! denoising with bidirectional buffers*, ACM MM 2022; Balaji et al., *eDiff-I*, 2022 (experts by noise level).

mod body;
mod temporal_shift;

use body::{Body, MULTIPLE};
use temporal_shift::TemporalShift;

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
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

/// The middle of the range of frames, which is taken off what the network is shown.
const GRAY: f32 = 0.5;

/// The size of a [`Shiftnet`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ShiftnetSpec {
    /// Colors of a frame: 1 or 3.
    pub channels: usize,
    /// Frames that the first layer sees at once: 1, or 3 (the frame between its neighbours).
    pub window: usize,
    /// Channels at a half, a quarter and an eighth of the size: multiples of 16 up to 512.
    pub widths: [usize; 3],
    /// Residual blocks at these sizes, at a half and a quarter as many on the way up again: 1 to 16 each.
    pub blocks: [usize; 3],
    /// Where other weights begin.
    pub experts: Experts,
}

/// The σ, in units of 1/255, below which other weights take over, at most three, each lower than the one before: `[13, 9]` are three sets
/// of weights, for σ from 13/255, from 9/255 and below.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, serde::Serialize, serde::Deserialize)]
#[serde(try_from = "Vec<u8>", into = "Vec<u8>")]
pub struct Experts([u8; 3]);

impl TryFrom<Vec<u8>> for Experts {
    type Error = Error;

    fn try_from(below: Vec<u8>) -> Result<Self> {
        Self::new(&below)
    }
}

impl From<Experts> for Vec<u8> {
    fn from(experts: Experts) -> Self {
        experts.below().to_vec()
    }
}

impl Experts {
    /// The same weights for every σ.
    pub const NONE: Self = Self([0; 3]);

    /// # Errors
    /// [`Error::Setting`] for more than three, 0, or others than descending ones.
    pub fn new(below: &[u8]) -> Result<Self> {
        let mut all = [0; 3];
        if below.len() > all.len() || below.contains(&0) || !below.is_sorted_by(|a, b| a > b) {
            let legal = "up to three σ from 255 to 1, each lower than the one before".to_owned();
            return Err(Error::Setting { key: "experts", value: format!("{below:?}"), legal });
        }
        all[..below.len()].copy_from_slice(below);
        Ok(Self(all))
    }

    /// The σ, in units of 1/255.
    pub fn below(&self) -> &[u8] {
        let count = self.0.iter().take_while(|&&sigma| sigma > 0).count();
        &self.0[..count]
    }

    /// Which weights are for this σ of a picture from 0 to 1.
    fn index(&self, sigma: f32) -> usize {
        // A schedule's σ has been divided by 255, which may round it below the bound that it is equal to.
        self.below().iter().take_while(|&&below| sigma * 255.0 < f32::from(below) - 1e-3).count()
    }

    /// What the names of the tensors of each set begin with.
    fn prefixes(&self) -> impl Iterator<Item = String> + '_ {
        std::iter::once(String::new()).chain(self.below().iter().map(|sigma| format!("below{sigma}.")))
    }
}

impl ShiftnetSpec {
    pub(crate) fn recognise(file: &WeightFile) -> Option<Self> {
        let Body { ends: (shown, found), widths, blocks } = Body::recognise(file)?;
        let window = (shown - 1) / found.max(1);
        let below: Vec<u8> = (1..=u8::MAX).rev().filter(|sigma| Body::is_in(file, &format!("below{sigma}."))).collect();
        Some(Self { channels: found / PHASES, window, widths, blocks, experts: Experts::new(&below).ok()? })
    }

    pub(crate) fn validate(self) -> Result<Self> {
        let one_or_three = |key, value: usize, legal: &str| match value {
            1 | 3 => Ok(()),
            _ => Err(Error::Setting { key, value: value.to_string(), legal: legal.into() }),
        };
        one_or_three("channels", self.channels, "1 (gray) or 3 (RGB)")?;
        one_or_three("window", self.window, "1 or 3 frames")?;
        self.body().validate().map(|()| self)
    }

    fn body(self) -> Body {
        let colors = PHASES * self.channels;
        Body { ends: (self.window * colors + 1, colors), widths: self.widths, blocks: self.blocks }
    }

    /// The frames that are shown for frame `t`, nothing before the first.
    fn shown(self, t: usize) -> impl Iterator<Item = Option<usize>> {
        let others: &[isize] = if self.window == 1 { &[0] } else { &[-1, 1, 0] };
        others.iter().map(move |&offset| t.checked_add_signed(offset))
    }
}

impl std::fmt::Display for ShiftnetSpec {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let colors = if self.channels == 1 { "gray" } else { "color" };
        let ([a, b, c], [k, l, m]) = (self.widths, self.blocks);
        write!(f, "ShiftNet ({colors}, {a}/{b}/{c} channels, {k}/{l}/{m} blocks")?;
        if self.window > 1 {
            write!(f, ", {} frames", self.window)?;
        }
        if !self.experts.below().is_empty() {
            write!(f, ", {} experts", 1 + self.experts.below().len())?;
        }
        write!(f, ")")
    }
}

/// The ShiftNet denoiser.
///
/// Frames whose size is not a multiple of 8 are mirrored at the right and the bottom.
#[derive(Debug, Clone)]
pub struct Shiftnet {
    spec: ShiftnetSpec,
    /// The layers of one expert after those of another.
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
        let each = net.layers_of_an_expert();
        net.convs.chunks_mut(each).try_for_each(|convs| spec.body().silence(convs))?;
        Ok(net)
    }

    fn build(spec: ShiftnetSpec, source: &mut Source<'_>) -> Result<Self> {
        let experts: Vec<_> =
            spec.experts.prefixes().map(|prefix| spec.body().build(source, &prefix)).collect::<Result<_>>()?;
        Ok(Self { spec, convs: experts.into_iter().flatten().collect(), cache: Cache::default() })
    }

    /// Its size.
    pub fn spec(&self) -> ShiftnetSpec {
        self.spec
    }

    fn layers_of_an_expert(&self) -> usize {
        self.convs.len() / self.spec.experts.prefixes().count()
    }

    /// Which layers are for this σ.
    fn expert(&self, sigma: f32) -> Range<usize> {
        let each = self.layers_of_an_expert();
        let first = each * self.spec.experts.index(sigma);
        first..first + each
    }

    /// A clip `[T, C, H, W]` without a tensor in the loop; arguments have been checked.
    fn infer_clip(&mut self, clip: ArrayView4<'_, f32>, sigma: f32, mut out: ArrayViewMut4<'_, f32>) -> Result<()> {
        let (frames, channels, height, width) = clip.dim();
        let half = |n: usize| n.next_multiple_of(MULTIPLE) / 2;
        let (half_h, half_w) = (half(height), half(width));
        let (body, expert) = (self.spec.body(), self.expert(sigma));
        let (shuffled, plain) = body.results(self.convs.len() / expert.len());
        let convs: Vec<&Conv> = self.convs.iter().collect();
        let engine = self.cache.engine(&convs, &shuffled, &plain)?;
        engine.start(half_h, half_w);
        let mut features = Vec::with_capacity(frames);
        for t in 0..frames {
            let mut shown = engine.image(body.ends.0, half_h, half_w);
            for (place, frame) in self.spec.shown(t).enumerate() {
                let first = place * PHASES * channels;
                match frame.filter(|&frame| frame < frames) {
                    Some(frame) => {
                        set_phases(&mut shown, first, clip.index_axis(Axis(0), frame), Padding::Reflect, GRAY);
                    }
                    None => (first..first + PHASES * channels)
                        .for_each(|channel| set_channel(&mut shown, channel, |_| std::iter::repeat(0.0))),
                }
            }
            set_channel(&mut shown, body.ends.0 - 1, |_| std::iter::repeat(sigma));
            features.push(engine.conv(expert.start, &shown)?);
            engine.recycle(shown);
        }
        let features = body.between(engine, expert.start, features)?;
        for ((features, frame), out) in features.into_iter().zip(clip.outer_iter()).zip(out.outer_iter_mut()) {
            let found = engine.conv(expert.end - 1, &features)?;
            engine.recycle(features);
            join_phases(&found, frame, out, |noisy, found| noisy + found);
            engine.recycle(found);
        }
        Ok(())
    }

    /// What the body finds for images `[N, 4 C, H/2, W/2]`, of which each clip is shown to the expert for its noise.
    fn found(&self, x: &Tensor, noise: &[f32]) -> candle_core::Result<Tensor> {
        let frames = x.dim(0)? / noise.len();
        let experts: Vec<_> = noise.iter().map(|&sigma| self.expert(sigma)).collect();
        let mut found = Vec::new();
        let mut first = 0;
        for clips in experts.chunk_by(|a, b| a == b) {
            let (noise, x) = (&noise[first..first + clips.len()], x.narrow(0, first * frames, clips.len() * frames)?);
            let gray = (&x - f64::from(GRAY))?;
            let seen = match self.spec.window {
                1 => gray,
                window => neighbours(&gray, frames)?.narrow(1, 0, window * gray.dim(1)?)?,
            };
            let shown = Tensor::cat(&[&seen, &noise_map(x.dim(0)?, noise, &x)?], 1)?;
            found.push(self.spec.body().forward(&self.convs[clips[0].clone()], &shown, frames)?);
            first += clips.len();
        }
        Tensor::cat(&found, 0)
    }
}

/// The frame before, the frame after, the frame itself (twice) as channels; zeros beyond the ends of the clips.
fn neighbours(x: &Tensor, frames: usize) -> candle_core::Result<Tensor> {
    let four = Tensor::cat(&[x, x, x, x], 1)?;
    four.apply_op1(TemporalShift::of(four.dim(1)?, frames))
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

    /// Experts that are lacking begin as the first one, frames that it was not shown as nothing; channels that are lacking begin at random and
    /// are not listened to.
    fn grow(&self, weights: &mut BTreeMap<String, Tensor>) -> Result<()> {
        for (name, own) in self.state() {
            let plain = name.split_once('.').filter(|(first, _)| first.starts_with("below")).map(|(_, rest)| rest);
            let Some(weight) = weights.get(&name).or_else(|| weights.get(plain?)) else { continue };
            let smaller =
                weight.rank() == own.rank() && weight.dims().iter().zip(own.dims()).all(|(has, own)| has <= own);
            let weight = match smaller && weight.dims() != own.dims() {
                true => body::widened(&own, weight, name.ends_with("body.input.weight"))?,
                false => weight.clone(),
            };
            weights.insert(name, weight);
        }
        Ok(())
    }
}

impl Network for Shiftnet {
    fn forward(&self, clips: &Tensor, noise: &[f32]) -> Result<Tensor> {
        let (_, _, h, w) = check_clips(self, clips, noise)?;
        let x = pixel_unshuffle(&Padding::Reflect.pad(clips, MULTIPLE)?, 2)?;
        let found = self.found(&x, noise)?;
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

    const SMALL: ShiftnetSpec =
        ShiftnetSpec { channels: 1, window: 1, widths: [16; 3], blocks: [1; 3], experts: Experts::NONE };

    /// A network no layer of which is silent.
    fn loud(channels: usize) -> Shiftnet {
        let experts = Experts::new(&[40, 20]).unwrap();
        let spec = ShiftnetSpec { channels, window: 3, widths: [16, 32, 16], blocks: [1, 2, 2], experts };
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
    fn each_noise_has_its_expert() {
        let experts = Experts::new(&[40, 20]).unwrap();
        let index = [90.0, 40.0, 39.0, 20.0, 19.0, 0.0].map(|sigma| experts.index(sigma / 255.0));
        assert_eq!(index, [0, 0, 1, 1, 2, 2]);
        for wrong in [&[20, 40][..], &[20, 20], &[20, 0], &[4, 3, 2, 1]] {
            assert!(matches!(Experts::new(wrong), Err(Error::Setting { key: "experts", .. })), "{wrong:?}");
        }
    }

    #[test]
    fn a_file_tells_window_and_experts() {
        let (net, folder) = (loud(3), tempfile::tempdir().unwrap());
        let path = folder.path().join("net.safetensors");
        crate::weights::write_safetensors(&path, &net.state(), crate::weights::Storage::F32).unwrap();
        let read = Shiftnet::load(&path).unwrap();
        assert_eq!(read.spec(), net.spec());
        let noisy = clip((3, 3, 8, 16), 8);
        assert_eq!(forward(&read, noisy.view(), &[0.1]), forward(&net, noisy.view(), &[0.1]));
    }

    #[test]
    fn a_grown_network_is_the_one_that_it_began_as() {
        let mut small = Shiftnet::random(SMALL, 0).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(9);
        for (_, tensor, _) in small.convs.iter_mut().flat_map(Conv::tensors_mut) {
            let values: Vec<f32> = (0..tensor.elem_count()).map(|_| 0.3 * (rng.random::<f32>() - 0.5)).collect();
            *tensor = Tensor::from_vec(values, tensor.dims(), tensor.device()).unwrap();
        }
        let spec = ShiftnetSpec { window: 3, experts: Experts::new(&[20]).unwrap(), ..SMALL };
        let mut grown = Shiftnet::random(spec, 1).unwrap();
        let mut weights = small.state();
        grown.grow(&mut weights).unwrap();
        grown.set_state(&weights).unwrap();
        let noisy = clip((3, 1, 8, 16), 10);
        for sigma in [0.2, 0.02] {
            let (small, grown) = (forward(&small, noisy.view(), &[sigma]), forward(&grown, noisy.view(), &[sigma]));
            assert!(difference(&small, &noisy) > 1e-3 && difference(&small, &grown) < 1e-5);
        }
    }

    #[test]
    fn a_widened_network_is_the_one_that_it_began_as() {
        let small = loud(1);
        let spec = ShiftnetSpec { widths: [32, 48, 64], ..small.spec() };
        let mut wide = Shiftnet::random(spec, 1).unwrap();
        let mut weights = small.state();
        wide.grow(&mut weights).unwrap();
        wide.set_state(&weights).unwrap();
        let noisy = clip((3, 1, 8, 16), 11);
        for sigma in [0.2, 0.1, 0.02] {
            let (small, wide) = (forward(&small, noisy.view(), &[sigma]), forward(&wide, noisy.view(), &[sigma]));
            assert!(difference(&small, &noisy) > 1e-3 && difference(&small, &wide) < 1e-5);
        }
        let unused = |(name, tensor): (&String, &Tensor)| {
            name.ends_with("enter0.0.0.weight")
                .then(|| tensor.abs().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap())
        };
        let (before, after) = (small.state(), wide.state());
        for (before, after) in before.iter().filter_map(unused).zip(after.iter().filter_map(unused)) {
            assert!(after > 1.5 * before, "new channels are not silent: {before} {after}");
        }
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
        let net = Shiftnet::random(SMALL, 0).unwrap();
        let noisy = clip((2, 1, 8, 8), 7);
        assert!(difference(&forward(&net, noisy.view(), &[0.1]), &noisy) < 1e-6);
    }
}
