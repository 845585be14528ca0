//! The walk of one ray, watertight by signs (design: geometry).
//!
//! The ray's *path* is the sequence of cells that comes from crossing lattice planes one after the other, in the order
//! of [`Line::time`], planes of equal time in the order of their axes. Neighbours on the path share the face in
//! between. The state there (inside: h ≥ c) comes from the face's own corners and the face's own plane, bit for bit
//! the same from both sides; a cell whose two states differ *must* give a hit. So the path cannot change sides unseen,
//! however roughly times are rounded: rounding moves the path by 1e-5 cells at most, where no cell is active nothing
//! depends on it, and in active cells everything is computed anew in f64.
//!
//! Cells that are skipped have all their corners on one side. None of the path is skipped wrongly: a cell of the path
//! is met between two times of its own planes, in order; a block's planes lie around those of its cells and times are
//! monotone, so that the times of the block are in order too.

use super::children::{Children, Line};
use super::{LEVELS, Pyramid, quantise4};
use crate::cell::Cell;
use crate::field::Field;
use crate::flattened::{Departure, FlattenedHit, FlattenedRay, Side, Target};
use glam::{DVec3, Vec4};

/// Corners on the face across an axis, near and far.
const FACES: [[u8; 2]; 3] = [[0x55, 0xaa], [0x33, 0xcc], [0x0f, 0xf0]];

/// Directions below this share of the largest component never cross a plane.
const PARALLEL: f64 = 1e-30;

/// A ray within Ω.
pub(super) struct Ray<'a> {
    field: &'a Field,
    o: [f64; 3],
    d: [f64; 3],
    inv: [f64; 3],
    /// The isovalue; h at the start if the ray starts on the surface.
    c: f64,
    /// The smallest f32 not below `c`: samples compare to both alike.
    c32: f32,
    /// Where Ω begins.
    t: f64,
    reach: f64,
    /// Whether the ray starts in Ω rather than enters it.
    within: bool,
}

/// A ray that is ready for the hierarchy.
pub(super) struct Start<'a> {
    pub(super) ray: Ray<'a>,
    pub(super) line: Line,
    /// The cell of the start is done.
    pub(super) departing: bool,
}

/// Children still to be visited.
#[derive(Default)]
pub(super) struct Stack {
    /// Levels that have some, bit by bit.
    pub(super) live: u32,
    /// The children, bit by bit, in the ray's order.
    pending: [u64; LEVELS],
    /// The number of each level's first child, in units of children.
    first: [[i32; 3]; LEVELS],
}

impl Stack {
    /// The level and number of the next child. Something must be live.
    #[inline(always)]
    #[allow(clippy::cast_possible_wrap, reason = "below 64")]
    pub(super) fn pop(&mut self, line: &Line) -> (usize, [i32; 3]) {
        let level = (self.live.trailing_zeros() as usize) % LEVELS;
        let these = self.pending[level];
        let rest = these & these.wrapping_sub(1);
        self.pending[level] = rest;
        self.live ^= u32::from(rest == 0) << level;
        let n = (these.trailing_zeros() ^ line.flip) as i32;
        let [x, y, z] = self.first[level];
        (level, [x + (n & 3), y + (n >> 2 & 3), z + (n >> 4)])
    }
}

/// What a cell says.
pub(super) enum Step {
    On,
    Hit(FlattenedHit),
    /// Beyond the reach.
    End,
}

