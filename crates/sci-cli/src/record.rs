//! Owns `record.json`, what a run reports to other programs: benchmarks, tests and the report page read it.
//!
//! Field names are fixed by [`SCHEMA`]. JSON knows neither NaN nor infinity: every number that can be missing or not
//! finite is an `Option`, and both `None` and a value that is not finite (the PSNR of equal images) become `null`.

use std::path::Path;

use online::{Relation, SplitRecord, Update, UpdateCounts};
use serde::{Deserialize, Serialize};

use crate::io::{FileError, ReadError, read_file};

/// The version of the record's layout; a change of a name or a unit raises it.
pub const SCHEMA: u32 = 1;

/// One run of an experiment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// [`SCHEMA`].
    pub schema: u32,
    /// The experiment's name, as in its file.
    pub experiment: String,
    /// The scene: the data's file name.
    pub scene: String,
    /// `gap`, `admm` or `two-stage`.
    pub solver: String,
    /// The denoiser's name; several are joined by ` → ` in the order of the stages.
    pub denoiser: String,
    /// One entry for each measurement, in the order they were solved.
    pub measurements: Vec<MeasurementRecord>,
    /// How many more were to be solved when the run was stopped; also one whose solve was stopped. 0 of a complete run.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub unsolved: usize,
    /// Means over `measurements`.
    pub mean: MeanRecord,
    /// What looked odd about the data, and what was taken for white, clipped or defective.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
    /// The process's largest resident memory in bytes; 0 where the system does not tell.
    pub peak_rss_bytes: u64,
    /// Worker threads.
    pub threads: usize,
    /// The seed of everything random.
    pub seed: u64,
    /// Version of `sci`.
    pub version: String,
    /// Source revision `sci` was built from; empty if unknown.
    pub revision: String,
    /// The processor's name.
    pub cpu: String,
    /// The instruction set that ran: that of the networks' kernels, or of the solver where there is no network.
    #[serde(default)]
    pub kernel: String,
    /// What networks multiplied: `f32`, `bf16`, `int16` where 16-bit numbers are asked for and there is no matrix unit, or `mixed`.
    #[serde(default)]
    pub precision_used: String,
    /// Wall-clock seconds of the command up to this record; of one that resumed a run, its own.
    #[serde(default)]
    pub wall_seconds: f64,
    /// The shards that it was solved in, if it was; the run's own memory, threads and seconds are then those of the largest, the
    /// processors and instruction sets those of all.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub shards: Vec<ShardRecord>,
    /// Every other file of the run, relative to the record's folder. A later run may replace and remove these and no others.
    #[serde(default)]
    pub files: Vec<String>,
    /// How the masks were found to sit, if that was looked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calibration: Option<crate::calibration::Calibration>,
    /// Of the measurements, and of the files that it read: another run with these has other results. Null in records of before.
    #[serde(default, skip_serializing_if = "serde_json::Value::is_null")]
    pub checksums: serde_json::Value,
    /// The resolved experiment: paths absolute, defaults filled in. `written` is what it was read from: `file`, its `text`,
    /// what it `extends` and the `--set`s.
    pub config: serde_json::Value,
}

#[allow(clippy::trivially_copy_pass_by_ref)] // as serde calls it
fn is_zero(count: &usize) -> bool {
    *count == 0
}

/// Where a shard of a run was solved.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ShardRecord {
    /// Its number, from 1.
    pub shard: usize,
    /// Its measurements, in the order they were solved; what one takes over from the one before the first did not.
    pub measurements: Vec<usize>,
    /// The processor's name; of a shard that was resumed elsewhere all of them.
    pub cpu: String,
    /// The instruction set, or all of them.
    pub kernel: String,
    /// Worker threads, when it was last resumed.
    pub threads: usize,
    /// As for a run.
    pub wall_seconds: f64,
    /// As for a run.
    pub peak_rss_bytes: u64,
}

impl ShardRecord {
    fn of(shard: usize, record: &Record) -> Self {
        Self {
            shard,
            measurements: record.measurements.iter().map(|m| m.index).collect(),
            cpu: record.cpu.clone(),
            kernel: record.kernel.clone(),
            threads: record.threads,
            wall_seconds: record.wall_seconds,
            peak_rss_bytes: record.peak_rss_bytes,
        }
    }

