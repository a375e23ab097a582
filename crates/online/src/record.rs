//! What updates did.

use crate::SplitLoss;
use serde::{Deserialize, Serialize};

/// Why an update was undone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RollBackReason {
    /// The loss, a gradient or the new output was not finite.
    NotFinite,
    /// The error at the pixels held out did not fall.
    HeldOut,
    /// The loss itself did not fall.
    Loss,
}

/// What became of an update that was due.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UpdateOutcome {
    /// The new weights are in use.
    Kept,
    /// The weights are, byte for byte, those before.
    RolledBack(RollBackReason),
    /// It did not fire, as too many in a row had been rolled back.
    Skipped,
}

/// An update that was due.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Update {
    /// The measurement of the sequence, from 0.
    pub measurement: usize,
    /// The iteration, from 0.
    pub iteration: usize,
    /// The learning rate; lower than the schedule's after roll-backs.
    pub learning_rate: f64,
    /// What became of it.
    pub outcome: UpdateOutcome,
    /// Mean of `r²` over the pixels that the loss sees, before; of an update that was skipped not computed.
    pub loss_before: Option<f64>,
    /// The same with the new weights; nothing when they were not finite.
    pub loss_after: Option<f64>,
    /// Mean of `r²` over the pixels held out, before.
    pub held_out_before: Option<f64>,
    /// The same with the new weights.
    pub held_out_after: Option<f64>,
}

impl Update {
    /// Before anything is tried.
    pub(crate) fn skipped(measurement: usize, iteration: usize, learning_rate: f64) -> Self {
        Self {
            measurement,
            iteration,
            learning_rate,
            outcome: UpdateOutcome::Skipped,
            loss_before: None,
            loss_after: None,
            held_out_before: None,
            held_out_after: None,
        }
    }

    pub(crate) fn with(mut self, before: SplitLoss, after: Option<SplitLoss>) -> Self {
        let finite = |v: f64| v.is_finite().then_some(v);
        self.loss_before = finite(before.loss);
        self.held_out_before = before.held_out.and_then(finite);
        self.loss_after = after.and_then(|after| finite(after.loss));
        self.held_out_after = after.and_then(|after| after.held_out).and_then(finite);
        self
    }
}

/// How many updates of which kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct UpdateCounts {
    /// Tried: kept or rolled back.
    pub fired: usize,
    /// With new weights in use.
    pub kept: usize,
    /// Undone.
    pub rolled_back: usize,
    /// Due, but not tried.
    pub skipped: usize,
}

impl UpdateCounts {
    /// Of a list of updates.
    pub fn of(updates: &[Update]) -> Self {
        let count = |f: fn(&UpdateOutcome) -> bool| updates.iter().filter(|u| f(&u.outcome)).count();
        let skipped = count(|o| matches!(o, UpdateOutcome::Skipped));
        Self {
            fired: updates.len() - skipped,
            kept: count(|o| matches!(o, UpdateOutcome::Kept)),
            rolled_back: count(|o| matches!(o, UpdateOutcome::RolledBack(_))),
            skipped,
        }
    }
}
