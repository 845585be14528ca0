//! Nodes next to a luminaire, nearer to it than its points are to each other: of points that all nodes share one or two would give such
//! a node most of its light. Each looks at points of its own instead, spread over the solid angle, along segments.

use super::blockers::Blockers;
use super::grid::Geometry;
use super::pack::LANES;
use super::points::Points;
use super::segments::Segments;
use crate::flattened::Side;
use crate::isa::Isa;
use crate::luminaire::{Aim, unoccluded};
use crate::polygon::LocalPolygon;
use crate::rng::{Sobol, Stage};
use crate::scene::Scene;
use glam::DVec3;
use rayon::prelude::*;

/// Replaces \[Σ V g, Σ g\] of the nodes near luminaire `number` (`sums`: per node, per side) by those of points of their own: as many
/// as a replicate has.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the lattice; sums are f32")]
pub(super) fn look(
    (scene, geometry, isa): (&Scene, &Geometry, Isa),
    (number, blockers): (u32, &Blockers),
    sides: &[Side],
    part: Points,
    sums: &mut [[f32; 2]],
) {
    let lattice = scene.lattice();
    let light = &scene.polygons()[number as usize];
    let Points { seed, replicate, count, .. } = part;
    let reach = (light.area() / count as f64).sqrt();
    let [nx, ny, _] = geometry.dims;
    let per = sides.len();
    let (lo, hi) = bounds(scene, number, reach);
    sums.par_chunks_mut(per * nx).enumerate().with_max_len(8).for_each(|(row, sums)| {
        let (j, k) = ((row % ny) as f64, (row / ny) as f64);
        if !(lo.y..=hi.y).contains(&j) || !(lo.z..=hi.z).contains(&k) {
            return;
        }
        geometry.lit_nodes(row, |i| {
            let x = DVec3::new(i as f64, j, k);
            let world = lattice.to_world(x);
            if !(lo.x..=hi.x).contains(&x.x) || light.distance(world) >= reach {
                return;
            }
            let at = row * nx + i;
            let Some(normal) = geometry.normal(at) else { return };
            let h = geometry.h[at];
            for (s, &side) in sides.iter().enumerate() {
                let normal = if side == Side::Lower { normal } else { -normal };
                let open = unoccluded(light, world, normal);
                let aim = if open > 0.0 { Aim::best(light, world, normal, open) } else { None };
                let key = 1 << 62 | u64::from(number) << 40 | (at * per + s) as u64;
                let set = Sobol::set(seed, Stage::Sweep, key);
                let sample = |aim: &Aim, n: usize| {
                    let (y, g) = aim.sample(set.point2((replicate * count + n) as u32, 0));
                    (lattice.to_index(y), g)
                };
                let mut sum = [0f64; 2];
                for first in (0..count).step_by(LANES) {
                    let Some(aim) = &aim else { break };
                    let mut segments = Segments::NONE;
                    let mut weights = [0.0; LANES];
                    for (lane, weight) in weights.iter_mut().enumerate().take(count - first) {
                        let (y, g) = sample(aim, first + lane);
                        sum[1] += g;
                        if g > 0.0 && !blockers.block(number, None, y, x) {
                            *weight = g;
                            segments.set_before(lane, &scene.field, y, x);
                        }
                    }
                    isa.extrema(geometry.h, &mut segments);
                    for (lane, g) in weights.into_iter().enumerate() {
                        let open = match side {
                            Side::Lower => segments.most[lane] < h,
                            Side::Higher => segments.least[lane] >= h,
                        };
                        sum[0] += if open { g } else { 0.0 };
                    }
                }
                sums[i * per + s] = sum.map(|x| x as f32);
            }
        });
    });
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
