//! `reconstruct`: an experiment on arrays.

use std::path::PathBuf;
use std::time::Instant;

use admm::Estimate;
use ndarray::{ArrayD, Axis, IxDyn, concatenate};
use numpy::PyArrayDyn;
use pyo3::exceptions::{PyRuntimeWarning, PyUserWarning};
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict};
use sci_cli::config::{self, Experiment};
use sci_cli::factory::Factory;
use sci_cli::io::scene::{self, Arrays, Scene};
use sci_cli::record::{Record, Stop as Ended};
use sci_cli::solve::{self, Show};

use crate::arrays::{from_json, out, stored};
use crate::failure::{Refused, callers, raised};
use crate::pool::{self, Stop};
use crate::settings;

/// Reconstructs the video behind measurements, as `sci run` does with the same experiment.
///
/// Parameters
/// ----------
/// measurement : array, [H, W] or [N, H, W]
///     What the camera measured: the sum of T frames, each through its mask. Any real number type; white is 255 in arrays of bytes and 1
///     in arrays of floats unless the numbers say otherwise, which is said in a warning; data={"scale": 4095} decides.
/// masks : array, [T, H, W]
///     Transmittances, any number type.
/// config : str or path
///     An experiment file, or the name of one that comes with the program (sci.experiments() lists them). Color sensors:
///     config="color/default", data={"cfa": "rggb"}.
/// truth : array or None, [N·T, H, W], in color [N·T, 3, H, W] or [N·T, H, W, 3]
///     If it is known, the record has PSNR and SSIM. A truth in color makes the sensor a color one.
/// progress : bool or callable
///     True draws a bar on sys.stderr. A callable is called as progress(measurement, done, iterations, psnr_db) after every iteration.
/// **settings
///     Any key of experiment files, with their units (σ from 0 to 255): seed=3, denoiser={"dim": 2}, **{"stop.seconds": 10}. A
///     dictionary changes keys of a table; with a "kind" it replaces the table.
///
/// Returns
/// -------
/// frames : array of float32, [N·T, H, W], of color sensors [N·T, 3, H, W]
///     White is 1 (or what it is in the measurements, where that was far off).
/// record : dict
///     What `sci run` writes to record.json: for each of record["measurements"] its psnr_db, ssim, ssim_gaussian, seconds, iterations,
///     stop, relative_residual and trace, and the experiment with every default.
///
/// Raises
/// ------
/// ValueError
///     For what is not legal in the experiment, its settings or the arrays; the message says what is.
/// KeyboardInterrupt
///     After Ctrl-C, at the end of the iteration in work.
///
/// Warns
/// -----
/// UserWarning
///     For what looks odd about the arrays.
/// RuntimeWarning
///     If a measurement diverged; the frames are then the last good estimate.
#[pyfunction]
#[pyo3(signature = (measurement, masks, config=PathBuf::from("gray/default"), truth=None, progress=None, **settings),
       text_signature = "(measurement, masks, config=\"gray/default\", truth=None, progress=True, **settings)")]
pub(crate) fn reconstruct<'py>(
    py: Python<'py>,
    measurement: &Bound<'py, PyAny>,
    masks: &Bound<'py, PyAny>,
    config: PathBuf,
    truth: Option<&Bound<'py, PyAny>>,
    progress: Option<&Bound<'py, PyAny>>,
    settings: Option<&Bound<'py, PyDict>>,
) -> PyResult<(Bound<'py, PyArrayDyn<f32>>, Bound<'py, PyAny>)> {
    let begin = Instant::now();
    let arrays = Arrays {
        mask: stored("masks", masks)?,
        meas: Some(stored("measurement", measurement)?),
        truth: truth.map(|truth| stored("truth", truth)).transpose()?,
    };
    let arguments = [vec!["data.path='arrays'".to_owned()], settings::arguments(settings)?].concat();
    let experiment = config::load_for_arrays(&config, &arguments).map_err(|e| raised(e.into()))?;
    let scene = scene::of_arrays(arrays, &experiment.data.reading).map_err(|e| raised(e.into()))?;
    say(py, &scene.warnings, &py.get_type::<PyUserWarning>())?;
    let show = Shown { callback: callback(py, progress)?, raised: None };
    let solved = pool::run(py, |stop| solve(&experiment, scene, show, stop, begin))?.map_err(raised)?;
    say(py, solved.note.as_slice(), &py.get_type::<PyUserWarning>())?;
    let diverged = solved.record.measurements.iter().filter(|m| m.stop == Ended::Diverged);
    let advice: Vec<String> = diverged.map(|m| solve::advice(m, &experiment)).collect();
    say(py, &advice, &py.get_type::<PyRuntimeWarning>())?;
    Ok((out(py, solved.frames), from_json(py, &solved.record.to_json())?))
}

