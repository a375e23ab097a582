//! `sci run`: an experiment from its file to a folder of results.

mod results;
mod solving;

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context;
use ndarray::Axis;
use sci_forward::VideoShape;
use serde_json::json;

use super::{Done, UsageError, catch_interrupts, check_folder, interrupted, shown_on_a_bar};
use crate::calibration::Calibration;
use crate::config::{self, Experiment, MaskSource, RandomMask, Simulate};
use crate::factory::Factory;
use crate::io::scene::{self, Scene, Truth};
use crate::pictures::Studio;
use crate::record::host;
use crate::run_folder::{Finished, RunFolder, RunPlan, Wish, refuse_inputs};
use crate::simulate::simulate;
use crate::solve;

/// Arguments of `sci run`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// The experiment file, TOML
    config: PathBuf,
    /// Override a key of the file: --set stage.0.sigma=25, --set data.path=traffic48.mat (a path given so is looked up
    /// in the current folder, then in SCI_DATA)
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Where to write [default: runs/<name>]. Only files that a record.json there lists are replaced or removed
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Go on with the run that was stopped in the folder; with the same experiment only. Where nothing is unfinished, says so,
    /// and begins if there are no results
    #[arg(long)]
    resume: bool,
    /// Throw the run away that was stopped in the folder, and begin
    #[arg(long, conflicts_with = "resume")]
    restart: bool,
}

impl Args {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        let begin = Instant::now();
        let experiment = config::load(&self.config, &self.set)?;
        let out = self.out.clone().unwrap_or_else(|| Path::new("runs").join(&experiment.name));
        check_folder(&out)?;
        refuse_inputs(&out, &experiment.inputs())?;
        catch_interrupts()?;
        let (mut scene, chosen) = scene_and_choice(&experiment)?;
        let found = shown_on_a_bar(|watch| solve::calibrate(&experiment, &mut scene, &chosen, watch));
        let calibration = match found {
            Err(_) if interrupted() => return Ok(Done::Interrupted),
            calibration => calibration?,
        };
        calibration.iter().flat_map(Calibration::lines).for_each(|line| outln!("{line}"));
        let mut factory = Factory::new(&experiment, scene.cfa)?;
        let shape = result_shape(&scene);
        let all = [chosen.len() * shape[0], shape[1], shape[2], shape[3]];
        experiment.output.format.holds(all).map_err(|e| UsageError(format!("output.format: {e}")))?;
        let plan = RunPlan {
            identity: identity(&experiment, &scene, &factory, &chosen)?,
            files: results::files(&experiment, &factory, shape[0], &chosen),
            measurements: chosen.clone(),
        };
        // A folder that cannot be written should not be found out after hours of solving.
        let Some(mut folder) = RunFolder::open(&out, &plan, self.wish())? else {
            outln!("nothing is unfinished: {} holds the results of this run", out.display());
            return Ok(Done::Complete);
        };
        self.announce(&experiment, &scene, chosen.len(), &folder, &out);
        let solved = solve(&experiment, &scene, &chosen, &mut factory, &mut folder);
        let stopped = folder.finished().iter().filter(|f| f.is_whole()).count();
        let run = results::Results {
            experiment: &experiment,
            scene: &scene,
            factory: &factory,
            out: &out,
            begin,
            calibration,
        };
        let done = solved.and_then(|()| run.finish(folder, chosen.len()));
        if done.is_err() && stopped > 0 && RunFolder::is_stopped_in(&out) {
            eprintln!(
                "{stopped} of {} measurements are kept in {}: add --resume to go on",
                chosen.len(),
                out.display()
            );
        }
        done
    }

    fn wish(&self) -> Wish {
        match (self.resume, self.restart) {
            (true, _) => Wish::Resume,
            (false, true) => Wish::Restart,
            (false, false) => Wish::New,
        }
    }

    fn announce(&self, experiment: &Experiment, scene: &Scene, count: usize, folder: &RunFolder, out: &Path) {
        let plural = if count == 1 { "" } else { "s" };
        outln!(
            "{} on {}: {} + {}, {count} measurement{plural} of {}",
            experiment.name,
            experiment.scene_name(),
            experiment.solver.kind,
            experiment.denoiser_kinds(),
            scene.operator.shape()
        );
        match folder.finished().len() {
            0 if self.resume => outln!("nothing is unfinished in {}: beginning", out.display()),
            0 => {}
            solved => outln!("going on: {solved} of {count} are solved"),
        }
    }
}

