//! How masks sit, by how well they explain each pixel from the brightness around it.
//!
//! With S = Σ_t C_t, S̄ its mean around a pixel, ȳ that of y, contrast c and black level b,
//!
//! ```text
//! y = ȳ S/S̄ + (1 − S/S̄)((1 − c) ȳ + c b) + texture of the scene
//! ```
//!
//! What is left beside ȳ is least where S is of the masks that are there. The scene's texture does not follow masks that move over it, so that it
//! adds to the error and leaves the minimum where it is; no video is solved. The contrast and the black level are fitted to all pixels at once.

use super::level::{self, Level, Pixel};
use super::{Errors, GROUPS, tile_of};
use ndarray::{Array2, ArrayView2, Zip, s};
use rayon::prelude::*;
use sci_forward::{CfaPattern, MaskStack, brightness};

/// Pixels to each side that tell how bright it is around one.
pub(super) const RADIUS: usize = 4;
/// How far pixels are off, of their brightness: what masks and noise leave, and texture, by how much is open.
const APART: f64 = 0.3;
const TEXTURE: f64 = 0.3;
/// The share of pixels around one that must be believed.
const MOST: f32 = 0.5;
/// Times that, beyond which errors count by their size instead of its square.
const FAR: f64 = 3.0;
/// One standard deviation of the black level and the contrast that all pixels tell.
const BY_ALL: f64 = 0.025;
/// The least variance of S/S̄ that tells where masks sit: a tenth of that of 32 random masks.
const UNEVEN: f64 = 3e-3;
/// Pixels without which nothing is told, and those that are asked at most, about: large sensors have more than enough, and each takes memory.
const LEAST: usize = 64;
const MOST_PIXELS: usize = 1 << 21;

/// One measurement, or one color of it, with the brightness around each pixel, in units of the mean of |y|.
struct View {
    y: Array2<f32>,
    light: Array2<f32>,
    /// 1 where a pixel is believed, and how many are around it, with it.
    believed: Array2<f32>,
    count: Array2<f32>,
    usable: Array2<bool>,
    groups: Array2<u8>,
    offset: (usize, usize),
}

/// What is asked.
pub(super) struct Neighbours {
    views: Vec<View>,
    /// Pixels of a color between one and the next.
    each: usize,
}

impl Neighbours {
    /// Of measurements with the mean of |y|. Pixels that are not `believed` are not asked, nor those among many such, or within `margin` of the edge.
    /// Nothing for masks of both signs, whose sum does not tell how bright it is, for those whose sum is the same at neighbouring pixels, or where next
    /// to nothing is left.
    pub(super) fn new(
        masks: &MaskStack,
        cfa: Option<CfaPattern>,
        (measurements, mean): (&[Array2<f32>], f64),
        believed: &[Array2<bool>],
        groups: &Array2<u8>,
        margin: usize,
    ) -> Option<Self> {
        if mean <= 0.0 || masks.view().iter().any(|&c| c < 0.0) {
            return None;
        }
        // Each color has a brightness of its own.
        let each = if cfa.is_some() { 2 } else { 1 };
        let mut views = Vec::new();
        for (y, believed) in measurements.iter().zip(believed) {
            for offset in (0..each).flat_map(|row| (0..each).map(move |column| (row, column))) {
                let of = s![offset.0..;each, offset.1..;each];
                let y = y.slice(of).mapv(|y| y / mean as f32);
                let believed = believed.slice(of).mapv(f32::from);
                let count = counts(&believed);
                let mut usable = Zip::from(&believed).and(&count).map_collect(|&own, &n| own > 0.0 && n > MOST * COUNT);
                let (height, width) = usable.dim();
                let inside = |at: usize, size: usize| (margin..size.saturating_sub(margin)).contains(&at);
                usable.indexed_iter_mut().for_each(|((i, j), u)| *u &= inside(i, height) && inside(j, width));
                let groups = groups.slice(of).to_owned();
                let mut view = View { light: Array2::zeros(y.dim()), y, believed, count, usable, groups, offset };
                view.light = view.around(view.y.view());
                views.push(view);
            }
        }
        thin_out(&mut views);
        let near = Self { views, each };
        let pixels = near.pixels(masks.sum().view());
        let uneven = pixels.iter().map(|p| (1.0 - p.open).powi(2)).sum::<f64>();
        (pixels.len() >= LEAST && uneven > UNEVEN * pixels.len() as f64).then_some(near)
    }

    /// All pixels that are asked, of masks with this sum.
    fn pixels(&self, open: ArrayView2<'_, f32>) -> Vec<Pixel> {
        let of_view = |view: &View| {
            let open = open.slice(s![view.offset.0..;self.each, view.offset.1..;self.each]);
            let (open_near, usual) = (view.around(open), f64::from(open.mean().unwrap_or(0.0)));
            let mut pixels = Vec::with_capacity(open.len());
            for (at, _) in view.usable.indexed_iter().filter(|(_, usable)| **usable) {
                let (light, near) = (f64::from(view.light[at]), f64::from(open_near[at]));
                // In the dark nothing is told, and noise would be divided by little.
                if near < 0.2 * usual || light < 0.05 {
                    continue;
                }
                let open = f64::from(open[at]);
                pixels.push(Pixel {
                    tile: tile_of(at, view.usable.dim()),
                    group: usize::from(view.groups[at]),
                    share: open / usual,
                    open: open / near,
                    y: f64::from(view.y[at]),
                    light,
                });
            }
            pixels
        };
        self.views.par_iter().flat_map_iter(of_view).collect()
    }

