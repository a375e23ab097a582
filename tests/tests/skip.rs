//! `[skip]`: what it leaves out is told, and switched off it changes nothing.

use std::path::Path;

use e2e::{Bench, on_the_demo};

/// The mask of all runs.
const RANDOM: &str = "kind = \"random\"";

/// Runs a config on measurement 0 and gives the video as the bytes of its file.
fn run(bench: &Bench, config: &Path, out: &str, set: &[&str]) -> Vec<u8> {
    let mut command = bench.command(&["run", "--out", out, "--set", "data.measurements=[0]"]);
    set.iter().for_each(|s| {
        command.args(["--set", s]);
    });
    let run = bench.finish(command.arg(config));
    assert_eq!(run.code, 0, "{}", run.stderr);
    std::fs::read(bench.path(&format!("{out}/recon.npy"))).unwrap()
}

#[test]
fn switched_off_it_changes_no_bit() {
    let bench = Bench::new();
    std::fs::write(bench.path("scene.toml"), on_the_demo("gray/gap-tv.toml", RANDOM)).unwrap();
    let scene = bench.path("scene.toml");
    let without = run(&bench, &scene, "without", &[]);
    let off = run(&bench, &scene, "off", &["skip.enabled=false", "skip.overshoot=1"]);
    assert!(without == off);
    let record = bench.record("off");
    let m = &record["measurements"][0];
    assert_eq!((&m["skipped"]["iterations"], m["trace"].get("predicted_error")), (&0.into(), None));
}

#[test]
fn a_judge_tells_how_good_the_result_is_without_a_truth() {
    let bench = Bench::new();
    std::fs::write(bench.path("tv.toml"), on_the_demo("gray/gap-tv.toml", RANDOM)).unwrap();
    run(&bench, &bench.path("tv.toml"), "out", &["judge=true"]);
    let record = bench.record("out");
    let m = &record["measurements"][0];
    let [predicted, psnr] = ["predicted_psnr_db", "psnr_db"].map(|key| m[key].as_f64().unwrap());
    // Few pixels on edges have most of the error, and 441 are asked.
    assert!((predicted - psnr).abs() < 3.0, "{predicted} dB predicted, {psnr} dB");
    assert_eq!((&m["skipped"]["iterations"], &m["stop"]), (&0.into(), &"schedule_done".into()));
    assert_eq!(record["config"]["judge"], true);
}

#[test]
fn a_network_is_given_the_sigmas_that_auto_stands_for() {
    let bench = Bench::new();
    std::fs::write(bench.path("auto.toml"), on_the_demo("gray/auto.toml", RANDOM)).unwrap();
    run(&bench, &bench.path("auto.toml"), "auto", &["stage.0.iterations=4"]);
    let record = bench.record("auto");
    let m = &record["measurements"][0];
    let list =
        |key: &str| -> Vec<f64> { m["trace"][key].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect() };
    let (sigmas, errors) = (list("sigma"), list("predicted_error"));
    // TV without a σ first, then σ that only falls.
    let network: Vec<f64> = sigmas.iter().copied().filter(|&s| s > 0.0).collect();
    assert!(sigmas[0] == 0.0 && !network.is_empty() && network.is_sorted_by(|a, b| a >= b), "{sigmas:?}");
    assert!(
        network.iter().all(|s| [50.0, 25.0, 12.0, 6.0].iter().any(|v| (s * 255.0 - v).abs() < 1e-3)),
        "{network:?}"
    );
    assert_eq!(errors.len(), sigmas.len());
    assert!(errors.iter().all(|&e| e > 0.0) && errors.last() < errors.first(), "{errors:?}");
    assert!(m["skipped"]["iterations"].as_u64().unwrap() > 0, "{}", m["skipped"]);
}

#[test]
fn tv_goes_first_only_once() {
    let bench = Bench::new();
    let config = on_the_demo("gray/fastdvdnet.toml", RANDOM).replace("gray_sci", "gray");
    std::fs::write(bench.path("default.toml"), config).unwrap();
    let iterations_of_tv = |solver: &str| {
        let stages = "stage=[{sigma=20,iterations=2}]";
        run(&bench, &bench.path("default.toml"), "out", &[stages, "skip.enabled=true", solver]);
        let record = bench.record("out");
        let sigmas = record["measurements"][0]["trace"]["sigma"].as_array().unwrap().clone();
        sigmas.iter().filter(|s| s.as_f64() == Some(0.0)).count()
    };
    assert_eq!(iterations_of_tv("solver.momentum=\"measurement\""), 0);
    assert!(iterations_of_tv("solver={kind=\"gap\",start=\"mean\"}") > 0);
}

/// A network that was trained for the σ of its schedule is given all of them, until the run stops, unless the experiment says otherwise.
#[test]
fn the_sigmas_of_a_network_for_iterates_are_not_passed_over() {
    let bench = Bench::new();
    std::fs::write(bench.path("default.toml"), on_the_demo("gray/fastdvdnet.toml", RANDOM)).unwrap();
    // Far above what is left of the error after the start.
    let stages = "stage=[{sigma=100,iterations=1},{sigma=50,iterations=1},{sigma=7,iterations=1}]";
    let sigmas = |overshoot: &[&str]| -> Vec<i64> {
        run(&bench, &bench.path("default.toml"), "out", &[&[stages, "skip.enabled=true"], overshoot].concat());
        let record = bench.record("out");
        let sigmas = record["measurements"][0]["trace"]["sigma"].as_array().unwrap();
        sigmas.iter().map(|sigma| (255.0 * sigma.as_f64().unwrap()).round() as i64).collect()
    };
    assert_eq!(sigmas(&[]), [100, 50, 7]);
    // The calls that are passed over go to the stage after them.
    assert_eq!(sigmas(&["skip.overshoot=2"]), [7, 7, 7]);
}

#[test]
fn what_the_default_cannot_do_with_its_network_is_refused() {
    let bench = Bench::new();
    std::fs::write(bench.path("default.toml"), on_the_demo("gray/fastdvdnet.toml", RANDOM)).unwrap();
    let auto = ["skip.enabled=true", "stage=[{sigma=\"auto\",iterations=4}]"];
    let trained = ["stage.0.sigma", "\"auto\"", "trained for the σ of its schedule"];
    let flips = ["[online]", "denoiser.flips = false", "online.enabled = false"];
    for (sets, parts) in [(&auto[..], trained), (&["online.enabled=true"], flips)] {
        let mut command = bench.command(&["run", "--out", "out"]);
        sets.iter().for_each(|set| {
            command.args(["--set", set]);
        });
        let refused = bench.finish(command.arg(bench.path("default.toml")));
        assert_eq!(refused.code, 2, "{}", refused.stderr);
        for part in parts {
            assert!(refused.stderr.contains(part), "{}", refused.stderr);
        }
        assert!(!bench.path("out").exists());
    }
}
