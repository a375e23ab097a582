//! The decorator that leaves out what a scene does not need: static tiles, and tiles that have settled.

use crate::{BoxError, Call, Denoiser};
use ndarray::parallel::prelude::*;
use ndarray::{Array3, Array4, ArrayView4, ArrayViewMut4, Axis, Zip, s};
use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Side of a tile in pixels, a multiple of every network's grid.
pub(crate) const SIDE: usize = 32;
/// Pixels around a region that a denoiser is given besides it: what the region sees of its surroundings.
const HALO: usize = 16;
/// A static tile whose frames come to differ by so many times the least that they differed moves after all.
const WAKE: f64 = 3.0;
/// A tile is settled while the root mean square change of its input is at most this, in units of σ.
const SETTLED: f32 = 0.05;
/// Mean square deviation of frames that never wakes a tile.
const FLOOR: f64 = (2.0 / 255.0) * (2.0 / 255.0);
/// Frames that differ by so many σ are alike but for what the denoiser takes for noise.
const QUIET: f32 = 1.25;
/// A call that would save less than this share of its pixels is made in one piece.
const LEAST_SAVED: f64 = 0.1;

/// Pixels that a denoiser was asked for, and those that it was spared.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TileCounts {
    /// Pixels of all frames of all calls.
    pub asked: u64,
    /// Those that the inner denoiser has worked on, halos included.
    pub done: u64,
}

impl TileCounts {
    /// The share left out, 0 to 1.
    pub fn skipped(&self) -> f64 {
        if self.asked == 0 { 0.0 } else { (1.0 - self.done as f64 / self.asked as f64).max(0.0) }
    }
}

/// [`TileCounts`] while they grow, to be read when the denoiser has been given away.
#[derive(Debug, Default)]
pub struct TileCounter {
    asked: AtomicU64,
    done: AtomicU64,
}

impl TileCounter {
    /// The counts as they are now.
    pub fn counts(&self) -> TileCounts {
        TileCounts { asked: self.asked.load(Ordering::Relaxed), done: self.done.load(Ordering::Relaxed) }
    }

    fn add(&self, asked: usize, done: usize) {
        self.asked.fetch_add(asked as u64, Ordering::Relaxed);
        self.done.fetch_add(done as u64, Ordering::Relaxed);
    }
}

/// Gives the inner denoiser only what is needed.
///
/// Tiles have 32 × 32 pixels.
///
/// * *Static tiles*, which the measurement tells ([`still`](crate::still)): the mean of their frames is denoised once, for all
///   of them. Their frames differ by what the data step adds, frame by frame, to explain the measurement; a tile whose
///   frames come to differ by 3 times the least of before, and by more than 1.25 σ, is woken for good, as
///   no static picture explains it.
/// * *Settled tiles.* A tile whose input has changed by at most 0.05 σ (root mean square) since it was last denoised, in the same
///   stage, keeps its output. The solver goes on to push its input towards the measurement, so that a residual wakes it.
///
/// What is left is denoised in rectangles with a halo of 16 pixels, or as a whole where that saves nothing. The inner denoiser must not
/// depend on where in the picture it is; it is called with as many frames as there are, or with one.
pub struct Tiles<D> {
    inner: D,
    memory: Option<Memory>,
    /// For each tile the least deviation of its frames so far, in mean squares; nothing where it moves.
    still: Vec<Option<f64>>,
    counter: Arc<TileCounter>,
}

/// What was denoised last.
struct Memory {
    stage: usize,
    /// For each tile the input of when it was last denoised.
    input: Array4<f32>,
    output: Array4<f32>,
}

/// What a tile needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Need {
    /// Nothing.
    Settled,
    /// One frame.
    MeanFrame,
    /// Every frame.
    Frames,
}

impl<D: Denoiser> Tiles<D> {
    /// Around a denoiser; `still` says which tiles stand still, in rows, as [`still`](crate::still) finds them; empty: none.
    pub fn new(inner: D, still: &[bool]) -> Self {
        let still = still.iter().map(|&still| still.then_some(f64::INFINITY)).collect();
        Self { inner, memory: None, still, counter: Arc::default() }
    }

    /// What was left out so far, also when the denoiser itself is out of reach.
    pub fn counter(&self) -> Arc<TileCounter> {
        Arc::clone(&self.counter)
    }

