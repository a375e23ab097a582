//! Owns `recon.*`, the result of a run: the videos of its measurements, each an `.npy` of its own, joined in any format.
//!
//! One frame is in memory at a time, however many measurements there are.

use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read, Seek, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use tiff::encoder::colortype::{ColorType, Gray16, Gray32Float};
use tiff::encoder::{TiffEncoder, TiffKind};
use tiff::tags::Tag;
use zip::CompressionMethod;
use zip::write::{SimpleFileOptions, ZipWriter};

use super::output::{MAT_SCALE, WriteError, write_atomically};
use super::{mat, npy};

/// The variable of the formats that have names.
const NAME: &str = "recon";
/// From here on offsets of 32 bits might not do.
const LARGE: u64 = 3 << 30;

type BoxError = Box<dyn std::error::Error + Send + Sync>;

/// The format of a result.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VideoFormat {
    /// `recon.npy`, `[T, C, H, W]`.
    Npy,
    /// `recon.npz`, uncompressed; gray without its channel.
    Npz,
    /// `recon.mat`, v5: `[H, W, T]` or `[H, W, 3, T]`, times 255.
    Mat,
    /// `recon.tif`, a page of f32 for each frame and channel, as ImageJ's hyperstacks are.
    Tiff,
    /// `recon.tif` with 16 bits a sample, of which 0 is black and 65535 white.
    Tiff16,
}

impl VideoFormat {
    /// All of them, by their names in experiment files.
    pub const ALL: [(&str, Self); 5] =
        [("npy", Self::Npy), ("npz", Self::Npz), ("mat", Self::Mat), ("tiff", Self::Tiff), ("tiff16", Self::Tiff16)];

    /// The file's name.
    pub fn file_name(self) -> &'static str {
        match self {
            Self::Npy => "recon.npy",
            Self::Npz => "recon.npz",
            Self::Mat => "recon.mat",
            Self::Tiff | Self::Tiff16 => "recon.tif",
        }
    }

    /// Whether it can hold a video `[T, C, H, W]`; asked before the work is done that it would be written after.
    ///
    /// # Errors
    /// `InvalidInput`, saying what is too large.
    pub fn holds(self, shape: [usize; 4]) -> io::Result<()> {
        match self {
            Self::Mat => mat::write_variable_header(&mut io::sink(), NAME, &matlab_size(shape)),
            _ => Ok(()),
        }
    }
}

/// Videos `[T, C, H, W]` of one size, one after the other.
#[derive(Clone, Debug)]
pub struct Parts<'a> {
    /// `.npy` files of f32 in row-major order.
    pub paths: &'a [PathBuf],
    /// Of each.
    pub shape: [usize; 4],
    /// What white is in the result: all samples are multiplied by it.
    pub unit: f32,
}

impl Parts<'_> {
    fn joined_shape(&self) -> [usize; 4] {
        let [frames, channels, height, width] = self.shape;
        [self.paths.len() * frames, channels, height, width]
    }

    fn bytes(&self) -> u64 {
        self.joined_shape().iter().map(|&n| n as u64).product::<u64>() * 4
    }

    /// Calls `take` for each frame `[C, H, W]` in its order.
    fn each_frame<E: From<io::Error>>(&self, mut take: impl FnMut(&[f32]) -> Result<(), E>) -> Result<(), E> {
        let [frames, channels, height, width] = self.shape;
        let header = npy::header(&self.shape);
        let mut bytes = vec![0; 4 * channels * height * width];
        for path in self.paths {
            let mut file = BufReader::new(File::open(path)?);
            let mut found = vec![0; header.len()];
            file.read_exact(&mut found)?;
            if found != header {
                let reason = format!("{} is not of shape {:?}", path.display(), self.shape);
                return Err(io::Error::new(io::ErrorKind::InvalidData, reason).into());
            }
            for _ in 0..frames {
                file.read_exact(&mut bytes)?;
                let samples: Vec<f32> =
                    bytes.as_chunks().0.iter().map(|&b| f32::from_le_bytes(b) * self.unit).collect();
                take(&samples)?;
            }
        }
        Ok(())
    }
}

/// Joins the parts into one file.
///
/// # Errors
/// The file system's, naming the file; a part that is not of the shape; a result that the format cannot hold.
pub fn join(path: &Path, format: VideoFormat, parts: &Parts<'_>) -> Result<(), WriteError> {
    write_atomically(path, |w| match format {
        VideoFormat::Npy => write_npy(w, &parts.joined_shape(), parts),
        VideoFormat::Npz => write_npz(w, parts),
        VideoFormat::Mat => write_mat(w, parts),
        VideoFormat::Tiff => write_tiff::<Gray32Float>(w, parts, |x| x),
        VideoFormat::Tiff16 => {
            write_tiff::<Gray16>(w, parts, |x| (x / parts.unit * f32::from(u16::MAX)).round() as u16)
        }
    })
}

