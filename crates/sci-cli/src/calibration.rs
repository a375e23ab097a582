//! Owns `calibration.json`: how masks were found to sit, and how a scene takes that.

use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;

use admm::Exposure;
use anyhow::Context;
use ndarray::{Array2, Axis, Zip, s};
use sci_forward::{MaskMismatch, MaskOperator, MaskStack};
use serde::{Deserialize, Serialize};

use crate::io::defects::{Defect, LeftOut};
use crate::io::read_file;
use crate::io::scene::field::median;
use crate::io::scene::{HARDLY_OPEN, Scene};

/// What it is called in the folder that `sci calibrate` writes.
pub const FILE: &str = "calibration.json";
/// The version of the file.
const SCHEMA: u32 = 1;
/// Measurements that are looked at, at most: each makes every try so much longer.
const MOST_MEASUREMENTS: usize = 3;

/// Share of the held-out pixels' power that is not predicted, from which on masks may be of another camera, or mirrored: .06 then, .001 to .004 on
/// captures, .02 with noise of σ = 50.
const DOUBTFUL: f64 = 0.04;

/// What was found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    schema: u32,
    /// Down and to the right, in pixels.
    shift: [f64; 2],
    /// In degrees, from the right down.
    rotation: f64,
    scale: f64,
    /// Standard deviation, in pixels.
    #[serde(default)]
    blur: f64,
    /// Share of the frame before, or after if negative.
    clock: f64,
    contrast: f64,
    /// Light before the first and after the last frame, in the unit of the masks.
    ends: [f64; 2],
    /// To be taken off the measurements, in units of white.
    black: f64,
    /// What white is in the numbers of the file that it was found in; another capture has another. Nothing in calibrations of before.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    white: Option<f64>,
    /// Light before the first frame, of each frame, and after the last; nothing where all frames get as much.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    exposure: Option<Vec<f64>>,
    /// One standard deviation of the least certain of these.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    exposure_uncertainty: Option<f64>,
    /// Share of the held-out pixels' power that is not predicted, with the masks as told and as found.
    pub error_before: f64,
    /// The same, as found.
    pub error_after: f64,
    /// All that was looked for.
    pub parameters: Vec<Parameter>,
    /// Mismatches that were tried.
    pub solves: usize,
}

/// A parameter that was looked for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Parameter {
    /// Its name.
    pub name: String,
    /// What was found.
    pub value: f64,
    /// One standard deviation; nothing if the measurements do not tell.
    pub uncertainty: Option<f64>,
    /// Whether it differs from what was told.
    pub told_apart: bool,
    /// Whether it may lie further off than was looked.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub at_end: bool,
    /// Values that were tried, and the errors with them.
    pub curve: Vec<(f64, f64)>,
}

/// Is told after every solve how many are done and about how many there will be, and says whether to go on.
pub type Watch<'w> = &'w mut dyn FnMut(usize, usize) -> ControlFlow<()>;

/// Looks for the mismatch of a scene's masks, by the first few of these measurements.
///
/// # Errors
/// What [`admm::Calibration::find`] reports, also when `watch` ends it.
pub fn find(
    scene: &Scene,
    measurements: &[usize],
    settings: &admm::Calibration,
    watch: Watch<'_>,
) -> anyhow::Result<Calibration> {
    let masks = masks_told(scene)?;
    let left_out = scene.left_out.iter().map(|pixel| pixel.defect.at).collect();
    let settings = admm::Calibration { clip: scene.clip, left_out, ..settings.clone() };
    let chosen: Vec<Array2<f32>> =
        measurements.iter().take(MOST_MEASUREMENTS).map(|&k| scene.y(k).to_owned()).collect();
    let found = settings.find(&masks, scene.cfa, &chosen, &mut |progress| watch(progress.solves, progress.expected));
    Ok(Calibration::of(found.context("calibration")?, scene.white()))
}

