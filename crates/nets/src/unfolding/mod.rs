//! The deep unfolding network: a prior that knows the measurement. A few iterations of projection onto the measurement and a
//! small U-shaped network in turn, trained as one.
//!
//! ```text
//! v₋₁ = y / Σ_t C_t in every frame,  x₀ = a few iterations of TV, which cost next to nothing
//! v_k, h_k = network_k(x_k, x_k − v_{k−1}, h_{k−1};  y / Σ C, C_t, Σ C),      x_{k+1} = v_k + Hᵀ (y − H v_k) / Σ_t C_t²
//! ```
//!
//! The network is a [`UnetSpec`] body; it adds to its estimate, and begins silent, so that the untrained solve is plain projection.
//! Features `h` go from each iteration to the next. Color frames leave the network as RGB, though it is shown the mosaic
//! alone: there is no demosaicing beside it.
//!
//! # References
//! Zhang, Ghanem, *ISTA-Net*, CVPR 2018, and Meng, Jalali, Yuan, *GAP-net for snapshot compressive imaging*, 2020 (unfolding).

mod snapshot;
#[cfg(test)]
mod tests;

use snapshot::Shown;
pub(crate) use snapshot::{Progress, Snapshot, phases};

use crate::infer::{Cache, channel_row, set_channel};
use crate::kernels::Blocked;
use crate::layers::{Conv, Source};
use crate::network::{Layers, reflect};
use crate::shift_unet::{self, MULTIPLE, PHASES, UnetSpec};
use crate::weights::{Architecture, WeightFile};
use crate::{Error, Result};
use admm::{Call, Estimate, Prior, PriorError};
use candle_core::Tensor;
use ndarray::{Array2, Array4, ArrayView2, ArrayView3, Axis};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sci_forward::CfaPattern;

/// Images beside the estimate that the network is shown: what the projection changed, y / Σ C, the mask, Σ C, and y / Σ C behind the mask.
const BESIDE: usize = 5;
/// Where an RGGB sensor samples the phases `[3 · 4]` of an RGB frame.
const SITES: [usize; PHASES] = [0, 5, 6, 11];

/// The size of an [`UnfoldingNet`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct UnfoldingSpec {
    /// Colors of a frame: 1, or 3 for an RGB video behind a Bayer sensor.
    pub channels: usize,
    /// Iterations with weights of their own, 1 to 32; all further ones have those of the last.
    pub iterations: usize,
    /// Channels at a half, a quarter and an eighth of the size: multiples of 16 up to 512.
    pub widths: [usize; 3],
    /// Residual blocks at an eighth of the size; there are two at the other sizes. 1 to 16.
    pub depth: usize,
}

impl UnfoldingSpec {
    pub(crate) fn recognise(file: &WeightFile) -> Option<Self> {
        let (outputs, widths, depth) = UnetSpec::recognise(file, "iteration0.")?;
        let iterations = (0..).take_while(|k| file.shape(&format!("iteration{k}.input.weight")).is_some()).count();
        Some(Self { channels: outputs / PHASES, iterations, widths, depth })
    }

    pub(crate) fn validate(self) -> Result<Self> {
        let bad =
            |key, value: usize, legal: &str| Err(Error::Setting { key, value: value.to_string(), legal: legal.into() });
        match self {
            Self { channels, .. } if channels != 1 && channels != 3 => bad("channels", channels, "1 (gray) or 3 (RGB)"),
            Self { iterations, .. } if !(1..=32).contains(&iterations) => bad("iterations", iterations, "1 to 32"),
            spec => spec.body().validate().map(|()| spec),
        }
    }

    /// What is done in an iteration.
    fn body(self) -> UnetSpec {
        let ends = (PHASES * (self.channels + BESIDE), PHASES * self.channels);
        UnetSpec { ends, widths: self.widths, depth: self.depth }
    }

    /// Multiply-adds for each pixel of each frame, over all iterations.
    pub fn multiply_adds(self) -> f64 {
        self.body().multiply_adds() * self.iterations as f64
    }
}

impl std::fmt::Display for UnfoldingSpec {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let colors = if self.channels == 1 { "gray" } else { "color" };
        let ([a, b, c], n) = (self.widths, self.iterations);
        write!(f, "unfolding network ({colors}, {n} iterations, {a}/{b}/{c} channels, depth {})", self.depth)
    }
}

