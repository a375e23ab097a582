//! The repository's rules as code. Every broken rule is printed; one is enough to fail.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::ensure;

use crate::circles;
use crate::workspace::{cargo, output, root};

const CRATES: [&str; 6] = ["sci-forward", "admm", "nets", "online", "sci-cli", "sci-python"];
/// Crates with a program in `examples` that knows them only.
const LIBRARIES: [&str; 4] = ["sci-forward", "admm", "nets", "online"];
/// What a crate must not depend on, not even through others.
const FORBIDDEN: [(&str, &[&str]); 6] = [
    ("sci-forward", &["image", "toml", "serde", "clap", "candle-core", "admm", "nets", "online", "sci-cli"]),
    ("admm", &["image", "toml", "clap", "candle-core", "nets", "online", "sci-cli"]),
    ("nets", &["image", "toml", "clap", "online", "sci-cli"]),
    ("online", &["image", "toml", "clap", "sci-cli"]),
    ("sci-cli", &["pyo3", "sci-python"]),
    ("xtask", &["candle-core", "sci-forward", "admm", "nets", "online", "sci-cli"]),
];
const MAX_LINES: usize = 800;

/// Checks every rule.
pub(crate) fn run() -> anyhow::Result<()> {
    let files = tracked_files()?;
    let mut broken = dependencies()?;
    broken.extend(files.iter().flat_map(|f| text_rules(f)));
    broken.extend(files.iter().filter(|f| f.starts_with("configs") && has_extension(f, "toml")).flat_map(|f| toml(f)));
    broken.extend(CRATES.iter().flat_map(|name| circles(name)));
    broken.extend(architecture());
    broken.extend(documents());
    broken.extend(LIBRARIES.iter().flat_map(|name| first_program(name)));
    broken.iter().for_each(|b| eprintln!("tidy: {b}"));
    ensure!(broken.is_empty(), "{} rules broken", broken.len());
    println!("tidy: {} files in order", files.len());
    Ok(())
}

/// Files of the repository that exist, relative to the root; new ones count unless ignored.
fn tracked_files() -> anyhow::Result<Vec<PathBuf>> {
    let mut git = Command::new("git");
    let list = output(git.current_dir(root()).args(["ls-files", "--cached", "--others", "--exclude-standard"]))?;
    Ok(list.lines().map(PathBuf::from).filter(|f| root().join(f).is_file()).collect())
}

fn has_extension(path: &Path, extension: &str) -> bool {
    path.extension().is_some_and(|e| e == extension)
}

fn dependencies() -> anyhow::Result<Vec<String>> {
    let mut broken = Vec::new();
    for (package, forbidden) in FORBIDDEN {
        let tree =
            output(cargo().args(["tree", "-p", package, "-e", "normal", "--prefix", "none", "--format", "{p}"]))?;
        let names: Vec<&str> = tree.lines().filter_map(|l| l.split_whitespace().next()).collect();
        let found = forbidden.iter().filter(|f| names.contains(f));
        broken.extend(found.map(|f| format!("{package} depends on {f}; see ARCHITECTURE.md for the direction")));
    }
    Ok(broken)
}

fn text_rules(file: &Path) -> Vec<String> {
    let Ok(text) = fs::read_to_string(root().join(file)) else { return Vec::new() };
    let named = |what: String| format!("{}: {what}", file.display());
    let mut broken = Vec::new();
    // Put together here, so that this file keeps its own rules.
    for folder in ["work", "root", "home", "tmp"] {
        let path = format!("/{folder}/");
        if let Some(at) = text.lines().position(|l| names_folder(l, &path)) {
            broken.push(named(format!("line {} names {path}, a folder of one machine", at + 1)));
        }
    }
    if text.contains(concat!("target-cpu", "=native")) {
        broken.push(named("builds for one machine only (target-cpu); kernels choose when they run".into()));
    }
    let lines = text.lines().count();
    if has_extension(file, "rs") && lines > MAX_LINES {
        broken.push(named(format!("{lines} lines, at most {MAX_LINES}: split it")));
    }
    broken
}

