//! Every mistake gives its exit code, a message that names file, key, value and what is legal, and no output.

use e2e::Bench;
use sci_cli::io::mat::{Variable, write_v5};

const CONFIG: &str = r#"
[data]
path = "scene.mat"
[solver]
kind = "gap"
[denoiser]
kind = "tv"
[[stage]]
iterations = 2
"#;

/// Masks and measurements of 2 frames of 8×6, as .mat.
fn scene(meas_rows: usize, bad_value: Option<f32>, names: [&str; 2]) -> Vec<u8> {
    let mask: Vec<f32> = (0..96).map(|i| (i % 2) as f32).collect();
    let mut meas = vec![100.0; meas_rows * 6];
    if let Some(v) = bad_value {
        meas[3 * meas_rows + 2] = v;
    }
    let mut bytes = Vec::new();
    let variables = [
        Variable { name: names[0], size: &[8, 6, 2], data: &mask },
        Variable { name: names[1], size: &[meas_rows, 6, 1], data: &meas },
    ];
    write_v5(&mut bytes, &variables).unwrap();
    bytes
}

fn bench() -> Bench {
    let bench = Bench::new();
    bench.write("scene.mat", scene(8, None, ["mask", "meas"]));
    bench.write("a.toml", CONFIG);
    bench
}

/// Runs `a.toml` with `arguments`; it must fail with `code` and say all of `needles`, and leave nothing.
#[track_caller]
fn fails(bench: &Bench, arguments: &[&str], code: i32, needles: &[&str]) {
    let before = bench.names();
    let run = bench.sci(&[&["run", "a.toml", "--out", "out"], arguments].concat());
    assert_eq!(run.code, code, "{}", run.stderr);
    for needle in needles {
        assert!(run.stderr.contains(needle), "{needle:?} is not in: {}", run.stderr);
    }
    assert_eq!(run.stderr.lines().filter(|l| l.starts_with("error: ")).count(), 1, "{}", run.stderr);
    assert!(!run.stderr.contains("panicked"), "{}", run.stderr);
    assert_eq!(bench.names(), before, "a failed run leaves nothing");
}

/// The same with one text of the config replaced.
#[track_caller]
fn config_fails(from: &str, to: &str, needles: &[&str]) {
    let bench = bench();
    assert!(CONFIG.contains(from), "{from:?}");
    bench.write("a.toml", CONFIG.replace(from, to));
    fails(&bench, &[], 2, needles);
}

