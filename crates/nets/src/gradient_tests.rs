//! Gradients of whole networks against central differences of the same network in f64, on candle's own operations.

use crate::layers::Conv;
use crate::{
    Ddnet, DdnetSpec, Ends, Experts, Fastdvdnet, FastdvdnetSpec, Ffdnet, FfdnetLayout, FfdnetSpec, Layers, Network,
    Shiftnet, ShiftnetSpec,
};
use candle_core::{DType, Device, Tensor};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn random(shape: &[usize], rng: &mut ChaCha8Rng) -> Tensor {
    let values: Vec<f32> = (0..shape.iter().product()).map(|_| rng.random::<f32>() - 0.5).collect();
    Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
}

fn double(t: &Tensor) -> Tensor {
    t.detach().to_dtype(DType::F64).unwrap()
}

fn sum(t: &Tensor) -> f64 {
    t.to_dtype(DType::F64).unwrap().sum_all().unwrap().to_scalar().unwrap()
}

/// `Σ out · g` of a copy of the network in f64, moved by `step` along `directions`.
fn moved<N: Network + Clone>(net: &N, x: &Tensor, g: &Tensor, directions: &[Tensor], step: f64) -> f64 {
    let mut net = net.clone();
    let shifted = |t: &Tensor, d: &Tensor| (double(t) + (double(d) * step).unwrap()).unwrap();
    let (x_direction, mut directions) = (&directions[0], directions[1..].iter());
    for conv in net.convs_mut() {
        for (_, tensor, trainable) in conv.tensors_mut() {
            *tensor = if trainable { shifted(tensor, directions.next().unwrap()) } else { double(tensor) };
        }
    }
    let out = net.forward(&shifted(x, x_direction), &[0.1]).unwrap();
    sum(&(out * double(g)).unwrap())
}

fn check<N: Network + Clone>(mut net: N, shape: [usize; 4]) {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    // Batch norms and biases start trivial: make them count.
    for conv in net.convs_mut() {
        for (name, tensor, _) in conv.tensors_mut() {
            let noise = random(tensor.dims(), &mut rng);
            let scale = if name.ends_with("running_var") { 0.5 } else { 0.2 };
            *tensor = (&*tensor + (noise * scale).unwrap()).unwrap();
        }
    }
    let vars = net.make_trainable().unwrap();
    let x = candle_core::Var::from_tensor(&random(&shape, &mut rng)).unwrap();
    let g = random(&shape, &mut rng);
    let out = net.forward(&x, &[0.1]).unwrap();
    assert_eq!(out.dims(), shape);
    let grads = (out * &g).unwrap().backward().unwrap();
    let all: Vec<&Tensor> = std::iter::once(x.as_tensor()).chain(vars.iter().map(|(_, v)| v.as_tensor())).collect();
    for seed in 0..3 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let directions: Vec<Tensor> = all.iter().map(|t| random(t.dims(), &mut rng)).collect();
        let slope: f64 = all.iter().zip(&directions).map(|(t, d)| sum(&(grads.get(t).unwrap() * d).unwrap())).sum();
        let scale: f64 =
            all.iter().zip(&directions).map(|(t, d)| sum(&(grads.get(t).unwrap() * d).unwrap()).abs()).sum();
        // So short that hardly any ReLU changes sides.
        let step = 1e-9;
        let difference =
            (moved(&net, &x, &g, &directions, step) - moved(&net, &x, &g, &directions, -step)) / (2.0 * step);
        assert!((slope - difference).abs() < 1e-4 * scale, "{}: {slope} {difference}", net.describe());
    }
}

#[test]
fn gradients_of_ffdnet_are_slopes() {
    let spec = FfdnetSpec { channels: 1, width: 5, depth: 4, layout: FfdnetLayout::Direct };
    check(Ffdnet::random(spec, 0).unwrap(), [2, 1, 7, 10]);
    let layout = FfdnetLayout::Residual { batch_norm: true };
    check(Ffdnet::random(FfdnetSpec { channels: 3, layout, ..spec }, 1).unwrap(), [1, 3, 6, 5]);
}

#[test]
fn gradients_of_fastdvdnet_are_slopes() {
    for (batch_norm, ends) in [(false, Ends::Mirrored), (true, Ends::Circular)] {
        let spec = FastdvdnetSpec { channels: 1, widths: [2, 3, 4], batch_norm };
        check(Fastdvdnet::random(spec, ends, 2).unwrap(), [4, 1, 6, 9]);
    }
}

#[test]
fn gradients_of_ddnet_are_slopes() {
    check(Ddnet::random(DdnetSpec { widths: [3, 2, 4] }, Ends::Circular, 3).unwrap(), [3, 3, 8, 5]);
}

#[test]
fn gradients_of_shiftnet_are_slopes() {
    for channels in [1, 3] {
        let spec =
            ShiftnetSpec { channels, window: 3, widths: [16, 32, 16], blocks: [2, 1, 1], experts: Experts::default() };
        check(Shiftnet::random(spec, 4).unwrap(), [3, channels, 8, 13]);
    }
}

#[test]
fn a_conv_folds_its_norm_once() {
    let spec = FastdvdnetSpec { channels: 1, widths: [2, 2, 2], batch_norm: true };
    let mut net = Fastdvdnet::random(spec, Ends::Circular, 0).unwrap();
    net.fold_batch_norm().unwrap();
    let before = net.state();
    net.fold_batch_norm().unwrap();
    assert!(before.keys().eq(net.state().keys()));
    assert!(before.keys().all(|name| !name.contains("running")));
    assert!(net.convs().into_iter().all(|conv: &Conv| !conv.is_variable()));
}
