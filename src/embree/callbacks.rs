//! What Embree calls, from C: the functions of a [`UserGeometry`], for single rays and packets.

use super::abi::{Hit, INVALID_ID, Ray, Ray8, Ray16};
use super::user::{UserGeometry, UserHit, UserHits16};
use embree4_sys::{RTCBoundsFunctionArguments, RTCIntersectFunctionNArguments, RTCOccludedFunctionNArguments};

// A packet of N rays and hits is 12 + 8 (or 9) fields of N 32-bit words. The field numbers:
const TNEAR: usize = std::mem::offset_of!(Ray, tnear) / 4;
const TFAR: usize = std::mem::offset_of!(Ray, tfar) / 4;
const HIT: usize = size_of::<Ray>() / 4;
const NORMAL: usize = HIT + std::mem::offset_of!(Hit, normal) / 4;
const U: usize = HIT + std::mem::offset_of!(Hit, u) / 4;
const V: usize = HIT + std::mem::offset_of!(Hit, v) / 4;
const PRIM: usize = HIT + std::mem::offset_of!(Hit, prim) / 4;
const GEOMETRY: usize = HIT + std::mem::offset_of!(Hit, geometry) / 4;
const INSTANCE: usize = HIT + std::mem::offset_of!(Hit, instance) / 4;

/// The box of a primitive.
///
/// # Safety
/// Embree calls it with the arguments and the user pointer that it was registered with.
pub(super) unsafe extern "C" fn bounds<G: UserGeometry>(args: *const RTCBoundsFunctionArguments) {
    // SAFETY: Embree passes a valid struct; `geometryUserPtr` is the `*const G` that `BvhBuilder` stored, live
    // and shared by its contract; `bounds_o` is Embree's own room for one RTCBounds.
    unsafe {
        let args = &*args;
        let (lower, upper) = (*args.geometryUserPtr.cast::<G>()).bounds(args.primID);
        args.bounds_o.write(embree4_sys::RTCBounds {
            lower_x: lower[0],
            lower_y: lower[1],
            lower_z: lower[2],
            align0: 0.0,
            upper_x: upper[0],
            upper_y: upper[1],
            upper_z: upper[2],
            align1: 0.0,
        });
    }
}

/// The nearest hits of a ray, or of a packet's.
///
/// # Safety
/// As `bounds`.
pub(super) unsafe extern "C" fn intersect<G: UserGeometry>(args: *const RTCIntersectFunctionNArguments) {
    // SAFETY: Embree passes a valid struct, the same in 4.0 to 4.4; `geometryUserPtr` is the `*const G` that
    // `BvhBuilder` stored, live and shared by its contract.
    let (args, data) = unsafe { (&*args, &*(*args).geometryUserPtr.cast::<G>()) };
    let (n, base) = (args.N as usize, args.rayhit.cast::<u32>());
    let mut room = None;
    if n == 1 {
        let ray = base.cast::<Ray>();
        // SAFETY: with N = 1 `rayhit` is the 16-byte aligned ray and hit of a single-ray query, nobody else
        // uses it during this call, and the shared reference ends with `intersect`.
        let found = unsafe { data.intersect(args.primID, &*ray) };
        if let Some(hit) = found {
            // SAFETY: as above.
            unsafe { accept(base, 1, 0, &hit, args.primID, args.geomID) };
        }
    // SAFETY: `base` is a packet of N rays that nobody writes to until the last use of `rays`.
    } else if let Some(rays) = unsafe { sixteen(base, n, &mut room) } {
        // SAFETY: `valid` has N entries.
        let active = unsafe { active(args.valid, n) };
        let mut hits = UserHits16::ZERO;
        let found = active & data.intersect16(args.primID, active, rays, &mut hits);
        for lane in (0..n).filter(|lane| found >> lane & 1 == 1) {
            let hit = UserHit {
                t: hits.t[lane],
                u: hits.u[lane],
                v: hits.v[lane],
                normal: [hits.normal[0][lane], hits.normal[1][lane], hits.normal[2][lane]],
            };
            // SAFETY: `base` is a packet of N rays and hits, `lane` < N.
            unsafe { accept(base, n, lane, &hit, args.primID, args.geomID) };
        }
    } else {
        for lane in 0..n {
            // SAFETY: `valid` has N entries, `base` is a packet of N rays and hits, `lane` < N.
            unsafe {
                if args.valid.add(lane).read() == 0 {
                    continue;
                }
                if let Some(hit) = data.intersect(args.primID, &lane_of(base, n, lane)) {
                    accept(base, n, lane, &hit, args.primID, args.geomID);
                }
            }
        }
    }
}

