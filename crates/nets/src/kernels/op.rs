//! The kernels as differentiable candle operations.
//!
//! A chain of convolutions is one operation: its images stay in the blocked layout from layer to layer, forward and back, and
//! the automatic differentiation around it sees a single node.

use super::blocked::{Blocked, Form};
use super::conv::PackedConv;
use super::error::KernelError;
use super::geometry::{Conv3x3, Precision, Step, Weights};
use super::grad::{bias_grad, weight_grad};
use super::half;
use super::isa::Isa;
use super::scratch::{IMAGES, Scratch};
use super::shuffle;
use candle_core::{CpuStorage, CustomOp2, DType, Device, Error, Layout, Result, Shape, Storage, Tensor};
use rayon::prelude::*;
use std::borrow::Cow;
use std::sync::{Mutex, PoisonError};

/// Of what knows nothing of candle.
type Checked<T> = std::result::Result<T, KernelError>;

/// A layer of a [`conv_chain`].
#[derive(Debug, Clone)]
pub struct Link {
    /// `[Cout,Cin/groups,3,3]`.
    pub weight: Tensor,
    /// `[Cout]`.
    pub bias: Option<Tensor>,
    /// How it is done.
    pub opts: Conv3x3,
    /// A way around other layers: the pixel-shuffled result, a quarter of its channels on twice the height and width, is added to
    /// the result of this earlier layer (counted from 0), and the sum goes on. Such a layer is of stride 1 and has neither groups, bias
    /// nor ReLU; it cannot be the last, and no two go onto the same.
    pub onto: Option<usize>,
}

impl Link {
    /// A layer whose result goes on as it is.
    pub fn new(weight: Tensor, bias: Option<Tensor>, opts: Conv3x3) -> Self {
        Self { weight, bias, opts, onto: None }
    }

    fn tensors(&self) -> impl Iterator<Item = &Tensor> {
        std::iter::once(&self.weight).chain(&self.bias)
    }

    /// On candle's own operations.
    fn by_candle(&self, x: &Tensor) -> Result<Tensor> {
        let Conv3x3 { stride, groups, relu, .. } = self.opts;
        let y = x.conv2d(&self.weight, 1, stride, 1, groups)?;
        let y = match &self.bias {
            Some(b) => y.broadcast_add(&b.reshape((1, (), 1, 1))?)?,
            None => y,
        };
        if relu { y.relu() } else { Ok(y) }
    }
}

/// `y[n,o] = f(b[o] + Σ_i w[o,i] ⋆ x[n,i])`, differentiable in all three arguments; `f` is the identity or `max(·, 0)`.
///
/// Shapes: `x [N,Cin,H,W]`, `w [Cout,Cin/groups,3,3]`, `bias [Cout]`, result `[N,Cout,⌈H/stride⌉,⌈W/stride⌉]`.
/// f32 runs on the kernels of this module, other types on candle's own operations.
///
/// ```
/// use candle_core::{Device, Tensor};
/// use nets::kernels::{Conv3x3, conv3x3};
/// let x = Tensor::ones((1, 1, 3, 3), candle_core::DType::F32, &Device::Cpu)?;
/// let w = Tensor::ones((1, 1, 3, 3), candle_core::DType::F32, &Device::Cpu)?;
/// let y = conv3x3(&x, &w, None, Conv3x3::default())?;
/// assert_eq!(y.flatten_all()?.to_vec1::<f32>()?, [4., 6., 4., 6., 9., 6., 4., 6., 4.]);
/// # Ok::<(), candle_core::Error>(())
/// ```
///
/// # Errors
/// When the shapes do not fit together, the stride is neither 1 nor 2, a shape has a zero, or `SCI_KERNEL` asks for an
/// instruction set that this machine lacks.
pub fn conv3x3(x: &Tensor, w: &Tensor, bias: Option<&Tensor>, opts: Conv3x3) -> Result<Tensor> {
    conv_chain(x, &[Link::new(w.clone(), bias.cloned(), opts)])
}

/// As [`conv3x3`], for f32 and a given instruction set.
///
/// # Errors
/// As [`conv3x3`], when a tensor is not f32, and when this machine lacks the instruction set.
pub fn conv3x3_on(isa: Isa, x: &Tensor, w: &Tensor, bias: Option<&Tensor>, opts: Conv3x3) -> Result<Tensor> {
    Chain::run(isa, x, &[Link::new(w.clone(), bias.cloned(), opts)])
}

