//! A denoiser of gray video as a prior on the mosaic of a color sensor.

use crate::{Call, Denoiser, Estimate, Prior, PriorError};
use ndarray::{ArrayView3, Axis};
use sci_forward::bayer::{sub_lattice, sub_lattice_mut};

/// Denoises the four Bayer sub-lattices of a mosaic `[T, H, W]` as four gray videos, each with a denoiser of its own.
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

impl<D: Denoiser> Prior for PerLattice<D> {
    fn apply(&mut self, call: &Call<'_>, noisy: ArrayView3<'_, f32>, out: &mut Estimate) -> Result<(), PriorError> {
        out.rgb = None;
        let call = call.without_measurement();
        for (site, denoiser) in self.denoisers.iter_mut().enumerate() {
            let (row, column) = (site / 2, site % 2);
            let to = sub_lattice_mut(out.sensor.view_mut(), row, column).insert_axis(Axis(1));
            let noisy = sub_lattice(noisy, row, column).insert_axis(Axis(1));
            denoiser.denoise(&call, noisy, to).map_err(|source| PriorError::denoiser(denoiser, source))?;
        }
        Ok(())
    }
}
