//! Directional filtering with a posteriori decision.

use super::rows::mirror;
use super::{CfaPattern, Color, Demosaicer, check_sizes};
use crate::BoxError;
use ndarray::parallel::prelude::*;
use ndarray::{Array2, ArrayView2, ArrayView3, ArrayViewMut3, ArrayViewMut4, Axis};

/// Demosaicing by directional filtering, a posteriori decision, and refinement (DDFAPD).
///
/// Green is interpolated along the row and along the column; at each site the direction whose color differences vary less
/// wins. Red and blue follow from interpolated color differences, in the winning direction where they are opposite to each other.
/// The refinement then smooths the color differences with a mean of 3 in that direction.
///
/// # References
/// Menon, Andriani, Calvagno, *Demosaicing with directional filtering and a posteriori decision*, 2007.
#[derive(Debug, Clone, Copy, Default)]
pub struct Menon;

impl Demosaicer for Menon {
    fn demosaic(
        &mut self,
        cfa: CfaPattern,
        mosaic: ArrayView3<'_, f32>,
        mut rgb: ArrayViewMut4<'_, f32>,
    ) -> Result<(), BoxError> {
        check_sizes(mosaic.dim(), rgb.dim())?;
        rgb.axis_iter_mut(Axis(0))
            .into_par_iter()
            .zip(mosaic.axis_iter(Axis(0)))
            .for_each(|(rgb, mosaic)| Frame::new(cfa, mosaic).demosaic(rgb));
        Ok(())
    }
}

/// Along which axis a site is interpolated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Direction {
    Row,
    Column,
}

/// One frame in the making.
struct Frame<'a> {
    cfa: CfaPattern,
    cfa_samples: ArrayView2<'a, f32>,
    /// Red, green and blue, each `[H, W]`.
    planes: [Array2<f32>; 3],
    direction: Array2<Direction>,
}

impl<'a> Frame<'a> {
    fn new(cfa: CfaPattern, cfa_samples: ArrayView2<'a, f32>) -> Self {
        let planes = [Color::Red, Color::Green, Color::Blue].map(|color| {
            Array2::from_shape_fn(cfa_samples.dim(), |(r, c)| {
                if cfa.color_at(r, c) == color { cfa_samples[[r, c]] } else { 0.0 }
            })
        });
        Self { cfa, cfa_samples, planes, direction: Array2::from_elem(cfa_samples.dim(), Direction::Row) }
    }

    fn demosaic(mut self, mut rgb: ArrayViewMut3<'_, f32>) {
        self.green_and_direction();
        self.red_and_blue_at_green();
        self.opposite_colors();
        self.refine();
        for (plane, mut out) in self.planes.iter().zip(rgb.outer_iter_mut()) {
            out.assign(plane);
        }
    }

    fn green_and_direction(&mut self) {
        let size = self.cfa_samples.dim();
        let samples = self.cfa_samples;
        let is_green = |r, c| self.cfa.color_at(r, c) == Color::Green;
        // Green by the 5-tap filter −¼ ½ ½ ½ −¼ of the mosaic itself.
        let green = [Direction::Row, Direction::Column].map(|direction| {
            Array2::from_shape_fn(size, |(r, c)| {
                let at = |k| along(&samples, direction, r, c, k);
                if is_green(r, c) { samples[[r, c]] } else { 0.5 * (at(-1) + at(0) + at(1)) - 0.25 * (at(-2) + at(2)) }
            })
        });
        // How much the color difference changes over two sites, in the direction of the interpolation.
        let change = [Direction::Row, Direction::Column].map(|direction| {
            let green = &green[direction as usize];
            let difference = Array2::from_shape_fn(size, |(r, c)| samples[[r, c]] - green[[r, c]]);
            Array2::from_shape_fn(size, |(r, c)| {
                (difference[[r, c]] - along(&difference.view(), direction, r, c, 2)).abs()
            })
        });
        let activity = |direction: Direction, r: usize, c: usize| -> f32 {
            let change = &change[direction as usize];
            // (across, along, weight); a change belongs to the site before it, hence the taps behind.
            const TAPS: [(isize, isize, f32); 8] = [
                (-2, 0, 1.0),
                (-2, -2, 1.0),
                (-1, -1, 1.0),
                (0, 0, 3.0),
                (0, -2, 3.0),
                (1, -1, 1.0),
                (2, 0, 1.0),
                (2, -2, 1.0),
            ];
            TAPS.iter()
                .map(|&(across, along, weight)| {
                    let (dr, dc) = if direction == Direction::Row { (across, along) } else { (along, across) };
                    let site = (r.checked_add_signed(dr), c.checked_add_signed(dc));
                    let (Some(r), Some(c)) = site else { return 0.0 };
                    weight * change.get((r, c)).copied().unwrap_or(0.0)
                })
                .sum()
        };
        self.direction = Array2::from_shape_fn(size, |(r, c)| {
            if activity(Direction::Column, r, c) >= activity(Direction::Row, r, c) {
                Direction::Row
            } else {
                Direction::Column
            }
        });
        let chosen = Array2::from_shape_fn(size, |site| green[self.direction[site] as usize][site]);
        self.planes[Color::Green as usize] = chosen;
    }

