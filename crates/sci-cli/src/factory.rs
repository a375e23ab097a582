//! Owns the step from a resolved experiment to objects that run: networks loaded once, solvers built for each measurement.

use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use admm::{
    Admm, BoxError, Demosaicked, Denoiser, Flips, Gap, MomentumStart, Observer, Outcome, PerLattice, PerStage, Plan,
    Prior, SolveError, Solver, Start, StopRule, TileCounter, TileCounts, Tiles, Tv, TwoStage, Wnnm,
};
use anyhow::Context;
use ndarray::{Array4, ArrayView3, ArrayViewMut4};
use nets::kernels::{Isa, Precision};
use nets::{Layers, MixedPrecision, Network, PrecisionCounter, PrecisionCounts};
use online::{AdaptiveDenoiser, Reuse, Sequence, Task, Update, UpdateCounts};
use sci_forward::bayer::{Bilinear, Malvar, Menon};
use sci_forward::{CfaPattern, Demosaicer, Measurement};

use crate::config::check::{Momentum, Solver as SolverChoice, Start as StartChoice};
use crate::config::denoising::Inference;
use crate::config::resolve::{Demosaicer as DemosaicerChoice, Denoiser as DenoiserChoice, Experiment, Online};
use crate::io::scene::Scene;
use crate::record::Adaptation;

/// Builds the solvers of one experiment.
pub struct Factory<'e> {
    experiment: &'e Experiment,
    parts: Vec<Part>,
    color: Option<Sensor>,
    plan: Plan,
    sequence: Option<Sequence>,
}

/// A color sensor, and what demosaics it.
struct Sensor {
    cfa: CfaPattern,
    demosaicer: SharedDemosaicer,
}

/// A denoiser as far as it can be shared by all measurements.
enum Part {
    /// Built anew for each measurement, as it may carry state from call to call.
    Tv { weight: f32, inner: usize },
    /// The same for all.
    Wnnm(Wnnm),
    /// Loaded once. Without a measurement it is the network itself.
    Ffdnet(AdaptiveDenoiser<nets::Ffdnet>, Inference),
    /// Loaded once.
    Fastdvdnet(AdaptiveDenoiser<nets::Fastdvdnet>, Inference),
}

impl Part {
    fn is_network(&self) -> bool {
        self.precision().is_some()
    }

    /// What it is to multiply, if it is a network.
    fn precision(&self) -> Option<Precision> {
        match self {
            Self::Tv { .. } | Self::Wnnm(_) => None,
            Self::Ffdnet(_, inference) | Self::Fastdvdnet(_, inference) => Some(inference.precision),
        }
    }

    fn prepare(&mut self, task: &Task) -> online::Result<()> {
        match self {
            Self::Tv { .. } | Self::Wnnm(_) => Ok(()),
            Self::Ffdnet(net, _) => task.prepare(net),
            Self::Fastdvdnet(net, _) => task.prepare(net),
        }
    }

    /// On gray or RGB video as it is.
    fn on_frames<'p>(&'p mut self, saving: &mut Saving) -> Box<dyn Denoiser + 'p> {
        match self {
            Self::Tv { weight, inner } => Box::new(Tv::new(*weight).inner(*inner)),
            Self::Wnnm(wnnm) => saving.tiles(*wnnm),
            Self::Ffdnet(net, inference) => saving.network(net, *inference),
            Self::Fastdvdnet(net, inference) => saving.network(net, *inference),
        }
    }

    /// On what the sensor sees.
    fn on_sensor<'p>(&'p mut self, color: Option<&Sensor>, saving: &mut Saving) -> Box<dyn Prior + 'p> {
        match (self, color) {
            (Self::Tv { weight, inner }, Some(_)) => Box::new(PerLattice::new(Tv::new(*weight).inner(*inner))),
            (part, Some(s)) => Box::new(Demosaicked::new(part.on_frames(saving), s.demosaicer.clone(), s.cfa)),
            (part, None) => Box::new(part.on_frames(saving)),
        }
    }

    fn load(&mut self, path: &Path) -> online::Result<()> {
        match self {
            Self::Tv { .. } | Self::Wnnm(_) => Ok(()),
            Self::Ffdnet(net, _) => net.load(path),
            Self::Fastdvdnet(net, _) => net.load(path),
        }
    }

    /// Of the updates of all networks, which the record joins, those of the denoiser that this is.
    fn take_up(&mut self, updates: &[Update]) {
        match self {
            Self::Tv { .. } | Self::Wnnm(_) => {}
            Self::Ffdnet(net, _) => net.take_up(updates),
            Self::Fastdvdnet(net, _) => net.take_up(updates),
        }
    }

    fn updates(&self) -> &[Update] {
        match self {
            Self::Tv { .. } | Self::Wnnm(_) => &[],
            Self::Ffdnet(net, _) => net.updates(),
            Self::Fastdvdnet(net, _) => net.updates(),
        }
    }
}

