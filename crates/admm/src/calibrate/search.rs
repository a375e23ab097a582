//! From a grid of shifts to parabolas in each parameter.

use super::level::Level;
use super::{CalibrateError, Calibrated, Calibration, Errors, GROUPS, Judge, Parameter, Point, Progress, Watch};
use sci_forward::MaskMismatch;
use std::ops::RangeInclusive;

/// Rounds through all parameters.
const ROUNDS: usize = 6;
/// Steps to a parameter's best without another.
const ALONE: usize = 4;
/// Standard deviations by which a value must differ from what was told.
const APART: f64 = 2.0;
/// The share of the least error that a simpler answer may cost. TV itself gains some percent from masks with a little more contrast, moved a
/// little with the scene: without this, runner's right masks were moved by 0.1 pixels, at 5.8 dB; a tenth was too little for masks that
/// shift along with it.
const WORTH: f64 = 0.12;
/// Nearly closed pixels tell black level and contrast if the uncertainty of both is no more than this, and the contrast no further from what was
/// told: masks that are blurred, or elsewhere, let light fall on them.
const SURE: f64 = 0.02;
const LIKE: f64 = 0.15;
/// By so much of their uncertainty masks as told must be surer than masks as found.
const SURER: f64 = 2.0;
/// The least that either differs from what was told where it does, and in standard deviations.
const SLIGHT: f64 = 0.025;
const CLEAR: f64 = 4.0;

/// A coordinate of the search.
#[derive(Clone, Copy)]
struct Axis {
    name: &'static str,
    get: fn(&Point) -> f64,
    set: fn(&mut Point, f64),
    /// The first step.
    step: f64,
    range: (f64, f64),
}

/// An axis of which it is known otherwise than by the error of held-out pixels whether its value differs from what was told.
struct Known {
    axis: usize,
    uncertainty: f64,
    differs: bool,
}

/// All axes that the settings ask for, shifts first.
fn axes(settings: &Calibration) -> Vec<Axis> {
    let axis = |wanted: bool, name, step, range: RangeInclusive<f64>, get, set| {
        wanted.then_some(Axis { name, get, set, step, range: (*range.start(), *range.end()) })
    };
    let (shifts, reach) = (settings.reach > 0.0, -settings.reach..=settings.reach);
    let all = [
        axis(shifts, "shift down", 0.5, reach.clone(), |p| p.mismatch.shift[0], |p, v| p.mismatch.shift[0] = v),
        axis(shifts, "shift right", 0.5, reach, |p| p.mismatch.shift[1], |p, v| p.mismatch.shift[1] = v),
        axis(settings.rotation, "rotation", 0.1, -2.0..=2.0, |p| p.mismatch.rotation, |p, v| p.mismatch.rotation = v),
        axis(settings.scale, "scale", 2e-3, 0.97..=1.03, |p| p.mismatch.scale, |p, v| p.mismatch.scale = v),
        axis(settings.clock, "clock", 0.05, -0.5..=0.5, |p| p.mismatch.clock, |p, v| p.mismatch.clock = v),
        axis(settings.contrast, "contrast", 0.05, 0.3..=1.5, |p| p.mismatch.contrast, |p, v| p.mismatch.contrast = v),
        axis(settings.black, "black level", 0.01, -0.3..=0.5, |p| p.black, |p, v| p.black = v),
    ];
    all.into_iter().flatten().collect()
}

/// The state of a search.
pub(super) struct Search<'s> {
    judge: Judge<'s>,
    watch: &'s mut Watch<'s>,
    axes: Vec<Axis>,
    reach: f64,
    best: Point,
    best_errors: Errors,
    solves: usize,
    curves: Vec<Vec<(f64, f64)>>,
}

impl<'s> Search<'s> {
    pub(super) fn new(judge: Judge<'s>, settings: &Calibration, watch: &'s mut Watch<'s>) -> Self {
        let axes = axes(settings);
        let told = Point { mismatch: MaskMismatch::default(), black: 0.0 };
        Self {
            judge,
            watch,
            reach: settings.reach,
            curves: vec![Vec::new(); axes.len()],
            axes,
            best: told,
            best_errors: Errors([f64::INFINITY; GROUPS]),
            solves: 0,
        }
    }