/// Convolutions one after another, each as [`conv3x3`]; differentiable in the input and in all weights and biases. Until the
/// result is dropped, what every layer was given is kept for the way back, if any gradient is asked for.
///
/// ```
/// use candle_core::{DType, Device, Tensor};
/// use nets::kernels::{Conv3x3, Link, conv_chain};
/// let weight = Tensor::ones((1, 1, 3, 3), DType::F32, &Device::Cpu)?;
/// let link = Link::new(weight, None, Conv3x3 { stride: 2, ..Conv3x3::default() });
/// let x = Tensor::ones((1, 1, 4, 4), DType::F32, &Device::Cpu)?;
/// assert_eq!(conv_chain(&x, &[link.clone(), link])?.flatten_all()?.to_vec1::<f32>()?, [25.]);
/// # Ok::<(), candle_core::Error>(())
/// ```
///
/// # Errors
/// As [`conv3x3`].
pub fn conv_chain(x: &Tensor, links: &[Link]) -> Result<Tensor> {
    let ours = |t: &Tensor| t.dtype() == DType::F32;
    if !links.is_empty() && ours(x) && links.iter().flat_map(Link::tensors).all(ours) {
        let bf16 = links.iter().all(|link| link.opts.precision == Precision::Bf16);
        let isa = if bf16 { Isa::detect() } else { Isa::detect_for_gradients() };
        return Chain::run(isa.map_err(Error::wrap)?, x, links);
    }
    layer_by_layer(x, links, |i, input| links[i].by_candle(input))
}

/// A chain whose layers, without the ways around others, are done by `layer`, which is given the number of each and its input.
pub(crate) fn layer_by_layer(
    x: &Tensor,
    links: &[Link],
    mut layer: impl FnMut(usize, &Tensor) -> Result<Tensor>,
) -> Result<Tensor> {
    let mut results: Vec<Tensor> = Vec::new();
    for (i, link) in links.iter().enumerate() {
        let y = layer(i, results.last().unwrap_or(x))?;
        results.push(match link.onto {
            None => y,
            Some(onto) => match results.get(onto) {
                Some(earlier) => (earlier + candle_nn::ops::pixel_shuffle(&y, 2)?)?,
                None => candle_core::bail!("conv_chain: layer {i} goes onto layer {onto}"),
            },
        });
    }
    Ok(results.pop().unwrap_or_else(|| x.clone()))
}

/// A layer as the operation sees it.
#[derive(Debug)]
struct Layer {
    opts: Conv3x3,
    inputs: usize,
    outputs: usize,
    /// Where its weights begin among the parameters; its biases follow.
    at: usize,
    biases: usize,
    /// Whether a gradient by weights, or by biases, is asked for.
    wants: (bool, bool),
    /// The earlier layer onto whose result its own is shuffled.
    onto: Option<usize>,
}

impl Layer {
    /// Numbers of an output's filter.
    fn filter(&self) -> usize {
        self.inputs / self.opts.groups * 9
    }

