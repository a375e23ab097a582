//! The solvers through [`admm::run`]: exact small cases, reference numbers on real scenes, and what a run may never do.

use admm::*;
use ndarray::{Array1, Array2, Array3, Array4, ArrayView4, ArrayViewMut4, Axis};
use ndarray_npy::NpzReader;
use sci_forward::testing::{gaussian, moving_square, uniform};
use sci_forward::{MaskOperator, MaskStack, Measurement, MeasurementError, SensingOperator, VideoShape};
use std::ops::ControlFlow;
use std::sync::{Arc, Mutex};

const SHAPE: VideoShape = VideoShape { frames: 4, height: 24, width: 20 };

fn operator() -> Arc<MaskOperator> {
    Arc::new(MaskOperator::new(MaskStack::random(SHAPE, 0.5, 3).unwrap()))
}

/// Of a simple scene.
fn measurement() -> Measurement {
    let h = operator();
    Measurement::new(h.clone(), h.forward(moving_square(SHAPE).view())).unwrap()
}

fn stages(iterations: usize) -> Plan {
    Plan::new([Stage { sigma: Some(0.1), iterations }])
}

fn solve(mut solver: impl Solver, start: Start<'_>, plan: &Plan) -> Outcome {
    run(&mut solver, &measurement(), start, plan, &mut ()).unwrap()
}

/// A denoiser that is a closure on the whole video.
struct Map<F>(F);

impl<F: FnMut(&Call<'_>, ArrayView4<'_, f32>) -> Array4<f32> + Send> Denoiser for Map<F> {
    fn name(&self) -> &str {
        "map"
    }
    fn denoise(
        &mut self,
        call: &Call<'_>,
        x: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        out.assign(&(self.0)(call, x));
        Ok(())
    }
}

#[test]
fn tv_matches_scikit_image() {
    let Some(path) = test_data::file("golden/tv_chambolle.npz") else { return };
    let mut npz = NpzReader::new(std::fs::File::open(path).unwrap()).unwrap();
    let input: Array3<f32> = npz.by_name("input").unwrap();
    let expected: Array3<f32> = npz.by_name("output").unwrap();
    let mut out = Array4::zeros(input.clone().insert_axis(Axis(1)).dim());
    let call = Call::new(0.0);
    Tv::new(0.3).denoise(&call, input.view().insert_axis(Axis(1)), out.view_mut()).unwrap();
    let worst = (out.remove_axis(Axis(1)) - expected).fold(0f32, |m, d| m.max(d.abs()));
    assert!(worst < 1e-5, "largest difference {worst}");
}

/// With the linear prior `θ = x / (1 + λ)`, i.e. `λ/2 ‖θ‖²`, and γ, ADMM has the ridge solution as its fixed point:
/// `x = (HᵀH + μ I)⁻¹ Hᵀ y` with `μ = γ λ`, per pixel a rank-one system.
#[test]
fn admm_with_a_linear_denoiser_reaches_its_exact_fixed_point() {
    let (h, problem, lambda, gamma) = (operator(), measurement(), 0.3f32, 0.7f32);
    let mut solver = Admm::new(Map(|_: &Call<'_>, x: ArrayView4<'_, f32>| x.mapv(|v| v / (1.0 + lambda))), gamma);
    let outcome = run(&mut solver, &problem, Start::Mean, &stages(400), &mut ()).unwrap();
    let mu = gamma * lambda;
    let exact = h.adjoint((&problem.y() / &h.gram().mapv(|g| g + mu)).view());
    let worst = (outcome.estimate.sensor - exact).fold(0f32, |m, d| m.max(d.abs()));
    assert!(worst < 2e-5, "largest difference {worst}");
}

