//! isolume pre-computes global illumination for **every** isosurface of a scalar volume at once, by flattened
//! light transport on the volume's graph in R⁴ (Banks & Beason 2009).
//!
//! Modules stand in pipeline order: a file uses only what stands above it here. Formulas carry the tag of their
//! source on the line that implements them: `[BB09 Eq. 2]` is Banks & Beason, "Decoupling Illumination from
//! Isosurface Generation Using 4D Light Transport", IEEE TVCG 15(6), 2009; the other tags are listed in
//! `docs/references.md`.

// Numerics, no knowledge of volumes; progress of long work.
pub mod error;
pub mod digits;
pub mod isa;
pub mod atomic;
mod files;
pub mod rng;
pub mod stats;
pub mod warp;
pub mod cubic;
pub mod nearest;
pub mod node_set;
mod neighbourhood;
mod sharpening;
pub mod linear_fit;
pub mod progress;
pub mod checkpoint;
// Samples, value, gradient, range.
pub mod volume;
pub mod series;
pub mod field;
pub mod mask;
pub mod isovalue_axis;
// Rays of R⁴; one hexahedron; the min/max hierarchy and its walk; triangle meshes of L(h, c).
pub mod flattened;
pub mod cell;
pub mod pyramid;
pub mod isosurface;
// What a hyperplane contains.
pub mod brdf;
pub mod reflectance;
pub mod emission;
pub mod polygon;
pub mod luminaire;
pub mod scene;
pub mod flat;
// The one seam: nearest hit and visibility.
pub mod tracer;
#[allow(unsafe_code, reason = "FFI to Embree, here only")]
pub mod embree;
// Light transport, generic over the tracer.
pub mod direct;
pub mod landing;
pub mod photon;
pub mod photon_map;
pub mod radiance_cache;
pub mod gather;
// Where, how much, onto the lattice.
pub mod sampling;
pub mod radiance;
pub mod split;
pub mod illumination_grid;
pub mod irradiance_caching;
pub mod fitted_grid;
pub mod smoothing;
pub mod sweep;
pub mod bake;
pub mod scene_file;
// Products.
pub mod export;
pub mod surface_mesh;
pub mod final_gather;
pub mod render;
pub mod view;
// One isosurface at a time in 3D, and how far a bake is from it.
pub mod reference;
pub mod accuracy;
pub mod plot;
pub mod study;
pub mod flatland;
// Hard cases, counted.
pub mod selftest;
// Verbs.
pub mod cli;
