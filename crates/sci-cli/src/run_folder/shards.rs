//! Owns the shards of a run in its folder: what each says of itself, what is missing of them, and how they become one run.
//!
//! A shard works in a folder of its own inside the run's staging folder and writes nowhere else, so that shards need to know
//! nothing of each other, on whatever machines they are. It is a stopped run in itself, and stays one until it is joined.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Finished, Layout, RunPlan, Wish};
use super::{RUN, Refusal, RunFolder, STAGING, compare, differences_in_short, fail, locked};
use crate::io::output::{WriteError, write_atomically};
use crate::record::{Record, ShardRecord};
use crate::shard::Shard;

/// The file in which a shard says what it is.
pub(super) const ABOUT: &str = "shard.cbor";

/// What a shard says of itself besides its measurements, in a format that keeps every bit of a number.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct About {
    /// What the results are like.
    pub layout: Layout,
    /// Whether a measurement takes something over from the one before.
    pub reuses: bool,
    /// How it was called, without what makes it this shard of the run.
    pub command: Command,
    /// The processors that worked on it, each once.
    pub cpus: Vec<String>,
    /// Their instruction sets, each once.
    pub kernels: Vec<String>,
    /// Once all is solved, its part of the run's record.
    pub record: Option<Record>,
}

/// A command as it was given.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Command {
    /// The current folder.
    pub folder: String,
    /// Program and arguments.
    pub words: Vec<String>,
}

impl Command {
    /// The line that makes `shard`, from the current folder `here`.
    fn line(&self, shard: Shard, here: &str) -> String {
        let words: Vec<String> = self.words.iter().map(|word| quoted(word)).collect();
        let go = if self.folder == here { String::new() } else { format!("cd {} && ", quoted(&self.folder)) };
        format!("{go}{} --shard {shard}", words.join(" "))
    }
}

/// As a shell reads it back.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_alphanumeric() || "_-./=:,@%+".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', r"'\''"))
    }
}

/// The name of a shard's folder.
pub(super) fn folder_name(shard: Shard) -> String {
    format!("shard-{}-of-{}", shard.number(), shard.count())
}

/// The shards that have begun, or were about to, with their folders, in order.
pub(super) fn folders(staging: &Path) -> Vec<(Shard, PathBuf)> {
    let shard = |path: &Path| {
        let (number, count) = path.file_name()?.to_str()?.strip_prefix("shard-")?.split_once("-of-")?;
        Shard::new(number.parse().ok()?, count.parse().ok()?)
    };
    let entries = fs::read_dir(staging).into_iter().flatten().flatten();
    let mut found: Vec<_> = entries.filter_map(|e| Some((shard(&e.path())?, e.path()))).collect();
    found.sort();
    found
}

/// What a run in a shard's folder, or in the staging folder itself, is; nothing where none has begun.
pub(super) fn identity(folder: &Path) -> Option<Value> {
    serde_json::from_str(&fs::read_to_string(folder.join(RUN)).ok()?).ok()
}

pub(super) fn read_about(folder: &Path) -> Option<About> {
    ciborium::from_reader(fs::read(folder.join(ABOUT)).ok()?.as_slice()).ok()
}

pub(super) fn write_about(folder: &Path, about: &About) -> Result<(), WriteError> {
    let mut bytes = Vec::new();
    let path = folder.join(ABOUT);
    ciborium::into_writer(about, &mut bytes).map_err(|e| WriteError::new(&path, e.to_string()))?;
    write_atomically(&path, |w| std::io::Write::write_all(w, &bytes))
}

/// What says that a run was cut into different numbers of shards.
fn refuse_counts(dir: &Path, a: Shard, b: Shard) -> Refusal {
    let staging = dir.join(STAGING);
    Refusal(format!(
        "{}: shards of a run in {} and of one in {} cannot be joined; go on with one of them, and remove the folders of the \
         other, {}",
        dir.display(),
        a.count(),
        b.count(),
        staging.join(format!("shard-*-of-{}", b.count())).display()
    ))
}

fn refuse_difference(dir: &Path, there: Shard, here: Shard, differences: &[String]) -> Refusal {
    Refusal(format!(
        "{}: shard {here} is of another run than shard {there}: {}",
        dir.display(),
        differences_in_short(differences)
    ))
}

impl RunFolder {
    /// Refuses a run that is not in shards where there are shards, unless it is to replace them.
    pub(super) fn refuse_shards(&self, wish: Wish) -> anyhow::Result<()> {
        let there = folders(&self.staging);
        let Some((first, _)) = there.first() else { return Ok(()) };
        if wish != Wish::Restart {
            return Err(Refusal(format!(
                "--out {dir}: a run in {} shards is unfinished there; go on with --shard, join its shards by `sci gather {dir}`, \
                 or add --restart to throw it away",
                first.count(),
                dir = self.dir.display()
            ))
            .into());
        }
        for (shard, folder) in there {
            let busy = || Refusal(format!("--out {}: shard {shard} is at work there", self.dir.display()));
            let _lock = locked(&folder)?.ok_or_else(busy)?;
            super::remove(&folder).map_err(fail(&folder))?;
        }
        Ok(())
    }