fn write_npy(w: &mut impl Write, shape: &[usize], parts: &Parts<'_>) -> Result<(), BoxError> {
    w.write_all(&npy::header(shape))?;
    parts.each_frame(|samples| Ok(w.write_all(&little_endian(samples.iter().copied()))?))
}

fn write_npz(w: &mut (impl Write + Seek), parts: &Parts<'_>) -> Result<(), BoxError> {
    let [frames, channels, height, width] = parts.joined_shape();
    let mut zip = ZipWriter::new(w);
    // Numbers of a camera hardly shrink.
    let options =
        SimpleFileOptions::default().compression_method(CompressionMethod::Stored).large_file(parts.bytes() > LARGE);
    zip.start_file(format!("{NAME}.npy"), options)?;
    let shape = if channels == 1 { vec![frames, height, width] } else { vec![frames, channels, height, width] };
    write_npy(&mut zip, &shape, parts)?;
    zip.finish()?;
    Ok(())
}

fn matlab_size([frames, channels, height, width]: [usize; 4]) -> Vec<usize> {
    if channels == 1 { vec![height, width, frames] } else { vec![height, width, channels, frames] }
}

fn write_mat(w: &mut impl Write, parts: &Parts<'_>) -> Result<(), BoxError> {
    let [_, _, height, width] = parts.shape;
    mat::write_file_header(w)?;
    mat::write_variable_header(w, NAME, &matlab_size(parts.joined_shape()))?;
    parts.each_frame(|samples| {
        // Column-major [H, W, C, T] is row-major [T, C, W, H].
        let planes = samples.chunks_exact(height * width);
        let columns = planes.flat_map(|plane| (0..width).flat_map(|x| plane[x..].iter().step_by(width)));
        Ok::<_, BoxError>(w.write_all(&little_endian(columns.map(|x| x * MAT_SCALE)))?)
    })?;
    Ok(w.write_all(mat::padding(parts.bytes() as usize))?)
}

fn little_endian(samples: impl Iterator<Item = f32>) -> Vec<u8> {
    samples.flat_map(f32::to_le_bytes).collect()
}

/// Pages of one channel each, in the order channel, frame: the only one that ImageJ reads color in floating point from.
fn write_tiff<C: Sample>(
    w: &mut (impl Write + Seek),
    parts: &Parts<'_>,
    convert: impl Fn(f32) -> C::Inner,
) -> Result<(), BoxError> {
    if parts.bytes() > LARGE {
        write_pages::<C, _, _>(TiffEncoder::new_big(w)?, parts, convert)
    } else {
        write_pages::<C, _, _>(TiffEncoder::new(w)?, parts, convert)
    }
}

fn write_pages<C: Sample, W: Write + Seek, K: TiffKind>(
    mut tiff: TiffEncoder<W, K>,
    parts: &Parts<'_>,
    convert: impl Fn(f32) -> C::Inner,
) -> Result<(), BoxError> {
    let [frames, channels, height, width] = parts.joined_shape();
    let side = |n: usize| u32::try_from(n).map_err(|_| "a TIFF side is at most 4294967295 pixels");
    let (rows, columns) = (side(height)?, side(width)?);
    let mode = if channels == 1 { "grayscale" } else { "composite" };
    let description = format!(
        "ImageJ=1.54f\nimages={}\nchannels={channels}\nframes={frames}\nhyperstack=true\nmode={mode}\nmin=0.0\nmax={}\n",
        frames * channels,
        C::white(parts.unit)
    );
    let mut first = true;
    parts.each_frame(|samples| {
        for plane in samples.chunks_exact(height * width) {
            let mut page = tiff.new_image::<C>(columns, rows)?;
            if std::mem::take(&mut first) {
                page.encoder().write_tag(Tag::ImageDescription, description.as_str())?;
            }
            let plane: Vec<C::Inner> = plane.iter().map(|&x| convert(x)).collect();
            C::write(page, &plane)?;
        }
        Ok(())
    })
}

/// The samples of a page.
trait Sample: ColorType {
    /// What white is, for the display.
    fn white(unit: f32) -> f32;

    fn write<W: Write + Seek, K: TiffKind>(
        page: tiff::encoder::ImageEncoder<'_, W, Self, K>,
        plane: &[Self::Inner],
    ) -> tiff::TiffResult<()>
    where
        Self: Sized;
}

impl Sample for Gray32Float {
    fn white(unit: f32) -> f32 {
        unit
    }

    fn write<W: Write + Seek, K: TiffKind>(
        page: tiff::encoder::ImageEncoder<'_, W, Self, K>,
        plane: &[f32],
    ) -> tiff::TiffResult<()> {
        page.write_data(plane)
    }
}

impl Sample for Gray16 {
    fn white(_: f32) -> f32 {
        f32::from(u16::MAX)
    }

