//! Owns the step from an experiment to objects that run: networks loaded once, solvers built for each measurement.

use std::ops::ControlFlow;
use std::path::Path;
use std::time::{Duration, Instant};

use admm::{Observer, Outcome, Plan, Prior, Start, StopRule, Tv};
use ndarray::ArrayView3;
use nets::kernels::{Isa, Precision, release_freed_memory};
use online::{Reuse, Sequence, SplitRecord, Successor, Task, Update, UpdateCounts};
use sci_forward::{CfaPattern, Measurement};

use crate::config::{Experiment, Stage};
use crate::io::scene::Scene;
use crate::parts::{Built, Learning, MultiplyAdds, Saving, Sensor, Site, Work};
use crate::record::{Adaptation, MeasurementRecord, Stop, host};
use crate::solvers::{self, Priors};

/// Builds the solvers of one experiment.
pub struct Factory<'e> {
    experiment: &'e Experiment,
    parts: Vec<Box<dyn Built>>,
    color: Option<Sensor>,
    plan: Plan,
    sequence: Option<Sequence>,
    multiply_adds: MultiplyAdds,
    /// Whether solves do without the network that takes over from the one that learned.
    ends_early: bool,
}

impl<'e> Factory<'e> {
    /// Loads what the experiment names, for scenes of a sensor with the pattern `cfa`, `None` for a gray one.
    ///
    /// # Errors
    /// A weight file that cannot be read or does not fit its network; a gray network or solver for a color scene, or the
    /// reverse.
    pub fn new(experiment: &'e Experiment, cfa: Option<CfaPattern>) -> anyhow::Result<Self> {
        let solver = &experiment.solver;
        if cfa.is_none() {
            let gray = "the scene is gray; name its Bayer pattern in data.cfa if it is a mosaic";
            anyhow::ensure!(
                !solver.method.color_only(),
                "solver.kind = \"{}\" is for color sensors: {gray}",
                solver.kind
            );
            anyhow::ensure!(solver.demosaicer.is_none(), "solver.demosaicer has no effect: {gray}");
        }
        let multiply_adds = MultiplyAdds::default();
        let adapt = experiment.online.map(|o| o.adapt).unwrap_or_default();
        let site = Site { cfa, adapt, work: &multiply_adds };
        let parts = experiment.denoisers.iter().map(|d| d.part.build(&site)).collect::<anyhow::Result<_>>()?;
        let sensor = |cfa| Sensor::new(cfa, &solver.demosaicer(), multiply_adds.clone());
        let color = cfa.map(sensor).transpose()?;
        let stage = |s: &Stage| admm::Stage { sigma: s.sigma, iterations: s.iterations };
        let mut plan = Plan::new(experiment.stages.iter().map(stage).collect::<Vec<_>>());
        plan.stop = StopRule {
            relative_change: experiment.relative_change,
            time: experiment.seconds.map(Duration::from_secs_f64),
            ..StopRule::default()
        };
        plan.hold_out = experiment.judge;
        let sequence = experiment.online.map(|o| Sequence::new(o.sequence)).transpose()?;
        Ok(Self { experiment, parts, color, plan, sequence, multiply_adds, ends_early: false })
    }

    /// The stages and the stop rule.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Solves the first of the measurements `left`; `previous` is the result of the one before.
    ///
    /// # Errors
    /// What [`admm::run`] and the adaptation report.
    pub fn solve(
        &mut self,
        scene: &Scene,
        left: &[usize],
        previous: Option<ArrayView3<'_, f32>>,
        observer: &mut dyn Follow,
    ) -> anyhow::Result<Solved> {
        let measurement = scene.measurement(left[0])?;
        let task = self.begin(&measurement)?;
        let split = self.adapt_by_splitting(scene, left, task.as_ref(), observer)?;
        let done: Vec<usize> = self.learning().map(|(net, _)| net.updates().len()).collect();
        let plan = self.plan_as_learned();
        let plan = if let Some(task) = &task { task.plan(&plan) } else { plan };
        let mut warm = self.warm_start_prior();
        let normal = self.normal_start(&mut warm, previous);
        let start = match &task {
            Some(task) => task.start(normal),
            None => normal,
        };
        let (outcome, work) = self.run(&measurement, start, &plan, observer)?;
        if let Some(sequence) = &mut self.sequence {
            match outcome.stop {
                admm::StopReason::Diverged => sequence.forget(),
                _ => sequence.finish(outcome.estimate.sensor.view()),
            }
        }
        let new: Vec<Vec<Update>> =
            self.learning().zip(done).map(|((net, _), done)| net.updates()[done..].to_vec()).collect();
        let (updates_of, updates) = (new.iter().map(Vec::len).collect(), new.concat());
        let adaptation = task.map(|task| Adaptation {
            relation: task.relation,
            warm_start: task.is_warm(),
            cut: task.cut,
            counts: split.as_ref().map_or_else(|| UpdateCounts::of(&updates), counts_of),
            updates,
            updates_of,
            split,
        });
        Ok(Solved { outcome, planned: plan.iterations(), work, adaptation })
    }

