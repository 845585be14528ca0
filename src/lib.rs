//! isolume pre-computes global illumination for **every** isosurface of a scalar volume at once, by flattened
//! light transport on the volume's graph in R⁴ (Banks & Beason 2009).
//!
//! Modules stand in pipeline order: a file uses only what stands above it here. Formulas carry the tag of their
//! source on the line that implements them: `[BB09 Eq. 2]` is Banks & Beason, "Decoupling Illumination from
//! Isosurface Generation Using 4D Light Transport", IEEE TVCG 15(6), 2009; the other tags are listed in
//! `docs/references.md`.

pub mod error;
mod files;
pub mod volume;
