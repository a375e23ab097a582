//! The folder of a run: whatever stops the program, what is solved is there, and what is not the run's is not touched.
#![cfg(unix)]

use std::fs;
use std::os::unix::ffi::OsStringExt;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use e2e::{Bench, Finished, assert_same, contents, on_the_demo, page_data, sci, wait_for};
use ndarray::Array3;
use serde_json::Value;

const CONFIG: &str = r#"
[data]
path = "../scene"
[solver]
kind = "gap"
start = "previous"
[denoiser]
kind = "tv"
[[stage]]
iterations = 20
"#;

fn npy(array: &Array3<f32>) -> Vec<u8> {
    let mut bytes = Vec::new();
    ndarray_npy::WriteNpyExt::write_npy(array, &mut bytes).unwrap();
    bytes
}

/// A folder `here` with an experiment, and beside it a scene of `measurements` of 4 frames.
fn bench(measurements: usize) -> Bench {
    let bench = Bench::new();
    fs::create_dir(bench.path("scene")).unwrap();
    let value = |t: usize, y: usize, x: usize| 0.5 + 0.4 * ((t + 3 * x) as f32 * 0.2).sin() * (y as f32 * 0.1).cos();
    let orig = Array3::from_shape_fn((4 * measurements, 64, 64), |(t, y, x)| value(t, y, x));
    let mask = Array3::from_shape_fn((4, 64, 64), |(t, y, x)| ((t * 7 + y * 5 + x * 3) % 4 < 2) as u8 as f32);
    bench.write("scene/orig.npy", npy(&orig));
    bench.write("scene/mask.npy", npy(&mask));
    fs::create_dir(bench.path("here")).unwrap();
    bench.write("here/a.toml", CONFIG);
    bench
}

fn run(bench: &Bench, arguments: &[&str]) -> Finished {
    bench.sci(&[&["run", "here/a.toml"], arguments].concat())
}

#[track_caller]
fn ok(bench: &Bench, arguments: &[&str]) -> Finished {
    let run = run(bench, arguments);
    assert_eq!(run.code, 0, "{}", run.stderr);
    run
}

/// Must be refused with exit 2, with all of `needles` in the message.
#[track_caller]
fn refused(bench: &Bench, arguments: &[&str], needles: &[&str]) {
    let run = run(bench, arguments);
    assert_eq!(run.code, 2, "{}{}", run.stdout, run.stderr);
    for needle in needles {
        assert!(run.stderr.contains(needle), "{needle:?} is not in: {}", run.stderr);
    }
}

fn begin(bench: &Bench, arguments: &[&str]) -> Child {
    let mut command = bench.command(&[&["run", "here/a.toml"], arguments].concat());
    command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
}

/// A small generator, so that a failure can be repeated.
struct Random(u64);

impl Random {
    fn below(&mut self, n: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % n
    }
}

/// Kills runs at `kills` moments, resuming after each, until one comes to its end; again until there were that many.
fn kill_and_resume(bench: &Bench, more: &[&str], kills: usize) {
    let undisturbed = Instant::now();
    ok(bench, &[&["--out", "whole"], more].concat());
    let whole = undisturbed.elapsed().as_millis() as u64;
    let mut random = Random(0x9e37_79b9_7f4a_7c15);
    let (mut killed, mut resumed) = (0, 0);
    while killed < kills {
        let _ = fs::remove_dir_all(bench.path("killed"));
        loop {
            let mut child = begin(bench, &[&["--out", "killed", "--resume"], more].concat());
            std::thread::sleep(Duration::from_millis(random.below(whole + whole / 4)));
            let ended = child.try_wait().unwrap();
            child.kill().unwrap();
            child.wait().unwrap();
            if let Some(status) = ended {
                assert!(status.success(), "{status} after {killed} kills");
                break;
            }
            killed += 1;
            resumed += usize::from(bench.path("killed/.sci-run/m00").exists());
        }
        // Says so, or ends what was left: the last kill may have been that of a run that was clearing up.
        ok(bench, &[&["--out", "killed", "--resume"], more].concat());
        assert_same(&bench.path("killed"), &bench.path("whole"));
    }
    assert!(resumed > 0, "no kill left a solved measurement");
}

