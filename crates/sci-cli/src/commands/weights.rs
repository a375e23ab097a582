//! `sci weights`: what is in a weight file.

use std::path::PathBuf;

use nets::{Ffdnet, Network, WeightFile, weights::Architecture};

use super::Done;

/// Sub-commands of `sci weights`.
#[derive(Debug, clap::Subcommand)]
pub(super) enum Command {
    /// Name the network a file belongs to, and list its tensors
    Inspect {
        /// A .pth or .safetensors file, or bundled:NAME
        file: PathBuf,
    },
}

impl Command {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        let Self::Inspect { file } = self;
        let weights = WeightFile::read(&file)?;
        let summary = weights.summary();
        let width = summary.iter().map(|t| t.name.len()).max().unwrap_or(0);
        for t in &summary {
            outln!("{:width$}  {:<5} {:?}", t.name, t.dtype, t.shape);
        }
        let count = weights.value_count();
        outln!("{} tensors, {count} values", summary.len());
        // Building the network also checks that every tensor it needs is there.
        let description = match weights.architecture()? {
            Architecture::Ffdnet(_) => Ffdnet::from_weights(weights)?.describe(),
            other => other.to_string(),
        };
        outln!("network: {description}");
        Ok(Done::Complete)
    }
}
