//! Measurement splitting with tiny networks.

use candle_core::Tensor;
use ndarray::{Array3, s};
use nets::kernels::Precision;
use nets::unrolled::Recipe;
use nets::{Ffdnet, FfdnetLayout, FfdnetSpec, Layers, Network, Parameters};
use online::{Error, SplitConfig, SplitRecord, Successor, adapt_by_splitting};
use sci_forward::testing::{moving_square, uniform};
use sci_forward::{CfaPattern, MaskOperator, MaskStack, Measurement, SensingOperator, VideoShape};
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::sync::Arc;

const SHAPE: VideoShape = VideoShape { frames: 4, height: 40, width: 48 };
const CONFIG: SplitConfig = SplitConfig {
    updates: 12,
    crops: 2,
    side: 32,
    hidden: 0.15,
    calls: 2,
    learning_rate: 1e-3,
    average: 0.5,
    blend: 1.0,
    judging: 0.1,
    judged_crops: 4,
    every: 4,
    patience: 2,
    parameters: Parameters::All,
    precision: Precision::F32,
    seed: 1,
};

fn net(channels: usize) -> Ffdnet {
    let layout = FfdnetLayout::Residual { batch_norm: false };
    Ffdnet::random(FfdnetSpec { channels, width: 8, depth: 3, layout }, 1).unwrap()
}

/// It adds next to nothing to its input, and is right for most pixels.
fn faint() -> Ffdnet {
    let mut net = net(1);
    let faint = net.state().into_iter().map(|(name, t)| (name, t.affine(0.1, 0.0).unwrap())).collect();
    net.set_state(&faint).unwrap();
    net
}

fn recipe() -> Recipe {
    Recipe { sigmas: vec![0.2, 0.1, 0.05], accelerate: true, start: Some((5, 0.1)), flips: true, dim: 1.5 }
}

/// A moving square, of a color sensor if there is a pattern.
fn measurement(cfa: Option<CfaPattern>) -> Measurement {
    let h = MaskOperator::new(MaskStack::random(SHAPE, 0.5, 0).unwrap());
    let y = h.forward(moving_square(SHAPE).view());
    Measurement::new(Arc::new(h), y).unwrap().with_cfa(cfa)
}

fn bytes(net: &dyn Network) -> BTreeMap<String, Vec<u32>> {
    let bits = |t: Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap().into_iter().map(f32::to_bits).collect();
    net.state().into_iter().map(|(name, t)| (name, bits(t))).collect()
}

fn adapt(net: &mut Ffdnet, measurement: &Measurement, config: &SplitConfig) -> SplitRecord {
    let all = std::slice::from_ref(measurement);
    adapt_by_splitting(net, all, &recipe(), None, config, &mut |_| ControlFlow::Continue(())).unwrap()
}

/// A network that knows nothing becomes one that predicts pixels better which it never learned from, and solves the whole better.
#[test]
fn what_is_learned_predicts_pixels_that_were_not_learned_from() {
    let square = measurement(None);
    let mut learned = net(1);
    let record = adapt(&mut learned, &square, &CONFIG);
    let (first, last) = (record.judgements[0], *record.judgements.last().unwrap());
    assert!(record.kept == 12 && last.updates == 12, "{record:?}");
    assert!(last.judged < 0.9 * first.judged, "{record:?}");
    let error = |net: &mut Ffdnet| {
        let found = recipe().solve(&square, net).unwrap();
        (found.index_axis_move(ndarray::Axis(1), 0) - moving_square(SHAPE)).mapv(|e| e * e).mean().unwrap()
    };
    assert!(error(&mut learned) < error(&mut net(1)));
}

#[test]
fn a_blend_lies_between_the_weights_before_and_those_learned() {
    let (square, before) = (measurement(None), net(1));
    let learned = |blend: f64| {
        let mut net = before.clone();
        let record = adapt(&mut net, &square, &SplitConfig { blend, every: 12, ..CONFIG });
        assert_eq!(record.kept, 12, "{record:?}");
        net
    };
    let (whole, most) = (learned(1.0), learned(0.75));
    let values = |net: &Ffdnet| {
        net.state().into_values().flat_map(|t| t.flatten_all().unwrap().to_vec1::<f32>().unwrap()).collect::<Vec<_>>()
    };
    for ((before, whole), most) in values(&before).into_iter().zip(values(&whole)).zip(values(&most)) {
        assert!((before + 0.75 * (whole - before) - most).abs() < 1e-6, "{before} {whole} {most}");
    }
}

