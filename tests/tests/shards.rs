//! A run in shards: processes that know nothing of each other solve it, and what is joined is what one would have made.
#![cfg(unix)]

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use e2e::{Bench, Finished, assert_same, contents, sci, wait_for};
use ndarray::Array3;

const CONFIG: &str = r#"
[data]
kind = "simulate"
path = "../video.npy"
[data.mask]
kind = "random"
density = 0.5
frames = 4
seed = 1
[solver]
kind = "gap"
[denoiser]
kind = "tv"
[[stage]]
iterations = 20
"#;

/// A folder with an experiment in `here`, and beside it a video for `measurements`.
fn bench(measurements: usize) -> Bench {
    let bench = Bench::new();
    let value = |t: usize, y: usize, x: usize| 0.5 + 0.4 * ((t + 3 * x) as f32 * 0.2).sin() * (y as f32 * 0.1).cos();
    let video = Array3::from_shape_fn((4 * measurements, 48, 64), |(t, y, x)| value(t, y, x));
    let mut bytes = Vec::new();
    ndarray_npy::WriteNpyExt::write_npy(&video, &mut bytes).unwrap();
    bench.write("video.npy", bytes);
    fs::create_dir(bench.path("here")).unwrap();
    bench.write("here/a.toml", CONFIG);
    bench
}

fn run(bench: &Bench, arguments: &[&str]) -> Finished {
    bench.sci(&[&["run", "here/a.toml"], arguments].concat())
}

fn gather(bench: &Bench) -> Finished {
    bench.sci(&["gather", "out"])
}

/// The run ended with `code` and has said all of this.
#[track_caller]
fn said(run: &Finished, code: i32, needles: &[&str]) {
    assert_eq!(run.code, code, "{}{}", run.stdout, run.stderr);
    for needle in needles {
        assert!(run.stdout.contains(needle) || run.stderr.contains(needle), "{needle:?}: {}{}", run.stdout, run.stderr);
    }
}

fn begin(bench: &Bench, arguments: &[&str]) -> Child {
    let mut command = bench.command(&[&["run", "here/a.toml", "--out", "out"], arguments].concat());
    command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
}

fn all_shards(bench: &Bench, count: usize, more: &[&str]) {
    let name = |i: usize| format!("{i}/{count}");
    let start = |i: usize| begin(bench, &[&["--shard", name(i).as_str()], more].concat());
    let children: Vec<Child> = (1..=count).map(start).collect();
    for mut child in children {
        assert!(child.wait().unwrap().success());
    }
}

#[test]
fn shards_at_once_become_what_one_process_makes() {
    let bench = bench(7);
    // A result of each kind, with a bound that the pictures of seven measurements share.
    for more in [&[][..], &["--set", "output.format=npz", "--set", "output.report_megabytes=1"]] {
        said(&run(&bench, &[&["--out", "whole"], more].concat()), 0, &[]);
        all_shards(&bench, 3, more);
        assert!(!bench.path("out/record.json").exists() || !more.is_empty());
        said(&gather(&bench), 0, &["7 measurements of 3 shards", "out/report.html"]);
        assert_same(&bench.path("out"), &bench.path("whole"));
    }
    let record = bench.record("out");
    let of: Vec<_> = record["shards"].as_array().unwrap().iter().map(|s| s["measurements"].to_string()).collect();
    assert_eq!(of, ["[0,1,2]", "[3,4]", "[5,6]"]);
    assert!(record["shards"].as_array().unwrap().iter().all(|s| s["wall_seconds"].as_f64() > Some(0.0)));
    // Late ones find that nothing is left.
    said(&gather(&bench), 0, &["nothing is left to gather"]);
    let late = ["--out", "out", "--set", "output.format=npz", "--set", "output.report_megabytes=1", "--shard", "2/3"];
    said(&run(&bench, &late), 0, &["nothing is unfinished"]);
    assert_same(&bench.path("out"), &bench.path("whole"));
}

