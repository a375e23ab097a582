//! The layers of ShiftNet: a small U-shaped network for whole clips.
//!
//! Everything is at half the size, each 2×2 pixels as channels (the *phases* of an image), a quarter and an eighth. Frames are
//! mixed at no cost: in each residual block a share of the channels is taken from the frame before, and as much from the frame after
//! (zeros beyond the ends), so that any number of frames goes through. What is added to something begins silent.
//!
//! # References
//! Zhang, Zuo, Zhang, *FFDNet*, TIP 2018 (half size by pixels as channels); Lin, Gan, Han, *TSM: temporal shift module*, ICCV 2019; Qi et al.,
//! *Real-time streaming video denoising with bidirectional buffers*, ACM MM 2022 (the shift in video restoration).

use super::temporal_shift::TemporalShift;
use crate::infer::{Engine, PHASES};
use crate::kernels::{Blocked, Conv3x3, LANES};
use crate::layers::{Conv, Shift, Source, chain};
use crate::weights::WeightFile;
use crate::{Error, Result};
use candle_core::Tensor;
use candle_nn::ops::pixel_shuffle;
use rayon::prelude::*;

/// Sizes at which the body works: a half, a quarter and an eighth.
const LEVELS: usize = 3;
/// Sides of an image are continued to a multiple of this.
pub(crate) const MULTIPLE: usize = 2 << (LEVELS - 1);
/// What the names of all tensors begin with.
const PREFIX: &str = "body.";

/// Its size.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Body {
    /// Channels that it is shown at half the size, and those that it finds.
    pub(crate) ends: (usize, usize),
    /// Channels at a half, a quarter and an eighth of the size: multiples of 16 up to 512.
    pub(crate) widths: [usize; LEVELS],
    /// Residual blocks at these sizes, at a half and a quarter as many on the way up again: 1 to 16 each.
    pub(crate) blocks: [usize; LEVELS],
}

impl Body {
    /// Whether a file has a body under names that begin so.
    pub(crate) fn is_in(file: &WeightFile, prefix: &str) -> bool {
        file.shape(&format!("{prefix}{PREFIX}input.weight")).is_some()
    }

    /// By the tensors of a file.
    pub(crate) fn recognise(file: &WeightFile) -> Option<Self> {
        let outputs = |name: &str| file.shape(&format!("{PREFIX}{name}.weight"))?.first().copied();
        let widths = [outputs("input")?, outputs("down0")?, outputs("down1")?];
        let blocks = |place: &str| (0..).take_while(|k| outputs(&format!("{place}.{k}.0")).is_some()).count();
        let shown = *file.shape(&format!("{PREFIX}input.weight"))?.get(1)?;
        let blocks = ["enter0", "enter1", "deepest"].map(blocks);
        Some(Self { ends: (shown, outputs("output")?), widths, blocks })
    }

    pub(crate) fn validate(self) -> Result<()> {
        let bad =
            |key, value: usize, legal: &str| Err(Error::Setting { key, value: value.to_string(), legal: legal.into() });
        let width = |w: &usize| !(16..=512).contains(w) || !w.is_multiple_of(16);
        if let Some(wrong) = self.widths.into_iter().find(width) {
            return bad("widths", wrong, "multiples of 16 from 16 to 512");
        }
        match self.blocks.into_iter().find(|n| !(1..=16).contains(n)) {
            Some(wrong) => bad("blocks", wrong, "1 to 16 each"),
            None => Ok(()),
        }
    }

    /// What is done between the first and the last convolution, and the name of each.
    fn steps(self) -> Vec<(String, Step)> {
        let blocks = |place: String, level: usize| {
            (0..self.blocks[level]).map(move |k| (format!("{place}.{k}"), Step::Block(level))).collect::<Vec<_>>()
        };
        let mut steps = Vec::new();
        for level in 0..LEVELS - 1 {
            steps.extend(blocks(format!("enter{level}"), level));
            steps.push((format!("down{level}"), Step::Down(level)));
        }
        steps.extend(blocks("deepest".to_owned(), LEVELS - 1));
        for level in (0..LEVELS - 1).rev() {
            steps.push((format!("up{level}"), Step::Up(level)));
            steps.extend(blocks(format!("leave{level}"), level));
        }
        steps
    }

