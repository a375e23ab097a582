//! What the networks have in common: named tensors, a differentiable forward pass, frames in and out.

use crate::kernels::Precision;
use crate::layers::{Conv, Parameters};
use crate::{Error, KeyReport};
use admm::{BoxError, Call};
use candle_core::{Tensor, Var};
use ndarray::{ArrayView4, ArrayViewMut4, Axis};
use std::collections::BTreeMap;
use std::ops::Range;

/// Frames that a stage of a network takes together: see [`Network::stages`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Window {
    /// Which results of the stage before (of the first stage: which frames) are read, in this order.
    pub inputs: Vec<usize>,
    /// Which results of this stage are made.
    pub outputs: Range<usize>,
}

/// The named layers of a network: what loading, saving and training need of it. The tensors have the names of its published
/// implementation.
pub trait Layers: Send + Sync {
    /// What it is, with its size, for messages: `"FFDNet (gray, 64 channels, 15 layers)"`.
    fn describe(&self) -> String;

    /// Channels of a frame, `C`: 1 gray, 3 RGB.
    fn channels(&self) -> usize;

    /// Multiply-adds of the convolutions of a call, for each pixel of each frame.
    fn multiply_adds(&self) -> f64;

    #[doc(hidden)]
    fn convs(&self) -> Vec<&Conv>;

    #[doc(hidden)]
    fn convs_mut(&mut self) -> Vec<&mut Conv>;

    /// What inference, as a denoiser, multiplies: f32 unless this asks for [`Precision::Bf16`].
    fn set_inference_precision(&mut self, precision: Precision) {
        // What inference has packed stays unless something changes.
        if self.convs().iter().any(|conv| conv.inference().precision != precision) {
            self.convs_mut().into_iter().for_each(|conv| conv.set_inference_precision(precision));
        }
    }

    /// What [`Network::forward`] and the gradient multiply: f32 unless this asks for [`Precision::Bf16`]. Inference
    /// is not changed by it.
    fn set_precision(&mut self, precision: Precision) {
        self.convs_mut().into_iter().for_each(|conv| conv.set_precision(precision));
    }

    /// Every tensor under its published name, batch norm statistics included.
    fn state(&self) -> BTreeMap<String, Tensor> {
        let copy = |conv: &Conv| {
            let mut conv = conv.clone();
            conv.tensors_mut().into_iter().map(|(name, t, _)| (name, t.clone())).collect::<Vec<_>>()
        };
        self.convs().into_iter().flat_map(copy).collect()
    }

    /// Makes weights, biases and the affine part of batch norms trainable, and returns them in the order of the
    /// layers; the statistics of batch norms stay frozen. [`Var::set`] on a result changes the network.
    ///
    /// # Errors
    /// When memory for the variables cannot be had.
    fn make_trainable(&mut self) -> Result<Vec<(String, Var)>, Error> {
        self.make_some_trainable(Parameters::All)
    }

    /// [`Layers::make_trainable`] of a part of the tensors. What was trainable before stays so.
    ///
    /// # Errors
    /// When memory for the variables cannot be had.
    fn make_some_trainable(&mut self, which: Parameters) -> Result<Vec<(String, Var)>, Error> {
        let mut vars = Vec::new();
        let convs = self.convs_mut();
        let last = convs.len().saturating_sub(1);
        for (i, conv) in convs.into_iter().enumerate() {
            let wanted = match which {
                Parameters::FirstLast => i == 0 || i == last,
                Parameters::Last => i == last,
                _ => true,
            };
            if wanted {
                vars.extend(conv.make_trainable(which)?);
            }
        }
        if vars.is_empty() {
            let (value, legal) = (format!("{which:?}"), "those that this network has: it has no batch norm".to_owned());
            return Err(Error::Setting { key: "parameters", value, legal });
        }
        Ok(vars)
    }

    /// Replaces every tensor by that of the same name in a [`Layers::state`]; nothing is trainable afterwards.
    ///
    /// # Errors
    /// [`Error::State`] when names or shapes are not the network's own; it is unchanged then.
    fn set_state(&mut self, state: &BTreeMap<String, Tensor>) -> Result<(), Error> {
        let own = self.state();
        let mut keys = KeyReport::default();
        for (name, tensor) in &own {
            match state.get(name) {
                None => keys.missing.push(name.clone()),
                Some(new) if new.dims() != tensor.dims() => {
                    keys.mismatched.push((name.clone(), tensor.dims().to_vec(), new.dims().to_vec()));
                }
                Some(_) => {}
            }
        }
        keys.unexpected = state.keys().filter(|name| !own.contains_key(*name)).cloned().collect();
        if !keys.is_empty() {
            return Err(Error::State { network: self.describe(), keys });
        }
        for conv in self.convs_mut() {
            for (name, tensor, _) in conv.tensors_mut() {
                *tensor = state[&name].detach();
            }
        }
        Ok(())
    }

