//! What the ways of convolving have in common: how it is done, its filters, and the pieces that an image is cut into.

#[cfg(target_arch = "x86_64")]
use super::blocked::{Pixel, ZERO};
use super::blocked::{View, ViewMut, check_len};
use super::error::KernelError;
use super::simd::LANES;

/// How a 3×3 convolution is done; the padding is always one zero on each side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Conv3x3 {
    /// Step between output pixels: 1 or 2.
    pub stride: usize,
    /// Number of channel groups; it divides both channel counts.
    pub groups: usize,
    /// Apply `max(·, 0)` to the result.
    pub relu: bool,
    /// What numbers are multiplied.
    pub precision: Precision,
}

impl Default for Conv3x3 {
    /// Stride 1, one group, no ReLU, f32.
    fn default() -> Self {
        Self { stride: 1, groups: 1, relu: false, precision: Precision::F32 }
    }
}

/// What numbers are multiplied, and kept between the layers of a [`conv_chain`](super::conv_chain); sums and parameters are f32 in any case.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// f32.
    #[default]
    F32,
    /// 16-bit numbers. On a matrix unit bf16, of 8 bits: twice as fast, also to train with. With AVX2, or AVX-512 and VNNI, inference multiplies
    /// integers, and gradients are of f32; elsewhere all is f32.
    Bf16,
}

/// How output pixels step over input pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Step {
    /// Stride 1.
    Same,
    /// Stride 2.
    Half,
    /// The gradient of stride 2: two output pixels for one input pixel.
    Double,
}

impl Step {
    pub(super) fn of_stride(stride: usize) -> Result<Self, KernelError> {
        match stride {
            1 => Ok(Self::Same),
            2 => Ok(Self::Half),
            _ => Err(KernelError::Stride(stride)),
        }
    }

    /// Rows (or columns) of the result of a convolution of `n`.
    pub(super) fn out_size(self, n: usize) -> usize {
        match self {
            Self::Same => n,
            Self::Half => n.div_ceil(2),
            Self::Double => 2 * n,
        }
    }

    /// First row of the padded input that output row `y` reads.
    pub(super) fn first_row(self, y: usize) -> usize {
        match self {
            Self::Same => y,
            Self::Half => 2 * y,
            Self::Double => y / 2,
        }
    }
}

/// Filters as the caller has them, `[Cout, Cin/groups, 3, 3]`, seen as those of a convolution or of its adjoint.
#[derive(Debug, Clone, Copy)]
pub(super) struct Weights<'a> {
    pub(super) data: &'a [f32],
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    pub(super) groups: usize,
    /// The adjoint: `inputs` and `outputs` change places and the filters turn by 180°.
    pub(super) adjoint: bool,
}

impl<'a> Weights<'a> {
    pub(super) fn new(data: &'a [f32], inputs: usize, outputs: usize, groups: usize) -> Result<Self, KernelError> {
        if groups == 0 || !inputs.is_multiple_of(groups) || !outputs.is_multiple_of(groups) {
            return Err(KernelError::Groups { groups, inputs, outputs });
        }
        check_len(outputs * (inputs / groups) * 9, data.len())?;
        Ok(Self { data, inputs, outputs, groups, adjoint: false })
    }

    pub(super) fn adjoint(self) -> Self {
        Self { inputs: self.outputs, outputs: self.inputs, adjoint: !self.adjoint, ..self }
    }

    /// Where the weight of output `o`, input `c` is, or nothing when they are of different groups.
    pub(super) fn index(&self, o: usize, c: usize, tap: usize) -> Option<usize> {
        // Packing calls this for every weight: no division where there is one group.
        let alone = self.groups == 1;
        let out_each = if alone { self.outputs } else { self.outputs / self.groups };
        let in_each = if alone { self.inputs } else { self.inputs / self.groups };
        let group = if alone { 0 } else { o / out_each };
        (alone || c / in_each == group).then(|| {
            if self.adjoint {
                (c * out_each + o - group * out_each) * 9 + 8 - tap
            } else {
                (o * in_each + c - group * in_each) * 9 + tap
            }
        })
    }

    pub(super) fn at(&self, o: usize, c: usize, tap: usize) -> f32 {
        self.index(o, c, tap).map_or(0.0, |i| self.data[i])
    }

    /// The filters of a block of outputs for input `c`, one pixel of outputs for each tap; zeros where there are none. For the matrix unit.
    #[cfg(target_arch = "x86_64")]
    pub(super) fn block(&self, block: usize, c: usize) -> [Pixel; 9] {
        let mut taps = [ZERO; 9];
        let outputs = block * LANES..self.outputs.min((block + 1) * LANES);
        for (lane, o) in outputs.enumerate().take_while(|_| c < self.inputs) {
            let Some(first) = self.index(o, c, if self.adjoint { 8 } else { 0 }) else { continue };
            for (i, &weight) in self.data[first..first + 9].iter().enumerate() {
                taps[if self.adjoint { 8 - i } else { i }].0[lane] = weight;
            }
        }
        taps
    }
}

/// One or two neighbouring blocks of output channels, worked on together.
#[derive(Debug, Clone, Copy)]
pub(super) struct Panel {
    pub(super) block: usize,
    pub(super) vecs: usize,
}

/// Channels `lane..lane + len` of a block.
#[derive(Debug, Clone, Copy)]
pub(super) struct ChannelRun {
    pub(super) block: usize,
    pub(super) lane: usize,
    pub(super) len: usize,
}

impl ChannelRun {
    /// The channels' numbers.
    pub(super) fn channels(self) -> std::ops::Range<usize> {
        let first = self.block * LANES + self.lane;
        first..first + self.len
    }
}

impl Panel {
    pub(super) fn cut(outputs: usize, vecs: usize) -> Vec<Self> {
        let blocks = outputs.div_ceil(LANES);
        (0..blocks).step_by(vecs).map(|block| Self { block, vecs: vecs.min(blocks - block) }).collect()
    }

    /// The input channels that reach the panel's outputs.
    pub(super) fn input_runs(self, weights: &Weights<'_>) -> impl Iterator<Item = ChannelRun> + use<> {
        let first = self.block * LANES;
        let last = (first + self.vecs * LANES).min(weights.outputs) - 1;
        let (out_each, in_each) = (weights.outputs / weights.groups, weights.inputs / weights.groups);
        let (low, high) = (first / out_each * in_each, (last / out_each + 1) * in_each);
        (low / LANES..high.div_ceil(LANES)).map(move |b| {
            let (from, to) = (low.max(b * LANES), high.min((b + 1) * LANES));
            ChannelRun { block: b, lane: from - b * LANES, len: to - from }
        })
    }
}

/// Output rows that are worked on at once.
#[derive(Clone, Copy)]
pub(super) struct Strip {
    /// Padded input; its first row is the first that the strip reads.
    pub(super) src: View,
    /// Output; its first row is the strip's first.
    pub(super) dst: ViewMut,
    pub(super) rows: usize,
    pub(super) width: usize,
}

/// What the weight gradient sees of a strip of output rows.
#[derive(Clone, Copy)]
pub(super) struct GradStrip {
    /// Padded input; its first row is the first that the strip reads.
    pub(super) input: View,
    /// Output gradient from the strip's first row and the first column on, zero to the next whole tile.
    pub(super) grad: View,
    pub(super) rows: usize,
    pub(super) width: usize,
}
