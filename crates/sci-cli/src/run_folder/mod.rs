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
//! ```

mod destination;
mod store;

use std::collections::BTreeSet;
use std::fs::{self, File, TryLockError};
use std::path::{Path, PathBuf};
use std::{fmt, io};

use serde_json::Value;

pub use destination::refuse_inputs;
pub use store::{Finished, read_video};

use crate::io::output::{WriteError, write_atomically};
use crate::record::{Record, Stop};

/// The file whose presence says that a folder holds the results of a run; it is moved into place last.
pub const RECORD: &str = "record.json";
const STAGING: &str = ".sci-run";
/// [`STAGING`] once it is not needed any more: a run that is killed while it clears up is finished.
const FINISHED: &str = ".sci-run-finished";
const LOCK: &str = "lock";
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
    /// The measurements in the order in which they are solved.
    pub measurements: Vec<usize>,
    /// Every file that it will leave, relative to the folder, without the record.
    pub files: Vec<String>,
}

/// A folder with a run at work.
#[derive(Debug)]
pub struct RunFolder {
    dir: PathBuf,
    created: bool,
    ours: BTreeSet<String>,
    finished: Vec<Finished>,
    _lock: File,
}

fn fail(path: &Path) -> impl FnOnce(io::Error) -> WriteError {
    move |e| WriteError::new(path, e)
}

impl RunFolder {
    /// Opens a folder, which need not exist, for a run. Nothing where `wish` is to resume and the folder holds the finished run.
    ///
    /// # Errors
    /// [`Refusal`] if another run is at work there, if it holds something of others that the run would overwrite, if there is a
    /// stopped run that `wish` does not mention, or another one than is to be resumed; [`WriteError`] if it cannot be written.
    pub fn open(dir: &Path, plan: &RunPlan, wish: Wish) -> anyhow::Result<Option<Self>> {
        let created = !dir.exists();
        fs::create_dir_all(dir).map_err(fail(dir))?;
        let dir = std::path::absolute(dir).map_err(fail(dir))?;
        let lock = lock(&dir)?;
        remove(&dir.join(FINISHED)).map_err(fail(&dir))?;
        let mut folder = Self { ours: BTreeSet::new(), finished: Vec::new(), created, _lock: lock, dir };
        folder.ours = destination::listed(&folder.dir)?;
        folder.ours.extend(folder.journal());
        folder.finished = folder.look(&plan.measurements);
        if folder.is_complete(plan, wish)? {
            return Ok(None);
        }
        destination::refuse_foreign(&folder.dir, &plan.files, &folder.ours)?;
        folder.begin(plan, wish)?;
        Ok(Some(folder))
    }

    /// Whether a folder holds a run that can be resumed.
    pub fn is_stopped_in(dir: &Path) -> bool {
        dir.join(STAGING).join(RUN).exists()
    }

    fn staging(&self) -> PathBuf {
        self.dir.join(STAGING)
    }

    /// The measurements that are solved, whole, in the order of the plan.
    pub fn finished(&self) -> &[Finished] {
        &self.finished
    }

    /// Of the plan's measurements those that are there, up to the first that is not.
    fn look(&self, measurements: &[usize]) -> Vec<Finished> {
        let found = |&index: &usize| Finished::read(&self.measurement(index), index);
        measurements.iter().map_while(found).collect()
    }

    fn measurement(&self, index: usize) -> PathBuf {
        self.staging().join(format!("m{index:02}"))
    }

    /// Whether there is nothing to resume because everything is there.
    fn is_complete(&self, plan: &RunPlan, wish: Wish) -> anyhow::Result<bool> {
        let record = self.dir.join(RECORD);
        if wish != Wish::Resume || self.staging().join(RUN).exists() || !record.exists() {
            return Ok(false);
        }
        let record = Record::read(&record)?;
        // It may have been stopped in its first measurement, of which nothing is left to go on from.
        let solved: Vec<usize> = record.measurements.iter().map(|m| m.index).collect();
        let complete = solved == plan.measurements && record.measurements.iter().all(|m| m.stop != Stop::Observer);
        let mut config = record.config;
        config.as_object_mut().map(|config| config.remove("written"));
        let mut differences = Vec::new();
        compare("", &config, &through_text(&plan.identity["config"]), &mut differences);
        if differences.is_empty() {
            return Ok(complete);
        }
        let problem = "nothing is unfinished there, and it holds the results of another run";
        Err(self.refuse_resume(problem, &differences).into())
    }

    fn refuse_resume(&self, problem: &str, differences: &[String]) -> Refusal {
        const SHOWN: usize = 4;
        let more = differences.len().saturating_sub(SHOWN);
        let more = if more > 0 { format!(", and {more} more") } else { String::new() };
        let first = differences[..differences.len().min(SHOWN)].join(", ");
        Refusal(format!("--resume: {}: {problem}: {first}{more}", self.dir.display()))
    }

