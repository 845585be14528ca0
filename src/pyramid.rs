//! The min/max hierarchy over all cells, valid for every isovalue, and the walk of a flattened ray through it.
//!
//! A node has 4×4×4 children, and their 64 ranges of h stand together in a [`Tile`]: so one step of the walk finds, as
//! the bits of a word, all children of a node that both hold the isovalue and lie on the ray (`walk`).

mod avx512;
mod children;
mod walk;

use crate::field::Field;
use crate::flattened::{FlattenedHit, FlattenedRay};
use avx512::Avx512;
use children::Scalar;
use rayon::prelude::*;

/// Levels at most: children are cells, then blocks of 4³, 16³ and 64³ cells.
const LEVELS: usize = 4;

/// Ranges of h over the 4×4×4 children of a node, x fastest, quantised by [`quantise`].
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
struct Tile {
    lo: [u16; 64],
    hi: [u16; 64],
}

impl Tile {
    /// Children without surface: they exclude every isovalue.
    const EMPTY: Self = Self { lo: [u16::MAX; 64], hi: [0; 64] };

    /// The range of all children.
    #[inline]
    fn range(&self) -> (u16, u16) {
        (self.lo.iter().fold(u16::MAX, |a, &b| a.min(b)), self.hi.iter().fold(0, |a, &b| a.max(b)))
    }
}

/// All nodes of a level, x fastest.
#[derive(Clone, Debug)]
struct Level {
    dims: [usize; 3],
    tiles: Vec<Tile>,
}

impl Level {
    #[inline]
    fn tile(&self, [i, j, k]: [usize; 3]) -> &Tile {
        &self.tiles[(k * self.dims[1] + j) * self.dims[0] + i]
    }
}

/// Min/max of h over cells and blocks of 4³, 16³ and 64³ cells, quantised to 16 bits over the sweep, so that no block
/// that holds a piece of L(h, c) is ever excluded. 4.1 bytes per cell.
#[derive(Clone, Debug)]
pub struct Pyramid {
    cells: [usize; 3],
    levels: Vec<Level>,
    capped: bool,
    wide: Option<Avx512>,
}

/// A monotone map of isovalues to 16 bits; everything outside the sweep clamps, NaN is 0.
#[inline]
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "the cast saturates")]
fn quantise(s: f32) -> u16 {
    (s * 65535.0) as u16
}

impl Pyramid {
    /// Builds all levels in one pass over the samples and one over each finer level. Cells that touch a non-finite
    /// sample hold no surface. `capped`: outside Ω counts as below every c, so Ω's faces close what they cut.
    pub fn new(field: &Field, capped: bool) -> Self {
        let cells = field.lattice().cells();
        let mut levels = vec![finest(field)];
        while levels.len() < LEVELS && levels[levels.len() - 1].tiles.len() > 1 {
            levels.push(coarser(&levels[levels.len() - 1]));
        }
        Self { cells, levels, capped, wide: Avx512::detect() }
    }

    /// The same without SIMD, as on a machine that has none: the same hits, slower.
    #[must_use]
    pub fn scalar(mut self) -> Self {
        self.wide = None;
        self
    }

    /// Bytes of all levels.
    pub fn bytes(&self) -> usize {
        self.levels.iter().map(|l| size_of::<Tile>() * l.tiles.len()).sum()
    }

    /// The first hit of `ray` with t ≤ `reach`, or `None`. `field` must be the one the pyramid was built from.
    #[inline]
    pub fn intersect(&self, field: &Field, ray: &FlattenedRay, reach: f64) -> Option<FlattenedHit> {
        match self.wide {
            Some(wide) => wide.walk::<false>(self, field, ray, reach),
            None => self.walk::<false, _>(Scalar, field, ray, reach),
        }
    }

    /// Whether [`Pyramid::intersect`] would find a hit; cheaper, since a sign change inside the reach proves one.
    #[inline]
    pub fn occluded(&self, field: &Field, ray: &FlattenedRay, reach: f64) -> bool {
        match self.wide {
            Some(wide) => wide.walk::<true>(self, field, ray, reach).is_some(),
            None => self.walk::<true, _>(Scalar, field, ray, reach).is_some(),
        }
    }
}

