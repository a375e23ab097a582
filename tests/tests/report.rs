//! `report.html` in a real browser: it loads without an error, and slider and keys change the frame.

use std::path::{Path, PathBuf};
use std::process::Command;

use e2e::{Bench, on_the_demo};

/// A browser on the `PATH`, or in `SCI_BROWSER`.
fn browser() -> Option<PathBuf> {
    let named = std::env::var_os("SCI_BROWSER").map(PathBuf::from);
    let path = std::env::var_os("PATH").unwrap_or_default();
    let found = named.or_else(|| {
        let names = ["chromium", "chromium-browser", "google-chrome"];
        std::env::split_paths(&path).flat_map(|dir| names.map(|n| dir.join(n))).find(|p| p.is_file())
    });
    if found.is_none() {
        test_data::skip("no chromium, chromium-browser or google-chrome on the PATH (SCI_BROWSER may name one)");
    }
    found
}

/// Acts on the page as a user would and leaves what was seen in the document.
const USER: &str = r#"<script>
const seen = [];
window.addEventListener("error", e => seen.push("error: " + e.message));
addEventListener("load", () => {
  const look = () => {
    const result = document.getElementById("result");
    return [document.getElementById("frame").value, result.dataset.frame, result.src.length + ":" + result.src.slice(-40),
      document.getElementById("readout").textContent, [...document.querySelectorAll(".bar")].findIndex(b => b.classList.contains("now"))].join(" | ");
  };
  const slider = document.getElementById("frame");
  seen.push("start " + look());
  slider.value = 2;
  slider.dispatchEvent(new Event("input"));
  seen.push("slider " + look());
  document.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowLeft", bubbles: true }));
  seen.push("key " + look());
  const choice = document.getElementById("measurement");
  choice.value = 1;
  choice.dispatchEvent(new Event("change"));
  seen.push("measurement " + look());
  // False where the page takes the key.
  const key = (target, init) => target.dispatchEvent(new KeyboardEvent("keydown", { bubbles: true, cancelable: true, ...init }));
  const summary = document.querySelector("summary");
  seen.push("theirs " + [key(document, { key: "ArrowLeft", altKey: true }), key(summary, { key: " " }), key(choice, { key: "ArrowRight" })]);
  const play = [...document.querySelectorAll("button")].find(b => b.textContent === "play");
  seen.push("space " + [key(document.body, { key: " " }), play.textContent, key(document.body, { key: " " }), play.textContent, slider.value]);
  const pre = document.createElement("pre");
  pre.id = "seen";
  pre.textContent = seen.join("\n");
  document.body.append(pre);
});
</script>"#;

fn dump(browser: &Path, bench: &Bench, page: &Path) -> String {
    let mut command = Command::new(browser);
    command.args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run"]);
    command.arg(format!("--user-data-dir={}", bench.path("profile").display()));
    command.args(["--virtual-time-budget=5000", "--dump-dom"]).arg(format!("file://{}", page.display()));
    let output = command.output().expect("the browser starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

#[test]
fn the_slider_changes_the_frame() {
    let Some(browser) = browser() else { return };
    let bench = Bench::new();
    bench.write("scene.toml", on_the_demo("gray/gap-tv-fast.toml", "kind = \"random\""));
    let run = bench.sci(&["run", "scene.toml", "--out", "run", "--set", "stage.0.iterations=3"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let page = std::fs::read_to_string(bench.path("run/report.html")).expect("a run writes its report");
    assert!(page.len() < 4_000_000, "{} bytes", page.len());
    bench.write("test.html", page.replacen("<head>", &format!("<head>{USER}"), 1));
    let dom = dump(&browser, &bench, &bench.path("test.html"));

    let seen =
        dom.split_once("<pre id=\"seen\">").and_then(|(_, rest)| rest.split_once("</pre>")).map(|(seen, _)| seen);
    let seen: Vec<&str> = seen.expect("the page ran to its end").lines().collect();
    assert_eq!(seen.len(), 6, "{seen:#?}");
    assert_eq!(seen[4..], ["theirs true,true,true", "space false,pause,false,play,1"]);
    let seen = &seen[..4];
    let fields: Vec<Vec<&str>> = seen.iter().map(|line| line.split(" | ").collect()).collect();
    for (line, (doing, frame)) in fields.iter().zip([("start", 0), ("slider", 2), ("key", 1), ("measurement", 1)]) {
        assert_eq!(line[0], format!("{doing} {frame}"));
        assert_eq!((line[1], line[4]), (frame.to_string().as_str(), frame.to_string().as_str()), "{line:?}");
        assert!(line[3].starts_with(&format!("frame {frame} of 0–7 · ")), "{line:?}");
    }
    let pictures: std::collections::BTreeSet<&str> = fields.iter().map(|line| line[2]).collect();
    assert_eq!(pictures.len(), 4, "each step shows another picture: {pictures:#?}");
    assert!(dom.contains("<svg") && dom.contains("class=\"curve\""), "the charts are drawn");
}