    /// Name, channels, stride, ReLU, bias and silence of the layers, in the order in which they are done.
    fn layers(self) -> Vec<LayerSpec> {
        let (w, (shown, found)) = (self.widths, self.ends);
        let plain = |name: &str, inputs, outputs| LayerSpec::new(name.to_owned(), inputs, outputs);
        let mut layers = vec![plain("input", shown, w[0])];
        for (name, step) in self.steps() {
            match step {
                Step::Block(level) => {
                    let half = |i: usize| plain(&format!("{name}.{i}"), w[level], w[level]);
                    layers.push(LayerSpec { relu: true, ..half(0) });
                    layers.push(LayerSpec { silent: true, ..half(1) });
                }
                Step::Down(level) => {
                    layers.push(LayerSpec { stride: 2, relu: true, ..plain(&name, w[level], w[level + 1]) });
                }
                Step::Up(level) => {
                    let up = plain(&name, w[level + 1], PHASES * w[level]);
                    layers.push(LayerSpec { silent: true, bias: false, ..up });
                }
            }
        }
        layers.push(LayerSpec { silent: true, ..plain("output", w[0], found) });
        layers
    }

    /// Multiply-adds for each pixel of each frame.
    pub(crate) fn multiply_adds(self) -> f64 {
        let mut pixels = 1.0 / PHASES as f64;
        let mut sum = 0.0;
        for layer in self.layers() {
            pixels /= (layer.stride * layer.stride) as f64;
            sum += pixels * (9 * layer.inputs * layer.outputs) as f64;
            if layer.name.starts_with("up") {
                pixels *= PHASES as f64;
            }
        }
        sum
    }

    /// The layers, under names that begin so.
    pub(crate) fn build(self, source: &mut Source<'_>, prefix: &str) -> Result<Vec<Conv>> {
        let layer = |LayerSpec { name, inputs, outputs, stride, relu, bias, .. }| {
            let opts = Conv3x3 { stride, relu, ..Conv3x3::default() };
            let shift = if bias { Shift::Bias } else { Shift::Nothing };
            Conv::new(source, format!("{prefix}{PREFIX}{name}"), (inputs, outputs), opts, shift)
        };
        self.layers().into_iter().map(layer).collect()
    }

    /// Makes zero what begins as zero.
    pub(crate) fn silence(self, convs: &mut [Conv]) -> Result<()> {
        for (conv, _) in convs.iter_mut().zip(self.layers()).filter(|(_, layer)| layer.silent) {
            conv.silence()?;
        }
        Ok(())
    }

    /// Of so many bodies one after another, which layers' results are shuffled, and which are held in f32: all but those inside residual
    /// blocks.
    pub(crate) fn results(self, bodies: usize) -> (Vec<usize>, Vec<usize>) {
        let layers = self.layers();
        let which = |wanted: fn(&LayerSpec) -> bool| {
            let all = std::iter::repeat_n(&layers, bodies).flatten().enumerate();
            all.filter(|(_, layer)| wanted(layer)).map(|(i, _)| i).collect()
        };
        (which(|layer| layer.name.starts_with("up")), which(|layer| !(layer.relu && layer.stride == 1)))
    }

    /// Differentiable: of images `[N, shown, H/2, W/2]`, clips of `frames` frames one after another, what is found.
    pub(crate) fn forward(self, convs: &[Conv], shown: &Tensor, frames: usize) -> candle_core::Result<Tensor> {
        let mut next = 0;
        let mut layers = |count: usize| {
            next += count;
            &convs[next - count..next]
        };
        let mut h = chain(layers(1), &[], shown)?;
        let mut above = Vec::new();
        for (_, step) in self.steps() {
            h = match step {
                Step::Block(_) => {
                    let shifted = h.apply_op1(TemporalShift::of(h.dim(1)?, frames))?;
                    (&h + chain(layers(2), &[], &shifted)?)?
                }
                Step::Down(_) => {
                    let down = chain(layers(1), &[], &h)?;
                    above.push(std::mem::replace(&mut h, down.clone()));
                    down
                }
                Step::Up(_) => {
                    let up = pixel_shuffle(&chain(layers(1), &[], &h)?, 2)?;
                    match above.pop() {
                        Some(above) => (above + up)?,
                        None => up,
                    }
                }
            };
        }
        chain(layers(1), &[], &h)
    }

    /// Without gradients: all but the first and the last layer, for the features of all frames; `first` is the number of the first.
    pub(crate) fn between(self, engine: &mut Engine, first: usize, mut h: Vec<Blocked>) -> Result<Vec<Blocked>> {
        let mut next = first + 1;
        let mut above: Vec<Vec<Blocked>> = Vec::new();
        for (_, step) in self.steps() {
            match step {
                Step::Block(_) => {
                    add_block(engine, next, &mut h)?;
                    next += 2;
                }
                Step::Down(_) => {
                    let down = h.iter().map(|h| engine.conv(next, h)).collect::<Result<_>>()?;
                    above.push(std::mem::replace(&mut h, down));
                    next += 1;
                }
                Step::Up(_) => {
                    let mut sums = above.pop().unwrap_or_default();
                    for (h, sum) in h.drain(..).zip(&mut sums) {
                        engine.add_shuffled(next, h, sum)?;
                    }
                    h = sums;
                    next += 1;
                }
            }
        }
        Ok(h)
    }
}

