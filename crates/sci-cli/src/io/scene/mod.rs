//! Owns the step from files to a scene: which array plays which part, its axes, its scale, and whether all fit together.
//!
//! A scene is masks, measurements and, if known, the truth; all in the layouts and units of the library: `[T, H, W]`,
//! frames in `[0, 1]`, measurements up to `Σ_t C_t`. A color scene is one of a Bayer sensor: what is measured, and the
//! truth it is compared with, is the mosaic; RGB truth is kept beside it.

use std::path::PathBuf;
use std::sync::Arc;

use ndarray::{Array2, Array3, Array4, ArrayView2, ArrayView3, ArrayView4, Axis, s};
use sci_forward::bayer::mosaic_into;
use sci_forward::{
    BinaryMasks, CfaPattern, MaskError, MaskOperator, MaskStack, Measurement, MeasurementError, Noise, SensingOperator,
    brightness,
};

mod banded;
#[cfg(test)]
mod camera_tests;
mod error;
pub(crate) mod field;
mod layout;
mod names;
mod orientation;
mod read;
mod scale;
mod sensor;
mod shift;
mod source;

pub use banded::Banded;
pub use error::SceneError;
pub use read::{Arrays, Decided, Video, as_read, of_arrays, read, read_gray_video, read_mask, read_video};
pub use sensor::{Clip, Sensor, SensorNoise};
pub use shift::MaskShift;

use super::defects::{self, Defect, Defects, LeftOut};
use super::raw::Raw;

/// The names under which a file holds the parts of a scene.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Keys {
    /// Masks `[B, H, W]`.
    pub mask: String,
    /// Measurements `[N, H, W]`.
    pub meas: String,
    /// Gray (or mosaic) truth `[T, H, W]`, of no account where there is `rgb`.
    pub orig: String,
    /// Color truth `[T, H, W, 3]`; a scene that has it is one of a Bayer sensor.
    pub rgb: String,
}

impl Default for Keys {
    fn default() -> Self {
        Self { mask: "mask".into(), meas: "meas".into(), orig: "orig".into(), rgb: "rgb".into() }
    }
}

impl Keys {
    fn all(&self) -> [&str; 4] {
        [&self.mask, &self.meas, &self.orig, &self.rgb]
    }
}

/// The order of a three-axis array in its file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Axes {
    /// Rows, columns, frames: MATLAB's habit.
    Hwt,
    /// Frames, rows, columns: NumPy's habit.
    Thw,
}

/// How to understand a scene file; `None` means by the file's format and content.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reading {
    /// Names of the parts.
    pub keys: Keys,
    /// Order of axes: `hwt` for .mat, `thw` otherwise.
    pub axes: Option<Axes>,
    /// What white is in the file: 255 for .mat and for bytes, 1 for floats of the other formats, unless the content says otherwise.
    pub scale: Option<f32>,
    /// The Bayer pattern of the sensor: RGGB where there is RGB truth, none (a gray sensor) otherwise.
    pub cfa: Option<CfaPattern>,
    /// What to do about defective pixels of the sensor.
    pub defects: Defects,
    /// How many pixels the masks may sit from where they are told to: 1 for those that are to be calibrated.
    pub masks_off: usize,
    /// The masks' own file or folder, of any format, if they are not in the scene's.
    pub mask: Option<PathBuf>,
    /// How one mask makes those of all frames.
    pub shift: Option<MaskShift>,
    /// What the measurements' file is if it has no header.
    pub raw: Option<Raw>,
    /// What the sensor does to the light.
    pub sensor: Sensor,
    /// Of a part of a scene, what its numbers mean.
    pub decided: Option<Decided>,
}

/// Masks, measurements and truth that fit together.
#[derive(Clone)]
pub struct Scene {
    /// H of the masks C `[B, H, W]`; binary ones take a bit a pixel.
    pub operator: Arc<dyn SensingOperator>,
    /// y `[N, H, W]`, up to `Σ_t C_t`.
    pub measurements: Array3<f32>,
    /// x `[T, H, W]` in `[0, 1]`, the mosaic for color; frame `k·B + t` belongs to measurement k.
    pub truth: Option<Array3<f32>>,
    /// The RGB video `[T, 3, H, W]` in `[0, 1]` whose mosaic the truth is.
    pub rgb: Option<Array4<f32>>,
    /// The pattern of a color sensor, `None` for a gray one.
    pub cfa: Option<CfaPattern>,
    /// What white is in units of the file's scale. 1 but for measurements that are far off that scale: they, and truth that is too,
    /// are divided by it, so that results have to be multiplied.
    pub unit: f32,
    /// The noise of the measurements, where solvers are to know of it.
    pub noise: Option<Noise>,
    /// What no measurement exceeds, in their unit.
    pub clip: Option<f32>,
    /// Pixels that measure nothing: closed in all masks, 0 in all measurements.
    pub left_out: Vec<LeftOut>,
    /// What looked odd but is no error.
    pub warnings: Vec<String>,
    decided: Decided,
}