impl Pyramid {
    /// The walk. With `ANY`, the t of the hit is only a bound.
    #[inline(always)]
    pub(super) fn walk<const ANY: bool, K: Children>(
        &self,
        kernel: K,
        field: &Field,
        ray: &FlattenedRay,
        reach: f64,
    ) -> Option<FlattenedHit> {
        let start = match self.begin::<ANY, K>(kernel, field, ray, reach) {
            Ok(start) => start,
            Err(done) => return done,
        };
        let Start { ray, line, .. } = &start;
        // Nodes larger than 256³ cells are taken in turn; mostly there is one.
        let top = self.levels.len() - 1;
        let constants = kernel.ray(line);
        let roots = self.levels[top].dims;
        let width = (4 << (2 * top)) as f32;
        let turn = |a: usize, i: usize| if line.negative(a) { roots[a] - 1 - i } else { i };
        let met = |a: usize, i: usize| {
            let (b, e) = (i as f32 * width, (i + 1) as f32 * width);
            let (b, e) = if line.negative(a) { (e, b) } else { (b, e) };
            (line.time(a, b), line.time(a, e))
        };
        for k in 0..roots[2] {
            for j in 0..roots[1] {
                for i in 0..roots[0] {
                    let root = [turn(0, i), turn(1, j), turn(2, k)];
                    if roots != [1; 3] {
                        let [x, y, z] = [0, 1, 2].map(|a| met(a, root[a]));
                        if !(x.0.max(y.0).max(z.0) <= x.1.min(y.1).min(z.1)) {
                            continue;
                        }
                    }
                    let mut stack = self.stack(kernel, line, &constants, root);
                    while stack.live != 0 {
                        let (level, child) = stack.pop(line);
                        if level > 0 {
                            self.open(kernel, line, &constants, &mut stack, level, child);
                            continue;
                        }
                        match ray.cell::<ANY>(line, child, start.departing) {
                            Step::On => {}
                            Step::Hit(hit) => return Some(hit),
                            Step::End => return None,
                        }
                    }
                }
            }
        }
        self.leave(ray)
    }

