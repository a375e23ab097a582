//! The fused data step against its definition, and sensing operators from outside.

use admm::*;
use ndarray::{
    Array2, Array3, Array4, ArrayView2, ArrayView3, ArrayView4, ArrayViewMut2, ArrayViewMut3, ArrayViewMut4, s,
};
use proptest::prelude::*;
use sci_forward::testing::{gaussian, mask_families, moving_square, uniform};
use sci_forward::{MaskOperator, MaskStack, Measurement, Noise, SensingOperator, VideoShape};
use std::sync::Arc;

/// Masks by the definition of H, with nothing told of masks: the data step takes its general path.
struct ByDefinition {
    masks: MaskStack,
    gram: Array2<f32>,
}

impl ByDefinition {
    fn new(masks: MaskStack) -> Self {
        let gram = MaskOperator::new(masks.clone()).gram().to_owned();
        Self { masks, gram }
    }
}

impl SensingOperator for ByDefinition {
    fn shape(&self) -> VideoShape {
        self.masks.shape()
    }
    fn forward_into(&self, x: ArrayView3<'_, f32>, mut y: ArrayViewMut2<'_, f32>) {
        y.fill(0.0);
        for ((t, i, j), x) in x.indexed_iter() {
            y[[i, j]] += self.masks.view()[[t, i, j]] * x;
        }
    }
    fn adjoint_into(&self, y: ArrayView2<'_, f32>, mut x: ArrayViewMut3<'_, f32>) {
        for ((t, i, j), x) in x.indexed_iter_mut() {
            *x = self.masks.view()[[t, i, j]] * y[[i, j]];
        }
    }
    fn gram(&self) -> ArrayView2<'_, f32> {
        self.gram.view()
    }
}

fn shapes() -> impl Strategy<Value = VideoShape> {
    (1usize..9, 1usize..40, prop_oneof![1usize..40, 1020usize..1030]).prop_map(|(frames, height, width)| VideoShape {
        frames,
        height,
        width,
    })
}

fn close(a: Progress, b: Progress) -> bool {
    [(a.residual, b.residual), (a.change, b.change), (a.norm, b.norm)].iter().all(|(a, b)| (a - b).abs() <= 1e-5 * b)
}

