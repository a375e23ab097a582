//! Scenes as cameras and laboratories store them: the same scene must come out of each.

use std::fs;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use hdf5_pure::FileBuilder;
use ndarray::{Array2, Array3, ArrayD, Axis, s};
use tiff::encoder::{TiffEncoder, colortype};

use super::*;
use crate::io::mat::{Variable, write_v5};
use crate::io::npy;
use crate::io::raw::Packing;

const SHAPE: (usize, usize, usize) = (4, 6, 8);

fn mask() -> Array3<f32> {
    Array3::from_shape_fn(SHAPE, |(t, y, x)| ((3 * t + 5 * y + 7 * x + t * x) % 3 % 2) as f32)
}

/// In numbers of a camera of twelve bits, on which one frame's white is 1000.
fn meas() -> Array3<f32> {
    let frames = Array3::from_shape_fn(SHAPE, |(t, y, x)| 500.0 + ((11 * t + 6 * y + 13 * x) % 48) as f32 * 10.0);
    (frames * mask()).sum_axis(Axis(0)).insert_axis(Axis(0))
}

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn write(&self, name: &str, bytes: impl AsRef<[u8]>) -> PathBuf {
        fs::write(self.path(name), bytes).unwrap();
        self.path(name)
    }

    fn npy(&self, name: &str, array: &Array3<f32>) -> PathBuf {
        let mut bytes = Vec::new();
        npy::write_npy(&mut bytes, array).unwrap();
        self.write(name, bytes)
    }

    fn tiff16(&self, name: &str, array: &Array3<f32>) -> PathBuf {
        let mut bytes = Cursor::new(Vec::new());
        let mut encoder = TiffEncoder::new(&mut bytes).unwrap();
        let (_, height, width) = array.dim();
        for page in array.outer_iter() {
            let page: Vec<u16> = page.iter().map(|&v| v as u16).collect();
            encoder.write_image::<colortype::Gray16>(width as u32, height as u32, &page).unwrap();
        }
        self.write(name, bytes.into_inner())
    }
}

fn scaled(scale: f32) -> Reading {
    Reading { scale: Some(scale), ..Reading::default() }
}

/// A scene from a file of measurements and one of masks.
fn two(meas: &Path, mask: &Path) -> Scene {
    super::read(meas, &Reading { mask: Some(mask.to_owned()), ..scaled(1000.0) }).unwrap()
}

fn masks_of(scene: &Scene) -> Array3<f32> {
    // Each frame alone, white: what is measured is its mask.
    let mut frames = Array3::zeros(scene.operator.shape().dim());
    let mut masks = frames.clone();
    for t in 0..scene.frames() {
        frames.fill(0.0);
        frames.index_axis_mut(Axis(0), t).fill(1.0);
        masks.index_axis_mut(Axis(0), t).assign(&scene.operator.forward(frames.view()));
    }
    masks
}

#[track_caller]
fn is_the_scene(scene: &Scene) {
    assert_eq!(masks_of(scene), mask());
    let worst = (&scene.measurements - &(meas() / 1000.0)).fold(0f32, |worst, d| worst.max(d.abs()));
    assert!(worst < 1e-6, "{worst}");
}

#[test]
fn measurements_and_masks_in_files_of_their_own() {
    let dir = Folder::new();
    let measured = [dir.npy("meas.npy", &meas()), dir.tiff16("meas.tif", &meas())];
    fs::create_dir(dir.path("shots")).unwrap();
    dir.tiff16("shots/shot1.tiff", &meas());
    let column_major =
        |array: &Array3<f32>| array.view().permuted_axes([0, 2, 1]).iter().copied().collect::<Vec<f32>>();
    let (t, h, w) = SHAPE;
    let mut mat = Vec::new();
    write_v5(&mut mat, &[Variable { name: "Phi", size: &[h, w, t], data: &column_major(&mask()) }]).unwrap();
    let mut zip = Cursor::new(Vec::new());
    npy::write_npz(&mut zip, &[("anything", mask().into_dyn().view())]).unwrap();
    let masks = [
        dir.npy("mask.npy", &mask()),
        dir.tiff16("mask.tif", &(mask() * 65535.0)),
        dir.write("mask.mat", mat),
        dir.write("mask.npz", zip.get_ref()),
    ];
    for meas in measured.iter().chain([&dir.path("shots")]) {
        masks.iter().for_each(|mask| is_the_scene(&two(meas, mask)));
    }
    let error = super::read(&measured[1], &Reading::default()).unwrap_err().to_string();
    assert!(error.contains("meas.tif") && error.contains("data.mask"), "{error}");
}

