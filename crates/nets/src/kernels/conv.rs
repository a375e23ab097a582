//! A convolution ready to run: its algorithm chosen, its filters packed.

use super::blocked::{Blocked, Pixel, Planes, ViewMut, ZERO, padded, unpack};
use super::scratch::{Scratch, Slot, band};
use super::simd::{Isa, LANES};
use super::{KernelError, Step, Strip, Weights, direct, winograd};

#[derive(Debug)]
enum Filters {
    Winograd(winograd::Winograd),
    Direct(direct::Direct),
}

/// A 3×3 convolution with zero padding 1, its filters transformed and packed once for many calls:
/// `y[o] = f(b[o] + Σ_i w[o,i] ⋆ x[i])`, where `f` is the identity or `max(·, 0)`.
#[derive(Debug)]
pub struct PackedConv {
    isa: Isa,
    inputs: usize,
    outputs: usize,
    step: Step,
    filters: Filters,
    bias: Vec<Pixel>,
    /// Lower bound of the result: 0 for ReLU, else −∞.
    floor: f32,
}

/// Whether Winograd's way is the faster; see the module header for the measurements behind the constants.
pub(super) fn prefers_winograd(inputs: usize, outputs: usize, groups: usize, step: Step) -> bool {
    if step != Step::Same || groups != 1 {
        return false;
    }
    // vector operations for one tile of 4×4 outputs
    let (blocks_in, blocks_out) = (inputs.div_ceil(LANES), outputs.div_ceil(LANES));
    let direct = 16 * 9 * inputs * blocks_out;
    let winograd = 36 * inputs * blocks_out + 400 * (blocks_in + blocks_out);
    winograd < direct
}

impl PackedConv {
    /// Packs `weights [Cout, Cin/groups, 3, 3]` and `bias [Cout]` for stride 1 or 2.
    ///
    /// # Errors
    /// [`KernelError`] when lengths, stride or groups do not fit, or `SCI_KERNEL` asks for what there is not.
    pub fn new(
        weights: &[f32],
        bias: Option<&[f32]>,
        inputs: usize,
        outputs: usize,
        opts: super::Conv3x3,
    ) -> Result<Self, KernelError> {
        Self::new_on(Isa::detect()?, weights, bias, inputs, outputs, opts)
    }

    /// As [`PackedConv::new`], for a given instruction set.
    ///
    /// # Errors
    /// As [`PackedConv::new`], and [`KernelError::MissingIsa`].
    pub fn new_on(
        isa: Isa,
        weights: &[f32],
        bias: Option<&[f32]>,
        inputs: usize,
        outputs: usize,
        opts: super::Conv3x3,
    ) -> Result<Self, KernelError> {
        let step = Step::of_stride(opts.stride)?;
        let weights = Weights::new(weights, inputs, outputs, opts.groups)?;
        let mut conv = Self::pack(isa.checked()?, &weights, step);
        if let Some(bias) = bias {
            super::blocked::check_len(outputs, bias.len())?;
            for (o, &b) in bias.iter().enumerate() {
                conv.bias[o / LANES].0[o % LANES] = b;
            }
        }
        if opts.relu {
            conv.floor = 0.0;
        }
        Ok(conv)
    }

    /// Without bias and ReLU; `isa` is available.
    pub(super) fn pack(isa: Isa, weights: &Weights<'_>, step: Step) -> Self {
        let (inputs, outputs) = (weights.inputs, weights.outputs);
        let filters = if prefers_winograd(inputs, outputs, weights.groups, step) {
            Filters::Winograd(winograd::Winograd::new(weights, isa.vecs()))
        } else {
            Filters::Direct(direct::Direct::new(weights, step, isa.vecs()))
        };
        Self {
            isa,
            inputs,
            outputs,
            step,
            filters,
            bias: vec![ZERO; outputs.div_ceil(LANES)],
            floor: f32::NEG_INFINITY,
        }
    }

    /// `(Cin, Cout)`.
    pub fn channels(&self) -> (usize, usize) {
        (self.inputs, self.outputs)
    }

