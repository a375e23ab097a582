//! Behaviour of the networks that needs no published weights.

use admm::{Call, Denoiser};
use candle_core::{Device, Tensor};
use ndarray::{Array3, Array4, Axis, concatenate, s};
use nets::kernels::{Isa, Precision};
use nets::weights::{Storage, convert, write_safetensors};
use nets::{
    Architecture, Ddnet, DdnetSpec, Ends, Error, Fastdvdnet, FastdvdnetSpec, Ffdnet, FfdnetLayout, FfdnetSpec, Layers,
    MixedPrecision, Network, Shiftnet, WeightFile,
};
use sci_forward::bayer::{Malvar, mosaic_into};
use sci_forward::testing::gaussian;
use sci_forward::{CfaPattern, Demosaicer};
use std::path::{Path, PathBuf};

/// Both in one object.
trait NetworkDenoiser: Network + Denoiser {}
impl<N: Network + Denoiser> NetworkDenoiser for N {}

const SIGMA: f32 = 0.1;
const CALL: Call<'_> = Call::new(SIGMA);

fn pattern(dim: (usize, usize, usize, usize)) -> Array4<f32> {
    Array4::from_shape_fn(dim, |(t, c, y, x)| ((13 * t + 7 * c + 5 * y + 3 * x) % 23) as f32 / 23.0)
}

fn tiny_ffdnet(channels: usize) -> Ffdnet {
    Ffdnet::random(FfdnetSpec { channels, width: 6, depth: 3, layout: FfdnetLayout::Direct }, 1).unwrap()
}

fn tiny_fastdvdnet(channels: usize, ends: Ends) -> Fastdvdnet {
    Fastdvdnet::random(FastdvdnetSpec { channels, widths: [4, 5, 6], batch_norm: true }, ends, 2).unwrap()
}

fn tiny_ddnet() -> Ddnet {
    Ddnet::random(DdnetSpec { widths: [4, 5, 6] }, Ends::Circular, 3).unwrap()
}

fn denoise(net: &mut dyn Denoiser, video: &Array4<f32>) -> Array4<f32> {
    let mut out = Array4::from_elem(video.dim(), f32::NAN);
    net.denoise(&CALL, video.view(), out.view_mut()).unwrap();
    out
}

/// The differentiable pass, which works on whole tensors.
fn by_tensors(net: &dyn Network, video: &Array4<f32>) -> Array4<f32> {
    let x = Tensor::from_slice(video.as_slice().unwrap(), video.dim(), &Device::Cpu).unwrap();
    let y = net.forward(&x, &[SIGMA]).unwrap();
    Array4::from_shape_vec(video.dim(), y.flatten_all().unwrap().to_vec1().unwrap()).unwrap()
}

#[track_caller]
fn assert_close(a: &Array4<f32>, b: &Array4<f32>, tolerance: f32) {
    assert_eq!(a.dim(), b.dim());
    let worst = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(worst <= tolerance && a.iter().all(|v| v.is_finite()), "differ by {worst:e}");
}

/// Inference may use the matrix unit and the tensors do not: as far as golden outputs may be off.
const TOLERANCE: f32 = 1e-4;

const ODD_SIZES: [(usize, usize); 6] = [(1, 1), (1, 9), (9, 1), (3, 5), (2, 6), (33, 31)];

#[test]
fn multiply_adds_are_those_of_all_layers() {
    // Half the size: 5 → 64, 13 times 64 → 64, 64 → 4.
    let ffdnet = Ffdnet::random(FfdnetSpec::GRAY, 0).unwrap();
    assert_eq!(ffdnet.multiply_adds(), 9.0 * (5.0 * 64.0 + 13.0 * 64.0 * 64.0 + 64.0 * 4.0) / 4.0);
    // For each pixel at full, half and quarter size; both stages.
    let full = 9.0 * (2.0 * 90.0 + 90.0 * 32.0 + 32.0 * 32.0 + 32.0);
    let half = 9.0 * (32.0 * 64.0 + 2.0 * 64.0 * 64.0 + 2.0 * 64.0 * 64.0 + 64.0 * 128.0);
    let quarter = 9.0 * (64.0 * 128.0 + 4.0 * 128.0 * 128.0 + 128.0 * 256.0);
    let fastdvdnet = Fastdvdnet::random(FastdvdnetSpec::GRAY, Ends::Circular, 0).unwrap();
    assert_eq!(fastdvdnet.multiply_adds(), 2.0 * (full + half / 4.0 + quarter / 16.0));
    // Three colors in and out and no noise map.
    let ddnet = Ddnet::random(DdnetSpec::PAPER, Ends::Circular, 0).unwrap();
    assert_eq!(ddnet.multiply_adds(), fastdvdnet.multiply_adds() + 2.0 * 9.0 * (90.0 + 2.0 * 32.0));
}

