//! Solves the measurements of a scene that is too large for memory in bands of rows, each on disk as soon as it is solved.

use std::path::PathBuf;

use anyhow::Context;
use ndarray::{Array3, Array4, Axis};
use nets::kernels::release_freed_memory;
use rayon::prelude::*;
use sci_forward::MaskError;
use sci_forward::bayer::mosaic_into;

use super::super::interrupted;
use super::solving::{Bar, line};
use crate::bands::{Bands, Joined};
use crate::config::Experiment;
use crate::factory::Factory;
use crate::io::scene::{Banded, SceneError};
use crate::pictures::Studio;
use crate::progress::Progress;
use crate::record::{MeasurementRecord, Stop};
use crate::run_folder::{Finished, RunFolder};
use crate::solve;

/// A scene and how it is cut.
#[derive(Debug)]
pub(super) struct Cut {
    pub(super) scene: Banded,
    pub(super) bands: Bands,
    /// Bytes that may be taken.
    pub(super) memory: usize,
}

impl Cut {
    /// Solves what is left of `own`, the part of the `chosen` measurements that is solved here, until Ctrl-C.
    pub(super) fn solve_all(
        &self,
        experiment: &Experiment,
        (chosen, own): (&[usize], &[usize]),
        factory: &mut Factory<'_>,
        folder: &mut RunFolder,
    ) -> anyhow::Result<()> {
        self.pass_solved(factory, folder)?;
        let limit = experiment.output.report_megabytes as usize * 1_000_000 / chosen.len().max(1);
        // A run may have stopped between a result and its pictures.
        for finished in folder.finished() {
            Studio::make_by_frames(&experiment.output, limit, &self.scene, finished, self.shape())?;
        }
        for &k in &own[folder.finished().len()..] {
            if !self.solve_bands(experiment, k, factory, folder)? {
                break;
            }
            self.join(k, folder)?;
            let finished = folder.finished().last().context("a measurement was joined")?;
            outln!("{}", line(&finished.record));
            if finished.record.stop == Stop::Diverged {
                eprintln!("{}", solve::advice(&finished.record, experiment));
            }
            Studio::make_by_frames(&experiment.output, limit, &self.scene, finished, self.shape())?;
        }
        Ok(())
    }

    /// `[T, C, H, W]` of the result of a measurement.
    fn shape(&self) -> [usize; 4] {
        let (t, h, w) = self.scene.shape().dim();
        [t, if self.scene.cfa.is_some() { 3 } else { 1 }, h, w]
    }

    /// Brings the factory to where it was after the measurements that are solved: what learns has seen their middle bands.
    fn pass_solved(&self, factory: &mut Factory<'_>, folder: &RunFolder) -> anyhow::Result<()> {
        if !factory.needs_weights() && !factory.needs_previous() {
            return Ok(());
        }
        for finished in folder.finished() {
            let k = finished.record.index;
            let (scene, sensor) = (self.scene.band(k, self.bands.solved(self.bands.middle()))?, finished.sensor()?);
            let view = sensor.as_ref().map(|sensor: &Array3<f32>| sensor.view());
            factory.pass(&scene, 0, view, &finished.record)?;
        }
        if let Some(last) = folder.finished().last() {
            factory.load_weights(&last.weights())?;
        }
        Ok(())
    }

    /// Solves the bands of measurement `k` that are not on disk; whether all are there then. Networks that learn do so from the band in
    /// the middle, which comes first, and are used as they are for the others.
    fn solve_bands(
        &self,
        experiment: &Experiment,
        k: usize,
        factory: &mut Factory<'_>,
        folder: &RunFolder,
    ) -> anyhow::Result<bool> {
        let (count, middle) = (self.bands.count(), self.bands.middle());
        let learning = experiment.online.is_some();
        let first = if learning { middle } else { 0 };
        for band in std::iter::once(first).chain((0..count).filter(|&band| band != first)) {
            // What was learned is not kept with a band, so that it is learned again.
            if !learning && folder.band(k, band).is_some() {
                continue;
            }
            if interrupted() {
                return Ok(false);
            }
            // What the bands before have left in pieces would add to what this one takes.
            release_freed_memory();
            let scene = match self.scene.band(k, self.bands.solved(band)) {
                // A shaded border: nothing is measured, and nothing to be found.
                Err(SceneError::Mask { source: MaskError::AllClosed, .. })
                    if band != middle || !factory.takes_over() =>
                {
                    let [frames, channels, _, width] = self.shape();
                    let video = Array4::zeros((frames, channels, self.bands.kept(band).len(), width));
                    let record =
                        MeasurementRecord { index: k, relative_residual: Some(0.0), ..MeasurementRecord::default() };
                    folder.store_band(record, band, &video, None, |_| Ok(()))?;
                    continue;
                }
                scene => scene?,
            };
            let learns = learning && band == middle;
            let name = format!("measurement {k:>2}, band {} of {count}", band + 1);
            if !scene.left_out.is_empty() {
                eprintln!("warning: {name}: {} pixels left out as not measured", scene.left_out.len());
            }
            let mut bar = Bar(Progress::of(&name, factory.plan().iterations()));
            let (record, estimate) = solve::band(factory, &scene, k, learns, &mut bar)?;
            bar.0.finish();
            if record.stop == Stop::Observer {
                return Ok(false);
            }
            let video = self.bands.cut(band, &estimate.video());
            let sensor = (band == middle && factory.needs_previous()).then_some(&estimate.sensor);
            let saves = band == middle && factory.needs_weights();
            folder.store_band(
                record,
                band,
                &video,
                sensor,
                |dir| {
                    if saves { factory.save_weights(dir) } else { Ok(()) }
                },
            )?;
        }
        Ok(true)
    }

