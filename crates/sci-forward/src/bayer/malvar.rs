//! Gradient-corrected linear interpolation.

use super::rows::{PAD, Window, copy_every_other, mirror};
use super::{CfaPattern, Color, Demosaicer, check_sizes};
use crate::BoxError;
use multiversion::multiversion;
use ndarray::parallel::prelude::*;
use ndarray::{ArrayView2, ArrayView3, ArrayView4, ArrayViewMut3, ArrayViewMut4, Axis, s};

/// Rows of one parallel task.
const BAND: usize = 32;

/// Linear demosaicing with 5×5 filters that correct the bilinear estimate by the gradient of the color that was seen.
///
/// With `m` the sample, `h1`, `v1` the sums of the two neighbours at distance 1 along the row and the column, `h2`, `v2` those
/// at distance 2, and `d` the sum of the four diagonal neighbours, all divided by 8:
///
/// ```text
/// green at red or blue               4 m + 2 (h1 + v1) − (h2 + v2)
/// red at green in a red row          5 m + 4 h1 − d − h2 + ½ v2        (blue at green in a blue row)
/// red at green in a blue row         5 m + 4 v1 − d − v2 + ½ h2        (blue at green in a red row)
/// red at blue, blue at red           6 m + 2 d − 3/2 (h2 + v2)
/// ```
///
/// ```
/// use ndarray::{Array3, Array4};
/// use sci_forward::{CfaPattern, Demosaicer, bayer::Malvar};
///
/// // One bright red sample: green there rises by half of it.
/// let mut mosaic = Array3::zeros((1, 8, 8));
/// mosaic[[0, 4, 4]] = 1.0;
/// let mut rgb = Array4::zeros((1, 3, 8, 8));
/// Malvar.demosaic(CfaPattern::Rggb, mosaic.view(), rgb.view_mut())?;
/// assert_eq!([0, 1, 2].map(|channel| rgb[[0, channel, 4, 4]]), [1.0, 0.5, 0.75]);
/// # Ok::<(), sci_forward::BoxError>(())
/// ```
///
/// # References
/// Malvar, He, Cutler, *High-quality linear interpolation for demosaicing of Bayer-patterned color images*, 2004.
#[derive(Debug, Clone, Copy, Default)]
pub struct Malvar;

impl Demosaicer for Malvar {
    fn name(&self) -> &str {
        "malvar"
    }

    fn demosaic(
        &mut self,
        cfa: CfaPattern,
        mosaic: ArrayView3<'_, f32>,
        mut rgb: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        check_sizes(mosaic.dim(), rgb.dim())?;
        rgb.axis_iter_mut(Axis(0)).into_par_iter().zip(mosaic.axis_iter(Axis(0))).for_each(|(mut rgb, mosaic)| {
            rgb.axis_chunks_iter_mut(Axis(1), BAND)
                .into_par_iter()
                .enumerate()
                .for_each(|(band, rgb)| demosaic_band(cfa, mosaic, band * BAND, rgb));
        });
        Ok(())
    }
}

impl Malvar {
    /// `mosaic = Mᵀ rgb`, M the demosaicing: what a function of a demosaicked video `[T, 3, H, W]` changes by with each sample
    /// `[T, H, W]`, from its gradient by the video.
    ///
    /// # Errors
    /// As [`Demosaicer::demosaic`].
    ///
    /// ```
    /// use ndarray::{Array3, Array4};
    /// use sci_forward::{CfaPattern, bayer::Malvar};
    /// let mut samples = Array3::zeros((1, 4, 4));
    /// Malvar.adjoint(CfaPattern::Rggb, Array4::ones((1, 3, 4, 4)).view(), samples.view_mut())?;
    /// // Every filter's weights sum to 1.
    /// assert_eq!(samples.sum(), 48.0);
    /// # Ok::<(), sci_forward::BoxError>(())
    /// ```
    pub fn adjoint(
        self,
        cfa: CfaPattern,
        rgb: ArrayView4<'_, f32>,
        mut mosaic: ArrayViewMut3<'_, f32>,
    ) -> Result<(), BoxError> {
        check_sizes(mosaic.dim(), rgb.dim())?;
        let (_, height, width) = mosaic.dim();
        mosaic.fill(0.0);
        mosaic.axis_iter_mut(Axis(0)).into_par_iter().zip(rgb.axis_iter(Axis(0))).for_each(|(mut mosaic, rgb)| {
            for (channel, r, c) in
                (0..3).flat_map(|k| (0..height).flat_map(move |r| (0..width).map(move |c| (k, r, c))))
            {
                let value = 0.125 * rgb[[channel, r, c]];
                for (weight, sites) in filter(cfa, channel, r, c).into_iter().zip(SITES) {
                    for &[down, right] in sites {
                        let at = |i: usize, by: isize, n: usize| mirror(i as isize + by, n);
                        mosaic[[at(r, down, height), at(c, right, width)]] += weight * value;
                    }
                }
            }
        });
        Ok(())
    }
}

