//! `kind = "two-stage"`: two-stage ADMM, for color sensors.

use admm::{Convention, TwoStage, TwoStageParams, XStep};
use anyhow::Context;
use serde_json::Value;

use super::{Entry, Keys, Method, Priors, Start};
use crate::parts::Demosaicer;
use crate::table::Table;

pub(super) const ENTRY: Entry = Entry { kind: "two-stage", read };

#[derive(Debug)]
struct TwoStages {
    params: TwoStageParams,
    /// How the RGB video is made from the mosaic.
    x_step: XStep,
}

fn read(t: &mut Table<'_>) -> Keys {
    let start = Start::read_or(t, "tv", 40);
    let conventions = [("paper-code", Convention::PaperCode), ("scaled", Convention::Scaled)];
    let params = TwoStageParams {
        rho: t.number("rho", 1.0, 1e-6..=1e6) as f32,
        tau: t.number("tau", 100.0, 1e-6..=1e6) as f32,
        convention: t.choice("convention", &conventions, Convention::PaperCode),
    };
    // Even with a closed form the first x has no v yet, and comes from a demosaicer.
    let (demosaicer, closed_form) = Demosaicer::read_or_closed_form(t, true);
    let x_step = if closed_form {
        XStep::ClosedForm { clip: t.flag("clip", true) }
    } else {
        t.idle(&["clip"], "solver.demosaicer = \"closed-form\"");
        XStep::Demosaic
    };
    Keys { method: Box::new(TwoStages { params, x_step }), start, demosaicer }
}

impl Method for TwoStages {
    fn color_only(&self) -> bool {
        true
    }

    fn default_demosaicer(&self) -> Demosaicer {
        Demosaicer::Malvar
    }

    fn begin_with_tv(&mut self, _json: &mut Value) -> bool {
        false
    }

    fn advice(&self, _backed_off: bool) -> &'static str {
        "raise solver.rho, or use solver.kind = \"gap\""
    }

    fn build<'p>(&self, priors: Priors<'p, '_>) -> anyhow::Result<Box<dyn admm::Solver + 'p>> {
        let sensor = priors.color.context("solver.kind = \"two-stage\" is for color sensors")?;
        let (demosaicer, cfa) = (sensor.demosaicer.clone(), sensor.cfa);
        Ok(Box::new(TwoStage::new(priors.on_frames(), demosaicer, self.x_step, cfa, self.params)))
    }
}
