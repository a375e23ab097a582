//! PyTorch `.pth` files: the ZIP format since 1.6 and the stream of pickles before it.

use super::pickle::{Id, Node, Pickle};
use super::stored::{MOST_AXES, Named, Stored};
use candle_core::DType;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::{Cursor, Read};

type Result<T> = std::result::Result<T, String>;

/// The pickle of PyTorch's magic number, with which the older format begins.
const LEGACY_MAGIC: [u8; 15] =
    [0x80, 0x02, 0x8a, 0x0a, 0x6c, 0xfc, 0x9c, 0x46, 0xf9, 0x20, 0x6a, 0xa8, 0x50, 0x19, b'.'];

/// What the entry of a file in a ZIP archive's list begins with.
const ZIP_ENTRY: &[u8] = b"PK\x01\x02";
/// Files in an archive, at most: there is one for each tensor, and a few more.
const MOST_ENTRIES: usize = 1 << 15;

/// Whether the bytes begin as a `.pth` file does.
pub(super) fn looks_like(bytes: &[u8]) -> bool {
    bytes.starts_with(&LEGACY_MAGIC) || bytes.starts_with(b"PK\x03\x04")
}

/// All tensors of the state dictionary.
pub(super) fn read(bytes: &[u8]) -> Result<Named> {
    if let Some(stream) = bytes.strip_prefix(&LEGACY_MAGIC) { read_stream(stream) } else { read_zip(bytes) }
}

fn read_zip(bytes: &[u8]) -> Result<Named> {
    if bytes.windows(ZIP_ENTRY.len()).filter(|window| *window == ZIP_ENTRY).count() > MOST_ENTRIES {
        return Err(format!("a ZIP archive of more than {MOST_ENTRIES} files: not a .pth file that PyTorch wrote"));
    }
    let mut zip = zip::ZipArchive::new(Cursor::new(bytes)).map_err(|e| format!("not a .pth file: {e}"))?;
    let pickle = zip.file_names().filter_map(|name| name.ok()).find(|name| name.ends_with("data.pkl"));
    let pickle = pickle.ok_or("a ZIP archive without data.pkl: not a .pth file that PyTorch wrote")?.into_owned();
    // Files in an archive may overlap: together they must not be longer than it.
    let mut left = bytes.len() as u64;
    let mut contents = |name: &str| -> Result<Vec<u8>> {
        let failed = |e: &dyn std::fmt::Display| format!("{name}: {e}");
        let file = zip.by_name(name).map_err(|e| failed(&e))?;
        let size = file.size();
        left = left.checked_sub(size).ok_or_else(|| failed(&"longer than the file it is in"))?;
        let mut data = Vec::with_capacity(size as usize);
        // Only at its end is the checksum looked at.
        file.take(size + 1).read_to_end(&mut data).map_err(|e| failed(&e))?;
        if data.len() as u64 == size { Ok(data) } else { Err(failed(&"its length is not what the archive says")) }
    };
    let state = contents(&pickle)?;
    let state = unpickle(&mut &*state)?;
    let folder = pickle.trim_end_matches("data.pkl");
    gather(tensors_of(&state)?, bytes.len(), |key| contents(&format!("{folder}data/{key}")).map(Cow::Owned))
}