#[test]
fn a_truth_beside_the_measurements_is_read_with_masks_of_their_own() {
    let dir = Folder::new();
    let truth = Array3::from_shape_fn(SHAPE, |(t, y, x)| ((11 * t + 6 * y + 13 * x) % 48) as f32 / 50.0 + 0.04);
    let y = (&truth * &mask()).sum_axis(Axis(0)).insert_axis(Axis(0));
    let mut zip = Cursor::new(Vec::new());
    npy::write_npz(&mut zip, &[("y", (&y * 4095.0).into_dyn().view()), ("x", truth.clone().into_dyn().view())])
        .unwrap();
    let reading = Reading { mask: Some(dir.npy("mask.npy", &mask())), ..Reading::default() };
    let scene = super::read(&dir.write("scene.npz", zip.get_ref()), &reading).unwrap();
    let worst = (&scene.measurements - &y).fold(0f32, |worst, d| worst.max(d.abs()));
    assert!(worst < 1e-5 && scene.truth == Some(truth), "{worst}");
    let said = scene.warnings.join("\n");
    assert!(said.contains("`y` is taken") && said.contains("white is taken to be 4095"), "{said}");
    assert!(!said.contains("differs"), "{said}");
}

#[test]
fn an_hdf5_of_others_is_in_c_order_and_one_of_matlab_reversed() {
    let dir = Folder::new();
    let (t, h, w) = (SHAPE.0 as u64, SHAPE.1 as u64, SHAPE.2 as u64);
    let values = |array: Array3<f32>| array.iter().copied().collect::<Vec<_>>();
    let mut plain = FileBuilder::new();
    plain.create_dataset("mask").with_f32_data(&values(mask())).with_shape(&[t, h, w]);
    plain.create_dataset("meas").with_f32_data(&values(meas())).with_shape(&[h, w]);
    is_the_scene(&super::read(&dir.write("a.h5", plain.finish().unwrap()), &scaled(1000.0)).unwrap());
    let turned = |array: Array3<f32>| array.permuted_axes([0, 2, 1]).iter().copied().collect::<Vec<_>>();
    let mut matlab = FileBuilder::new();
    matlab.with_userblock(512).with_userblock_content(b"MATLAB 7.3 MAT-file");
    matlab.create_dataset("mask").with_f32_data(&turned(mask())).with_shape(&[t, w, h]);
    matlab.create_dataset("meas").with_f32_data(&turned(meas())).with_shape(&[w, h]);
    is_the_scene(&super::read(&dir.write("a.mat", matlab.finish().unwrap()), &scaled(1000.0)).unwrap());
    // Groups, and the names of other programs.
    let mut grouped = FileBuilder::new();
    let mut group = grouped.create_group("data");
    group.create_dataset("mask").with_f32_data(&values(mask())).with_shape(&[1, t, h, w]);
    group.create_dataset("snapshot").with_f32_data(&values(meas())).with_shape(&[1, h, w]);
    grouped.add_group(group.finish());
    let path = dir.write("b.h5", grouped.finish().unwrap());
    let keys = Keys { mask: "data.mask".into(), meas: "data.snapshot".into(), ..Keys::default() };
    let given = super::read(&path, &Reading { keys, ..scaled(1000.0) }).unwrap();
    assert!(given.warnings.is_empty(), "{:?}", given.warnings);
    is_the_scene(&given);
    let guessed = super::read(&path, &scaled(1000.0)).unwrap();
    assert_eq!(guessed.warnings.len(), 2, "{:?}", guessed.warnings);
    is_the_scene(&guessed);
}

