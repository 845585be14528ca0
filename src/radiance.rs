//! Radiance samples: direct light by shadow rays, indirect light from the photon map or by final gather. \[BB09 §2.3\]

use crate::brdf::reflected;
use crate::checkpoint::Saved;
use crate::direct::{Receiver, direct_irradiance, luminous_reflectance};
use crate::flattened::Side;
use crate::gather::gathered_irradiance;
use crate::nearest::Neighbours;
use crate::photon_map::PhotonMap;
use crate::progress::Tick;
use crate::radiance_cache::RadianceCache;
use crate::rng::Stage;
use crate::scene::Scene;
use crate::tracer::Tracer;
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::f64::consts::PI;
use std::iter::Sum;
use std::ops::AddAssign;

/// Where indirect light comes from.
#[derive(Debug)]
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
    /// Irradiance straight from luminaires.
    pub direct: Vec3,
    /// Indirect irradiance by either half of the gather rays; without gather twice the same.
    pub indirect: [Vec3; 2],
    /// The part of `variance` that is theirs.
    pub indirect_variance: f32,
}

/// What samples cost.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Rays traced.
    pub rays: u64,
    /// Gather rays that landed where the cache holds nothing.
    pub misses: u64,
    /// Samples taken.
    pub samples: u64,
    /// Positions left out because ∇h vanishes there.
    pub without_gradient: u64,
}

impl AddAssign for Counts {
    fn add_assign(&mut self, o: Self) {
        self.rays += o.rays;
        self.misses += o.misses;
        self.samples += o.samples;
        self.without_gradient += o.without_gradient;
    }
}

impl Sum for Counts {
    fn sum<I: Iterator<Item = Self>>(all: I) -> Self {
        all.fold(Self::default(), |mut sum, counts| {
            sum += counts;
            sum
        })
    }
}

/// Samples and what they cost.
#[derive(Debug)]
pub struct RadianceSamples {
    /// One per position; `None` where ∇h vanishes.
    pub samples: Vec<Option<RadianceSample>>,
    /// Of all of them.
    pub counts: Counts,
}

impl RadianceSample {
    /// Bytes of a sample in a checkpoint, without its position.
    pub(crate) const SAVED: usize = 56;
}

/// Samples as a block: rays, misses, and the numbers of each; a variance of −1 stands for none.
fn to_block(counts: Counts, samples: &[Option<RadianceSample>]) -> Vec<u8> {
    let numbers = samples.iter().flat_map(|s| {
        let s = s.unwrap_or(RadianceSample { variance: -1.0, ..RadianceSample::default() });
        let [a, b] = s.indirect;
        let (r, d) = (s.radiance, s.direct);
        [r.x, r.y, r.z, s.variance, d.x, d.y, d.z, a.x, a.y, a.z, b.x, b.y, b.z, s.indirect_variance]
    });
    [counts.rays, counts.misses]
        .into_iter()
        .flat_map(u64::to_le_bytes)
        .chain(numbers.flat_map(f32::to_le_bytes))
        .collect()
}

/// The inverse of [`to_block`], for samples at `places`, into `out`; the rays and misses.
fn from_block(bytes: &[u8], places: &[(u64, Vec3)], out: &mut [Option<RadianceSample>]) -> Counts {
    let (counts, numbers) = bytes.split_at(16);
    for ((b, &(_, position)), out) in numbers.as_chunks::<{ RadianceSample::SAVED }>().0.iter().zip(places).zip(out) {
        let n: [f32; 14] = std::array::from_fn(|i| f32::from_le_bytes(std::array::from_fn(|k| b[4 * i + k])));
        let vector = |i: usize| Vec3::new(n[i], n[i + 1], n[i + 2]);
        *out = (n[3] != -1.0).then(|| RadianceSample {
            position,
            radiance: vector(0),
            variance: n[3],
            direct: vector(4),
            indirect: [vector(7), vector(10)],
            indirect_variance: n[13],
        });
    }
    let [rays, misses] = [0, 8].map(|i| u64::from_le_bytes(std::array::from_fn(|k| counts[i + k])));
    Counts { rays, misses, ..Counts::default() }
}

/// What samples of one side of a scene's level sets are taken with.
#[derive(Debug)]
pub struct Sampler<'a, T> {
    /// The scene.
    pub scene: &'a Scene,
    /// Its tracer.
    pub tracer: &'a T,
    /// Where indirect light comes from.
    pub indirect: &'a Indirect<'a>,
    /// The side.
    pub side: Side,
    /// Shadow rays per luminaire, the most.
    pub shadow_rays: u32,
    /// Seed of the run.
    pub seed: u64,
}

