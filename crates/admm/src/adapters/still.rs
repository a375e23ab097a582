//! Detects static tiles from one measurement.

use super::tiles::{Grid, SIDE};
use crate::linear::Cholesky;
use ndarray::parallel::prelude::*;
use ndarray::{Array1, Array2, Array3};
use sci_forward::Measurement;

/// Side of the blocks that are tested.
const BLOCK: usize = 16;
/// Largest F of a still block.
const LARGEST_F: f64 = 3.0;
/// Largest correlation of a still tile.
const LARGEST_CORRELATION: f64 = 0.12;

/// Which tiles of 32 × 32 pixels stand still, in rows: what [`Tiles`](crate::Tiles) wants to know.
///
/// Of a scene that stands still, `s = y / Σ_t C_t` is a picture of it, and the difference d of two neighbours in s has
/// nothing to do with which masks are open there. Where something moves, s is mottled by the masks. With
/// `w_t = C_t(p)/ΣC(p) − C_t(q)/ΣC(q)` for neighbours p and q in a row, of the same color on a color sensor:
///
/// * if the brightness of a block changes from frame to frame, `d = Σ_t w_t x_t + …`: in each block of 16 × 16 pixels the share of
///   d² that w explains by least squares, in units of what it explains of noise (F of T − 1 degrees of freedom), is at most 3;
/// * if only its texture moves, `|d|` is larger where `‖w‖` is: the correlation of the two over the tile is at most 0.12.
///
/// Masks that are alike everywhere cannot tell, nor blocks with too few open pixels: such tiles are not called still.
pub fn still(measurement: &Measurement) -> Vec<bool> {
    let (frames, height, width) = measurement.shape().dim();
    let grid = Grid { height, width, side: SIDE };
    let masks = measurement.operator().adjoint(Array2::ones((height, width)).view());
    let sum = masks.sum_axis(ndarray::Axis(0));
    let apart = if measurement.cfa().is_some() { 2 } else { 1 };
    let picture = Picture { masks, sum, apart, least: measurement.least_telling(), measurement };
    (0..grid.len())
        .into_par_iter()
        .map(|tile| {
            let (rows, columns) = grid.tile(tile);
            let mut of_tile = Correlation::default();
            let mut blocks_are_still = true;
            for top in rows.clone().step_by(BLOCK) {
                for left in columns.clone().step_by(BLOCK) {
                    let mut fit = Fit::new(frames);
                    for row in top..(top + BLOCK).min(rows.end) {
                        for column in left..(left + BLOCK).min(columns.end).min(width.saturating_sub(apart)) {
                            if let Some((d, w)) = picture.difference(row, column) {
                                of_tile.add(d.abs(), w.dot(&w).sqrt());
                                fit.add(d, &w);
                            }
                        }
                    }
                    blocks_are_still &= fit.is_noise();
                }
            }
            blocks_are_still && of_tile.is_none()
        })
        .collect()
}

struct Picture<'a> {
    masks: Array3<f32>,
    sum: Array2<f32>,
    /// From a pixel to its neighbour.
    apart: usize,
    /// [`Measurement::least_telling`].
    least: f32,
    measurement: &'a Measurement,
}

impl Picture<'_> {
    /// d and w of a pixel and its right neighbour, if the masks tell something of both.
    fn difference(&self, row: usize, column: usize) -> Option<(f64, Array1<f64>)> {
        let (p, q) = ([row, column], [row, column + self.apart]);
        let (sum_p, sum_q) = (f64::from(self.sum[p]), f64::from(self.sum[q]));
        let gram = self.measurement.operator().gram();
        if sum_p <= 0.0 || sum_q <= 0.0 || gram[p].min(gram[q]) < self.least {
            return None;
        }
        let d = f64::from(self.measurement.y()[p]) / sum_p - f64::from(self.measurement.y()[q]) / sum_q;
        let mask = |at: [usize; 2], t: usize| f64::from(self.masks[[t, at[0], at[1]]]);
        let w = (0..self.masks.dim().0).map(|t| mask(p, t) / sum_p - mask(q, t) / sum_q).collect();
        Some((d, w))
    }
}

/// Least squares of d by w.
struct Fit {
    /// `Σ w wᵀ` and `Σ w d`.
    normal: Array2<f64>,
    right: Array1<f64>,
    squares: f64,
    count: usize,
}

impl Fit {
    fn new(frames: usize) -> Self {
        Self { normal: Array2::zeros((frames, frames)), right: Array1::zeros(frames), squares: 0.0, count: 0 }
    }

    fn add(&mut self, d: f64, w: &Array1<f64>) {
        for (mut row, &a) in self.normal.outer_iter_mut().zip(w) {
            row.scaled_add(a, w);
        }
        self.right.scaled_add(d, w);
        self.squares += d * d;
        self.count += 1;
    }