#[test]
fn raw_frames_of_twelve_bits_of_a_stated_size() {
    let dir = Folder::new();
    let levels: Vec<u16> = meas().iter().map(|&v| v as u16).collect();
    let pairs = levels.as_chunks::<2>().0;
    let low = |v: u16| v as u8;
    let packed: Vec<u8> = pairs.iter().flat_map(|&[a, b]| [low(a), low(a >> 8) | low(b << 4), low(b >> 4)]).collect();
    let other: Vec<u8> =
        pairs.iter().flat_map(|&[a, b]| [low(a >> 4), low(a & 15) | low(b << 4), low(b >> 4)]).collect();
    let mask = dir.npy("mask.npy", &mask());
    let (_, height, width) = SHAPE;
    let read = |name: &str, bytes: &[u8], packing, scale| {
        let raw = Some(Raw { packing, height, width });
        super::read(&dir.write(name, bytes), &Reading { mask: Some(mask.clone()), raw, scale, ..Reading::default() })
    };
    is_the_scene(&read("a.raw", &packed, Packing::Mono12p, Some(1000.0)).unwrap());
    is_the_scene(&read("b.raw", &other, Packing::Mono12Packed, Some(1000.0)).unwrap());
    let y = read("a.raw", &packed, Packing::Mono12p, None).unwrap().y(0)[[0, 0]];
    assert_eq!(y, meas()[[0, 0, 0]] / 4095.0);
    let error = read("a.raw", &packed[1..], Packing::Mono12p, None).unwrap_err().to_string();
    assert!(error.contains("a.raw") && error.contains("data.raw"), "{error}");
    assert!(super::read(&dir.path("a.raw"), &Reading::default()).unwrap_err().to_string().contains("data.raw"));
}

#[test]
fn one_calibrated_mask_that_moves() {
    let dir = Folder::new();
    let pattern = Array2::from_shape_fn((9, 8), |(y, x)| ((3 * y + 5 * x + y * x) % 7) as f32 / 7.0);
    let whole = Array2::from_shape_fn((9, 8), |(y, x)| (10 * y + x) as f32).insert_axis(Axis(0));
    let mask = dir.npy("mask.npy", &pattern.clone().insert_axis(Axis(0)));
    let reading =
        |step| Reading { mask: Some(mask.clone()), shift: Some(MaskShift { step, frames: 4 }), ..scaled(1.0) };
    let scene = super::read(&dir.npy("meas.npy", &whole), &reading([1.0, 0.0])).unwrap();
    assert_eq!(masks_of(&scene).dim(), (4, 6, 8));
    for (t, found) in masks_of(&scene).outer_iter().enumerate() {
        assert_eq!(found, pattern.slice(s![t..t + 6, ..]), "frame {t}");
    }
    assert_eq!(scene.y(0)[[0, 0]], 0.0);
    assert!(scene.warnings[0].contains("6×8"), "{:?}", scene.warnings);
    // Upwards by half a pixel: the sensor's first rows see what lies beyond the pattern.
    let scene = super::read(&dir.path("meas.npy"), &reading([-0.5, 0.0])).unwrap();
    let masks = masks_of(&scene);
    assert_eq!((scene.y(0)[[0, 0]], masks[[0, 0, 3]]), (20.0, pattern[[2, 3]]));
    assert!((masks[[1, 0, 3]] - 0.5 * (pattern[[1, 3]] + pattern[[2, 3]])).abs() < 1e-6);
    let many = dir.npy("masks.npy", &Array3::ones((2, 9, 8)));
    let error = super::read(&dir.path("meas.npy"), &Reading { mask: Some(many), ..reading([1.0, 0.0]) });
    assert!(error.unwrap_err().to_string().contains("2 masks"));
    let far = super::read(&dir.path("meas.npy"), &reading([3.0, 0.0])).unwrap_err().to_string();
    assert!(far.contains("data.mask_shift = [3.0, 0.0]") && far.contains("meas.npy"), "{far}");
}

#[test]
fn a_single_mask_that_does_not_move_is_said() {
    let dir = Folder::new();
    let mask = dir.npy("mask.npy", &Array3::ones((1, 6, 8)));
    assert!(two(&dir.npy("meas.npy", &meas()), &mask).warnings[0].contains("data.mask_shift"));
}

