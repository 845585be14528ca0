//! Where planes of light keep that of a row of nodes: the run that holds all lit ones, and nothing of what is dark
//! before and behind it. Of many volumes a small part is lit.

use super::blocks::Blocks;
use super::pack::LANES;
use rayon::prelude::*;
use std::ops::Range;

/// The runs of all rows in one memory order. Planes hold them one behind the other.
pub(super) struct LitRows {
    /// Nodes in a row.
    nu: usize,
    /// The first node of each run.
    first: Vec<u32>,
    /// Where it is in planes; one more entry than rows.
    starts: Vec<u32>,
}

impl LitRows {
    /// Of rows of `nu` nodes of which `blocks` hold the lit ones. Runs go on so far that vectors that begin at lit
    /// nodes, or end a row, lie within them.
    #[allow(clippy::cast_possible_truncation, reason = "nodes are numbered in 31 bits")]
    pub(super) fn new(nu: usize, blocks: &Blocks) -> Self {
        let runs = || (0..blocks.rows.len()).map(|row| blocks.span(row, nu));
        let last = nu.saturating_sub(LANES + 1);
        let first = runs().map(|run| run.map_or(0, |(a, _)| a.min(last) as u32)).collect();
        let lengths = runs().map(|run| run.map_or(0, |(a, b)| (b + LANES).min(nu) - a.min(last)));
        let mut end = 0;
        let ends = lengths.map(|length| {
            end += length as u32;
            end
        });
        Self { nu, first, starts: std::iter::once(0).chain(ends).collect() }
    }

    /// Numbers that a plane holds.
    pub(super) fn len(&self) -> usize {
        self.starts[self.first.len()] as usize
    }

    /// The first node of a row's run, and where planes keep it and those behind.
    #[inline(always)]
    pub(super) fn run(&self, row: usize) -> (usize, Range<usize>) {
        (self.first[row] as usize, self.starts[row] as usize..self.starts[row + 1] as usize)
    }

    /// Where planes keep node `i` of a row; `None` if they do not, since it is dark.
    #[inline(always)]
    pub(super) fn place(&self, row: usize, i: usize) -> Option<usize> {
        let (first, run) = self.run(row);
        let place = (run.start + i).wrapping_sub(first);
        (i >= first && place < run.end).then_some(place)
    }

    /// The same of a node by its number.
    #[inline]
    pub(super) fn place_of(&self, node: usize) -> Option<usize> {
        self.place(node / self.nu, node % self.nu)
    }

    /// The same of a lit one.
    #[inline]
    pub(super) fn place_of_lit(&self, node: usize) -> usize {
        self.place_of(node).expect("the run of a row holds its lit nodes")
    }

    /// What a plane with `per` numbers a node holds of every row.
    pub(super) fn split<'p, T>(&self, mut plane: &'p mut [T], per: usize) -> Vec<&'p mut [T]> {
        let length = |row: usize| per * (self.starts[row + 1] - self.starts[row]) as usize;
        (0..self.first.len()).map(|row| plane.split_off_mut(..length(row)).expect("as many as there are")).collect()
    }

    /// Calls `visit` with the number of the first node of every run and what `plane` holds of it, in parallel.
    pub(super) fn for_each_run<T: Send>(&self, plane: &mut [T], visit: impl Fn(usize, &mut [T]) + Sync) {
        let runs = self.split(plane, 1).into_par_iter().enumerate().with_min_len(64);
        runs.filter(|(_, run)| !run.is_empty()).for_each(|(row, run)| visit(row * self.nu + self.run(row).0, run));
    }
}

