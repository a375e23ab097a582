//! Owns MATLAB files: v5 to v7 (read, plain or zlib-compressed; write, plain) and v7.3 (read, HDF5).
//!
//! The v5 container is read here rather than by a crate: it is a flat list of tagged arrays of which a scene needs
//! four, and the crates at hand either panic on forged type tags or inflate without a bound. Data is inflated straight
//! from the file's bytes, only for the variables asked for, never beyond the [`Budget`]. v7.3 is [`hdf5`].
//!
//! MATLAB is column-major and HDF5 stores its axes reversed, so in both a variable of MATLAB size `[H, W, T]` is a
//! row-major array of shape `[T, W, H]`, which is the shape given out here. Members of structs are named `struct.member`.
//!
//! Source: "MAT-File Format", MathWorks, chapter 1 (level 5 MAT-files).

use std::io::{self, Read, Write};

use flate2::read::ZlibDecoder;

use super::samples::{Array, Budget, Endian, SampleType, Samples, element_count};
use super::{NamedArrays, ReadError, hdf5};

const V5: &str = ".mat (v5)";
const HEADER_LEN: usize = 128;
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
/// The names of all fields of a struct.
const MAX_FIELDS: usize = 1 << 20;
/// Structs in structs.
const MAX_DEPTH: usize = 8;

/// Whether the bytes open like a MATLAB file of either family.
pub fn is_mat(bytes: &[u8]) -> bool {
    hdf5::is_hdf5(bytes) || (bytes.len() >= HEADER_LEN && endian_of(bytes).is_some())
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
    if hdf5::is_hdf5(bytes) { hdf5::read(bytes, wanted) } else { read_v5(bytes, wanted, Budget::for_file(bytes.len())) }
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

/// What a variable, or a member of one, begins with.
struct Head {
    class: u32,
    complex: bool,
    /// Row-major: the reverse of MATLAB's size.
    shape: Vec<usize>,
    name: String,
}

const CELL: u32 = 1;
const STRUCT: u32 = 2;
/// Strings, tables and other objects of MATLAB, which say neither a size nor, here, a name.
const OPAQUE: u32 = 17;
/// From double to uint64.
const NUMERIC: std::ops::RangeInclusive<u32> = 6..=15;

impl Head {
    fn read(r: &mut dyn Read, endian: Endian) -> Result<Self, ReadError> {
        let mut r = r;
        let (kind, flags) = subelement(&mut r, endian, 8)?;
        if kind != MI_UINT32 || flags.len() != 8 {
            return Err(bad("a variable does not begin with its array flags"));
        }
        let flags = word(&flags[..4], endian);
        if flags & 0xff == OPAQUE {
            return Ok(Self { class: OPAQUE, complex: false, shape: Vec::new(), name: String::new() });
        }
        let (kind, dims) = subelement(&mut r, endian, 4 * MAX_DIMS)?;
        if kind != MI_INT32 || dims.len() < 8 {
            return Err(bad("a variable without dimensions"));
        }
        let mut shape: Vec<usize> = dims.chunks_exact(4).map(|d| word(d, endian) as usize).collect();
        shape.reverse();
        let (kind, name) = subelement(&mut r, endian, MAX_NAME)?;
        if kind != MI_INT8 {
            return Err(bad("a variable without a name"));
        }
        let name = String::from_utf8_lossy(&name).into_owned();
        Ok(Self { class: flags & 0xff, complex: flags & 0x0800 != 0, shape, name })
    }

    /// What it is instead of an array of numbers.
    fn other(&self) -> &'static str {
        match self.class {
            CELL => "a cell array",
            STRUCT => "a struct",
            4 => "text",
            5 => "a sparse matrix",
            _ => "of an unknown class",
        }
    }
}

fn read_matrix(
    r: &mut impl Read,
    endian: Endian,
    wanted: &[&str],
    budget: &mut Budget,
    found: &mut NamedArrays,
) -> Result<(), ReadError> {
    let head = Head::read(r, endian)?;
    found.names.push(head.name.clone());
    let name = head.name.clone();
    Walk { endian, wanted, budget, found }.visit(r, &head, &name, MAX_DEPTH)
}

