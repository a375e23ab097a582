//! Owns the step from a resolved experiment to objects that run: networks loaded once, solvers built for each measurement.

use std::cell::{Cell, RefCell};
use std::path::Path;
use std::rc::Rc;
use std::time::{Duration, Instant};

use admm::{
    Admm, BoxError, Demosaicked, DenoiseCx, Denoiser, Flips, Gap, MomentumStart, Observer, Outcome, PerLattice,
    PerStage, Plan, Problem, SolveError, Start, StopRule, TileConfig, TileCounts, Tiles, Tv, TwoStage, Wnnm,
};
use anyhow::Context;
use ndarray::{Array4, ArrayView3, ArrayView4, ArrayViewMut4};
use nets::kernels::Precision;
use nets::{Frugal, HalfCounts, Network};
use online::{AdaptiveDenoiser, Counts, Sequence, Snapshot, Task, Update};
use sci_forward::bayer::{Bilinear, Malvar, Menon};
use sci_forward::{CfaPattern, Demosaicer};

use crate::config::check::{Momentum, Solver, Start as StartChoice};
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
    fn prepare(&mut self, task: &Task) -> online::Result<()> {
        match self {
            Self::Tv { .. } | Self::Wnnm(_) => Ok(()),
            Self::Ffdnet(net, _) => task.prepare(net),
            Self::Fastdvdnet(net, _) => task.prepare(net),
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
            let two_stage = matches!(experiment.solver, Solver::TwoStage { .. });
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
        let task = self.begin(scene, k)?;
        let done: Vec<usize> = self.parts.iter().map(|part| part.updates().len()).collect();
        let normal = start(self.experiment.start, self.color.is_some(), previous);
        let (start, plan) = match &task {
            Some(task) => (task.start(normal), task.plan(&self.plan)),
            None => (normal, self.plan.clone()),
        };
        let problem = Problem::new(scene.operator.as_ref(), scene.measurement(k))?;
        let (outcome, work) = self.run(&problem, start, &plan, observer)?;
        if let Some(sequence) = &mut self.sequence {
            sequence.finish(outcome.estimate.view());
        }
        let new = self.parts.iter().zip(done).flat_map(|(part, done)| &part.updates()[done..]);
        let updates: Vec<Update> = new.copied().collect();
        let adaptation = task.map(|task| Adaptation {
            relation: task.relation,
            warm_start: task.is_warm(),
            cut: task.cut,
            counts: Counts::of(&updates),
            updates,
        });
        Ok(Solved { outcome, planned: plan.iterations(), work, adaptation })
    }

    /// What is known of a measurement from those before, where networks adapt; all of them turn to it.
    fn begin(&mut self, scene: &Scene, k: usize) -> anyhow::Result<Option<Task>> {
        let Some(sequence) = &mut self.sequence else { return Ok(None) };
        let task = sequence.begin(Snapshot::new(scene.operator.clone(), scene.measurement(k), scene.cfa)?);
        self.parts.iter_mut().try_for_each(|part| part.prepare(&task))?;
        Ok(Some(task))
    }

    fn run(
        &mut self,
        problem: &Problem<'_>,
        start: Start<'_>,
        plan: &Plan,
        observer: &mut dyn Observer,
    ) -> Result<(Outcome<()>, Work), SolveError> {
        let calls = Rc::new(Cell::new(0));
        let color = self.color.as_ref();
        let begin = Instant::now();
        let saving = Saving::of(self.experiment, problem);
        let looked = begin.elapsed().as_secs_f64();
        let inner = denoiser(self.experiment, &mut self.parts, color, &saving);
        let denoiser = Counted { inner, calls: Rc::clone(&calls) };
        let mut outcome = match (self.experiment.solver, color) {
            (Solver::TwoStage { params, x_step }, Some(Sensor { cfa, demosaicer })) => {
                let mut solver = TwoStage::new(denoiser, demosaicer.clone(), x_step, *cfa, params);
                admm::run(&mut solver, problem, start, plan, observer)?.without_state()
            }
            (Solver::Gap { momentum }, _) => {
                let gap = match momentum {
                    None => Gap::plain(denoiser),
                    Some(Momentum::Zero) => Gap::with_momentum(denoiser, MomentumStart::Zero),
                    Some(Momentum::Measurement) => Gap::with_momentum(denoiser, MomentumStart::Measurement),
                };
                let mut gap = if self.experiment.skip.is_some() { gap.restarting() } else { gap };
                admm::run(&mut gap, problem, start, plan, observer)?.without_state()
            }
            (Solver::Admm { gamma }, _) => {
                let mut solver = Admm::new(denoiser, gamma);
                admm::run(&mut solver, problem, start, plan, observer)?.without_state()
            }
            (Solver::TwoStage { .. }, None) => unreachable!("Factory::new refuses two-stage solvers for gray scenes"),
        };
        if let Some(sensor) = color {
            sensor.complete(&mut outcome)?;
        }
        outcome.seconds += looked;
        let (skipped_tiles, halved) = (saving.tiles.get().skipped(), saving.halves.get().share());
        Ok((outcome, Work { calls: calls.get(), skipped_tiles, halved }))
    }

    /// Writes the weights as they are now, of each network one file `adapted-N-KIND.safetensors`, N its place among the
    /// denoisers.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn save_adapted(&self, dir: &Path) -> anyhow::Result<()> {
        for (i, (part, choice)) in self.parts.iter().zip(&self.experiment.denoisers).enumerate() {
            let path = dir.join(format!("adapted-{i}-{}.safetensors", choice.kind()));
            match part {
                Part::Tv { .. } | Part::Wnnm(_) => {}
                Part::Ffdnet(net, _) => net.save(&path)?,
                Part::Fastdvdnet(net, _) => net.save(&path)?,
            }
        }
        Ok(())
    }
}

