//! What watches a run from outside: progress, ground-truth metrics, early stops.

use crate::{BoxError, Estimate, Plan};
use std::ops::ControlFlow;

/// The state of the run after an iteration.
#[derive(Debug, Clone, Copy)]
pub struct IterInfo<'a> {
    /// The iteration, counted from 0 over all stages.
    pub iteration: usize,
    /// The stage, counted from 0.
    pub stage: usize,
    /// σ of the stage, in units of a frame's full scale, if it has one.
    pub sigma: Option<f32>,
    /// The estimate, at the sensor and in RGB.
    pub estimate: &'a Estimate,
    /// `‖y − H x‖ / ‖y‖` of the estimate.
    pub relative_residual: f64,
    /// `‖x_k − x_{k−1}‖ / ‖x_k‖` of the estimate.
    pub relative_change: f64,
    /// The mean square error that the held-out pixels predict, if there are any ([`HoldOut`](crate::HoldOut)).
    pub predicted_error: Option<f64>,
    /// Seconds of solving so far, observers not counted.
    pub seconds: f64,
}

/// Watches a run. Time spent in an observer is not counted as solving.
pub trait Observer {
    /// Called once, before the first iteration, that of a warm start too.
    ///
    /// # Errors
    /// An error ends the run with [`SolveError::Observer`](crate::SolveError::Observer).
    fn begin(&mut self, _plan: &Plan) -> Result<(), BoxError> {
        Ok(())
    }

    /// Called after each iteration of a [warm start](crate::Start::Warm), which has a count of its own; `Break` ends the run with
    /// [`StopReason::Observer`](crate::StopReason::Observer).
    ///
    /// # Errors
    /// An error ends the run with [`SolveError::Observer`](crate::SolveError::Observer).
    fn warm_start(&mut self, _it: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
        Ok(ControlFlow::Continue(()))
    }

    /// Called after each iteration; `Break` ends the run with [`StopReason::Observer`](crate::StopReason::Observer).
    ///
    /// # Errors
    /// An error ends the run with [`SolveError::Observer`](crate::SolveError::Observer).
    fn iteration(&mut self, it: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError>;
}

/// Watches nothing.
impl Observer for () {
    fn iteration(&mut self, _: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
        Ok(ControlFlow::Continue(()))
    }
}

impl<O: Observer + ?Sized> Observer for &mut O {
    fn begin(&mut self, plan: &Plan) -> Result<(), BoxError> {
        (**self).begin(plan)
    }
    fn warm_start(&mut self, it: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
        (**self).warm_start(it)
    }
    fn iteration(&mut self, it: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
        (**self).iteration(it)
    }
}