    /// Convolves one image; `output` takes on the shape of the result. Allocates nothing once `output` and `scratch`
    /// have grown to their sizes.
    ///
    /// # Errors
    /// [`KernelError::Channels`] or [`KernelError::Empty`].
    pub fn forward(&self, input: &Blocked, output: &mut Blocked, scratch: &mut Scratch) -> Result<(), KernelError> {
        let (channels, height, width) = input.shape();
        self.check(channels, [1, channels, height, width])?;
        let (out_h, out_w) = (self.step.out_size(height), self.step.out_size(width));
        output.resize(self.outputs, out_h, out_w);
        let (src, dst) = (input.view(), output.view_mut().inner());
        let each = strip_rows(out_w);
        scratch.each(out_h.div_ceil(each), |i, slot| {
            let y = i * each;
            let strip = Strip {
                src: src.down(self.step.first_row(y)),
                dst: dst.down(y),
                rows: each.min(out_h - y),
                width: out_w,
            };
            // SAFETY: the padded input has the rows that the strip reads; strips write disjoint rows of the output.
            unsafe { self.strip(strip, slot) }
        });
        Ok(())
    }

    fn check(&self, channels: usize, shape: [usize; 4]) -> Result<(), KernelError> {
        if channels != self.inputs {
            return Err(KernelError::Channels { expected: self.inputs, found: channels });
        }
        if shape.contains(&0) {
            return Err(KernelError::Empty(shape));
        }
        Ok(())
    }

    /// Convolves a batch of planes `[N,Cin,H,W]` to `[N,Cout,out_h,out_w]`.
    ///
    /// # Safety
    /// `output` must have room for the result; all of it is written.
    pub(super) unsafe fn forward_planes(
        &self,
        input: &[f32],
        shape: [usize; 4],
        output: *mut f32,
        (out_h, out_w): (usize, usize),
        scratch: &mut Scratch,
    ) -> Result<(), KernelError> {
        let [n, channels, height, width] = shape;
        self.check(channels, shape)?;
        super::blocked::check_len(n * channels * height * width, input.len())?;
        let each = strip_rows(out_w);
        let strips = out_h.div_ceil(each);
        let output = SendPtr(output);
        scratch.each(n * strips, |job, slot| {
            let (image, y) = (job / strips, job % strips * each);
            let rows = each.min(out_h - y);
            let planes = Planes {
                ptr: input[image * channels * height * width..].as_ptr(),
                plane: height * width,
                channels,
                height,
                width,
            };
            // SAFETY: `planes` is image `image` of the checked input; the strip's output rows are its own.
            unsafe {
                let first = self.step.first_row(y);
                let read = self.step.input_rows(rows);
                let src = band(self.isa, planes, 1, first, read, padded(width), &mut slot.src);
                let blocks = self.outputs.div_ceil(LANES);
                slot.dst.grow(blocks * rows * out_w * LANES);
                let dst = ViewMut { ptr: slot.dst.as_mut_ptr(), block: rows * out_w * LANES, row: out_w * LANES };
                self.strip(Strip { src, dst, rows, width: out_w }, slot);
                let plane = out_h * out_w;
                let result = Planes {
                    ptr: output.at(image * self.outputs * plane + y * out_w),
                    plane,
                    channels: self.outputs,
                    height: rows,
                    width: out_w,
                };
                unpack(self.isa, dst.shared(), result);
            }
        });
        Ok(())
    }

    /// # Safety
    /// The strip's memory must be valid.
    unsafe fn strip(&self, strip: Strip, slot: &mut Slot) {
        // SAFETY: the caller's contract; `isa` was checked when this was made.
        unsafe {
            match &self.filters {
                Filters::Winograd(f) => {
                    winograd::forward(self.isa, f, &self.bias, self.floor, strip, slot);
                }
                Filters::Direct(f) => {
                    direct::forward(self.isa, f, &self.bias, self.floor, strip, slot);
                }
            }
        }
    }
}

/// Output rows worked on at once: whole tiles, enough of them to keep the products wide, few enough for the cache.
pub(super) fn strip_rows(width: usize) -> usize {
    const TILES: usize = 64;
    winograd::TILE * (TILES / width.div_ceil(winograd::TILE)).max(1)
}

/// An address that workers write disjoint parts of.
#[derive(Clone, Copy)]
pub(super) struct SendPtr(pub(super) *mut f32);

// SAFETY: the users write disjoint parts.
unsafe impl Send for SendPtr {}
// SAFETY: as above.
unsafe impl Sync for SendPtr {}

impl SendPtr {
    /// # Safety
    /// `offset` must stay inside the allocation.
    pub(super) unsafe fn at(self, offset: usize) -> *mut f32 {
        // SAFETY: the caller's contract.
        unsafe { self.0.add(offset) }
    }
}
