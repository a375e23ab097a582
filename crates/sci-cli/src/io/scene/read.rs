//! Owns the reading of scenes, videos and masks: opened, found, laid out, scaled, checked.

use std::path::Path;

use ndarray::{Array3, Array4, ArrayView3, Axis};
use sci_forward::bayer::mosaic_into;
use sci_forward::{MaskStack, Noise};

use super::field::{Field, median};
use super::layout::Place;
use super::scale::{self, Content};
use super::source::Source;
use super::{
    Defects, Keys, PLAUSIBLE_WHITE, Reading, Scene, SceneError, Sensor, SensorNoise, Truth, brightest_hundredth,
    brightest_light, check_size, defects_of, is_signed, light_through, names, operator_of, orientation,
};
use crate::io::defects::LeftOut;
use crate::io::samples::{Array, Samples};
use crate::io::{NamedArrays, defects};

/// The arrays of a scene as they are stored.
pub(super) struct Parts {
    pub(super) keys: Keys,
    pub(super) names: Vec<String>,
    pub(super) mask: Option<Array>,
    pub(super) meas: Option<Array>,
    pub(super) orig: Option<Array>,
    pub(super) rgb: Option<Array>,
    pub(super) notes: Vec<String>,
}

/// What was decided of the numbers of a scene by their content; in a [`Reading`] of a part of a scene, what is to hold for it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Decided {
    /// What open is in masks.
    pub(super) open: f32,
    /// What white is in the truth.
    pub(super) truth: f32,
    /// What white is in measurements.
    pub(super) meas: f32,
    /// Where measurements clip, in the unit of their file.
    pub(super) clip: Option<f32>,
    /// [`Scene::unit`].
    pub(super) unit: f32,
    /// Pixels whose masks add up to less than this measure nothing.
    pub(super) least_open: f32,
}

impl Default for Decided {
    fn default() -> Self {
        Self { open: 1.0, truth: 1.0, meas: 1.0, clip: None, unit: 1.0, least_open: 0.0 }
    }
}

impl Parts {
    fn of(source: &Source, reading: &Reading) -> Result<Self, SceneError> {
        if !source.is_named() {
            if reading.mask.is_none() && reading.raw.is_none() {
                source.single()?;
                return Err(SceneError::NotAScene { file: source.file.clone(), what: source.what() });
            }
            let (keys, names, notes) = (reading.keys.clone(), Vec::new(), Vec::new());
            return Ok(Self { keys, names, notes, mask: None, meas: Some(source.single()?), orig: None, rgb: None });
        }
        let present = source.names()?;
        // What is in memory has no names.
        if !present.is_empty()
            && let Some((key, part)) = names::lacking(&reading.keys, &present, reading.mask.is_some())
        {
            return Err(source.missing(key, part, present));
        }
        let mut keys = names::resolved(&reading.keys, &present);
        if reading.mask.is_some() {
            keys.mask.clone_from(&reading.keys.mask);
        }
        let wanted: Vec<&str> = keys.all().into_iter().skip(usize::from(reading.mask.is_some())).collect();
        let NamedArrays { names, mut arrays } = source.arrays(&wanted)?;
        let mut take = |key: &str| arrays.remove(key);
        let (mask, meas, rgb) = (take(&keys.mask), take(&keys.meas), take(&keys.rgb));
        let mut orig = take(&keys.orig);
        // A guess that is no video, but coordinates or the like, was none.
        let is_video = |a: &Array| a.shape().iter().filter(|&&n| n > 1).count() >= 3;
        if keys.orig != reading.keys.orig && !orig.as_ref().is_some_and(is_video) {
            orig = None;
            keys.orig.clone_from(&reading.keys.orig);
        }
        let notes = names::notes(&reading.keys, &keys);
        Ok(Self { keys, names, mask, meas, orig, rgb, notes })
    }
}

/// Reads a scene: a .mat, .h5 or .npz file, a folder that holds each part as `<key>.npy`, or, with masks in a file of their own,
/// measurements in any format.
///
/// # Errors
/// [`SceneError`] naming the file and the variable at fault.
pub fn read(path: &Path, reading: &Reading) -> Result<Scene, SceneError> {
    let source = Source::open(path, reading.raw)?;
    let parts = Parts::of(&source, reading)?;
    assembled(&source, parts, reading)
}

