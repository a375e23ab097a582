//! Color solvers: exact fixed points, gray scenes through the color path, and the symmetry of the patterns.

use admm::*;
use ndarray::{Array1, Array2, Array3, Array4, ArrayView3, ArrayView4, ArrayViewMut4, Axis, s};
use sci_forward::bayer::{Bilinear, CfaPattern, Demosaicer, Malvar, Menon, mosaic_into};
use sci_forward::testing::{moving_square, uniform};
use sci_forward::{MaskOperator, MaskStack, Measurement, Noise, SensingOperator, VideoShape};
use std::sync::Arc;

/// `D(x) = a x`.
struct Scale(f32);

impl Denoiser for Scale {
    fn name(&self) -> &str {
        "scale"
    }
    fn denoise(
        &mut self,
        _: &Call<'_>,
        x: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        out.assign(&x.mapv(|v| v * self.0));
        Ok(())
    }
}

fn problem_data(shape: VideoShape) -> (Arc<MaskOperator>, Array2<f32>) {
    let h = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.6, 4).unwrap()));
    let y = h.forward(uniform(shape.dim(), 5).view());
    (h, y)
}

/// Solves `A z = c` in `f64` by elimination with pivots.
fn dense_solve(mut a: Array2<f64>, mut c: Array1<f64>) -> Array1<f64> {
    let n = c.len();
    for k in 0..n {
        let pivot = (k..n).max_by(|&i, &j| a[[i, k]].abs().total_cmp(&a[[j, k]].abs())).unwrap();
        for j in 0..n {
            a.swap([k, j], [pivot, j]);
        }
        c.swap(k, pivot);
        for i in k + 1..n {
            let f = a[[i, k]] / a[[k, k]];
            for j in k..n {
                let v = a[[k, j]];
                a[[i, j]] -= f * v;
            }
            c[i] -= f * c[k];
        }
    }
    for k in (0..n).rev() {
        let sum: f64 = (k + 1..n).map(|j| a[[k, j]] * c[j]).sum();
        c[k] = (c[k] - sum) / a[[k, k]];
    }
    c
}

/// The matrix of a linear map on videos, column by column.
fn matrix(n: usize, m: usize, map: impl Fn(&Array1<f32>) -> Array1<f32>) -> Array2<f64> {
    let mut a = Array2::zeros((m, n));
    for k in 0..n {
        let mut e = Array1::zeros(n);
        e[k] = 1.0f32;
        a.column_mut(k).assign(&map(&e).mapv(f64::from));
    }
    a
}

const TINY: VideoShape = VideoShape { frames: 2, height: 4, width: 4 };
const CFA: CfaPattern = CfaPattern::Grbg;

fn h_matrix(h: &MaskOperator) -> Array2<f64> {
    matrix(32, 16, |x| h.forward(x.to_shape(TINY.dim()).unwrap().view()).flatten().to_owned())
}

fn t_matrix() -> Array2<f64> {
    matrix(96, 32, |x| {
        let mut m = Array3::zeros(TINY.dim());
        mosaic_into(CFA, x.to_shape((2, 3, 4, 4)).unwrap().view(), m.view_mut());
        m.flatten().to_owned()
    })
}

fn demosaic_matrix(method: &mut dyn Demosaicer) -> Array2<f64> {
    let method = std::cell::RefCell::new(method);
    matrix(32, 96, |m| {
        let mut rgb = Array4::zeros((2, 3, 4, 4));
        method.borrow_mut().demosaic(CFA, m.to_shape(TINY.dim()).unwrap().view(), rgb.view_mut()).unwrap();
        rgb.flatten().to_owned()
    })
}

fn solve(
    x_step: XStep,
    params: TwoStageParams,
    a: f32,
    iterations: usize,
) -> (Arc<MaskOperator>, Array2<f32>, Array3<f32>, Array4<f32>) {
    let (h, y) = problem_data(TINY);
    let mut solver = TwoStage::new(Scale(a), Bilinear, x_step, CFA, params);
    let plan = Plan::new([Stage { sigma: Some(0.1), iterations }]);
    let outcome =
        run(&mut solver, &Measurement::new(h.clone(), y.clone()).unwrap(), Start::Mean, &plan, &mut ()).unwrap();
    assert_ne!(outcome.stop, StopReason::Diverged);
    (h, y, outcome.estimate.sensor, outcome.estimate.rgb.unwrap())
}

