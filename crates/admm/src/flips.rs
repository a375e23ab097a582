//! Owns the decorator that shows a denoiser the video another way round in every iteration.

use crate::{BoxError, DenoiseCx, Denoiser};
use ndarray::{Array4, ArrayView4, ArrayViewMut4, Axis};

/// Has the inner denoiser see the video mirrored left to right, top to bottom, or backwards in time: in iteration k those of the
/// three whose bit is set in k mod 8.
///
/// A denoiser's own preferences of direction then differ from call to call and do not add up over a solve. It costs a copy.
///
/// ```
/// use admm::{DenoiseCx, Denoiser, Flips, Tv};
/// use ndarray::Array4;
/// let noisy = Array4::from_shape_fn((2, 1, 4, 5), |(t, _, y, x)| ((7 * t + 5 * y + 3 * x) % 4) as f32);
/// let (mut plain, mut flipped) = (Array4::zeros(noisy.dim()), Array4::zeros(noisy.dim()));
/// let cx = DenoiseCx { iteration: 3, ..DenoiseCx::new(0.1) };
/// Tv::new(0.1).denoise(&cx, noisy.view(), plain.view_mut())?;
/// Flips::new(Tv::new(0.1)).denoise(&cx, noisy.view(), flipped.view_mut())?;
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
}

impl<D: Denoiser> Flips<D> {
    /// Around a denoiser.
    pub fn new(inner: D) -> Self {
        Self { inner }
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
        cx: &DenoiseCx,
        mut noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        flipped_axes(cx.iteration).for_each(|axis| noisy.invert_axis(axis));
        flipped_axes(cx.iteration).for_each(|axis| out.invert_axis(axis));
        let noisy = noisy.as_standard_layout();
        let mut denoised = Array4::zeros(noisy.dim());
        self.inner.denoise(cx, noisy.view(), denoised.view_mut())?;
        out.assign(&denoised);
        Ok(())
    }
}
