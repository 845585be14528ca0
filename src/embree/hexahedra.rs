//! The graph of h as Embree user geometry, with the extruded polygons: [`GraphTracer`].
//!
//! The whole volume is **one** primitive whose callback walks the min/max pyramid: Embree's hierarchy is blind to the
//! isovalue, and a callback costs as much as several cells (design: speed). The isovalue rides in `ray.id`, what the
//! ray starts and ends on in `ray.time`. Companions are a primitive each, in their own index spaces, but those that
//! share the lattice: one callback serves them all, the own field first, so that its hit ends the others' walks.

use super::extrusions::{Extrusions, embree_ray, flattened_ray, padded};
use super::{
    Bvh, BvhBuilder, Device, INVALID_ID, Ray, Ray16, RayHit, RayHit16, UserGeometry, UserHit, UserHits16, Valid16,
};
use crate::error::{Error, Result};
use crate::field::Field;
use crate::flattened::{FlattenedHit, FlattenedRay, Side, Target};
use crate::pyramid::Pyramid;
use crate::scene::{Boundary, Companion, Scene};
use crate::tracer::Tracer;
use glam::DVec3;
use std::sync::Arc;

/// The 4D scene in Embree: nearest flattened hits of the graph, walls and luminaires.
#[derive(Debug)]
pub struct GraphTracer<'a> {
    bvh: Bvh<'a>,
    /// Geometries below this number are volumes.
    volumes: u32,
    extrusions: Arc<Extrusions>,
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
        Self::with_pyramids(device, scene, &pyramids(scene))
    }

    /// As [`GraphTracer::new`] with the [`pyramids`] of the same scene, seen from any of its fields.
    ///
    /// # Errors
    /// `Invalid` for pyramids of other dimensions; `Embree` if the library refuses.
    pub fn with_pyramids(device: &Device, scene: &'a Scene, pyramids: &[Arc<Pyramid>]) -> Result<Self> {
        let mut builder = BvhBuilder::new(device)?;
        let graph = |number: usize, field: &'a Field| {
            let pyramid = pyramids.get(number).filter(|p| p.cells() == field.lattice().cells());
            let pyramid = pyramid.ok_or_else(|| Error::Invalid("these pyramids are of another scene".into()))?;
            Ok(Graph { field, pyramid: pyramid.clone() })
        };
        let companions = scene.companions().iter().map(|companion| {
            let graph = graph(companion.number, &companion.member.field)?;
            Ok(CompanionGraph { graph, companion })
        });
        let companions = companions.collect::<Result<Vec<_>>>()?;
        let graph = graph(scene.number(), &scene.field)?;
        let (same, others): (Vec<_>, Vec<_>) = companions.into_iter().partition(|c| c.companion.shares_lattice());
        let mut last = if same.is_empty() {
            builder.user_shared(Arc::new(graph), u32::MAX)?
        } else {
            builder.user_shared(Arc::new(StackedGraphs { graph, same }), u32::MAX)?
        };
        for other in others {
            last = builder.user_shared(Arc::new(other), u32::MAX)?;
        }
        let extrusions = Extrusions::attach(&mut builder, scene, u32::MAX)?;
        Ok(Self { bvh: builder.commit()?, volumes: last + 1, extrusions })
    }
}

/// The min/max hierarchy of each field of `scene`, by number.
pub fn pyramids(scene: &Scene) -> Vec<Arc<Pyramid>> {
    scene.members().iter().map(|m| Arc::new(Pyramid::new(&m.field, m.boundary == Boundary::Capped))).collect()
}