    /// Takes every tile for a moving one if nothing is known of them.
    fn fit(&mut self, grid: Grid) -> Result<(), BoxError> {
        if self.still.is_empty() {
            self.still.resize(grid.len(), None);
        }
        let (known, tiles) = (self.still.len(), grid.len());
        if known == tiles { Ok(()) } else { Err(format!("{known} tiles are known, the video has {tiles}").into()) }
    }

    /// What each tile of the grid needs.
    fn needs(&mut self, call: &Call<'_>, noisy: ArrayView4<'_, f32>, grid: Grid) -> Vec<Need> {
        let memory = self.memory.as_ref().filter(|m| m.stage == call.stage && m.input.dim() == noisy.dim());
        let sigma = call.sigma.unwrap_or(0.0);
        let begun = self.memory.is_some();
        let noise = FLOOR.max(f64::from(QUIET * sigma).powi(2));
        let need = |(tile, still): (usize, &mut Option<f64>)| {
            let (rows, columns) = grid.tile(tile);
            let now = noisy.slice(s![.., .., rows.clone(), columns.clone()]);
            // Before the first call nothing has made the frames alike, or unlike.
            if let (Some(least), true) = (&*still, begun) {
                let deviation = deviation(now);
                let awake = deviation > noise.max(*least * WAKE.powi(2));
                *still = if awake { None } else { Some(least.min(deviation)) };
            }
            let settled = memory.is_some_and(|memory| {
                let then = memory.input.slice(s![.., .., rows, columns]);
                let sum = Zip::from(&now).and(&then).fold(0.0, |sum, a, b| sum + f64::from(a - b).powi(2));
                sum <= f64::from(SETTLED * sigma).powi(2) * now.len() as f64
            });
            match still {
                _ if settled => Need::Settled,
                Some(_) => Need::MeanFrame,
                None => Need::Frames,
            }
        };
        self.still.par_iter_mut().enumerate().map(need).collect()
    }

    /// Keeps the input and output of these tiles.
    fn remember(
        &mut self,
        stage: usize,
        noisy: ArrayView4<'_, f32>,
        out: ArrayView4<'_, f32>,
        tiles: impl Iterator<Item = (Range<usize>, Range<usize>)>,
    ) {
        let known = self.memory.take().filter(|m| m.input.dim() == noisy.dim());
        let mut memory = known.unwrap_or_else(|| Memory { stage, input: noisy.to_owned(), output: out.to_owned() });
        memory.stage = stage;
        for (rows, columns) in tiles {
            let tile = s![.., .., rows, columns];
            memory.input.slice_mut(tile).assign(&noisy.slice(tile));
            memory.output.slice_mut(tile).assign(&out.slice(tile));
        }
        self.memory = Some(memory);
    }

    /// Denoises the mean of all frames and puts it into the tiles that need no more.
    fn denoise_mean(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        out: &mut ArrayViewMut4<'_, f32>,
        tiles: &[(Range<usize>, Range<usize>)],
    ) -> Result<(), BoxError> {
        let mean = mean_frame(noisy).insert_axis(Axis(0));
        let mut denoised = Array4::zeros(mean.dim());
        self.inner.denoise(&call.without_measurement(), mean.view(), denoised.view_mut())?;
        for (rows, columns) in tiles {
            let from = denoised.slice(s![0, .., rows.clone(), columns.clone()]);
            for mut frame in out.slice_mut(s![.., .., rows.clone(), columns.clone()]).outer_iter_mut() {
                frame.assign(&from);
            }
        }
        Ok(())
    }
}

impl<D: Denoiser> Denoiser for Tiles<D> {
    fn name(&self) -> &str {
        self.inner.name()
    }

