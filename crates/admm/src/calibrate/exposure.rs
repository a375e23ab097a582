//! How much light each frame lets in, from the places of a measurement that are even.
//!
//! Where a scene is even over a few pixels and stands still, `y = u Σ_t g_t C_t` with one brightness u: a linear regression tells the gain
//! g_t of each frame. A mask on a stage dwells where it turns round, and the light before the first frame and after the last falls through
//! the pattern as it is then; both put light into the first and last frames that is not theirs. The held-out error does not see a gain: a
//! frame that is brighter explains as much.

use super::{TILES, squares_of, tile_of};
use crate::linear::Cholesky;
use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis, s};
use sci_forward::{MaskError, MaskStack, brightness};

/// Pixels to each side over which a scene is to be even.
const RADIUS: usize = 4;
/// The largest slope of a brightness there, as a share of it.
const EVEN: f32 = 0.012;
/// Even pixels that a gain must at least have, and those that are used in all at most, about.
const LEAST: usize = 40;
const MOST_PIXELS: usize = 1 << 19;
/// The weight of gains of 1, as a share of what the pixels say: masks that move by less than their pixels are wide hardly tell a gain from
/// those before and after.
const RIDGE: f64 = 3e-3;
/// Rounds of finding what is even with the gains so far.
const ROUNDS: usize = 4;
/// Residuals beyond so many standard deviations are of what is not even.
const OUTLIER: f64 = 2.5;
/// Gains that are all nearer to 1 are left alone, as are those of more frames than this.
const SLIGHT: f64 = 0.03;
const MOST_FRAMES: usize = 64;
/// The correlation of masks with those before them that says that they move.
const SAME: f64 = 0.9;
/// How far a mask may move from a frame to the next, in pixels.
const FARTHEST: isize = 2;

/// How much light each frame lets in.
#[derive(Debug, Clone, PartialEq)]
pub struct Exposure {
    /// Of the time before the first frame, of each frame, and of the time after the last: `B + 2` numbers that add up to B. Those at both
    /// ends are 0 where masks do not move, so that nobody knows what was there then.
    pub gains: Vec<f64>,
    /// One standard deviation of the least certain.
    pub uncertainty: f64,
}

impl Exposure {
    /// The masks with this light: `S_t = g_t C_t`, and the first and the last with that before and after it.
    ///
    /// # Errors
    /// [`MaskError::Count`] if there are not two gains more than frames; else as [`MaskStack::new`].
    pub fn apply(&self, masks: &MaskStack) -> Result<MaskStack, MaskError> {
        let frames = masks.shape().frames;
        if self.gains.len() != frames + 2 {
            return Err(MaskError::Count { what: "gains", expected: frames + 2, found: self.gains.len() });
        }
        let all = extended(masks.view());
        let mut exposed = all.slice(s![1..=frames, .., ..]).to_owned();
        for (mut mask, gain) in exposed.outer_iter_mut().zip(&self.gains[1..]) {
            mask.mapv_inplace(|c| c * *gain as f32);
        }
        for (frame, beyond) in [(0, 0), (frames - 1, frames + 1)] {
            let light = all.index_axis(Axis(0), beyond);
            exposed.index_axis_mut(Axis(0), frame).scaled_add(self.gains[beyond] as f32, &light);
        }
        MaskStack::new(exposed)
    }

    /// Nothing if too little is even, or the gains cannot be told from equal ones. What is not `believed` is not used, nor what is near.
    pub(super) fn find(masks: &MaskStack, measurements: &[Array2<f32>], believed: &[Array2<bool>]) -> Option<Self> {
        let frames = masks.shape().frames;
        if frames > MOST_FRAMES {
            return None;
        }
        let all = extended(masks.view());
        let equal: Vec<f64> = (0..frames + 2).map(|t| if (1..=frames).contains(&t) { 1.0 } else { 0.0 }).collect();
        let whole: Vec<Array2<bool>> = believed.iter().map(|believed| squares_of(believed, RADIUS + 1)).collect();
        let mut found = Self { gains: equal.clone(), uncertainty: f64::INFINITY };
        for _ in 0..ROUNDS {
            found = Regression::of(&all, measurements, &whole, &found.gains)?.solve(&equal)?;
        }
        found.gains.iter_mut().for_each(|gain| *gain = gain.max(0.0));
        let sum: f64 = found.gains.iter().sum();
        found.gains.iter_mut().for_each(|gain| *gain *= frames as f64 / sum);
        let farthest = found.gains.iter().zip(&equal).fold(0f64, |far, (gain, equal)| far.max((gain - equal).abs()));
        (farthest > SLIGHT.max(3.0 * found.uncertainty)).then_some(found)
    }
}

