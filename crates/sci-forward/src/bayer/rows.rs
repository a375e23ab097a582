//! Mirrored access to the rows of a frame, shared by the demosaicers.

use multiversion::multiversion;
use ndarray::{ArrayView1, ArrayView2, ArrayViewMut1, s};

/// The columns that a row is mirrored by on each side.
pub(super) const PAD: usize = 2;

/// The index within `0..n` that `i` mirrors to, the edge not repeated (−1 → 1, n → n − 2): its parity stays, and so its color.
///
/// # Panics
/// If `n` is less than 2.
///
/// ```
/// use sci_forward::bayer::mirror;
/// assert_eq!([-2, -1, 0, 3, 4, 5].map(|i| mirror(i, 4)), [2, 1, 0, 3, 2, 1]);
/// ```
pub fn mirror(i: isize, n: usize) -> usize {
    assert!(n >= 2, "{n} places cannot be mirrored without repeating the edge");
    if let Ok(inside) = usize::try_from(i)
        && inside < n
    {
        return inside;
    }
    let period = 2 * (n as isize - 1);
    let i = i.rem_euclid(period);
    (if i < n as isize { i } else { period - i }) as usize
}

/// Writes row `r` (which may lie outside the image) to `row`, with [`PAD`] mirrored columns on each side.
fn padded_row(image: ArrayView2<'_, f32>, r: isize, row: &mut [f32]) {
    let (height, width) = image.dim();
    ArrayViewMut1::from(&mut row[PAD..][..width]).assign(&image.row(mirror(r, height)));
    mirror_columns(row);
}

/// Fills the [`PAD`] columns on each side of a row by mirroring those between.
pub(super) fn mirror_columns(row: &mut [f32]) {
    let width = row.len() - 2 * PAD;
    for k in 1..=PAD {
        row[PAD - k] = row[PAD + mirror(-(k as isize), width)];
        row[PAD + width + k - 1] = row[PAD + mirror((width + k - 1) as isize, width)];
    }
}

/// Copies columns `first`, `first + 2`, …; `first` is 0 or 1.
pub(super) fn copy_every_other(mut to: ArrayViewMut1<'_, f32>, from: ArrayView1<'_, f32>, first: usize) {
    match (to.as_slice_mut(), from.as_slice()) {
        (Some(to), Some(from)) if first == 0 => merge::<0>(to, from),
        (Some(to), Some(from)) => merge::<1>(to, from),
        _ => to.slice_mut(s![first..;2]).assign(&from.slice(s![first..;2])),
    }
}

/// [`copy_every_other`] by whole vectors of both rows.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn merge<const FIRST: usize>(to: &mut [f32], from: &[f32]) {
    const LANES: usize = 16;
    let ((to, to_rest), (from, from_rest)) = (to.as_chunks_mut::<LANES>(), from.as_chunks::<LANES>());
    for (to, from) in to.iter_mut().zip(from) {
        for lane in 0..LANES {
            to[lane] = if lane % 2 == FIRST { from[lane] } else { to[lane] };
        }
    }
    for column in (FIRST..to_rest.len()).step_by(2) {
        to_rest[column] = from_rest[column];
    }
}

/// The `2 · PAD + 1` padded rows around a row, moved down a row at a time.
pub(super) struct Window {
    rows: [Vec<f32>; 2 * PAD + 1],
}

impl Window {
    /// The window around row `r`.
    pub(super) fn around(image: ArrayView2<'_, f32>, r: usize) -> Self {
        let rows = std::array::from_fn(|k| {
            let mut row = vec![0.0; image.ncols() + 2 * PAD];
            padded_row(image, (r + k) as isize - PAD as isize, &mut row);
            row
        });
        Self { rows }
    }

    /// Moves on to the row after; `r` is the row that the window is then around.
    pub(super) fn advance(&mut self, image: ArrayView2<'_, f32>, r: usize) {
        self.rows.rotate_left(1);
        padded_row(image, (r + PAD) as isize, &mut self.rows[2 * PAD]);
    }

    /// The five rows, the middle one being the row that the window is around.
    pub(super) fn rows(&self) -> [&[f32]; 2 * PAD + 1] {
        std::array::from_fn(|k| &self.rows[k][..])
    }
}

#[cfg(test)]
mod tests {
    use super::mirror;

    #[test]
    fn mirroring_keeps_the_parity_and_stays_inside() {
        for n in 2..7 {
            for i in -5..12 {
                let m = mirror(i, n);
                assert!(m < n && (m as isize - i) % 2 == 0, "{i} in {n} gives {m}");
            }
        }
        assert_eq!([-1, 5, 6].map(|i| mirror(i, 5)), [1, 3, 2]);
    }
}
