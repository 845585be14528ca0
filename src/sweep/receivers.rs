//! What the nodes of a row receive from a point of a luminaire, sixteen at a time: g of each, and the share of the
//! fan's lines around it that see the point.

#![allow(clippy::needless_range_loop, reason = "a lane indexes several arrays at once")]

use super::blockers::Blockers;
use super::fans::{Fan, Fans, HIGHER, Kept, LOWER, SAMPLED, TURN};
use super::normals::decode;
use super::pack::LANES;
use glam::DVec3;

/// A point of a luminaire and its fans.
pub(super) struct Emitter<'a> {
    pub fans: &'a Fans,
    /// The luminaire's number, and what stands before it.
    pub number: u32,
    pub blockers: &'a Blockers,
    /// Its normal.
    pub facing: [f32; 3],
    /// From one node of a row to the next, in units of the lattice.
    pub step: [f32; 3],
    /// 0 gives no light to a side that nobody asks for, by [`crate::flattened::Side::index`].
    pub wanted: [f32; 2],
    /// Where the sums of either side are among a node's.
    pub place: [usize; 2],
}

impl Emitter<'_> {
    /// Adds \[V g, g\] of nodes `i`.. of row (`j`, `k`), at most as many as there are lanes, to their sums, one per
    /// side that is asked for. `to` leads from node 0 to the point; the nodes' `normals` are 0 where none is lit.
    #[inline(always)]
    pub(super) fn receive(&self, [i, j, k]: [usize; 3], to: [f32; 3], normals: &[u32], sums: &mut [[f32; 2]]) {
        let mut n = [0; LANES];
        n[..normals.len()].copy_from_slice(normals);
        let (mut g, mut higher) = ([0f32; LANES], [false; LANES]);
        for l in 0..LANES {
            // The normal's length falls out of Σ V g / Σ g.
            let [x, y, z] = decode(n[l]);
            let [a, b, c] = [0, 1, 2].map(|axis| to[axis] - (i + l) as f32 * self.step[axis]);
            let (r2, cos_x) = (a * a + b * b + c * c, a * x + b * y + c * z);
            let cos_y = -(a * self.facing[0] + b * self.facing[1] + c * self.facing[2]);
            higher[l] = cos_x < 0.0;
            // A side that nobody asks for counts as facing away.
            let faces = cos_y > 0.0 && cos_x * self.wanted[usize::from(higher[l])] != 0.0;
            g[l] = if faces { cos_x.abs() * cos_y / (r2 * r2) } else { 0.0 };
        }
        let asked = g.map(|g| g != 0.0);
        if !asked.contains(&true) {
            return;
        }
        let seen = self.fans.visibility([i, j, k], &asked);
        let per = sums.len() / normals.len();
        for l in 0..normals.len() {
            let (g, mut v) = if seen.known[l] { (g[l], seen.shares[usize::from(higher[l])][l]) } else { (0.0, 0.0) };
            if !self.blockers.none() && asked[l] {
                let x = DVec3::new((i + l) as f64, j as f64, k as f64);
                v = if self.blockers.block(self.number, None, self.fans.source, x) { 0.0 } else { v };
            }
            let [seen, all] = &mut sums[l * per + self.place[usize::from(higher[l])]];
            *seen += g * v;
            *all += g;
        }
    }
}

/// What nodes see of a fan's source.
pub(super) struct Seen {
    /// The share of the four lines around each that see the source at their own isovalue there: lower, higher side. On
    /// Ω's faces, where the lines are on one side, it may be below 0 or above 1.
    pub shares: [[f32; LANES]; 2],
    /// False where no line passes.
    pub known: [bool; LANES],
}