    /// Completes weights of a smaller network of the kind, so that they are this one's and its result stays the same.
    ///
    /// # Errors
    /// When a tensor operation fails.
    fn grow(&self, _weights: &mut BTreeMap<String, Tensor>) -> Result<(), Error> {
        Ok(())
    }

    /// Replaces every batch norm by the equal weight and bias of the convolution before it.
    ///
    /// # Errors
    /// When a tensor operation fails.
    fn fold_batch_norm(&mut self) -> Result<(), Error> {
        for conv in self.convs_mut() {
            conv.fold()?;
        }
        Ok(())
    }

    /// Number of trainable values.
    fn parameter_count(&self) -> usize {
        let trainable = |conv: &Conv| -> usize {
            conv.clone().tensors_mut().iter().filter(|(.., trainable)| *trainable).map(|(_, t, _)| t.elem_count()).sum()
        };
        self.convs().into_iter().map(trainable).sum()
    }
}

/// A network that denoises or demosaics frames.
pub trait Network: Layers {
    /// The network as a differentiable function of its input and its trainable tensors.
    ///
    /// `clips [N, C, H, W]` holds `noise.len()` clips of equal length one after another; `noise` is the σ of each, on
    /// the scale of the frames (networks without a noise map ignore its values). The result has the shape of the input.
    ///
    /// # Errors
    /// [`Error::Channels`], [`Error::Shape`] when `N` is not a multiple of `noise.len()` or a frame is empty,
    /// [`Error::Sigma`].
    fn forward(&self, clips: &Tensor, noise: &[f32]) -> Result<Tensor, Error>;

