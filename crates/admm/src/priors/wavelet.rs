//! Soft thresholds on wavelet coefficients, frame by frame.

use crate::{BoxError, Call, Denoiser};
use multiversion::multiversion;
use ndarray::parallel::prelude::*;
use ndarray::{ArrayView2, ArrayView4, ArrayViewMut2, ArrayViewMut4};

/// The low-pass filter of Daubechies' wavelet with eight vanishing moments; its squares add up to 1.
const LOW: [f64; 16] = [
    0.05441584224308161,
    0.3128715909144659,
    0.6756307362980128,
    0.5853546836548691,
    -0.015829105256023893,
    -0.2840155429624281,
    0.00047248457399797254,
    0.128747426620186,
    -0.01736930100202211,
    -0.04408825393106472,
    0.013981027917015516,
    0.008746094047015655,
    -0.00487035299301066,
    -0.0003917403729959771,
    0.0006754494059985568,
    -0.00011747678400228192,
];
const TAPS: usize = LOW.len();

/// Pixels by which a frame is mirrored beyond its edges; further out it is its own neighbour on the other side, as the transform asks for.
const MARGIN: usize = 32;

/// Soft thresholds on the coefficients d of an undecimated wavelet transform of every frame and channel on its own,
///
/// ```text
/// d ← sign(d) max(|d| − t σ 2⁻ʲ, 0)        at level j = 1 … levels,
/// ```
///
/// σ 2⁻ʲ being what noise of a standard deviation σ amounts to there. The filters are Daubechies' with eight vanishing moments (DB8), at every
/// pixel: the result moves with the picture, and no blocks can be seen. The coarsest approximation is left as it is.
///
/// | Parameter | Default | Purpose | Range |
/// |---|---|---|---|
/// | `threshold` | 1.5 | t, in standard deviations of the noise | ≥ 0 |
/// | `levels` | 4 | of the transform | 1 to 8 |
///
/// ```
/// use admm::{Call, Denoiser, Wavelet};
/// use ndarray::Array4;
/// use sci_forward::{VideoShape, testing::{gaussian, moving_square}};
/// let clean = moving_square(VideoShape { frames: 2, height: 32, width: 32 }).insert_axis(ndarray::Axis(1));
/// let noisy = &clean + &(gaussian(clean.dim(), 1) * 0.1);
/// let mut out = Array4::zeros(clean.dim());
/// Wavelet::default().denoise(&Call::new(0.1), noisy.view(), out.view_mut())?;
/// let error = |v: &Array4<f32>| (v - &clean).mapv(|d| d * d).mean().unwrap();
/// assert!(error(&out) < error(&noisy) / 2.0);
/// # Ok::<(), admm::BoxError>(())
/// ```
///
/// # References
/// Coifman, Donoho, *Translation-invariant de-noising*, 1995. Daubechies, *Ten lectures on wavelets*, 1992, table 6.1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wavelet {
    /// t, in standard deviations of the noise.
    pub threshold: f32,
    /// Levels of the transform.
    pub levels: u32,
}

impl Default for Wavelet {
    fn default() -> Self {
        Self { threshold: 1.5, levels: 4 }
    }
}

impl Denoiser for Wavelet {
    fn name(&self) -> &str {
        "wavelet"
    }

    fn denoise(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        let threshold = self.threshold * call.required_sigma()?;
        if noisy.is_empty() || threshold <= 0.0 {
            out.assign(&noisy);
            return Ok(());
        }
        let filters = Filters::new();
        out.outer_iter_mut().into_par_iter().zip(noisy.outer_iter()).for_each(|(mut out, noisy)| {
            for (out, noisy) in out.outer_iter_mut().zip(noisy.outer_iter()) {
                self.denoise_plane(&filters, threshold, noisy, out);
            }
        });
        Ok(())
    }
}

