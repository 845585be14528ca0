//! The min/max hierarchy over all cells, valid for every isovalue, and the walk of a flattened ray through it.
//!
//! A node has 4×4×4 children, and their 64 ranges of h stand together in a tile: so one step of the walk finds, as
//! the bits of a word, all children of a node that both hold the isovalue and lie on the ray (`walk`).

mod kernel;
mod packet;
mod simd;
#[cfg(test)]
mod tests;
mod walk;

use crate::field::Field;
use crate::flattened::{FlattenedHit, FlattenedRay};
use crate::isa::Isa;

use glam::Vec4;
use rayon::prelude::*;
use std::ops::Range;

/// Levels at most: children are cells, then blocks of 4³, 16³ and 64³ cells.
const LEVELS: usize = 4;

/// Ranges of h over the 4×4×4 children of a node, x fastest, as [`Ranks`].
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
struct Tile {
    lo: [u8; 64],
    hi: [u8; 64],
}

impl Tile {
    /// Children without surface: they exclude every isovalue.
    const EMPTY: Self = Self { lo: [u8::MAX; 64], hi: [0; 64] };

    /// The range of all children.
    #[inline]
    fn range(&self) -> (u8, u8) {
        (self.lo.iter().fold(u8::MAX, |a, &b| a.min(b)), self.hi.iter().fold(0, |a, &b| a.max(b)))
    }
}

/// All nodes of a level, x fastest.
#[derive(Clone, Debug)]
struct Level {
    dims: [usize; 3],
    tiles: Vec<Tile>,
}

impl Level {
    /// Where the tile of a node stands.
    #[inline]
    fn at(&self, [i, j, k]: [usize; 3]) -> usize {
        (k * self.dims[1] + j) * self.dims[0] + i
    }
}

/// Where a node or a cell begins, or how far from its parent.
#[derive(Clone, Copy, Debug, Default)]
struct Place {
    /// In memory: its first sample, and its first tile of each level but the last.
    at: [usize; LEVELS],
    /// In the lattice: its first corner, from a point that the walk chooses.
    corner: Vec4,
}

impl Place {
    #[inline(always)]
    fn plus(&self, step: &Self) -> Self {
        // Nothing wraps that is there.
        let at = std::array::from_fn(|level| self.at[level].wrapping_add(step.at[level]));
        Self { at, corner: self.corner + step.corner }
    }

    /// The same place, its corner counted from `base`.
    fn from(self, base: Vec4) -> Self {
        Self { corner: self.corner - base, ..self }
    }
}

/// Where the children of a level's nodes stand.
#[derive(Clone, Copy, Debug)]
struct Children {
    /// From the first on.
    steps: [Place; 64],
    /// What one takes in memory, and where what is read of it lies, in bytes.
    bytes: usize,
    lines: [usize; 4],
}

/// Min/max of h over cells and blocks of 4³, 16³ and 64³ cells, in 8 bits over the sweep, so that no block that holds a
/// piece of L(h, c) is ever excluded. 2.05 bytes per cell.
#[derive(Clone, Debug)]
pub struct Pyramid {
    cells: [usize; 3],
    /// Ω's far corner; 1 in the fourth place.
    far: Vec4,
    /// Beyond what rounding does to h at a point of a cell, and to three times that.
    rounding: f64,
    /// Six times what f32 does to a ray's place in a cell, or more.
    slack: f32,
    ranks: Ranks,
    levels: Vec<Level>,
    children: [Children; LEVELS],
    /// Nodes of the top level.
    roots: usize,
    /// What a step along y or z adds to a sample's position in memory.
    steps: [usize; 2],
    capped: bool,
    isa: Isa,
}

/// A monotone map of isovalues to 8 bits: half linear, half by the share of samples below, so that ranges stay narrow
/// where h is flat. It goes on a quarter of the sweep beyond it, a quarter as finely; what is farther outside clamps,
/// NaN is 0.
#[derive(Clone, Debug)]
struct Ranks(Box<[u8; Ranks::BINS]>);

impl Ranks {
    const BINS: usize = 4096;
    /// Those of the sweep.
    const SWEEP: Range<usize> = 683..3413;
    /// Samples that are looked at.
    const SAMPLES: usize = 1 << 16;

    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "in [0, 255]")]
    fn new(samples: &[f32]) -> Self {
        let mut counts = [0u32; Self::BINS];
        // Odd, so that it falls in with no row.
        for &s in samples.iter().step_by((samples.len() / Self::SAMPLES) | 1).filter(|&&s| s > 0.0 && s < 1.0) {
            counts[bins(Vec4::splat(s))[0]] += 1;
        }
        let all = f64::from(counts.iter().sum::<u32>().max(1));
        let (mut below, mut linear) = (0, 0.0);
        let most = 0.75 * Self::SWEEP.len() as f64 + 0.25 * Self::BINS as f64;
        let rank = |(n, count)| {
            below += count;
            linear += if Self::SWEEP.contains(&n) { 1.0 } else { 0.25 };
            (127.5 * (linear / most + f64::from(below) / all)) as u8
        };
        let ranks: Vec<u8> = counts.into_iter().enumerate().map(rank).collect();
        Self(ranks.try_into().expect("as many as bins"))
    }

    #[inline]
    fn of(&self, s: f32) -> u8 {
        self.of4(Vec4::splat(s))[0]
    }

    /// [`Ranks::of`] four.
    #[inline]
    fn of4(&self, s: Vec4) -> [u8; 4] {
        bins(s).map(|bin| self.0[bin])
    }
}

