//! Priors for the mosaic of a color sensor, made from priors for gray or RGB video.

use crate::{BoxError, DenoiseCx, Denoiser};
use ndarray::{Array4, ArrayView4, ArrayViewMut4, Axis};
use sci_forward::bayer::{CfaPattern, Demosaicer, mosaic_into, sub_lattice, sub_lattice_mut};

/// Denoises the four Bayer sub-lattices of a mosaic `[T, 1, H, W]` as four gray videos, each with a denoiser of its own.
#[derive(Debug, Clone)]
pub struct PerLattice<D> {
    denoisers: [D; 4],
}

impl<D: Denoiser + Clone> PerLattice<D> {
    /// The same denoiser for each sub-lattice.
    pub fn new(denoiser: D) -> Self {
        Self { denoisers: std::array::from_fn(|_| denoiser.clone()) }
    }
}

impl<D: Denoiser> Denoiser for PerLattice<D> {
    fn name(&self) -> &str {
        self.denoisers[0].name()
    }

    fn denoise(
        &mut self,
        cx: &DenoiseCx,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        let noisy = noisy.index_axis_move(Axis(1), 0);
        for (site, denoiser) in self.denoisers.iter_mut().enumerate() {
            let (row, column) = (site / 2, site % 2);
            let out = sub_lattice_mut(out.index_axis_mut(Axis(1), 0), row, column);
            let noisy = sub_lattice(noisy, row, column);
            denoiser.denoise(cx, noisy.insert_axis(Axis(1)), out.insert_axis(Axis(1)))?;
        }
        Ok(())
    }
}

/// A denoiser of RGB video as a denoiser of the mosaic: `mosaic(D_σ(demosaic(x)))`. With [`Gap`](crate::Gap) it is the color GAP
/// of the reference code.
pub struct Demosaicked<D, M> {
    denoiser: D,
    demosaicer: M,
    cfa: CfaPattern,
    rgb: Array4<f32>,
    denoised: Array4<f32>,
}

impl<D: Denoiser, M: Demosaicer> Demosaicked<D, M> {
    /// Of a sensor with this pattern.
    pub fn new(denoiser: D, demosaicer: M, cfa: CfaPattern) -> Self {
        let empty = Array4::zeros((0, 3, 0, 0));
        Self { denoiser, demosaicer, cfa, rgb: empty.clone(), denoised: empty }
    }
}

impl<D: Denoiser, M: Demosaicer> Denoiser for Demosaicked<D, M> {
    fn name(&self) -> &str {
        self.denoiser.name()
    }

    fn denoise(
        &mut self,
        cx: &DenoiseCx,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        let mosaic = noisy.index_axis_move(Axis(1), 0);
        let (frames, height, width) = mosaic.dim();
        if self.rgb.dim() != (frames, 3, height, width) {
            self.rgb = Array4::zeros((frames, 3, height, width));
            self.denoised = self.rgb.clone();
        }
        self.demosaicer.demosaic(self.cfa, mosaic, self.rgb.view_mut())?;
        self.denoiser.denoise(cx, self.rgb.view(), self.denoised.view_mut())?;
        mosaic_into(self.cfa, self.denoised.view(), out.index_axis_mut(Axis(1), 0));
        Ok(())
    }

    fn rgb(&self) -> Option<ArrayView4<'_, f32>> {
        Some(self.denoised.view())
    }
}