impl Fans {
    /// What those that are `asked` of nodes `i`.. of row (`j`, `k`) see.
    #[inline(always)]
    pub(super) fn visibility(&self, [i, j, k]: [usize; 3], asked: &[bool; LANES]) -> Seen {
        let (y, far) = (self.source, self.far);
        // On a face that looks at the source the segment between them meets Ω in the node alone.
        let looks = |a: usize, x: f64| y[a] < 0.0 && x == 0.0 || y[a] > far[a] && x == far[a];
        let row = [i, j, k].map(|x| x as f64);
        let mut x = [0.0; LANES];
        (0..LANES).for_each(|l| x[l] = (i + l) as f64);
        if looks(1, row[1]) || looks(2, row[2]) {
            return Seen { shares: self.entering.map(|e| [e; LANES]), known: [true; LANES] };
        }
        let [b, c] = [(row[1] - y.y).abs(), (row[2] - y.z).abs()];
        let (axis, least) = if c >= b { (2, c) } else { (1, b) };
        let mut around = FourSeen::default();
        let mut along = [false; LANES];
        (0..LANES).for_each(|l| along[l] = (x[l] - y.x).abs() > least);
        // The fan of the axis along which the source is farthest away; up is where nodes are beyond it.
        let fan = |axis: usize, up: bool| self.fans[axis + if up { 3 } else { 0 }].as_ref();
        if (0..LANES).any(|l| asked[l] && !along[l])
            && let Some(fan) = fan(axis, row[axis] > y[axis])
        {
            fan.look_across(&self.seen, &x, row, &mut around);
        }
        for up in [false, true] {
            let mut own = [false; LANES];
            (0..LANES).for_each(|l| own[l] = asked[l] && along[l] && (x[l] > y.x) == up);
            if own.contains(&true) {
                match fan(0, up) {
                    Some(fan) => fan.look_along(&self.seen, &x, row, &own, &mut around),
                    None => (0..LANES).filter(|l| own[*l]).for_each(|l| (around.near[l], around.far[l]) = (0, 0)),
                }
            }
        }
        let mut seen = around.shares(self.turn);
        for l in 0..LANES {
            if looks(0, x[l]) {
                seen.known[l] = true;
                (0..2).for_each(|s| seen.shares[s][l] = self.entering[s]);
            }
        }
        seen
    }
}

/// What the four lines around nodes see, in two bytes each those of one row, and where the nodes lie between them.
#[derive(Default)]
struct FourSeen {
    near: [u32; LANES],
    far: [u32; LANES],
    f: [f32; LANES],
    g: [f32; LANES],
}

impl Fan {
    /// Looks up the four lines around nodes `x` of a row whose slices run across it.
    #[inline(always)]
    fn look_across(&self, seen: &[u8], x: &[f64; LANES], row: [f64; 3], out: &mut FourSeen) {
        let [_, v, a] = self.layout.axes.map(|axis| row[axis]);
        let inverse = self.depth / (a - self.source[2]);
        let step = self.step(a);
        let kept = *self.kept(step);
        let mut line = [0; LANES];
        for l in 0..LANES {
            (line[l], out.f[l]) = self.line(0, x[l], inverse, &kept);
        }
        let (j, g) = self.line(1, v, inverse, &kept);
        out.g = [g; LANES];
        let first = kept.first[0];
        let [near, far] = [0, 1].map(|dj| {
            let begin = self.line_zero(j as usize + dj, step).wrapping_add(first);
            &seen[begin..][..kept.count[0]]
        });
        for l in 0..LANES {
            let at = line[l] as usize - first;
            (out.near[l], out.far[l]) = (pair(near, at), pair(far, at));
        }
    }

