//! Owns an experiment: its tables put together, the rules between them, and what the record shows of it.
//!
//! Denoisers are in [`parts`](crate::parts), solvers in [`solvers`], the tables that are always there in a file each
//! here. What is read is in range, complete and has an effect, so that no other code has to doubt a value; an error names the file and
//! line (or the `--set` argument), the key, the value and what is legal.

pub mod camera;
mod data;
mod online;
mod output;
mod skip;
mod stage;

use std::path::Path;

use ::online::AdaptLoss;
use admm::HoldOut;
use nets::unrolled::Recipe;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::bands::Footprint;
use crate::io::scene::SensorNoise;
use crate::parts::{Chosen, Demosaicer, Part, first_of_all};
use crate::shipped;
use crate::solvers::{self, Solver, Start};
use crate::table::{Paths, Source, Table};

pub use crate::table::ConfigError;
pub(crate) use data::AXES;
pub use data::{Calibration, Data, MaskSource, PATTERNS, RandomMask, Simulate};
pub use online::Online;
pub use output::Output;
pub use skip::Skip;
pub use stage::Stage;

/// What reading a gray scene and solving it take without the denoiser, measured.
const SOLVING_GRAY: Footprint = Footprint { of_frame_pixel: 32, of_pixel: 16, of_frame: 0, fixed: 0 };
/// The same of a color sensor, demosaicing included.
const SOLVING_COLOR: Footprint = Footprint { of_frame_pixel: 64, of_pixel: 40, of_frame: 0, fixed: 0 };
/// What each call of a solve that a gradient goes through takes for each pixel of each frame of a crop, measured.
const LEARNING_THROUGH_A_CALL: usize = 200;

/// An experiment ready to run.
#[derive(Debug)]
pub struct Experiment {
    /// Name, a relative path such as `gray/gap-tv`.
    pub name: String,
    /// Seed of everything random.
    pub seed: u64,
    /// Where the measurements come from.
    pub data: Data,
    /// The solver.
    pub solver: Solver,
    /// All denoisers.
    pub denoisers: Vec<Chosen>,
    /// The stages.
    pub stages: Vec<Stage>,
    /// Stop once the relative change is at most this; 0 never.
    pub relative_change: f64,
    /// Stop a measurement after so many seconds.
    pub seconds: Option<f64>,
    /// What is left out, if anything may be.
    pub skip: Option<Skip>,
    /// How networks adapt, if they do.
    pub online: Option<Online>,
    /// The solve that they learn through, where they do so before it.
    pub recipe: Option<Recipe>,
    /// The network that takes over from the one that learned, among the denoisers, and the whole solve.
    pub successor: Option<(usize, Recipe)>,
    /// The memory that a solve may take, in bytes, if it is limited.
    pub memory: Option<usize>,
    /// The pixels that a solve is not given and that judge it, if there are any: with `[skip]` or `judge`.
    pub judge: Option<HoldOut>,
    /// What to write.
    pub output: Output,
    /// The keys of its tables, defaults filled in.
    json: Value,
    /// What it was read from.
    written: Written,
}

/// An experiment as it was written, so that a record can be run again.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Written {
    /// Its file.
    #[serde(flatten)]
    pub file: WrittenFile,
    /// The files that it extends, nearest first.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub extends: Vec<WrittenFile>,
    /// The `--set` arguments.
    pub set: Vec<String>,
}

/// A file as it was when it was read.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct WrittenFile {
    /// Where it was, absolute.
    pub file: String,
    /// Its text.
    pub text: String,
}

/// Reads an experiment file, or one that was [`shipped`] by its name, with `--set` arguments applied.
///
/// # Errors
/// [`ConfigError`] naming the place, the key, the value and what is legal.
pub fn load(path: &Path, arguments: &[String]) -> Result<Experiment, ConfigError> {
    from_source(&open(path, arguments)?, Paths::LookedUp, arguments)
}

