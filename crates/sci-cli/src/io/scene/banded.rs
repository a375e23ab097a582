//! Owns a scene on disk that is read in bands of rows, a measurement at a time.

use std::ops::Range;
use std::path::Path;

use ndarray::{Array2, Axis, concatenate, s};
use sci_forward::{CfaPattern, MaskError, VideoShape};

use super::layout::{FileAxes, Place};
use super::read::{Parts, assembled};
use super::source::Source;
use super::{Keys, Reading, Scene, SceneError, Truth, names};
use crate::io::Format;
use crate::io::defects::{self, Defects};
use crate::io::samples::{Array, Samples};
use crate::io::slab::{self, Stored};

/// A scene of which a band of rows is in memory at a time.
///
/// What white is, where measurements clip and what open is in masks is decided once, by rows from all over the first measurement, and holds for all
/// bands.
#[derive(Clone, Debug)]
pub struct Banded {
    file: String,
    reading: Reading,
    mask: Part,
    meas: Option<Part>,
    truth: Option<Part>,
    shape: VideoShape,
    count: usize,
    /// The pattern of a color sensor, `None` for a gray one.
    pub cfa: Option<CfaPattern>,
    /// As [`Scene::unit`].
    pub unit: f32,
    /// What looked odd but is no error.
    pub warnings: Vec<String>,
}

/// Rows that are looked at together, to decide what numbers mean.
const BLOCK: usize = 16;

/// An array that plays a part.
#[derive(Clone, Debug)]
struct Part {
    key: String,
    stored: Stored,
    axes: FileAxes,
    format: Format,
}

impl Part {
    fn size(&self) -> (usize, usize) {
        (self.stored.shape()[self.axes.row], self.stored.shape()[self.axes.column])
    }

    fn frames(&self) -> usize {
        self.axes.frame.map_or(1, |axis| self.stored.shape()[axis])
    }

    /// Some rows of some frames.
    fn read(&self, frames: Range<usize>, rows: Range<usize>) -> Result<Array, SceneError> {
        let mut ranges: Vec<Range<usize>> = self.stored.shape().iter().map(|&length| 0..length).collect();
        ranges[self.axes.row] = rows;
        if let Some(axis) = self.axes.frame {
            ranges[axis] = frames;
        }
        Ok(self.stored.read(&ranges)?)
    }
}

