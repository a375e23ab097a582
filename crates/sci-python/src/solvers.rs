//! `Gap`, `Admm` and `TwoStage`: the solvers of the crate `admm` with any denoiser.

use std::ops::ControlFlow;
use std::time::Duration;

use admm::{
    Convention, Demosaicked, Denoiser, IterInfo, MomentumStart, Observer, Outcome, Plan, Prior, Stage, Start,
    StopReason, StopRule, TwoStageParams, XStep,
};
use ndarray::{Array3, Ix2, Ix3};
use numpy::PyArrayDyn;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sci_forward::bayer::{Bilinear, Malvar, Menon};
use sci_forward::{BoxError, CfaPattern, Demosaicer, Measurement, Noise};

use crate::arrays::{array, out, row_major};
use crate::denoisers::Plugged;
use crate::failure::{Refused, in_units_of_white, raised, refused};
use crate::operator::{operator, pattern};
use crate::pool::{self, Stop};

type MakeDemosaicer = fn() -> Box<dyn Demosaicer>;

/// How a solver is made of what it plugs in.
#[derive(Clone, Copy)]
enum Method {
    Gap { momentum: Option<MomentumStart>, restarts: bool },
    Admm { gamma: f32 },
    TwoStage { params: TwoStageParams, x_step: XStep },
}

/// What sci.Gap, sci.Admm and sci.TwoStage have in common: solve.
#[pyclass(frozen, subclass, module = "sci")]
pub(crate) struct Solver {
    method: Method,
    denoiser: Plugged,
    demosaicer: MakeDemosaicer,
}

/// Generalised alternating projection: x ← v + Hᵀ (y − H v) / diag(H Hᵀ), v ← denoiser(x, sigma).
///
/// Parameters
/// ----------
/// denoiser : sci.Denoiser or callable
///     denoiser(noisy, sigma) → video, arrays of float32 [T, C, H, W], C = 3 on color sensors, else 1; sigma is that of the stage, 0 to 1,
///     or None. It may be a torch model in a function. It is called on a worker thread, never twice at a time.
/// accelerate : bool
///     Project onto what has been accumulated of y − H v.
/// momentum : "measurement" or "zero"
///     Where that begins: at y, or at 0 as in the public Python code.
/// restart : bool
///     Begin it anew with every stage of a much smaller sigma.
/// demosaicer : "malvar", "menon" or "bilinear"
///     For color sensors.
#[pyclass(frozen, extends = Solver, module = "sci")]
pub(crate) struct Gap;

#[pymethods]
impl Gap {
    #[new]
    #[pyo3(signature = (denoiser, *, accelerate=true, momentum="measurement", restart=false, demosaicer="menon"))]
    fn new(
        denoiser: &Bound<'_, PyAny>,
        accelerate: bool,
        momentum: &str,
        restart: bool,
        demosaicer: &str,
    ) -> PyResult<PyClassInitializer<Self>> {
        let legal = [("measurement", MomentumStart::Measurement), ("zero", MomentumStart::Zero)];
        let momentum = Some(choice("momentum", momentum, &legal)?).filter(|_| accelerate);
        Ok(PyClassInitializer::from(Solver::new(Method::Gap { momentum, restarts: restart }, denoiser, demosaicer)?)
            .add_subclass(Self))
    }
}

/// ADMM with one splitting: x ← (θ + b) + Hᵀ (y − H (θ + b)) / (diag(H Hᵀ) + γ), θ ← denoiser(x − b, sigma), b ← b − (x − θ).
///
/// Parameters
/// ----------
/// denoiser, demosaicer
///     As for sci.Gap.
/// gamma : float, at least 0
///     Penalty of x − θ, in the unit of diag(H Hᵀ); 0 is plain GAP.
#[pyclass(frozen, extends = Solver, module = "sci")]
pub(crate) struct Admm;

#[pymethods]
impl Admm {
    #[new]
    #[pyo3(signature = (denoiser, *, gamma=0.01, demosaicer="menon"))]
    fn new(denoiser: &Bound<'_, PyAny>, gamma: f32, demosaicer: &str) -> PyResult<PyClassInitializer<Self>> {
        at_least_zero("gamma", gamma, false)?;
        Ok(PyClassInitializer::from(Solver::new(Method::Admm { gamma }, denoiser, demosaicer)?).add_subclass(Self))
    }
}

