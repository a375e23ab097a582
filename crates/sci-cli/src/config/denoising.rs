//! Owns the rules of `[denoiser]`.

use admm::Wnnm;
use nets::Ends;
use nets::kernels::Precision;
use nets::weights::bundled_for_iterates;

use super::check::{Checker, PathSetting};
use super::file::{NetKeys, Section, TvKeys, Value, VideoNetKeys, WnnmKeys};
use super::source::ConfigError;

/// How a network is run.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Inference {
    /// What it multiplies.
    pub precision: Precision,
    /// Whether it sees the video another way round in every iteration.
    pub flips: bool,
}

/// `[denoiser]`.
#[derive(Clone, Debug)]
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
        /// Weight file.
        weights: PathSetting,
        /// How it is run.
        inference: Inference,
    },
    /// FastDVDnet.
    Fastdvdnet {
        /// Weight file.
        weights: PathSetting,
        /// What stands for the frames before the first and after the last.
        ends: Ends,
        /// How it is run.
        inference: Inference,
    },
}

impl Denoiser {
    /// The weight file of a network.
    pub fn weights(&self) -> Option<&PathSetting> {
        match self {
            Self::Tv { .. } | Self::Wnnm(_) => None,
            Self::Ffdnet { weights, .. } | Self::Fastdvdnet { weights, .. } => Some(weights),
        }
    }

    /// Whether it is a network that was trained for the iterates of one schedule.
    pub fn for_iterates(&self) -> bool {
        self.weights().is_some_and(|weights| bundled_for_iterates(&weights.text))
    }

    /// Whether it sees the video another way round in every iteration.
    pub fn flips(&self) -> bool {
        match self {
            Self::Tv { .. } | Self::Wnnm(_) => false,
            Self::Ffdnet { inference, .. } | Self::Fastdvdnet { inference, .. } => inference.flips,
        }
    }
}

impl<'s> Checker<'s> {
    fn inference(&self, key: &str, precision: &Value, flips: &Value) -> Result<Inference, ConfigError> {
        Ok(Inference {
            precision: self.precision(&format!("{key}.precision"), precision)?.unwrap_or_default(),
            flips: self.flag(&format!("{key}.flips"), flips)?.unwrap_or(false),
        })
    }

    /// What a network multiplies.
    pub(super) fn precision(&self, key: &str, value: &Value) -> Result<Option<Precision>, ConfigError> {
        self.choice(key, value, &[("f32", Precision::F32), ("bf16", Precision::Bf16)])
    }

    /// A `[denoiser]`, or that of a stage.
    pub(super) fn denoiser(&self, mut section: Section<'s>) -> Result<Denoiser, ConfigError> {
        let (key, span) = (section.key.clone(), section.span.clone());
        let kind = section.take_kind(&["tv", "ffdnet", "fastdvdnet", "wavelet", "wnnm"], None)?;
        match kind.get_ref().as_str() {
            "tv" => {
                let k: TvKeys = section.read(&["kind"])?;
                Ok(Denoiser::Tv {
                    weight: self.number(&format!("{key}.weight"), &k.weight, 1e-6..=100.0)?.unwrap_or(0.3) as f32,
                    inner: self.whole(&format!("{key}.inner"), &k.inner, 1..=1000)?.unwrap_or(5) as usize,
                })
            }
            "wnnm" => {
                let k: WnnmKeys = section.read(&["kind"])?;
                let default = Wnnm::default();
                let whole = |name: &str, value, range, default: usize| {
                    Ok(self.whole(&format!("{key}.{name}"), value, range)?.map_or(default, |n| n as usize))
                };
                Ok(Denoiser::Wnnm(Wnnm {
                    patch: whole("patch", &k.patch, 2..=16, default.patch)?,
                    group: whole("group", &k.group, 2..=256, default.group)?,
                    step: whole("step", &k.step, 1..=16, default.step)?,
                    window: whole("window", &k.window, 1..=64, default.window)?,
                    frames: whole("frames", &k.frames, 0..=64, default.frames)?,
                }))
            }
            "ffdnet" => {
                let k: NetKeys = section.read(&["kind"])?;
                Ok(Denoiser::Ffdnet {
                    inference: self.inference(&key, &k.precision, &k.flips)?,
                    weights: self.path(&format!("{key}.weights"), k.weights, &span)?,
                })
            }
            "fastdvdnet" => {
                let k: VideoNetKeys = section.read(&["kind"])?;
                let ends = [("circular", Ends::Circular), ("mirrored", Ends::Mirrored)];
                Ok(Denoiser::Fastdvdnet {
                    ends: self.choice(&format!("{key}.ends"), &k.ends, &ends)?.unwrap_or_default(),
                    inference: self.inference(&key, &k.precision, &k.flips)?,
                    weights: self.path(&format!("{key}.weights"), k.weights, &span)?,
                })
            }
            _ => Err(self.not_yet(&format!("{key}.kind"), &kind.span(), "tv, wnnm, ffdnet, fastdvdnet")),
        }
    }
}