/// The masks of a scene, those at pixels that are left out with them.
fn masks_told(scene: &Scene) -> anyhow::Result<MaskStack> {
    let source = scene.operator.masks().context("the scene has no masks to calibrate")?;
    let masks = MaskStack::from_source(source)?;
    let mut all = masks.view().to_owned();
    for LeftOut { defect: Defect { at: (row, column), .. }, masks } in &scene.left_out {
        all.slice_mut(s![.., *row, *column]).iter_mut().zip(masks).for_each(|(c, told)| *c = *told);
    }
    Ok(MaskStack::new(all)?)
}

impl Calibration {
    fn of(found: admm::Calibrated, white: f32) -> Self {
        let MaskMismatch { shift, rotation, scale, blur, clock, contrast, ends } = found.mismatch;
        let parameters = found.parameters.into_iter().map(|p| Parameter {
            name: p.name.to_owned(),
            value: p.value,
            uncertainty: Some(p.uncertainty).filter(|u| u.is_finite()),
            told_apart: p.told_apart,
            at_end: p.at_end,
            curve: p.curve,
        });
        Self {
            schema: SCHEMA,
            shift,
            rotation,
            scale,
            blur,
            clock,
            contrast,
            ends,
            black: found.black,
            white: Some(f64::from(white)),
            exposure_uncertainty: found.exposure.as_ref().map(|e| e.uncertainty),
            exposure: found.exposure.map(|e| e.gains),
            error_before: found.error[0],
            error_after: found.error[1],
            parameters: parameters.collect(),
            solves: found.solves,
        }
    }

    /// Reads the file.
    ///
    /// # Errors
    /// Names the file and what is wrong with it.
    pub fn read(path: &Path) -> anyhow::Result<Self> {
        let read = || -> anyhow::Result<Self> {
            let found: Self = serde_json::from_slice(&read_file(path)?)?;
            anyhow::ensure!(found.schema == SCHEMA, "its schema is {}, expected {SCHEMA}", found.schema);
            Ok(found)
        };
        read().with_context(|| format!("{}: not a calibration of `sci calibrate`", path.display()))
    }

