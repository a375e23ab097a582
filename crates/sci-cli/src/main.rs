//! The `sci` binary: parses arguments, hands over to the library, returns its exit code.

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    sci_cli::commands::Cli::parse().execute()
}
