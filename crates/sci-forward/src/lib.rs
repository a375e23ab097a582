//! The forward model of video snapshot compressive imaging, and nothing else: no solver, no file format, no network.
//!
#![doc = include_str!("../README.md")]
//!
//! A camera modulates `T` fast frames `x_t`, each by its own mask `C_t`, and sums them into one image:
//!
//! ```text
//! y = Σ_t C_t ⊙ x_t + noise            y = H x + noise
//! ```
//!
//! Layouts everywhere: gray or mosaic video and masks `[T, H, W]`, RGB video `[T, 3, H, W]`, measurement `[H, W]`;
//! `f32`, row-major, frames in `[0, 1]`, so that `y` reaches `Σ_t C_t`.
//!
//! ```
//! use ndarray::Array3;
//! use sci_forward::{MaskOperator, MaskStack, Measurement, SensingOperator, VideoShape};
//! use std::sync::Arc;
//!
//! let shape = VideoShape { frames: 8, height: 6, width: 5 };
//! let h = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.5, 0)?));
//! // Frame t has the brightness t / 10: y is the sum of those that a pixel is open for.
//! let video = Array3::from_shape_fn(shape.dim(), |(t, ..)| t as f32 / 10.0);
//! let y = h.forward(video.view());
//! let open = h.source().view();
//! let expected: f32 = (0..8).map(|t| open[[t, 2, 3]] * t as f32 / 10.0).sum();
//! assert_eq!(y[[2, 3]], expected);
//!
//! // Operator and image together, checked once. The true video explains it.
//! let measurement = Measurement::new(h, y)?;
//! let residual = measurement.residual(video.insert_axis(ndarray::Axis(1)).view())?;
//! assert!(residual.iter().all(|r| *r == 0.0));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # References
//! Wu et al., *Adaptive Deep PnP Algorithm for Video Snapshot Compressive Imaging*, section 2.

pub mod bayer;
mod brightness;
mod masked;
mod masks;
mod measurement;
pub mod metrics;
mod mismatch;
mod noise;
mod operator;
mod readout;
#[cfg(any(test, feature = "testing"))]
pub mod testing;

pub use bayer::{CfaPattern, Demosaicer};
pub use brightness::brightness;
pub use masked::{BinaryMasks, Gained, MaskOperator, MaskSource, ShiftingMasks};
pub use masks::{MaskError, MaskStack};
pub use measurement::{Measurement, MeasurementError};
pub use mismatch::MaskMismatch;
pub use noise::{Noise, NoiseError};
pub use operator::{Restricted, SensingOperator};
pub use readout::{Readout, ReadoutError};

/// The error type at the seams where a plug-in (a denoiser, a demosaicer, an observer) reports to code that cannot know its errors.
pub type BoxError = Box<dyn std::error::Error + Send + Sync + 'static>;

/// The size of a gray or mosaic video `[T, H, W]`: `frames` × `height` × `width` pixels.
///
/// ```
/// let shape = sci_forward::VideoShape { frames: 8, height: 256, width: 320 };
/// assert_eq!((shape.dim(), shape.image_dim()), ((8, 256, 320), (256, 320)));
/// assert_eq!(shape.to_string(), "8 frames of 256×320");
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct VideoShape {
    /// T, the frames that one measurement sums (the compression ratio B).
    pub frames: usize,
    /// H, rows.
    pub height: usize,
    /// W, columns.
    pub width: usize,
}

impl VideoShape {
    /// The dimensions `(T, H, W)` of the video.
    pub fn dim(self) -> (usize, usize, usize) {
        (self.frames, self.height, self.width)
    }

    /// The dimensions `(H, W)` of the measurement.
    pub fn image_dim(self) -> (usize, usize) {
        (self.height, self.width)
    }
}

impl std::fmt::Display for VideoShape {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} frames of {}×{}", self.frames, self.height, self.width)
    }
}
