//! How the masks really sit, from measurements alone.
//!
//! Where they sit is told by how well their sum explains each pixel from the brightness around it ([`near`]), which takes no solve. A shift is
//! looked for on a grid first (a pattern of single pixels is told from itself moved by less than two), then each parameter in turn by parabolas
//! through three values, with steps that shrink. A black level and less contrast are told apart by the pixels that masks leave nearly closed
//! ([`level`]), where there are such, else by all.
//!
//! The sum of masks does not tell a share of the neighbouring frame, nor how bright it is around a pixel of masks of both signs, and where it is even
//! it tells nothing. Then they are found by pixels that are held out: the others are solved by a few iterations of GAP-TV, and the mismatch with which
//! the video predicts them best is taken, of `E(θ) = Σ ‖y − b − H_θ x_θ‖² / Σ ‖y‖²` over them, which needs no truth. Held out is one pixel in [`Calibration::spacing`].
//!
//! Clipped pixels only say that there was at least so much light: they are not asked. What the data cannot tell stays as it was told: a parameter whose
//! value is less than twice its uncertainty from that, or, by held-out pixels, without which the error is less than 12 % above the least. How much light
//! each frame gets is told apart from that, by what is even ([`Exposure`]). Light at the ends of the exposure
//! ([`MaskMismatch::ends`]) that comes through no mask is not looked for: where
//! nothing moves it is the same as less contrast, and with both, runner lost 3.5 dB of what is won back without.

mod exposure;
mod level;
mod near;
mod search;

pub use exposure::Exposure;

use crate::{Gap, Plan, SolveError, Stage, Start, Tv, run};
use ndarray::{Array2, Axis, Zip};
use near::{Neighbours, RADIUS};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sci_forward::{CfaPattern, MaskError, MaskMismatch, MaskOperator, MaskStack, Measurement, MeasurementError};
use search::Search;
use std::ops::ControlFlow;
use std::sync::Arc;

/// Weight and iterations of the fast solve.
const TV_WEIGHT: f32 = 0.15;
const ITERATIONS: usize = 16;
/// Held-out pixels fall into so many groups; each has a best value of its own, and their spread is the uncertainty.
const GROUPS: usize = 16;

/// What may be wrong with the masks, and how far it is looked for.
///
/// ```
/// use admm::Calibration;
/// use admm::sci_forward::{MaskMismatch, MaskOperator, MaskStack, SensingOperator, VideoShape};
/// use ndarray::Array3;
///
/// let shape = VideoShape { frames: 4, height: 32, width: 32 };
/// let square = |(t, i, j)| if (8..20).contains(&i) && (8 + t..20 + t).contains(&j) { 0.9 } else { 0.1 };
/// let told = MaskStack::random(shape, 0.5, 0)?;
/// let real = MaskMismatch { shift: [0.5, 0.0], ..MaskMismatch::default() }.apply(&told)?;
/// let y = MaskOperator::new(real).forward(Array3::from_shape_fn(shape.dim(), square).view());
///
/// let shifts = Calibration { rotation: false, scale: false, blur: false, contrast: false, black: false, ..Calibration::default() };
/// let found = shifts.find(&told, None, &[y], &mut |_| std::ops::ControlFlow::Continue(()))?;
/// assert!((found.mismatch.shift[0] - 0.5).abs() < 0.1, "{found:?}");
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// Farthest shift in pixels, either way, 0 to 16; 0 looks for none.
    pub reach: f64,
    /// Whether the masks may be turned.
    pub rotation: bool,
    /// Whether they may be larger or smaller.
    pub scale: bool,
    /// Whether they may be blurred.
    pub blur: bool,
    /// Whether the frame before or after is seen. Off by default: TV lags behind what moves, and a blend of frames makes up for that, so that
    /// 0.05 is found as 0.1 to 0.3. Three clips that are in no benchmark (8, 10 and 14 frames, two mask families, shift, rotation, contrast,
    /// gain, pedestal and noise besides; GAP-TV, mean): with a clock of 0.05 21.99 dB off and 21.99 on, without one 22.22 and 22.03.
    pub clock: bool,
    /// Whether they have less contrast.
    pub contrast: bool,
    /// Whether y has a black level.
    pub black: bool,
    /// Whether frames get more light or less, on a gray sensor.
    pub exposure: bool,
    /// One pixel in so many is held out, 2 or more.
    pub spacing: usize,
    /// Of the draw.
    pub seed: u64,
    /// The level at and above which pixels of y are clipped, if one is known.
    pub clip: Option<f32>,
    /// Pixels (row, column) that measure nothing.
    pub left_out: Vec<(usize, usize)>,
}

