//! `solver.start`: where a solve starts.

use crate::table::{MAX_ITERATIONS, Table};

/// Where a solve starts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Start {
    /// The measurement divided by the masks' sum.
    Mean,
    /// `Hᵀy`.
    Adjoint,
    /// The result of the measurement before; the first starts from the mean.
    Previous,
    /// A few iterations of ADMM-TV.
    Tv {
        /// Iterations.
        iterations: usize,
        /// TV weight.
        weight: f32,
    },
}

impl Start {
    /// Reads the keys; without any it is the mean.
    pub(super) fn read(t: &mut Table<'_>) -> Self {
        Self::read_or(t, "mean", 20)
    }

    /// Reads the keys; without any it is `default`, TV with so many iterations.
    pub(super) fn read_or(t: &mut Table<'_>, default: &str, iterations: usize) -> Self {
        // Who asks for TV gets the usual 20.
        let iterations = if t.holds("start") { 20 } else { iterations };
        let names = ["mean", "adjoint", "previous", "tv"].map(|name| (name, name));
        let name = t.choice("start", &names, default);
        if name == "tv" {
            return Self::Tv {
                iterations: t.whole("start_iterations", iterations, 1..=MAX_ITERATIONS),
                weight: t.number("start_weight", 0.1, 1e-6..=100.0) as f32,
            };
        }
        t.idle(&["start_iterations", "start_weight"], "solver.start = \"tv\"");
        match name {
            "adjoint" => Self::Adjoint,
            "previous" => Self::Previous,
            _ => Self::Mean,
        }
    }
}
