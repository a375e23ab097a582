//! `calibrate`: how masks really sit.

use std::ops::ControlFlow;

use numpy::PyArray3;
use pyo3::exceptions::PyUserWarning;
use pyo3::prelude::*;
use sci_cli::calibration;
use sci_cli::io::scene::{self, Arrays, Reading};

use crate::arrays::{from_json, out, stored};
use crate::failure::raised;
use crate::operator::pattern;
use crate::pool;
use crate::reconstruct::say;

/// Finds how the masks really sit, from measurements alone, as `sci calibrate` does: what explains each pixel best from the brightness around it
/// is taken.
///
/// Parameters
/// ----------
/// measurement : array, [H, W] or [N, H, W]
///     Any number type; the first three are looked at.
/// masks : array, [T, H, W]
///     As they were told.
/// cfa : "rggb", "bggr", "grbg", "gbrg" or None
///     The Bayer pattern of a color sensor.
/// reach : float, 0 to 16
///     Farthest shift in pixels.
/// clock : bool
///     Look for a share of the neighbouring frame too (found too large where much moves).
///
/// Returns
/// -------
/// masks : array of float32, [T, H, W]
///     As they are. Pixels that are not to be used are closed in all frames.
/// calibration : dict
///     Each parameter with its uncertainty. Written to a file by json.dump it is what data.calibration of an experiment takes; its
///     "black" times "white" is to be taken off measurements that are solved otherwise.
#[pyfunction]
#[pyo3(signature = (measurement, masks, *, cfa=None, reach=2.0, clock=false))]
pub(crate) fn calibrate<'py>(
    py: Python<'py>,
    measurement: &Bound<'py, PyAny>,
    masks: &Bound<'py, PyAny>,
    cfa: Option<&str>,
    reach: f64,
    clock: bool,
) -> PyResult<(Bound<'py, PyArray3<f32>>, Bound<'py, PyAny>)> {
    let (mask, meas) = (stored("masks", masks)?, Some(stored("measurement", measurement)?));
    let reading = Reading { cfa: pattern(cfa)?, masks_off: 1, ..Reading::default() };
    let scene = scene::of_arrays(Arrays { mask, meas, truth: None }, &reading).map_err(|e| raised(e.into()))?;
    say(py, &scene.warnings, &py.get_type::<PyUserWarning>())?;
    let settings = admm::Calibration { reach, clock, ..admm::Calibration::default() };
    let chosen: Vec<usize> = (0..scene.len()).collect();
    let found = pool::run(py, |stop| {
        let mut watch = |_, _| if stop.is_set() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
        let found = calibration::find(&scene, &chosen, &settings, &mut watch)?;
        Ok((found.masks(&scene)?, found))
    })?;
    let (masks, found) = found.map_err(raised)?;
    Ok((out(py, masks.view().to_owned()), from_json(py, &found.to_json())?))
}
