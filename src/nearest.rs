//! Nearest points through a cell grid: counting sort, then shells of cells outwards from the query.
//!
//! Ours, because a uniform grid answers 15·10⁶ samples on a lattice 1.5× faster than the best k-d tree crate
//! and builds 7× faster; the crate is the oracle of the tests.

use glam::Vec3;
use rayon::prelude::*;

/// Points sorted into cubic cells.
#[derive(Clone, Debug)]
pub struct PointGrid {
    origin: Vec3,
    inverse_size: f32,
    size: f32,
    dims: [usize; 3],
    /// Start of each cell in `points`; one more entry than cells.
    starts: Vec<u32>,
    /// Positions, cell by cell.
    points: Vec<Vec3>,
    /// Original number of each position.
    numbers: Vec<u32>,
}

/// The k nearest so far, as (squared distance, slot in the grid); reusable between queries.
#[derive(Clone, Debug, Default)]
pub struct Neighbours {
    heap: Vec<(f32, u32)>,
}

impl Neighbours {
    /// (squared distance, slot) of every point found, in no particular order.
    pub fn found(&self) -> &[(f32, u32)] {
        &self.heap
    }

    /// Replaces the farthest; the heap is full.
    fn replace_top(&mut self, entry: (f32, u32)) {
        self.heap[0] = entry;
        let (mut i, n) = (0, self.heap.len());
        loop {
            let (l, r) = (2 * i + 1, 2 * i + 2);
            let mut m = i;
            if l < n && self.heap[l].0 > self.heap[m].0 {
                m = l;
            }
            if r < n && self.heap[r].0 > self.heap[m].0 {
                m = r;
            }
            if m == i {
                return;
            }
            self.heap.swap(i, m);
            i = m;
        }
    }

    fn push(&mut self, entry: (f32, u32)) {
        self.heap.push(entry);
        let mut i = self.heap.len() - 1;
        while i > 0 && self.heap[(i - 1) / 2].0 < self.heap[i].0 {
            self.heap.swap(i, (i - 1) / 2);
            i = (i - 1) / 2;
        }
    }
}

impl PointGrid {
    /// Sorts `points` (at most 2³² − 1) into cells of `per_cell` points on average over their bounding box.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "cell numbers are clamped to the grid")]
    pub fn new(points: &[Vec3], per_cell: f32) -> Self {
        let bounds = |[lo, hi]: [Vec3; 2], [a, b]: [Vec3; 2]| [lo.min(a), hi.max(b)];
        let some = points.par_iter().with_min_len(1 << 12).map(|&p| [p, p]).reduce_with(bounds);
        let [lo, hi] = some.unwrap_or_default();
        let extent = (hi - lo).max(Vec3::splat((hi - lo).max_element() * 1e-3)).max(Vec3::splat(1e-30));
        let size = (extent.x as f64 * extent.y as f64 * extent.z as f64 * f64::from(per_cell)
            / points.len().max(1) as f64)
            .cbrt() as f32;
        let size = size.max(extent.max_element() / 2048.0);
        let dims = [extent.x, extent.y, extent.z].map(|e| (e / size) as usize + 1);
        let mut grid = Self {
            origin: lo,
            inverse_size: 1.0 / size,
            size,
            dims,
            starts: vec![0; dims.iter().product::<usize>() + 1],
            // By all threads: the first touch of memory takes longer than the sorting.
            points: points.par_iter().with_min_len(1 << 14).map(|_| Vec3::ZERO).collect(),
            numbers: points.par_iter().with_min_len(1 << 14).map(|_| 0).collect(),
        };
        grid.sort(points);
        grid
    }

