//! 3×3 convolutions with zero padding 1: the part of the program where nearly all CPU time goes.

use candle_core::{Result, Tensor};

/// How a 3×3 convolution is done; the padding is always one zero on each side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Conv3x3 {
    /// Step between output pixels: 1 or 2.
    pub stride: usize,
    /// Number of channel groups; it divides both channel counts.
    pub groups: usize,
    /// Apply `max(·, 0)` to the result.
    pub relu: bool,
}

impl Default for Conv3x3 {
    /// Stride 1, one group, no ReLU.
    fn default() -> Self {
        Self {
            stride: 1,
            groups: 1,
            relu: false,
        }
    }
}

/// `y[n,o] = b[o] + Σ_i w[o,i] ⋆ x[n,i]`, differentiable in all three arguments.
///
/// Shapes: `x [N,Cin,H,W]`, `w [Cout,Cin/groups,3,3]`, `bias [Cout]`, result `[N,Cout,⌈H/stride⌉,⌈W/stride⌉]`.
///
/// # Errors
/// When the shapes do not fit together.
pub fn conv3x3(x: &Tensor, w: &Tensor, bias: Option<&Tensor>, opts: Conv3x3) -> Result<Tensor> {
    let y = x.conv2d(w, 1, opts.stride, 1, opts.groups)?;
    let y = match bias {
        Some(b) => y.broadcast_add(&b.reshape((1, (), 1, 1))?)?,
        None => y,
    };
    if opts.relu { y.relu() } else { Ok(y) }
}
