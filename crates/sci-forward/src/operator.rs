//! The operator `H`, its adjoint, and the closed-form data steps that `H Hᵀ` being diagonal allows.
//!
//! Each operation is one pass over the video: a band of rows of every frame is read, summed and written back while it
//! is in cache. Sums run over the frames in order and over the rows in order, so that results are the same for any
//! number of threads.

use crate::{MaskError, MaskStack, VideoShape};
use multiversion::multiversion;
use ndarray::parallel::prelude::*;
use ndarray::{
    Array2, Array3, ArrayView1, ArrayView2, ArrayView3, ArrayViewMut1, ArrayViewMut2, ArrayViewMut3, Axis, Zip,
};
use std::borrow::Cow;

/// Rows of one parallel task.
const BAND: usize = 16;
/// Columns that are worked on at a time, 1 KB of `f32` a frame.
const CHUNK: usize = 256;
/// Lanes of the explicit sums, so that they vectorise in a fixed order.
const LANES: usize = 16;
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

    /// This operator without the pixels where `measured` `[H, W]` is false: to it they are pixels that no mask opens.
    ///
    /// # Errors
    /// [`MaskError::AllClosed`] if no open pixel is left.
    ///
    /// # Panics
    /// If a size differs from [`SensingOperator::shape`].
    fn restricted_to(&self, measured: ArrayView2<'_, bool>) -> Result<Box<dyn SensingOperator>, MaskError>;

    /// Moves `from` `[T, H, W]` towards the measurement in closed form and writes the result to `to`, see [`DataStep`].
    /// Returns how far `from` is from the measurement and from [`DataStep::previous`].
    ///
    /// # Panics
    /// If a size differs from [`SensingOperator::shape`].
    fn data_step(&self, step: DataStep<'_>, from: ArrayView3<'_, f32>, mut to: ArrayViewMut3<'_, f32>) -> Progress {
        let DataStep { y, damping, momentum, previous } = step;
        let progress = self.progress(y, from, previous.unwrap_or(from));
        let mut hx = self.forward(from);
        match momentum {
            Some(y1) => Zip::from(&mut hx).and(y).and(y1).for_each(|hx, &y, y1| {
                *y1 += y - *hx;
                *hx = *y1 - *hx;
            }),
            None => hx.zip_mut_with(&y, |hx, &y| *hx = y - *hx),
        }
        hx.zip_mut_with(&self.gram_diag(), |c, &gram| *c = if gram > CLOSED { *c / (gram + damping) } else { 0.0 });
        self.adjoint_into(hx.view(), to.view_mut());
        to += &from;
        progress
    }

    /// How far an iterate `x` `[T, H, W]` is from the measurement and from the iterate before it.
    ///
    /// # Panics
    /// If a size differs from [`SensingOperator::shape`].
    fn progress(&self, y: ArrayView2<'_, f32>, x: ArrayView3<'_, f32>, previous: ArrayView3<'_, f32>) -> Progress {
        let hx = self.forward(x);
        let square = |v: f32| f64::from(v).powi(2);
        Progress {
            residual: Zip::from(y).and(&hx).fold(0.0, |sum, &y, &hx| sum + square(y - hx)),
            change: Zip::from(x).and(previous).fold(0.0, |sum, &x, &p| sum + square(x - p)),
            norm: x.fold(0.0, |sum, &x| sum + square(x)),
        }
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

/// Squared norms that tell how a solver gets on.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Progress {
    /// `‖y − H x‖²`.
    pub residual: f64,
    /// `‖x − previous‖²`.
    pub change: f64,
    /// `‖x‖²`. Not finite if a value of `x` is not.
    pub norm: f64,
}

/// A closed-form data step, the heart of GAP and ADMM:
///
/// ```text
/// to = from + Hᵀ (t − H from) / (diag(H Hᵀ) + damping)
/// ```
///
/// with the target `t = y`, or with momentum (accelerated GAP) `y1 ← y1 + (y − H from)`, `t = y1`.
/// `damping = 0` projects onto `{x : H x = t}`; `damping = γ > 0` solves `argmin_x ‖y − H x‖² + γ‖x − from‖²`
/// (paper, Eq. `qv_k+1`). Pixels with `diag(H Hᵀ) = 0` stay as they are.
#[derive(Debug)]
pub struct DataStep<'a> {
    /// The measurement `[H, W]`.
    pub y: ArrayView2<'a, f32>,
    /// γ ≥ 0.
    pub damping: f32,
    /// The accumulated measurement `y1` `[H, W]` of accelerated GAP, in row-major order, updated in place.
    pub momentum: Option<&'a mut Array2<f32>>,
    /// The iterate before `from`, `[T, H, W]`, if its change is wanted.
    pub previous: Option<ArrayView3<'a, f32>>,
}

