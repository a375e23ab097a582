//! Owns the rules: from keys to values that are in range, complete, and have an effect.

use std::ops::{Range, RangeInclusive};

use admm::{Convention, TwoStageParams, XStep};
use sci_forward::CfaPattern;
use toml::Value as Toml;

use super::adaptation::Online;
use super::denoising::Denoiser;
use super::file::*;
use super::skipping::{AUTO, Skip};
use super::source::{ConfigError, Source};
use crate::io::defects::Defects;
use crate::io::recon::VideoFormat;
use crate::io::scene::{Axes, Keys, Reading};

/// A path as written, with what is needed to look it up and to report it.
#[derive(Clone, Debug)]
pub struct PathSetting {
    /// Dotted key.
    pub key: String,
    /// As written.
    pub text: String,
    /// Where.
    pub span: Range<usize>,
}

/// `[data]`.
#[derive(Clone, Debug)]
pub struct Data {
    /// The scene or the video.
    pub path: PathSetting,
    /// The masks' own file.
    pub mask: Option<PathSetting>,
    /// Measurements to reconstruct, `None` for all.
    pub measurements: Option<Vec<usize>>,
    /// How to understand the file.
    pub reading: Reading,
    /// Set for `kind = "simulate"`.
    pub simulate: Option<Simulate>,
}

/// What turns a video into measurements.
#[derive(Clone, Debug)]
pub struct Simulate {
    /// The masks.
    pub mask: Mask,
    /// Gaussian noise, standard deviation in 0..255 units; 0 for none.
    pub sigma: f32,
    /// Photons per unit of y, `None` for no shot noise.
    pub photons: Option<f64>,
    /// Seed of the noise.
    pub seed: u64,
}

/// `[data.mask]`.
#[derive(Clone, Debug)]
pub enum Mask {
    /// Independent random pixels.
    Random(RandomMask),
    /// One random pattern, moved by a pixel a frame.
    Shifting(RandomMask),
    /// Masks from a file.
    File(PathSetting),
}

/// The parameters of random masks.
#[derive(Clone, Debug, PartialEq)]
pub struct RandomMask {
    /// B.
    pub frames: usize,
    /// Open fraction.
    pub density: f64,
    /// Seed.
    pub seed: u64,
}

/// Where a solve starts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Start {
    /// The measurement divided by the masks' sum.
    Mean,
    /// `Hᵀy`.
    Adjoint,
    /// The result of the measurement before; the first starts from the mean.
    Previous,
    /// A few iterations of ADMM-TV.
    Tv {
        /// Iterations.
        iterations: usize,
        /// TV weight.
        weight: f32,
    },
}

/// `[solver]`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Solver {
    /// Generalised alternating projection.
    Gap {
        /// `None` for plain GAP, else whether y1 starts from zero (the reference) or from the measurement.
        momentum: Option<Momentum>,
    },
    /// ADMM.
    Admm {
        /// γ.
        gamma: f32,
    },
    /// Two-stage ADMM, for color sensors.
    TwoStage {
        /// ρ, τ and the convention.
        params: TwoStageParams,
        /// How the RGB video is made from the mosaic.
        x_step: XStep,
    },
}

/// What fills in the colors that a mosaic lacks; `P` is how a path is known.
#[derive(Clone, Debug, PartialEq)]
pub enum Demosaicer<P> {
    /// Means of neighbours.
    Bilinear,
    /// Malvar 2004.
    Malvar,
    /// Menon 2007.
    Menon,
    /// A network.
    Ddnet {
        /// Weight file.
        weights: P,
    },
}

impl<P> Demosaicer<P> {
    /// The name that chooses it in TOML.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Bilinear => "bilinear",
            Self::Malvar => "malvar",
            Self::Menon => "menon",
            Self::Ddnet { .. } => "ddnet",
        }
    }
}

/// Where y1 of accelerated GAP starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Momentum {
    /// At 0.
    Zero,
    /// At y.
    Measurement,
}

/// One `[[stage]]`.
#[derive(Clone, Debug)]
pub struct Stage {
    /// σ in 0..255 units, if the denoiser has one.
    pub sigma: Option<f32>,
    /// Iterations.
    pub iterations: usize,
    /// Index into [`Checked::denoisers`].
    pub denoiser: usize,
}