/// Whether a ray, or each of a packet's, meets anything.
///
/// # Safety
/// As `bounds`.
pub(super) unsafe extern "C" fn occluded<G: UserGeometry>(args: *const RTCOccludedFunctionNArguments) {
    // SAFETY: as in `intersect`.
    let (args, data) = unsafe { (&*args, &*(*args).geometryUserPtr.cast::<G>()) };
    let (n, base) = (args.N as usize, args.ray.cast::<u32>());
    let mut room = None;
    if n == 1 {
        let ray = base.cast::<Ray>();
        // SAFETY: as in `intersect`, without a hit behind the ray.
        unsafe {
            if data.occluded(args.primID, &*ray) {
                (&raw mut (*ray).tfar).write(f32::NEG_INFINITY);
            }
        }
    // SAFETY: as in `intersect`.
    } else if let Some(rays) = unsafe { sixteen(base, n, &mut room) } {
        // SAFETY: `valid` has N entries.
        let active = unsafe { active(args.valid, n) };
        let found = active & data.occluded16(args.primID, active, rays);
        for lane in (0..n).filter(|lane| found >> lane & 1 == 1) {
            // SAFETY: `base` is a packet of N rays, `lane` < N.
            unsafe { base.add(TFAR * n + lane).write(f32::NEG_INFINITY.to_bits()) };
        }
    } else {
        for lane in 0..n {
            // SAFETY: `valid` has N entries, `base` is a packet of N rays, `lane` < N.
            unsafe {
                if args.valid.add(lane).read() != 0 && data.occluded(args.primID, &lane_of(base, n, lane)) {
                    base.add(TFAR * n + lane).write(f32::NEG_INFINITY.to_bits());
                }
            }
        }
    }
}

/// Writes `hit` into lane `lane` of a packet of `n`, if it lies within the ray.
///
/// Only the fields that every Embree 4 has are touched: inside a callback the packet may be Embree's own copy, without
/// the spare bytes of `Hit`.
///
/// # Safety
/// `base` points to a packet of `n` rays and hits that nobody else uses; `lane < n`.
#[inline]
unsafe fn accept(base: *mut u32, n: usize, lane: usize, hit: &UserHit, prim: u32, geometry: u32) {
    // SAFETY: the fields are within the packet (their numbers are below 20) and words are 4-byte aligned in it.
    unsafe {
        let word = |field: usize| base.add(field * n + lane);
        let (tnear, tfar) = (f32::from_bits(word(TNEAR).read()), f32::from_bits(word(TFAR).read()));
        // Also refuses NaN, which would end the traversal in an unknown state.
        if !(hit.t >= tnear && hit.t <= tfar) {
            return;
        }
        word(TFAR).write(hit.t.to_bits());
        for (a, x) in hit.normal.iter().enumerate() {
            word(NORMAL + a).write(x.to_bits());
        }
        word(U).write(hit.u.to_bits());
        word(V).write(hit.v.to_bits());
        word(PRIM).write(prim);
        word(GEOMETRY).write(geometry);
        word(INSTANCE).write(INVALID_ID);
    }
}

/// Ray `lane` of a packet of `n`.
///
/// # Safety
/// `base` points to a packet of `n` rays; `lane < n`.
#[inline]
unsafe fn lane_of(base: *const u32, n: usize, lane: usize) -> Ray {
    // SAFETY: a ray has 12 fields, all within the packet; Ray is those twelve words, and any bits are valid in them.
    unsafe {
        let words: [u32; 12] = std::array::from_fn(|field| base.add(field * n + lane).read());
        std::mem::transmute::<[u32; 12], Ray>(words)
    }
}

/// The rays of a packet of sixteen, or of eight, which are widened into `room`; `None` for other packets.
///
/// # Safety
/// `base` points to a packet of `n` rays that is not written to while the result is used.
#[inline]
unsafe fn sixteen(base: *const u32, n: usize, room: &mut Option<Ray16>) -> Option<&Ray16> {
    // SAFETY: sixteen rays are a Ray16, eight a Ray8, if they are aligned; any bits are valid in them.
    unsafe {
        match n {
            16 if base.cast::<Ray16>().is_aligned() => Some(&*base.cast::<Ray16>()),
            8 if base.cast::<Ray8>().is_aligned() => Some(room.insert((*base.cast::<Ray8>()).widened())),
            _ => None,
        }
    }
}

/// Bit i is set if `valid[i]` is not 0.
///
/// # Safety
/// `valid` points to `n` values, 16 at most.
#[inline]
unsafe fn active(valid: *const i32, n: usize) -> u16 {
    // SAFETY: the caller's promise; i32 alignment is Embree's.
    let valid = unsafe { std::slice::from_raw_parts(valid, n) };
    valid.iter().enumerate().fold(0, |bits, (i, &v)| bits | u16::from(v != 0) << i)
}
