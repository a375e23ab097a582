//! Low rank of groups of similar patches, of all frames together.

/// Runs the same code for any side of a patch, compiled for the usual ones apart: rows of 6 numbers are not worth a loop.
macro_rules! by_side {
    ($side:expr, |$name:ident| $work:block) => {
        match $side {
            6 => by_side!(6, $name, $work),
            7 => by_side!(7, $name, $work),
            8 => by_side!(8, $name, $work),
            9 => by_side!(9, $name, $work),
            $name => $work,
        }
    };
    ($side:literal, $name:ident, $work:block) => {{
        #[allow(non_upper_case_globals)]
        const $name: usize = $side;
        $work
    }};
}

mod groups;
mod shrink;

use std::sync::Arc;

use crate::{BoxError, Call, Denoiser};
use groups::{Grid, Groups};
use ndarray::{Array3, ArrayView4, ArrayViewMut3, ArrayViewMut4, Axis, Zip};
use rayon::prelude::*;
use shrink::Shrinker;

/// Numbers of the patches that are worked on before they are put back, about: enough for many threads, little memory.
const AT_ONCE: usize = 1 << 20;

/// Weighted nuclear norm minimisation: patches like a reference patch, from its frame and those beside it, are the columns of a
/// matrix whose singular values s are shrunk,
///
/// ```text
/// ŝ = (s + √(s² − 4 c √M σ²)) / 2    where s² > 4 c √M σ², else 0
/// ```
///
/// for M patches from which their mean is taken. That is the minimiser for weights of `c √M σ² / ŝ`: what is strong is left alone. Every pixel
/// is the mean of all patches that cover it. Channels are matched together and shrunk apart.
///
/// | Parameter | Default | Purpose | Range |
/// |---|---|---|---|
/// | `patch` | 6 | side of a patch | ≥ 1, more than the frame is the frame |
/// | `group` | 32 | patches of a group, M | ≥ 2 |
/// | `step` | 4 | from one reference patch to the next | ≥ 1, more than a patch is a patch |
/// | `window` | 10 | how many pixels away patches are looked for, each way | |
/// | `frames` | 2 | how many frames away | |
/// | `weight` | 4 √2 | how strong, c; DeSCI has 2 √2 | > 0, finite |
/// | `match_every` | 1 | calls from one look for similar patches to the next, as long as the same video goes on; DeSCI has 20 | ≥ 1 |
///
/// Groups are found among all patches of the window, most of which are known to be too far off by their sums, or by their first rows. Of a group
/// only eigenvectors that are kept are looked for: in most of them there are fewer than eight.
///
/// The slowest prior, and the best that needs no training: 8 frames of 256² take about a second a call on two cores. The defaults were chosen on
/// two clips that are in no benchmark, after the network of the default schedule, σ 12 and 8, six calls each (dB): 27.91 and 28.00; groups of
/// 20 27.83 and 27.93; four frames away 27.85; groups of 48 from 7 pixels away, σ 12 and 6, 27.68 and 27.98.
///
/// ```
/// use admm::{Call, Denoiser, Wnnm};
/// use ndarray::Array4;
/// use sci_forward::{VideoShape, testing::{gaussian, moving_square}};
/// let clean = moving_square(VideoShape { frames: 4, height: 32, width: 32 }).insert_axis(ndarray::Axis(1));
/// let noisy = &clean + &(gaussian(clean.dim(), 1) * 0.1);
/// let mut out = Array4::zeros(clean.dim());
/// Wnnm::default().denoise(&Call::new(0.1), noisy.view(), out.view_mut())?;
/// let error = |v: &Array4<f32>| (v - &clean).mapv(|d| d * d).mean().unwrap();
/// assert!(error(&out) < error(&noisy) / 8.0);
/// # Ok::<(), admm::BoxError>(())
/// ```
///
/// # References
/// Gu, Xie, Meng, Zuo, Feng, Zhang, *Weighted nuclear norm minimization and its applications to low level vision*, IJCV 2017 (the
/// shrinkage). Liu, Yuan, Suo, Brady, Dai, *Rank minimization for snapshot compressive imaging*, IEEE TPAMI 2019 (groups over all frames,
/// inside GAP and ADMM).
#[derive(Debug, Clone, Default)]
pub struct Wnnm {
    params: WnnmParams,
    matched: Option<Matched>,
}

/// The settings of [`Wnnm`], where they are explained.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WnnmParams {
    /// Side of a patch.
    pub patch: usize,
    /// Patches of a group, M.
    pub group: usize,
    /// From one reference patch to the next.
    pub step: usize,
    /// How many pixels away patches are looked for, each way.
    pub window: usize,
    /// How many frames away patches are looked for, each way.
    pub frames: usize,
    /// How strong, c.
    pub weight: f32,
    /// Calls from one look for similar patches to the next.
    pub match_every: usize,
}

impl Default for WnnmParams {
    fn default() -> Self {
        let weight = 4.0 * std::f32::consts::SQRT_2;
        Self { patch: 6, group: 32, step: 4, window: 10, frames: 2, weight, match_every: 1 }
    }
}

