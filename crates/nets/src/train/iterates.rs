//! What a solver asks a denoiser: measurements simulated from training clips with new random masks, solved by GAP with the
//! network as it is. An iterate is no clean video with white noise; its error has the structure of the masks.

use super::config::IteratesConfig;
use crate::Result;
use crate::unrolled::{Recipe, RecordedCall, unusable};
use admm::{Denoiser, Prior, Tv};
use ndarray::{Array2, Array3, ArrayView4, Axis};
use rand::{Rng, RngExt};
use sci_forward::bayer::mosaic_into;
use sci_forward::{CfaPattern, MaskOperator, MaskStack, Measurement, SensingOperator, VideoShape};
use std::sync::Arc;

/// Weight of the TV prior in the start: the one of the reference's, and of configurations.
const START_WEIGHT: f32 = 0.1;

/// The prior of the start, for each sub-lattice of a color sensor.
pub(super) fn start_prior(measurement: &Measurement) -> Box<dyn Prior> {
    Tv::new(START_WEIGHT).on_sensor(measurement.cfa())
}

/// A measurement of a training clip.
#[derive(Clone)]
pub(super) struct Simulated {
    measurement: Measurement,
}

impl Simulated {
    /// A clip `[T, C, H, W]` seen through new masks: binary ones of a density drawn from the range, or, for the share
    /// `gray_masks`, any transmittance; up to the share `holes` of its pixels not measured; color clips through a sensor of one of the four patterns.
    pub(super) fn random(clip: ArrayView4<'_, f32>, settings: &IteratesConfig, rng: &mut impl Rng) -> Result<Self> {
        let (frames, channels, height, width) = clip.dim();
        let shape = VideoShape { frames, height, width };
        let masks = random_masks(shape, settings, rng)?;
        let measured = (settings.holes > 0.0).then(|| {
            let share = settings.holes * rng.random::<f64>();
            Array2::from_shape_simple_fn((height, width), || rng.random::<f64>() >= share)
        });
        // Drawn for gray clips too: what is drawn next does not depend on the color.
        let pattern = CfaPattern::ALL[rng.random_range(0..4)];
        let cfa = (channels == 3).then_some(pattern);
        let operator = Arc::new(MaskOperator::new(masks));
        let y = match cfa {
            None => operator.forward(clip.index_axis(Axis(1), 0)),
            Some(cfa) => {
                let mut mosaic = Array3::zeros(shape.dim());
                mosaic_into(cfa, clip, mosaic.view_mut());
                operator.forward(mosaic.view())
            }
        };
        let whole = Measurement::new(operator, y).map_err(unusable)?.with_cfa(cfa);
        let measurement = match measured {
            None => whole,
            Some(measured) => whole.restricted(measured.view()).map_err(unusable)?,
        };
        Ok(Self { measurement })
    }

    pub(super) fn measurement(&self) -> &Measurement {
        &self.measurement
    }

    /// What the solver gives the denoiser in some of its calls, drawn anew. Iterates of one clip are much
    /// alike, so that few of many clips teach more than all of few.
    ///
    /// # Errors
    /// That of the network.
    pub(super) fn iterates(
        &self,
        settings: &IteratesConfig,
        denoiser: &mut dyn Denoiser,
        rng: &mut impl Rng,
    ) -> Result<Vec<RecordedCall>> {
        let mut calls = rand::seq::index::sample(rng, settings.sigmas.len(), settings.calls).into_vec();
        calls.sort_unstable();
        settings.recipe().record(&self.measurement, denoiser, calls)
    }

    /// [`Self::iterates`] of consecutive calls; which is the last is drawn.
    ///
    /// # Errors
    /// That of the network.
    pub(super) fn last_calls(
        &self,
        settings: &IteratesConfig,
        denoiser: &mut dyn Denoiser,
        rng: &mut impl Rng,
    ) -> Result<Vec<RecordedCall>> {
        let first = rng.random_range(0..=settings.sigmas.len() - settings.calls);
        settings.recipe().record(&self.measurement, denoiser, (first..first + settings.calls).collect())
    }
}

impl IteratesConfig {
    /// Accelerated GAP; the denoiser sees the video another way round in every call, as in the configurations that networks are trained
    /// for.
    pub(super) fn recipe(&self) -> Recipe {
        Recipe {
            sigmas: self.sigmas.iter().map(|s| s / 255.0).collect(),
            accelerate: true,
            start: (self.start_iterations > 0).then_some((self.start_iterations, START_WEIGHT)),
            flips: true,
            dim: 1.0,
        }
    }
}

fn random_masks(shape: VideoShape, settings: &IteratesConfig, rng: &mut impl Rng) -> Result<MaskStack> {
    let [low, high] = settings.density;
    let density = low + (high - low) * rng.random::<f64>();
    let masks = if rng.random::<f64>() < settings.gray_masks {
        MaskStack::new(Array3::from_shape_simple_fn(shape.dim(), || rng.random()))
    } else {
        MaskStack::random(shape, density, rng.random())
    };
    masks.map_err(unusable)
}

#[cfg(test)]
mod tests {
    use super::*;
    use admm::{BoxError, Call};
    use ndarray::{Array4, ArrayViewMut4};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    struct Broken;

    impl Denoiser for Broken {
        fn name(&self) -> &str {
            "broken"
        }

        fn denoise(
            &mut self,
            _: &Call<'_>,
            _: ArrayView4<'_, f32>,
            mut out: ArrayViewMut4<'_, f32>,
        ) -> std::result::Result<(), BoxError> {
            out.fill(f32::NAN);
            Ok(())
        }
    }

    /// Validation goes on with a network that has gone astray.
    #[test]
    fn a_solve_that_diverges_has_a_finite_result_of_the_clips_size() {
        let settings = IteratesConfig {
            sigmas: vec![40.0, 20.0],
            calls: 1,
            unrolled: false,
            start_iterations: 2,
            frames: [2, 2],
            density: [0.5, 0.5],
            gray_masks: 0.0,
            holes: 0.1,
        };
        for channels in [1, 3] {
            let clip =
                Array4::from_shape_fn((2, channels, 8, 10), |(t, c, y, x)| ((t + 2 * c + y + x) % 7) as f32 / 7.0);
            let rng = &mut ChaCha8Rng::seed_from_u64(1);
            let simulated = Simulated::random(clip.view(), &settings, rng).unwrap();
            let result = settings.recipe().solve(simulated.measurement(), &mut Broken).unwrap();
            assert_eq!(result.dim(), clip.dim());
            assert!(result.iter().all(|v| v.is_finite()));
        }
    }
}