    /// Refuses a shard beside what it cannot be joined with.
    pub(super) fn refuse_beside(&self, shard: Shard, plan: &RunPlan, wish: Wish) -> anyhow::Result<()> {
        let staging = self.dir.join(STAGING);
        if staging.join(RUN).exists() {
            return Err(Refusal(format!(
                "--out {}: a run without --shard is unfinished there; end it with --resume, or name another folder",
                self.dir.display()
            ))
            .into());
        }
        let others = folders(&staging).into_iter().filter_map(|(other, path)| Some((other, identity(&path)?)));
        for (other, there) in others.filter(|(other, _)| *other != shard) {
            if other.count() != shard.count() {
                return Err(refuse_counts(&self.dir, shard, other).into());
            }
            let differences = compare(&there, &plan.identity);
            // Those that are to be restarted too differ until they are.
            if wish != Wish::Restart && !differences.is_empty() {
                return Err(refuse_difference(&self.dir, other, shard, &differences).into());
            }
        }
        Ok(())
    }

    /// Says what the shard is, with what is known of it from before.
    pub(super) fn introduce(&self, shard: Shard, mut about: About, before: Option<About>) -> Result<(), WriteError> {
        if let Some(before) = before {
            if before.kernels != about.kernels {
                eprintln!(
                    "warning: shard {shard} began with the kernel {} and goes on with {}: the last bits of its results differ",
                    before.kernels.join(", "),
                    about.kernels.join(", ")
                );
            }
            about.cpus = distinct([before.cpus, about.cpus].concat());
            about.kernels = distinct([before.kernels, about.kernels].concat());
        }
        write_about(&self.staging, &about)
    }

    /// Ends a shard of which everything is solved: `record` is its part of the run's. It stays until all are joined.
    ///
    /// # Errors
    /// The file system's.
    pub fn end_shard(self, record: Record) -> anyhow::Result<()> {
        let about = read_about(&self.staging);
        let about =
            about.ok_or_else(|| anyhow::anyhow!("{} cannot be read back", self.staging.join(ABOUT).display()))?;
        let (cpu, kernel) = (about.cpus.join(", "), about.kernels.join(", "));
        Ok(write_about(&self.staging, &About { record: Some(Record { cpu, kernel, ..record }), ..about })?)
    }
}

fn distinct(names: Vec<String>) -> Vec<String> {
    let mut seen = BTreeSet::new();
    names.into_iter().filter(|name| seen.insert(name.clone())).collect()
}

/// A shard that has begun.
#[derive(Debug)]
struct Part {
    shard: Shard,
    identity: Value,
    about: About,
    finished: Vec<Finished>,
    /// Nothing while the shard is at work.
    lock: Option<File>,
}

impl Part {
    /// Nothing if it ended before it had begun.
    fn read(shard: Shard, folder: &Path) -> anyhow::Result<Option<Self>> {
        let lock = locked(folder)?;
        let Some((identity, about)) = identity(folder).zip(read_about(folder)) else { return Ok(None) };
        let own = shard.part(&measurements(&identity)).to_vec();
        let mut finished = super::look(folder, &own);
        finished.retain(|f| !about.layout.output.has_pictures() || f.pictures().exists());
        Ok(Some(Self { shard, identity, about, finished, lock }))
    }

    /// Whether it can be joined, given which measurements it is to have.
    fn is_done(&self, own: &[usize]) -> bool {
        self.lock.is_some() && self.about.record.is_some() && self.finished.len() == own.len()
    }
}

/// The measurements of a whole run.
fn measurements(identity: &Value) -> Vec<usize> {
    serde_json::from_value(identity["measurements"].clone()).unwrap_or_default()
}

/// A shard that cannot be joined yet.
#[derive(Debug)]
pub struct Missing {
    /// Which.
    pub shard: Shard,
    /// Those of its measurements that are not solved; none if it only has to come to its end.
    pub measurements: Vec<usize>,
    /// Whether it is being solved.
    pub at_work: bool,
    /// The command that makes it.
    pub command: String,
}

/// The shards of a run in its folder, which nobody else changes meanwhile.
#[derive(Debug)]
pub struct Shards {
    folder: RunFolder,
    /// At least one, all of the same run, in order.
    parts: Vec<Part>,
}

/// A run whose measurements are all there.
#[derive(Debug)]
pub struct Joined {
    /// Its folder, in which all of them are finished.
    pub folder: RunFolder,
    /// What its results are like.
    pub layout: Layout,
    /// Its record.
    pub record: Record,
}