/// The same where noise of variance n is known of, pixel by pixel another: μ = (γ + n / mse) λ, the mse being that of the fixed point's own
/// residual.
#[test]
fn admm_with_known_noise_reaches_its_exact_fixed_point() {
    let (lambda, gamma) = (0.3f32, 0.2f32);
    let problem = measurement().with_noise(Some(sci_forward::Noise::new(Some(40.0), 0.05).unwrap()));
    let (operator, variance) = (problem.operator(), problem.variance().unwrap());
    let mut solver = Admm::new(Map(|_: &Call<'_>, x: ArrayView4<'_, f32>| x.mapv(|v| v / (1.0 + lambda))), gamma);
    let outcome = run(&mut solver, &problem, Start::Mean, &stages(600), &mut ()).unwrap();
    let found = outcome.estimate.sensor;
    let residual = &problem.y() - &operator.forward(found.view());
    let sum = |values: &Array2<f32>| values.iter().map(|&v| f64::from(v)).sum::<f64>();
    let open = operator.gram().mapv(|gram| if gram > 0.0 { 1.0 } else { 0.0 });
    let mse = (sum(&(&residual * &residual * &open)) / sum(&operator.gram().to_owned())) as f32;
    let mu = variance.mapv(|n| (gamma + n / mse) * lambda);
    let exact = operator.adjoint((&problem.y() / &(&operator.gram() + &mu)).view());
    let worst = (found - exact).fold(0f32, |m, d| m.max(d.abs()));
    assert!(worst < 2e-5, "largest difference {worst}");
}

/// A momentum that starts anew explains y no more closely than the noise allows.
#[test]
fn a_restart_knows_the_noise_too() {
    let noise = gaussian(SHAPE.image_dim(), 3) * 0.2;
    let unaware = Measurement::new(operator(), &noise + &measurement().y()).unwrap();
    let told = sci_forward::Noise::new(None, 0.2).unwrap();
    let plan = Plan::new([0.1, 0.01].map(|sigma| Stage { sigma: Some(sigma), iterations: 1 }));
    let last_input = |problem: &Measurement| {
        let mut seen = Array3::zeros(SHAPE.dim());
        let see = Map(|_: &Call<'_>, x: ArrayView4<'_, f32>| {
            seen.assign(&x.index_axis(Axis(1), 0));
            x.mapv(|v| 0.9 * v)
        });
        run(&mut Gap::accelerated(see).restarting(), problem, Start::Mean, &plan, &mut ()).unwrap();
        let off = problem.residual(seen.insert_axis(Axis(1)).view()).unwrap();
        off.mapv(|d| d * d).mean().unwrap().sqrt()
    };
    let (exact, damped) = (last_input(&unaware), last_input(&unaware.clone().with_noise(Some(told))));
    assert!(exact < 1e-4 && damped > 0.02, "{exact}, {damped}");
}

/// Whatever noise is told, what is left of the residual is not added up for ever. With half of it told the error rises and falls with the
/// iterations, and rounding, another on each processor, decides when.
#[test]
fn accelerated_gap_is_safe_where_noise_is_told_wrongly() {
    let truth = moving_square(SHAPE);
    let noise = gaussian(SHAPE.image_dim(), 3) * 0.2;
    let problem = Measurement::new(operator(), &noise + &measurement().y()).unwrap();
    let error = |told: Option<f64>, iterations: usize| {
        let told = told.map(|read| sci_forward::Noise::new(None, read).unwrap());
        let problem = problem.clone().with_noise(told);
        let mut solver = Gap::accelerated(Tv::new(0.3));
        let outcome = run(&mut solver, &problem, Start::Adjoint, &stages(iterations), &mut ()).unwrap();
        rms(&outcome.estimate.sensor, &truth)
    };
    let untold = error(None, 40);
    for (told, allowed) in [(0.1, 1.3), (0.14, 1.0), (0.17, 1.0), (0.2, 1.0), (0.28, 1.0)] {
        for iterations in [39, 40, 80, 320] {
            let error = error(Some(told), iterations);
            assert!(error < allowed * untold, "{told} told, {iterations} iterations: {error}, untold {untold}");
        }
    }
}

