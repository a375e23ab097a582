//! Every kind of masks and operator against its definition.

use ndarray::{Array2, Array3, ArrayView2, ArrayView3, s};
use proptest::prelude::*;
use sci_forward::testing::{Sheared, adjoint_gap, check_source, gaussian, mask_families, uniform};
use sci_forward::{
    BinaryMasks, Gained, MaskError, MaskMismatch, MaskOperator, MaskSource, MaskStack, Restricted, SensingOperator,
    ShiftingMasks, VideoShape,
};
use std::sync::Arc;

/// Widths around the chunks that rows are worked on in, among others.
fn shapes() -> impl Strategy<Value = VideoShape> {
    (1usize..9, 1usize..40, prop_oneof![1usize..140, 1020usize..1030]).prop_map(|(frames, height, width)| VideoShape {
        frames,
        height,
        width,
    })
}

/// A pattern that moves through all of `shape`, and where it is in each frame.
fn moving_pattern(shape: VideoShape, step: [f64; 2], seed: u64) -> (Array2<f32>, Vec<[f64; 2]>) {
    let last = step.map(|step| (step * (shape.frames - 1) as f64).abs().ceil() as usize);
    let mut pattern = uniform((shape.height + last[0], shape.width + last[1]), seed);
    pattern[[0, 0]] = 0.5;
    (pattern, (0..shape.frames).map(|t| step.map(|step| step * t as f64)).collect())
}

fn sources(shape: VideoShape, seed: u64) -> Vec<Box<dyn MaskSource>> {
    let mut sources: Vec<Box<dyn MaskSource>> = vec![];
    let binary = MaskStack::new(mask_families(shape, seed)[0].view().mapv(|v| 0.75 * v)).unwrap();
    sources.push(Box::new(BinaryMasks::new(&binary).unwrap()));
    for step in [[0.0, 1.0], [2.0, -1.0], [-0.3, 0.0], [0.0, 0.7], [1.25, -0.5]] {
        let (pattern, offsets) = moving_pattern(shape, step, seed);
        sources.push(Box::new(ShiftingMasks::new(pattern, &offsets).unwrap()));
    }
    for masks in mask_families(shape, seed) {
        let gain = (0..shape.frames).map(|t| 0.5 + t as f32).collect();
        sources.push(Box::new(Gained::new(masks.clone(), gain).unwrap()));
        sources.push(Box::new(masks));
    }
    sources
}

/// `H` by its definition.
fn forward(masks: ArrayView3<'_, f32>, x: ArrayView3<'_, f32>) -> Array2<f32> {
    let (_, height, width) = x.dim();
    Array2::from_shape_fn((height, width), |(i, j)| {
        masks.slice(s![.., i, j]).iter().zip(x.slice(s![.., i, j])).fold(0.0, |sum, (c, x)| sum + c * x)
    })
}

fn adjoint(masks: ArrayView3<'_, f32>, y: ArrayView2<'_, f32>) -> Array3<f32> {
    Array3::from_shape_fn(masks.dim(), |(t, i, j)| masks[[t, i, j]] * y[[i, j]])
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    #[test]
    fn every_source_gives_the_operator_of_its_masks(shape in shapes(), seed in any::<u64>()) {
        for source in sources(shape, seed) {
            check_source(&*source);
            let masks = MaskStack::from_source(&*source).unwrap();
            prop_assert_eq!(masks.shape(), shape);
            let h = MaskOperator::new(source);
            let (x, y) = (uniform(shape.dim(), seed), gaussian(shape.image_dim(), seed + 1));
            let mut out = Array2::from_elem(shape.image_dim(), f32::NAN);
            h.forward_into(x.view(), out.view_mut());
            prop_assert_eq!(&out, &forward(masks.view(), x.view()));
            prop_assert_eq!(h.gram(), forward(masks.view(), masks.view()));
            let mut out = Array3::from_elem(shape.dim(), f32::NAN);
            h.adjoint_into(y.view(), out.view_mut());
            prop_assert_eq!(&out, &adjoint(masks.view(), y.view()));
            let gap = adjoint_gap(&h, seed);
            prop_assert!(gap <= 1e-6, "{}", gap);
        }
    }

    #[test]
    fn a_restricted_operator_is_that_of_masks_closed_there(shape in shapes(), seed in any::<u64>()) {
        let measured = uniform(shape.image_dim(), seed).mapv(|v| v < 0.6);
        for masks in mask_families(shape, seed) {
            let mut closed = masks.view().to_owned();
            closed.outer_iter_mut().for_each(|mut c| c.zip_mut_with(&measured, |c, &keep| *c *= f32::from(u8::from(keep))));
            let h = Restricted::new(Arc::new(MaskOperator::new(masks)), measured.view());
            let (x, y) = (uniform(shape.dim(), seed), gaussian(shape.image_dim(), seed + 1));
            prop_assert_eq!(h.gram(), forward(closed.view(), closed.view()));
            prop_assert_eq!(h.forward(x.view()), forward(closed.view(), x.view()));
            prop_assert_eq!(h.adjoint(y.view()), adjoint(closed.view(), y.view()));
        }
    }
}