struct Solved {
    frames: ArrayD<f32>,
    record: Record,
    /// What there is to say of pixels.
    note: Option<String>,
}

/// What `sci run` does, without a folder.
fn solve(
    experiment: &Experiment,
    mut scene: Scene,
    mut show: Shown,
    stop: &Stop,
    begin: Instant,
) -> anyhow::Result<Solved> {
    let chosen = solve::choose(experiment, scene.len()).map_err(Refused)?;
    let mut look =
        |_, _| if stop.is_set() { std::ops::ControlFlow::Break(()) } else { std::ops::ControlFlow::Continue(()) };
    let (calibration, note) = solve::calibrate(experiment, &mut scene, &chosen, &mut look)?.unzip();
    let mut factory = Factory::new(experiment, scene.cfa).map_err(callers)?;
    let (mut records, mut videos) = (Vec::new(), Vec::new());
    let mut previous = None;
    let iterations = factory.plan().iterations();
    for (i, &measurement) in chosen.iter().enumerate() {
        let before = previous.as_ref().map(|sensor: &ndarray::Array3<f32>| sensor.view());
        let mut follow = Following { show: &mut show, stop, measurement, iterations };
        let (record, estimate) = solve::measurement(&mut factory, &scene, &chosen[i..], before, &mut follow)?;
        if let Some(raised) = show.raised.take() {
            return Err(raised.into());
        }
        records.push(record);
        previous = factory.needs_previous().then(|| estimate.sensor.clone());
        videos.push(shown(estimate));
        if stop.is_set() {
            break;
        }
    }
    let frames = joined(videos)? * scene.unit;
    let record = solve::record(experiment, &factory, records, Vec::new(), calibration, begin)?;
    Ok(Solved { frames, record, note: note.flatten() })
}

/// `[T, H, W]`, in color `[T, 3, H, W]`, in the memory that it has.
fn shown(estimate: Estimate) -> ArrayD<f32> {
    match estimate.rgb {
        Some(rgb) => rgb.into_dyn(),
        None => estimate.sensor.into_dyn(),
    }
}

/// One after the other; a single one as it is.
fn joined(mut videos: Vec<ArrayD<f32>>) -> anyhow::Result<ArrayD<f32>> {
    match videos.len() {
        0 => Ok(ArrayD::zeros(IxDyn(&[0, 0, 0]))),
        1 => Ok(videos.swap_remove(0)),
        _ => Ok(concatenate(Axis(0), &videos.iter().map(|v| v.view()).collect::<Vec<_>>())?),
    }
}

/// Whom the progress is told, and what that raised.
pub(crate) struct Shown {
    callback: Option<Py<PyAny>>,
    raised: Option<PyErr>,
}

struct Following<'s> {
    show: &'s mut Shown,
    stop: &'s Stop,
    measurement: usize,
    iterations: usize,
}

impl Show for Following<'_> {
    /// Updates before a solve have no share of its iterations.
    fn update(&mut self, _done: usize) {}

    fn step(&mut self, done: usize, psnr_db: Option<f64>) {
        let Some(callback) = &self.show.callback else { return };
        let told = Python::attach(|py| callback.call1(py, (self.measurement, done, self.iterations, psnr_db)));
        if let Err(raised) = told {
            self.show.raised.get_or_insert(raised);
        }
    }

    fn stopped(&self) -> bool {
        self.stop.is_set() || self.show.raised.is_some()
    }
}

/// What `progress` names: a callable as it is, a bar for True, which is the default, nothing for False and None.
pub(crate) fn callback(py: Python<'_>, progress: Option<&Bound<'_, PyAny>>) -> PyResult<Option<Py<PyAny>>> {
    let bar = || Ok(Some(py.import(intern!(py, "sci._progress"))?.call_method0(intern!(py, "Bar"))?.unbind()));
    match progress {
        None => bar(),
        Some(progress) if progress.is_none() => Ok(None),
        Some(progress) => match progress.cast::<PyBool>() {
            Ok(wanted) if wanted.is_true() => bar(),
            Ok(_) => Ok(None),
            Err(_) => Ok(Some(progress.clone().unbind())),
        },
    }
}

/// Warns of each.
pub(crate) fn say(py: Python<'_>, warnings: &[String], category: &Bound<'_, PyAny>) -> PyResult<()> {
    let warn = py.import(intern!(py, "warnings"))?.getattr(intern!(py, "warn"))?;
    warnings.iter().try_for_each(|text| warn.call1((text, category)).map(drop))
}