impl Default for Calibration {
    fn default() -> Self {
        Self {
            reach: 2.0,
            rotation: true,
            scale: true,
            blur: true,
            clock: false,
            contrast: true,
            black: true,
            exposure: true,
            spacing: 10,
            seed: 0,
            clip: None,
            left_out: Vec::new(),
        }
    }
}

/// A parameter that was looked for.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// `shift down`, `shift right`, `rotation`, `scale`, `blur`, `clock`, `contrast`, `black level`.
    pub name: &'static str,
    /// Its value: pixels, pixels, degrees, 1, pixels, share, share, share of the mean of y.
    pub value: f64,
    /// One standard deviation; infinite if the error does not depend on it.
    pub uncertainty: f64,
    /// Whether the value differs from what was told by more than the data leave open; else it is what was told.
    pub told_apart: bool,
    /// Whether it is an end of the range that was looked at: masks may sit further off.
    pub at_end: bool,
    /// Values that were tried, and the errors with them, in the order of values.
    pub curve: Vec<(f64, f64)>,
}

/// What was found.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibrated {
    /// How the masks differ from those that were told.
    pub mismatch: MaskMismatch,
    /// To be taken off y, in its unit.
    pub black: f64,
    /// The light of the frames, where it is not the same; for masks that are moved already.
    pub exposure: Option<Exposure>,
    /// E with the masks as told, and as found but for the light of the frames.
    pub error: [f64; 2],
    /// All that was looked for.
    pub parameters: Vec<Parameter>,
    /// Mismatches that were tried.
    pub solves: usize,
}

