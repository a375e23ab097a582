//! sci
fn main() {}
