//! Owns pictures, and folders of them in the natural order of their names: PNG, JPEG, and the pages of TIFF files.

use std::fs;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use image::codecs::jpeg::JpegDecoder;
use image::codecs::png::{CompressionType, FilterType, PngDecoder, PngEncoder};
use image::{DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder, ImageResult, Limits};
use ndarray::{Array4, ArrayView1, ArrayView3, ArrayView4, ArrayViewMut1, Axis};
use rayon::prelude::*;

use super::samples::{Array, Budget, SampleType, Samples};
use super::{FileError, Format, ReadError, read_file, tiff};

/// The `.png`, `.jpg` and `.jpeg` files of a folder, `frame2.png` before `frame10.png`.
///
/// # Errors
/// The folder's own error, or [`ReadError::NoFrames`] if it holds none.
pub fn list(folder: &Path) -> Result<Vec<PathBuf>, FileError> {
    list_named(folder, &["png", "jpg", "jpeg"])
}

/// Those of which [`read`] makes a video: pages of TIFF files too.
///
/// # Errors
/// As [`list`].
pub fn list_all(folder: &Path) -> Result<Vec<PathBuf>, FileError> {
    list_named(folder, &["png", "jpg", "jpeg", "tif", "tiff"])
}

fn list_named(folder: &Path, extensions: &[&str]) -> Result<Vec<PathBuf>, FileError> {
    let io = |source| FileError::new(folder, ReadError::Io(source));
    let mut paths = Vec::new();
    for entry in fs::read_dir(folder).map_err(io)? {
        let path = entry.map_err(io)?.path();
        let is = |known: &&str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(known));
        if extensions.iter().any(is) {
            paths.push(path);
        }
    }
    if paths.is_empty() {
        return Err(FileError::new(folder, ReadError::NoFrames));
    }
    paths.sort_by_cached_key(|p| natural_key(&p.file_name().unwrap_or_default().to_string_lossy()));
    Ok(paths)
}

/// Text with its digit runs as numbers, so that 2 sorts before 10.
fn natural_key(name: &str) -> Vec<(String, u64)> {
    let mut key = vec![(String::new(), 0u64)];
    let mut in_digits = false;
    for c in name.chars() {
        let last = key.len() - 1;
        match c.to_digit(10) {
            Some(d) => {
                key[last].1 = key[last].1.saturating_mul(10).saturating_add(u64::from(d));
                in_digits = true;
            }
            None if in_digits => {
                key.push((c.to_string(), 0));
                in_digits = false;
            }
            None => key[last].0.push(c),
        }
    }
    key
}

/// Reads a folder of equally large pictures as a video `[T, C, H, W]`, C = 1 if every frame is gray, else 3; a TIFF may hold several.
///
/// Samples are as stored, 0 to 255 or to 65535; transparency is dropped.
///
/// # Errors
/// [`FileError`] naming the folder or the frame at fault.
pub fn read(folder: &Path) -> Result<Array, FileError> {
    let paths = list_all(folder)?;
    let mut pictures: Vec<Array> = Vec::with_capacity(paths.len());
    for path in &paths {
        let bytes = read_file(path)?;
        let picture = match Format::of(&bytes) {
            Ok(Format::Tiff) => tiff::read(&bytes),
            _ => read_picture(&bytes),
        };
        let picture = picture.and_then(|p| if let Some(first) = pictures.first() { fitting(p, first) } else { Ok(p) });
        pictures.push(picture.map_err(|e| FileError::new(path, e))?);
    }
    join(pictures).map_err(|e| FileError::new(folder, e))
}

