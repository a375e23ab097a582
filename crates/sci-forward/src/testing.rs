//! Seeded inputs and measures for tests of operators and solvers (feature `testing`).

use crate::{MaskStack, SensingOperator, VideoShape};
use ndarray::{Array, Array3, Dimension, ShapeBuilder, Zip};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

/// Independent values, uniform in `[0, 1)`.
pub fn uniform<D: Dimension, S: ShapeBuilder<Dim = D>>(shape: S, seed: u64) -> Array<f32, D> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    Array::from_shape_simple_fn(shape, || rng.random())
}

/// Independent values of the standard normal distribution.
pub fn gaussian<D: Dimension, S: ShapeBuilder<Dim = D>>(shape: S, seed: u64) -> Array<f32, D> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    Array::from_shape_simple_fn(shape, || rng.sample(StandardNormal))
}

/// A video `[T, H, W]` in `[0, 1]` that looks like one: a shaded background and a bright square that moves.
pub fn moving_square(shape: VideoShape) -> Array3<f32> {
    let (_, height, width) = shape.dim();
    let side = (height.min(width) / 3).max(1);
    Array3::from_shape_fn(shape.dim(), |(t, i, j)| {
        let (top, left) = (height / 4 + t, width / 4 + t);
        if (top..top + side).contains(&i) && (left..left + side).contains(&j) {
            0.9
        } else {
            0.2 + 0.4 * (i + j) as f32 / (height + width) as f32
        }
    })
}

/// Binary, calibrated and partly closed masks of one shape: the families that every operator test goes through.
///
/// # Panics
/// If the shape is empty.
pub fn mask_families(shape: VideoShape, seed: u64) -> Vec<MaskStack> {
    let float = uniform(shape.dim(), seed);
    // Two thirds of the pixels are closed in every frame, but the first never is.
    let closed = Array3::from_shape_fn(shape.dim(), |(t, i, j)| {
        if (i, j) == (0, 0) || (i * 7 + j) % 3 == 0 { float[[t, i, j]].max(0.1) } else { 0.0 }
    });
    let mut binary = float.mapv(|v| v.round());
    binary[[0, 0, 0]] = 1.0;
    let mut float = float;
    float[[0, 0, 0]] = 0.5;
    [binary, float, closed].map(|masks| MaskStack::new(masks).expect("one value is open, all are in [0, 1]")).into()
}

/// `|⟨H x, y⟩ − ⟨x, Hᵀ y⟩| / max(‖H x‖ ‖y‖, ‖x‖ ‖Hᵀ y‖)` for random `x` and `y`, summed in `f64`: 0 for an exact adjoint.
pub fn adjoint_gap(operator: &dyn SensingOperator, seed: u64) -> f64 {
    let shape = operator.shape();
    let (x, y) = (gaussian(shape.dim(), seed), gaussian(shape.image_dim(), seed ^ 1));
    let (hx, hty) = (operator.forward(x.view()), operator.adjoint(y.view()));
    let left = Zip::from(&hx).and(&y).fold(0.0, |s, &a, &b| s + f64::from(a) * f64::from(b));
    let right = Zip::from(&x).and(&hty).fold(0.0, |s, &a, &b| s + f64::from(a) * f64::from(b));
    let scale = (norm(hx.iter()) * norm(y.iter())).max(norm(x.iter()) * norm(hty.iter()));
    (left - right).abs() / scale.max(f64::MIN_POSITIVE)
}

fn norm<'a>(values: impl Iterator<Item = &'a f32>) -> f64 {
    values.map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt()
}
