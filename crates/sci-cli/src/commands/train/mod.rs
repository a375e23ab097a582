//! `sci train`: a training run from its file to weights, resumable.

mod data;
mod log;

use std::io::{IsTerminal, stderr};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};
use nets::kernels::keep_freed_memory;
use nets::train::{TrainConfig, Trainer};
use nets::weights::Storage;

use super::{Done, UsageError, catch_interrupts, interrupted};
use crate::table::{ConfigError, Paths, Source, Table};
use log::Log;

/// Time between progress lines where there is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(30);

/// Arguments of `sci train`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// The training file, TOML
    config: PathBuf,
    /// Override a key of the file: --set training.steps=100
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Where to write [default: runs/train-<name>]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Continue from the checkpoint in the output folder, bit for bit as if never stopped
    #[arg(long)]
    resume: bool,
}

impl Args {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        let config = load(&self.config, &self.set)?;
        let out = self.out.unwrap_or_else(|| Path::new("runs").join(format!("train-{}", config.name)));
        let checkpoint = out.join("checkpoint.safetensors");
        if !self.resume && checkpoint.exists() {
            let text = format!("{}: a run is there already; give --resume or another --out", out.display());
            return Err(UsageError(text).into());
        }
        std::fs::create_dir_all(&out).with_context(|| format!("cannot create {}", out.display()))?;
        catch_interrupts()?;
        keep_freed_memory();
        let data = data::load(&config, &self.config)?;
        outln!("{} clips, {} photos, {} validation clips", data.videos.len(), data.photos.len(), data.validation.len());
        let start = config.weights.as_ref().map(|path| data::weights(path, &self.config)).transpose()?;
        let mut trainer = Trainer::new(config, data)?;
        if let Some(weights) = start {
            let place = || format!("{}: beginning with weights", self.config.display());
            trainer.start_from(&weights.into_tensors()).with_context(place)?;
        }
        outln!("{}, {} parameters", trainer.describe(), trainer.parameter_count());
        if self.resume {
            let resumed = trainer.resume(&checkpoint)?;
            if let Some(error) = resumed.refused {
                eprintln!("warning: {error}; going on from {}", resumed.from.display());
            }
            outln!("resumed at step {}", trainer.steps_done());
        }
        let log = Log::open(&out.join("log.jsonl"), trainer.steps_done())?;
        Run { trainer, log, checkpoint, out }.finish()
    }
}

/// Reads and checks a training file.
fn load(path: &Path, arguments: &[String]) -> Result<TrainConfig, ConfigError> {
    let source = Source::read(path, "training", arguments)?;
    let config: TrainConfig = Table::root(&source, Paths::AsWritten)?.deserialize()?;
    config.validate().map_err(|error| match &error {
        nets::Error::Setting { key, .. } => source.error_at(key, error.to_string()),
        other => source.file_error(other.to_string()),
    })?;
    Ok(config)
}

/// A run with its files.
struct Run {
    trainer: Trainer,
    log: Log,
    checkpoint: PathBuf,
    out: PathBuf,
}

impl Run {
    fn finish(mut self) -> anyhow::Result<Done> {
        let (total, start) = (self.trainer.config().training.steps, self.trainer.steps_done());
        let bar = bar(total, start);
        let (begun, mut last_line) = (Instant::now(), Instant::now());
        while !self.trainer.finished() && !interrupted() {
            let report = self.trainer.step()?;
            self.log.step(&report)?;
            let done = report.step;
            let config = self.trainer.config();
            let (validate, save) =
                (done % config.validation.every == 0 || done == total, done % config.checkpoint.every == 0);
            let message = self.log.message();
            match &bar {
                Some(bar) => {
                    bar.set_position(done);
                    bar.set_message(message);
                }
                None if last_line.elapsed() >= LINE_EVERY => {
                    last_line = Instant::now();
                    let each = begun.elapsed().as_secs_f64() / (done - start) as f64;
                    let left = Duration::from_secs((each * (total - done) as f64) as u64);
                    eprintln!("step {done} of {total}   {message}   {:.2} steps/s   {left:?} left", 1.0 / each);
                }
                None => {}
            }
            if validate {
                let scores = self.trainer.validate()?;
                let text = self.log.validation(done, &scores)?;
                match &bar {
                    Some(bar) => bar.println(text),
                    None => eprintln!("{text}"),
                }
                self.log.plot(&self.out.join("loss.svg"))?;
            }
            if save {
                self.save()?;
            }
        }
        if let Some(bar) = bar {
            bar.finish_and_clear();
        }
        self.save()?;
        self.log.plot(&self.out.join("loss.svg"))?;
        let done = if self.trainer.finished() { Done::Complete } else { Done::Interrupted };
        if done == Done::Interrupted {
            eprintln!("stopped at step {}; --resume goes on from here", self.trainer.steps_done());
        }
        outln!("{}", self.weights().display());
        Ok(done)
    }

    fn weights(&self) -> PathBuf {
        self.out.join(format!("{}.safetensors", self.trainer.config().name))
    }

    fn save(&mut self) -> anyhow::Result<()> {
        // The log first: a checkpoint never lacks the lines before it.
        self.log.flush()?;
        self.trainer.save(&self.checkpoint)?;
        Ok(self.trainer.export(&self.weights(), Storage::F32)?)
    }
}

fn bar(total: u64, start: u64) -> Option<ProgressBar> {
    if !stderr().is_terminal() {
        return None;
    }
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len}  {msg}  {per_sec}  {eta} left")
        .expect("the template is fixed and has only known keys");
    let bar = ProgressBar::new(total).with_style(style).with_position(start);
    bar.reset_eta();
    Some(bar)
}
