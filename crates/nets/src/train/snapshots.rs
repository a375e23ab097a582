//! Training through the whole solve of the unfolding network: clips measured by simulated cameras, each with masks, noise and faults of
//! its own, so that no single camera is learned by heart.

use super::config::{Loss, MaskKind, SnapshotsConfig};
use super::iterates::start_prior;
use crate::unfolding::{Progress, Snapshot, UnfoldingNet, phases};
use crate::unrolled::{Gradients, typed, unusable};
use crate::{Error, Result};
use admm::{Call, Estimate, Gap, Plan, Prior, PriorError, Stage, Start, run};
use candle_core::{Tensor, Var};
use ndarray::{Array2, Array3, Array4, ArrayView3, ArrayView4, Axis, Zip, s};
use rand::{Rng, RngExt};
use rand_distr::{Distribution, StandardNormal};
use sci_forward::bayer::mosaic_into;
use sci_forward::{CfaPattern, MaskOperator, MaskStack, Measurement};
use std::sync::Arc;

/// Largest errors of masks that are told wrongly: pixels, share of the gain of a frame, share of the full transmittance that leaks.
const MASK_SHIFT: f32 = 0.3;
const MASK_GAIN: f32 = 0.03;
const MASK_PEDESTAL: f32 = 0.01;
/// Largest share of the pixels that a saturated sensor clips.
const MOST_CLIPPED: f64 = 0.1;
/// Noise of the clips that have nearly none, at most, in units of full scale.
const NEARLY_NONE: f32 = 1.0 / 255.0;

/// A clip and its measurement, and how far its solve has come.
pub(super) struct Exercise {
    pub(super) snapshot: Snapshot,
    /// The frames as phases.
    pub(super) clean: Tensor,
    /// What it was drawn with.
    pub(super) seed: u64,
    pub(super) progress: Option<Progress>,
    /// Iterations after which it is through.
    pub(super) end: usize,
}

impl Exercise {
    /// A clip `[T, C, H, W]` seen by a camera that is drawn from the settings; color clips through an RGGB sensor: the network is shown
    /// other patterns from another first pixel.
    pub(super) fn new(clip: ArrayView4<'_, f32>, settings: &SnapshotsConfig, rng: &mut impl Rng) -> Result<Self> {
        let (seen, clean) = (seen(clip), clean_phases(clip)?);
        let masks = masks(seen.dim(), settings, rng);
        let mut y = (&masks * &seen).sum_axis(Axis(0));
        let mut told = if rng.random::<f64>() < settings.mask_errors { mistold(&masks, rng) } else { masks };
        add_noise(&mut y, settings, rng);
        let mut closed = Array2::from_shape_simple_fn(y.dim(), || false);
        if settings.holes > 0.0 {
            let share = settings.holes * rng.random::<f64>();
            closed.mapv_inplace(|_| rng.random::<f64>() < share);
        }
        if rng.random::<f64>() < settings.saturated {
            clip_brightest(&mut y, &mut closed, rng);
        }
        Zip::from(&mut y).and(&closed).for_each(|y, &closed| *y = if closed { 0.0 } else { *y });
        for mut mask in told.outer_iter_mut() {
            Zip::from(&mut mask).and(&closed).for_each(|c, &closed| *c = if closed { 0.0 } else { *c });
        }
        let cfa = (clip.len_of(Axis(1)) == 3).then_some(CfaPattern::Rggb);
        let snapshot = snapshot(told, y, cfa, settings.start_iterations)?;
        Ok(Self { snapshot, clean, seed: 0, progress: None, end: settings.iterations })
    }

