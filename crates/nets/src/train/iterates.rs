//! What a solver asks a denoiser: measurements simulated from training clips with new random masks, solved by GAP with the
//! network as it is. An iterate is no clean video with white noise; its error has the structure of the masks.

use super::config::IteratesConfig;
use crate::unrolled::{First, Recipe, RecordedCall, Relay};
use crate::weights::WeightFile;
use crate::{Architecture, Ends, Error, Network, Result};
use admm::Denoiser;
use rand::{Rng, RngExt};
use sci_forward::Measurement;

/// Weight of the TV prior in the start: the one of the reference's, and of configurations.
const START_WEIGHT: f32 = 0.1;

impl IteratesConfig {
    /// The network that makes the first calls, if one does, for clips of so many channels.
    ///
    /// # Errors
    /// When its weights cannot be read, or are not for such clips.
    pub(super) fn load_first(&self, channels: usize) -> Result<Option<Box<dyn Network>>> {
        let Some(first) = &self.first else { return Ok(None) };
        let net = Architecture::load(WeightFile::read(&first.weights)?, Ends::Circular)?;
        if net.channels() != channels || net.sees_mosaics() {
            let legal = format!("weights of a denoiser of {channels} channels");
            return Err(Error::Setting { key: "iterates.first.weights", value: net.describe(), legal });
        }
        Ok(Some(net))
    }

    /// How many calls another network makes.
    fn first_calls(&self) -> usize {
        self.first.as_ref().map_or(0, |first| first.sigmas.len())
    }

    /// The denoiser of the whole solve: `then` after the calls of the network of [`Self::load_first`].
    pub(super) fn relay<'d>(&self, first: Option<&dyn Network>, then: &'d mut dyn Network) -> Relay<'d> {
        Relay::new(first.map(|network| First { network, calls: self.first_calls() }), then)
    }

    /// What the solver gives the denoiser in some of the calls of a solve, drawn anew: of [`Self::unrolled`] ones consecutive calls. Iterates
    /// of one clip are much alike, so that few of many clips teach more than all of few. Nothing where the solve diverges.
    ///
    /// # Errors
    /// That of the network.
    pub(super) fn record(
        &self,
        measurement: &Measurement,
        denoiser: &mut dyn Denoiser,
        rng: &mut impl Rng,
    ) -> Result<Option<Vec<RecordedCall>>> {
        let calls = if self.unrolled {
            let first = rng.random_range(0..=self.sigmas.len() - self.calls);
            (first..first + self.calls).collect()
        } else {
            let mut calls = rand::seq::index::sample(rng, self.sigmas.len(), self.calls).into_vec();
            calls.sort_unstable();
            calls
        };
        let calls = calls.into_iter().map(|call: usize| self.first_calls() + call).collect();
        self.recipe().record(measurement, denoiser, calls)
    }

    /// Accelerated GAP; the denoiser sees the video another way round in every call, as in the configurations that networks are trained
    /// for.
    pub(super) fn recipe(&self) -> Recipe {
        let first = self.first.iter().flat_map(|first| &first.sigmas);
        Recipe {
            sigmas: first.chain(&self.sigmas).map(|s| s / 255.0).collect(),
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
    use crate::train::config::{CameraConfig, FirstCalls, MaskKind};
    use crate::{Ffdnet, FfdnetSpec};
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
        let sigmas = vec![40.0, 20.0];
        let settings = IteratesConfig { first: None, sigmas, calls: 1, unrolled: false, start_iterations: 2 };
        let camera = CameraConfig {
            frames: [2, 2],
            density: [0.5, 0.5],
            masks: MaskKind::ALL.to_vec(),
            noise: 0.0,
            noisy: 0.0,
            holes: 0.1,
            saturated: 0.0,
            mask_errors: 0.0,
            mask_grain: 0.0,
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

    #[test]
    fn another_network_makes_the_first_calls() {
        let first = FirstCalls { weights: "bundled:ffdnet_gray".into(), sigmas: vec![50.0, 40.0] };
        let settings = IteratesConfig {
            first: Some(first),
            sigmas: vec![20.0, 10.0],
            calls: 2,
            unrolled: true,
            start_iterations: 2,
        };
        let clip = Array4::from_shape_fn((3, 1, 16, 16), |(t, _, y, x)| ((7 * t + 5 * y + 3 * x) % 11) as f32 / 11.0);
        let rng = &mut ChaCha8Rng::seed_from_u64(1);
        let measurement = camera::plain(clip.view(), CfaPattern::Rggb, 0.0, rng).unwrap();
        let (mut other, mut trained) = (settings.load_first(1).unwrap().unwrap(), other_network());
        let mut both = settings.relay(Some(&*other), &mut trained);
        let seen = settings.record(&measurement, &mut both, rng).unwrap().unwrap();
        assert_eq!(seen.iter().map(|call| call.iteration).collect::<Vec<_>>(), [2, 3]);
        // What the trained one is given first is the other's work alone, what it is given then is not.
        let mut alone = settings.relay(None, &mut *other);
        let by_other = settings.recipe().record(&measurement, &mut alone, vec![2, 3]).unwrap().unwrap();
        assert_eq!(seen[0].input, by_other[0].input);
        assert_ne!(seen[1].input, by_other[1].input);
        assert!(settings.load_first(3).err().unwrap().to_string().contains("iterates.first.weights"));
    }

    fn other_network() -> Ffdnet {
        Ffdnet::random(FfdnetSpec { width: 8, depth: 3, ..FfdnetSpec::GRAY }, 3).unwrap()
    }
}
