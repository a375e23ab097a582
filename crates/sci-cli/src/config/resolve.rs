//! Owns the last step: paths looked up, σ divided by 255, ready to run and to be written into the run record.

use std::env;
use std::path::{Path, PathBuf};

use admm::{Convention, HoldOut, Wnnm, XStep};
use nets::Ends;
use serde_json::{Value, json};

use super::check::{self, Checked, Mask, Momentum, PathSetting};
use super::denoising::{self, Inference};
use super::skipping::{Skip, cheap_first};
use super::source::{ConfigError, Place, Source};
use crate::io::defects::Defects;
use crate::io::scene::{Axes, Reading};

pub use super::adaptation::Online;
pub use super::check::{Demosaicer, Output, RandomMask, Solver, Start};

/// The environment variable that names a folder of scenes and weights.
pub const DATA_VARIABLE: &str = "SCI_DATA";
/// Full scale of the σ written in TOML.
const SIGMA_UNIT: f32 = 255.0;

/// Where the measurements come from.
#[derive(Clone, Debug, PartialEq)]
pub struct Data {
    /// The scene or video, absolute.
    pub path: PathBuf,
    /// Measurements to reconstruct, `None` for all.
    pub measurements: Option<Vec<usize>>,
    /// How to understand the file.
    pub reading: Reading,
    /// Set if `path` is a video whose measurements are simulated.
    pub simulate: Option<Simulate>,
}

/// What turns a video into measurements.
#[derive(Clone, Debug, PartialEq)]
pub struct Simulate {
    /// The masks.
    pub mask: MaskSource,
    /// Standard deviation of Gaussian noise, in the unit of y (full scale 1).
    pub sigma: f32,
    /// Photons per unit of y, `None` for no shot noise.
    pub photons: Option<f64>,
    /// Seed of the noise.
    pub seed: u64,
}

/// Where masks come from.
#[derive(Clone, Debug, PartialEq)]
pub enum MaskSource {
    /// Independent random pixels.
    Random(RandomMask),
    /// One random pattern, moved by a pixel a frame.
    Shifting(RandomMask),
    /// A file, absolute.
    File(PathBuf),
}

/// A denoiser to build.
#[derive(Clone, Debug, PartialEq)]
pub enum Denoiser {
    /// Total variation.
    Tv {
        /// Weight.
        weight: f32,
        /// Dual steps a call.
        inner: usize,
    },
    /// Weighted nuclear norm minimisation.
    Wnnm(Wnnm),
    /// FFDNet.
    Ffdnet {
        /// Weight file, absolute.
        weights: PathBuf,
        /// How it is run.
        inference: Inference,
    },
    /// FastDVDnet.
    Fastdvdnet {
        /// Weight file, absolute.
        weights: PathBuf,
        /// What stands for the frames before the first and after the last.
        ends: Ends,
        /// How it is run.
        inference: Inference,
    },
}

impl Denoiser {
    /// The `kind` that names it in TOML.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Tv { .. } => "tv",
            Self::Wnnm(_) => "wnnm",
            Self::Ffdnet { .. } => "ffdnet",
            Self::Fastdvdnet { .. } => "fastdvdnet",
        }
    }

    /// Whether it is a network.
    pub fn is_network(&self) -> bool {
        matches!(self, Self::Ffdnet { .. } | Self::Fastdvdnet { .. })
    }
}

/// A stage to run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stage {
    /// σ in `[0, 1]`, if the denoiser has one.
    pub sigma: Option<f32>,
    /// Iterations.
    pub iterations: usize,
    /// Index into [`Experiment::denoisers`].
    pub denoiser: usize,
}

/// An experiment ready to run.
#[derive(Clone, Debug)]
pub struct Experiment {
    /// Name, a relative path such as `gray/gap-tv`.
    pub name: String,
    /// Seed of everything random.
    pub seed: u64,
    /// Where the measurements come from.
    pub data: Data,
    /// The solver.
    pub solver: Solver,
    /// Where it starts.
    pub start: Start,
    /// What demosaics color scenes; `None` if the file does not say.
    pub demosaicer: Option<Demosaicer<PathBuf>>,
    /// All denoisers.
    pub denoisers: Vec<Denoiser>,
    /// The stages.
    pub stages: Vec<Stage>,
    /// Stop once the relative change is at most this; 0 never.
    pub relative_change: f64,
    /// Stop a measurement after so many seconds.
    pub seconds: Option<f64>,
    /// What is left out, if anything may be.
    pub skip: Option<Skip>,
    /// How networks adapt while they solve, if they do.
    pub online: Option<Online>,
    /// What to write.
    pub output: Output,
    /// What it was read from.
    pub written: Written,
}

