//! The layout that the kernels work in: channels in blocks of 16, a border of zeros around every plane.

use super::error::KernelError;
use super::isa::Isa;
use super::simd::{LANES, Simd, entry};
use rayon::prelude::*;

/// One block of channels at one pixel: a cache line.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C, align(64))]
pub(super) struct Pixel(pub(super) [f32; LANES]);

pub(super) const ZERO: Pixel = Pixel([0.0; LANES]);

/// How an image holds its numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) enum Form {
    /// f32, 16 channels a block.
    #[default]
    Single,
    /// Two bf16 numbers whose sum it is to 17 bits; 32 channels in two blocks, the second for what the first lacks.
    Split,
    /// One bf16 number each, 32 channels a block: what training in bf16 keeps.
    Half,
}

/// What becomes of a result.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Store {
    /// It is written.
    As(Form),
    /// Its channels are four phases of an image of twice the size, in whole pairs of blocks each. They are added to the
    /// image of this form that is there.
    AddShuffled(Form),
}

/// Pixels after the last one: tiles of the matrix unit end where a row does only if it has whole ones.
pub(super) const SLACK: usize = 96;

/// One image of any number of channels as `[⌈C/16⌉][1 + ⌈H⌉₄ + 1][1 + ⌈W⌉₄ + 1][16]` (`⌈·⌉₄`: up to a multiple of 4).
///
/// For the matrix unit two blocks hold 32 channels as pairs of bf16 numbers instead (`Form::Split`), or one block 32 as bf16
/// (`Form::Half`).
///
/// The border is zero, so that a 3×3 filter, or a Winograd tile of 6×6, never has to look where it is. The lanes beyond
/// the last channel hold nothing: kernels write zeros there and never read them.
#[derive(Debug, Clone, Default)]
pub struct Blocked {
    form: Form,
    channels: usize,
    height: usize,
    width: usize,
    data: Vec<Pixel>,
}

/// Padded extent: the border and a whole number of Winograd tiles.
pub(super) fn padded(n: usize) -> usize {
    n.next_multiple_of(4) + 2
}

impl Blocked {
    /// An image of zeros.
    pub fn zeros(channels: usize, height: usize, width: usize) -> Self {
        Self::of(Form::Single, (channels, height, width))
    }

    /// As [`Blocked::zeros`], in the given form.
    pub(crate) fn of(form: Form, (channels, height, width): (usize, usize, usize)) -> Self {
        let mut image = Self::default();
        image.reform(form, channels, height, width);
        image
    }

    /// Takes on another shape; the content is unspecified unless the shape stays. Allocates only when it grows.
    pub fn resize(&mut self, channels: usize, height: usize, width: usize) {
        self.reform(Form::Single, channels, height, width);
    }

    /// As [`Blocked::resize`], in the given form.
    pub(crate) fn reform(&mut self, form: Form, channels: usize, height: usize, width: usize) {
        if (form, channels, height, width) == (self.form, self.channels, self.height, self.width) {
            return;
        }
        (self.form, self.channels, self.height, self.width) = (form, channels, height, width);
        self.data.clear();
        self.data.resize(self.blocks() * padded(height) * padded(width) + SLACK, ZERO);
    }

    pub(crate) fn form(&self) -> Form {
        self.form
    }

    /// `(channels, height, width)`.
    pub fn shape(&self) -> (usize, usize, usize) {
        (self.channels, self.height, self.width)
    }

    /// Memory of its pixels.
    pub(super) fn bytes(&self) -> usize {
        self.data.len() * size_of::<Pixel>()
    }

    /// All pixels with their border, block by block.
    pub(super) fn pixels(&self) -> &[Pixel] {
        &self.data
    }

    /// As [`Blocked::pixels`], to write.
    pub(super) fn pixels_mut(&mut self) -> &mut [Pixel] {
        &mut self.data
    }

    /// Number of channel blocks, `⌈C/16⌉`.
    pub fn blocks(&self) -> usize {
        match self.form {
            Form::Single => self.channels.div_ceil(LANES),
            Form::Split => 2 * self.channels.div_ceil(2 * LANES),
            Form::Half => self.channels.div_ceil(2 * LANES),
        }
    }

    fn first_pixel(&self, block: usize, y: usize) -> usize {
        assert!(
            block < self.blocks() && y < self.height,
            "block {block}, row {y} of {} blocks, {} rows",
            self.blocks(),
            self.height
        );
        (block * padded(self.height) + y + 1) * padded(self.width) + 1
    }

