//! Real scenes reach the numbers of the reference code, measured with its Python on the same files.

use e2e::Bench;
use serde_json::Value;

/// The record of measurement 0 of a scene under a shipped config, where the data is there.
fn measurement(config: &str, scene: &str) -> Option<Value> {
    let root = test_data::root()?;
    let bench = Bench::new();
    let run = bench.run_on(&root, config, &[&format!("data.path={scene}")]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    Some(bench.record("out")["measurements"][0].take())
}

/// The constants of the reference give its numbers.
fn reaches(config: &str, scene: &str, psnr: f64, ssim: f64) {
    let Some(m) = measurement(config, scene) else { return };
    let (p, s) = (m["psnr_db"].as_f64().unwrap(), m["ssim"].as_f64().unwrap());
    assert!((p - psnr).abs() <= 0.02, "PSNR {p}, reference {psnr}");
    assert!((s - ssim).abs() <= 0.001, "SSIM {s}, reference {ssim}");
    assert_eq!((m["iterations"].as_u64(), m["stop"].as_str()), (Some(40), Some("schedule_done")));
    assert_eq!(m["trace"]["psnr_db"].as_array().map(Vec::len), Some(40));
    assert_eq!(m["trace"]["psnr_db"][39].as_f64(), Some(p));
}

/// Our own constants are no worse than the reference's on traffic and on runner, in fewer iterations.
fn beats(config: &str, psnr: [f64; 2], most: u64) {
    for (scene, psnr) in ["traffic48.mat", "runner40.mat"].into_iter().zip(psnr) {
        let Some(m) = measurement(config, scene) else { return };
        assert!(m["psnr_db"].as_f64().unwrap() >= psnr - 0.005, "{scene}: {}, reference {psnr}", m["psnr_db"]);
        assert!(m["iterations"].as_u64().unwrap() <= most, "{scene}: {}", m["iterations"]);
    }
}

#[test]
fn gap_tv_fast() {
    beats("gray/gap-tv-fast.toml", [20.764, 29.806], 16);
}

#[test]
fn gap_ffdnet_fast() {
    beats("gray/gap-ffdnet-fast.toml", [23.708, 32.443], 20);
}

/// The weights that come with the program, well above what needs none (20.85 and 29.82 dB by TV).
#[test]
fn the_default_for_gray_scenes() {
    beats("gray/default.toml", [25.8, 34.6], 13);
}

#[test]
fn gap_tv_traffic() {
    reaches("gray/gap-tv.toml", "traffic48.mat", 20.764, 0.6873);
}

#[test]
fn gap_tv_runner() {
    reaches("gray/gap-tv.toml", "runner40.mat", 29.806, 0.8949);
}

#[test]
fn gap_ffdnet_traffic() {
    reaches("gray/gap-ffdnet.toml", "traffic48.mat", 23.708, 0.8222);
}

#[test]
fn gap_ffdnet_runner() {
    reaches("gray/gap-ffdnet.toml", "runner40.mat", 32.443, 0.9312);
}

/// From the reference's start, the bias-only weights diverge with acceleration; the run goes on without it and says so.
#[test]
fn a_diverging_run_goes_on_without_acceleration() {
    let Some(root) = test_data::root() else { return };
    let bench = Bench::new();
    let run = bench.run_on(&root, "gray/gap-ffdnet.toml", &["denoiser.weights=ffdnet_gray.pth"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(run.stdout.contains("went on without acceleration"), "{}", run.stdout);
    let m = &bench.record("out")["measurements"][0];
    assert_eq!((&m["stop"], &m["backed_off"]["without"]), (&"schedule_done".into(), &"acceleration".into()));
    assert!(m["psnr_db"].as_f64().unwrap() > 19.0, "{}", m["psnr_db"]);
}

/// A network for the wrong number of channels is found out before anything is solved.
#[test]
fn color_weights_on_a_gray_scene() {
    let Some(root) = test_data::root() else { return };
    let bench = Bench::new();
    let run = bench.run_on(&root, "gray/gap-ffdnet.toml", &["denoiser.weights=ffdnet_color.pth"]);
    assert_eq!(run.code, 1);
    assert!(run.stderr.contains("denoiser.weights") && run.stderr.contains("3 channels"), "{}", run.stderr);
    assert!(bench.names().is_empty());
}