    /// A clip through binary masks of density ½, with white noise on the measurement: what networks are compared by.
    pub(super) fn plain(
        clip: ArrayView4<'_, f32>,
        sigma: f32,
        start_iterations: usize,
        rng: &mut impl Rng,
    ) -> Result<Self> {
        let seen = seen(clip);
        let masks = random(seen.dim(), 0.5, rng);
        let mut y = (&masks * &seen).sum_axis(Axis(0));
        y.mapv_inplace(|y| y + sigma * normal(rng));
        let cfa = (clip.len_of(Axis(1)) == 3).then_some(CfaPattern::Rggb);
        let snapshot = snapshot(masks, y, cfa, start_iterations)?;
        Ok(Self { snapshot, clean: clean_phases(clip)?, seed: 0, progress: None, end: 0 })
    }

    /// Mean square error of each frame of a result.
    pub(super) fn errors(&self, result: &Tensor) -> Result<Vec<f32>> {
        Ok((result - &self.clean)?.sqr()?.flatten_from(1)?.mean(1)?.to_vec1()?)
    }

    pub(super) fn iterations_done(&self) -> usize {
        self.progress.as_ref().map_or(0, |progress| progress.iterations)
    }

    /// The next `iterations` of the solve, as a graph.
    pub(super) fn unfold(&self, net: &UnfoldingNet, iterations: usize) -> Result<(Vec<Tensor>, Tensor)> {
        net.unfold(&self.snapshot, self.progress.as_ref(), iterations)
    }

    /// Goes on by `iterations`. Returns the weighted mean loss of their results, the k-th with weight k as the last is what a user gets, and
    /// its gradient for each of `vars`; none goes back to iterations before these.
    pub(super) fn advance(
        &mut self,
        net: &UnfoldingNet,
        iterations: usize,
        vars: &[(String, Var)],
        loss: Loss,
    ) -> Result<Gradients> {
        let (results, features) = self.unfold(net, iterations)?;
        let weights = (results.len() * (results.len() + 1) / 2) as f64;
        let mut sum = Tensor::zeros((), self.clean.dtype(), self.clean.device())?;
        for (k, result) in results.iter().enumerate() {
            sum = (sum + (loss.mean(&(result - &self.clean)?)? * ((k + 1) as f64 / weights))?)?;
        }
        let mut found = Gradients::zero(vars.len());
        found.add_found(sum.to_scalar()?, &sum.backward()?, vars)?;
        let iterations = self.iterations_done() + results.len();
        self.progress =
            results.last().map(|result| Progress { iterations, result: result.detach(), features: features.detach() });
        Ok(found)
    }
}

/// A measurement with its x₀: what plain GAP gives a prior first.
fn snapshot(masks: Array3<f32>, y: Array2<f32>, cfa: Option<CfaPattern>, start_iterations: usize) -> Result<Snapshot> {
    let operator = MaskOperator::new(MaskStack::new(masks).map_err(unusable)?);
    let masks = operator.source().view().to_owned();
    let measurement = Measurement::new(Arc::new(operator), y).map_err(unusable)?.with_cfa(cfa);
    let stage = |iterations| Stage { sigma: None, iterations };
    let mut prior = start_prior(&measurement);
    let start = match start_iterations {
        0 => Start::Mean,
        iterations => Start::Warm { prior: &mut *prior, stage: stage(iterations) },
    };
    let begun = run(&mut Gap::plain(Nothing), &measurement, start, &Plan::new([stage(1)]), &mut ()).map_err(typed)?;
    Snapshot::new(masks.view(), measurement.y(), begun.estimate.sensor.view())
}

/// A prior that changes nothing.
struct Nothing;

impl Prior for Nothing {
    fn apply(
        &mut self,
        _: &Call<'_>,
        noisy: ArrayView3<'_, f32>,
        out: &mut Estimate,
    ) -> std::result::Result<(), PriorError> {
        out.rgb = None;
        out.sensor.assign(&noisy);
        Ok(())
    }
}

/// What a sensor sees of a clip: itself, or its RGGB mosaic.
fn seen(clip: ArrayView4<'_, f32>) -> Array3<f32> {
    let (t, c, h, w) = clip.dim();
    if c == 1 {
        return clip.index_axis(Axis(1), 0).to_owned();
    }
    let mut mosaic = Array3::zeros((t, h, w));
    mosaic_into(CfaPattern::Rggb, clip, mosaic.view_mut());
    mosaic
}