#[test]
fn frames_of_any_size_pass_and_both_paths_agree() {
    for (h, w) in ODD_SIZES {
        for frames in [1, 2, 3, 5] {
            let (gray, rgb) = (pattern((frames, 1, h, w)), pattern((frames, 3, h, w)));
            let mut ffdnet = tiny_ffdnet(1);
            assert_close(&denoise(&mut ffdnet, &gray), &by_tensors(&ffdnet, &gray), TOLERANCE);
            for ends in [Ends::Circular, Ends::Mirrored] {
                let mut net = tiny_fastdvdnet(3, ends);
                assert_close(&denoise(&mut net, &rgb), &by_tensors(&net, &rgb), TOLERANCE);
            }
            let mosaic = rgb.index_axis(Axis(1), 0);
            for cfa in [CfaPattern::Rggb, CfaPattern::Bggr, CfaPattern::Grbg, CfaPattern::Gbrg] {
                let mut out = Array4::from_elem(rgb.dim(), f32::NAN);
                tiny_ddnet().demosaic(cfa, mosaic, out.view_mut()).unwrap();
                assert!(out.iter().all(|v| v.is_finite()));
            }
        }
    }
}

/// Widths whose images the matrix unit takes, in whole and in partial blocks, and those that it does not.
#[test]
fn wide_networks_of_any_size_pass_and_both_paths_agree() {
    for (h, w) in [(1, 1), (3, 70), (37, 66)] {
        let video = pattern((3, 1, h, w));
        let spec = FfdnetSpec { channels: 1, width: 41, depth: 4, layout: FfdnetLayout::Direct };
        let mut ffdnet = Ffdnet::random(spec, 1).unwrap();
        assert_close(&denoise(&mut ffdnet, &video), &by_tensors(&ffdnet, &video), TOLERANCE);
        for widths in [[32, 64, 128], [20, 36, 70], [16, 32, 64]] {
            let spec = FastdvdnetSpec { channels: 1, widths, batch_norm: true };
            let mut net = Fastdvdnet::random(spec, Ends::Circular, 2).unwrap();
            assert_close(&denoise(&mut net, &video), &by_tensors(&net, &video), TOLERANCE);
        }
    }
}

/// The choice is read once per process, so this runs that test in processes of its own.
#[test]
fn wide_networks_pass_on_every_instruction_set() {
    for isa in Isa::ALL.into_iter().filter(|isa| isa.available()) {
        let run = std::process::Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "wide_networks_of_any_size_pass_and_both_paths_agree"])
            .env("SCI_KERNEL", isa.name())
            .output()
            .unwrap();
        assert!(run.status.success(), "{isa:?}: {}", String::from_utf8_lossy(&run.stdout));
    }
}

/// Whether 16-bit numbers are others than f32 here.
fn has_half_precision() -> bool {
    Isa::detect().unwrap().half_precision() != "f32"
}

/// Strides, groups, shuffles and skips of wide networks.
#[test]
fn inference_in_half_precision_is_near_that_in_f32() {
    let ffdnet = FfdnetSpec { channels: 1, width: 48, depth: 5, layout: FfdnetLayout::Residual { batch_norm: false } };
    let fastdvdnet = FastdvdnetSpec { channels: 3, widths: [20, 33, 64], batch_norm: true };
    let nets: [(Box<dyn NetworkDenoiser>, usize); 2] = [
        (Box::new(Ffdnet::random(ffdnet, 4).unwrap()), 1),
        (Box::new(Fastdvdnet::random(fastdvdnet, Ends::Circular, 4).unwrap()), 3),
    ];
    for (mut net, channels) in nets {
        let video = pattern((3, channels, 45, 70));
        let exact = denoise(net.as_mut(), &video);
        net.set_inference_precision(Precision::Bf16);
        let found = denoise(net.as_mut(), &video);
        let norm = |v: &Array4<f32>| v.mapv(|v| v * v).sum().sqrt();
        let (error, by_network) = (norm(&(&found - &exact)), norm(&(&exact - &video)));
        println!("{}: relative error {:e}", net.describe(), error / by_network);
        assert!(error < 2e-2 * by_network, "{}: {error:e} of {by_network:e}", net.describe());
        assert_eq!(error > 0.0, has_half_precision(), "{}", net.describe());
        let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert!(one.install(|| denoise(net.as_mut(), &video)) == found);
        net.set_inference_precision(Precision::F32);
        assert!(denoise(net.as_mut(), &video) == exact);
    }
}

