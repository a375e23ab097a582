//! The one loop that drives every solver.

use crate::guard::Guard;
use crate::held_out::{Best, HeldOut, Judge, Verdict};
use crate::{BoxError, DenoiseCx, IterInfo, Observer, Plan, Problem, Start};
use ndarray::{Array3, Array4, ArrayView3, ArrayView4};
use sci_forward::Progress;
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
    /// Stages did nothing for the held-out pixels any more ([`HoldOut`](crate::HoldOut)).
    Stalled,
    /// A value was not finite, the residual exploded, or what came out cannot be a scene: it explains the measurement worse than
    /// a black video, or is far brighter than it. The outcome holds the iterate that explains the measurement best.
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

    /// One iteration. Returns how far the new estimate is from the measurement and from the estimate before.
    ///
    /// # Errors
    /// What the denoiser reports.
    fn step(&mut self, problem: &Problem<'_>, cx: &DenoiseCx, state: &mut Self::State) -> Result<Progress, BoxError>;

    /// The estimate where the sensor sees it: gray or mosaic video `[T, H, W]`.
    fn estimate<'s>(&self, state: &'s Self::State) -> ArrayView3<'s, f32>;

    /// The estimate of the iteration before (of the start, after the first), `[T, H, W]`.
    fn previous<'s>(&self, state: &'s Self::State) -> ArrayView3<'s, f32>;

    /// The RGB estimate `[T, 3, H, W]` of a color solver, after a step.
    fn rgb<'s>(&'s self, _state: &'s Self::State) -> Option<ArrayView4<'s, f32>> {
        None
    }

    /// After a divergence: makes the state ready to go on from `good`, the best iterate so far, with more caution, and says
    /// what was given up; nothing if there is no more cautious way.
    fn back_off(&self, _problem: &Problem<'_>, _state: &mut Self::State, _good: Array3<f32>) -> Option<&'static str> {
        None
    }
}

/// A divergence that a solver went on after.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BackOff {
    /// The iteration that diverged, counted from 0.
    pub iteration: usize,
    /// What the solver did without from then on.
    pub without: &'static str,
}

/// The result of [`run`].
#[derive(Debug)]
pub struct Outcome<S> {
    /// The last state of the solver (after a divergence, the diverged one).
    pub state: S,
    /// The estimate `[T, H, W]`, always finite: with held-out pixels the best one, else after a divergence the one that
    /// explains the measurement best.
    pub estimate: Array3<f32>,
    /// The RGB estimate `[T, 3, H, W]` of a color solver that belongs to `estimate`; nothing after a divergence.
    pub rgb: Option<Array4<f32>>,
    /// Why the run ended.
    pub stop: StopReason,
    /// The divergence that it went on after, if there was one.
    pub backed_off: Option<BackOff>,
    /// Iterations done, diverged ones included.
    pub iterations: usize,
    /// Seconds of solving, the start included, observers not.
    pub seconds: f64,
    /// `‖y − H x‖ / ‖y‖` of `estimate`.
    pub relative_residual: f64,
}

impl<S> Outcome<S> {
    /// The same for every solver.
    pub fn without_state(self) -> Outcome<()> {
        let Self { estimate, rgb, stop, backed_off, iterations, seconds, relative_residual, .. } = self;
        Outcome { state: (), estimate, rgb, stop, backed_off, iterations, seconds, relative_residual }
    }
}