/// `[T, 4 C, H/2, W/2]`.
fn clean_phases(clip: ArrayView4<'_, f32>) -> Result<Tensor> {
    let (t, c, h, w) = clip.dim();
    let planes = clip.to_shape((t * c, h, w)).map_err(|e| Error::Data(e.to_string()))?;
    Ok(phases(planes.view())?.reshape((t, 4 * c, h / 2, w / 2))?)
}

fn normal(rng: &mut impl Rng) -> f32 {
    StandardNormal.sample(rng)
}

/// Uniform from `-limit` to `limit`.
fn symmetric(limit: f32, rng: &mut impl Rng) -> f32 {
    limit * (2.0 * rng.random::<f32>() - 1.0)
}

type Dim = (usize, usize, usize);

fn masks(dim: Dim, settings: &SnapshotsConfig, rng: &mut impl Rng) -> Array3<f32> {
    let [thin, dense] = settings.density;
    let density = thin + (dense - thin) * rng.random::<f64>();
    match settings.masks[rng.random_range(0..settings.masks.len())] {
        MaskKind::Random => random(dim, density, rng),
        MaskKind::Shifting => shifting(dim, density, rng),
        MaskKind::Blocky => blocky(dim, density, rng),
        MaskKind::Hadamard => hadamard(dim, rng),
        MaskKind::Gray => gray(dim, rng),
    }
}

fn random(dim: Dim, density: f64, rng: &mut impl Rng) -> Array3<f32> {
    Array3::from_shape_simple_fn(dim, || if rng.random::<f64>() < density { 1.0 } else { 0.0 })
}

/// One pattern that moves by whole pixels from frame to frame, mostly by one.
fn shifting((frames, height, width): Dim, density: f64, rng: &mut impl Rng) -> Array3<f32> {
    let step = if rng.random::<f64>() < 0.7 { 1 } else { rng.random_range(2..=3) };
    let [down, across] = [(1, 0), (0, 1), (1, 1)][rng.random_range(0..3)].into();
    let [down, across]: [usize; 2] = [down * step, across * step];
    let pattern = random((1, height + down * (frames - 1), width + across * (frames - 1)), density, rng);
    let backwards = rng.random::<bool>();
    Array3::from_shape_fn((frames, height, width), |(t, y, x)| {
        let t = if backwards { frames - 1 - t } else { t };
        pattern[[0, y + down * t, x + across * t]]
    })
}

/// Squares of two to four pixels that are open or shut together.
fn blocky((frames, height, width): Dim, density: f64, rng: &mut impl Rng) -> Array3<f32> {
    let side = rng.random_range(2..=4);
    let coarse = random((frames, height / side + 2, width / side + 2), density, rng);
    let offset: [usize; 2] = [rng.random_range(0..side), rng.random_range(0..side)];
    Array3::from_shape_fn((frames, height, width), |(t, y, x)| {
        coarse[[t, (y + offset[0]) / side, (x + offset[1]) / side]]
    })
}

/// The code of each pixel over time is a row of a Hadamard matrix, any but the first.
fn hadamard((frames, height, width): Dim, rng: &mut impl Rng) -> Array3<f32> {
    let order = frames.next_power_of_two().max(2);
    let rows = Array2::from_shape_simple_fn((height, width), || rng.random_range(1..order));
    Array3::from_shape_fn((frames, height, width), |(t, y, x)| ((rows[[y, x]] & t).count_ones() % 2) as f32)
}

/// Any transmittance, alike in neighbouring pixels, with a gain of its own in each frame.
fn gray(dim: Dim, rng: &mut impl Rng) -> Array3<f32> {
    let mut masks = Array3::from_shape_simple_fn(dim, || rng.random::<f32>());
    for _ in 0..rng.random_range(0..=2) {
        masks = blurred(&masks);
        // Blurring takes two thirds of the contrast.
        masks.mapv_inplace(|c| (0.5 + 1.7 * (c - 0.5)).clamp(0.0, 1.0));
    }
    for mut mask in masks.outer_iter_mut() {
        let gain = 1.0 + symmetric(0.2, rng);
        mask.mapv_inplace(|c| gain * c);
    }
    masks
}

