//! The reference: one isosurface at a time, illuminated in ordinary 3D, with the variance of every number.
//!
//! Two integrators share the receivers (the vertices of the mesh, which lie on the trilinear level set, with the shared
//! normal) and nothing of the bake's estimators: an unbiased path tracer, and a photon map on the mesh with final
//! gather. Both run in independent batches; what is reported is the batches' mean and the variance of that mean.

mod origin;
mod path;
mod surface_map;

pub use origin::{Origin, light};
pub use path::{PathTracer, path_picture};
pub use surface_map::{SurfaceMap, SurfaceMapSettings};

use crate::direct::Receiver;
use crate::error::{Error, Result};
use crate::export::{Mesh, ply};
use crate::isosurface;
use crate::isovalue_axis::IsovalueAxis;
use crate::photon::{PhotonSettings, check_power, trace_photons};
use crate::progress::Tick;
use crate::rng::{Rng, Stage};
use crate::scene::Scene;
use crate::surface_mesh::{SurfaceMesh, channel};
use crate::tracer::Tracer;
use crate::volume::Space;
use glam::DVec3;
use rayon::prelude::*;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

/// Counts changes of what references hold: those that a study keeps are made anew by another version.
pub const VERSION: u32 = 2;

/// How outgoing radiance is found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Integrator {
    /// Path tracing with next-event estimation: unbiased.
    #[default]
    Path,
    /// A photon map on the mesh and final gather, as BB09's reference; not for isosurfaces that emit light.
    Photon,
}

impl Integrator {
    /// Whether it can light `scene`.
    ///
    /// # Errors
    /// `NotSupported` for photons of isosurfaces that emit light, which leave from all of the sweep.
    pub fn check(self, scene: &Scene) -> Result<()> {
        let emits = || scene.members().iter().any(|m| m.surface.emission != DVec3::ZERO);
        if self == Self::Photon && emits() {
            return Err(Error::NotSupported(
                "--integrator photon: isosurfaces that emit light are for --integrator path".into(),
            ));
        }
        Ok(())
    }
}

/// How much work a reference is worth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ReferenceSettings {
    /// How.
    pub integrator: Integrator,
    /// Paths, or gather rays, per vertex; rounded up to a multiple of `batches`.
    pub samples: u32,
    /// Independent batches that tell the variance, at least 2.
    pub batches: u32,
    /// Photons over all batches ([`Integrator::Photon`]).
    pub photons: u64,
    /// How irradiance is estimated from photons.
    pub map: SurfaceMapSettings,
    /// A fixed random subset of this many vertices instead of all.
    pub vertices: Option<usize>,
    /// Seed of the estimates. The subset does not depend on it: references of different seeds share their vertices.
    pub seed: u64,
}

impl ReferenceSettings {
    /// Samples per vertex that are taken: as many in each batch.
    pub fn taken(&self) -> u32 {
        let batches = self.batches.max(2);
        self.samples.div_ceil(batches).saturating_mul(batches)
    }
}

impl Default for ReferenceSettings {
    fn default() -> Self {
        Self {
            integrator: Integrator::Path,
            samples: 1024,
            batches: 16,
            photons: 1 << 24,
            map: SurfaceMapSettings::default(),
            vertices: None,
            seed: 1,
        }
    }
}

/// Outgoing radiance at vertices.
#[derive(Clone, Debug, Default)]
pub struct Reference {
    /// Mean per vertex and channel; 0 where not sampled.
    pub radiance: Vec<DVec3>,
    /// Variance of that mean.
    pub variance: Vec<DVec3>,
    /// Whether the vertex was sampled: it is in the subset and has a normal.
    pub sampled: Vec<bool>,
    /// Rays traced.
    pub rays: u64,
}

impl Reference {
    /// Writes the reference of `mesh`, in a world whose axes mean what `space` says, as PLY: `radiance_r/g/b`,
    /// `variance_r/g/b` and `sampled` per vertex; `comment` as [`Origin::comment`].
    ///
    /// # Errors
    /// As [`ply::write`].
    pub fn write(&self, path: &Path, mesh: &SurfaceMesh, space: Option<Space>, comment: String) -> Result<()> {
        let radiance = [0, 1, 2].map(|c| channel(&self.radiance, c));
        let variance = [0, 1, 2].map(|c| channel(&self.variance, c));
        let sampled: Vec<f32> = self.sampled.iter().map(|&s| if s { 1.0 } else { 0.0 }).collect();
        let names = [&ply::RADIANCE[..], &ply::VARIANCE, &[ply::SAMPLED]].concat();
        let values = radiance.iter().chain(&variance).chain([&sampled]).map(Vec::as_slice);
        let properties: Vec<(&str, &[f32])> = names.into_iter().zip(values).collect();
        ply::write_with_comments(path, &Mesh { space, ..mesh.export(&properties) }, &[comment])
    }
}

