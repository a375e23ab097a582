//! The log of a training run, one JSON object a line, and the plot made from it.

use std::fs::File;
use std::io::{BufWriter, ErrorKind, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use nets::train::{Score, StepReport};
use plotters::coord::ranged1d::{AsRangedCoord, ValueFormatter};
use plotters::prelude::*;
use serde::{Deserialize, Serialize};

use crate::io::output::write_atomically;

/// Steps that one line sums up.
const STEPS_PER_LINE: u64 = 10;

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(untagged)]
enum Line {
    Validation {
        step: u64,
        validation: Vec<Psnr>,
    },
    /// A divergence after which the run went on from `step`.
    BackedOff {
        step: u64,
        diverged: String,
        /// The share of the learning rate that is left.
        rate: f64,
    },
    /// Means over [`STEPS_PER_LINE`] steps, the last of which is `step`.
    Steps {
        step: u64,
        loss: f64,
        gradient_norm: f64,
        learning_rate: f64,
        /// Channels that began anew, in all of them.
        #[serde(default)]
        revived: usize,
    },
}

#[derive(Debug, Clone, Serialize, Deserialize)]
struct Psnr {
    /// Nothing for clips that were reconstructed from a measurement.
    sigma: Option<f32>,
    /// Nothing if it is not finite, as JSON has no such number.
    psnr_db: Option<f64>,
}

fn legend(sigma: Option<f32>) -> String {
    sigma.map_or_else(|| "reconstruction".into(), |sigma| format!("σ {sigma}"))
}

impl Line {
    fn at(&self) -> u64 {
        match self {
            Self::Steps { step, .. } | Self::Validation { step, .. } | Self::BackedOff { step, .. } => *step,
        }
    }
}

/// The open log.
#[derive(Debug)]
pub(super) struct Log {
    path: PathBuf,
    file: BufWriter<File>,
    lines: Vec<Line>,
    open: Vec<StepReport>,
}

impl Log {
    /// Opens the log of a run that has come to `step`; lines of later steps, which it does again, are dropped, and one that was cut short.
    pub(super) fn open(path: &Path, step: u64) -> anyhow::Result<Self> {
        let before = match std::fs::read_to_string(path) {
            Err(error) if error.kind() == ErrorKind::NotFound => String::new(),
            read => read.with_context(|| format!("cannot read {}", path.display()))?,
        };
        let kept = before.lines().filter_map(|text| Some((text, serde_json::from_str::<Line>(text).ok()?)));
        let (texts, lines): (Vec<&str>, Vec<Line>) = kept.filter(|(_, line)| line.at() <= step).unzip();
        // In one step, so that nothing is lost if the program ends here.
        write_atomically(path, |file| texts.iter().try_for_each(|text| writeln!(file, "{text}")))?;
        let file = File::options().append(true).open(path);
        let file = BufWriter::new(file.with_context(|| format!("cannot write {}", path.display()))?);
        Ok(Self { path: path.to_owned(), file, lines, open: Vec::new() })
    }

    fn write(&mut self, line: Line) -> anyhow::Result<()> {
        let failed = || format!("cannot write {}", self.path.display());
        serde_json::to_writer(&mut self.file, &line).with_context(failed)?;
        self.file.write_all(b"\n").with_context(failed)?;
        self.lines.push(line);
        Ok(())
    }

    pub(super) fn step(&mut self, report: &StepReport) -> anyhow::Result<()> {
        self.open.push(*report);
        if !report.step.is_multiple_of(STEPS_PER_LINE) {
            return Ok(());
        }
        let steps = std::mem::take(&mut self.open);
        let mean = |value: fn(&StepReport) -> f64| steps.iter().map(value).sum::<f64>() / steps.len() as f64;
        self.write(Line::Steps {
            step: report.step,
            loss: mean(|r| f64::from(r.loss)),
            gradient_norm: mean(|r| r.gradient_norm),
            learning_rate: report.learning_rate,
            revived: steps.iter().map(|r| r.revived).sum(),
        })
    }

    /// Logs a validation and puts it into words.
    pub(super) fn validation(&mut self, step: u64, scores: &[Score]) -> anyhow::Result<String> {
        let validation = scores
            .iter()
            .map(|s| Psnr { sigma: s.sigma, psnr_db: Some(s.psnr_db).filter(|db| db.is_finite()) })
            .collect();
        self.write(Line::Validation { step, validation })?;
        let scores: Vec<String> = scores.iter().map(|s| format!("{}: {:.2} dB", legend(s.sigma), s.psnr_db)).collect();
        Ok(format!("step {step}   {}", scores.join("   ")))
    }

    /// Logs that the run went back to a step.
    pub(super) fn backed_off(&mut self, step: u64, diverged: &str, rate: f64) -> anyhow::Result<()> {
        self.write(Line::BackedOff { step, diverged: diverged.to_owned(), rate })
    }

    /// The latest loss, and how many channels have begun anew.
    pub(super) fn message(&self) -> String {
        let steps = self.lines.iter().filter_map(|line| match line {
            Line::Steps { loss, revived, .. } => Some((*loss, *revived)),
            Line::Validation { .. } | Line::BackedOff { .. } => None,
        });
        let Some((loss, revived)) = steps.reduce(|(_, before), (loss, revived)| (loss, before + revived)) else {
            return String::new();
        };
        if revived == 0 { format!("loss {loss:.5}") } else { format!("loss {loss:.5}   {revived} channels revived") }
    }

    pub(super) fn flush(&mut self) -> anyhow::Result<()> {
        self.file.flush().with_context(|| format!("cannot write {}", self.path.display()))
    }

