//! DDNet: a video demosaicer of the same two stages as FastDVDnet, without noise map and batch norm.
//!
//! ```text
//! y_t = m_t + block₁(m_{t−1}, m_t, m_{t+1})        out_t = y_t + block₂(y_{t−1}, y_t, y_{t+1})
//! ```
//!
//! `m` is the sparse RGB image of an RGGB mosaic: each pixel has the color that it saw, and zero in the other two.
//! This is the network that the paper describes; its published weights are of another one and are not available.
//!
//! # References
//! Wu et al., *Adaptive Deep PnP Algorithm for Video Snapshot Compressive Imaging*, section 3.

use crate::fastdvdnet::{check_widths, recognise_blocks};
use crate::layers::{Conv, Source};
use crate::network::{Layers, Network, Padding, Window, check_clips, reflect};
use crate::video::{BlockSpec, Ends, Residual, VideoNet};
use crate::weights::WeightFile;
use crate::{Architecture, Error, Result};
use admm::Call;
use candle_core::Tensor;
use ndarray::{Array4, ArrayView3, ArrayView4, ArrayViewMut4, s};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sci_forward::{BoxError, CfaPattern, Demosaicer};
use std::path::Path;

/// The size of a [`Ddnet`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct DdnetSpec {
    /// Channels at full, half and quarter size: 32, 64, 128 in the paper.
    pub widths: [usize; 3],
}

impl DdnetSpec {
    /// The paper's width.
    pub const PAPER: Self = Self { widths: [32, 64, 128] };

    pub(crate) fn recognise(file: &WeightFile) -> Option<Self> {
        let (per_frame, _, widths, _) = recognise_blocks(file)?;
        (per_frame == 3).then_some(Self { widths })
    }
}

impl std::fmt::Display for DdnetSpec {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [a, b, c] = self.widths;
        write!(f, "DDNet ({a}/{b}/{c} channels)")
    }
}

/// The DDNet demosaicer, trained for RGGB; other patterns are shifted to it.
#[derive(Debug, Clone)]
pub struct Ddnet {
    spec: DdnetSpec,
    net: VideoNet,
}

impl Ddnet {
    /// Reads a `.safetensors` or `.pth` file, or bundled weights (`bundled:NAME`).
    ///
    /// # Errors
    /// When the file cannot be read, is of another network, or its tensors do not fit together.
    pub fn load(path: &Path, ends: Ends) -> Result<Self> {
        Self::from_weights(WeightFile::read(path)?, ends)
    }

    /// Takes the weights of a file that has been read.
    ///
    /// # Errors
    /// When the weights are of another network, or do not fit together.
    pub fn from_weights(file: WeightFile, ends: Ends) -> Result<Self> {
        match file.architecture()? {
            Architecture::Ddnet(spec) => {
                let path = file.path().to_owned();
                let mut source = Source::stored(file.into_tensors());
                let net = Self::build(spec, ends, &mut source)?;
                source.finish(&path, &spec.to_string())?;
                Ok(net)
            }
            other => Err(Error::wrong_architecture(file.path(), "DDNet", other)),
        }
    }

    /// An untrained network, the same for the same seed.
    ///
    /// # Errors
    /// [`Error::Setting`] for a size out of range.
    pub fn random(spec: DdnetSpec, ends: Ends, seed: u64) -> Result<Self> {
        Self::build(spec, ends, &mut Source::Random(&mut ChaCha8Rng::seed_from_u64(seed)))
    }

    fn build(spec: DdnetSpec, ends: Ends, source: &mut Source<'_>) -> Result<Self> {
        check_widths(spec.widths)?;
        let block = BlockSpec { channels: 3, noise_map: false, widths: spec.widths, batch_norm: false };
        Ok(Self { spec, net: VideoNet::build(block, Residual::Add, ends, source)? })
    }

    /// Its size.
    pub fn spec(&self) -> DdnetSpec {
        self.spec
    }
}

/// The RGGB mosaic `[T, H, W]` as sparse RGB `[T, 3, H, W]`.
///
/// A mosaic of another pattern is continued at the top or the left by one mirrored row or column, which makes it RGGB:
/// the result is up to one pixel higher and wider.
pub(crate) fn sparse_rgb(cfa: CfaPattern, mosaic: ArrayView3<'_, f32>) -> Array4<f32> {
    let (top, left) = shift(cfa);
    let (t, h, w) = mosaic.dim();
    Array4::from_shape_fn((t, 3, h + top, w + left), |(t, color, y, x)| {
        let (row, column) = (reflect(y as isize - top as isize, h), reflect(x as isize - left as isize, w));
        // In an image one pixel wide the mirrored column has the wrong color: it stays unknown.
        let seen = CfaPattern::Rggb.color_at(y, x) as usize == color && cfa.color_at(row, column) as usize == color;
        if seen { mosaic[[t, row, column]] } else { 0.0 }
    })
}