    /// As a file.
    ///
    /// # Panics
    /// Never: its keys are strings.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("a calibration has only string keys and plain values") + "\n"
    }

    /// How masks differ from those told.
    pub fn mismatch(&self) -> MaskMismatch {
        let Self { shift, rotation, scale, blur, clock, contrast, ends, .. } = *self;
        MaskMismatch { shift, rotation, scale, blur, clock, contrast, ends }
    }

    /// The masks as they are; closed where that comes from beyond the edge of those told, and where they are hardly open, so that what is
    /// measured there is left out, as are pixels that the scene leaves out.
    ///
    /// # Errors
    /// If nothing of them is left open.
    pub fn masks(&self, scene: &Scene) -> anyhow::Result<MaskStack> {
        if let Some(gains) = self.exposure.as_ref().filter(|gains| gains.len() != scene.frames() + 2) {
            let (found, frames) = (gains.len().saturating_sub(2), scene.frames());
            anyhow::bail!("data.calibration: it is of {found} frames a measurement, the scene has {frames}");
        }
        let mismatch = self.mismatch();
        let moved = mismatch.apply(&masks_told(scene)?)?;
        let mut known = mismatch.reach(moved.shape().image_dim());
        scene.left_out.iter().for_each(|pixel| known[pixel.defect.at] = false);
        let exposed = match &self.exposure {
            Some(gains) => Exposure { gains: gains.clone(), uncertainty: 0.0 }.apply(&moved)?,
            None => moved,
        };
        let open = exposed.view().mapv(f32::abs).sum_axis(Axis(0));
        let least = HARDLY_OPEN * median(&open);
        let told = Zip::from(&known).and(&open).map_collect(|&known, &open| known && open >= least);
        let mut masks = exposed.view().to_owned();
        for mut mask in masks.outer_iter_mut() {
            mask.zip_mut_with(&told, |c, &told| *c = if told { *c } else { 0.0 });
        }
        Ok(MaskStack::new(masks)?)
    }

    /// Gives a scene the masks as they are, and takes the black level off its measurements.
    ///
    /// # Errors
    /// As [`Calibration::masks`].
    pub fn apply(&self, scene: &mut Scene) -> anyhow::Result<()> {
        scene.operator = Arc::new(MaskOperator::new(self.masks(scene)?));
        // The level is the sensor's, white the capture's.
        let black = (self.black * self.white.map_or(1.0, |white| white / f64::from(scene.white()))) as f32;
        scene.measurements -= black;
        scene.clip = scene.clip.map(|level| level - black);
        Ok(())
    }

    /// A line for each parameter.
    pub fn lines(&self) -> Vec<String> {
        let line = |p: &Parameter| {
            let value = match p.uncertainty {
                Some(uncertainty) => format!("{:9.4} ± {uncertainty:.4}", p.value),
                None => format!("{:9.4}   (not told by the measurements)", p.value),
            };
            let remark = match (p.at_end, p.told_apart, self.white) {
                (true, ..) if p.name.starts_with("shift") => {
                    "   at the end of what was looked at: it may lie further off, see --reach of sci calibrate"
                        .to_owned()
                }
                (true, ..) => "   at the end of what was looked at: it may lie further off".to_owned(),
                (false, true, Some(white)) if p.name == "black level" => {
                    format!(
                        "   of the mean; in the numbers of the file {:.4}, beside data.sensor.black",
                        self.black * white
                    )
                }
                (false, true, _) => String::new(),
                (false, false, _) => "   as told".to_owned(),
            };
            format!("{:<12} {value}{remark}", p.name)
        };
        let exposure = self.exposure.iter().map(|gains| {
            let gains: Vec<String> = gains.iter().map(|gain| format!("{gain:.2}")).collect();
            let uncertainty = self.exposure_uncertainty.unwrap_or(0.0);
            format!("{:<12} {} ± {uncertainty:.2} (before, of each frame, after)", "light", gains.join(" "))
        });
        let doubt = (self.error_after > DOUBTFUL).then(|| {
            format!(
                "{:.0} % of what held-out pixels measure is not predicted, with the masks as found: do masks and measurements belong together?",
                100.0 * self.error_after
            )
        });
        self.parameters.iter().map(line).chain(exposure).chain(doubt).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::samples::{Array, SampleType, Samples};
    use crate::io::scene::{Arrays, Reading, of_arrays};

    /// A scene whose white is this number.
    fn scene(white: f32) -> Scene {
        let array = |shape: [usize; 3], value: f32| {
            let values = (0..shape.iter().product())
                .map(|i| if shape[0] > 1 { ((i * 7 + i / 8) % 3 % 2) as f32 } else { value });
            Array::new(shape.to_vec(), Samples::Floats(values.collect()), SampleType::F32).unwrap()
        };
        let arrays = Arrays { mask: array([4, 8, 8], 1.0), meas: Some(array([1, 8, 8], white)), truth: None };
        of_arrays(arrays, &Reading { scale: Some(white), ..Reading::default() }).unwrap()
    }

    fn calibration(more: &str) -> Calibration {
        let text = format!(
            r#"{{"schema": 1, "shift": [0, 0], "rotation": 0, "scale": 1, "clock": 0, "contrast": 1, "ends": [0, 0], "black": 0.1,
            "error_before": 0.1, "error_after": 0.1, "parameters": [], "solves": 1{more}}}"#
        );
        serde_json::from_str(&text).unwrap()
    }

    #[test]
    fn a_black_level_is_the_sensors_whatever_white_is() {
        for (more, white, expected) in
            [("", 50.0, 0.9), (r#", "white": 100.0"#, 50.0, 0.8), (r#", "white": 100.0"#, 100.0, 0.9)]
        {
            let mut scene = scene(white);
            calibration(more).apply(&mut scene).unwrap();
            assert!(
                scene.measurements.iter().all(|y| (y - expected).abs() < 1e-6),
                "{more} {white}: {}",
                scene.measurements
            );
        }
    }

    #[test]
    fn a_calibration_of_other_frames_is_refused_and_one_that_tells_little_doubted() {
        let other = calibration(r#", "exposure": [0, 1, 1, 0]"#);
        let error = other.masks(&scene(1.0)).unwrap_err().to_string();
        assert_eq!(error, "data.calibration: it is of 2 frames a measurement, the scene has 4");
        assert!(other.lines().last().unwrap().contains("belong together"));
    }
}
