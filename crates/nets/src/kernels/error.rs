//! What callers of the kernels can do wrong.

/// A rule of the kernels that a call broke.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum KernelError {
    /// `SCI_KERNEL` names no instruction set.
    #[error("SCI_KERNEL is {0:?}; it can be amx, avx512, avx2, neon or portable")]
    UnknownIsa(String),
    /// This machine lacks the instruction set.
    #[error("this machine has no {0}")]
    MissingIsa(&'static str),
    /// A slice is not as long as its shape says.
    #[error("{found} numbers where the shape has {expected}")]
    Length {
        /// By the shape.
        expected: usize,
        /// In the slice.
        found: usize,
    },
    /// An image's channels are not those of the convolution.
    #[error("{found} channels go into a convolution of {expected}")]
    Channels {
        /// Of the convolution.
        expected: usize,
        /// Of the image.
        found: usize,
    },
    /// The image is in a form of the matrix unit that the convolution is not for.
    #[error("an image for the matrix unit goes into a convolution for another form")]
    Form,
    /// The stride is neither 1 nor 2.
    #[error("stride {0}; it can be 1 or 2")]
    Stride(usize),
    /// The groups do not divide the channels.
    #[error("{groups} groups do not divide {inputs} input and {outputs} output channels")]
    Groups {
        /// Number of groups.
        groups: usize,
        /// Input channels.
        inputs: usize,
        /// Output channels.
        outputs: usize,
    },
    /// The image or the batch is empty.
    #[error("an empty image: {0:?}")]
    Empty([usize; 4]),
}