#[test]
fn a_run_killed_at_any_moment_ends_as_if_undisturbed() {
    kill_and_resume(&bench(6), &["--set", "stage.0.iterations=200"], 20);
}

#[test]
fn networks_that_adapt_go_on_as_they_were() {
    let bench = bench(4);
    let layout = nets::FfdnetLayout::Residual { batch_norm: false };
    let spec = nets::FfdnetSpec { width: 8, depth: 3, layout, ..nets::FfdnetSpec::GRAY };
    let net = nets::Ffdnet::random(spec, 0).unwrap();
    let mut tensors = nets::Layers::state(&net);
    tensors.values_mut().for_each(|t| *t = t.affine(0.3, 0.0).unwrap());
    nets::weights::write_safetensors(&bench.path("net.safetensors"), &tensors, nets::weights::Storage::F32).unwrap();
    // Some updates are kept and some rolled back, which lowers the learning rate for those that follow.
    let online = "[online]\nreuse = \"carry-over\"\ninterval = 2\nlearning_rate = 3e-3\nheld_out = 0.1\nsave = true\n";
    let config = CONFIG.replace("kind = \"tv\"", "kind = \"ffdnet\"\nweights = \"../net.safetensors\"");
    let config = config.replace("iterations = 20", "iterations = 30\nsigma = 20").replace("start = \"previous\"\n", "");
    bench.write("here/a.toml", config + online);
    ok(&bench, &["--out", "whole"]);
    for solved in ["m00", "m01", "m02"] {
        let mut child = begin(&bench, &["--out", "killed", "--resume"]);
        wait_for(&bench.path("killed/.sci-run").join(solved));
        child.kill().unwrap();
        child.wait().unwrap();
    }
    assert!(ok(&bench, &["--out", "killed", "--resume"]).stdout.contains("going on: 3 of 4"));
    assert_same(&bench.path("killed"), &bench.path("whole"));
    let record = bench.record("killed");
    let all = record["measurements"].as_array().unwrap();
    assert!(all.iter().any(|m| m["online"]["counts"]["rolled_back"].as_u64() > Some(0)), "nothing was rolled back");
    assert!(bench.path("killed/adapted-0-ffdnet.safetensors").is_file());
}

/// A run with its first measurement solved, killed in a later one.
fn stopped(bench: &Bench, out: &str) {
    let mut child = begin(bench, &["--out", out, "--set", "stage.0.iterations=400"]);
    wait_for(&bench.path(out).join(".sci-run/m00"));
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(!bench.path(out).join("record.json").exists());
}

#[test]
fn a_stopped_run_is_neither_thrown_away_nor_continued_by_another() {
    let bench = bench(6);
    stopped(&bench, "out");
    let same = ["--out", "out", "--set", "stage.0.iterations=400"];
    refused(&bench, &same, &["solved", "--resume", "--restart"]);
    let other = ["--out", "out", "--set", "stage.0.iterations=401", "--resume"];
    refused(&bench, &other, &["another one", "stage.0.iterations", "400", "401"]);
    let resumed = ok(&bench, &[&same[..], &["--resume"]].concat());
    assert!(resumed.stdout.contains("going on: ") && !resumed.stdout.contains("measurement  0"), "{}", resumed.stdout);
    let again = ok(&bench, &[&same[..], &["--resume"]].concat());
    assert!(again.stdout.contains("nothing is unfinished"), "{}", again.stdout);
    refused(&bench, &other, &["nothing is unfinished", "stage.0.iterations"]);
    // Other masks of the same size are another run, for a stopped and for a finished one.
    stopped(&bench, "masks");
    let mask = Array3::from_shape_fn((4, 64, 64), |(t, y, x)| ((t * 5 + y * 7 + x) % 4 < 2) as u8 as f32);
    bench.write("scene/mask.npy", npy(&mask));
    let of_masks = ["--out", "masks", "--set", "stage.0.iterations=400", "--resume"];
    refused(&bench, &of_masks, &["another one", "checksums.files"]);
    refused(&bench, &[&same[..], &["--resume"]].concat(), &["nothing is unfinished", "checksums.files"]);
    stopped(&bench, "new");
    let anew = ok(&bench, &["--out", "new", "--restart"]);
    assert!(anew.stdout.contains("measurement  0"), "{}", anew.stdout);
    assert!(!bench.path("new/.sci-run").exists());
}