/// `[output]`, or `output = "minimal"`: nothing but the reconstruction and the record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Output {
    /// Format of the reconstruction.
    pub format: VideoFormat,
    /// Write PNG frames.
    pub frames: bool,
    /// Write an animated GIF.
    pub preview: bool,
    /// Its frames a second.
    pub fps: u16,
    /// Write the page.
    pub report: bool,
    /// What its pictures may take, in units of a million bytes.
    pub report_megabytes: u32,
}

/// An experiment whose every value is legal; paths are not looked up yet.
#[derive(Clone, Debug)]
pub struct Checked {
    /// Name, a relative path.
    pub name: Option<String>,
    /// Seed of everything random.
    pub seed: u64,
    /// `[data]`.
    pub data: Data,
    /// `[solver]`.
    pub solver: Solver,
    /// Where solves start.
    pub start: Start,
    /// What demosaics color scenes; `None` if the file does not say.
    pub demosaicer: Option<Demosaicer<PathSetting>>,
    /// All denoisers, the default first.
    pub denoisers: Vec<Denoiser>,
    /// The stages.
    pub stages: Vec<Stage>,
    /// Stop once the relative change is at most this; 0 never.
    pub relative_change: f64,
    /// Stop a measurement after so many seconds.
    pub seconds: Option<f64>,
    /// `[skip]`, if it is enabled.
    pub skip: Option<Skip>,
    /// `[online]`, if it is enabled.
    pub online: Option<Online>,
    /// `[output]`.
    pub output: Output,
}

const TOP: [&str; 12] = [
    "name",
    "seed",
    "data",
    "solver",
    "denoiser",
    "stage",
    "schedule",
    "schedules",
    "stop",
    "skip",
    "online",
    "output",
];
const PATTERNS: [(&str, CfaPattern); 4] =
    [("rggb", CfaPattern::Rggb), ("bggr", CfaPattern::Bggr), ("grbg", CfaPattern::Grbg), ("gbrg", CfaPattern::Gbrg)];
const DEFECTS: [(&str, Defects); 2] = [("keep", Defects::Keep), ("exclude", Defects::Exclude)];
pub(super) const MAX_ITERATIONS: i64 = 100_000;
const SEEDS: RangeInclusive<i64> = 0..=i64::MAX;
/// Of a stage, in 0..255 units.
const SIGMAS: RangeInclusive<f64> = 0.0..=255.0;

/// Checks an experiment.
///
/// # Errors
/// The first broken rule.
pub fn check(source: &Source) -> Result<Checked, ConfigError> {
    Checker { source }.experiment()
}

pub(super) struct Checker<'s> {
    pub(super) source: &'s Source,
}

impl<'s> Checker<'s> {
    fn experiment(&self) -> Result<Checked, ConfigError> {
        let mut root = Section::root(self.source)?;
        root.only(&TOP)?;
        let data = root.take("data")?;
        let solver = root.take("solver")?;
        let denoiser = root.take("denoiser")?;
        let stages = root.take_list("stage")?;
        let named = root.take("schedules")?;
        let stop = root.take("stop")?;
        let (skip, online) = (root.take("skip")?, root.take("online")?);
        let minimal = root.take_word("output", "minimal");
        let output = root.take("output")?;
        let top: TopKeys = root.read(&[])?;
        let seed = self.whole("seed", &top.seed, SEEDS)?.unwrap_or(0) as u64;
        let missing = |key: &str| self.source.file_error(format!("no [{key}] table"));
        let data = self.data(data.ok_or_else(|| missing("data"))?, seed)?;
        let (solver, start, demosaicer) = self.solver(solver.ok_or_else(|| missing("solver"))?)?;
        let mut skip = self.skip(skip, seed)?;
        let (denoisers, stages) = self.schedule(&top.schedule, denoiser, stages, named, skip.is_some())?;
        if let Some(skip) = &mut skip {
            skip.keep_trained_sigmas(&denoisers);
        }
        let online = self.online(online, seed, &denoisers)?;
        let (relative_change, seconds) = self.stop(stop)?;
        let name = self.name(top.name)?;
        let output = self.output(minimal, output)?;
        Ok(Checked {
            name,
            seed,
            data,
            solver,
            start,
            demosaicer,
            denoisers,
            stages,
            relative_change,
            seconds,
            skip,
            online,
            output,
        })
    }

