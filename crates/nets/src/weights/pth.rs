//! PyTorch `.pth` files: the ZIP format since 1.6 and the stream of pickles before it.
//!
//! candle decodes the pickle op-codes; what they mean is read here, because candle knows the ZIP format only and
//! panics on some malformed files.

use candle_core::pickle::{Object, Stack};
use candle_core::{DType, Device, Tensor};
use std::collections::BTreeMap;
use std::io::{Cursor, Read};

type Result<T> = std::result::Result<T, String>;

/// The pickle of PyTorch's magic number, with which the older format begins.
const LEGACY_MAGIC: [u8; 15] =
    [0x80, 0x02, 0x8a, 0x0a, 0x6c, 0xfc, 0x9c, 0x46, 0xf9, 0x20, 0x6a, 0xa8, 0x50, 0x19, b'.'];

/// Whether the bytes begin as a `.pth` file does.
pub(super) fn looks_like(bytes: &[u8]) -> bool {
    bytes.starts_with(&LEGACY_MAGIC) || bytes.starts_with(b"PK\x03\x04")
}

/// All tensors of the state dictionary, as stored.
pub(super) fn read(bytes: &[u8]) -> Result<BTreeMap<String, Tensor>> {
    if let Some(stream) = bytes.strip_prefix(&LEGACY_MAGIC) { read_stream(stream) } else { read_zip(bytes) }
}

fn read_zip(bytes: &[u8]) -> Result<BTreeMap<String, Tensor>> {
    let mut zip = zip::ZipArchive::new(Cursor::new(bytes)).map_err(|e| format!("not a .pth file: {e}"))?;
    let names: Vec<String> = zip.file_names().filter_map(|n| n.ok().map(|n| n.into_owned())).collect();
    let pickle = names
        .iter()
        .find(|n| n.ends_with("data.pkl"))
        .ok_or("a ZIP archive without data.pkl: not a .pth file that PyTorch wrote")?;
    let mut contents = |name: &str| -> Result<Vec<u8>> {
        let mut data = Vec::new();
        let mut file = zip.by_name(name).map_err(|e| format!("{name}: {e}"))?;
        file.read_to_end(&mut data).map_err(|e| format!("{name}: {e}"))?;
        Ok(data)
    };
    let root = unpickle(&mut Cursor::new(contents(pickle)?))?;
    let folder = pickle.trim_end_matches("data.pkl");
    let mut storages = BTreeMap::new();
    let infos = tensors_of(root)?;
    for info in infos.values() {
        if !storages.contains_key(&info.storage) {
            storages.insert(info.storage.clone(), contents(&format!("{folder}data/{}", info.storage))?);
        }
    }
    gather(infos, &storages)
}

/// Protocol version, system, state dictionary, list of storage keys (a pickle each), then every storage: length, data.
fn read_stream(stream: &[u8]) -> Result<BTreeMap<String, Tensor>> {
    let mut reader = Cursor::new(stream);
    unpickle(&mut reader)?;
    unpickle(&mut reader)?;
    let root = unpickle(&mut reader)?;
    let Object::List(keys) = unpickle(&mut reader)? else {
        return Err("not a .pth file: the list of storages is missing".into());
    };
    let mut types = BTreeMap::new();
    storage_types(&root, &mut types);
    let infos = tensors_of(root)?;
    let mut storages = BTreeMap::new();
    for key in keys {
        let key = key.unicode().map_err(|_| "not a .pth file: a storage key is not text")?;
        let dtype = types.get(&key).ok_or_else(|| format!("storage {key} belongs to no tensor"))?;
        let mut length = [0; 8];
        reader.read_exact(&mut length).map_err(|_| "the file is cut short")?;
        let size = usize::try_from(u64::from_le_bytes(length))
            .ok()
            .and_then(|n| n.checked_mul(dtype.size_in_bytes()))
            .ok_or("a storage has an impossible size")?;
        let start = reader.position() as usize;
        let data = start.checked_add(size).and_then(|end| stream.get(start..end)).ok_or("the file is cut short")?;
        reader.set_position((start + size) as u64);
        storages.insert(key, data.to_vec());
    }
    gather(infos, &storages)
}

fn unpickle(reader: &mut Cursor<impl AsRef<[u8]>>) -> Result<Object> {
    let mut stack = Stack::empty();
    stack.read_loop(reader).and_then(|()| stack.finalize()).map_err(|e| format!("not a .pth file, or cut short: {e}"))
}

/// A tensor as the pickle describes it: a strided view of a storage, in elements.
struct Info {
    storage: String,
    dtype: DType,
    offset: usize,
    shape: Vec<usize>,
    strides: Vec<usize>,
}

