//! Total variation by Chambolle's dual projection, frame by frame.
//!
//! One inner iteration is one pass over the frame: the primal row below is made from the duals just before the row
//! above it is updated, so that nothing but the two duals is kept. A frame and its duals (1 MB at 256×256) stay in L2.

#[cfg(target_arch = "x86_64")]
use crate::lanes::{Avx2, Avx512};
use crate::lanes::{Lanes, MAX_LANES, Portable};
use crate::{BoxError, DenoiseCx, Denoiser};
use ndarray::parallel::prelude::*;
use ndarray::{ArrayView2, ArrayView4, ArrayViewMut2, ArrayViewMut4, Axis};
use rayon::slice::ParallelSliceMut;

/// Dual step, 1 / (2 · dimensions).
const TAU: f32 = 0.25;

/// Isotropic total variation of every frame and channel on its own: `argmin_u ½‖u − x‖² + weight · Σ |∇u|`,
/// by `inner` steps of Chambolle's dual projection. σ is ignored: the strength is `weight`.
///
/// | Parameter | Default | Purpose | Range |
/// |---|---|---|---|
/// | `weight` | – | strength | > 0, finite |
/// | [`inner`](Tv::inner) | 5 | dual steps a call | ≥ 1 |
/// | [`warm_dual`](Tv::warm_dual) | off | start from the last call's dual instead of 0 | |
///
/// With the defaults it is scikit-image's `denoise_tv_chambolle(frame, weight, max_num_iter=5)`, which is what the
/// reference codes call: out of 5 steps the last only forms the output, and a step is the last one
/// as soon as the energy changes by less than 2e-4 of its first value.
///
/// # References
/// Chambolle, *An algorithm for total variation minimization and applications*, 2004.
#[derive(Debug, Clone)]
pub struct Tv {
    weight: f32,
    inner: usize,
    warm_dual: bool,
    kernel: Kernel,
    duals: Vec<Dual>,
}

/// The dual field of one plane.
#[derive(Debug, Clone, Default)]
struct Dual {
    size: (usize, usize),
    p0: Vec<f32>,
    p1: Vec<f32>,
    /// Whether the field holds the last call's dual.
    warm: bool,
    /// Where the output is made if the caller's is strided.
    strided: Vec<f32>,
}

impl Tv {
    /// TV of this weight.
    ///
    /// # Panics
    /// If the weight is not positive and finite.
    pub fn new(weight: f32) -> Self {
        assert!(weight > 0.0 && weight.is_finite(), "TV weight {weight} must be finite and greater than 0");
        let kernel = Kernel::available()[0];
        Self { weight, inner: 5, warm_dual: false, kernel, duals: Vec::new() }
    }

    /// Dual steps a call, at least 1.
    #[must_use]
    pub fn inner(mut self, steps: usize) -> Self {
        self.inner = steps.max(1);
        self
    }

    /// Starts each call from the dual field of the call before: inside a solver, where the input changes little from
    /// call to call, a few steps then do the work of many.
    #[must_use]
    pub fn warm_dual(mut self, on: bool) -> Self {
        self.warm_dual = on;
        self
    }
}

impl Denoiser for Tv {
    fn name(&self) -> &str {
        "tv"
    }

    fn denoise(
        &mut self,
        _: &DenoiseCx,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        let (frames, channels, height, width) = noisy.dim();
        // A dual that is kept belongs to its frame; one that is not stays in the cache of the thread that works on it.
        let groups = if self.warm_dual { frames } else { frames.min(rayon::current_num_threads()) }.max(1);
        let group = frames.div_ceil(groups).max(1);
        let kept = if self.warm_dual { channels } else { 1 };
        self.duals.resize_with(groups * kept, Dual::default);
        let Self { weight, inner, warm_dual, kernel, .. } = *self;
        out.axis_chunks_iter_mut(Axis(0), group)
            .into_par_iter()
            .zip(noisy.axis_chunks_iter(Axis(0), group))
            .zip(self.duals.par_chunks_mut(kept.max(1)))
            .for_each(|((mut out, noisy), duals)| {
                for (mut out, noisy) in out.outer_iter_mut().zip(noisy.outer_iter()) {
                    for (c, (out, noisy)) in out.outer_iter_mut().zip(noisy.outer_iter()).enumerate() {
                        let dual = &mut duals[c % kept];
                        dual.prepare((height, width), warm_dual);
                        dual.denoise(weight, inner, kernel, noisy, out);
                    }
                }
            });
        Ok(())
    }
}

