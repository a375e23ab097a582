//! Color scenes: every shipped config, the numbers of the reference code, and that the pattern does not matter.

use e2e::{Bench, data_root, workspace};
use serde_json::Value;

/// Runs measurement 0 of a scene under a config of `configs/color`, where the data is there.
fn measurement(config: &str, scene: &str, set: &[&str]) -> Option<Value> {
    let root = data_root()?;
    let bench = Bench::new();
    let mut command = bench.command(&["run", "--out", "out", "--set", "data.measurements=[0]"]);
    command.arg("--set").arg(format!("data.path={scene}"));
    set.iter().for_each(|s| {
        command.args(["--set", s]);
    });
    command.arg(workspace().join("configs/color").join(config)).env("SCI_DATA", root);
    let run = bench.finish(&mut command);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(bench.path("out/report.html").is_file() && bench.path("out/preview.gif").is_file());
    Some(bench.record("out")["measurements"][0].take())
}

fn slow() -> bool {
    let slow = std::env::var_os("RUN_SLOW_TESTS").is_some();
    if !slow {
        eprintln!("skipped: takes minutes (set RUN_SLOW_TESTS=1)");
    }
    slow
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
fn tv_start_calendar() {
    let Some(m) = measurement("two-stage-ffdnet.toml", "calendar.npz", &NO_ITERATION) else { return };
    close(&m, 16.5317, 0.5466);
}

#[test]
fn tv_start_walk() {
    let Some(m) = measurement("two-stage-ffdnet.toml", "walk.npz", &NO_ITERATION) else { return };
    close(&m, 20.9675, 0.7233);
}

#[test]
fn two_stage_ffdnet() {
    if !slow() {
        return;
    }
    for (scene, psnr, ssim) in [("calendar.npz", 16.8910, 0.6648), ("walk.npz", 22.9899, 0.8434)] {
        let Some(m) = measurement("two-stage-ffdnet.toml", scene, &[]) else { return };
        close(&m, psnr, ssim);
    }
}

/// One default for every scene is well above the reference, in fewer denoiser calls.
#[test]
fn default_beats_the_reference() {
    if !slow() {
        return;
    }
    for (scene, least) in [("calendar.npz", 16.89 + 3.1), ("walk.npz", 22.99 + 3.3)] {
        let Some(m) = measurement("default.toml", scene, &[]) else { return };
        assert!(m["psnr_db"].as_f64().unwrap() >= least, "{scene}: {}, at least {least}", m["psnr_db"]);
        assert!(m["denoiser_calls"].as_u64().unwrap() < 20, "{}", m["denoiser_calls"]);
    }
}

/// Every config is legal but for the weights that it names as missing.
#[test]
fn configs_resolve_or_name_what_is_missing() {
    let Some(root) = data_root() else { return };
    let bench = Bench::new();
    for folder in ["configs/color", "configs/gray"] {
        for entry in std::fs::read_dir(workspace().join(folder)).unwrap() {
            let path = entry.unwrap().path();
            let text = std::fs::read_to_string(&path).unwrap();
            // A measurement that is not there ends the run after everything was resolved.
            let mut command = bench.command(&["run", "--out", "out", "--set", "data.measurements=[9]"]);
            let run = bench.finish(command.arg(&path).env("SCI_DATA", &root));
            assert_eq!(run.code, 2, "{}: {}", path.display(), run.stderr);
            let missing = text.contains("bundled:") && run.stderr.contains("bundled:");
            assert!(missing || run.stderr.contains("`data.measurements` names 9"), "{}", run.stderr);
        }
    }
}

#[test]
fn gray_weights_on_a_color_scene() {
    let Some(root) = data_root() else { return };
    let bench = Bench::new();
    let mut command = bench.command(&["run", "--out", "out", "--set", "denoiser.weights=ffdnet_gray.pth"]);
    let run =
        bench.finish(command.arg(workspace().join("configs/color/two-stage-ffdnet-fast.toml")).env("SCI_DATA", root));
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
    let video = ndarray::Array4::from_shape_fn((4, 3, 33, 31), |(t, c, y, x)| {
        0.5 + 0.3 * (0.2 * (x + t) as f32 + c as f32).sin() * (0.15 * y as f32).cos()
    });
    bench.write("a.toml", config);
    ndarray_npy::write_npy(bench.path("video.npy"), &video).unwrap();
    for cfa in ["rggb", "bggr", "grbg", "gbrg"] {
        let run = bench.sci(&["run", "a.toml", "--out", "out", "--set", &format!("data.cfa={cfa}")]);
        assert_eq!(run.code, 0, "{cfa}: {}", run.stderr);
        let m = &bench.record("out")["measurements"][0];
        assert!(m["psnr_db"].as_f64().unwrap() > 25.0 && m["psnr_rgb_db"].as_f64().unwrap() > 25.0, "{cfa}: {m}");
        let recon: ndarray::Array4<f32> = ndarray_npy::read_npy(bench.path("out/recon.npy")).unwrap();
        assert_eq!(recon.dim(), video.dim());
    }
}

/// Without a penalty to speak of, two-stage ADMM diverges: a failure that says what to do and leaves the last good estimate.
#[test]
fn divergence_is_a_failure_with_a_result() {
    let Some(root) = data_root() else { return };
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
