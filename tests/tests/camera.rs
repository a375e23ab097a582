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
    // Its masks.npy would be in the place of what it reads.
    let onto = bench.sci(&["calibrate", "a.toml", "--set", wrong, "--out", "."]);
    assert!(onto.code == 2 && onto.stderr.contains("it holds an input"), "{}", onto.stderr);
    let calibration: Value = serde_json::from_slice(&fs::read(bench.path("cal/calibration.json")).unwrap()).unwrap();
    let (by_file, record) = run(&bench, &[wrong, "data.calibration=cal/calibration.json"]);
    assert_eq!(record["calibration"], calibration);
    let (by_masks, _) = run(&bench, &["data.mask=cal/masks.npy"]);
    assert!(by_file > off + 3.0 && (by_file - by_masks).abs() < 1.0, "{off} {by_file} {by_masks}");
    assert!((calibration["shift"][1].as_f64().unwrap() - 1.0).abs() < 0.1, "{calibration}");
    // What was beyond the edge of the masks that were told is not guessed: it counts as not measured.
    let found: ndarray::Array3<f32> = ndarray_npy::read_npy(bench.path("cal/masks.npy")).unwrap();
    let open = |column: usize| found.index_axis(ndarray::Axis(2), column).sum();
    assert!(open(0) == 0.0 && open(1) > 10.0 && open(47) > 10.0, "{} {} {}", open(0), open(1), open(47));
    let broken = bench.sci(&["run", "a.toml", "--out", "b", "--set", "data.calibration=scene.npz"]);
    assert_eq!(broken.code, 1);
    assert!(
        broken.stderr.contains("data.calibration") && broken.stderr.contains("not a calibration"),
        "{}",
        broken.stderr
    );
}

/// The same camera by arguments of `sci simulate` and by `[data.camera]`.
#[test]
fn a_camera_with_faults_is_simulated_alike_by_both_ways() {
    let faults =
        ["shift=[0.4,-0.3]", "contrast=0.9", "flicker=0.05", "black=0.05", "bits=10", "dead=0.004", "hot=0.004"];
    let arguments: Vec<&str> = faults.iter().flat_map(|fault| ["--set", fault]).collect();
    let bench = bench(&arguments);
    let (file, record) = run(&bench, &[]);
    assert!(record["config"]["data"]["camera"].is_null());
    let mut settings: Vec<String> = faults.iter().map(|fault| format!("data.camera.{fault}")).collect();
    settings.extend(
        [
            "data.kind=simulate",
            "data.path=video.y4m",
            "data.mask={kind=\"random\", frames=6, seed=3}",
            "data.noise.seed=3",
        ]
        .map(String::from),
    );
    let settings: Vec<&str> = settings.iter().map(String::as_str).collect();
    let (simulated, record) = run(&bench, &settings);
    assert_eq!(file, simulated);
    assert_eq!(record["config"]["data"]["camera"]["bits"], 10);
    // Without what is wrong with it, and with that told, it is better.
    let clean: Vec<&str> = settings.iter().filter(|set| !set.starts_with("data.camera")).copied().collect();
    let told = [&settings[..], &["data.sensor.black=0.05", "data.defects=exclude"]].concat();
    let (clean, told) = (run(&bench, &clean).0, run(&bench, &told).0);
    assert!(clean > told && told > file + 0.3, "{clean} {told} {file}");
}

/// Defective pixels stay where they are when masks turn out to sit elsewhere, and good ones are not taken for defective for that.
#[test]
fn defective_pixels_are_told_from_masks_that_sit_elsewhere() {
    let bench = bench(&["--set", "shift=[0.5,-0.3]", "--set", "dead=0.004", "--set", "hot=0.004"]);
    let told = bench.sci(&["mask", "--out", "mask.npy", "--frames", "6", "--size", "48x48", "--seed", "3"]);
    assert_eq!(told.code, 0, "{}", told.stderr);
    let settings = ["data.mask=mask.npy", "data.calibration=auto", "data.sensor.clip=none"];
    let (believed, _) = run(&bench, &settings);
    let (left_out, record) = run(&bench, &[&settings[..], &["data.defects=exclude"]].concat());
    assert!(left_out > believed + 3.0, "{left_out} {believed}");
    for (axis, shift) in [0.5, -0.3].iter().enumerate() {
        let found = record["calibration"]["shift"][axis].as_f64().unwrap();
        assert!((found - shift).abs() < 0.06, "{}", record["calibration"]["shift"]);
    }
}

