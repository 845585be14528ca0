//! The seam between light transport and geometry: everything that follows asks only these two questions.

use crate::flattened::{FlattenedHit, FlattenedRay};

/// Nearest hits and visibility in the scene's local frame. `intersect` and `occluded` agree on every ray.
pub trait Tracer: Sync {
    /// The nearest thing the ray meets within its reach; `None` if it leaves everything.
    fn intersect(&self, ray: &FlattenedRay) -> Option<FlattenedHit>;

    /// Whether the ray meets anything within its reach.
    fn occluded(&self, ray: &FlattenedRay) -> bool;
}
