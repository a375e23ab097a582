//! The operator `H`, its adjoint, and the closed-form data steps that `H Hᵀ` being diagonal allows.
//!
//! Each operation is one pass over the video: a band of rows of every frame is read, summed and written back while it
//! is in cache. Sums run over the frames in order and over the rows in order, so that results are the same for any
//! number of threads.

use crate::{MaskStack, VideoShape};
use multiversion::multiversion;
use ndarray::parallel::prelude::*;
use ndarray::{Array2, Array3, ArrayView2, ArrayView3, ArrayViewMut2, ArrayViewMut3, Axis, Zip};

/// Rows of one parallel task.
const BAND: usize = 16;
/// Columns of a row whose sums are held on the stack, 4 KB of `f32`.
const CHUNK: usize = 1024;
/// A pixel with `Σ C_t²` up to this counts as one that no mask opens: the square root is far below any sensor's noise,
/// and 1 / gram stays finite in `f32`.
pub(crate) const CLOSED: f32 = 1e-30;

/// `H`: a video `[T, H, W]` to a measurement `[H, W]`, with `H Hᵀ` diagonal.
pub trait SensingOperator: Send + Sync {
    /// The size of the video.
    fn shape(&self) -> VideoShape;

    /// `y = H x`: writes `y` `[H, W]` from `x` `[T, H, W]`.
    ///
    /// # Panics
    /// If a size differs from [`SensingOperator::shape`].
    fn forward_into(&self, x: ArrayView3<'_, f32>, y: ArrayViewMut2<'_, f32>);

    /// `x = Hᵀ y`: writes `x` `[T, H, W]` from `y` `[H, W]`.
    ///
    /// # Panics
    /// If a size differs from [`SensingOperator::shape`].
    fn adjoint_into(&self, y: ArrayView2<'_, f32>, x: ArrayViewMut3<'_, f32>);

    /// `diag(H Hᵀ)` `[H, W]`, all ≥ 0. It is 0 where no mask is open; such a pixel is never divided by.
    fn gram_diag(&self) -> ArrayView2<'_, f32>;

    /// Moves `x` `[T, H, W]` towards the measurement in closed form, see [`DataStep`]. Returns `‖y − H x‖²` of the `x` it was given.
    ///
    /// # Panics
    /// If a size differs from [`SensingOperator::shape`].
    fn data_step(&self, step: DataStep<'_>, mut x: ArrayViewMut3<'_, f32>) -> f64 {
        let mut hx = self.forward(x.view());
        let residual = squared_distance(step.y, hx.view());
        let DataStep { y, damping, momentum } = step;
        match momentum {
            Some(mut y1) => Zip::from(&mut hx).and(y).and(&mut y1).for_each(|hx, &y, y1| {
                *y1 += y - *hx;
                *hx = *y1 - *hx;
            }),
            None => hx.zip_mut_with(&y, |hx, &y| *hx = y - *hx),
        }
        hx.zip_mut_with(&self.gram_diag(), |c, &gram| *c = if gram > CLOSED { *c / (gram + damping) } else { 0.0 });
        let mut correction = Array3::zeros(x.dim());
        self.adjoint_into(hx.view(), correction.view_mut());
        x += &correction;
        residual
    }

    /// [`SensingOperator::forward_into`] into a new array.
    fn forward(&self, x: ArrayView3<'_, f32>) -> Array2<f32> {
        let mut y = Array2::zeros(self.shape().image_dim());
        self.forward_into(x, y.view_mut());
        y
    }

    /// [`SensingOperator::adjoint_into`] into a new array.
    fn adjoint(&self, y: ArrayView2<'_, f32>) -> Array3<f32> {
        let mut x = Array3::zeros(self.shape().dim());
        self.adjoint_into(y, x.view_mut());
        x
    }
}

/// A closed-form data step on `x`, the heart of GAP and ADMM:
///
/// ```text
/// x ← x + Hᵀ (t − H x) / (diag(H Hᵀ) + damping)
/// ```
///
/// with the target `t = y`, or with momentum (accelerated GAP) `y1 ← y1 + (y − H x)`, `t = y1`.
/// `damping = 0` projects onto `{x : H x = t}`; `damping = γ > 0` solves `argmin ‖y − H x′‖² + γ‖x′ − x‖²`
/// (paper, Eq. `qv_k+1`). Pixels with `diag(H Hᵀ) = 0` keep their `x`.
#[derive(Debug)]
pub struct DataStep<'a> {
    /// The measurement `[H, W]`.
    pub y: ArrayView2<'a, f32>,
    /// γ ≥ 0.
    pub damping: f32,
    /// The accumulated measurement `y1` `[H, W]` of accelerated GAP, updated in place.
    pub momentum: Option<ArrayViewMut2<'a, f32>>,
}

