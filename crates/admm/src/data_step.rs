//! The closed-form data step that `H Hᵀ` being diagonal allows, in one pass over the video.
//!
//! A band of rows of every frame is read, summed and written back while it is in cache. Sums run over the frames in order and over
//! the rows in order, so that results are the same for any number of threads. An operator that is not made of masks
//! ([`SensingOperator::masks`](sci_forward::SensingOperator::masks)) takes the same step by its `forward` and `adjoint`.

use multiversion::multiversion;
use ndarray::parallel::prelude::*;
use ndarray::{Array2, ArrayView1, ArrayView2, ArrayView3, ArrayViewMut2, ArrayViewMut3, Axis, Zip};
use sci_forward::{MaskSource, Measurement};
use std::borrow::Cow;
use std::ops::Range;

/// Rows of one parallel task.
const BAND: usize = 16;
/// Columns that are worked on at a time, 1 KB of `f32` a frame.
const CHUNK: usize = 256;
/// Lanes of the explicit sums, so that they vectorise in a fixed order.
const LANES: usize = 16;

/// Squared norms that tell how a solver gets on.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Progress {
    /// `‖y − H x‖²` over the pixels that a mask opens.
    pub residual: f64,
    /// `‖x − previous‖²`.
    pub change: f64,
    /// `‖x‖²`. Not finite if a value of `x` is not.
    pub norm: f64,
}

impl Progress {
    fn plus(self, o: Self) -> Self {
        Self { residual: self.residual + o.residual, change: self.change + o.change, norm: self.norm + o.norm }
    }
}

/// A closed-form data step, the heart of GAP and ADMM:
///
/// ```text
/// to = from + Hᵀ (t − H p) / (diag(H Hᵀ) + damping + precision · variance)
/// ```
///
/// with the target `t = y`, or with momentum (accelerated GAP) `y1 ← y1 + s (y − H from)`, `t = y1`, at the point `p = from`, s being
/// diag(H Hᵀ) over the divisor, or with a mirror z (ADMM) `p = 2 from − z`. `damping = 0` with `p = from` projects onto `{x : H x = t}`; `damping = γ > 0` solves
/// `argmin_x ‖y − H x‖² + γ‖x − from‖²` (paper, Eq. `qv_k+1`). With the variance n of the measurement's noise
/// ([`Measurement::variance`]) and `from` known to a variance of s², `precision = 1/s²` gives the likeliest x,
/// `argmin_x Σ (y − H x)²/n + ‖x − from‖²/s²`. A clipped pixel ([`Measurement::with_clip`]) is left alone by a video that gives it as
/// much light as it measures, or more. Pixels with `diag(H Hᵀ) = 0` stay as they are.
///
/// ```
/// use std::sync::Arc;
/// use admm::DataStep;
/// use admm::sci_forward::{MaskOperator, MaskStack, Measurement, SensingOperator, VideoShape};
/// use ndarray::Array3;
///
/// let shape = VideoShape { frames: 4, height: 8, width: 8 };
/// let h = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.9, 1)?));
/// let measurement = Measurement::new(h.clone(), h.forward(Array3::from_elem(shape.dim(), 0.7).view()))?;
/// let start = Array3::zeros(shape.dim());
/// let mut x = start.clone();
/// DataStep::default().apply(&measurement, start.view(), x.view_mut());
/// let gap = h.forward(x.view()) - measurement.y(); // projected: H x = y
/// assert!(x.sum() > 0.0 && gap.iter().all(|d| d.abs() < 1e-5));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Default)]
pub struct DataStep<'a> {
    /// γ ≥ 0, in the unit of `diag(H Hᵀ)`.
    pub damping: f32,
    /// How well `from` is known, 1/s² ≥ 0; of no account where no noise is known of.
    pub precision: f32,
    /// The accumulated measurement `y1` `[H, W]` of accelerated GAP, in row-major order, updated in place.
    pub momentum: Option<&'a mut Array2<f32>>,
    /// z `[T, H, W]`, if the step is taken at `2 from − z`.
    pub mirror: Option<ArrayView3<'a, f32>>,
    /// The iterate before `from`, `[T, H, W]`, if its change is wanted.
    pub previous: Option<ArrayView3<'a, f32>>,
}

