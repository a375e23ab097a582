//! `kind = "ffdnet"`.

use anyhow::Context;

use super::{Built, Entry, Inference, Part, Site};
use crate::bands::Footprint;
use crate::table::Table;

pub(super) const ENTRY: Entry = Entry { kind: "ffdnet", read };

#[derive(Debug)]
struct Ffdnet(Inference);

fn read(t: &mut Table<'_>) -> Box<dyn Part> {
    Box::new(Ffdnet(Inference::read(t)))
}

impl Part for Ffdnet {
    fn network(&self) -> Option<&Inference> {
        Some(&self.0)
    }

    fn adapts(&self) -> bool {
        true
    }

    fn footprint(&self, is_color: bool) -> Footprint {
        let (of_frame_pixel, of_pixel) = if is_color { (8, 280) } else { (0, 200) };
        Footprint { of_frame_pixel, of_pixel, ..Footprint::default() }
    }

    fn learning(&self) -> Footprint {
        Footprint { of_frame_pixel: 1100, fixed: 45 << 20, ..Footprint::default() }
    }

    fn build(&self, site: &Site<'_>) -> anyhow::Result<Box<dyn Built>> {
        let net = nets::Ffdnet::load(&self.0.weights).context("denoiser.weights")?;
        self.0.build(net, site)
    }
}