fn assert_close(a: impl IntoIterator<Item = f32>, b: impl IntoIterator<Item = f64>, tolerance: f64) {
    let worst = a.into_iter().zip(b).fold(0f64, |m, (a, b)| m.max((f64::from(a) - b).abs()));
    assert!(worst < tolerance, "largest difference {worst}");
}

/// Scaled, closed form: v solves `min ½‖y − H T v‖² + μ/2 ‖v‖²`, `μ = τ (1/a − 1)`, as `a x` is the prox of that prior.
#[test]
fn scaled_closed_form_reaches_the_exact_minimiser() {
    let (a, tau) = (0.8f32, 0.5f32);
    let params = TwoStageParams { rho: 0.7, tau, convention: Convention::Scaled };
    let (h, y, _, rgb) = solve(XStep::ClosedForm { clip: false }, params, a, 3000);
    let ht = h_matrix(&h).dot(&t_matrix());
    let mu = f64::from(tau) * (1.0 / f64::from(a) - 1.0);
    let normal = ht.t().dot(&ht) + Array2::<f64>::eye(96) * mu;
    let v = dense_solve(normal, ht.t().dot(&y.mapv(f64::from).flatten().to_owned()));
    assert_close(rgb, v, 1e-4);
}

/// Scaled, demosaicer `M`, `D = a`: at the fixed point `v = a M (q + b)`, `q = T v`, and `Hᵀ (y − H q) = ρ b`.
#[test]
fn scaled_demosaicing_reaches_its_exact_fixed_point() {
    let (a, rho) = (0.8f64, 0.7f64);
    let params = TwoStageParams { rho: rho as f32, tau: 1.0, convention: Convention::Scaled };
    let (h, y, theta, _) = solve(XStep::Demosaic, params, a as f32, 3000);
    let (hm, y) = (h_matrix(&h), y.mapv(f64::from).flatten().to_owned());
    // T M = 1, so q = a (q + b), b = (1/a − 1) q, and (HᵀH + ρ (1/a − 1)) q = Hᵀ y.
    assert!((t_matrix().dot(&demosaic_matrix(&mut Bilinear)) - Array2::<f64>::eye(32)).iter().all(|v| v.abs() < 1e-6));
    let q = dense_solve(hm.t().dot(&hm) + Array2::<f64>::eye(32) * (rho * (1.0 / a - 1.0)), hm.t().dot(&y));
    assert_close(theta, q, 1e-4);
}

/// The paper's convention with `D = 1`: `w` stays 0, `q = T x = q + b` makes `b` 0, so that `H q = y` and `x = M q` are left.
/// (With a denoiser that shrinks there is no other fixed point than 0: see the rustdoc of the convention.)
#[test]
fn the_papers_convention_reaches_its_exact_fixed_point() {
    let params = TwoStageParams { rho: 1.0, tau: 2.0, convention: Convention::PaperCode };
    let h = Arc::new(MaskOperator::new(MaskStack::random(TINY, 0.6, 4).unwrap()));
    let y = h.forward(uniform(TINY.dim(), 5).mapv(|v| 0.3 + 0.2 * v).view());
    let mut solver = TwoStage::new(Scale(1.0), Bilinear, XStep::Demosaic, CFA, params);
    let plan = Plan::new([Stage { sigma: Some(0.1), iterations: 400 }]);
    let outcome =
        run(&mut solver, &Measurement::new(h.clone(), y.clone()).unwrap(), Start::Mean, &plan, &mut ()).unwrap();
    let theta = &outcome.estimate.sensor;
    assert!(theta.iter().all(|&v| v > 0.0 && v < 1.0), "{theta}");
    assert!(outcome.relative_residual < 1e-6, "{}", outcome.relative_residual);
    let q = theta.mapv(f64::from).flatten().to_owned();
    assert_close(outcome.estimate.rgb.unwrap(), demosaic_matrix(&mut Bilinear).dot(&q), 1e-5);
}

