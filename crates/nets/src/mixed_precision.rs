//! The decorator that multiplies 16-bit numbers where the solve would not notice.

use crate::Network;
use crate::kernels::{Isa, Precision};
use admm::{BoxError, Call, Denoiser};
use ndarray::{Array4, ArrayView4, ArrayViewMut4, s};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// A denoiser that can be told what to multiply.
pub trait SelectPrecision: Denoiser {
    /// f32, or 16-bit numbers ([`Precision::Bf16`]).
    fn select_precision(&mut self, precision: Precision);
}

impl<N: Network + Denoiser> SelectPrecision for N {
    fn select_precision(&mut self, precision: Precision) {
        self.set_inference_precision(precision);
    }
}

/// Numbers that a denoiser was asked for, and those that it made in half precision.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PrecisionCounts {
    /// All numbers of all calls.
    pub asked: u64,
    /// Those in half precision.
    pub halved: u64,
}

impl PrecisionCounts {
    /// The share in half precision, 0 to 1.
    pub fn share(&self) -> f64 {
        if self.asked == 0 { 0.0 } else { self.halved as f64 / self.asked as f64 }
    }
}

/// [`PrecisionCounts`] while they grow, to be read when the denoiser has been given away.
#[derive(Debug, Default)]
pub struct PrecisionCounter {
    asked: AtomicU64,
    halved: AtomicU64,
}

impl PrecisionCounter {
    /// The counts as they are now.
    pub fn counts(&self) -> PrecisionCounts {
        PrecisionCounts { asked: self.asked.load(Ordering::Relaxed), halved: self.halved.load(Ordering::Relaxed) }
    }

    fn add(&self, asked: usize, halved: usize) {
        self.asked.fetch_add(asked as u64, Ordering::Relaxed);
        self.halved.fetch_add(halved as u64, Ordering::Relaxed);
    }
}

/// Has the inner denoiser multiply 16-bit numbers ([`Precision::Bf16`]), which takes half to four fifths of the time, in calls that tolerate its error ([`Call::tolerance`]).
///
/// The error is the network's own: for each σ the first frame is denoised both ways, and the root mean square of the difference is
/// held against the tolerance. Networks differ: 0.0002 to 0.007 at σ = 6 and 25 on the benchmark's gray scenes, least of those that
/// estimate the noise. Where the processor gains nothing from them, and where nothing is tolerated, all is f32.
///
/// ```
/// use admm::{Call, Denoiser};
/// use ndarray::Array4;
/// use nets::{Ffdnet, FfdnetSpec, MixedPrecision};
///
/// let mut net = Ffdnet::random(FfdnetSpec { width: 32, depth: 3, ..FfdnetSpec::GRAY }, 0)?;
/// let mut mixed = MixedPrecision::new(&mut net);
/// let counter = mixed.counter();
/// let (noisy, mut out) = (Array4::from_elem((2, 1, 9, 7), 0.5), Array4::zeros((2, 1, 9, 7)));
/// mixed.denoise(&Call::new(0.1), noisy.view(), out.view_mut())?;
/// assert_eq!((counter.counts().asked, counter.counts().share()), (2 * 9 * 7, 0.0));
/// # Ok::<(), admm::BoxError>(())
/// ```
pub struct MixedPrecision<'a, D> {
    inner: &'a mut D,
    has_half: bool,
    /// σ for which the error was measured, and the error.
    measured: Option<(Option<f32>, f64)>,
    counter: Arc<PrecisionCounter>,
}

impl<'a, D: SelectPrecision> MixedPrecision<'a, D> {
    /// Around a denoiser, which works in f32 otherwise.
    pub fn new(inner: &'a mut D) -> Self {
        let has_half = Isa::detect().is_ok_and(|isa| isa.half_precision() != "f32");
        Self { inner, has_half, measured: None, counter: Arc::default() }
    }

    /// What was made in half precision so far, also when the denoiser itself is out of reach.
    pub fn counter(&self) -> Arc<PrecisionCounter> {
        Arc::clone(&self.counter)
    }

    /// The error of half precision for this σ.
    fn error(&mut self, call: &Call<'_>, noisy: ArrayView4<'_, f32>) -> Result<f64, BoxError> {
        match self.measured {
            Some((sigma, error)) if sigma == call.sigma => return Ok(error),
            _ => {}
        }
        let first = noisy.slice(s![..1, .., .., ..]);
        // A trial, outside of the solve: a denoiser that adapts itself has nothing to learn from one frame.
        let trial = Call { sigma: call.sigma, ..Call::default() };
        let mut denoised = |precision| {
            let mut out = Array4::zeros(first.dim());
            self.inner.select_precision(precision);
            self.inner.denoise(&trial, first, out.view_mut()).map(|()| out)
        };
        let difference = denoised(Precision::F32)? - denoised(Precision::Bf16)?;
        let square = difference.iter().map(|&d| f64::from(d).powi(2)).sum::<f64>();
        let error = (square / difference.len().max(1) as f64).sqrt();
        self.measured = Some((call.sigma, error));
        Ok(error)
    }
}

impl<D: SelectPrecision> Denoiser for MixedPrecision<'_, D> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn denoise(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        // An error that is not a number is not tolerated.
        let halved = self.has_half && call.tolerance > 0.0 && self.error(call, noisy)? <= f64::from(call.tolerance);
        self.counter.add(noisy.len(), if halved { noisy.len() } else { 0 });
        self.inner.select_precision(if halved { Precision::Bf16 } else { Precision::F32 });
        self.inner.denoise(call, noisy, out)
    }
}
