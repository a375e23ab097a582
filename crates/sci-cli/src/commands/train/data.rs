//! Frames to train on: folders of images, decoded once and kept as bytes.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use nets::train::{Frame, TrainData, frame_from_rgb};
use rayon::prelude::*;

use crate::io;
use crate::training::Training;

/// Reads what the settings name.
pub(super) fn load(training: &Training) -> anyhow::Result<TrainData> {
    let config = &training.config;
    let channels = config.network.channels();
    let clips = |key: &str, path: &Path| clips(&training.find(key, path)?, channels).context(key.to_owned());
    let share = config.data.photo_share;
    let videos = match &config.data.video {
        Some(path) if share < 1.0 => clips("data.video", path)?,
        _ => Vec::new(),
    };
    let photos = match &config.data.photos {
        Some(path) if share > 0.0 => frames(&training.find("data.photos", path)?, channels).context("data.photos")?,
        _ => Vec::new(),
    };
    let mut validation = clips("data.validation", &config.data.validation)?;
    validation.iter_mut().for_each(|clip| clip.truncate(config.validation.frames));
    Ok(TrainData { videos, photos, validation })
}

fn entries(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let read =
        || -> std::io::Result<Vec<PathBuf>> { std::fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect() };
    let mut paths = read().with_context(|| folder.display().to_string())?;
    paths.sort();
    Ok(paths)
}

/// One clip for each folder in `folder`.
fn clips(folder: &Path, channels: usize) -> anyhow::Result<Vec<Vec<Frame>>> {
    let folders: Vec<PathBuf> = entries(folder)?.into_iter().filter(|path| path.is_dir()).collect();
    if folders.is_empty() {
        bail!("{}: holds no folders; each clip is a folder of frames", folder.display());
    }
    folders.iter().map(|folder| frames(folder, channels)).collect()
}

/// All images of a folder, by name.
fn frames(folder: &Path, channels: usize) -> anyhow::Result<Vec<Frame>> {
    let paths = io::frames::list(folder)?;
    paths.par_iter().map(|path| frame(path, channels).with_context(|| path.display().to_string())).collect()
}

fn frame(path: &Path, channels: usize) -> anyhow::Result<Frame> {
    let image = io::frames::decode(&std::fs::read(path)?)?.into_rgb8();
    let (width, height) = (image.width() as usize, image.height() as usize);
    Ok(frame_from_rgb(image.as_raw(), height, width, channels)?)
}