impl Banded {
    /// Looks at a scene; nothing of one whose format has to be read whole. [`Banded::unpack`] and [`Banded::decide`] come next.
    ///
    /// # Errors
    /// [`SceneError`] naming the file and what is wrong with it.
    pub fn open(path: &Path, reading: &Reading) -> Result<Option<Self>, SceneError> {
        let file = path.display().to_string();
        let Some(slab::Arrays { named, format }) = slab::arrays(path)? else { return Ok(None) };
        let listed: Vec<String> = named.iter().map(|(name, _)| name.clone()).collect();
        let missing = |key: &str, part| {
            let near = names::suggestion(key, &listed, &Keys::default());
            SceneError::MissingKey { file: file.clone(), key: key.into(), part, near, present: listed.clone() }
        };
        if let (Some((key, part)), true) =
            (names::lacking(&reading.keys, &listed, reading.mask.is_some()), format != Format::Npy || path.is_dir())
        {
            return Err(missing(key, part));
        }
        let mut keys = names::resolved(&reading.keys, &listed);
        // The only array of a file without names is the measurements, if masks have a file of their own.
        if let ([only], Some(_), Format::Npy, false) = (listed.as_slice(), &reading.mask, format, path.is_dir()) {
            keys.meas.clone_from(only);
        }
        // As in a scene that is read whole: a guess that is no video was none.
        let is_video = |(_, stored): &(String, Stored)| stored.shape().iter().filter(|&&n| n > 1).count() >= 3;
        if keys.orig != reading.keys.orig && !named.iter().any(|array| array.0 == keys.orig && is_video(array)) {
            keys.orig.clone_from(&reading.keys.orig);
        }
        let part_of = |named: &[(String, Stored)], key: &str, format: Format, channels: usize| {
            let (_, stored) = named.iter().find(|(name, _)| name == key)?;
            let place = Place { file: &file, key, format, axes: reading.axes };
            let axes = place.file_axes(stored.shape(), channels).filter(|_| stored.in_parts());
            Some(axes.map(|axes| Part { key: key.to_owned(), stored: stored.clone(), axes, format }))
        };
        let mask = match &reading.mask {
            None => part_of(&named, &keys.mask, format, 1),
            Some(path) => {
                let Some(own) = slab::arrays(path)? else { return Ok(None) };
                // What orders its axes in another way is put in order by reading it whole.
                if (own.format == Format::Mat) != (format == Format::Mat) {
                    return Ok(None);
                }
                let listed: Vec<String> = own.named.iter().map(|(name, _)| name.clone()).collect();
                let found = names::resolved(&Keys { mask: reading.keys.mask.clone(), ..Keys::default() }, &listed);
                let key = if own.named.len() == 1 { listed[0].clone() } else { found.mask };
                part_of(&own.named, &key, own.format, 1)
            }
        };
        let mask = mask.ok_or_else(|| missing(&keys.mask, "the masks; data.mask names a file of their own"))?;
        let meas = part_of(&named, &keys.meas, format, 1);
        let rgb = part_of(&named, &keys.rgb, format, 3);
        let is_color = rgb.is_some() || reading.cfa.is_some();
        let truth = if rgb.is_some() { rgb } else { part_of(&named, &keys.orig, format, 1) };
        // What is stored in another way than the plain ones is read whole.
        let (Some(mask), false, false) = (mask, matches!(meas, Some(None)), matches!(truth, Some(None))) else {
            return Ok(None);
        };
        let (meas, truth) = (meas.flatten(), truth.flatten());
        let frames = mask.frames();
        if frames == 0 || mask.size().0 == 0 || mask.size().1 == 0 {
            let why = format!("`{}` has shape {:?}: nothing is in it", mask.key, mask.stored.shape());
            return Err(SceneError::NotInBands { file, why });
        }
        let count = match (&meas, &truth) {
            (Some(meas), _) => meas.frames(),
            (None, Some(truth)) => truth.frames() / frames,
            (None, None) => return Err(missing(&keys.meas, "measurements, or the truth to simulate them from")),
        };
        for part in [&meas, &truth].into_iter().flatten() {
            if part.size() != mask.size() {
                let (size, mask_size) = (part.size(), mask.size());
                return Err(SceneError::SizeMismatch { file, key: part.key.clone(), size, mask: mask.key, mask_size });
            }
        }
        if count == 0 {
            let found = truth.map_or(0, |truth| truth.frames());
            return Err(SceneError::TooFewFrames { file, frames: found, needed: frames });
        }
        let (height, width) = mask.size();
        let warnings = names::notes(&reading.keys, &Keys { mask: reading.keys.mask.clone(), ..keys.clone() });
        let reading = Reading { keys, mask: None, ..reading.clone() };
        let cfa = is_color.then(|| reading.cfa.unwrap_or_default());
        let shape = VideoShape { frames, height, width };
        Ok(Some(Self { file, reading, mask, meas, truth, shape, count, cfa, unit: 1.0, warnings }))
    }

    /// Unpacks what is packed to files in `folder` that have no names, and are gone with the scene.
    ///
    /// # Errors
    /// [`SceneError`] naming the file and what is wrong with it.
    pub fn unpack(&mut self, folder: &Path) -> Result<(), SceneError> {
        let parts = [Some(&mut self.mask), self.meas.as_mut(), self.truth.as_mut()];
        parts.into_iter().flatten().try_for_each(|part| Ok(part.stored.unpack(folder)?))
    }

    /// Decides by `rows` rows of the first measurement what the numbers mean: the sky at the top of a scene is brighter than its middle, so that they
    /// are from all over it.
    ///
    /// # Errors
    /// Those of reading them, and if they tell a white that does not go with the truth.
    pub fn decide(&mut self, rows: usize) -> Result<(), SceneError> {
        let (height, blocks) = (self.shape.height, (rows / BLOCK).max(1));
        // At even rows, where a Bayer pattern begins.
        let apart = (height / blocks / 2 * 2).max(BLOCK);
        let spread: Vec<Range<usize>> =
            (0..height).step_by(apart).map(|first| first..(first + BLOCK).min(height)).collect();
        let mut part = self.part(&[0], &spread)?;
        // Pixels of two blocks are no neighbours, and have other rows here.
        part.warnings.retain(|note| !defects::is_note(note));
        for note in part.warnings.iter_mut().filter(|note| note.starts_with(|c: char| c.is_ascii_digit())) {
            *note = format!("of the rows that were looked at, {note}");
        }
        if part.unit != 1.0 && self.truth.is_some() {
            let why = "neither measurements nor truth are on a usual scale; say in data.scale what white is".into();
            return Err(SceneError::NotInBands { file: self.file.clone(), why });
        }
        self.reading.decided = Some(part.decided);
        (self.unit, self.cfa) = (part.unit, part.cfa);
        self.warnings.extend(part.warnings);
        Ok(())
    }

