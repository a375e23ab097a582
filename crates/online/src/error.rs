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
    /// A video does not belong to the measurement.
    #[error(transparent)]
    Measurement(#[from] sci_forward::MeasurementError),
    /// An update is due where the measurement is not in sight.
    #[error(
        "an update is due in iteration {iteration}, but the denoiser is not told the measurement: an adaptive denoiser must be \
         shown the whole video as the sensor saw it, not mirrored or in parts"
    )]
    NoMeasurement {
        /// The iteration, counted from 0.
        iteration: usize,
    },
    /// No pixel that judges is open in any crop.
    #[error(
        "no pixel is left to judge adaptation by: the measurement is too small, or too few of its pixels are measured"
    )]
    NothingToJudge,
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
