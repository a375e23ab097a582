//! `sci report`: finished runs side by side, as a table and as a page; the page of one run anew from its folder.

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Context;
use ndarray::{Array4, ArrayView4, Axis};
use serde::Deserialize;

use super::{Done, UsageError};
use crate::config::{Written, load_written};
use crate::io::output::write_atomically;
use crate::io::scene::{self, Keys, Reading, Scene};
use crate::record::Record;
use crate::report;
use crate::report::pictures::{MeasurementImages, Pictures};
use crate::run_folder::{RECORD, REPORT};

/// Arguments of `sci report`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// Folders that `sci run` wrote; of a single one the page is made anew
    #[arg(required = true, value_name = "DIR")]
    runs: Vec<PathBuf>,
    /// Where to write the page: of one run its frames, of several the table and the convergence curves [default: of one run the
    /// report.html in its folder, if it has one]
    #[arg(long, value_name = "FILE.html")]
    out: Option<PathBuf>,
    /// What the pictures of a single run may take [default: as its experiment says]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=400))]
    megabytes: Option<u32>,
}

impl Args {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        let records = self.runs.iter().map(|dir| Record::read(&dir.join(RECORD))).collect::<Result<Vec<_>, _>>()?;
        print_table(&records);
        match (self.runs.as_slice(), records.as_slice()) {
            ([dir], [record]) => self.page_of_one(dir, record)?,
            _ if self.megabytes.is_some() => {
                return Err(UsageError("--megabytes has no effect: a comparison has no pictures".into()).into());
            }
            _ => {
                if let Some(page) = &self.out {
                    report::write_comparison(page, &records)?;
                    outln!("wrote {}", page.display());
                }
            }
        }
        Ok(Done::Complete)
    }

    fn page_of_one(&self, dir: &Path, record: &Record) -> anyhow::Result<()> {
        let listed = record.files.iter().any(|name| name == REPORT);
        let page = match &self.out {
            Some(page) => page.clone(),
            None if listed => dir.join(REPORT),
            // A file that the record does not list would be in the way of the next run.
            None => {
                outln!("the run has no page; to make one, name it with --out FILE.html");
                return Ok(());
            }
        };
        let megabytes = self.megabytes.map_or_else(|| limit_of(record), u64::from);
        let limit = megabytes as usize * 1_000_000 / record.measurements.len().max(1);
        let pieces = tempfile::tempdir().context("cannot make a temporary folder")?;
        let paths = make_pieces(dir, record, limit, pieces.path())?;
        report::write(&page, record, &paths)?;
        outln!("wrote {}", page.display());
        Ok(())
    }
}

fn print_table(records: &[Record]) {
    let number = |x: Option<f64>, digits: usize| x.map_or_else(|| "–".to_owned(), |x| format!("{x:.digits$}"));
    let width = records.iter().map(|r| r.experiment.chars().count()).max().unwrap_or(0).max(10);
    let scene = records.iter().map(|r| r.scene.chars().count()).max().unwrap_or(0).max(5);
    outln!("{:width$}  {:scene$}   PSNR dB     SSIM  seconds  iterations", "experiment", "scene");
    for r in records {
        outln!(
            "{:width$}  {:scene$}  {:>8}  {:>7}  {:>7.2}  {:>10.1}",
            r.experiment,
            r.scene,
            number(r.mean.psnr_db, 2),
            number(r.mean.ssim, 4),
            r.mean.seconds,
            r.mean.iterations
        );
        if r.unsolved > 0 {
            outln!("{:width$}  stopped: {} more measurements were to be solved", "", r.unsolved);
        }
    }
}

/// What the experiment allows the pictures, in millions of bytes.
fn limit_of(record: &Record) -> u64 {
    record.config["output"]["report_megabytes"].as_u64().unwrap_or(30)
}

