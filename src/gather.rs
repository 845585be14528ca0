//! Final gather: one bounce of rays into the radiance cache. \[Jensen01; Christensen99\]

use crate::direct::{Estimate, Receiver, luminance};
use crate::radiance_cache::RadianceCache;
use crate::rng::{Sobol, Stage};
use crate::scene::Scene;
use crate::stats::Moments;
use crate::tracer::Tracer;
use crate::warp::{Frame, cosine_hemisphere};
use glam::DVec3;
use std::f64::consts::PI;

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
    let mut misses = 0;
    for i in 0..rays {
        let direction = frame.to_world(cosine_hemisphere(set.point2(i, 0)));
        let ray = scene.ray(receiver.position, direction, receiver.isovalue, receiver.departure);
        let radiance = match tracer.intersect(&ray) {
            Some(hit) => cache.lookup(scene, hit.target, ray.at(hit.t), receiver.isovalue, &mut misses),
            None => DVec3::ZERO,
        };
        sum += radiance;
        moments.push(luminance(radiance));
    }
    let n = f64::from(rays.max(1));
    Estimate { mean: sum * (PI / n), variance: PI * PI * moments.variance() / n, rays: u64::from(rays), misses }
}
