//! The forward model of video snapshot compressive imaging, and nothing else: no solver, no file format, no network.
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
//! use sci_forward::{MaskOperator, MaskStack, SensingOperator, VideoShape};
//!
//! let shape = VideoShape { frames: 8, height: 6, width: 5 };
//! let operator = MaskOperator::new(MaskStack::random(shape, 0.5, 0)?);
//! let y = operator.forward(Array3::from_elem(shape.dim(), 0.5).view());
//! assert_eq!(y.dim(), (6, 5));
//! # Ok::<(), sci_forward::MaskError>(())
//! ```
//!
//! # References
//! Wu et al., *Adaptive Deep PnP Algorithm for Video Snapshot Compressive Imaging*, section 2.

pub mod bayer;
mod mask;
pub mod metrics;
mod noise;
mod operator;
#[cfg(any(test, feature = "testing"))]
pub mod testing;

pub use bayer::{CfaPattern, Demosaicer};
pub use mask::{MaskError, MaskStack, held_in};
pub use noise::{Noise, NoiseError};
pub use operator::{DataStep, MaskOperator, Progress, SensingOperator};

/// The error type at the seams where a plug-in (a denoiser, a demosaicer, an observer) reports to code that cannot know its errors.
pub type BoxError = Box<dyn std::error::Error + Send + Sync + 'static>;

/// The size of a gray or mosaic video `[T, H, W]`: `frames` × `height` × `width` pixels.
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