impl Sensor {
    /// Sees to the RGB video where the solver has none of its own: after a prior on the mosaic, a divergence, or no
    /// iteration at all.
    fn complete(&self, outcome: &mut Outcome<()>) -> Result<(), SolveError> {
        if outcome.rgb.is_some() && outcome.iterations > 0 {
            return Ok(());
        }
        let begin = Instant::now();
        let (frames, height, width) = outcome.estimate.dim();
        let mut rgb = Array4::zeros((frames, 3, height, width));
        self.demosaicer.clone().demosaic(self.cfa, outcome.estimate.view(), rgb.view_mut()).map_err(|source| {
            SolveError::Denoiser { name: "demosaicer".into(), iteration: outcome.iterations, source }
        })?;
        outcome.rgb = Some(rgb);
        outcome.seconds += begin.elapsed().as_secs_f64();
        Ok(())
    }
}

/// The prior of a solve: on gray or, for the two-stage solver, RGB video as it is; else on the mosaic.
fn denoiser<'p>(
    experiment: &Experiment,
    parts: &'p mut [Part],
    color: Option<&Sensor>,
    saving: &Saving,
) -> PerStage<'p> {
    let on_mosaic = color.filter(|_| !matches!(experiment.solver, Solver::TwoStage { .. }));
    let denoisers = parts.iter_mut().map(|part| {
        let on_frames = match part {
            Part::Tv { weight, inner } => {
                let tv = Tv::new(*weight).inner(*inner);
                return if on_mosaic.is_some() { boxed(PerLattice::new(tv)) } else { boxed(tv) };
            }
            Part::Wnnm(wnnm) => saving.spare_tiles(*wnnm),
            Part::Ffdnet(net, inference) => saving.spare(net, *inference),
            Part::Fastdvdnet(net, inference) => saving.spare(net, *inference),
        };
        match on_mosaic {
            None => on_frames,
            Some(s) => boxed(Demosaicked::new(on_frames, s.demosaicer.clone(), s.cfa)),
        }
    });
    PerStage::new(denoisers.collect(), experiment.stages.iter().map(|s| s.denoiser).collect())
}

fn boxed<'a>(denoiser: impl Denoiser + 'a) -> Box<dyn Denoiser + 'a> {
    Box::new(denoiser)
}

