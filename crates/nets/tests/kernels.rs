//! The convolution kernels against a slow loop in f64, golden arrays, finite differences, and themselves on other threads.

use candle_core::{DType, Device, Result, Tensor, Var};
use nets::kernels::{
    Blocked, Conv3x3, Isa, LANES, Link, PackedConv, Precision, Scratch, conv_chain, conv3x3, conv3x3_on,
};
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

const CASES: [Case; 29] = [
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
    case(1, 2, 3, [1, 1], 2, 1),
    case(1, 6, 5, [1, 8], 2, 1),
];

fn uniform(rng: &mut ChaCha8Rng, len: usize, limit: f32) -> Vec<f32> {
    (0..len).map(|_| rng.random_range(-limit..limit)).collect()
}

impl Case {
    fn out(&self) -> [usize; 2] {
        [self.height.div_ceil(self.stride), self.width.div_ceil(self.stride)]
    }

    fn opts(&self, relu: bool) -> Conv3x3 {
        Conv3x3 { stride: self.stride, groups: self.groups, relu, ..Conv3x3::default() }
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
    ours_with(isa, case, ops, case.opts(relu))
}

fn ours_with(isa: Isa, case: &Case, ops: &Operands, opts: Conv3x3) -> Result<[Vec<f32>; 4]> {
    let cpu = &Device::Cpu;
    let [h, w] = case.out();
    let x = Var::from_slice(&ops.x, (case.batch, case.inputs, case.height, case.width), cpu)?;
    let k = Var::from_slice(&ops.w, (case.outputs, case.inputs / case.groups, 3, 3), cpu)?;
    let b = Var::from_slice(&ops.b, case.outputs, cpu)?;
    let g = Tensor::from_slice(&ops.g, (case.batch, case.outputs, h, w), cpu)?;
    let y = conv3x3_on(isa, &x, &k, Some(&b), opts)?;
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

/// Of numbers that are bf16 already, products in bf16 are exact.
#[test]
fn bf16_rounds_what_it_multiplies_and_nothing_else() -> Result<()> {
    for (seed, case) in CASES.iter().enumerate() {
        let mut ops = case.operands(seed as u64);
        for v in [&mut ops.x, &mut ops.w, &mut ops.g].into_iter().flatten() {
            *v = f32::from_bits(v.to_bits() & 0xffff_0000);
        }
        let e = exact(case, &ops);
        for isa in available() {
            let opts = Conv3x3 { precision: Precision::Bf16, ..case.opts(false) };
            let found = ours_with(isa, case, &ops, opts)?;
            for ((found, e), part) in found.iter().zip([&e.y, &e.dx, &e.dw, &e.db]).zip(["y", "dx", "dw", "db"]) {
                check(&format!("{part} of {case:?} on {isa:?}"), found, e, 3e-5);
            }
        }
    }
    Ok(())
}

/// A chain in bf16, strides and ReLUs among its layers, learns what one in f32 does, on any number of threads the same.
#[test]
fn gradients_of_a_chain_in_bf16_are_near_those_in_f32() -> Result<()> {
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    let cpu = &Device::Cpu;
    let x = Var::from_vec(uniform(&mut rng, 2 * 3 * 22 * 38, 1.0), (2, 3, 22, 38), cpu)?;
    let mut shape = |o: usize, i: usize| {
        let scale = (6.0 / (9 * i) as f32).sqrt();
        let w = Var::from_vec(uniform(&mut rng, o * i * 9, scale), (o, i, 3, 3), cpu)?;
        Ok::<_, candle_core::Error>((w, Var::from_vec(uniform(&mut rng, o, 0.1), o, cpu)?))
    };
    let params = [shape(40, 3)?, shape(70, 40)?, shape(33, 70)?, shape(8, 33)?];
    let gradients = |precision: Precision| -> Result<Vec<f32>> {
        let link = |((w, b), (stride, relu)): (&(Var, Var), (usize, bool))| {
            let opts = Conv3x3 { stride, relu, precision, ..Conv3x3::default() };
            Link::new(w.as_tensor().clone(), Some(b.as_tensor().clone()), opts)
        };
        let kinds = [(1, true), (2, true), (1, true), (1, false)];
        let y = conv_chain(&x, &params.iter().zip(kinds).map(link).collect::<Vec<_>>())?;
        let grads = y.sqr()?.sum_all()?.backward()?;
        let vars = params.iter().flat_map(|(w, b)| [w, b]).chain([&x]);
        let flat = vars.map(|v| grads.get(v).expect("a gradient for every variable").flatten_all()?.to_vec1::<f32>());
        Ok(flat.collect::<Result<Vec<_>>>()?.concat())
    };
    let exact = gradients(Precision::F32)?;
    let found = gradients(Precision::Bf16)?;
    let norm = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let both = exact.iter().zip(&found).map(|(&a, &b)| f64::from(a - b)).collect::<Vec<_>>();
    let error = norm(&both) / norm(&exact.iter().map(|&v| v.into()).collect::<Vec<_>>());
    println!("relative error of the gradient in bf16: {error:.2e}");
    assert!(error < 2e-2, "{error}");
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert!(one.install(|| gradients(Precision::Bf16))? == found);
    Ok(())
}

/// A small U of layers, two of which are shuffled onto earlier ones: its result, and its gradient by input and parameters.
fn u_shaped(dtype: DType, precision: Precision) -> Result<Vec<f64>> {
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let mut var = |shape: &[usize], limit: f32| {
        let values = uniform(&mut rng, shape.iter().product(), limit);
        Var::from_tensor(&Tensor::from_vec(values, shape, &Device::Cpu)?.to_dtype(dtype)?)
    };
    let x = var(&[3, 3, 20, 44], 1.0)?;
    let (mut links, mut vars) = (Vec::new(), vec![x.clone()]);
    for (outputs, inputs, stride, relu, onto) in [
        (36, 3, 1, true, None),
        (21, 36, 2, true, None),
        (40, 21, 2, true, None),
        (84, 40, 1, false, Some(1)),
        (19, 21, 1, true, None),
        (144, 19, 1, false, Some(0)),
        (5, 36, 1, false, None),
    ] {
        let weight = var(&[outputs, inputs, 3, 3], (6.0 / (9 * inputs) as f32).sqrt())?;
        let bias = if onto.is_none() { Some(var(&[outputs], 0.1)?) } else { None };
        let opts = Conv3x3 { stride, relu, precision, ..Conv3x3::default() };
        let tensor = |var: &Var| var.as_tensor().clone();
        links.push(Link { onto, ..Link::new(tensor(&weight), bias.as_ref().map(tensor), opts) });
        vars.extend([weight].into_iter().chain(bias));
    }
    let y = conv_chain(&x, &links)?;
    let grads = y.sqr()?.sum_all()?.backward()?;
    let flat = |t: &Tensor| t.flatten_all()?.to_dtype(DType::F64)?.to_vec1::<f64>();
    let mut all = flat(&y)?;
    for var in &vars {
        all.extend(flat(grads.get(var).expect("a gradient for every variable"))?);
    }
    Ok(all)
}

#[test]
fn results_shuffled_onto_earlier_ones_are_those_of_candle() -> Result<()> {
    let exact = u_shaped(DType::F64, Precision::F32)?;
    for (precision, bound) in [(Precision::F32, 1e-5), (Precision::Bf16, 2e-2)] {
        let found = u_shaped(DType::F32, precision)?;
        let square = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>().sqrt();
        let error = square(&mut exact.iter().zip(&found).map(|(a, b)| a - b)) / square(&mut exact.iter().copied());
        println!("relative error of results and gradients, {precision:?}: {error:.2e}");
        assert!(error < bound, "{precision:?}: {error}");
    }
    Ok(())
}

#[test]
fn layers_that_cannot_be_shuffled_onto_others_are_refused() -> Result<()> {
    let tensor = |shape: &[usize]| Tensor::ones(shape, DType::F32, &Device::Cpu);
    let x = tensor(&[1, 2, 6, 6])?;
    let link = |outputs: usize, stride: usize, onto: Option<usize>| {
        let link = Link::new(tensor(&[outputs, 2, 3, 3])?, None, Conv3x3 { stride, ..Conv3x3::default() });
        Result::Ok(Link { onto, ..link })
    };
    for (links, expected) in [
        (
            vec![link(2, 1, None)?, link(8, 1, Some(1))?, link(2, 1, None)?],
            "layer 1 of 8 channels cannot go onto layer 1",
        ),
        (
            vec![link(2, 1, None)?, link(4, 1, Some(0))?, link(2, 1, None)?],
            "layer 1 of 4 channels cannot go onto layer 0",
        ),
        (vec![link(2, 2, None)?, link(8, 1, Some(0))?], "layer 1 of 8 channels cannot go onto layer 0"),
        (vec![link(2, 1, None)?, link(8, 1, Some(0))?, link(2, 1, None)?], "twice 6×6, of layer 1, is not the size"),
        (
            vec![link(2, 1, None)?, link(8, 1, Some(0))?, link(8, 1, Some(0))?, link(2, 1, None)?],
            "layer 2 of 8 channels cannot go onto layer 0",
        ),
    ] {
        let error = conv_chain(&x, &links).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    Ok(())
}

/// Standard normal weights times He's scale, as networks have them.
fn network_operands(case: &Case, seed: u64) -> Operands {
    use rand_distr::{Distribution, StandardNormal};
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let scale = (2.0 / (9 * case.inputs) as f32).sqrt();
    let mut ops = case.operands(seed);
    for w in &mut ops.w {
        let z: f32 = StandardNormal.sample(&mut rng);
        *w = z * scale;
    }
    ops
}

/// The errors that the module header states.
#[test]
fn error_against_f64_is_as_stated() -> Result<()> {
    for (channels, bounds) in [(64, BOUNDS_64), (96, BOUNDS_96)] {
        let case = case(1, channels, channels, [40, 40], 1, 1);
        let ops = network_operands(&case, 1);
        let e = exact(&case, &ops);
        for isa in available() {
            let bounds = if isa == Isa::Amx { BOUNDS_AMX } else { bounds };
            let found = ours(isa, &case, &ops, false)?;
            let expected = [&e.y, &e.dx, &e.dw];
            for (((part, f), e), (max_bound, rms_bound)) in
                ["y", "dx", "dw"].iter().zip(&found).zip(expected).zip(bounds)
            {
                let (max, mean) = distance(f, e);
                println!("{channels} channels, {isa:?}, {part}: max {max:.2e}, RMS {mean:.2e}, of RMS {:.2}", rms(e));
                assert!(
                    max <= max_bound && mean <= rms_bound,
                    "{channels} channels, {isa:?}, {part}: max {max:e}, RMS {mean:e}"
                );
            }
        }
    }
    Ok(())
}

/// (max, RMS) for the result, the gradient by input and the gradient by weight.
const BOUNDS_64: [(f64, f64); 3] = [(5e-5, 5e-6), (1.2e-5, 1.2e-6), (3.4e-4, 6e-5)];
const BOUNDS_AMX: [(f64, f64); 3] = [(1.3e-4, 2.7e-5), (3.4e-5, 6.8e-6), (3.4e-4, 6e-5)];
const BOUNDS_96: [(f64, f64); 3] = [(5.5e-5, 6e-6), (1.4e-5, 1.5e-6), (3.4e-4, 6e-5)];

#[test]
fn agrees_with_pytorch() -> std::result::Result<(), Box<dyn std::error::Error>> {
    let Some(path) = test_data::file("golden/conv3x3.npz") else { return Ok(()) };
    let mut npz = ndarray_npy::NpzReader::new(std::fs::File::open(path)?)?;
    for k in 0..4 {
        let mut array = |name: &str| npz.by_name::<ndarray::OwnedRepr<f32>, ndarray::IxDyn>(&format!("{k}_{name}"));
        let [x, w, b, g] = [array("x")?, array("w")?, array("b")?, array("g")?];
        let expected = [array("y")?, array("dx")?, array("dw")?, array("db")?];
        let (s, o) = (x.shape(), w.shape()[0]);
        let case = case(s[0], s[1], o, [s[2], s[3]], 1, 1);
        let flat = |a: &ndarray::ArrayD<f32>| a.iter().copied().collect::<Vec<f32>>();
        let ops = Operands { x: flat(&x), w: flat(&w), b: flat(&b), g: flat(&g) };
        for isa in available() {
            let bound = if isa == Isa::Amx { 4e-5 } else { 2e-5 };
            let found = ours(isa, &case, &ops, false)?;
            for ((found, expected), part) in found.iter().zip(&expected).zip(["y", "dx", "dw", "db"]) {
                let expected: Vec<f64> = expected.iter().map(|&v| v.into()).collect();
                check(&format!("{part} of golden {k} on {isa:?}"), found, &expected, bound);
            }
        }
    }
    Ok(())
}

/// `Σ y·g` is linear in each argument, so a central difference of any width is its derivative.
#[test]
fn gradients_are_finite_differences() -> Result<()> {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for case in [
        case(2, 17, 20, [6, 9], 1, 1),
        case(1, 6, 20, [5, 7], 1, 2),
        case(2, 7, 18, [5, 8], 2, 1),
        case(1, 6, 4, [6, 5], 2, 2),
    ] {
        let ops = case.operands(4);
        let isa = Isa::detect().map_err(candle_core::Error::wrap)?;
        let [_, dx, dw, db] = ours(isa, &case, &ops, false)?;
        let loss = |ops: &Operands| -> Result<f64> {
            let [y, ..] = ours(isa, &case, ops, false)?;
            Ok(y.iter().zip(&ops.g).map(|(&y, &g)| f64::from(y) * f64::from(g)).sum())
        };
        for (pick, grad) in [(0, &dx), (1, &dw), (2, &db)] {
            for _ in 0..6 {
                let at = rng.random_range(0..grad.len());
                let moved = |by: f32| {
                    let mut ops = case.operands(4);
                    let target = [&mut ops.x, &mut ops.w, &mut ops.b];
                    target.into_iter().nth(pick).expect("three arguments")[at] += by;
                    loss(&ops)
                };
                let difference = (moved(1.0)? - moved(-1.0)?) / 2.0;
                let error = (difference - f64::from(grad[at])).abs();
                assert!(
                    error < 2e-3 * difference.abs().max(1.0),
                    "{case:?}, argument {pick} at {at}: {difference} by difference, {} by the kernel",
                    grad[at]
                );
            }
        }
    }
    Ok(())
}

#[test]
fn relu_cuts_the_result_and_its_gradient() -> Result<()> {
    for case in [case(2, 20, 33, [9, 14], 1, 1), case(1, 7, 5, [9, 14], 2, 1)] {
        let mut ops = case.operands(5);
        for isa in available() {
            let [plain, ..] = ours(isa, &case, &ops, false)?;
            let [y, dx, dw, db] = ours(isa, &case, &ops, true)?;
            let cut: Vec<f32> = plain.iter().map(|&v| v.max(0.0)).collect();
            assert_eq!(y, cut, "{case:?} on {isa:?}");
            let g = ops.g.clone();
            for (g, &y) in ops.g.iter_mut().zip(&y) {
                *g = if y > 0.0 { *g } else { 0.0 };
            }
            let e = exact(&case, &ops);
            ops.g = g;
            check("dx behind a ReLU", &dx, &e.dx, 3e-5);
            check("dw behind a ReLU", &dw, &e.dw, 3e-5);
            check("db behind a ReLU", &db, &e.db, 1e-5);
        }
    }
    Ok(())
}

fn on_threads<R: Send>(threads: usize, f: impl FnOnce() -> R + Send) -> R {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool").install(f)
}

fn bits(v: &[Vec<f32>]) -> Vec<Vec<u32>> {
    v.iter().map(|v| v.iter().map(|x| x.to_bits()).collect()).collect()
}

#[test]
fn same_bits_on_any_number_of_threads() {
    for case in [case(5, 64, 40, [33, 70], 1, 1), case(3, 5, 20, [90, 140], 1, 1), case(3, 12, 30, [70, 41], 2, 3)] {
        let ops = case.operands(6);
        for isa in available() {
            let run = |threads| on_threads(threads, || bits(&ours(isa, &case, &ops, true).expect("a result")));
            let one = run(1);
            for threads in [2, 3] {
                assert!(run(threads) == one, "{case:?} on {isa:?}, {threads} threads");
            }
        }
    }
}

/// A convolution of one image in the blocked layout.
fn packed(isa: Isa, case: &Case, ops: &Operands, relu: bool) -> PackedConv {
    PackedConv::new_on(isa, &ops.w, Some(&ops.b), case.inputs, case.outputs, case.opts(relu))
        .expect("a valid convolution")
}

/// Fills the lanes beyond the last channel.
fn fill_beyond(image: &mut Blocked, value: f32) {
    let (channels, height, _) = image.shape();
    let last = image.blocks() - 1;
    for y in 0..height {
        let lanes = image.row_mut(last, y).chunks_exact_mut(LANES);
        lanes.for_each(|pixel| pixel[channels - last * LANES..].fill(value));
    }
}

/// Whatever scratch, output and unused lanes held before, the result is that of planes, bit for bit.
#[test]
fn blocked_images_give_the_bits_of_planes() -> Result<()> {
    let mut scratch = Scratch::default();
    for isa in available() {
        for c in CASES.iter().filter(|c| c.batch == 1) {
            let ops = c.operands(7);
            let conv = packed(isa, c, &ops, true);
            let mut input = Blocked::default();
            let mut output = Blocked::default();
            let nan = vec![f32::NAN; ops.x.len()];
            for x in [&nan, &ops.x] {
                input.read_planes(c.inputs, c.height, c.width, x).expect("a whole image");
                fill_beyond(&mut input, f32::NAN);
                conv.forward(&input, &mut output, &mut scratch).expect("channels that fit");
            }
            let [h, w] = c.out();
            assert_eq!(output.shape(), (c.outputs, h, w));
            let mut found = vec![f32::NAN; c.outputs * h * w];
            output.write_planes(&mut found).expect("a whole image");
            let [expected, ..] = ours(isa, c, &ops, true)?;
            assert!(bits(&[found]) == bits(&[expected]), "{c:?} on {isa:?}");
        }
    }
    Ok(())
}

/// An image through a convolution of 16-bit numbers.
fn in_half_precision(isa: Isa, case: &Case, ops: &Operands, x: &[f32]) -> Vec<f32> {
    in_half_precision_beside(isa, case, ops, x, 0.0)
}

/// The same with `beyond` in the lanes beyond the last channel.
fn in_half_precision_beside(isa: Isa, case: &Case, ops: &Operands, x: &[f32], beyond: f32) -> Vec<f32> {
    let opts = Conv3x3 { precision: Precision::Bf16, ..case.opts(false) };
    let conv = PackedConv::new_on(isa, &ops.w, Some(&ops.b), case.inputs, case.outputs, opts).expect("valid");
    let (mut input, mut output) = (Blocked::default(), Blocked::default());
    input.read_planes(case.inputs, case.height, case.width, x).expect("a whole image");
    fill_beyond(&mut input, beyond);
    conv.forward(&input, &mut output, &mut Scratch::default()).expect("channels that fit");
    let [h, w] = case.out();
    let mut found = vec![f32::NAN; case.outputs * h * w];
    output.write_planes(&mut found).expect("a whole image");
    found
}

/// Those whose 16-bit numbers are integers; the matrix unit has images of its own.
fn with_integers() -> impl Iterator<Item = Isa> {
    available().filter(|isa| isa.half_precision() == "int16")
}

#[test]
fn products_of_integers_are_near_those_of_f32_whatever_the_unit() {
    let cases = CASES.iter().filter(|c| c.batch == 1 && (c.inputs / c.groups).is_multiple_of(2));
    for (seed, c) in cases.enumerate() {
        let mut ops = c.operands(seed as u64);
        ops.b.fill(0.0);
        let e = exact(c, &ops);
        for isa in with_integers() {
            for unit in [1.0, 1e-20, 1e20] {
                let x: Vec<f32> = ops.x.iter().map(|x| x * unit).collect();
                let found: Vec<f32> = in_half_precision(isa, c, &ops, &x).iter().map(|y| y / unit).collect();
                let (most, usual) = distance(&found, &e.y);
                let of = rms(&e.y);
                println!("{c:?} on {isa:?}: {:.1e}, RMS {:.1e}", most / of, usual / of);
                assert!(most < 2e-2 * of && usual < 3e-3 * of, "{c:?} on {isa:?}: {most:e}, {usual:e} of {of}");
            }
        }
    }
}

#[test]
fn lanes_beyond_the_last_channel_are_not_read_in_integers() {
    for c in [case(1, 6, 90, [9, 14], 1, 3), case(1, 20, 16, [9, 14], 2, 1), case(1, 90, 32, [9, 14], 1, 1)] {
        let ops = c.operands(3);
        for isa in with_integers() {
            let run = |beyond| bits(&[in_half_precision_beside(isa, &c, &ops, &ops.x, beyond)]);
            assert!(run(0.0) == run(f32::NAN), "{c:?} on {isa:?}");
            assert!(run(0.0) == run(1e9), "{c:?} on {isa:?}");
        }
    }
}

#[test]
fn filters_that_are_not_finite_give_no_finite_result_in_integers() {
    for c in [case(1, 32, 16, [8, 8], 1, 1), case(1, 32, 16, [8, 8], 2, 1)] {
        for wrong in [f32::NAN, f32::INFINITY] {
            let mut ops = c.operands(4);
            ops.w[4] = wrong;
            for isa in with_integers() {
                let found = in_half_precision(isa, &c, &ops, &ops.x);
                let plane = found.len() / c.outputs;
                assert!(!found[c.out()[1] + 1].is_finite(), "{c:?} on {isa:?}");
                assert!(found[plane..].iter().all(|y| y.is_finite()), "{c:?} on {isa:?}");
            }
        }
    }
}

/// Pixels and filters that are as large as the largest, all of one sign: no sum is too large for its integer.
#[test]
fn sums_of_integers_do_not_overflow() {
    // By the definition 2304 equal filters are rounded the same way.
    for (c, bound) in [(case(1, 256, 16, [8, 8], 1, 1), 1e-3), (case(1, 256, 16, [8, 8], 2, 1), 5e-3)] {
        let mut ops = c.operands(1);
        ops.w.fill(0.01);
        ops.b.fill(0.0);
        let x = vec![3.0; ops.x.len()];
        for isa in with_integers() {
            let found = in_half_precision(isa, &c, &ops, &x)[c.out()[1] + 1];
            let inside = 256.0 * 9.0 * 0.03;
            assert!((found / inside - 1.0).abs() < bound, "{found} is not {inside}, {c:?} on {isa:?}");
        }
    }
}

#[test]
fn images_of_zeros_and_pixels_that_are_not_finite_stay_such_in_integers() {
    for c in [case(1, 32, 20, [50, 300], 1, 1), case(1, 32, 20, [50, 300], 2, 1)] {
        let ops = c.operands(2);
        let [h, w] = c.out();
        for isa in with_integers() {
            let zeros = vec![0.0; ops.x.len()];
            let found = in_half_precision(isa, &c, &ops, &zeros);
            assert!(found.chunks_exact(h * w).zip(&ops.b).all(|(plane, b)| plane.iter().all(|y| y == b)), "{isa:?}");
            for wrong in [f32::NAN, f32::INFINITY] {
                let mut x = ops.x.clone();
                x[2 * c.width + 4] = wrong;
                let found = in_half_precision(isa, &c, &ops, &x);
                assert!(found[2 / c.stride * w + 4 / c.stride].is_nan(), "{c:?} on {isa:?}");
                assert!(found[h * w - 1].is_finite(), "a far pixel of {c:?} on {isa:?}");
            }
            let run = |threads| on_threads(threads, || bits(&[in_half_precision(isa, &c, &ops, &ops.x)]));
            assert!(run(1) == run(3), "{c:?} on {isa:?}");
        }
    }
}

#[test]
fn planes_survive_the_blocked_layout() {
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    let mut image = Blocked::default();
    for (c, h, w) in [(1, 1, 1), (16, 16, 16), (17, 3, 35), (48, 2, 31), (5, 4, 40)] {
        let planes = uniform(&mut rng, c * h * w, 1.0);
        image.read_planes(c, h, w, &planes).expect("a whole image");
        assert_eq!(image.row(0, h - 1)[(w - 1) * LANES], planes[h * w - 1]);
        let mut back = vec![f32::NAN; planes.len()];
        image.write_planes(&mut back).expect("a whole image");
        assert_eq!(back, planes);
    }
}

#[test]
fn a_nan_reaches_its_pixel_and_stops_nothing() -> Result<()> {
    for c in [case(1, 20, 20, [9, 9], 1, 1), case(1, 5, 5, [9, 9], 2, 1)] {
        let mut ops = c.operands(9);
        let [h, w] = c.out();
        ops.x[4 * c.width + 4] = f32::NAN;
        ops.g[0] = f32::INFINITY;
        for isa in available() {
            let [y, dx, dw, db] = ours(isa, &c, &ops, true)?;
            assert!(y[4 / c.stride * w + 4 / c.stride].is_nan(), "{c:?} on {isa:?}");
            assert!(y[h * w - 1].is_finite(), "a far pixel of {c:?} on {isa:?}");
            assert_eq!((dx.len(), dw.len(), db.len()), (ops.x.len(), ops.w.len(), c.outputs));
        }
    }
    Ok(())
}

#[test]
fn only_what_is_asked_for_gets_a_gradient() -> Result<()> {
    let cpu = &Device::Cpu;
    let x = Tensor::ones((1, 3, 4, 4), DType::F32, cpu)?;
    let w = Var::ones((2, 3, 3, 3), DType::F32, cpu)?;
    let y = conv3x3(&x, &w, None, Conv3x3::default())?;
    let grads = y.sum_all()?.backward()?;
    assert!(grads.get(&x).is_none() && grads.get(&w).is_some());
    Ok(())
}

/// f64 takes candle's own path, which is then an oracle of ours, strided views included.
#[test]
fn other_types_take_candles_path() -> Result<()> {
    let c = case(2, 6, 8, [7, 10], 2, 2);
    let ops = c.operands(10);
    let cpu = &Device::Cpu;
    let x = Tensor::from_slice(&ops.x, (2, 6, 10, 7), cpu)?.transpose(2, 3)?;
    let w = Tensor::from_slice(&ops.w, (8, 3, 3, 3), cpu)?;
    let b = Tensor::from_slice(&ops.b, 8, cpu)?;
    let fast = conv3x3(&x, &w, Some(&b), c.opts(true))?;
    let f64 = |t: &Tensor| t.to_dtype(DType::F64);
    let slow = conv3x3(&f64(&x)?, &f64(&w)?, Some(&f64(&b)?), c.opts(true))?;
    assert_eq!((fast.dtype(), slow.dtype()), (DType::F32, DType::F64));
    check("conv3x3", &fast.flatten_all()?.to_vec1()?, &slow.flatten_all()?.to_vec1()?, 1e-5);
    Ok(())
}

#[test]
fn broken_rules_are_named() -> Result<()> {
    let new = |w: usize, i, o, stride, groups| {
        let opts = Conv3x3 { stride, groups, ..Conv3x3::default() };
        PackedConv::new(&vec![0.0; w], None, i, o, opts).map(drop).unwrap_err().to_string()
    };
    assert_eq!(new(9, 1, 1, 3, 1), "stride 3; it can be 1 or 2");
    assert_eq!(new(9, 3, 2, 1, 2), "2 groups do not divide 3 input and 2 output channels");
    assert_eq!(new(9, 3, 2, 1, 0), "0 groups do not divide 3 input and 2 output channels");
    assert_eq!(new(8, 1, 1, 1, 1), "8 numbers where the shape has 9");
    assert_eq!(
        Isa::named("sse").unwrap_err().to_string(),
        "SCI_KERNEL is \"sse\"; it can be amx, avx512, avx2, neon or portable"
    );
    assert_eq!(Isa::named("portable"), Ok(Isa::Portable));
    for isa in Isa::ALL {
        assert_eq!(Isa::named(isa.name()).is_ok(), isa.available());
    }

    let conv = PackedConv::new(&[0.0; 9], None, 1, 1, Conv3x3::default()).expect("valid");
    let (mut out, mut scratch) = (Blocked::default(), Scratch::default());
    let mut forward = |image: &Blocked| conv.forward(image, &mut out, &mut scratch).unwrap_err().to_string();
    assert_eq!(forward(&Blocked::zeros(2, 3, 3)), "2 channels go into a convolution of 1");
    assert_eq!(forward(&Blocked::zeros(1, 0, 3)), "an empty image: [1, 1, 0, 3]");

    let zeros = |s: &[usize]| Tensor::zeros(s, DType::F32, &Device::Cpu);
    for (x, w, b) in [
        (vec![1, 2, 4, 4], vec![1, 3, 3, 3], vec![1]),
        (vec![1, 2, 4, 4], vec![1, 2, 5, 5], vec![1]),
        (vec![1, 2, 4, 4], vec![3, 2, 3, 3], vec![2]),
        (vec![2, 4, 4], vec![3, 2, 3, 3], vec![3]),
        (vec![1, 2, 0, 4], vec![1, 2, 3, 3], vec![1]),
    ] {
        let (x, w, b) = (zeros(&x)?, zeros(&w)?, zeros(&b)?);
        assert!(conv3x3(&x, &w, Some(&b), Conv3x3::default()).is_err(), "{x:?} {w:?} {b:?}");
    }
    Ok(())
}

/// The choice is read once per process, so this runs another test in processes of its own.
#[test]
fn environment_chooses_the_instruction_set() -> std::io::Result<()> {
    let run = |name: &str| {
        std::process::Command::new(std::env::current_exe()?)
            .args(["--exact", "only_what_is_asked_for_gets_a_gradient"])
            .env("SCI_KERNEL", name)
            .output()
    };
    for isa in Isa::ALL {
        assert_eq!(run(isa.name())?.status.success(), isa.available(), "{isa:?}");
    }
    let refused = run("mmx")?;
    assert!(!refused.status.success());
    let said = String::from_utf8_lossy(&refused.stdout).into_owned();
    assert!(said.contains("amx, avx512, avx2, neon or portable"), "{said}");
    Ok(())
}

proptest::proptest! {
    #![proptest_config(proptest::prelude::ProptestConfig { cases: 48, failure_persistence: None, ..Default::default() })]

    #[test]
    fn any_shape_agrees_with_the_definition(
        batch in 1usize..3, groups in 1usize..4, inputs in 1usize..24, outputs in 1usize..24,
        height in 1usize..20, width in 1usize..40, stride in 1usize..3, seed: u64,
    ) {
        let c = case(batch, groups * inputs, groups * outputs, [height, width], stride, groups);
        let ops = c.operands(seed);
        let e = exact(&c, &ops);
        for isa in available() {
            let [y, dx, dw, db] = ours(isa, &c, &ops, false).expect("a result");
            check("y", &y, &e.y, 3e-5);
            check("dx", &dx, &e.dx, 3e-5);
            check("dw", &dw, &e.dw, 5e-5);
            check("db", &db, &e.db, 1e-5);
        }
    }
}
