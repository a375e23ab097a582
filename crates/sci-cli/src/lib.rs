//! The `sci` command as a library: readers, configs and commands, so that each can be tested and fuzzed on its own.
//!
//! `main.rs` only parses arguments and turns the result into an exit code. Errors are typed up to the commands; the
//! chain is printed once, in `main`.

pub mod bands;
pub mod calibration;
pub mod commands;
pub mod config;
pub mod factory;
pub mod io;
pub mod parts;
pub mod pictures;
pub mod progress;
pub mod record;
pub mod report;
pub mod run_folder;
pub mod shard;
pub mod shipped;
pub mod simulate;
pub mod solve;
pub mod solvers;
pub mod table;
pub mod training;