/// Arrays of any number type, in the layout that NumPy's users have: masks `[B, H, W]`, measurements `[N, H, W]` or `[H, W]`, truth
/// `[T, H, W]`, `[T, 3, H, W]` or `[T, H, W, 3]`.
#[derive(Clone, Debug)]
pub struct Arrays {
    /// Masks.
    pub mask: Array,
    /// Measurements; simulated from the truth if there are none.
    pub meas: Option<Array>,
    /// What was in front of the camera.
    pub truth: Option<Array>,
}

/// A scene of arrays in memory, taken as a `.npz` file of them would be.
///
/// # Errors
/// [`SceneError`] naming the array at fault.
pub fn of_arrays(arrays: Arrays, reading: &Reading) -> Result<Scene, SceneError> {
    let Arrays { mask, meas, truth } = arrays;
    let is_rgb = truth.as_ref().is_some_and(|x| matches!(x.shape(), [_, 3, _, _] | [_, _, _, 3]));
    let (orig, rgb) = if is_rgb { (None, truth) } else { (truth, None) };
    let (keys, names, notes) = (reading.keys.clone(), Vec::new(), Vec::new());
    assembled(&Source::memory(), Parts { keys, names, mask: Some(mask), meas, orig, rgb, notes }, reading)
}

pub(super) fn assembled(source: &Source, mut parts: Parts, reading: &Reading) -> Result<Scene, SceneError> {
    let mut notes = std::mem::take(&mut parts.notes);
    let mut field = Field::read(reading)?;
    let mut decided = reading.decided.unwrap_or_default();
    let (mut mask, in_own_unit) = scene_masks(source, &mut parts, reading, &field, &mut decided, &mut notes)?;
    let mut truth = truth(source, &parts, reading, &mut decided, &mut notes)?;
    if parts.meas.is_none() && truth.is_none() {
        return Err(source.missing(
            &parts.keys.meas,
            "measurements, or `orig` or `rgb` to simulate them from",
            parts.names,
        ));
    }
    let stored = parts.meas.take();
    let key = if source.is_named() { parts.keys.meas.as_str() } else { "measurements" };
    let place = Place { file: &source.file, key, format: source.format(), axes: reading.axes };
    let mut meas = stored.as_ref().map(|array| place.frames(array, 1.0)).transpose()?;
    let is_color = reading.cfa.is_some() || matches!(truth, Some(Truth::Rgb(_)));
    if let Some(shift) = reading.shift {
        let seen = [meas.as_mut(), field.dark.as_mut()];
        mask = moved_masks(source, mask, (shift, is_color), seen, truth.as_mut(), &mut notes)?;
    } else if mask.len_of(Axis(0)) == 1 {
        notes.push("there is one mask, so that a measurement is one frame (B = 1); if it moves, data.mask_shift and data.frames say how".into());
    }
    close_hardly_open(&mut mask, reading.decided.is_some(), &mut decided, &mut notes);
    let (mut black, mut left_out) = (0.0, Vec::new());
    if let (Some(meas), Some(array)) = (meas.as_mut(), &stored) {
        if reading.decided.is_none() {
            let (level, note) = reading.sensor.clip.level(meas.view(), light_through(mask.view()).view());
            notes.extend(note);
            decided.clip = level;
        }
        black = take_off_black(meas, &field, (&source.file, key), reading)?;
        if reading.decided.is_none() {
            let seen = (array, meas.view());
            decided.meas = white_of_measurements(&place, seen, &mask, truth.as_ref(), reading, &mut notes);
        }
        *meas /= decided.meas;
        if meas.shape()[1..] == mask.shape()[1..] {
            match reading.decided {
                None if reading.scale.is_none() => {
                    let has_unit = matches!(reading.sensor.noise, SensorNoise::Known(_));
                    let white = decided.meas;
                    decided.unit = rescale((&mask, in_own_unit), meas, truth.as_mut(), (has_unit, white), &mut notes);
                }
                _ => *meas /= decided.unit,
            }
            left_out = look_for_defects(&mut mask, meas, reading, is_color, &mut notes);
        }
    }
    if let (Some(meas), None) = (meas.as_ref().filter(|meas| meas.shape()[1..] == mask.shape()[1..]), reading.decided) {
        let (open, lattice) = (light_through(mask.view()), if is_color { 2 } else { 1 });
        notes.extend(orientation::doubt(open.view(), meas.index_axis(Axis(0), 0), lattice));
    }
    let noise = noise_of(&reading.sensor, mask.view(), meas.as_ref(), &mut notes);
    let mut scene = Scene::new(&source.file, &parts.keys, mask, meas, truth, reading.cfa)?;
    let clip = decided.clip.map(|level| (level - black) / (decided.meas * decided.unit));
    (scene.unit, scene.clip, scene.noise, scene.decided) = (decided.unit, clip, noise, decided);
    scene.left_out = left_out;
    notes.append(&mut scene.warnings);
    scene.warnings = notes;
    Ok(scene)
}

