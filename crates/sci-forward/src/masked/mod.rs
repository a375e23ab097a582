//! `H` of coded-exposure video over any source of masks: stored, packed, or made on the fly.
//!
//! Each operation is one pass over the video: a band of rows of every frame is read, summed and written while it is in
//! cache. Sums run over the frames in order, so that results are the same for any number of threads.

mod binary;
mod gained;
mod rows;
mod shifting;

pub use binary::BinaryMasks;
pub use gained::Gained;
pub use shifting::ShiftingMasks;

use crate::operator::CLOSED;
use crate::{MaskStack, SensingOperator, VideoShape};
use ndarray::parallel::prelude::*;
use ndarray::{Array2, ArrayView2, ArrayView3, ArrayViewMut2, ArrayViewMut3, Axis};
use rows::Rows;

/// Rows of one parallel task.
const BAND: usize = 16;

/// Masks `C_t` `[T, H, W]` that are written a piece of a row at a time: they need not be stored as they are used.
///
/// [`MaskStack`] stores `f32`, [`BinaryMasks`] a bit a pixel, [`ShiftingMasks`] one pattern that moves, and [`Gained`] changes
/// the frames of another source by a factor each. A spectral camera (CASSI) fits too: the bands are the frames, each as wide as the
/// measurement, and band t's mask is the coded aperture moved by t columns and closed beside it; what is to be denoised is the
/// video moved back. A source of one's own promises values in -1e9 to 1e9, the same at every
/// call; `testing::check_source` (feature `testing`) holds it to that.
///
/// ```
/// use ndarray::{Array3, array};
/// use sci_forward::{MaskOperator, MaskSource, SensingOperator, VideoShape};
///
/// /// A shutter that is open for every other frame, for even rows first.
/// struct Alternating(VideoShape);
///
/// impl MaskSource for Alternating {
///     fn shape(&self) -> VideoShape {
///         self.0
///     }
///     fn fill(&self, frame: usize, row: usize, _start: usize, out: &mut [f32]) {
///         out.fill(if (frame + row) % 2 == 0 { 1.0 } else { 0.0 });
///     }
/// }
///
/// let h = MaskOperator::new(Alternating(VideoShape { frames: 3, height: 2, width: 1 }));
/// assert_eq!(h.gram(), array![[2.0], [1.0]]);
/// assert_eq!(h.forward(Array3::ones((3, 2, 1)).view()), array![[2.0], [1.0]]);
/// ```
pub trait MaskSource: Send + Sync {
    /// The size of the video that the masks modulate.
    fn shape(&self) -> VideoShape;

    /// Writes the masks' values of `frame` in `row`, columns `start..start + out.len()`, to `out`.
    ///
    /// # Panics
    /// If a position is outside [`MaskSource::shape`].
    fn fill(&self, frame: usize, row: usize, start: usize, out: &mut [f32]);

    /// The whole of a `row` of `frame`, if it is stored as [`MaskSource::fill`] would write it: it need not be copied then.
    ///
    /// # Panics
    /// If a position is outside [`MaskSource::shape`].
    fn stored(&self, _frame: usize, _row: usize) -> Option<&[f32]> {
        None
    }
}

impl<S: MaskSource + ?Sized> MaskSource for Box<S> {
    fn shape(&self) -> VideoShape {
        (**self).shape()
    }

    fn fill(&self, frame: usize, row: usize, start: usize, out: &mut [f32]) {
        (**self).fill(frame, row, start, out);
    }

    fn stored(&self, frame: usize, row: usize) -> Option<&[f32]> {
        (**self).stored(frame, row)
    }
}

/// `H` of coded-exposure video: `y = Σ_t C_t ⊙ x_t`, `Hᵀ y = (C_t ⊙ y)_t`, `diag(H Hᵀ) = Σ_t C_t²`.
///
/// ```
/// use ndarray::array;
/// use sci_forward::{MaskOperator, MaskStack, SensingOperator};
///
/// let h = MaskOperator::new(MaskStack::new(array![[[1.0, 0.0]], [[0.5, 1.0]]])?);
/// assert_eq!(h.forward(array![[[0.2, 0.4]], [[0.6, 0.8]]].view()), array![[0.5, 0.8]]);
/// assert_eq!(h.adjoint(array![[2.0, 4.0]].view()), array![[[2.0, 0.0]], [[1.0, 4.0]]]);
/// assert_eq!(h.gram(), array![[1.25, 1.0]]);
/// # Ok::<(), sci_forward::MaskError>(())
/// ```
///
/// # References
/// Wu et al., *Adaptive Deep PnP Algorithm for Video Snapshot Compressive Imaging*, section 2.
#[derive(Debug, Clone)]
pub struct MaskOperator<S = MaskStack> {
    source: S,
    gram: Array2<f32>,
}

impl<S: MaskSource> MaskOperator<S> {
    /// The operator of these masks.
    pub fn new(source: S) -> Self {
        let gram = gram_of(&source);
        Self { source, gram }
    }

    /// The masks.
    pub fn source(&self) -> &S {
        &self.source
    }

    #[track_caller]
    fn check(&self, x: (usize, usize, usize), y: (usize, usize)) {
        assert_eq!(x, self.shape().dim(), "the video must have the masks' size");
        assert_eq!(y, self.shape().image_dim(), "the measurement must have the masks' size");
    }
}

/// `Σ_t C_t²`, but 0 where that is too small to divide by, see [`SensingOperator::gram`].
fn gram_of(source: &impl MaskSource) -> Array2<f32> {
    let mut gram = Array2::zeros(source.shape().image_dim());
    gram.axis_chunks_iter_mut(Axis(0), BAND).into_par_iter().enumerate().for_each(|(band, mut gram)| {
        let mut rows = Rows::of(source);
        for (row, gram) in gram.outer_iter_mut().enumerate() {
            rows.gram(band * BAND + row, gram.into_slice().expect("a row of a new array"));
        }
        gram.mapv_inplace(|v| if v > CLOSED { v } else { 0.0 });
    });
    gram
}

impl<S: MaskSource> SensingOperator for MaskOperator<S> {
    fn shape(&self) -> VideoShape {
        self.source.shape()
    }

    fn forward_into(&self, x: ArrayView3<'_, f32>, mut y: ArrayViewMut2<'_, f32>) {
        self.check(x.dim(), y.dim());
        let bands = y.axis_chunks_iter_mut(Axis(0), BAND).into_par_iter().zip(x.axis_chunks_iter(Axis(1), BAND));
        bands.enumerate().for_each(|(band, (mut y, x))| {
            let mut rows = Rows::of(&self.source);
            for (row, (y, x)) in y.outer_iter_mut().zip(x.axis_iter(Axis(1))).enumerate() {
                rows.forward(band * BAND + row, x, y);
            }
        });
    }

    fn adjoint_into(&self, y: ArrayView2<'_, f32>, mut x: ArrayViewMut3<'_, f32>) {
        self.check(x.dim(), y.dim());
        let bands = x.axis_chunks_iter_mut(Axis(1), BAND).into_par_iter().zip(y.axis_chunks_iter(Axis(0), BAND));
        bands.enumerate().for_each(|(band, (mut x, y))| {
            let mut rows = Rows::of(&self.source);
            for (row, (x, y)) in x.axis_iter_mut(Axis(1)).zip(y.outer_iter()).enumerate() {
                rows.adjoint(band * BAND + row, y, x);
            }
        });
    }

    fn gram(&self) -> ArrayView2<'_, f32> {
        self.gram.view()
    }

    fn masks(&self) -> Option<&dyn MaskSource> {
        Some(&self.source)
    }
}
