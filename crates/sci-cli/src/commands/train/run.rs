//! The loop of a training run: steps, validations, checkpoints, and what is shown of them.

use std::io::{IsTerminal, stderr};
use std::time::{Duration, Instant};

use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};
use nets::train::{StepReport, Trainer};
use nets::weights::Storage;

use super::super::{Done, interrupted};
use super::Files;
use super::log::Log;

/// Time between progress lines where there is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(30);

/// The share of the learning rate below which a run that diverges ends.
const LEAST_RATE: f64 = 1.0 / 64.0;

/// A run with its files.
pub(super) struct Run {
    trainer: Trainer,
    log: Log,
    files: Files,
    shown: Shown,
    /// The step of the newest checkpoint, if this run has written it.
    saved: Option<u64>,
}

impl Run {
    pub(super) fn new(trainer: Trainer, log: Log, files: Files) -> Self {
        let shown = Shown::new(trainer.config().training.steps, trainer.steps_done());
        Self { trainer, log, files, shown, saved: None }
    }

    pub(super) fn finish(mut self) -> anyhow::Result<Done> {
        if self.trainer.steps_done() == 0 {
            // What a divergence goes back to.
            self.save()?;
        }
        while !self.trainer.finished() && !interrupted() {
            match self.trainer.step() {
                Ok(report) => self.after(&report)?,
                Err(diverged @ nets::Error::Diverged { .. }) => self.back_off(diverged)?,
                Err(other) => return Err(other.into()),
            }
        }
        self.shown.clear();
        self.save()?;
        self.log.plot(&self.files.plot)?;
        let done = if self.trainer.finished() { Done::Complete } else { Done::Interrupted };
        if done == Done::Interrupted {
            eprintln!("stopped at step {}; --resume goes on from here", self.trainer.steps_done());
        }
        outln!("{}", self.files.weights.display());
        Ok(done)
    }

    /// Logs a step, and does what is due after it.
    fn after(&mut self, report: &StepReport) -> anyhow::Result<()> {
        self.log.step(report)?;
        self.shown.step(report.step, &self.log.message());
        let (config, finished) = (self.trainer.config(), self.trainer.finished());
        let save = report.step.is_multiple_of(config.checkpoint.every);
        if report.step.is_multiple_of(config.validation.every) || finished {
            let scores = self.trainer.validate()?;
            let text = self.log.validation(report.step, &scores)?;
            self.shown.line(&text);
            self.log.plot(&self.files.plot)?;
        }
        if save { self.save() } else { Ok(()) }
    }

    /// Goes back to a checkpoint, at half the learning rate.
    fn back_off(&mut self, diverged: nets::Error) -> anyhow::Result<()> {
        let tried = self.trainer.rate();
        if tried <= LEAST_RATE {
            let highest = self.trainer.config().training.learning_rate;
            let problem = format!("training.learning_rate = {highest}: too high even at {tried} of it");
            return Err(anyhow::Error::new(diverged).context(problem));
        }
        self.trainer.back_off(&self.files.checkpoint).context("after a divergence")?;
        self.saved = Some(self.trainer.steps_done());
        self.trainer.export(&self.files.weights, Storage::F32)?;
        let (step, rate) = (self.trainer.steps_done(), self.trainer.rate());
        self.log = Log::open(&self.files.log, step)?;
        self.log.backed_off(step, &diverged.to_string(), rate)?;
        self.shown.line(&format!("warning: {diverged}; going on from step {step} at {rate} of the learning rate"));
        Ok(())
    }

    fn save(&mut self) -> anyhow::Result<()> {
        // The log first: a checkpoint never lacks the lines before it.
        self.log.flush()?;
        let step = self.trainer.steps_done();
        // The same once more would take the place of the checkpoint before.
        if self.saved != Some(step) {
            self.trainer.save(&self.files.checkpoint)?;
            self.saved = Some(step);
        }
        Ok(self.trainer.export(&self.files.weights, Storage::F32)?)
    }
}

/// A bar on a terminal, and a line now and then elsewhere.
struct Shown {
    bar: Option<ProgressBar>,
    total: u64,
    begun: Instant,
    /// Steps since then.
    done: u32,
    last_line: Instant,
}

impl Shown {
    fn new(total: u64, start: u64) -> Self {
        let bar = stderr().is_terminal().then(|| {
            let style = ProgressStyle::with_template("{bar:30} {pos}/{len}  {msg}  {per_sec}  {eta} left")
                .expect("the template is fixed and has only known keys");
            let bar = ProgressBar::new(total).with_style(style).with_position(start);
            bar.reset_eta();
            bar
        });
        Self { bar, total, begun: Instant::now(), done: 0, last_line: Instant::now() }
    }

    fn step(&mut self, step: u64, message: &str) {
        self.done += 1;
        if let Some(bar) = &self.bar {
            bar.set_position(step);
            bar.set_message(message.to_owned());
        } else if self.last_line.elapsed() >= LINE_EVERY {
            self.last_line = Instant::now();
            let each = self.begun.elapsed().as_secs_f64() / f64::from(self.done);
            let left = Duration::from_secs((each * (self.total - step) as f64) as u64);
            eprintln!("step {step} of {}   {message}   {:.2} steps/s   {left:?} left", self.total, 1.0 / each);
        }
    }

    fn line(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.println(text),
            None => eprintln!("{text}"),
        }
    }

    fn clear(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