    /// Makes a measurement of its bands.
    fn join(&self, k: usize, folder: &mut RunFolder) -> anyhow::Result<()> {
        let bands: Option<Vec<Finished>> = (0..self.bands.count()).map(|band| folder.band(k, band)).collect();
        let bands = bands.with_context(|| format!("a band of measurement {k} is gone from the folder"))?;
        let paths: Vec<PathBuf> = bands.iter().map(Finished::video).collect();
        folder.join_bands(k, &bands[self.bands.middle()], |path| {
            let (mut of_frames, mut waiting) = (Vec::new(), Vec::new());
            let mut compare = |frames: &mut Vec<(usize, Array3<f32>)>| {
                let compared = frames.par_drain(..).map(|(t, frame)| self.compared(k, t, frame));
                let compared: Vec<Option<MeasurementRecord>> = compared.collect::<anyhow::Result<_>>()?;
                of_frames.extend(compared.into_iter().flatten());
                Ok(())
            };
            Joined::open(&self.bands, &paths, self.shape())?.write(path, |t, frame| {
                waiting.push((t, frame));
                if waiting.len() < self.frames_at_once() { Ok(()) } else { compare(&mut waiting) }
            })?;
            compare(&mut waiting)?;
            Ok(self.joined_record(&bands, &of_frames))
        })
    }

    /// How many frames are compared with the truth at once: each is there with its truth, and with what the metrics make of them.
    fn frames_at_once(&self) -> usize {
        let [_, channels, height, width] = self.shape();
        let frame = 4 * height * width * (3 * channels + 4);
        (self.memory / 2 / frame).clamp(1, rayon::current_num_threads())
    }

    /// How near frame `t` is to the truth, if that is known: PSNR, both SSIMs, and PSNR in color.
    fn compared(&self, k: usize, t: usize, frame: Array3<f32>) -> anyhow::Result<Option<MeasurementRecord>> {
        let Some(truth) = self.scene.truth_frame(k, t)? else { return Ok(None) };
        let (truth, truth_rgb) = truth.seen(self.scene.cfa);
        let video: Array4<f32> = frame.insert_axis(Axis(0));
        let sensor = match self.scene.cfa {
            None => video.index_axis(Axis(1), 0).to_owned(),
            Some(cfa) => {
                let mut sensor = Array3::zeros(truth.raw_dim());
                mosaic_into(cfa, video.view(), sensor.view_mut());
                sensor
            }
        };
        let mut record = MeasurementRecord::default();
        record.compare(truth.view(), sensor.view());
        record.psnr_rgb_db = truth_rgb.map(|truth| solve::psnr_rgb(truth.view(), video.view()));
        Ok(Some(record))
    }

    /// The record of a measurement: of its bands, and of what its frames have in common with the truth.
    fn joined_record(&self, bands: &[Finished], frames: &[MeasurementRecord]) -> MeasurementRecord {
        let mean = |of: fn(&MeasurementRecord) -> Option<f64>| {
            let values: Option<Vec<f64>> = frames.iter().map(of).collect();
            values.filter(|v| !v.is_empty()).map(|v| v.iter().sum::<f64>() / v.len() as f64)
        };
        let records = || bands.iter().map(|band| &band.record);
        let middle = bands[self.bands.middle()].record.clone();
        let rows: Vec<f64> = (0..bands.len()).map(|band| self.bands.kept(band).len() as f64).collect();
        let weighted = |of: fn(&MeasurementRecord) -> f64| {
            records().zip(&rows).map(|(r, rows)| of(r) * rows).sum::<f64>() / rows.iter().sum::<f64>()
        };
        let mut skipped = middle.skipped;
        skipped.tiles = weighted(|r| r.skipped.tiles);
        skipped.precision = weighted(|r| r.skipped.precision);
        let diverged = records().find(|r| r.stop == Stop::Diverged);
        MeasurementRecord {
            psnr_db: mean(|r| r.psnr_db),
            ssim: mean(|r| r.ssim),
            ssim_gaussian: mean(|r| r.ssim_gaussian),
            psnr_rgb_db: mean(|r| r.psnr_rgb_db),
            bands: Some(bands.len()),
            seconds: records().map(|r| r.seconds).sum(),
            iterations: records().map(|r| r.iterations).max().unwrap_or(0),
            denoiser_calls: records().map(|r| r.denoiser_calls).sum(),
            gmac: records().map(|r| r.gmac).sum(),
            stop: diverged.map_or(middle.stop, |r| r.stop),
            backed_off: records().find_map(|r| r.backed_off.clone()),
            relative_residual: Some(weighted(|r| r.relative_residual.unwrap_or(f64::NAN).powi(2)).sqrt()),
            skipped,
            ..middle
        }
    }
}
