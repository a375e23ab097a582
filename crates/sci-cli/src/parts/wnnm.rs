//! `kind = "wnnm"`: weighted nuclear norm minimisation.

use admm::{Denoiser, Prior, Wnnm};

use super::{Built, Entry, Part, Saving, Sensor, Site, demosaicked};
use crate::table::Table;

pub(super) const ENTRY: Entry = Entry { kind: "wnnm", read };

#[derive(Debug)]
struct LowRank(Wnnm);

fn read(t: &mut Table<'_>) -> Box<dyn Part> {
    let default = Wnnm::default();
    Box::new(LowRank(Wnnm {
        patch: t.whole("patch", default.patch, 2..=16),
        group: t.whole("group", default.group, 2..=256),
        step: t.whole("step", default.step, 1..=16),
        window: t.whole("window", default.window, 1..=64),
        frames: t.whole("frames", default.frames, 0..=64),
    }))
}

impl Part for LowRank {
    fn build(&self, _site: &Site<'_>) -> anyhow::Result<Box<dyn Built>> {
        Ok(Box::new(Self(self.0)))
    }
}

impl Built for LowRank {
    fn on_frames<'p>(&'p mut self, saving: &mut Saving) -> Option<Box<dyn Denoiser + 'p>> {
        Some(saving.tiles(self.0))
    }

    fn on_sensor<'p>(&'p mut self, color: Option<&Sensor>, saving: &mut Saving) -> Box<dyn Prior + 'p> {
        demosaicked(saving.tiles(self.0), color)
    }
}