#[test]
fn twelve_bits_in_sixteen_are_said() {
    let dir = Folder::new();
    let reading = Reading { mask: Some(dir.npy("mask.npy", &mask())), ..Reading::default() };
    let scene = super::read(&dir.tiff16("meas.tif", &meas()), &reading).unwrap();
    assert!(scene.warnings[0].contains("white is taken to be 4095"), "{:?}", scene.warnings);
    assert!(scene.warnings[1].contains("darker than scenes are"), "{:?}", scene.warnings);
    let worst = (&scene.measurements * scene.unit - &(meas() / 4095.0)).fold(0f32, |worst, d| worst.max(d.abs()));
    assert!(worst < 1e-6, "{worst}");
    let video =
        read_video(&dir.tiff16("video.tif", &(meas() + Array3::<f32>::zeros((5, 6, 8)))), &Reading::default()).unwrap();
    assert!(video.notes[0].contains("hold 12"), "{:?}", video.notes);
    assert_eq!(video.frames[[4, 0, 3, 2]], meas()[[0, 3, 2]] / 4095.0);
}

#[test]
fn mistakes_are_called_by_their_name() {
    let dir = Folder::new();
    let error = |path: &Path, reading: &Reading| super::read(path, reading).unwrap_err().to_string();
    let pointer = dir.write("scene.mat", "version https://git-lfs.github.com/spec/v1\noid sha256:1\nsize 3\n");
    let text = error(&pointer, &Reading::default());
    assert!(text.contains("scene.mat") && text.contains("Git LFS"), "{text}");
    let page = dir.write("page.mat", "<!DOCTYPE html>\n<html>");
    assert!(error(&page, &Reading::default()).contains("HTML page"));
    let clip = dir.write("clip.mat", b"\0\0\0\x20ftypisom");
    let mask = Some(dir.npy("mask.npy", &mask()));
    assert!(error(&clip, &Reading { mask, ..Reading::default() }).contains("clip"));
    // Frames first in a .mat, where they come last.
    let data: Vec<f32> = ArrayD::ones(vec![4 * 6 * 8]).into_iter().collect();
    let variables = [
        Variable { name: "mask", size: &[4, 6, 8], data: &data },
        Variable { name: "meas", size: &[6, 8], data: &data[..48] },
    ];
    let mut bytes = Vec::new();
    write_v5(&mut bytes, &variables).unwrap();
    let turned = dir.write("turned.mat", bytes);
    assert!(error(&turned, &Reading::default()).contains("data.axes"));
    let scene = super::read(&turned, &Reading { axes: Some(Axes::Thw), ..Reading::default() }).unwrap();
    assert_eq!(scene.operator.shape().dim(), SHAPE);
    let keys = Keys { mask: "maks".into(), ..Keys::default() };
    let text = error(&turned, &Reading { keys, ..Reading::default() });
    assert!(text.contains("`maks`") && text.contains("did you mean `mask`"), "{text}");
}

/// To go on with what is there instead would be to solve something else.
#[test]
fn a_key_that_is_given_and_not_there_is_refused() {
    let dir = Folder::new();
    let mut zip = Cursor::new(Vec::new());
    let (mask, meas) = (mask().into_dyn(), meas().into_dyn());
    npy::write_npz(&mut zip, &[("mask", mask.view()), ("meas", meas.view()), ("orig", mask.view())]).unwrap();
    let path = dir.write("scene.npz", zip.into_inner());
    for keys in [Keys { meas: "maes".into(), ..Keys::default() }, Keys { orig: "gruond".into(), ..Keys::default() }] {
        let wrong = if keys.meas == "maes" {
            "`maes` (the measurements) (did you mean `meas`?)"
        } else {
            "`gruond` (the truth)"
        };
        let reading = Reading { keys, ..scaled(1000.0) };
        let whole = super::read(&path, &reading).unwrap_err().to_string();
        let banded = Banded::open(&path, &reading).unwrap_err().to_string();
        assert!(whole.contains(wrong) && banded.contains(wrong), "{whole} {banded}");
    }
}

