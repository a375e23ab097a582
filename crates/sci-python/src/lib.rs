//! The `sci` module of Python. It owns the way between NumPy and the crates, and nothing else: what is solved, read, checked and said is
//! that of the `sci` command, so that both give the same numbers and the same messages.
//!
//! Arrays come in as views where they are f32 already, results go out as the memory they were made in. Work is done with the
//! interpreter free for other threads; Ctrl-C ends a solve after the iteration in work.

mod arrays;
mod calibration;
mod denoisers;
mod failure;
mod operator;
mod pool;
mod quality;
mod reconstruct;
mod settings;
mod solvers;

use clap::Parser;
use pyo3::prelude::*;

/// Runs the `sci` command with these arguments, the first of which is its name, and ends the process.
#[pyfunction]
fn run_command(py: Python<'_>, arguments: Vec<String>) {
    // A process that only runs a command ends with it, and with what Rust has not written yet.
    py.detach(|| std::process::exit(sci_cli::commands::Cli::parse_from(arguments).execute().into()))
}

/// The names of the experiments that come with the program, such as "gray/default".
#[pyfunction]
fn experiments() -> Vec<&'static str> {
    sci_cli::shipped::names().collect()
}

/// The native part of the package sci.
#[pymodule]
fn _sci(m: &Bound<'_, PyModule>) -> PyResult<()> {
    m.add("__version__", sci_cli::record::host::VERSION)?;
    m.add_class::<operator::MaskOperator>()?;
    m.add_class::<denoisers::Denoiser>()?;
    m.add_class::<solvers::Gap>()?;
    m.add_class::<solvers::Admm>()?;
    m.add_class::<solvers::TwoStage>()?;
    m.add_function(wrap_pyfunction!(reconstruct::reconstruct, m)?)?;
    m.add_function(wrap_pyfunction!(calibration::calibrate, m)?)?;
    m.add_function(wrap_pyfunction!(operator::random_masks, m)?)?;
    m.add_function(wrap_pyfunction!(operator::shifting_masks, m)?)?;
    m.add_function(wrap_pyfunction!(operator::simulate, m)?)?;
    m.add_function(wrap_pyfunction!(quality::psnr, m)?)?;
    m.add_function(wrap_pyfunction!(quality::ssim, m)?)?;
    m.add_function(wrap_pyfunction!(experiments, m)?)?;
    m.add_function(wrap_pyfunction!(run_command, m)?)?;
    Ok(())
}