/// The same for a scene that is in memory: what its `[data]` says of files need not be there, or be at all.
///
/// # Errors
/// As [`load`], and if `[data]` asks for another scene than the one in memory.
pub fn load_for_arrays(path: &Path, arguments: &[String]) -> Result<Experiment, ConfigError> {
    let source = open(path, arguments)?;
    let experiment = from_source(&source, Paths::AllButScene, arguments)?;
    let data = &experiment.data;
    let other = [
        ("data.kind", data.simulate.is_some()),
        ("data.mask", data.reading.mask.is_some()),
        ("data.raw", data.reading.raw.is_some()),
    ];
    match other.into_iter().find(|(_, given)| *given) {
        Some((key, _)) => Err(source.error_at(key, format!("`{key}` has no effect on arrays: they are the scene"))),
        None => Ok(experiment),
    }
}

fn open(path: &Path, arguments: &[String]) -> Result<Source, ConfigError> {
    Source::read(&shipped::located(path), "experiment", arguments)
}

/// Reads an experiment from a record; its files need not be there any more.
///
/// # Errors
/// As [`load`].
pub fn load_written(written: &Written) -> Result<Experiment, ConfigError> {
    let held = |path: &Path| written.extends.iter().find(|base| Path::new(&base.file) == path);
    let read = |path: &Path| held(path).map(|base| base.text.clone()).ok_or("the record does not hold it".to_owned());
    let source = Source::new(written.file.file.as_ref(), &written.file.text, &written.set, &read)?;
    from_source(&source, Paths::LookedUp, &written.set)
}

/// Checks everything but whether files are where they are said to be.
///
/// # Errors
/// The first mistake.
pub fn check(source: &Source) -> Result<Experiment, ConfigError> {
    read(source, Paths::AsWritten, &[])
}

/// A file that is missing is told only of an experiment that is right otherwise.
fn from_source(source: &Source, paths: Paths, arguments: &[String]) -> Result<Experiment, ConfigError> {
    check(source)?;
    read(source, paths, arguments)
}

/// The tables of an experiment before they are read.
struct Tables<'s> {
    name: Option<String>,
    seed: u64,
    memory: Option<usize>,
    judge: bool,
    data: Option<Table<'s>>,
    solver: Option<Table<'s>>,
    schedule: stage::Tables<'s>,
    stop: Table<'s>,
    skip: Option<Table<'s>>,
    online: Option<Table<'s>>,
    /// Whether `output` is the word `minimal`, and the table if it is none.
    output: (bool, Table<'s>),
}

impl<'s> Tables<'s> {
    fn take(t: &mut Table<'s>) -> Result<Self, ConfigError> {
        let legal = "letters, digits, '.', '_' and '-', in parts joined by '/'";
        let part_ok = |p: &str| {
            !p.is_empty() && !p.starts_with('.') && p.chars().all(|c| c.is_ascii_alphanumeric() || "._-".contains(c))
        };
        Ok(Self {
            name: t.text("name", legal, |n| n.split('/').all(part_ok)),
            seed: t.seed("seed", 0),
            memory: t.legal("memory", MEMORY, |v| v.as_str().and_then(bytes)),
            judge: t.flag("judge", false),
            data: t.table("data")?,
            solver: t.table("solver")?,
            schedule: stage::Tables::take(t)?,
            stop: t.table_or_empty("stop")?,
            skip: t.table("skip")?,
            online: t.table("online")?,
            output: (t.word("output", "minimal"), t.table_or_empty("output")?),
        })
    }
}

/// Legal `memory`.
const MEMORY: &str =
    "a number with its unit from \"128 MB\" to \"64 TB\": MB, GB or TB, MiB, GiB or TiB, for example \"4 GiB\"";

/// How many bytes a text such as `4 GiB` means.
fn bytes(text: &str) -> Option<usize> {
    let at = text.find(|c: char| c.is_ascii_alphabetic())?;
    let unit = match text[at..].trim_end() {
        "MB" => 1e6,
        "GB" => 1e9,
        "TB" => 1e12,
        "MiB" => 1_048_576.0,
        "GiB" => 1_073_741_824.0,
        "TiB" => 1_099_511_627_776.0,
        _ => return None,
    };
    let bytes = text[..at].trim().parse::<f64>().ok()? * unit;
    (128e6..=64e12).contains(&bytes).then_some(bytes as usize)
}

