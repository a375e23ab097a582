//! Seeded noise, and the inputs that networks are trained and validated with.

use crate::ddnet::sparse_rgb;
use ndarray::{Array3, Array4, ArrayView4, Axis};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use sci_forward::CfaPattern;

/// Adds white Gaussian noise of standard deviation `sigma` (on the scale of the frames).
pub(super) fn add_noise(video: &mut Array4<f32>, sigma: f32, rng: &mut impl Rng) {
    for v in video.iter_mut() {
        let n: f32 = StandardNormal.sample(rng);
        *v += sigma * n;
    }
}

/// RGB frames `[T, 3, H, W]` as an RGGB sensor sees them, sparse RGB; noise included, as it is on the sensor.
pub(super) fn sensor(rgb: ArrayView4<'_, f32>) -> Array4<f32> {
    sparse_rgb(CfaPattern::Rggb, mosaic(rgb).view())
}

/// The RGGB mosaic `[T, H, W]`.
fn mosaic(rgb: ArrayView4<'_, f32>) -> Array3<f32> {
    let dim = (rgb.len_of(Axis(0)), rgb.len_of(Axis(2)), rgb.len_of(Axis(3)));
    Array3::from_shape_fn(dim, |(t, y, x)| rgb[[t, CfaPattern::Rggb.color_at(y, x) as usize, y, x]])
}
