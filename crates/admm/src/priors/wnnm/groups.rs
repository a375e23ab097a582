//! Which patches are alike.

use super::WnnmParams;
use multiversion::multiversion;
use ndarray::{Array3, ArrayView3, ArrayView4, Axis, Zip, s};
use rayon::prelude::*;

/// Where a patch begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Place {
    pub(super) frame: usize,
    pub(super) row: usize,
    pub(super) column: usize,
}

/// Reference patches in a video.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Grid {
    pub(super) frames: usize,
    pub(super) height: usize,
    pub(super) width: usize,
    /// Of a patch.
    pub(super) side: usize,
    /// From one to the next, at most a side, so that every pixel is covered.
    pub(super) step: usize,
}

impl Grid {
    /// The patches around which groups are made; the last ones end with the frame.
    pub(super) fn references(self) -> Vec<Place> {
        let along = |length: usize| -> Vec<usize> {
            let last = length - self.side;
            (0..last).step_by(self.step).chain([last]).collect()
        };
        let (rows, columns) = (along(self.height), along(self.width));
        let mut all = Vec::with_capacity(self.frames * rows.len() * columns.len());
        for frame in 0..self.frames {
            all.extend(rows.iter().flat_map(|&row| columns.iter().map(move |&column| Place { frame, row, column })));
        }
        all
    }

    /// Where in a plane `[T, H, W]` a patch begins.
    fn offset(self, place: Place) -> usize {
        (place.frame * self.height + place.row) * self.width + place.column
    }
}

/// The groups of a video.
pub(super) struct Groups {
    pub(super) grid: Grid,
    /// Of the patches of all groups, where they begin in a plane `[T, H, W]`.
    members: Vec<u32>,
    /// Where each group ends among them.
    ends: Vec<usize>,
    /// How many patches cover a pixel `[T, H, W]`.
    pub(super) counts: Array3<f32>,
}

impl Groups {
    /// Looks for the patches like each reference, by the mean of the channels of a video `[T, C, H, W]`.
    pub(super) fn new(grid: Grid, params: WnnmParams, video: ArrayView4<'_, f32>) -> Self {
        let matcher = Matcher::new(grid, params, video);
        let found: Vec<Vec<u32>> = grid.references().into_par_iter().map(|place| matcher.like(place)).collect();
        let ends = found.iter().scan(0, |end, group| {
            *end += group.len();
            Some(*end)
        });
        let (ends, members) = (ends.collect(), found.concat());
        let mut counts = Array3::zeros((grid.frames, grid.height, grid.width));
        let (size, side) = (grid.height * grid.width, grid.side);
        for &member in &members {
            let (frame, at) = (member as usize / size, member as usize % size);
            let (row, column) = (at / grid.width, at % grid.width);
            let mut patch = counts.slice_mut(s![frame, row..row + side, column..column + side]);
            patch.mapv_inplace(|count| count + 1.0);
        }
        Self { grid, members, ends, counts }
    }

    pub(super) fn len(&self) -> usize {
        self.ends.len()
    }

    /// Where the patches of a group begin, the reference first.
    pub(super) fn group(&self, index: usize) -> &[u32] {
        let begin = if index == 0 { 0 } else { self.ends[index - 1] };
        &self.members[begin..self.ends[index]]
    }
}

/// Columns that are compared at a time.
const COLUMNS: usize = 16;
/// How far around the reference patches are compared first, so that most others are known to be too far off.
const NEAR: usize = 4;

/// Finds patches by the sum of squared differences of their brightness.
struct Matcher {
    grid: Grid,
    params: WnnmParams,
    /// The mean of the channels `[T, H, W + 16]`.
    brightness: Array3<f32>,
    /// The sums over the patches that begin at each pixel, over the square root of their number of pixels, of the same size: no
    /// patches are nearer to each other than these.
    sums: Array3<f32>,
}

impl Matcher {
    fn new(grid: Grid, params: WnnmParams, video: ArrayView4<'_, f32>) -> Self {
        let mut brightness = Array3::zeros((grid.frames, grid.height, grid.width + COLUMNS));
        let mean = video.mean_axis(Axis(1)).expect("a video has a channel");
        brightness.slice_mut(s![.., .., ..grid.width]).assign(&mean);
        let sums = sums(grid, brightness.view());
        Self { grid, params, brightness, sums }
    }

    /// Where the patches nearest to a reference begin, which is the first; among equals those that begin earlier.
    fn like(&self, reference: Place) -> Vec<u32> {
        let WnnmParams { group, window, .. } = self.params;
        let mut nearest = Nearest::new(group, self.grid.offset(reference) as u32);
        self.look(reference, NEAR.min(window), &mut nearest);
        let limit = nearest.limit();
        let mut nearest = Nearest { limit, ..Nearest::new(group, self.grid.offset(reference) as u32) };
        self.look(reference, window, &mut nearest);
        nearest.places()
    }

