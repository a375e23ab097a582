//! TV, and the whole of the reference's GAP-TV (40 iterations of 5 dual steps), on 8 frames.

use admm::{Call, Denoiser, Gap, MomentumStart, Plan, Stage, Start, Tv, run};
use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use ndarray::{Array4, Axis};
use sci_forward::testing::{moving_square, uniform};
use sci_forward::{MaskOperator, MaskStack, Measurement, SensingOperator, VideoShape};
use std::sync::Arc;

fn gap_tv(c: &mut Criterion) {
    for size in [256, 1024] {
        let shape = VideoShape { frames: 8, height: size, width: size };
        let mut group = c.benchmark_group(format!("{size}x{size}x8"));
        let truth = moving_square(shape);
        let noisy = (&truth + &uniform(shape.dim(), 1)).insert_axis(Axis(1));
        let mut out = Array4::zeros(noisy.dim());
        let mut tv = Tv::new(0.3);
        let call = Call::new(0.0);
        // One call reads the frame and reads and writes two duals and the output in each of its five passes.
        group.throughput(Throughput::Bytes((5 * 7 * noisy.len() * size_of::<f32>()) as u64));
        group.bench_function("tv", |b| b.iter(|| tv.denoise(&call, noisy.view(), out.view_mut())));

        let operator =
            Arc::new(MaskOperator::new(MaskStack::random(shape, 0.5, 0).expect("a valid shape and density")));
        let y = operator.forward(truth.view());
        let problem = Measurement::new(operator, y).expect("a finite measurement of the right size");
        let plan = Plan::new([Stage { sigma: None, iterations: 40 }]);
        group.sample_size(10).throughput(Throughput::Elements(40));
        group.bench_function("gap-tv, 40 iterations", |b| {
            // From within the pool, as the program runs it: from outside each parallel step would wake a thread to begin.
            b.iter(|| {
                rayon::scope(|_| {
                    let mut solver = Gap::with_momentum(Tv::new(0.3), MomentumStart::Zero);
                    run(&mut solver, &problem, Start::Adjoint, &plan, &mut ()).map(|outcome| outcome.relative_residual)
                })
            })
        });
    }
}

criterion_group!(benches, gap_tv);
criterion_main!(benches);
