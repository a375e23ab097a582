//! From a grid of shifts to parabolas in each parameter.

use super::level::Level;
use super::{CalibrateError, Calibrated, Calibration, Errors, GROUPS, Judge, Parameter, Point, Progress, Watch};
use sci_forward::MaskMismatch;
use std::ops::RangeInclusive;

/// Rounds through all parameters.
const ROUNDS: usize = 6;
/// Standard deviations by which a value must differ from what was told.
const APART: f64 = 2.0;
/// The share of the least error that a simpler answer may cost, by held-out pixels. TV itself gains some percent from a blend of frames.
const WORTH: f64 = 0.12;
/// Nearly closed pixels tell black level and contrast if the uncertainty of both is no more than this, and the contrast no further from what was
/// told: masks that are blurred, or elsewhere, let light fall on them.
const SURE: f64 = 0.02;
const LIKE: f64 = 0.15;

/// What tells a parameter.
#[derive(Clone, Copy, PartialEq, Eq)]
enum By {
    /// The brightness around each pixel.
    Neighbours,
    /// Pixels that are not given to a solve.
    HeldOut,
    /// Nearly closed pixels.
    Closed,
}

/// A coordinate of the search.
#[derive(Clone, Copy)]
struct Axis {
    name: &'static str,
    by: By,
    get: fn(&Point) -> f64,
    set: fn(&mut Point, f64),
    /// The first step.
    step: f64,
    /// What a scene may imitate: a value that differs by no more from what was told is that.
    slight: f64,
    range: (f64, f64),
}

/// All axes that the settings ask for, shifts first. Where neighbours tell nothing, all are told by held-out pixels.
fn axes(settings: &Calibration, neighbours: bool) -> Vec<Axis> {
    let axis = |wanted: bool, name, by, [step, slight]: [f64; 2], range: RangeInclusive<f64>, get, set| {
        let by = if neighbours { by } else { By::HeldOut };
        wanted.then_some(Axis { name, by, get, set, step, slight, range: (*range.start(), *range.end()) })
    };
    let (reach, shifts) = (-settings.reach..=settings.reach, settings.reach > 0.0);
    let (near, held_out, closed) = (By::Neighbours, By::HeldOut, By::Closed);
    let [moved, turned, scaled, blurred, mixed, faint, dark] =
        [[0.5, 0.02], [0.1, 0.02], [2e-3, 2e-4], [0.5, 0.3], [0.05, 0.0], [0.05, 0.01], [0.01, 0.01]];
    #[rustfmt::skip]
    let all = [
        axis(shifts, "shift down", near, moved, reach.clone(), |p| p.mismatch.shift[0], |p, v| p.mismatch.shift[0] = v),
        axis(shifts, "shift right", near, moved, reach, |p| p.mismatch.shift[1], |p, v| p.mismatch.shift[1] = v),
        axis(settings.rotation, "rotation", near, turned, -2.0..=2.0, |p| p.mismatch.rotation, |p, v| p.mismatch.rotation = v),
        axis(settings.scale, "scale", near, scaled, 0.97..=1.03, |p| p.mismatch.scale, |p, v| p.mismatch.scale = v),
        axis(settings.blur && neighbours, "blur", near, blurred, 0.0..=2.0, |p| p.mismatch.blur, |p, v| p.mismatch.blur = v),
        axis(settings.clock, "clock", held_out, mixed, -0.5..=0.5, |p| p.mismatch.clock, |p, v| p.mismatch.clock = v),
        axis(settings.contrast, "contrast", closed, faint, 0.3..=1.5, |p| p.mismatch.contrast, |p, v| p.mismatch.contrast = v),
        axis(settings.black, "black level", closed, dark, -0.3..=0.5, |p| p.black, |p, v| p.black = v),
    ];
    all.into_iter().flatten().collect()
}

