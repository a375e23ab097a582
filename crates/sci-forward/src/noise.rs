//! Sensor noise on a measurement, seeded.

use ndarray::{Array2, ArrayView2, ArrayView3, Zip};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Poisson, StandardNormal};

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

/// The noise of a sensor: shot noise of the light, then read noise of the electronics.
///
/// ```text
/// y' = Poisson(photons · max(y, 0)) / photons + N(0, sigma²)
/// ```
///
/// `y` is in units of a frame's full scale, so it reaches `Σ_t C_t`. Without `photons` there is no shot noise, and `y' = y + N`.
///
/// ```
/// use ndarray::Array2;
/// use sci_forward::Noise;
///
/// let y = Array2::from_elem((64, 64), 2.0);
/// let noisy = Noise::new(Some(100.0), 0.1)?.apply(y.view(), 7);
/// // The variances add up: 2 / 100 + 0.1².
/// assert!((noisy.mean().unwrap() - 2.0).abs() < 0.02 && (noisy.var(0.0) - 0.03).abs() < 0.003);
/// # Ok::<(), sci_forward::NoiseError>(())
/// ```
///
/// # References
/// Foi et al., *Practical Poissonian-Gaussian noise modeling and fitting for single-image raw-data*, 2008.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Noise {
    photons: Option<f64>,
    sigma: f64,
}

/// The share of the usual below which a pixel counts as closed, and how many of them tell a noise.
const CLOSED: f32 = 1e-3;
const LEAST_CLOSED: usize = 64;
/// How far from their median noise reaches, in median distances: five standard deviations.
const FARTHEST: f32 = 7.4;

fn median(values: impl Iterator<Item = f32>) -> Option<f32> {
    let mut values: Vec<f32> = values.collect();
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f32::total_cmp).1)
}

/// The least distance from `middle`, where it is that of a sensor of whole numbers; else 0. Values that are stuck far off are fewer than those that
/// noise moves by one step.
fn step(values: &[f32], middle: f32) -> f32 {
    let off = || values.iter().map(|y| (y - middle).abs()).filter(|off| *off > 0.0);
    let least = off().fold(f32::INFINITY, f32::min);
    if off().filter(|off| *off == least).count() * 100 > 8 * values.len() { least } else { 0.0 }
}

/// How many different numbers there are.
fn distinct(values: &[f32]) -> usize {
    let mut sorted = values.to_vec();
    sorted.sort_unstable_by(f32::total_cmp);
    sorted.dedup();
    sorted.len()
}

impl Noise {
    /// No noise.
    pub const NONE: Self = Self { photons: None, sigma: 0.0 };

    /// Noise of a sensor that counts `photons` per unit of `y`, in (0, 1e9] (`None`: no shot noise), and whose read noise has
    /// the standard deviation `sigma` ≥ 0 in the unit of `y`.
    ///
    /// # Errors
    /// [`NoiseError`] for a parameter outside its range.
    pub fn new(photons: Option<f64>, sigma: f64) -> Result<Self, NoiseError> {
        if let Some(photons) = photons.filter(|photons| !(*photons > 0.0 && *photons <= 1e9)) {
            return Err(NoiseError::Photons(photons));
        }
        if !(sigma.is_finite() && sigma >= 0.0) {
            return Err(NoiseError::Sigma(sigma));
        }
        Ok(Self { photons, sigma })
    }