impl<'a> DataStep<'a> {
    /// The undamped projection onto `{x : H x = y}`.
    pub fn projection(y: ArrayView2<'a, f32>) -> Self {
        Self { y, damping: 0.0, momentum: None, previous: None }
    }
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
/// let start = Array3::zeros(shape.dim());
/// let mut x = start.clone();
/// h.data_step(DataStep::projection(y.view()), start.view(), x.view_mut());
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
            .for_each(|((mut y, x), c)| {
                for (row, y) in y.outer_iter_mut().enumerate() {
                    forward_row(rows_at(c, row), rows_at(x, row), y);
                }
            });
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

    fn restricted_to(&self, measured: ArrayView2<'_, bool>) -> Result<Box<dyn SensingOperator>, MaskError> {
        Ok(Box::new(Self::new(self.masks.clone().restricted_to(measured)?)))
    }

    fn data_step(&self, step: DataStep<'_>, from: ArrayView3<'_, f32>, mut to: ArrayViewMut3<'_, f32>) -> Progress {
        let DataStep { y, damping, momentum, previous } = step;
        let previous = previous.unwrap_or(from);
        self.check(from.dim(), y.dim());
        self.check(to.dim(), y.dim());
        self.check(previous.dim(), y.dim());
        let width = y.ncols();
        let momentum: Vec<Option<&mut [f32]>> = match momentum {
            Some(y1) => {
                assert_eq!(y1.dim(), y.dim(), "the momentum must have the measurement's size");
                let y1 = y1.as_slice_mut().expect("the momentum must be in row-major order");
                y1.chunks_mut(BAND * width).map(Some).collect()
            }
            None => (0..y.nrows().div_ceil(BAND)).map(|_| None).collect(),
        };
        let bands: Vec<Progress> = to
            .axis_chunks_iter_mut(Axis(1), BAND)
            .into_par_iter()
            .zip(from.axis_chunks_iter(Axis(1), BAND))
            .zip(previous.axis_chunks_iter(Axis(1), BAND))
            .zip(self.masks.view().axis_chunks_iter(Axis(1), BAND))
            .zip(self.gram.axis_chunks_iter(Axis(0), BAND))
            .zip(y.axis_chunks_iter(Axis(0), BAND))
            .zip(momentum)
            .map(|((((((mut to, from), previous), c), gram), y), mut y1)| {
                let mut local = Local::new(from.dim().0);
                let rows = 0..y.nrows();
                rows.fold(Progress::default(), |sum, row| {
                    let target = Target { gram: gram.row(row), y: y.row(row), damping };
                    let y1 = y1.as_mut().map(|y1| &mut y1[row * width..][..width]);
                    let to = to.index_axis_mut(Axis(1), row);
                    let video = [rows_at(from, row), rows_at(previous, row)];
                    sum.plus(data_step_row(rows_at(c, row), video, to, target, y1, &mut local))
                })
            })
            .collect();
        bands.into_iter().fold(Progress::default(), Progress::plus)
    }

    fn progress(&self, y: ArrayView2<'_, f32>, x: ArrayView3<'_, f32>, previous: ArrayView3<'_, f32>) -> Progress {
        self.check(x.dim(), y.dim());
        self.check(previous.dim(), y.dim());
        let bands: Vec<Progress> = y
            .axis_chunks_iter(Axis(0), BAND)
            .into_par_iter()
            .zip(x.axis_chunks_iter(Axis(1), BAND))
            .zip(previous.axis_chunks_iter(Axis(1), BAND))
            .zip(self.masks.view().axis_chunks_iter(Axis(1), BAND))
            .map(|(((y, x), previous), c)| {
                let mut hx = vec![0.0; y.ncols()];
                (0..y.nrows()).fold(Progress::default(), |sum, row| {
                    let (x, previous) = (rows_at(x, row), rows_at(previous, row));
                    sum.plus(progress_row(rows_at(c, row), x, previous, y.row(row), &mut hx))
                })
            })
            .collect();
        bands.into_iter().fold(Progress::default(), Progress::plus)
    }
}

