//! GFLOP/s of the 3×3 convolution beside candle's own and the machine's matrix product, one JSON object a line.
//!
//! Counts the multiplications of the definition, whatever the algorithm: `2·n·c²·9·h²` forward, three times that with
//! both gradients. The shapes are those of the Python peer. Times are the least of a few runs.

use candle_core::{CpuStorage, CustomOp1, Device, Layout, Result, Shape, Tensor, Var};
use nets::kernels::{Blocked, Conv3x3, Isa, PackedConv, Scratch, conv3x3, gemm_peak, keep_freed_memory};
use std::hint::black_box;
use std::time::Instant;

const SHAPES: [[usize; 3]; 4] = [[8, 64, 128], [8, 96, 128], [8, 32, 256], [8, 128, 64]];

/// Timed runs of ours.
const RUNS: usize = 12;

/// Seconds of one run: candle's convolution takes so long that it needs no more.
fn once(mut f: impl FnMut() -> Result<()>) -> Result<f64> {
    let start = Instant::now();
    f()?;
    Ok(start.elapsed().as_secs_f64())
}

/// Seconds of the fastest of `runs`, after one that is not counted.
fn best(runs: usize, mut f: impl FnMut() -> Result<()>) -> Result<f64> {
    f()?;
    let mut least = f64::INFINITY;
    for _ in 0..runs {
        let start = Instant::now();
        f()?;
        least = least.min(start.elapsed().as_secs_f64());
    }
    Ok(least)
}

/// Numbers in −1..1 without a pattern that matters.
fn tensor(shape: &[usize]) -> Result<Tensor> {
    let len: usize = shape.iter().product();
    let data: Vec<f32> =
        (0..len as u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 8) as f32 / (1 << 23) as f32 - 1.0).collect();
    Tensor::from_vec(data, shape, &Device::Cpu)
}

/// Hands the gradient `self.0` to its argument, as `backward(gradient)` does in the peer.
struct Seed(Tensor);

impl CustomOp1 for Seed {
    fn name(&self) -> &'static str {
        "seed"
    }

    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        Ok((CpuStorage::F32(vec![0.0]), Shape::from(())))
    }

    fn bwd(&self, _: &Tensor, _: &Tensor, _: &Tensor) -> Result<Option<Tensor>> {
        Ok(Some(self.0.clone()))
    }
}

fn forward_backward(x: &Var, w: &Var, conv: impl Fn(&Tensor, &Tensor) -> Result<Tensor>) -> Result<()> {
    let y = conv(x, w)?;
    let seed = Seed(y.detach());
    black_box(y.apply_op1(seed)?.backward()?);
    Ok(())
}

fn main() -> Result<()> {
    keep_freed_memory();
    let threads = rayon::current_num_threads();
    let isa = Isa::detect().map_err(candle_core::Error::wrap)?;
    let candle_too = std::env::args().all(|a| a != "--no-candle");
    for [n, c, h] in SHAPES {
        let flop = (2 * n * c * c * 9 * h * h) as f64;
        let (x, w) = (tensor(&[n, c, h, h])?, tensor(&[c, c, 3, 3])?);
        let (xv, wv) = (Var::from_tensor(&x)?, Var::from_tensor(&w)?);
        let ours = |x: &Tensor, w: &Tensor| conv3x3(x, w, None, Conv3x3::default());
        let forward = best(RUNS, || ours(&x, &w).map(|y| drop(black_box(y))))?;
        let both = best(RUNS, || forward_backward(&xv, &wv, ours))?;
        let blocked = packed(&x, &w, [n, c, h])?;
        println!(
            "{{\"conv\":\"ours\",\"isa\":\"{}\",\"threads\":{threads},\"batch\":{n},\"channels\":{c},\"size\":{h},\
             \"forward_ms\":{:.3},\"forward_gflops\":{:.1},\"forward_backward_ms\":{:.3},\
             \"forward_backward_gflops\":{:.1},\"packed_forward_gflops\":{:.1}}}",
            isa.name(),
            forward * 1e3,
            flop / forward / 1e9,
            both * 1e3,
            3.0 * flop / both / 1e9,
            flop / blocked / 1e9
        );
        if candle_too {
            let candle = |x: &Tensor, w: &Tensor| x.conv2d(w, 1, 1, 1, 1);
            let forward = once(|| candle(&x, &w).map(|y| drop(black_box(y))))?;
            let both = once(|| forward_backward(&xv, &wv, candle))?;
            println!(
                "{{\"conv\":\"candle\",\"threads\":{threads},\"batch\":{n},\"channels\":{c},\"size\":{h},\
                 \"forward_ms\":{:.3},\"forward_gflops\":{:.1},\"forward_backward_ms\":{:.3},\
                 \"forward_backward_gflops\":{:.1}}}",
                forward * 1e3,
                flop / forward / 1e9,
                both * 1e3,
                3.0 * flop / both / 1e9
            );
        }
    }
    let n = 1536;
    let (a, b) = (tensor(&[n, n])?, tensor(&[n, n])?);
    let seconds = best(5, || a.matmul(&b).map(|y| drop(black_box(y))))?;
    println!(
        "{{\"gemm\":\"candle\",\"threads\":{threads},\"size\":{n},\"gflops\":{:.1}}}",
        2.0 * (n * n * n) as f64 / seconds / 1e9
    );
    println!(
        "{{\"gemm\":\"ours\",\"threads\":{threads},\"gflops\":{:.1}}}",
        gemm_peak(isa).map_err(candle_core::Error::wrap)? / 1e9
    );
    Ok(())
}

/// A batch through the blocked layout, image by image, as a whole network runs it.
fn packed(x: &Tensor, w: &Tensor, [n, c, h]: [usize; 3]) -> Result<f64> {
    let wrap = candle_core::Error::wrap;
    let w = w.flatten_all()?.to_vec1::<f32>()?;
    let x = x.get(0)?.flatten_all()?.to_vec1::<f32>()?;
    let conv = PackedConv::new(&w, None, c, c, Conv3x3::default()).map_err(wrap)?;
    let (mut input, mut output) = (Blocked::default(), Blocked::default());
    let mut scratch = Scratch::default();
    input.read_planes(c, h, h, &x).map_err(wrap)?;
    best(RUNS, || {
        for _ in 0..n {
            conv.forward(&input, &mut output, &mut scratch).map_err(wrap)?;
        }
        black_box(output.row(0, 0));
        Ok(())
    })
}
