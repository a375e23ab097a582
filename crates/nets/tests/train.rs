//! Training: it learns, it resumes bit for bit, and it refuses damaged checkpoints.

use nets::train::*;
use nets::{Error, WeightFile};
use std::collections::BTreeMap;

fn photo(channels: usize, seed: usize) -> Frame {
    Frame::from_shape_fn((channels, 40, 36), |(c, y, x)| {
        let wave = ((y * (seed % 5 + 2)) as f32 * 0.11 + c as f32).sin() + ((x + 3 * seed) as f32 * 0.17).cos();
        (127.0 + 60.0 * wave) as u8
    })
}

fn data(channels: usize) -> TrainData {
    let video = |seed: usize| (0..6).map(|t| photo(channels, seed + t)).collect::<Vec<_>>();
    TrainData {
        videos: vec![video(0), video(7)],
        photos: (0..4).map(|i| photo(channels, i)).collect(),
        validation: vec![video(20)],
    }
}

fn config(network: NetworkConfig, frames: usize, steps: u64) -> TrainConfig {
    TrainConfig {
        name: "test".into(),
        seed: 3,
        network,
        data: DataConfig {
            video: Some("video".into()),
            photos: Some("photos".into()),
            validation: "validation".into(),
            photo_share: 0.5,
            patch: 16,
            frames,
            batch: 2,
        },
        weights: None,
        renew: vec![],
        noise: Some(NoiseConfig { sigma: [0.0, 50.0] }),
        camera: None,
        iterates: None,
        training: TrainingConfig {
            steps,
            optimizer: Optimizer::Muon,
            precision: Precision::F32,
            loss: Loss::L1,
            learning_rate: 2e-3,
            final_learning_rate: 0.0,
            warmup: steps.min(2),
            average: 0.9,
            blend: 1.0,
            clip_norm: 1.0,
            revive: 100,
        },
        validation: ValidationConfig { sigmas: vec![25.0], frames: 2, ..ValidationConfig::default() },
        checkpoint: CheckpointConfig::default(),
    }
}

const FFDNET: NetworkConfig = NetworkConfig::Ffdnet { channels: 1, width: 8, depth: 3 };
const FASTDVDNET: NetworkConfig =
    NetworkConfig::Fastdvdnet { channels: 1, widths: [4, 4, 4], ends: nets::Ends::Circular };
const SHIFTNET: NetworkConfig = shiftnet([1, 1, 1]);
const DDNET: NetworkConfig = NetworkConfig::Ddnet { widths: [4, 4, 4], ends: nets::Ends::Mirrored };

const fn shiftnet(blocks: [usize; 3]) -> NetworkConfig {
    let experts = nets::Experts::NONE;
    NetworkConfig::Shiftnet { channels: 1, widths: [16, 16, 16], blocks, window: 1, experts }
}

fn trainer(config: &TrainConfig) -> Trainer {
    Trainer::new(config.clone(), data(config.network.channels())).unwrap()
}

fn run(trainer: &mut Trainer, steps: usize) -> Vec<StepReport> {
    (0..steps).map(|_| trainer.step().unwrap()).collect()
}

fn bits(trainer: &Trainer) -> Vec<u32> {
    let values = |t: candle_core::Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
    trainer.weights().unwrap().into_values().flat_map(values).map(f32::to_bits).collect()
}

#[test]
fn resuming_is_the_straight_run_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.safetensors");
    // Wide enough for Muon's steps, and long enough to begin between two measurements of what the layers are given.
    let wide = NetworkConfig::Ffdnet { channels: 1, width: 16, depth: 4 };
    let wide_video = NetworkConfig::Fastdvdnet { channels: 1, widths: [4, 16, 16], ends: nets::Ends::Circular };
    let networks =
        [(FFDNET, 1, 6), (FASTDVDNET, 3, 6), (DDNET, 3, 6), (SHIFTNET, 3, 6), (wide, 1, 46), (wide_video, 3, 26)];
    for (network, frames, steps) in networks {
        let mut config = config(network, frames, steps);
        // Channels begin anew all the time.
        config.training.revive = 1;
        let mut straight = trainer(&config);
        let reports = run(&mut straight, steps as usize);
        assert!(reports.iter().map(|report| report.revived).sum::<usize>() > 0);
        let mut first = trainer(&config);
        run(&mut first, 3);
        first.save(&path).unwrap();
        let mut second = trainer(&config);
        let resumed = second.resume(&path).unwrap();
        assert!(resumed.refused.is_none() && resumed.from == path);
        assert_eq!(run(&mut second, steps as usize - 3), reports[3..]);
        assert!(second.finished());
        assert_eq!(bits(&second), bits(&straight));
        assert_eq!(second.validate().unwrap(), straight.validate().unwrap());
    }
}