impl DataStep<'_> {
    /// Takes the step from `from` `[T, H, W]` and writes the result to `to`. Returns how far `from` is from the measurement and from
    /// [`DataStep::previous`].
    ///
    /// # Panics
    /// If a size differs from that of the measurement, or the momentum is not in row-major order.
    pub fn apply(self, measurement: &Measurement, from: ArrayView3<'_, f32>, to: ArrayViewMut3<'_, f32>) -> Progress {
        let (video, image) = (measurement.shape().dim(), measurement.shape().image_dim());
        let views = [Some(from), Some(to.view()), self.mirror, self.previous];
        assert!(views.iter().flatten().all(|v| v.dim() == video), "a video must have the masks' size, {video:?}");
        assert!(self.momentum.as_ref().is_none_or(|y1| y1.dim() == image), "the momentum must have y's size {image:?}");
        match measurement.operator().masks() {
            Some(masks) => self.fused(measurement, masks, from, to),
            None => self.by_operator(measurement, from, to),
        }
    }

    /// One pass over all videos.
    fn fused(
        self,
        measurement: &Measurement,
        masks: &dyn MaskSource,
        from: ArrayView3<'_, f32>,
        mut to: ArrayViewMut3<'_, f32>,
    ) -> Progress {
        let Self { damping, precision, momentum, mirror, previous } = self;
        let variance = measurement.variance().filter(|_| precision > 0.0);
        let previous = previous.unwrap_or(from);
        let (y, gram, width) = (measurement.y(), measurement.operator().gram(), measurement.shape().width);
        let frames = from.dim().0;
        let momentum = rows_of(momentum, y.nrows(), width);
        let bands: Vec<Progress> = to
            .axis_chunks_iter_mut(Axis(1), BAND)
            .into_par_iter()
            .zip(momentum)
            .enumerate()
            .map(|(band, (mut to, mut y1))| {
                let mut chunk = Chunk::new(frames, mirror.is_some());
                let mut sum = Progress::default();
                for (i, to) in to.axis_iter_mut(Axis(1)).enumerate() {
                    let row = band * BAND + i;
                    let row = Row {
                        masks,
                        row,
                        from: rows_at(from, row),
                        previous: rows_at(previous, row),
                        mirror: mirror.map(|z| rows_at(z, row)),
                        target: Target {
                            gram: packed(gram.row(row)),
                            y: packed(y.row(row)),
                            measurement,
                            variance: variance.map(|variance| packed(variance.index_axis_move(Axis(0), row))),
                            damping,
                            precision,
                        },
                    };
                    let y1 = y1.as_mut().map(|y1| &mut y1[i * width..][..width]);
                    sum = sum.plus(row.step(to, y1, &mut chunk));
                }
                sum
            })
            .collect();
        bands.into_iter().fold(Progress::default(), Progress::plus)
    }

    /// The definition, for operators that are not made of masks.
    fn by_operator(
        self,
        measurement: &Measurement,
        from: ArrayView3<'_, f32>,
        mut to: ArrayViewMut3<'_, f32>,
    ) -> Progress {
        let Self { damping, precision, momentum, mirror, previous } = self;
        let operator = measurement.operator();
        let progress = progress(measurement, from, previous.unwrap_or(from));
        let mut h = operator.forward(from);
        let point = match mirror {
            Some(z) => &h * 2.0 - operator.forward(z),
            None => h.clone(),
        };
        let level = measurement.clip();
        let mut divisor = operator.gram().mapv(|gram| if gram > 0.0 { gram + damping } else { f32::INFINITY });
        if let Some(variance) = measurement.variance() {
            divisor.zip_mut_with(&variance, |divisor, &variance| *divisor += precision * variance);
        }
        let of_all = Zip::from(&mut h).and(measurement.y()).and(&point);
        match momentum {
            Some(y1) => {
                let share = &operator.gram() / &divisor;
                of_all.and(y1).and(&share).for_each(|h, &y, &point, y1, &share| {
                    *h = difference(point, y, Some((y1, share)), level);
                });
            }
            None => of_all.for_each(|h, &y, &point| *h = difference(point, y, None, level)),
        }
        h /= &divisor;
        operator.adjoint_into(h.view(), to.view_mut());
        Zip::from(&mut to).and(from).par_for_each(|to, &from| *to += from);
        progress
    }
}

