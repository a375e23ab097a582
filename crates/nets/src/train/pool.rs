//! Solves in progress, for a network whose iterations share their weights: each step takes some of them on by a few iterations and learns
//! from those, so that every iteration that is computed is learned from, at the same cost whatever the length of a solve.
//!
//! # References
//! Williams, Peng, *An efficient gradient-based algorithm for on-line training of recurrent network trajectories*, 1990
//! (backpropagation through a few steps at a time).

use super::checkpoint::PoolMeta;
use super::config::SnapshotsConfig;
use super::snapshots::Exercise;
use crate::unfolding::Progress;
use crate::{Error, Result};
use candle_core::Tensor;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::Path;

/// Solves of all ages, in as many batches as it takes steps to finish one.
#[derive(Default)]
pub(super) struct Pool {
    solves: Vec<Exercise>,
}

impl Pool {
    /// The next batch, which [`Pool::put_back`] has to get back. Solves that are through give way to new ones, which `begin` makes from a seed.
    pub(super) fn take(
        &mut self,
        settings: &SnapshotsConfig,
        seeds: &[u64],
        begin: impl Fn(u64) -> Result<Exercise> + Sync,
    ) -> Result<Vec<Exercise>> {
        let (batch, steps) = (seeds.len(), settings.iterations.div_ceil(settings.at_once));
        if self.solves.len() < batch * steps {
            // The first ones end early, each at another age, so that a batch has iterations of all kinds.
            let begun: Vec<_> = seeds.par_iter().map(|&seed| begin(seed)).collect::<Result<_>>()?;
            let ends = (0..).map(|i| settings.iterations.min((1 + (self.solves.len() + i) % steps) * settings.at_once));
            return Ok(begun.into_iter().zip(ends).map(|(solve, end)| Exercise { end, ..solve }).collect());
        }
        let next: Vec<_> = self.solves.drain(..batch).collect();
        let renewed = next
            .into_par_iter()
            .zip(seeds)
            .map(|(solve, &seed)| if solve.iterations_done() < solve.end { Ok(solve) } else { begin(seed) });
        renewed.collect()
    }

    /// After their step.
    pub(super) fn put_back(&mut self, solves: impl Iterator<Item = Exercise>) {
        self.solves.extend(solves);
    }

    /// For a checkpoint.
    pub(super) fn state(&self, tensors: &mut BTreeMap<String, Tensor>) -> Vec<PoolMeta> {
        let mut metas = Vec::new();
        for (i, solve) in self.solves.iter().enumerate() {
            if let Some(Progress { result, features, .. }) = &solve.progress {
                tensors.insert(format!("pool/{i}/result"), result.clone());
                tensors.insert(format!("pool/{i}/features"), features.clone());
            }
            metas.push(PoolMeta { seed: solve.seed, done: solve.iterations_done(), end: solve.end });
        }
        metas
    }

    /// From a checkpoint.
    pub(super) fn restored(
        path: &Path,
        metas: &[PoolMeta],
        tensors: &mut BTreeMap<String, Tensor>,
        begin: impl Fn(u64) -> Result<Exercise>,
    ) -> Result<Self> {
        let mut solves = Vec::new();
        for (i, &PoolMeta { seed, done, end }) in metas.iter().enumerate() {
            let mut take = |what: &str| {
                let key = format!("pool/{i}/{what}");
                tensors.remove(&key).ok_or_else(|| Error::format(path, format!("{key} is missing")))
            };
            let progress = match done {
                0 => None,
                iterations => Some(Progress { iterations, result: take("result")?, features: take("features")? }),
            };
            solves.push(Exercise { progress, end, ..begin(seed)? });
        }
        Ok(Self { solves })
    }
}
