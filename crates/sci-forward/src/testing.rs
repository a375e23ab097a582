//! Seeded inputs and measures for tests of operators and solvers (feature `testing`).

use crate::{MaskOperator, MaskSource, MaskStack, SensingOperator, VideoShape};
use ndarray::{
    Array, Array3, ArrayView2, ArrayView3, ArrayViewMut2, ArrayViewMut3, Axis, Dimension, ShapeBuilder, Zip, s,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

/// Independent values, uniform in `[0, 1)`.
///
/// ```
/// let values = sci_forward::testing::uniform((100, 100), 0);
/// assert!((values.mean().unwrap() - 0.5).abs() < 0.01);
/// ```
pub fn uniform<D: Dimension, S: ShapeBuilder<Dim = D>>(shape: S, seed: u64) -> Array<f32, D> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    Array::from_shape_simple_fn(shape, || rng.random())
}

/// Independent values of the standard normal distribution.
///
/// ```
/// let values = sci_forward::testing::gaussian((100, 100), 0);
/// assert!(values.mean().unwrap().abs() < 0.03 && (values.var(0.0) - 1.0).abs() < 0.05);
/// ```
pub fn gaussian<D: Dimension, S: ShapeBuilder<Dim = D>>(shape: S, seed: u64) -> Array<f32, D> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    Array::from_shape_simple_fn(shape, || rng.sample(StandardNormal))
}

/// A video `[T, H, W]` in `[0, 1]` that looks like one: a shaded background and a bright square that moves.
///
/// ```
/// use sci_forward::{VideoShape, testing::moving_square};
/// let video = moving_square(VideoShape { frames: 4, height: 24, width: 24 });
/// assert_eq!((video[[0, 6, 6]], video[[3, 9, 9]]), (0.9, 0.9));
/// assert!(video[[3, 6, 6]] < 0.9);
/// ```
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

/// Binary, calibrated, partly closed and signed masks of one shape: the families that every operator test goes through.
///
/// ```
/// use sci_forward::{VideoShape, testing::mask_families};
/// let families = mask_families(VideoShape { frames: 4, height: 5, width: 6 }, 0);
/// assert!(families[0].is_binary() && !families[1].is_binary());
/// assert!(families[2].sum().iter().any(|sum| *sum == 0.0) && families[3].is_signed());
/// ```
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
    let signed = binary.mapv(|c| 2.0 * c - 1.0);
    let families = [binary, float, closed, signed];
    families.map(|masks| MaskStack::new(masks).expect("one value is open, all are in [-1, 1]")).into()
}

/// `|⟨H x, y⟩ − ⟨x, Hᵀ y⟩| / max(‖H x‖ ‖y‖, ‖x‖ ‖Hᵀ y‖)` for random `x` and `y`, summed in `f64`: 0 for an exact adjoint.
///
/// ```
/// use sci_forward::{MaskOperator, VideoShape, testing::{adjoint_gap, mask_families}};
/// for masks in mask_families(VideoShape { frames: 4, height: 5, width: 6 }, 0) {
///     assert!(adjoint_gap(&MaskOperator::new(masks), 1) < 1e-6);
/// }
/// ```
pub fn adjoint_gap(operator: &dyn SensingOperator, seed: u64) -> f64 {
    let shape = operator.shape();
    let (x, y) = (gaussian(shape.dim(), seed), gaussian(shape.image_dim(), seed ^ 1));
    let (hx, hty) = (operator.forward(x.view()), operator.adjoint(y.view()));
    let left = Zip::from(&hx).and(&y).fold(0.0, |s, &a, &b| s + f64::from(a) * f64::from(b));
    let right = Zip::from(&x).and(&hty).fold(0.0, |s, &a, &b| s + f64::from(a) * f64::from(b));
    let scale = (norm(hx.iter()) * norm(y.iter())).max(norm(x.iter()) * norm(hty.iter()));
    (left - right).abs() / scale.max(f64::MIN_POSITIVE)
}

