//! The solvers through [`admm::run`]: exact small cases, reference numbers on real scenes, and what a run may never do.

use admm::*;
use ndarray::{Array1, Array2, Array3, Array4, ArrayView4, ArrayViewMut4, Axis};
use ndarray_npy::NpzReader;
use sci_forward::testing::{moving_square, uniform};
use sci_forward::{MaskOperator, MaskStack, SensingOperator, VideoShape};
use std::ops::ControlFlow;

const SHAPE: VideoShape = VideoShape { frames: 4, height: 24, width: 20 };

fn operator() -> MaskOperator {
    MaskOperator::new(MaskStack::random(SHAPE, 0.5, 3).unwrap())
}

fn stages(iterations: usize) -> Plan {
    Plan::new([Stage { sigma: 0.1, iterations }])
}

fn solve<S: Solver>(mut solver: S, start: Start<'_>, plan: &Plan) -> Outcome<S::State> {
    let h = operator();
    let y = h.forward(moving_square(SHAPE).view());
    run(&mut solver, &Problem::new(&h, y.view()).unwrap(), start, plan, &mut ()).unwrap()
}

/// A denoiser that is a closure on the whole video.
struct Map<F>(F);

impl<F: FnMut(&DenoiseCx, ArrayView4<'_, f32>) -> Array4<f32>> Denoiser for Map<F> {
    fn name(&self) -> &str {
        "map"
    }
    fn denoise(
        &mut self,
        cx: &DenoiseCx,
        x: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        out.assign(&(self.0)(cx, x));
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
    let cx = DenoiseCx::new(0.0);
    Tv::new(0.3).denoise(&cx, input.view().insert_axis(Axis(1)), out.view_mut()).unwrap();
    let worst = (out.remove_axis(Axis(1)) - expected).fold(0f32, |m, d| m.max(d.abs()));
    assert!(worst < 1e-5, "largest difference {worst}");
}

/// With the linear prior `θ = x / (1 + λ)`, i.e. `λ/2 ‖θ‖²`, and γ, ADMM has the ridge solution as its fixed point:
/// `x = (HᵀH + μ I)⁻¹ Hᵀ y` with `μ = γ λ`, per pixel a rank-one system.
#[test]
fn admm_with_a_linear_denoiser_reaches_its_exact_fixed_point() {
    let (h, lambda, gamma) = (operator(), 0.3f32, 0.7f32);
    let y = h.forward(moving_square(SHAPE).view());
    let mut solver = Admm::new(Map(|_: &DenoiseCx, x: ArrayView4<'_, f32>| x.mapv(|v| v / (1.0 + lambda))), gamma);
    let problem = Problem::new(&h, y.view()).unwrap();
    let outcome = run(&mut solver, &problem, Start::Mean, &stages(400), &mut ()).unwrap();
    let mu = gamma * lambda;
    let exact = h.adjoint((&y / &h.gram_diag().mapv(|g| g + mu)).view());
    let worst = (outcome.estimate - exact).fold(0f32, |m, d| m.max(d.abs()));
    assert!(worst < 2e-5, "largest difference {worst}");
}

/// With the identity as prior, GAP is a projection: one step reaches `{x : H x = y}`, and further steps stay.
#[test]
fn gap_with_no_prior_is_the_projection() {
    let identity = || Map(|_: &DenoiseCx, x: ArrayView4<'_, f32>| x.to_owned());
    let start = uniform(SHAPE.dim(), 8);
    let one = solve(Gap::plain(identity()), Start::From(start.view()), &stages(1));
    let five = solve(Gap::plain(identity()), Start::From(start.view()), &stages(5));
    assert!(one.relative_residual < 1e-6 && five.relative_residual < 1e-6);
    assert!((one.estimate - five.estimate).iter().all(|d| d.abs() < 1e-5));
}

#[test]
fn every_start_and_solver_recovers_a_simple_scene() {
    let truth = moving_square(SHAPE);
    let previous = Array3::from_elem(SHAPE.dim(), 0.4);
    let starts = [
        Start::Mean,
        Start::Adjoint,
        Start::From(previous.view()),
        Start::Tv { iterations: 10, weight: 0.1, bayer: false },
    ];
    let rmse = |x: &Array3<f32>| (x - &truth).mapv(|d| d * d).mean().unwrap().sqrt();
    for start in starts {
        let estimates = [
            solve(Gap::plain(Tv::new(0.1)), start, &stages(60)).estimate,
            solve(Gap::accelerated(Tv::new(0.1)), start, &stages(60)).estimate,
            solve(Gap::with_momentum(Tv::new(0.1), MomentumStart::Zero), start, &stages(60)).estimate,
            solve(Admm::new(Tv::new(0.1), 0.01), start, &stages(60)).estimate,
        ];
        for estimate in estimates {
            assert!(rmse(&estimate) < 0.1, "{start:?}: {}", rmse(&estimate));
        }
    }
}

#[test]
fn stages_name_their_denoisers_and_sigmas_in_order() {
    let seen = std::cell::RefCell::new(Vec::new());
    let probe = |name: &'static str| {
        let seen = &seen;
        Box::new(Map(move |cx: &DenoiseCx, x: ArrayView4<'_, f32>| {
            seen.borrow_mut().push((name, cx.iteration, cx.sigma));
            x.to_owned()
        })) as Box<dyn Denoiser + '_>
    };
    let plan = Plan::new([
        Stage { sigma: 0.2, iterations: 2 },
        Stage { sigma: 0.1, iterations: 1 },
        Stage { sigma: 0.05, iterations: 1 },
    ]);
    solve(Gap::plain(PerStage::new(vec![probe("a"), probe("b")], vec![0, 1, 0])), Start::Mean, &plan);
    assert_eq!(*seen.borrow(), [("a", 0, 0.2), ("a", 1, 0.2), ("b", 2, 0.1), ("a", 3, 0.05)]);
}

struct StopAt(usize);

impl Observer for StopAt {
    fn iteration(&mut self, it: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
        Ok(if it.iteration == self.0 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
    }
}

#[test]
fn every_way_to_stop_is_told() {
    let h = operator();
    let y = h.forward(moving_square(SHAPE).view());
    let problem = Problem::new(&h, y.view()).unwrap();
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
            move |cx: &DenoiseCx, x: ArrayView4<'_, f32>| {
                if cx.iteration == 3 { x.mapv(|v| v * poison) } else { x.to_owned() }
            },
        );
        let outcome = solve(Gap::plain(broken), Start::Mean, &stages(10));
        assert_eq!((outcome.stop, outcome.iterations), (StopReason::Diverged, 4));
        assert!(outcome.estimate.iter().all(|v| v.is_finite()));
        assert!(outcome.relative_residual < 1e-5);
    }
}

