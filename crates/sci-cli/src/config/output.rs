//! `[output]`: what is written.

use serde::{Deserialize, Serialize};

use crate::io::recon::VideoFormat;
use crate::table::Table;

/// `[output]`, or `output = "minimal"`: nothing but the reconstruction and the record.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Output {
    /// Format of the reconstruction.
    pub format: VideoFormat,
    /// Write PNG frames.
    pub frames: bool,
    /// Write an animated GIF.
    pub preview: bool,
    /// Its frames a second.
    pub fps: u16,
    /// Write the page.
    pub report: bool,
    /// What its pictures may take, in units of a million bytes.
    pub report_megabytes: u32,
}

impl Output {
    pub(super) fn read(t: &mut Table<'_>, minimal: bool) -> Self {
        Self {
            format: t.choice("format", &VideoFormat::ALL, VideoFormat::Npy),
            frames: t.flag("frames", !minimal),
            preview: t.flag("preview", !minimal),
            fps: t.whole("fps", 10, 1..=50) as u16,
            report: t.flag("report", !minimal),
            report_megabytes: t.whole("report_megabytes", 30, 1..=400) as u32,
        }
    }

    /// Whether pictures are made of each measurement.
    pub fn has_pictures(&self) -> bool {
        self.frames || self.preview || self.report
    }
}
