//! A gain for each frame.

use super::MaskSource;
use crate::masks::validated;
use crate::{MaskError, VideoShape};

/// The masks of another source, each frame's times a gain of its own: `C_t = g_t S_t`.
///
/// A light that flickers, a shutter of uneven times, or a source in other units need no copy of the masks.
///
/// ```
/// use ndarray::{Array3, array};
/// use sci_forward::{Gained, MaskOperator, MaskStack, SensingOperator};
///
/// let masks = MaskStack::new(Array3::ones((2, 1, 1)))?;
/// let h = MaskOperator::new(Gained::new(masks, vec![0.5, 2.0])?);
/// assert_eq!(h.forward(array![[[0.4]], [[0.3]]].view()), array![[0.8]]);
/// # Ok::<(), sci_forward::MaskError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Gained<S> {
    source: S,
    gain: Vec<f32>,
}

impl<S: MaskSource> Gained<S> {
    /// Takes a gain ≥ 0 for each frame of `source`.
    ///
    /// # Errors
    /// [`MaskError::Count`] if there is not one gain a frame, [`MaskError::Value`] if a transmittance is then out of range,
    /// [`MaskError::AllClosed`] if none is left open.
    pub fn new(source: S, gain: Vec<f32>) -> Result<Self, MaskError> {
        let frames = source.shape().frames;
        if gain.len() != frames {
            return Err(MaskError::Count { what: "gains", expected: frames, found: gain.len() });
        }
        validated(Self { source, gain })
    }
}

impl<S: MaskSource> MaskSource for Gained<S> {
    fn shape(&self) -> VideoShape {
        self.source.shape()
    }

    fn fill(&self, frame: usize, row: usize, start: usize, out: &mut [f32]) {
        self.source.fill(frame, row, start, out);
        let gain = self.gain[frame];
        out.iter_mut().for_each(|v| *v *= gain);
    }
}
