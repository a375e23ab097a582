//! Training clips: crops of videos, and photographs that a synthetic camera moves, with flips, rotations and reversal.

use crate::network::reflect;
use crate::{Error, Result};
use ndarray::{Array3, Array4, ArrayView3, ArrayView4, Axis};
use rand::{Rng, RngExt};

/// A decoded frame `[C, H, W]`, u8: 8 bits are what the files have, and a quarter of the memory of f32.
pub type Frame = Array3<u8>;

/// Decoded frames to train on and to validate with. Decoding is the caller's, so that no image format is known here.
#[derive(Debug, Clone, Default)]
pub struct TrainData {
    /// Clips of consecutive frames, each of one size.
    pub videos: Vec<Vec<Frame>>,
    /// Single photographs.
    pub photos: Vec<Frame>,
    /// Held-out clips.
    pub validation: Vec<Vec<Frame>>,
}

/// An RGB image, interleaved `[H, W, 3]`, as a [`Frame`] of 1 channel (luma, ITU-R BT.601) or 3.
///
/// # Errors
/// [`Error::Data`] when `rgb` is not `3·H·W` long or has no pixels.
pub fn frame_from_rgb(rgb: &[u8], height: usize, width: usize, channels: usize) -> Result<Frame> {
    if rgb.is_empty() || rgb.len() != 3 * height * width {
        return Err(Error::Data(format!("an image of {height}×{width} pixels has {} values", rgb.len())));
    }
    let pixel = |y: usize, x: usize| &rgb[3 * (y * width + x)..][..3];
    Ok(Array3::from_shape_fn((channels, height, width), |(c, y, x)| match (channels, pixel(y, x)) {
        (1, p) => (0.299 * f32::from(p[0]) + 0.587 * f32::from(p[1]) + 0.114 * f32::from(p[2])).round() as u8,
        (_, p) => p[c],
    }))
}

impl TrainData {
    pub(super) fn check(&self, channels: usize, photo_share: f64) -> Result<()> {
        let bad = |what: &str| Err(Error::Data(what.to_owned()));
        for clip in self.videos.iter().chain(&self.validation) {
            match clip.first() {
                None => return bad("a clip has no frames"),
                Some(first) if clip.iter().any(|f| f.dim() != first.dim()) => {
                    return bad("the frames of a clip differ in size");
                }
                Some(_) => {}
            }
        }
        let frames = self.videos.iter().chain(&self.validation).flatten().chain(&self.photos);
        for frame in frames {
            if frame.is_empty() || frame.len_of(Axis(0)) != channels {
                let shape = frame.shape();
                return Err(Error::Data(format!(
                    "a frame has shape {shape:?}, the network takes {channels} channel(s)"
                )));
            }
        }
        match () {
            () if self.videos.is_empty() && photo_share < 1.0 => bad("no videos, but photo_share is below 1"),
            () if self.photos.is_empty() && photo_share > 0.0 => bad("no photos, but photo_share is above 0"),
            () if self.validation.is_empty() => bad("no validation clips"),
            () => Ok(()),
        }
    }

    /// A random training clip `[T, C, P, P]` in `[0, 1]`.
    pub(super) fn clip(&self, rng: &mut impl Rng, frames: usize, patch: usize, photo_share: f64) -> Array4<f32> {
        let clip = if rng.random::<f64>() < photo_share {
            let photo = pick(&self.photos, rng);
            if frames == 1 {
                crop(std::slice::from_ref(photo), rng, 1, patch)
            } else {
                self.moving(photo, rng, frames, patch)
            }
        } else {
            crop(pick::<Vec<Frame>>(&self.videos, rng), rng, frames, patch)
        };
        augment(clip.view(), rng)
    }

