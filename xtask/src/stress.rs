//! `cargo xtask stress`: every solver on what no one should feed it, in process and through the built `sci`; and the fuzzer.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::ensure;
use serde_json::Value;

use crate::plot::{Axis, Look, Plot, Series, SeriesLabelPosition};
use crate::workspace::{Finished, Sci, cargo, json_lines, output, results_dir, shared};

#[derive(clap::Args)]
pub(crate) struct Options {
    /// Folder with weights/, for the networks [default: $SCI_DATA, else ../shared beside the repository]
    #[arg(long, value_name = "DIR")]
    shared: Option<PathBuf>,
    /// Keep table and plot as xtask/results/CPU/stress.md and drift.svg
    #[arg(long)]
    save: bool,
}

/// The tables that the solvers' stress tests print.
const GROUPS: [&str; 7] = ["masks", "size", "measurement", "unmeasured", "parameter", "run", "scale"];

/// Runs every case, prints the table, fails if there is a fault in it.
pub(crate) fn run(options: &Options) -> anyhow::Result<()> {
    let mut tests = cargo();
    tests.args(["test", "--release", "-q", "-p", "admm", "--lib", "--test", "stress", "--", "--nocapture"]);
    let lines: Vec<Value> = json_lines(&output(&mut tests)?).collect();
    let of = |key: &str| lines.iter().filter(|line| !line[key].is_null()).collect::<Vec<_>>();
    let (table, drift) = (of("case"), of("drift"));
    for group in GROUPS {
        ensure!(
            table.iter().any(|row| row["group"] == group),
            "the stress tests printed nothing of the group {group:?}"
        );
    }
    ensure!(!drift.is_empty(), "the tests printed no drift");
    let mut text = in_process(&table);
    let (program, faults) = through_sci(options)?;
    text += &program;
    print!("{text}");
    if options.save {
        let dir = results_dir()?;
        fs::write(dir.join("stress.md"), &text)?;
        fs::write(dir.join("drift.svg"), drift_plot(&drift)?)?;
        println!("wrote {}", dir.display());
    }
    ensure!(faults.is_empty(), "{}", faults.join("\n"));
    Ok(())
}

#[derive(clap::Args)]
pub(crate) struct Fuzz {
    /// Damaged inputs for each format
    #[arg(long, default_value_t = 125_000, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
}

/// Damaged inputs for the readers and the experiment files.
pub(crate) fn fuzz(options: &Fuzz) -> anyhow::Result<()> {
    let mut test = cargo();
    test.args(["test", "--release", "-p", "sci-cli", "--test", "hostile", "--", "--nocapture"])
        .env("SCI_FUZZ_ROUNDS", options.rounds.to_string());
    print!("{}", output(&mut test)?);
    Ok(())
}

fn in_process(table: &[&Value]) -> String {
    let text = |row: &Value, key: &str| row[key].as_str().unwrap_or_default().to_owned();
    let mut solvers: Vec<String> = Vec::new();
    for row in table {
        let solver = text(row, "solver");
        if !solvers.contains(&solver) {
            solvers.push(solver);
        }
    }
    let mut out =
        String::from("# Cases × solvers\n\nPSNR of the result and its relative residual, or how the run ended.\n");
    let groups: BTreeSet<String> = table.iter().map(|r| text(r, "group")).collect();
    for group in groups {
        let rows: Vec<&&Value> = table.iter().filter(|r| text(r, "group") == group).collect();
        let used: Vec<&String> = solvers.iter().filter(|s| rows.iter().any(|r| text(r, "solver") == **s)).collect();
        out += &format!("\n| {group} |");
        used.iter().for_each(|s| out += &format!(" {s} |"));
        out += "\n|---|";
        used.iter().for_each(|_| out += "---|");
        let mut cases: Vec<String> = rows.iter().map(|r| text(r, "case")).collect();
        cases.dedup();
        for case in cases {
            out += &format!("\n| {case} |");
            for solver in &used {
                let cell = rows.iter().find(|r| text(r, "case") == case && text(r, "solver") == **solver);
                let cell = cell.map_or(String::new(), |r| text(r, "outcome"));
                out += &format!(" {} |", cell.chars().take(90).collect::<String>());
            }
        }
        out += "\n";
    }
    out
}

