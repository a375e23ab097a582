//! Owns TIFF, read: pages of gray or RGB in any number type and the compressions of cameras and ImageJ, decoded by `tiff`.
//!
//! A stack says in its description which page is which frame and color: ImageJ by `channels=`, OME by an XML element. An ImageJ
//! stack may have one directory only, and its other frames after the first one's samples.

use std::io::Cursor;

use tiff::ColorType;
use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::tags::{ByteOrder, SampleFormat, Tag};

use super::ReadError;
use super::samples::{Array, Budget, Endian, SampleType, Samples};

const FORMAT: &str = "TIFF";
const UNCOMPRESSED: u16 = 1;
const PLANES_APART: u16 = 2;

/// Whether the bytes open like a TIFF or BigTIFF of either byte order.
pub fn is_tiff(bytes: &[u8]) -> bool {
    [b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"].iter().any(|magic| bytes.starts_with(*magic))
}

fn bad(reason: impl std::fmt::Display) -> ReadError {
    ReadError::Malformed { format: FORMAT, reason: reason.to_string() }
}

type Pages<'a> = Decoder<Cursor<&'a [u8]>>;

/// What the first page says of all.
struct Plan {
    width: usize,
    height: usize,
    /// Colors of a page: 1 or 3.
    colors: usize,
    /// Samples of a pixel in the file: with transparency, more than its colors.
    stored: usize,
    bits: u8,
    description: String,
}

impl Plan {
    fn of(pages: &mut Pages<'_>) -> Result<Self, ReadError> {
        let (width, height) = pages.dimensions().map_err(bad)?;
        let (stored, colors, bits) = match pages.colortype().map_err(bad)? {
            ColorType::Gray(bits) => (1, 1, bits),
            // Gray with transparency.
            ColorType::GrayA(bits) | ColorType::Multiband { bit_depth: bits, num_samples: 2 } => (2, 1, bits),
            ColorType::RGB(bits) => (3, 3, bits),
            ColorType::RGBA(bits) => (4, 3, bits),
            other => return Err(bad(format!("pixels of {other:?}; expected gray or RGB"))),
        };
        if bits < 8 && stored > 1 {
            return Err(bad(format!("color of {bits} bits, expected 8, 16 or 32")));
        }
        // A description that is no text says nothing.
        let description = pages.get_tag_ascii_string(Tag::ImageDescription).unwrap_or_default();
        Ok(Self { width: width as usize, height: height as usize, colors, stored, bits, description })
    }

    fn pixels(&self) -> usize {
        self.width.saturating_mul(self.height)
    }

    /// What ImageJ's description says about `key`.
    fn imagej(&self, key: &str) -> Option<&str> {
        let lines = self.description.strip_prefix("ImageJ=")?.lines();
        lines.filter_map(|line| line.split_once('=')).find(|(k, _)| *k == key).map(|(_, value)| value.trim())
    }

    fn imagej_count(&self, key: &str) -> usize {
        self.imagej(key).and_then(|n| n.parse().ok()).unwrap_or(1)
    }
}

/// Reads all pages as `[T, C, H, W]`, C = 1 or 3; transparency is dropped.
///
/// # Errors
/// [`ReadError`] for damaged bytes, pages that differ, colors and compressions that are not supported, or more than the budget.
pub fn read(bytes: &[u8]) -> Result<Array, ReadError> {
    let mut budget = Budget::for_file(bytes.len());
    let mut pages = open(bytes, &budget)?;
    let plan = Plan::of(&mut pages)?;
    let images = plan.imagej_count("images");
    if images > 1 && !pages.more_images() {
        return contiguous(bytes, &mut pages, &plan, images, &mut budget);
    }
    let mut count = 1;
    while pages.more_images() {
        pages.next_image().map_err(bad)?;
        count += 1;
    }
    // One page is there as decoded, all of them as converted, and one of these once more on its way.
    let page = plan.pixels().saturating_mul(plan.stored);
    let converted = plan.pixels().saturating_mul(plan.colors);
    budget.claim(page, usize::from(plan.bits).div_ceil(8))?;
    budget.claim(converted.saturating_mul(count + usize::from(count > 1)), if plan.bits > 8 { 4 } else { 1 })?;
    let mut pages = open(bytes, &budget)?;
    let mut video: Option<(Samples, SampleType)> = None;
    for index in 0..count {
        if index > 0 {
            pages.next_image().map_err(bad)?;
        }
        let (samples, kind) = read_page(&mut pages, &plan).map_err(|e| in_page(index, e))?;
        match &mut video {
            None => {
                let mut all = samples;
                all.reserve_exact((count - 1) * all.len());
                video = Some((all, kind));
            }
            Some((all, first)) if *first == kind => all.append(samples),
            Some((_, first)) => return Err(bad(format!("page {index} holds {kind:?}, but the first {first:?}"))),
        }
    }
    let (samples, kind) = video.ok_or_else(|| bad("no pages"))?;
    arrange(samples, kind, &plan, count, &mut budget)
}

/// Refuses a first directory with values that cannot be in the file. The decoder makes room for them before its limits can be set.
fn check_first_directory(bytes: &[u8]) -> Result<(), ReadError> {
    let is_big = bytes.get(2..4).is_some_and(|version| version.contains(&43));
    let number = |at: usize, size: usize| -> Option<usize> {
        let mut digits = bytes.get(at..at.checked_add(size)?)?.to_vec();
        if bytes.starts_with(b"II") {
            digits.reverse();
        }
        digits.iter().try_fold(0usize, |n, &d| n.checked_mul(256)?.checked_add(d.into()))
    };
    let (pointer, counter, word, entry) = if is_big { (8, 8, 8, 20) } else { (4, 2, 4, 12) };
    let cut_short = || bad("cut short inside its first directory");
    let start = number(pointer, word).ok_or_else(cut_short)?;
    let entries = number(start, counter).ok_or_else(cut_short)?;
    for index in 0..entries {
        let at =
            index.checked_mul(entry).and_then(|n| n.checked_add(start)?.checked_add(counter)).ok_or_else(cut_short)?;
        let (tag, kind) = (number(at, 2).ok_or_else(cut_short)?, number(at + 2, 2).ok_or_else(cut_short)?);
        let count = number(at + 4, word).ok_or_else(cut_short)?;
        // Bytes and text are kept as they are, numbers take many times their size.
        let most = if matches!(kind, 1 | 2 | 6 | 7) { bytes.len() } else { bytes.len().min(MAX_VALUES) };
        if count > most {
            return Err(bad(format!("tag {tag} claims {count} values, more than the {most} that are possible")));
        }
    }
    Ok(())
}

/// Values of one tag: a picture has not as many strips.
const MAX_VALUES: usize = 1 << 20;

fn open<'a>(bytes: &'a [u8], budget: &Budget) -> Result<Pages<'a>, ReadError> {
    check_first_directory(bytes)?;
    let mut limits = Limits::default();
    limits.decoding_buffer_size = budget.left();
    limits.intermediate_buffer_size = budget.left();
    Ok(Decoder::new(Cursor::new(bytes)).map_err(bad)?.with_limits(limits))
}

