//! `sci doctor`: what this machine has of what `sci` can use, and whether a small solve comes out right.

mod machine;
mod places;
mod self_test;

use std::path::PathBuf;

use anyhow::bail;
use serde::Serialize;
use serde_json::{Value, json};

use super::Done;
use crate::record::host;

/// Arguments of `sci doctor`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// The folder that results are to be written to; it is not made
    #[arg(long, value_name = "DIR", default_value = "runs")]
    out: PathBuf,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

/// What was found of one thing.
#[derive(Debug, Serialize)]
struct Finding {
    name: &'static str,
    state: State,
    /// For people, on one line.
    text: String,
    /// For programs.
    details: Value,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum State {
    /// As it should be.
    Fine,
    /// Something that not everyone needs is not there; the text says what goes without.
    Missing,
    /// Runs will fail.
    Broken,
}

impl Finding {
    fn fine(name: &'static str, text: impl Into<String>, details: Value) -> Self {
        Self { name, state: State::Fine, text: text.into(), details }
    }

    fn missing(name: &'static str, text: impl Into<String>) -> Self {
        Self { name, state: State::Missing, text: text.into(), details: Value::Null }
    }

    fn broken(name: &'static str, text: impl Into<String>) -> Self {
        Self { name, state: State::Broken, text: text.into(), details: Value::Null }
    }
}

impl Args {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        let findings: Vec<Finding> = [
            vec![machine::processor(), machine::threads(), machine::memory()],
            vec![places::data(), places::weights(), places::ffmpeg(), places::browser()],
            vec![places::results(&self.out), places::temporary()],
            self_test::findings(),
        ]
        .into_iter()
        .flatten()
        .collect();
        let broken: Vec<&str> = findings.iter().filter(|f| f.state == State::Broken).map(|f| f.name).collect();
        if self.json {
            let (version, revision) = (host::VERSION, host::REVISION);
            let found =
                json!({ "version": version, "revision": revision, "works": broken.is_empty(), "findings": findings });
            outln!("{}", serde_json::to_string_pretty(&found)?);
        } else {
            print(&findings);
        }
        match broken[..] {
            [] => Ok(Done::Complete),
            _ => bail!("broken: {}", broken.join(", ")),
        }
    }
}

fn print(findings: &[Finding]) {
    let revision = Some(host::REVISION).filter(|r| !r.is_empty()).map(|r| format!(" ({r})")).unwrap_or_default();
    outln!("sci {}{revision} on {} {}\n", host::VERSION, std::env::consts::OS, std::env::consts::ARCH);
    for Finding { name, state, text, .. } in findings {
        let mark = match state {
            State::Fine => "ok",
            State::Missing => "--",
            State::Broken => "!!",
        };
        outln!("{mark} {name:<12} {text}");
    }
    if findings.iter().all(|f| f.state != State::Broken) {
        outln!("\nEverything that is needed works.");
    }
}

/// Bytes as people say them.
fn told(bytes: u64) -> String {
    const MIB: f64 = (1u64 << 20) as f64;
    let mib = bytes as f64 / MIB;
    if mib < 1024.0 { format!("{mib:.1} MiB") } else { format!("{:.1} GiB", mib / 1024.0) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_told_in_a_unit_that_fits() {
        assert_eq!([told(973_616), told(3 << 30)], ["0.9 MiB", "3.0 GiB"]);
    }
}
