//! `sci simulate`: a video to a scene file of masks, measurements and truth.

use std::fs;
use std::path::PathBuf;

use clap::builder::{PossibleValuesParser, TypedValueParser};
use ndarray::{Array2, Axis, s};
use sci_forward::{CfaPattern, Noise, VideoShape};

use super::mask::Kind;
use super::{Done, UsageError, array_format, parse_density};
use crate::config::camera::of_arguments;
use crate::config::{AXES, PATTERNS};
use crate::io::output::{ArrayFormat, Part, write_arrays};
use crate::io::scene::{self, Axes, Keys, Reading, Truth};
use crate::simulate::{Camera, simulate};

/// Arguments of `sci simulate`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// The video: .mp4 or .avi (by ffmpeg), .gif, .y4m, .tif, a folder of pictures, .npy, .npz, .h5 or .mat; color becomes gray without
    /// --cfa
    video: PathBuf,
    /// Where to write the scene: .npz or .mat
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Measure with a color sensor of this Bayer pattern; the scene then holds the RGB truth
    #[arg(long, value_name = "PATTERN", value_parser = named(&PATTERNS))]
    cfa: Option<CfaPattern>,
    /// Order of the axes of arrays: rows, columns, frames or frames, rows, columns [default: hwt in .mat, thw elsewhere]
    #[arg(long, value_name = "ORDER", value_parser = named(&AXES))]
    axes: Option<Axes>,
    /// How the masks' pixels open
    #[arg(long, value_enum, default_value = "random")]
    mask: Kind,
    /// Take the masks from a file instead: .npy, .npz, .h5, .mat, .tif or a folder of pictures
    #[arg(long, value_name = "FILE", conflicts_with_all = ["mask", "frames", "density", "signed"])]
    mask_file: Option<PathBuf>,
    /// Frames a measurement sums
    #[arg(long, default_value = "8", value_name = "B", value_parser = clap::value_parser!(u16).range(2..=1024))]
    frames: u16,
    /// Share of open pixels, 0.001 to 1
    #[arg(long, default_value = "0.5", value_parser = parse_density)]
    density: f64,
    /// A differential camera: pixels of the masks that are not open are -1 instead of 0, and the difference of two readings is measured
    #[arg(long)]
    signed: bool,
    /// Measurements to make [default: as many as the video fills]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    measurements: Option<u32>,
    /// Gaussian noise, standard deviation in units of an 8-bit picture
    #[arg(long, default_value = "0", value_parser = parse_sigma)]
    sigma: f32,
    /// Shot noise: photons a pixel counts at full scale of one frame [default: none]
    #[arg(long, value_parser = parse_photons)]
    photons: Option<f64>,
    /// Seed of masks, noise and defects
    #[arg(long, default_value = "0")]
    seed: u64,
    /// What the camera does, as in [data.camera]. To the masks, which the scene holds as they were before: shift=[DOWN,RIGHT] (pixels),
    /// rotation (degrees), scale, blur (pixels), clock (share of the frame before), contrast, flicker (of the frames' gains). To the light:
    /// gain, black, full (the end of the range; both in units of white of a frame), bits, dead and hot (shares of the pixels)
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
}

/// One of some names, as the thing that it stands for.
fn named<T: Copy + Send + Sync + 'static>(names: &'static [(&'static str, T)]) -> impl TypedValueParser<Value = T> {
    let of = |text: String| names.iter().find(|(name, _)| *name == text).expect("one of the possible values").1;
    PossibleValuesParser::new(names.iter().map(|(name, _)| *name)).map(of)
}

fn parse_sigma(text: &str) -> Result<f32, String> {
    text.parse().ok().filter(|s| (0.0..=255.0).contains(s)).ok_or_else(|| "expected a number from 0 to 255".into())
}

fn parse_photons(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|p| (1e-3..=1e9).contains(p)).ok_or_else(|| "expected a number from 0.001 to 1e9".into())
}

fn say(warnings: &[String]) {
    warnings.iter().for_each(|w| eprintln!("warning: {w}"));
}

impl Args {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        let format = array_format(&self.out)?;
        if format == ArrayFormat::Npy {
            return Err(UsageError(format!(
                "--out {}: a scene is several arrays; name a .npz or .mat file",
                self.out.display()
            ))
            .into());
        }
        let inputs = [Some(&self.video), self.mask_file.as_ref()];
        let same =
            |input: &PathBuf| fs::canonicalize(input).ok().is_some_and(|i| fs::canonicalize(&self.out).ok() == Some(i));
        if let Some(input) = inputs.into_iter().flatten().find(|input| same(input)) {
            return Err(UsageError(format!("--out {}: it is the input {}", self.out.display(), input.display())).into());
        }
        let noise = Noise::new(self.photons, f64::from(self.sigma / 255.0))?;
        let (optics, readout) = of_arguments(&self.set, noise)?;
        let camera = Camera { optics, readout, seed: self.seed };
        let (cfa, reading) = (self.cfa, Reading { axes: self.axes, ..Reading::default() });
        let scene::Video { frames: mut truth, notes } = match cfa {
            None => scene::read_gray_video(&self.video, &reading)?,
            Some(_) => scene::read_video(&self.video, &reading)?,
        };
        say(&notes);
        let (_, channels, height, width) = truth.dim();
        anyhow::ensure!(cfa.is_none() || channels == 3, "{}: --cfa needs a video in color", self.video.display());
        let masks = match &self.mask_file {
            Some(file) => {
                let (masks, notes) = scene::read_mask(file, &reading)?;
                say(&notes);
                masks
            }
            None => {
                let shape = VideoShape { frames: self.frames.into(), height, width };
                self.mask.masks(shape, self.density, self.signed, self.seed)?
            }
        };
        if let Some(n) = self.measurements {
            let wanted = n as usize * masks.shape().frames;
            let there = truth.len_of(Axis(0));
            anyhow::ensure!(
                wanted <= there,
                "{}: --measurements {n} needs {wanted} frames, the video has {there}",
                self.video.display()
            );
            truth = truth.slice_move(s![..wanted, .., .., ..]);
        }
        let truth = if cfa.is_some() { Truth::Rgb(truth) } else { Truth::Sensor(truth.index_axis_move(Axis(1), 0)) };
        let scene = simulate(&self.video.display().to_string(), &Keys::default(), masks, truth, cfa, &camera)?;
        say(&scene.warnings);
        let mask = scene.operator.adjoint(Array2::ones((height, width)).view());
        let truth = match (&scene.rgb, &scene.truth) {
            (Some(rgb), _) => Part { name: "rgb", data: rgb.view(), is_light: true },
            (None, Some(x)) => Part { name: "orig", data: x.view().insert_axis(Axis(1)), is_light: true },
            (None, None) => unreachable!("a simulated scene keeps its truth"),
        };
        let parts = [
            Part { name: "mask", data: mask.view().insert_axis(Axis(1)), is_light: false },
            Part { name: "meas", data: scene.measurements.view().insert_axis(Axis(1)), is_light: true },
            truth,
        ];
        write_arrays(&self.out, format, &parts)?;
        outln!(
            "{}: {} measurements of {}",
            self.out.display(),
            scene.len(),
            VideoShape { frames: scene.frames(), height, width }
        );
        // Which pattern it is the file does not say.
        if let Some((name, _)) =
            PATTERNS.iter().find(|(_, pattern)| cfa == Some(*pattern) && *pattern != CfaPattern::default())
        {
            outln!("its sensor is not RGGB: run it with --set data.cfa={name}");
        }
        Ok(Done::Complete)
    }
}
