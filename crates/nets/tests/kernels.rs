//! The convolution kernels against a slow loop in f64, golden arrays, finite differences, and themselves on other threads.

use candle_core::{Device, Result, Tensor, Var};
use nets::kernels::{Blocked, Conv3x3, Isa, PackedConv, Scratch, conv3x3, conv3x3_on};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// A convolution to check.
#[derive(Debug, Clone, Copy)]
struct Case {
    batch: usize,
    inputs: usize,
    outputs: usize,
    height: usize,
    width: usize,
    stride: usize,
    groups: usize,
}

const fn case(
    batch: usize,
    inputs: usize,
    outputs: usize,
    [height, width]: [usize; 2],
    stride: usize,
    groups: usize,
) -> Case {
    Case { batch, inputs, outputs, height, width, stride, groups }
}

const CASES: [Case; 27] = [
    case(1, 1, 1, [1, 1], 1, 1),
    case(2, 1, 64, [1, 9], 1, 1),
    case(1, 64, 1, [9, 1], 1, 1),
    case(2, 3, 5, [3, 5], 1, 1),
    case(1, 5, 64, [17, 23], 1, 1),
    case(1, 12, 96, [8, 8], 1, 1),
    case(1, 13, 32, [7, 33], 1, 1),
    case(2, 64, 64, [13, 18], 1, 1),
    case(1, 64, 4, [12, 16], 1, 1),
    case(1, 90, 32, [6, 11], 1, 1),
    case(1, 96, 12, [16, 31], 1, 1),
    case(1, 17, 33, [35, 37], 1, 1),
    case(1, 48, 48, [1, 1], 1, 1),
    case(1, 48, 48, [2, 70], 1, 1),
    case(1, 16, 16, [255, 257], 1, 1),
    case(1, 12, 90, [9, 14], 1, 3),
    case(2, 64, 64, [5, 6], 1, 4),
    case(1, 20, 20, [5, 6], 1, 20),
    case(1, 1, 1, [1, 1], 2, 1),
    case(1, 3, 5, [3, 5], 2, 1),
    case(2, 5, 7, [1, 8], 2, 1),
    case(1, 5, 7, [8, 1], 2, 1),
    case(1, 32, 64, [16, 18], 2, 1),
    case(1, 13, 40, [15, 33], 2, 1),
    case(2, 64, 32, [9, 70], 2, 1),
    case(1, 12, 90, [9, 14], 2, 3),
    case(1, 6, 2, [2, 2], 2, 2),
];

fn uniform(rng: &mut ChaCha8Rng, len: usize, limit: f32) -> Vec<f32> {
    (0..len).map(|_| rng.random_range(-limit..limit)).collect()
}

impl Case {
    fn out(&self) -> [usize; 2] {
        [self.height.div_ceil(self.stride), self.width.div_ceil(self.stride)]
    }

    fn opts(&self, relu: bool) -> Conv3x3 {
        Conv3x3 { stride: self.stride, groups: self.groups, relu }
    }

    fn operands(&self, seed: u64) -> Operands {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let each = self.inputs / self.groups;
        let [h, w] = self.out();
        // He's scale, so that results are of the size of the inputs
        let scale = (2.0 / (9 * each) as f32).sqrt() * 3f32.sqrt();
        Operands {
            x: uniform(&mut rng, self.batch * self.inputs * self.height * self.width, 4.0),
            w: uniform(&mut rng, self.outputs * each * 9, scale),
            b: uniform(&mut rng, self.outputs, 1.0),
            g: uniform(&mut rng, self.batch * self.outputs * h * w, 1.0),
        }
    }

    /// Calls `f(output, input, weight)` for every product of the convolution's definition.
    fn products(&self, mut f: impl FnMut(usize, usize, usize)) {
        let (in_each, out_each) = (self.inputs / self.groups, self.outputs / self.groups);
        let [out_h, out_w] = self.out();
        for n in 0..self.batch {
            for o in 0..self.outputs {
                for i in 0..in_each {
                    let c = o / out_each * in_each + i;
                    for (y, x) in (0..out_h).flat_map(|y| (0..out_w).map(move |x| (y, x))) {
                        for (ky, kx) in (0..3).flat_map(|ky| (0..3).map(move |kx| (ky, kx))) {
                            let (sy, sx) = (y * self.stride + ky, x * self.stride + kx);
                            if (1..=self.height).contains(&sy) && (1..=self.width).contains(&sx) {
                                f(
                                    ((n * self.outputs + o) * out_h + y) * out_w + x,
                                    ((n * self.inputs + c) * self.height + sy - 1) * self.width + sx - 1,
                                    ((o * in_each + i) * 3 + ky) * 3 + kx,
                                );
                            }
                        }
                    }
                }
            }
        }
    }
}

