//! `kind = "tv"`: total variation.

use admm::{Denoiser, Prior};
use serde_json::json;

use super::{Built, Chosen, Entry, Part, Saving, Sensor, Site};
use crate::table::Table;

pub(super) const ENTRY: Entry = Entry { kind: "tv", read };

#[derive(Clone, Copy, Debug)]
struct Tv {
    weight: f32,
    /// Dual steps a call.
    inner: usize,
}

fn read(t: &mut Table<'_>) -> Box<dyn Part> {
    Box::new(Tv { weight: t.number("weight", 0.3, 1e-6..=100.0) as f32, inner: t.whole("inner", 5, 1..=1000) })
}

/// The TV that `[skip]` lets go first where a network would.
pub fn first_of_all() -> Chosen {
    let (weight, inner) = (0.15, 5);
    Chosen {
        kind: ENTRY.kind,
        json: json!({ "kind": ENTRY.kind, "weight": weight, "inner": inner }),
        part: Box::new(Tv { weight, inner }),
    }
}

impl Part for Tv {
    fn instead_of_sigma(&self) -> Option<&'static str> {
        Some("tv, whose strength is denoiser.weight")
    }

    fn build(&self, _site: &Site<'_>) -> anyhow::Result<Box<dyn Built>> {
        Ok(Box::new(*self))
    }
}

/// Made anew for each measurement, as it carries state from call to call.
impl Built for Tv {
    fn on_frames<'p>(&'p mut self, _saving: &mut Saving) -> Box<dyn Denoiser + 'p> {
        Box::new(admm::Tv::new(self.weight).inner(self.inner))
    }

    fn on_sensor<'p>(&'p mut self, color: Option<&Sensor>, _saving: &mut Saving) -> Box<dyn Prior + 'p> {
        admm::Tv::new(self.weight).inner(self.inner).on_sensor(color.map(|sensor| sensor.cfa))
    }
}
