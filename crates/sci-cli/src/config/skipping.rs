//! Owns the rules of `[skip]`, and what it makes of an experiment.

use std::ops::RangeInclusive;

use admm::HoldOut;

use super::check::{Checker, Momentum, Solver, Start};
use super::denoising::Denoiser;
use super::file::{Section, SkipKeys};
use super::resolve::{self, Experiment, Stage};
use super::source::ConfigError;

/// `[skip]`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Skip {
    /// When stages end.
    pub hold_out: HoldOut,
    /// Whether the experiment says which σ are too large.
    pub overshoot_given: bool,
    /// Whether networks are spared tiles that stand still or have settled.
    pub tiles: bool,
    /// Whether networks work in bf16 where the solve would not notice.
    pub half_precision: bool,
    /// Whether TV goes first.
    pub cheap_first: bool,
}

/// σ of the stages that `sigma = "auto"` stands for, in 0..255 units. Which of them are run, and for how long, the held-out
/// pixels decide.
pub(super) const AUTO: [f64; 4] = [50.0, 25.0, 12.0, 6.0];

/// Legal `skip.overshoot`; at the end no σ is passed over.
const OVERSHOOT: RangeInclusive<f64> = 0.1..=1e3;

impl<'s> Checker<'s> {
    /// The settings of `[skip]`, if it is there and not switched off.
    pub(super) fn skip(&self, section: Option<Section<'s>>, seed: u64) -> Result<Option<Skip>, ConfigError> {
        let Some(section) = section else { return Ok(None) };
        let k: SkipKeys = section.read(&[])?;
        let enabled = self.flag("skip.enabled", &k.enabled)?.unwrap_or(true);
        let default = HoldOut::default();
        let number = |key: &str, value, range, default| Ok(self.number(key, value, range)?.unwrap_or(default));
        let whole =
            |key: &str, value, default: usize| Ok(self.whole(key, value, 2..=1024)?.map_or(default, |n| n as usize));
        let hold_out = HoldOut {
            spacing: whole("skip.spacing", &k.spacing, default.spacing)?,
            seed,
            gain: number("skip.gain", &k.gain, 0.0..=0.5, default.gain)?,
            patience: whole("skip.patience", &k.patience, default.patience)?,
            overshoot: number("skip.overshoot", &k.overshoot, OVERSHOOT, default.overshoot)?,
        };
        let skip = Skip {
            hold_out,
            overshoot_given: k.overshoot.is_some(),
            tiles: self.flag("skip.tiles", &k.tiles)?.unwrap_or(true),
            half_precision: self.flag("skip.half_precision", &k.half_precision)?.unwrap_or(true),
            cheap_first: self.flag("skip.cheap_first", &k.cheap_first)?.unwrap_or(true),
        };
        Ok(enabled.then_some(skip))
    }
}

impl Skip {
    /// Networks for iterates were trained for the σ of their schedule: passing some of them over cost 0.1 to 1 dB on the benchmark.
    /// Stops, tiles and the best iterate are theirs all the same, and so is an `overshoot` that the experiment asks for.
    pub(super) fn keep_trained_sigmas(&mut self, denoisers: &[Denoiser]) {
        if !self.overshoot_given && denoisers.iter().any(Denoiser::for_iterates) {
            self.hold_out.overshoot = *OVERSHOOT.end();
        }
    }
}

/// Lets TV go first where a network would: as a stage of its own from the mean, for as long as it pays, so that the network
/// begins where TV ends. A start by TV does that already, and so does a two-stage solver.
pub(super) fn cheap_first(e: &mut Experiment) {
    let networks_first = e.stages.first().is_some_and(|s| e.denoisers[s.denoiser].is_network());
    let starts_with_tv = matches!(e.start, Start::Tv { .. }) || matches!(e.solver, Solver::TwoStage { .. });
    if !e.skip.is_some_and(|s| s.cheap_first) || !networks_first || starts_with_tv {
        return;
    }
    if let Start::Adjoint = e.start {
        e.start = Start::Mean;
    }
    if let Solver::Gap { momentum: Some(momentum) } = &mut e.solver {
        *momentum = Momentum::Measurement;
    }
    e.stages.insert(0, Stage { sigma: None, iterations: 16, denoiser: e.denoisers.len() });
    e.denoisers.push(resolve::Denoiser::Tv { weight: 0.15, inner: 5 });
}
