//! Convolution layers with optional batch norm, and where their tensors come from.

use crate::kernels::{Conv3x3, Link, Precision, conv_chain, layer_by_layer};
use crate::{Error, KeyReport};
use candle_core::{Device, Tensor, Var};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, OnceLock};

/// PyTorch's default, which all published weights were trained with.
const BATCH_NORM_EPSILON: f64 = 1e-5;

/// Which tensors of a network are trained; the statistics of batch norms never are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Parameters {
    /// Filters, biases and the affine part of batch norms.
    #[default]
    All,
    /// Biases of convolutions and of batch norms. Their gradient needs no sums over pairs of channels.
    Biases,
    /// All tensors of the first and the last convolution.
    FirstLast,
    /// All tensors of the last convolution: nothing is propagated through the layers before it.
    Last,
    /// Weight and bias of batch norms.
    NormAffine,
}

/// Batch norm with frozen statistics: `γ (x − mean) / √(var + ε) + β`.
#[derive(Debug, Clone)]
struct BatchNorm {
    name: String,
    gamma: Tensor,
    beta: Tensor,
    mean: Tensor,
    variance: Tensor,
}

/// A 3×3 convolution, batch norm, ReLU; the last two and the bias are optional.
#[derive(Debug, Clone)]
pub struct Conv {
    name: String,
    opts: Conv3x3,
    /// What inference multiplies, whatever `opts` says.
    inference: Precision,
    weight: Tensor,
    bias: Option<Tensor>,
    norm: Option<BatchNorm>,
    /// Set in a layer that is watched: the means of what it was given.
    input_means: Option<Arc<OnceLock<Vec<f32>>>>,
}

/// What a [`Conv`] adds to its products.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Shift {
    Nothing,
    Bias,
    /// Batch norm under this name.
    Norm(String),
}

impl Conv {
    pub(crate) fn new(
        source: &mut Source<'_>,
        name: String,
        (inputs, outputs): (usize, usize),
        opts: Conv3x3,
        shift: Shift,
    ) -> Result<Self, Error> {
        let inputs = inputs / opts.groups;
        // He initialisation keeps the variance through a ReLU; without one there is no half to make up for.
        let gain: f64 = if opts.relu { 2.0 } else { 1.0 };
        let deviation = (gain / (9 * inputs) as f64).sqrt();
        let weight = source.tensor(format!("{name}.weight"), &[outputs, inputs, 3, 3], Init::Normal(deviation))?;
        let bias = match shift {
            Shift::Bias => Some(source.tensor(format!("{name}.bias"), &[outputs], Init::Constant(0.0))?),
            _ => None,
        };
        let norm = match shift {
            Shift::Norm(name) => Some(BatchNorm {
                gamma: source.tensor(format!("{name}.weight"), &[outputs], Init::Constant(1.0))?,
                beta: source.tensor(format!("{name}.bias"), &[outputs], Init::Constant(0.0))?,
                mean: source.tensor(format!("{name}.running_mean"), &[outputs], Init::Constant(0.0))?,
                variance: source.tensor(format!("{name}.running_var"), &[outputs], Init::Constant(1.0))?,
                name,
            }),
            _ => None,
        };
        Ok(Self { name, opts, inference: Precision::F32, weight, bias, norm, input_means: None })
    }

    /// Makes the layer's products zero: it begins as nothing but its bias.
    pub(crate) fn silence(&mut self) -> candle_core::Result<()> {
        self.weight = self.weight.zeros_like()?;
        Ok(())
    }

    /// How inference does the layer.
    pub(crate) fn inference(&self) -> Conv3x3 {
        Conv3x3 { precision: self.inference, ..self.opts }
    }

    /// What the layer multiplies in inference.
    pub(crate) fn set_inference_precision(&mut self, precision: Precision) {
        self.inference = precision;
    }

    /// What the differentiable layer multiplies.
    pub(crate) fn set_precision(&mut self, precision: Precision) {
        self.opts.precision = precision;
    }

    /// Lets the next differentiable pass, which becomes slower, note the means of what the layer is given.
    pub(crate) fn watch(&mut self) {
        self.input_means = Some(Arc::default());
    }

    /// The mean of each channel that the layer was given since [`Conv::watch`], over all images and pixels.
    pub(crate) fn input_means(&self) -> Option<&[f32]> {
        Some(self.input_means.as_ref()?.get()?)
    }

    /// Multiply-adds for each pixel of its result.
    pub(crate) fn multiply_adds(&self) -> f64 {
        self.weight.elem_count() as f64
    }

    /// Whether a tensor is a variable ([`Conv::make_trainable`]), which changes behind the network's back.
    pub(crate) fn is_variable(&self) -> bool {
        let norm = self.norm.iter().flat_map(|norm| [&norm.gamma, &norm.beta]);
        [&self.weight].into_iter().chain(&self.bias).chain(norm).any(|tensor| tensor.is_variable())
    }

    /// Weight and bias with the batch norm folded in: `w γ/√(var+ε)`, `β − mean γ/√(var+ε)`; differentiable, so that
    /// training the affine part costs no pass over the activations.
    pub(crate) fn folded(&self) -> candle_core::Result<(Tensor, Option<Tensor>)> {
        let Some(norm) = &self.norm else { return Ok((self.weight.clone(), self.bias.clone())) };
        let scale = (&norm.gamma / (&norm.variance + BATCH_NORM_EPSILON)?.sqrt()?)?;
        let weight = self.weight.broadcast_mul(&scale.reshape(((), 1, 1, 1))?)?;
        let bias = (&norm.beta - (&norm.mean * &scale)?)?;
        Ok((weight, Some(bias)))
    }

