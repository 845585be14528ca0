//! Final gather: one bounce of rays into the radiance cache, more where surfaces of several fields cross and within
//! capped solids. \[Jensen01; Christensen99\]

use crate::direct::{Estimate, Receiver, direct_once, luminance};
use crate::flattened::{Departure, FlattenedHit, FlattenedRay, Side, Target};
use crate::landing::{landing, touches};
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
    /// Means of the first and the second half of the rays, well distributed each; both the mean of all if there is but
    /// one.
    pub halves: [DVec3; 2],
}

/// Hits on another field nearer than this many of its cells: surfaces of several fields cross, and light changes within
/// a cell of the cache where they do. Such hits find their own light, from the luminaires and along one ray more. A
/// field's own level sets never cross, so that the cache holds their light up close: the same errors at a tenth less
/// time.
const NEAR: f64 = 1.0;
/// Such hits in a row at most.
const CORNERS: usize = 4;
/// One of so many of a receiver's rays that land so goes on, for all of them: it corrects what the cache says, which is
/// the mean of the rays that it stands for but for a part that light in corners adds. \[Arvo90\]
const SHARE: u64 = 8;
/// Fewest rays that show a receiver to be sealed off from all light.
const PILOT: u32 = 16;

/// Indirect irradiance at `receiver`: π/M Σ L over `rays` cosine-distributed directions. Luminaires count 0, since
/// direct light is counted apart; what leaves everything carries nothing. \[BB09 Eq. 2\] A receiver that sees nothing
/// but dark surfaces all around, as inside another field's solid, is known to be dark after a quarter of its rays.
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
    let (mut misses, mut traced) = (0, 0);
    // Rays that landed, and of them those that found any light.
    let (mut landed, mut lit) = (0, 0);
    let turn = Rng::stream(seed, Stage::Gather, index << 20 ^ 0xF_FFFF).bits();
    let mut corners = Corners { scene, tracer, cache, turn };
    for i in 0..rays {
        if i == PILOT.max(rays / 4) && landed == i && lit == 0 {
            break;
        }
        traced += 1;
        let direction = frame.to_world(cosine_hemisphere(set.point2(i, 0)));
        let ray = scene.ray(receiver.position, direction, receiver.isovalue, receiver.departure);
        let radiance = tracer.intersect(&ray).map_or(DVec3::ZERO, |hit| {
            landed += 1;
            let mut rng = || Rng::stream(seed, Stage::Gather, index << 20 ^ u64::from(i));
            corners.radiance(ray, hit, &mut rng, &mut misses, &mut traced)
        });
        lit += u32::from(radiance != DVec3::ZERO);
        sums[usize::from(i >= first)] += radiance;
        moments.push(luminance(radiance));
    }
    let n = f64::from(rays.max(1));
    let mean = (sums[0] + sums[1]) * (PI / n);
    let half = |sum: DVec3, count: u32| if first > 0 { sum * (PI / f64::from(count)) } else { mean };
    // Corrections by a few rays may take more than there is.
    let estimate =
        Estimate { mean: mean.max(DVec3::ZERO), variance: PI * PI * moments.variance() / n, rays: traced, misses };
    Gathered { estimate, halves: [half(sums[0], first), half(sums[1], rays - first)] }
}

/// Whether a hit is on another field than its ray left, within [`NEAR`] cells.
#[inline]
fn near(scene: &Scene, ray: &FlattenedRay, hit: FlattenedHit) -> bool {
    let other = match (ray.departure, hit.target) {
        (Departure::Surface(_), Target::Companion(n, _)) => Some(n),
        (Departure::Companion(..), Target::Surface(_)) => None,
        (Departure::Companion(m, _), Target::Companion(n, _)) if m != n => Some(n),
        _ => return false,
    };
    let (from, to) = (ray.origin.as_dvec3(), ray.at(hit.t));
    let cells = match other {
        None => to - from,
        Some(n) => {
            let companion = &scene.companions()[usize::from(n)];
            companion.to_index(to) - companion.to_index(from)
        }
    };
    cells.length_squared() < NEAR * NEAR
}

/// Whether a hit is on the inside of a cap, whose light no cache holds: few scenes have any.
#[inline]
fn is_cap_from_within(hit: FlattenedHit) -> bool {
    matches!(hit.target, Target::Cap(_, Side::Higher))
}

/// What gathers in corners know.
struct Corners<'a, T> {
    scene: &'a Scene,
    tracer: &'a T,
    cache: &'a RadianceCache,
    /// Counts the rays that landed near.
    turn: u64,
}

impl<T: Tracer> Corners<'_, T> {
    /// Radiance that arrives along `ray` from its `hit`: that of the cache if it is far away or nothing around it is
    /// lit, else on a path until it is. `rng` makes the random numbers of the path.
    #[inline]
    fn radiance(
        &mut self,
        ray: FlattenedRay,
        hit: FlattenedHit,
        rng: &mut dyn FnMut() -> Rng,
        misses: &mut u64,
        rays: &mut u64,
    ) -> DVec3 {
        let cached = self.cache.lookup(self.scene, hit.target, ray.at(hit.t), ray.isovalue, misses);
        if is_cap_from_within(hit) {
            return self.path(ray, hit, cached, &mut rng(), misses, rays);
        }
        if cached == DVec3::ZERO || !near(self.scene, &ray, hit) {
            return cached;
        }
        self.turn = self.turn.wrapping_add(1);
        if !self.turn.is_multiple_of(SHARE) {
            return cached;
        }
        cached + (self.path(ray, hit, cached, &mut rng(), misses, rays) - cached) * SHARE as f64
    }

    /// The same along a path from a `hit` that is near or a cap from within, for which the cache says `cached`. Russian
    /// roulette ends what goes from cap to cap. \[Arvo90\]
    #[cold]
    fn path(
        &self,
        mut ray: FlattenedRay,
        mut hit: FlattenedHit,
        mut cached: DVec3,
        rng: &mut Rng,
        misses: &mut u64,
        rays: &mut u64,
    ) -> DVec3 {
        let Self { scene, tracer, cache, .. } = *self;
        let (mut total, mut weight) = (DVec3::ZERO, DVec3::ONE);
        let mut corners = 0;
        loop {
            let cap = is_cap_from_within(hit);
            if !cap && (corners == CORNERS || cached == DVec3::ZERO || !near(scene, &ray, hit)) {
                break;
            }
            corners += usize::from(!cap);
            let Some((mut receiver, albedo, emission)) = landing(scene, &ray, hit) else { return total };
            if touches(scene, &ray, hit) {
                receiver.departure = ray.departure;
            }
            total += weight * emission;
            if albedo == DVec3::ZERO {
                return total;
            }
            weight *= albedo;
            total += weight * direct_once(scene, tracer, &receiver, rng, rays) / PI;
            if cap {
                let survival = weight.max_element();
                if rng.unit() >= survival {
                    return total;
                }
                weight /= survival;
            }
            let direction = Frame::new(receiver.normal).to_world(cosine_hemisphere(rng.unit2()));
            ray = scene.ray(receiver.position, direction, ray.isovalue, receiver.departure);
            *rays += 1;
            let Some(next) = tracer.intersect(&ray) else { return total };
            hit = next;
            cached = cache.lookup(scene, hit.target, ray.at(hit.t), ray.isovalue, misses);
        }
        total + weight * cached
    }
}