    /// B frames of the size of the sensor.
    pub fn shape(&self) -> VideoShape {
        self.shape
    }

    /// N, measurements.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Whether there is no measurement.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// The frames of the truth that measurement `k` sums, if it reaches that far.
    fn frames_of(&self, k: usize) -> Option<(&Part, Range<usize>)> {
        let b = self.shape.frames;
        let truth = self.truth.as_ref()?;
        (truth.frames() >= (k + 1) * b).then_some((truth, k * b..(k + 1) * b))
    }

    /// The scene that these rows of measurement `k` are, its only one.
    ///
    /// # Errors
    /// [`SceneError`] naming the file and what is wrong with it.
    ///
    /// # Panics
    /// If there is no such measurement, or there are no such rows.
    pub fn band(&self, k: usize, rows: Range<usize>) -> Result<Scene, SceneError> {
        // Hot pixels are told from highlights by another measurement.
        let other = (k + 1) % self.count;
        let looks = self.reading.defects == Defects::Exclude && self.meas.is_some() && other != k;
        let both = if looks { vec![k, other] } else { vec![k] };
        let mut scene = self.part(&both, &[rows])?;
        scene.measurements = scene.measurements.slice_move(s![..1, .., ..]);
        Ok(scene)
    }

    /// The scene that these rows of measurements are, with the truth of the first of them.
    fn part(&self, chosen: &[usize], rows: &[Range<usize>]) -> Result<Scene, SceneError> {
        let read = |part: &Part, frames: Range<usize>| -> Result<Array, SceneError> {
            let blocks = rows.iter().map(|rows| part.read(frames.clone(), rows.clone()));
            Ok(Array::joined(blocks.collect::<Result<Vec<_>, _>>()?, part.axes.row))
        };
        let mask = Some(read(&self.mask, 0..self.shape.frames)?);
        let meas = |part: &Part| match (part.axes.frame, chosen) {
            (Some(axis), [_, _, ..]) => {
                let all = chosen.iter().map(|&k| read(part, k..k + 1)).collect::<Result<Vec<_>, _>>()?;
                Ok::<_, SceneError>(Array::joined(all, axis))
            }
            _ => read(part, chosen[0]..chosen[0] + 1),
        };
        let meas = self.meas.as_ref().map(meas).transpose()?;
        let truth = self.frames_of(chosen[0]).map(|(part, frames)| read(part, frames)).transpose()?;
        let (rgb, orig) = if self.has_rgb() { (truth, None) } else { (None, truth) };
        let source = Source::part(self.file.clone(), self.mask.format);
        let keys = self.reading.keys.clone();
        assembled(&source, Parts { keys, names: Vec::new(), mask, meas, orig, rgb, notes: Vec::new() }, &self.reading)
    }

    fn place<'p>(&'p self, part: &'p Part) -> Place<'p> {
        Place { file: &self.file, key: &part.key, format: part.format, axes: self.reading.axes }
    }

    fn has_rgb(&self) -> bool {
        self.truth.as_ref().is_some_and(|truth| truth.key == self.reading.keys.rgb)
    }

    /// Frame `t` of the truth of measurement `k`, if it reaches that far.
    ///
    /// # Errors
    /// As [`Banded::band`].
    pub fn truth_frame(&self, k: usize, t: usize) -> Result<Option<Truth>, SceneError> {
        let Some((part, frames)) = self.frames_of(k) else { return Ok(None) };
        let array = part.read(frames.start + t..frames.start + t + 1, 0..self.shape.height)?;
        let place = self.place(part);
        let white = self.reading.decided.unwrap_or_default().truth;
        Ok(Some(if self.has_rgb() {
            Truth::Rgb(place.channels(&array, white)?)
        } else {
            Truth::Sensor(place.frames(&array, white)?)
        }))
    }

