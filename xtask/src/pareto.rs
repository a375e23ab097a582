//! `cargo xtask bench pareto`: seconds against PSNR of every solver × denoiser over a range of budgets, with the Pareto front,
//! the Python peers and the published numbers.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, ensure};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::plot::{Axis, Look, Plot, Series, SeriesLabelPosition};
use crate::workspace::{
    built_sci, cpu, json_lines, median, output, range, results_dir, revision, root, sci_run, shared,
};

#[derive(clap::Args)]
pub(crate) struct Options {
    /// The scenes and solvers to measure
    #[arg(long, value_enum, default_value_t = Suite::Gray)]
    suite: Suite,
    /// A Python with NumPy, SciPy, scikit-image and PyTorch; without it only our own side is measured
    #[arg(long, value_name = "PYTHON")]
    peer: Option<PathBuf>,
    /// Folder with data/, weights/ and peers/ [default: $SCI_DATA, else ../shared beside the repository]
    #[arg(long, value_name = "DIR")]
    shared: Option<PathBuf>,
    /// Measure this scene only, by the beginning of its file's name
    #[arg(long)]
    scene: Option<String>,
    /// Measure the curves whose name contains this only
    #[arg(long)]
    only: Option<String>,
    /// Every curve once more with this setting, as in --variant skip.enabled=true
    #[arg(long, value_name = "KEY=VALUE")]
    variant: Option<String>,
    /// Rounds; each runs everything once, so that what is compared alternates; 0 only draws what is kept
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(0..=100))]
    runs: u32,
    /// Add to the results kept in xtask/results/CPU/, and draw the plots from all of them
    #[arg(long)]
    save: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Suite {
    Gray,
    Color,
}

/// One line of the plot: an experiment that ships, and what its budget scales.
struct Curve {
    name: &'static str,
    /// A file of `configs`.
    config: &'static str,
    /// What is different, as for `--set`.
    settings: &'static [&'static str],
    /// A file of weights/ in the place of the experiment's.
    weights: Option<&'static str>,
    /// σ of the stages, in 0..255 units, each with the iterations of the budget; with none, the experiment's own stages, the
    /// last with the iterations of the budget.
    sigmas: &'static [f32],
    budgets: &'static [usize],
}

const SIGMAS: &[f32] = &[50.0, 25.0, 12.0, 6.0];
/// Of the networks that were trained on a solver's iterates.
const FOR_ITERATES: &[f32] = &[20.0, 14.0, 10.0, 7.0];
const TV: &[usize] = &[4, 8, 16, 40, 80];
const NET: &[usize] = &[1, 2, 3, 5, 10];

const GRAY: &[Curve] = &[
    Curve {
        name: "GAP-TV, reference",
        config: "gray/gap-tv.toml",
        settings: &[],
        weights: None,
        sigmas: &[],
        budgets: TV,
    },
    Curve { name: "GAP-TV", config: "gray/gap-tv-fast.toml", settings: &[], weights: None, sigmas: &[], budgets: TV },
    Curve {
        name: "ADMM-TV",
        config: "gray/gap-tv-fast.toml",
        settings: &["solver={kind='admm'}"],
        weights: None,
        sigmas: &[],
        budgets: TV,
    },
    Curve {
        name: "GAP-FFDNet, reference",
        config: "gray/gap-ffdnet.toml",
        settings: &[],
        weights: Some("ffdnet_gray_ipol.pth"),
        sigmas: SIGMAS,
        budgets: NET,
    },
    Curve {
        name: "GAP-FFDNet",
        config: "gray/gap-ffdnet-fast.toml",
        settings: &[],
        weights: Some("ffdnet_gray.pth"),
        sigmas: SIGMAS,
        budgets: NET,
    },
    Curve {
        name: "plain GAP-FFDNet",
        config: "gray/gap-ffdnet-fast.toml",
        settings: &["solver={kind='gap', accelerate=false}"],
        weights: Some("ffdnet_gray.pth"),
        sigmas: SIGMAS,
        budgets: NET,
    },
    Curve {
        name: "ADMM-FFDNet",
        config: "gray/gap-ffdnet-fast.toml",
        settings: &["solver={kind='admm'}"],
        weights: Some("ffdnet_gray.pth"),
        sigmas: SIGMAS,
        budgets: NET,
    },
    Curve {
        name: "GAP-FFDNet, [skip]",
        config: "gray/gap-ffdnet-fast.toml",
        settings: &["skip.enabled=true"],
        weights: Some("ffdnet_gray.pth"),
        sigmas: SIGMAS,
        budgets: &[5, 10],
    },
    Curve {
        name: "GAP-FastDVDnet for iterates",
        config: "gray/default.toml",
        settings: &[],
        weights: None,
        sigmas: FOR_ITERATES,
        budgets: &[1, 2, 3],
    },
    Curve {
        name: "GAP-FastDVDnet for iterates, then WNNM",
        config: "gray/refined.toml",
        settings: &[],
        weights: None,
        sigmas: &[],
        budgets: &[1, 2, 4, 6],
    },
];

