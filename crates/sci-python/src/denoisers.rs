//! Denoisers: the program's for loops in Python, and any callable of Python for the program's loops.

use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::thread::ThreadId;

use admm::{BoxError, Call};
use ndarray::{Array4, ArrayView4, ArrayViewMut4, Axis, Ix4, IxDyn};
use numpy::{PyArray4, PyArrayDyn, PyArrayMethods, PyUntypedArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sci_cli::parts::{self, Built, MultiplyAdds, Saving, Site};
use sci_cli::table::{Paths, Source, Table};
use sci_forward::CfaPattern;

use crate::arrays::{array, floats, out, row_major};
use crate::failure::{callers, in_units_of_white, raised, refused};
use crate::settings;

/// A denoiser of the program, for its solvers and for loops of your own: denoiser(noisy, sigma).
///
/// Parameters
/// ----------
/// kind : str
///     As denoiser.kind in experiment files: "ffdnet", "fastdvdnet", "tv", "wnnm".
/// color : bool
///     Whether videos have three channels. Networks are made for one or the other.
/// **keys
///     The other keys of [denoiser]: weights="bundled:fastdvdnet_gray" (or a .pth or .safetensors file), precision="bf16", flips=True,
///     weight=0.1 ...
///
/// Examples
/// --------
/// >>> denoise = sci.Denoiser("fastdvdnet", weights="bundled:fastdvdnet_gray")
/// >>> clean = denoise(noisy, 25 / 255)
#[pyclass(frozen, module = "sci")]
pub(crate) struct Denoiser {
    kind: &'static str,
    color: bool,
    has_sigma: bool,
    built: Mutex<Box<dyn Built>>,
    /// The thread that has it.
    holder: Mutex<Option<ThreadId>>,
}

#[pymethods]
impl Denoiser {
    #[new]
    #[pyo3(signature = (kind, *, color=false, **keys))]
    fn new(py: Python<'_>, kind: &str, color: bool, keys: Option<&Bound<'_, PyDict>>) -> PyResult<Self> {
        let arguments = [vec![format!("denoiser.kind={kind:?}")], settings::of_table("denoiser", keys)?].concat();
        py.detach(|| Self::of(&arguments, color)).map_err(raised)
    }

    /// Removes noise of standard deviation sigma.
    ///
    /// Parameters
    /// ----------
    /// noisy : array of floats, [T, C, H, W], C = 3 in color, else 1; gray also [T, H, W]
    ///     White at 1; values may lie beyond 0 and 1.
    /// sigma : float, 0 to 1, or None
    ///     In units of white: 25 / 255, not 25. None for those with a strength of their own, such as "tv".
    /// iteration : int
    ///     Where in a loop it is called; with flips=True the video is seen another way round in every one.
    ///
    /// Returns
    /// -------
    /// array of float32, of the shape of noisy
    ///     Not clipped.
    #[pyo3(signature = (noisy, sigma=None, iteration=0))]
    fn __call__<'py>(
        &self,
        py: Python<'py>,
        noisy: &Bound<'py, PyAny>,
        sigma: Option<f32>,
        iteration: usize,
    ) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let sigma = self.checked(sigma)?;
        let axes = if self.color { "[T, 3, H, W]" } else { "[T, 1, H, W] or [T, H, W]" };
        let x = array::<IxDyn>("noisy", noisy, axes)?;
        let x = x.as_array();
        let shape = x.shape().to_vec();
        let (x, channels) =
            if x.ndim() == 3 { (x.insert_axis(Axis(1)), 1) } else { (x, if self.color { 3 } else { 1 }) };
        let x = x.into_dimensionality::<Ix4>().ok().filter(|x| x.len_of(Axis(1)) == channels && !x.is_empty());
        let x = x.filter(|_| !self.color || shape.len() == 4);
        let x = row_major(x.ok_or_else(|| refused(format!("`noisy` has shape {shape:?}, expected {axes}")))?);
        let clean = py.detach(|| {
            let mut clean = Array4::zeros(x.dim());
            let call = Call { sigma, iteration, ..Call::default() };
            let (mut held, mut saving) = (self.lock()?, Saving::default());
            held.built.on_frames(&mut saving).denoise(&call, x.view(), clean.view_mut()).map_err(boxed)?;
            anyhow::Ok(clean)
        });
        let clean = clean.map_err(raised)?.into_shape_with_order(IxDyn(&shape));
        Ok(out(py, clean.map_err(|e| refused(e.to_string()))?))
    }

    /// Its kind, as in experiment files.
    #[getter]
    fn kind(&self) -> &'static str {
        self.kind
    }

    fn __repr__(&self) -> String {
        format!("Denoiser({:?}, color={})", self.kind, if self.color { "True" } else { "False" })
    }
}

