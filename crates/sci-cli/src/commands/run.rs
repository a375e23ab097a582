//! `sci run`: an experiment from its file to a folder of results.

mod banded;
mod finishing;
mod solving;
mod subject;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;
use std::{fs, io};

use anyhow::Context;
use ndarray::Axis;
use sci_forward::VideoShape;
use serde_json::json;

use finishing::Ending;

use super::{Done, UsageError, catch_interrupts, check_folder, interrupted, shown_on_a_bar};
use crate::calibration::Calibration;
use crate::config::{self, Experiment, MaskSource, RandomMask, Simulate};
use crate::factory::Factory;
use crate::io::frames;
use crate::io::scene::{self, Scene, Truth};
use crate::pictures::Studio;
use crate::record::host;
use crate::run_folder::{self, About, Finished, Layout, RunFolder, RunPlan, Wish, checksum, refuse_inputs};
use crate::shard::{Shard, ranges};
use crate::simulate::simulate;
use crate::solve;
use subject::Subject;

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
    /// Solve part I of N of the measurements, to be joined by sci gather; the same again goes on where it was stopped. A task of a
    /// Slurm job array is a shard by itself; 1/1 is the whole run, there too
    #[arg(long, value_name = "I/N")]
    shard: Option<Shard>,
}

impl Args {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        let begin = Instant::now();
        let shard = self.shard()?;
        let experiment = config::load(&self.config, &self.set)?;
        let out = self.out(&experiment);
        check_folder(&out)?;
        refuse_inputs(&out, &experiment.inputs())?;
        catch_interrupts()?;
        let (mut subject, chosen) = Subject::open(&experiment, &out)?;
        let own = shard.map_or(&*chosen, |shard| shard.part(&chosen));
        if let (Some(shard), []) = (shard, own) {
            outln!("shard {shard} has nothing to do: there are {} measurements", chosen.len());
            return Ok(Done::Complete);
        }
        let calibration = match &mut subject {
            Subject::Cut(_) => None,
            Subject::Whole(scene) => {
                match shown_on_a_bar(|watch| solve::calibrate(&experiment, scene, &chosen, watch)) {
                    Err(_) if interrupted() => return Ok(Done::Interrupted),
                    calibration => calibration?,
                }
            }
        };
        let (calibration, note) = calibration.unzip();
        calibration.iter().flat_map(Calibration::lines).for_each(|line| outln!("{line}"));
        let note = note.flatten();
        note.iter().for_each(|note| say(&experiment, note));
        let warnings = subject.warnings().iter().chain(&note).cloned().collect();
        let mut factory = Factory::new(&experiment, subject.cfa())?;
        let layout = layout_of(&experiment, &subject, &factory);
        let all = [chosen.len() * layout.shape[0], layout.shape[1], layout.shape[2], layout.shape[3]];
        experiment.output.format.holds(all).map_err(|e| UsageError(format!("output.format: {e}")))?;
        let plan = self.plan(&experiment, &subject, &factory, &layout, &chosen, shard)?;
        // A folder that cannot be written should not be found out after hours of solving.
        let Some(mut folder) = RunFolder::open(&out, &plan, self.wish(shard))? else {
            outln!("nothing is unfinished: {} holds the results of this run", out.display());
            return Ok(Done::Complete);
        };
        self.announce(&experiment, &subject, own.len(), &folder, &out);
        if let Some(shard) = shard {
            announce_shard(shard, own, &chosen, factory.needs_previous());
        }
        let solved = solve(&experiment, &subject, (&chosen, own), &mut factory, &mut folder);
        let stopped = folder.finished().iter().filter(|f| f.is_whole()).count();
        let run = Ending {
            experiment: &experiment,
            factory: &factory,
            layout: &layout,
            out: &out,
            begin,
            calibration,
            checksums: plan.identity["checksums"].clone(),
            warnings,
            count: own.len(),
        };
        let done = solved.and_then(|()| match shard {
            None => run.finish(folder),
            Some(shard) => run.finish_shard(folder, shard),
        });
        if done.is_err() && stopped > 0 && RunFolder::is_stopped_in(&out) {
            let how = if shard.is_some() { "the same command goes on" } else { "add --resume to go on" };
            eprintln!("{stopped} of {} measurements are kept in {}: {how}", own.len(), out.display());
        }
        done
    }

    fn out(&self, experiment: &Experiment) -> PathBuf {
        self.out.clone().unwrap_or_else(|| Path::new("runs").join(&experiment.name))
    }

    /// The shard that is asked for, or that this is as a task of a job array; nothing for the whole run.
    fn shard(&self) -> Result<Option<Shard>, UsageError> {
        if let Some(shard) = self.shard {
            return Ok(Some(shard).filter(|shard| shard.count() > 1));
        }
        let shard = Shard::of_slurm(|name| std::env::var(name).ok()).map_err(UsageError)?;
        if let Some(shard) = shard {
            outln!(
                "shard {shard}, as this is a task of a Slurm job array; --shard 1/1 would solve all of the run here"
            );
        }
        Ok(shard)
    }

    fn wish(&self, shard: Option<Shard>) -> Wish {
        match (self.resume || shard.is_some(), self.restart) {
            (_, true) => Wish::Restart,
            (true, false) => Wish::Resume,
            (false, false) => Wish::New,
        }
    }

    fn plan(
        &self,
        experiment: &Experiment,
        subject: &Subject,
        factory: &Factory<'_>,
        layout: &Layout,
        chosen: &[usize],
        shard: Option<Shard>,
    ) -> anyhow::Result<RunPlan> {
        let mut identity = identity(experiment, subject, chosen)?;
        let kernel = factory.kernel()?;
        let about = About {
            layout: layout.clone(),
            reuses: factory.needs_previous(),
            command: self.command(experiment),
            cpus: vec![host::cpu()],
            kernels: vec![kernel.to_owned()],
            record: None,
        };
        // Machines of a cluster differ: of a shard the kernel is told, and in a run it must stay as it was.
        if shard.is_none() {
            identity["kernel"] = json!(kernel);
        }
        let (files, measurements) = (layout.files(chosen), chosen.to_vec());
        Ok(RunPlan { identity, files, measurements, shard: shard.map(|shard| (shard, about)) })
    }

    /// What to call for another shard of this run.
    fn command(&self, experiment: &Experiment) -> run_folder::Command {
        let mut words = vec!["sci".to_owned(), "run".to_owned(), self.config.display().to_string()];
        self.set.iter().for_each(|set| words.extend(["--set".to_owned(), set.clone()]));
        words.extend(["--out".to_owned(), self.out(experiment).display().to_string()]);
        run_folder::Command { folder: std::env::current_dir().unwrap_or_default().display().to_string(), words }
    }

    fn announce(&self, experiment: &Experiment, subject: &Subject, count: usize, folder: &RunFolder, out: &Path) {
        let plural = if count == 1 { "" } else { "s" };
        outln!(
            "{} on {}: {} + {}, {count} measurement{plural} of {}{}",
            experiment.name,
            experiment.scene_name(),
            experiment.solver.kind,
            experiment.denoiser_kinds(),
            subject.shape(),
            subject.in_bands()
        );
        match folder.finished().len() {
            0 if self.resume => outln!("nothing is unfinished in {}: beginning", out.display()),
            0 => {}
            solved => outln!("going on: {solved} of {count} are solved"),
        }
    }
}

