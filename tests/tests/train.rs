//! `sci train` and `sci weights` from their files to weights: what is refused, what is made, and that a run which was stopped ends alike.
#![cfg(unix)]

use std::fs;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

use e2e::{Bench, Finished, workspace};
use ndarray::Array3;
use nets::weights::{Storage, write_safetensors};
use nets::{Ffdnet, FfdnetLayout, FfdnetSpec, Layers};
use serde_json::Value;

/// Wide enough for Muon's steps.
const CONFIG: &str = r#"
name = "tiny"
[network]
kind = "ffdnet"
channels = 1
width = 16
depth = 4
[data]
video = "video"
validation = "validation"
photo_share = 0.0
patch = 16
batch = 2
[noise]
sigma = [0, 50]
[training]
steps = 12
learning_rate = 2e-3
[validation]
every = 6
sigmas = [25]
frames = 2
[checkpoint]
every = 2
"#;

/// In place of `[noise]`: four lessons a step, or two through the solver.
const ITERATES: &str = "[camera]\nframes = [2, 4]\ndensity = [0.3, 0.7]\nholes = 0.1\n[iterates]\nsigmas = [50, 25, 12]\nstart_iterations = 2\n";

fn on_iterates(unrolled: bool) -> String {
    let table = format!("{ITERATES}unrolled = {unrolled}\n");
    CONFIG.replace("[noise]\nsigma = [0, 50]\n", &table).replace("[validation]", "precision = \"bf16\"\n[validation]")
}

const FILES: [&str; 5] =
    ["checkpoint.previous.safetensors", "checkpoint.safetensors", "log.jsonl", "loss.svg", "tiny.safetensors"];

/// `t.toml` with this text, beside frames to train on.
fn bench(config: &str) -> Bench {
    let bench = Bench::new();
    for folder in ["video/a", "validation/a"] {
        fs::create_dir_all(bench.path(folder)).unwrap();
        for t in 0..5 {
            let value =
                |y: usize, x: usize| 0.5 + 0.2 * ((y + 2 * t) as f32 * 0.4).sin() + 0.2 * (x as f32 * 0.3).cos();
            let frame = Array3::from_shape_fn((1, 24, 28), |(_, y, x)| value(y, x));
            bench.write(&format!("{folder}/{t}.png"), sci_cli::io::frames::png(frame.view()).unwrap());
        }
    }
    bench.write("t.toml", config);
    bench
}

fn train(bench: &Bench, arguments: &[&str]) -> Finished {
    bench.sci(&[&["train", "t.toml", "--out", "out"], arguments].concat())
}

#[track_caller]
fn ends(run: &Finished, code: i32, needles: &[&str]) {
    assert_eq!(run.code, code, "{}{}", run.stdout, run.stderr);
    assert!(!run.stderr.contains("panicked"), "{}", run.stderr);
    for needle in needles {
        assert!(run.stderr.contains(needle), "{needle:?} is not in: {}", run.stderr);
    }
}

