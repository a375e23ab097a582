//! Updates, roll-backs and sequences with tiny networks.

use admm::{DenoiseCx, Denoiser, Gap, Outcome as Solve, Plan, Problem, SolveError, Stage, Start, run};
use candle_core::Tensor;
use ndarray::{Array2, Array3, Array4, ArrayView3};
use nets::{Ends, Fastdvdnet, FastdvdnetSpec, Ffdnet, FfdnetSpec, Network, WeightFile};
use online::{
    AdaptConfig, AdaptiveDenoiser, Counts, Error, Guard, Outcome, Parameters, Reuse, RollBack, Schedule,
    SequenceConfig, Snapshot, Solved, Task, Terms, run_sequence,
};
use sci_forward::testing::{moving_square, uniform};
use sci_forward::{CfaPattern, MaskOperator, MaskStack, SensingOperator, VideoShape};
use std::collections::BTreeMap;
use std::sync::Arc;

const SHAPE: VideoShape = VideoShape { frames: 4, height: 24, width: 20 };
const EAGER: Schedule = Schedule { first: 0, interval: 2, steps: 3, learning_rate: 1e-3, ..Schedule::PAPER_FFDNET };
const CONFIG: AdaptConfig = AdaptConfig { schedule: EAGER, guard: Guard::ON, ..AdaptConfig::PAPER_FFDNET };

fn net() -> Ffdnet {
    Ffdnet::random(FfdnetSpec { width: 8, depth: 3, ..FfdnetSpec::GRAY }, 1).unwrap()
}

fn operator() -> Arc<dyn SensingOperator> {
    Arc::new(MaskOperator::new(MaskStack::random(SHAPE, 0.5, 0).unwrap()))
}

fn snapshot(video: ArrayView3<'_, f32>) -> Snapshot {
    let operator = operator();
    Snapshot::new(operator.clone(), operator.forward(video).view(), None).unwrap()
}

fn bytes(net: &dyn Network) -> BTreeMap<String, Vec<u32>> {
    let bits = |t: Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap().into_iter().map(f32::to_bits).collect();
    net.state().into_iter().map(|(name, t)| (name, bits(t))).collect()
}

fn denoise(denoiser: &mut impl Denoiser, iteration: usize, x: &Array4<f32>) -> Array4<f32> {
    let mut v = Array4::zeros(x.dim());
    denoiser.denoise(&DenoiseCx { iteration, ..DenoiseCx::new(0.1) }, x.view(), v.view_mut()).unwrap();
    v
}

fn noisy() -> Array4<f32> {
    (moving_square(SHAPE) + 0.1 * uniform(SHAPE.dim(), 5)).insert_axis(ndarray::Axis(1))
}

#[test]
fn every_variant_lowers_the_loss_and_uses_the_new_output_at_once() {
    let none = Terms::NONE;
    let variants = [
        CONFIG,
        AdaptConfig { guard: Guard::OFF, ..CONFIG },
        AdaptConfig { terms: Terms { pseudo_clean: 0.1, ..none }, ..CONFIG },
        AdaptConfig { terms: Terms { distance: 1e-3, ..none }, ..CONFIG },
        AdaptConfig { terms: Terms { equivariance: 0.1, ..none }, ..CONFIG },
        AdaptConfig { blind: Some(0.2), ..CONFIG },
        AdaptConfig { parameters: Parameters::Biases, ..CONFIG },
        AdaptConfig { parameters: Parameters::FirstLast, ..CONFIG },
        AdaptConfig { parameters: Parameters::Last, ..CONFIG },
        AdaptConfig { schedule: Schedule { input_noise: 0.02, ..EAGER }, ..CONFIG },
        AdaptConfig { schedule: Schedule { keep_optimizer: true, ..EAGER }, ..CONFIG },
    ];
    for config in variants {
        let mut adaptive = AdaptiveDenoiser::new(net(), config).unwrap();
        adaptive.bind(snapshot(moving_square(SHAPE).view())).unwrap();
        let x = noisy();
        let first = denoise(&mut adaptive, 1, &x);
        assert_eq!(first, denoise(&mut net(), 1, &x), "nothing is due in iteration 1");
        for iteration in [2, 4] {
            let v = denoise(&mut adaptive, iteration, &x);
            let update = *adaptive.updates().last().unwrap();
            assert_eq!((update.outcome, update.iteration), (Outcome::Kept, iteration), "{config:?}");
            assert!(update.loss_after < update.loss_before, "{update:?}, {config:?}");
            assert_eq!(v, denoise(&mut adaptive.network().clone(), 1, &x), "the output is that of the new weights");
        }
        assert_ne!(bytes(adaptive.network()), bytes(&net()));
        adaptive.reset().unwrap();
        assert_eq!(bytes(adaptive.network()), bytes(&net()), "reset restores every byte");
    }
}

