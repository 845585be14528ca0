//! The rays and hits that are handed to Embree, generated from `wrapper/embree_abi.h`, and their layout as asserted.

/// What bindgen makes of `wrapper/embree_abi.h`.
#[allow(non_camel_case_types, non_snake_case, unreachable_pub, missing_docs, reason = "generated: the names are C's")]
#[allow(clippy::all, clippy::undocumented_unsafe_blocks, reason = "generated")]
pub(super) mod raw {
    include!(concat!(env!("OUT_DIR"), "/embree_abi.rs"));
}

pub use raw::{Hit, Hit16, Ray, Ray16, RayHit, RayHit16};
pub(super) use raw::{Ray8, RayHit8};

/// Embree's `RTC_INVALID_GEOMETRY_ID`: no geometry, no instance.
pub const INVALID_ID: u32 = u32::MAX;

// The layout of Embree's headers, 4.0 to 4.4 (the sizes of hits: at least). embree4-sys has 80 and 1280 bytes for the
// structs with hits, and a library from 4.3 on writes to bytes 80..84 and 1280..1344 (640..672 of eight).
const _: () = {
    use std::mem::{align_of, offset_of, size_of};
    assert!(size_of::<Ray>() == 48 && align_of::<Ray>() == 16);
    assert!(size_of::<RayHit>() == 96 && align_of::<RayHit>() == 16);
    assert!(size_of::<Ray16>() == 768 && align_of::<Ray16>() == 64);
    assert!(size_of::<RayHit16>() == 1344 && align_of::<RayHit16>() == 64);
    assert!(size_of::<Ray8>() == 384 && align_of::<Ray8>() == 32);
    assert!(size_of::<RayHit8>() == 672 && align_of::<RayHit8>() == 32);
    assert!(offset_of!(RayHit, hit) == 48 && offset_of!(RayHit8, hit) == 384 && offset_of!(RayHit16, hit) == 768);

    assert!(offset_of!(Ray, org) == offset_of!(embree4_sys::RTCRay, org_x));
    assert!(offset_of!(Ray, tnear) == offset_of!(embree4_sys::RTCRay, tnear));
    assert!(offset_of!(Ray, dir) == offset_of!(embree4_sys::RTCRay, dir_x));
    assert!(offset_of!(Ray, time) == offset_of!(embree4_sys::RTCRay, time));
    assert!(offset_of!(Ray, tfar) == offset_of!(embree4_sys::RTCRay, tfar));
    assert!(offset_of!(Ray, mask) == offset_of!(embree4_sys::RTCRay, mask));
    assert!(offset_of!(Ray, id) == offset_of!(embree4_sys::RTCRay, id));
    assert!(offset_of!(Ray, flags) == offset_of!(embree4_sys::RTCRay, flags));
    assert!(offset_of!(Hit, normal) == offset_of!(embree4_sys::RTCHit, Ng_x));
    assert!(offset_of!(Hit, u) == offset_of!(embree4_sys::RTCHit, u));
    assert!(offset_of!(Hit, v) == offset_of!(embree4_sys::RTCHit, v));
    assert!(offset_of!(Hit, prim) == offset_of!(embree4_sys::RTCHit, primID));
    assert!(offset_of!(Hit, geometry) == offset_of!(embree4_sys::RTCHit, geomID));
    assert!(offset_of!(Hit, instance) == offset_of!(embree4_sys::RTCHit, instID));
    assert!(offset_of!(Ray8, tfar) == offset_of!(embree4_sys::RTCRay8, tfar));
    assert!(offset_of!(Ray8, id) == offset_of!(embree4_sys::RTCRay8, id));
    assert!(offset_of!(raw::Hit8, geometry) == offset_of!(embree4_sys::RTCHit8, geomID));
    assert!(offset_of!(raw::Hit8, spare) == size_of::<embree4_sys::RTCHit8>());
    assert!(offset_of!(Ray16, tfar) == offset_of!(embree4_sys::RTCRay16, tfar));
    assert!(offset_of!(Ray16, id) == offset_of!(embree4_sys::RTCRay16, id));
    assert!(offset_of!(Hit16, geometry) == offset_of!(embree4_sys::RTCHit16, geomID));
    assert!(offset_of!(Hit16, spare) == size_of::<embree4_sys::RTCHit16>());
};