/// Says which part of the run a shard is, and what is lost with the rest.
fn announce_shard(shard: Shard, own: &[usize], chosen: &[usize], reuses: bool) {
    let which = if own.len() == 1 { "measurement" } else { "measurements" };
    outln!("shard {shard}: {which} {}, {} of {}", ranges(own), own.len(), chosen.len());
    if reuses && own.first() != chosen.first() {
        eprintln!(
            "warning: a measurement takes over from the one before, but {} begins shard {shard} without: the results will not be \
             those of one machine",
            ranges(&own[..1])
        );
    }
}

/// Solves what is left of `own`, the part of the `chosen` measurements that is solved here, with the pictures made meanwhile.
fn solve(
    experiment: &Experiment,
    subject: &Subject,
    (chosen, own): (&[usize], &[usize]),
    factory: &mut Factory<'_>,
    folder: &mut RunFolder,
) -> anyhow::Result<()> {
    let scene = match subject {
        Subject::Whole(scene) => scene,
        Subject::Cut(cut) => return cut.solve_all(experiment, (chosen, own), factory, folder),
    };
    let limit = experiment.output.report_megabytes as usize * 1_000_000;
    let studio = Studio { scene, output: experiment.output, report_bytes: limit / chosen.len().max(1) };
    let before: Vec<Finished> = folder.finished().to_vec();
    studio.in_step(&before, |show| solving::solve_all(experiment, scene, own, factory, folder, show))
}

