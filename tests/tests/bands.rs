//! A scene that is too large for `memory` is solved in bands of rows, and the result is that of the whole.

use std::fs;
use std::io::Cursor;
use std::process::Stdio;

use e2e::{Bench, assert_same, wait_for, workspace};
use ndarray::{Array3, Array4, Axis, s};
use ndarray_npy::{NpzWriter, ReadNpyExt, WriteNpyExt};

const CONFIG: &str = r#"
[data]
path = "scene.npz"
[solver]
kind = "gap"
[denoiser]
kind = "tv"
[[stage]]
iterations = 8
"#;
/// Enough for 500 of the rows below.
const BANDS: &str = "memory=\"160 MB\"";
const SIZE: (usize, usize, usize) = (8, 960, 512);

fn masks() -> Array3<u8> {
    let mut state = 1u32;
    Array3::from_shape_simple_fn(SIZE, || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 31) as u8
    })
}

fn video() -> Array3<u8> {
    let value =
        |t: usize, y: usize, x: usize| 128.0 + 100.0 * ((t + 3 * x) as f32 * 0.05).sin() * (y as f32 * 0.1).cos();
    Array3::from_shape_fn(SIZE, |(t, y, x)| value(t, y, x) as u8)
}

fn bench() -> Bench {
    let bench = Bench::new();
    let mut bytes = Cursor::new(Vec::new());
    let mut npz = NpzWriter::new(&mut bytes);
    npz.add_array("mask", &masks()).unwrap();
    npz.add_array("orig", &video()).unwrap();
    npz.finish().unwrap();
    bench.write("scene.npz", bytes.into_inner());
    bench.write("a.toml", CONFIG);
    bench
}

fn recon(bench: &Bench, run: &str) -> Array4<f32> {
    Array4::read_npy(fs::File::open(bench.path(run).join("recon.npy")).unwrap()).unwrap()
}

#[track_caller]
fn works(bench: &Bench, arguments: &[&str]) {
    let run = bench.sci(&[&["run", "a.toml"], arguments].concat());
    assert_eq!(run.code, 0, "{}{}", run.stdout, run.stderr);
}

/// The largest difference of two runs' results.
fn difference(bench: &Bench, a: &str, b: &str) -> f32 {
    (recon(bench, a) - recon(bench, b)).iter().fold(0.0, |most, d| most.max(d.abs()))
}

#[test]
fn bands_join_without_a_seam() {
    let bench = bench();
    works(&bench, &["--out", "whole"]);
    works(&bench, &["--out", "bands", "--set", BANDS]);
    let (whole, bands) = (bench.record("whole"), bench.record("bands"));
    assert!(whole["measurements"][0]["bands"].is_null() && bands["measurements"][0]["bands"].as_u64() > Some(2));
    assert!(difference(&bench, "whole", "bands") < 1e-4, "{}", difference(&bench, "whole", "bands"));
    for figure in ["psnr_db", "ssim", "ssim_gaussian"] {
        let of = |record: &serde_json::Value| record["measurements"][0][figure].as_f64().unwrap();
        assert!((of(&whole) - of(&bands)).abs() < 1e-3, "{figure}: {} {}", of(&whole), of(&bands));
    }
    assert_eq!(whole["files"], bands["files"]);
    // Where memory is enough, nothing is cut.
    works(&bench, &["--out", "enough", "--set", "memory=\"4 GiB\""]);
    assert_eq!(recon(&bench, "enough"), recon(&bench, "whole"));
}