/// Both ways of one measurement, some of whose pixels may be left out.
fn both_ways(masks: MaskStack, y: &Array2<f32>, hole: bool) -> [Measurement; 2] {
    let operators: [Arc<dyn SensingOperator>; 2] =
        [Arc::new(MaskOperator::new(masks.clone())), Arc::new(ByDefinition::new(masks))];
    operators.map(|operator| {
        let whole = Measurement::new(operator, y.clone()).unwrap();
        let mut measured = Array2::from_elem(y.dim(), true);
        if hole && y.len() > 1 {
            measured[[y.nrows() - 1, y.ncols() - 1]] = false;
        }
        whole.restricted(measured.view()).unwrap()
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, ..ProptestConfig::default() })]

    #[test]
    fn the_fused_step_equals_the_definition(
        shape in shapes(), seed in any::<u64>(), damping in prop_oneof![Just(0f32), 0.01f32..2.0], hole in any::<bool>(),
        (noisy, precision) in (any::<bool>(), 0f32..100.0),
        clip in prop_oneof![Just(None), (0.5f32..2.0).prop_map(Some)]
    ) {
        let noise = noisy.then(|| Noise::new(Some(50.0), 0.1).unwrap());
        for masks in mask_families(shape, seed) {
            let (x, y) = (uniform(shape.dim(), seed), gaussian(shape.image_dim(), seed + 1));
            let (previous, z) = (uniform(shape.dim(), seed + 2), uniform(shape.dim(), seed + 3));
            let ways = both_ways(masks, &y, hole).map(|measurement| measurement.with_noise(noise).with_clip(clip));
            for kind in 0..3 {
                let step = |measurement: &Measurement| {
                    let (mut to, mut y1) = (x.mapv(|_| f32::NAN), y.mapv(|v| v * 0.5));
                    let momentum = (kind == 1).then_some(&mut y1);
                    let mirror = (kind == 2).then(|| z.view());
                    let previous = Some(previous.view());
                    let step = DataStep { damping, precision, momentum, mirror, previous };
                    let progress = step.apply(measurement, x.view(), to.view_mut());
                    (to, y1, progress)
                };
                let [(to, y1, told), (expected, expected_y1, expected_told)] = ways.each_ref().map(step);
                let off = (&to - &expected).fold(0f32, |m, d| m.max(d.abs()));
                prop_assert!(off <= if kind == 2 { 1e-4 } else { 0.0 }, "{off}");
                prop_assert!(close(told, expected_told), "{told:?} {expected_told:?}");
                let open = ways[0].operator().gram();
                prop_assert!(y1.iter().zip(&expected_y1).zip(open).all(|((a, b), &open)| a == b || open == 0.0));
            }
            let [fast, slow] = ways.each_ref().map(|measurement| progress(measurement, x.view(), previous.view()));
            prop_assert!(close(fast, slow), "{fast:?} {slow:?}");
        }
    }

    /// The gradient of `Σ (y − H x)²/n + ‖x − v‖²/s²` is 0 where the step goes.
    #[test]
    fn with_noise_the_step_goes_to_the_likeliest_video(shape in shapes(), seed in any::<u64>(), s2 in 1e-4f32..1.0) {
        let operator = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.9, seed).unwrap()));
        let y = operator.forward(uniform(shape.dim(), seed).view());
        let measurement = Measurement::new(operator.clone(), y.clone()).unwrap();
        let measurement = measurement.with_noise(Some(Noise::new(Some(20.0), 0.05).unwrap()));
        let v = uniform(shape.dim(), seed + 1);
        let mut x = v.clone();
        DataStep { precision: 1.0 / s2, ..DataStep::default() }.apply(&measurement, v.view(), x.view_mut());
        let weighted = (&y - operator.forward(x.view())) / measurement.variance().unwrap();
        let gradient = (&x - &v) / s2 - operator.adjoint(weighted.view());
        let scale = 1.0 / s2 + weighted.iter().fold(0f32, |m, w| m.max(w.abs()));
        prop_assert!(gradient.iter().all(|g| g.abs() < 1e-4 * scale), "{gradient}");
    }

    #[test]
    fn a_projected_video_has_the_measurement(shape in shapes(), seed in any::<u64>()) {
        for masks in mask_families(shape, seed) {
            let operator = Arc::new(MaskOperator::new(masks));
            let before = uniform(shape.dim(), seed);
            let mut x = before.clone();
            let y = operator.forward(uniform(shape.dim(), seed + 1).view());
            let measurement = Measurement::new(operator.clone(), y.clone()).unwrap();
            DataStep::default().apply(&measurement, before.view(), x.view_mut());
            let hx = operator.forward(x.view());
            for ((i, j), &gram) in operator.gram().indexed_iter() {
                if gram > 0.0 {
                    prop_assert!((hx[[i, j]] - y[[i, j]]).abs() <= 2e-6 * y[[i, j]].abs().max(1.0), "{} {}", hx[[i, j]], y[[i, j]]);
                } else {
                    prop_assert!((0..shape.frames).all(|t| x[[t, i, j]] == before[[t, i, j]]));
                }
            }
        }
    }
}

#[test]
fn views_that_are_not_contiguous_give_the_same_bits() {
    let shape = VideoShape { frames: 3, height: 20, width: 33 };
    let operator = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.5, 0).unwrap()));
    let measurement = Measurement::new(operator, gaussian(shape.image_dim(), 2)).unwrap();
    let wide = uniform((3, 40, 66), 1);
    let strided = wide.slice(s![.., ..;2, 1..;2]);
    let packed = strided.to_owned();
    let (mut a, mut b) = (wide.clone(), packed.clone());
    let step = || DataStep { damping: 0.1, ..DataStep::default() };
    step().apply(&measurement, strided, a.slice_mut(s![.., ..;2, 1..;2]));
    step().apply(&measurement, packed.view(), b.view_mut());
    assert_eq!(progress(&measurement, strided, strided), progress(&measurement, packed.view(), strided));
    assert_eq!(a.slice(s![.., ..;2, 1..;2]), b);
}

#[test]
fn the_thread_count_does_not_change_a_bit() {
    let shape = VideoShape { frames: 5, height: 97, width: 61 };
    let operator = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.5, 0).unwrap()));
    let measurement = Measurement::new(operator, gaussian(shape.image_dim(), 2)).unwrap();
    let step = |threads| {
        let from = uniform(shape.dim(), 1);
        let mut x = from.clone();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let before = DataStep::default().apply(&measurement, from.view(), x.view_mut());
            let after = progress(&measurement, x.view(), from.view());
            let bits = |p: Progress| [p.residual, p.change, p.norm].map(f64::to_bits);
            (x, bits(before), bits(after))
        })
    };
    assert_eq!(step(1), step(2));
    assert_eq!(step(1), step(3));
}

