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

use crate::{Error, Result};
use candle_core::{DType, Tensor, Var};
use ndarray::{Array2, Array4, ArrayView2, ArrayView4, Axis, Zip};
use nets::{Network, Window};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sci_forward::bayer::{CfaPattern, mosaic_adjoint_into, mosaic_into};
use sci_forward::{SensingOperator, VideoShape};
use std::ops::Range;
use std::sync::Arc;

/// A measurement and what made it: `y = H T v`, `T` the mosaic of a color sensor or the identity of a gray one.
#[derive(Clone)]
pub struct Snapshot {
    operator: Arc<dyn SensingOperator>,
    y: Array2<f32>,
    cfa: Option<CfaPattern>,
}

impl std::fmt::Debug for Snapshot {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Snapshot")
            .field("shape", &self.operator.shape())
            .field("cfa", &self.cfa)
            .finish_non_exhaustive()
    }
}

impl Snapshot {
    /// Takes `y` `[H, W]`, on the scale of `Σ_t C_t`; `cfa` is the pattern of a color sensor.
    ///
    /// # Errors
    /// [`Error::Size`], [`Error::NotFinite`].
    pub fn new(operator: Arc<dyn SensingOperator>, y: ArrayView2<'_, f32>, cfa: Option<CfaPattern>) -> Result<Self> {
        let expected = operator.shape().image_dim();
        if y.dim() != expected {
            let list = |(h, w)| vec![h, w];
            return Err(Error::Size { what: "measurement", expected: list(expected), found: list(y.dim()) });
        }
        if let Some(((row, column), &value)) = y.indexed_iter().find(|(_, v)| !v.is_finite()) {
            return Err(Error::NotFinite { value, row, column });
        }
        Ok(Self { operator, y: y.to_owned(), cfa })
    }

    /// H.
    pub fn operator(&self) -> &Arc<dyn SensingOperator> {
        &self.operator
    }

    /// The measurement `[H, W]`.
    pub fn y(&self) -> ArrayView2<'_, f32> {
        self.y.view()
    }

    /// The pattern of a color sensor.
    pub fn cfa(&self) -> Option<CfaPattern> {
        self.cfa
    }

    /// Frames, rows and columns.
    pub fn shape(&self) -> VideoShape {
        self.operator.shape()
    }

    /// Channels of a frame of v: 3 of a color sensor, else 1.
    pub fn channels(&self) -> usize {
        if self.cfa.is_some() { 3 } else { 1 }
    }

    fn check(&self, what: &'static str, v: ArrayView4<'_, f32>) -> Result<()> {
        let (t, h, w) = self.shape().dim();
        let expected = vec![t, self.channels(), h, w];
        let found = v.shape().to_vec();
        if found == expected { Ok(()) } else { Err(Error::Size { what, expected, found }) }
    }

    /// `r = H T v − y` `[H, W]` of a video `[T, C, H, W]`.
    ///
    /// # Errors
    /// [`Error::Size`].
    pub fn residual(&self, v: ArrayView4<'_, f32>) -> Result<Array2<f32>> {
        self.check("video", v)?;
        let mut r = match self.cfa {
            None => self.operator.forward(v.index_axis_move(Axis(1), 0)),
            Some(cfa) => {
                let mut mosaic = ndarray::Array3::zeros(self.shape().dim());
                mosaic_into(cfa, v, mosaic.view_mut());
                self.operator.forward(mosaic.view())
            }
        };
        r -= &self.y;
        Ok(r)
    }

    /// `Tᵀ Hᵀ g` `[T, C, H, W]`: in frame t `C_t ⊙ g`, in the channel that the pixel sees.
    ///
    /// # Panics
    /// If `g` has not the size of the measurement.
    pub fn pull_back(&self, g: ArrayView2<'_, f32>) -> Array4<f32> {
        let mosaic = self.operator.adjoint(g);
        let Some(cfa) = self.cfa else { return mosaic.insert_axis(Axis(1)) };
        let (t, h, w) = mosaic.dim();
        let mut rgb = Array4::zeros((t, 3, h, w));
        mosaic_adjoint_into(cfa, mosaic.view(), rgb.view_mut());
        rgb
    }
}

/// What a pixel of a measurement is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    /// The loss sees it.
    Seen,
    /// It judges what the loss did.
    HeldOut,
    /// Neither.
    Neighbour,
}

/// Which pixels of a measurement the loss sees, and which are held out to judge what it did.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Pixels {
    roles: Array2<Role>,
    seen: usize,
    held: usize,
    blind: bool,
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

impl Pixels {
    /// Every pixel of `[H, W]` is held out with probability `held_out`, the same for the same seed; the loss sees the
    /// others, at least one.
    pub fn split(size: (usize, usize), held_out: f64, seed: u64) -> Self {
        Self::draw(size, held_out, None, seed)
    }

    /// Every pixel is held out with probability `held_out` and seen by the loss with probability `seen`, at least one;
    /// [`Pixels::blinded`] takes both out of the input.
    pub fn blind(size: (usize, usize), held_out: f64, seen: f64, seed: u64) -> Self {
        Self::draw(size, held_out, Some(seen), seed)
    }

