//! Final gather: one bounce of rays into the radiance cache, more where they land nearby. \[Jensen01; Christensen99\]

use crate::direct::{Estimate, Receiver, direct_once, luminance};
use crate::flattened::{FlattenedHit, FlattenedRay, Target};
use crate::landing::landing;
use crate::radiance_cache::RadianceCache;
use crate::rng::{Rng, Sobol, Stage};
use crate::scene::Scene;
use crate::stats::Moments;
use crate::tracer::Tracer;
use crate::warp::{Frame, cosine_hemisphere};
use glam::DVec3;
use std::f64::consts::PI;

/// A gathered irradiance and its two halves.
#[derive(Clone, Copy, Debug, Default)]
pub struct Gathered {
    /// Of all rays.
    pub estimate: Estimate,
    /// Means of the first and the second half of the rays, well distributed each; both the mean of all if there is but one.
    pub halves: [DVec3; 2],
}

/// Hits nearer than this many cells are in corners and crevices, where light changes within a cell of the cache: they get
/// their own light, from the luminaires and along one ray more.
const NEAR: f64 = 2.0;
/// Such hits in a row at most.
const CORNERS: usize = 8;

/// Indirect irradiance at `receiver`: π/M Σ L over `rays` cosine-distributed directions. Luminaires count 0, since
/// direct light is counted apart; what leaves everything carries nothing. \[BB09 Eq. 2\]
pub fn gathered_irradiance<T: Tracer>(
    scene: &Scene,
    tracer: &T,
    cache: &RadianceCache,
    receiver: &Receiver,
    rays: u32,
    (seed, index): (u64, u64),
) -> Gathered {
    let frame = Frame::new(receiver.normal);
    let set = Sobol::set(seed, Stage::Gather, index);
    let mut sums = [DVec3::ZERO; 2];
    let first = rays / 2;
    let mut moments = Moments::default();
    let (mut misses, mut traced) = (0, u64::from(rays));
    for i in 0..rays {
        let direction = frame.to_world(cosine_hemisphere(set.point2(i, 0)));
        let ray = scene.ray(receiver.position, direction, receiver.isovalue, receiver.departure);
        let radiance = match tracer.intersect(&ray) {
            Some(hit) if near(scene, &ray, hit) => {
                let mut rng = Rng::stream(seed, Stage::Gather, index << 20 ^ u64::from(i));
                let paths = Corners { scene, tracer, cache };
                paths.radiance(ray, hit, &mut rng, &mut misses, &mut traced)
            }
            Some(hit) => cache.lookup(scene, hit.target, ray.at(hit.t), receiver.isovalue, &mut misses),
            None => DVec3::ZERO,
        };
        sums[usize::from(i >= first)] += radiance;
        moments.push(luminance(radiance));
    }
    let n = f64::from(rays.max(1));
    let mean = (sums[0] + sums[1]) * (PI / n);
    let half = |sum: DVec3, count: u32| if first > 0 { sum * (PI / f64::from(count)) } else { mean };
    let estimate = Estimate { mean, variance: PI * PI * moments.variance() / n, rays: traced, misses };
    Gathered { estimate, halves: [half(sums[0], first), half(sums[1], rays - first)] }
}

/// Whether a hit is within [`NEAR`] cells of the field it is on.
#[inline]
fn near(scene: &Scene, ray: &FlattenedRay, hit: FlattenedHit) -> bool {
    let (from, to) = (ray.origin.as_dvec3(), ray.at(hit.t));
    let distance = match hit.target {
        Target::Companion(n, _) => {
            let companion = &scene.companions()[usize::from(n)];
            companion.to_index(to) - companion.to_index(from)
        }
        Target::Surface(_) | Target::Polygon(_) => to - from,
        // Outside of them there is no crevice.
        Target::Cap(..) => return false,
    };
    distance.length_squared() < NEAR * NEAR
}

/// What gathers in corners know.
struct Corners<'a, T> {
    scene: &'a Scene,
    tracer: &'a T,
    cache: &'a RadianceCache,
}

impl<T: Tracer> Corners<'_, T> {
    /// Radiance that arrives along `ray` from its near `hit`: on a path until it lands far away.
    fn radiance(
        &self,
        mut ray: FlattenedRay,
        mut hit: FlattenedHit,
        rng: &mut Rng,
        misses: &mut u64,
        rays: &mut u64,
    ) -> DVec3 {
        let Self { scene, tracer, cache } = *self;
        let (mut total, mut weight) = (DVec3::ZERO, DVec3::ONE);
        for _ in 0..CORNERS {
            if !near(scene, &ray, hit) {
                break;
            }
            let Some((receiver, albedo, emission)) = landing(scene, &ray, hit) else { return total };
            total += weight * emission;
            if albedo == DVec3::ZERO {
                return total;
            }
            weight *= albedo;
            total += weight * direct_once(scene, tracer, &receiver, rng, rays) / PI;
            let direction = Frame::new(receiver.normal).to_world(cosine_hemisphere(rng.unit2()));
            ray = scene.ray(receiver.position, direction, ray.isovalue, receiver.departure);
            *rays += 1;
            let Some(next) = tracer.intersect(&ray) else { return total };
            hit = next;
        }
        total + weight * cache.lookup(scene, hit.target, ray.at(hit.t), ray.isovalue, misses)
    }
}
