//! `kind = "wavelet"`: soft thresholds on wavelet coefficients.

use admm::{Denoiser, PerLattice, Prior, Wavelet};

use super::{Built, Entry, Part, Saving, Sensor, Site};
use crate::bands::Footprint;
use crate::table::Table;

pub(super) const ENTRY: Entry = Entry { kind: "wavelet", read };

#[derive(Clone, Copy, Debug)]
struct Threshold(Wavelet);

fn read(t: &mut Table<'_>) -> Box<dyn Part> {
    let default = Wavelet::default();
    Box::new(Threshold(Wavelet {
        threshold: t.number("threshold", default.threshold.into(), 0.0..=100.0) as f32,
        levels: t.whole("levels", default.levels as usize, 1..=8) as u32,
    }))
}

impl Part for Threshold {
    fn footprint(&self, _is_color: bool) -> Footprint {
        Footprint { of_pixel: 180, ..Footprint::default() }
    }

    fn build(&self, _site: &Site<'_>) -> anyhow::Result<Box<dyn Built>> {
        Ok(Box::new(*self))
    }
}

impl Built for Threshold {
    fn on_frames<'p>(&'p mut self, saving: &mut Saving) -> Box<dyn Denoiser + 'p> {
        saving.tiles(self.0)
    }

    /// As TV: a color sensor's sub-lattices are gray videos, which leaves nothing to a demosaicer's mistakes.
    fn on_sensor<'p>(&'p mut self, color: Option<&Sensor>, saving: &mut Saving) -> Box<dyn Prior + 'p> {
        match color {
            Some(_) => Box::new(PerLattice::new(self.0)),
            None => Box::new(saving.tiles(self.0)),
        }
    }
}
