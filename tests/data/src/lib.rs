//! The benchmark data (scenes, published weights, outputs of public libraries) that may not be in the repository: where tests
//! find it, and what a test without it does.

use std::fmt::Display;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Set to 1, a test without its data fails.
const REQUIRE: &str = "SCI_REQUIRE_DATA";

/// The folder with `data/`, `weights/`, `golden/` and `peers/`: as `SCI_DATA` says, else `shared` beside the repository. It need
/// not be there.
pub fn folder() -> PathBuf {
    let named = std::env::var_os("SCI_DATA").filter(|name| !name.is_empty()).map(PathBuf::from);
    named.unwrap_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared"))
}

/// [`folder`], if it is there; otherwise the test is skipped.
///
/// # Panics
/// If it is not there and `SCI_REQUIRE_DATA` is 1.
pub fn root() -> Option<PathBuf> {
    files([""]).map(|[root]| root)
}

/// A file, named as in `golden/metrics.npz`, if it is there; otherwise the test is skipped.
///
/// # Panics
/// If it is not there and `SCI_REQUIRE_DATA` is 1.
pub fn file(name: &str) -> Option<PathBuf> {
    files([name]).map(|[path]| path)
}

/// Several files, if all are there; otherwise the test is skipped.
///
/// # Panics
/// If one is not there and `SCI_REQUIRE_DATA` is 1.
pub fn files<const N: usize>(names: [&str; N]) -> Option<[PathBuf; N]> {
    let paths = names.map(|name| folder().join(name));
    let Some(missing) = paths.iter().find(|path| !path.exists()) else { return Some(paths) };
    let why =
        format!("{} is not there (SCI_DATA may name a folder with data/, weights/ and golden/)", missing.display());
    assert!(std::env::var_os(REQUIRE).is_none_or(|v| v != "1"), "{REQUIRE} is 1, but {why}");
    skip(why);
    None
}

/// Says that this test is skipped: one line on standard error, which begins with `skipped: ` and which the test harness does not
/// capture. The caller returns.
pub fn skip(why: impl Display) {
    let thread = std::thread::current();
    let line = format!("skipped: {}: {why}\n", thread.name().unwrap_or("a test"));
    // A closed standard error is no reason to fail.
    let _ = std::io::stderr().write_all(line.as_bytes());
}
