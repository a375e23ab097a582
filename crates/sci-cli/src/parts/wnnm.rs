//! `kind = "wnnm"`: weighted nuclear norm minimisation.

use admm::{Denoiser, PerLattice, Prior, Wnnm, WnnmParams};

use super::{Built, Entry, Part, Saving, Sensor, Site, demosaicked};
use crate::bands::Footprint;
use crate::table::Table;

pub(super) const ENTRY: Entry = Entry { kind: "wnnm", read };

#[derive(Clone, Copy, Debug)]
struct LowRank {
    params: WnnmParams,
    /// Whether a color sensor's sub-lattices are gray videos.
    lattices: bool,
}

fn read(t: &mut Table<'_>) -> Box<dyn Part> {
    let default = WnnmParams::default();
    let params = WnnmParams {
        patch: t.whole("patch", default.patch, 2..=16),
        group: t.whole("group", default.group, 2..=256),
        step: t.whole("step", default.step, 1..=16),
        window: t.whole("window", default.window, 1..=64),
        frames: t.whole("frames", default.frames, 0..=64),
        weight: t.number("weight", default.weight.into(), 1e-6..=100.0) as f32,
        match_every: t.whole("match_every", default.match_every, 1..=1000),
    };
    Box::new(LowRank { params, lattices: t.flag("lattices", false) })
}

impl Part for LowRank {
    fn against_tiles(&self) -> Option<&'static str> {
        let kept = self.params.match_every > 1;
        kept.then_some("denoiser.match_every is more than 1, and groups of one tile are not those of another")
    }

    /// Sums and weights of all patches, and the groups of one frame.
    fn footprint(&self, _is_color: bool) -> Footprint {
        Footprint { of_frame_pixel: 16, of_pixel: 400, ..Footprint::default() }
    }

    fn build(&self, _site: &Site<'_>) -> anyhow::Result<Box<dyn Built>> {
        Ok(Box::new(*self))
    }
}

/// Made anew for each measurement, as it carries groups from call to call.
impl Built for LowRank {
    fn on_frames<'p>(&'p mut self, saving: &mut Saving) -> Box<dyn Denoiser + 'p> {
        saving.tiles(Wnnm::new(self.params))
    }

    fn on_sensor<'p>(&'p mut self, color: Option<&Sensor>, saving: &mut Saving) -> Box<dyn Prior + 'p> {
        match color {
            Some(_) if self.lattices => Box::new(PerLattice::new(Wnnm::new(self.params))),
            _ => demosaicked(saving.tiles(Wnnm::new(self.params)), color),
        }
    }
}
