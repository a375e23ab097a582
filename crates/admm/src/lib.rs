//! Plug-and-play solvers for snapshot compressive imaging: one loop ([`run`]), solvers that take any [`Denoiser`]
//! ([`Gap`], [`Admm`], [`TwoStage`] for color sensors), and priors that need no network ([`Tv`], [`Wnnm`]).
//!
//! A solver never sees ground truth, files, networks or the clock; observers and the stop rule do.
//!
//! ```
//! use admm::{Gap, Plan, Problem, Stage, Start, Tv, run};
//! use sci_forward::{MaskOperator, MaskStack, SensingOperator, VideoShape, testing::moving_square};
//!
//! let shape = VideoShape { frames: 4, height: 32, width: 32 };
//! let h = MaskOperator::new(MaskStack::random(shape, 0.5, 0)?);
//! let truth = moving_square(shape);
//! let y = h.forward(truth.view());
//!
//! let mut solver = Gap::accelerated(Tv::new(0.1));
//! let plan = Plan::new([Stage { sigma: 0.0, iterations: 30 }]);
//! let outcome = run(&mut solver, &Problem::new(&h, y.view())?, Start::Mean, &plan, &mut ())?;
//! assert!((outcome.estimate - truth).iter().all(|d| d.abs() < 0.5));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod admm;
mod color;
mod flips;
mod gap;
mod guard;
mod held_out;
mod lanes;
mod observer;
mod prior;
mod problem;
#[cfg(test)]
mod reference;
mod schedule;
mod solver;
mod still;
mod tiles;
mod tv;
mod two_stage;
mod wnnm;

pub use admm::Admm;
pub use color::{Demosaicked, PerLattice};
pub use flips::{Flips, flipped_axes};
pub use gap::{Gap, MomentumStart};
pub use held_out::HoldOut;
pub use observer::{IterInfo, Observer};
pub use prior::{Clipped, DenoiseCx, Denoiser, PerStage};
pub use problem::{Problem, Start};
pub use schedule::{Plan, Stage, StopRule};
pub use sci_forward::BoxError;
pub use solver::{BackOff, Outcome, SolveError, Solver, StopReason, run};
pub use still::still;
pub use tiles::{TileConfig, TileCounts, Tiles};
pub use tv::Tv;
pub use two_stage::{Convention, TwoStage, TwoStageParams, XStep};
pub use wnnm::Wnnm;
