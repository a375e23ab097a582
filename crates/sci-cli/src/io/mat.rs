//! Owns MATLAB files: v5 to v7 (read, plain or zlib-compressed; write, plain) and v7.3 (read, HDF5).
//!
//! The v5 container is read here rather than by a crate: it is a flat list of tagged arrays of which a scene needs
//! four, and the crates at hand either panic on forged type tags or inflate without a bound. Data is inflated straight
//! from the file's bytes, only for the variables asked for, never beyond the [`Budget`]. v7.3 is HDF5 and goes through
//! `hdf5-reader`, with its own limits set to the same budget.
//!
//! MATLAB is column-major and HDF5 stores its axes reversed, so in both a variable of MATLAB size `[H, W, T]` is a
//! row-major array of shape `[T, W, H]`, which is the shape given out here.
//!
//! Source: "MAT-File Format", MathWorks, chapter 1 (level 5 MAT-files).

use std::io::{self, Read, Write};

use flate2::read::ZlibDecoder;
use hdf5_reader::{Hdf5File, OpenOptions, messages::datatype::Datatype};

use super::samples::{Array, Budget, Endian, SampleType, Samples, element_count};
use super::{NamedArrays, ReadError};

const V5: &str = ".mat (v5)";
const V73: &str = ".mat (v7.3)";
const HEADER_LEN: usize = 128;
const HDF5_SIGNATURE: &[u8] = b"\x89HDF\r\n\x1a\n";
const MI_INT8: u32 = 1;
const MI_INT32: u32 = 5;
const MI_UINT32: u32 = 6;
const MI_SINGLE: u32 = 7;
const MI_MATRIX: u32 = 14;
const MI_COMPRESSED: u32 = 15;
const MX_SINGLE: u32 = 7;
/// Longest variable name MATLAB writes is 63 characters; the rest is generosity.
const MAX_NAME: usize = 4096;
const MAX_DIMS: usize = 32;

/// Whether the bytes open like a MATLAB file of either family.
pub fn is_mat(bytes: &[u8]) -> bool {
    is_v73(bytes) || (bytes.len() >= HEADER_LEN && endian_of(bytes).is_some())
}

fn is_v73(bytes: &[u8]) -> bool {
    [0, 512].iter().any(|&at| bytes.get(at..at + 8) == Some(HDF5_SIGNATURE))
}

fn endian_of(bytes: &[u8]) -> Option<Endian> {
    match bytes.get(126..128)? {
        b"IM" => Some(Endian::Little),
        b"MI" => Some(Endian::Big),
        _ => None,
    }
}

/// Reads the variables named in `wanted` (others are only listed), v5, v7 or v7.3.
///
/// # Errors
/// [`ReadError`] for a file that is none of these, is cut short, or holds a wanted variable that is not a real
/// numeric array or would not fit the budget.
pub fn read(bytes: &[u8], wanted: &[&str]) -> Result<NamedArrays, ReadError> {
    let budget = Budget::for_file(bytes.len());
    if is_v73(bytes) { read_v73(bytes, wanted, budget) } else { read_v5(bytes, wanted, budget) }
}

fn bad(reason: impl Into<String>) -> ReadError {
    ReadError::Malformed { format: V5, reason: reason.into() }
}

fn read_v5(bytes: &[u8], wanted: &[&str], mut budget: Budget) -> Result<NamedArrays, ReadError> {
    if bytes.len() < HEADER_LEN {
        return Err(bad(format!("{} bytes are fewer than its {HEADER_LEN}-byte header", bytes.len())));
    }
    let endian = endian_of(bytes)
        .ok_or_else(|| bad("no byte-order mark at byte 126: not a MATLAB file, or an older format than v5"))?;
    let mut found = NamedArrays::default();
    let mut rest = &bytes[HEADER_LEN..];
    while rest.len() >= 8 {
        let (kind, size) = (word(&rest[0..4], endian), word(&rest[4..8], endian) as usize);
        let body = &rest[8..];
        let available = &body[..size.min(body.len())];
        match kind {
            MI_COMPRESSED => {
                let mut inflated = ZlibDecoder::new(available);
                let (kind, _) = tag(&mut inflated, endian)?;
                if kind == MI_MATRIX {
                    read_matrix(&mut inflated, endian, wanted, &mut budget, &mut found)?;
                }
            }
            MI_MATRIX if size > 0 => {
                read_matrix(&mut &available[..], endian, wanted, &mut budget, &mut found)?;
            }
            MI_MATRIX | 1..=18 => {}
            _ => {
                return Err(bad(format!(
                    "element type {kind} at byte {} is not one of 1 to 18",
                    bytes.len() - rest.len()
                )));
            }
        }
        if size > body.len() {
            return Err(bad(format!("cut short: the last variable has {} of its {size} bytes", body.len())));
        }
        // Compressed elements are packed; all others end on a multiple of eight bytes.
        let step = if kind == MI_COMPRESSED { size } else { size.next_multiple_of(8) };
        rest = &body[step.min(body.len())..];
    }
    Ok(found)
}

