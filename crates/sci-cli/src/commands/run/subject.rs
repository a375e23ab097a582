//! What a run solves: a scene in memory, or one that is too large for it.

use std::path::Path;

use anyhow::Context;
use sci_forward::{CfaPattern, VideoShape};

use super::super::UsageError;
use super::banded::Cut;
use super::{read_scene, say};
use crate::bands::Bands;
use crate::config::Experiment;
use crate::io::scene::{Banded, Scene, SceneError};
use crate::solve;

/// What a run solves.
#[derive(Debug)]
pub(super) enum Subject {
    /// A scene in memory.
    Whole(Box<Scene>),
    /// A scene on disk, and its bands.
    Cut(Box<Cut>),
}

impl Subject {
    /// The scene of an experiment, whose oddities are told, and the measurements of it that are wanted; `out` is where the results will be.
    ///
    /// # Errors
    /// Those of reading it; and if it has to be solved in bands for `memory` but cannot be.
    pub(super) fn open(experiment: &Experiment, out: &Path) -> anyhow::Result<(Self, Vec<usize>)> {
        let subject = match Self::cut(experiment, out)? {
            Some(cut) => Self::Cut(Box::new(cut)),
            None => Self::Whole(Box::new(Self::whole(experiment)?)),
        };
        let count = match &subject {
            Self::Whole(scene) => scene.len(),
            Self::Cut(cut) => cut.scene.len(),
        };
        subject.warnings().iter().for_each(|note| say(experiment, note));
        let chosen = solve::choose(experiment, count).map_err(UsageError)?;
        Ok((subject, chosen))
    }

    /// A scene that fits into memory, or has to.
    fn whole(experiment: &Experiment) -> anyhow::Result<Scene> {
        let scene = read_scene(experiment).context("data.path")?;
        let (shape, footprint) = (scene.operator.shape(), experiment.footprint(scene.cfa.is_some()));
        if let Some(memory) = experiment.memory.filter(|&memory| footprint.bytes(shape) > memory) {
            let why = experiment.needs_whole().map_or_else(
                || "this cannot be read in bands; .npz, .npy, .h5 and .mat of version 7.3 can, but not masks in .mat with data in another or the reverse".to_owned(),
                |(key, why)| format!("`{key}` does not go with bands: {why}"),
            );
            let (memory, needed) = (megabytes(memory), megabytes(footprint.bytes(shape)));
            anyhow::bail!(UsageError(format!("`memory` is {memory} MB, but {shape} takes {needed} MB, and {why}")));
        }
        Ok(scene)
    }

    /// The bands of a scene that does not fit into memory, if it can be read in bands.
    fn cut(experiment: &Experiment, out: &Path) -> anyhow::Result<Option<Cut>> {
        let (path, reading) = (&experiment.data.path, &experiment.data.reading);
        let Some(memory) = experiment.memory.filter(|_| experiment.needs_whole().is_none()) else { return Ok(None) };
        let Some(mut scene) = Banded::open(path, reading).context("data.path")? else { return Ok(None) };
        let shape = scene.shape();
        let bands = Bands::new(shape, experiment.footprint(scene.cfa.is_some()), memory).map_err(|needed| {
            let (memory, needed) = (megabytes(memory), megabytes(needed));
            UsageError(format!(
                "`memory` is {memory} MB, but the lowest band of {shape} takes {needed} MB; legal: that or more"
            ))
        })?;
        if bands.is_whole() {
            return Ok(None);
        }
        // Where the results will be there is room for what they are made of.
        let beside = out.ancestors().find(|folder| folder.is_dir()).unwrap_or(Path::new("."));
        scene.unpack(beside).context("data.path")?;
        scene.decide(bands.solved(bands.middle()).len()).context("data.path")?;
        Ok(Some(Cut { scene, bands, memory }))
    }

    /// What looks odd about it.
    pub(super) fn warnings(&self) -> &[String] {
        match self {
            Self::Whole(scene) => &scene.warnings,
            Self::Cut(cut) => &cut.scene.warnings,
        }
    }

    /// The pattern of a color sensor.
    pub(super) fn cfa(&self) -> Option<CfaPattern> {
        match self {
            Self::Whole(scene) => scene.cfa,
            Self::Cut(cut) => cut.scene.cfa,
        }
    }

    /// The size of the sensor's video.
    pub(super) fn shape(&self) -> VideoShape {
        match self {
            Self::Whole(scene) => scene.operator.shape(),
            Self::Cut(cut) => cut.scene.shape(),
        }
    }

    /// How it is cut, for a message.
    pub(super) fn in_bands(&self) -> String {
        match self {
            Self::Whole(_) => String::new(),
            Self::Cut(cut) => format!(", in {} bands of rows", cut.bands.count()),
        }
    }

    /// `[T, C, H, W]` of the result of a measurement.
    pub(super) fn result_shape(&self) -> [usize; 4] {
        let VideoShape { frames, height, width } = self.shape();
        [frames, if self.cfa().is_some() { 3 } else { 1 }, height, width]
    }

    /// What white is in units of the file's scale.
    pub(super) fn unit(&self) -> f32 {
        match self {
            Self::Whole(scene) => scene.unit,
            Self::Cut(cut) => cut.scene.unit,
        }
    }

    /// A checksum of the data: of all measurements, or of what those `chosen` of a scene that is read in bands are made of.
    ///
    /// # Errors
    /// If they cannot be read.
    pub(super) fn checksum(&self, chosen: &[usize]) -> Result<u32, SceneError> {
        match self {
            Self::Whole(scene) => {
                let mut sum = crc32fast::Hasher::new();
                scene.measurements.iter().for_each(|y| sum.update(&y.to_le_bytes()));
                Ok(sum.finalize())
            }
            Self::Cut(cut) => cut.scene.checksum(chosen),
        }
    }
}

fn megabytes(bytes: usize) -> usize {
    bytes.div_ceil(1_000_000)
}
