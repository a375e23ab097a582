//! The decorator that keeps an estimate within the range of pictures.

use crate::priors::clip;
use crate::{Call, Estimate, Prior, PriorError};
use ndarray::ArrayView3;

/// Clips the estimate of a prior to `[0, 1]`.
#[derive(Debug, Clone)]
pub struct Clipped<P>(pub P);

impl<P: Prior> Prior for Clipped<P> {
    fn apply(&mut self, call: &Call<'_>, noisy: ArrayView3<'_, f32>, out: &mut Estimate) -> Result<(), PriorError> {
        self.0.apply(call, noisy, out)?;
        out.sensor.par_mapv_inplace(clip);
        if let Some(rgb) = &mut out.rgb {
            rgb.par_mapv_inplace(clip);
        }
        Ok(())
    }
}