fn word(bytes: &[u8], endian: Endian) -> u32 {
    let b = [bytes[0], bytes[1], bytes[2], bytes[3]];
    match endian {
        Endian::Little => u32::from_le_bytes(b),
        Endian::Big => u32::from_be_bytes(b),
    }
}

fn cut_short(source: &io::Error) -> ReadError {
    if source.kind() == io::ErrorKind::UnexpectedEof {
        bad("cut short inside a variable")
    } else {
        bad(format!("damaged compressed data ({source})"))
    }
}

fn read_word(r: &mut impl Read, endian: Endian) -> Result<u32, ReadError> {
    let mut b = [0; 4];
    r.read_exact(&mut b).map_err(|e| cut_short(&e))?;
    Ok(word(&b, endian))
}

/// A tag of the normal form: type and byte count.
fn tag(r: &mut impl Read, endian: Endian) -> Result<(u32, usize), ReadError> {
    Ok((read_word(r, endian)?, read_word(r, endian)? as usize))
}

/// A subelement: its type and its bytes, in the normal or the packed ("small") form, padding consumed.
fn subelement(r: &mut impl Read, endian: Endian, limit: usize) -> Result<(u32, Vec<u8>), ReadError> {
    let first = read_word(r, endian)?;
    let small = first >> 16;
    if small != 0 {
        if small > 4 {
            return Err(bad(format!("packed element of {small} bytes, at most 4 fit")));
        }
        let mut b = [0; 4];
        r.read_exact(&mut b).map_err(|e| cut_short(&e))?;
        return Ok((first & 0xffff, b[..small as usize].to_vec()));
    }
    let size = read_word(r, endian)? as usize;
    if size > limit {
        return Err(bad(format!("element of {size} bytes where at most {limit} are possible")));
    }
    let bytes = take(r, size)?;
    // The last subelement of a variable may lack its padding, so a short read here is no error.
    let padding = (size.next_multiple_of(8) - size) as u64;
    io::copy(&mut r.take(padding), &mut io::sink()).map_err(|e| cut_short(&e))?;
    Ok((first, bytes))
}

/// Reads exactly `size` bytes, growing with what really arrives rather than with what a header claims.
fn take(r: &mut impl Read, size: usize) -> Result<Vec<u8>, ReadError> {
    let mut bytes = Vec::new();
    r.take(size as u64).read_to_end(&mut bytes).map_err(|e| cut_short(&e))?;
    if bytes.len() < size {
        return Err(bad(format!("cut short: {} of {size} bytes of a variable", bytes.len())));
    }
    Ok(bytes)
}

fn read_matrix(
    r: &mut impl Read,
    endian: Endian,
    wanted: &[&str],
    budget: &mut Budget,
    found: &mut NamedArrays,
) -> Result<(), ReadError> {
    let (kind, flags) = subelement(r, endian, 8)?;
    if kind != MI_UINT32 || flags.len() != 8 {
        return Err(bad("a variable does not begin with its array flags"));
    }
    let flags = word(&flags[..4], endian);
    let (kind, dims) = subelement(r, endian, 4 * MAX_DIMS)?;
    if kind != MI_INT32 || dims.len() < 8 {
        return Err(bad("a variable without dimensions"));
    }
    let mut shape: Vec<usize> = dims.chunks_exact(4).map(|d| word(d, endian) as usize).collect();
    shape.reverse();
    let (kind, name) = subelement(r, endian, MAX_NAME)?;
    if kind != MI_INT8 {
        return Err(bad("a variable without a name"));
    }
    let name = String::from_utf8_lossy(&name).into_owned();
    found.names.push(name.clone());
    if !wanted.contains(&name.as_str()) {
        return Ok(());
    }
    let class = flags & 0xff;
    if !(6..=15).contains(&class) || flags & 0x0800 != 0 {
        let what = match class {
            1 => "a cell array",
            2 | 3 => "a struct",
            4 => "text",
            5 => "a sparse matrix",
            6..=15 => "complex",
            _ => "of an unknown class",
        };
        return Err(ReadError::NotNumeric { key: name, what });
    }
    let array = read_numbers(r, endian, &name, shape, budget)?;
    found.arrays.insert(name, array);
    Ok(())
}

