//! Owns the decorator that shows a denoiser the video in less light.

use crate::{BoxError, Call, Denoiser};
use ndarray::{Array4, ArrayView4, ArrayViewMut4, Zip};

/// Has the inner denoiser see the video divided by a number, and multiplies what it gives back: `D'_σ(x) = k D_σ(x / k)`.
///
/// Whatever the denoiser takes for noise of σ is then noise of k σ. So a schedule is as strong as a scene needs it that its masks do not
/// explain, with a network that stays at the σ it was trained for. It costs a copy of the video there and back.
///
/// ```
/// use admm::{Call, Denoiser, Dimmed, Tv};
/// use ndarray::Array4;
/// let noisy = Array4::from_shape_fn((1, 1, 8, 8), |(.., y, x)| 0.5 + 0.1 * ((7 * y + 5 * x) % 3) as f32);
/// let contrast = |by: f32| {
///     let mut out = Array4::zeros(noisy.dim());
///     Dimmed::new(Tv::new(0.02), by).denoise(&Call::default(), noisy.view(), out.view_mut())?;
///     Ok::<_, admm::BoxError>(out.std(0.0))
/// };
/// assert!(contrast(4.0)? < contrast(1.0)? && contrast(1.0)? < noisy.std(0.0));
/// # Ok::<(), admm::BoxError>(())
/// ```
#[derive(Debug, Clone)]
pub struct Dimmed<D> {
    inner: D,
    by: f32,
    /// The dim input, kept for its memory.
    dim: Array4<f32>,
}

impl<D: Denoiser> Dimmed<D> {
    /// Around a denoiser, `by` > 0.
    pub fn new(inner: D, by: f32) -> Self {
        Self { inner, by, dim: Array4::zeros((0, 0, 0, 0)) }
    }
}

impl<D: Denoiser> Denoiser for Dimmed<D> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn denoise(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        let by = self.by;
        if self.dim.dim() != noisy.dim() {
            self.dim = Array4::zeros(noisy.dim());
        }
        Zip::from(&mut self.dim).and(noisy).par_for_each(|to, &from| *to = from / by);
        let call = call.without_measurement();
        self.inner.denoise(&Call { tolerance: call.tolerance / by, ..call }, self.dim.view(), out.view_mut())?;
        out.par_mapv_inplace(|v| v * by);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Multiplies by σ, and adds the tolerance.
    struct Marks;

    impl Denoiser for Marks {
        fn name(&self) -> &str {
            "marks"
        }

        fn denoise(
            &mut self,
            call: &Call<'_>,
            noisy: ArrayView4<'_, f32>,
            mut out: ArrayViewMut4<'_, f32>,
        ) -> Result<(), BoxError> {
            assert!(call.measurement.is_none());
            let sigma = call.required_sigma()?;
            Zip::from(&mut out).and(noisy).for_each(|out, &x| *out = x * x * sigma + call.tolerance);
            Ok(())
        }
    }

    #[test]
    fn less_light_goes_in_and_as_much_comes_out() {
        let (noisy, mut out) = (Array4::from_elem((2, 1, 3, 3), 0.8), Array4::zeros((2, 1, 3, 3)));
        let call = Call { tolerance: 0.1, ..Call::new(0.5) };
        Dimmed::new(Marks, 2.0).denoise(&call, noisy.view(), out.view_mut()).unwrap();
        assert!(out.iter().all(|v: &f32| (v - 2.0 * (0.16 * 0.5 + 0.05)).abs() < 1e-6), "{out}");
    }
}
