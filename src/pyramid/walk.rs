//! The walk of one ray, watertight by signs (design: geometry).
//!
//! The ray's *path* is the sequence of cells that comes from crossing lattice planes one after the other, in the order
//! of [`Line::time`], planes of equal time in the order of their axes. Neighbours on the path share the face in
//! between. The state there (inside: h ≥ c) comes from the face's own corners and the face's own plane, bit for bit
//! the same from both sides; a cell whose two states differ *must* give a hit. So the path cannot change sides unseen,
//! however roughly times are rounded: rounding moves the path by about 1e-7 of its length, where no cell is active
//! nothing depends on it, and in active cells everything is computed anew in f64.
//!
//! Cells that are skipped have all their corners on one side. None of the path is skipped wrongly: a cell of the path
//! is met between two times of its own planes, in order; a block's planes lie around those of its cells and times are
//! monotone, so that the times of the block are in order too.
//!
//! The walk climbs: it looks at the nodes around the start from the smallest up, each without the child it comes from.
//! A path begins in all of them and leaves each but once, so that this is its order; and no node waits for another.

mod begin;

use super::kernel::{Kernel, Line, Piece, Scalar};
use super::{LEVELS, Place, Pyramid, Ranks, place};
use crate::cell::Cell;
use crate::field::Field;
use crate::flattened::{FlattenedHit, FlattenedRay, Side, Target};
use glam::{DVec3, Vec4};

/// Corners on the face across an axis, near and far.
const FACES: [[u8; 2]; 3] = [[0x55, 0xaa], [0x33, 0xcc], [0x0f, 0xf0]];

/// Directions below this share of the largest component never cross a plane.
const PARALLEL: f32 = 1e-30;

/// Lattices stay below this, where every f32 is an integer from here to twice that.
const INTEGERS: f32 = 8_388_608.0;

/// [`Line::flip`] of the axes whose bits are set in the index.
const FLIPS: [u32; 8] = [0, 0x03, 0x0c, 0x0f, 0x30, 0x33, 0x3c, 0x3f];

/// A ray within Ω.
pub(super) struct Ray<'a> {
    samples: &'a [f32],
    /// What a step along y or z adds to a sample's position in memory.
    steps: [usize; 2],
    o: [f64; 4],
    d: [f64; 4],
    inv: [f64; 4],
    /// The isovalue; h at the start if the ray starts on the surface.
    c: f64,
    /// The smallest f32 not below `c`: samples compare to both alike.
    c32: f32,
    /// The lattice point that corners and lines of the walk count from.
    base: Vec4,
    /// Where Ω begins.
    t: f64,
    reach: f64,
    /// Whether the ray starts in Ω rather than enters it.
    within: bool,
}

/// A ray on its way through the hierarchy.
pub(super) struct Lane<'a, R> {
    pub(super) ray: Ray<'a>,
    line: Line,
    /// [`Kernel::constants`].
    constants: R,
    pub(super) stack: Stack,
    /// The start among the children of its nodes, six bits for each level.
    own: u32,
    /// The node of the top level that holds it.
    root: usize,
    /// The start's cell is done.
    departing: bool,
    /// Levels that were looked at around the start.
    pub(super) climbed: usize,
    /// It may end on a face of Ω.
    pub(super) capped: bool,
}

/// How a ray begins.
pub(super) enum Begun {
    /// It has a [`Lane`].
    On,
    Done(Option<FlattenedHit>),
    /// In a way that is not looked for here.
    Otherwise,
}

/// Children still to be visited.
pub(super) struct Stack {
    /// Levels that have some, bit by bit.
    pub(super) live: u32,
    /// The children, bit by bit, in the ray's order.
    pending: [u64; LEVELS],
    /// Where each level's child begins that was last popped, and behind them the node of the top level.
    places: [Place; LEVELS + 1],
}

