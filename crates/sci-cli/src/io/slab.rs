//! Owns the reading of a part of an array that is too large to be read whole: some frames, some rows.
//!
//! `.npy` files and the members of `.npz` archives that are stored plainly are sought in, packed members are unpacked to disk first, and
//! of HDF5 (MATLAB's v7.3 among it) the chunks are read that are needed. What other formats hold has to be read whole.

use std::fs::File;
use std::io::{self, BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use super::npy::{self, Header};
use super::samples::{Array, Budget, Samples};
use super::{FileError, Format, ReadError, hdf5};

/// An array on disk.
#[derive(Clone, Debug)]
pub struct Stored {
    path: PathBuf,
    place: Place,
    header: Header,
}

/// Where in its file an array is.
#[derive(Clone, Debug)]
enum Place {
    /// From this byte on, as it is.
    At(u64),
    /// A packed member of an archive.
    Packed(usize),
    /// What was such a member, in a file that has no name and is gone with the last that reads it.
    Unpacked(Arc<Mutex<File>>),
    /// A dataset.
    Dataset(String),
    /// One of a type of which parts cannot be read.
    Whole,
}

/// The arrays of a file, or of a folder of `.npy` files, and the format that their layout is of.
#[derive(Clone, Debug)]
pub struct Arrays {
    /// By name, in the order of the file.
    pub named: Vec<(String, Stored)>,
    /// The format.
    pub format: Format,
}

/// The arrays of which parts can be read.
///
/// # Errors
/// A file that cannot be read, or that is damaged; nothing where its format has to be read whole.
pub fn arrays(path: &Path) -> Result<Option<Arrays>, FileError> {
    let error = |e| FileError::new(path, e);
    if path.is_dir() {
        return in_folder(path);
    }
    let mut beginning = vec![0; 1024];
    let mut file = File::open(path).map_err(|e| error(ReadError::Io(e)))?;
    let length = read_some(&mut file, &mut beginning).map_err(|e| error(ReadError::Io(e)))?;
    beginning.truncate(length);
    file.rewind().map_err(|e| error(ReadError::Io(e)))?;
    match Format::of(&beginning) {
        Ok(Format::Npy) => {
            let stored = of_npy(path, &mut BufReader::new(file)).map_err(error)?;
            let stem = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
            Ok(Some(Arrays { named: vec![(stem, stored)], format: Format::Npy }))
        }
        Ok(Format::Npz) => Ok(Some(Arrays { named: in_archive(path, file).map_err(error)?, format: Format::Npz })),
        Ok(Format::Hdf5 | Format::Mat) if hdf5::is_hdf5(&beginning) => {
            let (found, of_matlab) = hdf5::headers(path).map_err(error)?;
            let stored = |(name, header, in_parts): hdf5::Found| {
                let place = if in_parts { Place::Dataset(name.clone()) } else { Place::Whole };
                (name, Stored { path: path.to_owned(), place, header })
            };
            let format = if of_matlab || hdf5::is_matlab(&beginning) { Format::Mat } else { Format::Hdf5 };
            Ok(Some(Arrays { named: found.into_iter().map(stored).collect(), format }))
        }
        _ => Ok(None),
    }
}

fn in_folder(folder: &Path) -> Result<Option<Arrays>, FileError> {
    let io = |e| FileError::new(folder, ReadError::Io(e));
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let path = entry.map_err(io)?.path();
        if path.extension().is_some_and(|e| e == "npy") && path.is_file() {
            found.extend(arrays(&path)?.into_iter().flat_map(|arrays| arrays.named));
        }
    }
    found.sort_by(|a, b| a.0.cmp(&b.0));
    Ok(if found.is_empty() { None } else { Some(Arrays { named: found, format: Format::Npy }) })
}

fn of_npy(path: &Path, file: &mut (impl Read + Seek)) -> Result<Stored, ReadError> {
    let (header, start) = npy::read_header(file)?;
    let end = file.seek(SeekFrom::End(0)).map_err(ReadError::Io)?;
    if end - start < header.bytes() {
        return Err(header.cut_short(end - start));
    }
    Ok(Stored { path: path.to_owned(), place: Place::At(start), header })
}