/// The real part: stored in the smallest type that holds its values, whatever the variable's class.
fn read_numbers(
    r: &mut impl Read,
    endian: Endian,
    name: &str,
    shape: Vec<usize>,
    budget: &mut Budget,
) -> Result<Array, ReadError> {
    let too_many = || bad(format!("`{name}` claims a size of {shape:?} samples"));
    let count = element_count(&shape).ok_or_else(too_many)?;
    let raw_limit = budget.left();
    let (kind, raw) = subelement(r, endian, raw_limit)?;
    let stored = match kind {
        1 => SampleType::I8,
        2 => SampleType::U8,
        3 => SampleType::I16,
        4 => SampleType::U16,
        5 => SampleType::I32,
        6 => SampleType::U32,
        7 => SampleType::F32,
        9 => SampleType::F64,
        12 => SampleType::I64,
        13 => SampleType::U64,
        _ => return Err(bad(format!("`{name}` holds samples of unknown type {kind}"))),
    };
    if Some(raw.len()) != count.checked_mul(stored.size()) {
        return Err(shape_mismatch(name, &shape, raw.len() / stored.size()));
    }
    budget.claim(count, stored.decoded_size())?;
    Array::new(shape, Samples::decode(raw, stored, endian), stored)
}

fn shape_mismatch(name: &str, shape: &[usize], got: usize) -> ReadError {
    let matlab: Vec<_> = shape.iter().rev().collect();
    bad(format!("`{name}` has size {matlab:?} but {got} samples"))
}

fn read_v73(bytes: &[u8], wanted: &[&str], mut budget: Budget) -> Result<NamedArrays, ReadError> {
    let hdf = |e: hdf5_reader::error::Error| ReadError::Malformed { format: V73, reason: e.to_string() };
    let limit = budget.left();
    let options = OpenOptions::default()
        .with_max_read_bytes(limit)
        .with_max_chunk_bytes(limit)
        // Every dataset is read once, so nothing is worth keeping.
        .with_chunk_cache_bytes(0)
        .with_max_object_header_bytes(1 << 20);
    let file = Hdf5File::from_bytes_with_options(bytes, options).map_err(hdf)?;
    let root = file.root_group().map_err(hdf)?;
    let (_, names) = root.member_names().map_err(hdf)?;
    let mut found = NamedArrays::default();
    for name in names {
        found.names.push(name.clone());
        if !wanted.contains(&name.as_str()) {
            continue;
        }
        let data = root.dataset(&name).map_err(hdf)?;
        let shape: Vec<usize> = data.shape().iter().map(|&d| usize::try_from(d).unwrap_or(usize::MAX)).collect();
        let count = element_count(&shape).unwrap_or(usize::MAX);
        let (stored, samples) = read_dataset(&data, &name, count, &mut budget, &hdf)?;
        found.arrays.insert(name, Array::new(shape, samples, stored)?);
    }
    Ok(found)
}

fn read_dataset(
    data: &hdf5_reader::Dataset,
    name: &str,
    count: usize,
    budget: &mut Budget,
    hdf: &impl Fn(hdf5_reader::error::Error) -> ReadError,
) -> Result<(SampleType, Samples), ReadError> {
    macro_rules! floats {
        ($kind:ident, $t:ty) => {{
            budget.claim(count, size_of::<$t>().max(4))?;
            let values = data.read_array::<$t>().map_err(hdf)?;
            (SampleType::$kind, Samples::Floats(values.iter().map(|&v| v as f32).collect()))
        }};
    }
    Ok(match data.dtype() {
        Datatype::FixedPoint { size: 1, signed: false, .. } => {
            budget.claim(count, 1)?;
            let values = data.read_array::<u8>().map_err(hdf)?;
            (SampleType::U8, Samples::Bytes(values.into_iter().collect()))
        }
        Datatype::FixedPoint { size: 1, signed: true, .. } => floats!(I8, i8),
        Datatype::FixedPoint { size: 2, signed: true, .. } => floats!(I16, i16),
        Datatype::FixedPoint { size: 2, signed: false, .. } => floats!(U16, u16),
        Datatype::FixedPoint { size: 4, signed: true, .. } => floats!(I32, i32),
        Datatype::FixedPoint { size: 4, signed: false, .. } => floats!(U32, u32),
        Datatype::FixedPoint { size: 8, signed: true, .. } => floats!(I64, i64),
        Datatype::FixedPoint { size: 8, signed: false, .. } => floats!(U64, u64),
        Datatype::FloatingPoint { size: 4, .. } => floats!(F32, f32),
        Datatype::FloatingPoint { size: 8, .. } => floats!(F64, f64),
        _ => return Err(ReadError::NotNumeric { key: name.to_owned(), what: "not a real numeric array" }),
    })
}

