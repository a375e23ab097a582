//! Owns HDF5 files, read through `hdf5-reader` with its limits set to the [`Budget`]: MATLAB's v7.3 and those of everyone else.
//!
//! Both store row-major arrays. MATLAB, column-major itself, stores a variable of size `[H, W, T]` as shape `[T, W, H]`; other
//! programs store the shape that they mean. What MATLAB wrote says so, in a block before the HDF5 data and in attributes.

use std::ops::Range;
use std::path::Path;

use hdf5_reader::error::{ByteOrder, Error};
use hdf5_reader::filters::FilterRegistry;
use hdf5_reader::group::Group;
use hdf5_reader::messages::datatype::{CompoundField, Datatype, ReferenceType};
use hdf5_reader::{Dataset, Hdf5File, OpenOptions, SliceInfo, SliceInfoElem};

use super::npy::Header;
use super::samples::{Array, Budget, Endian, SampleType, Samples, element_count};
use super::{NamedArrays, ReadError};

const FORMAT: &str = "HDF5 (.h5, .mat v7.3)";
const SIGNATURE: &[u8] = b"\x89HDF\r\n\x1a\n";
/// The filter that h5py calls `lzf`.
const LZF: u16 = 32000;
/// Groups in groups that are looked into: links may go in circles.
const MAX_DEPTH: usize = 4;
/// Arrays that are looked at, for the same reason.
const MAX_NAMES: usize = 10_000;
/// Where MATLAB keeps the elements of cell arrays.
const CELLS: &str = "#refs#";

/// Whether the bytes open like HDF5, with or without MATLAB's 512 bytes before it.
pub fn is_hdf5(bytes: &[u8]) -> bool {
    [0, 512].iter().any(|&at| bytes.get(at..at + SIGNATURE.len()) == Some(SIGNATURE))
}

/// Whether MATLAB wrote it, or a program that means to write for MATLAB.
pub fn is_matlab(bytes: &[u8]) -> bool {
    const ATTRIBUTE: &[u8] = b"MATLAB_class";
    bytes.starts_with(b"MATLAB") || bytes.windows(ATTRIBUTE.len()).any(|w| w == ATTRIBUTE)
}

fn bad(reason: impl std::fmt::Display) -> ReadError {
    ReadError::Malformed { format: FORMAT, reason: reason.to_string() }
}

/// Reads the arrays named in `wanted` (others are only listed). Members of groups and structs are named `group.member`.
///
/// # Errors
/// [`ReadError`] for damaged bytes, or a wanted array that is not of real numbers or would not fit the budget.
pub fn read(bytes: &[u8], wanted: &[&str]) -> Result<NamedArrays, ReadError> {
    let mut budget = Budget::for_file(bytes.len());
    let file = Hdf5File::from_bytes_with_options(bytes, options(budget.left())).map_err(bad)?;
    let root = file.root_group().map_err(bad)?;
    let mut found = NamedArrays::default();
    list(&root, "", MAX_DEPTH, &mut found.names)?;
    for &name in wanted {
        // Paths are written with slashes elsewhere.
        let dotted = name.trim_start_matches('/').replace('/', ".");
        if !found.names.contains(&dotted) {
            continue;
        }
        let data = open(&root, &dotted)?;
        let array = read_dataset(&root, &data, name, &mut budget)?;
        found.arrays.insert(name.to_owned(), array);
    }
    Ok(found)
}

/// How files are opened, so that nothing in one takes more than `limit` bytes.
fn options(limit: usize) -> OpenOptions {
    let mut filters = FilterRegistry::new();
    filters.register(LZF, Box::new(move |filter, data, _| unpack_lzf(&filter.client_data, data, limit)));
    OpenOptions::default()
        .with_max_read_bytes(limit)
        .with_max_chunk_bytes(limit)
        // Every dataset is read once, so nothing is worth keeping.
        .with_chunk_cache_bytes(0)
        .with_filter_registry(filters)
        .with_max_object_header_bytes(1 << 20)
}

