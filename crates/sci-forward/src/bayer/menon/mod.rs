//! Directional filtering with a posteriori decision, in bands of rows.

mod kernels;

use super::rows::{PAD, copy_every_other, mirror, mirror_columns};
use super::{CfaPattern, Color, Demosaicer, check_sizes};
use crate::BoxError;
use kernels::{Cross, change, decide, green, interpolate, refine, refine_at_green, select};
use ndarray::parallel::prelude::*;
use ndarray::{ArrayView1, ArrayView2, ArrayView3, ArrayViewMut1, ArrayViewMut3, ArrayViewMut4, Axis};

/// Rows of one parallel task.
const BAND: usize = 64;

/// Demosaicing by directional filtering, a posteriori decision, and refinement (DDFAPD).
///
/// Green is interpolated along the row and along the column; at each site the direction whose color differences vary less
/// wins. Red and blue follow from interpolated color differences, in the winning direction where they are opposite to each other.
/// The refinement then smooths the color differences with a mean of 3 in that direction.
///
/// ```
/// use ndarray::{Array3, Array4};
/// use sci_forward::{CfaPattern, Demosaicer, bayer::Menon};
///
/// // A vertical edge stays as sharp as it is: it is interpolated along the columns.
/// let edge = Array3::from_shape_fn((1, 12, 12), |(_, _, column)| if column < 6 { 0.1 } else { 0.9 });
/// let mut rgb = Array4::zeros((1, 3, 12, 12));
/// Menon.demosaic(CfaPattern::Rggb, edge.view(), rgb.view_mut())?;
/// assert!(rgb.indexed_iter().all(|((.., column), v)| (v - if column < 6 { 0.1 } else { 0.9 }).abs() < 1e-6));
/// # Ok::<(), sci_forward::BoxError>(())
/// ```
///
/// # References
/// Menon, Andriani, Calvagno, *Demosaicing with directional filtering and a posteriori decision*, 2007.
#[derive(Debug, Clone, Copy, Default)]
pub struct Menon;

impl Demosaicer for Menon {
    fn name(&self) -> &str {
        "menon"
    }

    fn demosaic(
        &mut self,
        cfa: CfaPattern,
        mosaic: ArrayView3<'_, f32>,
        mut rgb: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        check_sizes(mosaic.dim(), rgb.dim())?;
        rgb.axis_iter_mut(Axis(0)).into_par_iter().zip(mosaic.axis_iter(Axis(0))).for_each(|(mut rgb, mosaic)| {
            rgb.axis_chunks_iter_mut(Axis(1), BAND)
                .into_par_iter()
                .enumerate()
                .for_each(|(band, rgb)| Band::new(cfa, mosaic).demosaic(band * BAND, rgb));
        });
        Ok(())
    }
}

/// The last rows of an image in the making, each padded by some columns. What lies outside of the image is mirrored into it, or 0.
struct Rows {
    rows: [Vec<f32>; Self::COUNT],
    height: usize,
    /// A row outside, if it is not mirrored.
    zeros: Option<Vec<f32>>,
}

impl Rows {
    /// At least as many as lie between the rows that any step reads.
    const COUNT: usize = 8;

    fn mirrored((height, width): (usize, usize)) -> Self {
        // Of NaN, so that no result can come from a row that was not made.
        Self { rows: std::array::from_fn(|_| vec![f32::NAN; width + 2 * PAD]), height, zeros: None }
    }

    fn zero_outside(size: (usize, usize)) -> Self {
        Self { zeros: Some(vec![0.0; size.1 + 2 * PAD]), ..Self::mirrored(size) }
    }

    /// Row `row` with [`PAD`] columns on each side.
    fn padded(&self, row: isize) -> &[f32] {
        match &self.zeros {
            Some(zeros) if !(0..self.height as isize).contains(&row) => zeros,
            _ => &self.rows[mirror(row, self.height) % Self::COUNT],
        }
    }

    /// Row `row`, from `columns` further on.
    fn shifted(&self, row: isize, columns: isize) -> &[f32] {
        let padded = self.padded(row);
        &padded[(PAD as isize + columns) as usize..][..padded.len() - 2 * PAD]
    }

    fn row(&self, row: isize) -> &[f32] {
        self.shifted(row, 0)
    }

    /// The neighbours of the sites of a row, to the left and to the right.
    fn beside(&self, row: isize) -> [&[f32]; 2] {
        [self.shifted(row, -1), self.shifted(row, 1)]
    }

    /// Those above and below.
    fn above_and_below(&self, row: isize) -> [&[f32]; 2] {
        [self.row(row - 1), self.row(row + 1)]
    }

