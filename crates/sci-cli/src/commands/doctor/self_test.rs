//! Small solves whose result is known.

use std::path::Path;

use anyhow::Context;
use ndarray::Array3;
use sci_forward::{MaskStack, VideoShape};
use serde_json::json;

use super::Finding;
use crate::config;
use crate::factory::Factory;
use crate::io::scene::{Keys, Scene, Truth};
use crate::simulate::{Camera, simulate};
use crate::solve::{self, Show};

const SHAPE: VideoShape = VideoShape { frames: 8, height: 64, width: 64 };
/// Experiments, and the PSNR in dB that each has at least on the scene: half a dB below what it gave on every kernel.
const EXPECTED: [(&str, f64); 2] = [("gray/gap-tv", 28.7), ("gray/fast", 34.2)];

/// How each experiment did.
pub(super) fn findings() -> Vec<Finding> {
    EXPECTED.map(|(experiment, least)| finding(experiment, least)).into()
}

fn finding(experiment: &'static str, least: f64) -> Finding {
    let name = "self-test";
    match psnr(experiment) {
        Ok((psnr, seconds)) if psnr >= least => {
            let details = json!({ "experiment": experiment, "psnr_db": psnr, "least_db": least, "seconds": seconds });
            Finding::fine(
                name,
                format!("{experiment}: {psnr:.1} dB, at least {least} expected; {seconds:.2} s"),
                details,
            )
        }
        Ok((psnr, _)) => Finding::broken(
            name,
            format!(
                "{experiment}: {psnr:.1} dB, but at least {least} expected; SCI_KERNEL=portable tells whether it is a kernel's fault"
            ),
        ),
        Err(error) => Finding::broken(name, format!("{experiment}: {}", super::super::chain(&error))),
    }
}

/// PSNR in dB of the experiment on the scene, and the seconds it took.
fn psnr(experiment: &str) -> anyhow::Result<(f64, f64)> {
    let path = format!("bundled:{experiment}.toml");
    let experiment = config::load_for_arrays(Path::new(&path), &["data.path='self-test'".to_owned()])?;
    let scene = scene()?;
    let mut factory = Factory::new(&experiment, scene.cfa)?;
    let (record, _) = solve::measurement(&mut factory, &scene, &[0], None, &mut Silent)?;
    Ok((record.psnr_db.context("no truth to compare with")?, record.seconds))
}

/// A disc that moves over a shaded, textured ground, through random masks.
fn scene() -> anyhow::Result<Scene> {
    let video = Array3::from_shape_fn(SHAPE.dim(), |(t, i, j)| {
        let (t, i, j) = (t as f32, i as f32, j as f32);
        let ground = 0.3 + 0.003 * (i + j) + 0.08 * (0.7 * i).sin() * (0.5 * j).cos();
        let inside = 14.0 - (i - 24.0 - t).hypot(j - 20.0 - 2.0 * t);
        let share = (inside + 0.5).clamp(0.0, 1.0);
        ground + share * (0.85 - ground)
    });
    let masks = MaskStack::random(SHAPE, 0.5, 0)?;
    simulate("self-test", &Keys::default(), masks, Truth::Sensor(video), None, &Camera::default())
}

/// Nobody looks on.
struct Silent;

impl Show for Silent {
    fn update(&mut self, _done: usize) {}

    fn step(&mut self, _done: usize, _psnr_db: Option<f64>) {}

    fn stopped(&self) -> bool {
        false
    }
}
