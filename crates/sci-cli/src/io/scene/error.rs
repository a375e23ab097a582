//! Why files do not make a scene.

use sci_forward::MaskError;

use crate::io::FileError;

/// Why files do not make a scene.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SceneError {
    /// A file cannot be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// A needed part is missing.
    #[error("{file}: no variable `{key}` ({part}){}; it holds {}. Set data.keys if it has another name", meant(.near.as_deref()), list(.present))]
    MissingKey {
        /// The file.
        file: String,
        /// The name looked for.
        key: String,
        /// What it is for.
        part: &'static str,
        /// The name in the file that may be meant.
        near: Option<String>,
        /// The names in the file.
        present: Vec<String>,
    },
    /// A scene that has to be solved as a whole.
    #[error("{file}: cannot be read in bands, which `memory` asks for: {why}")]
    NotInBands {
        /// The file.
        file: String,
        /// What stands against it, and what to do.
        why: String,
    },
    /// A color sensor too small to have every color.
    #[error("{file}: {height}×{width} pixels (rows × columns) are no color scene: a Bayer pattern needs at least 2×2")]
    NoBayerPattern {
        /// The file.
        file: String,
        /// Rows.
        height: usize,
        /// Columns.
        width: usize,
    },
    /// An array with the wrong number of axes.
    #[error("{file}: `{key}` has shape {shape:?}, expected {expected}")]
    Axes {
        /// The file.
        file: String,
        /// The variable.
        key: String,
        /// Its shape.
        shape: Vec<usize>,
        /// The legal shapes.
        expected: &'static str,
    },
    /// Two arrays of different picture sizes.
    #[error("{file}: `{key}` is {}×{} (rows × columns), but `{mask}` is {}×{}; they must be equal. If frames are not where their axis is expected, data.axes (--axes of sci simulate) says so, for all files alike: hwt (usual in .mat) or thw (elsewhere)", .size.0, .size.1, .mask_size.0, .mask_size.1)]
    SizeMismatch {
        /// The file.
        file: String,
        /// The variable.
        key: String,
        /// Its rows and columns.
        size: (usize, usize),
        /// The mask variable.
        mask: String,
        /// The mask's rows and columns.
        mask_size: (usize, usize),
    },
    /// NaN or infinity.
    #[error(
        "{file}: `{key}` is {value} at frame {frame}, row {row}, column {column}; every value must be finite (data.defects = \"exclude\" leaves such pixels of a measurement out)"
    )]
    NotFinite {
        /// The file.
        file: String,
        /// The variable.
        key: String,
        /// The value.
        value: f32,
        /// Position.
        frame: usize,
        /// Position.
        row: usize,
        /// Position.
        column: usize,
    },
    /// Masks that are no masks.
    #[error("{file}: `{key}`: {source}")]
    Mask {
        /// The file.
        file: String,
        /// The variable.
        key: String,
        /// The broken rule.
        source: MaskError,
    },
    /// Fewer frames than masks, so nothing to sum.
    #[error("{file}: {frames} frames, but a measurement sums {needed}")]
    TooFewFrames {
        /// The file.
        file: String,
        /// Frames there.
        frames: usize,
        /// Frames a measurement needs.
        needed: usize,
    },
    /// A snapshot in color where a sensor's numbers are expected.
    #[error("{file}: `{key}` is a picture in color, expected gray or a mosaic as the sensor gives it (with data.cfa)")]
    Color {
        /// The file.
        file: String,
        /// The variable.
        key: String,
    },
    /// A mask that is to move is not one.
    #[error("{file}: {found} masks, but data.mask_shift moves one: expected [H, W]")]
    NotOneMask {
        /// The scene's file.
        file: String,
        /// Masks there.
        found: usize,
    },
    /// A mask that cannot move so far.
    #[error("{file}: data.mask_shift = {:?}, data.frames = {}: {source}", .shift.step, .shift.frames)]
    Shift {
        /// The scene's file.
        file: String,
        /// How it is to move.
        shift: super::MaskShift,
        /// The broken rule.
        source: MaskError,
    },
    /// A video where a scene is expected.
    #[error(
        "{file}: {what} has no masks and measurements. To simulate measurements from it, set data.kind = \"simulate\"; if it is the measurements, data.mask names the masks' file"
    )]
    NotAScene {
        /// The file.
        file: String,
        /// What it is.
        what: &'static str,
    },
}

fn meant(near: Option<&str>) -> String {
    near.map_or_else(String::new, |near| format!(" (did you mean `{near}`?)"))
}

fn list(names: &[String]) -> String {
    if names.is_empty() {
        return "no variables".into();
    }
    names.iter().map(|n| format!("`{n}`")).collect::<Vec<_>>().join(", ")
}