    /// [`Network::forward`] of one clip `[T, C, H, W]` without gradients, for solves.
    ///
    /// # Errors
    /// As [`Network::forward`], and when the call has no σ for a network that is told one.
    fn infer(
        &mut self,
        call: &Call<'_>,
        clip: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError>;

    /// Whether it fills in a mosaic, and is given frames with what an RGGB sensor sees of them, zeros elsewhere.
    fn sees_mosaics(&self) -> bool {
        false
    }

    /// A copy.
    fn boxed(&self) -> Box<dyn Network>;

    /// [`Network::forward`] of one clip taken apart, so that its gradient can be had with the memory of one window:
    /// for each stage the windows, in the order of their outputs, for a clip of `frames` frames.
    ///
    /// A stage maps `[inputs, C, H, W]` to `[outputs, C, H, W]` by [`Network::forward_window`]; the first reads
    /// [`Network::padded`] frames, the results of the last, cut back to the size of the frames, are those of `forward`.
    /// A network that does not say otherwise is one stage of one window.
    fn stages(&self, frames: usize) -> Vec<Vec<Window>> {
        vec![vec![Window { inputs: (0..frames).collect(), outputs: 0..frames }]]
    }

    /// One window of one stage of [`Network::stages`], differentiable in `inputs` and the trainable tensors.
    ///
    /// # Errors
    /// As [`Network::forward`].
    fn forward_window(&self, stage: usize, inputs: &Tensor, noise: f32) -> Result<Tensor, Error> {
        debug_assert_eq!(stage, 0);
        self.forward(inputs, &[noise])
    }

    /// How many rows away a row of a frame can change a row of the result, rounded up to a multiple of what
    /// [`Network::padded`] continues frames to, so that a strip cut out with as many rows around it has the same result;
    /// nothing where strips are not worth it.
    fn reach(&self) -> Option<usize> {
        None
    }

    /// Frames `[T, C, H, W]` continued to the size that [`Network::forward_window`] takes.
    ///
    /// # Errors
    /// When a tensor operation fails.
    fn padded(&self, clip: &Tensor) -> Result<Tensor, Error> {
        Ok(clip.clone())
    }
}

/// Checks the arguments of [`Network::forward`]; returns `(N, C, H, W)`.
pub(crate) fn check_clips(
    network: &dyn Network,
    clips: &Tensor,
    noise: &[f32],
) -> Result<(usize, usize, usize, usize), Error> {
    let shape =
        |expected: Vec<usize>| Error::Shape { what: "a video [T, C, H, W]", expected, found: clips.dims().to_vec() };
    let (n, c, h, w) = clips.dims4().map_err(|_| shape(vec![noise.len(), network.channels(), 1, 1]))?;
    if c != network.channels() {
        return Err(Error::Channels { network: network.describe(), expected: network.channels(), found: c });
    }
    if noise.is_empty() || n == 0 || n % noise.len() != 0 || h == 0 || w == 0 {
        return Err(shape(vec![n.next_multiple_of(noise.len().max(1)).max(1), c, h.max(1), w.max(1)]));
    }
    match noise.iter().find(|s| !(s.is_finite() && **s >= 0.0)) {
        Some(&sigma) => Err(Error::Sigma(sigma)),
        None => Ok((n, c, h, w)),
    }
}

/// Checks a call of [`admm::Denoiser::denoise`].
pub(crate) fn check_video(
    network: &dyn Network,
    sigma: f32,
    noisy: ArrayView4<'_, f32>,
    out: &ArrayViewMut4<'_, f32>,
) -> Result<(), Error> {
    let found = noisy.len_of(Axis(1));
    if found != network.channels() {
        return Err(Error::Channels { network: network.describe(), expected: network.channels(), found });
    }
    if noisy.shape() != out.shape() {
        let (expected, found) = (noisy.shape().to_vec(), out.shape().to_vec());
        return Err(Error::Shape { what: "the output video", expected, found });
    }
    if !(sigma.is_finite() && sigma >= 0.0) {
        return Err(Error::Sigma(sigma));
    }
    Ok(())
}

/// [`admm::Denoiser::denoise`] of a network, by `infer`.
pub(crate) fn denoise_clip<N: Network>(
    net: &mut N,
    call: &Call<'_>,
    noisy: ArrayView4<'_, f32>,
    out: ArrayViewMut4<'_, f32>,
    infer: impl FnOnce(&mut N, ArrayView4<'_, f32>, f32, ArrayViewMut4<'_, f32>) -> Result<(), Error>,
) -> Result<(), BoxError> {
    let sigma = call.required_sigma()?;
    check_video(net, sigma, noisy, &out)?;
    if noisy.is_empty() {
        return Ok(());
    }
    Ok(infer(net, noisy, sigma, out)?)
}

/// The σ of each frame as a map `[N, 1, H, W]` of the size and kind of `beside`.
pub(crate) fn noise_map(frames: usize, noise: &[f32], beside: &Tensor) -> candle_core::Result<Tensor> {
    let (_, _, height, width) = beside.dims4()?;
    let per_clip = frames / noise.len();
    let values: Vec<f32> = (0..frames).map(|n| noise[n / per_clip]).collect();
    let map = Tensor::from_vec(values, (frames, 1, 1, 1), beside.device())?.to_dtype(beside.dtype())?;
    map.broadcast_as((frames, 1, height, width))?.contiguous()
}

/// How a frame is continued beyond its last row and column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Padding {
    /// The last row again: `… y z | z z`.
    Replicate,
    /// Mirrored, the edge not repeated: `… x y z | y x`; back and forth in tiny frames.
    Reflect,
}

impl Padding {
    /// The row (or column) below `n` that stands for row `i`.
    pub(crate) fn source(self, i: usize, n: usize) -> usize {
        match self {
            Self::Replicate => i.min(n - 1),
            Self::Reflect => reflect(i as isize, n),
        }
    }

    /// Continues `[.., H, W]` to whole multiples of `multiple`.
    pub(crate) fn pad(self, x: &Tensor, multiple: usize) -> candle_core::Result<Tensor> {
        let mut x = x.clone();
        for axis in [2, 3] {
            let n = x.dim(axis)?;
            let padded = n.next_multiple_of(multiple);
            if padded != n {
                let rows: Vec<u32> = (0..padded).map(|i| self.source(i, n) as u32).collect();
                x = x.contiguous()?.index_select(&Tensor::new(rows, x.device())?, axis)?;
            }
        }
        Ok(x)
    }
}

/// `i` folded into `0..n` as between two mirrors on the first and the last element.
pub(crate) fn reflect(i: isize, n: usize) -> usize {
    if n == 1 {
        return 0;
    }
    let period = 2 * (n as isize - 1);
    let i = i.rem_euclid(period);
    i.min(period - i) as usize
}

/// Cuts `[.., H, W]` back to the size before [`Padding::pad`].
pub(crate) fn crop(x: &Tensor, height: usize, width: usize) -> candle_core::Result<Tensor> {
    x.narrow(2, 0, height)?.narrow(3, 0, width)?.contiguous()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mirrors_fold_any_index_into_range() {
        let folded: Vec<usize> = (-3..8).map(|i| reflect(i, 3)).collect();
        assert_eq!(folded, [1, 2, 1, 0, 1, 2, 1, 0, 1, 2, 1]);
        assert_eq!([reflect(-2, 1), reflect(5, 1)], [0, 0]);
    }
}
