//! The decorator that multiplies in bf16 where the solve would not notice.

use crate::Network;
use crate::kernels::{Isa, Precision};
use admm::{BoxError, DenoiseCx, Denoiser};
use ndarray::{Array4, ArrayView4, ArrayViewMut4, s};
use std::cell::Cell;
use std::rc::Rc;

/// A denoiser that can be told what to multiply.
pub trait Precise: Denoiser {
    /// f32, or bf16 where the processor has a matrix unit for it.
    fn compute_in(&mut self, precision: Precision);
}

impl<N: Network + Denoiser> Precise for N {
    fn compute_in(&mut self, precision: Precision) {
        self.set_inference_precision(precision);
    }
}

/// Numbers that a denoiser was asked for, and those that it made in bf16.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct HalfCounts {
    /// All numbers of all calls.
    pub asked: u64,
    /// Those in bf16.
    pub halved: u64,
}

impl HalfCounts {
    /// The share in bf16, 0 to 1.
    pub fn share(&self) -> f64 {
        if self.asked == 0 { 0.0 } else { self.halved as f64 / self.asked as f64 }
    }
}

/// Has the inner denoiser work in bf16, which takes half the time, in calls that tolerate its error ([`DenoiseCx::tolerance`]).
///
/// The error is the network's own: for each σ the first frame is denoised both ways, and the root mean square of the difference is
/// held against the tolerance. Networks differ: 0.0002 to 0.007 at σ = 6 and 25 on the benchmark's gray scenes, least of those that
/// estimate the noise. Where the processor has no matrix unit, and where nothing is tolerated, all is f32.
///
/// ```
/// use admm::{DenoiseCx, Denoiser};
/// use ndarray::Array4;
/// use nets::{Ffdnet, FfdnetSpec, Frugal};
///
/// let mut net = Ffdnet::random(FfdnetSpec { width: 32, depth: 3, ..FfdnetSpec::GRAY }, 0)?;
/// let counts = std::rc::Rc::default();
/// let mut frugal = Frugal::new(&mut net, std::rc::Rc::clone(&counts));
/// let (noisy, mut out) = (Array4::from_elem((2, 1, 9, 7), 0.5), Array4::zeros((2, 1, 9, 7)));
/// let cx = DenoiseCx::new(0.1);
/// frugal.denoise(&cx, noisy.view(), out.view_mut())?;
/// assert_eq!(counts.get().share(), 0.0);
/// # Ok::<(), admm::BoxError>(())
/// ```
pub struct Frugal<'a, D> {
    inner: &'a mut D,
    has_unit: bool,
    /// σ for which the error was measured, and the error.
    measured: Option<(f32, f64)>,
    counts: Rc<Cell<HalfCounts>>,
}

impl<'a, D: Precise> Frugal<'a, D> {
    /// Around a denoiser, which works in f32 otherwise.
    pub fn new(inner: &'a mut D, counts: Rc<Cell<HalfCounts>>) -> Self {
        let has_unit = Isa::detect().is_ok_and(|isa| isa == Isa::Amx);
        Self { inner, has_unit, measured: None, counts }
    }

    /// The error of bf16 for this σ.
    fn error(&mut self, cx: &DenoiseCx, noisy: ArrayView4<'_, f32>) -> Result<f64, BoxError> {
        match self.measured {
            Some((sigma, error)) if sigma == cx.sigma => return Ok(error),
            _ => {}
        }
        let first = noisy.slice(s![..1, .., .., ..]);
        let mut denoised = |precision| {
            let mut out = Array4::zeros(first.dim());
            self.inner.compute_in(precision);
            self.inner.denoise(cx, first, out.view_mut()).map(|()| out)
        };
        let difference = denoised(Precision::F32)? - denoised(Precision::Bf16)?;
        let square = difference.iter().map(|&d| f64::from(d).powi(2)).sum::<f64>();
        let error = (square / difference.len().max(1) as f64).sqrt();
        self.measured = Some((cx.sigma, error));
        Ok(error)
    }
}

impl<D: Precise> Denoiser for Frugal<'_, D> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn denoise(
        &mut self,
        cx: &DenoiseCx,
        noisy: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        // An error that is not a number is not tolerated.
        let halved = self.has_unit && cx.tolerance > 0.0 && self.error(cx, noisy)? <= f64::from(cx.tolerance);
        let HalfCounts { asked, halved: before } = self.counts.get();
        let numbers = noisy.len() as u64;
        self.counts.set(HalfCounts { asked: asked + numbers, halved: before + if halved { numbers } else { 0 } });
        self.inner.compute_in(if halved { Precision::Bf16 } else { Precision::F32 });
        self.inner.denoise(cx, noisy, out)
    }
}