impl Progress {
    fn plus(self, o: Self) -> Self {
        Self { residual: self.residual + o.residual, change: self.change + o.change, norm: self.norm + o.norm }
    }
}

/// Row `row` of every frame, `[T, W]`.
fn rows_at(video: ArrayView3<'_, f32>, row: usize) -> ArrayView2<'_, f32> {
    video.index_axis_move(Axis(1), row)
}

/// The measurement's side of a row of a data step.
struct Target<'a> {
    gram: ArrayView1<'a, f32>,
    y: ArrayView1<'a, f32>,
    damping: f32,
}

/// A chunk of a row of the video and of the masks, frame after frame.
///
/// The frames of a video whose size is a power of two lie on the same cache sets; read a second time from their own
/// place, they would have evicted each other.
struct Local {
    video: Vec<f32>,
    masks: Vec<f32>,
}

impl Local {
    fn new(frames: usize) -> Self {
        Self { video: vec![0.0; frames * CHUNK], masks: vec![0.0; frames * CHUNK] }
    }
}

/// `y = Σ_t c_t x_t` of one row; `c` and `x` are `[T, W]`.
fn forward_row(c: ArrayView2<'_, f32>, x: ArrayView2<'_, f32>, mut y: ArrayViewMut1<'_, f32>) {
    y.fill(0.0);
    for (c, x) in c.outer_iter().zip(x.outer_iter()) {
        match (y.as_slice_mut(), c.as_slice(), x.as_slice()) {
            (Some(y), Some(c), Some(x)) => add_product(y, c, x),
            _ => Zip::from(&mut y).and(c).and(x).for_each(|y, &c, &x| *y += c * x),
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn add_product(sum: &mut [f32], a: &[f32], b: &[f32]) {
    for ((sum, a), b) in sum.iter_mut().zip(a).zip(b) {
        *sum += a * b;
    }
}

/// [`SensingOperator::data_step`] of one row; `c`, `from`, `previous` and `to` are `[T, W]`.
fn data_step_row(
    c: ArrayView2<'_, f32>,
    [from, previous]: [ArrayView2<'_, f32>; 2],
    mut to: ArrayViewMut2<'_, f32>,
    target: Target<'_>,
    mut y1: Option<&mut [f32]>,
    local: &mut Local,
) -> Progress {
    let (_, width) = from.dim();
    let (gram, y) = (packed(target.gram), packed(target.y));
    let mut coefficients = [0f32; CHUNK];
    let mut residual = 0.0;
    let mut norms = Norms::default();
    for start in (0..width).step_by(CHUNK) {
        let columns = start..(start + CHUNK).min(width);
        let count = columns.len();
        let coefficients = &mut coefficients[..count];
        coefficients.fill(0.0);
        for (t, ((x, previous), c)) in from.outer_iter().zip(previous.outer_iter()).zip(c.outer_iter()).enumerate() {
            let (x, previous, c) = (packed(x), packed(previous), packed(c));
            let (x, c) = (&x[columns.clone()], &c[columns.clone()]);
            local.video[t * count..][..count].copy_from_slice(x);
            local.masks[t * count..][..count].copy_from_slice(c);
            add_progress(coefficients, c, x, &previous[columns.clone()], &mut norms);
        }
        let (y, gram) = (&y[columns.clone()], &gram[columns.clone()]);
        residual += match &mut y1 {
            None => coefficients_of(coefficients, y, gram, target.damping),
            Some(y1) => accelerated_coefficients(coefficients, y, gram, target.damping, &mut y1[columns.clone()]),
        };
        for (t, mut to) in to.outer_iter_mut().enumerate() {
            let (video, masks) = (&local.video[t * count..][..count], &local.masks[t * count..][..count]);
            match to.as_slice_mut() {
                Some(to) => write_sum(&mut to[columns.clone()], video, masks, coefficients),
                None => {
                    let sums = video.iter().zip(masks.iter().zip(&*coefficients)).map(|(x, (c, v))| x + c * v);
                    to.iter_mut().skip(start).zip(sums).for_each(|(to, sum)| *to = sum);
                }
            }
        }
    }
    norms.progress(residual)
}

/// `to = x + c v`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn write_sum(to: &mut [f32], x: &[f32], c: &[f32], v: &[f32]) {
    for (((to, x), c), v) in to.iter_mut().zip(x).zip(c).zip(v) {
        *to = x + c * v;
    }
}

/// Turns `H x` of a chunk into `(y − H x) / (gram + damping)`. Returns `Σ (y − H x)²`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn coefficients_of(hx: &mut [f32], y: &[f32], gram: &[f32], damping: f32) -> f64 {
    let residual = squared_distance(hx, y);
    for ((hx, y), gram) in hx.iter_mut().zip(y).zip(gram) {
        *hx = if *gram > CLOSED { (y - *hx) / (gram + damping) } else { 0.0 };
    }
    residual
}

/// As [`coefficients_of`], but adds `y − H x` to `y1` and aims at that.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn accelerated_coefficients(hx: &mut [f32], y: &[f32], gram: &[f32], damping: f32, y1: &mut [f32]) -> f64 {
    let residual = squared_distance(hx, y);
    for (((hx, y), gram), y1) in hx.iter_mut().zip(y).zip(gram).zip(y1) {
        *y1 += y - *hx;
        *hx = if *gram > CLOSED { (*y1 - *hx) / (gram + damping) } else { 0.0 };
    }
    residual
}

/// `Σ (a − b)²` over lanes.
#[inline(always)]
fn squared_distance(a: &[f32], b: &[f32]) -> f64 {
    let mut sums = [0f32; LANES];
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    for (a, b) in a.iter().zip(b) {
        for lane in 0..LANES {
            sums[lane] += (a[lane] - b[lane]) * (a[lane] - b[lane]);
        }
    }
    for (lane, (a, b)) in a_rest.iter().zip(b_rest).enumerate() {
        sums[lane] += (a - b) * (a - b);
    }
    sums.iter().map(|&v| f64::from(v)).sum()
}

/// The numbers as a slice, copied only if they are not one already.
fn packed(row: ArrayView1<'_, f32>) -> Cow<'_, [f32]> {
    match row.to_slice() {
        Some(row) => Cow::Borrowed(row),
        None => Cow::Owned(row.to_vec()),
    }
}

/// [`SensingOperator::progress`] of one row; `c`, `x` and `previous` are `[T, W]`, and `hx` is scratch.
fn progress_row(
    c: ArrayView2<'_, f32>,
    x: ArrayView2<'_, f32>,
    previous: ArrayView2<'_, f32>,
    y: ArrayView1<'_, f32>,
    hx: &mut [f32],
) -> Progress {
    hx.fill(0.0);
    let mut norms = Norms::default();
    for ((c, x), previous) in c.outer_iter().zip(x.outer_iter()).zip(previous.outer_iter()) {
        add_progress(hx, &packed(c), &packed(x), &packed(previous), &mut norms);
    }
    norms.progress(squared_distance(hx, &packed(y)))
}

/// Sums of `(x − previous)²` and of `x²` over lanes.
#[derive(Default)]
struct Norms {
    change: [f32; LANES],
    norm: [f32; LANES],
}

impl Norms {
    fn progress(&self, residual: f64) -> Progress {
        let sum = |lanes: &[f32; LANES]| lanes.iter().map(|&v| f64::from(v)).sum();
        Progress { residual, change: sum(&self.change), norm: sum(&self.norm) }
    }
}

/// Adds `c x` to `hx`, and to the norms, all in one reading of `x`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn add_progress(hx: &mut [f32], c: &[f32], x: &[f32], previous: &[f32], norms: &mut Norms) {
    let ((hx, hx_rest), (c, c_rest)) = (hx.as_chunks_mut::<LANES>(), c.as_chunks::<LANES>());
    let ((x, x_rest), (previous, previous_rest)) = (x.as_chunks::<LANES>(), previous.as_chunks::<LANES>());
    let Norms { mut change, mut norm } = *norms;
    for (((hx, c), x), previous) in hx.iter_mut().zip(c).zip(x).zip(previous) {
        for lane in 0..LANES {
            hx[lane] += c[lane] * x[lane];
            change[lane] += (x[lane] - previous[lane]) * (x[lane] - previous[lane]);
            norm[lane] += x[lane] * x[lane];
        }
    }
    for (lane, (((hx, c), x), previous)) in hx_rest.iter_mut().zip(c_rest).zip(x_rest).zip(previous_rest).enumerate() {
        *hx += c * x;
        change[lane] += (x - previous) * (x - previous);
        norm[lane] += x * x;
    }
    *norms = Norms { change, norm };
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
        fn restricted_to(&self, measured: ArrayView2<'_, bool>) -> Result<Box<dyn SensingOperator>, MaskError> {
            Ok(Box::new(Self(MaskOperator::new(self.0.masks.clone().restricted_to(measured)?))))
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

                let previous = uniform(shape.dim(), seed + 2);
                let close = |a: Progress, b: Progress| {
                    [(a.residual, b.residual), (a.change, b.change), (a.norm, b.norm)]
                        .iter()
                        .all(|(a, b)| (a - b).abs() <= 1e-5 * b)
                };
                for accelerated in [false, true] {
                    let run = |operator: &dyn SensingOperator| {
                        let (mut to, mut y1) = (x.mapv(|_| f32::NAN), y.mapv(|v| v * 0.5));
                        let momentum = accelerated.then_some(&mut y1);
                        let step = DataStep { y: y.view(), damping, momentum, previous: Some(previous.view()) };
                        let progress = operator.data_step(step, x.view(), to.view_mut());
                        (to, y1, progress)
                    };
                    let ((to, y1, progress), (naive_to, naive_y1, naive_progress)) = (run(&fast), run(&naive));
                    prop_assert_eq!(to, naive_to);
                    prop_assert_eq!(y1, naive_y1);
                    prop_assert!(close(progress, naive_progress), "{progress:?} {naive_progress:?}");
                }
                let progress = |h: &dyn SensingOperator| h.progress(y.view(), x.view(), previous.view());
                prop_assert!(close(progress(&fast), progress(&naive)));
            }
        }

        #[test]
        fn a_projected_video_has_the_measurement(shape in shapes(), seed in any::<u64>()) {
            for masks in mask_families(shape, seed) {
                let operator = MaskOperator::new(masks);
                let before = uniform(shape.dim(), seed);
                let mut x = before.clone();
                let y = operator.forward(uniform(shape.dim(), seed + 1).view());
                operator.data_step(DataStep::projection(y.view()), before.view(), x.view_mut());
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
        let step = || DataStep { damping: 0.1, ..DataStep::projection(y.view()) };
        operator.data_step(step(), strided, a.slice_mut(ndarray::s![.., ..;2, 1..;2]));
        operator.data_step(step(), packed.view(), b.view_mut());
        assert_eq!(operator.progress(y.view(), strided, strided), operator.progress(y.view(), packed.view(), strided));
        assert_eq!(a.slice(ndarray::s![.., ..;2, 1..;2]), b);
    }

    #[test]
    fn the_thread_count_does_not_change_a_bit() {
        let shape = VideoShape { frames: 5, height: 97, width: 61 };
        let operator = MaskOperator::new(MaskStack::random(shape, 0.5, 0).unwrap());
        let y = gaussian(shape.image_dim(), 2);
        let run = |threads| {
            let from = uniform(shape.dim(), 1);
            let mut x = from.clone();
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let step = DataStep::projection(y.view());
                let before = operator.data_step(step, from.view(), x.view_mut());
                let after = operator.progress(y.view(), x.view(), from.view());
                let bits = |p: Progress| [p.residual, p.change, p.norm].map(f64::to_bits);
                (x, bits(before), bits(after))
            })
        };
        assert_eq!(run(1), run(2));
        assert_eq!(run(1), run(3));
    }
}