/// What is not noticed is done in half precision, what is tolerated by none in f32, and the choice is that of the error itself.
#[test]
fn half_precision_is_for_calls_that_tolerate_its_error() {
    let spec = FfdnetSpec { channels: 1, width: 48, depth: 5, layout: FfdnetLayout::Residual { batch_norm: false } };
    let mut net = Ffdnet::random(spec, 4).unwrap();
    let video = pattern((3, 1, 45, 70));
    let exact = denoise(&mut net, &video);
    net.set_inference_precision(Precision::Bf16);
    let rounded = denoise(&mut net, &video);
    let frame = |v: &Array4<f32>| v.slice(ndarray::s![..1, .., .., ..]).to_owned();
    let difference = (frame(&rounded) - frame(&exact)).mapv(|d| f64::from(d).powi(2));
    let error = (difference.sum() / difference.len() as f64).sqrt() as f32;
    for (tolerance, halved) in [(0.0, false), (0.9 * error, false), (1.1 * error, true)] {
        let mut mixed = MixedPrecision::new(&mut net);
        let counter = mixed.counter();
        for _ in 0..2 {
            let mut out = Array4::zeros(video.dim());
            mixed.denoise(&Call { tolerance, ..CALL }, video.view(), out.view_mut()).unwrap();
            assert!(out == if halved { &rounded } else { &exact }, "tolerance {tolerance}, error {error}");
        }
        assert_eq!(counter.counts().share(), f64::from(u8::from(halved && has_half_precision())));
    }
}

#[test]
fn a_large_odd_frame_passes() {
    let video = pattern((1, 1, 255, 257));
    let mut ffdnet = tiny_ffdnet(1);
    assert_close(&denoise(&mut ffdnet, &video), &by_tensors(&ffdnet, &video), TOLERANCE);
    let mut fastdvdnet = tiny_fastdvdnet(1, Ends::Circular);
    assert_close(&denoise(&mut fastdvdnet, &video), &by_tensors(&fastdvdnet, &video), TOLERANCE);
    let mut rgb = Array4::from_elem((1, 3, 255, 257), f32::NAN);
    tiny_ddnet().demosaic(CfaPattern::Grbg, video.index_axis(Axis(1), 0), rgb.view_mut()).unwrap();
    assert!(rgb.iter().all(|v| v.is_finite()));
}

#[test]
fn sharing_the_first_stage_changes_no_bit() {
    // A window of its own for every frame: four blocks a frame, of which the middle result is kept.
    for ends in [Ends::Circular, Ends::Mirrored] {
        let mut net = tiny_fastdvdnet(1, ends);
        let video = pattern((6, 1, 8, 12));
        let shared = denoise(&mut net, &video);
        for t in 0..6isize {
            let window: Vec<_> = (t - 2..=t + 2)
                .map(|i| match ends {
                    Ends::Circular => i.rem_euclid(6) as usize,
                    Ends::Mirrored => {
                        if i < 0 {
                            -i as usize
                        } else {
                            i.min(10 - i) as usize
                        }
                    }
                })
                .map(|i| video.slice(s![i..=i, .., .., ..]))
                .collect();
            let window = concatenate(Axis(0), &window).unwrap();
            // The middle of five frames does not see their ends.
            let alone = denoise(&mut net, &window);
            assert_eq!(alone.index_axis(Axis(0), 2), shared.index_axis(Axis(0), t as usize), "frame {t}, {ends:?}");
        }
    }
}

#[test]
fn nan_and_infinity_pass_through_without_a_crash() {
    for poison in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut gray = pattern((3, 1, 9, 9));
        gray[[1, 0, 4, 4]] = poison;
        for net in [&mut tiny_ffdnet(1) as &mut dyn Denoiser, &mut tiny_fastdvdnet(1, Ends::Circular)] {
            let out = denoise(net, &gray);
            assert!(out.iter().any(|v| !v.is_finite()), "the poison is not hidden");
        }
        let mut rgb = Array4::zeros((3, 3, 9, 9));
        tiny_ddnet().demosaic(CfaPattern::Rggb, gray.index_axis(Axis(1), 0), rgb.view_mut()).unwrap();
    }
}

