//! Weights that ship inside the crate: one line here for each file in `crates/nets/weights/`, beside which a card says how it
//! was made.

use crate::{Error, Result};

macro_rules! bundled {
    ($($name:literal),*) => { &[$(($name, include_bytes!(concat!("../../weights/", $name, ".safetensors")))),*] };
}

const BUNDLED: &[(&str, &[u8])] = bundled![
    "ffdnet_gray",
    "ffdnet_color",
    "fastdvdnet_gray",
    "fastdvdnet_gray_sci",
    "fastdvdnet_gray_real_sci",
    "ddnet",
    "fastdvdnet_color",
    "fastdvdnet_color_sci",
    "shiftnet_gray_sci",
    "shiftnet_color_sci"
];

/// The names that `bundled:NAME` knows.
pub fn bundled_names() -> Vec<&'static str> {
    BUNDLED.iter().map(|(name, _)| *name).collect()
}

/// The same with the bytes that each takes in the program.
pub fn bundled_sizes() -> Vec<(&'static str, usize)> {
    BUNDLED.iter().map(|(name, bytes)| (*name, bytes.len())).collect()
}

/// Whether a path is that of bundled weights for the iterates of a solver, whose names end in `_sci`. They are no denoisers of
/// white noise, and know the σ of their schedule only.
pub fn bundled_for_iterates(path: &str) -> bool {
    path.strip_prefix("bundled:").is_some_and(|name| name.ends_with("_sci"))
}

pub(super) fn bytes(name: &str) -> Result<&'static [u8]> {
    BUNDLED
        .iter()
        .find(|(known, _)| *known == name)
        .map(|(_, bytes)| *bytes)
        .ok_or_else(|| Error::UnknownBundled { name: name.to_owned(), known: bundled_names() })
}
