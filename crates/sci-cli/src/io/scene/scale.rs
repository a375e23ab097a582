//! Owns the question of what white is stored as, where neither the experiment nor the file says.
//!
//! By type, whole numbers of 8 bits run to 255, floats in `.mat` to 255 and elsewhere to 1. More bits have no one habit: 10, 12 and 14
//! bits are stored in 16, at the lower or the upper end. So content decides, one rule for arrays and pictures, and what was decided is
//! said.

use crate::io::Format;
use crate::io::samples::{Array, SampleType, Samples};

use ndarray::{Array3, ArrayView3, Axis};

/// White in numbers of 8, 10, 12, 14 and 16 bits.
pub(super) const FULL_SCALES: [(u32, f32); 5] = [(8, 255.0), (10, 1023.0), (12, 4095.0), (14, 16383.0), (16, 65535.0)];
/// Bright scenes and filters overshoot white a little.
const OVERSHOOT: f32 = 2.0;
/// Where the brightest hundredth of measurements lies, in units of a white that is to be believed.
pub(super) const BELIEVABLE: std::ops::RangeInclusive<f32> = 0.3..=1.3;
/// How far the ratio of measurements to masked sums may be from the usual full scale, to stand for it.
const NEAR: f32 = 0.1;
/// The same of scales that are not usual.
const HIT: f32 = 0.005;

/// What white is stored as.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct White {
    pub(super) value: f32,
    /// What is to be said about it.
    pub(super) note: Option<String>,
}

impl White {
    fn plain(value: f32) -> Self {
        Self { value, note: None }
    }

    fn noted(key: &str, value: f32, why: String) -> Self {
        Self { value, note: Some(format!("`{key}`: {why}; white is taken to be {value} (data.scale fixes another)")) }
    }
}

/// What the numbers of an array look like.
pub(super) struct Content {
    /// The largest, without its sign.
    max: f32,
    /// Whether all are whole.
    whole: bool,
    /// Zeros at the lower end of all numbers, if whole.
    low_zeros: u32,
    stored: SampleType,
    stated: Option<f32>,
    usual: f32,
}

impl Content {
    pub(super) fn of(array: &Array, format: Format) -> Self {
        let (mut max, mut whole, mut ones) = (0f32, true, 0u32);
        match array.samples() {
            Samples::Bytes(bytes) => {
                max = f32::from(bytes.iter().copied().max().unwrap_or(0));
                ones = u32::from(bytes.iter().fold(0, |ones, &b| ones | b));
            }
            Samples::Floats(values) => {
                for v in values.iter().copied().filter(|v| v.is_finite()) {
                    max = max.max(v.abs());
                    whole &= v.fract() == 0.0;
                    ones |= v.abs() as u32;
                }
            }
        }
        let usual = usual(format, array.stored());
        Self { max, whole, low_zeros: ones.trailing_zeros(), stored: array.stored(), stated: array.white(), usual }
    }

    /// The file's own word, if the numbers do not contradict it.
    fn stated(&self) -> Option<f32> {
        self.stated.filter(|&white| self.max <= white)
    }

    /// Whether there are whole numbers of more than 8 bits.
    fn is_deep(&self) -> bool {
        self.stored.is_integer() && self.stored.size() > 1
    }

    /// The full scale of the fewest bits that hold all numbers, unless none does.
    fn full_scale(&self) -> Option<(u32, f32)> {
        // Cameras that align at the upper end leave zeros at the lower one; a few gray levels do so by chance.
        let aligned_high =
            self.is_deep() && (2..=8).contains(&self.low_zeros) && self.max >= (16u32 << self.low_zeros) as f32;
        let upper = FULL_SCALES[4];
        let smallest = FULL_SCALES.into_iter().find(|&(_, full)| self.max <= full)?;
        Some(if aligned_high && smallest.0 > 8 { upper } else { smallest })
    }

    fn bits_of_type(&self) -> usize {
        8 * self.stored.size()
    }
}

/// What white is stored as by habit.
fn usual(format: Format, stored: SampleType) -> f32 {
    if format == Format::Mat || stored.is_integer() { 255.0 } else { 1.0 }
}

/// White of a video.
pub(super) fn of_video(key: &str, content: &Content) -> White {
    if let Some(white) = content.stated() {
        return White::plain(white);
    }
    let Content { max, usual, .. } = *content;
    if content.is_deep() {
        return match content.full_scale() {
            Some((8, full)) if content.stored == SampleType::U16 => {
                White::noted(key, full, format!("numbers of 16 bits that do not exceed {max}"))
            }
            Some((16, full)) => White::plain(full),
            Some((bits, full)) if bits > 8 => White::noted(
                key,
                full,
                format!("numbers of {} bits that hold {bits} (up to {max})", content.bits_of_type()),
            ),
            _ => White::plain(usual),
        };
    }
    if content.stored.is_integer() || max <= 0.0 {
        return White::plain(usual);
    }
    let (unit, bytes) = (max <= OVERSHOOT, max > 2.0 * OVERSHOOT && max <= OVERSHOOT * 255.0);
    match content.full_scale() {
        _ if unit && usual != 1.0 => White::noted(key, 1.0, format!("no value exceeds {max}")),
        _ if bytes && usual != 255.0 => White::noted(key, 255.0, format!("values up to {max}")),
        Some((bits, full)) if content.whole && max > OVERSHOOT * 255.0 => {
            White::noted(key, full, format!("whole numbers of {bits} bits (up to {max})"))
        }
        _ => White::plain(usual),
    }
}