/// On the way through a variable and its members.
struct Walk<'a> {
    endian: Endian,
    wanted: &'a [&'a str],
    budget: &'a mut Budget,
    found: &'a mut NamedArrays,
}

impl Walk<'_> {
    /// Takes what is wanted of what follows `head`.
    fn visit(&mut self, r: &mut dyn Read, head: &Head, name: &str, depth: usize) -> Result<(), ReadError> {
        if head.class == STRUCT && depth > 0 {
            self.members(r, head, name, depth)?;
        }
        if !self.wanted.contains(&name) {
            return Ok(());
        }
        let array = match head.class {
            class if NUMERIC.contains(&class) => read_numbers(r, self.endian, name, head, self.budget)?,
            CELL => self.cells(r, head, name)?,
            _ => return Err(ReadError::NotNumeric { key: name.to_owned(), what: head.other() }),
        };
        self.found.arrays.insert(name.to_owned(), array);
        Ok(())
    }

    /// The members of a struct are listed; they are gone through only if one of them is wanted.
    fn members(&mut self, r: &mut dyn Read, head: &Head, name: &str, depth: usize) -> Result<(), ReadError> {
        let mut r = r;
        let (_, length) = subelement(&mut r, self.endian, 8)?;
        let length = length.get(..4).map_or(0, |b| word(b, self.endian) as usize);
        let (_, fields) = subelement(&mut r, self.endian, MAX_FIELDS)?;
        if length == 0 || length > MAX_NAME {
            return Err(bad(format!("`{name}`: field names of {length} characters")));
        }
        let text =
            |field: &[u8]| String::from_utf8_lossy(field.split(|&b| b == 0).next().unwrap_or_default()).into_owned();
        let fields: Vec<String> = fields.chunks_exact(length).map(|f| format!("{name}.{}", text(f))).collect();
        self.found.names.extend(fields.iter().cloned());
        let inner = format!("{name}.");
        if !self.wanted.iter().any(|w| w.starts_with(&inner)) {
            return Ok(());
        }
        if element_count(&head.shape) != Some(1) {
            return Err(ReadError::NotNumeric { key: name.to_owned(), what: "an array of structs" });
        }
        for field in fields {
            let Some((head, mut member)) = member(r, self.endian)? else { continue };
            self.visit(&mut member, &head, &field, depth - 1)?;
            // What was not wanted is passed over.
            io::copy(&mut member, &mut io::sink()).map_err(|e| cut_short(&e))?;
        }
        Ok(())
    }

    /// The elements of a cell array, all of one size: MATLAB's `[H, W]` of N cells becomes `[N, W, H]`.
    fn cells(&mut self, r: &mut dyn Read, head: &Head, name: &str) -> Result<Array, ReadError> {
        let not_frames =
            || ReadError::NotNumeric { key: name.to_owned(), what: "a cell array of what is not arrays of numbers" };
        let count = element_count(&head.shape).unwrap_or(usize::MAX);
        // Each takes more than this in the file, so no one can claim more than there are.
        self.budget.claim(count, size_of::<u64>())?;
        let frames = (0..count).map(|_| {
            let (head, mut cell) = member(&mut *r, self.endian)?.ok_or_else(not_frames)?;
            if !NUMERIC.contains(&head.class) {
                return Err(not_frames());
            }
            let frame = read_numbers(&mut cell, self.endian, name, &head, self.budget)?;
            io::copy(&mut cell, &mut io::sink()).map_err(|e| cut_short(&e))?;
            Ok(frame)
        });
        Array::stacked(name, frames)
    }
}

/// A member of a struct or a cell: its head, and a reader of the rest of it.
type Member<'r> = (Head, io::Take<&'r mut dyn Read>);

