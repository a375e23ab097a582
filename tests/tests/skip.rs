//! `[skip]`: what it leaves out is told, and switched off it changes nothing.

use std::path::Path;

use e2e::{Bench, workspace};

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
    let demo = workspace().join("configs/demo.toml");
    let without = run(&bench, &demo, "without", &[]);
    let off = run(&bench, &demo, "off", &["skip.enabled=false", "skip.overshoot=1"]);
    assert!(without == off);
    let record = bench.record("off");
    let m = &record["measurements"][0];
    assert_eq!((&m["skipped"]["iterations"], m["trace"].get("predicted_error")), (&0.into(), None));
}

#[test]
fn a_network_is_given_the_sigmas_that_auto_stands_for() {
    let bench = Bench::new();
    let auto = workspace().join("configs/gray/auto.toml");
    let config = std::fs::read_to_string(auto).unwrap();
    let video = format!("kind = \"simulate\"\npath = '{}'\n", workspace().join("configs/demo/bunny").display());
    let data = config.find("path = ").unwrap()..config.find("[solver]").unwrap();
    let config = [&config[..data.start], &video, "[data.mask]\nkind = \"random\"\n", &config[data.end..]].concat();
    std::fs::write(bench.path("auto.toml"), config).unwrap();
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