/// A fixed random subset of `count` of `total` vertices (Fisher–Yates), in increasing order; all if `None`.
pub fn subset(total: usize, count: Option<usize>) -> Vec<usize> {
    let count = count.unwrap_or(total).min(total);
    let mut all: Vec<usize> = (0..total).collect();
    if count < total {
        let mut rng = Rng::stream(0, Stage::Path, u64::MAX);
        for i in 0..count {
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "below total")]
            let j = i + (rng.unit() * (total - i) as f64) as usize;
            all.swap(i, j.min(total - 1));
        }
        all.truncate(count);
        all.sort_unstable();
    }
    all
}

/// The scene seen from each companion, with its isosurface, which may be empty.
fn companion_meshes(scene: &Scene, isovalue: f32) -> Result<Vec<(Scene, SurfaceMesh)>> {
    let seen = scene.companions().iter().map(|c| scene.seen_from(c.number));
    seen.map(|s| {
        let mesh = isosurface::extract(s.lattice().dims(), s.field.samples(), isovalue)?;
        let mesh = if mesh.triangles.is_empty() { SurfaceMesh::default() } else { SurfaceMesh::new(&s, mesh)? };
        Ok((s, mesh))
    })
    .collect()
}

/// Outgoing radiance of the outside at the vertices of `mesh`, the isosurface at `isovalue` (units of the sweep).
/// `tick(n)` reports n of batches × vertices done; returning false ends it.
///
/// # Errors
/// `Interrupted` if `tick` ends it; as [`Integrator::check`] and, of photons, [`check_power`]; from the extraction of
/// companions' isosurfaces.
#[allow(clippy::cast_possible_truncation, reason = "batches are few")]
pub fn reference<T: Tracer>(
    scene: &Scene,
    tracer: &T,
    mesh: &SurfaceMesh,
    isovalue: f32,
    settings: &ReferenceSettings,
    tick: Tick,
) -> Result<Reference> {
    settings.integrator.check(scene)?;
    if settings.integrator == Integrator::Photon {
        check_power(scene, settings.photons)?;
    }
    let side = scene.surface.outside;
    let companions = match settings.integrator {
        Integrator::Path => Vec::new(),
        Integrator::Photon => companion_meshes(scene, isovalue)?,
    };
    let chosen = subset(mesh.local.len(), settings.vertices);
    let receivers: Vec<Option<Receiver>> =
        chosen.iter().map(|&v| Receiver::on_level_set(scene, mesh.local[v], isovalue, side)).collect();
    let batches = settings.batches.max(2);
    let samples = settings.taken() / batches;
    let rays = AtomicU64::new(0);
    let (mut sums, mut squares) = (vec![DVec3::ZERO; chosen.len()], vec![DVec3::ZERO; chosen.len()]);
    for batch in 0..u64::from(batches) {
        let map = (settings.integrator == Integrator::Photon).then(|| {
            let photons = trace_photons(
                scene,
                tracer,
                &PhotonSettings {
                    count: (settings.photons / u64::from(batches)).max(1),
                    max_bounces: u16::MAX,
                    seed: seed_of(settings.seed, batch),
                    axis: IsovalueAxis::EVEN,
                    fixed_isovalue: Some(isovalue),
                },
                &|_| tick(0),
            );
            rays.fetch_add(photons.rays, Ordering::Relaxed);
            SurfaceMap::new(scene, mesh, &companions, isovalue, &photons, settings.map)
        });
        let estimates: Vec<DVec3> = chosen
            .par_iter()
            .zip(&receivers)
            .with_min_len(16)
            .map(|(&vertex, receiver)| {
                let Some(receiver) = receiver else { return DVec3::ZERO };
                if !tick(0) {
                    return DVec3::ZERO;
                }
                let key = Stage::Path.key(settings.seed, vertex as u64 * u64::from(batches) + batch);
                let mut paths = PathTracer::new(scene, tracer);
                let radiance = match &map {
                    None => paths.outgoing(receiver, samples, key),
                    Some(map) => map.outgoing(&mut paths, receiver, samples, key),
                };
                rays.fetch_add(paths.rays, Ordering::Relaxed);
                tick(1);
                radiance
            })
            .collect();
        if !tick(0) {
            return Err(Error::Interrupted);
        }
        // Welford's update, all vertices side by side.
        for ((mean, square), x) in sums.iter_mut().zip(&mut squares).zip(estimates) {
            let d = x - *mean;
            *mean += d / (batch + 1) as f64;
            *square += d * (x - *mean);
        }
    }
    let total = mesh.local.len();
    let mut out = Reference {
        radiance: vec![DVec3::ZERO; total],
        variance: vec![DVec3::ZERO; total],
        sampled: vec![false; total],
        rays: rays.into_inner(),
    };
    let n = f64::from(batches);
    for (i, &v) in chosen.iter().enumerate().filter(|(i, _)| receivers[*i].is_some()) {
        out.radiance[v] = sums[i];
        out.variance[v] = squares[i] / (n * (n - 1.0));
        out.sampled[v] = true;
    }
    Ok(out)
}

/// The seed of a batch: photons are keyed by nothing else.
fn seed_of(seed: u64, batch: u64) -> u64 {
    Rng::stream(seed, Stage::Photon, u64::MAX - batch).bits()
}