/// The masks with the one before the first and the one after the last: nothing, if they do not move.
fn extended(masks: ArrayView3<'_, f32>) -> Array3<f32> {
    let (frames, height, width) = masks.dim();
    let mut all = Array3::zeros((frames + 2, height, width));
    all.slice_mut(s![1..=frames, .., ..]).assign(&masks);
    if let Some(step) = motion(masks) {
        all.index_axis_mut(Axis(0), 0).assign(&moved(masks.index_axis(Axis(0), 0), step.map(|v| -v)));
        all.index_axis_mut(Axis(0), frames + 1).assign(&moved(masks.index_axis(Axis(0), frames - 1), step));
    }
    all
}

/// A mask moved by whole pixels, its edge continued.
fn moved(mask: ArrayView2<'_, f32>, [down, right]: [isize; 2]) -> Array2<f32> {
    let (height, width) = mask.dim();
    let from = |at: usize, step: isize, n: usize| (at as isize - step).clamp(0, n as isize - 1) as usize;
    Array2::from_shape_fn((height, width), |(i, j)| mask[[from(i, down, height), from(j, right, width)]])
}

/// By how many whole pixels masks move from a frame to the next, if they do.
fn motion(masks: ArrayView3<'_, f32>) -> Option<[isize; 2]> {
    let (frames, height, width) = masks.dim();
    if frames < 2 || height.min(width) <= 2 * FARTHEST as usize + 1 {
        return None;
    }
    let (bottom, right) = (height as isize - FARTHEST, width as isize - FARTHEST);
    let inside = |mask: ArrayView2<'_, f32>| {
        mask.slice(s![FARTHEST..bottom, FARTHEST..right]).iter().map(|&c| f64::from(c)).collect::<Vec<_>>()
    };
    let alike = |step: [isize; 2]| {
        let pairs = (1..frames).map(|t| {
            let before = moved(masks.index_axis(Axis(0), t - 1), step);
            correlation(&inside(before.view()), &inside(masks.index_axis(Axis(0), t)))
        });
        pairs.sum::<f64>() / (frames - 1) as f64
    };
    let steps = (-FARTHEST..=FARTHEST).flat_map(|down| (-FARTHEST..=FARTHEST).map(move |right| [down, right]));
    let best = steps.filter(|step| *step != [0, 0]).map(|step| (alike(step), step));
    best.max_by(|a, b| a.0.total_cmp(&b.0)).filter(|(alike, _)| *alike > SAME).map(|(_, step)| step)
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (ma, mb) = (mean(a), mean(b));
    let (ab, aa, bb) = a.iter().zip(b).fold((0.0, 0.0, 0.0), |(ab, aa, bb), (a, b)| {
        (ab + (a - ma) * (b - mb), aa + (a - ma).powi(2), bb + (b - mb).powi(2))
    });
    if aa * bb > 0.0 { ab / (aa * bb).sqrt() } else { 0.0 }
}

/// An even pixel: what a gain of 1 of each frame would measure and what is measured, by the root of the brightness, and its tile.
struct Pixel {
    tile: usize,
    light: Vec<f64>,
    y: f64,
}

/// All even pixels.
struct Regression(Vec<Pixel>);

