//! The min/max hierarchy over all cells, valid for every isovalue, and the walk of a flattened ray through it.
//!
//! The walk is watertight by signs (design: geometry): it goes from face crossing to face crossing, the state at a
//! crossing (inside: h ≥ c) comes from an expression both neighbours share, and a cell whose two crossings differ
//! *must* give a hit. Blocks whose range excludes c are skipped whole; all their samples are on one side, so the
//! state on their faces needs no arithmetic.

use crate::cell::Cell;
use crate::field::Field;
use crate::flattened::{Departure, FlattenedHit, FlattenedRay, Side, Target};
use glam::DVec3;
use rayon::prelude::*;

/// log₂ of the cells along an edge of a level's block: cells themselves, then 4, 16, 64.
const SHIFTS: [u32; 4] = [0, 2, 4, 6];
const TOP: usize = SHIFTS.len() - 1;

/// Ranges of one level: 16-bit minimum in the low half, maximum in the high half; x fastest.
#[derive(Clone, Debug)]
struct Level {
    dims: [usize; 3],
    ranges: Vec<u32>,
}

/// Min/max of h over cells and blocks of 4³, 16³, 64³ cells, quantised to 16 bits over the sweep, rounded so that no
/// block that holds a piece of L(h, c) is ever excluded. 4.07 bytes per cell.
#[derive(Clone, Debug)]
pub struct Pyramid {
    levels: [Level; SHIFTS.len()],
    capped: bool,
}

/// The range of a block without surface: excludes every c.
const EMPTY: u32 = 0x0000_ffff;

/// A monotone map of isovalues to 16 bits; everything outside the sweep clamps, NaN is 0.
#[inline]
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "the cast saturates")]
fn quantise(s: f32) -> u32 {
    u32::from((s * 65535.0) as u16)
}

#[inline]
fn excludes(range: u32, c: u32) -> bool {
    c < (range & 0xffff) || c > range >> 16
}

#[inline]
fn union(a: u32, b: u32) -> u32 {
    (a & 0xffff).min(b & 0xffff) | (a >> 16).max(b >> 16) << 16
}

impl Pyramid {
    /// Builds all levels in one pass over the samples and one over each finer level. Cells that touch a non-finite
    /// sample hold no surface. `capped`: outside Ω counts as below every c, so Ω's faces close what they cut.
    pub fn new(field: &Field, capped: bool) -> Self {
        let [nx, ny, _] = field.lattice().dims();
        let cells = field.lattice().cells();
        let samples = field.samples();
        let mut ranges = vec![EMPTY; cells.iter().product()];
        ranges.par_chunks_mut(cells[0] * cells[1]).enumerate().for_each(|(k, slab)| {
            // Columns of four samples (2×2 over y and z) are shared by the two cells beside them.
            for j in 0..cells[1] {
                let row = |dy: usize, dz: usize| &samples[((k + dz) * ny + j + dy) * nx..][..nx];
                let rows = [row(0, 0), row(1, 0), row(0, 1), row(1, 1)];
                let column = |i: usize| {
                    let [a, b, c, d] = rows.map(|r| r[i]);
                    (a.min(b).min(c.min(d)), a.max(b).max(c.max(d)), (a + b) + (c + d))
                };
                let mut left = column(0);
                for (i, range) in slab[j * cells[0]..][..cells[0]].iter_mut().enumerate() {
                    let right = column(i + 1);
                    // A sum is NaN if a sample is: min and max would hide it.
                    if !(left.2 + right.2).is_nan() {
                        *range = quantise(left.0.min(right.0)) | quantise(left.1.max(right.1)) << 16;
                    }
                    left = right;
                }
            }
        });
        let finest = Level { dims: cells, ranges };
        let second = coarser(&finest, 4);
        let third = coarser(&second, 4);
        let fourth = coarser(&third, 4);
        Self { levels: [finest, second, third, fourth], capped }
    }

    /// Bytes of all levels.
    pub fn bytes(&self) -> usize {
        self.levels.iter().map(|l| 4 * l.ranges.len()).sum()
    }

    /// The first hit of `ray` with t ≤ `reach`, or `None`. `field` must be the one the pyramid was built from.
    #[inline]
    pub fn intersect(&self, field: &Field, ray: &FlattenedRay, reach: f64) -> Option<FlattenedHit> {
        self.walk::<false>(field, ray, reach)
    }

    /// Whether [`Pyramid::intersect`] would find a hit; cheaper, since a sign change inside the reach proves one.
    #[inline]
    pub fn occluded(&self, field: &Field, ray: &FlattenedRay, reach: f64) -> bool {
        self.walk::<true>(field, ray, reach).is_some()
    }