#[test]
fn an_interrupt_writes_what_is_finished_and_keeps_what_a_resume_needs() {
    let bench = bench(6);
    let arguments = ["--out", "out", "--set", "stage.0.iterations=400"];
    let child = begin(&bench, &arguments);
    wait_for(&bench.path("out/.sci-run/m00"));
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    assert_eq!(child.wait_with_output().unwrap().status.code(), Some(130));
    let solved = bench.record("out")["measurements"].as_array().unwrap().len();
    assert!((1..6).contains(&solved) && bench.path("out/report.html").is_file());
    ok(&bench, &[&arguments[..], &["--resume"]].concat());
    ok(&bench, &["--out", "whole", "--set", "stage.0.iterations=400"]);
    assert_same(&bench.path("out"), &bench.path("whole"));
}

#[test]
fn two_runs_cannot_work_in_one_folder() {
    let bench = bench(6);
    let mut child = begin(&bench, &["--out", "out", "--set", "stage.0.iterations=100000"]);
    wait_for(&bench.path("out/.sci-run/run.json"));
    for wish in [&["--out", "out"][..], &["--out", "out", "--resume"], &["--out", "out", "--restart"]] {
        refused(&bench, wish, &["another run is at work"]);
    }
    child.kill().unwrap();
    child.wait().unwrap();
    // It had nothing solved, so nothing is in the way.
    ok(&bench, &["--out", "out"]);
}

#[test]
fn what_is_not_the_runs_is_neither_removed_nor_overwritten() {
    let bench = bench(1);
    for (name, is_folder) in [("frames", true), ("recon.npy", false), ("report.html", false), ("record.json", false)] {
        let dir = bench.path("foreign");
        fs::create_dir(&dir).unwrap();
        let mine = dir.join(name);
        if is_folder {
            fs::create_dir(&mine).unwrap();
        }
        let file = if is_folder { mine.join("1.png") } else { mine.clone() };
        fs::write(&file, "mine").unwrap();
        refused(&bench, &["--out", "foreign"], &["foreign", name]);
        assert_eq!(fs::read_to_string(&file).unwrap(), "mine");
        assert_eq!(fs::read_dir(&dir).unwrap().count(), 1, "nothing else is left in the folder");
        fs::remove_dir_all(&dir).unwrap();
    }
    // Beside names of its own a run is at home anywhere.
    ok(&bench, &["--out", "out"]);
    bench.write("out/notes.txt", "mine");
    bench.write("out/frames/mine.png", "mine");
    ok(&bench, &["--out", "out", "--set", "output.frames=false"]);
    assert_eq!(fs::read_to_string(bench.path("out/notes.txt")).unwrap(), "mine");
    let frames: Vec<_> = fs::read_dir(bench.path("out/frames")).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(frames, ["mine.png"]);
}

#[test]
fn a_run_of_an_earlier_version_is_not_replaced_unasked() {
    let bench = bench(1);
    ok(&bench, &["--out", "out"]);
    let mut record = bench.record("out");
    record.as_object_mut().unwrap().remove("files");
    bench.write("out/record.json", record.to_string());
    refused(&bench, &["--out", "out"], &["out", "`frames`", "earlier version", "remove the folder"]);
    let before = contents(&bench.path("out"));
    refused(&bench, &["--out", "out", "--restart"], &["earlier version"]);
    assert!(contents(&bench.path("out")) == before, "a refused run changes nothing");
}

#[test]
fn a_folder_never_holds_parts_of_two_runs() {
    let bench = bench(3);
    ok(&bench, &["--out", "out"]);
    assert!(bench.path("out/frames/m00_t00.png").is_file());
    let other = ["--set", "output.frames=false", "--set", "output.format=npz", "--set", "data.measurements=[2]"];
    ok(&bench, &[&["--out", "out"], &other[..]].concat());
    let names: Vec<PathBuf> = contents(&bench.path("out")).into_keys().collect();
    let expected = ["preview.gif", "recon.npz", "record.json", "report.html"].map(PathBuf::from);
    assert_eq!(names, expected);
    assert_eq!(bench.record("out")["files"], serde_json::json!(["preview.gif", "recon.npz", "report.html"]));
    ok(&bench, &["--out", "out", "--set", "output=minimal"]);
    let names: Vec<PathBuf> = contents(&bench.path("out")).into_keys().collect();
    assert_eq!(names, ["recon.npy", "record.json"].map(PathBuf::from));
}

