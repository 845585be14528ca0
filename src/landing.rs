//! What a ray finds where it lands, whatever stands there.

use crate::direct::Receiver;
use crate::flattened::{Departure, FlattenedHit, FlattenedRay, Side, Target};
use crate::scene::Scene;
use glam::DVec3;

/// What stands at a hit: a receiver, its albedo, and its emission unless it is a luminaire, whose light counts as
/// direct. `None` where ∇h vanishes.
#[inline]
pub fn landing(scene: &Scene, ray: &FlattenedRay, hit: FlattenedHit) -> Option<(Receiver, DVec3, DVec3)> {
    let position = ray.at(hit.t).as_vec3();
    let isovalue = ray.isovalue;
    let none = DVec3::ZERO;
    let (normal, departure, albedo, emission) = match hit.target {
        Target::Surface(side) => {
            let normal = scene.normal(position.as_dvec3(), side)?;
            (normal, Departure::Surface(side), scene.surface.albedo.at(f64::from(isovalue)), scene.surface.emission)
        }
        Target::Companion(n, side) => {
            let companion = &scene.companions()[usize::from(n)];
            let (normal, surface) = (companion.normal(position.as_dvec3(), side)?, &companion.member.surface);
            (normal, Departure::Companion(n, side), surface.albedo.at(f64::from(ray.isovalue)), surface.emission)
        }
        Target::Cap(face, side) => {
            let n = scene.face_normal(face);
            let albedo = scene.face_surface(face).albedo.at(f64::from(ray.isovalue));
            (if side == Side::Lower { n } else { -n }, Departure::Cap(face, side), albedo, none)
        }
        Target::Polygon(id) => {
            let p = &scene.polygons()[id as usize];
            // The back of a luminaire is black.
            let seen = (scene.lattice().axes() * ray.direction.as_dvec3()).dot(p.normal()) < 0.0;
            (p.normal(), Departure::Polygon(id), if seen { p.albedo } else { none }, none)
        }
    };
    Some((Receiver { position, normal, isovalue, departure }, albedo, emission))
}

/// Whether a ray from a level set meets a polygon or a cap where it starts, within the rounding of f32 coordinates.
/// What leaves that there starts on the level set, too: it must not begin behind it. (The polygon itself is no obstacle
/// if it is met from its front only.)
pub fn touches(scene: &Scene, ray: &FlattenedRay, hit: FlattenedHit) -> bool {
    let opaque_back = match hit.target {
        Target::Polygon(id) => scene.polygons()[id as usize].opaque_back,
        Target::Cap(..) => false,
        Target::Surface(_) | Target::Companion(..) => return false,
    };
    let on_surface = matches!(ray.departure, Departure::Surface(_) | Departure::Companion(..));
    let rounding = 16.0 * f32::EPSILON * ray.origin.abs().max_element().max(1.0);
    on_surface && !opaque_back && hit.t * ray.direction.length() <= rounding
}