    /// Row `y` of a channel block: `[W][16]`.
    ///
    /// # Panics
    /// When there is no such block or row.
    pub fn row(&self, block: usize, y: usize) -> &[f32] {
        self.check_single();
        floats(self.pixel_row(block, y))
    }

    fn check_single(&self) {
        assert_eq!(self.form, Form::Single, "the numbers of an image for the matrix unit");
    }

    /// As [`Blocked::row`], in any form.
    pub(super) fn pixel_row(&self, block: usize, y: usize) -> &[Pixel] {
        let first = self.first_pixel(block, y);
        &self.data[first..first + self.width]
    }

    /// As [`Blocked::pixel_row`], to write.
    pub(super) fn pixel_row_mut(&mut self, block: usize, y: usize) -> &mut [Pixel] {
        let first = self.first_pixel(block, y);
        &mut self.data[first..first + self.width]
    }

    /// Row `y` of a channel block, to write: `[W][16]`.
    ///
    /// # Panics
    /// When there is no such block or row.
    pub fn row_mut(&mut self, block: usize, y: usize) -> &mut [f32] {
        self.check_single();
        floats_mut(self.pixel_row_mut(block, y))
    }

    /// Takes on the shape `(channels, height, width)` and the content of `planes [C,H,W]`.
    ///
    /// # Errors
    /// [`KernelError::Length`] when `planes` is not of that size.
    pub fn read_planes(
        &mut self,
        channels: usize,
        height: usize,
        width: usize,
        planes: &[f32],
    ) -> Result<(), KernelError> {
        check_len(channels * height * width, planes.len())?;
        self.resize(channels, height, width);
        let isa = Isa::detect()?;
        let view = self.view_mut();
        // SAFETY: `planes` has C·H·W floats; the interior of this image is as large; detect() gives what there is.
        unsafe {
            let planes = Planes { ptr: planes.as_ptr(), plane: height * width, channels, height, width };
            pack(isa, planes, view.inner());
        }
        Ok(())
    }

    /// Writes the content into `planes [C,H,W]`.
    ///
    /// # Errors
    /// [`KernelError::Length`] when `planes` is not of that size.
    pub fn write_planes(&self, planes: &mut [f32]) -> Result<(), KernelError> {
        check_len(self.channels * self.height * self.width, planes.len())?;
        let isa = Isa::detect()?;
        // SAFETY: as in `read_planes`.
        unsafe {
            let planes = Planes {
                ptr: planes.as_mut_ptr(),
                plane: self.height * self.width,
                channels: self.channels,
                height: self.height,
                width: self.width,
            };
            unpack(isa, self.view().inner(), planes);
        }
        Ok(())
    }

    /// The rows of a channel block in parallel.
    pub(crate) fn par_rows_mut(&mut self, block: usize) -> impl IndexedParallelIterator<Item = &mut [[f32; LANES]]> {
        self.check_single();
        let (width, row) = (self.width, padded(self.width));
        let first = self.first_pixel(block, 0) - 1;
        let rows = &mut floats_mut(&mut self.data)[first * LANES..][..self.height * row * LANES];
        rows.as_chunks_mut::<LANES>().0.par_chunks_exact_mut(row).map(move |row| &mut row[1..=width])
    }

    pub(super) fn view(&self) -> View {
        View {
            ptr: self.data.as_ptr().cast(),
            block: padded(self.height) * padded(self.width) * LANES,
            row: padded(self.width) * LANES,
        }
    }

    pub(super) fn view_mut(&mut self) -> ViewMut {
        ViewMut {
            ptr: self.data.as_mut_ptr().cast(),
            block: padded(self.height) * padded(self.width) * LANES,
            row: padded(self.width) * LANES,
        }
    }
}

pub(super) fn check_len(expected: usize, found: usize) -> Result<(), KernelError> {
    if expected == found { Ok(()) } else { Err(KernelError::Length { expected, found }) }
}

pub(super) fn floats(pixels: &[Pixel]) -> &[f32] {
    // SAFETY: a Pixel is 16 floats without padding.
    unsafe { std::slice::from_raw_parts(pixels.as_ptr().cast(), pixels.len() * LANES) }
}

pub(super) fn floats_mut(pixels: &mut [Pixel]) -> &mut [f32] {
    // SAFETY: a Pixel is 16 floats without padding, and any floats make a Pixel.
    unsafe { std::slice::from_raw_parts_mut(pixels.as_mut_ptr().cast(), pixels.len() * LANES) }
}

/// Rows of `channels` planes that lie `plane` floats apart, by a pointer to read or to write.
#[derive(Clone, Copy)]
pub(super) struct Planes<P> {
    pub(super) ptr: P,
    pub(super) plane: usize,
    pub(super) channels: usize,
    pub(super) height: usize,
    pub(super) width: usize,
}

