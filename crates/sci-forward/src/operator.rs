//! The sensing operator `H` as solvers see it, and the wrapper that leaves pixels out.

use crate::{MaskSource, VideoShape};
use ndarray::{Array2, Array3, ArrayView2, ArrayView3, ArrayViewMut2, ArrayViewMut3, Zip};
use std::sync::Arc;

/// A pixel with `Σ_t C_t²` up to this counts as one that no mask opens: the square root is far below any sensor's noise,
/// and 1 / gram stays finite in `f32`.
pub(crate) const CLOSED: f32 = 1e-30;

/// `H`: a video `[T, H, W]` to a measurement `[H, W]`, linear, with `H Hᵀ` diagonal.
///
/// [`MaskOperator`](crate::MaskOperator) is the operator of coded-exposure video. Another one says what it does to a video,
/// its adjoint and its diagonal:
///
/// ```
/// use ndarray::{Array2, Array3, ArrayView2, ArrayView3, ArrayViewMut2, ArrayViewMut3, Axis};
/// use sci_forward::{SensingOperator, VideoShape};
///
/// /// A long exposure: `y = Σ_t x_t`.
/// struct LongExposure {
///     shape: VideoShape,
///     gram: Array2<f32>,
/// }
///
/// impl SensingOperator for LongExposure {
///     fn shape(&self) -> VideoShape {
///         self.shape
///     }
///     fn forward_into(&self, x: ArrayView3<'_, f32>, mut y: ArrayViewMut2<'_, f32>) {
///         y.assign(&x.sum_axis(Axis(0)));
///     }
///     fn adjoint_into(&self, y: ArrayView2<'_, f32>, mut x: ArrayViewMut3<'_, f32>) {
///         x.assign(&y.broadcast(self.shape.dim()).expect("y has the size of a frame"));
///     }
///     fn gram(&self) -> ArrayView2<'_, f32> {
///         self.gram.view()
///     }
/// }
///
/// let shape = VideoShape { frames: 4, height: 2, width: 3 };
/// let h = LongExposure { shape, gram: Array2::from_elem((2, 3), 4.0) };
/// assert_eq!(h.forward(Array3::from_elem((4, 2, 3), 0.5).view()), Array2::from_elem((2, 3), 2.0));
/// assert!(sci_forward::testing::adjoint_gap(&h, 0) < 1e-6);
/// ```
pub trait SensingOperator: Send + Sync {
    /// The size of the video. A measurement has the size of one of its frames.
    fn shape(&self) -> VideoShape;

    /// `y = H x`: writes `y` `[H, W]` from `x` `[T, H, W]`.
    ///
    /// # Panics
    /// If a size differs from [`SensingOperator::shape`].
    fn forward_into(&self, x: ArrayView3<'_, f32>, y: ArrayViewMut2<'_, f32>);

    /// `x = Hᵀ y`: writes `x` `[T, H, W]` from `y` `[H, W]`.
    ///
    /// # Panics
    /// If a size differs from [`SensingOperator::shape`].
    fn adjoint_into(&self, y: ArrayView2<'_, f32>, x: ArrayViewMut3<'_, f32>);

    /// `diag(H Hᵀ)` `[H, W]`, all ≥ 0, and exactly 0 where it is too small to divide by (up to 1e-30): `> 0.0` is the test of an
    /// open pixel, a pixel of 0 is one that measures nothing.
    fn gram(&self) -> ArrayView2<'_, f32>;

    /// The masks `C_t`, if `H` is `y = Σ_t C_t ⊙ x_t` at every pixel with [`gram`](SensingOperator::gram) `> 0`: a data step can
    /// then fuse its passes over the video. Pixels with `gram = 0` are to be skipped, whatever the masks are there.
    fn masks(&self) -> Option<&dyn MaskSource> {
        None
    }

    /// [`SensingOperator::forward_into`] into a new array.
    ///
    /// # Panics
    /// If `x` has not the size of [`SensingOperator::shape`].
    fn forward(&self, x: ArrayView3<'_, f32>) -> Array2<f32> {
        let mut y = Array2::zeros(self.shape().image_dim());
        self.forward_into(x, y.view_mut());
        y
    }

    /// [`SensingOperator::adjoint_into`] into a new array.
    ///
    /// # Panics
    /// If `y` has not the size of a frame.
    fn adjoint(&self, y: ArrayView2<'_, f32>) -> Array3<f32> {
        let mut x = Array3::zeros(self.shape().dim());
        self.adjoint_into(y, x.view_mut());
        x
    }
}

/// `H` without some of its pixels: to it they are pixels that no mask opens, `(H x) = 0` and `diag(H Hᵀ) = 0` there.
///
/// Dead pixels and pixels held out for validation are handled this way. [`SensingOperator::masks`] are those of the wrapped
/// operator: who uses them skips the pixels with `gram = 0`.
///
/// ```
/// use ndarray::{Array2, Array3, array};
/// use sci_forward::{MaskOperator, MaskStack, Restricted, SensingOperator};
/// use std::sync::Arc;
///
/// let h = Arc::new(MaskOperator::new(MaskStack::new(Array3::ones((2, 1, 2)))?));
/// let restricted = Restricted::new(h, array![[true, false]].view());
/// assert_eq!(restricted.gram(), array![[2.0, 0.0]]);
/// assert_eq!(restricted.forward(Array3::ones((2, 1, 2)).view()), array![[2.0, 0.0]]);
/// # Ok::<(), sci_forward::MaskError>(())
/// ```
#[derive(Clone)]
pub struct Restricted {
    inner: Arc<dyn SensingOperator>,
    gram: Array2<f32>,
}

impl Restricted {
    /// Leaves out the pixels of `inner` where `measured` `[H, W]` is false.
    ///
    /// # Panics
    /// If `measured` has not the size of a frame.
    pub fn new(inner: Arc<dyn SensingOperator>, measured: ArrayView2<'_, bool>) -> Self {
        assert_eq!(measured.dim(), inner.shape().image_dim(), "there must be one flag for each sensor pixel");
        let gram = Zip::from(inner.gram()).and(measured).map_collect(|&gram, &keep| if keep { gram } else { 0.0 });
        Self { inner, gram }
    }
}

impl std::fmt::Debug for Restricted {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Restricted").field("shape", &self.shape()).finish_non_exhaustive()
    }
}

impl SensingOperator for Restricted {
    fn shape(&self) -> VideoShape {
        self.inner.shape()
    }

    fn forward_into(&self, x: ArrayView3<'_, f32>, mut y: ArrayViewMut2<'_, f32>) {
        self.inner.forward_into(x, y.view_mut());
        close(y, self.gram.view());
    }

    fn adjoint_into(&self, y: ArrayView2<'_, f32>, x: ArrayViewMut3<'_, f32>) {
        assert_eq!(y.dim(), self.gram.dim(), "the measurement must have the masks' size");
        let mut y = y.to_owned();
        close(y.view_mut(), self.gram.view());
        self.inner.adjoint_into(y.view(), x);
    }

    fn gram(&self) -> ArrayView2<'_, f32> {
        self.gram.view()
    }

    fn masks(&self) -> Option<&dyn MaskSource> {
        self.inner.masks()
    }
}

/// Writes 0 into the pixels of `image` that are not open, whatever they held.
pub(crate) fn close(mut image: ArrayViewMut2<'_, f32>, gram: ArrayView2<'_, f32>) {
    image.zip_mut_with(&gram, |v, &gram| *v = if gram > 0.0 { *v } else { 0.0 });
}
