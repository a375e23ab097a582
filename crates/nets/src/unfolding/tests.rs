//! The network against its own graph, its definition, and finite differences.

use super::*;
use candle_core::{DType, Device};
use candle_nn::ops::pixel_shuffle;
use ndarray::{Array3, Zip};
use rand::RngExt;

const SPEC: UnfoldingSpec = UnfoldingSpec { channels: 1, iterations: 2, widths: [16, 32, 16], depth: 1 };

fn random(shape: &[usize], rng: &mut ChaCha8Rng) -> Tensor {
    let values: Vec<f32> = (0..shape.iter().product()).map(|_| 0.2 * (rng.random::<f32>() - 0.5)).collect();
    Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
}

/// A network no layer of which is silent.
fn loud(spec: UnfoldingSpec) -> UnfoldingNet {
    let mut net = UnfoldingNet::random(spec, 1).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    for conv in net.convs_mut() {
        for (_, tensor, _) in conv.tensors_mut() {
            *tensor = random(tensor.dims(), &mut rng);
        }
    }
    net
}

/// Binary masks, a measurement of noise through them.
fn measured(dim: (usize, usize, usize)) -> (Array3<f32>, Array2<f32>) {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let masks = Array3::from_shape_simple_fn(dim, || f32::from(u8::from(rng.random::<bool>())));
    let y = masks.mapv(|c| c * rng.random::<f32>()).sum_axis(Axis(0));
    (masks, y)
}

/// A measurement for the differentiable solve, from a start that is none of its own.
fn snapshot(masks: &Array3<f32>, y: &Array2<f32>) -> Snapshot {
    Snapshot::new(masks.view(), y.view(), start(masks, y).view()).unwrap()
}

/// A video that explains the measurement.
fn start(masks: &Array3<f32>, y: &Array2<f32>) -> Array3<f32> {
    let (_, height, width) = masks.dim();
    let frame = Array2::from_shape_fn((height, width), |(i, j)| ((3 * i + 5 * j) % 7) as f32 / 7.0);
    project(masks, y, &(Array3::zeros(masks.dim()) + &frame))
}

fn project(masks: &Array3<f32>, y: &Array2<f32>, v: &Array3<f32>) -> Array3<f32> {
    let gram = masks.mapv(|c| c * c).sum_axis(Axis(0));
    let lacks = Zip::from(y)
        .and(&(masks * v).sum_axis(Axis(0)))
        .and(&gram)
        .map_collect(|y, hv, &gram| if gram > 0.0 { (y - hv) / gram } else { 0.0 });
    v + masks * &lacks
}

/// All iterations without gradients; the data step is the solver's.
fn solved(net: &mut UnfoldingNet, masks: &Array3<f32>, y: &Array2<f32>, cfa: Option<CfaPattern>) -> Array4<f32> {
    let mut solve = net.begin(masks.view(), y.view(), cfa).unwrap();
    let mut x = start(masks, y);
    for _ in 0..net.spec().iterations {
        net.advance(&mut solve, x.view()).unwrap();
        let v = Array3::from_shape_fn(masks.dim(), |(t, i, j)| solve.sensor(t, i, j));
        x = project(masks, y, &v);
    }
    solve.last
}

#[test]
fn inference_is_the_differentiable_solve() {
    for (channels, frames) in [(1, 5), (3, 3), (1, 1)] {
        let mut net = loud(UnfoldingSpec { channels, ..SPEC });
        let (masks, y) = measured((frames, 16, 24));
        let results = net.unfold(&snapshot(&masks, &y), None, 2).unwrap().0;
        let found = solved(&mut net, &masks, &y, (channels == 3).then_some(CfaPattern::Rggb));
        let found = Tensor::from_iter(found.iter().copied(), &Device::Cpu).unwrap().reshape(found.dim()).unwrap();
        let expected = pixel_shuffle(results.last().unwrap(), 2).unwrap();
        let error = (found - expected).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
        assert!(error < 1e-4, "{channels} channels, {frames} frames: {error}");
    }
}