    fn cross(&self, row: isize) -> Cross<'_> {
        Cross { here: self.row(row), beside: self.beside(row), above_and_below: self.above_and_below(row) }
    }

    /// Lets `write` make or change a row of the image.
    fn make(&mut self, row: isize, write: impl FnOnce(&mut [f32])) {
        let padded = &mut self.rows[row as usize % Self::COUNT];
        let width = padded.len() - 2 * PAD;
        write(&mut padded[PAD..][..width]);
        match self.zeros {
            None => mirror_columns(padded),
            Some(_) => [0, 1, width + PAD, width + PAD + 1].into_iter().for_each(|column| padded[column] = 0.0),
        }
    }

    /// Takes every other value of a row from `values`, those from column `first` on.
    fn merge(&mut self, row: isize, values: &[f32], first: usize) {
        self.make(row, |row| copy_every_other(row.into(), values.into(), first));
    }
}

/// What the sites of a row see: green, and in between one color. The color opposite to it is seen in the rows above and below.
struct Sites {
    first_green: usize,
    first_colored: usize,
    color: usize,
    opposite: usize,
}

impl Sites {
    fn of_row(cfa: CfaPattern, row: isize) -> Self {
        let first_colored = usize::from(cfa.color_at(row as usize, 0) == Color::Green);
        let color = cfa.color_at(row as usize, first_colored);
        let opposite = if color == Color::Red { Color::Blue } else { Color::Red };
        Self { first_green: 1 - first_colored, first_colored, color: color as usize, opposite: opposite as usize }
    }
}

/// A step of the method, which makes one row from rows of the steps before it.
struct Step<'a> {
    /// How many rows it is ahead of the output: those that the steps after it read below their own.
    ahead: isize,
    /// How many rows above the band are needed of it.
    above: isize,
    make: fn(&mut Band<'a>, isize),
}

/// A band of rows of a frame in the making.
struct Band<'a> {
    cfa: CfaPattern,
    mosaic: ArrayView2<'a, f32>,
    samples: Rows,
    /// Green interpolated along the rows, and along the columns.
    greens: [Rows; 2],
    /// How much the color difference changes over two sites, along the rows and along the columns.
    changes: [Rows; 2],
    /// 1 where a site is interpolated along its row, 0 where along its column.
    along_row: Rows,
    /// Red, green and blue.
    planes: [Rows; 3],
    /// A row of values, of which every other one is wanted.
    values: Vec<f32>,
}

impl<'a> Band<'a> {
    const STEPS: [Step<'a>; 9] = [
        Step { ahead: 8, above: 8, make: Self::read },
        Step { ahead: 6, above: 6, make: Self::interpolate_green },
        Step { ahead: 4, above: 6, make: Self::change_along_columns },
        Step { ahead: 4, above: 4, make: Self::decide },
        Step { ahead: 3, above: 3, make: Self::red_and_blue_at_green },
        Step { ahead: 2, above: 2, make: Self::opposite_colors },
        Step { ahead: 2, above: 2, make: Self::refine_green },
        Step { ahead: 1, above: 1, make: Self::refine_red_and_blue_at_green },
        Step { ahead: 0, above: 0, make: Self::refine_opposite_colors },
    ];

    fn new(cfa: CfaPattern, mosaic: ArrayView2<'a, f32>) -> Self {
        let (size, width) = (mosaic.dim(), mosaic.ncols());
        let rows = || Rows::mirrored(size);
        Self {
            cfa,
            mosaic,
            samples: rows(),
            greens: [rows(), rows()],
            changes: [Rows::zero_outside(size), Rows::zero_outside(size)],
            along_row: rows(),
            planes: [rows(), rows(), rows()],
            values: vec![0.0; width],
        }
    }

    /// Rows `first..` of the frame, `rgb` being `[3, rows, W]`.
    fn demosaic(mut self, first: usize, mut rgb: ArrayViewMut3<'_, f32>) {
        let first = first as isize;
        let rows = first..first + rgb.dim().1 as isize;
        let start = first - Self::STEPS[0].ahead - Self::STEPS[0].above;
        for out in start..rows.end {
            for Step { ahead, above, make } in &Self::STEPS {
                let row = out + ahead;
                if row >= (first - above).max(0) && row < self.mosaic.nrows() as isize {
                    make(&mut self, row);
                }
            }
            if rows.contains(&out) {
                let mut rgb = rgb.index_axis_mut(Axis(1), (out - first) as usize);
                for (mut to, plane) in rgb.outer_iter_mut().zip(&self.planes) {
                    to.assign(&ArrayView1::from(plane.row(out)));
                }
            }
        }
    }

