//! BB09's engine: photons, a radiance cache, samples by exact rays, interpolation.

use super::grid_points::GridPoints;
use super::{BakeSettings, Interpolation, Lit, PhotonCounts, stages};
use crate::checkpoint::{self, Checkpoint};
use crate::embree::{Device, GraphTracer, pyramids};
use crate::error::{Error, Result};
use crate::fitted_grid::fit;
use crate::flattened::Side;
use crate::illumination_grid::{IlluminationGrid, shepard};
use crate::mask::Mask;
use crate::photon::{PhotonSettings, trace_photons};
use crate::photon_map::PhotonMap;
use crate::progress::Progress;
use crate::radiance::{Indirect, RadianceSample, sample_radiance};
use crate::radiance_cache::{CacheSettings, RadianceCache};
use crate::sampling::{Strategy, positions};
use crate::scene::Scene;
use crate::volume::Lattice;
use glam::Vec3;
use std::time::Instant;

/// A field to light: the scene seen from it, its grid, and what the grid's points hold.
pub(super) struct Job {
    /// The field's number: it has four stages of a checkpoint, the cache's sides and the samples'.
    pub(super) number: u32,
    pub(super) scene: Scene,
    pub(super) lattice: Lattice,
    pub(super) masks: Vec<Mask>,
}

/// Lights the fields of one 4D scene, `jobs` by number: the same photons, walls and cache serve all.
pub(super) fn light(
    jobs: &[Job],
    settings: &BakeSettings,
    device: &Device,
    progress: Progress,
    checkpoint: Option<&Checkpoint>,
) -> Result<Lit> {
    let mut lit = Lit::default();
    let begun = Instant::now();
    let first = &jobs[0].scene;
    let pyramids = pyramids(first);
    let tracers =
        jobs.iter().map(|job| GraphTracer::with_pyramids(device, &job.scene, &pyramids)).collect::<Result<Vec<_>>>()?;
    lit.seconds.build = begun.elapsed().as_secs_f64();

    let stage = progress.stage("photons", settings.photons);
    let photon_settings = PhotonSettings {
        count: settings.photons,
        max_bounces: settings.bounces,
        seed: settings.seed,
        fixed_isovalue: None,
    };
    let photons = trace_photons(first, &tracers[0], &photon_settings, &|n| stage.tick(n));
    lit.seconds.photons = stage.end()?;
    lit.rays = photons.rays;
    lit.photons = PhotonCounts {
        emitted: photons.emitted,
        stored: photons.stored(),
        without_gradient: photons.flat_gradient,
        energy_imbalance: photons.energy.iter().map(|e| e.imbalance()).fold(0.0, f64::max),
    };

    let stage = progress.stage("cache", jobs.iter().map(|job| RadianceCache::work(&job.scene)).sum());
    let cache_settings = CacheSettings {
        node_shadow_rays: settings.cache_shadow_rays,
        flat_shadow_rays: settings.wall_shadow_rays,
        flat_resolution: settings.wall_resolution,
        isovalue_resolution: settings.wall_isovalues,
        seed: settings.seed,
    };
    let estimate = settings.estimate();
    let gather = settings.gather_rays > 0;
    let saved = |job: &Job| stages(checkpoint, 4 * job.number);
    let tick = |n| stage.tick(n);
    let mut cache =
        RadianceCache::new(first, &tracers[0], &photons, estimate, &cache_settings, gather, saved(&jobs[0]), &tick);
    for (job, tracer) in jobs.iter().zip(&tracers).skip(1).filter(|_| gather) {
        cache.fill(&job.scene, tracer, &photons, estimate, &cache_settings, saved(job), &tick);
    }
    lit.seconds.cache = stage.end()?;
    lit.rays += cache.rays;

    for (job, tracer) in jobs.iter().zip(&tracers) {
        let mut sides = Vec::new();
        for side in job.scene.surface.stored_sides() {
            let map;
            let indirect = if gather {
                Indirect::Gather(&cache, settings.gather_rays)
            } else {
                map = PhotonMap::new(&job.scene, &photons.surface, side, |p| p.bounces > 0, estimate);
                Indirect::Map(&map)
            };
            let saved = stages(checkpoint, 4 * job.number + 2)[side.index()];
            sides.push((side, light_side(job, tracer, &indirect, side, settings, progress, saved, &mut lit)?));
        }
        lit.fields.push(sides);
    }
    lit.flats = cache.into_shown_flats();
    Ok(lit)
}

/// Samples one side of a field and brings the samples onto its grid.
#[allow(clippy::too_many_arguments, reason = "one call")]
fn light_side(
    job: &Job,
    tracer: &GraphTracer<'_>,
    indirect: &Indirect<'_>,
    side: Side,
    settings: &BakeSettings,
    progress: Progress,
    saved: checkpoint::Stage<'_>,
    lit: &mut Lit,
) -> Result<IlluminationGrid> {
    let Job { scene, lattice, masks, .. } = job;
    let begun = Instant::now();
    let strategy = settings.strategy.placed();
    let points =
        strategy.is_none().then(|| GridPoints::new(&scene.field, lattice, masks, settings.seed, |m| m != Mask::Empty));
    let scattered = strategy.map(|s| scatter(scene, settings, masks, &s)).transpose()?;
    let at = points.as_ref().map_or(scattered.as_deref().unwrap_or_default(), GridPoints::positions);
    let stage = progress.stage("samples", at.len() as u64);
    let (shadow_rays, seed) = (settings.shadow_rays, settings.seed);
    let sampled = sample_radiance(scene, tracer, indirect, at, side, shadow_rays, seed, saved, &|n| stage.tick(n));
    stage.end()?;
    lit.seconds.samples += begun.elapsed().as_secs_f64();
    lit.rays += sampled.rays;
    lit.misses += sampled.misses;
    lit.without_gradient += sampled.without_gradient;
    lit.samples += at.len() as u64 - sampled.without_gradient;

    let passes = 1 + u64::from(settings.interpolation == Interpolation::Fit);
    let stage = progress.stage("interpolate", passes * lattice.len() as u64);
    let grid = match points {
        Some(points) => {
            let mut grid = points.collect(&sampled.samples);
            if settings.smoothing && settings.gather_rays > 1 {
                points.smooth(scene, side, settings.tau, &mut grid, &sampled.samples);
            }
            points.fit_beside(grid, &sampled.samples)
        }
        None => {
            let samples: Vec<RadianceSample> = sampled.samples.into_iter().flatten().collect();
            let grid = shepard(&scene.field, lattice, masks, &samples, settings.neighbours, &|n| stage.tick(n));
            match settings.interpolation {
                Interpolation::Shepard => grid,
                Interpolation::Fit => {
                    fit(&scene.field, lattice, &samples, grid, |m| m != Mask::Empty, &|n| stage.tick(n))
                }
            }
        }
    };
    lit.seconds.interpolate += stage.end()?;
    Ok(grid)
}

/// Positions of scattered samples.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "counts")]
fn scatter(scene: &Scene, settings: &BakeSettings, masks: &[Mask], strategy: &Strategy) -> Result<Vec<Vec3>> {
    let needed = masks.iter().filter(|&&m| m != Mask::Empty).count();
    let count = settings.samples.unwrap_or(((needed as f64 * settings.samples_per_point) as u64).max(1000));
    let at = positions(&scene.field, strategy, count, settings.seed)?;
    if at.is_empty() {
        return Err(Error::Invalid("no sample landed on an isosurface of the sweep; choose other isovalues".into()));
    }
    Ok(at)
}
