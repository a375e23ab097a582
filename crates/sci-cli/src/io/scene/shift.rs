//! Owns the masks of one calibrated pattern that moves.

use ndarray::{Array2, Array3, ArrayBase, Axis, Dimension, OwnedRepr, RemoveAxis, Slice};
use sci_forward::{MaskError, MaskStack, ShiftingMasks};

/// How a single mask makes those of all frames: frame t sees it at the offset t · `step`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MaskShift {
    /// How far down and to the right each frame sees the pattern from where the one before did, in pixels of any sign, fractions too: frame t at
    /// `(y, x)` sees the pattern at `(y, x) + t · step`, so that its image moves up and to the left.
    pub step: [f64; 2],
    /// B.
    pub frames: usize,
}

/// The masks of the frames, and where on the sensor they are known.
pub(super) struct Moved {
    pub(super) masks: Array3<f32>,
    /// The first row and column of the pattern's own sensor that every offset knows the pattern for.
    first: [usize; 2],
    pattern: (usize, usize),
}

impl MaskShift {
    /// The masks of all frames where the moving pattern covers them; on a color sensor the first row and column stay even.
    pub(super) fn masks(&self, pattern: Array2<f32>, is_color: bool) -> Result<Moved, MaskError> {
        let size = pattern.dim();
        let offsets: Vec<[f64; 2]> = (0..self.frames).map(|t| self.step.map(|step| step * t as f64)).collect();
        // The smallest offset decides where the masks begin. One frame more, at a whole number of pixels, keeps them on the sensor's
        // pixels when that offset is a fraction.
        let multiple = if is_color { 2.0 } else { 1.0 };
        let least = [0, 1].map(|axis| offsets.iter().map(|o| o[axis]).fold(0.0, f64::min));
        let anchor = least.map(|v| (v / multiple).floor() * multiple);
        let moving = ShiftingMasks::new(pattern, &[&[anchor], offsets.as_slice()].concat())?;
        let mut masks = MaskStack::from_source(&moving)?.view().to_owned();
        masks.slice_axis_inplace(Axis(0), Slice::from(1..));
        Ok(Moved { masks, first: anchor.map(|v| -v as usize), pattern: size })
    }
}

impl Moved {
    /// Takes the part of `[.., H, W]` as large as the pattern that the masks are known for; others are left as they are.
    pub(super) fn crop<D: Dimension + RemoveAxis>(&self, data: &mut ArrayBase<OwnedRepr<f32>, D>) -> bool {
        let (rows, columns) = (Axis(data.ndim() - 2), Axis(data.ndim() - 1));
        let size = (data.len_of(rows), data.len_of(columns));
        let (_, height, width) = self.masks.dim();
        if size != self.pattern || size == (height, width) {
            return false;
        }
        let [row, column] = self.first;
        data.slice_axis_inplace(rows, Slice::from(row..row + height));
        data.slice_axis_inplace(columns, Slice::from(column..column + width));
        *data = data.as_standard_layout().into_owned();
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pattern() -> Array2<f32> {
        Array2::from_shape_fn((7, 9), |(y, x)| (10 * y + x) as f32)
    }

    /// What the pattern has at a place between its pixels; it is linear, so that interpolation is exact.
    fn at(y: f64, x: f64) -> f32 {
        (10.0 * y + x) as f32
    }

    #[test]
    fn frames_see_the_pattern_where_the_sensor_is() {
        for step in [[0.0, 1.0], [1.0, 0.0], [0.5, -0.75], [-1.25, 0.0], [-0.5, -0.5]] {
            for is_color in [false, true] {
                let moved = MaskShift { step, frames: 3 }.masks(pattern(), is_color).unwrap();
                let [row, column] = moved.first;
                assert!(!is_color || (row % 2, column % 2) == (0, 0));
                for ((t, y, x), &found) in moved.masks.indexed_iter() {
                    let offset = step.map(|s| s * t as f64);
                    let expected = at((y + row) as f64 + offset[0], (x + column) as f64 + offset[1]);
                    assert!((found - expected).abs() < 1e-4, "{step:?}, frame {t}, ({y}, {x}): {found} {expected}");
                }
            }
        }
    }

    #[test]
    fn measurements_of_the_whole_sensor_are_cut_to_where_the_masks_are_known() {
        let moved = MaskShift { step: [-1.25, 0.0], frames: 3 }.masks(pattern(), false).unwrap();
        let mut meas = pattern().insert_axis(Axis(0));
        assert!(moved.crop(&mut meas));
        assert_eq!(meas.shape()[1..], moved.masks.shape()[1..]);
        assert_eq!(meas[[0, 0, 0]], 30.0);
        let mut cut = meas.clone();
        assert!(!moved.crop(&mut cut), "what is cut already stays");
        assert_eq!(cut, meas);
    }

    #[test]
    fn a_pattern_too_small_for_its_way_is_an_error() {
        assert!(MaskShift { step: [4.0, 0.0], frames: 3 }.masks(pattern(), false).is_err());
    }
}
