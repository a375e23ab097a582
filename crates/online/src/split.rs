//! Adaptation before a solve, by measurement splitting: some pixels of the measurement are left out of the data step of a whole solve,
//! and the network learns to predict them.
//!
//! The paper's loss `‖y − H v‖²` looks at the very pixels that the network's input has just been projected onto, and a network that was
//! trained for a solver's iterates gains nothing by it. Pixels that the solve was not given tell how good its result is elsewhere.
//! Each update draws crops and, in each, pixels S to predict, solves the crops without them and goes against the gradient of
//!
//! ```text
//! ℓ = mean over S of (y − H T v)² / Σ_t C_t²
//! ```
//!
//! through the last calls of the solve. A share J of the pixels is in no S and given to no solve of these: by the prediction of J the average
//! of the weights is judged, and weights that predict it worse are not kept. Where other networks take the solve over from the one that learned,
//! J also tells whether they are to: what a network learned of a scene that is like nothing it was trained with, one that did not learn spoils.
//!
//! # References
//! Yaman et al., *Self-supervised learning of physics-guided reconstruction neural networks without fully sampled reference data*, Magnetic
//! Resonance in Medicine 2020; Yaman, Hosseini, Akçakaya, *Zero-shot self-supervised learning for MRI reconstruction*, ICLR 2022.

use crate::loss::values;
use crate::{Error, Result};
use admm::Denoiser;
use candle_core::{Tensor, Var};
use ndarray::{Array2, Array3, Array4, ArrayView4, Zip, s};
use nets::kernels::Precision;
use nets::train::{Adam, blend};
use nets::unrolled::{First, Gradients, Recipe, Relay};
use nets::{Network, Parameters};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use sci_forward::{MaskOperator, MaskStack, Measurement, MeasurementError};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::Instant;

/// How a network adapts by measurement splitting.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SplitConfig {
    /// Updates of the weights, at most.
    pub updates: usize,
    /// Crops in an update, 1 to 64.
    pub crops: usize,
    /// Side of a crop in pixels, a multiple of 8 from 16 to 1024; at most that of the measurement.
    pub side: usize,
    /// Share of the pixels of a crop that is to be predicted, in (0, 1).
    pub hidden: f64,
    /// The last calls of a solve, at least 1, which the gradient goes through; of a solve with fewer all.
    pub calls: usize,
    /// Of Adam, after a rise over the first ten updates.
    pub learning_rate: f64,
    /// Decay of the moving average of the weights in an update, in [0, 1).
    pub average: f64,
    /// How far the network goes from the weights it had to that average, in (0, 1].
    pub blend: f64,
    /// Share of the pixels that judge, in (0, 0.5].
    pub judging: f64,
    /// Crops in which they do.
    pub judged_crops: usize,
    /// Updates between judgements, at least 1.
    pub every: usize,
    /// After so many judgements in a row that found nothing better it stops.
    pub patience: usize,
    /// Which tensors change.
    pub parameters: Parameters,
    /// What gradients are computed in.
    pub precision: Precision,
    /// Of everything random.
    pub seed: u64,
}

