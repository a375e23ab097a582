//! Solves the measurements of a run one by one, and puts each on disk as soon as it is solved.

use anyhow::Context;
use ndarray::Array3;

use super::super::interrupted;
use crate::config::Experiment;
use crate::factory::Factory;
use crate::io::scene::Scene;
use crate::pictures::Job;
use crate::progress::Progress;
use crate::record::{MeasurementRecord, Stop};
use crate::run_folder::RunFolder;
use crate::solve::{self, Show};

/// Solves what is left of the measurements `own`, until Ctrl-C. Every solved measurement is in the folder before it is handed to `show`, which
/// says whether to go on.
pub(super) fn solve_all(
    experiment: &Experiment,
    scene: &Scene,
    own: &[usize],
    factory: &mut Factory<'_>,
    folder: &mut RunFolder,
    show: &dyn Fn(Job) -> bool,
) -> anyhow::Result<()> {
    let mut previous = pass_solved(scene, factory, folder)?;
    let planned = factory.plan().iterations();
    for (i, &k) in own.iter().enumerate().skip(folder.finished().len()) {
        if interrupted() {
            break;
        }
        let mut bar = Bar(Progress::new(k, planned));
        let start = previous.as_ref().map(|sensor| sensor.view());
        let (record, estimate) = solve::measurement(factory, scene, &own[i..], start, &mut bar)?;
        bar.0.finish();
        outln!("{}", line(&record));
        if record.stop == Stop::Diverged {
            eprintln!("{}", solve::advice(&record, experiment));
        }
        let (whole, saves) = (record.stop != Stop::Observer, factory.needs_weights());
        folder.store(record, &estimate, factory.needs_previous(), whole, |dir| {
            if saves { factory.save_weights(dir) } else { Ok(()) }
        })?;
        previous = factory.needs_previous().then(|| estimate.sensor.clone());
        let finished = folder.finished().last().cloned().context("a measurement was stored")?;
        if !show(Job { finished, estimate, last: i + 1 == own.len() && !folder.is_shard() }) {
            break;
        }
    }
    Ok(())
}

/// Brings the factory to where it was after the measurements that are solved; what the sensor sees of the last.
fn pass_solved(scene: &Scene, factory: &mut Factory<'_>, folder: &RunFolder) -> anyhow::Result<Option<Array3<f32>>> {
    let mut sensor = None;
    for finished in folder.finished() {
        sensor = finished.sensor()?;
        let view = sensor.as_ref().map(|sensor: &Array3<f32>| sensor.view());
        factory.pass(scene, finished.record.index, view, &finished.record)?;
    }
    if let Some(last) = folder.finished().last() {
        factory.load_weights(&last.weights())?;
    }
    Ok(sensor)
}

pub(super) fn line(m: &MeasurementRecord) -> String {
    let quality = match (m.psnr_db, m.ssim) {
        (Some(p), Some(s)) => {
            let rgb = m.psnr_rgb_db.map_or(String::new(), |p| format!("   RGB {p:6.2} dB"));
            format!("PSNR {p:6.2} dB   SSIM {s:.4}{rgb}")
        }
        _ => format!("residual {:.2e}", m.relative_residual.unwrap_or(f64::NAN)),
    };
    let predicted = m.predicted_psnr_db.map_or(String::new(), |p| format!("   predicted {p:.2} dB"));
    let note = match m.stop {
        Stop::ScheduleDone => "",
        Stop::Converged => "   converged",
        Stop::Stalled => "   nothing gained any more",
        Stop::Diverged => "   DIVERGED (last good estimate)",
        Stop::TimeUp => "   time up",
        Stop::Observer => "   stopped",
    };
    let updates = m.online.as_ref().map_or(String::new(), |a| {
        let warm = if a.warm_start { ", from the result before" } else { "" };
        let cut = if a.cut { ", after a cut" } else { "" };
        let took = a.split.as_ref().map_or(String::new(), |split| {
            let alone = if split.ends_early { ", the network after it left out" } else { "" };
            format!(" in {:.1} s{alone}", split.seconds)
        });
        format!("   {} of {} updates kept{took}{warm}{cut}", a.counts.kept, a.counts.fired + a.counts.skipped)
    });
    let backed_off = m
        .backed_off
        .as_ref()
        .map_or(String::new(), |b| format!("   diverged in iteration {}, went on without {}", b.iteration, b.without));
    let (k, iterations, seconds) = (m.index, m.iterations, m.seconds);
    let bands = m.bands.map_or(String::new(), |n| format!(" in {n} bands"));
    format!(
        "measurement {k:>2}   {quality}{predicted}   {iterations} iterations   {seconds:.2} s{bands}{updates}{backed_off}{note}"
    )
}

/// Shows a solve on the terminal, until Ctrl-C.
pub(super) struct Bar(pub(super) Progress);

impl Show for Bar {
    fn begin(&mut self) {
        self.0.start();
    }

    fn update(&mut self, done: usize) {
        self.0.update(done);
    }

    fn step(&mut self, done: usize, psnr_db: Option<f64>) {
        self.0.step(done, psnr_db);
    }

    fn stopped(&self) -> bool {
        interrupted()
    }
}
