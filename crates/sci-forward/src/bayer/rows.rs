//! Mirrored access to the rows of a frame, shared by the demosaicers.

use ndarray::ArrayView2;

/// The columns that a row is mirrored by on each side.
pub(super) const PAD: usize = 2;

/// The index within `0..n` that `i` mirrors to, the edge not repeated (−1 → 1, n → n − 2): its parity stays, and so its color.
/// `n` is at least 2.
pub(super) fn mirror(i: isize, n: usize) -> usize {
    let period = 2 * (n as isize - 1);
    let i = i.rem_euclid(period);
    (if i < n as isize { i } else { period - i }) as usize
}

/// Writes row `r` (which may lie outside the image) to `row`, with [`PAD`] mirrored columns on each side.
pub(super) fn padded_row(image: ArrayView2<'_, f32>, r: isize, row: &mut [f32]) {
    let (height, width) = image.dim();
    let source = image.row(mirror(r, height).min(height - 1));
    let (left, rest) = row.split_at_mut(PAD);
    let (middle, right) = rest.split_at_mut(width);
    middle.iter_mut().zip(source).for_each(|(to, v)| *to = *v);
    for (k, v) in left.iter_mut().enumerate() {
        *v = source[mirror(k as isize - PAD as isize, width)];
    }
    for (k, v) in right.iter_mut().enumerate() {
        *v = source[mirror((width + k) as isize, width)];
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
