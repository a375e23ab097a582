//! Color scenes: every shipped config, the numbers of the reference code, and that the pattern does not matter.

use std::path::{Path, PathBuf};

use e2e::{Bench, workspace};
use ndarray::{Array3, Array4, s};
use ndarray_npy::{NpzReader, WriteNpyExt};
use serde_json::Value;

/// Measurement 0 of a scene under a config of `configs/color`.
fn measurement(root: &Path, config: &str, scene: &Path, set: &[&str]) -> Value {
    let bench = Bench::new();
    let path = format!("data.path={}", scene.display());
    let run = bench.run_on(root, &format!("color/{config}"), &[&[path.as_str()], set].concat());
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(bench.path("out/report.html").is_file() && bench.path("out/preview.gif").is_file());
    bench.record("out")["measurements"][0].take()
}

/// The first measurement of a scene, 160×160 pixels of it from row and column 160 on, as a folder in `bench`.
fn crop(bench: &Bench, root: &Path, scene: &str) -> PathBuf {
    let file = std::fs::File::open(root.join("data").join(scene)).unwrap();
    let mut scene = NpzReader::new(file).unwrap();
    let rgb: Array4<u8> = scene.by_name("rgb").unwrap();
    let mask: Array3<u8> = scene.by_name("mask").unwrap();
    let folder = bench.path("crop");
    std::fs::create_dir_all(&folder).unwrap();
    let file = |name: &str| std::fs::File::create(folder.join(name)).unwrap();
    rgb.slice(s![..8, 160..320, 160..320, ..]).write_npy(file("rgb.npy")).unwrap();
    mask.slice(s![.., 160..320, 160..320]).write_npy(file("mask.npy")).unwrap();
    folder
}

#[track_caller]
fn close(m: &Value, psnr: f64, ssim: f64) {
    let (p, s) = (m["psnr_db"].as_f64().unwrap(), m["ssim"].as_f64().unwrap());
    assert!((p - psnr).abs() <= 0.05, "PSNR {p}, reference {psnr}");
    assert!((s - ssim).abs() <= 0.001, "SSIM {s}, reference {ssim}");
    assert!(m["psnr_rgb_db"].is_number(), "{m}");
}

const NO_ITERATION: [&str; 4] =
    ["stage.0.iterations=0", "stage.1.iterations=0", "stage.2.iterations=0", "stage.3.iterations=0"];

#[test]
fn tv_start() {
    let Some(root) = test_data::root() else { return };
    for (scene, psnr, ssim) in [("calendar.npz", 16.5317, 0.5466), ("walk.npz", 20.9675, 0.7233)] {
        close(&measurement(&root, "two-stage-ffdnet.toml", scene.as_ref(), &NO_ITERATION), psnr, ssim);
    }
}

/// PSNR and SSIM of the reference's two-stage ADMM with FFDNet on a [`crop`] of each scene.
const REFERENCE: [(&str, f64, f64); 2] = [("calendar.npz", 17.4173, 0.5728), ("walk.npz", 19.6384, 0.7686)];

#[test]
fn two_stage_ffdnet() {
    let Some(root) = test_data::root() else { return };
    let bench = Bench::new();
    for (scene, psnr, ssim) in REFERENCE {
        close(&measurement(&root, "two-stage-ffdnet.toml", &crop(&bench, &root, scene), &[]), psnr, ssim);
    }
}

/// One default for every scene is well above the reference, in fewer denoiser calls.
#[test]
fn default_beats_the_reference() {
    let Some(root) = test_data::root() else { return };
    let bench = Bench::new();
    for ((scene, reference, _), gain) in REFERENCE.into_iter().zip([2.8, 5.0]) {
        let m = measurement(&root, "default.toml", &crop(&bench, &root, scene), &[]);
        assert!(m["psnr_db"].as_f64().unwrap() >= reference + gain, "{scene}: {}, reference {reference}", m["psnr_db"]);
        assert!(m["denoiser_calls"].as_u64().unwrap() < 20, "{}", m["denoiser_calls"]);
    }
}

