//! What a ray finds where it lands, whatever stands there.

use crate::direct::Receiver;
use crate::flattened::{Departure, FlattenedHit, FlattenedRay, Target};
use crate::scene::Scene;
use glam::DVec3;

/// Landings after which a path ends at the latest: among surfaces that absorb nothing it would go on for ever.
pub const MOST_LANDINGS: u16 = u16::MAX;

/// What stands where a ray landed.
#[derive(Clone, Copy, Debug)]
pub struct Landing {
    /// The surface, on the side that the ray came to, as what leaves it starts: on the level set that the ray left if a
    /// polygon or a cap is met there, within the rounding of f32 coordinates. It must not begin behind that.
    pub receiver: Receiver,
    /// The surface itself.
    pub on: Departure,
    /// What it reflects: nothing on the back of a luminaire.
    pub albedo: DVec3,
    /// Radiance that it emits, unless it is a luminaire, whose light counts as direct.
    pub emission: DVec3,
}

/// What stands at a hit; `None` where ∇h vanishes.
#[inline]
pub fn landing(scene: &Scene, ray: &FlattenedRay, hit: FlattenedHit) -> Option<Landing> {
    let position = ray.at(hit.t).as_vec3();
    let isovalue = ray.isovalue;
    let none = DVec3::ZERO;
    let (normal, on, albedo, emission) = match hit.target {
        Target::Surface(side) | Target::Companion(_, side) => {
            let companion = hit.target.companion();
            let at = scene.field_at(companion, position.as_dvec3());
            let on = companion.map_or(Departure::Surface(side), |n| Departure::Companion(n, side));
            (at.normal(side)?, on, at.surface.albedo.at(f64::from(isovalue)), at.surface.emission)
        }
        Target::Cap(face, side) => {
            let n = scene.face_normal(face);
            let albedo = scene.face_surface(face).albedo.at(f64::from(isovalue));
            (side.facing(n), Departure::Cap(face, side), albedo, none)
        }
        Target::Polygon(id) => {
            let p = &scene.polygons()[id as usize];
            (p.normal(), Departure::Polygon(id), if scene.sees_front(ray, id) { p.albedo } else { none }, none)
        }
    };
    let departure = if touches(scene, ray, hit) { ray.departure } else { on };
    Some(Landing { receiver: Receiver { position, normal, isovalue, departure }, on, albedo, emission })
}

/// Whether a ray from a level set meets a polygon or a cap where it starts. (The polygon itself is no obstacle if it is
/// met from its front only.)
#[inline]
fn touches(scene: &Scene, ray: &FlattenedRay, hit: FlattenedHit) -> bool {
    let opaque_back = match hit.target {
        Target::Polygon(id) => scene.polygons()[id as usize].opaque_back,
        Target::Cap(..) => false,
        Target::Surface(_) | Target::Companion(..) => return false,
    };
    let on_surface = matches!(ray.departure, Departure::Surface(_) | Departure::Companion(..));
    let rounding = 16.0 * f32::EPSILON * ray.origin.abs().max_element().max(1.0);
    on_surface && !opaque_back && hit.t * ray.direction.length() <= rounding
}