/// White of measurements `[N, H, W]`, as stored, through `masks` `[B, H, W]`; `truth` `[T, H, W]` in units of white tells it best.
pub(super) fn of_measurements(
    key: &str,
    content: &Content,
    meas: ArrayView3<'_, f32>,
    masks: ArrayView3<'_, f32>,
    truth: Option<ArrayView3<'_, f32>>,
) -> White {
    if let Some(white) = content.stated() {
        return White::plain(white);
    }
    let usual = content.usual;
    if let Some(white) = truth.and_then(|x| told_by_truth(meas, masks, x, usual)) {
        return if white == usual {
            White::plain(white)
        } else {
            White::noted(key, white, "the truth tells the scale of the measurements".into())
        };
    }
    let Some(bright) = super::brightest_light(meas, masks) else { return White::plain(usual) };
    if content.is_deep() {
        return of_deep_measurements(key, content, bright);
    }
    // Masks in a unit of their own make measurements so too, of which nothing is known.
    let transmittances = masks.iter().all(|&c| c.abs() <= 1.0);
    if content.stored.is_integer() || super::PLAUSIBLE_WHITE.contains(&(bright / usual)) || !transmittances {
        return White::plain(usual);
    }
    let deeper = content.full_scale().filter(|_| content.whole).map(|(_, full)| full);
    let found = [1.0, 255.0].into_iter().chain(deeper).find(|full| BELIEVABLE.contains(&(bright / full)));
    match found {
        Some(white) => White::noted(key, white, format!("values up to {}", content.max)),
        None => White::plain(usual),
    }
}

/// A camera's numbers end at full scale; the sums of frames of 8 bits are of more bits too, but not brighter than the masks let through.
fn of_deep_measurements(key: &str, content: &Content, bright: f32) -> White {
    let Content { max, .. } = *content;
    if max <= 255.0 {
        return White::plain(255.0);
    }
    if bright <= 255.0 * *BELIEVABLE.end() {
        return White::noted(key, 255.0, format!("numbers up to {max}, as sums of frames of 8 bits have"));
    }
    match content.full_scale() {
        Some((bits, full)) => White::noted(
            key,
            full,
            format!("numbers of {} bits that hold {bits} (up to {max})", content.bits_of_type()),
        ),
        None => White::plain(content.usual),
    }
}

