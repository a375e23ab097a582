//! Owns the names of a run's files, and what besides its measurements says what is in them.

use serde::{Deserialize, Serialize};

use crate::config::Output;

/// The animated GIF, of a measurement and of the run.
pub const PREVIEW: &str = "preview.gif";
/// The page.
pub const REPORT: &str = "report.html";

/// The file of frame `t` of measurement `index`, in the folder `frames`.
pub fn frame_name(index: usize, t: usize) -> String {
    format!("m{index:02}_t{t:02}.png")
}

/// What the results of a run are like, whoever has solved its measurements.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Layout {
    /// `[T, C, H, W]` of the result of a measurement.
    pub shape: [usize; 4],
    /// What white is in the result.
    pub unit: f32,
    /// What is written.
    pub output: Output,
    /// The files of adapted weights that are to be kept.
    pub weights: Vec<String>,
}

impl Layout {
    /// The file of frame `t` of measurement `index`.
    pub fn frame(index: usize, t: usize) -> String {
        format!("frames/{}", frame_name(index, t))
    }

    /// Every file of a run of these measurements, sorted, but for the record.
    pub fn files(&self, measurements: &[usize]) -> Vec<String> {
        let output = &self.output;
        let mut files = vec![output.format.file_name().to_owned()];
        if output.frames {
            files.extend(measurements.iter().flat_map(|&k| (0..self.shape[0]).map(move |t| Self::frame(k, t))));
        }
        files.extend(output.preview.then(|| PREVIEW.to_owned()));
        files.extend(output.report.then(|| REPORT.to_owned()));
        files.extend(self.weights.iter().cloned());
        files.sort();
        files
    }
}