#[test]
fn accelerated_gap_goes_on_without_acceleration_after_its_first_divergence() {
    // Once broken, the accumulated measurement would stay so.
    let poisoned = |at: usize| {
        Map(
            move |cx: &DenoiseCx, x: ArrayView4<'_, f32>| {
                if cx.iteration % at == at - 1 { x.mapv(|v| v * f32::NAN) } else { x.to_owned() }
            },
        )
    };
    let once = solve(Gap::accelerated(poisoned(4)), Start::Mean, &stages(7));
    let expected = Some(BackOff { iteration: 3, without: "acceleration" });
    assert_eq!((once.stop, once.backed_off, once.iterations), (StopReason::ScheduleDone, expected, 7));
    assert!(once.estimate.iter().all(|v| v.is_finite()) && once.relative_residual < 1e-5);
    let twice = solve(Gap::accelerated(poisoned(4)), Start::Mean, &stages(9));
    assert_eq!((twice.stop, twice.backed_off, twice.iterations), (StopReason::Diverged, expected, 8));
    let last = solve(Gap::accelerated(poisoned(4)), Start::Mean, &stages(4));
    assert!(last.backed_off == expected && last.estimate.iter().all(|v| v.is_finite()));
}

#[test]
fn a_failing_denoiser_is_named_with_its_iteration() {
    struct Fails;
    impl Denoiser for Fails {
        fn name(&self) -> &str {
            "fails"
        }
        fn denoise(
            &mut self,
            _: &DenoiseCx,
            _: ArrayView4<'_, f32>,
            _: ArrayViewMut4<'_, f32>,
        ) -> Result<(), BoxError> {
            Err("out of film".into())
        }
    }
    let h = operator();
    let y = h.forward(moving_square(SHAPE).view());
    let error = run(&mut Gap::plain(Fails), &Problem::new(&h, y.view()).unwrap(), Start::Mean, &stages(2), &mut ())
        .unwrap_err();
    assert_eq!(error.to_string(), "denoiser fails failed in iteration 0");
    assert_eq!(std::error::Error::source(&error).unwrap().to_string(), "out of film");
}