impl Regression {
    fn of(all: &Array3<f32>, measurements: &[Array2<f32>], whole: &[Array2<bool>], gains: &[f64]) -> Option<Self> {
        let mut open = Array2::<f32>::zeros(measurements.first()?.dim());
        all.outer_iter().zip(gains).for_each(|(mask, gain)| open.scaled_add(*gain as f32, &mask));
        let even = |(y, whole)| even_pixels(y, whole, &open);
        let even: Vec<_> = measurements.iter().zip(whole).map(even).collect();
        // Every third, fifth and so on where there are more than enough: each takes memory for all frames.
        let step = even.iter().map(Vec::len).sum::<usize>().div_ceil(MOST_PIXELS).max(1) | 1;
        let pixel = |y: &Array2<f32>, (at, u): ((usize, usize), f32)| {
            let root = f64::from(u).sqrt();
            let light = all.slice(s![.., at.0, at.1]).iter().map(|&c| f64::from(c) * root).collect();
            Pixel { tile: tile_of(at, y.dim()), light, y: f64::from(y[at]) / root }
        };
        let of_one = |(y, even): (&Array2<f32>, Vec<_>)| {
            even.into_iter().step_by(step).map(|even| pixel(y, even)).collect::<Vec<_>>()
        };
        let pixels: Vec<Pixel> = measurements.iter().zip(even).flat_map(of_one).collect();
        (pixels.len() >= LEAST * gains.len()).then_some(Self(pixels))
    }

    /// Gains, those of pixels that fit badly left out.
    fn solve(self, equal: &[f64]) -> Option<Exposure> {
        let first = self.fit(equal)?;
        let residual = |pixel: &Pixel, gains: &[f64]| {
            pixel.y - pixel.light.iter().zip(gains).map(|(light, gain)| light * gain).sum::<f64>()
        };
        let spread = self.0.iter().map(|p| residual(p, &first.1).powi(2)).sum::<f64>() / self.0.len() as f64;
        let fits = |pixel: &Pixel| residual(pixel, &first.1).powi(2) <= OUTLIER.powi(2) * spread;
        let kept = Self(self.0.into_iter().filter(fits).collect());
        let (normal, gains) = kept.fit(equal)?;
        // Residuals of one tile have a common cause: each tile's pull on the gains counts once.
        let mut pulls = vec![vec![0.0; gains.len()]; TILES * TILES];
        for pixel in &kept.0 {
            let r = residual(pixel, &gains);
            pulls[pixel.tile].iter_mut().zip(&pixel.light).for_each(|(pull, light)| *pull += light * r);
        }
        let moves: Vec<Vec<f64>> = pulls.iter().map(|pull| normal.solve(pull)).collect();
        let variance = |t: usize| moves.iter().map(|m| m[t] * m[t]).sum::<f64>();
        let most = (0..gains.len()).map(variance).fold(0.0, f64::max);
        let share = gains.iter().sum::<f64>() / equal.iter().sum::<f64>();
        Some(Exposure { gains: gains.iter().map(|gain| gain / share).collect(), uncertainty: most.sqrt() / share })
    }

    /// The normal equations, and their solution.
    fn fit(&self, equal: &[f64]) -> Option<(Cholesky, Vec<f64>)> {
        let n = equal.len();
        let (mut matrix, mut right) = (Array2::<f64>::zeros((n, n)), vec![0.0; n]);
        let (mut both, mut square) = (0.0, 0.0);
        for Pixel { light, y, .. } in &self.0 {
            for i in 0..n {
                right[i] += light[i] * y;
                (0..=i).for_each(|j| matrix[[i, j]] += light[i] * light[j]);
            }
            let white: f64 = light.iter().zip(equal).map(|(light, equal)| light * equal).sum();
            (both, square) = (both + white * y, square + white * white);
        }
        let weight = RIDGE * matrix.diag().sum() / n as f64;
        for i in 0..n {
            matrix[[i, i]] += weight;
            right[i] += weight * equal[i] * both / square;
        }
        let normal = Cholesky::of(matrix)?;
        let gains = normal.solve(&right);
        Some((normal, gains))
    }
}

