//! Training: seeded, resumable bit for bit, on frames that the caller decodes.
//!
//! [`Trainer`] owns one run; the caller loops over [`Trainer::step`], validates and saves when it likes.

mod adam;
mod blend;
mod camera;
mod centre;
mod checkpoint;
mod config;
mod data;
mod iterates;
mod muon;
mod noise;
mod revive;
mod step;

pub use crate::kernels::Precision;
pub use adam::Adam;
pub use blend::blend;
pub use config::{
    CameraConfig, CheckpointConfig, DataConfig, FirstCalls, IteratesConfig, Loss, MaskKind, NetworkConfig, NoiseConfig,
    Optimizer, TrainConfig, TrainingConfig, ValidationConfig,
};
pub use data::{Frame, TrainData, frame_from_rgb};
pub use step::{Resumed, Score, StepReport, Trainer};
