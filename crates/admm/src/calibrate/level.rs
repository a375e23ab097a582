//! The black level and the contrast of masks, from the pixels that masks leave nearly closed.
//!
//! With contrast c, black level b, S = Σ_t C_t of mean k, and u the brightness of a place,
//!
//! ```text
//! y = (S + (1 − c)(k − S)) u + b,    ȳ ≈ k u + b around it
//! ```
//!
//! so that `y − S ȳ/k = (1 − S/k)((1 − c) ȳ + c b)`: where little is open, light that no mask explains is a share of what is around it, or the
//! same everywhere. There the scene's own texture is as little open, so that those pixels, few as they are, tell the two apart; how far pixels
//! are off, by how much is open, is learned from themselves. The error of held-out pixels does not tell: TV itself gains from some.

/// Shares of the usual S between which pixels are as far off as one another.
const STEPS: [f64; 7] = [0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 1.2];
/// Pixels of a step that tell how far it is off; with fewer it is as far as the next.
const LEAST: usize = 16;
/// Rounds of fitting, and of learning how far pixels are off.
const ROUNDS: usize = 4;
/// Pixels that are off by so many times the usual are left out.
const OUTLIER: f64 = 3.0;
/// The median of a normal variable's square, of variance 1.
const MEDIAN_SQUARE: f64 = 0.455;

/// A pixel: how open it is by what is around it, its light and that around it.
pub(super) struct Pixel {
    pub(super) tile: usize,
    pub(super) group: usize,
    /// S over the usual S.
    pub(super) share: f64,
    /// S/S̄.
    pub(super) open: f64,
    pub(super) y: f64,
    pub(super) light: f64,
}

impl Pixel {
    /// How far it is from ȳ S/S̄, and what 1 − c and b c would add to that, by the brightness around.
    pub(super) fn off(&self) -> (f64, [f64; 2]) {
        let closed = 1.0 - self.open;
        ((self.y - self.open * self.light) / self.light, [closed, closed / self.light])
    }

    /// What is left of that with 1 − c and b c.
    pub(super) fn left(&self, found: [f64; 2]) -> f64 {
        let (off, by) = self.off();
        off - by[0] * found[0] - by[1] * found[1]
    }
}

/// What is found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Level {
    /// In units of the mean of |y|.
    pub(super) black: f64,
    /// At most 1.
    pub(super) contrast: f64,
    /// One standard deviation of both.
    pub(super) uncertainty: [f64; 2],
}

/// Least squares of 1 − c and b c, each pixel weighed by how far those of its step are off.
pub(super) fn fit(pixels: &[Pixel]) -> Option<Level> {
    let mut variances: Vec<f64> = (0..=STEPS.len()).map(|step| STEPS[step.min(STEPS.len() - 1)].powi(2)).collect();
    let mut found = [0.0; 2];
    let mut normal = [0.0; 3];
    let mut weights = vec![0.0; pixels.len()];
    for round in 0..ROUNDS {
        for (p, weight) in pixels.iter().zip(&mut weights) {
            let variance = variances[step_of(p)];
            let outlier = round > 0 && p.left(found).powi(2) > OUTLIER.powi(2) * variance;
            *weight = if outlier { 0.0 } else { 1.0 / variance };
        }
        let right;
        (normal, right) = weighted_sums(pixels.iter().zip(weights.iter().copied()));
        found = solve(normal, right)?;
        // Pixels that are closed as they were told cannot be more so.
        if found[0] < 0.0 {
            found = [0.0, right[1] / normal[2]];
        }
        variances = variances_of(pixels, |p| p.left(found));
    }
    // Errors of one tile have a common cause: each tile's pull counts once.
    let mut pulls = vec![[0.0; 2]; super::TILES * super::TILES];
    for (p, weight) in pixels.iter().zip(&weights) {
        let pull = weight * p.left(found);
        let (_, by) = p.off();
        (0..2).for_each(|k| pulls[p.tile][k] += pull * by[k]);
    }
    let moves = pulls.into_iter().map(|pull| solve(normal, pull)).collect::<Option<Vec<_>>>()?;
    let deviation = |k: usize| moves.iter().map(|m| m[k] * m[k]).sum::<f64>().sqrt();
    let contrast = 1.0 - found[0];
    let uncertainty = [deviation(1) / contrast, deviation(0)];
    (contrast > 0.0).then_some(Level { black: found[1] / contrast, contrast, uncertainty })
}

/// The step of a pixel.
fn step_of(pixel: &Pixel) -> usize {
    STEPS.iter().take_while(|step| pixel.share > **step).count()
}

/// How far the pixels of each step are off; at least a thousandth.
fn variances_of(pixels: &[Pixel], left: impl Fn(&Pixel) -> f64) -> Vec<f64> {
    let mut squares = vec![Vec::new(); STEPS.len() + 1];
    pixels.iter().for_each(|p| squares[step_of(p)].push(left(p).powi(2)));
    let mut next = 1.0;
    let mut variances = vec![0.0; squares.len()];
    for (squares, variance) in squares.iter_mut().zip(&mut variances).rev() {
        if squares.len() >= LEAST {
            let middle = squares.len() / 2;
            next = *squares.select_nth_unstable_by(middle, f64::total_cmp).1 / MEDIAN_SQUARE;
        }
        *variance = next.max(1e-6);
    }
    variances
}

/// The left and the right side of the equations of 1 − c and b c, of pixels with their weights.
pub(super) fn weighted_sums<'p>(pixels: impl Iterator<Item = (&'p Pixel, f64)>) -> ([f64; 3], [f64; 2]) {
    pixels.fold(([0.0; 3], [0.0; 2]), |(normal, right), (p, weight)| {
        let (off, [a, b]) = p.off();
        (
            [normal[0] + weight * a * a, normal[1] + weight * a * b, normal[2] + weight * b * b],
            [right[0] + weight * a * off, right[1] + weight * b * off],
        )
    })
}

/// The solution of `[[n₀, n₁], [n₁, n₂]] x = right`.
pub(super) fn solve([a, b, c]: [f64; 3], right: [f64; 2]) -> Option<[f64; 2]> {
    let determinant = a * c - b * b;
    (determinant > 1e-9 * a * c)
        .then(|| [(c * right[0] - b * right[1]) / determinant, (a * right[1] - b * right[0]) / determinant])
}
