//! One isosurface as ordinary Embree triangles, with the scene's polygons: [`SurfaceTracer`].
//!
//! A ray that departs from the surface starts within rounding of one or several triangles, the more so since receivers
//! stand on vertices. Offsetting such starts would move them by an amount of somebody's choice; instead the tracer asks
//! what the hits say about the start:
//! * Directions that go into the surface by the trilinear gradient of the cell they enter meet it at t = 0, as in
//!   [`super::GraphTracer`].
//! * A hit from the other side on a triangle whose plane holds the start within [`ROUNDING`] is the start itself: the ray
//!   goes on behind it. The same hit on any other triangle means that the ray began inside, below the triangles but not
//!   below the trilinear surface: it meets the surface at t = 0.
//! * A hit from the own side within `ROUNDING` of the start touches the fan of triangles around a vertex or an edge: it
//!   does not count, unless what follows shows that the ray went inside.

use super::extrusions::{Extrusions, embree_ray};
use super::{Device, RayHit, Scene as Bvh, SceneBuilder};
use crate::error::{Error, Result};
use crate::field::Field;
use crate::flattened::{Departure, FlattenedHit, FlattenedRay, Side, Target};
use crate::isosurface::{Isosurface, extract_refined};
use crate::scene::{Boundary, Scene};
use crate::tracer::Tracer;
use glam::Vec3;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Distance between a start and the plane of the triangle it stands on, in units of f32's epsilon times the largest
/// coordinate: ½ from rounding the point to f32, about 4 from t and Embree's own arithmetic, the rest to spare.
const ROUNDING: f64 = 16.0;

/// Ray masks.
const TRIANGLES: u32 = 1;
const POLYGONS: u32 = 2;

/// The ordinary 3D scene of one isovalue: the triangles of its isosurface, walls and luminaires.
pub struct SurfaceTracer<'a> {
    bvh: Bvh<'a>,
    triangles: u32,
    extrusions: Arc<Extrusions>,
    field: &'a Field,
    mesh: Isosurface,
    inside_starts: AtomicU64,
}

/// A query's nearest hit: the distance, and the triangle with the side it was met from, or the polygon.
#[derive(Clone, Copy)]
enum Found {
    Triangle(f32, u32, Side),
    Polygon(f32, u32),
}

impl<'a> SurfaceTracer<'a> {
    /// Extracts the isosurface at `isovalue` (units of the sweep), every cell cut into `refine`³, and commits it.
    ///
    /// # Errors
    /// From extraction; `NotSupported` for capped boundaries, whose caps are no triangles; `Embree`.
    pub fn new(device: &Device, scene: &'a Scene, isovalue: f32, refine: usize) -> Result<Self> {
        let mesh = extract_refined(scene.lattice().dims(), scene.field.samples(), isovalue, refine)?;
        Self::with_mesh(device, scene, mesh)
    }

    /// As [`SurfaceTracer::new`] with a mesh as [`crate::isosurface::extract`] gives it: index coordinates, triangles
    /// counter-clockwise seen from the lower side, not flipped.
    ///
    /// # Errors
    /// As [`SurfaceTracer::new`].
    pub fn with_mesh(device: &Device, scene: &'a Scene, mesh: Isosurface) -> Result<Self> {
        if scene.boundary == Boundary::Capped {
            return Err(Error::NotSupported(
                "boundary = \"capped\": triangles hold no caps; trace the trilinear surface instead (--trilinear)"
                    .into(),
            ));
        }
        let vertices: Vec<[f32; 3]> = mesh.vertices.iter().map(|v| v.as_vec3().to_array()).collect();
        let mut builder = SceneBuilder::new(device)?;
        let triangles = builder.triangles(&vertices, &mesh.triangles, TRIANGLES)?;
        let extrusions = Extrusions::attach(&mut builder, scene, POLYGONS)?;
        let bvh = builder.commit()?;
        Ok(Self { bvh, triangles, extrusions, field: &scene.field, mesh, inside_starts: AtomicU64::new(0) })
    }

    /// The mesh, in index coordinates, counter-clockwise from the lower side.
    pub fn mesh(&self) -> &Isosurface {
        &self.mesh
    }

    /// Rays so far that departed from the surface below its triangles.
    pub fn inside_starts(&self) -> u64 {
        self.inside_starts.load(Ordering::Relaxed)
    }

