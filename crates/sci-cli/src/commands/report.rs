//! `sci report`: finished runs side by side, as a table and as a page.

use std::path::PathBuf;

use super::Done;
use crate::record::Record;
use crate::report;

/// Arguments of `sci report`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// Folders that `sci run` wrote
    #[arg(required = true, value_name = "DIR")]
    runs: Vec<PathBuf>,
    /// Also write a page with the table and the convergence curves
    #[arg(long, value_name = "FILE.html")]
    out: Option<PathBuf>,
}

impl Args {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        let records =
            self.runs.iter().map(|dir| Record::read(&dir.join("record.json"))).collect::<Result<Vec<_>, _>>()?;
        let number = |x: Option<f64>, digits: usize| x.map_or_else(|| "–".to_owned(), |x| format!("{x:.digits$}"));
        let width = records.iter().map(|r| r.experiment.chars().count()).max().unwrap_or(0).max(10);
        let scene = records.iter().map(|r| r.scene.chars().count()).max().unwrap_or(0).max(5);
        outln!("{:width$}  {:scene$}   PSNR dB     SSIM  seconds  iterations", "experiment", "scene");
        for r in &records {
            outln!(
                "{:width$}  {:scene$}  {:>8}  {:>7}  {:>7.2}  {:>10.1}",
                r.experiment,
                r.scene,
                number(r.mean.psnr_db, 2),
                number(r.mean.ssim, 4),
                r.mean.seconds,
                r.mean.iterations
            );
        }
        if let Some(page) = self.out {
            report::write_comparison(&page, &records)?;
            outln!("wrote {}", page.display());
        }
        Ok(Done::Complete)
    }
}