    fn write<W: Write + Seek, K: TiffKind>(
        page: tiff::encoder::ImageEncoder<'_, W, Self, K>,
        plane: &[u16],
    ) -> tiff::TiffResult<()> {
        page.write_data(plane)
    }
}

/// Copies a file without writing its bytes again where the file system can.
///
/// # Errors
/// The file system's, naming the copy.
pub fn link_or_copy(from: &Path, to: &Path) -> Result<(), WriteError> {
    if std::fs::hard_link(from, to).is_ok() {
        return Ok(());
    }
    write_atomically(to, |w: &mut BufWriter<&File>| io::copy(&mut File::open(from)?, w).map(drop))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::scene::{self, Reading};
    use ndarray::{Array4, Axis, concatenate};
    use ndarray_npy::WriteNpyExt;

    fn video(seed: usize, channels: usize) -> Array4<f32> {
        Array4::from_shape_fn((2, channels, 3, 4), |(t, c, y, x)| {
            ((seed + t * 24 + c * 7 + y * 4 + x) % 50) as f32 / 64.0
        })
    }

    /// Two parts on disk, and the video they make.
    fn parts(dir: &Path, channels: usize) -> (Vec<PathBuf>, Array4<f32>) {
        let videos = [video(0, channels), video(11, channels)];
        let paths: Vec<PathBuf> = (0..2).map(|i| dir.join(format!("{channels}-{i}.npy"))).collect();
        for (path, video) in paths.iter().zip(&videos) {
            video.write_npy(File::create(path).unwrap()).unwrap();
        }
        (paths, concatenate(Axis(0), &[videos[0].view(), videos[1].view()]).unwrap())
    }

    #[test]
    fn parts_joined_in_any_format_read_back_as_the_video() {
        let dir = tempfile::tempdir().unwrap();
        let keys = scene::Keys { orig: "recon".into(), rgb: "recon".into(), ..Default::default() };
        for channels in [1, 3] {
            let (paths, expected) = parts(dir.path(), channels);
            for format in [VideoFormat::Npy, VideoFormat::Npz, VideoFormat::Mat] {
                let to = dir.path().join(format.file_name());
                let parts = Parts { paths: &paths, shape: [2, channels, 3, 4], unit: 0.5 };
                join(&to, format, &parts).unwrap();
                let found =
                    scene::read_video(&to, &Reading { keys: keys.clone(), ..Default::default() }).unwrap().frames;
                let worst = (found - &expected * 0.5).fold(0f32, |worst, d| worst.max(d.abs()));
                assert!(worst < 1e-6, "{format:?}, {channels} channels: {worst}");
            }
        }
    }

    #[test]
    fn a_tiff_has_a_page_for_each_frame_and_channel_and_says_so() {
        let dir = tempfile::tempdir().unwrap();
        let (paths, expected) = parts(dir.path(), 3);
        let parts = Parts { paths: &paths, shape: [2, 3, 3, 4], unit: 1.0 };
        for (format, white) in [(VideoFormat::Tiff, 1.0), (VideoFormat::Tiff16, 65535.0)] {
            let to = dir.path().join(format.file_name());
            join(&to, format, &parts).unwrap();
            let mut tiff = tiff::decoder::Decoder::new(File::open(&to).unwrap()).unwrap();
            let description = tiff.get_tag_ascii_string(Tag::ImageDescription).unwrap();
            assert!(
                description.starts_with("ImageJ=") && description.contains("channels=3\nframes=4\n"),
                "{description}"
            );
            let mut planes =
                expected.outer_iter().flat_map(|frame| frame.outer_iter().map(|p| p.to_owned()).collect::<Vec<_>>());
            loop {
                let plane = planes.next().unwrap();
                let found: Vec<f32> = match tiff.read_image().unwrap() {
                    tiff::decoder::DecodingResult::F32(v) => v,
                    tiff::decoder::DecodingResult::U16(v) => v.into_iter().map(|x| f32::from(x) / white).collect(),
                    _ => panic!("neither f32 nor u16"),
                };
                assert!(found.iter().zip(&plane).all(|(a, b)| (a - b).abs() < 1e-5));
                if !tiff.more_images() {
                    break;
                }
                tiff.next_image().unwrap();
            }
            assert!(planes.next().is_none());
        }
    }

    #[test]
    fn a_mat_that_is_too_large_is_refused_before_there_is_anything_to_write() {
        assert!(VideoFormat::Mat.holds([8, 1, 256, 256]).is_ok());
        let error = VideoFormat::Mat.holds([1 << 10, 3, 1 << 10, 1 << 10]).unwrap_err().to_string();
        assert!(error.contains("4 GiB") && error.contains("npy"), "{error}");
        assert!(VideoFormat::Npy.holds([1 << 10, 3, 1 << 10, 1 << 10]).is_ok());
    }
}
