//! `cargo xtask repro`: the paper's tables, cell by cell, beside what this program gives.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use serde::Deserialize;
use serde_json::Value;

use crate::workspace::{Sci, Told, root, shared};

#[derive(clap::Args)]
pub(crate) struct Options {
    /// Which of the paper's tables
    #[arg(value_enum)]
    table: Which,
    /// Fail if a cell with an expected value is off it by more than configs/expected.toml tolerates
    #[arg(long)]
    check: bool,
    /// The demo's first snapshot instead of the paper's scenes, with the program that tests use: half a minute, and no data are needed
    #[arg(long, conflicts_with = "save")]
    demo: bool,
    /// Only the first measurement of each scene: less time, but figures that are not the published ones' means
    #[arg(long, conflicts_with_all = ["check", "demo", "save"])]
    first: bool,
    /// Only rows whose names hold this
    #[arg(long, value_name = "TEXT", default_value = "", conflicts_with = "save")]
    row: String,
    /// Keep the table in xtask/results/CPU/
    #[arg(long)]
    save: bool,
    /// Folder with data/ and weights/ [default: $SCI_DATA, else ../shared beside the repository]
    #[arg(long, value_name = "DIR")]
    shared: Option<PathBuf>,
}

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Which {
    TableGray,
    TableColor,
}

/// configs/expected.toml.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Expected {
    tolerance: Tolerance,
    gray: Table,
    color: Table,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Tolerance {
    psnr_db: f64,
    ssim: f64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    scenes: Vec<Scene>,
    row: Vec<Row>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Scene {
    name: String,
    file: String,
    measurements: Option<Vec<usize>>,
}

/// An algorithm; lists are in the order of the scenes, those that nothing was published of at the end.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Row {
    name: String,
    config: String,
    /// Weight files by the key that names them.
    #[serde(default)]
    weights: BTreeMap<String, String>,
    #[serde(default)]
    published: Vec<f64>,
    #[serde(default)]
    published_ssim: Vec<f64>,
    /// The row that it is meant to be better than, if any, and why it is not.
    extends: Option<String>,
    why: Option<String>,
    /// PSNR and SSIM on the demo.
    demo: Option<[f64; 2]>,
    /// PSNR and SSIM that this program gave, by the scene's name.
    #[serde(default)]
    expected: BTreeMap<String, [f64; 2]>,
}

/// What this program gives for a cell.
struct Ours {
    psnr_db: f64,
    ssim: f64,
    seconds: f64,
}

/// Prints the table; with `--check`, fails if a cell is off.
pub(crate) fn run(options: &Options) -> anyhow::Result<()> {
    let path = root().join("configs/expected.toml");
    let text = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    let expected: Expected = toml::from_str(&text).with_context(|| path.display().to_string())?;
    let mut table = if options.table == Which::TableGray { expected.gray } else { expected.color };
    table.row.retain(|row| row.name.contains(&options.row));
    if options.first {
        table.scenes.iter_mut().for_each(|scene| scene.measurements = Some(vec![0]));
    }
    let table = &table;
    let off = if options.demo {
        on_demo(table, &expected.tolerance)?
    } else {
        let shared = shared(options.shared.as_deref())?;
        let (told, off) = on_scenes(table, &expected.tolerance, &Sci::build(Some(&shared))?, &shared)?;
        if options.save {
            let name = if options.table == Which::TableGray { "repro-gray.md" } else { "repro-color.md" };
            told.save(name)?;
        }
        off
    };
    off.iter().for_each(|o| eprintln!("off: {o}"));
    ensure!(!options.check || off.is_empty(), "{} cells are off", off.len());
    Ok(())
}

impl Tolerance {
    /// What is wrong with a cell, if anything.
    fn off(&self, named: &str, ours: &Ours, [psnr, ssim]: [f64; 2]) -> Option<String> {
        let off = (ours.psnr_db - psnr).abs() > self.psnr_db || (ours.ssim - ssim).abs() > self.ssim;
        off.then(|| {
            format!(
                "{named}: {:.3} dB, {:.4}; expected {psnr} dB ± {}, {ssim} ± {}",
                ours.psnr_db, ours.ssim, self.psnr_db, self.ssim
            )
        })
    }
}

/// Every row with what is expected of it on the demo; what is off.
fn on_demo(table: &Table, tolerance: &Tolerance) -> anyhow::Result<Vec<String>> {
    let sci = Sci::build_as_tests_do()?;
    let video = root().join("configs/demo/bunny");
    let sets = [
        "data.kind=simulate".to_owned(),
        format!("data.path={}", video.display()),
        "data.mask={kind=\"random\"}".to_owned(),
        "data.measurements=[0]".to_owned(),
    ];
    let mut off = Vec::new();
    println!("| algorithm | the demo's first snapshot | SSIM | seconds |\n|---|---|---|---|");
    for row in &table.row {
        let Some(expected) = row.demo else { continue };
        let ours = ours(&sci.run(&root().join("configs").join(&row.config), &sets)?.success()?)
            .with_context(|| format!("{}: no truth", row.name))?;
        println!("| {} | {:.2} | {:.4} | {:.2} |", row.name, ours.psnr_db, ours.ssim, ours.seconds);
        off.extend(tolerance.off(&format!("{} on the demo", row.name), &ours, expected));
    }
    Ok(off)
}