/// The picture, if it is as large as the first one and its samples can stand beside it.
fn fitting(picture: Array, first: &Array) -> Result<Array, ReadError> {
    let size = |a: &Array| (a.shape()[3], a.shape()[2]);
    let bad = |reason| Err(ReadError::Malformed { format: "frame", reason });
    if size(&picture) != size(first) {
        let ((w, h), (first_w, first_h)) = (size(&picture), size(first));
        return bad(format!("{w}×{h} pixels, but the first frame has {first_w}×{first_h}"));
    }
    let whole = [SampleType::U8, SampleType::U16];
    if picture.stored() != first.stored() && ![picture.stored(), first.stored()].iter().all(|s| whole.contains(s)) {
        return bad(format!("samples of type {:?}, but the first frame has {:?}", picture.stored(), first.stored()));
    }
    Ok(picture)
}

/// Pictures `[T, C, H, W]` one after the other; gray ones are repeated among color, 8 bits stretched to 16 among such.
fn join(pictures: Vec<Array>) -> Result<Array, ReadError> {
    let Some(first) = pictures.first() else { return Err(ReadError::NoFrames) };
    let (h, w) = (first.shape()[2], first.shape()[3]);
    let channels = pictures.iter().map(|p| p.shape()[1]).max().unwrap_or(1);
    let mixed = pictures.iter().any(|p| p.stored() != first.stored());
    let stored = if mixed { SampleType::U16 } else { first.stored() };
    let white = first.white().filter(|_| pictures.iter().all(|p| p.white() == first.white()));
    let frames = pictures.iter().map(|p| p.shape()[0]).sum();
    let mut all: Option<Samples> = None;
    for picture in pictures {
        let repeat = channels / picture.shape()[1];
        let stretch = mixed && picture.stored() == SampleType::U8;
        let mut samples = picture.into_samples();
        if stretch {
            samples = Samples::Floats((0..samples.len()).map(|i| samples.at(i) * 257.0).collect());
        }
        if repeat > 1 {
            let planes: Vec<usize> = (0..samples.len() / (h * w)).flat_map(|t| [t; 3]).collect();
            samples = samples.in_order(&planes, h * w);
        }
        match &mut all {
            None => all = Some(samples),
            Some(all) => all.append(samples),
        }
    }
    let array = Array::new(vec![frames, channels, h, w], all.ok_or(ReadError::NoFrames)?, stored)?;
    Ok(match white {
        Some(white) => array.with_white(white),
        None => array,
    })
}

/// Reads one PNG or JPEG as `[1, C, H, W]`, C = 1 or 3, samples as stored.
///
/// # Errors
/// As [`decode`].
pub fn read_picture(bytes: &[u8]) -> Result<Array, ReadError> {
    to_video(&decode(bytes)?)
}

/// Decodes one PNG or JPEG, within the budget of its own size.
///
/// # Errors
/// [`ReadError::Malformed`] for broken bytes, [`ReadError::TooLarge`] for an image too large for its file,
/// [`ReadError::UnknownFormat`] if it is neither.
pub fn decode(bytes: &[u8]) -> Result<DynamicImage, ReadError> {
    let format = Format::of(bytes)?;
    let broken = |e: image::ImageError| ReadError::Malformed { format: "picture", reason: e.to_string() };
    let mut limits = Limits::default();
    let limit = Budget::for_file(bytes.len()).left();
    limits.max_alloc = Some(limit as u64);
    let mut decoder: Box<dyn ImageDecoder> = match format {
        Format::Png => Box::new(PngDecoder::with_limits(Cursor::new(bytes), limits.clone()).map_err(broken)?),
        Format::Jpeg => Box::new(JpegDecoder::new(Cursor::new(bytes)).map_err(broken)?),
        _ => return Err(ReadError::UnknownFormat),
    };
    decoder.set_limits(limits).map_err(broken)?;
    let needed = usize::try_from(decoder.total_bytes()).unwrap_or(usize::MAX);
    if needed > limit {
        return Err(ReadError::TooLarge { needed, limit });
    }
    DynamicImage::from_decoder(decoder).map_err(broken)
}

