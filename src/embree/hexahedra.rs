//! The graph of h and the extruded polygons as Embree user geometry: [`GraphTracer`].
//!
//! The whole volume is **one** primitive whose callback walks the min/max pyramid: Embree's hierarchy is blind to the
//! isovalue, and a callback costs as much as several cells (design: speed). The isovalue rides in `ray.id`, what the
//! ray starts and ends on in `ray.time`.

use super::{
    Device, INVALID_ID, Ray, Ray16, RayHit, RayHit16, RayView, Scene as Bvh, SceneBuilder, UserGeometry, UserHit,
    UserHits16, Valid16,
};
use crate::error::Result;
use crate::field::Field;
use crate::flattened::{FlattenedHit, FlattenedRay, Side, Target};
use crate::polygon::LocalPolygon;
use crate::pyramid::Pyramid;
use crate::scene::{Boundary, Scene};
use crate::tracer::Tracer;
use glam::{DVec3, Vec3};
use std::sync::Arc;

/// Boxes grow by this many cells, since Embree tests user geometry without its ROBUST care. 1e-3 lost no ray.
const PADDING: f64 = 1e-3;

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

/// Walls and luminaires, a primitive each.
struct Extrusions {
    polygons: Vec<LocalPolygon>,
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
        if !scene.polygons().is_empty() {
            let polygons = scene.polygons().iter().map(|p| LocalPolygon::new(p, scene.lattice())).collect();
            builder.user_shared(Arc::new(Extrusions { polygons }), u32::MAX)?;
        }
        Ok(Self { bvh: builder.commit()?, volume })
    }
}

/// The ray as Embree carries it.
#[inline]
fn embree_ray(ray: &FlattenedRay) -> Ray {
    let mut r = Ray::new(ray.origin.to_array(), ray.direction.to_array(), 0.0, ray.reach);
    r.id = ray.isovalue.to_bits();
    r.time = ray.pack_ends();
    r
}

/// The inverse of [`embree_ray`].
#[inline]
fn flattened_ray(r: &RayView) -> FlattenedRay {
    let (departure, target) = FlattenedRay::unpack_ends(r.time);
    FlattenedRay {
        origin: Vec3::from_array(r.org),
        direction: Vec3::from_array(r.dir),
        isovalue: f32::from_bits(r.id),
        reach: r.tfar,
        departure,
        target,
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

    fn intersect_many(&self, rays: &[FlattenedRay], hits: &mut [Option<FlattenedHit>]) {
        assert_eq!(rays.len(), hits.len(), "a place for every ray's hit");
        for (rays, hits) in rays.chunks(16).zip(hits.chunks_mut(16)) {
            let (valid, packet) = packet(rays);
            let mut rayhit = RayHit16::new(packet);
            self.bvh.intersect16(&valid, &mut rayhit);
            for (lane, hit) in hits.iter_mut().enumerate() {
                let found = &rayhit.hit;
                *hit = match found.geometry[lane] {
                    INVALID_ID => None,
                    id if id == self.volume => Some(decode_target(found.u[lane].to_bits())),
                    _ => Some(Target::Polygon(found.prim[lane])),
                }
                .map(|target| FlattenedHit { t: rayhit.ray.tfar[lane], target });
            }
        }
    }

    fn occluded_many(&self, rays: &[FlattenedRay], blocked: &mut [bool]) {
        assert_eq!(rays.len(), blocked.len(), "a place for every ray's answer");
        for (rays, blocked) in rays.chunks(16).zip(blocked.chunks_mut(16)) {
            let (valid, mut packet) = packet(rays);
            self.bvh.occluded16(&valid, &mut packet);
            for (lane, blocked) in blocked.iter_mut().enumerate() {
                *blocked = packet.tfar[lane] == f32::NEG_INFINITY;
            }
        }
    }
}

/// Up to sixteen rays as a packet; the lanes that are left over repeat the first and take no part.
#[inline]
fn packet(rays: &[FlattenedRay]) -> (Valid16, Ray16) {
    let packet = Ray16::new(&std::array::from_fn(|i| embree_ray(rays.get(i).unwrap_or(&rays[0]))));
    let valid = if rays.len() == 16 { Valid16::ALL } else { Valid16::from_bits((1 << rays.len()) - 1) };
    (valid, packet)
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

/// Box corners for Embree, grown by [`PADDING`].
#[allow(clippy::cast_possible_truncation, reason = "the padding covers f32 rounding")]
fn padded(lo: DVec3, hi: DVec3) -> ([f32; 3], [f32; 3]) {
    // Far from the origin an f32 step outgrows the padding in cells.
    let pad = PADDING.max(4.0 * f64::from(f32::EPSILON) * lo.abs().max(hi.abs()).max_element());
    ((lo - pad).as_vec3().to_array(), (hi + pad).as_vec3().to_array())
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

    #[inline]
    fn intersect16(&self, _: u32, active: u16, rays: &Ray16, hits: &mut UserHits16) -> u16 {
        let mut found = [None; 16];
        self.pyramid.intersect16(self.field, active, |lane| flattened_ray(&rays.lane(lane)), &mut found);
        let mut bits = 0;
        for (lane, hit) in found.iter().enumerate() {
            if let Some(hit) = hit {
                hits.t[lane] = hit.t;
                hits.u[lane] = f32::from_bits(encode_target(hit.target));
                bits |= 1 << lane;
            }
        }
        bits
    }

    #[inline]
    fn occluded16(&self, _: u32, active: u16, rays: &Ray16) -> u16 {
        self.pyramid.occluded16(self.field, active, |lane| flattened_ray(&rays.lane(lane)))
    }
}

impl Extrusions {
    #[inline]
    fn meet(&self, prim: u32, ray: &RayView) -> Option<f64> {
        let o = DVec3::from_array(ray.org.map(f64::from));
        let d = DVec3::from_array(ray.dir.map(f64::from));
        let ends = FlattenedRay::unpack_ends(ray.time);
        self.polygons[prim as usize].intersect(prim, ends, o, d, f64::from(ray.tfar))
    }
}

impl UserGeometry for Extrusions {
    fn len(&self) -> u32 {
        u32::try_from(self.polygons.len()).expect("scenes hold fewer than 2¹⁶ polygons")
    }

    fn bounds(&self, prim: u32) -> ([f32; 3], [f32; 3]) {
        let (lo, hi) = self.polygons[prim as usize].bounds();
        padded(lo, hi)
    }

    #[inline]
    #[allow(clippy::cast_possible_truncation, reason = "t leaves as f32, clamped to the reach")]
    fn intersect(&self, prim: u32, ray: &RayView) -> Option<UserHit> {
        let t = (self.meet(prim, ray)? as f32).min(ray.tfar);
        Some(UserHit { t, u: 0.0, v: 0.0, normal: [0.0; 3] })
    }

    #[inline]
    fn occluded(&self, prim: u32, ray: &RayView) -> bool {
        self.meet(prim, ray).is_some()
    }
}
