//! The networks against outputs of public PyTorch implementations, with the published weights.

use admm::{Call, Denoiser};
use candle_core::{Device, Tensor};
use ndarray::{Array0, Array4, ArrayD, ArrayView4};
use ndarray_npy::{NpzReader, ReadNpzError};
use nets::{Ends, Fastdvdnet, Ffdnet, Layers, Network, WeightFile};
use std::fs::File;
use std::path::Path;

struct Golden(NpzReader<File>);

impl Golden {
    fn open(path: &Path) -> Self {
        Self(NpzReader::new(File::open(path).unwrap()).unwrap())
    }
    fn video(&mut self, name: &str) -> Array4<f32> {
        self.0.by_name(&format!("{name}.npy")).unwrap()
    }
    fn tensor(&mut self, name: &str) -> Tensor {
        let array: ArrayD<f32> = self.0.by_name(&format!("{name}.npy")).unwrap();
        Tensor::from_iter(array.iter().copied(), &Device::Cpu).unwrap().reshape(array.shape()).unwrap()
    }
    fn number(&mut self, name: &str) -> f32 {
        let value: Result<Array0<f64>, ReadNpzError> = self.0.by_name(&format!("{name}.npy"));
        value.unwrap().into_scalar() as f32
    }
}

fn denoise(net: &mut dyn Denoiser, noisy: &Array4<f32>, sigma: f32) -> Array4<f32> {
    let mut out = Array4::from_elem(noisy.dim(), f32::NAN);
    net.denoise(&Call::new(sigma), noisy.view(), out.view_mut()).unwrap();
    out
}

#[track_caller]
fn assert_close(found: ArrayView4<'_, f32>, expected: ArrayView4<'_, f32>, tolerance: f32) {
    assert_eq!(found.shape(), expected.shape());
    let worst = found.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst <= tolerance, "largest difference {worst:e}, allowed {tolerance:e}");
    assert!(found.iter().all(|v| v.is_finite()));
}

#[test]
fn ffdnet_gray_matches_pytorch_even_and_odd() {
    let files = test_data::files(["golden/ffdnet_gray.npz", "weights/ffdnet_gray.pth"]);
    let Some([golden, weights]) = files else { return };
    let (mut golden, mut net) = (Golden::open(&golden), Ffdnet::load(&weights).unwrap());
    assert_eq!(net.describe(), "FFDNet (gray, 64 channels, 15 layers)");
    for (input, sigma, output) in [("input", "sigma", "output"), ("odd_input", "odd_sigma", "odd_output")] {
        let sigma = golden.number(sigma);
        let found = denoise(&mut net, &golden.video(input), sigma);
        assert_close(found.view(), golden.video(output).view(), 1e-4);
    }
}

#[test]
fn ffdnet_color_matches_pytorch() {
    let files = test_data::files(["golden/ffdnet_color.npz", "weights/ffdnet_color.pth"]);
    let Some([golden, weights]) = files else { return };
    let (mut golden, mut net) = (Golden::open(&golden), Ffdnet::load(&weights).unwrap());
    let sigma = golden.number("sigma");
    let found = denoise(&mut net, &golden.video("input"), sigma);
    assert_close(found.view(), golden.video("output").view(), 1e-4);
}

#[test]
fn the_batch_norm_layout_removes_noise_and_folds_exactly() {
    let files = test_data::files(["golden/ffdnet_gray.npz", "weights/ffdnet_gray_ipol.pth"]);
    let Some([golden, weights]) = files else { return };
    let (mut golden, mut net) = (Golden::open(&golden), Ffdnet::load(&weights).unwrap());
    assert_eq!(net.describe(), "FFDNet (gray, 64 channels, 15 layers, batch norm)");
    let (noisy, sigma) = (golden.video("input"), golden.number("sigma"));
    let found = denoise(&mut net, &noisy, sigma);
    // Two different trainings of one network agree on what is image far better than with the noise (σ = 0.1).
    let rms = ((&found - &golden.video("output")).mapv(|d| d * d).mean().unwrap()).sqrt();
    assert!(rms < 0.01, "{rms}");
    net.fold_batch_norm().unwrap();
    assert_eq!(net.describe(), "FFDNet (gray, 64 channels, 15 layers, residual)");
    assert_close(denoise(&mut net, &noisy, sigma).view(), found.view(), 1e-6);
}