#[test]
fn wrong_channels_shapes_and_noise_levels_are_refused_by_name() {
    let rgb = pattern((2, 3, 4, 4));
    let mut out = Array4::zeros(rgb.dim());
    let error = tiny_ffdnet(1).denoise(&CALL, rgb.view(), out.view_mut()).unwrap_err().to_string();
    assert_eq!(error, "FFDNet (gray, 6 channels, 3 layers) takes videos of 1 channel(s), this one has 3");
    let mut small = Array4::zeros((2, 3, 4, 3));
    let error =
        tiny_fastdvdnet(3, Ends::Circular).denoise(&CALL, rgb.view(), small.view_mut()).unwrap_err().to_string();
    assert!(error.contains("[2, 3, 4, 4]") && error.contains("[2, 3, 4, 3]"), "{error}");
    for sigma in [-1.0, f32::NAN] {
        let call = Call { sigma: Some(sigma), ..CALL };
        let error = tiny_ffdnet(3).denoise(&call, rgb.view(), out.view_mut()).unwrap_err().to_string();
        assert!(error.contains("noise level"), "{error}");
    }
    let mosaic = Array3::zeros((2, 4, 5));
    let error = tiny_ddnet().demosaic(CfaPattern::Rggb, mosaic.view(), out.view_mut()).unwrap_err().to_string();
    assert!(error.contains("[2, 3, 4, 5]"), "{error}");
    for spec in [FfdnetSpec { channels: 2, ..FfdnetSpec::GRAY }, FfdnetSpec { width: 0, ..FfdnetSpec::GRAY }] {
        assert!(matches!(Ffdnet::random(spec, 0), Err(Error::Setting { .. })));
    }
}

#[test]
fn an_empty_video_is_no_work() {
    let empty = Array4::<f32>::zeros((0, 1, 4, 4));
    assert_eq!(denoise(&mut tiny_ffdnet(1), &empty).len(), 0);
    assert_eq!(denoise(&mut tiny_fastdvdnet(1, Ends::Mirrored), &empty).len(), 0);
}

#[test]
fn changing_a_variable_changes_what_the_denoiser_does() {
    let video = pattern((2, 1, 8, 8));
    for mut net in [Box::new(tiny_ffdnet(1)) as Box<dyn Both>, Box::new(tiny_fastdvdnet(1, Ends::Circular))] {
        let before = denoise(net.denoiser(), &video);
        let vars = net.network().make_trainable().unwrap();
        assert_eq!(denoise(net.denoiser(), &video), before);
        let (_, last) = vars.last().unwrap();
        last.set(&(last.as_tensor() + 0.5).unwrap()).unwrap();
        assert_ne!(denoise(net.denoiser(), &video), before);
    }
}

trait Both {
    fn denoiser(&mut self) -> &mut dyn Denoiser;
    fn network(&mut self) -> &mut dyn Network;
}
impl<N: Denoiser + Network> Both for N {
    fn denoiser(&mut self) -> &mut dyn Denoiser {
        self
    }
    fn network(&mut self) -> &mut dyn Network {
        self
    }
}

#[test]
fn weights_survive_a_file_and_are_recognised() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("net.safetensors");
    let nets: [(Box<dyn Network>, Architecture); 4] = [
        (Box::new(tiny_ffdnet(3)), Architecture::Ffdnet(tiny_ffdnet(3).spec())),
        (
            Box::new(tiny_fastdvdnet(1, Ends::Circular)),
            Architecture::Fastdvdnet(tiny_fastdvdnet(1, Ends::Circular).spec()),
        ),
        (
            Box::new(tiny_fastdvdnet(3, Ends::Circular)),
            Architecture::Fastdvdnet(tiny_fastdvdnet(3, Ends::Circular).spec()),
        ),
        (Box::new(tiny_ddnet()), Architecture::Ddnet(tiny_ddnet().spec())),
    ];
    for (net, architecture) in nets {
        write_safetensors(&path, &net.state(), Storage::F32).unwrap();
        let file = WeightFile::read(&path).unwrap();
        assert_eq!(file.architecture().unwrap(), architecture);
        let read = Architecture::load(file, Ends::Circular).unwrap();
        let values = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for ((name, a), (other, b)) in net.state().iter().zip(&read.state()) {
            assert_eq!((name, values(a)), (other, values(b)));
        }
    }
}