impl Denoiser {
    fn of(arguments: &[String], color: bool) -> anyhow::Result<Self> {
        let source = Source::new(Path::new("denoiser"), "", arguments, &|_| Err("there is no file".into()))?;
        let (table, _) = Table::root(&source, Paths::LookedUp)?.read(|t| t.table_or_empty("denoiser"))?;
        let chosen = parts::read(table)?;
        let work = MultiplyAdds::default();
        let cfa = color.then(CfaPattern::default);
        let built = chosen.part.build(&Site { cfa, adapt: Default::default(), work: &work });
        let built = built.map_err(callers)?;
        let has_sigma = chosen.part.instead_of_sigma().is_none();
        Ok(Self { kind: chosen.kind, color, has_sigma, built: Mutex::new(built), holder: Mutex::new(None) })
    }

    fn checked(&self, sigma: Option<f32>) -> PyResult<Option<f32>> {
        match sigma {
            None if self.has_sigma => {
                Err(refused(format!("{} needs sigma, a number from 0 to 1 (25 / 255, not 25)", self.kind)))
            }
            Some(_) if !self.has_sigma => {
                Err(refused(format!("{} has a strength of its own, and no sigma", self.kind)))
            }
            sigma => sigma.map(|sigma| in_units_of_white("sigma", f64::from(sigma)).map(|()| sigma)).transpose(),
        }
    }

    /// One call at a time; other threads wait. A callback of the solve that has it would wait for ever.
    fn lock(&self) -> anyhow::Result<Held<'_>> {
        let holder = || self.holder.lock().unwrap_or_else(PoisonError::into_inner);
        if *holder() == Some(std::thread::current().id()) {
            anyhow::bail!(
                "this sci.Denoiser is at work in the solve that calls back; make another one for the callback"
            );
        }
        // What a panic left is overwritten by the next call.
        let built = self.built.lock().unwrap_or_else(PoisonError::into_inner);
        *holder() = Some(std::thread::current().id());
        Ok(Held { built, holder: &self.holder })
    }
}

/// A denoiser that this thread has, until it is dropped.
struct Held<'d> {
    built: MutexGuard<'d, Box<dyn Built>>,
    holder: &'d Mutex<Option<ThreadId>>,
}

impl Drop for Held<'_> {
    fn drop(&mut self) {
        *self.holder.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }
}

fn boxed(error: BoxError) -> anyhow::Error {
    anyhow::Error::from_boxed(error)
}

/// What a solver is given to denoise with.
pub(crate) enum Plugged {
    Ours(Py<Denoiser>),
    Callable(Py<PyAny>),
}

impl Plugged {
    /// The program's own, or any callable.
    pub(crate) fn new(any: &Bound<'_, PyAny>) -> PyResult<Self> {
        if let Ok(ours) = any.cast::<Denoiser>() {
            return Ok(Self::Ours(ours.clone().unbind()));
        }
        if !any.is_callable() {
            return Err(refused(format!(
                "denoiser = {any}: expected a sci.Denoiser or a callable denoiser(noisy, sigma)"
            )));
        }
        Ok(Self::Callable(any.clone().unbind()))
    }

    /// Checks what is known before a solve: the σ of its stages, and whether it is for color.
    pub(crate) fn check(&self, sigmas: impl IntoIterator<Item = Option<f32>>, color: bool) -> PyResult<()> {
        let Self::Ours(ours) = self else { return Ok(()) };
        let ours = ours.get();
        if ours.color != color {
            let (is, needed) = if color { ("gray", "True") } else { ("color", "False") };
            return Err(refused(format!("the denoiser is for {is} videos: make it with color={needed}")));
        }
        sigmas.into_iter().try_for_each(|sigma| ours.checked(sigma).map(drop))
    }

    /// Hands the denoiser of a solve to `solve`.
    pub(crate) fn with<T>(
        &self,
        solve: impl FnOnce(&mut dyn admm::Denoiser) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        match self {
            Self::Ours(ours) => {
                let mut held = ours.get().lock()?;
                let mut saving = Saving::default();
                let mut denoiser = held.built.on_frames(&mut saving);
                solve(denoiser.as_mut())
            }
            Self::Callable(callable) => solve(&mut Callable(callable)),
        }
    }
}

/// A callable of Python, denoiser(noisy, sigma), with arrays [T, C, H, W] in and out.
struct Callable<'c>(&'c Py<PyAny>);

impl admm::Denoiser for Callable<'_> {
    fn name(&self) -> &str {
        "of Python"
    }

    fn denoise(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        Python::attach(|py| {
            // The callable may keep what it is given, so that it gets an array of its own.
            let given = PyArray4::from_array(py, &noisy);
            let returned = floats("what the denoiser returned", &self.0.bind(py).call1((given, call.sigma))?)?;
            if returned.shape() != noisy.shape() {
                let (found, expected) = (returned.shape(), noisy.shape());
                return Err(refused(format!(
                    "the denoiser returned shape {found:?}, expected {expected:?}: [T, C, H, W] as it was given"
                )));
            }
            out.assign(&returned.try_readonly()?.as_array());
            Ok(())
        })
        .map_err(BoxError::from)
    }
}
