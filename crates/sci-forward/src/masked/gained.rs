//! A gain for each frame.

use super::MaskSource;
use crate::masks::validated;
use crate::{MaskError, VideoShape};
use multiversion::multiversion;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

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
    /// Takes a gain for each frame of `source`; one below 0 turns the signs of its mask.
    ///
    /// # Errors
    /// [`MaskError::Count`] if there is not one gain a frame, [`MaskError::Value`] if a value is then out of range,
    /// [`MaskError::AllClosed`] if none is left open.
    pub fn new(source: S, gain: Vec<f32>) -> Result<Self, MaskError> {
        let frames = source.shape().frames;
        if gain.len() != frames {
            return Err(MaskError::Count { what: "gains", expected: frames, found: gain.len() });
        }
        validated(Self { source, gain })
    }

    /// A light that flickers: the gains are 1 in the mean, with this standard deviation, and none is negative.
    ///
    /// # Errors
    /// As [`Gained::new`].
    ///
    /// ```
    /// use sci_forward::{Gained, MaskSource, MaskStack, VideoShape};
    /// let masks = MaskStack::random(VideoShape { frames: 2, height: 4, width: 4 }, 1.0, 0)?;
    /// let flickering = MaskStack::from_source(&Gained::flickering(masks, 0.1, 5)?)?;
    /// assert!(flickering.view()[[0, 0, 0]] != flickering.view()[[1, 0, 0]]);
    /// # Ok::<(), sci_forward::MaskError>(())
    /// ```
    pub fn flickering(source: S, spread: f64, seed: u64) -> Result<Self, MaskError> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut gain = || {
            let draw: f64 = StandardNormal.sample(&mut rng);
            (1.0 + spread * draw).max(0.0) as f32
        };
        let gains = (0..source.shape().frames).map(|_| gain()).collect();
        Self::new(source, gains)
    }
}

impl<S: MaskSource> MaskSource for Gained<S> {
    fn shape(&self) -> VideoShape {
        self.source.shape()
    }

    fn fill(&self, frame: usize, row: usize, start: usize, out: &mut [f32]) {
        match self.source.stored(frame, row) {
            Some(stored) => write_scaled(out, &stored[start..], self.gain[frame]),
            None => {
                self.source.fill(frame, row, start, out);
                scale(out, self.gain[frame]);
            }
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn write_scaled(to: &mut [f32], from: &[f32], gain: f32) {
    let from = &from[..to.len()];
    for (to, from) in to.iter_mut().zip(from) {
        *to = gain * from;
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn scale(values: &mut [f32], gain: f32) {
    for value in values {
        *value *= gain;
    }
}