impl Wavelet {
    fn denoise_plane(
        &self,
        filters: &Filters,
        threshold: f32,
        noisy: ArrayView2<'_, f32>,
        mut out: ArrayViewMut2<'_, f32>,
    ) {
        let (height, width) = noisy.dim();
        let plane = Plane { height: height + 2 * MARGIN, width: width + 2 * MARGIN };
        let mut values = Vec::with_capacity(plane.height * plane.width);
        for row in 0..plane.height {
            let row = noisy.row(mirrored(row, height));
            values.extend((0..plane.width).map(|column| row[mirrored(column, width)]));
        }
        plane.shrink(filters, self.levels, 1, threshold, &mut values);
        for (mut out, values) in out.outer_iter_mut().zip(values.chunks_exact(plane.width).skip(MARGIN)) {
            out.iter_mut().zip(&values[MARGIN..]).for_each(|(out, value)| *out = *value);
        }
    }
}

/// Which pixel of a line is shown at a place of the line with its margins.
fn mirrored(at: usize, length: usize) -> usize {
    let at = (at + 2 * length * MARGIN - MARGIN) % (2 * length);
    at.min(2 * length - 1 - at)
}

/// A quarter of the energy goes to each of four bands, as the transform has four times as many coefficients.
struct Filters {
    low: [f32; TAPS],
    high: [f32; TAPS],
}

impl Filters {
    fn new() -> Self {
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let sign = |k: usize| if k.is_multiple_of(2) { half } else { -half };
        Self {
            low: LOW.map(|tap| (half * tap) as f32),
            high: std::array::from_fn(|k| (sign(k) * LOW[TAPS - 1 - k]) as f32),
        }
    }
}

/// The size of what is transformed; its ends meet.
#[derive(Clone, Copy)]
struct Plane {
    height: usize,
    width: usize,
}

impl Plane {
    /// Takes what is below the threshold out of the bands of a level and of those above it. A level's taps lie 2^(level − 1) apart.
    fn shrink(self, filters: &Filters, levels: u32, level: u32, threshold: f32, values: &mut [f32]) {
        let gap = 1 << (level - 1);
        let size = values.len();
        let band = || vec![0f32; size];
        let [mut low, mut high] = [band(), band()];
        self.along_columns(&filters.low, gap, values, &mut low);
        self.along_columns(&filters.high, gap, values, &mut high);
        values.fill(0.0);
        let mut across = band();
        for (of_columns, lower) in [(&low, true), (&high, false)] {
            let filter = if lower { &filters.low } else { &filters.high };
            let mut both = band();
            for taps in [&filters.low, &filters.high] {
                let approximation = lower && std::ptr::eq(taps, &filters.low);
                self.along_rows(taps, gap, of_columns, &mut across);
                if !approximation {
                    soft(threshold / (1u32 << level) as f32, &mut across);
                } else if level < levels {
                    self.shrink(filters, levels, level + 1, threshold, &mut across);
                }
                self.back_along_rows(taps, gap, &across, &mut both);
            }
            self.back_along_columns(filter, gap, &both, values);
        }
    }

    /// `out[y, x] = Σ_k filter[k] · values[y + k · gap, x]`.
    fn along_columns(self, filter: &[f32; TAPS], gap: usize, values: &[f32], out: &mut [f32]) {
        for (row, out) in out.chunks_exact_mut(self.width).enumerate() {
            out.fill(0.0);
            self.add_rows(filter, |k| (row + k * gap) % self.height, values, out);
        }
    }

    /// Adds the transposed of [`Plane::along_columns`].
    fn back_along_columns(self, filter: &[f32; TAPS], gap: usize, values: &[f32], out: &mut [f32]) {
        for (row, out) in out.chunks_exact_mut(self.width).enumerate() {
            self.add_rows(filter, |k| (row + self.height * gap * TAPS - k * gap) % self.height, values, out);
        }
    }

    fn add_rows(self, filter: &[f32; TAPS], row: impl Fn(usize) -> usize, values: &[f32], out: &mut [f32]) {
        let rows = std::array::from_fn(|k| &values[row(k) * self.width..][..self.width]);
        add_weighted(filter, &rows, out);
    }

