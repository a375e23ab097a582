//! Owns experiment files, in three steps and three types: [`mod@file`] (what the TOML says, key by key, strict),
//! [`check`] (every value in range, every key with an effect), [`resolve`] (absolute paths, σ in `[0, 1]`).
//!
//! Only the last type reaches the rest of the program, so no other code has to doubt a value. An error names the file
//! and line (or the `--set` argument), the key, the value and what is legal.

pub mod adaptation;
mod camera;
pub mod check;
pub mod denoising;
pub mod file;
pub mod resolve;
pub mod skipping;
pub mod source;

pub use resolve::{Experiment, load};
pub use source::ConfigError;