fn in_archive(path: &Path, file: File) -> Result<Vec<(String, Stored)>, ReadError> {
    let broken = |e: zip::result::ZipError| ReadError::Malformed { format: ".npz", reason: e.to_string() };
    let mut zip = zip::ZipArchive::new(BufReader::new(file)).map_err(broken)?;
    let mut found = Vec::new();
    for index in 0..zip.len() {
        let mut member = zip.by_index(index).map_err(broken)?;
        let name = member.name().trim_end_matches(".npy").to_owned();
        let plain = member.compression() == zip::CompressionMethod::Stored;
        let (start, size) = (member.data_start(), member.size());
        // What is no array is not a part of a scene either.
        let Ok((header, length)) = npy::read_header(&mut member) else { continue };
        if size - length.min(size) < header.bytes() {
            return Err(header.cut_short(size - length.min(size)));
        }
        let place = if plain { Place::At(start + length) } else { Place::Packed(index) };
        found.push((name, Stored { path: path.to_owned(), place, header }));
    }
    Ok(found)
}

/// As much as there is.
fn read_some(file: &mut impl Read, mut into: &mut [u8]) -> io::Result<usize> {
    let all = into.len();
    while !into.is_empty() {
        match file.read(into)? {
            0 => break,
            n => into = &mut into[n..],
        }
    }
    Ok(all - into.len())
}

impl Stored {
    /// The array's shape, as [`Array::shape`] of the whole would be.
    pub fn shape(&self) -> &[usize] {
        &self.header.shape
    }

    /// Whether parts of it can be read.
    pub fn in_parts(&self) -> bool {
        !matches!(self.place, Place::Whole)
    }

    /// Bytes of a sample once it is read.
    pub fn sample_bytes(&self) -> usize {
        self.header.stored.decoded_size()
    }

    /// Makes a packed member of an archive one of which parts can be read: unpacks it to a file in `folder`.
    ///
    /// # Errors
    /// The operating system's, and damaged data.
    pub fn unpack(&mut self, folder: &Path) -> Result<(), FileError> {
        let Place::Packed(index) = self.place else { return Ok(()) };
        let error = |e| FileError::new(&self.path, e);
        let broken = |e: zip::result::ZipError| error(ReadError::Malformed { format: ".npz", reason: e.to_string() });
        let file = File::open(&self.path).map_err(|e| error(ReadError::Io(e)))?;
        let mut zip = zip::ZipArchive::new(BufReader::new(file)).map_err(broken)?;
        let mut member = zip.by_index(index).map_err(broken)?;
        npy::read_header(&mut member).map_err(error)?;
        let mut unpacked = tempfile::tempfile_in(folder).map_err(|e| FileError::new(folder, ReadError::Io(e)))?;
        let wanted = self.header.bytes();
        let copied = io::copy(&mut member.by_ref().take(wanted), &mut unpacked);
        // The checksum of a member is compared at its end.
        let found = copied.and_then(|found| io::copy(&mut member, &mut io::sink()).map(|_| found));
        let damaged = |e: &io::Error| {
            matches!(e.kind(), ErrorKind::InvalidData | ErrorKind::InvalidInput | ErrorKind::UnexpectedEof)
        };
        let found = found.map_err(|e| match damaged(&e) {
            true => error(ReadError::Malformed { format: ".npz", reason: e.to_string() }),
            false => error(ReadError::Io(e)),
        })?;
        if found < wanted {
            return Err(error(self.header.cut_short(found)));
        }
        self.place = Place::Unpacked(Arc::new(Mutex::new(unpacked)));
        Ok(())
    }