impl Default for SplitConfig {
    /// Found with `configs/gray/fast.toml` on crops of clips that are in no benchmark, and on cells, which look like nothing it was trained with.
    /// Gain in dB (*dog*, *car-shadow*, cells) and seconds of learning for 160×160×8 on two AVX2 cores:
    ///
    /// | | gain | seconds |
    /// |---|---|---|
    /// | one crop an update, three calls, 100 updates at 1e-4 | .27, .23, 1.3 | 55 |
    /// | the same, two calls; one call | .16, .03; .04, .00 | 43; 31 |
    /// | four crops, three calls, 30 updates at 4e-4 | .23, .17, 1.5 | 38 |
    /// | four crops, five calls, 30 updates at 3e-4 | .17, -.10, 2.1 | 57 |
    /// | **four crops, all seven calls, 30 updates at 3e-4** | .37, .35, 3.1 | 75 |
    ///
    /// How far to go to what was learned, on other crops, *dog*, *car-shadow*, cells, text, gain in dB:
    ///
    /// | | half | three quarters | all |
    /// |---|---|---|---|
    /// | 30 updates at 3e-4 | .25, .28, .87, .81 | .28, .32, 1.06, 1.06 | .26, .30, 1.07, 1.19 |
    /// | **at 5e-4** | .37, .32, .97, .98 | .41, .35, 1.11, 1.28 | .38, .30, 1.08, 1.46 |
    /// | at 8e-4 | .35, –, .83, 1.14 | .35, –, .92, 1.47 | .27, –, .79, 1.72 |
    ///
    /// So half is enough where a scene is like those of the training, and leaves more of what the network knew; the default lies between.
    /// Half of the updates at 8e-4 had less than half of the gain. Hiding a quarter or two fifths of the pixels, and learning four times from
    /// each trial solve, lost all of it or the half.
    fn default() -> Self {
        Self {
            updates: 30,
            crops: 4,
            side: 64,
            hidden: 0.12,
            calls: 7,
            learning_rate: 5e-4,
            average: 0.9,
            blend: 0.6,
            judging: 0.05,
            judged_crops: 8,
            every: 15,
            patience: 2,
            parameters: Parameters::All,
            precision: Precision::Bf16,
            seed: 0,
        }
    }
}

impl SplitConfig {
    /// Checks every setting.
    ///
    /// # Errors
    /// [`Error::Setting`] for the first that is out of range.
    pub fn validate(&self) -> Result<()> {
        let check = |holds: bool, key, value: f64, legal| match holds {
            true => Ok(()),
            false => Err(Error::Setting { key, value: value.to_string(), legal }),
        };
        let whole = |value: usize| value as f64;
        check((1..=64).contains(&self.crops), "crops", whole(self.crops), "1 to 64")?;
        let side = (16..=1024).contains(&self.side) && self.side.is_multiple_of(8);
        check(side, "side", whole(self.side), "a multiple of 8 from 16 to 1024")?;
        check(self.hidden > 0.0 && self.hidden < 1.0, "hidden", self.hidden, "greater than 0 and less than 1")?;
        check(self.calls >= 1, "calls", whole(self.calls), "at least 1")?;
        let rate = self.learning_rate > 0.0 && self.learning_rate <= 1.0;
        check(rate, "learning_rate", self.learning_rate, "greater than 0 and at most 1")?;
        check((0.0..1.0).contains(&self.average), "average", self.average, "at least 0 and less than 1")?;
        check(self.blend > 0.0 && self.blend <= 1.0, "blend", self.blend, "greater than 0 and at most 1")?;
        let judging = self.judging > 0.0 && self.judging <= 0.5;
        check(judging, "judging", self.judging, "greater than 0 and at most 0.5")?;
        check((1..=64).contains(&self.judged_crops), "judged_crops", whole(self.judged_crops), "1 to 64")?;
        check(self.every >= 1, "every", whole(self.every), "at least 1")?;
        check(self.patience >= 1, "patience", whole(self.patience), "at least 1")
    }
}

/// A judgement of the weights.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Judgement {
    /// Updates behind it.
    pub updates: usize,
    /// Mean of `(y − H T v)² / Σ C²` over the pixels predicted in the updates since the judgement before; nothing before the first update.
    pub hidden: Option<f64>,
    /// The same over the pixels that judge; the largest number there is where a solve diverged.
    pub judged: f64,
}

/// What an adaptation by splitting did.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SplitRecord {
    /// First of the weights as they were, then in order.
    pub judgements: Vec<Judgement>,
    /// Updates whose weights are in use; 0 when none paid.
    pub kept: usize,
    /// The error at the pixels that judge after the calls of the network that takes over; nothing where none does.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub taken_over: Option<f64>,
    /// Whether a solve is better off without that network: pixels that judge are predicted worse by more than 2 % after it.
    #[serde(default)]
    pub ends_early: bool,
    /// Wall-clock seconds it took.
    pub seconds: f64,
}