impl std::fmt::Debug for Scene {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Scene").field("shape", &self.operator.shape()).field("cfa", &self.cfa).finish_non_exhaustive()
    }
}

/// What was in front of the camera.
#[derive(Clone, Debug)]
pub enum Truth {
    /// As the sensor sees it: gray or a mosaic, `[T, H, W]`.
    Sensor(Array3<f32>),
    /// In color, `[T, 3, H, W]`.
    Rgb(Array4<f32>),
}

impl Truth {
    /// What a sensor with this pattern sees of it, `[T, H, W]`, and the color video if it is one.
    pub fn seen(self, cfa: Option<CfaPattern>) -> (Array3<f32>, Option<Array4<f32>>) {
        match self {
            Self::Sensor(x) => (x, None),
            Self::Rgb(rgb) => {
                let (t, _, h, w) = rgb.dim();
                let mut x = Array3::zeros((t, h, w));
                mosaic_into(cfa.unwrap_or_default(), rgb.view(), x.view_mut());
                (x, Some(rgb))
            }
        }
    }
}

impl Scene {
    /// Joins checked parts; measurements are simulated from the truth where `measurements` is `None`.
    ///
    /// The sensor is a color one if `cfa` says so or the truth is in color (RGGB then).
    ///
    /// # Errors
    /// [`SceneError`] if sizes differ, values are not finite, or there is neither measurement nor truth.
    pub fn new(
        file: &str,
        keys: &Keys,
        mask: Array3<f32>,
        measurements: Option<Array3<f32>>,
        truth: Option<Truth>,
        cfa: Option<CfaPattern>,
    ) -> Result<Self, SceneError> {
        let masks = read::checked(mask, file, &keys.mask)?;
        let (height, width) = masks.shape().image_dim();
        let check = |key: &str, array: ArrayView3<'_, f32>| {
            check_size(file, key, array, &keys.mask, (height, width))?;
            check_finite(file, key, array)
        };
        let cfa = if let Some(Truth::Rgb(_)) = truth { Some(cfa.unwrap_or_default()) } else { cfa };
        if cfa.is_some() && (height < 2 || width < 2) {
            return Err(SceneError::NoBayerPattern { file: file.into(), height, width });
        }
        if let Some(m) = &measurements {
            check(&keys.meas, m.view())?;
        }
        match &truth {
            None => {}
            Some(Truth::Sensor(x)) => check(&keys.orig, x.view())?,
            Some(Truth::Rgb(rgb)) => (0..3).try_for_each(|c| check(&keys.rgb, rgb.index_axis(Axis(1), c)))?,
        }
        let (truth, rgb) = truth.map_or((None, None), |truth| {
            let (x, rgb) = truth.seen(cfa);
            (Some(x), rgb)
        });
        let brightest = masks.reach();
        let operator = operator_of(masks);
        let mut warnings = Vec::new();
        let measurements = match (measurements, &truth) {
            (Some(m), _) => m,
            (None, Some(x)) => simulate(file, operator.as_ref(), x.view(), &mut warnings)?,
            (None, None) => {
                return Err(SceneError::MissingKey {
                    file: file.into(),
                    key: keys.meas.clone(),
                    part: "measurements, or the truth to simulate them from",
                    near: None,
                    present: vec![keys.mask.clone()],
                });
            }
        };
        let mut scene = Self {
            operator,
            measurements,
            truth,
            rgb,
            cfa,
            unit: 1.0,
            noise: None,
            clip: None,
            left_out: Vec::new(),
            warnings,
            decided: Decided::default(),
        };
        scene.look_for_wrong_scales(brightest);
        Ok(scene)
    }

    /// What white is in the numbers of the file that measurements came in.
    pub fn white(&self) -> f32 {
        self.decided.meas * self.unit
    }

    /// B, frames a measurement sums.
    pub fn frames(&self) -> usize {
        self.operator.shape().frames
    }

    /// N, measurements.
    pub fn len(&self) -> usize {
        self.measurements.len_of(Axis(0))
    }

    /// Whether there is no measurement.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Measurement `k` with what made it.
    ///
    /// # Errors
    /// None that is known: a scene's parts fit.
    ///
    /// # Panics
    /// If `k` is not below [`Scene::len`].
    pub fn measurement(&self, k: usize) -> Result<Measurement, MeasurementError> {
        let measurement = Measurement::new(Arc::clone(&self.operator), self.y(k).to_owned())?;
        Ok(measurement.with_cfa(self.cfa).with_noise(self.noise).with_clip(self.clip))
    }

    /// y `[H, W]` of measurement `k`.
    ///
    /// # Panics
    /// If `k` is not below [`Scene::len`].
    pub fn y(&self, k: usize) -> ArrayView2<'_, f32> {
        self.measurements.index_axis(Axis(0), k)
    }

    /// x `[B, H, W]` of measurement `k`, if the truth reaches that far.
    pub fn truth_of(&self, k: usize) -> Option<ArrayView3<'_, f32>> {
        let b = self.frames();
        let truth = self.truth.as_ref()?;
        (truth.len_of(Axis(0)) >= (k + 1) * b).then(|| truth.slice(s![k * b..(k + 1) * b, .., ..]))
    }

    /// The RGB truth `[B, 3, H, W]` of measurement `k`, if it is known and reaches that far.
    pub fn rgb_of(&self, k: usize) -> Option<ArrayView4<'_, f32>> {
        let b = self.frames();
        let rgb = self.rgb.as_ref()?;
        (rgb.len_of(Axis(0)) >= (k + 1) * b).then(|| rgb.slice(s![k * b..(k + 1) * b, .., .., ..]))
    }

    /// Looks for defective pixels again, by the masks as they are now, and says which there are in all; leaves them out if that is wished.
    ///
    /// # Errors
    /// If no pixel is left.
    pub fn look_for_defects(&mut self, wish: Defects) -> Result<Option<String>, MaskError> {
        let Some(masks) = self.operator.masks() else { return Ok(None) };
        let mut mask = MaskStack::from_source(masks)?.view().to_owned();
        let found = defects_of(mask.view(), self.measurements.view(), self.cfa.is_some(), 0);
        if wish == Defects::Keep {
            return Ok(defects::note(&found, wish));
        }
        if !found.is_empty() {
            self.left_out.extend(defects::exclude(&found, &mut mask, &mut self.measurements));
            self.operator = operator_of(MaskStack::new(mask)?);
        }
        let all: Vec<Defect> = self.left_out.iter().map(|pixel| pixel.defect).collect();
        Ok(defects::note(&all, wish))
    }

    /// A wrong scale gives a plausible but wrong picture, so it is worth a look at the numbers; `brightest` is what white measures at
    /// most.
    fn look_for_wrong_scales(&mut self, brightest: f32) {
        let peak = self.measurements.iter().fold(0f32, |peak, y| peak.max(y.abs()));
        if peak > 2.0 * brightest {
            self.warnings.push(format!(
                "measurements reach {peak}, but the masks add up to {brightest} at most; is data.scale right?"
            ));
        }
        let mismatch = (!self.is_empty()).then(|| self.truth_of(0)).flatten().map(|x| {
            let expected = self.operator.forward(x);
            let (mut off, mut all) = (0.0f64, 0.0f64);
            for (&a, &b) in expected.iter().zip(self.y(0)) {
                off += f64::from(a - b).powi(2);
                all += f64::from(b).powi(2);
            }
            (off / all.max(f64::MIN_POSITIVE)).sqrt()
        });
        if let Some(mismatch) = mismatch.filter(|&m| m > 0.2) {
            self.warnings.push(format!(
                "measurement 0 differs by {:.0} % from the masked sum of the truth; do mask, measurement and truth belong together{}?",
                100.0 * mismatch,
                if self.rgb.is_some() { ", and is data.cfa the sensor's" } else { "" }
            ));
        }
    }
}

