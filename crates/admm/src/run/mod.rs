//! The one loop that drives every solver.

mod clock;
mod guard;
mod hold_out;
mod observer;
mod outcome;
mod plan;

pub use hold_out::HoldOut;
pub use observer::{IterInfo, Observer};
pub use outcome::{BackOff, Outcome, SolveError, StopReason};
pub use plan::{Plan, Stage, StopRule};

use crate::{BoxError, Call, Estimate, Progress, Solver, Start, WarmStart, progress};
use clock::Clock;
use guard::Guard;
use hold_out::{HeldOut, Judge, Verdict};
use sci_forward::Measurement;
use std::ops::ControlFlow;

/// Runs `solver` on `measurement` from `start` through the stages of `plan`. After a first divergence it goes on from the best
/// iterate if the solver knows a more cautious way ([`Solver::back_off`]).
///
/// # Errors
/// [`SolveError`] for a bad start or plan, or what the prior or the observer reports. Divergence is an outcome, not an error.
pub fn run(
    solver: &mut dyn Solver,
    measurement: &Measurement,
    start: Start<'_>,
    plan: &Plan,
    observer: &mut dyn Observer,
) -> Result<Outcome, SolveError> {
    plan.hold_out.as_ref().map_or(Ok(()), HoldOut::validate)?;
    let mut clock = Clock::start();
    let held_out = plan.hold_out.as_ref().and_then(|config| HeldOut::new(measurement, config));
    let given = held_out.as_ref().map_or(measurement, HeldOut::given);
    let mut from = start.estimate(given)?;
    clock.pause();
    observer.begin(plan).map_err(|source| SolveError::Observer { iteration: 0, source })?;
    clock.resume();

    if let Start::Warm { prior, stage } = start {
        let mut warm = Loop::new(given, plan.stop, &mut clock, None, from);
        let stop = warm.run(&mut WarmStart::new(prior), &[stage], &mut |it| observer.warm_start(it))?;
        if matches!(stop, StopReason::TimeUp | StopReason::Observer) {
            let warm_only = warm.finish(measurement, stop);
            return Ok(Outcome { iterations: 0, ..warm_only });
        }
        from = warm.current;
    }
    let judge = held_out.as_ref().zip(plan.hold_out).map(|(pixels, config)| Judge::new(pixels, config, &from));
    let mut main = Loop::new(given, plan.stop, &mut clock, judge, from);
    let stop = main.run(solver, &plan.stages, &mut |it| observer.iteration(it))?;
    Ok(main.finish(measurement, stop))
}

/// What is told of each iteration.
type Observe<'o> = dyn FnMut(&IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> + 'o;

/// The state of the loop.
struct Loop<'r> {
    measurement: &'r Measurement,
    stop: StopRule,
    clock: &'r mut Clock,
    guard: Guard,
    judge: Option<Judge<'r>>,
    /// The last iterate that was not found to have diverged, and the memory for the next.
    current: Estimate,
    next: Estimate,
    /// Of `current`.
    progress: Progress,
    relative_residual: f64,
    iterations: usize,
    backed_off: Option<BackOff>,
}

/// What comes after an iteration.
enum Look {
    GoOn,
    EndStage,
    Stop(StopReason),
}

/// How a stage ended.
enum StageEnd {
    /// With so many iterations left over.
    Done { left: usize },
    /// And the run with it.
    Stop(StopReason),
}

impl<'r> Loop<'r> {
    fn new(
        measurement: &'r Measurement,
        stop: StopRule,
        clock: &'r mut Clock,
        judge: Option<Judge<'r>>,
        from: Estimate,
    ) -> Self {
        let progress = progress(measurement, from.sensor.view(), from.sensor.view());
        let relative_residual = relative(progress, measurement).0;
        Self {
            measurement,
            stop,
            clock,
            guard: Guard::new(measurement, relative_residual, stop.diverged_above),
            judge,
            next: Estimate::zeros(measurement.shape()),
            current: from,
            progress,
            relative_residual,
            iterations: 0,
            backed_off: None,
        }
    }

    fn run(
        &mut self,
        solver: &mut dyn Solver,
        stages: &[Stage],
        observe: &mut Observe<'_>,
    ) -> Result<StopReason, SolveError> {
        solver.start(self.measurement, &self.current);
        let mut spare = 0;
        for (index, stage) in stages.iter().enumerate() {
            // What stages with a σ leave over is for those after them.
            let borrowed = if stage.sigma.is_some() { std::mem::take(&mut spare) } else { 0 };
            let stage = Stage { iterations: stage.iterations + borrowed, ..*stage };
            let skipped = self.judge.as_ref().is_some_and(|judge| judge.skips(stage.sigma));
            let left = match skipped && index + 1 < stages.len() {
                true => stage.iterations,
                false => match self.stage(solver, index, stage, observe)? {
                    StageEnd::Done { left } => left,
                    StageEnd::Stop(reason) => return Ok(reason),
                },
            };
            spare += if stage.sigma.is_some() { left } else { 0 };
        }
        Ok(StopReason::ScheduleDone)
    }

