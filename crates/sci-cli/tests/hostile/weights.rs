//! Weight files and checkpoints to damage, put together by hand where no one but PyTorch writes them.

use std::io::{Cursor, Write};
use std::path::Path;

use ndarray::Array3;
use nets::train::{TrainData, Trainer};
use nets::{Ffdnet, FfdnetLayout, FfdnetSpec, Layers};
use zip::CompressionMethod;
use zip::write::SimpleFileOptions;

/// The pickle of the number that a file in PyTorch's older format begins with.
const MAGIC: &[u8] = &[0x80, 0x02, 0x8a, 0x0a, 0x6c, 0xfc, 0x9c, 0x46, 0xf9, 0x20, 0x6a, 0xa8, 0x50, 0x19, b'.'];

/// The smallest network there is.
pub(crate) fn smallest() -> Ffdnet {
    Ffdnet::random(FfdnetSpec { channels: 1, width: 1, depth: 2, layout: FfdnetLayout::Direct }, 1).unwrap()
}

/// A state dictionary as PyTorch writes it: its pickle, and the storages.
pub(crate) struct State {
    pickle: Vec<u8>,
    storages: Vec<Vec<u8>>,
}

impl State {
    /// That of a network.
    pub(crate) fn of(net: &Ffdnet) -> Self {
        let (mut entries, mut storages) = (Vec::new(), Vec::new());
        for (name, tensor) in net.state() {
            let values: Vec<f32> = tensor.flatten_all().unwrap().to_vec1().unwrap();
            let mut strides = vec![1; tensor.dims().len()];
            for axis in (1..strides.len()).rev() {
                strides[axis - 1] = strides[axis] * tensor.dims()[axis];
            }
            let [shape, strides] = [tensor.dims(), &strides].map(|sizes| tuple(sizes.iter().map(|&n| small(n))));
            entries.push(text(&name));
            entries.push(rebuilt(storages.len(), values.len(), &shape, &strides));
            storages.push(values.iter().flat_map(|v| v.to_le_bytes()).collect());
        }
        Self { pickle: dictionary(&entries.concat()), storages }
    }

    /// Many tensors that share one shape of very many axes.
    pub(crate) fn of_one_long_shape() -> Self {
        let shape = [tuple((0..100_000).map(|_| small(1))), b"q\x01".to_vec()].concat();
        let tensor = |i: usize| {
            let shape = if i == 0 { shape.as_slice() } else { b"h\x01" };
            [text(&format!("t{i}")), rebuilt(0, 1, shape, b"h\x01")].concat()
        };
        Self { pickle: dictionary(&(0..1000).flat_map(tensor).collect::<Vec<_>>()), storages: vec![vec![0; 4]] }
    }

    /// The format since 1.6.
    pub(crate) fn archive(&self) -> Vec<u8> {
        let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
        let mut add = |name: String, data: &[u8]| {
            let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
            zip.start_file(name, options).unwrap();
            zip.write_all(data).unwrap();
        };
        add("net/data.pkl".into(), &self.pickle);
        self.storages.iter().enumerate().for_each(|(key, data)| add(format!("net/data/{key}"), data));
        zip.finish().unwrap().into_inner()
    }

    /// The format before.
    pub(crate) fn stream(&self) -> Vec<u8> {
        let keys: Vec<u8> = (0..self.storages.len()).flat_map(|key| text(&key.to_string())).collect();
        let storage = |data: &Vec<u8>| [&(data.len() as u64 / 4).to_le_bytes(), data.as_slice()].concat();
        let storages: Vec<u8> = self.storages.iter().flat_map(storage).collect();
        stream(&[b"\x80\x02M\xe9\x03.\x80\x02}.", self.pickle.as_slice(), b"\x80\x02](", &keys, b"e.", &storages])
    }
}

/// The older format with these bytes behind its beginning.
pub(crate) fn stream(rest: &[&[u8]]) -> Vec<u8> {
    [MAGIC, &rest.concat()].concat()
}

fn text(text: &str) -> Vec<u8> {
    [b"X", &(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
}

fn small(n: usize) -> Vec<u8> {
    vec![b'K', n as u8]
}

fn tuple(items: impl IntoIterator<Item = Vec<u8>>) -> Vec<u8> {
    [b"(".to_vec(), items.into_iter().flatten().collect(), b"t".to_vec()].concat()
}

fn dictionary(entries: &[u8]) -> Vec<u8> {
    [b"\x80\x02ccollections\nOrderedDict\n)R(", entries, b"u."].concat()
}

/// The call that makes a tensor of a storage.
fn rebuilt(key: usize, count: usize, shape: &[u8], strides: &[u8]) -> Vec<u8> {
    let class = b"ctorch\nFloatStorage\n".to_vec();
    let name = tuple([text("storage"), class, text(&key.to_string()), text("cpu"), small(count)]);
    let hooks = b"\x89ccollections\nOrderedDict\n)R".to_vec();
    let arguments = tuple([[name, b"Q".to_vec()].concat(), small(0), shape.to_vec(), strides.to_vec(), hooks]);
    [b"ctorch._utils\n_rebuild_tensor_v2\n".to_vec(), arguments, b"R".to_vec()].concat()
}

/// A `.safetensors` file with this header and as many zeros.
pub(crate) fn safetensors(header: &str, zeros: usize) -> Vec<u8> {
    [&(header.len() as u64).to_le_bytes(), header.as_bytes(), &vec![0; zeros]].concat()
}

/// A run of the smallest network, which has saved a checkpoint.
pub(crate) fn trainer(checkpoint: &Path) -> Trainer {
    let config = r#"{
        "name": "tiny",
        "network": { "kind": "ffdnet", "channels": 1, "width": 1, "depth": 2 },
        "data": { "photos": "p", "validation": "v", "photo_share": 1.0, "patch": 8, "batch": 1 },
        "noise": { "sigma": [0, 50] },
        "training": { "steps": 3, "learning_rate": 1e-3 }
    }"#;
    let frame = Array3::from_shape_fn((1, 12, 12), |(_, y, x)| (7 * y + 5 * x) as u8);
    let data = TrainData { photos: vec![frame.clone()], validation: vec![vec![frame]], ..TrainData::default() };
    let mut trainer = Trainer::new(serde_json::from_str(config).unwrap(), data).unwrap();
    trainer.step().unwrap();
    trainer.save(checkpoint).unwrap();
    trainer
}
