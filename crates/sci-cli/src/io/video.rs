//! Owns video files: animated GIF (read and write) and Y4M (read).

use std::fs;
use std::io::{self, Cursor, Read, Write};
use std::path::PathBuf;

use image::{AnimationDecoder, ImageDecoder, Limits, codecs::gif::GifDecoder};
use ndarray::{ArrayView3, ArrayView4};
use rayon::prelude::*;

use super::ReadError;
use super::frames::{push_planes, to_byte, to_pixels};
use super::samples::{Array, Budget, SampleType, Samples};

const GIF: &str = ".gif";
const Y4M: &str = ".y4m";
/// Longest side accepted, so that no product of sizes can overflow.
const MAX_SIDE: usize = 1 << 16;
/// The pixels of a video that the palette of its GIF is made of; a side of a frame can be as long.
const SAMPLE: usize = 1 << 15;
/// How coarsely these are sampled once more, 1 to 30.
const PALETTE_SPEED: i32 = 4;
/// The last byte of a GIF.
const GIF_END: u8 = 0x3b;

/// Whether the bytes open like a GIF.
pub fn is_gif(bytes: &[u8]) -> bool {
    bytes.starts_with(b"GIF8")
}

/// Whether the bytes open like a Y4M stream.
pub fn is_y4m(bytes: &[u8]) -> bool {
    bytes.starts_with(b"YUV4MPEG2")
}

/// Reads an animated GIF as `[T, C, H, W]`, 0 to 255; C = 1 if every pixel of every frame is gray, else 3.
///
/// # Errors
/// [`ReadError`] for broken bytes or more pixels than the file's budget.
pub fn read_gif(bytes: &[u8]) -> Result<Array, ReadError> {
    let broken = |e: image::ImageError| ReadError::Malformed { format: GIF, reason: e.to_string() };
    let open = || -> Result<(image::Frames<'_>, usize, usize), ReadError> {
        let mut decoder = GifDecoder::new(Cursor::new(bytes)).map_err(broken)?;
        let (w, h) = decoder.dimensions();
        let mut limits = Limits::default();
        limits.max_alloc = Some(Budget::for_file(bytes.len()).left() as u64);
        decoder.set_limits(limits).map_err(broken)?;
        Ok((decoder.into_frames(), w as usize, h as usize))
    };
    let mut budget = Budget::for_file(bytes.len());
    // The frames are counted first: a vector that grows would hold its content twice.
    let (counted, w, h) = open()?;
    // The decoder keeps a canvas, the part of it that changes and the new one, and hands that out, all RGBA.
    budget.claim(w * h, 16)?;
    let mut frames = 0;
    for frame in counted {
        frame.map_err(broken)?;
        budget.claim(w * h, 3)?;
        frames += 1;
    }
    let mut planes = Vec::with_capacity(frames * w * h * 3);
    for frame in open()?.0 {
        push_planes(&mut planes, &frame.map_err(broken)?.into_buffer().into_raw(), 4);
    }
    if frames == 0 {
        return Err(ReadError::Malformed { format: GIF, reason: "no frames".into() });
    }
    drop_equal_channels(planes, frames, h, w)
}

/// Keeps one channel of a video `[T, 3, H, W]` whose channels are all equal.
pub(super) fn drop_equal_channels(mut planes: Vec<u8>, t: usize, h: usize, w: usize) -> Result<Array, ReadError> {
    let n = h * w;
    let gray = n > 0 && planes.chunks_exact(3 * n).all(|f| f[..n] == f[n..2 * n] && f[..n] == f[2 * n..]);
    if gray {
        (0..t).for_each(|f| planes.copy_within(3 * n * f..3 * n * f + n, n * f));
        planes.truncate(t * n);
        Array::new(vec![t, 1, h, w], Samples::Bytes(planes), SampleType::U8)
    } else {
        Array::new(vec![t, 3, h, w], Samples::Bytes(planes), SampleType::U8)
    }
}

