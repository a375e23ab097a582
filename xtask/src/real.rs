//! `cargo xtask real`: the paper's sections of captured data, on the captures that are at hand and on simulated cameras of its sizes.

use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use serde_json::Value;

use crate::workspace::{Sci, Told, root, shared};

#[derive(clap::Args)]
pub(crate) struct Options {
    /// Only scenes whose names hold this
    #[arg(long, value_name = "TEXT", default_value = "")]
    scene: String,
    /// Only experiments whose names hold one of these
    #[arg(long, value_name = "TEXT", value_delimiter = ',')]
    config: Vec<String>,
    /// Where the pictures and their page are written
    #[arg(long, value_name = "DIR", default_value = "runs/real")]
    out: PathBuf,
    /// Keep the table in xtask/results/CPU/real.md
    #[arg(long)]
    save: bool,
    /// Folder with data/ [default: $SCI_DATA, else ../shared beside the repository]
    #[arg(long, value_name = "DIR")]
    shared: Option<PathBuf>,
}

/// A capture, or a video that a camera is simulated for.
struct Scene {
    name: &'static str,
    file: &'static str,
    color: bool,
    /// Further settings.
    sets: &'static [&'static str],
}

const SCENES: [Scene; 4] = [
    Scene { name: "hand, captured, 256²×14", file: "real/hand-4.mat", color: false, sets: &[] },
    Scene { name: "chopper wheel, captured, 256²×14", file: "real/chopper-wheel-4.mat", color: false, sets: &[] },
    Scene {
        name: "calendar, simulated, gray, 512²×10",
        file: "calendar.npz",
        color: false,
        sets: &["data.mask={kind=\"shifting\",frames=10}", "data.camera.full=4.5"],
    },
    // The clip has sixteen frames of the paper's 22.
    Scene {
        name: "calendar, simulated, color, 512²×16",
        file: "calendar.npz",
        color: true,
        sets: &["data.mask={kind=\"shifting\",frames=16}", "data.camera.full=5", "data.cfa=rggb"],
    },
];

/// What all simulated cameras do: read noise, a sensor of eight bits that clips the brightest.
const CAMERA: [&str; 3] = ["data.kind=simulate", "data.noise.sigma=2", "data.camera.bits=8"];

/// Experiments under configs/, and their settings.
const GRAY: [(&str, &[&str]); 8] = [
    ("gray/gap-tv", &[]),
    ("gray/gap-wavelet", &[]),
    ("gray/desci-fast", &[]),
    ("gray/gap-ffdnet-fast", &["denoiser.weights=bundled:ffdnet_gray"]),
    ("gray/fast", &[]),
    ("gray/default", &[]),
    ("gray/adaptive", &[]),
    ("real/gray", &[]),
];
const COLOR: [(&str, &[&str]); 7] = [
    ("color/gap-tv", &[]),
    ("color/gap-wavelet", &[]),
    ("color/two-stage-ffdnet-fast", &["denoiser.weights=bundled:ffdnet_color"]),
    ("color/fast", &[]),
    ("color/default", &[]),
    ("color/adaptive", &[]),
    ("real/color", &[]),
];

/// Prints the table, a row as soon as it is there, and writes the pictures.
pub(crate) fn run(options: &Options) -> anyhow::Result<()> {
    let shared = shared(options.shared.as_deref())?;
    let sci = Sci::build(Some(&shared))?;
    let mut told = Told::default();
    told.line("| scene | experiment | PSNR, dB | predicted PSNR, dB | seconds |");
    told.line("|---|---|---|---|---|");
    let mut page = Page::new(&options.out)?;
    for (i, scene) in SCENES.iter().enumerate().filter(|(_, scene)| scene.name.contains(&options.scene)) {
        page.scene(scene.name);
        for &(config, sets) in if scene.color { &COLOR[..] } else { &GRAY[..] } {
            if !options.config.is_empty() && !options.config.iter().any(|part| config.contains(part)) {
                continue;
            }
            let folder = options.out.join(format!("{i}-{}", config.replace('/', "-")));
            let record = solve(&sci, &shared, scene, config, sets, &folder)
                .with_context(|| format!("{config} on {}", scene.name))?;
            let of = |key: &str| record["measurements"][0][key].as_f64();
            let [psnr, predicted] = ["psnr_db", "predicted_psnr_db"]
                .map(|key| of(key).map_or_else(|| "–".to_owned(), |value| format!("{value:.2}")));
            let seconds = of("seconds").context("the record has no seconds")?;
            told.line(&format!("| {} | {config} | {psnr} | {predicted} | {seconds:.1} |", scene.name));
            let figures = format!("PSNR {psnr} dB, predicted {predicted} dB, {seconds:.1} s");
            page.run(config, &figures, &folder, &record)?;
        }
    }
    println!("wrote {}", page.write()?.display());
    if options.save {
        told.save("real.md")?;
    }
    Ok(())
}

/// The record of the first measurement of a scene, with its frames in `folder`.
fn solve(sci: &Sci, shared: &Path, scene: &Scene, config: &str, sets: &[&str], folder: &Path) -> anyhow::Result<Value> {
    let mut all = vec![
        format!("data.path={}", shared.join("data").join(scene.file).display()),
        "data.measurements=[0]".to_owned(),
        "judge=true".to_owned(),
        "output.report=false".to_owned(),
    ];
    let camera = if scene.sets.is_empty() { &[][..] } else { &CAMERA[..] };
    all.extend(camera.iter().chain(scene.sets).chain(sets).map(|set| (*set).to_owned()));
    sci.run_into(folder, &root().join(format!("configs/{config}.toml")), &all)?.success()
}

/// A page of frames: the first, the middle one and the last of each result.
struct Page {
    folder: PathBuf,
    html: String,
}

impl Page {
    fn new(folder: &Path) -> anyhow::Result<Self> {
        fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
        let style = "body{font:14px sans-serif;background:#111;color:#ddd}img{width:30vw;image-rendering:pixelated}";
        let html =
            format!("<!doctype html><meta charset=\"utf-8\"><title>Captured data</title><style>{style}</style>\n");
        Ok(Self { folder: folder.to_owned(), html })
    }

    fn scene(&mut self, name: &str) {
        _ = writeln!(self.html, "<h2>{name}</h2>");
    }

    fn run(&mut self, config: &str, figures: &str, folder: &Path, record: &Value) -> anyhow::Result<()> {
        _ = writeln!(self.html, "<p>{config}: {figures}</p>");
        let files = record["files"].as_array().context("the record lists no files")?.iter().filter_map(Value::as_str);
        let frames: Vec<&str> = files.filter(|file| file.starts_with("frames/") && file.ends_with(".png")).collect();
        let [Some(first), Some(last)] = [frames.first(), frames.last()] else {
            anyhow::bail!("no frames were written")
        };
        let run = folder.file_name().context("a run has a folder of its own")?.to_string_lossy();
        for frame in [first, frames[frames.len() / 2], last] {
            _ = write!(self.html, "<img src=\"{run}/{frame}\" alt=\"{frame}\">");
        }
        Ok(())
    }

    fn write(self) -> anyhow::Result<PathBuf> {
        let path = self.folder.join("index.html");
        fs::write(&path, self.html).with_context(|| path.display().to_string())?;
        Ok(path)
    }
}
