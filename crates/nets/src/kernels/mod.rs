//! 3×3 convolutions with zero padding 1, f32 on the CPU: the part of the program where nearly all time goes.
//!
//! Two ways in. [`conv_chain`] (and [`conv3x3`], a chain of one) is a candle operation with gradients, planes `[N,C,H,W]` in and
//! out: training and adaptation use it. [`PackedConv`] is a layer whose filters are packed once and which maps one [`Blocked`]
//! image to another without allocating: inference chains these, and so does a [`conv_chain`] inside, forward and back.
//!
//! # How it works
//!
//! * Layout: channels in blocks of 16, one block of one pixel a cache line, a border of zeros around the image
//!   ([`Blocked`]).
//! * Where the processor has AMX, inference does convolutions of more than 16 channels by the definition on its matrix
//!   unit (`amx`), each number as the sum of two bf16 ones. Images between the layers of a network stay in that form. The
//!   error is five times that of AVX-512 (below); 40 iterations of GAP-FFDNet on *traffic* end 2e-5 dB apart.
//! * Every other multiplication is done by one of two register tiles (`tile`): pixels × 16 or 32 output channels, or, for the
//!   weight gradient, input × output channels. They are written once over a 16-lane vector (`simd`) and compiled for
//!   AVX-512 (14 × 2 registers), AVX2 with FMA (6 × 2), NEON (6 × 4) and plain Rust. [`Isa::detect`] takes the best that
//!   the machine has, `SCI_KERNEL=amx|avx512|avx2|neon|portable` another one, [`conv3x3_on`] and [`PackedConv::new_on`] any.
//! * Elsewhere stride 1 is done by Winograd F(4×4, 3×3) (`winograd`): 32 tiles at a time are transformed, multiplied in 36 small
//!   matrix products and transformed back with bias and ReLU, so that both transforms (0.3 MB each at 64 channels) and
//!   most of the filters stay in the second-level cache. The weight gradient is the adjoint of the same steps.
//! * Stride 2, its gradient by input (four parities of output pixels), groups and very few input channels are done by
//!   the definition (`direct`), with the same register tile. Groups cost nothing special: a panel of output channels
//!   lists the input channels that reach it.
//! * A result does not depend on the number of threads: strips are independent, every output number is one chain of
//!   multiply-adds in a fixed order, and the weight gradient is summed in chunks that the shape alone determines. Other
//!   instruction sets may differ in the last bits.
//! * Winograd mixes the pixels of a tile: a NaN or an infinity spreads over its 4×4 tile and those next to it.
//!
//! # What was tried
//!
//! GFLOP/s of one core of a Xeon with AVX-512 and AMX (2.6 GHz nominal, 2 MB second-level cache), counted as the
//! definition's multiplications, for the shapes 8×64×128², 8×96×128², 8×32×256², 8×128×64². The register tile alone
//! reaches 234. Measured on a shared machine, best of several runs, about ±5 %.
//!
//! | way                               | [`PackedConv`], blocked | [`conv3x3`], planes     | with both gradients     |
//! |-----------------------------------|-------------------------|-------------------------|-------------------------|
//! | F(4×4, 3×3)                       | 593 · 649 · 517 · 623   | 430 · 409 · 340 · 473   | 324 · 318 · 236 · 378   |
//! | F(2×2, 3×3), 64 tiles at a time   | 398 · 407 · 215 · 341   | 302 · 335 · 221 · 287   | 256 · 281 · 119 · 206   |
//! | direct                            | 218 · 205 · 221 · 222   | 191 · 201 · 182 · 203   | 165 · 181 · 136 · 182   |
//!
//! The last two columns are of a [`conv3x3`] that copied planes to blocks a strip at a time. As a chain of one it copies whole
//! images, and loses: two threads, in turn, forward 688 · 766 · 473 · 730 → 586 · 671 · 359 · 685, both 500 · 589 · 331 · 548 →
//! 432 · 519 · 272 · 491. But a network pays for the copies once, and the automatic differentiation no longer fills an image with
//! zeros to add a gradient to it: a training step (in turn, ms) of FFDNet went from 113 to 94, of FastDVDnet from 810 to 705.
//!
//! * Tiles transformed at a time: 16 lose 15 to 25 %, 48 lose 5 %, 64 more; 32 stay. Strips of 32, 64 or 128 tiles are
//!   within the noise of each other.
//! * Winograd against direct by channels (in → out, 128², time ratio): 3→32 1.46, 4→64 1.03, 5→64 0.89, 8→64 0.63,
//!   16→16 0.58, 64→1 0.49, 90→32 0.38. The rule in `conv` counts vector operations and predicts these to ±0.25,
//!   with the change of sign at the same place.
//! * Interpolation points of F(4×4, 3×3), RMS error at 64 channels in 10⁻⁶ (greatest error in 10⁻⁵): 0, ±1, ±2, ∞
//!   5.3 (9.1); ±1/2, ±1 5.4 (9.6); ±1/2, ±3/2 3.0 (7.6); ±3/4, ±3/2 2.6 (2.0); ±1/√2, ±√2 2.5 (2.0); ±5/8, ±3/2
//!   2.4 (2.5), the choice, which oneDNN made too. All cost the same. F(2×2, 3×3) has 0.8 (0.6), direct 1.4 (1.4).
//! * Candle's tensors: fresh memory for every result made [`conv3x3`] half as fast as now; [`keep_freed_memory`] cures
//!   it. Prefetching the lines that a strip's result will be written to gives 0 to 5 %.
//!
//! # The matrix unit
//!
//! Whole passes over 8 frames of 256×256, 2 threads, in turn (ms): by AVX-512 alone FFDNet gray 147, color 239,
//! FastDVDnet gray 576; with AMX 103, 163, 331.
//!
//! * The unit does 1,700 GMAC/s a core with zeros, 1,275 with other numbers (its clock falls): 425 of products of three
//!   parts, where the direct tile has 115. 2×2 tiles of 16×16 hide all loads; 4×1 tiles are 6 % slower.
//! * Storing, rounding and splitting a result beside the multiplication of the next: 16 %. Shuffled channels are added
//!   where they are stored: afterwards it took 3 %, on one thread.
//! * Outputs of each group of a grouped convolution in blocks of their own (90 channels become 96): 40 % fewer products
//!   in FastDVDnet's first layer.
//! * Asking for the next row early: up to 10 % in a loop over one layer, but 5 to 15 % slower in networks: not done.
//! * FastDVDnet has 2.6 times the products of FFDNet and takes 3.2 times as long. Its features at full size are 25 MB a
//!   frame, more than the second-level cache holds: 80 % of the time goes into the unit's loop, at 60 % of its speed
//!   (FFDNet 75 %); 6 % into splitting the first layer's results, 4 % into computing them.
//! * Training in f32 gains little: a step of FFDNet takes 88 ms, 95 by AVX-512; of FastDVDnet 695 to 699, 704.
//! * Not tried: the first two layers of FastDVDnet in bands of rows, without the image between them; its noise map as a
//!   bias (at most 2 %); whole frames in parallel.
//!
//! [`Precision::Bf16`] leaves the low part away: one product instead of three, half the memory, and the weight gradient on the unit too
//! (`half`). Steps a second of training: FFDNet 9 → 26, FastDVDnet 1.6 → 2.7, of which a tenth is Muon. FastDVDnet's blocks as one chain each
//! (`shuffle`), and rows of 16 pixels two at a time: 2.7 → 3.4, and through a whole solve 0.23 → 0.36. Packing by filters
//! instead of single numbers, the weight gradient of several small images with its sums read once, and candle's own threads put to rest: a
//! training step through a solve 19 % shorter (2.24 → 1.82 s). Reconstruction: GAP with the
//! FastDVDnets for iterates 2.4 → 1.2 s (gray), 16.5 → 9.4 s (color), the same PSNR to 0.01 dB; two-stage FFDNet, color, 11 → 6.1 s,
//! 0.01 to 0.02 dB less; the published gray FFDNet, which has no residual connection, loses 0.2 to 0.8 dB.
//!
//! # Error
//!
//! Against f64, inputs uniform in [-4, 4], weights N(0, 2/(9·Cin)), 40×40 pixels; results have an RMS of 3.2. A test
//! holds these to twice the values:
//!
//! With AMX, both channels: 6.2e-5 (1.3e-5); 1.5e-5 (3.3e-6); 1.6e-4 (2.9e-5), which is AVX-512's.
//!
//! | channels | result, max (RMS)   | gradient by input, of RMS 0.8 | gradient by weight, of RMS 52 |
//! |----------|---------------------|-------------------------------|-------------------------------|
//! | 64       | 2.5e-5 (2.4e-6)     | 5.9e-6 (6.0e-7)               | 1.6e-4 (2.9e-5)               |
//! | 96       | 2.8e-5 (2.9e-6)     | 6.9e-6 (7.2e-7)               | 1.6e-4 (2.9e-5)               |

