//! What can go wrong in this crate.

/// An error of adaptation.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The network, its tensors or a weight file.
    #[error(transparent)]
    Net(Box<nets::Error>),
    /// The network refused to denoise.
    #[error("the network could not denoise")]
    Denoiser(#[source] admm::BoxError),
    /// Measurement and masks differ in size, or a video is not theirs.
    #[error("the {what} is {found:?}, the masks ask for {expected:?}")]
    Size {
        /// Which array.
        what: &'static str,
        /// The size it must have.
        expected: Vec<usize>,
        /// The size it has.
        found: Vec<usize>,
    },
    /// The measurement holds a NaN or an infinity.
    #[error("the measurement is {value} at row {row}, column {column}: every value must be finite")]
    NotFinite {
        /// The value.
        value: f32,
        /// Its row.
        row: usize,
        /// Its column.
        column: usize,
    },
    /// A gray network for a color sensor, or the other way round.
    #[error("{network} has {found} channel(s); a {sensor} sensor needs {expected}")]
    Channels {
        /// The network.
        network: String,
        /// "gray" or "color".
        sensor: &'static str,
        /// Channels of a frame.
        expected: usize,
        /// Channels of the network.
        found: usize,
    },
    /// A setting outside its range.
    #[error("{key} = {value}: {legal}")]
    Setting {
        /// The setting.
        key: &'static str,
        /// The value given.
        value: String,
        /// What is legal.
        legal: &'static str,
    },
    /// Solving a measurement of a sequence failed.
    #[error("measurement {index} could not be solved")]
    Solve {
        /// Its number, from 0.
        index: usize,
        /// Why.
        source: Box<admm::SolveError>,
    },
}

impl From<nets::Error> for Error {
    fn from(error: nets::Error) -> Self {
        Self::Net(Box::new(error))
    }
}

impl From<candle_core::Error> for Error {
    fn from(error: candle_core::Error) -> Self {
        Self::Net(Box::new(error.into()))
    }
}
