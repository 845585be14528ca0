//! How long a bake takes, before it takes it.

use super::{BakeSettings, Engine, StrategyName};
use crate::checkpoint;
use crate::direct::{Receiver, direct_irradiance};
use crate::embree::{Device, GraphTracer, pyramids};
use crate::error::Result;
use crate::flat;
use crate::flattened::Departure;
use crate::illumination_grid::GridSize;
use crate::mask::{Mask, masks};
use crate::nearest::Neighbours;
use crate::photon::{PhotonSettings, Photons, trace_photons};
use crate::photon_map::PhotonMap;
use crate::radiance::{Indirect, sample_radiance};
use crate::radiance_cache::RadianceCache;
use crate::rng::Stage;
use crate::sampling::{Strategy, positions};
use crate::scene::Scene;
use crate::sweep::{self, SweepSettings};
use rayon::prelude::*;
use std::time::Instant;

/// Photons and samples tried: a second or so.
const PHOTONS: u64 = 1 << 15;
const SAMPLES: u64 = 1 << 12;

/// Sweeps are tried on a coarse copy of the field, with half the points along each edge or so many along the longest, walls
/// likewise, and with an eighth and a quarter of the directions.
const COARSE: usize = 32;

/// A sweep's time grows as this power of the number of points: measured from 64³ to 256³, walls included.
const GROWTH: f64 = 0.84;

/// Estimated wall seconds of a bake, stage by stage, on as many threads as it will have.
#[derive(Clone, Debug, PartialEq)]
pub struct TimeEstimate {
    /// Name and seconds of each stage.
    pub stages: Vec<(&'static str, f64)>,
}

impl TimeEstimate {
    /// Does a small part of each stage and scales it up: right within a factor of about 2 on a machine that stays as busy
    /// as it is; of sweeps only the order of magnitude, since a coarse copy of a field bounces light otherwise. Interpolation of
    /// scattered samples, rays beside the ends of a sweep and export are left out.
    ///
    /// # Errors
    /// `Invalid` if the grid has too many points; `NotSupported` as [`sweep::sweep`]; `Embree`.
    pub fn new(scene: &Scene, settings: &BakeSettings, device: &Device) -> Result<Self> {
        match settings.engine {
            Engine::Sweep => Self::of_sweeps(scene, settings),
            Engine::Photon => Self::of_photons(scene, settings, device),
        }
    }

    fn of_sweeps(scene: &Scene, settings: &BakeSettings) -> Result<Self> {
        let mut all = 0.0;
        let all_directions = settings.directions;
        let directions = [(all_directions / 8).max(8), (all_directions / 4).max(16).min(all_directions)];
        for number in 0..scene.fields() {
            let lit = scene.lit(number);
            let dims = lit.lattice().dims();
            let shrink = (dims.into_iter().max().unwrap_or(1) as f64 / COARSE as f64).max(2.0);
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a part of a length")]
            let shrunk = |n: usize| ((n as f64 / shrink).round() as usize).max(2);
            let points = dims.map(shrunk);
            // So that a wall's share of the work stays what it is.
            let walls = (shrunk(settings.wall_resolution), settings.wall_isovalues);
            let coarse = lit.resampled(&GridSize::Points(points).lattice(lit.lattice())?);
            let seconds = |directions: usize| -> Result<f64> {
                let few = SweepSettings {
                    directions,
                    light_points: (settings.light_points * directions / all_directions).max(1),
                    flat_resolution: walls,
                    ..settings.sweep()
                };
                let begun = Instant::now();
                sweep::sweep(&coarse, &few, &|_| true)?;
                Ok(begun.elapsed().as_secs_f64())
            };
            // Some of the time is for directions, some is not.
            let [few, more] = [seconds(directions[0])?, seconds(directions[1])?];
            let each = (more - few).max(0.0) / (directions[1] - directions[0]).max(1) as f64;
            let grid = settings.grid.lattice(lit.lattice())?;
            let larger = grid.len() as f64 / coarse.lattice().len() as f64;
            all += (more + each * (all_directions - directions[1]) as f64) * larger.powf(GROWTH);
        }
        Ok(Self { stages: vec![("sweep", all)] })
    }