/// With the identity as prior, GAP is a projection: one step reaches `{x : H x = y}`, and further steps stay.
#[test]
fn gap_with_no_prior_is_the_projection() {
    let identity = || Map(|_: &Call<'_>, x: ArrayView4<'_, f32>| x.to_owned());
    let start = uniform(SHAPE.dim(), 8);
    let one = solve(Gap::plain(identity()), Start::From(start.view()), &stages(1));
    let five = solve(Gap::plain(identity()), Start::From(start.view()), &stages(5));
    assert!(one.relative_residual < 1e-6 && five.relative_residual < 1e-6);
    assert!((one.estimate.sensor - five.estimate.sensor).iter().all(|d| d.abs() < 1e-5));
}

fn rms(a: &Array3<f32>, b: &Array3<f32>) -> f32 {
    (a - b).mapv(|d| d * d).mean().unwrap().sqrt()
}

#[test]
fn every_start_and_solver_recovers_a_simple_scene() {
    let truth = moving_square(SHAPE);
    let previous = Array3::from_elem(SHAPE.dim(), 0.4);
    // What a start knows without a solver: the mean of the frames.
    let still = run(&mut Gap::plain(Tv::new(0.1)), &measurement(), Start::Mean, &Plan::new([]), &mut ()).unwrap();
    let known = rms(&still.estimate.sensor, &truth);
    let mut tv = Tv::new(0.1);
    for which in 0..4 {
        let mut check = |name: &str, share: f32, mut solver: Box<dyn Solver>| {
            let start = match which {
                0 => Start::Mean,
                1 => Start::Adjoint,
                2 => Start::From(previous.view()),
                _ => Start::Warm { prior: &mut tv, stage: Stage { sigma: None, iterations: 10 } },
            };
            let shown = format!("{start:?}");
            let outcome = run(solver.as_mut(), &measurement(), start, &stages(60), &mut ()).unwrap();
            let error = rms(&outcome.estimate.sensor, &truth);
            assert!(error < share * known, "{name} from {shown}: {error} of {known}");
        };
        check("plain GAP", 0.75, Box::new(Gap::plain(Tv::new(0.1))));
        check("GAP", 0.6, Box::new(Gap::accelerated(Tv::new(0.1))));
        check("the reference's GAP", 0.6, Box::new(Gap::with_momentum(Tv::new(0.1), MomentumStart::Zero)));
        check("ADMM", 0.6, Box::new(Admm::new(Tv::new(0.1), 0.01)));
    }
}

/// The reference's ADMM-TV, by its lines.
#[test]
fn the_warm_start_is_the_references() {
    let problem = measurement();
    let (h, y) = (operator(), problem.y());
    let mut theta = h.adjoint(y);
    let (mut b, mut x) = (Array3::<f32>::zeros(SHAPE.dim()), theta.clone());
    let weight = h.gram().mapv(|g| if g > 0.0 { 1.0 / (g + 0.01) } else { 0.0 });
    for _ in 0..7 {
        let p = &theta + &b;
        x = &p + &h.adjoint(((&y - &h.forward(p.view())) * &weight).view());
        let z = (&x - &b).insert_axis(Axis(1));
        let mut v = Array4::zeros(z.dim());
        Tv::new(0.1).denoise(&Call::default(), z.view(), v.view_mut()).unwrap();
        theta = v.remove_axis(Axis(1)).mapv(|v| v.clamp(0.0, 1.0));
        b = &b - &(&x - &theta);
    }
    let mut tv = Tv::new(0.1);
    let start = Start::Warm { prior: &mut tv, stage: Stage { sigma: None, iterations: 7 } };
    let warm = run(&mut Gap::plain(Tv::new(0.1)), &problem, start, &Plan::new([]), &mut ()).unwrap();
    let worst = (warm.estimate.sensor - x).fold(0f32, |m, d| m.max(d.abs()));
    assert!(worst < 1e-5, "{worst}");
}