    /// What comes before the hierarchy: the part of the ray in Ω, its isovalue, and the cell of its departure. `Err`
    /// if that is all.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped cell numbers; t leaves as f32")]
    #[inline(always)]
    pub(super) fn begin<'a, const ANY: bool, K: Children>(
        &self,
        kernel: K,
        field: &'a Field,
        ray: &FlattenedRay,
        reach: f64,
    ) -> Result<Start<'a>, Option<FlattenedHit>> {
        let n = self.cells;
        let mut o = ray.origin.as_dvec3().to_array();
        let d = ray.direction.as_dvec3().to_array();
        // Faces from 6 on are another field's.
        if let Departure::Cap(face @ 0..6, side) = ray.departure {
            let (axis, far) = (usize::from(face % 3), face >= 3);
            let inward = if far { d[axis] < 0.0 } else { d[axis] > 0.0 };
            if inward != (side == Side::Higher) && d[axis] != 0.0 {
                return Err(Some(FlattenedHit { t: 0.0, target: cap(axis, far, side) }));
            }
            if side == Side::Lower {
                // Ω is convex: what leaves it never comes back.
                return Err(None);
            }
            o[axis] = if far { n[axis] as f64 } else { 0.0 };
        }
        if let Departure::Surface(side) = ray.departure {
            let outwards = |a: usize| (o[a] == 0.0 && d[a] < 0.0) || (o[a] == n[a] as f64 && d[a] > 0.0);
            if let Some(axis) = (0..3).find(|&a| outwards(a)) {
                // It leaves Ω where it starts. There h = c counts as inside, which must not end a ray from the lower side.
                let closed = self.capped && side == Side::Higher;
                let target = cap(axis, d[axis] > 0.0, side);
                return Err(closed.then_some(FlattenedHit { t: 0.0, target }));
            }
        }
        let inv = d.map(|x| 1.0 / x);
        // Clip to Ω. A component 0 (or −0) never crosses a plane: its slab holds the whole line or nothing of it.
        let (mut t, mut t_out, mut entry) = (0f64, reach, None);
        if !(0..3).all(|a| o[a] >= 0.0 && o[a] <= n[a] as f64) {
            for a in 0..3 {
                let far = n[a] as f64;
                if d[a] == 0.0 {
                    if !(o[a] >= 0.0 && o[a] <= far) {
                        return Err(None);
                    }
                    continue;
                }
                let (near_plane, far_plane) = if d[a] > 0.0 { (0.0, far) } else { (far, 0.0) };
                let t0 = (near_plane - o[a]) * inv[a];
                if t0 > t {
                    (t, entry) = (t0, Some(a));
                }
                t_out = t_out.min((far_plane - o[a]) * inv[a]);
            }
        }
        let scale = d[0].abs().max(d[1].abs()).max(d[2].abs());
        if !(t <= t_out) || scale == 0.0 {
            return Err(None);
        }
        // The cell of the start, and the line from there.
        let mut cell = [0i32; 3];
        let mut line = Line { o: [0.0; 3], inv: [1e30; 3], flip: 0, end: 0.0, most_lo: 0, least_hi: 0 };
        for a in 0..3 {
            let p = o[a] + t * d[a];
            // On a shared plane the ray is in the cell it goes to.
            let below = d[a] < 0.0 && p == p.floor();
            cell[a] = (p.floor() as i32 - i32::from(below)).clamp(0, n[a] as i32 - 1);
            if d[a].abs() > PARALLEL * scale {
                (line.o[a], line.inv[a]) = (p as f32, (scale * inv[a]) as f32);
                line.flip |= (u32::from(d[a] < 0.0) * 3) << (2 * a);
            } else {
                line.o[a] = cell[a] as f32 + 0.5;
            }
        }
        // What is cold most often, on the way while the first cell is computed.
        for (level, shift) in [(0, 2), (1, 4)] {
            if let Some(level) = self.levels.get(level) {
                kernel.prefetch(level.tile(cell.map(|i| i as usize >> shift)));
            }
        }
        // Roughly: the cells decide.
        line.end = ((reach - t) * scale * (1.0 + 1e-5) + 1e-3) as f32;

        let mut c = f64::from(ray.isovalue);
        let mut departing = None;
        if let (Departure::Surface(side), None) = (ray.departure, entry) {
            let local = DVec3::from_array(std::array::from_fn(|a| (o[a] - f64::from(cell[a])).clamp(0.0, 1.0)));
            let here = Cell { s: field.corners(cell.map(|i| i as usize)) }.value(local);
            if here.is_finite() {
                // So that the root at the start is exactly 0.
                c = here;
                departing = Some(side);
            }
        }
        let nearest = c as f32;
        let c32 = if f64::from(nearest) < c { nearest.next_up() } else { nearest };
        [line.most_lo, line.least_hi, ..] = quantise4(Vec4::new(c32.next_down(), c32, 0.0, 0.0));

        let ray = Ray { field, o, d, inv, c, c32, t, reach, within: entry.is_none() };
        if let Some(axis) = entry {
            let far = d[axis] < 0.0;
            if self.capped && ray.cell_at(cell).face_inside_ray(axis, far, &ray, cell, t) {
                return Err(Some(FlattenedHit { t: t as f32, target: cap(axis, far, Side::Lower) }));
            }
        }
        if let Some(side) = departing {
            match ray.first_cell::<ANY>(&line, cell, side) {
                Step::On => {}
                Step::Hit(hit) => return Err(Some(hit)),
                Step::End => return Err(None),
            }
        }

        Ok(Start { ray, line, departing: departing.is_some() })
    }

    /// The root with its children.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "node numbers are small")]
    pub(super) fn stack<K: Children>(&self, kernel: K, line: &Line, constants: &K::Ray, root: [usize; 3]) -> Stack {
        let mut stack = Stack::default();
        self.open(kernel, line, constants, &mut stack, self.levels.len(), root.map(|i| i as i32));
        stack
    }

    /// Pushes the active children of node `node`, itself a child at `level`.
    #[inline(always)]
    #[allow(clippy::cast_sign_loss, reason = "node numbers are not negative")]
    pub(super) fn open<K: Children>(
        &self,
        kernel: K,
        line: &Line,
        constants: &K::Ray,
        stack: &mut Stack,
        level: usize,
        node: [i32; 3],
    ) {
        let level = (level - 1) % LEVELS;
        let first = node.map(|i| 4 * i);
        let shift = 2 * level;
        let base = [first[0] << shift, first[1] << shift, first[2] << shift, 0];
        let tile = self.levels[level].tile(node.map(|i| i as usize));
        let found = kernel.children(line, constants, tile, base, (1 << shift) as f32);
        stack.first[level] = first;
        stack.pending[level] = found;
        stack.live |= u32::from(found != 0) << level;
    }

    /// What a ray finds that leaves Ω within its reach, if Ω is capped.
    #[allow(clippy::cast_possible_truncation, reason = "t leaves as f32")]
    pub(super) fn leave(&self, ray: &Ray) -> Option<FlattenedHit> {
        if !self.capped {
            return None;
        }
        let (mut axis, mut t) = (0, f64::INFINITY);
        for a in 0..3 {
            if ray.d[a] != 0.0 {
                let plane = if ray.d[a] > 0.0 { self.cells[a] as f64 } else { 0.0 };
                let t_plane = (plane - ray.o[a]) * ray.inv[a];
                if t_plane < t {
                    (axis, t) = (a, t_plane);
                }
            }
        }
        let t = t.max(ray.t);
        if t >= ray.reach {
            return None;
        }
        let far = ray.d[axis] > 0.0;
        let cell = std::array::from_fn(|a| {
            let last = self.cells[a] as i32 - 1;
            if a != axis {
                ((ray.o[a] + t * ray.d[a]).floor() as i32).clamp(0, last)
            } else if far {
                last
            } else {
                0
            }
        });
        let inside = ray.cell_at(cell).face_inside_ray(axis, far, ray, cell, t);
        inside.then(|| FlattenedHit { t: t as f32, target: cap(axis, far, Side::Higher) })
    }
}

