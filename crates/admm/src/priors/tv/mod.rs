//! Total variation by Chambolle's dual projection, frame by frame.
//!
//! The dual steps of a call run as one sweep over the frame: as soon as a step has made row `r` of its primal, the next
//! step works on the row above. Each step keeps two rows of its dual and of its primal, so that the whole computation stays
//! in cache, the frame is read once and written once, and no dual plane exists.

mod lanes;

#[cfg(target_arch = "x86_64")]
use self::lanes::{Avx2, Avx512};
use self::lanes::{Lanes, MAX_LANES, Portable};
use crate::{BoxError, Call, Denoiser, PerLattice, Prior};
use ndarray::parallel::prelude::*;
use ndarray::{ArrayView2, ArrayView4, ArrayViewMut2, ArrayViewMut4, Axis};
use sci_forward::CfaPattern;

/// Dual step, 1 / (2 · dimensions).
const TAU: f32 = 0.25;
/// The steps end once the energy changes by less than this part of its first value.
const ENERGY_TOLERANCE: f64 = 2e-4;

/// Isotropic total variation of every frame and channel on its own: `argmin_u ½‖u − x‖² + weight · Σ |∇u|`,
/// by a few steps of Chambolle's dual projection. σ is ignored: the strength is `weight`.
///
/// | Parameter | Default | Purpose | Range |
/// |---|---|---|---|
/// | `weight` | – | strength | > 0, finite |
/// | [`inner`](Tv::inner) | 5 | iterations a call, the last of which only forms the output | ≥ 1 |
///
/// With the defaults it is scikit-image's `denoise_tv_chambolle(frame, weight, max_num_iter=5)`, which is what the
/// reference codes call, with its early end: the iterations stop as soon as the energy changes by less than 2e-4 of its
/// first value.
///
/// # References
/// Chambolle, *An algorithm for total variation minimization and applications*, 2004.
#[derive(Debug, Clone)]
pub struct Tv {
    weight: f32,
    inner: usize,
    sweep: Sweep,
    scratch: Vec<Scratch>,
}

/// What one thread needs to denoise a plane: the steps in flight, and where strided rows are packed.
#[derive(Debug, Clone, Default)]
struct Scratch {
    width: usize,
    levels: Vec<Level>,
    packed: Vec<f32>,
}

/// The two newest rows, row `r` at index `r % 2`, of the dual that a step starts from and of the primal that it makes.
/// A row of the primal ends with its last number once more, the right neighbour of the last column; the first number of a row
/// of the dual has a zero before it, its left neighbour, and lies on a cache line: [`FIRST`].
#[derive(Debug, Clone, Default)]
struct Level {
    dual: [Rows; 2],
    primal: [Row; 2],
    energy: f64,
}

/// A row of each of the two components of the dual.
type Rows = [Row; 2];

/// Numbers in a cache line of 64 bytes.
const LINE: usize = 16;
/// The index of a dual row's first number.
const FIRST: usize = LINE;

/// A row that begins on a cache line: vectors that straddle two lines take twice as long to load and store.
#[derive(Debug, Clone, Default)]
struct Row(Vec<Line>);

#[derive(Debug, Clone, Copy, Default)]
#[repr(C, align(64))]
struct Line([f32; LINE]);

impl Row {
    /// At least so many zeros.
    fn zeros(length: usize) -> Self {
        Self(vec![Line::default(); length.div_ceil(LINE)])
    }
}

impl std::ops::Deref for Row {
    type Target = [f32];
    fn deref(&self) -> &[f32] {
        // SAFETY: a line is 16 floats without padding, and a vector of them is contiguous.
        unsafe { std::slice::from_raw_parts(self.0.as_ptr().cast(), self.0.len() * LINE) }
    }
}

impl std::ops::DerefMut for Row {
    fn deref_mut(&mut self) -> &mut [f32] {
        // SAFETY: as for `deref`.
        unsafe { std::slice::from_raw_parts_mut(self.0.as_mut_ptr().cast(), self.0.len() * LINE) }
    }
}

impl Tv {
    /// TV of this weight.
    ///
    /// # Panics
    /// If the weight is not positive, is not finite, or is so small that its inverse is not.
    pub fn new(weight: f32) -> Self {
        assert!(weight > 0.0 && weight.is_normal(), "TV weight {weight} must be finite and greater than 1.2e-38");
        let sweep = Sweep::available()[0];
        Self { weight, inner: 5, sweep, scratch: Vec::new() }
    }

    /// The prior of a sensor's video: on a color sensor each of the four sub-lattices is a gray video.
    pub fn on_sensor(self, cfa: Option<CfaPattern>) -> Box<dyn Prior> {
        if cfa.is_some() { Box::new(PerLattice::new(self)) } else { Box::new(self) }
    }