/// The tensors of the root dictionary, or of its `state_dict`.
fn tensors_of(root: Object) -> Result<BTreeMap<String, Info>> {
    let Object::Dict(mut entries) = root else {
        return Err("no dictionary of tensors in it: a whole pickled model cannot be read, only its state_dict".into());
    };
    if let Some(at) = entries.iter().position(|(k, _)| *k == Object::Unicode("state_dict".into())) {
        let Object::Dict(inner) = entries.swap_remove(at).1 else {
            return Err("its state_dict is not a dictionary".into());
        };
        entries = inner;
    }
    let mut tensors = BTreeMap::new();
    for (name, value) in entries {
        let Ok(name) = name.unicode() else { continue };
        if let Some(info) = tensor_info(value).map_err(|e| format!("tensor {name}: {e}"))? {
            tensors.insert(name, info);
        }
    }
    Ok(tensors)
}

fn tensor_info(value: Object) -> Result<Option<Info>> {
    let Object::Reduce { callable, args } = value else { return Ok(None) };
    let (Object::Class { class_name, .. }, Object::Tuple(mut args)) = (*callable, *args) else { return Ok(None) };
    match class_name.as_str() {
        "_rebuild_parameter" if !args.is_empty() => tensor_info(args.swap_remove(0)),
        "_rebuild_tensor" | "_rebuild_tensor_v2" => rebuild(args).map(Some),
        _ => Ok(None),
    }
}

/// Arguments: storage, offset, shape, strides, …
fn rebuild(args: Vec<Object>) -> Result<Info> {
    const MALFORMED: &str = "malformed";
    let mut args = args.into_iter();
    let mut next = || args.next().ok_or(MALFORMED);
    let Object::PersistentLoad(id) = next()? else { return Err(MALFORMED.into()) };
    let (storage, dtype) = storage_of(&id).ok_or("of a storage type other than f16, bf16, f32, f64, u8, i64")?;
    let offset = next()?.int_or_long().ok().and_then(|n| usize::try_from(n).ok()).ok_or(MALFORMED)?;
    let shape = Vec::<usize>::try_from(next()?).map_err(|_| MALFORMED)?;
    let strides = Vec::<usize>::try_from(next()?).map_err(|_| MALFORMED)?;
    if shape.len() != strides.len() {
        return Err(MALFORMED.into());
    }
    Ok(Info { storage, dtype, offset, shape, strides })
}

/// `("storage", type, key, location, length, …)`.
fn storage_of(id: &Object) -> Option<(String, DType)> {
    let Object::Tuple(id) = id else { return None };
    let (Object::Class { class_name, .. }, Object::Unicode(key)) = (id.get(1)?, id.get(2)?) else { return None };
    let dtype = match class_name.as_str() {
        "FloatStorage" => DType::F32,
        "DoubleStorage" => DType::F64,
        "HalfStorage" => DType::F16,
        "BFloat16Storage" => DType::BF16,
        "ByteStorage" => DType::U8,
        "LongStorage" => DType::I64,
        _ => return None,
    };
    Some((key.clone(), dtype))
}

/// Every storage that the pickle mentions: an optimiser's state may lie beside the network's.
fn storage_types(object: &Object, types: &mut BTreeMap<String, DType>) {
    match object {
        Object::PersistentLoad(id) => types.extend(storage_of(id)),
        Object::Tuple(items) | Object::List(items) => items.iter().for_each(|o| storage_types(o, types)),
        Object::Dict(entries) => entries.iter().for_each(|(k, v)| {
            storage_types(k, types);
            storage_types(v, types);
        }),
        Object::Reduce { callable, args } | Object::Build { callable, args } => {
            storage_types(callable, types);
            storage_types(args, types);
        }
        _ => {}
    }
}

fn gather(infos: BTreeMap<String, Info>, storages: &BTreeMap<String, Vec<u8>>) -> Result<BTreeMap<String, Tensor>> {
    infos
        .into_iter()
        .map(|(name, info)| {
            let storage =
                storages.get(&info.storage).ok_or_else(|| format!("tensor {name}: its storage is missing"))?;
            let data = strided(&info, storage).ok_or_else(|| format!("tensor {name}: its storage is too short"))?;
            let tensor = Tensor::from_raw_buffer(&data, info.dtype, &info.shape, &Device::Cpu)
                .map_err(|e| format!("tensor {name}: {e}"))?;
            Ok((name, tensor))
        })
        .collect()
}

/// The elements of a strided view in row-major order; `None` when one lies outside the storage.
fn strided(info: &Info, storage: &[u8]) -> Option<Vec<u8>> {
    let size = info.dtype.size_in_bytes();
    let count = info.shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d))?;
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
    Some(data)
}
