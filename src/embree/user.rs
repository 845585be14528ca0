//! Primitives of our own: what Embree calls back for, and what is reported to it.

use super::abi::{Ray, Ray16};

/// What a [`UserGeometry`] reports for the nearest hit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UserHit {
    /// Distance in units of the ray's `dir`. A hit outside [`tnear`, `tfar`], or NaN, is ignored.
    pub t: f32,
    /// First surface coordinate, handed on.
    pub u: f32,
    /// Second surface coordinate, handed on.
    pub v: f32,
    /// Normal, handed on.
    pub normal: [f32; 3],
}

/// What a [`UserGeometry`] reports for up to sixteen rays: [`UserHit`], one field after the other.
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UserHits16 {
    /// Distances.
    pub t: [f32; 16],
    /// First surface coordinates.
    pub u: [f32; 16],
    /// Second surface coordinates.
    pub v: [f32; 16],
    /// Normals: x of all hits, then y, then z.
    pub normal: [[f32; 16]; 3],
}

impl UserHits16 {
    /// All zero.
    pub const ZERO: Self = Self { t: [0.0; 16], u: [0.0; 16], v: [0.0; 16], normal: [[0.0; 16]; 3] };
}

/// Primitives that intersect rays themselves. The `time` and `id` of the rays they see hold whatever 32 bits the caller
/// of the query put there, bit for bit.
///
/// Embree calls these functions from C, on any thread, several at a time. **They must not panic:** a panic cannot
/// cross C, so that it aborts the process (those in `callbacks` are `extern "C"`, which aborts on unwinding since
/// Rust 1.81). They must not query a scene of their own geometry without end, and should not allocate: a query
/// of a scene with one primitive costs 10 to 25 ns besides what they do.
///
/// `intersect` and `occluded` must agree: the second is true exactly if the first finds a hit.
pub trait UserGeometry: Sync {
    /// The number of primitives. Asked once, when the geometry joins a scene.
    fn len(&self) -> u32;

    /// Whether there are no primitives.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The lower and upper corner of primitive `prim`'s box. Embree uses these numbers as they are, and tests rays
    /// against them without its ROBUST care, whatever the scene's flag says: grow them by what rounding can do.
    fn bounds(&self, prim: u32) -> ([f32; 3], [f32; 3]);

    /// The nearest hit within `tnear` and `tfar`. The ray need not meet the primitive's box: Embree does not test the
    /// box of a geometry that is alone in its scene with one primitive.
    fn intersect(&self, prim: u32, ray: &Ray) -> Option<UserHit>;

    /// Whether anything is hit within `tnear` and `tfar`.
    fn occluded(&self, prim: u32, ray: &Ray) -> bool;

    /// `intersect` for the rays whose bit is set in `active`; returns the bits of the rays that hit, and their hits in
    /// `hits` (whatever stands in the other lanes is ignored).
    ///
    /// Embree may split a packet: it is asked for eight rays at a time on a CPU with AVX2, and hands over single ones,
    /// to `intersect`, on one without.
    #[inline]
    fn intersect16(&self, prim: u32, active: u16, rays: &Ray16, hits: &mut UserHits16) -> u16 {
        let mut found = 0;
        for lane in (0..16).filter(|lane| active >> lane & 1 == 1) {
            if let Some(hit) = self.intersect(prim, &rays.lane(lane)) {
                hits.t[lane] = hit.t;
                hits.u[lane] = hit.u;
                hits.v[lane] = hit.v;
                for (all, one) in hits.normal.iter_mut().zip(hit.normal) {
                    all[lane] = one;
                }
                found |= 1 << lane;
            }
        }
        found
    }

    /// `occluded` for the rays whose bit is set in `active`; returns the bits of those that are.
    #[inline]
    fn occluded16(&self, prim: u32, active: u16, rays: &Ray16) -> u16 {
        (0..16)
            .filter(|lane| active >> lane & 1 == 1 && self.occluded(prim, &rays.lane(*lane)))
            .fold(0, |found, lane| found | 1 << lane)
    }
}