    /// The same of those that are its `own`, where slices run along the row.
    #[inline(always)]
    fn look_along(&self, seen: &[u8], x: &[f64; LANES], row: [f64; 3], own: &[bool; LANES], out: &mut FourSeen) {
        let [u, v, _] = self.layout.axes.map(|axis| row[axis]);
        for l in 0..LANES {
            if own[l] {
                let inverse = self.depth / (x[l] - self.source[2]);
                let step = self.step(x[l]);
                let kept = self.kept(step);
                let ((line, f), (j, g)) = (self.line(0, u, inverse, kept), self.line(1, v, inverse, kept));
                (out.f[l], out.g[l]) = (f, g);
                let at = |dj: usize| pair(seen, self.line_zero(j as usize + dj, step).wrapping_add(line as usize));
                (out.near[l], out.far[l]) = (at(0), at(1));
            }
        }
    }

    /// Of the lines along u (`axis` 0) or v the cell where a node at `x` of that axis lies, and where in it: around it,
    /// or next to it within Ω if it is the first or last. `inverse`: the depth of the lattice's plane, in that of the
    /// node, in whose slice some are `kept`.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "clamped to the fan")]
    fn line(&self, axis: usize, x: f64, inverse: f64, kept: &Kept) -> (i32, f32) {
        let p = self.source[axis] + (x - self.source[axis]) * inverse - self.first[axis] as f64;
        let line = if x == 0.0 {
            p.ceil()
        } else if x == (self.layout.dims[axis] - 1) as f64 {
            p.floor() - 1.0
        } else {
            p
        };
        let first = kept.first[axis] as i32;
        let line = (line as i32).clamp(first, first + (kept.count[axis] - 2) as i32);
        (line, (p - f64::from(line)) as f32)
    }

    /// Slices from the first to slice `k`.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the fan")]
    fn step(&self, k: f64) -> usize {
        // A node as good as at the source lies before the first slice.
        (k as usize).abs_diff(self.slices.0).min(self.slices.1 - 1)
    }
}

/// What line `at` of those that are `seen` and the next one see.
#[inline(always)]
fn pair(seen: &[u8], at: usize) -> u32 {
    let pair = &seen[at..][..2];
    u32::from(u16::from_le_bytes([pair[0], pair[1]]))
}

