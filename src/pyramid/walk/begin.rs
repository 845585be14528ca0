//! How a ray begins: the part of it in Ω, its isovalue, and the cell of its departure.

use super::{Begun, Child, FLIPS, INTEGERS, Lane, PARALLEL, Ray, Step, cap, first_of, not_below, point, state};
use crate::field::Field;
use crate::flattened::{Departure, Entry, FlattenedHit, FlattenedRay, Side, enter};
use crate::pyramid::Pyramid;
use crate::pyramid::kernel::{Kernel, Line, Piece};
use glam::{Vec3, Vec4};

impl Pyramid {
    /// What comes before the hierarchy: the part of the ray in Ω, its isovalue, and the cell of its departure.
    #[inline(always)]
    pub(in crate::pyramid) fn begin<'a, const ANY: bool, K: Kernel>(
        &self,
        kernel: K,
        field: &'a Field,
        ray: &FlattenedRay,
        reach: f64,
        lane: &mut Option<Lane<'a, K::Constants>>,
    ) -> Begun {
        match self.begin_within(kernel, field, ray, reach, lane) {
            Begun::Otherwise => kernel.outlined(|| self.begin_anywhere::<ANY, K>(kernel, field, ray, reach, lane)),
            begun => begun,
        }
    }

    /// [`Pyramid::begin`] of most rays: they start amid Ω, and those on the surface leave their cell without meeting it
    /// again.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, reason = "clamped: t and c leave as f32")]
    fn begin_within<'a, K: Kernel>(
        &self,
        kernel: K,
        field: &'a Field,
        ray: &FlattenedRay,
        reach: f64,
        lane: &mut Option<Lane<'a, K::Constants>>,
    ) -> Begun {
        let (origin, direction) = (ray.origin.extend(0.5), ray.direction.extend(0.0));
        let size = direction.abs();
        let scale = size.max_element();
        let amid = (origin.cmpgt(Vec4::ZERO) & origin.cmplt(self.far)).all();
        if !(amid && scale > 0.0 && scale < f32::INFINITY) || matches!(ray.departure, Departure::Cap(..)) {
            return Begun::Otherwise;
        }
        let backward = direction.cmplt(Vec4::ZERO);
        let floor = origin.floor();
        // On a shared plane the ray is in the cell it goes to.
        let corner = floor - Vec4::select(backward & origin.cmpeq(floor), Vec4::ONE, Vec4::ZERO);
        let [x, y, z, _] = (corner + INTEGERS).to_array().map(|x| x.to_bits() & 0x7f_ffff);
        let cell = [x, y, z];
        let start = self.nodes(cell);
        // What is cold most often, on the way while the first cell is computed.
        self.prefetch(kernel, &start);
        let crosses = size.cmpgt(Vec4::splat(PARALLEL * scale));
        let backward = backward & crosses;
        let mut line = Line {
            start: origin,
            d: direction / scale,
            o: Vec4::select(crosses, origin, corner + 0.5),
            inv: Vec4::select(crosses, scale / direction, Vec4::splat(1e30)),
            far: Vec4::select(backward, Vec4::ZERO, Vec4::ONE),
            flip: FLIPS[backward.bitmask() as usize & 7],
            // Roughly: the cells decide.
            end: (reach * f64::from(scale) * (1.0 + 1e-5) + 1e-3) as f32,
            most_lo: 0,
            least_hi: 0,
        };
        let (o, d) = (origin.to_array().map(f64::from), direction.to_array().map(f64::from));
        let inv = d.map(|x| 1.0 / x);
        let (mut c, mut c32) = (f64::from(ray.isovalue), ray.isovalue);
        let mut departing = false;
        if let Departure::Surface(side) = ray.departure {
            let planes = corner + line.far;
            let (exit, _) = first_of(line.times(planes));
            let t_exit = ((f64::from(planes.to_array()[exit]) - o[exit]) * inv[exit]).max(0.0);
            let last = t_exit >= reach;
            let corners = kernel.corners(field.samples(), self.sample(cell), self.steps);
            self.ask_around(kernel, field.samples(), &line, cell);
            let on = if last { 0 } else { 1 << exit };
            let t = [0.0, if last { reach } else { t_exit }];
            let v = kernel.span(&corners, &Piece { o: &o, d: &d, far: line.far, cell: corner, t, on: [0, on] });
            // So that the root at the start is exactly 0.
            c = v[0];
            c32 = not_below(c);
            // The Bernstein coefficients of the cubic without this root, but for factors.
            let sign = if side == Side::Higher { 1.0 } else { -1.0 };
            let rises = [(v[1] + v[2] + v[4]) - 3.0 * c, (v[3] + v[5] + v[6]) - 3.0 * c, v[7] - c].map(|x| sign * x);
            let clear = (rises[0] > self.rounding) & (rises[1] > self.rounding) & (rises[2] > self.rounding);
            let inside = kernel.inside(&corners, c32);
            let end = state(inside, exit, !line.negative(exit), v[7] >= c);
            if !(clear & (last | (end == (side == Side::Higher)))) {
                return Begun::Otherwise;
            }
            if last {
                return Begun::Done(None);
            }
            departing = true;
        }
        line.hold(&self.ranks, c32);
        let ray = Ray {
            samples: field.samples(),
            steps: self.steps,
            o,
            d,
            inv,
            c,
            c32,
            base: Vec4::ZERO,
            t: 0.0,
            reach,
            within: true,
        };
        *lane = Some(Lane::new(kernel.constants(&line), ray, line, start, departing, self.capped));
        Begun::On
    }

    /// Asks memory for the rows of samples that the cells after `cell` add: most rays that leave a surface meet it in a
    /// neighbour's cell, and look there.
    #[inline(always)]
    fn ask_around<K: Kernel>(&self, kernel: K, samples: &[f32], line: &Line, cell: [u32; 3]) {
        let at = samples.as_ptr().wrapping_add(self.sample(cell));
        let [y, z] = self.steps;
        let beyond = |axis: usize, step: usize| {
            at.wrapping_add(if line.negative(axis) { step.wrapping_neg() } else { 2 * step })
        };
        for row in [beyond(1, y), beyond(1, y).wrapping_add(z), beyond(2, z), beyond(2, z).wrapping_add(y)] {
            kernel.ask(row.cast());
        }
    }

    /// The cell of a start, roughly: only to ask memory for it.
    #[inline(always)]
    pub(in crate::pyramid) fn start(&self, origin: Vec3) -> Child {
        let floor = origin.extend(0.0).max(Vec4::ZERO).min(self.far).floor();
        let [x, y, z, _] = (floor + INTEGERS).to_array().map(|x| x.to_bits() & 0x7f_ffff);
        Child { level: 0, at: self.sample([x, y, z]) }
    }

    /// [`Pyramid::begin`] of any ray.
    #[allow(clippy::cast_possible_truncation, reason = "clamped cell numbers; t leaves as f32")]
    #[inline(always)]
    fn begin_anywhere<'a, const ANY: bool, K: Kernel>(
        &self,
        kernel: K,
        field: &'a Field,
        ray: &FlattenedRay,
        reach: f64,
        lane: &mut Option<Lane<'a, K::Constants>>,
    ) -> Begun {
        let (mut o, d) = (ray.origin.as_dvec3().to_array(), ray.direction.as_dvec3().to_array());
        if let Some(hit) = self.ends_at_once(ray.departure, &mut o, d) {
            return Begun::Done(hit);
        }
        let inv = d.map(|x| 1.0 / x);
        let Some(Entry { t, axis: entry }) = enter(self.cells, o, d, inv, reach) else { return Begun::Done(None) };
        let (cell, base, mut line) = self.line([o, d, inv], t, entry.is_some(), reach);
        let mut start = self.nodes(cell);
        self.prefetch(kernel, &start);
        start.places = start.places.map(|place| place.from(base));

        let c = f64::from(ray.isovalue);
        let within = entry.is_none();
        let four = |[x, y, z]: [f64; 3]| [x, y, z, 0.0];
        let (samples, steps) = (field.samples(), self.steps);
        let (o, d, inv) = (four(o), four(d), four(inv));
        let mut ray_in = Ray { samples, steps, o, d, inv, c, c32: ray.isovalue, base, t, reach, within };
        let mut departing = None;
        if let (Departure::Surface(side), true) = (ray.departure, within) {
            let here = ray_in.cell_at(self.sample(cell)).value(ray_in.local(point(cell), 0.0));
            if here.is_finite() {
                // So that the root at the start is exactly 0.
                (ray_in.c, ray_in.c32) = (here, not_below(here));
                departing = Some(side);
            }
        }
        line.hold(&self.ranks, ray_in.c32);
        let ray = ray_in;
        if let Some(axis) = entry {
            let far = d[axis] < 0.0;
            if self.capped && ray.cell_at(self.sample(cell)).face_inside_ray(axis, far, &ray, point(cell), t) {
                return Begun::Done(Some(FlattenedHit { t: t as f32, target: cap(axis, far, Side::Lower) }));
            }
        }
        if let Some(side) = departing {
            match ray.first_cell::<ANY>(&line, self.sample(cell), point(cell), side) {
                Step::On => {}
                Step::Hit(hit) => return Begun::Done(Some(hit)),
                Step::End => return Begun::Done(None),
            }
        }

        *lane = Some(Lane::new(kernel.constants(&line), ray, line, start, departing.is_some(), self.capped));
        Begun::On
    }

    /// Moves the start `o` of a ray that leaves a level set or a cap into Ω, where it is whatever its f32 coordinates;
    /// what it meets, if it ends there: at a cap, or without a hit.
    #[inline(always)]
    #[allow(clippy::option_option, reason = "the outer one goes on")]
    fn ends_at_once(&self, departure: Departure, o: &mut [f64; 3], d: [f64; 3]) -> Option<Option<FlattenedHit>> {
        let n = self.cells;
        // An edge is no way out. Faces from 6 on are another field's.
        if matches!(departure, Departure::Surface(_) | Departure::Cap(0..6, _)) {
            (0..3).for_each(|a| o[a] = o[a].clamp(0.0, n[a] as f64));
        }
        if let Departure::Cap(face @ 0..6, side) = departure {
            let (axis, far) = (usize::from(face % 3), face >= 3);
            let inward = if far { d[axis] < 0.0 } else { d[axis] > 0.0 };
            if inward != (side == Side::Higher) && d[axis] != 0.0 {
                return Some(Some(FlattenedHit { t: 0.0, target: cap(axis, far, side) }));
            }
            if side == Side::Lower {
                // Ω is convex: what leaves it never comes back.
                return Some(None);
            }
            o[axis] = if far { n[axis] as f64 } else { 0.0 };
        }
        if let Departure::Surface(side) = departure {
            let outwards = |a: usize| (o[a] == 0.0 && d[a] < 0.0) || (o[a] == n[a] as f64 && d[a] > 0.0);
            if let Some(axis) = (0..3).find(|&a| outwards(a)) {
                // It leaves Ω where it starts. There h = c counts as inside, which must not end a ray from the lower
                // side.
                let closed = self.capped && side == Side::Higher;
                let target = cap(axis, d[axis] > 0.0, side);
                return Some(closed.then_some(FlattenedHit { t: 0.0, target }));
            }
        }
        None
    }

    /// The cell of a ray (start, direction and its reciprocals) at `t`, and the line from there, with the lattice point
    /// that it counts from. A ray that enters Ω does so between f32's numbers: far from the first corner it would cross
    /// planes sooner or later than a line that counts from there, the more, the smaller the angle. From the lattice
    /// point nearest to it f32 tells all times alike well.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, reason = "clamped cell numbers; lines are f32")]
    fn line(&self, [o, d, inv]: [[f64; 3]; 3], t: f64, enters: bool, reach: f64) -> ([u32; 3], Vec4, Line) {
        let scale = d[0].abs().max(d[1].abs()).max(d[2].abs());
        let (mut cell, mut base) = ([0u32; 3], Vec4::ZERO);
        let mut line = Line {
            start: Vec4::ZERO,
            d: Vec4::ZERO,
            o: Vec4::ZERO,
            inv: Vec4::splat(1e30),
            far: Vec4::ONE,
            flip: 0,
            // Roughly: the cells decide.
            end: ((reach - t) * scale * (1.0 + 1e-5) + 1e-3) as f32,
            most_lo: 0,
            least_hi: 0,
        };
        for a in 0..3 {
            let p = o[a] + t * d[a];
            base[a] = if enters { p.round() as f32 } else { 0.0 };
            let start = (p - f64::from(base[a])) as f32;
            (line.start[a], line.d[a]) = (start, (d[a] / scale) as f32);
            // On a shared plane the ray is in the cell it goes to.
            let below = d[a] < 0.0 && p == p.floor();
            cell[a] = (p.floor() as i32 - i32::from(below)).clamp(0, self.cells[a] as i32 - 1).cast_unsigned();
            if d[a].abs() > f64::from(PARALLEL) * scale {
                (line.o[a], line.inv[a]) = (start, (scale * inv[a]) as f32);
                line.flip |= (u32::from(d[a] < 0.0) * 3) << (2 * a);
                line.far[a] = if d[a] < 0.0 { 0.0 } else { 1.0 };
            } else {
                line.o[a] = cell[a] as f32 - base[a] + 0.5;
            }
        }
        (cell, base, line)
    }
}
