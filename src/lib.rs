//! isolume pre-computes global illumination for **every** isosurface of a scalar volume at once, by flattened
//! light transport on the volume's graph in R⁴ (Banks & Beason 2009).
//!
//! ```
//! use isolume::bake::{BakeOptions, BakeSettings, Preset, bake};
//! use isolume::embree::Device;
//! use isolume::export::bake_file::BakedVolume;
//! use isolume::field::{Field, Sweep};
//! use isolume::flattened::Side;
//! use isolume::glam::DVec3;
//! use isolume::progress::Progress;
//! use isolume::scene::{Boundary, Scene, Surface, cornell_box};
//! use isolume::volume::{Lattice, Samples, Volume};
//!
//! // Distances from the middle of a cube, and the spheres between 0.2 and 0.4 of them.
//! let lattice = Lattice::aligned([17; 3], DVec3::ZERO, DVec3::splat(1.0 / 16.0))?;
//! let at = |i: usize| lattice.to_world(lattice.point(i));
//! let samples = (0..lattice.len()).map(|i| at(i).distance(DVec3::splat(0.5)) as f32).collect();
//! let volume = Volume::new("distance", lattice.clone(), Samples::F32(samples))?;
//! let field = Field::new(&volume, Sweep::new(0.2, 0.4)?)?;
//!
//! // Around them walls and a luminaire, a tenth of the volume away; the spheres' outside is where values are higher.
//! let walls = cornell_box(field.lattice(), 0.1)?;
//! let surface = Surface { outside: Side::Higher, ..Surface::default() };
//! let scene = Scene::new(field, surface, Boundary::Open, walls)?;
//!
//! let options = BakeOptions { preset: Some(Preset::Preview), ..BakeOptions::default() };
//! let settings = BakeSettings::new(&options, &scene)?;
//! let bake = bake(&scene, &settings, &Device::new(0)?, Progress::Quiet)?;
//! let baked = BakedVolume::new(scene, bake);
//!
//! // The light of the sphere through a point above the middle, and through one below it.
//! let [above, below] = [0.8, 0.2].map(|z| baked.radiance_at(Side::Higher, DVec3::new(0.5, 0.5, z)).unwrap());
//! assert!(above.min_element() > below.max_element() && below.min_element() > 0.0);
//! # Ok::<(), isolume::error::Error>(())
//! ```
//!
//! A program of another package finds Embree at run time if its `build.rs` says where that is:
//!
//! ```no_run
//! println!("cargo:rustc-link-arg=-Wl,-rpath,{}", std::env::var("DEP_ISOLUME_EMBREE").unwrap());
//! ```
//!
//! Positions are in the world (the volume's own unit of length) or, where a function says *local*, in units of voxels;
//! isovalues are in the volume's units where a [`field::Sweep`] converts them (`f64`), and in units of the sweep, [0,
//! 1], in rays, meshes and references (`f32`). Bakes and pictures take a [`progress::Progress`], whose observer may end
//! them; sweeps and references a function that may.
//!
//! Modules stand in pipeline order: a file uses only what stands above it here. Formulas carry the tag of their
//! source on the line that implements them: `[BB09 Eq. 2]` is Banks & Beason, "Decoupling Illumination from
//! Isosurface Generation Using 4D Light Transport", IEEE TVCG 15(6), 2009; the other tags are listed in
//! `docs/references.md`.

/// Vectors and matrices, in most signatures.
pub use glam;

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