/// The mean of each pixel and the three to the right, below and across, mirrored at the edge.
fn blurred(masks: &Array3<f32>) -> Array3<f32> {
    let (_, height, width) = masks.dim();
    let after = |i: usize, n: usize| if i + 1 < n { i + 1 } else { i };
    Array3::from_shape_fn(masks.dim(), |(t, y, x)| {
        let (below, right) = (after(y, height), after(x, width));
        (masks[[t, y, x]] + masks[[t, y, right]] + masks[[t, below, x]] + masks[[t, below, right]]) / 4.0
    })
}

/// Masks as a calibration that is a little off has them: moved by a part of a pixel, each frame with a wrong gain, all with a pedestal.
fn mistold(masks: &Array3<f32>, rng: &mut impl Rng) -> Array3<f32> {
    let (_, height, width) = masks.dim();
    let [dy, dx] = [symmetric(MASK_SHIFT, rng), symmetric(MASK_SHIFT, rng)];
    let pedestal = MASK_PEDESTAL * rng.random::<f32>();
    let gains: Vec<f32> = masks.outer_iter().map(|_| 1.0 + symmetric(MASK_GAIN, rng)).collect();
    let beside = |i: usize, d: f32, n: usize| if d > 0.0 { (i + 1).min(n - 1) } else { i.saturating_sub(1) };
    Array3::from_shape_fn(masks.dim(), |(t, y, x)| {
        let (by, bx) = (beside(y, dy, height), beside(x, dx, width));
        let row = |y: usize| masks[[t, y, x]] * (1.0 - dx.abs()) + masks[[t, y, bx]] * dx.abs();
        gains[t] * (row(y) * (1.0 - dy.abs()) + row(by) * dy.abs()) + pedestal
    })
}

/// White and shot noise: in most clips nearly none, else of any σ up to the largest, which is that of a pixel of average brightness.
fn add_noise(y: &mut Array2<f32>, settings: &SnapshotsConfig, rng: &mut impl Rng) {
    let most = if rng.random::<f64>() >= settings.noisy {
        NEARLY_NONE.min(settings.noise / 255.0)
    } else {
        settings.noise / 255.0
    };
    let (sigma, shot) = (most * rng.random::<f32>(), rng.random::<f32>());
    let mean = y.mean().unwrap_or(0.0).max(f32::MIN_POSITIVE);
    y.mapv_inplace(|y| y + sigma * (1.0 - shot + shot * (y / mean).max(0.0)).sqrt() * normal(rng));
}

/// Clips the brightest pixels; half the time they are known, and left out.
fn clip_brightest(y: &mut Array2<f32>, closed: &mut Array2<bool>, rng: &mut impl Rng) {
    let mut sorted: Vec<f32> = y.iter().copied().collect();
    sorted.sort_unstable_by(f32::total_cmp);
    let share = MOST_CLIPPED * rng.random::<f64>();
    let level = sorted[((1.0 - share) * (sorted.len() - 1) as f64) as usize];
    let known = rng.random::<bool>();
    Zip::from(y).and(closed).for_each(|y, closed| {
        *closed |= known && *y > level;
        *y = y.min(level);
    });
}