fn in_page(index: usize, error: ReadError) -> ReadError {
    match error {
        ReadError::Malformed { reason, .. } => bad(format!("page {index}: {reason}")),
        other => other,
    }
}

/// One page's colors as planes.
fn read_page(pages: &mut Pages<'_>, plan: &Plan) -> Result<(Samples, SampleType), ReadError> {
    let own = Plan::of(pages)?;
    if (own.width, own.height, own.stored, own.bits) != (plan.width, plan.height, plan.stored, plan.bits) {
        return Err(bad(format!(
            "{}×{} pixels of {} samples of {} bits, but the first page has {}×{} of {} of {}",
            own.width, own.height, own.stored, own.bits, plan.width, plan.height, plan.stored, plan.bits
        )));
    }
    let apart = pages.find_tag_unsigned::<u16>(Tag::PlanarConfiguration).map_err(bad)? == Some(PLANES_APART);
    let mut decoded = DecodingResult::U8(Vec::new());
    pages.read_image_to_buffer(&mut decoded).map_err(bad)?;
    macro_rules! planes {
        ($samples:expr, $kind:ident, $convert:expr) => {{
            let planes = planes(&$samples, plan, apart)?;
            let mut converted = Vec::with_capacity(plan.pixels() * plan.colors);
            converted.extend(planes.map($convert));
            (Samples::Floats(converted), SampleType::$kind)
        }};
    }
    Ok(match decoded {
        DecodingResult::U8(v) if plan.bits < 8 => (Samples::Bytes(unpacked(&v, plan)?), SampleType::U8),
        DecodingResult::U8(v) => {
            let mut bytes = Vec::with_capacity(plan.pixels() * plan.colors);
            bytes.extend(planes(&v, plan, apart)?);
            (Samples::Bytes(bytes), SampleType::U8)
        }
        DecodingResult::U16(v) => planes!(v, U16, f32::from),
        DecodingResult::U32(v) => planes!(v, U32, |x| x as f32),
        DecodingResult::U64(v) => planes!(v, U64, |x| x as f32),
        DecodingResult::I8(v) => planes!(v, I8, f32::from),
        DecodingResult::I16(v) => planes!(v, I16, f32::from),
        DecodingResult::I32(v) => planes!(v, I32, |x| x as f32),
        DecodingResult::I64(v) => planes!(v, I64, |x| x as f32),
        DecodingResult::F16(v) => planes!(v, F16, half::f16::to_f32),
        DecodingResult::F32(v) => planes!(v, F32, |x| x),
        DecodingResult::F64(v) => planes!(v, F64, |x| x as f32),
    })
}