    fn weights<'p>(&self, params: &'p [f32]) -> &'p [f32] {
        &params[self.at..][..self.outputs * self.filter()]
    }

    /// The weights as the kernels are given them, for images of this form, with the number of outputs.
    fn ordered<'p>(&self, params: &'p [f32], form: Form) -> (Cow<'p, [f32]>, usize) {
        let weights = self.weights(params);
        match self.onto {
            None => (weights.into(), self.outputs),
            Some(_) => {
                let ordered = shuffle::by_phase(weights, self.filter(), shuffle::block(form));
                let outputs = ordered.len() / self.filter();
                (ordered.into(), outputs)
            }
        }
    }

    fn step(&self) -> Checked<Step> {
        Step::of_stride(self.opts.stride)
    }

    fn packed(&self, isa: Isa, params: &[f32], form: Form) -> Checked<PackedConv> {
        let (weights, outputs) = self.ordered(params, form);
        let bias = &params[self.at + self.weights(params).len()..][..self.biases];
        let bias = (self.biases > 0).then_some(bias);
        let opts = Conv3x3 { precision: self.precision(isa), ..self.opts };
        PackedConv::new_on(isa, &weights, bias, self.inputs, outputs, opts)
    }

    /// What it multiplies: gradients are of f32 where there is no matrix unit, not of rounded integers.
    fn precision(&self, isa: Isa) -> Precision {
        if isa == Isa::Amx { self.opts.precision } else { Precision::F32 }
    }

    /// The gradient by the input, as a convolution of the gradient by the result, with this step.
    fn adjoint(&self, isa: Isa, params: &[f32], step: Step, form: Form) -> Checked<PackedConv> {
        let (weights, outputs) = self.ordered(params, form);
        let weights = Weights::new(&weights, self.inputs, outputs, self.opts.groups)?;
        Ok(PackedConv::pack(isa, &weights.adjoint(), step, self.precision(isa)))
    }

    /// Writes the gradients that are wanted to their places among those of all parameters.
    fn parameter_grads(&self, isa: Isa, step: Step, x: &[&Blocked], grads: &[Blocked], all: &mut [f32]) -> Checked<()> {
        let halves = grads.first().is_some_and(|grad| grad.form() == Form::Half);
        let outputs = grads.first().map_or(self.outputs, |grad| grad.shape().0);
        let own = &mut all[self.at..];
        let (own, own_bias) = own.split_at_mut(self.outputs * self.filter());
        let bias = match self.wants {
            (weights, bias) if weights || halves && bias => {
                let shape = (self.inputs, outputs, self.opts.groups);
                let (dw, db) = Scratch::lend(|scratch| weight_grad(isa, x, grads, shape, step, scratch))?;
                match self.onto {
                    None => own.copy_from_slice(&dw),
                    Some(_) => shuffle::by_channel(&dw, self.filter(), own),
                }
                db
            }
            (_, true) => bias_grad(grads, self.outputs),
            (_, false) => return Ok(()),
        };
        own_bias[..self.biases].copy_from_slice(&bias[..self.biases]);
        Ok(())
    }
}

/// The layers, with what the way back needs of the way there.
#[derive(Debug)]
struct Chain {
    isa: Isa,
    /// Of the images between the layers.
    form: Form,
    layers: Vec<Layer>,
    wants_input_grad: bool,
    /// Of each image: what goes into each layer, and the result if the last layer has a ReLU.
    kept: Mutex<Vec<Vec<Blocked>>>,
}

impl Chain {
    fn run(isa: Isa, x: &Tensor, links: &[Link]) -> Result<Tensor> {
        let isa = isa.checked().map_err(Error::wrap)?;
        let (_, mut channels, ..) = x.dims4()?;
        let (mut layers, mut at): (Vec<Layer>, _) = (Vec::new(), 0);
        for (i, Link { weight, bias, opts, onto }) in links.iter().enumerate() {
            let outputs = filter_channels(weight.dims4()?, channels, opts.groups)?;
            let biases = bias.as_ref().map_or(0, |b| b.elem_count());
            if bias.is_some() && biases != outputs {
                candle_core::bail!("conv3x3: {biases} biases for {outputs} channels");
            }
            let wants = (weight.track_op(), bias.as_ref().is_some_and(|b| b.track_op()));
            let onto = *onto;
            if let Some(earlier) = onto {
                let shuffles = opts.stride == 1 && opts.groups == 1 && !opts.relu && biases == 0 && i + 1 < links.len();
                let fits = layers.get(earlier).is_some_and(|l| l.onto.is_none() && 4 * l.outputs == outputs);
                let alone = layers.iter().all(|l| l.onto != onto);
                if !(shuffles && fits && alone) {
                    candle_core::bail!("conv_chain: layer {i} of {outputs} channels cannot go onto layer {earlier}");
                }
            }
            layers.push(Layer { opts: *opts, inputs: channels, outputs, at, biases, wants, onto });
            at += weight.elem_count() + biases;
            channels = if onto.is_some() { outputs / 4 } else { outputs };
        }
        let flat = links.iter().flat_map(Link::tensors).map(|t| t.flatten_all()).collect::<Result<Vec<_>>>()?;
        let halves = isa == Isa::Amx && links.iter().all(|link| link.opts.precision == Precision::Bf16);
        let form = if halves { Form::Half } else { Form::Single };
        let chain = Self { isa, form, layers, wants_input_grad: x.track_op(), kept: Mutex::default() };
        x.contiguous()?.apply_op2(&Tensor::cat(&flat, 0)?, chain)
    }

