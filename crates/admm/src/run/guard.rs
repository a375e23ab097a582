//! What tells a diverged run from a hard one, and what is given back after it.

use crate::{Estimate, Progress};
use sci_forward::Measurement;

/// After an estimate this many times closer to the measurement, one that is further from it than a black video has diverged.
const FALL_BACK: f64 = 10.0;
/// How many times brighter (root mean square) a result may be than [`level`]; scenes reach twice that.
const TOO_BRIGHT: f64 = 10.0;

/// Follows the residuals of a run, and keeps the iterate with the smallest.
///
/// An iterate has diverged if it is not finite, if its relative residual exceeds a limit, or if it is above 1 (a black video has 1,
/// and the truth, whatever the noise, hardly more) after one of a tenth of it. A result may not be above 1 at all, and not be far
/// brighter than any scene that gives this measurement: what no mask sees of a wrong start, or of a wrong prior, stays in it
/// unnoticed by the residual.
pub(crate) struct Guard {
    limit: f64,
    level: f64,
    /// The smallest residual of an iterate, of the start before the first.
    best: f64,
    /// Whether an iterate was admitted.
    iterated: bool,
    /// The best iterate, once another has followed.
    kept: Option<Estimate>,
}

impl Guard {
    pub(crate) fn new(measurement: &Measurement, start_residual: f64, limit: f64) -> Self {
        Self { limit, level: level(measurement), best: start_residual, iterated: false, kept: None }
    }

    /// Takes note of an iterate, `previous` being the one before. False if it has diverged.
    pub(crate) fn admit(&mut self, residual: f64, change: f64, previous: &Estimate) -> bool {
        let fell_back = self.iterated && residual > 1.0 && residual > FALL_BACK * self.best;
        if !(residual <= self.limit && change.is_finite()) || fell_back {
            return false;
        }
        if !self.iterated || residual < self.best {
            self.best = residual;
            self.kept = None;
        } else if self.kept.is_none() {
            self.kept = Some(previous.clone());
        }
        self.iterated = true;
        true
    }

    /// Whether the last admitted iterate may be called a result.
    pub(crate) fn is_result(&self, residual: f64, progress: Progress) -> bool {
        !self.iterated || (residual <= 1.0 && progress.norm.sqrt() <= TOO_BRIGHT * self.level)
    }

    /// Makes `current`, the last iterate that was not found to have diverged, the best one; returns its residual.
    pub(crate) fn restore_best(&self, current: &mut Estimate) -> f64 {
        if let Some(kept) = &self.kept {
            current.assign(kept);
        }
        self.best
    }
}

/// How large `‖x‖` is expected to be at most, from the shortest video that has the measurement: `√(B Σ y² / diag(H Hᵀ))` over the
/// measured pixels, the others taken to be like them. A still scene, and one that is bright in one frame only, are no larger.
fn level(measurement: &Measurement) -> f64 {
    let (y, gram, least) = (measurement.y(), measurement.operator().gram(), measurement.least_telling());
    let (sum, count) = ndarray::Zip::from(y).and(gram).fold((0f64, 0usize), |(sum, count), &y, &gram| {
        if gram > 0.0 && gram >= least {
            (sum + f64::from(y).powi(2) / f64::from(gram), count + 1)
        } else {
            (sum, count)
        }
    });
    let pixels = y.len() as f64;
    let frames = measurement.shape().frames as f64;
    // A black measurement has no level of its own: full scale.
    if sum > 0.0 { (frames * sum / count as f64 * pixels).sqrt() } else { (frames * pixels).sqrt() }
}