#[test]
fn a_warm_start_is_watched_and_stopped_as_any_solve() {
    struct Watch {
        warm: Vec<usize>,
        main: usize,
        stop_at: usize,
    }
    impl Observer for Watch {
        fn warm_start(&mut self, it: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
            self.warm.push(it.iteration);
            Ok(if it.iteration == self.stop_at { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
        }
        fn iteration(&mut self, _: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
            self.main += 1;
            Ok(ControlFlow::Continue(()))
        }
    }
    let solve = |stop_at, stop: StopRule| {
        let (mut tv, mut watch) = (Tv::new(0.1), Watch { warm: Vec::new(), main: 0, stop_at });
        let start = Start::Warm { prior: &mut tv, stage: Stage { sigma: None, iterations: 4 } };
        let plan = Plan { stop, ..stages(3) };
        let outcome = run(&mut Gap::plain(Tv::new(0.1)), &measurement(), start, &plan, &mut watch).unwrap();
        assert!(outcome.estimate.is_finite() && outcome.relative_residual < 0.1);
        (outcome.stop, outcome.iterations, watch.warm, watch.main)
    };
    let never = StopRule::default();
    assert_eq!(solve(9, never), (StopReason::ScheduleDone, 3, vec![0, 1, 2, 3], 3));
    assert_eq!(solve(1, never), (StopReason::Observer, 0, vec![0, 1], 0));
    let limit = StopRule { time: Some(std::time::Duration::ZERO), ..never };
    assert_eq!(solve(9, limit), (StopReason::TimeUp, 0, vec![0], 0));
}

#[test]
fn stages_name_their_denoisers_and_sigmas_in_order() {
    let seen = Mutex::new(Vec::new());
    let probe = |name: &'static str| {
        let seen = &seen;
        Box::new(Map(move |call: &Call<'_>, x: ArrayView4<'_, f32>| {
            seen.lock().unwrap().push((name, call.iteration, call.sigma));
            x.to_owned()
        })) as Box<dyn Prior + '_>
    };
    let plan = Plan::new([
        Stage { sigma: Some(0.2), iterations: 2 },
        Stage { sigma: Some(0.1), iterations: 1 },
        Stage { sigma: Some(0.05), iterations: 1 },
    ]);
    solve(Gap::plain(PerStage::new(vec![probe("a"), probe("b")], vec![0, 1, 0])), Start::Mean, &plan);
    assert_eq!(
        *seen.lock().unwrap(),
        [("a", 0, Some(0.2)), ("a", 1, Some(0.2)), ("b", 2, Some(0.1)), ("a", 3, Some(0.05))]
    );
}

struct StopAt(usize);

impl Observer for StopAt {
    fn iteration(&mut self, it: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
        Ok(if it.iteration == self.0 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
    }
}

#[test]
fn every_way_to_stop_is_told() {
    let problem = measurement();
    let stop_with = |stop: StopRule, observer: &mut dyn Observer| {
        let plan = Plan { stop, ..stages(50) };
        let outcome = run(&mut Gap::plain(Tv::new(0.1)), &problem, Start::Mean, &plan, observer).unwrap();
        (outcome.stop, outcome.iterations)
    };
    let never = StopRule::default();
    assert_eq!(stop_with(never, &mut ()), (StopReason::ScheduleDone, 50));
    assert_eq!(stop_with(never, &mut StopAt(6)), (StopReason::Observer, 7));
    let (stop, iterations) = stop_with(StopRule { relative_change: 0.01, ..never }, &mut ());
    assert!(stop == StopReason::Converged && iterations < 50, "{iterations}");
    let limit = StopRule { time: Some(std::time::Duration::ZERO), ..never };
    assert_eq!(stop_with(limit, &mut ()), (StopReason::TimeUp, 1));
}

#[test]
fn a_denoiser_that_explodes_or_turns_nan_ends_as_diverged_with_the_last_good_estimate() {
    for poison in [f32::NAN, f32::INFINITY, 1e30] {
        let broken = Map(
            move |call: &Call<'_>, x: ArrayView4<'_, f32>| {
                if call.iteration == 3 { x.mapv(|v| v * poison) } else { x.to_owned() }
            },
        );
        let outcome = solve(Gap::plain(broken), Start::Mean, &stages(10));
        assert_eq!((outcome.stop, outcome.iterations), (StopReason::Diverged, 4));
        assert!(outcome.estimate.is_finite());
        assert!(outcome.relative_residual < 1e-5);
    }
}

#[test]
fn accelerated_gap_goes_on_without_acceleration_after_its_first_divergence() {
    // Once broken, the accumulated measurement would stay so.
    let poisoned = |at: usize| {
        Map(
            move |call: &Call<'_>, x: ArrayView4<'_, f32>| {
                if call.iteration % at == at - 1 { x.mapv(|v| v * f32::NAN) } else { x.to_owned() }
            },
        )
    };
    let once = solve(Gap::accelerated(poisoned(4)), Start::Mean, &stages(7));
    let expected = Some(BackOff { iteration: 3, without: "acceleration" });
    assert_eq!((once.stop, once.backed_off, once.iterations), (StopReason::ScheduleDone, expected, 7));
    assert!(once.estimate.is_finite() && once.relative_residual < 1e-5);
    let twice = solve(Gap::accelerated(poisoned(4)), Start::Mean, &stages(9));
    assert_eq!((twice.stop, twice.backed_off, twice.iterations), (StopReason::Diverged, expected, 8));
    let last = solve(Gap::accelerated(poisoned(4)), Start::Mean, &stages(4));
    assert!(last.backed_off == expected && last.estimate.is_finite());
}

#[test]
fn a_failing_denoiser_is_named_with_its_iteration() {
    struct Fails;
    impl Denoiser for Fails {
        fn name(&self) -> &str {
            "fails"
        }
        fn denoise(&mut self, _: &Call<'_>, _: ArrayView4<'_, f32>, _: ArrayViewMut4<'_, f32>) -> Result<(), BoxError> {
            Err("out of film".into())
        }
    }
    let error = run(&mut Gap::plain(Fails), &measurement(), Start::Mean, &stages(2), &mut ()).unwrap_err();
    assert_eq!(error.to_string(), "denoiser fails failed in iteration 0");
    assert_eq!(std::error::Error::source(&error).unwrap().to_string(), "out of film");
}

#[test]
fn inputs_of_the_wrong_size_or_not_finite_are_refused() {
    let h = operator();
    assert!(matches!(Measurement::new(h.clone(), Array2::zeros((3, 3))), Err(MeasurementError::Size { .. })));
    let start_with = |start: Start<'_>, measurement: &Measurement| {
        run(&mut Gap::plain(Tv::new(0.1)), measurement, start, &stages(1), &mut ()).map(|_| ()).unwrap_err()
    };
    let wrong = Array3::zeros((1, 24, 20));
    assert!(matches!(start_with(Start::From(wrong.view()), &measurement()), SolveError::Size { .. }));
    let mut wrong = Array3::zeros(SHAPE.dim());
    wrong[[1, 2, 3]] = f32::INFINITY;
    let message = start_with(Start::From(wrong.view()), &measurement()).to_string();
    assert_eq!(message, "the start is inf at index [1, 2, 3]: every value must be finite");
    // A start that is computed may leave the range of numbers too.
    let heavy = Arc::new(MaskOperator::new(MaskStack::new(Array3::from_elem(SHAPE.dim(), 1e9)).unwrap()));
    let bright = Measurement::new(heavy, Array2::from_elem(SHAPE.image_dim(), 1e30)).unwrap();
    assert!(matches!(start_with(Start::Adjoint, &bright), SolveError::NotFinite { what: "start", .. }));
    let mut plan = stages(1);
    plan.hold_out = Some(HoldOut { spacing: 0, ..HoldOut::default() });
    let error = run(&mut Gap::plain(Tv::new(0.1)), &measurement(), Start::Mean, &plan, &mut ()).unwrap_err();
    assert_eq!(error.to_string(), "hold_out.spacing = 0: it must be at least 2");
}

/// The residue of a calibration, 1e-16, opens no pixel: nothing is divided by it, in the start and afterwards.
#[test]
fn a_pixel_that_masks_hardly_open_counts_as_closed_everywhere() {
    let shape = VideoShape { frames: 8, height: 8, width: 8 };
    let mut masks = Array3::ones(shape.dim());
    masks.slice_mut(ndarray::s![.., 3, 3]).fill(1e-16);
    let h = Arc::new(MaskOperator::new(MaskStack::new(masks).unwrap()));
    let mut y = h.forward(Array3::from_elem(shape.dim(), 0.5).view());
    y[[3, 3]] = 0.01;
    let measurement = Measurement::new(h, y).unwrap();
    for start in [Start::Mean, Start::Adjoint] {
        let outcome = run(&mut Gap::accelerated(Tv::new(0.1)), &measurement, start, &stages(20), &mut ()).unwrap();
        let estimate = outcome.estimate.sensor;
        assert!(estimate.iter().all(|v| (v - 0.5).abs() < 0.1), "{}", estimate[[0, 3, 3]]);
    }
}

#[test]
fn the_time_of_an_iteration_that_diverges_counts() {
    let slow = Map(|_: &Call<'_>, x: ArrayView4<'_, f32>| {
        std::thread::sleep(std::time::Duration::from_millis(50));
        x.mapv(|_| f32::NAN)
    });
    let outcome = solve(Gap::plain(slow), Start::Mean, &stages(1));
    assert!(outcome.stop == StopReason::Diverged && outcome.seconds >= 0.05, "{}", outcome.seconds);
}

#[test]
fn results_are_the_same_bits_for_any_thread_count_and_run() {
    let solve_with = |threads, which| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut tv = Tv::new(0.2);
            let start = Start::Warm { prior: &mut tv, stage: Stage { sigma: None, iterations: 3 } };
            let mut solver: Box<dyn Solver> = match which {
                0 => Box::new(Gap::accelerated(Tv::new(0.1))),
                _ => Box::new(Admm::new(Tv::new(0.1), 0.1)),
            };
            run(solver.as_mut(), &measurement(), start, &stages(20), &mut ()).unwrap()
        })
    };
    for which in [0, 1] {
        let (one, two, again) = (solve_with(1, which), solve_with(2, which), solve_with(2, which));
        assert_eq!(one.estimate, two.estimate);
        assert_eq!(two.estimate, again.estimate);
        assert_eq!(one.relative_residual.to_bits(), two.relative_residual.to_bits());
    }
}

