//! The one table of networks: what weights can be of, and what can be trained. A new one is a variant here, and a line in each function.

use crate::fastdvdnet::check_widths;
use crate::{
    Ddnet, DdnetSpec, Ends, Fastdvdnet, FastdvdnetSpec, Ffdnet, FfdnetSpec, Network, Result, Shiftnet, ShiftnetSpec,
    WeightFile,
};

/// A network and its size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Architecture {
    /// FFDNet, gray or color.
    Ffdnet(FfdnetSpec),
    /// FastDVDnet, gray or color.
    Fastdvdnet(FastdvdnetSpec),
    /// DDNet.
    Ddnet(DdnetSpec),
    /// ShiftNet, gray or color.
    Shiftnet(ShiftnetSpec),
}

impl Architecture {
    /// Told by the names and shapes of tensors.
    pub(crate) fn recognise(file: &WeightFile) -> Option<Self> {
        ShiftnetSpec::recognise(file)
            .map(Self::Shiftnet)
            .or_else(|| FastdvdnetSpec::recognise(file).map(Self::Fastdvdnet))
            .or_else(|| DdnetSpec::recognise(file).map(Self::Ddnet))
            .or_else(|| FfdnetSpec::recognise(file).map(Self::Ffdnet))
    }

    /// The network with the weights of a file, whichever it is; `ends` are those of a network that looks at neighbouring frames.
    ///
    /// # Errors
    /// When the file is of no known network, or its tensors do not fit together.
    pub fn load(file: WeightFile, ends: Ends) -> Result<Box<dyn Network>> {
        Ok(match file.architecture()? {
            Self::Ffdnet(_) => Box::new(Ffdnet::from_weights(file)?),
            Self::Fastdvdnet(_) => Box::new(Fastdvdnet::from_weights(file, ends)?),
            Self::Ddnet(_) => Box::new(Ddnet::from_weights(file, ends)?),
            Self::Shiftnet(_) => Box::new(Shiftnet::from_weights(file)?),
        })
    }

    /// The network with random weights, the same for the same seed.
    ///
    /// # Errors
    /// [`Error::Setting`](crate::Error::Setting) for a size out of range.
    pub fn random(self, ends: Ends, seed: u64) -> Result<Box<dyn Network>> {
        Ok(match self {
            Self::Ffdnet(spec) => Box::new(Ffdnet::random(spec, seed)?),
            Self::Fastdvdnet(spec) => Box::new(Fastdvdnet::random(spec, ends, seed)?),
            Self::Ddnet(spec) => Box::new(Ddnet::random(spec, ends, seed)?),
            Self::Shiftnet(spec) => Box::new(Shiftnet::random(spec, seed)?),
        })
    }

    /// Checks the size.
    pub(crate) fn validate(self) -> Result<()> {
        match self {
            Self::Ffdnet(spec) => spec.validate().map(drop),
            Self::Fastdvdnet(spec) => spec.block().map(drop),
            Self::Ddnet(spec) => check_widths(spec.widths),
            Self::Shiftnet(spec) => spec.validate().map(drop),
        }
    }
}

impl std::fmt::Display for Architecture {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Ffdnet(spec) => spec.fmt(f),
            Self::Fastdvdnet(spec) => spec.fmt(f),
            Self::Ddnet(spec) => spec.fmt(f),
            Self::Shiftnet(spec) => spec.fmt(f),
        }
    }
}
