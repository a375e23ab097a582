//! The metrics against scikit-image's outputs (`golden/metrics.npz`).

use ndarray::{Array1, Array3, ArrayView2};
use ndarray_npy::NpzReader;
use sci_forward::metrics;

#[test]
fn metrics_match_scikit_image() {
    let Some(path) = test_data::file("golden/metrics.npz") else { return };
    let mut npz = NpzReader::new(std::fs::File::open(path).unwrap()).unwrap();
    let reference: Array3<f32> = npz.by_name("reference").unwrap();
    let image: Array3<f32> = npz.by_name("image").unwrap();
    type Metric = fn(ArrayView2<'_, f32>, ArrayView2<'_, f32>) -> f64;
    let cases: [(&str, Metric); 3] =
        [("psnr", metrics::psnr), ("ssim_uniform7", metrics::ssim), ("ssim_gaussian11", metrics::ssim_gaussian)];
    for (name, metric) in cases {
        let expected: Array1<f64> = npz.by_name(name).unwrap();
        for ((a, b), expected) in reference.outer_iter().zip(image.outer_iter()).zip(expected) {
            let ours = metric(a, b);
            assert!((ours - expected).abs() < 1e-4, "{name}: {ours} is not {expected}");
        }
    }
}
