//! admm
