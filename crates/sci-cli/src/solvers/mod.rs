//! Owns the solvers of an experiment: a file for each, with its keys and what is built of it, and the one list of them.

mod admm;
mod gap;
mod start;
mod two_stage;

use std::fmt::Debug;

use ::admm::{Denoiser, PerStage, Prior};
use serde_json::Value;

use crate::parts::{Built, Demosaicer, Saving, Sensor};
use crate::table::{ConfigError, Table};

pub use start::Start;

/// Every solver.
const SOLVERS: &[Entry] = &[gap::ENTRY, admm::ENTRY, two_stage::ENTRY];

/// A line of [`SOLVERS`].
struct Entry {
    /// The `kind` that names it.
    kind: &'static str,
    /// Asks a table for its keys.
    read: fn(&mut Table<'_>) -> Keys,
}

/// What a solver's keys say.
struct Keys {
    method: Box<dyn Method>,
    start: Start,
    demosaicer: Option<Demosaicer>,
}

/// `[solver]`.
#[derive(Debug)]
pub struct Solver {
    /// The `kind` that names it.
    pub kind: &'static str,
    /// Its keys for the record.
    pub json: Value,
    /// What it is.
    pub method: Box<dyn Method>,
    /// Where solves start.
    pub start: Start,
    /// What demosaics color scenes, if the experiment says so.
    pub demosaicer: Option<Demosaicer>,
}

/// Reads `[solver]`.
///
/// # Errors
/// The first mistake.
pub fn read(table: Table<'_>) -> Result<Solver, ConfigError> {
    let ((kind, keys), json) = table.read(|t| {
        let entry = t.entry(SOLVERS, |entry| entry.kind)?;
        Ok((entry.kind, (entry.read)(t)))
    })?;
    let Keys { method, start, demosaicer } = keys;
    Ok(Solver { kind, json, method, start, demosaicer })
}

impl Solver {
    /// What demosaics color scenes.
    pub fn demosaicer(&self) -> Demosaicer {
        self.demosaicer.clone().unwrap_or_else(|| self.method.default_demosaicer())
    }

    /// Lets a stage of TV go first where a network would; whether it may. A start by TV does that already.
    pub fn begin_with_tv(&mut self) -> bool {
        if matches!(self.start, Start::Tv { .. }) || !self.method.begin_with_tv(&mut self.json) {
            return false;
        }
        if self.start == Start::Adjoint {
            (self.start, self.json["start"]) = (Start::Mean, "mean".into());
        }
        true
    }

    /// What to try when a solve has diverged; `backed_off` if it had gone on once already.
    pub fn advice(&self, backed_off: bool) -> &'static str {
        match self.start {
            Start::Adjoint if !backed_off => "start from solver.start = \"mean\" (the adjoint is not normalised)",
            _ => self.method.advice(backed_off),
        }
    }
}

/// What a solver says of itself, and how it is built.
pub trait Method: Debug + Send + Sync {
    /// Whether it is for color sensors only.
    fn color_only(&self) -> bool {
        false
    }

    /// Whether it is accelerated, if it is one that networks can learn through.
    fn unrolled(&self) -> Option<bool> {
        None
    }

    /// That of the reference code.
    fn default_demosaicer(&self) -> Demosaicer {
        Demosaicer::Menon
    }

    /// Gets ready for a first stage of TV, and changes what the record shows of it; false if there can be none.
    fn begin_with_tv(&mut self, _json: &mut Value) -> bool {
        true
    }

    /// What to try when a solve has diverged; `backed_off` if it had gone on once already.
    fn advice(&self, backed_off: bool) -> &'static str;

    /// The solver of a measurement.
    ///
    /// # Errors
    /// For a sensor, or of denoisers, that it is not for.
    fn build<'p>(&self, priors: Priors<'p, '_>) -> anyhow::Result<Box<dyn ::admm::Solver + 'p>>;
}

/// The denoisers of a schedule, to be made what a solver plugs in.
pub struct Priors<'p, 's> {
    /// Every denoiser.
    pub built: &'p mut [Box<dyn Built>],
    /// Which of them is that of each stage.
    pub of_stage: Vec<usize>,
    /// The sensor, if it sees colors.
    pub color: Option<&'s Sensor>,
    /// What networks are spared.
    pub saving: &'s mut Saving,
    /// Whether stages are ended early.
    pub skips: bool,
}

impl<'p> Priors<'p, '_> {
    /// On what the sensor sees.
    fn on_sensor(self) -> PerStage<dyn Prior + 'p> {
        let Self { built, of_stage, color, saving, .. } = self;
        PerStage::<dyn Prior + 'p>::new(built.iter_mut().map(|part| part.on_sensor(color, saving)).collect(), of_stage)
    }

    /// On RGB video as it is.
    fn on_frames(self) -> PerStage<dyn Denoiser + 'p> {
        let Self { built, of_stage, saving, .. } = self;
        let denoisers = built.iter_mut().map(|part| part.on_frames(saving)).collect();
        PerStage::<dyn Denoiser + 'p>::new(denoisers, of_stage)
    }
}
