//! Owns the folder of a run: nothing that is solved can be lost, and nothing that is not the run's is touched.
//!
//! All that is unfinished lies in a folder inside the destination, so that it is on the same file system and moving it into
//! place is one step for each file. A measurement becomes a folder there as soon as it is solved, at once and whole; what the
//! next one needs is part of it. When all are solved the results are put together beside them and moved into place, the
//! record last; then the folder goes. Whatever stops the program in between, `--resume` finds what is solved.
//!
//! ```text
//! DIR/.sci-run/lock          held while a run works here
//! DIR/.sci-run/run.json      which run this is
//! DIR/.sci-run/m00/          a measurement: video.npy, its record, what the next one needs; later its pictures
//! DIR/.sci-run/m01.bands/    those bands of a measurement that are solved, where it is solved in bands, each as a measurement is
//! DIR/.sci-run/ours.json     files of DIR that are the run's while there is no record that lists them
//! DIR/.sci-run/out/          the results before they are moved
//! DIR/.sci-run/shard-1-of-3/ lock, run.json and measurements of a shard, if the run is in shards, and what it says of itself
//! ```

mod destination;
mod layout;
mod shards;
mod store;

use std::collections::BTreeSet;
use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};
use std::{fmt, io};

use serde_json::Value;

pub use destination::refuse_inputs;
pub use layout::{Layout, PREVIEW, REPORT, frame_name};
pub use shards::{About, Command, Joined, Missing, Shards};
pub use store::{Finished, checksum, read_video};

use crate::io::output::{WriteError, write_atomically};
use crate::record::{Record, Stop};
use crate::shard::Shard;

/// The file whose presence says that a folder holds the results of a run; it is moved into place last.
pub const RECORD: &str = "record.json";
const STAGING: &str = ".sci-run";
/// [`STAGING`] once it is not needed any more: a run that is killed while it clears up is finished.
const FINISHED: &str = ".sci-run-finished";
pub(crate) const LOCK: &str = "lock";
const RUN: &str = "run.json";
const OURS: &str = "ours.json";
const OUT: &str = "out";

/// A folder that a run must not write into; a mistake of the call, not of the run.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct Refusal(pub String);

/// What to do with a run that was stopped in the folder before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wish {
    /// There should be none.
    New,
    /// Go on with it.
    Resume,
    /// Throw it away.
    Restart,
}

/// What a run is, as far as its folder has to know.
#[derive(Clone, Debug)]
pub struct RunPlan {
    /// Everything that the results depend on: two runs of equal identity end with the same bytes.
    pub identity: Value,
    /// All its measurements in the order in which they are solved.
    pub measurements: Vec<usize>,
    /// Every file that it will leave, relative to the folder, without the record.
    pub files: Vec<String>,
    /// The shard of it that is solved here, if it is in shards.
    pub shard: Option<(Shard, About)>,
}

impl RunPlan {
    fn own(&self) -> &[usize] {
        self.shard.as_ref().map_or(&self.measurements, |(shard, _)| shard.part(&self.measurements))
    }
}

/// A folder with a run at work.
#[derive(Debug)]
pub struct RunFolder {
    dir: PathBuf,
    /// [`STAGING`], or the folder in it of the shard in work.
    staging: PathBuf,
    shard: Option<Shard>,
    created: bool,
    ours: BTreeSet<String>,
    finished: Vec<Finished>,
    /// Nobody else is at work in what is locked.
    locks: Vec<File>,
}

fn fail(path: &Path) -> impl FnOnce(io::Error) -> WriteError {
    move |e| WriteError::new(path, e)
}

