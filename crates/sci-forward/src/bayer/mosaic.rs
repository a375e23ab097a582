//! The mosaic operator T: each pixel keeps the one color that its filter lets through.

use super::CfaPattern;
use super::rows::copy_every_other;
use ndarray::parallel::prelude::*;
use ndarray::{ArrayView3, ArrayView4, ArrayViewMut3, ArrayViewMut4, Axis, s};

/// `mosaic = T rgb`: writes `[T, H, W]` from an RGB video `[T, 3, H, W]` (paper, `T_M`).
///
/// # Panics
/// If the sizes do not belong together.
///
/// ```
/// use ndarray::{Array3, array};
/// use sci_forward::{CfaPattern, bayer::mosaic_into};
/// let rgb = array![[[[1.0, 1.0]], [[2.0, 2.0]], [[3.0, 3.0]]]];
/// let mut mosaic = Array3::zeros((1, 1, 2));
/// mosaic_into(CfaPattern::Rggb, rgb.view(), mosaic.view_mut());
/// assert_eq!(mosaic, array![[[1.0, 2.0]]]);
/// ```
pub fn mosaic_into(cfa: CfaPattern, rgb: ArrayView4<'_, f32>, mut mosaic: ArrayViewMut3<'_, f32>) {
    check(mosaic.dim(), rgb.dim());
    mosaic.axis_iter_mut(Axis(0)).into_par_iter().zip(rgb.axis_iter(Axis(0))).for_each(|(mut mosaic, rgb)| {
        for (r, mut row) in mosaic.outer_iter_mut().enumerate() {
            for first in [0, 1] {
                let channel = rgb.slice(s![cfa.color_at(r, first) as usize, r, ..]);
                copy_every_other(row.view_mut(), channel, first);
            }
        }
    });
}

/// `rgb = Tᵀ mosaic`: writes `[T, 3, H, W]`, each sample in its own channel and zeros elsewhere.
///
/// # Panics
/// If the sizes do not belong together.
///
/// ```
/// use ndarray::{Array4, array};
/// use sci_forward::{CfaPattern, bayer::mosaic_adjoint_into};
/// let mut rgb = Array4::zeros((1, 3, 1, 2));
/// mosaic_adjoint_into(CfaPattern::Rggb, array![[[1.0, 2.0]]].view(), rgb.view_mut());
/// assert_eq!(rgb, array![[[[1.0, 0.0]], [[0.0, 2.0]], [[0.0, 0.0]]]]);
/// ```
pub fn mosaic_adjoint_into(cfa: CfaPattern, mosaic: ArrayView3<'_, f32>, mut rgb: ArrayViewMut4<'_, f32>) {
    check(mosaic.dim(), rgb.dim());
    rgb.axis_iter_mut(Axis(0)).into_par_iter().zip(mosaic.axis_iter(Axis(0))).for_each(|(mut rgb, mosaic)| {
        for (r, row) in mosaic.outer_iter().enumerate() {
            rgb.slice_mut(s![.., r, ..]).fill(0.0);
            for first in [0, 1] {
                let channel = rgb.slice_mut(s![cfa.color_at(r, first) as usize, r, ..]);
                copy_every_other(channel, row, first);
            }
        }
    });
}

#[track_caller]
fn check((frames, height, width): (usize, usize, usize), rgb: (usize, usize, usize, usize)) {
    assert_eq!(rgb, (frames, 3, height, width), "the RGB video must have the mosaic's size");
}

/// The sub-lattice of sites `(row + 2i, column + 2j)` of a mosaic video `[T, H, W]`, as a view; `row` and `column` are 0 or 1.
/// All its pixels have one color.
///
/// ```
/// use ndarray::array;
/// use sci_forward::bayer::sub_lattice;
/// let mosaic = array![[[0.0, 0.1, 0.2], [1.0, 1.1, 1.2], [2.0, 2.1, 2.2]]];
/// assert_eq!(sub_lattice(mosaic.view(), 0, 1), array![[[0.1], [2.1]]]);
/// ```
pub fn sub_lattice(mosaic: ArrayView3<'_, f32>, row: usize, column: usize) -> ArrayView3<'_, f32> {
    mosaic.slice_move(s![.., row..;2, column..;2])
}

/// [`sub_lattice`] to write to.
pub fn sub_lattice_mut(mosaic: ArrayViewMut3<'_, f32>, row: usize, column: usize) -> ArrayViewMut3<'_, f32> {
    mosaic.slice_move(s![.., row..;2, column..;2])
}
