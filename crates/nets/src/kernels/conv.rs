//! A convolution ready to run: its algorithm chosen, its filters packed.

#[cfg(target_arch = "x86_64")]
use super::amx;
use super::blocked::{Blocked, Form, Pixel, SLACK, Store, View, ViewMut, ZERO, check_len, padded};
use super::error::KernelError;
use super::geometry::{Conv3x3, Precision, Step, Strip, Weights};
use super::isa::Isa;
use super::scratch::{Scratch, Slot};
use super::simd::LANES;
use super::{direct, winograd};

#[derive(Debug)]
enum Filters {
    Winograd(winograd::Winograd),
    Direct(direct::Direct),
    #[cfg(target_arch = "x86_64")]
    WinogradInIntegers(winograd::Integers),
    #[cfg(target_arch = "x86_64")]
    DirectInIntegers(direct::Integers),
    #[cfg(target_arch = "x86_64")]
    Amx(amx::Amx),
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
    /// Of the result.
    form: Form,
}

/// Whether Winograd's way is the faster; see `docs/kernels.md` for the measurements behind the constants.
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
        opts: Conv3x3,
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
        opts: Conv3x3,
    ) -> Result<Self, KernelError> {
        let step = Step::of_stride(opts.stride)?;
        let weights = Weights::new(weights, inputs, outputs, opts.groups)?;
        let mut conv = Self::pack(isa.checked()?, &weights, step, opts.precision);
        if let Some(bias) = bias {
            check_len(outputs, bias.len())?;
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
    #[cfg_attr(not(target_arch = "x86_64"), expect(unused_variables, reason = "f32 alone"))]
    pub(super) fn pack(isa: Isa, weights: &Weights<'_>, step: Step, precision: Precision) -> Self {
        let (inputs, outputs) = (weights.inputs, weights.outputs);
        let filters = match isa {
            #[cfg(target_arch = "x86_64")]
            Isa::Amx if precision == Precision::Bf16 => Filters::Amx(amx::Amx::new(weights, step, Form::Half)),
            #[cfg(target_arch = "x86_64")]
            Isa::Amx if prefers_matrix_unit(inputs, weights.groups, step) => {
                Filters::Amx(amx::Amx::new(weights, step, Form::Split))
            }
            #[cfg(target_arch = "x86_64")]
            _ if precision == Precision::Bf16
                && winograd::Integers::suits(isa, inputs)
                && prefers_winograd(inputs, outputs, weights.groups, step) =>
            {
                Filters::WinogradInIntegers(winograd::Integers::new(weights, isa.vecs()))
            }
            _ if prefers_winograd(inputs, outputs, weights.groups, step) => {
                Filters::Winograd(winograd::Winograd::new(weights, isa.vecs()))
            }
            #[cfg(target_arch = "x86_64")]
            _ if precision == Precision::Bf16 && direct::Integers::suits(isa, weights, step) => {
                Filters::DirectInIntegers(direct::Integers::new(weights, step, isa.vecs()))
            }
            _ => Filters::Direct(direct::Direct::new(weights, step, isa.vecs())),
        };
        Self {
            isa,
            inputs,
            outputs,
            step,
            filters,
            bias: vec![ZERO; outputs.div_ceil(LANES)],
            floor: f32::NEG_INFINITY,
            form: Form::Single,
        }
    }

    /// Gives its result in that form; any but [`Form::Single`] is for [`Isa::Amx`].
    pub(crate) fn giving(self, form: Form) -> Self {
        debug_assert!(form == Form::Single || self.isa == Isa::Amx, "{:?} has no split images", self.isa);
        Self { form, ..self }
    }

    pub(crate) fn form(&self) -> Form {
        self.form
    }

    /// The form in which it multiplies its input.
    fn input_form(&self) -> Form {
        match &self.filters {
            #[cfg(target_arch = "x86_64")]
            Filters::Amx(amx) => amx.form,
            _ => Form::Single,
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
        let (_, height, width) = input.shape();
        let (_, out_h, out_w) = self.out_shape(height, width);
        self.forward_to((out_h, out_w), input, output, scratch)
    }

    /// As [`PackedConv::forward`], to a result of this height and width, at most one less than its own.
    pub(super) fn forward_to(
        &self,
        size: (usize, usize),
        input: &Blocked,
        output: &mut Blocked,
        scratch: &mut Scratch,
    ) -> Result<(), KernelError> {
        self.check_image(input)?;
        output.reform(self.form, self.outputs, size.0, size.1);
        let dst = output.view_mut().inner();
        // SAFETY: strips write disjoint rows of the output.
        unsafe { self.strips(size, input, Store::As(self.form), |y| dst.down(y), scratch) }
        Ok(())
    }

    /// Channels, height and width of the result for an image of this height and width.
    pub(super) fn out_shape(&self, height: usize, width: usize) -> (usize, usize, usize) {
        (self.outputs, self.step.out_size(height), self.step.out_size(width))
    }

    /// Adds the pixel-shuffled result to an image of twice the size in the same form of the matrix unit: phase `2i + j` of the outputs to the pixels
    /// `(2y + i, 2x + j)`.
    ///
    /// # Errors
    /// [`KernelError::Form`] when either is for f32 or they differ, else as [`PackedConv::forward`].
    ///
    /// # Panics
    /// When the output channels are not four times those of the image, in whole pairs of blocks.
    pub(crate) fn add_shuffled(
        &self,
        input: &Blocked,
        image: &mut Blocked,
        scratch: &mut Scratch,
    ) -> Result<(), KernelError> {
        let (_, height, width) = input.shape();
        self.check_image(input)?;
        let form = image.form();
        if self.input_form() != form || form == Form::Single {
            return Err(KernelError::Form);
        }
        let (channels, double_h, double_w) = image.shape();
        let expected = (4 * channels.next_multiple_of(2 * LANES), 2 * height, 2 * width);
        assert_eq!(expected, (self.outputs, double_h, double_w));
        let dst = image.view_mut().inner();
        // SAFETY: strips write disjoint rows of the image.
        unsafe { self.strips((height, width), input, Store::AddShuffled(form), |y| dst.down(2 * y), scratch) }
        Ok(())
    }

    /// # Safety
    /// `dst(y)` must be where output row `y` can be written.
    unsafe fn strips(
        &self,
        (out_h, out_w): (usize, usize),
        input: &Blocked,
        store: Store,
        dst: impl Fn(usize) -> ViewMut + Sync,
        scratch: &mut Scratch,
    ) {
        let (_, _, width) = input.shape();
        let (src, each) = (input.view(), strip_rows(out_w));
        scratch.each(out_h.div_ceil(each), |i, slot| {
            let y = i * each;
            let mut src = src.down(self.step.first_row(y));
            let rows = each.min(out_h - y);
            // SAFETY: the padded input has the rows that the strip reads.
            unsafe {
                if input.form() != self.input_form() {
                    let count = (self.step.first_row(rows - 1) + 3) * padded(width);
                    src = split_copy(src, self.inputs, count, slot);
                }
                self.strip(Strip { src, dst: dst(y), rows, width: out_w }, store, slot);
            }
        });
    }

    fn check_image(&self, input: &Blocked) -> Result<(), KernelError> {
        let (channels, height, width) = input.shape();
        self.check(channels, [1, channels, height, width])?;
        match (input.form(), self.input_form()) {
            (Form::Single, Form::Split) => Ok(()),
            (given, wanted) if given == wanted => Ok(()),
            _ => Err(KernelError::Form),
        }
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

    /// # Safety
    /// The strip's memory must be valid.
    unsafe fn strip(&self, strip: Strip, store: Store, slot: &mut Slot) {
        // SAFETY: the caller's contract; `isa` was checked when this was made.
        unsafe {
            match &self.filters {
                #[cfg(target_arch = "x86_64")]
                Filters::Amx(f) => amx::forward(f, &self.bias, self.floor, strip, store, slot),
                _ if matches!(store, Store::As(Form::Split | Form::Half)) => self.strip_then_convert(strip, slot),
                Filters::Winograd(f) => winograd::forward(self.isa, f, &self.bias, self.floor, strip, slot),
                Filters::Direct(f) => direct::forward(self.isa, f, &self.bias, self.floor, strip, slot),
                #[cfg(target_arch = "x86_64")]
                Filters::WinogradInIntegers(f) => {
                    winograd::forward_in_integers(self.isa, f, &self.bias, self.floor, strip, slot);
                }
                #[cfg(target_arch = "x86_64")]
                Filters::DirectInIntegers(f) => {
                    direct::forward_in_integers(self.isa, f, &self.bias, self.floor, strip, slot);
                }
            }
        }
    }

    /// # Safety
    /// The strip's memory must be valid.
    unsafe fn strip_then_convert(&self, strip: Strip, slot: &mut Slot) {
        let Strip { dst, rows, width, .. } = strip;
        let (row, blocks) = (width * LANES, self.outputs.div_ceil(LANES));
        slot.dst.grow(blocks * rows * row);
        let whole = ViewMut { ptr: slot.dst.as_mut_ptr(), block: rows * row, row };
        // SAFETY: the caller's contract; `whole` has room for the result.
        unsafe {
            self.strip(Strip { dst: whole, ..strip }, Store::As(Form::Single), slot);
            for y in 0..rows {
                convert(whole.shared().down(y), self.outputs, width, dst.down(y), self.form);
            }
        }
    }
}

/// Whether the matrix unit is the faster; of up to 16 channels it would waste half and more.
#[cfg(target_arch = "x86_64")]
fn prefers_matrix_unit(inputs: usize, groups: usize, step: Step) -> bool {
    groups == 1 && inputs > LANES && step != Step::Double
}

/// `count` pixels, split, in the slot's source buffer.
///
/// # Safety
/// `src` must have the pixels, and the processor the matrix unit.
unsafe fn split_copy(src: View, channels: usize, count: usize, slot: &mut Slot) -> View {
    let block = count * LANES;
    slot.src.grow(channels.div_ceil(2 * LANES) * 2 * block + SLACK * LANES);
    let dst = ViewMut { ptr: slot.src.as_mut_ptr(), block, row: src.row };
    // SAFETY: the caller's contract.
    unsafe { convert(src, channels, count, dst, Form::Split) };
    dst.shared()
}

/// Splits or halves `count` pixels of `channels` channels in a row.
///
/// # Safety
/// As that of the function called.
unsafe fn convert(src: View, channels: usize, count: usize, dst: ViewMut, form: Form) {
    #[cfg(target_arch = "x86_64")]
    // SAFETY: the caller's contract.
    unsafe {
        amx::convert(src, channels, count, dst, form);
    }
    #[cfg(not(target_arch = "x86_64"))]
    unreachable!("{count} pixels of {channels} channels from {:p} to {:p}: no {form:?} images here", src.ptr, dst.ptr);
}

/// Output rows worked on at once: whole tiles, enough of them to keep the products wide, few enough for the cache.
pub(super) fn strip_rows(width: usize) -> usize {
    const TILES: usize = 64;
    winograd::TILE * (TILES / width.div_ceil(winograd::TILE)).max(1)
}
