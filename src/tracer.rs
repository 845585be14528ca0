//! The seam between light transport and geometry: everything that follows asks only these questions.

use crate::flattened::{FlattenedHit, FlattenedRay};

/// Nearest hits and visibility in the scene's local frame. `intersect` and `occluded` agree on every ray. Asking for
/// many rays at once gives the same bits as asking for each, unless two things are met at the same t: then either may
/// be named.
pub trait Tracer: Sync {
    /// The nearest thing the ray meets within its reach; `None` if it leaves everything.
    fn intersect(&self, ray: &FlattenedRay) -> Option<FlattenedHit>;

    /// Whether the ray meets anything within its reach.
    fn occluded(&self, ray: &FlattenedRay) -> bool;

    /// [`Tracer::intersect`] for every ray, into the same places of `hits`. Faster if neighbours in `rays` are
    /// neighbours in space.
    ///
    /// # Panics
    /// If the lengths differ.
    fn intersect_many(&self, rays: &[FlattenedRay], hits: &mut [Option<FlattenedHit>]) {
        assert_eq!(rays.len(), hits.len(), "a place for every ray's hit");
        for (ray, hit) in rays.iter().zip(hits) {
            *hit = self.intersect(ray);
        }
    }

    /// [`Tracer::occluded`] for every ray, into the same places of `blocked`.
    ///
    /// # Panics
    /// If the lengths differ.
    fn occluded_many(&self, rays: &[FlattenedRay], blocked: &mut [bool]) {
        assert_eq!(rays.len(), blocked.len(), "a place for every ray's answer");
        for (ray, blocked) in rays.iter().zip(blocked) {
            *blocked = self.occluded(ray);
        }
    }
}
