//! The settings of an adaptive denoiser.

use crate::{Error, Result, Schedule};
use nets::Parameters;
use nets::kernels::Precision;

/// How a denoiser adapts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdaptConfig {
    /// When, and how far.
    pub schedule: Schedule,
    /// Which tensors change.
    pub parameters: Parameters,
    /// What the loss has besides the error at the sensor.
    pub terms: Terms,
    /// When an update is undone.
    pub guard: Guard,
    /// The share of the pixels that the loss sees, taken out of the network's input for it together with the pixels held
    /// out ([`Pixels::blinded`](crate::Pixels::blinded)). Nothing: the paper's loss, which sees all that are not held
    /// out, with an input that holds them.
    pub blind: Option<f64>,
    /// What gradients are computed in; the network denoises as ever.
    pub precision: Precision,
    /// Of everything random: pixels held out, noise, flips.
    pub seed: u64,
}

impl AdaptConfig {
    /// The paper's code with FFDNet: all parameters, the plain loss, no guard.
    pub const PAPER_FFDNET: Self = Self {
        schedule: Schedule::PAPER_FFDNET,
        parameters: Parameters::All,
        terms: Terms::NONE,
        guard: Guard::OFF,
        blind: None,
        precision: Precision::F32,
        seed: 42,
    };
    /// The paper's code with FastDVDnet.
    pub const PAPER_FASTDVDNET: Self = Self { schedule: Schedule::PAPER_FASTDVDNET, ..Self::PAPER_FFDNET };

    /// Checks every setting.
    ///
    /// # Errors
    /// [`Error::Setting`] for the first that is out of range.
    pub fn validate(&self) -> Result<()> {
        self.schedule.validate()?;
        let Terms { pseudo_clean, distance, equivariance } = self.terms;
        for (key, weight) in [("pseudo_clean", pseudo_clean), ("distance", distance), ("equivariance", equivariance)] {
            if !(weight.is_finite() && weight >= 0.0) {
                let legal = "a weight, finite and at least 0";
                return Err(Error::Setting { key, value: weight.to_string(), legal });
            }
        }
        let Guard { held_out, back_off, .. } = self.guard;
        if !(0.0..1.0).contains(&held_out) {
            let legal = "a share of the pixels, at least 0 and less than 1";
            return Err(Error::Setting { key: "held_out", value: held_out.to_string(), legal });
        }
        if let Some(seen) = self.blind.filter(|seen| !(*seen > 0.0 && seen + held_out <= 0.9)) {
            let legal = "greater than 0, and at most 0.9 together with held_out: what is left are the neighbours";
            return Err(Error::Setting { key: "blind", value: seen.to_string(), legal });
        }
        if !(back_off > 0.0 && back_off <= 1.0) {
            let legal = "greater than 0 and at most 1";
            return Err(Error::Setting { key: "back_off", value: back_off.to_string(), legal });
        }
        Ok(())
    }
}

impl Default for AdaptConfig {
    /// Two short updates early, in iterations 3 and 6, guarded: later ones, longer steps and the blind loss lost on some
    /// scene. Found with accelerated GAP-FFDNet (gray, σ 50, 25, 12, 6, five iterations each, lr 3e-6) on three
    /// validation clips that are in no benchmark: +0.07, +0.14, +0.05 dB with the gradient of all frames, +0.06, +0.13,
    /// +0.14 dB with that of every fourth, which is all that an update needs to know its direction.
    ///
    /// Where weights are carried over only the first measurement of a scene updates: with updates in each of them
    /// *traffic* lost 0.1, 0.6, 1.4 dB in measurements 2 to 4 while the loss fell, at the pixels held out too.
    fn default() -> Self {
        let schedule = Schedule {
            interval: 3,
            max_updates: Some(2),
            steps: 1,
            stride: 4,
            learning_rate: 3e-6,
            growth: 100.0,
            ..Schedule::PAPER_FFDNET
        };
        Self { schedule, guard: Guard::ON, precision: Precision::Bf16, ..Self::PAPER_FFDNET }
    }
}

/// Weights of the terms beside the error at the sensor, `mean (H T f(x) − y)²` with weight 1; 0 leaves a term out.
///
/// The measurement sees one combination of the frames; these terms speak about the rest.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Terms {
    /// `mean (f(v + σ n) − v)²`: the output v before the update, with new noise, is to come out again (Dewil et al.,
    /// *Self-supervised training for blind multi-frame video denoising*, 2021).
    pub pseudo_clean: f64,
    /// `‖w − w₀‖²`, `w₀` the pretrained weights.
    pub distance: f64,
    /// `mean (f(g x) − g v)²`, `g` a flip of rows, columns, both, or the order of frames, drawn for each step.
    pub equivariance: f64,
}

impl Terms {
    /// The plain loss.
    pub const NONE: Self = Self { pseudo_clean: 0.0, distance: 0.0, equivariance: 0.0 };
}

/// When an update is undone. An update whose loss or output is not finite always is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Guard {
    /// The share of the pixels of the measurement that the loss does not see. An update is kept only if the error falls
    /// both where the loss looks and where it does not. 0: every update is kept that is finite.
    pub held_out: f64,
    /// After a roll-back the learning rate is multiplied by this, until the next reset.
    pub back_off: f64,
    /// After so many roll-backs in a row the updates of this measurement that are still due are skipped.
    pub patience: usize,
}

impl Guard {
    /// The paper's: none.
    pub const OFF: Self = Self { held_out: 0.0, back_off: 1.0, patience: usize::MAX };
    /// One pixel in ten judges; half the learning rate after a roll-back, no more tries after two.
    pub const ON: Self = Self { held_out: 0.1, back_off: 0.5, patience: 2 };
}
