//! Owns the denoisers of an experiment: a file for each, with its keys and what is built of it, and the one list of them.

mod demosaicer;
mod fastdvdnet;
mod ffdnet;
mod network;
mod saving;
mod shiftnet;
mod tv;
mod wavelet;
mod wnnm;

use std::fmt::Debug;
use std::ops::ControlFlow;
use std::path::Path;

use admm::{Demosaicked, Denoiser, Prior};
use nets::Network;
use nets::unrolled::Recipe;
use online::{AdaptConfig, SplitRecord, Successor, Task, Update};
use sci_forward::{CfaPattern, Measurement};
use serde_json::Value;

use crate::bands::Footprint;
use crate::table::{ConfigError, Table};

pub use demosaicer::{Demosaicer, Sensor};
pub use network::{Inference, PRECISIONS};
pub use saving::{MultiplyAdds, Saving, Work};
pub use tv::first_of_all;

/// Every denoiser.
const DENOISERS: &[Entry] =
    &[tv::ENTRY, wavelet::ENTRY, wnnm::ENTRY, ffdnet::ENTRY, fastdvdnet::ENTRY, shiftnet::ENTRY];

/// A line of [`DENOISERS`].
struct Entry {
    /// The `kind` that names it.
    kind: &'static str,
    /// Asks a table for its keys.
    read: fn(&mut Table<'_>) -> Box<dyn Part>,
}

/// A denoiser of an experiment.
#[derive(Debug)]
pub struct Chosen {
    /// The `kind` that names it.
    pub kind: &'static str,
    /// Its keys for the record.
    pub json: Value,
    /// What it is.
    pub part: Box<dyn Part>,
}

/// Reads a `[denoiser]`, or that of a stage.
///
/// # Errors
/// The first mistake.
pub fn read(table: Table<'_>) -> Result<Chosen, ConfigError> {
    let ((kind, part), json) = table.read(|t| {
        let entry = t.entry(DENOISERS, |entry| entry.kind)?;
        Ok((entry.kind, (entry.read)(t)))
    })?;
    Ok(Chosen { kind, json, part })
}

/// What a denoiser says of itself, and how it is built.
pub trait Part: Debug + Send + Sync {
    /// What it has in place of a σ, said after "its denoiser is"; nothing if its stages must give one.
    fn instead_of_sigma(&self) -> Option<&'static str> {
        None
    }

    /// How its network is run, if it is one.
    fn network(&self) -> Option<&Inference> {
        None
    }

    /// Whether it can learn while it solves.
    fn adapts(&self) -> bool {
        false
    }

    /// Why it must be given the video as a whole (`[skip]`), if it must.
    fn against_tiles(&self) -> Option<&'static str> {
        None
    }

    /// What it takes while it works, beside its input and output.
    fn footprint(&self, _is_color: bool) -> Footprint {
        Footprint::default()
    }

    /// What it takes on top while it learns from a crop of a scene, whose pixels and frames these are; measured.
    fn learning(&self) -> Footprint {
        Footprint::default()
    }

    /// What all measurements share of it, such as a loaded network.
    ///
    /// # Errors
    /// When a file cannot be read, or is not for such a sensor.
    fn build(&self, site: &Site<'_>) -> anyhow::Result<Box<dyn Built>>;
}

/// Where a part is to work.
#[derive(Clone, Copy, Debug)]
pub struct Site<'f> {
    /// The pattern of a color sensor, `None` for a gray one.
    pub cfa: Option<CfaPattern>,
    /// How networks learn.
    pub adapt: AdaptConfig,
    /// What counts their work.
    pub work: &'f MultiplyAdds,
}

impl Site<'_> {
    /// Checks that weights are for the sensor's colors.
    ///
    /// # Errors
    /// If they are for others.
    pub fn fits(&self, channels: usize, weights: &Path) -> anyhow::Result<()> {
        let (scene, needed) = if self.cfa.is_some() { ("color", 3) } else { ("gray", 1) };
        let how = match channels {
            3 => "; name its Bayer pattern in data.cfa if it is a mosaic",
            _ => "; the experiments for color are color/fast, color/default, real/color and their like",
        };
        anyhow::ensure!(
            channels == needed,
            "denoiser.weights: {}: a network for {channels} channels, but the scene is {scene}: it needs one for {needed}{how}",
            weights.display()
        );
        Ok(())
    }
}

/// A part as far as it can be shared by all measurements.
pub trait Built: Send {
    /// On gray or RGB video as it is.
    fn on_frames<'p>(&'p mut self, saving: &mut Saving) -> Box<dyn Denoiser + 'p>;

    /// On what the sensor sees.
    fn on_sensor<'p>(&'p mut self, color: Option<&Sensor>, saving: &mut Saving) -> Box<dyn Prior + 'p>;

    /// As a network, if it is one that denoises.
    fn network(&self) -> Option<&dyn Network> {
        None
    }

    /// As what learns, if it does.
    fn learning(&mut self) -> Option<&mut dyn Learning> {
        None
    }
}

/// A denoiser of frames as a prior on what the sensor sees.
fn demosaicked<'p>(denoiser: Box<dyn Denoiser + 'p>, color: Option<&Sensor>) -> Box<dyn Prior + 'p> {
    match color {
        Some(sensor) => Box::new(Demosaicked::new(denoiser, sensor.demosaicer.clone(), sensor.cfa)),
        None => Box::new(denoiser),
    }
}

/// A network that learns while it solves, or could.
pub trait Learning {
    /// Turns to a measurement.
    ///
    /// # Errors
    /// As [`Task::prepare`].
    fn prepare(&mut self, task: &Task) -> online::Result<()>;

    /// Learns before a solve by `recipe` and `successor`, where it is to; `watch` is told of each update and says whether to go on.
    ///
    /// # Errors
    /// As [`online::adapt_by_splitting`].
    fn adapt_by_splitting(
        &mut self,
        measurements: &[Measurement],
        recipe: &Recipe,
        successor: Option<Successor<'_>>,
        watch: &mut dyn FnMut(usize) -> ControlFlow<()>,
    ) -> online::Result<Option<SplitRecord>>;

    /// Writes its weights as they are now.
    ///
    /// # Errors
    /// When the file cannot be written.
    fn save(&mut self, path: &Path) -> online::Result<()>;

    /// Takes weights that were saved.
    ///
    /// # Errors
    /// When the file cannot be read.
    fn load(&mut self, path: &Path) -> online::Result<()>;

    /// Counts updates that were made before the program was stopped.
    fn take_up(&mut self, updates: &[Update]);

    /// Every update so far.
    fn updates(&self) -> &[Update];
}
