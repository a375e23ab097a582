//! The one loop that drives every solver.

use crate::{BoxError, DenoiseCx, IterInfo, Observer, Plan, Problem, Start};
use ndarray::parallel::prelude::*;
use ndarray::{Array2, Array3, Array4, ArrayView3, ArrayView4, ArrayViewMut3, Axis, Zip};
use std::ops::ControlFlow;
use std::time::{Duration, Instant};

/// Why a problem cannot be solved. Divergence is not an error: see [`StopReason::Diverged`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SolveError {
    /// An input has the wrong size.
    #[error("the {what} is {found:?}, the masks ask for {expected:?}")]
    Size {
        /// Which input.
        what: &'static str,
        /// The size it must have.
        expected: Vec<usize>,
        /// The size it has.
        found: Vec<usize>,
    },
    /// An input holds a NaN or an infinity.
    #[error("the {what} is {value} at index {at:?}: every value must be finite")]
    NotFinite {
        /// Which input.
        what: &'static str,
        /// The value.
        value: f32,
        /// Its index, in the order of the layout.
        at: Vec<usize>,
    },
    /// The denoiser failed.
    #[error("denoiser {name} failed in iteration {iteration}")]
    Denoiser {
        /// Its name.
        name: String,
        /// The iteration, counted from 0.
        iteration: usize,
        /// What it reported.
        source: BoxError,
    },
    /// The observer failed.
    #[error("an observer failed in iteration {iteration}")]
    Observer {
        /// The iteration, counted from 0.
        iteration: usize,
        /// What it reported.
        source: BoxError,
    },
}

/// Why a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum StopReason {
    /// Every stage was run.
    ScheduleDone,
    /// The relative change fell to the tolerance.
    Converged,
    /// A value was not finite or the residual exploded; the outcome holds the iterate before.
    Diverged,
    /// The time limit passed.
    TimeUp,
    /// An observer asked for it.
    Observer,
}

/// An iterative solver: `init` once, `step` for each iteration.
pub trait Solver {
    /// What is kept from one iteration to the next.
    type State;

    /// The name of its denoiser, for errors.
    fn denoiser_name(&self) -> &str;

    /// The state before the first iteration, from a video `[T, H, W]`.
    fn init(&mut self, problem: &Problem<'_>, start: Array3<f32>) -> Self::State;

    /// One iteration.
    ///
    /// # Errors
    /// What the denoiser reports.
    fn step(&mut self, problem: &Problem<'_>, cx: &DenoiseCx, state: &mut Self::State) -> Result<(), BoxError>;

    /// The estimate where the sensor sees it: gray or mosaic video `[T, H, W]`.
    fn estimate<'s>(&self, state: &'s Self::State) -> ArrayView3<'s, f32>;

    /// The RGB estimate `[T, 3, H, W]` of a color solver.
    fn rgb<'s>(&self, _state: &'s Self::State) -> Option<ArrayView4<'s, f32>> {
        None
    }
}

/// The result of [`run`].
#[derive(Debug)]
pub struct Outcome<S> {
    /// The last state of the solver (after a divergence, the diverged one).
    pub state: S,
    /// The estimate `[T, H, W]`, always finite: after a divergence the last good one.
    pub estimate: Array3<f32>,
    /// The RGB estimate `[T, 3, H, W]` of a color solver that belongs to `estimate`.
    pub rgb: Option<Array4<f32>>,
    /// Why the run ended.
    pub stop: StopReason,
    /// Iterations done, the diverged one included.
    pub iterations: usize,
    /// Seconds of solving, the start included, observers not.
    pub seconds: f64,
    /// `‖y − H x‖ / ‖y‖` of `estimate`.
    pub relative_residual: f64,
}

/// Runs `solver` on `problem` from `start` through the stages of `plan`.
///
/// # Errors
/// [`SolveError`] for a bad start, or what the denoiser or the observer reports. Divergence is an outcome, not an error.
pub fn run<S: Solver>(
    solver: &mut S,
    problem: &Problem<'_>,
    start: Start<'_>,
    plan: &Plan,
    observer: &mut dyn Observer,
) -> Result<Outcome<S::State>, SolveError> {
    let mut clock = Stopwatch::start();
    let start = start.video(problem)?;
    let mut best = LastGood::new(problem, start.clone());
    let mut state = solver.init(problem, start);
    clock.pause();
    observer.begin(plan).map_err(|source| SolveError::Observer { iteration: 0, source })?;

    let mut iterations = 0;
    let mut stop = StopReason::ScheduleDone;
    'stages: for (stage, &crate::Stage { sigma, iterations: count }) in plan.stages.iter().enumerate() {
        for _ in 0..count {
            clock.resume();
            let cx = DenoiseCx { sigma, iteration: iterations, stage };
            solver.step(problem, &cx, &mut state).map_err(|source| SolveError::Denoiser {
                name: solver.denoiser_name().to_owned(),
                iteration: cx.iteration,
                source,
            })?;
            iterations += 1;
            let advance = best.advance(problem, solver.estimate(&state), solver.rgb(&state), plan.stop.diverged_above);
            clock.pause();
            let Some(relative_change) = advance else {
                stop = StopReason::Diverged;
                break 'stages;
            };
            let info = IterInfo {
                iteration: cx.iteration,
                stage,
                sigma,
                estimate: best.estimate.view(),
                rgb: best.rgb.as_ref().map(|rgb| rgb.view()),
                relative_residual: best.relative_residual,
                relative_change,
                seconds: clock.elapsed().as_secs_f64(),
            };
            let flow =
                observer.iteration(&info).map_err(|source| SolveError::Observer { iteration: cx.iteration, source })?;
            stop = match flow {
                ControlFlow::Break(()) => StopReason::Observer,
                _ if relative_change <= plan.stop.relative_change => StopReason::Converged,
                _ if plan.stop.time.is_some_and(|limit| clock.elapsed() >= limit) => StopReason::TimeUp,
                _ => continue,
            };
            break 'stages;
        }
    }
    let seconds = clock.elapsed().as_secs_f64();
    let LastGood { estimate, rgb, relative_residual, .. } = best;
    Ok(Outcome { state, estimate, rgb, stop, iterations, seconds, relative_residual })
}

