//! How far away what reaches the sweep is, so that segments step over what is below it.

use super::grid::Geometry;
use crate::neighbourhood::neighbourhood;

/// The distance of every block of nodes to the nearest that a surface of the sweep may pass, as a number of slices.
pub(super) struct Clearance {
    /// Per block, how many slices on, along any axis and with slopes up to 1, the next one is that may reach the sweep;
    /// x fastest, and behind them as much as makes words of bytes.
    pub slices: Vec<u8>,
}

impl Clearance {
    /// Nodes in a block along each axis, as a power of 2.
    pub(super) const SHIFT: u32 = 2;
    const WIDTH: usize = 1 << Self::SHIFT;

    /// Blocks of a lattice.
    pub(super) fn blocks(dims: [usize; 3]) -> [usize; 3] {
        dims.map(|n| n.div_ceil(Self::WIDTH))
    }

    /// For light of the lower side, from which nothing below the sweep hides anything.
    #[allow(clippy::cast_possible_truncation, reason = "at most 249")]
    pub(super) fn new(geometry: &Geometry) -> Self {
        let dims = Self::blocks(geometry.dims);
        let [_, ny, nz] = geometry.dims;
        let [bx, by, _] = dims;
        let mut distance = vec![u8::MAX; dims.iter().product()];
        // A node more than its neighbours: places of segments are rounded.
        let around = |node: usize, end: usize| node.saturating_sub(1) / Self::WIDTH..=(end - 1) / Self::WIDTH;
        for row in 0..ny * nz {
            for (a, b) in geometry.reaching(row) {
                for k in around(row / ny, row / ny + 1) {
                    for j in around(row % ny, row % ny + 1) {
                        around(a, b).for_each(|i| distance[(k * by + j) * bx + i] = 0);
                    }
                }
            }
        }
        // Twice over all blocks, forwards and backwards, finds how many steps to neighbours lead to the nearest. [RP68]
        let all = 0..distance.len();
        for at in all.clone().chain(all.rev()) {
            let nearest = neighbourhood(dims, at).flat_map(|run| &distance[run]).fold(u8::MAX, |n, d| n.min(*d));
            distance[at] = distance[at].min(nearest.saturating_add(1));
        }
        // From the last node of a block, or the first, to the first node of another.
        let slices = |d: u8| if d == 0 { 1 } else { Self::WIDTH as u8 * (d.min(63) - 1) + 1 };
        let mut slices: Vec<u8> = distance.into_iter().map(slices).collect();
        slices.extend([1; 3]);
        Self { slices }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::field::{Field, Sweep};
    use crate::rng::{Rng, Stage};
    use crate::volume::{Lattice, Samples, Volume};
    use glam::DVec3;

    /// A few nodes of noise, one of which is no number, in what is below the sweep.
    pub(in crate::sweep) fn specks(dims: [usize; 3], seed: u64, share: f64) -> Field {
        let mut rng = Rng::stream(seed, Stage::Test, 0);
        let lattice = Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap();
        let mut samples: Vec<f64> =
            (0..lattice.len()).map(|_| if rng.unit() < share { rng.unit() } else { -rng.unit() - 0.1 }).collect();
        samples[lattice.len() / 3] = f64::NAN;
        let volume = Volume::new("specks", lattice, Samples::F64(samples)).unwrap();
        Field::new(&volume, Sweep::new(0.0, 1.0).unwrap()).unwrap()
    }

    #[test]
    fn blocks_know_how_far_the_nearest_is_that_reaches_the_sweep() {
        for (dims, share) in [([41, 30, 35], 2e-4), ([29, 33, 26], 4e-4), ([5, 3, 50], 0.01), ([2, 2, 2], 1.0)] {
            let field = specks(dims, 3, share);
            let clearance = Clearance::new(&Geometry::new(&field));
            let [bx, by, bz] = dims.map(|n| n.div_ceil(4));
            let blocks = || (0..bx * by * bz).map(|b| [b % bx, b / bx % by, b / (bx * by)].map(|b| b as i64));
            let reaching: Vec<[i64; 3]> = (0..field.lattice().len())
                .filter(|&at| !(field.samples()[at] < 0.0))
                .map(|at| field.lattice().ijk(at).map(|i| i as i64))
                .collect();
            // A block is met by what its cells and those of rounded places beside them have at their corners.
            let met =
                |b: &[i64; 3]| reaching.iter().any(|n| (0..3).all(|a| (4 * b[a] - 1..=4 * b[a] + 5).contains(&n[a])));
            let met: Vec<[i64; 3]> = blocks().filter(met).collect();
            let (mut near, mut far) = (0, 0);
            for (b, &slices) in blocks().zip(&clearance.slices) {
                let away = |m: &[i64; 3]| (0..3).map(|a| (m[a] - b[a]).abs()).max().unwrap();
                let d = met.iter().map(away).min().unwrap();
                assert_eq!(i64::from(slices), if d == 0 { 1 } else { 4 * d - 3 }, "{dims:?} {b:?}");
                (near, far) = (near + usize::from(d == 0), far + usize::from(d > 1));
            }
            assert!(near > 0 && (far > 20 || dims[0] < 10), "{dims:?}: {near} {far}");
        }
    }

    /// As far as a byte tells, and no farther.
    #[test]
    fn clearances_end_where_bytes_do() {
        let lattice = Lattice::aligned([600, 5, 5], DVec3::ZERO, DVec3::ONE).unwrap();
        let samples = (0..lattice.len()).map(|at| if at == 0 { 0.5 } else { -1.0 }).collect();
        let field = Field::made(lattice, Samples::F64(samples), 0.0, 1.0);
        let slices = Clearance::new(&Geometry::new(&field)).slices;
        // Of rows as long as this, ten nodes at a time are known to hold nothing: the first twelve may.
        assert_eq!([0, 2, 3, 4, 5, 64, 65, 66, 149].map(|b| slices[b]), [1, 1, 1, 5, 9, 245, 249, 249, 249]);
    }
}
