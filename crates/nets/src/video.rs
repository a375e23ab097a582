//! The two-stage video network that FastDVDnet and DDNet share: a U-shaped block on three neighbouring frames, and a
//! second one on three results of the first.
//!
//! A window of five frames holds three triplets, and neighbouring windows share two of them: each triplet goes through
//! the first block once, so that `T` frames cost `2T` blocks instead of `4T`, with exactly the same result.

use crate::Result;
use crate::infer::{Cache, Engine, channel_row};
use crate::kernels::{Blocked, Conv3x3};
use crate::layers::{Conv, Shift, Source, chain};
use crate::network::{Padding, Window, crop, noise_map, reflect};
use candle_core::Tensor;
use ndarray::{Array4, ArrayView3, ArrayView4, ArrayViewMut3, ArrayViewMut4, Axis, s};
use rayon::prelude::*;

/// Feature channels that the first convolution gives to each of the three frames.
const FEATURES_PER_FRAME: usize = 30;

/// What stands for the frames before the first and after the last.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Ends {
    /// The other end of the sequence, as the reference reconstruction code has it.
    #[default]
    Circular,
    /// The sequence mirrored, the end frame not repeated: as the published denoiser was made for.
    Mirrored,
}

/// Which frames, and which results of the first stage, belong together.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Windows {
    /// Frames of each triplet of the first stage.
    pub(crate) first: Vec<[usize; 3]>,
    /// For each frame its three triplets.
    pub(crate) second: Vec<[usize; 3]>,
}

impl Windows {
    pub(crate) fn new(frames: usize, ends: Ends) -> Self {
        let n = frames as isize;
        match ends {
            Ends::Circular => {
                let around = |t: isize| [t - 1, t, t + 1].map(|i| i.rem_euclid(n) as usize);
                let triplets: Vec<_> = (0..n).map(around).collect();
                Self { first: triplets.clone(), second: triplets }
            }
            // A mirrored triplet runs backwards, so that the ones around −1 and T are their own.
            Ends::Mirrored => Self {
                first: (-1..=n).map(|t| [t - 1, t, t + 1].map(|i| reflect(i, frames))).collect(),
                second: (0..frames).map(|t| [t, t + 1, t + 2]).collect(),
            },
        }
    }

    /// The same for `clips` clips of `frames` frames, one after another.
    fn repeated(frames: usize, clips: usize, ends: Ends) -> Self {
        let one = Self::new(frames, ends);
        let repeat = |list: &[[usize; 3]], step: usize| -> Vec<[usize; 3]> {
            (0..clips).flat_map(|c| list.iter().map(move |i| i.map(|i| i + c * step))).collect()
        };
        Self { first: repeat(&one.first, frames), second: repeat(&one.second, one.first.len()) }
    }
}

/// The size of both blocks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct BlockSpec {
    /// Colors of a frame.
    pub(crate) channels: usize,
    /// Whether every frame comes with a map of σ.
    pub(crate) noise_map: bool,
    /// Channels at full, half and quarter size.
    pub(crate) widths: [usize; 3],
    /// Batch norm, or biases in its place.
    pub(crate) batch_norm: bool,
}

/// Stage of a [`Block`]: name, stride, groups, and whether batch norm (or bias) and ReLU follow.
const LAYERS: [(&str, usize, bool); 16] = [
    ("inc.convblock.0", 1, true),
    ("inc.convblock.3", 1, true),
    ("downc0.convblock.0", 2, true),
    ("downc0.convblock.3.convblock.0", 1, true),
    ("downc0.convblock.3.convblock.3", 1, true),
    ("downc1.convblock.0", 2, true),
    ("downc1.convblock.3.convblock.0", 1, true),
    ("downc1.convblock.3.convblock.3", 1, true),
    ("upc2.convblock.0.convblock.0", 1, true),
    ("upc2.convblock.0.convblock.3", 1, true),
    ("upc2.convblock.1", 1, false),
    ("upc1.convblock.0.convblock.0", 1, true),
    ("upc1.convblock.0.convblock.3", 1, true),
    ("upc1.convblock.1", 1, false),
    ("outc.convblock.0", 1, true),
    ("outc.convblock.3", 1, false),
];