/// Treats a simulated scene, whose masks are told to be `masks`, as one that was read: its sensor and its defects.
///
/// # Errors
/// If no pixel is left that is not defective.
pub fn as_read(scene: &mut Scene, masks: MaskStack, reading: &Reading) -> Result<(), SceneError> {
    let Sensor { black, clip, .. } = reading.sensor;
    let (level, note) = clip.level(scene.measurements.view(), light_through(masks.view()).view());
    scene.warnings.extend(note);
    scene.measurements -= black;
    scene.noise = noise_of(&reading.sensor, masks.view(), Some(&scene.measurements), &mut scene.warnings);
    scene.clip = level.map(|level| level - black);
    let mut mask = masks.view().to_owned();
    scene.left_out =
        look_for_defects(&mut mask, &mut scene.measurements, reading, scene.cfa.is_some(), &mut scene.warnings);
    if reading.defects == Defects::Exclude {
        scene.operator = operator_of(checked(mask, "simulated", &reading.keys.mask)?);
    }
    Ok(())
}

/// The masks `[B, H, W]`, from their own file if they have one, and whether they were in a unit of their own.
fn scene_masks(
    source: &Source,
    parts: &mut Parts,
    reading: &Reading,
    field: &Field,
    decided: &mut Decided,
    notes: &mut Vec<String>,
) -> Result<(Array3<f32>, bool), SceneError> {
    if let Some(path) = &reading.mask {
        let source = Source::open(path, None)?;
        let (masks, key, in_own_unit) = masks_of(&source, reading, field, decided, notes)?;
        // Here, where the file has its name.
        return Ok((checked(masks, &source.file, &key)?.view().to_owned(), in_own_unit));
    }
    let key = &parts.keys.mask;
    let Some(array) = parts.mask.take() else {
        let names = std::mem::take(&mut parts.names);
        return Err(source.missing(key, "the masks; data.mask names a file of their own", names));
    };
    let place = Place { file: &source.file, key, format: source.format(), axes: reading.axes };
    transmittances(&place, &array, reading, field, decided, notes)
}

/// The masks that a file holds, under their name if it has names, that name, and whether they were in a unit of their own.
fn masks_of(
    source: &Source,
    reading: &Reading,
    field: &Field,
    decided: &mut Decided,
    notes: &mut Vec<String>,
) -> Result<(Array3<f32>, String, bool), SceneError> {
    let mut wanted = reading.keys.mask.clone();
    if source.is_named() {
        let own = Keys { mask: reading.keys.mask.clone(), ..Keys::default() };
        wanted = names::resolved(&own, &source.names()?).mask;
        notes.extend(names::notes(&own, &Keys { mask: wanted.clone(), ..own.clone() }));
    }
    let (array, key) = source.array(&wanted, "the masks")?;
    let place = Place { file: &source.file, key: &key, format: source.format(), axes: reading.axes };
    let (masks, in_own_unit) = transmittances(&place, &array, reading, field, decided, notes)?;
    Ok((masks, key, in_own_unit))
}

pub(super) fn checked(masks: Array3<f32>, file: &str, key: &str) -> Result<MaskStack, SceneError> {
    MaskStack::new(masks).map_err(|source| SceneError::Mask { file: file.into(), key: key.into(), source })
}

/// Masks as transmittances, and whether they were in a unit of their own.
fn transmittances(
    place: &Place<'_>,
    array: &Array,
    reading: &Reading,
    field: &Field,
    decided: &mut Decided,
    notes: &mut Vec<String>,
) -> Result<(Array3<f32>, bool), SceneError> {
    let full = match place.is_picture() && array.stored().is_integer() && field.white.is_none() {
        true if is_zero_and_one(array) => 1.0,
        true => {
            let white = scale::of_video(place.key, &Content::of(array, place.format));
            notes.extend(white.note);
            white.value
        }
        false => 1.0,
    };
    let masks = field.transmittances(place.frames(array, 1.0)?, full, (place.key, reading), notes)?;
    Ok(normalised(masks, place.key, reading.decided.is_some(), decided, notes))
}