    /// Iterations a call, at least 1.
    #[must_use]
    pub fn inner(mut self, iterations: usize) -> Self {
        self.inner = iterations.max(1);
        self
    }
}

impl Denoiser for Tv {
    fn name(&self) -> &str {
        "tv"
    }

    fn denoise(
        &mut self,
        _: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        let (frames, _, _, width) = noisy.dim();
        if noisy.is_empty() {
            return Ok(());
        }
        // One scratch a thread; which thread takes which frames does not matter to the result.
        let group = frames.div_ceil(rayon::current_num_threads());
        self.scratch.resize_with(frames.div_ceil(group), Scratch::default);
        let sweep = if width < self.sweep.lanes { Sweep::SCALAR } else { self.sweep };
        let plane = Plane { width, weight: self.weight, inner: self.inner, sweep };
        out.axis_chunks_iter_mut(Axis(0), group)
            .into_par_iter()
            .zip(noisy.axis_chunks_iter(Axis(0), group))
            .zip(&mut self.scratch)
            .for_each(|((mut out, noisy), scratch)| {
                for (mut out, noisy) in out.outer_iter_mut().zip(noisy.outer_iter()) {
                    for (out, noisy) in out.outer_iter_mut().zip(noisy.outer_iter()) {
                        scratch.denoise(&plane, noisy, out);
                    }
                }
            });
        Ok(())
    }
}

/// What is the same for all planes of a call.
#[derive(Clone, Copy)]
struct Plane {
    width: usize,
    weight: f32,
    inner: usize,
    sweep: Sweep,
}

impl Scratch {
    fn denoise(&mut self, plane: &Plane, image: ArrayView2<'_, f32>, mut out: ArrayViewMut2<'_, f32>) {
        // The sub-lattices of a mosaic come as strided views; the sweep works on rows in memory order.
        let image = image.as_standard_layout();
        let image = image.as_slice().expect("a standard layout is a slice");
        match out.as_slice_mut() {
            Some(out) => self.denoise_plane(plane, image, out),
            None => {
                let mut packed = std::mem::take(&mut self.packed);
                packed.resize(image.len(), 0.0);
                self.denoise_plane(plane, image, &mut packed);
                out.iter_mut().zip(&packed).for_each(|(out, v)| *out = *v);
                self.packed = packed;
            }
        }
    }

    fn denoise_plane(&mut self, plane: &Plane, image: &[f32], out: &mut [f32]) {
        let mut steps = plane.inner - 1;
        self.run(plane, steps, image, out);
        // The energies are known when the sweep is over. If the steps should have ended early, fewer are swept again:
        // on a video that is still noisy this does not happen.
        if let Some(early) = self.early_end(steps) {
            steps = early;
            self.run(plane, steps, image, out);
        }
    }

    fn run(&mut self, plane: &Plane, steps: usize, image: &[f32], out: &mut [f32]) {
        let rows = |length| [Row::zeros(length), Row::zeros(length)];
        let dual = || rows(FIRST + plane.width);
        if self.width != plane.width {
            self.levels.clear();
            self.width = plane.width;
        }
        self.levels.resize_with(steps + 1, || Level {
            dual: [dual(), dual()],
            primal: rows(plane.width + 1),
            energy: 0.0,
        });
        // SAFETY: `Sweep::available` has checked the instruction set; rows have at least a vector's width.
        unsafe { (plane.sweep.run)(&mut self.levels, image, plane.width, plane.weight, out) }
    }

    /// The number of steps after which the energy had settled, if that is less than `steps`.
    fn early_end(&self, steps: usize) -> Option<usize> {
        let energy = |s: usize| self.levels[s].energy;
        (1..steps).find(|&s| (energy(s - 1) - energy(s)).abs() < ENERGY_TOLERANCE * energy(0))
    }
}

/// [`sweep`] compiled for one instruction set.
#[derive(Debug, Clone, Copy)]
struct Sweep {
    run: unsafe fn(&mut [Level], &[f32], usize, f32, &mut [f32]),
    /// The narrowest row that it can take.
    lanes: usize,
}

macro_rules! compiled {
    ($lanes:ty $(, $features:literal)?) => {{
        $(#[target_feature(enable = $features)])?
        unsafe fn compiled(levels: &mut [Level], image: &[f32], width: usize, weight: f32, out: &mut [f32]) {
            // SAFETY: the caller's; the features are those of the vector.
            unsafe { sweep::<$lanes>(levels, image, width, weight, out) }
        }
        Sweep { run: compiled, lanes: <$lanes as Lanes>::N }
    }};
}

impl Sweep {
    const SCALAR: Self = compiled!(f32);

    /// Those that this machine can run, the fastest first.
    fn available() -> Vec<Self> {
        let mut sweeps = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx512f") {
                sweeps.push(compiled!(Avx512, "avx512f"));
            }
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                sweeps.push(compiled!(Avx2, "avx2,fma"));
            }
        }
        // On AArch64 it compiles to NEON, which is always there.
        sweeps.push(compiled!(Portable));
        sweeps
    }
}