impl RunFolder {
    /// Opens a folder, which need not exist, for a run or a shard of it. Nothing where `wish` is to resume and the folder holds the
    /// finished run.
    ///
    /// # Errors
    /// [`Refusal`] if another run is at work there, if it holds something of others that the run would overwrite, if there is a
    /// stopped run that `wish` does not mention, or another one than is to be resumed, or shards of another one; [`WriteError`] if
    /// it cannot be written.
    pub fn open(dir: &Path, plan: &RunPlan, wish: Wish) -> anyhow::Result<Option<Self>> {
        let mut folder = Self::lock(dir, plan.shard.as_ref().map(|(shard, _)| *shard))?;
        folder.finished = look(&folder.staging, plan.own());
        if folder.is_complete(plan, wish)? {
            return Ok(None);
        }
        destination::refuse_foreign(&folder.dir, &plan.files, &folder.ours)?;
        match folder.shard {
            None => folder.refuse_shards(wish)?,
            Some(shard) => folder.refuse_beside(shard, plan, wish)?,
        }
        folder.begin(plan, wish)?;
        Ok(Some(folder))
    }

    /// Opens a folder to join the shards of a run in it.
    fn open_shards(dir: &Path) -> anyhow::Result<Self> {
        let folder = Self::lock(dir, None)?;
        if folder.staging.join(RUN).exists() {
            let dir = dir.display();
            return Err(Refusal(format!("{dir}: a run without --shard is unfinished there beside the shards")).into());
        }
        Ok(folder)
    }

    /// Takes the lock of a folder, which need not exist, or of a shard in it.
    fn lock(dir: &Path, shard: Option<Shard>) -> anyhow::Result<Self> {
        let created = !dir.exists();
        fs::create_dir_all(dir).map_err(fail(dir))?;
        let dir = std::path::absolute(dir).map_err(fail(dir))?;
        let root = dir.join(STAGING);
        let staging = shard.map_or_else(|| root.clone(), |shard| root.join(shards::folder_name(shard)));
        let who = shard.map_or_else(|| "another run".to_owned(), |shard| format!("shard {shard}"));
        let busy = || Refusal(format!("--out {}: {who} is at work there", dir.display()));
        let locks = vec![locked(&staging)?.ok_or_else(busy)?];
        if shard.is_none() {
            remove(&dir.join(FINISHED)).map_err(fail(&dir))?;
        }
        let mut folder = Self { ours: BTreeSet::new(), finished: Vec::new(), created, locks, dir, staging, shard };
        folder.ours = destination::listed(&folder.dir)?;
        folder.ours.extend(folder.journal());
        Ok(folder)
    }

    /// Whether a folder holds a run, or shards of one, that can be resumed.
    pub fn is_stopped_in(dir: &Path) -> bool {
        let staging = dir.join(STAGING);
        staging.join(RUN).exists() || shards::folders(&staging).iter().any(|(_, shard)| shard.join(RUN).exists())
    }

    /// Whether what is solved stays where it is until all shards are joined.
    pub fn is_shard(&self) -> bool {
        self.shard.is_some()
    }

    /// The measurements that are solved, whole, in the order of the plan.
    pub fn finished(&self) -> &[Finished] {
        &self.finished
    }

    /// Whether there is nothing to resume because everything is there.
    fn is_complete(&self, plan: &RunPlan, wish: Wish) -> anyhow::Result<bool> {
        let record = self.dir.join(RECORD);
        if wish != Wish::Resume || Self::is_stopped_in(&self.dir) || !record.exists() {
            return Ok(false);
        }
        let record = Record::read(&record)?;
        // It may have been stopped in its first measurement, of which nothing is left to go on from.
        let solved: Vec<usize> = record.measurements.iter().map(|m| m.index).collect();
        let complete = solved == plan.measurements && record.measurements.iter().all(|m| m.stop != Stop::Observer);
        let mut config = record.config;
        config.as_object_mut().map(|config| config.remove("written"));
        let mut differences = compare(&config, &plan.identity["config"]);
        if !record.checksums.is_null() {
            let of = |checksums: &Value| serde_json::json!({ "checksums": checksums });
            differences.extend(compare(&of(&record.checksums), &of(&plan.identity["checksums"])));
        }
        if differences.is_empty() {
            return Ok(complete);
        }
        // A shard resumes without being asked to, so that these results are as much in its way as in that of any new run.
        if self.shard.is_some() {
            return Ok(false);
        }
        let problem = "nothing is unfinished there, and it holds the results of another run";
        Err(self.refuse_resume(problem, &differences).into())
    }

