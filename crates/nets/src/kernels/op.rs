//! The kernels as differentiable candle operations.
//!
//! A chain of convolutions is one operation: its images stay in the blocked layout from layer to layer, forward and back, and
//! the automatic differentiation around it sees a single node.

use super::blocked::{Blocked, Form};
use super::conv::PackedConv;
use super::grad::{bias_grad, weight_grad};
use super::half;
use super::scratch::{IMAGES, Scratch};
use super::simd::Isa;
use super::{KernelError, Step, Weights};
use candle_core::{CpuStorage, CustomOp2, DType, Device, Error, Layout, Result, Shape, Storage, Tensor};
use rayon::prelude::*;
use std::sync::{Mutex, PoisonError};

/// Of what knows nothing of candle.
type Checked<T> = std::result::Result<T, KernelError>;

/// How a 3×3 convolution is done; the padding is always one zero on each side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Conv3x3 {
    /// Step between output pixels: 1 or 2.
    pub stride: usize,
    /// Number of channel groups; it divides both channel counts.
    pub groups: usize,
    /// Apply `max(·, 0)` to the result.
    pub relu: bool,
    /// What numbers are multiplied.
    pub precision: Precision,
}

impl Default for Conv3x3 {
    /// Stride 1, one group, no ReLU, f32.
    fn default() -> Self {
        Self { stride: 1, groups: 1, relu: false, precision: Precision::F32 }
    }
}

/// What numbers are multiplied, and kept between the layers of a [`conv_chain`]; sums and parameters are f32 in any case.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// f32.
    #[default]
    F32,
    /// bf16, 8 bits: twice as fast to train with, and where the processor has no matrix unit for it, f32.
    Bf16,
}

/// A layer of a [`conv_chain`].
#[derive(Debug, Clone)]
pub struct Link {
    /// `[Cout,Cin/groups,3,3]`.
    pub weight: Tensor,
    /// `[Cout]`.
    pub bias: Option<Tensor>,
    /// How it is done.
    pub opts: Conv3x3,
}

impl Link {
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
/// f32 on the CPU runs on the kernels of this module, anything else on candle's own operations.
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
    conv_chain(x, &[Link { weight: w.clone(), bias: bias.cloned(), opts }])
}

/// As [`conv3x3`], for f32 on the CPU and a given instruction set.
///
/// # Errors
/// As [`conv3x3`], when a tensor is not f32 on the CPU, and when this machine lacks the instruction set.
pub fn conv3x3_on(isa: Isa, x: &Tensor, w: &Tensor, bias: Option<&Tensor>, opts: Conv3x3) -> Result<Tensor> {
    Chain::run(isa, x, &[Link { weight: w.clone(), bias: bias.cloned(), opts }])
}

/// Convolutions one after another, each as [`conv3x3`]; differentiable in the input and in all weights and biases. Until the
/// result is dropped, what every layer was given is kept for the way back, if any gradient is asked for.
///
/// ```
/// use candle_core::{DType, Device, Tensor};
/// use nets::kernels::{Conv3x3, Link, conv_chain};
/// let weight = Tensor::ones((1, 1, 3, 3), DType::F32, &Device::Cpu)?;
/// let link = Link { weight, bias: None, opts: Conv3x3 { stride: 2, ..Conv3x3::default() } };
/// let x = Tensor::ones((1, 1, 4, 4), DType::F32, &Device::Cpu)?;
/// assert_eq!(conv_chain(&x, &[link.clone(), link])?.flatten_all()?.to_vec1::<f32>()?, [25.]);
/// # Ok::<(), candle_core::Error>(())
/// ```
///
/// # Errors
/// As [`conv3x3`].
pub fn conv_chain(x: &Tensor, links: &[Link]) -> Result<Tensor> {
    let ours = |t: &Tensor| t.device().is_cpu() && t.dtype() == DType::F32;
    if !links.is_empty() && ours(x) && links.iter().flat_map(Link::tensors).all(ours) {
        let bf16 = links.iter().all(|link| link.opts.precision == Precision::Bf16);
        let isa = if bf16 { Isa::detect() } else { Isa::detect_for_gradients() };
        return Chain::run(isa.map_err(Error::wrap)?, x, links);
    }
    links.iter().try_fold(x.clone(), |x, link| link.by_candle(&x))
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
}

