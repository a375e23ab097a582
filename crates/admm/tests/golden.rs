//! The paper's algorithm for color sensors, two-stage ADMM after its warm start by TV, against a transcription of the public
//! code's updates in `f64` that shares nothing with the solver: what it computes is pinned without any file.

use admm::*;
use ndarray::{Array2, Array3, Array4, ArrayView4, ArrayViewMut4, Axis, Zip, s};
use sci_forward::bayer::{CfaPattern, Malvar};
use sci_forward::{MaskOperator, MaskStack, Measurement, VideoShape};
use std::sync::Arc;

const SHAPE: VideoShape = VideoShape { frames: 4, height: 18, width: 22 };
const RHO: f64 = 0.55;
const TAU: f64 = 10.0;
const TV_WEIGHT: f64 = 0.1;
const START_ITERATIONS: usize = 40;
/// σ and iterations of the stages.
const STAGES: [(f64, usize); 2] = [(0.2, 5), (0.1, 4)];

/// A red square that moves over a slope of other colors, `[T, 3, H, W]`.
fn truth() -> Array4<f64> {
    let (frames, height, width) = SHAPE.dim();
    Array4::from_shape_fn((frames, 3, height, width), |(t, c, i, j)| {
        if (4 + t..10 + t).contains(&i) && (5 + t..12 + t).contains(&j) {
            [0.9, 0.2, 0.3][c]
        } else {
            0.2 + 0.02 * (i as f64 + [0.0, 4.0, 8.0][c]) + 0.01 * j as f64
        }
    })
}

