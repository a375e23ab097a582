//! Solves the measurements of a run one by one, and puts each on disk as soon as it is solved.

use std::ops::ControlFlow;

use admm::{BoxError, IterInfo, Observer, Plan, StopReason};
use anyhow::Context;
use ndarray::{Array3, ArrayView3, ArrayView4};
use sci_forward::metrics::{mean_over_frames, psnr, ssim, ssim_gaussian};

use super::super::interrupted;
use crate::config::Experiment;
use crate::factory::{Factory, Follow, Solved};
use crate::io::scene::Scene;
use crate::pictures::Job;
use crate::progress::Progress;
use crate::record::{MeasurementRecord, Skipped, Stop, Trace};
use crate::run_folder::RunFolder;

/// Solves what is left of `chosen`, until Ctrl-C. Every solved measurement is in the folder before it is handed to `show`, which
/// says whether to go on.
pub(super) fn solve_all(
    experiment: &Experiment,
    scene: &Scene,
    chosen: &[usize],
    factory: &mut Factory<'_>,
    folder: &mut RunFolder,
    show: &dyn Fn(Job) -> bool,
) -> anyhow::Result<()> {
    let mut previous = pass_solved(scene, factory, folder)?;
    let planned = factory.plan().iterations();
    for (i, &k) in chosen.iter().enumerate().skip(folder.finished().len()) {
        if interrupted() {
            break;
        }
        let truth = scene.truth_of(k);
        let mut watch = Watch::new(truth, Progress::new(k, planned));
        let start = previous.as_ref().map(|sensor| sensor.view());
        let solved =
            factory.solve(scene, &chosen[i..], start, &mut watch).with_context(|| format!("measurement {k}"))?;
        let mut record = measurement_record(k, &solved, truth, watch.finish(), planned);
        let estimate = solved.outcome.estimate;
        record.psnr_rgb_db = estimate.rgb.as_ref().zip(scene.rgb_of(k)).map(|(x, t)| psnr_rgb(t, x.view()));
        outln!("{}", line(&record));
        if record.stop == Stop::Diverged {
            eprintln!("{}", advice(&record, experiment));
        }
        let (whole, saves) = (record.stop != Stop::Observer, factory.needs_weights());
        folder.store(record, &estimate, factory.needs_previous(), whole, |dir| {
            if saves { factory.save_weights(dir) } else { Ok(()) }
        })?;
        previous = factory.needs_previous().then(|| estimate.sensor.clone());
        let finished = folder.finished().last().cloned().context("a measurement was stored")?;
        if !show(Job { finished, estimate, last: i + 1 == chosen.len() }) {
            break;
        }
    }
    Ok(())
}

/// Brings the factory to where it was after the measurements that are solved; what the sensor sees of the last.
fn pass_solved(scene: &Scene, factory: &mut Factory<'_>, folder: &RunFolder) -> anyhow::Result<Option<Array3<f32>>> {
    let mut sensor = None;
    for finished in folder.finished() {
        sensor = finished.sensor()?;
        let view = sensor.as_ref().map(|sensor: &Array3<f32>| sensor.view());
        factory.pass(scene, finished.record.index, view, finished.record.online.as_ref())?;
    }
    if let Some(last) = folder.finished().last() {
        factory.load_weights(&last.weights())?;
    }
    Ok(sensor)
}

/// How measurement `index` went; `whole` are the iterations of the schedule.
fn measurement_record(
    index: usize,
    solved: &Solved,
    truth: Option<ArrayView3<'_, f32>>,
    trace: Trace,
    whole: usize,
) -> MeasurementRecord {
    let Solved { outcome, planned, work, adaptation } = solved;
    let x = outcome.estimate.sensor.view();
    // Stopping early because nothing changes any more saves iterations, as does a start that needs fewer; being stopped
    // does not.
    let left = match outcome.stop {
        StopReason::ScheduleDone | StopReason::Converged | StopReason::Stalled => planned - outcome.iterations,
        StopReason::Diverged | StopReason::TimeUp | StopReason::Observer => 0,
    };
    let counts = adaptation.as_ref().map(|a| a.counts).unwrap_or_default();
    MeasurementRecord {
        index,
        psnr_db: truth.map(|t| mean_over_frames(t, x, psnr)),
        ssim: truth.map(|t| mean_over_frames(t, x, ssim)),
        ssim_gaussian: truth.map(|t| mean_over_frames(t, x, ssim_gaussian)),
        psnr_rgb_db: None,
        seconds: outcome.seconds,
        iterations: outcome.iterations,
        stop: outcome.stop.into(),
        backed_off: outcome.backed_off.map(Into::into),
        relative_residual: Some(outcome.relative_residual),
        updates: counts.kept,
        denoiser_calls: outcome.iterations,
        gmac: work.gmac,
        skipped: Skipped {
            iterations: whole - planned + left,
            tiles: work.skipped_tiles,
            precision: work.halved,
            updates: counts.skipped,
        },
        online: adaptation.clone(),
        trace,
    }
}