/// `H` of coded-exposure video: `y = Σ_t C_t ⊙ x_t`, `diag(H Hᵀ) = Σ_t C_t²`.
///
/// ```
/// use ndarray::{Array2, Array3};
/// use sci_forward::{DataStep, MaskOperator, MaskStack, SensingOperator, VideoShape};
///
/// let shape = VideoShape { frames: 4, height: 8, width: 8 };
/// let h = MaskOperator::new(MaskStack::random(shape, 0.9, 1)?);
/// let y = h.forward(Array3::from_elem(shape.dim(), 0.7).view());
/// let mut x = Array3::zeros(shape.dim());
/// h.data_step(DataStep { y: y.view(), damping: 0.0, momentum: None }, x.view_mut());
/// assert!((h.forward(x.view()) - y).iter().all(|d| d.abs() < 1e-5)); // projected: H x = y
/// # Ok::<(), sci_forward::MaskError>(())
/// ```
#[derive(Debug, Clone)]
pub struct MaskOperator {
    masks: MaskStack,
    gram: Array2<f32>,
}

impl MaskOperator {
    /// The operator of these masks.
    pub fn new(masks: MaskStack) -> Self {
        let mut gram = Array2::zeros(masks.shape().image_dim());
        for mask in masks.view().outer_iter() {
            gram.zip_mut_with(&mask, |g, &c| *g += c * c);
        }
        Self { masks, gram }
    }

    /// The masks.
    pub fn masks(&self) -> &MaskStack {
        &self.masks
    }

    #[track_caller]
    fn check(&self, x: (usize, usize, usize), y: (usize, usize)) {
        assert_eq!(x, self.shape().dim(), "the video must have the masks' size");
        assert_eq!(y, self.shape().image_dim(), "the measurement must have the masks' size");
    }
}

impl SensingOperator for MaskOperator {
    fn shape(&self) -> VideoShape {
        self.masks.shape()
    }

    fn forward_into(&self, x: ArrayView3<'_, f32>, mut y: ArrayViewMut2<'_, f32>) {
        self.check(x.dim(), y.dim());
        y.axis_chunks_iter_mut(Axis(0), BAND)
            .into_par_iter()
            .zip(x.axis_chunks_iter(Axis(1), BAND))
            .zip(self.masks.view().axis_chunks_iter(Axis(1), BAND))
            .for_each(|((y, x), c)| forward_band(c, x, y));
    }

    fn adjoint_into(&self, y: ArrayView2<'_, f32>, mut x: ArrayViewMut3<'_, f32>) {
        self.check(x.dim(), y.dim());
        x.axis_chunks_iter_mut(Axis(1), BAND)
            .into_par_iter()
            .zip(y.axis_chunks_iter(Axis(0), BAND))
            .zip(self.masks.view().axis_chunks_iter(Axis(1), BAND))
            .for_each(|((mut x, y), c)| Zip::from(&mut x).and(c).and_broadcast(y).for_each(|x, &c, &y| *x = c * y));
    }

    fn gram_diag(&self) -> ArrayView2<'_, f32> {
        self.gram.view()
    }

    fn data_step(&self, step: DataStep<'_>, mut x: ArrayViewMut3<'_, f32>) -> f64 {
        self.check(x.dim(), step.y.dim());
        let DataStep { y, damping, momentum } = step;
        let masks = self.masks.view();
        let bands = x
            .axis_chunks_iter_mut(Axis(1), BAND)
            .into_par_iter()
            .zip(masks.axis_chunks_iter(Axis(1), BAND).into_par_iter())
            .zip(self.gram.axis_chunks_iter(Axis(0), BAND).into_par_iter())
            .zip(y.axis_chunks_iter(Axis(0), BAND).into_par_iter());
        let residuals: Vec<f64> = match momentum {
            Some(mut y1) => {
                assert_eq!(y1.dim(), y.dim(), "the momentum must have the measurement's size");
                bands
                    .zip(y1.axis_chunks_iter_mut(Axis(0), BAND))
                    .map(|((((x, c), gram), y), y1)| data_step_band(x, c, gram, y, Some(y1), damping))
                    .collect()
            }
            None => bands.map(|(((x, c), gram), y)| data_step_band(x, c, gram, y, None, damping)).collect(),
        };
        residuals.iter().sum()
    }
}