/// Layers whose result is shuffled onto that of an earlier one.
const ONTO: [(usize, usize); 2] = [(10, 4), (13, 1)];

/// The U-shaped block: three frames in, one out.
#[derive(Debug, Clone)]
struct Block {
    convs: Vec<Conv>,
}

impl Block {
    fn build(spec: BlockSpec, stage: &str, source: &mut Source<'_>) -> Result<Self> {
        let [a, b, c] = spec.widths;
        let input = 3 * (spec.channels + usize::from(spec.noise_map));
        let features = 3 * FEATURES_PER_FRAME;
        let channels = [
            (input, features),
            (features, a),
            (a, b),
            (b, b),
            (b, b),
            (b, c),
            (c, c),
            (c, c),
            (c, c),
            (c, c),
            (c, 4 * b),
            (b, b),
            (b, b),
            (b, 4 * a),
            (a, a),
            (a, spec.channels),
        ];
        let layer = |(i, ((name, stride, hidden), channels)): (usize, ((&str, usize, bool), _))| {
            let shift = match (hidden, spec.batch_norm) {
                (false, _) => Shift::Nothing,
                (true, false) => Shift::Bias,
                (true, true) => Shift::Norm(norm_after(&format!("{stage}.{name}"))),
            };
            let groups = if i == 0 { 3 } else { 1 };
            Conv::new(
                source,
                format!("{stage}.{name}"),
                channels,
                Conv3x3 { stride, groups, relu: hidden, ..Conv3x3::default() },
                shift,
            )
        };
        let convs = LAYERS.into_iter().zip(channels).enumerate().map(layer).collect::<Result<_>>()?;
        Ok(Self { convs })
    }

    /// Multiply-adds for each pixel of its result.
    fn multiply_adds(&self) -> f64 {
        let (mut pixels, mut sum) = (1.0, 0.0);
        for (i, (conv, (_, stride, _))) in self.convs.iter().zip(LAYERS).enumerate() {
            pixels /= (stride * stride) as f64;
            sum += pixels * conv.multiply_adds();
            if ONTO.iter().any(|(shuffled, _)| *shuffled == i) {
                pixels *= 4.0;
            }
        }
        sum
    }

    /// `[N, 3(C + 1), H, W]` -> `[N, C, H, W]`, `H` and `W` multiples of 4.
    fn forward(&self, x: &Tensor) -> candle_core::Result<Tensor> {
        chain(&self.convs, &ONTO, x)
    }
}

/// The batch norm after convolution `….{i}` is `….{i + 1}`.
fn norm_after(conv: &str) -> String {
    let (prefix, index) = conv.rsplit_once('.').expect("layer names end in .INDEX");
    format!("{prefix}.{}", index.parse::<usize>().expect("layer names end in .INDEX") + 1)
}

/// How a stage uses what its block computes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Residual {
    /// `middle − block`: the block estimates noise.
    Subtract,
    /// `middle + block`: the block estimates what the mosaic lacks.
    Add,
}

/// Both stages.
#[derive(Debug, Clone)]
pub(crate) struct VideoNet {
    spec: BlockSpec,
    residual: Residual,
    pub(crate) ends: Ends,
    blocks: [Block; 2],
    cache: Cache,
}

impl VideoNet {
    pub(crate) fn build(spec: BlockSpec, residual: Residual, ends: Ends, source: &mut Source<'_>) -> Result<Self> {
        let blocks = [Block::build(spec, "temp1", source)?, Block::build(spec, "temp2", source)?];
        Ok(Self { spec, residual, ends, blocks, cache: Cache::default() })
    }

    /// Multiply-adds for each pixel of each frame, which is the middle of one triplet in each stage. (Mirrored ends add one at each end.)
    pub(crate) fn multiply_adds(&self) -> f64 {
        self.blocks.iter().map(Block::multiply_adds).sum()
    }