/// Reads a Y4M stream of 8 to 16 bits a sample as `[T, C, H, W]`, from 0 to full scale: C = 1 for `mono`, else RGB.
///
/// YCbCr is taken as BT.601, limited range (16 to 235 of 255) unless the header says `XCOLORRANGE=FULL`; chroma of a
/// subsampled stream is repeated.
///
/// # Errors
/// [`ReadError`] for broken bytes, or more pixels than the file's budget.
pub fn read_y4m(bytes: &[u8]) -> Result<Array, ReadError> {
    let bad = |reason: String| ReadError::Malformed { format: Y4M, reason };
    let header = Y4mHeader::read(bytes)?;
    let mut budget = Budget::for_file(bytes.len());
    let limits = y4m::Limits { bytes: budget.left() };
    let mut reader = Cursor::new(header.known.as_bytes()).chain(header.frames);
    let mut decoder = y4m::Decoder::new_with_limits(&mut reader, limits).map_err(|e| bad(e.to_string()))?;
    let (w, h) = (decoder.get_width(), decoder.get_height());
    let space = decoder.get_colorspace();
    let deep = decoder.get_bytes_per_sample() == 2;
    budget.claim(w * h, if deep { 6 } else { 3 })?;
    let channels = if matches!(space, y4m::Colorspace::Cmono | y4m::Colorspace::Cmono12) { 1 } else { 3 };
    let convert = Ycc { space, size: (w, h), bits: header.bits, full_range: header.full_range };
    let (mut planes, mut deep_planes) = (Vec::new(), Vec::new());
    let mut frames = 0;
    loop {
        match decoder.read_frame() {
            Ok(frame) => {
                budget.claim(w * h * channels, if deep { 4 } else { 1 })?;
                let ycc = [frame.get_y_plane(), frame.get_u_plane(), frame.get_v_plane()];
                if deep {
                    convert.each(ycc, |x| deep_planes.push(x));
                } else {
                    convert.each(ycc, |x| planes.push(x as u8));
                }
                frames += 1;
            }
            Err(y4m::Error::EOF) => break,
            Err(e) => return Err(bad(format!("frame {frames}: {e}"))),
        }
    }
    if frames == 0 {
        return Err(bad("no frames".into()));
    }
    let shape = vec![frames, channels, h, w];
    if deep {
        Ok(Array::new(shape, Samples::Floats(deep_planes), SampleType::U16)?.with_white(convert.white()))
    } else {
        Array::new(shape, Samples::Bytes(planes), SampleType::U8)
    }
}

/// The header line, read before the decoder does: that multiplies sizes unchecked, and knows few of the depths that exist.
struct Y4mHeader<'a> {
    /// The line, with a depth of more than 8 bits called 12, which is stored the same way.
    known: String,
    /// What follows it.
    frames: &'a [u8],
    bits: u32,
    /// Whether samples use all of 0 to full scale.
    full_range: bool,
}

impl<'a> Y4mHeader<'a> {
    fn read(bytes: &'a [u8]) -> Result<Self, ReadError> {
        let bad = |field: &str, rule: String| ReadError::Malformed {
            format: Y4M,
            reason: format!("header field {field:?}: {rule}"),
        };
        let end = bytes
            .iter()
            .take(MAX_Y4M_HEADER)
            .position(|&b| b == b'\n')
            .map_or(bytes.len().min(MAX_Y4M_HEADER), |at| at + 1);
        let (line, frames) = bytes.split_at(end);
        let line = String::from_utf8_lossy(line);
        let side = |field: &str| field.strip_prefix('W').or_else(|| field.strip_prefix('H')).map(str::parse::<usize>);
        let (mut known, mut bits) = (line.to_string(), 8);
        for field in line.split_ascii_whitespace().skip(1) {
            if side(field).is_some_and(|n| !n.is_ok_and(|n| (1..=MAX_SIDE).contains(&n))) {
                return Err(bad(field, format!("a side is 1 to {MAX_SIDE} pixels")));
            }
            let Some((space, depth)) = field.strip_prefix('C').and_then(deep_space) else { continue };
            if !(9..=16).contains(&depth) {
                return Err(bad(field, format!("samples of {depth} bits, supported are 8 to 16")));
            }
            bits = depth;
            known = line.replacen(field, &format!("C{space}12"), 1);
        }
        Ok(Self { known, frames, bits, full_range: line.contains("XCOLORRANGE=FULL") })
    }
}