impl Dual {
    fn prepare(&mut self, size: (usize, usize), warm: bool) {
        if self.size != size {
            let zeros = vec![0.0; size.0 * size.1];
            *self = Self { size, p0: zeros.clone(), p1: zeros, warm: false, strided: Vec::new() };
        }
        self.warm &= warm;
    }

    fn denoise(
        &mut self,
        weight: f32,
        inner: usize,
        kernel: Kernel,
        image: ArrayView2<'_, f32>,
        mut out: ArrayViewMut2<'_, f32>,
    ) {
        // The sub-lattices of a mosaic come as strided views; the kernel works on rows in memory order.
        let image = image.as_standard_layout();
        let image = image.as_slice().expect("a standard layout is a slice");
        match out.as_slice_mut() {
            Some(out) => self.denoise_plane(weight, inner, kernel, image, out),
            None => {
                let mut plane = std::mem::take(&mut self.strided);
                plane.resize(image.len(), 0.0);
                self.denoise_plane(weight, inner, kernel, image, &mut plane);
                out.iter_mut().zip(&plane).for_each(|(out, v)| *out = *v);
                self.strided = plane;
            }
        }
    }

    fn denoise_plane(&mut self, weight: f32, inner: usize, kernel: Kernel, image: &[f32], out: &mut [f32]) {
        let pixels = image.len().max(1) as f64;
        let (mut first, mut previous) = (0.0, 0.0);
        for step in 0..inner - 1 {
            let plane = Plane { image, width: self.size.1, weight, fresh: !self.warm };
            // SAFETY: `Kernel::available` has checked the instruction set.
            let energy = unsafe { (kernel.dual_step)(&plane, &mut self.p0, &mut self.p1, out) } / pixels;
            self.warm = true;
            if step == 0 {
                first = energy;
            } else if (previous - energy).abs() < 2e-4 * first {
                return;
            }
            previous = energy;
        }
        let plane = Plane { image, width: self.size.1, weight, fresh: !self.warm };
        // SAFETY: `Kernel::available` has checked the instruction set.
        unsafe { (kernel.primal_step)(&plane, &self.p0, &self.p1, out) }
    }
}

struct Plane<'a> {
    image: &'a [f32],
    width: usize,
    weight: f32,
    /// The dual is 0, whatever its arrays hold.
    fresh: bool,
}

/// Writes `out = image + div p`, then moves the dual: `p ← (p − τ ∇out) / (1 + τ / weight · |∇out|)`.
/// Returns the energy `Σ (out − image)² + weight · Σ |∇out|`.
///
/// # Safety
/// The instruction set of `L` must be there.
#[inline(always)]
unsafe fn dual_step<L: Lanes>(plane: &Plane<'_>, p0: &mut [f32], p1: &mut [f32], out: &mut [f32]) -> f64 {
    let Plane { image, width, weight, fresh } = *plane;
    let height = image.len() / width.max(1);
    let mut energy = 0f64;
    for r in 0..height {
        let here = r * width..(r + 1) * width;
        // SAFETY: the caller's, for all three calls.
        unsafe {
            if r == 0 {
                primal_row::<L>(plane, 0, p0, p1, out);
            }
            // The row below is made from p0 of this row, so it comes before this row's update.
            let last = r + 1 == height;
            if !last {
                primal_row::<L>(plane, r + 1, p0, p1, out);
            }
            let (row, below) = out[here.start..].split_at(width);
            let below = if last { row } else { &below[..width] };
            let (p0, p1) = (&mut p0[here.clone()], &mut p1[here.clone()]);
            if fresh {
                p0.fill(0.0);
                p1.fill(0.0);
            }
            energy += f64::from(dual_row::<L>(row, below, &image[here], weight, p0, p1));
        }
    }
    energy
}