#[test]
fn half_precision_storage_is_read_and_close() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("half.safetensors");
    let mut net = tiny_ffdnet(1);
    write_safetensors(&path, &net.state(), Storage::F16).unwrap();
    assert!(WeightFile::read(&path).unwrap().summary().iter().all(|t| t.dtype == "F16"));
    let video = pattern((1, 1, 8, 8));
    assert_close(&denoise(&mut Ffdnet::load(&path).unwrap(), &video), &denoise(&mut net, &video), 5e-3);
}

#[test]
fn folding_on_conversion_keeps_the_function() {
    let folder = tempfile::tempdir().unwrap();
    let (plain, folded) = (folder.path().join("a.safetensors"), folder.path().join("b.safetensors"));
    let mut net = tiny_fastdvdnet(1, Ends::Circular);
    write_safetensors(&plain, &net.state(), Storage::F32).unwrap();
    convert(&plain, &folded, true, Storage::F32).unwrap();
    let mut read = Fastdvdnet::load(&folded, Ends::Circular).unwrap();
    assert!(!read.spec().batch_norm);
    let video = pattern((3, 1, 8, 8));
    assert_close(&denoise(&mut read, &video), &denoise(&mut net, &video), 1e-6);
    let error = convert(&plain, &folder.path().join("c.pth"), false, Storage::F32).unwrap_err().to_string();
    assert!(error.contains("safetensors"), "{error}");
}

#[test]
fn wrong_weights_are_refused_with_file_and_keys_in_one_error() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bad.safetensors");
    let write = |tensors| write_safetensors(&path, &tensors, Storage::F32).unwrap();
    let refused = || Ffdnet::load(&path).unwrap_err().to_string();

    let mut state = tiny_ffdnet(1).state();
    let bias = state.remove("model.2.bias").unwrap();
    state.insert("model.2.scale".into(), bias.clone());
    state.insert("model.0.bias".into(), Tensor::zeros(7, candle_core::DType::F32, &Device::Cpu).unwrap());
    write(state);
    let error = refused();
    for part in [
        "bad.safetensors",
        "missing model.2.bias",
        "unexpected model.2.scale",
        "model.0.bias (expected [6], found [7])",
    ] {
        assert!(error.contains(part), "{part} is not in: {error}");
    }

    let mut state = tiny_ffdnet(1).state();
    state.insert("model.0.bias".into(), Tensor::new(&[0f32, 1.0, f32::NAN, 0.0, 0.0, 0.0], &Device::Cpu).unwrap());
    write(state);
    assert!(refused().contains("model.0.bias holds NaN"), "{}", refused());

    write(tiny_ddnet().state());
    assert!(refused().contains("DDNet (4/5/6 channels), not of FFDNet"), "{}", refused());
    write([("x".to_owned(), bias)].into());
    assert!(refused().contains("no known network"), "{}", refused());
    let error = Ffdnet::load(Path::new("bundled:nothing")).unwrap_err().to_string();
    assert!(error.contains("no bundled weights \"nothing\""), "{error}");
    assert!(matches!(Ffdnet::load(&folder.path().join("absent.pth")), Err(Error::Read { .. })));
}

/// A file must be read whole, and cut at any sixteenth be refused.
#[track_caller]
fn refused_if_cut(path: &Path) {
    let bytes = std::fs::read(path).unwrap();
    assert!(WeightFile::parse(path, &bytes).is_ok());
    for part in 0..16 {
        let cut = &bytes[..bytes.len() * part / 16];
        assert!(WeightFile::parse(path, cut).is_err(), "{} of {} bytes", cut.len(), bytes.len());
    }
}

#[test]
fn a_weight_file_cut_anywhere_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("net.safetensors");
    write_safetensors(&path, &tiny_ffdnet(1).state(), Storage::F32).unwrap();
    refused_if_cut(&path);
}

#[test]
fn a_published_weight_file_cut_anywhere_is_an_error() {
    let files = test_data::files(["weights/ffdnet_gray.pth", "weights/fastdvdnet_half_color.pth"]);
    let Some(files) = files else { return };
    files.iter().for_each(|path| refused_if_cut(path));
}

