//! Mask stacks: validated once, so that no operator or solver has to ask again.

use crate::operator::CLOSED;
use crate::{MaskSource, ShiftingMasks, VideoShape};
use ndarray::{Array2, Array3, ArrayView3, Dimension, IntoDimension};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Why something is not a set of masks.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MaskError {
    /// A dimension is zero.
    #[error(
        "masks of {frames}×{height}×{width} (frames × rows × columns) are empty: every dimension must be at least 1"
    )]
    Empty {
        /// T.
        frames: usize,
        /// H.
        height: usize,
        /// W.
        width: usize,
    },
    /// A value is NaN, or too large for the sums of its square.
    #[error(
        "mask value {value} at frame {frame}, row {row}, column {column}: it must be in -{LARGEST:e} to {LARGEST:e}"
    )]
    Value {
        /// The offending value.
        value: f32,
        /// Its frame.
        frame: usize,
        /// Its row.
        row: usize,
        /// Its column.
        column: usize,
    },
    /// No pixel of any mask is open by more than rounding errors.
    #[error("every mask is zero everywhere (or below 1e-15): nothing reaches the sensor")]
    AllClosed,
    /// A density outside `(0, 1]`.
    #[error("mask density {0} is outside (0, 1]")]
    Density(f64),
    /// Masks that are to be packed have more than one open value.
    #[error("a mask holds {value} beside {open}: binary masks hold 0 and one other value")]
    NotBinary {
        /// The value that does not belong.
        value: f32,
        /// The open value that came first.
        open: f32,
    },
    /// A moving pattern goes farther than it reaches, or by what is not a number.
    #[error("a pattern of {rows}×{columns} pixels cannot move by {offset:?} pixels (down, right)")]
    Offset {
        /// Its rows.
        rows: usize,
        /// Its columns.
        columns: usize,
        /// How far it is to move, down and to the right.
        offset: [f64; 2],
    },
    /// Something that each frame has one of has another number.
    #[error("{found} {what} for {expected} frames: each frame has one")]
    Count {
        /// What.
        what: &'static str,
        /// The frames.
        expected: usize,
        /// How many there are.
        found: usize,
    },
}

/// The largest value, in whatever unit: squares of measurements stay in the range of `f32`.
const LARGEST: f32 = 1e9;

/// `T` masks `C_t` `[T, H, W]`, binary or calibrated in any unit, at least one of them open: transmittances of 0 to 1e9, or, of a
/// differential camera, whose measurement is the difference of two, values of either sign down to -1e9.
#[derive(Debug, Clone, PartialEq)]
pub struct MaskStack {
    /// In row-major order.
    masks: Array3<f32>,
}

impl MaskStack {
    /// Checks and takes masks `[T, H, W]`.
    ///
    /// # Errors
    /// [`MaskError`] if a dimension is zero, a value is out of range, or every value is 0.
    ///
    /// ```
    /// use ndarray::array;
    /// assert!(sci_forward::MaskStack::new(array![[[0.0, 1.0], [0.25, 1.0]]]).is_ok());
    /// assert!(sci_forward::MaskStack::new(array![[[1.0, -1.0]]]).is_ok());
    /// assert!(sci_forward::MaskStack::new(array![[[0.0, f32::NAN]]]).is_err());
    /// ```
    pub fn new(masks: Array3<f32>) -> Result<Self, MaskError> {
        let masks = if masks.is_standard_layout() { masks } else { masks.as_standard_layout().into_owned() };
        validated(Self { masks })
    }

    /// The masks of any source, stored.
    ///
    /// # Errors
    /// [`MaskError`] as in [`MaskStack::new`].
    ///
    /// ```
    /// use sci_forward::{MaskStack, ShiftingMasks, VideoShape};
    /// let shape = VideoShape { frames: 4, height: 3, width: 5 };
    /// let masks = MaskStack::from_source(&ShiftingMasks::random(shape, 0.5, 1, [0.0, 1.0])?)?;
    /// assert_eq!(masks, MaskStack::shifting(shape, 0.5, 1)?);
    /// # Ok::<(), sci_forward::MaskError>(())
    /// ```
    pub fn from_source(source: &dyn MaskSource) -> Result<Self, MaskError> {
        Self::new(stored(source))
    }

    /// Independent binary masks, each pixel open with probability `density`.
    ///
    /// # Errors
    /// [`MaskError::Density`] outside `(0, 1]`; [`MaskError::Empty`] or, for tiny shapes and densities, [`MaskError::AllClosed`].
    ///
    /// ```
    /// use sci_forward::{MaskStack, VideoShape};
    /// let masks = MaskStack::random(VideoShape { frames: 8, height: 64, width: 64 }, 0.25, 0)?;
    /// assert!(masks.is_binary());
    /// assert!((masks.view().mean().unwrap() - 0.25).abs() < 0.01);
    /// # Ok::<(), sci_forward::MaskError>(())
    /// ```
    pub fn random(shape: VideoShape, density: f64, seed: u64) -> Result<Self, MaskError> {
        Self::new(bernoulli(shape.dim(), density, seed)?)
    }

