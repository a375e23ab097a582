//! Owns what a camera sees of nothing and of white, for masks and measurements: dark and white frames.

use std::path::Path;

use ndarray::{Array2, Array3, Axis, Zip};

use super::layout::Place;
use super::source::Source;
use super::{Reading, SceneError, check_finite, check_size};

/// A dark and a white frame, each `[1, H, W]` in the unit of the file of what it belongs to.
#[derive(Default)]
pub(super) struct Field {
    /// What is measured without light.
    pub(super) dark: Option<Array3<f32>>,
    /// What is measured of a white scene with no mask before it.
    pub(super) white: Option<Array3<f32>>,
}

/// Pixels at which white is less than this share of the usual above dark see next to nothing: what is divided by it is noise.
const DEAD: f32 = 0.05;

impl Field {
    /// Reads the frames that there are.
    pub(super) fn read(reading: &Reading) -> Result<Self, SceneError> {
        let sensor = &reading.sensor;
        let read = |path: &Option<_>, key| path.as_deref().map(|path| frame(path, key, reading)).transpose();
        Ok(Self { dark: read(&sensor.dark, DARK)?, white: read(&sensor.white, WHITE)? })
    }

    /// Masks `[B, H, W]` as transmittances, `(mask − dark) / (white − dark)`, closed where white is hardly more than dark; without a white frame
    /// divided by `full`.
    pub(super) fn transmittances(
        &self,
        mut mask: Array3<f32>,
        full: f32,
        (key, reading): (&str, &Reading),
        notes: &mut Vec<String>,
    ) -> Result<Array3<f32>, SceneError> {
        let size = (mask.len_of(Axis(1)), mask.len_of(Axis(2)));
        self.check(reading, key, size)?;
        if let Some(dark) = &self.dark {
            mask -= dark;
        }
        let Some(white) = &self.white else { return Ok(mask / full) };
        let light = match &self.dark {
            Some(dark) => white - dark,
            None => white.clone(),
        };
        let light = light.index_axis_move(Axis(0), 0);
        let least = DEAD * median(&light);
        let dead = light.iter().filter(|&&light| light <= least.max(0.0)).count();
        if dead > 0 {
            notes
                .push(format!("{WHITE}: {dead} pixels see less than 5 % of the usual light and count as not measured"));
        }
        for mut mask in mask.outer_iter_mut() {
            Zip::from(&mut mask)
                .and(&light)
                .for_each(|c, &light| *c = if light > least.max(0.0) { *c / light } else { 0.0 });
        }
        Ok(mask)
    }

    /// That the frames have the size of an array.
    pub(super) fn check(&self, reading: &Reading, key: &str, size: (usize, usize)) -> Result<(), SceneError> {
        let sensor = &reading.sensor;
        for (frame, path, name) in [(&self.dark, &sensor.dark, DARK), (&self.white, &sensor.white, WHITE)] {
            if let (Some(frame), Some(path)) = (frame, path) {
                check_size(&path.display().to_string(), name, frame.view(), key, size)?;
            }
        }
        Ok(())
    }
}

const DARK: &str = "data.sensor.dark";
const WHITE: &str = "data.sensor.white";

/// The mean `[1, H, W]` of the frames in a file of any format.
fn frame(path: &Path, key: &'static str, reading: &Reading) -> Result<Array3<f32>, SceneError> {
    // Without a header it is what the measurements' file is said to be.
    let source = match (Source::open(path, None), reading.raw) {
        (Err(_), Some(raw)) => Source::open(path, Some(raw))?,
        (opened, _) => opened?,
    };
    let (array, name) = source.array(key.rsplit('.').next().unwrap_or(key), "the frame")?;
    let place = Place { file: &source.file, key: &name, format: source.format(), axes: reading.axes };
    let frames = place.frames(&array, 1.0)?;
    check_finite(&source.file, key, frames.view())?;
    let count = frames.len_of(Axis(0)) as f32;
    Ok((frames.sum_axis(Axis(0)) / count).insert_axis(Axis(0)))
}

/// The upper one of two.
///
/// # Panics
/// If there is no pixel.
pub(crate) fn median(image: &Array2<f32>) -> f32 {
    let mut values: Vec<f32> = image.iter().copied().collect();
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}
