//! One isosurface as ordinary Embree triangles, with the scene's polygons: [`SurfaceTracer`]. Of several fields, one
//! isosurface of each.
//!
//! A ray that departs from the surface starts within rounding of one or several triangles, the more so since receivers
//! stand on vertices. Offsetting such starts would move them by an amount of somebody's choice; instead the tracer asks
//! what the hits say about the start:
//! * Directions that go into the surface by the trilinear gradient of the cell they enter meet it at t = 0, as in
//!   [`super::GraphTracer`].
//! * A hit from the other side on a triangle whose plane holds the start within [`ROUNDING`] is the start itself: the
//!   ray goes on behind it. The same hit on any other triangle means that the ray began inside, below the triangles but
//!   not below the trilinear surface: it meets the surface at t = 0.
//! * A hit from the own side within `ROUNDING` of the start touches the fan of triangles around a vertex or an edge: it
//!   does not count, unless what follows shows that the ray went inside.

use super::extrusions::{Extrusions, embree_ray};
use super::{Bvh, BvhBuilder, Device, RayHit};
use crate::error::{Error, Result};
use crate::field::Field;
use crate::flattened::{Departure, FlattenedHit, FlattenedRay, Side, Target};
use crate::isosurface::{Isosurface, extract_refined};
use crate::scene::{Boundary, Scene};
use crate::tracer::Tracer;
use glam::{DVec3, Vec3};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Distance between a start and the plane of the triangle it stands on, in units of f32's epsilon times the largest
/// coordinate: ½ from rounding the point to f32, about 4 from t and Embree's own arithmetic, the rest to spare.
const ROUNDING: f64 = 16.0;

/// Ray masks: a bit for each mesh, one for the polygons.
const POLYGONS: u32 = 1 << 31;

#[inline]
fn bit(mesh: usize) -> u32 {
    1 << mesh
}

/// The ordinary 3D scene of one isovalue: the triangles of its isosurface, walls and luminaires.
#[derive(Debug)]
pub struct SurfaceTracer<'a> {
    bvh: Bvh<'a>,
    extrusions: Arc<Extrusions>,
    scene: &'a Scene,
    /// The scene's own mesh, then its companions', all in the local frame. Their geometries have the same numbers.
    meshes: Vec<Isosurface>,
    inside_starts: AtomicU64,
}

/// A query's nearest hit: the distance, and the mesh and its triangle with the side it was met from, or the polygon.
#[derive(Clone, Copy)]
enum Found {
    Triangle(f32, Met),
    Polygon(f32, u32),
}

#[derive(Clone, Copy)]
struct Met {
    mesh: usize,
    triangle: u32,
    side: Side,
}

/// The level set of mesh `mesh`, as targets name it.
#[inline]
#[allow(clippy::cast_possible_truncation, reason = "meshes are few")]
fn target(mesh: usize, side: Side) -> Target {
    match mesh.checked_sub(1) {
        None => Target::Surface(side),
        Some(n) => Target::Companion(n as u8, side),
    }
}

/// The mesh that a ray departs from, and the side it leaves into.
#[inline]
fn departing(ray: &FlattenedRay) -> Option<(usize, Side)> {
    match ray.departure {
        Departure::Surface(side) => Some((0, side)),
        Departure::Companion(n, side) => Some((usize::from(n) + 1, side)),
        _ => None,
    }
}

impl<'a> SurfaceTracer<'a> {
    /// Extracts the isosurface of each field at `isovalue` (units of the sweep), every cell cut into `refine`³, and
    /// commits them.
    ///
    /// # Errors
    /// From extraction; `NotSupported` for capped boundaries, whose caps are no triangles; `Embree`.
    pub fn new(device: &Device, scene: &'a Scene, isovalue: f32, refine: usize) -> Result<Self> {
        let extract = |field: &Field| extract_refined(field.lattice().dims(), field.samples(), isovalue, refine);
        let companions = scene.companions().iter().map(|c| extract(&c.member.field)).collect::<Result<_>>()?;
        Self::with_meshes(device, scene, extract(&scene.field)?, companions)
    }

    /// From meshes as extracted: index coordinates, triangles counter-clockwise seen from the lower side.
    fn with_meshes(device: &Device, scene: &'a Scene, own: Isosurface, companions: Vec<Isosurface>) -> Result<Self> {
        let boundaries = scene.companions().iter().map(|c| c.member.boundary);
        if boundaries.chain([scene.boundary]).any(|b| b == Boundary::Capped) {
            return Err(Error::NotSupported(
                "boundary = \"capped\": triangles hold no caps; trace the trilinear surface instead (--trilinear)"
                    .into(),
            ));
        }
        let mut meshes = vec![own];
        for (mut mesh, companion) in companions.into_iter().zip(scene.companions()) {
            mesh.vertices.iter_mut().for_each(|v| *v = companion.to_local(*v));
            if companion.flips() {
                mesh.triangles.iter_mut().for_each(|t| t.swap(1, 2));
            }
            meshes.push(mesh);
        }
        let mut builder = BvhBuilder::new(device)?;
        for (n, mesh) in meshes.iter().enumerate() {
            let vertices: Vec<[f32; 3]> = mesh.vertices.iter().map(|v| v.as_vec3().to_array()).collect();
            builder.triangles(&vertices, &mesh.triangles, bit(n))?;
        }
        let extrusions = Extrusions::attach(&mut builder, scene, POLYGONS)?;
        let bvh = builder.commit()?;
        Ok(Self { bvh, extrusions, scene, meshes, inside_starts: AtomicU64::new(0) })
    }