#[test]
fn a_distance_term_keeps_the_weights_nearer() {
    let moved = |distance: f64| {
        let config = AdaptConfig { terms: Terms { distance, ..Terms::NONE }, guard: Guard::OFF, ..CONFIG };
        let mut adaptive = AdaptiveDenoiser::new(net(), config).unwrap();
        adaptive.bind(snapshot(moving_square(SHAPE).view())).unwrap();
        for iteration in (2..20).step_by(2) {
            denoise(&mut adaptive, iteration, &noisy());
        }
        let (now, start) = (adaptive.network().state(), net().state());
        let square = |(name, t): (&String, &Tensor)| {
            (t - &start[name]).unwrap().sqr().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap()
        };
        now.iter().map(square).sum::<f32>()
    };
    let (free, held) = (moved(0.0), moved(10.0));
    assert!(held < 0.5 * free, "{held} against {free}");
}

#[test]
fn an_update_that_the_held_out_pixels_refuse_is_undone_byte_for_byte() {
    // A step this long overshoots.
    let schedule = Schedule { learning_rate: 10.0, ..EAGER };
    let mut adaptive = AdaptiveDenoiser::new(net(), AdaptConfig { schedule, ..CONFIG }).unwrap();
    adaptive.bind(snapshot(moving_square(SHAPE).view())).unwrap();
    let (x, before) = (noisy(), bytes(adaptive.network()));
    let plain = denoise(&mut net(), 1, &x);
    for iteration in [2, 4, 6, 8] {
        assert_eq!(denoise(&mut adaptive, iteration, &x), plain);
        assert_eq!(bytes(adaptive.network()), before);
    }
    let outcomes: Vec<_> = adaptive.updates().iter().map(|u| (u.outcome, u.learning_rate)).collect();
    let undone = Outcome::RolledBack(RollBack::HeldOut);
    assert_eq!(outcomes, [(undone, 10.0), (undone, 5.0), (Outcome::Skipped, 2.5), (Outcome::Skipped, 2.5)]);
    assert_eq!(adaptive.counts(), Counts { fired: 2, kept: 0, rolled_back: 2, skipped: 2 });
}

#[test]
fn nan_rolls_back_and_the_run_goes_on() {
    for guard in [Guard::ON, Guard::OFF] {
        // With one step the new output is NaN, with two already the second gradient.
        for steps in [1, 2] {
            let schedule = Schedule { steps, learning_rate: 1e38, ..EAGER };
            let mut adaptive = AdaptiveDenoiser::new(net(), AdaptConfig { schedule, guard, ..CONFIG }).unwrap();
            let snapshot = snapshot(moving_square(SHAPE).view());
            adaptive.bind(snapshot.clone()).unwrap();
            let outcome = solve(&mut adaptive, &snapshot, Start::Mean, &plan()).unwrap();
            assert!(outcome.estimate.iter().all(|v| v.is_finite()));
            assert_eq!(outcome.iterations, 7);
            assert_eq!(adaptive.updates()[0].outcome, Outcome::RolledBack(RollBack::NotFinite));
            assert_eq!(adaptive.counts().kept, 0);
            assert_eq!(bytes(adaptive.network()), bytes(&net()));
        }
    }
}

#[test]
fn a_sensor_of_another_kind_is_refused() {
    let mut adaptive = AdaptiveDenoiser::new(net(), CONFIG).unwrap();
    let color = Snapshot::new(operator(), Array2::zeros((24, 20)).view(), Some(CfaPattern::Rggb)).unwrap();
    assert!(matches!(adaptive.bind(color), Err(Error::Channels { expected: 3, found: 1, .. })));
    assert!(matches!(Snapshot::new(operator(), Array2::zeros((24, 21)).view(), None), Err(Error::Size { .. })));
    assert!(matches!(
        Snapshot::new(operator(), Array2::from_elem((24, 20), f32::NAN).view(), None),
        Err(Error::NotFinite { .. })
    ));
}

#[test]
fn color_video_networks_adapt_too() {
    let spec = FastdvdnetSpec { channels: 3, widths: [4, 4, 8], batch_norm: true };
    let net = Fastdvdnet::random(spec, Ends::Circular, 3).unwrap();
    let schedule = Schedule { input_noise: 0.02, learning_rate: 1e-4, ..EAGER };
    let mut adaptive = AdaptiveDenoiser::new(net, AdaptConfig { schedule, ..CONFIG }).unwrap();
    let y = operator().forward(moving_square(SHAPE).view());
    adaptive.bind(Snapshot::new(operator(), y.view(), Some(CfaPattern::Bggr)).unwrap()).unwrap();
    let statistics = |net: &Fastdvdnet| {
        bytes(net).into_iter().filter(|(name, _)| name.contains("running")).collect::<BTreeMap<_, _>>()
    };
    let before = statistics(adaptive.network());
    denoise(&mut adaptive, 2, &uniform((4, 3, 24, 20), 4));
    assert_eq!(adaptive.counts().kept, 1, "{:?}", adaptive.updates());
    assert_eq!(statistics(adaptive.network()), before, "batch norm statistics are frozen");
}