/// `Σ (a − b)²` in `f64`, row by row.
pub(crate) fn squared_distance(a: ArrayView2<'_, f32>, b: ArrayView2<'_, f32>) -> f64 {
    Zip::from(a).and(b).fold(0.0, |sum, &a, &b| sum + f64::from(a - b).powi(2))
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn forward_band(c: ArrayView3<'_, f32>, x: ArrayView3<'_, f32>, mut y: ArrayViewMut2<'_, f32>) {
    y.fill(0.0);
    for (c, x) in c.outer_iter().zip(x.outer_iter()) {
        for ((mut y, c), x) in y.outer_iter_mut().zip(c.outer_iter()).zip(x.outer_iter()) {
            match (y.as_slice_mut(), c.as_slice(), x.as_slice()) {
                (Some(y), Some(c), Some(x)) => y.iter_mut().zip(c.iter().zip(x)).for_each(|(y, (c, x))| *y += c * x),
                _ => Zip::from(&mut y).and(c).and(x).for_each(|y, &c, &x| *y += c * x),
            }
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn data_step_band(
    mut x: ArrayViewMut3<'_, f32>,
    c: ArrayView3<'_, f32>,
    gram: ArrayView2<'_, f32>,
    y: ArrayView2<'_, f32>,
    mut y1: Option<ArrayViewMut2<'_, f32>>,
    damping: f32,
) -> f64 {
    let (frames, rows, width) = x.dim();
    let mut sums = [0f32; CHUNK];
    let mut residual = 0f64;
    for row in 0..rows {
        for start in (0..width).step_by(CHUNK) {
            let columns = ndarray::s![row, start..(start + CHUNK).min(width)];
            let sums = &mut sums[..CHUNK.min(width - start)];
            sums.fill(0.0);
            for t in 0..frames {
                let (c, x) = (c.index_axis(Axis(0), t), x.index_axis(Axis(0), t));
                let (c, x) = (c.slice(columns), x.slice(columns));
                match (c.as_slice(), x.as_slice()) {
                    (Some(c), Some(x)) => sums.iter_mut().zip(c.iter().zip(x)).for_each(|(s, (c, x))| *s += c * x),
                    _ => sums.iter_mut().zip(c.iter().zip(x)).for_each(|(s, (c, x))| *s += c * x),
                }
            }
            let (gram, y) = (gram.slice(columns), y.slice(columns));
            let mut y1 = y1.as_mut().map(|y1| y1.slice_mut(columns));
            for (i, sum) in sums.iter_mut().enumerate() {
                let error = y[i] - *sum;
                residual += f64::from(error).powi(2);
                let target = match &mut y1 {
                    Some(y1) => {
                        y1[i] += error;
                        y1[i] - *sum
                    }
                    None => error,
                };
                *sum = if gram[i] > CLOSED { target / (gram[i] + damping) } else { 0.0 };
            }
            for t in 0..frames {
                let c = c.index_axis(Axis(0), t);
                let c = c.slice(columns);
                let mut x = x.index_axis_mut(Axis(0), t);
                let mut x = x.slice_mut(columns);
                match (x.as_slice_mut(), c.as_slice()) {
                    (Some(x), Some(c)) => x.iter_mut().zip(c.iter().zip(&*sums)).for_each(|(x, (c, s))| *x += c * s),
                    _ => x.iter_mut().zip(c.iter().zip(&*sums)).for_each(|(x, (c, s))| *x += c * s),
                }
            }
        }
    }
    residual
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{adjoint_gap, gaussian, mask_families, uniform};
    use proptest::prelude::*;

    /// `H` by its definition, with the trait's default data step: the oracle.
    struct Naive(MaskOperator);

    impl SensingOperator for Naive {
        fn shape(&self) -> VideoShape {
            self.0.shape()
        }
        fn forward_into(&self, x: ArrayView3<'_, f32>, mut y: ArrayViewMut2<'_, f32>) {
            y.fill(0.0);
            for ((t, i, j), x) in x.indexed_iter() {
                y[[i, j]] += self.0.masks.view()[[t, i, j]] * x;
            }
        }
        fn adjoint_into(&self, y: ArrayView2<'_, f32>, mut x: ArrayViewMut3<'_, f32>) {
            for ((t, i, j), x) in x.indexed_iter_mut() {
                *x = self.0.masks.view()[[t, i, j]] * y[[i, j]];
            }
        }
        fn gram_diag(&self) -> ArrayView2<'_, f32> {
            self.0.gram_diag()
        }
    }

    fn shapes() -> impl Strategy<Value = VideoShape> {
        (1usize..9, 1usize..40, prop_oneof![1usize..40, 1020usize..1030])
            .prop_map(|(frames, height, width)| VideoShape { frames, height, width })
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 40, ..ProptestConfig::default() })]

        #[test]
        fn the_adjoint_is_the_adjoint(shape in shapes(), seed in any::<u64>()) {
            for masks in mask_families(shape, seed) {
                let gap = adjoint_gap(&MaskOperator::new(masks), seed);
                prop_assert!(gap <= 1e-6, "{gap}");
            }
        }

        #[test]
        fn the_fast_path_equals_the_definition(shape in shapes(), seed in any::<u64>(), damping in prop_oneof![Just(0f32), 0.01f32..2.0]) {
            for masks in mask_families(shape, seed) {
                let fast = MaskOperator::new(masks);
                let naive = Naive(fast.clone());
                let (x, y) = (uniform(shape.dim(), seed), gaussian(shape.image_dim(), seed + 1));
                let mut out = Array2::from_elem(shape.image_dim(), f32::NAN);
                fast.forward_into(x.view(), out.view_mut());
                prop_assert_eq!(&out, &naive.forward(x.view()));
                let mut out = Array3::from_elem(shape.dim(), f32::NAN);
                fast.adjoint_into(y.view(), out.view_mut());
                prop_assert_eq!(&out, &naive.adjoint(y.view()));

                for accelerated in [false, true] {
                    let run = |operator: &dyn SensingOperator| {
                        let (mut x, mut y1) = (x.clone(), y.mapv(|v| v * 0.5));
                        let momentum = accelerated.then(|| y1.view_mut());
                        let residual = operator.data_step(DataStep { y: y.view(), damping, momentum }, x.view_mut());
                        (x, y1, residual)
                    };
                    let ((x, y1, residual), (nx, ny1, nresidual)) = (run(&fast), run(&naive));
                    prop_assert_eq!(x, nx);
                    prop_assert_eq!(y1, ny1);
                    prop_assert!((residual - nresidual).abs() <= 1e-9 * nresidual);
                }
            }
        }

        #[test]
        fn a_projected_video_has_the_measurement(shape in shapes(), seed in any::<u64>()) {
            for masks in mask_families(shape, seed) {
                let operator = MaskOperator::new(masks);
                let mut x = uniform(shape.dim(), seed);
                let before = x.clone();
                let y = operator.forward(uniform(shape.dim(), seed + 1).view());
                operator.data_step(DataStep { y: y.view(), damping: 0.0, momentum: None }, x.view_mut());
                let hx = operator.forward(x.view());
                for ((i, j), &gram) in operator.gram_diag().indexed_iter() {
                    if gram > CLOSED {
                        prop_assert!((hx[[i, j]] - y[[i, j]]).abs() <= 2e-6 * y[[i, j]].max(1.0), "{} {}", hx[[i, j]], y[[i, j]]);
                    } else {
                        prop_assert!((0..shape.frames).all(|t| x[[t, i, j]] == before[[t, i, j]]));
                    }
                }
            }
        }
    }

    #[test]
    fn views_that_are_not_contiguous_give_the_same_bits() {
        let shape = VideoShape { frames: 3, height: 20, width: 33 };
        let operator = MaskOperator::new(MaskStack::random(shape, 0.5, 0).unwrap());
        let wide = uniform((3, 40, 66), 1);
        let strided = wide.slice(ndarray::s![.., ..;2, 1..;2]);
        let packed = strided.to_owned();
        assert_eq!(operator.forward(strided), operator.forward(packed.view()));
        let y = gaussian(shape.image_dim(), 2);
        let mut a = wide.clone();
        let mut b = packed.clone();
        operator.data_step(
            DataStep { y: y.view(), damping: 0.1, momentum: None },
            a.slice_mut(ndarray::s![.., ..;2, 1..;2]),
        );
        operator.data_step(DataStep { y: y.view(), damping: 0.1, momentum: None }, b.view_mut());
        assert_eq!(a.slice(ndarray::s![.., ..;2, 1..;2]), b);
    }

    #[test]
    fn the_thread_count_does_not_change_a_bit() {
        let shape = VideoShape { frames: 5, height: 97, width: 61 };
        let operator = MaskOperator::new(MaskStack::random(shape, 0.5, 0).unwrap());
        let y = gaussian(shape.image_dim(), 2);
        let run = |threads| {
            let mut x = uniform(shape.dim(), 1);
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let residual = pool
                .install(|| operator.data_step(DataStep { y: y.view(), damping: 0.0, momentum: None }, x.view_mut()));
            (x, residual.to_bits())
        };
        assert_eq!(run(1), run(2));
        assert_eq!(run(1), run(3));
    }
}