/// Bins of [`Ranks`].
#[inline]
fn bins(s: Vec4) -> [usize; 4] {
    // 2²³ rounds to an integer and leaves it in the low bits.
    let clamped = (s * 2730.0 + 682.5).max(Vec4::ZERO).min(Vec4::splat(4095.0));
    (clamped + 8_388_608.0).to_array().map(|x| x.to_bits() as usize % Ranks::BINS)
}

impl Pyramid {
    /// Builds all levels in one pass over the samples and one over each finer level. Cells that touch a non-finite
    /// sample hold no surface. `capped`: outside Ω counts as below every c, so Ω's faces close what they cut.
    pub fn new(field: &Field, capped: bool) -> Self {
        let cells = field.lattice().cells();
        let ranks = Ranks::new(field.samples());
        let mut levels = vec![finest(field, &ranks)];
        while levels.len() < LEVELS && levels[levels.len() - 1].tiles.len() > 1 {
            levels.push(coarser(&levels[levels.len() - 1]));
        }
        #[allow(clippy::cast_possible_truncation, reason = "lattices fit memory")]
        let far = field.lattice().far().as_vec3().extend(1.0);
        let rounding = 32.0 * f64::EPSILON * f64::from(field.largest());
        let dims = field.lattice().dims();
        let slack = 24.0 * f32::EPSILON * far.max_element();
        let roots = levels[levels.len() - 1].tiles.len();
        let steps = [dims[0], dims[0] * dims[1]];
        let children = std::array::from_fn(|level| children(dims, &levels, level));
        Self { cells, far, rounding, slack, ranks, levels, children, roots, steps, capped, isa: Isa::current() }
    }

    /// Cells along each axis of its lattice.
    pub fn cells(&self) -> [usize; 3] {
        self.cells
    }

    /// The same with another instruction set: the same hits.
    #[cfg(test)]
    fn with(mut self, isa: Isa) -> Self {
        self.isa = isa;
        self
    }

    /// Bytes of all levels.
    pub fn bytes(&self) -> usize {
        Ranks::BINS + self.levels.iter().map(|l| size_of::<Tile>() * l.tiles.len()).sum::<usize>()
    }

    /// The first hit of `ray` with t ≤ `reach`, or `None`. `field` must be the one the pyramid was built from.
    #[inline]
    pub fn intersect(&self, field: &Field, ray: &FlattenedRay, reach: f64) -> Option<FlattenedHit> {
        self.isa.walk::<false>(self, field, ray, reach)
    }

    /// Whether [`Pyramid::intersect`] would find a hit; cheaper, since a sign change inside the reach proves one.
    #[inline]
    pub fn occluded(&self, field: &Field, ray: &FlattenedRay, reach: f64) -> bool {
        self.isa.walk::<true>(self, field, ray, reach).is_some()
    }
}

impl Pyramid {
    /// [`Pyramid::intersect`] for the rays whose bits are set in `active`, each within its own reach, into the same
    /// places of `hits`; the same bits, in less time for each. Places of other rays are left alone.
    #[inline]
    pub fn intersect16(
        &self,
        field: &Field,
        active: u16,
        ray: impl Fn(usize) -> FlattenedRay,
        hits: &mut [Option<FlattenedHit>; 16],
    ) {
        self.isa.walk16::<false>(self, field, active, ray, hits);
    }

    /// [`Pyramid::occluded`] for the rays whose bits are set in `active`, as bits.
    #[inline]
    pub fn occluded16(&self, field: &Field, active: u16, ray: impl Fn(usize) -> FlattenedRay) -> u16 {
        let mut hits = [None; 16];
        self.isa.walk16::<true>(self, field, active, ray, &mut hits);
        hits.iter().enumerate().fold(0, |bits, (n, hit)| bits | u16::from(hit.is_some()) << n)
    }
}

/// Where a node or a cell begins whose first cell is `cell`.
fn place(dims: [usize; 3], levels: &[Level], cell: [usize; 3]) -> Place {
    let at = std::array::from_fn(|level| {
        let (dims, size) = match level.checked_sub(1).map(|below| levels.get(below)) {
            None => (dims, 1),
            Some(Some(below)) => (below.dims, 4usize.pow(level as u32)),
            Some(None) => return 0,
        };
        let [x, y, z] = cell.map(|i| i / size);
        (z * dims[1] + y) * dims[0] + x
    });
    Place { at, corner: Vec4::new(cell[0] as f32, cell[1] as f32, cell[2] as f32, 0.0) }
}