impl Layer {
    fn weights<'p>(&self, params: &'p [f32]) -> &'p [f32] {
        &params[self.at..][..self.outputs * (self.inputs / self.opts.groups) * 9]
    }

    fn step(&self) -> Checked<Step> {
        Step::of_stride(self.opts.stride)
    }

    fn packed(&self, isa: Isa, params: &[f32]) -> Checked<PackedConv> {
        let weights = self.weights(params);
        let bias = &params[self.at + weights.len()..][..self.biases];
        let bias = (self.biases > 0).then_some(bias);
        PackedConv::new_on(isa, weights, bias, self.inputs, self.outputs, self.opts)
    }

    /// The gradient by the input, as a convolution of the gradient by the result, with this step.
    fn adjoint(&self, isa: Isa, params: &[f32], step: Step) -> Checked<PackedConv> {
        let weights = Weights::new(self.weights(params), self.inputs, self.outputs, self.opts.groups)?;
        Ok(PackedConv::pack(isa, &weights.adjoint(), step, self.opts.precision))
    }

    /// Writes the gradients that are wanted to their places among those of all parameters.
    fn parameter_grads(&self, isa: Isa, step: Step, x: &[&Blocked], grads: &[Blocked], all: &mut [f32]) -> Checked<()> {
        let halves = grads.first().is_some_and(|grad| grad.form() == Form::Half);
        let own = &mut all[self.at..];
        let bias = match self.wants {
            (weights, bias) if weights || halves && bias => {
                let shape = (self.inputs, self.outputs, self.opts.groups);
                let (dw, db) = Scratch::lend(|scratch| weight_grad(isa, x, grads, shape, step, scratch))?;
                own[..dw.len()].copy_from_slice(&dw);
                db
            }
            (_, true) => bias_grad(grads, self.outputs),
            (_, false) => return Ok(()),
        };
        let weights = self.outputs * (self.inputs / self.opts.groups) * 9;
        own[weights..][..self.biases].copy_from_slice(&bias[..self.biases]);
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
        let (mut layers, mut at) = (Vec::new(), 0);
        for Link { weight, bias, opts } in links {
            let outputs = filter_channels(weight.dims4()?, channels, opts.groups)?;
            let biases = bias.as_ref().map_or(0, |b| b.elem_count());
            if bias.is_some() && biases != outputs {
                candle_core::bail!("conv3x3: {biases} biases for {outputs} channels");
            }
            let wants = (weight.track_op(), bias.as_ref().is_some_and(|b| b.track_op()));
            layers.push(Layer { opts: *opts, inputs: channels, outputs, at, biases, wants });
            at += weight.elem_count() + biases;
            channels = outputs;
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

    /// One image `[C,H,W]` through all layers; what is to be kept of it.
    fn image(&self, convs: &[PackedConv], x: &[f32], [c, h, w]: [usize; 3], y: &mut [f32]) -> Checked<Vec<Blocked>> {
        let (keep, mut kept) = (self.first_wanted().is_some(), Vec::new());
        let mut image = IMAGES.take(Form::Single, (c, h, w));
        image.read_planes(c, h, w, x)?;
        image = to_form(image, self.form);
        Scratch::lend(|scratch| {
            for conv in convs {
                let (_, h, w) = image.shape();
                let mut next = IMAGES.take(conv.form(), conv.out_shape(h, w));
                conv.forward(&image, &mut next, scratch)?;
                let before = std::mem::replace(&mut image, next);
                if keep { kept.push(before) } else { IMAGES.give([before]) }
            }
            Checked::Ok(())
        })?;
        image.write_planes(y)?;
        if keep && self.layers.last().is_some_and(|l| l.opts.relu) {
            kept.push(image);
        } else {
            IMAGES.give([image]);
        }
        Ok(kept)
    }

    /// From the gradients by the result of each image: those by its input if they are wanted, and those by the parameters.
    fn back(&self, params: &[f32], mut grads: Vec<Blocked>) -> Checked<(Vec<Blocked>, Vec<f32>)> {
        let kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let mut all = vec![0.0; params.len()];
        let first = self.first_wanted().unwrap_or(self.layers.len());
        for (i, layer) in self.layers.iter().enumerate().skip(first).rev() {
            let inputs: Vec<&Blocked> = kept.iter().map(|kept| &kept[i]).collect();
            // Halved gradients of stride 2 are widened to stride 1.
            let (step, back) = match layer.step()? {
                step if step == Step::Same || self.form == Form::Half => (Step::Same, Step::Same),
                step => (step, Step::Double),
            };
            grads.par_iter_mut().zip(&*kept).for_each(|(grad, kept)| {
                if layer.opts.relu {
                    mask(grad, &kept[i + 1]);
                }
                *grad = to_form(std::mem::take(grad), self.form);
            });
            if self.form == Form::Half && layer.opts.stride == 2 {
                grads.par_iter_mut().zip(&inputs).for_each(|(grad, input)| widen_stride(grad, input));
            }
            layer.parameter_grads(self.isa, step, &inputs, &grads, &mut all)?;
            if i > first || self.wants_input_grad {
                let form = if i == 0 { Form::Single } else { self.form };
                let conv = layer.adjoint(self.isa, params, back)?.giving(form);
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

fn with_numbers<R>(t: &Tensor, f: impl FnOnce(&[f32]) -> Result<R>) -> Result<R> {
    let t = t.contiguous()?;
    let (storage, layout) = t.storage_and_layout();
    match &*storage {
        Storage::Cpu(s) => f(numbers(s, layout)?),
        _ => candle_core::bail!("conv3x3: the tensor left the CPU"),
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
        let packed = |(i, layer): (usize, &Layer)| {
            let form = if i == last { Form::Single } else { self.form };
            layer.packed(self.isa, params).map(|conv| conv.giving(form))
        };
        let convs = self.layers.par_iter().enumerate().map(packed).collect::<Checked<Vec<_>>>().map_err(Error::wrap)?;
        let shape = convs.iter().fold((c, h, w), |(_, h, w), conv| conv.out_shape(h, w));
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
        Ok((dx, params.track_op().then(|| Tensor::new(all, &Device::Cpu)).transpose()?))
    }
}