#[test]
fn an_input_inside_the_destination_is_refused() {
    let bench = bench(1);
    refused(&bench, &["--out", "scene"], &["data.path", "input"]);
    refused(&bench, &["--out", "."], &["data.path", "input"]);
    symlink(bench.path("scene"), bench.path("link")).unwrap();
    refused(&bench, &["--out", "link"], &["data.path", "input"]);
    let names: Vec<_> = fs::read_dir(bench.path("scene")).unwrap().collect();
    assert_eq!(names.len(), 2);
}

#[test]
fn the_current_folder_and_links_to_other_disks_are_destinations() {
    let bench = bench(2);
    let mut here = bench.command(&["run", "a.toml", "--out", "."]);
    let run = bench.finish(here.current_dir(bench.path("here")));
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(bench.path("here/record.json").is_file() && bench.path("here/a.toml").is_file());
    let Ok(elsewhere) = tempfile::Builder::new().prefix("sci-test-").tempdir_in("/dev/shm") else {
        eprintln!("skipped: no /dev/shm for a link to another file system");
        return;
    };
    symlink(elsewhere.path(), bench.path("out")).unwrap();
    ok(&bench, &["--out", "out"]);
    assert!(elsewhere.path().join("record.json").is_file());
    assert_same(&bench.path("out"), elsewhere.path());
    ok(&bench, &["--out", "out", "--set", "output=minimal"]);
    assert_eq!(fs::read_dir(elsewhere.path()).unwrap().count(), 2);
}

#[test]
fn a_folder_that_cannot_be_written_is_found_out_before_anything_is_solved() {
    let bench = bench(1);
    let locked = bench.path("locked");
    fs::create_dir(&locked).unwrap();
    fs::set_permissions(&locked, fs::Permissions::from_mode(0o555)).unwrap();
    let mut command = bench.command(&["run", "here/a.toml", "--out", "locked"]);
    if fs::write(locked.join("probe"), "").is_ok() {
        // The permissions do not bind this user: as nobody, who has to get into the folder and at the program.
        fs::remove_file(locked.join("probe")).unwrap();
        fs::set_permissions(bench.path("."), fs::Permissions::from_mode(0o755)).unwrap();
        std::os::unix::process::CommandExt::uid(&mut command, 65534);
    }
    let Ok(output) = command.output() else {
        eprintln!("skipped: no user for whom a folder is read-only can run the program");
        return;
    };
    let (said, error) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(
        error.contains("cannot write") && error.contains("locked") && !said.contains("measurement  0"),
        "{said}{error}"
    );
}

#[test]
fn a_full_disk_costs_at_most_the_measurement_in_work() {
    let bench = bench(6);
    ok(&bench, &["--out", "whole"]);
    // Files of more than the measurement's 64 KiB cannot be written: the joined result does not fit.
    let limited = |blocks: usize, more: &str| {
        let script = format!(
            "trap '' XFSZ; ulimit -f {blocks}; exec \"$0\" run here/a.toml --out out --set output.report=false {more}"
        );
        let mut command = Command::new("bash");
        command.args(["-c", &script]).arg(sci()).current_dir(bench.path(".")).env_remove("SCI_DATA");
        bench.finish(&mut command)
    };
    let failed = limited(100, "");
    assert_eq!(failed.code, 1, "{}", failed.stderr);
    assert!(failed.stderr.contains("--resume") && failed.stderr.contains("recon.npy"), "{}", failed.stderr);
    assert!(!bench.path("out/record.json").exists());
    let resumed = limited(10_000, "--resume");
    assert_eq!(resumed.code, 0, "{}", resumed.stderr);
    assert!(resumed.stdout.contains("6 of 6 are solved"), "{}", resumed.stdout);
    assert_eq!(fs::read(bench.path("out/recon.npy")).unwrap(), fs::read(bench.path("whole/recon.npy")).unwrap());
    // Not even a measurement fits: nothing is left, and the next run is not held up.
    let nothing = limited(32, "--restart");
    assert_eq!(nothing.code, 1, "{}", nothing.stderr);
    assert!(!bench.path("out/.sci-run").exists() && bench.path("out/record.json").is_file());
}

