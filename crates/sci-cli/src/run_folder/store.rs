//! Owns a measurement on disk: written aside and renamed, so that it is there whole or not at all.
//!
//! A kill cannot tear it. A power cut could, between the renaming and [`Finished::sync`], which does not hold up the next solve:
//! so each array has a checksum, and one that does not agree is as if it were not there.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use admm::Estimate;
use ndarray::{Array3, Array4, ArrayBase, ArrayView4, Data, Dimension};
use ndarray_npy::ReadNpyExt;
use serde::{Deserialize, Serialize};

use super::{RunFolder, fail, measurement_name, remove};
use crate::io::npy;
use crate::io::output::WriteError;
use crate::record::MeasurementRecord;

/// The file that makes a folder a measurement.
pub(super) const COMPLETE: &str = "measurement.cbor";
/// The extension of the folder of a measurement's bands.
pub(super) const BANDS: &str = "bands";
const VIDEO: &str = "video.npy";
const SENSOR: &str = "sensor.npy";
const WEIGHTS: &str = "weights";
const PICTURES: &str = "pictures";

/// What a measurement's folder says of itself, in a format that keeps every bit of a number.
#[derive(Serialize, Deserialize)]
struct Entry {
    record: MeasurementRecord,
    /// Of the files of arrays, in the order [`VIDEO`], [`SENSOR`].
    checksums: Vec<u32>,
}

/// A measurement that is solved and on disk.
#[derive(Clone, Debug)]
pub struct Finished {
    dir: PathBuf,
    /// How it went.
    pub record: MeasurementRecord,
}

impl Finished {
    /// The measurement of a folder, if it is whole.
    pub(super) fn read(dir: &Path, index: usize) -> Option<Self> {
        let entry: Entry = ciborium::from_reader(fs::read(dir.join(COMPLETE)).ok()?.as_slice()).ok()?;
        let is_whole = |(name, sum): (&str, &u32)| checksum(&dir.join(name)).is_ok_and(|found| found == *sum);
        let whole = [VIDEO, SENSOR].into_iter().zip(&entry.checksums).all(is_whole) && !entry.checksums.is_empty();
        (whole && entry.record.index == index).then(|| Self { dir: dir.to_owned(), record: entry.record })
    }

    pub(super) fn dir(&self) -> &Path {
        &self.dir
    }

    /// Whether it was not stopped from outside.
    pub fn is_whole(&self) -> bool {
        self.dir.extension().is_none()
    }

    /// The file of the result as it is shown, `[T, C, H, W]`.
    pub fn video(&self) -> PathBuf {
        self.dir.join(VIDEO)
    }

    /// What the sensor sees of the result, if a later measurement can need it.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn sensor(&self) -> anyhow::Result<Option<Array3<f32>>> {
        let path = self.dir.join(SENSOR);
        if !path.exists() {
            return Ok(None);
        }
        Ok(Some(Array3::read_npy(File::open(path)?)?))
    }

    /// The folder of weights that networks had when it was solved.
    pub fn weights(&self) -> PathBuf {
        self.dir.join(WEIGHTS)
    }

    /// The folder of its pictures.
    pub fn pictures(&self) -> PathBuf {
        self.dir.join(PICTURES)
    }

    /// Makes its pictures with `fill`, unless they are there: whole or not at all.
    ///
    /// # Errors
    /// The file system's, and that of `fill`.
    pub fn make_pictures(&self, fill: impl FnOnce(&Path) -> Result<(), WriteError>) -> Result<(), WriteError> {
        let made = self.pictures();
        if made.exists() {
            return Ok(());
        }
        let temporary = self.dir.join("pictures.tmp");
        remove(&temporary).map_err(fail(&temporary))?;
        fs::create_dir(&temporary).map_err(fail(&temporary))?;
        fill(&temporary)?;
        fs::rename(&temporary, &made).map_err(fail(&made))
    }

    /// Waits until a power cut would not harm it.
    ///
    /// # Errors
    /// The file system's.
    pub fn sync(&self) -> Result<(), WriteError> {
        for entry in fs::read_dir(&self.dir).map_err(fail(&self.dir))? {
            let path = entry.map_err(fail(&self.dir))?.path();
            if path.is_file() {
                // Windows writes out only what is open for writing.
                File::options().write(true).open(&path).and_then(|file| file.sync_all()).map_err(fail(&path))?;
            }
        }
        Ok(())
    }
}

/// Reads [`Finished::video`].
///
/// # Errors
/// If the file cannot be read.
pub fn read_video(path: &Path) -> anyhow::Result<Array4<f32>> {
    Ok(Array4::read_npy(File::open(path)?)?)
}

impl RunFolder {
    /// Puts a solved measurement on disk. What the sensor sees of it is kept if a later measurement can need it; `state` writes the weights that
    /// it needs into a folder. `whole` says that it was not stopped from outside: else [`RunFolder::finished`] does not know it
    /// after the run.
    ///
    /// # Errors
    /// The file system's, and that of `state`.
    pub fn store(
        &mut self,
        record: MeasurementRecord,
        estimate: &Estimate,
        keep_sensor: bool,
        whole: bool,
        state: impl FnOnce(&Path) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        let dir = self.staging.join(measurement_name(record.index));
        let dir = if whole { dir } else { dir.with_extension("stopped") };
        let sensor = keep_sensor.then_some(&estimate.sensor);
        self.finished.push(put(&dir, record, &estimate.video(), sensor, state)?);
        Ok(())
    }