/// Solves what is left, with the pictures made meanwhile.
fn solve(
    experiment: &Experiment,
    scene: &Scene,
    chosen: &[usize],
    factory: &mut Factory<'_>,
    folder: &mut RunFolder,
) -> anyhow::Result<()> {
    let limit = experiment.output.report_megabytes as usize * 1_000_000;
    let studio = Studio { scene, output: experiment.output, report_bytes: limit / chosen.len().max(1) };
    let before: Vec<Finished> = folder.finished().to_vec();
    studio.in_step(&before, |show| solving::solve_all(experiment, scene, chosen, factory, folder, show))
}

/// Everything that the bits of a run depend on.
fn identity(
    experiment: &Experiment,
    scene: &Scene,
    factory: &Factory<'_>,
    chosen: &[usize],
) -> anyhow::Result<serde_json::Value> {
    let mut sum = crc32fast::Hasher::new();
    scene.measurements.iter().for_each(|y| sum.update(&y.to_le_bytes()));
    Ok(json!({
        "version": host::VERSION,
        "kernel": factory.kernel()?,
        "measurements": chosen,
        "checksum of the data": format!("{:08x}", sum.finalize()),
        "config": experiment.to_json(),
    }))
}

/// `[T, C, H, W]` of the result of a measurement.
fn result_shape(scene: &Scene) -> [usize; 4] {
    let VideoShape { frames, height, width } = scene.operator.shape();
    [frames, if scene.cfa.is_some() { 3 } else { 1 }, height, width]
}

/// The scene of an experiment, whose oddities are told, and the measurements of it that are wanted.
pub(super) fn scene_and_choice(experiment: &Experiment) -> anyhow::Result<(Scene, Vec<usize>)> {
    let scene = read_scene(experiment).context("data.path")?;
    scene.warnings.iter().for_each(|w| eprintln!("warning: {}: {w}", experiment.data.path.display()));
    let chosen = solve::choose(experiment, &scene).map_err(UsageError)?;
    Ok((scene, chosen))
}

/// The scene that an experiment names, simulated if it says so.
pub(super) fn read_scene(experiment: &Experiment) -> anyhow::Result<Scene> {
    let data = &experiment.data;
    let Some(s) = &data.simulate else { return Ok(scene::read(&data.path, &data.reading)?) };
    let scene::Video { frames: video, mut notes } = match data.reading.cfa {
        None => scene::read_gray_video(&data.path, &data.reading)?,
        Some(_) => scene::read_video(&data.path, &data.reading)?,
    };
    let (_, channels, height, width) = video.dim();
    // A single channel of a color sensor is its mosaic.
    let truth = if channels == 3 { Truth::Rgb(video) } else { Truth::Sensor(video.index_axis_move(Axis(1), 0)) };
    let masks = masks(s, &data.reading, (height, width), &mut notes)?;
    let file = data.path.display().to_string();
    let mut scene = simulate(&file, &data.reading.keys, masks.clone(), truth, data.reading.cfa, &s.camera)?;
    scene::as_read(&mut scene, masks, &data.reading)?;
    notes.append(&mut scene.warnings);
    scene.warnings = notes;
    Ok(scene)
}

fn masks(
    s: &Simulate,
    reading: &scene::Reading,
    (height, width): (usize, usize),
    notes: &mut Vec<String>,
) -> anyhow::Result<sci_forward::MaskStack> {
    use sci_forward::MaskStack;
    let shape = |frames| VideoShape { frames, height, width };
    let of = |r: &RandomMask, masks: MaskStack| if r.signed { masks.differential() } else { masks };
    Ok(match &s.mask {
        MaskSource::Random(r) => of(r, MaskStack::random(shape(r.frames), r.density, r.seed)?),
        MaskSource::Shifting(r) => of(r, MaskStack::shifting(shape(r.frames), r.density, r.seed)?),
        MaskSource::File(path) => {
            let (masks, said) = scene::read_mask(path, reading)?;
            notes.extend(said);
            masks
        }
    })
}