/// The rows of each band of an image in row-major order, or nothing for each.
fn rows_of(image: Option<&mut Array2<f32>>, height: usize, width: usize) -> Vec<Option<&mut [f32]>> {
    match image {
        Some(image) => {
            let rows = image.as_slice_mut().expect("the momentum must be in row-major order");
            rows.chunks_mut(BAND * width).map(Some).collect()
        }
        None => (0..height.div_ceil(BAND)).map(|_| None).collect(),
    }
}

/// How far an iterate `x` `[T, H, W]` is from the measurement and from the iterate before it.
///
/// # Panics
/// If a size differs from that of the measurement.
pub fn progress(measurement: &Measurement, x: ArrayView3<'_, f32>, previous: ArrayView3<'_, f32>) -> Progress {
    let video = measurement.shape().dim();
    assert!(x.dim() == video && previous.dim() == video, "a video must have the masks' size, {video:?}");
    let (operator, y) = (measurement.operator(), measurement.y());
    let (gram, masks) = (operator.gram(), operator.masks());
    // Without masks H x is made whole beforehand.
    let whole = masks.is_none().then(|| operator.forward(x));
    let width = y.ncols();
    let bands: Vec<Progress> = (0..y.nrows().div_ceil(BAND))
        .into_par_iter()
        .map(|band| {
            let (mut hx, mut c) = (vec![0.0; width], vec![0.0; width]);
            let mut sum = Progress::default();
            for row in band * BAND..((band + 1) * BAND).min(y.nrows()) {
                hx.fill(0.0);
                let mut norms = Norms::default();
                for (frame, (x, previous)) in
                    rows_at(x, row).outer_iter().zip(rows_at(previous, row).outer_iter()).enumerate()
                {
                    if let Some(masks) = masks {
                        masks.fill(frame, row, 0, &mut c);
                    }
                    add_progress(&mut hx, &c, &packed(x), &packed(previous), &mut norms);
                }
                if let Some(whole) = &whole {
                    hx.iter_mut().zip(whole.row(row)).for_each(|(hx, &whole)| *hx = whole);
                }
                let mut y = packed(y.row(row));
                if measurement.clip().is_some() {
                    measurement.one_sided(y.to_mut(), &hx);
                }
                sum = sum.plus(norms.progress(squared_residual(&hx, &y, &packed(gram.row(row)))));
            }
            sum
        })
        .collect();
    bands.into_iter().fold(Progress::default(), Progress::plus)
}

/// Row `row` of every frame, `[T, W]`.
fn rows_at(video: ArrayView3<'_, f32>, row: usize) -> ArrayView2<'_, f32> {
    video.index_axis_move(Axis(1), row)
}

/// The measurement's side of a row.
struct Target<'a> {
    gram: Cow<'a, [f32]>,
    y: Cow<'a, [f32]>,
    measurement: &'a Measurement,
    variance: Option<Cow<'a, [f32]>>,
    damping: f32,
    precision: f32,
}

/// What the step of one row reads; the videos' rows are `[T, W]`.
struct Row<'a> {
    masks: &'a dyn MaskSource,
    row: usize,
    from: ArrayView2<'a, f32>,
    previous: ArrayView2<'a, f32>,
    mirror: Option<ArrayView2<'a, f32>>,
    target: Target<'a>,
}

/// A chunk of a row of the video and of the masks, frame after frame, and of the sums over the frames.
///
/// The frames of a video whose size is a power of two lie on the same cache sets; read a second time from their own
/// place, they would have evicted each other.
struct Chunk {
    video: Vec<f32>,
    masks: Vec<f32>,
    /// `H from`, then what is added of the masks.
    hx: Vec<f32>,
    /// `H z`.
    hz: Option<Vec<f32>>,
    /// What the difference to the target is divided by.
    divisor: Vec<f32>,
    /// y, one-sided where it is clipped.
    y: Vec<f32>,
}

impl Chunk {
    fn new(frames: usize, mirrored: bool) -> Self {
        let (video, masks) = (vec![0.0; frames * CHUNK], vec![0.0; frames * CHUNK]);
        let row = || vec![0.0; CHUNK];
        Self { video, masks, hx: row(), hz: mirrored.then(row), divisor: row(), y: row() }
    }
}

