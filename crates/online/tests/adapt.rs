//! Updates, roll-backs and sequences with tiny networks.

use admm::{BoxError, Call, Denoiser, Flips, Gap, HoldOut, Outcome, Plan, SolveError, Stage, Start, StopReason, run};
use candle_core::Tensor;
use ndarray::{Array2, Array3, Array4, ArrayView3, ArrayView4, ArrayViewMut4, Zip};
use nets::{Ends, Fastdvdnet, FastdvdnetSpec, Ffdnet, FfdnetSpec, MixedPrecision, Network, WeightFile};
use online::{
    AdaptConfig, AdaptiveDenoiser, Error, Parameters, Reuse, RollBackReason, RollBackRule, SequenceConfig, Solved,
    Task, UpdateCounts, UpdateOutcome, UpdateSchedule, run_sequence,
};
use sci_forward::testing::{moving_square, uniform};
use sci_forward::{CfaPattern, MaskOperator, MaskStack, Measurement, SensingOperator, VideoShape};
use std::collections::BTreeMap;
use std::sync::Arc;

const SHAPE: VideoShape = VideoShape { frames: 4, height: 24, width: 20 };
const EAGER: UpdateSchedule =
    UpdateSchedule { first: 0, interval: 2, steps: 3, learning_rate: 1e-3, ..UpdateSchedule::PAPER_FFDNET };
const CONFIG: AdaptConfig = AdaptConfig { schedule: EAGER, roll_back: RollBackRule::ON, ..AdaptConfig::PAPER_FFDNET };

fn net() -> Ffdnet {
    Ffdnet::random(FfdnetSpec { width: 8, depth: 3, ..FfdnetSpec::GRAY }, 1).unwrap()
}

fn operator() -> Arc<dyn SensingOperator> {
    Arc::new(MaskOperator::new(MaskStack::random(SHAPE, 0.5, 0).unwrap()))
}

fn measurement(video: ArrayView3<'_, f32>) -> Measurement {
    let operator = operator();
    let y = operator.forward(video);
    Measurement::new(operator, y).unwrap()
}

fn of_square() -> Measurement {
    measurement(moving_square(SHAPE).view())
}

/// A denoiser at the beginning of a measurement.
fn begun(config: AdaptConfig, measurement: &Measurement) -> AdaptiveDenoiser<Ffdnet> {
    let mut adaptive = AdaptiveDenoiser::new(net(), config).unwrap();
    adaptive.begin_measurement(measurement).unwrap();
    adaptive
}

fn bytes(net: &dyn Network) -> BTreeMap<String, Vec<u32>> {
    let bits = |t: Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap().into_iter().map(f32::to_bits).collect();
    net.state().into_iter().map(|(name, t)| (name, bits(t))).collect()
}

fn denoise(denoiser: &mut impl Denoiser, iteration: usize, measurement: &Measurement, x: &Array4<f32>) -> Array4<f32> {
    let mut v = Array4::zeros(x.dim());
    let call = Call { iteration, measurement: Some(measurement), ..Call::new(0.1) };
    denoiser.denoise(&call, x.view(), v.view_mut()).unwrap();
    v
}

fn noisy() -> Array4<f32> {
    (moving_square(SHAPE) + 0.1 * uniform(SHAPE.dim(), 5)).insert_axis(ndarray::Axis(1))
}

#[test]
fn every_variant_lowers_the_loss_and_uses_the_new_output_at_once() {
    let variants = [
        CONFIG,
        AdaptConfig { roll_back: RollBackRule::OFF, ..CONFIG },
        AdaptConfig { parameters: Parameters::Biases, ..CONFIG },
        AdaptConfig { parameters: Parameters::FirstLast, ..CONFIG },
        AdaptConfig { parameters: Parameters::Last, ..CONFIG },
        AdaptConfig { schedule: UpdateSchedule { input_noise: 0.02, ..EAGER }, ..CONFIG },
        AdaptConfig { schedule: UpdateSchedule { stride: 3, ..EAGER }, ..CONFIG },
    ];
    let (square, x) = (of_square(), noisy());
    for config in variants {
        let mut adaptive = begun(config, &square);
        let first = denoise(&mut adaptive, 1, &square, &x);
        assert_eq!(first, denoise(&mut net(), 1, &square, &x), "nothing is due in iteration 1");
        for iteration in [2, 4] {
            let v = denoise(&mut adaptive, iteration, &square, &x);
            let update = *adaptive.updates().last().unwrap();
            assert_eq!((update.outcome, update.iteration), (UpdateOutcome::Kept, iteration), "{config:?}");
            assert!(update.loss_after < update.loss_before, "{update:?}, {config:?}");
            let now = denoise(&mut adaptive.network().clone(), 1, &square, &x);
            assert_eq!(v, now, "the output is that of the new weights");
        }
        assert_ne!(bytes(adaptive.network()), bytes(&net()));
        adaptive.reset().unwrap();
        assert_eq!(bytes(adaptive.network()), bytes(&net()), "reset restores every byte");
    }
}

