//! A camera on the bench: masks that sit elsewhere than told, noise, black level and clipping, through the commands.

use std::fs;

use e2e::Bench;
use serde_json::Value;

const CONFIG: &str = r#"
[data]
path = "scene.npz"
[solver]
kind = "gap"
accelerate = true
start = "mean"
[denoiser]
kind = "tv"
weight = 0.1
[[stage]]
iterations = 30
"#;

/// A scene simulated from a moving pattern, 48×48.
fn bench(simulate: &[&str]) -> Bench {
    let bench = Bench::new();
    bench.write("a.toml", CONFIG);
    let mut y4m = b"YUV4MPEG2 W48 H48 F25:1 Cmono XCOLORRANGE=FULL\n".to_vec();
    for t in 0..6usize {
        y4m.extend(b"FRAME\n");
        let bright = |y: usize, x: usize| (12..30).contains(&y) && (8 + 2 * t..26 + 2 * t).contains(&x);
        y4m.extend((0..48 * 48).map(|i| if bright(i / 48, i % 48) { 220u8 } else { 40 + (i % 48) as u8 }));
    }
    bench.write("video.y4m", y4m);
    let base = ["simulate", "video.y4m", "--out", "scene.npz", "--frames", "6", "--seed", "3"];
    let run = bench.sci(&[&base, simulate].concat());
    assert_eq!(run.code, 0, "{}", run.stderr);
    bench
}

/// PSNR of a run, and the record.
#[track_caller]
fn run(bench: &Bench, settings: &[&str]) -> (f64, Value) {
    let mut args = vec!["run", "a.toml", "--out", "out", "--set", "output=minimal"];
    settings.iter().for_each(|set| args.extend(["--set", set]));
    let run = bench.sci(&args);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let record = bench.record("out");
    (record["measurements"][0]["psnr_db"].as_f64().unwrap(), record)
}

#[test]
fn masks_that_sit_elsewhere_are_found_and_used() {
    let bench = bench(&[]);
    // Masks a pixel to the left of those that measured.
    let told = bench.sci(&["mask", "--out", "mask.npy", "--frames", "6", "--size", "48x48", "--seed", "3"]);
    assert_eq!(told.code, 0, "{}", told.stderr);
    let mask: ndarray::Array3<f32> = ndarray_npy::read_npy(bench.path("mask.npy")).unwrap();
    let moved = ndarray::Array3::from_shape_fn(mask.dim(), |(t, i, j)| mask[[t, i, (j + 1).min(47)]]);
    ndarray_npy::write_npy(bench.path("moved.npy"), &moved).unwrap();
    let wrong = "data.mask=moved.npy";
    let (off, _) = run(&bench, &[wrong]);
    let args = ["calibrate", "a.toml", "--set", wrong, "--out", "cal", "--reach", "1"];
    let found = bench.sci(&args);
    assert_eq!(found.code, 0, "{}", found.stderr);
    assert_eq!(fs::read_dir(bench.path("cal")).unwrap().count(), 3);
    let calibration: Value = serde_json::from_slice(&fs::read(bench.path("cal/calibration.json")).unwrap()).unwrap();
    let (by_file, record) = run(&bench, &[wrong, "data.calibration=cal/calibration.json"]);
    assert_eq!(record["calibration"], calibration);
    let (by_masks, _) = run(&bench, &["data.mask=cal/masks.npy"]);
    assert!(by_file > off + 3.0 && (by_file - by_masks).abs() < 1.0, "{off} {by_file} {by_masks}");
    assert!((calibration["shift"][1].as_f64().unwrap() - 1.0).abs() < 0.1, "{calibration}");
    let broken = bench.sci(&["run", "a.toml", "--out", "b", "--set", "data.calibration=scene.npz"]);
    assert_eq!(broken.code, 1);
    assert!(
        broken.stderr.contains("data.calibration") && broken.stderr.contains("not a calibration"),
        "{}",
        broken.stderr
    );
}

#[test]
fn noise_that_is_told_is_not_reconstructed() {
    let bench = bench(&["--sigma", "50"]);
    let (unaware, _) = run(&bench, &[]);
    let (aware, record) = run(&bench, &["data.sensor.noise=50"]);
    assert!(aware > unaware + 0.5, "{aware} {unaware}");
    let shown = record["config"]["data"]["sensor"]["noise"].as_f64().unwrap();
    assert!((shown - 50.0 / 255.0).abs() < 1e-6, "{shown}");
}

#[test]
fn a_black_level_is_taken_off() {
    let bench = bench(&[]);
    let (right, _) = run(&bench, &[]);
    // A level that is not there makes everything darker: the key does something, by its size.
    let (dark, _) = run(&bench, &["data.sensor.black=0.3"]);
    assert!(dark < right - 3.0, "{dark} {right}");
}

#[test]
fn a_level_that_is_no_number_is_refused() {
    let bench = bench(&[]);
    for set in ["data.sensor.clip=loud", "data.sensor.clip=-1", "data.sensor.black=\"x\"", "data.sensor.gain=2"] {
        let run = bench.sci(&["run", "a.toml", "--out", "out", "--set", set]);
        assert_eq!(run.code, 2, "{set}: {}", run.stderr);
        assert!(run.stderr.contains("data.sensor"), "{set}: {}", run.stderr);
    }
}

/// Nothing tells the unit of masks that exceed 1 by far: the result is the same whatever it is, and white is bright.
#[test]
fn the_unit_of_masks_does_not_matter() {
    let bench = bench(&[]);
    let read = |name: &str| {
        let mut scene = ndarray_npy::NpzReader::new(fs::File::open(bench.path("scene.npz")).unwrap()).unwrap();
        scene.by_name::<ndarray::OwnedRepr<f32>, ndarray::Ix3>(name).unwrap()
    };
    let (mask, meas) = (read("mask"), read("meas"));
    let gray = mask.mapv(|c| 0.1 + 0.8 * c);
    let recon = |unit: f32, gain: f32| {
        let mut file = ndarray_npy::NpzWriter::new(fs::File::create(bench.path("unit.npz")).unwrap());
        file.add_array("mask", &(&gray * unit)).unwrap();
        file.add_array("meas", &(&meas * gain)).unwrap();
        file.finish().unwrap();
        let args = ["run", "a.toml", "--set", "data.path=unit.npz", "--set", "output=minimal", "--out", "out"];
        let run = bench.sci(&args);
        assert!(run.code == 0 && run.stderr.contains("unit of their own"), "{}", run.stderr);
        let recon: ndarray::ArrayD<f32> = ndarray_npy::read_npy(bench.path("out/recon.npy")).unwrap();
        let brightest = recon.iter().copied().fold(0.0, f32::max);
        recon / brightest
    };
    let first = recon(113.0, 0.3);
    for (unit, gain) in [(255.0, 0.3), (113.0, 0.05), (10.0, 1.0)] {
        let off = (recon(unit, gain) - &first).fold(0f32, |m, d| m.max(d.abs()));
        assert!(off < 1e-3, "masks × {unit}, y × {gain}: {off}");
    }
}