#[test]
fn inputs_of_the_wrong_size_or_not_finite_are_refused() {
    let h = operator();
    let wrong = Array2::zeros((3, 3));
    assert!(matches!(Problem::new(&h, wrong.view()), Err(SolveError::Size { .. })));
    let mut y = h.forward(moving_square(SHAPE).view());
    let start = Array3::zeros((1, 24, 20));
    let problem = Problem::new(&h, y.view()).unwrap();
    assert!(matches!(Start::From(start.view()).video(&problem), Err(SolveError::Size { .. })));
    y[[2, 1]] = f32::NAN;
    let message = Problem::new(&h, y.view()).err().unwrap().to_string();
    assert!(message.contains("NaN at index [2, 1]"), "{message}");
}

#[test]
fn results_are_the_same_bits_for_any_thread_count_and_run() {
    let solve_with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            solve(Gap::accelerated(Tv::new(0.1)), Start::Tv { iterations: 3, weight: 0.2, bayer: false }, &stages(20))
        })
    };
    let (one, two, again) = (solve_with(1), solve_with(2), solve_with(2));
    assert_eq!(one.estimate, two.estimate);
    assert_eq!(two.estimate, again.estimate);
    assert_eq!(one.relative_residual.to_bits(), two.relative_residual.to_bits());
}

#[test]
fn a_black_measurement_gives_a_black_video() {
    let h = operator();
    let y = Array2::zeros(SHAPE.image_dim());
    let outcome = run(
        &mut Gap::accelerated(Tv::new(0.1)),
        &Problem::new(&h, y.view()).unwrap(),
        Start::Mean,
        &stages(20),
        &mut (),
    )
    .unwrap();
    assert!(outcome.stop == StopReason::Converged || outcome.stop == StopReason::ScheduleDone);
    assert!(outcome.estimate.iter().all(|&v| v == 0.0));
}

#[test]
fn pixels_that_no_mask_opens_are_filled_in_by_the_prior() {
    let mut measured = Array2::from_elem(SHAPE.image_dim(), true);
    measured.slice_mut(ndarray::s![10..12, 8..10]).fill(false);
    let h = MaskOperator::new(MaskStack::random(SHAPE, 0.5, 3).unwrap().restricted_to(measured.view()).unwrap());
    let truth = Array3::from_elem(SHAPE.dim(), 0.6);
    let y = h.forward(truth.view());
    let outcome =
        run(&mut Gap::plain(Tv::new(0.3)), &Problem::new(&h, y.view()).unwrap(), Start::Mean, &stages(60), &mut ())
            .unwrap();
    assert!((outcome.estimate - truth).iter().all(|d| d.abs() < 1e-3));
}

/// The data of a scene in ndarray's own format is the business of the program; here only its size is checked by the doc example.
#[test]
fn the_trace_is_monotone_in_time_and_counts_from_zero() {
    struct Trace(Vec<(usize, f64)>);
    impl Observer for Trace {
        fn iteration(&mut self, it: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
            self.0.push((it.iteration, it.seconds));
            Ok(ControlFlow::Continue(()))
        }
    }
    let h = operator();
    let y = h.forward(moving_square(SHAPE).view());
    let mut trace = Trace(Vec::new());
    run(&mut Gap::plain(Tv::new(0.1)), &Problem::new(&h, y.view()).unwrap(), Start::Mean, &stages(5), &mut trace)
        .unwrap();
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
        let cx = DenoiseCx { iteration, ..DenoiseCx::new(0.1) };
        Flips::new(Map(|_: &DenoiseCx, x: ArrayView4<'_, f32>| lean(x)))
            .denoise(&cx, noisy.view(), found.view_mut())
            .unwrap();
        assert_eq!(found, expected, "iteration {iteration}");
        assert_eq!(seen.contains(&found), iteration >= 8, "eight ways round, then again");
        seen.push(found);
    }
}