/// The next member, `None` if it is empty.
fn member(r: &mut dyn Read, endian: Endian) -> Result<Option<Member<'_>>, ReadError> {
    let mut r = r;
    let (kind, size) = tag(&mut r, endian)?;
    if kind != MI_MATRIX {
        return Err(bad(format!("a member of element type {kind}, expected {MI_MATRIX}")));
    }
    if size == 0 {
        return Ok(None);
    }
    let mut member = r.take(size as u64);
    Ok(Some((Head::read(&mut member, endian)?, member)))
}

/// The numbers: stored in the smallest type that holds them, whatever the variable's class.
fn read_numbers(
    r: &mut dyn Read,
    endian: Endian,
    name: &str,
    head: &Head,
    budget: &mut Budget,
) -> Result<Array, ReadError> {
    let mut r = r;
    let shape = head.shape.clone();
    let too_many = || bad(format!("`{name}` claims a size of {shape:?} samples"));
    let count = element_count(&shape).ok_or_else(too_many)?;
    let (packed, raw) = subelement(&mut r, endian, budget.left())?;
    let packed = sample_type(packed).ok_or_else(|| bad(format!("`{name}` holds samples of unknown type {packed}")))?;
    if Some(raw.len()) != count.checked_mul(packed.size()) {
        return Err(shape_mismatch(name, &shape, raw.len() / packed.size()));
    }
    budget.claim(count, packed.decoded_size())?;
    if head.complex {
        let (kind, imaginary) = subelement(&mut r, endian, budget.left())?;
        let kind = sample_type(kind).ok_or_else(|| bad(format!("`{name}` holds samples of unknown type {kind}")))?;
        let imaginary = Samples::decode(imaginary, kind, endian);
        if (0..imaginary.len()).any(|i| imaginary.at(i) != 0.0) {
            return Err(ReadError::NotNumeric {
                key: name.to_owned(),
                what: "complex, with imaginary parts that are not zero",
            });
        }
    }
    Array::new(shape, Samples::decode(raw, packed, endian), class_type(head.class).unwrap_or(packed))
}

fn sample_type(element: u32) -> Option<SampleType> {
    Some(match element {
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
        _ => return None,
    })
}

/// What a variable of a class holds for MATLAB.
fn class_type(class: u32) -> Option<SampleType> {
    Some(match class {
        6 => SampleType::F64,
        7 => SampleType::F32,
        8 => SampleType::I8,
        9 => SampleType::U8,
        10 => SampleType::I16,
        11 => SampleType::U16,
        12 => SampleType::I32,
        13 => SampleType::U32,
        14 => SampleType::I64,
        15 => SampleType::U64,
        _ => return None,
    })
}