    /// What is left of the pixels' light beside that around them, shared out among the groups: 1 is as far as is usual.
    pub(super) fn errors(&self, open: ArrayView2<'_, f32>) -> Errors {
        let pixels = self.pixels(open);
        let found = fitted(&pixels).unwrap_or([0.0; 2]);
        let mut errors = [0.0; GROUPS];
        for p in &pixels {
            let left = p.left(found).abs() * weight(p).sqrt();
            let error = if left < FAR { left * left } else { FAR * (2.0 * left - FAR) };
            errors[p.group] += error / pixels.len().max(1) as f64;
        }
        Errors(errors)
    }

    /// Black level and contrast, by nearly closed pixels.
    pub(super) fn level(&self, open: ArrayView2<'_, f32>) -> Option<Level> {
        level::fit(&self.pixels(open))
    }

    /// Black level and contrast, by all pixels; what is dark among bright seems less so, so that neither is sure to some hundredths.
    pub(super) fn level_by_all(&self, open: ArrayView2<'_, f32>) -> Option<Level> {
        let [closed, black] = fitted(&self.pixels(open))?;
        let contrast = (1.0 - closed).min(1.0);
        (contrast > 0.0).then_some(Level { black: black / contrast, contrast, uncertainty: [BY_ALL; 2] })
    }
}

/// Leaves every third, fifth and so on of the pixels of each view if there are too many.
fn thin_out(views: &mut [View]) {
    let usable = views.iter().map(|view| view.usable.iter().filter(|&&usable| usable).count()).sum::<usize>();
    let step = usable.div_ceil(MOST_PIXELS).max(1) | 1;
    for view in views {
        // Another place in each row, so that nothing that repeats is always left out.
        let usable = view.usable.indexed_iter_mut().filter(|(_, usable)| **usable);
        usable.enumerate().for_each(|(k, ((row, _), usable))| *usable = (k + row).is_multiple_of(step));
    }
}

/// Pixels of a whole square.
const COUNT: f32 = ((2 * RADIUS + 1) * (2 * RADIUS + 1)) as f32;

/// How many pixels of the square around each are believed, where it is inside.
fn counts(believed: &Array2<f32>) -> Array2<f32> {
    COUNT * brightness(believed.view(), Array2::ones(believed.dim()).view(), RADIUS)
}

impl View {
    /// The mean of the believed pixels around each, without it.
    fn around(&self, image: ArrayView2<'_, f32>) -> Array2<f32> {
        let mut mean = brightness(image, self.believed.view(), RADIUS);
        Zip::from(&mut mean).and(&image).and(&self.believed).and(&self.count).for_each(
            |mean, &own, &believed, &count| {
                *mean = (count * *mean - believed * own) / (count - believed).max(1.0);
            },
        );
        mean
    }
}

/// One over the square of how far a pixel may be off.
fn weight(p: &Pixel) -> f64 {
    1.0 / (APART.powi(2) + (TEXTURE * p.open).powi(2))
}

/// 1 − c and b c by weighted least squares.
fn fitted(pixels: &[Pixel]) -> Option<[f64; 2]> {
    let (normal, right) = level::weighted_sums(pixels.iter().map(|p| (p, weight(p))));
    level::solve(normal, right)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array3;
    use sci_forward::{MaskMismatch, MaskOperator, MaskStack, SensingOperator, VideoShape};

    const SHAPE: VideoShape = VideoShape { frames: 6, height: 96, width: 96 };

    /// Texture on a slow change of brightness, moving.
    fn scene() -> Array3<f32> {
        Array3::from_shape_fn(SHAPE.dim(), |(t, i, j)| {
            let slow = 0.4 + 0.3 * (0.05 * i as f32 + 0.04 * (j + t) as f32).sin();
            slow * (1.0 + 0.2 * (1.9 * i as f32 + 0.7 * t as f32).sin() * (2.3 * j as f32).cos())
        })
    }

    fn found(masks: &MaskStack, contrast: f64, black: f32) -> Option<(Level, f64)> {
        let real = MaskMismatch { contrast, ..MaskMismatch::default() }.apply(masks).unwrap();
        let y = MaskOperator::new(real).forward(scene().view()) + black;
        let mean = f64::from(y.mean().unwrap());
        let (believed, groups) = (y.mapv(|_| true), y.mapv(|_| 0));
        let near = Neighbours::new(masks, None, (&[y], mean), &[believed], &groups, 4)?;
        near.level(masks.sum().view()).map(|level| (level, f64::from(black) / mean))
    }

    #[test]
    fn a_black_level_and_less_contrast_are_told_apart() {
        for masks in [MaskStack::random(SHAPE, 0.5, 3).unwrap(), MaskStack::shifting(SHAPE, 0.5, 3).unwrap()] {
            for (contrast, black) in [(1.0, 0.0), (1.0, 0.2), (0.9, 0.0), (0.95, 0.1)] {
                let (level, real) = found(&masks, contrast, black).unwrap();
                let off = (level.black - real).abs();
                assert!(off < 0.02 && off < 4.0 * level.uncertainty[0].max(2e-3), "{contrast}, {real}: {level:?}");
                assert!((level.contrast - contrast).abs() < 0.03, "{contrast}: {level:?}");
            }
        }
    }

    #[test]
    fn masks_that_let_everything_through_and_those_of_both_signs_tell_nothing() {
        let open = MaskStack::new(Array3::from_elem(SHAPE.dim(), 1.0)).unwrap();
        assert_eq!(found(&open, 1.0, 0.2), None);
        let signed = MaskStack::random(SHAPE, 0.5, 3).unwrap().view().mapv(|c| 2.0 * c - 1.0);
        assert_eq!(found(&MaskStack::new(signed).unwrap(), 1.0, 0.2), None);
    }
}
