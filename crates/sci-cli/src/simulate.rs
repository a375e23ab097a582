//! Owns simulation for `sci simulate` and `data.kind = "simulate"`: masks over a video, then the noise of a sensor.

use sci_forward::{CfaPattern, MaskStack, Noise};

use crate::io::scene::{Keys, Scene, SceneError, Truth};

/// The noise of a simulated sensor, each measurement with a seed of its own made from this one.
#[derive(Clone, Copy, Debug)]
pub struct SeededNoise {
    /// Shot and read noise.
    pub noise: Noise,
    /// Of the first measurement's seed.
    pub seed: u64,
}

/// Measures the T frames of `truth` through `masks`, T / B times; by a color sensor if it is in color or `cfa` is given.
///
/// # Errors
/// [`SceneError`] if sizes differ or there are too few frames.
pub fn simulate(
    file: &str,
    keys: &Keys,
    masks: MaskStack,
    truth: Truth,
    cfa: Option<CfaPattern>,
    noise: SeededNoise,
) -> Result<Scene, SceneError> {
    let mut scene = Scene::new(file, keys, masks.view().to_owned(), None, Some(truth), cfa)?;
    for (k, mut y) in scene.measurements.outer_iter_mut().enumerate() {
        // The noise draws from two seeds in a row.
        let seed = noise.seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(2 * k as u64);
        let noisy = noise.noise.apply(y.view(), seed);
        y.assign(&noisy);
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
        let noise = |photons, sigma, seed| SeededNoise { noise: Noise::new(photons, sigma).unwrap(), seed };
        let make = |n: SeededNoise| {
            simulate("v", &Keys::default(), masks.clone(), truth.clone(), None, n).unwrap().measurements
        };
        let both = |seed| make(noise(Some(100.0), 0.1, seed));
        let (a, b) = (both(3), both(3));
        assert_eq!(a, b);
        assert_ne!(a.index_axis(ndarray::Axis(0), 0), a.index_axis(ndarray::Axis(0), 1));
        assert_ne!(a, both(4));
        let clean = make(noise(None, 0.0, 3));
        assert_eq!(clean.index_axis(ndarray::Axis(0), 0), clean.index_axis(ndarray::Axis(0), 1));
    }
}