/// What patches were found to be alike.
#[derive(Clone)]
struct Matched {
    groups: Arc<Groups>,
    /// In which iteration.
    iteration: usize,
    /// The iteration of the last call that used them.
    last: usize,
    /// Whether that iteration had one call alone, of the whole video then.
    alone: bool,
}

impl std::fmt::Debug for Matched {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Matched({} groups in iteration {})", self.groups.len(), self.iteration)
    }
}

impl Wnnm {
    /// With these settings.
    pub fn new(params: WnnmParams) -> Self {
        Self { params, matched: None }
    }

    /// The groups of this call: those that were found before, or others.
    fn groups(&mut self, call: &Call<'_>, grid: Grid, noisy: ArrayView4<'_, f32>) -> Arc<Groups> {
        // A video goes on with the next iteration; another run, or another part of the video, does not.
        let goes_on = |matched: &&mut Matched| {
            let recent = call.iteration < matched.iteration.saturating_add(self.params.match_every);
            recent && call.iteration == matched.last + 1 && matched.alone && matched.groups.grid == grid
        };
        if let Some(matched) = self.matched.as_mut().filter(goes_on) {
            matched.last = call.iteration;
            return Arc::clone(&matched.groups);
        }
        let (groups, iteration) = (Arc::new(Groups::new(grid, self.params, noisy)), call.iteration);
        let alone = self.matched.as_ref().is_none_or(|matched| matched.last != iteration);
        self.matched = Some(Matched { groups: Arc::clone(&groups), iteration, last: iteration, alone });
        groups
    }
}

impl Denoiser for Wnnm {
    fn name(&self) -> &str {
        "wnnm"
    }

    fn denoise(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        let (frames, _, height, width) = noisy.dim();
        let sigma = call.required_sigma()?;
        if noisy.is_empty() || sigma <= 0.0 {
            out.assign(&noisy);
            return Ok(());
        }
        let side = self.params.patch.clamp(1, height.min(width));
        let grid = Grid { frames, height, width, side, step: self.params.step.clamp(1, side) };
        let groups = self.groups(call, grid, noisy);
        for (noisy, mut out) in noisy.axis_iter(Axis(1)).zip(out.axis_iter_mut(Axis(1))) {
            let noisy = noisy.as_standard_layout();
            let plane = noisy.as_slice().expect("a standard layout is a slice");
            let sums = shrunk(&groups, plane, sigma, self.params.weight);
            Zip::from(&mut out).and(&sums).and(&groups.counts).par_for_each(|out, sum, count| *out = sum / count);
        }
        Ok(())
    }
}

/// The sums of the patches of all groups of a plane `[T, H, W]`, once they have been shrunk.
fn shrunk(groups: &Groups, plane: &[f32], sigma: f32, weight: f32) -> Array3<f32> {
    let Grid { frames, height, width, side, .. } = groups.grid;
    let (pixels, waves) = (side * side, shrink::waves(side));
    let mut sums = Array3::<f32>::zeros((frames, height, width));
    let of_all = (0..groups.len()).collect::<Vec<_>>();
    let at_once = (AT_ONCE / (pixels * groups.group(0).len())).max(1).next_multiple_of(shrink::AT_ONCE);
    for some in of_all.chunks(at_once) {
        let shrink = |shrinker: &mut Shrinker<'_>, some: &[usize]| {
            let members: Vec<&[u32]> = some.iter().map(|&index| groups.group(index)).collect();
            shrinker.shrink(&members, plane, sigma, weight)
        };
        let shrinker = || Shrinker::new(side, width, &waves);
        let values: Vec<Vec<f32>> = some.par_chunks(shrink::AT_ONCE).map_init(shrinker, shrink).collect();
        // Each pixel in the order of the groups: the same sums for any number of threads, which share the frames.
        let share = frames.div_ceil(rayon::current_num_threads());
        sums.axis_chunks_iter_mut(Axis(0), share).into_par_iter().enumerate().for_each(|(band, sums)| {
            let patches = values.iter().flat_map(|values| values.chunks_exact(pixels));
            let members = some.iter().flat_map(|&index| groups.group(index));
            add(members.zip(patches), band * share * height * width, side, sums);
        });
    }
    sums
}

/// Adds those patches to some frames that are in them; `first` is where they begin.
fn add<'a>(
    patches: impl Iterator<Item = (&'a u32, &'a [f32])>,
    first: usize,
    side: usize,
    mut sums: ArrayViewMut3<'_, f32>,
) {
    let width = sums.len_of(Axis(2));
    let sums = sums.as_slice_mut().expect("frames of a standard layout");
    by_side!(side, |side| {
        for (&member, patch) in patches {
            let Some(at) = (member as usize).checked_sub(first).filter(|&at| at < sums.len()) else { continue };
            for (i, row) in patch.chunks_exact(side).enumerate() {
                sums[at + i * width..][..side].iter_mut().zip(row).for_each(|(sum, value)| *sum += value);
            }
        }
    });
}
