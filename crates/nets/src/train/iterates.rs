//! What a solver asks a denoiser: measurements simulated from training clips with new random masks, solved by GAP with the
//! network as it is. An iterate is no clean video with white noise; its error has the structure of the masks.

use super::config::IteratesConfig;
use crate::Result;
use crate::unrolled::{Recipe, RecordedCall};
use admm::Denoiser;
use rand::{Rng, RngExt};
use sci_forward::Measurement;

/// Weight of the TV prior in the start: the one of the reference's, and of configurations.
const START_WEIGHT: f32 = 0.1;

impl IteratesConfig {
    /// What the solver gives the denoiser in some of the calls of a solve, drawn anew: of [`Self::unrolled`] ones consecutive calls. Iterates
    /// of one clip are much alike, so that few of many clips teach more than all of few.
    ///
    /// # Errors
    /// That of the network.
    pub(super) fn record(
        &self,
        measurement: &Measurement,
        denoiser: &mut dyn Denoiser,
        rng: &mut impl Rng,
    ) -> Result<Vec<RecordedCall>> {
        let calls = if self.unrolled {
            let first = rng.random_range(0..=self.sigmas.len() - self.calls);
            (first..first + self.calls).collect()
        } else {
            let mut calls = rand::seq::index::sample(rng, self.sigmas.len(), self.calls).into_vec();
            calls.sort_unstable();
            calls
        };
        self.recipe().record(measurement, denoiser, calls)
    }

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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::camera;
    use crate::train::config::{CameraConfig, MaskKind};
    use admm::{BoxError, Call};
    use ndarray::{Array4, ArrayView4, ArrayViewMut4};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use sci_forward::CfaPattern;

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
        let settings = IteratesConfig { sigmas: vec![40.0, 20.0], calls: 1, unrolled: false, start_iterations: 2 };
        let camera = CameraConfig {
            frames: [2, 2],
            density: [0.5, 0.5],
            masks: MaskKind::ALL.to_vec(),
            noise: 0.0,
            noisy: 0.0,
            holes: 0.1,
            saturated: 0.0,
            mask_errors: 0.0,
        };
        for channels in [1, 3] {
            let clip =
                Array4::from_shape_fn((2, channels, 8, 10), |(t, c, y, x)| ((t + 2 * c + y + x) % 7) as f32 / 7.0);
            let rng = &mut ChaCha8Rng::seed_from_u64(1);
            let measurement = camera::measure(clip.view(), CfaPattern::Gbrg, &camera, rng).unwrap();
            let result = settings.recipe().solve(&measurement, &mut Broken).unwrap();
            assert_eq!(result.dim(), clip.dim());
            assert!(result.iter().all(|v| v.is_finite()));
        }
    }
}
