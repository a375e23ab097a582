//! Checkpoints: weights, their average, the optimiser's moments, and how far training has come, in one safetensors file.
//!
//! The random generator needs no state of its own: each step draws from the stream of its number.

use super::config::TrainConfig;
use crate::weights::{read_safetensors, write_atomically};
use crate::{Error, Result};
use candle_core::{DType, Tensor};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};

const KEY: &str = "checkpoint";
const SCHEMA: u32 = 5;

/// What a checkpoint says beside its tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Meta {
    schema: u32,
    pub(super) step: u64,
    pub(super) adam_steps: u64,
    pub(super) config: TrainConfig,
    /// Whether it began with random weights.
    pub(super) random: bool,
    /// The share of the settings' learning rate that is left after divergences.
    pub(super) rate: f64,
}

impl Meta {
    pub(super) fn new(step: u64, adam_steps: u64, config: TrainConfig, random: bool, rate: f64) -> Self {
        Self { schema: SCHEMA, step, adam_steps, config, random, rate }
    }

    /// What is wrong with it.
    fn fault(&self) -> Option<String> {
        let steps = self.config.training.steps;
        if self.schema != SCHEMA {
            return Some(format!("its schema is {}, this program reads {SCHEMA}", self.schema));
        }
        let legal = self.step <= steps && self.adam_steps <= self.step && self.rate > 0.0 && self.rate <= 1.0;
        (!legal).then(|| {
            let Self { step, adam_steps, rate, .. } = self;
            format!("step {step} of {steps}, {adam_steps} of the optimiser, {rate} of the rate")
        })
    }
}

/// The name of the checkpoint before `path`.
pub(super) fn previous(path: &Path) -> PathBuf {
    path.with_extension("previous.safetensors")
}

/// Writes under a temporary name, keeps the checkpoint that was there as [`previous`], and renames.
pub(super) fn write(path: &Path, meta: &Meta, tensors: &BTreeMap<String, Tensor>) -> Result<()> {
    let json = serde_json::to_string(meta).map_err(|e| Error::format(path, e.to_string()))?;
    let header = Some(HashMap::from([(KEY.to_owned(), json)]));
    let bytes = safetensors::serialize(tensors, header).map_err(|e| Error::format(path, e.to_string()))?;
    write_atomically(path, &bytes, |path| if path.exists() { std::fs::rename(path, previous(path)) } else { Ok(()) })
}

/// Reads a checkpoint and nothing less than a whole one.
pub(super) fn read(path: &Path) -> Result<(Meta, BTreeMap<String, Tensor>)> {
    let bytes = std::fs::read(path).map_err(|source| Error::Read { path: path.to_owned(), source })?;
    let refuse = |why: String| Error::format(path, format!("not a whole checkpoint: {why}"));
    let (stored, header) = read_safetensors(&bytes).map_err(refuse)?;
    let json = header.get(KEY);
    let json = json.ok_or_else(|| refuse("it is a safetensors file that was not written by a training run".into()))?;
    let meta: Meta = serde_json::from_str(json).map_err(|e| refuse(e.to_string()))?;
    if let Some(fault) = meta.fault() {
        return Err(refuse(fault));
    }
    let mut tensors = BTreeMap::new();
    for (name, tensor) in stored {
        if tensor.dtype != DType::F32 {
            return Err(refuse(format!("tensor {name} is of type {:?}", tensor.dtype)));
        }
        if let Some(value) = tensor.not_finite() {
            return Err(refuse(format!("tensor {name} holds {value}")));
        }
        tensors.insert(name, tensor.into_tensor()?);
    }
    Ok((meta, tensors))
}

/// What may differ in a run that goes on: where its data lies, and how it is watched and saved.
const FREE: [&str; 6] =
    ["data.video", "data.photos", "data.validation", "iterates.first.weights", "validation", "checkpoint"];

/// Refuses to go on with settings that would make another run of it.
pub(super) fn check_same_run(path: &Path, saved: &TrainConfig, now: &TrainConfig) -> Result<()> {
    let value = |config: &TrainConfig| serde_json::to_value(config).map_err(|e| Error::format(path, e.to_string()));
    let mut found = Vec::new();
    differences("", &value(saved)?, &value(now)?, &mut found);
    if found.is_empty() {
        return Ok(());
    }
    let why = format!("it is of a run with {}; only {} may change when it goes on", found.join(", "), FREE.join(", "));
    Err(Error::format(path, why))
}

/// The keys of what differs, with both values.
fn differences(key: &str, saved: &Value, now: &Value, found: &mut Vec<String>) {
    if saved == now || FREE.contains(&key) {
        return;
    }
    let (Value::Object(before), Value::Object(after)) = (saved, now) else {
        found.push(format!("{key} = {saved}, not {now}"));
        return;
    };
    let names: BTreeSet<&String> = before.keys().chain(after.keys()).collect();
    for name in names {
        let key = if key.is_empty() { name.clone() } else { format!("{key}.{name}") };
        let of = |table: &Map<String, Value>| table.get(name).cloned().unwrap_or_default();
        differences(&key, &of(before), &of(after), found);
    }
}