    pub(crate) fn convs(&self) -> Vec<&Conv> {
        self.blocks.iter().flat_map(|b| &b.convs).collect()
    }

    /// Access that may change the weights: what was made of them is forgotten.
    pub(crate) fn convs_mut(&mut self) -> Vec<&mut Conv> {
        self.cache.forget();
        self.blocks.iter_mut().flat_map(|b| &mut b.convs).collect()
    }

    /// Differentiable: `clips [N, C, H, W]`, `noise.len()` clips; arguments have been checked.
    pub(crate) fn forward(&self, clips: &Tensor, noise: &[f32]) -> candle_core::Result<Tensor> {
        let (n, _, h, w) = clips.dims4()?;
        let windows = Windows::repeated(n / noise.len(), noise.len(), self.ends);
        let x = Padding::Reflect.pad(clips, 4)?;
        let y = self.stage(&self.blocks[0], &x, &windows.first, noise)?;
        let out = self.stage(&self.blocks[1], &y, &windows.second, noise)?;
        crop(&out, h, w)
    }

    /// The triplets of both stages, for [`Network::stages`](crate::Network::stages).
    pub(crate) fn stages(&self, frames: usize) -> Vec<Vec<Window>> {
        let Windows { first, second } = Windows::new(frames, self.ends);
        let window = |(i, triplet): (usize, [usize; 3])| Window { inputs: triplet.into(), outputs: i..i + 1 };
        [first, second].map(|triplets| triplets.into_iter().enumerate().map(window).collect()).into()
    }

    /// One triplet `[3, C, H, W]`, `H` and `W` multiples of 4, through one stage.
    pub(crate) fn forward_window(&self, stage: usize, triplet: &Tensor, noise: f32) -> candle_core::Result<Tensor> {
        self.stage(&self.blocks[stage], triplet, &[[0, 1, 2]], &[noise])
    }

    fn stage(&self, block: &Block, x: &Tensor, triplets: &[[usize; 3]], noise: &[f32]) -> candle_core::Result<Tensor> {
        let pick = |k: usize| {
            let index: Vec<u32> = triplets.iter().map(|t| t[k] as u32).collect();
            x.index_select(&Tensor::new(index, x.device())?, 0)
        };
        let frames = [pick(0)?, pick(1)?, pick(2)?];
        let input = if self.spec.noise_map {
            let map = noise_map(triplets.len(), noise, x)?;
            Tensor::cat(&[&frames[0], &map, &frames[1], &map, &frames[2], &map], 1)?
        } else {
            Tensor::cat(&frames, 1)?
        };
        let found = block.forward(&input)?;
        match self.residual {
            Residual::Subtract => &frames[1] - found,
            Residual::Add => &frames[1] + found,
        }
    }

    /// Inference, frame by frame; arguments have been checked.
    pub(crate) fn infer(
        &mut self,
        video: ArrayView4<'_, f32>,
        sigma: f32,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<()> {
        let convs: Vec<&Conv> = self.blocks.iter().flat_map(|b| &b.convs).collect();
        let mut run = BlockRun {
            engine: self.cache.engine(&convs, &SHUFFLED, &[])?,
            spec: self.spec,
            residual: self.residual,
            sigma,
        };
        let (frames, c, h, w) = video.dim();
        let windows = Windows::new(frames, self.ends);
        let (ph, pw) = (h.next_multiple_of(4), w.next_multiple_of(4));
        let padded = Array4::from_shape_fn((frames, c, ph, pw), |(t, c, y, x)| {
            video[[t, c, Padding::Reflect.source(y, h), Padding::Reflect.source(x, w)]]
        });
        run.engine.start(ph, pw);
        let mut between = Array4::zeros((windows.first.len(), c, ph, pw));
        for (triplet, out) in windows.first.iter().zip(between.outer_iter_mut()) {
            run.stage(0, triplet.map(|t| padded.index_axis(Axis(0), t)), out)?;
        }
        for (triplet, out) in windows.second.iter().zip(out.outer_iter_mut()) {
            run.stage(LAYERS.len(), triplet.map(|t| between.index_axis(Axis(0), t)), out)?;
        }
        Ok(())
    }
}

/// Layers whose output is shuffled, in both blocks.
const SHUFFLED: [usize; 4] = [ONTO[0].0, ONTO[1].0, LAYERS.len() + ONTO[0].0, LAYERS.len() + ONTO[1].0];

/// Runs blocks on single triplets.
struct BlockRun<'a> {
    engine: &'a mut Engine,
    spec: BlockSpec,
    residual: Residual,
    sigma: f32,
}

