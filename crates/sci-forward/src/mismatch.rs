//! How the masks that modulate the light differ from those that were told.

use crate::{MaskError, MaskStack};
use ndarray::parallel::prelude::*;
use ndarray::{Array2, Array3, ArrayView2, ArrayView3, ArrayViewMut1, ArrayViewMut2, Axis, Zip};

/// What makes the masks on a sensor others than those that were calibrated: they sit elsewhere, are seen at the wrong time, or with
/// less contrast. The default changes nothing.
///
/// ```text
/// moved    S_t(p) = C_t(R⁻¹ (p − centre − shift) / scale + centre)          bilinear, the edge continued
/// blur     S_t ← S_t ∗ Gaussian of this standard deviation                  the edge continued
/// clock    S_t ← (1 − c) S_t + c S_{t−1}   (c < 0: |c| of S_{t+1})          the frame before (after) is still (already) seen
/// contrast S_t ← q S_t + (1 − q) mean(S_t)
/// ends     S_0 ← S_0 + e₀,  S_{B−1} ← S_{B−1} + e₁                          light before the first frame and after the last
/// ```
///
/// with `p` in pixels (row, column). Bilinear interpolation is exact for pixels of a mask that are as large as those of the sensor
/// and move across them.
///
/// ```
/// use ndarray::array;
/// use sci_forward::{MaskMismatch, MaskStack};
///
/// let masks = MaskStack::new(array![[[0.0, 1.0, 0.0, 0.0]]])?;
/// let moved = MaskMismatch { shift: [0.0, 0.5], ..MaskMismatch::default() }.apply(&masks)?;
/// assert_eq!(moved.view(), array![[[0.0, 0.5, 0.5, 0.0]]]);
/// # Ok::<(), sci_forward::MaskError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MaskMismatch {
    /// Down and to the right, in pixels.
    pub shift: [f64; 2],
    /// About the centre, in degrees, from the right down.
    pub rotation: f64,
    /// About the centre; 1 leaves the size.
    pub scale: f64,
    /// Standard deviation of the blur, in pixels, 0 to 16; 0 is none.
    pub blur: f64,
    /// Share of the neighbouring frame, -1 to 1; of the frame before if positive.
    pub clock: f64,
    /// What is left of the differences to a mask's mean; 1 leaves all.
    pub contrast: f64,
    /// Transmittance for light before the first and after the last frame, in units of the masks.
    pub ends: [f64; 2],
}

impl Default for MaskMismatch {
    fn default() -> Self {
        Self { shift: [0.0; 2], rotation: 0.0, scale: 1.0, blur: 0.0, clock: 0.0, contrast: 1.0, ends: [0.0; 2] }
    }
}

impl MaskMismatch {
    /// The masks on the sensor, of those that were told. What becomes negative of masks that are not is 0.
    ///
    /// # Errors
    /// [`MaskError`] if a value is then out of range (a parameter is not finite), or nothing is open.
    pub fn apply(&self, masks: &MaskStack) -> Result<MaskStack, MaskError> {
        let mut moved = self.moved(masks.view());
        if self.blur != 0.0 {
            let weights = gaussian(self.blur.abs().clamp(0.0, MAX_BLUR));
            moved.outer_iter_mut().into_par_iter().for_each(|mut mask| {
                (0..2).for_each(|axis| mask.lanes_mut(Axis(axis)).into_iter().for_each(|lane| smooth(lane, &weights)));
            });
        }
        if self.clock != 0.0 {
            moved = blended(&moved, self.clock as f32);
        }
        if self.contrast != 1.0 {
            let contrast = self.contrast as f32;
            for mut mask in moved.outer_iter_mut() {
                let mean = (mask.iter().map(|&c| f64::from(c)).sum::<f64>() / mask.len() as f64) as f32;
                mask.mapv_inplace(|c| mean + contrast * (c - mean));
            }
        }
        let last = moved.len_of(Axis(0)) - 1;
        for (frame, end) in [0, last].into_iter().zip(self.ends).filter(|(_, end)| *end != 0.0) {
            moved.index_axis_mut(Axis(0), frame).mapv_inplace(|c| c + end as f32);
        }
        if !masks.is_signed() {
            // Not `max`: a NaN is to be refused.
            moved.mapv_inplace(|c| if c < 0.0 { 0.0 } else { c });
        }
        MaskStack::new(moved)
    }

    /// Where the masks that were told reach, of a sensor of `(H, W)` pixels: false where [`MaskMismatch::apply`] has to continue their edge,
    /// by more than a tenth of a pixel. A mask there is a guess.
    ///
    /// ```
    /// use sci_forward::MaskMismatch;
    ///
    /// let moved = MaskMismatch { shift: [0.0, 1.5], ..MaskMismatch::default() };
    /// assert_eq!(moved.reach((1, 4)), ndarray::array![[false, false, true, true]]);
    /// ```
    pub fn reach(&self, (height, width): (usize, usize)) -> Array2<bool> {
        let inside = |v: f64, n: usize| v >= -EDGE && v <= (n - 1) as f64 + EDGE;
        let place = self.place((height, width));
        Array2::from_shape_fn((height, width), |(i, j)| {
            let [y, x] = place(i, j);
            inside(y, height) && inside(x, width)
        })
    }