/// A cell, or a node of the level below. It begins at its level's [`Stack::places`].
#[derive(Clone, Copy, Default)]
pub(super) struct Child {
    pub(super) level: usize,
    /// Place in memory: of its tile, or of the cell's first sample.
    pub(super) at: usize,
}

/// Where a ray starts.
pub(super) struct Start {
    /// As [`Lane::own`] and [`Lane::root`].
    own: u32,
    root: usize,
    /// As [`Stack::places`].
    places: [Place; LEVELS + 1],
}

/// The width of a level's children, in cells.
#[inline(always)]
fn size(level: usize) -> f32 {
    f32::from_bits((127 + 2 * level as u32) << 23)
}

/// A place of the lattice.
#[inline(always)]
fn point([x, y, z]: [u32; 3]) -> Vec4 {
    // Below 2²³ an integer is the low bits of itself plus 2²³.
    Vec4::from_array([x, y, z, 0].map(|i| f32::from_bits(i | INTEGERS.to_bits()))) - INTEGERS
}

impl Stack {
    /// Leaves children of a level for later.
    #[inline(always)]
    fn push(&mut self, level: usize, these: u64) {
        self.pending[level] = these;
        self.live |= u32::from(these != 0) << level;
    }

    /// The next child; no child if nothing is live.
    #[inline(always)]
    fn pop(&mut self, pyramid: &Pyramid, line: &Line) -> Child {
        let level = (self.live.trailing_zeros() as usize) % LEVELS;
        self.live &= self.live.wrapping_sub(1);
        self.first(pyramid, line, level, self.pending[level])
    }