#[test]
fn published_files_are_recognised() {
    for (name, what) in [
        ("weights/ffdnet_gray.pth", "FFDNet (gray, 64 channels, 15 layers)"),
        ("weights/ffdnet_color.pth", "FFDNet (color, 96 channels, 12 layers)"),
        ("weights/ffdnet_gray_ipol.pth", "FFDNet (gray, 64 channels, 15 layers, batch norm)"),
        ("weights/fastdvdnet_half_color.pth", "FastDVDnet (color, 16/32/64 channels, batch norm)"),
    ] {
        let Some(path) = test_data::file(name) else { return };
        assert_eq!(WeightFile::read(&path).unwrap().architecture().unwrap().to_string(), what);
    }
}

#[test]
fn fastdvdnet_matches_pytorch_with_batch_norm_and_folded() {
    let files = test_data::files(["golden/fastdvdnet_half_color.npz", "weights/fastdvdnet_half_color.pth"]);
    let Some([golden, weights]) = files else { return };
    let mut net = Fastdvdnet::load(&weights, Ends::Circular).unwrap();
    let mut golden = Golden::open(&golden);
    let (noisy, sigma, expected) = (golden.video("input"), golden.number("sigma"), golden.video("output"));
    assert_close(denoise(&mut net, &noisy, sigma).view(), expected.view(), 1e-4);
    let tensor = |a: &Array4<f32>| Tensor::from_slice(a.as_slice().unwrap(), a.dim(), &Device::Cpu).unwrap();
    let live = net.forward(&tensor(&noisy), &[sigma]).unwrap();
    let live = Array4::from_shape_vec(noisy.dim(), live.flatten_all().unwrap().to_vec1().unwrap()).unwrap();
    assert_close(live.view(), expected.view(), 1e-4);
    net.fold_batch_norm().unwrap();
    assert_close(denoise(&mut net, &noisy, sigma).view(), expected.view(), 1e-4);
}

#[test]
fn gradients_of_the_measurement_loss_match_pytorch() {
    let files = test_data::files(["golden/online_gradient_gray.npz", "weights/ffdnet_gray.pth"]);
    let Some([golden, weights]) = files else { return };
    let (mut golden, mut net) = (Golden::open(&golden), Ffdnet::load(&weights).unwrap());
    let (mask, y, input) = (golden.tensor("mask"), golden.tensor("y"), golden.tensor("input"));
    let vars = net.make_trainable().unwrap();
    let sigma = golden.number("sigma");
    let video = net.forward(&input, &[sigma]).unwrap().squeeze(1).unwrap();
    let residual = ((mask * video).unwrap().sum(0).unwrap() - y).unwrap();
    let loss = residual.sqr().unwrap().mean_all().unwrap();
    let value = loss.to_scalar::<f32>().unwrap();
    assert!((value / golden.number("loss") - 1.0).abs() < 1e-4, "{value}");
    let grads = loss.backward().unwrap();
    for (name, expected) in [
        ("model.0.weight", "grad_first_weight"),
        ("model.0.bias", "grad_first_bias"),
        ("model.14.weight", "grad_middle_weight"),
        ("model.28.weight", "grad_last_weight"),
    ] {
        let (_, var) = vars.iter().find(|(n, _)| n == name).unwrap();
        let expected = golden.tensor(expected);
        let norm = |t: &Tensor| t.sqr().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap().sqrt();
        let error = norm(&(grads.get(var).unwrap() - &expected).unwrap()) / norm(&expected);
        assert!(error < 1e-3, "{name}: relative error {error:e}");
    }
}