    /// The first layer that the gradient has to reach, if there is one.
    fn first_wanted(&self) -> Option<usize> {
        if self.wants_input_grad { Some(0) } else { self.layers.iter().position(|l| l.wants.0 || l.wants.1) }
    }

    /// Sizes `(C, H, W)` of an image on its way: what goes into each layer, and the result.
    fn shapes(&self, first: (usize, usize, usize)) -> Result<Vec<(usize, usize, usize)>> {
        let mut shapes = vec![first];
        for (i, layer) in self.layers.iter().enumerate() {
            let (_, h, w) = shapes[i];
            let [h, w] = [h, w].map(|n| n.div_ceil(layer.opts.stride));
            shapes.push(match layer.onto {
                None => (layer.outputs, h, w),
                Some(earlier) if shapes[earlier + 1] == (layer.outputs / 4, 2 * h, 2 * w) => shapes[earlier + 1],
                Some(earlier) => candle_core::bail!(
                    "conv_chain: twice {h}×{w}, of layer {i}, is not the size {:?} of layer {earlier}",
                    shapes[earlier + 1]
                ),
            });
        }
        Ok(shapes)
    }

    /// One image `[C,H,W]` through all layers; what is to be kept of it.
    fn image(&self, convs: &[PackedConv], x: &[f32], [c, h, w]: [usize; 3], y: &mut [f32]) -> Checked<Vec<Blocked>> {
        let keep = self.first_wanted().is_some();
        let mut image = IMAGES.take(Form::Single, (c, h, w));
        image.read_planes(c, h, w, x)?;
        // What goes into each layer, then the result.
        let mut images = vec![to_form(image, self.form)];
        Scratch::lend(|scratch| {
            for (i, (layer, conv)) in self.layers.iter().zip(convs).enumerate() {
                let image = &images[i];
                let (_, h, w) = image.shape();
                let next = match layer.onto {
                    None => {
                        let mut next = IMAGES.take(conv.form(), conv.out_shape(h, w));
                        conv.forward(image, &mut next, scratch)?;
                        next
                    }
                    Some(earlier) => onto(conv, image, &images[earlier + 1], scratch)?,
                };
                images.push(next);
                let read_again = |later: &Layer| later.onto.is_some_and(|earlier| earlier + 1 == i);
                if !keep && !self.layers[i..].iter().any(read_again) {
                    IMAGES.give([std::mem::take(&mut images[i])]);
                }
            }
            Checked::Ok(())
        })?;
        images[self.layers.len()].write_planes(y)?;
        if !(keep && self.layers.last().is_some_and(|l| l.opts.relu)) {
            IMAGES.give(images.pop());
        }
        if !keep {
            IMAGES.give(images.drain(..).filter(|image| image.bytes() > 0));
        }
        Ok(images)
    }

    /// From the gradients by the result of each image: those by its input if they are wanted, and those by the parameters.
    fn back(&self, params: &[f32], mut grads: Vec<Blocked>) -> Checked<(Vec<Blocked>, Vec<f32>)> {
        let kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let mut all = vec![0.0; params.len()];
        let first = self.first_wanted().unwrap_or(self.layers.len());
        // By the result of a layer, from the layers that went onto it.
        let mut around: Vec<Vec<Blocked>> = vec![Vec::new(); self.layers.len()];
        for (i, layer) in self.layers.iter().enumerate().skip(first).rev() {
            let inputs: Vec<&Blocked> = kept.iter().map(|kept| &kept[i]).collect();
            // Halved gradients of stride 2 are widened to stride 1.
            let (step, back) = match layer.step()? {
                step if step == Step::Same || self.form == Form::Half => (Step::Same, Step::Same),
                step => (step, Step::Double),
            };
            let ways = std::mem::take(&mut around[i]);
            grads.par_iter_mut().zip(&ways).for_each(|(grad, way)| add(grad, way));
            IMAGES.give(ways);
            grads.par_iter_mut().zip(&*kept).for_each(|(grad, kept)| {
                if layer.opts.relu {
                    mask(grad, &kept[i + 1]);
                }
                *grad = to_form(std::mem::take(grad), self.form);
            });
            if let Some(earlier) = layer.onto {
                let both = grads.into_par_iter().map(|grad| (unshuffled(&grad), grad));
                (grads, around[earlier]) = both.unzip();
            }
            if self.form == Form::Half && layer.opts.stride == 2 {
                grads.par_iter_mut().zip(&inputs).for_each(|(grad, input)| widen_stride(grad, input));
            }
            layer.parameter_grads(self.isa, step, &inputs, &grads, &mut all)?;
            if i > first || self.wants_input_grad {
                let form = if i == 0 { Form::Single } else { self.form };
                let conv = layer.adjoint(self.isa, params, back, self.form)?.giving(form);
                grads.par_iter_mut().zip(inputs).try_for_each(|(grad, input)| {
                    let (channels, height, width) = input.shape();
                    let mut dx = IMAGES.take(form, (channels, height, width));
                    Scratch::lend(|scratch| conv.forward_to((height, width), grad, &mut dx, scratch))?;
                    IMAGES.give([std::mem::replace(grad, dx)]);
                    Checked::Ok(())
                })?;
            }
        }
        Ok((grads, all))
    }
}