/// Of two networks that take over, one that makes noise spoils what there is, and one that leaves it alone does not.
#[test]
fn the_pixels_that_judge_tell_whether_another_network_is_to_take_over() {
    let (square, loud, quiet) = (measurement(None), net(1), faint());
    let whole = Recipe { sigmas: vec![0.2, 0.1, 0.05, 0.05], ..recipe() };
    let taken_over = |first: &Ffdnet, next: &Ffdnet| {
        let successor = Some(Successor { network: next, recipe: &whole });
        let mut watch = |_| ControlFlow::Continue(());
        let all = std::slice::from_ref(&square);
        adapt_by_splitting(&mut first.clone(), all, &recipe(), successor, &CONFIG, &mut watch).unwrap()
    };
    let (spoilt, mended) = (taken_over(&quiet, &loud), taken_over(&loud, &quiet));
    assert!(spoilt.ends_early, "{spoilt:?}");
    assert!(!mended.ends_early && mended.taken_over < spoilt.taken_over, "{mended:?}");
}

#[test]
fn in_color_it_learns_too() {
    let mosaic = measurement(Some(CfaPattern::Gbrg));
    // Through a demosaicer a network that knows nothing takes longer to be of use.
    let record = adapt(&mut net(3), &mosaic, &SplitConfig { updates: 24, patience: 6, ..CONFIG });
    assert!(record.kept > 8, "{record:?}");
}

#[test]
fn weights_that_predict_worse_are_not_kept() {
    let (mut net, square) = (faint(), measurement(None));
    let before = bytes(&net);
    // Steps this long overshoot.
    let record = adapt(&mut net, &square, &SplitConfig { learning_rate: 1.0, every: 2, ..CONFIG });
    assert!(record.kept == 0 && record.updates() == 4, "two judgements in vain end it: {record:?}");
    assert!(bytes(&net) == before, "the weights are what they were");
}

#[test]
fn several_measurements_are_learned_from_and_a_stop_is_heeded() {
    let (mut learned, mut told) = (net(1), Vec::new());
    let all = [measurement(None), measurement(None)];
    let mut watch = |updates| {
        told.push(updates);
        if updates == 3 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let record = adapt_by_splitting(&mut learned, &all, &recipe(), None, &CONFIG, &mut watch).unwrap();
    assert_eq!((told, record.updates()), (vec![1, 2, 3], 3));
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let square = measurement(None);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut net = net(1);
            let record = adapt(&mut net, &square, &SplitConfig { updates: 4, ..CONFIG });
            (record.judgements, bytes(&net))
        })
    };
    assert!(with(1) == with(3));
}

#[test]
fn where_nothing_can_judge_it_says_so() {
    let masks = Array3::from_shape_fn((2, 20, 20), |(_, y, x)| f32::from(u8::from((y, x) == (3, 3))));
    let h = MaskOperator::new(MaskStack::new(masks).unwrap());
    let y = uniform((1, 20, 20), 1).slice(s![0, .., ..]).to_owned();
    let one = Measurement::new(Arc::new(h), y).unwrap();
    let result = adapt_by_splitting(&mut net(1), &[one], &recipe(), None, &CONFIG, &mut |_| ControlFlow::Continue(()));
    assert!(matches!(result, Err(Error::NothingToJudge)), "{result:?}");
}

/// What a solve came from before it diverged may predict pixels well: that is no merit of the network.
#[test]
fn weights_with_which_a_solve_diverges_are_not_kept() {
    let (mut net, square) = (faint(), measurement(None));
    let before = bytes(&net);
    let far = recipe().solve_to_the_end(&square, &mut exploding()).unwrap();
    assert!(far.is_none() && recipe().solve(&square, &mut exploding()).is_ok());
    let record = adapt(&mut net, &square, &SplitConfig { learning_rate: 1.0, every: 2, ..CONFIG });
    assert!(record.kept == 0 && bytes(&net) == before, "{record:?}");
}

/// It makes what it is given a thousand times as bright.
fn exploding() -> Ffdnet {
    let mut net = net(1);
    let loud = net.state().into_iter().map(|(name, t)| (name, t.affine(1e4, 0.0).unwrap())).collect();
    net.set_state(&loud).unwrap();
    net
}
