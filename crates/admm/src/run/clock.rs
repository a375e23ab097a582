//! The time of a solve.

use std::time::{Duration, Instant};

/// A clock that stands still while observers work.
pub(super) struct Clock {
    running_since: Option<Instant>,
    before: Duration,
}

impl Clock {
    pub(super) fn start() -> Self {
        Self { running_since: Some(Instant::now()), before: Duration::ZERO }
    }

    /// The time so far, stopped.
    pub(super) fn pause(&mut self) -> Duration {
        self.before = self.elapsed();
        self.running_since = None;
        self.before
    }

    /// Goes on; a clock that runs already is left alone.
    pub(super) fn resume(&mut self) {
        self.running_since.get_or_insert_with(Instant::now);
    }

    pub(super) fn elapsed(&self) -> Duration {
        self.before + self.running_since.map_or(Duration::ZERO, |since| since.elapsed())
    }
}