    /// Draws loss and validation PSNR over the steps.
    pub(super) fn plot(&self, path: &Path) -> anyhow::Result<()> {
        let losses: Vec<(f64, f64)> = self
            .lines
            .iter()
            .filter_map(|line| match line {
                Line::Steps { step, loss, .. } if loss.is_finite() => Some((*step as f64, *loss)),
                _ => None,
            })
            .collect();
        let mut curves: Vec<Curve> = Vec::new();
        for line in &self.lines {
            let Line::Validation { step, validation } = line else { continue };
            for score in validation {
                let Some(psnr_db) = score.psnr_db else { continue };
                let point = (*step as f64, psnr_db);
                match curves.iter_mut().find(|(sigma, _)| *sigma == score.sigma) {
                    Some((_, points)) => points.push(point),
                    None => curves.push((score.sigma, vec![point])),
                }
            }
        }
        let mut svg = String::new();
        draw(&mut svg, &losses, &curves).map_err(|e| anyhow!("cannot draw the plot: {e}"))?;
        std::fs::write(path, svg).with_context(|| format!("cannot write {}", path.display()))
    }
}

/// σ, and PSNR over the steps.
type Curve = (Option<f32>, Vec<(f64, f64)>);

type DrawError = Box<dyn std::error::Error + Send + Sync>;

fn draw(svg: &mut String, losses: &[(f64, f64)], curves: &[Curve]) -> Result<(), DrawError> {
    let root = SVGBackend::with_string(svg, (900, 700)).into_drawing_area();
    root.fill(&WHITE)?;
    let (upper, lower) = root.split_vertically(350);
    let steps = losses.iter().chain(curves.iter().flat_map(|(_, c)| c)).map(|p| p.0).fold(1.0, f64::max);
    if let Some((low, high)) = extent(losses.iter().map(|p| p.1)) {
        // A logarithm, as PSNR is, may be of either sign.
        if low > 0.0 {
            draw_losses(&upper, losses, 0.0..steps, (0.9 * low..1.1 * high).log_scale())?;
        } else {
            let margin = (0.05 * (high - low)).max(1e-6);
            draw_losses(&upper, losses, 0.0..steps, low - margin..high + margin)?;
        }
    }
    if let Some((low, high)) = extent(curves.iter().flat_map(|(_, c)| c).map(|p| p.1)) {
        let mut chart = ChartBuilder::on(&lower)
            .caption("validation PSNR (dB)", ("sans-serif", 18))
            .margin(12)
            .x_label_area_size(30)
            .y_label_area_size(70)
            .build_cartesian_2d(0.0..steps, low - 0.5..high + 0.5)?;
        chart.configure_mesh().x_desc("step").light_line_style(TRANSPARENT).draw()?;
        for (i, (sigma, points)) in curves.iter().enumerate() {
            let color = Palette99::pick(i).to_rgba();
            chart
                .draw_series(LineSeries::new(points.iter().copied(), color.stroke_width(2)))?
                .label(legend(*sigma))
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 20, y)], color));
        }
        chart.configure_series_labels().background_style(WHITE.mix(0.8)).border_style(BLACK).draw()?;
    }
    root.present()?;
    Ok(())
}

fn draw_losses<Y>(
    area: &DrawingArea<SVGBackend<'_>, plotters::coord::Shift>,
    losses: &[(f64, f64)],
    x: Range<f64>,
    y: Y,
) -> Result<(), DrawError>
where
    Y: AsRangedCoord<Value = f64>,
    Y::CoordDescType: ValueFormatter<f64>,
{
    let mut chart = ChartBuilder::on(area)
        .caption("training loss", ("sans-serif", 18))
        .margin(12)
        .x_label_area_size(30)
        .y_label_area_size(70)
        .build_cartesian_2d(x, y)?;
    chart.configure_mesh().x_desc("step").light_line_style(TRANSPARENT).draw()?;
    chart.draw_series(LineSeries::new(losses.iter().copied(), &BLUE))?;
    Ok(())
}

fn extent(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    values.fold(None, |range, v| match range {
        None => Some((v, v)),
        Some((low, high)) => Some((f64::min(low, v), f64::max(high, v))),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(step: u64) -> StepReport {
        StepReport { step, loss: 1.0 / step as f32, learning_rate: 1e-3, gradient_norm: 1.0, revived: 0 }
    }

    #[test]
    fn a_resumed_log_has_every_step_once() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.jsonl");
        let mut log = Log::open(&path, 0).unwrap();
        (1..=40).for_each(|s| log.step(&report(s)).unwrap());
        log.validation(40, &[Score { sigma: Some(25.0), psnr_db: 30.0 }]).unwrap();
        log.flush().unwrap();
        let mut log = Log::open(&path, 20).unwrap();
        (21..=30).for_each(|s| log.step(&report(s)).unwrap());
        log.flush().unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        let steps: Vec<u64> = text.lines().map(|l| serde_json::from_str::<Line>(l).unwrap().at()).collect();
        assert_eq!(steps, [10, 20, 30]);
    }

    #[test]
    fn the_plot_shows_both_curves_and_an_empty_log_gives_an_empty_plot() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("loss.svg");
        let mut log = Log::open(&folder.path().join("log.jsonl"), 0).unwrap();
        log.plot(&path).unwrap();
        (1..=20).for_each(|s| log.step(&report(s)).unwrap());
        log.validation(20, &[Score { sigma: Some(25.0), psnr_db: 30.0 }]).unwrap();
        log.plot(&path).unwrap();
        let svg = std::fs::read_to_string(&path).unwrap();
        assert!(svg.contains("training loss") && svg.contains("validation PSNR") && svg.contains("σ 25"));
    }
}
