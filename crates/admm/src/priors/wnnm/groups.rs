//! Which patches are alike.

use super::Wnnm;
use ndarray::{Array3, ArrayView4, Axis, s};

/// Where a patch begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Place {
    pub(super) frame: usize,
    pub(super) row: usize,
    pub(super) column: usize,
}

/// Reference patches in a video.
#[derive(Debug, Clone, Copy)]
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
}

/// Columns that are compared at a time.
const COLUMNS: usize = 16;

/// Finds patches by the sum of squared differences of their brightness.
pub(super) struct Matcher {
    pub(super) grid: Grid,
    settings: Wnnm,
    /// The mean of the channels `[T, H, W + 16]`.
    brightness: Array3<f32>,
}

impl Matcher {
    pub(super) fn new(grid: Grid, settings: Wnnm, video: ArrayView4<'_, f32>) -> Self {
        let mut brightness = Array3::zeros((grid.frames, grid.height, grid.width + COLUMNS));
        let mean = video.mean_axis(Axis(1)).expect("a video has a channel");
        brightness.slice_mut(s![.., .., ..grid.width]).assign(&mean);
        Self { grid, settings, brightness }
    }

    /// The patches nearest to a reference, which is the first.
    pub(super) fn like(&self, reference: Place) -> Vec<Place> {
        let Grid { frames, height, width, side, .. } = self.grid;
        let near = |at: usize, by: usize, end: usize| at.saturating_sub(by)..at.saturating_add(by).min(end - 1) + 1;
        let Wnnm { window, group, .. } = self.settings;
        let rows = near(reference.row, window, height - side + 1);
        let columns = near(reference.column, window, width - side + 1);
        // The distance above, the place below: sorting by one number.
        let mut found: Vec<u64> = Vec::new();
        for frame in near(reference.frame, self.settings.frames, frames) {
            for row in rows.clone() {
                for first in columns.clone().step_by(COLUMNS) {
                    let distances = self.distances(reference, Place { frame, row, column: first });
                    let count = COLUMNS.min(columns.end - first);
                    found.extend(distances[..count].iter().enumerate().map(|(k, d)| {
                        let place = Place { frame, row, column: first + k };
                        // The reference is the nearest, whatever else is equal to it.
                        let bits = if place == reference { 0 } else { d.to_bits().saturating_add(1) };
                        u64::from(bits) << 32 | self.number(place)
                    }));
                }
            }
        }
        let nearest = group.clamp(1, found.len());
        found.select_nth_unstable(nearest - 1);
        found.truncate(nearest);
        found.sort_unstable();
        found.into_iter().map(|key| self.place(key & u64::from(u32::MAX))).collect()
    }

    fn number(&self, place: Place) -> u64 {
        ((place.frame * self.grid.height + place.row) * self.grid.width + place.column) as u64
    }

    fn place(&self, number: u64) -> Place {
        let (rows, column) = (number as usize / self.grid.width, number as usize % self.grid.width);
        Place { frame: rows / self.grid.height, row: rows % self.grid.height, column }
    }

    /// Between the reference and the patch at a place, and the patches that begin in the columns after it; what is beyond the frame is
    /// unspecified.
    fn distances(&self, reference: Place, first: Place) -> [f32; COLUMNS] {
        let side = self.grid.side;
        let all = self.brightness.as_slice().expect("made so");
        let width = self.grid.width + COLUMNS;
        let row =
            |place: Place, i: usize| &all[(place.frame * self.grid.height + place.row + i) * width + place.column..];
        let mut sums = [0f32; COLUMNS];
        for i in 0..side {
            let own = &row(reference, i)[..side];
            let other = &row(first, i)[..side + COLUMNS - 1];
            for (j, &own) in own.iter().enumerate() {
                for (sum, &other) in sums.iter_mut().zip(&other[j..j + COLUMNS]) {
                    *sum += (other - own) * (other - own);
                }
            }
        }
        sums
    }
}