    /// The record of a run of which these are the shards, by their numbers and in their order; nothing if there are none.
    pub fn join(records: Vec<(usize, Record)>) -> Option<Record> {
        let shards: Vec<Self> = records.iter().map(|(number, record)| Self::of(*number, record)).collect();
        let all = |text: fn(&Self) -> &str| {
            let mut names: Vec<&str> = shards.iter().flat_map(|shard| text(shard).split(", ")).collect();
            names.sort_unstable();
            names.dedup();
            names.join(", ")
        };
        let (cpu, kernel) = (all(|shard| &shard.cpu), all(|shard| &shard.kernel));
        let mut records = records.into_iter().map(|(_, record)| record);
        let mut joined = records.next()?;
        for record in records {
            joined.measurements.extend(record.measurements);
            joined.threads = joined.threads.max(record.threads);
            joined.peak_rss_bytes = joined.peak_rss_bytes.max(record.peak_rss_bytes);
            joined.wall_seconds = joined.wall_seconds.max(record.wall_seconds);
            if joined.precision_used != record.precision_used {
                joined.precision_used = "mixed".into();
            }
        }
        let mean = MeanRecord::of(&joined.measurements);
        Some(Record { mean, cpu, kernel, shards, ..joined })
    }
}

/// How one measurement went.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MeasurementRecord {
    /// Index of the measurement in its file.
    pub index: usize,
    /// Mean PSNR over the frames in dB, data range 1, on the mosaic for color; `None` without a ground truth.
    pub psnr_db: Option<f64>,
    /// Mean SSIM over the frames, 7×7 uniform window (scikit-image's default).
    pub ssim: Option<f64>,
    /// Mean SSIM over the frames, 11×11 Gaussian window.
    pub ssim_gaussian: Option<f64>,
    /// Mean PSNR of the RGB frames in dB; `None` for gray scenes.
    pub psnr_rgb_db: Option<f64>,
    /// PSNR in dB that pixels which the solve was not given predict, with `[skip]` or `judge`, for errors that do not depend on each other.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub predicted_psnr_db: Option<f64>,
    /// In how many bands of rows it was solved, if in several: their trace is that of the band in the middle, and seconds are the sum.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bands: Option<usize>,
    /// Wall-clock seconds of the solve with its warm start, without reading, writing and metrics.
    pub seconds: f64,
    /// Iterations done.
    pub iterations: usize,
    /// Why the solve ended.
    pub stop: Stop,
    /// The divergence that it went on after; only where there was one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub backed_off: Option<BackedOff>,
    /// ‖y − H x‖ / ‖y‖ of the result.
    pub relative_residual: Option<f64>,
    /// Online updates of the denoiser that were kept.
    pub updates: usize,
    /// Calls of the denoiser.
    pub denoiser_calls: usize,
    /// Multiply-adds of the networks' calls in units of 1e9, without those of online updates; `None` where no network ran.
    #[serde(default)]
    pub gmac: Option<f64>,
    /// Work that was left out.
    pub skipped: Skipped,
    /// How the denoiser adapted; only where it was to.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub online: Option<Adaptation>,
    /// What happened, iteration by iteration.
    pub trace: Trace,
}

/// A divergence that the solver went on after, from its best iterate.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct BackedOff {
    /// The iteration that diverged, counted from 0; it has no entry in the trace.
    pub iteration: usize,
    /// What the solver did without from then on.
    pub without: String,
}

impl From<admm::BackOff> for BackedOff {
    fn from(b: admm::BackOff) -> Self {
        Self { iteration: b.iteration, without: b.without.to_owned() }
    }
}

/// How the denoiser adapted to a measurement.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Adaptation {
    /// How well the result before explains this measurement; nothing for the first, and without carry-over.
    pub relation: Option<Relation>,
    /// Whether it was solved from the result before.
    pub warm_start: bool,
    /// Whether the scene was cut before it.
    pub cut: bool,
    /// How many updates of which kind.
    pub counts: UpdateCounts,
    /// Every update that was due, in order; those of the first network first.
    pub updates: Vec<Update>,
    /// How many of them are of which network.
    #[serde(default)]
    pub updates_of: Vec<usize>,
    /// What was learned before the solve, by measurement splitting.
    #[serde(default)]
    pub split: Option<SplitRecord>,
}

/// Why a solve ended; the same reasons as [`admm::StopReason`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stop {
    /// Every stage was run.
    #[default]
    ScheduleDone,
    /// The relative change fell to the tolerance.
    Converged,
    /// The held-out pixels gained nothing any more; the result is the best iterate.
    Stalled,
    /// A value was not finite or the residual exploded; the result is the estimate before.
    Diverged,
    /// The time limit passed.
    TimeUp,
    /// Interrupted from outside.
    Observer,
}

