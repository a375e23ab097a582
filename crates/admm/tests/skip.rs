//! Held-out pixels and tiles in whole runs.

use admm::{
    BoxError, DenoiseCx, Denoiser, Gap, HoldOut, Plan, Problem, Stage, Start, StopReason, TileConfig, TileCounts,
    Tiles, Tv, run, still,
};
use ndarray::{Array3, Array4, ArrayView4, ArrayViewMut4, Axis, s};
use sci_forward::testing::{gaussian, moving_square};
use sci_forward::{MaskOperator, MaskStack, SensingOperator, VideoShape};
use std::cell::Cell;
use std::rc::Rc;

const SHAPE: VideoShape = VideoShape { frames: 8, height: 96, width: 128 };

fn operator() -> MaskOperator {
    MaskOperator::new(MaskStack::random(SHAPE, 0.5, 4).unwrap())
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
        _: &DenoiseCx,
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
fn a_run_ends_by_itself_close_to_the_best_iterate() {
    let h = operator();
    let truth = moving_square(SHAPE);
    let y = h.forward(truth.view());
    let problem = Problem::new(&h, y.view()).unwrap();
    let mut plan = Plan::new([Stage { sigma: 0.0, iterations: 300 }]);
    let whole = run(&mut Gap::accelerated(Tv::new(0.1)), &problem, Start::Mean, &plan, &mut ()).unwrap();
    plan.hold_out = Some(HoldOut::default());
    let cut = run(&mut Gap::accelerated(Tv::new(0.1)), &problem, Start::Mean, &plan, &mut ()).unwrap();
    assert_eq!((whole.iterations, cut.stop), (300, StopReason::ScheduleDone));
    assert!(cut.iterations < 60, "{}", cut.iterations);
    assert!(error(&cut.estimate, &truth) < 2.0 * error(&whole.estimate, &truth));
}

#[test]
fn a_judged_run_is_the_same_for_any_number_of_threads() {
    let h = operator();
    let y = h.forward(moving_square(SHAPE).view());
    let mut plan = Plan::new([Stage { sigma: 0.0, iterations: 30 }, Stage { sigma: 0.1, iterations: 10 }]);
    plan.hold_out = Some(HoldOut::default());
    let solve = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let problem = Problem::new(&h, y.view()).unwrap();
            let still = still(&problem, 32);
            let tiles = Tiles::new(Blur, TileConfig::default(), &still, Rc::default());
            let o = run(&mut Gap::accelerated(tiles).restarting(), &problem, Start::Mean, &plan, &mut ()).unwrap();
            (o.iterations, o.estimate)
        })
    };
    assert_eq!(solve(1), solve(3));
}

#[test]
fn too_small_a_sensor_is_not_held_out_from() {
    let shape = VideoShape { frames: 2, height: 5, width: 5 };
    let h = MaskOperator::new(MaskStack::random(shape, 0.5, 4).unwrap());
    let y = h.forward(moving_square(shape).view());
    let problem = Problem::new(&h, y.view()).unwrap();
    let mut plan = Plan::new([Stage { sigma: 0.0, iterations: 7 }]);
    let whole = run(&mut Gap::plain(Tv::new(0.1)), &problem, Start::Mean, &plan, &mut ()).unwrap();
    plan.hold_out = Some(HoldOut::default());
    let judged = run(&mut Gap::plain(Tv::new(0.1)), &problem, Start::Mean, &plan, &mut ()).unwrap();
    assert_eq!((whole.iterations, whole.estimate), (judged.iterations, judged.estimate));
}

/// What `calls` of `Tiles` around a blur give and leave out, and the blur alone.
fn tiled(
    still: &[bool],
    inputs: &[Array4<f32>],
    config: TileConfig,
) -> (Vec<Array4<f32>>, Vec<Array4<f32>>, TileCounts) {
    let counts = Rc::new(Cell::new(TileCounts::default()));
    let mut tiles = Tiles::new(Blur, config, still, Rc::clone(&counts));
    let cx = DenoiseCx::new(0.1);
    let call = |d: &mut dyn Denoiser, x: &Array4<f32>| {
        let mut out = Array4::from_elem(x.dim(), f32::NAN);
        d.denoise(&cx, x.view(), out.view_mut()).unwrap();
        out
    };
    let a = inputs.iter().map(|x| call(&mut tiles, x)).collect();
    let b = inputs.iter().map(|x| call(&mut Blur, x)).collect();
    (a, b, counts.get())
}

fn noise(seed: u64) -> Array4<f32> {
    gaussian(SHAPE.dim(), seed).mapv(|v| 0.5 + 0.1 * v).insert_axis(Axis(1))
}

#[test]
fn still_tiles_are_denoised_once_for_all_frames_and_the_others_show_no_seams() {
    // Of 3 × 4 tiles the first two columns stand still.
    let still: Vec<bool> = (0..12).map(|tile| tile % 4 < 2).collect();
    let x = noise(1);
    let (tiled, whole, counts) = tiled(&still, std::slice::from_ref(&x), TileConfig::default());
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
    let mut loud = quiet.clone();
    loud.slice_mut(s![3.., .., 32..64, 32..64]).mapv_inplace(|v| v + 0.3);
    let config = TileConfig { settled: 0.0, ..TileConfig::default() };
    let (tiled, whole, _) = tiled(&[true; 12], &[quiet.clone(), quiet, loud], config);
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
    let (tiled, whole, counts) = tiled(&[false; 12], &[x, nearly], TileConfig::default());
    let other = s![.., .., 40.., 40..];
    assert_eq!(tiled[1].slice(other), tiled[0].slice(other));
    let woken = s![.., .., ..32, ..32];
    assert!((&tiled[1].slice(woken) - &whole[1].slice(woken)).iter().all(|d| d.abs() < 1e-6));
    assert_eq!(counts.done, 8 * 96 * 128 + 8 * 48 * 48);
}

#[test]
fn a_still_scene_costs_one_frame() {
    let h = operator();
    let truth = Array3::from_shape_fn(SHAPE.dim(), |(_, i, j)| {
        let (i, j) = (i as f32, j as f32);
        0.5 + 0.15 * (0.9 * i + 0.4 * j).sin() * (0.31 * j).cos() + 0.1 * (i * j / 100.0).sin()
    });
    let y = h.forward(truth.view());
    let problem = Problem::new(&h, y.view()).unwrap();
    let still = still(&problem, 32);
    assert_eq!(still, [true; 12]);
    let counts = Rc::new(Cell::new(TileCounts::default()));
    let tiles = Tiles::new(Blur, TileConfig { settled: 0.0, ..TileConfig::default() }, &still, Rc::clone(&counts));
    let plan = Plan::new([Stage { sigma: 0.1, iterations: 6 }]);
    run(&mut Gap::plain(tiles), &problem, Start::Mean, &plan, &mut ()).unwrap();
    assert!((counts.get().skipped() - 7.0 / 8.0).abs() < 1e-9, "{:?}", counts.get());
}
