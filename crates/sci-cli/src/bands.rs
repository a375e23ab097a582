//! Owns how a scene that is too large for memory is cut into bands of rows: which rows are solved together, and how results are joined.
//!
//! H works on each pixel alone, and a prior looks only so far: a band that is solved with a margin of [`MARGIN`] rows on either side has
//! in its inside what the whole scene would have there. Half of the margin is thrown away; over the other half two neighbours are
//! blended, so that what little they differ by draws no line.

use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

use ndarray::{Array3, Array4, s};
use sci_forward::VideoShape;

use crate::io::npy;
use crate::io::output::WriteError;

/// Rows that a band is solved with beyond its own, on either side.
pub const MARGIN: usize = 64;
/// Bands begin at a multiple of this: networks work at an eighth of the size, and a Bayer pattern has a period of two.
const STEP: usize = 16;
/// The lowest band without margins. Bands that are evened out to at most this have at least the rows over which two are blended, so that no row is
/// one of three.
const LOWEST: usize = 96;
/// What the program takes before it has a scene: its code, weights, threads.
const PROGRAM: usize = 100 << 20;

/// Bytes that reading and solving a scene take at most, beside those of the program.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Footprint {
    /// For each pixel of each frame.
    pub of_frame_pixel: usize,
    /// For each pixel of the sensor, whatever the number of frames.
    pub of_pixel: usize,
    /// For each frame, whatever its size.
    pub of_frame: usize,
    /// Whatever the scene.
    pub fixed: usize,
}

impl Footprint {
    /// Bytes for a scene of this size.
    pub fn bytes(self, shape: VideoShape) -> usize {
        let pixels = shape.height * shape.width;
        PROGRAM + self.fixed + shape.frames * (self.of_frame + pixels * self.of_frame_pixel) + pixels * self.of_pixel
    }

    /// How many rows of a scene fit into `memory` bytes.
    fn rows(self, shape: VideoShape, memory: usize) -> usize {
        let [none, one] = [0, 1].map(|height| self.bytes(VideoShape { height, ..shape }));
        memory.saturating_sub(none) / (one - none).max(1)
    }
}

/// The bands of a scene.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Bands {
    /// Where they begin and the last one ends, without margins.
    edges: Vec<usize>,
}

impl Bands {
    /// As few bands as fit into `memory` bytes, all about as high.
    ///
    /// # Errors
    /// The bytes that would do, where not even a low band fits.
    pub fn new(shape: VideoShape, footprint: Footprint, memory: usize) -> Result<Self, usize> {
        let height = shape.height;
        let fits = footprint.rows(shape, memory);
        if fits >= height {
            return Ok(Self { edges: vec![0, height] });
        }
        let least = 2 * MARGIN + LOWEST;
        if fits < least {
            return Err(footprint.bytes(VideoShape { height: least, ..shape }));
        }
        let own = (fits - 2 * MARGIN) / STEP * STEP;
        let count = height.div_ceil(own);
        let edge = |i: usize| if i == count { height } else { (height * i / count).next_multiple_of(STEP).min(height) };
        let mut edges: Vec<usize> = (0..=count).map(edge).collect();
        edges.dedup();
        Ok(Self { edges })
    }

    /// How many there are.
    pub fn count(&self) -> usize {
        self.edges.len() - 1
    }

    /// Whether the scene is one band.
    pub fn is_whole(&self) -> bool {
        self.count() == 1
    }

    /// The band in the middle.
    pub fn middle(&self) -> usize {
        self.count() / 2
    }

    fn widened(&self, band: usize, by: usize) -> Range<usize> {
        let height = self.edges[self.count()];
        self.edges[band].saturating_sub(by)..(self.edges[band + 1] + by).min(height)
    }

    /// The rows that are solved for a band.
    ///
    /// # Panics
    /// If there is no such band.
    pub fn solved(&self, band: usize) -> Range<usize> {
        self.widened(band, MARGIN)
    }

    /// The rows of which a band's result is used.
    ///
    /// # Panics
    /// If there is no such band.
    pub fn kept(&self, band: usize) -> Range<usize> {
        self.widened(band, MARGIN / 2)
    }