/// Those of the nodes of a level.
fn children(dims: [usize; 3], levels: &[Level], level: usize) -> Children {
    let width = 4usize.pow(level as u32);
    // No node of a level that is not there has a second child.
    let step = |n: usize| {
        if level < levels.len() {
            place(dims, levels, [n % 4, n / 4 % 4, n / 16].map(|i| width * i))
        } else {
            Place::default()
        }
    };
    let [y, z] = [dims[0], dims[0] * dims[1]].map(|step| size_of::<f32>() * step);
    let (bytes, lines) =
        if level == 0 { (size_of::<f32>(), [0, y, z, y + z]) } else { (size_of::<Tile>(), [0, 64, 0, 64]) };
    Children { steps: std::array::from_fn(step), bytes, lines }
}

/// A level of `dims` nodes.
fn level(dims: [usize; 3], tile: impl Fn([usize; 3]) -> Tile + Sync) -> Level {
    // Collected in place: no byte is written twice.
    let tiles = (0..dims.iter().product::<usize>())
        .into_par_iter()
        .with_min_len(64)
        .map(|n| tile([n % dims[0], n / dims[0] % dims[1], n / (dims[0] * dims[1])]))
        .collect();
    Level { dims, tiles }
}

/// The nodes of 4³ cells.
fn finest(field: &Field, ranks: &Ranks) -> Level {
    let cells = field.lattice().cells();
    level(cells.map(|n| n.div_ceil(4)), |node| {
        let first = node.map(|i| 4 * i);
        let whole = (0..3).all(|a| first[a] + 4 <= cells[a]);
        whole.then(|| whole_tile(field, ranks, first)).flatten().unwrap_or_else(|| any_tile(field, ranks, first))
    })
}

/// The node whose first cell is `first`, all of whose cells exist. `None` if one of its samples is not a number.
#[inline]
fn whole_tile(field: &Field, ranks: &Ranks, [i, j, k]: [usize; 3]) -> Option<Tile> {
    let [nx, ny, _] = field.lattice().dims();
    let samples = field.samples();
    let mut tile = Tile::EMPTY;
    // Four cells at a time along x; first the smallest and largest sample along x, then y, then z.
    let mut before = [[Vec4::ZERO; 2]; 4];
    let mut sum = Vec4::ZERO;
    for z in 0..5 {
        let mut previous = [Vec4::ZERO; 2];
        for y in 0..5 {
            let row = &samples[((k + z) * ny + j + y) * nx + i..][..5];
            let (a, b) = (Vec4::from_slice(&row[..4]), Vec4::from_slice(&row[1..]));
            sum += a + b;
            let along_x = [a.min(b), a.max(b)];
            if y > 0 {
                let along_y = [along_x[0].min(previous[0]), along_x[1].max(previous[1])];
                if z > 0 {
                    let at = 4 * (y - 1) + 16 * (z - 1);
                    tile.lo[at..at + 4].copy_from_slice(&ranks.of4(along_y[0].min(before[y - 1][0])));
                    tile.hi[at..at + 4].copy_from_slice(&ranks.of4(along_y[1].max(before[y - 1][1])));
                }
                before[y - 1] = along_y;
            }
            previous = along_x;
        }
    }
    // A sum is NaN if a sample is: min and max would hide it.
    (!sum.is_nan()).then_some(tile)
}

/// The same for a node that sticks out of the lattice or touches a NaN.
#[cold]
fn any_tile(field: &Field, ranks: &Ranks, first: [usize; 3]) -> Tile {
    let cells = field.lattice().cells();
    let mut tile = Tile::EMPTY;
    for n in 0..64 {
        let cell = [first[0] + n % 4, first[1] + n / 4 % 4, first[2] + n / 16];
        if (0..3).any(|a| cell[a] >= cells[a]) {
            continue;
        }
        let corners = field.corners(cell);
        if !corners.iter().any(|s| s.is_nan()) {
            tile.lo[n] = ranks.of(corners.iter().fold(f32::INFINITY, |a, &b| a.min(b)));
            tile.hi[n] = ranks.of(corners.iter().fold(f32::NEG_INFINITY, |a, &b| a.max(b)));
        }
    }
    tile
}

/// The level whose children are the nodes of `fine`.
fn coarser(fine: &Level) -> Level {
    level(fine.dims.map(|n| n.div_ceil(4)), |node| {
        let mut tile = Tile::EMPTY;
        for n in 0..64 {
            let child = [4 * node[0] + n % 4, 4 * node[1] + n / 4 % 4, 4 * node[2] + n / 16];
            if (0..3).all(|a| child[a] < fine.dims[a]) {
                (tile.lo[n], tile.hi[n]) = fine.tiles[fine.at(child)].range();
            }
        }
        tile
    })
}