struct Operands {
    x: Vec<f32>,
    w: Vec<f32>,
    b: Vec<f32>,
    g: Vec<f32>,
}

/// Result and gradients in f64.
struct Exact {
    y: Vec<f64>,
    dx: Vec<f64>,
    dw: Vec<f64>,
    db: Vec<f64>,
}

fn exact(case: &Case, ops: &Operands) -> Exact {
    let [h, w] = case.out();
    let channel = |i: usize| i / (h * w) % case.outputs;
    let mut e = Exact {
        y: (0..ops.g.len()).map(|i| f64::from(ops.b[channel(i)])).collect(),
        dx: vec![0.0; ops.x.len()],
        dw: vec![0.0; ops.w.len()],
        db: vec![0.0; case.outputs],
    };
    for (i, &g) in ops.g.iter().enumerate() {
        e.db[channel(i)] += f64::from(g);
    }
    case.products(|o, i, k| {
        let (x, w, g) = (f64::from(ops.x[i]), f64::from(ops.w[k]), f64::from(ops.g[o]));
        e.y[o] += x * w;
        e.dx[i] += g * w;
        e.dw[k] += g * x;
    });
    e
}

/// Result and gradients of `Σ y·g` by the kernels.
fn ours(isa: Isa, case: &Case, ops: &Operands, relu: bool) -> Result<[Vec<f32>; 4]> {
    let cpu = &Device::Cpu;
    let [h, w] = case.out();
    let x = Var::from_slice(&ops.x, (case.batch, case.inputs, case.height, case.width), cpu)?;
    let k = Var::from_slice(&ops.w, (case.outputs, case.inputs / case.groups, 3, 3), cpu)?;
    let b = Var::from_slice(&ops.b, case.outputs, cpu)?;
    let g = Tensor::from_slice(&ops.g, (case.batch, case.outputs, h, w), cpu)?;
    let y = conv3x3_on(isa, &x, &k, Some(&b), case.opts(relu))?;
    let grads = (&y * &g)?.sum_all()?.backward()?;
    let flat = |t: &Tensor| t.flatten_all()?.to_vec1::<f32>();
    let grad = |v: &Var| flat(grads.get(v).expect("a gradient for every variable"));
    Ok([flat(&y)?, grad(&x)?, grad(&k)?, grad(&b)?])
}

fn rms(v: &[f64]) -> f64 {
    (v.iter().map(|x| x * x).sum::<f64>() / v.len() as f64).sqrt()
}

/// Greatest and RMS difference.
#[track_caller]
fn distance(found: &[f32], expected: &[f64]) -> (f64, f64) {
    assert_eq!(found.len(), expected.len());
    let d: Vec<f64> = found.iter().zip(expected).map(|(&a, &b)| (f64::from(a) - b).abs()).collect();
    // max() would skip NaN
    let max = d.iter().fold(0.0, |m: f64, &d| if d <= m { m } else { d });
    (max, rms(&d))
}

/// Greatest difference, in units of the expected values' RMS (at least 1).
#[track_caller]
fn check(what: &str, found: &[f32], expected: &[f64], bound: f64) {
    let (max, _) = distance(found, expected);
    let unit = rms(expected).max(1.0);
    assert!(max <= bound * unit, "{what}: off by {max:e}, the bound is {:e}", bound * unit);
}

fn available() -> impl Iterator<Item = Isa> {
    Isa::ALL.into_iter().filter(|isa| isa.available())
}

#[test]
fn agrees_with_the_definition() -> Result<()> {
    for (seed, case) in CASES.iter().enumerate() {
        let ops = case.operands(seed as u64);
        let e = exact(case, &ops);
        for isa in available() {
            let [y, dx, dw, db] = ours(isa, case, &ops, false)?;
            let name = |part: &str| format!("{part} of {case:?} on {isa:?}");
            check(&name("y"), &y, &e.y, 3e-5);
            check(&name("dx"), &dx, &e.dx, 3e-5);
            check(&name("dw"), &dw, &e.dw, 3e-5);
            check(&name("db"), &db, &e.db, 1e-5);
        }
    }
    Ok(())
}