/// All steps of one call on one plane. With `u_s = image + div p_s`, level `s` makes row `r` of
///
/// ```text
/// p_{s+1} = (p_s − τ ∇u_s) / (1 + τ / weight · |∇u_s|)
/// ```
///
/// one row after level `s − 1`, and the last level writes `out = u`. `p_0` is 0. Each level's energy is `Σ (u_s − image)² + weight · Σ |∇u_s|`.
///
/// # Safety
/// The instruction set of `L` must be there, and rows must have at least `L::N` columns.
#[inline(always)]
unsafe fn sweep<L: Lanes>(levels: &mut [Level], image: &[f32], width: usize, weight: f32, out: &mut [f32]) {
    let (height, last) = (image.len() / width, levels.len() - 1);
    for level in levels.iter_mut() {
        level.energy = 0.0;
    }
    for front in 0..=height + last {
        for s in 0..=last.min(front) {
            let r = front - s;
            if r > height {
                continue;
            }
            let (done, rest) = levels.split_at_mut(s + 1);
            let level = &mut done[s];
            let row_of = |r: usize| r * width..(r + 1) * width;
            if r < height {
                let primal = if s == last { &mut out[row_of(r)] } else { &mut level.primal[r % 2][..width] };
                if s == 0 {
                    primal.copy_from_slice(&image[row_of(r)]);
                } else {
                    let above = if r > 0 { Some(&level.dual[(r - 1) % 2][0][..]) } else { None };
                    // SAFETY: the caller's.
                    unsafe { primal_row::<L>(&image[row_of(r)], &level.dual[r % 2], above, primal) }
                }
                level.primal[r % 2][width] = level.primal[r % 2][width - 1];
            }
            if s < last && r > 0 {
                // The row above now has its lower neighbour; the last row has none, and no gradient down.
                let up = (r - 1) % 2;
                let Level { dual, primal, energy } = level;
                let below = if r < height { &primal[r % 2] } else { &primal[up] };
                let from = if s == 0 { None } else { Some(&dual[up]) };
                let to = &mut rest[0].dual[up];
                // SAFETY: the caller's.
                let sum = unsafe { dual_row::<L>(&primal[up], below, &image[row_of(r - 1)], weight, from, to) };
                *energy += f64::from(sum);
            }
        }
    }
}

/// A row of `image + div p`, where `(div p)[r, x] = p0[r−1, x] − p0[r, x] + p1[r, x−1] − p1[r, x]`.
///
/// # Safety
/// The instruction set of `L` must be there, and the row must have at least `L::N` columns.
#[inline(always)]
unsafe fn primal_row<L: Lanes>(image: &[f32], [p0, p1]: &Rows, above: Option<&[f32]>, out: &mut [f32]) {
    let width = image.len();
    let end = FIRST + width;
    assert!(out.len() == width && p0.len() >= end && p1.len() >= end && width >= L::N);
    assert!(above.is_none_or(|p| p.len() >= end));
    let mut x = 0;
    while x < width {
        // The last vector reaches back over the one before if the width asks for it, and makes the same again.
        x = x.min(width - L::N);
        // SAFETY: `x + N ≤ width`, and rows of the dual reach to `FIRST + width`; the instruction set is the caller's.
        unsafe {
            let mut sum = L::load(image.as_ptr().add(x)).sub(L::load(p0.as_ptr().add(FIRST + x)));
            sum = sum.sub(L::load(p1.as_ptr().add(FIRST + x)));
            if let Some(above) = above {
                sum = sum.add(L::load(above.as_ptr().add(FIRST + x)));
            }
            sum.add(L::load(p1.as_ptr().add(FIRST + x - 1))).store(out.as_mut_ptr().add(x));
        }
        x += L::N;
    }
}

