//! Walls and luminaires as Embree user geometry, and rays as Embree carries them: what both tracers share.

use super::{BvhBuilder, Ray, UserGeometry, UserHit};
use crate::error::Result;
use crate::flattened::{Ends, FlattenedRay};
use crate::polygon::LocalPolygon;
use crate::scene::Scene;
use glam::{DVec3, Vec3};
use std::sync::Arc;

/// Boxes grow by this many cells, since Embree tests user geometry without its ROBUST care. 1e-3 lost no ray.
const PADDING: f64 = 1e-3;

/// Walls and luminaires, a primitive each.
#[derive(Debug)]
pub(super) struct Extrusions {
    polygons: Vec<LocalPolygon>,
}

/// The ray as Embree carries it.
#[inline]
pub(crate) fn embree_ray(ray: &FlattenedRay) -> Ray {
    let mut r = Ray::new(ray.origin.to_array(), ray.direction.to_array(), 0.0, ray.reach);
    r.id = ray.isovalue.to_bits();
    r.time = ray.pack_ends();
    r
}

/// The inverse of [`embree_ray`].
#[inline]
pub(crate) fn flattened_ray(r: &Ray) -> FlattenedRay {
    let Ends { departure, target, with_light } = FlattenedRay::unpack_ends(r.time);
    FlattenedRay {
        origin: Vec3::from_array(r.org),
        direction: Vec3::from_array(r.dir),
        isovalue: f32::from_bits(r.id),
        reach: r.tfar,
        departure,
        target,
        with_light,
    }
}

/// Box corners for Embree, grown by [`PADDING`].
#[allow(clippy::cast_possible_truncation, reason = "the padding covers f32 rounding")]
pub(crate) fn padded(lo: DVec3, hi: DVec3) -> ([f32; 3], [f32; 3]) {
    // Far from the origin an f32 step outgrows the padding in cells.
    let pad = PADDING.max(4.0 * f64::from(f32::EPSILON) * lo.abs().max(hi.abs()).max_element());
    ((lo - pad).as_vec3().to_array(), (hi + pad).as_vec3().to_array())
}

impl Extrusions {
    /// Adds the polygons of `scene`, if it has any; rays see them if `mask` and theirs share a bit.
    ///
    /// # Errors
    /// `Embree` if the library refuses.
    pub(super) fn attach(builder: &mut BvhBuilder<'_>, scene: &Scene, mask: u32) -> Result<Arc<Self>> {
        let polygons = scene.polygons().iter().map(|p| LocalPolygon::new(p, scene.lattice())).collect();
        let this = Arc::new(Self { polygons });
        if !scene.polygons().is_empty() {
            builder.user_shared(this.clone(), mask)?;
        }
        Ok(this)
    }

    /// The polygon that a ray met which met polygon `id`: another one only if it starts on both, where rounding would
    /// choose.
    #[inline]
    pub(super) fn settle(&self, ray: &FlattenedRay, id: u32) -> u32 {
        let (o, d) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
        match self.polygons[id as usize].starts_on(o, d) {
            None => id,
            Some(speed) => self.fastest(ray, id, speed),
        }
    }

    #[cold]
    fn fastest(&self, ray: &FlattenedRay, id: u32, speed: f64) -> u32 {
        let (o, d) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
        let mut best = (speed, id);
        for (n, polygon) in (0u32..).zip(&self.polygons) {
            // By rounding apart is the same: luminaires come first.
            if let Some(speed) = polygon.starts_on(o, d)
                && speed > best.0 * (1.0 + if n < best.1 { -1e-6 } else { 1e-6 })
                && polygon.meet(n, ray).is_some()
            {
                best = (speed, n);
            }
        }
        best.1
    }

    #[inline]
    fn meet(&self, prim: u32, ray: &Ray) -> Option<f64> {
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
    fn intersect(&self, prim: u32, ray: &Ray) -> Option<UserHit> {
        let t = (self.meet(prim, ray)? as f32).min(ray.tfar);
        Some(UserHit { t, u: 0.0, v: 0.0, normal: [0.0; 3] })
    }

    #[inline]
    fn occluded(&self, prim: u32, ray: &Ray) -> bool {
        self.meet(prim, ray).is_some()
    }
}
