//! Whole-network inference in the kernels' blocked layout, one frame at a time: no tensor is made, images are reused,
//! and a network's activations are those of one frame.

use crate::Result;
use crate::kernels::{Blocked, Conv3x3, Form, Isa, LANES, PackedConv, Precision, Scratch, shuffle};
use crate::layers::Conv;
use crate::network::Padding;
use ndarray::{ArrayView3, ArrayViewMut3, s};

/// Packed convolutions and the images between them.
#[derive(Debug, Default)]
pub(crate) struct Engine {
    convs: Vec<(PackedConv, Conv3x3)>,
    free: Vec<Blocked>,
    frame: (usize, usize),
    scratch: Scratch,
}

impl Engine {
    /// Packs the layers, batch norm folded. The outputs of the layers in `shuffled` are put in the order that
    /// [`Engine::add_shuffled`] needs; the results of the layers in `plain` are held in f32.
    pub(crate) fn new(convs: &[&Conv], shuffled: &[usize], plain: &[usize]) -> Result<Self> {
        let isa = Isa::detect()?;
        let pack = |(i, conv): (usize, &&Conv)| {
            let opts = conv.inference();
            let mut filters = Filters::new(conv)?;
            if i > 0 && convs[i - 1].inference().groups > 1 {
                filters.spread_inputs(convs[i - 1].inference().groups);
            }
            if opts.groups > 1 {
                filters.spread_outputs(opts.groups);
            }
            let result = |channels: usize| match plain.contains(&i) {
                true => Form::Single,
                false => form(isa, opts.precision, channels),
            };
            if shuffled.contains(&i) {
                filters.order_by_phase(result(filters.outputs / 4));
            }
            let Filters { inputs, outputs, values, bias } = filters;
            // What the matrix unit would not gain from stays in f32, as the input of the first layer does.
            let full = isa == Isa::Amx && form(isa, opts.precision, inputs) != Form::Half;
            let opts = Conv3x3 { precision: if full { Precision::F32 } else { opts.precision }, ..opts };
            let packed = PackedConv::new_on(isa, &values, bias.as_deref(), inputs, outputs, opts)?;
            Ok((if shuffled.contains(&i) { packed } else { packed.giving(result(outputs)) }, opts))
        };
        Ok(Self { convs: convs.iter().enumerate().map(pack).collect::<Result<_>>()?, ..Self::default() })
    }

    /// Announces the size of the frames to come; images of another size are let go.
    pub(crate) fn start(&mut self, height: usize, width: usize) {
        if self.frame != (height, width) {
            self.frame = (height, width);
            self.free.clear();
        }
    }

    /// An f32 image whose border is zero and whose pixels are unspecified.
    pub(crate) fn image(&mut self, channels: usize, height: usize, width: usize) -> Blocked {
        self.image_of(Form::Single, (channels, height, width))
    }

    fn image_of(&mut self, form: Form, shape: (usize, usize, usize)) -> Blocked {
        match self.free.iter().position(|image| (image.form(), image.shape()) == (form, shape)) {
            Some(i) => self.free.swap_remove(i),
            None => Blocked::of(form, shape),
        }
    }

    /// Takes an image back.
    pub(crate) fn recycle(&mut self, image: Blocked) {
        self.free.push(image);
    }

    /// Layer `i`.
    pub(crate) fn conv(&mut self, i: usize, input: &Blocked) -> Result<Blocked> {
        let stride = self.convs[i].1.stride;
        let ((_, outputs), (_, h, w)) = (self.convs[i].0.channels(), input.shape());
        let shape = (outputs, h.div_ceil(stride), w.div_ceil(stride));
        let mut output = self.image_of(self.convs[i].0.form(), shape);
        self.convs[i].0.forward(input, &mut output, &mut self.scratch)?;
        Ok(output)
    }

    /// Adds the pixel-shuffled result of layer `i` to `image`; the input is taken back.
    pub(crate) fn add_shuffled(&mut self, i: usize, input: Blocked, image: &mut Blocked) -> Result<()> {
        if image.form() != Form::Single {
            self.convs[i].0.add_shuffled(&input, image, &mut self.scratch)?;
        } else {
            let quarters = self.conv(i, &input)?;
            shuffle::add_shuffled(&quarters, image);
            self.recycle(quarters);
        }
        self.recycle(input);
        Ok(())
    }

    /// Layers one after another; the images between them, and the input, are taken back.
    pub(crate) fn chain(&mut self, layers: std::ops::Range<usize>, mut image: Blocked) -> Result<Blocked> {
        for i in layers {
            let next = self.conv(i, &image)?;
            self.recycle(std::mem::replace(&mut image, next));
        }
        Ok(image)
    }
}

/// An [`Engine`] that is made when needed. A clone starts without: it may get other weights.
#[derive(Debug, Default)]
pub(crate) struct Cache(Option<Engine>);

impl Clone for Cache {
    fn clone(&self) -> Self {
        Self(None)
    }
}

impl Cache {
    /// The engine for the layers. Variables may have changed since the last call, so they are packed anew each time,
    /// which costs little beside running them.
    pub(crate) fn engine(&mut self, convs: &[&Conv], shuffled: &[usize], plain: &[usize]) -> Result<&mut Engine> {
        if convs.iter().any(|conv| conv.is_variable()) {
            self.0 = None;
        }
        match &mut self.0 {
            Some(engine) => Ok(engine),
            none => Ok(none.insert(Engine::new(convs, shuffled, plain)?)),
        }
    }

