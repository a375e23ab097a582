//! Denoisers that adapt to the scene while they solve, by the measurement alone, and carry what they learned to the next
//! measurement.
//!
//! [`AdaptiveDenoiser`] is a [`admm::Denoiser`] around a network: a solver does not know that it adapts. It learns from
//! `ℓ = mean (H T v − y)²`, the error of its own output at the sensor ([`Snapshot`]), when its [`Schedule`] says so; an
//! update is undone when pixels of the measurement that it did not see disagree ([`Guard`]). [`run_sequence`] solves the
//! measurements of a scene in order.
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

pub use adapt::AdaptiveDenoiser;
pub use config::{AdaptConfig, Guard, Terms};
pub use error::Error;
pub use loss::{Pixels, Snapshot, SplitLoss, accumulate_gradient};
pub use nets::Parameters;
pub use record::{Counts, Outcome, RollBack, Update};
pub use reuse::{Relation, Reuse, Similarity, continuation};
pub use schedule::Schedule;
pub use sequence::{Sequence, SequenceConfig, Solved, Task, run_sequence};

/// A result of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;
