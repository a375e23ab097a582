//! Memory that calls reuse, and how work is shared out.

use super::blocked::{Pixel, Planes, SLACK, View, ViewMut, ZERO, pack};
use super::simd::{Isa, LANES};
use super::tile::Run;
use rayon::prelude::*;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

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
        let store = || STORE.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        let mut scratch = store().pop().unwrap_or_default();
        let result = f(&mut scratch);
        store().push(scratch);
        result
    }
}

/// Copies rows `first - top..` of an image to blocks with a border of zeros: `rows` rows in all, `padded_width` wide.
///
/// # Safety
/// The image must be readable and `isa` available.
pub(super) unsafe fn band(
    isa: Isa,
    image: Planes<*const f32>,
    top: usize,
    first: usize,
    rows: usize,
    padded_width: usize,
    buffer: &mut Buffer,
) -> View {
    let line = padded_width * LANES;
    let block = rows * line;
    let blocks = image.channels.div_ceil(LANES);
    // room to split the numbers where they are
    buffer.grow(blocks.next_multiple_of(2) * block + SLACK * LANES);
    let pixels = &mut buffer.pixels()[..blocks * rows * padded_width];
    // rows of the band that the image has
    let from = top.saturating_sub(first).min(rows);
    let to = (image.height + top).saturating_sub(first).min(rows).max(from);
    for plane in pixels.chunks_exact_mut(rows * padded_width) {
        plane[..from * padded_width].fill(ZERO);
        plane[to * padded_width..].fill(ZERO);
        for row in plane[from * padded_width..to * padded_width].chunks_exact_mut(padded_width) {
            row[0] = ZERO;
            row[1 + image.width..].fill(ZERO);
        }
    }
    let ptr = buffer.as_mut_ptr();
    // SAFETY: rows from..to lie in the image and in the band.
    unsafe {
        let rows = Planes {
            ptr: image.ptr.wrapping_add((first + from).wrapping_sub(top).wrapping_mul(image.width)),
            height: to - from,
            ..image
        };
        pack(isa, rows, ViewMut { ptr: ptr.add(from * line + LANES), block, row: line });
    }
    View { ptr, block, row: line }
}