#[test]
fn a_file_of_each_format_that_can_be_read_in_bands_gives_the_same() {
    let bench = bench();
    works(&bench, &["--out", "npz", "--set", BANDS, "--set", "output=minimal"]);
    let mut packed = NpzWriter::new_compressed(fs::File::create(bench.path("packed.npz")).unwrap());
    packed.add_array("mask", &masks()).unwrap();
    packed.add_array("orig", &video()).unwrap();
    packed.finish().unwrap();
    fs::create_dir(bench.path("folder")).unwrap();
    masks().write_npy(fs::File::create(bench.path("folder/mask.npy")).unwrap()).unwrap();
    video().write_npy(fs::File::create(bench.path("folder/orig.npy")).unwrap()).unwrap();
    // As MATLAB has it: columns first.
    let mut b = hdf5_pure::mat::MatBuilder::new(hdf5_pure::mat::Options::default());
    let (t, h, w) = SIZE;
    let columns = |x: Array3<u8>| x.permuted_axes([0, 2, 1]).as_standard_layout().iter().copied().collect::<Vec<u8>>();
    b.write_u8("mask", &[h, w, t], &columns(masks())).unwrap();
    b.write_u8("orig", &[h, w, t], &columns(video())).unwrap();
    bench.write("matlab.mat", b.finish().unwrap());
    for name in ["packed.npz", "folder", "matlab.mat"] {
        let (path, out) = (format!("data.path={name}"), format!("out-{name}"));
        works(&bench, &["--out", &out, "--set", &path, "--set", BANDS, "--set", "output=minimal"]);
        assert_eq!(recon(&bench, &out), recon(&bench, "npz"), "{name}");
    }
}

#[test]
fn a_run_that_is_killed_goes_on_with_the_next_band() {
    let bench = bench();
    let set = ["--set", BANDS, "--set", "stage.0.iterations=30"];
    works(&bench, &[&["--out", "whole"], &set[..]].concat());
    let arguments = [&["run", "a.toml", "--out", "out"], &set[..]].concat();
    let mut child = bench.command(&arguments).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    wait_for(&bench.path("out/.sci-run/m00.bands/b000"));
    child.kill().unwrap();
    child.wait().unwrap();
    let again = bench.sci(&arguments);
    assert!(again.code == 2 && again.stderr.contains("of a measurement solved"), "{}", again.stderr);
    works(&bench, &[&["--out", "out", "--resume"], &set[..]].concat());
    assert_same(&bench.path("out"), &bench.path("whole"));
}

/// It stops in its second measurement, and the pictures of the first are not there, as if it had stopped between the two.
#[test]
fn pictures_that_a_stopped_run_did_not_make_are_made() {
    let bench = Bench::new();
    let both = ndarray::concatenate(Axis(0), &[video().view(), video().view()]).unwrap();
    let mut npz = NpzWriter::new(fs::File::create(bench.path("scene.npz")).unwrap());
    npz.add_array("mask", &masks()).unwrap();
    npz.add_array("orig", &both).unwrap();
    npz.finish().unwrap();
    bench.write("a.toml", CONFIG);
    let arguments = ["run", "a.toml", "--out", "out", "--set", BANDS, "--set", "stage.0.iterations=30"];
    let mut child = bench.command(&arguments).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    wait_for(&bench.path("out/.sci-run/m01.bands"));
    child.kill().unwrap();
    child.wait().unwrap();
    fs::remove_dir_all(bench.path("out/.sci-run/m00/pictures")).unwrap();
    let resumed = bench.sci(&[&arguments[..], &["--resume"]].concat());
    assert_eq!(resumed.code, 0, "{}{}", resumed.stdout, resumed.stderr);
    assert!(bench.path("out/frames/m00_t07.png").is_file() && bench.path("out/report.html").is_file());
}

/// Masks and measurements, each alone in a `.npy` file.
#[test]
fn measurements_and_masks_may_lie_in_files_without_names() {
    let bench = Bench::new();
    let y = (masks().mapv(u16::from) * video().mapv(u16::from)).sum_axis(Axis(0)).mapv(f32::from) / 255.0;
    masks().write_npy(fs::File::create(bench.path("coded.npy")).unwrap()).unwrap();
    y.write_npy(fs::File::create(bench.path("shots.npy")).unwrap()).unwrap();
    bench.write("a.toml", CONFIG);
    let of = ["--set", "data.path=shots.npy", "--set", "data.mask=coded.npy", "--set", "output=minimal"];
    works(&bench, &[&["--out", "whole"], &of[..]].concat());
    works(&bench, &[&["--out", "bands", "--set", BANDS], &of[..]].concat());
    assert!(bench.record("bands")["measurements"][0]["bands"].as_u64() > Some(1));
    assert!(difference(&bench, "whole", "bands") < 1e-4);
}