#[test]
fn a_black_measurement_gives_a_black_video() {
    let black = Measurement::new(operator(), Array2::zeros(SHAPE.image_dim())).unwrap();
    let outcome = run(&mut Gap::accelerated(Tv::new(0.1)), &black, Start::Mean, &stages(20), &mut ()).unwrap();
    assert!(outcome.stop == StopReason::Converged || outcome.stop == StopReason::ScheduleDone);
    assert!(outcome.estimate.sensor.iter().all(|&v| v == 0.0));
}

#[test]
fn pixels_that_no_mask_opens_are_filled_in_by_the_prior() {
    let mut measured = Array2::from_elem(SHAPE.image_dim(), true);
    measured.slice_mut(ndarray::s![10..12, 8..10]).fill(false);
    let truth = Array3::from_elem(SHAPE.dim(), 0.6);
    let y = operator().forward(truth.view());
    let part = Measurement::new(operator(), y).unwrap().restricted(measured.view()).unwrap();
    let outcome = run(&mut Gap::plain(Tv::new(0.3)), &part, Start::Mean, &stages(60), &mut ()).unwrap();
    assert!((outcome.estimate.sensor - truth).iter().all(|d| d.abs() < 1e-3));
}

#[test]
fn the_trace_is_monotone_in_time_and_counts_from_zero() {
    struct Trace(Vec<(usize, f64)>);
    impl Observer for Trace {
        fn iteration(&mut self, it: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
            self.0.push((it.iteration, it.seconds));
            Ok(ControlFlow::Continue(()))
        }
    }
    let mut trace = Trace(Vec::new());
    run(&mut Gap::plain(Tv::new(0.1)), &measurement(), Start::Mean, &stages(5), &mut trace).unwrap();
    let iterations: Array1<usize> = trace.0.iter().map(|t| t.0).collect();
    assert_eq!(iterations, Array1::from_iter(0..5));
    assert!(trace.0.windows(2).all(|w| w[0].1 < w[1].1));
}

