//! What a sensor makes of the light that it sums: noise, gain, a pedestal, defects, an end of its range, whole numbers.

use crate::{Noise, NoiseError};
use ndarray::{Array2, Array3, ArrayView3, Zip};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A setting of a sensor outside its range.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ReadoutError {
    /// A setting.
    #[error("a sensor with {key} = {value}: it must be {legal}")]
    Setting {
        /// Its name.
        key: &'static str,
        /// Its value.
        value: f64,
        /// What is legal.
        legal: &'static str,
    },
    /// Whole numbers need a largest one.
    #[error("a sensor of {0} bits without an end of its range: the largest number must stand for something")]
    Endless(u32),
    /// Its noise.
    #[error(transparent)]
    Noise(#[from] NoiseError),
}

/// A sensor, from the light of a pixel to the number that is stored. The default stores the light as it is.
///
/// ```text
/// y' = round(min(gain · noisy(y) + black, full))          dead pixels: black, hot ones: full
/// ```
///
/// in the unit of y, white of a single frame. Rounded is to `2^bits − 1` equal steps from 0 to `full`, so that nothing is negative.
///
/// | Setting | Default | Purpose | Range |
/// |---|---|---|---|
/// | `noise` | none | of the light and the electronics, before the gain | as [`Noise`] |
/// | `gain` | 1 | what light is multiplied by | `(0, 1e6]` |
/// | `black` | 0 | what is read without light | `[-1e6, 1e6]` |
/// | `full` | ∞ | what is read at most | > 0 |
/// | `bits` | none | of the converter, with a finite `full` | 1 to 24 |
/// | `dead`, `hot` | 0 | shares of pixels that see nothing, or more than there is | `[0, 0.5]` |
///
/// ```
/// use ndarray::array;
/// use sci_forward::Readout;
///
/// let sensor = Readout { gain: 2.0, black: 0.5, full: 3.0, bits: Some(2), ..Readout::default() };
/// let y = sensor.apply(array![[[0.0, 0.3, 0.8, 9.0]]].view(), 0)?;
/// assert_eq!(y, array![[[1.0, 1.0, 2.0, 3.0]]]); // 0.5, 1.1 and 2.1 in steps of 1, and the end of the range
/// # Ok::<(), sci_forward::ReadoutError>(())
/// ```
///
/// # References
/// EMVA Standard 1288, *Standard for characterization of image sensors and cameras*, release 4.0: the linear model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Readout {
    /// Shot and read noise.
    pub noise: Noise,
    /// What light is multiplied by.
    pub gain: f64,
    /// What is read without light.
    pub black: f64,
    /// What is read at most.
    pub full: f64,
    /// Bits of the converter.
    pub bits: Option<u32>,
    /// Share of the pixels that read black.
    pub dead: f64,
    /// Share of the pixels that read full; where there is no end, half as much again as the brightest.
    pub hot: f64,
}

impl Default for Readout {
    fn default() -> Self {
        Self { noise: Noise::NONE, gain: 1.0, black: 0.0, full: f64::INFINITY, bits: None, dead: 0.0, hot: 0.0 }
    }
}

/// A hot pixel of a sensor without an end, in units of the brightest measurement.
const HOT: f64 = 1.5;

impl Readout {
    /// What the sensor stores of `y` `[N, H, W]`. Noise differs from measurement to measurement, defects do not; both are the same for the
    /// same `seed`.
    ///
    /// # Errors
    /// [`ReadoutError`] for a setting outside its range.
    pub fn apply(&self, y: ArrayView3<'_, f32>, seed: u64) -> Result<Array3<f32>, ReadoutError> {
        self.check()?;
        let mut stored = y.to_owned();
        for (k, mut y) in stored.outer_iter_mut().enumerate() {
            // The noise draws from two seeds in a row.
            let seed = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(2 * k as u64);
            let noisy = self.noise.apply(y.view(), seed);
            y.assign(&noisy);
        }
        let (gain, black) = (self.gain as f32, self.black as f32);
        stored.mapv_inplace(|y| gain * y + black);
        self.spoil(&mut stored, seed);
        stored.mapv_inplace(|y| self.ended(y));
        Ok(stored)
    }