/// An experiment as it was written, so that a record can be run again.
#[derive(Clone, Debug)]
pub struct Written {
    /// The file, absolute.
    pub file: PathBuf,
    /// Its text.
    pub text: String,
    /// The `--set` arguments.
    pub set: Vec<String>,
}

/// Reads, checks and resolves an experiment file with `--set` arguments applied.
///
/// # Errors
/// [`ConfigError`] naming the place, the key, the value and what is legal.
pub fn load(path: &Path, arguments: &[String]) -> Result<Experiment, ConfigError> {
    let bytes = std::fs::read(path).map_err(|e| ConfigError {
        place: Place::File(path.to_owned()),
        problem: format!("cannot read the experiment file: {e}"),
    })?;
    let text = String::from_utf8(bytes)
        .map_err(|_| ConfigError { place: Place::File(path.to_owned()), problem: "not a text file".into() })?;
    load_text(path, text, arguments)
}

/// The same with the text of the file at hand; `path` is where it was.
///
/// # Errors
/// As [`load`].
pub fn load_text(path: &Path, text: String, arguments: &[String]) -> Result<Experiment, ConfigError> {
    let source = Source::new(path, &text, arguments);
    let checked = check::check(&source)?;
    let file = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    resolve(checked, &source, Written { file, text: text.clone(), set: arguments.to_vec() })
}

fn resolve(checked: Checked, source: &Source, written: Written) -> Result<Experiment, ConfigError> {
    let find = |setting: &PathSetting| locate(setting, source);
    let simulate = match &checked.data.simulate {
        None => None,
        Some(s) => Some(Simulate {
            mask: match &s.mask {
                Mask::Random(r) => MaskSource::Random(r.clone()),
                Mask::Shifting(r) => MaskSource::Shifting(r.clone()),
                Mask::File(p) => MaskSource::File(find(p)?),
            },
            sigma: s.sigma / SIGMA_UNIT,
            photons: s.photons,
            seed: s.seed,
        }),
    };
    let mask = checked.data.mask.as_ref().map(find).transpose()?;
    let data = Data {
        path: find(&checked.data.path)?,
        measurements: checked.data.measurements,
        reading: Reading { mask, ..checked.data.reading },
        simulate,
    };
    let denoisers = checked
        .denoisers
        .iter()
        .map(|d| match d {
            denoising::Denoiser::Tv { weight, inner } => Ok(Denoiser::Tv { weight: *weight, inner: *inner }),
            denoising::Denoiser::Wnnm(wnnm) => Ok(Denoiser::Wnnm(*wnnm)),
            denoising::Denoiser::Ffdnet { weights, inference } => {
                Ok(Denoiser::Ffdnet { weights: locate_weights(weights, source)?, inference: *inference })
            }
            denoising::Denoiser::Fastdvdnet { weights, ends, inference } => {
                let weights = locate_weights(weights, source)?;
                Ok(Denoiser::Fastdvdnet { weights, ends: *ends, inference: *inference })
            }
        })
        .collect::<Result<_, ConfigError>>()?;
    let demosaicer = match checked.demosaicer {
        None => None,
        Some(Demosaicer::Bilinear) => Some(Demosaicer::Bilinear),
        Some(Demosaicer::Malvar) => Some(Demosaicer::Malvar),
        Some(Demosaicer::Menon) => Some(Demosaicer::Menon),
        Some(Demosaicer::Ddnet { weights }) => Some(Demosaicer::Ddnet { weights: locate_weights(&weights, source)? }),
    };
    let stages = checked
        .stages
        .iter()
        .map(|s| Stage {
            sigma: s.sigma.map(|sigma| sigma / SIGMA_UNIT),
            iterations: s.iterations,
            denoiser: s.denoiser,
        })
        .collect();
    let stem = || source.path().file_stem().map_or("experiment".into(), |s| s.to_string_lossy().into_owned());
    let mut experiment = Experiment {
        name: checked.name.unwrap_or_else(stem),
        seed: checked.seed,
        data,
        solver: checked.solver,
        start: checked.start,
        demosaicer,
        denoisers,
        stages,
        relative_change: checked.relative_change,
        seconds: checked.seconds,
        skip: checked.skip,
        online: checked.online,
        output: checked.output,
        written,
    };
    cheap_first(&mut experiment);
    Ok(experiment)
}