#[test]
fn packed_masks_are_the_masks() {
    // Less than a word, a whole word, and more.
    for width in [1, 31, 63, 64, 65, 130] {
        let shape = VideoShape { frames: 3, height: 2, width };
        let masks = MaskStack::new(mask_families(shape, 4)[0].view().mapv(|v| 3.0 * v)).unwrap();
        assert_eq!(MaskStack::from_source(&BinaryMasks::new(&masks).unwrap()).unwrap(), masks, "{width}");
    }
    let below = MaskStack::new(ndarray::array![[[0.0, -2.0, -2.0]]]).unwrap();
    assert_eq!(MaskStack::from_source(&BinaryMasks::new(&below).unwrap()).unwrap(), below);
    let both = MaskStack::new(ndarray::array![[[1.0, -1.0]]]).unwrap();
    assert_eq!(BinaryMasks::new(&both), Err(MaskError::NotBinary { value: -1.0, open: 1.0 }));
    let masks = MaskStack::new(ndarray::array![[[0.0, 0.5, 0.25]]]).unwrap();
    assert_eq!(BinaryMasks::new(&masks), Err(MaskError::NotBinary { value: 0.25, open: 0.5 }));
}

#[test]
fn a_moving_pattern_is_interpolated_where_it_is() {
    let shape = VideoShape { frames: 5, height: 7, width: 9 };
    for step in [[0.0, 1.0], [1.0, 0.0], [-2.0, 1.0], [0.5, 0.0], [0.0, -0.25], [0.3, -0.7]] {
        let (pattern, offsets) = moving_pattern(shape, step, 3);
        let masks = MaskStack::from_source(&ShiftingMasks::new(pattern.clone(), &offsets).unwrap()).unwrap();
        assert_eq!(masks.shape(), shape);
        for ((t, i, j), &value) in masks.view().indexed_iter() {
            // Against the step it starts from the far end.
            let place = |at: usize, step: f64| {
                at as f64 + step * if step < 0.0 { t as f64 - (shape.frames - 1) as f64 } else { t as f64 }
            };
            let (y, x) = (place(i, step[0]), place(j, step[1]));
            let weight = |at: f64, k: usize| (1.0 - (at - k as f64).abs()).max(0.0);
            let expected: f64 =
                pattern.indexed_iter().map(|((r, c), &v)| weight(y, r) * weight(x, c) * f64::from(v)).sum();
            assert!((f64::from(value) - expected).abs() < 1e-6, "{step:?} at {t}, {i}, {j}: {value} is not {expected}");
        }
    }
}

#[test]
fn a_bad_movement_is_named() {
    let check = |offsets: &[[f64; 2]], part: &str| {
        let message = ShiftingMasks::new(Array2::ones((3, 4)), offsets).unwrap_err().to_string();
        assert!(message.contains(part), "{message}");
    };
    check(&[], "0×3×4");
    check(&[[0.0, 0.0], [0.0, f64::NAN]], "NaN");
    check(&[[0.0, 0.0], [0.0, -4.0]], "a pattern of 3×4 pixels cannot move by [0.0, 4.0] pixels");
    check(&[[0.0, 0.0], [1e300, 0.0]], "3×4");
    let shape = VideoShape { frames: 2, height: 3, width: 4 };
    assert!(matches!(ShiftingMasks::random(shape, 0.5, 0, [1e9, 0.0]), Err(MaskError::Offset { .. })));
    assert!(matches!(ShiftingMasks::random(shape, 0.5, 0, [f64::NAN, 0.0]), Err(MaskError::Offset { .. })));
    assert_eq!(ShiftingMasks::random(shape, 0.0, 0, [1.0, 0.0]), Err(MaskError::Density(0.0)));
    let mut pattern = Array2::ones((3, 4));
    pattern[[2, 3]] = -1e10;
    let error = ShiftingMasks::new(pattern, &[[0.0, 0.0], [0.5, 0.0]]).unwrap_err();
    assert!(error.to_string().contains("-10000000000 at frame 0, row 2, column 3"), "{error}");
}

#[test]
fn masks_of_both_signs_move_and_fade_with_their_signs() {
    let masks = MaskStack::new(ndarray::array![[[-1.0, 1.0, 1.0, -1.0]]]).unwrap();
    let seen = MaskMismatch { shift: [0.0, 0.5], contrast: 0.5, ..MaskMismatch::default() }.apply(&masks).unwrap();
    // Moved: -1, 0, 1, 0, with the mean 0.
    assert_eq!(seen.view(), ndarray::array![[[-0.5, 0.0, 0.5, 0.0]]]);
}

