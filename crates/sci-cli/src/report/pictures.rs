//! Owns what the report shows of a measurement, within the bytes that it may take: smaller frames first, then fewer.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::ImageError;
use ndarray::{Array4, ArrayView2, ArrayView3, ArrayView4, Axis, s};
use rayon::prelude::*;
use sci_forward::CfaPattern;
use serde::Serialize;

use crate::io::frames::{self, longer_side, pngs};
use crate::solve::psnr_rgb;

/// Frames are not made smaller than this, in pixels of the longer side, but left out.
const SMALLEST: usize = 400;

/// What one measurement looks like; frames are in `[0, 1]`, C is 1 (gray or mosaic) or 3 (RGB).
#[derive(Clone, Copy, Debug)]
pub struct MeasurementImages<'a> {
    /// y `[H, W]`, if it is at hand, shown scaled to its largest value.
    pub measurement: Option<ArrayView2<'a, f32>>,
    /// The result `[T, C, H, W]`.
    pub recon: ArrayView4<'a, f32>,
    /// The sensor's pattern: of an RGB result the page also shows the mosaic that the sensor sees of it.
    pub cfa: Option<CfaPattern>,
    /// The truth `[T, C, H, W]`, if known.
    pub truth: Option<ArrayView4<'a, f32>>,
}

/// The pictures of a measurement as the page's script reads them.
#[derive(Debug, Serialize)]
pub struct Pictures {
    measurement: Option<String>,
    recon: Vec<String>,
    /// Row and column of the red site, if the result is RGB and in full size.
    red_site: Option<(usize, usize)>,
    truth: Option<Vec<String>>,
    /// Of the frames that are shown, in full size.
    psnr_db: Vec<Option<f64>>,
    /// All frames that there are.
    frames: usize,
    /// Every `step`th is shown, the first first.
    step: usize,
    /// One pixel shown is of so many squared.
    shrink: usize,
}

impl Pictures {
    /// Of a measurement, in at most `limit` bytes; `full` are the result's frames as PNGs if they are at hand.
    ///
    /// # Errors
    /// The PNG encoder's.
    ///
    /// # Panics
    /// If a truth has another size than its result.
    pub fn of(images: &MeasurementImages<'_>, full: Option<Vec<Vec<u8>>>, limit: usize) -> Result<Self, ImageError> {
        let shrink = shrink(images, full.as_deref(), limit)?;
        let encode = |video: ArrayView4<'_, f32>| pngs(video, longer_side(video) / shrink);
        let recon = match full {
            Some(full) if shrink == 1 => full,
            _ => encode(images.recon)?,
        };
        let truth = images.truth.map(encode).transpose()?;
        let measurement = images.measurement.map(|y| encode(to_its_largest(y).view())).transpose()?;
        let taken = measurement.iter().flatten().map(|png| uri_len(png)).sum::<usize>();
        let of_frame: Vec<usize> = (0..recon.len())
            .map(|t| uri_len(&recon[t]) + truth.as_ref().map_or(0, |truth| uri_len(&truth[t])))
            .collect();
        let step = step(&of_frame, limit.saturating_sub(taken));
        let shown = |pngs: Vec<Vec<u8>>| pngs.iter().step_by(step).map(|png| uri(png)).collect::<Vec<_>>();
        let psnr_db = images.truth.map_or_else(Vec::new, |truth| {
            let shown: Vec<_> = truth.outer_iter().zip(images.recon.outer_iter()).step_by(step).collect();
            shown.into_par_iter().map(|(truth, frame)| psnr(truth, frame)).collect()
        });
        let fits = step <= of_frame.len();
        Ok(Self {
            measurement: measurement.filter(|_| fits).and_then(|pngs| pngs.first().map(|png| uri(png))),
            recon: if fits { shown(recon) } else { Vec::new() },
            red_site: images.cfa.filter(|_| images.recon.dim().1 == 3 && shrink == 1).map(CfaPattern::red_site),
            truth: truth.filter(|_| fits).map(shown),
            psnr_db: if fits { psnr_db } else { Vec::new() },
            frames: of_frame.len(),
            step,
            shrink,
        })
    }
}

