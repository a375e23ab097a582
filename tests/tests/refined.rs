//! A prior of similar patches after the network's result: better than the network alone where a scene repeats itself.

use e2e::Bench;

#[test]
fn refined_is_better_than_default_on_traffic() {
    let Some(root) = test_data::root() else { return };
    let [default, refined] = ["gray/default.toml", "gray/refined.toml"].map(|config| {
        let bench = Bench::new();
        let run = bench.run_on(&root, config, &["data.path=traffic48.mat"]);
        assert_eq!(run.code, 0, "{}", run.stderr);
        bench.record("out")["measurements"][0]["psnr_db"].as_f64().unwrap()
    });
    assert!(refined > default + 1.0, "default {default:.2} dB, refined {refined:.2} dB");
}
