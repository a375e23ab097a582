//! PSNR and both SSIM conventions of the field, per frame, data range 1, in `f64`.
//!
//! The paper's code takes scikit-image's defaults ([`ssim`]); the `cacti` family takes the Gaussian window
//! ([`ssim_gaussian`]). The two give different numbers for the same images, so that their columns cannot be compared.

use multiversion::multiversion;
use ndarray::parallel::prelude::*;
use ndarray::{ArrayView2, ArrayView3, Axis, s};

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
    assert_eq!(reference.dim(), image.dim(), "images of one size are compared");
    if reference.nrows() < taps.len() || reference.ncols() < taps.len() {
        return f64::NAN;
    }
    let (height, width) = (reference.nrows() + 1 - taps.len(), reference.ncols() + 1 - taps.len());
    let mut strip = Strip::new(reference.ncols(), taps, covariance_norm);
    let mut sum = 0.0;
    for first in (0..height).step_by(STRIP) {
        let rows = s![first..(first + STRIP).min(height) + taps.len() - 1, ..];
        // From strip to strip the terms are added in the order of the whole.
        sum = strip.terms(reference.slice(rows), image.slice(rows)).iter().fold(sum, |sum, term| sum + term);
    }
    sum / (height * width) as f64
}

/// Rows of the map of SSIM that are made at once: what they need stays in the cache.
const STRIP: usize = 16;

/// Makes the map of SSIM a strip at a time, in the same memory.
struct Strip<'t> {
    taps: &'t [f64],
    covariance_norm: f64,
    width: usize,
    /// The rows of both images.
    images: [Vec<f64>; 2],
    /// The product of two of them, and what the taps make of its rows.
    product: Vec<f64>,
    filtered: Vec<f64>,
    /// Of a, b, a², b² and ab.
    means: [Vec<f64>; 5],
    terms: Vec<f64>,
}

impl<'t> Strip<'t> {
    fn new(width: usize, taps: &'t [f64], covariance_norm: f64) -> Self {
        let (images, means) = (std::array::from_fn(|_| Vec::new()), std::array::from_fn(|_| Vec::new()));
        let (product, filtered, terms) = (Vec::new(), Vec::new(), Vec::new());
        Self { taps, covariance_norm, width, images, product, filtered, means, terms }
    }

    /// The map of SSIM of these rows.
    fn terms(&mut self, a: ArrayView2<'_, f32>, b: ArrayView2<'_, f32>) -> &[f64] {
        let Self { taps, width, images, product, filtered, means, terms, .. } = self;
        for (rows, image) in images.iter_mut().zip([a, b]) {
            rows.clear();
            rows.extend(image.iter().map(|&v| f64::from(v)));
        }
        let mut filter = |rows: &[f64], to: &mut Vec<f64>| filter_valid(rows, *width, taps, filtered, to);
        let [mean_a, mean_b, products @ ..] = means;
        filter(&images[0], mean_a);
        filter(&images[1], mean_b);
        for ((a, b), to) in [(0, 0), (1, 1), (0, 1)].into_iter().zip(products) {
            product.clear();
            product.extend(images[a].iter().zip(&images[b]).map(|(a, b)| a * b));
            filter(product, to);
        }
        terms.clear();
        terms.resize(means[0].len(), 0.0);
        let [mean_a, mean_b, aa, bb, ab] = &*means;
        similarities(terms, [mean_a, mean_b, aa, bb, ab], self.covariance_norm);
        terms
    }
}

/// The terms of [`ssim`], of the means of a, b, a², b² and ab.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn similarities(terms: &mut [f64], means: [&[f64]; 5], covariance_norm: f64) {
    const C1: f64 = 0.01 * 0.01;
    const C2: f64 = 0.03 * 0.03;
    let [mean_a, mean_b, aa, bb, ab] = means.map(|mean| &mean[..terms.len()]);
    for (i, term) in terms.iter_mut().enumerate() {
        let (ma, mb) = (mean_a[i], mean_b[i]);
        let variance_a = covariance_norm * (aa[i] - ma * ma);
        let variance_b = covariance_norm * (bb[i] - mb * mb);
        let covariance = covariance_norm * (ab[i] - ma * mb);
        *term = (2.0 * ma * mb + C1) * (2.0 * covariance + C2)
            / ((ma * ma + mb * mb + C1) * (variance_a + variance_b + C2));
    }
}

/// The separable filter `taps ⊗ taps` of rows of this width, where it lies inside them; `rows` is scratch.
fn filter_valid(image: &[f64], width: usize, taps: &[f64], rows: &mut Vec<f64>, to: &mut Vec<f64>) {
    let inner = width + 1 - taps.len();
    let height = image.len() / width;
    rows.resize(height * inner, 0.0);
    for (row, image) in rows.chunks_exact_mut(inner).zip(image.chunks_exact(width)) {
        weighted_sums(row, image, 1, taps);
    }
    to.resize((height + 1 - taps.len()) * inner, 0.0);
    for (i, row) in to.chunks_exact_mut(inner).enumerate() {
        weighted_sums(row, &rows[i * inner..], inner, taps);
    }
}

/// `to[j] = Σ_k taps[k] from[j + k step]`, added in this order.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn weighted_sums(to: &mut [f64], from: &[f64], step: usize, taps: &[f64]) {
    const LANES: usize = 16;
    let (to, rest) = to.as_chunks_mut::<LANES>();
    for (i, to) in to.iter_mut().enumerate() {
        let mut sums = [0f64; LANES];
        for (k, &tap) in taps.iter().enumerate() {
            let from = &from[i * LANES + k * step..][..LANES];
            for lane in 0..LANES {
                sums[lane] += tap * from[lane];
            }
        }
        *to = sums;
    }
    let first = to.len() * LANES;
    for (j, to) in rest.iter_mut().enumerate() {
        *to = taps.iter().enumerate().fold(0.0, |sum, (k, &tap)| sum + tap * from[first + j + k * step]);
    }
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
