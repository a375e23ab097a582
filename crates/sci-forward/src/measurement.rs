//! A measurement with what made it, checked once.

use crate::bayer::{mosaic_adjoint_into, mosaic_into};
use crate::operator::close;
use crate::{CfaPattern, Noise, Restricted, SensingOperator, VideoShape};
use ndarray::{Array2, Array3, Array4, ArrayView2, ArrayView4, Axis, Zip};
use std::sync::Arc;

/// Why an operator and an image are not a measurement, or a video does not belong to one.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MeasurementError {
    /// An array has the wrong size.
    #[error("the {what} is {found:?}, the masks ask for {expected:?}")]
    Size {
        /// Which array.
        what: &'static str,
        /// The size it must have.
        expected: Vec<usize>,
        /// The size it has.
        found: Vec<usize>,
    },
    /// A pixel is NaN or infinite.
    #[error("the measurement is {value} at index [{row}, {column}]: every value must be finite")]
    NotFinite {
        /// Its row.
        row: usize,
        /// Its column.
        column: usize,
        /// Its value.
        value: f32,
    },
    /// No pixel is open.
    #[error("no pixel that is measured is opened by a mask: there is nothing to reconstruct from")]
    AllClosed,
}

/// A measurement and what made it: `y = H T v + noise`, `T` the mosaic of a color sensor, or the identity of a gray one.
///
/// Sizes and finiteness are checked here, once.
///
/// ```
/// use ndarray::Array3;
/// use sci_forward::{CfaPattern, MaskOperator, MaskStack, Measurement, SensingOperator, VideoShape};
/// use std::sync::Arc;
///
/// let shape = VideoShape { frames: 8, height: 6, width: 4 };
/// let h = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.5, 0)?));
/// let y = h.forward(Array3::from_elem(shape.dim(), 0.5).view());
/// let measurement = Measurement::new(h, y)?.with_cfa(Some(CfaPattern::Rggb));
/// assert_eq!(measurement.channels(), 3);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone)]
pub struct Measurement {
    operator: Arc<dyn SensingOperator>,
    /// In row-major order.
    y: Array2<f32>,
    cfa: Option<CfaPattern>,
    scale: f64,
    /// Of each pixel of y, where noise is known of.
    variance: Option<Array2<f32>>,
    /// What the sensor could not exceed.
    clip: Option<f32>,
}

impl Measurement {
    /// Takes `y` `[H, W]`, on the scale of `Σ_t C_t`, of a gray sensor.
    ///
    /// # Errors
    /// [`MeasurementError::Size`] if `y` has not the size of the operator's frames, [`MeasurementError::NotFinite`] if a pixel is
    /// NaN or infinite, [`MeasurementError::AllClosed`] if no pixel has `gram > 0`.
    pub fn new(operator: Arc<dyn SensingOperator>, y: Array2<f32>) -> Result<Self, MeasurementError> {
        check("measurement", y.shape(), operator.shape().image_dim().into())?;
        if let Some(((row, column), &value)) = y.indexed_iter().find(|(_, v)| !v.is_finite()) {
            return Err(MeasurementError::NotFinite { row, column, value });
        }
        let y = if y.is_standard_layout() { y } else { y.as_standard_layout().into_owned() };
        let (mut squares, mut open) = (0.0, 0usize);
        Zip::from(&y).and(operator.gram()).for_each(|&y, &gram| {
            if gram > 0.0 {
                squares += f64::from(y).powi(2);
                open += 1;
            }
        });
        if open == 0 {
            return Err(MeasurementError::AllClosed);
        }
        let scale = if squares > 0.0 { squares.sqrt() } else { (open as f64).sqrt() };
        Ok(Self { operator, y, cfa: None, scale, variance: None, clip: None })
    }

    /// The same measurement by a sensor with this color filter array; `None` for a gray sensor.
    pub fn with_cfa(self, cfa: Option<CfaPattern>) -> Self {
        Self { cfa, ..self }
    }

