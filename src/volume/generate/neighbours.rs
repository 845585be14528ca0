//! Who is near whom: a box that may be periodic, linked cells, neighbour lists and clusters.

use glam::DVec3;
use rayon::prelude::*;

/// The box [0, size) of a simulation; along some axes it repeats.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SimulationBox {
    /// Edge lengths.
    pub size: DVec3,
    /// Which axes repeat.
    pub periodic: [bool; 3],
}

impl SimulationBox {
    /// The separation `d` of two points to the nearest image, for |d| < 1.5 edges along every axis.
    #[inline]
    pub fn nearest_image(&self, d: DVec3) -> DVec3 {
        // Without branches and, unlike rounding, without a call on machines before SSE4.1.
        let one = |d: f64, size: f64, periodic: bool| {
            let size = if periodic { size } else { 0.0 };
            let half = if periodic { 0.5 * size } else { f64::INFINITY };
            d - if d > half { size } else { 0.0 } + if d < -half { size } else { 0.0 }
        };
        DVec3::new(
            one(d.x, self.size.x, self.periodic[0]),
            one(d.y, self.size.y, self.periodic[1]),
            one(d.z, self.size.z, self.periodic[2]),
        )
    }

    /// A point moved into [0, size) along the axes that repeat.
    pub fn wrap(&self, x: DVec3) -> DVec3 {
        let one = |a: usize| if self.periodic[a] { x[a].rem_euclid(self.size[a]) } else { x[a] };
        DVec3::new(one(0), one(1), one(2))
    }

    /// Shortest edge that repeats; infinite if none does.
    pub fn period(&self) -> f64 {
        (0..3).filter(|&a| self.periodic[a]).map(|a| self.size[a]).fold(f64::INFINITY, f64::min)
    }
}

/// Linked cells: particles sorted by cell, the cells at least as wide as the reach.
struct Cells<'a> {
    bounds: &'a SimulationBox,
    counts: [usize; 3],
    starts: Vec<usize>,
    particles: Vec<u32>,
}

impl<'a> Cells<'a> {
    fn new(bounds: &'a SimulationBox, positions: &[DVec3], members: &[u32], reach: f64) -> Self {
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a small count")]
        let counts = bounds.size.to_array().map(|s| ((s / reach) as usize).clamp(1, 256));
        let mut cells = Self { bounds, counts, starts: vec![], particles: vec![0; members.len()] };
        let home: Vec<usize> = members.iter().map(|&i| cells.index(cells.cell(positions[i as usize]))).collect();
        let mut starts = vec![0; counts.iter().product::<usize>() + 1];
        for &c in &home {
            starts[c + 1] += 1;
        }
        for c in 1..starts.len() {
            starts[c] += starts[c - 1];
        }
        let mut next = starts.clone();
        for (&i, &c) in members.iter().zip(&home) {
            cells.particles[next[c]] = i;
            next[c] += 1;
        }
        cells.starts = starts;
        cells
    }

    fn cell(&self, x: DVec3) -> [usize; 3] {
        let x = self.bounds.wrap(x) / self.bounds.size;
        // A particle in a wall belongs to the cell beside it.
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "negative numbers become 0")]
        std::array::from_fn(|a| ((x[a] * self.counts[a] as f64) as usize).min(self.counts[a] - 1))
    }

    fn index(&self, [i, j, k]: [usize; 3]) -> usize {
        (k * self.counts[1] + j) * self.counts[0] + i
    }

    /// The cells along axis `a` that touch cell `i`, itself included, each once.
    fn beside(&self, a: usize, i: usize) -> impl Iterator<Item = usize> + use<> {
        let n = self.counts[a];
        let clipped = i.saturating_sub(1)..=(i + 1).min(n - 1);
        let around = if self.bounds.periodic[a] && n > 2 { Some([(i + n - 1) % n, i, (i + 1) % n]) } else { None };
        let clipped = if around.is_some() { None } else { Some(clipped) };
        around.into_iter().flatten().chain(clipped.into_iter().flatten())
    }

    /// Calls `found` with every particle in reach of `x`, in an order that depends on nothing but positions.
    fn around(&self, x: DVec3, mut found: impl FnMut(u32)) {
        let [i, j, k] = self.cell(x);
        for k in self.beside(2, k) {
            for j in self.beside(1, j) {
                for i in self.beside(0, i) {
                    let c = self.index([i, j, k]);
                    self.particles[self.starts[c]..self.starts[c + 1]].iter().for_each(|&p| found(p));
                }
            }
        }
    }
}

