//! `cargo xtask bench pareto`: seconds against PSNR of every solver × denoiser over a range of budgets, with the Pareto front,
//! the Python peers and the published numbers.

mod curves;
mod draw;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, ensure};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::workspace::{Sci, cpu, json_lines, output, results_dir, revision, shared};
use curves::{Curve, Suite};

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
    let mut faults = Vec::new();
    if options.runs > 0 {
        let sci = Sci::build(options.shared.as_deref())?;
        (0..options.runs).try_for_each(|_| round(options, &sci, &mut results, &mut faults))?;
    }
    ensure!(!results.points.is_empty(), "nothing was measured\n{}", faults.join("\n"));
    (results.suite, results.cpu, results.revision) = (suite.name().into(), cpu(), revision()?);
    print!("{}", draw::table(&results));
    if options.save {
        fs::write(&kept, serde_json::to_string_pretty(&results)? + "\n")?;
        draw::draw(suite, &results, &results_dir()?)?;
        println!("wrote {}", kept.display());
    }
    ensure!(faults.is_empty(), "{}", faults.join("\n"));
    Ok(())
}

/// Every curve at every budget on every scene once, the peers too; what did not run to its end is among the `faults`.
fn round(options: &Options, sci: &Sci, results: &mut Results, faults: &mut Vec<String>) -> anyhow::Result<()> {
    let shared = shared(options.shared.as_deref())?;
    let wanted = |name: &str, filter: &Option<String>| filter.as_ref().is_none_or(|f| name.contains(f.as_str()));
    for scene in options.suite.scenes().iter().filter(|s| wanted(s.file, &options.scene)) {
        let data = shared.join("data").join(scene.file);
        if !data.is_file() {
            println!("no data: {}", data.display());
            continue;
        }
        for curve in options.suite.curves().iter().filter(|c| wanted(c.name, &options.only)) {
            for &number in curve.budget.numbers() {
                for variant in [None, options.variant.as_deref()].into_iter().take(1 + options.variant.iter().len()) {
                    match measure(sci, curve, number, variant, &data) {
                        Ok(point) => results.push(point),
                        Err(e) => faults.push(format!("{} × {number} on {}: {e:#}", curve.name, scene.file)),
                    }
                }
            }
        }
        if let Some(python) = &options.peer {
            for (command, weights) in options.suite.peers() {
                results.push(peer(python, &shared, scene.file, command, *weights)?);
            }
        }
    }
    Ok(())
}

/// A curve at one number of its budget, perhaps with a setting more, on measurement 0.
fn measure(sci: &Sci, curve: &Curve, number: usize, variant: Option<&str>, data: &Path) -> anyhow::Result<Point> {
    let mut sets = curve.settings(number)?;
    sets.extend(["data.measurements=[0]".to_owned(), format!("data.path={}", data.display())]);
    sets.extend(variant.map(str::to_owned));
    let record = sci.run(&curve.file(), &sets)?.success()?;
    let name = variant.map_or(curve.name.to_owned(), |v| format!("{}, {v}", curve.name));
    let scene = data.file_name().unwrap_or_default().to_string_lossy();
    point(&scene, name, &record)
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

#[cfg(test)]
mod tests {
    use super::*;

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
