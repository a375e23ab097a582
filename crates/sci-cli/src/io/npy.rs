//! Owns NumPy's `.npy` and `.npz`.
//!
//! Writing goes through `ndarray-npy`. Reading does not: that crate allocates what a header declares before it looks at
//! how many bytes follow, and needs the number type to be known beforehand. The header is one line of three keys.
//!
//! Source: the `.npy` format, versions 1.0 to 3.0, `numpy.lib.format`.

use std::io::{Read, Seek, SeekFrom, Write};
use std::ops::Range;

use ndarray::{ArrayViewD, Data, Dimension};
use ndarray_npy::{NpzWriter, WriteNpyError, WriteNpyExt, WriteNpzError};

use super::samples::{Array, Budget, Endian, SampleType, Samples, element_count};
use super::{NamedArrays, ReadError};

const MAGIC: &[u8] = b"\x93NUMPY";
const FORMAT: &str = ".npy";
/// Longest header accepted; NumPy's own limit is 10 000 characters.
const MAX_HEADER: usize = 10_000;

/// Whether the bytes open like an `.npy` file.
pub fn is_npy(bytes: &[u8]) -> bool {
    bytes.starts_with(MAGIC)
}

/// Whether the bytes open like an `.npz` file (a zip archive).
pub fn is_npz(bytes: &[u8]) -> bool {
    bytes.starts_with(b"PK\x03\x04") || bytes.starts_with(b"PK\x05\x06")
}

fn bad(reason: impl Into<String>) -> ReadError {
    ReadError::Malformed { format: FORMAT, reason: reason.into() }
}

/// Reads one array of any real number type, either byte order, C or Fortran order.
///
/// # Errors
/// [`ReadError`] if the header is not a NumPy header, the type is not a real number, or fewer bytes follow than the
/// shape needs.
pub fn read_npy(bytes: &[u8]) -> Result<Array, ReadError> {
    let layout = layout(bytes)?;
    let raw = bytes[layout.data].to_vec();
    layout.header.decode(layout.header.shape.clone(), raw, &mut Budget::for_file(bytes.len()))
}

/// What a header says of an array.
#[derive(Clone, Debug)]
pub(super) struct Header {
    pub(super) shape: Vec<usize>,
    pub(super) stored: SampleType,
    endian: Endian,
    /// Numbers of a sample: 2 of a complex one.
    parts: usize,
    pub(super) fortran: bool,
}

/// A header, and where its data lie.
struct Layout {
    header: Header,
    data: Range<usize>,
}

fn layout(bytes: &[u8]) -> Result<Layout, ReadError> {
    let (text, data) = split_header(bytes)?;
    let header = header_of(text)?;
    let needed = usize::try_from(header.bytes()).ok().filter(|&n| n <= data.len());
    let Some(needed) = needed else { return Err(header.cut_short(data.len() as u64)) };
    let start = bytes.len() - data.len();
    Ok(Layout { header, data: start..start + needed })
}

fn header_of(text: &str) -> Result<Header, ReadError> {
    let (stored, endian, parts) = sample_type(quoted(text, "descr")?)?;
    let fortran = match after(text, "fortran_order")? {
        s if s.starts_with("True") => true,
        s if s.starts_with("False") => false,
        _ => return Err(bad("`fortran_order` is neither True nor False")),
    };
    let shape = shape(text)?;
    let bytes = element_count(&shape).and_then(|n| n.checked_mul(parts * stored.size()));
    bytes.ok_or_else(|| bad(format!("shape {shape:?} overflows")))?;
    Ok(Header { shape, stored, endian, parts, fortran })
}

/// The header at the beginning of a file, and how many bytes it takes.
pub(super) fn read_header(file: &mut impl Read) -> Result<(Header, u64), ReadError> {
    let mut bytes = vec![0; 12];
    file.read_exact(&mut bytes).map_err(ReadError::Io)?;
    // A header may be said to end before.
    let missing = header_length(&bytes)?.end.saturating_sub(bytes.len());
    file.take(missing as u64).read_to_end(&mut bytes).map_err(ReadError::Io)?;
    let (text, _) = split_header(&bytes)?;
    Ok((header_of(text)?, bytes.len() as u64))
}

