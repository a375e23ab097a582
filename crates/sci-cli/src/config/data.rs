//! `[data]`: where the measurements come from.

use std::path::{Path, PathBuf};

use sci_forward::{CfaPattern, Noise};
use serde_json::json;

use super::camera;
use crate::calibration;
use crate::io::defects::Defects;
use crate::io::raw::{Packing, Raw};
use crate::io::scene::{Axes, Clip, Keys, MaskShift, Reading, Sensor, SensorNoise};
use crate::simulate::Camera;
use crate::table::{ConfigError, Table, as_number};

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
    /// How the masks are found to sit.
    pub calibration: Calibration,
}

/// How masks are found to sit on the sensor.
#[derive(Clone, Debug, PartialEq)]
pub enum Calibration {
    /// As the file has them.
    None,
    /// From the measurements, before the first is solved.
    Auto,
    /// As `sci calibrate` has found it: its file, absolute.
    File(PathBuf),
}

/// What turns a video into measurements.
#[derive(Clone, Debug, PartialEq)]
pub struct Simulate {
    /// The masks.
    pub mask: MaskSource,
    /// The camera behind them.
    pub camera: Camera,
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

/// The parameters of random masks.
#[derive(Clone, Debug, PartialEq)]
pub struct RandomMask {
    /// B.
    pub frames: usize,
    /// Open fraction.
    pub density: f64,
    /// Whether pixels that are not open are -1, of a differential camera.
    pub signed: bool,
    /// Seed.
    pub seed: u64,
}

/// The orders of axes by their names.
pub(crate) const AXES: [(&str, Axes); 2] = [("hwt", Axes::Hwt), ("thw", Axes::Thw)];
/// The patterns of color sensors by their names.
pub const PATTERNS: [(&str, CfaPattern); 4] =
    [("rggb", CfaPattern::Rggb), ("bggr", CfaPattern::Bggr), ("grbg", CfaPattern::Grbg), ("gbrg", CfaPattern::Gbrg)];
const DEFECTS: [(&str, Defects); 2] = [("keep", Defects::Keep), ("exclude", Defects::Exclude)];

impl Data {
    pub(super) fn read(t: &mut Table<'_>, seed: u64) -> Result<Self, ConfigError> {
        let simulated = t.kind(&["scene", "simulate"], Some("scene"))? == "simulate";
        let keys = t.part("keys", |t| Ok(part_names(t)))?;
        let simulate = if simulated { Some(Simulate::read(t, seed)?) } else { None };
        let calibration = calibration(t);
        let mask = if !simulated && t.holds("mask") { Some(t.path("mask")) } else { None };
        Ok(Self {
            path: t.path("path"),
            measurements: measurements(t),
            reading: Reading {
                keys,
                axes: t.optional_choice("axes", &AXES),
                scale: t.optional_number("scale", 1e-6..=1e6).map(|s| s as f32),
                cfa: t.optional_choice("cfa", &PATTERNS),
                defects: t.choice("defects", &DEFECTS, Defects::default()),
                masks_off: usize::from(calibration != Calibration::None),
                mask,
                shift: mask_shift(t, simulated),
                raw: if t.holds("raw") { Some(t.part("raw", |t| Ok(raw(t)))?) } else { None },
                sensor: t.part("sensor", |t| Ok(sensor(t, simulated)))?,
                ..Reading::default()
            },
            simulate,
            calibration,
        })
    }

