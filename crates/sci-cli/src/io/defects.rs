//! Owns the search for sensor pixels that are not to be trusted: not finite, dead or hot.

use std::fmt;

use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis, s};

/// What to do about defective pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Defects {
    /// A NaN is an error; dead and hot pixels are named and used.
    #[default]
    Keep,
    /// They are named and count as not measured.
    Exclude,
}

/// What is wrong with a pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// NaN or infinite in some measurement.
    NotFinite,
    /// Far darker than its neighbourhood in every measurement.
    Dead,
    /// Far brighter than its neighbourhood in every measurement.
    Hot,
}

/// A defective pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Defect {
    /// What is wrong.
    pub kind: Kind,
    /// Row and column.
    pub at: (usize, usize),
}

/// Of so many neighbours, three may be defective too.
const RANK: usize = 3;
/// A dead pixel has at most this part of its neighbours' light, and they have at least [`DARK`].
const DEAD: f32 = 0.1;
/// In units of white, the light that is too little to tell.
const DARK: f32 = 0.05;
/// A hot pixel has more than this many times its neighbours' light, and [`BRIGHT`] more.
const HOT: f32 = 1.5;
/// In units of white.
const BRIGHT: f32 = 0.15;
/// A single measurement may show a highlight that passes; only light that no scene has counts as hot there.
const IMPOSSIBLE: f32 = 1.2;

/// Finds the defective pixels of the sensor behind `measurements` `[N, H, W]`, in units in which white measures `open` `[H, W]`,
/// the sum of the masks. `lattice` is the distance of pixels of one color: 2 on a Bayer sensor, else 1.
///
/// What a pixel measures is divided by `open` and compared with the pixels of its color at distances 1 and 2 of the lattice, of which
/// the three most extreme are left out. A scene can do the same to a pixel once, hardly in every measurement.
///
/// Masks may sit up to `off` pixels from where they are told to: a pixel is hot if it is so with the most open mask within that. (Of masks
/// told half a pixel off, `off = 0` makes 639 good pixels of 25,600 hot.)
pub fn find(open: ArrayView2<'_, f32>, measurements: ArrayView3<'_, f32>, lattice: usize, off: usize) -> Vec<Defect> {
    let most = most_within(open, off);
    let mut found = Vec::new();
    for ((row, column), &sum) in open.indexed_iter() {
        let at = (row, column);
        let values = || measurements.axis_iter(Axis(0)).map(move |y| y[at]);
        if values().any(|v| !v.is_finite()) {
            found.push(Defect { kind: Kind::NotFinite, at });
            continue;
        }
        if sum <= 0.0 || measurements.is_empty() {
            continue;
        }
        let compared = measurements.axis_iter(Axis(0)).map(|y| compare((open, most.view()), y, at, lattice));
        let verdicts: Vec<Option<Kind>> = compared.collect();
        let Some(kind) = verdicts[0] else { continue };
        let certain = verdicts.len() > 1 || kind == Kind::Dead || values().all(|v| v > IMPOSSIBLE * most[at]);
        if certain && verdicts.iter().all(|&v| v == Some(kind)) {
            found.push(Defect { kind, at });
        }
    }
    found
}

/// The most that masks are open within so many pixels.
fn most_within(open: ArrayView2<'_, f32>, off: usize) -> Array2<f32> {
    let (height, width) = open.dim();
    let around = |at: usize, end: usize| at.saturating_sub(off)..(at + off + 1).min(end);
    Array2::from_shape_fn(open.dim(), |(i, j)| {
        open.slice(s![around(i, height), around(j, width)]).iter().fold(0f32, |most, &open| most.max(open))
    })
}

/// What one measurement says about a pixel, by how far masks are open there, as told and at most.
fn compare(
    (open, most): (ArrayView2<'_, f32>, ArrayView2<'_, f32>),
    y: ArrayView2<'_, f32>,
    (row, column): (usize, usize),
    lattice: usize,
) -> Option<Kind> {
    let steps = -2isize..=2;
    let near = |at: usize, step: isize, end: usize| at.checked_add_signed(step * lattice as isize).filter(|&i| i < end);
    let (height, width) = y.dim();
    let mut light = Vec::with_capacity(24);
    for (i, j) in steps.clone().flat_map(|i| steps.clone().map(move |j| (i, j))).filter(|&s| s != (0, 0)) {
        let (Some(i), Some(j)) = (near(row, i, height), near(column, j, width)) else { continue };
        if open[[i, j]] > 0.0 && y[[i, j]].is_finite() {
            light.push(y[[i, j]] / open[[i, j]]);
        }
    }
    if light.len() <= 2 * RANK {
        return None;
    }
    light.sort_by(f32::total_cmp);
    let (low, high) = (light[RANK], light[light.len() - 1 - RANK]);
    let own = y[[row, column]];
    match () {
        () if low >= DARK && own <= DEAD * low * open[[row, column]] => Some(Kind::Dead),
        () if own / most[[row, column]] > HOT * high.max(0.0) + BRIGHT => Some(Kind::Hot),
        () => None,
    }
}

/// A pixel that is left out, and how far the masks `[B]` were open there.
#[derive(Clone, Debug, PartialEq)]
pub struct LeftOut {
    /// Where it is, and why.
    pub defect: Defect,
    /// What a neighbour gets of these where masks turn out to sit elsewhere.
    pub masks: Vec<f32>,
}

