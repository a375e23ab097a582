//! A denoiser of RGB video as a prior on the mosaic of a color sensor.

use crate::{Call, Denoiser, Estimate, Prior, PriorError};
use ndarray::{Array4, ArrayView3};
use sci_forward::bayer::{CfaPattern, Demosaicer, mosaic_into};

/// Demosaics, denoises and samples again: `mosaic(D_σ(demosaic(x)))`. With [`Gap`](crate::Gap) it is the color GAP of the reference
/// code.
pub struct Demosaicked<D, M> {
    denoiser: D,
    demosaicer: M,
    cfa: CfaPattern,
    /// The denoiser's input, kept for its memory.
    demosaicked: Array4<f32>,
}

impl<D: Denoiser, M: Demosaicer> Demosaicked<D, M> {
    /// Of a sensor with this pattern.
    pub fn new(denoiser: D, demosaicer: M, cfa: CfaPattern) -> Self {
        Self { denoiser, demosaicer, cfa, demosaicked: Array4::zeros((0, 3, 0, 0)) }
    }
}

impl<D: Denoiser, M: Demosaicer> Prior for Demosaicked<D, M> {
    fn apply(&mut self, call: &Call<'_>, noisy: ArrayView3<'_, f32>, out: &mut Estimate) -> Result<(), PriorError> {
        let Self { denoiser, demosaicer, cfa, demosaicked } = self;
        let (sensor, rgb) = out.for_rgb();
        if demosaicked.dim() != rgb.dim() {
            *demosaicked = Array4::zeros(rgb.dim());
        }
        demosaicer
            .demosaic(*cfa, noisy, demosaicked.view_mut())
            .map_err(|source| PriorError::demosaicer(demosaicer, source))?;
        denoiser
            .denoise(call, demosaicked.view(), rgb.view_mut())
            .map_err(|source| PriorError::denoiser(denoiser, source))?;
        mosaic_into(*cfa, rgb.view(), sensor.view_mut());
        Ok(())
    }
}