    /// Replaces the batch norm by the equal weight and bias.
    pub(crate) fn fold(&mut self) -> candle_core::Result<()> {
        let (weight, bias) = self.folded()?;
        (self.weight, self.bias, self.norm) = (weight.detach(), bias.map(|b| b.detach()), None);
        Ok(())
    }

    pub(crate) fn weight_name(&self) -> String {
        format!("{}.weight", self.name)
    }

    pub(crate) fn bias_name(&self) -> String {
        format!("{}.bias", self.name)
    }

    /// `(name, tensor, trainable)` of everything in the layer.
    pub(crate) fn tensors_mut(&mut self) -> Vec<(String, &mut Tensor, bool)> {
        let (weight_name, bias_name) = (self.weight_name(), self.bias_name());
        let mut all = vec![(weight_name, &mut self.weight, true)];
        if let Some(bias) = &mut self.bias {
            all.push((bias_name, bias, true));
        }
        if let Some(norm) = &mut self.norm {
            let name = |key| format!("{}.{key}", norm.name);
            all.extend([
                (name("weight"), &mut norm.gamma, true),
                (name("bias"), &mut norm.beta, true),
                (name("running_mean"), &mut norm.mean, false),
                (name("running_var"), &mut norm.variance, false),
            ]);
        }
        all
    }

    /// Makes the trainable tensors variables, or those among them that `which` asks for, and returns them.
    pub(crate) fn make_trainable(&mut self, which: Parameters) -> candle_core::Result<Vec<(String, Var)>> {
        let affine = self.norm.as_ref().map(|norm| ["weight", "bias"].map(|key| format!("{}.{key}", norm.name)));
        let wanted = |name: &String| match which {
            Parameters::All | Parameters::FirstLast | Parameters::Last => true,
            Parameters::Biases => name.ends_with(".bias"),
            Parameters::NormAffine => affine.as_ref().is_some_and(|affine| affine.contains(name)),
        };
        let mut vars = Vec::new();
        for (name, tensor, trainable) in self.tensors_mut() {
            if trainable && wanted(&name) {
                let var = Var::from_tensor(tensor)?;
                *tensor = var.as_tensor().clone();
                vars.push((name, var));
            }
        }
        Ok(vars)
    }
}

/// Layers one after another; differentiable. `(i, earlier)` of `ways`: the result of layer `i` is shuffled onto that of an earlier one.
pub(crate) fn chain(convs: &[Conv], ways: &[(usize, usize)], x: &Tensor) -> candle_core::Result<Tensor> {
    let link = |(i, conv): (usize, &Conv)| {
        let (weight, bias) = conv.folded()?;
        let onto = ways.iter().find(|(layer, _)| *layer == i).map(|(_, earlier)| *earlier);
        Ok(Link { onto, ..Link::new(weight, bias, conv.opts) })
    };
    let links = convs.iter().enumerate().map(link).collect::<candle_core::Result<Vec<_>>>()?;
    if convs.iter().all(|conv| conv.input_means.is_none()) {
        return conv_chain(x, &links);
    }
    layer_by_layer(x, &links, |i, input| {
        if let Some(means) = &convs[i].input_means {
            let of_channels = input.transpose(0, 1)?.flatten_from(1)?.mean(1)?.to_vec1()?;
            // A second pass finds the first one's.
            let _ = means.set(of_channels);
        }
        conv_chain(input, &[Link { onto: None, ..links[i].clone() }])
    })
}

/// How a tensor starts when it is not loaded.
#[derive(Debug, Clone, Copy)]
enum Init {
    Normal(f64),
    Constant(f32),
}

/// Where a network's tensors come from. One pass over the architecture either loads it or initialises it.
pub(crate) enum Source<'a> {
    /// A file's tensors; differences are collected, and reported together by [`Source::finish`].
    Stored { tensors: BTreeMap<String, Tensor>, report: KeyReport },
    /// He initialisation. candle's CPU generator cannot be seeded; this one is.
    Random(&'a mut ChaCha8Rng),
}

impl Source<'_> {
    pub(crate) fn stored(tensors: BTreeMap<String, Tensor>) -> Self {
        Self::Stored { tensors, report: KeyReport::default() }
    }

    fn tensor(&mut self, name: String, shape: &[usize], init: Init) -> Result<Tensor, Error> {
        match self {
            Self::Random(rng) => {
                let count = shape.iter().product();
                let values = match init {
                    Init::Constant(value) => vec![value; count],
                    Init::Normal(deviation) => {
                        let normal = |_| (deviation * Distribution::<f64>::sample(&StandardNormal, *rng)) as f32;
                        (0..count).map(normal).collect()
                    }
                };
                Ok(Tensor::from_vec(values, shape, &Device::Cpu)?)
            }
            Self::Stored { tensors, report } => {
                match tensors.remove(&name) {
                    Some(tensor) if tensor.dims() == shape => return Ok(tensor),
                    Some(tensor) => report.mismatched.push((name, shape.to_vec(), tensor.dims().to_vec())),
                    None => report.missing.push(name),
                }
                // A placeholder, one number long: `finish` will refuse the whole.
                Ok(Tensor::new(0f32, &Device::Cpu)?.broadcast_as(shape)?)
            }
        }
    }

    /// Refuses tensors that were missing, of another shape, or left over.
    pub(crate) fn finish(self, path: &Path, network: &str) -> Result<(), Error> {
        let Self::Stored { tensors, mut report } = self else { return Ok(()) };
        report.unexpected = tensors.into_keys().filter(|name| !name.ends_with("num_batches_tracked")).collect();
        if report.is_empty() {
            Ok(())
        } else {
            Err(Error::Keys { path: path.to_owned(), network: network.to_owned(), keys: report })
        }
    }
}