/// The folders a relative path is looked up in.
fn search_folders(setting: &PathSetting, source: &Source) -> Vec<PathBuf> {
    let here = || PathBuf::from(".");
    let first = if source.is_set(&setting.span) {
        here()
    } else {
        source.path().parent().filter(|p| !p.as_os_str().is_empty()).map_or_else(here, Path::to_owned)
    };
    let mut folders = vec![first];
    if let Some(data) = env::var_os(DATA_VARIABLE).filter(|v| !v.is_empty()).map(PathBuf::from) {
        folders.extend([data.clone(), data.join("data"), data.join("weights")]);
    }
    folders
}

fn locate(setting: &PathSetting, source: &Source) -> Result<PathBuf, ConfigError> {
    let folders = search_folders(setting, source);
    // Joining an absolute path gives that path, whatever the folder.
    if let Some(found) = folders.iter().map(|f| f.join(&setting.text)).find(|p| p.exists()) {
        return std::path::absolute(&found)
            .map_err(|e| source.error(&setting.span, format!("`{}` = {:?}: {e}", setting.key, setting.text)));
    }
    let mut problem = format!("`{}` = {:?}: no such file or folder", setting.key, setting.text);
    if Path::new(&setting.text).is_relative() {
        let looked: Vec<String> = folders.iter().map(|f| f.display().to_string()).collect();
        problem += &format!("; looked in {}", looked.join(", "));
        if folders.len() == 1 {
            problem += &format!(" ({DATA_VARIABLE} is not set: it may name a folder with data/ and weights/)");
        }
    }
    Err(source.error(&setting.span, problem))
}

/// Published weight files by the name under which configs know them: what it is and where it comes from.
const PUBLISHED: [(&str, &str); 3] = [
    (
        "ffdnet_gray_ipol.pth",
        "the gray FFDNet of Tassano, Delon and Veit (IPOL 2019), published as models/net_gray.pth at https://github.com/m-tassano/ffdnet",
    ),
    (
        "ffdnet_gray.pth",
        "the gray FFDNet of Zhang et al., published as ffdnet_gray.pth at https://github.com/cszn/KAIR/releases/tag/v1.0",
    ),
    (
        "ffdnet_color.pth",
        "the color FFDNet of Zhang et al., published as ffdnet_color.pth at https://github.com/cszn/KAIR/releases/tag/v1.0",
    ),
];

fn locate_weights(setting: &PathSetting, source: &Source) -> Result<PathBuf, ConfigError> {
    if let Some(name) = setting.text.strip_prefix("bundled:") {
        let known = nets::weights::bundled_names();
        if known.contains(&name) {
            return Ok(PathBuf::from(&setting.text));
        }
        let legal: Vec<String> = known.iter().map(|n| format!("bundled:{n}")).collect();
        let legal = if legal.is_empty() {
            "no weights are bundled yet".to_owned()
        } else {
            format!("bundled are {}", legal.join(", "))
        };
        return Err(source.error(
            &setting.span,
            format!("`{}` = {:?} is not legal: {legal}; name a .pth or .safetensors file", setting.key, setting.text),
        ));
    }
    locate(setting, source).map_err(|mut error| {
        let name = Path::new(&setting.text).file_name().unwrap_or_default();
        if let Some((name, what)) = PUBLISHED.iter().find(|(n, _)| *n == name) {
            let folder = search_folders(setting, source).remove(0);
            error.problem += &format!(
                ". It is {what}; save it as {} or as weights/{name} in the folder {DATA_VARIABLE} names",
                folder.join(name).display()
            );
        }
        error
    })
}

impl Experiment {
    /// The file or folder name of the data, as the run record's `scene`.
    pub fn scene_name(&self) -> String {
        self.data
            .path
            .file_name()
            .map_or_else(|| self.data.path.display().to_string(), |n| n.to_string_lossy().into_owned())
    }