    fn refuse_resume(&self, problem: &str, differences: &[String]) -> Refusal {
        let (how, dir) =
            (self.shard.map_or_else(|| "--resume".to_owned(), |s| format!("--shard {s}")), self.dir.display());
        Refusal(format!("{how}: {dir}: {problem}: {}", differences_in_short(differences)))
    }

    /// Begins anew, or goes on with what is there.
    fn begin(&mut self, plan: &RunPlan, wish: Wish) -> anyhow::Result<()> {
        let there = shards::identity(&self.staging);
        let mut before = shards::read_about(&self.staging);
        if wish == Wish::Resume
            && let Some(there) = &there
        {
            let differences = compare(there, &plan.identity);
            if !differences.is_empty() {
                // Nothing is lost by refusing, so what is there stays even if it is nothing yet.
                return Err(self.refuse_resume("the run that was stopped there is another one", &differences).into());
            }
        } else {
            let stopped = self.solved_by_anyone();
            if wish == Wish::New && stopped > Solved::default() {
                return Err(Refusal(format!(
                    "--out {}: a run was stopped there with {stopped} solved; add --resume to go on with it, or --restart to \
                     throw it away",
                    self.dir.display()
                ))
                .into());
            }
            self.finished.clear();
            before = None;
            self.clear_unfinished(false)?;
        }
        self.clear_unfinished(true)?;
        if let Some((shard, about)) = &plan.shard {
            self.introduce(*shard, about.clone(), before)?;
        }
        let identity = format!("{:#}\n", plan.identity);
        write_atomically(&self.staging.join(RUN), |w| io::Write::write_all(w, identity.as_bytes()))?;
        Ok(())
    }

    /// What is solved there, of whichever run.
    fn solved_by_anyone(&self) -> Solved {
        // Those with another extension were stopped, or are not whole.
        let complete = |path: &PathBuf| path.extension().is_none() && path.join(store::COMPLETE).exists();
        let (mut measurements, mut bands) = (0, 0);
        for path in entries(&self.staging) {
            if is_of_bands(&path) {
                bands += entries(&path).filter(complete).count();
            } else {
                measurements += usize::from(complete(&path));
            }
        }
        Solved { measurements, bands }
    }

    /// How many bands there are of a measurement that is not solved as a whole.
    pub fn bands_solved(&self) -> usize {
        self.solved_by_anyone().bands
    }

    /// Removes all but the finished measurements, and the bands of one that is not if they are to be kept.
    fn clear_unfinished(&self, keep_bands: bool) -> Result<(), WriteError> {
        let staging = &self.staging;
        for entry in fs::read_dir(staging).map_err(fail(staging))? {
            let path = entry.map_err(fail(staging))?.path();
            let ours = [LOCK, OURS, RUN, shards::ABOUT].iter().any(|name| path.file_name().is_some_and(|n| n == *name));
            let kept = ours || self.finished.iter().any(|f| f.dir() == path) || keep_bands && is_of_bands(&path);
            if !kept {
                remove(&path).map_err(fail(&path))?;
            }
        }
        Ok(())
    }

    /// A file of the run in work, before it is moved into place.
    ///
    /// # Errors
    /// The file system's.
    pub fn out(&self, name: &str) -> Result<PathBuf, WriteError> {
        let path = self.staging.join(OUT).join(name);
        let parent = path.parent().unwrap_or(&path);
        fs::create_dir_all(parent).map_err(fail(parent))?;
        Ok(path)
    }