/// Steps of the paper's closed form against a dense solve of `(ρ TᵀT + τ) x = ρ Tᵀ q + Tᵀ b + τ v + w`, without noise and with, which damps the
/// data step by n / mse(θ) more.
#[test]
fn the_papers_closed_form_is_the_dense_solution() {
    let params = TwoStageParams { rho: 0.55, tau: 10.0, convention: Convention::PaperCode };
    let a = 0.95;
    let start = uniform(TINY.dim(), 6);
    for noise in [None, Some(Noise::new(Some(50.0), 0.1).unwrap())] {
        let (h, y) = problem_data(TINY);
        let problem = Measurement::new(h.clone(), y).unwrap().with_noise(noise);
        let [theta, v] = paper_by_definition(&h, &problem, params, a, &start);
        let mut solver = TwoStage::new(Scale(a as f32), Bilinear, XStep::ClosedForm { clip: false }, CFA, params);
        let plan = Plan::new([Stage { sigma: Some(0.1), iterations: 3 }]);
        let outcome = run(&mut solver, &problem, Start::From(start.view()), &plan, &mut ()).unwrap();
        assert_close(outcome.estimate.sensor, theta, 1e-5);
        assert_close(outcome.estimate.rgb.unwrap(), v, 1e-5);
    }
}

/// Three iterations of the paper's closed form with `D = a`, by the definition, in `f64`: θ and v.
fn paper_by_definition(
    h: &MaskOperator,
    problem: &Measurement,
    TwoStageParams { rho, tau, .. }: TwoStageParams,
    a: f64,
    start: &Array3<f32>,
) -> [Array1<f64>; 2] {
    let (rho, tau) = (f64::from(rho), f64::from(tau));
    let (hm, tm, mm) = (h_matrix(h), t_matrix(), demosaic_matrix(&mut Bilinear));
    let flat = |image: Array2<f32>| image.mapv(f64::from).flatten().to_owned();
    let (y, gram) = (flat(problem.y().to_owned()), flat(h.gram().to_owned()));
    let noise = problem.variance().map(|n| flat(n.to_owned()));
    let (mut b, mut w, mut v) = (Array1::<f64>::zeros(32), Array1::<f64>::zeros(96), Array1::<f64>::zeros(96));
    let (mut theta, mut mse) = (start.mapv(f64::from).flatten().to_owned(), 0.0);
    for k in 0..3 {
        let damping = noise.as_ref().map_or(Array1::from_elem(16, rho), |n| {
            let residual = &y - &hm.dot(&theta);
            mse = (residual.dot(&residual) / gram.sum()).max(0.7 * mse);
            n / mse + rho
        });
        let p = &theta - &b / rho;
        let r = (&y - &hm.dot(&p)) / (&gram + &damping);
        let q = &p + &hm.t().dot(&r);
        let x = if k == 0 {
            mm.dot(&(&q + &b / rho))
        } else {
            let normal = tm.t().dot(&tm) * rho + Array2::<f64>::eye(96) * tau;
            dense_solve(normal, tm.t().dot(&(&q * rho + &b)) + &v * tau + &w)
        };
        v = (&x - &w / tau) * a;
        let raw = tm.dot(&v);
        theta = raw.mapv(|v| v.clamp(0.0, 1.0));
        b = b + (if k == 0 { raw } else { q }) - &theta;
        w = w + &x - &v;
    }
    [theta, v]
}