    /// Where a pixel of the sensor is in the masks that were told, of `(H, W)` pixels.
    fn place(&self, (height, width): (usize, usize)) -> impl Fn(usize, usize) -> [f64; 2] {
        let centre = [height, width].map(|n| (n as f64 - 1.0) / 2.0);
        let (sin, cos) = self.rotation.to_radians().sin_cos();
        let ([sin, cos], shift) = ([sin / self.scale, cos / self.scale], self.shift);
        move |i, j| {
            let (y, x) = (i as f64 - centre[0] - shift[0], j as f64 - centre[1] - shift[1]);
            [cos * y - sin * x + centre[0], sin * y + cos * x + centre[1]]
        }
    }

    fn moved(&self, masks: ArrayView3<'_, f32>) -> Array3<f32> {
        if (self.shift, self.rotation, self.scale) == ([0.0; 2], 0.0, 1.0) {
            return masks.to_owned();
        }
        let mut moved = Array3::zeros(masks.dim());
        moved.outer_iter_mut().into_par_iter().zip(masks.outer_iter()).for_each(|(to, from)| self.move_frame(from, to));
        moved
    }

    fn move_frame(&self, from: ArrayView2<'_, f32>, mut to: ArrayViewMut2<'_, f32>) {
        let (height, width) = from.dim();
        let place = self.place((height, width));
        for (i, mut row) in to.outer_iter_mut().enumerate() {
            for (j, value) in row.iter_mut().enumerate() {
                let [y, x] = place(i, j);
                let (rows, down) = between(y, height);
                let (columns, across) = between(x, width);
                let at = |row: usize| {
                    let [a, b] = columns.map(|column| from[[row, column]]);
                    a + across * (b - a)
                };
                let [above, below] = rows.map(at);
                *value = above + down * (below - above);
            }
        }
    }
}

/// How far beyond its edge a mask is still known well enough, in pixels: a tenth of the difference to a neighbour may be wrong there.
const EDGE: f64 = 0.1;
/// The strongest blur, in pixels.
const MAX_BLUR: f64 = 16.0;

/// The right half of a Gaussian, the middle first, to three standard deviations; with the left half it adds up to 1.
fn gaussian(sigma: f64) -> Vec<f64> {
    let reach = (3.0 * sigma).ceil() as usize;
    let half: Vec<f64> = (0..=reach).map(|d| (-0.5 * (d as f64 / sigma).powi(2)).exp()).collect();
    let sum = 2.0 * half.iter().sum::<f64>() - half[0];
    half.into_iter().map(|weight| weight / sum).collect()
}

/// A row or column blurred, its ends continued.
fn smooth(mut lane: ArrayViewMut1<'_, f32>, weights: &[f64]) {
    let sharp: Vec<f64> = lane.iter().map(|&c| f64::from(c)).collect();
    let last = sharp.len() - 1;
    for (i, value) in lane.iter_mut().enumerate() {
        let beside = |d: usize| sharp[i.saturating_sub(d)] + sharp[(i + d).min(last)];
        let sides: f64 = weights.iter().enumerate().skip(1).map(|(d, weight)| weight * beside(d)).sum();
        *value = (weights[0] * sharp[i] + sides) as f32;
    }
}

/// The pixels on both sides of a position, inside an image side of `n` pixels, and how far it is from the first to the second.
fn between(position: f64, n: usize) -> ([usize; 2], f32) {
    // A position that is not a number becomes 0.
    let position = position.max(0.0).min((n - 1) as f64);
    let first = position as usize;
    ([first, (first + 1).min(n - 1)], (position - first as f64) as f32)
}