/// Protocol version, system, state dictionary, list of storage keys (a pickle each), then every storage: length, data.
fn read_stream(stream: &[u8]) -> Result<Named> {
    let mut rest = stream;
    unpickle(&mut rest)?;
    unpickle(&mut rest)?;
    let state = unpickle(&mut rest)?;
    let keys = unpickle(&mut rest)?;
    let Node::List(list) = keys.root() else {
        return Err("not a .pth file: the list of storages is missing".into());
    };
    // An optimiser's state may lie beside the network's: every storage counts.
    let types: BTreeMap<&str, DType> = state.nodes().filter_map(|node| storage_of(&state, node)).collect();
    let mut storages = BTreeMap::new();
    for &key in list {
        let key = keys.text(key).ok_or("not a .pth file: a storage key is not text")?;
        let dtype = types.get(key).ok_or_else(|| format!("storage {key} belongs to no tensor"))?;
        let (length, after) = rest.split_first_chunk().ok_or("the file is cut short")?;
        let size = usize::try_from(u64::from_le_bytes(*length))
            .ok()
            .and_then(|n| n.checked_mul(dtype.size_in_bytes()))
            .ok_or("a storage has an impossible size")?;
        let (data, after) = after.split_at_checked(size).ok_or("the file is cut short")?;
        storages.insert(key, data);
        rest = after;
    }
    gather(tensors_of(&state)?, stream.len(), |key| {
        storages.get(key).map(|data| Cow::Borrowed(*data)).ok_or_else(|| format!("storage {key} is missing"))
    })
}

fn unpickle<'p>(bytes: &mut &'p [u8]) -> Result<Pickle<'p>> {
    Pickle::read(bytes).map_err(|e| format!("not a .pth file: {e}"))
}

/// A tensor as the pickle describes it: a strided view of a storage, in elements.
struct Info<'p> {
    storage: &'p str,
    dtype: DType,
    offset: usize,
    shape: Vec<usize>,
    strides: Vec<usize>,
}

/// The tensors of the root dictionary, or of its `state_dict`.
fn tensors_of<'p>(pickle: &Pickle<'p>) -> Result<BTreeMap<&'p str, Info<'p>>> {
    let Node::Dict(root) = pickle.root() else {
        return Err("no dictionary of tensors in it: a whole pickled model cannot be read, only its state_dict".into());
    };
    let mut entries = root;
    if let Some((_, state)) = entries.iter().find(|(key, _)| pickle.text(*key) == Some("state_dict")) {
        let Node::Dict(inner) = pickle.node(*state) else {
            return Err("its state_dict is not a dictionary".into());
        };
        entries = inner;
    }
    let mut tensors = BTreeMap::new();
    for (name, value) in entries {
        let Some(name) = pickle.text(*name) else { continue };
        if let Some(info) = tensor_info(pickle, *value).map_err(|e| format!("tensor {name}: {e}"))? {
            tensors.insert(name, info);
        }
    }
    Ok(tensors)
}

/// The tensor of a call that makes one.
fn tensor_info<'p>(pickle: &Pickle<'p>, mut value: Id) -> Result<Option<Info<'p>>> {
    // A parameter is made of its tensor, which was there before it: this ends.
    while let &Node::Call(callee, arguments) = pickle.node(value) {
        let (Some(name), Some(arguments)) = (pickle.class(callee), pickle.tuple(arguments)) else { break };
        match (name, arguments) {
            ("_rebuild_parameter", [tensor, ..]) => value = *tensor,
            ("_rebuild_tensor" | "_rebuild_tensor_v2", _) => return rebuild(pickle, arguments).map(Some),
            _ => break,
        }
    }
    Ok(None)
}

/// Arguments: storage, offset, shape, strides, …
fn rebuild<'p>(pickle: &Pickle<'p>, arguments: &[Id]) -> Result<Info<'p>> {
    const MALFORMED: &str = "malformed";
    let &[storage, offset, shape, strides, ..] = arguments else { return Err(MALFORMED.into()) };
    if !matches!(pickle.node(storage), Node::Persistent(_)) {
        return Err(MALFORMED.into());
    }
    let (storage, dtype) =
        storage_of(pickle, pickle.node(storage)).ok_or("of a storage type other than f16, bf16, f32, f64, u8, i64")?;
    let sizes = |id: Id| -> Option<Vec<usize>> {
        // Many tensors may share one shape: it must be short.
        let items = pickle.tuple(id).filter(|items| items.len() <= MOST_AXES)?;
        items.iter().map(|&item| pickle.size(item)).collect()
    };
    let offset = pickle.size(offset).ok_or(MALFORMED)?;
    let (shape, strides) = (sizes(shape).ok_or(MALFORMED)?, sizes(strides).ok_or(MALFORMED)?);
    if shape.len() != strides.len() {
        return Err(MALFORMED.into());
    }
    Ok(Info { storage, dtype, offset, shape, strides })
}

