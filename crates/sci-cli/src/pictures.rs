//! Owns the pictures of a run, frames, preview and the report's pieces: made of one measurement while the next is solved.

use std::fs;
use std::path::Path;
use std::sync::mpsc::{Receiver, sync_channel};

use admm::Estimate;
use anyhow::Context;
use ndarray::{Array4, ArrayView4, Axis, concatenate};

use crate::bands::frame_of;
use crate::config::Output;
use crate::io::output::{WriteError, write_atomically};
use crate::io::scene::{Banded, Scene};
use crate::io::{frames, video};
use crate::report;
use crate::report::pictures::{MeasurementImages, Pictures};
use crate::run_folder::{Finished, PREVIEW, frame_name, read_video};

/// The file of a measurement's piece of the report.
pub const PIECE: &str = "report.json";
/// A preview is halved until its longer side is at most this.
const PREVIEW_SIDE: usize = 640;
/// The same of what the page shows of a measurement that is too large for memory.
const PAGE_SIDE: usize = 1000;

/// A measurement that has just been solved.
#[derive(Debug)]
pub struct Job {
    /// On disk.
    pub finished: Finished,
    /// Its estimate.
    pub estimate: Estimate,
    /// Whether it is about to be moved into place, as no other one follows.
    pub last: bool,
}

/// What makes the pictures of a run.
#[derive(Debug)]
pub struct Studio<'a> {
    /// Where measurements and truth are.
    pub scene: &'a Scene,
    /// What is wanted.
    pub output: Output,
    /// What the report may take of each measurement, in bytes.
    pub report_bytes: usize,
}