fn to_video(image: &DynamicImage) -> Result<Array, ReadError> {
    let color = image.color();
    let deep = color.bytes_per_pixel() / color.channel_count() > 1;
    let (w, h) = (image.width() as usize, image.height() as usize);
    let widened = |raw: Vec<u16>| Samples::Floats(raw.into_iter().map(f32::from).collect());
    let (channels, samples) = match (color.has_color(), deep) {
        (false, false) => (1, Samples::Bytes(image.to_luma8().into_raw())),
        (false, true) => (1, widened(image.to_luma16().into_raw())),
        (true, false) => (3, Samples::Bytes(planes(&image.to_rgb8().into_raw()))),
        (true, true) => (3, widened(planes(&image.to_rgb16().into_raw()))),
    };
    Array::new(vec![1, channels, h, w], samples, if deep { SampleType::U16 } else { SampleType::U8 })
}

fn planes<T: Copy>(interleaved: &[T]) -> Vec<T> {
    let mut planes = Vec::with_capacity(interleaved.len());
    push_planes(&mut planes, interleaved, 3);
    planes
}

/// Appends interleaved pixels of `stride` channels as three planes.
pub(super) fn push_planes<T: Copy>(out: &mut Vec<T>, interleaved: &[T], stride: usize) {
    for c in 0..3 {
        out.extend(interleaved.iter().skip(c).step_by(stride).copied());
    }
}

/// A sample of `[0, 1]` as a byte, rounded, clipped; NaN becomes 0.
pub fn to_byte(x: f32) -> u8 {
    // Not `round`, which is a call into the mathematical library for each sample.
    (x.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
}

/// The bytes of a frame `[C, H, W]`, pixel by pixel.
pub fn to_pixels(frame: ArrayView3<'_, f32>) -> Vec<u8> {
    let (channels, height, width) = frame.dim();
    let mut pixels = vec![0; channels * height * width];
    for (c, plane) in frame.outer_iter().enumerate() {
        for (row, out) in plane.outer_iter().zip(pixels.chunks_exact_mut(channels * width)) {
            row.iter().zip(out[c..].iter_mut().step_by(channels)).for_each(|(&v, byte)| *byte = to_byte(v));
        }
    }
    pixels
}

/// One frame `[C, H, W]`, C = 1 or 3, samples in `[0, 1]`, as the bytes of an 8-bit PNG, compressed fast rather than well.
///
/// # Errors
/// The encoder's, for a frame without pixels.
pub fn png(frame: ArrayView3<'_, f32>) -> ImageResult<Vec<u8>> {
    let (channels, height, width) = frame.dim();
    let color = if channels == 1 { ExtendedColorType::L8 } else { ExtendedColorType::Rgb8 };
    let mut bytes = Vec::new();
    // One filter for all rows: to try all five for each takes longer than to pack them.
    PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Up).write_image(
        &to_pixels(frame),
        width as u32,
        height as u32,
        color,
    )?;
    Ok(bytes)
}

/// Each frame of `[T, C, H, W]` as a PNG, halved until no side is longer than `side`.
///
/// # Errors
/// The encoder's.
pub fn pngs(video: ArrayView4<'_, f32>, side: usize) -> ImageResult<Vec<Vec<u8>>> {
    let encoded = |frame: ArrayView4<'_, f32>| {
        let small = (longer_side(frame) > side).then(|| halved_to(frame, side));
        png(small.as_ref().map_or(frame, |small| small.view()).index_axis(Axis(0), 0))
    };
    let frames: Vec<_> = video.axis_chunks_iter(Axis(0), 1).collect();
    frames.into_par_iter().map(encoded).collect()
}