fn drift_plot(lines: &[&Value]) -> anyhow::Result<String> {
    let points = lines.iter().filter_map(|l| Some((l["drift"].as_f64()?, l["rms"].as_f64()?))).collect();
    Plot {
        caption: "GAP-TV in f32 against f64, root mean square difference (white = 1)".into(),
        x: Axis { label: "iteration", log: false },
        y: Axis { label: "difference", log: true },
        series: vec![Series { name: "accelerated GAP-TV".into(), points, look: Look::Front }],
        shades: 1,
        legend: SeriesLabelPosition::LowerRight,
    }
    .svg()
}

/// A scene for `sci`, written as a folder of .npy files.
struct Scene {
    frames: usize,
    height: usize,
    width: usize,
    mask: Vec<f32>,
    meas: Vec<f32>,
    orig: Vec<f32>,
}

impl Scene {
    /// A bright square moves over a ramp, behind masks of half open pixels; two measurements.
    fn new(frames: usize, height: usize, width: usize) -> Self {
        let mut state = 0x9e37_79b9_7f4a_7c15u64;
        let mut coin = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 63) as f32
        };
        let plane = height * width;
        let mut mask: Vec<f32> = (0..frames * plane).map(|_| coin()).collect();
        // Where no mask is open, the first is.
        (0..plane)
            .filter(|p| (0..frames).all(|t| mask[t * plane + p] == 0.0))
            .collect::<Vec<_>>()
            .iter()
            .for_each(|p| mask[*p] = 1.0);
        let value = |t: usize, p: usize| {
            let (i, j) = (p / width, p % width);
            let inside = (i + 600 - t) % 60 > 10
                && (i + 600 - t) % 60 < 20
                && (j + 600 - t) % 60 > 10
                && (j + 600 - t) % 60 < 20;
            if inside { 0.9 } else { 0.2 + 0.4 * (i + j) as f32 / (height + width) as f32 }
        };
        let orig: Vec<f32> =
            (0..2 * frames).flat_map(|t| (0..plane).map(move |p| (t, p))).map(|(t, p)| value(t, p)).collect();
        let measure =
            |k: usize, p: usize| (0..frames).map(|t| mask[t * plane + p] * orig[(k * frames + t) * plane + p]).sum();
        let meas = (0..2).flat_map(|k| (0..plane).map(move |p| (k, p))).map(|(k, p)| measure(k, p)).collect();
        Self { frames, height, width, mask, meas, orig }
    }

    /// Sets twelve pixels of both measurements.
    fn defects(mut self, value: f32) -> Self {
        let (height, width) = (self.height, self.width);
        for k in 0..12 {
            let at = (7 * k + 3) % height * width + (11 * k + 5) % width;
            self.meas[at] = value;
            self.meas[height * width + at] = value;
        }
        self
    }

    fn scaled(mut self, scale: f32) -> Self {
        self.meas.iter_mut().chain(&mut self.orig).for_each(|v| *v *= scale);
        self
    }

    fn write(&self, dir: &Path) -> anyhow::Result<()> {
        fs::create_dir_all(dir)?;
        for (name, values, planes) in
            [("mask", &self.mask, self.frames), ("meas", &self.meas, 2), ("orig", &self.orig, 2 * self.frames)]
        {
            fs::write(dir.join(format!("{name}.npy")), npy([planes, self.height, self.width], values))?;
        }
        Ok(())
    }
}