/// H of masks; binary ones take a bit a pixel.
pub fn operator_of(masks: MaskStack) -> Arc<dyn SensingOperator> {
    match BinaryMasks::new(&masks) {
        Ok(binary) => Arc::new(MaskOperator::new(binary)),
        Err(_) => Arc::new(MaskOperator::new(masks)),
    }
}

fn check_size(
    file: &str,
    key: &str,
    array: ArrayView3<'_, f32>,
    mask: &str,
    mask_size: (usize, usize),
) -> Result<(), SceneError> {
    let (_, h, w) = array.dim();
    if (h, w) == mask_size {
        return Ok(());
    }
    Err(SceneError::SizeMismatch { file: file.into(), key: key.into(), size: (h, w), mask: mask.into(), mask_size })
}

fn check_finite(file: &str, key: &str, array: ArrayView3<'_, f32>) -> Result<(), SceneError> {
    // Without an early end rows are gone through by whole vectors.
    if array.rows().into_iter().all(|row| row.iter().fold(true, |finite, v| finite & v.is_finite())) {
        return Ok(());
    }
    match array.indexed_iter().find(|(_, v)| !v.is_finite()) {
        None => Ok(()),
        Some(((frame, row, column), &value)) => {
            Err(SceneError::NotFinite { file: file.into(), key: key.into(), value, frame, row, column })
        }
    }
}