/// Every pixel of every frame open or closed, by a hash of its place; open in the first frame if in no other.
fn masks() -> Array3<f64> {
    let bit = |(t, i, j): (usize, usize, usize)| {
        let mut h = ((t * 64 + i) * 64 + j + 1) as u64;
        for _ in 0..3 {
            h = (h ^ (h >> 31)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        }
        (h >> 63) as f64
    };
    let mut masks = Array3::from_shape_fn(SHAPE.dim(), bit);
    let closed = masks.sum_axis(Axis(0)).mapv(|open| if open == 0.0 { 1.0 } else { 0.0 });
    masks.index_axis_mut(Axis(0), 0).zip_mut_with(&closed, |mask, closed| *mask += closed);
    masks
}

/// The channel that an RGGB sensor sees at a pixel.
fn channel(i: usize, j: usize) -> usize {
    i % 2 + j % 2
}

/// T x: the mosaic that the sensor sees of an RGB video.
fn mosaic(rgb: &Array4<f64>) -> Array3<f64> {
    Array3::from_shape_fn(SHAPE.dim(), |(t, i, j)| rgb[[t, channel(i, j), i, j]])
}

/// Chambolle's total variation as in scikit-image: five steps, of which the last is only looked at.
fn tv(image: &Array2<f64>) -> Array2<f64> {
    let (height, width) = image.dim();
    let mut p = Array3::<f64>::zeros((2, height, width));
    let (mut first, mut last) = (0.0, 0.0);
    let mut out = image.clone();
    for step in 0..5 {
        out = Array2::from_shape_fn((height, width), |(i, j)| {
            let above = if i > 0 { p[[0, i - 1, j]] } else { 0.0 };
            let left = if j > 0 { p[[1, i, j - 1]] } else { 0.0 };
            image[[i, j]] - p[[0, i, j]] - p[[1, i, j]] + above + left
        });
        let slope = Array3::from_shape_fn((2, height, width), |(axis, i, j)| match axis {
            0 if i + 1 < height => out[[i + 1, j]] - out[[i, j]],
            1 if j + 1 < width => out[[i, j + 1]] - out[[i, j]],
            _ => 0.0,
        });
        let norm = slope.map_axis(Axis(0), |s| s[0].hypot(s[1]));
        let moved = (&out - image).mapv(|d| d * d).sum();
        let energy = (moved + TV_WEIGHT * norm.sum()) / image.len() as f64;
        if step == 0 {
            first = energy;
        } else if (last - energy).abs() < 2e-4 * first {
            break;
        }
        last = energy;
        p = (p - 0.25 * slope) / norm.mapv(|n| 1.0 + 0.25 / TV_WEIGHT * n);
    }
    out
}

/// Malvar, He and Cutler's interpolation, borders mirrored without repeating the edge.
fn malvar(mosaic: &Array3<f64>) -> Array4<f64> {
    // Eight times the weights, from two rows above to two below.
    const GREEN: [[f64; 5]; 5] = [
        [0., 0., -1., 0., 0.],
        [0., 0., 2., 0., 0.],
        [-1., 2., 4., 2., -1.],
        [0., 0., 2., 0., 0.],
        [0., 0., -1., 0., 0.],
    ];
    const IN_ITS_ROW: [[f64; 5]; 5] = [
        [0., 0., 0.5, 0., 0.],
        [0., -1., 0., -1., 0.],
        [-1., 4., 5., 4., -1.],
        [0., -1., 0., -1., 0.],
        [0., 0., 0.5, 0., 0.],
    ];
    const OPPOSITE: [[f64; 5]; 5] = [
        [0., 0., -1.5, 0., 0.],
        [0., 2., 0., 2., 0.],
        [-1.5, 0., 6., 0., -1.5],
        [0., 2., 0., 2., 0.],
        [0., 0., -1.5, 0., 0.],
    ];
    let (frames, height, width) = SHAPE.dim();
    let mirror = |at: usize, by: usize, end: usize| {
        let at = (at + by).abs_diff(2);
        if at < end { at } else { 2 * (end - 1) - at }
    };
    Array4::from_shape_fn((frames, 3, height, width), |(t, c, i, j)| {
        // Green is seen at every second pixel; its row has red if it is even, else blue.
        let (weights, transposed) = match (channel(i, j), c) {
            (seen, wanted) if seen == wanted => return mosaic[[t, i, j]],
            (_, 1) => (GREEN, false),
            (1, wanted) => (IN_ITS_ROW, wanted != 2 * (i % 2)),
            _ => (OPPOSITE, false),
        };
        let weight = |a: usize, b: usize| if transposed { weights[b][a] } else { weights[a][b] };
        let places = (0..5).flat_map(|a| (0..5).map(move |b| (a, b)));
        places.map(|(a, b)| weight(a, b) * mosaic[[t, mirror(i, a, height), mirror(j, b, width)]]).sum::<f64>() / 8.0
    })
}

/// D_σ: the mean of the 3×3 neighbors of the frame and channel, those that differ much from the pixel counted less.
fn bilateral(rgb: ArrayView4<'_, f64>, sigma: f64) -> Array4<f64> {
    let (_, _, height, width) = rgb.dim();
    Array4::from_shape_fn(rgb.dim(), |(t, c, i, j)| {
        let (mut sum, mut weights) = (0.0, 0.0);
        for a in i.saturating_sub(1)..=(i + 1).min(height - 1) {
            for b in j.saturating_sub(1)..=(j + 1).min(width - 1) {
                let weight = (-0.5 * ((rgb[[t, c, a, b]] - rgb[[t, c, i, j]]) / sigma).powi(2)).exp();
                sum += weight * rgb[[t, c, a, b]];
                weights += weight;
            }
        }
        sum / weights
    })
}

struct Bilateral;

impl Denoiser for Bilateral {
    fn name(&self) -> &str {
        "bilateral"
    }
    fn denoise(
        &mut self,
        call: &Call<'_>,
        x: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        out.assign(&bilateral(x.mapv(f64::from).view(), f64::from(call.required_sigma()?)).mapv(|v| v as f32));
        Ok(())
    }
}

/// The transcription: masks, measurement, diag(H Hᵀ).
struct Exact {
    masks: Array3<f64>,
    y: Array2<f64>,
    gram: Array2<f64>,
}

impl Exact {
    fn new() -> Self {
        let masks = masks();
        let y = (&masks * &mosaic(&truth())).sum_axis(Axis(0));
        let gram = (&masks * &masks).sum_axis(Axis(0));
        Self { masks, y, gram }
    }

    /// p + Hᵀ (y − H p) / (diag(H Hᵀ) + γ).
    fn data_step(&self, p: &Array3<f64>, gamma: f64) -> Array3<f64> {
        let residual = &self.y - &(&self.masks * p).sum_axis(Axis(0));
        p + &self.masks * &(residual / (&self.gram + gamma))
    }

    /// The warm start: ADMM with TV on each of the four sub-lattices, from Hᵀ y.
    fn warm_start(&self) -> Array3<f64> {
        let mut theta = &self.masks * &self.y;
        let mut b = Array3::<f64>::zeros(theta.dim());
        let mut x = theta.clone();
        for _ in 0..START_ITERATIONS {
            x = self.data_step(&(&theta + &b), 0.01);
            let noisy = &x - &b;
            for t in 0..SHAPE.frames {
                for (row, column) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                    let lattice = s![t, row..;2, column..;2];
                    theta.slice_mut(lattice).assign(&tv(&noisy.slice(lattice).to_owned()));
                }
            }
            theta.mapv_inplace(|v| v.clamp(0.0, 1.0));
            b = b - (&x - &theta);
        }
        x
    }

    /// θ and v after all stages, from θ.
    fn two_stage(&self, mut theta: Array3<f64>, closed_form: bool) -> (Array3<f64>, Array4<f64>) {
        let mut b = Array3::<f64>::zeros(theta.dim());
        let mut v = Array4::<f64>::zeros(truth().dim());
        let mut w = v.clone();
        let sigmas = STAGES.iter().flat_map(|&(sigma, iterations)| std::iter::repeat_n(sigma, iterations));
        for (k, sigma) in sigmas.enumerate() {
            let q = self.data_step(&(&theta - &(&b / RHO)), RHO);
            let x = if closed_form && k > 0 {
                Array4::from_shape_fn(v.dim(), |(t, c, i, j)| {
                    let (v, w) = (v[[t, c, i, j]], w[[t, c, i, j]]);
                    let (q, b) = (q[[t, i, j]], b[[t, i, j]]);
                    let seen = channel(i, j) == c;
                    let x = if seen { (RHO * q + b + TAU * v + w) / (RHO + TAU) } else { (TAU * v + w) / TAU };
                    x.clamp(0.0, 1.0)
                })
            } else {
                malvar(&(&q + &(&b / RHO)))
            };
            v = bilateral((&x - &(&w / TAU)).view(), sigma);
            let raw = mosaic(&v);
            theta = raw.mapv(|v| v.clamp(0.0, 1.0));
            // In the first iteration of the public code θ before clipping stands where q should.
            b = b + (if k == 0 { &raw } else { &q }) - &theta;
            w = w + &x - &v;
        }
        (theta, v)
    }
}

