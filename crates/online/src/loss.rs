//! The loss of an output at the sensor, and its exact gradient with the memory of one window.
//!
//! Written out for the whole video, `ℓ = mean (H T f(x) − y)²` needs the activations of every frame at once. But it
//! depends on the weights through `v = f(x)` only, so two passes do: the first computes v without a graph and the
//! residual `r = H T v − y`; the second goes through the frames again, each with its graph, propagates
//! `∂ℓ/∂v_t = (2/N) Tᵀ (C_t ⊙ r)` and drops the graph. The gradients are summed in the order of the frames.
//!
//! A network of several stages (FastDVDnet) takes as many passes, the last stage first: what arrives at the results of
//! a stage is what the stage before propagates. The memory is that of one triplet through one block, half a window of
//! five frames, besides one video for each stage. Frames of FFDNet, which reaches few rows, are taken a strip at a time.

use crate::Result;
use candle_core::{DType, Device, Tensor, Var};
use ndarray::{Array2, ArrayView2, ArrayView4, Axis, Zip};
use nets::{Network, Window};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sci_forward::Measurement;
use std::ops::Range;

/// What a pixel of a measurement is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    /// The loss sees it.
    Seen,
    /// It judges what the loss did.
    HeldOut,
    /// It measures nothing: no mask opens it, or it is held out of the solve.
    Closed,
}

/// Which pixels of a measurement the loss sees, and which are held out to judge what it did.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PixelSplit {
    roles: Array2<Role>,
    seen: usize,
    held_out: usize,
}

/// The loss on the pixels of both kinds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SplitLoss {
    /// Mean of `r²` over the pixels that the loss sees.
    pub loss: f64,
    /// Mean of `r²` over the pixels held out, if there are any.
    pub held_out: Option<f64>,
}

impl SplitLoss {
    /// Whether both are finite.
    pub fn is_finite(&self) -> bool {
        self.loss.is_finite() && self.held_out.is_none_or(f64::is_finite)
    }
}

impl PixelSplit {
    /// Every open pixel is held out with probability `held_out`, the same for the same seed; the loss sees the other open
    /// ones. The loss sees at least one, and of two or more at least one is held out unless `held_out` is 0.
    pub fn draw(measurement: &Measurement, held_out: f64, seed: u64) -> Self {
        let gram = measurement.operator().gram();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let drawn = Array2::from_shape_simple_fn(gram.dim(), || rng.random::<f64>());
        let (lowest, highest) = Zip::from(&drawn).and(gram).fold((1f64, 0f64), |(low, high), &u, &gram| {
            if gram > 0.0 { (low.min(u), high.max(u)) } else { (low, high) }
        });
        let below = if held_out > 0.0 { held_out.max(lowest.next_up()).min(highest) } else { 0.0 };
        let roles = Zip::from(&drawn).and(gram).map_collect(|&u, &gram| match () {
            () if gram <= 0.0 => Role::Closed,
            () if u < below => Role::HeldOut,
            () => Role::Seen,
        });
        let count = |role| roles.iter().filter(|&&r| r == role).count();
        Self { seen: count(Role::Seen), held_out: count(Role::HeldOut), roles }
    }

    /// Of a residual `[H, W]`, summed in `f64` in row-major order.
    ///
    /// # Panics
    /// If the residual has another size.
    pub fn loss(&self, residual: ArrayView2<'_, f32>) -> SplitLoss {
        let (mut seen, mut held_out) = (0f64, 0f64);
        Zip::from(residual).and(&self.roles).for_each(|&r, role| {
            let square = f64::from(r) * f64::from(r);
            match role {
                Role::Seen => seen += square,
                Role::HeldOut => held_out += square,
                Role::Closed => {}
            }
        });
        let held_out = (self.held_out > 0).then(|| held_out / self.held_out as f64);
        SplitLoss { loss: seen / self.seen as f64, held_out }
    }