    /// The same measurement with noise that solvers are to know of: they then explain y as closely as the noise allows, not exactly. The
    /// shot noise of a pixel is that of its measured light, of which y says little if masks have both signs: read noise is all that should be
    /// given then. Noise that has no variance anywhere is none.
    ///
    /// ```
    /// use ndarray::{Array3, array};
    /// use sci_forward::{MaskOperator, MaskStack, Measurement, Noise};
    /// use std::sync::Arc;
    ///
    /// let h = Arc::new(MaskOperator::new(MaskStack::new(Array3::ones((2, 1, 2)))?));
    /// let measurement = Measurement::new(h, array![[1.0, 0.0]])?.with_noise(Some(Noise::new(Some(4.0), 0.5)?));
    /// assert_eq!(measurement.variance(), Some(array![[0.5, 0.25]].view()));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn with_noise(self, noise: Option<Noise>) -> Self {
        let variance = noise.map(|noise| self.y.mapv(|y| noise.variance(y)));
        Self { variance: variance.filter(|variance| variance.iter().any(|&v| v > 0.0)), ..self }
    }

    /// The same measurement by a sensor that clips at a level, in the unit of y: pixels that have reached it say only that there was as
    /// much light, or more. A level that is not a finite number above 0 is none.
    pub fn with_clip(self, level: Option<f32>) -> Self {
        Self { clip: level.filter(|level| *level > 0.0 && level.is_finite()), ..self }
    }

    /// The level at which the sensor clips, where one is known.
    pub fn clip(&self) -> Option<f32> {
        self.clip
    }

    /// What of y a video disagrees with that would give `hx`: y itself, but for a clipped pixel `hx` if that is more.
    ///
    /// ```
    /// use ndarray::{Array3, array};
    /// use sci_forward::{MaskOperator, MaskStack, Measurement};
    /// use std::sync::Arc;
    ///
    /// let h = Arc::new(MaskOperator::new(MaskStack::new(Array3::ones((2, 1, 3)))?));
    /// let measurement = Measurement::new(h, array![[0.5, 1.0, 1.0]])?.with_clip(Some(1.0));
    /// let mut y = [0.5, 1.0, 1.0];
    /// measurement.one_sided(&mut y, &[0.7, 0.7, 1.3]);
    /// assert_eq!(y, [0.5, 1.0, 1.3]);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # References
    /// The constraint set of a clipped sample: Foucart, Needham, *Sparse recovery from saturated measurements*, 2017.
    pub fn one_sided(&self, y: &mut [f32], hx: &[f32]) {
        if let Some(level) = self.clip {
            for (y, hx) in y.iter_mut().zip(hx) {
                *y = if *y >= level && *hx > *y { *hx } else { *y };
            }
        }
    }

    /// y `[H, W]` as `H x` is to be compared with it: [one-sided](Self::one_sided) where it is clipped.
    ///
    /// # Panics
    /// If the sizes differ.
    pub fn y_against(&self, hx: ArrayView2<'_, f32>) -> Array2<f32> {
        let mut y = self.y.clone();
        Zip::from(&mut y).and(hx).for_each(|y, hx| self.one_sided(std::slice::from_mut(y), std::slice::from_ref(hx)));
        y
    }

    /// The variance of the noise of each pixel `[H, W]`, where noise is known of.
    pub fn variance(&self) -> Option<ArrayView2<'_, f32>> {
        self.variance.as_ref().map(|variance| variance.view())
    }

    /// The least `diag(H Hᵀ)` of a pixel that tells something of the video: a fiftieth of the mean of those that are open at all. Errors
    /// are compared over that number, so that noise at a pixel of less would outweigh fifty others; of binary masks hardly any pixel is so.
    ///
    /// ```
    /// use ndarray::array;
    /// use sci_forward::{MaskOperator, MaskStack, Measurement};
    /// use std::sync::Arc;
    ///
    /// let h = Arc::new(MaskOperator::new(MaskStack::new(array![[[1.0, 1.0, 0.01, 0.0]]])?));
    /// let least = Measurement::new(h, array![[0.5, 0.2, 0.1, 0.0]])?.least_telling();
    /// assert!(least > 0.01 * 0.01 && least < 1.0);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn least_telling(&self) -> f32 {
        let open = self.operator.gram();
        let (sum, count) = open.iter().filter(|&&g| g > 0.0).fold((0.0, 0), |(sum, n), &g| (sum + f64::from(g), n + 1));
        (sum / (50 * count.max(1)) as f64) as f32
    }

    /// `H`.
    pub fn operator(&self) -> &dyn SensingOperator {
        &*self.operator
    }

    /// `H`, to be kept.
    pub fn shared_operator(&self) -> &Arc<dyn SensingOperator> {
        &self.operator
    }

    /// The measured image `[H, W]`, in row-major order.
    pub fn y(&self) -> ArrayView2<'_, f32> {
        self.y.view()
    }

    /// The color filter array of a color sensor.
    pub fn cfa(&self) -> Option<CfaPattern> {
        self.cfa
    }

    /// The size of the video where the sensor sees it.
    pub fn shape(&self) -> VideoShape {
        self.operator.shape()
    }

    /// Channels of the video: 3 of a color sensor's RGB, else 1.
    pub fn channels(&self) -> usize {
        if self.cfa.is_some() { 3 } else { 1 }
    }

    /// What a residual `‖y − H x‖` is divided by: `‖y‖` over the open pixels. A black measurement has no scale of its own: the square
    /// root of their number, a residual in units of the full scale.
    pub fn scale(&self) -> f64 {
        self.scale
    }

    /// The measurement without the pixels where `measured` `[H, W]` is false: the operator is [`Restricted`], and `y` is 0 there.
    ///
    /// # Errors
    /// [`MeasurementError::Size`] if `measured` has not the size of the measurement, [`MeasurementError::AllClosed`] if no open
    /// pixel is left.
    ///
    /// ```
    /// use ndarray::{Array3, array};
    /// use sci_forward::{MaskOperator, MaskStack, Measurement};
    /// use std::sync::Arc;
    ///
    /// let h = Arc::new(MaskOperator::new(MaskStack::new(Array3::ones((2, 1, 2)))?));
    /// let whole = Measurement::new(h, array![[3.0, 4.0]])?;
    /// let part = whole.restricted(array![[true, false]].view())?;
    /// assert_eq!((whole.scale(), part.scale()), (5.0, 3.0));
    /// assert_eq!(part.y(), array![[3.0, 0.0]]);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn restricted(&self, measured: ArrayView2<'_, bool>) -> Result<Self, MeasurementError> {
        check("map of measured pixels", measured.shape(), self.shape().image_dim().into())?;
        let y = Zip::from(&self.y).and(measured).map_collect(|&y, &keep| if keep { y } else { 0.0 });
        let operator = Arc::new(Restricted::new(self.operator.clone(), measured));
        Ok(Self { cfa: self.cfa, variance: self.variance.clone(), clip: self.clip, ..Self::new(operator, y)? })
    }

    /// `r = H T v − y` `[H, W]` of a video `[T, C, H, W]`, 0 at the pixels that are not open, and at clipped ones that get more light than
    /// they measure.
    ///
    /// # Errors
    /// [`MeasurementError::Size`] if `video` is not `[T, C, H, W]` with [`channels`](Self::channels) for C.
    pub fn residual(&self, video: ArrayView4<'_, f32>) -> Result<Array2<f32>, MeasurementError> {
        let (t, h, w) = self.shape().dim();
        check("video", video.shape(), [t, self.channels(), h, w])?;
        let mut residual = match self.cfa {
            None => self.operator.forward(video.index_axis_move(Axis(1), 0)),
            Some(cfa) => {
                let mut mosaic = Array3::zeros((t, h, w));
                mosaic_into(cfa, video, mosaic.view_mut());
                self.operator.forward(mosaic.view())
            }
        };
        residual -= &self.y_against(residual.view());
        close(residual.view_mut(), self.operator.gram());
        Ok(residual)
    }

    /// `Tᵀ Hᵀ g` `[T, C, H, W]` of an image `g` `[H, W]`: in frame t `C_t ⊙ g`, in the channel that the pixel sees.
    ///
    /// # Panics
    /// If `g` has not the size of the measurement.
    ///
    /// ```
    /// use ndarray::{Array3, array};
    /// use sci_forward::{CfaPattern, MaskOperator, MaskStack, Measurement};
    /// use std::sync::Arc;
    ///
    /// let h = Arc::new(MaskOperator::new(MaskStack::new(Array3::ones((1, 1, 2)))?));
    /// let gray = Measurement::new(h, array![[1.0, 1.0]])?;
    /// assert_eq!(gray.pull_back(array![[3.0, 4.0]].view()), array![[[[3.0, 4.0]]]]);
    /// let color = gray.with_cfa(Some(CfaPattern::Rggb));
    /// assert_eq!(color.pull_back(array![[3.0, 4.0]].view()), array![[[[3.0, 0.0]], [[0.0, 4.0]], [[0.0, 0.0]]]]);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn pull_back(&self, g: ArrayView2<'_, f32>) -> Array4<f32> {
        let mosaic = self.operator.adjoint(g);
        let Some(cfa) = self.cfa else { return mosaic.insert_axis(Axis(1)) };
        let (t, h, w) = mosaic.dim();
        let mut rgb = Array4::zeros((t, 3, h, w));
        mosaic_adjoint_into(cfa, mosaic.view(), rgb.view_mut());
        rgb
    }
}

impl std::fmt::Debug for Measurement {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Measurement").field("shape", &self.shape()).field("cfa", &self.cfa).finish_non_exhaustive()
    }
}

fn check<const N: usize>(what: &'static str, found: &[usize], expected: [usize; N]) -> Result<(), MeasurementError> {
    if found == expected {
        return Ok(());
    }
    Err(MeasurementError::Size { what, expected: expected.to_vec(), found: found.to_vec() })
}
