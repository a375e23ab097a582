//! Benchmarks: this program and the Python peer in turn on one machine, so that only the ratio has to be believed.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, ensure};
use serde_json::{Value, json};

use crate::workspace::{Sci, cargo, cpu, json_lines, median, output, range, results_dir, revision, root, shared};

#[derive(clap::Args)]
pub(crate) struct Options {
    /// A Python with NumPy, SciPy, scikit-image and PyTorch; without it only our own side is measured
    #[arg(long, value_name = "PYTHON")]
    peer: Option<PathBuf>,
    /// Folder with data/, weights/ and peers/ [default: $SCI_DATA, else ../shared beside the repository]
    #[arg(long, value_name = "DIR")]
    shared: Option<PathBuf>,
    /// Scene file under data/
    #[arg(long, default_value = "traffic48.mat")]
    scene: String,
    /// Runs of each side
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=1000))]
    runs: u32,
    /// Keep the result as xtask/results/CPU/BENCHMARK.json
    #[arg(long)]
    save: bool,
}

impl Options {
    fn peer_script(&self) -> anyhow::Result<Option<(&Path, PathBuf)>> {
        let Some(python) = &self.peer else {
            println!("no Python given (--peer PYTHON): measuring our side only");
            return Ok(None);
        };
        let script = shared(self.shared.as_deref())?.join("peers/peer.py");
        ensure!(script.is_file(), "{} is missing", script.display());
        Ok(Some((python, script)))
    }
}

/// Seconds of several runs, and the quality, which must not vary.
#[derive(Default)]
struct Side {
    seconds: Vec<f64>,
    psnr: Vec<f64>,
    ssim: Vec<f64>,
}

impl Side {
    fn push(&mut self, seconds: &Value, psnr: &Value, ssim: &Value) -> anyhow::Result<()> {
        let number = |v: &Value| v.as_f64().with_context(|| format!("expected a number, found {v}"));
        self.seconds.push(number(seconds)?);
        self.psnr.push(number(psnr)?);
        self.ssim.push(number(ssim)?);
        Ok(())
    }

    fn json(&self) -> Value {
        json!({ "median_seconds": median(&self.seconds), "seconds": self.seconds, "psnr_db": self.psnr[0], "ssim": self.ssim[0] })
    }

    fn line(&self, name: &str) -> String {
        let (low, high) = range(&self.seconds);
        format!(
            "{name:<5} {:>9.4} s (from {low:.4} to {high:.4}, {} runs)   PSNR {:.3} dB   SSIM {:.4}",
            median(&self.seconds),
            self.seconds.len(),
            self.psnr[0],
            self.ssim[0]
        )
    }
}

/// `configs/gray/<name>.toml` against `peer.py <name>` on measurement 0.
pub(crate) fn solver(name: &str, options: &Options) -> anyhow::Result<()> {
    let shared = shared(options.shared.as_deref())?;
    let scene = shared.join("data").join(&options.scene);
    ensure!(scene.is_file(), "{} is missing", scene.display());
    let weights = (name == "gap-ffdnet").then(|| shared.join("weights/ffdnet_gray_ipol.pth"));
    let peer = options.peer_script()?;
    let sci = Sci::build(Some(&shared))?;
    let (mut ours, mut theirs) = (Side::default(), Side::default());
    let config = root().join(format!("configs/gray/{name}.toml"));
    let mut sets = vec![format!("data.path={}", scene.display()), "data.measurements=[0]".into()];
    sets.extend(weights.as_ref().map(|w| format!("denoiser.weights={}", w.display())));
    for _ in 0..options.runs {
        let record = sci.run(&config, &sets)?.success()?;
        let m = &record["measurements"][0];
        ours.push(&m["seconds"], &m["psnr_db"], &m["ssim"])?;
        if let Some((python, script)) = &peer {
            let printed = output(Command::new(python).arg(script).arg(name).arg(&scene).args(&weights))?;
            let r = json_lines(&printed).next().context("the peer printed no result")?;
            theirs.push(&r["seconds"], &r["psnr"], &r["ssim"])?;
        }
    }
    println!("{name} on {}, measurement 0", options.scene);
    println!("{}", ours.line("sci"));
    let mut result = json!({ "benchmark": name, "scene": options.scene, "sci": ours.json() });
    if peer.is_some() {
        println!("{}", theirs.line("peer"));
        let ratio = median(&theirs.seconds) / median(&ours.seconds);
        println!("sci is {ratio:.1} times as fast; PSNR differs by {:+.4} dB", ours.psnr[0] - theirs.psnr[0]);
        result["peer"] = theirs.json();
        result["ratio"] = json!(ratio);
    }
    save(name, result, options)
}