/// The pictures of each measurement, from the result in the folder, and from the scene if it can still be read.
fn make_pieces(dir: &Path, record: &Record, limit: usize, to: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let scene = scene_of(record)
        .inspect_err(|e| {
            eprintln!("warning: the scene cannot be read again, so the page shows the results alone: {e:#}")
        })
        .ok();
    let unit = scene.as_ref().map_or(1.0, |scene| scene.unit);
    let video = result(dir, record, unit)?;
    let count = record.measurements.len();
    let frames = video.len_of(Axis(0)) / count.max(1);
    anyhow::ensure!(
        frames > 0 && frames * count == video.len_of(Axis(0)),
        "{}: {} frames are not those of {count} measurements",
        dir.display(),
        video.len_of(Axis(0))
    );
    let chunks = video.axis_chunks_iter(Axis(0), frames).zip(&record.measurements).enumerate();
    let piece = |(i, (result, measurement)): (usize, (ArrayView4<'_, f32>, &crate::record::MeasurementRecord))| {
        let path = to.join(format!("{i}.json"));
        let images = images(scene.as_ref(), measurement.index, result);
        let json = serde_json::to_vec(&Pictures::of(&images, None, limit)?)?;
        write_atomically(&path, |w| w.write_all(&json))?;
        Ok(path)
    };
    chunks.map(piece).collect()
}

fn images<'a>(scene: Option<&'a Scene>, index: usize, recon: ArrayView4<'a, f32>) -> MeasurementImages<'a> {
    let fits =
        |scene: &&Scene| index < scene.len() && scene.operator.shape().image_dim() == (recon.dim().2, recon.dim().3);
    let scene = scene.filter(fits);
    let truth = scene.and_then(|scene| match recon.len_of(Axis(1)) {
        3 => scene.rgb_of(index),
        _ => scene.truth_of(index).map(|t| t.insert_axis(Axis(1))),
    });
    MeasurementImages {
        measurement: scene.map(|scene| scene.y(index)),
        recon,
        cfa: scene.and_then(|scene| scene.cfa),
        truth: truth.filter(|truth| truth.dim() == recon.dim()),
    }
}

/// The scene of a run, read again as its experiment says.
fn scene_of(record: &Record) -> anyhow::Result<Scene> {
    let written = &record.config["written"];
    let mut written = Written::deserialize(written).context("the record does not hold the experiment's text")?;
    // Where it was found then; the current folder may be another one now.
    let data = &record.config["data"];
    data["path"].as_str().context("the record names no data")?;
    let files = [
        ("data.path", &data["path"]),
        ("data.mask", &data["mask"]),
        ("data.mask.path", &data["mask"]["path"]),
        ("data.calibration", &data["calibration"]),
        ("data.sensor.dark", &data["sensor"]["dark"]),
        ("data.sensor.white", &data["sensor"]["white"]),
    ];
    let found =
        files.into_iter().filter_map(|(key, path)| Some((key, path.as_str().filter(|p| Path::new(p).is_absolute())?)));
    written.set.extend(found.map(|(key, path)| format!("{key}={}", toml::Value::from(path))));
    let experiment = load_written(&written)?;
    super::run::read_scene(&experiment)
}

/// The result `[T, C, H, W]` with white at 1.
fn result(dir: &Path, record: &Record, unit: f32) -> anyhow::Result<Array4<f32>> {
    let listed = |name: &str| record.files.iter().any(|file| file == name);
    let arrays = ["recon.npy", "recon.npz", "recon.mat"].into_iter().find(|name| listed(name));
    let keys = Keys { orig: "recon".into(), rgb: "recon".into(), ..Default::default() };
    if let Some(name) = arrays {
        // The program's own habits, whatever the numbers look like.
        let scale = Some(if name.ends_with(".mat") { 255.0 } else { 1.0 });
        let video = scene::read_video(&dir.join(name), &Reading { keys, scale, ..Default::default() })?.frames;
        return Ok(if unit == 1.0 { video } else { video / unit });
    }
    let frames = dir.join("frames");
    anyhow::ensure!(
        frames.is_dir(),
        "{}: neither recon.npy, recon.npz, recon.mat nor frames to make a page of",
        dir.display()
    );
    Ok(scene::read_video(&frames, &Reading::default())?.frames)
}