/// Each frame with a share of the one before, or after where `clock` is negative. The first (last) stands for what was before (after).
fn blended(masks: &Array3<f32>, clock: f32) -> Array3<f32> {
    let last = masks.len_of(Axis(0)) - 1;
    let mut all = Array3::zeros(masks.dim());
    for (t, mut mask) in all.outer_iter_mut().enumerate() {
        let other = if clock > 0.0 { t.saturating_sub(1) } else { (t + 1).min(last) };
        let (own, other) = (masks.index_axis(Axis(0), t), masks.index_axis(Axis(0), other));
        Zip::from(&mut mask).and(own).and(other).for_each(|c, &own, &other| *c = own + clock.abs() * (other - own));
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::VideoShape;
    use ndarray::{Array2, s};

    fn masks() -> MaskStack {
        MaskStack::random(VideoShape { frames: 3, height: 12, width: 16 }, 0.5, 4).unwrap()
    }

    #[test]
    fn nothing_changes_nothing() {
        assert_eq!(MaskMismatch::default().apply(&masks()).unwrap(), masks());
    }

    #[test]
    fn whole_pixels_move_exactly_and_the_edge_is_continued() {
        let moved = MaskMismatch { shift: [2.0, -1.0], ..MaskMismatch::default() }.apply(&masks()).unwrap();
        assert_eq!(moved.view().slice(s![.., 2.., ..15]), masks().view().slice(s![.., ..10, 1..]));
        assert_eq!(moved.view().slice(s![.., 0, ..15]), masks().view().slice(s![.., 0, 1..]));
    }

    /// A pattern that is linear in both coordinates is turned and scaled exactly.
    #[test]
    fn turning_and_scaling_are_about_the_centre() {
        let plane = |y: f64, x: f64| (20.0 + 0.7 * y - 0.4 * x) as f32;
        let pattern = Array2::from_shape_fn((21, 21), |(i, j)| plane(i as f64 - 10.0, j as f64 - 10.0));
        let masks = MaskStack::new(pattern.insert_axis(Axis(0))).unwrap();
        let turned = MaskMismatch { rotation: 5.0, scale: 1.1, ..MaskMismatch::default() }.apply(&masks).unwrap();
        let (sin, cos) = 5f64.to_radians().sin_cos();
        for (i, j) in [(10, 10), (6, 14), (15, 9)] {
            let (y, x) = (i as f64 - 10.0, j as f64 - 10.0);
            let expected = plane((cos * y - sin * x) / 1.1, (sin * y + cos * x) / 1.1);
            assert!((turned.view()[[0, i, j]] - expected).abs() < 1e-4);
        }
    }

    #[test]
    fn blur_keeps_the_light_and_spreads_it() {
        let mut point = Array3::zeros((1, 31, 31));
        point[[0, 15, 15]] = 1.0;
        let point = MaskStack::new(point).unwrap();
        let blurred = MaskMismatch { blur: 1.5, ..MaskMismatch::default() }.apply(&point).unwrap();
        let view = blurred.view();
        assert!((view.sum() - 1.0).abs() < 1e-5);
        let spread = |axis: usize| {
            view.indexed_iter().map(|(at, &c)| f64::from(c) * ([at.1, at.2][axis] as f64 - 15.0).powi(2)).sum::<f64>()
        };
        assert!((spread(0) - 2.25).abs() < 0.1 && (spread(1) - 2.25).abs() < 0.1, "{} {}", spread(0), spread(1));
    }

    #[test]
    fn masks_reach_as_far_as_they_were_told() {
        assert!(MaskMismatch { shift: [0.05, -0.05], ..MaskMismatch::default() }.reach((5, 6)).iter().all(|r| *r));
        let found = MaskMismatch { shift: [-1.0, 0.4], ..MaskMismatch::default() }.reach((5, 6));
        let expected = Array2::from_shape_fn((5, 6), |(i, j)| i < 4 && j > 0);
        assert_eq!(found, expected);
        assert!(!MaskMismatch { rotation: 1.0, ..MaskMismatch::default() }.reach((100, 100))[[0, 99]]);
    }

    #[test]
    fn clock_contrast_and_ends_are_what_they_say() {
        let masks = MaskStack::new(ndarray::array![[[0.0, 1.0]], [[1.0, 0.0]], [[1.0, 1.0]]]).unwrap();
        let of = |m: MaskMismatch| m.apply(&masks).unwrap().view().to_owned();
        let late = of(MaskMismatch { clock: 0.25, ..MaskMismatch::default() });
        assert_eq!(late, ndarray::array![[[0.0, 1.0]], [[0.75, 0.25]], [[1.0, 0.75]]]);
        let early = of(MaskMismatch { clock: -0.25, ..MaskMismatch::default() });
        assert_eq!(early, ndarray::array![[[0.25, 0.75]], [[1.0, 0.25]], [[1.0, 1.0]]]);
        let flat = of(MaskMismatch { contrast: 0.5, ends: [0.1, 0.2], ..MaskMismatch::default() });
        let expected = ndarray::array![[[0.35, 0.85]], [[0.75, 0.25]], [[1.2, 1.2]]];
        assert!((flat - expected).iter().all(|d: &f32| d.abs() < 1e-6));
    }

    #[test]
    fn what_is_not_a_number_is_refused() {
        let nan = MaskMismatch { contrast: f64::NAN, ..MaskMismatch::default() };
        assert!(matches!(nan.apply(&masks()), Err(MaskError::Value { .. })));
        let closed = MaskMismatch { ends: [-9.0; 2], ..MaskMismatch::default() };
        assert!(
            closed.apply(&MaskStack::random(VideoShape { frames: 1, height: 2, width: 2 }, 1.0, 0).unwrap()).is_err()
        );
    }
}