const COLOR: &[Curve] = &[
    Curve {
        name: "GAP-TV",
        config: "color/gap-tv.toml",
        settings: &["solver={kind='gap'}"],
        weights: None,
        sigmas: &[],
        budgets: TV,
    },
    Curve {
        name: "GAP-FFDNet, Menon",
        config: "color/gap-ffdnet.toml",
        settings: &[],
        weights: Some("ffdnet_color.pth"),
        sigmas: SIGMAS,
        budgets: &[1, 2, 4],
    },
    Curve {
        name: "two-stage FFDNet, paper",
        config: "color/two-stage-ffdnet.toml",
        settings: &[],
        weights: Some("ffdnet_color.pth"),
        sigmas: SIGMAS,
        budgets: &[1, 2, 4],
    },
    Curve {
        name: "two-stage FFDNet, scaled",
        config: "color/two-stage-ffdnet-fast.toml",
        settings: &[],
        weights: Some("ffdnet_color.pth"),
        sigmas: SIGMAS,
        budgets: &[1, 2, 4],
    },
    Curve {
        name: "two-stage FFDNet, scaled, [skip]",
        config: "color/two-stage-ffdnet-fast.toml",
        settings: &["skip.enabled=true"],
        weights: Some("ffdnet_color.pth"),
        sigmas: SIGMAS,
        budgets: &[4],
    },
    Curve {
        name: "GAP-FastDVDnet for iterates",
        config: "color/default.toml",
        settings: &[],
        weights: None,
        sigmas: FOR_ITERATES,
        budgets: &[1, 2, 3],
    },
    Curve {
        name: "GAP-FastDVDnet for iterates, then WNNM",
        config: "color/refined.toml",
        settings: &[],
        weights: None,
        sigmas: &[],
        budgets: &[1, 2, 4, 6],
    },
];

/// A scene, and what is published for it: PSNR means over its measurements, not over the one measured here.
struct Scene {
    file: &'static str,
    published: &'static [(&'static str, f64)],
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

impl Suite {
    fn name(self) -> &'static str {
        if self == Self::Gray { "gray" } else { "color" }
    }

    fn curves(self) -> &'static [Curve] {
        if self == Self::Gray { GRAY } else { COLOR }
    }

    fn scenes(self) -> &'static [Scene] {
        if self == Self::Gray { GRAY_SCENES } else { COLOR_SCENES }
    }

    /// Commands of the peer with the weights they need.
    fn peers(self) -> &'static [(&'static str, Option<&'static str>)] {
        match self {
            Self::Gray => &[("gap-tv", None), ("gap-ffdnet", Some("ffdnet_gray_ipol.pth"))],
            Self::Color => &[("two-stage", Some("ffdnet_color.pth"))],
        }
    }
}

/// What is known of one curve at one budget on one scene.
#[derive(Clone, Serialize, Deserialize)]
struct Point {
    scene: String,
    curve: String,
    iterations: u64,
    psnr_db: f64,
    ssim: f64,
    peak_rss_bytes: u64,
    seconds: Vec<f64>,
}

impl Point {
    fn is_peer(&self) -> bool {
        self.curve.starts_with("Python")
    }
}

#[derive(Default, Serialize, Deserialize)]
struct Results {
    suite: String,
    cpu: String,
    revision: String,
    points: Vec<Point>,
}

impl Results {
    fn read(path: &Path) -> anyhow::Result<Self> {
        let text = fs::read_to_string(path).with_context(|| path.display().to_string())?;
        serde_json::from_str(&text).with_context(|| path.display().to_string())
    }

