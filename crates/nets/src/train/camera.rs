//! Simulated cameras that measure training clips, each with masks, noise and faults of its own, so that no single camera is learned by heart.

use super::config::{CameraConfig, MaskKind};
use crate::Result;
use crate::unrolled::unusable;
use ndarray::{Array2, Array3, ArrayView4, Axis, Zip};
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

/// A measurement of a clip `[T, C, H, W]` by a camera that is drawn from the settings; color clips through a sensor of this pattern.
pub(super) fn measure(
    clip: ArrayView4<'_, f32>,
    pattern: CfaPattern,
    settings: &CameraConfig,
    rng: &mut impl Rng,
) -> Result<Measurement> {
    let (seen, cfa) = seen(clip, pattern);
    let Masks { shown, told } = masks(seen.dim(), settings, rng);
    let mut y = (shown.as_ref().unwrap_or(&told) * &seen).sum_axis(Axis(0));
    let told = if rng.random::<f64>() < settings.mask_errors { mistold(&told, rng) } else { told };
    add_noise(&mut y, settings, rng);
    let mut kept = Array2::from_shape_simple_fn(y.dim(), || true);
    if settings.holes > 0.0 {
        let share = settings.holes * rng.random::<f64>();
        kept.mapv_inplace(|_| rng.random::<f64>() >= share);
    }
    if rng.random::<f64>() < settings.saturated {
        clip_brightest(&mut y, &mut kept, rng);
    }
    let whole = measured(told, y, cfa)?;
    if kept.iter().all(|&kept| kept) { Ok(whole) } else { whole.restricted(kept.view()).map_err(unusable) }
}

/// A measurement through binary masks of density ½, with white noise: what networks are compared by.
pub(super) fn plain(
    clip: ArrayView4<'_, f32>,
    pattern: CfaPattern,
    sigma: f32,
    rng: &mut impl Rng,
) -> Result<Measurement> {
    let (seen, cfa) = seen(clip, pattern);
    let masks = random(seen.dim(), 0.5, rng);
    let mut y = (&masks * &seen).sum_axis(Axis(0));
    y.mapv_inplace(|y| y + sigma * normal(rng));
    measured(masks, y, cfa)
}

fn measured(masks: Array3<f32>, y: Array2<f32>, cfa: Option<CfaPattern>) -> Result<Measurement> {
    let operator = MaskOperator::new(MaskStack::new(masks).map_err(unusable)?);
    Ok(Measurement::new(Arc::new(operator), y).map_err(unusable)?.with_cfa(cfa))
}

/// What a sensor sees of a clip: itself, or its mosaic.
fn seen(clip: ArrayView4<'_, f32>, pattern: CfaPattern) -> (Array3<f32>, Option<CfaPattern>) {
    let (t, c, h, w) = clip.dim();
    if c == 1 {
        return (clip.index_axis(Axis(1), 0).to_owned(), None);
    }
    let mut mosaic = Array3::zeros((t, h, w));
    mosaic_into(pattern, clip, mosaic.view_mut());
    (mosaic, Some(pattern))
}

pub(super) fn normal(rng: &mut impl Rng) -> f32 {
    StandardNormal.sample(rng)
}

/// Uniform from `-limit` to `limit`.
fn symmetric(limit: f32, rng: &mut impl Rng) -> f32 {
    limit * (2.0 * rng.random::<f32>() - 1.0)
}

type Dim = (usize, usize, usize);

/// Masks as they are told, and as they are where that differs.
struct Masks {
    shown: Option<Array3<f32>>,
    told: Array3<f32>,
}

fn masks(dim: Dim, settings: &CameraConfig, rng: &mut impl Rng) -> Masks {
    let [thin, dense] = settings.density;
    let density = thin + (dense - thin) * rng.random::<f64>();
    let told = match settings.masks[rng.random_range(0..settings.masks.len())] {
        MaskKind::Random => random(dim, density, rng),
        MaskKind::Shifting => return shifting(dim, density, settings.mask_grain, rng),
        MaskKind::Blocky => blocky(dim, density, rng),
        MaskKind::Hadamard => hadamard(dim, rng),
        MaskKind::Gray => gray(dim, rng),
    };
    Masks { shown: None, told }
}

pub(super) fn random(dim: Dim, density: f64, rng: &mut impl Rng) -> Array3<f32> {
    Array3::from_shape_simple_fn(dim, || if rng.random::<f64>() < density { 1.0 } else { 0.0 })
}

/// One pattern that moves by whole pixels from frame to frame, mostly by one; its grain, which is not told, moves with it.
fn shifting((frames, height, width): Dim, density: f64, most_grain: f32, rng: &mut impl Rng) -> Masks {
    let step = if rng.random::<f64>() < 0.7 { 1 } else { rng.random_range(2..=3) };
    let [down, across] = [(1, 0), (0, 1), (1, 1)][rng.random_range(0..3)].into();
    let [down, across]: [usize; 2] = [down * step, across * step];
    let pattern = random((1, height + down * (frames - 1), width + across * (frames - 1)), density, rng);
    let backwards = rng.random::<bool>();
    let moved = |pattern: &Array3<f32>| {
        Array3::from_shape_fn((frames, height, width), |(t, y, x)| {
            let t = if backwards { frames - 1 - t } else { t };
            pattern[[0, y + down * t, x + across * t]]
        })
    };
    let shown = (most_grain > 0.0).then(|| moved(&(&pattern * &grain(pattern.dim(), most_grain, rng))));
    Masks { shown, told: moved(&pattern) }
}