    fn sites(&self, row: isize) -> Sites {
        Sites::of_row(self.cfa, row)
    }

    fn read(&mut self, row: isize) {
        let source = self.mosaic.row(row as usize);
        self.samples.make(row, |to| ArrayViewMut1::from(to).assign(&source));
    }

    fn interpolate_green(&mut self, row: isize) {
        let Sites { first_green, .. } = self.sites(row);
        let samples = &self.samples;
        let [along_row, along_column] = &mut self.greens;
        along_row.make(row, |to| green(to, [-2, -1, 0, 1, 2].map(|k| samples.shifted(row, k))));
        along_column.make(row, |to| green(to, [-2, -1, 0, 1, 2].map(|k| samples.row(row + k))));
        along_row.merge(row, samples.row(row), first_green);
        along_column.merge(row, samples.row(row), first_green);
        let difference = |by| [samples.shifted(row, by), along_row.shifted(row, by)];
        self.changes[0].make(row, |to| change(to, difference(0), difference(2)));
    }

    fn change_along_columns(&mut self, row: isize) {
        let difference = |row| [self.samples.row(row), self.greens[1].row(row)];
        self.changes[1].make(row, |to| change(to, difference(row), difference(row + 2)));
    }

    fn decide(&mut self, row: isize) {
        let [row_changes, column_changes] = &self.changes;
        let row_changes = [-2, -1, 0, 1, 2].map(|k| row_changes.padded(row + k));
        let column_changes = [-2, -1, 0].map(|k| column_changes.padded(row + k));
        self.along_row.make(row, |to| decide(to, row_changes, column_changes));
        let (along_row, [a, b]) = (self.along_row.row(row), &self.greens);
        self.planes[Color::Green as usize].make(row, |to| select(to, along_row, a.row(row), b.row(row)));
    }

    /// Red and blue at the green sites: green plus the mean color difference of the two neighbours that have the color.
    fn red_and_blue_at_green(&mut self, row: isize) {
        let (sites, samples) = (self.sites(row), &self.samples);
        let [color, opposite, green] = in_order(&mut self.planes, &sites);
        color.make(row, |to| interpolate(to, green.row(row), samples.beside(row), green.beside(row)));
        color.merge(row, samples.row(row), sites.first_colored);
        let (samples, around) = (samples.above_and_below(row), green.above_and_below(row));
        opposite.make(row, |to| interpolate(to, green.row(row), samples, around));
    }

    /// Red at the blue sites and blue at the red ones, in the direction decided for the site.
    fn opposite_colors(&mut self, row: isize) {
        let sites = self.sites(row);
        let [color, opposite, _] = in_order(&mut self.planes, &sites);
        kernels::opposite(&mut self.values, self.along_row.row(row), color.cross(row), opposite.cross(row));
        opposite.merge(row, &self.values, sites.first_colored);
    }

    /// Green at the colored sites, from the smoothed difference to the color that was seen.
    fn refine_green(&mut self, row: isize) {
        let sites = self.sites(row);
        let [color, _, green] = in_order(&mut self.planes, &sites);
        refine(&mut self.values, self.along_row.row(row), color.cross(row), green.cross(row));
        green.merge(row, &self.values, sites.first_colored);
    }

    /// Red and blue at the green sites, from the differences to the new green.
    fn refine_red_and_blue_at_green(&mut self, row: isize) {
        let sites = self.sites(row);
        let [color, opposite, green] = in_order(&mut self.planes, &sites);
        refine_at_green(&mut self.values, green.row(row), color.beside(row), green.beside(row));
        color.merge(row, &self.values, sites.first_green);
        let around = green.above_and_below(row);
        refine_at_green(&mut self.values, green.row(row), opposite.above_and_below(row), around);
        opposite.merge(row, &self.values, sites.first_green);
    }

    /// Red at blue and blue at red, from their smoothed difference.
    fn refine_opposite_colors(&mut self, row: isize) {
        let sites = self.sites(row);
        let [color, opposite, _] = in_order(&mut self.planes, &sites);
        refine(&mut self.values, self.along_row.row(row), color.cross(row), opposite.cross(row));
        opposite.merge(row, &self.values, sites.first_colored);
    }
}

/// The planes of the color of a row, of the opposite one, and of green.
fn in_order<'p>(planes: &'p mut [Rows; 3], sites: &Sites) -> [&'p mut Rows; 3] {
    planes
        .get_disjoint_mut([sites.color, sites.opposite, Color::Green as usize])
        .expect("three colors are three planes")
}
