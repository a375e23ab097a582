//! `sci run`: an experiment from its file to a folder of results.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use admm::{BoxError, Estimate, IterInfo, Observer, Plan, StopReason};
use anyhow::Context;
use ndarray::{ArrayView3, ArrayView4, Axis, CowArray};
use sci_forward::metrics::{mean_over_frames, psnr, ssim, ssim_gaussian};
use sci_forward::{Noise, VideoShape};

use super::{Done, UsageError, catch_interrupts, interrupted};
use crate::config::resolve::{Experiment, MaskSource, OutputFormat, Simulate};
use crate::config::{self};
use crate::factory::{Factory, Solved};
use crate::io::output::{ArrayFormat, Part, Staging, write_arrays, write_frames, write_preview};
use crate::io::scene::{self, Scene, Truth};
use crate::progress::Progress;
use crate::record::{MeanRecord, MeasurementRecord, Record, SCHEMA, Skipped, Trace, host};
use crate::report::{self, MeasurementImages};
use crate::simulate::{SeededNoise, simulate};

/// Arguments of `sci run`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// The experiment file, TOML
    config: PathBuf,
    /// Override a key of the file: --set stage.0.sigma=25, --set data.path=traffic48.mat (a path given so is looked up
    /// in the current folder, then in SCI_DATA)
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Where to write [default: runs/<name>]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

impl Args {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        let experiment = config::load(&self.config, &self.set)?;
        let out = self.out.unwrap_or_else(|| Path::new("runs").join(&experiment.name));
        if out.exists() && !out.is_dir() {
            return Err(UsageError(format!("--out {}: it is a file, expected a folder", out.display())).into());
        }
        catch_interrupts()?;
        let scene = read_scene(&experiment).context("data.path")?;
        scene.warnings.iter().for_each(|w| eprintln!("warning: {}: {w}", experiment.data.path.display()));
        let chosen = choose(&experiment, &scene)?;
        let mut factory = Factory::new(&experiment, scene.cfa)?;
        // A folder that cannot be written should not be found out after hours of solving.
        drop(Staging::new(&out)?);
        announce(&experiment, &scene, chosen.len());
        let results = solve_all(&experiment, &scene, &chosen, &mut factory)?;
        if results.is_empty() {
            eprintln!("stopped before the first iteration: nothing to write");
            return Ok(Done::Interrupted);
        }
        finish(&experiment, &scene, &factory, &results, &out)
    }
}

fn read_scene(experiment: &Experiment) -> anyhow::Result<Scene> {
    let data = &experiment.data;
    let Some(s) = &data.simulate else { return Ok(scene::read(&data.path, &data.reading)?) };
    let video = match data.reading.cfa {
        None => scene::read_gray_video(&data.path, &data.reading)?.insert_axis(Axis(1)),
        Some(_) => scene::read_video(&data.path, &data.reading)?,
    };
    let (_, channels, height, width) = video.dim();
    // A single channel of a color sensor is its mosaic.
    let truth = if channels == 3 { Truth::Rgb(video) } else { Truth::Sensor(video.index_axis_move(Axis(1), 0)) };
    let masks = masks(s, &data.reading, height, width)?;
    let noise = SeededNoise { noise: Noise::new(s.photons, f64::from(s.sigma))?, seed: s.seed };
    Ok(simulate(&data.path.display().to_string(), &data.reading.keys, masks, truth, data.reading.cfa, noise)?)
}

fn masks(
    s: &Simulate,
    reading: &scene::Reading,
    height: usize,
    width: usize,
) -> anyhow::Result<sci_forward::MaskStack> {
    use sci_forward::MaskStack;
    let shape = |frames| VideoShape { frames, height, width };
    Ok(match &s.mask {
        MaskSource::Random(r) => MaskStack::random(shape(r.frames), r.density, r.seed)?,
        MaskSource::Shifting(r) => MaskStack::shifting(shape(r.frames), r.density, r.seed)?,
        MaskSource::File(path) => scene::read_mask(path, reading)?,
    })
}

fn choose(experiment: &Experiment, scene: &Scene) -> anyhow::Result<Vec<usize>> {
    let count = scene.len();
    let chosen = experiment.data.measurements.clone().unwrap_or_else(|| (0..count).collect());
    match chosen.iter().find(|&&k| k >= count) {
        None => Ok(chosen),
        Some(k) => Err(UsageError(format!(
            "{}: `data.measurements` names {k}, but the scene has {count} (legal: 0 to {})",
            experiment.data.path.display(),
            count - 1
        ))
        .into()),
    }
}

