//! `sci train`: a training run from its file to weights, resumable.

mod data;
mod log;
mod run;

use std::path::{Path, PathBuf};

use anyhow::Context;
use nets::WeightFile;
use nets::kernels::keep_freed_memory;
use nets::train::Trainer;

use super::{Done, UsageError, catch_interrupts, check_folder};
use crate::run_folder::{LOCK, locked};
use crate::training::{CHECKPOINT, Training};
use log::Log;
use run::Run;

/// Arguments of `sci train`.
///
/// A run that was stopped, by whatever, goes on with --resume from its last checkpoint. If the loss is no longer finite, it goes back
/// by itself to the checkpoint before the last, with half the learning rate from there on.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// The training file, TOML
    config: PathBuf,
    /// Override a key of the file: --set training.steps=100
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Where to write [default: runs/train-<name>]. Without --resume nothing there is replaced
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Continue from the checkpoint in the output folder, bit for bit as if never stopped; with the same settings only
    #[arg(long)]
    resume: bool,
}

impl Args {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        let training = Training::read(&self.config, &self.set)?;
        let name = &training.config.name;
        let files = Files::new(self.out.unwrap_or_else(|| Path::new("runs").join(format!("train-{name}"))), name);
        files.check(self.resume)?;
        let weights = if self.resume { None } else { training.weights()? };
        catch_interrupts()?;
        keep_freed_memory();
        let data = data::load(&training)?;
        outln!("{} clips, {} photos, {} validation clips", data.videos.len(), data.photos.len(), data.validation.len());
        let mut trainer = Trainer::new(training.config, data)?;
        if let Some(weights) = weights {
            let place = || format!("{}: beginning with weights", self.config.display());
            trainer.start_from(&WeightFile::read(&weights)?.into_tensors()).with_context(place)?;
        }
        outln!("{}, {} parameters", trainer.describe(), trainer.parameter_count());
        std::fs::create_dir_all(&files.folder).with_context(|| format!("cannot create {}", files.folder.display()))?;
        let Some(held) = locked(&files.folder)? else {
            let folder = files.folder.display();
            return Err(UsageError(format!("--out {folder}: another training is at work there")).into());
        };
        if self.resume {
            let resumed = trainer.resume(&files.checkpoint)?;
            if let Some(error) = resumed.refused {
                eprintln!("warning: {error}; going on from {}", resumed.from.display());
            }
            outln!("resumed at step {}", trainer.steps_done());
        }
        let log = Log::open(&files.log, trainer.steps_done())?;
        let lock = files.folder.join(LOCK);
        let done = Run::new(trainer, log, files).finish();
        std::fs::remove_file(lock).ok();
        drop(held);
        done
    }
}

/// The files of a run.
struct Files {
    folder: PathBuf,
    checkpoint: PathBuf,
    /// The one before it.
    previous: PathBuf,
    log: PathBuf,
    plot: PathBuf,
    weights: PathBuf,
}

impl Files {
    fn new(folder: PathBuf, name: &str) -> Self {
        Self {
            checkpoint: folder.join(format!("{CHECKPOINT}.safetensors")),
            previous: folder.join(format!("{CHECKPOINT}.previous.safetensors")),
            log: folder.join("log.jsonl"),
            plot: folder.join("loss.svg"),
            weights: folder.join(format!("{name}.safetensors")),
            folder,
        }
    }

    /// Refuses to write over what is not the run's, and to go on with a run that is not there.
    fn check(&self, resume: bool) -> Result<(), UsageError> {
        check_folder(&self.folder)?;
        let (folder, is_there) = (self.folder.display(), |file: &&PathBuf| file.symlink_metadata().is_ok());
        if resume {
            if [&self.checkpoint, &self.previous].iter().any(is_there) {
                return Ok(());
            }
            return Err(UsageError(format!("--resume: {folder} holds no run to go on with: there is no checkpoint")));
        }
        match [&self.checkpoint, &self.previous, &self.log, &self.plot, &self.weights].into_iter().find(is_there) {
            None => Ok(()),
            Some(file) => Err(UsageError(format!(
                "--out {folder}: {} is there already; give --resume to go on with the run, or another --out",
                file.display()
            ))),
        }
    }
}