    /// The first child of `these`, of a level; the others are left for later.
    #[inline(always)]
    fn first(&mut self, pyramid: &Pyramid, line: &Line, level: usize, these: u64) -> Child {
        let rest = these & these.wrapping_sub(1);
        self.pending[level] = rest;
        self.live |= u32::from(rest != 0) << level;
        let n = (these.trailing_zeros() ^ line.flip) % 64;
        let (node, step) = (&self.places[level + 1], &pyramid.children[level].steps[n as usize]);
        let at = node.at[level].wrapping_add(step.at[level]);
        self.places[level] = node.plus(step);
        Child { level, at }
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
    pub(super) fn walk<const ANY: bool, K: Kernel>(
        &self,
        kernel: K,
        field: &Field,
        ray: &FlattenedRay,
        reach: f64,
    ) -> Option<FlattenedHit> {
        let mut lane = None;
        match kernel.outlined(|| self.begin::<ANY, K>(kernel, field, ray, reach, &mut lane)) {
            Begun::Done(hit) => return hit,
            Begun::On | Begun::Otherwise => {}
        }
        let lane = lane.as_mut()?;
        let mut turn = 0;
        loop {
            while lane.stack.live == 0 {
                if lane.climbed < self.levels.len() {
                    self.climb(kernel, lane);
                } else if self.roots == 1 || !self.next_root(kernel, lane, &mut turn) {
                    return self.leave(&lane.ray);
                }
            }
            let mut child = lane.pop(self);
            while child.level > 0 {
                let level = (child.level - 1) % LEVELS;
                let found = self.look(kernel, lane, level, child.at);
                if found == 0 {
                    break;
                }
                child = lane.stack.first(self, &lane.line, level, found);
            }
            if child.level > 0 {
                continue;
            }
            match lane.cell::<ANY, K>(kernel, self.slack, child) {
                Step::On => {}
                Step::Hit(hit) => return Some(hit),
                Step::End => return None,
            }
        }
    }

    /// Looks around the start: opens the nodes that hold it on the next two levels, but for the children that hold it
    /// and are done. What they give comes first on the path, and neither node waits for the other.
    #[inline(always)]
    pub(super) fn climb<K: Kernel>(&self, kernel: K, lane: &mut Lane<K::Constants>) {
        if lane.climbed == 0 {
            self.look_around::<0, K>(kernel, lane);
            self.look_around::<1, K>(kernel, lane);
        } else {
            self.look_around::<2, K>(kernel, lane);
            self.look_around::<3, K>(kernel, lane);
        }
        lane.climbed += 2;
    }

    /// Opens the node that holds the start on a level, but for the child that holds it and is done.
    #[inline(always)]
    fn look_around<const LEVEL: usize, K: Kernel>(&self, kernel: K, lane: &mut Lane<K::Constants>) {
        if LEVEL >= self.levels.len() {
            return;
        }
        let own = u64::from(LEVEL > 0 || lane.departing) << ((lane.own >> (6 * LEVEL) ^ lane.line.flip) % 64);
        let pending = !own & self.look(kernel, lane, LEVEL, tile(LEVEL, &lane.stack.places, lane.root));
        lane.stack.push(LEVEL, pending);
        if LEVEL > 0 {
            // The first that will be opened after what is found on the levels below.
            let n = (pending.trailing_zeros() ^ lane.line.flip) % 64;
            let step = &self.children[LEVEL].steps[n as usize];
            let at = lane.stack.places[LEVEL + 1].at[LEVEL].wrapping_add(step.at[LEVEL]);
            let tile = self.levels[LEVEL - 1].tiles.as_ptr().wrapping_add(at).cast::<u8>();
            kernel.ask(tile);
            kernel.ask(tile.wrapping_add(64));
        }
    }

    /// Opens the next node of the top level that the ray may meet after its start's; false if there is none. Nodes
    /// larger than 256³ cells are taken in turn; mostly there is one.
    #[cold]
    #[allow(clippy::cast_possible_truncation, reason = "node numbers are small")]
    fn next_root<K: Kernel>(&self, kernel: K, lane: &mut Lane<K::Constants>, turn: &mut usize) -> bool {
        let top = self.levels.len() - 1;
        let (width, roots) = (size(top + 1), self.levels[top].dims);
        while *turn < self.roots {
            let n = [*turn % roots[0], *turn / roots[0] % roots[1], *turn / (roots[0] * roots[1])];
            *turn += 1;
            let line = &lane.line;
            let number = [0, 1, 2].map(|a| if line.negative(a) { roots[a] - 1 - n[a] } else { n[a] });
            let at = self.levels[top].at(number);
            let node = self.root(number).from(lane.ray.base);
            let corner = node.corner;
            let near = line.times(corner + (Vec4::ONE - line.far) * width);
            let far = line.times(corner + line.far * width);
            let met = near.x.max(near.y).max(near.z) <= far.x.min(far.y).min(far.z);
            if met && at != lane.root {
                lane.stack.places[top + 1] = node;
                let found = self.look(kernel, lane, top, at);
                lane.stack.push(top, found);
                return true;
            }
        }
        false
    }

    /// Where node `number` of the top level begins.
    fn root(&self, number: [usize; 3]) -> Place {
        let width = 4usize.pow(self.levels.len() as u32);
        let dims = self.cells.map(|n| n + 1);
        place(dims, &self.levels, number.map(|i| width * i))
    }

    /// The nodes around a cell.
    #[inline(always)]
    fn nodes(&self, cell: [u32; 3]) -> Start {
        let own = spread(cell);
        let mut places = [Place::default(); LEVELS + 1];
        let mut root = 0;
        if self.roots != 1 {
            let number = cell.map(|i| i as usize >> (2 * LEVELS));
            (places[LEVELS], root) = (self.root(number), self.levels[LEVELS - 1].at(number));
        }
        for level in (1..LEVELS).rev() {
            let n = (own >> (6 * level)) % 64;
            places[level] = places[level + 1].plus(&self.children[level].steps[n as usize]);
        }
        Start { own, root, places }
    }

    /// Asks memory for the two lowest nodes around a start.
    #[inline(always)]
    fn prefetch<K: Kernel>(&self, kernel: K, start: &Start) {
        for (level, nodes) in self.levels.iter().enumerate().take(2) {
            kernel.prefetch(&nodes.tiles[tile(level, &start.places, start.root)]);
        }
    }

    /// Pushes the active children of a node that was popped.
    #[inline(always)]
    pub(super) fn open<K: Kernel>(&self, kernel: K, lane: &mut Lane<K::Constants>, node: Child) {
        let level = (node.level - 1) % LEVELS;
        let found = self.look(kernel, lane, level, node.at);
        lane.stack.push(level, found);
    }

    /// The active children of a level's node, whose tile stands `at`.
    #[inline(always)]
    fn look<K: Kernel>(&self, kernel: K, lane: &Lane<K::Constants>, level: usize, at: usize) -> u64 {
        let tile = &self.levels[level].tiles[at];
        kernel.children(&lane.line, &lane.constants, tile, lane.stack.places[level + 1].corner, size(level))
    }

    /// Where the samples of a cell begin.
    #[inline(always)]
    fn sample(&self, [i, j, k]: [u32; 3]) -> usize {
        i as usize + j as usize * self.steps[0] + k as usize * self.steps[1]
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
            let i = if a != axis { (ray.o[a] + t * ray.d[a]).floor() as i32 } else { i32::from(far) * last };
            i.clamp(0, last).cast_unsigned()
        });
        let inside = ray.cell_at(self.sample(cell)).face_inside_ray(axis, far, ray, point(cell), t);
        inside.then(|| FlattenedHit { t: t as f32, target: cap(axis, far, Side::Higher) })
    }
}

