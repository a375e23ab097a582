//! What is measured: experiments that ship, how a budget changes each, and the scenes with what is published for them.

use std::fs;
use std::path::PathBuf;

use anyhow::Context;

use crate::workspace::root;

/// One line of the plot.
pub(super) struct Curve {
    pub(super) name: &'static str,
    /// A file of `configs`.
    pub(super) config: &'static str,
    /// What is different, as for `--set`.
    pub(super) settings: &'static [&'static str],
    pub(super) budget: Budget,
}

/// What of an experiment's own stages is set, and to which numbers.
#[derive(Clone, Copy)]
pub(super) enum Budget {
    /// The iterations of each stage.
    Stages(&'static [usize]),
    /// The iterations of the last stage.
    Last(&'static [usize]),
    /// How many of the σ that the only stage lists, from its first to its last.
    Sigmas(&'static [usize]),
}

const fn curve(name: &'static str, config: &'static str, budget: Budget) -> Curve {
    Curve { name, config, settings: &[], budget }
}

impl Curve {
    const fn with(mut self, settings: &'static [&'static str]) -> Self {
        self.settings = settings;
        self
    }
}

const TV: Budget = Budget::Stages(&[4, 8, 16, 40, 80]);
const NET: Budget = Budget::Stages(&[1, 2, 3, 5, 10]);
const COLOR_NET: Budget = Budget::Stages(&[1, 2, 4]);
/// Of the two published networks the one by FFDNet's authors.
const WEIGHTS: &str = "denoiser.weights=ffdnet_gray.pth";

const GRAY: &[Curve] = &[
    curve("GAP-TV, reference", "gray/gap-tv.toml", TV),
    curve("GAP-TV", "gray/gap-tv-fast.toml", TV),
    curve("ADMM-TV", "gray/gap-tv-fast.toml", TV).with(&["solver={kind='admm'}"]),
    curve("GAP-FFDNet, reference", "gray/gap-ffdnet.toml", NET),
    curve("GAP-FFDNet", "gray/gap-ffdnet-fast.toml", NET).with(&[WEIGHTS]),
    curve("plain GAP-FFDNet", "gray/gap-ffdnet-fast.toml", NET)
        .with(&[WEIGHTS, "solver={kind='gap', accelerate=false}"]),
    curve("ADMM-FFDNet", "gray/gap-ffdnet-fast.toml", NET).with(&[WEIGHTS, "solver={kind='admm'}"]),
    curve("GAP-FFDNet, [skip]", "gray/gap-ffdnet-fast.toml", Budget::Stages(&[5, 10]))
        .with(&[WEIGHTS, "skip.enabled=true"]),
    curve("GAP-ShiftNet for iterates", "gray/fast.toml", Budget::Sigmas(&[3, 5, 7])),
    curve("GAP-FastDVDnet for iterates", "gray/fastdvdnet.toml", Budget::Sigmas(&[4, 8, 12])),
    curve("GAP-ShiftNet, then FastDVDnet", "gray/default.toml", Budget::Stages(&[1])),
    curve("ShiftNet, FastDVDnet and WNNM", "gray/refined.toml", Budget::Last(&[1, 2, 4, 6])),
];

const COLOR: &[Curve] = &[
    curve("GAP-TV", "color/gap-tv.toml", TV).with(&["solver={kind='gap'}"]),
    curve("GAP-FFDNet, Menon", "color/gap-ffdnet.toml", COLOR_NET),
    curve("two-stage FFDNet, paper", "color/two-stage-ffdnet.toml", COLOR_NET),
    curve("two-stage FFDNet, scaled", "color/two-stage-ffdnet-fast.toml", COLOR_NET),
    curve("two-stage FFDNet, scaled, [skip]", "color/two-stage-ffdnet-fast.toml", Budget::Stages(&[4]))
        .with(&["skip.enabled=true"]),
    curve("GAP-ShiftNet for iterates", "color/fast.toml", Budget::Sigmas(&[3, 5, 7])),
    curve("GAP-FastDVDnet for iterates", "color/fastdvdnet.toml", Budget::Sigmas(&[4, 6, 8])),
    curve("GAP-ShiftNet, then FastDVDnet", "color/default.toml", Budget::Stages(&[1])),
    curve("GAP-FastDVDnet for iterates, then WNNM", "color/refined.toml", Budget::Last(&[1, 2, 4, 6])),
];

/// A scene, and what is published for it: PSNR means over its measurements, not over the one measured here.
pub(super) struct Scene {
    pub(super) file: &'static str,
    pub(super) published: &'static [(&'static str, f64)],
}

