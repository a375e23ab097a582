//! The steps of [`Menon`](super::Menon) on one row, for every site of it: who calls takes the results at the sites they are meant
//! for. All slices have the width of the result, unless they are said to be padded.

use crate::bayer::rows::PAD;
use multiversion::multiversion;

/// A row and the neighbours of its sites.
#[derive(Clone, Copy)]
pub(super) struct Cross<'a> {
    pub(super) here: &'a [f32],
    /// To the left and to the right.
    pub(super) beside: [&'a [f32]; 2],
    pub(super) above_and_below: [&'a [f32]; 2],
}

impl<'a> Cross<'a> {
    /// With its lengths in sight of the compiler.
    #[inline(always)]
    fn of_width(self, width: usize) -> Self {
        let cut = |row: &'a [f32]| &row[..width];
        let Self { here, beside, above_and_below } = self;
        Self { here: cut(here), beside: beside.map(cut), above_and_below: above_and_below.map(cut) }
    }
}

/// `a` where `along_row` is 1, else `b`. By their bits: of a choice between two values the compiler makes one read from a chosen
/// place, one at a time.
#[inline(always)]
fn pick(along_row: f32, a: f32, b: f32) -> f32 {
    let mask = if along_row > 0.0 { u32::MAX } else { 0 };
    f32::from_bits(a.to_bits() & mask | b.to_bits() & !mask)
}

/// Green by the 5-tap filter −¼ ½ ½ ½ −¼ of the mosaic itself.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn green(to: &mut [f32], samples: [&[f32]; 5]) {
    let width = to.len();
    let [a, b, c, d, e] = samples.map(|row| &row[..width]);
    for x in 0..width {
        to[x] = 0.5 * (b[x] + c[x] + d[x]) - 0.25 * (a[x] + e[x]);
    }
}

/// How much the difference between the samples and green changes from one place to another: `|(s − g) − (s' − g')|`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn change(to: &mut [f32], here: [&[f32]; 2], there: [&[f32]; 2]) {
    let width = to.len();
    let [sample, green] = here.map(|row| &row[..width]);
    let [sample_there, green_there] = there.map(|row| &row[..width]);
    for x in 0..width {
        to[x] = ((sample[x] - green[x]) - (sample_there[x] - green_there[x])).abs();
    }
}

/// 1 where the changes along the row, summed around a site, are not more than those along the column, else 0. The rows are padded;
/// the last of the column's and the middle one of the row's is the site's own. A change belongs to the site before it, hence the
/// taps behind.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn decide(to: &mut [f32], row_changes: [&[f32]; 5], column_changes: [&[f32]; 3]) {
    let width = to.len();
    let [up2, up1, here, down1, down2] = row_changes.map(|row| &row[..width + 2 * PAD]);
    let [above2, above1, beside] = column_changes.map(|row| &row[..width + 2 * PAD]);
    for x in 0..width {
        let at = |row: &[f32], by: usize| row[x + by];
        let along_row = at(up2, 2)
            + at(up2, 0)
            + at(up1, 1)
            + 3.0 * at(here, 2)
            + 3.0 * at(here, 0)
            + at(down1, 1)
            + at(down2, 2)
            + at(down2, 0);
        let along_column = at(beside, 0)
            + at(above2, 0)
            + at(above1, 1)
            + 3.0 * at(beside, 2)
            + 3.0 * at(above2, 2)
            + at(above1, 3)
            + at(beside, 4)
            + at(above2, 4);
        to[x] = if along_column >= along_row { 1.0 } else { 0.0 };
    }
}

/// [`pick`] along a row.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn select(to: &mut [f32], along_row: &[f32], a: &[f32], b: &[f32]) {
    for (((to, along_row), a), b) in to.iter_mut().zip(along_row).zip(a).zip(b) {
        *to = pick(*along_row, *a, *b);
    }
}

/// Green plus the mean color difference of two neighbours.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn interpolate(to: &mut [f32], green: &[f32], colors: [&[f32]; 2], greens: [&[f32]; 2]) {
    let width = to.len();
    let ([a, b], [green_a, green_b]) = (colors.map(|row| &row[..width]), greens.map(|row| &row[..width]));
    let green = &green[..width];
    for x in 0..width {
        to[x] = green[x] + 0.5 * (a[x] + b[x]) - 0.5 * (green_a[x] + green_b[x]);
    }
}

/// The color seen plus the mean difference to it of the opposite color at the two neighbours in the site's direction.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn opposite(to: &mut [f32], along_row: &[f32], color: Cross<'_>, opposite: Cross<'_>) {
    let width = to.len();
    let (along_row, color, opposite) = (&along_row[..width], color.of_width(width), opposite.of_width(width));
    for x in 0..width {
        let mean = |of: Cross<'_>| {
            let [a, b] = of.beside.map(|row| row[x]);
            let [above, below] = of.above_and_below.map(|row| row[x]);
            0.5 * pick(along_row[x], a + b, above + below)
        };
        to[x] = color.here[x] + mean(opposite) - mean(color);
    }
}

/// `a − smooth(a − b)`, the mean being of three sites in the site's direction.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn refine(to: &mut [f32], along_row: &[f32], a: Cross<'_>, b: Cross<'_>) {
    let width = to.len();
    let (along_row, a, b) = (&along_row[..width], a.of_width(width), b.of_width(width));
    for x in 0..width {
        let [left, right] = [0, 1].map(|k| a.beside[k][x] - b.beside[k][x]);
        let [above, below] = [0, 1].map(|k| a.above_and_below[k][x] - b.above_and_below[k][x]);
        let (before, after) = (pick(along_row[x], left, above), pick(along_row[x], right, below));
        to[x] = a.here[x] - (before + (a.here[x] - b.here[x]) + after) / 3.0;
    }
}

/// Green plus the mean difference to it of a color at two neighbours.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn refine_at_green(to: &mut [f32], green: &[f32], colors: [&[f32]; 2], greens: [&[f32]; 2]) {
    let width = to.len();
    let ([a, b], [green_a, green_b]) = (colors.map(|row| &row[..width]), greens.map(|row| &row[..width]));
    let green = &green[..width];
    for x in 0..width {
        to[x] = green[x] + 0.5 * ((a[x] - green_a[x]) + (b[x] - green_b[x]));
    }
}
