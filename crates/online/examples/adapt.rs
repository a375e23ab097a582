//! GAP-FFDNet on every measurement of a gray scene, with the settings given and without adaptation: PSNR, seconds,
//! and what the updates did.
//!
//! ```text
//! cargo run --release -p online --example adapt -- WEIGHTS SCENE.npz [key=value]...
//! ```
//! A scene holds `mask` `[T, H, W]`, `orig` `[N·T, H, W]`, both floats in [0, 1]. Keys: those of `set` below.

use admm::{Gap, Plan, Problem, Stage, Start, run};
use ndarray::{Array3, Axis, s};
use ndarray_npy::NpzReader;
use nets::kernels::Precision;
use nets::{Ffdnet, Network};
use online::{
    AdaptConfig, AdaptiveDenoiser, Outcome, Parameters, Reuse, Schedule, SequenceConfig, Snapshot, run_sequence,
};
use sci_forward::metrics::{mean_over_frames, psnr};
use sci_forward::{MaskOperator, MaskStack, SensingOperator};
use std::error::Error;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;

struct Settings {
    adapt: AdaptConfig,
    sequence: SequenceConfig,
    stages: Vec<Stage>,
    measurements: usize,
    /// GAP without momentum.
    plain: bool,
}

fn set(settings: &mut Settings, key: &str, value: &str) -> Result<(), Box<dyn Error>> {
    let Settings { adapt, sequence, stages, measurements, plain } = settings;
    let AdaptConfig { schedule, parameters, terms, guard, blind, precision, seed } = adapt;
    match key {
        "first" => schedule.first = value.parse()?,
        "interval" => schedule.interval = value.parse()?,
        "max_updates" => schedule.max_updates = Some(value.parse()?),
        "steps" => schedule.steps = value.parse()?,
        "lr" => schedule.learning_rate = value.parse()?,
        "noise" => schedule.input_noise = value.parse::<f32>()? / 255.0,
        "growth" => schedule.growth = value.parse()?,
        "keep_optimizer" => schedule.keep_optimizer = value.parse()?,
        "parameters" => {
            *parameters = match value {
                "all" => Parameters::All,
                "biases" => Parameters::Biases,
                "first-last" => Parameters::FirstLast,
                "last" => Parameters::Last,
                "norm-affine" => Parameters::NormAffine,
                other => return Err(format!("parameters = {other}").into()),
            }
        }
        "pseudo_clean" => terms.pseudo_clean = value.parse()?,
        "distance" => terms.distance = value.parse()?,
        "equivariance" => terms.equivariance = value.parse()?,
        "held_out" => guard.held_out = value.parse()?,
        "back_off" => guard.back_off = value.parse()?,
        "patience" => guard.patience = value.parse()?,
        "blind" => *blind = Some(value.parse()?),
        "precision" => *precision = if value == "bf16" { Precision::Bf16 } else { Precision::F32 },
        "plain" => *plain = value.parse()?,
        "seed" => *seed = value.parse()?,
        "carry_over" => sequence.reuse = if value.parse()? { Reuse::CarryOver } else { Reuse::Reset },
        "unchanged" => sequence.similarity.unchanged = value.parse()?,
        "warm" => sequence.similarity.warm = value.parse()?,
        "cut" => sequence.similarity.cut = value.parse()?,
        "effort" => sequence.effort = value.parse()?,
        "measurements" => *measurements = value.parse()?,
        "stages" => {
            let stage = |text: &str| -> Result<Stage, Box<dyn Error>> {
                let (sigma, iterations) = text.split_once('x').ok_or("stages are written 50x5,25x5")?;
                Ok(Stage { sigma: sigma.parse::<f32>()? / 255.0, iterations: iterations.parse()? })
            };
            *stages = value.split(',').map(stage).collect::<Result<_, _>>()?;
        }
        other => return Err(format!("no setting {other}").into()),
    }
    Ok(())
}

