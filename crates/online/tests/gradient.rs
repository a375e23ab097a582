//! The gradient of the loss: against autodiff of the whole video at once, PyTorch, and finite differences.

use admm::{Call, Denoiser};
use candle_core::{Device, Tensor, Var};
use ndarray::{Array0, Array1, Array2, Array3, Array4, ArrayView4};
use ndarray_npy::NpzReader;
use nets::kernels::Isa;
use nets::{Ends, Fastdvdnet, FastdvdnetSpec, Ffdnet, FfdnetLayout, FfdnetSpec, Layers, Network, Parameters};
use online::{PixelSplit, accumulate_gradient};
use sci_forward::testing::{gaussian, uniform};
use sci_forward::{CfaPattern, MaskOperator, MaskStack, Measurement, SensingOperator, VideoShape};
use std::fs::File;
use std::sync::Arc;

const SIGMA: f32 = 0.1;

fn simulated(shape: VideoShape, cfa: Option<CfaPattern>) -> Measurement {
    let operator = Arc::new(MaskOperator::new(MaskStack::new(uniform(shape.dim(), 1)).unwrap()));
    let y = operator.forward(uniform(shape.dim(), 2).view());
    Measurement::new(operator, y).unwrap().with_cfa(cfa)
}

fn tensor(video: ArrayView4<'_, f32>) -> Tensor {
    Tensor::from_vec(video.iter().copied().collect::<Vec<_>>(), video.dim(), &Device::Cpu).unwrap()
}

/// `∂ℓ/∂v` with the residual of the network's own inference.
fn upstream<N: Network + Denoiser>(
    net: &mut N,
    measurement: &Measurement,
    pixels: &PixelSplit,
    x: ArrayView4<'_, f32>,
) -> Array4<f32> {
    let mut v = Array4::zeros(x.dim());
    net.denoise(&Call::new(SIGMA), x, v.view_mut()).unwrap();
    measurement.pull_back(pixels.gradient(measurement.residual(v.view()).unwrap().view()).view())
}

fn two_pass<N: Network + Denoiser>(
    net: &mut N,
    measurement: &Measurement,
    pixels: &PixelSplit,
    x: ArrayView4<'_, f32>,
    which: Parameters,
) -> (Vec<(String, Var)>, Vec<Vec<f32>>) {
    let vars = net.make_some_trainable(which).unwrap();
    let upstream = upstream(net, measurement, pixels, x);
    let mut sums: Vec<Vec<f32>> = vars.iter().map(|(_, v)| vec![0.0; v.elem_count()]).collect();
    accumulate_gradient(net, &vars, x, SIGMA, upstream.view(), &mut sums).unwrap();
    (vars, sums)
}

/// The loss as one graph over all frames.
fn whole_loss(net: &dyn Network, measurement: &Measurement, x: ArrayView4<'_, f32>) -> Tensor {
    let (t, c, h, w) = x.dim();
    // C_t where the sensor sees the channel: the adjoint of an image of ones.
    let seen = measurement.pull_back(Array2::ones((h, w)).view());
    let y = Tensor::from_vec(measurement.y().iter().copied().collect::<Vec<_>>(), (h, w), &Device::Cpu).unwrap();
    let v = net.forward(&tensor(x), &[SIGMA]).unwrap();
    let summed = (v * tensor(seen.view())).unwrap().reshape((t * c, h, w)).unwrap().sum(0).unwrap();
    (summed - y).unwrap().sqr().unwrap().mean_all().unwrap()
}

