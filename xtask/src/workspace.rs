//! Where things are, and how to run a program.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, ensure};

/// The root of the repository.
pub(crate) fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask lies in the workspace")
}

/// The cargo that runs this task, in the root.
pub(crate) fn cargo() -> Command {
    let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    cargo.current_dir(root());
    cargo
}

/// Runs a program, its messages to the terminal, and gives back what it printed.
pub(crate) fn output(command: &mut Command) -> anyhow::Result<String> {
    let named = format!("{command:?}");
    let output = command.stderr(Stdio::inherit()).output().with_context(|| named.clone())?;
    ensure!(output.status.success(), "{named}: {}", output.status);
    String::from_utf8(output.stdout).with_context(|| named)
}

/// Builds `sci` in release mode and says where it is.
pub(crate) fn built_sci() -> anyhow::Result<PathBuf> {
    let messages =
        output(cargo().args(["build", "--release", "-p", "sci-cli", "--bin", "sci", "--message-format=json"]))?;
    json_lines(&messages)
        .find_map(|message| message["executable"].as_str().map(PathBuf::from))
        .context("cargo did not name the binary it built")
}

/// The lines that are JSON objects.
pub(crate) fn json_lines(text: &str) -> impl Iterator<Item = serde_json::Value> {
    text.lines().filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok()).filter(|v| v.is_object())
}