impl Ray<'_> {
    /// The cell whose samples begin at `at`.
    #[inline(always)]
    fn cell_at(&self, at: usize) -> Cell {
        Cell { s: Scalar.corners(self.samples, at, self.steps) }
    }

    /// Where the ray crosses a plane of the lattice, in f64.
    #[inline(always)]
    fn time(&self, axis: usize, plane: f32) -> f64 {
        (f64::from(plane) - self.o[axis]) * self.inv[axis]
    }

    /// Position at `t` in the cell at `corner`.
    #[inline(always)]
    fn local(&self, corner: Vec4, t: f64) -> DVec3 {
        let at = |a: usize| (self.o[a] + t * self.d[a] - f64::from(corner[a])).clamp(0.0, 1.0);
        DVec3::new(at(0), at(1), at(2))
    }

    #[inline(always)]
    fn direction(&self) -> DVec3 {
        DVec3::new(self.d[0], self.d[1], self.d[2])
    }

    /// Where h − c changes its sign after `t`, within `span`, the states at both ends being given.
    #[inline(never)]
    fn crossing(&self, at: usize, corner: Vec4, t: f64, span: f64, [begins, ends]: [bool; 2]) -> Option<f64> {
        let cubic = self.cell_at(at).cubic(self.c, self.local(corner, t), self.direction());
        cubic.first_crossing(span, begins, ends)
    }

    /// The cell from whose surface the ray departs.
    #[inline(always)]
    fn first_cell<const ANY: bool>(&self, line: &Line, at: usize, corner: Vec4, side: Side) -> Step {
        let corners = self.cell_at(at);
        let planes = corner + line.far;
        let (exit, _) = first_of(line.times(planes));
        let t_exit = self.time(exit, planes[exit]).max(0.0);
        let last = t_exit >= self.reach;
        // f(t) = t q(t): the sign of q is the sign of h − c once the ray has left.
        let (local, d) = (self.local(corner, 0.0), self.direction());
        let mut cubic = corners.cubic(self.c, local, d).deflate();
        cubic.c[0] = corners.slope(local, d);
        let start = cubic.c.iter().find(|&&x| x != 0.0).is_none_or(|&x| x > 0.0);
        if start != (side == Side::Higher) {
            return Step::Hit(FlattenedHit { t: 0.0, target: Target::Surface(side) });
        }
        let end = corners.face_inside_ray(exit, !line.negative(exit), self, corner, t_exit);
        let sure = ANY & !last & (start != end);
        let crossing = if sure { Some(0.0) } else { cubic.first_crossing(t_exit, start, end) };
        match crossing {
            Some(t) if t <= self.reach => Step::Hit(Self::hit(t, start)),
            _ if last => Step::End,
            _ => Step::On,
        }
    }

    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, reason = "t leaves as f32")]
    fn hit(t: f64, from_inside: bool) -> FlattenedHit {
        let side = if from_inside { Side::Higher } else { Side::Lower };
        FlattenedHit { t: t as f32, target: Target::Surface(side) }
    }
}