impl Shards {
    /// The shards in a folder; nothing if none has begun there.
    ///
    /// # Errors
    /// [`Refusal`] if they are not of one run, or if someone else is at work in the folder.
    pub fn of(dir: &Path) -> anyhow::Result<Option<Self>> {
        let there = folders(&dir.join(STAGING));
        if there.is_empty() {
            return Ok(None);
        }
        let folder = RunFolder::open_shards(dir)?;
        let parts = there.iter().map(|(shard, path)| Part::read(*shard, path));
        let parts: Vec<Part> = parts.filter_map(Result::transpose).collect::<Result<_, _>>()?;
        let Some(first) = parts.first() else { return Ok(None) };
        for other in &parts[1..] {
            if other.shard.count() != first.shard.count() {
                return Err(refuse_counts(dir, first.shard, other.shard).into());
            }
            let differences = compare(&first.identity, &other.identity);
            if !differences.is_empty() {
                return Err(refuse_difference(dir, first.shard, other.shard, &differences).into());
            }
        }
        let files = first.about.layout.files(&measurements(&first.identity));
        super::destination::refuse_foreign(&folder.dir, &files, &folder.ours)?;
        Ok(Some(Self { folder, parts }))
    }

    /// How many shards there are to be.
    pub fn count(&self) -> usize {
        self.parts[0].shard.count()
    }

    /// Those that cannot be joined yet, in order.
    pub fn missing(&self) -> Vec<Missing> {
        let all = measurements(&self.parts[0].identity);
        let here = std::env::current_dir().unwrap_or_default().display().to_string();
        let missing = |shard: Shard| {
            let own = shard.part(&all);
            let part = self.parts.iter().find(|part| part.shard == shard);
            if own.is_empty() || part.is_some_and(|part| part.is_done(own)) {
                return None;
            }
            Some(Missing {
                shard,
                measurements: own[part.map_or(0, |part| part.finished.len())..].to_vec(),
                at_work: part.is_some_and(|part| part.lock.is_none()),
                command: part.unwrap_or(&self.parts[0]).about.command.line(shard, &here),
            })
        };
        Shard::all(self.count()).filter_map(missing).collect()
    }

    /// What is not as on one machine although nothing is missing.
    pub fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        let kernels = |part: &Part| part.about.kernels.clone();
        let kernels = distinct(self.parts.iter().flat_map(kernels).collect());
        if kernels.len() > 1 {
            warnings.push(format!(
                "shards ran on different kernels ({}): the last bits of their results differ; record.json says which ran where",
                kernels.join(", ")
            ));
        }
        let first = |part: &Part| Some(part.finished.first()?.record.index);
        let begun: Vec<usize> = self.parts.iter().skip(1).filter_map(first).collect();
        if self.parts[0].about.reuses && !begun.is_empty() {
            warnings.push(format!(
                "measurements take over from the one before, but {} had none, as a shard begins there: the results are not \
                 those of one machine",
                crate::shard::ranges(&begun)
            ));
        }
        warnings
    }

    /// One run of them all; nothing unless none is [`Shards::missing`].
    pub fn join(mut self) -> Option<Joined> {
        if !self.missing().is_empty() {
            return None;
        }
        let layout = self.parts[0].about.layout.clone();
        let mut records = Vec::new();
        for part in self.parts {
            self.folder.finished.extend(part.finished);
            self.folder.locks.extend(part.lock);
            // A shard beyond the last measurement has none.
            records.extend(part.about.record.map(|record| (part.shard.number(), record)));
        }
        let mut record = ShardRecord::join(records)?;
        let indices: Vec<usize> = record.measurements.iter().map(|m| m.index).collect();
        record.files = layout.files(&indices);
        Some(Joined { folder: self.folder, layout, record })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_of_a_missing_shard_can_be_given_to_a_shell() {
        let words = ["sci", "run", "a b.toml", "--set", "data.measurements=[0, 1]", "--out", "o'x"];
        let command = Command { folder: "there".into(), words: words.map(String::from).to_vec() };
        let shard = Shard::new(2, 3).unwrap();
        let line = r"sci run 'a b.toml' --set 'data.measurements=[0, 1]' --out 'o'\''x' --shard 2/3";
        assert_eq!(command.line(shard, "there"), line);
        assert_eq!(command.line(shard, "here"), format!("cd there && {line}"));
    }

    #[test]
    fn only_folders_of_shards_are_shards() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["shard-10-of-10", "shard-2-of-10", "shard-0-of-3", "shard-4-of-3", "m00", "shard-a-of-b"] {
            fs::create_dir(dir.path().join(name)).unwrap();
        }
        let found: Vec<String> = folders(dir.path()).iter().map(|(shard, _)| shard.to_string()).collect();
        assert_eq!(found, ["2/10", "10/10"]);
    }
}
