//! Training through the whole solve of the unfolding network.

use super::config::Loss;
use super::iterates::start_prior;
use crate::unfolding::{Progress, Snapshot, UnfoldingNet, phases};
use crate::unrolled::{Gradients, typed};
use crate::{Error, Result};
use admm::{Call, Estimate, Gap, Plan, Prior, PriorError, Stage, Start, run};
use candle_core::{Tensor, Var};
use ndarray::{Array2, Array4, ArrayView3, ArrayView4, s};
use sci_forward::Measurement;

/// A clip and its measurement, and how far its solve has come.
pub(super) struct Exercise {
    pub(super) snapshot: Snapshot,
    /// The frames as phases.
    pub(super) clean: Tensor,
    /// What it was drawn with.
    pub(super) seed: u64,
    pub(super) progress: Option<Progress>,
    /// Iterations after which it is through.
    pub(super) end: usize,
}

impl Exercise {
    /// A clip `[T, C, H, W]` and its measurement, of an RGGB sensor if it is of color: the network is shown other patterns from another first
    /// pixel.
    pub(super) fn new(clip: ArrayView4<'_, f32>, measurement: &Measurement, start_iterations: usize) -> Result<Self> {
        let snapshot = snapshot(measurement, start_iterations)?;
        Ok(Self { snapshot, clean: clean_phases(clip)?, seed: 0, progress: None, end: 0 })
    }

    /// Mean square error of each frame of a result.
    pub(super) fn errors(&self, result: &Tensor) -> Result<Vec<f32>> {
        Ok((result - &self.clean)?.sqr()?.flatten_from(1)?.mean(1)?.to_vec1()?)
    }

    pub(super) fn iterations_done(&self) -> usize {
        self.progress.as_ref().map_or(0, |progress| progress.iterations)
    }

    /// The next `iterations` of the solve, as a graph.
    pub(super) fn unfold(&self, net: &UnfoldingNet, iterations: usize) -> Result<(Vec<Tensor>, Tensor)> {
        net.unfold(&self.snapshot, self.progress.as_ref(), iterations)
    }

    /// Goes on by `iterations`. Returns the weighted mean loss of their results, the k-th with weight k as the last is what a user gets, and
    /// its gradient for each of `vars`; none goes back to iterations before these.
    pub(super) fn advance(
        &mut self,
        net: &UnfoldingNet,
        iterations: usize,
        vars: &[(String, Var)],
        loss: Loss,
    ) -> Result<Gradients> {
        let (results, features) = self.unfold(net, iterations)?;
        let weights = (results.len() * (results.len() + 1) / 2) as f64;
        let mut sum = Tensor::zeros((), self.clean.dtype(), self.clean.device())?;
        for (k, result) in results.iter().enumerate() {
            sum = (sum + (loss.mean(&(result - &self.clean)?)? * ((k + 1) as f64 / weights))?)?;
        }
        let mut found = Gradients::zero(vars.len());
        found.add_found(sum.to_scalar()?, &sum.backward()?, vars)?;
        let iterations = self.iterations_done() + results.len();
        self.progress =
            results.last().map(|result| Progress { iterations, result: result.detach(), features: features.detach() });
        Ok(found)
    }
}

/// A measurement with its x₀: what plain GAP gives a prior first.
fn snapshot(measurement: &Measurement, start_iterations: usize) -> Result<Snapshot> {
    let stage = |iterations| Stage { sigma: None, iterations };
    let mut prior = start_prior(measurement);
    let start = match start_iterations {
        0 => Start::Mean,
        iterations => Start::Warm { prior: &mut *prior, stage: stage(iterations) },
    };
    let begun = run(&mut Gap::plain(Nothing), measurement, start, &Plan::new([stage(1)]), &mut ()).map_err(typed)?;
    // What a sensor that sees 1 everywhere passes on: the mask of each frame.
    let ones = Array2::ones(measurement.y().dim());
    let masks = measurement.operator().adjoint(ones.view());
    Snapshot::new(masks.view(), measurement.y(), begun.estimate.sensor.view())
}