#[test]
fn every_iteration_turns_the_video_another_way_round_and_back() {
    // A blur that leans to the right, downwards and forwards in time.
    let lean = |noisy: ArrayView4<'_, f32>| {
        Array4::from_shape_fn(noisy.dim(), |(t, c, y, x)| {
            0.5 * (noisy[[t, c, y, x]] + noisy[[t.saturating_sub(1), c, y.saturating_sub(1), x.saturating_sub(1)]])
        })
    };
    let noisy = uniform((3, 5, 7), 1).insert_axis(Axis(1));
    let mut seen: Vec<Array4<f32>> = Vec::new();
    for iteration in 0..16 {
        let turned = |axis: &usize| iteration >> [3, 2, 0].iter().position(|a| a == axis).unwrap() & 1 == 1;
        let axes = || [3, 2, 0].into_iter().filter(turned).map(Axis);
        let mut input = noisy.clone();
        axes().for_each(|axis| input.invert_axis(axis));
        let mut expected = lean(input.view());
        axes().for_each(|axis| expected.invert_axis(axis));

        let mut found = Array4::from_elem(noisy.dim(), f32::NAN);
        let call = Call { iteration, ..Call::new(0.1) };
        Flips::new(Map(|_: &Call<'_>, x: ArrayView4<'_, f32>| lean(x)))
            .denoise(&call, noisy.view(), found.view_mut())
            .unwrap();
        assert_eq!(found, expected, "iteration {iteration}");
        assert_eq!(seen.contains(&found), iteration >= 8, "eight ways round, then again");
        seen.push(found);
    }
}