#[test]
fn a_camera_that_cannot_be_is_refused() {
    let bench = bench(&[]);
    for (command, set, part) in [
        ("simulate", "gain=0", "a number from 0.000001 to 1000000"),
        ("simulate", "shift=[1]", "two numbers from -64 to 64"),
        ("simulate", "colour=red", "unknown key `colour`"),
        ("mask", "black=0.1", "unknown key `black`"),
    ] {
        let mut args = vec![command, "--out", "x.npz", "--set", set];
        if command == "simulate" {
            args.push("video.y4m");
        }
        let run = bench.sci(&args);
        assert!(run.code == 2 && run.stderr.contains(part), "{set}: {} {}", run.code, run.stderr);
    }
}

#[test]
fn masks_are_made_as_optics_show_them() {
    let bench = Bench::new();
    let make = |out: &str, sets: &[&str]| -> ndarray::Array3<f32> {
        let run = bench.sci(&[&["mask", "--out", out, "--frames", "3", "--size", "20x30"], sets].concat());
        assert_eq!(run.code, 0, "{}", run.stderr);
        ndarray_npy::read_npy(bench.path(out)).unwrap()
    };
    let (told, moved) = (make("a.npy", &[]), make("b.npy", &["--set", "shift=[0,2]"]));
    assert_eq!(moved.slice(ndarray::s![.., .., 2..]), told.slice(ndarray::s![.., .., ..28]));
    let flickering = make("c.npy", &["--set", "flicker=0.1"]);
    assert!((0..3).all(|t| flickering.index_axis(ndarray::Axis(0), t) != told.index_axis(ndarray::Axis(0), t)));
}

