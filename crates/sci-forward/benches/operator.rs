//! `H` and its adjoint over every kind of masks, in bytes of video and measurement moved a second, beside a plain copy.

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use ndarray::{Array3, Zip};
use sci_forward::testing::uniform;
use sci_forward::{BinaryMasks, Gained, MaskOperator, MaskStack, SensingOperator, ShiftingMasks, VideoShape};

fn operators(shape: VideoShape) -> [(&'static str, Box<dyn SensingOperator>); 6] {
    let stack = MaskStack::random(shape, 0.5, 0).expect("a valid shape and density");
    let shifting = |step| ShiftingMasks::random(shape, 0.5, 0, step).expect("a valid shape and density");
    let binary = BinaryMasks::new(&stack).expect("masks of 0 and 1");
    let gained = Gained::new(stack.clone(), vec![0.5; shape.frames]).expect("a gain for each frame");
    [
        ("f32", Box::new(MaskOperator::new(stack))),
        ("bits", Box::new(MaskOperator::new(binary))),
        ("shifting", Box::new(MaskOperator::new(shifting([0.0, 1.0])))),
        ("shifting by half pixels", Box::new(MaskOperator::new(shifting([0.0, 0.5])))),
        ("shifting by half pixels both ways", Box::new(MaskOperator::new(shifting([0.5, 0.5])))),
        ("gained f32", Box::new(MaskOperator::new(gained))),
    ]
}

fn operator(c: &mut Criterion) {
    for size in [256, 1024] {
        let shape = VideoShape { frames: 8, height: size, width: size };
        let x = uniform(shape.dim(), 1);
        let mut copy = Array3::zeros(shape.dim());
        let mut group = c.benchmark_group(format!("{size}x{size}x8"));
        group.throughput(Throughput::Bytes((2 * x.len() * size_of::<f32>()) as u64));
        group.bench_function("copy", |b| b.iter(|| Zip::from(&mut copy).and(&x).par_for_each(|a, &b| *a = b)));
        group.throughput(Throughput::Bytes(((x.len() + size * size) * size_of::<f32>()) as u64));
        for (masks, operator) in operators(shape) {
            let mut y = operator.forward(x.view());
            group.bench_function(BenchmarkId::new("forward", masks), |b| {
                b.iter(|| operator.forward_into(x.view(), y.view_mut()))
            });
            group.bench_function(BenchmarkId::new("adjoint", masks), |b| {
                b.iter(|| operator.adjoint_into(y.view(), copy.view_mut()))
            });
        }
    }
}

criterion_group!(benches, operator);
criterion_main!(benches);
