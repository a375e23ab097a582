//! Ends a run of which no more is going to be solved here.

use std::path::Path;
use std::time::Instant;

use super::super::{Done, interrupted, results};
use crate::calibration::Calibration;
use crate::config::Experiment;
use crate::factory::Factory;
use crate::record::Record;
use crate::run_folder::{Layout, RunFolder};
use crate::shard::Shard;
use crate::solve;

/// What a run is at its end, but for what it has solved.
pub(super) struct Ending<'r> {
    pub(super) experiment: &'r Experiment,
    pub(super) factory: &'r Factory<'r>,
    pub(super) layout: &'r Layout,
    pub(super) out: &'r Path,
    /// When the command began.
    pub(super) begin: Instant,
    /// How the masks were found to sit.
    pub(super) calibration: Option<Calibration>,
    /// As in the record.
    pub(super) checksums: serde_json::Value,
    /// As in the record.
    pub(super) warnings: Vec<String>,
    /// How many measurements were to be solved here.
    pub(super) count: usize,
}

impl Ending<'_> {
    /// Writes the results, and says how it went.
    pub(super) fn finish(self, mut folder: RunFolder) -> anyhow::Result<Done> {
        if folder.finished().is_empty() {
            match folder.bands_solved() {
                0 => eprintln!("stopped before the first iteration: nothing to write"),
                bands => eprintln!("{bands} bands of the first measurement are solved: add --resume to go on"),
            }
            return Ok(Done::Interrupted);
        }
        let record = self.record(&folder)?;
        results::write(&mut folder, self.layout, &record)?;
        let complete = self.is_complete(&folder);
        let kept = if complete {
            folder.close()?;
            self.count
        } else {
            folder.keep()?
        };
        results::announce(&record, self.out);
        if !complete {
            let how = if kept > 0 { "add --resume to go on" } else { "what is written is of a solve that was stopped" };
            outln!("{kept} of {} measurements are solved: {how}", self.count);
        }
        results::verdict(&record, self.out)?;
        Ok(if interrupted() && !complete { Done::Interrupted } else { Done::Complete })
    }

    /// Leaves what is solved for `sci gather`. Measurements that diverged are its to complain of: solving them again does not help.
    pub(super) fn finish_shard(self, folder: RunFolder, shard: Shard) -> anyhow::Result<Done> {
        if !self.is_complete(&folder) {
            let kept = folder.keep()?;
            outln!("{kept} of {} measurements of shard {shard} are solved: the same command goes on", self.count);
            return Ok(Done::Interrupted);
        }
        let record = self.record(&folder)?;
        folder.end_shard(record)?;
        outln!("shard {shard} is solved; when all are: sci gather {}", self.out.display());
        Ok(Done::Complete)
    }

    fn is_complete(&self, folder: &RunFolder) -> bool {
        self.unsolved(folder) == 0
    }

    /// How many measurements are not solved to their end.
    fn unsolved(&self, folder: &RunFolder) -> usize {
        self.count - folder.finished().iter().filter(|finished| finished.is_whole()).count()
    }

    /// The record of what is solved.
    fn record(&self, folder: &RunFolder) -> anyhow::Result<Record> {
        let measurements: Vec<_> = folder.finished().iter().map(|f| f.record.clone()).collect();
        let indices: Vec<usize> = measurements.iter().map(|m| m.index).collect();
        let (files, calibration) = (self.layout.files(&indices), self.calibration.clone());
        let record = solve::record(self.experiment, self.factory, measurements, files, calibration, self.begin)?;
        let (checksums, warnings) = (self.checksums.clone(), self.warnings.clone());
        Ok(Record { checksums, warnings, unsolved: self.unsolved(folder), ..record })
    }
}