/// Runs `solver` on `problem` from `start` through the stages of `plan`. After a first divergence it goes on from the best
/// iterate if the solver knows a more cautious way ([`Solver::back_off`]).
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
    let held_out = plan.hold_out.as_ref().and_then(|config| HeldOut::new(problem.reborrow(), config));
    let given = match &held_out {
        Some(pixels) => pixels.problem()?,
        None => problem.reborrow(),
    };
    let start = start.video(&given)?;
    let mut judge =
        held_out.as_ref().zip(plan.hold_out).map(|(pixels, config)| Judge::new(pixels, config, start.view()));
    let mut relative_residual = relative(given.operator().progress(given.y(), start.view(), start.view()), &given).0;
    let mut guard = Guard::new(&given, relative_residual, plan.stop.diverged_above);
    let mut state = solver.init(&given, start);
    clock.pause();
    observer.begin(plan).map_err(|source| SolveError::Observer { iteration: 0, source })?;

    let mut iterations = 0;
    let mut spare = 0;
    let mut stop = StopReason::ScheduleDone;
    let mut backed_off = None;
    let mut last = Progress::default();
    'stages: for (stage, &crate::Stage { sigma, iterations: count }) in plan.stages.iter().enumerate() {
        // What stages of a denoiser with a σ leave over is for those after them.
        let count = count + if sigma > 0.0 { std::mem::take(&mut spare) } else { 0 };
        if stage + 1 < plan.stages.len() && judge.as_ref().is_some_and(|judge| judge.skips(sigma)) {
            spare += count;
            continue;
        }
        for left in (0..count).rev() {
            clock.resume();
            let iteration = iterations;
            let tolerance = judge.as_ref().map_or(0.0, |judge| judge.tolerance());
            let cx = DenoiseCx { sigma, iteration, stage, tolerance };
            let progress = solver.step(&given, &cx, &mut state).map_err(|source| {
                let name = solver.denoiser_name().to_owned();
                SolveError::Denoiser { name, iteration, source }
            })?;
            iterations += 1;
            let estimate = solver.estimate(&state);
            let rgb = solver.rgb(&state);
            let rgb_is_finite = rgb.is_none_or(|rgb| rgb.iter().all(|v| v.is_finite()));
            let (residual, relative_change) = relative(progress, &given);
            if !rgb_is_finite || !guard.admit(residual, relative_change, solver.previous(&state)) {
                let (good, good_residual) = guard.best(solver.previous(&state));
                let without = backed_off.is_none().then(|| solver.back_off(&given, &mut state, good)).flatten();
                backed_off = backed_off.or(without.map(|without| BackOff { iteration, without }));
                if without.is_some() {
                    relative_residual = good_residual;
                    clock.pause();
                    continue;
                }
                stop = StopReason::Diverged;
                break 'stages;
            }
            (relative_residual, last) = (residual, progress);
            let judged = judge.as_mut().map(|judge| judge.judge(estimate, rgb, left == 0));
            clock.pause();

            let (predicted_error, verdict) = judged.unzip();
            let seconds = clock.elapsed().as_secs_f64();
            let info = IterInfo {
                iteration,
                stage,
                sigma,
                estimate,
                rgb,
                relative_residual,
                relative_change,
                predicted_error,
                seconds,
            };
            stop = match observer.iteration(&info).map_err(|source| SolveError::Observer { iteration, source })? {
                ControlFlow::Break(()) => StopReason::Observer,
                _ if verdict == Some(Verdict::Stop) => StopReason::Stalled,
                _ if relative_change < plan.stop.relative_change => StopReason::Converged,
                _ if plan.stop.time.is_some_and(|limit| clock.elapsed() >= limit) => StopReason::TimeUp,
                _ if verdict == Some(Verdict::EndStage) => {
                    spare += if sigma > 0.0 { left } else { 0 };
                    break;
                }
                _ => continue,
            };
            break 'stages;
        }
    }
    clock.resume();
    let chosen = match judge.and_then(Judge::into_best) {
        Some(best) => best_held_out(best, problem, &guard, stop),
        None => last_good(solver, &state, &guard, (stop, relative_residual, last)),
    };
    let Chosen { estimate, rgb, stop, relative_residual } = chosen;
    let seconds = clock.elapsed().as_secs_f64();
    Ok(Outcome { state, estimate, rgb, stop, backed_off, iterations, seconds, relative_residual })
}

/// What a run returns of its iterates, and how it ended after all.
struct Chosen {
    estimate: Array3<f32>,
    rgb: Option<Array4<f32>>,
    stop: StopReason,
    relative_residual: f64,
}

/// The iterate that predicts the held-out pixels best; it must explain the whole measurement.
fn best_held_out(best: Best, problem: &Problem<'_>, guard: &Guard, stop: StopReason) -> Chosen {
    let Best { estimate, rgb, .. } = best;
    let progress = problem.operator().progress(problem.y(), estimate.view(), estimate.view());
    let relative_residual = relative(progress, problem).0;
    let stop = if guard.is_result(relative_residual, progress) { stop } else { StopReason::Diverged };
    Chosen { estimate, rgb, stop, relative_residual }
}

/// The last iterate; after a divergence, or when a run that ended by itself has no result, the one that explains the
/// measurement best.
fn last_good<S: Solver>(
    solver: &S,
    state: &S::State,
    guard: &Guard,
    (stop, relative_residual, last): (StopReason, f64, Progress),
) -> Chosen {
    let ended = matches!(stop, StopReason::ScheduleDone | StopReason::Converged);
    let or = match stop {
        StopReason::Diverged => Some(solver.previous(state)),
        _ if ended && !guard.is_result(relative_residual, last) => Some(solver.estimate(state)),
        _ => None,
    };
    match or {
        Some(or) => {
            let (estimate, relative_residual) = guard.best(or);
            Chosen { estimate, rgb: None, stop: StopReason::Diverged, relative_residual }
        }
        None => {
            let rgb = solver.rgb(state).map(|rgb| rgb.to_owned());
            Chosen { estimate: solver.estimate(state).to_owned(), rgb, stop, relative_residual }
        }
    }
}

/// `‖y − H x‖ / ‖y‖` and `‖x − previous‖ / ‖x‖`; a NaN or an infinity in `x` makes one of them not finite.
fn relative(progress: Progress, problem: &Problem<'_>) -> (f64, f64) {
    let change = progress.change.sqrt();
    let change = if progress.norm > 0.0 { change / progress.norm.sqrt() } else { change };
    // An infinite norm would hide behind a quotient of 0.
    (progress.residual.sqrt() / problem.scale(), if progress.norm.is_finite() { change } else { f64::NAN })
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