/// The state of a search.
pub(super) struct Search<'s> {
    judge: Judge<'s>,
    watch: &'s mut Watch<'s>,
    axes: Vec<Axis>,
    reach: f64,
    told: Point,
    by: By,
    best: Point,
    best_errors: Errors,
    tried: usize,
    curves: Vec<Vec<(f64, f64)>>,
    /// One standard deviation of each axis, and whether its value differs from what was told.
    found: Vec<(f64, bool)>,
}

impl<'s> Search<'s> {
    pub(super) fn new(judge: Judge<'s>, settings: &Calibration, watch: &'s mut Watch<'s>) -> Self {
        let axes = axes(settings, judge.near.is_some());
        let told = Point { mismatch: MaskMismatch::default(), black: 0.0 };
        Self {
            judge,
            watch,
            reach: settings.reach,
            curves: vec![Vec::new(); axes.len()],
            found: vec![(f64::INFINITY, false); axes.len()],
            axes,
            told,
            by: By::HeldOut,
            best: told,
            best_errors: Errors([f64::INFINITY; GROUPS]),
            tried: 0,
        }
    }

    pub(super) fn run(mut self) -> Result<Calibrated, CalibrateError> {
        let first = self.judge.held_out(&self.told)?.total();
        self.search(By::Neighbours)?;
        self.level()?;
        self.search(By::HeldOut)?;
        let mut last = if self.best == self.told { first } else { self.judge.held_out(&self.best)?.total() };
        // What predicts no better is not what is there.
        if last > first {
            (self.best, last) = (self.told, first);
            self.found.iter_mut().for_each(|found| found.1 = false);
        }
        let parameters = self.parameters();
        Ok(Calibrated {
            mismatch: self.best.mismatch,
            black: self.best.black * self.judge.level,
            exposure: None,
            error: [first, last],
            parameters,
            solves: self.tried,
        })
    }

    /// The axes that are told by this.
    fn axes_by(&self, by: By) -> Vec<usize> {
        (0..self.axes.len()).filter(|&axis| self.axes[axis].by == by).collect()
    }

    /// Looks for all that is told by one of the two errors.
    fn search(&mut self, by: By) -> Result<(), CalibrateError> {
        let axes = self.axes_by(by);
        if axes.is_empty() {
            return Ok(());
        }
        self.by = by;
        let point = self.best;
        self.best_errors = self.errors(&point)?;
        if axes.iter().any(|&axis| self.axes[axis].name.starts_with("shift")) {
            self.grid()?;
        }
        let mut steps: Vec<f64> = axes.iter().map(|&axis| self.axes[axis].step).collect();
        for _ in 0..ROUNDS {
            for (&axis, step) in axes.iter().zip(&mut steps) {
                *step = self.descend(axis, *step)?;
            }
        }
        for &axis in &axes {
            self.found[axis].0 = self.uncertainty(axis)?;
        }
        self.leave_as_told(&axes)
    }

    fn expected(&self) -> usize {
        let side = 2 * self.reach.floor() as usize + 1;
        let moving = self.axes.iter().filter(|axis| axis.by != By::Closed).count();
        side * side + (3 * ROUNDS + 3 + moving / 2) * moving
    }