impl Header {
    /// Of real numbers in row-major order that another format decodes.
    pub(super) fn plain(shape: Vec<usize>, stored: SampleType) -> Self {
        Self { shape, stored, endian: Endian::Little, parts: 1, fortran: false }
    }

    /// Bytes of a sample in the file.
    pub(super) fn sample(&self) -> usize {
        self.parts * self.stored.size()
    }

    /// Bytes of all samples.
    pub(super) fn bytes(&self) -> u64 {
        (self.shape.iter().product::<usize>() * self.sample()) as u64
    }

    pub(super) fn cut_short(&self, found: u64) -> ReadError {
        let Self { shape, .. } = self;
        bad(format!("cut short: shape {shape:?} of {}-byte samples, but {found} bytes of data", self.sample()))
    }

    /// An array of this `shape`, of its bytes. What it needs beside them is claimed.
    pub(super) fn decode(&self, shape: Vec<usize>, raw: Vec<u8>, budget: &mut Budget) -> Result<Array, ReadError> {
        let Self { stored, endian, parts, fortran, .. } = *self;
        let count = raw.len() / self.sample();
        // Complex numbers are there in whole before their real parts are taken out.
        budget.claim(count, (2 * parts - 1) * stored.decoded_size())?;
        let samples = Samples::decode(raw, stored, endian);
        let samples = match parts {
            1 => samples,
            _ => samples.real_parts().ok_or_else(|| bad("complex numbers whose imaginary parts are not all zero"))?,
        };
        let samples = if fortran { to_row_major(&samples, &shape) } else { samples };
        Array::new(shape, samples, stored)
    }
}

fn split_header(bytes: &[u8]) -> Result<(&str, &[u8]), ReadError> {
    let range = header_length(bytes)?;
    let header = bytes.get(range.clone()).ok_or_else(|| bad("cut short inside its header"))?;
    let header = std::str::from_utf8(header).map_err(|_| bad("header is not text"))?;
    Ok((header, &bytes[range.end..]))
}

/// Where the text of a header is, by its first 12 bytes.
fn header_length(bytes: &[u8]) -> Result<Range<usize>, ReadError> {
    let short = || bad("cut short inside its header");
    if !is_npy(bytes) {
        return Err(bad("does not begin with the NumPy magic bytes"));
    }
    let (len, start) = match bytes.get(6).ok_or_else(short)? {
        1 => {
            (usize::from(u16::from_le_bytes([*bytes.get(8).ok_or_else(short)?, *bytes.get(9).ok_or_else(short)?])), 10)
        }
        2 | 3 => {
            let b = bytes.get(8..12).ok_or_else(short)?;
            (u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize, 12)
        }
        v => return Err(bad(format!("version {v}, known are 1 to 3"))),
    };
    if len > MAX_HEADER {
        return Err(bad(format!("header of {len} bytes, at most {MAX_HEADER} are accepted")));
    }
    Ok(start..start + len)
}

/// What follows `'key':` in the header's dictionary.
fn after<'a>(header: &'a str, key: &str) -> Result<&'a str, ReadError> {
    let missing = || bad(format!("header without `{key}`"));
    let at = header.find(&format!("'{key}'")).ok_or_else(missing)?;
    let rest = header[at + key.len() + 2..].trim_start();
    Ok(rest.strip_prefix(':').ok_or_else(missing)?.trim_start())
}

fn quoted<'a>(header: &'a str, key: &str) -> Result<&'a str, ReadError> {
    after(header, key)?
        .strip_prefix('\'')
        .and_then(|s| s.split('\'').next())
        .ok_or_else(|| bad(format!("`{key}` is not a plain type; record arrays are not supported")))
}

