//! The gradient of the loss: against autodiff of the whole video at once, PyTorch, and finite differences.

use admm::{DenoiseCx, Denoiser};
use candle_core::{Device, Tensor, Var};
use ndarray::{Array0, Array1, Array2, Array3, Array4, ArrayView4, Axis};
use ndarray_npy::NpzReader;
use nets::kernels::Isa;
use nets::{Ends, Fastdvdnet, FastdvdnetSpec, Ffdnet, FfdnetLayout, FfdnetSpec, Network, Parameters};
use online::{Pixels, Snapshot, accumulate_gradient};
use sci_forward::testing::{gaussian, uniform};
use sci_forward::{CfaPattern, MaskOperator, MaskStack, SensingOperator, VideoShape};
use std::fs::File;
use std::sync::Arc;

const SIGMA: f32 = 0.1;

fn snapshot(shape: VideoShape, cfa: Option<CfaPattern>) -> Snapshot {
    let operator = Arc::new(MaskOperator::new(MaskStack::new(uniform(shape.dim(), 1)).unwrap()));
    let y = operator.forward(uniform(shape.dim(), 2).view());
    Snapshot::new(operator, y.view(), cfa).unwrap()
}

fn tensor(video: ArrayView4<'_, f32>) -> Tensor {
    Tensor::from_vec(video.iter().copied().collect::<Vec<_>>(), video.dim(), &Device::Cpu).unwrap()
}

/// `∂ℓ/∂v` with the residual of the network's own inference.
fn upstream<N: Network + Denoiser>(
    net: &mut N,
    snapshot: &Snapshot,
    pixels: &Pixels,
    x: ArrayView4<'_, f32>,
) -> Array4<f32> {
    let mut v = Array4::zeros(x.dim());
    net.denoise(&DenoiseCx::new(SIGMA), x, v.view_mut()).unwrap();
    snapshot.pull_back(pixels.gradient(snapshot.residual(v.view()).unwrap().view()).view())
}

fn two_pass<N: Network + Denoiser>(
    net: &mut N,
    snapshot: &Snapshot,
    pixels: &Pixels,
    x: ArrayView4<'_, f32>,
    which: Parameters,
) -> (Vec<(String, Var)>, Vec<Vec<f32>>) {
    let vars = net.make_some_trainable(which).unwrap();
    let upstream = upstream(net, snapshot, pixels, x);
    let mut sums: Vec<Vec<f32>> = vars.iter().map(|(_, v)| vec![0.0; v.elem_count()]).collect();
    accumulate_gradient(net, &vars, x, SIGMA, upstream.view(), &mut sums).unwrap();
    (vars, sums)
}

/// The loss as one graph over all frames.
fn whole_loss(net: &dyn Network, snapshot: &Snapshot, x: ArrayView4<'_, f32>) -> Tensor {
    let (t, c, h, w) = x.dim();
    // C_t where the sensor sees the channel: the adjoint of an image of ones.
    let seen = snapshot.pull_back(Array2::ones((h, w)).view());
    let y = Tensor::from_vec(snapshot.y().iter().copied().collect::<Vec<_>>(), (h, w), &Device::Cpu).unwrap();
    let v = net.forward(&tensor(x), &[SIGMA]).unwrap();
    let summed = (v * tensor(seen.view())).unwrap().reshape((t * c, h, w)).unwrap().sum(0).unwrap();
    (summed - y).unwrap().sqr().unwrap().mean_all().unwrap()
}

#[track_caller]
fn assert_equals_whole_graph<N: Network + Denoiser>(mut net: N, shape: VideoShape, which: Parameters) {
    let cfa = (net.channels() == 3).then_some(CfaPattern::Grbg);
    let (snapshot, pixels) = (snapshot(shape, cfa), Pixels::split(shape.image_dim(), 0.0, 0));
    let x = uniform((shape.frames, net.channels(), shape.height, shape.width), 3);
    let (vars, sums) = two_pass(&mut net, &snapshot, &pixels, x.view(), which);
    let whole = whole_loss(&net, &snapshot, x.view()).backward().unwrap();
    assert!(!vars.is_empty());
    for ((name, var), sum) in vars.iter().zip(&sums) {
        let expected = whole.get(var).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let scale = expected.iter().fold(0f32, |m, v| m.max(v.abs()));
        let worst = expected.iter().zip(sum).fold(0f32, |m, (a, b)| m.max((a - b).abs()));
        assert!(scale > 0.0 && worst <= 1e-5 * scale.max(1.0), "{}, {name}: {worst:e} of {scale:e}", net.describe());
    }
}

