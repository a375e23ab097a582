//! The kernels as differentiable candle operations.

use super::conv::PackedConv;
use super::grad::{Operands, weight_grad};
use super::scratch::Scratch;
use super::simd::Isa;
use super::{KernelError, Step, Weights};
use candle_core::{CpuStorage, CustomOp2, CustomOp3, DType, Device, Error, Layout, Result, Shape, Storage, Tensor};
use rayon::prelude::*;

/// How a 3×3 convolution is done; the padding is always one zero on each side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Conv3x3 {
    /// Step between output pixels: 1 or 2.
    pub stride: usize,
    /// Number of channel groups; it divides both channel counts.
    pub groups: usize,
    /// Apply `max(·, 0)` to the result.
    pub relu: bool,
}

impl Default for Conv3x3 {
    /// Stride 1, one group, no ReLU.
    fn default() -> Self {
        Self { stride: 1, groups: 1, relu: false }
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
    let ours = |t: &Tensor| t.device().is_cpu() && t.dtype() == DType::F32;
    if ours(x) && ours(w) && bias.is_none_or(ours) {
        return conv3x3_on(Isa::detect_for_gradients().map_err(Error::wrap)?, x, w, bias, opts);
    }
    let y = x.conv2d(w, 1, opts.stride, 1, opts.groups)?;
    let y = match bias {
        Some(b) => y.broadcast_add(&b.reshape((1, (), 1, 1))?)?,
        None => y,
    };
    if opts.relu { y.relu() } else { Ok(y) }
}

/// As [`conv3x3`], for f32 on the CPU and a given instruction set.
///
/// # Errors
/// As [`conv3x3`], when a tensor is not f32 on the CPU, and when this machine lacks the instruction set.
pub fn conv3x3_on(isa: Isa, x: &Tensor, w: &Tensor, bias: Option<&Tensor>, opts: Conv3x3) -> Result<Tensor> {
    let isa = isa.checked().map_err(Error::wrap)?;
    let op = Op { isa, opts };
    let (x, w) = (x.contiguous()?, w.contiguous()?);
    match bias {
        Some(b) => x.apply_op3(&w, &b.contiguous()?, op),
        None => x.apply_op2(&w, op),
    }
}

#[derive(Debug, Clone, Copy)]
struct Op {
    isa: Isa,
    opts: Conv3x3,
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

/// `[Cout, Cin]` of filters `[Cout, Cin/groups, 3, 3]`, checked against an input's channels.
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

/// Runs a packed convolution on planes.
fn run(conv: &PackedConv, x: &[f32], shape: [usize; 4], out: (usize, usize)) -> Result<Vec<f32>> {
    let len = shape[0] * conv.channels().1 * out.0 * out.1;
    let mut y = Vec::with_capacity(len);
    Scratch::lend(|scratch| {
        // SAFETY: `y` has room for the result, all of which is written before it becomes its content.
        unsafe {
            conv.forward_planes(x, shape, y.as_mut_ptr(), out, scratch)?;
            y.set_len(len);
        }
        Ok::<_, KernelError>(())
    })
    .map_err(Error::wrap)?;
    Ok(y)
}

impl Op {
    fn step(&self) -> Result<Step> {
        Step::of_stride(self.opts.stride).map_err(Error::wrap)
    }

    fn forward(
        &self,
        x: (&CpuStorage, &Layout),
        w: (&CpuStorage, &Layout),
        bias: Option<&[f32]>,
    ) -> Result<(CpuStorage, Shape)> {
        let (n, channels, height, width) = x.1.shape().dims4()?;
        let outputs = filter_channels(w.1.shape().dims4()?, channels, self.opts.groups)?;
        let step = self.step()?;
        let out = (step.out_size(height), step.out_size(width));
        let weights = numbers(w.0, w.1)?;
        let conv = PackedConv::new_on(self.isa, weights, bias, channels, outputs, self.opts).map_err(Error::wrap)?;
        let y = run(&conv, numbers(x.0, x.1)?, [n, channels, height, width], out)?;
        Ok((CpuStorage::F32(y), (n, outputs, out.0, out.1).into()))
    }