/// Masks of both signs add up to nothing at many pixels: the mean start is then that of a scene that is even over a few.
#[test]
fn masks_of_both_signs_are_solved_from_every_start() {
    let shape = VideoShape { frames: 6, height: 48, width: 48 };
    let truth = moving_square(shape);
    let h = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.5, 1).unwrap().differential().unwrap()));
    let measurement = Measurement::new(h.clone(), h.forward(truth.view())).unwrap();
    let plan = |iterations| Plan::new([Stage { sigma: None, iterations }]);
    let solve = |start: Start<'_>, iterations| {
        let gap = &mut Gap::accelerated(Tv::new(0.1));
        rms(&run(gap, &measurement, start, &plan(iterations), &mut ()).unwrap().estimate.sensor, &truth)
    };
    let still = solve(Start::Mean, 0);
    assert!(still < 0.2, "{still}");
    let (mean, adjoint) = (solve(Start::Mean, 40), solve(Start::Adjoint, 40));
    assert!(mean < 0.05 && adjoint < 0.08, "{mean} {adjoint}");
    let admm = run(&mut Admm::new(Tv::new(0.1), 0.01), &measurement, Start::Mean, &plan(60), &mut ()).unwrap();
    assert!(rms(&admm.estimate.sensor, &truth) < 0.06);
}

