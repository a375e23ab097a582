//! Mask stacks: validated once, so that no operator or solver has to ask again.

use crate::VideoShape;
use crate::operator::CLOSED;
use ndarray::{Array2, Array3, ArrayView3, s};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Why an array is not a stack of masks.
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
    /// A transmittance is negative, NaN, or too large for the sums of its square.
    #[error(
        "mask value {value} at frame {frame}, row {row}, column {column}: a transmittance must be in 0 to {MAX_TRANSMITTANCE:e}"
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
}

/// The largest transmittance, in whatever unit: squares of measurements stay in the range of `f32`.
const MAX_TRANSMITTANCE: f32 = 1e9;

/// `T` masks `C_t` `[T, H, W]`: transmittances from 0 to 1e9, binary or calibrated in any unit, at least one of them open.
#[derive(Debug, Clone, PartialEq)]
pub struct MaskStack {
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
    /// assert!(sci_forward::MaskStack::new(array![[[0.0, -1.0]]]).is_err());
    /// ```
    pub fn new(masks: Array3<f32>) -> Result<Self, MaskError> {
        let (frames, height, width) = masks.dim();
        if frames * height * width == 0 {
            return Err(MaskError::Empty { frames, height, width });
        }
        if let Some(((frame, row, column), &value)) =
            masks.indexed_iter().find(|(_, v)| !(0.0..=MAX_TRANSMITTANCE).contains(*v))
        {
            return Err(MaskError::Value { value, frame, row, column });
        }
        if masks.iter().all(|&v| v * v <= CLOSED) {
            return Err(MaskError::AllClosed);
        }
        let masks = if masks.is_standard_layout() { masks } else { masks.as_standard_layout().into_owned() };
        Ok(Self { masks })
    }

    /// Independent binary masks, each pixel open with probability `density`.
    ///
    /// # Errors
    /// [`MaskError::Density`] outside `(0, 1]`; [`MaskError::Empty`] or, for tiny shapes and densities, [`MaskError::AllClosed`].
    pub fn random(shape: VideoShape, density: f64, seed: u64) -> Result<Self, MaskError> {
        Self::new(bernoulli(shape.dim(), density, seed)?)
    }

    /// One random binary pattern `[H, W + T − 1]` that moves by a pixel a frame: `C_t = a[:, t..t + W]`,
    /// as a translating physical mask does (the masks of the gray benchmark were made so).
    ///
    /// # Errors
    /// As [`MaskStack::random`].
    pub fn shifting(shape: VideoShape, density: f64, seed: u64) -> Result<Self, MaskError> {
        let (frames, height, width) = shape.dim();
        if frames * height * width == 0 {
            return Err(MaskError::Empty { frames, height, width });
        }
        let pattern = bernoulli((1, height, width + frames - 1), density, seed)?;
        let mut masks = Array3::zeros(shape.dim());
        for (t, mut mask) in masks.outer_iter_mut().enumerate() {
            mask.assign(&pattern.slice(s![0, .., t..t + width]));
        }
        Self::new(masks)
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

    /// Whether every transmittance is 0 or 1.
    pub fn is_binary(&self) -> bool {
        self.masks.iter().all(|&v| v == 0.0 || v == 1.0)
    }

    /// `Σ_t C_t` `[H, W]`: what a static white scene measures.
    pub fn sum(&self) -> Array2<f32> {
        self.masks.sum_axis(ndarray::Axis(0))
    }

    /// The masks with every transmittance of the pixels where `measured` `[H, W]` is false set to 0.
    ///
    /// To the operator such a pixel is one that no mask opens: it takes no part in the data step. Dead pixels
    /// and pixels held out for validation are handled this way. What the measurement holds there counts as residual, so it is
    /// best set to 0.
    ///
    /// # Errors
    /// [`MaskError::AllClosed`] if nothing stays open.
    ///
    /// # Panics
    /// If `measured` is not `[H, W]`.
    pub fn restricted_to(mut self, measured: ndarray::ArrayView2<'_, bool>) -> Result<Self, MaskError> {
        assert_eq!(measured.dim(), self.shape().image_dim(), "one flag per sensor pixel");
        for mut mask in self.masks.outer_iter_mut() {
            mask.zip_mut_with(&measured, |c, &keep| *c = if keep { *c } else { 0.0 });
        }
        Self::new(self.masks)
    }
}

/// Which pixels of a sensor `[H, W]` stay in use when one in each `spacing` × `spacing` block, drawn with `seed`, is held
/// out for validation: true for those that stay. With a spacing of 1 none would stay: it must be at least 2.
///
/// # Panics
/// If `spacing` is less than 2.
pub fn held_in(image: (usize, usize), spacing: usize, seed: u64) -> Array2<bool> {
    assert!(spacing >= 2, "a spacing of {spacing} leaves no pixel: it must be at least 2");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut stays = Array2::from_elem(image, true);
    for mut block in stays.exact_chunks_mut((spacing, spacing)) {
        block[[rng.random_range(0..spacing), rng.random_range(0..spacing)]] = false;
    }
    stays
}

fn bernoulli(dim: (usize, usize, usize), density: f64, seed: u64) -> Result<Array3<f32>, MaskError> {
    if !(density > 0.0 && density <= 1.0) {
        return Err(MaskError::Density(density));
    }
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    Ok(Array3::from_shape_simple_fn(dim, || f32::from(u8::from(rng.random_bool(density)))))
}

#[cfg(test)]
mod tests {
    use super::*;

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

    #[test]
    fn one_pixel_of_each_block_is_held_out() {
        let stays = held_in((31, 17), 5, 3);
        assert_eq!(stays.iter().filter(|stays| !**stays).count(), 6 * 3);
        assert!(stays.exact_chunks((5, 5)).into_iter().all(|block| block.iter().filter(|stays| !**stays).count() == 1));
        assert_eq!(stays, held_in((31, 17), 5, 3));
        assert_ne!(stays, held_in((31, 17), 5, 4));
    }

    #[test]
    fn a_restricted_stack_closes_the_unmeasured_pixels() {
        let mut measured = Array2::from_elem((31, 17), true);
        measured[[3, 4]] = false;
        let sum = MaskStack::new(Array3::ones(SHAPE.dim())).unwrap().restricted_to(measured.view()).unwrap().sum();
        assert_eq!((sum[[3, 4]], sum[[3, 5]]), (0.0, 4.0));
    }
}