    /// y `[H, W]` of measurement `k`.
    ///
    /// # Errors
    /// As [`Banded::band`].
    ///
    /// # Panics
    /// If there is no such measurement.
    pub fn y(&self, k: usize) -> Result<Array2<f32>, SceneError> {
        if let Some(part) = &self.meas {
            let decided = self.reading.decided.unwrap_or_default();
            let stored = self.place(part).frames(&part.read(k..k + 1, 0..self.shape.height)?, 1.0)?;
            let black = self.reading.sensor.black;
            return Ok(stored.index_axis_move(Axis(0), 0).mapv(|y| (y - black) / decided.meas / decided.unit));
        }
        let strip = |rows: Range<usize>| match self.band(k, rows.clone()) {
            Err(SceneError::Mask { source: MaskError::AllClosed, .. }) => {
                Ok(Array2::zeros((rows.len(), self.shape.width)))
            }
            scene => Ok(scene?.y(0).to_owned()),
        };
        let strips = self.strips().map(strip);
        let strips = strips.collect::<Result<Vec<Array2<f32>>, SceneError>>()?;
        let views: Vec<_> = strips.iter().map(|strip| strip.view()).collect();
        Ok(concatenate(Axis(0), &views).expect("strips of one width"))
    }

    /// All rows, few at a time.
    fn strips(&self) -> impl Iterator<Item = Range<usize>> {
        const ROWS: usize = 64;
        let height = self.shape.height;
        (0..height).step_by(ROWS).map(move |first| first..(first + ROWS).min(height))
    }

    /// A checksum of measurements: of y, or, where y is simulated, of the masks and the truth as they are stored, which is less work.
    ///
    /// # Errors
    /// As [`Banded::band`].
    ///
    /// # Panics
    /// If there is no such measurement.
    pub fn checksum(&self, measurements: &[usize]) -> Result<u32, SceneError> {
        let mut sum = crc32fast::Hasher::new();
        let mut add = |array: &Array| match array.samples() {
            Samples::Bytes(bytes) => sum.update(bytes),
            Samples::Floats(values) => sum.update(&values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>()),
        };
        for rows in self.strips() {
            add(&self.mask.read(0..self.shape.frames, rows)?);
        }
        for &k in measurements {
            let (part, frames) = match &self.meas {
                Some(meas) => (meas, k..k + 1),
                None => self.frames_of(k).expect("what is simulated has a truth"),
            };
            for rows in self.strips() {
                add(&part.read(frames.clone(), rows)?);
            }
        }
        Ok(sum.finalize())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array, Array3, Array4, Dimension};
    use ndarray_npy::{NpzWriter, WritableElement};

    /// A scene of bytes whose masks have this shape, and the folder that it is in.
    fn scene(masks: [usize; 3], frames: usize) -> (tempfile::TempDir, std::path::PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.npz");
        let mut npz = NpzWriter::new(std::fs::File::create(&path).unwrap());
        npz.add_array("mask", &Array3::<u8>::ones(masks)).unwrap();
        let video = Array3::from_shape_fn((frames, masks[1], masks[2]), |(t, y, x)| (t + 5 * y + x) as u8);
        npz.add_array("orig", &video).unwrap();
        npz.finish().unwrap();
        (dir, path)
    }

    /// A folder with a scene of these masks and measurements.
    fn measured<A: WritableElement, B: WritableElement>(
        mask: &Array<A, impl Dimension>,
        meas: &Array3<B>,
        compressed: bool,
    ) -> (tempfile::TempDir, std::path::PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.npz");
        let file = std::fs::File::create(&path).unwrap();
        let mut npz = if compressed { NpzWriter::new_compressed(file) } else { NpzWriter::new(file) };
        npz.add_array("mask", mask).unwrap();
        npz.add_array("meas", meas).unwrap();
        npz.finish().unwrap();
        (dir, path)
    }

    #[test]
    fn bands_hold_what_the_whole_has_in_their_rows() {
        let (_dir, path) = scene([2, 40, 6], 5);
        let mut banded = Banded::open(&path, &Reading::default()).unwrap().unwrap();
        banded.unpack(path.parent().unwrap()).unwrap();
        banded.decide(20).unwrap();
        let whole = super::super::read(&path, &Reading::default()).unwrap();
        assert_eq!((banded.len(), banded.shape(), banded.unit), (2, whole.operator.shape(), 1.0));
        let band = banded.band(1, 10..30).unwrap();
        assert_eq!(band.y(0), whole.y(1).slice(ndarray::s![10..30, ..]));
        assert_eq!(band.truth_of(0).unwrap(), whole.truth_of(1).unwrap().slice(ndarray::s![.., 10..30, ..]));
        assert_eq!(banded.y(1).unwrap(), whole.y(1));
        let sums = [&[0][..], &[1], &[0, 1]].map(|chosen| banded.checksum(chosen).unwrap());
        assert!(sums[0] != sums[1] && sums[1] != sums[2] && sums[0] != sums[2], "{sums:?}");
        let (frame, color) = banded.truth_frame(1, 1).unwrap().unwrap().seen(None);
        assert_eq!((frame.index_axis(Axis(0), 0), color), (whole.truth_of(1).unwrap().index_axis(Axis(0), 1), None));
    }

