//! Readers, experiment, training and weight files, checkpoints and records on damaged bytes: thousands of seeded mutations of every format
//! must give a result or an error, never a panic, and must never hold more than the budget of four times the file plus 64 MiB (of JSON
//! 32 times the file, of TOML 128 times). `SCI_FUZZ_ROUNDS` inputs for each format, `SCI_FUZZ_ONLY` for the formats with this in their names; `cargo xtask fuzz`
//! asks for more than a million in all. What once failed, or was thought of as an attack, is among the seeds.

mod counting;
mod weights;

use std::cell::RefCell;
use std::io::{Cursor, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;

use ndarray::{Array3, Array4, ArrayViewD};
use ndarray_npy::NpzWriter;
use nets::weights::{Storage, write_safetensors};
use nets::{Architecture, Ends, Layers, WeightFile};
use sci_cli::config;
use sci_cli::io::mat::{self, Variable};
use sci_cli::io::samples::Budget;
use sci_cli::io::scene::{self, Banded, Reading};
use sci_cli::io::{frames, hdf5, npy, tiff, video};
use sci_cli::record::Record;
use sci_cli::table::Source;
use sci_cli::training::Training;

use counting::counted;
use weights::State;

/// xorshift64*, so that a failure repeats.
struct Rng(u64);

impl Rng {
    fn below(&mut self, n: usize) -> usize {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) as usize % n
    }

    /// One to four bytes overwritten, as often as not among the first, where headers are, and now and then a piece cut off or repeated.
    fn mutate(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut out = bytes.to_vec();
        for _ in 0..=self.below(4) {
            let end = if self.below(2) == 0 { out.len().min(256) } else { out.len() };
            let (at, random) = (self.below(end), self.below(256) as u8);
            out[at] = [0, 1, 0x7f, 0x80, 0xff, random][self.below(6)];
        }
        match self.below(8) {
            0 => out.truncate(self.below(bytes.len())),
            1 => out.extend_from_slice(&bytes[self.below(bytes.len())..]),
            _ => {}
        }
        out
    }
}

/// What may be held of a file of this size: the budget, and a mebibyte for what a decoder needs itself.
fn budget(size: usize) -> usize {
    Budget::for_file(size).left() + (1 << 20)
}

/// The same for JSON: a number of one digit is a value of 32 bytes.
fn json_budget(size: usize) -> usize {
    size.saturating_mul(32).saturating_add(1 << 20)
}

fn check(name: &str, seed: &[u8], read: impl Fn(&[u8]) -> bool) {
    check_within(budget, name, seed, read);
}

fn check_within(budget: fn(usize) -> usize, name: &str, seed: &[u8], read: impl Fn(&[u8]) -> bool) {
    if std::env::var("SCI_FUZZ_ONLY").is_ok_and(|only| !name.contains(&only)) {
        return;
    }
    assert!(read(seed), "{name}: the undamaged file is read");
    let rounds: usize =
        std::env::var("SCI_FUZZ_ROUNDS").map_or(10_000, |n| n.parse().expect("SCI_FUZZ_ROUNDS is a number"));
    let mut rng = Rng(0x9e37_79b9_7f4a_7c15);
    let mut parent = seed.to_vec();
    let (mut accepted, mut most) = (0, 0);
    for round in 0..rounds {
        if round % 64 == 0 {
            parent = seed.to_vec();
        }
        let bytes = rng.mutate(&parent);
        let (readable, held) = counted(|| catch_unwind(AssertUnwindSafe(|| read(&bytes))));
        let readable = readable.unwrap_or_else(|_| panic!("{name}, round {round}: a panic on {bytes:?}"));
        assert!(held <= budget(bytes.len()), "{name}, round {round}: {held} bytes held for a file of {}", bytes.len());
        most = most.max(held);
        accepted += usize::from(readable);
        // Damage that is not noticed adds up, until the next fresh start.
        if readable && !bytes.is_empty() {
            parent = bytes;
        }
    }
    println!("{name}: {rounds} inputs, {accepted} of them readable, at most {:.1} MB held", most as f64 / 1e6);
}

/// The same for TOML, of which a file has at most a mebibyte: a table is written in three bytes, and its parser has several forms of it.
fn toml_budget(size: usize) -> usize {
    size.saturating_mul(128).saturating_add(1 << 20)
}

/// Must be refused, within the budget.
#[track_caller]
fn refused(name: &str, bytes: &[u8], read: impl Fn(&[u8]) -> bool) {
    refused_within(budget, name, bytes, read);
}