impl SplitRecord {
    /// Updates that were made.
    pub fn updates(&self) -> usize {
        self.judgements.last().map_or(0, |last| last.updates)
    }
}

/// The share of an error by which few pixels do not tell two solves apart. Five scenes with 1, 1, 1, 4 and 29 % more after the network that
/// takes over: without it they had .03 dB less, .05 more, .25 less, .16 and .3 more.
const TIE: f64 = 0.02;

/// A network that takes a solve over from one that learns.
#[derive(Clone, Copy)]
pub struct Successor<'n> {
    /// It, which does not learn.
    pub network: &'n dyn Network,
    /// The whole solve; its first calls are those of the one that learns.
    pub recipe: &'n Recipe,
}

/// Adapts a network to measurements of one scene, which will be solved by `recipe`, and after that by `successor`, if there is one. `watch` is told after
/// each update how many are done, and says whether to go on; stopped early, the best weights so far stay. The same for any number of threads.
///
/// # Errors
/// [`Error::Setting`], [`Error::Net`], [`Error::Denoiser`]; the network has the weights it had then.
pub fn adapt_by_splitting<N: Network + Denoiser + Clone>(
    net: &mut N,
    measurements: &[Measurement],
    recipe: &Recipe,
    successor: Option<Successor<'_>>,
    config: &SplitConfig,
    watch: &mut dyn FnMut(usize) -> ControlFlow<()>,
) -> Result<SplitRecord> {
    config.validate()?;
    let begin = Instant::now();
    let mut scenes: Vec<Scene> = Vec::new();
    for measurement in measurements {
        scenes.push(Scene::new(measurement, config, &scenes));
    }
    let judged = judging_crops(&scenes, config)?;
    let mut learner = Learner::new(net.clone(), config)?;
    let mut best = (learner.judge(&judged, recipe)?, 0, net.state());
    let mut judgements = vec![Judgement { updates: 0, hidden: None, judged: best.0.min(f64::MAX) }];
    let (mut hidden, mut since) = (Vec::new(), 0);
    for update in 1..=config.updates {
        let Some(loss) = learner.update(&scenes, recipe, update)? else { break };
        hidden.push(loss);
        let stop = watch(update).is_break();
        if !update.is_multiple_of(config.every) && update < config.updates && !stop {
            continue;
        }
        let error = learner.judge(&judged, recipe)?;
        let mean = hidden.drain(..).map(f64::from).fold((0.0, 0.0), |(sum, n), loss| (sum + loss, n + 1.0));
        judgements.push(Judgement { updates: update, hidden: Some(mean.0 / mean.1), judged: error.min(f64::MAX) });
        since += 1;
        if error < best.0 {
            (best, since) = ((error, update, learner.blended()?), 0);
        }
        if stop || since >= config.patience {
            break;
        }
    }
    if best.1 > 0 {
        net.set_state(&best.2)?;
    }
    let calls = recipe.sigmas.len();
    let taken_over = successor.map(|next| {
        let first = First { network: net, calls };
        judged_error(
            &judged,
            || next.network.boxed(),
            |given, then| Ok(next.recipe.solve_to_the_end(given, &mut Relay::new(Some(first), &mut **then))?),
        )
    });
    let taken_over = taken_over.transpose()?.map(|error| error.min(f64::MAX));
    let ends_early = taken_over.is_some_and(|after| after > (1.0 + TIE) * best.0);
    Ok(SplitRecord { judgements, kept: best.1, taken_over, ends_early, seconds: begin.elapsed().as_secs_f64() })
}

/// A measurement with the pixels that judge.
struct Scene<'m> {
    measurement: &'m Measurement,
    /// The mask of each frame, shared by measurements of one operator.
    masks: Arc<Array3<f32>>,
    judges: Array2<bool>,
}

/// A piece of a measurement: what a solve is given of it, and what it is to predict.
struct Crop {
    whole: Measurement,
    given: Measurement,
    asked: Array2<bool>,
}

