//! Tasks of the repository, run as `cargo xtask`: rules checked by a program, and benchmarks against the Python peer.
//!
//! They drive the built `sci` and read its run records; nothing here links the solvers.

mod bench;
mod circles;
mod large;
mod pareto;
mod plot;
mod real;
mod repro;
mod robust;
mod sensitivity;
mod stress;
mod tidy;
mod workspace;

use clap::{Parser, Subcommand};

#[derive(Parser)]
#[command(name = "cargo xtask")]
enum Task {
    /// Check the repository's rules
    Tidy,
    /// Measure speed, and compare with the Python a user would run instead
    #[command(subcommand)]
    Bench(Bench),
    /// The paper's tables, cell by cell, beside what this program gives
    Repro(repro::Options),
    /// The paper's sections of captured data: a table, and a page of pictures
    Real(real::Options),
    /// Feed every solver what no one should feed it, and print how each case ended
    Stress(stress::Options),
    /// Read damaged files and experiments, more than a million
    Fuzz(stress::Fuzz),
}

#[derive(Subcommand)]
enum Bench {
    /// GAP-TV on a gray scene
    GapTv(bench::Options),
    /// GAP-FFDNet on a gray scene
    GapFfdnet(bench::Options),
    /// 3×3 convolutions
    Kernels(bench::Options),
    /// Run time against error: every solver × denoiser over a range of budgets
    Pareto(pareto::Options),
    /// The paper's figure of parameters: schedules and numbers of online updates
    Sensitivity(sensitivity::Options),
    /// The faults of real cameras, one at a time and together, with and without calibration
    Robust(robust::Options),
    /// Scenes larger than memory: seconds and memory over size
    Large(large::Options),
}

fn main() -> anyhow::Result<()> {
    match Task::parse() {
        Task::Tidy => tidy::run(),
        Task::Repro(options) => repro::run(&options),
        Task::Real(options) => real::run(&options),
        Task::Stress(options) => stress::run(&options),
        Task::Fuzz(options) => stress::fuzz(&options),
        Task::Bench(Bench::GapTv(options)) => bench::solver("gap-tv", &options),
        Task::Bench(Bench::GapFfdnet(options)) => bench::solver("gap-ffdnet", &options),
        Task::Bench(Bench::Kernels(options)) => bench::kernels(&options),
        Task::Bench(Bench::Pareto(options)) => pareto::run(&options),
        Task::Bench(Bench::Sensitivity(options)) => sensitivity::run(&options),
        Task::Bench(Bench::Robust(options)) => robust::run(&options),
        Task::Bench(Bench::Large(options)) => large::run(&options),
    }
}
