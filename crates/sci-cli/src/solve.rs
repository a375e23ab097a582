//! Owns the solve of an experiment's scene in memory, a measurement at a time, and the record of it: what `sci run` and programs that hold
//! arrays have in common. Files, bars and Ctrl-C are those of who calls.

use std::ops::ControlFlow;
use std::time::Instant;

use admm::{BoxError, Estimate, IterInfo, Observer, Plan, StopReason};
use anyhow::Context;
use ndarray::{ArrayView3, ArrayView4};
use sci_forward::metrics::{mean_over_frames, psnr, ssim, ssim_gaussian};

use crate::calibration::{self, Calibration};
use crate::config::{self, Experiment};
use crate::factory::{Factory, Follow, Solved};
use crate::io::scene::Scene;
use crate::record::{MeanRecord, MeasurementRecord, Record, SCHEMA, Skipped, Trace, host};

/// What is told of a solve while it runs.
pub trait Show {
    /// The first iteration is about to begin.
    fn begin(&mut self) {}
    /// Networks were updated for the `done`-th time before it.
    fn update(&mut self, done: usize);
    /// `done` iterations are done; with the mean PSNR in dB where there is a truth.
    fn step(&mut self, done: usize, psnr_db: Option<f64>);
    /// Whether the solve is to stop. Asked after every iteration.
    fn stopped(&self) -> bool;
}

/// The measurements of a scene of `count` that an experiment wants.
///
/// # Errors
/// The first one that the scene does not have, and which it has.
pub fn choose(experiment: &Experiment, count: usize) -> Result<Vec<usize>, String> {
    let chosen = experiment.data.measurements.clone().unwrap_or_else(|| (0..count).collect());
    match chosen.iter().find(|&&k| k >= count) {
        None => Ok(chosen),
        Some(k) => Err(format!(
            "{}: `data.measurements` names {k}, but the scene has {count} (legal: 0 to {})",
            experiment.data.path.display(),
            count - 1
        )),
    }
}

/// Moves the masks to where they really are, if that is asked for, and looks for defective pixels by them: how they sit, and what there is to
/// say of pixels. `watch` is as in [`calibration::find`].
///
/// # Errors
/// A file that is no calibration, those of [`calibration::find`], and a scene of which no pixel is left.
pub fn calibrate(
    experiment: &Experiment,
    scene: &mut Scene,
    chosen: &[usize],
    watch: calibration::Watch<'_>,
) -> anyhow::Result<Option<(Calibration, Option<String>)>> {
    let found = match &experiment.data.calibration {
        config::Calibration::None => return Ok(None),
        config::Calibration::File(path) => Calibration::read(path).context("data.calibration")?,
        config::Calibration::Auto => calibration::find(scene, chosen, &admm::Calibration::default(), watch)?,
    };
    found.apply(scene)?;
    let note = scene.look_for_defects(experiment.data.reading.defects)?;
    Ok(Some((found, note)))
}

/// Solves the first of the measurements `left`; `previous` is what the sensor sees of the result before, where the factory needs it.
///
/// # Errors
/// Those of [`Factory::solve`], with the measurement's number.
pub fn measurement(
    factory: &mut Factory<'_>,
    scene: &Scene,
    left: &[usize],
    previous: Option<ArrayView3<'_, f32>>,
    show: &mut dyn Show,
) -> anyhow::Result<(MeasurementRecord, Estimate)> {
    let k = left[0];
    let truth = scene.truth_of(k);
    let mut watch = Watch { truth, trace: Trace::default(), show };
    let solved = factory.solve(scene, left, previous, &mut watch).with_context(|| format!("measurement {k}"))?;
    let mut record = measurement_record(k, &solved, watch.trace, factory.plan());
    let estimate = solved.outcome.estimate;
    if let Some(truth) = truth {
        record.compare(truth, estimate.sensor.view());
    }
    record.psnr_rgb_db = estimate.rgb.as_ref().zip(scene.rgb_of(k)).map(|(x, t)| psnr_rgb(t, x.view()));
    Ok((record, estimate))
}

/// Solves a band of measurement `k`, the only measurement of `scene`; networks learn from it only if they are to. The record lacks what
/// compares with a truth.
///
/// # Errors
/// Those of [`Factory::solve`], with the measurement's number.
pub fn band(
    factory: &mut Factory<'_>,
    scene: &Scene,
    k: usize,
    learns: bool,
    show: &mut dyn Show,
) -> anyhow::Result<(MeasurementRecord, Estimate)> {
    let mut watch = Watch { truth: scene.truth_of(0), trace: Trace::default(), show };
    let solved =
        if learns { factory.solve(scene, &[0], None, &mut watch) } else { factory.solve_as_learned(scene, &mut watch) };
    let solved = solved.with_context(|| format!("measurement {k}"))?;
    let record = measurement_record(k, &solved, watch.trace, factory.plan());
    Ok((record, solved.outcome.estimate))
}