impl<'e> Factory<'e> {
    /// Loads what the experiment names, for scenes of a sensor with the pattern `cfa`, `None` for a gray one.
    ///
    /// # Errors
    /// A weight file that cannot be read or does not fit its network; a gray network or solver for a color scene, or the
    /// reverse.
    pub fn new(experiment: &'e Experiment, cfa: Option<CfaPattern>) -> anyhow::Result<Self> {
        if cfa.is_none() {
            let gray = "the scene is gray; name its Bayer pattern in data.cfa if it is a mosaic";
            let two_stage = matches!(experiment.solver, SolverChoice::TwoStage { .. });
            anyhow::ensure!(!two_stage, "solver.kind = \"two-stage\" is for color sensors: {gray}");
            anyhow::ensure!(experiment.demosaicer.is_none(), "solver.demosaicer has no effect: {gray}");
        }
        let parts =
            experiment.denoisers.iter().map(|d| load(d, cfa, experiment.online)).collect::<anyhow::Result<_>>()?;
        let sensor = |cfa| anyhow::Ok(Sensor { cfa, demosaicer: demosaicer(experiment)? });
        let color = cfa.map(sensor).transpose()?;
        let stages: Vec<admm::Stage> =
            experiment.stages.iter().map(|s| admm::Stage { sigma: s.sigma, iterations: s.iterations }).collect();
        let mut plan = Plan::new(stages);
        plan.stop = StopRule {
            relative_change: experiment.relative_change,
            time: experiment.seconds.map(Duration::from_secs_f64),
            ..StopRule::default()
        };
        plan.hold_out = experiment.skip.map(|s| s.hold_out);
        let sequence = experiment.online.map(|o| Sequence::new(o.sequence)).transpose()?;
        Ok(Self { experiment, parts, color, plan, sequence })
    }

    /// The stages and the stop rule.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Solves measurement `k`; `previous` is the result of the one before.
    ///
    /// # Errors
    /// What [`admm::run`] and the adaptation report.
    pub fn solve(
        &mut self,
        scene: &Scene,
        k: usize,
        previous: Option<ArrayView3<'_, f32>>,
        observer: &mut dyn Observer,
    ) -> anyhow::Result<Solved> {
        let measurement = scene.measurement(k)?;
        let task = self.begin(&measurement)?;
        let done: Vec<usize> = self.parts.iter().map(|part| part.updates().len()).collect();
        let plan = task.as_ref().map_or_else(|| self.plan.clone(), |task| task.plan(&self.plan));
        let mut warm = self.warm_start_prior();
        let normal = match (self.experiment.start, &mut warm, previous) {
            (StartChoice::Adjoint, ..) => Start::Adjoint,
            (StartChoice::Tv { iterations, .. }, Some(prior), _) => {
                Start::Warm { prior: prior.as_mut(), stage: admm::Stage { sigma: None, iterations } }
            }
            (StartChoice::Previous, _, Some(video)) => Start::From(video),
            _ => Start::Mean,
        };
        let start = match &task {
            Some(task) => task.start(normal),
            None => normal,
        };
        let (outcome, work) = self.run(&measurement, start, &plan, observer)?;
        if let Some(sequence) = &mut self.sequence {
            sequence.finish(outcome.estimate.sensor.view());
        }
        let new: Vec<&[Update]> = self.parts.iter().zip(done).map(|(part, done)| &part.updates()[done..]).collect();
        let updates_of =
            self.parts.iter().zip(&new).filter(|(part, _)| part.is_network()).map(|(_, u)| u.len()).collect();
        let updates = new.concat();
        let adaptation = task.map(|task| Adaptation {
            relation: task.relation,
            warm_start: task.is_warm(),
            cut: task.cut,
            counts: UpdateCounts::of(&updates),
            updates,
            updates_of,
        });
        Ok(Solved { outcome, planned: plan.iterations(), work, adaptation })
    }

    /// What is known of a measurement from those before, where networks adapt; all of them turn to it.
    fn begin(&mut self, measurement: &Measurement) -> anyhow::Result<Option<Task>> {
        let Some(sequence) = &mut self.sequence else { return Ok(None) };
        let task = sequence.begin(measurement.clone());
        self.parts.iter_mut().try_for_each(|part| part.prepare(&task))?;
        Ok(Some(task))
    }

