//! Every format in and out, through the commands: the same scene must give the same result from each.

use std::fs;

use e2e::{Bench, workspace};
use serde_json::Value;

const CONFIG: &str = r#"
[data]
path = "unset"
[solver]
kind = "gap"
start = "tv"
[denoiser]
kind = "tv"
weight = 0.1
[[stage]]
iterations = 5
"#;

fn bench() -> Bench {
    let bench = Bench::new();
    bench.write("a.toml", CONFIG);
    for name in ["scene_v7.mat", "scene.npz"] {
        fs::copy(workspace().join("tests/fixtures").join(name), bench.path(name)).unwrap();
    }
    bench
}

/// Runs the config on `scene` and returns the bytes of recon.npy.
#[track_caller]
fn recon(bench: &Bench, scene: &str, more: &[&str]) -> Vec<u8> {
    let path = format!("data.path={scene}");
    let run = bench.sci(&[&["run", "a.toml", "--out", "out", "--set", &path], more].concat());
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(!run.stderr.contains("warning"), "{}", run.stderr);
    fs::read(bench.path("out/recon.npy")).unwrap()
}

/// Runs a command that must succeed.
#[track_caller]
fn ok(bench: &Bench, args: &[&str]) -> String {
    let run = bench.sci(args);
    assert_eq!(run.code, 0, "{args:?}: {}", run.stderr);
    run.stdout
}

/// `sci metrics` between two videos.
#[track_caller]
fn psnr(bench: &Bench, a: &str, b: &str) -> f64 {
    let out: Value = serde_json::from_str(&ok(bench, &["metrics", a, b, "--json"])).unwrap();
    // Equal videos have an infinite PSNR, which JSON cannot say.
    out["psnr_db"].as_f64().unwrap_or(f64::INFINITY)
}

/// A noiseless 8-bit video of 8 frames as Y4M.
fn y4m() -> Vec<u8> {
    let mut bytes = b"YUV4MPEG2 W24 H16 F25:1 Cmono XCOLORRANGE=FULL\n".to_vec();
    for t in 0..8u32 {
        bytes.extend(b"FRAME\n");
        bytes.extend((0..16u32).flat_map(|y| (0..24u32).map(move |x| (20 * t + 5 * y + x) as u8)));
    }
    bytes
}

#[test]
fn mat_v5_by_scipy_and_npz_by_numpy_hold_the_same_scene() {
    let bench = bench();
    bench.write("from_mat.npy", recon(&bench, "scene_v7.mat", &[]));
    bench.write("from_npz.npy", recon(&bench, "scene.npz", &[]));
    // One has measurements in f64, for the other they are simulated in f32.
    assert!(psnr(&bench, "from_mat.npy", "from_npz.npy") > 100.0);
}

#[test]
fn mat_v73_has_reversed_axes() {
    let bench = bench();
    let mask = |t: usize, y: usize, x: usize| u8::from((3 * t + 5 * y + 7 * x) % 4 < 2);
    let orig = |t: usize, y: usize, x: usize| (40 * t + 7 * y + 3 * x) as u8;
    let (h, w) = (6, 5);
    // MATLAB's [H, W, T] is stored as [T, W, H]; NumPy's is [T, H, W].
    let matlab = |n: usize, f: &dyn Fn(usize, usize, usize) -> u8| -> Vec<u8> {
        (0..n)
            .flat_map(|t| (0..w).flat_map(move |x| (0..h).map(move |y| (t, y, x))))
            .map(|(t, y, x)| f(t, y, x))
            .collect()
    };
    let mut file = hdf5_pure::FileBuilder::new();
    file.with_userblock(512).with_userblock_content(b"MATLAB 7.3 MAT-file");
    file.create_dataset("mask").with_u8_data(&matlab(2, &mask)).with_shape(&[2, w as u64, h as u64]);
    file.create_dataset("orig").with_u8_data(&matlab(4, &orig)).with_shape(&[4, w as u64, h as u64]);
    let hdf5 = file.finish().unwrap();
    bench.write("plain.mat", &hdf5);

    fs::create_dir(bench.path("folder")).unwrap();
    let npy = |n: usize, f: &dyn Fn(usize, usize, usize) -> u8| -> Vec<u8> {
        let mut bytes = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
        let header = format!("{{'descr': '|u1', 'fortran_order': False, 'shape': ({n}, {h}, {w}), }}");
        bytes.extend(format!("{header:117}\n").bytes());
        bytes.extend(
            (0..n).flat_map(|t| (0..h).flat_map(move |y| (0..w).map(move |x| (t, y, x)))).map(|(t, y, x)| f(t, y, x)),
        );
        bytes
    };
    bench.write("folder/mask.npy", npy(2, &mask));
    bench.write("folder/orig.npy", npy(4, &orig));
    assert_eq!(recon(&bench, "plain.mat", &[]), recon(&bench, "folder", &[]));
    let darker = recon(&bench, "folder", &["--set", "data.scale=510"]);
    assert_ne!(darker, recon(&bench, "folder", &[]));
}