/// A file on disk, and the limit of what may be read of it at once.
fn open_file(path: &Path) -> Result<Hdf5File, ReadError> {
    let length = std::fs::metadata(path).map_err(ReadError::Io)?.len();
    let limit = Budget::for_file(usize::try_from(length).unwrap_or(usize::MAX)).left();
    Hdf5File::open_with_options(path, options(limit)).map_err(bad)
}

/// An array's name, shape and type, and whether parts of it can be read.
pub(super) type Found = (String, Header, bool);

/// The arrays of plain real numbers in a file, and whether MATLAB wrote them.
///
/// # Errors
/// [`ReadError`] for damaged bytes.
pub(super) fn headers(path: &Path) -> Result<(Vec<Found>, bool), ReadError> {
    let file = open_file(path)?;
    let root = file.root_group().map_err(bad)?;
    let mut names = Vec::new();
    list(&root, "", MAX_DEPTH, &mut names)?;
    let (mut found, mut of_matlab) = (Vec::new(), false);
    for name in names {
        let data = open(&root, &name)?;
        of_matlab |= data.attribute("MATLAB_class").is_ok();
        let Some((kind, _, 1)) = numbers(data.dtype()) else { continue };
        let shape: Option<Vec<usize>> = data.shape().iter().map(|&d| usize::try_from(d).ok()).collect();
        if let Some(shape) = shape.filter(|shape| element_count(shape).is_some()) {
            let in_parts = kind != SampleType::F16 && !matches!(data.dtype(), Datatype::Enum { .. });
            found.push((name, Header::plain(shape, kind), in_parts));
        }
    }
    Ok((found, of_matlab))
}

/// The part of an array from [`headers`] within a range of each axis.
///
/// # Errors
/// [`ReadError`] for damaged bytes.
pub(super) fn read_part(path: &Path, name: &str, ranges: &[Range<usize>]) -> Result<Array, ReadError> {
    let file = open_file(path)?;
    let data = open(&file.root_group().map_err(bad)?, name)?;
    let slice = |r: &Range<usize>| SliceInfoElem::Slice { start: r.start as u64, end: r.end as u64, step: 1 };
    let part = SliceInfo { selections: ranges.iter().map(slice).collect() };
    let shape = ranges.iter().map(ExactSizeIterator::len).collect();
    let (kind, ..) = numbers(data.dtype()).ok_or(ReadError::NotNumeric { key: name.into(), what: "not numbers" })?;
    macro_rules! floats {
        ($t:ty) => {
            Samples::Floats(data.read_slice::<$t>(&part).map_err(bad)?.iter().map(|&v| v as f32).collect())
        };
    }
    let samples = match kind {
        SampleType::U8 => Samples::Bytes(data.read_slice::<u8>(&part).map_err(bad)?.into_iter().collect()),
        SampleType::I8 => floats!(i8),
        SampleType::I16 => floats!(i16),
        SampleType::U16 => floats!(u16),
        SampleType::I32 => floats!(i32),
        SampleType::U32 => floats!(u32),
        SampleType::I64 => floats!(i64),
        SampleType::U64 => floats!(u64),
        SampleType::F32 => floats!(f32),
        SampleType::F64 => floats!(f64),
        SampleType::F16 => return Err(bad(format!("`{name}`: parts of arrays of 16-bit floats cannot be read"))),
    };
    Array::new(shape, samples, kind)
}

/// The names of all datasets, a group's after those beside it.
fn list(group: &Group, prefix: &str, depth: usize, names: &mut Vec<String>) -> Result<(), ReadError> {
    let (groups, datasets) = group.member_names().map_err(bad)?;
    names.extend(datasets.iter().map(|name| format!("{prefix}{name}")));
    for name in groups.iter().filter(|name| depth > 1 && !name.starts_with('#')) {
        if names.len() > MAX_NAMES {
            return Err(bad(format!("more than {MAX_NAMES} arrays")));
        }
        list(&group.group(name).map_err(bad)?, &format!("{prefix}{name}."), depth - 1, names)?;
    }
    Ok(())
}