    /// The walk. With `ANY`, the t of the hit is only a bound.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped cell numbers; t leaves as f32")]
    fn walk<const ANY: bool>(&self, field: &Field, ray: &FlattenedRay, reach: f64) -> Option<FlattenedHit> {
        let n = self.levels[0].dims;
        let mut o = ray.origin.as_dvec3().to_array();
        let d = ray.direction.as_dvec3().to_array();
        if let Departure::Cap(face, side) = ray.departure {
            let (axis, far) = (usize::from(face % 3), face >= 3);
            let inward = if far { d[axis] < 0.0 } else { d[axis] > 0.0 };
            if inward != (side == Side::Higher) && d[axis] != 0.0 {
                return Some(FlattenedHit { t: 0.0, target: cap(axis, far, side) });
            }
            if side == Side::Lower {
                // Ω is convex: what leaves it never comes back.
                return None;
            }
            o[axis] = if far { n[axis] as f64 } else { 0.0 };
        }
        let inv = d.map(|x| 1.0 / x);
        // Clip to Ω. A component 0 (or −0) never crosses a plane: its slab holds the whole line or nothing of it.
        let (mut t, mut t_out, mut entry, mut exit) = (0f64, reach, None, 0);
        for a in 0..3 {
            let far = n[a] as f64;
            if d[a] == 0.0 {
                if !(o[a] >= 0.0 && o[a] <= far) {
                    return None;
                }
                continue;
            }
            let (near_plane, far_plane) = if d[a] > 0.0 { (0.0, far) } else { (far, 0.0) };
            let t0 = (near_plane - o[a]) * inv[a];
            if t0 > t {
                (t, entry) = (t0, Some(a));
            }
            let t1 = (far_plane - o[a]) * inv[a];
            if t1 < t_out {
                (t_out, exit) = (t1, a);
            }
        }
        if !(t <= t_out) || d == [0.0; 3] {
            return None;
        }
        if let (Departure::Surface(side), true) = (ray.departure, t_out == 0.0 && reach > 0.0) {
            // It leaves Ω where it starts. There h = c counts as inside, which must not end a ray from the lower side.
            let closed = self.capped && side == Side::Higher;
            return closed.then(|| FlattenedHit { t: 0.0, target: cap(exit, d[exit] > 0.0, side) });
        }
        let mut cell = [0i64; 3];
        for a in 0..3 {
            let p = o[a] + t * d[a];
            // On a shared plane the ray is in the cell it goes to.
            let below = d[a] < 0.0 && p == p.floor();
            cell[a] = (p.floor() as i64 - i64::from(below)).clamp(0, n[a] as i64 - 1);
        }

        // The isovalue: h at the start if the ray starts on the surface, so that its root there is exactly 0.
        let mut c = f64::from(ray.isovalue);
        let mut departing = None;
        if let (Departure::Surface(side), None) = (ray.departure, entry) {
            let local = DVec3::from_array(std::array::from_fn(|a| (o[a] - cell[a] as f64).clamp(0.0, 1.0)));
            let here = Cell { s: field.corners(cell.map(|i| i as usize)) }.value(local);
            if here.is_finite() {
                c = here;
                departing = Some(side);
            }
        }
        let quantised = quantise(c as f32);

        // The state at the current crossing where known; a skipped block leaves it open, since it may hold NaN cells.
        let mut inside: Option<bool> = None;
        if let (Some(axis), true) = (entry, self.capped) {
            let corners = Cell { s: field.corners(cell.map(|i| i as usize)) };
            if crossing_inside(&corners, axis, d[axis] < 0.0, cell, &o, &d, t, c) {
                return Some(FlattenedHit { t: t as f32, target: cap(axis, d[axis] < 0.0, Side::Lower) });
            }
        }
        let mut level = TOP;
        loop {
            let shift = SHIFTS[level];
            let grid = &self.levels[level];
            let block = cell.map(|i| i as usize >> shift);
            let range = grid.ranges[(block[2] * grid.dims[1] + block[1]) * grid.dims[0] + block[0]];
            let skip = departing.is_none() && excludes(range, quantised);
            if !skip && level > 0 {
                level -= 1;
                continue;
            }

            // Where the ray leaves the block.
            let (mut axis, mut t_exit) = (0, f64::INFINITY);
            for a in 0..3 {
                if d[a] != 0.0 {
                    let plane = if d[a] > 0.0 { ((block[a] + 1) << shift).min(n[a]) } else { block[a] << shift };
                    let t_plane = (plane as f64 - o[a]) * inv[a];
                    if t_plane < t_exit {
                        (axis, t_exit) = (a, t_plane);
                    }
                }
            }
            let t_exit = t_exit.max(t);

            if skip {
                inside = None;
            } else {
                let corners = Cell { s: field.corners(cell.map(|i| i as usize)) };
                if departing.is_some() || corners.straddles(c) {
                    let last = t_exit >= reach;
                    let t_end = if last { reach } else { t_exit };
                    let local =
                        DVec3::from_array(std::array::from_fn(|a| (o[a] + t * d[a] - cell[a] as f64).clamp(0.0, 1.0)));
                    let mut cubic = corners.cubic(c, local, DVec3::from_array(d));
                    let start = match departing.take() {
                        Some(side) => {
                            // f(t) = t q(t): the sign of q is the sign of h − c once the ray has left.
                            cubic = cubic.deflate();
                            let leaves_inside = cubic.c.iter().find(|&&x| x != 0.0).is_none_or(|&x| x > 0.0);
                            if leaves_inside != (side == Side::Higher) {
                                return Some(FlattenedHit { t: 0.0, target: Target::Surface(side) });
                            }
                            leaves_inside
                        }
                        None => inside.unwrap_or_else(|| match entry {
                            Some(a) => crossing_inside(&corners, a, d[a] < 0.0, cell, &o, &d, t, c),
                            None => cubic.value(0.0) >= 0.0,
                        }),
                    };
                    let span = (t_end - t).max(0.0);
                    let end = if last {
                        cubic.value(span) >= 0.0
                    } else {
                        crossing_inside(&corners, axis, d[axis] > 0.0, cell, &o, &d, t_exit, c)
                    };
                    let crossing = if ANY && start != end { Some(0.0) } else { cubic.first_crossing(span, start, end) };
                    if let Some(dt) = crossing {
                        let side = if start { Side::Higher } else { Side::Lower };
                        return Some(FlattenedHit { t: (t + dt).min(reach) as f32, target: Target::Surface(side) });
                    }
                    inside = Some(end);
                } else {
                    inside = None;
                }
            }

            // Into the next cell.
            if t_exit >= reach {
                return None;
            }
            let mut next = cell;
            for a in 0..3 {
                let (lo, hi) = ((block[a] << shift) as i64, (((block[a] + 1) << shift).min(n[a]) - 1) as i64);
                next[a] = if a == axis {
                    if d[a] > 0.0 { hi + 1 } else { lo - 1 }
                } else if shift == 0 {
                    cell[a]
                } else {
                    ((o[a] + t_exit * d[a]).floor() as i64).clamp(lo, hi)
                };
            }
            if next[axis] < 0 || next[axis] >= n[axis] as i64 {
                if self.capped {
                    let corner_cell: [usize; 3] =
                        std::array::from_fn(|a| if a == axis { cell_beside(next[a], n[a]) } else { next[a] as usize });
                    let corners = Cell { s: field.corners(corner_cell) };
                    let inside_cell = corner_cell.map(|i| i as i64);
                    if crossing_inside(&corners, axis, d[axis] > 0.0, inside_cell, &o, &d, t_exit, c) {
                        return Some(FlattenedHit { t: t_exit as f32, target: cap(axis, d[axis] > 0.0, Side::Higher) });
                    }
                }
                return None;
            }
            // A coarser block is worth a look only when a new one was entered.
            while level < TOP && (next[axis] ^ cell[axis]) >> SHIFTS[level + 1] != 0 {
                level += 1;
            }
            (cell, t, entry) = (next, t_exit, Some(axis));
        }
    }
}