#[test]
fn the_config_itself_is_right() {
    let bench = bench();
    let run = bench.sci(&["run", "a.toml", "--out", "out"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(bench.path("out/recon.npy").is_file() && bench.path("out/record.json").is_file());
}

#[test]
fn unknown_key() {
    config_fails(
        "iterations = 2",
        "iterationz = 2",
        &["a.toml:9:", "`stage.0.iterationz`", "did you mean `iterations`", "sigma"],
    );
    config_fails("[denoiser]", "[denoizer]", &["a.toml:6:", "`denoizer`", "did you mean `denoiser`"]);
    config_fails(
        "[solver]",
        "keys.masc = \"m\"\n[solver]",
        &["a.toml:4:", "`data.keys.masc`", "mask, meas, orig, rgb"],
    );
}

#[test]
fn wrong_type() {
    let legal = "a whole number from 0 to 100000";
    config_fails("iterations = 2", "iterations = \"many\"", &["a.toml:9:", "`stage.0.iterations` = \"many\"", legal]);
    config_fails("iterations = 2", "iterations = 2.5", &["`stage.0.iterations` = 2.5", legal]);
    config_fails(
        "kind = \"gap\"",
        "kind = \"gap\"\naccelerate = 1",
        &["a.toml:6:", "`solver.accelerate` = 1", "true or false"],
    );
    config_fails("path = \"scene.mat\"", "path = 3", &["`data.path` = 3", "the path of a file"]);
    config_fails("[denoiser]\nkind = \"tv\"\n", "denoiser = 3\n", &["unknown key `solver.denoiser`"]);
}

#[test]
fn out_of_range() {
    config_fails("iterations = 2", "iterations = -2", &["a.toml:9:", "`stage.0.iterations` = -2", "0 to 100000"]);
    for (sigma, legal) in
        [("300", "0 to 255"), ("[]", "in a list"), ("[20, 300]", "0 to 255"), ("[20, true]", "in a list")]
    {
        let stage = format!("kind = \"wnnm\"\n[[stage]]\nsigma = {sigma}");
        let problem = format!("`stage.0.sigma` = {sigma}");
        config_fails("kind = \"tv\"\n[[stage]]", &stage, &["a.toml:9:", &problem, legal]);
    }
    config_fails("kind = \"tv\"", "kind = \"tv\"\nweight = nan", &["`denoiser.weight` = nan", "0.000001 to 100"]);
    config_fails("[data]", "name = \"../up\"\n[data]", &["a.toml:2:", "`name` = \"../up\""]);
    config_fails("[data]", "seed = -1\n[data]", &["`seed` = -1", "at least 0"]);
}

#[test]
fn a_key_without_effect() {
    config_fails(
        "iterations = 2",
        "iterations = 2\nsigma = 30",
        &["a.toml:10:", "`stage.0.sigma` has no effect", "denoiser.weight"],
    );
    config_fails(
        "kind = \"gap\"",
        "kind = \"gap\"\nstart_weight = 1",
        &["`solver.start_weight` has no effect", "start = \"tv\""],
    );
    config_fails(
        "kind = \"gap\"",
        "kind = \"gap\"\naccelerate = false\nmomentum = \"zero\"",
        &["`solver.momentum` has no effect"],
    );
}

#[test]
fn missing_parts() {
    config_fails("[[stage]]\niterations = 2\n", "", &["a.toml: no [[stage]]"]);
    config_fails("iterations = 2", "", &["a.toml:8:", "`stage.0.iterations` is missing", "0 to 100000"]);
    config_fails("kind = \"gap\"", "", &["a.toml:4:", "`solver.kind` is missing", "gap, admm"]);
    config_fails("path = \"scene.mat\"", "", &["a.toml:2:", "`data.path` is missing"]);
}

#[test]
fn not_toml() {
    config_fails("[solver]", "[solver", &["a.toml:4:", "not valid TOML"]);
    let bench = bench();
    bench.write("a.toml", [0xff, 0xfe, 0]);
    fails(&bench, &[], 2, &["a.toml", "not a text file"]);
    let run = bench.sci(&["run", "nowhere.toml"]);
    assert_eq!(run.code, 2);
    assert!(run.stderr.contains("nowhere.toml"), "{}", run.stderr);
}

#[test]
fn settings_of_wnnm_and_wavelets_are_checked() {
    for (denoiser, needles) in [
        ("denoiser={kind=\"wnnm\",patch=1}", ["`denoiser.patch` = 1", "2 to 16"]),
        ("denoiser={kind=\"wnnm\",lambda=0.1}", ["lambda", "window"]),
        ("denoiser={kind=\"wnnm\",match_every=0}", ["`denoiser.match_every` = 0", "1 to 1000"]),
        ("denoiser={kind=\"wavelet\",levels=9}", ["`denoiser.levels` = 9", "1 to 8"]),
        ("denoiser={kind=\"wavelet\",threshold=-1}", ["`denoiser.threshold` = -1", "0 to 100"]),
    ] {
        fails(&bench(), &["--set", denoiser], 2, &needles);
    }
    // A tile is another video than the one before it.
    let kept = ["denoiser={kind=\"wnnm\",match_every=2}", "stage.0.sigma=20", "skip.enabled=true"];
    let kept = kept.map(|set| ["--set", set]).concat();
    fails(&bench(), &kept, 2, &["`skip.tiles` is true", "denoiser.match_every", "legal: false"]);
}

#[test]
fn settings_of_skipping_are_checked() {
    for (argument, needles) in [
        ("skip.enabled=maybe", ["`skip.enabled` = maybe", "true"]),
        ("skip.gain=2", ["`skip.gain` = 2", "0 to 0.5"]),
        ("skip.spacing=1", ["`skip.spacing` = 1", "2 to 1024"]),
        ("skip.tile=true", ["unknown key `skip.tile`", "did you mean `tiles`"]),
    ] {
        let needles: Vec<&str> = needles.to_vec();
        fails(&bench(), &["--set", argument], 2, &needles);
    }
}

#[test]
fn settings_of_adaptation_are_checked() {
    for (argument, needles) in [
        ("online.interval=0", ["`online.interval` = 0", "1 to 100000"]),
        ("online.learning_rate=0", ["`online.learning_rate` = 0", "to 1"]),
        ("online.reuse=keep", ["`online.reuse` = keep", "reset, carry-over"]),
        ("online.parameters=none", ["`online.parameters` = none", "all, biases"]),
        ("online.intervall=3", ["unknown key `online.intervall`", "did you mean `interval`"]),
        ("online.enabled=true", ["[online] has no effect", "no stage has a network"]),
    ] {
        fails(&bench(), &["--set", argument], 2, &needles);
    }
    // Low rank is no network either.
    let wnnm = ["--set", "denoiser={kind=\"wnnm\"}", "--set", "stage.0.sigma=20", "--set", "online.enabled=true"];
    fails(&bench(), &wnnm, 2, &["[online] has no effect", "no stage has a network"]);
}

#[test]
fn overrides_are_checked_like_the_file() {
    fails(
        &bench(),
        &["--set", "stage.0.iterations=-1"],
        2,
        &["--set stage.0.iterations=-1:", "`stage.0.iterations` = -1", "0 to 100000"],
    );
    fails(&bench(), &["--set", "stage.4.iterations=1"], 2, &["--set stage.4.iterations=1:", "stage.0"]);
    fails(&bench(), &["--set", "gap.iterations=1"], 2, &["unknown key `gap`", "solver"]);
    fails(&bench(), &["--set", "solver.start=meen"], 2, &["`solver.start` = meen", "mean, adjoint, previous, tv"]);
    fails(&bench(), &["--set", "nonsense"], 2, &["--set nonsense:", "key=value"]);
    fails(&bench(), &["--set", "data.measurements=[1]"], 2, &["scene.mat", "`data.measurements` names 1", "0 to 0"]);
    fails(&bench(), &["--set", "data.measurements=[0, 0]"], 2, &["`data.measurements` = [0, 0]", "none twice"]);
}

#[test]
fn gray_scenes_have_no_color_solver() {
    fails(&bench(), &["--set", "solver.kind=two-stage"], 1, &["solver.kind", "color sensors", "data.cfa"]);
    fails(&bench(), &["--set", "solver.demosaicer=menon"], 1, &["solver.demosaicer", "no effect", "data.cfa"]);
    fails(&bench(), &["--set", "data.cfa=rgbg"], 2, &["`data.cfa` = rgbg", "rggb, bggr, grbg, gbrg"]);
    fails(&bench(), &["--set", "solver.weights=a"], 2, &["`solver.weights` has no effect", "ddnet"]);
}

#[test]
fn schedules_are_chosen_by_name() {
    let bench = bench();
    bench.write("a.toml", format!("schedule = \"long\"\n{CONFIG}\n[schedules]\nlong = [{{ iterations = 3 }}]\n"));
    let run = bench.sci(&["run", "a.toml", "--out", "out"]);
    assert_eq!(
        (run.code, bench.record("out")["measurements"][0]["iterations"].as_u64()),
        (0, Some(3)),
        "{}",
        run.stderr
    );
    fails(&bench, &["--set", "schedule=short"], 2, &["`schedule` = short", "legal: long"]);
}

#[test]
fn missing_file() {
    fails(
        &bench(),
        &["--set", "data.path=no.mat"],
        2,
        &["--set data.path=no.mat:", "`data.path` = \"no.mat\"", "looked in", "SCI_DATA"],
    );
    config_fails("scene.mat", "no.mat", &["a.toml:3:", "`data.path` = \"no.mat\"", "looked in"]);
}

#[test]
fn missing_weights_say_which_file_goes_where() {
    let ffdnet = "kind = \"ffdnet\"\nweights = \"ffdnet_gray_ipol.pth\"";
    let bench = bench();
    bench.write(
        "a.toml",
        CONFIG.replace("kind = \"tv\"", ffdnet).replace("iterations = 2", "iterations = 2\nsigma = 6"),
    );
    let needles = [
        "a.toml:8:",
        "`denoiser.weights` = \"ffdnet_gray_ipol.pth\"",
        "https://",
        "net_gray.pth",
        "weights/ffdnet_gray_ipol.pth",
    ];
    fails(&bench, &[], 2, &needles);
}

#[test]
fn sizes_that_differ() {
    let bench = bench();
    bench.write("scene.mat", scene(7, None, ["mask", "meas"]));
    fails(&bench, &[], 1, &["scene.mat", "`meas` is 7×6", "`mask` is 8×6", "must be equal"]);
}

#[test]
fn values_that_are_not_finite() {
    for (value, text) in [(f32::NAN, "NaN"), (f32::INFINITY, "inf")] {
        let bench = bench();
        bench.write("scene.mat", scene(8, Some(value), ["mask", "meas"]));
        fails(&bench, &[], 1, &["scene.mat", &format!("`meas` is {text}"), "row 2, column 3", "finite"]);
    }
}

#[test]
fn an_empty_folder() {
    let bench = bench();
    std::fs::create_dir(bench.path("empty")).unwrap();
    fails(&bench, &["--set", "data.path=empty"], 1, &["data.path", "empty", "no .png, .jpg or .tif frames"]);
    let simulate = ["--set", "data.path=empty", "--set", "data.kind=simulate", "--set", "data.mask={kind=\"random\"}"];
    fails(&bench, &simulate, 1, &["data.path", "empty", "no .png, .jpg or .tif frames"]);
}

#[test]
fn a_truncated_mat() {
    let whole = scene(8, None, ["mask", "meas"]);
    let bench = bench();
    for len in [whole.len() - 40, whole.len() / 2, 200, 100] {
        bench.write("scene.mat", &whole[..len]);
        fails(&bench, &[], 1, &["data.path", "scene.mat"]);
    }
    bench.write("scene.mat", &whole[..whole.len() - 40]);
    fails(&bench, &[], 1, &["cut short"]);
}

#[test]
fn a_mat_without_the_keys() {
    let bench = bench();
    bench.write("scene.mat", scene(8, None, ["open", "light"]));
    fails(&bench, &[], 1, &["scene.mat", "no variable `mask`", "`open`, `light`", "data.keys"]);
    let named = bench.sci(&["run", "a.toml", "--out", "out", "--set", "data.keys={mask=\"open\", meas=\"light\"}"]);
    assert_eq!(named.code, 0, "{}", named.stderr);
}

#[test]
fn another_kind_of_file() {
    let bench = bench();
    bench.write("scene.mat", "hello");
    fails(&bench, &[], 1, &["scene.mat", "unknown format", ".npz"]);
}

#[test]
fn a_failing_run_leaves_a_finished_one_alone() {
    let bench = bench();
    assert_eq!(bench.sci(&["run", "a.toml", "--out", "out"]).code, 0);
    let record = std::fs::read(bench.path("out/record.json")).unwrap();
    bench.write("scene.mat", scene(8, Some(f32::NAN), ["mask", "meas"]));
    fails(&bench, &[], 1, &["finite"]);
    assert_eq!(std::fs::read(bench.path("out/record.json")).unwrap(), record);
}

#[test]
fn bad_usage() {
    let bench = bench();
    for args in [
        &["run"][..],
        &["jump"],
        &["run", "a.toml", "--threads", "0"],
        &["mask", "--out", "m.xyz"],
        &["mask", "--out", "m.npy", "--density", "2"],
    ] {
        let run = bench.sci(args);
        assert_eq!(run.code, 2, "{args:?}: {}", run.stderr);
    }
    bench.write("file", "");
    let run = bench.sci(&["run", "a.toml", "--out", "file"]);
    assert_eq!(run.code, 2);
    assert!(run.stderr.contains("file, expected a folder"), "{}", run.stderr);
}