#[test]
fn an_update_that_the_held_out_pixels_refuse_is_undone_byte_for_byte() {
    // A step this long overshoots.
    let schedule = UpdateSchedule { learning_rate: 10.0, ..EAGER };
    let (square, x) = (of_square(), noisy());
    let mut adaptive = begun(AdaptConfig { schedule, ..CONFIG }, &square);
    let before = bytes(adaptive.network());
    let plain = denoise(&mut net(), 1, &square, &x);
    for iteration in [2, 4, 6, 8] {
        assert_eq!(denoise(&mut adaptive, iteration, &square, &x), plain);
        assert_eq!(bytes(adaptive.network()), before);
    }
    let outcomes: Vec<_> = adaptive.updates().iter().map(|u| (u.outcome, u.learning_rate)).collect();
    let (undone, skipped) = (UpdateOutcome::RolledBack(RollBackReason::HeldOut), UpdateOutcome::Skipped);
    assert_eq!(outcomes, [(undone, 10.0), (undone, 5.0), (skipped, 2.5), (skipped, 2.5)]);
    assert_eq!(adaptive.counts(), UpdateCounts { fired: 2, kept: 0, rolled_back: 2, skipped: 2 });
    // The next measurement has its own patience.
    adaptive.begin_measurement(&square).unwrap();
    denoise(&mut adaptive, 2, &square, &x);
    assert_eq!(adaptive.updates().last().unwrap().outcome, undone);
}

/// Of one open pixel nothing can be held out: an update that nothing judges is undone.
#[test]
fn no_update_is_kept_unjudged() {
    let one = Array2::from_shape_fn((24, 20), |at| at == (10, 9));
    let one_pixel = of_square().restricted(one.view()).unwrap();
    for (roll_back, kept) in [(RollBackRule::ON, 0), (RollBackRule::OFF, 1)] {
        let mut adaptive = begun(AdaptConfig { roll_back, ..CONFIG }, &one_pixel);
        denoise(&mut adaptive, 2, &one_pixel, &noisy());
        assert_eq!(adaptive.counts().kept, kept, "{:?}", adaptive.updates());
    }
    // So few are to be held out that a draw alone would have held out none.
    let roll_back = RollBackRule { held_out: 1e-9, ..RollBackRule::ON };
    let mut adaptive = begun(AdaptConfig { roll_back, ..CONFIG }, &of_square());
    denoise(&mut adaptive, 2, &of_square(), &noisy());
    assert!(adaptive.updates()[0].held_out_before.is_some());
}

#[test]
fn nan_rolls_back_and_the_run_goes_on() {
    for roll_back in [RollBackRule::ON, RollBackRule::OFF] {
        // With one step the new output is NaN, with two already the second gradient.
        for steps in [1, 2] {
            let schedule = UpdateSchedule { steps, learning_rate: 1e38, ..EAGER };
            let square = of_square();
            let mut adaptive = begun(AdaptConfig { schedule, roll_back, ..CONFIG }, &square);
            let outcome = solve(&mut adaptive, &square, Start::Mean, &plan()).unwrap();
            assert!(outcome.estimate.is_finite());
            assert_eq!((outcome.iterations, outcome.stop), (7, StopReason::ScheduleDone));
            assert_eq!(adaptive.updates()[0].outcome, UpdateOutcome::RolledBack(RollBackReason::NotFinite));
            assert_eq!(adaptive.counts().kept, 0);
            assert_eq!(bytes(adaptive.network()), bytes(&net()));
        }
    }
}

#[test]
fn a_sensor_of_another_kind_is_refused() {
    let mut adaptive = AdaptiveDenoiser::new(net(), CONFIG).unwrap();
    let color = of_square().with_cfa(Some(CfaPattern::Rggb));
    let refused = adaptive.begin_measurement(&color).unwrap_err();
    assert!(matches!(refused, Error::Channels { expected: 3, found: 1, .. }));
    assert_eq!(refused.to_string(), "FFDNet (gray, 8 channels, 3 layers) has 1 channel(s); a color sensor needs 3");
}

