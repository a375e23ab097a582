//! Validation pixels: some measured pixels are held out of a run, and say when a stage or the run has done its work.

use crate::{Estimate, SolveError};
use ndarray::parallel::prelude::*;
use ndarray::{Array2, ArrayView3, Axis, Zip};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sci_forward::Measurement;

/// A part of the measurement is held out of the data steps to judge the iterates by, and stages that do nothing for it
/// are cut short. The result is the best iterate.
///
/// The judge is the *predicted error*, an estimate of the mean square error of a pixel of a frame that needs no truth.
/// With `r = y − H x`, `g = diag(H Hᵀ)` and T frames:
///
/// ```text
/// E(x) = mean over held-out pixels of r²/g  +  mean over the others of r²/(g T)
/// ```
///
/// Pixels that masks leave nearly closed ([`Measurement::least_telling`]) are not asked.
///
/// At a pixel held out, r is a sum of T errors that no data step has touched, with variance g · MSE when they are
/// independent. At the others it is the part of the error in the range of `Hᵀ`, 1/T of the dimensions, which a jump of σ
/// makes large where the pixels held out see nothing.
///
/// A stage ends when an iteration takes less than `gain` off E, once E has gone below the best of the stages before; a stage that has not
/// is given `patience` iterations. The run ends when two stages in a row did not and the best E is `2 patience` iterations
/// old, so that short stages have the patience of long ones, and when one did not while E rose in each of the last
/// `patience` iterations: a smaller σ, which overshoots at first, would have made it fall again. A stage whose σ is more than `overshoot · √E`
/// is not begun, unless it is the last: it would smooth more than there is to smooth.
///
/// A judge that does not decide leaves the run as it is, and only tells E: how well a video was recovered of which there is no truth.
///
/// | Parameter | Default | Purpose | Range |
/// |---|---|---|---|
/// | `spacing` | 12 | one pixel in each `spacing` × `spacing` block is held out | ≥ 2 |
/// | `seed` | 0 | which one | |
/// | `gain` | 0.015 | least share of E that an iteration takes off | `[0, 1)` |
/// | `patience` | 3 | iterations to get below the best E of before | ≥ 2 |
/// | `overshoot` | 2.2 | largest σ in units of `√E` | > 0 |
/// | `decides` | true | whether E ends stages and chooses the result | |
///
/// The defaults were chosen on clips that are in no benchmark. Mean of three of them, gray and color, dB: without it 25.96 and
/// 25.52 (20 and 15 iterations); overshoot 1.6 26.27 and 25.19, 2.2 26.32 and 25.42, 3 26.09 and 25.46 (gain 0.03). Gain in
/// gray: 0.03 26.32 after 23 iterations, 0.015 26.37 after 27, 0 26.38 after 34; looked at again because the benchmark's runner
/// lost 0.4 dB with 0.03. No gain: σ = 2 √E or 3 √E in each iteration instead of stages (25.66, 24.89), and extrapolation
/// v + β (v − v₋) inside stages (β = 0.3, 0.6, 1: 26.32, 26.26, 26.14).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HoldOut {
    /// Side of the blocks that give up one pixel each.
    pub spacing: usize,
    /// Of the draw.
    pub seed: u64,
    /// The least share of E that an iteration must take off for its stage to go on.
    pub gain: f64,
    /// Iterations of a stage in which E may be above the best of the stages before.
    pub patience: usize,
    /// The largest σ of a stage, in units of `√E`.
    pub overshoot: f64,
    /// Whether what they say changes the run; otherwise it is only told ([`IterInfo::predicted_error`](crate::IterInfo)).
    pub decides: bool,
}

impl Default for HoldOut {
    fn default() -> Self {
        Self { spacing: 12, seed: 0, gain: 0.015, patience: 3, overshoot: 2.2, decides: true }
    }
}