fn main() -> Result<(), Box<dyn Error>> {
    nets::kernels::keep_freed_memory();
    let mut arguments = std::env::args().skip(1);
    let (Some(weights), Some(scene)) = (arguments.next(), arguments.next()) else {
        return Err("usage: adapt WEIGHTS SCENE.npz [key=value]...".into());
    };
    let mut settings = Settings {
        adapt: AdaptConfig::default(),
        sequence: SequenceConfig::default(),
        stages: [50.0, 25.0, 12.0, 6.0].map(|s: f32| Stage { sigma: s / 255.0, iterations: 5 }).to_vec(),
        measurements: usize::MAX,
        plain: false,
    };
    for argument in arguments {
        let (key, value) = argument.split_once('=').ok_or("settings are written key=value")?;
        set(&mut settings, key, value)?;
    }
    let mut file = NpzReader::new(File::open(&scene)?)?;
    let masks: Array3<f32> = file.by_name("mask.npy")?;
    let truth: Array3<f32> = file.by_name("orig.npy")?;
    let operator: Arc<dyn SensingOperator> = Arc::new(MaskOperator::new(MaskStack::new(masks)?));
    let frames = operator.shape().frames;
    let clips: Vec<_> = truth.axis_chunks_iter(Axis(0), frames).take(settings.measurements).collect();
    let net = Ffdnet::load(Path::new(&weights))?;
    println!("{}, {}", net.describe(), scene);
    let plan = Plan::new(settings.stages.clone());

    let never = Schedule { max_updates: Some(0), ..settings.adapt.schedule };
    let mut results = Vec::new();
    for adapt in [AdaptConfig { schedule: never, ..settings.adapt }, settings.adapt] {
        let mut denoiser = AdaptiveDenoiser::new(net.clone(), adapt)?;
        let reset = SequenceConfig { reuse: Reuse::Reset, ..settings.sequence };
        let config = if results.is_empty() { reset } else { settings.sequence };
        let snapshots = clips.iter().map(|clip| Snapshot::new(operator.clone(), operator.forward(*clip).view(), None));
        let snapshots = snapshots.collect::<Result<Vec<_>, _>>()?;
        results.push(run_sequence(&mut denoiser, snapshots, config, |denoiser, task| {
            let problem = Problem::new(task.snapshot.operator().as_ref(), task.snapshot.y())?;
            let mut solver = if settings.plain { Gap::plain(denoiser) } else { Gap::accelerated(denoiser) };
            run(&mut solver, &problem, task.start(Start::Mean), &task.plan(&plan), &mut ())
        })?);
    }
    let (plain, adaptive) = (&results[0], &results[1]);
    let mut sums = [0.0; 4];
    for (i, (clip, (plain, adaptive))) in clips.iter().zip(plain.iter().zip(adaptive)).enumerate() {
        let quality =
            |x: &Array3<f32>| mean_over_frames(clip.slice(s![.., .., ..]), x.mapv(|v| v.clamp(0.0, 1.0)).view(), psnr);
        let (a, b) = (quality(&plain.outcome.estimate), quality(&adaptive.outcome.estimate));
        let (ta, tb) = (plain.outcome.seconds, adaptive.outcome.seconds);
        sums.iter_mut().zip([a, b, ta, tb]).for_each(|(sum, v)| *sum += v / clips.len() as f64);
        let relation = adaptive
            .relation
            .map_or(String::new(), |r| format!("  of start {:.3}, of scene {:.3}", r.of_start(), r.of_scene()));
        println!(
            "{i}: {a:.3} -> {b:.3} dB ({:+.3}), {ta:.2} -> {tb:.2} s, {} iterations{}{}{relation}",
            b - a,
            adaptive.outcome.iterations,
            if adaptive.warm { ", warm" } else { "" },
            if adaptive.cut { ", cut" } else { "" },
        );
        for update in &adaptive.updates {
            let of = |v: Option<f64>| v.map_or("-".into(), |v| format!("{v:.4e}"));
            let outcome = if let Outcome::RolledBack(why) = update.outcome {
                format!("rolled back: {why:?}")
            } else {
                format!("{:?}", update.outcome)
            };
            println!(
                "   {:3}: loss {} -> {}, held out {} -> {}, lr {:e}, {outcome}",
                update.iteration,
                of(update.loss_before),
                of(update.loss_after),
                of(update.held_out_before),
                of(update.held_out_after),
                update.learning_rate
            );
        }
    }
    println!(
        "mean: {:.3} -> {:.3} dB ({:+.3}), {:.2} -> {:.2} s",
        sums[0],
        sums[1],
        sums[1] - sums[0],
        sums[2],
        sums[3]
    );
    Ok(())
}