/// The middle of the range of frames, which is taken off what the network is shown.
const GRAY: f32 = 0.5;

/// The network.
#[derive(Debug, Clone)]
pub struct UnfoldingNet {
    spec: UnfoldingSpec,
    /// Of all iterations, in the order in which they are done.
    convs: Vec<Conv>,
    cache: Cache,
}

impl UnfoldingNet {
    /// Takes the weights of a file that has been read.
    ///
    /// # Errors
    /// When the weights are of another network, or do not fit together.
    pub fn from_weights(file: WeightFile) -> Result<Self> {
        match file.architecture()? {
            Architecture::Unfolding(spec) => {
                let path = file.path().to_owned();
                let mut source = Source::stored(file.into_tensors());
                let net = Self::build(spec.validate()?, &mut source)?;
                source.finish(&path, &spec.to_string())?;
                Ok(net)
            }
            other => Err(Error::wrong_architecture(file.path(), "the unfolding network", other)),
        }
    }

    /// An untrained network, the same for the same seed; its result is its input.
    ///
    /// # Errors
    /// [`Error::Setting`] for a size out of range.
    pub fn random(spec: UnfoldingSpec, seed: u64) -> Result<Self> {
        let mut net = Self::build(spec.validate()?, &mut Source::Random(&mut ChaCha8Rng::seed_from_u64(seed)))?;
        for k in 0..spec.iterations {
            let layers = net.iteration(k);
            spec.body().silence(&mut net.convs[layers])?;
        }
        Ok(net)
    }

    fn build(spec: UnfoldingSpec, source: &mut Source<'_>) -> Result<Self> {
        let iteration = |k| spec.body().build(source, &format!("iteration{k}."));
        let convs = (0..spec.iterations).map(iteration).collect::<Result<Vec<_>>>()?.concat();
        Ok(Self { spec, convs, cache: Cache::default() })
    }

    /// The layers of an iteration; those after the last have its.
    fn iteration(&self, k: usize) -> std::ops::Range<usize> {
        let each = self.convs.len() / self.spec.iterations;
        let first = each * k.min(self.spec.iterations - 1);
        first..first + each
    }

    /// Its size.
    pub fn spec(&self) -> UnfoldingSpec {
        self.spec
    }

    /// `iterations` of the solve as a differentiable function of the weights, from `progress` on: the result of each, all as phases
    /// `[T, 4 C, H/2, W/2]`, and the features of the last.
    pub(crate) fn unfold(
        &self,
        snapshot: &Snapshot,
        progress: Option<&Progress>,
        iterations: usize,
    ) -> Result<(Vec<Tensor>, Tensor)> {
        let mut results: Vec<Tensor> = Vec::new();
        let mut before = progress.map(|p| p.result.clone());
        let mut features = progress.map(|p| p.features.clone());
        let first = progress.map_or(0, |p| p.iterations);
        for k in first..first + iterations.max(1) {
            let (x, sensor) = match &before {
                None => (snapshot.start.clone(), snapshot.mean.clone()),
                Some(v) => {
                    let sensor = self.sensor(v)?;
                    (snapshot.project(&sensor)?, sensor)
                }
            };
            let base = self.base(&x, before.as_ref())?;
            let shown = Tensor::cat(&[&(&base - f64::from(GRAY))?, &(&x - &sensor)?, &snapshot.beside], 1)?;
            let (convs, frames) = (&self.convs[self.iteration(k)], shown.dim(0)?);
            let (found, h) = self.spec.body().forward(convs, &shown, features.take(), frames)?;
            let v = (base + found)?;
            before = Some(v.clone());
            features = Some(h);
            results.push(v);
        }
        let features = features.ok_or_else(|| Error::Data("a solve of no iterations".to_owned()))?;
        Ok((results, features))
    }

    /// What the network adds to: the iterate, in color the last result with the iterate where the sensor samples it; at first
    /// the nearest samples of each color.
    fn base(&self, x: &Tensor, last: Option<&Tensor>) -> candle_core::Result<Tensor> {
        if self.spec.channels == 1 {
            return Ok(x.clone());
        }
        let [r, g, h, b] = [0, 1, 2, 3].map(|phase| x.narrow(1, phase, 1));
        let (r, g, h, b) = (r?, g?, h?, b?);
        match last {
            None => {
                let mean = ((&g + &h)? * 0.5)?;
                Tensor::cat(&[&r, &r, &r, &r, &mean, &g, &h, &mean, &b, &b, &b, &b], 1)
            }
            Some(v) => Tensor::cat(&[&r, &v.narrow(1, 1, 4)?, &g, &h, &v.narrow(1, 7, 4)?, &b], 1),
        }
    }

