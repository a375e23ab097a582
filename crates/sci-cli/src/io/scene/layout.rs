//! Owns the step from an array as stored to frames in the program's layout and unit.

use ndarray::{Array3, Array4, ArrayView, ArrayView3, ArrayView4, ArrayViewD, Axis, Dimension, Ix3, Ix4, IxDyn, Zip};

use super::{Axes, SceneError};
use crate::io::Format;
use crate::io::samples::{Array, Samples};

/// Which array of which file, for messages, and how it is stored.
#[derive(Clone, Copy)]
pub(super) struct Place<'a> {
    pub(super) file: &'a str,
    pub(super) key: &'a str,
    pub(super) format: Format,
    /// The order of axes, unless by the format.
    pub(super) axes: Option<Axes>,
}

/// Which axes of an array in its file are which.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct FileAxes {
    /// None of a single frame.
    pub(super) frame: Option<usize>,
    pub(super) row: usize,
    pub(super) column: usize,
}

impl Place<'_> {
    /// Pictures have the one order that their reader gives them.
    pub(super) fn is_picture(&self) -> bool {
        !matches!(self.format, Format::Mat | Format::Hdf5 | Format::Npz | Format::Npy)
    }

    fn axes(&self) -> Axes {
        let usual = if self.format == Format::Mat { Axes::Hwt } else { Axes::Thw };
        if self.is_picture() { usual } else { self.axes.unwrap_or(usual) }
    }

    /// Which axes of an array in its file are which, one of `channels` among four; nothing if its shape is not one of the plain ones.
    pub(super) fn file_axes(&self, shape: &[usize], channels: usize) -> Option<FileAxes> {
        let reversed = self.format == Format::Mat;
        let mut meant = shape.to_vec();
        if reversed {
            meant.reverse();
        }
        let (frame, row, column) = match (self.axes(), meant.as_slice()) {
            (_, [_, _]) => (None, 0, 1),
            (Axes::Thw, [_, _, _]) => (Some(0), 1, 2),
            (Axes::Hwt, [_, _, _]) => (Some(2), 0, 1),
            (Axes::Hwt, [_, _, c, _]) if *c == channels => (Some(3), 0, 1),
            (Axes::Thw, [_, c, _, _]) if *c == channels => (Some(0), 2, 3),
            (Axes::Thw, [_, _, _, c]) if *c == channels => (Some(0), 1, 2),
            _ => return None,
        };
        let in_file = |axis: usize| if reversed { shape.len() - 1 - axis } else { axis };
        Some(FileAxes { frame: frame.map(in_file), row: in_file(row), column: in_file(column) })
    }

    fn wrong(&self, shape: &[usize], expected: &'static str) -> SceneError {
        SceneError::Axes { file: self.file.into(), key: self.key.into(), shape: shape.to_vec(), expected }
    }

    /// Samples in the order of axes that the file means.
    fn laid_out<'v, T>(&self, shape: &[usize], samples: &'v [T]) -> ArrayViewD<'v, T> {
        let data = ArrayViewD::from_shape(IxDyn(shape), samples).expect("an Array's shape holds exactly its samples");
        if self.format == Format::Mat { data.reversed_axes() } else { data }
    }

    /// Leaves out axes of length 1, the outermost first, until `most` are left or all others are longer.
    fn squeezed<'v, T>(&self, mut data: ArrayViewD<'v, T>, most: usize) -> ArrayViewD<'v, T> {
        while data.ndim() > most {
            let mut ones = (0..data.ndim()).filter(|&axis| data.len_of(Axis(axis)) == 1);
            // A last axis of one channel goes before a first one of one frame.
            let channel = Some(data.ndim() - 1).filter(|&last| data.ndim() == 4 && data.len_of(Axis(last)) == 1);
            let outermost = if self.axes() == Axes::Thw { channel.or_else(|| ones.next()) } else { ones.next_back() };
            match outermost {
                Some(axis) => data = data.index_axis_move(Axis(axis), 0),
                None => break,
            }
        }
        data
    }

    fn three<'v, T>(&self, data: ArrayViewD<'v, T>) -> Result<ArrayView3<'v, T>, SceneError> {
        const EXPECTED: &str = "two axes (one frame) or three, none of length 0, and any number of length 1";
        let shape = data.shape().to_vec();
        let data = self.squeezed(data, 3);
        if data.is_empty() {
            return Err(self.wrong(&shape, EXPECTED));
        }
        let data = match (data.ndim(), self.axes()) {
            (2, _) => data.insert_axis(Axis(0)),
            (3, Axes::Thw) => data,
            (3, Axes::Hwt) => data.permuted_axes(IxDyn(&[2, 0, 1])),
            _ => return Err(self.wrong(&shape, EXPECTED)),
        };
        data.into_dimensionality::<Ix3>().map_err(|_| self.wrong(&shape, EXPECTED))
    }

    fn four<'v, T>(&self, data: ArrayViewD<'v, T>) -> Result<ArrayView4<'v, T>, SceneError> {
        let shape = data.shape().to_vec();
        let data = self.squeezed(data, 4);
        let order = match (self.axes(), data.shape()) {
            _ if data.is_empty() => None,
            (Axes::Hwt, [_, _, 1 | 3, _]) => Some([3, 2, 0, 1]),
            (Axes::Thw, [_, 1 | 3, _, _]) => Some([0, 1, 2, 3]),
            (Axes::Thw, [_, _, _, 1 | 3]) => Some([0, 3, 1, 2]),
            _ => None,
        };
        let Some(order) = order else {
            return match data.ndim() {
                0..=3 => Ok(self.three(data)?.insert_axis(Axis(1))),
                _ => self.three(data).map(|frames| frames.insert_axis(Axis(1))).map_err(|_| {
                    self.wrong(
                        &shape,
                        "[T, H, W], [T, 1, H, W], [T, 3, H, W] or [T, H, W, 3] (in .mat [H, W, 3, T]), none of length 0",
                    )
                }),
            };
        };
        let data = data.permuted_axes(IxDyn(&order)).into_dimensionality::<Ix4>();
        data.map_err(|_| self.wrong(&shape, "four axes"))
    }

    /// Gray frames `[T, H, W]`; pictures may be color if all channels are equal.
    pub(super) fn frames(&self, array: &Array, white: f32) -> Result<Array3<f32>, SceneError> {
        let shape = array.shape();
        if !self.is_picture() || shape.len() != 4 {
            return Ok(match array.samples() {
                Samples::Bytes(v) => in_units_of(white, self.three(self.laid_out(shape, v))?),
                Samples::Floats(v) => in_units_of(white, self.three(self.laid_out(shape, v))?),
            });
        }
        let pictures = self.channels(array, white)?;
        let first = pictures.index_axis(Axis(1), 0);
        if pictures.axis_iter(Axis(1)).any(|channel| channel != first) {
            return Err(SceneError::Color { file: self.file.into(), key: self.key.into() });
        }
        Ok(first.to_owned())
    }

    /// A video `[T, C, H, W]`, C = 1 or 3.
    pub(super) fn channels(&self, array: &Array, white: f32) -> Result<Array4<f32>, SceneError> {
        let shape = array.shape();
        Ok(match array.samples() {
            Samples::Bytes(v) => in_units_of(white, self.four(self.laid_out(shape, v))?),
            Samples::Floats(v) => in_units_of(white, self.four(self.laid_out(shape, v))?),
        })
    }
}