    fn draw((height, width): (usize, usize), held_out: f64, seen: Option<f64>, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut roles = Array2::from_shape_simple_fn((height, width), || match rng.random::<f64>() {
            u if u < held_out => Role::HeldOut,
            u if seen.is_some_and(|seen| u >= held_out + seen) => Role::Neighbour,
            _ => Role::Seen,
        });
        let count = |roles: &Array2<Role>, role| roles.iter().filter(|&&r| r == role).count();
        if count(&roles, Role::Seen) == 0
            && let Some(first) = roles.first_mut()
        {
            *first = Role::Seen;
        }
        Self { seen: count(&roles, Role::Seen), held: count(&roles, Role::HeldOut), roles, blind: seen.is_some() }
    }

    /// The input `[T, C, H, W]` of a network without what it says about the pixels that the loss looks at or that are
    /// held out: each is the mean of the others among its eight neighbours. Nothing unless made by [`Pixels::blind`].
    ///
    /// The input of a denoiser has been projected onto the measurement, so that it holds every pixel of it, those held
    /// out too; a network that denoises less then has a smaller error everywhere. What it makes of a pixel that it does
    /// not see is a fair judge (Batson, Royer, *Noise2Self*, 2019).
    ///
    /// # Panics
    /// If the video has not the size of the measurement.
    pub fn blinded(&self, video: ArrayView4<'_, f32>) -> Option<Array4<f32>> {
        let (.., height, width) = video.dim();
        assert_eq!((height, width), self.roles.dim(), "the video must have the measurement's size");
        let mut blinded = self.blind.then(|| video.to_owned())?;
        let hidden = self.roles.indexed_iter().filter(|(_, role)| **role != Role::Neighbour);
        for ((i, j), _) in hidden {
            let around = |at: usize, n: usize| at.saturating_sub(1)..(at + 2).min(n);
            let pairs = around(i, height).flat_map(|i| around(j, width).map(move |j| (i, j)));
            let others: Vec<_> = pairs.filter(|&at| self.roles[at] == Role::Neighbour).collect();
            if others.is_empty() {
                continue;
            }
            for (mut out, frame) in blinded.outer_iter_mut().zip(video.outer_iter()) {
                for (mut out, plane) in out.outer_iter_mut().zip(frame.outer_iter()) {
                    out[[i, j]] = others.iter().map(|&at| plane[at]).sum::<f32>() / others.len() as f32;
                }
            }
        }
        Some(blinded)
    }

    /// Of a residual `[H, W]`, summed in `f64` in row-major order.
    ///
    /// # Panics
    /// If the residual has another size.
    pub fn loss(&self, residual: ArrayView2<'_, f32>) -> SplitLoss {
        let (mut seen, mut held) = (0f64, 0f64);
        Zip::from(residual).and(&self.roles).for_each(|&r, role| {
            let square = f64::from(r) * f64::from(r);
            match role {
                Role::Seen => seen += square,
                Role::HeldOut => held += square,
                Role::Neighbour => {}
            }
        });
        let held_out = (self.held > 0).then(|| held / self.held as f64);
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
/// [`Error::Net`] as [`Network::forward`].
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
    let device = network.device();
    let tensor = |video: ArrayView4<'_, f32>| {
        Tensor::from_vec(video.iter().copied().collect::<Vec<f32>>(), video.dim(), &device)
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
        upstream = propagate(network, (stage, windows), vars, (&read[stage], sigma), &upstream, sums)?;
        read.truncate(stage);
    }
    Ok(())
}

/// One stage of [`accumulate_gradient`]; returns the gradient by what the stage reads (nothing for the first).
fn propagate(
    network: &dyn Network,
    (stage, windows): (usize, &[Window]),
    vars: &[(String, Var)],
    (read, sigma): (&Tensor, f32),
    upstream: &Tensor,
    sums: &mut [Vec<f32>],
) -> Result<Tensor> {
    let (_, _, height, _) = read.dims4()?;
    let frame = read.elem_count() / read.dim(0)?;
    let mut below = vec![0f32; if stage == 0 { 0 } else { read.elem_count() }];
    let strips = strips(network.reach().filter(|_| stage == 0), height);
    for (window, Strip { rows, around }) in windows.iter().flat_map(|w| strips.iter().map(move |s| (w, s))) {
        let upstream = upstream.narrow(0, window.outputs.start, window.outputs.len())?;
        let upstream = upstream.narrow(2, rows.start, rows.len())?;
        if values(&upstream)?.iter().all(|&v| v == 0.0) {
            continue;
        }
        let mut inputs = gather(read, window)?.narrow(2, around.start, around.len())?;
        let leaf = (stage > 0).then(|| Var::from_tensor(&inputs)).transpose()?;
        if let Some(leaf) = &leaf {
            inputs = leaf.as_tensor().clone();
        }
        let result = network.forward_window(stage, &inputs, sigma)?;
        let result = result.narrow(2, rows.start - around.start, rows.len())?;
        let grads = (result * upstream)?.sum_all()?.backward()?;
        for ((_, var), sum) in vars.iter().zip(&mut *sums) {
            if let Some(grad) = grads.get(var) {
                add(sum, &values(grad)?);
            }
        }
        if let Some(grad) = leaf.as_ref().and_then(|leaf| grads.get(leaf)) {
            for (&t, grad) in window.inputs.iter().zip(values(grad)?.chunks_exact(frame)) {
                add(&mut below[t * frame..][..frame], grad);
            }
        }
    }
    match stage {
        0 => Ok(Tensor::zeros(0, DType::F32, read.device())?),
        _ => Ok(Tensor::from_vec(below, read.shape(), read.device())?),
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

fn values(tensor: &Tensor) -> Result<Vec<f32>> {
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
