//! Small pieces of context geometry share photons: each alone would be a spot of noise.

use crate::flat;
use crate::nearest::{Neighbours, PointGrid};
use crate::scene::Scene;
use glam::Vec3;
use rayon::prelude::*;

/// Texels of a wall that the radius of a pool spans.
const REACH: f64 = 2.0;

/// Least cosine between the normals of a pool.
const CONE: f32 = 0.7;

/// For each flat, the flats whose photons it takes.
pub(super) struct Pools {
    /// Of flats that are smaller than a texel; the others are alone.
    members: Vec<Option<Vec<u32>>>,
}

impl Pools {
    /// Pools of flats that are as small as a texel of a wall with `across` of them: those around that look the same
    /// way.
    pub(super) fn new(scene: &Scene, across: usize) -> Self {
        let origin = scene.bounds()[0];
        let small: Vec<(u32, Vec3, Vec3)> = (0u32..)
            .zip(scene.polygons())
            .filter(|(_, p)| p.other_face != 0)
            .filter_map(|(n, p)| {
                let flat = flat::flat(scene, n as usize)?;
                let single = flat.resolution(across, 1) == [1, 1, 1] && !flat.albedo.black();
                single.then(|| (n, (p.middle() - origin).as_vec3(), p.normal().as_vec3()))
            })
            .collect();
        let grid = PointGrid::new(&small.iter().map(|s| s.1).collect::<Vec<_>>(), 3.0);
        let [lo, hi] = scene.bounds();
        #[allow(clippy::cast_possible_truncation, reason = "a length")]
        let radius = (REACH * (hi - lo).max_element() / across as f64) as f32;
        let pools: Vec<Vec<u32>> = small
            .par_iter()
            .map_init(Neighbours::default, |scratch, &(n, centre, normal)| {
                let of = |slot: u32| &small[grid.numbers()[slot as usize] as usize];
                grid.nearest(centre, usize::MAX, radius, |slot| of(slot).2.dot(normal) >= CONE, scratch);
                let mut pool: Vec<u32> = scratch.found().iter().map(|f| of(f.1).0).collect();
                if !pool.contains(&n) {
                    pool.push(n);
                }
                // One order, so that sums have the same bits.
                pool.sort_unstable();
                pool
            })
            .collect();
        let mut members = vec![None; flat::count(scene)];
        for ((n, ..), pool) in small.iter().zip(pools) {
            members[*n as usize] = Some(pool);
        }
        Self { members }
    }

    /// The flats that flat `n` takes photons of.
    pub(super) fn of(&self, n: usize) -> impl Iterator<Item = usize> {
        let pool = self.members[n].as_deref();
        pool.into_iter().flatten().map(|&m| m as usize).chain(pool.is_none().then_some(n))
    }

    /// Area of the pool of flat `n` in areas of its own.
    pub(super) fn area(&self, scene: &Scene, n: usize) -> f64 {
        let area = |m: u32| scene.polygons()[m as usize].area();
        self.members[n]
            .as_ref()
            .map_or(1.0, |pool| pool.iter().map(|&m| area(m)).sum::<f64>() / scene.polygons()[n].area())
    }
}
