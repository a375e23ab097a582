//! FFDNet, FastDVDnet and DDNet: the learned denoisers and demosaicer of plug-and-play reconstruction, on candle, with
//! CPU convolution kernels of their own.
//!
#![doc = include_str!("../README.md")]

mod architecture;
mod ddnet;
mod error;
mod fastdvdnet;
mod ffdnet;
#[cfg(test)]
mod gradient_tests;
mod infer;
pub mod kernels;
mod layers;
mod mixed_precision;
mod network;
mod shiftnet;
pub mod train;
pub mod unrolled;
mod video;
pub mod weights;

pub use admm;
pub use architecture::Architecture;
pub use ddnet::{Ddnet, DdnetSpec};
pub use error::{Error, KeyReport};
pub use fastdvdnet::{Fastdvdnet, FastdvdnetSpec};
pub use ffdnet::{Ffdnet, FfdnetLayout, FfdnetSpec};
pub use layers::Parameters;
pub use mixed_precision::{MixedPrecision, PrecisionCounter, PrecisionCounts, SelectPrecision};
pub use network::{Layers, Network, Window};
pub use shiftnet::{Experts, Shiftnet, ShiftnetSpec};
pub use video::Ends;
pub use weights::WeightFile;

/// A result of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;
