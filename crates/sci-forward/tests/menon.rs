//! [`Menon`] against a slow transcription of the method, site by site.

use ndarray::{Array2, Array3, Array4, Axis};
use sci_forward::bayer::Color::{Blue, Green, Red};
use sci_forward::bayer::{CfaPattern, Demosaicer, Menon, mirror};
use sci_forward::testing::uniform;

/// A way to go: rows and columns of one step.
type Direction = (isize, isize);
const ALONG_ROW: Direction = (0, 1);
const ALONG_COLUMN: Direction = (1, 0);

/// The value `k` steps from a site, mirrored at the border.
fn at(plane: &Array2<f32>, (r, c): (usize, usize), (down, right): Direction, k: isize) -> f32 {
    let (height, width) = plane.dim();
    plane[[mirror(r as isize + k * down, height), mirror(c as isize + k * right, width)]]
}

fn mean_of_2(plane: &Array2<f32>, site: (usize, usize), direction: Direction) -> f32 {
    0.5 * (at(plane, site, direction, -1) + at(plane, site, direction, 1))
}

fn mean_of_3(plane: &Array2<f32>, site: (usize, usize), direction: Direction) -> f32 {
    (at(plane, site, direction, -1) + at(plane, site, direction, 0) + at(plane, site, direction, 1)) / 3.0
}

/// Green, and the direction in which each site is interpolated.
fn green_and_direction(cfa: CfaPattern, samples: &Array2<f32>) -> (Array2<f32>, Array2<Direction>) {
    let size = samples.dim();
    let interpolated = [ALONG_ROW, ALONG_COLUMN].map(|direction| {
        Array2::from_shape_fn(size, |site| {
            let at = |k| at(samples, site, direction, k);
            let filtered = 0.5 * (at(-1) + at(0) + at(1)) - 0.25 * (at(-2) + at(2));
            if cfa.color_at(site.0, site.1) == Green { samples[site] } else { filtered }
        })
    });
    // How much the color difference changes over two sites, summed around a site; nothing changes outside the image.
    let activity = [ALONG_ROW, ALONG_COLUMN].map(|direction| {
        let difference = samples - &interpolated[usize::from(direction == ALONG_COLUMN)];
        let change = Array2::from_shape_fn(size, |site| (difference[site] - at(&difference, site, direction, 2)).abs());
        Array2::from_shape_fn(size, |(r, c)| {
            // (across, along, weight); a change belongs to the site before it, hence the taps behind.
            let taps: [(isize, isize, f32); 8] = [
                (-2, 0, 1.0),
                (-2, -2, 1.0),
                (-1, -1, 1.0),
                (0, 0, 3.0),
                (0, -2, 3.0),
                (1, -1, 1.0),
                (2, 0, 1.0),
                (2, -2, 1.0),
            ];
            taps.iter().fold(0.0, |sum, &(across, along, weight)| {
                let (down, right) = if direction == ALONG_ROW { (across, along) } else { (along, across) };
                let site = (r.wrapping_add_signed(down), c.wrapping_add_signed(right));
                sum + weight * change.get(site).copied().unwrap_or(0.0)
            })
        })
    });
    let direction =
        Array2::from_shape_fn(
            size,
            |site| {
                if activity[1][site] >= activity[0][site] { ALONG_ROW } else { ALONG_COLUMN }
            },
        );
    let green = Array2::from_shape_fn(size, |site| interpolated[usize::from(direction[site] == ALONG_COLUMN)][site]);
    (green, direction)
}

/// The RGB frame `[3, H, W]` of a mosaic `[H, W]`.
fn menon(cfa: CfaPattern, samples: &Array2<f32>) -> Array3<f32> {
    let size = samples.dim();
    let color = |site: (usize, usize)| cfa.color_at(site.0, site.1);
    let (green, direction) = green_and_direction(cfa, samples);
    // Where a green site has neighbours of a color.
    let towards = |wanted, (r, c)| if cfa.color_at(r, c + 1) == wanted { ALONG_ROW } else { ALONG_COLUMN };

    // Red and blue at the green sites, then red at blue and blue at red.
    let at_green = [Red, Blue].map(|wanted| {
        Array2::from_shape_fn(size, |site| match color(site) == Green {
            true => {
                let direction = towards(wanted, site);
                green[site] + mean_of_2(samples, site, direction) - mean_of_2(&green, site, direction)
            }
            false => samples[site],
        })
    });
    let opposite = |wanted, [this, other]: [&Array2<f32>; 2]| {
        Array2::from_shape_fn(size, |site| match color(site) {
            seen if seen == wanted || seen == Green => this[site],
            _ => other[site] + mean_of_2(this, site, direction[site]) - mean_of_2(other, site, direction[site]),
        })
    };
    let red = opposite(Red, [&at_green[0], &at_green[1]]);
    let blue = opposite(Blue, [&at_green[1], &at_green[0]]);

    // The refinement: green at the colored sites, the others at the green ones, then red at blue and blue at red.
    let (red_green, blue_green) = (&red - &green, &blue - &green);
    let green = Array2::from_shape_fn(size, |site| match color(site) {
        Red => red[site] - mean_of_3(&red_green, site, direction[site]),
        Blue => blue[site] - mean_of_3(&blue_green, site, direction[site]),
        Green => green[site],
    });
    let [red, blue] = [(Red, red), (Blue, blue)].map(|(wanted, plane)| {
        let difference = &plane - &green;
        Array2::from_shape_fn(size, |site| match color(site) == Green {
            true => green[site] + mean_of_2(&difference, site, towards(wanted, site)),
            false => plane[site],
        })
    });
    let red_blue = &red - &blue;
    let final_red = Array2::from_shape_fn(size, |site| match color(site) {
        Blue => blue[site] + mean_of_3(&red_blue, site, direction[site]),
        _ => red[site],
    });
    let final_blue = Array2::from_shape_fn(size, |site| match color(site) {
        Red => red[site] - mean_of_3(&red_blue, site, direction[site]),
        _ => blue[site],
    });
    ndarray::stack(Axis(0), &[final_red.view(), green.view(), final_blue.view()]).unwrap()
}

/// Every operation is the same and in the same order: so is every bit.
#[test]
fn bands_of_rows_give_the_bits_of_the_definition() {
    // Around the height of a band and of what it reads above and below, and down to the smallest mosaic.
    let sizes = [(2, 2), (2, 5), (3, 2), (5, 3), (8, 9), (63, 17), (64, 16), (65, 34), (70, 21), (137, 40)];
    for (height, width) in sizes {
        for cfa in CfaPattern::ALL {
            let mut mosaic = uniform((2, height, width), (height + width) as u64);
            // The second frame has edges to decide between.
            mosaic.index_axis_mut(Axis(0), 1).indexed_iter_mut().for_each(|((r, c), v)| {
                *v = 0.02 * *v + if (r / 7 + c / 5) % 2 == 0 { 0.2 } else { 0.7 };
            });
            let mut rgb = Array4::from_elem((2, 3, height, width), f32::NAN);
            Menon.demosaic(cfa, mosaic.view(), rgb.view_mut()).unwrap();
            for (frame, rgb) in mosaic.outer_iter().zip(rgb.outer_iter()) {
                let expected = menon(cfa, &frame.to_owned());
                assert!(rgb == expected, "{cfa} {height}×{width}");
            }
        }
    }
}