    /// The nearest hit among the geometries of `mask` within [`from`, `reach`].
    #[inline]
    fn query(&self, ray: &FlattenedRay, mask: u32, from: f32, reach: f32) -> Option<Found> {
        let mut r = embree_ray(ray);
        (r.mask, r.tnear, r.tfar) = (mask, from, reach);
        let mut rayhit = RayHit::new(r);
        self.bvh.intersect1(&mut rayhit);
        if !rayhit.is_hit() {
            return None;
        }
        let (t, prim) = (rayhit.ray.tfar, rayhit.hit.prim);
        if rayhit.hit.geometry != self.triangles {
            return Some(Found::Polygon(t, self.extrusions.settle(ray, prim)));
        }
        let against = Vec3::from_array(rayhit.hit.normal).dot(ray.direction) < 0.0;
        Some(Found::Triangle(t, prim, if against { Side::Lower } else { Side::Higher }))
    }

    /// Whether a ray that starts on the surface goes to `side` by the trilinear gradient of the cell it enters.
    #[inline]
    fn leaves(&self, ray: &FlattenedRay, side: Side) -> bool {
        let d = ray.direction.as_dvec3();
        let p = ray.origin.as_dvec3() + d * (1e-9 / d.abs().max_element());
        let rise = self.field.gradient(p).dot(self.field.lattice().axes() * d);
        // NaN: no opinion.
        if side == Side::Lower { !(rise > 0.0) } else { !(rise < 0.0) }
    }

    /// The hit of a ray that departs into `side`, whose first hit is the triangle hit `first`.
    #[cold]
    fn settle(&self, ray: &FlattenedRay, side: Side, first: (f32, u32, Side)) -> Option<FlattenedHit> {
        let begun_inside = || {
            self.inside_starts.fetch_add(1, Ordering::Relaxed);
            Some(FlattenedHit { t: 0.0, target: Target::Surface(side) })
        };
        let o = ray.origin.as_dvec3();
        let rounding = ROUNDING * f64::from(f32::EPSILON) * o.abs().max_element().max(1.0);
        let touching = 4.0 * rounding / ray.direction.as_dvec3().length();
        let polygon = self.query(ray, POLYGONS, 0.0, ray.reach);
        let reach = polygon.map_or(ray.reach, |p| decode(p).t);
        let mut entered = false;
        let (mut t, mut prim, mut met) = first;
        // A fan has a few triangles; a ray along a flat piece of surface may cross more that hold its start.
        for _ in 0..64 {
            let [a, b, c] = self.mesh.triangles[prim as usize].map(|v| self.mesh.vertices[v as usize]);
            let normal = (b - a).cross(c - a).normalize_or_zero();
            let own = normal.dot(o - a).abs() <= rounding;
            if met == side {
                if !(own && f64::from(t) <= touching) {
                    return Some(FlattenedHit { t, target: Target::Surface(side) });
                }
                entered = true;
            } else if !own {
                return begun_inside();
            }
            match self.query(ray, TRIANGLES, t.next_up(), reach) {
                Some(Found::Triangle(next, p, s)) => (t, prim, met) = (next, p, s),
                _ => break,
            }
        }
        // The ray touched the surface from its own side and met nothing of it since: the values on its way tell where it is.
        if entered && reach.is_finite() {
            let h = self.field.value(o + ray.direction.as_dvec3() * (0.5 * f64::from(reach)));
            if (h >= f64::from(ray.isovalue)) != (side == Side::Higher) {
                return begun_inside();
            }
        }
        polygon.map(decode)
    }
}

#[inline]
fn decode(found: Found) -> FlattenedHit {
    match found {
        Found::Triangle(t, _, side) => FlattenedHit { t, target: Target::Surface(side) },
        Found::Polygon(t, id) => FlattenedHit { t, target: Target::Polygon(id) },
    }
}

impl Tracer for SurfaceTracer<'_> {
    #[inline]
    fn intersect(&self, ray: &FlattenedRay) -> Option<FlattenedHit> {
        let Departure::Surface(side) = ray.departure else {
            return self.query(ray, u32::MAX, 0.0, ray.reach).map(decode);
        };
        if !self.leaves(ray, side) {
            return Some(FlattenedHit { t: 0.0, target: Target::Surface(side) });
        }
        match self.query(ray, u32::MAX, 0.0, ray.reach)? {
            Found::Triangle(t, prim, met) => self.settle(ray, side, (t, prim, met)),
            polygon => Some(decode(polygon)),
        }
    }

    #[inline]
    fn occluded(&self, ray: &FlattenedRay) -> bool {
        if let Departure::Surface(side) = ray.departure
            && !self.leaves(ray, side)
        {
            return true;
        }
        // Nothing on the way at all settles it; something may be the start itself.
        self.bvh.occluded1(&mut embree_ray(ray))
            && (!matches!(ray.departure, Departure::Surface(_)) || self.intersect(ray).is_some())
    }
}
