//! The seam between a solver and what it plugs in as a prior, and the priors that need no network.

mod tv;
mod wavelet;
mod wnnm;

pub use tv::Tv;
pub use wavelet::Wavelet;
pub use wnnm::{Wnnm, WnnmParams};

use crate::BoxError;
use ndarray::parallel::prelude::*;
use ndarray::{Array3, Array4, ArrayView3, ArrayView4, ArrayViewMut4, Axis};
use sci_forward::{Measurement, VideoShape};

/// Where in the solve a prior is called, and what it may look at.
#[derive(Debug, Clone, Copy, Default)]
pub struct Call<'a> {
    /// σ, the standard deviation of the noise to remove, in units of a frame's full scale (`25 / 255`, not 25). Nothing in
    /// stages of a prior with a strength of its own, such as [`Tv`].
    pub sigma: Option<f32>,
    /// The iteration, counted from 0 over all stages.
    pub iteration: usize,
    /// The stage of the schedule, counted from 0.
    pub stage: usize,
    /// The root mean square error of the result, in units of a frame's full scale, that the solve would not notice: a share of the
    /// predicted error of the iterates where pixels are held out ([`HoldOut`](crate::HoldOut)), else 0.
    pub tolerance: f32,
    /// What the solver was given to explain, without the pixels held out. Nothing where a denoiser works by itself, and
    /// where it is shown the video otherwise than the sensor saw it (mirrored, in parts).
    pub measurement: Option<&'a Measurement>,
}

impl Call<'_> {
    /// A first call with this σ, outside of any solve; no error is tolerated.
    pub const fn new(sigma: f32) -> Self {
        Self { sigma: Some(sigma), iteration: 0, stage: 0, tolerance: 0.0, measurement: None }
    }

    /// σ, for a denoiser that cannot do without.
    ///
    /// # Errors
    /// If the stage has none.
    pub fn required_sigma(&self) -> Result<f32, BoxError> {
        self.sigma.ok_or_else(|| format!("stage {} has no sigma, which this denoiser needs", self.stage).into())
    }

    /// The call for a denoiser that is shown the video otherwise than the sensor saw it.
    pub fn without_measurement(self) -> Call<'static> {
        let Self { sigma, iteration, stage, tolerance, .. } = self;
        Call { sigma, iteration, stage, tolerance, measurement: None }
    }
}

/// Removes noise of a given strength from a video: the proximal step `v = D_σ(x)` of plug-and-play methods.
///
/// Decorators (adaptation, [`Flips`](crate::Flips), [`Tiles`](crate::Tiles)) are denoisers too. The input may leave `[0, 1]`
/// and the output is not clipped.
pub trait Denoiser: Send {
    /// A short lower-case name for logs, such as `"tv"`.
    fn name(&self) -> &str;

    /// Writes the denoised video to `out`; `noisy` and `out` are `[T, C, H, W]`, `C` = 1 or 3.
    ///
    /// # Errors
    /// What the implementation reports, for example a number of channels that it was not made for.
    fn denoise(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError>;
}

macro_rules! denoise_through {
    ($($pointer:ty),+) => { $(
        impl<D: Denoiser + ?Sized> Denoiser for $pointer {
            fn name(&self) -> &str {
                (**self).name()
            }
            fn denoise(
                &mut self,
                call: &Call<'_>,
                noisy: ArrayView4<'_, f32>,
                out: ArrayViewMut4<'_, f32>,
            ) -> Result<(), BoxError> {
                (**self).denoise(call, noisy, out)
            }
        }
    )+ };
}
denoise_through!(&mut D, Box<D>);

/// One iterate: the video where the sensor sees it, and the RGB video behind it if the prior has one. They belong to the same
/// iterate, always.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    /// Gray video, or the mosaic of a color sensor, `[T, H, W]`.
    pub sensor: Array3<f32>,
    /// RGB video `[T, 3, H, W]`, of which `sensor` is the mosaic.
    pub rgb: Option<Array4<f32>>,
}

impl Estimate {
    /// A video `[T, H, W]` at the sensor, with no RGB video behind it.
    pub fn at_sensor(sensor: Array3<f32>) -> Self {
        Self { sensor, rgb: None }
    }

    /// Zeros of a size.
    pub(crate) fn zeros(shape: VideoShape) -> Self {
        Self::at_sensor(Array3::zeros(shape.dim()))
    }