/// A file system of its own, of `size`, gone with the test.
struct Disk(PathBuf);

impl Disk {
    /// Nothing, and a word, where none may be mounted.
    fn mount(at: PathBuf, size: &str) -> Option<Self> {
        fs::create_dir(&at).unwrap();
        if mount(&at, &format!("size={size}")) {
            return Some(Self(at));
        }
        test_data::skip("no file system can be mounted (that takes root, and a system that lets it)");
        None
    }

    fn grow(&self, size: &str) {
        assert!(mount(&self.0, &format!("remount,size={size}")));
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(&self.0).status();
    }
}

fn mount(at: &Path, options: &str) -> bool {
    let mount = Command::new("mount").args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(at).output();
    mount.is_ok_and(|output| output.status.success())
}

#[test]
fn a_full_file_system_loses_nothing_that_is_solved() {
    let bench = bench(6);
    ok(&bench, &["--out", "whole"]);
    // A measurement takes 64 KiB and its pictures as much again.
    let Some(disk) = Disk::mount(bench.path("disk"), "384k") else { return };
    let failed = run(&bench, &["--out", "disk/out"]);
    assert_eq!(failed.code, 1, "{}", failed.stderr);
    assert!(failed.stderr.contains("No space left") && failed.stderr.contains("--resume"), "{}", failed.stderr);
    assert!(!bench.path("disk/out/record.json").exists());
    disk.grow("16m");
    let resumed = ok(&bench, &["--out", "disk/out", "--resume"]);
    assert!(resumed.stdout.contains("going on: "), "{}", resumed.stdout);
    assert_same(&bench.path("disk/out"), &bench.path("whole"));
}

#[test]
fn memory_does_not_grow_with_the_number_of_measurements() {
    const RESULT: u64 = 16 * 128 * 128 * 4;
    let peak = |measurements: usize| {
        let bench = Bench::new();
        fs::create_dir(bench.path("scene")).unwrap();
        let mask = Array3::from_shape_fn((16, 128, 128), |(t, y, x)| ((t * 7 + y * 5 + x * 3) % 4 < 2) as u8 as f32);
        let meas = Array3::from_shape_fn((measurements, 128, 128), |(k, y, x)| 4.0 + ((k + y + x) % 7) as f32 * 0.1);
        bench.write("scene/mask.npy", npy(&mask));
        bench.write("scene/meas.npy", npy(&meas));
        fs::create_dir(bench.path("here")).unwrap();
        bench.write("here/a.toml", CONFIG.replace("iterations = 20", "iterations = 2"));
        // One thread has one heap.
        ok(&bench, &["--out", "out", "--threads", "1"]);
        bench.record("out")["peak_rss_bytes"].as_u64().unwrap()
    };
    let (few, many) = (peak(2), peak(42));
    if few == 0 {
        test_data::skip("the system does not tell how much memory a process had");
        return;
    }
    assert!(
        many < few + 10 * RESULT,
        "{few} bytes for 2 measurements, {many} for 42, whose results take {}",
        42 * RESULT
    );
}

#[test]
fn names_that_are_not_utf8_are_names() {
    let bench = bench(1);
    let odd = bench.path(".").join(std::ffi::OsString::from_vec(b"caf\xe9".to_vec()));
    fs::create_dir(&odd).unwrap();
    fs::copy(bench.path("here/a.toml"), odd.join("a.toml")).unwrap();
    for name in ["mask.npy", "orig.npy"] {
        fs::create_dir_all(odd.join("scene")).unwrap();
        fs::copy(bench.path("scene").join(name), odd.join("scene").join(name)).unwrap();
    }
    let mut command = bench.command(&["run", "a.toml", "--out", "o", "--set", "data.path=scene"]);
    let run = bench.finish(command.current_dir(&odd));
    assert_eq!(run.code, 0, "{}", run.stderr);
    let record: Value = serde_json::from_slice(&fs::read(odd.join("o/record.json")).unwrap()).unwrap();
    assert!(record["config"]["data"]["path"].as_str().unwrap().contains("caf\u{fffd}"));
    let mut again = bench.command(&["run", "a.toml", "--out", "o", "--resume", "--set", "data.path=scene"]);
    assert!(bench.finish(again.current_dir(&odd)).stdout.contains("nothing is unfinished"));
}

