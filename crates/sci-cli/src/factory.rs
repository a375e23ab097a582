//! Owns the step from a resolved experiment to objects that run: networks loaded once, solvers built for each measurement.

use std::cell::Cell;
use std::rc::Rc;
use std::time::Duration;

use admm::{
    Admm, BoxError, DenoiseCx, Denoiser, Gap, MomentumStart, Observer, Outcome, PerStage, Plan, Problem, SolveError,
    Start, StopRule, Tv,
};
use anyhow::Context;
use ndarray::{ArrayView3, ArrayView4, ArrayViewMut4};

use crate::config::check::{Momentum, Solver, Start as StartChoice};
use crate::config::resolve::{Denoiser as DenoiserChoice, Experiment};

/// Builds the solvers of one experiment.
pub struct Factory<'e> {
    experiment: &'e Experiment,
    parts: Vec<Part>,
    plan: Plan,
}

/// A denoiser as far as it can be shared by all measurements.
enum Part {
    /// Built anew for each measurement, as it may carry state from call to call.
    Tv { weight: f32, inner: usize },
    /// Loaded once.
    Ffdnet(nets::Ffdnet),
}

impl<'e> Factory<'e> {
    /// Loads what the experiment names.
    ///
    /// # Errors
    /// A weight file that cannot be read or does not fit its network.
    pub fn new(experiment: &'e Experiment) -> anyhow::Result<Self> {
        let parts = experiment.denoisers.iter().map(load).collect::<anyhow::Result<_>>()?;
        let stages: Vec<admm::Stage> =
            experiment.stages.iter().map(|s| admm::Stage { sigma: s.sigma, iterations: s.iterations }).collect();
        let mut plan = Plan::new(stages);
        plan.stop = StopRule {
            relative_change: experiment.relative_change,
            time: experiment.seconds.map(Duration::from_secs_f64),
            ..StopRule::default()
        };
        Ok(Self { experiment, parts, plan })
    }

    /// The stages and the stop rule.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Solves one measurement; `previous` is the result of the one before.
    ///
    /// # Errors
    /// What [`admm::run`] reports.
    pub fn solve(
        &mut self,
        problem: &Problem<'_>,
        previous: Option<ArrayView3<'_, f32>>,
        observer: &mut dyn Observer,
    ) -> Result<Solved, SolveError> {
        let calls = Rc::new(Cell::new(0));
        let of_stage = self.experiment.stages.iter().map(|s| s.denoiser).collect();
        let denoisers = self.parts.iter_mut().map(|p| p.denoiser()).collect();
        let denoiser = Counted { inner: PerStage::new(denoisers, of_stage), calls: Rc::clone(&calls) };
        let start = start(self.experiment.start, previous);
        let mut solved = match self.experiment.solver {
            Solver::Gap { momentum } => {
                let mut gap = match momentum {
                    None => Gap::plain(denoiser),
                    Some(Momentum::Zero) => Gap::with_momentum(denoiser, MomentumStart::Zero),
                    Some(Momentum::Measurement) => Gap::with_momentum(denoiser, MomentumStart::Measurement),
                };
                without_state(admm::run(&mut gap, problem, start, &self.plan, observer)?)
            }
            Solver::Admm { gamma } => {
                let mut solver = Admm::new(denoiser, gamma);
                without_state(admm::run(&mut solver, problem, start, &self.plan, observer)?)
            }
        };
        solved.denoiser_calls = calls.get();
        Ok(solved)
    }
}

/// The outcome of one measurement, whatever the solver.
#[derive(Debug)]
pub struct Solved {
    /// The result; its state is dropped.
    pub outcome: Outcome<()>,
    /// Calls of the denoiser.
    pub denoiser_calls: usize,
}

fn without_state<S>(o: Outcome<S>) -> Solved {
    let Outcome { estimate, rgb, stop, iterations, seconds, relative_residual, .. } = o;
    let outcome = Outcome { state: (), estimate, rgb, stop, iterations, seconds, relative_residual };
    Solved { outcome, denoiser_calls: 0 }
}

fn start<'a>(choice: StartChoice, previous: Option<ArrayView3<'a, f32>>) -> Start<'a> {
    match (choice, previous) {
        (StartChoice::Adjoint, _) => Start::Adjoint,
        (StartChoice::Tv { iterations, weight }, _) => Start::Tv { iterations, weight },
        (StartChoice::Previous, Some(x)) => Start::From(x),
        (StartChoice::Mean | StartChoice::Previous, _) => Start::Mean,
    }
}

fn load(choice: &DenoiserChoice) -> anyhow::Result<Part> {
    Ok(match choice {
        DenoiserChoice::Tv { weight, inner } => {
            Part::Tv { weight: *weight, inner: *inner }
        }
        DenoiserChoice::Ffdnet { weights } => {
            let net = nets::Ffdnet::load(weights).context("denoiser.weights")?;
            let channels = net.spec().channels;
            anyhow::ensure!(
                channels == 1,
                "denoiser.weights: {}: a network for {channels} channels, but the scene is gray: it needs one for 1",
                weights.display()
            );
            Part::Ffdnet(net)
        }
    })
}

impl Part {
    fn denoiser(&mut self) -> Box<dyn Denoiser + '_> {
        match self {
            Self::Tv { weight, inner } => Box::new(Tv::new(*weight).inner(*inner)),
            Self::Ffdnet(net) => Box::new(net),
        }
    }
}

/// Counts calls for the run record.
struct Counted<D> {
    inner: D,
    calls: Rc<Cell<usize>>,
}

impl<D: Denoiser> Denoiser for Counted<D> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn denoise(
        &mut self,
        cx: &DenoiseCx,
        noisy: ArrayView4<'_, f32>,
        out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        self.calls.set(self.calls.get() + 1);
        self.inner.denoise(cx, noisy, out)
    }
}
