//! A prior of similar patches after the network's result: better than the network alone where a scene repeats itself.

use e2e::{Bench, data_root, workspace};

#[test]
fn refined_is_better_than_default_on_traffic() {
    let Some(root) = data_root() else { return };
    let [default, refined] = ["default", "refined"].map(|name| {
        let bench = Bench::new();
        let mut command = bench.command(&["run", "--out", "out", "--set", "data.measurements=[0]"]);
        let config = workspace().join(format!("configs/gray/{name}.toml"));
        let run = bench.finish(command.arg(config).env("SCI_DATA", &root));
        assert_eq!(run.code, 0, "{}", run.stderr);
        bench.record("out")["measurements"][0]["psnr_db"].as_f64().unwrap()
    });
    assert!(refined > default + 1.0, "default {default:.2} dB, refined {refined:.2} dB");
}
