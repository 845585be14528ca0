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

/// A gathered irradiance and its two halves.
#[derive(Clone, Copy, Debug, Default)]
pub struct Gathered {
    /// Of all rays.
    pub estimate: Estimate,
    /// Means of the first and the second half of the rays, well distributed each; both the mean of all if there is but one.
    pub halves: [DVec3; 2],
}

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
    let mut misses = 0;
    for i in 0..rays {
        let direction = frame.to_world(cosine_hemisphere(set.point2(i, 0)));
        let ray = scene.ray(receiver.position, direction, receiver.isovalue, receiver.departure);
        let radiance = match tracer.intersect(&ray) {
            Some(hit) => cache.lookup(scene, hit.target, ray.at(hit.t), receiver.isovalue, &mut misses),
            None => DVec3::ZERO,
        };
        sums[usize::from(i >= first)] += radiance;
        moments.push(luminance(radiance));
    }
    let n = f64::from(rays.max(1));
    let mean = (sums[0] + sums[1]) * (PI / n);
    let half = |sum: DVec3, count: u32| if first > 0 { sum * (PI / f64::from(count)) } else { mean };
    let estimate = Estimate { mean, variance: PI * PI * moments.variance() / n, rays: u64::from(rays), misses };
    Gathered { estimate, halves: [half(sums[0], first), half(sums[1], rays - first)] }
}
