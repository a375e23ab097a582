//! sci-forward