fn announce(experiment: &Experiment, scene: &Scene, count: usize) {
    let plural = if count == 1 { "" } else { "s" };
    outln!(
        "{} on {}: {} + {}, {count} measurement{plural} of {}",
        experiment.name,
        experiment.scene_name(),
        experiment.solver_kind(),
        experiment.denoiser_kinds(),
        scene.operator.shape()
    );
}

/// One solved measurement.
struct Solution {
    record: MeasurementRecord,
    estimate: Estimate,
}

fn solve_all(
    experiment: &Experiment,
    scene: &Scene,
    chosen: &[usize],
    factory: &mut Factory<'_>,
) -> anyhow::Result<Vec<Solution>> {
    let mut solutions: Vec<Solution> = Vec::new();
    let planned = factory.plan().iterations();
    for &k in chosen {
        if interrupted() {
            break;
        }
        let truth = scene.truth_of(k);
        let mut watch = Watch::new(truth, Progress::new(k, planned));
        let previous = solutions.last().map(|s| s.estimate.sensor.view());
        let solved = factory.solve(scene, k, previous, &mut watch).with_context(|| format!("measurement {k}"))?;
        let trace = watch.finish();
        let mut solution = solution(k, solved, truth, trace, planned);
        solution.record.psnr_rgb_db =
            solution.estimate.rgb.as_ref().zip(scene.rgb_of(k)).map(|(x, t)| psnr_rgb(t, x.view()));
        outln!("{}", line(&solution.record));
        if solution.record.stop == crate::record::Stop::Diverged {
            eprintln!("{}", advice(&solution.record, experiment));
        }
        solutions.push(solution);
    }
    Ok(solutions)
}

fn solution(index: usize, solved: Solved, truth: Option<ArrayView3<'_, f32>>, trace: Trace, whole: usize) -> Solution {
    let Solved { outcome, planned, work, adaptation } = solved;
    let x = outcome.estimate.sensor.view();
    // Stopping early because nothing changes any more saves iterations, as does a start that needs fewer; being stopped
    // does not.
    let left = match outcome.stop {
        StopReason::ScheduleDone | StopReason::Converged | StopReason::Stalled => planned - outcome.iterations,
        StopReason::Diverged | StopReason::TimeUp | StopReason::Observer => 0,
    };
    let counts = adaptation.as_ref().map(|a| a.counts).unwrap_or_default();
    let record = MeasurementRecord {
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
        skipped: Skipped {
            iterations: whole - planned + left,
            tiles: work.skipped_tiles,
            precision: work.halved,
            updates: counts.skipped,
        },
        online: adaptation,
        trace,
    };
    Solution { record, estimate: outcome.estimate }
}

/// Mean over the frames of the PSNR over all three colors, `[T, 3, H, W]`.
fn psnr_rgb(truth: ArrayView4<'_, f32>, video: ArrayView4<'_, f32>) -> f64 {
    // The colors of a frame one below the other are one image of three times the height.
    let stacked = |v: ArrayView4<'_, f32>| {
        let (t, c, h, w) = v.dim();
        v.as_standard_layout().into_owned().into_shape_with_order((t, c * h, w)).expect("the same number of pixels")
    };
    mean_over_frames(stacked(truth).view(), stacked(video).view(), psnr)
}

fn line(m: &MeasurementRecord) -> String {
    use crate::record::Stop;
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
        format!("   {} of {} updates kept{warm}{cut}", a.counts.kept, a.counts.fired + a.counts.skipped)
    });
    let backed_off = m
        .backed_off
        .as_ref()
        .map_or(String::new(), |b| format!("   diverged in iteration {}, went on without {}", b.iteration, b.without));
    let (k, iterations, seconds) = (m.index, m.iterations, m.seconds);
    format!("measurement {k:>2}   {quality}   {iterations} iterations   {seconds:.2} s{updates}{backed_off}{note}")
}

