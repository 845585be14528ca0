//! Radiance samples: direct light by shadow rays, indirect light from the photon map or by final gather. \[BB09 §2.3\]

use crate::brdf::reflected;
use crate::direct::{Receiver, direct_irradiance, luminance};
use crate::flattened::{Departure, Side};
use crate::gather::gathered_irradiance;
use crate::nearest::Neighbours;
use crate::photon_map::PhotonMap;
use crate::radiance_cache::RadianceCache;
use crate::rng::Stage;
use crate::scene::Scene;
use crate::tracer::Tracer;
use glam::Vec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};

/// Where indirect light comes from.
pub enum Indirect<'a> {
    /// Straight from the photon map without first landings: BB09's own mode.
    Map(&'a PhotonMap<'a>),
    /// Final gather of this many rays into the cache.
    Gather(&'a RadianceCache, u32),
}

/// Outgoing radiance of one side of the level set through a point.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RadianceSample {
    /// Where, local frame.
    pub position: Vec3,
    /// Reflected plus emitted, RGB.
    pub radiance: Vec3,
    /// Variance of the luminance.
    pub variance: f32,
}

/// Samples and what they cost.
pub struct RadianceSamples {
    /// One per position; `None` where ∇h vanishes.
    pub samples: Vec<Option<RadianceSample>>,
    /// Positions left out because ∇h vanishes there.
    pub without_gradient: u64,
    /// Rays traced.
    pub rays: u64,
}

/// Samples `side` of the level sets through `positions`. `tick(n)` reports n samples done; returning false stops early.
#[allow(clippy::cast_possible_truncation, reason = "isovalues and storage are f32")]
#[allow(clippy::too_many_arguments, reason = "one call per bake")]
pub fn sample_radiance<T: Tracer>(
    scene: &Scene,
    tracer: &T,
    indirect: &Indirect<'_>,
    positions: &[Vec3],
    side: Side,
    shadow_rays: u32,
    seed: u64,
    tick: &(dyn Fn(u64) -> bool + Sync),
) -> RadianceSamples {
    let rays = AtomicU64::new(0);
    const CHUNK: usize = 1024;
    let chunks: Vec<Vec<Option<RadianceSample>>> = positions
        .par_chunks(CHUNK)
        .enumerate()
        .map(|(chunk, positions)| {
            if !tick(0) {
                return Vec::new();
            }
            let mut scratch = Neighbours::default();
            let mut traced = 0;
            let samples = positions
                .iter()
                .enumerate()
                .map(|(n, &position)| {
                    let index = (chunk * CHUNK + n) as u64;
                    let p = position.as_dvec3();
                    let isovalue = scene.field.value(p);
                    let receiver = Receiver {
                        position,
                        normal: scene.normal(p, side)?,
                        isovalue: isovalue as f32,
                        departure: Departure::Surface(side),
                    };
                    let key = (index * 2 + side.index() as u64, seed);
                    let direct =
                        direct_irradiance(scene, tracer, &receiver, shadow_rays, (key.1, Stage::Direct, key.0));
                    traced += direct.rays;
                    let (mean, variance) = match indirect {
                        Indirect::Map(map) => {
                            let e = map.irradiance(p, isovalue, &mut scratch);
                            (e.mean, e.variance)
                        }
                        Indirect::Gather(cache, rays) => {
                            let e = gathered_irradiance(scene, tracer, cache, &receiver, *rays, (key.1, key.0));
                            traced += e.rays;
                            (e.mean, e.variance)
                        }
                    };
                    let albedo = scene.surface.albedo;
                    let scale = luminance(albedo) / std::f64::consts::PI;
                    Some(RadianceSample {
                        position,
                        radiance: (reflected(albedo, direct.mean + mean) + scene.surface.emission).as_vec3(),
                        variance: ((direct.variance + variance) * scale * scale) as f32,
                    })
                })
                .collect();
            rays.fetch_add(traced, Ordering::Relaxed);
            tick(positions.len() as u64);
            samples
        })
        .collect();
    let samples = chunks.concat();
    let without_gradient = samples.iter().filter(|s| s.is_none()).count() as u64;
    RadianceSamples { samples, without_gradient, rays: rays.into_inner() }
}