/// Writes `out = image + div p`.
///
/// # Safety
/// The instruction set of `L` must be there.
#[inline(always)]
unsafe fn primal_step<L: Lanes>(plane: &Plane<'_>, p0: &[f32], p1: &[f32], out: &mut [f32]) {
    for r in 0..plane.image.len() / plane.width.max(1) {
        // SAFETY: the caller's.
        unsafe { primal_row::<L>(plane, r, p0, p1, out) }
    }
}

/// Row `r` of `image + div p`, where `(div p)[r, x] = p0[r−1, x] − p0[r, x] + p1[r, x−1] − p1[r, x]`.
///
/// # Safety
/// The instruction set of `L` must be there.
#[inline(always)]
unsafe fn primal_row<L: Lanes>(plane: &Plane<'_>, r: usize, p0: &[f32], p1: &[f32], out: &mut [f32]) {
    let Plane { image, width, fresh, .. } = *plane;
    let here = r * width..(r + 1) * width;
    let (image, out) = (&image[here.clone()], &mut out[here.clone()]);
    if fresh {
        out.copy_from_slice(image);
        return;
    }
    let above = if r > 0 { Some(&p0[here.start - width..here.start]) } else { None };
    let (p0, p1) = (&p0[here.clone()], &p1[here]);
    let at = |x: usize| {
        let up = if let Some(above) = above { above[x] } else { 0.0 };
        image[x] - p0[x] - p1[x] + up + if x > 0 { p1[x - 1] } else { 0.0 }
    };
    out[0] = at(0);
    let mut x = 1;
    while x + L::N <= width {
        // SAFETY: `x ≥ 1` and `x + N ≤ width`, the length of every row; the instruction set is the caller's.
        unsafe {
            let load = |row: &[f32], x: usize| L::load(row.as_ptr().add(x));
            let mut sum = load(image, x).sub(load(p0, x)).sub(load(p1, x));
            if let Some(above) = above {
                sum = sum.add(load(above, x));
            }
            sum.add(load(p1, x - 1)).store(out.as_mut_ptr().add(x));
        }
        x += L::N;
    }
    while x < width {
        out[x] = at(x);
        x += 1;
    }
}

/// Moves the dual of one row, `below` being the next row of the primal (or the row itself at the end, where the gradient is 0).
///
/// # Safety
/// The instruction set of `L` must be there.
#[inline(always)]
unsafe fn dual_row<L: Lanes>(
    row: &[f32],
    below: &[f32],
    image: &[f32],
    weight: f32,
    p0: &mut [f32],
    p1: &mut [f32],
) -> f32 {
    let width = row.len();
    assert!(below.len() == width && image.len() == width && p0.len() == width && p1.len() == width);
    // SAFETY: every pointer has N floats: in the rows up to the last N columns but one, in padded copies after that.
    // The instruction set is the caller's.
    unsafe {
        let mut energy = L::splat(0.0);
        let mut x = 0;
        while x + L::N < width {
            let primal = [row.as_ptr().add(x), row.as_ptr().add(x + 1), below.as_ptr().add(x), image.as_ptr().add(x)];
            energy = dual_lanes(primal, weight, p0.as_mut_ptr().add(x), p1.as_mut_ptr().add(x), energy);
            x += L::N;
        }
        // The last column has no right neighbour: its gradient to the right is 0, as is everything beyond it.
        let pad = |slice: &[f32]| {
            let mut lanes = [0f32; MAX_LANES];
            lanes[..slice.len()].copy_from_slice(slice);
            lanes
        };
        let mut right = pad(&row[x + 1..]);
        right[width - 1 - x] = row[width - 1];
        let (row, below, image) = (pad(&row[x..]), pad(&below[x..]), pad(&image[x..]));
        let (mut q0, mut q1) = (pad(&p0[x..]), pad(&p1[x..]));
        let primal = [row.as_ptr(), right.as_ptr(), below.as_ptr(), image.as_ptr()];
        energy = dual_lanes(primal, weight, q0.as_mut_ptr(), q1.as_mut_ptr(), energy);
        p0[x..].copy_from_slice(&q0[..width - x]);
        p1[x..].copy_from_slice(&q1[..width - x]);
        let mut sums = [0f32; MAX_LANES];
        energy.store(sums.as_mut_ptr());
        sums.iter().sum()
    }
}