fn advice(m: &MeasurementRecord, experiment: &Experiment) -> String {
    use crate::config::check::{Momentum, Solver, Start};
    let suggestion = match (experiment.start, experiment.solver) {
        // It has already gone on without acceleration.
        (_, Solver::Gap { .. }) if m.backed_off.is_some() => "raise stage.0.sigma, or use another denoiser",
        (Start::Adjoint, _) => "start from solver.start = \"mean\" (the adjoint is not normalised)",
        (_, Solver::Gap { momentum: Some(Momentum::Zero) }) => "set solver.momentum = \"measurement\"",
        (_, Solver::Gap { momentum: Some(_) }) => "set solver.accelerate = false",
        (_, Solver::Gap { momentum: None }) => "raise stage.0.sigma, or use another denoiser",
        (_, Solver::TwoStage { .. }) => "raise solver.rho, or use solver.kind = \"gap\"",
        (_, Solver::Admm { .. }) => "raise solver.gamma, or use solver.kind = \"gap\"",
    };
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

/// Until Ctrl-C.
fn go_on() -> ControlFlow<()> {
    if interrupted() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
}

/// Writes the run and says how it went.
fn finish(
    experiment: &Experiment,
    scene: &Scene,
    factory: &Factory<'_>,
    solutions: &[Solution],
    out: &Path,
) -> anyhow::Result<Done> {
    let record = record(experiment, solutions);
    if let (Some(p), Some(s), true) = (record.mean.psnr_db, record.mean.ssim, solutions.len() > 1) {
        outln!("mean             PSNR {p:6.2} dB   SSIM {s:.4}   {:.2} s", record.mean.seconds);
    }
    write(experiment, scene, factory, solutions, &record, out)?;
    outln!("wrote {}; look at {}", out.display(), out.join("report.html").display());
    let diverged = record.measurements.iter().filter(|m| m.stop == crate::record::Stop::Diverged).count();
    anyhow::ensure!(
        diverged == 0,
        "{diverged} of {} measurements diverged; {} holds the last good estimates, marked in record.json",
        record.measurements.len(),
        out.display()
    );
    Ok(if interrupted() { Done::Interrupted } else { Done::Complete })
}

fn record(experiment: &Experiment, solutions: &[Solution]) -> Record {
    let measurements: Vec<MeasurementRecord> = solutions.iter().map(|s| s.record.clone()).collect();
    Record {
        schema: SCHEMA,
        experiment: experiment.name.clone(),
        scene: experiment.scene_name(),
        solver: experiment.solver_kind().to_owned(),
        denoiser: experiment.denoiser_kinds(),
        mean: MeanRecord::of(&measurements),
        measurements,
        peak_rss_bytes: host::peak_rss_bytes(),
        threads: rayon::current_num_threads(),
        seed: experiment.seed,
        version: host::VERSION.to_owned(),
        revision: host::REVISION.to_owned(),
        cpu: host::cpu(),
        config: experiment.to_json(),
    }
}

fn write(
    experiment: &Experiment,
    scene: &Scene,
    factory: &Factory<'_>,
    solutions: &[Solution],
    record: &Record,
    out: &Path,
) -> anyhow::Result<()> {
    let staging = Staging::new(out)?;
    let dir = staging.path();
    let output = &experiment.output;
    let views: Vec<ArrayView4<'_, f32>> = solutions.iter().map(|s| s.estimate.video()).collect();
    let video = ndarray::concatenate(Axis(0), &views).context("joining the measurements")?;
    // Pictures show white as white; the numbers are on the measurements' own scale.
    let scaled = if scene.unit == 1.0 { CowArray::from(video.view()) } else { CowArray::from(&video * scene.unit) };
    let format = match output.format {
        OutputFormat::Npy => ArrayFormat::Npy,
        OutputFormat::Npz => ArrayFormat::Npz,
        OutputFormat::Mat => ArrayFormat::Mat,
    };
    let recon = dir.join(format!("recon.{}", format.extension()));
    write_arrays(&recon, format, &[Part { name: "recon", data: scaled.view(), is_light: true }])?;
    if output.frames {
        let b = scene.frames();
        let name = |i: usize| format!("m{:02}_t{:02}.png", solutions[i / b].record.index, i % b);
        write_frames(&dir.join("frames"), video.view(), name)?;
    }
    if output.preview {
        write_preview(&dir.join("preview.gif"), video.view(), output.fps)?;
    }
    if experiment.online.is_some_and(|o| o.save) {
        factory.save_adapted(dir)?;
    }
    let images: Vec<MeasurementImages<'_>> = solutions
        .iter()
        .map(|s| MeasurementImages {
            measurement: scene.y(s.record.index),
            recon: s.estimate.video(),
            cfa: scene.cfa,
            truth: match s.estimate.rgb {
                Some(_) => scene.rgb_of(s.record.index),
                None => scene.truth_of(s.record.index).map(|t| t.insert_axis(Axis(1))),
            },
        })
        .collect();
    report::write(&dir.join("report.html"), record, &images)?;
    std::fs::write(dir.join("record.json"), record.to_json()).context("record.json")?;
    staging.commit()?;
    Ok(())
}
