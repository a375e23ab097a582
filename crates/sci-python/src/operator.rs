//! The forward model: masks, the operator of masks, simulation.

use std::sync::Arc;

use ndarray::{Axis, Ix2, Ix3, IxDyn};
use numpy::{PyArray2, PyArray3};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sci_cli::config::PATTERNS;
use sci_cli::config::camera::of_arguments;
use sci_cli::io::scene::{Keys, Truth, operator_of};
use sci_cli::simulate::Camera;
use sci_forward::{CfaPattern, MaskStack, Noise, SensingOperator, VideoShape};

use crate::arrays::{array, must_be, out, row_major};
use crate::failure::{in_units_of_white, raised, refused};
use crate::settings;

const VIDEO: &str = "[T, H, W]";

/// The forward model y = H x = Σ_t C_t ⊙ x_t of masks C.
///
/// Parameters
/// ----------
/// masks : array, [T, H, W]
///     Transmittances, usually 0 to 1; of a differential camera of both signs. Stored as a bit a pixel where all are 0 or 1.
#[pyclass(frozen, module = "sci")]
pub(crate) struct MaskOperator {
    pub(crate) operator: Arc<dyn SensingOperator>,
}

#[pymethods]
impl MaskOperator {
    #[new]
    fn new(masks: &Bound<'_, PyAny>) -> PyResult<Self> {
        Ok(Self { operator: operator_of(mask_stack(masks)?) })
    }

    /// (T, H, W): the frames that a measurement sums, rows, columns.
    #[getter]
    fn shape(&self) -> (usize, usize, usize) {
        self.operator.shape().dim()
    }

    /// The masks C, [T, H, W], a new array.
    #[getter]
    fn masks<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let source = self.operator.masks().ok_or_else(|| refused("the operator has no masks"))?;
        let masks = MaskStack::from_source(source).map_err(|e| raised(e.into()))?;
        Ok(out(py, masks.view().to_owned()))
    }

    /// diag(H Hᵀ) = Σ_t C_t², [H, W], a new array; exactly 0 where it is too small to divide by.
    #[getter]
    fn gram<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f32>> {
        out(py, self.operator.gram().to_owned())
    }

    /// y = H x: the measurement [H, W] of a video [T, H, W].
    fn forward<'py>(&self, py: Python<'py>, video: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let x = array::<Ix3>("video", video, VIDEO)?;
        let x = x.as_array();
        let (t, h, w) = self.shape();
        must_be("video", x.shape(), &[t, h, w], "that of the masks")?;
        Ok(out(py, py.detach(|| self.operator.forward(row_major(x).view()))))
    }

    /// x = Hᵀ y: C_t ⊙ y for each frame, [T, H, W], of a measurement [H, W].
    fn adjoint<'py>(&self, py: Python<'py>, measurement: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray3<f32>>> {
        let y = array::<Ix2>("measurement", measurement, "[H, W]")?;
        let y = y.as_array();
        let (_, h, w) = self.shape();
        must_be("measurement", y.shape(), &[h, w], "that of a mask")?;
        Ok(out(py, py.detach(|| self.operator.adjoint(row_major(y).view()))))
    }

    fn __repr__(&self) -> String {
        format!("MaskOperator({})", self.operator.shape())
    }
}

/// Masks as the library has them.
pub(crate) fn mask_stack(masks: &Bound<'_, PyAny>) -> PyResult<MaskStack> {
    let masks = array::<Ix3>("masks", masks, VIDEO)?;
    MaskStack::new(row_major(masks.as_array()).into_owned()).map_err(|e| raised(e.into()))
}

/// An operator as it is, or that of masks.
pub(crate) fn operator(any: &Bound<'_, PyAny>) -> PyResult<Arc<dyn SensingOperator>> {
    match any.cast::<MaskOperator>() {
        Ok(found) => Ok(Arc::clone(&found.get().operator)),
        Err(_) => Ok(operator_of(mask_stack(any)?)),
    }
}

/// "rggb" and its like; `None` for a gray sensor.
pub(crate) fn pattern(cfa: Option<&str>) -> PyResult<Option<CfaPattern>> {
    let known = |name: &str| PATTERNS.iter().find(|(known, _)| *known == name).map(|(_, pattern)| *pattern);
    let illegal =
        |name: &str| format!("cfa = {name:?} is not legal; legal: \"rggb\", \"bggr\", \"grbg\", \"gbrg\", None");
    cfa.map(|name| known(name).ok_or_else(|| refused(illegal(name)))).transpose()
}