/// Half the height and width of a video `[T, C, H, W]`, each pixel the mean of four; an odd last row or column is left out.
pub fn halved(video: ArrayView4<'_, f32>) -> Array4<f32> {
    let (frames, channels, height, width) = video.dim();
    let mut half = Array4::zeros((frames, channels, (height / 2).max(1), (width / 2).max(1)));
    half.axis_iter_mut(Axis(0)).into_par_iter().zip(video.axis_iter(Axis(0))).for_each(|(mut half, frame)| {
        for (mut half, plane) in half.outer_iter_mut().zip(frame.outer_iter()) {
            for (y, half) in half.outer_iter_mut().enumerate() {
                halve(half, plane.row(2 * y), plane.row((2 * y + 1).min(height - 1)));
            }
        }
    });
    half
}

fn halve(half: ArrayViewMut1<'_, f32>, top: ArrayView1<'_, f32>, bottom: ArrayView1<'_, f32>) {
    // A single column stands beside itself.
    let pairs = |row: ArrayView1<'_, f32>| if row.len() == 1 { vec![row[0]; 2] } else { row.to_vec() };
    let (top, bottom) = (pairs(top), pairs(bottom));
    let fours = top.as_chunks::<2>().0.iter().zip(bottom.as_chunks::<2>().0);
    half.into_iter().zip(fours).for_each(|(half, ([a, b], [c, d]))| *half = 0.25 * (a + b + c + d));
}

/// A video of half the height and width, once or as often as it takes until no side is longer than `side`. No more than a frame for each
/// thread is in memory in a size between.
pub fn halved_to(video: ArrayView4<'_, f32>, side: usize) -> Array4<f32> {
    let (frames, channels, mut height, mut width) = video.dim();
    let mut times = 0;
    while times == 0 || height.max(width) > side {
        (height, width, times) = ((height / 2).max(1), (width / 2).max(1), times + 1);
    }
    let mut small = Array4::zeros((frames, channels, height, width));
    let pairs = small.axis_chunks_iter_mut(Axis(0), 1).into_par_iter().zip(video.axis_chunks_iter(Axis(0), 1));
    pairs.for_each(|(mut small, frame)| {
        let first = halved(frame);
        small.assign(&(1..times).fold(first, |frame, _| halved(frame.view())));
    });
    small
}

/// [`halved_to`] of a video that is larger, else the video as it is.
pub fn shrunk(video: ArrayView4<'_, f32>, side: usize) -> Array4<f32> {
    if longer_side(video) > side { halved_to(video, side) } else { video.to_owned() }
}

