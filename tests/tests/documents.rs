//! The README, the guide and docs/clusters.md: their commands run, on a small scene under the names that they use; their experiments are legal,
//! and their links lead somewhere.
#![cfg(unix)]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use clap::Parser;
use e2e::{Bench, sci, workspace};
use ndarray::{Array2, Array3};
use ndarray_npy::write_npy;
use sci_cli::commands::Cli;
use sci_cli::config;
use sci_cli::io::mat::{Variable, write_v5};
use sci_cli::shipped;
use sci_cli::table::Source;

/// What takes minutes, or needs what a test may not have: such lines are parsed, and their experiments checked.
const ONLY_CHECKED: [&str; 4] = ["sci train", "/adaptive", "clip.mp4", "sci run gray/refined"];
/// What the documents call beside `sci`.
const OTHERS: [&str; 8] =
    ["cargo ", "rustup ", "CC_", "pip install ", "pytest ", "python -m sci.gpu.train ", "sbatch ", "parallel "];

fn documents() -> Vec<PathBuf> {
    let root = workspace();
    let guide = fs::read_dir(root.join("docs/guide")).unwrap().map(|entry| entry.unwrap().path());
    let mut all: Vec<PathBuf> =
        [root.join("README.md"), root.join("docs/clusters.md")].into_iter().chain(guide).collect();
    all.sort();
    all
}

/// The blocks of a language, each with its lines.
fn blocks(document: &Path, language: &str) -> Vec<String> {
    let text = fs::read_to_string(document).unwrap();
    let fence = format!("```{language}\n");
    text.split(&fence).skip(1).map(|rest| rest.split("```").next().unwrap_or_default().to_owned()).collect()
}

/// Video, scenes, masks and clips under the names that the documents use: 3 measurements of 4 frames of 32×32.
fn bench() -> Bench {
    let bench = Bench::new();
    std::os::unix::fs::symlink(workspace().join("configs"), bench.path("configs")).unwrap();
    let video = Array3::from_shape_fn((12, 32, 32), |(t, i, j)| {
        let inside = 7.0 - (i as f32 - 12.0 - t as f32).hypot(j as f32 - 14.0);
        0.3 + 0.004 * (i + j) as f32 + 0.4 * inside.clamp(0.0, 1.0)
    });
    write_npy(bench.path("video.npy"), &video).unwrap();
    write_npy(bench.path("one.npy"), &Array2::from_shape_fn((32, 32), |(i, j)| ((i * 7 + j * 5) % 3 / 2) as f32))
        .unwrap();
    for (arguments, out) in
        [("simulate video.npy --frames 4", "scene.npz"), ("simulate video.npy --frames 4", "scene.mat")]
            .into_iter()
            .chain([
                ("simulate video.npy --frames 4 --sigma 2", "capture.mat"),
                ("mask --frames 4 --size 32x32", "masks.mat"),
            ])
    {
        let words: Vec<&str> = arguments.split(' ').chain(["--out", out]).collect();
        let made = bench.sci(&words);
        assert_eq!(made.code, 0, "{out}: {}", made.stderr);
    }
    let (mask, meas) = (vec![1.0; 4096], vec![100.0; 1024]);
    let mut theirs = Vec::new();
    let variables = [("Phi", &[32, 32, 4], &mask), ("meas", &[32, 32, 1], &meas)];
    write_v5(&mut theirs, &variables.map(|(name, size, data)| Variable { name, size, data })).unwrap();
    bench.write("theirs.mat", theirs);
    // A result is a stack of pictures too, and its preview a clip.
    let set = ["data.path=scene.npz", "output.format=tiff", "data.measurements=[0]"].map(|set| ["--set", set]).concat();
    let made = bench.sci(&[&["run", "gray/gap-tv", "--out", "made"][..], &set].concat());
    assert_eq!(made.code, 0, "{}", made.stderr);
    fs::copy(bench.path("made/recon.tif"), bench.path("shots.tif")).unwrap();
    fs::copy(bench.path("made/preview.gif"), bench.path("clip.gif")).unwrap();
    bench
}