    /// A band of a measurement, if it is solved and on disk.
    pub fn band(&self, index: usize, band: usize) -> Option<Finished> {
        Finished::read(&self.bands(index).join(format!("b{band:03}")), index)
    }

    /// Puts a solved band of a measurement on disk, `[T, C, rows, W]`; `sensor` is what the sensor sees of it, if a later measurement can
    /// need that, and `state` writes the weights that it needs into a folder.
    ///
    /// # Errors
    /// The file system's, and that of `state`.
    pub fn store_band(
        &self,
        record: MeasurementRecord,
        band: usize,
        video: &Array4<f32>,
        sensor: Option<&Array3<f32>>,
        state: impl FnOnce(&Path) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        let dir = self.bands(record.index).join(format!("b{band:03}"));
        remove(&dir).map_err(fail(&dir))?;
        put(&dir, record, &video.view(), sensor, state)?;
        Ok(())
    }

    /// Makes a measurement of its bands, of which `learned` has what the next measurement needs: `write` puts the joined video into a file
    /// and says how it went.
    ///
    /// # Errors
    /// The file system's, and that of `write`.
    pub fn join_bands(
        &mut self,
        index: usize,
        learned: &Finished,
        write: impl FnOnce(&Path) -> anyhow::Result<MeasurementRecord>,
    ) -> anyhow::Result<()> {
        let dir = self.staging.join(measurement_name(index));
        let temporary = dir.with_extension("tmp");
        remove(&temporary).map_err(fail(&temporary))?;
        fs::create_dir_all(&temporary).map_err(fail(&temporary))?;
        let video = temporary.join(VIDEO);
        let record = write(&video)?;
        let mut checksums = vec![checksum(&video).map_err(fail(&video))?];
        fs::rename(learned.weights(), temporary.join(WEIGHTS)).map_err(fail(&temporary))?;
        if learned.dir.join(SENSOR).exists() {
            let sensor = temporary.join(SENSOR);
            fs::rename(learned.dir.join(SENSOR), &sensor).map_err(fail(&sensor))?;
            checksums.push(checksum(&sensor).map_err(fail(&sensor))?);
        }
        self.finished.push(completed(&temporary, &dir, Entry { record, checksums })?);
        let bands = self.bands(index);
        Ok(remove(&bands).map_err(fail(&bands))?)
    }

    fn bands(&self, index: usize) -> PathBuf {
        self.staging.join(measurement_name(index)).with_extension(BANDS)
    }
}

/// Writes what is solved beside its folder, and makes it the folder.
fn put(
    dir: &Path,
    record: MeasurementRecord,
    video: &ArrayView4<'_, f32>,
    sensor: Option<&Array3<f32>>,
    state: impl FnOnce(&Path) -> anyhow::Result<()>,
) -> anyhow::Result<Finished> {
    let temporary = dir.with_extension("tmp");
    remove(&temporary).map_err(fail(&temporary))?;
    fs::create_dir_all(temporary.join(WEIGHTS)).map_err(fail(&temporary))?;
    let mut checksums = vec![write_array(&temporary.join(VIDEO), video)?];
    if let Some(sensor) = sensor {
        checksums.push(write_array(&temporary.join(SENSOR), sensor)?);
    }
    state(&temporary.join(WEIGHTS))?;
    Ok(completed(&temporary, dir, Entry { record, checksums })?)
}

/// Makes a folder of arrays what it is to be, in one step.
fn completed(temporary: &Path, dir: &Path, entry: Entry) -> Result<Finished, WriteError> {
    let path = temporary.join(COMPLETE);
    let mut bytes = Vec::new();
    ciborium::into_writer(&entry, &mut bytes).map_err(|e| WriteError::new(&path, e.to_string()))?;
    fs::write(&path, bytes).map_err(fail(&path))?;
    fs::rename(temporary, dir).map_err(fail(dir))?;
    Ok(Finished { dir: dir.to_owned(), record: entry.record })
}

/// Writes an array as `.npy`; its checksum.
fn write_array<D: Dimension>(path: &Path, array: &ArrayBase<impl Data<Elem = f32>, D>) -> Result<u32, WriteError> {
    let file = File::create(path).map_err(fail(path))?;
    let mut sink = Sum { inner: BufWriter::new(file), sum: crc32fast::Hasher::new() };
    npy::write_npy(&mut sink, array).map_err(|e| WriteError::new(path, e))?;
    sink.flush().map_err(fail(path))?;
    Ok(sink.sum.finalize())
}

/// Of the bytes of a file.
///
/// # Errors
/// The file system's.
pub fn checksum(path: &Path) -> io::Result<u32> {
    let mut sink = Sum { inner: io::sink(), sum: crc32fast::Hasher::new() };
    io::copy(&mut io::BufReader::with_capacity(1 << 20, File::open(path)?), &mut sink)?;
    Ok(sink.sum.finalize())
}

/// Hands on what is written, and adds it up.
struct Sum<W> {
    inner: W,
    sum: crc32fast::Hasher,
}

impl<W: Write> Write for Sum<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.inner.write(bytes)?;
        self.sum.update(&bytes[..written]);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.inner.flush()
    }
}
