//! The video that a solver starts from.

use crate::{Estimate, Prior, SolveError, Stage};
use ndarray::{Array3, ArrayView3, Zip};
use sci_forward::{Measurement, brightness};

/// The video that a solver starts from.
#[non_exhaustive]
pub enum Start<'a> {
    /// Every frame is the static scene that fits `y` best: `y Σ_t C_t / (Σ_t C_t)²`, i.e. `y / Σ_t C_t`.
    /// Pixels that no mask opens get the mean of the others. Masks of both signs may add up to nothing: then the scene is taken to be even
    /// over some pixels too ([`brightness`]).
    Mean,
    /// `Hᵀ y`, the reference code's start. It is not normalised: values reach about `B²/4`. At clipped pixels it is, `Hᵀ y / diag(H Hᵀ)`: they
    /// say that there was as much light or more, so that nothing would take away what is too much.
    Adjoint,
    /// A given video `[T, H, W]`, for example the result of the previous measurement.
    From(ArrayView3<'a, f32>),
    /// The result of a [`WarmStart`](crate::WarmStart) from `Hᵀ y` with this prior, through one stage. It runs on the same loop, under the
    /// same time limit and observers ([`Observer::warm_start`](crate::Observer::warm_start)), and is given the same pixels.
    Warm {
        /// The prior; with the reference [`Tv`](crate::Tv) of weight 0.1, on a color sensor for each sub-lattice.
        prior: &'a mut dyn Prior,
        /// How long, and with which σ if the prior wants one.
        stage: Stage,
    },
}

impl std::fmt::Debug for Start<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Mean => write!(f, "Mean"),
            Self::Adjoint => write!(f, "Adjoint"),
            Self::From(video) => write!(f, "From({:?})", video.dim()),
            Self::Warm { stage, .. } => write!(f, "Warm({stage:?})"),
        }
    }
}

impl Start<'_> {
    /// Where the first iteration begins; of a warm start its own.
    pub(crate) fn estimate(&self, measurement: &Measurement) -> Result<Estimate, SolveError> {
        let video = match self {
            Self::Mean => mean(measurement),
            Self::Adjoint | Self::Warm { .. } => adjoint(measurement),
            Self::From(video) => given(*video, measurement)?,
        };
        match video.indexed_iter().find(|(_, v)| !v.is_finite()) {
            Some(((t, i, j), &value)) => Err(SolveError::NotFinite { what: "start", value, at: vec![t, i, j] }),
            None => Ok(Estimate::at_sensor(video)),
        }
    }
}

fn given(video: ArrayView3<'_, f32>, measurement: &Measurement) -> Result<Array3<f32>, SolveError> {
    let expected = measurement.shape().dim();
    if video.dim() != expected {
        let list = |(t, h, w)| vec![t, h, w];
        return Err(SolveError::Size { what: "start", expected: list(expected), found: list(video.dim()) });
    }
    Ok(video.as_standard_layout().into_owned())
}

fn adjoint(measurement: &Measurement) -> Array3<f32> {
    let operator = measurement.operator();
    let Some(level) = measurement.clip() else { return operator.adjoint(measurement.y()) };
    let of_pixel = |&y: &f32, &gram: &f32| if y >= level && gram > 0.0 { y / gram } else { y };
    operator.adjoint(Zip::from(measurement.y()).and(operator.gram()).map_collect(of_pixel).view())
}

/// Pixels to each side over which a scene is taken to be even, where a pixel alone says nothing.
const EVEN: usize = 2;

fn mean(measurement: &Measurement) -> Array3<f32> {
    let (shape, operator) = (measurement.shape(), measurement.operator());
    let open = operator.forward(Array3::ones(shape.dim()).view());
    let measured = || Zip::from(&open).and(measurement.y()).and(operator.gram());
    // Of transmittances the square of the sum is never less than the sum of the squares.
    if measured().any(|&open, _, &gram| gram > 0.0 && (open <= 0.0 || open * open < 0.999 * gram)) {
        let frame = brightness(measurement.y(), open.view(), EVEN);
        return frame.broadcast(shape.dim()).expect("an image broadcasts over frames").to_owned();
    }
    let is_open = |open: f32, gram: f32| open > 0.0 && gram > 0.0;
    let (sum, count) = measured().fold((0f64, 0usize), |(sum, count), &open, &y, &gram| {
        if is_open(open, gram) { (sum + f64::from(y / open), count + 1) } else { (sum, count) }
    });
    let fill = (sum / count.max(1) as f64) as f32;
    let frame = measured().map_collect(|&open, &y, &gram| if is_open(open, gram) { y / open } else { fill });
    frame.broadcast(shape.dim()).expect("an image broadcasts over frames").to_owned()
}