/// One variable to write: its name, its MATLAB size and its samples in column-major order.
#[derive(Clone, Debug)]
pub struct Variable<'a> {
    /// Variable name.
    pub name: &'a str,
    /// MATLAB size, for example `[H, W, T]`.
    pub size: &'a [usize],
    /// Samples, first axis fastest.
    pub data: &'a [f32],
}

/// Writes a v5 file of single-precision variables, uncompressed.
///
/// # Errors
/// The writer's error, or `InvalidInput` if a variable is larger than the 4 GiB the format can hold or its size does
/// not match its data.
pub fn write_v5(w: &mut impl Write, variables: &[Variable<'_>]) -> io::Result<()> {
    write_file_header(w)?;
    for v in variables {
        if element_count(v.size) != Some(v.data.len()) {
            return Err(invalid(v.name, "its size does not match its data"));
        }
        write_variable_header(w, v.name, v.size)?;
        v.data.iter().try_for_each(|x| w.write_all(&x.to_le_bytes()))?;
        w.write_all(padding(4 * v.data.len()))?;
    }
    Ok(())
}

/// Begins a v5 file.
///
/// # Errors
/// The writer's error.
pub fn write_file_header(w: &mut impl Write) -> io::Result<()> {
    let mut header = [b' '; HEADER_LEN];
    let text = b"MATLAB 5.0 MAT-file, written by sci";
    header[..text.len()].copy_from_slice(text);
    header[116..124].fill(0);
    header[124..128].copy_from_slice(b"\x00\x01IM");
    w.write_all(&header)
}

/// Begins a variable of single precision; its samples in column-major order, little-endian, and their [`padding`] have to follow.
///
/// # Errors
/// The writer's error, or `InvalidInput` if the variable is larger than the 4 GiB the format can hold.
pub fn write_variable_header(w: &mut impl Write, name: &str, size: &[usize]) -> io::Result<()> {
    let words: Option<Vec<u32>> = size.iter().map(|&d| i32::try_from(d).ok().map(|d| d as u32)).collect();
    let dims = words.ok_or_else(|| invalid(name, "an axis is too long for a .mat v5 file"))?;
    let padded = |n: usize| n.next_multiple_of(8);
    let too_large = || invalid(name, "more than the 4 GiB a .mat v5 variable holds; use npy");
    let data_len = element_count(size).and_then(|n| n.checked_mul(4)).ok_or_else(too_large)?;
    let body = 16 + 8 + padded(4 * dims.len()) + 8 + padded(name.len()) + 8 + padded(data_len);
    let body = u32::try_from(body).map_err(|_| too_large())?;
    let put = |w: &mut dyn Write, kind: u32, bytes: &[u8]| -> io::Result<()> {
        w.write_all(&kind.to_le_bytes())?;
        w.write_all(&(bytes.len() as u32).to_le_bytes())?;
        w.write_all(bytes)?;
        w.write_all(padding(bytes.len()))
    };
    w.write_all(&MI_MATRIX.to_le_bytes())?;
    w.write_all(&body.to_le_bytes())?;
    put(w, MI_UINT32, &[MX_SINGLE.to_le_bytes(), [0; 4]].concat())?;
    put(w, MI_INT32, &dims.iter().flat_map(|d| d.to_le_bytes()).collect::<Vec<_>>())?;
    put(w, MI_INT8, name.as_bytes())?;
    w.write_all(&MI_SINGLE.to_le_bytes())?;
    w.write_all(&(data_len as u32).to_le_bytes())
}

/// The zeros after `len` bytes of data.
pub fn padding(len: usize) -> &'static [u8] {
    &[0; 8][..len.next_multiple_of(8) - len]
}