    /// What the sensor sees of frames.
    fn sensor(&self, v: &Tensor) -> candle_core::Result<Tensor> {
        if self.spec.channels == 1 {
            return Ok(v.clone());
        }
        let sites = SITES.map(|site| v.narrow(1, site, 1)).into_iter().collect::<candle_core::Result<Vec<_>>>()?;
        Tensor::cat(&sites, 1)
    }
}

impl Layers for UnfoldingNet {
    fn describe(&self) -> String {
        self.spec.to_string()
    }

    fn channels(&self) -> usize {
        self.spec.channels
    }

    /// Of one iteration.
    fn multiply_adds(&self) -> f64 {
        self.spec.multiply_adds() / self.spec.iterations as f64
    }

    fn convs(&self) -> Vec<&Conv> {
        self.convs.iter().collect()
    }

    fn convs_mut(&mut self) -> Vec<&mut Conv> {
        self.cache.forget();
        self.convs.iter_mut().collect()
    }
}

/// A solve in progress: the measurement, and what the network keeps from iteration to iteration.
#[derive(Debug)]
pub struct Unfolding {
    shown: Shown,
    lattice: Lattice,
    /// The last result `[T, C, H, W]`; before the first, `C` times y / Σ C in each frame.
    last: Array4<f32>,
    /// Of each frame, at half the size.
    features: Vec<Blocked>,
    iteration: usize,
}

impl Unfolding {
    /// The last result `[T, C, H, W]`.
    pub fn frames(&self) -> &Array4<f32> {
        &self.last
    }

    /// What the sensor sees of a pixel of the last result.
    fn sensor(&self, t: usize, y: usize, x: usize) -> f32 {
        self.last[[t, self.lattice.color(y, x).min(self.last.len_of(Axis(1)) - 1), y, x]]
    }

    /// What the network adds to, from the iterate.
    fn base(&self, iterate: ArrayView3<'_, f32>) -> Array4<f32> {
        let at = |t: usize, [y, x]: [usize; 2]| iterate[[t, y, x]];
        let (lattice, colors) = (&self.lattice, self.last.len_of(Axis(1)));
        Array4::from_shape_fn(self.last.dim(), |(t, c, y, x)| match self.iteration {
            _ if colors == 1 || lattice.color(y, x) == c => at(t, [y, x]),
            0 if c == 1 => 0.5 * (at(t, lattice.beside([y, x], 1)) + at(t, lattice.beside([y, x], 2))),
            0 => at(t, lattice.beside([y, x], 3 * c / 2)),
            _ => self.last[[t, c, y, x]],
        })
    }
}

/// How an image lies among its phases: an RGGB sensor's first pixel is a red one, for others a row or column is put before; the sides are
/// continued to multiples of [`MULTIPLE`]. Mirrored, so that the colors stay what they are.
#[derive(Debug)]
struct Lattice {
    size: [usize; 2],
    /// Rows and columns put before.
    before: [usize; 2],
    /// Which pixel each continued row, and column, is.
    sources: [Vec<usize>; 2],
}

impl Lattice {
    fn new(size: [usize; 2], cfa: Option<CfaPattern>) -> Self {
        let red =
            |cfa: CfaPattern| (0..2).flat_map(|y| [[y, 0], [y, 1]]).find(|&[y, x]| cfa.color_at(y, x) as usize == 0);
        // A red pixel at (1, 1) is at (2, 2) after a row and a column.
        let before = cfa.and_then(red).unwrap_or([0, 0]);
        let sources = [0, 1].map(|axis| {
            let n = (before[axis] + size[axis]).next_multiple_of(MULTIPLE);
            (0..n).map(|i| reflect(i as isize - before[axis] as isize, size[axis])).collect()
        });
        Self { size, before, sources }
    }

    /// The color that an RGGB sensor has at a pixel.
    fn color(&self, y: usize, x: usize) -> usize {
        (y + self.before[0]) % 2 + (x + self.before[1]) % 2
    }

