use std::path::Path;

use nets::admm::{Call, Denoiser};
use nets::{Ffdnet, Layers};

fn main() -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
    let mut net = Ffdnet::load(Path::new("bundled:ffdnet_gray"))?; // or a .pth or .safetensors file
    let noisy = ndarray::Array4::from_shape_fn((4, 1, 64, 64), |(t, _, i, j)| ((t + i + j) % 7) as f32 / 7.0);
    let mut clean = noisy.clone(); // [T, C, H, W]
    net.denoise(&Call::new(25.0 / 255.0), noisy.view(), clean.view_mut())?;
    println!("{} took {:.3} away", net.describe(), (clean - noisy).mapv(f32::abs).mean().unwrap_or(0.0));
    Ok(())
}
