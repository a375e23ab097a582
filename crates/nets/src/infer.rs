//! Whole-network inference in the kernels' blocked layout, one frame at a time: no tensor is made, images are reused,
//! and a network's activations are those of one frame.

use crate::Result;
use crate::kernels::{Blocked, Conv3x3, LANES, PackedConv, Scratch};
use crate::layers::Conv;

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
    /// [`add_shuffled`] reads.
    pub(crate) fn new(convs: &[&Conv], shuffled: &[usize]) -> Result<Self> {
        let pack = |(i, conv): (usize, &&Conv)| {
            let (weight, bias) = conv.folded()?;
            let (outputs, inputs, ..) = weight.dims4()?;
            let inputs = inputs * conv.opts().groups;
            let values = weight.flatten_all()?.to_vec1::<f32>()?;
            let bias = bias.map(|b| b.to_vec1::<f32>()).transpose()?;
            let packed = if shuffled.contains(&i) {
                let (outputs, values) = by_phase(&values, outputs);
                PackedConv::new(&values, None, inputs, outputs, conv.opts())?
            } else {
                PackedConv::new(&values, bias.as_deref(), inputs, outputs, conv.opts())?
            };
            Ok((packed, conv.opts()))
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

    /// An image whose border is zero and whose pixels are unspecified.
    pub(crate) fn image(&mut self, channels: usize, height: usize, width: usize) -> Blocked {
        match self.free.iter().position(|image| image.shape() == (channels, height, width)) {
            Some(i) => self.free.swap_remove(i),
            None => Blocked::zeros(channels, height, width),
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
        let mut output = self.image(outputs, h.div_ceil(stride), w.div_ceil(stride));
        self.convs[i].0.forward(input, &mut output, &mut self.scratch)?;
        Ok(output)
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
    pub(crate) fn engine(&mut self, convs: &[&Conv], shuffled: &[usize]) -> Result<&mut Engine> {
        if convs.iter().any(|conv| conv.is_variable()) {
            self.0 = None;
        }
        match &mut self.0 {
            Some(engine) => Ok(engine),
            none => Ok(none.insert(Engine::new(convs, shuffled)?)),
        }
    }

    /// The weights change.
    pub(crate) fn forget(&mut self) {
        self.0 = None;
    }
}

/// Filters `[4C, …]` for a pixel shuffle, in the order `[phase][C]`, each phase filled up with zeros to whole blocks.
fn by_phase(weights: &[f32], outputs: usize) -> (usize, Vec<f32>) {
    let filter = weights.len() / outputs;
    let channels = outputs / 4;
    let padded = channels.next_multiple_of(LANES);
    let mut ordered = vec![0.0; 4 * padded * filter];
    for (i, values) in weights.chunks_exact(filter).enumerate() {
        let (channel, phase) = (i / 4, i % 4);
        let at = (phase * padded + channel) * filter;
        ordered[at..at + filter].copy_from_slice(values);
    }
    (4 * padded, ordered)
}

/// `image += pixel_shuffle(quarters)`: phase `2i + j` of `quarters` goes to the pixels `(2y + i, 2x + j)`.
pub(crate) fn add_shuffled(quarters: &Blocked, image: &mut Blocked) {
    let (_, height, width) = quarters.shape();
    let blocks = image.blocks();
    for block in 0..blocks {
        for y in 0..height {
            for i in 0..2 {
                let row = image.row_mut(block, 2 * y + i);
                let left = quarters.row(2 * i * blocks + block, y);
                let right = quarters.row((2 * i + 1) * blocks + block, y);
                let pixels = left.as_chunks::<LANES>().0.iter().zip(right.as_chunks::<LANES>().0);
                for (out, (left, right)) in row.as_chunks_mut::<{ 2 * LANES }>().0.iter_mut().zip(pixels) {
                    for k in 0..LANES {
                        out[k] += left[k];
                        out[LANES + k] += right[k];
                    }
                }
            }
        }
        debug_assert_eq!((2 * height, 2 * width), (image.shape().1, image.shape().2));
    }
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

/// One row of one channel.
pub(crate) fn channel_row(image: &Blocked, channel: usize, y: usize) -> impl Iterator<Item = f32> {
    image.row(channel / LANES, y).as_chunks::<LANES>().0.iter().map(move |pixel| pixel[channel % LANES])
}