    /// Of the video that was solved for a band, what is kept of it.
    ///
    /// # Panics
    /// If `video` has not the rows of [`Bands::solved`].
    pub fn cut(&self, band: usize, video: &ndarray::ArrayView4<'_, f32>) -> Array4<f32> {
        let (solved, kept) = (self.solved(band), self.kept(band));
        assert_eq!(video.dim().2, solved.len(), "the rows that were solved");
        video.slice(s![.., .., kept.start - solved.start..kept.end - solved.start, ..]).to_owned()
    }

    /// The share that a band has in a row of the joined video. The shares of all bands add up to 1.
    fn share(&self, band: usize, row: usize) -> f32 {
        let rising = |edge: usize| {
            let into = row as f32 - edge as f32 + (MARGIN / 2) as f32 + 0.5;
            (into / MARGIN as f32).clamp(0.0, 1.0)
        };
        let begins = if band == 0 { 1.0 } else { rising(self.edges[band]) };
        let ends = if band + 1 == self.count() { 0.0 } else { rising(self.edges[band + 1]) };
        begins - ends
    }
}

/// The kept parts of all bands as `.npy` files `[T, C, rows, W]`, to be read as one video, a frame at a time.
pub struct Joined<'b> {
    bands: &'b Bands,
    files: Vec<BufReader<File>>,
    /// T, C, H, W.
    shape: [usize; 4],
}

impl<'b> Joined<'b> {
    /// Opens the parts of a video of this shape.
    ///
    /// # Errors
    /// A file that cannot be read, or is of another shape.
    pub fn open(bands: &'b Bands, paths: &[PathBuf], shape: [usize; 4]) -> io::Result<Self> {
        let mut files = Vec::new();
        for (band, path) in paths.iter().enumerate() {
            let header = npy::header(&[shape[0], shape[1], bands.kept(band).len(), shape[3]]);
            let (mut file, mut found) = (BufReader::new(File::open(path)?), vec![0; header.len()]);
            file.read_exact(&mut found)?;
            if found != header {
                let reason = format!("{} is not the part of a band", path.display());
                return Err(io::Error::new(io::ErrorKind::InvalidData, reason));
            }
            files.push(file);
        }
        Ok(Self { bands, files, shape })
    }

    /// The next frame `[C, H, W]`.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn next_frame(&mut self) -> io::Result<Array3<f32>> {
        let [_, channels, height, width] = self.shape;
        let mut frame = Array3::zeros((channels, height, width));
        for (band, file) in self.files.iter_mut().enumerate() {
            let kept = self.bands.kept(band);
            let mut bytes = vec![0; 4 * channels * kept.len() * width];
            file.read_exact(&mut bytes)?;
            let mut rows = bytes.chunks_exact(4 * width);
            for channel in 0..channels {
                for row in kept.clone() {
                    let (share, samples) = (self.bands.share(band, row), rows.next().unwrap_or_default());
                    let to = frame.slice_mut(s![channel, row, ..]);
                    let values = samples.as_chunks().0.iter().map(|&b| f32::from_le_bytes(b));
                    to.into_iter().zip(values).for_each(|(to, value)| *to += share * value);
                }
            }
        }
        Ok(frame)
    }

    /// Writes the video as `.npy`, and hands each frame on with its number.
    ///
    /// # Errors
    /// The file system's, naming the file, and that of `look`.
    pub fn write(
        mut self,
        path: &Path,
        mut look: impl FnMut(usize, Array3<f32>) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        let fail = |e: io::Error| WriteError::new(path, e);
        let mut file = BufWriter::new(File::create(path).map_err(fail)?);
        file.write_all(&npy::header(&self.shape)).map_err(fail)?;
        for t in 0..self.shape[0] {
            let frame = self.next_frame().map_err(fail)?;
            for row in frame.rows() {
                let bytes: Vec<u8> = row.iter().flat_map(|value| value.to_le_bytes()).collect();
                file.write_all(&bytes).map_err(fail)?;
            }
            look(t, frame)?;
        }
        Ok(file.flush().map_err(fail)?)
    }
}