    /// The TV of a warm start, if the experiment begins with one.
    fn warm_start_prior(&self) -> Option<Box<dyn Prior>> {
        let StartChoice::Tv { weight, .. } = self.experiment.start else { return None };
        let tv = Tv::new(weight);
        Some(if self.color.is_some() { Box::new(PerLattice::new(tv)) } else { Box::new(tv) })
    }

    fn run(
        &mut self,
        measurement: &Measurement,
        start: Start<'_>,
        plan: &Plan,
        observer: &mut dyn Observer,
    ) -> Result<(Outcome, Work), SolveError> {
        let begin = Instant::now();
        let mut saving = Saving::of(self.experiment, measurement);
        let looked = begin.elapsed().as_secs_f64();
        let mut solver = solver(self.experiment, &mut self.parts, self.color.as_ref(), &mut saving);
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
        self.experiment.start == StartChoice::Previous || self.carries_over()
    }

    /// Whether networks go from measurement to measurement as they are.
    fn carries_over(&self) -> bool {
        self.experiment.online.is_some_and(|o| o.sequence.reuse == Reuse::CarryOver)
    }

    /// Whether weights are to be kept with each measurement: for the next one, or to be saved with the last.
    pub fn needs_weights(&self) -> bool {
        self.carries_over() || self.experiment.online.is_some_and(|o| o.save)
    }

    /// The file of each adapting network's weights, `adapted-N-KIND.safetensors`, N its place among the denoisers.
    pub fn weight_files(&self) -> Vec<String> {
        let networks = self.experiment.denoisers.iter().enumerate().filter(|(_, d)| d.is_network());
        networks.map(|(i, d)| format!("adapted-{i}-{}.safetensors", d.kind())).collect()
    }

    fn networks(&mut self) -> impl Iterator<Item = (&mut Part, String)> {
        let names = self.weight_files();
        self.parts.iter_mut().filter(|part| part.is_network()).zip(names)
    }

    /// Writes the weights as they are now to [`Factory::weight_files`] in a folder.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn save_weights(&mut self, dir: &Path) -> anyhow::Result<()> {
        for (part, name) in self.networks() {
            match part {
                Part::Tv { .. } | Part::Wnnm(_) => {}
                Part::Ffdnet(net, _) => net.save(&dir.join(name))?,
                Part::Fastdvdnet(net, _) => net.save(&dir.join(name))?,
            }
        }
        Ok(())
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
        adaptation: Option<&Adaptation>,
    ) -> anyhow::Result<()> {
        self.begin(&scene.measurement(k)?)?;
        if let (Some(sequence), Some(sensor)) = (&mut self.sequence, sensor) {
            sequence.finish(sensor);
        }
        let mut updates = adaptation.map_or(&[][..], |a| &a.updates);
        let counts = adaptation.map_or(&[][..], |a| &a.updates_of);
        for ((part, _), &count) in self.networks().zip(counts) {
            let (own, rest) = updates.split_at_checked(count).unwrap_or((updates, &[]));
            part.take_up(own);
            updates = rest;
        }
        Ok(())
    }

    /// Reads what [`Factory::save_weights`] wrote, if networks go from measurement to measurement as they are.
    ///
    /// # Errors
    /// When a file cannot be read.
    pub fn load_weights(&mut self, dir: &Path) -> anyhow::Result<()> {
        if !self.carries_over() {
            return Ok(());
        }
        self.networks().try_for_each(|(part, name)| Ok(part.load(&dir.join(name))?))
    }

    fn has_network(&self) -> bool {
        self.parts.iter().any(Part::is_network)
            || matches!(self.experiment.demosaicer, Some(DemosaicerChoice::Ddnet { .. }))
    }

    /// The instruction set that runs: that of the networks' kernels, or of the solver where there is no network.
    ///
    /// # Errors
    /// When `SCI_KERNEL` names none that this machine has, and there is a network to run on it.
    pub fn kernel(&self) -> anyhow::Result<&'static str> {
        if self.has_network() {
            return Ok(Isa::detect()?.name());
        }
        // Solvers choose by themselves, and the matrix unit is not for them.
        let own = Isa::ALL.into_iter().filter(|isa| *isa != Isa::Amx).find(|isa| isa.available());
        Ok(own.unwrap_or(Isa::Portable).name())
    }

    /// What networks multiply: bf16 is for the matrix unit only; `halved` is the share that `[skip]` chose it for.
    ///
    /// # Errors
    /// As [`Factory::kernel`].
    pub fn precision_used(&self, halved: f64) -> anyhow::Result<&'static str> {
        let wished = self.parts.iter().any(|part| part.precision() == Some(Precision::Bf16));
        let has_unit = self.has_network() && Isa::detect()? == Isa::Amx;
        let full = self.parts.iter().any(|part| part.precision() == Some(Precision::F32));
        Ok(match (has_unit && wished, has_unit && halved > 0.0) {
            (true, false) if !full => "bf16",
            (false, false) => "f32",
            _ => "mixed",
        })
    }
}