/// The larger of height and width.
pub fn longer_side(video: ArrayView4<'_, f32>) -> usize {
    video.len_of(Axis(2)).max(video.len_of(Axis(3)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{ImageBuffer, Luma};
    use ndarray::{Array2, Array3, arr2};

    fn write_png(path: &Path, frame: ArrayView3<'_, f32>) -> ImageResult<()> {
        Ok(fs::write(path, png(frame)?)?)
    }

    #[test]
    fn half_a_frame_is_the_mean_of_four_pixels() {
        let half = |frame: Array2<f32>| halved(frame.view().insert_axis(Axis(0)).insert_axis(Axis(0)));
        let plane = |half: Array4<f32>| half.index_axis_move(Axis(0), 0).index_axis_move(Axis(0), 0);
        let frame = Array2::from_shape_fn((3, 5), |(y, x)| (4 * y + x) as f32);
        assert_eq!(plane(half(frame)), arr2(&[[2.5, 4.5]]));
        assert_eq!(plane(half(arr2(&[[3.0]]))), arr2(&[[3.0]]));
        assert_eq!(plane(half(arr2(&[[3.0, 5.0]]))), arr2(&[[4.0]]));
    }

    #[test]
    fn bytes_are_rounded_and_clipped_and_stand_pixel_by_pixel() {
        assert_eq!(
            [-1.0, 0.0, 0.499 / 255.0, 0.501 / 255.0, 1.0, 9.0, f32::NAN].map(to_byte),
            [0, 0, 0, 1, 255, 255, 0]
        );
        let frame = Array3::from_shape_fn((3, 1, 2), |(c, _, x)| (10 * c + x) as f32 / 255.0);
        assert_eq!(to_pixels(frame.view()), [0, 10, 20, 1, 11, 21]);
    }

    #[test]
    fn folder_round_trip_in_natural_order() {
        let dir = tempfile::tempdir().unwrap();
        for t in [0usize, 2, 10] {
            let frame = Array3::from_elem((1, 3, 4), t as f32 / 255.0);
            write_png(&dir.path().join(format!("f{t}.png")), frame.view()).unwrap();
        }
        let video = read(dir.path()).unwrap();
        assert_eq!(video.shape(), [3, 1, 3, 4]);
        assert_eq!([0, 12, 24].map(|i| video.samples().at(i)), [0.0, 2.0, 10.0]);
    }

    #[test]
    fn color_frames_become_planes() {
        let dir = tempfile::tempdir().unwrap();
        let frame = Array3::from_shape_fn((3, 2, 2), |(c, _, _)| [0.0, 0.2, 1.0][c]);
        write_png(&dir.path().join("a.png"), frame.view()).unwrap();
        let video = read(dir.path()).unwrap();
        assert_eq!(video.shape(), [1, 3, 2, 2]);
        assert_eq!(video.samples(), &Samples::Bytes(vec![0, 0, 0, 0, 51, 51, 51, 51, 255, 255, 255, 255]));
    }

    #[test]
    fn jpegs_are_frames_too() {
        let dir = tempfile::tempdir().unwrap();
        for t in [9u8, 10] {
            let gray = ImageBuffer::from_pixel(16, 8, Luma([10 * t]));
            gray.save(dir.path().join(format!("f{t}.jpg"))).unwrap();
        }
        let video = read(dir.path()).unwrap();
        assert_eq!(video.shape(), [2, 1, 8, 16]);
        assert_eq!([0, 128].map(|i| video.samples().at(i)), [90.0, 100.0]);
    }

    #[test]
    fn pages_of_tiff_files_and_deep_pictures_stand_beside_others() {
        use ::tiff::encoder::{TiffEncoder, colortype};
        let dir = tempfile::tempdir().unwrap();
        let mut pages = TiffEncoder::new(fs::File::create(dir.path().join("f1.tif")).unwrap()).unwrap();
        for page in [1u16, 2] {
            pages.write_image::<colortype::Gray16>(4, 3, &[1000 * page; 12]).unwrap();
        }
        let video = read(dir.path()).unwrap();
        assert_eq!((video.shape(), video.stored()), (&[2, 1, 3, 4][..], SampleType::U16));
        write_png(&dir.path().join("f2.png"), Array3::from_elem((3, 3, 4), 1.0).view()).unwrap();
        let video = read(dir.path()).unwrap();
        assert_eq!(video.shape(), [3, 3, 3, 4]);
        assert_eq!([0, 12, 36, 72, 107].map(|i| video.samples().at(i)), [1000.0, 1000.0, 2000.0, 65535.0, 65535.0]);
        fs::write(dir.path().join("f3.png"), png(Array3::from_elem((1, 3, 5), 1.0).view()).unwrap()).unwrap();
        let error = read(dir.path()).unwrap_err().to_string();
        assert!(error.contains("f3.png") && error.contains("5×3"), "{error}");
    }

    #[test]
    fn an_empty_folder_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let error = read(dir.path()).unwrap_err();
        assert!(matches!(error.source, ReadError::NoFrames), "{error}");
    }

    #[test]
    fn damaged_png_bytes_give_errors() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        write_png(&path, Array3::from_elem((1, 5, 7), 0.5).view()).unwrap();
        let bytes = fs::read(&path).unwrap();
        for at in 0..bytes.len() {
            let mut b = bytes.clone();
            b[at] ^= 0xff;
            let _ = decode(&b);
            assert!(decode(&bytes[..at]).is_err() || at > bytes.len() - 16);
        }
    }
}