/// The nodes of 4³ cells.
fn finest(field: &Field) -> Level {
    let [nx, ny, _] = field.lattice().dims();
    let cells = field.lattice().cells();
    let samples = field.samples();
    let dims = cells.map(|n| n.div_ceil(4));
    let mut tiles = vec![Tile::EMPTY; dims.iter().product()];
    tiles.par_chunks_mut(dims[0]).enumerate().for_each_init(
        || (vec![(0f32, 0f32, 0f32); nx], vec![(u16::MAX, 0u16); 4 * dims[0]]),
        |(columns, ranges), (row, tiles)| {
            let (bj, bk) = (row % dims[1], row / dims[1]);
            for (j, k) in (0..16).map(|n| (4 * bj + n % 4, 4 * bk + n / 4)) {
                if j >= cells[1] || k >= cells[2] {
                    continue;
                }
                // Columns of four samples (2×2 over y and z) are shared by the two cells beside them.
                let line = |dy: usize, dz: usize| &samples[((k + dz) * ny + j + dy) * nx..][..nx];
                let (p, q, r, s) = (line(0, 0), line(1, 0), line(0, 1), line(1, 1));
                for (i, column) in columns.iter_mut().enumerate() {
                    let (a, b, c, d) = (p[i], q[i], r[i], s[i]);
                    *column = (a.min(b).min(c.min(d)), a.max(b).max(c.max(d)), (a + b) + (c + d));
                }
                for (pair, range) in columns.windows(2).zip(ranges.iter_mut()) {
                    let (left, right) = (pair[0], pair[1]);
                    // A sum is NaN if a sample is: min and max would hide it.
                    *range = if (left.2 + right.2).is_nan() {
                        (u16::MAX, 0)
                    } else {
                        (quantise(left.0.min(right.0)), quantise(left.1.max(right.1)))
                    };
                }
                let at = 4 * (j % 4) + 16 * (k % 4);
                for (tile, four) in tiles.iter_mut().zip(ranges.chunks_exact(4)) {
                    for (x, &(lo, hi)) in four.iter().enumerate() {
                        (tile.lo[at + x], tile.hi[at + x]) = (lo, hi);
                    }
                }
            }
        },
    );
    Level { dims, tiles }
}

