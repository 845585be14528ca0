//! Radiance samples: direct light by shadow rays, indirect light from the photon map or by final gather. \[BB09 §2.3\]

use crate::brdf::reflected;
use crate::checkpoint;
use crate::direct::{Receiver, direct_irradiance, luminance};
use crate::flattened::{Departure, Side};
use crate::gather::gathered_irradiance;
use crate::nearest::Neighbours;
use crate::photon_map::PhotonMap;
use crate::radiance_cache::RadianceCache;
use crate::rng::Stage;
use crate::scene::Scene;
use crate::tracer::Tracer;
use glam::{DVec3, Vec3};
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
    /// Indirect irradiance by either half of the gather rays; 0 without gather.
    pub indirect: [Vec3; 2],
    /// The part of `variance` that is theirs.
    pub indirect_variance: f32,
}

/// Samples and what they cost.
pub struct RadianceSamples {
    /// One per position; `None` where ∇h vanishes.
    pub samples: Vec<Option<RadianceSample>>,
    /// Positions left out because ∇h vanishes there.
    pub without_gradient: u64,
    /// Rays traced.
    pub rays: u64,
    /// Gather rays that landed where the cache holds nothing.
    pub misses: u64,
}

impl RadianceSample {
    /// Bytes of a sample in a checkpoint, without its position.
    pub(crate) const SAVED: usize = 44;
}

/// Samples as a block: rays, misses, and the numbers of each; a variance of −1 stands for none.
fn to_block(counts: [u64; 2], samples: &[Option<RadianceSample>]) -> Vec<u8> {
    let numbers = samples.iter().flat_map(|s| {
        let s = s.unwrap_or(RadianceSample { variance: -1.0, ..RadianceSample::default() });
        let [a, b] = s.indirect;
        let r = s.radiance;
        [r.x, r.y, r.z, s.variance, a.x, a.y, a.z, b.x, b.y, b.z, s.indirect_variance]
    });
    counts.into_iter().flat_map(u64::to_le_bytes).chain(numbers.flat_map(f32::to_le_bytes)).collect()
}

/// The inverse of [`to_block`], for samples at `positions`, into `out`; the counts.
fn from_block(bytes: &[u8], positions: &[Vec3], out: &mut [Option<RadianceSample>]) -> [u64; 2] {
    let (counts, numbers) = bytes.split_at(16);
    for ((b, &position), out) in numbers.as_chunks::<{ RadianceSample::SAVED }>().0.iter().zip(positions).zip(out) {
        let n: [f32; 11] = std::array::from_fn(|i| f32::from_le_bytes(std::array::from_fn(|k| b[4 * i + k])));
        let vector = |i: usize| Vec3::new(n[i], n[i + 1], n[i + 2]);
        *out = (n[3] != -1.0).then(|| RadianceSample {
            position,
            radiance: vector(0),
            variance: n[3],
            indirect: [vector(4), vector(7)],
            indirect_variance: n[10],
        });
    }
    [0, 8].map(|i| u64::from_le_bytes(std::array::from_fn(|k| counts[i + k])))
}

/// Samples `side` of the level sets through `positions`. `tick(n)` reports n samples done; returning false stops early.
/// Blocks are kept in `saved` and looked for there.
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
    saved: checkpoint::Stage<'_>,
    tick: &(dyn Fn(u64) -> bool + Sync),
) -> RadianceSamples {
    let (rays, misses) = (AtomicU64::new(0), AtomicU64::new(0));
    const CHUNK: usize = 1024;
    let mut samples = vec![None; positions.len()];
    samples.par_chunks_mut(CHUNK).zip(positions.par_chunks(CHUNK)).enumerate().for_each(|(chunk, (out, positions))| {
        if !tick(0) {
            return;
        }
        if let Some(bytes) = saved.load(chunk, 16 + RadianceSample::SAVED * positions.len()) {
            let counts = from_block(&bytes, positions, out);
            rays.fetch_add(counts[0], Ordering::Relaxed);
            misses.fetch_add(counts[1], Ordering::Relaxed);
            tick(positions.len() as u64);
            return;
        }
        let mut scratch = Neighbours::default();
        let (mut traced, mut missed) = (0, 0);
        let mut sample = |n: usize, position: Vec3| {
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
            let direct = direct_irradiance(scene, tracer, &receiver, shadow_rays, (key.1, Stage::Direct, key.0));
            traced += direct.rays;
            let mut halves = [DVec3::ZERO; 2];
            let (mean, variance) = match indirect {
                Indirect::Map(map) => {
                    let e = map.irradiance(p, isovalue, &mut scratch);
                    (e.mean, e.variance)
                }
                Indirect::Gather(cache, rays) => {
                    let g = gathered_irradiance(scene, tracer, cache, &receiver, *rays, (key.1, key.0));
                    halves = g.halves;
                    let e = g.estimate;
                    traced += e.rays;
                    missed += e.misses;
                    (e.mean, e.variance)
                }
            };
            let albedo = scene.surface.albedo.at(isovalue);
            let scale = luminance(albedo) / std::f64::consts::PI;
            Some(RadianceSample {
                position,
                // The cache's flats may be a little negative where few photons land.
                radiance: (reflected(albedo, (direct.mean + mean).max(DVec3::ZERO)) + scene.surface.emission).as_vec3(),
                variance: ((direct.variance + variance) * scale * scale) as f32,
                indirect: halves.map(|h| h.as_vec3()),
                indirect_variance: (variance * scale * scale) as f32,
            })
        };
        for (n, (place, &position)) in out.iter_mut().zip(positions).enumerate() {
            *place = sample(n, position);
        }
        rays.fetch_add(traced, Ordering::Relaxed);
        misses.fetch_add(missed, Ordering::Relaxed);
        saved.save(chunk, || to_block([traced, missed], out));
        tick(positions.len() as u64);
    });
    let without_gradient = samples.iter().filter(|s| s.is_none()).count() as u64;
    RadianceSamples { samples, without_gradient, rays: rays.into_inner(), misses: misses.into_inner() }
}