/// Blocked pixels to read: block `b`, row `y`, column `x` at `ptr + b·block + y·row + 16·x`.
#[derive(Clone, Copy)]
pub(super) struct View {
    pub(super) ptr: *const f32,
    pub(super) block: usize,
    pub(super) row: usize,
}

/// Blocked pixels to write.
#[derive(Clone, Copy)]
pub(super) struct ViewMut {
    pub(super) ptr: *mut f32,
    pub(super) block: usize,
    pub(super) row: usize,
}

// SAFETY: views are addresses; what is done through them is the user's concern.
unsafe impl Send for View {}
// SAFETY: as above.
unsafe impl Sync for View {}
// SAFETY: as above.
unsafe impl Send for ViewMut {}
// SAFETY: as above.
unsafe impl Sync for ViewMut {}

impl View {
    pub(super) fn down(self, rows: usize) -> Self {
        Self { ptr: self.ptr.wrapping_add(rows * self.row), ..self }
    }

    /// Skips the border.
    pub(super) fn inner(self) -> Self {
        Self { ptr: self.ptr.wrapping_add(self.row + LANES), ..self }
    }
}

impl ViewMut {
    pub(super) fn down(self, rows: usize) -> Self {
        Self { ptr: self.ptr.wrapping_add(rows * self.row), ..self }
    }

    /// Skips the border.
    pub(super) fn inner(self) -> Self {
        Self { ptr: self.ptr.wrapping_add(self.row + LANES), ..self }
    }

    pub(super) fn shared(self) -> View {
        View { ptr: self.ptr, block: self.block, row: self.row }
    }
}

entry!(pub(super) fn pack = pack_rows(planes: Planes<*const f32>, dst: ViewMut));

/// Planes to blocks.
#[inline(always)]
unsafe fn pack_rows<S: Simd>(planes: Planes<*const f32>, dst: ViewMut) {
    let Planes { ptr, plane, channels, height, width } = planes;
    let mut c = 0;
    while c < channels {
        let lanes = (channels - c).min(LANES);
        let mut y = 0;
        while y < height {
            let mut x = 0;
            while x < width {
                let pixels = (width - x).min(LANES);
                // SAFETY: pixels x..x+pixels of row y, channels c..c+lanes are inside on both sides.
                unsafe {
                    let src = ptr.add(c * plane + y * width + x);
                    let out = dst.ptr.add(c / LANES * dst.block + y * dst.row + x * LANES);
                    if lanes == LANES && pixels == LANES {
                        S::transpose(src, plane, out, LANES);
                        let mut k = 0;
                        while k < LANES {
                            S::prefetch(src.wrapping_add(k * plane + 4 * LANES));
                            k += 1;
                        }
                    } else {
                        let mut p = 0;
                        while p < pixels {
                            S::splat(0.0).store(out.add(p * LANES));
                            let mut k = 0;
                            while k < lanes {
                                *out.add(p * LANES + k) = *src.add(k * plane + p);
                                k += 1;
                            }
                            p += 1;
                        }
                    }
                }
                x += LANES;
            }
            y += 1;
        }
        c += LANES;
    }
}

entry!(pub(super) fn unpack = unpack_rows(src: View, planes: Planes<*mut f32>));

/// Blocks to planes.
#[inline(always)]
unsafe fn unpack_rows<S: Simd>(src: View, planes: Planes<*mut f32>) {
    let Planes { ptr, plane, channels, height, width } = planes;
    let mut c = 0;
    while c < channels {
        let lanes = (channels - c).min(LANES);
        let mut y = 0;
        while y < height {
            let mut x = 0;
            while x < width {
                let pixels = (width - x).min(LANES);
                // SAFETY: pixels x..x+pixels of row y, channels c..c+lanes are inside on both sides.
                unsafe {
                    let p = src.ptr.add(c / LANES * src.block + y * src.row + x * LANES);
                    let out = ptr.add(c * plane + y * width + x);
                    if lanes == LANES && pixels == LANES {
                        S::transpose(p, LANES, out, plane);
                        let mut k = 0;
                        while k < LANES {
                            S::prefetch(out.wrapping_add(k * plane + 4 * LANES));
                            k += 1;
                        }
                    } else {
                        let mut k = 0;
                        while k < lanes {
                            let mut i = 0;
                            while i < pixels {
                                *out.add(k * plane + i) = *p.add(i * LANES + k);
                                i += 1;
                            }
                            k += 1;
                        }
                    }
                }
                x += LANES;
            }
            y += 1;
        }
        c += LANES;
    }
}