/// One with every fault.
fn camera() -> CameraConfig {
    CameraConfig {
        frames: [2, 4],
        density: [0.3, 0.7],
        masks: MaskKind::ALL.to_vec(),
        noise: 20.0,
        noisy: 0.5,
        holes: 0.1,
        saturated: 0.2,
        mask_errors: 0.2,
        mask_grain: 0.1,
    }
}

/// The same run on the iterates of a solver, one clip a step.
fn on_iterates(mut config: TrainConfig) -> TrainConfig {
    config.noise = None;
    config.data.frames = 1;
    config.data.batch = 1;
    config.iterates = Some(IteratesConfig {
        first: None,
        sigmas: vec![50.0, 25.0, 12.0],
        calls: 2,
        unrolled: false,
        start_iterations: 2,
    });
    config.camera = Some(camera());
    config
}

#[test]
fn training_on_iterates_learns_resumes_and_validates_by_reconstruction() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.safetensors");
    let color = NetworkConfig::Ffdnet { channels: 3, width: 8, depth: 3 };
    for (network, unrolled) in [
        (FFDNET, false),
        (FASTDVDNET, false),
        (color.clone(), false),
        (FFDNET, true),
        (FASTDVDNET, true),
        (SHIFTNET, true),
        (color, true),
    ] {
        let mut config = on_iterates(config(network, 1, 24));
        config.iterates.as_mut().unwrap().unrolled = unrolled;
        let mut straight = trainer(&config);
        let before = straight.validate().unwrap();
        // Measured without noise, and with.
        assert!(before.iter().map(|score| score.sigma).eq([None, Some(25.0)]));
        run(&mut straight, 12);
        straight.save(&path).unwrap();
        let rest = run(&mut straight, 12);
        let mut second = trainer(&config);
        second.resume(&path).unwrap();
        assert_eq!(run(&mut second, 12), rest);
        assert_eq!(bits(&second), bits(&straight));
        let after = straight.validate().unwrap();
        assert!(after[0].psnr_db > before[0].psnr_db + 1.0, "{before:?} {after:?}");
    }
}

/// An update by both is the mean of three lessons: two calls of a solve, and a noisy batch.
#[test]
fn a_step_learns_from_iterates_and_noise_at_once() {
    let noise = Some(NoiseConfig { sigma: [0.0, 50.0] });
    let mut config = on_iterates(config(FASTDVDNET, 1, 24));
    let alone = run(&mut trainer(&config), 1)[0].loss;
    config.data.frames = 3;
    config.noise = noise;
    let mut both = trainer(&config);
    let before = both.validate().unwrap();
    let first = run(&mut both, 24)[0].loss;
    assert!(first != alone && (first - alone).abs() < alone, "{first} {alone}");
    let after = both.validate().unwrap();
    assert!(after[0].psnr_db > before[0].psnr_db + 1.0, "{before:?} {after:?}");
}