    fn of_photons(scene: &Scene, settings: &BakeSettings, device: &Device) -> Result<Self> {
        let pyramids = pyramids(scene);
        let tracer = GraphTracer::with_pyramids(device, scene, &pyramids)?;
        let count = settings.photons.min(PHOTONS);
        let pilot = PhotonSettings { count, max_bounces: settings.bounces, seed: settings.seed, fixed_isovalue: None };
        let begun = Instant::now();
        let photons = trace_photons(scene, &tracer, &pilot, &|_| true);
        let all = begun.elapsed().as_secs_f64() * settings.photons as f64 / count as f64;
        let (mut cache, mut samples, mut per_ray) = (0.0, 0.0, 0.0);
        for number in 0..scene.fields() {
            let seen = scene.seen_from(number);
            let tracer = GraphTracer::with_pyramids(device, &seen, &pyramids)?;
            let [nodes, sampled, ray] = field_seconds(&seen, &tracer, &photons, settings)?;
            (cache, samples, per_ray) = (cache + nodes, samples + sampled, ray);
        }
        let texels = flat::texels(scene, settings.wall_resolution, settings.wall_isovalues);
        let walls = texels as f64 * f64::from(settings.wall_shadow_rays) * per_ray;
        Ok(Self { stages: vec![("photons", all), ("cache", cache + walls), ("samples", samples)] })
    }

    /// All stages together, seconds.
    pub fn total(&self) -> f64 {
        self.stages.iter().map(|s| s.1).sum()
    }
}

/// Estimated seconds of the cache's nodes and of the samples of the scene's own field, and seconds per ray.
#[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
fn field_seconds(
    scene: &Scene,
    tracer: &GraphTracer<'_>,
    photons: &Photons,
    settings: &BakeSettings,
) -> Result<[f64; 3]> {
    let needed = |masks: &[Mask]| masks.iter().filter(|&&m| m != Mask::Empty).count() as f64;
    let side = scene.surface.outside;
    let at = positions(&scene.field, &Strategy::Uniform, SAMPLES, settings.seed)?;
    let tried = at.len().max(1) as f64;
    let map = PhotonMap::new(scene, &photons.surface, side, |p| p.bounces > 0, settings.estimate());
    let begun = Instant::now();
    let rays: u64 = at
        .par_iter()
        .enumerate()
        .with_min_len(64)
        .map_init(Neighbours::default, |scratch, (i, &position)| {
            let p = position.as_dvec3();
            let isovalue = scene.field.value(p) as f32;
            let Some(normal) = scene.normal(p, side) else { return 0 };
            map.irradiance(p, f64::from(isovalue), scratch);
            let receiver = Receiver { position, normal, isovalue, departure: Departure::Surface(side) };
            let key = (settings.seed, Stage::Cache, i as u64);
            direct_irradiance(scene, tracer, &receiver, settings.cache_shadow_rays, key).rays
        })
        .sum();
    let per_node = begun.elapsed().as_secs_f64() / tried;
    // Light reaches the other side of most surfaces, too.
    let sides = if photons.surface.iter().any(|p| p.side != side) { 2.0 } else { 1.0 };
    let nodes = if settings.gather_rays > 0 { sides * needed(&masks(&scene.field, scene.lattice())) } else { 0.0 };

    let begun = Instant::now();
    let empty = RadianceCache::from_parts([None, None], vec![None; flat::count(scene)]);
    let indirect = match settings.gather_rays {
        0 => Indirect::Map(&map),
        rays => Indirect::Gather(&empty, rays),
    };
    let unsaved = checkpoint::Stage::UNSAVED;
    let (shadow, seed) = (settings.shadow_rays, settings.seed);
    let sampled = sample_radiance(scene, tracer, &indirect, &at, side, shadow, seed, unsaved, &|_| true);
    let seconds = begun.elapsed().as_secs_f64();
    let lattice = settings.grid.lattice(scene.lattice())?;
    let points = needed(&masks(&scene.field, &lattice));
    let samples = match settings.strategy {
        StrategyName::Nodes => points,
        _ => settings.samples.map_or(points * settings.samples_per_point, |n| n as f64),
    };
    let per_ray = seconds / (sampled.rays + rays).max(1) as f64;
    let per_sample = seconds / tried * scene.surface.stored_sides().len() as f64;
    Ok([per_node * nodes, per_sample * samples, per_ray])
}

impl std::fmt::Display for TimeEstimate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "about {:.0} s:", self.total().max(1.0))?;
        let mut separator = " ";
        for (name, seconds) in &self.stages {
            write!(f, "{separator}{name} {seconds:.1}")?;
            separator = ", ";
        }
        Ok(())
    }
}
