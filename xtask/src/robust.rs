//! `cargo xtask bench robust`: what the faults of a real camera cost, one at a time and together, and what calibration wins back.

use std::path::{Path, PathBuf};

use anyhow::Context;

use crate::workspace::{Sci, Told, root, shared};

#[derive(clap::Args)]
pub(crate) struct Options {
    /// Only conditions whose names hold this
    #[arg(long, value_name = "TEXT", default_value = "")]
    only: String,
    /// Only scenes whose names hold this
    #[arg(long, value_name = "TEXT", default_value = "")]
    scene: String,
    /// Only experiments whose names hold this; part of the table's name
    #[arg(long, value_name = "TEXT", default_value = "")]
    config: String,
    /// Keep the table in xtask/results/CPU/
    #[arg(long)]
    save: bool,
    /// Folder with data/ [default: $SCI_DATA, else ../shared beside the repository]
    #[arg(long, value_name = "DIR")]
    shared: Option<PathBuf>,
}

/// A scene, and the level below which nine tenths of its first measurement lie.
const SCENES: [(&str, f64); 2] = [("traffic48", 3.21), ("runner40", 1.93)];
/// Experiments under configs/, and whether they calibrate by themselves.
const CONFIGS: [(&str, bool); 4] =
    [("gray/gap-tv", false), ("gray/default", false), ("gray/fast", false), ("real/gray", true)];

/// A fault: its name, its settings (`FULL` stands for the level of the scene), and whether there is anything to calibrate.
type Condition = (&'static str, &'static [&'static str], bool);

const CONDITIONS: [Condition; 10] = [
    ("none", &[], true),
    ("noise, σ = 25 of 255", &["data.noise.sigma=25"], false),
    ("noise, 100 photons", &["data.noise.photons=100"], false),
    ("a tenth of the pixels clipped", &["data.camera.full=FULL"], false),
    ("one pixel in 500 dead, one hot", &["data.camera.dead=0.002", "data.camera.hot=0.002"], false),
    ("black level, 3 % of full well", &["data.camera.black=0.24"], true),
    ("masks moved .3 down, .5 right", &["data.camera.shift=[0.3,0.5]"], true),
    ("masks blurred, σ = .5", &["data.camera.blur=0.5"], true),
    ("light that flickers by 5 %", &["data.camera.flicker=0.05"], true),
    (
        "moved, turned, clock, contrast, gain, black, noise",
        &[
            "data.camera.shift=[0.3,0.5]",
            "data.camera.rotation=0.1",
            "data.camera.clock=0.05",
            "data.camera.contrast=0.95",
            "data.camera.gain=1.02",
            "data.camera.black=0.016",
            "data.noise.sigma=1",
        ],
        true,
    ),
];

/// Prints the table, a row as soon as it is there; with `--save` keeps it.
pub(crate) fn run(options: &Options) -> anyhow::Result<()> {
    let shared = shared(options.shared.as_deref())?;
    let sci = Sci::build(Some(&shared))?;
    let columns: Vec<Column> = columns().into_iter().filter(|column| column.head.contains(&options.config)).collect();
    let mut told = Told::default();
    let scenes: Vec<_> = SCENES.iter().filter(|(scene, _)| scene.contains(&options.scene)).collect();
    let heads: Vec<String> = scenes
        .iter()
        .flat_map(|(scene, _)| columns.iter().map(move |column| format!("{scene}, {}", column.head)))
        .collect();
    told.line(&format!("| PSNR in dB, first measurement | {} |", heads.join(" | ")));
    told.line(&format!("|---{}|", "|---".repeat(heads.len())));
    for (name, sets, calibrates) in CONDITIONS.iter().filter(|(name, ..)| name.contains(&options.only)) {
        let mut cells = Vec::new();
        for (scene, column) in scenes.iter().flat_map(|scene| columns.iter().map(move |column| (scene, column))) {
            cells.push(match column.calibrated && !calibrates {
                true => "–".to_owned(),
                false => format!("{:.2}", psnr(&sci, &shared, column, scene, sets).with_context(|| *name)?),
            });
        }
        told.line(&format!("| {name} | {} |", cells.join(" | ")));
    }
    if options.save {
        let of = [&options.config, &options.scene].into_iter().filter(|part| !part.is_empty());
        let name = of.fold("robust".to_owned(), |name, part| format!("{name}-{}", part.replace('/', "-")));
        told.save(&(name + ".md"))?;
    }
    Ok(())
}

/// An experiment, calibrated or not.
struct Column {
    config: PathBuf,
    head: String,
    calibrated: bool,
}

fn columns() -> Vec<Column> {
    let of = |&(name, by_itself): &(&str, bool)| {
        let config = root().join(format!("configs/{name}.toml"));
        let plain = Column { config: config.clone(), head: name.to_owned(), calibrated: false };
        let calibrated = Column { config, head: format!("{name} calibrated"), calibrated: true };
        if by_itself { vec![plain] } else { vec![plain, calibrated] }
    };
    CONFIGS.iter().flat_map(of).collect()
}

/// PSNR of the first measurement of a scene, seen by a camera with these settings.
fn psnr(sci: &Sci, shared: &Path, column: &Column, (scene, full): &(&str, f64), sets: &[&str]) -> anyhow::Result<f64> {
    let file = shared.join(format!("data/{scene}.mat"));
    let mut all = vec![
        "data.kind=simulate".into(),
        format!("data.path={}", file.display()),
        format!("data.mask={{kind=\"file\", path={:?}}}", file.display().to_string()),
        "data.measurements=[0]".into(),
    ];
    all.extend(sets.iter().map(|set| set.replace("FULL", &full.to_string())));
    if column.calibrated {
        all.push("data.calibration=auto".into());
    }
    let record = sci.run(&column.config, &all)?.success()?;
    record["mean"]["psnr_db"].as_f64().context("the record has no PSNR")
}