/// A mosaic of a gray scene whose demosaicing is exact (a plane) goes through the color path as through the gray one.
#[test]
fn a_gray_scene_through_the_color_path_equals_the_gray_path() {
    let shape = VideoShape { frames: 4, height: 16, width: 12 };
    let (h, _) = problem_data(shape);
    let flat = Array3::from_shape_fn(shape.dim(), |(t, _, _)| 0.2 + 0.1 * t as f32);
    let y = h.forward(flat.view());
    let problem = Measurement::new(h.clone(), y.clone()).unwrap();
    let plan = Plan::new([Stage { sigma: None, iterations: 30 }]);
    // Frame by frame the mean, the same for every color.
    struct FrameMean;
    impl Denoiser for FrameMean {
        fn name(&self) -> &str {
            "frame mean"
        }
        fn denoise(
            &mut self,
            _: &Call<'_>,
            x: ArrayView4<'_, f32>,
            mut out: ArrayViewMut4<'_, f32>,
        ) -> Result<(), BoxError> {
            for (x, mut out) in x.outer_iter().zip(out.outer_iter_mut()) {
                out.fill(x.mean().unwrap());
            }
            Ok(())
        }
    }
    let gray = run(&mut Gap::plain(FrameMean), &problem, Start::Mean, &plan, &mut ()).unwrap();
    let color = Demosaicked::new(FrameMean, Malvar, CfaPattern::Rggb);
    let color = run(&mut Gap::plain(color), &problem, Start::Mean, &plan, &mut ()).unwrap();
    let worst = (&gray.estimate.sensor - &color.estimate.sensor).fold(0f32, |m, d| m.max(d.abs()));
    // Malvar's green and red means of a noisy mosaic differ a little from the mosaic's own; the limit is the same.
    assert!(worst < 5e-3, "{worst}");
    let rgb = color.estimate.rgb.unwrap();
    assert_eq!(rgb.slice(s![.., 0, .., ..]), rgb.slice(s![.., 2, .., ..]));
}

/// The same scene seen through a shifted sensor (masks, scene and pattern shifted along) gives the same quality.
#[test]
fn the_four_patterns_give_the_same_result_up_to_the_shift() {
    let big = VideoShape { frames: 4, height: 98, width: 98 };
    let masks = MaskStack::random(big, 0.5, 7).unwrap();
    let scene = moving_square(big);
    let psnr = |cfa: CfaPattern, top: usize, left: usize| {
        let crop = |v: ArrayView3<'_, f32>| v.slice(s![.., top..top + 96, left..left + 96]).to_owned();
        let h = Arc::new(MaskOperator::new(MaskStack::new(crop(masks.view())).unwrap()));
        let truth = crop(scene.view());
        let y = h.forward(truth.view());
        let params = TwoStageParams { rho: 1.0, tau: 100.0, convention: Convention::PaperCode };
        let mut solver = TwoStage::new(Tv::new(0.1), Malvar, XStep::Demosaic, cfa, params);
        let plan = Plan::new([Stage { sigma: None, iterations: 20 }]);
        let mut tv = PerLattice::new(Tv::new(0.1));
        let start = Start::Warm { prior: &mut tv, stage: Stage { sigma: None, iterations: 20 } };
        let outcome =
            run(&mut solver, &Measurement::new(h.clone(), y.clone()).unwrap(), start, &plan, &mut ()).unwrap();
        let inner = s![.., 16..80, 16..80];
        let (shifted, truth) = (outcome.estimate.sensor, truth);
        let mse = (&shifted.slice(inner) - &truth.slice(inner)).mapv(|d| d * d).mean().unwrap();
        -10.0 * mse.log10()
    };
    let reference = psnr(CfaPattern::Rggb, 0, 0);
    assert!(reference > 18.0, "{reference}");
    for (cfa, top, left) in [(CfaPattern::Grbg, 0, 1), (CfaPattern::Gbrg, 1, 0), (CfaPattern::Bggr, 1, 1)] {
        let shifted = psnr(cfa, top, left);
        assert!((shifted - reference).abs() < 0.5, "{cfa}: {shifted} dB, RGGB {reference} dB");
    }
}

