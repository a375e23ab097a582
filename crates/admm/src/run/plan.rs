//! What a run does and when it ends: stages of σ, and the stop rule.

use crate::HoldOut;
use std::time::Duration;

/// A number of iterations with one prior at one σ.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stage {
    /// σ given to the prior, in units of a frame's full scale; nothing for priors with a strength of their own.
    pub sigma: Option<f32>,
    /// Iterations.
    pub iterations: usize,
}

/// When to stop before the schedule is done.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StopRule {
    /// `Converged` once `‖x_k − x_{k−1}‖ / ‖x_k‖` is below this; 0 never.
    pub relative_change: f64,
    /// `TimeUp` after the iteration that passes this.
    pub time: Option<Duration>,
    /// `Diverged` once `‖y − H x‖ / ‖y‖` exceeds this, or a value is not finite.
    pub diverged_above: f64,
}

impl Default for StopRule {
    fn default() -> Self {
        // The reference's unnormalised start has a relative residual of about B; a run that leaves 1,000 does not come back.
        Self { relative_change: 0.0, time: None, diverged_above: 1e3 }
    }
}

/// The stages in order, and the stop rule.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The stages.
    pub stages: Vec<Stage>,
    /// The stop rule.
    pub stop: StopRule,
    /// Whether stages are cut short, judged by held-out pixels; off if nothing. The numbers of iterations
    /// are then limits, and what a stage leaves over of them is added to the next.
    pub hold_out: Option<HoldOut>,
}

impl Plan {
    /// These stages, stopped only by divergence.
    pub fn new(stages: impl Into<Vec<Stage>>) -> Self {
        Self { stages: stages.into(), stop: StopRule::default(), hold_out: None }
    }

    /// The iterations of all stages.
    pub fn iterations(&self) -> usize {
        self.stages.iter().map(|s| s.iterations).sum()
    }
}