impl Tracer for GraphTracer<'_> {
    #[inline]
    fn intersect(&self, ray: &FlattenedRay) -> Option<FlattenedHit> {
        let mut rayhit = RayHit::new(embree_ray(ray));
        self.bvh.intersect1(&mut rayhit);
        if !rayhit.is_hit() {
            return None;
        }
        let target = if rayhit.hit.geometry < self.volumes {
            decode_target(rayhit.hit.u.to_bits())
        } else {
            Target::Polygon(self.extrusions.settle(ray, rayhit.hit.prim))
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
            for (lane, (hit, ray)) in hits.iter_mut().zip(rays).enumerate() {
                let found = &rayhit.hit;
                *hit = match found.geometry[lane] {
                    INVALID_ID => None,
                    id if id < self.volumes => Some(decode_target(found.u[lane].to_bits())),
                    _ => Some(Target::Polygon(self.extrusions.settle(ray, found.prim[lane]))),
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

/// A volume hit's target in the 32 bits of `hit.u`: side, face + 1 of a cap, and from bit 16 companion + 1.
#[inline]
fn encode_target(target: Target) -> u32 {
    match target {
        Target::Surface(side) => side.index() as u32,
        Target::Cap(face, side) => side.index() as u32 | (u32::from(face) + 1) << 1,
        Target::Companion(n, side) => side.index() as u32 | (u32::from(n) + 1) << 16,
        Target::Polygon(_) => 0,
    }
}

#[inline]
#[allow(clippy::cast_possible_truncation, reason = "encoded from bytes")]
fn decode_target(bits: u32) -> Target {
    let side = if bits & 1 == 0 { Side::Lower } else { Side::Higher };
    match bits >> 1 {
        0 => Target::Surface(side),
        face if face < 1 << 15 => Target::Cap((face - 1) as u8, side),
        _ => Target::Companion((bits >> 16) as u8 - 1, side),
    }
}

#[inline]
fn user_hit(hit: FlattenedHit) -> UserHit {
    UserHit { t: hit.t, u: f32::from_bits(encode_target(hit.target)), v: 0.0, normal: [0.0; 3] }
}

/// Writes down what a packet's lanes found; a bit for each lane that found anything.
#[inline]
fn user_hits(found: [Option<FlattenedHit>; 16], hits: &mut UserHits16) -> u16 {
    let mut bits = 0;
    for (lane, hit) in found.into_iter().enumerate() {
        if let Some(hit) = hit {
            hits.t[lane] = hit.t;
            hits.u[lane] = f32::from_bits(encode_target(hit.target));
            bits |= 1 << lane;
        }
    }
    bits
}

impl UserGeometry for Graph<'_> {
    fn len(&self) -> u32 {
        1
    }

    fn bounds(&self, _: u32) -> ([f32; 3], [f32; 3]) {
        padded(DVec3::ZERO, self.field.lattice().far())
    }

    #[inline]
    fn intersect(&self, _: u32, ray: &Ray) -> Option<UserHit> {
        self.pyramid.intersect(self.field, &flattened_ray(ray), f64::from(ray.tfar)).map(user_hit)
    }

    #[inline]
    fn occluded(&self, _: u32, ray: &Ray) -> bool {
        self.pyramid.occluded(self.field, &flattened_ray(ray), f64::from(ray.tfar))
    }

    #[inline]
    fn intersect16(&self, _: u32, active: u16, rays: &Ray16, hits: &mut UserHits16) -> u16 {
        let mut found = [None; 16];
        self.pyramid.intersect16(self.field, active, |lane| flattened_ray(&rays.lane(lane)), &mut found);
        user_hits(found, hits)
    }

    #[inline]
    fn occluded16(&self, _: u32, active: u16, rays: &Ray16) -> u16 {
        self.pyramid.occluded16(self.field, active, |lane| flattened_ray(&rays.lane(lane)))
    }
}

/// A companion's graph: rays are carried into its index space, where they are the rays of a scene of its own.
struct CompanionGraph<'a> {
    graph: Graph<'a>,
    companion: &'a Companion,
}

impl CompanionGraph<'_> {
    #[inline]
    fn ray(&self, ray: &Ray) -> FlattenedRay {
        self.companion.ray_to_index(&flattened_ray(ray))
    }

    /// A hit of its own walk, as the scene names what was hit.
    #[inline]
    fn named(&self, hit: FlattenedHit) -> FlattenedHit {
        FlattenedHit { target: self.companion.target(hit.target), ..hit }
    }
}

impl UserGeometry for CompanionGraph<'_> {
    fn len(&self) -> u32 {
        1
    }

    fn bounds(&self, _: u32) -> ([f32; 3], [f32; 3]) {
        let corners = self.companion.corners();
        let lo = corners.iter().copied().fold(DVec3::INFINITY, DVec3::min);
        padded(lo, corners.iter().copied().fold(DVec3::NEG_INFINITY, DVec3::max))
    }

    #[inline]
    fn intersect(&self, _: u32, ray: &Ray) -> Option<UserHit> {
        let hit = self.graph.pyramid.intersect(self.graph.field, &self.ray(ray), f64::from(ray.tfar))?;
        Some(user_hit(self.named(hit)))
    }

    #[inline]
    fn occluded(&self, _: u32, ray: &Ray) -> bool {
        self.graph.pyramid.occluded(self.graph.field, &self.ray(ray), f64::from(ray.tfar))
    }

    #[inline]
    fn intersect16(&self, _: u32, active: u16, rays: &Ray16, hits: &mut UserHits16) -> u16 {
        let mut found = [None; 16];
        self.graph.pyramid.intersect16(self.graph.field, active, |lane| self.ray(&rays.lane(lane)), &mut found);
        user_hits(found.map(|hit| Some(self.named(hit?))), hits)
    }

    #[inline]
    fn occluded16(&self, _: u32, active: u16, rays: &Ray16) -> u16 {
        self.graph.pyramid.occluded16(self.graph.field, active, |lane| self.ray(&rays.lane(lane)))
    }
}