/// Masks whose pixels open independently of each other, [T, H, W], 0 or 1.
///
/// Parameters
/// ----------
/// shape : (T, H, W)
///     Frames that a measurement sums, rows, columns.
/// density : float, above 0, at most 1
///     Share of open pixels.
/// seed : int
///     The same seed gives the same masks, on every machine.
#[pyfunction]
#[pyo3(signature = (shape, density=0.5, seed=0))]
pub(crate) fn random_masks(
    py: Python<'_>,
    shape: (usize, usize, usize),
    density: f64,
    seed: u64,
) -> PyResult<Bound<'_, PyArray3<f32>>> {
    masks(py, shape, |shape| MaskStack::random(shape, density, seed))
}

/// One random pattern that moves to the left by a pixel a frame, [T, H, W], 0 or 1. Parameters as for random_masks.
#[pyfunction]
#[pyo3(signature = (shape, density=0.5, seed=0))]
pub(crate) fn shifting_masks(
    py: Python<'_>,
    shape: (usize, usize, usize),
    density: f64,
    seed: u64,
) -> PyResult<Bound<'_, PyArray3<f32>>> {
    masks(py, shape, |shape| MaskStack::shifting(shape, density, seed))
}

fn masks(
    py: Python<'_>,
    (frames, height, width): (usize, usize, usize),
    make: impl FnOnce(VideoShape) -> Result<MaskStack, sci_forward::MaskError>,
) -> PyResult<Bound<'_, PyArray3<f32>>> {
    // Any larger one is a mistake, and would ask for memory that no machine has.
    const MOST: usize = 1 << 34;
    let count = frames.checked_mul(height).and_then(|n| n.checked_mul(width)).filter(|&n| n <= MOST);
    if count.is_none() {
        return Err(refused(format!("shape = {frames}, {height}, {width}: at most {MOST} values in all")));
    }
    let made = make(VideoShape { frames, height, width }).map_err(|e| raised(e.into()))?;
    Ok(out(py, made.view().to_owned()))
}

/// Measures a video as a camera would: N = frames of the video / T measurements y = Σ_t C_t ⊙ x_t + noise.
///
/// Parameters
/// ----------
/// video : array of floats, [N·T, H, W], or in color [N·T, 3, H, W]
///     In [0, 1]. Color needs cfa.
/// masks : array, [T, H, W]
///     Those that the camera is told to have.
/// cfa : "rggb", "bggr", "grbg", "gbrg" or None
///     The Bayer pattern of a color sensor.
/// sigma : float, 0 to 1
///     Standard deviation of Gaussian noise, in units of white of one frame.
/// photons : float or None
///     Photons that a pixel counts at full scale of one frame, for shot noise.
/// seed : int
///     Of everything random.
/// **camera
///     What else the camera does, as in [data.camera] of an experiment file: shift=[0.3, 0.5], rotation, scale, blur, clock, contrast,
///     flicker, gain, black, full, bits, dead, hot.
///
/// Returns
/// -------
/// array of float32, [N, H, W]
///     Up to Σ_t C_t; frames that fill no measurement are left out.
#[pyfunction]
#[pyo3(signature = (video, masks, *, cfa=None, sigma=0.0, photons=None, seed=0, **camera))]
#[expect(clippy::too_many_arguments, reason = "keyword arguments of Python")]
pub(crate) fn simulate<'py>(
    py: Python<'py>,
    video: &Bound<'py, PyAny>,
    masks: &Bound<'py, PyAny>,
    cfa: Option<&str>,
    sigma: f64,
    photons: Option<f64>,
    seed: u64,
    camera: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyArray3<f32>>> {
    const AXES: &str = "[T, H, W] or, with cfa, [T, 3, H, W]";
    let (cfa, masks) = (pattern(cfa)?, mask_stack(masks)?);
    let x = array::<IxDyn>("video", video, AXES)?;
    let x = row_major(x.as_array()).into_owned();
    let shape = x.shape().to_vec();
    let truth = match (x.ndim(), cfa) {
        (3, _) => x.into_dimensionality().ok().map(Truth::Sensor),
        (4, Some(_)) if x.len_of(Axis(1)) == 3 => x.into_dimensionality().ok().map(Truth::Rgb),
        _ => None,
    };
    let truth = truth.ok_or_else(|| refused(format!("`video` has shape {shape:?}, expected {AXES}")))?;
    in_units_of_white("sigma", sigma)?;
    let noise = Noise::new(photons, sigma).map_err(|e| raised(e.into()))?;
    let (optics, readout) = of_arguments(&settings::arguments(camera)?, noise).map_err(|e| raised(e.into()))?;
    let camera = Camera { optics, readout, seed };
    let keys = Keys { mask: "masks".into(), orig: "video".into(), rgb: "video".into(), ..Keys::default() };
    let scene =
        py.detach(|| sci_cli::simulate::simulate("arrays", &keys, masks, truth, cfa, &camera)).map_err(raised)?;
    Ok(out(py, scene.measurements))
}
