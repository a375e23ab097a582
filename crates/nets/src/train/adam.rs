//! Adam with plain f32 state, which a checkpoint can hold bit for bit.

use super::muon;
use crate::Result;
use candle_core::{Device, Tensor, Var};
use rayon::prelude::*;

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPSILON: f64 = 1e-8;

/// Adam without weight decay: `w −= η m̂ / (√v̂ + ε)`, β = 0.9, 0.999, ε = 1e-8; on request with Muon's steps for the
/// kernels between hidden layers: `w −= η 0.2 √max(R, C) U Vᵀ` with `U Σ Vᵀ` the momentum as a matrix `[R, C]`.
///
/// # References
/// Kingma, Ba, *Adam: a method for stochastic optimization*, 2015. Jordan et al., *Muon: An optimizer for hidden layers in
/// neural networks*, 2024.
#[derive(Debug, Clone)]
pub struct Adam {
    vars: Vec<Var>,
    /// Rows and columns of the variables that take Muon's steps.
    matrices: Vec<Option<[usize; 2]>>,
    /// First and second moments of each variable; the second is unused with Muon.
    moments: Vec<(Vec<f32>, Vec<f32>)>,
    steps: u64,
}

impl Adam {
    /// An optimiser of `vars` without history.
    pub fn new(vars: Vec<Var>) -> Self {
        let moments = vars.iter().map(|v| (vec![0.0; v.elem_count()], vec![0.0; v.elem_count()])).collect();
        Self { matrices: vec![None; vars.len()], vars, moments, steps: 0 }
    }

    /// The same with Muon's steps for kernels of at least 16 channels on both sides.
    pub fn with_muon(mut self) -> Self {
        self.matrices = self.vars.iter().map(|var| muon::matrix(var.dims())).collect();
        self
    }

    /// Moves every variable one step against its gradient (plain numbers, a slice for each variable), all gradients
    /// together first shortened to the norm `clip_norm`. Variables without a gradient stay. Returns the norm before that;
    /// nothing moves when it is not finite.
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
        let adam = |w: &mut [f32], m: &mut [f32], v: &mut [f32], g: &[f32]| {
            for (((w, m), v), g) in w.iter_mut().zip(m).zip(v).zip(g) {
                let g = scale * *g;
                *m = b1 * *m + (1.0 - b1) * g;
                *v = b2 * *v + (1.0 - b2) * g * g;
                *w -= rate * *m / (v.sqrt() + epsilon);
            }
        };
        let muon = |w: &mut [f32], m: &mut [f32], g: &[f32], size: [usize; 2]| {
            let decayed = |m: f32, g: f32| muon::decayed(m, scale * g);
            m.iter_mut().zip(g).for_each(|(m, &g)| *m = decayed(*m, g));
            let ahead = m.iter().zip(g).map(|(&m, &g)| decayed(m, g)).collect();
            let step = muon::direction(ahead, size);
            w.iter_mut().zip(step).for_each(|(w, step)| *w -= learning_rate as f32 * step);
        };
        let old = |var: &Var| var.flatten_all()?.to_vec1::<f32>();
        let weights = self.vars.iter().map(old).collect::<candle_core::Result<Vec<_>>>()?;
        let variables = (weights, &mut self.moments, &self.matrices, grads);
        let new: Vec<_> = variables
            .into_par_iter()
            .map(|(mut w, (m, v), matrix, g)| {
                let g = g.as_ref()?;
                match *matrix {
                    Some(size) => muon(&mut w, m, g, size),
                    None => adam(&mut w, m, v, g),
                }
                Some(w)
            })
            .collect();
        for (var, new) in self.vars.iter().zip(new) {
            if let Some(new) = new {
                var.set(&Tensor::from_vec(new, var.shape(), var.device())?)?;
            }
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
