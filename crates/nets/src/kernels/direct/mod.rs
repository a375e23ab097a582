//! Convolution by its definition over channel blocks: for strides, groups, few channels and tiny images.

#[cfg(target_arch = "x86_64")]
mod integers;

#[cfg(target_arch = "x86_64")]
pub(super) use integers::{Integers, forward as forward_in_integers};

use super::blocked::{Pixel, ZERO};
use super::geometry::{ChannelRun, GradStrip, Panel, Step, Strip, Weights};
use super::scratch::Slot;
use super::simd::{LANES, Simd, entry};
use super::tile::{Out, Run, outer, product};

/// Input channels, one row and column of the filter away.
#[derive(Debug, Clone, Copy)]
struct Tap {
    row: usize,
    column: usize,
    run: ChannelRun,
}

impl Tap {
    /// Where its numbers are, in an image with that much between its blocks and its rows.
    #[inline(always)]
    fn at(&self, block: usize, row: usize) -> Run {
        let Self { row: y, column, run } = *self;
        Run { offset: run.block * block + y * row + column * LANES + run.lane, len: run.len }
    }
}

/// One panel of output channels at the output pixels of one parity.
#[derive(Debug)]
struct Part {
    panel: Panel,
    taps: Vec<Tap>,
    /// Where its weights start.
    first: usize,
    /// Parity of the output row and column; zero unless the convolution is a transposed one.
    parity: (usize, usize),
}

/// A convolution's filters, in the order in which they are read.
#[derive(Debug)]
pub(super) struct Direct {
    parts: Vec<Part>,
    filters: Vec<Pixel>,
    step: Step,
}

/// Filter taps that reach an output pixel of that parity, with the row (or column) of the padded input they read.
fn taps_1d(step: Step, parity: usize) -> &'static [(usize, usize)] {
    match (step, parity) {
        (Step::Same | Step::Half, _) => &[(0, 0), (1, 1), (2, 2)],
        // dx[2i] takes dy[i] by the middle tap; dx[2i+1] takes dy[i] and dy[i+1] by the outer ones (filters are rotated)
        (Step::Double, 0) => &[(1, 1)],
        (Step::Double, _) => &[(0, 1), (2, 2)],
    }
}

impl Direct {
    pub(super) fn new(weights: &Weights<'_>, step: Step, vecs: usize) -> Self {
        let mut direct = Self { parts: Vec::new(), filters: Vec::new(), step };
        let parities = if step == Step::Double { 2 } else { 1 };
        for py in 0..parities {
            for px in 0..parities {
                for panel in Panel::cut(weights.outputs, vecs) {
                    direct.push(weights, panel, (py, px));
                }
            }
        }
        direct
    }

    fn push(&mut self, weights: &Weights<'_>, panel: Panel, parity: (usize, usize)) {
        let first = self.filters.len();
        let mut taps = Vec::new();
        for run in panel.input_runs(weights) {
            for &(ky, row) in taps_1d(self.step, parity.0) {
                for &(kx, column) in taps_1d(self.step, parity.1) {
                    taps.push(Tap { row, column, run });
                    for c in run.channels() {
                        for v in 0..panel.vecs {
                            let mut w = ZERO;
                            let o = (panel.block + v) * LANES;
                            for (k, w) in w.0.iter_mut().enumerate().take(weights.outputs - o) {
                                *w = weights.at(o + k, c, ky * 3 + kx);
                            }
                            self.filters.push(w);
                        }
                    }
                }
            }
        }
        self.parts.push(Part { panel, taps, first, parity });
    }
}

entry!(pub(super) fn forward = forward_strip(
    conv: &Direct, bias: &[Pixel], floor: f32, strip: Strip, slot: &mut Slot,
));

#[inline(always)]
unsafe fn forward_strip<S: Simd>(conv: &Direct, bias: &[Pixel], floor: f32, strip: Strip, slot: &mut Slot) {
    // SAFETY: the caller's contract.
    unsafe {
        if conv.step == Step::Half {
            forward_by::<S, { 2 * LANES }>(conv, bias, floor, strip, slot);
        } else {
            forward_by::<S, LANES>(conv, bias, floor, strip, slot);
        }
    }
}