/// The level whose children are the nodes of `fine`.
fn coarser(fine: &Level) -> Level {
    let dims = fine.dims.map(|n| n.div_ceil(4));
    let mut tiles = vec![Tile::EMPTY; dims.iter().product()];
    tiles.par_chunks_mut(dims[0]).enumerate().for_each(|(row, tiles)| {
        let (bj, bk) = (row % dims[1], row / dims[1]);
        for (j, k) in (0..16).map(|n| (4 * bj + n % 4, 4 * bk + n / 4)) {
            if j >= fine.dims[1] || k >= fine.dims[2] {
                continue;
            }
            let line = &fine.tiles[(k * fine.dims[1] + j) * fine.dims[0]..][..fine.dims[0]];
            let at = 4 * (j % 4) + 16 * (k % 4);
            for (i, child) in line.iter().enumerate() {
                (tiles[i / 4].lo[at + i % 4], tiles[i / 4].hi[at + i % 4]) = child.range();
            }
        }
    });
    Level { dims, tiles }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Sweep;
    use crate::flattened::{Departure, Side};
    use crate::rng::{Rng, Stage};
    use crate::volume::{Lattice, Samples, Volume};
    use crate::warp;
    use glam::{DVec3, Vec3};

    /// Smooth enough for long ways, with plateaus and a NaN.
    fn field(dims: [usize; 3], levels: f64) -> Field {
        let lattice = Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap();
        let mut samples: Vec<f32> = (0..lattice.len())
            .map(|o| {
                let x = DVec3::from_array(lattice.ijk(o).map(|i| i as f64));
                let wave = (0.31 * x.x).sin() + (0.23 * x.y + 0.1 * x.z).cos() + (0.17 * x.z).sin();
                ((wave / 6.0 + 0.5) * levels).round() as f32
            })
            .collect();
        samples[lattice.offset(dims[0] / 2, 1, 1)] = f32::NAN;
        let volume = Volume::new("waves", lattice, Samples::F32(samples)).unwrap();
        Field::new(&volume, Sweep::new(0.0, levels).unwrap()).unwrap()
    }

    /// From inside, outside and the surface, on planes and along them.
    fn ray(field: &Field, rng: &mut Rng, levels: f64) -> FlattenedRay {
        let far = field.lattice().far();
        let mut p = (DVec3::new(rng.unit(), rng.unit(), rng.unit()) * 1.4 - 0.2) * far;
        let mut d = warp::sphere(rng.unit2()) * 10f64.powf(4.0 * rng.unit() - 2.0);
        for a in 0..3 {
            match rng.bits() % 12 {
                0 => p[a] = p[a].round(),
                1 => d[a] = 0.0,
                2 => (p[a], d[a]) = (p[a].round(), 0.01),
                3 => d[a] = 1.0f64.copysign(d[a]),
                _ => {}
            }
        }
        let within = (0..3).all(|a| p[a] >= 0.0 && p[a] <= far[a]);
        let on = within && rng.bits() % 2 == 0;
        let c = if rng.bits() % 2 == 0 { (rng.unit() * levels).round() / levels } else { rng.unit() };
        let mut ray = FlattenedRay::free(p.as_vec3(), d.as_vec3(), c as f32);
        if on {
            ray.departure = Departure::Surface(if rng.bits() % 2 == 0 { Side::Lower } else { Side::Higher });
        }
        if ray.direction == Vec3::ZERO {
            ray.direction = Vec3::Z;
        }
        if rng.bits() % 4 == 0 {
            ray.reach = (30.0 * rng.unit()) as f32 / ray.direction.length();
        }
        ray
    }

    #[test]
    fn with_and_without_simd_hits_are_the_same_bits() {
        // Below and above one node of the top level, thin, and off the grid of blocks.
        for (dims, levels) in [([70, 66, 67], 1e4), ([5, 4, 9], 7.0), ([300, 30, 21], 40.0), ([2, 101, 33], 1e3)] {
            let field = field(dims, levels);
            let mut rng = Rng::stream(3, Stage::Test, dims[0] as u64);
            for capped in [false, true] {
                let wide = Pyramid::new(&field, capped);
                let scalar = wide.clone().scalar();
                let mut hits = 0;
                for _ in 0..100_000 {
                    let ray = ray(&field, &mut rng, levels);
                    let hit = wide.intersect(&field, &ray, f64::from(ray.reach));
                    assert_eq!(hit, scalar.intersect(&field, &ray, f64::from(ray.reach)), "{ray:?}");
                    assert_eq!(hit.is_some(), wide.occluded(&field, &ray, f64::from(ray.reach)), "{ray:?}");
                    hits += u32::from(hit.is_some());
                }
                assert!((5_000..95_000).contains(&hits), "{hits} hits of {dims:?} test nothing");
            }
        }
    }

    /// Crosses every plane, looks at every cell.
    fn plain_walk(field: &Field, ray: &FlattenedRay) -> Option<f64> {
        let (o, d) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
        let far = field.lattice().far();
        let mut times: Vec<f64> = (0..3)
            .flat_map(|a| (0..=far[a] as usize).map(move |k| (k as f64 - o[a]) / d[a]))
            .filter(|t| t.is_finite() && *t > 0.0)
            .collect();
        times.push(0.0);
        times.sort_by(f64::total_cmp);
        for pair in times.windows(2).filter(|pair| pair[1] > pair[0]) {
            let middle = o + d * (0.5 * (pair[0] + pair[1]));
            if !(middle.cmpge(DVec3::ZERO).all() && middle.cmple(far).all()) {
                continue;
            }
            let (cell, _) = field.locate(middle);
            let corners = crate::cell::Cell { s: field.corners(cell) };
            if corners.s.iter().any(|s| s.is_nan()) {
                continue;
            }
            let base = DVec3::from_array(cell.map(|i| i as f64));
            let cubic = corners.cubic(f64::from(ray.isovalue), o + d * pair[0] - base, d);
            let span = pair[1] - pair[0];
            if let Some(t) = cubic.first_crossing(span, cubic.value(0.0) >= 0.0, cubic.value(span) >= 0.0) {
                return Some(pair[0] + t);
            }
        }
        None
    }

    #[test]
    fn first_hits_are_those_of_a_plain_walk_in_f64() {
        let field = field([70, 66, 67], 1e4);
        let pyramid = Pyramid::new(&field, false);
        let mut rng = Rng::stream(4, Stage::Test, 0);
        let (mut wrong, mut hits) = (0, 0);
        for _ in 0..50_000 {
            let mut ray = ray(&field, &mut rng, 1e4);
            (ray.departure, ray.reach) = (Departure::Free, f32::INFINITY);
            ray.isovalue = rng.unit() as f32;
            let expected = plain_walk(&field, &ray);
            let hit = pyramid.intersect(&field, &ray, f64::INFINITY).map(|h| f64::from(h.t));
            hits += u32::from(hit.is_some());
            wrong += u32::from(match (hit, expected) {
                (Some(t), Some(expected)) => (t - expected).abs() > 1e-6 * expected.max(1.0),
                (hit, expected) => hit.is_some() != expected.is_some(),
            });
        }
        assert_eq!(wrong, 0, "of {hits}");
        assert!(hits > 10_000);
    }
}