impl Pictures {
    /// Pictures that are `factor` times smaller than what they are of, whose frames have these PSNRs.
    #[must_use]
    pub fn of_larger(self, factor: usize, psnr_db: &[Option<f64>]) -> Self {
        let shown =
            if self.psnr_db.is_empty() { Vec::new() } else { psnr_db.iter().step_by(self.step).copied().collect() };
        Self { shrink: self.shrink * factor, psnr_db: shown, ..self }
    }
}

/// How much smaller the frames have to be for all to fit, by the size of the first; not so small that nothing is seen.
fn shrink(images: &MeasurementImages<'_>, full: Option<&[Vec<u8>]>, limit: usize) -> Result<usize, ImageError> {
    let (frames, side) = (images.recon.len_of(Axis(0)), longer_side(images.recon));
    let videos = if images.truth.is_some() { 2 } else { 1 };
    let mut frame = images.recon.slice(s![..1, .., .., ..]).to_owned();
    let encoded = |frame: &Array4<f32>| Ok::<_, ImageError>(uri_len(&frames::png(frame.index_axis(Axis(0), 0))?));
    let mut size = match full.and_then(<[_]>::first) {
        Some(png) => uri_len(png),
        None => encoded(&frame)?,
    };
    let mut shrink = 1;
    while size * frames * videos > limit && side / (2 * shrink) >= SMALLEST {
        frame = frames::halved(frame.view());
        size = encoded(&frame)?;
        shrink *= 2;
    }
    Ok(shrink)
}

/// The least step with which the frames of these sizes fit; more than there are frames if not even one does.
fn step(sizes: &[usize], limit: usize) -> usize {
    let fits = |step: usize| sizes.iter().step_by(step).sum::<usize>() <= limit;
    (1..=sizes.len()).find(|&step| fits(step)).unwrap_or(sizes.len() + 1)
}

fn to_its_largest(y: ArrayView2<'_, f32>) -> Array4<f32> {
    let brightest = y.iter().fold(0.0f32, |a, &b| a.max(b));
    let scale = if brightest > 0.0 { 1.0 / brightest } else { 1.0 };
    y.mapv(|v| v * scale).insert_axis(Axis(0)).insert_axis(Axis(0))
}

/// PSNR over all channels of a frame `[C, H, W]`; `None` (so that JSON has a form for it) where it is infinite.
pub(crate) fn psnr(truth: ArrayView3<'_, f32>, frame: ArrayView3<'_, f32>) -> Option<f64> {
    let one = |frame| ArrayView3::insert_axis(frame, Axis(0));
    Some(psnr_rgb(one(truth), one(frame))).filter(|p| p.is_finite())
}

const SCHEME: &str = "data:image/png;base64,";

fn uri(png: &[u8]) -> String {
    let mut uri = SCHEME.to_owned();
    STANDARD.encode_string(png, &mut uri);
    uri
}

fn uri_len(png: &[u8]) -> usize {
    SCHEME.len() + png.len().div_ceil(3) * 4
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(frames: usize, side: usize) -> Array4<f32> {
        let mut state = 1u32;
        Array4::from_shape_simple_fn((frames, 1, side, side), || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        })
    }

    fn pictures(video: &Array4<f32>, limit: usize) -> Pictures {
        let view = video.view();
        let y = view.index_axis(Axis(0), 0).index_axis_move(Axis(0), 0);
        let images = MeasurementImages { measurement: Some(y), recon: view, cfa: None, truth: Some(view) };
        Pictures::of(&images, None, limit).unwrap()
    }

    #[test]
    fn what_does_not_fit_is_made_smaller_then_left_out_and_said() {
        let video = noise(6, 800);
        let whole = pictures(&video, usize::MAX);
        assert_eq!((whole.step, whole.shrink, whole.recon.len(), whole.frames), (1, 1, 6, 6));
        let size = |p: &Pictures| serde_json::to_vec(p).unwrap().len();
        let half = pictures(&video, size(&whole) / 3);
        assert_eq!((half.step, half.shrink, half.recon.len()), (1, 2, 6));
        let fewer = pictures(&video, size(&whole) / 9);
        assert_eq!((fewer.step, fewer.shrink, fewer.recon.len(), fewer.psnr_db.len()), (3, 2, 2, 2));
        for (pictures, part) in [(&half, 3), (&fewer, 9)] {
            assert!(size(pictures) <= size(&whole) / part + 300);
        }
        let none = pictures(&video, 100);
        assert!(none.recon.is_empty() && none.measurement.is_none() && none.frames == 6);
    }
}
