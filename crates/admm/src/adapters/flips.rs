//! Owns the decorator that shows a denoiser the video another way round in every iteration.

use crate::{BoxError, Call, Denoiser};
use ndarray::{Array4, ArrayView4, ArrayViewMut4, Axis, Zip};

/// Has the inner denoiser see the video mirrored left to right, top to bottom, or backwards in time: in iteration k those of the
/// three whose bit is set in k mod 8.
///
/// A denoiser's own preferences of direction then differ from call to call and do not add up over a solve. It costs a copy of
/// the video there and back.
///
/// ```
/// use admm::{Call, Denoiser, Flips, Tv};
/// use ndarray::Array4;
/// let noisy = Array4::from_shape_fn((2, 1, 4, 5), |(t, _, y, x)| ((7 * t + 5 * y + 3 * x) % 4) as f32);
/// let (mut plain, mut flipped) = (Array4::zeros(noisy.dim()), Array4::zeros(noisy.dim()));
/// let call = Call { iteration: 3, ..Call::default() };
/// Tv::new(0.1).denoise(&call, noisy.view(), plain.view_mut())?;
/// Flips::new(Tv::new(0.1)).denoise(&call, noisy.view(), flipped.view_mut())?;
/// // Total variation is nearly the same in all directions.
/// assert!((plain - flipped).iter().all(|d| d.abs() < 0.1));
/// # Ok::<(), admm::BoxError>(())
/// ```
///
/// # References
/// Terris et al., *Equivariant plug-and-play image reconstruction*, CVPR 2024 (still pictures, a random transformation each time).
#[derive(Debug, Clone)]
pub struct Flips<D> {
    inner: D,
    /// The turned input and output, kept for their memory.
    turned: [Array4<f32>; 2],
}

impl<D: Denoiser> Flips<D> {
    /// Around a denoiser.
    pub fn new(inner: D) -> Self {
        Self { inner, turned: std::array::from_fn(|_| Array4::zeros((0, 0, 0, 0))) }
    }
}

/// The axes of `[T, C, H, W]` that [`Flips`] turns round in an iteration.
pub fn flipped_axes(iteration: usize) -> impl Iterator<Item = Axis> {
    [3, 2, 0].into_iter().enumerate().filter(move |(bit, _)| iteration >> bit & 1 == 1).map(|(_, axis)| Axis(axis))
}

impl<D: Denoiser> Denoiser for Flips<D> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn denoise(
        &mut self,
        call: &Call<'_>,
        mut noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        if flipped_axes(call.iteration).next().is_none() {
            return self.inner.denoise(call, noisy, out);
        }
        flipped_axes(call.iteration).for_each(|axis| noisy.invert_axis(axis));
        flipped_axes(call.iteration).for_each(|axis| out.invert_axis(axis));
        if self.turned[0].dim() != noisy.dim() {
            self.turned = std::array::from_fn(|_| Array4::zeros(noisy.dim()));
        }
        let [input, denoised] = &mut self.turned;
        Zip::from(&mut *input).and(noisy).par_for_each(|to, &from| *to = from);
        self.inner.denoise(&call.without_measurement(), input.view(), denoised.view_mut())?;
        Zip::from(&mut out).and(&*denoised).par_for_each(|to, &from| *to = from);
        Ok(())
    }
}