/// Longest header line accepted; the decoder's own limit is 1024.
const MAX_Y4M_HEADER: usize = 1024;

/// A color space of more than 8 bits, such as `420p10` or `mono16`: its name up to the depth, and that.
fn deep_space(space: &str) -> Option<(&str, u32)> {
    let name = ["420p", "422p", "444p", "mono"].into_iter().find(|name| space.starts_with(name))?;
    Some((name, space[name.len()..].parse().ok()?))
}

/// How luma and chroma become gray or RGB.
struct Ycc {
    space: y4m::Colorspace,
    /// Width and height.
    size: (usize, usize),
    bits: u32,
    full_range: bool,
}

impl Ycc {
    fn white(&self) -> f32 {
        ((1u32 << self.bits) - 1) as f32
    }

    /// Calls `put` for each sample of a frame, plane by plane, rounded and from 0 to white.
    fn each(&self, [y, u, v]: [&[u8]; 3], mut put: impl FnMut(f32)) {
        use y4m::Colorspace as C;
        let (w, h) = self.size;
        let white = self.white();
        // The levels of limited range are those of 8 bits, with zeros after them.
        let step = (1u32 << (self.bits - 8)) as f32;
        let (y_scale, y_zero, c_scale) = match self.full_range {
            true => (1.0, 0.0, 1.0),
            false => (white / (219.0 * step), 16.0 * step, white / (224.0 * step)),
        };
        let deep = self.bits > 8;
        let sample = |plane: &[u8], i: usize| match deep {
            true => f32::from(u16::from_le_bytes([plane[2 * i], plane[2 * i + 1]])),
            false => f32::from(plane[i]),
        };
        let luma = |i: usize| (sample(y, i) - y_zero) * y_scale;
        let mut put = |x: f32| put(x.round().clamp(0.0, white));
        let (sx, sy) = match self.space {
            C::Cmono | C::Cmono12 => {
                (0..w * h).for_each(|i| put(luma(i)));
                return;
            }
            C::C444 | C::C444p10 | C::C444p12 => (1, 1),
            C::C422 | C::C422p10 | C::C422p12 => (2, 1),
            _ => (2, 2),
        };
        let chroma = |plane: &[u8], i: usize| {
            let (row, col) = (i / w / sy, i % w / sx);
            (sample(plane, row * w.div_ceil(sx) + col) - 128.0 * step) * c_scale
        };
        (0..w * h).for_each(|i| put(luma(i) + 1.402 * chroma(v, i)));
        (0..w * h).for_each(|i| put(luma(i) - 0.344_136 * chroma(u, i) - 0.714_136 * chroma(v, i)));
        (0..w * h).for_each(|i| put(luma(i) + 1.772 * chroma(u, i)));
    }
}

/// Writes a video `[T, C, H, W]`, C = 1 or 3, samples in `[0, 1]`, as an endless animated GIF of `fps` frames a second.
///
/// Gray video keeps all 256 levels; color is reduced to 256 colors, the same for all frames.
///
/// # Errors
/// The encoder's or the writer's error; a side above 65535 pixels.
pub fn write_gif(w: impl Write, video: ArrayView4<'_, f32>, fps: u16) -> Result<(), gif::EncodingError> {
    let (_, channels, height, width) = video.dim();
    let side = |n: usize| {
        u16::try_from(n).map_err(|_| io::Error::new(io::ErrorKind::InvalidInput, "a GIF side is at most 65535 pixels"))
    };
    let (height, width) = (side(height)?, side(width)?);
    let ramp: Vec<u8> = (0..=255).flat_map(|g| [g; 3]).collect();
    let palette = (channels == 3).then(|| Palette::of(video));
    // Colors go with each frame, so that GIFs can be joined.
    let mut encoder = gif::Encoder::new(w, width, height, if palette.is_none() { &ramp } else { &[] })?;
    encoder.set_repeat(gif::Repeat::Infinite)?;
    let frames: Vec<ArrayView3<'_, f32>> = video.outer_iter().collect();
    let encoded: Vec<gif::Frame<'static>> = frames
        .par_iter()
        .map(|frame| {
            let pixels = to_pixels(*frame);
            let indices = palette.as_ref().map(|palette| palette.indices(&pixels));
            let mut gif_frame = gif::Frame {
                width,
                height,
                delay: 100 / fps.max(1),
                buffer: indices.unwrap_or(pixels).into(),
                palette: palette.as_ref().map(|palette| palette.colors.clone()),
                ..Default::default()
            };
            gif_frame.make_lzw_pre_encoded();
            gif_frame
        })
        .collect();
    encoded.iter().try_for_each(|frame| encoder.write_lzw_pre_encoded_frame(frame))
}