    fn check(&self) -> Result<(), ReadoutError> {
        let check = |key, value, legal, ok: bool| {
            if ok { Ok(()) } else { Err(ReadoutError::Setting { key, value, legal }) }
        };
        let Self { gain, black, full, bits, dead, hot, .. } = *self;
        check("gain", gain, "greater than 0 and at most 1e6", gain > 0.0 && gain <= 1e6)?;
        check("black", black, "from -1e6 to 1e6", black.abs() <= 1e6)?;
        check("full", full, "greater than 0", full > 0.0)?;
        check("dead", dead, "from 0 to 0.5", (0.0..=0.5).contains(&dead))?;
        check("hot", hot, "from 0 to 0.5", (0.0..=0.5).contains(&hot))?;
        if let Some(bits) = bits {
            check("bits", bits.into(), "from 1 to 24", (1..=24).contains(&bits))?;
            if full.is_infinite() {
                return Err(ReadoutError::Endless(bits));
            }
        }
        Ok(())
    }

    /// Dead and hot pixels, the same ones in all measurements.
    fn spoil(&self, stored: &mut Array3<f32>, seed: u64) {
        if self.dead + self.hot == 0.0 {
            return;
        }
        let brightest = f64::from(stored.iter().copied().fold(0.0, f32::max));
        let full = if self.full.is_finite() { self.full } else { HOT * brightest };
        // Not the stream of the noise of the first measurement.
        let mut rng = ChaCha8Rng::seed_from_u64(!seed);
        let (_, height, width) = stored.dim();
        let drawn = Array2::from_shape_simple_fn((height, width), || rng.random::<f64>());
        for y in stored.outer_iter_mut() {
            Zip::from(y).and(&drawn).for_each(|y, &drawn| match drawn {
                drawn if drawn < self.dead => *y = self.black as f32,
                drawn if drawn < self.dead + self.hot => *y = full as f32,
                _ => {}
            });
        }
    }

    /// Within the range, in the steps of the converter.
    fn ended(&self, y: f32) -> f32 {
        let y = f64::from(y).min(self.full);
        let Some(bits) = self.bits else { return y as f32 };
        let step = self.full / f64::from((1u32 << bits) - 1);
        ((y.max(0.0) / step).round() * step) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp() -> Array3<f32> {
        Array3::from_shape_fn((2, 40, 50), |(_, i, j)| (i * 50 + j) as f32 / 500.0)
    }

    #[test]
    fn the_default_stores_the_light() {
        assert_eq!(Readout::default().apply(ramp().view(), 3).unwrap(), ramp());
    }

    #[test]
    fn noise_is_seeded_and_differs_between_measurements() {
        let sensor = |photons, sigma| Readout { noise: Noise::new(photons, sigma).unwrap(), ..Readout::default() };
        let both = |seed| sensor(Some(100.0), 0.1).apply(ramp().view(), seed).unwrap();
        let first = |y: &Array3<f32>, k| y.index_axis(ndarray::Axis(0), k).to_owned();
        let y = both(3);
        assert_eq!(y, both(3));
        assert_ne!(y, both(4));
        assert_ne!(first(&y, 0), first(&y, 1));
    }

    #[test]
    fn numbers_are_whole_and_end() {
        let sensor = Readout { gain: 1.1, black: 0.1, full: 3.0, bits: Some(8), ..Readout::default() };
        let y = sensor.apply(ramp().view(), 0).unwrap();
        let counts = y.mapv(|y| y / 3.0 * 255.0);
        assert!(counts.iter().all(|c| (c - c.round()).abs() < 1e-3));
        let expected = ramp().mapv(|y| (1.1 * y + 0.1).min(3.0));
        assert!((y - expected).iter().all(|d| d.abs() < 0.51 * 3.0 / 255.0));
    }

    #[test]
    fn defects_stay_where_they_are() {
        let sensor = Readout { black: 0.25, full: 9.0, dead: 0.1, hot: 0.05, ..Readout::default() };
        let y = sensor.apply((ramp() + 0.5).view(), 7).unwrap();
        let share = |v: f32| {
            let of = |k| y.index_axis(ndarray::Axis(0), k).mapv(|y| y == v);
            assert_eq!(of(0), of(1));
            of(0).iter().filter(|is| **is).count() as f64 / 2000.0
        };
        assert!((share(0.25) - 0.1).abs() < 0.03 && (share(9.0) - 0.05).abs() < 0.02);
    }

    #[test]
    fn what_is_out_of_range_is_named() {
        let check = |sensor: Readout, part: &str| {
            let message = sensor.apply(ramp().view(), 0).unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        };
        check(Readout { gain: 0.0, ..Readout::default() }, "gain = 0");
        check(Readout { full: f64::NAN, ..Readout::default() }, "full = NaN");
        check(Readout { hot: 0.6, ..Readout::default() }, "hot = 0.6");
        check(Readout { bits: Some(8), ..Readout::default() }, "8 bits without an end");
        check(Readout { bits: Some(40), full: 1.0, ..Readout::default() }, "bits = 40");
    }
}