    fn name(&self, name: Value) -> Result<Option<String>, ConfigError> {
        let legal = "letters, digits, '.', '_' and '-', in parts joined by '/'";
        let part_ok = |p: &str| {
            !p.is_empty() && !p.starts_with('.') && p.chars().all(|c| c.is_ascii_alphanumeric() || "._-".contains(c))
        };
        self.text("name", &name, legal, |n| n.split('/').all(part_ok))
    }

    fn data(&self, mut section: Section<'s>, seed: u64) -> Result<Data, ConfigError> {
        let span = section.span.clone();
        let kind = section.take_kind(&["scene", "simulate"], Some("scene"))?;
        let (names, raw) = (section.take("keys")?, section.take("raw")?);
        let mut also = vec!["kind", "keys", "raw"];
        let simulate = if kind.get_ref() == "simulate" {
            also.extend(["mask", "noise"]);
            let (mask, noise) = (section.take("mask")?, section.take("noise")?);
            let problem = "`data.mask` is missing: data.kind = \"simulate\" needs a table [data.mask]";
            let mask = mask.ok_or_else(|| self.source.error(&span, problem))?;
            Some(self.simulate(mask, noise, seed)?)
        } else {
            None
        };
        let k: DataKeys = section.read(&also)?;
        let shift = self.mask_shift(&k.mask_shift, &k.frames, simulate.is_some())?;
        Ok(Data {
            path: self.path("data.path", k.path, &span)?,
            mask: k.mask.map(|mask| self.path("data.mask", Some(mask), &span)).transpose()?,
            measurements: self.measurements(k.measurements)?,
            reading: Reading {
                keys: self.part_names(names)?,
                axes: self.choice("data.axes", &k.axes, &[("hwt", Axes::Hwt), ("thw", Axes::Thw)])?,
                scale: self.number("data.scale", &k.scale, 1e-6..=1e6)?.map(|s| s as f32),
                cfa: self.choice("data.cfa", &k.cfa, &PATTERNS)?,
                defects: self.choice("data.defects", &k.defects, &DEFECTS)?.unwrap_or_default(),
                // Found once all is checked.
                mask: None,
                shift,
                raw: raw.map(|section| self.raw(section)).transpose()?,
            },
            simulate,
        })
    }

    fn part_names(&self, section: Option<Section<'s>>) -> Result<Keys, ConfigError> {
        let names: PartNames = section.map(|s| s.read(&[])).transpose()?.unwrap_or_default();
        let default = Keys::default();
        let name = |part: &str, value: &Value, default: String| {
            let name =
                self.text(&format!("data.keys.{part}"), value, "the name of a variable, in quotes", |n| !n.is_empty())?;
            Ok(name.unwrap_or(default))
        };
        Ok(Keys {
            mask: name("mask", &names.mask, default.mask)?,
            meas: name("meas", &names.meas, default.meas)?,
            orig: name("orig", &names.orig, default.orig)?,
            rgb: name("rgb", &names.rgb, default.rgb)?,
        })
    }

    fn simulate(&self, mask: Section<'s>, noise: Option<Section<'s>>, seed: u64) -> Result<Simulate, ConfigError> {
        let mask = self.mask(mask, seed)?;
        let noise: NoiseKeys = noise.map(|n| n.read(&[])).transpose()?.unwrap_or_default();
        Ok(Simulate {
            mask,
            sigma: self.number("data.noise.sigma", &noise.sigma, 0.0..=255.0)?.unwrap_or(0.0) as f32,
            photons: self.number("data.noise.photons", &noise.photons, 1e-3..=1e9)?,
            seed: self.whole("data.noise.seed", &noise.seed, SEEDS)?.map_or(seed, |s| s as u64),
        })
    }

    fn mask(&self, mut section: Section<'s>, seed: u64) -> Result<Mask, ConfigError> {
        let span = section.span.clone();
        let kind = section.take_kind(&["random", "shifting", "file"], None)?;
        if kind.get_ref() == "file" {
            let k: FileMaskKeys = section.read(&["kind"])?;
            return Ok(Mask::File(self.path("data.mask.path", k.path, &span)?));
        }
        let k: RandomMaskKeys = section.read(&["kind"])?;
        let random = RandomMask {
            frames: self.whole("data.mask.frames", &k.frames, 2..=1024)?.unwrap_or(8) as usize,
            density: self.number("data.mask.density", &k.density, 1e-3..=1.0)?.unwrap_or(0.5),
            seed: self.whole("data.mask.seed", &k.seed, SEEDS)?.map_or(seed, |s| s as u64),
        };
        Ok(if kind.get_ref() == "random" { Mask::Random(random) } else { Mask::Shifting(random) })
    }