/// The pixels of a measurement around which it is even, and `whole`, with the brightness there.
fn even_pixels(y: &Array2<f32>, whole: &Array2<bool>, open: &Array2<f32>) -> Vec<((usize, usize), f32)> {
    let (height, width) = y.dim();
    let brightness = brightness(y.view(), open.view(), RADIUS);
    let middle = brightness.mean().unwrap_or(0.0);
    let mut even = Vec::new();
    for i in 2 * RADIUS + 1..height.saturating_sub(2 * RADIUS + 1) {
        for j in 2 * RADIUS + 1..width.saturating_sub(2 * RADIUS + 1) {
            let u = brightness[[i, j]];
            let down = 0.5 * (brightness[[i + 1, j]] - brightness[[i - 1, j]]);
            let right = 0.5 * (brightness[[i, j + 1]] - brightness[[i, j - 1]]);
            if whole[[i, j]] && u > 0.02 * middle && down.hypot(right) < EVEN * u {
                even.push(((i, j), u));
            }
        }
    }
    even
}

#[cfg(test)]
mod tests {
    use super::*;
    use sci_forward::{MaskOperator, SensingOperator, VideoShape};

    const SHAPE: VideoShape = VideoShape { frames: 6, height: 64, width: 64 };

    /// Two even halves, one of which gives way to the other.
    fn scene() -> Array3<f32> {
        Array3::from_shape_fn(SHAPE.dim(), |(t, _, j)| if j < 30 + t { 0.8 } else { 0.3 })
    }

    fn exposure(masks: &MaskStack, y: Array2<f32>) -> Option<Exposure> {
        let believed = y.mapv(|_| true);
        Exposure::find(masks, &[y], &[believed])
    }

    #[test]
    fn gains_are_found_of_masks_that_stand_still() {
        let masks = MaskStack::random(SHAPE, 0.5, 3).unwrap();
        let real = Exposure { gains: vec![0.0, 1.3, 0.9, 1.0, 0.8, 1.1, 0.9, 0.0], uncertainty: 0.0 };
        let y = MaskOperator::new(real.apply(&masks).unwrap()).forward(scene().view());
        let found = exposure(&masks, y).unwrap();
        let off = found.gains.iter().zip(&real.gains).fold(0f64, |off, (a, b)| off.max((a - b).abs()));
        assert!(off < 0.02 && off < 4.0 * found.uncertainty.max(1e-3), "{found:?}");
    }

    /// The light before the first frame and after the last comes through the pattern as it is then.
    #[test]
    fn light_before_and_after_is_found_of_masks_that_move() {
        let masks = MaskStack::shifting(SHAPE, 0.5, 3).unwrap();
        assert_eq!(motion(masks.view()), Some([0, -1]));
        let real = Exposure { gains: vec![0.5, 1.1, 0.8, 0.8, 0.8, 1.0, 0.9, 0.1], uncertainty: 0.0 };
        let y = MaskOperator::new(real.apply(&masks).unwrap()).forward(scene().view());
        let found = exposure(&masks, y).unwrap();
        let off = found.gains.iter().zip(&real.gains).fold(0f64, |off, (a, b)| off.max((a - b).abs()));
        assert!(off < 0.03, "{found:?}");
    }

    #[test]
    fn equal_gains_and_scenes_that_are_nowhere_even_say_nothing() {
        let masks = MaskStack::random(SHAPE, 0.5, 3).unwrap();
        let y = |video: Array3<f32>| MaskOperator::new(masks.clone()).forward(video.view());
        assert_eq!(exposure(&masks, y(scene())), None);
        let rough = Array3::from_shape_fn(SHAPE.dim(), |(t, i, j)| ((i / 3 + j / 4 + t) % 2) as f32 * 0.8 + 0.1);
        assert_eq!(exposure(&masks, y(rough)), None);
    }

    #[test]
    fn gains_are_one_a_frame_and_two() {
        let masks = MaskStack::random(SHAPE, 0.5, 3).unwrap();
        let few = Exposure { gains: vec![1.0; 6], uncertainty: 0.0 };
        assert!(matches!(few.apply(&masks), Err(MaskError::Count { expected: 8, found: 6, .. })));
    }
}
