//! `kind = "shiftnet"`.

use anyhow::Context;

use super::{Built, Entry, Inference, Part, Site};
use crate::bands::Footprint;
use crate::table::Table;

pub(super) const ENTRY: Entry = Entry { kind: "shiftnet", read };

#[derive(Debug)]
struct Shiftnet(Inference);

fn read(t: &mut Table<'_>) -> Box<dyn Part> {
    Box::new(Shiftnet(Inference::read(t)))
}

impl Part for Shiftnet {
    fn network(&self) -> Option<&Inference> {
        Some(&self.0)
    }

    fn adapts(&self) -> bool {
        true
    }

    fn footprint(&self, is_color: bool) -> Footprint {
        // Large bands take a quarter more than small ones, in pieces that the allocator cannot use again.
        let (of_frame_pixel, of_pixel) = if is_color { (104, 400) } else { (60, 320) };
        Footprint { of_frame_pixel, of_pixel, ..Footprint::default() }
    }

    fn learning(&self) -> Footprint {
        Footprint { of_frame_pixel: 1850, fixed: 25 << 20, ..Footprint::default() }
    }

    fn build(&self, site: &Site<'_>) -> anyhow::Result<Box<dyn Built>> {
        let net = nets::Shiftnet::load(&self.0.weights).context("denoiser.weights")?;
        self.0.build(net, site)
    }
}
