//! Weights between two sets of them.

use crate::Result;
use candle_core::{Device, Tensor, Var};
use std::collections::BTreeMap;

/// Puts `(1 − share) · from + share · to` of each variable into a state of a network; 1 is `to` bit for bit.
///
/// ```
/// use candle_core::{Device, Var};
/// use nets::train::blend;
/// use std::collections::BTreeMap;
///
/// let vars = [("bias".to_owned(), Var::new(&[0f32, 0.0], &Device::Cpu)?)];
/// let mut state = BTreeMap::new();
/// blend(&mut state, &vars, &[vec![1.0, 2.0]], &[vec![3.0, 6.0]], 0.25)?;
/// assert_eq!(state["bias"].to_vec1::<f32>()?, [1.5, 3.0]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// When there are not as many values as a variable has.
///
/// # References
/// Wortsman et al., *Robust fine-tuning of zero-shot models*, CVPR 2022.
pub fn blend(
    state: &mut BTreeMap<String, Tensor>,
    vars: &[(String, Var)],
    from: &[Vec<f32>],
    to: &[Vec<f32>],
    share: f64,
) -> Result<()> {
    let share = share as f32;
    for ((name, var), (from, to)) in vars.iter().zip(from.iter().zip(to)) {
        let blended: Vec<f32> = from.iter().zip(to).map(|(from, to)| (1.0 - share) * from + share * to).collect();
        state.insert(name.clone(), Tensor::from_vec(blended, var.shape(), &Device::Cpu)?);
    }
    Ok(())
}