/// The colors of a video's GIF. Making 256 colors is the slow part, so they are made once, of a sample; and which of them is
/// nearest is asked once for each cell of a grid, not for each pixel.
struct Palette {
    /// RGB, one after the other.
    colors: Vec<u8>,
    /// The nearest color of each cell.
    nearest: Vec<u8>,
}

impl Palette {
    /// Cells of the grid along each of the three axes, as a power of two.
    const BITS: usize = 5;

    fn of(video: ArrayView4<'_, f32>) -> Self {
        let (frames, _, height, width) = video.dim();
        // Odd, so that an even width does not make it a few columns.
        let step = (frames * height * width).div_ceil(SAMPLE) | 1;
        let places = (0..frames * height * width).step_by(step);
        let pixel = |i: usize| {
            let (t, y, x) = (i / width / height, i / width % height, i % width);
            [0, 1, 2].map(|c| to_byte(video[[t, c, y, x]]))
        };
        let sample: Vec<u8> = places.flat_map(pixel).collect();
        // The crate's quantiser is at hand only in the shape of a frame.
        let frame = gif::Frame::from_rgb_speed((sample.len() / 3) as u16, 1, &sample, PALETTE_SPEED);
        let colors = frame.palette.unwrap_or_default();
        let cells = 0..1usize << (3 * Self::BITS);
        let nearest = cells.map(|cell| nearest(&colors, Self::middle(cell))).collect();
        Self { colors, nearest }
    }

    /// The color in the middle of a cell.
    fn middle(cell: usize) -> [i32; 3] {
        let half = 1 << (7 - Self::BITS);
        [2, 1, 0]
            .map(|axis| ((cell >> (axis * Self::BITS)) & ((1 << Self::BITS) - 1)) << (8 - Self::BITS) | half)
            .map(|level| level as i32)
    }

    fn indices(&self, pixels: &[u8]) -> Vec<u8> {
        let cell =
            |rgb: &[u8; 3]| rgb.iter().fold(0, |cell, &v| cell << Self::BITS | usize::from(v) >> (8 - Self::BITS));
        pixels.as_chunks::<3>().0.iter().map(|rgb| self.nearest[cell(rgb)]).collect()
    }
}

/// Which of the colors, at most 256, is nearest.
fn nearest(colors: &[u8], to: [i32; 3]) -> u8 {
    let distance = |color: &[u8; 3]| (0..3).map(|c| (i32::from(color[c]) - to[c]).pow(2)).sum::<i32>();
    let distances = colors.as_chunks::<3>().0.iter().map(distance).enumerate();
    distances.min_by_key(|(_, distance)| *distance).map_or(0, |(index, _)| index as u8)
}

/// Writes the GIF of several, which [`write_gif`] made of videos of one size, one after the other.
///
/// # Errors
/// The reader's or the writer's error.
pub fn join_gifs(w: &mut impl Write, parts: &[PathBuf]) -> io::Result<()> {
    for (i, part) in parts.iter().enumerate() {
        let bytes = fs::read(part)?;
        // They begin with the same bytes up to the first frame, and end with one that says so.
        let frames = bytes.get(if i == 0 { 0 } else { gif_head(&bytes) }..bytes.len() - 1).unwrap_or_default();
        w.write_all(frames)?;
    }
    w.write_all(&[GIF_END])
}