    /// Moves the results into place, the record last, and removes what an earlier run left that this one does not write.
    ///
    /// # Errors
    /// The file system's, naming the file.
    pub fn commit(&mut self, files: &[String]) -> Result<(), WriteError> {
        let old = std::mem::take(&mut self.ours);
        self.ours = old.iter().chain(files).cloned().collect();
        let journal = serde_json::to_vec(&self.ours).map_err(|e| WriteError::new(&self.dir, e))?;
        write_atomically(&self.staging.join(OURS), |w| io::Write::write_all(w, &journal))?;
        let record = self.dir.join(RECORD);
        remove(&record).map_err(fail(&record))?;
        let new: BTreeSet<&String> = files.iter().collect();
        for stale in old.iter().filter(|name| !new.contains(name)) {
            let path = self.dir.join(stale);
            remove_file(&path).map_err(fail(&path))?;
        }
        for name in files {
            self.put_in_place(name)?;
        }
        self.put_in_place(RECORD)?;
        // Not there, or not empty as something of the user's is in it.
        let _ = fs::remove_dir(self.dir.join("frames"));
        self.ours = files.iter().cloned().collect();
        let journal = self.staging.join(OURS);
        remove_file(&journal).map_err(fail(&journal))
    }

    fn put_in_place(&self, name: &str) -> Result<(), WriteError> {
        let (from, to) = (self.staging.join(OUT).join(name), self.dir.join(name));
        if let Some(parent) = to.parent() {
            fs::create_dir_all(parent).map_err(fail(parent))?;
        }
        fs::rename(from, &to).map_err(fail(&to))
    }

    /// Ends a run that was stopped after what it had was put in place: what is solved stays, to be resumed. How many are.
    ///
    /// # Errors
    /// The file system's.
    pub fn keep(mut self) -> Result<usize, WriteError> {
        self.finished.retain(Finished::is_whole);
        self.clear_unfinished(true)?;
        Ok(self.finished.len())
    }

    /// Ends a run of which everything is in place.
    ///
    /// # Errors
    /// The file system's.
    pub fn close(mut self) -> Result<(), WriteError> {
        self.finished.clear();
        self.leave().map_err(fail(&self.dir))
    }

    /// Leaves nothing but the results. One step makes the run a finished one, however long the rest takes.
    fn leave(&self) -> io::Result<()> {
        let gone = self.dir.join(FINISHED);
        fs::rename(&self.staging, &gone)?;
        remove(&gone)
    }

    fn journal(&self) -> Vec<String> {
        let bytes = fs::read(self.dir.join(STAGING).join(OURS)).unwrap_or_default();
        let names: Vec<String> = serde_json::from_slice(&bytes).unwrap_or_default();
        names.into_iter().filter(|name| destination::can_be_ours(name)).collect()
    }
}

impl Drop for RunFolder {
    /// A run that has solved nothing leaves nothing.
    fn drop(&mut self) {
        let staging = &self.staging;
        if self.shard.is_some() {
            // One that has begun is not forgotten, so that who joins them knows of it.
            if !staging.join(RUN).exists() {
                let _ = remove(staging);
                let _ = fs::remove_dir(self.dir.join(STAGING));
            }
        } else if staging.exists()
            && self.solved_by_anyone() == Solved::default()
            && !staging.join(OURS).exists()
            && shards::folders(staging).is_empty()
        {
            let _ = self.leave();
        }
        if self.created {
            // Fails, as it should, if there is anything in it.
            let _ = fs::remove_dir(&self.dir);
        }
    }
}

/// What is found in a folder, of whichever run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
struct Solved {
    measurements: usize,
    /// Of a measurement that is not solved as a whole.
    bands: usize,
}

impl fmt::Display for Solved {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let plural = |n: usize| if n == 1 { "" } else { "s" };
        let Self { measurements, bands } = *self;
        if measurements > 0 || bands == 0 {
            write!(f, "{measurements} measurement{}", plural(measurements))?;
        }
        if bands > 0 {
            let and = if measurements > 0 { " and " } else { "" };
            write!(f, "{and}{bands} band{} of a measurement", plural(bands))?;
        }
        Ok(())
    }
}

/// What is in a folder, nothing of one that cannot be read.
fn entries(dir: &Path) -> impl Iterator<Item = PathBuf> {
    fs::read_dir(dir).into_iter().flatten().flatten().map(|entry| entry.path())
}

/// Whether a folder holds the bands of a measurement.
fn is_of_bands(path: &Path) -> bool {
    path.extension().is_some_and(|e| e == store::BANDS)
}

