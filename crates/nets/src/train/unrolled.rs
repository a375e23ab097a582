//! The gradient through consecutive iterations of accelerated GAP: a call of the denoiser is taught what helps the calls
//! after it, not only what is near the truth.
//!
//! In color the gradient goes through Menon's demosaicing as if it were Malvar's, its linear neighbour: both correct the mean of the
//! nearest samples by the curvature of the color that was seen, Menon in one direction and Malvar in both.

use super::config::Loss;
use super::iterates::{RecordedCall, Simulated};
use super::step::{Gradients, tensor};
use crate::{Error, Network, Result};
use admm::flipped_axes;
use candle_core::{Tensor, Var};
use ndarray::{Array2, Array3, Array4, ArrayView3, Axis};
use sci_forward::SensingOperator;
use sci_forward::bayer::{Malvar, mosaic_adjoint_into};

/// Consecutive calls of a solver, and the truth.
pub(super) struct Unrolled {
    pub simulated: Simulated,
    pub clean: Tensor,
    pub calls: Vec<RecordedCall>,
}

impl Unrolled {
    /// The weighted mean loss of the results of all calls, each of half the weight of the one after it, as the last is what a
    /// user gets, and its gradient for each of `vars`. Goes backward call by call, each run
    /// again with its graph, so that the memory is that of one.
    pub(super) fn gradient(&self, network: &dyn Network, vars: &[(String, Var)], loss: Loss) -> Result<Gradients> {
        let mut share = 0.5 / (1.0 - 0.5f64.powi(self.calls.len() as i32));
        let mut total = Gradients::zero(vars.len());
        let mut back: Option<Array4<f32>> = None;
        let mut to_momentum = Array2::zeros(self.simulated.measurement().shape().image_dim());
        for call in self.calls.iter().rev() {
            let input = Var::from_tensor(&tensor(call.input.clone())?)?;
            let v = denoised(network, &input, call)?;
            let own = (loss.mean(&(&v - &self.clean)?)? * share)?;
            let objective = match back.take() {
                None => own.clone(),
                Some(upstream) => {
                    let upstream = Tensor::from_vec(upstream.into_raw_vec_and_offset().0, v.shape(), v.device())?;
                    (&own + (v * upstream)?.sum_all()?)?
                }
            };
            let gradients = objective.backward()?;
            total.add_found(own.to_scalar()?, &gradients, vars)?;
            share *= 0.5;
            if let Some(to_input) = gradients.get(&input) {
                let to_input = Array4::from_shape_vec(input.dims4()?, to_input.flatten_all()?.to_vec1()?);
                let to_input = to_input.expect("the gradient has the shape of the input");
                back = Some(self.through_iteration(to_input, &mut to_momentum)?);
            }
        }
        Ok(total)
    }

    /// From the gradient by the input of a call to that by the result of the call before, both `[T, C, H, W]`.
    fn through_iteration(&self, to_input: Array4<f32>, to_momentum: &mut Array2<f32>) -> Result<Array4<f32>> {
        let measurement = self.simulated.measurement();
        let operator = measurement.operator();
        let Some(cfa) = measurement.cfa() else {
            let to_x = to_input.index_axis(Axis(1), 0);
            return Ok(through_projection(operator, to_x, to_momentum).insert_axis(Axis(1)));
        };
        let mut to_x = Array3::zeros(operator.shape().dim());
        Malvar.adjoint(cfa, to_input.view(), to_x.view_mut()).map_err(|e| Error::Data(e.to_string()))?;
        let to_mosaic = through_projection(operator, to_x.view(), to_momentum);
        let mut to_v = to_input;
        mosaic_adjoint_into(cfa, to_mosaic.view(), to_v.view_mut());
        Ok(to_v)
    }
}

/// The result of a call, which sees its input as [`admm::Flips`] turns it.
fn denoised(network: &dyn Network, input: &Tensor, call: &RecordedCall) -> Result<Tensor> {
    let axes: Vec<usize> = flipped_axes(call.iteration).map(|axis| axis.index()).collect();
    Ok(network.forward(&input.flip(&axes)?, &[call.sigma])?.flip(&axes)?)
}