fn of(mask: Array3<f32>, meas: Array3<f32>, reading: &Reading) -> Scene {
    let array = |array: Array3<f32>| {
        let shape = array.shape().to_vec();
        crate::io::samples::Array::new(
            shape,
            crate::io::samples::Samples::Floats(array.into_raw_vec_and_offset().0),
            crate::io::samples::SampleType::F32,
        )
        .unwrap()
    };
    of_arrays(Arrays { mask: array(mask), meas: Some(array(meas)), truth: None }, reading).unwrap()
}

/// Masks through which everything is seen, and a scene of this brightness.
fn bright(level: f32) -> (Array3<f32>, Array3<f32>) {
    let mask = MaskStack::random(sci_forward::VideoShape { frames: 4, height: 48, width: 48 }, 0.6, 1).unwrap();
    let mask = mask.view().to_owned();
    let frames = Array3::from_shape_fn(mask.dim(), |(t, y, x)| level * (0.6 + 0.4 * ((t + y + x) as f32 * 0.3).sin()));
    let meas = (&mask * &frames).sum_axis(Axis(0)).insert_axis(Axis(0));
    (mask, meas)
}

#[test]
fn captures_that_are_dark_are_brought_to_white_unless_noise_is_told_in_it() {
    let (mask, meas) = bright(0.1);
    let scene = of(mask.clone(), meas.clone(), &Reading::default());
    assert!((0.05..0.15).contains(&scene.unit), "{}", scene.unit);
    assert!(scene.warnings[0].contains("darker than scenes are"), "{:?}", scene.warnings);
    let mut reading = Reading::default();
    reading.sensor.noise = SensorNoise::Known(Noise::new(None, 0.01).unwrap());
    let scene = of(mask, meas, &reading);
    assert!(scene.unit == 1.0 && scene.warnings[0].contains("data.scale = 0."), "{:?}", scene.warnings);
    let (mask, meas) = bright(0.8);
    let scene = of(mask, meas, &Reading::default());
    assert!(scene.unit == 1.0 && scene.warnings.is_empty(), "{:?}", scene.warnings);
}

#[test]
fn what_a_dark_frame_leaves_of_a_shaded_border_measures_nothing() {
    let (mut mask, mut meas) = bright(0.8);
    mask.slice_mut(s![.., ..3, ..]).fill(4e-4);
    meas.slice_mut(s![.., ..3, ..]).fill(0.02);
    let scene = of(mask, meas, &Reading::default());
    assert!(scene.unit == 1.0 && scene.operator.gram().slice(s![..3, ..]).iter().all(|&g| g == 0.0));
    assert!(scene.warnings.iter().any(|note| note.starts_with("144 pixels that masks open")), "{:?}", scene.warnings);
}

#[test]
fn masks_that_are_turned_are_told() {
    let (mask, meas) = bright(0.8);
    let turned = mask.slice(s![.., ..;-1, ..]).as_standard_layout().into_owned();
    let scene = of(turned, meas, &Reading::default());
    assert!(scene.warnings.iter().any(|note| note.contains("mirrored top to bottom")), "{:?}", scene.warnings);
}

/// Labels are masks too.
#[test]
fn pictures_of_zeros_and_ones_are_open_where_they_are_one() {
    let dir = Folder::new();
    is_the_scene(&two(&dir.npy("meas.npy", &meas()), &dir.tiff16("mask.tif", &mask())));
}

#[test]
fn a_level_that_most_pixels_reach_is_noticed() {
    let (mask, meas) = bright(0.8);
    let mut reading = Reading { scale: Some(1.0), ..Reading::default() };
    reading.sensor.clip = Clip::Level(0.01);
    assert!(of(mask, meas, &reading).warnings[0].contains("data.sensor.clip = 0.01"));
}

#[test]
fn a_video_whose_frames_seem_to_be_its_last_axis_is_noticed() {
    let dir = Folder::new();
    let notes = |dim, axes| {
        let path = dir.npy("video.npy", &Array3::from_elem(dim, 0.5));
        read_video(&path, &Reading { axes, ..Reading::default() }).unwrap().notes
    };
    assert!(notes((40, 48, 8), None)[0].contains("40 frames of 48×8"));
    assert!(notes((40, 48, 8), Some(Axes::Hwt)).is_empty() && notes((8, 40, 48), None).is_empty());
}
