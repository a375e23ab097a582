//! Adam with plain f32 state, which a checkpoint can hold bit for bit.

use crate::Result;
use candle_core::backprop::GradStore;
use candle_core::{Device, Tensor, Var};

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPSILON: f64 = 1e-8;

/// Adam without weight decay: `w −= η m̂ / (√v̂ + ε)`, β = 0.9, 0.999, ε = 1e-8.
///
/// # References
/// Kingma, Ba, *Adam: a method for stochastic optimization*, 2015.
#[derive(Debug, Clone)]
pub struct Adam {
    vars: Vec<Var>,
    /// First and second moments of each variable.
    moments: Vec<(Vec<f32>, Vec<f32>)>,
    steps: u64,
}

impl Adam {
    /// An optimiser of `vars` without history.
    pub fn new(vars: Vec<Var>) -> Self {
        let moments = vars.iter().map(|v| (vec![0.0; v.elem_count()], vec![0.0; v.elem_count()])).collect();
        Self { vars, moments, steps: 0 }
    }

    /// Moves every variable one step against its gradient, all gradients together first shortened to the norm
    /// `clip_norm`. Variables without a gradient stay. Returns the norm before that; nothing moves when it is not finite.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn step(&mut self, grads: &GradStore, learning_rate: f64, clip_norm: f64) -> Result<f64> {
        let grad = |var: &Var| grads.get(var).map(|g| g.flatten_all()?.to_vec1::<f32>()).transpose();
        let grads = self.vars.iter().map(grad).collect::<candle_core::Result<Vec<_>>>()?;
        self.apply(&grads, learning_rate, clip_norm)
    }

    /// [`Adam::step`] with gradients as plain numbers, one slice for each variable.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn apply(&mut self, grads: &[Option<Vec<f32>>], learning_rate: f64, clip_norm: f64) -> Result<f64> {
        let squares = grads.iter().flatten().flatten().map(|&g| f64::from(g) * f64::from(g));
        let norm = squares.sum::<f64>().sqrt();
        if !norm.is_finite() {
            return Ok(norm);
        }
        self.steps += 1;
        let scale = if norm > clip_norm { clip_norm / norm } else { 1.0 } as f32;
        let power = self.steps.min(1 << 30) as i32;
        let (correct1, correct2) = (1.0 - BETA1.powi(power), 1.0 - BETA2.powi(power));
        let rate = (learning_rate * correct2.sqrt() / correct1) as f32;
        let epsilon = (EPSILON * correct2.sqrt()) as f32;
        let (b1, b2) = (BETA1 as f32, BETA2 as f32);
        for ((var, (m, v)), grad) in self.vars.iter().zip(&mut self.moments).zip(grads) {
            let Some(grad) = grad else { continue };
            let mut weights = var.flatten_all()?.to_vec1::<f32>()?;
            for (((w, m), v), g) in weights.iter_mut().zip(m).zip(v).zip(grad) {
                let g = scale * *g;
                *m = b1 * *m + (1.0 - b1) * g;
                *v = b2 * *v + (1.0 - b2) * g * g;
                *w -= rate * *m / (v.sqrt() + epsilon);
            }
            var.set(&Tensor::from_vec(weights, var.shape(), var.device())?)?;
        }
        Ok(norm)
    }

    /// Goes on with the same history for other variables of the same number and sizes.
    ///
    /// # Panics
    /// When they are not.
    pub fn rebind(&mut self, vars: Vec<Var>) {
        let sizes = |vars: &[Var]| vars.iter().map(|v| v.elem_count()).collect::<Vec<_>>();
        assert_eq!(sizes(&vars), sizes(&self.vars), "variables of the same sizes");
        self.vars = vars;
    }

    /// Steps taken.
    pub(super) fn steps(&self) -> u64 {
        self.steps
    }

    /// The moments, in the order and the shapes of the variables.
    pub(super) fn state(&self) -> Result<Vec<(Tensor, Tensor)>> {
        let tensor = |values: &[f32], var: &Var| Tensor::from_slice(values, var.shape(), &Device::Cpu);
        let pairs = self.vars.iter().zip(&self.moments);
        Ok(pairs.map(|(var, (m, v))| Ok((tensor(m, var)?, tensor(v, var)?))).collect::<candle_core::Result<_>>()?)
    }

    pub(super) fn restore(&mut self, steps: u64, moments: Vec<(Vec<f32>, Vec<f32>)>) {
        (self.steps, self.moments) = (steps, moments);
    }
}
