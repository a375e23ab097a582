//! Owns how errors become exceptions: what the caller can mend is a `ValueError`, what the system says an `OSError`, what a denoiser in
//! Python raises is raised as it is, and the rest is a `RuntimeError`. The message is that of the `sci` command.

use std::error::Error;

use pyo3::exceptions::{PyOSError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use sci_cli::commands::{UsageError, chain};
use sci_cli::io::scene::SceneError;
use sci_cli::io::{FileError, ReadError};
use sci_cli::table::{ConfigError, Place};

/// The exception of an error.
pub(crate) fn raised(error: anyhow::Error) -> PyErr {
    if let Some(raised) = error.chain().find_map(|cause| cause.downcast_ref::<PyErr>()) {
        return Python::attach(|py| noted(py, raised.clone_ref(py), &error));
    }
    let message = message(&error);
    if error.chain().any(|cause| matches!(cause.downcast_ref(), Some(ReadError::Io(_))) || cause.is::<std::io::Error>())
    {
        PyOSError::new_err(message)
    } else if error.chain().any(is_the_callers) {
        PyValueError::new_err(message)
    } else {
        PyRuntimeError::new_err(message)
    }
}

/// That a standard deviation is in units of white.
pub(crate) fn in_units_of_white(name: &str, sigma: f64) -> PyResult<()> {
    match (0.0..=1.0).contains(&sigma) {
        true => Ok(()),
        false => Err(refused(format!("{name} = {sigma} is not legal; legal: 0 to 1 (25 / 255, not 25)"))),
    }
}

/// Says with an exception that came from Python where in the solve that was.
fn noted(py: Python<'_>, raised: PyErr, error: &anyhow::Error) -> PyErr {
    let value = raised.value(py);
    // Python 3.10 has no notes.
    if value.hasattr("add_note").unwrap_or(false) {
        let _ = value.call_method1("add_note", (error.to_string(),));
    }
    raised
}

/// Whether the caller gave what is wrong.
fn is_the_callers(cause: &(dyn Error + 'static)) -> bool {
    cause.is::<ConfigError>()
        || cause.is::<UsageError>()
        || cause.is::<SceneError>()
        || cause.is::<FileError>()
        || cause.is::<ReadError>()
        || cause.is::<Refused>()
        || cause.is::<sci_forward::MaskError>()
        || cause.is::<sci_forward::NoiseError>()
        || cause.is::<sci_forward::ReadoutError>()
        || cause.is::<sci_forward::MeasurementError>()
        || cause.is::<admm::CalibrateError>()
        || matches!(
            cause.downcast_ref(),
            Some(admm::SolveError::Size { .. } | admm::SolveError::NotFinite { .. } | admm::SolveError::Setting { .. })
        )
}

fn message(error: &anyhow::Error) -> String {
    match error.downcast_ref() {
        // Here no one has written --set; the problem names the key, the value and what is legal.
        Some(ConfigError { place: Place::Set(_), problem }) => problem.clone(),
        _ => chain(error),
    }
}

/// An argument that is not legal, and what is.
#[derive(Debug)]
pub(crate) struct Refused(pub(crate) String);

impl std::fmt::Display for Refused {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.0)
    }
}

impl Error for Refused {}

/// An error of which only what the system says is not the caller's fault.
pub(crate) fn callers(error: anyhow::Error) -> anyhow::Error {
    if error.chain().any(|cause| cause.is::<std::io::Error>()) { error } else { Refused(chain(&error)).into() }
}

/// A `ValueError`.
pub(crate) fn refused(message: impl Into<String>) -> PyErr {
    PyValueError::new_err(message.into())
}