/// `N` columns of the dual step: `[row, right, below, image]` of the primal.
///
/// # Safety
/// Every pointer must have `N` floats, and the instruction set of `L` must be there.
#[inline(always)]
unsafe fn dual_lanes<L: Lanes>(primal: [*const f32; 4], weight: f32, p0: *mut f32, p1: *mut f32, energy: L) -> L {
    // SAFETY: the caller's.
    unsafe {
        let [u, right, below, image] = [L::load(primal[0]), L::load(primal[1]), L::load(primal[2]), L::load(primal[3])];
        let (g0, g1, d) = (below.sub(u), right.sub(u), u.sub(image));
        let norm = g0.mul_add(g0, g1.mul(g1)).sqrt();
        let shrink = norm.mul_add(L::splat(TAU / weight), L::splat(1.0)).recip();
        let tau = L::splat(TAU);
        tau.neg_mul_add(g0, L::load(p0)).mul(shrink).store(p0);
        tau.neg_mul_add(g1, L::load(p1)).mul(shrink).store(p1);
        d.mul_add(d, norm.mul_add(L::splat(weight), energy))
    }
}

/// [`dual_step`] and [`primal_step`] compiled for one instruction set.
#[derive(Debug, Clone, Copy)]
struct Kernel {
    dual_step: unsafe fn(&Plane<'_>, &mut [f32], &mut [f32], &mut [f32]) -> f64,
    primal_step: unsafe fn(&Plane<'_>, &[f32], &[f32], &mut [f32]),
}

macro_rules! kernel {
    ($lanes:ty $(, $features:literal)?) => {{
        $(#[target_feature(enable = $features)])?
        unsafe fn dual(plane: &Plane<'_>, p0: &mut [f32], p1: &mut [f32], out: &mut [f32]) -> f64 {
            // SAFETY: the caller's; the features are those of the vector.
            unsafe { dual_step::<$lanes>(plane, p0, p1, out) }
        }
        $(#[target_feature(enable = $features)])?
        unsafe fn primal(plane: &Plane<'_>, p0: &[f32], p1: &[f32], out: &mut [f32]) {
            // SAFETY: the caller's; the features are those of the vector.
            unsafe { primal_step::<$lanes>(plane, p0, p1, out) }
        }
        Kernel { dual_step: dual, primal_step: primal }
    }};
}

impl Kernel {
    /// Those that this machine can run, the fastest first.
    fn available() -> Vec<Self> {
        let mut kernels = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx512f") {
                kernels.push(kernel!(Avx512, "avx512f"));
            }
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                kernels.push(kernel!(Avx2, "avx2,fma"));
            }
        }
        // On AArch64 it compiles to NEON, which is always there.
        kernels.push(kernel!(Portable));
        kernels
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array2, Array4};
    use sci_forward::VideoShape;
    use sci_forward::testing::{moving_square, uniform};

    const CX: DenoiseCx = DenoiseCx { sigma: 0.0, iteration: 0, stage: 0 };

    /// scikit-image's loop, in `f64`, by the definition.
    fn reference(image: ArrayView2<'_, f32>, weight: f64, inner: usize) -> Array2<f64> {
        let image = image.mapv(f64::from);
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
            let g0 =
                Array2::from_shape_fn((h, w), |(i, j)| if i + 1 < h { out[[i + 1, j]] - out[[i, j]] } else { 0.0 });
            let g1 =
                Array2::from_shape_fn((h, w), |(i, j)| if j + 1 < w { out[[i, j + 1]] - out[[i, j]] } else { 0.0 });
            let norm = (&g0 * &g0 + &g1 * &g1).mapv(f64::sqrt);
            let energy = ((&out - &image).mapv(|d| d * d).sum() + weight * norm.sum()) / image.len() as f64;
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

    #[test]
    fn the_fast_path_is_the_definition_at_every_size() {
        for (h, w) in [(1, 1), (1, 9), (9, 1), (2, 2), (3, 5), (17, 16), (16, 17), (33, 49), (20, 255)] {
            for (weight, inner) in [(0.3, 5), (0.02, 5), (1.0, 1), (0.1, 30)] {
                let noisy = uniform((2, 1, h, w), 3);
                for kernel in Kernel::available() {
                    let mut out = Array4::from_elem(noisy.dim(), f32::NAN);
                    let mut tv = Tv { kernel, ..Tv::new(weight).inner(inner) };
                    tv.denoise(&CX, noisy.view(), out.view_mut()).unwrap();
                    for t in 0..2 {
                        let expected = reference(noisy.slice(ndarray::s![t, 0, .., ..]), f64::from(weight), inner);
                        for ((i, j), e) in expected.indexed_iter() {
                            let ours = f64::from(out[[t, 0, i, j]]);
                            assert!(
                                (ours - e).abs() < 1e-5,
                                "{h}×{w} weight {weight} inner {inner}: {ours} is not {e}"
                            );
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn a_strided_plane_gives_the_same_bits_as_a_packed_one() {
        let noisy = uniform((2, 1, 20, 30), 1);
        let lattice = ndarray::s![.., .., 1..;2, ..;2];
        let packed = noisy.slice(lattice).to_owned();
        let (mut a, mut b) = (Array4::zeros(noisy.dim()), Array4::zeros(packed.dim()));
        Tv::new(0.1).denoise(&CX, noisy.slice(lattice), a.slice_mut(lattice)).unwrap();
        Tv::new(0.1).denoise(&CX, packed.view(), b.view_mut()).unwrap();
        assert_eq!(a.slice(lattice), b);
    }

    #[test]
    fn it_lowers_the_error_of_a_noisy_video_and_a_warm_dual_goes_further() {
        let clean = moving_square(VideoShape { frames: 3, height: 40, width: 40 }).insert_axis(Axis(1));
        let noisy = &clean + &(uniform(clean.dim(), 9) - 0.5) * 0.4;
        let error = |v: &Array4<f32>| (v - &clean).mapv(|d| d * d).sum();
        let (mut cold, mut warm) = (Array4::zeros(clean.dim()), Array4::zeros(clean.dim()));
        Tv::new(0.1).denoise(&CX, noisy.view(), cold.view_mut()).unwrap();
        let mut tv = Tv::new(0.1).warm_dual(true);
        for _ in 0..4 {
            tv.denoise(&CX, noisy.view(), warm.view_mut()).unwrap();
        }
        assert!(error(&cold) < 0.5 * error(&noisy));
        let energy = |v: &Array4<f32>| {
            let tv = ndarray::Zip::from(v.windows((1, 1, 2, 2))).fold(0.0, |s, q| {
                s + ((q[[0, 0, 1, 0]] - q[[0, 0, 0, 0]]).powi(2) + (q[[0, 0, 0, 1]] - q[[0, 0, 0, 0]]).powi(2)).sqrt()
            });
            0.5 * (v - &noisy).mapv(|d| d * d).sum() + 0.1 * tv
        };
        assert!(energy(&warm) < energy(&cold));
    }
}
