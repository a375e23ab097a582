//! How a run can end.

use crate::{BoxError, Estimate};

/// Why a measurement cannot be solved. Divergence is not an error: see [`StopReason::Diverged`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SolveError {
    /// An input has the wrong size.
    #[error("the {what} is {found:?}, the masks ask for {expected:?}")]
    Size {
        /// Which input.
        what: &'static str,
        /// The size it must have.
        expected: Vec<usize>,
        /// The size it has.
        found: Vec<usize>,
    },
    /// An input holds a NaN or an infinity.
    #[error("the {what} is {value} at index {at:?}: every value must be finite")]
    NotFinite {
        /// Which input.
        what: &'static str,
        /// The value.
        value: f32,
        /// Its index, in the order of the layout.
        at: Vec<usize>,
    },
    /// A setting of the plan is outside its range.
    #[error("{key} = {value}: {legal}")]
    Setting {
        /// The setting.
        key: &'static str,
        /// The value given.
        value: f64,
        /// What is legal.
        legal: &'static str,
    },
    /// A part of the prior failed.
    #[error("{part} {name} failed in iteration {iteration}")]
    Prior {
        /// What the part is: "denoiser", "demosaicer", "network".
        part: &'static str,
        /// Its name.
        name: String,
        /// The iteration, counted from 0.
        iteration: usize,
        /// What it reported.
        source: BoxError,
    },
    /// The observer failed.
    #[error("an observer failed in iteration {iteration}")]
    Observer {
        /// The iteration, counted from 0.
        iteration: usize,
        /// What it reported.
        source: BoxError,
    },
}

/// Why a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum StopReason {
    /// Every stage was run.
    ScheduleDone,
    /// The relative change fell to the tolerance.
    Converged,
    /// Stages did nothing for the held-out pixels any more ([`HoldOut`](crate::HoldOut)).
    Stalled,
    /// A value was not finite, the residual exploded, or what came out cannot be a scene: it explains the measurement worse than
    /// a black video, or is far brighter than it. The outcome holds the iterate that explains the measurement best.
    Diverged,
    /// The time limit passed.
    TimeUp,
    /// An observer asked for it.
    Observer,
}

/// A divergence that a solver went on after.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BackOff {
    /// The iteration that diverged, counted from 0.
    pub iteration: usize,
    /// What the solver did without from then on.
    pub without: &'static str,
}

/// The result of [`run`](crate::run).
#[derive(Debug)]
pub struct Outcome {
    /// The estimate, always finite: with held-out pixels the best one, else the last one, or after a divergence the one that
    /// explains the measurement best. It has an RGB video if the prior that made it had one; a start has none.
    pub estimate: Estimate,
    /// Why the run ended.
    pub stop: StopReason,
    /// The divergence that it went on after, if there was one.
    pub backed_off: Option<BackOff>,
    /// Iterations done, diverged ones included, those of a warm start not.
    pub iterations: usize,
    /// Seconds of solving, the start included, observers not.
    pub seconds: f64,
    /// `‖y − H x‖ / ‖y‖` of `estimate`.
    pub relative_residual: f64,
}