/// Runs the test with f32 kernels in a process of its own if this one infers on the matrix unit, whose residual is exact to
/// 1e-5 and the gradient with it to 1e-3; true if that was done.
fn delegated(test: &str) -> bool {
    if Isa::detect().unwrap() != Isa::Amx {
        return false;
    }
    let exact = Isa::ALL.into_iter().find(|isa| *isa != Isa::Amx && isa.available()).unwrap();
    let mut command = std::process::Command::new(std::env::current_exe().unwrap());
    let run = command.args(["--exact", test]).env("SCI_KERNEL", exact.name()).output().unwrap();
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stdout));
    true
}

const SHAPE: VideoShape = VideoShape { frames: 5, height: 13, width: 10 };

#[test]
fn ffdnet_in_both_layouts_equals_the_whole_graph() {
    if delegated("ffdnet_in_both_layouts_equals_the_whole_graph") {
        return;
    }
    for layout in [FfdnetLayout::Direct, FfdnetLayout::Residual { batch_norm: true }] {
        for channels in [1, 3] {
            let spec = FfdnetSpec { channels, width: 8, depth: 4, layout };
            assert_equals_whole_graph(Ffdnet::random(spec, 4).unwrap(), SHAPE, Parameters::All);
        }
    }
}

/// Frames so tall that they are taken in strips, the last one higher than the others.
#[test]
fn tall_frames_in_strips_equal_the_whole_graph() {
    if delegated("tall_frames_in_strips_equal_the_whole_graph") {
        return;
    }
    let spec = FfdnetSpec { channels: 1, width: 8, depth: 4, layout: FfdnetLayout::Direct };
    let tall = VideoShape { frames: 2, height: 401, width: 10 };
    assert_equals_whole_graph(Ffdnet::random(spec, 4).unwrap(), tall, Parameters::All);
}

#[test]
fn fastdvdnet_in_windows_equals_the_whole_graph() {
    if delegated("fastdvdnet_in_windows_equals_the_whole_graph") {
        return;
    }
    for ends in [Ends::Circular, Ends::Mirrored] {
        for (channels, batch_norm) in [(1, true), (3, false)] {
            let spec = FastdvdnetSpec { channels, widths: [4, 8, 8], batch_norm };
            assert_equals_whole_graph(Fastdvdnet::random(spec, ends, 5).unwrap(), SHAPE, Parameters::All);
        }
    }
}

#[test]
fn parts_of_the_parameters_have_the_same_gradient() {
    let spec = FfdnetSpec { channels: 1, width: 8, depth: 4, layout: FfdnetLayout::Residual { batch_norm: true } };
    for which in [Parameters::Biases, Parameters::FirstLast, Parameters::Last, Parameters::NormAffine] {
        assert_equals_whole_graph(Ffdnet::random(spec, 6).unwrap(), SHAPE, which);
    }
    let names = |which| -> Vec<String> {
        let vars = Ffdnet::random(spec, 6).unwrap().make_some_trainable(which).unwrap();
        vars.into_iter().map(|(name, _)| name.rsplit_once("dncnn.").unwrap().1.to_owned()).collect()
    };
    assert_eq!(names(Parameters::Biases), ["3.bias", "6.bias"]);
    assert_eq!(names(Parameters::FirstLast), ["0.weight", "8.weight"]);
    assert_eq!(names(Parameters::Last), ["8.weight"]);
    assert_eq!(names(Parameters::NormAffine), ["3.weight", "3.bias", "6.weight", "6.bias"]);
}