    /// Whether w explains no more of d than of noise.
    fn is_noise(&self) -> bool {
        let freedom = self.right.len() - 1;
        if freedom == 0 || self.count < 4 * self.right.len() {
            return false;
        }
        // The components of w sum to 0: the direction of equal frames is free, and anything may be put there.
        let scale = self.normal.diag().sum() / self.right.len() as f64;
        if scale <= 0.0 {
            return false;
        }
        let normal = &self.normal + scale;
        let right = self.right.as_slice().expect("made so");
        let solved = Cholesky::of(normal).map(|cholesky| cholesky.solve(right));
        let explained = solved.map_or(f64::INFINITY, |x| x.iter().zip(right).map(|(x, right)| x * right).sum());
        let rest = (self.squares - explained).max(0.0) / (self.count - freedom) as f64;
        explained <= LARGEST_F * freedom as f64 * rest || self.squares <= 1e-8 * self.count as f64
    }
}

/// Sums of a correlation.
#[derive(Default)]
struct Correlation {
    n: f64,
    x: f64,
    y: f64,
    xx: f64,
    yy: f64,
    xy: f64,
}

impl Correlation {
    fn add(&mut self, x: f64, y: f64) {
        self.n += 1.0;
        self.x += x;
        self.y += y;
        self.xx += x * x;
        self.yy += y * y;
        self.xy += x * y;
    }

    fn is_none(&self) -> bool {
        let covariance = self.n * self.xy - self.x * self.y;
        let variances = (self.n * self.xx - self.x * self.x) * (self.n * self.yy - self.y * self.y);
        covariance <= LARGEST_CORRELATION * variances.max(0.0).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sci_forward::{CfaPattern, MaskOperator, MaskStack, SensingOperator, VideoShape};
    use std::sync::Arc;

    const SHAPE: VideoShape = VideoShape { frames: 8, height: 64, width: 96 };

    /// A picture with texture and edges.
    fn scene(row: f64, column: f64) -> f32 {
        let texture = (0.9 * row + 0.4 * column).sin() * (0.31 * column).cos() + (0.07 * row * column / 8.0).sin();
        (0.5 + 0.15 * texture + if (column / 20.0) as i64 % 2 == 0 { 0.15 } else { 0.0 }) as f32
    }

    fn tiles(video: impl Fn(usize, usize, usize) -> f32) -> Vec<bool> {
        on_sensor(None, video)
    }

    fn on_sensor(cfa: Option<CfaPattern>, video: impl Fn(usize, usize, usize) -> f32) -> Vec<bool> {
        let h = MaskOperator::new(MaskStack::random(SHAPE, 0.5, 2).unwrap());
        let y = h.forward(Array3::from_shape_fn(SHAPE.dim(), |(t, i, j)| video(t, i, j)).view());
        still(&Measurement::new(Arc::new(h), y).unwrap().with_cfa(cfa))
    }

    #[test]
    fn a_still_scene_stands_still() {
        let tiles = tiles(|_, i, j| scene(i as f64, j as f64));
        assert_eq!(tiles, [true; 6]);
    }

    #[test]
    fn a_scene_that_moves_as_a_whole_does_not() {
        let tiles = tiles(|t, i, j| scene(i as f64, j as f64 + 2.0 * t as f64));
        assert_eq!(tiles, [false; 6]);
    }

    #[test]
    fn something_small_that_moves_wakes_its_tile_only() {
        let tiles = tiles(|t, i, j| {
            let on = (36..44).contains(&i) && (68 + 2 * t..76 + 2 * t).contains(&j);
            if on { 1.0 } else { scene(i as f64, j as f64) }
        });
        assert_eq!(tiles, [true, true, true, true, true, false]);
    }

    /// Pixels beside each other differ by their color more than by anything that moves.
    #[test]
    fn on_a_color_sensor_it_is_seen_too() {
        let color = |i: usize, j: usize| [[1.0, 0.5], [0.5, 0.2]][i % 2][j % 2];
        let of = |speed: f64| {
            let moved = move |t: usize, i: usize, j: usize| color(i, j) * scene(i as f64, j as f64 + speed * t as f64);
            on_sensor(Some(CfaPattern::Rggb), moved)
        };
        assert_eq!((of(0.0), of(2.0)), (vec![true; 6], vec![false; 6]));
        let brighter = |t: usize, i: usize, j: usize| color(i, j) * (0.5 + 0.02 * t as f32) * scene(i as f64, j as f64);
        assert_eq!(on_sensor(Some(CfaPattern::Rggb), brighter), [false; 6]);
    }
}
