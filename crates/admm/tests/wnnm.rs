//! [`Wnnm`] as a denoiser: sizes at the edge of what there is, and the same bits whoever counts.

use admm::{Call, Denoiser, Wnnm, WnnmParams};
use ndarray::Array4;
use sci_forward::VideoShape;
use sci_forward::testing::{gaussian, moving_square};

fn denoised(params: WnnmParams, sigma: f32, noisy: &Array4<f32>) -> Array4<f32> {
    let (mut wnnm, mut out) = (Wnnm::new(params), Array4::from_elem(noisy.dim(), f32::NAN));
    wnnm.denoise(&Call::new(sigma), noisy.view(), out.view_mut()).unwrap();
    out
}

fn noisy_square(channels: usize) -> (Array4<f32>, Array4<f32>) {
    let shape = VideoShape { frames: 4, height: 30, width: 41 };
    let gray = moving_square(shape);
    let clean = Array4::from_shape_fn((4, channels, 30, 41), |(t, c, y, x)| gray[[t, y, x]] * (1.0 - 0.2 * c as f32));
    let noisy = &clean + &(gaussian(clean.dim(), 7) * 0.1);
    (clean, noisy)
}

#[test]
fn noise_goes_in_gray_and_in_color() {
    for channels in [1, 3] {
        let (clean, noisy) = noisy_square(channels);
        let out = denoised(WnnmParams::default(), 0.1, &noisy);
        let error = |v: &Array4<f32>| (v - &clean).mapv(|d| d * d).mean().unwrap();
        assert!(error(&out) < error(&noisy) / 8.0, "{channels}: {} of {}", error(&out), error(&noisy));
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let (_, noisy) = noisy_square(1);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| denoised(WnnmParams::default(), 0.1, &noisy))
    };
    assert!(on(1) == on(3));
}

#[test]
fn every_size_is_covered() {
    let odd = WnnmParams { patch: 5, group: 300, step: 9, window: 40, frames: 9, ..WnnmParams::default() };
    for shape in [(1, 1, 1, 1), (1, 1, 3, 40), (2, 3, 5, 7), (3, 1, 17, 6)] {
        for params in [WnnmParams::default(), odd] {
            // Nothing but its mean patches, which are the picture.
            let flat = Array4::from_elem(shape, 0.25);
            let out = denoised(params, 0.1, &flat);
            assert!(out.iter().all(|v| (v - 0.25).abs() < 1e-6), "{shape:?}");
        }
    }
    assert_eq!(denoised(odd, 0.1, &Array4::zeros((2, 1, 0, 5))).dim(), (2, 1, 0, 5));
}

#[test]
fn without_noise_nothing_changes_and_what_is_not_finite_ends() {
    let (_, mut noisy) = noisy_square(1);
    assert_eq!(denoised(WnnmParams::default(), 0.0, &noisy), noisy);
    noisy[[1, 0, 3, 4]] = f32::NAN;
    noisy[[2, 0, 5, 4]] = f32::INFINITY;
    assert!(denoised(WnnmParams::default(), 0.1, &noisy).iter().any(|v| !v.is_finite()));
}

/// Groups are kept for as many calls as was said, of the same video only.
#[test]
fn groups_are_kept_from_call_to_call() {
    let (_, noisy) = noisy_square(1);
    let other = noisy.slice(ndarray::s![.., .., .., ..;-1]).to_owned();
    let params = WnnmParams { match_every: 3, window: 5, ..WnnmParams::default() };
    let mut kept = Wnnm::new(params);
    let mut call = |iteration: usize, video: &Array4<f32>| {
        let mut out = Array4::zeros(video.dim());
        kept.denoise(&Call { iteration, ..Call::new(0.1) }, video.view(), out.view_mut()).unwrap();
        out
    };
    let anew = denoised(params, 0.1, &other);
    call(4, &noisy);
    assert!(call(5, &other) != anew && call(6, &other) != anew);
    assert!(call(7, &other) == anew);
    // A solve that begins is not one that goes on, nor is one that left a call out, and another size is another video.
    call(4, &noisy);
    assert!(call(6, &other) == anew);
    // Two calls of an iteration are of two parts.
    call(20, &noisy);
    call(20, &noisy);
    assert!(call(21, &other) == anew);
    call(4, &noisy);
    assert!(call(0, &other) == anew);
    let part = other.slice(ndarray::s![.., .., 4.., ..]).to_owned();
    assert!(call(1, &part) == denoised(params, 0.1, &part));
}

/// The sum of squared differences decides, whatever is known beforehand of patches that are too far off.
#[test]
fn a_group_is_the_nearest_patches() {
    // One reference patch to a frame, as large as half of it: nothing but the mean is left of weak groups.
    let noisy = gaussian((3, 1, 12, 12), 5);
    let params =
        WnnmParams { patch: 6, group: 9, step: 6, window: 12, frames: 3, weight: 1e6, ..WnnmParams::default() };
    let found = denoised(params, 1.0, &noisy);
    let patch = |t: usize, y: usize, x: usize| -> Vec<f32> {
        noisy.slice(ndarray::s![t, 0, y..y + 6, x..x + 6]).iter().copied().collect()
    };
    let places: Vec<_> = (0..3 * 49).map(|k| (k / 49, k / 7 % 7, k % 7)).collect();
    let mut sums = Array4::<f64>::zeros(noisy.dim());
    let mut counts = Array4::<f64>::zeros(noisy.dim());
    for &(t, y, x) in places.iter().filter(|(_, y, x)| y % 6 == 0 && x % 6 == 0) {
        let own = patch(t, y, x);
        let distance = |&(t, y, x): &(usize, usize, usize)| -> f32 {
            patch(t, y, x).iter().zip(&own).map(|(a, b)| (a - b).powi(2)).sum()
        };
        let mut group = places.clone();
        group.sort_by(|a, b| distance(a).total_cmp(&distance(b)));
        let mean: Vec<f64> = (0..36)
            .map(|k| group[..9].iter().map(|&(t, y, x)| f64::from(patch(t, y, x)[k])).sum::<f64>() / 9.0)
            .collect();
        for &(t, y, x) in &group[..9] {
            for (k, mean) in mean.iter().enumerate() {
                sums[[t, 0, y + k / 6, x + k % 6]] += mean;
                counts[[t, 0, y + k / 6, x + k % 6]] += 1.0;
            }
        }
    }
    for ((found, sum), count) in found.iter().zip(&sums).zip(&counts) {
        assert!((f64::from(*found) - sum / count).abs() < 1e-5, "{found} is not {}", sum / count);
    }
}