impl Sensor {
    /// Sees to the RGB video where the estimate has none of its own: after a prior on the mosaic, or no iteration at all.
    fn complete(&self, outcome: &mut Outcome) -> Result<(), SolveError> {
        let (sensor, None) = (&outcome.estimate.sensor, &outcome.estimate.rgb) else { return Ok(()) };
        let begin = Instant::now();
        let (frames, height, width) = sensor.dim();
        let mut rgb = Array4::zeros((frames, 3, height, width));
        self.demosaicer.clone().demosaic(self.cfa, sensor.view(), rgb.view_mut()).map_err(|source| {
            SolveError::Prior {
                part: "demosaicer",
                name: self.demosaicer.name.clone(),
                iteration: outcome.iterations,
                source,
            }
        })?;
        outcome.estimate.rgb = Some(rgb);
        outcome.seconds += begin.elapsed().as_secs_f64();
        Ok(())
    }
}

/// The solver of a measurement with its priors: on gray or, for the two-stage solver, RGB video as it is; else on the mosaic.
fn solver<'p>(
    experiment: &Experiment,
    parts: &'p mut [Part],
    color: Option<&Sensor>,
    saving: &mut Saving,
) -> Box<dyn Solver + 'p> {
    let of_stage = experiment.stages.iter().map(|s| s.denoiser).collect();
    if let (SolverChoice::TwoStage { params, x_step }, Some(Sensor { cfa, demosaicer })) = (experiment.solver, color) {
        let on_frames = parts.iter_mut().map(|part| part.on_frames(saving)).collect();
        let denoiser = PerStage::<dyn Denoiser + 'p>::new(on_frames, of_stage);
        return Box::new(TwoStage::new(denoiser, demosaicer.clone(), x_step, *cfa, params));
    }
    let priors = parts.iter_mut().map(|part| part.on_sensor(color, saving)).collect();
    let prior = PerStage::<dyn Prior + 'p>::new(priors, of_stage);
    match experiment.solver {
        SolverChoice::Gap { momentum } => {
            let gap = match momentum {
                None => Gap::plain(prior),
                Some(Momentum::Zero) => Gap::with_momentum(prior, MomentumStart::Zero),
                Some(Momentum::Measurement) => Gap::with_momentum(prior, MomentumStart::Measurement),
            };
            Box::new(if experiment.skip.is_some() { gap.restarting() } else { gap })
        }
        SolverChoice::Admm { gamma } => Box::new(Admm::new(prior, gamma)),
        SolverChoice::TwoStage { .. } => unreachable!("Factory::new refuses two-stage solvers for gray scenes"),
    }
}

/// What networks were spared in a solve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Work {
    /// The share of the pixels of all calls that was left out.
    pub skipped_tiles: f64,
    /// The share of what networks did that was in bf16 because the solve would not notice.
    pub halved: f64,
}

/// What networks may be spared of a measurement, and what they were.
struct Saving {
    /// Which tiles stand still; nothing when all are wanted.
    still: Option<Vec<bool>>,
    half_precision: bool,
    tiles: Vec<Arc<TileCounter>>,
    halves: Vec<Arc<PrecisionCounter>>,
}

impl Saving {
    /// A network that adapts is given everything in full: its updates look at the whole measurement.
    fn of(experiment: &Experiment, measurement: &Measurement) -> Self {
        let skip = experiment.skip.filter(|_| experiment.online.is_none());
        Self {
            still: skip.is_some_and(|s| s.tiles).then(|| admm::still(measurement)),
            half_precision: skip.is_some_and(|s| s.half_precision),
            tiles: Vec::new(),
            halves: Vec::new(),
        }
    }