/// Frame `t` of an `.npy` file of this shape, `[C, H, W]`.
///
/// # Errors
/// A file that cannot be read.
pub fn frame_of(path: &Path, shape: [usize; 4], t: usize) -> io::Result<Array3<f32>> {
    let [_, channels, height, width] = shape;
    let size = 4 * channels * height * width;
    let mut file = File::open(path)?;
    file.seek(SeekFrom::Start((npy::header(&shape).len() + t * size) as u64))?;
    let mut bytes = vec![0; size];
    file.read_exact(&mut bytes)?;
    let samples = bytes.as_chunks().0.iter().map(|&b| f32::from_le_bytes(b)).collect();
    Array3::from_shape_vec((channels, height, width), samples).map_err(io::Error::other)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHAPE: VideoShape = VideoShape { frames: 8, height: 2160, width: 3840 };
    const FOOTPRINT: Footprint = Footprint { of_frame_pixel: 50, of_pixel: 300, of_frame: 1 << 20, fixed: 10 << 20 };

    #[test]
    fn bands_fit_cover_every_row_and_share_it() {
        let least = Bands::new(SHAPE, FOOTPRINT, 400 << 20).unwrap_err();
        for memory in [least, 1usize << 30, 2 << 30, 3 << 30] {
            let bands = Bands::new(SHAPE, FOOTPRINT, memory).unwrap();
            assert!(bands.count() > 1);
            for band in 0..bands.count() {
                let solved = bands.solved(band);
                assert!(FOOTPRINT.bytes(VideoShape { height: solved.len(), ..SHAPE }) <= memory, "{solved:?}");
                assert_eq!(solved.start % STEP, 0);
            }
            for row in 0..SHAPE.height {
                let shares: Vec<f32> = (0..bands.count()).map(|band| bands.share(band, row)).collect();
                assert!((shares.iter().sum::<f32>() - 1.0).abs() < 1e-6);
                for (band, share) in shares.iter().enumerate() {
                    assert!(*share >= 0.0 && (*share == 0.0 || bands.kept(band).contains(&row)), "{band} {row}");
                }
            }
        }
        assert!(Bands::new(SHAPE, FOOTPRINT, 32 << 30).unwrap().is_whole());
    }

    #[test]
    fn too_little_memory_is_told_by_how_much_would_do() {
        let needed = Bands::new(SHAPE, FOOTPRINT, 400 << 20).unwrap_err();
        assert!(needed > 400 << 20 && Bands::new(SHAPE, FOOTPRINT, needed).is_ok());
    }

    #[test]
    fn parts_of_one_video_are_joined_to_it() {
        let dir = tempfile::tempdir().unwrap();
        let shape = VideoShape { frames: 2, height: 700, width: 6 };
        let bands =
            Bands::new(shape, Footprint { of_pixel: 1 << 16, ..Footprint::default() }, PROGRAM + (110 << 20)).unwrap();
        assert!(bands.count() > 2, "{bands:?}");
        let video = Array4::from_shape_fn((2, 3, 700, 6), |(t, c, y, x)| (t + 2 * c + y * x) as f32 / 4096.0);
        let paths: Vec<PathBuf> = (0..bands.count()).map(|band| dir.path().join(format!("{band}.npy"))).collect();
        for (band, path) in paths.iter().enumerate() {
            let solved = bands.solved(band);
            let part = bands.cut(band, &video.slice(s![.., .., solved, ..]));
            npy::write_npy(&mut File::create(path).unwrap(), &part).unwrap();
        }
        let (path, shape) = (dir.path().join("video.npy"), [2, 3, 700, 6]);
        let mut seen = 0;
        Joined::open(&bands, &paths, shape)
            .unwrap()
            .write(&path, |t, frame| {
                let off = (&frame - &video.slice(s![t, .., .., ..])).iter().fold(0f32, |most, d| most.max(d.abs()));
                assert!(off < 1e-6, "{off}");
                seen += 1;
                Ok(())
            })
            .unwrap();
        assert_eq!(seen, 2);
        assert_eq!(frame_of(&path, shape, 1).unwrap()[[2, 699, 5]], video[[1, 2, 699, 5]]);
    }
}
