//! What the next measurement may take over from the last, decided by the measurement alone.

use ndarray::{Array2, Array3, ArrayView3, Axis, Zip, s};
use sci_forward::Measurement;
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
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Relation {
    /// Of the previous result, arranged as it fits best.
    pub previous: f64,
    /// Of a still image as smooth as a 3×3 mean of the measurement: a start that needs no knowledge of the scene.
    ///
    /// The solvers' own start `y / Σ_t C_t` cannot serve: it explains every measurement without a residual.
    pub still: f64,
    /// Of the best constant: no picture at all.
    pub flat: f64,
}

impl Relation {
    /// `previous / still`: below 1 the previous result is the better start.
    pub fn of_start(&self) -> f64 {
        quotient(self.previous, self.still)
    }

    /// `previous / flat`: a picture of something else explains the measurement worse than none.
    ///
    /// Measured with true frames: at most 1.11 from one measurement to the next in 18 pairs of five scenes with fast
    /// motion, at least 1.30 in all 20 cuts between them.
    pub fn of_scene(&self) -> f64 {
        quotient(self.previous, self.flat)
    }
}

fn quotient(a: f64, b: f64) -> f64 {
    // What is explained exactly was explained well, whatever the other does.
    if a == 0.0 { 0.0 } else { a / b.max(f64::MIN_POSITIVE) }
}

/// From where on the previous result is good for what.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    /// Up to this [`Relation::of_start`] the scene barely changed: fewer iterations and updates.
    pub unchanged: f64,
    /// Up to this [`Relation::of_start`] the previous result takes the place of the normal start.
    pub warm: f64,
    /// Above this [`Relation::of_scene`] the scene was cut: everything begins anew.
    pub cut: f64,
}

impl Default for Similarity {
    fn default() -> Self {
        Self { unchanged: 0.7, warm: 1.0, cut: 1.2 }
    }
}

/// The arrangement of the previous result `[T, H, W]` that fits the new measurement best, and how well it does:
/// as it is, its last frame standing still, or running backwards (the motion goes on from the last frame).
///
/// # Panics
/// If the previous result has not the size of the new one.
pub fn continuation(previous: ArrayView3<'_, f32>, measurement: &Measurement) -> (Array3<f32>, Relation) {
    let operator = measurement.operator();
    let last = previous.index_axis(Axis(0), previous.len_of(Axis(0)) - 1);
    let still_last = last.broadcast(previous.dim()).expect("a frame broadcasts over frames");
    let candidates = [previous, still_last, previous.slice(s![..;-1, .., ..])];
    let (best, previous) = candidates
        .iter()
        .map(|video| (video, relative_residual(measurement, &operator.forward(*video))))
        .min_by(|a, b| a.1.total_cmp(&b.1))
        .expect("there are three candidates");
    let transmitted = operator.forward(Array3::ones(measurement.shape().dim()).view());
    let still = relative_residual(measurement, &still_image(measurement, &transmitted));
    let flat = relative_residual(measurement, &constant_image(measurement, &transmitted));
    (best.as_standard_layout().into_owned(), Relation { previous, still, flat })
}

/// `‖y − H x‖ / ‖y‖` over the open pixels.
fn relative_residual(measurement: &Measurement, hx: &Array2<f32>) -> f64 {
    let y = measurement.y_against(hx.view());
    let open = Zip::from(hx).and(&y).and(measurement.operator().gram());
    let squares = open.fold(0.0, |sum, &hx, &y, &gram| if gram > 0.0 { sum + f64::from(hx - y).powi(2) } else { sum });
    squares.sqrt() / measurement.scale()
}

/// `H` of the smooth still image, `transmitted = a`: `s(p) = Σ_q a(q) y(q) / Σ_q a(q)²` over the 3×3 neighbours q of p (of the same
/// color), `a = Σ_t C_t`, which is the constant that fits y there best in the sense of least squares.
fn still_image(measurement: &Measurement, transmitted: &Array2<f32>) -> Array2<f32> {
    let y = measurement.y();
    let step = if measurement.cfa().is_some() { 2 } else { 1 };
    let (height, width) = y.dim();
    Array2::from_shape_fn(y.dim(), |(i, j)| {
        let (mut above, mut below) = (0f32, 0f32);
        for (di, dj) in (0..9).map(|k| (k / 3, k % 3)) {
            let inside = |at: usize, d: usize, n: usize| (at + d * step).checked_sub(step).filter(|&at| at < n);
            if let (Some(i), Some(j)) = (inside(i, di, height), inside(j, dj, width)) {
                above += transmitted[[i, j]] * y[[i, j]];
                below += transmitted[[i, j]] * transmitted[[i, j]];
            }
        }
        if below > 0.0 { transmitted[[i, j]] * above / below } else { 0.0 }
    })
}

/// `H` of the constant that fits y best in the sense of least squares.
fn constant_image(measurement: &Measurement, transmitted: &Array2<f32>) -> Array2<f32> {
    let (mut above, mut below) = (0f64, 0f64);
    Zip::from(transmitted).and(measurement.y()).for_each(|&a, &y| {
        above += f64::from(a * y);
        below += f64::from(a * a);
    });
    transmitted * (above / below.max(f64::MIN_POSITIVE)) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use sci_forward::testing::moving_square;
    use sci_forward::{MaskOperator, MaskStack, SensingOperator, VideoShape};
    use std::sync::Arc;

    /// The same scene again, brighter than the sensor can tell.
    #[test]
    fn a_result_brighter_than_clipped_pixels_is_no_error() {
        let shape = VideoShape { frames: 4, height: 24, width: 32 };
        let h = MaskOperator::new(MaskStack::random(shape, 0.5, 1).unwrap());
        let truth = moving_square(shape);
        let y = h.forward(truth.view());
        let level = 0.6 * y.iter().copied().fold(0.0, f32::max);
        let clipped = Measurement::new(Arc::new(h), y.mapv(|y| y.min(level))).unwrap().with_clip(Some(level));
        let (_, relation) = continuation(truth.view(), &clipped);
        assert!(relation.previous < 1e-5, "{relation:?}");
    }
}
