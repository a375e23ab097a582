//! What the networks share: keys, and how those that denoise white noise run and learn.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use admm::{Denoiser, Prior};
use nets::Network;
use nets::kernels::Precision;
use nets::unrolled::Recipe;
use nets::weights::bundled_for_iterates;
use online::{AdaptiveDenoiser, SplitRecord, Successor, Task, Update};
use sci_forward::Measurement;

use super::{Built, Learning, Saving, Sensor, Site, demosaicked};
use crate::table::Table;

/// How a network is run.
#[derive(Clone, Debug)]
pub struct Inference {
    /// Weight file, absolute, or `bundled:NAME`.
    pub weights: PathBuf,
    /// What it multiplies.
    pub precision: Precision,
    /// Whether it sees the video another way round in every iteration.
    pub flips: bool,
    /// It sees the video divided by this.
    pub dim: f32,
}

/// What networks multiply.
pub const PRECISIONS: [(&str, Precision); 2] = [("f32", Precision::F32), ("bf16", Precision::Bf16)];

impl Inference {
    /// From the table of a denoiser.
    pub(super) fn read(t: &mut Table<'_>) -> Self {
        let (flips, dim) = (t.flag("flips", false), t.number("dim", 1.0, 0.1..=100.0) as f32);
        let precision = t.choice("precision", &PRECISIONS, Precision::default());
        Self { precision, flips, dim, weights: t.weights("weights") }
    }

    /// Whether it was trained for the iterates of one schedule.
    pub fn for_iterates(&self) -> bool {
        self.weights.to_str().is_some_and(bundled_for_iterates)
    }

    /// Makes a loaded network ready to run, and to learn.
    pub(super) fn build<N>(&self, mut net: N, site: &Site<'_>) -> anyhow::Result<Box<dyn Built>>
    where
        N: Network + Denoiser + Clone + 'static,
    {
        site.fits(net.channels(), &self.weights)?;
        net.set_inference_precision(self.precision);
        let multiply_adds = net.multiply_adds();
        let net = AdaptiveDenoiser::new(net, site.adapt)?;
        Ok(Box::new(Running { net, inference: self.clone(), multiply_adds }))
    }
}

/// Loaded once. Without a measurement it is the network itself.
struct Running<N> {
    net: AdaptiveDenoiser<N>,
    inference: Inference,
    multiply_adds: f64,
}

impl<N: Network + Denoiser + Clone> Built for Running<N> {
    fn on_frames<'p>(&'p mut self, saving: &mut Saving) -> Box<dyn Denoiser + 'p> {
        saving.network(&mut self.net, &self.inference, self.multiply_adds)
    }

    fn on_sensor<'p>(&'p mut self, color: Option<&Sensor>, saving: &mut Saving) -> Box<dyn Prior + 'p> {
        demosaicked(saving.network(&mut self.net, &self.inference, self.multiply_adds), color)
    }

    fn network(&self) -> Option<&dyn Network> {
        Some(self.net.network())
    }

    fn learning(&mut self) -> Option<&mut dyn Learning> {
        Some(&mut self.net)
    }
}

impl<N: Network + Denoiser + Clone> Learning for AdaptiveDenoiser<N> {
    fn prepare(&mut self, task: &Task) -> online::Result<()> {
        task.prepare(self)
    }

    fn adapt_by_splitting(
        &mut self,
        measurements: &[Measurement],
        recipe: &Recipe,
        successor: Option<Successor<'_>>,
        watch: &mut dyn FnMut(usize) -> ControlFlow<()>,
    ) -> online::Result<Option<SplitRecord>> {
        AdaptiveDenoiser::adapt_by_splitting(self, measurements, recipe, successor, watch)
    }

    fn save(&mut self, path: &Path) -> online::Result<()> {
        AdaptiveDenoiser::save(self, path)
    }

    fn load(&mut self, path: &Path) -> online::Result<()> {
        AdaptiveDenoiser::load(self, path)
    }

    fn take_up(&mut self, updates: &[Update]) {
        AdaptiveDenoiser::take_up(self, updates);
    }

    fn updates(&self) -> &[Update] {
        AdaptiveDenoiser::updates(self)
    }
}