impl<'a, R> Lane<'a, R> {
    #[inline(always)]
    fn new(constants: R, ray: Ray<'a>, line: Line, start: Start, departing: bool, capped: bool) -> Self {
        let Start { own, root, places } = start;
        let stack = Stack { live: 0, pending: [0; LEVELS], places };
        Self { ray, line, constants, stack, own, root, departing, climbed: 0, capped }
    }

    /// [`Stack::pop`].
    #[inline(always)]
    pub(super) fn pop(&mut self, pyramid: &Pyramid) -> Child {
        self.stack.pop(pyramid, &self.line)
    }

    /// A cell of the path, or one that the path only touches. `slack`: [`Pyramid::slack`].
    #[inline(always)]
    pub(super) fn cell<const ANY: bool, K: Kernel>(&self, kernel: K, slack: f32, cell: Child) -> Step {
        let (ray, line) = (&self.ray, &self.line);
        let corners = kernel.corners(ray.samples, cell.at, ray.steps);
        let inside = kernel.inside(&corners, ray.c32);
        let corner = self.stack.places[0].corner;
        let (near, far) = (corner + (Vec4::ONE - line.far), corner + line.far);
        // The last plane before the cell and the first behind it.
        let (entry, t_in) = last_of(line.times(near));
        let (exit, t_out) = first_of(line.times(far));
        // Touched, not crossed: another cell's planes lie between these two.
        let crossed = (t_in < t_out) | ((t_in == t_out) & (entry < exit));
        let first = ray.within & (t_in <= 0.0);
        if (inside == 0) | (inside == u8::MAX) | !crossed | (first & self.departing) {
            return Step::On;
        }
        // Most cells are passed by.
        let local = |t: f32| (line.start - corner + line.d * t).max(Vec4::ZERO).min(Vec4::ONE);
        if kernel.clear(&corners, ray.c32, local(t_in.max(0.0)), local(t_out), slack) {
            return Step::On;
        }
        let [corner, near, far] = [corner, near, far].map(|place| place + ray.base);
        let t = ray.time(entry, near.to_array()[entry]).max(0.0);
        let t = if first { 0.0 } else { t };
        if t > ray.reach {
            return Step::End;
        }
        // Each face at its own time, as its other cell has it: rounding may have turned their order round.
        let t_exit = ray.time(exit, far.to_array()[exit]).max(0.0);
        let last = t_exit >= ray.reach;
        let piece = Piece {
            o: &ray.o,
            d: &ray.d,
            far: line.far,
            cell: corner,
            t: [t, t_exit],
            on: [if first { 0 } else { 1 << entry }, 1 << exit],
        };
        let v = kernel.span(&corners, &piece);
        let above = kernel.at_least(&v, ray.c);
        // Signs come from weights, not from the cubic's coefficients, which a huge corner far away may have rounded
        // off.
        let (begins, ends) = (above & 1 == 1, above >> 7 == 1);
        let begins = if first { begins } else { state(inside, entry, line.negative(entry), begins) };
        let ends = state(inside, exit, !line.negative(exit), ends);
        // Between equal states nothing happens if all Bernstein coefficients agree.
        if (begins == ends) & (above == if begins { u8::MAX } else { 0 }) {
            return if last { Step::End } else { Step::On };
        }
        if ANY && !last && begins != ends {
            return Step::Hit(Ray::hit(t, begins));
        }
        if t_exit < t {
            return if begins == ends { Step::On } else { Step::Hit(Ray::hit(t, begins)) };
        }
        // In all of the cell, so that t does not depend on where the reach ends: on what was met before.
        match ray.crossing(cell.at, corner, t, t_exit - t, [begins, ends]) {
            Some(dt) if t + dt <= ray.reach => Step::Hit(Ray::hit(t + dt, begins)),
            _ if last => Step::End,
            _ => Step::On,
        }
    }
}

