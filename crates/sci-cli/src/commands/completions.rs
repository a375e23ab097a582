//! `sci completions`: what makes a shell complete the commands and their arguments.

use std::io::{self, Write};

use anyhow::Context;
use clap::CommandFactory;
use clap_complete::{Shell, generate};

use super::{Cli, Done};

/// Arguments of `sci completions`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// The shell
    shell: Shell,
}

impl Args {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        let mut script = Vec::new();
        generate(self.shell, &mut Cli::command(), "sci", &mut script);
        io::stdout().write_all(&script).context("cannot write to the standard output")?;
        Ok(Done::Complete)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::ValueEnum;

    #[test]
    fn every_shell_knows_every_command() {
        for shell in Shell::value_variants() {
            let mut script = Vec::new();
            generate(*shell, &mut Cli::command(), "sci", &mut script);
            let script = String::from_utf8(script).unwrap();
            for command in Cli::command().get_subcommands() {
                assert!(script.contains(command.get_name()), "{shell}: {}", command.get_name());
            }
        }
    }
}
