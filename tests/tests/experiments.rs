//! Experiment files that extend others, and the count of networks' work.

use std::path::Path;

use e2e::{Bench, Finished, workspace};
use ndarray::ArrayD;
use ndarray_npy::read_npy;
use nets::Layers;

/// The demo's video through masks of two frames, denoised once by TV.
fn config() -> String {
    let video = workspace().join("configs/demo/bunny");
    format!(
        "[data]\nkind = \"simulate\"\npath = '{}'\nmeasurements = [0]\n[data.mask]\nkind = \"random\"\nframes = 2\n\
         [solver]\nkind = \"gap\"\naccelerate = false\n[denoiser]\nkind = \"tv\"\n[[stage]]\niterations = 1\n[output]\nframes = false\n",
        video.display()
    )
}

fn bench() -> Bench {
    let bench = Bench::new();
    bench.write("base.toml", config());
    bench
}

fn run(bench: &Bench, file: &str, sets: &[&str]) -> Finished {
    let sets = sets.iter().flat_map(|set| ["--set", set]);
    bench.sci(&["run", file, "--out", "out"].into_iter().chain(sets).collect::<Vec<_>>())
}

#[track_caller]
fn runs(bench: &Bench, file: &str, sets: &[&str]) -> serde_json::Value {
    let run = run(bench, file, sets);
    assert_eq!(run.code, 0, "{}", run.stderr);
    bench.record("out")
}

#[track_caller]
fn fails(bench: &Bench, file: &str, sets: &[&str], code: i32, needles: &[&str]) {
    let run = run(bench, file, sets);
    assert_eq!(run.code, code, "{}", run.stderr);
    for needle in needles {
        assert!(run.stderr.contains(needle), "{needle:?} is not in: {}", run.stderr);
    }
}

#[test]
fn a_file_says_only_where_it_differs() {
    let bench = Bench::new();
    std::fs::create_dir(bench.path("sub")).unwrap();
    bench.write("sub/base.toml", config());
    bench.write("a.toml", "extends = \"sub/base.toml\"\n[denoiser]\nweight = 0.2\n[[stage]]\niterations = 2\n");
    let record = runs(&bench, "a.toml", &[]);
    assert_eq!((&record["experiment"], &record["measurements"][0]["iterations"]), (&"a".into(), &2.into()));
    assert_eq!((&record["config"]["denoisers"][0]["weight"], &record["denoiser"]), (&0.2.into(), &"tv".into()));
    assert_eq!(runs(&bench, "a.toml", &["stage.0.iterations=3"])["measurements"][0]["iterations"], 3);
    // A mistake is told with the file it is in.
    bench.write("sub/base.toml", config().replace("kind = \"tv\"", "kind = \"tv\"\ninner = 0"));
    fails(&bench, "a.toml", &[], 2, &["sub/base.toml:13: `denoiser.inner` = 0", "1 to 1000"]);
}

#[test]
fn a_record_holds_what_its_file_extends() {
    let bench = bench();
    bench.write("a.toml", "extends = \"base.toml\"\n[[stage]]\niterations = 2\n");
    let record = runs(&bench, "a.toml", &["denoiser.weight=0.2"]);
    let recon = std::fs::read(bench.path("out/recon.npy")).unwrap();
    let written = &record["config"]["written"];
    let again = Bench::new();
    let files = written["extends"].as_array().unwrap().iter().chain([written]);
    for file in files {
        let name = Path::new(file["file"].as_str().unwrap()).file_name().unwrap().to_str().unwrap();
        again.write(name, file["text"].as_str().unwrap());
    }
    let sets: Vec<&str> = written["set"].as_array().unwrap().iter().map(|set| set.as_str().unwrap()).collect();
    runs(&again, "a.toml", &sets);
    assert!(std::fs::read(again.path("out/recon.npy")).unwrap() == recon);
    // The files themselves need not be there for the page to be made again, with the scene.
    std::fs::remove_file(bench.path("base.toml")).unwrap();
    let page = bench.sci(&["report", "out"]);
    assert!(page.code == 0 && !page.stderr.contains("cannot be read again"), "{}", page.stderr);
}

#[test]
fn what_cannot_be_extended_is_refused() {
    let bench = bench();
    bench.write("a.toml", "\nextends = \"none.toml\"\n");
    fails(&bench, "a.toml", &[], 2, &["a.toml:2:", "`extends` = \"none.toml\"", "cannot read"]);
    bench.write("a.toml", "extends = \"b.toml\"\n");
    bench.write("b.toml", "extends = \"a.toml\"\n");
    fails(&bench, "a.toml", &[], 2, &["b.toml:1:", "`extends` = \"a.toml\"", "cannot extend itself", "a.toml → "]);
    fails(&bench, "base.toml", &["extends=b.toml"], 2, &["--set extends=b.toml:", "line of a file"]);
}

#[test]
fn the_work_of_networks_is_counted() {
    let bench = bench();
    let gmac = |sets: &[&str]| runs(&bench, "base.toml", sets)["measurements"][0]["gmac"].clone();
    assert_eq!(gmac(&[]), serde_json::Value::Null);
    let pixels = read_npy::<_, ArrayD<f32>>(bench.path("out/recon.npy")).unwrap().len() as f64;
    let close = |found: serde_json::Value, expected: f64| {
        let ratio = found.as_f64().unwrap() / expected;
        assert!((ratio - 1.0).abs() < 1e-6, "{found} for {expected}");
    };
    let gray = nets::Ffdnet::load("bundled:ffdnet_gray".as_ref()).unwrap().multiply_adds();
    let ffdnet = "denoiser={kind=\"ffdnet\",weights=\"bundled:ffdnet_gray\"}";
    close(gmac(&[ffdnet, "stage.0.sigma=[25, 12]"]), 2.0 * gray * pixels / 1e9);
    // A demosaicer beside TV on the mosaic is called once, at the end.
    let ddnet = nets::Ddnet::load("bundled:ddnet".as_ref(), nets::Ends::Circular).unwrap().multiply_adds();
    let color = ["data.cfa=rggb", "solver.demosaicer=ddnet", "solver.weights=bundled:ddnet"];
    close(gmac(&color), ddnet * pixels / 1e9);
}