/// Stands in for ffmpeg: a script that gives two frames, whatever it is asked for.
#[cfg(unix)]
#[test]
fn clips_are_simulated_from_through_ffmpeg() {
    use std::os::unix::fs::PermissionsExt;
    let bench = bench();
    bench.write("clip.mp4", b"\0\0\0\x20ftypisom");
    let args = ["simulate", "clip.mp4", "--frames", "2", "--out", "s.npz"];
    let without = bench.command(&args).env("PATH", bench.path("nowhere")).output().unwrap();
    let said = String::from_utf8_lossy(&without.stderr).into_owned();
    assert!(without.status.code() == Some(1) && said.contains("clip.mp4") && said.contains("ffmpeg"), "{said}");
    fs::create_dir(bench.path("bin")).unwrap();
    let picture = r"printf 'P6\n4 2\n255\n'; printf 'abcabcdefdefghighijkljkl'";
    bench.write("bin/ffmpeg", format!("#!/bin/sh\n{picture}\n{picture}\n"));
    fs::set_permissions(bench.path("bin/ffmpeg"), fs::Permissions::from_mode(0o755)).unwrap();
    let with = bench.command(&args).env("PATH", bench.path("bin")).output().unwrap();
    let said = String::from_utf8_lossy(&with.stdout).into_owned();
    assert!(said.contains("1 measurements of 2 frames of 2×4"), "{said}{}", String::from_utf8_lossy(&with.stderr));
}

#[test]
fn masks_in_a_file_of_their_own_and_mistakes_about_them() {
    let bench = bench();
    bench.write("clip.y4m", y4m());
    ok(&bench, &["mask", "--kind", "shifting", "--frames", "4", "--size", "16x24", "--seed", "3", "--out", "m.npy"]);
    ok(&bench, &["simulate", "clip.y4m", "--mask-file", "m.npy", "--out", "s.npz"]);
    let together = recon(&bench, "s.npz", &[]);
    assert_eq!(together, recon(&bench, "s.npz", &["--set", "data.mask=m.npy"]));
    for (setting, part) in [
        ("data.mask_shift=[1, 0]", "data.frames"),
        ("data.frames=4", "data.mask_shift"),
        ("data.raw={format=\"mono12p\", height=3}", "data.raw.width"),
        ("data.raw={format=\"mono13\", height=3, width=3}", "mono12packed"),
        ("data.mask=nowhere.npy", "nowhere.npy"),
    ] {
        let run = bench.sci(&["run", "a.toml", "--out", "out", "--set", "data.path=s.npz", "--set", setting]);
        assert!(run.code != 0 && run.stderr.contains(part), "{setting}: {}", run.stderr);
    }
    let moved = ["--set", "data.mask_shift=[0, 65]", "--set", "data.frames=4"];
    let run = bench.sci(&[&["run", "a.toml", "--out", "out", "--set", "data.path=s.npz"], &moved[..]].concat());
    assert!(run.code != 0 && run.stderr.contains("from -64 to 64"), "{}", run.stderr);
}

#[test]
fn simulated_scenes_agree_in_every_container() {
    let bench = bench();
    bench.write("clip.y4m", y4m());
    for out in ["s.npz", "s.mat"] {
        let said = ok(&bench, &["simulate", "clip.y4m", "--frames", "4", "--seed", "7", "--out", out]);
        assert!(said.contains("2 measurements of 4 frames of 16×24"), "{said}");
    }
    recon(&bench, "s.npz", &[]);
    let from_npz = bench.record("out")["mean"]["psnr_db"].as_f64().unwrap();
    recon(&bench, "s.mat", &[]);
    let from_mat = bench.record("out")["mean"]["psnr_db"].as_f64().unwrap();
    let simulate = ["--set", "data.kind=simulate", "--set", "data.mask={kind=\"random\", frames=4, seed=7}"];
    recon(&bench, "clip.y4m", &simulate);
    let from_config = bench.record("out")["mean"]["psnr_db"].as_f64().unwrap();
    assert!(
        (from_npz - from_mat).abs() < 1e-3 && (from_npz - from_config).abs() < 1e-3,
        "{from_npz} {from_mat} {from_config}"
    );
    assert!(psnr(&bench, "s.mat", "clip.y4m") > 100.0 && psnr(&bench, "s.npz", "clip.y4m") > 100.0);
}

