//! Denoisers that adapt to the scene while they solve, by the measurement alone, and carry what they learned to the next
//! measurement.
//!
#![doc = include_str!("../README.md")]
//!
//! [`AdaptiveDenoiser`] is a [`admm::Denoiser`] around a network: a solver does not know that it adapts. It learns from
//! `ℓ = mean (H T v − y)²`, the error of its own output v at the sensor, when its [`UpdateSchedule`] says so; an update is
//! undone when pixels of the measurement that it did not see disagree ([`RollBackRule`]). It sees what the solver was given
//! ([`admm::Call::measurement`]), so that pixels held out of the solve judge an adapted network as they judge any other prior.
//! [`run_sequence`] solves the measurements of a scene in order. [`adapt_by_splitting`] learns before a solve instead, from pixels that trial
//! solves were not given: what pays for networks that were trained for a solver's iterates.
//!
//! # Differences from the paper
//! * Algorithm 2 lists the update at the end of iteration k, after w and u. It is done inside the v step here, as in the
//!   authors' code, and the output of the new weights is the v of that same iteration.
//! * The paper's loss is a sum of squares of `y − H T x^(k)`. It is a mean here, of v as the network gives it (before any
//!   clipping), as in the authors' code; the mean is over the open pixels that are not held out.
//!
//! # References
//! Wu et al., *Adaptive Deep PnP Algorithm for Video Snapshot Compressive Imaging*, sections "Online PnP" and "Online PnP
//! for Continuous Measurements".

mod adapt;
mod config;
mod error;
mod loss;
mod record;
mod reuse;
mod schedule;
mod sequence;
mod split;

pub use adapt::AdaptiveDenoiser;
pub use config::{AdaptConfig, AdaptLoss, RollBackRule};
pub use error::Error;
pub use loss::{PixelSplit, SplitLoss, accumulate_gradient};
pub use nets::{self, Parameters};
pub use record::{RollBackReason, Update, UpdateCounts, UpdateOutcome};
pub use reuse::{Relation, Reuse, Similarity, continuation};
pub use schedule::UpdateSchedule;
pub use sequence::{Sequence, SequenceConfig, Solved, Task, run_sequence};
pub use split::{Judgement, SplitConfig, SplitRecord, Successor, adapt_by_splitting};

/// A result of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;
