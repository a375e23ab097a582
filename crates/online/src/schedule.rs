//! When a denoiser updates itself, and how far it goes.

use crate::{Error, Result};

/// When updates fire, and what one of them does.
///
/// In iteration `k` (from 0) of measurement `m` (from 0) an update fires when `k > first` and `k mod interval_m = 0`,
/// unless `max_updates` have fired in this measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UpdateSchedule {
    /// No update up to this iteration: early iterations show only the rough features. 1 in the paper's code.
    pub first: usize,
    /// K₀, at least 1.
    pub interval: usize,
    /// At most so many in a measurement.
    pub max_updates: Option<usize>,
    /// Steps of Adam in an update, at least 1. Each update begins without moments, as in the paper's code.
    pub steps: usize,
    /// The gradient is that of every so many frames only, in the next update (or step) of the others; 1 for all, as in the
    /// paper. At least 1; more than there are frames is one of them. The residual is always that of all frames.
    pub stride: usize,
    /// The learning rate.
    pub learning_rate: f64,
    /// Standard deviation of the noise added to the network's input for the steps (not for the output that is used);
    /// one draw an update.
    pub input_noise: f32,
    /// `interval_m = interval · growthᵐ`, rounded: later measurements of a sequence update less often. At least 1.
    pub growth: f64,
}

impl UpdateSchedule {
    /// The paper's code with FFDNet on *walk*-like color scenes: lr 2e-6, 2 steps, every 15 iterations.
    pub const PAPER_FFDNET: Self = Self {
        first: 1,
        interval: 15,
        max_updates: None,
        steps: 2,
        stride: 1,
        learning_rate: 2e-6,
        input_noise: 0.0,
        growth: 1.0,
    };
    /// The paper's code with FastDVDnet: lr 2e-7, 2 steps, every 12 iterations, noise of 5/255 on the input.
    pub const PAPER_FASTDVDNET: Self =
        Self { interval: 12, learning_rate: 2e-7, input_noise: 5.0 / 255.0, ..Self::PAPER_FFDNET };

    /// Iterations between updates in measurement `m` of a sequence.
    pub fn interval_of(&self, m: usize) -> usize {
        let grown = self.interval as f64 * self.growth.powi(m.min(1 << 20) as i32);
        // A float beyond the range becomes the greatest integer: no update any more.
        (grown.round() as usize).max(1)
    }

    /// Whether an update fires in iteration `k` of measurement `m`, of which `fired` have been in it already.
    ///
    /// ```
    /// use online::UpdateSchedule;
    /// let schedule = UpdateSchedule { interval: 4, max_updates: Some(2), ..UpdateSchedule::PAPER_FFDNET };
    /// let mut fired = 0;
    /// let mut due = |k| { let due = schedule.due(k, 0, fired); fired += usize::from(due); due };
    /// assert_eq!((0..16).filter(|&k| due(k)).collect::<Vec<_>>(), [4, 8]);
    /// ```
    pub fn due(&self, k: usize, m: usize, fired: usize) -> bool {
        k > self.first && k.is_multiple_of(self.interval_of(m)) && self.max_updates.is_none_or(|max| fired < max)
    }

    pub(crate) fn validate(&self) -> Result<()> {
        let bad = |key, value: String, legal| Err(Error::Setting { key, value, legal });
        let finite_at_least = |v: f64, low: f64| v.is_finite() && v >= low;
        match self {
            s if s.interval == 0 => bad("interval", "0".into(), "at least 1"),
            s if s.steps == 0 => bad("steps", "0".into(), "at least 1"),
            s if s.stride == 0 => bad("stride", "0".into(), "at least 1"),
            s if !(finite_at_least(s.learning_rate, 0.0) && s.learning_rate > 0.0) => {
                bad("learning_rate", s.learning_rate.to_string(), "finite and greater than 0")
            }
            s if !finite_at_least(f64::from(s.input_noise), 0.0) => {
                bad("input_noise", s.input_noise.to_string(), "finite and at least 0")
            }
            s if !finite_at_least(s.growth, 1.0) => bad("growth", s.growth.to_string(), "finite and at least 1"),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fired(schedule: UpdateSchedule, iterations: usize, m: usize) -> Vec<usize> {
        let mut fired = Vec::new();
        for k in 0..iterations {
            if schedule.due(k, m, fired.len()) {
                fired.push(k);
            }
        }
        fired
    }

    /// Name, iterations, interval, limit, and where the updates fall.
    type Row = (&'static str, usize, usize, Option<usize>, &'static [usize]);

    /// Rows of the paper's code.
    #[test]
    fn the_papers_table() {
        let table: [Row; 8] = [
            ("FFDNet, Beauty", 25, 15, None, &[15]),
            ("FFDNet, Bosphorus", 20, 8, None, &[8, 16]),
            ("FFDNet, ShakeNDry", 20, 10, None, &[10]),
            ("FastDVD, Beauty", 18, 9, Some(1), &[9]),
            ("FastDVD, Jockey", 24, 12, None, &[12]),
            ("FastDVD + DDNet, Beauty, the last iteration", 23, 22, None, &[22]),
            ("FastDVD + DDNet, Runner", 55, 41, None, &[41]),
            ("FFDNet + DDNet, Beauty", 16, 6, None, &[6, 12]),
        ];
        for (row, iterations, interval, max_updates, expected) in table {
            let schedule = UpdateSchedule { interval, max_updates, ..UpdateSchedule::PAPER_FFDNET };
            assert_eq!(fired(schedule, iterations, 0), expected, "{row}");
        }
    }

    #[test]
    fn nothing_fires_up_to_first_and_the_interval_grows() {
        let schedule = UpdateSchedule { interval: 1, first: 3, ..UpdateSchedule::PAPER_FFDNET };
        assert_eq!(fired(schedule, 7, 0), [4, 5, 6]);
        let schedule = UpdateSchedule { interval: 3, growth: 2.0, ..UpdateSchedule::PAPER_FFDNET };
        assert_eq!((fired(schedule, 13, 0), fired(schedule, 13, 1)), (vec![3, 6, 9, 12], vec![6, 12]));
        assert_eq!(schedule.interval_of(5000), usize::MAX);
        assert!(fired(schedule, 100, 5000).is_empty());
    }

    #[test]
    fn settings_out_of_range_are_named() {
        let ok = UpdateSchedule::PAPER_FFDNET;
        let bad = [
            UpdateSchedule { interval: 0, ..ok },
            UpdateSchedule { steps: 0, ..ok },
            UpdateSchedule { stride: 0, ..ok },
            UpdateSchedule { learning_rate: 0.0, ..ok },
            UpdateSchedule { learning_rate: f64::NAN, ..ok },
            UpdateSchedule { input_noise: -1.0, ..ok },
            UpdateSchedule { growth: 0.5, ..ok },
        ];
        let keys = bad.map(|s| match s.validate() {
            Err(Error::Setting { key, .. }) => key,
            other => panic!("{other:?}"),
        });
        assert_eq!(keys, ["interval", "steps", "stride", "learning_rate", "learning_rate", "input_noise", "growth"]);
    }
}
