//! Whole passes and training steps: 8 frames of 256×256 through each denoiser, one step of FFDNet on 16 patches.

use admm::{Call, Denoiser};
use criterion::{Criterion, criterion_group, criterion_main};
use ndarray::Array4;
use nets::train::{
    CheckpointConfig, DataConfig, Frame, Loss, NetworkConfig, NoiseConfig, Optimizer, Precision, TrainConfig,
    TrainData, Trainer, TrainingConfig, ValidationConfig,
};
use nets::{Ends, Fastdvdnet, FastdvdnetSpec, Ffdnet, FfdnetSpec};

fn pass(c: &mut Criterion, name: &str, net: &mut dyn Denoiser, channels: usize) {
    let video =
        Array4::from_shape_fn((8, channels, 256, 256), |(t, c, y, x)| ((t + c + 5 * y + 3 * x) % 17) as f32 / 17.0);
    let mut out = Array4::zeros(video.dim());
    let call = Call::new(0.1);
    c.bench_function(name, |b| b.iter(|| net.denoise(&call, video.view(), out.view_mut()).expect("shapes fit")));
}

fn passes(c: &mut Criterion) {
    pass(c, "ffdnet gray", &mut Ffdnet::random(FfdnetSpec::GRAY, 0).expect("a legal size"), 1);
    let mut net = Fastdvdnet::random(FastdvdnetSpec::GRAY, Ends::Circular, 0).expect("a legal size");
    pass(c, "fastdvdnet gray", &mut net, 1);
    pass(c, "ffdnet color", &mut Ffdnet::random(FfdnetSpec::COLOR, 0).expect("a legal size"), 3);
}

fn training(c: &mut Criterion) {
    let frame = Frame::from_shape_fn((1, 128, 128), |(_, y, x)| ((y * y + 7 * x) % 251) as u8);
    let data = TrainData { photos: vec![frame.clone()], validation: vec![vec![frame]], videos: vec![] };
    let config = TrainConfig {
        name: "bench".into(),
        seed: 0,
        network: NetworkConfig::Ffdnet { channels: 1, width: 64, depth: 15 },
        data: DataConfig {
            video: None,
            photos: Some("photos".into()),
            validation: "validation".into(),
            photo_share: 1.0,
            patch: 64,
            frames: 1,
            batch: 16,
        },
        weights: None,
        renew: vec![],
        noise: Some(NoiseConfig { sigma: [0.0, 75.0] }),
        camera: None,
        iterates: None,
        training: TrainingConfig {
            steps: u64::MAX,
            optimizer: Optimizer::Muon,
            precision: Precision::F32,
            loss: Loss::L1,
            learning_rate: 1e-3,
            final_learning_rate: 0.0,
            warmup: 0,
            average: 0.999,
            blend: 1.0,
            clip_norm: 1.0,
            revive: 100,
        },
        validation: ValidationConfig::default(),
        checkpoint: CheckpointConfig::default(),
    };
    let mut trainer = Trainer::new(config, data).expect("a legal run");
    c.bench_function("training step, ffdnet gray, 16 patches of 64×64", |b| {
        b.iter(|| trainer.step().expect("a finite loss"));
    });
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(10);
    targets = passes, training
}
criterion_main!(benches);
