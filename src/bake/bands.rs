//! Bands of isovalues, baked one after another so that the radiance cache never covers the whole sweep at once.
//!
//! Hyperplanes do not light each other. A ray of isovalue c lands in a cell that straddles c, so samples of a band need
//! the cache at the nodes of the cells that straddle it, and at those beside them, against which they are sharpened.
//! What is within two steps of a node spans one interval of isovalues: bands in rising order need it one after another,
//! and each takes over what the one before has. So the work, and the light, are those of one band.

use crate::field::Field;
use crate::mask::Mask;
use rayon::prelude::*;
use std::ops::RangeInclusive;

/// One band: [from, to[, the last one [from, 1].
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Band {
    pub(super) number: usize,
    from: f32,
    to: f32,
}

impl Band {
    /// The sweep.
    pub(super) const WHOLE: Self = Self { number: 0, from: 0.0, to: 1.0 };

    /// Whether isovalue `c` of the sweep belongs to it.
    #[inline]
    pub(super) fn holds(self, c: f32) -> bool {
        c >= self.from && (c < self.to || self.to == 1.0)
    }

    /// Its isovalues.
    pub(super) fn range(self) -> RangeInclusive<f32> {
        self.from..=self.to
    }
}

/// Steps of the sweep in which nodes are counted.
const STEPS: usize = 4096;

/// Steps from a node within which a band that needs it has an isovalue.
pub(super) const REACH: usize = 2;

/// How many nodes there are at which isovalues.
pub(super) struct Levels {
    /// Nodes of the sweep by their own isovalue.
    own: Vec<u64>,
    /// Nodes with surfaces of the sweep around, by the least and by the greatest isovalue within [`REACH`].
    least: Vec<u64>,
    most: Vec<u64>,
}

impl Levels {
    /// Counts the nodes of fields with their masks, all on the fields' own lattices. `steps`: [`REACH`], or 0 if no
    /// band needs any.
    pub(super) fn new<'a>(fields: impl Iterator<Item = (&'a Field, &'a [Mask])>, steps: usize) -> Self {
        let mut levels = Self { own: vec![0; STEPS], least: vec![0; STEPS], most: vec![0; STEPS] };
        for (field, masks) in fields {
            let count = |chunk: usize| {
                let mut counts = vec![0u64; 3 * STEPS];
                for o in chunk * CHUNK..masks.len().min((chunk + 1) * CHUNK) {
                    if masks[o] == Mask::Empty {
                        continue;
                    }
                    let [least, most] = field.range_around(o, steps);
                    counts[STEPS + step(least)] += 1;
                    counts[2 * STEPS + step(most)] += 1;
                    if masks[o] == Mask::Valid {
                        counts[step(field.samples()[o])] += 1;
                    }
                }
                counts
            };
            const CHUNK: usize = 1 << 18;
            let add = |mut a: Vec<u64>, b: Vec<u64>| {
                a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
                a
            };
            let sums = (0..masks.len().div_ceil(CHUNK)).into_par_iter().map(count).reduce(|| vec![0; 3 * STEPS], add);
            for (all, new) in [&mut levels.own, &mut levels.least, &mut levels.most].into_iter().zip(sums.chunks(STEPS))
            {
                all.iter_mut().zip(new).for_each(|(a, b)| *a += b);
            }
        }
        levels
    }

    /// At most `count` bands of about as many nodes each; none is without nodes.
    pub(super) fn bands(&self, count: usize) -> Vec<Band> {
        let total: u64 = self.own.iter().sum();
        let mut edges = vec![0.0];
        let (mut below, mut shares) = (0, 0);
        for (n, own) in self.own.iter().enumerate().take(STEPS - 1) {
            below += own;
            // Whole shares that end here; one step may hold several.
            let ended = below * count as u64 / total.max(1);
            if ended > shares && below < total {
                shares = ended;
                // Exact in f32: the steps are a power of two.
                edges.push((n + 1) as f32 / STEPS as f32);
            }
        }
        edges.push(1.0);
        (0..).zip(edges.windows(2)).map(|(number, e)| Band { number, from: e[0], to: e[1] }).collect()
    }

    /// Nodes that a band needs at most.
    pub(super) fn needed(&self, band: Band) -> u64 {
        // One step more than it says at either end: for the margin of a hit's rounding.
        let (from, to) = (step(band.from).saturating_sub(1), (step(band.to) + 1).min(STEPS - 1));
        let total: u64 = self.least.iter().sum();
        let below: u64 = self.most[..from].iter().sum();
        let above: u64 = self.least[(to + 1).min(STEPS)..].iter().sum();
        total - below - above
    }
}

