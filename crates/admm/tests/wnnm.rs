//! [`Wnnm`] as a denoiser: sizes at the edge of what there is, and the same bits whoever counts.

use admm::{Call, Denoiser, Wnnm};
use ndarray::Array4;
use sci_forward::VideoShape;
use sci_forward::testing::{gaussian, moving_square};

fn denoised(wnnm: Wnnm, sigma: f32, noisy: &Array4<f32>) -> Array4<f32> {
    let (mut wnnm, mut out) = (wnnm, Array4::from_elem(noisy.dim(), f32::NAN));
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
        let out = denoised(Wnnm::default(), 0.1, &noisy);
        let error = |v: &Array4<f32>| (v - &clean).mapv(|d| d * d).mean().unwrap();
        assert!(error(&out) < error(&noisy) / 8.0, "{channels}: {} of {}", error(&out), error(&noisy));
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let (_, noisy) = noisy_square(1);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| denoised(Wnnm::default(), 0.1, &noisy))
    };
    assert!(on(1) == on(3));
}

#[test]
fn every_size_is_covered() {
    let odd = Wnnm { patch: 5, group: 300, step: 9, window: 40, frames: 9 };
    for shape in [(1, 1, 1, 1), (1, 1, 3, 40), (2, 3, 5, 7), (3, 1, 17, 6)] {
        for wnnm in [Wnnm::default(), odd] {
            // Nothing but its mean patches, which are the picture.
            let flat = Array4::from_elem(shape, 0.25);
            let out = denoised(wnnm, 0.1, &flat);
            assert!(out.iter().all(|v| (v - 0.25).abs() < 1e-6), "{shape:?}");
        }
    }
    assert_eq!(denoised(odd, 0.1, &Array4::zeros((2, 1, 0, 5))).dim(), (2, 1, 0, 5));
}

#[test]
fn without_noise_nothing_changes_and_what_is_not_finite_ends() {
    let (_, mut noisy) = noisy_square(1);
    assert_eq!(denoised(Wnnm::default(), 0.0, &noisy), noisy);
    noisy[[1, 0, 3, 4]] = f32::NAN;
    noisy[[2, 0, 5, 4]] = f32::INFINITY;
    assert!(denoised(Wnnm::default(), 0.1, &noisy).iter().any(|v| !v.is_finite()));
}
