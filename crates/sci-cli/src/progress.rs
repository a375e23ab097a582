//! Owns what a user sees while a solve runs: a bar on a terminal, a line now and then elsewhere.

use std::io::{IsTerminal, stderr};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

/// Time between lines where there is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// The progress of one measurement.
#[derive(Debug)]
pub struct Progress {
    /// Of what.
    name: String,
    iterations: usize,
    bar: Option<ProgressBar>,
    last_line: Instant,
}

impl Progress {
    /// Progress of `iterations` on measurement number `measurement`; nothing is shown before [`Progress::start`].
    pub fn new(measurement: usize, iterations: usize) -> Self {
        Self::of(&format!("measurement {measurement:>2}"), iterations)
    }

    /// Progress of `iterations` of anything.
    pub fn of(name: &str, iterations: usize) -> Self {
        Self { name: name.to_owned(), iterations, bar: None, last_line: Instant::now() }
    }

    /// Begins to show.
    pub fn start(&mut self) {
        self.last_line = Instant::now();
        if !stderr().is_terminal() {
            return;
        }
        let style = ProgressStyle::with_template("{prefix} {bar:30} {pos}/{len}  {msg}  {eta} left")
            .unwrap_or_else(|_| ProgressStyle::default_bar());
        let bar = ProgressBar::new(self.iterations as u64).with_style(style);
        bar.set_prefix(self.name.clone());
        self.bar = Some(bar);
    }

    /// Shows that a network was updated for the `done`-th time before the solve.
    pub fn update(&mut self, done: usize) {
        if stderr().is_terminal() {
            eprint!("\r{}   update {done}   ", self.name);
        } else if self.last_line.elapsed() >= LINE_EVERY {
            self.last_line = Instant::now();
            eprintln!("{}   update {done}", self.name);
        }
    }

    /// Shows that `done` iterations are done.
    pub fn step(&mut self, done: usize, psnr_db: Option<f64>) {
        let quality = psnr_db.map_or(String::new(), |p| format!("{p:.2} dB"));
        match &self.bar {
            Some(bar) => {
                bar.set_position(done as u64);
                bar.set_message(quality);
            }
            None if self.last_line.elapsed() >= LINE_EVERY => {
                self.last_line = Instant::now();
                eprintln!("{}   iteration {done} of {}   {quality}", self.name, self.iterations);
            }
            None => {}
        }
    }

    /// Takes the bar away.
    pub fn finish(self) {
        if let Some(bar) = self.bar {
            bar.finish_and_clear();
        }
    }
}