    pub(super) fn run(mut self) -> Result<Calibrated, CalibrateError> {
        let told = self.best;
        self.best_errors = self.errors(&told)?;
        let first = self.best_errors.total();
        self.grid()?;
        let mut steps: Vec<f64> = self.axes.iter().map(|axis| axis.step).collect();
        for _ in 0..ROUNDS {
            for (i, step) in steps.iter_mut().enumerate() {
                *step = self.descend(i, *step)?;
            }
        }
        let least = self.best_errors.total();
        let known = self.told_by_closed_pixels(&told)?;
        if known.is_empty() {
            self.tell_black_from_contrast(&told, least)?;
        }
        let mut uncertainties = (0..self.axes.len()).map(|i| self.uncertainty(i)).collect::<Result<Vec<_>, _>>()?;
        known.iter().for_each(|known| uncertainties[known.axis] = known.uncertainty);
        let mut apart = self.leave_as_told(&told, least, &uncertainties, &known)?;
        if !known.is_empty() {
            // Masks may sit elsewhere now.
            for known in self.told_by_closed_pixels(&told)? {
                (apart[known.axis], uncertainties[known.axis]) = (known.differs, known.uncertainty);
            }
        }
        let parameters = self.parameters(&uncertainties, &apart);
        Ok(Calibrated {
            mismatch: self.best.mismatch,
            black: self.best.black * self.judge.level,
            exposure: None,
            error: [first, self.best_errors.total()],
            parameters,
            solves: self.solves,
        })
    }

    fn expected(&self) -> usize {
        let side = 2 * self.reach.floor() as usize + 1;
        side * side + (3 * ROUNDS + 3 + self.axes.len() / 2) * self.axes.len() + 2 * (1 + 3 * ALONE)
    }

    fn errors(&mut self, point: &Point) -> Result<Errors, CalibrateError> {
        let errors = self.judge.errors(point)?;
        self.solves += 1;
        let error = self.best_errors.total().min(errors.total());
        let progress = Progress { solves: self.solves, expected: self.expected().max(self.solves), error };
        match (self.watch)(progress) {
            std::ops::ControlFlow::Continue(()) => Ok(errors),
            std::ops::ControlFlow::Break(()) => Err(CalibrateError::Stopped),
        }
    }

    /// Tries a point, and goes there if it is better.
    fn try_point(&mut self, point: Point) -> Result<Errors, CalibrateError> {
        let errors = self.errors(&point)?;
        if errors.total() < self.best_errors.total() {
            (self.best, self.best_errors) = (point, errors);
        }
        Ok(errors)
    }

    /// Whole pixels, all within reach.
    fn grid(&mut self) -> Result<(), CalibrateError> {
        let most = self.reach.floor() as i32;
        let told = self.best;
        for (down, right) in (-most..=most).flat_map(|down| (-most..=most).map(move |right| (down, right))) {
            if (down, right) != (0, 0) {
                let mut point = told;
                point.mismatch.shift = [down.into(), right.into()];
                self.try_point(point)?;
            }
        }
        Ok(())
    }

    fn with(&self, axis: usize, value: f64) -> Point {
        let mut point = self.best;
        let Axis { set, range: (least, most), .. } = self.axes[axis];
        set(&mut point, value.clamp(least, most));
        point
    }

    /// To the minimum of the parabola through the errors at the best value and two others, to either side where the range allows; returns
    /// the next step.
    fn descend(&mut self, axis: usize, step: f64) -> Result<f64, CalibrateError> {
        let Axis { get, range: (least, most), .. } = self.axes[axis];
        let at = get(&self.best);
        let mut points = vec![(at, self.best_errors.total())];
        for value in two_beside(at, step, least, most) {
            let point = self.with(axis, value);
            points.push((get(&point), self.look(axis, point)?.total()));
        }
        let moved = get(&self.best) != at;
        let lowest = vertex([points[0], points[1], points[2]]);
        match lowest.filter(|lowest| (lowest - at).abs() <= step) {
            // Near: the next step is as small as what is left to find.
            Some(lowest) => {
                let point = self.with(axis, lowest);
                self.look(axis, point)?;
                Ok(0.5 * step)
            }
            // Beyond: go on from the better side, with longer steps.
            None if moved => Ok(1.5 * step),
            None => Ok(0.5 * step),
        }
    }

    /// Tries a point on an axis.
    fn look(&mut self, axis: usize, point: Point) -> Result<Errors, CalibrateError> {
        let errors = self.try_point(point)?;
        self.curves[axis].push(((self.axes[axis].get)(&point), errors.total()));
        Ok(errors)
    }