#[test]
fn sub_lattices_are_denoised_apart() {
    let noisy = uniform((2, 20, 24), 3);
    let mut out =
        Estimate { sensor: Array3::from_elem(noisy.dim(), f32::NAN), rgb: Some(Array4::zeros((2, 3, 20, 24))) };
    PerLattice::new(Tv::new(0.1)).apply(&Call::default(), noisy.view(), &mut out).unwrap();
    for (row, column) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
        let lattice = noisy.slice(s![.., row..;2, column..;2]).to_owned().insert_axis(Axis(1));
        let mut alone = Array4::zeros(lattice.dim());
        Tv::new(0.1).denoise(&Call::default(), lattice.view(), alone.view_mut()).unwrap();
        assert_eq!(out.sensor.slice(s![.., row..;2, column..;2]), alone.remove_axis(Axis(1)));
    }
    assert!(out.is_finite() && out.rgb.is_none(), "an RGB video of before is not of this estimate");
}

const SMALL: VideoShape = VideoShape { frames: 2, height: 24, width: 26 };

fn small_problem() -> Measurement {
    let h = Arc::new(MaskOperator::new(MaskStack::random(SMALL, 0.6, 4).unwrap()));
    Measurement::new(h.clone(), h.forward(moving_square(SMALL).view())).unwrap().with_cfa(Some(CFA))
}

/// The RGB video, sampled, is the estimate at the sensor.
fn assert_together(outcome: &Outcome) {
    let mut mosaic = Array3::zeros(outcome.estimate.sensor.dim());
    mosaic_into(CFA, outcome.estimate.rgb.as_ref().unwrap().view(), mosaic.view_mut());
    assert_eq!(mosaic, outcome.estimate.sensor);
}

/// With held-out pixels, when the best iterate comes first without and then with an RGB video, and the other way round.
#[test]
fn the_best_iterate_has_its_own_rgb_video() {
    let lattice = || Box::new(PerLattice::new(Tv::new(0.1))) as Box<dyn Prior>;
    let demosaicked = || Box::new(Demosaicked::new(Tv::new(0.1), Malvar, CFA)) as Box<dyn Prior>;
    let mut plan = Plan::new([Stage { sigma: None, iterations: 3 }, Stage { sigma: Some(0.01), iterations: 9 }]);
    plan.hold_out = Some(HoldOut { spacing: 6, overshoot: 1e3, ..HoldOut::default() });
    let solve = |priors: Vec<Box<dyn Prior>>| {
        let mut gap = Gap::plain(PerStage::new(priors, vec![0, 1]));
        run(&mut gap, &small_problem(), Start::Mean, &plan, &mut ()).unwrap()
    };
    assert_together(&solve(vec![lattice(), demosaicked()]));
    let outcome = solve(vec![demosaicked(), lattice()]);
    if outcome.estimate.rgb.is_some() {
        assert_together(&outcome);
    }
}

/// A prior that breaks in its fourth call, after which accelerated GAP goes on from the best iterate: that and its RGB video are the result,
/// also when no iteration is left.
#[test]
fn after_a_divergence_sensor_and_rgb_are_of_the_same_iterate() {
    struct Breaks;
    impl Denoiser for Breaks {
        fn name(&self) -> &str {
            "breaks"
        }
        fn denoise(
            &mut self,
            call: &Call<'_>,
            x: ArrayView4<'_, f32>,
            mut out: ArrayViewMut4<'_, f32>,
        ) -> Result<(), BoxError> {
            // Only the colors that no pixel sees are broken: the sensor does not notice.
            let broken = |c: usize, i: usize, j: usize| call.iteration == 3 && c != CFA.color_at(i, j) as usize;
            for (((_, c, i, j), out), &x) in out.indexed_iter_mut().zip(&x) {
                *out = if broken(c, i, j) { f32::NAN } else { x };
            }
            Ok(())
        }
    }
    for iterations in [4, 5, 6] {
        let plan = Plan::new([Stage { sigma: Some(0.1), iterations }]);
        let mut gap = Gap::accelerated(Demosaicked::new(Breaks, Malvar, CFA));
        let outcome = run(&mut gap, &small_problem(), Start::Mean, &plan, &mut ()).unwrap();
        assert_eq!((outcome.stop, outcome.backed_off.unwrap().iteration), (StopReason::ScheduleDone, 3));
        assert!(outcome.estimate.is_finite());
        assert_together(&outcome);
    }
    let plan = Plan::new([Stage { sigma: Some(0.1), iterations: 5 }]);
    let mut gap = Gap::plain(Demosaicked::new(Breaks, Malvar, CFA));
    let outcome = run(&mut gap, &small_problem(), Start::Mean, &plan, &mut ()).unwrap();
    assert_eq!((outcome.stop, outcome.iterations), (StopReason::Diverged, 4));
    assert_together(&outcome);
}

