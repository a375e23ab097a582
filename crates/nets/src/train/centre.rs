//! What the layers are given on average: where a network begins, and what the steps of its weights turn around.

use crate::Result;
use crate::layers::Conv;
use candle_core::{Device, Tensor, Var};

/// Values of one filter.
pub(super) const TAPS: usize = 9;
/// A layer without ReLU that makes fewer channels makes a picture.
const FEWEST_HIDDEN: usize = 16;
/// What a nearly shut ReLU lets through, as part of the mean before it.
const NEARLY_SHUT: f32 = 0.02;
/// By how much of that mean it is opened.
const RAISE: f32 = 0.1;

/// The mean of what a layer is given, around which Muon's steps of its weight turn.
///
/// Behind a ReLU all inputs are positive, so that any step of `W` shifts what the layer makes of them, and often shuts the next ReLU for
/// good. In the coordinates `y = W (x − mean) + b'` no step of `W` does, as with batch norm; the gradient there is `∂W − ∂b meanᵀ`, and
/// a step `ΔW` at the same `b'` takes `b` to `b − ΔW mean`. FFDNet (gray, as in [`muon`](super::muon)) after 2,000 steps: 28.85 dB at
/// σ = 25 on the validation clips, 28.65 without.
///
/// # References
/// Schraudolph, *Centering neural network gradient factors*, in *Neural Networks: Tricks of the Trade*, 1998.
#[derive(Debug, Clone)]
pub(super) struct Centre {
    /// The number of the layer's bias among the variables, if it has one.
    pub bias: Option<usize>,
    /// The mean of each channel that the layer is given.
    pub means: Vec<f32>,
}

impl Centre {
    /// The gradient of a weight `[O, I, 3, 3]` in the coordinates `W (x − mean) + b'`.
    pub(super) fn gradient(&self, of_weight: &[f32], of_bias: &[f32]) -> Vec<f32> {
        let mut around = of_weight.to_vec();
        let filters = of_bias.iter().flat_map(|b| self.means.iter().map(move |mean| b * mean));
        for (filter, b) in around.chunks_exact_mut(TAPS).zip(filters) {
            filter.iter_mut().for_each(|g| *g -= b);
        }
        around
    }

    /// How the bias, by its number, makes up for a weight's step; without one, the step leaves out what would shift the mean.
    pub(super) fn keep(&self, step: &mut [f32]) -> Option<(usize, Vec<f32>)> {
        match self.bias {
            Some(bias) => Some((bias, response(step, &self.means, 1))),
            None => {
                leave_mean_out(step, &self.means);
                None
            }
        }
    }
}

/// `W mean`: what a weight of so many groups makes of the means.
fn response(weight: &[f32], means: &[f32], groups: usize) -> Vec<f32> {
    let inputs = means.len() / groups;
    let outputs = weight.len() / (TAPS * inputs);
    let of_row = |(o, row): (usize, &[f32])| {
        let group = o * groups / outputs;
        let means = &means[group * inputs..][..inputs];
        row.chunks_exact(TAPS).zip(means).map(|(filter, mean)| filter.iter().sum::<f32>() * mean).sum()
    };
    weight.chunks_exact(TAPS * inputs).enumerate().map(of_row).collect()
}

/// Makes `W mean` zero by the least change of a weight of one group; nothing where all means are zero.
fn leave_mean_out(weight: &mut [f32], means: &[f32]) {
    let square = TAPS as f32 * means.iter().map(|mean| mean * mean).sum::<f32>();
    if square < f32::MIN_POSITIVE {
        return;
    }
    let made = response(weight, means, 1);
    for (row, made) in weight.chunks_exact_mut(TAPS * means.len()).zip(made) {
        for (filter, mean) in row.chunks_exact_mut(TAPS).zip(means) {
            filter.iter_mut().for_each(|w| *w -= made * mean / square);
        }
    }
}

/// The variables of a layer.
pub(super) struct Variables<'a> {
    pub weight: &'a Var,
    pub bias: Option<&'a Var>,
}

/// Lets a layer with random weights make nothing of its mean input, so that the ReLU behind it opens for half of what comes: the deeper a
/// layer without batch norm, the larger its mean beside what varies, and the more ReLUs would be shut, or open, for everything.
/// The last layer makes nothing at all, so that the network begins as its residual connections, and what it found at random need not be
/// unlearned. FastDVDnet (gray, 800 steps at 2e-3), PSNR at σ = 25 on the validation clips: 28.85 dB with He's weights as they are,
/// 28.92 with half-open ReLUs, 29.08 with both. Of layers that are `renewed` among others every one without a ReLU is silent.
///
/// # References
/// Mishkin, Matas, *All you need is a good init*, ICLR 2016 (means and variances of a first batch; the variances brought nothing here).
pub(super) fn open(conv: &Conv, means: &[f32], Variables { weight, bias }: Variables<'_>, renewed: bool) -> Result<()> {
    let mut values: Vec<f32> = weight.flatten_all()?.to_vec1()?;
    if !conv.inference().relu && (renewed || weight.dims()[0] < FEWEST_HIDDEN) {
        values.fill(0.0);
        weight.set(&weight.zeros_like()?)?;
    }
    let (var, values) = match bias {
        Some(bias) => {
            let made = response(&values, means, conv.inference().groups);
            (bias, made.into_iter().map(|mean| -mean).collect())
        }
        None => {
            leave_mean_out(&mut values, means);
            (weight, values)
        }
    };
    Ok(var.set(&Tensor::from_vec(values, var.shape(), &Device::Cpu)?)?)
}