#[test]
fn a_blend_lies_between_the_start_and_what_was_learned() {
    let mut config = config(FFDNET, 1, 4);
    let start = trainer(&config).weights().unwrap();
    config.weights = Some("bundled:any".into());
    let other = start.iter().map(|(name, t)| (name.clone(), t.affine(0.5, 0.1).unwrap())).collect();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.safetensors");
    let trained = |blend: f64| {
        let mut config = config.clone();
        config.training.blend = blend;
        let mut first = trainer(&config);
        first.start_from(&start).unwrap();
        run(&mut first, 2);
        first.save(&path).unwrap();
        // What it began with is in the checkpoint.
        let mut second = trainer(&config);
        second.start_from(&other).unwrap();
        second.resume(&path).unwrap();
        run(&mut second, 2);
        second.weights().unwrap()
    };
    let (whole, quarter) = (trained(1.0), trained(0.25));
    let values = |state: &BTreeMap<String, candle_core::Tensor>| -> Vec<f32> {
        state.values().flat_map(|t| t.flatten_all().unwrap().to_vec1::<f32>().unwrap()).collect()
    };
    let mut moved = false;
    for ((start, whole), quarter) in values(&start).into_iter().zip(values(&whole)).zip(values(&quarter)) {
        assert!((0.75 * start + 0.25 * whole - quarter).abs() < 1e-6, "{start} {whole} {quarter}");
        moved |= (whole - start).abs() > 1e-3;
    }
    assert!(moved);
    config.weights = None;
    config.training.blend = 0.5;
    assert!(matches!(config.validate(), Err(Error::Setting { key: "training.blend", .. })));
}

#[test]
fn random_weights_begin_as_the_residual_connection_with_open_relus() {
    for (network, frames, blocks) in [(FFDNET, 1, 1), (FASTDVDNET, 3, 2), (DDNET, 3, 2)] {
        let mut config = config(network, frames, 1);
        config.training.learning_rate = 1e-9;
        let mut first = trainer(&config);
        let weights = |trainer: &Trainer| trainer.weights().unwrap();
        let before = weights(&first);
        run(&mut first, 1);
        let largest = |t: &candle_core::Tensor| {
            let values = t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            values.into_iter().map(f32::abs).fold(0.0, f32::max)
        };
        let after = weights(&first);
        let silent = after.iter().filter(|(name, t)| name.ends_with(".weight") && largest(t) < 1e-6).count();
        assert_eq!(silent, blocks);
        let moved = after.iter().filter(|(name, t)| name.ends_with(".bias") && largest(t) > 1e-3).count();
        assert!(moved >= blocks, "{moved}");
        // Weights that were given are taken as they are.
        let mut second = trainer(&config);
        second.start_from(&before).unwrap();
        run(&mut second, 1);
        let unchanged = |(name, t): (&String, &candle_core::Tensor)| largest(&(t - &before[name]).unwrap()) < 1e-6;
        assert!(weights(&second).iter().all(unchanged));
    }
}

#[test]
fn a_run_can_begin_with_weights() {
    let config = config(FFDNET, 1, 4);
    let mut first = trainer(&config);
    run(&mut first, 4);
    let weights = first.weights().unwrap();
    let mut second = trainer(&on_iterates(config));
    second.start_from(&weights).unwrap();
    assert_eq!(bits(&second), bits(&first));
    let other = trainer(&self::config(FASTDVDNET, 1, 1)).weights().unwrap();
    assert!(matches!(second.start_from(&other), Err(Error::State { .. })));
}

#[test]
fn shut_layers_that_begin_anew_are_open_and_leave_the_network_what_it_was() {
    let mut config = config(FASTDVDNET, 3, 1);
    config.training.learning_rate = 1e-9;
    let mut shut = trainer(&TrainConfig { seed: 9, ..config.clone() }).weights().unwrap();
    let shut_by = "upc2.convblock.0.convblock.3.bias";
    for (_, bias) in shut.iter_mut().filter(|(name, _)| name.ends_with(shut_by)) {
        *bias = (bias.ones_like().unwrap() * -1e4).unwrap();
    }
    let begin = |renew: &[&str]| {
        let config = TrainConfig {
            weights: Some("shut".into()),
            renew: renew.iter().map(|part| (*part).to_owned()).collect(),
            ..config.clone()
        };
        let mut trainer = trainer(&config);
        let started = trainer.start_from(&shut);
        (trainer, started)
    };
    let step = |renew: &[&str]| {
        let (mut trainer, started) = begin(renew);
        started.unwrap();
        run(&mut trainer, 1);
        trainer
    };
    let (before, after) = (step(&[]), step(&["downc1", "upc2"]));
    assert!((before.validate().unwrap()[0].psnr_db - after.validate().unwrap()[0].psnr_db).abs() < 1e-4);
    for (name, now) in after.weights().unwrap() {
        let moved = (&now - &shut[&name]).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
        assert_eq!(moved > 1e-3, name.contains("downc1") || name.contains("upc2"), "{name}: {moved}");
        if name.ends_with(shut_by) {
            assert!(now.min_all().unwrap().to_scalar::<f32>().unwrap() > -10.0);
        }
    }
    assert!(matches!(begin(&["upc3"]).1, Err(Error::Setting { key: "renew", .. })));
}

