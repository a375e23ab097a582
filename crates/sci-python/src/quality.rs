//! PSNR and both SSIMs, over frames.

use ndarray::{ArrayView2, Axis, IxDyn};
use pyo3::prelude::*;
use sci_forward::metrics;

use crate::arrays::{array, must_be, row_major};
use crate::failure::refused;

type Metric = fn(ArrayView2<'_, f32>, ArrayView2<'_, f32>) -> f64;

/// Peak signal-to-noise ratio in dB for data from 0 to 1, the mean over frames: 10 log10(1 / MSE) of each.
///
/// Parameters
/// ----------
/// reference, video : array of floats, [H, W], [T, H, W] or [T, 3, H, W]
///     The frames compared, white at 1. Of frames in color it is the MSE over all three colors.
///
/// Returns
/// -------
/// float
///     Infinite for equal videos.
#[pyfunction]
pub(crate) fn psnr(py: Python<'_>, reference: &Bound<'_, PyAny>, video: &Bound<'_, PyAny>) -> PyResult<f64> {
    mean(py, reference, video, 1, metrics::psnr, true)
}

/// Structural similarity for data from 0 to 1, the mean over frames, in one of the field's two conventions, whose numbers differ.
///
/// Parameters
/// ----------
/// reference, video : array of floats, [H, W], [T, H, W] or [T, 3, H, W]
///     The frames compared, white at 1, at least 7×7 ("uniform") or 11×11 ("gaussian"). Of color it is the mean over the colors.
/// window : "uniform" or "gaussian"
///     "uniform" is scikit-image's default and that of the paper's code: 7×7, sample covariance. "gaussian" is the original's: 11×11,
///     σ = 1.5, only where the window fits.
///
/// Returns
/// -------
/// float
///     At most 1, for equal videos.
#[pyfunction]
#[pyo3(signature = (reference, video, window="uniform"))]
pub(crate) fn ssim(
    py: Python<'_>,
    reference: &Bound<'_, PyAny>,
    video: &Bound<'_, PyAny>,
    window: &str,
) -> PyResult<f64> {
    match window {
        "uniform" => mean(py, reference, video, 7, metrics::ssim, false),
        "gaussian" => mean(py, reference, video, 11, metrics::ssim_gaussian, false),
        _ => Err(refused(format!("window = {window:?} is not legal; legal: \"uniform\", \"gaussian\""))),
    }
}

/// The mean over frames; those in color are one image of three times the height if they are `stacked`, else three.
fn mean(
    py: Python<'_>,
    reference: &Bound<'_, PyAny>,
    video: &Bound<'_, PyAny>,
    least: usize,
    metric: Metric,
    stacked: bool,
) -> PyResult<f64> {
    const AXES: &str = "[H, W], [T, H, W] or [T, 3, H, W]";
    let a = array::<IxDyn>("reference", reference, AXES)?;
    let b = array::<IxDyn>("video", video, AXES)?;
    let (a, b) = (a.as_array(), b.as_array());
    must_be("video", b.shape(), a.shape(), "that of `reference`")?;
    let (frames, height, width) = match *a.shape() {
        [h, w] => (1, h, w),
        [t, h, w] => (t, h, w),
        [t, 3, h, w] if stacked => (t, 3 * h, w),
        [t, 3, h, w] => (3 * t, h, w),
        _ => return Err(refused(format!("`reference` has shape {:?}, expected {AXES}", a.shape()))),
    };
    if frames == 0 || height < least || width < least {
        return Err(refused(format!(
            "`reference` has shape {:?}: at least a frame of {least}×{least} is needed",
            a.shape()
        )));
    }
    let (a, b) = (row_major(a), row_major(b));
    let same = "row-major, and the same number of values";
    let a = a.view().into_shape_with_order((frames, height, width)).expect(same);
    let b = b.view().into_shape_with_order((frames, height, width)).expect(same);
    debug_assert_eq!(a.len_of(Axis(0)), frames);
    Ok(py.detach(|| metrics::mean_over_frames(a, b, metric)))
}