    /// The weights change.
    pub(crate) fn forget(&mut self) {
        self.0 = None;
    }
}

/// How the images between layers are held: split or halved for the matrix unit, but for those that it would not gain from.
fn form(isa: Isa, precision: Precision, channels: usize) -> Form {
    match precision {
        _ if isa != Isa::Amx || channels <= LANES => Form::Single,
        Precision::F32 => Form::Split,
        Precision::Bf16 => Form::Half,
    }
}

/// A layer's filters `[Cout, Cin/groups, 3, 3]`, batch norm folded, to be put in the order that suits the kernels.
struct Filters {
    inputs: usize,
    outputs: usize,
    values: Vec<f32>,
    bias: Option<Vec<f32>>,
}

impl Filters {
    fn new(conv: &Conv) -> Result<Self> {
        let (weight, bias) = conv.folded()?;
        let (outputs, each, ..) = weight.dims4()?;
        let values = weight.flatten_all()?.to_vec1::<f32>()?;
        let bias = bias.map(|b| b.to_vec1::<f32>()).transpose()?;
        Ok(Self { inputs: each * conv.inference().groups, outputs, values, bias })
    }

    /// Fills up the outputs of each group with zeros to whole pairs of blocks, so that no panel of outputs has the
    /// inputs of two groups.
    fn spread_outputs(&mut self, groups: usize) {
        let filter = self.values.len() / self.outputs;
        let each = self.outputs / groups;
        self.values = filled_up(&self.values, each * filter, wide(each) * filter);
        self.bias = self.bias.take().map(|b| filled_up(&b, each, wide(each)));
        self.outputs = groups * wide(each);
    }

    /// As the layer before has spread its outputs.
    fn spread_inputs(&mut self, groups: usize) {
        let each = self.inputs / groups;
        self.values = filled_up(&self.values, each * 9, wide(each) * 9);
        self.inputs = groups * wide(each);
    }

    /// Puts the outputs, of a pixel shuffle, in the order that the kernels add them in. They have no bias.
    fn order_by_phase(&mut self, form: Form) {
        let filter = self.values.len() / self.outputs;
        self.values = shuffle::by_phase(&self.values, filter, shuffle::block(form));
        (self.outputs, self.bias) = (self.values.len() / filter, None);
    }
}

/// Channels of a group in whole pairs of blocks.
fn wide(each: usize) -> usize {
    each.next_multiple_of(2 * LANES)
}

/// Every `each` numbers followed by zeros, `wide` in all.
fn filled_up(values: &[f32], each: usize, wide: usize) -> Vec<f32> {
    let zeros = std::iter::repeat_n(0.0, wide - each);
    values.chunks_exact(each).flat_map(|group| group.iter().copied().chain(zeros.clone())).collect()
}

/// Sets one channel of an image, row by row.
pub(crate) fn set_channel<I: IntoIterator<Item = f32>>(image: &mut Blocked, channel: usize, row: impl Fn(usize) -> I) {
    let (_, height, _) = image.shape();
    for y in 0..height {
        let pixels = image.row_mut(channel / LANES, y).as_chunks_mut::<LANES>().0;
        for (pixel, value) in pixels.iter_mut().zip(row(y)) {
            pixel[channel % LANES] = value;
        }
    }
}

/// Phases of an image of one channel: its 2×2 pixels as channels.
pub(crate) const PHASES: usize = 4;

/// Writes the phases of a frame `[C, H, W]`, less `black`, into channels from `first`; beyond its edge it goes on by `padding`.
pub(crate) fn set_phases(image: &mut Blocked, first: usize, frame: ArrayView3<'_, f32>, padding: Padding, black: f32) {
    let ((channels, height, width), (_, _, half_w)) = (frame.dim(), image.shape());
    for channel in 0..PHASES * channels {
        let (color, i, j) = place(channel);
        set_channel(image, first + channel, |y| {
            let row = frame.slice(s![color, padding.source(2 * y + i, height), ..]);
            (0..half_w).map(move |x| row[padding.source(2 * x + j, width)] - black)
        });
    }
}

/// Makes each pixel of `out` of that of `frame`, both `[C, H, W]`, and what was found for it in its phase.
pub(crate) fn join_phases(
    found: &Blocked,
    frame: ArrayView3<'_, f32>,
    mut out: ArrayViewMut3<'_, f32>,
    join: impl Fn(f32, f32) -> f32,
) {
    let ((channels, height, _), (_, half_h, _)) = (frame.dim(), found.shape());
    for (channel, y) in (0..PHASES * channels).flat_map(|channel| (0..half_h).map(move |y| (channel, y))) {
        let (color, i, j) = place(channel);
        if 2 * y + i >= height {
            continue;
        }
        let columns = s![color, 2 * y + i, j..;2];
        let pixels = frame.slice(columns);
        for ((out, &pixel), found) in out.slice_mut(columns).iter_mut().zip(pixels).zip(channel_row(found, channel, y))
        {
            *out = join(pixel, found);
        }
    }
}

/// Color, row and column of a phase.
fn place(channel: usize) -> (usize, usize, usize) {
    (channel / PHASES, channel / 2 % 2, channel % 2)
}

/// One row of one channel.
pub(crate) fn channel_row(image: &Blocked, channel: usize, y: usize) -> impl Iterator<Item = f32> {
    image.row(channel / LANES, y).as_chunks::<LANES>().0.iter().map(move |pixel| pixel[channel % LANES])
}