impl<'m> Scene<'m> {
    /// The next after others.
    fn new(measurement: &'m Measurement, config: &SplitConfig, others: &[Self]) -> Self {
        let same = |other: &&Self| Arc::ptr_eq(measurement.shared_operator(), other.measurement.shared_operator());
        let masks = others.iter().find(same).map(|other| other.masks.clone()).unwrap_or_else(|| {
            // What a sensor that sees 1 everywhere passes on.
            Arc::new(measurement.operator().adjoint(Array2::ones(measurement.y().dim()).view()))
        });
        let mut rng = ChaCha8Rng::seed_from_u64(config.seed);
        rng.set_stream(JUDGES + others.len() as u64);
        let gram = measurement.operator().gram();
        let judges = gram.map(|&gram| rng.random::<f64>() < config.judging && gram > 0.0);
        Self { measurement, masks, judges }
    }

    /// A crop at a random place, which `ask` asks of (whether a pixel judges, a random number in `[0, 1)`): nothing when no pixel is asked,
    /// or none is given.
    fn crop(&self, side: usize, rng: &mut ChaCha8Rng, ask: impl Fn(bool, f64) -> bool) -> Option<Crop> {
        let (height, width) = self.measurement.y().dim();
        let (h, w) = (side.min(height), side.min(width));
        // At even places the pattern of a color sensor is what it was.
        let mut place = |n: usize, side: usize| 2 * rng.random_range(0..=(n - side) / 2);
        let (y, x) = (place(height, h), place(width, w));
        let area = s![y..y + h, x..x + w];
        let masks = self.masks.slice(s![.., y..y + h, x..x + w]).as_standard_layout().into_owned();
        let operator = MaskOperator::new(MaskStack::new(masks).ok()?);
        let whole = Measurement::new(Arc::new(operator), self.measurement.y().slice(area).to_owned()).ok()?;
        let whole = whole.with_cfa(self.measurement.cfa()).with_clip(self.measurement.clip());
        let judges = self.judges.slice(area);
        let (open, least) = (whole.operator().gram(), whole.least_telling());
        let mut asked = Array2::from_elem((h, w), false);
        Zip::from(&mut asked).and(judges).and(open).for_each(|asked, &judge, &open| {
            *asked = ask(judge, rng.random()) && open > 0.0 && open >= least;
        });
        if !asked.iter().any(|&asked| asked) {
            return None;
        }
        let kept = Zip::from(&asked).and(judges).map_collect(|&asked, &judge| !asked && !judge);
        let given = whole.restricted(kept.view()).ok()?;
        Some(Crop { whole, given, asked })
    }
}

/// Streams of the generator: updates take those from 1.
const JUDGES: u64 = 1 << 62;
const JUDGED_CROPS: u64 = 1 << 63;

