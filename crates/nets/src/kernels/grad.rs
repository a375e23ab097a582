//! The gradient by weight and bias.
//!
//! The batch is cut into chunks of strips, as many as the shape alone says; each chunk is summed by one worker in order,
//! and the chunks' sums are added in order, so that the result does not depend on the number of threads.

use super::blocked::{Pixel, Planes, ZERO, padded};
use super::conv::{prefers_winograd, strip_rows};
use super::scratch::{Scratch, Slot, band};
use super::simd::{Isa, LANES};
use super::{GradStrip, KernelError, Step, Weights, direct, winograd};
use std::sync::Mutex;

/// Chunks of a batch: enough to occupy a few cores, few enough that their sums stay a small part of the memory traffic.
const MAX_CHUNKS: usize = 8;

enum Plan {
    Winograd(winograd::GradPlan),
    Direct(direct::GradPlan),
}

/// What the gradient is taken of.
pub(super) struct Operands<'a> {
    /// `[N,Cin,H,W]`.
    pub(super) input: &'a [f32],
    pub(super) shape: [usize; 4],
    /// `∂y [N,Cout,..]`.
    pub(super) grad: &'a [f32],
    pub(super) outputs: usize,
}

/// `∂w[o,i] = Σ_n ∂y[n,o] ⋆ x[n,i]` as `[Cout, Cin/groups, 3, 3]`, and `∂b[o] = Σ ∂y[n,o]`.
pub(super) fn weight_grad(
    isa: Isa,
    operands: &Operands<'_>,
    step: Step,
    groups: usize,
    scratch: &mut Scratch,
) -> Result<(Vec<f32>, Vec<f32>), KernelError> {
    let Operands { input, shape: [n, inputs, height, width], grad, outputs } = *operands;
    let (out_h, out_w) = (step.out_size(height), step.out_size(width));
    super::blocked::check_len(n * inputs * height * width, input.len())?;
    super::blocked::check_len(n * outputs * out_h * out_w, grad.len())?;
    let mut result = vec![0.0; outputs * (inputs / groups) * 9];
    let weights = Weights::new(&result, inputs, outputs, groups)?;
    let plan = if prefers_winograd(inputs, outputs, groups, step) {
        Plan::Winograd(winograd::GradPlan::new(inputs, outputs, isa.vecs()))
    } else {
        Plan::Direct(direct::GradPlan::new(&weights, step, isa.vecs()))
    };
    let blocks = outputs.div_ceil(LANES);
    let pixels = blocks
        + match &plan {
            Plan::Winograd(p) => p.pixels,
            Plan::Direct(p) => p.pixels,
        };

    let each = strip_rows(out_w);
    let strips = out_h.div_ceil(each);
    let chunks = (n * strips).min(MAX_CHUNKS);
    let mut buffers = std::mem::take(&mut scratch.sums);
    buffers.resize_with(chunks.max(buffers.len()), Default::default);
    let sums: Vec<Mutex<&mut [Pixel]>> = buffers[..chunks].iter_mut().map(|b| Mutex::new(b.zeros(pixels))).collect();
    scratch.each(chunks, |chunk, slot| {
        let mut sums = sums[chunk].lock().expect("no other worker has this chunk");
        let (bias, weights) = sums.split_at_mut(blocks);
        for job in chunk * n * strips / chunks..(chunk + 1) * n * strips / chunks {
            let (image, y) = (job / strips, job % strips * each);
            let rows = each.min(out_h - y);
            let x = Planes {
                ptr: input[image * inputs * height * width..].as_ptr(),
                plane: height * width,
                channels: inputs,
                height,
                width,
            };
            let g = Planes {
                ptr: grad[image * outputs * out_h * out_w..].as_ptr(),
                plane: out_h * out_w,
                channels: outputs,
                height: out_h,
                width: out_w,
            };
            // SAFETY: the planes are those of image `image`; `isa` is available; the strip has what is read of it.
            unsafe {
                let (first, read) = (step.first_row(y), step.input_rows(rows));
                let Slot { src, dst, .. } = slot;
                let input = band(isa, x, 1, first, read, padded(width), src);
                let tall = rows.next_multiple_of(winograd::TILE);
                let mut grad = band(isa, g, 0, y, tall, padded(out_w), dst);
                grad.ptr = grad.ptr.add(LANES);
                let strip = GradStrip { input, grad, rows, width: out_w };
                add_bias(bias, &strip);
                match &plan {
                    Plan::Winograd(p) => winograd::weight_grad(isa, p, weights, strip, slot),
                    Plan::Direct(p) => direct::weight_grad(isa, p, weights, strip),
                }
            }
        }
    });
    drop(sums);
    let (total, others) = buffers[..chunks].split_at_mut(1);
    let total = total[0].pixels();
    for other in others {
        winograd::add(total, other.pixels());
    }
    let (bias, total) = total.split_at(blocks);
    let bias = bias.iter().flat_map(|b| b.0).take(outputs).collect();
    match &plan {
        Plan::Winograd(p) => p.finish(total, &mut result),
        Plan::Direct(p) => {
            let shape = Weights { data: &[], ..weights };
            p.finish(&shape, total, &mut result);
        }
    }
    scratch.sums = buffers;
    Ok((result, bias))
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