    /// A photograph seen by a moving camera, with part of another one moving in front of it.
    fn moving(&self, photo: &Frame, rng: &mut impl Rng, frames: usize, patch: usize) -> Array4<f32> {
        let camera = Motion::random(rng, photo.dim(), patch, 3.0);
        let front = pick(&self.photos, rng);
        let object = (rng.random::<f32>() < 0.5)
            .then(|| (Motion::random(rng, front.dim(), patch, 6.0), Ellipse::random(rng, patch)));
        let mut clip = Array4::zeros((frames, photo.len_of(Axis(0)), patch, patch));
        for (t, mut image) in clip.outer_iter_mut().enumerate() {
            let time = t as f32 - 0.5 * (frames - 1) as f32;
            for y in 0..patch {
                for x in 0..patch {
                    let centred = [y as f32 - 0.5 * patch as f32, x as f32 - 0.5 * patch as f32];
                    let behind = camera.at(time, centred);
                    let cover = object.as_ref().map_or(0.0, |(motion, shape)| shape.cover(centred, motion.shift(time)));
                    for c in 0..image.len_of(Axis(0)) {
                        let mut value = 0.0;
                        if cover < 1.0 {
                            value += (1.0 - cover) * bicubic(photo.index_axis(Axis(0), c), behind);
                        }
                        if let (true, Some((motion, _))) = (cover > 0.0, &object) {
                            value += cover * bicubic(front.index_axis(Axis(0), c), motion.at(time, centred));
                        }
                        image[[c, y, x]] = value.clamp(0.0, 1.0);
                    }
                }
            }
        }
        clip
    }
}

fn pick<'a, T>(items: &'a [T], rng: &mut impl Rng) -> &'a T {
    &items[rng.random_range(0..items.len())]
}

/// A crop of consecutive frames; frames (and pixels) that a small video lacks are mirrored.
fn crop(video: &[Frame], rng: &mut impl Rng, frames: usize, patch: usize) -> Array4<f32> {
    let (channels, height, width) = video[0].dim();
    let mut start = |have: usize, want: usize| rng.random_range(0..=have.saturating_sub(want));
    let (t0, y0, x0) = (start(video.len(), frames), start(height, patch), start(width, patch));
    Array4::from_shape_fn((frames, channels, patch, patch), |(t, c, y, x)| {
        let at = |i: usize, n: usize| reflect(i as isize, n);
        f32::from(video[at(t0 + t, video.len())][[c, at(y0 + y, height), at(x0 + x, width)]]) / 255.0
    })
}

/// One of the 8 symmetries of the square, and half the time the clip backwards.
fn augment(clip: ArrayView4<'_, f32>, rng: &mut impl Rng) -> Array4<f32> {
    let [time, rows, columns, transpose] = std::array::from_fn(|_| rng.random::<bool>());
    let mut view = clip;
    for (axis, flip) in [(0, time), (2, rows), (3, columns)] {
        if flip {
            view.invert_axis(Axis(axis));
        }
    }
    if transpose {
        view.swap_axes(2, 3);
    }
    view.as_standard_layout().into_owned()
}

/// A smooth path of the camera: position, rotation and zoom are quadratic in time.
struct Motion {
    centre: [f32; 2],
    velocity: [f32; 2],
    acceleration: [f32; 2],
    rotation: f32,
    zoom: f32,
}

impl Motion {
    /// Speed up to `fastest` pixels a frame, mostly slower; the view starts anywhere in the photograph.
    fn random(rng: &mut impl Rng, (_, height, width): (usize, usize, usize), patch: usize, fastest: f32) -> Self {
        let mut symmetric = |limit: f32| limit * (2.0 * rng.random::<f32>() - 1.0);
        let around = |n: usize, r: f32| 0.5 * n as f32 + r * 0.5 * n.saturating_sub(patch) as f32;
        let centre = [around(height, symmetric(1.0)), around(width, symmetric(1.0))];
        // A product of two: slow motion is common.
        let speed = fastest * symmetric(1.0).abs();
        Self {
            centre,
            velocity: [symmetric(speed), symmetric(speed)],
            acceleration: [symmetric(0.15), symmetric(0.15)],
            rotation: symmetric(0.01),
            zoom: symmetric(0.01),
        }
    }

    fn shift(&self, time: f32) -> [f32; 2] {
        std::array::from_fn(|i| self.velocity[i] * time + 0.5 * self.acceleration[i] * time * time)
    }

    /// Where in the photograph the point `[y, x]` of the patch, counted from its centre, is seen.
    fn at(&self, time: f32, [y, x]: [f32; 2]) -> [f32; 2] {
        let (sin, cos) = (self.rotation * time).sin_cos();
        let scale = 1.0 + self.zoom * time;
        let shift = self.shift(time);
        [
            self.centre[0] - shift[0] + scale * (cos * y - sin * x),
            self.centre[1] - shift[1] + scale * (sin * y + cos * x),
        ]
    }
}

/// The outline of a moving object, soft over about two pixels.
struct Ellipse {
    centre: [f32; 2],
    radii: [f32; 2],
}

