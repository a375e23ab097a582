//! `[online]`: a network that adapts, from the experiment file to the record.

use e2e::Bench;
use serde_json::Value;

const EXPERIMENT: &str = r#"
[data]
kind = "simulate"
path = "video.npy"
[data.mask]
kind = "random"
frames = 4
[solver]
kind = "gap"
[denoiser]
kind = "ffdnet"
weights = "net.safetensors"
[[stage]]
sigma = 25
iterations = 3
[[stage]]
sigma = 12
iterations = 4
[online]
interval = 2
learning_rate = 1e-3
held_out = 0
growth = 1
save = true
"#;

/// Three measurements of a moving pattern, and a network small enough to train in a test.
fn bench() -> Bench {
    let bench = Bench::new();
    let video = ndarray::Array3::from_shape_fn((12, 32, 32), |(t, y, x)| {
        0.5 + 0.3 * (0.4 * x as f32 + 0.05 * t as f32).sin() * (0.3 * y as f32).cos()
    });
    let mut bytes = Vec::new();
    ndarray_npy::WriteNpyExt::write_npy(&video, &mut bytes).unwrap();
    bench.write("video.npy", bytes);
    bench.write("a.toml", EXPERIMENT);
    let layout = nets::FfdnetLayout::Residual { batch_norm: false };
    let spec = nets::FfdnetSpec { width: 8, depth: 3, layout, ..nets::FfdnetSpec::GRAY };
    let net = nets::Ffdnet::random(spec, 0).unwrap();
    let mut tensors = nets::Layers::state(&net);
    // Near the identity, as a residual network with small weights is.
    tensors.values_mut().for_each(|t| *t = t.affine(0.3, 0.0).unwrap());
    nets::weights::write_safetensors(&bench.path("net.safetensors"), &tensors, nets::weights::Storage::F32).unwrap();
    bench
}

fn run(bench: &Bench, out: &str, set: &[&str]) -> Value {
    let mut args = vec!["run", "a.toml", "--out", out];
    args.extend(set.iter().flat_map(|s| ["--set", s]));
    let run = bench.sci(&args);
    assert_eq!(run.code, 0, "{}", run.stderr);
    bench.record(out)
}

fn psnr(record: &Value) -> Vec<f64> {
    record["measurements"].as_array().unwrap().iter().map(|m| m["psnr_db"].as_f64().unwrap()).collect()
}

#[test]
fn updates_are_recorded_and_the_switch_turns_all_of_it_off() {
    let bench = bench();
    let plain = run(&bench, "plain", &["online.enabled=false"]);
    assert!(plain["measurements"][0].get("online").is_none());
    assert_eq!(plain["config"]["online"]["enabled"], false);
    assert!(!bench.path("plain/adapted-0-ffdnet.safetensors").exists());

    let adapted = run(&bench, "adapted", &[]);
    for m in adapted["measurements"].as_array().unwrap() {
        let (online, updates) = (&m["online"], m["online"]["updates"].as_array().unwrap());
        let iterations: Vec<_> = updates.iter().map(|u| u["iteration"].as_u64().unwrap()).collect();
        assert_eq!(iterations, [2, 4], "the default ends after two");
        assert_eq!(online["counts"]["kept"], m["updates"]);
        assert_eq!(online["counts"]["fired"], 2);
    }
    assert_ne!(psnr(&adapted), psnr(&plain));

    // Far too large a step: all are undone, so that the result is the plain one.
    let guarded = run(&bench, "guarded", &["online.held_out=0.1", "online.learning_rate=1.0"]);
    assert_eq!(psnr(&guarded), psnr(&plain));
    for m in guarded["measurements"].as_array().unwrap() {
        assert_eq!((m["updates"].as_u64(), m["online"]["counts"]["rolled_back"].as_u64()), (Some(0), Some(2)));
    }
}

#[test]
fn measurements_under_reset_are_single_runs_and_saved_weights_can_be_named() {
    let bench = bench();
    let all = psnr(&run(&bench, "all", &[]));
    for (k, expected) in all.iter().enumerate() {
        let alone = run(&bench, "alone", &[&format!("data.measurements=[{k}]")]);
        assert_eq!(psnr(&alone), [*expected], "measurement {k}");
    }
    let carried = psnr(&run(&bench, "carried", &["online.reuse=carry-over"]));
    assert_eq!(carried[0], all[0]);
    assert_ne!(carried[1..], all[1..]);

    let weights = "denoiser.weights=all/adapted-0-ffdnet.safetensors";
    let named = run(&bench, "named", &[weights, "online.enabled=false"]);
    assert_ne!(psnr(&named), psnr(&run(&bench, "plain", &["online.enabled=false"])));
}