fn shape(header: &str) -> Result<Vec<usize>, ReadError> {
    let inner = after(header, "shape")?
        .strip_prefix('(')
        .and_then(|s| s.split_once(')'))
        .ok_or_else(|| bad("`shape` is not a tuple"))?
        .0;
    inner
        .split(',')
        .map(str::trim)
        .filter(|s| !s.is_empty())
        .map(|s| s.parse().map_err(|_| bad(format!("`shape` has the length {s:?}"))))
        .collect()
}

/// The type of a sample, its byte order, and how many make a number: two for complex ones.
fn sample_type(descr: &str) -> Result<(SampleType, Endian, usize), ReadError> {
    let unsupported = || {
        bad(format!(
            "samples of type {descr:?}; supported are bool, integers, 2-, 4- or 8-byte floats and complex numbers of them"
        ))
    };
    let (endian, code) = match descr.split_at_checked(1) {
        Some(("<" | "|" | "=", code)) => (Endian::Little, code),
        Some((">", code)) => (Endian::Big, code),
        _ => return Err(unsupported()),
    };
    let stored = match code {
        "b1" | "u1" => SampleType::U8,
        "i1" => SampleType::I8,
        "i2" => SampleType::I16,
        "u2" => SampleType::U16,
        "i4" => SampleType::I32,
        "u4" => SampleType::U32,
        "i8" => SampleType::I64,
        "u8" => SampleType::U64,
        "f2" => SampleType::F16,
        "f4" | "c8" => SampleType::F32,
        "f8" | "c16" => SampleType::F64,
        _ => return Err(unsupported()),
    };
    Ok((stored, endian, if code.starts_with('c') { 2 } else { 1 }))
}

fn to_row_major(samples: &Samples, shape: &[usize]) -> Samples {
    use ndarray::{ArrayView, IxDyn, ShapeBuilder};
    fn reorder<T: Copy>(v: &[T], shape: &[usize]) -> Vec<T> {
        ArrayView::from_shape(IxDyn(shape).f(), v)
            .expect("the caller decoded exactly as many samples as the shape holds")
            .iter()
            .copied()
            .collect()
    }
    match samples {
        Samples::Bytes(v) => Samples::Bytes(reorder(v, shape)),
        Samples::Floats(v) => Samples::Floats(reorder(v, shape)),
    }
}

/// Reads the arrays named in `wanted` from an `.npz` (others are only listed), which need not be in memory.
///
/// # Errors
/// [`ReadError`] for a broken archive, a broken member, or one that would inflate beyond the file's budget.
pub fn read_npz(mut file: impl Read + Seek, wanted: &[&str]) -> Result<NamedArrays, ReadError> {
    let broken = |e: &dyn std::fmt::Display| ReadError::Malformed { format: ".npz", reason: e.to_string() };
    let length = file.seek(SeekFrom::End(0)).map_err(ReadError::Io)?;
    let mut budget = Budget::for_file(usize::try_from(length).unwrap_or(usize::MAX));
    let mut zip = zip::ZipArchive::new(file).map_err(|e| broken(&e))?;
    let mut found = NamedArrays::default();
    for index in 0..zip.len() {
        let member = zip.by_index(index).map_err(|e| broken(&e))?;
        let name = member.name().trim_end_matches(".npy").to_owned();
        found.names.push(name.clone());
        if !wanted.contains(&name.as_str()) {
            continue;
        }
        let array = read_member(member, &mut budget).map_err(|e| match e {
            ReadError::Malformed { reason, .. } => broken(&format!("`{name}`: {reason}")),
            other => other,
        })?;
        found.arrays.insert(name, array);
    }
    Ok(found)
}

/// One array of an archive. Its bytes count as long as they are there.
fn read_member(member: zip::read::ZipFile<'_, impl Read>, budget: &mut Budget) -> Result<Array, ReadError> {
    let size = budget.holds(usize::try_from(member.size()).unwrap_or(usize::MAX), 1)?;
    let mut raw = Vec::with_capacity(size + 1);
    member.take(size as u64 + 1).read_to_end(&mut raw).map_err(|e| bad(e.to_string()))?;
    if raw.len() > size {
        return Err(bad("longer than its archive says"));
    }
    budget.claim(size, 1)?;
    let layout = layout(&raw)?;
    raw.truncate(layout.data.end);
    raw.drain(..layout.data.start);
    let array = layout.header.decode(layout.header.shape.clone(), raw, budget)?;
    budget.release(size);
    Ok(array)
}

