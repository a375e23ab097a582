//! `sci metrics A B`: the numbers of the papers between two videos.

use std::path::{Path, PathBuf};

use ndarray::{Array3, Axis, s};
use sci_forward::metrics::{psnr, ssim, ssim_gaussian};

use super::Done;
use crate::io::scene::{self, Reading};

/// Arguments of `sci metrics`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// The result: .npy, .npz, .mat, .gif, .y4m or a folder of pictures; color is compared as gray
    a: PathBuf,
    /// The truth
    b: PathBuf,
    /// Print each frame
    #[arg(long)]
    frames: bool,
    /// Print one JSON object
    #[arg(long)]
    json: bool,
}

impl Args {
    pub(super) fn run(self) -> anyhow::Result<Done> {
        let reading = Reading { keys: scene::Keys { rgb: "recon".into(), ..Default::default() }, ..Default::default() };
        let gray = |path: &Path, reading: &Reading| -> anyhow::Result<Array3<f32>> {
            let video = scene::read_gray_video(path, reading)?;
            video.notes.iter().for_each(|note| eprintln!("warning: {}: {note}", path.display()));
            Ok(video.frames.index_axis_move(Axis(1), 0))
        };
        let a = gray(&self.a, &reading)?;
        let b = gray(&self.b, &Reading::default())?;
        let ((na, ha, wa), (nb, hb, wb)) = (a.dim(), b.dim());
        anyhow::ensure!(
            (ha, wa) == (hb, wb),
            "{} is {ha}×{wa}, but {} is {hb}×{wb} (rows × columns); they must be equal",
            self.a.display(),
            self.b.display()
        );
        let n = na.min(nb);
        if na != nb {
            eprintln!("warning: {na} and {nb} frames; the first {n} are compared");
        }
        let rows: Vec<[f64; 3]> = a
            .slice(s![..n, .., ..])
            .axis_iter(Axis(0))
            .zip(b.axis_iter(Axis(0)))
            .map(|(a, b)| [psnr(b, a), ssim(b, a), ssim_gaussian(b, a)])
            .collect();
        let mean = |i: usize| rows.iter().map(|r| r[i]).sum::<f64>() / n as f64;
        if self.json {
            let column = |i: usize| rows.iter().map(|r| r[i]).collect::<Vec<_>>();
            outln!(
                "{}",
                serde_json::json!({
                    "frames": n, "psnr_db": mean(0), "ssim": mean(1), "ssim_gaussian": mean(2),
                    "per_frame": { "psnr_db": column(0), "ssim": column(1), "ssim_gaussian": column(2) },
                })
            );
            return Ok(Done::Complete);
        }
        if self.frames {
            for (t, [p, u, g]) in rows.iter().enumerate() {
                outln!("frame {t:>4}   PSNR {p:6.2} dB   SSIM {u:.4}   SSIM (Gaussian) {g:.4}");
            }
        }
        outln!("{n} frames    PSNR {:6.2} dB   SSIM {:.4}   SSIM (Gaussian) {:.4}", mean(0), mean(1), mean(2));
        Ok(Done::Complete)
    }
}