#[test]
fn adapted_weights_are_saved_as_any_other_weights() {
    let mut adaptive = AdaptiveDenoiser::new(net(), CONFIG).unwrap();
    adaptive.bind(snapshot(moving_square(SHAPE).view())).unwrap();
    denoise(&mut adaptive, 2, &noisy());
    let path = tempfile::tempdir().unwrap().keep().join("adapted.safetensors");
    adaptive.save(&path).unwrap();
    let loaded = Ffdnet::from_weights(WeightFile::read(&path).unwrap()).unwrap();
    assert_eq!(bytes(&loaded), bytes(adaptive.network()));
    let mut other = AdaptiveDenoiser::new(net(), CONFIG).unwrap();
    other.load(&path).unwrap();
    assert_eq!(bytes(other.network()), bytes(adaptive.network()));
    std::fs::remove_dir_all(path.parent().unwrap()).unwrap();
}

fn plan() -> Plan {
    Plan::new([Stage { sigma: 0.1, iterations: 3 }, Stage { sigma: 0.05, iterations: 4 }])
}

fn solve<N: Network + Denoiser>(
    denoiser: &mut AdaptiveDenoiser<N>,
    snapshot: &Snapshot,
    start: Start<'_>,
    plan: &Plan,
) -> Result<Solve<()>, SolveError> {
    let problem = Problem::new(snapshot.operator().as_ref(), snapshot.y())?;
    Ok(run(&mut Gap::plain(denoiser), &problem, start, plan, &mut ())?.without_state())
}

fn sequence(videos: &[Array3<f32>], config: SequenceConfig) -> (AdaptiveDenoiser<Ffdnet>, Vec<Solved<()>>) {
    let mut denoiser = AdaptiveDenoiser::new(net(), CONFIG).unwrap();
    let snapshots: Vec<_> = videos.iter().map(|v| snapshot(v.view())).collect();
    let solved = run_sequence(&mut denoiser, snapshots, config, |denoiser, task: &Task| {
        // A denoiser this small cannot solve anything: the truth stands in for a good result.
        let mut outcome = solve(denoiser, &task.snapshot, task.start(Start::Mean), &task.plan(&plan()))?;
        if config.reuse == Reuse::CarryOver {
            outcome.estimate.assign(&videos[task.index]);
        }
        Ok(outcome)
    });
    (denoiser, solved.unwrap())
}

#[test]
fn a_sequence_under_reset_equals_single_runs() {
    let videos = [moving_square(SHAPE), uniform(SHAPE.dim(), 8), moving_square(SHAPE)];
    let (_, together) = sequence(&videos, SequenceConfig::default());
    for (video, of_sequence) in videos.iter().zip(&together) {
        let (_, alone) = sequence(std::slice::from_ref(video), SequenceConfig::default());
        assert_eq!(alone[0].outcome.estimate, of_sequence.outcome.estimate);
        assert_eq!(alone[0].updates.len(), 3);
        assert!(!of_sequence.warm && !of_sequence.cut && of_sequence.relation.is_none());
    }
    assert!(together.iter().any(|s| s.updates.iter().any(|u| u.outcome == Outcome::Kept)), "something was learned");
}

#[test]
fn a_scene_that_barely_changes_is_carried_over_and_a_cut_is_noticed() {
    let (a, b) = (moving_square(SHAPE), 1.0 - 0.8 * uniform(SHAPE.dim(), 9));
    let config = SequenceConfig { reuse: Reuse::CarryOver, ..SequenceConfig::default() };
    let (denoiser, solved) = sequence(&[a.clone(), a.clone(), b.clone(), b.clone()], config);
    let seen: Vec<_> = solved.iter().map(|s| (s.warm, s.cut, s.outcome.iterations)).collect();
    assert_eq!(seen, [(false, false, 7), (true, false, 4), (false, true, 7), (true, false, 4)]);
    // After the cut the third measurement is solved as if it were the first.
    let (_, alone) = sequence(&[b], config);
    let without_index = |s: &Solved<()>| s.updates.iter().map(|u| (u.outcome, u.loss_after)).collect::<Vec<_>>();
    assert_eq!(without_index(&alone[0]), without_index(&solved[2]));
    assert_eq!(denoiser.updates().last().unwrap().measurement, 3);
}

#[test]
fn the_iterations_left_are_the_last_of_the_schedule() {
    let mut sequence = online::Sequence::new(SequenceConfig::default()).unwrap();
    let mut task = sequence.begin(snapshot(moving_square(SHAPE).view()));
    for (effort, expected) in [(1.0, [3, 4]), (0.7, [1, 4]), (0.5, [0, 4]), (0.01, [0, 1])] {
        task.effort = effort;
        let counts: Vec<_> = task.plan(&plan()).stages.iter().map(|s| s.iterations).collect();
        assert_eq!(counts, expected);
    }
    for effort in [0.0, 1.1, f64::NAN] {
        assert!(online::Sequence::new(SequenceConfig { effort, ..SequenceConfig::default() }).is_err());
    }
}