/// The samples of a page in the order of color, row, column.
fn planes<'a, T: Copy>(
    samples: &'a [T],
    plan: &Plan,
    apart: bool,
) -> Result<impl Iterator<Item = T> + use<'a, T>, ReadError> {
    let (pixels, colors) = (plan.pixels(), plan.colors);
    if Some(samples.len()) != pixels.checked_mul(plan.stored) {
        return Err(bad(format!("{} samples for {pixels} pixels of {} samples", samples.len(), plan.stored)));
    }
    let (between_colors, between_pixels) = if apart { (pixels, 1) } else { (1, plan.stored) };
    Ok((0..colors).flat_map(move |c| (0..pixels).map(move |i| samples[c * between_colors + i * between_pixels])))
}

/// Samples of less than a byte; rows begin with a byte of their own.
fn unpacked(packed: &[u8], plan: &Plan) -> Result<Vec<u8>, ReadError> {
    let bits = usize::from(plan.bits);
    let row = (plan.width * bits).div_ceil(8);
    if packed.len() != row * plan.height || 8 % bits != 0 {
        return Err(bad(format!("{} bytes for rows of {} samples of {bits} bits", packed.len(), plan.width)));
    }
    let each = |row: &[u8], x: usize| (row[x * bits / 8] >> (8 - bits - x * bits % 8)) & (0xff >> (8 - bits));
    let mut samples = Vec::with_capacity(plan.pixels());
    packed.chunks_exact(row).for_each(|row| samples.extend((0..plan.width).map(|x| each(row, x))));
    Ok(samples)
}

/// The frames of an ImageJ stack that has a directory for the first only.
fn contiguous(
    bytes: &[u8],
    pages: &mut Pages<'_>,
    plan: &Plan,
    images: usize,
    budget: &mut Budget,
) -> Result<Array, ReadError> {
    let compression = pages.find_tag_unsigned::<u16>(Tag::Compression).map_err(bad)?.unwrap_or(UNCOMPRESSED);
    if compression != UNCOMPRESSED || plan.stored != 1 {
        return Err(bad(format!("a stack of {images} images with one directory must be gray and uncompressed")));
    }
    let format = pages.find_tag_unsigned::<u16>(Tag::SampleFormat).map_err(bad)?;
    let float = format == Some(SampleFormat::IEEEFP.to_u16());
    let kind = match (plan.bits, float) {
        (8, false) => SampleType::U8,
        (16, false) => SampleType::U16,
        (32, true) => SampleType::F32,
        _ => {
            return Err(bad(format!(
                "a stack with one directory and samples of {} bits, expected 8, 16 or 32 (float)",
                plan.bits
            )));
        }
    };
    let starts = pages.find_tag_unsigned_vec::<u64>(Tag::StripOffsets).map_err(bad)?.unwrap_or_default();
    let start = starts.iter().min().and_then(|&at| usize::try_from(at).ok()).unwrap_or(usize::MAX);
    let count = images.saturating_mul(plan.pixels());
    let end = count.checked_mul(kind.size()).and_then(|n| n.checked_add(start));
    let raw = end.and_then(|end| bytes.get(start..end)).ok_or_else(|| {
        bad(format!("cut short: {images} images of {}×{} pixels are more than the file holds", plan.width, plan.height))
    })?;
    budget.claim(count, kind.decoded_size())?;
    let endian = if pages.byte_order() == ByteOrder::BigEndian { Endian::Big } else { Endian::Little };
    arrange(Samples::decode(raw.to_vec(), kind, endian), kind, plan, images, budget)
}