    /// Counting sort in two steps, each of which stays in the cache: into slabs of cells by runs of points, then within
    /// each slab.
    #[allow(clippy::cast_possible_truncation, reason = "points are numbered in 32 bits")]
    fn sort(&mut self, points: &[Vec3]) {
        const RUN: usize = 1 << 16;
        const SLABS: usize = 256;
        let cells = self.starts.len() - 1;
        let per_slab = cells.div_ceil(SLABS);
        // Of each run (cell, number) slab by slab, and where each slab ends.
        let run = |(run, points): (usize, &[Vec3])| {
            let cells: Vec<u32> = points.iter().map(|&p| self.index(self.cell(p))).collect();
            let mut ends = [0u32; SLABS + 1];
            cells.iter().for_each(|&c| ends[c as usize / per_slab + 1] += 1);
            for s in 0..SLABS {
                ends[s + 1] += ends[s];
            }
            let mut sorted = vec![(0u32, 0u32); points.len()];
            for (n, &c) in cells.iter().enumerate() {
                let next = &mut ends[c as usize / per_slab];
                sorted[*next as usize] = (c, (run * RUN + n) as u32);
                *next += 1;
            }
            (sorted, ends)
        };
        let runs: Vec<_> = points.par_chunks(RUN).enumerate().with_max_len(1).map(run).collect();
        let of = |slab: usize| {
            runs.iter().map(move |(sorted, ends)| {
                let start = if slab == 0 { 0 } else { ends[slab - 1] };
                &sorted[start as usize..ends[slab] as usize]
            })
        };
        let mut slabs = Vec::with_capacity(SLABS);
        let (mut before, mut places, mut numbers) = (0, &mut self.points[..], &mut self.numbers[..]);
        for (slab, starts) in self.starts[1..].chunks_mut(per_slab).enumerate() {
            let count = of(slab).map(<[_]>::len).sum();
            let here = (places.split_off_mut(..count), numbers.split_off_mut(..count));
            slabs.push((before, starts, here.0.expect("as many places"), here.1.expect("as many numbers")));
            before += count;
        }
        slabs.into_par_iter().enumerate().with_max_len(1).for_each(|(slab, (before, ends, places, numbers))| {
            let first = (slab * per_slab) as u32;
            let mut next = vec![0u32; ends.len() + 1];
            of(slab).flatten().for_each(|(c, _)| next[(c - first) as usize + 1] += 1);
            for c in 0..ends.len() {
                next[c + 1] += next[c];
                ends[c] = before as u32 + next[c + 1];
            }
            for &(c, number) in of(slab).flatten() {
                let slot = &mut next[(c - first) as usize];
                places[*slot as usize] = points[number as usize];
                numbers[*slot as usize] = number;
                *slot += 1;
            }
        });
        // By all threads, as it was taken.
        runs.into_par_iter().for_each(drop);
    }

    /// Original numbers in slot order: sort the payload by it, and slots index the payload.
    pub fn numbers(&self) -> &[u32] {
        &self.numbers
    }

    #[inline]
    #[allow(clippy::cast_possible_truncation, reason = "floats saturate")]
    fn cell(&self, p: Vec3) -> [i32; 3] {
        let q = (p - self.origin) * self.inverse_size;
        // What truncation takes for 0 instead of -1 is clamped to that.
        std::array::from_fn(|a| (q[a] as i32).clamp(0, self.dims[a] as i32 - 1))
    }

    #[inline]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "cells are inside the grid")]
    fn index(&self, [i, j, k]: [i32; 3]) -> u32 {
        ((k as usize * self.dims[1] + j as usize) * self.dims[0] + i as usize) as u32
    }

