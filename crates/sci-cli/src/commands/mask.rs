//! `sci mask`: masks to a file.

use std::path::PathBuf;

use clap::ValueEnum;
use ndarray::Axis;
use sci_forward::{MaskStack, VideoShape};

use super::{Done, array_format, parse_density, parse_size};
use crate::config::camera::optics_of_arguments;
use crate::io::output::{Part, write_arrays};

/// Arguments of `sci mask`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// Where to write: .npy, .npz or .mat (variable `mask`)
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// How the pixels open
    #[arg(long, value_enum, default_value = "random")]
    kind: Kind,
    /// Masks, the frames a measurement sums
    #[arg(long, default_value = "8", value_name = "B", value_parser = clap::value_parser!(u16).range(1..=1024))]
    frames: u16,
    /// Picture size, HEIGHTxWIDTH
    #[arg(long, default_value = "256x256", value_parser = parse_size)]
    size: (usize, usize),
    /// Share of open pixels, 0.001 to 1
    #[arg(long, default_value = "0.5", value_parser = parse_density)]
    density: f64,
    /// Of a differential camera: pixels that are not open are -1 instead of 0
    #[arg(long)]
    signed: bool,
    /// Seed
    #[arg(long, default_value = "0")]
    seed: u64,
    /// As a camera's optics show them: shift=[DOWN,RIGHT] (pixels), rotation (degrees), scale, blur (pixels), clock (share of the frame
    /// before), contrast, flicker (of the frames' gains)
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// The published ways to make masks.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(super) enum Kind {
    /// Every pixel of every mask on its own
    Random,
    /// One random pattern that moves by a pixel a frame
    Shifting,
}

impl Kind {
    pub(super) fn masks(self, shape: VideoShape, density: f64, signed: bool, seed: u64) -> anyhow::Result<MaskStack> {
        let masks = match self {
            Self::Random => MaskStack::random(shape, density, seed)?,
            Self::Shifting => MaskStack::shifting(shape, density, seed)?,
        };
        Ok(if signed { masks.differential()? } else { masks })
    }
}

impl Args {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        let format = array_format(&self.out)?;
        let shape = VideoShape { frames: self.frames.into(), height: self.size.0, width: self.size.1 };
        let optics = optics_of_arguments(&self.set)?;
        let masks = optics.masks(&self.kind.masks(shape, self.density, self.signed, self.seed)?, self.seed)?;
        let data = masks.view().insert_axis(Axis(1));
        write_arrays(&self.out, format, &[Part { name: "mask", data, is_light: false }])?;
        let open = masks.view().iter().filter(|&&c| c > 0.0).count() as f64 / masks.view().len() as f64;
        outln!("{}: {shape}, {:.1} % open", self.out.display(), 100.0 * open);
        Ok(Done::Complete)
    }
}
