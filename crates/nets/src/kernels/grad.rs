//! The gradient by weight and bias.
//!
//! The batch is cut into chunks of strips, as many as the shape alone says; each chunk is summed by one worker in order,
//! and the chunks' sums are added in order, so that the result does not depend on the number of threads.

use super::blocked::{Blocked, Form, Pixel, ZERO};
use super::conv::{prefers_winograd, strip_rows};
use super::error::KernelError;
use super::geometry::{GradStrip, Step, Weights};
#[cfg(target_arch = "x86_64")]
use super::half;
use super::isa::Isa;
use super::scratch::Scratch;
use super::simd::LANES;
use super::{direct, winograd};
use rayon::prelude::*;
use std::sync::Mutex;

/// Chunks of a batch: enough to occupy a few cores, few enough that their sums stay a small part of the memory traffic.
const MAX_CHUNKS: usize = 8;

/// The fewest output pixels of a chunk: a deep layer's sums are as much memory as its images. Strips of so many pixels together
/// are worked on at once by the matrix unit.
const CHUNK_PIXELS: usize = 1024;

enum Plan {
    Winograd(winograd::GradPlan),
    Direct(direct::GradPlan),
    #[cfg(target_arch = "x86_64")]
    Half(half::GradPlan),
}

impl Plan {
    fn new(isa: Isa, form: Form, shape: &Weights<'_>, step: Step) -> Self {
        let Weights { inputs, outputs, groups, .. } = *shape;
        match form {
            #[cfg(target_arch = "x86_64")]
            Form::Half => Self::Half(half::GradPlan::new(inputs, outputs)),
            _ if prefers_winograd(inputs, outputs, groups, step) => {
                Self::Winograd(winograd::GradPlan::new(inputs, outputs, isa.vecs()))
            }
            _ => Self::Direct(direct::GradPlan::new(shape, step, isa.vecs())),
        }
    }

    /// Cache lines of the sums of the bias, and of the weights.
    fn pixels(&self, outputs: usize) -> (usize, usize) {
        match self {
            Self::Winograd(p) => (outputs.div_ceil(LANES), p.pixels),
            Self::Direct(p) => (outputs.div_ceil(LANES), p.pixels),
            #[cfg(target_arch = "x86_64")]
            Self::Half(p) => (p.bias_pixels(), p.pixels),
        }
    }
}