/// `[online]` as `gray/adaptive.toml` has it, at the size of a test.
const SPLIT: &str = "online={loss=\"split\",reuse=\"carry-over\",updates=4,every=2,crops=1,side=32,calls=2,learning_rate=1e-3,\
                     judging=0.1,judged_crops=2,precision=\"f32\",save=true}";

#[test]
fn splitting_learns_once_from_all_measurements_before_the_first() {
    let bench = bench();
    let plain = run(&bench, "plain", &["online.enabled=false"]);
    let adapted = run(&bench, "adapted", &[SPLIT]);
    assert_ne!(psnr(&adapted), psnr(&plain));
    let online = |k: usize| &adapted["measurements"][k]["online"];
    let judgements = online(0)["split"]["judgements"].as_array().unwrap();
    let updates: Vec<_> = judgements.iter().map(|j| j["updates"].as_u64().unwrap()).collect();
    assert_eq!(updates, [0, 2, 4]);
    assert_eq!((online(0)["counts"]["fired"].as_u64(), online(0)["split"]["kept"].as_u64()), (Some(4), Some(4)));
    assert!(online(1)["split"].is_null() && online(2)["split"].is_null(), "learned once");

    // What was learned is saved, and is all there is to it.
    let weights = "denoiser.weights=adapted/adapted-0-ffdnet.safetensors";
    assert_eq!(psnr(&run(&bench, "named", &[weights, "online.enabled=false"])), psnr(&adapted));

    // Alone, a measurement is learned from alone.
    let reset = run(&bench, "reset", &[SPLIT, "online.reuse=reset"]);
    for k in 0..3 {
        let alone = run(&bench, "alone", &[SPLIT, "online.reuse=reset", &format!("data.measurements=[{k}]")]);
        assert_eq!(psnr(&alone)[0], psnr(&reset)[k], "measurement {k}");
    }
}

/// The network that adapts, another, and the first again.
const RETURNS: &str = "stage=[{sigma=9,iterations=1},{denoiser={kind=\"tv\"},iterations=1},{sigma=9,iterations=1}]";

/// What a network is adapted to are its own calls, wherever the solve goes on from there.
#[test]
fn another_denoiser_may_take_over_from_the_one_that_learns() {
    let bench = bench();
    let alone = run(&bench, "alone", &[SPLIT, "stage=[{sigma=9,iterations=2}]"]);
    let followed =
        run(&bench, "followed", &[SPLIT, "stage=[{sigma=9,iterations=2},{denoiser={kind=\"tv\"},iterations=2}]"]);
    let learned = |record: &Value| record["measurements"][0]["online"]["split"]["judgements"].clone();
    assert_eq!(learned(&followed), learned(&alone));
    assert_ne!(psnr(&followed), psnr(&alone));
}

/// Of a network it is known whether it is to take over; one that spoils what was learned is left out, of all measurements.
#[test]
fn a_network_that_predicts_pixels_worse_does_not_take_over() {
    let bench = bench();
    let alone = run(&bench, "alone", &[SPLIT, "stage=[{sigma=9,iterations=2}]"]);
    let next = |weights: &str| {
        format!(
            "stage=[{{sigma=9,iterations=2}},{{denoiser={{kind=\"ffdnet\",weights=\"{weights}\"}},sigma=255,iterations=1}}]"
        )
    };
    let spoilt = run(&bench, "spoilt", &[SPLIT, &next("bundled:ffdnet_gray")]);
    let split = &spoilt["measurements"][0]["online"]["split"];
    let judged = split["judgements"][2]["judged"].as_f64().unwrap();
    assert!(split["taken_over"].as_f64().unwrap() > judged, "{split}");
    assert_eq!(psnr(&spoilt), psnr(&alone));
    let iterations = |k: usize| spoilt["measurements"][k]["iterations"].as_u64();
    assert!((0..3).all(|k| iterations(k) == Some(2)));
}

#[test]
fn splitting_wants_one_solve_to_learn_through() {
    let bench = bench();
    for (set, needle) in [
        ("solver.kind=\"admm\"", "`solver.kind` is another"),
        ("solver.momentum=\"zero\"", "`solver.momentum` is zero"),
        ("solver.start=\"adjoint\"", "`solver.start` is another"),
        ("stage=[{denoiser={kind=\"tv\"},iterations=1},{sigma=9,iterations=1}]", "`denoiser` is another"),
        (RETURNS, "`denoiser` is another"),
        ("online.interval=2", "`online.interval` has no effect without online.loss"),
    ] {
        let run = bench.sci(&["run", "a.toml", "--out", "no", "--set", SPLIT, "--set", set]);
        assert!(run.code == 2 && run.stderr.contains(needle), "{set}: {}", run.stderr);
        assert!(!bench.path("no").exists());
    }
}