#[test]
fn an_update_without_the_measurement_in_sight_is_an_error() {
    let square = of_square();
    let message = |denoiser: &mut dyn Denoiser| {
        let call = Call { iteration: 2, measurement: Some(&square), ..Call::new(0.1) };
        let (x, mut v) = (noisy(), Array4::zeros(noisy().dim()));
        denoiser.denoise(&call, x.view(), v.view_mut()).unwrap_err().to_string()
    };
    let found = message(&mut Flips::new(begun(CONFIG, &square)));
    assert!(
        found.starts_with("an update is due in iteration 2, but the denoiser is not told the measurement"),
        "{found}"
    );
    // The trial calls of mixed precision are not those of the solve, and before a measurement begins nothing is due.
    let (mut adaptive, x) = (begun(CONFIG, &square), noisy());
    let call = Call { iteration: 2, tolerance: 1.0, measurement: Some(&square), ..Call::new(0.1) };
    MixedPrecision::new(&mut adaptive).denoise(&call, x.view(), Array4::zeros(x.dim()).view_mut()).unwrap();
    assert_eq!(adaptive.updates().len(), 1);
    let mut idle = AdaptiveDenoiser::new(net(), CONFIG).unwrap();
    assert_eq!(denoise(&mut idle, 2, &square, &x), denoise(&mut net(), 2, &square, &x));
}

/// Passes on what it is given, and notes which pixels the solve may see.
struct Witness<'d> {
    inner: &'d mut AdaptiveDenoiser<Ffdnet>,
    open: Option<Array2<bool>>,
}

impl Denoiser for Witness<'_> {
    fn name(&self) -> &str {
        "witness"
    }

    fn denoise(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        self.open = call.measurement.map(|given| given.operator().gram().mapv(|gram| gram > 0.0));
        self.inner.denoise(call, noisy, out)
    }
}

/// What is learned does not depend on the pixels that judge the iterates: whatever they measured, the weights are the same.
#[test]
fn pixels_held_out_of_the_solve_teach_nothing() {
    let schedule = UpdateSchedule { interval: 1, steps: 1, ..EAGER };
    let hold_out = Some(HoldOut { spacing: 4, ..HoldOut::default() });
    let plan = Plan { hold_out, ..Plan::new([Stage { sigma: Some(0.1), iterations: 2 }]) };
    let learned = |measurement: &Measurement| {
        let config = AdaptConfig { schedule, roll_back: RollBackRule::OFF, ..CONFIG };
        let mut adaptive = begun(config, measurement);
        let mut witness = Witness { inner: &mut adaptive, open: None };
        run(&mut Gap::plain(&mut witness), measurement, Start::Mean, &plan, &mut ()).unwrap();
        let open = witness.open.unwrap();
        assert_eq!(adaptive.counts().kept, 1);
        (open, bytes(adaptive.network()))
    };
    let square = of_square();
    let (open, weights) = learned(&square);
    let held_out = Zip::from(&open).and(square.operator().gram()).map_collect(|&open, &gram| gram > 0.0 && !open);
    assert!(held_out.iter().filter(|held| **held).count() >= 20);
    let changed = |which: &Array2<bool>| {
        let y = Zip::from(square.y()).and(which).map_collect(|&y, &which| if which { 1.5 * y + 0.1 } else { y });
        learned(&Measurement::new(square.shared_operator().clone(), y).unwrap()).1
    };
    assert!(changed(&held_out) == weights);
    assert!(changed(&open) != weights);
}

#[test]
fn color_video_networks_adapt_too() {
    let spec = FastdvdnetSpec { channels: 3, widths: [4, 4, 8], batch_norm: true };
    let net = Fastdvdnet::random(spec, Ends::Circular, 3).unwrap();
    let schedule = UpdateSchedule { input_noise: 0.02, learning_rate: 1e-4, ..EAGER };
    let mut adaptive = AdaptiveDenoiser::new(net, AdaptConfig { schedule, ..CONFIG }).unwrap();
    let color = of_square().with_cfa(Some(CfaPattern::Bggr));
    adaptive.begin_measurement(&color).unwrap();
    let statistics = |net: &Fastdvdnet| {
        bytes(net).into_iter().filter(|(name, _)| name.contains("running")).collect::<BTreeMap<_, _>>()
    };
    let before = statistics(adaptive.network());
    denoise(&mut adaptive, 2, &color, &uniform((4, 3, 24, 20), 4));
    assert_eq!(adaptive.counts().kept, 1, "{:?}", adaptive.updates());
    assert_eq!(statistics(adaptive.network()), before, "batch norm statistics are frozen");
}

