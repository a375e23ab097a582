//! Where things are, and how to run a program.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context, ensure};
use serde_json::Value;
use tempfile::TempDir;

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

/// The JSON objects that lines end with; before one the test harness may have put a dot for a test that passed.
pub(crate) fn json_lines(text: &str) -> impl Iterator<Item = Value> {
    let object = |line: &str| serde_json::from_str::<Value>(&line[line.find('{')?..]).ok();
    text.lines().filter_map(object).filter(|v| v.is_object())
}

/// The folder with data/, weights/ and peers/: as named, else `SCI_DATA`, else beside the repository.
pub(crate) fn shared(named: Option<&Path>) -> anyhow::Result<PathBuf> {
    let dir = named.map_or_else(test_data::folder, PathBuf::from);
    dir.canonicalize().with_context(|| format!("{}: give --shared DIR", dir.display()))
}

/// Where results of this machine are kept, created if it is not there.
pub(crate) fn results_dir() -> anyhow::Result<PathBuf> {
    let folder: String =
        cpu().chars().map(|c| if c.is_ascii_alphanumeric() { c.to_ascii_lowercase() } else { '-' }).collect();
    let dir = root().join("xtask/results").join(folder);
    std::fs::create_dir_all(&dir).with_context(|| dir.display().to_string())?;
    Ok(dir)
}

/// A table whose lines are printed as soon as they are there, as each may take minutes.
#[derive(Default)]
pub(crate) struct Told(String);

impl Told {
    pub(crate) fn line(&mut self, line: &str) {
        println!("{line}");
        self.0 += line;
        self.0.push('\n');
    }

    /// Keeps it in the folder of this machine's results, under this name.
    pub(crate) fn save(&self, name: &str) -> anyhow::Result<()> {
        let path = results_dir()?.join(name);
        std::fs::write(&path, &self.0).with_context(|| path.display().to_string())?;
        println!("wrote {}", path.display());
        Ok(())
    }
}

/// The commit that is checked out.
pub(crate) fn revision() -> anyhow::Result<String> {
    Ok(output(Command::new("git").current_dir(root()).args(["rev-parse", "HEAD"]))?.trim().to_owned())
}

/// The processor's name.
pub(crate) fn cpu() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = info.lines().find(|l| l.starts_with("model name")).and_then(|l| l.split_once(':'));
    name.map_or_else(|| std::env::consts::ARCH.to_owned(), |(_, name)| name.trim().to_owned())
}

/// The built `sci`, and a folder for its runs, which goes with it.
pub(crate) struct Sci {
    program: PathBuf,
    /// Where scenes and weights are that an experiment names.
    data: PathBuf,
    runs: TempDir,
}

impl Sci {
    /// Builds it in release mode. `data` as for [`shared`], but it need not be there.
    pub(crate) fn build(data: Option<&Path>) -> anyhow::Result<Self> {
        Self::build_with(&["--release"], data)
    }

    /// Builds it in the profile of the tests, which is optimised too, and there after them.
    pub(crate) fn build_as_tests_do() -> anyhow::Result<Self> {
        Self::build_with(&[], None)
    }

    fn build_with(profile: &[&str], data: Option<&Path>) -> anyhow::Result<Self> {
        let usual = ["build", "-p", "sci-cli", "--bin", "sci", "--message-format=json"];
        let messages = output(cargo().args(usual).args(profile))?;
        let program = json_lines(&messages)
            .find_map(|message| message["executable"].as_str().map(PathBuf::from))
            .context("cargo did not name the binary it built")?;
        let data = std::path::absolute(data.map_or_else(test_data::folder, PathBuf::from))?;
        Ok(Self { program, data, runs: tempfile::tempdir().context("no temporary folder")? })
    }

    /// `sci run CONFIG --set ...`, without pictures. What it left is there until the next run.
    pub(crate) fn run(&self, config: &Path, sets: &[String]) -> anyhow::Result<Finished> {
        let sets: Vec<String> = std::iter::once("output=minimal".to_owned()).chain(sets.iter().cloned()).collect();
        self.run_into(&self.runs.path().join("run"), config, &sets)
    }

    /// The same with its pictures, into a folder that is removed before.
    pub(crate) fn run_into(&self, folder: &Path, config: &Path, sets: &[String]) -> anyhow::Result<Finished> {
        if folder.exists() {
            std::fs::remove_dir_all(folder).with_context(|| folder.display().to_string())?;
        }
        let mut command = Command::new(&self.program);
        command.arg("run").arg(config).arg("--out").arg(folder).env("SCI_DATA", &self.data);
        sets.iter().for_each(|set| {
            command.arg("--set").arg(set);
        });
        let output = command.output().with_context(|| format!("{command:?}"))?;
        let record = std::fs::read_to_string(folder.join("record.json")).ok();
        Ok(Finished {
            code: output.status.code(),
            stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
            record: record.map(|r| serde_json::from_str(&r)).transpose()?,
            folder: folder.to_owned(),
        })
    }
}

/// How a run of `sci` ended: exit code, what it said on standard error, its record if it left one, and where the rest is.
pub(crate) struct Finished {
    pub(crate) code: Option<i32>,
    pub(crate) stderr: String,
    pub(crate) record: Option<Value>,
    pub(crate) folder: PathBuf,
}

impl Finished {
    /// The record of a run that ended well; otherwise what it said.
    pub(crate) fn success(self) -> anyhow::Result<Value> {
        ensure!(self.code == Some(0), "{}", self.stderr.trim());
        self.record.context("the run left no record")
    }
}

pub(crate) fn range(values: &[f64]) -> (f64, f64) {
    values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &v| (low.min(v), high.max(v)))
}

pub(crate) fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let middle = sorted.len() / 2;
    if sorted.len() % 2 == 1 { sorted[middle] } else { (sorted[middle - 1] + sorted[middle]) / 2.0 }
}

#[cfg(test)]
mod tests {
    #[test]
    fn medians() {
        assert_eq!(super::median(&[3.0, 1.0, 2.0]), 2.0);
        assert_eq!(super::median(&[4.0, 1.0, 2.0, 3.0]), 2.5);
    }
}