    /// Adds a run. The quality of a point does not vary; if it changed, what was measured before is of another program.
    fn push(&mut self, run: Point) {
        let same = |p: &&mut Point| (&p.scene, &p.curve, p.iterations) == (&run.scene, &run.curve, run.iterations);
        match self.points.iter_mut().find(same) {
            Some(p) if (p.psnr_db - run.psnr_db).abs() < 1e-3 => {
                p.seconds.extend(run.seconds);
                p.peak_rss_bytes = p.peak_rss_bytes.max(run.peak_rss_bytes);
            }
            Some(p) => *p = run,
            None => self.points.push(run),
        }
    }
}

/// Measures, prints the table, and with `--save` keeps it and draws the plots.
pub(crate) fn run(options: &Options) -> anyhow::Result<()> {
    let suite = options.suite;
    let kept = results_dir()?.join(format!("pareto-{}.json", suite.name()));
    let mut results = if options.save && kept.is_file() { Results::read(&kept)? } else { Results::default() };
    if options.runs > 0 {
        let sci = built_sci()?;
        (0..options.runs).try_for_each(|_| round(options, &sci, &mut results))?;
    }
    ensure!(!results.points.is_empty(), "nothing was measured");
    (results.suite, results.cpu, results.revision) = (suite.name().into(), cpu(), revision()?);
    print!("{}", table(&results));
    if options.save {
        fs::write(&kept, serde_json::to_string_pretty(&results)? + "\n")?;
        draw(suite, &results, &results_dir()?)?;
        println!("wrote {}", kept.display());
    }
    Ok(())
}

/// Every curve at every budget on every scene once, the peers too.
fn round(options: &Options, sci: &Path, results: &mut Results) -> anyhow::Result<()> {
    let shared = shared(options.shared.as_deref())?;
    let out = std::env::temp_dir().join(format!("sci-pareto-{}", std::process::id()));
    let wanted = |name: &str, filter: &Option<String>| filter.as_ref().is_none_or(|f| name.contains(f.as_str()));
    for scene in options.suite.scenes().iter().filter(|s| wanted(s.file, &options.scene)) {
        let data = shared.join("data").join(scene.file);
        if !data.is_file() {
            println!("no data: {}", data.display());
            continue;
        }
        for curve in options.suite.curves().iter().filter(|c| wanted(c.name, &options.only)) {
            for &budget in curve.budgets {
                for variant in
                    [None, options.variant.as_deref()].iter().take(1 + usize::from(options.variant.is_some()))
                {
                    let mut sets = curve.settings(budget)?;
                    sets.push(format!("data.path={}", data.display()));
                    let weights = curve.weights.map(|file| shared.join("weights").join(file));
                    sets.extend(weights.map(|path| format!("denoiser.weights={}", path.display())));
                    sets.extend(variant.map(str::to_owned));
                    let record = match sci_run(sci, &curve.file(), &sets, &out)?.success() {
                        Ok(record) => record,
                        Err(e) => {
                            println!("{} × {budget} on {}: {e}", curve.name, scene.file);
                            continue;
                        }
                    };
                    let name = variant.map_or(curve.name.to_owned(), |v| format!("{}, {v}", curve.name));
                    results.push(point(scene.file, name, &record)?);
                }
            }
        }
        if let Some(python) = &options.peer {
            for (command, weights) in options.suite.peers() {
                results.push(peer(python, &shared, scene.file, command, *weights)?);
            }
        }
    }
    let _ = fs::remove_dir_all(&out);
    Ok(())
}

impl Curve {
    fn file(&self) -> PathBuf {
        root().join("configs").join(self.config)
    }

    /// What makes its file the experiment at a budget, as for `--set`.
    fn settings(&self, budget: usize) -> anyhow::Result<Vec<String>> {
        let mut settings: Vec<String> = self.settings.iter().map(|s| (*s).to_owned()).collect();
        settings.push(if self.sigmas.is_empty() {
            let text = fs::read_to_string(self.file()).with_context(|| self.config)?;
            let file: toml::Table = text.parse().with_context(|| self.config)?;
            let stages = file.get("stage").and_then(|s| s.as_array()).map_or(0, Vec::len);
            let last = stages.checked_sub(1).with_context(|| format!("{}: no [[stage]]", self.config))?;
            format!("stage.{last}.iterations={budget}")
        } else {
            format!("stage=[{{ sigma = {:?}, iterations = {budget} }}]", self.sigmas)
        });
        settings.extend(["data.measurements=[0]", "output.frames=false", "output.preview=false"].map(String::from));
        Ok(settings)
    }
}

