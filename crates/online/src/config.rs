//! The settings of an adaptive denoiser.

use crate::{Error, Result, SplitConfig, UpdateSchedule};
use nets::Parameters;
use nets::kernels::Precision;

/// What a denoiser learns from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum AdaptLoss {
    /// How its output explains the measurement, while it solves: the paper's.
    Measurement,
    /// Pixels that trial solves are not given, before it solves: [`AdaptiveDenoiser::adapt_by_splitting`](crate::AdaptiveDenoiser::adapt_by_splitting).
    /// The other settings have no effect.
    Split(SplitConfig),
}

/// How a denoiser adapts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdaptConfig {
    /// From what.
    pub loss: AdaptLoss,
    /// When, and how far.
    pub schedule: UpdateSchedule,
    /// Which tensors change.
    pub parameters: Parameters,
    /// When an update is undone.
    pub roll_back: RollBackRule,
    /// What gradients are computed in; the network denoises as ever.
    pub precision: Precision,
    /// Of everything random: pixels held out, noise.
    pub seed: u64,
}

impl AdaptConfig {
    /// The paper's code with FFDNet: all parameters, no update is undone.
    pub const PAPER_FFDNET: Self = Self {
        loss: AdaptLoss::Measurement,
        schedule: UpdateSchedule::PAPER_FFDNET,
        parameters: Parameters::All,
        roll_back: RollBackRule::OFF,
        precision: Precision::F32,
        seed: 42,
    };
    /// The paper's code with FastDVDnet.
    pub const PAPER_FASTDVDNET: Self = Self { schedule: UpdateSchedule::PAPER_FASTDVDNET, ..Self::PAPER_FFDNET };

    /// Checks every setting.
    ///
    /// # Errors
    /// [`Error::Setting`] for the first that is out of range.
    pub fn validate(&self) -> Result<()> {
        if let AdaptLoss::Split(split) = self.loss {
            split.validate()?;
        }
        self.schedule.validate()?;
        let RollBackRule { held_out, back_off, .. } = self.roll_back;
        if !(0.0..1.0).contains(&held_out) {
            let legal = "a share of the pixels, at least 0 and less than 1";
            return Err(Error::Setting { key: "held_out", value: held_out.to_string(), legal });
        }
        if !(back_off > 0.0 && back_off <= 1.0) {
            let legal = "greater than 0 and at most 1";
            return Err(Error::Setting { key: "back_off", value: back_off.to_string(), legal });
        }
        Ok(())
    }
}

impl Default for AdaptConfig {
    /// Two short updates early, in iterations 3 and 6, that can be undone: later ones and longer steps lost on some
    /// scene. Found with accelerated GAP-FFDNet (gray, σ 50, 25, 12, 6, five iterations each, lr 3e-6) on three
    /// validation clips that are in no benchmark: +0.07, +0.14, +0.05 dB with the gradient of all frames, +0.06, +0.13,
    /// +0.14 dB with that of every fourth, which is all that an update needs to know its direction.
    ///
    /// Where weights are carried over only the first measurement of a scene updates: with updates in each of them
    /// *traffic* lost 0.1, 0.6, 1.4 dB in measurements 2 to 4 while the loss fell, at the pixels held out too.
    fn default() -> Self {
        let schedule = UpdateSchedule {
            interval: 3,
            max_updates: Some(2),
            steps: 1,
            stride: 4,
            learning_rate: 3e-6,
            growth: 100.0,
            ..UpdateSchedule::PAPER_FFDNET
        };
        Self { schedule, roll_back: RollBackRule::ON, precision: Precision::Bf16, ..Self::PAPER_FFDNET }
    }
}

/// When an update is undone. An update whose loss or output is not finite always is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RollBackRule {
    /// The share of the pixels of the measurement that the loss does not see, at least one pixel. An update is kept only if the
    /// error falls both where the loss looks and where it does not. 0: every update is kept that is finite.
    pub held_out: f64,
    /// After a roll-back the learning rate is multiplied by this, until the next reset.
    pub back_off: f64,
    /// After so many roll-backs in a row the updates of this measurement that are still due are skipped.
    pub patience: usize,
}

impl RollBackRule {
    /// The paper's: none.
    pub const OFF: Self = Self { held_out: 0.0, back_off: 1.0, patience: usize::MAX };
    /// One pixel in ten judges; half the learning rate after a roll-back, no more tries after two.
    pub const ON: Self = Self { held_out: 0.1, back_off: 0.5, patience: 2 };
}