/// The crops in which the pixels that judge are predicted, of all scenes in turn.
fn judging_crops(scenes: &[Scene<'_>], config: &SplitConfig) -> Result<Vec<Crop>> {
    let crop = |i: usize| {
        let mut rng = ChaCha8Rng::seed_from_u64(config.seed);
        rng.set_stream(JUDGED_CROPS + i as u64);
        scenes.get(i % scenes.len().max(1))?.crop(config.side, &mut rng, |judge, _| judge)
    };
    let crops: Vec<Crop> = (0..config.judged_crops).filter_map(crop).collect();
    if crops.is_empty() { Err(Error::NothingToJudge) } else { Ok(crops) }
}

/// The mean error of solves at the pixels that judge; each thread has a network of its own, which packs its filters once.
fn judged_error<N>(
    crops: &[Crop],
    network: impl Fn() -> N + Sync + Send,
    solve: impl Fn(&Measurement, &mut N) -> Result<Option<Array4<f32>>> + Sync,
) -> Result<f64> {
    let error = |net: &mut N, crop: &Crop| -> Result<f64> {
        // What diverges predicts nothing, however good that is which it came from.
        let Some(found) = solve(&crop.given, net)? else { return Ok(f64::INFINITY) };
        Ok(f64::from(crop.loss(found.view())?.0))
    };
    let errors = crops.par_iter().map_init(network, error).collect::<Result<Vec<_>>>()?;
    Ok(errors.iter().sum::<f64>() / errors.len() as f64)
}

impl Crop {
    /// Mean of `(y − H T v)² / Σ C²` over the pixels asked of, and its gradient by v.
    fn loss(&self, v: ArrayView4<'_, f32>) -> std::result::Result<(f32, Array4<f32>), MeasurementError> {
        let mut weighted = self.whole.residual(v)?;
        let count = self.asked.iter().filter(|&&asked| asked).count() as f32;
        let mut sum = 0f64;
        Zip::from(&mut weighted).and(&self.asked).and(self.whole.operator().gram()).for_each(|r, &asked, &gram| {
            let slope = if asked { *r / gram } else { 0.0 };
            sum += f64::from(*r * slope);
            *r = 2.0 * slope / count;
        });
        Ok(((sum / f64::from(count)) as f32, self.whole.pull_back(weighted.view())))
    }
}

/// The network that learns.
struct Learner<'c, N> {
    net: N,
    vars: Vec<(String, Var)>,
    /// Values of `vars` before.
    start: Vec<Vec<f32>>,
    adam: Adam,
    average: Vec<Vec<f32>>,
    config: &'c SplitConfig,
}

impl<'c, N: Network + Denoiser + Clone> Learner<'c, N> {
    fn new(mut net: N, config: &'c SplitConfig) -> Result<Self> {
        net.set_precision(config.precision);
        let vars = net.make_some_trainable(config.parameters)?;
        let adam = Adam::new(vars.iter().map(|(_, var)| var.clone()).collect());
        let start = vars.iter().map(|(_, var)| values(var)).collect::<Result<Vec<_>>>()?;
        Ok(Self { net, vars, adam, average: start.clone(), start, config })
    }

    /// One update; its loss, or nothing when a number was not finite.
    fn update(&mut self, scenes: &[Scene<'_>], recipe: &Recipe, number: usize) -> Result<Option<f32>> {
        let config = self.config;
        let now = self.constant(&self.net.state())?;
        let first = recipe.sigmas.len().saturating_sub(config.calls);
        let lesson = |i: usize| -> Result<Option<Gradients>> {
            let mut rng = ChaCha8Rng::seed_from_u64(config.seed);
            rng.set_stream((number * 64 + i) as u64);
            let scene = &scenes[rng.random_range(0..scenes.len())];
            let hide = |judge: bool, u: f64| !judge && u < config.hidden;
            let Some(crop) = scene.crop(config.side, &mut rng, hide) else { return Ok(None) };
            let calls = (first..recipe.sigmas.len()).collect();
            let Some(calls) = recipe.record(&crop.given, &mut now.clone(), calls)? else {
                // A loss that is no number ends the updates.
                return Ok(Some(Gradients { loss: f32::NAN, of_vars: Vec::new() }));
            };
            Ok(Some(recipe.gradient(&crop.given, &calls, &self.net, &self.vars, &|v| Ok(crop.loss(v)?))?))
        };
        let lessons = (0..config.crops).into_par_iter().map(lesson).collect::<Result<Vec<_>>>()?;
        let lessons: Vec<Gradients> = lessons.into_iter().flatten().collect();
        if lessons.is_empty() {
            return Ok(None);
        }
        let Gradients { loss, of_vars } = Gradients::mean(lessons);
        // Adam's first steps are as long as any, but know the direction least.
        let rate = config.learning_rate * (number as f64 / WARM_UP).min(1.0);
        if !loss.is_finite() || !self.adam.apply(&of_vars, rate, CLIP_NORM)?.is_finite() {
            return Ok(None);
        }
        // Shorter at first, so that it follows at all in few updates.
        let decay = config.average.min(number as f64 / (number as f64 + 5.0)) as f32;
        for ((_, var), average) in self.vars.iter().zip(&mut self.average) {
            average.iter_mut().zip(values(var)?).for_each(|(a, w)| *a = decay * *a + (1.0 - decay) * w);
        }
        Ok(Some(loss))
    }

    /// The error of [`Learner::blended`] at the pixels that judge.
    fn judge(&self, crops: &[Crop], recipe: &Recipe) -> Result<f64> {
        let blended = self.constant(&self.blended()?)?;
        judged_error(crops, || blended.clone(), |given, net| Ok(recipe.solve_to_the_end(given, net)?))
    }

    /// The weights between those before and the average of those learned, as a state of the network.
    fn blended(&self) -> Result<BTreeMap<String, Tensor>> {
        let mut state = self.net.state();
        blend(&mut state, &self.vars, &self.start, &self.average, self.config.blend)?;
        Ok(state)
    }

    /// The network with a state as constants, which inference packs once.
    fn constant(&self, state: &BTreeMap<String, Tensor>) -> Result<N> {
        let mut net = self.net.clone();
        net.set_state(state)?;
        Ok(net)
    }
}

/// Updates over which the learning rate rises.
const WARM_UP: f64 = 10.0;
/// Longest gradient; longer ones are shortened to it.
const CLIP_NORM: f64 = 1.0;

#[cfg(test)]
mod tests {
    use super::*;
    use sci_forward::testing::{moving_square, uniform};
    use sci_forward::{CfaPattern, SensingOperator, VideoShape};