/// A mosaic is no picture: the page is without it.
#[test]
fn a_color_scene_may_have_a_mosaic_for_its_truth() {
    let bench = bench();
    works(&bench, &["--out", "out", "--set", "data.cfa=rggb", "--set", "memory=\"200 MB\""]);
    let record = bench.record("out");
    assert!(record["measurements"][0]["bands"].as_u64() > Some(1));
    assert!(record["measurements"][0]["psnr_db"].as_f64().is_some());
}

#[test]
fn a_color_scene_has_what_the_middle_of_its_bands_would_have_alone() {
    let bench = Bench::new();
    let (_, h, w) = SIZE;
    let rgb = Array4::from_shape_fn((8, h, w, 3), |(t, y, x, c)| (60 * c + (t + x + 2 * y) % 97) as u8);
    let mut npz = NpzWriter::new(fs::File::create(bench.path("scene.npz")).unwrap());
    npz.add_array("mask", &masks()).unwrap();
    npz.add_array("rgb", &rgb).unwrap();
    npz.finish().unwrap();
    bench.write("a.toml", CONFIG);
    works(&bench, &["--out", "whole", "--set", "output=minimal"]);
    works(&bench, &["--out", "bands", "--set", "memory=\"200 MB\""]);
    let record = bench.record("bands");
    assert!(record["measurements"][0]["bands"].as_u64() > Some(1));
    let of = |run: &str, key: &str| bench.record(run)["measurements"][0][key].as_f64().unwrap();
    for key in ["psnr_db", "psnr_rgb_db"] {
        assert!((of("whole", key) - of("bands", key)).abs() < 1e-2, "{key}");
    }
    // Menon's directions turn over with a rounding, here and there: in the mean over a row nothing is seen of that, nor of a seam.
    let off = (recon(&bench, "whole") - recon(&bench, "bands")).mapv(|d| d * d);
    let rows = off.mean_axis(Axis(0)).unwrap().mean_axis(Axis(0)).unwrap().mean_axis(Axis(1)).unwrap();
    let worst = rows.slice(s![..]).iter().fold(0.0f32, |most, &r| most.max(r));
    assert!(worst < 1e-4, "{worst}");
}

/// A scene of bytes as a plain `.npz`, with the truth under this name.
fn write_scene(bench: &Bench, (frames, height, width): (usize, usize, usize), truth: &str) {
    let mut state = 1u32;
    let masks = Array3::from_shape_simple_fn((frames, height, width), || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 31) as u8
    });
    let value = |t: usize, y: usize, x: usize| {
        128.0 + 90.0 * ((t + 3 * x) as f32 * 0.05).sin() * ((y + 2 * t) as f32 * 0.1).cos()
    };
    let mut npz = NpzWriter::new(fs::File::create(bench.path("scene.npz")).unwrap());
    npz.add_array("mask", &masks).unwrap();
    match truth {
        "rgb" => {
            let color = |(t, y, x, c)| (value(t, y, x) - 20.0 * c as f32) as u8;
            npz.add_array(truth, &Array4::from_shape_fn((frames, height, width, 3), color)).unwrap();
        }
        _ => {
            let gray = |(t, y, x)| value(t, y, x) as u8;
            npz.add_array(truth, &Array3::from_shape_fn((frames, height, width), gray)).unwrap();
        }
    }
    npz.finish().unwrap();
}

/// Networks work at an eighth of the size, and are shown the video upside down too: bands lie on the grid of the whole, and are continued
/// at the same side.
#[test]
fn bands_of_a_network_are_the_whole_whatever_the_height() {
    let bench = Bench::new();
    let config = workspace().join("configs/gray/fast.toml");
    let stage = "stage=[{sigma=[20,16,12,9],iterations=1}]";
    for height in [483, 485] {
        write_scene(&bench, (4, height, 203), "orig");
        for (out, memory) in [("whole", "4 GiB"), ("bands", "150 MB")] {
            let (path, out) = (bench.path("scene.npz"), format!("{out}-{height}"));
            let path = format!("data.path={}", path.display());
            let memory = format!("memory=\"{memory}\"");
            let config = config.to_str().unwrap();
            let run = bench.sci(&["run", config, "--out", &out, "--set", &path, "--set", &memory, "--set", stage]);
            assert_eq!(run.code, 0, "{}{}", run.stdout, run.stderr);
        }
        let of = |run: &str| bench.record(&format!("{run}-{height}"))["measurements"][0].clone();
        let (whole, bands) = (of("whole"), of("bands"));
        assert!(whole["bands"].is_null() && bands["bands"].as_u64() > Some(1), "{bands}");
        let off = (whole["psnr_db"].as_f64().unwrap() - bands["psnr_db"].as_f64().unwrap()).abs();
        assert!(off < 0.003, "{height} rows: {off} dB");
        let most = difference(&bench, &format!("whole-{height}"), &format!("bands-{height}"));
        assert!(most < 0.02, "{height} rows: {most}");
    }
}

