//! `H`, its adjoint and the data step, in bytes of video, masks and measurement moved a second, beside a plain copy.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use ndarray::Array3;
use sci_forward::{DataStep, MaskOperator, MaskStack, SensingOperator, VideoShape, testing::uniform};

fn operator(c: &mut Criterion) {
    for size in [256, 1024] {
        let shape = VideoShape { frames: 8, height: size, width: size };
        let operator = MaskOperator::new(MaskStack::random(shape, 0.5, 0).expect("a valid shape and density"));
        let x = uniform(shape.dim(), 1);
        let mut y = operator.forward(x.view());
        let mut y1 = y.clone();
        let measured = y.clone();
        let video = (x.len() * size_of::<f32>()) as u64;
        let image = (y.len() * size_of::<f32>()) as u64;

        let mut group = c.benchmark_group(format!("{size}x{size}x8"));
        group.throughput(Throughput::Bytes(2 * video));
        let mut copy = Array3::zeros(shape.dim());
        group.bench_function("copy", |b| b.iter(|| ndarray::Zip::from(&mut copy).and(&x).par_for_each(|a, &b| *a = b)));
        group.throughput(Throughput::Bytes(2 * video + image));
        group.bench_function("forward", |b| b.iter(|| operator.forward_into(x.view(), y.view_mut())));
        group.bench_function("adjoint", |b| b.iter(|| operator.adjoint_into(measured.view(), copy.view_mut())));
        group.throughput(Throughput::Bytes(3 * video + 2 * image));
        group.bench_function("projection", |b| {
            b.iter(|| operator.data_step(DataStep::projection(measured.view()), x.view(), copy.view_mut()))
        });
        let previous = x.clone();
        group.bench_function("progress", |b| b.iter(|| operator.progress(measured.view(), x.view(), previous.view())));
        group.throughput(Throughput::Bytes(3 * video + 4 * image));
        group.bench_function("accelerated projection", |b| {
            b.iter(|| {
                operator.data_step(
                    DataStep { momentum: Some(&mut y1), ..DataStep::projection(measured.view()) },
                    x.view(),
                    copy.view_mut(),
                )
            })
        });
    }
}

criterion_group!(benches, operator);
criterion_main!(benches);
