//! Puts the results of a run together from its measurements on disk, and into place, whoever has solved them.

use std::io::Write;
use std::path::{Path, PathBuf};

use crate::io::output::{WriteError, write_atomically};
use crate::io::recon::{Parts, VideoFormat, join, link_or_copy};
use crate::io::video::join_gifs;
use crate::pictures::PIECE;
use crate::record::{Record, Stop};
use crate::report;
use crate::run_folder::{Finished, Layout, PREVIEW, RECORD, REPORT, RunFolder, frame_name};

/// Makes every file of the run that `record` lists, from the folder's finished measurements, and moves them into place.
pub(super) fn write(folder: &mut RunFolder, layout: &Layout, record: &Record) -> Result<(), WriteError> {
    put_videos(folder, layout)?;
    put_copies(folder, layout)?;
    if layout.output.report {
        let pieces: Vec<PathBuf> = folder.finished().iter().map(|f| f.pictures().join(PIECE)).collect();
        report::write(&folder.out(REPORT)?, record, &pieces)?;
    }
    write_atomically(&folder.out(RECORD)?, |w| w.write_all(record.to_json().as_bytes()))?;
    if let (Some(p), Some(s), true) = (record.mean.psnr_db, record.mean.ssim, record.measurements.len() > 1) {
        outln!("mean             PSNR {p:6.2} dB   SSIM {s:.4}   {:.2} s", record.mean.seconds);
    }
    folder.commit(&record.files)
}

fn put_videos(folder: &RunFolder, layout: &Layout) -> Result<(), WriteError> {
    let Layout { shape, unit, output, .. } = *layout;
    let solved = folder.finished();
    let recon = folder.out(output.format.file_name())?;
    let paths: Vec<PathBuf> = solved.iter().map(Finished::video).collect();
    match paths.as_slice() {
        // What is on disk is the result already.
        [only] if output.format == VideoFormat::Npy && unit == 1.0 => link_or_copy(only, &recon)?,
        // Pictures show white as white; the numbers are on the measurements' own scale.
        _ => join(&recon, output.format, &Parts { paths: &paths, shape, unit })?,
    }
    if output.preview {
        let parts: Vec<PathBuf> = solved.iter().map(|f| f.pictures().join(PREVIEW)).collect();
        write_atomically(&folder.out(PREVIEW)?, |w| join_gifs(w, &parts))?;
    }
    Ok(())
}

/// Frames, and the weights that networks had in the end.
fn put_copies(folder: &RunFolder, layout: &Layout) -> Result<(), WriteError> {
    let solved = folder.finished();
    for finished in solved.iter().filter(|_| layout.output.frames) {
        for t in 0..layout.shape[0] {
            let index = finished.record.index;
            link_or_copy(&finished.pictures().join(frame_name(index, t)), &folder.out(&Layout::frame(index, t))?)?;
        }
    }
    let Some(last) = solved.last() else { return Ok(()) };
    layout.weights.iter().try_for_each(|name| link_or_copy(&last.weights().join(name), &folder.out(name)?))
}

/// Says where the results are.
pub(super) fn announce(record: &Record, out: &Path) {
    let page = record.files.iter().any(|name| name == REPORT);
    let look = if page { format!("; look at {}", out.join(REPORT).display()) } else { String::new() };
    outln!("wrote {}{look}", out.display());
}

/// Fails if a measurement diverged.
pub(super) fn verdict(record: &Record, out: &Path) -> anyhow::Result<()> {
    let diverged = record.measurements.iter().filter(|m| m.stop == Stop::Diverged).count();
    anyhow::ensure!(
        diverged == 0,
        "{diverged} of {} measurements diverged; {} holds the last good estimates, marked in record.json",
        record.measurements.len(),
        out.display()
    );
    Ok(())
}
