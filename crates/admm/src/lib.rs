//! Plug-and-play solvers for snapshot compressive imaging: one loop ([`run`]), solvers that take any [`Prior`]
//! ([`Gap`], [`Admm`], [`TwoStage`] for color sensors), and priors that need no network ([`Tv`], [`Wavelet`], [`Wnnm`]).
//!
//! A solver never sees ground truth, files, networks or the clock; observers and the stop rule do.
//!
//! ```
//! use std::sync::Arc;
//! use admm::sci_forward::{MaskOperator, MaskStack, Measurement, SensingOperator, VideoShape};
//! use admm::{Gap, Plan, Stage, Start, Tv, run};
//!
//! // A bright square on a dark ground, one pixel further to the right in each frame.
//! let shape = VideoShape { frames: 4, height: 32, width: 32 };
//! let square = |(t, i, j)| if (8..20).contains(&i) && (8 + t..20 + t).contains(&j) { 0.9 } else { 0.1 };
//! let truth = ndarray::Array3::from_shape_fn(shape.dim(), square);
//! let h = MaskOperator::new(MaskStack::random(shape, 0.5, 0)?);
//! let y = h.forward(truth.view());
//!
//! let measurement = Measurement::new(Arc::new(h), y)?;
//! let mut solver = Gap::accelerated(Tv::new(0.1)); // TV has a weight of its own in the place of σ
//! let plan = Plan::new([Stage { sigma: None, iterations: 60 }]);
//! let outcome = run(&mut solver, &measurement, Start::Mean, &plan, &mut ())?;
//! let still = run(&mut solver, &measurement, Start::Mean, &Plan::new([]), &mut ())?; // the start: every frame the same
//! let rms = |x: ndarray::Array3<f32>| (x - &truth).mapv(|d| d * d).mean().unwrap().sqrt();
//! let (solved, started) = (rms(outcome.estimate.sensor), rms(still.estimate.sensor));
//! assert!(solved < 0.75 * started, "{solved} of {started}");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod adapters;
mod calibrate;
mod data_step;
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