    /// The read noise of measurements `[N, H, W]`, seen at the pixels that no mask opens, whatever the scene is: those of `open` `[H, W]`
    /// (`Σ_t |C_t|`) that are 0, or a thousandth of the usual. It is their standard deviation, so that a black level does not count, without
    /// those that are further from their median than five times as much by the median distance: hot ones. Shot noise is not seen there.
    /// Nothing where fewer than 64 pixels are closed, which tell it to 9 %.
    ///
    /// ```
    /// use ndarray::{Array2, Array3};
    /// use sci_forward::Noise;
    ///
    /// let closed = |i, j| (i * 7 + j) % 11 == 0;
    /// let open = Array2::from_shape_fn((40, 40), |(i, j)| if closed(i, j) { 0.0 } else { 4.0 });
    /// let noise = Noise::new(None, 0.1)?;
    /// let y = noise.apply((&open * 0.4 + 0.2).view(), 3).insert_axis(ndarray::Axis(0));
    /// let found = Noise::of_closed_pixels(y.view(), open.view()).unwrap();
    /// assert!((found.variance(0.0).sqrt() - 0.1).abs() < 0.02);
    /// # Ok::<(), sci_forward::NoiseError>(())
    /// ```
    ///
    /// # Panics
    /// If the sizes differ.
    ///
    /// # References
    /// Hampel, *The influence curve and its role in robust estimation*, 1974, for the median distance.
    pub fn of_closed_pixels(y: ArrayView3<'_, f32>, open: ArrayView2<'_, f32>) -> Option<Self> {
        let most = CLOSED * median(open.iter().copied())?;
        let dark: Vec<f32> = y
            .outer_iter()
            .flat_map(|y| Zip::from(y).and(open).map_collect(|&y, &open| (y, open)).into_iter())
            .filter(|(y, open)| *open <= most && y.is_finite())
            .map(|(y, _)| y)
            .collect();
        if dark.len() < LEAST_CLOSED {
            return None;
        }
        // A sensor that has no negative numbers shows the upper half of its noise alone; the other half is its lowest number.
        let lowest = dark.iter().copied().fold(f32::INFINITY, f32::min);
        let above: Vec<f32> = dark.iter().map(|y| y - lowest).filter(|y| *y > 0.0).collect();
        let share = above.len() as f32 / dark.len() as f32;
        // Two or three numbers are a pedestal between two steps.
        let half = (0.3..=0.6).contains(&share) && distinct(&above) > 2;
        let black = median(dark.iter().copied())?;
        let off: Vec<f32> = if half { above } else { dark.iter().map(|y| y - black).collect() };
        let most = FARTHEST * median(off.iter().map(|y| y.abs()))?.max(step(&dark, black));
        let near: Vec<f64> = off.iter().filter(|y| y.abs() <= most).map(|&y| f64::from(y)).collect();
        let mean = if half { 0.0 } else { near.iter().sum::<f64>() / near.len() as f64 };
        let squares = near.iter().map(|y| (y - mean).powi(2)).sum::<f64>();
        // The lower half, which the sensor shows as its lowest number, is off as far.
        let variance = if half { 2.0 * squares / dark.len() as f64 } else { squares / near.len() as f64 };
        Some(Self { photons: None, sigma: variance.sqrt() })
    }

    /// The read noise alone.
    pub fn read_noise(self) -> Self {
        Self { photons: None, ..self }
    }

    /// The variance of a measurement of `y`: `max(y, 0) / photons + sigma²`.
    ///
    /// ```
    /// let noise = sci_forward::Noise::new(Some(100.0), 0.1)?;
    /// assert!((noise.variance(2.0) - 0.03).abs() < 1e-7 && (noise.variance(-1.0) - 0.01).abs() < 1e-7);
    /// # Ok::<(), sci_forward::NoiseError>(())
    /// ```
    pub fn variance(&self, y: f32) -> f32 {
        let shot = self.photons.map_or(0.0, |photons| f64::from(y.max(0.0)) / photons);
        (shot + self.sigma * self.sigma) as f32
    }

    /// The noisy measurement `[H, W]`, the same for the same `seed`.
    ///
    /// Shot noise draws from `seed` and read noise from `seed + 1`: one of them alone is what it is in the sum of both.
    pub fn apply(&self, y: ArrayView2<'_, f32>, seed: u64) -> Array2<f32> {
        let mut noisy = y.to_owned();
        if let Some(photons) = self.photons {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            noisy.mapv_inplace(|v| (count(photons * f64::from(v), &mut rng) / photons) as f32);
        }
        if self.sigma > 0.0 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed.wrapping_add(1));
            noisy.mapv_inplace(|v| (f64::from(v) + self.sigma * normal(&mut rng)) as f32);
        }
        noisy
    }
}

/// From so many photons on, counts are drawn from a normal distribution: the skewness 1/√λ that it lacks is below 1e-4, while the
/// exact sampler loses its digits and ends at 1.8e19.
const MANY: f64 = 1e9;

/// A photon count of mean `lambda`: 0 if there is no light, or a negative reading.
fn count(lambda: f64, rng: &mut ChaCha8Rng) -> f64 {
    if lambda <= 0.0 {
        return 0.0;
    }
    if lambda >= MANY {
        return lambda + lambda.sqrt() * normal(rng);
    }
    // What is left is NaN, which stays what it is.
    Poisson::new(lambda).map_or(lambda, |poisson| poisson.sample(rng))
}