    /// Takes what begins within a window.
    fn look(&self, reference: Place, window: usize, nearest: &mut Nearest) {
        let Grid { frames, height, width, side, .. } = self.grid;
        let around = |at: usize, by: usize, end: usize| at.saturating_sub(by)..at.saturating_add(by).min(end - 1) + 1;
        let rows = around(reference.row, window, height - side + 1);
        let columns = around(reference.column, window, width - side + 1);
        let sum = self.sums[[reference.frame, reference.row, reference.column]];
        let pixels = self.patch(reference);
        let own = Own { pixels: &pixels, side, sum, slack: 1e-4 * (1.0 + sum.abs()) };
        let stride = width + COLUMNS;
        let (brightness, sums) = (self.brightness.as_slice(), self.sums.as_slice());
        let (brightness, sums) = (brightness.expect("made so"), sums.expect("made so"));
        for frame in around(reference.frame, self.params.frames, frames) {
            for row in rows.clone() {
                let from = (frame * height + row) * stride + columns.start;
                let first = self.grid.offset(Place { frame, row, column: columns.start });
                let row = Row { pixels: &brightness[from..], sums: &sums[from..], stride, count: columns.len() };
                compare(&own, &row, first as u32, nearest);
            }
        }
    }

    fn patch(&self, place: Place) -> Vec<f32> {
        let (rows, columns) = (place.row..place.row + self.grid.side, place.column..place.column + self.grid.side);
        self.brightness.slice(s![place.frame, rows, columns]).iter().copied().collect()
    }
}

/// A reference patch.
struct Own<'a> {
    pixels: &'a [f32],
    side: usize,
    sum: f32,
    /// More than what sums are rounded by.
    slack: f32,
}

/// Where patches of a row begin.
struct Row<'a> {
    /// From the first on, to the end of the video.
    pixels: &'a [f32],
    sums: &'a [f32],
    /// From a row to the next.
    stride: usize,
    /// How many begin one beside the other.
    count: usize,
}

/// Takes from a row the patches that are near enough to the reference.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn compare(own: &Own<'_>, row: &Row<'_>, first: u32, nearest: &mut Nearest) {
    for column in (0..row.count).step_by(COLUMNS) {
        let reach = f32::from_bits(nearest.limit);
        let far = reach.sqrt() + own.slack;
        let mut all_far = true;
        for sum in &row.sums[column..column + COLUMNS] {
            all_far &= (sum - own.sum).abs() > far;
        }
        if all_far {
            continue;
        }
        let mut distances = [0f32; COLUMNS];
        for (i, own) in own.pixels.chunks_exact(own.side).enumerate() {
            let other = &row.pixels[i * row.stride + column..][..own.len() + COLUMNS - 1];
            for (own, other) in own.iter().zip(other.windows(COLUMNS)) {
                for l in 0..COLUMNS {
                    distances[l] += (other[l] - own) * (other[l] - own);
                }
            }
            // Sums of squares only grow.
            all_far = true;
            for distance in &distances {
                all_far &= *distance > reach;
            }
            if all_far {
                break;
            }
        }
        if !all_far {
            nearest.take(&distances[..COLUMNS.min(row.count - column)], first + column as u32);
        }
    }
}

/// Of all patches `[T, H, W + 16]` the sum of their pixels over the square root of their number.
fn sums(grid: Grid, brightness: ArrayView3<'_, f32>) -> Array3<f32> {
    let scale = 1.0 / grid.side as f32;
    let mut all = Array3::zeros(brightness.dim());
    Zip::from(all.outer_iter_mut()).and(brightness.outer_iter()).par_for_each(|mut all, frame| {
        for (row, mut sums) in all.outer_iter_mut().enumerate().take(grid.height - grid.side + 1) {
            for (column, sum) in sums.iter_mut().enumerate().take(grid.width - grid.side + 1) {
                let patch = frame.slice(s![row..row + grid.side, column..column + grid.side]);
                *sum = scale * patch.iter().sum::<f32>();
            }
        }
    });
    all
}

/// The nearest patches so far.
struct Nearest {
    group: usize,
    reference: u32,
    /// The bits of a distance beyond which nothing is taken: bits of numbers that are not negative are in the numbers' order.
    limit: u32,
    /// The distance above, the place below: sorting by one number.
    found: Vec<u64>,
}

impl Nearest {
    fn new(group: usize, reference: u32) -> Self {
        Self { group, reference, limit: f32::INFINITY.to_bits(), found: Vec::with_capacity(4 * group + COLUMNS) }
    }

    /// Takes patches that begin next to each other.
    fn take(&mut self, distances: &[f32], first: u32) {
        for (k, distance) in distances.iter().enumerate() {
            let (bits, place) = (distance.to_bits(), first + k as u32);
            // The reference is the nearest, whatever else is equal to it, or is not a number.
            if place == self.reference {
                self.found.push(u64::from(place));
            } else if bits <= self.limit {
                self.found.push(u64::from(bits + 1) << 32 | u64::from(place));
            }
        }
        if self.found.len() > 4 * self.group {
            self.narrow();
        }
    }

    /// Leaves out what is not among the nearest, and what is further off from now on.
    fn narrow(&mut self) {
        let nearest = self.group.min(self.found.len());
        let (_, last, _) = self.found.select_nth_unstable(nearest - 1);
        if nearest == self.group {
            self.limit = self.limit.min(((*last >> 32) as u32).saturating_sub(1));
        }
        self.found.truncate(nearest);
    }

    fn limit(mut self) -> u32 {
        if !self.found.is_empty() {
            self.narrow();
        }
        self.limit
    }

    fn places(mut self) -> Vec<u32> {
        self.narrow();
        self.found.sort_unstable();
        self.found.into_iter().map(|key| key as u32).collect()
    }
}
