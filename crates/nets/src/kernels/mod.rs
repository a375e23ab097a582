//! 3×3 convolutions with zero padding 1: the part of the program where nearly all CPU time goes.

mod blocked;
mod conv;
mod direct;
mod grad;
mod memory;
mod op;
mod peak;
mod scratch;
mod simd;
mod tile;
mod winograd;

pub use blocked::Blocked;
pub use conv::PackedConv;
pub use memory::keep_freed_memory;
pub use op::{Conv3x3, conv3x3, conv3x3_on};
pub use peak::gemm_peak;
pub use scratch::Scratch;
pub use simd::{Isa, LANES};

use blocked::{View, ViewMut};

/// A rule of the kernels that a call broke.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum KernelError {
    /// `SCI_KERNEL` names no instruction set.
    #[error("SCI_KERNEL is {0:?}; it can be avx512, avx2, neon or portable")]
    UnknownIsa(String),
    /// This machine lacks the instruction set.
    #[error("this machine has no {0}")]
    MissingIsa(&'static str),
    /// A slice is not as long as its shape says.
    #[error("{found} numbers where the shape has {expected}")]
    Length {
        /// By the shape.
        expected: usize,
        /// In the slice.
        found: usize,
    },
    /// An image's channels are not those of the convolution.
    #[error("{found} channels go into a convolution of {expected}")]
    Channels {
        /// Of the convolution.
        expected: usize,
        /// Of the image.
        found: usize,
    },
    /// The stride is neither 1 nor 2.
    #[error("stride {0}; it can be 1 or 2")]
    Stride(usize),
    /// The groups do not divide the channels.
    #[error("{groups} groups do not divide {inputs} input and {outputs} output channels")]
    Groups {
        /// Number of groups.
        groups: usize,
        /// Input channels.
        inputs: usize,
        /// Output channels.
        outputs: usize,
    },
    /// The image or the batch is empty.
    #[error("an empty image: {0:?}")]
    Empty([usize; 4]),
}

/// How output pixels step over input pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    /// Stride 1.
    Same,
    /// Stride 2.
    Half,
    /// The gradient of stride 2: two output pixels for one input pixel.
    Double,
}

impl Step {
    fn of_stride(stride: usize) -> Result<Self, KernelError> {
        match stride {
            1 => Ok(Self::Same),
            2 => Ok(Self::Half),
            _ => Err(KernelError::Stride(stride)),
        }
    }

    /// Rows (or columns) of the result of a convolution of `n`.
    fn out_size(self, n: usize) -> usize {
        match self {
            Self::Same => n,
            Self::Half => n.div_ceil(2),
            Self::Double => 2 * n,
        }
    }

    /// First row of the padded input that output row `y` reads.
    fn first_row(self, y: usize) -> usize {
        match self {
            Self::Same => y,
            Self::Half => 2 * y,
            Self::Double => y / 2,
        }
    }

    /// Rows of the padded input that `rows` output rows read.
    fn input_rows(self, rows: usize) -> usize {
        match self {
            // whole Winograd tiles
            Self::Same => rows.next_multiple_of(winograd::TILE) + 2,
            Self::Half | Self::Double => self.first_row(rows - 1) + 3,
        }
    }
}

/// Filters as the caller has them, `[Cout, Cin/groups, 3, 3]`, seen as those of a convolution or of its adjoint.
#[derive(Debug, Clone, Copy)]
struct Weights<'a> {
    data: &'a [f32],
    inputs: usize,
    outputs: usize,
    groups: usize,
    /// The adjoint: `inputs` and `outputs` change places and the filters turn by 180°.
    adjoint: bool,
}

impl<'a> Weights<'a> {
    fn new(data: &'a [f32], inputs: usize, outputs: usize, groups: usize) -> Result<Self, KernelError> {
        if groups == 0 || !inputs.is_multiple_of(groups) || !outputs.is_multiple_of(groups) {
            return Err(KernelError::Groups { groups, inputs, outputs });
        }
        blocked::check_len(outputs * (inputs / groups) * 9, data.len())?;
        Ok(Self { data, inputs, outputs, groups, adjoint: false })
    }

    fn adjoint(self) -> Self {
        Self { inputs: self.outputs, outputs: self.inputs, adjoint: !self.adjoint, ..self }
    }

    /// Where the weight of output `o`, input `c` is, or nothing when they are of different groups.
    fn index(&self, o: usize, c: usize, tap: usize) -> Option<usize> {
        let (out_each, in_each) = (self.outputs / self.groups, self.inputs / self.groups);
        let group = o / out_each;
        (c / in_each == group).then(|| {
            if self.adjoint {
                (c * out_each + o - group * out_each) * 9 + 8 - tap
            } else {
                (o * in_each + c - group * in_each) * 9 + tap
            }
        })
    }

    fn at(&self, o: usize, c: usize, tap: usize) -> f32 {
        self.index(o, c, tap).map_or(0.0, |i| self.data[i])
    }
}

/// One or two neighbouring blocks of output channels, worked on together.
#[derive(Debug, Clone, Copy)]
struct Panel {
    block: usize,
    vecs: usize,
}

impl Panel {
    fn cut(outputs: usize, vecs: usize) -> Vec<Self> {
        let blocks = outputs.div_ceil(LANES);
        (0..blocks).step_by(vecs).map(|block| Self { block, vecs: vecs.min(blocks - block) }).collect()
    }

    /// The input channels that reach the panel's outputs, as `(block, first lane, lanes)`.
    fn input_runs(self, weights: &Weights<'_>) -> impl Iterator<Item = (usize, usize, usize)> + use<> {
        let first = self.block * LANES;
        let last = (first + self.vecs * LANES).min(weights.outputs) - 1;
        let (out_each, in_each) = (weights.outputs / weights.groups, weights.inputs / weights.groups);
        let (low, high) = (first / out_each * in_each, (last / out_each + 1) * in_each);
        (low / LANES..high.div_ceil(LANES)).map(move |b| {
            let (from, to) = (low.max(b * LANES), high.min((b + 1) * LANES));
            (b, from - b * LANES, to - from)
        })
    }
}

/// Output rows that are worked on at once.
#[derive(Clone, Copy)]
struct Strip {
    /// Padded input; its first row is the first that the strip reads.
    src: View,
    /// Output; its first row is the strip's first.
    dst: ViewMut,
    rows: usize,
    width: usize,
}

/// What the weight gradient sees of a strip of output rows.
#[derive(Clone, Copy)]
struct GradStrip {
    /// Padded input; its first row is the first that the strip reads.
    input: View,
    /// Output gradient from the strip's first row and the first column on, zero to the next whole tile.
    grad: View,
    rows: usize,
    width: usize,
}
