//! `[[stage]]`, `[schedules]` and `schedule`: which denoiser is called how often, with which σ.

use toml::Value;

use crate::parts::{self, Chosen, Part};
use crate::table::{ConfigError, MAX_ITERATIONS, SIGMAS, Source, Table, as_number, sigma};

/// A stage to run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stage {
    /// σ in `[0, 1]`, if the denoiser has one.
    pub sigma: Option<f32>,
    /// Iterations.
    pub iterations: usize,
    /// Which denoiser.
    pub denoiser: usize,
}

/// σ of the stages that `sigma = "auto"` stands for, in 0..255 units. Which of them are run, and for how long, the held-out
/// pixels decide.
const AUTO: [f64; 4] = [50.0, 25.0, 12.0, 6.0];

/// The tables of a schedule.
pub(super) struct Tables<'s> {
    /// `[denoiser]`.
    default: Option<Table<'s>>,
    unnamed: Vec<Table<'s>>,
    named: Vec<(String, Vec<Table<'s>>)>,
    /// `schedule`.
    chosen: Option<String>,
    /// The legal ones.
    names: String,
}

impl<'s> Tables<'s> {
    /// Takes them out of the experiment.
    pub(super) fn take(t: &mut Table<'s>) -> Result<Self, ConfigError> {
        let (default, unnamed) = (t.table("denoiser")?, t.list("stage")?);
        let mut schedules = t.table_or_empty("schedules")?;
        let keys = schedules.keys();
        let names = if keys.is_empty() { "none, as there is no [schedules]".to_owned() } else { keys.join(", ") };
        let chosen = t.text("schedule", &names, |c| keys.iter().any(|key| key == c));
        let named = keys.into_iter().map(|key| Ok((key.clone(), schedules.list(&key)?)));
        Ok(Self { default, unnamed, named: named.collect::<Result<_, ConfigError>>()?, chosen, names })
    }

    /// The denoisers and the stages to run: those of the schedule that is chosen, else the unnamed ones. All must be legal.
    pub(super) fn read(self, source: &Source, skips: bool) -> Result<(Vec<Chosen>, Vec<Stage>), ConfigError> {
        let Self { default, unnamed, named, chosen, names } = self;
        let denoisers: Vec<Chosen> = default.map(parts::read).transpose()?.into_iter().collect();
        let has_default = !denoisers.is_empty();
        let mut reader = Reader { denoisers, has_default, skips };
        let mut stages = None;
        let has_names = !named.is_empty();
        for (name, tables) in named {
            let read = reader.stages(tables)?;
            stages = stages.or((chosen.as_ref() == Some(&name)).then_some(read));
        }
        let unnamed = reader.stages(unnamed)?;
        let stages = stages.unwrap_or(unnamed);
        if stages.is_empty() {
            let choose = if has_names { format!(", or schedule = one of {names}") } else { String::new() };
            return Err(
                source.file_error(format!("no [[stage]]: at least one is needed, for example iterations = 40{choose}"))
            );
        }
        if has_default && stages.iter().all(|s| s.denoiser != 0) {
            return Err(source.file_error("[denoiser] has no effect: every [[stage]] names its own"));
        }
        Ok(in_use(reader.denoisers, stages))
    }
}

struct Reader {
    /// The default first, if there is one.
    denoisers: Vec<Chosen>,
    has_default: bool,
    skips: bool,
}

impl Reader {
    fn stages(&mut self, tables: Vec<Table<'_>>) -> Result<Vec<Stage>, ConfigError> {
        let mut stages = Vec::new();
        for table in tables {
            stages.extend(table.read(|t| self.stage(t))?.0);
        }
        Ok(stages)
    }

    /// A `[[stage]]`, or as many as it has σ.
    fn stage(&mut self, t: &mut Table<'_>) -> Result<Vec<Stage>, ConfigError> {
        let denoiser = match t.table("denoiser")? {
            Some(own) => {
                self.denoisers.push(parts::read(own)?);
                self.denoisers.len() - 1
            }
            None if self.has_default => 0,
            None => {
                return Err(t.error(format!("`{}` has no denoiser, and there is no [denoiser] table", t.key())));
            }
        };
        let sigmas = self.sigmas(t, self.denoisers[denoiser].part.as_ref());
        let iterations = t.required_whole("iterations", 0..=MAX_ITERATIONS);
        Ok(sigmas.into_iter().map(|sigma| Stage { sigma, iterations, denoiser }).collect())
    }

    fn sigmas(&self, t: &mut Table<'_>, part: &dyn Part) -> Vec<Option<f32>> {
        if let Some(instead) = part.instead_of_sigma() {
            if t.given("sigma") {
                t.refuse("sigma", &format!("has no effect: its denoiser is {instead}"));
            }
            return vec![None];
        }
        let legal = if t.holds_list("sigma") {
            "numbers from 0 to 255 in a list, in units of an 8-bit picture, one for each stage"
        } else {
            "a number from 0 to 255, in units of an 8-bit picture"
        };
        let (given, mut auto) = (t.holds("sigma"), false);
        let one = |v: &Value| as_number(v).filter(|sigma| SIGMAS.contains(sigma));
        let found: Option<Vec<f64>> = t.legal("sigma", legal, |v| match v {
            Value::String(word) if word == "auto" => {
                auto = true;
                Some(AUTO.to_vec())
            }
            Value::Array(list) => list.iter().map(one).collect::<Option<Vec<_>>>().filter(|sigmas| !sigmas.is_empty()),
            _ => Some(vec![one(v)?]),
        });
        if !given {
            t.refuse("sigma", "is missing; legal: 0 to 255, in units of an 8-bit picture");
        }
        if auto && !self.skips {
            t.refuse("sigma", "= \"auto\" is decided by held-out pixels: it needs skip.enabled = true");
        }
        if auto && part.network().is_some_and(|network| network.for_iterates()) {
            t.refuse("sigma", "= \"auto\" is for networks of any σ; this one was trained for the σ of its schedule");
        }
        found.unwrap_or_default().into_iter().map(|in_file| Some(sigma(in_file))).collect()
    }
}

/// Leaves out the denoisers of schedules that are not run, so that nothing is loaded for them.
fn in_use(denoisers: Vec<Chosen>, mut stages: Vec<Stage>) -> (Vec<Chosen>, Vec<Stage>) {
    let (mut kept, mut used) = (Vec::new(), Vec::new());
    for (index, denoiser) in denoisers.into_iter().enumerate() {
        if stages.iter().any(|s| s.denoiser == index) {
            kept.push(denoiser);
            used.push(index);
        }
    }
    for stage in &mut stages {
        stage.denoiser = used.iter().position(|i| *i == stage.denoiser).unwrap_or(0);
    }
    (kept, stages)
}
