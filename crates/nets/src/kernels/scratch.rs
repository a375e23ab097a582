//! Memory that calls reuse, and how work is shared out.

use super::blocked::{Blocked, Form, Pixel, ZERO};
use super::simd::LANES;
use super::tile::Run;
use rayon::prelude::*;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// Working memory of the kernels. Keep one for a sequence of calls: it grows to what the largest needs, and then no
/// call allocates. Holds about 1 MB per thread at 64 channels.
#[derive(Debug, Default)]
pub struct Scratch {
    slots: Vec<Slot>,
    /// The weight gradient's partial sums.
    pub(super) sums: Vec<Buffer>,
}

/// Floats that start at a cache line.
#[derive(Debug, Default)]
pub(super) struct Buffer(Vec<Pixel>);

impl Buffer {
    /// Makes room for that many floats; the content is unspecified.
    pub(super) fn grow(&mut self, floats: usize) {
        let pixels = floats.div_ceil(LANES);
        if self.0.len() < pixels {
            self.0.resize(pixels, ZERO);
        }
    }

    pub(super) fn as_mut_ptr(&mut self) -> *mut f32 {
        self.0.as_mut_ptr().cast()
    }

    /// That many pixels, all zero.
    pub(super) fn zeros(&mut self, pixels: usize) -> &mut [Pixel] {
        self.0.clear();
        self.0.resize(pixels, ZERO);
        &mut self.0
    }

    pub(super) fn pixels(&mut self) -> &mut [Pixel] {
        &mut self.0
    }
}

/// One worker's share.
#[derive(Debug, Default)]
pub(super) struct Slot {
    /// Transformed input, and products (or transformed output gradient).
    pub(super) a: Buffer,
    pub(super) b: Buffer,
    /// A strip of the operands and of the result, where those are planes.
    pub(super) src: Buffer,
    pub(super) dst: Buffer,
    pub(super) runs: Vec<Run>,
}

impl Scratch {
    /// Runs `job(0..jobs)`, each once, on as many workers as the current pool has threads; who does which is open.
    pub(super) fn each(&mut self, jobs: usize, job: impl Fn(usize, &mut Slot) + Sync) {
        let workers = rayon::current_num_threads().min(jobs);
        if self.slots.len() < workers {
            self.slots.resize_with(workers, Slot::default);
        }
        let next = AtomicUsize::new(0);
        self.slots[..workers].par_iter_mut().with_max_len(1).for_each(|slot| {
            loop {
                let i = next.fetch_add(1, Ordering::Relaxed);
                if i >= jobs {
                    break;
                }
                job(i, slot);
            }
        });
    }

    /// Lends a scratch from a process-wide store, for callers that have nowhere to keep one.
    pub(super) fn lend<R>(f: impl FnOnce(&mut Self) -> R) -> R {
        static STORE: Mutex<Vec<Scratch>> = Mutex::new(Vec::new());
        let store = || STORE.lock().unwrap_or_else(PoisonError::into_inner);
        let mut scratch = store().pop().unwrap_or_default();
        let result = f(&mut scratch);
        store().push(scratch);
        result
    }
}

/// Images of earlier calls: their borders are zero already, and their memory is at hand.
pub(super) struct Images {
    free: Mutex<Vec<Blocked>>,
}

/// The images that the process keeps.
pub(super) static IMAGES: Images = Images { free: Mutex::new(Vec::new()) };

/// Bytes of them at most.
const MOST_KEPT: usize = 1 << 30;

impl Images {
    /// An image whose border is zero and whose pixels are unspecified.
    pub(super) fn take(&self, form: Form, shape: (usize, usize, usize)) -> Blocked {
        let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        // The last are the likeliest to be in a cache.
        let found =
            free.iter().rposition(|image| (image.form(), image.shape()) == (form, shape)).map(|i| free.swap_remove(i));
        drop(free);
        found.unwrap_or_else(|| Blocked::of(form, shape))
    }

    /// Takes images back.
    pub(super) fn give(&self, images: impl IntoIterator<Item = Blocked>) {
        let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        let mut bytes: usize = free.iter().map(Blocked::bytes).sum();
        for image in images {
            bytes += image.bytes();
            if bytes <= MOST_KEPT {
                free.push(image);
            }
        }
    }
}