/// The scale on which the first measurement is the masked sum of the truth.
fn told_by_truth(
    meas: ArrayView3<'_, f32>,
    masks: ArrayView3<'_, f32>,
    truth: ArrayView3<'_, f32>,
    usual: f32,
) -> Option<f32> {
    let frames = masks.len_of(Axis(0));
    let fits = meas.dim().0 > 0 && truth.dim().0 >= frames && meas.shape()[1..] == truth.shape()[1..];
    if !fits || masks.shape()[1..] != truth.shape()[1..] {
        return None;
    }
    let expected: Array3<f32> = &masks * &truth.slice(ndarray::s![..frames, .., ..]);
    let expected = expected.sum_axis(Axis(0));
    let (mut both, mut square, mut measured) = (0f64, 0f64, 0f64);
    for (&y, &e) in meas.index_axis(Axis(0), 0).iter().zip(&expected) {
        let (y, e) = (f64::from(y), f64::from(e));
        both += y * e;
        square += e * e;
        measured += y * y;
    }
    let ratio = both / square;
    // The part of y that no multiple of the masked sum explains.
    let unexplained = 1.0 - both * both / (square * measured);
    let near = |full: f32, most: f32| (ratio as f32 / full - 1.0).abs() < most;
    // What a camera adds to the usual scale is its own; else a full scale must be hit, or the unit is one of its own.
    let known = || [1.0].into_iter().chain(FULL_SCALES.map(|s| s.1)).find(|&full| near(full, HIT));
    let scale = || if near(usual, NEAR) { usual } else { known().unwrap_or(ratio as f32) };
    (unexplained < 0.05 && ratio > 0.0).then(scale)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;

    fn content(values: &[f32], stored: SampleType, format: Format) -> Content {
        Content::of(&Array::new(vec![values.len()], Samples::Floats(values.to_vec()), stored).unwrap(), format)
    }

    #[track_caller]
    fn white(values: &[f32], stored: SampleType, format: Format, expected: f32, is_said: bool) {
        let found = of_video("orig", &content(values, stored, format));
        assert_eq!((found.value, found.note.is_some()), (expected, is_said), "{found:?}");
    }

    #[test]
    fn twelve_bits_in_sixteen_are_noticed_in_pictures_and_arrays_alike() {
        for format in [Format::Png, Format::Tiff, Format::Npy, Format::Mat] {
            white(&[0.0, 17.0, 3900.0], SampleType::U16, format, 4095.0, true);
            white(&[0.0, 17.0, 1000.0], SampleType::U16, format, 1023.0, true);
            white(&[0.0, 17.0, 16000.0], SampleType::U16, format, 16383.0, true);
            white(&[0.0, 17.0, 60001.0], SampleType::U16, format, 65535.0, false);
            white(&[0.0, 17.0, 200.0], SampleType::U8, format, 255.0, false);
        }
        // Twelve bits at the upper end, the brightest of them well below white.
        white(&[160.0, 3216.0, 12816.0], SampleType::U16, Format::Png, 65535.0, false);
        let found = of_video("orig", &content(&[17.0, 3900.0], SampleType::U16, Format::Png));
        assert!(found.note.unwrap().contains("16 bits that hold 12 (up to 3900)"));
    }

    #[test]
    fn floats_have_their_habits_unless_they_contradict_them() {
        white(&[0.1, 1.0], SampleType::F32, Format::Npz, 1.0, false);
        white(&[0.1, 3.0], SampleType::F32, Format::Npz, 1.0, false);
        white(&[0.1, 254.5], SampleType::F32, Format::Npz, 255.0, true);
        white(&[1.0, 3000.0], SampleType::F32, Format::Npz, 4095.0, true);
        white(&[0.1, 240.5], SampleType::F64, Format::Mat, 255.0, false);
        white(&[0.1, 0.9], SampleType::F64, Format::Mat, 1.0, true);
        white(&[0.0, 0.0], SampleType::F64, Format::Mat, 255.0, false);
    }

    #[test]
    fn the_files_own_word_counts_unless_the_numbers_exceed_it() {
        let array =
            |max: f32| Array::new(vec![1], Samples::Floats(vec![max]), SampleType::U16).unwrap().with_white(4095.0);
        assert_eq!(of_video("orig", &Content::of(&array(100.0), Format::Raw)), White::plain(4095.0));
        assert_eq!(of_video("orig", &Content::of(&array(60001.0), Format::Raw)), White::plain(65535.0));
    }

    /// Masks that let half of eight frames through, and the sum of frames of brightness 0.25 to 1.
    fn sums() -> (Array3<f32>, Array3<f32>, Array3<f32>) {
        let masks = Array3::from_shape_fn((8, 6, 6), |(t, y, x)| ((t + y + x) % 2) as f32);
        let truth = Array3::from_shape_fn((8, 6, 6), |(t, y, x)| 0.25 + ((t * 7 + y * 5 + x * 3) % 16) as f32 / 20.0);
        let y = (&masks * &truth).sum_axis(Axis(0)).insert_axis(Axis(0));
        (masks, truth, y)
    }

    #[test]
    fn truth_in_the_file_tells_the_scale_of_the_measurements() {
        let (masks, truth, y) = sums();
        for (full, format) in [(1.0, Format::Mat), (255.0, Format::Npz), (4095.0, Format::Npy)] {
            let stored = &y * full;
            let content = content(stored.as_slice().unwrap(), SampleType::F32, format);
            let found = of_measurements("meas", &content, stored.view(), masks.view(), Some(truth.view()));
            assert_eq!((found.value, found.note.is_some()), (full, true));
        }
        let other = told_by_truth(y.view(), masks.view(), (&truth * 0.5).view(), 1.0).unwrap();
        assert!((other - 2.0).abs() < 1e-4, "{other}");
        assert_eq!(told_by_truth(y.view(), masks.view(), (truth - 0.5).view(), 1.0), None);
    }

    #[test]
    fn measurements_of_a_camera_are_told_from_sums_of_bytes() {
        let (masks, _, y) = sums();
        let deep = |full: f32| {
            let stored = y.mapv(|v| (v * full).round());
            let content = content(stored.as_slice().unwrap(), SampleType::U16, Format::Tiff);
            of_measurements("meas", &content, stored.view(), masks.view(), None)
        };
        let found = deep(255.0);
        assert_eq!(found.value, 255.0);
        assert!(found.note.unwrap().contains("sums of frames"));
        // Four frames' worth of light at most, on a scale that ends at 4095.
        assert_eq!(deep(4095.0 / 4.0).value, 4095.0);
        assert_eq!(deep(20.0).value, 255.0);
    }

    #[test]
    fn float_measurements_off_their_habit_keep_a_scale_that_is_one() {
        let (masks, _, y) = sums();
        let found = |full: f32, format| {
            let stored = &y * full;
            let content = content(stored.as_slice().unwrap(), SampleType::F64, format);
            of_measurements("meas", &content, stored.view(), masks.view(), None)
        };
        assert_eq!((found(1.0, Format::Mat).value, found(255.0, Format::Npz).value), (1.0, 255.0));
        assert_eq!((found(255.0, Format::Mat), found(1.0, Format::Npz)), (White::plain(255.0), White::plain(1.0)));
        // Of this nothing is known, and the caller makes its brightest hundredth white.
        assert_eq!(found(1e-4, Format::Npz), White::plain(1.0));
    }
}