    /// The part of the array within a range of each axis.
    ///
    /// # Errors
    /// The operating system's, and damaged data.
    ///
    /// # Panics
    /// If the ranges are not within the shape, it is packed ([`Stored::unpack`] comes first), or parts of it cannot be read.
    pub fn read(&self, ranges: &[Range<usize>]) -> Result<Array, FileError> {
        assert_eq!(ranges.len(), self.header.shape.len(), "a range for each axis");
        let inside = |(range, &length): (&Range<usize>, &usize)| range.start <= range.end && range.end <= length;
        assert!(ranges.iter().zip(&self.header.shape).all(inside), "ranges within the array");
        self.read_part(ranges).map_err(|e| FileError::new(&self.path, e))
    }

    fn read_part(&self, ranges: &[Range<usize>]) -> Result<Array, ReadError> {
        let raw = match &self.place {
            Place::Dataset(name) => return hdf5::read_part(&self.path, name, ranges),
            Place::At(start) => File::open(&self.path).and_then(|file| self.picked(ranges, *start, file)),
            // Whoever held it last reads from a place of his own.
            Place::Unpacked(file) => self.picked(ranges, 0, &mut *file.lock().unwrap_or_else(PoisonError::into_inner)),
            Place::Packed(_) | Place::Whole => panic!("a packed member is unpacked before it is read"),
        };
        let shape = ranges.iter().map(ExactSizeIterator::len).collect();
        // What is asked for is what memory there is for.
        self.header.decode(shape, raw.map_err(ReadError::Io)?, &mut Budget::for_file(usize::MAX))
    }

    /// The bytes of a part, in the order of the file, in which the array begins at `start`.
    fn picked(&self, ranges: &[Range<usize>], start: u64, file: impl Read + Seek) -> io::Result<Vec<u8>> {
        let mut axes: Vec<(usize, Range<usize>)> =
            self.header.shape.iter().copied().zip(ranges.iter().cloned()).collect();
        if self.header.fortran {
            axes.reverse();
        }
        let mut file = BufReader::with_capacity(1 << 20, file);
        file.seek(SeekFrom::Start(start))?;
        let size = self.header.sample();
        let mut raw = Vec::with_capacity(size * ranges.iter().map(ExactSizeIterator::len).product::<usize>());
        let mut at = 0;
        for run in runs(&axes) {
            let (start, length) = (run.start * size, run.len() * size);
            // Keeps what the buffer holds.
            file.seek_relative((start - at) as i64)?;
            let old = raw.len();
            raw.resize(old + length, 0);
            file.read_exact(&mut raw[old..])?;
            at = start + length;
        }
        Ok(raw)
    }
}

/// The runs of neighbouring samples of a part, in their order; an axis is its length and the range that is wanted.
fn runs(axes: &[(usize, Range<usize>)]) -> impl Iterator<Item = Range<usize>> {
    // Axes after the last that is not wanted whole are read in one go.
    let last = axes.iter().rposition(|(length, range)| range.len() != *length).unwrap_or(0);
    let inner: usize = axes.iter().skip(last + 1).map(|(length, _)| length).product();
    let outer = &axes[..last.min(axes.len())];
    let whole = (1, 0..1);
    let (length, range) = axes.get(last).cloned().unwrap_or(whole);
    let count: usize = outer.iter().map(|(_, range)| range.len()).product();
    (0..count).map(move |mut run| {
        let (mut place, mut stride) = (0, 1);
        for (length, range) in outer.iter().rev() {
            place += (range.start + run % range.len()) * stride;
            (run, stride) = (run / range.len(), stride * length);
        }
        (place * length + range.start) * inner..(place * length + range.end) * inner
    })
}

