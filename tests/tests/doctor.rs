//! `sci doctor` on a machine where all is well, and on those where something is not.

use std::collections::BTreeMap;

use e2e::{Bench, Finished};
use serde_json::Value;

/// The findings by name; of the self-tests the last.
fn findings(run: &Finished) -> BTreeMap<String, Value> {
    let found: Value = serde_json::from_str(&run.stdout).expect("--json prints JSON");
    let list = found["findings"].as_array().expect("a list").iter();
    list.map(|finding| (finding["name"].as_str().expect("a name").to_owned(), finding.clone())).collect()
}

#[test]
fn a_machine_that_works_is_told_what_it_uses() {
    let bench = Bench::new();
    let run = bench.sci(&["doctor"]);
    assert_eq!(run.code, 0, "{}{}", run.stdout, run.stderr);
    for part in
        ["networks use", "in the program", "fastdvdnet_gray_sci", "self-test", "Everything that is needed works."]
    {
        assert!(run.stdout.contains(part), "{part}: {}", run.stdout);
    }
    let run = bench.sci(&["doctor", "--json", "--threads", "1"]);
    assert_eq!(run.code, 0, "{}{}", run.stdout, run.stderr);
    let found = findings(&run);
    assert_eq!(found["threads"]["details"]["used"], 1);
    assert!(found["memory"]["details"]["total_bytes"].as_u64() > Some(1 << 27), "{}", found["memory"]);
    assert_eq!(found["weights"]["details"].as_array().map(Vec::len), Some(nets::weights::bundled_names().len()));
    assert!(found["self-test"]["details"]["psnr_db"].as_f64() > Some(30.0), "{}", found["self-test"]);
    // It looks, and leaves nothing behind.
    assert!(bench.names().is_empty(), "{:?}", bench.names());
}

#[test]
fn what_is_missing_is_no_error() {
    let bench = Bench::new();
    let run = bench.finish(bench.command(&["doctor", "--json"]).env("PATH", bench.path("nowhere")));
    assert_eq!(run.code, 0, "{}{}", run.stdout, run.stderr);
    let found = findings(&run);
    for name in ["ffmpeg", "data"] {
        assert_eq!(found[name]["state"], "missing", "{}", found[name]);
    }
}

#[test]
fn what_is_broken_is_named() {
    let bench = Bench::new();
    bench.write("file", "");
    let mut command = bench.command(&["doctor", "--json", "--out", "file/runs"]);
    command.env("SCI_DATA", bench.path("nowhere")).env("SCI_KERNEL", "abacus");
    let run = bench.finish(&mut command);
    assert_eq!(run.code, 1, "{}{}", run.stdout, run.stderr);
    // A network has no kernel to run on then, and the last self-test is one with a network.
    for name in ["data", "results", "processor", "self-test"] {
        assert_eq!(findings(&run)[name]["state"], "broken", "{name}: {}", run.stdout);
        assert!(run.stderr.contains(name), "{}", run.stderr);
    }
    assert!(run.stdout.contains("abacus") && run.stdout.contains("nowhere"), "{}", run.stdout);
}