/// The record of a run that began at `begin`, of these measurements and files.
///
/// # Errors
/// As [`Factory::kernel`].
pub fn record(
    experiment: &Experiment,
    factory: &Factory<'_>,
    measurements: Vec<MeasurementRecord>,
    files: Vec<String>,
    calibration: Option<Calibration>,
    begin: Instant,
) -> anyhow::Result<Record> {
    let halved = measurements.iter().fold(0.0, |most, m| m.skipped.precision.max(most));
    Ok(Record {
        schema: SCHEMA,
        experiment: experiment.name.clone(),
        scene: experiment.scene_name(),
        solver: experiment.solver.kind.to_owned(),
        denoiser: experiment.denoiser_kinds(),
        unsolved: 0,
        mean: MeanRecord::of(&measurements),
        warnings: Vec::new(),
        measurements,
        peak_rss_bytes: host::peak_rss_bytes(),
        threads: rayon::current_num_threads(),
        seed: experiment.seed,
        version: host::VERSION.to_owned(),
        revision: host::REVISION.to_owned(),
        cpu: host::cpu(),
        kernel: factory.kernel()?.to_owned(),
        precision_used: factory.precision_used(halved)?.to_owned(),
        wall_seconds: begin.elapsed().as_secs_f64(),
        shards: Vec::new(),
        files,
        calibration,
        checksums: serde_json::Value::Null,
        config: experiment.record_json(),
    })
}

/// What to try after a measurement has diverged, on one line.
pub fn advice(m: &MeasurementRecord, experiment: &Experiment) -> String {
    let suggestion = experiment.solver.advice(m.backed_off.is_some());
    format!("measurement {} diverged in iteration {}: {suggestion}", m.index, m.iterations.saturating_sub(1))
}

impl MeasurementRecord {
    /// Takes in how near the result `[T, H, W]` is to the truth.
    pub(crate) fn compare(&mut self, truth: ArrayView3<'_, f32>, x: ArrayView3<'_, f32>) {
        self.psnr_db = Some(mean_over_frames(truth, x, psnr));
        self.ssim = Some(mean_over_frames(truth, x, ssim));
        self.ssim_gaussian = Some(mean_over_frames(truth, x, ssim_gaussian));
    }
}

/// How measurement `index` went; `whole` are the iterations of the schedule.
fn measurement_record(index: usize, solved: &Solved, trace: Trace, plan: &Plan) -> MeasurementRecord {
    let Solved { outcome, planned, work, adaptation } = solved;
    let (whole, decides) = (plan.iterations(), plan.hold_out.is_some_and(|hold_out| hold_out.decides));
    // Stopping early because nothing changes any more saves iterations, as does a start that needs fewer; being stopped
    // does not.
    let left = match outcome.stop {
        StopReason::ScheduleDone | StopReason::Converged | StopReason::Stalled => planned - outcome.iterations,
        StopReason::Diverged | StopReason::TimeUp | StopReason::Observer => 0,
    };
    let counts = adaptation.as_ref().map(|a| a.counts).unwrap_or_default();
    let predicted = trace.predicted_error.iter().flatten().copied();
    // The result is the best of the iterates where `[skip]` decides, else the last.
    let predicted = if decides { predicted.reduce(f64::min) } else { predicted.last() };
    MeasurementRecord {
        index,
        psnr_db: None,
        ssim: None,
        ssim_gaussian: None,
        psnr_rgb_db: None,
        predicted_psnr_db: predicted.filter(|error| *error > 0.0).map(|error| -10.0 * error.log10()),
        bands: None,
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
pub(crate) fn psnr_rgb(truth: ArrayView4<'_, f32>, video: ArrayView4<'_, f32>) -> f64 {
    let (t, c, h, w) = truth.dim();
    // The colors of a frame one below the other are one image of three times the height.
    let stacked = (t, c * h, w);
    let (truth, video) = (truth.to_shape(stacked), video.to_shape(stacked));
    let same = "the same number of pixels";
    mean_over_frames(truth.expect(same).view(), video.expect(same).view(), psnr)
}

/// Follows one solve: convergence curve, and what is shown of it.
struct Watch<'t> {
    truth: Option<ArrayView3<'t, f32>>,
    trace: Trace,
    show: &'t mut dyn Show,
}

impl Watch<'_> {
    fn go_on(&self) -> ControlFlow<()> {
        if self.show.stopped() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }
}

impl Observer for Watch<'_> {
    fn begin(&mut self, _: &Plan) -> Result<(), BoxError> {
        self.show.begin();
        Ok(())
    }

    fn warm_start(&mut self, _: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
        Ok(self.go_on())
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
        self.show.step(it.iteration + 1, psnr_db);
        Ok(self.go_on())
    }
}

impl Follow for Watch<'_> {
    fn adaptation(&mut self, updates: usize) -> ControlFlow<()> {
        self.show.update(updates);
        self.go_on()
    }
}