    /// Finds the `k` nearest points of `q` within `radius` that `accept(slot)` takes, into `out`.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "cells are inside the grid")]
    pub fn nearest(&self, q: Vec3, k: usize, radius: f32, mut accept: impl FnMut(u32) -> bool, out: &mut Neighbours) {
        out.heap.clear();
        if self.points.is_empty() || k == 0 {
            return;
        }
        let centre = self.cell(q);
        let mut limit = radius * radius;
        // Distance from q to the nearest face of its own cell; negative outside the grid.
        let local = (q - self.origin) - Vec3::from_array(centre.map(|c| c as f32)) * self.size;
        let near = local.min(Vec3::splat(self.size) - local).min_element();
        let shells = *self.dims.iter().max().expect("three dimensions") as i32;
        for shell in 0..shells {
            if shell > 0 {
                let reach = near + (shell - 1) as f32 * self.size;
                if reach > 0.0 && reach * reach > limit {
                    return;
                }
            }
            let range = |a: usize| {
                let n = self.dims[a] as i32 - 1;
                ((centre[a] - shell).max(0), (centre[a] + shell).min(n))
            };
            let ((x0, x1), (y0, y1), (z0, z1)) = (range(0), range(1), range(2));
            for z in z0..=z1 {
                for y in y0..=y1 {
                    let whole_row = (z - centre[2]).abs() == shell || (y - centre[1]).abs() == shell;
                    let mut visit = |from: i32, to: i32| {
                        let row = self.index([0, y, z]) as usize;
                        let slots = self.starts[row + from as usize]..self.starts[row + to as usize + 1];
                        for slot in slots {
                            let d2 = (self.points[slot as usize] - q).length_squared();
                            if d2 <= limit && accept(slot) {
                                if out.heap.len() < k {
                                    out.push((d2, slot));
                                } else {
                                    out.replace_top((d2, slot));
                                }
                                if out.heap.len() == k {
                                    limit = out.heap[0].0;
                                }
                            }
                        }
                    };
                    if whole_row {
                        visit(x0, x1);
                    } else {
                        for x in [centre[0] - shell, centre[0] + shell] {
                            if (0..self.dims[0] as i32).contains(&x) {
                                visit(x, x);
                            }
                        }
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Rng, Stage};

    #[test]
    fn finds_exactly_what_a_full_search_finds() {
        let mut rng = Rng::stream(1, Stage::Test, 0);
        let mut point = |flat: bool| {
            Vec3::new(rng.unit() as f32 * 3.0, rng.unit() as f32, if flat { 0.5 } else { rng.unit() as f32 * 0.2 })
        };
        for (flat, away) in [(false, Vec3::ZERO), (true, Vec3::ZERO), (false, Vec3::new(-7.0, 100.0, 3.0))] {
            let mut point = |flat: bool| away + point(flat);
            let points: Vec<Vec3> = (0..5000).map(|_| point(flat)).collect();
            let grid = PointGrid::new(&points, 4.0);
            let mut out = Neighbours::default();
            for i in 0..500 {
                let q = point(false) + Vec3::splat(if i % 5 == 0 { 0.4 } else { 0.0 });
                let (k, radius) = (1 + i % 40, if i % 3 == 0 { 0.05 } else { f32::INFINITY });
                let odd = |slot: u32| grid.numbers()[slot as usize] % 2 == 1;
                grid.nearest(q, k, radius, odd, &mut out);
                let mut found: Vec<f32> = out.found().iter().map(|e| e.0).collect();
                found.sort_by(f32::total_cmp);
                let mut all: Vec<f32> = (1..5000).step_by(2).map(|n| (points[n] - q).length_squared()).collect();
                all.retain(|d| *d <= radius * radius);
                all.sort_by(f32::total_cmp);
                all.truncate(k);
                assert_eq!(found, all, "query {i}");
            }
        }
    }

    /// More points than one run holds, in cells of which many are empty.
    #[test]
    fn every_point_is_in_its_cell_in_the_order_of_its_number() {
        let mut rng = Rng::stream(2, Stage::Test, 0);
        let mut point = || Vec3::new(rng.unit() as f32, rng.unit() as f32, 30.0 * rng.unit().powi(9) as f32);
        let points: Vec<Vec3> = (0..200_000).map(|_| point()).collect();
        let grid = PointGrid::new(&points, 2.0);
        assert_eq!((grid.starts[0], grid.starts[grid.starts.len() - 1]), (0, 200_000));
        for (cell, range) in grid.starts.windows(2).enumerate() {
            let slots = range[0] as usize..range[1] as usize;
            assert!(grid.numbers[slots.clone()].is_sorted_by(|a, b| a < b));
            for slot in slots {
                assert_eq!(grid.points[slot], points[grid.numbers[slot] as usize]);
                assert_eq!(grid.index(grid.cell(grid.points[slot])) as usize, cell);
            }
        }
        let mut numbers = grid.numbers;
        numbers.sort_unstable();
        assert!(numbers.into_iter().eq(0..200_000));
    }

    #[test]
    fn empty_and_coincident_points() {
        let mut out = Neighbours::default();
        PointGrid::new(&[], 2.0).nearest(Vec3::ZERO, 3, 1.0, |_| true, &mut out);
        assert!(out.found().is_empty());
        PointGrid::new(&[Vec3::ONE; 10], 2.0).nearest(Vec3::ZERO, 3, 9.0, |_| true, &mut out);
        assert_eq!(out.found().len(), 3);
    }
}