/// Whether an array has nothing but 0 and 1: labels, as masks are saved in pictures too.
fn is_zero_and_one(array: &Array) -> bool {
    match array.samples() {
        Samples::Bytes(v) => v.iter().all(|&v| v <= 1),
        Samples::Floats(v) => v.iter().all(|&v| v == 0.0 || v == 1.0),
    }
}

/// Masks as transmittances, and whether they were in a unit of their own. Those saved as black and white run to full scale; others that
/// exceed 1 by far are in a unit of their own, in which the most open pixel is taken to be open. Small negative ones are what a dark frame
/// leaves when it is taken off, larger ones are of a differential camera.
fn normalised(
    mut mask: Array3<f32>,
    key: &str,
    is_decided: bool,
    decided: &mut Decided,
    notes: &mut Vec<String>,
) -> (Array3<f32>, bool) {
    let finite = || mask.iter().copied().filter(|v| v.is_finite());
    let (least, highest) = (finite().fold(0.0, f32::min), finite().fold(0.0, f32::max));
    let most = if is_decided { decided.open } else { highest.max(-least) };
    if least < -SMALL * highest {
        notes.push(format!(
            "`{key}`: values down to {least} are taken for those of a differential camera; clipped, dead and hot pixels are not looked for"
        ));
    } else if least < 0.0 {
        let count = mask.iter().filter(|c| **c < 0.0).count();
        notes.push(format!("`{key}`: {count} transmittances below 0, down to {least}, count as 0"));
        // Not `max`: a NaN is to be refused.
        mask.mapv_inplace(|c| if c < 0.0 { 0.0 } else { c });
    }
    if most <= MOST_TRANSMITTANCE {
        return (mask, false);
    }
    let is_black_and_white =
        scale::FULL_SCALES.iter().any(|&(_, full)| full == most) && mask.iter().all(|&v| v == 0.0 || v.abs() == most);
    mask /= most;
    decided.open = most;
    (mask, !is_black_and_white)
}

/// Closes pixels that masks open for next to nothing, as what a dark frame leaves of a shaded border: what they measure is noise, which would be
/// divided by as little.
fn close_hardly_open(mask: &mut Array3<f32>, is_decided: bool, decided: &mut Decided, notes: &mut Vec<String>) {
    if is_signed(mask.view()) {
        return;
    }
    let open = mask.sum_axis(Axis(0));
    if !is_decided {
        decided.least_open = NOT_OPEN * median(&open);
    }
    let hardly = open.mapv(|open| open > 0.0 && open < decided.least_open);
    let count = hardly.iter().filter(|&&hardly| hardly).count();
    if count > 0 {
        let close = |c: &mut f32, hardly: &bool| *c = if *hardly { 0.0 } else { *c };
        mask.outer_iter_mut().for_each(|mut mask| mask.zip_mut_with(&hardly, close));
        notes.push(format!("{count} pixels that masks open for less than 1 % of the usual count as not measured"));
    }
}

/// The share of the usual light that is none.
const NOT_OPEN: f32 = 0.01;
/// Negative transmittances are noise down to this share of the largest.
const SMALL: f32 = 0.1;
/// Gains of single frames may take a transmittance above 1.
const MOST_TRANSMITTANCE: f32 = 2.0;

/// The truth, in units of white.
fn truth(
    source: &Source,
    parts: &Parts,
    reading: &Reading,
    decided: &mut Decided,
    notes: &mut Vec<String>,
) -> Result<Option<Truth>, SceneError> {
    let (key, array) = match (&parts.rgb, &parts.orig) {
        (Some(rgb), _) => (&parts.keys.rgb, rgb),
        (None, Some(orig)) => (&parts.keys.orig, orig),
        (None, None) => return Ok(None),
    };
    let place = Place { file: &source.file, key, format: source.format(), axes: reading.axes };
    if reading.decided.is_none() {
        decided.truth = white_of_video(&place, array, reading, notes);
    }
    let white = decided.truth;
    if parts.rgb.is_none() {
        return Ok(Some(Truth::Sensor(place.frames(array, white)?)));
    }
    let rgb = place.channels(array, white)?;
    if rgb.len_of(Axis(1)) == 3 {
        return Ok(Some(Truth::Rgb(rgb)));
    }
    let expected = "three colors: [T, H, W, 3] or [T, 3, H, W], in .mat [H, W, 3, T]";
    Err(SceneError::Axes { file: source.file.clone(), key: key.clone(), shape: rgb.shape().to_vec(), expected })
}

