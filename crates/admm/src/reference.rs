//! The solvers' oracle: GAP-TV in `f64`, by the definition, and how far the fast path drifts from it.

use crate::*;
use ndarray::{Array2, Array3, Axis, Zip};
use sci_forward::testing::moving_square;
use sci_forward::{MaskOperator, MaskStack, Measurement, SensingOperator, VideoShape};
use std::ops::ControlFlow;
use std::sync::Arc;

/// scikit-image's loop, in `f64`, by the definition.
pub(crate) fn tv(image: &Array2<f64>, weight: f64, inner: usize) -> Array2<f64> {
    let (h, w) = image.dim();
    let (mut p0, mut p1) = (Array2::<f64>::zeros((h, w)), Array2::<f64>::zeros((h, w)));
    let mut out = image.clone();
    let (mut first, mut previous) = (0.0, 0.0);
    for step in 0..inner {
        if step > 0 {
            out = Array2::from_shape_fn((h, w), |(i, j)| {
                let up = if i > 0 { p0[[i - 1, j]] } else { 0.0 };
                let left = if j > 0 { p1[[i, j - 1]] } else { 0.0 };
                image[[i, j]] - p0[[i, j]] - p1[[i, j]] + up + left
            });
        }
        let g0 = Array2::from_shape_fn((h, w), |(i, j)| if i + 1 < h { out[[i + 1, j]] - out[[i, j]] } else { 0.0 });
        let g1 = Array2::from_shape_fn((h, w), |(i, j)| if j + 1 < w { out[[i, j + 1]] - out[[i, j]] } else { 0.0 });
        let norm = (&g0 * &g0 + &g1 * &g1).mapv(f64::sqrt);
        let energy = ((&out - image).mapv(|d| d * d).sum() + weight * norm.sum()) / image.len() as f64;
        let shrink = norm.mapv(|n| 1.0 / (1.0 + 0.25 / weight * n));
        p0 = (p0 - 0.25 * g0) * &shrink;
        p1 = (p1 - 0.25 * g1) * &shrink;
        if step == 0 {
            first = energy;
        } else if (previous - energy).abs() < 2e-4 * first {
            break;
        }
        previous = energy;
    }
    out
}

/// Accelerated GAP-TV from the mean. Calls `watch` with v after each iteration.
fn gap_tv(masks: &Array3<f64>, y: &Array2<f64>, weight: f64, iterations: usize, mut watch: impl FnMut(&Array3<f64>)) {
    let forward = |x: &Array3<f64>| (masks * x).sum_axis(Axis(0));
    let gram = (masks * masks).sum_axis(Axis(0));
    let open = masks.sum_axis(Axis(0));
    let measured: Vec<f64> = y.iter().zip(&open).filter(|(_, o)| **o > 0.0).map(|(y, o)| y / o).collect();
    let fill = measured.iter().sum::<f64>() / measured.len() as f64;
    let mean = Zip::from(y).and(&open).map_collect(|&y, &o| if o > 0.0 { y / o } else { fill });
    let mut v = mean.broadcast(masks.dim()).unwrap().to_owned();
    let mut y1 = y.clone();
    for _ in 0..iterations {
        let hv = forward(&v);
        y1 = y1 + y - &hv;
        let step = Zip::from(&y1).and(&hv).and(&gram).map_collect(|&t, &h, &g| if g > 0.0 { (t - h) / g } else { 0.0 });
        let x = &v + &(masks * &step);
        for (mut v, x) in v.outer_iter_mut().zip(x.outer_iter()) {
            v.assign(&tv(&x.to_owned(), weight, 5));
        }
        watch(&v);
    }
}

/// Keeps every estimate of a run.
struct Estimates(Vec<Array3<f32>>);

impl Observer for Estimates {
    fn iteration(&mut self, it: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
        self.0.push(it.estimate.sensor.clone());
        Ok(ControlFlow::Continue(()))
    }
}

/// Root mean square difference between `f32` and `f64` after each of 500 iterations, which must stay at the rounding of one.
/// Printed one JSON object a line, for `cargo xtask stress`.
#[test]
fn the_drift_of_500_iterations_does_not_grow() {
    const ITERATIONS: usize = 500;
    let shape = VideoShape { frames: 8, height: 48, width: 40 };
    let h = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.5, 3).unwrap()));
    let y = h.forward(moving_square(shape).view());
    let mut fast = Estimates(Vec::new());
    let plan = Plan::new([Stage { sigma: None, iterations: ITERATIONS }]);
    let problem = Measurement::new(h.clone(), y.clone()).unwrap();
    run(&mut Gap::accelerated(Tv::new(0.1)), &problem, Start::Mean, &plan, &mut fast).unwrap();

    let mut fast = fast.0.iter();
    let mut worst = 0.0;
    let mut k = 0;
    gap_tv(&h.source().view().mapv(f64::from), &y.mapv(f64::from), f64::from(0.1f32), ITERATIONS, |exact| {
        let ours = fast.next().unwrap();
        let rms = (exact - &ours.mapv(f64::from)).mapv(|d| d * d).mean().unwrap().sqrt();
        k += 1;
        println!(r#"{{"drift":{k},"rms":{rms:e}}}"#);
        worst = f64::max(worst, rms);
    });
    assert!(worst < 1e-6, "{worst:e}");
}