/// A part of the body; its level is 0 at half the size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    /// Residual block: `h + conv(relu(conv(shift(h))))`.
    Block(usize),
    /// To the next level.
    Down(usize),
    /// Back from it, added to what was there.
    Up(usize),
}

/// A convolution.
struct LayerSpec {
    name: String,
    inputs: usize,
    outputs: usize,
    stride: usize,
    relu: bool,
    bias: bool,
    /// It begins as zero: what it is added to is right already.
    silent: bool,
}

impl LayerSpec {
    fn new(name: String, inputs: usize, outputs: usize) -> Self {
        Self { name, inputs, outputs, stride: 1, relu: false, bias: true, silent: false }
    }
}

/// A tensor of a smaller body (`weight`) within the one of a larger, untrained body (`own`): its channels keep their way through the shift in
/// time, and do not listen to the new ones. What the first layer is shown grows at its beginning.
pub(super) fn widened(own: &Tensor, weight: &Tensor, is_first: bool) -> Result<Tensor> {
    let size = |tensor: &Tensor, axis: usize| tensor.dims().get(axis).copied().unwrap_or(1);
    let (has, wants) = ([0, 1].map(|axis| size(weight, axis)), [0, 1].map(|axis| size(own, axis)));
    let kernel = own.elem_count() / (wants[0] * wants[1]);
    let old: Vec<f32> = weight.flatten_all()?.to_vec1()?;
    let mut new: Vec<f32> = own.flatten_all()?.to_vec1()?;
    for output in 0..has[0] {
        let row = &mut new[place(output, has[0], wants[0]) * wants[1] * kernel..][..wants[1] * kernel];
        row.fill(0.0);
        for input in 0..has[1] {
            let to = if is_first { wants[1] - has[1] + input } else { place(input, has[1], wants[1]) };
            row[to * kernel..][..kernel].copy_from_slice(&old[(output * has[1] + input) * kernel..][..kernel]);
        }
    }
    Ok(Tensor::from_vec(new, own.dims(), own.device())?)
}

/// Where channel `c` of `old` stands among `new`: those from the frame before, those from the frame after and the others begin with the old ones.
fn place(c: usize, old: usize, new: usize) -> usize {
    let (old, new) = (TemporalShift::each_way(old), TemporalShift::each_way(new));
    let group = (c / old.max(1)).min(2);
    group * new + c - group * old
}

/// The residual block of the layers `first` and the one after it, frame by frame.
fn add_block(engine: &mut Engine, first: usize, h: &mut [Blocked]) -> Result<()> {
    // The frame before, as it was before the block.
    let mut before: Option<Blocked> = None;
    for t in 0..h.len() {
        let (channels, height, width) = h[t].shape();
        let mut image = engine.image(channels, height, width);
        shift(&mut image, before.as_ref(), &h[t], h.get(t + 1));
        let inside = engine.conv(first, &image)?;
        let found = engine.conv(first + 1, &inside)?;
        engine.recycle(inside);
        sum(&mut image, &h[t], &found);
        engine.recycle(found);
        let old = before.replace(std::mem::replace(&mut h[t], image));
        old.into_iter().for_each(|old| engine.recycle(old));
    }
    before.into_iter().for_each(|old| engine.recycle(old));
    Ok(())
}

/// [`TemporalShift`] of one frame.
fn shift(image: &mut Blocked, before: Option<&Blocked>, now: &Blocked, after: Option<&Blocked>) {
    let each_way = TemporalShift::each_way(now.shape().0);
    for block in 0..image.blocks() {
        let lanes = |from: usize| {
            let [from, to] =
                [from, from + each_way].map(|c| c.clamp(block * LANES, (block + 1) * LANES) - block * LANES);
            from..to
        };
        let ways = [(lanes(0), before), (lanes(each_way), after)];
        image.par_rows_mut(block).enumerate().for_each(|(y, row)| {
            row.as_flattened_mut().copy_from_slice(now.row(block, y));
            for (lanes, other) in ways.iter().filter(|(lanes, _)| !lanes.is_empty()) {
                match other.map(|other| other.row(block, y).as_chunks::<LANES>().0) {
                    Some(other) => row.iter_mut().zip(other).for_each(|(to, from)| {
                        to[lanes.clone()].copy_from_slice(&from[lanes.clone()]);
                    }),
                    None => row.iter_mut().for_each(|to| to[lanes.clone()].fill(0.0)),
                }
            }
        });
    }
}

/// `image = a + b`.
fn sum(image: &mut Blocked, a: &Blocked, b: &Blocked) {
    for block in 0..image.blocks() {
        image.par_rows_mut(block).enumerate().for_each(|(y, row)| {
            let both = a.row(block, y).iter().zip(b.row(block, y));
            row.as_flattened_mut().iter_mut().zip(both).for_each(|(sum, (a, b))| *sum = a + b);
        });
    }
}
