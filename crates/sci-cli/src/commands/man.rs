//! `sci man`: the manual pages, of the program and of each command.

use std::fs;
use std::path::PathBuf;

use clap::CommandFactory;

use super::{Cli, Done, check_folder};
use crate::io::output::WriteError;

/// Arguments of `sci man`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// The folder for sci.1, sci-run.1 and so on
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

impl Args {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        check_folder(&self.out)?;
        let failed = |e| WriteError::new(&self.out, e);
        fs::create_dir_all(&self.out).map_err(failed)?;
        clap_mangen::generate_to(Cli::command(), &self.out).map_err(failed)?;
        outln!("wrote {}", self.out.join("sci.1").display());
        Ok(Done::Complete)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_command_has_a_page() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("man1");
        Args { out: out.clone() }.run().unwrap();
        let page = |name: &str| fs::read_to_string(out.join(name)).unwrap();
        assert!(page("sci.1").contains("calibrate"));
        for command in Cli::command().get_subcommands() {
            assert!(page(&format!("sci-{}.1", command.get_name())).contains("SYNOPSIS"));
        }
        assert!(page("sci-run.1").contains("resume"));
    }
}
