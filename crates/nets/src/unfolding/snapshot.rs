//! A measurement as the network is shown it, and as tensors to learn from.

use super::GRAY;
use crate::Result;
use candle_core::{Device, Tensor};
use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis, Zip};

/// A measurement as the network is shown it. Scaling masks and measurement together changes nothing.
#[derive(Debug, Clone)]
pub(crate) struct Shown {
    /// y / Σ_t C_t `[H, W]`; ½ where no mask is open.
    pub(crate) mean: Array2<f32>,
    /// C_t `[T, H, W]` by √2 times the root of their mean square: binary masks of density ½ keep their values.
    pub(crate) masks: Array3<f32>,
    /// The mean of those over time `[H, W]`.
    pub(crate) open: Array2<f32>,
}

impl Shown {
    pub(crate) fn new(masks: ArrayView3<'_, f32>, y: ArrayView2<'_, f32>) -> Self {
        let squares: f64 = masks.iter().map(|&c| f64::from(c) * f64::from(c)).sum();
        let scale = (2.0 * squares / masks.len().max(1) as f64).sqrt().max(f64::MIN_POSITIVE) as f32;
        let sum = masks.sum_axis(Axis(0));
        let mean = Zip::from(y).and(&sum).map_collect(|&y, &sum| if sum > 0.0 { y / sum } else { GRAY });
        let masks = masks.mapv(|c| c / scale);
        let open = sum / (scale * masks.len_of(Axis(0)) as f32);
        Self { mean, masks, open }
    }
}

/// How far a solve of [`UnfoldingNet::unfold`] has come.
pub(crate) struct Progress {
    /// Iterations done, at least one.
    pub(crate) iterations: usize,
    /// The last result, without a graph behind it.
    pub(crate) result: Tensor,
    /// The features of that iteration, likewise.
    pub(crate) features: Tensor,
}

/// A measurement for [`UnfoldingNet::unfold`], all images as phases `[T or 1, 4, H/2, W/2]`.
pub(crate) struct Snapshot {
    masks: Tensor,
    y: Tensor,
    /// 1 / Σ C²; 0 where no mask is open.
    inverse: Tensor,
    /// y / Σ C in each frame.
    pub(super) mean: Tensor,
    /// x₀.
    pub(super) start: Tensor,
    /// What the network is shown beside the iterates.
    pub(super) beside: Tensor,
}

impl Snapshot {
    /// Of masks `[T, H, W]`, a measurement `[H, W]` whose sides are multiples of [`MULTIPLE`], of an RGGB sensor if the network is for
    /// color, and x₀ `[T, H, W]`.
    pub(crate) fn new(masks: ArrayView3<'_, f32>, y: ArrayView2<'_, f32>, start: ArrayView3<'_, f32>) -> Result<Self> {
        let shown = Shown::new(masks, y);
        let frames = masks.len_of(Axis(0));
        let gram = masks.mapv(|c| c * c).sum_axis(Axis(0));
        let inverse = gram.mapv(|g| if g > 0.0 { 1.0 / g } else { 0.0 });
        let image = |image: ArrayView2<'_, f32>| phases(image.insert_axis(Axis(0)));
        let each = |image: &Tensor| {
            let (_, c, h, w) = image.dims4()?;
            image.broadcast_as((frames, c, h, w))?.contiguous()
        };
        let mean = each(&image(shown.mean.view())?)?;
        let open = each(&image(shown.open.view())?)?;
        let masks_shown = phases(shown.masks.view())?;
        let behind = ((&mean - f64::from(GRAY))? * &masks_shown)?;
        let beside = (Tensor::cat(&[&mean, &masks_shown, &open], 1)? - f64::from(GRAY))?;
        let beside = Tensor::cat(&[&beside, &behind], 1)?;
        let (masks, inverse) = (phases(masks)?, image(inverse.view())?);
        Ok(Self { masks, y: image(y)?, inverse, mean, start: phases(start)?, beside })
    }

    /// `v + Hᵀ (y − H v) / Σ C²`.
    pub(super) fn project(&self, v: &Tensor) -> candle_core::Result<Tensor> {
        let lacks = (&self.y - (v * &self.masks)?.sum_keepdim(0)?)?;
        v + self.masks.broadcast_mul(&(lacks * &self.inverse)?)?
    }

    /// In another number type, for tests.
    #[cfg(test)]
    pub(super) fn to_dtype(&self, dtype: candle_core::DType) -> Self {
        let [masks, y, inverse, mean, start, beside] =
            [&self.masks, &self.y, &self.inverse, &self.mean, &self.start, &self.beside]
                .map(|t| t.to_dtype(dtype).unwrap());
        Self { masks, y, inverse, mean, start, beside }
    }
}

/// The phases `[N, 4, H/2, W/2]` of images `[N, H, W]` with even sides: pixel `(2y + i, 2x + j)` becomes channel `2i + j`.
pub(crate) fn phases(images: ArrayView3<'_, f32>) -> Result<Tensor> {
    let (n, h, w) = images.dim();
    let all = Tensor::from_iter(images.iter().copied(), &Device::Cpu)?.reshape((n, 1, h, w))?;
    Ok(candle_nn::ops::pixel_unshuffle(&all, 2)?)
}