/// The dual step of one row, `below` being the next row of the primal (or the row itself at the end), from the dual
/// `from` (0 if there is none). Returns the energy of the row.
///
/// # Safety
/// The instruction set of `L` must be there, and the row must have at least `L::N` columns.
#[inline(always)]
unsafe fn dual_row<L: Lanes>(
    row: &[f32],
    below: &[f32],
    image: &[f32],
    weight: f32,
    from: Option<&Rows>,
    to: &mut Rows,
) -> f32 {
    let width = image.len();
    let end = FIRST + width;
    assert!(row.len() > width && below.len() > width && to.iter().all(|p| p.len() >= end) && width >= L::N);
    assert!(from.is_none_or(|p| p.iter().all(|p| p.len() >= end)));
    // SAFETY: `x + N ≤ width` for every vector, rows of the primal are longer than that, those of the dual
    // reach to `FIRST + width`. The instruction set is the caller's.
    unsafe {
        let mut energy = L::splat(0.0);
        let whole = width / L::N * L::N;
        let mut x = 0;
        while x < whole {
            energy = dual_lanes([row, below, image], weight, from, to, x, energy);
            x += L::N;
        }
        let mut lanes = [0f32; MAX_LANES];
        energy.store(lanes.as_mut_ptr());
        if whole < width {
            // The last vector reaches back over the one before; only its new columns count.
            let mut tail = [0f32; MAX_LANES];
            let x = width - L::N;
            dual_lanes([row, below, image], weight, from, to, x, L::splat(0.0)).store(tail.as_mut_ptr());
            lanes.iter_mut().zip(&tail).take(L::N).skip(whole - x).for_each(|(sum, v)| *sum += v);
        }
        sum_of(lanes)
    }
}

/// The sum of the lanes, by halves: a chain of additions would take as long as the row.
#[inline(always)]
fn sum_of(mut lanes: [f32; MAX_LANES]) -> f32 {
    let mut half = MAX_LANES / 2;
    while half > 0 {
        for i in 0..half {
            lanes[i] += lanes[i + half];
        }
        half /= 2;
    }
    lanes[0]
}

/// The `N` columns from `x` on of [`dual_row`], with `[row, below, image]`. Returns `energy` with theirs added.
///
/// # Safety
/// `x + N` must be at most the width of the row, and the instruction set of `L` must be there.
#[inline(always)]
unsafe fn dual_lanes<L: Lanes>(
    [row, below, image]: [&[f32]; 3],
    weight: f32,
    from: Option<&Rows>,
    [to0, to1]: &mut Rows,
    x: usize,
    energy: L,
) -> L {
    // SAFETY: the caller's; the primal has a column more at its end, the dual begins at `FIRST`.
    unsafe {
        let u = L::load(row.as_ptr().add(x));
        let g0 = L::load(below.as_ptr().add(x)).sub(u);
        let g1 = L::load(row.as_ptr().add(x + 1)).sub(u);
        let d = u.sub(L::load(image.as_ptr().add(x)));
        let norm = g0.mul_add(g0, g1.mul(g1)).sqrt();
        let shrink = norm.mul_add(L::splat(TAU / weight), L::splat(1.0)).recip();
        let (mut p0, mut p1) = (L::splat(0.0), L::splat(0.0));
        if let Some([from0, from1]) = from {
            p0 = L::load(from0.as_ptr().add(FIRST + x));
            p1 = L::load(from1.as_ptr().add(FIRST + x));
        }
        let tau = L::splat(TAU);
        tau.neg_mul_add(g0, p0).mul(shrink).store(to0.as_mut_ptr().add(FIRST + x));
        tau.neg_mul_add(g1, p1).mul(shrink).store(to1.as_mut_ptr().add(FIRST + x));
        d.mul_add(d, norm.mul_add(L::splat(weight), energy))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference;
    use ndarray::Array4;
    use sci_forward::VideoShape;
    use sci_forward::testing::{moving_square, uniform};

    const CX: Call<'static> = Call::new(0.0);

    #[test]
    fn the_fast_path_is_the_definition_at_every_size() {
        for (h, w) in [(1, 1), (1, 9), (9, 1), (2, 2), (3, 5), (17, 16), (16, 17), (33, 49), (20, 255)] {
            for (weight, inner) in [(0.3, 5), (0.02, 5), (1.0, 1), (0.1, 30)] {
                let noisy = uniform((2, 1, h, w), 3);
                for sweep in Sweep::available() {
                    let mut out = Array4::from_elem(noisy.dim(), f32::NAN);
                    let mut tv = Tv { sweep, ..Tv::new(weight).inner(inner) };
                    tv.denoise(&CX, noisy.view(), out.view_mut()).unwrap();
                    for t in 0..2 {
                        let frame = noisy.slice(ndarray::s![t, 0, .., ..]).mapv(f64::from);
                        let expected = reference::tv(&frame, f64::from(weight), inner);
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
    fn it_lowers_the_error_of_a_noisy_video() {
        let clean = moving_square(VideoShape { frames: 3, height: 40, width: 40 }).insert_axis(Axis(1));
        let noisy = &clean + &(uniform(clean.dim(), 9) - 0.5) * 0.4;
        let error = |v: &Array4<f32>| (v - &clean).mapv(|d| d * d).sum();
        let mut out = Array4::zeros(clean.dim());
        Tv::new(0.1).denoise(&CX, noisy.view(), out.view_mut()).unwrap();
        assert!(error(&out) < 0.5 * error(&noisy));
    }
}
