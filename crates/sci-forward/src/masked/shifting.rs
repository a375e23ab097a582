//! One pattern that moves.

use super::MaskSource;
use crate::masks::{bernoulli, validated};
use crate::{MaskError, MaskStack, VideoShape};
use multiversion::multiversion;
use ndarray::{Array2, Axis};

/// One pattern `a` that moves from frame to frame, as a translating physical mask does; the masks are made on the fly.
///
/// ```text
/// C_t[i, j] = a(i + dy_t, j + dx_t)
/// ```
///
/// with offsets in pixels of the sensor, from the one that is least on. Between pixels `a` is interpolated bilinearly. The frames
/// are as large as the pattern allows for every offset.
///
/// ```
/// use ndarray::array;
/// use sci_forward::{MaskSource, ShiftingMasks};
///
/// // Half a pixel to the right a frame.
/// let masks = ShiftingMasks::new(array![[0.0, 1.0, 1.0, 0.0]], &[[0.0, 0.0], [0.0, 0.5], [0.0, 1.0]])?;
/// assert_eq!(masks.shape().dim(), (3, 1, 3));
/// let mut row = [f32::NAN; 3];
/// masks.fill(1, 0, 0, &mut row);
/// assert_eq!(row, [0.5, 1.0, 0.5]);
/// # Ok::<(), sci_forward::MaskError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct ShiftingMasks {
    shape: VideoShape,
    /// A stack of one.
    pattern: MaskStack,
    shifts: Vec<Shift>,
}

/// Where a frame lies on the pattern.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Shift {
    row: usize,
    column: usize,
    /// Of the way to the next row and column, in `[0, 1)`.
    fraction: [f32; 2],
}

impl ShiftingMasks {
    /// Takes a pattern and an offset `[dy, dx]` of any sign for each frame.
    ///
    /// # Errors
    /// [`MaskError`] if there is no frame, an offset is not finite, the pattern is too small for the offsets, a value of it is out
    /// of range, or nothing is open.
    pub fn new(pattern: Array2<f32>, offsets: &[[f64; 2]]) -> Result<Self, MaskError> {
        let (rows, columns) = pattern.dim();
        if let Some(&offset) = offsets.iter().find(|offset| !offset.iter().all(|v| v.is_finite())) {
            return Err(MaskError::Offset { rows, columns, offset });
        }
        let least = [0, 1].map(|axis| offsets.iter().map(|o| o[axis]).fold(f64::INFINITY, f64::min));
        let offsets: Vec<_> = offsets.iter().map(|o| [o[0] - least[0], o[1] - least[1]]).collect();
        let offset = [0, 1].map(|axis| offsets.iter().map(|o| o[axis]).fold(0.0, f64::max));
        // An `as` of what is larger than any pattern saturates.
        let size = |n: usize, most: f64| n.checked_sub(most.ceil() as usize).filter(|n| *n > 0);
        let (Some(height), Some(width)) = (size(rows, offset[0]), size(columns, offset[1])) else {
            return Err(MaskError::Offset { rows, columns, offset });
        };
        let shape = VideoShape { frames: offsets.len(), height, width };
        let shifts = offsets.into_iter().map(Shift::new).collect();
        // Between pixels a value out of range could pass for one in it.
        let pattern = MaskStack::new(pattern.insert_axis(Axis(0)))?;
        validated(Self { shape, pattern, shifts })
    }

