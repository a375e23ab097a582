//! Masks that sit elsewhere than they were told to, found from measurements alone.

use admm::sci_forward::testing::moving_square;
use admm::sci_forward::{CfaPattern, MaskMismatch, MaskOperator, MaskStack, SensingOperator, VideoShape};
use admm::{CalibrateError, Calibrated, Calibration};
use ndarray::{Array2, Array3};
use std::ops::ControlFlow;

const SHAPE: VideoShape = VideoShape { frames: 4, height: 48, width: 48 };

/// Three scenes that have little in common.
fn scenes() -> [Array3<f32>; 3] {
    let waves = |(t, i, j): (usize, usize, usize)| {
        0.5 + 0.25 * (0.3 * i as f32 + 0.5 * t as f32).sin() + 0.2 * (0.23 * j as f32 - 0.2 * t as f32).cos()
    };
    let steps = |(t, i, j): (usize, usize, usize)| ((i / 12 + (j + t) / 16) % 3) as f32 / 3.0 + 0.1;
    [moving_square(SHAPE), Array3::from_shape_fn(SHAPE.dim(), waves), Array3::from_shape_fn(SHAPE.dim(), steps)]
}

fn told() -> MaskStack {
    MaskStack::random(SHAPE, 0.5, 3).unwrap()
}

fn measured(truth: &Array3<f32>, real: &MaskMismatch) -> Array2<f32> {
    MaskOperator::new(real.apply(&told()).unwrap()).forward(truth.view())
}

/// Nothing but a shift, in few solves.
fn shifts() -> Calibration {
    Calibration {
        reach: 1.0,
        rotation: false,
        scale: false,
        blur: false,
        contrast: false,
        black: false,
        ..Calibration::default()
    }
}

fn find(settings: &Calibration, y: Array2<f32>) -> Calibrated {
    settings.find(&told(), None, &[y], &mut |_| ControlFlow::Continue(())).unwrap()
}

#[test]
fn a_shift_of_any_sign_is_found_in_every_scene() {
    for (truth, shift) in scenes().iter().zip([[0.5, -0.3], [-0.4, 0.2], [0.25, 0.75]]) {
        let found = find(&shifts(), measured(truth, &MaskMismatch { shift, ..MaskMismatch::default() }));
        for axis in 0..2 {
            let off = (found.mismatch.shift[axis] - shift[axis]).abs();
            assert!(off < 0.05, "{shift:?}: {:?} after {} solves", found.mismatch.shift, found.solves);
        }
        assert!(found.error[1] < 0.5 * found.error[0], "{:?}", found.error);
        assert!(found.parameters.iter().all(|p| p.told_apart), "{:?}", found.parameters);
    }
}

/// The least error of a range may lie at its end because the masks sit beyond.
#[test]
fn what_may_lie_beyond_reach_is_said() {
    let near = Calibration { reach: 1.0, ..shifts() };
    for (right, beyond) in [(0.8, false), (1.0, true), (1.3, true)] {
        let shift = [0.0, right];
        let found = find(&near, measured(&scenes()[0], &MaskMismatch { shift, ..MaskMismatch::default() }));
        let [down, across] = [0, 1].map(|axis| found.parameters[axis].at_end);
        assert_eq!((down, across), (false, beyond), "{right}: {:?}", found.mismatch);
    }
}

#[test]
fn a_blur_is_told_from_a_shift() {
    let truth = &scenes()[1];
    let both = Calibration { blur: true, ..shifts() };
    for (shift, blur) in [([0.0, 0.0], 0.6), ([0.5, -0.3], 0.0), ([0.25, 0.0], 0.5)] {
        let found = find(&both, measured(truth, &MaskMismatch { shift, blur, ..MaskMismatch::default() }));
        assert!((found.mismatch.blur - blur).abs() < 0.1, "{shift:?}, {blur}: {:?}", found.mismatch);
        let off = (0..2).map(|axis| (found.mismatch.shift[axis] - shift[axis]).abs()).fold(0.0, f64::max);
        assert!(off < 0.06, "{shift:?}, {blur}: {:?}", found.mismatch);
    }
}

/// Of masks that are told, .5 down and .3 left, to that many pixels.
fn assert_shift_is_found(told: &MaskStack, bound: f64) {
    let real = MaskMismatch { shift: [0.5, -0.3], ..MaskMismatch::default() }.apply(told).unwrap();
    let y = MaskOperator::new(real).forward(scenes()[0].view());
    let found = shifts().find(told, None, &[y], &mut |_| ControlFlow::Continue(())).unwrap();
    let [down, right] = found.mismatch.shift;
    assert!((down - 0.5).abs() < bound && (right + 0.3).abs() < bound, "{found:?}");
}

/// Their sum does not tell how bright it is, so that pixels are held out.
#[test]
fn a_shift_of_masks_of_both_signs_is_found() {
    let told = told().differential().unwrap();
    assert_shift_is_found(&told, 0.1);
}

/// Each pixel is open in half of the frames and shut in the others: the sum is nothing.
#[test]
fn a_shift_of_balanced_masks_of_both_signs_is_found() {
    let random = told();
    let half = SHAPE.frames / 2;
    let each = |(t, i, j): (usize, usize, usize)| {
        let open = random.view()[[t % half, i, j]];
        if t < half { 2.0 * open - 1.0 } else { 1.0 - 2.0 * open }
    };
    let balanced = MaskStack::new(Array3::from_shape_fn(SHAPE.dim(), each)).unwrap();
    assert!(SHAPE.frames.is_multiple_of(2) && balanced.sum().iter().all(|&sum| sum == 0.0));
    assert_shift_is_found(&balanced, 0.1);
}

