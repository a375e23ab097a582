//! The solvers: [`Gap`] and [`Admm`] with one splitting, the paper's [`TwoStage`] for color sensors, and the [`WarmStart`].

mod admm;
mod gap;
mod known;
mod two_stage;
mod warm_start;

pub use admm::Admm;
pub use gap::{Gap, MomentumStart};
pub use two_stage::{Convention, TwoStage, TwoStageParams, XStep};
pub use warm_start::WarmStart;

use crate::{Call, Estimate, PriorError, Progress};
use sci_forward::Measurement;

/// An iterative solver: [`start`](Solver::start) once, [`step`](Solver::step) for each iteration. The loop ([`run`](crate::run)) owns the
/// iterates; a solver keeps what else it needs from one iteration to the next, its duals.
pub trait Solver: Send {
    /// Begins to solve a measurement from an estimate; whatever was solved before is forgotten.
    fn start(&mut self, measurement: &Measurement, from: &Estimate);

    /// One iteration: writes the estimate after `previous` to `next`, all of it, and returns how far `next.sensor` is from the
    /// measurement and from `previous.sensor`. `next` holds an earlier iterate.
    ///
    /// # Errors
    /// What the prior reports.
    fn step(
        &mut self,
        measurement: &Measurement,
        call: &Call<'_>,
        previous: &Estimate,
        next: &mut Estimate,
    ) -> Result<Progress, PriorError>;

    /// After a divergence: makes ready to go on from `good`, the best iterate so far, with more caution, and says
    /// what was given up; nothing if there is no more cautious way.
    fn back_off(&mut self, _measurement: &Measurement, _good: &Estimate) -> Option<&'static str> {
        None
    }
}
