//! Low rank of groups of similar patches, of all frames together.

mod groups;
mod shrink;

use crate::{BoxError, Call, Denoiser};
use groups::{Grid, Matcher, Place};
use ndarray::{Array4, ArrayView3, ArrayView4, ArrayViewMut3, ArrayViewMut4, Axis, Zip, s};
use rayon::prelude::*;
use shrink::{GROUPS, Shrinker};

/// Groups that are worked on before their patches are put back: enough for many threads, little memory.
const AT_ONCE: usize = 1024;

/// Weighted nuclear norm minimisation: patches like a reference patch, from its frame and those beside it, are the columns of a
/// matrix whose singular values s are shrunk,
///
/// ```text
/// ŝ = (s + √(s² − 4 c √M σ²)) / 2    where s² > 4 c √M σ², else 0,        c = 4 √2,
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
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Wnnm {
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
}

impl Default for Wnnm {
    fn default() -> Self {
        Self { patch: 6, group: 32, step: 4, window: 10, frames: 2 }
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
        let (frames, channels, height, width) = noisy.dim();
        let sigma = call.required_sigma()?;
        if noisy.is_empty() || sigma <= 0.0 {
            out.assign(&noisy);
            return Ok(());
        }
        let side = self.patch.clamp(1, height.min(width));
        let grid = Grid { frames, height, width, side, step: self.step.clamp(1, side) };
        let matcher = Matcher::new(grid, *self, noisy);
        let planes: Vec<ArrayView3<'_, f32>> = noisy.axis_iter(Axis(1)).collect();
        // For each frame its channels, and how many patches cover a pixel.
        let mut sums = Array4::<f32>::zeros((frames, channels + 1, height, width));
        for some in grid.references().chunks(AT_ONCE) {
            let shrunk = |some: &[Place]| Shrunk::new(&matcher, &planes, some, sigma);
            let groups: Vec<_> = some.par_chunks(GROUPS).map(shrunk).collect();
            // Each frame in the order of the groups: the same sums for any number of threads.
            sums.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(frame, mut sums)| {
                groups.iter().for_each(|groups| groups.add_to(frame, side, sums.view_mut()));
            });
        }
        for (mut out, sums) in out.outer_iter_mut().zip(sums.outer_iter()) {
            let counts = sums.index_axis(Axis(0), channels);
            for (mut out, sums) in out.outer_iter_mut().zip(sums.outer_iter()) {
                Zip::from(&mut out).and(&sums).and(&counts).for_each(|out, sum, count| *out = sum / count);
            }
        }
        Ok(())
    }
}

/// Groups whose singular values have been shrunk.
struct Shrunk {
    /// The patches of all groups.
    members: Vec<Place>,
    /// For each channel their pixels.
    values: Vec<Vec<f32>>,
}

impl Shrunk {
    fn new(matcher: &Matcher, planes: &[ArrayView3<'_, f32>], references: &[Place], sigma: f32) -> Self {
        let side = matcher.grid.side;
        let of_groups: Vec<Vec<Place>> = references.iter().map(|&reference| matcher.like(reference)).collect();
        let shrink = |plane: &ArrayView3<'_, f32>| {
            let mut shrinker = Shrinker::new(side * side, sigma);
            for group in &of_groups {
                let patch =
                    |place: &Place, k: usize| plane[[place.frame, place.row + k / side, place.column + k % side]];
                shrinker.take(group.len(), |m, k| patch(&group[m], k));
            }
            shrinker.shrunk()
        };
        let values = planes.iter().map(shrink).collect();
        Self { members: of_groups.concat(), values }
    }

    /// Adds the patches of a frame to its channels `[C + 1, H, W]`, and 1 to the last.
    fn add_to(&self, frame: usize, side: usize, mut sums: ArrayViewMut3<'_, f32>) {
        for (i, place) in self.members.iter().enumerate().filter(|(_, place)| place.frame == frame) {
            let (rows, columns) = (place.row..place.row + side, place.column..place.column + side);
            let mut patch = sums.slice_mut(s![.., rows, columns]);
            for (values, mut sums) in self.values.iter().zip(patch.outer_iter_mut()) {
                sums.iter_mut().zip(&values[i * side * side..]).for_each(|(sum, value)| *sum += value);
            }
            patch.index_axis_mut(Axis(0), self.values.len()).mapv_inplace(|count| count + 1.0);
        }
    }
}