    /// `∂loss/∂r = (2/N) r` at the `N` pixels that the loss sees, else 0.
    ///
    /// # Panics
    /// If the residual has another size.
    pub fn gradient(&self, residual: ArrayView2<'_, f32>) -> Array2<f32> {
        let factor = (2.0 / self.seen as f64) as f32;
        let of = |&r: &f32, &role: &Role| if role == Role::Seen { factor * r } else { 0.0 };
        Zip::from(residual).and(&self.roles).map_collect(of)
    }
}

/// Adds to `sums` the gradient of `⟨upstream, f(input)⟩` by each of `vars`: with `upstream = ∂ℓ/∂v`, the gradient of ℓ.
///
/// `input` and `upstream` are `[T, C, H, W]`, `f` is `network` told `sigma`; `sums[i]` has the values of `vars[i]`.
/// Activations are those of one window ([`Network::stages`]), or of a strip of it where the network knows its reach; both are
/// summed in their order. One whose upstream is zero costs nothing.
///
/// # Errors
/// [`Error::Net`](crate::Error::Net) as [`Network::forward`].
///
/// # Panics
/// If `sums` and `vars` do not belong together, or the videos differ in shape.
pub fn accumulate_gradient(
    network: &dyn Network,
    vars: &[(String, Var)],
    input: ArrayView4<'_, f32>,
    sigma: f32,
    upstream: ArrayView4<'_, f32>,
    sums: &mut [Vec<f32>],
) -> Result<()> {
    assert_eq!(input.dim(), upstream.dim(), "the gradient belongs to a video of the input's shape");
    assert_eq!(vars.len(), sums.len(), "a sum for each variable");
    let tensor = |video: ArrayView4<'_, f32>| {
        Tensor::from_vec(video.iter().copied().collect::<Vec<f32>>(), video.dim(), &Device::Cpu)
    };
    let stages = network.stages(input.len_of(Axis(0)));
    let mut read = vec![network.padded(&tensor(input)?)?];
    for (stage, windows) in stages.iter().enumerate().take(stages.len() - 1) {
        let from = &read[stage];
        let result = |window: &Window| Ok(network.forward_window(stage, &gather(from, window)?, sigma)?.detach());
        let results = windows.iter().map(result).collect::<Result<Vec<_>>>()?;
        read.push(Tensor::cat(&results, 0)?);
    }
    let (_, _, height, width) = read[0].dims4()?;
    let (_, _, h, w) = input.dim();
    let mut upstream = tensor(upstream)?.pad_with_zeros(2, 0, height - h)?.pad_with_zeros(3, 0, width - w)?;
    for (stage, windows) in stages.iter().enumerate().rev() {
        upstream = StagePass { network, vars, sigma, stage, windows, read: &read[stage] }.propagate(&upstream, sums)?;
        read.truncate(stage);
    }
    Ok(())
}

/// The way back through one stage of a network.
struct StagePass<'p> {
    network: &'p dyn Network,
    vars: &'p [(String, Var)],
    sigma: f32,
    stage: usize,
    windows: &'p [Window],
    /// What the stage reads: padded frames, or the results of the stage before.
    read: &'p Tensor,
}