fn point(scene: &str, curve: String, record: &Value) -> anyhow::Result<Point> {
    let m = &record["measurements"][0];
    let number = |v: &Value| v.as_f64().with_context(|| format!("{curve}: expected a number, found {v}"));
    Ok(Point {
        scene: scene.into(),
        iterations: m["iterations"].as_u64().unwrap_or(0),
        psnr_db: number(&m["psnr_db"])?,
        ssim: number(&m["ssim"])?,
        peak_rss_bytes: record["peak_rss_bytes"].as_u64().unwrap_or(0),
        seconds: vec![number(&m["seconds"])?],
        curve,
    })
}

fn peer(python: &Path, shared: &Path, scene: &str, command: &str, weights: Option<&str>) -> anyhow::Result<Point> {
    let mut peer = Command::new(python);
    peer.arg(shared.join("peers/peer.py")).arg(command).arg(shared.join("data").join(scene));
    if let Some(weights) = weights {
        peer.arg(shared.join("weights").join(weights));
    }
    let printed = output(&mut peer)?;
    let result = json_lines(&printed).last().context("the peer printed no result")?;
    let number = |key: &str| result[key].as_f64().with_context(|| format!("the peer's {key} in {result}"));
    Ok(Point {
        scene: scene.into(),
        curve: format!("Python {command}"),
        iterations: result["iterations"].as_u64().unwrap_or(0),
        psnr_db: number("psnr")?,
        ssim: number("ssim")?,
        peak_rss_bytes: 0,
        seconds: vec![number("seconds")?],
    })
}

fn table(results: &Results) -> String {
    let mut out = String::new();
    let mut last = "";
    for p in &results.points {
        if p.scene != last {
            out += &format!(
                "\n| {} | its | PSNR | SSIM | seconds (from, to, runs) | MB |\n|---|---|---|---|---|---|\n",
                p.scene
            );
            last = &p.scene;
        }
        let (low, high) = range(&p.seconds);
        let memory = if p.peak_rss_bytes > 0 { format!("{}", p.peak_rss_bytes / 1_000_000) } else { "–".into() };
        out += &format!(
            "| {} | {} | {:.2} | {:.4} | {:.4} ({low:.4}, {high:.4}, {}) | {memory} |\n",
            p.curve,
            p.iterations,
            p.psnr_db,
            p.ssim,
            median(&p.seconds),
            p.seconds.len()
        );
    }
    out + "\n"
}

/// Those points that no other beats in both time and PSNR, by time.
fn front(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let mut sorted = points.to_vec();
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0).then(b.1.total_cmp(&a.1)));
    let mut best = f64::NEG_INFINITY;
    sorted.retain(|p| {
        let better = p.1 > best;
        best = best.max(p.1);
        better
    });
    front_steps(&sorted)
}

/// The front as the staircase that it is.
fn front_steps(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let mut steps = Vec::new();
    for pair in points.windows(2) {
        steps.extend([pair[0], (pair[1].0, pair[0].1)]);
    }
    steps.extend(points.last());
    steps
}

/// One plot for each scene, and one for the mean over the scenes: PSNR, and root mean square error.
fn draw(suite: Suite, results: &Results, dir: &Path) -> anyhow::Result<()> {
    for scene in suite.scenes() {
        let points: Vec<Point> = results.points.iter().filter(|p| p.scene == scene.file).cloned().collect();
        if !points.is_empty() {
            let name = scene.file.split('.').next().unwrap_or(scene.file);
            save_plots(
                &points,
                scene.published,
                &format!("{name}, measurement 0"),
                &dir.join(format!("pareto-{name}")),
            )?;
        }
    }
    save_plots(
        &mean(results),
        &[],
        &format!("mean of the {} scenes, measurement 0", suite.name()),
        &dir.join(format!("pareto-{}", suite.name())),
    )
}

/// Mean PSNR and mean of the median seconds of what was measured on every scene.
fn mean(results: &Results) -> Vec<Point> {
    let mut groups: BTreeMap<(String, u64), Vec<&Point>> = BTreeMap::new();
    for p in &results.points {
        groups.entry((p.curve.clone(), p.iterations)).or_default().push(p);
    }
    let scenes = results.points.iter().map(|p| &p.scene).collect::<std::collections::BTreeSet<_>>().len();
    let complete = groups.into_values().filter(|g| g.len() == scenes);
    complete
        .map(|group| {
            let mean = |value: &dyn Fn(&Point) -> f64| group.iter().map(|p| value(p)).sum::<f64>() / scenes as f64;
            let (psnr_db, seconds) = (mean(&|p| p.psnr_db), mean(&|p| median(&p.seconds)));
            Point { scene: "mean".into(), psnr_db, seconds: vec![seconds], ..group[0].clone() }
        })
        .collect()
}