/// A graph and those of companions on the same lattice.
struct StackedGraphs<'a> {
    graph: Graph<'a>,
    same: Vec<CompanionGraph<'a>>,
}

impl StackedGraphs<'_> {
    /// The ray for the walk through companion `c` within `reach`.
    #[inline(always)]
    fn ray(c: &CompanionGraph<'_>, ray: &FlattenedRay, reach: f32) -> FlattenedRay {
        FlattenedRay { reach, ..c.companion.ray_to_index(ray) }
    }
}

impl UserGeometry for StackedGraphs<'_> {
    fn len(&self) -> u32 {
        1
    }

    fn bounds(&self, prim: u32) -> ([f32; 3], [f32; 3]) {
        self.graph.bounds(prim)
    }

    #[inline]
    fn intersect(&self, _: u32, ray: &Ray) -> Option<UserHit> {
        let flattened = flattened_ray(ray);
        let mut nearest = self.graph.pyramid.intersect(self.graph.field, &flattened, f64::from(ray.tfar));
        for c in &self.same {
            let reach = nearest.map_or(ray.tfar, |h| h.t);
            let ray = Self::ray(c, &flattened, reach);
            let found = c.graph.pyramid.intersect(c.graph.field, &ray, f64::from(reach));
            if let Some(hit) = found.filter(|h| nearest.is_none_or(|n| h.t < n.t)) {
                nearest = Some(c.named(hit));
            }
        }
        nearest.map(user_hit)
    }

    #[inline]
    fn occluded(&self, _: u32, ray: &Ray) -> bool {
        let (flattened, reach) = (flattened_ray(ray), f64::from(ray.tfar));
        let hidden = |c: &CompanionGraph<'_>| {
            c.graph.pyramid.occluded(c.graph.field, &c.companion.ray_to_index(&flattened), reach)
        };
        self.graph.pyramid.occluded(self.graph.field, &flattened, reach) || self.same.iter().any(hidden)
    }

    #[inline]
    fn intersect16(&self, _: u32, active: u16, rays: &Ray16, hits: &mut UserHits16) -> u16 {
        let mut nearest = [None; 16];
        let ray = |lane: usize| flattened_ray(&rays.lane(lane));
        self.graph.pyramid.intersect16(self.graph.field, active, ray, &mut nearest);
        for c in &self.same {
            let mut found = [None; 16];
            let reach: [f32; 16] = std::array::from_fn(|i| nearest[i].map_or(rays.tfar[i], |h: FlattenedHit| h.t));
            let within = |lane: usize| Self::ray(c, &ray(lane), reach[lane]);
            c.graph.pyramid.intersect16(c.graph.field, active, within, &mut found);
            for (best, hit) in nearest.iter_mut().zip(found) {
                if let Some(hit) = hit.filter(|h| best.is_none_or(|b| h.t < b.t)) {
                    *best = Some(c.named(hit));
                }
            }
        }
        user_hits(nearest, hits)
    }

    #[inline]
    fn occluded16(&self, _: u32, active: u16, rays: &Ray16) -> u16 {
        let ray = |lane: usize| flattened_ray(&rays.lane(lane));
        let mut found = self.graph.pyramid.occluded16(self.graph.field, active, ray);
        for c in &self.same {
            let open = active & !found;
            found |= c.graph.pyramid.occluded16(c.graph.field, open, |lane| c.companion.ray_to_index(&ray(lane)));
        }
        found
    }
}