/// From `∂ℓ/∂x` of the iterate and `∂ℓ/∂y1` of the accumulated measurement, both after the data step
///
/// ```text
/// y1 ← y1 + (y − H v);  x ← v + Hᵀ (y1 − H v) / diag(H Hᵀ),
/// ```
///
/// to `∂ℓ/∂v` and `∂ℓ/∂y1` before it: with `q = H ∂x / diag(H Hᵀ)`, `∂y1 ← ∂y1 + q` and `∂v = ∂x − Hᵀ (q + ∂y1)`.
fn through_projection(
    operator: &dyn SensingOperator,
    to_x: ArrayView3<'_, f32>,
    to_y1: &mut Array2<f32>,
) -> Array3<f32> {
    let mut q = operator.forward(to_x);
    // Where no mask is open H is zero, and so is what is divided.
    q.zip_mut_with(&operator.gram(), |q, &d| *q = if d > 0.0 { *q / d } else { 0.0 });
    *to_y1 += &q;
    &to_x - &operator.adjoint((q + &*to_y1).view())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Ffdnet, FfdnetLayout, FfdnetSpec, Layers};
    use admm::Denoiser;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    use super::super::config::IteratesConfig;
    use super::super::step::stack;

    /// Along the gradient in the weights the whole loss changes as it says: through the network, the projection and the
    /// accumulated measurement of every call.
    #[test]
    fn the_gradient_is_that_of_the_whole_loss() {
        let clip = Array4::from_shape_fn((3, 1, 12, 12), |(t, _, y, x)| ((7 * t + 5 * y + 3 * x) % 11) as f32 / 11.0);
        let (slope, norm) = slope_along_gradient(clip);
        assert!((slope - norm).abs() < 0.01 * norm, "slope {slope}, gradient {norm}");
    }

    /// In color the demosaicing's part is an approximation.
    #[test]
    fn the_gradient_in_color_is_near_that_of_the_whole_loss() {
        let wave =
            |t: usize, c: usize, y: usize, x: usize| (0.5 * (t + y) as f32 + 0.3 * x as f32 + 0.7 * c as f32).sin();
        let clip = Array4::from_shape_fn((3, 3, 12, 12), |(t, c, y, x)| 0.5 + 0.3 * wave(t, c, y, x));
        let (slope, norm) = slope_along_gradient(clip);
        assert!((slope - norm).abs() < 0.25 * norm, "slope {slope}, gradient {norm}");
    }

    /// How the loss of three calls changes along its gradient by difference, and the gradient's length.
    fn slope_along_gradient(clip: Array4<f32>) -> (f64, f64) {
        let channels = clip.len_of(Axis(1));
        let spec = FfdnetSpec { channels, width: 8, depth: 3, layout: FfdnetLayout::Residual { batch_norm: false } };
        let mut net = Ffdnet::random(spec, 1).unwrap();
        let settings = IteratesConfig {
            sigmas: vec![40.0, 30.0, 20.0],
            calls: 3,
            unrolled: true,
            start_iterations: 0,
            frames: [3, 3],
            density: [0.5, 0.5],
            gray_masks: 0.0,
            holes: 0.1,
        };
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let simulated = Simulated::random(clip.view(), &settings, &mut rng).unwrap();
        let (clean, vars) = (stack(std::slice::from_ref(&clip)).unwrap(), net.make_trainable().unwrap());

        let loss_at = |net: &mut Ffdnet| -> f64 {
            let mut seen = Vec::new();
            let rng = &mut ChaCha8Rng::seed_from_u64(3);
            let calls = simulated.last_calls(&settings, net as &mut dyn Denoiser, rng).unwrap();
            for call in calls {
                let v = denoised(net, &tensor(call.input.clone()).unwrap(), &call).unwrap();
                let error = (v - &clean).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
                seen.push(error.iter().map(|&e| f64::from(e).powi(2)).sum::<f64>() / error.len() as f64);
            }
            (seen[0] + 2.0 * seen[1] + 4.0 * seen[2]) / 7.0
        };
        let calls = simulated.last_calls(&settings, &mut net, &mut ChaCha8Rng::seed_from_u64(3)).unwrap();
        assert_eq!(calls.len(), 3);
        assert_eq!(calls[0].input.len_of(Axis(0)), 3);
        let before = loss_at(&mut net);
        let unrolled = Unrolled { simulated: simulated.clone(), clean: clean.clone(), calls };
        let found = unrolled.gradient(&net, &vars, Loss::L2).unwrap();
        assert!((f64::from(found.loss) - before).abs() < 1e-5 * before, "{} {before}", found.loss);

        // Along the gradient itself: the change is the length of the gradient times the step.
        let gradients: Vec<Vec<f32>> = found.of_vars.into_iter().map(Option::unwrap).collect();
        let norm = gradients.iter().flatten().map(|&g| f64::from(g).powi(2)).sum::<f64>().sqrt();
        let old: Vec<Vec<f32>> = vars.iter().map(|(_, v)| v.flatten_all().unwrap().to_vec1().unwrap()).collect();
        let at = |step: f64| {
            for (((_, var), old), g) in vars.iter().zip(&old).zip(&gradients) {
                let new: Vec<f32> = old.iter().zip(g).map(|(w, g)| w + (step / norm) as f32 * g).collect();
                var.set(&Tensor::from_vec(new, var.shape(), var.device()).unwrap()).unwrap();
            }
            let state = net.state();
            let mut plain = Ffdnet::random(spec, 1).unwrap();
            plain.set_state(&state).unwrap();
            loss_at(&mut plain)
        };
        ((at(1e-2) - at(-1e-2)) / 2e-2, norm)
    }
}