/// The step of an isovalue, or the nearest.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "floats saturate")]
fn step(c: f32) -> usize {
    ((c * STEPS as f32) as usize).min(STEPS - 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    use crate::mask::masks;
    use crate::volume::{Lattice, Samples};
    use glam::DVec3;

    #[test]
    fn bands_share_the_nodes_and_cover_the_sweep() {
        let lattice = Lattice::aligned([40, 30, 20], DVec3::ZERO, DVec3::ONE).unwrap();
        // Most of the nodes are low.
        let h = |o: usize| (o as f32 / lattice.len() as f32).powi(3) * 1.2 - 0.1;
        let samples: Vec<f32> = (0..lattice.len()).map(h).collect();
        let field = Field::made(lattice.clone(), Samples::F32(samples), 0.0, 1.0);
        let masks = masks(&field, &lattice);
        let levels = Levels::new([(&field, &masks[..])].into_iter(), REACH);
        let valid = masks.iter().filter(|&&m| m == Mask::Valid).count();
        for count in [1, 2, 3, 7, 100] {
            let bands = levels.bands(count);
            assert!(bands.len() == count, "{} of {count}", bands.len());
            assert_eq!((bands[0].from, bands[count - 1].to), (0.0, 1.0));
            let of = |b: &Band| {
                let held = |o: &usize| masks[*o] == Mask::Valid && b.holds(field.samples()[*o]);
                (0..lattice.len()).filter(held).count()
            };
            let shares: Vec<usize> = bands.iter().map(of).collect();
            assert_eq!(shares.iter().sum::<usize>(), valid, "each node is in one band");
            assert!(shares.iter().all(|&s| s > 0 && s <= valid / count + valid / 20), "{shares:?}");
            for b in &bands {
                let needed = |o: &usize| {
                    let [least, most] = field.range_around(*o, REACH);
                    masks[*o] != Mask::Empty && least <= b.to && most >= b.from
                };
                let needed = (0..lattice.len()).filter(needed).count() as u64;
                assert!((needed..=needed + needed / 5 + 50).contains(&levels.needed(*b)));
            }
        }
        assert_eq!(levels.bands(1)[0].range(), 0.0..=1.0);
    }

    #[test]
    fn where_all_nodes_are_alike_there_is_one_band() {
        let levels = Levels { own: vec![0; STEPS], least: vec![0; STEPS], most: vec![0; STEPS] };
        let own = (0..STEPS).map(|n| if n == 7 { 1000 } else { 0 }).collect();
        assert_eq!(Levels { own, ..levels }.bands(8).len(), 1);
    }

    /// A peak holds several shares, which cannot be told apart; what comes after it is no band for each of them.
    #[test]
    fn beside_a_peak_no_band_is_empty() {
        for (peaks, bands) in [(&[(7, 1000), (4000, 1)][..], 2), (&[(7, 700), (2000, 200), (4000, 100)], 3)] {
            let own = (0..STEPS).map(|n| peaks.iter().find(|p| p.0 == n).map_or(0, |p| p.1)).collect();
            let levels = Levels { own, least: vec![0; STEPS], most: vec![0; STEPS] };
            let found = levels.bands(4);
            let held = |b: &Band| peaks.iter().filter(|p| b.holds(p.0 as f32 / STEPS as f32)).map(|p| p.1).sum();
            let held: Vec<u64> = found.iter().map(held).collect();
            assert!(held.len() == bands && held.iter().all(|&n| n > 0), "{held:?}");
        }
    }
}