#[test]
fn adapted_weights_are_saved_as_any_other_weights() {
    let square = of_square();
    let mut adaptive = begun(CONFIG, &square);
    denoise(&mut adaptive, 2, &square, &noisy());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("adapted.safetensors");
    adaptive.save(&path).unwrap();
    let loaded = Ffdnet::from_weights(WeightFile::read(&path).unwrap()).unwrap();
    assert_eq!(bytes(&loaded), bytes(adaptive.network()));
    let mut other = AdaptiveDenoiser::new(net(), CONFIG).unwrap();
    other.load(&path).unwrap();
    assert_eq!(bytes(other.network()), bytes(adaptive.network()));
}

fn plan() -> Plan {
    Plan::new([Stage { sigma: Some(0.1), iterations: 3 }, Stage { sigma: Some(0.05), iterations: 4 }])
}

fn solve<N: Network + Denoiser>(
    denoiser: &mut AdaptiveDenoiser<N>,
    measurement: &Measurement,
    start: Start<'_>,
    plan: &Plan,
) -> Result<Outcome, SolveError> {
    run(&mut Gap::plain(denoiser), measurement, start, plan, &mut ())
}

fn sequence(videos: &[Array3<f32>], config: SequenceConfig) -> (AdaptiveDenoiser<Ffdnet>, Vec<Solved>) {
    let mut denoiser = AdaptiveDenoiser::new(net(), CONFIG).unwrap();
    let measurements: Vec<_> = videos.iter().map(|v| measurement(v.view())).collect();
    let solved = run_sequence(&mut denoiser, measurements, config, |denoiser, task: &Task| {
        // A denoiser this small cannot solve anything: the truth stands in for a good result.
        let mut outcome = solve(denoiser, &task.measurement, task.start(Start::Mean), &task.plan(&plan()))?;
        if config.reuse == Reuse::CarryOver {
            outcome.estimate.sensor.assign(&videos[task.index]);
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
    assert!(
        together.iter().any(|s| s.updates.iter().any(|u| u.outcome == UpdateOutcome::Kept)),
        "something was learned"
    );
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
    let without_index = |s: &Solved| s.updates.iter().map(|u| (u.outcome, u.loss_after)).collect::<Vec<_>>();
    assert_eq!(without_index(&alone[0]), without_index(&solved[2]));
    assert_eq!(denoiser.updates().last().unwrap().measurement, 3);
}

#[test]
fn the_iterations_left_are_the_last_of_the_schedule() {
    let mut sequence = online::Sequence::new(SequenceConfig::default()).unwrap();
    let mut task = sequence.begin(of_square());
    for (effort, expected) in [(1.0, [3, 4]), (0.7, [1, 4]), (0.5, [0, 4]), (0.01, [0, 1])] {
        task.effort = effort;
        let counts: Vec<_> = task.plan(&plan()).stages.iter().map(|s| s.iterations).collect();
        assert_eq!(counts, expected);
    }
    for effort in [0.0, 1.1, f64::NAN] {
        assert!(online::Sequence::new(SequenceConfig { effort, ..SequenceConfig::default() }).is_err());
    }
}

#[test]
fn nothing_is_carried_over_from_what_diverged() {
    let config = SequenceConfig { reuse: Reuse::CarryOver, ..SequenceConfig::default() };
    let mut sequence = online::Sequence::new(config).unwrap();
    let fresh = |task: Task| (task.fresh, task.is_warm());
    assert_eq!(fresh(sequence.begin(of_square())), (false, false));
    sequence.finish(moving_square(SHAPE).view());
    assert_eq!(fresh(sequence.begin(of_square())), (false, true));
    sequence.forget();
    assert_eq!(fresh(sequence.begin(of_square())), (true, false));
    sequence.finish(moving_square(SHAPE).view());
    assert_eq!(fresh(sequence.begin(of_square())), (false, true));
}

#[test]
fn parameters_that_a_network_lacks_are_named() {
    let config = AdaptConfig { parameters: nets::Parameters::NormAffine, ..CONFIG };
    assert!(AdaptiveDenoiser::new(net(), config).unwrap_err().to_string().contains("batch norm"));
}