/// The middle of a video `[T, C, H, W]` with sides that are multiples of `multiple`.
pub(super) fn cut(video: &Array4<f32>, multiple: usize) -> Array4<f32> {
    let (_, _, h, w) = video.dim();
    let [h, w] = [h, w].map(|n| n / multiple * multiple);
    video.slice(s![.., .., ..h, ..w]).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::UnfoldingSpec;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    const DIM: Dim = (6, 16, 8);

    fn settings() -> SnapshotsConfig {
        SnapshotsConfig {
            frames: [6, 6],
            density: [0.3, 0.6],
            masks: MaskKind::ALL.to_vec(),
            noise: 20.0,
            noisy: 0.5,
            holes: 0.05,
            saturated: 0.5,
            mask_errors: 0.5,
            start_iterations: 2,
            iterations: 3,
            at_once: 3,
        }
    }

    #[test]
    fn every_kind_of_mask_opens_about_half_of_the_pixels() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for kind in MaskKind::ALL {
            let settings = SnapshotsConfig { masks: vec![kind], density: [0.5, 0.5], ..settings() };
            let masks = masks((8, 32, 40), &settings, &mut rng);
            let mean = masks.mean().unwrap();
            assert!((0.4..0.6).contains(&mean), "{kind:?}: {mean}");
            assert!(masks.iter().all(|c| (0.0..=1.2).contains(c)), "{kind:?}");
        }
    }

    #[test]
    fn a_shifting_mask_is_one_pattern_that_moves() {
        let masks = shifting(DIM, 0.5, &mut ChaCha8Rng::seed_from_u64(3));
        let moved = |dy: usize, dx: usize, a: ArrayView3<'_, f32>, b: ArrayView3<'_, f32>| {
            let (_, h, w) = DIM;
            a.slice(s![.., dy.., dx..]) == b.slice(s![.., ..h - dy, ..w - dx])
        };
        let (a, b) = (masks.slice(s![..5, .., ..]), masks.slice(s![1.., .., ..]));
        let steps = (0..4).flat_map(|dy| (0..4).map(move |dx| (dy, dx)));
        assert!(steps.into_iter().any(|(dy, dx)| moved(dy, dx, a, b) || moved(dy, dx, b, a)));
    }

    /// Along the gradient in the weights the whole loss changes as it says, through network, shift and projection of every iteration.
    #[test]
    fn the_gradient_is_that_of_the_whole_loss() {
        for channels in [1, 3] {
            let spec = UnfoldingSpec { channels, iterations: 3, widths: [16, 16, 16], depth: 1 };
            let mut net = UnfoldingNet::random(spec, 1).unwrap();
            let (t, h, w) = DIM;
            let clip = Array4::from_shape_fn((t, channels, h, w), |(t, c, y, x)| {
                ((7 * t + 5 * y + 3 * x + c) % 11) as f32 / 11.0
            });
            let exercise = || Exercise::new(clip.view(), &settings(), &mut ChaCha8Rng::seed_from_u64(2)).unwrap();
            let vars = crate::Layers::make_trainable(&mut net).unwrap();
            let mut rng = ChaCha8Rng::seed_from_u64(4);
            for (_, var) in &vars {
                let values: Vec<f32> = (0..var.elem_count()).map(|_| 0.1 * normal(&mut rng)).collect();
                var.set(&Tensor::from_vec(values, var.shape(), var.device()).unwrap()).unwrap();
            }
            let found = exercise().advance(&net, 3, &vars, Loss::L2).unwrap();
            let gradients: Vec<Vec<f32>> = found.of_vars.into_iter().map(Option::unwrap).collect();
            let norm = gradients.iter().flatten().map(|&g| f64::from(g).powi(2)).sum::<f64>().sqrt();
            let old: Vec<Vec<f32>> = vars.iter().map(|(_, v)| v.flatten_all().unwrap().to_vec1().unwrap()).collect();
            let at = |step: f64| {
                for (((_, var), old), g) in vars.iter().zip(&old).zip(&gradients) {
                    let new: Vec<f32> = old.iter().zip(g).map(|(w, g)| w + (step / norm) as f32 * g).collect();
                    var.set(&Tensor::from_vec(new, var.shape(), var.device()).unwrap()).unwrap();
                }
                f64::from(exercise().advance(&net, 3, &vars, Loss::L2).unwrap().loss)
            };
            let slope = (at(2e-3) - at(-2e-3)) / 4e-3;
            assert!((slope - norm).abs() < 0.02 * norm, "slope {slope}, gradient {norm}");
        }
    }
}
