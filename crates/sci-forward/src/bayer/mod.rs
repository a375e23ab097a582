//! Bayer sensors: which color a pixel sees, the mosaic operator T and its adjoint, the four sub-lattices, and demosaicing.
//!
//! | Demosaicer | Method | Border |
//! |---|---|---|
//! | [`Bilinear`] | mean of the 2 or 4 nearest samples | mirrored, the edge not repeated |
//! | [`Malvar`] | gradient-corrected linear 5×5 filters | mirrored, the edge not repeated |
//! | [`Menon`] | directional filtering, a posteriori decision, refinement | mirrored, the edge not repeated |
//!
//! Mirroring without repeating the edge keeps the color of every site: a red row is mirrored into red rows.

mod bilinear;
mod malvar;
mod menon;
mod mosaic;
mod pattern;
mod rows;

pub use bilinear::Bilinear;
pub use malvar::Malvar;
pub use menon::Menon;
pub use mosaic::{mosaic_adjoint_into, mosaic_into, sub_lattice, sub_lattice_mut};
pub use pattern::{CfaPattern, Color};
pub use rows::mirror;

use crate::BoxError;
use ndarray::{ArrayView3, ArrayViewMut4};

/// Fills in the two colors that each pixel of a mosaic video did not see.
pub trait Demosaicer: Send {
    /// What errors and records call it.
    fn name(&self) -> &str;

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

impl<M: Demosaicer + ?Sized> Demosaicer for &mut M {
    fn name(&self) -> &str {
        (**self).name()
    }

    fn demosaic(
        &mut self,
        cfa: CfaPattern,
        mosaic: ArrayView3<'_, f32>,
        rgb: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        (**self).demosaic(cfa, mosaic, rgb)
    }
}

impl<M: Demosaicer + ?Sized> Demosaicer for Box<M> {
    fn name(&self) -> &str {
        (**self).name()
    }

    fn demosaic(
        &mut self,
        cfa: CfaPattern,
        mosaic: ArrayView3<'_, f32>,
        rgb: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        (**self).demosaic(cfa, mosaic, rgb)
    }
}

/// A mosaic that is too small to have every color.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a mosaic of {height}×{width} pixels cannot be demosaicked: at least 2×2 are needed")]
pub struct MosaicTooSmall {
    /// H.
    pub height: usize,
    /// W.
    pub width: usize,
}

/// Checks the sizes of a demosaicing call.
///
/// # Panics
/// If `rgb` is not the mosaic's `[T, 3, H, W]`.
#[track_caller]
fn check_sizes(mosaic: (usize, usize, usize), rgb: (usize, usize, usize, usize)) -> Result<(), MosaicTooSmall> {
    let (frames, height, width) = mosaic;
    assert_eq!(rgb, (frames, 3, height, width), "the RGB video must have the mosaic's size");
    if height < 2 || width < 2 { Err(MosaicTooSmall { height, width }) } else { Ok(()) }
}