/// Writes one array as `.npy`.
///
/// # Errors
/// The writer's error.
pub fn write_npy<S, D>(w: &mut impl Write, array: &ndarray::ArrayBase<S, D>) -> Result<(), WriteNpyError>
where
    S: Data<Elem = f32>,
    D: Dimension,
{
    array.write_npy(w)
}

/// What an `.npy` file of f32 in row-major order has before its samples.
pub fn header(shape: &[usize]) -> Vec<u8> {
    let lengths: Vec<String> = shape.iter().map(usize::to_string).collect();
    let comma = if shape.len() == 1 { "," } else { "" };
    let text = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({}{comma})}}", lengths.join(", "));
    // Magic, version and length take 10 bytes, a line feed one; all together a multiple of 64.
    let len = (10 + text.len() + 1).next_multiple_of(64) - 10;
    let mut bytes = [MAGIC, &[1, 0], &(len as u16).to_le_bytes(), text.as_bytes()].concat();
    bytes.resize(10 + len - 1, b' ');
    bytes.push(b'\n');
    bytes
}

/// Writes named arrays as an uncompressed `.npz`: masks and video unpack to many times their compressed size, which [`read_npz`]
/// would refuse of a large scene.
///
/// # Errors
/// The writer's error.
pub fn write_npz(w: impl Write + Seek, arrays: &[(&str, ArrayViewD<'_, f32>)]) -> Result<(), WriteNpzError> {
    let mut npz = NpzWriter::new(w);
    for (name, array) in arrays {
        npz.add_array(*name, array)?;
    }
    npz.finish()?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use super::*;
    use ndarray::{Array3, ShapeBuilder};

    fn ramp() -> Array3<f32> {
        Array3::from_shape_fn((2, 3, 4), |(t, y, x)| (100 * t + 10 * y + x) as f32)
    }

    #[test]
    fn the_header_is_the_one_that_arrays_are_written_with() {
        for shape in [vec![3], vec![2, 3], vec![1, 3, 10, 2], vec![1000, 3, 1, 1]] {
            let mut bytes = Vec::new();
            write_npy(&mut bytes, &ndarray::ArrayD::<f32>::zeros(shape.clone())).unwrap();
            assert!(bytes.starts_with(&header(&shape)), "{shape:?}");
            assert_eq!(bytes.len() - header(&shape).len(), 4 * shape.iter().product::<usize>());
        }
    }

    #[test]
    fn npy_round_trip_in_both_orders() {
        let mut fortran = Array3::zeros((2, 3, 4).f());
        fortran.assign(&ramp());
        for array in [ramp(), fortran] {
            let mut bytes = Vec::new();
            write_npy(&mut bytes, &array).unwrap();
            let read = read_npy(&bytes).unwrap();
            assert_eq!(read.shape(), [2, 3, 4]);
            let expected: Vec<f32> = ramp().iter().copied().collect();
            assert_eq!(read.samples(), &Samples::Floats(expected));
        }
    }

    fn file(descr: &str, count: usize, data: &[u8]) -> Vec<u8> {
        let header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({count},), }}");
        [MAGIC, &[1, 0, 118, 0], format!("{header:117}\n").as_bytes(), data].concat()
    }

    #[test]
    fn half_floats_and_complex_without_imaginary_part_are_read() {
        let halves = read_npy(&file("<f2", 2, &[0x00, 0x38, 0x00, 0xc0])).unwrap();
        assert_eq!((halves.samples(), halves.stored()), (&Samples::Floats(vec![0.5, -2.0]), SampleType::F16));
        let pairs: Vec<u8> = [1.5f64, 0.0, 2.5, 0.0].iter().flat_map(|x| x.to_le_bytes()).collect();
        assert_eq!(read_npy(&file("<c16", 2, &pairs)).unwrap().samples(), &Samples::Floats(vec![1.5, 2.5]));
        let pairs: Vec<u8> = [1.5f32, 0.5].iter().flat_map(|x| x.to_le_bytes()).collect();
        let error = read_npy(&file("<c8", 1, &pairs)).unwrap_err().to_string();
        assert!(error.contains("imaginary"), "{error}");
    }

    #[test]
    fn npz_round_trip_reads_only_what_is_wanted() {
        let mut bytes = Cursor::new(Vec::new());
        let (a, b) = (ramp().into_dyn(), ramp().into_dyn() * 2.0);
        write_npz(&mut bytes, &[("mask", a.view()), ("meas", b.view())]).unwrap();
        let found = read_npz(&mut bytes, &["meas"]).unwrap();
        assert_eq!(found.names, ["mask", "meas"]);
        assert_eq!(found.arrays["meas"].samples().at(23), 246.0);
        assert_eq!(found.arrays.len(), 1);
    }

    #[test]
    fn hostile_bytes_give_errors() {
        let mut bytes = Vec::new();
        write_npy(&mut bytes, &ramp()).unwrap();
        for len in 0..bytes.len() {
            assert!(read_npy(&bytes[..len]).is_err(), "{len} bytes");
        }
        for at in 0..160 {
            for value in [0, b'9', b'(', 0x80, 0xff] {
                let mut b = bytes.clone();
                b[at] = value;
                let _ = read_npy(&b);
            }
        }
        let ends_at_once = [MAGIC, &[1, 0, 0, 0, 0, 0]].concat();
        assert!(read_header(&mut ends_at_once.as_slice()).is_err());
        let mut forged = MAGIC.to_vec();
        forged.extend([1, 0, 70, 0]);
        forged
            .extend(format!("{:70}", "{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999, 9), }").bytes());
        let error = read_npy(&forged).unwrap_err().to_string();
        assert!(error.contains("cut short"), "{error}");
    }

    #[test]
    fn damaged_archives_give_errors() {
        let mut plain = Cursor::new(Vec::new());
        write_npz(&mut plain, &[("mask", ramp().into_dyn().view())]).unwrap();
        let mut deflated = NpzWriter::new_compressed(Cursor::new(Vec::new()));
        deflated.add_array("mask", &ramp()).unwrap();
        for bytes in [plain.into_inner(), deflated.finish().unwrap().into_inner()] {
            assert!(read_npz(Cursor::new(&bytes), &["mask"]).is_ok());
            for len in 0..bytes.len() {
                assert!(read_npz(Cursor::new(&bytes[..len]), &["mask"]).is_err(), "{len} bytes");
            }
            for at in 0..bytes.len() {
                let mut b = bytes.clone();
                b[at] ^= 0xff;
                let _ = read_npz(Cursor::new(&b), &["mask"]);
            }
        }
    }

    #[test]
    fn what_unpacks_to_too_much_is_refused_with_the_limit_of_its_file() {
        let mut npz = NpzWriter::new_compressed(Cursor::new(Vec::new()));
        let zeros = Array3::<f32>::zeros((20, 1024, 1024));
        npz.add_array("mask", &zeros).unwrap();
        let bytes = npz.finish().unwrap().into_inner();
        match read_npz(Cursor::new(&bytes), &["mask"]) {
            Err(ReadError::TooLarge { needed, limit }) => {
                assert_eq!(limit, Budget::for_file(bytes.len()).left());
                assert!(needed > limit);
            }
            other => panic!("{other:?}"),
        }
        let mut stored = Cursor::new(Vec::new());
        write_npz(&mut stored, &[("mask", zeros.into_dyn().view())]).unwrap();
        assert!(read_npz(&mut stored, &["mask"]).is_ok(), "our own files are read whatever is in them");
    }
}