fn read(source: &Source, paths: Paths, arguments: &[String]) -> Result<Experiment, ConfigError> {
    let (tables, _) = Table::root(source, paths)?.read(Tables::take)?;
    let missing = |key: &str| source.file_error(format!("no [{key}] table"));
    let stem = || source.path().file_stem().map_or("experiment".into(), |s| s.to_string_lossy().into_owned());
    let (name, seed, memory) = (tables.name.unwrap_or_else(stem), tables.seed, tables.memory);
    let judge = tables.judge.then_some(HoldOut { seed, decides: false, ..HoldOut::default() });
    let (data, data_json) = tables.data.ok_or_else(|| missing("data"))?.read(|t| Data::read(t, seed))?;
    let solver = solvers::read(tables.solver.ok_or_else(|| missing("solver"))?)?;
    let (mut skip, mut skip_json) = unless_off(tables.skip, |t| Skip::read(t, seed))?;
    let (denoisers, stages) = tables.schedule.read(source, skip.is_some())?;
    if let Some(skip) = &mut skip {
        skip.keep_trained_sigmas(&denoisers);
        skip_json["overshoot"] = skip.hold_out.overshoot.into();
    }
    let (online, online_json) = unless_off(tables.online, |t| Online::read(t, seed, &denoisers))?;
    let ((relative_change, seconds), stop_json) = tables
        .stop
        .read(|t| Ok((t.number("relative_change", 0.0, 0.0..=1.0), t.optional_number("seconds", 1e-3..=1e6))))?;
    let (minimal, output) = tables.output;
    let (output, output_json) = output.read(|t| Ok(Output::read(t, minimal)))?;
    let mut json = json!({
        "name": name, "seed": seed, "data": data_json, "stop": stop_json, "skip": skip_json, "online": online_json,
        "output": output_json,
    });
    if let Some(memory) = memory {
        json["memory"] = memory.into();
    }
    if judge.is_some() {
        json["judge"] = true.into();
    }
    let written = Written::of(source, arguments);
    let mut experiment = Experiment {
        name,
        seed,
        data,
        solver,
        denoisers,
        stages,
        relative_change,
        seconds,
        skip,
        online,
        recipe: None,
        successor: None,
        memory,
        judge: skip.map(|skip| skip.hold_out).or(judge),
        output,
        json,
        written,
    };
    let why = experiment.denoisers.iter().find_map(|denoiser| denoiser.part.against_tiles());
    if let (Some(why), true) = (why, experiment.skip.is_some_and(|skip| skip.tiles)) {
        return Err(source.error_at("skip.tiles", format!("`skip.tiles` is true, but {why}; legal: false")));
    }
    experiment.set_recipe().map_err(|(key, problem)| source.error_at(key, format!("`{key}` {problem}")))?;
    experiment.begin_with_tv();
    Ok(experiment)
}

