//! `kind = "fastdvdnet"`.

use anyhow::Context;
use nets::Ends;

use super::{Built, Entry, Inference, Part, Site};
use crate::bands::Footprint;
use crate::table::Table;

pub(super) const ENTRY: Entry = Entry { kind: "fastdvdnet", read };

#[derive(Debug)]
struct Fastdvdnet {
    inference: Inference,
    /// What stands for the frames before the first and after the last.
    ends: Ends,
}

fn read(t: &mut Table<'_>) -> Box<dyn Part> {
    let ends = [("circular", Ends::Circular), ("mirrored", Ends::Mirrored)];
    let ends = t.choice("ends", &ends, Ends::default());
    Box::new(Fastdvdnet { inference: Inference::read(t), ends })
}

impl Part for Fastdvdnet {
    fn network(&self) -> Option<&Inference> {
        Some(&self.inference)
    }

    fn adapts(&self) -> bool {
        true
    }

    fn footprint(&self, is_color: bool) -> Footprint {
        let (of_frame_pixel, of_pixel) = if is_color { (32, 1250) } else { (8, 1250) };
        Footprint { of_frame_pixel, of_pixel, ..Footprint::default() }
    }

    fn learning(&self) -> Footprint {
        Footprint { of_frame_pixel: 3850, of_pixel: 6700, fixed: 100 << 20, ..Footprint::default() }
    }

    fn build(&self, site: &Site<'_>) -> anyhow::Result<Box<dyn Built>> {
        let net = nets::Fastdvdnet::load(&self.inference.weights, self.ends).context("denoiser.weights")?;
        self.inference.build(net, site)
    }
}