/// The presets for captured data, on a camera with faults.
#[test]
fn the_presets_for_cameras_run() {
    let bench = bench(&["--set", "shift=[0.5,0.25]", "--set", "black=0.05", "--set", "hot=0.001", "--sigma", "2"]);
    for (config, sets) in [("real/gray", &[][..]), ("real/color", &["--set", "data.cfa=rggb"])] {
        let config = e2e::workspace().join(format!("configs/{config}.toml"));
        let config = config.to_str().unwrap();
        let base = ["run", config, "--out", "out", "--set", "data.path=scene.npz", "--set", "output=minimal"];
        let run = bench.sci(&[&base, sets].concat());
        assert_eq!(run.code, 0, "{}", run.stderr);
        let record = bench.record("out");
        assert!(record["calibration"]["solves"].as_u64().unwrap() > 50, "{record}");
        let psnr = record["mean"]["psnr_db"].as_f64().unwrap();
        assert!(psnr > 20.0, "{config}: {psnr}");
    }
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

/// With a truth in the file, neither the unit of the measurements nor that of the masks makes a difference.
#[test]
fn the_unit_of_measurements_does_not_matter() {
    let bench = bench(&[]);
    let read = |name: &str| {
        let mut scene = ndarray_npy::NpzReader::new(fs::File::open(bench.path("scene.npz")).unwrap()).unwrap();
        scene.by_name::<ndarray::OwnedRepr<f32>, ndarray::Ix3>(name).unwrap()
    };
    let (mask, meas, orig) = (read("mask"), read("meas"), read("orig"));
    let psnr = |of_masks: f32, of_y: f32| {
        let mut file = ndarray_npy::NpzWriter::new(fs::File::create(bench.path("unit.npz")).unwrap());
        file.add_array("mask", &(&mask * of_masks)).unwrap();
        file.add_array("meas", &(&meas * of_y)).unwrap();
        file.add_array("orig", &orig).unwrap();
        file.finish().unwrap();
        run(&bench, &["data.path=unit.npz"]).0
    };
    let first = psnr(1.0, 1.0);
    for (of_masks, of_y) in
        [(1.0, 1e-3), (1.0, 0.1), (1.0, 0.7), (1.0, 30.0), (1.0, 1e3), (0.1, 1.0), (100.0, 2.0), (255.0, 1e3)]
    {
        let off = psnr(of_masks, of_y) - first;
        assert!(off.abs() < 0.05, "masks × {of_masks}, y × {of_y}: {off}");
    }
}

#[test]
fn small_negative_transmittances_are_clipped_with_a_word() {
    let bench = bench(&[]);
    let made = bench.sci(&["mask", "--out", "mask.npy", "--frames", "6", "--size", "48x48", "--seed", "3"]);
    assert_eq!(made.code, 0, "{}", made.stderr);
    let mask: ndarray::Array3<f32> = ndarray_npy::read_npy(bench.path("mask.npy")).unwrap();
    let write =
        |dark: f32| ndarray_npy::write_npy(bench.path("dark.npy"), &mask.mapv(|c| if c == 0.0 { dark } else { c }));
    write(-0.02).unwrap();
    let args = ["run", "a.toml", "--out", "out", "--set", "data.mask=dark.npy", "--set", "output=minimal"];
    let clipped = bench.sci(&args);
    assert!(
        clipped.code == 0 && clipped.stderr.contains("transmittances below 0, down to -0.02"),
        "{}",
        clipped.stderr
    );
    assert_eq!(bench.record("out")["mean"]["psnr_db"].as_f64().unwrap(), run(&bench, &[]).0);
}

/// A differential camera, whose masks are -1 and 1: as good a camera as any, in whatever unit.
#[test]
fn masks_of_both_signs_are_taken_as_they_are() {
    let bench = bench(&["--signed", "--sigma", "1"]);
    let (first, record) = run(&bench, &[]);
    assert!(first > 27.0, "{first}");
    assert_eq!(record["measurements"][0]["stop"], "schedule_done");
    let made = bench.sci(&["mask", "--out", "mask.npy", "--frames", "6", "--size", "48x48", "--seed", "3", "--signed"]);
    assert_eq!(made.code, 0, "{}", made.stderr);
    assert_eq!(run(&bench, &["data.mask=mask.npy"]).0, first);
    let read = |name: &str| {
        let mut scene = ndarray_npy::NpzReader::new(fs::File::open(bench.path("scene.npz")).unwrap()).unwrap();
        scene.by_name::<ndarray::OwnedRepr<f32>, ndarray::Ix3>(name).unwrap()
    };
    let (mask, meas, orig) = (read("mask"), read("meas"), read("orig"));
    let write = |of_masks: f32, of_y: f32, with_truth: bool| {
        let mut file = ndarray_npy::NpzWriter::new(fs::File::create(bench.path("unit.npz")).unwrap());
        file.add_array("mask", &(&mask * of_masks)).unwrap();
        file.add_array("meas", &(&meas * of_y)).unwrap();
        if with_truth {
            file.add_array("orig", &orig).unwrap();
        }
        file.finish().unwrap();
    };
    for (of_masks, of_y) in [(1.0, 1e-3), (1.0, 0.3), (1.0, 1e3), (0.1, 1.0), (127.0, 2.0), (255.0, 1e3)] {
        write(of_masks, of_y, true);
        let off = run(&bench, &["data.path=unit.npz"]).0 - first;
        assert!(off.abs() < 0.05, "masks × {of_masks}, y × {of_y}: {off}");
    }
    // Without a truth white is found by the light, and the result has the unit of y.
    let recon = |of_y: f32| {
        write(1.0, of_y, false);
        let run =
            bench.sci(&["run", "a.toml", "--set", "data.path=unit.npz", "--set", "output=minimal", "--out", "out"]);
        assert!(run.code == 0 && run.stderr.contains("differential camera"), "{}", run.stderr);
        ndarray_npy::read_npy::<_, ndarray::ArrayD<f32>>(bench.path("out/recon.npy")).unwrap() / of_y
    };
    let plain = recon(1.0);
    for of_y in [1e-3, 50.0] {
        let off = (recon(of_y) - &plain).mapv(|d| d * d).mean().unwrap().sqrt();
        assert!(off < 0.02, "y × {of_y}: {off}");
    }
}

/// What the light of a pixel decides is left out, and said, where it is not known.
#[test]
fn a_differential_camera_knows_its_read_noise() {
    // Each of the two readings has the noise.
    let bench = bench(&["--signed", "--sigma", "50"]);
    let (unaware, _) = run(&bench, &[]);
    let (aware, _) = run(&bench, &["data.sensor.noise=70.7", "data.sensor.photons=1000"]);
    assert!(aware > unaware + 0.5, "{unaware} {aware}");
    let said =
        bench.sci(&["run", "a.toml", "--out", "out", "--set", "data.sensor.photons=9", "--set", "output=minimal"]);
    assert!(said.stderr.contains("data.sensor.photons is left out"), "{}", said.stderr);
}

/// Masks and measurements with an offset and a gain of every pixel's own, which a dark and a white frame take off.
#[test]
fn a_dark_and_a_white_frame_make_masks_and_measurements_whole() {
    let bench = bench(&[]);
    let (first, _) = run(&bench, &[]);
    let mut scene = ndarray_npy::NpzReader::new(fs::File::open(bench.path("scene.npz")).unwrap()).unwrap();
    let mut read = |name: &str| scene.by_name::<ndarray::OwnedRepr<f32>, ndarray::Ix3>(name).unwrap();
    let (mask, meas, orig) = (read("mask"), read("meas"), read("orig"));
    let dark = ndarray::Array2::from_shape_fn((48, 48), |(i, j)| 5.0 + ((7 * i + 3 * j) % 11) as f32);
    let light =
        ndarray::Array2::from_shape_fn((48, 48), |(i, j)| 200.0 - ((i as f32 - 24.0).powi(2) + j as f32) / 10.0);
    ndarray_npy::write_npy(bench.path("mask.npy"), &(&mask * &light + &dark)).unwrap();
    ndarray_npy::write_npy(bench.path("dark.npy"), &dark).unwrap();
    ndarray_npy::write_npy(bench.path("white.npy"), &(&light + &dark)).unwrap();
    let mut file = ndarray_npy::NpzWriter::new(fs::File::create(bench.path("raw.npz")).unwrap());
    file.add_array("meas", &(&meas * 255.0 + &dark)).unwrap();
    file.add_array("orig", &orig).unwrap();
    file.finish().unwrap();
    let raw = ["data.path=raw.npz", "data.mask=mask.npy"];
    let frames = ["data.sensor.dark=dark.npy", "data.sensor.white=white.npy"];
    let (without, _) = run(&bench, &raw);
    let (with, _) = run(&bench, &[&raw[..], &frames].concat());
    assert!((with - first).abs() < 0.05 && without < first - 1.0, "{first} {with} {without}");
    // A pixel that sees no white is not measured.
    let mut dead = &light + &dark;
    dead[[20, 20]] = dark[[20, 20]];
    ndarray_npy::write_npy(bench.path("white.npy"), &dead).unwrap();
    let (with_dead, _) = run(&bench, &[&raw[..], &frames].concat());
    assert!((with_dead - first).abs() < 0.3, "{first} {with_dead}");
    let refused = |frame: &str, expected: &[&str], code: i32| {
        let mut args = vec!["run", "a.toml", "--out", "out"];
        raw.iter().chain(&frames).chain([&frame]).for_each(|set| args.extend(["--set", set]));
        let run = bench.sci(&args);
        assert_eq!(run.code, code, "{}", run.stderr);
        expected.iter().for_each(|part| assert!(run.stderr.contains(part), "{part}: {}", run.stderr));
    };
    ndarray_npy::write_npy(bench.path("small.npy"), &ndarray::Array2::<f32>::ones((4, 5))).unwrap();
    refused("data.sensor.white=small.npy", &["small.npy", "data.sensor.white", "4×5", "48×48"], 1);
    refused("data.sensor.dark=gone.npy", &["gone.npy", "data.sensor.dark"], 2);
    refused("data.sensor.black=3", &["data.sensor.black", "data.sensor.dark"], 2);
}

/// What pixels show that no mask opens is noise, whatever the scene; where there is none nothing changes.
#[test]
fn read_noise_is_found_and_a_clean_scene_is_left_alone() {
    let clean = bench(&["--density", "0.4"]);
    assert_eq!(run(&clean, &["data.sensor.noise=auto"]).0, run(&clean, &[]).0);
    // A twentieth of the pixels is closed.
    let noisy = bench(&["--sigma", "50", "--density", "0.4"]);
    let [auto, known, unaware] =
        ["auto", "50", "0"].map(|noise| run(&noisy, &[&format!("data.sensor.noise={noise}")]).0);
    assert!((auto - known).abs() < 1.0 && auto > unaware + 0.5, "{auto} {known} {unaware}");
    let run = noisy.sci(&[
        "run",
        "a.toml",
        "--out",
        "out",
        "--set",
        "data.sensor.noise=auto",
        "--set",
        "data.sensor.photons=9",
    ]);
    assert!(run.code == 2 && run.stderr.contains("data.sensor.photons"), "{}", run.stderr);
}

#[test]
fn masks_that_are_not_of_a_calibration_are_not_replaced() {
    let bench = bench(&[]);
    fs::create_dir(bench.path("mine")).unwrap();
    bench.write("mine/masks.npy", b"mine");
    let run = bench.sci(&["calibrate", "a.toml", "--out", "mine"]);
    assert!(run.code == 2 && run.stderr.contains("masks.npy is there"), "{}", run.stderr);
    assert_eq!(fs::read(bench.path("mine/masks.npy")).unwrap(), b"mine");
}