/// For each particle, those within `reach` of it, as far as `members` says that either matters; itself excluded.
/// Particles that are no members have none. Positions must lie within half an edge of the box.
///
/// `reach` must be at most half of [`SimulationBox::period`].
pub fn neighbours(bounds: &SimulationBox, positions: &[DVec3], members: &[u32], reach: f64) -> Vec<Vec<u32>> {
    let cells = Cells::new(bounds, positions, members, reach);
    let near = |&i: &u32| {
        let x = positions[i as usize];
        let mut near = Vec::new();
        cells.around(x, |j| {
            let d = bounds.nearest_image(x - positions[j as usize]);
            if j != i && d.length_squared() < reach * reach {
                near.push(j);
            }
        });
        near
    };
    let found: Vec<Vec<u32>> = members.par_iter().map(near).collect();
    let mut all = vec![Vec::new(); positions.len()];
    for (&i, near) in members.iter().zip(found) {
        all[i as usize] = near;
    }
    all
}

/// Sizes of the clusters, greatest first: two particles closer than `link` belong to the same one (friends of friends).
pub fn clusters(bounds: &SimulationBox, positions: &[DVec3], link: f64) -> Vec<usize> {
    #[allow(clippy::cast_possible_truncation, reason = "particles are counted in u32")]
    let members: Vec<u32> = (0..positions.len() as u32).collect();
    let near = neighbours(bounds, positions, &members, link);
    let mut seen = vec![false; positions.len()];
    let mut sizes = Vec::new();
    for first in members {
        if seen[first as usize] {
            continue;
        }
        seen[first as usize] = true;
        let (mut open, mut size) = (vec![first], 0);
        while let Some(i) = open.pop() {
            size += 1;
            for &j in &near[i as usize] {
                if !std::mem::replace(&mut seen[j as usize], true) {
                    open.push(j);
                }
            }
        }
        sizes.push(size);
    }
    sizes.sort_unstable_by(|a, b| b.cmp(a));
    sizes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Rng, Stage};

    fn scattered(bounds: &SimulationBox, n: u64) -> Vec<DVec3> {
        let at = |i| {
            let mut rng = Rng::stream(3, Stage::Test, i);
            // Some a little outside, as between two rebuilds.
            DVec3::new(rng.unit(), rng.unit(), rng.unit()) * bounds.size * 1.04 - 0.02 * bounds.size
        };
        (0..n).map(at).collect()
    }

    #[test]
    fn linked_cells_find_what_all_pairs_find() {
        // Edges of 1, 2, 3 and more cells; periodic or not.
        for (size, periodic) in [
            (DVec3::new(10.0, 10.0, 10.0), [true; 3]),
            (DVec3::new(4.0, 5.5, 7.0), [true; 3]),
            (DVec3::new(3.0, 4.1, 9.0), [false, true, true]),
            (DVec3::new(4.5, 1.0, 6.5), [false; 3]),
            (DVec3::new(9.0, 4.9, 6.5), [false, false, true]),
        ] {
            let bounds = SimulationBox { size, periodic };
            let x = scattered(&bounds, 300);
            let members: Vec<u32> = (0..300).filter(|i| i % 3 != 0).collect();
            let found = neighbours(&bounds, &x, &members, 2.0);
            for i in 0..300u32 {
                let near = |j: &u32| {
                    let mut d = x[i as usize] - x[*j as usize];
                    for a in (0..3).filter(|&a| periodic[a]) {
                        d[a] -= size[a] * (d[a] / size[a]).round();
                    }
                    i % 3 != 0 && *j != i && d.length() < 2.0
                };
                let want: Vec<u32> = members.iter().copied().filter(near).collect();
                let mut have = found[i as usize].clone();
                have.sort_unstable();
                assert_eq!(have, want, "{bounds:?} particle {i}");
            }
        }
    }

    #[test]
    fn clusters_are_counted_across_the_faces() {
        let bounds = SimulationBox { size: DVec3::splat(10.0), periodic: [true; 3] };
        let x: Vec<DVec3> = [0.1, 1.0, 9.6, 5.0, 5.5, 7.5].iter().map(|&x| DVec3::new(x, 3.0, 9.9)).collect();
        assert_eq!(clusters(&bounds, &x, 1.0), [3, 2, 1]);
        assert_eq!(clusters(&SimulationBox { periodic: [false; 3], ..bounds }, &x, 1.0), [2, 2, 1, 1]);
    }
}