    fn measurements(&self, list: Value) -> Result<Option<Vec<usize>>, ConfigError> {
        let Some(list) = list else { return Ok(None) };
        let index = |v: &Toml| v.as_integer().and_then(|i| usize::try_from(i).ok());
        let indices = list.get_ref().as_array().and_then(|l| l.iter().map(index).collect::<Option<Vec<usize>>>());
        let distinct = |l: &Vec<usize>| !l.is_empty() && l.iter().enumerate().all(|(i, k)| !l[..i].contains(k));
        match indices.filter(distinct) {
            Some(indices) => Ok(Some(indices)),
            None => {
                let legal = "a list of whole numbers from 0, at least one, none twice, for example [0, 2]";
                Err(self.value_error("data.measurements", &list.span(), legal))
            }
        }
    }

    fn solver(
        &self,
        mut section: Section<'s>,
    ) -> Result<(Solver, Start, Option<Demosaicer<PathSetting>>), ConfigError> {
        let kind = section.take_kind(&["gap", "admm", "two-stage"], None)?;
        let span = section.span.clone();
        match kind.get_ref().as_str() {
            "gap" => {
                let k: GapKeys = section.read(&["kind"])?;
                let start = self.start(k.start, k.start_iterations, k.start_weight)?.unwrap_or(Start::Mean);
                let accelerate = self.flag("solver.accelerate", &k.accelerate)?.unwrap_or(true);
                let legal = [("zero", Momentum::Zero), ("measurement", Momentum::Measurement)];
                let momentum = self.choice("solver.momentum", &k.momentum, &legal)?;
                if let (false, Some(m)) = (accelerate, &k.momentum) {
                    return Err(self
                        .source
                        .error(&m.span(), "`solver.momentum` has no effect without solver.accelerate = true"));
                }
                let momentum = accelerate.then(|| momentum.unwrap_or(Momentum::Measurement));
                let demosaicer = self.demosaicer(k.demosaicer, k.weights, &span)?;
                Ok((Solver::Gap { momentum }, start, demosaicer))
            }
            "admm" => {
                let k: AdmmKeys = section.read(&["kind"])?;
                let start = self.start(k.start, k.start_iterations, k.start_weight)?.unwrap_or(Start::Mean);
                let gamma = self.number("solver.gamma", &k.gamma, 0.0..=1e3)?.unwrap_or(0.01) as f32;
                Ok((Solver::Admm { gamma }, start, self.demosaicer(k.demosaicer, k.weights, &span)?))
            }
            _ => self.two_stage(section.read(&["kind"])?, &span),
        }
    }

    fn two_stage(
        &self,
        k: TwoStageKeys,
        table: &Range<usize>,
    ) -> Result<(Solver, Start, Option<Demosaicer<PathSetting>>), ConfigError> {
        let start = self.start(k.start, k.start_iterations, k.start_weight)?;
        let start = start.unwrap_or(Start::Tv { iterations: 40, weight: 0.1 });
        let positive = |key: &str, value: &Value, default: f64| {
            let number = self.number(&format!("solver.{key}"), value, 1e-6..=1e6)?;
            Ok(number.unwrap_or(default) as f32)
        };
        let legal = [("paper-code", Convention::PaperCode), ("scaled", Convention::Scaled)];
        let params = TwoStageParams {
            rho: positive("rho", &k.rho, 1.0)?,
            tau: positive("tau", &k.tau, 100.0)?,
            convention: self.choice("solver.convention", &k.convention, &legal)?.unwrap_or(Convention::PaperCode),
        };
        let clip = self.flag("solver.clip", &k.clip)?;
        if k.demosaicer.as_ref().and_then(|d| d.get_ref().as_str()) == Some("closed-form") {
            // The first x has no v yet, and comes from a demosaicer.
            let demosaicer = self.demosaicer(None, k.weights, table)?;
            let x_step = XStep::ClosedForm { clip: clip.unwrap_or(true) };
            return Ok((Solver::TwoStage { params, x_step }, start, demosaicer));
        }
        if let Some(clip) = &k.clip {
            let problem = "`solver.clip` has no effect without solver.demosaicer = \"closed-form\"";
            return Err(self.source.error(&clip.span(), problem));
        }
        let demosaicer = self.demosaicer(k.demosaicer, k.weights, table)?;
        Ok((Solver::TwoStage { params, x_step: XStep::Demosaic }, start, demosaicer))
    }