    fn stage(
        &mut self,
        solver: &mut dyn Solver,
        index: usize,
        stage: Stage,
        observe: &mut Observe<'_>,
    ) -> Result<StageEnd, SolveError> {
        for left in (0..stage.iterations).rev() {
            self.clock.resume();
            let call = Call {
                sigma: stage.sigma,
                iteration: self.iterations,
                stage: index,
                tolerance: self.judge.as_ref().map_or(0.0, Judge::tolerance),
                measurement: Some(self.measurement),
            };
            let Some(relative_change) = self.step(solver, &call)? else {
                if self.back_off(solver, call.iteration) {
                    continue;
                }
                return Ok(StageEnd::Stop(StopReason::Diverged));
            };
            match self.look(&call, relative_change, left == 0, observe)? {
                Look::GoOn => {}
                Look::EndStage => return Ok(StageEnd::Done { left }),
                Look::Stop(reason) => return Ok(StageEnd::Stop(reason)),
            }
        }
        Ok(StageEnd::Done { left: 0 })
    }

    /// After an iteration: what the held-out pixels, the observer and the stop rule say of it.
    fn look(
        &mut self,
        call: &Call<'_>,
        relative_change: f64,
        last_of_stage: bool,
        observe: &mut Observe<'_>,
    ) -> Result<Look, SolveError> {
        let judged = self.judge.as_mut().map(|judge| judge.judge(&self.current, last_of_stage));
        let (predicted_error, verdict) = judged.unzip();
        let time = self.clock.pause();
        let iteration = call.iteration;
        let info = IterInfo {
            iteration,
            stage: call.stage,
            sigma: call.sigma,
            estimate: &self.current,
            relative_residual: self.relative_residual,
            relative_change,
            predicted_error,
            seconds: time.as_secs_f64(),
        };
        let observed = observe(&info).map_err(|source| SolveError::Observer { iteration, source })?;
        Ok(match (observed, verdict) {
            (ControlFlow::Break(()), _) => Look::Stop(StopReason::Observer),
            (_, Some(Verdict::Stop)) => Look::Stop(StopReason::Stalled),
            _ if relative_change < self.stop.relative_change => Look::Stop(StopReason::Converged),
            _ if self.stop.time.is_some_and(|limit| time >= limit) => Look::Stop(StopReason::TimeUp),
            (_, Some(Verdict::EndStage)) => Look::EndStage,
            _ => Look::GoOn,
        })
    }

    /// One iteration; returns the relative change. Nothing if what came out has diverged: `current` is then as it was.
    fn step(&mut self, solver: &mut dyn Solver, call: &Call<'_>) -> Result<Option<f64>, SolveError> {
        let step = solver.step(self.measurement, call, &self.current, &mut self.next);
        let progress = step.map_err(|e| SolveError::Prior {
            part: e.part,
            name: e.name,
            iteration: call.iteration,
            source: e.source,
        })?;
        self.iterations += 1;
        let (residual, change) = relative(progress, self.measurement);
        // The norms speak of the sensor's video only.
        let finite = self.next.rgb.is_none() || self.next.is_finite();
        if !finite || !self.guard.admit(residual, change, &self.current) {
            return Ok(None);
        }
        std::mem::swap(&mut self.current, &mut self.next);
        (self.progress, self.relative_residual) = (progress, residual);
        Ok(Some(change))
    }

    /// After a divergence: whether the solver goes on, from the best iterate. It may once.
    fn back_off(&mut self, solver: &mut dyn Solver, iteration: usize) -> bool {
        self.relative_residual = self.guard.restore_best(&mut self.current);
        self.progress = progress(self.measurement, self.current.sensor.view(), self.current.sensor.view());
        if self.backed_off.is_some() {
            return false;
        }
        let without = solver.back_off(self.measurement, &self.current);
        self.backed_off = without.map(|without| BackOff { iteration, without });
        without.is_some()
    }

    /// The result: the iterate that predicts the held-out pixels best, which must explain the `whole` measurement, else the last; after
    /// a divergence, or when a run that ended by itself has no result, the one that explains the measurement best.
    fn finish(mut self, whole: &Measurement, mut stop: StopReason) -> Outcome {
        self.clock.resume();
        let ended = matches!(stop, StopReason::ScheduleDone | StopReason::Converged);
        if let Some(best) = self.judge.take().and_then(Judge::into_best) {
            let progress = progress(whole, best.sensor.view(), best.sensor.view());
            let residual = relative(progress, whole).0;
            if self.guard.is_result(residual, progress) {
                (self.current, self.relative_residual) = (best, residual);
            } else {
                self.relative_residual = self.guard.restore_best(&mut self.current);
                stop = StopReason::Diverged;
            }
        } else if ended && !self.guard.is_result(self.relative_residual, self.progress) {
            self.relative_residual = self.guard.restore_best(&mut self.current);
            stop = StopReason::Diverged;
        }
        Outcome {
            estimate: self.current,
            stop,
            backed_off: self.backed_off,
            iterations: self.iterations,
            seconds: self.clock.elapsed().as_secs_f64(),
            relative_residual: self.relative_residual,
        }
    }
}

/// `‖y − H x‖ / ‖y‖` and `‖x − previous‖ / ‖x‖`; a NaN or an infinity in `x` makes one of them not finite.
fn relative(progress: Progress, measurement: &Measurement) -> (f64, f64) {
    let change = progress.change.sqrt();
    let change = if progress.norm > 0.0 { change / progress.norm.sqrt() } else { change };
    // An infinite norm would hide behind a quotient of 0.
    (progress.residual.sqrt() / measurement.scale(), if progress.norm.is_finite() { change } else { f64::NAN })
}
