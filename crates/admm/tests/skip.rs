//! Held-out pixels and tiles in whole runs.

use admm::{
    BoxError, Call, Denoiser, Gap, HoldOut, IterInfo, Observer, Plan, Stage, Start, StopReason, TileCounts, Tiles, Tv,
    run, still,
};
use ndarray::{Array3, Array4, ArrayView4, ArrayViewMut4, Axis, s};
use sci_forward::testing::{gaussian, moving_square};
use sci_forward::{MaskOperator, MaskStack, Measurement, SensingOperator, VideoShape};
use std::ops::ControlFlow;
use std::sync::Arc;

const SHAPE: VideoShape = VideoShape { frames: 8, height: 96, width: 128 };

fn measurement_of(truth: &Array3<f32>) -> Measurement {
    let (frames, height, width) = truth.dim();
    let shape = VideoShape { frames, height, width };
    let h = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.5, 4).unwrap()));
    Measurement::new(h.clone(), h.forward(truth.view())).unwrap()
}

fn error(a: &Array3<f32>, b: &Array3<f32>) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>() / a.len() as f64
}

/// A blur over 5 × 5 pixels, frame by frame: local, and the same everywhere.
struct Blur;

impl Denoiser for Blur {
    fn name(&self) -> &str {
        "blur"
    }
    fn denoise(
        &mut self,
        _: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        let (_, _, h, w) = noisy.dim();
        for ((t, c, i, j), out) in out.indexed_iter_mut() {
            let window =
                noisy.slice(s![t, c, i.saturating_sub(2)..(i + 3).min(h), j.saturating_sub(2)..(j + 3).min(w)]);
            *out = window.sum() / window.len() as f32;
        }
        Ok(())
    }
}

#[test]
fn a_judge_that_does_not_decide_only_tells() {
    struct Told(Vec<Option<f64>>);
    impl Observer for Told {
        fn iteration(&mut self, it: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
            self.0.push(it.predicted_error);
            Ok(ControlFlow::Continue(()))
        }
    }
    let truth = moving_square(SHAPE);
    let measurement = measurement_of(&truth);
    let watching = HoldOut { decides: false, ..HoldOut::default() };
    // A σ that a judge who decides would pass over, and more iterations than it would allow.
    let stages = [Stage { sigma: Some(9.0), iterations: 1 }, Stage { sigma: None, iterations: 60 }];
    let solve = |measurement: &Measurement, hold_out| {
        let plan = Plan { hold_out, ..Plan::new(stages) };
        let mut told = Told(Vec::new());
        let mut solver = Gap::accelerated(Tv::new(0.3));
        (run(&mut solver, measurement, Start::Mean, &plan, &mut told).unwrap(), told.0)
    };
    let (judged, told) = solve(&measurement, Some(watching));
    let (plain, untold) = solve(&watching.given(&measurement), None);
    assert_eq!(judged.estimate, plain.estimate);
    assert_eq!((judged.iterations, judged.stop), (61, StopReason::ScheduleDone));
    assert!(untold.iter().all(Option::is_none));
    let predicted = told.last().copied().flatten().unwrap();
    let ratio = predicted / error(&judged.estimate.sensor, &truth);
    // The errors of a moving edge in frames that follow each other cancel in their sum.
    assert!((0.2..1.5).contains(&ratio), "{ratio}");
}

#[test]
fn a_run_ends_by_itself_close_to_the_best_iterate() {
    let truth = moving_square(SHAPE);
    let problem = measurement_of(&truth);
    let mut plan = Plan::new([Stage { sigma: None, iterations: 300 }]);
    // The least error of any iterate.
    struct Best<'t>(f64, &'t Array3<f32>);
    impl Observer for Best<'_> {
        fn iteration(&mut self, it: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
            self.0 = self.0.min(error(&it.estimate.sensor, self.1));
            Ok(ControlFlow::Continue(()))
        }
    }
    let mut best = Best(f64::INFINITY, &truth);
    let whole = run(&mut Gap::accelerated(Tv::new(0.1)), &problem, Start::Mean, &plan, &mut ()).unwrap();
    plan.hold_out = Some(HoldOut::default());
    let cut = run(&mut Gap::accelerated(Tv::new(0.1)), &problem, Start::Mean, &plan, &mut best).unwrap();
    assert_eq!((whole.iterations, cut.stop), (300, StopReason::ScheduleDone));
    assert!(cut.iterations < 60, "{}", cut.iterations);
    let (chosen, last) = (error(&cut.estimate.sensor, &truth), error(&whole.estimate.sensor, &truth));
    assert!(
        chosen < 1.02 * best.0 && chosen < 1.7 * last,
        "{chosen}: the best iterate has {}, the 300th {last}",
        best.0
    );
}

#[test]
fn a_judged_run_is_the_same_for_any_number_of_threads() {
    let problem = measurement_of(&moving_square(SHAPE));
    let mut plan = Plan::new([Stage { sigma: None, iterations: 30 }, Stage { sigma: Some(0.1), iterations: 10 }]);
    plan.hold_out = Some(HoldOut::default());
    let solve = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let tiles = Tiles::new(Blur, &still(&problem));
            let o = run(&mut Gap::accelerated(tiles).restarting(), &problem, Start::Mean, &plan, &mut ()).unwrap();
            (o.iterations, o.estimate.sensor)
        })
    };
    assert_eq!(solve(1), solve(3));
}