/// Samples divided by white, written once, in the order that they stand in.
fn in_units_of<T, D>(white: f32, samples: ArrayView<'_, T, D>) -> ndarray::Array<f32, D>
where
    T: Copy + Into<f32> + Sync,
    D: Dimension,
{
    let mut values = ndarray::Array::zeros(samples.raw_dim());
    Zip::from(&mut values).and(samples).par_for_each(|to, &v| *to = v.into() / white);
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::samples::SampleType;

    fn frames(shape: &[usize], format: Format, axes: Option<Axes>) -> Result<Vec<usize>, String> {
        let count = shape.iter().product();
        let array = Array::new(shape.to_vec(), Samples::Bytes(vec![0; count]), SampleType::U8).unwrap();
        let place = Place { file: "f", key: "mask", format, axes };
        place.frames(&array, 1.0).map(|f| f.shape().to_vec()).map_err(|e| e.to_string())
    }

    #[test]
    fn axes_of_length_one_are_left_out() {
        for shape in [&[8, 5, 6][..], &[1, 8, 5, 6], &[8, 1, 5, 6], &[8, 5, 6, 1], &[1, 1, 8, 5, 6, 1]] {
            assert_eq!(frames(shape, Format::Npy, None).unwrap(), [8, 5, 6], "{shape:?}");
        }
        // In MATLAB these are H×W×T×1, H×W×1×T, H×W×1×1 and H×W.
        for (shape, expected) in [
            (&[1, 8, 6, 5][..], [8, 5, 6]),
            (&[8, 1, 6, 5], [8, 5, 6]),
            (&[1, 1, 6, 5], [1, 5, 6]),
            (&[6, 5], [1, 5, 6]),
        ] {
            assert_eq!(frames(shape, Format::Mat, None).unwrap(), expected, "{shape:?}");
        }
        assert_eq!(frames(&[1, 6, 5, 8], Format::Mat, Some(Axes::Thw)).unwrap(), [8, 5, 6]);
        assert!(frames(&[2, 8, 5, 6], Format::Npy, None).unwrap_err().contains("[2, 8, 5, 6]"));
        assert!(frames(&[8, 0, 6], Format::Npy, None).is_err());
    }

    #[test]
    fn videos_have_channels_wherever_they_are_stored() {
        let video = |shape: &[usize], format| {
            let count = shape.iter().product();
            let array = Array::new(shape.to_vec(), Samples::Bytes(vec![0; count]), SampleType::U8).unwrap();
            Place { file: "f", key: "orig", format, axes: None }.channels(&array, 1.0).map(|v| v.shape().to_vec())
        };
        for (shape, format, expected) in [
            (&[8, 5, 6][..], Format::Npy, [8, 1, 5, 6]),
            (&[8, 5, 6, 3], Format::Npy, [8, 3, 5, 6]),
            (&[1, 8, 3, 5, 6], Format::Npy, [8, 3, 5, 6]),
            (&[1, 8, 5, 6], Format::Npy, [8, 1, 5, 6]),
            (&[8, 3, 6, 5], Format::Mat, [8, 3, 5, 6]),
            (&[1, 8, 6, 5], Format::Mat, [8, 1, 5, 6]),
        ] {
            assert_eq!(video(shape, format).unwrap(), expected, "{shape:?}");
        }
        assert!(video(&[2, 8, 5, 6], Format::Npy).is_err());
    }

    #[test]
    fn gray_pictures_saved_in_color_are_gray() {
        let place = Place { file: "f", key: "meas", format: Format::Png, axes: None };
        let array = |v: [u8; 3]| Array::new(vec![1, 3, 1, 1], Samples::Bytes(v.to_vec()), SampleType::U8).unwrap();
        assert_eq!(place.frames(&array([51; 3]), 255.0).unwrap()[[0, 0, 0]], 0.2);
        assert!(place.frames(&array([1, 2, 3]), 255.0).unwrap_err().to_string().contains("color"));
    }
}