/// What ships must load, and denoise: a ramp with seeded noise comes out much closer to the ramp.
#[test]
fn bundled_weights_denoise() {
    for name in nets::weights::bundled_names() {
        let path = PathBuf::from(format!("bundled:{name}"));
        let file = WeightFile::read(&path).unwrap();
        match file.architecture().unwrap() {
            Architecture::Ffdnet(_) => lowers_the_noise(name, &mut Ffdnet::load(&path).unwrap()),
            Architecture::Fastdvdnet(_) => {
                lowers_the_noise(name, &mut Fastdvdnet::load(&path, Ends::Circular).unwrap())
            }
            Architecture::Ddnet(_) => fills_in_the_colors(name, &mut Ddnet::load(&path, Ends::Circular).unwrap()),
            Architecture::Shiftnet(_) => lowers_the_noise(name, &mut Shiftnet::load(&path).unwrap()),
            other => unreachable!("{name}: no test looks at a bundled {other}"),
        }
    }
}

/// Stripes of two colors, too fine for a mosaic's neighbours to be averaged.
fn fills_in_the_colors(name: &str, net: &mut Ddnet) {
    let stripes = |(t, c, y, x): (usize, usize, usize, usize)| {
        if (y / 3 + x + t) % 7 < 3 { 0.7 - 0.2 * c as f32 } else { 0.1 * (c + 1) as f32 }
    };
    let clean = Array4::from_shape_fn((3, 3, 48, 48), stripes);
    let mut mosaic = Array3::zeros((3, 48, 48));
    mosaic_into(CfaPattern::Rggb, clean.view(), mosaic.view_mut());
    let rgb = |demosaicer: &mut dyn Demosaicer| {
        let mut rgb = Array4::zeros(clean.dim());
        demosaicer.demosaic(CfaPattern::Rggb, mosaic.view(), rgb.view_mut()).unwrap();
        (&rgb - &clean).mapv(|v| v * v).mean().unwrap()
    };
    let (ours, malvar) = (rgb(net), rgb(&mut Malvar));
    assert!(ours < 0.7 * malvar, "{name}: {ours:e}, Malvar {malvar:e}");
}

fn lowers_the_noise<N: Network + Denoiser>(name: &str, net: &mut N) {
    let channels = net.channels();
    let ramp = |(t, c, y, x): (usize, usize, usize, usize)| 0.2 + 0.01 * (y + t) as f32 + 0.005 * (x + c) as f32;
    let clean = Array4::from_shape_fn((6, channels, 48, 48), ramp);
    // A net for iterates knows the σ of its schedule alone.
    let sigma = if name.ends_with("_sci") { 0.04 } else { SIGMA };
    let noisy = &clean + &(&gaussian(clean.dim(), 7) * sigma);
    let mut denoised = Array4::zeros(noisy.dim());
    net.denoise(&Call::new(sigma), noisy.view(), denoised.view_mut()).unwrap();
    let error = |video: &Array4<f32>| (video - &clean).mapv(|v| v * v).mean().unwrap();
    let (before, after) = (error(&noisy), error(&denoised));
    assert!(after < 0.1 * before, "{name}: {before:e} {after:e}");
}

#[test]
fn a_blend_is_a_share_of_the_way() {
    let folder = tempfile::tempdir().unwrap();
    let [from, to, out] = ["from", "to", "out"].map(|name| folder.path().join(format!("{name}.safetensors")));
    let spec = FfdnetSpec { width: 4, depth: 3, ..FfdnetSpec::GRAY };
    let nets = [1, 2].map(|seed| Ffdnet::random(spec, seed).unwrap());
    write_safetensors(&from, &nets[0].state(), Storage::F32).unwrap();
    write_safetensors(&to, &nets[1].state(), Storage::F32).unwrap();
    nets::weights::blend(&from, &to, 0.25, &out, Storage::F32).unwrap();
    let values = |state: std::collections::BTreeMap<String, Tensor>| -> Vec<f32> {
        state.into_values().flat_map(|t| t.flatten_all().unwrap().to_vec1::<f32>().unwrap()).collect()
    };
    let [a, b] = nets.each_ref().map(|net| values(net.state()));
    let found = values(nets::WeightFile::read(&out).unwrap().into_tensors());
    assert!(
        !found.is_empty()
            && found.iter().zip(a.iter().zip(&b)).all(|(c, (a, b))| (0.75 * a + 0.25 * b - c).abs() < 1e-6)
    );
    assert!(nets::weights::blend(&from, &to, 1.5, &out, Storage::F32).is_err());
}