    /// A random binary pattern, each pixel open with probability `density`, that moves by `step` `[dy, dx]` a frame.
    ///
    /// # Errors
    /// [`MaskError::Density`] outside `(0, 1]`; [`MaskError::Empty`], [`MaskError::Offset`], and, for tiny shapes and densities,
    /// [`MaskError::AllClosed`].
    ///
    /// ```
    /// use sci_forward::{MaskSource, ShiftingMasks, VideoShape};
    /// let shape = VideoShape { frames: 8, height: 32, width: 48 };
    /// assert_eq!(ShiftingMasks::random(shape, 0.5, 0, [-0.5, 1.25])?.shape(), shape);
    /// # Ok::<(), sci_forward::MaskError>(())
    /// ```
    pub fn random(shape: VideoShape, density: f64, seed: u64, step: [f64; 2]) -> Result<Self, MaskError> {
        let (frames, height, width) = shape.dim();
        if frames * height * width == 0 {
            return Err(MaskError::Empty { frames, height, width });
        }
        let offsets: Vec<_> = (0..frames).map(|t| step.map(|step| step * t as f64)).collect();
        let most = offsets[frames - 1].map(|v| v.abs().ceil());
        if !most.iter().all(|v| *v < MAX_TRAVEL) {
            return Err(MaskError::Offset { rows: height, columns: width, offset: offsets[frames - 1] });
        }
        let pattern = bernoulli((height + most[0] as usize, width + most[1] as usize), density, seed)?;
        Self::new(pattern, &offsets)
    }
}

/// The farthest that a random pattern moves, in pixels: it has to be stored.
const MAX_TRAVEL: f64 = 65_536.0;

impl Shift {
    fn new(offset: [f64; 2]) -> Self {
        Self { row: offset[0] as usize, column: offset[1] as usize, fraction: offset.map(|v| v.fract() as f32) }
    }
}

impl ShiftingMasks {
    /// The pattern from where a frame has `row`, `column` on, but for a fraction.
    fn piece(&self, frame: usize, row: usize, column: usize) -> &[f32] {
        let Shift { row: down, column: right, .. } = self.shifts[frame];
        let width = self.pattern.shape().width;
        let pattern = self.pattern.view().to_slice().expect("a stack is in row-major order");
        &pattern[(row + down) * width..][..width][column + right..]
    }
}

impl MaskSource for ShiftingMasks {
    fn shape(&self) -> VideoShape {
        self.shape
    }

    fn fill(&self, frame: usize, row: usize, start: usize, out: &mut [f32]) {
        let VideoShape { height, width, .. } = self.shape;
        assert!(row < height && start + out.len() <= width, "outside the masks of {}", self.shape);
        // At a whole offset the next row or column may not exist, and is not needed.
        let Shift { fraction, .. } = self.shifts[frame];
        let [below, beside] = fraction.map(|f| usize::from(f > 0.0));
        let at = |down, right| &self.piece(frame, row + down, start + right)[..out.len()];
        let [a, b, c, d] = [at(0, 0), at(0, beside), at(below, 0), at(below, beside)];
        match (below, beside) {
            (0, 0) => out.copy_from_slice(a),
            (0, _) => interpolate(out, [a, b], fraction[1]),
            (_, 0) => interpolate(out, [a, c], fraction[0]),
            _ => interpolate_both(out, [[a, b], [c, d]], fraction),
        }
    }

    fn stored(&self, frame: usize, row: usize) -> Option<&[f32]> {
        assert!(row < self.shape.height, "outside the masks of {}", self.shape);
        let whole = self.shifts[frame].fraction == [0.0; 2];
        whole.then(|| &self.piece(frame, row, 0)[..self.shape.width])
    }
}

/// `(1 − fraction) a + fraction b`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn interpolate(out: &mut [f32], [a, b]: [&[f32]; 2], fraction: f32) {
    for ((out, a), b) in out.iter_mut().zip(a).zip(b) {
        *out = (1.0 - fraction) * a + fraction * b;
    }
}

/// Along the rows first, then between them.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn interpolate_both(out: &mut [f32], [[a, b], [c, d]]: [[&[f32]; 2]; 2], [down, right]: [f32; 2]) {
    for ((((out, a), b), c), d) in out.iter_mut().zip(a).zip(b).zip(c).zip(d) {
        *out = (1.0 - down) * ((1.0 - right) * a + right * b) + down * ((1.0 - right) * c + right * d);
    }
}