    fn demosaicer(
        &self,
        kind: Value,
        weights: Value,
        table: &Range<usize>,
    ) -> Result<Option<Demosaicer<PathSetting>>, ConfigError> {
        let legal = "malvar, menon, bilinear, ddnet, and closed-form with solver.kind = \"two-stage\"";
        let known = |t: &str| ["malvar", "menon", "bilinear", "ddnet"].contains(&t);
        let name = self.text("solver.demosaicer", &kind, legal, known)?;
        if let (Some(w), false) = (&weights, name.as_deref() == Some("ddnet")) {
            let problem = "`solver.weights` has no effect without solver.demosaicer = \"ddnet\"";
            return Err(self.source.error(&w.span(), problem));
        }
        Ok(match name.as_deref() {
            None => None,
            Some("malvar") => Some(Demosaicer::Malvar),
            Some("menon") => Some(Demosaicer::Menon),
            Some("bilinear") => Some(Demosaicer::Bilinear),
            Some(_) => Some(Demosaicer::Ddnet { weights: self.path("solver.weights", weights, table)? }),
        })
    }

    fn start(&self, start: Value, iterations: Value, weight: Value) -> Result<Option<Start>, ConfigError> {
        let count = self.whole("solver.start_iterations", &iterations, 1..=MAX_ITERATIONS)?.unwrap_or(20) as usize;
        let tv_weight = self.number("solver.start_weight", &weight, 1e-6..=100.0)?.unwrap_or(0.1) as f32;
        let tv = Start::Tv { iterations: count, weight: tv_weight };
        let legal = [("mean", Start::Mean), ("adjoint", Start::Adjoint), ("previous", Start::Previous), ("tv", tv)];
        let start = self.choice("solver.start", &start, &legal)?;
        if !matches!(start, Some(Start::Tv { .. })) {
            let unused = [
                ("solver.start_iterations", iterations.map(|s| s.span())),
                ("solver.start_weight", weight.map(|s| s.span())),
            ];
            if let Some((key, Some(span))) = unused.into_iter().find(|(_, s)| s.is_some()) {
                return Err(self.source.error(&span, format!("`{key}` has no effect without solver.start = \"tv\"")));
            }
        }
        Ok(start)
    }

    /// The stages to run: those of the `[schedules]` that `schedule` names, else the `[[stage]]`s. All must be legal.
    fn schedule(
        &self,
        chosen: &Value,
        default: Option<Section<'s>>,
        stages: Vec<Section<'s>>,
        named: Option<Section<'s>>,
        skips: bool,
    ) -> Result<(Vec<Denoiser>, Vec<Stage>), ConfigError> {
        let mut denoisers = default.map(|d| self.denoiser(d)).transpose()?.into_iter().collect::<Vec<_>>();
        let has_default = !denoisers.is_empty();
        let mut schedules = Vec::new();
        if let Some(mut named) = named {
            for name in named.keys() {
                let stages = self.stages(&mut denoisers, has_default, named.take_list(&name)?, skips)?;
                schedules.push((name, stages));
            }
        }
        let names: Vec<String> = schedules.iter().map(|(name, _)| name.clone()).collect();
        let legal = if names.is_empty() { "none, as there is no [schedules]".to_owned() } else { names.join(", ") };
        let unnamed = self.stages(&mut denoisers, has_default, stages, skips)?;
        let stages = match self.text("schedule", chosen, &legal, |c| names.iter().any(|n| n == c))? {
            Some(chosen) => schedules.into_iter().find(|(n, _)| *n == chosen).map_or(unnamed, |(_, stages)| stages),
            None => unnamed,
        };
        if stages.is_empty() {
            let choose = if names.is_empty() { String::new() } else { format!(", or schedule = one of {legal}") };
            return Err(self
                .source
                .file_error(format!("no [[stage]]: at least one is needed, for example iterations = 40{choose}")));
        }
        if has_default && stages.iter().all(|s| s.denoiser != 0) {
            return Err(self.source.file_error("[denoiser] has no effect: every [[stage]] names its own"));
        }
        Ok(in_use(denoisers, stages))
    }