impl FourSeen {
    #[inline(always)]
    fn shares(&self, turn: u8) -> Seen {
        let (turn, mask) = (u32::from(turn), u32::from(!(TURN - 1)));
        let mut seen = Seen { shares: [[0.0; LANES]; 2], known: [false; LANES] };
        for l in 0..LANES {
            let lines = [self.near[l] & 0xff, self.near[l] >> 8, self.far[l] & 0xff, self.far[l] >> 8];
            let lines = lines.map(|seen| if seen & mask == turn { seen } else { 0 });
            // Of lines some of which are missing those that are there, by distance.
            let all = lines[0] & lines[1] & lines[2] & lines[3] & u32::from(SAMPLED) != 0;
            let clamped = |f: f32| if all { f } else { f.clamp(0.0, 1.0) };
            let (f, g) = (clamped(self.f[l]), clamped(self.g[l]));
            let weights = [(1.0 - f) * (1.0 - g), f * (1.0 - g), (1.0 - f) * g, f * g];
            let sum = [SAMPLED, LOWER, HIGHER].map(|bit| {
                let seen = |n: usize| if lines[n] & u32::from(bit) != 0 { weights[n] } else { 0.0 };
                seen(0) + seen(1) + seen(2) + seen(3)
            });
            seen.known[l] = sum[0] > 0.0;
            (seen.shares[0][l], seen.shares[1][l]) = (sum[1] / sum[0], sum[2] / sum[0]);
        }
        seen
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flattened::Side;
    use crate::isa::Isa;
    use crate::scene::{Boundary, Scene, Surface, cornell_box};
    use crate::sweep::fans::tests::{noise, visibility};
    use crate::sweep::grid::Geometry;
    use glam::Vec3;

    /// What local `x` sees, one node at a time: the mean of the four lines around it in its fan.
    fn plain(fans: &Fans, x: [f64; 3]) -> Option<[f32; 2]> {
        let y = fans.source.to_array();
        if (0..3).any(|a| y[a] < 0.0 && x[a] == 0.0 || y[a] > fans.far[a] && x[a] == fans.far[a]) {
            return Some(fans.entering);
        }
        let away = [0, 1, 2].map(|a| (x[a] - y[a]).abs());
        let axis = [2, 1, 0].into_iter().reduce(|a, b| if away[b] > away[a] { b } else { a }).unwrap();
        let fan = fans.fans[axis + if x[axis] > y[axis] { 3 } else { 0 }].as_ref()?;
        let [u, v, a] = fan.layout.axes;
        let ratio = fan.depth / (x[a] - y[a]);
        let step = (x[a] as usize).abs_diff(fan.slices.0);
        let line = |n: usize, axis: usize| {
            let p = y[axis] + (x[axis] - y[axis]) * ratio - fan.first[n] as f64;
            let within = if x[axis] == 0.0 { p.ceil() } else { p };
            let within = if x[axis] == fans.far[axis] { p.floor() - 1.0 } else { within };
            let line = (within.max(0.0) as usize).min(fan.count[n] - 2);
            (line, (p - line as f64) as f32)
        };
        let ((i, f), (j, g)) = (line(0, u), line(1, v));
        let sees = |di: usize, dj: usize| {
            let seen = fans.seen[fan.at([i + di, j + dj], step).expect("lines around nodes are kept")];
            if seen & !(TURN - 1) == fans.turn { seen } else { 0 }
        };
        let lines = [sees(0, 0), sees(1, 0), sees(0, 1), sees(1, 1)];
        let all = lines.iter().all(|seen| seen & SAMPLED != 0);
        let (f, g) = if all { (f, g) } else { (f.clamp(0.0, 1.0), g.clamp(0.0, 1.0)) };
        let weights = [(1.0 - f) * (1.0 - g), f * (1.0 - g), (1.0 - f) * g, f * g];
        let sum = |bit| lines.iter().zip(weights).map(|(seen, w)| if seen & bit != 0 { w } else { 0.0 }).sum::<f32>();
        let known = sum(SAMPLED);
        (known > 0.0).then(|| [LOWER, HIGHER].map(|bit| sum(bit) / known))
    }

    /// Sources in the lattice, on its nodes and sides, and outside.
    #[test]
    fn rows_see_what_their_nodes_do() {
        let field = noise([37, 12, 14], 30, Some(100));
        let (geometry, isa, sides) = (Geometry::new(&field), Isa::current(), [Side::Lower]);
        let mut fans = Fans::default();
        let (mut partial, mut unknown, mut outward) = (0, 0, 0);
        for y in [
            [18.3, 5.2, 6.1],
            [18.0, 5.0, 6.0],
            [30.9, 11.0, 0.2],
            [0.0, 3.3, 13.0],
            [-3.0, 5.2, 6.1],
            [41.3, 13.0, 17.7],
            [8.0, -0.4, 15.5],
            [17.9, 6.3, 15.2],
        ] {
            let open = [f32::NEG_INFINITY, f32::INFINITY];
            fans.march((&geometry, isa, &sides), DVec3::from_array(y), if y[2] < 7.0 { [0.4; 2] } else { open });
            for at in 0..geometry.h.len() {
                let x = field.lattice().ijk(at);
                // Nothing is asked of a node at the source.
                if x.map(|x| x as f64) == y {
                    continue;
                }
                let (seen, expected) = (visibility(&fans, x), plain(&fans, x.map(|x| x as f64)));
                assert_eq!(seen, expected, "{x:?} from {y:?}");
                let [v, _] = seen.unwrap_or_default();
                partial += usize::from(v > 0.0 && v < 1.0);
                outward += usize::from(!(0.0..=1.0).contains(&v));
                unknown += usize::from(seen.is_none());
            }
        }
        assert!(partial > 5000 && unknown > 1000 && outward > 100, "{partial} {unknown} {outward}");
    }

    /// Σ V g and Σ g of both sides by every instruction set, and of one at a time.
    #[test]
    fn every_instruction_set_receives_the_same_bits() {
        let field = noise([37, 12, 14], 30, Some(100));
        let scene =
            Scene::new(field.clone(), Surface::default(), Boundary::Open, cornell_box(field.lattice(), 0.1).unwrap())
                .unwrap();
        let geometry = Geometry::new(&field);
        let both = Side::BOTH;
        let mut fans = Fans::default();
        fans.march((&geometry, Isa::PLAIN, &both), DVec3::new(21.3, 12.7, 6.2), [f32::NEG_INFINITY, f32::INFINITY]);
        let blockers = Blockers::new(&scene, 0, &[]);
        assert!(blockers.none());
        let receive = |isa: Isa, wanted: [f32; 2], place: [usize; 2]| {
            let per = 1 + place[1];
            let lit = geometry.lit_rows();
            let mut sums = vec![[0.5f32; 2]; per * lit.len()];
            let emitter = Emitter {
                fans: &fans,
                number: 0,
                blockers: &blockers,
                facing: [0.1, -0.9, 0.2],
                step: [0.2, 0.01, 0.0],
                wanted,
                place,
            };
            for (row, sums) in lit.split(&mut sums, per).into_iter().enumerate() {
                let (first, run) = lit.run(row);
                let to = [4.26, 2.54 - 0.2 * (row % 12) as f32, 1.24 - 0.2 * (row / 12) as f32];
                geometry.lit_vectors(row, |a, b| {
                    let normals = &geometry.normals[run.clone()][a - first..b - first];
                    let sums = &mut sums[per * (a - first)..per * (b - first)];
                    isa.receive(&emitter, [a, row % 12, row / 12], to, normals, sums);
                });
            }
            sums
        };
        let all = receive(Isa::PLAIN, [1.0; 2], [0, 1]);
        let bits = |sums: &[[f32; 2]]| sums.as_flattened().iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        for isa in Isa::found() {
            assert_eq!(bits(&receive(isa, [1.0; 2], [0, 1])), bits(&all), "{isa:?}");
        }
        for at in (0..geometry.h.len()).filter(|&at| geometry.lit(at)) {
            let [i, j, k] = field.lattice().ijk(at);
            let normal = geometry.along_normal(at);
            let to = Vec3::new(4.26 - 0.2 * i as f32, 2.54 - 0.2 * j as f32 - 0.01 * i as f32, 1.24 - 0.2 * k as f32);
            let (cos_x, cos_y) = (to.dot(normal), -to.dot(Vec3::new(0.1, -0.9, 0.2)));
            let mut expected = [[0.5; 2]; 2];
            if let Some(v) = visibility(&fans, [i, j, k])
                && cos_y > 0.0
            {
                let (side, g) = (usize::from(cos_x < 0.0), cos_x.abs() * cos_y / to.length_squared().powi(2));
                (expected[side][0], expected[side][1]) = (0.5 + g * v[side], 0.5 + g);
            }
            let place = geometry.lit_rows().place_of_lit(at);
            for (sum, expected) in all[2 * place..][..2].as_flattened().iter().zip(expected.as_flattened()) {
                assert!((sum - expected).abs() < 1e-4 * expected.abs().max(0.5), "{i} {j} {k}: {sum} {expected}");
            }
        }
        let [lower, higher] = [[1.0, 0.0], [0.0, 1.0]].map(|wanted| receive(Isa::current(), wanted, [0, 0]));
        let mut lit = [0; 2];
        for (n, sums) in all.chunks(2).enumerate() {
            assert_eq!((sums[0], sums[1]), (lower[n], higher[n]), "node {n}");
            (0..2).for_each(|s| lit[s] += usize::from(sums[s][0] > 0.5));
        }
        assert!(lit.iter().all(|n| *n > 200), "{lit:?}");
    }
}