impl Drop for Chain {
    fn drop(&mut self) {
        let kept = self.kept.get_mut().unwrap_or_else(PoisonError::into_inner);
        IMAGES.give(kept.drain(..).flatten());
    }
}

/// The pixel-shuffled result of `conv`, added to a copy of `earlier`.
fn onto(conv: &PackedConv, image: &Blocked, earlier: &Blocked, scratch: &mut Scratch) -> Checked<Blocked> {
    let mut sum = IMAGES.take(earlier.form(), earlier.shape());
    sum.pixels_mut().copy_from_slice(earlier.pixels());
    if sum.form() == Form::Single {
        let (_, h, w) = image.shape();
        let mut quarters = IMAGES.take(conv.form(), conv.out_shape(h, w));
        conv.forward(image, &mut quarters, scratch)?;
        shuffle::add_shuffled(&quarters, &mut sum);
        IMAGES.give([quarters]);
    } else {
        conv.add_shuffled(image, &mut sum, scratch)?;
    }
    Ok(sum)
}

/// The gradient by what was shuffled onto an image, from that by the sum.
fn unshuffled(grad: &Blocked) -> Blocked {
    let (channels, h, w) = grad.shape();
    let padded = channels.next_multiple_of(shuffle::block(grad.form()));
    let mut quarters = IMAGES.take(grad.form(), (4 * padded, h / 2, w / 2));
    shuffle::unshuffle(grad, &mut quarters);
    quarters
}

/// `sum += other`, of one form and shape.
fn add(sum: &mut Blocked, other: &Blocked) {
    if sum.form() == Form::Half {
        // SAFETY: only the matrix unit makes images of this form.
        return unsafe { half::add(sum, other) };
    }
    let (_, height, _) = sum.shape();
    for (block, y) in (0..sum.blocks()).flat_map(|block| (0..height).map(move |y| (block, y))) {
        sum.row_mut(block, y).iter_mut().zip(other.row(block, y)).for_each(|(sum, other)| *sum += other);
    }
}

/// Lets a gradient through where the ReLU let its value through.
fn mask(grad: &mut Blocked, y: &Blocked) {
    if y.form() == Form::Half {
        // SAFETY: only the matrix unit makes images of this form.
        return unsafe { half::mask(grad, y) };
    }
    let (_, height, _) = y.shape();
    for block in 0..y.blocks() {
        for row in 0..height {
            for (g, &y) in grad.row_mut(block, row).iter_mut().zip(y.row(block, row)) {
                *g = if y <= 0.0 { 0.0 } else { *g };
            }
        }
    }
}

/// The image in a form of the matrix unit, if that is asked for.
fn to_form(image: Blocked, form: Form) -> Blocked {
    if image.form() == form {
        return image;
    }
    let mut halved = IMAGES.take(form, image.shape());
    // SAFETY: a chain asks for this form where there is a matrix unit.
    unsafe { half::round(&image, &mut halved) };
    IMAGES.give([image]);
    halved
}

/// Makes the gradient by a result of stride 2 one of stride 1 on the pixels of `input`.
fn widen_stride(grad: &mut Blocked, input: &Blocked) {
    let (_, height, width) = input.shape();
    let mut wide = IMAGES.take(Form::Half, (grad.shape().0, height, width));
    half::widen_stride(grad, &mut wide);
    IMAGES.give([std::mem::replace(grad, wide)]);
}