/// Rows and columns to put before a mosaic to make it RGGB.
fn shift(cfa: CfaPattern) -> (usize, usize) {
    let red = |row, column| cfa.color_at(row, column) as usize == 0;
    match (red(0, 0), red(0, 1), red(1, 0)) {
        (true, ..) => (0, 0),
        (_, true, _) => (0, 1),
        (_, _, true) => (1, 0),
        _ => (1, 1),
    }
}

impl Layers for Ddnet {
    fn describe(&self) -> String {
        self.spec.to_string()
    }

    fn channels(&self) -> usize {
        3
    }

    fn multiply_adds(&self) -> f64 {
        self.net.multiply_adds()
    }

    fn convs(&self) -> Vec<&Conv> {
        self.net.convs()
    }

    fn convs_mut(&mut self) -> Vec<&mut Conv> {
        self.net.convs_mut()
    }
}

impl Network for Ddnet {
    fn forward(&self, clips: &Tensor, noise: &[f32]) -> Result<Tensor> {
        check_clips(self, clips, noise)?;
        Ok(self.net.forward(clips, noise)?)
    }

    /// Triplets through the first block, then triplets of its results through the second.
    fn stages(&self, frames: usize) -> Vec<Vec<Window>> {
        self.net.stages(frames)
    }

    fn forward_window(&self, stage: usize, inputs: &Tensor, noise: f32) -> Result<Tensor> {
        Ok(self.net.forward_window(stage, inputs, noise)?)
    }

    fn padded(&self, clip: &Tensor) -> Result<Tensor> {
        Ok(Padding::Reflect.pad(clip, 4)?)
    }

    /// Frames of a mosaic; no σ is looked at.
    fn infer(&mut self, _: &Call<'_>, clip: ArrayView4<'_, f32>, out: ArrayViewMut4<'_, f32>) -> Result<(), BoxError> {
        Ok(self.net.infer(clip, 0.0, out)?)
    }

    fn sees_mosaics(&self) -> bool {
        true
    }

    fn boxed(&self) -> Box<dyn Network> {
        Box::new(self.clone())
    }
}

impl Demosaicer for Ddnet {
    fn name(&self) -> &str {
        "ddnet"
    }

    fn demosaic(
        &mut self,
        cfa: CfaPattern,
        mosaic: ArrayView3<'_, f32>,
        mut rgb: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        let (t, h, w) = mosaic.dim();
        if rgb.dim() != (t, 3, h, w) {
            let (expected, found) = (vec![t, 3, h, w], rgb.shape().to_vec());
            return Err(Error::Shape { what: "the RGB video", expected, found }.into());
        }
        if mosaic.is_empty() {
            return Ok(());
        }
        let sparse = sparse_rgb(cfa, mosaic);
        if sparse.dim() == rgb.dim() {
            return Ok(self.net.infer(sparse.view(), 0.0, rgb)?);
        }
        let mut whole = Array4::zeros(sparse.dim());
        self.net.infer(sparse.view(), 0.0, whole.view_mut())?;
        let (top, left) = shift(cfa);
        rgb.assign(&whole.slice(s![.., .., top.., left..]));
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;

    #[test]
    fn every_pattern_becomes_rggb_with_its_colors_in_place() {
        for cfa in [CfaPattern::Rggb, CfaPattern::Bggr, CfaPattern::Grbg, CfaPattern::Gbrg] {
            for (h, w) in [(4, 6), (5, 3), (2, 2)] {
                // Each pixel holds its color plus one.
                let mosaic = Array3::from_shape_fn((1, h, w), |(_, y, x)| cfa.color_at(y, x) as u8 as f32 + 1.0);
                for ((_, color, y, x), &v) in sparse_rgb(cfa, mosaic.view()).indexed_iter() {
                    let seen = CfaPattern::Rggb.color_at(y, x) as usize == color;
                    assert_eq!(v, if seen { color as f32 + 1.0 } else { 0.0 }, "{cfa:?} {h}×{w} at {y}, {x}");
                }
            }
        }
    }
}