/// An array of `f32` in NumPy's format, version 1.
fn npy(shape: [usize; 3], values: &[f32]) -> Vec<u8> {
    let [t, h, w] = shape;
    let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({t}, {h}, {w}), }}");
    let length = (10 + header.len() + 1).next_multiple_of(64) - 10;
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((length as u16).to_le_bytes());
    bytes.extend(format!("{header:<width$}\n", width = length - 1).into_bytes());
    bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    bytes
}

/// The values behind a .npy file's header.
fn values_of(npy: &[u8]) -> impl Iterator<Item = f32> {
    let header = npy.get(8..10).map_or(0, |b| 10 + usize::from(u16::from_le_bytes([b[0], b[1]])));
    npy.get(header..).unwrap_or_default().as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b))
}

const GAP_TV: &str = "[solver]\nkind = 'gap'\n[denoiser]\nkind = 'tv'\nweight = 0.1\n[[stage]]\niterations = 40\n";
const ADMM_TV: &str = "[solver]\nkind = 'admm'\n[denoiser]\nkind = 'tv'\nweight = 0.1\n[[stage]]\niterations = 40\n";
const TWO_STAGE: &str =
    "[solver]\nkind = 'two-stage'\n[denoiser]\nkind = 'tv'\nweight = 0.1\n[[stage]]\niterations = 40\n";
const FFDNET: &str = "[solver]\nkind = 'gap'\n[denoiser]\nkind = 'ffdnet'\nweights = 'ffdnet_gray.pth'\n[[stage]]\nsigma = 25\niterations = 8\n";

/// How a case must end.
#[derive(Clone, Copy, Debug)]
enum Ends {
    /// With a result of at least so many dB.
    Result(f64),
    /// With an error that says this.
    Refused(&'static str),
    /// By saying that it diverged, and with the last good estimate.
    Diverged,
}

/// A case that goes through the program: its name, the scene, the experiment without its data, `--set` arguments, how it ends.
type Case = (&'static str, Scene, &'static str, &'static [&'static str], Ends);

