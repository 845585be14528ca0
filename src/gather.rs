//! Final gather: one bounce of rays into the radiance cache. \[Jensen01; Christensen99\]

use crate::direct::{Estimate, Receiver, luminance};
use crate::flattened::FlattenedRay;
use crate::radiance_cache::RadianceCache;
use crate::rng::{Sobol, Stage};
use crate::scene::Scene;
use crate::stats::Moments;
use crate::tracer::Tracer;
use crate::warp::{Frame, cosine_hemisphere};
use glam::{DVec3, Vec3};
use std::f64::consts::PI;

/// Rays asked for at once.
const PACKET: usize = 16;

/// Indirect irradiance at `receiver`: π/M Σ L over `rays` cosine-distributed directions. Luminaires count 0, since
/// direct light is counted apart; what leaves everything carries nothing. \[BB09 Eq. 2\]
pub fn gathered_irradiance<T: Tracer>(
    scene: &Scene,
    tracer: &T,
    cache: &RadianceCache,
    receiver: &Receiver,
    rays: u32,
    (seed, index): (u64, u64),
) -> Estimate {
    let frame = Frame::new(receiver.normal);
    let set = Sobol::set(seed, Stage::Gather, index);
    let mut sum = DVec3::ZERO;
    let mut moments = Moments::default();
    // In packets, as the tracer likes them; the order of the sums stays that of the directions.
    let mut batch = [FlattenedRay::free(receiver.position, Vec3::ZERO, receiver.isovalue); PACKET];
    let mut hits = [None; PACKET];
    for first in (0..rays).step_by(PACKET) {
        let n = PACKET.min((rays - first) as usize);
        for (i, ray) in (first..).zip(&mut batch[..n]) {
            let direction = frame.to_world(cosine_hemisphere(set.point2(i, 0)));
            *ray = scene.ray(receiver.position, direction, receiver.isovalue, receiver.departure);
        }
        tracer.intersect_many(&batch[..n], &mut hits[..n]);
        for (ray, hit) in batch[..n].iter().zip(&hits[..n]) {
            let radiance = hit.map_or(DVec3::ZERO, |hit| cache.lookup(scene, hit.target, ray.at(hit.t), ray.isovalue));
            sum += radiance;
            moments.push(luminance(radiance));
        }
    }
    let n = f64::from(rays.max(1));
    Estimate { mean: sum * (PI / n), variance: PI * PI * moments.variance() / n, rays: u64::from(rays) }
}