/// The newest estimate that is finite and fits the measurement, kept apart from the solver's state.
struct LastGood {
    estimate: Array3<f32>,
    rgb: Option<Array4<f32>>,
    relative_residual: f64,
    hx: Array2<f32>,
}

impl LastGood {
    fn new(problem: &Problem<'_>, estimate: Array3<f32>) -> Self {
        let hx = Array2::zeros(problem.y().dim());
        let mut last = Self { estimate, rgb: None, relative_residual: 0.0, hx };
        last.relative_residual = last.residual_of(problem, None);
        last
    }

    /// `‖y − H x‖ / ‖y‖` of `candidate`, or of the kept estimate.
    fn residual_of(&mut self, problem: &Problem<'_>, candidate: Option<ArrayView3<'_, f32>>) -> f64 {
        let x = candidate.unwrap_or(self.estimate.view());
        problem.operator().forward_into(x, self.hx.view_mut());
        let sum = Zip::from(&self.hx).and(problem.y()).fold(0.0, |s, &a, &b| s + f64::from(a - b).powi(2));
        sum.sqrt() / problem.scale()
    }

    /// Takes a candidate and returns the relative change, or keeps the old estimate and returns nothing if it diverged.
    fn advance(
        &mut self,
        problem: &Problem<'_>,
        candidate: ArrayView3<'_, f32>,
        rgb: Option<ArrayView4<'_, f32>>,
        diverged_above: f64,
    ) -> Option<f64> {
        let residual = self.residual_of(problem, Some(candidate));
        // A NaN anywhere in a measured pixel makes the residual NaN; the norm below catches the unmeasured ones.
        if !(residual <= diverged_above) {
            return None;
        }
        let norms = norms(candidate, self.estimate.view());
        if !norms.1.is_finite() || rgb.is_some_and(|rgb| !rgb.iter().all(|v| v.is_finite())) {
            return None;
        }
        copy_frames(candidate, self.estimate.view_mut());
        match (&mut self.rgb, rgb) {
            (Some(kept), Some(rgb)) => kept.assign(&rgb),
            (kept, rgb) => *kept = rgb.map(|rgb| rgb.to_owned()),
        }
        self.relative_residual = residual;
        let (change, norm) = norms;
        Some(if norm > 0.0 { (change / norm).sqrt() } else { change.sqrt() })
    }
}

/// `(‖new − old‖², ‖new‖²)`, each frame summed on its own and the frames in order, so that threads do not change the result.
fn norms(new: ArrayView3<'_, f32>, old: ArrayView3<'_, f32>) -> (f64, f64) {
    let frames: Vec<(f64, f64)> = new
        .axis_iter(Axis(0))
        .into_par_iter()
        .zip(old.axis_iter(Axis(0)))
        .map(|(new, old)| {
            new.outer_iter().zip(old.outer_iter()).fold((0.0, 0.0), |(change, norm), (new, old)| {
                let (c, n) = match (new.as_slice(), old.as_slice()) {
                    (Some(new), Some(old)) => row_norms(new, old),
                    _ => row_norms(&new.to_vec(), &old.to_vec()),
                };
                (change + f64::from(c), norm + f64::from(n))
            })
        })
        .collect();
    frames.iter().fold((0.0, 0.0), |(a, b), (c, n)| (a + c, b + n))
}

/// The sums of one row, over 16 lanes in `f32`.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn row_norms(new: &[f32], old: &[f32]) -> (f32, f32) {
    let (mut change, mut norm) = ([0f32; 16], [0f32; 16]);
    let (new_chunks, new_rest) = new.as_chunks::<16>();
    let (old_chunks, old_rest) = old.as_chunks::<16>();
    for (new, old) in new_chunks.iter().zip(old_chunks) {
        for lane in 0..16 {
            let d = new[lane] - old[lane];
            change[lane] += d * d;
            norm[lane] += new[lane] * new[lane];
        }
    }
    for (lane, (new, old)) in new_rest.iter().zip(old_rest).enumerate() {
        let d = new - old;
        change[lane] += d * d;
        norm[lane] += new * new;
    }
    (change.iter().sum(), norm.iter().sum())
}

fn copy_frames(from: ArrayView3<'_, f32>, mut to: ArrayViewMut3<'_, f32>) {
    to.axis_iter_mut(Axis(0)).into_par_iter().zip(from.axis_iter(Axis(0))).for_each(|(mut to, from)| to.assign(&from));
}

/// A clock that stands still while observers work.
struct Stopwatch {
    running_since: Option<Instant>,
    before: Duration,
}

impl Stopwatch {
    fn start() -> Self {
        Self { running_since: Some(Instant::now()), before: Duration::ZERO }
    }
    fn pause(&mut self) {
        self.before = self.elapsed();
        self.running_since = None;
    }
    fn resume(&mut self) {
        self.running_since = Some(Instant::now());
    }
    fn elapsed(&self) -> Duration {
        self.before + self.running_since.map_or(Duration::ZERO, |since| since.elapsed())
    }
}