    /// Each group of pixels has a parabola of its own; the spread of their minima, by the root of their number.
    fn uncertainty(&mut self, axis: usize) -> Result<f64, CalibrateError> {
        let (at, step) = ((self.axes[axis].get)(&self.best), self.axes[axis].step);
        let middle = self.best_errors;
        let (below, above) = (self.errors(&self.with(axis, at - step))?, self.errors(&self.with(axis, at + step))?);
        let curvature = |g: usize| below.0[g] - 2.0 * middle.0[g] + above.0[g];
        let total: f64 = (0..GROUPS).map(curvature).sum();
        if total <= 0.0 {
            return Ok(f64::INFINITY);
        }
        // The minimum of all is moved by each group's slope over the curvature of all.
        let slopes: Vec<f64> = (0..GROUPS).map(|g| 0.5 * (above.0[g] - below.0[g])).collect();
        let mean = slopes.iter().sum::<f64>() / GROUPS as f64;
        let variance = slopes.iter().map(|slope| (slope - mean).powi(2)).sum::<f64>() / (GROUPS - 1) as f64;
        Ok(step * (GROUPS as f64 * variance).sqrt() / total)
    }

    /// Black level and contrast as nearly closed pixels tell them, if they do, of masks as found, or as told where that is far surer: TV gains from
    /// masks that moved by some hundredths of a pixel with the scene, and their closed pixels are others. What is known then.
    fn told_by_closed_pixels(&mut self, told: &Point) -> Result<Vec<Known>, CalibrateError> {
        if self.named("black level").or(self.named("contrast")).is_none() {
            return Ok(Vec::new());
        }
        let doubt = |level: &Level| level.uncertainty.iter().sum::<f64>();
        let level = match (self.judge.level(told)?, self.judge.level(&self.best)?) {
            (Some(as_told), Some(found)) if SURER * doubt(&as_told) > doubt(&found) => found,
            (Some(level), _) | (None, Some(level)) => level,
            (None, None) => return Ok(Vec::new()),
        };
        let sure = level.uncertainty.iter().all(|uncertainty| *uncertainty <= SURE);
        if !sure || (level.contrast - 1.0).abs() > LIKE {
            return Ok(Vec::new());
        }
        let mut known = Vec::new();
        for (name, value, uncertainty) in [
            ("black level", level.black.max(0.0), level.uncertainty[0]),
            ("contrast", level.contrast, level.uncertainty[1]),
        ] {
            let Some(axis) = self.named(name) else { continue };
            let as_told = (self.axes[axis].get)(told);
            let differs = (value - as_told).abs() > SLIGHT.max(CLEAR * uncertainty);
            self.best = self.with(axis, if differs { value } else { as_told });
            known.push(Known { axis, uncertainty, differs });
        }
        let point = self.best;
        self.best_errors = self.errors(&point)?;
        Ok(known)
    }

    fn named(&self, name: &str) -> Option<usize> {
        self.axes.iter().position(|axis| axis.name == name)
    }

    /// A black level and less contrast both are light that no mask explains, and a descent by one after the other ends with some of each. Where one
    /// alone, at its own best, is nearly as good, the better of the two is what is there.
    fn tell_black_from_contrast(&mut self, told: &Point, least: f64) -> Result<(), CalibrateError> {
        let (Some(contrast), Some(black)) = (self.named("contrast"), self.named("black level")) else { return Ok(()) };
        let (black_alone, contrast_alone) = (self.alone(black, contrast, told)?, self.alone(contrast, black, told)?);
        let better = if black_alone.1.total() < contrast_alone.1.total() { black_alone } else { contrast_alone };
        if better.1.total() <= (1.0 + WORTH) * least {
            (self.best, self.best_errors) = better;
        }
        Ok(())
    }

    /// The best value of an axis with another as told, from where the search is.
    fn alone(&mut self, axis: usize, other: usize, told: &Point) -> Result<(Point, Errors), CalibrateError> {
        let here = (self.best, self.best_errors);
        let point = self.with(other, (self.axes[other].get)(told));
        (self.best, self.best_errors) = (point, self.errors(&point)?);
        self.descend_alone(axis)?;
        let found = (self.best, self.best_errors);
        (self.best, self.best_errors) = here;
        Ok(found)
    }

    /// To the best value of an axis that has shared with another what there is, so that it is far.
    fn descend_alone(&mut self, axis: usize) -> Result<(), CalibrateError> {
        let mut step = 4.0 * self.axes[axis].step;
        for _ in 0..ALONE {
            step = self.descend(axis, step)?;
        }
        Ok(())
    }