    /// Red and blue at the green sites: green plus the mean color difference of the two neighbours that have the color.
    fn red_and_blue_at_green(&mut self) {
        let (height, width) = self.cfa_samples.dim();
        for color in [Color::Red, Color::Blue] {
            let [red, green, blue] = &self.planes;
            let plane = if color == Color::Red { red } else { blue };
            let updated = Array2::from_shape_fn((height, width), |(r, c)| {
                if self.cfa.color_at(r, c) != Color::Green {
                    return plane[[r, c]];
                }
                let direction = self.direction_of(color, r, c);
                let mean = |p: &Array2<f32>| neighbours(&p.view(), direction, r, c);
                green[[r, c]] + mean(plane) - mean(green)
            });
            self.planes[color as usize] = updated;
        }
    }

    /// The direction in which a green site has neighbours of a color.
    fn direction_of(&self, color: Color, r: usize, c: usize) -> Direction {
        if self.cfa.color_at(r, c + 1) == color { Direction::Row } else { Direction::Column }
    }

    /// Red at the blue sites and blue at the red ones, in the direction decided for the site.
    fn opposite_colors(&mut self) {
        let [red, _, blue] = &self.planes;
        let (old_red, old_blue) = (red.clone(), blue.clone());
        for (site, &direction) in self.direction.indexed_iter() {
            let mean = |p: &Array2<f32>| neighbours(&p.view(), direction, site.0, site.1);
            match self.cfa.color_at(site.0, site.1) {
                Color::Blue => self.planes[0][site] = old_blue[site] + mean(&old_red) - mean(&old_blue),
                Color::Red => self.planes[2][site] = old_red[site] + mean(&old_blue) - mean(&old_red),
                Color::Green => {}
            }
        }
    }

    fn refine(&mut self) {
        let color_at = |site: (usize, usize)| self.cfa.color_at(site.0, site.1);
        let smooth = |p: &Array2<f32>, site: (usize, usize)| {
            let at = |k| along(&p.view(), self.direction[site], site.0, site.1, k);
            (at(-1) + at(0) + at(1)) / 3.0
        };
        let [red, green, blue] = &mut self.planes;

        // Green at the colored sites, from the smoothed difference to the color that was seen.
        let (red_green, blue_green) = (&*red - &*green, &*blue - &*green);
        for (site, v) in green.indexed_iter_mut() {
            match color_at(site) {
                Color::Red => *v = red[site] - smooth(&red_green, site),
                Color::Blue => *v = blue[site] - smooth(&blue_green, site),
                Color::Green => {}
            }
        }
        // Red and blue at the green sites, from the differences to the new green.
        for (color, plane) in [(Color::Red, &mut *red), (Color::Blue, &mut *blue)] {
            let difference = &*plane - &*green;
            for (site, v) in plane.indexed_iter_mut() {
                if color_at(site) == Color::Green {
                    let in_row = self.cfa.color_at(site.0, site.1 + 1) == color;
                    let direction = if in_row { Direction::Row } else { Direction::Column };
                    *v = green[site] + neighbours(&difference.view(), direction, site.0, site.1);
                }
            }
        }
        // Red at blue and blue at red, from their smoothed difference.
        let red_blue = &*red - &*blue;
        for (site, v) in red.indexed_iter_mut() {
            if color_at(site) == Color::Blue {
                *v = blue[site] + smooth(&red_blue, site);
            }
        }
        for (site, v) in blue.indexed_iter_mut() {
            if color_at(site) == Color::Red {
                *v = red[site] - smooth(&red_blue, site);
            }
        }
    }
}

/// The value `k` sites on from `(r, c)` in a direction, mirrored at the border.
fn along(plane: &ArrayView2<'_, f32>, direction: Direction, r: usize, c: usize, k: isize) -> f32 {
    let (height, width) = plane.dim();
    match direction {
        Direction::Row => plane[[r, mirror(c as isize + k, width)]],
        Direction::Column => plane[[mirror(r as isize + k, height), c]],
    }
}

/// The mean of the two neighbours in a direction.
fn neighbours(plane: &ArrayView2<'_, f32>, direction: Direction, r: usize, c: usize) -> f32 {
    0.5 * (along(plane, direction, r, c, -1) + along(plane, direction, r, c, 1))
}