impl Ray {
    /// A ray from `org` along `dir` over (`tnear`, `tfar`), seen by every geometry; `id` and `time` are 0.
    #[inline]
    #[must_use]
    pub fn new(org: [f32; 3], dir: [f32; 3], tnear: f32, tfar: f32) -> Self {
        Self { org, tnear, dir, time: 0, tfar, mask: u32::MAX, id: 0, flags: 0 }
    }
}

impl RayHit {
    /// A ray that has hit nothing yet.
    #[inline]
    #[must_use]
    pub fn new(ray: Ray) -> Self {
        let hit = Hit {
            normal: [0.0; 3],
            u: 0.0,
            v: 0.0,
            prim: INVALID_ID,
            geometry: INVALID_ID,
            instance: INVALID_ID,
            spare: [INVALID_ID; 4],
        };
        Self { ray, hit }
    }

    /// Whether a query found something.
    #[inline]
    #[must_use]
    pub fn is_hit(&self) -> bool {
        self.hit.geometry != INVALID_ID
    }
}

impl Ray16 {
    /// Sixteen rays side by side.
    #[inline]
    #[must_use]
    pub fn new(rays: &[Ray; 16]) -> Self {
        let axis = |a: usize| -> [[f32; 16]; 2] {
            [std::array::from_fn(|i| rays[i].org[a]), std::array::from_fn(|i| rays[i].dir[a])]
        };
        let ([ox, dx], [oy, dy], [oz, dz]) = (axis(0), axis(1), axis(2));
        Self {
            org: [ox, oy, oz],
            tnear: std::array::from_fn(|i| rays[i].tnear),
            dir: [dx, dy, dz],
            time: std::array::from_fn(|i| rays[i].time),
            tfar: std::array::from_fn(|i| rays[i].tfar),
            mask: std::array::from_fn(|i| rays[i].mask),
            id: std::array::from_fn(|i| rays[i].id),
            flags: [0; 16],
        }
    }

    /// Ray number `lane`.
    ///
    /// # Panics
    /// If `lane` is 16 or more.
    #[inline]
    #[must_use]
    pub fn lane(&self, lane: usize) -> Ray {
        Ray {
            org: [self.org[0][lane], self.org[1][lane], self.org[2][lane]],
            tnear: self.tnear[lane],
            dir: [self.dir[0][lane], self.dir[1][lane], self.dir[2][lane]],
            time: self.time[lane],
            tfar: self.tfar[lane],
            mask: self.mask[lane],
            id: self.id[lane],
            flags: self.flags[lane],
        }
    }
}

/// One half of sixteen.
#[inline(always)]
fn half<T: Copy>(x: &[T; 16], half: usize) -> [T; 8] {
    std::array::from_fn(|i| x[8 * half + i])
}

/// Puts it back.
#[inline(always)]
fn put<T: Copy>(x: &mut [T; 16], half: usize, from: &[T; 8]) {
    x[8 * half..][..8].copy_from_slice(from);
}

impl Ray8 {
    /// The first or the second eight rays of sixteen.
    #[inline]
    pub(super) fn half_of(rays: &Ray16, n: usize) -> Self {
        Self {
            org: [half(&rays.org[0], n), half(&rays.org[1], n), half(&rays.org[2], n)],
            tnear: half(&rays.tnear, n),
            dir: [half(&rays.dir[0], n), half(&rays.dir[1], n), half(&rays.dir[2], n)],
            time: half(&rays.time, n),
            tfar: half(&rays.tfar, n),
            mask: half(&rays.mask, n),
            id: half(&rays.id, n),
            flags: half(&rays.flags, n),
        }
    }