#[test]
fn every_output_reads_back_as_the_result() {
    let bench = bench();
    bench.write("clip.y4m", y4m());
    ok(&bench, &["simulate", "clip.y4m", "--frames", "4", "--out", "s.npz"]);
    for (format, result) in [("npz", "recon.npz"), ("mat", "recon.mat"), ("npy", "recon.npy"), ("tiff", "recon.tif")] {
        let set = format!("output.format={format}");
        ok(&bench, &["run", "a.toml", "--out", format, "--set", "data.path=s.npz", "--set", &set]);
        let mut names: Vec<_> = fs::read_dir(bench.path(format)).unwrap().map(|e| e.unwrap().file_name()).collect();
        names.sort();
        assert_eq!(names, ["frames", "preview.gif", result, "record.json", "report.html"]);
    }
    let truth = psnr(&bench, "npy/recon.npy", "clip.y4m");
    let recorded = bench.record("npy")["mean"]["psnr_db"].as_f64().unwrap();
    assert!((truth - recorded).abs() < 0.02, "{truth} {recorded}");
    assert!(psnr(&bench, "npz/recon.npz", "npy/recon.npy") > 120.0);
    assert!(psnr(&bench, "mat/recon.mat", "npy/recon.npy") > 120.0);
    // Eight bits a sample: an error of at most half a level, unless the result leaves [0, 1].
    assert!(psnr(&bench, "npy/frames", "npy/recon.npy") > 50.0);
    assert!(psnr(&bench, "npy/preview.gif", "npy/frames").is_infinite());
}

#[test]
fn masks_are_seeded_and_fit_a_simulation() {
    let bench = bench();
    bench.write("clip.y4m", y4m());
    let mask = |out: &str, seed: &str| {
        ok(&bench, &["mask", "--kind", "shifting", "--frames", "4", "--size", "16x24", "--seed", seed, "--out", out]);
        fs::read(bench.path(out)).unwrap()
    };
    assert_eq!(mask("a.npy", "3"), mask("b.npy", "3"));
    assert_ne!(mask("a.npy", "3"), mask("c.npy", "4"));
    mask("m.mat", "3");
    for file in ["a.npy", "m.mat"] {
        ok(&bench, &["simulate", "clip.y4m", "--mask-file", file, "--out", &format!("{file}.npz")]);
    }
    assert_eq!(recon(&bench, "a.npy.npz", &[]), recon(&bench, "m.mat.npz", &[]));
}

#[test]
fn the_result_depends_neither_on_threads_nor_on_the_day() {
    let bench = bench();
    bench.write("clip.y4m", y4m());
    ok(&bench, &["simulate", "clip.y4m", "--frames", "4", "--sigma", "3", "--photons", "500", "--out", "s.npz"]);
    let one = recon(&bench, "s.npz", &["--threads", "1"]);
    assert_eq!(bench.record("out")["threads"], 1);
    assert_eq!(one, recon(&bench, "s.npz", &["--threads", "2"]));
    assert_eq!(bench.record("out")["threads"], 2);
    assert_eq!(one, recon(&bench, "s.npz", &["--threads", "2"]));
}

#[test]
fn a_previous_start_continues_from_the_measurement_before() {
    let bench = bench();
    let trace = |start: &str, measurements: &str| {
        recon(&bench, "scene.npz", &["--set", start, "--set", measurements]);
        let record = bench.record("out");
        record["measurements"].as_array().unwrap().iter().map(|m| m["trace"]["psnr_db"].clone()).collect::<Vec<_>>()
    };
    let previous = trace("solver.start=previous", "data.measurements=[0, 1]");
    let mean = trace("solver.start=mean", "data.measurements=[0, 1]");
    assert_eq!(previous[0], mean[0], "the first starts from the mean");
    assert_ne!(previous[1], mean[1]);
    let alone = trace("solver.start=previous", "data.measurements=[1]");
    assert_eq!(alone[0], mean[1]);
}

#[test]
fn a_table_of_runs() {
    let bench = bench();
    recon(&bench, "scene.npz", &[]);
    let table = ok(&bench, &["report", "out"]);
    assert!(table.contains("scene.npz") && table.contains("PSNR"), "{table}");
    let run = bench.sci(&["report", "nowhere"]);
    assert_eq!(run.code, 1);
    assert!(run.stderr.contains("nowhere"), "{}", run.stderr);
}

/// Ctrl-C: the exit code says so, and what was done is there.
#[cfg(unix)]
#[test]
fn an_interrupt_keeps_what_is_finished() {
    use std::io::{BufRead, BufReader};
    use std::process::{Command, Stdio};
    let bench = bench();
    let args = ["run", "a.toml", "--out", "out", "--set", "data.path=scene.npz", "--set", "stage.0.iterations=100000"];
    let mut child = bench
        .command(&args)
        .args(["--set", "stop.seconds=60"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // The first line is printed once everything is loaded.
    let mut line = String::new();
    BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    std::thread::sleep(std::time::Duration::from_millis(200));
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130), "{}", String::from_utf8_lossy(&output.stderr));
    let record = bench.record("out");
    let last = record["measurements"].as_array().unwrap().last().unwrap().clone();
    assert_eq!(last["stop"], "observer", "{last}");
    assert!(bench.path("out/recon.npy").is_file());
}