    /// Solves the only measurement of a scene with networks as they are: a band beside one that they have learned from.
    ///
    /// # Errors
    /// What [`admm::run`] reports.
    pub fn solve_as_learned(&mut self, scene: &Scene, observer: &mut dyn Follow) -> anyhow::Result<Solved> {
        let (measurement, plan) = (scene.measurement(0)?, self.plan_as_learned());
        let mut warm = self.warm_start_prior();
        let start = self.normal_start(&mut warm, None);
        let (outcome, work) = self.run(&measurement, start, &plan, observer)?;
        Ok(Solved { outcome, planned: plan.iterations(), work, adaptation: None })
    }

    /// Where a solve begins of which nothing else is known.
    fn normal_start<'s>(
        &self,
        warm: &'s mut Option<Box<dyn Prior>>,
        previous: Option<ArrayView3<'s, f32>>,
    ) -> Start<'s> {
        match (self.experiment.solver.start, warm, previous) {
            (solvers::Start::Adjoint, ..) => Start::Adjoint,
            (solvers::Start::Tv { iterations, .. }, Some(prior), _) => {
                Start::Warm { prior: prior.as_mut(), stage: admm::Stage { sigma: None, iterations } }
            }
            (solvers::Start::Previous, _, Some(video)) => Start::From(video),
            _ => Start::Mean,
        }
    }

    /// What is known of a measurement from those before, where networks adapt; all of them turn to it.
    fn begin(&mut self, measurement: &Measurement) -> anyhow::Result<Option<Task>> {
        let Some(sequence) = &mut self.sequence else { return Ok(None) };
        let task = sequence.begin(measurement.clone());
        self.learning().try_for_each(|(net, _)| net.prepare(&task))?;
        Ok(Some(task))
    }

    /// Lets networks learn before the solve, where they are to: what is carried over from all measurements that are left, once.
    fn adapt_by_splitting(
        &mut self,
        scene: &Scene,
        left: &[usize],
        task: Option<&Task>,
        observer: &mut dyn Follow,
    ) -> anyhow::Result<Option<SplitRecord>> {
        let Some(recipe) = &self.experiment.recipe else { return Ok(None) };
        if !task.is_some_and(|task| task.fresh || task.index == 0) {
            return Ok(None);
        }
        let used = if self.carries_over() { left } else { &left[..1] };
        // What judges the solve is not learned from.
        let given = |measurement| match &self.plan.hold_out {
            Some(hold_out) => hold_out.given(&measurement),
            None => measurement,
        };
        let measurements =
            used.iter().map(|&k| Ok(given(scene.measurement(k)?))).collect::<anyhow::Result<Vec<_>>>()?;
        let mut watch = |updates| observer.adaptation(updates);
        let successor = self.experiment.successor.as_ref();
        let next = successor.and_then(|(index, recipe)| Some((self.parts[*index].network()?.boxed(), recipe)));
        let next = next.as_ref().map(|(network, recipe)| Successor { network: &**network, recipe });
        let first = self.learning().next();
        let record =
            first.map(|(net, _)| net.adapt_by_splitting(&measurements, recipe, next, &mut watch)).transpose()?;
        let record = record.flatten();
        self.ends_early = record.as_ref().is_some_and(|split| split.ends_early);
        // The solve is to have it: in bands of a large scene it needs all there is.
        release_freed_memory();
        Ok(record)
    }

    /// The plan, without the stages of a network that is better not to take over from the one that learned.
    fn plan_as_learned(&self) -> Plan {
        let (mut plan, denoisers) = (self.plan.clone(), &self.experiment.denoisers);
        // The first stages may be TV, which does not learn.
        let mut stages = plan.stages.iter_mut().zip(&self.experiment.stages);
        let learner = stages.find(|(_, own)| denoisers[own.denoiser].part.adapts()).map(|(_, own)| own.denoiser);
        for (stage, own) in stages {
            if self.ends_early && Some(own.denoiser) != learner {
                stage.iterations = 0;
            }
        }
        plan
    }

    /// The TV of a warm start, if the experiment begins with one.
    fn warm_start_prior(&self) -> Option<Box<dyn Prior>> {
        let solvers::Start::Tv { weight, .. } = self.experiment.solver.start else { return None };
        Some(Tv::new(weight).on_sensor(self.color.as_ref().map(|sensor| sensor.cfa)))
    }

    fn run(
        &mut self,
        measurement: &Measurement,
        start: Start<'_>,
        plan: &Plan,
        observer: &mut dyn Observer,
    ) -> anyhow::Result<(Outcome, Work)> {
        let begin = Instant::now();
        // A network that adapts is given everything in full: its updates look at the whole measurement.
        let skip = self.experiment.skip.filter(|_| self.experiment.online.is_none());
        let (tiles, half) = (skip.is_some_and(|s| s.tiles), skip.is_some_and(|s| s.half_precision));
        let mut saving = Saving::new(tiles, half, measurement, self.multiply_adds.clone());
        let looked = begin.elapsed().as_secs_f64();
        let mut solver = self.experiment.solver.method.build(Priors {
            built: &mut self.parts,
            of_stage: self.experiment.stages.iter().map(|s| s.denoiser).collect(),
            color: self.color.as_ref(),
            saving: &mut saving,
            skips: self.experiment.skip.is_some(),
        })?;
        let mut outcome = admm::run(solver.as_mut(), measurement, start, plan, observer)?;
        drop(solver);
        if let Some(sensor) = &self.color {
            sensor.complete(&mut outcome)?;
        }
        outcome.seconds += looked;
        Ok((outcome, saving.work()))
    }

    /// Whether a measurement can need what the sensor sees of the one before.
    pub fn needs_previous(&self) -> bool {
        self.experiment.solver.start == solvers::Start::Previous || self.carries_over()
    }

    /// Whether networks go from measurement to measurement as they are.
    fn carries_over(&self) -> bool {
        self.experiment.online.is_some_and(|o| o.sequence.reuse == Reuse::CarryOver)
    }

    /// Whether weights are to be kept with each measurement: for the next one, or to be saved with the last.
    pub fn needs_weights(&self) -> bool {
        self.carries_over() || self.experiment.online.is_some_and(|o| o.save)
    }

    /// The file of each learning network's weights, `adapted-N-KIND.safetensors`, N its place among the denoisers.
    pub fn weight_files(&self) -> Vec<String> {
        let networks = self.experiment.denoisers.iter().enumerate().filter(|(_, d)| d.part.adapts());
        networks.map(|(i, d)| format!("adapted-{i}-{}.safetensors", d.kind)).collect()
    }

    /// The networks that learn, or could, each with its file.
    fn learning(&mut self) -> impl Iterator<Item = (&mut dyn Learning, String)> {
        let names = self.weight_files();
        self.parts.iter_mut().filter_map(|part| part.learning()).zip(names)
    }

    /// Writes the weights as they are now to [`Factory::weight_files`] in a folder.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn save_weights(&mut self, dir: &Path) -> anyhow::Result<()> {
        self.learning().try_for_each(|(net, name)| Ok(net.save(&dir.join(name))?))
    }

    /// Takes a measurement as solved that was before the program was stopped: `sensor` is what [`Factory::solve`] made of it, if
    /// it was kept, `updates` its updates, each as long as the network was that made it.
    ///
    /// # Errors
    /// None that is known for measurements that have been solved before.
    pub fn pass(
        &mut self,
        scene: &Scene,
        k: usize,
        sensor: Option<ArrayView3<'_, f32>>,
        record: &MeasurementRecord,
    ) -> anyhow::Result<()> {
        self.begin(&scene.measurement(k)?)?;
        let adaptation = record.online.as_ref();
        match (&mut self.sequence, sensor) {
            (Some(sequence), _) if record.stop == Stop::Diverged => sequence.forget(),
            (Some(sequence), Some(sensor)) => sequence.finish(sensor),
            _ => {}
        }
        if let Some(split) = adaptation.and_then(|a| a.split.as_ref()) {
            self.ends_early = split.ends_early;
        }
        let mut updates = adaptation.map_or(&[][..], |a| &a.updates);
        let counts = adaptation.map_or(&[][..], |a| &a.updates_of);
        for ((net, _), &count) in self.learning().zip(counts) {
            let (own, rest) = updates.split_at_checked(count).unwrap_or((updates, &[]));
            net.take_up(own);
            updates = rest;
        }
        Ok(())
    }

    /// Whether a measurement takes something over from the one before, or from its own band in the middle.
    pub fn takes_over(&self) -> bool {
        self.needs_weights() || self.needs_previous() || self.experiment.online.is_some()
    }

    /// Reads what [`Factory::save_weights`] wrote, if networks go from measurement to measurement as they are.
    ///
    /// # Errors
    /// When a file cannot be read.
    pub fn load_weights(&mut self, dir: &Path) -> anyhow::Result<()> {
        if !self.carries_over() {
            return Ok(());
        }
        self.learning().try_for_each(|(net, name)| Ok(net.load(&dir.join(name))?))
    }

    /// What networks among the denoisers are to multiply.
    fn precisions(&self) -> impl Iterator<Item = Precision> {
        self.experiment.denoisers.iter().filter_map(|d| Some(d.part.network()?.precision))
    }

    fn has_network(&self) -> bool {
        let demosaicer = self.experiment.solver.demosaicer.as_ref();
        self.precisions().next().is_some() || demosaicer.is_some_and(|d| d.weights().is_some())
    }

    /// The instruction set that runs: that of the networks' kernels, or of the solver where there is no network.
    ///
    /// # Errors
    /// When `SCI_KERNEL` names none that this machine has, and there is a network to run on it.
    pub fn kernel(&self) -> anyhow::Result<&'static str> {
        if self.has_network() {
            return Ok(Isa::detect()?.name());
        }
        Ok(host::solver_kernel().name())
    }

    /// What networks multiply: `f32`, what 16-bit numbers are on this processor, or `mixed`; `halved` is the share that `[skip]` chose
    /// these for.
    ///
    /// # Errors
    /// As [`Factory::kernel`].
    pub fn precision_used(&self, halved: f64) -> anyhow::Result<&'static str> {
        let half = if self.has_network() { Isa::detect()?.half_precision() } else { "f32" };
        let wished = self.precisions().any(|precision| precision == Precision::Bf16);
        let full = self.precisions().any(|precision| precision == Precision::F32);
        Ok(match (wished, halved > 0.0) {
            _ if half == "f32" => half,
            (true, false) if !full => half,
            (false, false) => "f32",
            _ => "mixed",
        })
    }
}

/// What follows the solve of a measurement.
pub trait Follow: Observer {
    /// So many updates were made before it; whether to go on.
    fn adaptation(&mut self, updates: usize) -> ControlFlow<()>;
}

fn counts_of(split: &SplitRecord) -> UpdateCounts {
    let (fired, kept) = (split.updates(), split.kept);
    UpdateCounts { fired, kept, rolled_back: fired - kept, skipped: 0 }
}

/// The outcome of one measurement, whatever the solver.
#[derive(Debug)]
pub struct Solved {
    /// The result.
    pub outcome: Outcome,
    /// The iterations that were to be run.
    pub planned: usize,
    /// What the denoiser did.
    pub work: Work,
    /// How the denoiser adapted, where it was to.
    pub adaptation: Option<Adaptation>,
}