    /// Puts back what an `occluded` query wrote.
    #[inline]
    pub(super) fn put_back(&self, rays: &mut Ray16, n: usize) {
        put(&mut rays.tfar, n, &self.tfar);
    }

    /// The same rays as the first eight of sixteen; the others are zero.
    #[inline]
    pub(super) fn widened(&self) -> Ray16 {
        fn wide<T: Copy + Default>(x: &[T; 8]) -> [T; 16] {
            std::array::from_fn(|i| if i < 8 { x[i] } else { T::default() })
        }
        Ray16 {
            org: [wide(&self.org[0]), wide(&self.org[1]), wide(&self.org[2])],
            tnear: wide(&self.tnear),
            dir: [wide(&self.dir[0]), wide(&self.dir[1]), wide(&self.dir[2])],
            time: wide(&self.time),
            tfar: wide(&self.tfar),
            mask: wide(&self.mask),
            id: wide(&self.id),
            flags: wide(&self.flags),
        }
    }
}

impl RayHit8 {
    /// The first or the second eight rays of sixteen, and their hits.
    #[inline]
    pub(super) fn half_of(all: &RayHit16, n: usize) -> Self {
        let hit = &all.hit;
        let hit = raw::Hit8 {
            normal: [half(&hit.normal[0], n), half(&hit.normal[1], n), half(&hit.normal[2], n)],
            u: half(&hit.u, n),
            v: half(&hit.v, n),
            prim: half(&hit.prim, n),
            geometry: half(&hit.geometry, n),
            instance: half(&hit.instance, n),
            spare: half(&hit.spare, n),
        };
        Self { ray: Ray8::half_of(&all.ray, n), hit }
    }

    /// Puts back what an `intersect` query wrote.
    #[inline]
    pub(super) fn put_back(&self, all: &mut RayHit16, n: usize) {
        self.ray.put_back(&mut all.ray, n);
        let (to, from) = (&mut all.hit, &self.hit);
        to.normal.iter_mut().zip(&from.normal).for_each(|(to, from)| put(to, n, from));
        put(&mut to.u, n, &from.u);
        put(&mut to.v, n, &from.v);
        put(&mut to.prim, n, &from.prim);
        put(&mut to.geometry, n, &from.geometry);
        put(&mut to.instance, n, &from.instance);
    }
}

impl RayHit16 {
    /// Sixteen rays that have hit nothing yet.
    #[inline]
    #[must_use]
    pub fn new(ray: Ray16) -> Self {
        let hit = Hit16 {
            normal: [[0.0; 16]; 3],
            u: [0.0; 16],
            v: [0.0; 16],
            prim: [INVALID_ID; 16],
            geometry: [INVALID_ID; 16],
            instance: [INVALID_ID; 16],
            spare: [INVALID_ID; 16],
        };
        Self { ray, hit }
    }
}

/// Which of sixteen rays take part in a query.
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Valid16([i32; 16]);

impl Valid16 {
    /// All sixteen.
    pub const ALL: Self = Self([-1; 16]);

    /// Ray i takes part if bit i is set.
    #[inline]
    #[must_use]
    pub fn from_bits(bits: u16) -> Self {
        Self(std::array::from_fn(|i| -i32::from(bits >> i & 1)))
    }

    /// The lanes as Embree reads them: −1 takes part, 0 does not. Aligned to 64 bytes.
    #[inline]
    pub(super) fn as_ptr(&self) -> *const i32 {
        self.0.as_ptr()
    }

    /// The same of the first or the second eight, aligned to 32 bytes; `None` if none of them takes part.
    #[inline]
    pub(super) fn half(&self, n: usize) -> Option<*const i32> {
        let half = &self.0[8 * n..][..8];
        half.iter().any(|&lane| lane != 0).then_some(half.as_ptr())
    }
}