/// The experiments for large recordings, each in bands of a small one, and learning in no more memory than is allowed.
#[test]
fn large_experiments_run_to_the_end_in_their_memory() {
    let bench = Bench::new();
    write_scene(&bench, (4, 1000, 96), "rgb");
    let path = format!("data.path={}", bench.path("scene.npz").display());
    let learning: &[&str] = &["online.side=32", "online.crops=1", "online.updates=2", "online.judged_crops=2"];
    let experiments: [(&str, u64, &[&str]); 4] = [
        ("gap-tv", 128, &[]),
        ("gap-ffdnet", 128, &["denoiser.weights=bundled:ffdnet_color"]),
        ("fast", 160, &[]),
        ("adaptive", 200, learning),
    ];
    let shipped = fs::read_dir(workspace().join("configs/large")).unwrap();
    assert_eq!(shipped.count(), experiments.len(), "each of configs/large is run");
    for (name, megabytes, sets) in experiments {
        let config = workspace().join(format!("configs/large/{name}.toml"));
        let memory = format!("memory=\"{megabytes} MB\"");
        let stage = if name == "gap-tv" { "stage=[{iterations=2}]" } else { "stage=[{sigma=20,iterations=1}]" };
        let mut arguments = vec!["run", config.to_str().unwrap(), "--out", name];
        [path.as_str(), &memory, stage].iter().chain(sets).for_each(|set| arguments.extend(["--set", set]));
        let run = bench.sci(&arguments);
        assert_eq!(run.code, 0, "{name}: {}{}", run.stdout, run.stderr);
        let record = bench.record(name);
        assert!(record["measurements"][0]["bands"].as_u64() > Some(1), "{name}");
        let used = record["peak_rss_bytes"].as_u64().unwrap();
        assert!(used < megabytes * 1_000_000, "{name}: {used} bytes");
    }
}

#[test]
fn what_does_not_go_with_bands_is_said() {
    let bench = bench();
    let said = |set: &[&str], needle: &str| {
        let mut arguments = vec!["run", "a.toml", "--out", "out"];
        set.iter().for_each(|s| arguments.extend(["--set", s]));
        let run = bench.sci(&arguments);
        assert!(run.code == 2 && run.stderr.contains(needle), "{needle:?}: {} {}", run.code, run.stderr);
        assert!(!bench.path("out").exists());
    };
    said(&["memory=4"], "from \"128 MB\" to \"64 TB\"");
    said(&["memory=\"4 Gb\""], "for example \"4 GiB\"");
    said(&["memory=\"128 MB\""], "the lowest band of");
    said(&[BANDS, "data.calibration=auto"], "`data.calibration` does not go with bands");
}

/// A shaded border: nothing is measured there, and the rest is what it was.
#[test]
fn a_band_that_masks_leave_closed_is_black() {
    let bench = bench();
    let mut mask = masks();
    mask.slice_mut(s![.., 300.., ..]).fill(0);
    let mut npz = NpzWriter::new(fs::File::create(bench.path("scene.npz")).unwrap());
    npz.add_array("mask", &mask).unwrap();
    npz.add_array("orig", &video()).unwrap();
    npz.finish().unwrap();
    works(&bench, &["--out", "out", "--set", BANDS]);
    let found = recon(&bench, "out");
    assert!(found.slice(s![.., .., 700.., ..]).iter().all(|&v| v == 0.0));
    assert!(found.slice(s![.., .., ..250, ..]).iter().all(|&v| v.is_finite()) && found[[0, 0, 100, 100]] > 0.05);
}
