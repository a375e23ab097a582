//! Owns `report.html`: a run as one page that needs no other file, to be looked at, kept and sent around.
//!
//! The page is a template, a style sheet and a script of this folder with the record and the pictures put in as JSON;
//! the script draws everything, so that there is one place that knows the layout. Pictures are PNG data URIs. The
//! error picture and the mosaic are not stored: the script computes them from result and truth. Pictures take no more bytes than
//! the experiment allows; the page says which are smaller or left out.

pub mod pictures;

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::io::output::{WriteError, write_atomically};
use crate::record::Record;

const TEMPLATE: &str = include_str!("report/template.html");
const STYLE: &str = include_str!("report/style.css");
const SCRIPT: &str = include_str!("report/script.js");

/// What the script reads of a page that compares runs; on that of one run, `images` has an entry for each measurement.
#[derive(Serialize)]
struct Data<'a> {
    runs: &'a [Record],
    images: Option<()>,
}

/// Writes the page of one run; `pieces` are files of [`pictures::Pictures`] as JSON, for each of `record.measurements` one, in the same
/// order. They are copied, not read into memory.
///
/// # Errors
/// The file system's, naming the page.
pub fn write(path: &Path, record: &Record, pieces: &[PathBuf]) -> Result<(), WriteError> {
    let record = serde_json::to_string(record).map_err(|e| WriteError::new(path, e))?;
    write_page(path, |w| {
        write!(w, "{{\"runs\":[{}],\"images\":[", for_html(&record))?;
        for (i, piece) in pieces.iter().enumerate() {
            w.write_all(if i == 0 { b"" } else { b"," })?;
            io::copy(&mut File::open(piece)?, w)?;
        }
        w.write_all(b"]}")
    })
}

/// Writes a page that compares runs: a table and their convergence curves in one chart.
///
/// # Errors
/// The file system's, naming the page.
pub fn write_comparison(path: &Path, records: &[Record]) -> Result<(), WriteError> {
    let data = Data { runs: records, images: None };
    let json = serde_json::to_string(&data).map_err(|e| WriteError::new(path, e))?;
    write_page(path, |w| w.write_all(for_html(&json).as_bytes()))
}

/// Inside a script element only `<` could end it; in JSON it occurs in strings alone, where it may be escaped.
fn for_html(json: &str) -> String {
    json.replace('<', "\\u003c")
}

fn write_page(path: &Path, data: impl FnOnce(&mut BufWriter<&File>) -> io::Result<()>) -> Result<(), WriteError> {
    let [head, after_style, after_data, tail] = cut(TEMPLATE, ["{{style}}", "{{data}}", "{{script}}"]);
    write_atomically(path, |w| {
        w.write_all([head, STYLE, after_style].concat().as_bytes())?;
        data(w)?;
        w.write_all([after_data, SCRIPT, tail].concat().as_bytes())
    })
}

/// The template without the marks, which occur once each and in this order.
fn cut<'t>(template: &'t str, marks: [&str; 3]) -> [&'t str; 4] {
    let mut rest = template;
    let parts = marks.map(|mark| {
        let (before, after) = rest.split_once(mark).expect("the template is part of this crate and has every mark");
        rest = after;
        before
    });
    [parts[0], parts[1], parts[2], rest]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_asks_for_nothing_and_forbids_the_rest() {
        let parts = cut(TEMPLATE, ["{{style}}", "{{data}}", "{{script}}"]);
        let page = parts.concat();
        assert!(!page.contains("{{"), "{page}");
        assert!(page.contains("Content-Security-Policy") && page.contains("default-src 'none'"), "{page}");
        // The name of a kind of drawing, which is looked up nowhere.
        let script = SCRIPT.replace("http://www.w3.org/2000/svg", "");
        assert!([&page, &script, STYLE].iter().all(|part| !part.contains("http:") && !part.contains("https:")));
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