#[test]
fn too_small_a_sensor_is_not_held_out_from() {
    let shape = VideoShape { frames: 2, height: 5, width: 5 };
    let problem = measurement_of(&moving_square(shape));
    let mut plan = Plan::new([Stage { sigma: None, iterations: 7 }]);
    let whole = run(&mut Gap::plain(Tv::new(0.1)), &problem, Start::Mean, &plan, &mut ()).unwrap();
    plan.hold_out = Some(HoldOut::default());
    let judged = run(&mut Gap::plain(Tv::new(0.1)), &problem, Start::Mean, &plan, &mut ()).unwrap();
    assert_eq!((whole.iterations, whole.estimate), (judged.iterations, judged.estimate));
}

/// What `calls` of `Tiles` around a blur give and leave out, and the blur alone.
fn tiled(still: &[bool], inputs: &[Array4<f32>]) -> (Vec<Array4<f32>>, Vec<Array4<f32>>, TileCounts) {
    let mut tiles = Tiles::new(Blur, still);
    let call = |d: &mut dyn Denoiser, x: &Array4<f32>| {
        let mut out = Array4::from_elem(x.dim(), f32::NAN);
        d.denoise(&Call::new(0.1), x.view(), out.view_mut()).unwrap();
        out
    };
    let a = inputs.iter().map(|x| call(&mut tiles, x)).collect();
    let b = inputs.iter().map(|x| call(&mut Blur, x)).collect();
    (a, b, tiles.counter().counts())
}

fn noise(seed: u64) -> Array4<f32> {
    gaussian(SHAPE.dim(), seed).mapv(|v| 0.5 + 0.1 * v).insert_axis(Axis(1))
}

#[test]
fn still_tiles_are_denoised_once_for_all_frames_and_the_others_show_no_seams() {
    // Of 3 × 4 tiles the first two columns stand still.
    let still: Vec<bool> = (0..12).map(|tile| tile % 4 < 2).collect();
    let x = noise(1);
    let (tiled, whole, counts) = tiled(&still, std::slice::from_ref(&x));
    let (tiled, whole) = (&tiled[0], &whole[0]);
    let moving = s![.., .., .., 64..];
    let gap = (&tiled.slice(moving) - &whole.slice(moving)).iter().fold(0f32, |a, d| a.max(d.abs()));
    assert!(gap < 1e-6, "{gap}");
    let mean_of_blurs = whole.mean_axis(Axis(0)).unwrap();
    for frame in tiled.outer_iter() {
        let gap = &frame.slice(s![.., .., ..64]) - &mean_of_blurs.slice(s![.., .., ..64]);
        assert!(gap.iter().all(|d| d.abs() < 1e-5));
    }
    // One frame of all, and 8 of the right half with its halo.
    assert_eq!((counts.asked, counts.done), (8 * 96 * 128, 96 * 128 + 8 * 96 * (64 + 16)));
}

#[test]
fn a_tile_wakes_when_no_still_picture_explains_it_any_more() {
    let quiet = noise(1).mapv(|v| 0.5 + 0.05 * (v - 0.5));
    // As much as wakes a settled tile.
    let brighter = quiet.mapv(|v| v + 0.01);
    let mut loud = quiet.clone();
    loud.slice_mut(s![3.., .., 32..64, 32..64]).mapv_inplace(|v| v + 0.3);
    let (tiled, whole, _) = tiled(&[true; 12], &[quiet, brighter, loud]);
    let difference = |k: usize, rows: std::ops::Range<usize>| {
        let (a, b) = (&tiled[k], &whole[k]);
        let tile = s![.., .., rows, 32..64];
        (&a.slice(tile) - &b.slice(tile)).iter().fold(0f32, |a, d| a.max(d.abs()))
    };
    assert!(difference(1, 32..64) > 1e-4, "asleep: one frame for all");
    assert!(difference(2, 32..64) < 1e-6, "awake: {}", difference(2, 32..64));
    assert!(difference(2, 64..96) > 1e-4, "its neighbour sleeps on");
}

#[test]
fn a_settled_tile_keeps_its_output_until_its_input_moves() {
    let x = noise(1);
    let mut nearly = x.mapv(|v| v + 0.004);
    nearly.slice_mut(s![.., .., ..32, ..32]).mapv_inplace(|v| v + 0.01);
    let (tiled, whole, counts) = tiled(&[false; 12], &[x, nearly]);
    let other = s![.., .., 40.., 40..];
    assert_eq!(tiled[1].slice(other), tiled[0].slice(other));
    let woken = s![.., .., ..32, ..32];
    assert!((&tiled[1].slice(woken) - &whole[1].slice(woken)).iter().all(|d| d.abs() < 1e-6));
    assert_eq!(counts.done, 8 * 96 * 128 + 8 * 48 * 48);
}

#[test]
fn a_still_scene_costs_one_frame() {
    let truth = Array3::from_shape_fn(SHAPE.dim(), |(_, i, j)| {
        let (i, j) = (i as f32, j as f32);
        0.5 + 0.15 * (0.9 * i + 0.4 * j).sin() * (0.31 * j).cos() + 0.1 * (i * j / 100.0).sin()
    });
    let problem = measurement_of(&truth);
    let still = still(&problem);
    assert_eq!(still, [true; 12]);
    let tiles = Tiles::new(Blur, &still);
    let counter = tiles.counter();
    let plan = Plan::new([Stage { sigma: Some(0.1), iterations: 6 }]);
    run(&mut Gap::plain(tiles), &problem, Start::Mean, &plan, &mut ()).unwrap();
    let skipped = counter.counts().skipped();
    assert!((7.0 / 8.0..1.0).contains(&skipped), "{skipped}");
}

#[test]
fn tiles_of_another_grid_are_refused() {
    let x = noise(1);
    let error = Tiles::new(Blur, &[true; 5]).denoise(&Call::new(0.1), x.view(), x.clone().view_mut()).unwrap_err();
    assert_eq!(error.to_string(), "5 tiles are known, the video has 12");
}