#[track_caller]
fn refused_within(budget: fn(usize) -> usize, name: &str, bytes: &[u8], read: impl Fn(&[u8]) -> bool) {
    let (readable, held) = counted(|| read(bytes));
    assert!(!readable, "{name} is read");
    assert!(held <= budget(bytes.len()), "{name}: {held} bytes held for a file of {}", bytes.len());
}

fn is_network(bytes: &[u8]) -> bool {
    let file = WeightFile::parse("a.pth".as_ref(), bytes);
    file.is_ok_and(|file| Architecture::load(file, Ends::Circular).is_ok())
}

fn is_training(bytes: &[u8]) -> bool {
    let source = Source::new("t.toml".as_ref(), &String::from_utf8_lossy(bytes), &[], &|_| Err("none".into()));
    source.and_then(Training::new).is_ok()
}

fn is_record(bytes: &[u8]) -> bool {
    Record::parse("record.json".as_ref(), bytes).is_ok()
}

/// A scene, by way of a file.
fn is_scene(path: &Path, bytes: &[u8]) -> bool {
    std::fs::write(path, bytes).unwrap();
    scene::read(path, &Reading::default()).is_ok()
}

/// A scene that is read in bands, by way of a file: all that is read of a measurement.
fn is_banded(path: &Path, bytes: &[u8]) -> bool {
    std::fs::write(path, bytes).unwrap();
    // Of a folder the file is the masks, beside others of its arrays.
    let folder = path.parent().unwrap();
    let scene = if path.extension().is_some_and(|e| e == "npy") { folder } else { path };
    read_in_bands(scene, folder).is_some()
}

fn read_in_bands(path: &Path, folder: &Path) -> Option<()> {
    let mut scene = Banded::open(path, &Reading::default()).ok()??;
    scene.unpack(folder).ok()?;
    scene.decide(2).ok()?;
    let (last, rows) = (scene.len() - 1, scene.shape().height.min(2));
    scene.checksum(&[last]).ok()?;
    scene.band(last, 0..rows).ok()?;
    scene.truth_frame(last, 0).ok()?;
    scene.y(last).ok().map(drop)
}

