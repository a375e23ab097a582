//! Owns folders of PNG or JPEG frames: one file a frame, in the natural order of their names.

use std::fs;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use image::codecs::jpeg::JpegDecoder;
use image::codecs::png::{CompressionType, FilterType, PngDecoder, PngEncoder};
use image::{DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder, ImageResult, Limits};
use ndarray::{Array3, ArrayView3};

use super::samples::{Array, Budget, SampleType, Samples};
use super::{FileError, Format, ReadError, read_file};

/// The `.png`, `.jpg` and `.jpeg` files of a folder, `frame2.png` before `frame10.png`.
///
/// # Errors
/// The folder's own error, or [`ReadError::NoFrames`] if it holds none.
pub fn list(folder: &Path) -> Result<Vec<PathBuf>, FileError> {
    let io = |source| FileError::new(folder, ReadError::Io(source));
    let mut paths = Vec::new();
    for entry in fs::read_dir(folder).map_err(io)? {
        let path = entry.map_err(io)?.path();
        let is = |known: &&str| path.extension().is_some_and(|e| e.eq_ignore_ascii_case(known));
        if ["png", "jpg", "jpeg"].iter().any(is) {
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

/// Reads a folder of equally large pictures as a video `[T, C, H, W]`, C = 1 if every frame is gray, else 3.
///
/// Samples are 0 to 255 for 8-bit files and 0.0 to 1.0 for 16-bit ones; transparency is dropped.
///
/// # Errors
/// [`FileError`] naming the folder or the frame at fault.
pub fn read(folder: &Path) -> Result<Array, FileError> {
    let paths = list(folder)?;
    let mut images = Vec::with_capacity(paths.len());
    for path in &paths {
        let image = decode(&read_file(path)?).map_err(|e| FileError::new(path, e))?;
        if let Some(first) = images.first().map(|i: &DynamicImage| (i.width(), i.height())) {
            let size = (image.width(), image.height());
            if size != first {
                return Err(FileError::new(
                    path,
                    ReadError::Malformed {
                        format: "frame",
                        reason: format!(
                            "{}×{} pixels, but the first frame has {}×{}",
                            size.0, size.1, first.0, first.1
                        ),
                    },
                ));
            }
        }
        images.push(image);
    }
    to_video(&images).map_err(|e| FileError::new(folder, e))
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

fn to_video(images: &[DynamicImage]) -> Result<Array, ReadError> {
    let gray = images.iter().all(|i| !i.color().has_color());
    let deep = images.iter().any(|i| i.color().bytes_per_pixel() / i.color().channel_count() > 1);
    let channels = if gray { 1 } else { 3 };
    let (w, h) = images.first().map_or((0, 0), |i| (i.width() as usize, i.height() as usize));
    let shape = vec![images.len(), channels, h, w];
    if deep {
        let mut v: Vec<f32> = Vec::new();
        for image in images {
            if gray {
                v.extend(image.to_luma16().as_raw().iter().map(|&s| f32::from(s) / 65535.0));
            } else {
                let raw = image.to_rgb16().into_raw();
                (0..3).for_each(|c| v.extend(raw.iter().skip(c).step_by(3).map(|&s| f32::from(s) / 65535.0)));
            }
        }
        Array::new(shape, Samples::Floats(v), SampleType::F32)
    } else {
        let mut v: Vec<u8> = Vec::new();
        for image in images {
            if gray {
                v.extend(image.to_luma8().into_raw());
            } else {
                push_planes(&mut v, &image.to_rgb8().into_raw(), 3);
            }
        }
        Array::new(shape, Samples::Bytes(v), SampleType::U8)
    }
}

/// Appends interleaved pixels of `stride` channels as three planes.
pub(super) fn push_planes(out: &mut Vec<u8>, interleaved: &[u8], stride: usize) {
    for c in 0..3 {
        out.extend(interleaved.iter().skip(c).step_by(stride));
    }
}

/// A sample of `[0, 1]` as a byte, rounded, clipped; NaN becomes 0.
pub fn to_byte(x: f32) -> u8 {
    (x.clamp(0.0, 1.0) * 255.0).round() as u8
}

/// One frame `[C, H, W]`, C = 1 or 3, samples in `[0, 1]`, as the bytes of an 8-bit PNG, compressed fast rather than well.
///
/// # Errors
/// The encoder's, for a frame without pixels.
pub fn png(frame: ArrayView3<'_, f32>) -> ImageResult<Vec<u8>> {
    let (channels, height, width) = frame.dim();
    let pixels: Vec<u8> = frame.permuted_axes([1, 2, 0]).iter().map(|&v| to_byte(v)).collect();
    let color = if channels == 1 { ExtendedColorType::L8 } else { ExtendedColorType::Rgb8 };
    let mut bytes = Vec::new();
    PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Adaptive).write_image(
        &pixels,
        width as u32,
        height as u32,
        color,
    )?;
    Ok(bytes)
}

/// Half the height and width of a frame `[C, H, W]`, each pixel the mean of four; an odd last row or column is left out.
pub fn halved(frame: ArrayView3<'_, f32>) -> Array3<f32> {
    let (channels, height, width) = frame.dim();
    Array3::from_shape_fn((channels, (height / 2).max(1), (width / 2).max(1)), |(c, y, x)| {
        let at = |dy: usize, dx: usize| frame[[c, (2 * y + dy).min(height - 1), (2 * x + dx).min(width - 1)]];
        0.25 * (at(0, 0) + at(0, 1) + at(1, 0) + at(1, 1))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{ImageBuffer, Luma};

    fn write_png(path: &Path, frame: ArrayView3<'_, f32>) -> ImageResult<()> {
        Ok(fs::write(path, png(frame)?)?)
    }

    #[test]
    fn half_a_frame_is_the_mean_of_four_pixels() {
        let frame = Array3::from_shape_fn((1, 3, 4), |(_, y, x)| (4 * y + x) as f32);
        assert_eq!(halved(frame.view()), ndarray::arr3(&[[[2.5, 4.5]]]));
        assert_eq!(halved(ndarray::arr3(&[[[3.0]]]).view()), ndarray::arr3(&[[[3.0]]]));
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
