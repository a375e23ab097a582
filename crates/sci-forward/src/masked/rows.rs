//! The operator on one row.

use super::MaskSource;
use multiversion::multiversion;
use ndarray::{ArrayView1, ArrayView2, ArrayViewMut1, ArrayViewMut2};
use std::borrow::Cow;

/// Masks, and room for a row of them.
pub(super) struct Rows<'a, S> {
    source: &'a S,
    room: Vec<f32>,
}

impl<'a, S: MaskSource> Rows<'a, S> {
    pub(super) fn of(source: &'a S) -> Self {
        Self { source, room: vec![0.0; source.shape().width] }
    }

    /// `gram = Σ_t c_t²`.
    pub(super) fn gram(&mut self, row: usize, gram: &mut [f32]) {
        gram.fill(0.0);
        for t in 0..self.source.shape().frames {
            let c = masks(self.source, t, row, &mut self.room);
            add_product(gram, c, c);
        }
    }

    /// `y = Σ_t c_t x_t`; `x` is `[T, W]`.
    pub(super) fn forward(&mut self, row: usize, x: ArrayView2<'_, f32>, mut y: ArrayViewMut1<'_, f32>) {
        match y.as_slice_mut() {
            Some(y) => self.sum_of_products(row, x, y),
            None => {
                let mut sum = vec![0.0; y.len()];
                self.sum_of_products(row, x, &mut sum);
                y.assign(&ArrayView1::from(&sum));
            }
        }
    }

    fn sum_of_products(&mut self, row: usize, x: ArrayView2<'_, f32>, y: &mut [f32]) {
        y.fill(0.0);
        for (t, x) in x.outer_iter().enumerate() {
            let c = masks(self.source, t, row, &mut self.room);
            add_product(y, c, &packed(x));
        }
    }

    /// `x_t = c_t y`; `x` is `[T, W]`.
    pub(super) fn adjoint(&mut self, row: usize, y: ArrayView1<'_, f32>, mut x: ArrayViewMut2<'_, f32>) {
        let y = packed(y);
        for (t, mut x) in x.outer_iter_mut().enumerate() {
            let c = masks(self.source, t, row, &mut self.room);
            match x.as_slice_mut() {
                Some(x) => write_product(x, c, &y),
                None => x.iter_mut().zip(c).zip(&*y).for_each(|((x, c), y)| *x = c * y),
            }
        }
    }
}

/// A row of masks, where it is stored or made in `room`.
fn masks<'a>(source: &'a impl MaskSource, frame: usize, row: usize, room: &'a mut [f32]) -> &'a [f32] {
    if let Some(stored) = source.stored(frame, row) {
        return stored;
    }
    source.fill(frame, row, 0, room);
    room
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn add_product(sum: &mut [f32], a: &[f32], b: &[f32]) {
    for ((sum, a), b) in sum.iter_mut().zip(a).zip(b) {
        *sum += a * b;
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn write_product(to: &mut [f32], a: &[f32], b: &[f32]) {
    for ((to, a), b) in to.iter_mut().zip(a).zip(b) {
        *to = a * b;
    }
}

/// The numbers as a slice, copied only if they are not one already.
fn packed(row: ArrayView1<'_, f32>) -> Cow<'_, [f32]> {
    match row.to_slice() {
        Some(row) => Cow::Borrowed(row),
        None => Cow::Owned(row.to_vec()),
    }
}
