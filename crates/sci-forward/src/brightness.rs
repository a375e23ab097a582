//! How bright a scene is, before anything is known of its frames.

use ndarray::{Array2, ArrayView2, Zip};

/// The brightness `[H, W]` of a scene that stands still and is even over a square of `2 radius + 1` pixels around each pixel: the u of
/// `y = u Σ_t C_t` there, by least squares.
///
/// ```text
/// u = Σ y S / Σ S²,   S = Σ_t C_t,   both over the square, as far as it is on the sensor and y is finite
/// ```
///
/// `y` and `open`, which is S, are `[H, W]`; u is in the unit of a frame. Unlike `y / S` it is defined where S is 0 or less, as it is at
/// many pixels of masks of both signs. A square in which S is 0 everywhere says nothing: u is 0 there.
///
/// # Panics
/// If the sizes differ.
///
/// ```
/// use ndarray::array;
/// let u = sci_forward::brightness(array![[1.0, 0.0, -0.5]].view(), array![[2.0, 0.0, -1.0]].view(), 1);
/// assert_eq!(u, array![[0.5, 0.5, 0.5]]);
/// ```
pub fn brightness(y: ArrayView2<'_, f32>, open: ArrayView2<'_, f32>, radius: usize) -> Array2<f32> {
    let product = |of: fn(f32, f32) -> f32| {
        Zip::from(y).and(open).map_collect(|&y, &open| if y.is_finite() { of(y, open) } else { 0.0 })
    };
    let (both, squares) = (product(|y, open| y * open), product(|_, open| open * open));
    let mut u = square_sums(&both, radius);
    // What differences of large sums leave of nothing.
    let nothing = 1e-12 * squares.iter().map(|&s| f64::from(s)).sum::<f64>() as f32;
    u.zip_mut_with(&square_sums(&squares, radius), |u, &s| *u = if s > nothing { *u / s } else { 0.0 });
    u
}

/// Sums over a square around each pixel, what of it is inside.
fn square_sums(image: &Array2<f32>, radius: usize) -> Array2<f32> {
    let (height, width) = image.dim();
    let mut sums = Array2::<f64>::zeros((height + 1, width + 1));
    for i in 0..height {
        for j in 0..width {
            sums[[i + 1, j + 1]] = f64::from(image[[i, j]]) + sums[[i, j + 1]] + sums[[i + 1, j]] - sums[[i, j]];
        }
    }
    Array2::from_shape_fn((height, width), |(i, j)| {
        let (top, left) = (i.saturating_sub(radius), j.saturating_sub(radius));
        let (bottom, right) = ((i + radius + 1).min(height), (j + radius + 1).min(width));
        (sums[[bottom, right]] - sums[[top, right]] - sums[[bottom, left]] + sums[[top, left]]) as f32
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::s;

    #[test]
    fn the_light_of_a_slow_ramp_is_found_whatever_the_signs() {
        let ramp = Array2::from_shape_fn((20, 30), |(i, j)| 0.2 + 0.01 * (i + j) as f32);
        let open = Array2::from_shape_fn((20, 30), |(i, j)| ((i * 7 + j * 5) % 9) as f32 - 4.0);
        let mut y = &ramp * &open;
        y[[5, 5]] = f32::NAN;
        let off =
            (brightness(y.view(), open.view(), 2) - &ramp).slice(s![2..18, 2..28]).fold(0f32, |m, d| m.max(d.abs()));
        assert!(off < 0.02, "{off}");
        assert_eq!(brightness(y.view(), (open * 0.0).view(), 2), ramp * 0.0);
    }
}