    /// `out[y, x] = Σ_k filter[k] · values[y, x + k · gap]`.
    fn along_rows(self, filter: &[f32; TAPS], gap: usize, values: &[f32], out: &mut [f32]) {
        out.fill(0.0);
        self.add_shifted(filter, |k| k * gap, values, out);
    }

    /// Adds the transposed of [`Plane::along_rows`].
    fn back_along_rows(self, filter: &[f32; TAPS], gap: usize, values: &[f32], out: &mut [f32]) {
        self.add_shifted(filter, |k| (TAPS * self.width - k * gap % self.width) % self.width, values, out);
    }

    fn add_shifted(self, filter: &[f32; TAPS], shift: impl Fn(usize) -> usize, values: &[f32], out: &mut [f32]) {
        let shifts: [usize; TAPS] = std::array::from_fn(|k| shift(k) % self.width);
        // A row twice, so that every shift of it is a slice.
        let mut twice = vec![0f32; 2 * self.width];
        for (values, out) in values.chunks_exact(self.width).zip(out.chunks_exact_mut(self.width)) {
            twice[..self.width].copy_from_slice(values);
            twice[self.width..].copy_from_slice(values);
            let rows = shifts.map(|shift| &twice[shift..shift + self.width]);
            add_weighted(filter, &rows, out);
        }
    }
}

/// `out += Σ_k filter[k] · rows[k]`, of equal lengths.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn add_weighted(filter: &[f32; TAPS], rows: &[&[f32]; TAPS], out: &mut [f32]) {
    const LANES: usize = 16;
    let whole = out.len() / LANES * LANES;
    for x in (0..whole).step_by(LANES) {
        let mut sums = [0f32; LANES];
        for (tap, row) in filter.iter().zip(rows) {
            let row = &row[x..x + LANES];
            for l in 0..LANES {
                sums[l] += tap * row[l];
            }
        }
        out[x..x + LANES].iter_mut().zip(&sums).for_each(|(out, sum)| *out += sum);
    }
    for x in whole..out.len() {
        out[x] += filter.iter().zip(rows).map(|(tap, row)| tap * row[x]).sum::<f32>();
    }
}

