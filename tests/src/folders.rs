//! What a run has left in its folder.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde_json::Value;

/// Every file below a folder, with its bytes; of a record and a page without what depends on the day and the machine's work.
///
/// # Panics
/// If one cannot be read.
pub fn contents(dir: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    let mut folders = vec![dir.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                folders.push(path);
                continue;
            }
            let bytes = fs::read(&path).expect("a file");
            let name = path.strip_prefix(dir).expect("it is below").to_owned();
            let bytes = match name.to_str() {
                Some("record.json") => {
                    timeless(&serde_json::from_slice(&bytes).expect("a record is JSON")).into_bytes()
                }
                Some("report.html") => timeless_page(&String::from_utf8(bytes).expect("a page is text")).into_bytes(),
                _ => bytes,
            };
            files.insert(name, bytes);
        }
    }
    files
}

fn timeless(record: &Value) -> String {
    let mut record = record.clone();
    for key in ["peak_rss_bytes", "wall_seconds", "shards"] {
        record[key] = Value::Null;
    }
    record["mean"]["seconds"] = Value::Null;
    for m in record["measurements"].as_array_mut().expect("a list") {
        m["seconds"] = Value::Null;
        m["trace"]["seconds"] = Value::Null;
    }
    record.to_string()
}

/// What the script of a report reads.
///
/// # Panics
/// If the page is none of ours.
pub fn page_data(page: &str) -> Value {
    let (_, rest) = page.split_once("id=\"data\">").expect("it has data");
    serde_json::from_str(rest.split_once("</script>").expect("it has an end").0).expect("data is JSON")
}

fn timeless_page(page: &str) -> String {
    let data = page_data(page);
    format!("{}{}", timeless(&data["runs"][0]), data["images"])
}

/// Two runs left the same, but for [`contents`]' exceptions.
///
/// # Panics
/// If they did not.
#[track_caller]
pub fn assert_same(found: &Path, expected: &Path) {
    let (found, expected) = (contents(found), contents(expected));
    assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    for (name, bytes) in &found {
        assert!(*bytes == expected[name], "{} differs", name.display());
    }
}

/// Waits until a file is there.
///
/// # Panics
/// After two minutes.
pub fn wait_for(path: &Path) {
    let begin = Instant::now();
    while !path.exists() {
        assert!(begin.elapsed() < Duration::from_secs(120), "{} does not come", path.display());
        std::thread::sleep(Duration::from_millis(2));
    }
}