fn invalid(name: &str, reason: &str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidInput, format!("`{name}`: {reason}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(variables: &[Variable<'_>]) -> Vec<u8> {
        let mut bytes = Vec::new();
        write_v5(&mut bytes, variables).unwrap();
        bytes
    }

    fn sample() -> Vec<u8> {
        let data: Vec<f32> = (0..24).map(|i| i as f32).collect();
        file(&[
            Variable { name: "other", size: &[1, 1], data: &[5.0] },
            Variable { name: "orig", size: &[2, 3, 4], data: &data },
        ])
    }

    /// The same elements, each wrapped in a zlib stream as MATLAB writes them by default.
    fn compressed(plain: &[u8]) -> Vec<u8> {
        let mut out = plain[..HEADER_LEN].to_vec();
        let mut rest = &plain[HEADER_LEN..];
        while !rest.is_empty() {
            let len = 8 + word(&rest[4..8], Endian::Little) as usize;
            let mut z = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::default());
            z.write_all(&rest[..len]).unwrap();
            let z = z.finish().unwrap();
            out.extend(MI_COMPRESSED.to_le_bytes());
            out.extend((z.len() as u32).to_le_bytes());
            out.extend(z);
            rest = &rest[len..];
        }
        out
    }

    #[test]
    fn v5_round_trip_plain_and_compressed() {
        for bytes in [sample(), compressed(&sample())] {
            let found = read(&bytes, &["orig"]).unwrap();
            assert_eq!(found.names, ["other", "orig"]);
            let orig = &found.arrays["orig"];
            assert_eq!(orig.shape(), [4, 3, 2]);
            assert_eq!(orig.samples().at(1), 1.0);
            assert!(!found.arrays.contains_key("other"));
        }
    }

    #[test]
    fn every_truncation_is_an_error_or_a_shorter_list() {
        for bytes in [sample(), compressed(&sample())] {
            for len in 0..bytes.len() {
                if let Ok(found) = read(&bytes[..len], &["orig"]) {
                    assert!(!found.arrays.contains_key("orig"), "{len} bytes");
                }
            }
        }
    }

    #[test]
    fn flipped_bytes_never_panic() {
        for bytes in [sample(), compressed(&sample())] {
            for at in 0..bytes.len() {
                for value in [0, 1, 0x7f, 0x80, 0xff] {
                    let mut b = bytes.clone();
                    b[at] = value;
                    let _ = read(&b, &["orig", "other"]);
                }
            }
        }
    }

    #[test]
    fn a_bomb_is_refused() {
        // 256 MiB of zeros in about a quarter of a megabyte.
        let size = 1usize << 26;
        let mut plain = file(&[Variable { name: "orig", size: &[1, 1], data: &[0.0] }]);
        plain.truncate(HEADER_LEN);
        let mut z = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::best());
        write_variable_header(&mut z, "orig", &[size, 1]).unwrap();
        let zeros = [0; 1 << 16];
        (0..4 * size / zeros.len()).for_each(|_| z.write_all(&zeros).unwrap());
        let z = z.finish().unwrap();
        plain.extend(MI_COMPRESSED.to_le_bytes());
        plain.extend((z.len() as u32).to_le_bytes());
        plain.extend(z);
        let error = read(&plain, &["orig"]).unwrap_err();
        assert!(error.to_string().contains("at most"), "{error}");
    }

    #[test]
    fn v73_with_userblock() {
        let mut b = hdf5_pure::FileBuilder::new();
        b.create_dataset("mask").with_u8_data(&[0, 1, 1, 0, 1, 0]).with_shape(&[1, 2, 3]);
        b.create_dataset("meas").with_f64_data(&[0.5; 6]).with_shape(&[1, 2, 3]);
        let plain = b.finish().unwrap();
        let found = read(&plain, &["mask", "meas"]).unwrap();
        assert_eq!(found.arrays["mask"].shape(), [1, 2, 3]);
        assert_eq!(found.arrays["mask"].samples(), &Samples::Bytes(vec![0, 1, 1, 0, 1, 0]));
        assert_eq!(found.arrays["meas"].samples().at(3), 0.5);
        for len in (0..plain.len()).step_by(7) {
            let _ = read(&plain[..len], &["mask", "meas"]);
        }
        for at in 0..plain.len() {
            let mut bytes = plain.clone();
            bytes[at] ^= 0xff;
            let _ = read(&bytes, &["mask", "meas"]);
        }
    }
}
