//! Plug-and-play solvers for snapshot compressive imaging: one loop ([`run`]), solvers that take any [`Prior`]
//! ([`Gap`], [`Admm`], [`TwoStage`] for color sensors), and priors that need no network ([`Tv`], [`Wavelet`], [`Wnnm`]).
//!
//! A solver never sees ground truth, files, networks or the clock; observers and the stop rule do.
//!
#![doc = include_str!("../README.md")]

mod adapters;
mod calibrate;
mod data_step;
mod linear;
mod priors;
#[cfg(test)]
mod reference;
mod run;
mod solvers;
mod start;

pub use adapters::{
    Clipped, Demosaicked, Dimmed, Flips, PerLattice, PerStage, TileCounter, TileCounts, Tiles, flipped_axes, still,
};
pub use calibrate::{CalibrateError, Calibrated, Calibration, Exposure, Parameter};
pub use calibrate::{Progress as CalibrationProgress, Watch as CalibrationWatch};
pub use data_step::{DataStep, Progress, progress};
pub use priors::{Call, Denoiser, Estimate, Prior, PriorError, Tv, Wavelet, Wnnm, WnnmParams};
pub use run::{BackOff, HoldOut, IterInfo, Observer, Outcome, Plan, SolveError, Stage, StopReason, StopRule, run};
pub use sci_forward::{self, BoxError};
pub use solvers::{Admm, Convention, Gap, MomentumStart, Solver, TwoStage, TwoStageParams, WarmStart, XStep};
pub use start::Start;
