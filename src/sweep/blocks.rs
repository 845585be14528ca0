//! Which blocks of the rows of nodes in memory hold something: what a sweep passes by in one step.

use rayon::prelude::*;

/// For every row of nodes in memory, which blocks of [`Blocks::size`] nodes hold something.
pub(super) struct Blocks {
    /// Nodes in a block.
    pub size: usize,
    /// ⌈2³² / size⌉: products instead of divisions, the same for fewer than 2³² / size nodes.
    reciprocal: usize,
    /// A bit per block of a row.
    pub rows: Vec<u64>,
}

impl Blocks {
    pub(super) fn new(size: usize, rows: Vec<u64>) -> Self {
        Self { size, reciprocal: (1usize << 32).div_ceil(size), rows }
    }

    /// The blocks of nodes that `is` holds, in rows of `nu`; those of neighbours along the row, up to `reach`, count
    /// too.
    pub(super) fn along(
        nu: usize,
        rows: usize,
        (size, reach): (usize, usize),
        is: impl Fn(usize) -> bool + Sync,
    ) -> Self {
        let holds = |row: usize, block: usize| {
            let (a, b) = ((block * size).saturating_sub(reach), ((block + 1) * size + reach).min(nu));
            // No early end: vectors look at many nodes at a time.
            (a..b).fold(false, |any, i| any | is(row * nu + i))
        };
        let bits = |row| (0..nu.div_ceil(size)).fold(0, |bits, block| bits | u64::from(holds(row, block)) << block);
        Self::new(size, (0..rows).into_par_iter().with_min_len(64).map(bits).collect())
    }

    /// The same in y, z, x order of nodes in x, y, z order.
    pub(super) fn across(
        [nx, ny, nz]: [usize; 3],
        (size, reach): (usize, usize),
        is: impl Fn(usize) -> bool + Sync,
    ) -> Self {
        let slice = |z: usize| {
            let mut rows = vec![0u64; nx];
            for y in 0..ny {
                let (a, b) = (y.saturating_sub(reach) / size, (y + reach).min(ny - 1) / size);
                let bits = (u64::MAX << a) & (u64::MAX >> (63 - b));
                let at = (z * ny + y) * nx;
                for (x, row) in rows.iter_mut().enumerate() {
                    *row |= if is(at + x) { bits } else { 0 };
                }
            }
            rows
        };
        let slices: Vec<Vec<u64>> = (0..nz).into_par_iter().with_max_len(4).map(slice).collect();
        Self::new(size, (0..nx).flat_map(|x| slices.iter().map(move |slice| slice[x])).collect())
    }

    /// Joins every row with its neighbours along both other axes, the faster of which has `inner` rows.
    pub(super) fn joined(self, inner: usize) -> Self {
        let outer = self.rows.len() / inner;
        let rows = (0..self.rows.len())
            .map(|row| {
                let (i, o) = (row % inner, row / inner);
                let mut bits = 0;
                for o in o.saturating_sub(1)..(o + 2).min(outer) {
                    for i in i.saturating_sub(1)..(i + 2).min(inner) {
                        bits |= self.rows[o * inner + i];
                    }
                }
                bits
            })
            .collect();
        Self { rows, ..self }
    }

    /// The least range of nodes that holds the blocks of a row and the one `step` rows on; `None` if there are none.
    #[inline]
    pub(super) fn extent(&self, row: usize, step: usize, nu: usize) -> Option<(usize, usize)> {
        let (a, b) = self.nodes(self.rows[row] | self.rows[row + step], nu)?;
        // A line beyond a block's last node still meets its cell.
        Some((a.saturating_sub(1), (b + 1).min(nu)))
    }

    /// The least range of nodes that holds the blocks of a row; `None` if there are none.
    #[inline]
    pub(super) fn span(&self, row: usize, nu: usize) -> Option<(usize, usize)> {
        self.nodes(self.rows[row], nu)
    }

    /// The nodes of every block of a row, from the first to behind the last.
    #[inline(always)]
    pub(super) fn each(&self, row: usize, nu: usize) -> impl Iterator<Item = (usize, usize)> {
        let size = self.size;
        std::iter::successors(Some(self.rows[row]), |bits| Some(bits & bits.wrapping_sub(1)))
            .take_while(|bits| *bits != 0)
            .map(move |bits| bits.trailing_zeros() as usize * size)
            .map(move |a| (a, (a + size).min(nu)))
    }

    fn nodes(&self, bits: u64, nu: usize) -> Option<(usize, usize)> {
        let (a, b) = (bits.trailing_zeros() as usize, 64 - bits.leading_zeros() as usize);
        (bits != 0).then(|| (a * self.size, (b * self.size).min(nu)))
    }

    /// Whether a block of `bits` meets nodes from..to.
    #[inline(always)]
    pub(super) fn meets(&self, bits: u64, from: usize, to: usize) -> bool {
        let (a, b) = ((from * self.reciprocal) >> 32, ((to - 1) * self.reciprocal) >> 32);
        bits & (u64::MAX << a) & (u64::MAX >> (63 - b)) != 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::volume::Lattice;
    use glam::DVec3;

    /// Blocks of every size, of nodes in either order, against all nodes one by one.
    #[test]
    fn blocks_hold_what_is_within_reach() {
        let dims = [37, 9, 11];
        let [nx, ny, nz] = dims;
        let lattice = Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap();
        let is = |o: usize| matches!(lattice.ijk(o), [5, 3, _] | [36, 8, 2] | [_, 0, 7]);
        for (size, reach) in [(1, 0), (1, 1), (2, 1), (16, 0), (16, 1)] {
            let (along, across) =
                (Blocks::along(nx, ny * nz, (size, reach), is), Blocks::across(dims, (size, reach), is));
            let holds = |n: usize, block: usize, at: &dyn Fn(usize) -> usize| {
                (0..n).any(|i| is(at(i)) && (i.saturating_sub(reach) / size..=(i + reach) / size).contains(&block))
            };
            let check = |blocks: &Blocks, n: usize, at: &dyn Fn(usize, usize) -> usize| {
                for (row, bits) in blocks.rows.iter().enumerate() {
                    for block in 0..n.div_ceil(size) {
                        let expected = holds(n, block, &|i| at(row, i));
                        assert_eq!(bits >> block & 1 == 1, expected, "{size} {reach}: block {block} of row {row}");
                    }
                }
            };
            assert_eq!((along.rows.len(), across.rows.len()), (ny * nz, nx * nz));
            check(&along, nx, &|row, x| lattice.offset(x, row % ny, row / ny));
            check(&across, ny, &|row, y| lattice.offset(row / nz, y, row % nz));
        }
    }

    #[test]
    fn blocks_meet_what_shares_a_node_with_them() {
        for size in (1..80).chain([255, 256, 1000, 8191]) {
            let nodes = 64 * size;
            let blocks = Blocks::new(size, Vec::new());
            for block in [0, 1, 30, 62, 63] {
                let (a, b) = (block * size, (block + 1) * size);
                for from in [a.saturating_sub(2), a.saturating_sub(1), a, b - 1, b, b + 1] {
                    for to in [from + 1, from + 2, from + 17, from + size, from + 2 * size] {
                        if to <= nodes {
                            assert_eq!(blocks.meets(1 << block, from, to), from < b && to > a, "{size}: {from}..{to}");
                        }
                    }
                }
            }
        }
    }
}