#[test]
fn any_size_and_any_sensor_is_solved() {
    for (h, w) in [(1, 1), (9, 14), (16, 7)] {
        for cfa in CfaPattern::ALL {
            let mut net = loud(UnfoldingSpec { channels: 3, ..SPEC });
            let (masks, y) = measured((2, h, w));
            let frames = solved(&mut net, &masks, &y, Some(cfa));
            assert!(frames.dim() == (2, 3, h, w) && frames.iter().all(|v| v.is_finite()));
        }
    }
}

#[test]
fn a_sensor_that_begins_elsewhere_sees_the_same_colors() {
    let mut net = UnfoldingNet::random(UnfoldingSpec { channels: 3, ..SPEC }, 1).unwrap();
    let colors = [0.2, 0.5, 0.9];
    for cfa in CfaPattern::ALL {
        let masks = Array3::ones((1, 6, 10));
        let y = Array2::from_shape_fn((6, 10), |(y, x)| colors[cfa.color_at(y, x) as usize]);
        let frames = solved(&mut net, &masks, &y, Some(cfa));
        let right = frames.indexed_iter().all(|((_, c, ..), &v)| (v - colors[c]).abs() < 1e-6);
        assert!(right, "{cfa:?}: {frames}");
    }
}

#[test]
fn an_untrained_network_projects() {
    let net = UnfoldingNet::random(SPEC, 1).unwrap();
    let (masks, y) = measured((4, 8, 8));
    let snapshot = snapshot(&masks, &y);
    let results = net.unfold(&snapshot, None, 2).unwrap().0;
    let change = (results.last().unwrap() - &snapshot.start).unwrap().abs().unwrap().max_all().unwrap();
    assert!(change.to_scalar::<f32>().unwrap() < 1e-5);
}

#[test]
fn the_scale_of_masks_and_measurement_does_not_matter() {
    let net = loud(SPEC);
    let (masks, y) = measured((3, 8, 8));
    let last = |scale: f32| {
        let snapshot = snapshot(&(&masks * scale), &(&y * scale));
        net.unfold(&snapshot, None, 2).unwrap().0.pop().unwrap()
    };
    let change = (last(1.0) - last(100.0)).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
    assert!(change < 1e-4, "{change}");
}

/// Against central differences of the same solve in f64.
#[test]
fn gradients_are_slopes() {
    for channels in [1, 3] {
        let mut net = loud(UnfoldingSpec { channels, ..SPEC });
        let (masks, y) = measured((3, 8, 16));
        let snapshot = snapshot(&masks, &y);
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let g: Vec<Tensor> = (0..2).map(|_| random(&[3, 4 * channels, 4, 8], &mut rng)).collect();
        let vars = net.make_trainable().unwrap();
        let directions: Vec<Tensor> = vars.iter().map(|(_, var)| random(var.dims(), &mut rng)).collect();
        let results = net.unfold(&snapshot, None, 2).unwrap().0;
        let sum = ((&results[0] * &g[0]).unwrap() + (&results[1] * &g[1]).unwrap()).unwrap().sum_all().unwrap();
        let grads = sum.backward().unwrap();
        let double = |t: &Tensor| t.detach().to_dtype(DType::F64).unwrap();
        let dot =
            |a: &Tensor, b: &Tensor| (double(a) * double(b)).unwrap().sum_all().unwrap().to_scalar::<f64>().unwrap();
        let slope: f64 = vars.iter().zip(&directions).map(|((_, var), d)| dot(grads.get(var).unwrap(), d)).sum();
        let moved = |step: f64| {
            let mut net = net.clone();
            let mut directions = directions.iter();
            for conv in net.convs_mut() {
                for (_, tensor, _) in conv.tensors_mut() {
                    *tensor = (double(tensor) + (double(directions.next().unwrap()) * step).unwrap()).unwrap();
                }
            }
            let results = net.unfold(&snapshot.to_dtype(DType::F64), None, 2).unwrap().0;
            dot(&results[0], &g[0]) + dot(&results[1], &g[1])
        };
        let difference = (moved(1e-8) - moved(-1e-8)) / 2e-8;
        assert!((slope - difference).abs() < 1e-3 * slope.abs().max(1e-3), "{channels}: {slope} {difference}");
    }
}