/// Turns a plane in x, y, z order over to y, z, x, into one of zeros: numbers that are not 0 and have a place in both.
pub(super) fn transpose<T: Copy + Default + PartialEq + Send + Sync>(
    [from_rows, to_rows]: [&LitRows; 2],
    [nx, ny, nz]: [usize; 3],
    from: &[T],
    to: &mut [T],
) {
    /// Columns of x are moved this many at a time: a cache line of four bytes each.
    const STRIP: usize = 16;
    to_rows.split(to, 1).par_chunks_mut(STRIP * nz).enumerate().for_each(|(strip, columns)| {
        let x = strip * STRIP..nx.min((strip + 1) * STRIP);
        for row in 0..ny * nz {
            let (first, run) = from_rows.run(row);
            let (a, b) = (first.max(x.start), (first + run.len()).min(x.end));
            for i in a..b.max(a) {
                let value = from[run.start + i - first];
                let column = (i - x.start) * nz + row / ny;
                let (first, _) = to_rows.run(strip * STRIP * nz + column);
                if value != T::default()
                    && let Some(to) = (row % ny).checked_sub(first).and_then(|y| columns[column].get_mut(y))
                {
                    *to = value;
                }
            }
        }
    });
}

/// Turns it back to x, y, z order, into a plane of zeros.
pub(super) fn untranspose([from_rows, to_rows]: [&LitRows; 2], [ny, nz]: [usize; 2], from: &[f32], to: &mut [f32]) {
    /// Columns of as many rows as a cache line holds are read whole.
    const ROWS: usize = 64;
    to_rows.split(to, 1).par_chunks_mut(ROWS).enumerate().for_each(|(chunk, rows)| {
        let row = chunk * ROWS;
        let of = |n: usize| to_rows.run(row + n).0;
        let lit = || rows.iter().enumerate().filter(|(_, run)| !run.is_empty()).map(|(n, run)| (of(n), run.len()));
        let (a, b) = lit().fold((usize::MAX, 0), |(a, b), (first, n)| (a.min(first), b.max(first + n)));
        for x in a..b {
            for (n, run) in rows.iter_mut().enumerate() {
                let (y, z) = ((row + n) % ny, (row + n) / ny);
                if let Some(to) = x.checked_sub(of(n)).and_then(|i| run.get_mut(i))
                    && let Some(place) = from_rows.place(x * nz + z, y)
                {
                    *to = from[place];
                }
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Rng, Stage};

    /// Rows of all lengths, with few lit nodes, many and none: all of these have a place, each its own, and so have the
    /// vectors of nodes that begin at them or, near the end of a row, end before its last node.
    #[test]
    fn runs_hold_the_vectors_of_lit_nodes() {
        let mut rng = Rng::stream(5, Stage::Test, 0);
        let mut outside = 0;
        for nu in [1, 2, 16, 17, 18, 33, 61, 64, 150, 1200] {
            let lit: Vec<bool> =
                (0..8 * nu).map(|node| node / nu != 3 && rng.unit() < [0.0, 0.01, 0.1, 1.0][node / nu % 4]).collect();
            let size = nu.div_ceil(64).next_multiple_of(16);
            let rows = LitRows::new(nu, &Blocks::along(nu, 8, (size, 0), |node| lit[node]));
            let mut plane: Vec<usize> = (0..rows.len() + 3).collect();
            let split = rows.split(&mut plane, 1);
            let mut next = 0;
            for (row, run) in split.iter().enumerate() {
                assert_eq!((rows.run(row).1.start, rows.run(row).1.len()), (next, run.len()));
                next += run.len();
                for i in 0..nu {
                    let place = rows.place(row, i);
                    assert_eq!(place, rows.place_of(row * nu + i));
                    assert_eq!(place, i.checked_sub(rows.run(row).0).and_then(|i| run.get(i).copied()));
                    outside += usize::from(place.is_none());
                    if lit[row * nu + i] {
                        let begin = i.min((nu - 1).saturating_sub(LANES));
                        let all = begin..(begin + LANES).min(nu);
                        assert!(place.is_some() && all.clone().all(|i| rows.place(row, i).is_some()), "{nu}: {all:?}");
                    }
                }
            }
            assert_eq!(next, rows.len());
        }
        assert!(outside > 2000, "{outside}");
    }
}