/// Every solver goes through an operator that is not made of masks, with the same result but for rounding.
#[test]
fn an_operator_of_its_own_solves() {
    let shape = VideoShape { frames: 4, height: 24, width: 20 };
    let masks = MaskStack::random(shape, 0.5, 3).unwrap();
    let y = MaskOperator::new(masks.clone()).forward(moving_square(shape).view());
    let ways = both_ways(masks, &y, false);
    let mut plan = Plan::new([Stage { sigma: None, iterations: 20 }]);
    for hold_out in [None, Some(HoldOut { spacing: 6, ..HoldOut::default() })] {
        plan.hold_out = hold_out;
        let solvers: [fn() -> Box<dyn Solver>; 3] = [
            || Box::new(Gap::plain(Tv::new(0.1))),
            || Box::new(Gap::accelerated(Tv::new(0.1))),
            || Box::new(Admm::new(Tv::new(0.1), 0.1)),
        ];
        for solver in solvers {
            let [a, b] = ways.each_ref().map(|measurement| {
                run(solver().as_mut(), measurement, Start::Mean, &plan, &mut ()).unwrap().estimate.sensor
            });
            assert!((a - b).iter().all(|d| d.abs() < 1e-4));
        }
    }
}

/// Spectral imaging: a prism moves each of the L channels of a scene one pixel further to the right before the sensor sums
/// them. In sheared coordinates (channels padded to W + L − 1, the one mask sheared along) that is a stack of masks, and a prior
/// that knows nothing of it works in a decorator that takes the shear back.
#[test]
fn a_spectral_camera_is_sheared_masks_and_a_prior_that_shears_back() {
    struct Unsheared<D> {
        inner: D,
        width: usize,
    }
    impl<D: Denoiser> Denoiser for Unsheared<D> {
        fn name(&self) -> &str {
            self.inner.name()
        }
        fn denoise(
            &mut self,
            call: &Call<'_>,
            sheared: ArrayView4<'_, f32>,
            mut out: ArrayViewMut4<'_, f32>,
        ) -> Result<(), BoxError> {
            let (channels, one, height, _) = sheared.dim();
            let mut upright = Array4::zeros((channels, one, height, self.width));
            for (l, mut channel) in upright.outer_iter_mut().enumerate() {
                channel.assign(&sheared.slice(s![l, .., .., l..l + self.width]));
            }
            let mut denoised = Array4::zeros(upright.dim());
            self.inner.denoise(&call.without_measurement(), upright.view(), denoised.view_mut())?;
            out.fill(0.0);
            for (l, channel) in denoised.outer_iter().enumerate() {
                out.slice_mut(s![l, .., .., l..l + self.width]).assign(&channel);
            }
            Ok(())
        }
    }
    let (channels, height, width) = (6, 32, 30);
    let scene = moving_square(VideoShape { frames: channels, height, width });
    let code = MaskStack::random(VideoShape { frames: 1, height, width }, 0.5, 8).unwrap();
    let shear = |l: usize| s![l, .., l..l + width];
    let sheared_dim = (channels, height, width + channels - 1);
    let (mut masks, mut truth) = (Array3::zeros(sheared_dim), Array3::zeros(sheared_dim));
    for l in 0..channels {
        masks.slice_mut(shear(l)).assign(&code.view().index_axis(ndarray::Axis(0), 0));
        truth.slice_mut(shear(l)).assign(&scene.index_axis(ndarray::Axis(0), l));
    }
    let h = Arc::new(MaskOperator::new(MaskStack::new(masks).unwrap()));
    let measurement = Measurement::new(h.clone(), h.forward(truth.view())).unwrap();
    let plan = Plan::new([Stage { sigma: None, iterations: 60 }]);
    let error = |estimate: &Estimate| (&estimate.sensor - &truth).mapv(|d| d * d).mean().unwrap().sqrt();
    let mut gap = Gap::accelerated(Unsheared { inner: Tv::new(0.1), width });
    let start = run(&mut gap, &measurement, Start::Mean, &Plan::new([]), &mut ()).unwrap();
    let solved = run(&mut gap, &measurement, Start::Mean, &plan, &mut ()).unwrap();
    assert!(error(&solved.estimate) < 0.5 * error(&start.estimate), "{}", error(&solved.estimate));
}