#[test]
fn a_network_that_grows_is_at_first_what_it_was() {
    let mut small = trainer(&config(SHIFTNET, 3, 8));
    run(&mut small, 8);
    let more = shiftnet([2, 1, 3]);
    let grown = |renew: &[&str]| {
        let renew = renew.iter().map(|part| (*part).to_owned()).collect();
        let mut trainer = trainer(&TrainConfig { weights: Some("small".into()), renew, ..config(more.clone(), 3, 8) });
        let started = trainer.start_from(&small.weights().unwrap());
        (trainer, started)
    };
    let (mut large, started) = grown(&["enter0.1", "leave0.1", "deepest.1", "deepest.2"]);
    started.unwrap();
    assert_eq!(large.validate().unwrap(), small.validate().unwrap());
    let before = large.weights().unwrap();
    run(&mut large, 8);
    let moved = |name: &str| {
        let (before, after) = (&before[name], &large.weights().unwrap()[name]);
        (after - before).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap() > 0.0
    };
    assert!(moved("body.deepest.2.1.weight") && moved("body.enter0.0.0.weight"));
    assert!(matches!(grown(&["enter0.1", "leave0.1"]).1, Err(Error::State { .. })));
}

#[test]
fn noise_iterates_or_both() {
    let good = on_iterates(config(FFDNET, 1, 1));
    let key = |change: fn(&mut TrainConfig)| {
        let mut config = good.clone();
        change(&mut config);
        match config.validate() {
            Err(Error::Setting { key, .. }) => key,
            other => panic!("{other:?}"),
        }
    };
    assert!(good.validate().is_ok());
    let both = TrainConfig { noise: Some(NoiseConfig { sigma: [0.0, 50.0] }), ..good.clone() };
    assert!(both.validate().is_ok());
    assert_eq!(key(|c| (c.iterates, c.camera) = (None, None)), "noise");
    assert_eq!(key(|c| c.noise = Some(NoiseConfig { sigma: [50.0, 0.0] })), "noise.sigma");
    assert_eq!(key(|c| c.data.frames = 2), "data.frames");
    assert_eq!(key(|c| c.iterates = None), "camera");
    assert_eq!(key(|c| c.camera = None), "camera");
    assert_eq!(key(|c| c.network = DDNET), "iterates");
    assert_eq!(key(|c| c.iterates.as_mut().unwrap().sigmas.clear()), "iterates.sigmas");
    assert_eq!(key(|c| c.iterates.as_mut().unwrap().start_iterations = 1001), "iterates.start_iterations");
    assert_eq!(key(|c| c.iterates.as_mut().unwrap().calls = 0), "iterates.calls");
    assert_eq!(key(|c| c.iterates.as_mut().unwrap().calls = 4), "iterates.calls");
    assert_eq!(key(|c| c.camera.as_mut().unwrap().frames = [0, 4]), "camera.frames");
    assert_eq!(key(|c| c.camera.as_mut().unwrap().density = [0.5, 0.3]), "camera.density");
    assert_eq!(key(|c| c.camera.as_mut().unwrap().masks.clear()), "camera.masks");
    assert_eq!(key(|c| c.camera.as_mut().unwrap().holes = 0.6), "camera.holes");
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    // Wide enough for Muon's steps, and with several lessons a step, whose gradients are summed.
    let wide = config(NetworkConfig::Ffdnet { channels: 1, width: 16, depth: 4 }, 1, 3);
    let mut lessons = on_iterates(wide.clone());
    lessons.data.batch = 2;
    for config in [wide, lessons] {
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let mut trainer = trainer(&config);
                run(&mut trainer, 3);
                bits(&trainer)
            })
        };
        assert_eq!(with(1), with(3));
    }
}