const GRAY_SCENES: &[Scene] = &[
    Scene {
        file: "traffic48.mat",
        published: &[
            ("published GAP-TV", 20.66),
            ("published PnP-FFDNet", 24.01),
            ("published online FastDVDnet", 28.16),
        ],
    },
    Scene {
        file: "runner40.mat",
        published: &[
            ("published GAP-TV", 29.81),
            ("published PnP-FFDNet", 32.44),
            ("published online FastDVDnet", 36.41),
        ],
    },
];
const COLOR_SCENES: &[Scene] =
    &[Scene { file: "walk.npz", published: &[] }, Scene { file: "calendar.npz", published: &[] }];

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum Suite {
    Gray,
    Color,
}

impl Suite {
    pub(super) fn name(self) -> &'static str {
        if self == Self::Gray { "gray" } else { "color" }
    }

    pub(super) fn curves(self) -> &'static [Curve] {
        if self == Self::Gray { GRAY } else { COLOR }
    }

    pub(super) fn scenes(self) -> &'static [Scene] {
        if self == Self::Gray { GRAY_SCENES } else { COLOR_SCENES }
    }

    /// Commands of the peer with the weights they need.
    pub(super) fn peers(self) -> &'static [(&'static str, Option<&'static str>)] {
        match self {
            Self::Gray => &[("gap-tv", None), ("gap-ffdnet", Some("ffdnet_gray_ipol.pth"))],
            Self::Color => &[("two-stage", Some("ffdnet_color.pth"))],
        }
    }
}

impl Budget {
    pub(super) fn numbers(self) -> &'static [usize] {
        let (Self::Stages(numbers) | Self::Last(numbers) | Self::Sigmas(numbers)) = self;
        numbers
    }
}

impl Curve {
    pub(super) fn file(&self) -> PathBuf {
        root().join("configs").join(self.config)
    }

    /// What makes its file the experiment at one number of its budget, as for `--set`.
    pub(super) fn settings(&self, number: usize) -> anyhow::Result<Vec<String>> {
        let text = fs::read_to_string(self.file()).with_context(|| self.config)?;
        let file: toml::Table = text.parse().with_context(|| self.config)?;
        let stages = file.get("stage").and_then(|s| s.as_array()).filter(|stages| !stages.is_empty());
        let stages = stages.with_context(|| format!("{}: no [[stage]]", self.config))?;
        let iterations = |stage: usize| format!("stage.{stage}.iterations={number}");
        let mut settings: Vec<String> = self.settings.iter().map(|s| (*s).to_owned()).collect();
        match self.budget {
            Budget::Stages(_) => settings.extend((0..stages.len()).map(iterations)),
            Budget::Last(_) => settings.push(iterations(stages.len() - 1)),
            Budget::Sigmas(_) => {
                let sigmas = stages[0].get("sigma").and_then(|s| s.as_array());
                let sigmas = sigmas.with_context(|| format!("{}: its stage lists no σ", self.config))?;
                settings.push(format!("stage.0.sigma={}", toml::Value::Array(evenly(sigmas, number))));
            }
        }
        Ok(settings)
    }
}

/// So many of a list, the first and the last among them; all if it has no more.
fn evenly(list: &[toml::Value], count: usize) -> Vec<toml::Value> {
    let count = count.min(list.len());
    let last = count.saturating_sub(1).max(1);
    (0..count).map(|i| list[i * (list.len() - 1) / last].clone()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each curve at each budget is TOML, and has the stages of its experiment.
    #[test]
    fn every_curve_is_an_experiment() {
        for curve in GRAY.iter().chain(COLOR) {
            for &number in curve.budget.numbers() {
                for setting in curve.settings(number).unwrap() {
                    let (key, value) = setting.split_once('=').unwrap();
                    let is_path = setting == WEIGHTS;
                    let is_toml = format!("{key} = {value}").parse::<toml::Table>().is_ok();
                    assert!(is_path || is_toml, "{}: {setting}", curve.name);
                }
            }
        }
        let settings =
            |config: &str, number| GRAY.iter().find(|c| c.config == config).unwrap().settings(number).unwrap();
        assert_eq!(settings("gray/refined.toml", 4), ["stage.2.iterations=4"]);
        assert_eq!(settings("gray/fastdvdnet.toml", 4), ["stage.0.sigma=[20, 16, 12, 7]"]);
        assert_eq!(settings("gray/gap-ffdnet.toml", 3).len(), 4);
    }

    #[test]
    fn a_part_of_a_list_has_both_its_ends() {
        let list: Vec<toml::Value> = (0..12).map(toml::Value::from).collect();
        let part = |count| evenly(&list, count).iter().map(|v| v.as_integer().unwrap()).collect::<Vec<_>>();
        assert_eq!(part(1), [0]);
        assert_eq!(part(2), [0, 11]);
        assert_eq!(part(4), [0, 3, 7, 11]);
        assert_eq!(part(99).len(), 12);
    }
}