/// Raises the biases of ReLUs that are nearly shut, before they are shut for everything: with what their layer is `given` on average, and
/// with what they let through on average, `made`.
///
/// For normal values of mean μ < 0 and deviation s a ReLU lets through 0.02 |μ| on average at μ = −1.5 s, where it is open for 7 %. A tenth
/// of |μ| at a time outpaces what shuts it. Without it a layer at a quarter of the size of FastDVDnet (gray, at a constant 2e-3) was open for
/// 1 % of the pixels after 4,400 steps, with it for 44 % after 3,000 at 1.5e-3.
pub(super) fn hold_open(
    conv: &Conv,
    given: &[f32],
    made: &[f32],
    Variables { weight, bias }: Variables<'_>,
) -> Result<()> {
    let (Some(bias), true) = (bias, conv.inference().relu) else { return Ok(()) };
    let mut biases: Vec<f32> = bias.to_vec1()?;
    let responses = response(&weight.flatten_all()?.to_vec1::<f32>()?, given, conv.inference().groups);
    for ((bias, response), made) in biases.iter_mut().zip(responses).zip(made) {
        let mean = response + *bias;
        if mean < 0.0 && *made < -NEARLY_SHUT * mean {
            *bias -= RAISE * mean;
        }
    }
    Ok(bias.set(&Tensor::from_vec(biases, bias.shape(), &Device::Cpu)?)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Ffdnet, FfdnetLayout, FfdnetSpec, Layers};

    #[test]
    fn the_gradient_around_the_mean_is_that_of_a_layer_without_one() {
        // At one pixel, for one tap: ∂W = Σ g xᵀ over two images, whose mean is m.
        let (g, x, m) = ([0.5, -2.0], [[1.0, 3.0], [2.0, 5.0]], [1.5, 4.0]);
        let of =
            |x: [[f32; 2]; 2]| -> Vec<f32> { (0..2).flat_map(|i| vec![g[0] * x[0][i] + g[1] * x[1][i]; 9]).collect() };
        let centre = Centre { bias: Some(1), means: m.to_vec() };
        assert_eq!(centre.gradient(&of(x), &[g[0] + g[1]]), of(x.map(|x| [x[0] - m[0], x[1] - m[1]])));
    }

    #[test]
    fn a_step_without_a_bias_leaves_the_mean_where_it_was() {
        let (means, other) = ([1.0, 3.0], [3.0, -1.0]);
        let mut step: Vec<f32> = (0..2 * 2 * TAPS).map(|i| ((i * 37) % 11) as f32 - 5.0).collect();
        let beside = response(&step, &other, 1);
        assert!(Centre { bias: None, means: means.to_vec() }.keep(&mut step).is_none());
        assert!(response(&step, &means, 1).iter().all(|made| made.abs() < 1e-4));
        // What is at right angles to the mean stays.
        assert!(response(&step, &other, 1).iter().zip(beside).all(|(now, before)| (now - before).abs() < 1e-4));
        Centre { bias: None, means: vec![0.0; 2] }.keep(&mut step);
        assert!(step.iter().all(|w| w.is_finite()));
    }

    #[test]
    fn only_what_is_nearly_shut_is_raised() {
        let mut net = Ffdnet::random(
            FfdnetSpec { channels: 1, width: 6, depth: 4, layout: FfdnetLayout::Residual { batch_norm: false } },
            1,
        )
        .unwrap();
        let vars = net.make_trainable().unwrap();
        let convs = net.convs();
        let var = |name: String| &vars.iter().find(|(var, _)| *var == name).unwrap().1;
        let (weight, bias) = (var(convs[1].weight_name()), var(convs[1].bias_name()));
        let plain = || bias.to_vec1::<f32>().unwrap();
        // Given nothing, so that the bias is the mean.
        bias.set(&Tensor::new(&[-2f32, -2.0, -2.0, 2.0, 0.0, -1.0], &Device::Cpu).unwrap()).unwrap();
        let hold = |layer: usize| {
            let made = [0.0, 0.03, 0.05, 0.0, 0.0, f32::NAN];
            hold_open(convs[layer], &[0.0; 6], &made, Variables { weight, bias: Some(bias) }).unwrap();
        };
        hold(1);
        assert_eq!(plain(), [-1.8, -1.8, -2.0, 2.0, 0.0, -1.0]);
        // The last layer has no ReLU.
        hold(3);
        assert_eq!(plain(), [-1.8, -1.8, -2.0, 2.0, 0.0, -1.0]);
    }

    #[test]
    fn each_group_has_its_own_means() {
        let weight: Vec<f32> = (1..=4).flat_map(|w| vec![w as f32; TAPS]).collect();
        assert_eq!(response(&weight, &[1.0, 10.0], 2), [9.0, 18.0, 270.0, 360.0]);
        assert_eq!(response(&weight, &[1.0, 10.0], 1), [9.0 + 180.0, 27.0 + 360.0]);
    }
}