/// Pages in the order of the file as `[T, C, H, W]`.
fn arrange(
    samples: Samples,
    kind: SampleType,
    plan: &Plan,
    count: usize,
    budget: &mut Budget,
) -> Result<Array, ReadError> {
    let (h, w) = (plan.height, plan.width);
    let order = if plan.colors == 1 { order_of_pages(plan, count)? } else { None };
    let array = match order {
        None => Array::new(vec![count, plan.colors, h, w], samples, kind)?,
        Some(pages) => {
            // They are there twice while they change places.
            budget.claim(samples.len(), kind.decoded_size())?;
            Array::new(vec![count / 3, 3, h, w], samples.in_order(&pages, h * w), kind)?
        }
    };
    let white = match plan.imagej("max").and_then(|max| max.parse::<f32>().ok()) {
        // The brightest level that is shown; of the full scale of some number of bits it tells that.
        Some(max) if kind == SampleType::U16 && (8..=16).any(|bits| max == ((1u32 << bits) - 1) as f32) => Some(max),
        _ if plan.bits < 8 => Some(((1u32 << plan.bits) - 1) as f32),
        _ => None,
    };
    Ok(match white {
        Some(white) => array.with_white(white),
        None => array,
    })
}

/// Where the planes of color frames are, frame by frame; `None` if every page is a frame.
fn order_of_pages(plan: &Plan, count: usize) -> Result<Option<Vec<usize>>, ReadError> {
    let (sizes, order) = match plan.description.find("<OME").map(|at| &plan.description[at..]) {
        Some(xml) => {
            let size = |name: &str| attribute(xml, name).and_then(|n| n.parse().ok()).unwrap_or(1);
            let order = attribute(xml, "DimensionOrder").unwrap_or("XYZCT");
            ([size("SizeC"), size("SizeZ"), size("SizeT")], order.trim_start_matches("XY").to_owned())
        }
        None => (["channels", "slices", "frames"].map(|key| plan.imagej_count(key)), "CZT".to_owned()),
    };
    let [channels, slices, frames] = sizes;
    // A description may leave out some of the numbers, and one axis alone is time, whatever it is called.
    if channels == 1 || channels == count {
        return if channels == 3 { Ok(Some(vec![0, 1, 2])) } else { Ok(None) };
    }
    let stated = slices.checked_mul(frames).and_then(|n| n.checked_mul(channels));
    if channels != 3 || stated != Some(count) {
        return Err(bad(format!(
            "{count} pages for {channels} channels, {slices} slices and {frames} frames; expected 1 channel or 3"
        )));
    }
    let mut pages = vec![0; count];
    for page in 0..count {
        let (mut rest, mut at) = (page, [0; 3]);
        for axis in order.chars() {
            let axis = "CZT".find(axis).ok_or_else(|| bad(format!("pages in the order {order:?}")))?;
            at[axis] = rest % sizes[axis];
            rest /= sizes[axis];
        }
        let [channel, slice, frame] = at;
        let frame = frame * slices + slice;
        pages[3 * frame + channel] = page;
    }
    Ok(Some(pages))
}

