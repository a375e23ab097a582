//! Bilinear interpolation.

use super::rows::{PAD, Window};
use super::{CfaPattern, Color, Demosaicer, check_sizes};
use crate::BoxError;
use ndarray::parallel::prelude::*;
use ndarray::{ArrayView2, ArrayView3, ArrayViewMut3, ArrayViewMut4, Axis};

/// Each missing color is the mean of its two or four nearest samples.
///
/// ```
/// use ndarray::{Array4, array};
/// use sci_forward::{CfaPattern, Demosaicer, bayer::Bilinear};
///
/// // A red pixel among green and blue ones.
/// let mosaic = array![[[0.8, 0.2, 0.1, 0.3], [0.4, 0.5, 0.2, 0.1], [0.1, 0.2, 0.7, 0.2], [0.3, 0.3, 0.4, 0.1]]];
/// let mut rgb = Array4::zeros((1, 3, 4, 4));
/// Bilinear.demosaic(CfaPattern::Rggb, mosaic.view(), rgb.view_mut())?;
/// assert_eq!(rgb[[0, 0, 2, 2]], 0.7);
/// assert!((rgb[[0, 1, 2, 2]] - (0.2 + 0.2 + 0.2 + 0.4) / 4.0f32).abs() < 1e-6);
/// assert!((rgb[[0, 2, 2, 2]] - (0.5 + 0.1 + 0.3 + 0.1) / 4.0f32).abs() < 1e-6);
/// # Ok::<(), sci_forward::BoxError>(())
/// ```
#[derive(Debug, Clone, Copy, Default)]
pub struct Bilinear;

impl Demosaicer for Bilinear {
    fn name(&self) -> &str {
        "bilinear"
    }

    fn demosaic(
        &mut self,
        cfa: CfaPattern,
        mosaic: ArrayView3<'_, f32>,
        mut rgb: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        check_sizes(mosaic.dim(), rgb.dim())?;
        rgb.axis_iter_mut(Axis(0))
            .into_par_iter()
            .zip(mosaic.axis_iter(Axis(0)))
            .for_each(|(rgb, mosaic)| demosaic_frame(cfa, mosaic, rgb));
        Ok(())
    }
}

fn demosaic_frame(cfa: CfaPattern, mosaic: ArrayView2<'_, f32>, mut rgb: ArrayViewMut3<'_, f32>) {
    let (height, width) = mosaic.dim();
    let mut window = Window::around(mosaic, 0);
    for r in 0..height {
        if r > 0 {
            window.advance(mosaic, r);
        }
        let [_, up, here, down, _] = window.rows();
        for c in 0..width {
            let x = c + PAD;
            let sides = 0.5 * (here[x - 1] + here[x + 1]);
            let ends = 0.5 * (up[x] + down[x]);
            let corners = 0.25 * (up[x - 1] + up[x + 1] + down[x - 1] + down[x + 1]);
            let pixel = match cfa.color_at(r, c) {
                Color::Red => [here[x], 0.5 * (sides + ends), corners],
                Color::Blue => [corners, 0.5 * (sides + ends), here[x]],
                Color::Green if cfa.color_at(r, c + 1) == Color::Red => [sides, here[x], ends],
                Color::Green => [ends, here[x], sides],
            };
            for (channel, v) in pixel.into_iter().enumerate() {
                rgb[[channel, r, c]] = v;
            }
        }
    }
}