/// The shared state of a crossing: whether h ≥ c where the ray meets the face across `axis`. `inside`: the corners of
/// the cell that are; `here`: what [`Cell::value`] says there. Equal signs of all four corners decide without
/// arithmetic.
#[inline(always)]
fn state(inside: u8, axis: usize, far: bool, here: bool) -> bool {
    let face = FACES[axis][usize::from(far)];
    inside & face == face || (here && inside & face != 0)
}

impl Line {
    /// Sets what ranges that hold the isovalue begin and end at; `c32` is the smallest f32 not below it.
    #[inline(always)]
    fn hold(&mut self, ranks: &Ranks, c32: f32) {
        [self.most_lo, self.least_hi, ..] = ranks.of4(Vec4::new(c32.next_down(), c32, 0.0, 0.0));
    }
}

impl Cell {
    /// [`Cell::face_inside`] where the ray meets the face at `t`.
    #[inline(always)]
    fn face_inside_ray(&self, axis: usize, far: bool, ray: &Ray, corner: Vec4, t: f64) -> bool {
        let at = |a: usize| (ray.o[a] + t * ray.d[a] - f64::from(corner[a])).clamp(0.0, 1.0);
        self.face_inside(axis, far, ray.c, at((axis + 1) % 3), at((axis + 2) % 3))
    }
}

/// Where the tile of a level's node stands, of those around a start.
#[inline(always)]
fn tile(level: usize, places: &[Place; LEVELS + 1], root: usize) -> usize {
    if level + 1 < LEVELS { places[level + 1].at[level + 1] } else { root }
}

/// A cell among the children of the nodes around it: x, y and z of each level side by side, in six bits.
#[inline(always)]
fn spread(cell: [u32; 3]) -> u32 {
    let [x, y, z] = cell.map(|i| {
        let fours = (i & 0xff | i << 8) & 0x00_f00f;
        (fours | fours << 4) & 0x0c_30c3
    });
    x | y << 2 | z << 4
}

/// The smallest f32 not below `c`.
#[inline(always)]
#[allow(clippy::cast_possible_truncation, reason = "rounded up")]
fn not_below(c: f64) -> f32 {
    let nearest = c as f32;
    if f64::from(nearest) < c { nearest.next_up() } else { nearest }
}

/// The axis of the largest number, of equal ones the last, and that number.
#[inline(always)]
fn last_of(t: Vec4) -> (usize, f32) {
    let [x, y, z, _] = t.to_array();
    let (a, t) = (usize::from(y >= x), if x > y { x } else { y });
    let last = usize::from(z >= t);
    // Without branches, which nothing could foretell.
    (a & !last | last << 1, if t > z { t } else { z })
}

/// The axis of the smallest number, of equal ones the first, and that number.
#[inline(always)]
fn first_of(t: Vec4) -> (usize, f32) {
    let [x, y, z, _] = t.to_array();
    let (a, t) = (usize::from(y < x), if y < x { y } else { x });
    let last = usize::from(z < t);
    (a & !last | last << 1, if z < t { z } else { t })
}

#[inline]
fn cap(axis: usize, far: bool, side: Side) -> Target {
    #[allow(clippy::cast_possible_truncation, reason = "an axis is below 3")]
    Target::Cap(axis as u8 + 3 * u8::from(far), side)
}