/// A line of the shell, with `sci` on the path.
fn shell(bench: &Bench, line: &str) -> e2e::Finished {
    let folder = sci().parent().unwrap().display();
    let mut command = Command::new("sh");
    command.current_dir(bench.path(".")).env_remove("SCI_DATA").env_remove("SLURM_ARRAY_TASK_ID");
    command.env("PATH", format!("{folder}:{}", std::env::var("PATH").unwrap_or_default()));
    bench.finish(command.args(["-c", line]))
}

/// Parses the arguments as `sci` does, and looks through the experiment.
fn check(bench: &Bench, line: &str) {
    let words = shell(bench, &format!("set -- {line}\nprintf '%s\\n' \"$@\"")).stdout;
    let words: Vec<&str> = words.lines().collect();
    if let Err(error) = Cli::try_parse_from(&words) {
        panic!("{line}: {error}");
    }
    if words[1] == "run" {
        let sets: Vec<String> =
            words.windows(2).filter(|pair| pair[0] == "--set").map(|pair| pair[1].to_owned()).collect();
        let file = workspace().join(words[2]);
        let path = if file.exists() { file } else { shipped::located(Path::new(words[2])) };
        let checked = Source::read(&path, "experiment", &sets).and_then(|source| config::check(&source));
        assert!(checked.is_ok(), "{line}: {}", checked.unwrap_err());
    }
}

/// Runs the commands of a document in their order.
#[track_caller]
fn follow(name: &str) {
    let bench = bench();
    let mut followed = 0;
    for line in blocks(&workspace().join(name), "sh").iter().flat_map(|block| block.lines()) {
        if !line.starts_with("sci ") {
            assert!(
                OTHERS.iter().any(|other| line.starts_with(other)),
                "{name}: no test knows what this calls: {line}"
            );
        } else if ONLY_CHECKED.iter().any(|part| line.contains(part)) {
            check(&bench, line);
        } else {
            let run = shell(&bench, line);
            assert_eq!(run.code, 0, "{name}: {line}\n{}", run.stderr);
            followed += 1;
        }
    }
    assert!(followed > 0, "{name} has no commands");
}

macro_rules! followed {
    ($($test:ident: $name:literal),* $(,)?) => {
        $(#[test]
        fn $test() {
            follow($name);
        })*

        #[test]
        fn every_document_with_commands_is_followed() {
            let followed = [$($name),*];
            for document in documents() {
                let name = document.strip_prefix(workspace()).unwrap().to_str().unwrap();
                let commands = blocks(&document, "sh").iter().flat_map(|block| block.lines()).any(|line| {
                    line.starts_with("sci ") && !ONLY_CHECKED.iter().any(|part| line.contains(part))
                });
                assert_eq!(followed.contains(&name), commands, "{name}");
            }
        }
    };
}

followed! {
    the_readme: "README.md",
    many_machines: "docs/clusters.md",
    camera: "docs/guide/camera.md",
    choosing: "docs/guide/choosing.md",
    concepts: "docs/guide/concepts.md",
    developing: "docs/guide/developing.md",
    formats: "docs/guide/formats.md",
    large_scenes: "docs/guide/large.md",
    python: "docs/guide/python.md",
    training: "docs/guide/training.md",
}

#[test]
fn lines_that_are_not_run_are_checked() {
    let bench = bench();
    for document in documents() {
        for line in
            blocks(&document, "sh").iter().flat_map(|block| block.lines()).filter(|line| line.starts_with("sci "))
        {
            check(&bench, line);
        }
    }
}

#[test]
fn experiments_are_legal() {
    let mut checked = 0;
    for document in documents() {
        for text in blocks(&document, "toml") {
            let source = Source::new(&document, &text, &[], &|_| Err("no file".to_owned()));
            let experiment = source.and_then(|source| config::check(&source));
            assert!(experiment.is_ok(), "{}: {}", document.display(), experiment.unwrap_err());
            checked += 1;
        }
    }
    assert!(checked > 0);
}

#[test]
fn links_lead_somewhere() {
    for document in documents() {
        let text = fs::read_to_string(&document).unwrap();
        for link in text.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            let path = link.split('#').next().unwrap_or_default();
            if !link.starts_with("http") && !path.is_empty() {
                assert!(document.parent().unwrap().join(path).exists(), "{}: {link}", document.display());
            }
        }
    }
}
