use ndarray::Array3;
use sci_forward::{MaskOperator, MaskStack, SensingOperator, VideoShape};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let shape = VideoShape { frames: 8, height: 64, width: 64 };
    let h = MaskOperator::new(MaskStack::random(shape, 0.5, 0)?);
    let video = Array3::from_shape_fn(shape.dim(), |(t, ..)| t as f32 / 8.0); // [T, H, W] in 0..=1
    let y = h.forward(video.view()); // [H, W]: what a camera with these masks measures
    println!("{shape} in one image, up to {:.2}", y.iter().copied().fold(0.0, f32::max));
    Ok(())
}
