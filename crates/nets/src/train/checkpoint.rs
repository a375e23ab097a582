//! Checkpoints: weights, their average, the optimiser's moments, and how far training has come, in one safetensors file.
//!
//! The random generator needs no state of its own: each step draws from the stream of its number.

use super::config::TrainConfig;
use crate::weights::write_atomically;
use crate::{Error, Result};
use candle_core::{DType, Device, Tensor};
use safetensors::SafeTensors;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

const KEY: &str = "checkpoint";
const SCHEMA: u32 = 4;

/// What a checkpoint says beside its tensors.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Meta {
    schema: u32,
    pub(super) step: u64,
    pub(super) adam_steps: u64,
    pub(super) config: TrainConfig,
    /// Solves in progress, in their order.
    pub(super) pool: Vec<PoolMeta>,
}

/// What a solve in progress was drawn with, and the iterations that it has behind it and is to have.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct PoolMeta {
    pub(super) seed: u64,
    pub(super) done: usize,
    pub(super) end: usize,
}

impl Meta {
    pub(super) fn new(step: u64, adam_steps: u64, config: TrainConfig, pool: Vec<PoolMeta>) -> Self {
        Self { schema: SCHEMA, step, adam_steps, config, pool }
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
    let file = SafeTensors::deserialize(&bytes).map_err(|e| refuse(e.to_string()))?;
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(|e| refuse(e.to_string()))?;
    let json = header.metadata().as_ref().and_then(|m| m.get(KEY));
    let json = json.ok_or_else(|| refuse("it is a safetensors file that was not written by a training run".into()))?;
    let meta: Meta = serde_json::from_str(json).map_err(|e| refuse(e.to_string()))?;
    if meta.schema != SCHEMA {
        return Err(refuse(format!("its schema is {}, this program reads {SCHEMA}", meta.schema)));
    }
    let mut tensors = BTreeMap::new();
    for (name, view) in file.tensors() {
        let tensor = Tensor::from_raw_buffer(view.data(), DType::F32, view.shape(), &Device::Cpu)?;
        if view.dtype() != safetensors::Dtype::F32 {
            return Err(refuse(format!("tensor {name} is of type {:?}", view.dtype())));
        }
        tensors.insert(name, tensor);
    }
    Ok((meta, tensors))
}

/// Refuses to go on with settings that would make another run of it.
pub(super) fn check_same_run(path: &Path, saved: &TrainConfig, now: &TrainConfig) -> Result<()> {
    let value = |config: &TrainConfig| serde_json::to_value(config).map_err(|e| Error::format(path, e.to_string()));
    let (saved, now) = (value(saved)?, value(now)?);
    for part in ["seed", "network", "data", "noise", "snapshots", "training"] {
        // Where the data lies may change; what is cut from it may not.
        let strip = |config: &serde_json::Value| {
            let mut part = config[part].clone();
            if let Some(table) = part.as_object_mut() {
                ["video", "photos", "validation"].iter().for_each(|key| drop(table.remove(*key)));
            }
            part
        };
        let (saved, now) = (strip(&saved), strip(&now));
        if saved != now {
            let why =
                format!("it was trained with {part} = {saved}, this run has {now}; resuming needs equal settings");
            return Err(Error::format(path, why));
        }
    }
    Ok(())
}