fn save_plots(points: &[Point], published: &[(&str, f64)], title: &str, path: &Path) -> anyhow::Result<()> {
    let psnr = |db: f64| db;
    // Against white = 1, in gray levels of 255.
    let rmse = |db: f64| 255.0 * 10f64.powf(-db / 20.0);
    let plot = |what: &str, y: Axis, of: &dyn Fn(f64) -> f64| {
        let caption = format!("Run time against {what}: {title}");
        let (x, series) = (Axis { label: "seconds", log: true }, series(points, published, of));
        Plot { caption, x, y, series, shades: 1, legend: SeriesLabelPosition::LowerRight }.svg()
    };
    let quality = plot("quality", Axis { label: "PSNR (dB)", log: false }, &psnr)?;
    fs::write(path.with_extension("svg"), quality)?;
    let label = "root mean square error (gray levels of 255)";
    let error = plot("error", Axis { label, log: true }, &rmse)?;
    fs::write(format!("{}-error.svg", path.display()), error)?;
    Ok(())
}

fn series(points: &[Point], published: &[(&str, f64)], of: &dyn Fn(f64) -> f64) -> Vec<Series> {
    let mut names: Vec<&String> = Vec::new();
    points.iter().for_each(|p| {
        if !names.contains(&&p.curve) {
            names.push(&p.curve);
        }
    });
    let at = |p: &Point| (median(&p.seconds), of(p.psnr_db));
    let curves = names.iter().map(|name| {
        let mut own: Vec<&Point> = points.iter().filter(|p| p.curve == **name).collect();
        own.sort_by_key(|p| p.iterations);
        let look = if own[0].is_peer() { Look::Marks } else { Look::Curve };
        Series { name: (*name).clone(), points: own.into_iter().map(at).collect(), look }
    });
    let ours: Vec<(f64, f64)> =
        points.iter().filter(|p| !p.is_peer()).map(|p| (median(&p.seconds), p.psnr_db)).collect();
    let front = front(&ours).into_iter().map(|(s, db)| (s, of(db))).collect();
    let levels = published.iter().map(|(name, db)| Series {
        name: (*name).to_owned(),
        points: vec![(1.0, of(*db))],
        look: Look::Level,
    });
    let mut all: Vec<Series> = curves.collect();
    all.push(Series { name: "Pareto front".into(), points: front, look: Look::Front });
    all.extend(levels);
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_front_leaves_out_what_is_beaten_and_goes_in_steps() {
        let points = [(2.0, 25.0), (1.0, 20.0), (3.0, 24.0), (1.0, 19.0), (4.0, 26.0)];
        assert_eq!(front(&points), [(1.0, 20.0), (2.0, 20.0), (2.0, 25.0), (4.0, 25.0), (4.0, 26.0)]);
    }

    /// Each curve at each budget is TOML, and has the stages that its experiment has, or those of its σ.
    #[test]
    fn every_curve_is_an_experiment() {
        for curve in GRAY.iter().chain(COLOR) {
            for setting in curve.settings(3).unwrap() {
                let (key, value) = setting.split_once('=').unwrap();
                assert!(format!("{key} = {value}").parse::<toml::Table>().is_ok(), "{}: {setting}", curve.name);
            }
        }
        let refined = GRAY.iter().find(|c| c.config == "gray/refined.toml").unwrap();
        assert!(refined.settings(4).unwrap().contains(&"stage.1.iterations=4".to_owned()));
    }

    #[test]
    fn runs_of_one_point_add_up_and_another_program_starts_anew() {
        let point = |psnr_db, seconds| Point {
            scene: "s".into(),
            curve: "c".into(),
            iterations: 4,
            psnr_db,
            ssim: 0.5,
            peak_rss_bytes: 1,
            seconds: vec![seconds],
        };
        let mut results = Results::default();
        [(20.0, 1.0), (20.0, 2.0)].into_iter().for_each(|(p, s)| results.push(point(p, s)));
        assert_eq!(results.points[0].seconds, [1.0, 2.0]);
        results.push(point(21.0, 3.0));
        assert_eq!((results.points.len(), &results.points[0].seconds[..]), (1, &[3.0][..]));
    }
}