    fn stages(
        &self,
        denoisers: &mut Vec<Denoiser>,
        has_default: bool,
        sections: Vec<Section<'s>>,
        skips: bool,
    ) -> Result<Vec<Stage>, ConfigError> {
        let mut stages = Vec::new();
        for mut section in sections {
            let (key, span) = (section.key.clone(), section.span.clone());
            let denoiser = match section.take("denoiser")? {
                Some(own) => {
                    denoisers.push(self.denoiser(own)?);
                    denoisers.len() - 1
                }
                None if has_default => 0,
                None => {
                    return Err(self
                        .source
                        .error(&span, format!("`{key}` has no denoiser, and there is no [denoiser] table")));
                }
            };
            let k: StageKeys = section.read(&["denoiser"])?;
            let sigmas = self.sigmas(&key, &span, &k.sigma, &denoisers[denoiser], skips)?;
            let iterations =
                self.whole(&format!("{key}.iterations"), &k.iterations, 0..=MAX_ITERATIONS)?.ok_or_else(|| {
                    self.source.error(&span, format!("`{key}.iterations` is missing; legal: 0 to {MAX_ITERATIONS}"))
                })?;
            let stage = |sigma| Stage { sigma, iterations: iterations as usize, denoiser };
            stages.extend(sigmas.into_iter().map(stage));
        }
        Ok(stages)
    }

    /// σ of a `[[stage]]`: one, or one for each of the stages that it stands for.
    fn sigmas(
        &self,
        stage: &str,
        table: &Range<usize>,
        value: &Value,
        denoiser: &Denoiser,
        skips: bool,
    ) -> Result<Vec<Option<f32>>, ConfigError> {
        let key = format!("{stage}.sigma");
        let is_tv = matches!(denoiser, Denoiser::Tv { .. });
        let refuse = |problem: &str| {
            let place = value.as_ref().map_or_else(|| table.clone(), |given| given.span());
            Err(self.source.error(&place, format!("`{key}` {problem}")))
        };
        let Some(given) = value else {
            return if is_tv {
                Ok(vec![None])
            } else {
                refuse("is missing; legal: 0 to 255, in units of an 8-bit picture")
            };
        };
        match given.get_ref() {
            _ if is_tv => refuse("has no effect: its denoiser is tv, whose strength is denoiser.weight"),
            Toml::String(auto) if auto == "auto" && !skips => {
                refuse("= \"auto\" is decided by held-out pixels: it needs skip.enabled = true")
            }
            Toml::String(auto) if auto == "auto" && denoiser.for_iterates() => {
                refuse("= \"auto\" is for networks of any σ; this one was trained for the σ of its schedule")
            }
            Toml::String(auto) if auto == "auto" => Ok(AUTO.map(|sigma| Some(sigma as f32)).to_vec()),
            Toml::Array(list) => {
                let legal = "numbers from 0 to 255 in a list, in units of an 8-bit picture, one for each stage";
                let each =
                    |v: &Toml| as_number(v).filter(|sigma| SIGMAS.contains(sigma)).map(|sigma| Some(sigma as f32));
                let sigmas = self.legal(&key, value, legal, |_| {
                    list.iter().map(each).collect::<Option<Vec<_>>>().filter(|sigmas| !sigmas.is_empty())
                })?;
                Ok(sigmas.unwrap_or_default())
            }
            _ => Ok(self.number(&key, value, SIGMAS)?.map(|sigma| Some(sigma as f32)).into_iter().collect()),
        }
    }

    fn stop(&self, section: Option<Section<'s>>) -> Result<(f64, Option<f64>), ConfigError> {
        let k: StopKeys = section.map(|s| s.read(&[])).transpose()?.unwrap_or_default();
        Ok((
            self.number("stop.relative_change", &k.relative_change, 0.0..=1.0)?.unwrap_or(0.0),
            self.number("stop.seconds", &k.seconds, 1e-3..=1e6)?,
        ))
    }

    fn output(&self, minimal: bool, section: Option<Section<'s>>) -> Result<Output, ConfigError> {
        let k: OutputKeys = section.map(|s| s.read(&[])).transpose()?.unwrap_or_default();
        let flag = |key: &str, value: &Value| Ok(self.flag(&format!("output.{key}"), value)?.unwrap_or(!minimal));
        Ok(Output {
            format: self.choice("output.format", &k.format, &VideoFormat::ALL)?.unwrap_or(VideoFormat::Npy),
            frames: flag("frames", &k.frames)?,
            preview: flag("preview", &k.preview)?,
            fps: self.whole("output.fps", &k.fps, 1..=50)?.unwrap_or(10) as u16,
            report: flag("report", &k.report)?,
            report_megabytes: self.whole("output.report_megabytes", &k.report_megabytes, 1..=400)?.unwrap_or(30) as u32,
        })
    }