/// What the denoiser of a solve did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Work {
    /// Its calls.
    pub calls: usize,
    /// The share of the pixels of these calls that was left out.
    pub skipped_tiles: f64,
    /// The share of what networks did that was in bf16 because the solve would not notice.
    pub halved: f64,
}

/// What networks may be spared of a measurement.
struct Saving {
    config: TileConfig,
    /// Which tiles stand still; nothing when all are wanted.
    still: Option<Vec<bool>>,
    tiles: Rc<Cell<TileCounts>>,
    half_precision: bool,
    halves: Rc<Cell<HalfCounts>>,
}

impl Saving {
    /// A network that adapts is given everything in full: its updates look at the whole measurement.
    fn of(experiment: &Experiment, problem: &Problem<'_>) -> Self {
        let config = TileConfig::default();
        let skip = experiment.skip.filter(|_| experiment.online.is_none());
        let still = skip.is_some_and(|s| s.tiles).then(|| admm::still(problem, config.side));
        let half_precision = skip.is_some_and(|s| s.half_precision);
        Self { config, still, tiles: Rc::default(), half_precision, halves: Rc::default() }
    }

    fn spare<'a, N>(&self, net: &'a mut AdaptiveDenoiser<N>, inference: Inference) -> Box<dyn Denoiser + 'a>
    where
        N: Network + Denoiser,
    {
        let halves = self.half_precision && inference.precision == Precision::F32;
        match (halves, inference.flips) {
            (false, false) => self.spare_tiles(net),
            (false, true) => self.spare_tiles(Flips::new(net)),
            (true, false) => self.spare_tiles(Frugal::new(net, Rc::clone(&self.halves))),
            (true, true) => self.spare_tiles(Flips::new(Frugal::new(net, Rc::clone(&self.halves)))),
        }
    }

    fn spare_tiles<'a>(&self, net: impl Denoiser + 'a) -> Box<dyn Denoiser + 'a> {
        match &self.still {
            Some(still) => Box::new(Tiles::new(net, self.config, still, Rc::clone(&self.tiles))),
            None => Box::new(net),
        }
    }
}

/// The outcome of one measurement, whatever the solver.
#[derive(Debug)]
pub struct Solved {
    /// The result; its state is dropped.
    pub outcome: Outcome<()>,
    /// The iterations that were to be run.
    pub planned: usize,
    /// What the denoiser did.
    pub work: Work,
    /// How the denoiser adapted, where it was to.
    pub adaptation: Option<Adaptation>,
}

fn start<'a>(choice: StartChoice, bayer: bool, previous: Option<ArrayView3<'a, f32>>) -> Start<'a> {
    match (choice, previous) {
        (StartChoice::Adjoint, _) => Start::Adjoint,
        (StartChoice::Tv { iterations, weight }, _) => Start::Tv { iterations, weight, bayer },
        (StartChoice::Previous, Some(x)) => Start::From(x),
        (StartChoice::Mean | StartChoice::Previous, _) => Start::Mean,
    }
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
        (Some(DemosaicerChoice::Malvar), _) | (None, Solver::TwoStage { .. }) => Box::new(Malvar),
        (Some(DemosaicerChoice::Menon), _) | (None, _) => Box::new(Menon),
        (Some(DemosaicerChoice::Ddnet { weights }), _) => {
            Box::new(nets::Ddnet::load(weights, nets::Ends::Circular).context("solver.weights")?)
        }
    };
    Ok(SharedDemosaicer(Rc::new(RefCell::new(demosaicer))))
}

/// One demosaicer for all denoisers of a schedule, as a network is too large to have twice.
#[derive(Clone)]
struct SharedDemosaicer(Rc<RefCell<Box<dyn Demosaicer>>>);

impl Demosaicer for SharedDemosaicer {
    fn demosaic(
        &mut self,
        cfa: CfaPattern,
        mosaic: ArrayView3<'_, f32>,
        rgb: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        self.0.borrow_mut().demosaic(cfa, mosaic, rgb)
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

    fn rgb(&self) -> Option<ArrayView4<'_, f32>> {
        self.inner.rgb()
    }
}