/// `Cout` of filters `[Cout, Cin/groups, 3, 3]`, checked against an input's channels.
fn filter_channels(filters: (usize, usize, usize, usize), channels: usize, groups: usize) -> Result<usize> {
    let (outputs, each, kh, kw) = filters;
    if (kh, kw) != (3, 3) || each * groups != channels {
        candle_core::bail!(
            "conv3x3: filters {filters:?} on {channels} channels in {groups} groups; they must be \
             [Cout, Cin/groups, 3, 3]"
        )
    }
    Ok(outputs)
}

/// The numbers of a contiguous tensor.
fn numbers<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    let data = storage.as_slice::<f32>()?;
    match layout.contiguous_offsets() {
        Some((from, to)) => Ok(&data[from..to]),
        None => Err(Error::RequiresContiguous { op: "conv3x3" }.bt()),
    }
}

/// The numbers of an f32 tensor, in order.
pub(crate) fn with_numbers<R>(t: &Tensor, f: impl FnOnce(&[f32]) -> Result<R>) -> Result<R> {
    let t = t.contiguous()?;
    let (storage, layout) = t.storage_and_layout();
    match &*storage {
        Storage::Cpu(s) => f(numbers(s, layout)?),
        _ => candle_core::bail!("conv3x3: the tensor is not on the CPU"),
    }
}

/// Planes `[N,C,H,W]` as images.
fn blocked(planes: &[f32], [_, c, h, w]: [usize; 4]) -> Result<Vec<Blocked>> {
    let image = |planes: &[f32]| {
        let mut image = IMAGES.take(Form::Single, (c, h, w));
        image.read_planes(c, h, w, planes).map(|()| image)
    };
    planes.par_chunks_exact(c * h * w).map(image).collect::<Checked<_>>().map_err(Error::wrap)
}

/// Images as planes `[N,C,H,W]`.
fn planes(images: &[Blocked], shape: [usize; 4]) -> Result<Tensor> {
    let mut all = vec![0.0; shape.iter().product()];
    let each = shape[1] * shape[2] * shape[3];
    let write = |(image, planes): (&Blocked, &mut [f32])| image.write_planes(planes);
    images.par_iter().zip(all.par_chunks_exact_mut(each)).try_for_each(write).map_err(Error::wrap)?;
    Tensor::from_vec(all, &shape, &Device::Cpu)
}

fn dims(t: &Tensor) -> Result<[usize; 4]> {
    t.dims4().map(|(n, c, h, w)| [n, c, h, w])
}

impl CustomOp2 for Chain {
    fn name(&self) -> &'static str {
        "conv3x3"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        params: &CpuStorage,
        params_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (n, c, h, w) = x_layout.shape().dims4()?;
        if [n, c, h, w].contains(&0) {
            return Err(Error::wrap(KernelError::Empty([n, c, h, w])));
        }
        let (x, params) = (numbers(x, x_layout)?, numbers(params, params_layout)?);
        let last = self.layers.len() - 1;
        let shape = self.shapes((c, h, w))?[last + 1];
        let packed = |(i, layer): (usize, &Layer)| {
            let form = if i == last { Form::Single } else { self.form };
            layer.packed(self.isa, params, self.form).map(|conv| conv.giving(form))
        };
        let convs = self.layers.par_iter().enumerate().map(packed).collect::<Checked<Vec<_>>>().map_err(Error::wrap)?;
        let each = shape.0 * shape.1 * shape.2;
        let mut y = vec![0.0; n * each];
        let images = x.par_chunks_exact(c * h * w).zip(y.par_chunks_exact_mut(each));
        let kept = images.map(|(x, y)| self.image(&convs, x, [c, h, w], y)).collect::<Checked<_>>();
        *self.kept.lock().unwrap_or_else(PoisonError::into_inner) = kept.map_err(Error::wrap)?;
        Ok((CpuStorage::F32(y), (n, shape.0, shape.1, shape.2).into()))
    }

    fn bwd(&self, x: &Tensor, params: &Tensor, _: &Tensor, grad: &Tensor) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let grads = with_numbers(grad, |g| blocked(g, dims(grad)?))?;
        let back = |params: &[f32]| self.back(params, grads).map_err(Error::wrap);
        let (images, all) = with_numbers(params, back)?;
        let dx = self.wants_input_grad.then(|| planes(&images, dims(x)?)).transpose()?;
        IMAGES.give(images);
        Ok((dx, params.track_op().then(|| Tensor::from_vec(all, params.shape(), &Device::Cpu)).transpose()?))
    }
}