/// Takes the pixels out of the masks `[B, H, W]` and sets their measurements `[N, H, W]` to 0.
pub fn exclude(defects: &[Defect], masks: &mut Array3<f32>, measurements: &mut Array3<f32>) -> Vec<LeftOut> {
    let leave_out = |&defect: &Defect| {
        let at = defect.at;
        measurements.slice_mut(s![.., at.0, at.1]).fill(0.0);
        let mut open = masks.slice_mut(s![.., at.0, at.1]);
        let masks = open.to_vec();
        open.fill(0.0);
        LeftOut { defect, masks }
    };
    defects.iter().map(leave_out).collect()
}

/// A sentence on defects, and on what is done about them; nothing where there are none.
pub fn note(defects: &[Defect], wish: Defects) -> Option<String> {
    named(defects).map(|named| match wish {
        Defects::Exclude => format!("{LEFT_OUT}{named}"),
        Defects::Keep => format!("{DEFECTIVE}{named}; data.defects = \"exclude\" leaves them out"),
    })
}

const LEFT_OUT: &str = "pixels left out as not measured: ";
const DEFECTIVE: &str = "pixels look defective: ";

/// Whether a sentence is one of [`note`].
pub fn is_note(sentence: &str) -> bool {
    sentence.starts_with(LEFT_OUT) || sentence.starts_with(DEFECTIVE)
}

/// Names them: how many of each kind, and where the first are. `None` if there are none.
fn named(defects: &[Defect]) -> Option<String> {
    let kinds = [Kind::NotFinite, Kind::Dead, Kind::Hot].into_iter().filter_map(|kind| {
        let at: Vec<String> =
            defects.iter().filter(|d| d.kind == kind).map(|d| format!("({}, {})", d.at.0, d.at.1)).collect();
        let more = if at.len() > 5 { ", …" } else { "" };
        let first = at.iter().take(5).cloned().collect::<Vec<_>>().join(", ");
        (!at.is_empty()).then(|| format!("{} {kind} at (row, column) {first}{more}", at.len()))
    });
    let text = kinds.collect::<Vec<_>>().join("; ");
    (!text.is_empty()).then_some(text)
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::NotFinite => "not finite",
            Self::Dead => "dead",
            Self::Hot => "hot",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sci_forward::{MaskMismatch, MaskStack, VideoShape};

    /// Two measurements of a ramp.
    fn ramp(height: usize, width: usize) -> (Array2<f32>, Array3<f32>) {
        let open = Array2::from_shape_fn((height, width), |(i, j)| 2.0 + ((i * 7 + j * 3) % 5) as f32);
        let y = Array3::from_shape_fn((2, height, width), |(_, i, j)| {
            open[[i, j]] * (0.2 + 0.6 * (i + j) as f32 / (height + width) as f32)
        });
        (open, y)
    }

    #[test]
    fn each_kind_is_found_where_it_is_and_nowhere_else() {
        for lattice in [1, 2] {
            let (open, mut y) = ramp(20, 24);
            assert_eq!(find(open.view(), y.view(), lattice, 0), []);
            y.slice_mut(s![.., 0, 5]).fill(0.0);
            y.slice_mut(s![.., 9, 9]).fill(20.0);
            y[[1, 19, 23]] = f32::NAN;
            let expected = [(Kind::Dead, (0, 5)), (Kind::Hot, (9, 9)), (Kind::NotFinite, (19, 23))];
            assert_eq!(find(open.view(), y.view(), lattice, 0), expected.map(|(kind, at)| Defect { kind, at }));
        }
    }

    #[test]
    fn a_highlight_in_one_of_two_measurements_is_no_defect() {
        let (open, mut y) = ramp(20, 24);
        y[[1, 9, 9]] = 20.0;
        assert_eq!(find(open.view(), y.view(), 1, 0), []);
    }

    /// Masks told half a pixel off make no defect; what is dead or hot all the same is found.
    #[test]
    fn pixels_are_not_defective_where_masks_sit_elsewhere() {
        let shape = VideoShape { frames: 8, height: 40, width: 40 };
        let told = MaskStack::random(shape, 0.5, 3).unwrap();
        let real = MaskMismatch { shift: [0.5, 0.3], ..MaskMismatch::default() }.apply(&told).unwrap();
        let mut y = real.view().sum_axis(Axis(0)).insert_axis(Axis(0)) * 0.6;
        let open = told.view().sum_axis(Axis(0));
        assert_eq!(find(open.view(), y.view(), 1, 1), []);
        (y[[0, 5, 7]], y[[0, 20, 11]]) = (0.0, 9.5);
        let expected = [(Kind::Dead, (5, 7)), (Kind::Hot, (20, 11))];
        assert_eq!(find(open.view(), y.view(), 1, 1), expected.map(|(kind, at)| Defect { kind, at }));
    }

    #[test]
    fn they_are_counted_and_the_first_five_placed() {
        let defects: Vec<Defect> = (0..7).map(|i| Defect { kind: Kind::Hot, at: (i, 2 * i) }).collect();
        let text = named(&defects).unwrap();
        assert_eq!(text, "7 hot at (row, column) (0, 0), (1, 2), (2, 4), (3, 6), (4, 8), …");
        assert_eq!(named(&[]), None);
    }
}