    /// What is shown and kept, `[T, C, H, W]`: the RGB video if there is one, else the gray or mosaic one.
    pub fn video(&self) -> ArrayView4<'_, f32> {
        self.rgb.as_ref().map_or_else(|| self.sensor.view().insert_axis(Axis(1)), |rgb| rgb.view())
    }

    /// Whether every value is finite.
    pub fn is_finite(&self) -> bool {
        let finite = |frame: ArrayView3<'_, f32>| frame.iter().all(|v| v.is_finite());
        let rgb = self.rgb.as_ref().is_none_or(|rgb| rgb.axis_iter(Axis(0)).into_par_iter().all(finite));
        rgb && self.sensor.axis_iter(Axis(0)).into_par_iter().all(|frame| frame.iter().all(|v| v.is_finite()))
    }

    /// Both videos to write to, the RGB one made if there is none. What they hold is of an earlier iterate.
    pub fn for_rgb(&mut self) -> (&mut Array3<f32>, &mut Array4<f32>) {
        let (frames, height, width) = self.sensor.dim();
        let rgb = self.rgb.get_or_insert_with(|| Array4::zeros((frames, 3, height, width)));
        (&mut self.sensor, rgb)
    }

    /// Takes over another estimate, in the memory that is there.
    pub(crate) fn assign(&mut self, other: &Self) {
        self.sensor.assign(&other.sensor);
        match (&mut self.rgb, &other.rgb) {
            (Some(to), Some(from)) => to.assign(from),
            (to, from) => *to = from.clone(),
        }
    }
}

/// Why a prior failed: which part of it, and what that reported.
#[derive(Debug, thiserror::Error)]
#[error("{part} {name} failed")]
pub struct PriorError {
    /// What the part is: "denoiser", "demosaicer", "network".
    pub part: &'static str,
    /// Its name.
    pub name: String,
    /// What it reported.
    pub source: BoxError,
}

impl PriorError {
    pub(crate) fn denoiser(denoiser: &(impl Denoiser + ?Sized), source: BoxError) -> Self {
        Self { part: "denoiser", name: denoiser.name().to_owned(), source }
    }

    pub(crate) fn demosaicer(demosaicer: &(impl sci_forward::Demosaicer + ?Sized), source: BoxError) -> Self {
        Self { part: "demosaicer", name: demosaicer.name().to_owned(), source }
    }
}

/// From the sensor's noisy video to an estimate: what [`Gap`](crate::Gap) and [`Admm`](crate::Admm) plug in.
///
/// Any [`Denoiser`] is one, for gray sensors. Color sensors have [`PerLattice`](crate::PerLattice) and
/// [`Demosaicked`](crate::Demosaicked), schedules of several priors [`PerStage`](crate::PerStage).
pub trait Prior: Send {
    /// Writes the estimate of `noisy` `[T, H, W]` to `out`, whose sensor video has that size. `out` holds an earlier iterate: it is to be
    /// written whole, and its RGB video taken away if there is none now.
    ///
    /// # Errors
    /// What its parts report.
    fn apply(&mut self, call: &Call<'_>, noisy: ArrayView3<'_, f32>, out: &mut Estimate) -> Result<(), PriorError>;
}

impl<D: Denoiser> Prior for D {
    fn apply(&mut self, call: &Call<'_>, noisy: ArrayView3<'_, f32>, out: &mut Estimate) -> Result<(), PriorError> {
        out.rgb = None;
        let to = out.sensor.view_mut().insert_axis(Axis(1));
        self.denoise(call, noisy.insert_axis(Axis(1)), to).map_err(|source| PriorError::denoiser(self, source))
    }
}

macro_rules! apply_through {
    ($($pointer:ty),+) => { $(
        impl Prior for $pointer {
            fn apply(
                &mut self,
                call: &Call<'_>,
                noisy: ArrayView3<'_, f32>,
                out: &mut Estimate,
            ) -> Result<(), PriorError> {
                (**self).apply(call, noisy, out)
            }
        }
    )+ };
}
apply_through!(&mut (dyn Prior + '_), Box<dyn Prior + '_>);

/// Into `[0, 1]`; a NaN stays one.
pub(crate) fn clip(v: f32) -> f32 {
    v.clamp(0.0, 1.0)
}
