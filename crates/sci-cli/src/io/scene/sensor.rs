//! What a sensor does to the light that it sums.

use std::path::PathBuf;

use ndarray::{ArrayView2, ArrayView3, Zip};
use sci_forward::Noise;

/// What is known of a sensor, or to be found out.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sensor {
    /// What it measures without light, in the unit of the file.
    pub black: f32,
    /// The same pixel by pixel, a file or folder.
    pub dark: Option<PathBuf>,
    /// What it measures of a white scene with no mask before it, a file or folder.
    pub white: Option<PathBuf>,
    /// Its noise.
    pub noise: SensorNoise,
    /// Whether its brightest pixels are clipped.
    pub clip: Clip,
}

/// What solvers are told of a sensor's noise.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum SensorNoise {
    /// Nothing: measurements are to be explained exactly.
    #[default]
    None,
    /// This, in units of white.
    Known(Noise),
    /// What pixels that no mask opens show of it.
    Auto,
}

/// The level that a sensor cannot exceed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Clip {
    /// The brightest value, if many pixels have it whatever their masks.
    #[default]
    Auto,
    /// There is none.
    None,
    /// In the unit of the file.
    Level(f32),
}

/// At least this share of the pixels has the brightest value where it is a limit.
const CROWDED: f64 = 1e-3;
/// If more have it, there is nothing to see.
const BLIND: f64 = 0.5;
/// Pixels at a limit are open for less than this share of the most open one's time; white behind masks that are open most is no limit.
const OPENNESS: f64 = 0.95;

impl Clip {
    /// As in an experiment file.
    pub fn to_json(self) -> serde_json::Value {
        match self {
            Self::Auto => "auto".into(),
            Self::None => "none".into(),
            Self::Level(level) => level.into(),
        }
    }

    /// The level, for measurements `[N, H, W]` through masks with the sums `open` `[H, W]`, and what is to be said of it.
    pub(super) fn level(self, meas: ArrayView3<'_, f32>, open: ArrayView2<'_, f32>) -> (Option<f32>, Option<String>) {
        match self {
            Self::None => (None, None),
            Self::Level(level) => {
                let count = meas.iter().filter(|&&y| y >= level).count();
                let share = 100.0 * count as f64 / meas.len().max(1) as f64;
                let odd = (share > 50.0).then(|| {
                    format!("data.sensor.clip = {level}, in the numbers of the file: {share:.0} % of the pixels are there or above")
                });
                (Some(level), odd)
            }
            Self::Auto => match crowded(meas, open) {
                None => (None, None),
                Some((level, share)) => {
                    let note = format!(
                        "{:.1} % of the pixels are clipped at {level}: they count as at least that bright; data.sensor.clip = \"none\" believes them",
                        100.0 * share
                    );
                    (Some(level), Some(note))
                }
            },
        }
    }
}

/// The brightest value, and the share of the pixels that have it, if they are too many to have it by chance.
fn crowded(meas: ArrayView3<'_, f32>, open: ArrayView2<'_, f32>) -> Option<(f32, f64)> {
    let brightest = meas.iter().copied().filter(|v| v.is_finite()).fold(0.0, f32::max);
    let most_open = open.iter().copied().fold(0.0, f32::max);
    if brightest <= 0.0 || most_open <= 0.0 || meas.shape()[1..] != *open.shape() {
        return None;
    }
    let (mut count, mut openness) = (0usize, 0f64);
    for y in meas.outer_iter() {
        Zip::from(y).and(open).for_each(|&y, &open| {
            if y >= brightest {
                count += 1;
                openness += f64::from(open / most_open);
            }
        });
    }
    let share = count as f64 / meas.len() as f64;
    (count >= 8 && (CROWDED..=BLIND).contains(&share) && openness / (count as f64) < OPENNESS)
        .then_some((brightest, share))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array2, Array3};
    use sci_forward::{MaskOperator, MaskStack, SensingOperator, VideoShape};

    fn measured(frame: impl Fn(usize, usize) -> f32) -> (Array3<f32>, Array2<f32>) {
        let shape = VideoShape { frames: 8, height: 48, width: 48 };
        let h = MaskOperator::new(MaskStack::random(shape, 0.5, 2).unwrap());
        let video = Array3::from_shape_fn(shape.dim(), |(_, i, j)| frame(i, j));
        let open = h.forward(Array3::ones(shape.dim()).view());
        (h.forward(video.view()).insert_axis(ndarray::Axis(0)), open)
    }

    #[test]
    fn clipped_pixels_are_told_from_bright_ones() {
        let (y, open) = measured(|i, j| 0.2 + 0.7 * ((i * 5 + j * 3) % 48) as f32 / 48.0);
        assert_eq!(Clip::Auto.level(y.view(), open.view()), (None, None));
        let clipped = y.mapv(|y| y.min(2.5));
        let (level, note) = Clip::Auto.level(clipped.view(), open.view());
        assert!(level == Some(2.5) && note.unwrap().contains("clipped at 2.5"));
        assert_eq!(Clip::None.level(clipped.view(), open.view()).0, None);
        assert_eq!(Clip::Level(2.0).level(clipped.view(), open.view()).0, Some(2.0));
    }

    #[test]
    fn a_white_wall_is_not_clipped() {
        let (y, open) = measured(|_, _| 1.0);
        assert_eq!(Clip::Auto.level(y.view(), open.view()).0, None);
        assert_eq!(Clip::Auto.level((y * 0.0).view(), open.view()).0, None);
    }
}