/// A prior that changes nothing.
struct Nothing;

impl Prior for Nothing {
    fn apply(
        &mut self,
        _: &Call<'_>,
        noisy: ArrayView3<'_, f32>,
        out: &mut Estimate,
    ) -> std::result::Result<(), PriorError> {
        out.rgb = None;
        out.sensor.assign(&noisy);
        Ok(())
    }
}

/// `[T, 4 C, H/2, W/2]`.
fn clean_phases(clip: ArrayView4<'_, f32>) -> Result<Tensor> {
    let (t, c, h, w) = clip.dim();
    let planes = clip.to_shape((t * c, h, w)).map_err(|e| Error::Data(e.to_string()))?;
    Ok(phases(planes.view())?.reshape((t, 4 * c, h / 2, w / 2))?)
}

/// The middle of a video `[T, C, H, W]` with sides that are multiples of `multiple`.
pub(super) fn cut(video: &Array4<f32>, multiple: usize) -> Array4<f32> {
    let (_, _, h, w) = video.dim();
    let [h, w] = [h, w].map(|n| n / multiple * multiple);
    video.slice(s![.., .., ..h, ..w]).to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::UnfoldingSpec;
    use crate::train::camera;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use sci_forward::CfaPattern;

    /// Along the gradient in the weights the whole loss changes as it says, through network, shift and projection of every iteration.
    #[test]
    fn the_gradient_is_that_of_the_whole_loss() {
        for channels in [1, 3] {
            let spec = UnfoldingSpec { channels, iterations: 3, widths: [16, 16, 16], depth: 1 };
            let mut net = UnfoldingNet::random(spec, 1).unwrap();
            let (t, h, w) = (6, 16, 8);
            let clip = Array4::from_shape_fn((t, channels, h, w), |(t, c, y, x)| {
                ((7 * t + 5 * y + 3 * x + c) % 11) as f32 / 11.0
            });
            let rng = &mut ChaCha8Rng::seed_from_u64(2);
            let measurement = camera::plain(clip.view(), CfaPattern::Rggb, 0.1, rng).unwrap();
            let exercise = || Exercise::new(clip.view(), &measurement, 2).unwrap();
            let vars = crate::Layers::make_trainable(&mut net).unwrap();
            let mut rng = ChaCha8Rng::seed_from_u64(4);
            for (_, var) in &vars {
                let values: Vec<f32> = (0..var.elem_count()).map(|_| 0.1 * camera::normal(&mut rng)).collect();
                var.set(&Tensor::from_vec(values, var.shape(), var.device()).unwrap()).unwrap();
            }
            let found = exercise().advance(&net, 3, &vars, Loss::L2).unwrap();
            let gradients: Vec<Vec<f32>> = found.of_vars.into_iter().map(Option::unwrap).collect();
            let norm = gradients.iter().flatten().map(|&g| f64::from(g).powi(2)).sum::<f64>().sqrt();
            let old: Vec<Vec<f32>> = vars.iter().map(|(_, v)| v.flatten_all().unwrap().to_vec1().unwrap()).collect();
            let at = |step: f64| {
                for (((_, var), old), g) in vars.iter().zip(&old).zip(&gradients) {
                    let new: Vec<f32> = old.iter().zip(g).map(|(w, g)| w + (step / norm) as f32 * g).collect();
                    var.set(&Tensor::from_vec(new, var.shape(), var.device()).unwrap()).unwrap();
                }
                f64::from(exercise().advance(&net, 3, &vars, Loss::L2).unwrap().loss)
            };
            let slope = (at(2e-3) - at(-2e-3)) / 4e-3;
            assert!((slope - norm).abs() < 0.02 * norm, "slope {slope}, gradient {norm}");
        }
    }
}