    /// The pixel of a phase in the quad of a pixel.
    fn beside(&self, [y, x]: [usize; 2], phase: usize) -> [usize; 2] {
        let quad = |i: usize, axis: usize, offset: usize| self.sources[axis][(i + self.before[axis]) / 2 * 2 + offset];
        [quad(y, 0, phase / 2), quad(x, 1, phase % 2)]
    }

    /// Sides of an image of one phase.
    fn half(&self) -> [usize; 2] {
        [0, 1].map(|axis| self.sources[axis].len() / 2)
    }

    /// Writes an image, pixel by pixel, into the four channels of its phases from `channel`.
    fn write(&self, image: &mut Blocked, channel: usize, value: impl Fn(usize, usize) -> f32) {
        for phase in 0..PHASES {
            let columns = || self.sources[1].iter().skip(phase % 2).step_by(2);
            set_channel(image, channel + phase, |y| {
                let y = self.sources[0][2 * y + phase / 2];
                let value = &value;
                columns().map(move |&x| value(y, x))
            });
        }
    }

    /// Adds the image in the four channels of its phases from `channel`.
    fn add(&self, image: &Blocked, channel: usize, mut to: ndarray::ArrayViewMut2<'_, f32>) {
        let [h, w] = self.size;
        for (phase, y) in (0..PHASES).flat_map(|phase| (0..self.half()[0]).map(move |y| (phase, y))) {
            let Some(row) = (2 * y + phase / 2).checked_sub(self.before[0]).filter(|&row| row < h) else { continue };
            for (x, found) in channel_row(image, channel + phase, y).enumerate() {
                if let Some(column) = (2 * x + phase % 2).checked_sub(self.before[1]).filter(|&column| column < w) {
                    to[[row, column]] += found;
                }
            }
        }
    }
}

impl UnfoldingNet {
    /// Begins the solve of a measurement `[H, W]` through masks `[T, H, W]`; the pattern is that of the sensor of a color video, which a network
    /// for gray does not look at.
    ///
    /// # Errors
    /// [`Error::Shape`] when the sizes differ or are zero, [`Error::Setting`] when a network for color is given no pattern.
    pub fn begin(
        &self,
        masks: ArrayView3<'_, f32>,
        y: ArrayView2<'_, f32>,
        cfa: Option<CfaPattern>,
    ) -> Result<Unfolding> {
        let (t, h, w) = masks.dim();
        if y.dim() != (h, w) || masks.is_empty() {
            let (expected, found) = (vec![h.max(1), w.max(1)], y.shape().to_vec());
            return Err(Error::Shape { what: "a measurement", expected, found });
        }
        if self.spec.channels == 3 && cfa.is_none() {
            let legal = "given for a network of color".to_owned();
            return Err(Error::Setting { key: "cfa", value: "none".to_owned(), legal });
        }
        let shown = Shown::new(masks, y);
        let last = Array4::from_shape_fn((t, self.spec.channels, h, w), |(_, _, y, x)| shown.mean[[y, x]]);
        let lattice = Lattice::new([h, w], cfa.filter(|_| self.spec.channels == 3));
        Ok(Unfolding { shown, lattice, last, features: Vec::new(), iteration: 0 })
    }