/// Of these measurements those that are in a staging folder, up to the first that is not.
fn look(staging: &Path, measurements: &[usize]) -> Vec<Finished> {
    let found = |&index: &usize| Finished::read(&staging.join(measurement_name(index)), index);
    measurements.iter().map_while(found).collect()
}

fn measurement_name(index: usize) -> String {
    format!("m{index:02}")
}

/// Takes the lock of a staging folder, until the file is dropped; nothing if someone else has it.
pub(crate) fn locked(staging: &Path) -> anyhow::Result<Option<File>> {
    fs::create_dir_all(staging).map_err(fail(staging))?;
    let path = staging.join(LOCK);
    let file = File::options().create(true).truncate(false).write(true).open(&path).map_err(fail(&path))?;
    match file.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => return Ok(None),
        Err(TryLockError::Error(e)) if e.kind() == io::ErrorKind::Unsupported => {
            eprintln!(
                "warning: {}: the file system has no locks, so see to it that no other run is at work there",
                staging.display()
            );
        }
        Err(TryLockError::Error(e)) => return Err(fail(&path)(e).into()),
    }
    // A run that has just finished may have taken its folder, and this lock with it, away.
    Ok(is_at(&file, &path).then_some(file))
}

#[cfg(unix)]
fn is_at(file: &File, path: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let id = |m: fs::Metadata| (m.dev(), m.ino());
    file.metadata().ok().map(id) == fs::metadata(path).ok().map(id)
}

#[cfg(not(unix))]
fn is_at(_: &File, path: &Path) -> bool {
    path.exists()
}

/// The keys in which what was read back from a file differs from what is here, with both values.
fn compare(there: &Value, here: &Value) -> Vec<String> {
    let mut differences = Vec::new();
    // As it would be when it is read back.
    let here = serde_json::from_str(&here.to_string()).unwrap_or_default();
    compare_at("", there, &here, &mut differences);
    differences
}

/// The first of the differences, and how many more there are.
fn differences_in_short(differences: &[String]) -> String {
    const SHOWN: usize = 4;
    let more = differences.len().saturating_sub(SHOWN);
    let more = if more > 0 { format!(", and {more} more") } else { String::new() };
    differences[..differences.len().min(SHOWN)].join(", ") + &more
}

fn compare_at(key: &str, there: &Value, here: &Value, differences: &mut Vec<String>) {
    let below = |name: &str| if key.is_empty() { name.to_owned() } else { format!("{key}.{name}") };
    match (there, here) {
        (Value::Object(a), Value::Object(b)) => {
            let keys: BTreeSet<&String> = a.keys().chain(b.keys()).collect();
            let value = |map: &serde_json::Map<String, Value>, name: &str| map.get(name).cloned().unwrap_or_default();
            keys.into_iter().for_each(|name| compare_at(&below(name), &value(a, name), &value(b, name), differences));
        }
        (Value::Array(a), Value::Array(b)) if a.len() == b.len() && a.iter().any(Value::is_object) => {
            a.iter().zip(b).enumerate().for_each(|(i, (a, b))| compare_at(&below(&i.to_string()), a, b, differences));
        }
        _ if there != here => {
            differences.push(format!("`{key}` is {} there and {} here", shortened(there), shortened(here)));
        }
        _ => {}
    }
}

/// A value as far as it fits into a message.
fn shortened(value: &Value) -> String {
    const MOST: usize = 80;
    let text = value.to_string();
    if text.chars().count() <= MOST { text } else { text.chars().take(MOST).chain("…".chars()).collect() }
}

fn remove(path: &Path) -> io::Result<()> {
    if path.is_dir() && !path.is_symlink() { missing_is_fine(fs::remove_dir_all(path)) } else { remove_file(path) }
}

fn remove_file(path: &Path) -> io::Result<()> {
    missing_is_fine(fs::remove_file(path))
}

fn missing_is_fine(removed: io::Result<()>) -> io::Result<()> {
    match removed {
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
        other => other,
    }
}
