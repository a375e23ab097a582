//! Frames to train on: folders of images, decoded once and kept as bytes.

use std::env;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use nets::WeightFile;
use nets::train::{Frame, TrainConfig, TrainData, frame_from_rgb};
use rayon::prelude::*;

use crate::io;

/// Environment variable with the folder that data is looked up in.
const DATA_VARIABLE: &str = "SCI_DATA";

/// Reads what the settings name.
pub(super) fn load(config: &TrainConfig, file: &Path) -> anyhow::Result<TrainData> {
    let channels = config.network.channels();
    let find = |path: &Path| locate(path, file);
    let clips = |path: &Path| clips(&find(path)?, channels);
    let share = config.data.photo_share;
    let videos = match &config.data.video {
        Some(path) if share < 1.0 => clips(path).context("data.video")?,
        _ => Vec::new(),
    };
    let photos = match &config.data.photos {
        Some(path) if share > 0.0 => frames(&find(path)?, channels).context("data.photos")?,
        _ => Vec::new(),
    };
    let mut validation = clips(&config.data.validation).context("data.validation")?;
    validation.iter_mut().for_each(|clip| clip.truncate(config.validation.frames));
    Ok(TrainData { videos, photos, validation })
}

/// The weights a run begins with.
pub(super) fn weights(path: &Path, file: &Path) -> anyhow::Result<WeightFile> {
    let bundled = path.to_str().is_some_and(|p| p.starts_with("bundled:"));
    let path = if bundled { path.to_owned() } else { locate(path, file).context("weights")? };
    Ok(WeightFile::read(&path)?)
}

/// A relative path is looked up beside the training file, then in the current folder, then in SCI_DATA.
fn locate(path: &Path, file: &Path) -> anyhow::Result<PathBuf> {
    let beside = file.parent().map_or(PathBuf::new(), Path::to_owned);
    let mut folders = vec![beside, PathBuf::new()];
    folders.extend(env::var_os(DATA_VARIABLE).filter(|v| !v.is_empty()).map(PathBuf::from));
    let tried: Vec<PathBuf> = folders.into_iter().map(|folder| folder.join(path)).collect();
    match tried.iter().find(|path| path.exists()) {
        Some(found) => Ok(found.clone()),
        None => {
            let list: Vec<String> = tried.iter().map(|path| path.display().to_string()).collect();
            bail!(
                "no such file or folder: {} (looked for {}; {DATA_VARIABLE} can name the folder it is in)",
                path.display(),
                list.join(", ")
            )
        }
    }
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
