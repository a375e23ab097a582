//! `sci calibrate`: how the masks of an experiment's scene really sit, from its measurements alone.

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use ndarray::Axis;
use plotters::prelude::*;

use super::run::{say, scene_and_choice};
use super::{Done, UsageError, catch_interrupts, check_folder, interrupted, shown_on_a_bar};
use crate::calibration::{self, Calibration, Parameter};
use crate::config;
use crate::io::output::{ArrayFormat, Part, write_arrays, write_atomically};
use crate::run_folder::refuse_inputs;

/// Arguments of `sci calibrate`.
///
/// Writes calibration.json (for data.calibration), masks.npy (the masks as they are) and calibration.svg (the error over each
/// parameter).
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// An experiment file, TOML, whose [data] says what is to be calibrated
    config: PathBuf,
    /// Override a key of the file
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Where to write [default: runs/<name>-calibration]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Farthest shift in pixels, 0 to 16
    #[arg(long, value_name = "PIXELS", default_value = "2", value_parser = parse_reach)]
    reach: f64,
    /// Look for a share of the neighbouring frame too (found too large where much moves)
    #[arg(long)]
    clock: bool,
}

fn parse_reach(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|r| (0.0..=16.0).contains(r)).ok_or_else(|| "expected a number from 0 to 16".into())
}

impl Args {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        let mut experiment = config::load(&self.config, &self.set)?;
        experiment.data.reading.masks_off = 1;
        let default = || Path::new("runs").join(format!("{}-calibration", experiment.name));
        let out = self.out.clone().unwrap_or_else(default);
        refuse_inputs(&out, &experiment.inputs())?;
        check_folder(&out)?;
        if let Some(foreign) = FILES.map(|name| out.join(name)).iter().find(|file| file.exists())
            && !out.join(calibration::FILE).exists()
        {
            anyhow::bail!(UsageError(format!(
                "--out: {} is there, but no {} with it: it is not of a calibration and would be replaced; name another folder",
                foreign.display(),
                calibration::FILE
            )));
        }
        catch_interrupts()?;
        let (mut scene, chosen) = scene_and_choice(&experiment)?;
        let Self { reach, clock, .. } = self;
        let settings = admm::Calibration { reach, clock, ..admm::Calibration::default() };
        let found = match shown_on_a_bar(|watch| calibration::find(&scene, &chosen, &settings, watch)) {
            Err(_) if interrupted() => return Ok(Done::Interrupted),
            found => found?,
        };
        std::fs::create_dir_all(&out).with_context(|| format!("cannot make {}", out.display()))?;
        let masks = found.masks(&scene)?;
        let part = Part { name: "mask", data: masks.view().insert_axis(Axis(1)), is_light: false };
        write_arrays(&out.join(FILES[0]), ArrayFormat::Npy, &[part])?;
        let mut svg = String::new();
        draw(&mut svg, &found).map_err(|e| anyhow!("cannot draw the curves: {e}"))?;
        write_atomically(&out.join(FILES[1]), |w| w.write_all(svg.as_bytes()))?;
        // Last: where it is, the others are.
        write_atomically(&out.join(calibration::FILE), |w| w.write_all(found.to_json().as_bytes()))?;
        found.lines().iter().for_each(|line| outln!("{line}"));
        found.apply(&mut scene)?;
        scene.look_for_defects(experiment.data.reading.defects)?.iter().for_each(|note| say(&experiment, note));
        let Calibration { error_before, error_after, solves, .. } = found;
        outln!("held-out error {error_before:.3e} -> {error_after:.3e} after {solves} tries");
        outln!("wrote {0}; use it by --set data.calibration={0}/{1}", out.display(), calibration::FILE);
        Ok(Done::Complete)
    }
}

/// What is written beside [`calibration::FILE`].
const FILES: [&str; 2] = ["masks.npy", "calibration.svg"];

const COLUMNS: usize = 3;
const CELL: (u32, u32) = (320, 240);

type DrawError = DrawingAreaErrorKind<std::io::Error>;

/// The error over each parameter.
fn draw(svg: &mut String, found: &Calibration) -> Result<(), DrawError> {
    let rows = found.parameters.len().div_ceil(COLUMNS).max(1);
    let root = SVGBackend::with_string(svg, (CELL.0 * COLUMNS as u32, CELL.1 * rows as u32)).into_drawing_area();
    root.fill(&WHITE)?;
    for (area, parameter) in root.split_evenly((rows, COLUMNS)).iter().zip(&found.parameters) {
        draw_curve(area, parameter)?;
    }
    root.present()
}

fn draw_curve(
    area: &DrawingArea<SVGBackend<'_>, plotters::coord::Shift>,
    parameter: &Parameter,
) -> Result<(), DrawError> {
    let Parameter { name, value, curve, .. } = parameter;
    let bounds = |values: &mut dyn Iterator<Item = f64>| {
        let (least, most) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
        let margin = (0.05 * (most - least)).max(1e-9);
        if least <= most { least - margin..most + margin } else { 0.0..1.0 }
    };
    let (x, y) = (bounds(&mut curve.iter().map(|p| p.0)), bounds(&mut curve.iter().map(|p| p.1)));
    let mut chart = ChartBuilder::on(area)
        .margin(10)
        .caption(format!("{name} {value:.4}"), ("sans-serif", 15))
        .x_label_area_size(25)
        .y_label_area_size(60)
        .build_cartesian_2d(x, y)?;
    chart.configure_mesh().x_labels(5).y_labels(5).y_label_formatter(&|e| format!("{e:.1e}")).draw()?;
    chart.draw_series(LineSeries::new(curve.iter().copied(), &BLUE))?;
    chart.draw_series(curve.iter().map(|&point| Circle::new(point, 2, BLUE.filled())))?;
    Ok(())
}
