//! Nodes next to a luminaire, nearer to it than its points are to each other: of points that all nodes share one or two
//! would give such a node most of its light. Each looks at points of its own instead, spread over the solid angle,
//! along segments.

use super::Direct;
use crate::field::Field;
use crate::flattened::Side;
use crate::isa::Isa;
use crate::luminaire::Aim;
use crate::polygon::LocalPolygon;
use crate::rng::{Sobol, Stage};
use crate::scene::Scene;
use crate::sweep::blockers::Blockers;
use crate::sweep::grid::Geometry;
use crate::sweep::pack::LANES;
use crate::sweep::points::Points;
use crate::sweep::segments::Segments;
use glam::DVec3;
use rayon::prelude::*;

impl Direct<'_> {
    /// Replaces \[Σ V g, Σ g\] of the nodes near luminaire `number` (`sums`: per place of planes, per side) by those of
    /// points of their own: as many as a replicate has.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the lattice; sums are f32")]
    pub(super) fn look_from_near(&self, number: u32, blockers: &Blockers, sums: &mut [[f32; 2]]) {
        let (scene, geometry, sides, isa) = (self.scene, self.geometry, self.sides, self.isa);
        let lattice = scene.lattice();
        let light = &scene.polygons()[number as usize];
        let Points { seed, replicate, count, .. } = self.points;
        let reach = (light.area() / count as f64).sqrt();
        let [nx, ny, _] = geometry.dims;
        let per = sides.len();
        let (lo, hi) = bounds(scene, number, reach);
        let lit = geometry.lit_rows();
        lit.split(sums, per).into_par_iter().enumerate().with_max_len(8).for_each(|(row, sums)| {
            let (j, k) = ((row % ny) as f64, (row / ny) as f64);
            if !(lo.y..=hi.y).contains(&j) || !(lo.z..=hi.z).contains(&k) {
                return;
            }
            let (first, _) = lit.run(row);
            let mut looks =
                Looks { isa, geometry, sums, segments: Segments::NONE, taken: 0, looks: [Look::NONE; LANES] };
            geometry.lit_nodes(row, |i| {
                let x = DVec3::new(i as f64, j, k);
                let world = lattice.to_world(x);
                if !(lo.x..=hi.x).contains(&x.x) || !light.is_nearer(world, reach) {
                    return;
                }
                let at = row * nx + i;
                let Some(normal) = geometry.normal(at) else { return };
                let (h, place) = (geometry.h[at], (i - first) * per);
                for (s, &side) in sides.iter().enumerate() {
                    looks.sums[place + s] = [0.0; 2];
                    let normal = side.facing(normal);
                    let Some(aim) = Aim::best(light, world, normal) else { continue };
                    let key = 1 << 62 | u64::from(number) << 40 | (at * per + s) as u64;
                    let set = Sobol::set(seed, Stage::Sweep, key);
                    for n in replicate * count..(replicate + 1) * count {
                        let (y, g) = aim.sample(set.point2(n as u32, 0));
                        looks.sums[place + s][1] += g as f32;
                        let y = lattice.to_index(y);
                        // Caps let no light into solids.
                        let cap = scene.is_capped() && y.clamp(DVec3::ZERO, lattice.far()) != y;
                        let closed = side == Side::Higher && cap;
                        if g > 0.0 && !closed && !blockers.block(number, None, y, x) {
                            looks.add(&scene.field, [y, x], Look { place: place + s, side, h, g: g as f32, cap });
                        }
                    }
                }
            });
            looks.finish();
        });
    }
}

/// One from a node at a point.
#[derive(Clone, Copy)]
struct Look {
    /// Where the node's sums are, its side and its isovalue.
    place: usize,
    side: Side,
    h: f32,
    /// What the point gives if it is seen.
    g: f32,
    /// Whether a cap may stand between.
    cap: bool,
}

impl Look {
    const NONE: Self = Self { place: 0, side: Side::Lower, h: 0.0, g: 0.0, cap: false };
}

/// Looks of the nodes of a row, as many at a time as there are lanes.
struct Looks<'a> {
    isa: Isa,
    geometry: &'a Geometry<'a>,
    sums: &'a mut [[f32; 2]],
    segments: Segments,
    taken: usize,
    looks: [Look; LANES],
}

impl Looks<'_> {
    fn add(&mut self, field: &Field, [y, x]: [DVec3; 2], look: Look) {
        let enough = match look.side {
            Side::Lower => [f32::NEG_INFINITY, look.h],
            Side::Higher => [look.h, f32::INFINITY],
        };
        #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
        let h = |p: DVec3| field.value(p) as f32;
        self.segments.set_before(self.taken, field.lattice(), h, [y, x], enough);
        if self.geometry.has_gaps() {
            // On the side that looks.
            self.segments.set_node(self.taken, if look.side == Side::Lower { look.h.next_down() } else { look.h });
        }
        self.looks[self.taken] = look;
        self.taken += 1;
        if self.taken == LANES {
            self.finish();
        }
    }

    /// Adds what those that were taken see.
    fn finish(&mut self) {
        let (h, gaps) = (self.geometry.h, self.geometry.has_gaps());
        if !gaps {
            self.isa.extrema(h, &mut self.segments, None);
        }
        let Segments { least, most, .. } = &self.segments;
        for (lane, look) in self.looks[..self.taken].iter().enumerate() {
            let open = match look.side {
                // Only what holds the isovalue itself between two gaps hides it.
                _ if gaps => {
                    let ranges = self.segments.ranges(h, lane, [look.cap, false]);
                    !ranges.iter().any(|[least, most]| *least < look.h && *most >= look.h)
                }
                Side::Lower => most[lane] < look.h,
                Side::Higher => least[lane] >= look.h,
            };
            self.sums[look.place][0] += if open { look.g } else { 0.0 };
        }
        (self.segments, self.taken) = (Segments::NONE, 0);
    }
}

/// Bounds of all nodes within `reach` of a luminaire.
fn bounds(scene: &Scene, number: u32, reach: f64) -> (DVec3, DVec3) {
    let lattice = scene.lattice();
    let (lo, hi) = LocalPolygon::new(&scene.polygons()[number as usize], lattice).bounds();
    // A step of length 1 in the world is at most so long along each index.
    let inverse = lattice.axes().inverse().transpose();
    let most = reach * DVec3::new(inverse.x_axis.length(), inverse.y_axis.length(), inverse.z_axis.length());
    (lo - most, hi + most)
}
