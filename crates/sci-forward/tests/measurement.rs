//! The checked pair of an operator and what it measured.

use ndarray::{Array2, Array3, Array4, ArrayView4, s};
use sci_forward::bayer::mosaic_into;
use sci_forward::testing::{Sheared, gaussian, uniform};
use sci_forward::{CfaPattern, MaskOperator, MaskStack, Measurement, MeasurementError, SensingOperator, VideoShape};
use std::sync::Arc;

const SHAPE: VideoShape = VideoShape { frames: 3, height: 6, width: 8 };

fn operator() -> Arc<dyn SensingOperator> {
    let mut masks = uniform(SHAPE.dim(), 1);
    masks.slice_mut(s![.., 2, 3]).fill(0.0);
    masks.slice_mut(s![.., 2, 4]).fill(1e-16);
    Arc::new(MaskOperator::new(MaskStack::new(masks).unwrap()))
}

fn measurement(cfa: Option<CfaPattern>) -> Measurement {
    Measurement::new(operator(), uniform(SHAPE.image_dim(), 2)).unwrap().with_cfa(cfa)
}

#[test]
fn what_does_not_belong_together_is_named() {
    let error = Measurement::new(operator(), Array2::zeros((6, 7))).unwrap_err();
    assert_eq!(error, MeasurementError::Size { what: "measurement", expected: vec![6, 8], found: vec![6, 7] });
    assert_eq!(error.to_string(), "the measurement is [6, 7], the masks ask for [6, 8]");
    let mut y = Array2::zeros((6, 8));
    y[[4, 5]] = f32::NEG_INFINITY;
    let error = Measurement::new(operator(), y).unwrap_err();
    assert_eq!(error.to_string(), "the measurement is -inf at index [4, 5]: every value must be finite");

    let color = measurement(Some(CfaPattern::Rggb));
    let error = color.residual(Array4::zeros((3, 1, 6, 8)).view()).unwrap_err();
    assert_eq!(error.to_string(), "the video is [3, 1, 6, 8], the masks ask for [3, 3, 6, 8]");
    let error = color.restricted(Array2::from_elem((8, 6), true).view()).unwrap_err();
    assert_eq!(error.to_string(), "the map of measured pixels is [8, 6], the masks ask for [6, 8]");
}

#[test]
fn a_measurement_of_closed_pixels_alone_is_refused() {
    // Two pixels that no mask opens, one of them but for rounding errors.
    let mut measured = Array2::from_elem((6, 8), false);
    measured[[2, 3]] = true;
    measured[[2, 4]] = true;
    assert_eq!(measurement(None).restricted(measured.view()).unwrap_err(), MeasurementError::AllClosed);
    measured[[2, 5]] = true;
    assert!(measurement(None).restricted(measured.view()).is_ok());
}

#[test]
fn the_scale_is_that_of_the_open_pixels() {
    let mut y = Array2::zeros((6, 8));
    assert_eq!(Measurement::new(operator(), y.clone()).unwrap().scale(), (46f64).sqrt());
    y[[2, 3]] = 100.0;
    y[[2, 4]] = 100.0;
    assert_eq!(Measurement::new(operator(), y.clone()).unwrap().scale(), (46f64).sqrt());
    y[[0, 0]] = 3.0;
    y[[5, 7]] = 4.0;
    let whole = Measurement::new(operator(), y).unwrap();
    assert_eq!(whole.scale(), 5.0);
    let mut measured = Array2::from_elem((6, 8), true);
    measured[[5, 7]] = false;
    assert_eq!(whole.restricted(measured.view()).unwrap().scale(), 3.0);
}

/// `H T v − y` by its definition.
fn residual(m: &Measurement, video: ArrayView4<'_, f32>) -> Array2<f32> {
    let mosaic = match m.cfa() {
        None => video.slice(s![.., 0, .., ..]).to_owned(),
        Some(cfa) => {
            let mut mosaic = Array3::zeros(SHAPE.dim());
            mosaic_into(cfa, video, mosaic.view_mut());
            mosaic
        }
    };
    let mut r = m.operator().forward(mosaic.view()) - m.y();
    r.zip_mut_with(&m.operator().gram(), |r, &gram| *r *= f32::from(u8::from(gram > 0.0)));
    r
}

#[test]
fn the_residual_is_that_of_the_open_pixels() {
    for cfa in [None, Some(CfaPattern::Grbg)] {
        let m = measurement(cfa);
        let video = uniform((3, m.channels(), 6, 8), 5);
        let r = m.residual(video.view()).unwrap();
        assert_eq!(r, residual(&m, video.view()));
        assert_eq!((r[[2, 3]], r[[2, 4]]), (0.0, 0.0));
        assert!(r[[2, 5]] != 0.0);

        let measured = uniform((6, 8), 3).mapv(|v| v < 0.5);
        let part = m.restricted(measured.view()).unwrap().residual(video.view()).unwrap();
        assert_eq!(part, ndarray::Zip::from(&r).and(&measured).map_collect(|&r, &keep| if keep { r } else { 0.0 }));
    }
}

/// `⟨H T v, g⟩ = ⟨v, Tᵀ Hᵀ g⟩`, H v being the residual of a black measurement.
#[test]
fn the_pull_back_is_the_adjoint_of_the_residual() {
    let sheared: Arc<dyn SensingOperator> = Arc::new(Sheared::new(MaskStack::random(SHAPE, 0.5, 1).unwrap()));
    for operator in [operator(), sheared] {
        for cfa in [None, Some(CfaPattern::Gbrg)] {
            let black = Measurement::new(operator.clone(), Array2::zeros((6, 8))).unwrap().with_cfa(cfa);
            let (v, g) = (uniform((3, black.channels(), 6, 8), 7), gaussian((6, 8), 8));
            let left = (black.residual(v.view()).unwrap() * &g).sum();
            let right = (black.pull_back(g.view()) * &v).sum();
            assert!((left - right).abs() < 1e-4 * left.abs().max(1.0), "{cfa:?}: {left} is not {right}");
        }
    }
}

#[test]
fn an_image_in_another_order_is_put_in_order() {
    let y = uniform((6, 8), 2);
    let turned = y.t().as_standard_layout().into_owned().reversed_axes();
    assert!(!turned.is_standard_layout());
    let m = Measurement::new(operator(), turned).unwrap();
    assert!(m.y().is_standard_layout());
    assert_eq!(m.y(), y);
}

#[test]
fn a_measurement_can_go_to_another_thread() {
    let m = measurement(None);
    let there = m.clone();
    let scale = std::thread::spawn(move || there.scale()).join().unwrap();
    assert_eq!(scale, m.scale());
}
