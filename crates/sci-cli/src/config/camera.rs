//! Owns the keys that say what a camera's own files do not: how one mask moves, and what is in a file without a header.

use toml::{Spanned, Value as Toml};

use super::check::Checker;
use super::file::{RawKeys, Section, Value};
use super::source::ConfigError;
use crate::io::raw::{Packing, Raw};
use crate::io::scene::MaskShift;

/// Pixels a frame.
const MAX_STEP: f64 = 64.0;

impl Checker<'_> {
    /// `data.mask_shift` and `data.frames`, which go together.
    pub(super) fn mask_shift(
        &self,
        step: &Value,
        frames: &Value,
        simulated: bool,
    ) -> Result<Option<MaskShift>, ConfigError> {
        let count = self.whole("data.frames", frames, 2..=1024)?;
        let place = step.as_ref().or(frames.as_ref()).map(Spanned::span);
        let Some(place) = place else { return Ok(None) };
        let problem = match (step, count) {
            _ if simulated => {
                "`data.mask_shift` and `data.frames` have no effect on a simulation, which has [data.mask]"
            }
            (Some(step), Some(frames)) => {
                return Ok(Some(MaskShift { step: self.step(step)?, frames: frames as usize }));
            }
            (Some(_), None) => {
                "`data.mask_shift` needs data.frames, the number of frames (2 to 1024) that one mask is moved for"
            }
            (None, _) => {
                "`data.frames` needs data.mask_shift, by which one mask moves: two numbers from -64 to 64, for example [1, 0]"
            }
        };
        Err(self.source.error(&place, problem))
    }

    /// Two numbers, down and to the right.
    fn step(&self, step: &Spanned<Toml>) -> Result<[f64; 2], ConfigError> {
        let number = |v: &Toml| v.as_float().or_else(|| v.as_integer().map(|i| i as f64));
        let legal = |v: &f64| (-MAX_STEP..=MAX_STEP).contains(v);
        let both: Option<Vec<f64>> = step.get_ref().as_array().and_then(|l| l.iter().map(number).collect());
        match both.as_deref() {
            Some(&[dy, dx]) if legal(&dy) && legal(&dx) => Ok([dy, dx]),
            _ => {
                let legal = "two numbers from -64 to 64, the pixels down and right from a frame to the next, for example [1, 0]";
                Err(self.value_error("data.mask_shift", &step.span(), legal))
            }
        }
    }

    /// `[data.raw]`.
    pub(super) fn raw(&self, section: Section<'_>) -> Result<Raw, ConfigError> {
        let span = section.span.clone();
        let k: RawKeys = section.read(&[])?;
        let missing = |key: &str| {
            self.source.error(&span, format!("`data.raw.{key}` is missing: a raw file says neither size nor packing"))
        };
        let side = |key: &str, value: &Value| {
            let side = self.whole(&format!("data.raw.{key}"), value, 1..=65_536)?;
            side.map(|n| n as usize).ok_or_else(|| missing(key))
        };
        Ok(Raw {
            packing: self.choice("data.raw.format", &k.format, &Packing::ALL)?.ok_or_else(|| missing("format"))?,
            height: side("height", &k.height)?,
            width: side("width", &k.width)?,
        })
    }
}