    const SHAPE: VideoShape = VideoShape { frames: 4, height: 30, width: 44 };

    fn measurement(cfa: Option<CfaPattern>) -> Measurement {
        let h = MaskOperator::new(MaskStack::random(SHAPE, 0.5, 0).unwrap());
        let y = h.forward(moving_square(SHAPE).view());
        Measurement::new(Arc::new(h), y).unwrap().with_cfa(cfa)
    }

    #[test]
    fn pixels_that_judge_are_neither_learned_from_nor_given() {
        let (measurement, config) = (measurement(None), SplitConfig { side: 24, ..SplitConfig::default() });
        let scene = Scene::new(&measurement, &config, &[]);
        for stream in 0..20 {
            let mut rng = ChaCha8Rng::seed_from_u64(7);
            rng.set_stream(stream);
            let all = |judge: bool, _| judge;
            let asked_of_judges = scene.crop(24, &mut rng.clone(), all).unwrap();
            let learned = scene.crop(24, &mut rng, |judge, u| !judge && u < 0.2).unwrap();
            assert_eq!(learned.whole.y(), asked_of_judges.whole.y(), "the same place");
            let given = learned.given.operator().gram();
            Zip::from(&learned.asked).and(&asked_of_judges.asked).and(given).for_each(|&asked, &judge, &given| {
                assert!(!(asked && judge) && (given == 0.0 || !asked && !judge));
            });
        }
    }

    /// Against differences of the loss.
    #[test]
    fn the_gradient_is_the_slope_of_the_loss() {
        for cfa in [None, Some(CfaPattern::Grbg)] {
            let measurement = measurement(cfa);
            let scene = Scene::new(&measurement, &SplitConfig::default(), &[]);
            let crop = scene.crop(24, &mut ChaCha8Rng::seed_from_u64(3), |_, u| u < 0.3).unwrap();
            let video = |seed| {
                let (t, h, w) = crop.whole.shape().dim();
                let c = crop.whole.channels();
                uniform((t, c * h, w), seed).into_shape_with_order((t, c, h, w)).unwrap()
            };
            let (v, direction) = (video(1), video(2));
            let at = |step: f32| f64::from(crop.loss((&v + &(&direction * step)).view()).unwrap().0);
            let slope: f64 = (crop.loss(v.view()).unwrap().1 * &direction).iter().map(|&p| f64::from(p)).sum();
            let difference = (at(0.1) - at(-0.1)) / 0.2;
            assert!((slope - difference).abs() < 1e-3 * slope.abs(), "{slope} {difference}");
        }
    }
}