/// The samples that the weights of [`filter`] belong to: m, h1, v1, d, h2, v2.
const SITES: [&[[isize; 2]]; 6] = [
    &[[0, 0]],
    &[[0, -1], [0, 1]],
    &[[-1, 0], [1, 0]],
    &[[-1, -1], [-1, 1], [1, -1], [1, 1]],
    &[[0, -2], [0, 2]],
    &[[-2, 0], [2, 0]],
];

/// Eight times the weights of the samples in one color of a pixel.
fn filter(cfa: CfaPattern, channel: usize, r: usize, c: usize) -> [f32; 6] {
    match (cfa.color_at(r, c), channel) {
        (color, channel) if color as usize == channel => [8.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        (Color::Green, channel) if cfa.color_at(r, c + 1) as usize == channel => [5.0, 4.0, 0.0, -1.0, -1.0, 0.5],
        (Color::Green, _) => [5.0, 0.0, 4.0, -1.0, 0.5, -1.0],
        (_, channel) if channel == Color::Green as usize => [4.0, 2.0, 2.0, 0.0, -1.0, -1.0],
        _ => [6.0, 0.0, 0.0, 2.0, -1.5, -1.5],
    }
}

/// Rows `first..` of a frame, `rgb` being `[3, rows, W]`.
fn demosaic_band(cfa: CfaPattern, mosaic: ArrayView2<'_, f32>, first: usize, mut rgb: ArrayViewMut3<'_, f32>) {
    let width = mosaic.ncols();
    let mut window = Window::around(mosaic, first);
    let mut filtered = [const { Vec::new() }; 4].map(|_: Vec<f32>| vec![0.0; width]);
    for r in 0..rgb.dim().1 {
        if r > 0 {
            window.advance(mosaic, first + r);
        }
        filter_row(window.rows(), &mut filtered);
        let sample = &window.rows()[PAD][PAD..PAD + width];
        let [green, along, across, opposite] = &filtered;
        // What a site does not see: at a colored site green and the opposite color; at a green one the color of its row along
        // the row, the other one across.
        for (column, color) in [0, 1].map(|c| (c, cfa.color_at(first + r, c))) {
            let row_color = if color == Color::Green { cfa.color_at(first + r, column + 1) } else { color };
            let other = if row_color == Color::Red { Color::Blue } else { Color::Red };
            let sources = match color {
                Color::Green => [(Color::Green, sample), (row_color, &along[..]), (other, &across[..])],
                _ => [(color, sample), (Color::Green, &green[..]), (other, &opposite[..])],
            };
            for (channel, source) in sources {
                copy_every_other(rgb.slice_mut(s![channel as usize, r, ..]), source.into(), column);
            }
        }
    }
}

/// The four filters `[green, along the row, across it, opposite]` at every pixel of the middle row.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn filter_row(rows: [&[f32]; 5], filtered: &mut [Vec<f32>; 4]) {
    let [up2, up1, here, down1, down2] = rows;
    let width = here.len() - 2 * PAD;
    let [green, along, across, opposite] = filtered;
    let (green, along) = (&mut green[..width], &mut along[..width]);
    let (across, opposite) = (&mut across[..width], &mut opposite[..width]);
    let (left2, left1, m) = (&here[..width], &here[1..][..width], &here[2..][..width]);
    let (right1, right2) = (&here[3..][..width], &here[4..][..width]);
    let (up_left, up, up_right) = (&up1[1..][..width], &up1[2..][..width], &up1[3..][..width]);
    let (down_left, down, down_right) = (&down1[1..][..width], &down1[2..][..width], &down1[3..][..width]);
    let (up2, down2) = (&up2[2..][..width], &down2[2..][..width]);
    for x in 0..width {
        let (h1, v1, h2, v2) = (left1[x] + right1[x], up[x] + down[x], left2[x] + right2[x], up2[x] + down2[x]);
        let d = (up_left[x] + up_right[x]) + (down_left[x] + down_right[x]);
        green[x] = 0.125 * (4.0 * m[x] + 2.0 * (h1 + v1) - (h2 + v2));
        along[x] = 0.125 * (5.0 * m[x] + 4.0 * h1 - d - h2 + 0.5 * v2);
        across[x] = 0.125 * (5.0 * m[x] + 4.0 * v1 - d - v2 + 0.5 * h2);
        opposite[x] = 0.125 * (6.0 * m[x] + 2.0 * d - 1.5 * (h2 + v2));
    }
}