/// Every config is legal, and what it names is there.
#[test]
fn configs_resolve() {
    let Some(root) = test_data::root() else { return };
    let bench = Bench::new();
    for folder in ["color", "gray", "bench"] {
        for entry in std::fs::read_dir(workspace().join("configs").join(folder)).unwrap() {
            let path = entry.unwrap().path();
            // A measurement that is not there ends the run after everything was resolved.
            let run = bench.run_on(&root, path.to_str().unwrap(), &["data.measurements=[9]"]);
            assert_eq!(run.code, 2, "{}: {}", path.display(), run.stderr);
            assert!(run.stderr.contains("`data.measurements` names 9"), "{}", run.stderr);
        }
    }
}

#[test]
fn gray_weights_on_a_color_scene() {
    let Some(root) = test_data::root() else { return };
    let bench = Bench::new();
    let run = bench.run_on(&root, "color/two-stage-ffdnet-fast.toml", &["denoiser.weights=ffdnet_gray.pth"]);
    assert_eq!(run.code, 1);
    assert!(run.stderr.contains("1 channels") && run.stderr.contains("scene is color"), "{}", run.stderr);
}

/// A color video through every pattern, also at an odd size, with the prior that needs no weights.
#[test]
fn all_patterns_and_odd_sizes() {
    let config = r#"
[data]
kind = "simulate"
path = "video.npy"
[data.mask]
kind = "random"
frames = 4
[solver]
kind = "gap"
[denoiser]
kind = "tv"
weight = 0.05
[[stage]]
iterations = 30
"#;
    let bench = Bench::new();
    let video = Array4::from_shape_fn((4, 3, 33, 31), |(t, c, y, x)| {
        0.5 + 0.3 * (0.2 * (x + t) as f32 + c as f32).sin() * (0.15 * y as f32).cos()
    });
    bench.write("a.toml", config);
    ndarray_npy::write_npy(bench.path("video.npy"), &video).unwrap();
    for cfa in ["rggb", "bggr", "grbg", "gbrg"] {
        let run = bench.sci(&["run", "a.toml", "--out", "out", "--set", &format!("data.cfa={cfa}")]);
        assert_eq!(run.code, 0, "{cfa}: {}", run.stderr);
        let m = &bench.record("out")["measurements"][0];
        assert!(m["psnr_db"].as_f64().unwrap() > 25.0 && m["psnr_rgb_db"].as_f64().unwrap() > 25.0, "{cfa}: {m}");
        let recon: Array4<f32> = ndarray_npy::read_npy(bench.path("out/recon.npy")).unwrap();
        assert_eq!(recon.dim(), video.dim());
    }
}

/// Without a penalty to speak of, two-stage ADMM diverges: a failure that says what to do and leaves the last good estimate.
#[test]
fn divergence_is_a_failure_with_a_result() {
    let Some(root) = test_data::root() else { return };
    let bench = Bench::new();
    let config = "[data]\npath = 'walk.npz'\nmeasurements = [0]\n[solver]\nkind = 'two-stage'\nrho = 1e-6\n\
                  [denoiser]\nkind = 'tv'\nweight = 0.1\n[[stage]]\niterations = 12\n";
    std::fs::write(bench.path("diverges.toml"), config).unwrap();
    let run = bench.finish(bench.command(&["run", "diverges.toml", "--out", "out"]).env("SCI_DATA", root));
    assert_eq!(run.code, 1, "{}", run.stdout);
    for needle in ["measurement 0 diverged in iteration", "raise solver.rho", "1 of 1 measurements diverged"] {
        assert!(run.stderr.contains(needle), "{needle:?} is not in: {}", run.stderr);
    }
    let m = &bench.record("out")["measurements"][0];
    assert_eq!(m["stop"], "diverged");
    assert!(m["relative_residual"].is_number() && bench.path("out/recon.npy").is_file());
}