impl Row<'_> {
    /// Writes the row of every frame to `to` `[T, W]`.
    fn step(&self, mut to: ArrayViewMut2<'_, f32>, mut y1: Option<&mut [f32]>, chunk: &mut Chunk) -> Progress {
        let width = self.from.ncols();
        let mut residual = 0.0;
        let mut norms = Norms::default();
        for start in (0..width).step_by(CHUNK) {
            let columns = start..(start + CHUNK).min(width);
            let count = columns.len();
            self.read(start, count, chunk, &mut norms);
            let Target { gram, y, measurement, .. } = &self.target;
            let (gram, y) = (&gram[columns.clone()], &y[columns.clone()]);
            let (hx, divisor) = (&mut chunk.hx[..count], &mut chunk.divisor[..count]);
            self.target.divisor(columns.clone(), divisor);
            if let Some(level) = measurement.clip() {
                chunk.y[..count].copy_from_slice(y);
                measurement.one_sided(&mut chunk.y[..count], hx);
                residual += squared_residual(hx, &chunk.y[..count], gram);
                let y1 = y1.as_deref_mut().map(|y1| &mut y1[columns.clone()]);
                let hz = chunk.hz.as_ref().map(|hz| &hz[..count]);
                one_sided_coefficients(hx, hz, y, y1, gram, level, divisor);
            } else {
                residual += squared_residual(hx, y, gram);
                self.whole_coefficients(columns.clone(), hx, chunk.hz.as_deref(), y1.as_deref_mut(), divisor);
            }
            for (t, mut to) in to.outer_iter_mut().enumerate() {
                let (video, masks) = (&chunk.video[t * count..][..count], &chunk.masks[t * count..][..count]);
                match to.as_slice_mut() {
                    Some(to) => write_sum(&mut to[columns.clone()], video, masks, hx),
                    None => {
                        let sums = video.iter().zip(masks.iter().zip(&*hx)).map(|(x, (c, v))| x + c * v);
                        to.iter_mut().skip(start).zip(sums).for_each(|(to, sum)| *to = sum);
                    }
                }
            }
        }
        norms.progress(residual)
    }

    /// What the masks are multiplied with, of a sensor that does not clip, in the place of `H from`.
    fn whole_coefficients(
        &self,
        columns: Range<usize>,
        hx: &mut [f32],
        hz: Option<&[f32]>,
        y1: Option<&mut [f32]>,
        divisor: &[f32],
    ) {
        let (y, gram) = (&self.target.y[columns.clone()], &self.target.gram[columns.clone()]);
        match (y1, hz) {
            (Some(y1), _) => accelerated_coefficients(hx, y, gram, divisor, &mut y1[columns]),
            (None, Some(hz)) => mirrored_coefficients(hx, &hz[..y.len()], y, divisor),
            (None, None) => coefficients(hx, y, divisor),
        }
    }

    /// Copies `count` columns of all frames and masks, and sums them up.
    fn read(&self, start: usize, count: usize, chunk: &mut Chunk, norms: &mut Norms) {
        let Chunk { video, masks, hx, hz, .. } = chunk;
        hx.fill(0.0);
        for (t, (x, previous)) in self.from.outer_iter().zip(self.previous.outer_iter()).enumerate() {
            let (x, previous) = (packed(x), packed(previous));
            let (local, c) = (&mut video[t * count..][..count], &mut masks[t * count..][..count]);
            local.copy_from_slice(&x[start..][..count]);
            self.masks.fill(t, self.row, start, c);
            add_progress(&mut hx[..count], c, local, &previous[start..][..count], norms);
        }
        if let (Some(hz), Some(mirror)) = (hz, self.mirror) {
            hz.fill(0.0);
            for (t, z) in mirror.outer_iter().enumerate() {
                add_product(&mut hz[..count], &masks[t * count..][..count], &packed(z)[start..][..count]);
            }
        }
    }
}

/// `sum += a b`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn add_product(sum: &mut [f32], a: &[f32], b: &[f32]) {
    for ((sum, a), b) in sum.iter_mut().zip(a).zip(b) {
        *sum += a * b;
    }
}

/// `to = x + c v`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn write_sum(to: &mut [f32], x: &[f32], c: &[f32], v: &[f32]) {
    for (((to, x), c), v) in to.iter_mut().zip(x).zip(c).zip(v) {
        *to = x + c * v;
    }
}

