//! Finds Embree and generates the ray/hit bindings.
fn main() {}
