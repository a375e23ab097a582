//! Priors and denoisers made from others: for color sensors, for schedules, and decorators that spare or balance work.

mod clipped;
mod demosaicked;
mod dimmed;
mod flips;
mod per_lattice;
mod per_stage;
mod still;
mod tiles;

pub use clipped::Clipped;
pub use demosaicked::Demosaicked;
pub use dimmed::Dimmed;
pub use flips::{Flips, flipped_axes};
pub use per_lattice::PerLattice;
pub use per_stage::PerStage;
pub use still::still;
pub use tiles::{TileCounter, TileCounts, Tiles};