fn white_of_video(place: &Place<'_>, array: &Array, reading: &Reading, notes: &mut Vec<String>) -> f32 {
    if let Some(scale) = reading.scale {
        return scale;
    }
    let white = scale::of_video(place.key, &Content::of(array, place.format));
    notes.extend(white.note);
    white.value
}

/// What white is in measurements.
fn white_of_measurements(
    place: &Place<'_>,
    (array, meas): (&Array, ArrayView3<'_, f32>),
    mask: &Array3<f32>,
    truth: Option<&Truth>,
    reading: &Reading,
    notes: &mut Vec<String>,
) -> f32 {
    if let Some(scale) = reading.scale {
        return scale;
    }
    let content = Content::of(array, place.format);
    let white = if meas.shape()[1..] == mask.shape()[1..] {
        let mosaic = match truth {
            Some(Truth::Rgb(rgb)) => {
                let mut x = Array3::zeros((rgb.len_of(Axis(0)), rgb.len_of(Axis(2)), rgb.len_of(Axis(3))));
                mosaic_into(reading.cfa.unwrap_or_default(), rgb.view(), x.view_mut());
                Some(x)
            }
            _ => None,
        };
        let sensor = match truth {
            Some(Truth::Sensor(x)) => Some(x.view()),
            _ => mosaic.as_ref().map(|x| x.view()),
        };
        scale::of_measurements(place.key, &content, meas, mask.view(), sensor)
    } else {
        scale::of_video(place.key, &content)
    };
    notes.extend(white.note);
    white.value
}

/// Replaces the one mask by those of all frames, and cuts what was seen to where they are known.
fn moved_masks(
    source: &Source,
    mask: Array3<f32>,
    (shift, is_color): (super::MaskShift, bool),
    seen: [Option<&mut Array3<f32>>; 2],
    truth: Option<&mut Truth>,
    notes: &mut Vec<String>,
) -> Result<Array3<f32>, SceneError> {
    let error = |source_error| SceneError::Shift { file: source.file.clone(), shift, source: source_error };
    let (found, rows, columns) = mask.dim();
    if found != 1 {
        return Err(SceneError::NotOneMask { file: source.file.clone(), found });
    }
    let moved = shift.masks(mask.index_axis_move(Axis(0), 0), is_color).map_err(error)?;
    let mut is_cut = false;
    seen.into_iter().flatten().for_each(|seen| is_cut |= moved.crop(seen));
    match truth {
        Some(Truth::Sensor(x)) => is_cut |= moved.crop(x),
        Some(Truth::Rgb(x)) => is_cut |= moved.crop(x),
        None => {}
    }
    if is_cut {
        let (_, height, width) = moved.masks.dim();
        notes.push(format!("of {rows}×{columns} pixels, the moving mask is known in every frame for {height}×{width}; the others are cut off"));
    }
    Ok(moved.masks)
}

/// The noise that solvers are told of: shot noise is that of the light, which measurements of masks of both signs do not tell.
fn noise_of(
    sensor: &Sensor,
    masks: ArrayView3<'_, f32>,
    meas: Option<&Array3<f32>>,
    notes: &mut Vec<String>,
) -> Option<Noise> {
    let noise = match sensor.noise {
        SensorNoise::None => return None,
        SensorNoise::Known(noise) => noise,
        SensorNoise::Auto => return found_noise(masks, meas?.view(), notes),
    };
    if noise == noise.read_noise() || !is_signed(masks) {
        return Some(noise);
    }
    notes.push("data.sensor.photons is left out: masks of both signs do not tell the light of a pixel; data.sensor.noise is used".into());
    Some(noise.read_noise())
}

/// What is found of the noise, and said.
fn found_noise(masks: ArrayView3<'_, f32>, meas: ArrayView3<'_, f32>, notes: &mut Vec<String>) -> Option<Noise> {
    let open = masks.mapv(f32::abs).sum_axis(Axis(0));
    let found = if meas.shape()[1..] == *open.shape() { Noise::of_closed_pixels(meas, open.view()) } else { None };
    notes.push(match found {
        Some(noise) => format!(
            "data.sensor.noise = \"auto\": read noise of {:.2} (of 255), from pixels that no mask opens",
            255.0 * noise.variance(0.0).sqrt()
        ),
        None => {
            "data.sensor.noise = \"auto\": too few pixels are never opened by a mask to tell the noise; none is assumed"
                .into()
        }
    });
    found.filter(|noise| *noise != Noise::NONE)
}

/// Takes the dark frame, or the black level, off measurements; returns what that is of a clipped pixel at most.
fn take_off_black(
    meas: &mut Array3<f32>,
    field: &Field,
    (file, key): (&str, &str),
    reading: &Reading,
) -> Result<f32, SceneError> {
    let Some(dark) = &field.dark else {
        *meas -= reading.sensor.black;
        return Ok(reading.sensor.black);
    };
    let size = (meas.len_of(Axis(1)), meas.len_of(Axis(2)));
    let dark_file = reading.sensor.dark.as_ref().map_or_else(|| file.to_owned(), |path| path.display().to_string());
    check_size(&dark_file, "data.sensor.dark", dark.view(), key, size)?;
    *meas -= dark;
    // The few pixels that are darkest by chance, or hot, do not lower the level for all others.
    Ok(brightest_hundredth(dark.iter().copied()).unwrap_or(0.0))
}

/// Names pixels that look defective, and leaves them out if that is asked for. Of masks that may sit elsewhere it is too early to say which
/// are: [`Scene::look_for_defects`] names them.
fn look_for_defects(
    mask: &mut Array3<f32>,
    meas: &mut Array3<f32>,
    reading: &Reading,
    is_color: bool,
    notes: &mut Vec<String>,
) -> Vec<LeftOut> {
    let found = defects_of(mask.view(), meas.view(), is_color, reading.masks_off);
    if reading.masks_off == 0 {
        notes.extend(defects::note(&found, reading.defects));
    }
    match reading.defects {
        Defects::Exclude => defects::exclude(&found, mask, meas),
        Defects::Keep => Vec::new(),
    }
}

/// Brings measurements that are far off their scale, or have none as their masks were in a unit of their own, and truth that is too, to
/// one on which the brightest hundredth is white; returns what white was. Without a truth, dark ones are brought there too, as a camera's
/// numbers end with the light of all frames, of which one has a part, and networks know scenes of usual brightness best; but not where noise is told
/// in units of white (`has_unit`), which in the file is `full`.
fn rescale(
    (mask, in_own_unit): (&Array3<f32>, bool),
    meas: &mut Array3<f32>,
    truth: Option<&mut Truth>,
    (has_unit, full): (bool, f32),
    warnings: &mut Vec<String>,
) -> f32 {
    let Some(white) = brightest_light(meas.view(), mask.view()) else { return 1.0 };
    let unknown = in_own_unit && truth.is_none();
    let unusual = truth.is_none() && white < *scale::BELIEVABLE.start();
    if PLAUSIBLE_WHITE.contains(&white) && !unknown {
        if unusual && has_unit {
            warnings.push(format!(
                "the brightest hundredth is {white:.2} of white, which is taken to be {full}; data.scale = {} would make it white",
                four_digits(white * full)
            ));
        }
        if !unusual || has_unit {
            return 1.0;
        }
    }
    *meas /= white;
    let values = match truth {
        None => None,
        Some(Truth::Sensor(x)) => Some(x.view_mut().into_dyn()),
        Some(Truth::Rgb(x)) => Some(x.view_mut().into_dyn()),
    };
    let is_off = |v: f32| v > 0.0 && !PLAUSIBLE_WHITE.contains(&v);
    if let Some(mut x) = values.filter(|x| brightest_hundredth(x.iter().copied()).is_some_and(is_off)) {
        x /= white;
    }
    let why = match () {
        () if unknown => "masks are in a unit of their own",
        () if PLAUSIBLE_WHITE.contains(&white) => "measurements are darker than scenes are",
        () => "measurements are off their scale",
    };
    warnings.push(format!(
        "{why}: white is taken to be {} (the brightest hundredth), and the result scaled likewise; data.scale fixes another",
        four_digits(white * full)
    ));
    white
}

/// A number above 0 as people write it, with four digits that mean something.
fn four_digits(value: f32) -> String {
    let digits = 3 - value.log10().floor() as i32;
    if (-2..=7).contains(&digits) { format!("{value:.*}", digits.max(0) as usize) } else { format!("{value:.3e}") }
}

/// A video, and what is to be said about how it was read.
#[derive(Clone, Debug)]
pub struct Video {
    /// `[T, C, H, W]`, C = 1 or 3, in `[0, 1]`.
    pub frames: Array4<f32>,
    /// What looked odd but is no error.
    pub notes: Vec<String>,
}

/// Reads any video as gray `[T, 1, H, W]` in `[0, 1]`: [`read_video`], whose color becomes luma,
/// 0.299 R + 0.587 G + 0.114 B (ITU-R BT.601, as MATLAB's `rgb2gray`).
///
/// # Errors
/// [`SceneError`] naming the file and what is wrong with it.
pub fn read_gray_video(path: &Path, reading: &Reading) -> Result<Video, SceneError> {
    let Video { frames, notes } = read_video(path, reading)?;
    Ok(Video { frames: luma(frames), notes })
}

/// Reads any video, gray `[T, 1, H, W]` or color `[T, 3, H, W]`, in `[0, 1]`: a clip, TIFF, GIF, Y4M, a folder of pictures, or the
/// `orig` (else `rgb`) of a file of arrays.
///
/// # Errors
/// [`SceneError`] naming the file and what is wrong with it.
pub fn read_video(path: &Path, reading: &Reading) -> Result<Video, SceneError> {
    let source = Source::open(path, reading.raw)?;
    let mut notes = Vec::new();
    let (array, key) = if source.is_named() {
        let names = source.names()?;
        let keys = names::resolved(&reading.keys, &names);
        let key = if names.contains(&keys.orig) { keys.orig.clone() } else { keys.rgb.clone() };
        let array = source.arrays(&[key.as_str()])?.arrays.remove(&key);
        let array = array.ok_or_else(|| source.missing(&reading.keys.orig, "the video", names))?;
        notes.extend(names::notes(
            &reading.keys,
            &Keys { mask: reading.keys.mask.clone(), meas: reading.keys.meas.clone(), ..keys },
        ));
        (array, key)
    } else {
        (source.video()?, "frames".to_owned())
    };
    let place = Place { file: &source.file, key: &key, format: source.format(), axes: reading.axes };
    if place.is_picture() && array.shape()[0] < 2 && source.what() == "a picture" {
        return Err(SceneError::TooFewFrames { file: source.file, frames: 1, needed: 2 });
    }
    let white = white_of_video(&place, &array, reading, &mut notes);
    let frames = place.channels(&array, white)?;
    let (count, _, height, width) = frames.dim();
    // A few columns of many frames are more likely frames.
    if reading.axes.is_none() && !place.is_picture() && 4 * width < count.min(height) {
        notes.push(format!(
            "`{key}`: {count} frames of {height}×{width}; if the last axis are the frames, data.axes = \"hwt\" (--axes hwt of sci simulate) says so"
        ));
    }
    Ok(Video { frames, notes })
}

/// A video `[T, C, H, W]`, C = 1 or 3, as luma `[T, 1, H, W]`.
fn luma(video: Array4<f32>) -> Array4<f32> {
    if video.len_of(Axis(1)) == 1 {
        return video;
    }
    let mut gray = Array3::zeros(video.index_axis(Axis(1), 0).raw_dim());
    for (channel, weight) in video.axis_iter(Axis(1)).zip([0.299, 0.587, 0.114]) {
        gray.scaled_add(weight, &channel);
    }
    gray.insert_axis(Axis(1))
}

/// Reads masks `[B, H, W]` alone, from a file of any format or a folder of pictures, and says what is odd about them.
///
/// # Errors
/// [`SceneError`] naming the file and what is wrong with it.
pub fn read_mask(path: &Path, reading: &Reading) -> Result<(MaskStack, Vec<String>), SceneError> {
    let source = Source::open(path, None)?;
    let mut notes = Vec::new();
    let (masks, key, _) = masks_of(&source, reading, &Field::default(), &mut Decided::default(), &mut notes)?;
    Ok((checked(masks, &source.file, &key)?, notes))
}