impl From<admm::StopReason> for Stop {
    fn from(reason: admm::StopReason) -> Self {
        match reason {
            admm::StopReason::ScheduleDone => Self::ScheduleDone,
            admm::StopReason::Converged => Self::Converged,
            admm::StopReason::Stalled => Self::Stalled,
            admm::StopReason::Diverged => Self::Diverged,
            admm::StopReason::TimeUp => Self::TimeUp,
            admm::StopReason::Observer => Self::Observer,
        }
    }
}

/// Work left out because it would not have changed the result.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Skipped {
    /// Iterations of the schedule that were not run.
    pub iterations: usize,
    /// The share of tiles the denoiser left alone, 0 to 1.
    pub tiles: f64,
    /// The share of what networks did that was in 16-bit numbers instead of f32, 0 to 1; left out of the file where it is 0.
    #[serde(default, skip_serializing_if = "is_none")]
    pub precision: f64,
    /// Online updates that were due and not made.
    pub updates: usize,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde asks for a reference")]
fn is_none(share: &f64) -> bool {
    *share == 0.0
}

/// Series with one value for each iteration; empty where a quantity was not followed.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Trace {
    /// Mean PSNR of the estimate in dB, computed outside the timed part.
    pub psnr_db: Vec<Option<f64>>,
    /// ‖y − H x‖ / ‖y‖.
    pub relative_residual: Vec<Option<f64>>,
    /// ‖x_k − x_{k−1}‖ / ‖x_k‖.
    pub relative_change: Vec<Option<f64>>,
    /// Seconds since the solve began.
    pub seconds: Vec<f64>,
    /// σ of the iteration, in units of a frame's full scale.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub sigma: Vec<f32>,
    /// The mean square error that held-out pixels predict; empty without `[skip]`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub predicted_error: Vec<Option<f64>>,
}

/// Means over the measurements of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MeanRecord {
    /// Mean of the measurements' PSNR in dB; `None` if any has none.
    pub psnr_db: Option<f64>,
    /// Mean of the measurements' SSIM (7×7 uniform); `None` if any has none.
    pub ssim: Option<f64>,
    /// Mean seconds of a measurement.
    pub seconds: f64,
    /// Mean iterations of a measurement.
    pub iterations: f64,
}

impl MeanRecord {
    /// Averages `measurements`; zeros and `None` if there are none.
    pub fn of(measurements: &[MeasurementRecord]) -> Self {
        let count = measurements.len();
        if count == 0 {
            return Self::default();
        }
        let mean = |value: &dyn Fn(&MeasurementRecord) -> Option<f64>| {
            measurements.iter().map(value).sum::<Option<f64>>().map(|sum| sum / count as f64)
        };
        Self {
            psnr_db: mean(&|m| m.psnr_db),
            ssim: mean(&|m| m.ssim),
            seconds: mean(&|m| Some(m.seconds)).unwrap_or_default(),
            iterations: mean(&|m| Some(m.iterations as f64)).unwrap_or_default(),
        }
    }
}

impl Record {
    /// Reads a `record.json`.
    ///
    /// # Errors
    /// [`FileError`] if it cannot be read, is not such a record, or has another [`SCHEMA`].
    pub fn read(path: &Path) -> Result<Self, FileError> {
        Self::parse(path, &read_file(path)?)
    }

    /// Reads the bytes of a `record.json`; `path` is for messages.
    ///
    /// # Errors
    /// [`FileError`] if it is not such a record, or has another [`SCHEMA`].
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self, FileError> {
        let malformed = |reason| FileError::new(path, ReadError::Malformed { format: "record.json", reason });
        let record: Self = serde_json::from_slice(bytes).map_err(|e| malformed(e.to_string()))?;
        if record.schema != SCHEMA {
            return Err(malformed(format!("schema {}, this version reads {SCHEMA}", record.schema)));
        }
        Ok(record)
    }

    /// The record as indented JSON, with a final newline.
    ///
    /// # Panics
    /// Never: every field has a JSON form.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("a record has only string keys and plain values") + "\n"
    }
}

/// The machine and the build, as a record names them.
pub mod host {
    use std::fs;

    use nets::kernels::Isa;
    use sysinfo::{CpuRefreshKind, System};

    /// Version of `sci`.
    pub const VERSION: &str = env!("CARGO_PKG_VERSION");

    /// Source revision of the build; empty outside a Git checkout.
    pub const REVISION: &str = env!("SCI_REVISION");

    /// The processor's name, or its architecture where the system does not tell.
    pub fn cpu() -> String {
        let mut system = System::new();
        system.refresh_cpu_list(CpuRefreshKind::nothing());
        let name = system.cpus().first().map(|cpu| cpu.brand().trim().to_owned());
        name.filter(|name| !name.is_empty()).unwrap_or_else(|| std::env::consts::ARCH.to_owned())
    }

