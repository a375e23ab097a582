//! Owns the decorator that shows a denoiser the video another way round in every iteration.

use crate::{BoxError, Call, Denoiser};
use ndarray::{Array4, ArrayView4, ArrayViewMut4, Axis, Zip, s};
use sci_forward::bayer::mirror;

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
    /// What the sides of turned frames are multiples of.
    multiple: usize,
    /// The turned input and output, kept for their memory.
    turned: [Array4<f32>; 2],
}

impl<D: Denoiser> Flips<D> {
    /// Around a denoiser.
    pub fn new(inner: D) -> Self {
        Self { inner, multiple: 1, turned: std::array::from_fn(|_| Array4::zeros((0, 0, 0, 0))) }
    }

    /// Continues frames to multiples of `multiple`, mirrored at the right and the bottom, before they are turned.
    ///
    /// A network that needs such multiples continues what it is shown there itself: of a turned video that is another side, and all
    /// that it makes smaller would lie on another grid than in the video that is not turned.
    ///
    /// # Panics
    /// If `multiple` is 0.
    #[must_use]
    pub fn continued_to(self, multiple: usize) -> Self {
        assert!(multiple > 0, "frames have sides that are multiples of 1 or more");
        Self { multiple, ..self }
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
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        if flipped_axes(call.iteration).next().is_none() {
            return self.inner.denoise(call, noisy, out);
        }
        let (t, c, height, width) = noisy.dim();
        let continued = (t, c, height.next_multiple_of(self.multiple), width.next_multiple_of(self.multiple));
        if self.turned[0].dim() != continued {
            self.turned = std::array::from_fn(|_| Array4::zeros(continued));
        }
        let [input, denoised] = &mut self.turned;
        let (mut shown, mut found) = (input.view_mut(), denoised.view_mut());
        flipped_axes(call.iteration).for_each(|axis| shown.invert_axis(axis));
        Zip::from(shown.slice_mut(s![.., .., ..height, ..width])).and(noisy).par_for_each(|to, &from| *to = from);
        continue_from(Axis(3), width, &mut shown);
        continue_from(Axis(2), height, &mut shown);
        self.inner.denoise(&call.without_measurement(), input.view(), found.view_mut())?;
        flipped_axes(call.iteration).for_each(|axis| found.invert_axis(axis));
        let inside = found.slice(s![.., .., ..height, ..width]);
        Zip::from(&mut out).and(inside).par_for_each(|to, &from| *to = from);
        Ok(())
    }
}

/// Mirrors what is before place `n` of an axis to what is from there on.
fn continue_from(axis: Axis, n: usize, video: &mut ArrayViewMut4<'_, f32>) {
    let (known, mut beyond) = video.view_mut().split_at(axis, n);
    for (i, mut to) in beyond.axis_iter_mut(axis).enumerate() {
        to.assign(&known.index_axis(axis, if n == 1 { 0 } else { mirror((n + i) as isize, n) }));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::concatenate;

    /// Gives back what it is shown, and keeps it.
    struct Seen(Array4<f32>);

    impl Denoiser for Seen {
        fn name(&self) -> &str {
            "seen"
        }

        fn denoise(
            &mut self,
            _: &Call<'_>,
            noisy: ArrayView4<'_, f32>,
            mut out: ArrayViewMut4<'_, f32>,
        ) -> Result<(), BoxError> {
            out.assign(&noisy);
            self.0 = noisy.to_owned();
            Ok(())
        }
    }

    #[test]
    fn frames_are_continued_at_the_same_sides_however_they_are_turned() {
        for (height, width) in [(5, 6), (8, 4), (1, 3)] {
            let video = Array4::from_shape_fn((2, 1, height, width), |(t, _, y, x)| (100 * t + 10 * y + x) as f32);
            let rows =
                |n: usize| (0..n.next_multiple_of(4)).map(move |i| if n == 1 { 0 } else { mirror(i as isize, n) });
            let columns: Vec<_> = rows(width).map(|x| video.slice(s![.., .., .., x..=x])).collect();
            let wide = concatenate(Axis(3), &columns).unwrap();
            let all: Vec<_> = rows(height).map(|y| wide.slice(s![.., .., y..=y, ..])).collect();
            let mut expected = concatenate(Axis(2), &all).unwrap();
            for iteration in 1..8 {
                let mut flips = Flips::new(Seen(Array4::zeros((0, 0, 0, 0)))).continued_to(4);
                let mut out = Array4::zeros(video.dim());
                flips.denoise(&Call { iteration, ..Call::default() }, video.view(), out.view_mut()).unwrap();
                assert_eq!(out, video);
                flipped_axes(iteration).for_each(|axis| expected.invert_axis(axis));
                assert_eq!(flips.inner.0, expected, "{height}×{width}, iteration {iteration}");
                flipped_axes(iteration).for_each(|axis| expected.invert_axis(axis));
            }
        }
    }
}