/// Whether a line has `folder` as the beginning of a path, not as a part of one.
fn names_folder(line: &str, folder: &str) -> bool {
    line.match_indices(folder)
        .any(|(at, _)| !line[..at].chars().next_back().is_some_and(|c| c.is_alphanumeric() || "._-}~/*".contains(c)))
}

/// Each experiment file must be TOML; that its keys are legal is tested through `sci` itself.
fn toml(file: &Path) -> Option<String> {
    let text = fs::read_to_string(root().join(file)).ok()?;
    text.parse::<toml::Table>().err().map(|e| format!("{}: {}", file.display(), e.message()))
}

/// Modules of a crate that import each other.
fn circles(name: &str) -> Vec<String> {
    let found = circles::of(&root().join("crates").join(name).join("src"));
    let told = found.iter().map(|(folder, modules)| {
        format!("crates/{name}: {} in {folder} import each other in a circle", modules.join(", "))
    });
    told.collect()
}

/// The code map names every crate and every module at its top.
fn architecture() -> Vec<String> {
    let map = fs::read_to_string(root().join("ARCHITECTURE.md")).unwrap_or_default();
    let mut broken = Vec::new();
    for name in CRATES {
        let src = root().join("crates").join(name).join("src");
        let Some((_, section)) = map.split_once(&format!("### `crates/{name}`")) else {
            broken.push(format!("ARCHITECTURE.md has no section ### `crates/{name}`"));
            continue;
        };
        let section = section.split("\n### ").next().unwrap_or(section);
        for entry in fs::read_dir(src).into_iter().flatten().flatten() {
            let path = entry.path();
            let module = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            let is_module = has_extension(&path, "rs") || path.join("mod.rs").is_file();
            if is_module && !["lib", "main"].contains(&module.as_str()) && !section.contains(&format!("`{module}`")) {
                broken
                    .push(format!("ARCHITECTURE.md: the section of crates/{name} does not name its module `{module}`"));
            }
        }
    }
    broken
}

fn documents() -> Vec<String> {
    let mut broken: Vec<String> =
        ["LICENSE-MIT", "LICENSE-APACHE", "README.md", "CHANGELOG.md", "configs/demo/ATTRIBUTION.md"]
            .iter()
            .filter(|f| !root().join(f).is_file())
            .map(|f| format!("{f} is missing"))
            .collect();
    for name in CRATES {
        let lib = root().join("crates").join(name).join("src/lib.rs");
        if !fs::read_to_string(lib).is_ok_and(|text| text.starts_with("//! ")) {
            broken.push(format!("crates/{name}/src/lib.rs does not begin with what the crate owns (//!)"));
        }
    }
    broken
}

/// The README of a library begins with its program in `examples`, which names no other crate of ours.
fn first_program(name: &str) -> Vec<String> {
    let read = |path: String| fs::read_to_string(root().join(path)).unwrap_or_default();
    let readme = read(format!("crates/{name}/README.md"));
    let program = read(format!("examples/{name}/src/main.rs"));
    let first = readme.split_once("```rust\n").and_then(|(_, rest)| rest.split_once("```")).map(|(first, _)| first);
    let mut broken = Vec::new();
    if program.is_empty() || first != Some(program.as_str()) {
        broken.push(format!("crates/{name}/README.md does not begin with examples/{name}/src/main.rs"));
    }
    let manifest = read(format!("examples/{name}/Cargo.toml"));
    let named = |other: &&&str| manifest.lines().any(|line| line.starts_with(&format!("{other} =")));
    let others = CRATES.iter().filter(|other| **other != name).filter(named);
    broken.extend(others.map(|other| format!("examples/{name} names {other} too: it is to do with {name} alone")));
    broken
}

#[cfg(test)]
mod tests {
    use super::names_folder;

    #[test]
    fn only_the_beginning_of_a_path_counts() {
        let folder = format!("/{}/", "tmp");
        assert!(names_folder(&format!("cat {folder}x"), &folder));
        assert!(names_folder(&format!("\"{folder}x\""), &folder));
        assert!(!names_folder(&format!("target{folder}x"), &folder));
    }
}
