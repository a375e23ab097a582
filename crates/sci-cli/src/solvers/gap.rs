//! `kind = "gap"`: generalised alternating projection.

use admm::{Gap, MomentumStart};
use serde_json::Value;

use super::{Entry, Keys, Method, Priors, Start};
use crate::parts::Demosaicer;
use crate::table::Table;

pub(super) const ENTRY: Entry = Entry { kind: "gap", read };

#[derive(Debug)]
struct Projection {
    /// `None` for plain GAP, else where y1 starts.
    momentum: Option<MomentumStart>,
    /// Whether y1 starts anew where σ falls by far, and where a prior with a σ follows one without.
    restarts: bool,
}

fn read(t: &mut Table<'_>) -> Keys {
    let (momentum, restarts) = if t.flag("accelerate", true) {
        let legal = [("zero", MomentumStart::Zero), ("measurement", MomentumStart::Measurement)];
        (Some(t.choice("momentum", &legal, MomentumStart::Measurement)), t.flag("restart", false))
    } else {
        t.idle(&["momentum", "restart"], "solver.accelerate = true");
        (None, false)
    };
    Keys { method: Box::new(Projection { momentum, restarts }), start: Start::read(t), demosaicer: Demosaicer::read(t) }
}

impl Method for Projection {
    fn unrolled(&self) -> Option<bool> {
        match self.momentum {
            None => Some(false),
            Some(MomentumStart::Measurement) if !self.restarts => Some(true),
            Some(_) => None,
        }
    }

    /// From where TV ends nothing is left to make up for.
    fn begin_with_tv(&mut self, json: &mut Value) -> bool {
        if let Some(momentum) = &mut self.momentum {
            *momentum = MomentumStart::Measurement;
            json["momentum"] = "measurement".into();
        }
        true
    }

    fn advice(&self, backed_off: bool) -> &'static str {
        // What has backed off has already gone on without acceleration.
        match self.momentum.filter(|_| !backed_off) {
            None => "raise stage.0.sigma, or use another denoiser",
            Some(MomentumStart::Zero) => "set solver.momentum = \"measurement\"",
            Some(MomentumStart::Measurement) => "set solver.accelerate = false",
        }
    }

    fn build<'p>(&self, priors: Priors<'p, '_>) -> anyhow::Result<Box<dyn admm::Solver + 'p>> {
        let restarts = self.restarts || priors.skips;
        let gap = match self.momentum {
            None => Gap::plain(priors.on_sensor()),
            Some(momentum) => Gap::with_momentum(priors.on_sensor(), momentum),
        };
        Ok(Box::new(if restarts { gap.restarting() } else { gap }))
    }
}