    /// The instruction set of the solvers, which choose by themselves; the matrix unit is not for them.
    pub fn solver_kernel() -> Isa {
        let own = Isa::ALL.into_iter().filter(|isa| *isa != Isa::Amx).find(|isa| isa.available());
        own.unwrap_or(Isa::Portable)
    }

    /// The largest resident memory of this process so far in bytes; 0 where the system does not tell.
    pub fn peak_rss_bytes() -> u64 {
        fs::read_to_string("/proc/self/status")
            .ok()
            .and_then(|status| field(&status, "VmHWM")?.split_whitespace().next()?.parse::<u64>().ok())
            .map_or(0, |kib| kib * 1024)
    }

    /// The value of the first `name: value` line.
    fn field<'a>(text: &'a str, name: &str) -> Option<&'a str> {
        text.lines().find_map(|line| line.strip_prefix(name)?.trim_start().strip_prefix(':').map(str::trim))
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// The example of the format's description, with every name a reader may rely on.
    pub(crate) const EXAMPLE: &str = include_str!("../../../tests/fixtures/record.json");

    #[test]
    fn names_are_those_of_the_format() {
        let expected: serde_json::Value = serde_json::from_str(EXAMPLE).unwrap();
        let record: Record = serde_json::from_str(EXAMPLE).unwrap();
        let written: serde_json::Value = serde_json::from_str(&record.to_json()).unwrap();
        assert_eq!(written, expected);
    }

    #[test]
    fn numbers_that_are_not_finite_become_null() {
        let mut record: Record = serde_json::from_str(EXAMPLE).unwrap();
        record.measurements[0].psnr_db = Some(f64::INFINITY);
        record.measurements[0].ssim = Some(f64::NAN);
        record.measurements[0].trace.psnr_db = vec![Some(20.0), Some(f64::INFINITY)];
        let back: Record = serde_json::from_str(&record.to_json()).unwrap();
        assert_eq!((back.measurements[0].psnr_db, back.measurements[0].ssim), (None, None));
        assert_eq!(back.measurements[0].trace.psnr_db, [Some(20.0), None]);
    }

    #[test]
    fn means_are_missing_where_a_value_is() {
        let record: Record = serde_json::from_str(EXAMPLE).unwrap();
        let first = record.measurements[0].clone();
        let second = MeasurementRecord { psnr_db: Some(30.76), ssim: None, iterations: 21, ..first.clone() };
        let mean = MeanRecord::of(&[first, second]);
        assert_eq!((mean.psnr_db, mean.ssim, mean.iterations), (Some(25.76), None, 30.5));
        assert_eq!(MeanRecord::of(&[]), MeanRecord::default());
    }

    #[test]
    fn shards_are_one_run_that_says_where_each_was_solved() {
        let whole: Record = serde_json::from_str(EXAMPLE).unwrap();
        let part = |index: usize, kernel: &str, threads: usize, seconds: f64| {
            let mut part = Record { kernel: kernel.into(), threads, wall_seconds: seconds, ..whole.clone() };
            part.measurements.truncate(1);
            part.measurements[0].index = index;
            part
        };
        let records = vec![(1, part(4, "avx2", 8, 3.0)), (2, part(6, "avx512, avx2", 2, 5.0))];
        let joined = ShardRecord::join(records).unwrap();
        assert_eq!(joined.measurements.iter().map(|m| m.index).collect::<Vec<_>>(), [4, 6]);
        assert_eq!((joined.kernel.as_str(), joined.threads, joined.wall_seconds), ("avx2, avx512", 8, 5.0));
        assert_eq!(joined.mean, MeanRecord::of(&joined.measurements));
        let second = &joined.shards[1];
        assert_eq!((second.shard, second.measurements.as_slice(), second.threads), (2, &[6][..], 2));
        assert!(ShardRecord::join(Vec::new()).is_none());
    }

    #[test]
    fn another_schema_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("record.json");
        std::fs::write(&path, EXAMPLE.replacen("\"schema\": 1", "\"schema\": 7", 1)).unwrap();
        let error = Record::read(&path).unwrap_err().to_string();
        assert!(error.contains("record.json") && error.contains("schema 7"), "{error}");
    }

    #[test]
    fn this_process_has_a_size_and_a_processor() {
        assert!(!host::cpu().is_empty());
        assert!(!cfg!(target_os = "linux") || host::peak_rss_bytes() > 1 << 20);
    }
}
