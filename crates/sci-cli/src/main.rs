//! The `sci` binary: parses arguments, hands over to the library, returns its exit code.

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    keep_candle_to_one_thread();
    ExitCode::from(sci_cli::commands::Cli::parse().execute())
}

/// Candle's own threads spin while they wait, beside rayon's that have the work: 7 % of a training step on two cores.
fn keep_candle_to_one_thread() {
    const THREADS: &str = "CANDLE_NUM_THREADS";
    if std::env::var_os(THREADS).is_none() {
        // SAFETY: no other thread runs yet.
        unsafe { std::env::set_var(THREADS, "1") };
    }
}
