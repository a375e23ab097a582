//! A prior of similar patches after the network's result: better than the network alone.

use e2e::{Bench, on_the_demo};

fn psnr(config: &str) -> f64 {
    let bench = Bench::new();
    bench.write("scene.toml", on_the_demo(config));
    let run = bench.sci(&["run", "scene.toml", "--out", "out", "--set", "data.measurements=[0]"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    bench.record("out")["measurements"][0]["psnr_db"].as_f64().unwrap()
}

#[test]
fn refined_is_better_than_default() {
    let [default, refined] = ["gray/default.toml", "gray/refined.toml"].map(psnr);
    assert!(refined > default + 0.2, "default {default:.2} dB, refined {refined:.2} dB");
}
