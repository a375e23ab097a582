//! `[online]`: how networks adapt while they solve.

use nets::Parameters;
use online::{AdaptConfig, AdaptLoss, Reuse, RollBackRule, SequenceConfig, SplitConfig, UpdateSchedule};

use crate::parts::{Chosen, PRECISIONS};
use crate::table::{MAX_ITERATIONS, Table};

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
/// Whether it is measurement splitting.
const LOSSES: [(&str, bool); 2] = [("measurement", false), ("split", true)];
/// What only one of the losses has.
const OF_MEASUREMENT: [&str; 10] =
    ["preset", "first", "interval", "max_updates", "steps", "stride", "input_noise", "growth", "held_out", "back_off"];
const OF_SPLIT: [&str; 10] =
    ["updates", "crops", "side", "hidden", "calls", "average", "blend", "judging", "judged_crops", "every"];
const REUSE: [(&str, Reuse); 2] = [("reset", Reuse::Reset), ("carry-over", Reuse::CarryOver)];

impl Online {
    /// Nothing if it is switched off.
    pub(super) fn read(t: &mut Table<'_>, seed: u64, denoisers: &[Chosen]) -> Option<Self> {
        let enabled = t.flag("enabled", true);
        let split = t.choice("loss", &LOSSES, false);
        let otherwise = |d: &Chosen| d.part.network().is_some_and(|network| network.flips || network.dim != 1.0);
        if enabled && !split && denoisers.iter().any(otherwise) {
            t.complain(
                "[online] compares what a network gives with the measurement, so that it must see the video the right way \
                 round and as bright as it is; legal: denoiser.flips = false with denoiser.dim = 1, online.loss = \"split\", or \
                 online.enabled = false",
            );
        }
        let default = SequenceConfig::default();
        let sequence = SequenceConfig {
            reuse: t.choice("reuse", &REUSE, default.reuse),
            effort: t.number("effort", default.effort, 1e-3..=1.0),
            ..default
        };
        let adapt = if split { by_splitting(t, seed) } else { by_measurement(t, seed) };
        let save = t.flag("save", false);
        if !enabled {
            return None;
        }
        if let Err(e) = adapt.validate() {
            t.complain(format!("`online`: {e}"));
        }
        if !denoisers.iter().any(|d| d.part.network().is_some()) {
            t.complain("[online] has no effect: no stage has a network to adapt");
        }
        Some(Self { adapt, sequence, save })
    }
}

fn by_measurement(t: &mut Table<'_>, seed: u64) -> AdaptConfig {
    t.idle(&OF_SPLIT, "online.loss = \"split\"");
    let presets = [
        ("default", AdaptConfig::default()),
        ("paper-ffdnet", AdaptConfig::PAPER_FFDNET),
        ("paper-fastdvdnet", AdaptConfig::PAPER_FASTDVDNET),
    ];
    let preset = t.choice("preset", &presets, AdaptConfig::default());
    AdaptConfig {
        loss: AdaptLoss::Measurement,
        schedule: updates(t, preset.schedule),
        parameters: t.choice("parameters", &PARAMETERS, preset.parameters),
        precision: t.choice("precision", &PRECISIONS, preset.precision),
        roll_back: RollBackRule {
            held_out: t.number("held_out", preset.roll_back.held_out, 0.0..=0.9),
            back_off: t.number("back_off", preset.roll_back.back_off, 1e-3..=1.0),
            patience: t.whole("patience", preset.roll_back.patience, 0..=MAX_ITERATIONS),
        },
        seed,
    }
}

fn by_splitting(t: &mut Table<'_>, seed: u64) -> AdaptConfig {
    t.idle(&OF_MEASUREMENT, "online.loss = \"measurement\"");
    let default = SplitConfig::default();
    let split = SplitConfig {
        updates: t.whole("updates", default.updates, 0..=MAX_ITERATIONS),
        crops: t.whole("crops", default.crops, 1..=64),
        side: t.whole("side", default.side, 16..=1024),
        hidden: t.number("hidden", default.hidden, 1e-3..=0.9),
        calls: t.whole("calls", default.calls, 1..=MAX_ITERATIONS),
        learning_rate: t.number("learning_rate", default.learning_rate, 1e-12..=1.0),
        average: t.number("average", default.average, 0.0..=0.9999),
        blend: t.number("blend", default.blend, 1e-3..=1.0),
        judging: t.number("judging", default.judging, 1e-3..=0.5),
        judged_crops: t.whole("judged_crops", default.judged_crops, 1..=64),
        every: t.whole("every", default.every, 1..=MAX_ITERATIONS),
        patience: t.whole("patience", default.patience, 1..=MAX_ITERATIONS),
        parameters: t.choice("parameters", &PARAMETERS, default.parameters),
        precision: t.choice("precision", &PRECISIONS, default.precision),
        seed,
    };
    AdaptConfig { loss: AdaptLoss::Split(split), ..AdaptConfig::default() }
}

fn updates(t: &mut Table<'_>, preset: UpdateSchedule) -> UpdateSchedule {
    let max_updates = t.optional_whole("max_updates", 0..=MAX_ITERATIONS).or(preset.max_updates);
    t.show("max_updates", max_updates);
    UpdateSchedule {
        first: t.whole("first", preset.first, 0..=MAX_ITERATIONS),
        interval: t.whole("interval", preset.interval, 1..=MAX_ITERATIONS),
        max_updates,
        steps: t.whole("steps", preset.steps, 1..=1000),
        stride: t.whole("stride", preset.stride, 1..=1024),
        learning_rate: t.number("learning_rate", preset.learning_rate, 1e-12..=1.0),
        input_noise: t.sigma("input_noise", preset.input_noise),
        growth: t.number("growth", preset.growth, 1.0..=1e6),
    }
}