#[test]
fn a_killed_shard_is_named_and_made_by_the_command_that_gather_prints() {
    let bench = bench(6);
    let long = ["--set", "stage.0.iterations=2000"];
    said(&run(&bench, &[&["--out", "whole"], &long[..]].concat()), 0, &[]);
    let mut child = begin(&bench, &[&long[..], &["--shard", "2/2"]].concat());
    wait_for(&bench.path("out/.sci-run/shard-2-of-2/m03"));
    child.kill().unwrap();
    child.wait().unwrap();
    let before = contents(&bench.path("out"));
    let missing = gather(&bench);
    said(
        &missing,
        1,
        &["shard 1/2 is missing: measurements 0 to 2", "shard 2/2 is missing", "2 of 2", "nothing was written"],
    );
    assert!(contents(&bench.path("out")).keys().all(|name| before.contains_key(name) || name.ends_with("lock")));
    for line in missing.stderr.lines().filter(|line| line.trim_start().starts_with("sci run ")) {
        let path = format!("{}:{}", sci().parent().unwrap().display(), std::env::var("PATH").unwrap());
        let mut shell = Command::new("bash");
        let made = bench.finish(shell.args(["-c", line.trim()]).current_dir(bench.path("")).env("PATH", path));
        said(&made, 0, &["when all are: sci gather out"]);
        assert_eq!(line.contains("2/2"), made.stdout.contains("going on: "), "{}", made.stdout);
    }
    said(&gather(&bench), 0, &[]);
    assert_same(&bench.path("out"), &bench.path("whole"));
}

#[test]
fn a_gather_that_is_killed_is_done_again() {
    let bench = bench(6);
    said(&run(&bench, &["--out", "whole"]), 0, &[]);
    for milliseconds in [0, 5, 10, 20, 40, 80] {
        let _ = fs::remove_dir_all(bench.path("out"));
        all_shards(&bench, 2, &[]);
        let mut child = bench.command(&["gather", "out"]).stdout(Stdio::null()).spawn().unwrap();
        std::thread::sleep(Duration::from_millis(milliseconds));
        child.kill().unwrap();
        child.wait().unwrap();
        said(&gather(&bench), 0, &[]);
        // What was being cleared up when it was killed the next run takes away.
        let _ = fs::remove_dir_all(bench.path("out/.sci-run-finished"));
        assert_same(&bench.path("out"), &bench.path("whole"));
    }
}

#[test]
fn shards_of_different_runs_are_not_joined() {
    let bench = bench(4);
    said(&run(&bench, &["--out", "out", "--shard", "1/2"]), 0, &["measurements 0, 1"]);
    let other = ["--out", "out", "--set", "stage.0.iterations=21", "--shard", "2/2"];
    let names = ["shard 2/2 is of another run than shard 1/2", "stage.0.iterations", "20", "21"];
    said(&run(&bench, &other), 2, &names);
    said(&run(&bench, &["--out", "out", "--shard", "3/3"]), 2, &["in 3 and of one in 2"]);
    said(&run(&bench, &["--out", "out"]), 2, &["in 2 shards", "sci gather", "--restart"]);
    // Begun at the same moment they could not know of each other.
    said(&run(&bench, &[&other[..], &["--restart"]].concat()), 0, &[]);
    let before = contents(&bench.path("out"));
    said(&gather(&bench), 2, &names);
    assert!(contents(&bench.path("out")).keys().all(|name| before.contains_key(name) || name.ends_with("lock")));
    said(&run(&bench, &["--out", "out", "--restart"]), 0, &[]);
    said(&run(&bench, &["--out", "whole"]), 0, &[]);
    assert_same(&bench.path("out"), &bench.path("whole"));
}

#[test]
fn a_shard_has_one_process_and_a_legal_number() {
    let bench = bench(2);
    let mut child = begin(&bench, &["--set", "stage.0.iterations=100000", "--shard", "1/2"]);
    wait_for(&bench.path("out/.sci-run/shard-1-of-2/run.json"));
    let same = ["--out", "out", "--set", "stage.0.iterations=100000", "--shard", "1/2"];
    said(&run(&bench, &same), 2, &["shard 1/2 is at work there"]);
    said(&gather(&bench), 1, &["shard 1/2 is at work", "shard 2/2 is missing: measurement 1"]);
    said(&run(&bench, &["--out", "out", "--restart"]), 2, &["shard 1/2 is at work there"]);
    child.kill().unwrap();
    child.wait().unwrap();
    for (shard, legal) in [("3/2", "1 to 2"), ("0/2", "1 to 2"), ("1", "I/N")] {
        said(&run(&bench, &["--out", "new", "--shard", shard]), 2, &["--shard", shard, legal]);
    }
    said(&run(&bench, &["--out", "new", "--shard", "3/5"]), 0, &["shard 3/5 has nothing to do", "2 measurements"]);
    said(&bench.sci(&["gather", "new"]), 1, &["no shards"]);
    assert!(!bench.path("new").exists());
}