    /// The files beside `data.path`, with their keys.
    pub(super) fn other_files(&self) -> impl Iterator<Item = (&'static str, &Path)> {
        let mask = match &self.simulate {
            Some(Simulate { mask: MaskSource::File(path), .. }) => Some(("data.mask.path", path.as_path())),
            _ => self.reading.mask.as_deref().map(|path| ("data.mask", path)),
        };
        let calibration = match &self.calibration {
            Calibration::File(path) => Some(("data.calibration", path.as_path())),
            _ => None,
        };
        let sensor = &self.reading.sensor;
        let frames = [("data.sensor.dark", &sensor.dark), ("data.sensor.white", &sensor.white)];
        let frames = frames.into_iter().filter_map(|(key, path)| Some((key, path.as_deref()?)));
        mask.into_iter().chain(calibration).chain(frames)
    }
}

/// `data.mask_shift` and `data.frames`, which go together.
fn mask_shift(t: &mut Table<'_>, simulated: bool) -> Option<MaskShift> {
    if simulated {
        t.idle(&["mask_shift", "frames"], "a scene's own masks: a simulation has [data.mask]");
        return None;
    }
    if !t.holds("mask_shift") {
        t.idle(&["frames"], "data.mask_shift, by which one mask moves: two numbers from -64 to 64, for example [1, 0]");
        return None;
    }
    let legal = "two numbers from -64 to 64: frame t sees the mask at row y + t dy, column x + t dx, for example [1, 0] of a mask whose image moves up";
    let step = t.legal("mask_shift", legal, |v| camera::pair(v, 64.0));
    t.show("mask_shift", step.map(|step| json!(step)));
    Some(MaskShift { step: step.unwrap_or_default(), frames: t.required_whole("frames", 2..=1024) })
}

/// `[data.raw]`: a raw file says neither size nor packing.
fn raw(t: &mut Table<'_>) -> Raw {
    let packing = t.optional_choice("format", &Packing::ALL);
    if packing.is_none() && !t.given("format") {
        let names: Vec<&str> = Packing::ALL.iter().map(|(name, _)| *name).collect();
        t.complain(format!("`data.raw.format` is missing; legal: {}", names.join(", ")));
    }
    Raw {
        packing: packing.unwrap_or(Packing::Mono8),
        height: t.required_whole("height", 1..=65_536),
        width: t.required_whole("width", 1..=65_536),
    }
}

/// `[data.sensor]`.
fn sensor(t: &mut Table<'_>, simulated: bool) -> Sensor {
    let noise = if t.word("noise", "auto") {
        t.idle(&["photons"], "data.sensor.noise as a number: \"auto\" finds read noise");
        t.show("noise", "auto");
        SensorNoise::Auto
    } else {
        noise(t, "noise").map_or(SensorNoise::None, SensorNoise::Known)
    };
    if simulated {
        t.idle(&["dark", "white"], "data.kind = \"scene\": a simulated sensor has data.sensor.black");
    } else if t.holds("dark") {
        t.idle(&["black"], "a file without data.sensor.dark, which has the black level of each pixel");
    }
    let frame = |t: &mut Table<'_>, key: &str| if t.holds(key) { Some(t.path(key)) } else { None };
    let (dark, white) = (frame(t, "dark"), frame(t, "white"));
    let legal = "\"auto\", \"none\", or a number above 0 in the unit of the file";
    let clip = t.legal("clip", legal, |v| match (v.as_str(), as_number(v)) {
        (Some("auto"), _) => Some(Clip::Auto),
        (Some("none"), _) => Some(Clip::None),
        (None, Some(level)) if level > 0.0 && level.is_finite() => Some(Clip::Level(level as f32)),
        _ => None,
    });
    let clip = clip.unwrap_or_default();
    t.show("clip", clip.to_json());
    Sensor { black: t.number("black", 0.0, -1e6..=1e6) as f32, dark, white, noise, clip }
}

/// Read noise under this key, and shot noise.
fn noise(t: &mut Table<'_>, key: &str) -> Option<Noise> {
    let photons = t.optional_number("photons", 1e-3..=1e9);
    let sigma = t.sigma(key, 0.0);
    // In range, which is all that can be wrong.
    Noise::new(photons, f64::from(sigma)).ok().filter(|_| photons.is_some() || sigma > 0.0)
}

fn calibration(t: &mut Table<'_>) -> Calibration {
    if t.word("calibration", "none") {
        return Calibration::None;
    }
    if t.word("calibration", "auto") {
        return Calibration::Auto;
    }
    if !t.holds("calibration") {
        return Calibration::None;
    }
    let path = t.path("calibration");
    // The folder that `sci calibrate` wrote it to means it.
    Calibration::File(if path.is_dir() { path.join(calibration::FILE) } else { path })
}

fn part_names(t: &mut Table<'_>) -> Keys {
    let default = Keys::default();
    let mut name = |part: &str, default: String| {
        let name = t.text(part, "the name of a variable, in quotes", |n| !n.is_empty()).unwrap_or(default);
        t.show(part, name.clone());
        name
    };
    Keys {
        mask: name("mask", default.mask),
        meas: name("meas", default.meas),
        orig: name("orig", default.orig),
        rgb: name("rgb", default.rgb),
    }
}

fn measurements(t: &mut Table<'_>) -> Option<Vec<usize>> {
    let legal = "a list of whole numbers from 0, at least one, none twice, for example [0, 2]";
    let index = |v: &toml::Value| v.as_integer().and_then(|i| usize::try_from(i).ok());
    let distinct = |l: &Vec<usize>| !l.is_empty() && l.iter().enumerate().all(|(i, k)| !l[..i].contains(k));
    let list = t.legal("measurements", legal, |v| {
        v.as_array()?.iter().map(index).collect::<Option<Vec<usize>>>().filter(distinct)
    });
    t.show("measurements", list.clone());
    list
}

impl Simulate {
    fn read(t: &mut Table<'_>, seed: u64) -> Result<Self, ConfigError> {
        if !t.holds("mask") {
            let problem = "`data.mask` is missing: data.kind = \"simulate\" needs a table [data.mask]";
            return Err(t.error(problem));
        }
        let mask = t.part("mask", |t| MaskSource::read(t, seed))?;
        let (noise, seed) = t.part("noise", |t| Ok((noise(t, "sigma"), t.seed("seed", seed))))?;
        let (optics, readout) = t.part("camera", |t| Ok(camera::read(t, noise.unwrap_or(Noise::NONE))))?;
        Ok(Self { mask, camera: Camera { optics, readout, seed } })
    }
}

impl MaskSource {
    fn read(t: &mut Table<'_>, seed: u64) -> Result<Self, ConfigError> {
        let kind = t.kind(&["random", "shifting", "file"], None)?;
        if kind == "file" {
            return Ok(Self::File(t.path("path")));
        }
        let random = RandomMask {
            frames: t.whole("frames", 8, 2..=1024),
            density: t.number("density", 0.5, 1e-3..=1.0),
            signed: t.flag("signed", false),
            seed: t.seed("seed", seed),
        };
        Ok(if kind == "random" { Self::Random(random) } else { Self::Shifting(random) })
    }
}