    pub(super) fn path(&self, key: &str, path: Value, table: &Range<usize>) -> Result<PathSetting, ConfigError> {
        let legal = "the path of a file or folder, in quotes";
        match (self.text(key, &path, legal, |p| !p.is_empty())?, path) {
            (Some(text), Some(value)) => Ok(PathSetting { key: key.into(), span: value.span(), text }),
            _ => Err(self.source.error(table, format!("`{key}` is missing; legal: {legal}"))),
        }
    }

    /// The value if there is one and `read` finds it legal.
    fn legal<T>(
        &self,
        key: &str,
        value: &Value,
        legal: &str,
        read: impl Fn(&Toml) -> Option<T>,
    ) -> Result<Option<T>, ConfigError> {
        let Some(v) = value else { return Ok(None) };
        read(v.get_ref()).map(Some).ok_or_else(|| self.value_error(key, &v.span(), legal))
    }

    pub(super) fn whole(
        &self,
        key: &str,
        value: &Value,
        range: RangeInclusive<i64>,
    ) -> Result<Option<i64>, ConfigError> {
        let legal = match *range.end() {
            i64::MAX => format!("a whole number of at least {}", range.start()),
            end => format!("a whole number from {} to {end}", range.start()),
        };
        self.legal(key, value, &legal, |v| v.as_integer().filter(|i| range.contains(i)))
    }

    pub(super) fn number(
        &self,
        key: &str,
        value: &Value,
        range: RangeInclusive<f64>,
    ) -> Result<Option<f64>, ConfigError> {
        let unit =
            if key.ends_with("sigma") || key.ends_with("input_noise") { ", in units of an 8-bit picture" } else { "" };
        let legal = format!("a number from {} to {}{unit}", range.start(), range.end());
        self.legal(key, value, &legal, |v| as_number(v).filter(|x| range.contains(x)))
    }

    pub(super) fn flag(&self, key: &str, value: &Value) -> Result<Option<bool>, ConfigError> {
        self.legal(key, value, "true or false", Toml::as_bool)
    }

    fn text(
        &self,
        key: &str,
        value: &Value,
        legal: &str,
        ok: impl Fn(&str) -> bool,
    ) -> Result<Option<String>, ConfigError> {
        self.legal(key, value, legal, |v| v.as_str().filter(|t| ok(t)).map(str::to_owned))
    }

    pub(super) fn choice<T: Copy>(
        &self,
        key: &str,
        value: &Value,
        legal: &[(&str, T)],
    ) -> Result<Option<T>, ConfigError> {
        let names: Vec<&str> = legal.iter().map(|(name, _)| *name).collect();
        self.legal(key, value, &names.join(", "), |v| {
            legal.iter().find(|(name, _)| v.as_str() == Some(name)).map(|&(_, choice)| choice)
        })
    }

    pub(super) fn value_error(&self, key: &str, span: &Range<usize>, legal: &str) -> ConfigError {
        self.source.error(span, format!("`{key}` = {} is not legal; legal: {legal}", self.source.snippet(span)))
    }

    pub(super) fn not_yet(&self, key: &str, span: &Range<usize>, available: &str) -> ConfigError {
        let value = self.source.snippet(span);
        self.source.error(span, format!("`{key}` = {value} is not available yet; available: {available}"))
    }
}

fn as_number(value: &Toml) -> Option<f64> {
    value.as_float().or_else(|| value.as_integer().map(|i| i as f64))
}

/// Leaves out the denoisers of schedules that are not run, so that nothing is loaded for them.
fn in_use(denoisers: Vec<Denoiser>, mut stages: Vec<Stage>) -> (Vec<Denoiser>, Vec<Stage>) {
    let mut kept = Vec::new();
    for (index, denoiser) in denoisers.into_iter().enumerate() {
        let users = || stages.iter().filter(|s| s.denoiser == index);
        if users().next().is_some() {
            kept.push((index, denoiser));
        }
    }
    for stage in &mut stages {
        stage.denoiser = kept.iter().position(|(i, _)| *i == stage.denoiser).unwrap_or(0);
    }
    (kept.into_iter().map(|(_, d)| d).collect(), stages)
}
