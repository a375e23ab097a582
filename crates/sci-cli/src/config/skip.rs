//! `[skip]`: what is left out of a solve because it would not be missed.

use std::ops::RangeInclusive;

use admm::HoldOut;

use crate::parts::Chosen;
use crate::table::Table;

/// `[skip]`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Skip {
    /// When stages end.
    pub hold_out: HoldOut,
    /// Whether the experiment says which σ are too large.
    overshoot_given: bool,
    /// Whether networks are spared tiles that stand still or have settled.
    pub tiles: bool,
    /// Whether networks work in bf16 where the solve would not notice.
    pub half_precision: bool,
    /// Whether TV goes first.
    pub cheap_first: bool,
}

/// Legal `skip.overshoot`; at the end no σ is passed over.
const OVERSHOOT: RangeInclusive<f64> = 0.1..=1e3;

impl Skip {
    /// Nothing if it is switched off.
    pub(super) fn read(t: &mut Table<'_>, seed: u64) -> Option<Self> {
        let enabled = t.flag("enabled", true);
        let default = HoldOut::default();
        let overshoot_given = t.holds("overshoot");
        let hold_out = HoldOut {
            spacing: t.whole("spacing", default.spacing, 2..=1024),
            seed,
            gain: t.number("gain", default.gain, 0.0..=0.5),
            patience: t.whole("patience", default.patience, 2..=1024),
            overshoot: t.number("overshoot", default.overshoot, OVERSHOOT),
            decides: true,
        };
        let skip = Self {
            hold_out,
            overshoot_given,
            tiles: t.flag("tiles", true),
            half_precision: t.flag("half_precision", true),
            cheap_first: t.flag("cheap_first", true),
        };
        enabled.then_some(skip)
    }

    /// Networks for iterates were trained for the σ of their schedule: passing some of them over cost 0.1 to 1 dB on the benchmark.
    /// Stops, tiles and the best iterate are theirs all the same, and so is an `overshoot` that the experiment asks for.
    pub(super) fn keep_trained_sigmas(&mut self, denoisers: &[Chosen]) {
        let for_iterates = |d: &Chosen| d.part.network().is_some_and(|network| network.for_iterates());
        if !self.overshoot_given && denoisers.iter().any(for_iterates) {
            self.hold_out.overshoot = *OVERSHOOT.end();
        }
    }
}