fn psnr(video: &Array3<f64>) -> f64 {
    -10.0 * (video - &mosaic(&truth())).mapv(|d| d * d).mean().unwrap().log10()
}

#[track_caller]
fn assert_close<D: ndarray::Dimension>(found: &ndarray::Array<f32, D>, exact: &ndarray::Array<f64, D>) {
    let worst = Zip::from(found).and(exact).fold(0f64, |worst, &a, &b| worst.max((f64::from(a) - b).abs()));
    assert!(worst < 1e-5, "largest difference {worst:e}");
}

/// The program's run, whose numbers are in `f32`.
fn found(x_step: XStep, stages: &[(f64, usize)]) -> (Array3<f32>, Option<Array4<f32>>) {
    let exact = Exact::new();
    let h = MaskOperator::new(MaskStack::new(exact.masks.mapv(|v| v as f32)).unwrap());
    let y = exact.y.mapv(|v| v as f32);
    let params = TwoStageParams { rho: RHO as f32, tau: TAU as f32, convention: Convention::PaperCode };
    let mut solver = TwoStage::new(Bilateral, Malvar, x_step, CfaPattern::Rggb, params);
    let mut tv = PerLattice::new(Tv::new(TV_WEIGHT as f32));
    let start = Start::Warm { prior: &mut tv, stage: Stage { sigma: None, iterations: START_ITERATIONS } };
    let stage = |&(sigma, iterations): &(f64, usize)| Stage { sigma: Some(sigma as f32), iterations };
    let plan = Plan::new(stages.iter().map(stage).collect::<Vec<_>>());
    let measurement = Measurement::new(Arc::new(h), y).unwrap();
    let outcome = run(&mut solver, &measurement, start, &plan, &mut ()).unwrap();
    (outcome.estimate.sensor, outcome.estimate.rgb)
}

#[test]
fn the_warm_start() {
    let start = Exact::new().warm_start();
    assert!((psnr(&start) - 23.684).abs() < 0.001, "{} dB", psnr(&start));
    let (estimate, _) = found(XStep::Demosaic, &[]);
    assert_close(&estimate, &start);
}

#[test]
fn two_stage_with_malvar() {
    let exact = Exact::new();
    let (theta, v) = exact.two_stage(exact.warm_start(), false);
    assert!((psnr(&theta) - 23.006).abs() < 0.001, "{} dB", psnr(&theta));
    let (estimate, rgb) = found(XStep::Demosaic, &STAGES);
    assert_close(&estimate, &theta);
    assert_close(&rgb.unwrap(), &v);
}

#[test]
fn two_stage_in_closed_form() {
    let exact = Exact::new();
    let (theta, v) = exact.two_stage(exact.warm_start(), true);
    assert!((psnr(&theta) - 21.917).abs() < 0.001, "{} dB", psnr(&theta));
    let (estimate, rgb) = found(XStep::ClosedForm { clip: true }, &STAGES);
    assert_close(&estimate, &theta);
    assert_close(&rgb.unwrap(), &v);
}