#[test]
fn a_task_of_a_job_array_is_a_shard_by_itself() {
    let bench = bench(3);
    let task = |variables: &[(&str, &str)], more: &[&str]| {
        let mut command = bench.command(&[&["run", "here/a.toml", "--out", "out"], more].concat());
        command.envs(variables.iter().map(|(name, value)| (format!("SLURM_ARRAY_TASK_{name}"), value)));
        bench.finish(&mut command)
    };
    said(&task(&[("ID", "1"), ("COUNT", "2")], &[]), 2, &["SLURM_ARRAY_TASK_MIN", "--shard"]);
    said(&task(&[("ID", "9"), ("COUNT", "2"), ("MIN", "0")], &[]), 2, &["SLURM_ARRAY_TASK_ID is 9"]);
    // What is said on the command line is meant.
    said(&task(&[("ID", "1"), ("COUNT", "2"), ("MIN", "0")], &["--shard", "1/1"]), 0, &["3 measurements"]);
    assert!(bench.path("out/record.json").exists());
    fs::rename(bench.path("out"), bench.path("whole")).unwrap();
    for (id, number) in [("0", "shard 1/2"), ("1", "shard 2/2")] {
        said(&task(&[("ID", id), ("COUNT", "2"), ("MIN", "0")], &[]), 0, &[number, "Slurm"]);
    }
    said(&gather(&bench), 0, &[]);
    assert_same(&bench.path("out"), &bench.path("whole"));
}

#[test]
fn what_measurements_take_over_is_lost_where_a_shard_begins_and_that_is_said() {
    let bench = bench(4);
    let reuse = ["--out", "out", "--set", "solver.start=\"previous\""];
    let shard = |number: &'static str| [&reuse[..], &["--shard", number]].concat();
    let first = run(&bench, &shard("1/2"));
    said(&first, 0, &[]);
    assert!(!first.stderr.contains("warning"), "{}", first.stderr);
    said(&run(&bench, &shard("2/2")), 0, &["warning", "2 begins shard 2/2"]);
    said(&gather(&bench), 0, &["warning", "but 2 had none"]);
}

/// A network of random numbers, whose kernel can be chosen.
fn with_network(bench: &Bench) {
    let layout = nets::FfdnetLayout::Residual { batch_norm: false };
    let spec = nets::FfdnetSpec { width: 8, depth: 3, layout, ..nets::FfdnetSpec::GRAY };
    let net = nets::Ffdnet::random(spec, 0).unwrap();
    let path: &Path = &bench.path("net.safetensors");
    nets::weights::write_safetensors(path, &nets::Layers::state(&net), nets::weights::Storage::F32).unwrap();
    let config = CONFIG.replace("kind = \"tv\"", "kind = \"ffdnet\"\nweights = \"../net.safetensors\"");
    bench.write("here/a.toml", config.replace("iterations = 20", "iterations = 3\nsigma = 20"));
}

#[test]
fn other_processors_are_told_and_recorded() {
    let bench = bench(2);
    with_network(&bench);
    said(&run(&bench, &["--out", "out", "--shard", "1/2"]), 0, &[]);
    let mut other = bench.command(&["run", "here/a.toml", "--out", "out", "--shard", "2/2"]);
    said(&bench.finish(other.env("SCI_KERNEL", "portable")), 0, &[]);
    let joined = gather(&bench);
    let record = bench.record("out");
    if record["shards"][0]["kernel"] == "portable" {
        test_data::skip("this processor has one kernel");
        return;
    }
    said(&joined, 0, &["warning", "different kernels", "portable"]);
    assert_eq!(record["shards"][1]["kernel"], "portable");
    assert!(record["kernel"].as_str().unwrap().contains(", "), "{}", record["kernel"]);
}
