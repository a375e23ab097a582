//! `cargo xtask bench sensitivity`: the paper's figure of parameters, PSNR after each iteration for several schedules and
//! numbers of online updates.

use std::fs;
use std::path::PathBuf;

use anyhow::Context;
use serde_json::Value;

use crate::plot::{Axis, Look, Plot, Series, SeriesLabelPosition};
use crate::workspace::{Sci, results_dir, root};

#[derive(clap::Args)]
pub(crate) struct Options {
    /// The scene, as data.path [default: that of configs/bench/sensitivity.toml]
    #[arg(long, value_name = "FILE")]
    scene: Option<PathBuf>,
    /// Keep the plot and the table in xtask/results/CPU/
    #[arg(long)]
    save: bool,
}

const CONFIG: &str = "configs/bench/sensitivity.toml";
/// The schedules of the configuration, with their iterations.
const SCHEDULES: [(&str, usize); 4] = [("a", 25), ("b", 45), ("c", 36), ("d", 42)];
const UPDATES: [usize; 4] = [0, 1, 3, 5];

/// One curve of the figure.
struct Run {
    name: String,
    kept: u64,
    seconds: f64,
    /// After each iteration, in dB.
    psnr_db: Vec<f64>,
}

impl Run {
    fn read(name: String, record: &Value) -> anyhow::Result<Self> {
        let m = &record["measurements"][0];
        let trace = m["trace"]["psnr_db"].as_array().filter(|t| !t.is_empty());
        let trace = trace.with_context(|| format!("{name}: no PSNR: the scene has no truth"))?;
        Ok(Self {
            name,
            kept: m["updates"].as_u64().unwrap_or(0),
            seconds: m["seconds"].as_f64().context("a record without seconds")?,
            psnr_db: trace.iter().map(|v| v.as_f64().unwrap_or(f64::NAN)).collect(),
        })
    }

    /// The best iteration, counted from 1, and its PSNR.
    fn best(&self) -> (usize, f64) {
        let values = self.psnr_db.iter().copied().enumerate();
        values.fold((0, f64::NEG_INFINITY), |best, (k, db)| if db > best.1 { (k + 1, db) } else { best })
    }
}

/// Runs every schedule with every number of updates, and prints the table.
pub(crate) fn run(options: &Options) -> anyhow::Result<()> {
    let sci = Sci::build(None)?;
    let mut runs = Vec::new();
    for (schedule, iterations) in SCHEDULES {
        for updates in UPDATES {
            let mut sets = vec![format!("schedule={schedule}")];
            if updates > 0 {
                let interval = iterations / (updates + 1);
                sets.push("online.enabled=true".into());
                sets.push(format!("online.max_updates={updates}"));
                sets.push(format!("online.interval={interval}"));
            }
            sets.extend(options.scene.iter().map(|scene| format!("data.path={}", scene.display())));
            let name = format!("{}, {updates} updates", schedule.to_uppercase());
            let record = sci.run(&root().join(CONFIG), &sets)?.success().with_context(|| name.clone())?;
            runs.push(Run::read(name, &record)?);
        }
    }
    let table = table(&runs);
    print!("{table}");
    if options.save {
        let dir = results_dir()?;
        fs::write(dir.join("sensitivity.md"), table)?;
        fs::write(dir.join("sensitivity.svg"), plot(&runs).svg()?)?;
        println!("wrote {}", dir.join("sensitivity.svg").display());
    }
    Ok(())
}

fn table(runs: &[Run]) -> String {
    let head = "| schedule | updates kept | last, dB | best, dB | best after | seconds |\n|---|---|---|---|---|---|\n";
    let line = |r: &Run| {
        let (after, best) = r.best();
        let last = r.psnr_db.last().copied().unwrap_or(f64::NAN);
        format!("| {} | {} | {last:.2} | {best:.2} | {after} | {:.1} |\n", r.name, r.kept, r.seconds)
    };
    head.to_owned() + &runs.iter().map(line).collect::<String>()
}

fn plot(runs: &[Run]) -> Plot {
    let points = |r: &Run| r.psnr_db.iter().enumerate().map(|(k, &db)| (k as f64 + 1.0, db)).collect();
    let series = runs.iter().map(|r| Series { name: r.name.clone(), points: points(r), look: Look::Curve });
    Plot {
        caption: "Two-stage FFDNet: schedules A to D of the paper, by number of updates".into(),
        x: Axis { label: "iteration", log: false },
        y: Axis { label: "PSNR (dB)", log: false },
        series: series.collect(),
        shades: UPDATES.len(),
        legend: SeriesLabelPosition::LowerLeft,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_schedules_have_these_iterations() {
        let text = fs::read_to_string(root().join(CONFIG)).unwrap();
        let config: toml::Table = text.parse().unwrap();
        for (name, iterations) in SCHEDULES {
            let stages = config["schedules"][name].as_array().unwrap();
            let sum: i64 = stages.iter().map(|s| s["iterations"].as_integer().unwrap()).sum();
            assert_eq!(sum, iterations as i64, "{name}");
        }
    }

    #[test]
    fn the_best_iteration_is_counted_from_one() {
        let run = Run { name: "a".into(), kept: 0, seconds: 1.0, psnr_db: vec![20.0, 22.0, 21.0] };
        assert_eq!(run.best(), (2, 22.0));
    }
}