impl HoldOut {
    /// Checks every setting.
    ///
    /// # Errors
    /// [`SolveError::Setting`] for the first that is out of range.
    pub fn validate(&self) -> Result<(), SolveError> {
        let Self { spacing, gain, patience, overshoot, .. } = *self;
        let check =
            |key, value, legal, ok: bool| if ok { Ok(()) } else { Err(SolveError::Setting { key, value, legal }) };
        check("hold_out.spacing", spacing as f64, "it must be at least 2", spacing >= 2)?;
        check("hold_out.gain", gain, "it must be at least 0 and less than 1", (0.0..1.0).contains(&gain))?;
        check("hold_out.patience", patience as f64, "it must be at least 2", patience >= 2)?;
        check("hold_out.overshoot", overshoot, "it must be greater than 0", overshoot > 0.0)
    }

    /// What a solve is given of a measurement whose other pixels judge; all of it where there are too few to hold any out.
    pub fn given(&self, full: &Measurement) -> Measurement {
        HeldOut::new(full, self).map_or_else(|| full.clone(), |held_out| held_out.given)
    }

    /// Which pixels of a sensor `[H, W]` stay in use: all but one in each block.
    fn draw(&self, image: (usize, usize)) -> Array2<bool> {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        let mut stays = Array2::from_elem(image, true);
        for mut block in stays.exact_chunks_mut((self.spacing, self.spacing)) {
            block[[rng.random_range(0..self.spacing), rng.random_range(0..self.spacing)]] = false;
        }
        stays
    }
}

/// The share of `√E` that a denoiser may be off. Independent errors of a tenth add a hundredth to E, 0.04 dB; momentum adds them up:
/// with 0.13 three clips lost 0.15 to 0.19 dB, and with 0.3 in all stages but the last the benchmark's runner lost 0.7.
const TOLERANCE: f64 = 0.1;

/// What the rule says after an iteration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Verdict {
    GoOn,
    EndStage,
    Stop,
}

/// When stages and runs end, from the predicted errors alone.
#[derive(Debug)]
struct Rule {
    config: HoldOut,
    /// The least error so far, and that before the stage.
    best: f64,
    best_before: f64,
    /// The error of the iteration before.
    last: f64,
    in_stage: usize,
    /// Stages in a row that did nothing.
    failed: usize,
    /// Iterations since the best.
    idle: usize,
    /// Iterations in a row that raised the error.
    rising: usize,
}

impl Rule {
    /// `start` is the error of the video that the run starts from.
    fn new(config: HoldOut, start: f64) -> Self {
        Self { config, best: start, best_before: start, last: start, in_stage: 0, failed: 0, idle: 0, rising: 0 }
    }

    fn skips(&self, sigma: Option<f32>) -> bool {
        sigma.is_some_and(|sigma| f64::from(sigma) > self.config.overshoot * self.best.sqrt())
    }

    /// Takes the error after an iteration; `last_of_stage` when the schedule ends the stage here.
    fn observe(&mut self, error: f64, last_of_stage: bool) -> Verdict {
        self.in_stage += 1;
        let stalled = error > self.last * (1.0 - self.config.gain);
        self.idle = if error < self.best { 0 } else { self.idle + 1 };
        self.rising = if error > self.last { self.rising + 1 } else { 0 };
        (self.last, self.best) = (error, self.best.min(error));
        // The first iteration of a stage meets what the σ before has left; what it does says nothing about the stage.
        let grace = if self.best < self.best_before { 2 } else { self.config.patience };
        if !(last_of_stage || (stalled && self.in_stage >= grace)) {
            return Verdict::GoOn;
        }
        self.failed = if self.best < self.best_before { 0 } else { self.failed + 1 };
        (self.best_before, self.in_stage) = (self.best, 0);
        let patience = self.config.patience;
        let idle = self.failed >= 2 && self.idle >= 2 * patience;
        let lost = self.failed >= 1 && self.rising >= patience;
        if idle || lost { Verdict::Stop } else { Verdict::EndStage }
    }
}

