use std::sync::Arc;

use admm::sci_forward::{MaskOperator, MaskStack, Measurement, SensingOperator, VideoShape};
use admm::{Gap, Plan, Stage, Start, Tv, run};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let shape = VideoShape { frames: 8, height: 64, width: 64 };
    let video = ndarray::Array3::from_shape_fn(shape.dim(), |(t, i, j)| if i + j > 40 + t { 0.9 } else { 0.1 });
    let h = MaskOperator::new(MaskStack::random(shape, 0.5, 0)?);
    let y = h.forward(video.view()); // [T, H, W] to [H, W]
    let measurement = Measurement::new(Arc::new(h), y)?;
    let mut solver = Gap::accelerated(Tv::new(0.1)); // any admm::Prior; every admm::Denoiser is one
    let plan = Plan::new([Stage { sigma: None, iterations: 40 }]);
    let outcome = run(&mut solver, &measurement, Start::Mean, &plan, &mut ())?;
    println!("residual {:.1e} after {} iterations", outcome.relative_residual, outcome.iterations);
    Ok(())
}