/// Every row on every scene that is there: the table as printed, and what is off.
fn on_scenes(table: &Table, tolerance: &Tolerance, sci: &Sci, shared: &Path) -> anyhow::Result<(Told, Vec<String>)> {
    let mut off = Vec::new();
    let mut told = Told::default();
    told.line("| algorithm | scene | published | ours | difference | SSIM, published | seconds a measurement |");
    told.line("|---|---|---|---|---|---|---|");
    let mut found = BTreeMap::new();
    for row in &table.row {
        for (i, scene) in table.scenes.iter().enumerate() {
            let published = row.published.get(i);
            let [of_psnr, of_ssim] = [published, row.published_ssim.get(i)];
            let [psnr, ssim] = [of_psnr.map(|v| format!("{v:.2}")), of_ssim.map(|v| format!("{v:.3}"))]
                .map(|text| text.unwrap_or_else(|| "–".to_owned()));
            let named = format!("| {} | {} | {psnr}", row.name, scene.name);
            match cell(sci, shared, row, scene)? {
                Err(lacking) => told.line(&format!("{named} | {lacking} | – | – ({ssim}) | – |")),
                Ok(ours) => {
                    let Ours { psnr_db, ssim: own, seconds } = ours;
                    let off_by = published.map_or_else(|| "–".to_owned(), |v| format!("{:+.2}", psnr_db - v));
                    told.line(&format!("{named} | {psnr_db:.2} | {off_by} | {own:.3} ({ssim}) | {seconds:.2} |"));
                    let expected = row.expected.get(&scene.name).copied();
                    off.extend(
                        expected.and_then(|e| tolerance.off(&format!("{} on {}", row.name, scene.name), &ours, e)),
                    );
                    found.insert((row.name.as_str(), scene.name.as_str()), psnr_db);
                }
            }
        }
    }
    for row in &table.row {
        if let Some(line) = worse(row, &found) {
            told.line(&format!("\n{line}"));
        }
    }
    Ok((told, off))
}

/// What is to be said of a row that is worse than the one it extends.
fn worse(row: &Row, found: &BTreeMap<(&str, &str), f64>) -> Option<String> {
    let other = row.extends.as_deref()?;
    let of_row = found.iter().filter(|((name, _), _)| *name == row.name);
    let losses = of_row.filter_map(|((_, scene), psnr)| {
        let loss = found.get(&(other, *scene))? - psnr;
        (loss > 0.005).then(|| format!("{scene} {loss:.2}"))
    });
    let losses = losses.collect::<Vec<_>>().join(", ");
    let why = row.why.as_deref().unwrap_or("not explained yet");
    (!losses.is_empty()).then(|| format!("{} is worse than {other} (dB: {losses}): {why}.", row.name))
}

/// One cell, or what it lacks.
fn cell(sci: &Sci, shared: &Path, row: &Row, scene: &Scene) -> anyhow::Result<Result<Ours, String>> {
    let needed =
        [format!("data/{}", scene.file)].into_iter().chain(row.weights.values().map(|w| format!("weights/{w}")));
    let missing: Vec<String> = needed.filter(|file| !shared.join(file).is_file()).collect();
    if !missing.is_empty() {
        return Ok(Err(format!("no data: put {} in the shared folder", missing.join(", "))));
    }
    let config = root().join("configs").join(&row.config);
    if !config.is_file() {
        return Ok(Err(format!("no configs/{} yet", row.config)));
    }
    let mut sets = vec![format!("data.path={}", shared.join("data").join(&scene.file).display())];
    sets.extend(scene.measurements.iter().map(|m| format!("data.measurements={m:?}")));
    sets.extend(row.weights.iter().map(|(key, file)| format!("{key}={}", shared.join("weights").join(file).display())));
    let record = match sci.run(&config, &sets)?.success() {
        Ok(record) => record,
        Err(e) => return Ok(Err(e.to_string().lines().last().unwrap_or("failed").to_owned())),
    };
    Ok(ours(&record).ok_or_else(|| "the file holds no truth".into()))
}

/// The means of a record, if there was a truth to compare with.
fn ours(record: &Value) -> Option<Ours> {
    let mean = |key: &str| record["mean"][key].as_f64();
    Some(Ours { psnr_db: mean("psnr_db")?, ssim: mean("ssim")?, seconds: mean("seconds")? })
}
