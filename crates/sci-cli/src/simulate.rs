//! Owns simulation for `sci simulate`, `sci mask` and `data.kind = "simulate"`: a camera, from masks and video to what its sensor stores.

use anyhow::Context;
use ndarray::{Array3, Axis, s};
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
        readout.full = readout.gain * f64::from(real.reach()) + readout.black;
    }
    let differ = real != masks;
    let mut scene = Scene::new(file, keys, real.view().to_owned(), None, Some(truth), cfa)?;
    scene.measurements = if real.is_signed() {
        read_twice(&scene, &real, &readout, camera.seed)?
    } else {
        readout.apply(scene.measurements.view(), camera.seed)?
    };
    if differ {
        scene.operator = operator_of(masks);
    }
    Ok(scene)
}

/// What a differential camera stores `[N, H, W]`: the sensor reads the light of values above 0 and of those below, and the difference is
/// taken of the numbers. Black cancels out; noise, an end of the range and steps are of each of the two.
fn read_twice(scene: &Scene, real: &MaskStack, readout: &Readout, seed: u64) -> anyhow::Result<Array3<f32>> {
    let y = &scene.measurements;
    let all = operator_of(MaskStack::new(real.view().mapv(f32::abs))?);
    let mut both = Array3::zeros((2 * y.len_of(Axis(0)), y.len_of(Axis(1)), y.len_of(Axis(2))));
    for (k, y) in y.outer_iter().enumerate() {
        let light = all.forward(scene.truth_of(k).context("a simulated scene has all of its truth")?);
        both.index_axis_mut(Axis(0), 2 * k).assign(&((&light + &y) / 2.0));
        both.index_axis_mut(Axis(0), 2 * k + 1).assign(&((&light - &y) / 2.0));
    }
    let stored = readout.apply(both.view(), seed)?;
    Ok(&stored.slice(s![..;2, .., ..]) - &stored.slice(s![1..;2, .., ..]))
}

#[cfg(test)]
mod tests {
    use super::*;
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

    /// Each of two readings has its black level and its noise: the one cancels out, the other adds up.
    #[test]
    fn a_differential_camera_is_read_twice() {
        let masks = MaskStack::random(SHAPE, 0.5, 1).unwrap().differential().unwrap();
        let read = |readout| {
            let truth = Truth::Sensor(Array3::from_shape_fn((6, 12, 16), |(t, i, j)| (t + i + j) as f32 / 40.0));
            let camera = Camera { readout, ..Camera::default() };
            simulate("v", &Keys::default(), masks.clone(), truth, None, &camera).unwrap()
        };
        let plain = read(Readout { black: 0.3, ..Readout::default() });
        let off = |scene: &Scene| {
            let expected = scene.operator.forward(scene.truth_of(1).unwrap());
            (&scene.y(1) - &expected).mapv(|d| d * d).mean().unwrap().sqrt()
        };
        assert!(off(&plain) < 1e-6);
        let noise = sci_forward::Noise::new(None, 0.1).unwrap();
        let noisy = off(&read(Readout { noise, ..Readout::default() }));
        assert!((noisy - 0.02f32.sqrt()).abs() < 0.02, "{noisy}");
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