    fn errors(&mut self, point: &Point) -> Result<Errors, CalibrateError> {
        let errors = match &self.judge.near {
            Some(near) if self.by == By::Neighbours => near.errors(self.judge.open(point)?.view()),
            _ => self.judge.held_out(point)?,
        };
        self.tried += 1;
        let error = self.best_errors.total().min(errors.total());
        let progress = Progress { solves: self.tried, expected: self.expected().max(self.tried), error };
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
        let Axis { get, step, .. } = self.axes[axis];
        let (at, middle) = (get(&self.best), self.best_errors);
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

    /// Whether the best value is at an end of its range: the least error of all may lie beyond.
    fn is_at_end(&self, axis: usize) -> bool {
        let Axis { get, slight, range: (least, most), .. } = self.axes[axis];
        let at = get(&self.best);
        at <= least + 2.0 * slight || at >= most - 2.0 * slight
    }

    /// Black level and contrast as nearly closed pixels tell them, or, where these are too few, all. A scene may imitate some of either: held-out pixels
    /// must be predicted better with them.
    fn level(&mut self) -> Result<(), CalibrateError> {
        let (axes, point) = (self.axes_by(By::Closed), self.best);
        let (false, Some(near)) = (axes.is_empty(), &self.judge.near) else { return Ok(()) };
        let open = self.judge.open(&point)?;
        let like = |level: &Level| (level.contrast - 1.0).abs() <= LIKE;
        let sure = |level: &Level| level.uncertainty.iter().all(|uncertainty| *uncertainty <= SURE);
        let closed = near.level(open.view()).filter(|level| sure(level) && like(level));
        // What all pixels tell is biased where a scene has fine texture: it has to be worth more.
        let margin = if closed.is_some() { 1.0 } else { 1.0 + WORTH };
        let Some(level) = closed.or_else(|| near.level_by_all(open.view())) else { return Ok(()) };
        for &axis in &axes {
            let Axis { name, .. } = self.axes[axis];
            let (value, uncertainty) = match name {
                "contrast" => (level.contrast, level.uncertainty[1]),
                _ => (level.black.max(0.0), level.uncertainty[0]),
            };
            self.found[axis] = (uncertainty, self.differs(axis, value, uncertainty));
            if self.found[axis].1 {
                self.best = self.with(axis, value);
            }
        }
        if self.best != point
            && margin * self.judge.held_out(&self.best)?.total() > self.judge.held_out(&point)?.total()
        {
            self.best = point;
            axes.iter().for_each(|&axis| self.found[axis].1 = false);
        }
        Ok(())
    }

    /// Whether a value differs from what was told.
    fn differs(&self, axis: usize, value: f64, uncertainty: f64) -> bool {
        let Axis { get, slight, .. } = self.axes[axis];
        (value - get(&self.told)).abs() > slight.max(APART * uncertainty)
    }

    /// Puts parameters back to what was told, the one that costs least first: those that do not differ from it by more than the data leave open,
    /// then, by held-out pixels, all without which the error stays near the least.
    fn leave_as_told(&mut self, axes: &[usize]) -> Result<(), CalibrateError> {
        let (least, mut point) = (self.best_errors.total(), self.best);
        for &axis in axes {
            let Axis { get, set, .. } = self.axes[axis];
            self.found[axis].1 = self.differs(axis, get(&self.best), self.found[axis].0);
            if !self.found[axis].1 {
                set(&mut point, get(&self.told));
            }
        }
        if point != self.best {
            (self.best, self.best_errors) = (point, self.errors(&point)?);
        }
        while let (By::HeldOut, Some((axis, point, errors))) = (self.by, self.cheapest(axes)?) {
            if errors.total() > (1.0 + WORTH) * least {
                break;
            }
            self.found[axis].1 = false;
            (self.best, self.best_errors) = (point, errors);
        }
        Ok(())
    }

    /// Of the parameters that are apart the one whose return to what was told costs least, with the point and its errors.
    fn cheapest(&mut self, axes: &[usize]) -> Result<Option<(usize, Point, Errors)>, CalibrateError> {
        let mut cheapest: Option<(usize, Point, Errors)> = None;
        for &axis in axes.iter().filter(|&&axis| self.found[axis].1).collect::<Vec<_>>() {
            let point = self.with(axis, (self.axes[axis].get)(&self.told));
            let errors = self.errors(&point)?;
            if cheapest.is_none_or(|(_, _, least)| errors.total() < least.total()) {
                cheapest = Some((axis, point, errors));
            }
        }
        Ok(cheapest)
    }

    fn parameters(&mut self) -> Vec<Parameter> {
        let curves = std::mem::take(&mut self.curves);
        let all = self.axes.iter().zip(&self.found).zip(curves).enumerate();
        all.map(|(index, ((axis, &(uncertainty, told_apart)), mut curve))| {
            curve.sort_by(|a, b| a.0.total_cmp(&b.0));
            let at_end = told_apart && self.is_at_end(index);
            Parameter { name: axis.name, value: (axis.get)(&self.best), uncertainty, told_apart, at_end, curve }
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