    /// One random binary pattern `[H, W + T − 1]` that moves by a pixel a frame: `C_t = a[:, t..t + W]`,
    /// as a translating physical mask does (the masks of the gray benchmark were made so).
    ///
    /// Other steps, fractions of a pixel among them, are [`ShiftingMasks`].
    ///
    /// # Errors
    /// As [`MaskStack::random`].
    ///
    /// ```
    /// use ndarray::s;
    /// use sci_forward::{MaskStack, VideoShape};
    /// let masks = MaskStack::shifting(VideoShape { frames: 2, height: 4, width: 6 }, 0.5, 0)?;
    /// assert_eq!(masks.view().slice(s![0, .., 1..]), masks.view().slice(s![1, .., ..5]));
    /// # Ok::<(), sci_forward::MaskError>(())
    /// ```
    pub fn shifting(shape: VideoShape, density: f64, seed: u64) -> Result<Self, MaskError> {
        Self::from_source(&ShiftingMasks::random(shape, density, seed, [0.0, 1.0])?)
    }

    /// The masks of a differential camera, which measures the light of a mask of 0 to 1 less that of its complement: `2 C − 1`.
    ///
    /// ```
    /// use ndarray::array;
    /// let masks = sci_forward::MaskStack::new(array![[[0.0, 1.0, 0.5]]])?.differential()?;
    /// assert_eq!(masks.view(), array![[[-1.0, 1.0, 0.0]]]);
    /// # Ok::<(), sci_forward::MaskError>(())
    /// ```
    ///
    /// # Errors
    /// As [`MaskStack::new`]: masks of 0.5 everywhere measure nothing.
    pub fn differential(self) -> Result<Self, MaskError> {
        Self::new(self.masks.mapv_into(|c| 2.0 * c - 1.0))
    }

    /// The size of the video that these masks modulate.
    pub fn shape(&self) -> VideoShape {
        let (frames, height, width) = self.masks.dim();
        VideoShape { frames, height, width }
    }

    /// The masks `[T, H, W]`.
    pub fn view(&self) -> ArrayView3<'_, f32> {
        self.masks.view()
    }

    /// Whether every value is 0 or 1.
    ///
    /// ```
    /// use ndarray::array;
    /// use sci_forward::MaskStack;
    /// assert!(MaskStack::new(array![[[0.0, 1.0]]])?.is_binary());
    /// assert!(!MaskStack::new(array![[[0.0, 0.5]]])?.is_binary());
    /// # Ok::<(), sci_forward::MaskError>(())
    /// ```
    pub fn is_binary(&self) -> bool {
        self.masks.iter().all(|&v| v == 0.0 || v == 1.0)
    }

    /// Whether a value is below 0: the masks are those of a differential camera.
    ///
    /// ```
    /// use ndarray::array;
    /// use sci_forward::MaskStack;
    /// assert!(MaskStack::new(array![[[-1.0, 1.0]]])?.is_signed());
    /// assert!(!MaskStack::new(array![[[0.0, 0.5]]])?.is_signed());
    /// # Ok::<(), sci_forward::MaskError>(())
    /// ```
    pub fn is_signed(&self) -> bool {
        self.masks.iter().any(|&v| v < 0.0)
    }

    #[inline]
    fn row(&self, frame: usize, row: usize) -> &[f32] {
        let (frames, height, width) = self.masks.dim();
        assert!(frame < frames && row < height, "frame {frame}, row {row} of masks of {}", self.shape());
        let masks = self.masks.as_slice().expect("stored in row-major order");
        &masks[(frame * height + row) * width..][..width]
    }

    /// `Σ_t C_t` `[H, W]`: what a static white scene measures.
    ///
    /// ```
    /// use ndarray::array;
    /// let masks = sci_forward::MaskStack::new(array![[[0.0, 1.0]], [[0.5, 1.0]]])?;
    /// assert_eq!(masks.sum(), array![[0.5, 2.0]]);
    /// # Ok::<(), sci_forward::MaskError>(())
    /// ```
    pub fn sum(&self) -> Array2<f32> {
        self.masks.sum_axis(ndarray::Axis(0))
    }

    /// The most that a scene within `[0, 1]` measures, or minus the least: the largest sum of values of one sign at a pixel.
    ///
    /// ```
    /// use ndarray::array;
    /// let masks = sci_forward::MaskStack::new(array![[[-1.0, 0.5]], [[-1.0, 1.0]]])?;
    /// assert_eq!(masks.reach(), 2.0);
    /// # Ok::<(), sci_forward::MaskError>(())
    /// ```
    pub fn reach(&self) -> f32 {
        let (frames, height, width) = self.masks.dim();
        let mut sums = vec![[0f32; 2]; width];
        let mut most = 0f32;
        for row in 0..height {
            sums.fill([0.0; 2]);
            for frame in 0..frames {
                for (sum, &c) in sums.iter_mut().zip(self.row(frame, row)) {
                    *sum = [sum[0] + c.max(0.0), sum[1] + (-c).max(0.0)];
                }
            }
            most = sums.as_flattened().iter().copied().fold(most, f32::max);
        }
        most
    }
}