/// Holds a source of masks to its promises: values in -1e9 to 1e9, the same in pieces as in a whole row, and as they are stored.
///
/// # Panics
/// If a promise is broken.
///
/// ```
/// use sci_forward::{MaskStack, VideoShape, testing::check_source};
/// check_source(&MaskStack::random(VideoShape { frames: 2, height: 3, width: 70 }, 0.5, 0)?);
/// # Ok::<(), sci_forward::MaskError>(())
/// ```
pub fn check_source(source: &dyn MaskSource) {
    let (frames, height, width) = source.shape().dim();
    let (mut whole, mut pieces) = (vec![f32::NAN; width], vec![f32::NAN; width]);
    for (frame, row) in (0..frames).flat_map(|t| (0..height).map(move |row| (t, row))) {
        source.fill(frame, row, 0, &mut whole);
        let outside = whole.iter().position(|v| !(-1e9..=1e9).contains(v));
        assert_eq!(outside.map(|column| whole[column]), None, "frame {frame}, row {row}");
        if let Some(stored) = source.stored(frame, row) {
            assert_eq!(stored, whole, "frame {frame}, row {row} as it is stored");
        }
        // Pieces of every length from 1 on.
        let mut start = 0;
        for length in 1.. {
            let end = (start + length).min(width);
            source.fill(frame, row, start, &mut pieces[start..end]);
            start = end;
            if start == width {
                break;
            }
        }
        assert_eq!(pieces, whole, "frame {frame}, row {row} in pieces");
    }
}

/// An operator that masks alone do not make, for tests of what works with any: frame t is moved by t columns, around the edge, then
/// masked and summed, `y[i, j] = Σ_t C_t[i, j] x_t[i, (j + t) mod W]`, as a disperser moves the bands of a spectral camera.
///
/// ```
/// use ndarray::array;
/// use sci_forward::{MaskStack, SensingOperator, testing::Sheared};
/// let h = Sheared::new(MaskStack::new(array![[[1.0, 1.0]], [[1.0, 0.0]]])?);
/// assert_eq!(h.forward(array![[[0.1, 0.2]], [[0.3, 0.4]]].view()), array![[0.5, 0.2]]);
/// assert!(h.masks().is_none());
/// # Ok::<(), sci_forward::MaskError>(())
/// ```
#[derive(Debug, Clone)]
pub struct Sheared(MaskOperator);

impl Sheared {
    /// The operator of these masks.
    pub fn new(masks: MaskStack) -> Self {
        Self(MaskOperator::new(masks))
    }

    /// Moves frame t of `x` by t columns to the left, or to the right.
    fn shear(x: ArrayView3<'_, f32>, mut to: ArrayViewMut3<'_, f32>, to_the_right: bool) {
        let width = x.dim().2;
        for (t, (x, mut to)) in x.outer_iter().zip(to.outer_iter_mut()).enumerate() {
            let first = if to_the_right { width - t % width } else { t % width };
            let parts = ndarray::concatenate(Axis(1), &[x.slice(s![.., first..]), x.slice(s![.., ..first])]);
            to.assign(&parts.expect("two parts of one frame"));
        }
    }
}

impl SensingOperator for Sheared {
    fn shape(&self) -> VideoShape {
        self.0.shape()
    }

    fn forward_into(&self, x: ArrayView3<'_, f32>, y: ArrayViewMut2<'_, f32>) {
        let mut sheared = Array3::zeros(x.dim());
        Self::shear(x, sheared.view_mut(), false);
        self.0.forward_into(sheared.view(), y);
    }

    fn adjoint_into(&self, y: ArrayView2<'_, f32>, x: ArrayViewMut3<'_, f32>) {
        Self::shear(self.0.adjoint(y).view(), x, true);
    }

    fn gram(&self) -> ArrayView2<'_, f32> {
        self.0.gram()
    }
}

fn norm<'a>(values: impl Iterator<Item = &'a f32>) -> f64 {
    values.map(|&v| f64::from(v).powi(2)).sum::<f64>().sqrt()
}