fn soft(threshold: f32, values: &mut [f32]) {
    values.iter_mut().for_each(|value| *value -= value.clamp(-threshold, threshold));
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array2, Array4};
    use sci_forward::testing::uniform;

    /// What makes perfect reconstruction possible: shifts by even numbers of taps are orthonormal; and the moments that vanish.
    #[test]
    fn the_filter_is_orthonormal_and_blind_to_polynomials() {
        for shift in (0..TAPS).step_by(2) {
            let product: f64 = (shift..TAPS).map(|k| LOW[k] * LOW[k - shift]).sum();
            assert!((product - f64::from(u8::from(shift == 0))).abs() < 1e-11, "{shift}: {product}");
        }
        for power in 0..8 {
            let moment: f64 = (0..TAPS).map(|k| LOW[k] * (k as f64 / 15.0).powi(power) * (-1f64).powi(k as i32)).sum();
            assert!(moment.abs() < 1e-9, "{power}: {moment}");
        }
    }

    #[test]
    fn a_threshold_that_takes_nothing_changes_nothing() {
        for (height, width) in [(1, 1), (1, 9), (5, 3), (33, 40), (64, 100)] {
            for levels in [1, 4, 8] {
                let noisy = uniform((2, 1, height, width), 3);
                let mut out = Array4::from_elem(noisy.dim(), f32::NAN);
                let mut wavelet = Wavelet { threshold: 1e-9, levels };
                wavelet.denoise(&Call::new(1.0), noisy.view(), out.view_mut()).unwrap();
                let worst = out.iter().zip(&noisy).fold(0f32, |worst, (a, b)| worst.max((a - b).abs()));
                assert!(worst < 2e-5, "{height}×{width}, {levels} levels: {worst}");
            }
        }
    }

    /// The definition in f64: every coefficient is a product with a shifted wavelet, every pixel their sum.
    fn naive(values: &Array2<f64>, levels: u32, level: u32, threshold: f64) -> Array2<f64> {
        let (height, width) = values.dim();
        let gap = 1 << (level - 1);
        let half = std::f64::consts::FRAC_1_SQRT_2;
        let filter = |high: bool, k: usize| match high {
            false => half * LOW[k],
            true => half * LOW[TAPS - 1 - k] * (-1f64).powi(k as i32),
        };
        let mut result = Array2::zeros((height, width));
        for (high_y, high_x) in [(false, false), (false, true), (true, false), (true, true)] {
            let taps = || (0..TAPS).flat_map(|i| (0..TAPS).map(move |j| (i, j)));
            let at = |y: usize, x: usize, i: usize, j: usize| [(y + i * gap) % height, (x + j * gap) % width];
            let mut band = Array2::from_shape_fn((height, width), |(y, x)| {
                taps().map(|(i, j)| filter(high_y, i) * filter(high_x, j) * values[at(y, x, i, j)]).sum::<f64>()
            });
            if high_y || high_x {
                let t = threshold / f64::from(1 << level);
                band.mapv_inplace(|d| d.signum() * (d.abs() - t).max(0.0));
            } else if level < levels {
                band = naive(&band, levels, level + 1, threshold);
            }
            for ((y, x), d) in band.indexed_iter() {
                taps().for_each(|(i, j)| result[at(y, x, i, j)] += filter(high_y, i) * filter(high_x, j) * d);
            }
        }
        result
    }

    #[test]
    fn it_is_the_definition() {
        for (height, width) in [(9, 7), (16, 21)] {
            let values = uniform((1, 1, height, width), 5);
            let expected = naive(&values.slice(ndarray::s![0, 0, .., ..]).mapv(f64::from), 3, 1, 0.2);
            let mut found: Vec<f32> = values.iter().copied().collect();
            Plane { height, width }.shrink(&Filters::new(), 3, 1, 0.2, &mut found);
            for (found, expected) in found.iter().zip(&expected) {
                assert!((f64::from(*found) - expected).abs() < 1e-5, "{found} is not {expected}");
            }
        }
    }

    /// A picture that is moved gives the result, moved: no block begins anywhere.
    #[test]
    fn it_moves_with_the_picture() {
        let plane = Plane { height: 20, width: 24 };
        let values: Vec<f32> = uniform((1, 1, 20, 24), 5).iter().copied().collect();
        let moved: Vec<f32> = (0..480).map(|i| values[(i / 24 + 3) % 20 * 24 + (i % 24 + 5) % 24]).collect();
        let (mut a, mut b) = (values, moved);
        plane.shrink(&Filters::new(), 2, 1, 0.3, &mut a);
        plane.shrink(&Filters::new(), 2, 1, 0.3, &mut b);
        for (i, b) in b.iter().enumerate() {
            assert!((b - a[(i / 24 + 3) % 20 * 24 + (i % 24 + 5) % 24]).abs() < 1e-5);
        }
    }

    #[test]
    fn a_threshold_shrinks_what_varies_and_leaves_the_mean() {
        let values = uniform((1, 1, 40, 40), 2);
        let energy = |threshold: f32| {
            let mut out = Array4::zeros(values.dim());
            let mut wavelet = Wavelet { threshold, levels: 4 };
            wavelet.denoise(&Call::new(0.1), values.view(), out.view_mut()).unwrap();
            let mean = out.mean().unwrap();
            assert!((mean - values.mean().unwrap()).abs() < 0.02, "{mean}");
            out.mapv(|v| (v - mean).powi(2)).sum()
        };
        let [none, some, more, all] = [1e-6, 1.0, 3.0, 1000.0].map(energy);
        assert!(none > 1.5 * some && some > 1.5 * more && more > all, "{none} {some} {more} {all}");
    }
}
