//! What was measured as a table, and as plots with the Pareto front.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use super::curves::Suite;
use super::{Point, Results};
use crate::plot::{Axis, Look, Plot, Series, SeriesLabelPosition};
use crate::workspace::{median, range};

pub(super) fn table(results: &Results) -> String {
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
pub(super) fn draw(suite: Suite, results: &Results, dir: &Path) -> anyhow::Result<()> {
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
}
