//! Sensor noise on a measurement, seeded.

use ndarray::{Array2, ArrayView2};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal, Poisson};

/// A noise parameter outside its range.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum NoiseError {
    /// σ is negative or not finite.
    #[error("Gaussian noise of standard deviation {0}: it must be finite and at least 0 (frames are in [0, 1])")]
    Sigma(f64),
    /// The photon count is not positive and finite.
    #[error("Poisson noise of {0} photons per unit: it must be finite and greater than 0, and at most 1e9")]
    Photons(f64),
}

/// The noise of a simulated measurement. `y` is in units of a frame's full scale, so it reaches `Σ_t C_t`.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Noise {
    /// `y + N(0, sigma²)`.
    Gaussian {
        /// Standard deviation, in the unit of `y`.
        sigma: f64,
    },
    /// `Poisson(photons · max(y, 0)) / photons`: shot noise of a sensor that counts `photons` per unit of `y`.
    Poisson {
        /// Photons that a pixel counts when `y` = 1.
        photons: f64,
    },
}

impl Noise {
    /// The noisy measurement `[H, W]`, the same for the same `seed`.
    ///
    /// # Errors
    /// [`NoiseError`] for a parameter outside its range.
    ///
    /// ```
    /// use ndarray::Array2;
    /// use sci_forward::Noise;
    /// let y = Noise::Gaussian { sigma: 0.1 }.apply(Array2::from_elem((4, 4), 2.0).view(), 7)?;
    /// assert!(y.iter().all(|v| (v - 2.0).abs() < 1.0));
    /// # Ok::<(), sci_forward::NoiseError>(())
    /// ```
    pub fn apply(self, y: ArrayView2<'_, f32>, seed: u64) -> Result<Array2<f32>, NoiseError> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        match self {
            Self::Gaussian { sigma } => {
                if !(sigma.is_finite() && sigma >= 0.0) {
                    return Err(NoiseError::Sigma(sigma));
                }
                let normal = Normal::new(0.0, sigma).map_err(|_| NoiseError::Sigma(sigma))?;
                Ok(y.mapv(|v| (f64::from(v) + normal.sample(&mut rng)) as f32))
            }
            Self::Poisson { photons } => {
                if !(photons > 0.0 && photons <= 1e9) {
                    return Err(NoiseError::Photons(photons));
                }
                Ok(y.mapv(|v| match Poisson::new(photons * f64::from(v)) {
                    Ok(count) => (count.sample(&mut rng) / photons) as f32,
                    // No light (or a negative reading): no photons, no noise.
                    Err(_) => 0.0,
                }))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mean_and_variance(noise: Noise) -> (f64, f64) {
        let y = noise.apply(Array2::from_elem((200, 200), 2.0).view(), 3).unwrap().mapv(f64::from);
        (y.mean().unwrap(), y.var(0.0))
    }

    #[test]
    fn noise_has_the_mean_and_variance_of_its_model() {
        let (mean, variance) = mean_and_variance(Noise::Gaussian { sigma: 0.2 });
        assert!((mean - 2.0).abs() < 0.005 && (variance - 0.04).abs() < 0.002, "{mean} {variance}");
        let (mean, variance) = mean_and_variance(Noise::Poisson { photons: 50.0 });
        assert!((mean - 2.0).abs() < 0.005 && (variance - 2.0 / 50.0).abs() < 0.002, "{mean} {variance}");
    }

    #[test]
    fn darkness_has_no_shot_noise_and_bad_parameters_are_refused() {
        let dark = Array2::zeros((2, 2));
        assert_eq!(Noise::Poisson { photons: 10.0 }.apply(dark.view(), 0).unwrap(), dark);
        assert_eq!(Noise::Poisson { photons: 0.0 }.apply(dark.view(), 0), Err(NoiseError::Photons(0.0)));
        assert_eq!(Noise::Gaussian { sigma: -1.0 }.apply(dark.view(), 0), Err(NoiseError::Sigma(-1.0)));
    }
}
