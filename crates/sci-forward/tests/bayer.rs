//! The demosaicers: golden outputs, flat images, exact linear ramps, the samples that must survive, and the mosaic operator.

use ndarray::{Array2, Array3, Array4, Axis, s};
use ndarray_npy::NpzReader;
use sci_forward::bayer::{
    Bilinear, CfaPattern, Demosaicer, Malvar, Menon, mosaic_adjoint_into, mosaic_into, sub_lattice,
};
use sci_forward::testing::{gaussian, uniform};

fn demosaicers() -> [(&'static str, Box<dyn Demosaicer>); 3] {
    [("bilinear", Box::new(Bilinear)), ("malvar2004", Box::new(Malvar)), ("menon2007", Box::new(Menon))]
}

fn demosaic(method: &mut dyn Demosaicer, cfa: CfaPattern, mosaic: &Array3<f32>) -> Array4<f32> {
    let (t, h, w) = mosaic.dim();
    let mut rgb = Array4::from_elem((t, 3, h, w), f32::NAN);
    method.demosaic(cfa, mosaic.view(), rgb.view_mut()).unwrap();
    rgb
}

#[test]
fn the_interior_matches_the_public_library() {
    let Some(path) = test_data::file("golden/demosaic_rggb.npz") else { return };
    let mut npz = NpzReader::new(std::fs::File::open(path).unwrap()).unwrap();
    let mosaic: Array2<f32> = npz.by_name("mosaic").unwrap();
    let (h, w) = mosaic.dim();
    for (name, mut method) in demosaicers() {
        // The library repeats the edge in the linear methods.
        let expected: Array3<f32> = npz.by_name(name).unwrap();
        let ours = demosaic(&mut *method, CfaPattern::Rggb, &mosaic.clone().insert_axis(Axis(0)));
        let border = 4;
        for r in border..h - border {
            for c in border..w - border {
                for k in 0..3 {
                    let (a, b) = (ours[[0, k, r, c]], expected[[r, c, k]]);
                    assert!((a - b).abs() < 1e-5, "{name} at {r}, {c}, channel {k}: {a} is not {b}");
                }
            }
        }
    }
}

#[test]
fn flat_images_stay_flat_and_samples_stay_what_they_were() {
    for (name, mut method) in demosaicers() {
        for cfa in CfaPattern::ALL {
            for (h, w) in [(2, 2), (2, 3), (3, 2), (5, 7), (33, 40), (40, 33)] {
                let flat = Array3::from_elem((2, h, w), 0.3f32);
                let rgb = demosaic(&mut *method, cfa, &flat);
                assert!(rgb.iter().all(|v| (v - 0.3).abs() < 1e-6), "{name} {cfa} {h}×{w}");

                let mosaic = uniform((2, h, w), 5);
                let rgb = demosaic(&mut *method, cfa, &mosaic);
                let mut again = Array3::from_elem(mosaic.dim(), f32::NAN);
                mosaic_into(cfa, rgb.view(), again.view_mut());
                assert!((&again - &mosaic).iter().all(|d| d.abs() < 1e-6), "{name} {cfa} {h}×{w}");
            }
        }
    }
}

/// Each channel a ramp of its own: every filter here takes what is linear as it is, away from the border.
#[test]
fn linear_ramps_are_exact() {
    let (height, width) = (34, 41);
    let ramps = Array4::from_shape_fn((1, 3, height, width), |(_, k, r, c)| {
        let [down, right] = [[0.004, 0.002], [-0.003, 0.005], [0.001, -0.006]][k];
        0.5 + down * r as f32 + right * c as f32
    });
    for (name, mut method) in demosaicers() {
        for cfa in CfaPattern::ALL {
            let mut mosaic = Array3::zeros((1, height, width));
            mosaic_into(cfa, ramps.view(), mosaic.view_mut());
            let rgb = demosaic(&mut *method, cfa, &mosaic);
            let border = if name == "menon2007" { 8 } else { 2 };
            let inner = s![.., .., border..height - border, border..width - border];
            let worst = (&rgb.slice(inner) - &ramps.slice(inner)).fold(0f32, |m, d| m.max(d.abs()));
            assert!(worst < 1e-6, "{name} {cfa}: {worst}");
        }
    }
}

/// More rows than one task takes, and more tasks than threads.
#[test]
fn the_thread_count_does_not_change_a_bit() {
    let mosaic = uniform((2, 150, 37), 4);
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| demosaicers().map(|(_, mut method)| demosaic(&mut *method, CfaPattern::Gbrg, &mosaic)))
    };
    assert_eq!(run(1), run(2));
    assert_eq!(run(1), run(3));
}

#[test]
fn views_that_are_not_contiguous_give_the_same_bits() {
    let wide = uniform((2, 80, 44), 3);
    let mosaic = wide.slice(s![.., ..;2, 1..;2]);
    for (name, mut method) in demosaicers() {
        let mut rgb = Array4::from_elem((2, 3, 80, 44), f32::NAN);
        method.demosaic(CfaPattern::Grbg, mosaic, rgb.slice_mut(s![.., .., 1..;2, ..;2])).unwrap();
        let packed = demosaic(&mut *method, CfaPattern::Grbg, &mosaic.to_owned());
        assert_eq!(rgb.slice(s![.., .., 1..;2, ..;2]), packed, "{name}");
    }
}

