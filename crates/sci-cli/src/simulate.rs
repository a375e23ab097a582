//! Owns simulation for `sci simulate`, `sci mask` and `data.kind = "simulate"`: a camera, from masks and video to what its sensor stores.

use sci_forward::{CfaPattern, Gained, MaskError, MaskMismatch, MaskStack, Readout};

use crate::io::scene::{Keys, Scene, Truth, operator_of};

/// How the masks that modulate the light differ from those that are told.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Optics {
    /// Where they sit, and how they are seen.
    pub mismatch: MaskMismatch,
    /// Standard deviation of the frames' gains about 1.
    pub flicker: f64,
}

impl Optics {
    /// The masks that modulate the light; the gains are drawn from `seed`.
    ///
    /// # Errors
    /// If nothing of them is left open, or a value is out of range.
    pub fn masks(&self, told: &MaskStack, seed: u64) -> Result<MaskStack, MaskError> {
        let masks = self.mismatch.apply(told)?;
        if self.flicker == 0.0 {
            return Ok(masks);
        }
        MaskStack::from_source(&Gained::flickering(masks, self.flicker, seed)?)
    }
}

/// A camera. The default sums light through the masks that are told, and stores it as it is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Camera {
    /// The masks' way to the sensor.
    pub optics: Optics,
    /// The sensor. Where it has bits but no end, its largest number is what white measures behind the most open pixel.
    pub readout: Readout,
    /// Of everything random.
    pub seed: u64,
}

/// Measures the T frames of `truth`, T / B times, by a camera whose masks are told to be `masks`; by a color sensor if it is in color or
/// `cfa` is given.
///
/// # Errors
/// If sizes differ, there are too few frames, or the camera is none.
pub fn simulate(
    file: &str,
    keys: &Keys,
    masks: MaskStack,
    truth: Truth,
    cfa: Option<CfaPattern>,
    camera: &Camera,
) -> anyhow::Result<Scene> {
    let real = camera.optics.masks(&masks, camera.seed)?;
    let mut readout = camera.readout;
    if readout.bits.is_some() && readout.full.is_infinite() {
        let brightest = real.sum().iter().copied().fold(0.0, f32::max);
        readout.full = readout.gain * f64::from(brightest) + readout.black;
    }
    let differ = real != masks;
    let mut scene = Scene::new(file, keys, real.view().to_owned(), None, Some(truth), cfa)?;
    scene.measurements = readout.apply(scene.measurements.view(), camera.seed)?;
    if differ {
        scene.operator = operator_of(masks);
    }
    Ok(scene)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;
    use sci_forward::{SensingOperator, VideoShape};

    const SHAPE: VideoShape = VideoShape { frames: 3, height: 12, width: 16 };

    fn made(camera: &Camera) -> Scene {
        let masks = MaskStack::random(SHAPE, 0.5, 1).unwrap();
        let truth = Truth::Sensor(Array3::from_shape_fn((6, 12, 16), |(t, i, j)| (t + i + j) as f32 / 40.0));
        simulate("v", &Keys::default(), masks, truth, None, camera).unwrap()
    }

    #[test]
    fn light_goes_through_the_real_masks_and_the_others_are_told() {
        let told = made(&Camera::default());
        let shift = MaskMismatch { shift: [1.0, 0.0], ..MaskMismatch::default() };
        let optics = Optics { mismatch: shift, flicker: 0.1 };
        let moved = made(&Camera { optics, seed: 4, ..Camera::default() });
        assert_eq!(moved.operator.gram(), told.operator.gram());
        let real = optics.masks(&MaskStack::random(SHAPE, 0.5, 1).unwrap(), 4).unwrap();
        let expected = sci_forward::MaskOperator::new(real).forward(told.truth_of(1).unwrap());
        assert_eq!(moved.y(1), expected);
        assert_ne!(moved.y(1), told.y(1));
    }

    #[test]
    fn a_converter_without_an_end_holds_white() {
        let readout = Readout { gain: 2.0, bits: Some(4), ..Readout::default() };
        let scene = made(&Camera { readout, ..Camera::default() });
        let full = 2.0 * scene.operator.forward(Array3::ones(SHAPE.dim()).view()).iter().copied().fold(0.0, f32::max);
        let counts = scene.measurements.mapv(|y| y / full * 15.0);
        assert!(counts.iter().all(|c| (c - c.round()).abs() < 1e-3 && *c <= 15.001));
    }
}