#[test]
fn a_damaged_checkpoint_is_refused_and_the_one_before_it_used() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.safetensors");
    let config = config(FFDNET, 1, 9);
    let mut first = trainer(&config);
    run(&mut first, 2);
    first.save(&path).unwrap();
    run(&mut first, 2);
    first.save(&path).unwrap();
    let whole = std::fs::read(&path).unwrap();
    for part in [0, 1, 8, 15] {
        std::fs::write(&path, &whole[..whole.len() * part / 16]).unwrap();
        let mut second = trainer(&config);
        let resumed = second.resume(&path).unwrap();
        assert_eq!((second.steps_done(), resumed.from), (2, folder.path().join("run.previous.safetensors")));
        let refused = resumed.refused.unwrap().to_string();
        assert!(refused.contains("run.safetensors") && refused.contains("not a whole checkpoint"), "{refused}");
    }
    // The damaged one is gone, so that the next does not take the place of the good one.
    assert!(!path.exists());
    assert_eq!(trainer(&config).resume(&path).unwrap().from, folder.path().join("run.previous.safetensors"));
    std::fs::write(&path, &whole[..9]).unwrap();
    std::fs::remove_file(folder.path().join("run.previous.safetensors")).unwrap();
    let mut third = trainer(&config);
    assert!(matches!(third.resume(&path), Err(Error::Format { .. })));
    assert_eq!(third.steps_done(), 0);
    // Weights alone are no checkpoint.
    first.export(&path, nets::weights::Storage::F32).unwrap();
    assert!(third.resume(&path).unwrap_err().to_string().contains("not written by a training run"));
}

#[test]
fn a_checkpoint_of_other_settings_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.safetensors");
    let config = on_iterates(config(FFDNET, 1, 9));
    trainer(&config).save(&path).unwrap();
    type Change = fn(&mut TrainConfig);
    let changes: [(Change, &str); 7] = [
        (|c| c.name = "other".into(), "name = \"test\", not \"other\""),
        (|c| c.seed = 4, "seed = 3, not 4"),
        (|c| c.weights = Some("bundled:ffdnet_gray".into()), "weights = null, not \"bundled:ffdnet_gray\""),
        (|c| c.network = NetworkConfig::Ffdnet { channels: 1, width: 9, depth: 3 }, "network.width = 8, not 9"),
        (|c| c.data.patch = 12, "data.patch = 16, not 12"),
        (|c| c.camera.as_mut().unwrap().holes = 0.2, "camera.holes = 0.1, not 0.2"),
        (|c| c.training.steps = 10, "training.steps = 9, not 10"),
    ];
    for (change, needle) in changes {
        let mut other = config.clone();
        change(&mut other);
        let error = trainer(&other).resume(&path).unwrap_err().to_string();
        assert!(error.contains("run.safetensors") && error.contains(needle), "{error}");
    }
    let mut moved = config;
    moved.data.photos = Some("elsewhere".into());
    moved.validation.every = 7;
    moved.checkpoint.every = 7;
    trainer(&moved).resume(&path).unwrap();
}

#[test]
fn a_checkpoint_knows_whether_the_run_began_with_weights() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.safetensors");
    let config = config(FFDNET, 1, 2);
    let weights = trainer(&TrainConfig { seed: 8, ..config.clone() }).weights().unwrap();
    let mut straight = trainer(&config);
    straight.start_from(&weights).unwrap();
    straight.save(&path).unwrap();
    run(&mut straight, 2);
    let mut second = trainer(&config);
    second.resume(&path).unwrap();
    run(&mut second, 2);
    assert_eq!(bits(&second), bits(&straight));
}

