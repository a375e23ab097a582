//! nets

pub mod kernels;
