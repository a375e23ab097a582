//! Owns the look whether masks and measurements belong together: the light through masks follows their sum, from pixel to pixel.

use ndarray::{Array2, ArrayView2, s};

/// From this correlation on masks belong to a measurement. Captures have .8 and more; masks of others, mirrored ones too, under .06.
const TOGETHER: f32 = 0.1;
/// From this one on, in size, a turned mask is what is meant.
const MEANT: f32 = 0.3;

/// What is to be said of masks with the sum `open` that do not go with a measurement, but would if they were turned; nothing if they go, or if
/// nothing tells. `lattice` is the distance of pixels of one color.
pub(super) fn doubt(open: ArrayView2<'_, f32>, y: ArrayView2<'_, f32>, lattice: usize) -> Option<String> {
    let y = fine(y, lattice).filter(|y| y.len() >= FEWEST)?;
    let open = fine(open, lattice)?;
    let told = correlation(open.view(), y.view()).filter(|&told| told < TOGETHER)?;
    let elsewhere = elsewhere(&open, &y);
    // The differences of a turned picture are the turned differences.
    let turned = (0..8).filter_map(|turn| Some((turn, correlation(turned(open.view(), turn), y.view())?)));
    let (turn, found) = turned.max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()))?;
    (found.abs() >= MEANT.max(elsewhere)).then(|| {
        let how = HOW.iter().enumerate().filter(|(bit, _)| turn >> bit & 1 == 1).map(|(_, how)| *how);
        let how = how.chain((found < 0.0).then_some("inverted (1 − mask)")).collect::<Vec<_>>().join(" and ");
        format!(
            "masks do not go with measurement 0 (correlation {told:.2} of their sum with it, from pixel to pixel); they would, {how} ({:.2})",
            found.abs()
        )
    })
}

/// Of fewer pixels one of eight turns goes with any measurement by chance.
const FEWEST: usize = 1000;
/// How many pixels masks may sit off.
const OFF: usize = 3;

/// How well masks go with a measurement if they are moved by some pixels, at best: then they are not turned, though they go against what is
/// measured beside them.
fn elsewhere(open: &Array2<f32>, y: &Array2<f32>) -> f32 {
    let (height, width) = y.dim();
    if height.min(width) <= 4 * OFF {
        return 0.0;
    }
    let inside = y.slice(s![OFF..height - OFF, OFF..width - OFF]);
    let offsets = (0..=2 * OFF).flat_map(|i| (0..=2 * OFF).map(move |j| (i, j))).filter(|&at| at != (OFF, OFF));
    let moved = |(i, j)| correlation(open.slice(s![i..i + height - 2 * OFF, j..j + width - 2 * OFF]), inside);
    offsets.filter_map(moved).fold(0.0, f32::max)
}

/// What the bits of a turn do to masks, the last one first.
const HOW: [&str; 3] = ["mirrored top to bottom", "mirrored left to right", "with rows and columns exchanged"];

fn turned(image: ArrayView2<'_, f32>, turn: usize) -> ArrayView2<'_, f32> {
    let image = if turn & 4 == 0 { image } else { image.reversed_axes() };
    match turn & 3 {
        0 => image,
        1 => image.slice_move(s![..;-1, ..]),
        2 => image.slice_move(s![.., ..;-1]),
        _ => image.slice_move(s![..;-1, ..;-1]),
    }
}

/// How pixels inside differ from the mean of the four of their color around them; what is not finite differs by nothing.
fn fine(image: ArrayView2<'_, f32>, lattice: usize) -> Option<Array2<f32>> {
    let (height, width) = image.dim();
    let inside = |n: usize| n.checked_sub(2 * lattice).filter(|&n| n > 0);
    let size = (inside(height)?, inside(width)?);
    Some(Array2::from_shape_fn(size, |(i, j)| {
        let (i, j, l) = (i + lattice, j + lattice, lattice);
        let around = image[[i - l, j]] + image[[i + l, j]] + image[[i, j - l]] + image[[i, j + l]];
        Some(image[[i, j]] - 0.25 * around).filter(|v| v.is_finite()).unwrap_or(0.0)
    }))
}

/// Of values with a mean of about 0; nothing if they have other sizes, or do not vary.
fn correlation(a: ArrayView2<'_, f32>, b: ArrayView2<'_, f32>) -> Option<f32> {
    if a.dim() != b.dim() {
        return None;
    }
    let sum =
        |a: ArrayView2<'_, f32>, b: ArrayView2<'_, f32>| a.iter().zip(b).map(|(a, b)| f64::from(a * b)).sum::<f64>();
    let square = sum(a, a) * sum(b, b);
    (square > 0.0).then(|| (sum(a, b) / square.sqrt()) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array3, Axis};
    use sci_forward::{MaskStack, VideoShape};

    #[test]
    fn masks_that_are_turned_or_inverted_are_named_and_others_are_not() {
        let shape = VideoShape { frames: 6, height: 48, width: 48 };
        let masks = MaskStack::random(shape, 0.4, 5).unwrap();
        let video = Array3::from_shape_fn(shape.dim(), |(t, i, j)| 0.4 + 0.3 * ((t + i + 2 * j) as f32 / 9.0).sin());
        let y = (&masks.view() * &video).sum_axis(Axis(0));
        let open = masks.view().sum_axis(Axis(0));
        for lattice in [1, 2] {
            assert_eq!(doubt(open.view(), y.view(), lattice), None);
            for (turn, said) in
                [(1, "mirrored top to bottom ("), (2, "left to right ("), (4, "with rows and columns exchanged (")]
            {
                let note = doubt(turned(open.view(), turn), y.view(), lattice).unwrap();
                assert!(note.contains(said), "{note}");
            }
            assert!(
                doubt(open.mapv(|open| 6.0 - open).view(), y.view(), lattice).unwrap().contains("they would, inverted")
            );
            // A pixel off, and half of one.
            for by in [1.0, 0.5] {
                let beside = open.slice(s![.., 1..]).mapv(|open| by * open);
                let moved = &beside + &open.slice(s![.., ..47]).mapv(|open| (1.0 - by) * open);
                assert_eq!(doubt(moved.view(), y.slice(s![.., ..47]), lattice), None);
            }
            // Of another camera, even masks, and pictures of a pixel.
            let other = MaskStack::random(shape, 0.4, 6).unwrap().view().sum_axis(Axis(0));
            assert_eq!(doubt(other.view(), y.view(), lattice), None);
            assert_eq!(doubt(Array2::ones((48, 48)).view(), y.view(), lattice), None);
            assert_eq!(doubt(Array2::ones((1, 1)).view(), Array2::ones((1, 1)).view(), lattice), None);
        }
    }
}