#[test]
fn a_divergence_is_gone_back_on_at_half_the_rate() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.safetensors");
    let config = config(FFDNET, 1, 20);
    let mut diverging = trainer(&config);
    let lose = |trainer: &mut Trainer| {
        let huge = trainer.weights().unwrap().into_iter().map(|(name, t)| (name, t.affine(0.0, 1e20).unwrap()));
        trainer.start_from(&huge.collect()).unwrap();
        assert!(matches!(trainer.step(), Err(Error::Diverged { .. })));
    };
    // From the only checkpoint there is.
    diverging.save(&path).unwrap();
    run(&mut diverging, 1);
    lose(&mut diverging);
    diverging.back_off(&path).unwrap();
    assert_eq!((diverging.steps_done(), diverging.rate()), (0, 0.5));
    // From the one before the last, whatever it says of the rate.
    run(&mut diverging, 2);
    diverging.save(&path).unwrap();
    let good = bits(&diverging);
    run(&mut diverging, 1);
    diverging.save(&path).unwrap();
    for rate in [0.25, 0.125] {
        lose(&mut diverging);
        diverging.back_off(&path).unwrap();
        assert_eq!((diverging.steps_done(), diverging.rate(), bits(&diverging)), (2, rate, good.clone()));
    }
    // The lower rate is a part of what is saved.
    let mut resumed = trainer(&config);
    resumed.resume(&path).unwrap();
    let reports = [run(&mut diverging, 1)[0], run(&mut resumed, 1)[0]];
    assert_eq!(reports[0], reports[1]);
    assert_eq!(reports[0].learning_rate, config.learning_rate(2) / 8.0);
    assert_eq!(bits(&resumed), bits(&diverging));
}

/// Training on one still image: less than half of the noise is left.
fn overfit(network: NetworkConfig, frames: usize, steps: usize) {
    let mut config = config(network, frames, steps as u64);
    config.data.photo_share = 0.0;
    config.noise = Some(NoiseConfig { sigma: [50.0, 50.0] });
    config.training.learning_rate = 1e-2;
    let wave = |c: usize, y: usize, x: usize| (0.4 * y as f32 + c as f32).sin() + (0.3 * x as f32).cos();
    let shape = (config.network.channels(), 16, 16);
    let image = Frame::from_shape_fn(shape, |(c, y, x)| (127.0 + 60.0 * wave(c, y, x)) as u8);
    let data = TrainData { photos: vec![], videos: vec![vec![image.clone(); 3]], validation: vec![vec![image]] };
    let mut trainer = Trainer::new(config, data).unwrap();
    let reports = run(&mut trainer, steps);
    let last: f32 = reports[steps - 5..].iter().map(|r| r.loss).sum::<f32>() / 5.0;
    assert!(last < reports[0].loss / 2.0, "{} → {last}", reports[0].loss);
}

#[test]
fn ffdnet_learns_one_image() {
    overfit(FFDNET, 1, 300);
}

#[test]
fn fastdvdnet_learns_one_clip() {
    overfit(FASTDVDNET, 3, 200);
}

#[test]
fn ddnet_learns_one_clip() {
    overfit(NetworkConfig::Ddnet { widths: [8, 8, 8], ends: nets::Ends::Circular }, 3, 400);
}

#[test]
fn training_beats_doing_nothing_on_held_out_frames() {
    let mut config = config(NetworkConfig::Ffdnet { channels: 1, width: 16, depth: 4 }, 1, 500);
    config.training.learning_rate = 5e-3;
    config.data.batch = 8;
    let mut trainer = trainer(&config);
    let untrained = trainer.validate().unwrap()[0].psnr_db;
    run(&mut trainer, 500);
    let trained = trainer.validate().unwrap()[0].psnr_db;
    // 20.2 dB is the noise itself.
    assert!(trained > untrained + 3.0 && trained > 21.0, "{untrained} → {trained}");
}

#[test]
fn exported_weights_load_as_the_network() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("weights.safetensors");
    let trainer = trainer(&config(FASTDVDNET, 3, 1));
    trainer.export(&path, nets::weights::Storage::F32).unwrap();
    let read = nets::Architecture::load(WeightFile::read(&path).unwrap(), nets::Ends::Circular).unwrap();
    assert_eq!(read.describe(), trainer.describe());
}