impl Studio<'_> {
    /// Runs `solve`, which hands every solved measurement to its argument, and makes the pictures of `solved` before and of these
    /// meanwhile, on threads of their own: the solver's are never held up by a picture. At most one measurement waits. The
    /// argument gives `false` once something went wrong.
    ///
    /// # Errors
    /// That of `solve`, else that of the pictures.
    pub fn in_step<R>(
        &self,
        solved: &[Finished],
        solve: impl FnOnce(&dyn Fn(Job) -> bool) -> anyhow::Result<R>,
    ) -> anyhow::Result<R> {
        let threads = rayon::current_num_threads();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().context("cannot start threads")?;
        std::thread::scope(|scope| {
            let (sender, receiver) = sync_channel(0);
            let studio = scope.spawn(move || pool.install(|| self.make_all(solved, receiver)));
            let result = solve(&|job| sender.send(job).is_ok());
            drop(sender);
            let made = studio.join().map_err(|_| anyhow::anyhow!("a picture could not be made"))?;
            let result = result?;
            made?;
            Ok(result)
        })
    }

    /// Ends, and with it the receiver, with the first error.
    fn make_all(&self, solved: &[Finished], jobs: Receiver<Job>) -> anyhow::Result<()> {
        for finished in solved.iter().filter(|f| self.output.has_pictures() && !f.pictures().exists()) {
            self.make(finished, read_video(&finished.video())?.view())?;
        }
        for Job { finished, estimate, last } in jobs {
            if self.output.has_pictures() {
                self.make(&finished, estimate.video())?;
            }
            drop(estimate);
            // After the last there is nothing to hide it behind, and it is about to be moved into place.
            if !last {
                finished.sync()?;
            }
        }
        Ok(())
    }

    fn make(&self, finished: &Finished, result: ArrayView4<'_, f32>) -> Result<(), WriteError> {
        let index = finished.record.index;
        finished.make_pictures(|dir| {
            let frames = if self.output.frames { Some(self.frames(dir, index, result)?) } else { None };
            if self.output.preview {
                preview(&dir.join(PREVIEW), result, self.output.fps)?;
            }
            if self.output.report {
                self.piece(&dir.join(PIECE), index, result, frames)?;
            }
            Ok(())
        })
    }

    /// The pictures of a measurement that is too large for memory, a frame at a time: preview and page show it smaller.
    ///
    /// # Errors
    /// That of the pictures, or of the scene.
    pub fn make_by_frames(
        output: &Output,
        report_bytes: usize,
        scene: &Banded,
        finished: &Finished,
        shape: [usize; 4],
    ) -> anyhow::Result<()> {
        let (index, path) = (finished.record.index, finished.video());
        if !output.has_pictures() || finished.pictures().exists() {
            return Ok(());
        }
        finished.make_pictures(|dir| {
            let fail = |e: anyhow::Error| WriteError::new(dir, e);
            let (mut small, mut truth, mut psnr_db) = (Vec::new(), Vec::new(), Vec::new());
            for t in 0..shape[0] {
                let frame = frame_of(&path, shape, t).map_err(|e| WriteError::new(&path, e))?;
                if output.frames {
                    let png = frames::png(frame.view()).map_err(|e| WriteError::new(dir, e))?;
                    fs::write(dir.join(frame_name(index, t)), png).map_err(|e| WriteError::new(dir, e))?;
                }
                if output.report
                    && let Some(whole) = scene.truth_frame(index, t).map_err(|e| fail(e.into()))?
                {
                    let whole = whole.seen(scene.cfa);
                    let shown = whole.1.unwrap_or_else(|| whole.0.insert_axis(Axis(1)));
                    // Of a mosaic there is no picture to compare with.
                    if shown.len_of(Axis(1)) == frame.len_of(Axis(0)) {
                        psnr_db.push(report::pictures::psnr(shown.index_axis(Axis(0), 0), frame.view()));
                        truth.push(frames::shrunk(shown.view(), PAGE_SIDE));
                    }
                }
                small.push(frames::shrunk(frame.insert_axis(Axis(0)).view(), PAGE_SIDE));
            }
            let joined = |videos: &[Array4<f32>]| {
                let views: Vec<_> = videos.iter().map(|video| video.view()).collect();
                concatenate(Axis(0), &views).map_err(|e| fail(e.into()))
            };
            let small = joined(&small)?;
            if output.preview {
                preview(&dir.join(PREVIEW), small.view(), output.fps)?;
            }
            if output.report {
                let y = scene.y(index).map_err(|e| fail(e.into()))?.insert_axis(Axis(0)).insert_axis(Axis(0));
                let y = frames::shrunk(y.view(), PAGE_SIDE);
                let truth = if truth.is_empty() { None } else { Some(joined(&truth)?) };
                let images = MeasurementImages {
                    measurement: Some(y.index_axis(Axis(0), 0).index_axis_move(Axis(0), 0)),
                    recon: small.view(),
                    cfa: None,
                    truth: truth.as_ref().map(|truth| truth.view()),
                };
                let factor = shape[2].max(shape[3]) / frames::longer_side(small.view());
                let pictures = Pictures::of(&images, None, report_bytes).map_err(|e| WriteError::new(dir, e))?;
                save(&dir.join(PIECE), &pictures.of_larger(factor, &psnr_db))?;
            }
            Ok(())
        })?;
        Ok(())
    }

    /// Each frame as a PNG, which the report may use too.
    fn frames(&self, dir: &Path, index: usize, result: ArrayView4<'_, f32>) -> Result<Vec<Vec<u8>>, WriteError> {
        let pngs = frames::pngs(result, usize::MAX).map_err(|e| WriteError::new(dir, e))?;
        for (t, png) in pngs.iter().enumerate() {
            let path = dir.join(frame_name(index, t));
            fs::write(&path, png).map_err(|e| WriteError::new(&path, e))?;
        }
        Ok(pngs)
    }

    fn piece(
        &self,
        path: &Path,
        index: usize,
        result: ArrayView4<'_, f32>,
        frames: Option<Vec<Vec<u8>>>,
    ) -> Result<(), WriteError> {
        let images = MeasurementImages {
            measurement: Some(self.scene.y(index)),
            recon: result,
            cfa: self.scene.cfa,
            truth: if result.len_of(Axis(1)) == 3 {
                self.scene.rgb_of(index)
            } else {
                self.scene.truth_of(index).map(|t| t.insert_axis(Axis(1)))
            },
        };
        let pictures = Pictures::of(&images, frames, self.report_bytes).map_err(|e| WriteError::new(path, e))?;
        save(path, &pictures)
    }
}

fn preview(path: &Path, result: ArrayView4<'_, f32>, fps: u16) -> Result<(), WriteError> {
    let small = (frames::longer_side(result) > PREVIEW_SIDE).then(|| frames::halved_to(result, PREVIEW_SIDE));
    let shown = small.as_ref().map_or(result, |small| small.view());
    write_atomically(path, |w| video::write_gif(w, shown, fps))
}

fn save(path: &Path, pictures: &Pictures) -> Result<(), WriteError> {
    let json = serde_json::to_vec(pictures).map_err(|e| WriteError::new(path, e))?;
    fs::write(path, json).map_err(|e| WriteError::new(path, e))
}