/// The pixels held out of one measurement.
pub(super) struct HeldOut {
    full: Measurement,
    given: Measurement,
    /// The weight of r² in E.
    weight: Array2<f32>,
}

impl HeldOut {
    /// Nothing where there are too few pixels to hold any out.
    pub(super) fn new(full: &Measurement, config: &HoldOut) -> Option<Self> {
        let stays = config.draw(full.y().dim());
        let (gram, least) = (full.operator().gram(), full.least_telling());
        let telling = |gram: f32| gram > 0.0 && gram >= least;
        let count = |kept: bool| {
            Zip::from(&stays).and(gram).fold(0u32, |n, &stays, &gram| n + u32::from(telling(gram) && stays == kept))
        };
        let (held, used) = (count(false), count(true));
        if held == 0 || used == 0 {
            return None;
        }
        let given = full.restricted(stays.view()).ok()?;
        let frames = full.shape().frames as f32;
        let weight = Zip::from(&stays).and(gram).map_collect(|&stays, &gram| match stays {
            _ if !telling(gram) => 0.0,
            true => 1.0 / (gram * frames * used as f32),
            false => 1.0 / (gram * held as f32),
        });
        Some(Self { full: full.clone(), given, weight })
    }

    /// What the solver is given.
    pub(super) fn given(&self) -> &Measurement {
        &self.given
    }

    /// E of an iterate: rows in parallel, their sums in order.
    fn error(&self, x: ArrayView3<'_, f32>) -> f64 {
        let hx = self.full.operator().forward(x);
        let y = self.full.y_against(hx.view());
        let of_row = |row: usize| {
            let (y, hx, weight) = (y.row(row), hx.row(row), self.weight.row(row));
            let square = |y: f32, hx: f32| f64::from(y - hx).powi(2);
            Zip::from(y).and(hx).and(weight).fold(0.0, |sum, &y, &hx, &weight| sum + f64::from(weight) * square(y, hx))
        };
        let rows: Vec<f64> = (0..y.len_of(Axis(0))).into_par_iter().map(of_row).collect();
        rows.into_iter().sum()
    }
}

/// The rule, and the best iterate so far.
pub(super) struct Judge<'a> {
    held_out: &'a HeldOut,
    rule: Rule,
    best: Option<(f64, Estimate)>,
}

impl<'a> Judge<'a> {
    /// `start` is what the run starts from.
    pub(super) fn new(held_out: &'a HeldOut, config: HoldOut, start: &Estimate) -> Self {
        Self { held_out, rule: Rule::new(config, held_out.error(start.sensor.view())), best: None }
    }

    /// Judges an iterate and keeps it if it is the best; returns E and what to do.
    pub(super) fn judge(&mut self, estimate: &Estimate, last_of_stage: bool) -> (f64, Verdict) {
        let error = self.held_out.error(estimate.sensor.view());
        if !self.rule.config.decides {
            return (error, Verdict::GoOn);
        }
        match &mut self.best {
            Some((best, _)) if error >= *best => {}
            Some((best, kept)) => {
                *best = error;
                kept.assign(estimate);
            }
            None => self.best = Some((error, estimate.clone())),
        }
        (error, self.rule.observe(error, last_of_stage))
    }

    /// Whether a stage with this σ has nothing to do.
    pub(super) fn skips(&self, sigma: Option<f32>) -> bool {
        self.rule.config.decides && self.rule.skips(sigma)
    }

    /// For [`Call::tolerance`](crate::Call::tolerance).
    pub(super) fn tolerance(&self) -> f32 {
        if self.rule.config.decides { (TOLERANCE * self.rule.best.sqrt()) as f32 } else { 0.0 }
    }