    /// y without its masks is scaled as in a band, whatever it came in.
    #[test]
    fn a_whole_y_is_that_of_the_bands() {
        let mask = Array3::from_shape_fn((4, 20, 6), |(t, y, x)| ((t + y + x) % 2) as u8);
        let y = Array3::from_shape_fn((2, 20, 6), |(k, y, x)| (100 + 40 * k + 7 * y + 11 * x) as u16);
        let (_dir, path) = measured(&mask, &y, false);
        let mut reading = Reading::default();
        reading.sensor.black = 64.0;
        let mut banded = Banded::open(&path, &reading).unwrap().unwrap();
        banded.decide(20).unwrap();
        let (whole, band) = (banded.y(1).unwrap(), banded.band(1, 0..20).unwrap());
        assert!(whole.iter().zip(band.y(0)).all(|(a, b)| (a - b).abs() <= 1e-6 * b.abs()), "{whole} {}", band.y(0));
    }

    #[test]
    fn empty_and_short_arrays_are_errors() {
        for (masks, frames, said) in
            [([0, 4, 4], 3, "nothing is in it"), ([2, 0, 4], 3, "nothing"), ([4, 4, 4], 3, "3")]
        {
            let (_dir, path) = scene(masks, frames);
            let error = Banded::open(&path, &Reading::default()).unwrap_err().to_string();
            assert!(error.contains(said) && error.contains("scene.npz"), "{error}");
        }
    }

    /// Sky at the top is bright, which the rows in the middle do not show.
    #[test]
    fn what_numbers_mean_is_decided_by_rows_from_all_over() {
        let mask = Array3::from_shape_fn((4, 320, 6), |(t, y, x)| ((t + y + x) % 2) as u8);
        let light = |y: usize| if y < 60 { 3000 } else { 200 };
        let y = Array3::from_shape_fn((1, 320, 6), |(_, y, x)| (light(y) + x) as u16);
        let (_dir, path) = measured(&mask, &y, false);
        let whole = super::super::read(&path, &Reading::default()).unwrap();
        let mut banded = Banded::open(&path, &Reading::default()).unwrap().unwrap();
        banded.decide(64).unwrap();
        let band = banded.band(0, 200..232).unwrap();
        let (part, all) = (band.y(0), whole.y(0));
        assert!(part.iter().zip(all.slice(s![200..232, ..])).all(|(a, b)| (a - b).abs() <= 0.1 * b), "{part} {all}");
    }

    #[test]
    fn hot_pixels_are_told_by_another_measurement() {
        let mask = Array3::from_shape_fn((4, 48, 16), |(t, y, x)| ((t + y + x) % 2) as f32);
        let hot = |y: usize, x: usize| if (y, x) == (21, 7) { 2.0 } else { 0.6 };
        let (_dir, path) = measured(&mask, &Array3::from_shape_fn((2, 48, 16), |(_, y, x)| hot(y, x)), false);
        let reading = Reading { defects: Defects::Exclude, scale: Some(1.0), ..Reading::default() };
        let mut banded = Banded::open(&path, &reading).unwrap().unwrap();
        banded.decide(32).unwrap();
        for k in 0..2 {
            let band = banded.band(k, 16..32).unwrap();
            assert_eq!((band.len(), band.left_out.len(), band.operator.gram()[[5, 7]]), (1, 1, 0.0));
        }
    }

    #[test]
    fn a_packed_member_is_checked_to_its_end() {
        let mut state = 1u32;
        let noise = Array3::from_shape_simple_fn((2, 64, 64), || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        });
        let (dir, path) = measured(&noise, &Array3::<u8>::ones((1, 64, 64)), true);
        let mut bytes = std::fs::read(&path).unwrap();
        let unpacked = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            Banded::open(&path, &Reading::default()).unwrap().unwrap().unpack(dir.path()).map_err(|e| e.to_string())
        };
        assert_eq!(unpacked(&bytes), Ok(()));
        bytes[3000] ^= 4;
        assert!(unpacked(&bytes).is_err());
    }

    #[test]
    fn shapes_that_are_not_plain_are_read_whole() {
        let (_dir, path) = measured(&Array4::<u8>::ones((1, 3, 8, 8)), &Array3::<u8>::ones((1, 8, 8)), false);
        assert!(Banded::open(&path, &Reading::default()).unwrap().is_none());
    }
}