fn cases() -> Vec<Case> {
    let small = || Scene::new(8, 48, 40);
    vec![
        ("nothing unusual", small(), GAP_TV, &[], Ends::Result(26.0)),
        (
            "12 NaN pixels",
            small().defects(f32::NAN),
            GAP_TV,
            &[],
            Ends::Refused("`meas` is NaN at frame 0, row 3, column 5"),
        ),
        ("12 NaN pixels, excluded", small().defects(f32::NAN), GAP_TV, &["data.defects=exclude"], Ends::Result(26.0)),
        ("12 dead pixels", small().defects(0.0), GAP_TV, &[], Ends::Result(25.0)),
        ("12 dead pixels, excluded", small().defects(0.0), GAP_TV, &["data.defects=exclude"], Ends::Result(26.0)),
        ("12 hot pixels", small().defects(8.0), GAP_TV, &[], Ends::Result(18.0)),
        ("12 hot pixels, excluded", small().defects(8.0), GAP_TV, &["data.defects=exclude"], Ends::Result(26.0)),
        ("y × 1e-8", small().scaled(1e-8), GAP_TV, &[], Ends::Result(25.0)),
        ("y × 1e-4", small().scaled(1e-4), GAP_TV, &[], Ends::Result(25.0)),
        ("y × 1e4", small().scaled(1e4), GAP_TV, &[], Ends::Result(25.0)),
        ("y × 1e8", small().scaled(1e8), GAP_TV, &[], Ends::Result(25.0)),
        ("y × 1e8, two-stage", small().scaled(1e8), TWO_STAGE, &["data.cfa=rggb"], Ends::Result(22.0)),
        (
            "masks all 0",
            Scene { mask: vec![0.0; 8 * 48 * 40], ..small() },
            GAP_TV,
            &[],
            Ends::Refused("every mask is zero"),
        ),
        ("B = 1", Scene::new(1, 48, 40), GAP_TV, &[], Ends::Result(70.0)),
        ("B = 64", Scene::new(64, 48, 40), GAP_TV, &[], Ends::Result(23.0)),
        ("2×2", Scene::new(8, 2, 2), GAP_TV, &[], Ends::Result(15.0)),
        ("1×4096", Scene::new(8, 1, 4096), GAP_TV, &[], Ends::Result(90.0)),
        ("2,000 iterations", small(), GAP_TV, &["stage.0.iterations=2000"], Ends::Result(26.0)),
        ("2,000 iterations, ADMM", small(), ADMM_TV, &["stage.0.iterations=2000"], Ends::Result(26.0)),
        (
            "2,000 iterations, two-stage",
            small(),
            TWO_STAGE,
            &["data.cfa=rggb", "stage.0.iterations=2000"],
            Ends::Diverged,
        ),
        (
            "TV weight 1e-8",
            small(),
            GAP_TV,
            &["denoiser.weight=1e-8"],
            Ends::Refused("`denoiser.weight` = 1e-8 is not legal"),
        ),
        (
            "TV weight 1e8",
            small(),
            GAP_TV,
            &["denoiser.weight=1e8"],
            Ends::Refused("`denoiser.weight` = 1e8 is not legal"),
        ),
        ("γ 1e8", small(), ADMM_TV, &["solver.gamma=1e8"], Ends::Refused("`solver.gamma` = 1e8 is not legal")),
        ("ρ 1e-6", small(), TWO_STAGE, &["data.cfa=rggb", "solver.rho=1e-6"], Ends::Diverged),
        ("τ 1e6", small(), TWO_STAGE, &["data.cfa=rggb", "solver.tau=1e6"], Ends::Result(24.0)),
        ("FFDNet", small(), FFDNET, &[], Ends::Result(26.0)),
        (
            "FFDNet from the adjoint",
            small(),
            FFDNET,
            &["solver.start=adjoint", "stage.0.iterations=40"],
            Ends::Result(26.0),
        ),
        ("FFDNet, σ = 0", small(), FFDNET, &["stage.0.sigma=0"], Ends::Result(21.0)),
        ("FFDNet, σ = 255", small(), FFDNET, &["stage.0.sigma=255"], Ends::Result(18.0)),
        ("FFDNet, y × 1e8", small().scaled(1e8), FFDNET, &[], Ends::Result(23.0)),
        ("FFDNet, 2×2", Scene::new(8, 2, 2), FFDNET, &[], Ends::Result(21.0)),
        ("FFDNet, 1×4096", Scene::new(8, 1, 4096), FFDNET, &[], Ends::Result(21.0)),
        ("FFDNet, 12 hot pixels", small().defects(8.0), FFDNET, &[], Ends::Result(16.0)),
        ("FFDNet, 500 iterations", Scene::new(8, 24, 20), FFDNET, &["stage.0.iterations=500"], Ends::Result(39.0)),
    ]
}

/// The table of the cases through the program, and its faults.
fn through_sci(options: &Options) -> anyhow::Result<(String, Vec<String>)> {
    let sci = Sci::build(options.shared.as_deref())?;
    let has_weights = shared(options.shared.as_deref()).is_ok_and(|s| s.join("weights/ffdnet_gray.pth").is_file());
    let dir = tempfile::tempdir()?;
    let dir = dir.path();
    let mut text = String::from("\n| through `sci run` | exit code | outcome |\n|---|---|---|\n");
    let mut faults = Vec::new();
    for (name, scene, experiment, sets, ends) in cases() {
        if experiment == FFDNET && !has_weights {
            text += &format!("| {name} | – | no data: weights/ffdnet_gray.pth |\n");
            continue;
        }
        let sets: Vec<String> = sets.iter().map(|s| (*s).to_owned()).collect();
        scene.write(&dir.join("scene"))?;
        let config = dir.join("stress.toml");
        fs::write(&config, format!("[data]\npath = 'scene'\n{experiment}"))?;
        let finished = sci.run(&config, &sets)?;
        let recon = fs::read(finished.folder.join("recon.npy")).unwrap_or_default();
        match outcome(&finished, &recon, ends) {
            Ok(outcome) => text += &format!("| {name} | {} | {outcome} |\n", finished.code.unwrap_or(-1)),
            Err(fault) => {
                text += &format!("| {name} | {:?} | FAULT: {fault} |\n", finished.code);
                faults.push(format!("{name}: {fault}"));
            }
        }
    }
    Ok((text, faults))
}