/// The length of what [`write_gif`] writes before the first frame: header, screen, a palette if the screen has one, repetition.
fn gif_head(bytes: &[u8]) -> usize {
    const HAS_PALETTE: u8 = 0x80;
    let palette = match bytes.get(10) {
        Some(flags) if flags & HAS_PALETTE != 0 => 3 << ((flags & 7) + 1),
        _ => 0,
    };
    6 + 7 + palette + 19
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array4, Axis};

    #[test]
    fn gray_gif_round_trip_is_exact() {
        let video = Array4::from_shape_fn((3, 1, 5, 7), |(t, _, y, x)| ((t * 80 + y * 7 + x) as f32) / 255.0);
        let mut bytes = Vec::new();
        write_gif(&mut bytes, video.view(), 10).unwrap();
        let read = read_gif(&bytes).unwrap();
        assert_eq!(read.shape(), [3, 1, 5, 7]);
        let expected: Vec<u8> = video.iter().map(|&x| to_byte(x)).collect();
        assert_eq!(read.samples(), &Samples::Bytes(expected));
    }

    #[test]
    fn joined_gifs_show_the_joined_videos() {
        let dir = tempfile::tempdir().unwrap();
        for channels in [1, 3] {
            let video =
                Array4::from_shape_fn((5, channels, 6, 7), |(t, c, y, x)| ((t * 31 + c * 5 + y * x) as f32) / 255.0);
            let gif = |video: ArrayView4<'_, f32>| {
                let mut bytes = Vec::new();
                write_gif(&mut bytes, video, 10).unwrap();
                bytes
            };
            let (first, second) = video.view().split_at(Axis(0), 2);
            let single = [gif(first), gif(second)];
            let parts: Vec<PathBuf> = (0..2).map(|i| dir.path().join(format!("{i}.gif"))).collect();
            parts.iter().zip(&single).for_each(|(path, bytes)| fs::write(path, bytes).unwrap());
            let mut joined = Vec::new();
            join_gifs(&mut joined, &parts).unwrap();
            let shown = |gif: &[u8]| read_gif(gif).unwrap().into_samples();
            let mut expected = shown(&single[0]);
            expected.append(shown(&single[1]));
            assert_eq!(shown(&joined), expected, "{channels} channels");
        }
    }

    #[test]
    fn a_few_colors_are_kept_and_many_are_near() {
        let shown = |video: &Array4<f32>| {
            let mut bytes = Vec::new();
            write_gif(&mut bytes, video.view(), 10).unwrap();
            read_gif(&bytes).unwrap()
        };
        // Levels in the middle of the grid's cells, fewer than 256 colors.
        let few = Array4::from_shape_fn((2, 3, 4, 5), |(t, c, y, x)| (4 + 8 * (t + 3 * c + y + 2 * x)) as f32 / 255.0);
        let read = shown(&few);
        few.iter()
            .enumerate()
            .for_each(|(i, &v)| assert_eq!(read.samples().at(i), f32::from(to_byte(v)), "sample {i}"));
        let many = Array4::from_shape_fn((2, 3, 100, 120), |(t, c, y, x)| match c {
            0 => y as f32 / 99.0,
            1 => x as f32 / 119.0,
            _ => 0.3 + 0.2 * t as f32,
        });
        let read = shown(&many);
        let off = many.iter().enumerate().map(|(i, v)| (255.0 * v - read.samples().at(i)).abs());
        let (worst, mean) =
            off.fold((0.0f32, 0.0), |(worst, sum), off| (worst.max(off), sum + off / many.len() as f32));
        assert!(worst < 40.0 && mean < 8.0, "{worst} at worst, {mean} in the mean");
    }

    #[test]
    fn color_gif_keeps_three_channels() {
        let video = Array4::from_shape_fn((2, 3, 4, 4), |(_, c, _, _)| c as f32 / 2.0);
        let mut bytes = Vec::new();
        write_gif(&mut bytes, video.view(), 10).unwrap();
        assert_eq!(read_gif(&bytes).unwrap().shape(), [2, 3, 4, 4]);
    }

    fn y4m_bytes(header: &str, frame: &[u8], frames: usize) -> Vec<u8> {
        let mut bytes = format!("YUV4MPEG2 {header}\n").into_bytes();
        for _ in 0..frames {
            bytes.extend(b"FRAME\n");
            bytes.extend(frame);
        }
        bytes
    }

    #[test]
    fn y4m_ranges_and_subsampling() {
        let mono = read_y4m(&y4m_bytes("W2 H1 F25:1 Cmono", &[16, 235], 2)).unwrap();
        assert_eq!((mono.shape(), mono.samples()), (&[2, 1, 1, 2][..], &Samples::Bytes(vec![0, 255, 0, 255])));
        let full = read_y4m(&y4m_bytes("W2 H1 F25:1 Cmono XCOLORRANGE=FULL", &[16, 235], 1)).unwrap();
        assert_eq!(full.samples(), &Samples::Bytes(vec![16, 235]));
        // A 3×3 picture has 2×2 chroma; gray chroma gives equal channels.
        let mut frame = vec![126; 9];
        frame.extend([128; 8]);
        let color = read_y4m(&y4m_bytes("W3 H3 F25:1 C420jpeg", &frame, 1)).unwrap();
        assert_eq!((color.shape(), color.samples()), (&[1, 3, 3, 3][..], &Samples::Bytes(vec![128; 27])));
    }

    #[test]
    fn y4m_of_ten_to_sixteen_bits() {
        for (bits, white) in [(10u32, 1023.0), (12, 4095.0), (16, 65535.0)] {
            let word = |x: u32| (x << (bits - 8)).to_le_bytes()[..2].to_vec();
            let mono = [word(16), word(235)].concat();
            let mono = read_y4m(&y4m_bytes(&format!("W2 H1 F25:1 Cmono{bits}"), &mono, 2)).unwrap();
            assert_eq!((mono.shape(), mono.white()), (&[2, 1, 1, 2][..], Some(white)));
            assert_eq!(mono.samples(), &Samples::Floats(vec![0.0, white, 0.0, white]));
            let gray = [word(16), word(235), word(16), word(235), word(128), word(128)].concat();
            let header = format!("W2 H2 F25:1 Ip A1:1 C420p{bits} XYSCSS=420P{bits} XCOLORRANGE=LIMITED");
            let color = read_y4m(&y4m_bytes(&header, &gray, 1)).unwrap();
            assert_eq!((color.shape(), color.stored()), (&[1, 3, 2, 2][..], SampleType::U16));
            assert_eq!(color.samples(), &Samples::Floats([0.0, white, 0.0, white].repeat(3)));
        }
        let full = read_y4m(&y4m_bytes("W1 H1 F25:1 C444p10 XCOLORRANGE=FULL", &[5, 1, 0, 2, 0, 2], 1)).unwrap();
        assert_eq!(full.samples(), &Samples::Floats(vec![261.0; 3]));
    }

    #[test]
    fn hostile_headers_give_errors() {
        for header in ["W99999999999 H99999999999", "W65536 H65536 C444", "W0 H3", "W-1 H3", "W2 H1 C420p99", ""] {
            assert!(read_y4m(&y4m_bytes(header, &[0; 30], 1)).is_err(), "{header}");
        }
        assert!(read_y4m(&y4m_bytes("W2 H2 Cmono", &[0; 3], 1)).is_err());
        let huge = b"GIF89a\xff\xff\xff\xff\x80\x00\x00\0\0\0\xff\xff\xff,\0\0\0\0\xff\xff\xff\xff\x00\x02\x02D\x01\0;";
        assert!(read_gif(huge).is_err());
    }

    #[test]
    fn flipped_gif_bytes_never_panic() {
        let mut bytes = Vec::new();
        write_gif(&mut bytes, Array4::from_elem((2, 1, 4, 4), 0.5).view(), 10).unwrap();
        for at in 0..bytes.len() {
            let mut b = bytes.clone();
            b[at] ^= 0xff;
            let _ = read_gif(&b);
            let _ = read_gif(&bytes[..at]);
        }
    }
}