/// One test, as the largest allocation is the whole process's.
#[test]
fn damaged_files_are_harmless() {
    let ramp = Array3::from_shape_fn((2, 5, 7), |(t, y, x)| (100 * t + 10 * y + x) as f32 / 255.0);
    let data: Vec<f32> = ramp.iter().copied().collect();

    let mut v5 = Vec::new();
    let size = [7, 5, 2];
    let variables = ["mask", "meas"].map(|name| Variable { name, size: &size, data: &data });
    mat::write_v5(&mut v5, &variables).unwrap();
    check(".mat v5", &v5, |b| mat::read(b, &["mask", "meas"]).is_ok());

    let zipped = include_bytes!("../../../../tests/fixtures/scene_v7.mat");
    check(".mat v7", zipped, |b| mat::read(b, &["mask", "meas", "orig"]).is_ok());

    let mut hdf5 = hdf5_pure::FileBuilder::new();
    hdf5.create_dataset("mask").with_f32_data(&data).with_shape(&[2, 5, 7]);
    hdf5.create_dataset("meas").with_u8_data(&[7; 70]).with_shape(&[2, 5, 7]).with_chunks(&[1, 5, 7]).with_deflate(6);
    check(".mat v7.3", &hdf5.finish().unwrap(), |b| mat::read(b, &["mask", "meas"]).is_ok());

    let mut matlab = hdf5_pure::mat::MatBuilder::new(hdf5_pure::mat::Options::default());
    matlab.struct_("data", |s| s.write_f32("mask", &[7, 10], &data).map(drop)).unwrap();
    matlab.cell("frames", &[1, 2], |c| c.push_u8(&[2, 1], &[1, 2])?.push_u8(&[2, 1], &[3, 4]).map(drop)).unwrap();
    matlab.write_complex_f64("meas", &[2, 1], &[(5.0, 0.0), (6.0, 0.0)]).unwrap();
    let matlab = matlab.finish().unwrap();
    check(".mat v7.3, nested", &matlab, |b| hdf5::read(b, &["data.mask", "frames", "meas"]).is_ok());
    let mut lzf = hdf5_pure::FileBuilder::new();
    lzf.create_dataset("mask").with_u8_data(&[7; 4096]).with_shape(&[64, 64]).with_chunks(&[32, 64]).with_lzf();
    check(".h5, LZF", &lzf.finish().unwrap(), |b| hdf5::read(b, &["mask"]).is_ok());

    for compression in [::tiff::encoder::Compression::Lzw, ::tiff::encoder::Compression::Uncompressed] {
        let mut file = Cursor::new(Vec::new());
        let mut pages = ::tiff::encoder::TiffEncoder::new(&mut file).unwrap().with_compression(compression);
        for page in ramp.outer_iter() {
            let mut image = pages.new_image::<::tiff::encoder::colortype::Gray32Float>(7, 5).unwrap();
            let description = "ImageJ=1.54f\nimages=2\nframes=2\n";
            image.encoder().write_tag(::tiff::tags::Tag::ImageDescription, description).unwrap();
            image.write_data(page.to_slice().unwrap()).unwrap();
        }
        check(".tif", file.get_ref(), |b| tiff::read(b).is_ok());
    }

    let mut bytes = Vec::new();
    npy::write_npy(&mut bytes, &ramp).unwrap();
    check(".npy", &bytes, |b| npy::read_npy(b).is_ok());

    let mut zip = Cursor::new(Vec::new());
    npy::write_npz(&mut zip, &[("mask", ramp.view().into_dyn())]).unwrap();
    check(".npz", zip.get_ref(), |b| npy::read_npz(Cursor::new(b), &["mask"]).is_ok());
    let packed = compressed(&[("mask", ramp.view().into_dyn())]);
    check(".npz, compressed", &packed, |b| npy::read_npz(Cursor::new(b), &["mask"]).is_ok());

    let mut gif = Vec::new();
    video::write_gif(&mut gif, Array4::from_elem((3, 1, 9, 11), 0.4).view(), 10).unwrap();
    check(".gif", &gif, |b| video::read_gif(b).is_ok());

    let mut y4m = b"YUV4MPEG2 W6 H4 F25:1 C420jpeg\nFRAME\n".to_vec();
    y4m.extend([100; 36]);
    check(".y4m", &y4m, |b| video::read_y4m(b).is_ok());

    let mut y4m = b"YUV4MPEG2 W6 H4 F25:1 C420p10\nFRAME\n".to_vec();
    y4m.extend([1; 72]);
    check(".y4m, 10 bits", &y4m, |b| video::read_y4m(b).is_ok());

    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.png");
    std::fs::write(&path, frames::png(ramp.slice(ndarray::s![..1, .., ..])).unwrap()).unwrap();
    check(".png", &std::fs::read(&path).unwrap(), |b| frames::decode(b).is_ok());
    let mut jpeg = Vec::new();
    image::load_from_memory(&std::fs::read(&path).unwrap())
        .unwrap()
        .write_to(&mut Cursor::new(&mut jpeg), image::ImageFormat::Jpeg)
        .unwrap();
    check(".jpg", &jpeg, |b| frames::decode(b).is_ok());

    let gray = include_str!("../../../../configs/gray/gap-tv.toml");
    let experiment = |b: &[u8]| {
        let text = String::from_utf8_lossy(b);
        let source = Source::new("a.toml".as_ref(), &text, &[], &|_| Ok(gray.to_owned()));
        source.and_then(|source| config::check(&source)).is_ok()
    };
    check("experiment, gray", gray.as_bytes(), experiment);
    check("experiment, color", include_bytes!("../../../../configs/color/fastdvdnet.toml"), experiment);
    check("experiment that extends another", b"extends = 'b.toml'\n[denoiser]\nweight = 0.2\n", experiment);
    check("training file", include_bytes!("../../../../configs/train/fastdvdnet_gray.toml"), is_training);
    check("training file, iterates", include_bytes!("../../../../configs/train/fastdvdnet_gray_sci.toml"), is_training);
    check_within(json_budget, "record.json", include_bytes!("../../../../tests/fixtures/record.json"), is_record);
    damaged_scenes(&dir.path().join("scene"), &ramp);
    damaged_bands(dir.path(), &ramp);
    damaged_weights(dir.path());
    attacks(dir.path());
}

