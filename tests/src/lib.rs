//! What the end-to-end tests share: the built `sci` and a folder to run it in. Their data is found by `test_data`.

mod folders;

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

use serde_json::Value;
use tempfile::TempDir;

pub use folders::{assert_same, contents, page_data, wait_for};

/// The root of the workspace.
///
/// # Panics
/// Never: this crate lies in the workspace.
pub fn workspace() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("this crate lies in the workspace")
}

/// The `sci` binary, built once in the profile of the tests.
///
/// # Panics
/// If it does not build.
pub fn sci() -> &'static Path {
    static SCI: OnceLock<PathBuf> = OnceLock::new();
    SCI.get_or_init(|| {
        let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
        cargo.current_dir(workspace()).args(["build", "-p", "sci-cli", "--bin", "sci", "--message-format=json"]);
        if !cfg!(debug_assertions) {
            cargo.arg("--release");
        }
        let output = cargo.stderr(Stdio::inherit()).output().expect("cargo runs");
        assert!(output.status.success(), "sci does not build");
        String::from_utf8_lossy(&output.stdout)
            .lines()
            .filter_map(|line| serde_json::from_str::<Value>(line).ok())
            .find_map(|message| message["executable"].as_str().map(PathBuf::from))
            .expect("cargo names the binary it built")
    })
}

/// An experiment of `configs`, on the demo's video through a mask (the keys of `[data.mask]`).
///
/// # Panics
/// If there is no such experiment.
pub fn on_the_demo(config: &str, mask: &str) -> String {
    let config = std::fs::read_to_string(workspace().join("configs").join(config)).expect("a file of configs");
    let video = format!("kind = \"simulate\"\npath = '{}'\n", workspace().join("configs/demo/bunny").display());
    let data = config.find("path = ").expect("a path")..config.find("[solver]").expect("a solver");
    [&config[..data.start], &video, "[data.mask]\n", mask, "\n", &config[data.end..]].concat()
}

/// What a run of `sci` left behind.
#[derive(Debug)]
pub struct Finished {
    /// Exit code.
    pub code: i32,
    /// Standard output.
    pub stdout: String,
    /// Standard error.
    pub stderr: String,
}

/// A temporary folder in which `sci` runs.
#[derive(Debug)]
pub struct Bench {
    dir: TempDir,
}

impl Default for Bench {
    fn default() -> Self {
        Self::new()
    }
}

impl Bench {
    /// An empty folder.
    ///
    /// # Panics
    /// If the system has none to give.
    pub fn new() -> Self {
        Self { dir: tempfile::tempdir().expect("a temporary folder") }
    }

    /// A path in the folder.
    pub fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// Writes a file.
    ///
    /// # Panics
    /// If it cannot be written.
    pub fn write(&self, name: &str, bytes: impl AsRef<[u8]>) {
        fs::write(self.path(name), bytes).expect("the folder is writable");
    }

    /// Every name in the folder, hidden ones too, sorted.
    ///
    /// # Panics
    /// If it cannot be listed.
    pub fn names(&self) -> Vec<String> {
        let entries = fs::read_dir(self.dir.path()).expect("the folder is readable");
        let mut names: Vec<String> =
            entries.map(|e| e.expect("an entry").file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    /// `sci` with these arguments, about to run in the folder without `SCI_DATA`, and as no task of a job array.
    pub fn command<S: AsRef<OsStr>>(&self, args: &[S]) -> Command {
        let mut command = Command::new(sci());
        command.current_dir(self.dir.path()).env_remove("SCI_DATA").env_remove("SLURM_ARRAY_TASK_ID").args(args);
        command
    }

    /// Runs `sci`.
    ///
    /// # Panics
    /// If it does not start or is killed.
    pub fn sci<S: AsRef<OsStr>>(&self, args: &[S]) -> Finished {
        self.finish(&mut self.command(args))
    }

    /// Runs a file of `configs` on measurement 0 into `out`, with these settings and the scenes and weights of `data`.
    ///
    /// # Panics
    /// If `sci` does not start or is killed.
    pub fn run_on(&self, data: &Path, config: &str, settings: &[&str]) -> Finished {
        let mut command = self.command(&["run", "--out", "out", "--set", "data.measurements=[0]"]);
        command.arg(workspace().join("configs").join(config)).env("SCI_DATA", data);
        settings.iter().for_each(|setting| {
            command.args(["--set", setting]);
        });
        self.finish(&mut command)
    }

    /// Runs a command to its end.
    ///
    /// # Panics
    /// If it does not start or is killed.
    pub fn finish(&self, command: &mut Command) -> Finished {
        let output = command.output().expect("sci starts");
        Finished {
            code: output.status.code().expect("sci ends by itself"),
            stdout: String::from_utf8_lossy(&output.stdout).into_owned(),
            stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
        }
    }

    /// The `record.json` of a run.
    ///
    /// # Panics
    /// If there is none.
    pub fn record(&self, run: &str) -> Value {
        let bytes = fs::read(self.path(run).join("record.json")).expect("the run left a record");
        serde_json::from_slice(&bytes).expect("a record is JSON")
    }
}
