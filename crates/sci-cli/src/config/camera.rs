//! `[data.camera]`, and the same keys after `--set` of `sci simulate` and `sci mask`: what a simulated camera does to masks and light.

use std::path::Path;

use sci_forward::{MaskMismatch, Noise, Readout};
use serde_json::json;

use crate::simulate::Optics;
use crate::table::{ConfigError, Paths, Source, Table, as_number};

/// How the masks that modulate the light differ from those that are told.
fn optics(t: &mut Table<'_>) -> Optics {
    let legal = "two numbers from -64 to 64, pixels down and right, for example [0.3, 0.5]";
    let shift = t.legal("shift", legal, |v| pair(v, 64.0)).unwrap_or_default();
    t.show("shift", json!(shift));
    let mismatch = MaskMismatch {
        shift,
        rotation: t.number("rotation", 0.0, -45.0..=45.0),
        scale: t.number("scale", 1.0, 0.5..=2.0),
        blur: t.number("blur", 0.0, 0.0..=16.0),
        clock: t.number("clock", 0.0, -1.0..=1.0),
        contrast: t.number("contrast", 1.0, 0.01..=2.0),
        ..MaskMismatch::default()
    };
    Optics { mismatch, flicker: t.number("flicker", 0.0, 0.0..=1.0) }
}

/// Two numbers, neither farther from 0 than `most`.
pub(super) fn pair(value: &toml::Value, most: f64) -> Option<[f64; 2]> {
    let both: Option<Vec<f64>> = value.as_array()?.iter().map(as_number).collect();
    <[f64; 2]>::try_from(both?).ok().filter(|both| both.iter().all(|v| v.abs() <= most))
}

fn readout(t: &mut Table<'_>, noise: Noise) -> Readout {
    Readout {
        noise,
        gain: t.number("gain", 1.0, 1e-6..=1e6),
        black: t.number("black", 0.0, -1e6..=1e6),
        full: t.optional_number("full", 1e-6..=1e6).unwrap_or(f64::INFINITY),
        bits: t.optional_whole("bits", 1..=24).map(|bits| bits as u32),
        dead: t.number("dead", 0.0, 0.0..=0.5),
        hot: t.number("hot", 0.0, 0.0..=0.5),
    }
}

/// All of `[data.camera]`.
pub(super) fn read(t: &mut Table<'_>, noise: Noise) -> (Optics, Readout) {
    (optics(t), readout(t, noise))
}

/// The camera of the arguments of `sci simulate`, with this noise.
///
/// # Errors
/// Names the first argument that is not legal, and what is.
pub fn of_arguments(arguments: &[String], noise: Noise) -> Result<(Optics, Readout), ConfigError> {
    of(arguments, |t| read(t, noise))
}

/// The masks' way to the sensor of the arguments of `sci mask`.
///
/// # Errors
/// As [`of_arguments`].
pub fn optics_of_arguments(arguments: &[String]) -> Result<Optics, ConfigError> {
    of(arguments, optics)
}

fn of<T>(arguments: &[String], read: impl FnOnce(&mut Table<'_>) -> T) -> Result<T, ConfigError> {
    let source = Source::new(Path::new("--set"), "", arguments, &|_| Err("there is no file".into()))?;
    let (found, _) = Table::root(&source, Paths::AsWritten)?.read(|t| Ok(read(t)))?;
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_are_a_camera() {
        let set = ["shift=[0.5, -0.25]", "black=0.1", "bits=10"].map(String::from);
        let (optics, readout) = of_arguments(&set, Noise::NONE).unwrap();
        assert_eq!((optics.mismatch.shift, readout.black, readout.bits), ([0.5, -0.25], 0.1, Some(10)));
        assert_eq!(of_arguments(&[], Noise::NONE).unwrap(), (Optics::default(), Readout::default()));
        assert_eq!(optics_of_arguments(&set[..1]).unwrap(), optics);
    }

    #[test]
    fn what_is_no_camera_is_named() {
        let check = |set: &str, part: &str| {
            let message = optics_of_arguments(&[set.into()]).unwrap_err().to_string();
            assert!(message.starts_with("--set ") && message.contains(part), "{message}");
        };
        check("shift=[1]", "two numbers from -64 to 64");
        check("contrast=3", "a number from 0.01 to 2");
        check("black=0.1", "black");
    }
}
