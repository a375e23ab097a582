//! Owns the command line: one module a command, and the exit code that each kind of error gives.
//!
//! 0 done · 1 failed · 2 bad usage or bad TOML · 130 interrupted (what was finished is written).

/// `println!` that does not mind when nobody reads on, as under `sci … | head`: results on disk matter more.
macro_rules! outln {
    ($($arg:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stdout(), $($arg)*);
    }};
}

mod calibrate;
mod completions;
mod doctor;
mod gather;
mod man;
mod mask;
mod metrics;
mod report;
mod results;
mod run;
mod simulate;
mod train;
mod weights;

use std::ops::ControlFlow;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context;
use clap::{Parser, Subcommand};

use crate::calibration;
use crate::progress::Progress;
use crate::run_folder::Refusal;
use crate::table::ConfigError;

/// Reconstruct video from snapshot compressive measurements.
#[derive(Debug, Parser)]
#[command(name = "sci", version, about, max_term_width = 100)]
pub struct Cli {
    /// Worker threads [default: all]; results do not depend on it
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run an experiment file
    ///
    /// A measurement is on disk as soon as it is solved. A run that was stopped, by whatever, goes on with --resume, which repeats
    /// at most the measurement in work. Without --resume a folder with a stopped run is refused, so that nothing solved is lost.
    Run(run::Args),
    /// Join the shards of a run to its results
    ///
    /// Shards are made by sci run --shard, on as many machines as there are. Results are those of one machine, byte for byte. If a
    /// shard is missing nothing is written, and the command that makes it is printed.
    Gather(gather::Args),
    /// Find how the masks really sit, from measurements alone
    Calibrate(calibrate::Args),
    /// Make masks and measurements from a video
    Simulate(simulate::Args),
    /// Make a stack of masks
    Mask(mask::Args),
    /// Compare two videos: PSNR and SSIM
    Metrics(metrics::Args),
    /// Train a network
    Train(train::Args),
    /// Look into weight files, and convert them
    #[command(subcommand)]
    Weights(weights::Command),
    /// Compare finished runs
    Report(report::Args),
    /// Look at this machine, and whether sci works here
    ///
    /// Says what is used of the processor, where data are looked for and which programs are missing, and solves a small scene. Ends
    /// with 1 if something is broken. Its output is what to add to a report of a problem.
    Doctor(doctor::Args),
    /// Print what makes a shell complete the commands
    ///
    /// For bash, for example: sci completions bash > ~/.local/share/bash-completion/completions/sci
    Completions(completions::Args),
    /// Write the manual pages
    ///
    /// For example: sci man --out ~/.local/share/man/man1, then man sci-run
    Man(man::Args),
}

/// How a command ended well.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Done {
    /// Everything was done.
    Complete,
    /// The user stopped it; what was finished is written.
    Interrupted,
}

/// A mistake in how a command was called, as opposed to one that happened while it ran.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(pub String);

impl Cli {
    /// Runs the command and prints its error, if any; the exit code.
    pub fn execute(self) -> u8 {
        match self.dispatch() {
            Ok(Done::Complete) => 0,
            Ok(Done::Interrupted) => 130,
            Err(error) => {
                eprintln!("error: {}", chain(&error));
                let usage = error.is::<ConfigError>() || error.is::<UsageError>() || error.is::<Refusal>();
                if usage { 2 } else { 1 }
            }
        }
    }

    fn dispatch(self) -> anyhow::Result<Done> {
        if let Some(n) = self.threads {
            rayon::ThreadPoolBuilder::new()
                .num_threads(usize::from(n))
                .build_global()
                .context("cannot start the worker threads")?;
        }
        // Within the pool a parallel step begins at once; from outside, each would wake a thread first.
        rayon::scope(|_| self.command.run())
    }
}

impl Command {
    fn run(self) -> anyhow::Result<Done> {
        match self {
            Command::Run(args) => args.run(),
            Command::Gather(args) => args.run(),
            Command::Calibrate(args) => args.run(),
            Command::Simulate(args) => args.run(),
            Command::Mask(args) => args.run(),
            Command::Metrics(args) => args.run(),
            Command::Train(args) => args.run(),
            Command::Weights(command) => command.run(),
            Command::Report(args) => args.run(),
            Command::Doctor(args) => args.run(),
            Command::Completions(args) => args.run(),
            Command::Man(args) => args.run(),
        }
    }
}

/// The error and its causes on one line; a cause that the error before it already quotes is not repeated.
pub fn chain(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain() {
        let part = cause.to_string();
        if text.is_empty() {
            text = part;
        } else if !text.ends_with(&part) {
            text = format!("{text}: {part}");
        }
    }
    text
}

/// Set by the first Ctrl-C.
static INTERRUPTED: AtomicBool = AtomicBool::new(false);

/// Whether the user asked to stop.
fn interrupted() -> bool {
    INTERRUPTED.load(Ordering::Relaxed)
}

/// Makes the first Ctrl-C a request to stop, and the second one final.
fn catch_interrupts() -> anyhow::Result<()> {
    ctrlc::set_handler(|| {
        if INTERRUPTED.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
        eprintln!("stopping after this iteration; what is finished will be written (Ctrl-C again to quit at once)");
    })
    .context("cannot handle Ctrl-C")
}

/// Calibrates with a bar that shows how far it has come, until Ctrl-C.
fn shown_on_a_bar<T>(calibrate: impl FnOnce(calibration::Watch<'_>) -> T) -> T {
    let mut shown: Option<Progress> = None;
    let found = calibrate(&mut |done, expected| {
        let bar = shown.get_or_insert_with(|| {
            let mut bar = Progress::of("calibration", expected);
            bar.start();
            bar
        });
        bar.step(done, None);
        if interrupted() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    if let Some(bar) = shown {
        bar.finish();
    }
    found
}

/// Refuses a file where results are to have a folder.
fn check_folder(out: &Path) -> Result<(), UsageError> {
    if out.exists() && !out.is_dir() {
        return Err(UsageError(format!("--out {}: it is a file, expected a folder", out.display())));
    }
    Ok(())
}

/// A size as `HEIGHTxWIDTH`.
fn parse_size(text: &str) -> Result<(usize, usize), String> {
    let side = |s: &str| s.parse::<usize>().ok().filter(|n| (1..=65_535).contains(n));
    text.split_once('x')
        .and_then(|(h, w)| Some((side(h)?, side(w)?)))
        .ok_or_else(|| "expected HEIGHTxWIDTH, each 1 to 65535, for example 256x256".into())
}

fn parse_density(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|d| (1e-3..=1.0).contains(d)).ok_or_else(|| "expected a number from 0.001 to 1".into())
}

/// A path whose extension says how to write arrays.
fn array_format(path: &Path) -> anyhow::Result<crate::io::output::ArrayFormat> {
    crate::io::output::ArrayFormat::of(path).ok_or_else(|| {
        UsageError(format!("--out {}: expected a name that ends in .npy, .npz or .mat", path.display())).into()
    })
}