/// The border cell that a step out of Ω came from.
#[inline]
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the lattice")]
fn cell_beside(outside: i64, n: usize) -> usize {
    outside.clamp(0, n as i64 - 1) as usize
}

#[inline]
fn cap(axis: usize, far: bool, side: Side) -> Target {
    #[allow(clippy::cast_possible_truncation, reason = "an axis is below 3")]
    Target::Cap(axis as u8 + 3 * u8::from(far), side)
}

/// The shared state of a crossing: whether h ≥ c where the ray meets the face of `cell` across `axis`.
#[inline]
#[allow(clippy::too_many_arguments, reason = "the ray's arrays stay in registers")]
fn crossing_inside(
    corners: &Cell,
    axis: usize,
    far: bool,
    cell: [i64; 3],
    o: &[f64; 3],
    d: &[f64; 3],
    t: f64,
    c: f64,
) -> bool {
    let (b, e) = ((axis + 1) % 3, (axis + 2) % 3);
    let u = (o[b] + t * d[b] - cell[b] as f64).clamp(0.0, 1.0);
    let v = (o[e] + t * d[e] - cell[e] as f64).clamp(0.0, 1.0);
    corners.face_inside(axis, far, c, u, v)
}

/// A level whose blocks unite `factor`³ blocks of `fine`.
fn coarser(fine: &Level, factor: usize) -> Level {
    let dims = fine.dims.map(|n| n.div_ceil(factor));
    let mut ranges = vec![EMPTY; dims.iter().product()];
    ranges.par_chunks_mut(dims[0] * dims[1]).enumerate().for_each(|(k, slab)| {
        for z in factor * k..(factor * (k + 1)).min(fine.dims[2]) {
            for y in 0..fine.dims[1] {
                let row = &fine.ranges[(z * fine.dims[1] + y) * fine.dims[0]..][..fine.dims[0]];
                let out = &mut slab[y / factor * dims[0]..][..dims[0]];
                for (chunk, range) in row.chunks(factor).zip(out) {
                    *range = chunk.iter().fold(*range, |r, &x| union(r, x));
                }
            }
        }
    });
    Level { dims, ranges }
}