    pub(super) fn into_best(self) -> Option<Estimate> {
        self.best.map(|(_, estimate)| estimate)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sci_forward::testing::moving_square;
    use sci_forward::{MaskOperator, MaskStack, SensingOperator, VideoShape};
    use std::sync::Arc;

    /// How many of `errors` the rule looks at in stages of at most 6, where stages end, and whether it stops.
    fn follow(start: f64, errors: &[f64]) -> (Vec<usize>, bool) {
        let mut rule = Rule::new(HoldOut::default(), start);
        let (mut ends, mut in_stage) = (Vec::new(), 0);
        for (k, &error) in errors.iter().enumerate() {
            in_stage += 1;
            match rule.observe(error, in_stage == 6) {
                Verdict::GoOn => continue,
                Verdict::EndStage => ends.push(k),
                Verdict::Stop => return (ends, true),
            }
            in_stage = 0;
        }
        (ends, false)
    }

    #[test]
    fn a_stage_goes_on_while_it_gains() {
        assert_eq!(follow(1.0, &[0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3]), (vec![5], false));
    }

    #[test]
    fn a_stage_ends_where_its_gain_does() {
        assert_eq!(follow(1.0, &[0.9, 0.8, 0.79]), (vec![2], false));
    }

    #[test]
    fn a_bad_first_iteration_is_forgiven() {
        assert_eq!(follow(1.0, &[0.5, 0.499, 0.9, 0.45, 0.4, 0.399]), (vec![1, 5], false));
    }

    #[test]
    fn two_stages_that_only_lose_end_the_run() {
        assert_eq!(follow(1.0, &[0.5, 0.499, 0.6, 0.61, 0.605, 0.55, 0.56, 0.57, 0.1]), (vec![1, 4], true));
    }

    #[test]
    fn a_stage_that_only_rises_ends_the_run() {
        assert_eq!(follow(1.0, &[0.5, 0.499, 0.51, 0.52, 0.53, 0.1]), (vec![1], true));
        // The first rise is of the σ that changed.
        assert_eq!(follow(1.0, &[0.5, 0.499, 0.6, 0.51, 0.52, 0.45]), (vec![1, 4], false));
    }

    #[test]
    fn stages_of_one_iteration_have_the_patience_of_longer_ones() {
        let mut rule = Rule::new(HoldOut::default(), 1.0);
        let mut verdicts = [0.5, 0.6, 0.7, 0.6, 0.45, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5].map(|e| rule.observe(e, true));
        assert_eq!(verdicts[10], Verdict::Stop);
        verdicts[10] = Verdict::EndStage;
        assert_eq!(verdicts, [Verdict::EndStage; 11]);
    }

    #[test]
    fn a_stage_that_would_smooth_too_much_is_skipped() {
        let mut rule = Rule::new(HoldOut::default(), 1.0);
        assert!(!rule.skips(Some(0.5)));
        rule.observe(0.01, false);
        assert!(rule.skips(Some(0.23)) && !rule.skips(Some(0.21)) && !rule.skips(None));
    }

    #[test]
    fn one_pixel_of_each_block_is_held_out() {
        let draw = |seed| HoldOut { spacing: 5, seed, ..HoldOut::default() }.draw((31, 17));
        let stays = draw(3);
        assert_eq!(stays.iter().filter(|stays| !**stays).count(), 6 * 3);
        assert!(stays.exact_chunks((5, 5)).into_iter().all(|block| block.iter().filter(|stays| !**stays).count() == 1));
        assert_eq!(stays, draw(3));
        assert_ne!(stays, draw(4));
    }

    #[test]
    fn settings_out_of_range_are_named() {
        let default = HoldOut::default();
        let wrong = [
            (HoldOut { spacing: 1, ..default }, "hold_out.spacing = 1: it must be at least 2"),
            (HoldOut { gain: 1.0, ..default }, "hold_out.gain = 1: it must be at least 0 and less than 1"),
            (HoldOut { patience: 1, ..default }, "hold_out.patience = 1: it must be at least 2"),
            (HoldOut { overshoot: 0.0, ..default }, "hold_out.overshoot = 0: it must be greater than 0"),
        ];
        assert!(default.validate().is_ok());
        for (config, message) in wrong {
            assert_eq!(config.validate().unwrap_err().to_string(), message);
        }
    }

    #[test]
    fn pixels_held_out_are_hidden_from_the_solver_and_predict_the_error() {
        let shape = VideoShape { frames: 4, height: 64, width: 64 };
        let h = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.5, 1).unwrap()));
        let truth = moving_square(shape);
        let full = Measurement::new(h.clone(), h.forward(truth.view())).unwrap();
        let pixels = HeldOut::new(&full, &HoldOut { spacing: 4, ..HoldOut::default() }).unwrap();
        let given = pixels.given();
        let hidden = || Zip::from(given.operator().gram()).and(h.gram()).and(given.y());
        let count = hidden().fold(0, |n, &given, &full, &y| n + usize::from(given == 0.0 && full > 0.0 && y == 0.0));
        assert!(count > 200, "{count}");
        assert!(pixels.error(truth.view()) < 1e-12);
        // Independent errors of known size.
        let mut noisy = truth;
        let noise = sci_forward::testing::gaussian(shape.dim(), 5);
        noisy.zip_mut_with(&noise, |x, n| *x += 0.1 * n);
        let predicted = pixels.error(noisy.view());
        // 1 + 1/T of the mean square error: at the pixels that the data step sees, nothing has been projected here.
        assert!((predicted / 0.0125 - 1.0).abs() < 0.15, "{predicted}");
    }

    /// Masks of gray glass: where only the glass is open, y is noise.
    #[test]
    fn nearly_closed_pixels_do_not_predict() {
        let shape = VideoShape { frames: 4, height: 64, width: 64 };
        let masks = MaskStack::random(shape, 0.5, 1).unwrap().view().mapv(|c| c.max(0.005));
        let h = Arc::new(MaskOperator::new(MaskStack::new(masks).unwrap()));
        let truth = moving_square(shape);
        let y = h.forward(truth.view())
            + sci_forward::testing::gaussian((1, 64, 64), 5).index_axis(Axis(0), 0).mapv(|n| 0.04 * n);
        let full = Measurement::new(h, y).unwrap();
        let pixels = HeldOut::new(&full, &HoldOut { spacing: 4, ..HoldOut::default() }).unwrap();
        let predicted = pixels.error(truth.view());
        // The noise over the light of an open pixel, which is about 2.
        assert!(predicted < 3.0 * 0.04 * 0.04, "{predicted}");
    }

    /// A better iterate takes the place of the best whole: at the sensor and in RGB.
    #[test]
    fn the_best_iterate_is_kept_whole() {
        let shape = VideoShape { frames: 2, height: 16, width: 16 };
        let h = Arc::new(MaskOperator::new(MaskStack::random(shape, 0.9, 1).unwrap()));
        let truth = moving_square(shape);
        let full = Measurement::new(h.clone(), h.forward(truth.view())).unwrap();
        let config = HoldOut { spacing: 4, ..HoldOut::default() };
        let pixels = HeldOut::new(&full, &config).unwrap();
        let rgb = |v: f32| ndarray::Array4::from_elem((2, 3, 16, 16), v);
        let at = |off: f32, rgb| Estimate { sensor: &truth + off, rgb };
        for iterates in [[at(0.2, None), at(0.1, Some(rgb(1.0)))], [at(0.2, Some(rgb(2.0))), at(0.1, None)]] {
            let mut judge = Judge::new(&pixels, config, &at(0.5, None));
            iterates.iter().for_each(|estimate| _ = judge.judge(estimate, false));
            judge.judge(&at(0.3, Some(rgb(3.0))), false);
            assert_eq!(judge.into_best().as_ref(), Some(&iterates[1]));
        }
    }
}