/// The two-stage ADMM for color sensors of Wu et al. (2023): the mosaic from the measurement, the RGB video from the mosaic.
///
/// Parameters
/// ----------
/// denoiser, demosaicer
///     As for sci.Gap.
/// rho, tau : float, above 0
///     Penalties of q = T x and of x = v.
/// convention : "paper-code" or "scaled"
///     How duals are kept: as the paper's public code does, or consistently.
/// closed_form : bool
///     Make x in closed form after a first step by the demosaicer; clip_x then says whether x is clipped to 0 and 1.
#[pyclass(frozen, extends = Solver, module = "sci")]
pub(crate) struct TwoStage;

#[pymethods]
impl TwoStage {
    #[new]
    #[pyo3(signature = (denoiser, *, rho=1.0, tau=100.0, convention="paper-code", demosaicer="menon", closed_form=false, clip_x=true))]
    fn new(
        denoiser: &Bound<'_, PyAny>,
        rho: f32,
        tau: f32,
        convention: &str,
        demosaicer: &str,
        closed_form: bool,
        clip_x: bool,
    ) -> PyResult<PyClassInitializer<Self>> {
        at_least_zero("rho", rho, true)?;
        at_least_zero("tau", tau, true)?;
        let legal = [("paper-code", Convention::PaperCode), ("scaled", Convention::Scaled)];
        let params = TwoStageParams { rho, tau, convention: choice("convention", convention, &legal)? };
        let x_step = if closed_form { XStep::ClosedForm { clip: clip_x } } else { XStep::Demosaic };
        Ok(PyClassInitializer::from(Solver::new(Method::TwoStage { params, x_step }, denoiser, demosaicer)?)
            .add_subclass(Self))
    }
}