    /// Puts parameters back to what was told, but for those that are `known`, the one that costs least first: those that do not differ from it
    /// by more than the data leave open, then all without which the error stays near the least. Which are left.
    fn leave_as_told(
        &mut self,
        told: &Point,
        least: f64,
        uncertainties: &[f64],
        known: &[Known],
    ) -> Result<Vec<bool>, CalibrateError> {
        let differs = |(axis, uncertainty): (&Axis, &f64)| {
            ((axis.get)(&self.best) - (axis.get)(told)).abs() > APART * uncertainty
        };
        let mut apart: Vec<bool> = self.axes.iter().zip(uncertainties).map(differs).collect();
        known.iter().for_each(|known| apart[known.axis] = known.differs);
        let mut point = self.best;
        for (axis, _) in self.axes.iter().zip(&apart).filter(|(_, apart)| !**apart) {
            (axis.set)(&mut point, (axis.get)(told));
        }
        if point != self.best {
            (self.best, self.best_errors) = (point, self.errors(&point)?);
        }
        while let Some((axis, point, errors)) = self.cheapest(told, &apart, known)? {
            if errors.total() > (1.0 + WORTH) * least {
                break;
            }
            apart[axis] = false;
            (self.best, self.best_errors) = (point, errors);
        }
        Ok(apart)
    }

    /// Of the parameters that are apart the one whose return to what was told costs least, with the point and its errors.
    fn cheapest(
        &mut self,
        told: &Point,
        apart: &[bool],
        known: &[Known],
    ) -> Result<Option<(usize, Point, Errors)>, CalibrateError> {
        let mut cheapest: Option<(usize, Point, Errors)> = None;
        for axis in (0..apart.len()).filter(|&axis| apart[axis] && known.iter().all(|known| known.axis != axis)) {
            let point = self.with(axis, (self.axes[axis].get)(told));
            let errors = self.errors(&point)?;
            if cheapest.is_none_or(|(_, _, least)| errors.total() < least.total()) {
                cheapest = Some((axis, point, errors));
            }
        }
        Ok(cheapest)
    }

    fn parameters(&mut self, uncertainties: &[f64], apart: &[bool]) -> Vec<Parameter> {
        let curves = std::mem::take(&mut self.curves);
        let all = self.axes.iter().zip(uncertainties).zip(apart).zip(curves);
        all.map(|(((axis, &uncertainty), &told_apart), mut curve)| {
            curve.sort_by(|a, b| a.0.total_cmp(&b.0));
            Parameter { name: axis.name, value: (axis.get)(&self.best), uncertainty, told_apart, curve }
        })
        .collect()
    }
}

/// The values a step below and above, both on the other side where one would be out of range.
fn two_beside(at: f64, step: f64, least: f64, most: f64) -> [f64; 2] {
    match (at - step >= least, at + step <= most) {
        (true, false) => [at - 2.0 * step, at - step],
        (false, true) => [at + step, at + 2.0 * step],
        _ => [at - step, at + step],
    }
}

/// Where the parabola through three points has its minimum, if it has one.
fn vertex([(a, fa), (b, fb), (c, fc)]: [(f64, f64); 3]) -> Option<f64> {
    let (slope_b, slope_c) = ((fb - fa) / (b - a), (fc - fa) / (c - a));
    let curvature = (slope_b - slope_c) / (b - c);
    (curvature > 0.0 && curvature.is_finite()).then(|| 0.5 * (a + b - slope_b / curvature))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_parabola_has_its_minimum_where_it_is() {
        let at = |x: f64| (x, 3.0 * (x - 0.3).powi(2) + 1.0);
        assert!((vertex([at(0.5), at(-1.0), at(2.0)]).unwrap() - 0.3).abs() < 1e-12);
        assert_eq!(vertex([(0.0, 1.0), (-1.0, 1.0), (1.0, 1.0)]), None);
        assert_eq!(vertex([(0.0, 1.0), (-1.0, 0.0), (1.0, 0.0)]), None);
        assert_eq!(vertex([(0.0, 1.0), (0.0, 1.0), (1.0, 0.0)]), None);
    }

    #[test]
    fn values_stay_in_range() {
        assert_eq!(two_beside(0.0, 0.5, -1.0, 1.0), [-0.5, 0.5]);
        assert_eq!(two_beside(1.0, 0.5, -1.0, 1.0), [0.0, 0.5]);
        assert_eq!(two_beside(-0.75, 0.5, -1.0, 1.0), [-0.25, 0.25]);
    }
}
