//! The measurements of a scene in order.

use crate::reuse::continuation;
use crate::{AdaptiveDenoiser, Error, Relation, Result, Reuse, Similarity, Update};
use admm::{Denoiser, Outcome, Plan, SolveError, Start, StopReason};
use ndarray::{Array3, ArrayView3};
use nets::Network;
use sci_forward::Measurement;

/// How a sequence is solved.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SequenceConfig {
    /// What the next measurement takes over.
    pub reuse: Reuse,
    /// When a previous result is good for what.
    pub similarity: Similarity,
    /// The share of the iterations that is left, the last ones of the schedule, when the scene barely changed; in `(0, 1]`.
    pub effort: f64,
}

impl Default for SequenceConfig {
    fn default() -> Self {
        Self { reuse: Reuse::Reset, similarity: Similarity::default(), effort: 0.5 }
    }
}

/// A measurement to be solved, with what is known from those before.
#[derive(Debug)]
pub struct Task {
    /// Its number, from 0.
    pub index: usize,
    /// The measurement.
    pub measurement: Measurement,
    /// How it relates to the previous result, if there is one and it may be used.
    pub relation: Option<Relation>,
    /// Whether the scene was cut before it.
    pub cut: bool,
    /// The share of the iterations that it needs, in `(0, 1]`.
    pub effort: f64,
    /// Whether denoisers begin with their pretrained weights: under [`Reuse::Reset`] and after a cut.
    pub fresh: bool,
    warm: Option<Array3<f32>>,
}

impl Task {
    /// The previous result where that is better, else the normal start.
    pub fn start<'a>(&'a self, normal: Start<'a>) -> Start<'a> {
        self.warm.as_ref().map_or(normal, |video| Start::From(video.view()))
    }

    /// Whether [`Task::start`] is the previous result.
    pub fn is_warm(&self) -> bool {
        self.warm.is_some()
    }

    /// The last `effort · iterations` iterations of a plan, rounded up: the first ones only find what is known already.
    /// Stages keep their numbers; those that are not needed have no iterations.
    pub fn plan(&self, plan: &Plan) -> Plan {
        let mut left = (self.effort * plan.iterations() as f64).ceil() as usize;
        let mut plan = plan.clone();
        for stage in plan.stages.iter_mut().rev() {
            stage.iterations = stage.iterations.min(left);
            left -= stage.iterations;
        }
        plan
    }

    /// Turns a denoiser to this measurement, with the weights that it is to begin with.
    ///
    /// # Errors
    /// As [`AdaptiveDenoiser::begin_measurement`].
    pub fn prepare<N: Network + Denoiser>(&self, denoiser: &mut AdaptiveDenoiser<N>) -> Result<()> {
        if self.fresh {
            denoiser.reset()?;
        }
        denoiser.begin_measurement(&self.measurement)
    }
}

/// What a sequence has seen so far. For a caller with a loop of its own; [`run_sequence`] is that loop.
#[derive(Debug)]
pub struct Sequence {
    config: SequenceConfig,
    previous: Option<Array3<f32>>,
    index: usize,
    /// Whether what was learned and found before is of no use.
    forgotten: bool,
}

impl Sequence {
    /// At the beginning.
    ///
    /// # Errors
    /// [`Error::Setting`].
    pub fn new(config: SequenceConfig) -> Result<Self> {
        if !(config.effort > 0.0 && config.effort <= 1.0) {
            let legal = "greater than 0 and at most 1";
            return Err(Error::Setting { key: "effort", value: config.effort.to_string(), legal });
        }
        let Similarity { unchanged, warm, cut } = config.similarity;
        if !(0.0 <= unchanged && unchanged <= warm && cut >= 0.0) {
            let (key, value) = ("unchanged, warm, cut", format!("{unchanged}, {warm}, {cut}"));
            return Err(Error::Setting { key, value, legal: "0 ≤ unchanged ≤ warm, and cut at least 0" });
        }
        Ok(Self { config, previous: None, index: 0, forgotten: false })
    }

    /// What is to be done with the next measurement; [`Task::prepare`] readies each denoiser for it.
    pub fn begin(&mut self, measurement: Measurement) -> Task {
        let (index, similarity) = (self.index, self.config.similarity);
        self.index += 1;
        let usable =
            |video: &Array3<f32>| video.dim() == measurement.shape().dim() && video.iter().all(|v| v.is_finite());
        let previous = self.previous.take().filter(|_| self.config.reuse == Reuse::CarryOver).filter(usable);
        let known = previous.map(|video| continuation(video.view(), &measurement));
        let relation = known.as_ref().map(|(_, relation)| *relation);
        let cut = relation.is_some_and(|relation| relation.of_scene() > similarity.cut);
        let within = |limit: f64| !cut && relation.is_some_and(|relation| relation.of_start() <= limit);
        let fresh = std::mem::take(&mut self.forgotten) || cut || self.config.reuse == Reuse::Reset;
        let effort = if within(similarity.unchanged) { self.config.effort } else { 1.0 };
        let warm = known.filter(|_| within(similarity.warm)).map(|(video, _)| video);
        Task { index, measurement, relation, cut, effort, fresh, warm }
    }

    /// Hands in the result at the sensor, `[T, H, W]`, of the measurement that was begun last.
    pub fn finish(&mut self, estimate: ArrayView3<'_, f32>) {
        self.previous = Some(estimate.to_owned());
    }

    /// Instead of [`Sequence::finish`], of one that diverged: the next begins with nothing of it, and with the weights that networks had at first.
    pub fn forget(&mut self) {
        self.forgotten = true;
    }
}

/// A measurement of a sequence, solved.
#[derive(Debug)]
pub struct Solved {
    /// The result.
    pub outcome: Outcome,
    /// How the measurement related to the result before.
    pub relation: Option<Relation>,
    /// Whether it was solved from the result before.
    pub warm: bool,
    /// Whether the scene was cut before it.
    pub cut: bool,
    /// The updates that were due.
    pub updates: Vec<Update>,
}

/// Solves the measurements of a scene in order. `solve` runs a solver with the denoiser on [`Task::measurement`], from
/// [`Task::start`], by [`Task::plan`]; under [`Reuse::Reset`] each result is that of the measurement alone.
///
/// # Errors
/// [`Error::Solve`] for what `solve` reports, [`Error::Channels`].
pub fn run_sequence<N: Network + Denoiser>(
    denoiser: &mut AdaptiveDenoiser<N>,
    measurements: impl IntoIterator<Item = Measurement>,
    config: SequenceConfig,
    mut solve: impl FnMut(&mut AdaptiveDenoiser<N>, &Task) -> std::result::Result<Outcome, SolveError>,
) -> Result<Vec<Solved>> {
    let mut sequence = Sequence::new(config)?;
    let mut solved = Vec::new();
    for measurement in measurements {
        let task = sequence.begin(measurement);
        task.prepare(denoiser)?;
        let before = denoiser.updates().len();
        let outcome =
            solve(denoiser, &task).map_err(|source| Error::Solve { index: task.index, source: Box::new(source) })?;
        match outcome.stop {
            StopReason::Diverged => sequence.forget(),
            _ => sequence.finish(outcome.estimate.sensor.view()),
        }
        let updates = denoiser.updates()[before..].to_vec();
        solved.push(Solved { outcome, relation: task.relation, warm: task.is_warm(), cut: task.cut, updates });
    }
    Ok(solved)
}
