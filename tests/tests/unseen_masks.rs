//! What a denoiser gained by training on iterates is no habit of the masks it was trained with.

use e2e::{Bench, on_the_demo};
use ndarray::Array3;

const FRAMES: usize = 4;
const SIDE: usize = 256;

/// Whether a mask is open at frame, row and column.
type Open = fn((usize, usize, usize)) -> bool;

/// A hash of a place: the same random bit in all runs.
fn bit(t: usize, y: usize, x: usize) -> bool {
    let mut h = (t as u64) << 40 | (y as u64) << 20 | x as u64;
    for _ in 0..3 {
        h = (h ^ (h >> 31)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    }
    h >> 63 == 1
}

/// Every pixel for itself, as in training.
fn random((t, y, x): (usize, usize, usize)) -> bool {
    bit(t, y, x)
}

/// One mask that moves down a row a frame.
fn shifting((t, y, x): (usize, usize, usize)) -> bool {
    bit(0, (y + t) % SIDE, x)
}

/// Blocks of 2 × 2 pixels.
fn blocky((t, y, x): (usize, usize, usize)) -> bool {
    bit(t, y / 2, x / 2)
}

/// Rows of a Walsh-Hadamard matrix of order 2¹⁶, one for each frame, their columns shuffled.
fn hadamard((t, y, x): (usize, usize, usize)) -> bool {
    let column = (y * SIDE + x).wrapping_mul(40_503) % (SIDE * SIDE);
    let row = [0x5a3d, 0xc6b1, 0x39e7, 0x9d4b][t];
    (row & column).count_ones().is_multiple_of(2)
}

/// PSNR in the schedule that `gray/fastdvdnet.toml` has for the trained denoiser.
fn psnr(bench: &Bench, mask: &str, weights: &str) -> f64 {
    let mask = format!("kind = \"file\"\npath = \"{mask}.npy\"");
    bench.write("scene.toml", on_the_demo("gray/fastdvdnet.toml", &mask));
    let set = format!("denoiser.weights=bundled:{weights}");
    let run = bench.sci(&[
        "run",
        "scene.toml",
        "--out",
        "out",
        "--set",
        &set,
        "--set",
        "output.frames=false",
        "--set",
        "data.measurements=[0]",
    ]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    bench.record("out")["measurements"][0]["psnr_db"].as_f64().unwrap()
}

#[test]
fn masks_of_a_kind_unseen_in_training_lose_no_gain() {
    let bench = Bench::new();
    let gain = |name: &str, open: Open| {
        let masks = Array3::from_shape_fn((FRAMES, SIDE, SIDE), |at| f32::from(u8::from(open(at))));
        ndarray_npy::write_npy(bench.path(&format!("{name}.npy")), &masks).unwrap();
        let [before, after] = ["fastdvdnet_gray", "fastdvdnet_gray_sci"].map(|weights| psnr(&bench, name, weights));
        println!("{name}: {before:.2} dB before, {after:.2} dB after");
        after - before
    };
    let seen = gain("random", random);
    assert!(seen > 0.3, "{seen:.2} dB");
    let unseen: [(&str, Open); 3] = [("shifting", shifting), ("blocky", blocky), ("hadamard", hadamard)];
    for (name, open) in unseen {
        let gain = gain(name, open);
        assert!(gain > seen - 0.3, "{name}: {gain:.2} dB, {seen:.2} dB with random masks");
    }
}
