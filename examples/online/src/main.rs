use std::{path::Path, sync::Arc};

use online::nets::admm::sci_forward::{MaskOperator, MaskStack, Measurement, SensingOperator, VideoShape};
use online::nets::{Ffdnet, admm};
use online::{AdaptConfig, AdaptiveDenoiser};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let shape = VideoShape { frames: 8, height: 64, width: 64 };
    let video = ndarray::Array3::from_shape_fn(shape.dim(), |(t, i, j)| if i + j > 40 + t { 0.9 } else { 0.1 });
    let h = MaskOperator::new(MaskStack::random(shape, 0.5, 0)?);
    let y = h.forward(video.view()); // [T, H, W] to [H, W]
    let measurement = Measurement::new(Arc::new(h), y)?;
    let net = Ffdnet::load(Path::new("bundled:ffdnet_gray"))?;
    let mut denoiser = AdaptiveDenoiser::new(net, AdaptConfig::PAPER_FFDNET)?;
    denoiser.begin_measurement(&measurement)?; // from here on it learns from the measurement that the solver was given
    let plan = admm::Plan::new([admm::Stage { sigma: Some(25.0 / 255.0), iterations: 12 }]);
    let mut solver = admm::Gap::accelerated(&mut denoiser);
    admm::run(&mut solver, &measurement, admm::Start::Mean, &plan, &mut ())?;
    println!("updates {:?}", denoiser.counts());
    Ok(())
}
