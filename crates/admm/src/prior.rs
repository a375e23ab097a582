//! The seam between a solver and what it plugs in as a prior.

use crate::BoxError;
use ndarray::{ArrayView4, ArrayViewMut4};

/// Where in the solve a denoiser is called.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DenoiseCx {
    /// σ, the standard deviation of the noise to remove, in units of a frame's full scale (`25 / 255`, not 25).
    pub sigma: f32,
    /// The iteration, counted from 0 over all stages.
    pub iteration: usize,
    /// The stage of the schedule, counted from 0.
    pub stage: usize,
    /// The root mean square error of the result, in units of a frame's full scale, that the solve would not notice: a share of the
    /// predicted error of the iterates where pixels are held out ([`HoldOut`](crate::HoldOut)), else 0.
    pub tolerance: f32,
}

impl DenoiseCx {
    /// A first call with this σ; no error is tolerated.
    pub const fn new(sigma: f32) -> Self {
        Self { sigma, iteration: 0, stage: 0, tolerance: 0.0 }
    }
}

/// Removes noise of a given strength from a video: the proximal step `v = D_σ(x)` of plug-and-play methods.
///
/// Decorators (adaptation, skipping) are denoisers too. The input may leave `[0, 1]` and the output is not clipped.
pub trait Denoiser {
    /// A short lower-case name for logs, such as `"tv"`.
    fn name(&self) -> &str;

    /// Writes the denoised video to `out`; `noisy` and `out` are `[T, C, H, W]`, `C` = 1 or 3.
    ///
    /// # Errors
    /// What the implementation reports, for example a number of channels that it was not made for.
    fn denoise(
        &mut self,
        cx: &DenoiseCx,
        noisy: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError>;

    /// The RGB video `[T, 3, H, W]` behind the last output, of a denoiser that works on a mosaic in color.
    fn rgb(&self) -> Option<ArrayView4<'_, f32>> {
        None
    }
}

impl<D: Denoiser + ?Sized> Denoiser for &mut D {
    fn name(&self) -> &str {
        (**self).name()
    }
    fn denoise(
        &mut self,
        cx: &DenoiseCx,
        noisy: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        (**self).denoise(cx, noisy, out)
    }
    fn rgb(&self) -> Option<ArrayView4<'_, f32>> {
        (**self).rgb()
    }
}

impl<D: Denoiser + ?Sized> Denoiser for Box<D> {
    fn name(&self) -> &str {
        (**self).name()
    }
    fn denoise(
        &mut self,
        cx: &DenoiseCx,
        noisy: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        (**self).denoise(cx, noisy, out)
    }
    fn rgb(&self) -> Option<ArrayView4<'_, f32>> {
        (**self).rgb()
    }
}

/// One denoiser for each stage of the schedule, so that a cheap prior can prepare the ground for a dear one.
pub struct PerStage<'a> {
    denoisers: Vec<Box<dyn Denoiser + 'a>>,
    of_stage: Vec<usize>,
    /// The denoiser that was called last.
    last: usize,
    name: String,
}

impl<'a> PerStage<'a> {
    /// Stage `s` calls `denoisers[of_stage[s]]`.
    ///
    /// # Panics
    /// If an index is out of range.
    pub fn new(denoisers: Vec<Box<dyn Denoiser + 'a>>, of_stage: Vec<usize>) -> Self {
        assert!(of_stage.iter().all(|&i| i < denoisers.len()), "every stage names a denoiser");
        let name = denoisers.iter().map(|d| d.name()).collect::<Vec<_>>().join(" → ");
        Self { denoisers, of_stage, last: 0, name }
    }
}

impl Denoiser for PerStage<'_> {
    fn name(&self) -> &str {
        &self.name
    }
    fn denoise(
        &mut self,
        cx: &DenoiseCx,
        noisy: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        let Some(&index) = self.of_stage.get(cx.stage) else {
            return Err(format!("stage {} has no denoiser: there are {}", cx.stage, self.of_stage.len()).into());
        };
        self.last = index;
        self.denoisers[index].denoise(cx, noisy, out)
    }
    fn rgb(&self) -> Option<ArrayView4<'_, f32>> {
        self.denoisers[self.last].rgb()
    }
}

/// Clips the output of a denoiser to `[0, 1]`.
#[derive(Debug, Clone)]
pub struct Clipped<D>(pub D);

impl<D: Denoiser> Denoiser for Clipped<D> {
    fn name(&self) -> &str {
        self.0.name()
    }
    fn denoise(
        &mut self,
        cx: &DenoiseCx,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        self.0.denoise(cx, noisy, out.view_mut())?;
        out.par_mapv_inplace(clip);
        Ok(())
    }
    fn rgb(&self) -> Option<ArrayView4<'_, f32>> {
        self.0.rgb()
    }
}

/// Into `[0, 1]`; a NaN stays one.
pub(crate) fn clip(v: f32) -> f32 {
    v.clamp(0.0, 1.0)
}