    /// The gradient before the ReLU, which lets through what it let through before.
    fn unmask(&self, y: &Tensor, grad: &Tensor) -> Result<Tensor> {
        if !self.opts.relu {
            return grad.contiguous();
        }
        let masked = with_numbers(y, |y| {
            with_numbers(grad, |g| {
                let mut out = Vec::with_capacity(g.len());
                y.par_iter()
                    .zip(g)
                    .with_min_len(1 << 14)
                    .map(|(&y, &g)| if y <= 0.0 { 0.0 } else { g })
                    .collect_into_vec(&mut out);
                Ok(out)
            })
        })?;
        Tensor::from_vec(masked, grad.shape(), &Device::Cpu)
    }

    fn input_grad(&self, x: &Tensor, w: &Tensor, grad: &Tensor) -> Result<Tensor> {
        let (n, channels, height, width) = x.dims4()?;
        let (_, outputs, out_h, out_w) = grad.dims4()?;
        let step = match self.step()? {
            Step::Half => Step::Double,
            other => other,
        };
        let conv = with_numbers(w, |w| {
            let weights = Weights::new(w, channels, outputs, self.opts.groups).map_err(Error::wrap)?;
            Ok(PackedConv::pack(self.isa, &weights.adjoint(), step))
        })?;
        let dx = with_numbers(grad, |g| run(&conv, g, [n, outputs, out_h, out_w], (height, width)))?;
        Tensor::from_vec(dx, (n, channels, height, width), &Device::Cpu)
    }

    /// By the bias alone: sums over frames and pixels, in f64 in a fixed order.
    fn bias_grad(grad: &Tensor) -> Result<Tensor> {
        let (n, outputs, height, width) = grad.dims4()?;
        let db = with_numbers(grad, |g| {
            let plane = height * width;
            let sum = |o: usize| -> f64 {
                (0..n).flat_map(|i| &g[(i * outputs + o) * plane..][..plane]).map(|&v| f64::from(v)).sum()
            };
            Ok((0..outputs).into_par_iter().map(|o| sum(o) as f32).collect::<Vec<_>>())
        })?;
        Tensor::from_vec(db, outputs, &Device::Cpu)
    }

    /// By weight and bias.
    fn weight_grad(&self, x: &Tensor, w: &Tensor, grad: &Tensor) -> Result<(Tensor, Tensor)> {
        let (n, channels, height, width) = x.dims4()?;
        let outputs = w.dim(0)?;
        let step = self.step()?;
        let (dw, db) = with_numbers(x, |x| {
            with_numbers(grad, |g| {
                Scratch::lend(|scratch| {
                    let operands = Operands { input: x, shape: [n, channels, height, width], grad: g, outputs };
                    weight_grad(self.isa, &operands, step, self.opts.groups, scratch)
                })
                .map_err(Error::wrap)
            })
        })?;
        Ok((Tensor::from_vec(dw, w.shape(), &Device::Cpu)?, Tensor::from_vec(db, outputs, &Device::Cpu)?))
    }
}

impl CustomOp2 for Op {
    fn name(&self) -> &'static str {
        "conv3x3"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        w: &CpuStorage,
        w_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        self.forward((x, x_layout), (w, w_layout), None)
    }

    fn bwd(&self, x: &Tensor, w: &Tensor, y: &Tensor, grad: &Tensor) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let grad = self.unmask(y, grad)?;
        let dx = x.track_op().then(|| self.input_grad(x, w, &grad));
        let dw = w.track_op().then(|| self.weight_grad(x, w, &grad));
        Ok((dx.transpose()?, dw.transpose()?.map(|(dw, _)| dw)))
    }
}

impl CustomOp3 for Op {
    fn name(&self) -> &'static str {
        "conv3x3"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        w: &CpuStorage,
        w_layout: &Layout,
        b: &CpuStorage,
        b_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        self.forward((x, x_layout), (w, w_layout), Some(numbers(b, b_layout)?))
    }

    fn bwd(
        &self,
        x: &Tensor,
        w: &Tensor,
        b: &Tensor,
        y: &Tensor,
        grad: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let grad = self.unmask(y, grad)?;
        let dx = x.track_op().then(|| self.input_grad(x, w, &grad));
        let (dw, db) = match (w.track_op(), b.track_op()) {
            (true, _) => self.weight_grad(x, w, &grad).map(|(dw, db)| (Some(dw), Some(db)))?,
            (false, true) => (None, Some(Self::bias_grad(&grad)?)),
            (false, false) => (None, None),
        };
        Ok((dx.transpose()?, dw, db))
    }
}