/// The value of an attribute in XML.
fn attribute<'a>(xml: &'a str, name: &str) -> Option<&'a str> {
    xml.split_once(&format!(" {name}=\""))?.1.split_once('"').map(|(value, _)| value)
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiff::encoder::colortype::{Gray8, Gray16, Gray32Float, RGB8};
    use tiff::encoder::{Compression, TiffEncoder};

    /// A stack of pages of 5 × 4 pixels, the description on the first.
    fn stack<C: tiff::encoder::colortype::ColorType>(
        compression: Compression,
        description: &str,
        pages: &[Vec<C::Inner>],
    ) -> Vec<u8>
    where
        [C::Inner]: tiff::encoder::TiffValue,
    {
        let mut bytes = Cursor::new(Vec::new());
        let mut encoder = TiffEncoder::new(&mut bytes).unwrap().with_compression(compression);
        for (i, page) in pages.iter().enumerate() {
            let mut image = encoder.new_image::<C>(5, 4).unwrap();
            if i == 0 && !description.is_empty() {
                image.encoder().write_tag(Tag::ImageDescription, description).unwrap();
            }
            image.write_data(page).unwrap();
        }
        bytes.into_inner()
    }

    fn levels(page: usize) -> impl Iterator<Item = usize> {
        (0..20).map(move |i| 100 * page + i)
    }

    fn values(array: &Array) -> Vec<f32> {
        (0..array.samples().len()).map(|i| array.samples().at(i)).collect()
    }

    #[test]
    fn single_pages_and_stacks_of_every_depth_and_compression() {
        let compressions = [
            Compression::Uncompressed,
            Compression::Lzw,
            Compression::Deflate(Default::default()),
            Compression::Packbits,
        ];
        for compression in compressions {
            for pages in [1, 3] {
                let expected: Vec<f32> = (0..pages).flat_map(levels).map(|v| v as f32).collect();
                let eight: Vec<_> = (0..pages).map(|p| levels(p).map(|v| v as u8).collect()).collect();
                let eight = read(&stack::<Gray8>(compression, "", &eight)).unwrap();
                assert_eq!((eight.shape(), eight.stored()), (&[pages, 1, 4, 5][..], SampleType::U8));
                assert_eq!(values(&eight), expected.iter().map(|v| v % 256.0).collect::<Vec<_>>());
                let sixteen: Vec<_> = (0..pages).map(|p| levels(p).map(|v| v as u16).collect()).collect();
                let sixteen = read(&stack::<Gray16>(compression, "", &sixteen)).unwrap();
                assert_eq!((values(&sixteen), sixteen.stored()), (expected.clone(), SampleType::U16));
                let float: Vec<_> = (0..pages).map(|p| levels(p).map(|v| v as f32).collect()).collect();
                let float = read(&stack::<Gray32Float>(compression, "", &float)).unwrap();
                assert_eq!((values(&float), float.stored()), (expected, SampleType::F32));
            }
        }
    }

    #[test]
    fn color_pages_become_planes() {
        let page: Vec<u8> = (0..20).flat_map(|i| [i, 100 + i, 200 + i]).collect();
        let color = read(&stack::<RGB8>(Compression::Uncompressed, "", &[page.clone(), page])).unwrap();
        assert_eq!(color.shape(), [2, 3, 4, 5]);
        assert_eq!([0, 20, 40, 61].map(|i| color.samples().at(i)), [0.0, 100.0, 200.0, 1.0]);
    }

    #[test]
    fn descriptions_tell_frames_from_colors() {
        let pages: Vec<Vec<u8>> = (0..6).map(|p| vec![p; 20]).collect();
        let firsts = |description: &str| {
            let found = read(&stack::<Gray8>(Compression::Uncompressed, description, &pages)).unwrap();
            (found.shape()[0], (0..6).map(|p| found.samples().at(20 * p) as u8).collect::<Vec<_>>())
        };
        assert_eq!(firsts(""), (6, vec![0, 1, 2, 3, 4, 5]));
        assert_eq!(firsts("ImageJ=1.54f\nimages=6\nslices=6\n"), (6, vec![0, 1, 2, 3, 4, 5]));
        assert_eq!(firsts("ImageJ=1.54f\nimages=6\nchannels=3\nframes=2\n"), (2, vec![0, 1, 2, 3, 4, 5]));
        let ome = |order: &str| {
            format!("<OME><Pixels DimensionOrder=\"{order}\" SizeC=\"3\" SizeT=\"2\" SizeZ=\"1\"/></OME>")
        };
        assert_eq!(firsts(&ome("XYCZT")), (2, vec![0, 1, 2, 3, 4, 5]));
        assert_eq!(firsts(&ome("XYZTC")), (2, vec![0, 2, 4, 1, 3, 5]));
        let odd = stack::<Gray8>(Compression::Uncompressed, "ImageJ=1\nimages=6\nchannels=2\nframes=3\n", &pages);
        assert!(read(&odd).unwrap_err().to_string().contains("2 channels"));
    }

    /// As ImageJ writes it: big-endian, one directory, all samples after each other.
    fn hyperstack(images: usize, there: usize) -> Vec<u8> {
        let description = format!("ImageJ=1.54f\nimages={images}\nframes={images}\nhyperstack=true\nmax=4095.0\n\0");
        let data = 8 + 2 + 8 * 12 + 4 + description.len() as u32;
        let short = |tag: u16, value: u16| {
            [&tag.to_be_bytes()[..], &[0, 3, 0, 0, 0, 1], &value.to_be_bytes(), &[0, 0]].concat()
        };
        let long = |tag: u16, kind: u8, count: u32, value: u32| {
            [&tag.to_be_bytes()[..], &[0, kind], &count.to_be_bytes(), &value.to_be_bytes()].concat()
        };
        let entries = [
            short(256, 5),
            short(257, 4),
            short(258, 16),
            short(262, 1),
            long(270, 2, description.len() as u32, 8 + 2 + 8 * 12 + 4),
            long(273, 4, 1, data),
            short(278, 4),
            long(279, 4, 1, 40),
        ];
        let mut bytes = b"MM\0*\0\0\0\x08\0\x08".to_vec();
        bytes.extend(entries.concat());
        bytes.extend([0; 4]);
        bytes.extend(description.bytes());
        bytes.extend((0..there).flat_map(levels).flat_map(|v| (v as u16).to_be_bytes()));
        bytes
    }

    #[test]
    fn a_hyperstack_with_one_directory_is_read_whole() {
        let found = read(&hyperstack(3, 3)).unwrap();
        assert_eq!((found.shape(), found.white()), (&[3, 1, 4, 5][..], Some(4095.0)));
        assert_eq!(values(&found), (0..3).flat_map(levels).map(|v| v as f32).collect::<Vec<_>>());
        let error = read(&hyperstack(3, 2)).unwrap_err().to_string();
        assert!(error.contains("cut short: 3 images"), "{error}");
    }

    #[test]
    fn values_that_cannot_be_there_are_refused_before_there_is_room_for_them() {
        let mut bytes = hyperstack(2, 2);
        // The count of the description's characters: the fifth entry.
        bytes[10 + 4 * 12 + 4..][..4].copy_from_slice(&[0x0f, 0xf0, 0, 0]);
        let error = read(&bytes).unwrap_err().to_string();
        assert!(error.contains("tag 270 claims 267386880 values"), "{error}");
    }

    #[test]
    fn damaged_bytes_never_panic() {
        let page: Vec<u16> = levels(1).map(|v| v as u16).collect();
        for bytes in [stack::<Gray16>(Compression::Lzw, "", &[page.clone(), page]), hyperstack(2, 2)] {
            for at in 0..bytes.len() {
                let _ = read(&bytes[..at]);
                for value in [0, 1, 0x7f, 0x80, 0xff] {
                    let mut damaged = bytes.clone();
                    damaged[at] = value;
                    let _ = read(&damaged);
                }
            }
        }
    }

    #[test]
    fn samples_of_one_bit_are_black_and_white() {
        let plan = Plan { width: 5, height: 2, colors: 1, stored: 1, bits: 1, description: String::new() };
        assert_eq!(unpacked(&[0b1010_0000, 0b0100_1000], &plan).unwrap(), [1, 0, 1, 0, 0, 0, 1, 0, 0, 1]);
        assert!(unpacked(&[0], &plan).is_err());
    }
}
