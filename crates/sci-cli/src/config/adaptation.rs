//! Owns the rules of `[online]`.

use nets::Parameters;
use online::{AdaptConfig, Reuse, RollBackRule, SequenceConfig, UpdateSchedule};

use super::check::{Checker, MAX_ITERATIONS};
use super::denoising::Denoiser;
use super::file::{OnlineKeys, Section, Value};
use super::source::ConfigError;

/// `[online]`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Online {
    /// How networks adapt.
    pub adapt: AdaptConfig,
    /// What the next measurement takes over.
    pub sequence: SequenceConfig,
    /// Whether the adapted weights are written.
    pub save: bool,
}

const PARAMETERS: [(&str, Parameters); 5] = [
    ("all", Parameters::All),
    ("biases", Parameters::Biases),
    ("first-last", Parameters::FirstLast),
    ("last", Parameters::Last),
    ("norm-affine", Parameters::NormAffine),
];

impl<'s> Checker<'s> {
    /// The settings of `[online]`, if the table is there and not switched off.
    pub(super) fn online(
        &self,
        section: Option<Section<'s>>,
        seed: u64,
        denoisers: &[Denoiser],
    ) -> Result<Option<Online>, ConfigError> {
        let Some(section) = section else { return Ok(None) };
        let table = section.span.clone();
        let k: OnlineKeys = section.read(&[])?;
        let enabled = self.flag("online.enabled", &k.enabled)?.unwrap_or(true);
        if enabled && denoisers.iter().any(Denoiser::flips) {
            let message = "[online] compares what a network gives with the measurement, so that it must see the video the right way \
                           round; legal: denoiser.flips = false, or online.enabled = false";
            return Err(self.source.error(&table, message));
        }
        let presets = [
            ("default", AdaptConfig::default()),
            ("paper-ffdnet", AdaptConfig::PAPER_FFDNET),
            ("paper-fastdvdnet", AdaptConfig::PAPER_FASTDVDNET),
        ];
        let preset = self.choice("online.preset", &k.preset, &presets)?.unwrap_or_default();
        let adapt = AdaptConfig {
            schedule: self.updates(&k, preset.schedule)?,
            parameters: self.choice("online.parameters", &k.parameters, &PARAMETERS)?.unwrap_or(preset.parameters),
            roll_back: self.roll_back(&k, preset.roll_back)?,
            precision: self.precision("online.precision", &k.precision)?.unwrap_or(preset.precision),
            seed,
        };
        let default = SequenceConfig::default();
        let reuse = [("reset", Reuse::Reset), ("carry-over", Reuse::CarryOver)];
        let sequence = SequenceConfig {
            reuse: self.choice("online.reuse", &k.reuse, &reuse)?.unwrap_or(default.reuse),
            effort: self.number("online.effort", &k.effort, 1e-3..=1.0)?.unwrap_or(default.effort),
            ..default
        };
        let save = self.flag("online.save", &k.save)?.unwrap_or(false);
        if !enabled {
            return Ok(None);
        }
        adapt.validate().map_err(|e| self.source.error(&table, format!("`online`: {e}")))?;
        if denoisers.iter().all(|d| d.weights().is_none()) {
            return Err(self.source.error(&table, "[online] has no effect: no stage has a network to adapt"));
        }
        Ok(Some(Online { adapt, sequence, save }))
    }

    fn updates(&self, k: &OnlineKeys, preset: UpdateSchedule) -> Result<UpdateSchedule, ConfigError> {
        let whole = |key: &str, value: &Value, range| self.whole(&format!("online.{key}"), value, range);
        let max_updates = whole("max_updates", &k.max_updates, 0..=MAX_ITERATIONS)?;
        Ok(UpdateSchedule {
            first: whole("first", &k.first, 0..=MAX_ITERATIONS)?.map_or(preset.first, |n| n as usize),
            interval: whole("interval", &k.interval, 1..=MAX_ITERATIONS)?.map_or(preset.interval, |n| n as usize),
            max_updates: max_updates.map_or(preset.max_updates, |n| Some(n as usize)),
            steps: whole("steps", &k.steps, 1..=1000)?.map_or(preset.steps, |n| n as usize),
            stride: whole("stride", &k.stride, 1..=1024)?.map_or(preset.stride, |n| n as usize),
            learning_rate: self
                .number("online.learning_rate", &k.learning_rate, 1e-12..=1.0)?
                .unwrap_or(preset.learning_rate),
            input_noise: self
                .number("online.input_noise", &k.input_noise, 0.0..=255.0)?
                .map_or(preset.input_noise, |n| n as f32 / 255.0),
            growth: self.number("online.growth", &k.growth, 1.0..=1e6)?.unwrap_or(preset.growth),
        })
    }

    fn roll_back(&self, k: &OnlineKeys, preset: RollBackRule) -> Result<RollBackRule, ConfigError> {
        Ok(RollBackRule {
            held_out: self.number("online.held_out", &k.held_out, 0.0..=0.9)?.unwrap_or(preset.held_out),
            back_off: self.number("online.back_off", &k.back_off, 1e-3..=1.0)?.unwrap_or(preset.back_off),
            patience: self
                .whole("online.patience", &k.patience, 0..=MAX_ITERATIONS)?
                .map_or(preset.patience, |n| n as usize),
        })
    }
}
