//! `cargo xtask bench large`: memory, and seconds for a megapixel of a frame, of color scenes of growing size in bounded memory.

use std::fs::{self, File};
use std::io::{BufWriter, Write};
use std::path::Path;

use anyhow::Context;

use crate::workspace::{Sci, Told, root};

#[derive(clap::Args)]
pub(crate) struct Options {
    /// Experiments under configs/large/
    #[arg(long, value_name = "NAME", value_delimiter = ',', default_value = "gap-tv,fast")]
    config: Vec<String>,
    /// Heights of the frames; widths are 16/9 of them
    #[arg(long, value_name = "ROWS", value_delimiter = ',', default_value = "1080,2160")]
    rows: Vec<usize>,
    /// Frames of a measurement
    #[arg(long, default_value_t = 24, value_parser = clap::value_parser!(u16).range(2..=64))]
    frames: u16,
    /// Further settings of all runs
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Keep the table in xtask/results/CPU/large.md
    #[arg(long)]
    save: bool,
}

/// Prints the table, a row as soon as it is there; with `--save` keeps it.
pub(crate) fn run(options: &Options) -> anyhow::Result<()> {
    let sci = Sci::build(None)?;
    let folder = tempfile::tempdir().context("no temporary folder")?;
    let mut told = Told::default();
    told.line("| experiment | scene | bands | memory, MB | s of solving | s in all | s a megapixel and frame |");
    told.line("|---|---|---|---|---|---|---|");
    for &rows in &options.rows {
        let columns = (rows * 16 / 9).next_multiple_of(2);
        let scene = folder.path().join("scene");
        make_scene(&scene, (usize::from(options.frames), rows, columns)).context("the scene")?;
        for name in &options.config {
            let config = root().join(format!("configs/large/{name}.toml"));
            let mut sets = vec![format!("data.path={}", scene.display())];
            sets.extend(options.set.iter().cloned());
            let record = sci.run(&config, &sets)?.success()?;
            let number = |value: &serde_json::Value| value.as_f64().context("the record lacks a number");
            let seconds = number(&record["measurements"][0]["seconds"])?;
            let megapixels = f64::from(options.frames) * (rows * columns) as f64 / 1e6;
            told.line(&format!(
                "| {name} | {columns}×{rows}×{} | {} | {:.0} | {seconds:.1} | {:.1} | {:.3} |",
                options.frames,
                record["measurements"][0]["bands"].as_u64().unwrap_or(1),
                number(&record["peak_rss_bytes"])? / 1e6,
                number(&record["wall_seconds"])?,
                seconds / megapixels
            ));
        }
    }
    if options.save {
        told.save("large.md")?;
    }
    Ok(())
}

/// A color scene of moving waves and random masks as `.npy` files of bytes, written a frame at a time.
fn make_scene(folder: &Path, (frames, rows, columns): (usize, usize, usize)) -> anyhow::Result<()> {
    fs::create_dir_all(folder)?;
    let begin = |name: &str, shape: &str| -> anyhow::Result<BufWriter<File>> {
        let mut file = BufWriter::new(File::create(folder.join(name))?);
        let text = format!("{{'descr': '|u1', 'fortran_order': False, 'shape': ({shape}), }}");
        let length = (10 + text.len() + 1).next_multiple_of(64) - 10;
        file.write_all(b"\x93NUMPY\x01\x00")?;
        file.write_all(&u16::try_from(length)?.to_le_bytes())?;
        writeln!(file, "{text:width$}", width = length - 1)?;
        Ok(file)
    };
    let mut mask = begin("mask.npy", &format!("{frames}, {rows}, {columns}"))?;
    let mut rgb = begin("rgb.npy", &format!("{frames}, {rows}, {columns}, 3"))?;
    let mut state = 1u32;
    for t in 0..frames {
        for y in 0..rows {
            let mut bits = Vec::with_capacity(columns);
            let mut pixels = Vec::with_capacity(3 * columns);
            for x in 0..columns {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                bits.push((state >> 31) as u8);
                let (t, y, x) = (t as f32, y as f32, x as f32);
                let wave = ((x + 3.0 * t) * 0.11).sin() * ((y - 2.0 * t) * 0.07).cos();
                pixels.extend([0.0, 1.0, 2.0].map(|c: f32| (128.0 + (90.0 - 20.0 * c) * wave) as u8));
            }
            mask.write_all(&bits)?;
            rgb.write_all(&pixels)?;
        }
    }
    mask.flush()?;
    Ok(rgb.flush()?)
}