/// The dataset of a name from [`list`]; a dot may be part of a name too.
fn open(root: &Group, dotted: &str) -> Result<Dataset, ReadError> {
    let mut group = root.clone();
    let mut rest = dotted;
    loop {
        let (groups, datasets) = group.member_names().map_err(bad)?;
        if datasets.iter().any(|name| name == rest) {
            return group.dataset(rest).map_err(bad);
        }
        let inner =
            |name: &String| rest.strip_prefix(name.as_str())?.strip_prefix('.').map(|rest| (name.clone(), rest));
        let Some((name, inner)) = groups.iter().find_map(inner) else {
            return Err(bad(format!("`{dotted}` is listed but not there")));
        };
        group = group.group(&name).map_err(bad)?;
        rest = inner;
    }
}

fn read_dataset(root: &Group, data: &Dataset, name: &str, budget: &mut Budget) -> Result<Array, ReadError> {
    if matches!(data.dtype(), Datatype::Reference { ref_type: ReferenceType::Object, size: 8 }) {
        return read_cells(root, data, name, budget);
    }
    let not_numeric = |what| ReadError::NotNumeric { key: name.to_owned(), what };
    let (kind, endian, parts) = numbers(data.dtype()).ok_or_else(|| not_numeric("not numbers"))?;
    let shape: Vec<usize> = data.shape().iter().map(|&d| usize::try_from(d).unwrap_or(usize::MAX)).collect();
    let count = element_count(&shape).and_then(|n| n.checked_mul(parts)).unwrap_or(usize::MAX);
    // Bytes are handed on as they are; anything else is there twice while it is converted, complex numbers three times.
    let converted = if kind == SampleType::U8 { 0 } else { 2 * parts * kind.decoded_size() - kind.decoded_size() };
    budget.claim(count / parts, kind.size() * parts + converted)?;
    let raw = data.read_raw_bytes().map_err(bad)?;
    let samples = Samples::decode(raw, kind, endian);
    let samples = match parts {
        1 => samples,
        _ => samples.real_parts().ok_or_else(|| not_numeric("complex, with imaginary parts that are not zero"))?,
    };
    Array::new(shape, samples, kind)
}

/// The type of a number's parts, their order of bytes, and how many there are: two in a complex number.
fn numbers(kind: &Datatype) -> Option<(SampleType, Endian, usize)> {
    let order = |o: &ByteOrder| if *o == ByteOrder::LittleEndian { Endian::Little } else { Endian::Big };
    Some(match kind {
        Datatype::FixedPoint { size, signed, byte_order } => {
            let kind = match (size, signed) {
                (1, false) => SampleType::U8,
                (1, true) => SampleType::I8,
                (2, false) => SampleType::U16,
                (2, true) => SampleType::I16,
                (4, false) => SampleType::U32,
                (4, true) => SampleType::I32,
                (8, false) => SampleType::U64,
                (8, true) => SampleType::I64,
                _ => return None,
            };
            (kind, order(byte_order), 1)
        }
        Datatype::FloatingPoint { size, byte_order } => {
            let kind = match size {
                2 => SampleType::F16,
                4 => SampleType::F32,
                8 => SampleType::F64,
                _ => return None,
            };
            (kind, order(byte_order), 1)
        }
        // h5py stores booleans as names of small integers.
        Datatype::Enum { base, .. } => numbers(base).filter(|n| n.2 == 1)?,
        Datatype::Compound { size, fields } => complex(*size as usize, fields)?,
        _ => return None,
    })
}

/// Two numbers of a type, one after the other, are a complex one, whatever they are called.
fn complex(size: usize, fields: &[CompoundField]) -> Option<(SampleType, Endian, usize)> {
    let [real, imaginary] = fields else { return None };
    let part = numbers(&real.datatype).filter(|n| n.2 == 1)?;
    let packed = real.byte_offset == 0 && imaginary.byte_offset as usize == part.0.size() && size == 2 * part.0.size();
    // A byte is decoded as it is and cannot be told from its neighbour then.
    let legal = packed && numbers(&imaginary.datatype)? == part && part.0 != SampleType::U8;
    legal.then_some((part.0, part.1, 2))
}