impl<T: Tracer> Sampler<'_, T> {
    /// The samples at `positions`, random numbers keyed by their place in the list. `tick(n)` reports n samples done;
    /// returning false stops early.
    pub fn samples(&self, positions: &[Vec3], tick: Tick) -> RadianceSamples {
        let place = |n: usize| (n as u64, positions[n]);
        sample_places(self, positions.len(), &place, Saved::NOWHERE, tick)
    }

    /// The sample at `position`, its random numbers keyed by `key`; `None` where ∇h vanishes, no light between a
    /// luminaire and the wall that it covers ([`Scene::covers`]). Adds rays and misses to `counts`.
    #[allow(clippy::cast_possible_truncation, reason = "isovalues and storage are f32")]
    fn sample(
        &self,
        key: u64,
        position: Vec3,
        scratch: &mut Neighbours,
        counts: &mut Counts,
    ) -> Option<RadianceSample> {
        let Self { scene, tracer, side, .. } = *self;
        let p = position.as_dvec3();
        let isovalue = scene.field.value(p);
        // A point whose cells hold no surface, since each has a sample that is not finite.
        if !isovalue.is_finite() {
            return None;
        }
        let receiver = Receiver::on_level_set(scene, p, isovalue as f32, side)?;
        if scene.covers(scene.lattice().to_world(p)) {
            let radiance = scene.surface.emission.as_vec3();
            return Some(RadianceSample { position, radiance, ..RadianceSample::default() });
        }
        let index = key * 2 + side.index() as u64;
        let direct = direct_irradiance(scene, tracer, &receiver, self.shadow_rays, Stage::Direct.key(self.seed, index));
        counts.rays += direct.rays;
        let (mean, variance, halves) = match self.indirect {
            Indirect::Map(map) => {
                let e = map.irradiance(&receiver, scratch);
                (e.mean, e.variance, [e.mean; 2])
            }
            Indirect::Gather(cache, rays) => {
                let g =
                    gathered_irradiance(scene, tracer, *cache, &receiver, *rays, Stage::Gather.key(self.seed, index));
                let e = g.estimate;
                counts.rays += e.rays;
                counts.misses += e.misses;
                (e.mean, e.variance, g.halves)
            }
        };
        let albedo = scene.surface.albedo.at(isovalue);
        let variance_of = |e: DVec3, variance: f64| variance * (luminous_reflectance(albedo, e) / PI).powi(2);
        let indirect_variance = variance_of(mean, variance);
        Some(RadianceSample {
            position,
            // The cache's flats may be a little negative where few photons land.
            radiance: (reflected(albedo, (direct.mean + mean).max(DVec3::ZERO)) + scene.surface.emission).as_vec3(),
            variance: (variance_of(direct.mean, direct.variance) + indirect_variance) as f32,
            direct: direct.mean.as_vec3(),
            indirect: halves.map(|h| h.as_vec3()),
            indirect_variance: indirect_variance as f32,
        })
    }

    /// A block of samples into `out`: taken from `saved` if it holds the block, else made at the `places` (keys and
    /// positions) and kept there.
    pub fn block(
        &self,
        places: &[(u64, Vec3)],
        out: &mut [Option<RadianceSample>],
        saved: Saved<'_>,
        block: usize,
    ) -> Counts {
        let cost = if let Some(bytes) = saved.load(block, 16 + RadianceSample::SAVED * places.len()) {
            from_block(&bytes, places, out)
        } else {
            let (mut scratch, mut counts) = (Neighbours::default(), Counts::default());
            for (out, &(key, position)) in out.iter_mut().zip(places) {
                *out = self.sample(key, position, &mut scratch, &mut counts);
            }
            saved.save(block, || to_block(counts, out));
            counts
        };
        let samples = out.iter().flatten().count() as u64;
        Counts { samples, without_gradient: out.len() as u64 - samples, ..cost }
    }
}

/// Samples per block.
pub const BLOCK: usize = 1024;

/// As [`Sampler::samples`], at places given by number with the keys of their random numbers. Blocks are kept in `saved`
/// and looked for there.
pub fn sample_places<T: Tracer>(
    sampler: &Sampler<'_, T>,
    count: usize,
    place: &(dyn Fn(usize) -> (u64, Vec3) + Sync),
    saved: Saved<'_>,
    tick: Tick,
) -> RadianceSamples {
    let mut samples = vec![None; count];
    let blocks = samples.par_chunks_mut(BLOCK).enumerate().with_max_len(1).map(|(n, out)| {
        if !tick(0) {
            return Counts::default();
        }
        let places: Vec<(u64, Vec3)> = (n * BLOCK..n * BLOCK + out.len()).map(place).collect();
        let counts = sampler.block(&places, out, saved, n);
        tick(out.len() as u64);
        counts
    });
    let counts = blocks.sum();
    RadianceSamples { samples, counts }
}