/// Key and type of a storage, `("storage", type, key, location, length, …)`.
fn storage_of<'p>(pickle: &Pickle<'p>, node: &Node<'p>) -> Option<(&'p str, DType)> {
    let Node::Persistent(name) = node else { return None };
    let &[_, class, key, ..] = pickle.tuple(*name)? else { return None };
    let dtype = match pickle.class(class)? {
        "FloatStorage" => DType::F32,
        "DoubleStorage" => DType::F64,
        "HalfStorage" => DType::F16,
        "BFloat16Storage" => DType::BF16,
        "ByteStorage" => DType::U8,
        "LongStorage" => DType::I64,
        _ => return None,
    };
    Some((pickle.text(key)?, dtype))
}

/// Reads each storage, of which `contents` gives the bytes, once, and then all tensors in it.
fn gather<'b>(
    infos: BTreeMap<&str, Info<'_>>,
    file: usize,
    mut contents: impl FnMut(&str) -> Result<Cow<'b, [u8]>>,
) -> Result<Named> {
    let mut of_storages: BTreeMap<&str, Vec<(&str, &Info<'_>)>> = BTreeMap::new();
    for (name, info) in &infos {
        of_storages.entry(info.storage).or_default().push((name, info));
    }
    // Tensors may be views of the same numbers, but those of a network are not: this bounds what a file can ask for.
    let mut left = file;
    let mut tensors = BTreeMap::new();
    for (storage, views) in of_storages {
        let data = contents(storage)?;
        for (name, info) in views {
            let named = |why: &str| format!("tensor {name}: {why}");
            let view = strided(info, &data).ok_or_else(|| named("its storage is too short"))?;
            left = left.checked_sub(view.len()).ok_or_else(|| named("the tensors are larger than the file"))?;
            let stored = Stored::new(info.dtype, &info.shape, &view).map_err(|e| named(&e))?;
            tensors.insert(name.to_owned(), stored);
        }
    }
    Ok(tensors)
}

/// The elements of a strided view in row-major order; `None` when one lies outside the storage.
fn strided<'s>(info: &Info<'_>, storage: &'s [u8]) -> Option<Cow<'s, [u8]>> {
    let size = info.dtype.size_in_bytes();
    let count = info.shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d))?;
    let first = info.offset.checked_mul(size)?;
    if row_major(&info.shape).eq(info.strides.iter().rev().copied()) {
        return Some(Cow::Borrowed(storage.get(first..first.checked_add(count.checked_mul(size)?)?)?));
    }
    // A view may repeat elements, but no weight does: this bounds the memory that a malformed file can ask for.
    if count > storage.len() / size {
        return None;
    }
    let mut data = Vec::with_capacity(count * size);
    let mut index = vec![0usize; info.shape.len()];
    for _ in 0..count {
        let at = index
            .iter()
            .zip(&info.strides)
            .try_fold(info.offset, |at, (&i, &s)| at.checked_add(i.checked_mul(s)?))?
            .checked_mul(size)?;
        data.extend_from_slice(storage.get(at..at.checked_add(size)?)?);
        for (i, &extent) in index.iter_mut().zip(&info.shape).rev() {
            *i += 1;
            if *i < extent {
                break;
            }
            *i = 0;
        }
    }
    Some(Cow::Owned(data))
}

/// The strides of elements that lie one after another, the last axis first.
fn row_major(shape: &[usize]) -> impl Iterator<Item = usize> {
    shape.iter().rev().scan(1usize, |stride, &extent| {
        let this = *stride;
        *stride = stride.saturating_mul(extent);
        Some(this)
    })
}
