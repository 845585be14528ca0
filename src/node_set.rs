//! A set of lattice points that numbers its members: arrays over a part of a lattice need room for that part only.

use rayon::prelude::*;
use std::ops::Range;

/// Some of a lattice's points, in a quarter of a byte per point of the lattice; nothing if it holds them all.
#[derive(Clone, Debug)]
pub struct NodeSet {
    points: usize,
    len: usize,
    /// Empty: all points are members.
    words: Vec<Word>,
}

/// 64 points: who of them is a member, and how many members come before.
#[derive(Clone, Copy, Debug)]
struct Word {
    members: u64,
    before: u64,
}

impl NodeSet {
    /// All of `points` points.
    pub fn all(points: usize) -> Self {
        Self { points, len: points, words: Vec::new() }
    }

    /// Those of `points` points that `holds` accepts.
    pub fn new(points: usize, holds: impl Fn(usize) -> bool + Sync) -> Self {
        let mut words: Vec<Word> = (0..points.div_ceil(64))
            .into_par_iter()
            .with_min_len(64)
            .map(|w| {
                let held = (64 * w..points.min(64 * w + 64)).filter(|&o| holds(o));
                Word { members: held.fold(0, |bits, o| bits | 1 << (o % 64)), before: 0 }
            })
            .collect();
        let mut len = 0;
        for word in &mut words {
            word.before = len;
            len += u64::from(word.members.count_ones());
        }
        let len = usize::try_from(len).expect("no more members than points");
        if len == points { Self::all(points) } else { Self { points, len, words } }
    }

    /// Members.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Whether point `o` is a member.
    #[inline]
    pub fn contains(&self, o: usize) -> bool {
        self.words.is_empty() || self.words[o / 64].members >> (o % 64) & 1 == 1
    }

    /// Members below point `o`, which may be one past the last point.
    #[inline]
    #[allow(clippy::cast_possible_truncation, reason = "no more members than points")]
    pub fn before(&self, o: usize) -> usize {
        if self.words.is_empty() {
            return o;
        }
        match self.words.get(o / 64) {
            Some(w) => w.before as usize + (w.members & !(u64::MAX << (o % 64))).count_ones() as usize,
            None => self.len,
        }
    }

    /// The number of member `o`: its place in an array over the members.
    #[inline]
    pub fn slot(&self, o: usize) -> Option<usize> {
        self.contains(o).then(|| self.before(o))
    }

    /// The numbers of members among points `o` and `o` + 1.
    #[inline]
    pub fn pair(&self, o: usize) -> [Option<usize>; 2] {
        let (slot, [a, b]) = (self.before(o), [self.contains(o), self.contains(o + 1)]);
        [a.then_some(slot), b.then_some(slot + usize::from(a))]
    }

    /// The members in a range of points, rising.
    pub fn members(&self, range: Range<usize>) -> impl Iterator<Item = usize> {
        range.filter(|&o| self.contains(o))
    }

    /// An array over the members cut into the parts that belong to so many points each.
    pub fn split<'a, T>(&self, array: &'a mut [T], each: usize) -> Vec<&'a mut [T]> {
        assert_eq!(array.len(), self.len, "one entry per member");
        let mut rest = array;
        (0..self.points.div_ceil(each))
            .map(|n| {
                let count = self.before(((n + 1) * each).min(self.points)) - self.before(n * each);
                let (part, behind) = std::mem::take(&mut rest).split_at_mut(count);
                rest = behind;
                part
            })
            .collect()
    }

    /// Bytes of a set over `points` points.
    pub const fn bytes(points: u64) -> u64 {
        points / 4
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::{Rng, Stage};

    #[test]
    fn members_are_numbered_in_order() {
        for (points, share) in [(1, 0.5), (63, 0.5), (64, 1.0), (64, 0.0), (65, 0.3), (1000, 0.1), (4096, 0.9)] {
            let mut rng = Rng::stream(1, Stage::Test, points as u64);
            let held: Vec<bool> = (0..points).map(|_| rng.unit() < share).collect();
            let set = NodeSet::new(points, |o| held[o]);
            let members: Vec<usize> = (0..points).filter(|&o| held[o]).collect();
            assert_eq!((set.len(), set.is_empty()), (members.len(), members.is_empty()));
            assert_eq!(set.members(0..points).collect::<Vec<_>>(), members);
            for o in 0..points {
                assert_eq!(set.slot(o), members.iter().position(|&m| m == o));
                assert_eq!(set.before(o), members.iter().filter(|&&m| m < o).count());
                if o + 1 < points {
                    assert_eq!(set.pair(o), [set.slot(o), set.slot(o + 1)]);
                }
            }
            assert_eq!(set.before(points), members.len());
            let mut array = members.clone();
            for each in [1, 7, 64, 100] {
                let parts = set.split(&mut array, each);
                assert_eq!(parts.len(), points.div_ceil(each));
                assert!(parts.iter().enumerate().all(|(n, p)| p.iter().all(|m| m / each == n)));
                assert_eq!(parts.concat(), members);
            }
        }
    }
}