/// Of masks that open each pixel once the sum is the same everywhere: pixels are held out.
#[test]
fn a_shift_of_masks_with_an_even_sum_is_found() {
    let each = |(t, i, j): (usize, usize, usize)| f32::from((7 * i + 3 * j + i * j) % SHAPE.frames == t);
    let told = MaskStack::new(Array3::from_shape_fn(SHAPE.dim(), each)).unwrap();
    assert_shift_is_found(&told, 0.2);
}

/// Where no neighbours tell anything, and where few do.
#[test]
fn small_sensors_are_no_trouble() {
    for size in [9, 14, 20] {
        let shape = VideoShape { frames: 2, height: size, width: size + 1 };
        let masks = MaskStack::random(shape, 0.5, 1).unwrap();
        let y = MaskOperator::new(masks.clone()).forward(moving_square(shape).view());
        for cfa in [None, Some(CfaPattern::Rggb)] {
            let found =
                Calibration::default().find(&masks, cfa, std::slice::from_ref(&y), &mut |_| ControlFlow::Continue(()));
            let found = found.unwrap();
            assert!(found.error[1] <= found.error[0], "{size}, {cfa:?}: {found:?}");
        }
    }
}

#[test]
fn masks_that_are_right_stay_as_they_are() {
    for truth in scenes() {
        let found = find(&shifts(), measured(&truth, &MaskMismatch::default()));
        let kept = found.mismatch.shift.iter().zip(&found.parameters).all(|(s, p)| s.abs() <= 2.0 * p.uncertainty);
        assert!(kept, "{:?}", found.parameters);
        assert!(found.mismatch.shift.iter().all(|s| s.abs() < 0.05), "{:?}", found.mismatch.shift);
    }
}

#[test]
fn clock_and_black_level_are_found() {
    let truth = &scenes()[0];
    let y = measured(truth, &MaskMismatch { clock: 0.3, ..MaskMismatch::default() });
    let found = find(&Calibration { reach: 0.0, clock: true, ..shifts() }, y);
    assert!((found.mismatch.clock - 0.3).abs() < 0.06, "{found:?}");
    // What changes next to nothing is left as it was told.
    let y = measured(truth, &MaskMismatch { clock: 0.02, ..MaskMismatch::default() });
    assert_eq!(find(&Calibration { reach: 0.0, clock: true, ..shifts() }, y).mismatch.clock, 0.0);
    let y = measured(truth, &MaskMismatch::default()) + 0.1;
    let found = find(&Calibration { reach: 0.0, black: true, ..shifts() }, y);
    assert!((found.black - 0.1).abs() < 0.04, "{found:?}");
}

#[test]
fn what_is_out_of_range_is_refused_and_a_stop_is_heard() {
    let y = measured(&scenes()[0], &MaskMismatch::default());
    let wrong = Calibration { reach: -1.0, ..shifts() };
    let result = wrong.find(&told(), None, std::slice::from_ref(&y), &mut |_| ControlFlow::Continue(()));
    assert!(matches!(result, Err(CalibrateError::Setting { key: "reach", .. })));
    let none = shifts().find(&told(), None, &[], &mut |_| ControlFlow::Continue(()));
    assert!(matches!(none, Err(CalibrateError::Empty)));
    let mut solves = 0;
    let stopped = shifts().find(&told(), None, &[y], &mut |progress| {
        solves = progress.solves;
        if progress.solves == 3 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    assert!(matches!(stopped, Err(CalibrateError::Stopped)) && solves == 3);
}

/// What is clipped or dead says nothing of where the masks sit, or how much light a frame gets.
#[test]
fn clipped_and_dead_pixels_are_not_believed() {
    let truth = &scenes()[1];
    let clipped = |y: &Array2<f32>| {
        let mut all: Vec<f32> = y.iter().copied().collect();
        all.sort_by(f32::total_cmp);
        let level = all[all.len() * 8 / 10];
        (y.mapv(|y| y.min(level)), level)
    };
    for shift in [[0.0, 0.0], [0.5, -0.3]] {
        let (mut y, level) = clipped(&measured(truth, &MaskMismatch { shift, ..MaskMismatch::default() }));
        let left_out: Vec<(usize, usize)> = (0..20).map(|i| ((7 * i) % 48, (11 * i) % 48)).collect();
        left_out.iter().for_each(|&at| y[at] = 0.0);
        let found = find(&Calibration { clip: Some(level), left_out, ..shifts() }, y.clone());
        for (axis, shift) in shift.iter().enumerate() {
            assert!((found.mismatch.shift[axis] - shift).abs() < 0.06, "{shift:?}: {:?}", found.parameters);
        }
        assert_eq!(found.exposure, None);
        let all = find(&shifts(), y);
        assert!(found.error[1] < 0.5 * all.error[1], "{:?} {:?}", found.error, all.error);
    }
    let beyond = Calibration { left_out: vec![(3, 48)], ..shifts() };
    let result =
        beyond.find(&told(), None, &[measured(truth, &MaskMismatch::default())], &mut |_| ControlFlow::Continue(()));
    assert!(matches!(result, Err(CalibrateError::LeftOut { column: 48, .. })));
}
