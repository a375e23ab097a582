//! Owns simulation for `sci simulate` and `data.kind = "simulate"`: masks over a video, then the noise of a sensor.

use sci_forward::{CfaPattern, MaskStack, Noise};

use crate::io::scene::{Keys, Scene, SceneError, Truth};

/// The noise of a simulated sensor: shot noise first, then read noise.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NoiseModel {
    /// Standard deviation of the Gaussian part, in the unit of y; 0 for none.
    pub sigma: f32,
    /// Photons a unit of y, `None` for no shot noise.
    pub photons: Option<f64>,
    /// Seed; each measurement gets its own stream from it.
    pub seed: u64,
}

/// Why a simulation fails.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SimulateError {
    /// Masks and video do not fit.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A noise parameter out of range.
    #[error(transparent)]
    Noise(#[from] sci_forward::NoiseError),
}

/// Measures the T frames of `truth` through `masks`, T / B times; by a color sensor if it is in color or `cfa` is given.
///
/// # Errors
/// [`SimulateError`] if sizes differ, there are too few frames, or the noise is out of range.
pub fn simulate(
    file: &str,
    keys: &Keys,
    masks: MaskStack,
    truth: Truth,
    cfa: Option<CfaPattern>,
    noise: &NoiseModel,
) -> Result<Scene, SimulateError> {
    let mut scene = Scene::new(file, keys, masks.view().to_owned(), None, Some(truth), cfa)?;
    for (k, mut y) in scene.measurements.outer_iter_mut().enumerate() {
        // Two draws a measurement, each from a seed of its own.
        let seed = |part: u64| noise.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(2 * k as u64 + part);
        if let Some(photons) = noise.photons {
            let shot = Noise::Poisson { photons }.apply(y.view(), seed(0))?;
            y.assign(&shot);
        }
        if noise.sigma > 0.0 {
            let read = Noise::Gaussian { sigma: f64::from(noise.sigma) }.apply(y.view(), seed(1))?;
            y.assign(&read);
        }
    }
    Ok(scene)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;
    use sci_forward::VideoShape;

    #[test]
    fn noise_is_seeded_and_differs_between_measurements() {
        let shape = VideoShape { frames: 2, height: 8, width: 8 };
        let masks = MaskStack::random(shape, 0.5, 1).unwrap();
        let truth = Truth::Sensor(Array3::from_elem((4, 8, 8), 0.5));
        let noise = NoiseModel { sigma: 0.1, photons: Some(100.0), seed: 3 };
        let make = |n: &NoiseModel| {
            simulate("v", &Keys::default(), masks.clone(), truth.clone(), None, n).unwrap().measurements
        };
        let (a, b) = (make(&noise), make(&noise));
        assert_eq!(a, b);
        assert_ne!(a.index_axis(ndarray::Axis(0), 0), a.index_axis(ndarray::Axis(0), 1));
        assert_ne!(a, make(&NoiseModel { seed: 4, ..noise }));
        let clean = make(&NoiseModel { sigma: 0.0, photons: None, seed: 3 });
        assert_eq!(clean.index_axis(ndarray::Axis(0), 0), clean.index_axis(ndarray::Axis(0), 1));
    }
}
