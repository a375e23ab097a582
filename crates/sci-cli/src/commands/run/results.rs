//! Puts the results of a run together from its measurements on disk, and into place.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Instant;

use super::super::{Done, interrupted};
use crate::calibration::Calibration;
use crate::config::Experiment;
use crate::factory::Factory;
use crate::io::output::{WriteError, write_atomically};
use crate::io::recon::{Parts, VideoFormat, join, link_or_copy};
use crate::io::video::join_gifs;
use crate::pictures::{PIECE, PREVIEW, frame_name};
use crate::record::{Record, Stop};
use crate::report;
use crate::run_folder::{Finished, RECORD, RunFolder};
use crate::solve;

/// The file of the page.
const REPORT: &str = "report.html";

/// Every file of a run of these measurements, of `frames` frames each, but for the record.
pub(super) fn files(
    experiment: &Experiment,
    factory: &Factory<'_>,
    frames: usize,
    measurements: &[usize],
) -> Vec<String> {
    let output = &experiment.output;
    let mut files = vec![output.format.file_name().to_owned()];
    if output.frames {
        let of = |&index: &usize| (0..frames).map(move |t| format!("frames/{}", frame_name(index, t)));
        files.extend(measurements.iter().flat_map(of));
    }
    files.extend(output.preview.then(|| PREVIEW.to_owned()));
    files.extend(output.report.then(|| REPORT.to_owned()));
    if experiment.online.is_some_and(|o| o.save) {
        files.extend(factory.weight_files());
    }
    files.sort();
    files
}

/// A run of which no more is going to be solved.
pub(super) struct Results<'r> {
    pub(super) experiment: &'r Experiment,
    /// `[T, C, H, W]` of the result of a measurement.
    pub(super) shape: [usize; 4],
    /// What white is in units of the file's scale.
    pub(super) unit: f32,
    pub(super) factory: &'r Factory<'r>,
    pub(super) out: &'r Path,
    /// When the command began.
    pub(super) begin: Instant,
    /// How the masks were found to sit.
    pub(super) calibration: Option<Calibration>,
}

impl Results<'_> {
    /// Writes the run, and says how it went; `count` measurements were to be solved.
    pub(super) fn finish(&self, mut folder: RunFolder, count: usize) -> anyhow::Result<Done> {
        if folder.finished().is_empty() {
            eprintln!("stopped before the first iteration: nothing to write");
            return Ok(Done::Interrupted);
        }
        let record = self.put_together(&folder)?;
        if let (Some(p), Some(s), true) = (record.mean.psnr_db, record.mean.ssim, record.measurements.len() > 1) {
            outln!("mean             PSNR {p:6.2} dB   SSIM {s:.4}   {:.2} s", record.mean.seconds);
        }
        folder.commit(&record.files)?;
        let complete = record.measurements.len() == count && folder.finished().iter().all(Finished::is_whole);
        let kept = if complete {
            folder.close()?;
            count
        } else {
            folder.keep()?
        };
        let page = record.files.iter().any(|name| name == REPORT);
        let look = if page { format!("; look at {}", self.out.join(REPORT).display()) } else { String::new() };
        outln!("wrote {}{look}", self.out.display());
        if kept > 0 && !complete {
            outln!("{kept} of {count} measurements are solved: add --resume to go on");
        }
        let diverged = record.measurements.iter().filter(|m| m.stop == Stop::Diverged).count();
        anyhow::ensure!(
            diverged == 0,
            "{diverged} of {} measurements diverged; {} holds the last good estimates, marked in record.json",
            record.measurements.len(),
            self.out.display()
        );
        Ok(if interrupted() && !complete { Done::Interrupted } else { Done::Complete })
    }

    /// Makes every file of the run, beside its place.
    fn put_together(&self, folder: &RunFolder) -> anyhow::Result<Record> {
        let solved = folder.finished();
        let indices: Vec<usize> = solved.iter().map(|f| f.record.index).collect();
        let files = files(self.experiment, self.factory, self.shape[0], &indices);
        self.put_videos(folder)?;
        for name in &files {
            if let Some(frame) = name.strip_prefix("frames/") {
                let owner = solved.iter().find(|f| frame.starts_with(&frame_name_start(f)));
                let from = owner.map(|f| f.pictures().join(frame)).unwrap_or_default();
                link_or_copy(&from, &folder.out(name)?)?;
            } else if name.starts_with("adapted-") {
                let from = solved.last().map(|f| f.weights().join(name)).unwrap_or_default();
                link_or_copy(&from, &folder.out(name)?)?;
            }
        }
        let measurements = solved.iter().map(|f| f.record.clone()).collect();
        let record =
            solve::record(self.experiment, self.factory, measurements, files, self.calibration.clone(), self.begin)?;
        if self.experiment.output.report {
            let pieces: Vec<PathBuf> = solved.iter().map(|f| f.pictures().join(PIECE)).collect();
            report::write(&folder.out(REPORT)?, &record, &pieces)?;
        }
        write_atomically(&folder.out(RECORD)?, |w| w.write_all(record.to_json().as_bytes()))?;
        Ok(record)
    }

    fn put_videos(&self, folder: &RunFolder) -> Result<(), WriteError> {
        let solved = folder.finished();
        let output = &self.experiment.output;
        let recon = folder.out(output.format.file_name())?;
        let paths: Vec<PathBuf> = solved.iter().map(Finished::video).collect();
        match paths.as_slice() {
            // What is on disk is the result already.
            [only] if output.format == VideoFormat::Npy && self.unit == 1.0 => link_or_copy(only, &recon)?,
            // Pictures show white as white; the numbers are on the measurements' own scale.
            _ => join(&recon, output.format, &Parts { paths: &paths, shape: self.shape, unit: self.unit })?,
        }
        if output.preview {
            let parts: Vec<PathBuf> = solved.iter().map(|f| f.pictures().join(PREVIEW)).collect();
            write_atomically(&folder.out(PREVIEW)?, |w| join_gifs(w, &parts))?;
        }
        Ok(())
    }
}

/// What the names of a measurement's frames begin with.
fn frame_name_start(finished: &Finished) -> String {
    format!("m{:02}_", finished.record.index)
}