/// Why there is no calibration.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CalibrateError {
    /// A setting is out of range.
    #[error("{key} = {value}: it must be {legal}")]
    Setting {
        /// Its name.
        key: &'static str,
        /// Its value.
        value: f64,
        /// What is legal.
        legal: &'static str,
    },
    /// A pixel that is left out is not on the sensor.
    #[error("left_out names row {row}, column {column} of a sensor of {height} rows and {width} columns")]
    LeftOut {
        /// Its row.
        row: usize,
        /// Its column.
        column: usize,
        /// Rows of the sensor.
        height: usize,
        /// Columns of it.
        width: usize,
    },
    /// There is nothing to calibrate with.
    #[error("there is no measurement to calibrate with")]
    Empty,
    /// The masks.
    #[error(transparent)]
    Mask(#[from] MaskError),
    /// A measurement.
    #[error(transparent)]
    Measurement(#[from] MeasurementError),
    /// The fast solve.
    #[error(transparent)]
    Solve(#[from] SolveError),
    /// The caller wished to stop.
    #[error("stopped")]
    Stopped,
}

/// How far the search is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress {
    /// Mismatches tried so far.
    pub solves: usize,
    /// About how many there will be.
    pub expected: usize,
    /// The least error so far.
    pub error: f64,
}

/// Told of each step of the search.
pub type Watch<'w> = dyn FnMut(Progress) -> ControlFlow<()> + 'w;

impl Calibration {
    /// Looks for the mismatch of `masks` with which all `measurements` `[H, W]` are explained best.
    ///
    /// # Errors
    /// [`CalibrateError`] for a setting out of range, measurements that do not fit the masks, or when `watch` breaks off.
    pub fn find(
        &self,
        masks: &MaskStack,
        cfa: Option<CfaPattern>,
        measurements: &[Array2<f32>],
        watch: &mut Watch<'_>,
    ) -> Result<Calibrated, CalibrateError> {
        let setting = |key, value, legal, ok: bool| {
            if ok { Ok(()) } else { Err(CalibrateError::Setting { key, value, legal }) }
        };
        setting("reach", self.reach, "0 to 16 pixels", (0.0..=16.0).contains(&self.reach))?;
        setting("spacing", self.spacing as f64, "at least 2", self.spacing >= 2)?;
        if measurements.is_empty() {
            return Err(CalibrateError::Empty);
        }
        let (height, width) = masks.shape().image_dim();
        if let Some(&(row, column)) = self.left_out.iter().find(|&&(row, column)| row >= height || column >= width) {
            return Err(CalibrateError::LeftOut { row, column, height, width });
        }
        let judge = Judge::new(masks, cfa, measurements, self)?;
        let mut found = Search::new(judge, self, watch).run()?;
        if self.exposure && cfa.is_none() {
            let dark = found.black as f32;
            let believed = self.believed(measurements);
            let measurements: Vec<Array2<f32>> = measurements.iter().map(|y| y.mapv(|y| y - dark)).collect();
            found.exposure = Exposure::find(&found.mismatch.apply(masks)?, &measurements, &believed);
        }
        Ok(found)
    }

    /// The pixels of measurements that say how much light there was.
    fn believed(&self, measurements: &[Array2<f32>]) -> Vec<Array2<bool>> {
        let of = |y: &Array2<f32>| {
            let mut believed = y.mapv(|y| self.clip.is_none_or(|level| y < level));
            self.left_out.iter().for_each(|&at| believed[at] = false);
            believed
        };
        measurements.iter().map(of).collect()
    }
}

/// Tiles to a side, the errors of each of which have a common cause.
const TILES: usize = 4;

/// The tile of a pixel.
fn tile_of((row, column): (usize, usize), (height, width): (usize, usize)) -> usize {
    row * TILES / height * TILES + column * TILES / width
}

/// The pixels around which all are believed, so far to each side.
fn squares_of(believed: &Array2<bool>, reach: usize) -> Array2<bool> {
    let mut whole = believed.clone();
    for axis in [Axis(0), Axis(1)] {
        for mut lane in whole.lanes_mut(axis) {
            let all = lane.to_vec();
            let end = all.len();
            let near = |at: usize| &all[at.saturating_sub(reach)..(at + reach + 1).min(end)];
            lane.iter_mut().enumerate().for_each(|(at, whole)| *whole = near(at).iter().all(|&believed| believed));
        }
    }
    whole
}

/// Values of all parameters, those that are not looked for as told.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Point {
    mismatch: MaskMismatch,
    /// In units of the mean of y.
    black: f64,
}

/// Errors of the held-out pixels, group by group.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Errors([f64; GROUPS]);

impl Errors {
    fn total(&self) -> f64 {
        self.0.iter().sum()
    }
}

/// What a mismatch is judged by.
struct Judge<'a> {
    masks: &'a MaskStack,
    /// Their sum, as one mask.
    open: Option<MaskStack>,
    /// What the sum is judged by, if it tells something.
    near: Option<Neighbours>,
    cfa: Option<CfaPattern>,
    measurements: &'a [Array2<f32>],
    clip: Option<f32>,
    /// Pixels that solves are given: neither held out nor left out.
    given: Array2<bool>,
    /// The groups of each measurement's pixels that are asked.
    asked: Vec<Array2<Option<u8>>>,
    /// Mean of |y|.
    level: f64,
    /// Σ y² over the pixels that are asked.
    power: f64,
}