/// Mean over the frames of the PSNR over all three colors, `[T, 3, H, W]`.
fn psnr_rgb(truth: ArrayView4<'_, f32>, video: ArrayView4<'_, f32>) -> f64 {
    let (t, c, h, w) = truth.dim();
    // The colors of a frame one below the other are one image of three times the height.
    let stacked = (t, c * h, w);
    let (truth, video) = (truth.to_shape(stacked), video.to_shape(stacked));
    let same = "the same number of pixels";
    mean_over_frames(truth.expect(same).view(), video.expect(same).view(), psnr)
}

fn line(m: &MeasurementRecord) -> String {
    let quality = match (m.psnr_db, m.ssim) {
        (Some(p), Some(s)) => {
            let rgb = m.psnr_rgb_db.map_or(String::new(), |p| format!("   RGB {p:6.2} dB"));
            format!("PSNR {p:6.2} dB   SSIM {s:.4}{rgb}")
        }
        _ => format!("residual {:.2e}", m.relative_residual.unwrap_or(f64::NAN)),
    };
    let note = match m.stop {
        Stop::ScheduleDone => "",
        Stop::Converged => "   converged",
        Stop::Stalled => "   nothing gained any more",
        Stop::Diverged => "   DIVERGED (last good estimate)",
        Stop::TimeUp => "   time up",
        Stop::Observer => "   stopped",
    };
    let updates = m.online.as_ref().map_or(String::new(), |a| {
        let warm = if a.warm_start { ", from the result before" } else { "" };
        let cut = if a.cut { ", after a cut" } else { "" };
        let took = a.split.as_ref().map_or(String::new(), |split| format!(" in {:.1} s", split.seconds));
        format!("   {} of {} updates kept{took}{warm}{cut}", a.counts.kept, a.counts.fired + a.counts.skipped)
    });
    let backed_off = m
        .backed_off
        .as_ref()
        .map_or(String::new(), |b| format!("   diverged in iteration {}, went on without {}", b.iteration, b.without));
    let (k, iterations, seconds) = (m.index, m.iterations, m.seconds);
    format!("measurement {k:>2}   {quality}   {iterations} iterations   {seconds:.2} s{updates}{backed_off}{note}")
}

fn advice(m: &MeasurementRecord, experiment: &Experiment) -> String {
    let suggestion = experiment.solver.advice(m.backed_off.is_some());
    format!("measurement {} diverged in iteration {}: {suggestion}", m.index, m.iterations.saturating_sub(1))
}

/// Follows one solve: convergence curve, progress, Ctrl-C.
struct Watch<'t> {
    truth: Option<ArrayView3<'t, f32>>,
    trace: Trace,
    progress: Progress,
}

impl<'t> Watch<'t> {
    fn new(truth: Option<ArrayView3<'t, f32>>, progress: Progress) -> Self {
        Self { truth, trace: Trace::default(), progress }
    }

    fn finish(self) -> Trace {
        self.progress.finish();
        self.trace
    }
}

impl Observer for Watch<'_> {
    fn begin(&mut self, _: &Plan) -> Result<(), BoxError> {
        self.progress.start();
        Ok(())
    }

    fn warm_start(&mut self, _: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
        Ok(go_on())
    }

    fn iteration(&mut self, it: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
        let psnr_db = self.truth.map(|truth| mean_over_frames(truth, it.estimate.sensor.view(), psnr));
        if psnr_db.is_some() {
            self.trace.psnr_db.push(psnr_db);
        }
        self.trace.relative_residual.push(Some(it.relative_residual));
        self.trace.relative_change.push(Some(it.relative_change));
        self.trace.seconds.push(it.seconds);
        self.trace.sigma.push(it.sigma.unwrap_or(0.0));
        if it.predicted_error.is_some() {
            self.trace.predicted_error.push(it.predicted_error);
        }
        self.progress.step(it.iteration + 1, psnr_db);
        Ok(go_on())
    }
}

impl Follow for Watch<'_> {
    fn adaptation(&mut self, updates: usize) -> ControlFlow<()> {
        self.progress.update(updates);
        go_on()
    }
}

/// Until Ctrl-C.
fn go_on() -> ControlFlow<()> {
    if interrupted() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
}