impl Ellipse {
    fn random(rng: &mut impl Rng, patch: usize) -> Self {
        let side = patch as f32;
        Self {
            centre: [side * (rng.random::<f32>() - 0.5), side * (rng.random::<f32>() - 0.5)],
            radii: [side * rng.random_range(0.1..0.4), side * rng.random_range(0.1..0.4)],
        }
    }

    /// 1 inside, 0 outside, for the object moved by `shift`.
    fn cover(&self, point: [f32; 2], shift: [f32; 2]) -> f32 {
        let d: [f32; 2] = std::array::from_fn(|i| (point[i] - self.centre[i] - shift[i]) / self.radii[i]);
        let distance = (1.0 - d[0].hypot(d[1])) * self.radii[0].min(self.radii[1]);
        (0.5 + 0.5 * distance).clamp(0.0, 1.0)
    }
}

/// Catmull-Rom interpolation of a plane at `[y, x]`, in `[0, 1]`; mirrored outside.
fn bicubic(plane: ndarray::ArrayView2<'_, u8>, [y, x]: [f32; 2]) -> f32 {
    let (height, width) = plane.dim();
    let (y0, x0) = (y.floor(), x.floor());
    let (wy, wx) = (catmull_rom(y - y0), catmull_rom(x - x0));
    let columns: [usize; 4] = std::array::from_fn(|k| reflect(x0 as isize + k as isize - 1, width));
    let mut sum = 0.0;
    for (k, wy) in wy.into_iter().enumerate() {
        let row = reflect(y0 as isize + k as isize - 1, height);
        for (column, wx) in columns.into_iter().zip(wx) {
            sum += wy * wx * f32::from(plane[[row, column]]);
        }
    }
    sum / 255.0
}

fn catmull_rom(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [0.5 * (-t3 + 2.0 * t2 - t), 0.5 * (3.0 * t3 - 5.0 * t2 + 2.0), 0.5 * (-3.0 * t3 + 4.0 * t2 + t), 0.5 * (t3 - t2)]
}

/// The first frames of a clip, `[T, C, H, W]` in `[0, 1]`.
pub(super) fn to_video(clip: &[Frame], frames: usize) -> Array4<f32> {
    let clip = &clip[..frames.min(clip.len())];
    let (c, h, w) = clip[0].dim();
    let mut video = Array4::zeros((clip.len(), c, h, w));
    for (mut out, frame) in video.outer_iter_mut().zip(clip) {
        let frame: ArrayView3<'_, u8> = frame.view();
        out.zip_mut_with(&frame, |o, &v| *o = f32::from(v) / 255.0);
    }
    video
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn ramp(h: usize, w: usize) -> Frame {
        Array3::from_shape_fn((1, h, w), |(_, y, x)| (3 * y + 2 * x) as u8)
    }

    #[test]
    fn interpolation_keeps_pixels_and_straight_lines() {
        let frame = ramp(20, 20);
        let at = |y, x| 255.0 * bicubic(frame.index_axis(Axis(0), 0), [y, x]);
        assert!((at(4.0, 7.0) - 26.0).abs() < 1e-3);
        assert!((at(4.5, 7.25) - 28.0).abs() < 1e-3, "{}", at(4.5, 7.25));
    }

    #[test]
    fn clips_have_their_shape_even_from_tiny_sources_and_repeat_with_the_seed() {
        let data = TrainData {
            videos: vec![vec![ramp(3, 50), ramp(3, 50)]],
            photos: vec![ramp(1, 2), ramp(40, 30)],
            validation: vec![],
        };
        for photo_share in [0.0, 1.0] {
            for seed in 0..8 {
                let draw = || data.clip(&mut ChaCha8Rng::seed_from_u64(seed), 5, 16, photo_share);
                let clip = draw();
                assert_eq!(clip.dim(), (5, 1, 16, 16));
                assert!(clip.iter().all(|v| (0.0..=1.0).contains(v)));
                assert_eq!(clip, draw());
            }
        }
    }

    #[test]
    fn a_moving_camera_moves() {
        let photo = Array3::from_shape_fn((1, 64, 64), |(_, y, x)| ((y * 37 + x * 91) % 251) as u8);
        let data = TrainData { photos: vec![photo], ..TrainData::default() };
        let clip = data.clip(&mut ChaCha8Rng::seed_from_u64(1), 3, 16, 1.0);
        let still = (&clip.index_axis(Axis(0), 0) - &clip.index_axis(Axis(0), 1)).iter().all(|d| *d == 0.0);
        assert!(!still);
    }
}