impl<'a> Judge<'a> {
    fn new(
        masks: &'a MaskStack,
        cfa: Option<CfaPattern>,
        measurements: &'a [Array2<f32>],
        settings: &Calibration,
    ) -> Result<Self, CalibrateError> {
        let operator = Arc::new(MaskOperator::new(masks.clone()));
        for y in measurements {
            Measurement::new(operator.clone(), y.clone())?;
        }
        let mut rng = ChaCha8Rng::seed_from_u64(settings.seed);
        let share = 1.0 / settings.spacing as f64;
        let drawn = Array2::from_shape_simple_fn(masks.shape().image_dim(), || {
            (rng.random_range(0..GROUPS) as u8, rng.random::<f64>() < share)
        });
        let groups = drawn.mapv(|(group, held_out)| held_out.then_some(group));
        let mut given = groups.mapv(|group| group.is_none());
        settings.left_out.iter().for_each(|&at| given[at] = false);
        let believed = settings.believed(measurements);
        let asked_of =
            |believed| Zip::from(&groups).and(believed).map_collect(|&group, &believed| group.filter(|_| believed));
        let asked: Vec<Array2<Option<u8>>> = believed.iter().map(asked_of).collect();
        let square = |y: &Array2<f32>, asked: &Array2<Option<u8>>| {
            Zip::from(y).and(asked).fold(0.0, |sum, &y, group| sum + group.map_or(0.0, |_| f64::from(y).powi(2)))
        };
        let power = measurements.iter().zip(&asked).map(|(y, asked)| square(y, asked)).sum::<f64>();
        let sum: f64 = measurements.iter().flatten().map(|&y| f64::from(y.abs())).sum();
        let level = sum / measurements.iter().map(Array2::len).sum::<usize>().max(1) as f64;
        let (clip, power) = (settings.clip, power.max(f64::MIN_POSITIVE));
        let margin = RADIUS + settings.reach.ceil() as usize + 1;
        let groups = drawn.mapv(|(group, _)| group);
        let near = Neighbours::new(masks, cfa, (measurements, level), &believed, &groups, margin);
        // Of masks of both signs the sum may be nothing, and nobody asks for it.
        let open = near.as_ref().map(|_| MaskStack::new(masks.sum().insert_axis(Axis(0)))).transpose()?;
        Ok(Self { masks, open, near, cfa, measurements, clip, given, asked, level, power })
    }

    /// The sum of masks that sit as in `point`.
    ///
    /// # Panics
    /// Without neighbours, as of masks of both signs.
    fn open(&self, point: &Point) -> Result<Array2<f32>, CalibrateError> {
        let open = self.open.as_ref().expect("asked for where neighbours tell");
        let moved = MaskMismatch { clock: 0.0, contrast: 1.0, ends: [0.0; 2], ..point.mismatch };
        Ok(moved.apply(open)?.sum())
    }

    /// E of a mismatch by held-out pixels, shared out among the groups.
    fn held_out(&self, point: &Point) -> Result<Errors, CalibrateError> {
        let masks = point.mismatch.apply(self.masks)?;
        let operator = Arc::new(MaskOperator::new(masks));
        let black = (point.black * self.level) as f32;
        let clip = self.clip.map(|level| level - black);
        let mut errors = [0.0; GROUPS];
        for (y, asked) in self.measurements.iter().zip(&self.asked) {
            let whole = Measurement::new(operator.clone(), y.mapv(|y| y - black))?.with_cfa(self.cfa).with_clip(clip);
            let predicted = self.predicted(&whole)?;
            Zip::from(asked).and(whole.y()).and(&predicted).for_each(|group, &y, &hx| {
                if let Some(group) = group {
                    errors[usize::from(*group)] += f64::from(y - hx).powi(2) / self.power;
                }
            });
        }
        Ok(Errors(errors))
    }

    /// H x of the whole sensor, x solved by the pixels given.
    fn predicted(&self, whole: &Measurement) -> Result<Array2<f32>, CalibrateError> {
        let given = whole.restricted(self.given.view())?;
        let prior = Tv::new(TV_WEIGHT).on_sensor(self.cfa);
        let plan = Plan::new([Stage { sigma: None, iterations: ITERATIONS }]);
        let outcome = run(&mut Gap::accelerated(prior), &given, Start::Mean, &plan, &mut ())?;
        Ok(whole.operator().forward(outcome.estimate.sensor.view()))
    }
}