    /// The scene's own mesh, in index coordinates, counter-clockwise from the lower side.
    pub fn mesh(&self) -> &Isosurface {
        &self.meshes[0]
    }

    /// The field of a mesh, and a local position in its index space.
    #[inline]
    fn field(&self, mesh: usize, p: DVec3) -> (&Field, DVec3) {
        match mesh.checked_sub(1) {
            None => (&self.scene.field, p),
            Some(n) => {
                let c = &self.scene.companions()[n];
                (&c.member.field, c.to_index(p))
            }
        }
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
        let mesh = rayhit.hit.geometry as usize;
        if mesh >= self.meshes.len() {
            return Some(Found::Polygon(t, self.extrusions.settle(ray, prim)));
        }
        let against = Vec3::from_array(rayhit.hit.normal).dot(ray.direction) < 0.0;
        let side = if against { Side::Lower } else { Side::Higher };
        Some(Found::Triangle(t, Met { mesh, triangle: prim, side }))
    }

    /// Whether a ray that starts on the surface goes to `side` by the trilinear gradient of the cell it enters.
    #[inline]
    fn leaves(&self, ray: &FlattenedRay, (mesh, side): (usize, Side)) -> bool {
        let d = ray.direction.as_dvec3();
        let p = ray.origin.as_dvec3() + d * (1e-9 / d.abs().max_element());
        let (field, p) = self.field(mesh, p);
        let rise = field.gradient(p).dot(self.scene.lattice().axes() * d);
        // NaN: no opinion.
        if side == Side::Lower { !(rise > 0.0) } else { !(rise < 0.0) }
    }

    /// The hit of a ray that departs from a mesh into a side of it, whose first hit on that mesh is `first`.
    #[cold]
    fn settle(&self, ray: &FlattenedRay, (own, side): (usize, Side), first: (f32, Met)) -> Option<FlattenedHit> {
        let begun_inside = || {
            self.inside_starts.fetch_add(1, Ordering::Relaxed);
            Some(FlattenedHit { t: 0.0, target: target(own, side) })
        };
        let o = ray.origin.as_dvec3();
        let rounding = ROUNDING * f64::from(f32::EPSILON) * o.abs().max_element().max(1.0);
        let touching = 4.0 * rounding / ray.direction.as_dvec3().length();
        let other = self.query(ray, !bit(own), 0.0, ray.reach);
        let reach = other.map_or(ray.reach, |p| decode(p).t);
        let mut entered = false;
        let (mut t, mut met) = first;
        // A fan has a few triangles; a ray along a flat piece of surface may cross more that hold its start.
        for _ in 0..64 {
            let mesh = &self.meshes[own];
            let [a, b, c] = mesh.triangles[met.triangle as usize].map(|v| mesh.vertices[v as usize]);
            let normal = (b - a).cross(c - a).normalize_or_zero();
            let holds = normal.dot(o - a).abs() <= rounding;
            if met.side == side {
                if !(holds && f64::from(t) <= touching) {
                    return Some(FlattenedHit { t, target: target(own, side) });
                }
                entered = true;
            } else if !holds {
                return begun_inside();
            }
            match self.query(ray, bit(own), t.next_up(), reach) {
                Some(Found::Triangle(next, m)) => (t, met) = (next, m),
                _ => break,
            }
        }
        // The ray touched the surface from its own side and met nothing of it since: the values on its way tell where
        // it is.
        if entered && reach.is_finite() {
            let (field, p) = self.field(own, o + ray.direction.as_dvec3() * (0.5 * f64::from(reach)));
            let h = field.value(p);
            if (h >= f64::from(ray.isovalue)) != (side == Side::Higher) {
                return begun_inside();
            }
        }
        other.map(decode)
    }
}

#[inline]
fn decode(found: Found) -> FlattenedHit {
    match found {
        Found::Triangle(t, met) => FlattenedHit { t, target: target(met.mesh, met.side) },
        Found::Polygon(t, id) => FlattenedHit { t, target: Target::Polygon(id) },
    }
}

impl Tracer for SurfaceTracer<'_> {
    #[inline]
    fn intersect(&self, ray: &FlattenedRay) -> Option<FlattenedHit> {
        let Some(own) = departing(ray) else {
            return self.query(ray, u32::MAX, 0.0, ray.reach).map(decode);
        };
        if !self.leaves(ray, own) {
            return Some(FlattenedHit { t: 0.0, target: target(own.0, own.1) });
        }
        match self.query(ray, u32::MAX, 0.0, ray.reach)? {
            Found::Triangle(t, met) if met.mesh == own.0 => self.settle(ray, own, (t, met)),
            other => Some(decode(other)),
        }
    }

    #[inline]
    fn occluded(&self, ray: &FlattenedRay) -> bool {
        let own = departing(ray);
        if own.is_some_and(|own| !self.leaves(ray, own)) {
            return true;
        }
        // Nothing on the way at all settles it; something may be the start itself.
        self.bvh.occluded1(&mut embree_ray(ray)) && (own.is_none() || self.intersect(ray).is_some())
    }
}
