//! Time for free: some channels of each frame are those of its neighbours.

use candle_core::{CpuStorage, CustomOp1, Layout, Shape, Tensor, WithDType};

/// One of so many channels is taken from the frame before, and one from the frame after.
const SHIFTED: usize = 4;

/// Of images `[N, C, H, W]`, clips of equal length one after another, each in order of time: the first channels of each from the frame before, as
/// many from the frame after, the others its own. Zeros beyond the ends of a clip.
#[derive(Debug, Clone, Copy)]
pub(super) struct TemporalShift {
    each_way: usize,
    /// Of a clip.
    frames: usize,
    /// The adjoint: from the frame after first.
    back: bool,
}

impl TemporalShift {
    pub(super) fn of(channels: usize, frames: usize) -> Self {
        Self { each_way: Self::each_way(channels), frames, back: false }
    }

    /// Of so many channels those that are taken from the frame before, and as many from the one after.
    pub(super) fn each_way(channels: usize) -> usize {
        channels / SHIFTED
    }

    /// Which image channel `c` of image `n` is taken from.
    fn source(self, n: usize, c: usize) -> Option<usize> {
        match (c / self.each_way.max(1), self.back) {
            (0, false) | (1, true) => (!n.is_multiple_of(self.frames)).then(|| n - 1),
            (1, false) | (0, true) => Some(n + 1).filter(|after| !after.is_multiple_of(self.frames)),
            _ => Some(n),
        }
    }

    fn shift<T: WithDType>(self, x: &[T], channels: usize, plane: usize) -> Vec<T> {
        let mut out = vec![T::zero(); x.len()];
        for (i, out) in out.chunks_exact_mut(plane).enumerate() {
            if let Some(t) = self.source(i / channels, i % channels) {
                out.copy_from_slice(&x[(t * channels + i % channels) * plane..][..plane]);
            }
        }
        out
    }
}

impl CustomOp1 for TemporalShift {
    fn name(&self) -> &'static str {
        "temporal-shift"
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        let (_, c, h, w) = layout.shape().dims4()?;
        let Some((from, to)) = layout.contiguous_offsets() else {
            return Err(candle_core::Error::RequiresContiguous { op: "temporal-shift" }.bt());
        };
        let shifted = match x {
            CpuStorage::F32(x) => CpuStorage::F32(self.shift(&x[from..to], c, h * w)),
            CpuStorage::F64(x) => CpuStorage::F64(self.shift(&x[from..to], c, h * w)),
            _ => candle_core::bail!("temporal-shift: f32 and f64 only"),
        };
        Ok((shifted, layout.shape().clone()))
    }

    fn bwd(&self, _: &Tensor, _: &Tensor, grad: &Tensor) -> candle_core::Result<Option<Tensor>> {
        Ok(Some(grad.contiguous()?.apply_op1(Self { back: !self.back, ..*self })?))
    }
}
