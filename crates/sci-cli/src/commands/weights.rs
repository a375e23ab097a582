//! `sci weights`: what is in a weight file, and other forms of it.

use std::path::{Path, PathBuf};

use nets::WeightFile;
use nets::weights::{self, Storage};

use super::Done;

/// Sub-commands of `sci weights`.
#[derive(Debug, clap::Subcommand)]
pub(super) enum Command {
    /// Name the network a file belongs to, and list its tensors
    Inspect {
        /// A .pth or .safetensors file, or bundled:NAME
        file: PathBuf,
    },
    /// Write a .pth or .safetensors file as .safetensors
    Convert {
        /// The file to read, or bundled:NAME
        input: PathBuf,
        /// The .safetensors file to write
        output: PathBuf,
        /// Fold batch norm into the convolutions
        #[arg(long)]
        fold: bool,
        /// Store 16 bits a number: half the size, relative error up to 0.05 %
        #[arg(long)]
        half: bool,
    },
    /// Write weights that are a share of the way from some to others of the same network, which have most of what both know
    Blend {
        /// Where the way begins: a .pth or .safetensors file, or bundled:NAME
        from: PathBuf,
        /// Where it ends
        to: PathBuf,
        /// 0 to 1
        share: f64,
        /// The .safetensors file to write
        output: PathBuf,
        /// Store 16 bits a number
        #[arg(long)]
        half: bool,
    },
}

impl Command {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        match self {
            Self::Inspect { file } => inspect(&file)?,
            Self::Convert { input, output, fold, half } => {
                weights::convert(&input, &output, fold, storage(half))?;
                outln!("{}", output.display());
            }
            Self::Blend { from, to, share, output, half } => {
                weights::blend(&from, &to, share, &output, storage(half))?;
                outln!("{}", output.display());
            }
        }
        Ok(Done::Complete)
    }
}

fn storage(half: bool) -> Storage {
    if half { Storage::F16 } else { Storage::F32 }
}

fn inspect(file: &Path) -> anyhow::Result<()> {
    let weights = WeightFile::read(file)?;
    let summary = weights.summary();
    let width = summary.iter().map(|t| t.name.len()).max().unwrap_or(0);
    for t in &summary {
        outln!("{:width$}  {:<5} {:?}", t.name, t.dtype, t.shape);
    }
    outln!("{} tensors, {} values", summary.len(), weights.value_count());
    // Building the network also checks that every tensor it needs is there.
    let network = nets::Architecture::load(weights, nets::Ends::Circular)?;
    outln!("network: {}, {} parameters", network.describe(), network.parameter_count());
    Ok(())
}