#[test]
fn a_demosaicer_has_a_name_and_can_go_to_another_thread() {
    let names = demosaicers().map(|(_, method)| std::thread::spawn(move || method.name().to_owned()).join().unwrap());
    assert_eq!(names, ["bilinear", "malvar", "menon"]);
}

/// Shifting the pattern by a row or a column is the same as shifting the image.
#[test]
fn the_four_patterns_are_one_pattern_shifted() {
    let wide = uniform((1, 43, 38), 11);
    for (name, mut method) in demosaicers() {
        let whole = demosaic(&mut *method, CfaPattern::Rggb, &wide);
        for (cfa, top, left) in [(CfaPattern::Grbg, 0, 1), (CfaPattern::Gbrg, 1, 0), (CfaPattern::Bggr, 1, 1)] {
            let part = demosaic(&mut *method, cfa, &wide.slice(s![.., top.., left..]).to_owned());
            // Menon looks far: its directions are decided from changes of interpolated differences.
            let inner = s![.., .., 14..26, 14..24];
            let expected = whole.slice(s![.., .., top.., left..]);
            let worst = (&part.slice(inner) - &expected.slice(inner)).fold(0f32, |m, d| m.max(d.abs()));
            assert!(worst < 1e-6, "{name} {cfa}: {worst}");
        }
    }
}

#[test]
fn a_mosaic_without_every_color_is_refused() {
    for (_, mut method) in demosaicers() {
        let mut rgb = Array4::zeros((1, 3, 1, 8));
        let error = method.demosaic(CfaPattern::Rggb, Array3::zeros((1, 1, 8)).view(), rgb.view_mut()).unwrap_err();
        assert!(error.to_string().contains("1×8"), "{error}");
    }
}

#[test]
fn the_mosaic_and_its_adjoint_belong_together() {
    for cfa in CfaPattern::ALL {
        let (rgb, m) = (uniform((2, 3, 7, 6), 1), uniform((2, 7, 6), 2));
        let (mut tx, mut tty) = (Array3::from_elem(m.dim(), f32::NAN), Array4::from_elem(rgb.dim(), f32::NAN));
        mosaic_into(cfa, rgb.view(), tx.view_mut());
        mosaic_adjoint_into(cfa, m.view(), tty.view_mut());
        let (left, right) = ((&tx * &m).sum(), (&rgb * &tty).sum());
        assert!((left - right).abs() < 1e-4 * left.abs(), "{left} {right}");
        // Both by their definition, also in arrays that are not contiguous.
        for ((t, r, c), &v) in tx.indexed_iter() {
            let seen = cfa.color_at(r, c) as usize;
            assert_eq!(v, rgb[[t, seen, r, c]]);
            assert!((0..3).all(|k| tty[[t, k, r, c]] == if k == seen { m[[t, r, c]] } else { 0.0 }));
        }
        let turned = rgb.view().permuted_axes([0, 1, 3, 2]).as_standard_layout().into_owned();
        let mut again = Array3::from_elem((2, 6, 7), f32::NAN);
        mosaic_into(cfa, turned.view().permuted_axes([0, 1, 3, 2]), again.view_mut().permuted_axes([0, 2, 1]));
        assert_eq!(again.permuted_axes([0, 2, 1]), tx);
        // A sub-lattice has one color.
        let red = cfa.red_site();
        let lattice = sub_lattice(tx.view(), red.0, red.1);
        assert_eq!(lattice, rgb.slice(s![.., 0, red.0..;2, red.1..;2]));
    }
}

/// `⟨M m, g⟩ = ⟨m, Mᵀ g⟩`, all patterns, odd sizes.
#[test]
fn malvar_has_its_adjoint() {
    for (k, cfa) in CfaPattern::ALL.into_iter().enumerate() {
        for (height, width) in [(2, 2), (3, 5), (8, 7)] {
            let m = gaussian((2, height, width), k as u64);
            let g = gaussian((6, height, width), 9).into_shape_with_order((2, 3, height, width)).unwrap();
            let mut rgb = Array4::from_elem(g.dim(), f32::NAN);
            Malvar.demosaic(cfa, m.view(), rgb.view_mut()).unwrap();
            let mut back = Array3::from_elem(m.dim(), f32::NAN);
            Malvar.adjoint(cfa, g.view(), back.view_mut()).unwrap();
            let dot = |pairs: &mut dyn Iterator<Item = (f32, f32)>| pairs.map(|(a, b)| f64::from(a * b)).sum::<f64>();
            let one = dot(&mut rgb.iter().copied().zip(g.iter().copied()));
            let other = dot(&mut m.iter().copied().zip(back.iter().copied()));
            assert!((one - other).abs() < 1e-5 * one.abs().max(1.0), "{cfa:?} {height}×{width}: {one} {other}");
        }
    }
}
