//! Readers on damaged bytes: thousands of seeded mutations of every format must give a result or an error, never a panic,
//! and never an allocation beyond the budget of four times the file plus 64 MiB.

use std::alloc::{GlobalAlloc, Layout, System};
use std::io::Cursor;
use std::sync::atomic::{AtomicUsize, Ordering};

use ndarray::{Array3, Array4};
use sci_cli::io::mat::{self, Variable};
use sci_cli::io::samples::Budget;
use sci_cli::io::{frames, npy, video};

/// The system's allocator, remembering the largest request.
struct Largest;

static LARGEST: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call is passed on unchanged to the system's allocator, which keeps the contract.
unsafe impl GlobalAlloc for Largest {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        LARGEST.fetch_max(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller's promises are the system allocator's conditions.
        unsafe { System.alloc(layout) }
    }
    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        // SAFETY: `at` came from `System` with this layout, see `alloc`.
        unsafe { System.dealloc(at, layout) }
    }
    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        LARGEST.fetch_max(layout.size(), Ordering::Relaxed);
        // SAFETY: as in `alloc`.
        unsafe { System.alloc_zeroed(layout) }
    }
    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        LARGEST.fetch_max(size, Ordering::Relaxed);
        // SAFETY: as in `dealloc`; the caller promises a legal new size.
        unsafe { System.realloc(at, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Largest = Largest;

/// xorshift64*, so that a failure repeats.
struct Rng(u64);

impl Rng {
    fn below(&mut self, n: usize) -> usize {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) as usize % n
    }

    /// One to four bytes overwritten, and now and then a piece cut off or repeated.
    fn mutate(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut out = bytes.to_vec();
        for _ in 0..=self.below(4) {
            let (at, random) = (self.below(out.len()), self.below(256) as u8);
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
    let mut rng = Rng(0x9e37_79b9_7f4a_7c15);
    for round in 0..20_000 {
        let bytes = rng.mutate(seed);
        LARGEST.store(0, Ordering::Relaxed);
        read(&bytes);
        let (largest, limit) = (LARGEST.load(Ordering::Relaxed), Budget::for_file(bytes.len()).left());
        assert!(largest <= limit, "{name}, round {round}: {largest} bytes at once for a file of {}", bytes.len());
    }
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

    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.png");
    frames::write_png(&path, ramp.slice(ndarray::s![..1, .., ..])).unwrap();
    check(".png", &std::fs::read(&path).unwrap(), |b| frames::decode_png(b).is_ok());
}
