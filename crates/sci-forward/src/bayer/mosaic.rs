//! The mosaic operator T: each pixel keeps the one color that its filter lets through.

use super::CfaPattern;
use ndarray::parallel::prelude::*;
use ndarray::{ArrayView3, ArrayView4, ArrayViewMut3, ArrayViewMut4, Axis, s};

/// `mosaic = T rgb`: writes `[T, H, W]` from an RGB video `[T, 3, H, W]` (paper, `T_M`).
///
/// # Panics
/// If the sizes do not belong together.
pub fn mosaic_into(cfa: CfaPattern, rgb: ArrayView4<'_, f32>, mut mosaic: ArrayViewMut3<'_, f32>) {
    let (frames, height, width) = mosaic.dim();
    assert_eq!(rgb.dim(), (frames, 3, height, width), "the RGB video must have the mosaic's size");
    mosaic.axis_iter_mut(Axis(0)).into_par_iter().zip(rgb.axis_iter(Axis(0))).for_each(|(mut mosaic, rgb)| {
        for (r, mut row) in mosaic.outer_iter_mut().enumerate() {
            let channels = [0, 1].map(|c| rgb.slice(s![cfa.color_at(r, c) as usize, r, ..]));
            for (c, v) in row.iter_mut().enumerate() {
                *v = channels[c & 1][c];
            }
        }
    });
}

/// `rgb = Tᵀ mosaic`: writes `[T, 3, H, W]`, each sample in its own channel and zeros elsewhere.
///
/// # Panics
/// If the sizes do not belong together.
pub fn mosaic_adjoint_into(cfa: CfaPattern, mosaic: ArrayView3<'_, f32>, mut rgb: ArrayViewMut4<'_, f32>) {
    let (frames, height, width) = mosaic.dim();
    assert_eq!(rgb.dim(), (frames, 3, height, width), "the RGB video must have the mosaic's size");
    rgb.axis_iter_mut(Axis(0)).into_par_iter().zip(mosaic.axis_iter(Axis(0))).for_each(|(mut rgb, mosaic)| {
        for (channel, mut plane) in rgb.outer_iter_mut().enumerate() {
            for ((r, c), v) in plane.indexed_iter_mut() {
                *v = if cfa.color_at(r, c) as usize == channel { mosaic[[r, c]] } else { 0.0 };
            }
        }
    });
}

/// The sub-lattice of sites `(row + 2i, column + 2j)` of a mosaic video `[T, H, W]`, as a view; `row` and `column` are 0 or 1.
/// All its pixels have one color.
pub fn sub_lattice(mosaic: ArrayView3<'_, f32>, row: usize, column: usize) -> ArrayView3<'_, f32> {
    mosaic.slice_move(s![.., row..;2, column..;2])
}

/// [`sub_lattice`] to write to.
pub fn sub_lattice_mut(mosaic: ArrayViewMut3<'_, f32>, row: usize, column: usize) -> ArrayViewMut3<'_, f32> {
    mosaic.slice_move(s![.., row..;2, column..;2])
}