#[test]
fn a_bad_gain_is_named() {
    let ones = || MaskStack::new(Array3::ones((2, 1, 1))).unwrap();
    let message = |gain: Vec<f32>| Gained::new(ones(), gain).unwrap_err().to_string();
    assert_eq!(message(vec![1.0]), "1 gains for 2 frames: each frame has one");
    assert!(message(vec![1.0, f32::NAN]).contains("NaN at frame 1"));
    assert!(message(vec![1.0, 1e10]).contains("10000000000 at frame 1"));
    assert!(message(vec![0.0, 0.0]).contains("nothing reaches the sensor"));
}

/// What too little light reaches to divide by it is closed for everyone, by the one test `gram > 0`.
#[test]
fn a_pixel_that_is_open_by_rounding_errors_is_closed() {
    let mut masks = Array3::ones((8, 8, 8));
    masks.slice_mut(s![.., 3, 3]).fill(1e-16);
    masks.slice_mut(s![.., 5, 2]).fill(0.0);
    let h = MaskOperator::new(MaskStack::new(masks).unwrap());
    assert_eq!((h.gram()[[3, 3]], h.gram()[[5, 2]], h.gram()[[3, 4]]), (0.0, 0.0, 8.0));
    let h = Restricted::new(Arc::new(h), Array2::from_elem((8, 8), true).view());
    assert_eq!(h.forward(Array3::ones((8, 8, 8)).view())[[3, 3]], 0.0);
    assert_eq!(h.adjoint(Array2::ones((8, 8)).view()).slice(s![.., 3, 3]), ndarray::Array1::<f32>::zeros(8));
}

#[test]
fn an_operator_that_is_no_mask_is_one_too() {
    let h = Sheared::new(MaskStack::random(VideoShape { frames: 4, height: 9, width: 11 }, 0.5, 1).unwrap());
    assert!(h.masks().is_none());
    assert!(adjoint_gap(&h, 3) < 1e-6);
    // The diagonal of H Hᵀ, seen pixel by pixel: nothing leaks into the others.
    for place in [(0, 0), (4, 5), (8, 10)] {
        let mut y = Array2::zeros((9, 11));
        y[place] = 1.0;
        let mut expected = Array2::zeros((9, 11));
        expected[place] = h.gram()[place];
        assert_eq!(h.forward(h.adjoint(y.view()).view()), expected);
    }
    let gram = h.gram().to_owned();
    let restricted = Restricted::new(Arc::new(h), gram.mapv(|g| g > 1.0).view());
    assert!(restricted.masks().is_none());
    assert!(adjoint_gap(&restricted, 4) < 1e-6);
    assert_eq!(restricted.gram(), gram.mapv(|g| if g > 1.0 { g } else { 0.0 }));
}

#[test]
fn views_that_are_not_contiguous_give_the_same_bits() {
    let shape = VideoShape { frames: 3, height: 20, width: 33 };
    let h = MaskOperator::new(MaskStack::random(shape, 0.5, 0).unwrap());
    let wide = uniform((3, 40, 66), 1);
    let strided = wide.slice(s![.., ..;2, 1..;2]);
    let y = h.forward(strided.to_owned().view());
    let mut out = Array2::from_elem((40, 66), f32::NAN);
    h.forward_into(strided, out.slice_mut(s![1..;2, ..;2]));
    assert_eq!(out.slice(s![1..;2, ..;2]), y);
    let mut back = Array3::from_elem(wide.dim(), f32::NAN);
    h.adjoint_into(out.slice(s![1..;2, ..;2]), back.slice_mut(s![.., ..;2, 1..;2]));
    assert_eq!(back.slice(s![.., ..;2, 1..;2]), h.adjoint(y.view()));
    // Masks in another order are put in order.
    let masks = h.source().view();
    let turned =
        MaskStack::new(masks.permuted_axes([2, 1, 0]).as_standard_layout().into_owned().permuted_axes([2, 1, 0]));
    assert_eq!(&turned.unwrap(), h.source());
}

#[test]
fn the_thread_count_does_not_change_a_bit() {
    let shape = VideoShape { frames: 5, height: 97, width: 61 };
    let (x, y) = (uniform(shape.dim(), 1), gaussian(shape.image_dim(), 2));
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let h = MaskOperator::new(mask_families(shape, 0)[1].clone());
            (h.gram().to_owned(), h.forward(x.view()), h.adjoint(y.view()))
        })
    };
    assert_eq!(run(1), run(2));
    assert_eq!(run(1), run(3));
}

#[test]
#[should_panic(expected = "the video must have the masks' size")]
fn a_video_of_another_size_is_a_mistake_of_the_caller() {
    let shape = VideoShape { frames: 2, height: 3, width: 4 };
    MaskOperator::new(MaskStack::random(shape, 0.5, 0).unwrap()).forward(Array3::zeros((2, 3, 5)).view());
}