/// `cargo bench -p nets --bench kernels` (ours and candle's convolutions, the peak of a matrix product) beside `peer.py conv`,
/// shape by shape, and the geometric mean of the peer's times over each.
pub(crate) fn kernels(options: &Options) -> anyhow::Result<()> {
    const TIMES: [&str; 2] = ["forward", "forward_backward"];
    let peer = options.peer_script()?;
    let ours: Vec<Value> = json_lines(&output(cargo().args(["bench", "-p", "nets", "--bench", "kernels"]))?).collect();
    let theirs: Vec<Value> = match &peer {
        Some((python, script)) => json_lines(&output(Command::new(python).arg(script).arg("conv"))?).collect(),
        None => Vec::new(),
    };
    let same = |a: &Value, b: &Value| ["batch", "channels", "size"].iter().all(|k| a[*k] == b[*k]);
    let mut rows = Vec::new();
    println!("{:<18} {:<17} {:<7} {:>9} {:>12} {:>7}", "GFLOP/s, direct", "", "", "", "peer", "ratio");
    for row in &ours {
        let Some(name) = row["conv"].as_str() else {
            println!(
                "{:<18} {:<17} {:<7} {:>9.0}",
                "matrix product",
                "",
                row["gemm"].as_str().unwrap_or(""),
                row["gflops"].as_f64().unwrap_or(f64::NAN)
            );
            continue;
        };
        for what in TIMES {
            let rate = |v: &Value| v[format!("{what}_gflops")].as_f64();
            let Some(own) = rate(row) else { continue };
            let other = theirs.iter().find(|r| same(r, row)).and_then(rate);
            let ratio = other.map(|o| own / o);
            let shape = format!("{}×{}×{}²", row["batch"], row["channels"], row["size"]);
            let cell = |v: Option<f64>, digits| v.map_or("–".to_owned(), |v| format!("{v:.digits$}"));
            println!("{shape:<18} {what:<17} {name:<7} {own:>9.0} {:>12} {:>7}", cell(other, 0), cell(ratio, 2));
            rows.push(
                json!({ "shape": shape, "what": what, "of": name, "gflops": own, "peer": other, "ratio": ratio }),
            );
        }
    }
    ensure!(!rows.is_empty(), "the kernel benchmark printed no result");
    let mut result = json!({ "benchmark": "kernels" });
    for what in TIMES {
        let ratios: Vec<f64> = rows
            .iter()
            .filter(|r| r["of"] == "ours" && r["what"] == what)
            .filter_map(|r| r["ratio"].as_f64())
            .collect();
        if !ratios.is_empty() {
            let mean = (ratios.iter().map(|r| r.ln()).sum::<f64>() / ratios.len() as f64).exp();
            println!("{what}: {mean:.2} times the peer, geometric mean");
            result[format!("{what}_geometric_mean")] = json!(mean);
        }
    }
    result["rows"] = json!(rows);
    save("kernels", result, options)
}

fn save(name: &str, mut result: Value, options: &Options) -> anyhow::Result<()> {
    if !options.save {
        return Ok(());
    }
    result["cpu"] = json!(cpu());
    result["revision"] = json!(revision()?);
    let dir = results_dir()?;
    let path = dir.join(format!("{name}.json"));
    fs::write(&path, serde_json::to_string_pretty(&result)? + "\n")?;
    println!("wrote {}", path.display());
    Ok(())
}
