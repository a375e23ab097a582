//! What is solved, and from where.

use crate::{Clipped, DenoiseCx, Denoiser, PerLattice, SolveError, Tv};
use ndarray::{Array3, ArrayView2, ArrayView3, Axis, Zip};
use sci_forward::{DataStep, SensingOperator};

/// One measurement and the operator that made it: `y = H x + noise`.
#[derive(Clone, Copy)]
pub struct Problem<'a> {
    operator: &'a dyn SensingOperator,
    y: ArrayView2<'a, f32>,
    scale: f64,
}

impl<'a> Problem<'a> {
    /// Takes `y` `[H, W]`, on the scale of `Σ_t C_t`.
    ///
    /// # Errors
    /// [`SolveError::Size`] if `y` has not the operator's size, [`SolveError::NotFinite`] if a pixel is NaN or infinite.
    pub fn new(operator: &'a dyn SensingOperator, y: ArrayView2<'a, f32>) -> Result<Self, SolveError> {
        let expected = operator.shape().image_dim();
        if y.dim() != expected {
            return Err(SolveError::Size { what: "measurement", expected: vec_of(expected), found: vec_of(y.dim()) });
        }
        if let Some(((row, column), &value)) = y.indexed_iter().find(|(_, v)| !v.is_finite()) {
            return Err(SolveError::NotFinite { what: "measurement", value, at: vec![row, column] });
        }
        let norm = y.fold(0.0, |s, &v| s + f64::from(v).powi(2)).sqrt();
        // A black measurement has no scale of its own: its residual is taken in units of the full scale.
        let scale = if norm > 0.0 { norm } else { (y.len() as f64).sqrt() };
        Ok(Self { operator, y, scale })
    }

    /// The same problem for a shorter time, which views are not by themselves.
    pub(crate) fn reborrow(&self) -> Problem<'_> {
        Problem { y: self.y.reborrow(), ..*self }
    }

    /// `H`.
    pub fn operator(&self) -> &'a dyn SensingOperator {
        self.operator
    }

    /// The measurement `y` `[H, W]`.
    pub fn y(&self) -> ArrayView2<'a, f32> {
        self.y
    }

    /// What a residual `‖y − H x‖` is divided by: `‖y‖`, or `√(HW)` for a black measurement.
    pub fn scale(&self) -> f64 {
        self.scale
    }
}

fn vec_of((a, b): (usize, usize)) -> Vec<usize> {
    vec![a, b]
}

/// The video that a solver starts from.
#[derive(Debug, Clone, Copy)]
#[non_exhaustive]
pub enum Start<'a> {
    /// Every frame is the static scene that fits `y` best: `y Σ_t C_t / (Σ_t C_t)²`, i.e. `y / Σ_t C_t`.
    /// Pixels that no mask opens get the mean of the others.
    Mean,
    /// `Hᵀ y`, the reference code's start. It is not normalised: values reach about `B²/4`.
    Adjoint,
    /// A given video `[T, H, W]`, for example the result of the previous measurement.
    From(ArrayView3<'a, f32>),
    /// The reference code's warm start: so many iterations of ADMM with a TV prior and γ = 0.01 from `Hᵀ y`, θ clipped to
    /// `[0, 1]`, of which the projection is taken. On a color sensor TV works on the four sub-lattices.
    Tv {
        /// Iterations.
        iterations: usize,
        /// Weight of [`Tv`](crate::Tv).
        weight: f32,
        /// Whether the sensor is a Bayer sensor.
        bayer: bool,
    },
}

impl Start<'_> {
    /// The video `[T, H, W]` to start from.
    ///
    /// # Errors
    /// [`SolveError`] if a given video has the wrong size or is not finite.
    pub fn video(&self, problem: &Problem<'_>) -> Result<Array3<f32>, SolveError> {
        let shape = problem.operator.shape();
        match *self {
            Self::Mean => Ok(mean(problem)),
            Self::Adjoint => Ok(problem.operator.adjoint(problem.y)),
            Self::From(video) => {
                if video.dim() != shape.dim() {
                    let (expected, found) = (shape.dim(), video.dim());
                    let list = |(t, h, w)| vec![t, h, w];
                    return Err(SolveError::Size { what: "start", expected: list(expected), found: list(found) });
                }
                if let Some(((t, i, j), &value)) = video.indexed_iter().find(|(_, v)| !v.is_finite()) {
                    return Err(SolveError::NotFinite { what: "start", value, at: vec![t, i, j] });
                }
                Ok(video.as_standard_layout().into_owned())
            }
            Self::Tv { iterations, weight, bayer: false } => admm_tv(problem, iterations, Clipped(Tv::new(weight))),
            Self::Tv { iterations, weight, bayer: true } => {
                admm_tv(problem, iterations, Clipped(PerLattice::new(Tv::new(weight))))
            }
        }
    }
}

fn admm_tv(problem: &Problem<'_>, iterations: usize, mut tv: impl Denoiser) -> Result<Array3<f32>, SolveError> {
    let mut theta = problem.operator.adjoint(problem.y);
    let mut b = Array3::<f32>::zeros(theta.dim());
    let (mut p, mut x) = (b.clone(), theta.clone());
    for iteration in 0..iterations {
        Zip::from(&mut p).and(&theta).and(&b).par_for_each(|p, &theta, &b| *p = theta + b);
        let step = DataStep { damping: 0.01, ..DataStep::projection(problem.y) };
        problem.operator.data_step(step, p.view(), x.view_mut());
        Zip::from(&mut p).and(&x).and(&b).par_for_each(|z, &x, &b| *z = x - b);
        let cx = DenoiseCx { iteration, ..DenoiseCx::new(0.0) };
        tv.denoise(&cx, p.view().insert_axis(Axis(1)), theta.view_mut().insert_axis(Axis(1)))
            .map_err(|source| SolveError::Denoiser { name: tv.name().into(), iteration, source })?;
        // b ← b − (x − θ) = θ − (x − b).
        Zip::from(&mut b).and(&theta).and(&p).par_for_each(|b, &theta, &z| *b = theta - z);
    }
    Ok(x)
}

fn mean(problem: &Problem<'_>) -> Array3<f32> {
    let shape = problem.operator.shape();
    let open = problem.operator.forward(Array3::ones(shape.dim()).view());
    let gram = problem.operator.gram_diag();
    let measured = || Zip::from(&open).and(problem.y).and(gram);
    let is_open = |open: f32, gram: f32| open > 0.0 && gram > 0.0;
    let (sum, count) = measured().fold((0f64, 0usize), |(sum, count), &open, &y, &gram| {
        if is_open(open, gram) { (sum + f64::from(y / open), count + 1) } else { (sum, count) }
    });
    let fill = (sum / count.max(1) as f64) as f32;
    let frame = measured().map_collect(|&open, &y, &gram| if is_open(open, gram) { y / open } else { fill });
    frame.broadcast(shape.dim()).expect("an image broadcasts over frames").to_owned()
}