#[track_caller]
fn assert_equals_whole_graph<N: Network + Denoiser>(mut net: N, shape: VideoShape, which: Parameters) {
    let cfa = (net.channels() == 3).then_some(CfaPattern::Grbg);
    let measurement = simulated(shape, cfa);
    let pixels = PixelSplit::draw(&measurement, 0.0, 0);
    let x = uniform((shape.frames, net.channels(), shape.height, shape.width), 3);
    let (vars, sums) = two_pass(&mut net, &measurement, &pixels, x.view(), which);
    let whole = whole_loss(&net, &measurement, x.view()).backward().unwrap();
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
    let measurement = Measurement::new(operator, y).unwrap();
    let pixels = PixelSplit::draw(&measurement, 0.0, 0);
    let mut net = Ffdnet::load(&weights).unwrap();
    let vars = net.make_trainable().unwrap();

    let sigma = *sigma.first().unwrap() as f32;
    let mut v = Array4::zeros(x.dim());
    net.denoise(&Call::new(sigma), x.view(), v.view_mut()).unwrap();
    let residual = measurement.residual(v.view()).unwrap();
    // The mean of the reference is over all pixels: those that no mask opens add nothing but their number.
    let open = measurement.operator().gram().iter().filter(|gram| **gram > 0.0).count();
    let share = open as f64 / measurement.y().len() as f64;
    let (found, expected) = (share * pixels.loss(residual.view()).loss, *loss.first().unwrap());
    assert!((found / expected - 1.0).abs() < 1e-4, "loss {found} instead of {expected}");

    let upstream = measurement.pull_back(pixels.gradient(residual.view()).view());
    let mut sums: Vec<Vec<f32>> = vars.iter().map(|(_, v)| vec![0.0; v.elem_count()]).collect();
    accumulate_gradient(&net, &vars, x.view(), sigma, upstream.view(), &mut sums).unwrap();
    let compare = |name: &str, expected: Vec<f32>| {
        let i = vars.iter().position(|(n, _)| n == name).unwrap();
        let scale = expected.iter().fold(0f32, |m, v| m.max(v.abs()));
        let worst = expected.iter().zip(&sums[i]).fold(0f32, |m, (a, b)| m.max((a - share as f32 * b).abs()));
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
    let measurement = simulated(shape, None);
    let pixels = PixelSplit::draw(&measurement, 0.2, 7);
    let x = uniform((3, 1, 12, 12), 3);
    let mut net = Ffdnet::random(FfdnetSpec { width: 8, depth: 3, ..FfdnetSpec::GRAY }, 8).unwrap();
    let (vars, sums) = two_pass(&mut net, &measurement, &pixels, x.view(), Parameters::All);
    for (layer, index) in [(0, 17), (2, 100), (4, 5)] {
        let var = &vars[layer].1;
        let start = var.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let step = 1e-2;
        let mut loss = |by: f32| {
            let mut moved = start.clone();
            moved[index] += by;
            var.set(&Tensor::from_vec(moved, var.shape(), &Device::Cpu).unwrap()).unwrap();
            let mut v = Array4::zeros(x.dim());
            net.denoise(&Call::new(SIGMA), x.view(), v.view_mut()).unwrap();
            pixels.loss(measurement.residual(v.view()).unwrap().view()).loss
        };
        let slope = (loss(step) - loss(-step)) / f64::from(2.0 * step);
        let found = f64::from(sums[layer][index]);
        assert!((slope - found).abs() <= 0.01 * slope.abs().max(1e-3), "{}: {found} instead of {slope}", vars[layer].0);
        loss(0.0);
    }
}

/// A measurement of which the first row is not open.
fn first_row_closed(height: usize, width: usize) -> Measurement {
    let whole = simulated(VideoShape { frames: 3, height, width }, None);
    whole.restricted(Array2::from_shape_fn((height, width), |(row, _)| row > 0).view()).unwrap()
}

#[test]
fn pixels_held_out_have_no_gradient_and_a_loss_of_their_own() {
    let measurement = first_row_closed(20, 30);
    let residual = gaussian((20, 30), 9);
    let pixels = PixelSplit::draw(&measurement, 0.25, 10);
    let gradient = pixels.gradient(residual.view());
    assert!(gradient.row(0).iter().all(|g| *g == 0.0), "closed pixels measure nothing");
    let open = residual.iter().zip(&gradient).skip(30);
    let (seen, held): (Vec<_>, Vec<_>) = open.partition(|(_, g)| **g != 0.0);
    assert!((100..190).contains(&held.len()), "{} of 570 held out", held.len());
    let mean = |of: &[(&f32, &f32)]| of.iter().map(|(r, _)| f64::from(**r).powi(2)).sum::<f64>() / of.len() as f64;
    let loss = pixels.loss(residual.view());
    assert!((loss.loss - mean(&seen)).abs() < 1e-9 && (loss.held_out.unwrap() - mean(&held)).abs() < 1e-9);
    assert_eq!(PixelSplit::draw(&measurement, 0.25, 10), pixels);
    assert_ne!(PixelSplit::draw(&measurement, 0.25, 11), pixels);
}

/// However few or many are to be held out, and whatever the draw: one pixel at least is seen, and one judges.
#[test]
fn both_kinds_have_a_pixel_where_there_are_two() {
    let residual = Array2::ones((2, 2));
    let two_open = first_row_closed(2, 2);
    for held_out in [1e-9, 0.5, 0.999_999_9] {
        for seed in 0..20 {
            let loss = PixelSplit::draw(&two_open, held_out, seed).loss(residual.view());
            assert_eq!((loss.loss, loss.held_out), (1.0, Some(1.0)), "{held_out}, {seed}");
        }
    }
    assert_eq!(PixelSplit::draw(&two_open, 0.0, 0).loss(residual.view()).held_out, None);
    // The only pixel is to be learned from.
    let loss = PixelSplit::draw(&first_row_closed(2, 1), 0.9, 0).loss(Array2::ones((2, 1)).view());
    assert_eq!((loss.loss, loss.held_out), (1.0, None));
}

/// The sums are of frames, windows and strips in their order, whatever the number of threads.
#[test]
fn the_number_of_threads_changes_no_bit() {
    let tall = VideoShape { frames: 3, height: 200, width: 12 };
    let ffdnet = Ffdnet::random(FfdnetSpec { width: 16, depth: 4, ..FfdnetSpec::GRAY }, 0).unwrap();
    let spec = FastdvdnetSpec { channels: 3, widths: [4, 8, 8], batch_norm: true };
    let fastdvdnet = Fastdvdnet::random(spec, Ends::Circular, 0).unwrap();
    same_on_any_number_of_threads(&ffdnet, tall, None);
    same_on_any_number_of_threads(&fastdvdnet, SHAPE, Some(CfaPattern::Grbg));
}

fn same_on_any_number_of_threads<N: Network + Denoiser + Clone>(net: &N, shape: VideoShape, cfa: Option<CfaPattern>) {
    let measurement = simulated(shape, cfa);
    let x = uniform((shape.frames, net.channels(), shape.height, shape.width), 3);
    let pixels = PixelSplit::draw(&measurement, 0.1, 0);
    let gradient = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| two_pass(&mut net.clone(), &measurement, &pixels, x.view(), Parameters::All).1)
    };
    let one = gradient(1);
    assert!(one.iter().flatten().any(|g| *g != 0.0));
    for threads in [2, 5] {
        assert!(gradient(threads) == one, "{}, {threads} threads", net.describe());
    }
}

/// Frames that take turns: their gradients add up to that of all frames, and frames without one are left out.
#[test]
fn the_gradients_of_parts_of_the_frames_add_up() {
    let shape = VideoShape { frames: 5, height: 8, width: 10 };
    let measurement = simulated(shape, None);
    let x = uniform((5, 1, 8, 10), 3);
    let ffdnet = Ffdnet::random(FfdnetSpec { width: 8, depth: 3, ..FfdnetSpec::GRAY }, 0).unwrap();
    let spec = FastdvdnetSpec { channels: 1, widths: [4, 8, 8], batch_norm: false };
    let fastdvdnet = Fastdvdnet::random(spec, Ends::Circular, 0).unwrap();
    parts_add_up(ffdnet, &measurement, x.view());
    parts_add_up(fastdvdnet, &measurement, x.view());
}

fn parts_add_up<N: Network + Denoiser>(mut net: N, measurement: &Measurement, x: ArrayView4<'_, f32>) {
    let pixels = PixelSplit::draw(measurement, 0.0, 0);
    let (vars, whole) = two_pass(&mut net, measurement, &pixels, x, Parameters::All);
    let upstream = upstream(&mut net, measurement, &pixels, x);
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