/// Reads a table that need not be there and can be switched off.
fn unless_off<T>(
    table: Option<Table<'_>>,
    read: impl FnOnce(&mut Table<'_>) -> Option<T>,
) -> Result<(Option<T>, Value), ConfigError> {
    match table.map(|t| t.read(|t| Ok(read(t)))).transpose()? {
        Some((Some(value), json)) => Ok((Some(value), json)),
        _ => Ok((None, json!({ "enabled": false }))),
    }
}

impl Written {
    fn of(source: &Source, arguments: &[String]) -> Self {
        let file = |(path, text): (&Path, &str)| {
            let absolute =
                Some(path).filter(|path| !shipped::is_shipped(path)).and_then(|p| std::path::absolute(p).ok());
            let absolute = absolute.unwrap_or_else(|| path.to_owned());
            WrittenFile { file: absolute.to_string_lossy().into_owned(), text: text.to_owned() }
        };
        let mut files = source.files().map(file);
        Self {
            file: files.next().expect("a source begins with a file"),
            extends: files.collect(),
            set: arguments.to_vec(),
        }
    }
}

impl Experiment {
    /// For measurement splitting, the solve to learn through.
    ///
    /// # Errors
    /// The key that does not fit, and what is wrong with it.
    fn set_recipe(&mut self) -> Result<(), (&'static str, String)> {
        if !self.online.is_some_and(|online| matches!(online.adapt.loss, AdaptLoss::Split(_))) {
            return Ok(());
        }
        let start = match self.solver.start {
            Start::Mean => Some(None),
            Start::Tv { iterations, weight } => Some(Some((iterations, weight))),
            Start::Adjoint | Start::Previous => None,
        };
        let first = self.stages.first().map_or(0, |stage| stage.denoiser);
        let part = &self.denoisers[first].part;
        // What it is adapted to is the solve as far as the network makes it; others may take over from it.
        let leading = self.stages.iter().take_while(|stage| stage.denoiser == first).count();
        let returns = self.stages[leading..].iter().any(|stage| stage.denoiser == first);
        let leads = part.adapts() && !returns && !self.denoisers[..first].iter().any(|d| d.part.adapts());
        let accelerate = self.solver.method.unrolled();
        let through = "but online.loss = \"split\" learns through";
        let rules = [
            (self.solver.kind == "gap", "solver.kind", format!("is another, {through} GAP; legal: gap")),
            (
                accelerate.is_some(),
                "solver.momentum",
                format!("is zero, {through} momentum from y; legal: measurement, or solver.accelerate = false"),
            ),
            (start.is_some(), "solver.start", format!("is another, {through} solves from these; legal: mean, tv")),
            (
                self.solver.demosaicer() == Demosaicer::Menon,
                "solver.demosaicer",
                format!("is another, {through} Menon's; legal: menon"),
            ),
            (
                leads,
                "denoiser",
                format!(
                    "is another, {through} the calls of one network, which come before all others; legal: ffdnet, fastdvdnet, shiftnet"
                ),
            ),
        ];
        if let Some((_, key, problem)) = rules.into_iter().find(|(holds, ..)| !holds) {
            return Err((key, problem));
        }
        let sigma = |stage: &Stage| std::iter::repeat_n(stage.sigma.unwrap_or(0.0), stage.iterations);
        let recipe = accelerate.zip(start).map(|(accelerate, start)| Recipe {
            sigmas: self.stages[..leading].iter().flat_map(sigma).collect(),
            accelerate,
            start,
            flips: part.network().is_some_and(|network| network.flips),
            dim: part.network().map_or(1.0, |network| network.dim),
        });
        // Of what else takes over it cannot be told whether it is to.
        let next = self.stages.get(leading).map(|stage| stage.denoiser);
        let alike = |next: &usize| {
            let seen = |part: &dyn Part| part.network().map(|network| (network.flips, network.dim));
            seen(&*self.denoisers[*next].part) == seen(&**part)
                && self.stages[leading..].iter().all(|stage| stage.denoiser == *next)
        };
        self.successor = next.filter(alike).zip(recipe.clone()).map(|(next, recipe)| {
            let sigmas = self.stages.iter().flat_map(sigma).collect();
            (next, Recipe { sigmas, ..recipe })
        });
        self.recipe = recipe;
        Ok(())
    }

    /// Where `[skip]` may, lets TV go first where a network would that is told a σ: as a stage of its own from the mean, for as
    /// long as it pays, so that the network begins where TV ends.
    fn begin_with_tv(&mut self) {
        let first = self.stages.first().map(|stage| &self.denoisers[stage.denoiser].part);
        let waits = first.is_some_and(|part| part.network().is_some() && part.instead_of_sigma().is_none());
        if waits && self.skip.is_some_and(|s| s.cheap_first) && self.solver.begin_with_tv() {
            self.stages.insert(0, Stage { sigma: None, iterations: 16, denoiser: self.denoisers.len() });
            self.denoisers.push(first_of_all());
        }
    }

    /// What reading and solving a scene take at most; of a color sensor's if `is_color`.
    pub fn footprint(&self, is_color: bool) -> Footprint {
        let solver = if is_color { SOLVING_COLOR } else { SOLVING_GRAY };
        // A network that demosaics is as large as the largest denoiser.
        let demosaicer = self.solver.demosaicer.as_ref().and_then(|d| d.weights());
        let demosaicer = demosaicer.map(|_| Footprint { of_frame_pixel: 32, of_pixel: 1250, ..Footprint::default() });
        let parts = self.denoisers.iter().map(|d| d.part.footprint(is_color)).chain(demosaicer);
        // Not all of what learning took can be given back, so that it adds to what solving takes.
        parts.fold(
            Footprint { of_frame_pixel: solver.of_frame_pixel, of_pixel: solver.of_pixel, ..self.learning() },
            |most, part| Footprint {
                of_frame_pixel: most.of_frame_pixel.max(solver.of_frame_pixel + part.of_frame_pixel),
                of_pixel: most.of_pixel.max(solver.of_pixel + part.of_pixel),
                ..most
            },
        )
    }

    /// What learning from crops takes: nothing of what the size of the scene decides.
    fn learning(&self) -> Footprint {
        let Some(AdaptLoss::Split(split)) = self.online.map(|online| online.adapt.loss) else {
            return Footprint::default();
        };
        let pixels = split.crops * split.side.pow(2);
        let networks = self.denoisers.iter().filter(|d| d.part.adapts()).map(|d| d.part.learning());
        networks.fold(Footprint::default(), |most, network| Footprint {
            of_frame: most.of_frame.max(pixels * (network.of_frame_pixel + split.calls * LEARNING_THROUGH_A_CALL)),
            fixed: most.fixed.max(network.fixed + pixels * network.of_pixel),
            ..most
        })
    }

    /// What needs the whole of a scene at once, if anything does: a key, and why.
    pub fn needs_whole(&self) -> Option<(&'static str, &'static str)> {
        let (data, sensor) = (&self.data, &self.data.reading.sensor);
        let reasons = [
            (
                "data.kind",
                data.simulate.is_some(),
                "a simulated scene is made as a whole; `sci simulate` writes it to a file",
            ),
            ("data.sensor.dark", sensor.dark.is_some(), "a dark frame is read as a whole"),
            ("data.sensor.white", sensor.white.is_some(), "a white frame is read as a whole"),
            ("data.sensor.noise", sensor.noise == SensorNoise::Auto, "noise is estimated from the whole"),
            ("data.mask_shift", data.reading.shift.is_some(), "a moving mask is moved as a whole"),
            ("data.raw", data.reading.raw.is_some(), "a file without a header is read as a whole"),
            ("data.calibration", data.calibration != Calibration::None, "masks are calibrated as a whole"),
            ("solver.start", self.solver.start == Start::Previous, "the result before is kept as a whole"),
            (
                "online.loss",
                self.online.is_some() && self.recipe.is_none(),
                "networks would be updated in every band anew; \"split\" learns once, before the solve",
            ),
        ];
        reasons.into_iter().find(|(_, holds, _)| *holds).map(|(key, _, why)| (key, why))
    }

    /// The file or folder name of the data, as the run record's `scene`.
    pub fn scene_name(&self) -> String {
        let path = &self.data.path;
        path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned())
    }

    /// The denoisers' kinds in the order of the stages, repeated ones once, joined by ` → `.
    pub fn denoiser_kinds(&self) -> String {
        let mut kinds: Vec<&str> = self.stages.iter().map(|s| self.denoisers[s.denoiser].kind).collect();
        kinds.dedup();
        kinds.join(" → ")
    }

    /// Every file and folder it reads, with its key.
    pub fn inputs(&self) -> Vec<(&'static str, &Path)> {
        let demosaicer = self.solver.demosaicer.as_ref().and_then(|d| d.weights());
        let networks =
            self.denoisers.iter().filter_map(|d| Some(("denoiser.weights", d.part.network()?.weights.as_path())));
        let all = [("data.path", self.data.path.as_path())]
            .into_iter()
            .chain(self.data.other_files())
            .chain(demosaicer.map(|path| ("solver.weights", path)))
            .chain(networks);
        all.filter(|(_, path)| !path.to_string_lossy().starts_with("bundled:")).collect()
    }

    /// [`Experiment::to_json`] and what it was read from, so that it can be run again.
    pub fn record_json(&self) -> Value {
        let mut value = self.to_json();
        value["written"] = json!(self.written);
        value
    }

    /// The resolved experiment for the run record, with the keys of the TOML; σ in `[0, 1]`, paths absolute.
    pub fn to_json(&self) -> Value {
        let stage = |s: &Stage| json!({ "sigma": s.sigma, "iterations": s.iterations, "denoiser": s.denoiser });
        let mut value = self.json.clone();
        value["solver"] = self.solver.json.clone();
        value["denoisers"] = self.denoisers.iter().map(|d| d.json.clone()).collect();
        value["stage"] = self.stages.iter().map(stage).collect();
        value
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;

    fn configs() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs")
    }

    #[test]
    fn every_shipped_experiment_is_right() {
        let mut checked = 0;
        for folder in ["gray", "color", "real", "large", "bench", "."] {
            for entry in std::fs::read_dir(configs().join(folder)).unwrap() {
                let path = entry.unwrap().path();
                if path.extension().is_some_and(|e| e == "toml") && !path.ends_with("expected.toml") {
                    let experiment = check(&Source::read(&path, "experiment", &[]).unwrap()).unwrap();
                    // What the record shows is what the file says, under the same keys.
                    let shown = experiment.to_json();
                    assert_eq!(shown["solver"]["kind"], experiment.solver.kind, "{}", path.display());
                    assert_eq!(shown["denoisers"][0]["kind"], experiment.denoisers[0].kind, "{}", path.display());
                    checked += 1;
                }
            }
        }
        assert!(checked > 20, "{checked}");
    }

    #[test]
    fn the_record_shows_every_key_with_its_default() {
        let text = "[data]\npath = 'a'\n[solver]\nkind = 'two-stage'\n[denoiser]\nkind = 'fastdvdnet'\nweights = 'b'\n\
                    [[stage]]\nsigma = 51\niterations = 3\n[online]\n[skip]\n";
        let source = Source::new("x/a.toml".as_ref(), text, &[], &|_| Err("no other files".into())).unwrap();
        let shown = check(&source).unwrap().to_json();
        let solver = json!({
            "kind": "two-stage", "start": "tv", "start_iterations": 40, "start_weight": 0.1, "rho": 1.0, "tau": 100.0,
            "convention": "paper-code", "demosaicer": null,
        });
        assert_eq!((&shown["name"], &shown["solver"]), (&json!("a"), &solver));
        let denoiser = json!({ "kind": "fastdvdnet", "weights": "b", "precision": "f32", "flips": false, "dim": 1.0, "ends": "circular" });
        assert_eq!(shown["denoisers"], json!([denoiser]));
        assert_eq!(shown["stage"], json!([{ "sigma": 0.2f32, "iterations": 3, "denoiser": 0 }]));
        let interval = ::online::AdaptConfig::default().schedule.interval;
        assert_eq!((&shown["online"]["interval"], &shown["skip"]["spacing"]), (&json!(interval), &json!(12)));
    }

    #[test]
    fn a_list_of_sigmas_is_that_many_stages() {
        let configs = configs();
        let stages = |more: &str| {
            let path = format!("data.path={}", configs.join("demo/bunny").display());
            let experiment = load(&configs.join("gray/refined.toml"), &[path, more.into()]).unwrap();
            experiment
                .stages
                .iter()
                .map(|s| (s.sigma.map(|sigma| sigma * 255.0), s.iterations, s.denoiser))
                .collect::<Vec<_>>()
        };
        let refined = stages("seed=0");
        assert_eq!(refined.len(), 15);
        assert_eq!(refined[..2], [(Some(20.0), 1, 0), (Some(17.0), 1, 0)]);
        assert_eq!(refined[12..], [(Some(7.0), 1, 1), (Some(12.0), 6, 2), (Some(8.0), 6, 2)]);
        let written_out = "stage=[{sigma=9.5,iterations=3},{sigma=4,iterations=3}]";
        assert_eq!(stages("stage=[{sigma=[9.5, 4],iterations=3}]"), stages(written_out));
    }
}