/// With strong noise, a solver that knows of it is far better than one that does not; with none, nothing changes.
#[test]
fn noise_that_is_known_is_not_reconstructed() {
    let shape = VideoShape { frames: 6, height: 48, width: 48 };
    let truth = moving_square(shape);
    let operator = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.5, 1).unwrap()));
    let y = operator.forward(truth.view());
    let solve = |solver: &dyn Fn() -> Box<dyn Solver>, measurement: &Measurement| {
        let plan = Plan::new([Stage { sigma: None, iterations: 30 }]);
        let outcome = run(solver().as_mut(), measurement, Start::Mean, &plan, &mut ()).unwrap();
        outcome.estimate.sensor
    };
    let gap = || Box::new(Gap::accelerated(Tv::new(0.15))) as Box<dyn Solver>;
    let admm = || Box::new(Admm::new(Tv::new(0.15), 0.01)) as Box<dyn Solver>;
    let error = |x: &ndarray::Array3<f32>| (x - &truth).mapv(|d| d * d).mean().unwrap();
    for sigma in [0.2, 0.4] {
        let noise = sci_forward::Noise::new(None, sigma).unwrap();
        let unaware = Measurement::new(operator.clone(), noise.apply(y.view(), 3)).unwrap();
        let aware = unaware.clone().with_noise(Some(noise));
        for (name, solver) in [("gap", &gap as &dyn Fn() -> Box<dyn Solver>), ("admm", &admm)] {
            let [unaware, aware] = [&unaware, &aware].map(|measurement| error(&solve(solver, measurement)));
            assert!(aware < 0.8 * unaware, "{name}, σ = {sigma}: {aware} with, {unaware} without");
        }
    }
    let clean = Measurement::new(operator, y).unwrap();
    let silent = clean.clone().with_noise(Some(sci_forward::Noise::new(None, 0.0).unwrap()));
    assert_eq!(solve(&gap, &clean), solve(&gap, &silent));
    assert_eq!(solve(&admm, &clean), solve(&admm, &silent));
}

/// A sensor that clips a tenth of its pixels: one-sided they tell more than left out, and far more than believed.
#[test]
fn clipped_pixels_say_that_there_was_as_much_light_or_more() {
    let shape = VideoShape { frames: 6, height: 48, width: 48 };
    let truth = moving_square(shape);
    let operator = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.5, 1).unwrap()));
    let mut y = operator.forward(truth.view());
    let mut sorted: Vec<f32> = y.iter().copied().collect();
    sorted.sort_unstable_by(f32::total_cmp);
    let level = sorted[sorted.len() * 9 / 10];
    y.mapv_inplace(|y| y.min(level));
    let believed = Measurement::new(operator, y.clone()).unwrap();
    let left_out = believed.restricted(y.mapv(|y| y < level).view()).unwrap();
    let one_sided = believed.clone().with_clip(Some(level));
    let solve = |measurement: &Measurement, start: Start<'_>| {
        let plan = Plan::new([Stage { sigma: None, iterations: 40 }]);
        let outcome = run(&mut Gap::accelerated(Tv::new(0.1)), measurement, start, &plan, &mut ()).unwrap();
        assert_eq!(outcome.stop, StopReason::ScheduleDone);
        (outcome.estimate.sensor - &truth).mapv(|d| d * d).mean().unwrap()
    };
    let [believed, left_out, one_sided] =
        [&believed, &left_out, &one_sided].map(|measurement| solve(measurement, Start::Mean));
    assert!(one_sided < 0.95 * left_out && left_out < 0.5 * believed, "{one_sided} {left_out} {believed}");
}

/// The adjoint is too bright; what nothing takes away again must not be in it.
#[test]
fn clipped_pixels_do_not_keep_the_light_of_the_adjoint() {
    let shape = VideoShape { frames: 16, height: 48, width: 48 };
    let truth = moving_square(shape).mapv(|x| 0.3 + 0.5 * x);
    let operator = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.5, 1).unwrap()));
    let level = 3.0;
    let y = operator.forward(truth.view()).mapv(|y| y.min(level));
    let measurement = Measurement::new(operator, y).unwrap().with_clip(Some(level));
    let error = |start: Start<'_>| {
        let plan = Plan::new([Stage { sigma: None, iterations: 40 }]);
        let outcome = run(&mut Gap::accelerated(Tv::new(0.1)), &measurement, start, &plan, &mut ()).unwrap();
        (outcome.estimate.sensor - &truth).mapv(|d| d * d).mean().unwrap()
    };
    let [mean, adjoint] = [Start::Mean, Start::Adjoint].map(error);
    assert!(adjoint < 1.5 * mean, "{adjoint} {mean}");
}
