//! Owns the way of arrays: in from whatever NumPy makes an array of, out as the memory they were made in.

use ndarray::{Array, ArrayView, CowArray, Dimension};
use numpy::{
    PyArray, PyArrayDescrMethods, PyArrayDyn, PyArrayMethods, PyReadonlyArray, PyUntypedArray, PyUntypedArrayMethods,
};
use pyo3::IntoPyObjectExt;
use pyo3::intern;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use sci_cli::io::samples::{self, SampleType, Samples};

use crate::failure::refused;

/// An array as NumPy has it, or makes of it, whatever its number type.
fn untyped<'py>(any: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyUntypedArray>> {
    let numpy = any.py().import(intern!(any.py(), "numpy"))?;
    Ok(numpy.call_method1(intern!(any.py(), "asarray"), (any,))?.cast_into::<PyUntypedArray>()?)
}

/// `name` as f32, a view if it is f32 already.
pub(crate) fn floats<'py>(name: &str, any: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
    let array = untyped(any)?;
    let kind = array.dtype().kind();
    if !b"biuf".contains(&kind) {
        return Err(refused(format!("`{name}` holds {}, expected real numbers", array.dtype())));
    }
    let options = PyDict::new(any.py());
    options.set_item("dtype", numpy::dtype::<f32>(any.py()))?;
    let numpy = any.py().import(intern!(any.py(), "numpy"))?;
    Ok(numpy.call_method(intern!(any.py(), "asarray"), (array,), Some(&options))?.cast_into::<PyArrayDyn<f32>>()?)
}

/// `name` as f32 with the number of axes of `D`, which `axes` names.
pub(crate) fn array<'py, D: Dimension>(
    name: &str,
    any: &Bound<'py, PyAny>,
    axes: &str,
) -> PyResult<PyReadonlyArray<'py, f32, D>> {
    let found = floats(name, any)?;
    let wrong = refused(format!("`{name}` has shape {:?}, expected {axes}", found.shape()));
    let array = found.cast_into::<PyArray<f32, D>>().map_err(|_| wrong)?;
    Ok(array.try_readonly()?)
}

/// Row-major; a copy only of what is not.
pub(crate) fn row_major<'a, D: Dimension>(view: ArrayView<'a, f32, D>) -> CowArray<'a, f32, D> {
    if view.is_standard_layout() { view.into() } else { view.as_standard_layout().into_owned().into() }
}

/// Says that two sizes differ which must not.
pub(crate) fn must_be(name: &str, found: &[usize], expected: &[usize], why: &str) -> PyResult<()> {
    if found == expected {
        return Ok(());
    }
    Err(refused(format!("`{name}` has shape {found:?}, expected {expected:?}, {why}")))
}

/// The array as a file of its number type would hold it, so that its scale is judged as that of a file.
pub(crate) fn stored(name: &str, any: &Bound<'_, PyAny>) -> PyResult<samples::Array> {
    let array = untyped(any)?;
    let dtype = array.dtype();
    let kind = stored_as(dtype.kind(), dtype.itemsize());
    let Some(kind) = kind else { return Err(refused(format!("`{name}` holds {dtype}, expected real numbers"))) };
    let shape = array.shape().to_vec();
    let samples = if kind == SampleType::U8 {
        let bytes = array.call_method1(intern!(any.py(), "astype"), (numpy::dtype::<u8>(any.py()),))?;
        Samples::Bytes(bytes.cast_into::<PyArrayDyn<u8>>()?.try_readonly()?.as_array().iter().copied().collect())
    } else {
        Samples::Floats(floats(name, array.as_any())?.try_readonly()?.as_array().iter().copied().collect())
    };
    samples::Array::new(shape, samples, kind).map_err(|e| refused(format!("`{name}`: {e}")))
}

fn stored_as(kind: u8, bytes: usize) -> Option<SampleType> {
    Some(match (kind, bytes) {
        (b'b', _) | (b'u', 1) => SampleType::U8,
        (b'u', 2) => SampleType::U16,
        (b'u', 4) => SampleType::U32,
        (b'u', _) => SampleType::U64,
        (b'i', 1) => SampleType::I8,
        (b'i', 2) => SampleType::I16,
        (b'i', 4) => SampleType::I32,
        (b'i', _) => SampleType::I64,
        (b'f', 2) => SampleType::F16,
        (b'f', 4) => SampleType::F32,
        (b'f', _) => SampleType::F64,
        _ => return None,
    })
}

/// An array as one of NumPy's, in the same memory.
pub(crate) fn out<'py, D: Dimension>(py: Python<'py>, array: Array<f32, D>) -> Bound<'py, PyArray<f32, D>> {
    PyArray::from_owned_array(py, array)
}

/// JSON as what Python's json makes of it.
pub(crate) fn from_json<'py>(py: Python<'py>, text: &str) -> PyResult<Bound<'py, PyAny>> {
    py.import(intern!(py, "json"))?.call_method1(intern!(py, "loads"), (text,))?.into_bound_py_any(py)
}
