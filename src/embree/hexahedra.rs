//! The graph of h as Embree user geometry, with the extruded polygons: [`GraphTracer`].
//!
//! The whole volume is **one** primitive whose callback walks the min/max pyramid: Embree's hierarchy is blind to the
//! isovalue, and a callback costs as much as several cells (design: speed). The isovalue rides in `ray.id`, what the
//! ray starts and ends on in `ray.time`.

use super::extrusions::{Extrusions, embree_ray, flattened_ray, padded};
use super::{Device, RayHit, RayView, Scene as Bvh, SceneBuilder, UserGeometry, UserHit};
use crate::error::Result;
use crate::field::Field;
use crate::flattened::{FlattenedHit, FlattenedRay, Side, Target};
use crate::pyramid::Pyramid;
use crate::scene::{Boundary, Scene};
use crate::tracer::Tracer;
use glam::DVec3;
use std::sync::Arc;

/// The 4D scene in Embree: nearest flattened hits of the graph, walls and luminaires.
pub struct GraphTracer<'a> {
    bvh: Bvh<'a>,
    volume: u32,
}

/// The graph as one primitive.
struct Graph<'a> {
    field: &'a Field,
    pyramid: Arc<Pyramid>,
}

impl<'a> GraphTracer<'a> {
    /// Builds the pyramid and commits the scene; valid for every isovalue.
    ///
    /// # Errors
    /// `Embree` if the library refuses.
    pub fn new(device: &Device, scene: &'a Scene) -> Result<Self> {
        let pyramid = Arc::new(Pyramid::new(&scene.field, scene.boundary == Boundary::Capped));
        Self::with_pyramid(device, scene, pyramid)
    }

    /// As [`GraphTracer::new`] with a pyramid that was built from the same field and boundary.
    ///
    /// # Errors
    /// `Embree` if the library refuses.
    pub fn with_pyramid(device: &Device, scene: &'a Scene, pyramid: Arc<Pyramid>) -> Result<Self> {
        let mut builder = SceneBuilder::new(device)?;
        let volume = builder.user_shared(Arc::new(Graph { field: &scene.field, pyramid }), u32::MAX)?;
        Extrusions::attach(&mut builder, scene, u32::MAX)?;
        Ok(Self { bvh: builder.commit()?, volume })
    }
}

impl Tracer for GraphTracer<'_> {
    #[inline]
    fn intersect(&self, ray: &FlattenedRay) -> Option<FlattenedHit> {
        let mut rayhit = RayHit::new(embree_ray(ray));
        self.bvh.intersect1(&mut rayhit);
        if !rayhit.is_hit() {
            return None;
        }
        let target = if rayhit.hit.geometry == self.volume {
            decode_target(rayhit.hit.u.to_bits())
        } else {
            Target::Polygon(rayhit.hit.prim)
        };
        Some(FlattenedHit { t: rayhit.ray.tfar, target })
    }

    #[inline]
    fn occluded(&self, ray: &FlattenedRay) -> bool {
        self.bvh.occluded1(&mut embree_ray(ray))
    }
}

/// A volume hit's target in the 32 bits of `hit.u`: side, and face + 1 of a cap.
#[inline]
fn encode_target(target: Target) -> u32 {
    match target {
        Target::Surface(side) => side.index() as u32,
        Target::Cap(face, side) => side.index() as u32 | (u32::from(face) + 1) << 1,
        Target::Polygon(_) => 0,
    }
}

#[inline]
fn decode_target(bits: u32) -> Target {
    let side = if bits & 1 == 0 { Side::Lower } else { Side::Higher };
    match bits >> 1 {
        0 => Target::Surface(side),
        #[allow(clippy::cast_possible_truncation, reason = "a face is below 6")]
        face => Target::Cap((face - 1) as u8, side),
    }
}

impl UserGeometry for Graph<'_> {
    fn len(&self) -> u32 {
        1
    }

    fn bounds(&self, _: u32) -> ([f32; 3], [f32; 3]) {
        padded(DVec3::ZERO, self.field.lattice().far())
    }

    #[inline]
    fn intersect(&self, _: u32, ray: &RayView) -> Option<UserHit> {
        let hit = self.pyramid.intersect(self.field, &flattened_ray(ray), f64::from(ray.tfar))?;
        Some(UserHit { t: hit.t, u: f32::from_bits(encode_target(hit.target)), v: 0.0, normal: [0.0; 3] })
    }

    #[inline]
    fn occluded(&self, _: u32, ray: &RayView) -> bool {
        self.pyramid.occluded(self.field, &flattened_ray(ray), f64::from(ray.tfar))
    }
}