/// y `[N, H, W]` of a video `[T, H, W]`, N = T / B rounded down.
fn simulate(
    file: &str,
    operator: &dyn SensingOperator,
    truth: ArrayView3<'_, f32>,
    warnings: &mut Vec<String>,
) -> Result<Array3<f32>, SceneError> {
    let b = operator.shape().frames;
    let frames = truth.len_of(Axis(0));
    let count = frames / b;
    if count == 0 {
        return Err(SceneError::TooFewFrames { file: file.into(), frames, needed: b });
    }
    if !frames.is_multiple_of(b) {
        warnings
            .push(format!("the last {} of {frames} frames fill no measurement of {b} and are left out", frames % b));
    }
    let (h, w) = operator.shape().image_dim();
    let mut y = Array3::zeros((count, h, w));
    for (k, y) in y.outer_iter_mut().enumerate() {
        operator.forward_into(truth.slice(s![k * b..(k + 1) * b, .., ..]), y);
    }
    Ok(y)
}

/// White is here, in units of the file's scale; a scene may be darker than white, but a sensor's 8 bits end at the lower one.
const PLAUSIBLE_WHITE: std::ops::RangeInclusive<f32> = 1.0 / 64.0..=4.0;

/// What is white in measurements `[N, H, W]` of masks `[B, H, W]` if their brightest hundredth is; nothing if there is no light.
fn brightest_light(meas: ArrayView3<'_, f32>, masks: ArrayView3<'_, f32>) -> Option<f32> {
    let mut open = masks.sum_axis(Axis(0));
    let is_signed = is_signed(masks);
    if !is_signed {
        // What is divided by little light is noise.
        let least = HARDLY_OPEN * field::median(&open);
        open.mapv_inplace(|open| if open < least { 0.0 } else { open });
    }
    // Masks of both signs may add up to nothing at a pixel. Those that are closed come out infinite, and do not count.
    let light = |y: ArrayView2<'_, f32>| match is_signed {
        true => brightness(y, open.view(), EVEN),
        false => &y / &open,
    };
    brightest_hundredth(meas.outer_iter().flat_map(light)).filter(|&bright| bright > 0.0)
}

/// Pixels that masks open for less than this share of the usual tell nothing that is to be divided by it.
pub(crate) const HARDLY_OPEN: f32 = 0.2;

/// The defective pixels of measurements `[N, H, W]` of masks `[B, H, W]` that may sit `off` pixels elsewhere.
fn defects_of(masks: ArrayView3<'_, f32>, meas: ArrayView3<'_, f32>, is_color: bool, off: usize) -> Vec<Defect> {
    defects::find(light_through(masks).view(), meas, if is_color { 2 } else { 1 }, off)
}

/// What white measures `[H, W]`; of masks of both signs nothing, as their measurements do not tell how much light there was.
fn light_through(masks: ArrayView3<'_, f32>) -> Array2<f32> {
    match is_signed(masks) {
        true => Array2::zeros((masks.len_of(Axis(1)), masks.len_of(Axis(2)))),
        false => masks.sum_axis(Axis(0)),
    }
}

/// Pixels to each side over which a scene is taken to be even, where a pixel alone says nothing.
const EVEN: usize = 4;

/// Whether masks are those of a differential camera.
fn is_signed(masks: ArrayView3<'_, f32>) -> bool {
    masks.iter().any(|&c| c < 0.0)
}

