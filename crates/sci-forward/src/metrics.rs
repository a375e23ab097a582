//! PSNR and both SSIM conventions of the field, per frame, data range 1, in `f64`.
//!
//! The paper's code takes scikit-image's defaults ([`ssim`]); the `cacti` family takes the Gaussian window
//! ([`ssim_gaussian`]). The two give different numbers for the same images, so that their columns cannot be compared.

use multiversion::multiversion;
use ndarray::parallel::prelude::*;
use ndarray::{Array2, ArrayView2, ArrayView3, Axis, Zip, s};

/// Peak signal-to-noise ratio `10 log10(1 / MSE)` in dB of an image `[H, W]` with data range 1; infinite for equal images.
///
/// ```
/// use ndarray::Array2;
/// let (a, b) = (Array2::<f32>::zeros((4, 4)), Array2::<f32>::from_elem((4, 4), 0.1));
/// assert!((sci_forward::metrics::psnr(a.view(), b.view()) - 20.0).abs() < 1e-5);
/// ```
///
/// # Panics
/// If the sizes differ.
pub fn psnr(reference: ArrayView2<'_, f32>, image: ArrayView2<'_, f32>) -> f64 {
    assert_eq!(reference.dim(), image.dim(), "images of one size are compared");
    let sum: f64 = reference
        .outer_iter()
        .zip(image.outer_iter())
        .map(|(a, b)| match (a.as_slice(), b.as_slice()) {
            (Some(a), Some(b)) => squared_distance(a, b),
            _ => squared_distance(&a.to_vec(), &b.to_vec()),
        })
        .sum();
    -10.0 * (sum / reference.len() as f64).log10()
}

/// `Σ (a − b)²` of a row, over lanes.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn squared_distance(a: &[f32], b: &[f32]) -> f64 {
    const LANES: usize = 8;
    let mut sums = [0f64; LANES];
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    for (a, b) in a.iter().zip(b) {
        for lane in 0..LANES {
            sums[lane] += (f64::from(a[lane]) - f64::from(b[lane])).powi(2);
        }
    }
    let rest: f64 = a_rest.iter().zip(b_rest).map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum();
    sums.iter().sum::<f64>() + rest
}

/// The mean over frames of a metric of two videos `[T, H, W]`.
///
/// ```
/// use ndarray::array;
/// use sci_forward::metrics::{mean_over_frames, psnr};
/// let (reference, video) = (array![[[0.0f32]], [[0.0]]], array![[[0.1f32]], [[0.01]]]);
/// // 20 dB and 40 dB: of the frames' PSNR the mean is taken, not of their errors.
/// assert!((mean_over_frames(reference.view(), video.view(), psnr) - 30.0).abs() < 1e-5);
/// ```
///
/// # Panics
/// If the sizes differ.
pub fn mean_over_frames<M>(reference: ArrayView3<'_, f32>, video: ArrayView3<'_, f32>, metric: M) -> f64
where
    M: Fn(ArrayView2<'_, f32>, ArrayView2<'_, f32>) -> f64 + Sync,
{
    assert_eq!(reference.dim(), video.dim(), "videos of one size are compared");
    let frames: Vec<f64> =
        reference.axis_iter(Axis(0)).into_par_iter().zip(video.axis_iter(Axis(0))).map(|(a, b)| metric(a, b)).collect();
    frames.iter().sum::<f64>() / reference.dim().0 as f64
}

/// Structural similarity as scikit-image's default and the paper's code have it: 7×7 uniform window, sample
/// covariance (N / (N − 1)), K1 = 0.01, K2 = 0.03, 3 border pixels left out. At most 1, for equal images; NaN for images under
/// 7×7.
///
/// ```text
/// mean of (2 μ_a μ_b + C1) (2 σ_ab + C2) / ((μ_a² + μ_b² + C1) (σ_a² + σ_b² + C2)),  C1 = K1², C2 = K2²
/// ```
///
/// ```
/// use sci_forward::{metrics::ssim, testing::uniform};
/// let image = uniform((16, 16), 0);
/// let darker = image.mapv(|v| 0.5 * v);
/// assert_eq!(ssim(image.view(), image.view()), 1.0);
/// assert!(ssim(image.view(), darker.view()) < 0.9);
/// ```
///
/// # Panics
/// If the sizes differ.
///
/// # References
/// Wang et al., *Image quality assessment: from error visibility to structural similarity*, 2004.
pub fn ssim(reference: ArrayView2<'_, f32>, image: ArrayView2<'_, f32>) -> f64 {
    ssim_with(reference, image, &[1.0 / 7.0; 7], 49.0 / 48.0)
}

