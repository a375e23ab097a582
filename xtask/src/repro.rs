//! `cargo xtask repro`: the paper's tables, cell by cell, beside what this program gives.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use serde::Deserialize;

use crate::workspace::{Sci, results_dir, root, shared};

#[derive(clap::Args)]
pub(crate) struct Options {
    /// Which of the paper's tables
    #[arg(value_enum)]
    table: Which,
    /// Fail if a cell with an expected value is off it by more than configs/expected.toml tolerates
    #[arg(long)]
    check: bool,
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

/// An algorithm; lists are in the order of the scenes.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Row {
    name: String,
    config: String,
    /// Weight files by the key that names them.
    #[serde(default)]
    weights: std::collections::BTreeMap<String, String>,
    published: Vec<f64>,
    #[serde(default)]
    published_ssim: Vec<f64>,
    /// PSNR and SSIM that this program gave, by the scene's name.
    #[serde(default)]
    expected: std::collections::BTreeMap<String, [f64; 2]>,
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
    let table = if options.table == Which::TableGray { &expected.gray } else { &expected.color };
    let shared = shared(options.shared.as_deref())?;
    let sci = Sci::build(Some(&shared))?;
    let mut off = Vec::new();
    let mut kept = String::new();
    // Rows take minutes: each is printed when it is there.
    let mut tell = |line: String| {
        println!("{line}");
        kept += &(line + "\n");
    };
    tell("| algorithm | scene | published | ours | difference | SSIM, published | seconds a measurement |".into());
    tell("|---|---|---|---|---|---|---|".into());
    for row in &table.row {
        for (i, scene) in table.scenes.iter().enumerate() {
            let published =
                row.published.get(i).with_context(|| format!("{}: published has no entry {i}", row.name))?;
            let ssim = row.published_ssim.get(i).map_or("–".to_owned(), |s| format!("{s:.3}"));
            let named = format!("| {} | {} | {published:.2}", row.name, scene.name);
            match cell(&sci, &shared, row, scene)? {
                Err(lacking) => tell(format!("{named} | {lacking} | – | – ({ssim}) | – |")),
                Ok(Ours { psnr_db, ssim: own, seconds }) => {
                    let off_by = psnr_db - published;
                    tell(format!("{named} | {psnr_db:.2} | {off_by:+.2} | {own:.3} ({ssim}) | {seconds:.2} |"));
                    let tolerance = &expected.tolerance;
                    let Some([psnr, ssim]) = row.expected.get(&scene.name) else { continue };
                    if (psnr_db - psnr).abs() > tolerance.psnr_db || (own - ssim).abs() > tolerance.ssim {
                        off.push(format!(
                            "{} on {}: {psnr_db:.3} dB, {own:.4}; expected {psnr} dB ± {}, {ssim} ± {}",
                            row.name, scene.name, tolerance.psnr_db, tolerance.ssim
                        ));
                    }
                }
            }
        }
    }
    if options.save {
        let name = if options.table == Which::TableGray { "repro-gray.md" } else { "repro-color.md" };
        fs::write(results_dir()?.join(name), kept)?;
    }
    off.iter().for_each(|o| eprintln!("off: {o}"));
    ensure!(!options.check || off.is_empty(), "{} cells are off", off.len());
    Ok(())
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
    let mean = |key: &str| record["mean"][key].as_f64();
    Ok(match (mean("psnr_db"), mean("ssim"), mean("seconds")) {
        (Some(psnr_db), Some(ssim), Some(seconds)) => Ok(Ours { psnr_db, ssim, seconds }),
        _ => Err("the file holds no truth".into()),
    })
}