    fn denoise(
        &mut self,
        call: &Call<'_>,
        noisy: ArrayView4<'_, f32>,
        mut out: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        let (frames, _, height, width) = noisy.dim();
        let grid = Grid { height, width, side: SIDE };
        self.fit(grid)?;
        let needs = self.needs(call, noisy, grid);
        let of = |need: Need| (0..needs.len()).filter(|&i| needs[i] == need).map(|i| grid.tile(i)).collect::<Vec<_>>();
        let still = of(Need::MeanFrame);
        let moving = rectangles(&needs, grid);
        let with_halo: Vec<_> = moving.iter().map(|(r, c)| grid.grown(r, c, HALO)).collect();
        let area = |(rows, columns): &(Range<usize>, Range<usize>)| rows.len() * columns.len();
        let all = frames * height * width;
        let work =
            frames * with_halo.iter().map(area).sum::<usize>() + if still.is_empty() { 0 } else { height * width };
        let whole = work as f64 > (1.0 - LEAST_SAVED) * all as f64;
        self.counter.add(all, if whole { all } else { work });
        if whole {
            self.inner.denoise(call, noisy, out.view_mut())?;
            self.memory = Some(Memory { stage: call.stage, input: noisy.to_owned(), output: out.to_owned() });
            return Ok(());
        }
        if let Some(memory) = &self.memory {
            for (rows, columns) in of(Need::Settled) {
                let kept = memory.output.slice(s![.., .., rows.clone(), columns.clone()]);
                out.slice_mut(s![.., .., rows, columns]).assign(&kept);
            }
        }
        if !still.is_empty() {
            self.denoise_mean(call, noisy, &mut out, &still)?;
        }
        for ((rows, columns), (halo_rows, halo_columns)) in moving.iter().zip(&with_halo) {
            let input = noisy.slice(s![.., .., halo_rows.clone(), halo_columns.clone()]).to_owned();
            let mut denoised = Array4::zeros(input.dim());
            self.inner.denoise(&call.without_measurement(), input.view(), denoised.view_mut())?;
            let (top, left) = (rows.start - halo_rows.start, columns.start - halo_columns.start);
            let core = denoised.slice(s![.., .., top..top + rows.len(), left..left + columns.len()]);
            out.slice_mut(s![.., .., rows.clone(), columns.clone()]).assign(&core);
        }
        let worked_on = of(Need::MeanFrame).into_iter().chain(of(Need::Frames));
        self.remember(call.stage, noisy, out.view(), worked_on);
        Ok(())
    }
}

fn mean_frame(video: ArrayView4<'_, f32>) -> Array3<f32> {
    video.mean_axis(Axis(0)).expect("a video has at least one frame")
}

/// Mean square of the differences of the frames of a tile `[T, C, h, w]` from their mean.
fn deviation(tile: ArrayView4<'_, f32>) -> f64 {
    let mean = mean_frame(tile);
    let sum = tile
        .outer_iter()
        .map(|frame| Zip::from(frame).and(&mean).fold(0.0, |sum, x, m| sum + f64::from(x - m).powi(2)))
        .sum::<f64>();
    sum / tile.len() as f64
}

/// A picture cut into square tiles, those at the right and bottom as small as need be.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Grid {
    pub(crate) height: usize,
    pub(crate) width: usize,
    pub(crate) side: usize,
}

impl Grid {
    pub(crate) fn columns(self) -> usize {
        self.width.div_ceil(self.side)
    }

    pub(crate) fn len(self) -> usize {
        self.columns() * self.height.div_ceil(self.side)
    }

    /// The rows and columns of a tile.
    pub(crate) fn tile(self, index: usize) -> (Range<usize>, Range<usize>) {
        let (row, column) = (index / self.columns(), index % self.columns());
        self.region(row..row + 1, column..column + 1)
    }

    /// The rows and columns of a rectangle of tiles.
    fn region(self, rows: Range<usize>, columns: Range<usize>) -> (Range<usize>, Range<usize>) {
        let pixels = |r: Range<usize>, end: usize| r.start * self.side..(r.end * self.side).min(end);
        (pixels(rows, self.height), pixels(columns, self.width))
    }

    fn grown(self, rows: &Range<usize>, columns: &Range<usize>, by: usize) -> (Range<usize>, Range<usize>) {
        let grow = |r: &Range<usize>, end: usize| r.start.saturating_sub(by)..(r.end + by).min(end);
        (grow(rows, self.height), grow(columns, self.width))
    }
}

/// Rectangles that cover the tiles that need every frame and no others: runs within a row, joined with equal ones below.
fn rectangles(needs: &[Need], grid: Grid) -> Vec<(Range<usize>, Range<usize>)> {
    let mut done: Vec<(Range<usize>, Range<usize>)> = Vec::new();
    for (row, tiles) in needs.chunks(grid.columns()).enumerate() {
        let mut column = 0;
        for run in tiles.chunk_by(|a, b| (*a == Need::Frames) == (*b == Need::Frames)) {
            let columns = column..column + run.len();
            column = columns.end;
            if run[0] != Need::Frames {
                continue;
            }
            match done.iter_mut().find(|(rows, c)| rows.end == row && *c == columns) {
                Some((rows, _)) => rows.end += 1,
                None => done.push((row..row + 1, columns)),
            }
        }
    }
    done.into_iter().map(|(rows, columns)| grid.region(rows, columns)).collect()
}
