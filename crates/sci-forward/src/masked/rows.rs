//! The operator on one row, a chunk of columns at a time.

use super::MaskSource;
use multiversion::multiversion;
use ndarray::{ArrayView1, ArrayView2, ArrayViewMut1, ArrayViewMut2, s};
use std::borrow::Cow;
use std::ops::Range;

/// Columns that are worked on at a time: a chunk of masks and one of sums stay in the first-level cache.
const CHUNK: usize = 1024;

/// The chunks of a row.
fn chunks(width: usize) -> impl Iterator<Item = Range<usize>> {
    (0..width).step_by(CHUNK).map(move |start| start..(start + CHUNK).min(width))
}

/// `gram = Σ_t c_t²`.
pub(super) fn gram(masks: &impl MaskSource, row: usize, mut gram: ArrayViewMut1<'_, f32>) {
    let (mut c, mut sum) = ([0.0; CHUNK], [0.0; CHUNK]);
    for columns in chunks(gram.len()) {
        let (c, sum) = (&mut c[..columns.len()], &mut sum[..columns.len()]);
        sum.fill(0.0);
        for t in 0..masks.shape().frames {
            masks.fill(t, row, columns.start, c);
            add_product(sum, c, c);
        }
        gram.slice_mut(s![columns]).assign(&ArrayView1::from(&*sum));
    }
}

/// `y = Σ_t c_t x_t`; `x` is `[T, W]`.
pub(super) fn forward(masks: &impl MaskSource, row: usize, x: ArrayView2<'_, f32>, mut y: ArrayViewMut1<'_, f32>) {
    let (mut c, mut sum) = ([0.0; CHUNK], [0.0; CHUNK]);
    for columns in chunks(y.len()) {
        let (c, sum) = (&mut c[..columns.len()], &mut sum[..columns.len()]);
        sum.fill(0.0);
        for (t, x) in x.outer_iter().enumerate() {
            masks.fill(t, row, columns.start, c);
            add_product(sum, c, &packed(x.slice_move(s![columns.clone()])));
        }
        y.slice_mut(s![columns]).assign(&ArrayView1::from(&*sum));
    }
}

/// `x_t = c_t y`; `x` is `[T, W]`.
pub(super) fn adjoint(masks: &impl MaskSource, row: usize, y: ArrayView1<'_, f32>, mut x: ArrayViewMut2<'_, f32>) {
    let y = packed(y);
    let mut c = [0.0; CHUNK];
    for columns in chunks(y.len()) {
        let y = &y[columns.clone()];
        for (t, mut x) in x.outer_iter_mut().enumerate() {
            let mut x = x.slice_mut(s![columns.clone()]);
            match x.as_slice_mut() {
                Some(x) => {
                    masks.fill(t, row, columns.start, x);
                    multiply(x, y);
                }
                None => {
                    let c = &mut c[..y.len()];
                    masks.fill(t, row, columns.start, c);
                    x.iter_mut().zip(&*c).zip(y).for_each(|((x, c), y)| *x = c * y);
                }
            }
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn add_product(sum: &mut [f32], a: &[f32], b: &[f32]) {
    for ((sum, a), b) in sum.iter_mut().zip(a).zip(b) {
        *sum += a * b;
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
pub(super) fn multiply(product: &mut [f32], by: &[f32]) {
    for (product, by) in product.iter_mut().zip(by) {
        *product *= by;
    }
}

/// The numbers as a slice, copied only if they are not one already.
fn packed(row: ArrayView1<'_, f32>) -> Cow<'_, [f32]> {
    match row.to_slice() {
        Some(row) => Cow::Borrowed(row),
        None => Cow::Owned(row.to_vec()),
    }
}