/// The value that a hundredth of the finite ones exceed.
fn brightest_hundredth(values: impl Iterator<Item = f32>) -> Option<f32> {
    let mut finite: Vec<f32> = values.filter(|v| v.is_finite()).collect();
    let rank = finite.len().checked_sub(1)? * 99 / 100;
    Some(*finite.select_nth_unstable_by(rank, f32::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::io::mat::{Variable, write_v5};

    /// Column-major `[H, W, T]` samples of a function of (t, row, column).
    fn column_major((t, h, w): (usize, usize, usize), f: impl Fn(usize, usize, usize) -> f32) -> Vec<f32> {
        let mut v = Vec::new();
        for k in 0..t {
            for x in 0..w {
                for y in 0..h {
                    v.push(f(k, y, x));
                }
            }
        }
        v
    }

    fn write_scene(dir: &Path, meas: Option<Vec<f32>>) -> std::path::PathBuf {
        let mask = column_major((2, 3, 4), |t, y, x| ((t + y + x) % 2) as f32);
        let orig = column_major((4, 3, 4), |t, y, x| (60 * t + 10 * y + x) as f32);
        let mut variables = vec![
            Variable { name: "mask", size: &[3, 4, 2], data: &mask },
            Variable { name: "orig", size: &[3, 4, 4], data: &orig },
        ];
        if let Some(m) = &meas {
            variables.push(Variable { name: "meas", size: &[3, 4, 2], data: m });
        }
        let path = dir.join("scene.mat");
        let mut bytes = Vec::new();
        write_v5(&mut bytes, &variables).unwrap();
        std::fs::write(&path, bytes).unwrap();
        path
    }

    #[test]
    fn mat_axes_and_scale() {
        let dir = tempfile::tempdir().unwrap();
        let scene = read(&write_scene(dir.path(), None), &Reading::default()).unwrap();
        assert_eq!((scene.len(), scene.frames()), (2, 2));
        let truth = scene.truth_of(1).unwrap();
        assert_eq!(truth[[1, 2, 3]], (180.0 + 23.0) / 255.0);
        // Pixel (2, 3): mask 0 is open (0 + 2 + 3 odd), mask 1 closed.
        assert_eq!(scene.y(0)[[2, 3]], 23.0 / 255.0);
        assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    }

    #[test]
    fn a_measurement_of_another_scale_is_noticed() {
        let dir = tempfile::tempdir().unwrap();
        let meas = column_major((2, 3, 4), |_, _, _| 3.0 * 255.0);
        let scene = read(&write_scene(dir.path(), Some(meas)), &Reading::default()).unwrap();
        assert_eq!((scene.warnings.len(), scene.unit), (2, 1.0), "{:?}", scene.warnings);
    }

    #[test]
    fn a_measurement_far_off_its_scale_is_rescaled_unless_the_scale_is_given() {
        let dir = tempfile::tempdir().unwrap();
        let path = write_scene(dir.path(), Some(column_major((2, 3, 4), |_, _, _| 1e8 * 255.0)));
        let scene = read(&path, &Reading::default()).unwrap();
        assert_eq!((scene.unit, scene.y(1)[[1, 2]]), (1e8, 1.0));
        assert!(scene.warnings[0].contains("white is taken to be 2.550e10"), "{:?}", scene.warnings);
        let scene = read(&path, &Reading { scale: Some(255.0), ..Reading::default() }).unwrap();
        assert_eq!((scene.unit, scene.y(1)[[1, 2]]), (1.0, 1e8));
    }

    #[test]
    fn a_nan_pixel_is_left_out_on_request() {
        let dir = tempfile::tempdir().unwrap();
        let meas = column_major((2, 3, 4), |t, y, x| if (t, y, x) == (1, 2, 0) { f32::NAN } else { 200.0 });
        let reading = Reading { defects: Defects::Exclude, ..Reading::default() };
        let scene = read(&write_scene(dir.path(), Some(meas)), &reading).unwrap();
        assert_eq!(scene.operator.gram()[[2, 0]], 0.0);
        assert!(scene.measurements.iter().all(|v| v.is_finite()));
        assert!(scene.warnings[0].contains("1 not finite at (row, column) (2, 0)"), "{:?}", scene.warnings);
    }

    #[test]
    fn nan_is_located() {
        let dir = tempfile::tempdir().unwrap();
        let meas = column_major((2, 3, 4), |t, y, x| if (t, y, x) == (1, 2, 0) { f32::NAN } else { 1.0 });
        let error = read(&write_scene(dir.path(), Some(meas)), &Reading::default()).unwrap_err().to_string();
        assert!(error.contains("`meas` is NaN at frame 1, row 2, column 0"), "{error}");
    }
}