#[cfg(target_arch = "x86_64")]
mod amx;
mod blocked;
mod conv;
mod direct;
mod grad;
#[cfg_attr(not(target_arch = "x86_64"), path = "no_half.rs")]
mod half;
mod memory;
mod op;
mod peak;
mod scratch;
pub(crate) mod shuffle;
mod simd;
mod tile;
mod winograd;

pub use blocked::Blocked;
pub use conv::PackedConv;
pub use memory::keep_freed_memory;
pub(crate) use op::layer_by_layer;
pub use op::{Conv3x3, Link, Precision, conv_chain, conv3x3, conv3x3_on};
pub use peak::gemm_peak;
pub use scratch::Scratch;
pub use simd::{Isa, LANES};

pub(crate) use blocked::Form;
use blocked::{Pixel, View, ViewMut, ZERO};
pub(crate) use op::with_numbers;

/// A rule of the kernels that a call broke.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum KernelError {
    /// `SCI_KERNEL` names no instruction set.
    #[error("SCI_KERNEL is {0:?}; it can be amx, avx512, avx2, neon or portable")]
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
    /// The image is in a form of the matrix unit that the convolution is not for.
    #[error("an image for the matrix unit goes into a convolution for another form")]
    Form,
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

    fn at(&self, o: usize, c: usize, tap: usize) -> f32 {
        self.index(o, c, tap).map_or(0.0, |i| self.data[i])
    }

    /// The filters of a block of outputs for input `c`, one pixel of outputs for each tap; zeros where there are none.
    fn block(&self, block: usize, c: usize) -> [Pixel; 9] {
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
struct Panel {
    block: usize,
    vecs: usize,
}

/// Channels `lane..lane + len` of a block.
#[derive(Debug, Clone, Copy)]
struct ChannelRun {
    block: usize,
    lane: usize,
    len: usize,
}

impl ChannelRun {
    /// The channels' numbers.
    fn channels(self) -> std::ops::Range<usize> {
        let first = self.block * LANES + self.lane;
        first..first + self.len
    }
}

impl Panel {
    fn cut(outputs: usize, vecs: usize) -> Vec<Self> {
        let blocks = outputs.div_ceil(LANES);
        (0..blocks).step_by(vecs).map(|block| Self { block, vecs: vecs.min(blocks - block) }).collect()
    }

    /// The input channels that reach the panel's outputs.
    fn input_runs(self, weights: &Weights<'_>) -> impl Iterator<Item = ChannelRun> + use<> {
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