    /// Begins anew, or goes on with what is there.
    fn begin(&mut self, plan: &RunPlan, wish: Wish) -> anyhow::Result<()> {
        let path = self.staging().join(RUN);
        let there = fs::read_to_string(&path).ok();
        if wish == Wish::Resume
            && let Some(there) = &there
        {
            let there: Value = serde_json::from_str(there).unwrap_or_default();
            let mut differences = Vec::new();
            compare("", &there, &through_text(&plan.identity), &mut differences);
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
            self.clear_unfinished(false)?;
        }
        self.clear_unfinished(true)?;
        write_atomically(&path, |w| io::Write::write_all(w, format!("{:#}\n", plan.identity).as_bytes()))?;
        Ok(())
    }

    /// What is solved there, of whichever run.
    fn solved_by_anyone(&self) -> Solved {
        // Those with another extension were stopped, or are not whole.
        let complete = |path: &PathBuf| path.extension().is_none() && path.join(store::COMPLETE).exists();
        let (mut measurements, mut bands) = (0, 0);
        for path in entries(&self.staging()) {
            if path.extension().is_some_and(|e| e == store::BANDS) {
                bands += entries(&path).filter(complete).count();
            } else {
                measurements += usize::from(complete(&path));
            }
        }
        Solved { measurements, bands }
    }

    /// Removes all but the finished measurements, and the bands of one that is not if they are to be kept.
    fn clear_unfinished(&self, keep_bands: bool) -> Result<(), WriteError> {
        let staging = self.staging();
        for entry in fs::read_dir(&staging).map_err(fail(&staging))? {
            let path = entry.map_err(fail(&staging))?.path();
            let name = path.file_name().unwrap_or_default();
            let kept = name == LOCK
                || name == OURS
                || name == RUN
                || self.finished.iter().any(|f| f.dir() == path)
                || keep_bands && path.extension().is_some_and(|e| e == store::BANDS);
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
        let path = self.staging().join(OUT).join(name);
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
        write_atomically(&self.staging().join(OURS), |w| io::Write::write_all(w, &journal))?;
        let record = self.dir.join(RECORD);
        remove(&record).map_err(fail(&record))?;
        for stale in old.iter().filter(|name| !files.contains(name)) {
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
        let journal = self.staging().join(OURS);
        remove_file(&journal).map_err(fail(&journal))
    }

    fn put_in_place(&self, name: &str) -> Result<(), WriteError> {
        let (from, to) = (self.staging().join(OUT).join(name), self.dir.join(name));
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
        fs::rename(self.staging(), &gone)?;
        remove(&gone)
    }

    fn journal(&self) -> Vec<String> {
        let bytes = fs::read(self.staging().join(OURS)).unwrap_or_default();
        let names: Vec<String> = serde_json::from_slice(&bytes).unwrap_or_default();
        names.into_iter().filter(|name| destination::can_be_ours(name)).collect()
    }
}

impl Drop for RunFolder {
    /// A run that has solved nothing leaves nothing.
    fn drop(&mut self) {
        let staging = self.staging();
        if staging.exists() && self.solved_by_anyone() == Solved::default() && !staging.join(OURS).exists() {
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

/// Takes the lock of a folder, until the file is dropped.
fn lock(dir: &Path) -> anyhow::Result<File> {
    let busy = || Refusal(format!("--out {}: another run is at work there", dir.display()));
    let staging = dir.join(STAGING);
    fs::create_dir_all(&staging).map_err(fail(dir))?;
    let path = staging.join(LOCK);
    let file = File::options().create(true).truncate(false).write(true).open(&path).map_err(fail(&path))?;
    match file.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => return Err(busy().into()),
        Err(TryLockError::Error(e)) if e.kind() == io::ErrorKind::Unsupported => {
            eprintln!(
                "warning: {}: the file system has no locks, so see to it that no other run is at work there",
                dir.display()
            );
        }
        Err(TryLockError::Error(e)) => return Err(fail(&path)(e).into()),
    }
    // A run that has just finished may have taken its folder, and this lock with it, away.
    if is_at(&file, &path) { Ok(file) } else { Err(busy().into()) }
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

/// As it is when it is read back, to be compared with what was read back.
fn through_text(value: &Value) -> Value {
    serde_json::from_str(&value.to_string()).unwrap_or_default()
}

/// The keys in which two values differ, with both values.
fn compare(key: &str, there: &Value, here: &Value, differences: &mut Vec<String>) {
    let below = |name: &str| if key.is_empty() { name.to_owned() } else { format!("{key}.{name}") };
    match (there, here) {
        (Value::Object(a), Value::Object(b)) => {
            let keys: BTreeSet<&String> = a.keys().chain(b.keys()).collect();
            let value = |map: &serde_json::Map<String, Value>, name: &str| map.get(name).cloned().unwrap_or_default();
            keys.into_iter().for_each(|name| compare(&below(name), &value(a, name), &value(b, name), differences));
        }
        (Value::Array(a), Value::Array(b)) if a.len() == b.len() && a.iter().any(Value::is_object) => {
            a.iter().zip(b).enumerate().for_each(|(i, (a, b))| compare(&below(&i.to_string()), a, b, differences));
        }
        _ if there != here => differences.push(format!("`{key}` is {there} there and {here} here")),
        _ => {}
    }
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