#[test]
fn no_iteration_makes_no_rgb_video() {
    let params = TwoStageParams { rho: 1.0, tau: 100.0, convention: Convention::PaperCode };
    let solvers: [Box<dyn Solver>; 2] = [
        Box::new(Gap::accelerated(Demosaicked::new(Scale(1.0), Malvar, CFA))),
        Box::new(TwoStage::new(Scale(1.0), Malvar, XStep::Demosaic, CFA, params)),
    ];
    for mut solver in solvers {
        let outcome = run(solver.as_mut(), &small_problem(), Start::Mean, &Plan::new([]), &mut ()).unwrap();
        assert_eq!((outcome.iterations, outcome.estimate.rgb), (0, None));
    }
}

#[test]
fn a_demosaicer_that_fails_is_named() {
    struct Fails;
    impl Demosaicer for Fails {
        fn name(&self) -> &str {
            "blind"
        }
        fn demosaic(
            &mut self,
            _: CfaPattern,
            _: ArrayView3<'_, f32>,
            _: ArrayViewMut4<'_, f32>,
        ) -> Result<(), BoxError> {
            Err("no light".into())
        }
    }
    let params = TwoStageParams { rho: 1.0, tau: 100.0, convention: Convention::Scaled };
    let solvers: [Box<dyn Solver>; 2] = [
        Box::new(Gap::accelerated(Demosaicked::new(Scale(1.0), Fails, CFA))),
        Box::new(TwoStage::new(Scale(1.0), Fails, XStep::Demosaic, CFA, params)),
    ];
    let plan = Plan::new([Stage { sigma: Some(0.1), iterations: 2 }]);
    for mut solver in solvers {
        let error = run(solver.as_mut(), &small_problem(), Start::Mean, &plan, &mut ()).unwrap_err();
        assert_eq!(error.to_string(), "demosaicer blind failed in iteration 0");
    }
}

/// Whoever drives the steps himself, with any count of iterations, begins anew with [`Solver::start`].
#[test]
fn the_first_step_is_the_one_after_start() {
    let params = TwoStageParams { rho: 0.55, tau: 10.0, convention: Convention::PaperCode };
    let problem = small_problem();
    let mut solver = TwoStage::new(Scale(0.9), Bilinear, XStep::ClosedForm { clip: false }, CFA, params);
    let start = Estimate::at_sensor(uniform(SMALL.dim(), 6));
    let mut drive = |first: usize| {
        let (mut current, mut next) = (start.clone(), Estimate::at_sensor(Array3::zeros(SMALL.dim())));
        solver.start(&problem, &start);
        for iteration in first..first + 3 {
            let call = Call { iteration, ..Call::new(0.1) };
            solver.step(&problem, &call, &current, &mut next).unwrap();
            std::mem::swap(&mut current, &mut next);
        }
        current
    };
    assert_eq!(drive(0), drive(7));
}

#[test]
fn two_stages_give_the_same_bits_for_any_number_of_threads() {
    let solve = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let params = TwoStageParams { rho: 0.55, tau: 10.0, convention: Convention::Scaled };
            let mut solver = TwoStage::new(Scale(0.9), Menon, XStep::ClosedForm { clip: true }, CFA, params);
            let plan = Plan::new([Stage { sigma: Some(0.1), iterations: 6 }]);
            run(&mut solver, &small_problem(), Start::Mean, &plan, &mut ()).unwrap().estimate
        })
    };
    assert_eq!(solve(1), solve(3));
}