/// Factors around 1, alike in neighbouring pixels, of a standard deviation up to `most`.
fn grain(dim: Dim, most: f32, rng: &mut impl Rng) -> Array3<f32> {
    let sigma = most * rng.random::<f32>();
    // The mean of four has half of their standard deviation.
    blurred(&Array3::from_shape_simple_fn(dim, || 1.0 + 2.0 * sigma * normal(rng))).mapv_into(|c| c.max(0.0))
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
fn add_noise(y: &mut Array2<f32>, settings: &CameraConfig, rng: &mut impl Rng) {
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
fn clip_brightest(y: &mut Array2<f32>, kept: &mut Array2<bool>, rng: &mut impl Rng) {
    let mut sorted: Vec<f32> = y.iter().copied().collect();
    sorted.sort_unstable_by(f32::total_cmp);
    let share = MOST_CLIPPED * rng.random::<f64>();
    let level = sorted[((1.0 - share) * (sorted.len() - 1) as f64) as usize];
    let known = rng.random::<bool>();
    Zip::from(y).and(kept).for_each(|y, kept| {
        *kept &= !(known && *y > level);
        *y = y.min(level);
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array4, ArrayView3, s};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    const DIM: Dim = (6, 16, 8);

    fn settings() -> CameraConfig {
        CameraConfig {
            frames: [6, 6],
            density: [0.3, 0.6],
            masks: MaskKind::ALL.to_vec(),
            noise: 20.0,
            noisy: 0.5,
            holes: 0.05,
            saturated: 0.5,
            mask_errors: 0.5,
            mask_grain: 0.1,
        }
    }

    #[test]
    fn every_kind_of_mask_opens_about_half_of_the_pixels() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for kind in MaskKind::ALL {
            let settings = CameraConfig { masks: vec![kind], density: [0.5, 0.5], ..settings() };
            let told = masks((8, 32, 40), &settings, &mut rng).told;
            let mean = told.mean().unwrap();
            assert!((0.4..0.6).contains(&mean), "{kind:?}: {mean}");
            assert!(told.iter().all(|c| (0.0..=1.2).contains(c)), "{kind:?}");
        }
    }

    #[test]
    fn a_shifting_mask_and_its_grain_are_one_pattern_that_moves() {
        let Masks { shown, told } = shifting(DIM, 0.5, 0.1, &mut ChaCha8Rng::seed_from_u64(3));
        let shown = shown.unwrap();
        assert_ne!(shown, told);
        let moved = |dy: usize, dx: usize, a: ArrayView3<'_, f32>, b: ArrayView3<'_, f32>| {
            let (_, h, w) = DIM;
            a.slice(s![.., dy.., dx..]) == b.slice(s![.., ..h - dy, ..w - dx])
        };
        for masks in [shown, told] {
            let (a, b) = (masks.slice(s![..5, .., ..]), masks.slice(s![1.., .., ..]));
            let mut steps = (0..4).flat_map(|dy| (0..4).map(move |dx| (dy, dx)));
            assert!(steps.any(|(dy, dx)| moved(dy, dx, a, b) || moved(dy, dx, b, a)));
        }
    }

    #[test]
    fn a_measurement_is_that_of_the_clip_where_it_was_measured() {
        let clip = Array4::from_shape_fn((6, 3, 16, 8), |(t, c, y, x)| ((t + 2 * c + y + x) % 7) as f32 / 7.0);
        let exact =
            CameraConfig { noise: 0.0, saturated: 0.0, mask_errors: 0.0, mask_grain: 0.0, holes: 0.5, ..settings() };
        for (seed, pattern) in (0..).zip(CfaPattern::ALL) {
            let measurement = measure(clip.view(), pattern, &exact, &mut ChaCha8Rng::seed_from_u64(seed)).unwrap();
            let explained = measurement.operator().forward(seen(clip.view(), pattern).0.view());
            let error = (&explained - &measurement.y()).iter().fold(0.0f32, |most, e| most.max(e.abs()));
            assert!(error < 1e-5 && measurement.cfa() == Some(pattern), "{pattern:?}: {error}");
        }
    }

    #[test]
    fn every_fault_changes_the_measurement() {
        let clip = Array4::from_shape_fn((6, 1, 16, 8), |(t, _, y, x)| ((t + y + x) % 7) as f32 / 7.0);
        let exact = CameraConfig { noise: 0.0, saturated: 0.0, mask_errors: 0.0, mask_grain: 0.0, ..settings() };
        let none = CameraConfig { holes: 0.0, masks: vec![MaskKind::Shifting], ..exact };
        let error = |camera: &CameraConfig| {
            let rng = &mut ChaCha8Rng::seed_from_u64(5);
            let measurement = measure(clip.view(), CfaPattern::Rggb, camera, rng).unwrap();
            let explained = measurement.operator().forward(clip.index_axis(Axis(1), 0));
            (&explained - &measurement.y()).iter().map(|e| e * e).sum::<f32>()
        };
        assert!(error(&none) < 1e-6);
        assert!(error(&CameraConfig { noise: 50.0, noisy: 1.0, ..none.clone() }) > 0.1);
        assert!(error(&CameraConfig { mask_errors: 1.0, ..none.clone() }) > 0.1);
        assert!(error(&CameraConfig { mask_grain: 0.2, ..none }) > 0.1);
    }
}