    fn network<'a, N>(&mut self, net: &'a mut AdaptiveDenoiser<N>, inference: Inference) -> Box<dyn Denoiser + 'a>
    where
        N: Network + Denoiser,
    {
        let mut denoiser: Box<dyn Denoiser + 'a> = if self.half_precision && inference.precision == Precision::F32 {
            let mixed = MixedPrecision::new(net);
            self.halves.push(mixed.counter());
            Box::new(mixed)
        } else {
            Box::new(net)
        };
        if inference.flips {
            denoiser = Box::new(Flips::new(denoiser));
        }
        self.tiles(denoiser)
    }

    fn tiles<'a>(&mut self, denoiser: impl Denoiser + 'a) -> Box<dyn Denoiser + 'a> {
        let Some(still) = &self.still else { return Box::new(denoiser) };
        let tiles = Tiles::new(denoiser, still);
        self.tiles.push(tiles.counter());
        Box::new(tiles)
    }

    fn work(&self) -> Work {
        let (mut tiles, mut halves) = (TileCounts::default(), PrecisionCounts::default());
        for TileCounts { asked, done } in self.tiles.iter().map(|counter| counter.counts()) {
            (tiles.asked, tiles.done) = (tiles.asked + asked, tiles.done + done);
        }
        for PrecisionCounts { asked, halved } in self.halves.iter().map(|counter| counter.counts()) {
            (halves.asked, halves.halved) = (halves.asked + asked, halves.halved + halved);
        }
        Work { skipped_tiles: tiles.skipped(), halved: halves.share() }
    }
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

fn load(choice: &DenoiserChoice, cfa: Option<CfaPattern>, online: Option<Online>) -> anyhow::Result<Part> {
    let adapt = online.map(|o| o.adapt).unwrap_or_default();
    let fits = |net: &dyn Network, weights: &Path| {
        let (channels, (scene, needed)) = (net.channels(), if cfa.is_some() { ("color", 3) } else { ("gray", 1) });
        anyhow::ensure!(
            channels == needed,
            "denoiser.weights: {}: a network for {channels} channels, but the scene is {scene}: it needs one for {needed}",
            weights.display()
        );
        Ok(())
    };
    Ok(match choice {
        DenoiserChoice::Tv { weight, inner } => Part::Tv { weight: *weight, inner: *inner },
        DenoiserChoice::Wnnm(wnnm) => Part::Wnnm(*wnnm),
        DenoiserChoice::Ffdnet { weights, inference } => {
            let mut net = nets::Ffdnet::load(weights).context("denoiser.weights")?;
            fits(&net, weights)?;
            net.set_inference_precision(inference.precision);
            Part::Ffdnet(AdaptiveDenoiser::new(net, adapt)?, *inference)
        }
        DenoiserChoice::Fastdvdnet { weights, ends, inference } => {
            let mut net = nets::Fastdvdnet::load(weights, *ends).context("denoiser.weights")?;
            fits(&net, weights)?;
            net.set_inference_precision(inference.precision);
            Part::Fastdvdnet(AdaptiveDenoiser::new(net, adapt)?, *inference)
        }
    })
}

/// The demosaicer of an experiment; by default that of the reference code: Malvar's for two stages, Menon's else.
fn demosaicer(experiment: &Experiment) -> anyhow::Result<SharedDemosaicer> {
    let demosaicer: Box<dyn Demosaicer> = match (&experiment.demosaicer, experiment.solver) {
        (Some(DemosaicerChoice::Bilinear), _) => Box::new(Bilinear),
        (Some(DemosaicerChoice::Malvar), _) | (None, SolverChoice::TwoStage { .. }) => Box::new(Malvar),
        (Some(DemosaicerChoice::Menon), _) | (None, _) => Box::new(Menon),
        (Some(DemosaicerChoice::Ddnet { weights }), _) => {
            Box::new(nets::Ddnet::load(weights, nets::Ends::Circular).context("solver.weights")?)
        }
    };
    let name = demosaicer.name().to_owned();
    Ok(SharedDemosaicer { name, shared: Arc::new(Mutex::new(demosaicer)) })
}

/// One demosaicer for all priors of a schedule, as a network is too large to have twice.
#[derive(Clone)]
struct SharedDemosaicer {
    name: String,
    shared: Arc<Mutex<Box<dyn Demosaicer>>>,
}

impl Demosaicer for SharedDemosaicer {
    fn name(&self) -> &str {
        &self.name
    }

    fn demosaic(
        &mut self,
        cfa: CfaPattern,
        mosaic: ArrayView3<'_, f32>,
        rgb: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        // A demosaicer keeps nothing that a panic could have left half done.
        self.shared.lock().unwrap_or_else(PoisonError::into_inner).demosaic(cfa, mosaic, rgb)
    }
}