    /// The solver's `kind`.
    pub fn solver_kind(&self) -> &'static str {
        match self.solver {
            Solver::Gap { .. } => "gap",
            Solver::Admm { .. } => "admm",
            Solver::TwoStage { .. } => "two-stage",
        }
    }

    /// The denoisers' kinds in the order of the stages, repeated ones once, joined by ` → `.
    pub fn denoiser_kinds(&self) -> String {
        let mut kinds: Vec<&str> = self.stages.iter().map(|s| self.denoisers[s.denoiser].kind()).collect();
        kinds.dedup();
        kinds.join(" → ")
    }

    /// Every file and folder it reads, with its key.
    pub fn inputs(&self) -> Vec<(&'static str, &Path)> {
        let mask = match &self.data.simulate {
            Some(Simulate { mask: MaskSource::File(path), .. }) => Some(("data.mask.path", path)),
            _ => self.data.reading.mask.as_ref().map(|path| ("data.mask", path)),
        };
        let demosaicer = match &self.demosaicer {
            Some(Demosaicer::Ddnet { weights }) => Some(("solver.weights", weights)),
            _ => None,
        };
        let networks = self.denoisers.iter().filter_map(|d| match d {
            Denoiser::Ffdnet { weights, .. } | Denoiser::Fastdvdnet { weights, .. } => {
                Some(("denoiser.weights", weights))
            }
            Denoiser::Tv { .. } | Denoiser::Wnnm(_) => None,
        });
        let all = [("data.path", &self.data.path)].into_iter().chain(mask).chain(demosaicer).chain(networks);
        all.filter(|(_, path)| !path.to_string_lossy().starts_with("bundled:"))
            .map(|(key, path)| (key, path.as_path()))
            .collect()
    }

    /// [`Experiment::to_json`] and what it was read from, so that it can be run again.
    pub fn record_json(&self) -> Value {
        let Written { file, text, set } = &self.written;
        let mut value = self.to_json();
        value["written"] = json!({ "file": file.to_string_lossy(), "text": text, "set": set });
        value
    }

    /// The resolved experiment for the run record, with the keys of the TOML; σ in `[0, 1]`, paths absolute.
    pub fn to_json(&self) -> Value {
        json!({
            "name": self.name,
            "seed": self.seed,
            "data": self.data_json(),
            "solver": self.solver_json(),
            "denoisers": self.denoisers.iter().map(denoiser_json).collect::<Vec<_>>(),
            "stage": self.stages.iter()
                .map(|s| json!({ "sigma": s.sigma, "iterations": s.iterations, "denoiser": s.denoiser }))
                .collect::<Vec<_>>(),
            "stop": { "relative_change": self.relative_change, "seconds": self.seconds },
            "skip": self.skip.as_ref().map_or_else(|| json!({ "enabled": false }), skip_json),
            "online": self.online.as_ref().map_or_else(|| json!({ "enabled": false }), online_json),
            "output": {
                "format": self.output.format, "frames": self.output.frames, "preview": self.output.preview,
                "fps": self.output.fps, "report": self.output.report, "report_megabytes": self.output.report_megabytes,
            },
        })
    }

    fn data_json(&self) -> Value {
        let (d, k) = (&self.data, &self.data.reading.keys);
        let axes = d.reading.axes.map(|a| if a == Axes::Hwt { "hwt" } else { "thw" });
        let mut value = json!({
            "kind": if d.simulate.is_some() { "simulate" } else { "scene" },
            "path": d.path.to_string_lossy(),
            "measurements": d.measurements,
            "keys": { "mask": k.mask, "meas": k.meas, "orig": k.orig, "rgb": k.rgb },
            "axes": axes,
            "scale": d.reading.scale,
            "cfa": d.reading.cfa.map(|c| c.to_string().to_lowercase()),
            "defects": if d.reading.defects == Defects::Exclude { "exclude" } else { "keep" },
        });
        if let Some(mask) = &d.reading.mask {
            value["mask"] = json!(mask.to_string_lossy());
        }
        if let Some(shift) = &d.reading.shift {
            value["mask_shift"] = json!(shift.step);
            value["frames"] = json!(shift.frames);
        }
        if let Some(raw) = &d.reading.raw {
            value["raw"] = json!({ "format": raw.packing.name(), "height": raw.height, "width": raw.width });
        }
        if let Some(s) = &d.simulate {
            let random = |kind, r: &RandomMask| json!({ "kind": kind, "frames": r.frames, "density": r.density, "seed": r.seed });
            value["mask"] = match &s.mask {
                MaskSource::Random(r) => random("random", r),
                MaskSource::Shifting(r) => random("shifting", r),
                MaskSource::File(path) => json!({ "kind": "file", "path": path.to_string_lossy() }),
            };
            value["noise"] = json!({ "sigma": s.sigma, "photons": s.photons, "seed": s.seed });
        }
        value
    }

    fn solver_json(&self) -> Value {
        let mut value = match self.solver {
            Solver::Gap { momentum } => json!({
                "kind": "gap",
                "accelerate": momentum.is_some(),
                "momentum": momentum.map(|m| if m == Momentum::Zero { "zero" } else { "measurement" }),
            }),
            Solver::Admm { gamma } => json!({ "kind": "admm", "gamma": gamma }),
            Solver::TwoStage { params, .. } => json!({
                "kind": "two-stage",
                "rho": params.rho,
                "tau": params.tau,
                "convention": if params.convention == Convention::Scaled { "scaled" } else { "paper-code" },
            }),
        };
        match (&self.demosaicer, self.solver) {
            (_, Solver::TwoStage { x_step: XStep::ClosedForm { clip }, .. }) => {
                value["demosaicer"] = "closed-form".into();
                value["clip"] = clip.into();
            }
            (Some(d), _) => value["demosaicer"] = d.kind().into(),
            (None, _) => {}
        }
        if let Some(Demosaicer::Ddnet { weights }) = &self.demosaicer {
            value["weights"] = json!(weights.to_string_lossy());
        }
        value["start"] = match self.start {
            Start::Mean => "mean".into(),
            Start::Adjoint => "adjoint".into(),
            Start::Previous => "previous".into(),
            Start::Tv { iterations, weight } => {
                value["start_iterations"] = iterations.into();
                value["start_weight"] = weight.into();
                "tv".into()
            }
        };
        value
    }
}