impl MaskSource for MaskStack {
    fn shape(&self) -> VideoShape {
        self.shape()
    }

    fn fill(&self, frame: usize, row: usize, start: usize, out: &mut [f32]) {
        out.copy_from_slice(&self.row(frame, row)[start..start + out.len()]);
    }

    fn stored(&self, frame: usize, row: usize) -> Option<&[f32]> {
        Some(self.row(frame, row))
    }
}

fn stored(source: &dyn MaskSource) -> Array3<f32> {
    let mut masks = Array3::zeros(source.shape().dim());
    for (t, mut mask) in masks.outer_iter_mut().enumerate() {
        for (row, mut values) in mask.outer_iter_mut().enumerate() {
            source.fill(t, row, 0, values.as_slice_mut().expect("a row of a new array"));
        }
    }
    masks
}

/// A source that has been checked: not empty, every value in range, at least one open.
pub(crate) fn validated<S: MaskSource>(source: S) -> Result<S, MaskError> {
    let (frames, height, width) = source.shape().dim();
    if frames * height * width == 0 {
        return Err(MaskError::Empty { frames, height, width });
    }
    let mut values = vec![0.0; width];
    let mut largest = 0f32;
    for (frame, row) in (0..frames).flat_map(|t| (0..height).map(move |row| (t, row))) {
        source.fill(frame, row, 0, &mut values);
        if let Some(column) = values.iter().position(|v| !(-LARGEST..=LARGEST).contains(v)) {
            return Err(MaskError::Value { value: values[column], frame, row, column });
        }
        largest = values.iter().fold(largest, |largest, &v| largest.max(v.abs()));
    }
    if largest * largest <= CLOSED { Err(MaskError::AllClosed) } else { Ok(source) }
}

/// Independent values, 1 with probability `density`, else 0.
pub(crate) fn bernoulli<I: IntoDimension>(
    shape: I,
    density: f64,
    seed: u64,
) -> Result<ndarray::Array<f32, I::Dim>, MaskError>
where
    I::Dim: Dimension,
{
    if !(density > 0.0 && density <= 1.0) {
        return Err(MaskError::Density(density));
    }
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let draw = || f32::from(u8::from(rng.random_bool(density)));
    Ok(ndarray::Array::from_shape_simple_fn(shape.into_dimension(), draw))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::s;

    const SHAPE: VideoShape = VideoShape { frames: 4, height: 31, width: 17 };

    #[test]
    fn random_masks_are_seeded_binary_and_of_the_asked_density() {
        let masks = MaskStack::random(SHAPE, 0.3, 5).unwrap();
        assert!(masks.is_binary());
        assert_eq!(masks, MaskStack::random(SHAPE, 0.3, 5).unwrap());
        assert_ne!(masks, MaskStack::random(SHAPE, 0.3, 6).unwrap());
        assert!((masks.view().mean().unwrap() - 0.3).abs() < 0.03);
    }

    #[test]
    fn shifting_masks_move_by_one_pixel_a_frame() {
        let masks = MaskStack::shifting(SHAPE, 0.5, 1).unwrap();
        for t in 0..3 {
            assert_eq!(masks.view().slice(s![t, .., 1..]), masks.view().slice(s![t + 1, .., ..16]));
        }
    }

    #[test]
    fn bad_masks_are_named() {
        let check = |masks: Array3<f32>, part: &str| {
            let message = MaskStack::new(masks).unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        };
        check(Array3::zeros((0, 2, 2)), "0×2×2");
        check(Array3::zeros((1, 2, 2)), "every mask is zero");
        let mut masks = Array3::ones((2, 3, 4));
        masks[[1, 2, 3]] = f32::NAN;
        check(masks, "NaN at frame 1, row 2, column 3");
        assert_eq!(MaskStack::random(SHAPE, 1.5, 0), Err(MaskError::Density(1.5)));
    }
}