fn normal(rng: &mut ChaCha8Rng) -> f64 {
    StandardNormal.sample(rng)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mean_and_variance(noise: Noise, level: f32) -> (f64, f64) {
        let y = noise.apply(Array2::from_elem((200, 200), level).view(), 3).mapv(f64::from);
        (y.mean().unwrap(), y.var(0.0))
    }

    #[test]
    fn noise_has_the_mean_and_variance_of_its_model() {
        for (photons, sigma) in [(None, 0.2), (Some(50.0), 0.0), (Some(50.0), 0.2)] {
            let (mean, variance) = mean_and_variance(Noise::new(photons, sigma).unwrap(), 2.0);
            let expected = photons.map_or(0.0, |photons| 2.0 / photons) + sigma * sigma;
            assert!((mean - 2.0).abs() < 0.005, "{photons:?} {sigma}: {mean}");
            assert!((variance - expected).abs() < 0.03 * expected, "{photons:?} {sigma}: {variance} is not {expected}");
        }
    }

    /// Both sides of the number of photons at which the sampler changes, and beyond the range of the exact one.
    #[test]
    fn bright_light_has_shot_noise_of_the_same_law() {
        for level in [0.9 * MANY, 1.1 * MANY, 1e15, 1e20] {
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            let counts = Array2::from_shape_simple_fn((200, 200), || count(level, &mut rng) - level);
            let (mean, variance) = (counts.mean().unwrap() / level.sqrt(), counts.var(0.0) / level);
            assert!(mean.abs() < 0.02 && (variance - 1.0).abs() < 0.03, "{level}: {mean}, {variance}");
        }
    }

    #[test]
    fn light_beyond_the_samplers_range_stays_light() {
        let y = Array2::from_elem((2, 2), 2e10);
        let noisy = Noise::new(Some(1e9), 0.0).unwrap().apply(y.view(), 0);
        assert!(noisy.iter().all(|v| (v / 2e10 - 1.0).abs() < 1e-6), "{noisy}");
    }

    #[test]
    fn darkness_has_no_shot_noise_and_bad_parameters_are_refused() {
        let dark = ndarray::array![[0.0, -1.0]];
        assert_eq!(Noise::new(Some(10.0), 0.0).unwrap().apply(dark.view(), 0), Array2::<f32>::zeros((1, 2)));
        assert_eq!(Noise::new(Some(0.0), 0.0), Err(NoiseError::Photons(0.0)));
        assert_eq!(Noise::new(Some(2e9), 0.0), Err(NoiseError::Photons(2e9)));
        assert_eq!(Noise::new(None, -1.0), Err(NoiseError::Sigma(-1.0)));
        assert!(Noise::new(None, f64::NAN).is_err());
    }

    /// Sensors of whole numbers, with and without a pedestal that keeps negative noise.
    #[test]
    fn noise_is_found_at_closed_pixels_of_whole_numbers() {
        let open = Array2::from_shape_fn((64, 64), |(i, j)| if (i * 7 + j) % 11 == 0 { 0.0 } else { 4.0f32 });
        for (pedestal, sigma) in
            [(0.0, 2.5), (0.0, 10.0), (20.0, 0.5), (20.0, 0.7), (20.0, 3.0), (0.0, 0.0), (20.5, 0.2)]
        {
            let noise = Noise::new(None, sigma).unwrap();
            let mut y = noise.apply((&open * 30.0 + pedestal).view(), 3).mapv(|y| y.round().max(0.0));
            // Hot ones, one in 22 of those that are closed.
            y.iter_mut().zip(&open).filter(|(_, open)| **open == 0.0).step_by(22).for_each(|(y, _)| *y = 255.0);
            let found = Noise::of_closed_pixels(y.insert_axis(ndarray::Axis(0)).view(), open.view()).unwrap();
            // Rounding is noise too: between two steps it is half of one.
            let expected = if pedestal == 20.5 { 0.5 } else { sigma as f32 };
            let found = found.variance(0.0).sqrt();
            assert!((found - expected).abs() <= 0.15 * expected + 0.05, "{pedestal}, {sigma}: {found}");
        }
    }

    #[test]
    fn the_two_parts_are_drawn_apart() {
        let y = Array2::from_elem((8, 8), 1.0f32);
        let apply = |photons, sigma| Noise::new(photons, sigma).unwrap().apply(y.view(), 5);
        let shot = apply(Some(40.0), 0.0);
        let read = apply(None, 0.1) - &y;
        let both = apply(Some(40.0), 0.1);
        assert!((&both - &shot - &read).iter().all(|d| d.abs() < 1e-6));
        assert_ne!(Noise::new(None, 0.1).unwrap().apply(y.view(), 6), apply(None, 0.1));
    }
}
