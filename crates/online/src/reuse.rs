//! What the next measurement may take over from the last, decided by the measurement alone.

use crate::Snapshot;
use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis, s};
use serde::{Deserialize, Serialize};

/// What is left of one measurement when the next begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Reuse {
    /// Nothing: pretrained weights and the normal start, so that each result is that of its measurement alone.
    #[default]
    Reset,
    /// The adapted weights, and the result as a start where it fits; unless the scene was cut.
    CarryOver,
}

/// How well the previous result explains the new measurement, as relative residuals `‖y − H x‖ / ‖y‖`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Relation {
    /// Of the previous result, arranged as it fits best.
    pub previous: f64,
    /// Of a still image as smooth as a 3×3 mean of the measurement: what can be said without any knowledge of the scene.
    ///
    /// The solvers' own start `y / Σ_t C_t` cannot serve: it explains every measurement without a residual.
    pub still: f64,
}

impl Relation {
    /// `previous / still`: small when the scene barely changed, 1 when the previous result is worth nothing.
    pub fn ratio(&self) -> f64 {
        // A measurement that a smooth still image explains exactly needs no previous result.
        if self.previous == 0.0 { 0.0 } else { self.previous / self.still.max(f64::MIN_POSITIVE) }
    }
}

/// From which [`Relation::ratio`] on the previous result is good for what.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    /// Up to here the scene barely changed: fewer iterations and updates.
    pub unchanged: f64,
    /// Up to here the previous result is a better start than the normal one.
    pub warm: f64,
    /// Above it the scene was cut: everything begins anew.
    pub cut: f64,
}

impl Default for Similarity {
    fn default() -> Self {
        Self { unchanged: 0.7, warm: 1.0, cut: 1.5 }
    }
}

/// The arrangement of the previous result `[T, H, W]` that fits the new measurement best, and how well it does:
/// as it is, its last frame standing still, or running backwards (the motion goes on from the last frame).
///
/// # Panics
/// If the previous result has not the size of the new one.
pub fn continuation(previous: ArrayView3<'_, f32>, snapshot: &Snapshot) -> (Array3<f32>, Relation) {
    let (y, operator) = (snapshot.y(), snapshot.operator());
    let norm = norm(y).max(f64::MIN_POSITIVE);
    let last = previous.index_axis(Axis(0), previous.len_of(Axis(0)) - 1);
    let still_last = last.broadcast(previous.dim()).expect("a frame broadcasts over frames");
    let candidates = [previous, still_last, previous.slice(s![..;-1, .., ..])];
    let residual = |video: &ArrayView3<'_, f32>| distance(operator.forward(*video).view(), y) / norm;
    let (best, previous) = candidates
        .iter()
        .map(|video| (video, residual(video)))
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .expect("there are three candidates");
    let still = distance(still_image(snapshot).view(), y) / norm;
    (best.as_standard_layout().into_owned(), Relation { previous, still })
}

/// `H` of the smooth still image: `s(p) = Σ_q a(q) y(q) / Σ_q a(q)²` over the 3×3 neighbours q of p (of the same color),
/// `a = Σ_t C_t`, which is the constant that fits y there best in the sense of least squares.
fn still_image(snapshot: &Snapshot) -> Array2<f32> {
    let y = snapshot.y();
    let open = snapshot.operator().forward(Array3::ones(snapshot.shape().dim()).view());
    let step = if snapshot.cfa().is_some() { 2 } else { 1 };
    let (height, width) = y.dim();
    Array2::from_shape_fn(y.dim(), |(i, j)| {
        let (mut above, mut below) = (0f32, 0f32);
        for (di, dj) in (0..9).map(|k| (k / 3, k % 3)) {
            let inside = |at: usize, d: usize, n: usize| (at + d * step).checked_sub(step).filter(|&at| at < n);
            if let (Some(i), Some(j)) = (inside(i, di, height), inside(j, dj, width)) {
                above += open[[i, j]] * y[[i, j]];
                below += open[[i, j]] * open[[i, j]];
            }
        }
        if below > 0.0 { open[[i, j]] * above / below } else { 0.0 }
    })
}

fn norm(y: ArrayView2<'_, f32>) -> f64 {
    y.fold(0.0, |sum, &v| sum + f64::from(v).powi(2)).sqrt()
}

fn distance(a: ArrayView2<'_, f32>, b: ArrayView2<'_, f32>) -> f64 {
    ndarray::Zip::from(a).and(b).fold(0.0, |sum, &a, &b| sum + f64::from(a - b).powi(2)).sqrt()
}
