//! `[data]`: where the measurements come from.

use std::path::{Path, PathBuf};

use sci_forward::CfaPattern;

use crate::io::defects::Defects;
use crate::io::scene::{Axes, Keys, Reading};
use crate::table::{ConfigError, Table};

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

const AXES: [(&str, Axes); 2] = [("hwt", Axes::Hwt), ("thw", Axes::Thw)];
const PATTERNS: [(&str, CfaPattern); 4] =
    [("rggb", CfaPattern::Rggb), ("bggr", CfaPattern::Bggr), ("grbg", CfaPattern::Grbg), ("gbrg", CfaPattern::Gbrg)];
const DEFECTS: [(&str, Defects); 2] = [("keep", Defects::Keep), ("exclude", Defects::Exclude)];

impl Data {
    pub(super) fn read(t: &mut Table<'_>, seed: u64) -> Result<Self, ConfigError> {
        let simulated = t.kind(&["scene", "simulate"], Some("scene"))? == "simulate";
        let keys = t.part("keys", |t| Ok(part_names(t)))?;
        let simulate = if simulated { Some(Simulate::read(t, seed)?) } else { None };
        Ok(Self {
            path: t.path("path"),
            measurements: measurements(t),
            reading: Reading {
                keys,
                axes: t.optional_choice("axes", &AXES),
                scale: t.optional_number("scale", 1e-6..=1e6).map(|s| s as f32),
                cfa: t.optional_choice("cfa", &PATTERNS),
                defects: t.choice("defects", &DEFECTS, Defects::default()),
            },
            simulate,
        })
    }

    /// The file of masks, if there is one.
    pub(super) fn mask_file(&self) -> Option<&Path> {
        match &self.simulate {
            Some(Simulate { mask: MaskSource::File(path), .. }) => Some(path),
            _ => None,
        }
    }
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
        t.part("noise", |t| {
            Ok(Self {
                mask,
                sigma: t.sigma("sigma", 0.0),
                photons: t.optional_number("photons", 1e-3..=1e9),
                seed: t.seed("seed", seed),
            })
        })
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
            seed: t.seed("seed", seed),
        };
        Ok(if kind == "random" { Self::Random(random) } else { Self::Shifting(random) })
    }
}
