//! Owns how keyword arguments become what `--set` says.

use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict, PyFloat, PyInt, PyString};
use toml::Value;

use crate::failure::refused;

/// The `--set` arguments of settings such as `seed=3`, `denoiser={"dim": 2}` or `**{"data.cfa": "rggb"}`, in their order.
///
/// A dictionary changes keys of a table, but one that names a `kind` is a table of its own, as in a file that extends another.
pub(crate) fn arguments(settings: Option<&Bound<'_, PyDict>>) -> PyResult<Vec<String>> {
    let mut found = Vec::new();
    settings.map_or(Ok(()), |settings| collect("", settings, &mut found))?;
    Ok(found)
}

/// The same for the keys of one table.
pub(crate) fn of_table(table: &str, settings: Option<&Bound<'_, PyDict>>) -> PyResult<Vec<String>> {
    let mut found = Vec::new();
    settings.map_or(Ok(()), |settings| collect(&format!("{table}."), settings, &mut found))?;
    Ok(found)
}

fn collect(above: &str, settings: &Bound<'_, PyDict>, found: &mut Vec<String>) -> PyResult<()> {
    for (name, value) in settings {
        let key = format!("{above}{}", name.extract::<String>()?);
        match value.cast::<PyDict>() {
            Ok(table) if !table.contains("kind")? => collect(&format!("{key}."), table, found)?,
            _ => found.push(format!("{key}={}", toml_of(&key, &value)?)),
        }
    }
    Ok(())
}

fn toml_of(key: &str, any: &Bound<'_, PyAny>) -> PyResult<Value> {
    if any.is_instance_of::<PyBool>() {
        return Ok(Value::Boolean(any.extract()?));
    }
    if any.is_instance_of::<PyString>() {
        return Ok(Value::String(any.extract()?));
    }
    if any.is_instance_of::<PyInt>() {
        return Ok(Value::Integer(any.extract()?));
    }
    if any.is_instance_of::<PyFloat>() {
        return Ok(Value::Float(any.extract()?));
    }
    if let Ok(table) = any.cast::<PyDict>() {
        let entry = |(name, value): (Bound<'_, PyAny>, Bound<'_, PyAny>)| {
            let name = name.extract::<String>()?;
            Ok((name.clone(), toml_of(&format!("{key}.{name}"), &value)?))
        };
        return Ok(Value::Table(table.iter().map(entry).collect::<PyResult<_>>()?));
    }
    // A path of pathlib.
    if any.hasattr("__fspath__")? {
        return toml_of(key, &any.call_method0("__fspath__")?);
    }
    // A number of NumPy's, or an array of them.
    if any.hasattr("tolist")? {
        return toml_of(key, &any.call_method0("tolist")?);
    }
    let list = any.try_iter().map_err(|_| {
        refused(format!("`{key}` = {any}: expected a number, a text, True or False, a list or a dictionary"))
    })?;
    Ok(Value::Array(list.map(|item| toml_of(key, &item?)).collect::<PyResult<_>>()?))
}