/// What a run came to, or the rule that it broke.
fn outcome(finished: &Finished, recon: &[u8], ends: Ends) -> Result<String, String> {
    let says = |what: &str| finished.stderr.lines().find(|l| l.contains(what)).map(str::to_owned);
    if let Some(line) = says("panicked") {
        return Err(line);
    }
    if let Some(v) = values_of(recon).find(|v| !v.is_finite()) {
        return Err(format!("{v} in recon.npy"));
    }
    let otherwise = || Err(format!("exit code {:?}, expected {ends:?}: {}", finished.code, finished.stderr));
    match (ends, finished.code, &finished.record) {
        (Ends::Result(least), Some(0), Some(record)) => {
            // The PSNR of a result that equals the truth is infinite, which JSON cannot say.
            let psnr = record["mean"]["psnr_db"].as_f64().unwrap_or(f64::INFINITY);
            if psnr < least {
                return Err(format!("{psnr:.1} dB, expected {least}"));
            }
            let warning = says("warning: ").map(|w| w.rsplit("scene: ").next().unwrap_or_default().to_owned());
            Ok(format!("{psnr:.1} dB{}", warning.map_or(String::new(), |w| format!("; {w}"))))
        }
        (Ends::Diverged, Some(1), Some(_)) => says(" diverged in ").map_or_else(otherwise, Ok),
        (Ends::Refused(why), Some(1 | 2), None) => says(why)
            .map_or_else(otherwise, |line| Ok(line.rsplit('/').next().unwrap_or_default().chars().take(160).collect())),
        _ => otherwise(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    /// A run that ended like this, with one sample in its result.
    fn ended(code: i32, psnr_db: Option<f64>, stderr: &str, sample: f32, ends: Ends) -> Result<String, String> {
        let record = psnr_db.map(|psnr_db| json!({ "mean": { "psnr_db": psnr_db } }));
        let finished = Finished { code: Some(code), stderr: stderr.into(), record, folder: PathBuf::new() };
        outcome(&finished, &npy([1, 1, 1], &[sample]), ends)
    }

    #[test]
    fn a_result_below_its_floor_is_a_fault_and_so_is_any_other_end() {
        let floor = Ends::Result(26.0);
        assert!(ended(0, Some(26.1), "", 0.5, floor).is_ok());
        let refused = Ends::Refused("not legal");
        for (code, psnr_db, stderr, sample, ends, said) in [
            (0, Some(25.9), "", 0.5, floor, "25.9 dB, expected 26"),
            (0, Some(30.0), "", f32::NAN, floor, "NaN in recon.npy"),
            (0, None, "", 0.5, floor, "exit code"),
            (1, Some(30.0), "", 0.5, floor, "exit code"),
            (101, None, "thread panicked at", 0.5, refused, "panicked"),
            (2, None, "something else", 0.5, refused, "something else"),
            (0, Some(30.0), "", 0.5, Ends::Diverged, "exit code"),
        ] {
            let fault = ended(code, psnr_db, stderr, sample, ends).unwrap_err();
            assert!(fault.contains(said), "{fault}");
        }
        assert!(ended(2, None, "x.toml: `a` is not legal", 0.5, refused).is_ok());
        assert!(ended(1, Some(9.0), "it diverged in iteration 3", 0.5, Ends::Diverged).is_ok());
    }
}