impl StagePass<'_> {
    /// Adds to `sums` the gradient by each variable, window by window and strip by strip, and returns that by what the
    /// stage reads (nothing for the first).
    fn propagate(&self, upstream: &Tensor, sums: &mut [Vec<f32>]) -> Result<Tensor> {
        let &Self { network, stage, windows, read, .. } = self;
        let frame = read.elem_count() / read.dim(0)?;
        let mut below = vec![0f32; if stage == 0 { 0 } else { read.elem_count() }];
        let strips = strips(network.reach().filter(|_| stage == 0), read.dim(2)?);
        for (window, strip) in windows.iter().flat_map(|w| strips.iter().map(move |s| (w, s))) {
            let upstream = upstream.narrow(0, window.outputs.start, window.outputs.len())?;
            let upstream = upstream.narrow(2, strip.rows.start, strip.rows.len())?;
            if values(&upstream)?.iter().all(|&v| v == 0.0) {
                continue;
            }
            if let Some(to_inputs) = self.strip(window, strip, &upstream, sums)? {
                for (&t, grad) in window.inputs.iter().zip(to_inputs.chunks_exact(frame)) {
                    add(&mut below[t * frame..][..frame], grad);
                }
            }
        }
        match stage {
            0 => Ok(Tensor::zeros(0, DType::F32, read.device())?),
            _ => Ok(Tensor::from_vec(below, read.shape(), read.device())?),
        }
    }

    /// One strip of one window; returns the gradient by its inputs (nothing for the first stage).
    fn strip(
        &self,
        window: &Window,
        Strip { rows, around }: &Strip,
        upstream: &Tensor,
        sums: &mut [Vec<f32>],
    ) -> Result<Option<Vec<f32>>> {
        let mut inputs = gather(self.read, window)?.narrow(2, around.start, around.len())?;
        let leaf = (self.stage > 0).then(|| Var::from_tensor(&inputs)).transpose()?;
        if let Some(leaf) = &leaf {
            inputs = leaf.as_tensor().clone();
        }
        let result = self.network.forward_window(self.stage, &inputs, self.sigma)?;
        let result = result.narrow(2, rows.start - around.start, rows.len())?;
        let grads = (result * upstream)?.sum_all()?.backward()?;
        for ((_, var), sum) in self.vars.iter().zip(sums) {
            if let Some(grad) = grads.get(var) {
                add(sum, &values(grad)?);
            }
        }
        leaf.as_ref().and_then(|leaf| grads.get(leaf)).map(values).transpose()
    }
}

/// Rows of a strip: the more, the less is computed twice; the fewer, the less memory.
const STRIP: usize = 48;

/// Rows whose results are looked at, and those around them that they depend on.
struct Strip {
    rows: Range<usize>,
    around: Range<usize>,
}

/// Strips of frames of a network of that reach, all with as many rows around, so that they use the same memory in turn; one
/// of all rows where there is no reach, or little to save.
fn strips(reach: Option<usize>, height: usize) -> Vec<Strip> {
    let (count, reach) = match reach {
        Some(reach) if height >= 2 * STRIP => (height / STRIP, reach),
        _ => (1, 0),
    };
    // Even, as cut frames have to be.
    let each = height.div_ceil(count).next_multiple_of(2);
    let tall = (each + 2 * reach).min(height);
    let strip = |i: usize| {
        let rows = i * each..((i + 1) * each).min(height);
        let first = rows.start.saturating_sub(reach).min((height - tall).next_multiple_of(2));
        Strip { rows, around: first..(first + tall).min(height) }
    };
    (0..height.div_ceil(each)).map(strip).collect()
}

fn gather(from: &Tensor, window: &Window) -> Result<Tensor> {
    let frames = window.inputs.iter().map(|&t| from.narrow(0, t, 1)).collect::<candle_core::Result<Vec<_>>>()?;
    Ok(Tensor::cat(&frames, 0)?)
}

pub(crate) fn values(tensor: &Tensor) -> Result<Vec<f32>> {
    Ok(tensor.flatten_all()?.to_vec1()?)
}

fn add(sum: &mut [f32], terms: &[f32]) {
    assert_eq!(sum.len(), terms.len(), "a gradient has the size of its variable");
    sum.iter_mut().zip(terms).for_each(|(s, t)| *s += t);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strips_cover_all_rows_once_with_their_reach_around_them() {
        for height in [1, 2, 255, 256, 257, 301, 512, 1000, 9001] {
            for reach in [None, Some(10), Some(32)] {
                let strips = strips(reach, height);
                let mut next = 0;
                for Strip { rows, around } in &strips {
                    assert_eq!((rows.start, around.start % 2), (next, 0), "{height}");
                    let reach = reach.filter(|_| strips.len() > 1).unwrap_or(0);
                    assert!(around.start <= rows.start.saturating_sub(reach), "{height}");
                    assert!(around.end >= (rows.end + reach).min(height) && around.end <= height, "{height}");
                    assert!(reach == 0 || around.len() <= 2 * STRIP + 2 * reach, "{height}: {around:?}");
                    next = rows.end;
                }
                assert_eq!(next, height);
            }
        }
    }
}