impl Ray<'_> {
    #[inline(always)]
    #[allow(clippy::cast_sign_loss, reason = "cells of the lattice")]
    fn cell_at(&self, cell: [i32; 3]) -> Cell {
        Cell { s: self.field.corners(cell.map(|i| i as usize)) }
    }

    /// Where the ray crosses the near or far plane of a cell, in f64.
    #[inline(always)]
    fn time(&self, axis: usize, plane: i32) -> f64 {
        (f64::from(plane) - self.o[axis]) * self.inv[axis]
    }

    /// Cell-local position at `t`.
    #[inline(always)]
    fn local(&self, cell: [i32; 3], t: f64) -> DVec3 {
        let at = |a: usize| (self.o[a] + t * self.d[a] - f64::from(cell[a])).clamp(0.0, 1.0);
        DVec3::new(at(0), at(1), at(2))
    }

    /// A cell of the path, or one that the path only touches.
    #[inline(always)]
    pub(super) fn cell<const ANY: bool>(&self, line: &Line, cell: [i32; 3], departing: bool) -> Step {
        let corners = self.cell_at(cell);
        let inside = corners.inside(self.c32);
        if inside == 0 || inside == u8::MAX {
            return Step::On;
        }
        let far = [0, 1, 2].map(|a| i32::from(!line.negative(a)));
        let t_in = [0, 1, 2].map(|a| line.time(a, (cell[a] + 1 - far[a]) as f32));
        let t_out = [0, 1, 2].map(|a| line.time(a, (cell[a] + far[a]) as f32));
        // The last plane before the cell and the first behind it.
        let entry = last_of(t_in);
        let exit = first_of(t_out);
        // Touched, not crossed: another cell's planes lie between these two.
        if !(t_in[entry] < t_out[exit] || (t_in[entry] == t_out[exit] && entry < exit)) {
            return Step::On;
        }
        let first = self.within && t_in[entry] <= 0.0;
        if first && departing {
            return Step::On;
        }
        let t = if first { 0.0 } else { self.time(entry, cell[entry] + 1 - far[entry]).max(0.0) };
        if t > self.reach {
            return Step::End;
        }
        let t_exit = self.time(exit, cell[exit] + far[exit]).max(t);
        let last = t_exit >= self.reach;
        let local = self.local(cell, t);
        let cubic = corners.cubic(self.c, local, DVec3::from_array(self.d));
        // Signs come from weights, not from the cubic's coefficients, which a huge corner far away may have rounded off.
        let start = if first {
            corners.value(local) >= self.c
        } else {
            self.crossing(&corners, inside, entry, far[entry] == 0, cell, t)
        };
        let span = if last { (self.reach - t).max(0.0) } else { t_exit - t };
        let end = if last {
            corners.value(self.local(cell, t + span)) >= self.c
        } else {
            self.crossing(&corners, inside, exit, far[exit] == 1, cell, t_exit)
        };
        let crossing = if ANY && start != end { Some(0.0) } else { cubic.first_crossing(span, start, end) };
        match crossing {
            Some(dt) => Step::Hit(self.hit(t + dt, start)),
            None if last => Step::End,
            None => Step::On,
        }
    }

    /// The cell from whose surface the ray departs.
    #[inline(always)]
    fn first_cell<const ANY: bool>(&self, line: &Line, cell: [i32; 3], side: Side) -> Step {
        let corners = self.cell_at(cell);
        let far = [0, 1, 2].map(|a| i32::from(!line.negative(a)));
        let exit = first_of([0, 1, 2].map(|a| line.time(a, (cell[a] + far[a]) as f32)));
        let t_exit = self.time(exit, cell[exit] + far[exit]).max(0.0);
        let last = t_exit >= self.reach;
        // f(t) = t q(t): the sign of q is the sign of h − c once the ray has left.
        let (local, d) = (self.local(cell, 0.0), DVec3::from_array(self.d));
        let mut cubic = corners.cubic(self.c, local, d).deflate();
        cubic.c[0] = corners.slope(local, d);
        let start = cubic.c.iter().find(|&&x| x != 0.0).is_none_or(|&x| x > 0.0);
        if start != (side == Side::Higher) {
            return Step::Hit(FlattenedHit { t: 0.0, target: Target::Surface(side) });
        }
        let span = if last { self.reach } else { t_exit };
        let end = if last {
            cubic.value(span) >= 0.0
        } else {
            self.crossing(&corners, corners.inside(self.c32), exit, far[exit] == 1, cell, t_exit)
        };
        let crossing = if ANY && start != end { Some(0.0) } else { cubic.first_crossing(span, start, end) };
        match crossing {
            Some(t) => Step::Hit(self.hit(t, start)),
            None if last => Step::End,
            None => Step::On,
        }
    }

    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, reason = "t leaves as f32")]
    fn hit(&self, t: f64, from_inside: bool) -> FlattenedHit {
        let side = if from_inside { Side::Higher } else { Side::Lower };
        FlattenedHit { t: t.min(self.reach) as f32, target: Target::Surface(side) }
    }

    /// The shared state of a crossing: whether h ≥ c where the ray meets the face of `cell` across `axis`.
    /// `inside`: the corners of the cell that are.
    #[inline(always)]
    fn crossing(&self, corners: &Cell, inside: u8, axis: usize, far: bool, cell: [i32; 3], t: f64) -> bool {
        let face = FACES[axis][usize::from(far)];
        match inside & face {
            0 => false,
            all if all == face => true,
            _ => corners.face_inside_ray(axis, far, self, cell, t),
        }
    }
}

impl Cell {
    /// [`Cell::face_inside`] where the ray meets the face at `t`.
    #[inline(always)]
    fn face_inside_ray(&self, axis: usize, far: bool, ray: &Ray, cell: [i32; 3], t: f64) -> bool {
        let at = |a: usize| (ray.o[a] + t * ray.d[a] - f64::from(cell[a])).clamp(0.0, 1.0);
        self.face_inside(axis, far, ray.c, at((axis + 1) % 3), at((axis + 2) % 3))
    }
}

/// The axis of the largest number; of equal ones the last.
#[inline(always)]
fn last_of(t: [f32; 3]) -> usize {
    let a = usize::from(t[1] >= t[0]);
    if t[2] >= t[a] { 2 } else { a }
}

/// The axis of the smallest number; of equal ones the first.
#[inline(always)]
fn first_of(t: [f32; 3]) -> usize {
    let a = usize::from(t[1] < t[0]);
    if t[2] < t[a] { 2 } else { a }
}

#[inline]
fn cap(axis: usize, far: bool, side: Side) -> Target {
    #[allow(clippy::cast_possible_truncation, reason = "an axis is below 3")]
    Target::Cap(axis as u8 + 3 * u8::from(far), side)
}