/// An `.npz` as `numpy.savez_compressed` writes it.
fn compressed(arrays: &[(&str, ArrayViewD<'_, f32>)]) -> Vec<u8> {
    let mut npz = NpzWriter::new_compressed(Cursor::new(Vec::new()));
    arrays.iter().for_each(|(name, array)| npz.add_array(*name, array).unwrap());
    npz.finish().unwrap().into_inner()
}

fn damaged_scenes(path: &Path, ramp: &Array3<f32>) {
    let (mask, meas) = (ramp.mapv(|v| v.min(1.0)), ramp.sum_axis(ndarray::Axis(0)));
    let packed = compressed(&[("mask", mask.view().into_dyn()), ("meas", meas.view().into_dyn())]);
    check("scene, .npz", &packed, |b| is_scene(path, b));
    check("scene, .mat v7", include_bytes!("../../../../tests/fixtures/scene_v7.mat"), |b| is_scene(path, b));
}

/// Every format of which parts are read, with the truth or the measurements.
fn damaged_bands(folder: &Path, ramp: &Array3<f32>) {
    let (mask, meas) = (ramp.mapv(|v| v.min(1.0)), ramp.sum_axis(ndarray::Axis(0)));
    let orig = Array3::from_shape_fn((4, 5, 7), |(t, y, x)| (20 * t + 5 * y + x) as f32 / 255.0);
    let of = |array: &Array3<f32>| array.iter().copied().collect::<Vec<f32>>();
    let path = folder.join("bands");
    let arrays = [("mask", mask.view().into_dyn()), ("orig", orig.view().into_dyn())];
    let mut plain = Cursor::new(Vec::new());
    npy::write_npz(&mut plain, &arrays).unwrap();
    check("bands, .npz", plain.get_ref(), |b| is_banded(&path, b));
    check("bands, .npz, compressed", &compressed(&arrays), |b| is_banded(&path, b));

    let mut hdf5 = hdf5_pure::FileBuilder::new();
    hdf5.create_dataset("mask")
        .with_f32_data(&of(&mask))
        .with_shape(&[2, 5, 7])
        .with_chunks(&[1, 2, 7])
        .with_deflate(6);
    hdf5.create_dataset("orig").with_u8_data(&[7; 140]).with_shape(&[4, 5, 7]).with_chunks(&[2, 2, 4]).with_deflate(6);
    check("bands, .h5", &hdf5.finish().unwrap(), |b| is_banded(&path, b));
    let mut matlab = hdf5_pure::mat::MatBuilder::new(hdf5_pure::mat::Options::default());
    matlab.write_f32("mask", &[7, 5, 2], &of(&mask)).unwrap();
    matlab.write_f64("meas", &[7, 5], &meas.iter().map(|&y| f64::from(y)).collect::<Vec<_>>()).unwrap();
    check("bands, .mat v7.3", &matlab.finish().unwrap(), |b| is_banded(&path, b));

    let arrays = folder.join("arrays");
    std::fs::create_dir(&arrays).unwrap();
    npy::write_npy(&mut std::fs::File::create(arrays.join("orig.npy")).unwrap(), &orig).unwrap();
    let mut bytes = Vec::new();
    npy::write_npy(&mut bytes, &mask).unwrap();
    check("bands, .npy", &bytes, |b| is_banded(&arrays.join("mask.npy"), b));
}

fn damaged_weights(folder: &Path) {
    let net = weights::smallest();
    let path = folder.join("net.safetensors");
    write_safetensors(&path, &net.state(), Storage::F32).unwrap();
    check(".safetensors", &std::fs::read(&path).unwrap(), is_network);
    write_safetensors(&path, &net.state(), Storage::F16).unwrap();
    check(".safetensors, f16", &std::fs::read(&path).unwrap(), is_network);
    check(".pth", &State::of(&net).archive(), is_network);
    check(".pth before 1.6", &State::of(&net).stream(), is_network);

    let path = folder.join("checkpoint.safetensors");
    let trainer = RefCell::new(weights::trainer(&path));
    let whole = std::fs::read(&path).unwrap();
    check("checkpoint", &whole, |b| {
        std::fs::write(&path, b).unwrap();
        trainer.borrow_mut().resume(&path).is_ok()
    });
}

/// An `.npz` of masks and measurements of bytes, all with this header.
fn npz(header: &str, data: &[u8]) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for key in ["mask.npy", "meas.npy"] {
        let length = (header.len() as u16).to_le_bytes();
        zip.start_file(key, zip::write::SimpleFileOptions::default()).unwrap();
        zip.write_all(&[b"\x93NUMPY\x01\x00", &length[..], header.as_bytes(), data].concat()).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

/// What takes all memory, or the stack, of a reader that is not careful.
fn attacks(folder: &Path) {
    let nested = [b"N".to_vec(), vec![0x85; 200_000], b".".to_vec()].concat();
    refused("a pickle of 200,000 tuples in each other", &weights::stream(&[&nested]), is_network);
    let doubled = [b"N".to_vec(), b"q\x00h\x00\x86".repeat(60), b".".to_vec()].concat();
    refused("a pickle of 2^60 values", &weights::stream(&[&doubled]), is_network);
    refused("a pickle that never ends", &weights::stream(&[&vec![b'N'; 8 << 20]]), is_network);
    refused("tensors of 100,000 axes", &State::of_one_long_shape().stream(), is_network);
    refused("tensors of 100,000 axes in an archive", &State::of_one_long_shape().archive(), is_network);
    let entries = [b"PK\x03\x04".to_vec(), b"PK\x01\x02".repeat(1 << 20)].concat();
    refused("an archive with a million entries", &entries, is_network);

    refused("a header of 2^63 bytes", &[0, 0, 0, 0, 0, 0, 0, 0x80], is_network);
    let empty = r#"{"a":{"dtype":"F32","shape":[0,1099511627776,1099511627776],"data_offsets":[0,0]}}"#;
    refused("an axis of length 0 beside huge ones", &weights::safetensors(empty, 0), is_network);
    let one = |i: usize| format!(r#""{i}":{{"dtype":"U8","shape":[1],"data_offsets":[{i},{}]}}"#, i + 1);
    let many: Vec<String> = (0..16_000).map(one).collect();
    refused("16,000 tensors", &weights::safetensors(&format!("{{{}}}", many.join(",")), many.len()), is_network);
    let deepest = r#"{"model.18446744073709551614.weight":{"dtype":"F32","shape":[4,1,1,1],"data_offsets":[0,16]},
                      "model.0.weight":{"dtype":"F32","shape":[1,1,1,1],"data_offsets":[16,20]}}"#;
    refused("a network of 2^63 layers", &weights::safetensors(deepest, 20), is_network);
    // Layers of 1024 × 1024 filters are missing.
    let wide = |(i, name): (usize, &str)| {
        let (from, to) = (4096 * i, 4096 * (i + 1));
        format!(r#""temp1.{name}.weight":{{"dtype":"F32","shape":[1024,1,1,1],"data_offsets":[{from},{to}]}},"#)
    };
    let names = ["inc.convblock.0", "inc.convblock.3", "downc0.convblock.0", "downc1.convblock.0"];
    let wide: String = names.into_iter().enumerate().map(wide).collect();
    let last = r#""temp1.outc.convblock.3.weight":{"dtype":"F32","shape":[1,1,1,1],"data_offsets":[16384,16388]}"#;
    refused("the names of a wide network", &weights::safetensors(&format!("{{{wide}{last}}}"), 16_388), is_network);

    let scene = folder.join("attack");
    for order in ["False", "True"] {
        let header =
            format!("{{'descr': '|u1', 'fortran_order': {order}, 'shape': (0, 1099511627776, 1099511627776)}}\n");
        refused("an empty scene of huge frames", &npz(&header, &[]), |b| is_scene(&scene, b));
        refused("an empty scene of huge frames, in bands", &npz(&header, &[]), |b| is_banded(&scene, b));
        // The sizes in the directory of the archive say that 4 GiB are packed in it.
        let header = format!("{{'descr': '|u1', 'fortran_order': {order}, 'shape': (1, 65535, 65535)}}\n");
        let mut forged = npz(&header, &[1; 4096]);
        for at in (0..forged.len() - 4).filter(|&at| forged[at..at + 4] == *b"PK\x01\x02").collect::<Vec<_>>() {
            forged[at + 24..at + 28].copy_from_slice(&0xffff_fff0u32.to_le_bytes());
        }
        refused("an archive that says that it holds more, in bands", &forged, |b| is_banded(&scene, b));
        refused("an archive that says that it holds more", &forged, |b| is_scene(&scene, b));
    }
    let zeros = "{'descr': '<f8', 'fortran_order': False, 'shape': (7864320,)}\n";
    // 60 MiB in some kilobytes, of which 30 would be left: as doubles and as floats it is too much.
    refused("zeros that unpack", &npz(zeros, &vec![0; 60 << 20]), |b| {
        npy::read_npz(Cursor::new(b), &["mask", "meas"]).is_ok()
    });

    let deep = |open: &str| format!("a = {}", open.repeat(300_000));
    for open in ["[", "{b=", "[{b="] {
        refused_within(toml_budget, "TOML in itself", deep(open).as_bytes(), is_training);
    }
    refused("JSON in itself", format!("{{\"config\": {}", "[".repeat(300_000)).as_bytes(), is_record);
}