impl Target<'_> {
    /// `gram + damping + precision · variance` of some columns; infinite where no mask is open, so that nothing is added.
    fn divisor(&self, columns: Range<usize>, to: &mut [f32]) {
        let gram = &self.gram[columns.clone()];
        match &self.variance {
            Some(variance) => noisy_divisor(gram, self.damping, &variance[columns], self.precision, to),
            None => divisor(gram, self.damping, to),
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn divisor(gram: &[f32], damping: f32, to: &mut [f32]) {
    for (to, gram) in to.iter_mut().zip(gram) {
        *to = if *gram > 0.0 { gram + damping } else { f32::INFINITY };
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn noisy_divisor(gram: &[f32], damping: f32, variance: &[f32], precision: f32, to: &mut [f32]) {
    for ((to, gram), variance) in to.iter_mut().zip(gram).zip(variance) {
        *to = if *gram > 0.0 { gram + damping + precision * variance } else { f32::INFINITY };
    }
}

/// [`difference`] over the divisor, of a sensor that clips at `level`.
fn one_sided_coefficients(
    hx: &mut [f32],
    hz: Option<&[f32]>,
    y: &[f32],
    mut y1: Option<&mut [f32]>,
    gram: &[f32],
    level: f32,
    divisor: &[f32],
) {
    for i in 0..hx.len() {
        let point = hz.map_or(hx[i], |hz| 2.0 * hx[i] - hz[i]);
        let y1 = y1.as_deref_mut().map(|y1| (&mut y1[i], gram[i] / divisor[i]));
        hx[i] = difference(point, y[i], y1, Some(level)) / divisor[i];
    }
}

/// `t − H p` of a pixel, whose y1 adds up a share of `y − H p`; what a clipped pixel asks for, and what it has asked for in y1 beyond y,
/// is never negative: a constraint `H x ≥ y` and its multiplier.
fn difference(point: f32, y: f32, y1: Option<(&mut f32, f32)>, level: Option<f32>) -> f32 {
    let clipped = level.is_some_and(|level| y >= level);
    let one_sided = |v: f32| if clipped { v.max(0.0) } else { v };
    let Some((y1, share)) = y1 else { return one_sided(y - point) };
    *y1 += share * (y - point);
    *y1 = if clipped { y1.max(y) } else { *y1 };
    one_sided(*y1 - point)
}

/// Turns `H x` of a chunk into `(y − H x) / divisor`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn coefficients(hx: &mut [f32], y: &[f32], divisor: &[f32]) {
    for ((hx, y), divisor) in hx.iter_mut().zip(y).zip(divisor) {
        *hx = (y - *hx) / divisor;
    }
}

/// As [`coefficients`], at `2 x − z`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn mirrored_coefficients(hx: &mut [f32], hz: &[f32], y: &[f32], divisor: &[f32]) {
    for (((hx, hz), y), divisor) in hx.iter_mut().zip(hz).zip(y).zip(divisor) {
        *hx = (y - (2.0 * *hx - hz)) / divisor;
    }
}

/// As [`coefficients`], but adds the share `gram / divisor` of `y − H x` to `y1` and aims at that.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn accelerated_coefficients(hx: &mut [f32], y: &[f32], gram: &[f32], divisor: &[f32], y1: &mut [f32]) {
    for ((((hx, y), gram), divisor), y1) in hx.iter_mut().zip(y).zip(gram).zip(divisor).zip(y1) {
        *y1 += gram / divisor * (y - *hx);
        *hx = (*y1 - *hx) / divisor;
    }
}

/// `Σ (y − hx)²` of a chunk over lanes, where a mask is open.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn squared_residual(hx: &[f32], y: &[f32], gram: &[f32]) -> f64 {
    let mut sums = [0f32; LANES];
    let square = |hx: f32, y: f32, gram: f32| if gram > 0.0 { (y - hx) * (y - hx) } else { 0.0 };
    let ((hx, hx_rest), (y, y_rest)) = (hx.as_chunks::<LANES>(), y.as_chunks::<LANES>());
    let (gram, gram_rest) = gram.as_chunks::<LANES>();
    for ((hx, y), gram) in hx.iter().zip(y).zip(gram) {
        for lane in 0..LANES {
            sums[lane] += square(hx[lane], y[lane], gram[lane]);
        }
    }
    for (lane, ((hx, y), gram)) in hx_rest.iter().zip(y_rest).zip(gram_rest).enumerate() {
        sums[lane] += square(*hx, *y, *gram);
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
