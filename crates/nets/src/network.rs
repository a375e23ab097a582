//! What the networks have in common: named tensors, a differentiable forward pass, frames in and out.

use crate::Error;
use crate::layers::Conv;
use candle_core::{Device, Tensor, Var};
use ndarray::{ArrayView4, ArrayViewMut4, Axis};
use std::collections::BTreeMap;

/// A denoising or demosaicing network whose tensors have the names of its published implementation.
pub trait Network: Send + Sync {
    /// What it is, with its size, for messages: `"FFDNet (gray, 64 channels, 15 layers)"`.
    fn describe(&self) -> String;

    /// Channels of a frame, `C`: 1 gray, 3 RGB.
    fn channels(&self) -> usize;

    /// The network as a differentiable function of its input and its trainable tensors.
    ///
    /// `clips [N, C, H, W]` holds `noise.len()` clips of equal length one after another; `noise` is the σ of each, on
    /// the scale of the frames (networks without a noise map ignore its values). The result has the shape of the input.
    ///
    /// # Errors
    /// [`Error::Channels`], [`Error::Shape`] when `N` is not a multiple of `noise.len()` or a frame is empty,
    /// [`Error::Sigma`].
    fn forward(&self, clips: &Tensor, noise: &[f32]) -> Result<Tensor, Error>;

    #[doc(hidden)]
    fn convs(&self) -> Vec<&Conv>;

    #[doc(hidden)]
    fn convs_mut(&mut self) -> Vec<&mut Conv>;

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
        let mut vars = Vec::new();
        for conv in self.convs_mut() {
            vars.extend(conv.make_trainable()?);
        }
        Ok(vars)
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

    /// Moves the tensors to another device; trainable tensors become constants.
    ///
    /// # Errors
    /// When the device refuses.
    fn to_device(&mut self, device: &Device) -> Result<(), Error> {
        for conv in self.convs_mut() {
            for (_, tensor, _) in conv.tensors_mut() {
                *tensor = tensor.detach().to_device(device)?;
            }
        }
        Ok(())
    }

    /// The device of the tensors.
    fn device(&self) -> Device {
        self.convs().first().map_or(Device::Cpu, |conv| conv.device().clone())
    }

    /// Number of trainable values.
    fn parameter_count(&self) -> usize {
        let trainable = |conv: &Conv| -> usize {
            conv.clone().tensors_mut().iter().filter(|(.., trainable)| *trainable).map(|(_, t, _)| t.elem_count()).sum()
        };
        self.convs().into_iter().map(trainable).sum()
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

/// Frames as a tensor on `device`.
pub(crate) fn to_tensor(frames: ArrayView4<'_, f32>, device: &Device) -> candle_core::Result<Tensor> {
    let shape = frames.dim();
    Tensor::from_vec(frames.iter().copied().collect::<Vec<f32>>(), shape, device)
}

/// The values of a tensor of the shape of `out`.
pub(crate) fn copy_to(tensor: &Tensor, mut out: ArrayViewMut4<'_, f32>) -> candle_core::Result<()> {
    let values = tensor.flatten_all()?.to_vec1::<f32>()?;
    out.iter_mut().zip(values).for_each(|(o, v)| *o = v);
    Ok(())
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