impl Samples {
    /// The part within a range of each axis of an array of this shape.
    #[cfg(test)]
    fn part(&self, shape: &[usize], ranges: &[Range<usize>]) -> Vec<f32> {
        let axes: Vec<_> = shape.iter().copied().zip(ranges.iter().cloned()).collect();
        runs(&axes).flatten().map(|i| self.at(i)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array3, ShapeBuilder, s};
    use ndarray_npy::{NpzWriter, WriteNpyExt};

    fn ramp() -> Array3<f32> {
        Array3::from_shape_fn((4, 5, 6), |(t, y, x)| (100 * t + 10 * y + x) as f32)
    }

    fn expected() -> Vec<f32> {
        ramp().slice(s![1..3, 2..5, ..]).iter().copied().collect()
    }

    fn check(stored: &Stored, folder: &Path) {
        let mut stored = stored.clone();
        stored.unpack(folder).unwrap();
        assert_eq!(stored.shape(), [4, 5, 6]);
        let part = stored.read(&[1..3, 2..5, 0..6]).unwrap();
        assert_eq!((part.shape(), part.samples()), (&[2, 3, 6][..], &Samples::Floats(expected())));
        let whole = stored.read(&[0..4, 0..5, 0..6]).unwrap();
        assert_eq!(whole.samples(), &Samples::Floats(ramp().iter().copied().collect()));
    }

    #[test]
    fn parts_of_npy_in_both_orders_and_of_archives_plain_and_packed() {
        let dir = tempfile::tempdir().unwrap();
        let mut fortran = Array3::zeros((4, 5, 6).f());
        fortran.assign(&ramp());
        for (name, array) in [("c.npy", ramp()), ("fortran.npy", fortran.clone())] {
            let path = dir.path().join(name);
            array.write_npy(File::create(&path).unwrap()).unwrap();
            check(&arrays(&path).unwrap().unwrap().named[0].1, dir.path());
        }
        let path = dir.path().join("a.npz");
        for packed in [false, true] {
            let file = File::create(&path).unwrap();
            let mut npz = if packed { NpzWriter::new_compressed(file) } else { NpzWriter::new(file) };
            npz.add_array("other", &(ramp() * 2.0)).unwrap();
            npz.add_array("mask", &fortran).unwrap();
            npz.finish().unwrap();
            let found = arrays(&path).unwrap().unwrap().named;
            assert_eq!(found.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>(), ["other", "mask"]);
            check(&found[1].1, dir.path());
            assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 3, "nothing is left of what was unpacked");
        }
        let found = arrays(dir.path()).unwrap().unwrap().named;
        assert_eq!(found.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>(), ["c", "fortran"]);
    }

    #[test]
    fn parts_of_hdf5_and_of_matlab_v7_3() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.h5");
        let bytes: Vec<u8> = (0..120).collect();
        let mut b = hdf5_pure::FileBuilder::new();
        b.create_dataset("mask").with_u8_data(&bytes).with_shape(&[4, 5, 6]).with_chunks(&[2, 2, 6]).with_deflate(6);
        b.create_dataset("meas").with_f64_data(&[0.5; 30]).with_shape(&[5, 6]);
        std::fs::write(&path, b.finish().unwrap()).unwrap();
        let found = arrays(&path).unwrap().unwrap().named;
        let mask = &found.iter().find(|(name, _)| name == "mask").unwrap().1;
        assert_eq!((mask.shape(), mask.sample_bytes()), (&[4, 5, 6][..], 1));
        let part = mask.read(&[1..3, 2..5, 0..6]).unwrap();
        let expected = Samples::Bytes(bytes.clone()).part(&[4, 5, 6], &[1..3, 2..5, 0..6]);
        assert_eq!(part.samples(), &Samples::Bytes(expected.iter().map(|&v| v as u8).collect()));
        let meas = &found.iter().find(|(name, _)| name == "meas").unwrap().1;
        assert_eq!(meas.read(&[0..2, 3..6]).unwrap().samples(), &Samples::Floats(vec![0.5; 6]));
    }

    #[test]
    fn what_is_cut_short_is_an_error() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.npy");
        let mut bytes = Vec::new();
        ramp().write_npy(&mut bytes).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() - 1]).unwrap();
        let error = arrays(&path).unwrap_err().to_string();
        assert!(error.contains("cut short") && error.contains("a.npy"), "{error}");
        std::fs::write(&path, "no array").unwrap();
        assert!(arrays(&path).unwrap().is_none());
    }
}
