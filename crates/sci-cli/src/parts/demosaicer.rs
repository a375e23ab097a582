//! `solver.demosaicer`: what fills in the colors that a mosaic lacks.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use admm::{BoxError, Outcome, SolveError};
use anyhow::Context;
use ndarray::{Array4, ArrayView3, ArrayViewMut4};
use nets::Layers;
use sci_forward::CfaPattern;
use sci_forward::bayer::{Bilinear, Malvar, Menon};

use super::MultiplyAdds;
use crate::table::Table;

/// What demosaics.
#[derive(Clone, Debug, PartialEq)]
pub enum Demosaicer {
    /// Means of neighbours.
    Bilinear,
    /// Malvar 2004.
    Malvar,
    /// Menon 2007.
    Menon,
    /// A network, of this weight file.
    Ddnet(PathBuf),
}

/// What stands for a demosaicer with two stages.
const CLOSED_FORM: &str = "closed-form";

impl Demosaicer {
    /// Reads `solver.demosaicer`; nothing if it is not given.
    pub fn read(t: &mut Table<'_>) -> Option<Self> {
        Self::read_or_closed_form(t, false).0
    }

    /// The same where there may be no demosaicer at all, but a closed form; whether there is.
    pub fn read_or_closed_form(t: &mut Table<'_>, closed_form: bool) -> (Option<Self>, bool) {
        let legal = "malvar, menon, bilinear, ddnet, and closed-form with solver.kind = \"two-stage\"";
        let known =
            |name: &str| ["malvar", "menon", "bilinear", "ddnet"].contains(&name) || closed_form && name == CLOSED_FORM;
        let name = t.text("demosaicer", legal, known);
        if name.as_deref() == Some("ddnet") {
            return (Some(Self::Ddnet(t.weights("weights"))), false);
        }
        t.idle(&["weights"], "solver.demosaicer = \"ddnet\"");
        let found = match name.as_deref() {
            Some("malvar") => Some(Self::Malvar),
            Some("menon") => Some(Self::Menon),
            Some("bilinear") => Some(Self::Bilinear),
            _ => None,
        };
        (found, name.as_deref() == Some(CLOSED_FORM))
    }

    /// The weight file of a network.
    pub fn weights(&self) -> Option<&Path> {
        match self {
            Self::Ddnet(weights) => Some(weights),
            Self::Bilinear | Self::Malvar | Self::Menon => None,
        }
    }

    fn build(&self) -> anyhow::Result<(Box<dyn sci_forward::Demosaicer>, f64)> {
        Ok(match self {
            Self::Bilinear => (Box::new(Bilinear), 0.0),
            Self::Malvar => (Box::new(Malvar), 0.0),
            Self::Menon => (Box::new(Menon), 0.0),
            Self::Ddnet(weights) => {
                let net = nets::Ddnet::load(weights, nets::Ends::Circular).context("solver.weights")?;
                let multiply_adds = net.multiply_adds();
                (Box::new(net), multiply_adds)
            }
        })
    }
}

/// A color sensor, and what demosaics it.
pub struct Sensor {
    /// Its pattern.
    pub cfa: CfaPattern,
    pub(crate) demosaicer: SharedDemosaicer,
}

impl Sensor {
    /// Loads the demosaicer.
    ///
    /// # Errors
    /// When its weights cannot be read.
    pub fn new(cfa: CfaPattern, demosaicer: &Demosaicer, count: MultiplyAdds) -> anyhow::Result<Self> {
        let (demosaicer, multiply_adds) = demosaicer.build()?;
        let name = demosaicer.name().to_owned();
        let shared = Arc::new(Mutex::new(demosaicer));
        Ok(Self { cfa, demosaicer: SharedDemosaicer { name, shared, multiply_adds, count } })
    }

    /// Sees to the RGB video where the estimate has none of its own: after a prior on the mosaic, or no iteration at all.
    pub(crate) fn complete(&self, outcome: &mut Outcome) -> Result<(), SolveError> {
        let (sensor, None) = (&outcome.estimate.sensor, &outcome.estimate.rgb) else { return Ok(()) };
        let begin = Instant::now();
        let (frames, height, width) = sensor.dim();
        let mut rgb = Array4::zeros((frames, 3, height, width));
        let demosaic = |rgb| {
            let mut demosaicer = self.demosaicer.clone();
            sci_forward::Demosaicer::demosaic(&mut demosaicer, self.cfa, sensor.view(), rgb)
        };
        demosaic(rgb.view_mut()).map_err(|source| SolveError::Prior {
            part: "demosaicer",
            name: self.demosaicer.name.clone(),
            iteration: outcome.iterations,
            source,
        })?;
        outcome.estimate.rgb = Some(rgb);
        outcome.seconds += begin.elapsed().as_secs_f64();
        Ok(())
    }
}

/// One demosaicer for all priors of a schedule, as a network is too large to have twice.
#[derive(Clone)]
pub(crate) struct SharedDemosaicer {
    name: String,
    shared: Arc<Mutex<Box<dyn sci_forward::Demosaicer>>>,
    /// For each pixel of each frame.
    multiply_adds: f64,
    count: MultiplyAdds,
}

impl sci_forward::Demosaicer for SharedDemosaicer {
    fn name(&self) -> &str {
        &self.name
    }

    fn demosaic(
        &mut self,
        cfa: CfaPattern,
        mosaic: ArrayView3<'_, f32>,
        rgb: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        self.count.add(mosaic.len(), self.multiply_adds);
        // A demosaicer keeps nothing that a panic could have left half done.
        self.shared.lock().unwrap_or_else(PoisonError::into_inner).demosaic(cfa, mosaic, rgb)
    }
}