fn skip_json(s: &Skip) -> Value {
    let HoldOut { spacing, seed, gain, patience, overshoot } = s.hold_out;
    json!({
        "enabled": true, "spacing": spacing, "seed": seed, "gain": gain, "patience": patience, "overshoot": overshoot,
        "tiles": s.tiles, "half_precision": s.half_precision, "cheap_first": s.cheap_first,
    })
}

fn online_json(o: &Online) -> Value {
    let (schedule, guard) = (o.adapt.schedule, o.adapt.roll_back);
    json!({
        "enabled": true,
        "reuse": o.sequence.reuse,
        "effort": o.sequence.effort,
        "first": schedule.first,
        "interval": schedule.interval,
        "max_updates": schedule.max_updates,
        "steps": schedule.steps,
        "stride": schedule.stride,
        "learning_rate": schedule.learning_rate,
        "input_noise": schedule.input_noise,
        "growth": schedule.growth,
        "parameters": o.adapt.parameters,
        "precision": o.adapt.precision,
        "held_out": guard.held_out,
        "back_off": guard.back_off,
        "patience": guard.patience,
        "save": o.save,
    })
}

fn denoiser_json(d: &Denoiser) -> Value {
    match d {
        Denoiser::Tv { weight, inner } => {
            json!({ "kind": "tv", "weight": weight, "inner": inner })
        }
        Denoiser::Wnnm(Wnnm { patch, group, step, window, frames }) => {
            json!({ "kind": "wnnm", "patch": patch, "group": group, "step": step, "window": window, "frames": frames })
        }
        Denoiser::Ffdnet { weights, inference: Inference { precision, flips } } => {
            json!({ "kind": "ffdnet", "weights": weights.to_string_lossy(), "precision": precision, "flips": flips })
        }
        Denoiser::Fastdvdnet { weights, ends, inference: Inference { precision, flips } } => {
            json!({ "kind": "fastdvdnet", "weights": weights.to_string_lossy(), "ends": ends, "precision": precision, "flips": flips })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_of_sigmas_is_that_many_stages() {
        let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs");
        let stages = |more: &str| {
            let path = format!("data.path={}", configs.join("demo/bunny").display());
            let experiment = load(&configs.join("gray/refined.toml"), &[path, more.into()]).unwrap();
            experiment
                .stages
                .iter()
                .map(|s| (s.sigma.map(|sigma| sigma * SIGMA_UNIT), s.iterations, s.denoiser))
                .collect::<Vec<_>>()
        };
        let refined = stages("seed=0");
        assert_eq!(refined.len(), 14);
        assert_eq!(refined[..2], [(Some(20.0), 1, 0), (Some(18.0), 1, 0)]);
        assert_eq!(refined[12..], [(Some(12.0), 6, 1), (Some(8.0), 6, 1)]);
        let written_out = "stage=[{sigma=9.5,iterations=3},{sigma=4,iterations=3}]";
        assert_eq!(stages("stage=[{sigma=[9.5, 4],iterations=3}]"), stages(written_out));
    }
}
