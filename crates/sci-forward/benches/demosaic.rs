//! Each demosaicer, and the mosaic operator, in pixels a second, beside a plain copy of the RGB video it writes.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use ndarray::Array4;
use sci_forward::CfaPattern::Rggb;
use sci_forward::bayer::{Bilinear, Demosaicer, Malvar, Menon, mosaic_adjoint_into, mosaic_into};
use sci_forward::testing::uniform;

fn demosaic(c: &mut Criterion) {
    for size in [480, 512] {
        videos_of(c, size);
    }
}

fn videos_of(c: &mut Criterion, size: usize) {
    let frames = 8;
    let mosaic = uniform((frames, size, size), 1);
    let source: Array4<f32> = uniform((frames, 3, size, size), 2);
    let mut rgb = Array4::zeros(source.dim());
    let mut sampled = mosaic.clone();
    let mut group = c.benchmark_group(format!("{size}x{size}x{frames}"));
    group.throughput(Throughput::Elements(mosaic.len() as u64)).sample_size(20);
    group.bench_function("copy", |b| b.iter(|| ndarray::Zip::from(&mut rgb).and(&source).par_for_each(|a, &b| *a = b)));
    group.bench_function("mosaic", |b| b.iter(|| mosaic_into(Rggb, source.view(), sampled.view_mut())));
    group.bench_function("mosaic adjoint", |b| b.iter(|| mosaic_adjoint_into(Rggb, mosaic.view(), rgb.view_mut())));
    group.bench_function("bilinear", |b| b.iter(|| Bilinear.demosaic(Rggb, mosaic.view(), rgb.view_mut())));
    group.bench_function("malvar", |b| b.iter(|| Malvar.demosaic(Rggb, mosaic.view(), rgb.view_mut())));
    group.bench_function("menon", |b| b.iter(|| Menon.demosaic(Rggb, mosaic.view(), rgb.view_mut())));
}

criterion_group!(benches, demosaic);
criterion_main!(benches);