/// Of each file that it reads, by its key: masks, weights, a calibration, dark and white frames; of the data where it was read as a whole.
fn checksums_of_files(experiment: &Experiment, subject: &Subject) -> anyhow::Result<serde_json::Value> {
    let cut = matches!(subject, Subject::Cut(_));
    let mut sums = BTreeMap::<&str, crc32fast::Hasher>::new();
    for (key, path) in experiment.inputs().into_iter().filter(|(key, _)| !(cut && *key == "data.path")) {
        let sum = sums.entry(key).or_default();
        let files =
            files_of(path).and_then(|files| files.iter().map(|file| checksum(file)).collect::<io::Result<Vec<_>>>());
        let files = files.with_context(|| format!("{key}: {}", path.display()))?;
        files.iter().for_each(|of_file| sum.update(&of_file.to_le_bytes()));
    }
    let sums = sums.into_iter().map(|(key, sum)| (key.to_owned(), format!("{:08x}", sum.finalize()).into()));
    Ok(serde_json::Value::Object(sums.collect()))
}

/// The file itself, or the arrays of a folder, or its pictures; nothing of a pipe, which cannot be read twice.
fn files_of(path: &Path) -> io::Result<Vec<PathBuf>> {
    if !path.is_dir() {
        return Ok(Some(path.to_owned()).filter(|path| path.is_file()).into_iter().collect());
    }
    let mut files = fs::read_dir(path)?.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>()?;
    files.retain(|file| file.is_file() && file.extension().is_some_and(|e| e == "npy"));
    if files.is_empty() {
        return frames::list_all(path).map_err(io::Error::other);
    }
    files.sort();
    Ok(files)
}

/// Everything that the bits of a run depend on, but for the kernel.
fn identity(experiment: &Experiment, subject: &Subject, chosen: &[usize]) -> anyhow::Result<serde_json::Value> {
    Ok(json!({
        "version": host::VERSION,
        "measurements": chosen,
        "checksums": {
            "data": format!("{:08x}", subject.checksum(chosen)?),
            "files": checksums_of_files(experiment, subject)?,
        },
        "config": experiment.to_json(),
    }))
}

/// What the results are like.
fn layout_of(experiment: &Experiment, subject: &Subject, factory: &Factory<'_>) -> Layout {
    let saves = experiment.online.is_some_and(|o| o.save);
    let weights = if saves { factory.weight_files() } else { Vec::new() };
    Layout { shape: subject.result_shape(), unit: subject.unit(), output: experiment.output, weights }
}

/// Says what looks odd about the data of an experiment.
pub(super) fn say(experiment: &Experiment, note: &str) {
    eprintln!("warning: {}: {note}", experiment.data.path.display());
}

/// The scene of an experiment, whose oddities are told, and the measurements of it that are wanted.
pub(super) fn scene_and_choice(experiment: &Experiment) -> anyhow::Result<(Scene, Vec<usize>)> {
    let scene = read_scene(experiment).context("data.path")?;
    scene.warnings.iter().for_each(|note| say(experiment, note));
    let chosen = solve::choose(experiment, scene.len()).map_err(UsageError)?;
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
    let of = |r: &RandomMask, masks: MaskStack| if r.signed { masks.differential() } else { Ok(masks) };
    Ok(match &s.mask {
        MaskSource::Random(r) => of(r, MaskStack::random(shape(r.frames), r.density, r.seed)?)?,
        MaskSource::Shifting(r) => of(r, MaskStack::shifting(shape(r.frames), r.density, r.seed)?)?,
        MaskSource::File(path) => {
            let (masks, said) = scene::read_mask(path, reading)?;
            notes.extend(said);
            masks
        }
    })
}
