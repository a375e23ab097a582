//! `kind = "gap"`: generalised alternating projection.

use admm::{Gap, MomentumStart};
use serde_json::Value;

use super::{Entry, Keys, Method, Priors, Start};
use crate::parts::Demosaicer;
use crate::table::Table;

pub(super) const ENTRY: Entry = Entry { kind: "gap", read };

/// `None` for plain GAP, else where y1 starts.
#[derive(Debug)]
struct Projection(Option<MomentumStart>);

fn read(t: &mut Table<'_>) -> Keys {
    let momentum = if t.flag("accelerate", true) {
        let legal = [("zero", MomentumStart::Zero), ("measurement", MomentumStart::Measurement)];
        Some(t.choice("momentum", &legal, MomentumStart::Measurement))
    } else {
        t.idle(&["momentum"], "solver.accelerate = true");
        None
    };
    Keys { method: Box::new(Projection(momentum)), start: Start::read(t), demosaicer: Demosaicer::read(t) }
}

impl Method for Projection {
    fn accelerated(&self) -> bool {
        self.0.is_some()
    }

    fn unrolled(&self) -> Option<bool> {
        match self.0 {
            None => Some(false),
            Some(MomentumStart::Measurement) => Some(true),
            Some(MomentumStart::Zero) => None,
        }
    }

    /// From where TV ends nothing is left to make up for.
    fn begin_with_tv(&mut self, json: &mut Value) -> bool {
        if let Some(momentum) = &mut self.0 {
            *momentum = MomentumStart::Measurement;
            json["momentum"] = "measurement".into();
        }
        true
    }

    fn advice(&self, backed_off: bool) -> &'static str {
        // What has backed off has already gone on without acceleration.
        match self.0.filter(|_| !backed_off) {
            None => "raise stage.0.sigma, or use another denoiser",
            Some(MomentumStart::Zero) => "set solver.momentum = \"measurement\"",
            Some(MomentumStart::Measurement) => "set solver.accelerate = false",
        }
    }

    fn build<'p>(&self, priors: Priors<'p, '_>) -> anyhow::Result<Box<dyn admm::Solver + 'p>> {
        let skips = priors.skips;
        let gap = match self.0 {
            None => Gap::plain(priors.on_sensor()),
            Some(momentum) => Gap::with_momentum(priors.on_sensor(), momentum),
        };
        Ok(Box::new(if skips { gap.restarting() } else { gap }))
    }
}