#[inline(always)]
unsafe fn forward_by<S: Simd, const STEP: usize>(
    conv: &Direct,
    bias: &[Pixel],
    floor: f32,
    strip: Strip,
    slot: &mut Slot,
) {
    let out_step = if conv.step == Step::Double { 2 } else { 1 };
    let mut i = 0;
    while i < conv.parts.len() {
        let Part { panel, ref taps, first, parity: (py, px) } = conv.parts[i];
        slot.runs.clear();
        slot.runs.extend(taps.iter().map(|tap| tap.at(strip.src.block, strip.src.row)));
        let count = strip.width.saturating_sub(px).div_ceil(out_step);
        let mut y = py;
        while y < strip.rows {
            // SAFETY: output rows below `rows` read input rows that a strip's source has; `bias` and the filters have
            // what the panel takes.
            unsafe {
                product::<S, STEP>(
                    panel.vecs,
                    count,
                    strip.src.ptr.add(y / out_step * (STEP / LANES) * strip.src.row),
                    &slot.runs,
                    conv.filters.as_ptr().add(first).cast(),
                    bias.as_ptr().add(panel.block).cast(),
                    floor,
                    Out {
                        ptr: strip.dst.ptr.add(panel.block * strip.dst.block + y * strip.dst.row + px * LANES),
                        step: out_step * LANES,
                        vec_step: strip.dst.block,
                    },
                );
            }
            y += out_step;
        }
        i += 1;
    }
}

/// Sums of the weight gradient: for each panel, `[run][9][channels of the run][vecs · 16]`.
#[derive(Debug)]
pub(super) struct GradPlan {
    parts: Vec<(Panel, Vec<ChannelRun>)>,
    step: Step,
    pub(super) pixels: usize,
}

impl GradPlan {
    /// `weights` gives the shape alone.
    pub(super) fn new(weights: &Weights<'_>, step: Step, vecs: usize) -> Self {
        let parts: Vec<(Panel, Vec<_>)> = Panel::cut(weights.outputs, vecs)
            .into_iter()
            .map(|panel| (panel, panel.input_runs(weights).collect()))
            .collect();
        let pixels = parts.iter().map(|(panel, runs)| 9 * panel.vecs * runs.iter().map(|r| r.len).sum::<usize>()).sum();
        Self { parts, step, pixels }
    }

    /// Writes the sums to `grad [Cout, Cin/groups, 3, 3]`.
    pub(super) fn finish(&self, shape: &Weights<'_>, sums: &[Pixel], grad: &mut [f32]) {
        let mut sums = sums.iter();
        for (panel, runs) in &self.parts {
            for run in runs {
                for tap in 0..9 {
                    for c in run.channels() {
                        for v in 0..panel.vecs {
                            let sum = sums.next().expect("the plan counted its own sums");
                            let o = (panel.block + v) * LANES;
                            for (k, &g) in sum.0.iter().enumerate().take(shape.outputs - o) {
                                if let Some(at) = shape.index(o + k, c, tap) {
                                    grad[at] = g;
                                }
                            }
                        }
                    }
                }
            }
        }
    }
}

entry!(pub(super) fn weight_grad = weight_grad_strip(plan: &GradPlan, sums: &mut [Pixel], strip: GradStrip));

#[inline(always)]
unsafe fn weight_grad_strip<S: Simd>(plan: &GradPlan, sums: &mut [Pixel], strip: GradStrip) {
    // SAFETY: the caller's contract.
    unsafe {
        if plan.step == Step::Half {
            weight_grad_by::<S, { 2 * LANES }>(plan, sums, strip);
        } else {
            weight_grad_by::<S, LANES>(plan, sums, strip);
        }
    }
}

#[inline(always)]
unsafe fn weight_grad_by<S: Simd, const STEP: usize>(plan: &GradPlan, sums: &mut [Pixel], strip: GradStrip) {
    let mut acc = sums.as_mut_ptr().cast::<f32>();
    let (input, grad) = (strip.input, strip.grad);
    for (panel, runs) in &plan.parts {
        for &ChannelRun { block, lane, len } in runs {
            for tap in 0..9 {
                let mut y = 0;
                while y < strip.rows {
                    // SAFETY: output rows below `rows` read input rows that the strip has; the plan counted its sums.
                    unsafe {
                        outer::<S, STEP>(
                            panel.vecs,
                            len,
                            strip.width,
                            input.ptr.add(
                                block * input.block
                                    + (y * (STEP / LANES) + tap / 3) * input.row
                                    + tap % 3 * LANES
                                    + lane,
                            ),
                            grad.ptr.add(panel.block * grad.block + y * grad.row),
                            grad.block,
                            acc,
                        );
                    }
                    y += 1;
                }
                // SAFETY: at most one past the last sum.
                acc = unsafe { acc.add(len * panel.vecs * LANES) };
            }
        }
    }
}