    /// The next iteration from the iterate `x [T, H, W]`, without gradients; those after the last are done as the last. The result is
    /// [`Unfolding::frames`].
    ///
    /// # Errors
    /// [`Error::Shape`] when `x` is of another size than the masks.
    pub fn advance(&mut self, solve: &mut Unfolding, x: ArrayView3<'_, f32>) -> Result<()> {
        if x.dim() != solve.shown.masks.dim() {
            let expected = solve.shown.masks.shape().to_vec();
            return Err(Error::Shape { what: "an iterate", expected, found: x.shape().to_vec() });
        }
        let layers = self.iteration(solve.iteration);
        let (body, convs) = (self.spec.body(), self.convs.iter().collect::<Vec<_>>());
        let (shuffled, plain) = body.results(self.spec.iterations);
        let engine = self.cache.engine(&convs, &shuffled, &plain)?;
        let [half_h, half_w] = solve.lattice.half();
        engine.start(half_h, half_w);
        let mut base = solve.base(x);
        let mut features = std::mem::take(&mut solve.features).into_iter();
        let mut h = Vec::with_capacity(x.len_of(Axis(0)));
        for t in 0..x.len_of(Axis(0)) {
            let mut shown = engine.image(body.ends.0, half_h, half_w);
            show(&mut shown, solve, x, &base, t);
            let mut begun = engine.conv(layers.start, &shown)?;
            engine.recycle(shown);
            if let Some(before) = features.next() {
                shift_unet::add(&mut begun, &before);
                engine.recycle(before);
            }
            h.push(begun);
        }
        let h = body.between(engine, layers.start, h)?;
        for (h, mut frame) in h.iter().zip(base.outer_iter_mut()) {
            let found = engine.conv(layers.end - 1, h)?;
            frame.outer_iter_mut().enumerate().for_each(|(c, plane)| solve.lattice.add(&found, PHASES * c, plane));
            engine.recycle(found);
        }
        (solve.last, solve.features) = (base, h);
        solve.iteration += 1;
        Ok(())
    }
}

/// The network as the prior of plain GAP, from the start that it was trained from (the shipped ones: `Start::Warm` with 20 iterations of
/// TV): one iteration of the network in each of the solver's. A solve that begins anew (iteration
/// 0) begins with its own measurement.
#[derive(Debug)]
pub struct UnfoldingPrior {
    net: UnfoldingNet,
    solve: Option<Unfolding>,
}

impl UnfoldingPrior {
    /// Around a network.
    pub fn new(net: UnfoldingNet) -> Self {
        Self { net, solve: None }
    }

    /// The network.
    pub fn network(&self) -> &UnfoldingNet {
        &self.net
    }

    fn advance(&mut self, call: &Call<'_>, noisy: ArrayView3<'_, f32>) -> Result<&Unfolding> {
        let solve = match self.solve.take() {
            Some(solve) if call.iteration > 0 => solve,
            _ => {
                let Some(measurement) = call.measurement else {
                    let what = format!("{} needs the measurement, which it is not shown here", self.net.describe());
                    return Err(Error::Data(what));
                };
                // What a sensor that sees 1 everywhere passes on: the mask of each frame.
                let ones = Array2::ones(measurement.y().dim());
                self.net.begin(
                    measurement.operator().adjoint(ones.view()).view(),
                    measurement.y(),
                    measurement.cfa(),
                )?
            }
        };
        let solve = self.solve.insert(solve);
        self.net.advance(solve, noisy)?;
        Ok(solve)
    }
}

impl Prior for UnfoldingPrior {
    fn apply(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView3<'_, f32>,
        out: &mut Estimate,
    ) -> std::result::Result<(), PriorError> {
        let failed = |e: Error| PriorError { part: "network", name: "unfolding".to_owned(), source: Box::new(e) };
        let solve = self.advance(call, noisy).map_err(failed)?;
        let frames = solve.frames();
        if frames.len_of(Axis(1)) == 1 {
            out.rgb = None;
            out.sensor.assign(&frames.index_axis(Axis(1), 0));
        } else {
            let (sensor, rgb) = out.for_rgb();
            rgb.assign(frames);
            sensor.indexed_iter_mut().for_each(|((t, y, x), value)| *value = solve.sensor(t, y, x));
        }
        Ok(())
    }
}

/// Writes what the network is shown of a frame.
fn show(image: &mut Blocked, solve: &Unfolding, x: ArrayView3<'_, f32>, base: &Array4<f32>, t: usize) {
    let Unfolding { shown: Shown { mean, masks, open }, lattice, .. } = solve;
    let colors = base.len_of(Axis(1));
    for c in 0..colors {
        lattice.write(image, PHASES * c, |i, j| base[[t, c, i, j]] - GRAY);
    }
    let mut next = PHASES * colors;
    let mut write = |value: &dyn Fn(usize, usize) -> f32| {
        lattice.write(image, next, value);
        next += PHASES;
    };
    write(&|i, j| x[[t, i, j]] - solve.sensor(t, i, j));
    write(&|i, j| mean[[i, j]] - GRAY);
    write(&|i, j| masks[[t, i, j]] - GRAY);
    write(&|i, j| open[[i, j]] - GRAY);
    write(&|i, j| (mean[[i, j]] - GRAY) * masks[[t, i, j]]);
}