/// Structural similarity with the original's Gaussian window (11×11, σ = 1.5), population covariance, valid region only.
/// NaN for images under 11×11. The formula is that of [`ssim`].
///
/// ```
/// use sci_forward::{metrics::ssim_gaussian, testing::uniform};
/// let image = uniform((16, 16), 0);
/// let darker = image.mapv(|v| 0.5 * v);
/// assert!((ssim_gaussian(image.view(), image.view()) - 1.0).abs() < 1e-12);
/// assert!(ssim_gaussian(image.view(), darker.view()) < 0.9);
/// ```
///
/// # Panics
/// If the sizes differ.
///
/// # References
/// Wang et al., *Image quality assessment: from error visibility to structural similarity*, 2004.
pub fn ssim_gaussian(reference: ArrayView2<'_, f32>, image: ArrayView2<'_, f32>) -> f64 {
    let mut taps: [f64; 11] = std::array::from_fn(|i| (-0.5 * ((i as f64 - 5.0) / 1.5).powi(2)).exp());
    let sum: f64 = taps.iter().sum();
    taps.iter_mut().for_each(|t| *t /= sum);
    ssim_with(reference, image, &taps, 1.0)
}

fn ssim_with(reference: ArrayView2<'_, f32>, image: ArrayView2<'_, f32>, taps: &[f64], covariance_norm: f64) -> f64 {
    const C1: f64 = 0.01 * 0.01;
    const C2: f64 = 0.03 * 0.03;
    assert_eq!(reference.dim(), image.dim(), "images of one size are compared");
    if reference.nrows() < taps.len() || reference.ncols() < taps.len() {
        return f64::NAN;
    }
    let (height, width) = (reference.nrows() + 1 - taps.len(), reference.ncols() + 1 - taps.len());
    let mut sum = 0.0;
    for first in (0..height).step_by(STRIP) {
        let rows = s![first..(first + STRIP).min(height) + taps.len() - 1, ..];
        let (a, b) = (reference.slice(rows).mapv(f64::from), image.slice(rows).mapv(f64::from));
        let filter = |v: &Array2<f64>| filter_valid(v, taps);
        let (mean_a, mean_b) = (filter(&a), filter(&b));
        let (aa, bb, ab) = (filter(&(&a * &a)), filter(&(&b * &b)), filter(&(&a * &b)));
        // From strip to strip the terms are added in the order of the whole.
        sum = Zip::from(&mean_a).and(&mean_b).and(&aa).and(&bb).and(&ab).fold(sum, |sum, &ma, &mb, &aa, &bb, &ab| {
            let variance_a = covariance_norm * (aa - ma * ma);
            let variance_b = covariance_norm * (bb - mb * mb);
            let covariance = covariance_norm * (ab - ma * mb);
            sum + (2.0 * ma * mb + C1) * (2.0 * covariance + C2)
                / ((ma * ma + mb * mb + C1) * (variance_a + variance_b + C2))
        });
    }
    sum / (height * width) as f64
}

/// Rows of the map of SSIM that are made at once: what they need stays in the cache.
const STRIP: usize = 16;

/// The separable filter `taps ⊗ taps` where it lies inside the image.
fn filter_valid(image: &Array2<f64>, taps: &[f64]) -> Array2<f64> {
    let (height, width) = (image.nrows() + 1 - taps.len(), image.ncols() + 1 - taps.len());
    let mut rows = Array2::zeros((image.nrows(), width));
    for (image, mut row) in image.outer_iter().zip(rows.outer_iter_mut()) {
        for (k, &tap) in taps.iter().enumerate() {
            row.scaled_add(tap, &image.slice(s![k..k + width]));
        }
    }
    let mut filtered = Array2::zeros((height, width));
    for (i, mut row) in filtered.outer_iter_mut().enumerate() {
        for (k, &tap) in taps.iter().enumerate() {
            row.scaled_add(tap, &rows.row(i + k));
        }
    }
    filtered
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::uniform;

    #[test]
    fn equal_images_have_no_error() {
        let a = uniform((20, 21), 0);
        assert_eq!(psnr(a.view(), a.view()), f64::INFINITY);
        assert!((ssim(a.view(), a.view()) - 1.0).abs() < 1e-12);
        assert!((ssim_gaussian(a.view(), a.view()) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn an_image_smaller_than_the_window_has_no_ssim() {
        let a = uniform((6, 30), 0);
        assert!(ssim(a.view(), a.view()).is_nan());
        assert!(psnr(a.view(), a.view()).is_infinite());
    }
}