#[pymethods]
impl Solver {
    /// Solves a measurement.
    ///
    /// Parameters
    /// ----------
    /// measurement : array of floats, [H, W]
    ///     y, up to Σ_t C_t: white is 1.
    /// masks : sci.MaskOperator, or array [T, H, W]
    ///     Of the frames that y sums.
    /// stages : list of (sigma, iterations)
    ///     sigma is what the denoiser is given, 0 to 1, or None.
    /// start : "mean", "adjoint" or array [T, H, W]
    ///     Every frame the static scene that fits y best, or Hᵀ y, or a given video.
    /// cfa : "rggb", "bggr", "grbg", "gbrg" or None
    ///     The Bayer pattern of a color sensor.
    /// noise : float or None, 0 to 1
    ///     Standard deviation of the noise of y, in units of white: GAP then explains y no closer than that.
    /// clip : float or None
    ///     What no measured pixel exceeds: those that reach it count as at least that bright.
    /// relative_change : float, 0 to 1
    ///     End once ‖x_k − x_{k−1}‖ / ‖x_k‖ is below this; 0 never.
    /// seconds : float or None
    ///     End after the iteration that passes this.
    /// callback : callable or None
    ///     callback(iteration, video) after each iteration, video [T, H, W]; it may return True to end the solve.
    ///
    /// Returns
    /// -------
    /// video : array of float32, [T, H, W], of color sensors [T, 3, H, W]
    ///     Not clipped, always finite.
    /// info : dict
    ///     stop ("schedule_done", "converged", "diverged", "time_up", "observer"), iterations, seconds and relative_residual, which is
    ///     ‖y − H x‖ / ‖y‖. After a divergence the video is the iterate that explains y best.
    #[pyo3(signature = (measurement, masks, stages, *, start=None, cfa=None, noise=None, clip=None, relative_change=0.0, seconds=None,
        callback=None), text_signature = "($self, measurement, masks, stages, *, start=\"mean\", cfa=None, noise=None, clip=None, \
        relative_change=0.0, seconds=None, callback=None)")]
    #[expect(clippy::too_many_arguments, reason = "keyword arguments of Python")]
    fn solve<'py>(
        &self,
        py: Python<'py>,
        measurement: &Bound<'py, PyAny>,
        masks: &Bound<'py, PyAny>,
        stages: Vec<(Option<f32>, usize)>,
        start: Option<&Bound<'py, PyAny>>,
        cfa: Option<&str>,
        noise: Option<f64>,
        clip: Option<f32>,
        relative_change: f64,
        seconds: Option<f64>,
        callback: Option<Py<PyAny>>,
    ) -> PyResult<(Bound<'py, PyArrayDyn<f32>>, Bound<'py, PyDict>)> {
        let cfa = pattern(cfa)?;
        let y = row_major(array::<Ix2>("measurement", measurement, "[H, W]")?.as_array()).into_owned();
        if let Some(sigma) =
            stages.iter().filter_map(|stage| stage.0).find(|sigma| !(*sigma >= 0.0 && sigma.is_finite()))
        {
            return Err(refused(format!("sigma = {sigma} of a stage is not legal; legal: 0 or more, or None")));
        }
        noise.map_or(Ok(()), |noise| in_units_of_white("noise", noise))?;
        if let Some(clip) = clip.filter(|clip| !(*clip > 0.0 && clip.is_finite())) {
            return Err(refused(format!("clip = {clip} is not legal; legal: a number above 0")));
        }
        let noise = noise.map(|sigma| Noise::new(None, sigma)).transpose().map_err(|e| raised(e.into()))?;
        let measurement = Measurement::new(operator(masks)?, y).map_err(|e| raised(e.into()))?;
        let measurement = measurement.with_cfa(cfa).with_noise(noise).with_clip(clip);
        self.denoiser.check(stages.iter().map(|stage| stage.0), cfa.is_some())?;
        let mut plan =
            Plan::new(stages.iter().map(|&(sigma, iterations)| Stage { sigma, iterations }).collect::<Vec<_>>());
        if !(0.0..=1.0).contains(&relative_change) {
            return Err(refused(format!("relative_change = {relative_change} is not legal; legal: 0 to 1")));
        }
        let time = seconds.map(Duration::try_from_secs_f64).transpose();
        plan.stop.time = time.map_err(|e| refused(format!("seconds: {e}")))?;
        plan.stop = StopRule { relative_change, ..plan.stop };
        let start = Begin::of(start)?;
        let outcome = pool::run(py, |stop| self.run(&measurement, &plan, &start, &mut Watch { callback, stop }))?;
        let outcome = outcome.map_err(raised)?;
        let info = PyDict::new(py);
        info.set_item("stop", named(outcome.stop))?;
        info.set_item("iterations", outcome.iterations)?;
        info.set_item("seconds", outcome.seconds)?;
        info.set_item("relative_residual", outcome.relative_residual)?;
        let estimate = outcome.estimate;
        let video = estimate.rgb.map_or_else(|| estimate.sensor.into_dyn(), |rgb| rgb.into_dyn());
        Ok((out(py, video), info))
    }
}

impl Solver {
    fn new(method: Method, denoiser: &Bound<'_, PyAny>, demosaicer: &str) -> PyResult<Self> {
        let legal: [(&str, MakeDemosaicer); 3] =
            [("malvar", || Box::new(Malvar)), ("menon", || Box::new(Menon)), ("bilinear", || Box::new(Bilinear))];
        let demosaicer = choice("demosaicer", demosaicer, &legal)?;
        Ok(Self { method, denoiser: Plugged::new(denoiser)?, demosaicer })
    }

    fn run(
        &self,
        measurement: &Measurement,
        plan: &Plan,
        start: &Begin,
        watch: &mut Watch<'_>,
    ) -> anyhow::Result<Outcome> {
        self.denoiser.with(|denoiser| {
            let mut solver = self.build(denoiser, measurement.cfa())?;
            let mut outcome = admm::run(solver.as_mut(), measurement, start.start(), plan, watch)?;
            drop(solver);
            if let (Some(cfa), None) = (measurement.cfa(), &outcome.estimate.rgb) {
                // No iteration was done that would have made it.
                let (sensor, rgb) = outcome.estimate.for_rgb();
                (self.demosaicer)().demosaic(cfa, sensor.view(), rgb.view_mut()).map_err(anyhow::Error::from_boxed)?;
            }
            Ok(outcome)
        })
    }