#[test]
fn the_gradient_equals_pytorchs() {
    // Before it is delegated, so that it is seen to be skipped.
    let files = test_data::files(["golden/online_gradient_gray.npz", "weights/ffdnet_gray.pth"]);
    let Some([golden, weights]) = files else { return };
    if delegated("the_gradient_equals_pytorchs") {
        return;
    }
    let mut golden = NpzReader::new(File::open(golden).unwrap()).unwrap();
    let masks: Array3<f32> = golden.by_name("mask.npy").unwrap();
    let y: Array2<f32> = golden.by_name("y.npy").unwrap();
    let x: Array4<f32> = golden.by_name("input.npy").unwrap();
    let sigma: Array0<f64> = golden.by_name("sigma.npy").unwrap();
    let loss: Array0<f64> = golden.by_name("loss.npy").unwrap();
    let operator = Arc::new(MaskOperator::new(MaskStack::new(masks).unwrap()));
    let snapshot = Snapshot::new(operator, y.view(), None).unwrap();
    let pixels = Pixels::split(y.dim(), 0.0, 0);
    let mut net = Ffdnet::load(&weights).unwrap();
    let vars = net.make_trainable().unwrap();

    let sigma = *sigma.first().unwrap() as f32;
    let mut v = Array4::zeros(x.dim());
    net.denoise(&DenoiseCx::new(sigma), x.view(), v.view_mut()).unwrap();
    let residual = snapshot.residual(v.view()).unwrap();
    let (found, expected) = (pixels.loss(residual.view()).loss, *loss.first().unwrap());
    assert!((found / expected - 1.0).abs() < 1e-4, "loss {found} instead of {expected}");

    let upstream = snapshot.pull_back(pixels.gradient(residual.view()).view());
    let mut sums: Vec<Vec<f32>> = vars.iter().map(|(_, v)| vec![0.0; v.elem_count()]).collect();
    accumulate_gradient(&net, &vars, x.view(), sigma, upstream.view(), &mut sums).unwrap();
    let compare = |name: &str, expected: Vec<f32>| {
        let i = vars.iter().position(|(n, _)| n == name).unwrap();
        let scale = expected.iter().fold(0f32, |m, v| m.max(v.abs()));
        let worst = expected.iter().zip(&sums[i]).fold(0f32, |m, (a, b)| m.max((a - b).abs()));
        assert_eq!(expected.len(), sums[i].len());
        assert!(worst <= 1e-4 * scale, "{name}: {worst:e} of {scale:e}");
    };
    let bias: Array1<f32> = golden.by_name("grad_first_bias.npy").unwrap();
    compare("model.0.bias", bias.to_vec());
    for (name, key) in [("model.0.weight", "first"), ("model.14.weight", "middle"), ("model.28.weight", "last")] {
        let grad: Array4<f32> = golden.by_name(&format!("grad_{key}_weight.npy")).unwrap();
        compare(name, grad.iter().copied().collect());
    }
}

#[test]
fn one_weight_moved_changes_the_loss_as_the_gradient_says() {
    let shape = VideoShape { frames: 3, height: 12, width: 12 };
    let (snapshot, pixels) = (snapshot(shape, None), Pixels::split(shape.image_dim(), 0.2, 7));
    let x = uniform((3, 1, 12, 12), 3);
    let mut net = Ffdnet::random(FfdnetSpec { width: 8, depth: 3, ..FfdnetSpec::GRAY }, 8).unwrap();
    let (vars, sums) = two_pass(&mut net, &snapshot, &pixels, x.view(), Parameters::All);
    for (layer, index) in [(0, 17), (2, 100), (4, 5)] {
        let var = &vars[layer].1;
        let start = var.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let step = 1e-2;
        let mut loss = |by: f32| {
            let mut moved = start.clone();
            moved[index] += by;
            var.set(&Tensor::from_vec(moved, var.shape(), &Device::Cpu).unwrap()).unwrap();
            let mut v = Array4::zeros(x.dim());
            net.denoise(&DenoiseCx::new(SIGMA), x.view(), v.view_mut()).unwrap();
            pixels.loss(snapshot.residual(v.view()).unwrap().view()).loss
        };
        let slope = (loss(step) - loss(-step)) / f64::from(2.0 * step);
        let found = f64::from(sums[layer][index]);
        assert!((slope - found).abs() <= 0.01 * slope.abs().max(1e-3), "{}: {found} instead of {slope}", vars[layer].0);
        loss(0.0);
    }
}

