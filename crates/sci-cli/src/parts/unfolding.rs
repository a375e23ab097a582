//! `kind = "unfolding"`: the deep unfolding network, a prior that knows the measurement.
//!
//! It was trained as the whole of a solve: plain GAP from the mean or from TV (its card says which), one of its iterations in each of the solver's. Fewer are a rougher
//! result, more repeat the last. Weights to ship go beside the others, in one line of `nets::weights`: `bundled:NAME` then knows them.

use admm::{Call, Denoiser, Estimate, Prior, PriorError};
use anyhow::Context;
use ndarray::ArrayView3;
use nets::{Layers, UnfoldingNet, UnfoldingPrior, WeightFile};

use super::{Around, Built, Entry, Inference, Misfit, MultiplyAdds, Part, Saving, Sensor, Site};
use crate::table::Table;

pub(super) const ENTRY: Entry = Entry { kind: "unfolding", read };

#[derive(Debug)]
struct Unfolding(Inference);

fn read(t: &mut Table<'_>) -> Box<dyn Part> {
    Box::new(Unfolding(Inference::read_upright(t)))
}

impl Part for Unfolding {
    fn instead_of_sigma(&self) -> Option<&'static str> {
        Some("unfolding, which finds the noise by itself")
    }

    fn network(&self) -> Option<&Inference> {
        Some(&self.0)
    }

    fn check(&self, around: &Around<'_>) -> Result<(), Misfit> {
        let trained = "denoiser.kind = \"unfolding\" was trained for";
        let others_before = around.stages.iter().skip_while(|own| **own).any(|own| *own) || !around.stages[0];
        let rules = [
            (
                around.solver == "gap",
                "solver.kind",
                format!("is \"{}\", but {trained} plain GAP; legal: gap", around.solver),
            ),
            (!around.accelerated, "solver.accelerate", format!("is true, but {trained} plain GAP; legal: false")),
            (
                around.normalised,
                "solver.start",
                format!("is neither the mean nor TV, which {trained}; legal: mean, tv"),
            ),
            (!others_before, "stage", format!("begins with another denoiser, but {trained} solves from their start")),
            (!around.online, "online.enabled", "is true, but an unfolding network does not adapt; legal: false".into()),
            (
                !around.tiles,
                "skip.tiles",
                "is true, but an unfolding network needs the measurement as a whole; legal: false".into(),
            ),
        ];
        match rules.into_iter().find(|(holds, ..)| !holds) {
            Some((_, key, problem)) => Err(Misfit { key, problem }),
            None => Ok(()),
        }
    }

    fn build(&self, site: &Site<'_>) -> anyhow::Result<Box<dyn Built>> {
        let weights = &self.0.weights;
        let file = WeightFile::read(weights).context("denoiser.weights")?;
        let mut net = UnfoldingNet::from_weights(file).context("denoiser.weights")?;
        site.fits(net.channels(), weights)?;
        net.set_inference_precision(self.0.precision);
        let (multiply_adds, work) = (net.multiply_adds(), site.work.clone());
        Ok(Box::new(Running { prior: UnfoldingPrior::new(net), multiply_adds, work }))
    }
}

/// Loaded once: each solve begins with its own measurement.
struct Running {
    prior: UnfoldingPrior,
    multiply_adds: f64,
    work: MultiplyAdds,
}

impl Built for Running {
    fn on_frames<'p>(&'p mut self, _saving: &mut Saving) -> Option<Box<dyn Denoiser + 'p>> {
        None
    }

    fn on_sensor<'p>(&'p mut self, _color: Option<&Sensor>, _saving: &mut Saving) -> Box<dyn Prior + 'p> {
        let prior: &mut (dyn Prior + 'p) = self;
        Box::new(prior)
    }
}

impl Prior for Running {
    fn apply(&mut self, call: &Call<'_>, noisy: ArrayView3<'_, f32>, out: &mut Estimate) -> Result<(), PriorError> {
        self.work.add(noisy.len(), self.multiply_adds);
        self.prior.apply(call, noisy, out)
    }
}