#[test]
fn every_setting_has_its_range() {
    type Change = fn(&mut TrainConfig);
    let changes: [(&str, Change); 14] = [
        ("name", |c| c.name = "../x".into()),
        ("data", |c| (c.data.video, c.data.photos) = (None, None)),
        ("data.photo_share", |c| c.data.photo_share = f64::NAN),
        ("data.patch", |c| c.data.patch = 30),
        ("data.frames", |c| c.data.frames = 0),
        ("data.batch", |c| c.data.batch = 0),
        ("renew", |c| c.renew = vec!["upc2".into()]),
        ("noise.sigma", |c| c.noise = Some(NoiseConfig { sigma: [30.0, 300.0] })),
        ("training.steps", |c| c.training.steps = 0),
        ("training.learning_rate", |c| c.training.learning_rate = -1.0),
        ("training.warmup", |c| c.training.warmup = 100),
        ("training.average", |c| c.training.average = 1.0),
        ("training.clip_norm", |c| c.training.clip_norm = 0.0),
        ("validation.sigmas", |c| c.validation.sigmas = vec![-1.0]),
    ];
    let good = config(FFDNET, 1, 10);
    good.validate().unwrap();
    for (expected, change) in changes {
        let mut config = good.clone();
        change(&mut config);
        match config.validate() {
            Err(Error::Setting { key, .. }) => assert_eq!(key, expected),
            other => panic!("{expected}: {other:?}"),
        }
    }
}

#[test]
fn unusable_data_is_refused() {
    let config = config(FFDNET, 1, 1);
    let refused = |data: TrainData| Trainer::new(config.clone(), data).unwrap_err().to_string();
    assert!(refused(data(3)).contains("takes 1 channel"));
    assert!(refused(TrainData { videos: vec![], ..data(1) }).contains("no videos"));
    assert!(refused(TrainData { photos: vec![], ..data(1) }).contains("no photos"));
    assert!(refused(TrainData { validation: vec![], ..data(1) }).contains("no validation"));
    let uneven = vec![vec![photo(1, 0), Frame::zeros((1, 2, 2))]];
    assert!(refused(TrainData { videos: uneven, ..data(1) }).contains("differ in size"));
    assert!(frame_from_rgb(&[1, 2, 3], 1, 2, 3).is_err());
    assert_eq!(frame_from_rgb(&[10, 20, 30], 1, 1, 1).unwrap()[[0, 0, 0]], 18);
}

#[test]
fn learning_rates_rise_and_fall() {
    let config = config(FFDNET, 1, 11);
    let rates: Vec<f64> = (0..11).map(|s| config.learning_rate(s)).collect();
    assert_eq!((rates[0], rates[1], rates[2]), (1e-3, 2e-3, 2e-3));
    assert!(rates[2..].windows(2).all(|w| w[1] < w[0]) && rates[10] < 1e-9);
}

/// An expert that no lesson of a run reaches has no means, is not idle, and stays what it was.
#[test]
fn experts_that_are_never_asked_are_left_alone() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.safetensors");
    let experts = nets::Experts::new(&[40, 20]).unwrap();
    let network = NetworkConfig::Shiftnet { channels: 1, widths: [16, 16, 16], blocks: [1, 1, 1], window: 1, experts };
    let mut config = on_iterates(config(network, 1, 8));
    config.iterates = Some(IteratesConfig { sigmas: vec![50.0, 30.0], unrolled: true, ..config.iterates.unwrap() });
    config.training.revive = 2;
    let mut first = trainer(&config);
    let never_asked = |trainer: &Trainer| {
        let weights = trainer.weights().unwrap().into_iter().filter(|(name, _)| name.starts_with("below20."));
        weights.map(|(name, t)| (name, t.flatten_all().unwrap().to_vec1::<f32>().unwrap())).collect::<Vec<_>>()
    };
    let before = never_asked(&first);
    run(&mut first, 4);
    let after = never_asked(&first);
    let values = before.iter().zip(&after).flat_map(|((_, before), (_, after))| before.iter().zip(after));
    // The average of equal numbers is rounded.
    assert!(!before.is_empty() && values.clone().all(|(before, after)| (before - after).abs() < 1e-6));
    first.save(&path).unwrap();
    let mut second = trainer(&config);
    second.resume(&path).unwrap();
    run(&mut first, 2);
    run(&mut second, 2);
    assert_eq!(bits(&first), bits(&second));
}
