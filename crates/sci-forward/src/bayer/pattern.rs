//! The four Bayer patterns.

/// A color of the sensor; as a number, its channel of an RGB video.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Color {
    /// Channel 0.
    Red = 0,
    /// Channel 1.
    Green = 1,
    /// Channel 2.
    Blue = 2,
}

/// The color filter array of the sensor, named by its top-left 2×2 block in reading order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum CfaPattern {
    /// Red top left, blue bottom right.
    #[default]
    Rggb,
    /// Blue top left, red bottom right.
    Bggr,
    /// Red top right, blue bottom left.
    Grbg,
    /// Red bottom left, blue top right.
    Gbrg,
}

impl CfaPattern {
    /// All four.
    pub const ALL: [Self; 4] = [Self::Rggb, Self::Bggr, Self::Grbg, Self::Gbrg];

    /// Row and column, each 0 or 1, of the red site of the 2×2 block. Blue is at the opposite corner.
    ///
    /// ```
    /// use sci_forward::CfaPattern;
    /// assert_eq!(CfaPattern::Grbg.red_site(), (0, 1));
    /// ```
    pub fn red_site(self) -> (usize, usize) {
        match self {
            Self::Rggb => (0, 0),
            Self::Bggr => (1, 1),
            Self::Grbg => (0, 1),
            Self::Gbrg => (1, 0),
        }
    }

    /// The color seen by the pixel at `(row, column)`.
    ///
    /// ```
    /// use sci_forward::{CfaPattern, bayer::Color::{Blue, Green, Red}};
    /// let colors = [(0, 0), (0, 1), (1, 0), (3, 1)].map(|(r, c)| CfaPattern::Rggb.color_at(r, c));
    /// assert_eq!(colors, [Red, Green, Green, Blue]);
    /// ```
    pub fn color_at(self, row: usize, column: usize) -> Color {
        let (red_row, red_column) = self.red_site();
        match ((row ^ red_row) & 1, (column ^ red_column) & 1) {
            (0, 0) => Color::Red,
            (1, 1) => Color::Blue,
            _ => Color::Green,
        }
    }
}

impl std::fmt::Display for CfaPattern {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Rggb => "RGGB",
            Self::Bggr => "BGGR",
            Self::Grbg => "GRBG",
            Self::Gbrg => "GBRG",
        })
    }
}