#[test]
fn a_record_can_be_run_again_and_says_what_ran() {
    let bench = bench(2);
    ok(&bench, &["--out", "first", "--set", "stage.0.iterations=7"]);
    let record = bench.record("first");
    let written = &record["config"]["written"];
    bench.write("here/again.toml", written["text"].as_str().unwrap());
    let set: Vec<&str> = written["set"].as_array().unwrap().iter().map(|s| s.as_str().unwrap()).collect();
    let mut arguments = vec!["run", "here/again.toml", "--out", "second"];
    set.iter().for_each(|s| arguments.extend(["--set", s]));
    assert_eq!(bench.sci(&arguments).code, 0);
    let recon = |run: &str| fs::read(bench.path(run).join("recon.npy")).unwrap();
    assert_eq!(recon("first"), recon("second"));
    assert!(["avx512", "avx2", "neon", "portable"].contains(&record["kernel"].as_str().unwrap()));
    assert_eq!(record["precision_used"], "f32");
    assert!(record["wall_seconds"].as_f64() > record["mean"]["seconds"].as_f64());
}

#[test]
fn the_page_of_a_run_is_made_again_from_its_folder() {
    let bench = bench(2);
    ok(&bench, &["--out", "out"]);
    let page = fs::read_to_string(bench.path("out/report.html")).unwrap();
    fs::remove_file(bench.path("out/report.html")).unwrap();
    let made = bench.sci(&["report", "out"]);
    assert_eq!(made.code, 0, "{}", made.stderr);
    let images = |page: &str| page_data(page)["images"].clone();
    assert!(images(&fs::read_to_string(bench.path("out/report.html")).unwrap()) == images(&page));
    // Without the scene there are the results.
    fs::remove_dir_all(bench.path("scene")).unwrap();
    let made = bench.sci(&["report", "out", "--out", "alone.html"]);
    assert_eq!(made.code, 0, "{}", made.stderr);
    assert!(made.stderr.contains("cannot be read again"), "{}", made.stderr);
    assert!(fs::read_to_string(bench.path("alone.html")).unwrap().contains("data:image/png"));
}

#[test]
fn a_report_keeps_its_size() {
    let bench = Bench::new();
    bench.write("scene.toml", on_the_demo("gray/gap-tv-fast.toml", "kind = \"random\""));
    let run = bench.sci(&[
        "run",
        "scene.toml",
        "--out",
        "run",
        "--set",
        "stage.0.iterations=2",
        "--set",
        "output.report_megabytes=1",
    ]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let page = fs::read_to_string(bench.path("run/report.html")).unwrap();
    assert!(page.len() < 1_100_000, "{} bytes", page.len());
    assert!(page_data(&page)["images"][0]["step"].as_u64() > Some(1), "frames are left out");
}

/// Masks that are a folder of pictures are told from others of the same name.
#[test]
fn other_pictures_of_masks_are_another_run() {
    let bench = bench(2);
    ok(&bench, &["--out", "made", "--set", "data.measurements=[0]"]);
    fs::rename(bench.path("made/frames"), bench.path("masks")).unwrap();
    let (mut names, size) = (Vec::new(), 64);
    for entry in fs::read_dir(bench.path("masks")).unwrap() {
        names.push(entry.unwrap().path());
    }
    names.sort();
    let y = Array3::from_shape_fn((2, size, size), |(k, i, j)| 0.5 + 0.01 * (k + i * j % 7) as f32);
    bench.write("y.npy", npy(&y));
    let sets = ["--out", "out", "--set", "data.path=y.npy", "--set", "data.mask=masks"];
    ok(&bench, &[&sets[..], &["--shard", "1/2"]].concat());
    fs::copy(&names[0], &names[1]).unwrap();
    refused(&bench, &[&sets[..], &["--shard", "2/2"]].concat(), &["checksums"]);
}
