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
//!   error is five times that of AVX-512; 40 iterations of GAP-FFDNet on *traffic* end 2e-5 dB apart.
//! * Every other f32 multiplication is done by one of two register tiles (`tile`): pixels × 16 or 32 output channels, or, for the
//!   weight gradient, input × output channels. They are written once over a 16-lane vector (`simd`) and compiled for
//!   AVX-512 (14 × 2 registers), AVX2 with FMA (6 × 2), NEON (6 × 4) and plain Rust. [`Isa::detect`] takes the best that
//!   the machine has, `SCI_KERNEL=amx|avx512|avx2|neon|portable` another one, [`conv3x3_on`] and [`PackedConv::new_on`] any.
//! * Elsewhere stride 1 is done by Winograd F(4×4, 3×3) (`winograd`): 32 tiles at a time are transformed, multiplied in 36 small
//!   matrix products and transformed back with bias and ReLU, so that both transforms (0.3 MB each at 64 channels) and
//!   most of the filters stay in the second-level cache. The weight gradient is the adjoint of the same steps.
//! * Stride 2, its gradient by input (four parities of output pixels), groups and very few input channels are done by
//!   the definition (`direct`), with the same register tile. Groups cost nothing special: a panel of output channels
//!   lists the input channels that reach it.
//! * Inference in 16-bit numbers ([`Precision::Bf16`]) multiplies integers in both ways (`integers`): `vpdpwssd` of AVX-512, `vpmaddwd` of AVX2.
//! * A result does not depend on the number of threads: strips are independent, every output number is one chain of
//!   multiply-adds in a fixed order, and the weight gradient is summed in chunks that the shape alone determines. Other
//!   instruction sets may differ in the last bits.
//! * Winograd mixes the pixels of a tile: a NaN or an infinity spreads over its 4×4 tile and those next to it; with integers over all tiles, or the
//!   strip, that have their scale in common.
//!
//! What was tried, on which machine, and how large the errors are: `docs/kernels.md`.

#[cfg(target_arch = "x86_64")]
mod amx;
mod blocked;
mod conv;
mod direct;
mod error;
mod geometry;
mod grad;
#[cfg_attr(not(target_arch = "x86_64"), path = "no_half.rs")]
mod half;
#[cfg(target_arch = "x86_64")]
mod integers;
mod isa;
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
pub use error::KernelError;
pub use geometry::{Conv3x3, Precision};
pub use isa::Isa;
pub use memory::{keep_freed_memory, release_freed_memory};
pub(crate) use op::layer_by_layer;
pub use op::{Link, conv_chain, conv3x3, conv3x3_on};
pub use peak::gemm_peak;
pub use scratch::Scratch;
pub use simd::LANES;

pub(crate) use blocked::Form;
pub(crate) use op::with_numbers;