fn shape_mismatch(name: &str, shape: &[usize], got: usize) -> ReadError {
    let matlab: Vec<_> = shape.iter().rev().collect();
    bad(format!("`{name}` has size {matlab:?} but {got} samples"))
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

    /// An element with its padding.
    fn element(kind: u32, data: &[u8]) -> Vec<u8> {
        [&kind.to_le_bytes(), &(data.len() as u32).to_le_bytes(), data, padding(data.len())].concat()
    }

    /// A variable of a class, with what follows its name.
    fn matrix(flags: u32, size: [u32; 2], name: &str, content: &[Vec<u8>]) -> Vec<u8> {
        let size = size.iter().flat_map(|n| n.to_le_bytes()).collect::<Vec<_>>();
        let head = [
            element(MI_UINT32, &[flags.to_le_bytes(), [0; 4]].concat()),
            element(MI_INT32, &size),
            element(MI_INT8, name.as_bytes()),
        ];
        element(MI_MATRIX, &[head.concat(), content.concat()].concat())
    }

    fn doubles(values: &[f64]) -> Vec<u8> {
        element(9, &values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<_>>())
    }

    /// A struct `data` with members `mask` and `more.meas`, a cell array of frames, one of unequal ones, and complex numbers.
    fn nested() -> Vec<u8> {
        let fields = |names: &[&str]| {
            let padded: Vec<u8> = names.iter().flat_map(|n| format!("{n:\0<8}").into_bytes()).collect();
            [element(MI_INT32, &8u32.to_le_bytes()), element(MI_INT8, &padded)].concat()
        };
        let frame = |v: f64| matrix(6, [2, 1], "", &[doubles(&[v, v + 1.0])]);
        let inner = matrix(STRUCT, [1, 1], "", &[fields(&["meas"]), frame(5.0)]);
        let bytes = file(&[]);
        [
            bytes,
            matrix(
                STRUCT,
                [1, 1],
                "data",
                &[fields(&["note", "mask", "more"]), element(MI_MATRIX, &[]), frame(1.0), inner],
            ),
            matrix(CELL, [1, 2], "frames", &[frame(1.0), frame(3.0)]),
            matrix(CELL, [1, 2], "uneven", &[frame(1.0), matrix(6, [1, 1], "", &[doubles(&[3.0])])]),
            matrix(6 | 0x0800, [2, 1], "real", &[doubles(&[7.0, 8.0]), doubles(&[0.0, -0.0])]),
            matrix(6 | 0x0800, [2, 1], "wave", &[doubles(&[7.0, 8.0]), doubles(&[0.0, 1.0])]),
        ]
        .concat()
    }

    #[test]
    fn members_of_structs_cells_of_frames_and_real_complex_numbers() {
        for bytes in [nested(), compressed(&nested())] {
            let found = read(&bytes, &["data.mask", "data.more.meas", "frames", "real"]).unwrap();
            let names =
                ["data", "data.note", "data.mask", "data.more", "data.more.meas", "frames", "uneven", "real", "wave"];
            assert_eq!(found.names, names);
            let values = |key: &str| found.arrays[key].samples().clone();
            assert_eq!(values("data.mask"), Samples::Floats(vec![1.0, 2.0]));
            assert_eq!(values("data.more.meas"), Samples::Floats(vec![5.0, 6.0]));
            assert_eq!(found.arrays["frames"].shape(), [2, 1, 2]);
            assert_eq!(values("frames"), Samples::Floats(vec![1.0, 2.0, 3.0, 4.0]));
            assert_eq!(values("real"), Samples::Floats(vec![7.0, 8.0]));
            for (name, part) in [("uneven", "of one size"), ("wave", "imaginary parts"), ("data", "a struct")] {
                let error = read(&bytes, &[name]).unwrap_err().to_string();
                assert!(error.contains(part) && error.contains(name), "{error}");
            }
        }
    }

    #[test]
    fn damaged_structs_and_cells_never_panic() {
        let wanted = ["data.mask", "data.more.meas", "frames", "uneven", "real", "wave"];
        let bytes = nested();
        for at in 0..bytes.len() {
            let _ = read(&bytes[..at], &wanted);
            for value in [0, 1, 0x7f, 0x80, 0xff] {
                let mut b = bytes.clone();
                b[at] = value;
                let _ = read(&b, &wanted);
            }
        }
    }

    /// A string, which says neither its size nor, where others have it, its name.
    #[test]
    fn an_object_of_matlab_is_passed_over() {
        let plain = sample();
        let mut body = Vec::new();
        for (kind, data) in
            [(MI_UINT32, [OPAQUE, 0].map(u32::to_le_bytes).concat()), (MI_INT8, b"note\0\0\0\0".to_vec())]
        {
            body.extend(kind.to_le_bytes());
            body.extend((data.len() as u32).to_le_bytes());
            body.extend(data);
        }
        let object = [14u32.to_le_bytes().to_vec(), (body.len() as u32).to_le_bytes().to_vec(), body].concat();
        let with = [&plain[..HEADER_LEN], &object, &plain[HEADER_LEN..]].concat();
        let found = read(&with, &["orig"]).unwrap();
        assert!(
            found.arrays["orig"].shape() == [4, 3, 2] && found.names.contains(&"other".to_owned()),
            "{:?}",
            found.names
        );
    }
}
