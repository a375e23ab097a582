//! `kind = "admm"`.

use admm::Admm;

use super::{Entry, Keys, Method, Priors, Start};
use crate::parts::Demosaicer;
use crate::table::Table;

pub(super) const ENTRY: Entry = Entry { kind: "admm", read };

#[derive(Debug)]
struct OneSplitting {
    gamma: f32,
}

fn read(t: &mut Table<'_>) -> Keys {
    let gamma = t.number("gamma", 0.01, 0.0..=1e3) as f32;
    Keys { method: Box::new(OneSplitting { gamma }), start: Start::read(t), demosaicer: Demosaicer::read(t) }
}

impl Method for OneSplitting {
    fn advice(&self, _backed_off: bool) -> &'static str {
        "raise solver.gamma, or use solver.kind = \"gap\""
    }

    fn build<'p>(&self, priors: Priors<'p, '_>) -> anyhow::Result<Box<dyn admm::Solver + 'p>> {
        Ok(Box::new(Admm::new(priors.on_sensor(), self.gamma)))
    }
}
