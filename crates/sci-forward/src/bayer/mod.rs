//! Bayer color filter arrays: which color a sensor pixel sees, and the seam that demosaicers implement.

use crate::BoxError;
use ndarray::{ArrayView3, ArrayViewMut4};

/// The color filter array of the sensor, named by its top-left 2×2 block in reading order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum CfaPattern {
    /// Red top left, blue bottom right.
    #[default]
    Rggb,
    /// Blue top left, red bottom right.
    Bggr,
    /// Red top right, blue bottom left.
    Grbg,
    /// Red bottom left, blue top right.
    Gbrg,
}

impl CfaPattern {
    /// The color seen by the pixel at `(row, column)`: 0 red, 1 green, 2 blue.
    ///
    /// ```
    /// use sci_forward::CfaPattern;
    /// assert_eq!([(0, 0), (0, 1), (1, 0), (3, 1)].map(|(r, c)| CfaPattern::Rggb.color_at(r, c)), [0, 1, 1, 2]);
    /// ```
    pub fn color_at(self, row: usize, column: usize) -> usize {
        let (red_row, red_column) = match self {
            Self::Rggb => (0, 0),
            Self::Bggr => (1, 1),
            Self::Grbg => (0, 1),
            Self::Gbrg => (1, 0),
        };
        // 0 on the red site, 1 on either green, 2 on blue.
        ((row ^ red_row) & 1) + ((column ^ red_column) & 1)
    }
}

/// Fills in the two colors that each pixel of a mosaic video did not see.
pub trait Demosaicer {
    /// Writes the RGB video `[T, 3, H, W]` of a `mosaic` `[T, H, W]` taken through `cfa`.
    ///
    /// # Errors
    /// What the implementation reports, for example a mosaic size or pattern that it cannot take.
    fn demosaic(
        &mut self,
        cfa: CfaPattern,
        mosaic: ArrayView3<'_, f32>,
        rgb: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError>;
}
