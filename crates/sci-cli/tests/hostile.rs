//! Readers and experiment files on damaged bytes: thousands of seeded mutations of every format must give a result or an error,
//! never a panic, and must never hold more than the budget of four times the file plus 64 MiB. `SCI_FUZZ_ROUNDS` inputs for each
//! format; `cargo xtask fuzz` asks for more than a million in all.

use std::alloc::{GlobalAlloc, Layout, System};
use std::io::Cursor;
use std::sync::atomic::{AtomicUsize, Ordering};

use ndarray::{Array3, Array4};
use sci_cli::config;
use sci_cli::io::mat::{self, Variable};
use sci_cli::io::samples::Budget;
use sci_cli::io::{frames, hdf5, npy, tiff, video};
use sci_cli::table::Source;

/// The system's allocator, counting what is held, and the most that ever was.
struct Counting;

static HELD: AtomicUsize = AtomicUsize::new(0);
static MOST: AtomicUsize = AtomicUsize::new(0);

fn took(size: usize) {
    MOST.fetch_max(HELD.fetch_add(size, Ordering::Relaxed) + size, Ordering::Relaxed);
}

// SAFETY: every call is passed on unchanged to the system's allocator, which keeps the contract.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        took(layout.size());
        // SAFETY: the caller's promises are the system allocator's conditions.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        HELD.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: `at` came from `System` with this layout, see `alloc`.
        unsafe { System.dealloc(at, layout) }
    }
    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        took(layout.size());
        // SAFETY: as in `alloc`.
        unsafe { System.alloc_zeroed(layout) }
    }
    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // Old and new may both be there while it is copied.
        took(size);
        HELD.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: as in `dealloc`; the caller promises a legal new size.
        unsafe { System.realloc(at, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

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

fn check(name: &str, seed: &[u8], read: impl Fn(&[u8]) -> bool) {
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
        let before = HELD.load(Ordering::Relaxed);
        MOST.store(before, Ordering::Relaxed);
        let readable = read(&bytes);
        let held = MOST.load(Ordering::Relaxed) - before;
        let limit = Budget::for_file(bytes.len()).left();
        assert!(held <= limit, "{name}, round {round}: {held} bytes held for a file of {}", bytes.len());
        most = most.max(held);
        accepted += usize::from(readable);
        // Damage that is not noticed adds up, until the next fresh start.
        if readable && !bytes.is_empty() {
            parent = bytes;
        }
    }
    println!("{name}: {rounds} inputs, {accepted} of them readable, at most {:.1} MB held", most as f64 / 1e6);
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

    let zipped = include_bytes!("../../../tests/fixtures/scene_v7.mat");
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
    check(".npz", zip.get_ref(), |b| npy::read_npz(b, &["mask"]).is_ok());

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

    let demo = include_str!("../../../configs/demo.toml");
    let experiment = |b: &[u8]| {
        let text = String::from_utf8_lossy(b);
        let source = Source::new("a.toml".as_ref(), &text, &[], &|_| Ok(demo.to_owned()));
        source.and_then(|source| config::check(&source)).is_ok()
    };
    check("experiment, gray", demo.as_bytes(), experiment);
    check("experiment, color", include_bytes!("../../../configs/color/default.toml"), experiment);
    check("experiment that extends another", b"extends = 'b.toml'\n[denoiser]\nweight = 0.2\n", experiment);
    let unfolding = b"[data]\npath = 'a'\n[solver]\nkind = 'gap'\naccelerate = false\n[denoiser]\nkind = 'unfolding'\n\
                      weights = 'b'\n[[stage]]\niterations = 3\n";
    check("experiment, unfolding", unfolding, experiment);
}
