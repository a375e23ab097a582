//! Owns `report.html`: a run as one page that needs no other file, to be looked at, kept and sent around.
//!
//! The page is a template, a style sheet and a script of this folder with the record and the pictures put in as JSON;
//! the script draws everything, so that there is one place that knows the layout. Pictures are PNG data URIs. The
//! error picture and the mosaic are not stored: the script computes them from result and truth.

use std::io::Write;
use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder, ImageError};
use ndarray::{ArrayView2, ArrayView3, ArrayView4, Axis, Zip};
use sci_forward::CfaPattern;
use serde::Serialize;

use crate::io::frames::to_byte;
use crate::io::output::{WriteError, write_atomically};
use crate::record::Record;

const TEMPLATE: &str = include_str!("report/template.html");
const STYLE: &str = include_str!("report/style.css");
const SCRIPT: &str = include_str!("report/script.js");

/// What one measurement looks like; frames are in `[0, 1]`, C is 1 (gray or mosaic) or 3 (RGB).
#[derive(Clone, Copy, Debug)]
pub struct MeasurementImages<'a> {
    /// y `[H, W]`, shown scaled to its largest value.
    pub measurement: ArrayView2<'a, f32>,
    /// The result `[T, C, H, W]`.
    pub recon: ArrayView4<'a, f32>,
    /// The sensor's pattern: of an RGB result the page also shows the mosaic that the sensor sees of it.
    pub cfa: Option<CfaPattern>,
    /// The truth `[T, C, H, W]`, if known.
    pub truth: Option<ArrayView4<'a, f32>>,
}

/// What the script reads.
#[derive(Serialize)]
struct Data<'a> {
    runs: &'a [&'a Record],
    /// One entry for each measurement of the only run; `None` on a page that compares runs.
    images: Option<Vec<Pictures>>,
}

#[derive(Serialize)]
struct Pictures {
    measurement: String,
    recon: Vec<String>,
    /// Row and column of the red site, if the result is RGB.
    red_site: Option<(usize, usize)>,
    truth: Option<Vec<String>>,
    psnr_db: Vec<Option<f64>>,
}

/// Writes the page of one run; `images` are those of `record.measurements`, in the same order.
///
/// # Errors
/// The file system's or the PNG encoder's, naming the page.
///
/// # Panics
/// If a truth has another size than its result.
pub fn write(path: &Path, record: &Record, images: &[MeasurementImages<'_>]) -> Result<(), WriteError> {
    let pictures: Result<Vec<_>, _> = images.iter().map(Pictures::of).collect();
    let pictures = pictures.map_err(|e| WriteError::new(path, e))?;
    write_page(path, &Data { runs: &[record], images: Some(pictures) })
}

/// Writes a page that compares runs: a table and their convergence curves in one chart.
///
/// # Errors
/// The file system's, naming the page.
pub fn write_comparison(path: &Path, records: &[Record]) -> Result<(), WriteError> {
    let runs: Vec<&Record> = records.iter().collect();
    write_page(path, &Data { runs: &runs, images: None })
}

fn write_page(path: &Path, data: &Data<'_>) -> Result<(), WriteError> {
    let json = serde_json::to_string(data).map_err(|e| WriteError::new(path, e))?;
    // Inside a script element only `<` could end it; in JSON it occurs in strings alone, where it may be escaped.
    let page =
        fill(TEMPLATE, &[("{{style}}", STYLE), ("{{data}}", &json.replace('<', "\\u003c")), ("{{script}}", SCRIPT)]);
    write_atomically(path, |w| w.write_all(page.as_bytes()))
}

/// Replaces the marks, which occur once each and in this order; what is put in is not searched again.
fn fill(template: &str, parts: &[(&str, &str)]) -> String {
    let mut page = String::new();
    let mut rest = template;
    for (mark, part) in parts {
        let (before, after) = rest.split_once(mark).expect("the template is part of this crate and has every mark");
        page += before;
        page += part;
        rest = after;
    }
    page + rest
}

impl Pictures {
    fn of(images: &MeasurementImages<'_>) -> Result<Self, ImageError> {
        let brightest = images.measurement.iter().fold(0.0f32, |a, &b| a.max(b));
        let scale = if brightest > 0.0 { 1.0 / brightest } else { 1.0 };
        let measurement = images.measurement.mapv(|v| v * scale).insert_axis(Axis(0));
        let uris = |video: ArrayView4<'_, f32>| video.outer_iter().map(data_uri).collect::<Result<Vec<_>, _>>();
        let psnr_db = images.truth.map_or_else(Vec::new, |truth| {
            truth.outer_iter().zip(images.recon.outer_iter()).map(|(a, b)| psnr(a, b)).collect()
        });
        Ok(Self {
            measurement: data_uri(measurement.view())?,
            recon: uris(images.recon)?,
            red_site: images.cfa.filter(|_| images.recon.dim().1 == 3).map(CfaPattern::red_site),
            truth: images.truth.map(uris).transpose()?,
            psnr_db,
        })
    }
}

/// PSNR over all channels of a frame `[C, H, W]`; `None` (so that JSON has a form for it) where it is infinite.
fn psnr(truth: ArrayView3<'_, f32>, frame: ArrayView3<'_, f32>) -> Option<f64> {
    let sum = Zip::from(truth).and(frame).fold(0.0, |s, &a, &b| s + (f64::from(a) - f64::from(b)).powi(2));
    Some(-10.0 * (sum / truth.len() as f64).log10()).filter(|p| p.is_finite())
}

/// A frame `[C, H, W]` as an 8-bit PNG in a data URI.
fn data_uri(frame: ArrayView3<'_, f32>) -> Result<String, ImageError> {
    let (channels, height, width) = frame.dim();
    let pixels: Vec<u8> = frame.permuted_axes([1, 2, 0]).iter().map(|&v| to_byte(v)).collect();
    let color = if channels == 1 { ExtendedColorType::L8 } else { ExtendedColorType::Rgb8 };
    let mut png = Vec::new();
    PngEncoder::new_with_quality(&mut png, CompressionType::Best, FilterType::Adaptive).write_image(
        &pixels,
        width as u32,
        height as u32,
        color,
    )?;
    Ok(format!("data:image/png;base64,{}", STANDARD.encode(png)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_put_in_once_and_not_searched() {
        assert_eq!(fill("<{{a}}|{{b}}>", &[("{{a}}", "{{b}}"), ("{{b}}", "2")]), "<{{b}}|2>");
        let page = fill(TEMPLATE, &[("{{style}}", ""), ("{{data}}", ""), ("{{script}}", "")]);
        assert!(!page.contains("{{") && !page.contains("http"), "{page}");
    }

    #[test]
    fn a_name_cannot_leave_its_script_element() {
        let mut record: Record = serde_json::from_str(crate::record::tests::EXAMPLE).unwrap();
        record.experiment = "</script><b>".into();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("r.html");
        write(&path, &record, &[]).unwrap();
        let page = std::fs::read_to_string(&path).unwrap();
        assert!(page.contains("\\u003c/script>\\u003cb>"), "the name is there");
        assert_eq!(page.matches("</script>").count(), 2);
    }
}