fn bytes(bench: &Bench, name: &str) -> Vec<u8> {
    fs::read(bench.path(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
}

fn log(bench: &Bench) -> Vec<Value> {
    let text = String::from_utf8(bytes(bench, "out/log.jsonl")).unwrap();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// But for what a killed program leaves aside.
fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let mut names: Vec<String> = entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.retain(|name| !name.starts_with('.'));
    names.sort();
    names
}

#[test]
fn a_run_leaves_its_files_and_nothing_else_is_written_over() {
    let bench = bench(CONFIG);
    ends(&train(&bench, &[]), 0, &["step 12   σ 25: "]);
    assert_eq!(names(&bench.path("out")), FILES);
    let steps: Vec<u64> = log(&bench).iter().map(|line| line["step"].as_u64().unwrap()).collect();
    assert_eq!(steps, [6, 10, 12]);
    let before = FILES.map(|name| bytes(&bench, &format!("out/{name}")));
    ends(&train(&bench, &[]), 2, &["--out out: ", "is there already; give --resume"]);
    // Nothing is left to do.
    ends(&train(&bench, &["--resume"]), 0, &[]);
    assert_eq!(bytes(&bench, "out/tiny.safetensors"), before[4]);
    assert_eq!(bytes(&bench, "out/log.jsonl"), before[2]);

    for name in FILES {
        let folder = format!("with-{name}");
        fs::create_dir(bench.path(&folder)).unwrap();
        bench.write(&format!("{folder}/{name}"), "mine");
        let run = bench.sci(&["train", "t.toml", "--out", &folder]);
        ends(&run, 2, &[&format!("{folder}/{name} is there already")]);
        assert_eq!(names(&bench.path(&folder)), [name]);
        assert_eq!(bytes(&bench, &format!("{folder}/{name}")), b"mine");
    }
    bench.write("file", "");
    ends(&bench.sci(&["train", "t.toml", "--out", "file"]), 2, &["it is a file, expected a folder"]);
}

#[test]
fn mistakes_are_told_before_anything_is_made() {
    let bench = bench(CONFIG);
    let before = bench.names();
    for (set, code, needles) in [
        ("training.step=3", 2, ["--set training.step=3: unknown key", "did you mean `steps`?"]),
        ("training.steps=many", 2, ["`training.steps` = many is not legal", "expected u64"]),
        ("training.learning_rate=2", 2, ["training.learning_rate = 2", "above 0 and at most 1"]),
        ("network.depth=1", 2, ["network.depth = 1", "2 to 100"]),
        ("name=checkpoint", 2, ["`name` = \"checkpoint\" is not legal", "any name but that of the checkpoints"]),
        ("name=../x", 2, ["name = ../x", "it becomes a file name"]),
        ("weights=none.pth", 2, ["`weights` = \"none.pth\": no such file", "looked in"]),
        ("weights=bundled:none", 2, ["`weights` = \"bundled:none\" is not legal", "bundled:ffdnet_gray"]),
        ("data.video=none", 2, ["`data.video` = \"none\": no such file or folder", "looked in"]),
        ("data.validation=video/a", 1, ["data.validation: ", "holds no folders"]),
        ("weights=bundled:ffdnet_color", 1, ["t.toml: beginning with weights", "these are not the tensors of FFDNet"]),
    ] {
        ends(&train(&bench, &["--set", set]), code, &needles);
        assert_eq!(bench.names(), before, "{set}");
    }
    ends(&train(&bench, &["--resume"]), 2, &["--resume: out holds no run to go on with"]);
}

#[test]
fn a_resumed_run_must_be_the_same_one() {
    let bench = bench(CONFIG);
    ends(&train(&bench, &[]), 0, &[]);
    for (set, needle) in [
        ("noise.sigma=[0, 25]", "noise.sigma = [0.0,50.0], not [0.0,25.0]"),
        ("training.steps=13", "training.steps = 12, not 13"),
        ("training.optimizer=adam", "training.optimizer = \"muon\", not \"adam\""),
        ("name=other", "name = \"tiny\", not \"other\""),
    ] {
        ends(&train(&bench, &["--resume", "--set", set]), 1, &["checkpoint.safetensors", needle]);
    }
    fs::rename(bench.path("video"), bench.path("moved")).unwrap();
    ends(&train(&bench, &["--resume", "--set", "data.video=moved", "--set", "checkpoint.every=9"]), 0, &[]);
}

fn begin(bench: &Bench, arguments: &[&str]) -> Child {
    let mut command = bench.command(&[&["train", "t.toml"], arguments].concat());
    command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
}

/// Begins a run and sends it a signal after its first steps; whether it was still at work, and its exit code.
fn stopped(bench: &Bench, steps: &str, signal: &str) -> (bool, Option<i32>) {
    let mut child = begin(bench, &["--out", "stopped", "--set", steps]);
    while !bench.path("stopped/checkpoint.previous.safetensors").exists() {
        assert!(child.try_wait().unwrap().is_none(), "it ended without a checkpoint");
        sleep(Duration::from_millis(2));
    }
    let at_work = child.try_wait().unwrap().is_none();
    assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success() || !at_work);
    (at_work, child.wait().unwrap().code())
}

/// A run that gets a signal and goes on ends with the bytes of one that does not.
#[track_caller]
fn ends_alike(config: &str, signal: &str, code: Option<i32>) {
    // However fast the machine is, one of these is not over when the signal comes.
    for steps in [60, 600, 6000, 60_000].map(|n| format!("training.steps={n}")) {
        let bench = bench(config);
        let (at_work, ended) = stopped(&bench, &steps, signal);
        if !at_work || ended == Some(0) {
            continue;
        }
        assert_eq!(ended, code);
        for (out, resume) in [("stopped", &["--resume"][..]), ("straight", &[])] {
            let run = bench.sci(&[&["train", "t.toml", "--out", out, "--set", &steps], resume].concat());
            ends(&run, 0, &[]);
        }
        assert_eq!(names(&bench.path("stopped")), names(&bench.path("straight")));
        for name in ["tiny.safetensors", "checkpoint.safetensors"] {
            let of = |out: &str| bytes(&bench, &format!("{out}/{name}"));
            assert!(of("stopped") == of("straight"), "{name} differs");
        }
        return;
    }
    panic!("every run was over before the signal");
}

#[test]
fn after_ctrl_c_a_run_goes_on_bit_for_bit() {
    ends_alike(CONFIG, "-INT", Some(130));
}

#[test]
fn after_a_kill_a_run_on_iterates_goes_on_bit_for_bit() {
    ends_alike(&on_iterates(false), "-KILL", None);
}

#[test]
fn the_number_of_threads_changes_no_bit_of_several_lessons() {
    for unrolled in [false, true] {
        let bench = bench(&on_iterates(unrolled));
        let weights = ["1", "2"].map(|threads| {
            let run =
                bench.sci(&["train", "t.toml", "--set", "training.steps=3", "--threads", threads, "--out", threads]);
            ends(&run, 0, &["step 3   reconstruction: "]);
            bytes(&bench, &format!("{threads}/tiny.safetensors"))
        });
        assert!(weights[0] == weights[1], "unrolled = {unrolled}");
    }
}

#[test]
fn a_divergence_goes_back_to_a_checkpoint_at_half_the_rate() {
    let deep = CONFIG.replace("depth = 4", "depth = 20").replace("2e-3", "1.0\noptimizer = \"adam\"\nloss = \"l2\"");
    let bench = bench(&deep);
    ends(
        &train(&bench, &[]),
        0,
        &["warning: training diverged at step ", "going on from step 0 at 0.5 of the learning rate"],
    );
    let diverged: Vec<Value> = log(&bench).into_iter().filter(|line| !line["diverged"].is_null()).collect();
    assert_eq!((&diverged[0]["step"], &diverged[0]["rate"]), (&0.into(), &0.5.into()));
    let first = log(&bench).into_iter().find(|line| line["step"] == 10).unwrap();
    assert!(first["learning_rate"].as_f64().unwrap() < 0.5, "{first}");
    // What it went on with is resumed.
    let finished = bytes(&bench, "out/tiny.safetensors");
    ends(&train(&bench, &["--resume"]), 0, &[]);
    assert_eq!(bytes(&bench, "out/tiny.safetensors"), finished);
}

fn ffdnet(batch_norm: bool) -> Ffdnet {
    let layout = if batch_norm { FfdnetLayout::Residual { batch_norm } } else { FfdnetLayout::Direct };
    Ffdnet::random(FfdnetSpec { channels: 1, width: 4, depth: 3, layout }, 1).unwrap()
}

#[test]
fn weights_are_found_in_the_same_places_by_run_and_train() {
    let config =
        format!("weights = \"net.safetensors\"\n{}", CONFIG.replace("width = 16\ndepth = 4", "width = 4\ndepth = 3"));
    // Weights that were trained are of the layout with a residual connection.
    let folded = {
        let mut net = ffdnet(true);
        net.fold_batch_norm().unwrap();
        net.state()
    };
    let experiment = format!(
        "[data]\nkind = \"simulate\"\npath = '{}'\nmeasurements = [0]\n[data.mask]\nkind = \"random\"\nframes = 2\n[solver]\n\
         kind = \"gap\"\n[denoiser]\nkind = \"ffdnet\"\nweights = \"net.safetensors\"\n[[stage]]\nsigma = 25\niterations = 1\n",
        workspace().join("configs/demo/bunny").display()
    );
    for folder in ["here", "below", "data", "data/weights"] {
        let bench = bench("");
        for made in ["below", "here", "data/weights"] {
            fs::create_dir_all(bench.path(made)).unwrap();
        }
        // Both files lie in `below`; the current folder is `here`.
        bench.write("below/t.toml", &config);
        bench.write("below/a.toml", &experiment);
        write_safetensors(&bench.path(folder).join("net.safetensors"), &folded, Storage::F32).unwrap();
        for (arguments, out) in [
            (&["train", "../below/t.toml", "--set", "training.steps=1"][..], "trained"),
            (&["run", "../below/a.toml"], "solved"),
        ] {
            let mut command = bench.command(arguments);
            command.args(["--out", out]).current_dir(bench.path("here")).env("SCI_DATA", bench.path("data"));
            if arguments[0] == "train" {
                command.args(["--set", "data.video=../video", "--set", "data.validation=../validation"]);
            }
            ends(&bench.finish(&mut command), 0, &[]);
        }
    }
}

#[test]
fn weight_files_are_shown_and_converted() {
    let bench = Bench::new();
    let at = |name: &str| bench.path(name);
    write_safetensors(&at("net.safetensors"), &ffdnet(true).state(), Storage::F32).unwrap();
    let shown = bench.sci(&["weights", "inspect", "net.safetensors"]);
    ends(&shown, 0, &[]);
    assert!(shown.stdout.contains("network: FFDNet (gray, 4 channels, 3 layers, batch norm), "), "{}", shown.stdout);
    assert!(
        bench.sci(&["weights", "inspect", "bundled:ffdnet_gray"]).stdout.contains("network: FFDNet (gray, 64 channels")
    );

    ends(&bench.sci(&["weights", "convert", "net.safetensors", "half.safetensors", "--fold", "--half"]), 0, &[]);
    let shown = bench.sci(&["weights", "inspect", "half.safetensors"]).stdout;
    assert!(shown.contains("F16") && shown.contains("FFDNet (gray, 4 channels, 3 layers, residual)"), "{shown}");

    ends(&bench.sci(&["weights", "blend", "net.safetensors", "net.safetensors", "0.25", "same.safetensors"]), 0, &[]);
    let half_way = ["weights", "blend", "bundled:ffdnet_gray", "net.safetensors", "0.5", "no.safetensors"];
    ends(&bench.sci(&half_way), 1, &["net.safetensors", "bundled:ffdnet_gray"]);
    fs::remove_file(at("same.safetensors")).unwrap();
    let large = ffdnet(false).state().into_iter().map(|(name, t)| (name, t.affine(1.0, 1e5).unwrap())).collect();
    write_safetensors(&at("large.safetensors"), &large, Storage::F32).unwrap();
    let run = bench.sci(&["weights", "convert", "large.safetensors", "no.safetensors", "--half"]);
    ends(&run, 1, &["no.safetensors: tensor model.0.bias holds numbers beyond 65504"]);
    ends(&bench.sci(&["weights", "convert", "net.safetensors", "no.pth"]), 1, &["written as .safetensors only"]);
    ends(&bench.sci(&["weights", "inspect", "no.safetensors"]), 1, &["no.safetensors: cannot be read"]);
    bench.write("text.pth", "no weights");
    ends(
        &bench.sci(&["weights", "inspect", "text.pth"]),
        1,
        &["text.pth: neither a .pth nor a whole .safetensors file"],
    );
    assert_eq!(bench.names(), ["half.safetensors", "large.safetensors", "net.safetensors", "text.pth"]);
}

#[test]
fn a_hostile_pickle_ends_with_a_message() {
    let bench = Bench::new();
    let magic = b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.";
    bench.write("deep.pth", [&magic[..], b"N", &[0x85; 300_000], b"."].concat());
    bench.write("bomb.pth", [&magic[..], b"N", &b"q\x00h\x00\x86".repeat(30), b"."].concat());
    for name in ["deep.pth", "bomb.pth"] {
        ends(&bench.sci(&["weights", "inspect", name]), 1, &[name, "not a .pth file"]);
    }
}

#[test]
fn two_trainings_cannot_work_in_one_folder() {
    let bench = bench(CONFIG);
    let mut first = begin(&bench, &["--out", "out", "--set", "training.steps=100000"]);
    e2e::wait_for(&bench.path("out/checkpoint.safetensors"));
    let second = train(&bench, &["--set", "training.steps=100000", "--resume"]);
    first.kill().unwrap();
    first.wait().unwrap();
    ends(&second, 2, &["another training is at work there"]);
    // What a kill leaves is taken.
    ends(&train(&bench, &["--set", "training.steps=100000", "--set", "data.patch=12", "--resume"]), 1, &["data.patch"]);
}