/// The elements of a cell array, all of one size: MATLAB's `[H, W]` of N cells becomes `[N, W, H]`.
fn read_cells(root: &Group, cells: &Dataset, name: &str, budget: &mut Budget) -> Result<Array, ReadError> {
    let count = usize::try_from(cells.num_elements().map_err(bad)?).unwrap_or(usize::MAX);
    budget.claim(count, 8)?;
    let addresses = cells.read_raw_bytes().map_err(bad)?;
    let (addresses, _) = addresses.as_chunks();
    let stored = root.group(CELLS).and_then(|g| g.datasets()).map_err(bad)?;
    let frames = addresses.iter().map(|&address| {
        let address = u64::from_le_bytes(address);
        let cell = stored.iter().find(|d| d.address() == address);
        let cell =
            cell.ok_or_else(|| ReadError::NotNumeric { key: name.to_owned(), what: "a cell array of no arrays" })?;
        if matches!(cell.dtype(), Datatype::Reference { .. }) {
            return Err(ReadError::NotNumeric { key: name.to_owned(), what: "a cell array of cell arrays" });
        }
        read_dataset(root, cell, name, budget)
    });
    Array::stacked(name, frames)
}

/// Unpacks what LZF packed. The format has no header: a byte below 32 is one less than the number of plain bytes that follow; any
/// other begins a repetition of what came out before.
fn unpack_lzf(client_data: &[u32], packed: &[u8], limit: usize) -> Result<Vec<u8>, Error> {
    let damaged = || Error::InvalidData("damaged LZF data".into());
    // h5py writes the size of a chunk as the third number; it need not be there.
    let expected = client_data.get(2).map_or(limit, |&n| (n as usize).min(limit));
    let mut out: Vec<u8> = Vec::new();
    let mut rest = packed.iter().copied();
    while let Some(control) = rest.next() {
        let control = usize::from(control);
        if control < 32 {
            for _ in 0..=control {
                out.push(rest.next().ok_or_else(damaged)?);
            }
        } else {
            let mut next = || rest.next().map(usize::from).ok_or_else(damaged);
            let length = if control >> 5 == 7 { 7 + next()? } else { control >> 5 } + 2;
            let back = ((control & 31) << 8) + next()? + 1;
            let from = out.len().checked_sub(back).ok_or_else(damaged)?;
            for at in from..from + length {
                out.push(out[at]);
            }
        }
        if out.len() > expected {
            return Err(damaged());
        }
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use hdf5_pure::FileBuilder;
    use hdf5_pure::mat::{MatBuilder, Options};

    /// The arrays of a file, with some bytes cut off or turned round to see that it does no harm.
    fn found(bytes: &[u8], wanted: &[&str]) -> NamedArrays {
        for at in (0..bytes.len()).step_by(13) {
            let mut damaged = bytes.to_vec();
            damaged[at] ^= 0xff;
            let _ = read(&damaged, wanted);
            let _ = read(&bytes[..at], wanted);
        }
        read(bytes, wanted).unwrap()
    }

    #[test]
    fn every_type_of_number_in_a_plain_file() {
        let mut b = FileBuilder::new();
        b.create_dataset("mask").with_u8_data(&[0, 1, 1, 0, 1, 0]).with_shape(&[1, 2, 3]);
        b.create_dataset("meas").with_f64_data(&[0.5; 6]).with_shape(&[1, 2, 3]);
        b.create_dataset("deep").with_u16_data(&[7, 4095]).with_shape(&[2]);
        let bytes = b.finish().unwrap();
        assert!(is_hdf5(&bytes) && !is_matlab(&bytes));
        let found = found(&bytes, &["mask", "meas", "deep"]);
        assert_eq!(found.arrays["mask"].shape(), [1, 2, 3]);
        assert_eq!(found.arrays["mask"].samples(), &Samples::Bytes(vec![0, 1, 1, 0, 1, 0]));
        assert_eq!(found.arrays["meas"].samples().at(3), 0.5);
        assert_eq!(found.arrays["deep"].stored(), SampleType::U16);
    }

    #[test]
    fn members_of_groups_have_dotted_names() {
        let mut b = FileBuilder::new();
        let mut group = b.create_group("data");
        group.create_dataset("mask").with_u8_data(&[1, 0]).with_shape(&[2]);
        b.add_group(group.finish());
        b.create_dataset("other").with_u8_data(&[3]).with_shape(&[1]);
        let bytes = b.finish().unwrap();
        let found = found(&bytes, &["data.mask"]);
        assert_eq!(found.names, ["other", "data.mask"]);
        assert_eq!(found.arrays["data.mask"].samples(), &Samples::Bytes(vec![1, 0]));
        assert_eq!(read(&bytes, &["data/mask"]).unwrap().arrays["data/mask"], found.arrays["data.mask"]);
    }

    #[test]
    fn structs_cells_and_complex_numbers_of_matlab() {
        let mut b = MatBuilder::new(Options::default());
        b.struct_("data", |s| s.write_f64("mask", &[2, 1], &[1.0, 2.0]).map(drop)).unwrap();
        b.cell("frames", &[1, 2], |c| c.push_u8(&[2, 1], &[1, 2])?.push_u8(&[2, 1], &[3, 4]).map(drop)).unwrap();
        b.cell("uneven", &[1, 2], |c| c.push_u8(&[2, 1], &[1, 2])?.push_u8(&[1, 1], &[3]).map(drop)).unwrap();
        b.write_complex_f64("meas", &[2, 1], &[(5.0, 0.0), (6.0, 0.0)]).unwrap();
        b.write_complex_f64("wave", &[1, 1], &[(5.0, 1.0)]).unwrap();
        b.write_char("text", "words").unwrap();
        let bytes = b.finish().unwrap();
        assert!(is_hdf5(&bytes) && is_matlab(&bytes));
        let found = found(&bytes, &["data.mask", "frames", "meas"]);
        assert_eq!(found.arrays["data.mask"].samples(), &Samples::Floats(vec![1.0, 2.0]));
        assert_eq!(found.arrays["frames"].shape(), [2, 1, 2]);
        assert_eq!(found.arrays["frames"].samples(), &Samples::Bytes(vec![1, 2, 3, 4]));
        assert_eq!(found.arrays["meas"].samples(), &Samples::Floats(vec![5.0, 6.0]));
        for (name, part) in [("uneven", "of one size"), ("wave", "imaginary parts")] {
            let error = read(&bytes, &[name]).unwrap_err().to_string();
            assert!(error.contains(part) && error.contains(name), "{error}");
        }
    }

    #[test]
    fn lzf_of_h5py() {
        let data: Vec<u8> = (0..4096u32).map(|i| (i % 64 / 7) as u8).collect();
        let mut b = FileBuilder::new();
        b.create_dataset("mask").with_u8_data(&data).with_shape(&[64, 64]).with_chunks(&[32, 64]).with_lzf();
        let bytes = b.finish().unwrap();
        assert!(bytes.len() < 4096, "it is packed");
        assert_eq!(found(&bytes, &["mask"]).arrays["mask"].samples(), &Samples::Bytes(data));
    }

    #[test]
    fn a_packed_bomb_is_refused() {
        // Repetitions of 264 bytes for three.
        let packed: Vec<u8> = [0, 9].into_iter().chain((0..1000).flat_map(|_| [0xe0, 0xff, 0])).collect();
        assert_eq!(unpack_lzf(&[], &packed, 1 << 20).unwrap().len(), 264_001);
        assert!(unpack_lzf(&[4, 0, 1000], &packed, 1 << 20).is_err());
        assert!(unpack_lzf(&[], &packed, 1000).is_err());
        assert!(unpack_lzf(&[], &[0xe0, 0xff, 0], 1000).is_err());
    }
}