impl BlockRun<'_> {
    /// One triplet through the block that begins at layer `first`; `out` may lack the last rows and columns.
    fn stage(&mut self, first: usize, frames: [ArrayView3<'_, f32>; 3], mut out: ArrayViewMut3<'_, f32>) -> Result<()> {
        let (c, h, w) = frames[1].dim();
        let each = c + usize::from(self.spec.noise_map);
        let mut input = self.engine.image(3 * each, h, w);
        let (noise_map, sigma) = (self.spec.noise_map, self.sigma);
        // at most 3 · 4 channels: one block
        input.par_rows_mut(0).enumerate().for_each(|(y, row)| {
            for (k, frame) in frames.iter().enumerate() {
                for channel in 0..c {
                    let values = frame.slice(s![channel, y, ..]);
                    row.iter_mut().zip(values).for_each(|(pixel, &value)| pixel[k * each + channel] = value);
                }
                if noise_map {
                    row.iter_mut().for_each(|pixel| pixel[k * each + c] = sigma);
                }
            }
        });
        let found = self.block(first, input)?;
        let sign = if self.residual == Residual::Subtract { -1.0 } else { 1.0 };
        out.axis_iter_mut(Axis(1)).into_par_iter().enumerate().for_each(|(y, mut row)| {
            for (channel, mut row) in row.outer_iter_mut().enumerate() {
                let middle = frames[1].slice(s![channel, y, ..]);
                for ((out, middle), value) in row.iter_mut().zip(middle).zip(channel_row(&found, channel, y)) {
                    *out = middle + sign * value;
                }
            }
        });
        self.engine.recycle(found);
        Ok(())
    }

    /// The block without its residual connection.
    fn block(&mut self, first: usize, input: Blocked) -> Result<Blocked> {
        let engine = &mut *self.engine;
        let mut full = engine.chain(first..first + 2, input)?;
        let down = engine.conv(first + 2, &full)?;
        let mut half = engine.chain(first + 3..first + 5, down)?;
        let down = engine.conv(first + 5, &half)?;
        let quarter = engine.chain(first + 6..first + 10, down)?;
        engine.add_shuffled(first + 10, quarter, &mut half)?;
        let half = engine.chain(first + 11..first + 13, half)?;
        engine.add_shuffled(first + 13, half, &mut full)?;
        engine.chain(first + 14..first + 16, full)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The window of five frames around each frame, as the reference implementations build it.
    fn naive(frames: usize, ends: Ends) -> Vec<[[usize; 3]; 3]> {
        let at = |i: isize| match ends {
            Ends::Circular => i.rem_euclid(frames as isize) as usize,
            Ends::Mirrored => reflect(i, frames),
        };
        let window = |t: isize| [t - 2, t - 1, t, t + 1, t + 2].map(at);
        let triplets = |w: [usize; 5]| [[w[0], w[1], w[2]], [w[1], w[2], w[3]], [w[2], w[3], w[4]]];
        (0..frames as isize).map(|t| triplets(window(t))).collect()
    }

    #[test]
    fn shared_triplets_are_those_of_the_five_frame_windows() {
        for ends in [Ends::Circular, Ends::Mirrored] {
            for frames in 1..9 {
                let windows = Windows::new(frames, ends);
                let shared: Vec<_> = windows.second.iter().map(|w| w.map(|i| windows.first[i])).collect();
                assert_eq!(shared, naive(frames, ends), "{frames} frames, {ends:?}");
                assert!(windows.first.len() <= frames + 2);
            }
        }
    }
}