#[test]
fn pixels_held_out_have_no_gradient_and_a_loss_of_their_own() {
    let residual = gaussian((20, 30), 9);
    let pixels = Pixels::split((20, 30), 0.25, 10);
    let gradient = pixels.gradient(residual.view());
    let held = gradient.iter().filter(|g| **g == 0.0).count();
    assert!((100..200).contains(&held), "{held} of 600 held out");
    let (seen, out): (Vec<_>, Vec<_>) = residual.iter().zip(&gradient).partition(|(_, g)| **g != 0.0);
    let mean = |of: &[(&f32, &f32)]| of.iter().map(|(r, _)| f64::from(**r).powi(2)).sum::<f64>() / of.len() as f64;
    let loss = pixels.loss(residual.view());
    assert!((loss.loss - mean(&seen)).abs() < 1e-9 && (loss.held_out.unwrap() - mean(&out)).abs() < 1e-9);
    assert_eq!(Pixels::split((20, 30), 0.25, 10), pixels);
    assert_ne!(Pixels::split((20, 30), 0.25, 11), pixels);
    // A fraction of 1 would leave nothing to learn from.
    assert!(Pixels::split((2, 2), 0.999_999_9, 0).loss(Array2::ones((2, 2)).view()).loss.is_finite());
    assert_eq!(residual.len_of(Axis(0)), 20);
}

#[test]
fn a_blinded_input_says_nothing_of_the_pixels_that_are_looked_at() {
    let size = (16, 18);
    let pixels = Pixels::blind(size, 0.1, 0.2, 12);
    let looked_at = |at| {
        let mut residual = Array2::zeros(size);
        residual[at] = 1.0;
        let loss = pixels.loss(residual.view());
        loss.loss > 0.0 || loss.held_out.unwrap() > 0.0
    };
    let video = uniform((2, 3, 16, 18), 13);
    let blinded = pixels.blinded(video.view()).unwrap();
    let mut hidden = 0;
    for at in ndarray::indices(size) {
        if looked_at(at) {
            hidden += 1;
            let mut other = video.clone();
            other.slice_mut(ndarray::s![.., .., at.0, at.1]).fill(9.0);
            assert_eq!(pixels.blinded(other.view()).unwrap(), blinded, "{at:?}");
        } else {
            let here = ndarray::s![.., .., at.0, at.1];
            assert_eq!(blinded.slice(here), video.slice(here));
        }
    }
    assert!((50..130).contains(&hidden), "{hidden} of 288");
    assert_eq!(Pixels::split(size, 0.1, 12).blinded(video.view()), None);
}

/// Frames that take turns: their gradients add up to that of all frames, and frames without one are left out.
#[test]
fn the_gradients_of_parts_of_the_frames_add_up() {
    let shape = VideoShape { frames: 5, height: 8, width: 10 };
    let snapshot = snapshot(shape, None);
    let x = uniform((5, 1, 8, 10), 3);
    let ffdnet = Ffdnet::random(FfdnetSpec { width: 8, depth: 3, ..FfdnetSpec::GRAY }, 0).unwrap();
    let spec = FastdvdnetSpec { channels: 1, widths: [4, 8, 8], batch_norm: false };
    let fastdvdnet = Fastdvdnet::random(spec, Ends::Circular, 0).unwrap();
    parts_add_up(ffdnet, &snapshot, x.view());
    parts_add_up(fastdvdnet, &snapshot, x.view());
}

fn parts_add_up<N: Network + Denoiser>(mut net: N, snapshot: &Snapshot, x: ArrayView4<'_, f32>) {
    let pixels = Pixels::split(snapshot.shape().image_dim(), 0.0, 0);
    let (vars, whole) = two_pass(&mut net, snapshot, &pixels, x, Parameters::All);
    let upstream = upstream(&mut net, snapshot, &pixels, x);
    let mut sums: Vec<Vec<f32>> = whole.iter().map(|g| vec![0.0; g.len()]).collect();
    for turn in 0..2 {
        let mut part = upstream.clone();
        part.outer_iter_mut().enumerate().filter(|(t, _)| t % 2 != turn).for_each(|(_, mut f)| f.fill(0.0));
        accumulate_gradient(&net, &vars, x, SIGMA, part.view(), &mut sums).unwrap();
    }
    let largest = whole.iter().flatten().fold(0f32, |m, v| m.max(v.abs()));
    for (sum, whole) in sums.iter().flatten().zip(whole.iter().flatten()) {
        assert!((sum - whole).abs() <= 1e-5 * largest, "{sum} {whole}");
    }
}