/// `∂w[o,i] = Σ_n ∂y[n,o] ⋆ x[n,i]` as `[Cout, Cin/groups, 3, 3]`, and `∂b[o] = Σ ∂y[n,o]`, of as many images `grads` of ∂y
/// as `x` of the input, all of the same form; `(inputs, outputs, groups)` are those of the convolution. Halved images are of
/// stride 1.
pub(super) fn weight_grad(
    isa: Isa,
    x: &[&Blocked],
    grads: &[Blocked],
    (inputs, outputs, groups): (usize, usize, usize),
    step: Step,
    scratch: &mut Scratch,
) -> Result<(Vec<f32>, Vec<f32>), KernelError> {
    let mut result = vec![0.0; outputs * (inputs / groups) * 9];
    let weights = Weights::new(&result, inputs, outputs, groups)?;
    let (form, (_, out_h, out_w)) = grads.first().map_or_else(Default::default, |g| (g.form(), g.shape()));
    let plan = Plan::new(isa, form, &weights, step);
    let (blocks, pixels) = plan.pixels(outputs);
    let pixels = blocks + pixels;

    let each = strip_rows(out_w);
    let strips = out_h.div_ceil(each);
    let jobs = grads.len() * strips;
    let chunks = jobs.min(MAX_CHUNKS).min((grads.len() * out_h * out_w / CHUNK_PIXELS).max(1));
    let mut buffers = std::mem::take(&mut scratch.sums);
    buffers.resize_with(chunks.max(buffers.len()), Default::default);
    let sums: Vec<Mutex<&mut [Pixel]>> = buffers[..chunks].iter_mut().map(|b| Mutex::new(b.zeros(pixels))).collect();
    scratch.each(chunks, |chunk, slot| {
        let mut sums = sums[chunk].lock().expect("no other worker has this chunk");
        let (bias, weights) = sums.split_at_mut(blocks);
        let strip = |job: usize| {
            let (image, y) = (job / strips, job % strips * each);
            GradStrip {
                input: x[image].view().down(step.first_row(y)),
                grad: grads[image].view().inner().down(y),
                rows: each.min(out_h - y),
                width: out_w,
            }
        };
        let of_chunk: Vec<GradStrip> = (chunk * jobs / chunks..(chunk + 1) * jobs / chunks).map(strip).collect();
        // SAFETY: both images have the strips, a border and whole tiles; `isa` is available.
        unsafe {
            match &plan {
                Plan::Winograd(p) => of_chunk.iter().for_each(|strip| {
                    add_bias(bias, strip);
                    winograd::weight_grad(isa, p, weights, *strip, slot);
                }),
                Plan::Direct(p) => of_chunk.iter().for_each(|strip| {
                    add_bias(bias, strip);
                    direct::weight_grad(isa, p, weights, *strip);
                }),
                #[cfg(target_arch = "x86_64")]
                Plan::Half(p) => {
                    let together = (CHUNK_PIXELS / (each.min(out_h) * out_w)).max(1);
                    of_chunk.chunks(together).for_each(|some| half::weight_grad(p, bias, weights, some, slot));
                }
            }
        }
    });
    drop(sums);
    if let Some((total, others)) = buffers[..chunks].split_first_mut() {
        let total = total.pixels();
        for other in others {
            winograd::add(total, other.pixels());
        }
        let (_, total) = total.split_at(blocks);
        let shape = Weights { data: &[], ..weights };
        match &plan {
            Plan::Winograd(p) => p.finish(total, &mut result),
            Plan::Direct(p) => p.finish(&shape, total, &mut result),
            #[cfg(target_arch = "x86_64")]
            Plan::Half(p) => p.finish(&shape, total, &mut result),
        }
    }
    let bias = buffers[..chunks].iter_mut().take(1).flat_map(|b| b.pixels()[..blocks].iter().flat_map(|b| b.0));
    let bias = bias.take(outputs).collect();
    scratch.sums = buffers;
    Ok((result, bias))
}

/// By the bias alone: sums over images and pixels, in f64 in a fixed order.
pub(super) fn bias_grad(grads: &[Blocked], outputs: usize) -> Vec<f32> {
    let sum = |block: usize| {
        let mut sum = [0f64; LANES];
        for grad in grads {
            for y in 0..grad.shape().1 {
                for pixel in grad.row(block, y).as_chunks::<LANES>().0 {
                    (0..LANES).for_each(|k| sum[k] += f64::from(pixel[k]));
                }
            }
        }
        sum.map(|s| s as f32)
    };
    let sums: Vec<_> = (0..outputs.div_ceil(LANES)).into_par_iter().map(sum).collect();
    sums.into_iter().flatten().take(outputs).collect()
}

/// Adds a strip's output gradient up, row by row.
///
/// # Safety
/// The strip must be readable.
unsafe fn add_bias(bias: &mut [Pixel], strip: &GradStrip) {
    for (block, sum) in bias.iter_mut().enumerate() {
        for y in 0..strip.rows {
            // SAFETY: the caller's contract.
            let row = unsafe {
                std::slice::from_raw_parts(
                    strip.grad.ptr.add(block * strip.grad.block + y * strip.grad.row).cast::<Pixel>(),
                    strip.width,
                )
            };
            let mut line = ZERO;
            for p in row {
                for k in 0..LANES {
                    line.0[k] += p.0[k];
                }
            }
            for k in 0..LANES {
                sum.0[k] += line.0[k];
            }
        }
    }
}