    fn build<'d>(
        &self,
        denoiser: &'d mut dyn Denoiser,
        cfa: Option<CfaPattern>,
    ) -> anyhow::Result<Box<dyn admm::Solver + 'd>> {
        let demosaicer = (self.demosaicer)();
        let on_sensor = move |denoiser: &'d mut dyn Denoiser, demosaicer| -> Box<dyn Prior + 'd> {
            match cfa {
                Some(cfa) => Box::new(Demosaicked::new(denoiser, demosaicer, cfa)),
                None => Box::new(denoiser),
            }
        };
        Ok(match self.method {
            Method::Gap { momentum, restarts } => {
                let prior = on_sensor(denoiser, demosaicer);
                let gap = match momentum {
                    Some(start) => admm::Gap::with_momentum(prior, start),
                    None => admm::Gap::plain(prior),
                };
                Box::new(if restarts { gap.restarting() } else { gap })
            }
            Method::Admm { gamma } => Box::new(admm::Admm::new(on_sensor(denoiser, demosaicer), gamma)),
            Method::TwoStage { params, x_step } => {
                let cfa = cfa.ok_or_else(|| Refused("sci.TwoStage is for color sensors: give cfa".into()))?;
                Box::new(admm::TwoStage::new(denoiser, demosaicer, x_step, cfa, params))
            }
        })
    }
}

/// Where a solve begins.
enum Begin {
    Mean,
    Adjoint,
    From(Array3<f32>),
}

impl Begin {
    fn of(start: Option<&Bound<'_, PyAny>>) -> PyResult<Self> {
        let Some(start) = start else { return Ok(Self::Mean) };
        match start.extract::<String>() {
            Ok(name) if name == "mean" => Ok(Self::Mean),
            Ok(name) if name == "adjoint" => Ok(Self::Adjoint),
            Ok(name) => {
                Err(refused(format!("start = {name:?} is not legal; legal: \"mean\", \"adjoint\", an array [T, H, W]")))
            }
            Err(_) => {
                let video = array::<Ix3>("start", start, "[T, H, W]")?;
                Ok(Self::From(row_major(video.as_array()).into_owned()))
            }
        }
    }

    fn start(&self) -> Start<'_> {
        match self {
            Self::Mean => Start::Mean,
            Self::Adjoint => Start::Adjoint,
            Self::From(video) => Start::From(video.view()),
        }
    }
}

/// Calls back after every iteration, and ends the solve on Ctrl-C.
struct Watch<'s> {
    callback: Option<Py<PyAny>>,
    stop: &'s Stop,
}

impl Observer for Watch<'_> {
    fn iteration(&mut self, it: &IterInfo<'_>) -> Result<ControlFlow<()>, BoxError> {
        let wished = match &self.callback {
            Some(callback) => Python::attach(|py| {
                let video = out(py, it.estimate.sensor.clone());
                callback.call1(py, (it.iteration, video))?.is_truthy(py)
            })?,
            None => false,
        };
        Ok(if wished || self.stop.is_set() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
    }
}

/// As records name it.
fn named(stop: StopReason) -> &'static str {
    match stop {
        StopReason::ScheduleDone => "schedule_done",
        StopReason::Converged => "converged",
        StopReason::Stalled => "stalled",
        StopReason::Diverged => "diverged",
        StopReason::TimeUp => "time_up",
        StopReason::Observer => "observer",
    }
}

fn choice<T: Copy>(name: &str, given: &str, legal: &[(&str, T)]) -> PyResult<T> {
    let found = legal.iter().find(|(known, _)| *known == given).map(|(_, value)| *value);
    let names: Vec<&str> = legal.iter().map(|(name, _)| *name).collect();
    found.ok_or_else(|| refused(format!("{name} = {given:?} is not legal; legal: {}", names.join(", "))))
}

fn at_least_zero(name: &str, value: f32, above: bool) -> PyResult<()> {
    if value.is_finite() && (value > 0.0 || value == 0.0 && !above) {
        return Ok(());
    }
    let legal = if above { "a finite number above 0" } else { "a finite number of at least 0" };
    Err(refused(format!("{name} = {value} is not legal; legal: {legal}")))
}
