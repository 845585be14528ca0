//! Where scattered radiance samples are placed: the strategies of \[BB09 §3\].

use crate::error::Result;
use crate::field::Field;
use crate::isosurface;
use crate::rng::{Rng, Sobol, Stage};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// A way to place radiance samples.
#[derive(Clone, Debug, PartialEq)]
pub enum Strategy {
    /// Strategy 3: uniform over Ω (low-discrepancy), in the lattice's order.
    Uniform,
    /// Strategy 1: uniform by area over the level sets at these isovalues, in units of the sweep.
    LevelSets(Vec<f64>),
    /// Strategy 2: uniform over this many parallel planes across the diagonal of Ω.
    Planes(usize),
}

/// Points that a uniform search for samples on the sweep may try.
const MOST: usize = 1 << 32;

/// Points that one may try which takes no time to speak of.
const AT_HAND: usize = 1 << 20;

/// `count` positions in the local frame. The level set through each is the one it samples; positions whose isovalue
/// lies outside the sweep are left out, so the result may be shorter for level sets at the sweep's ends, and for planes
/// of a sweep that fills less than about `count` / 4·10⁹ of Ω, or uniform samples of one that fills less of its cells.
/// All strategies give `count` samples otherwise, so that they are compared at equal numbers.
///
/// # Errors
/// From extracting level sets.
pub fn positions(field: &Field, strategy: &Strategy, count: u64, seed: u64) -> Result<Vec<Vec3>> {
    positions_in(field, strategy, count, seed, MOST)
}

/// As [`positions`], but what is not found at once is left out.
///
/// # Errors
/// From extracting level sets.
pub fn positions_at_hand(field: &Field, strategy: &Strategy, count: u64, seed: u64) -> Result<Vec<Vec3>> {
    positions_in(field, strategy, count, seed, AT_HAND)
}

/// `count` positions in the local frame for each of `strata` equal parts of the sweep, uniform over the part of Ω whose
/// isovalues it holds, in the lattice's order; fewer where not as many are at hand.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "within the strata")]
pub fn positions_by_isovalue(field: &Field, strata: u8, count: u64, seed: u64) -> Vec<Vec<Vec3>> {
    let stratum = |h: f64| ((h * f64::from(strata)) as u8).min(strata - 1);
    let cells = field.cells_on_sweep();
    let spans: Vec<[u8; 2]> =
        cells.par_iter().map(|&cell| field.cell_range(cell).map(|h| stratum(f64::from(h)))).collect();
    let of = |n: u8| {
        let passed = cells.par_iter().zip(&spans).filter(|(_, span)| (span[0]..=span[1]).contains(&n));
        let own: Vec<usize> = passed.map(|(cell, _)| *cell).collect();
        let within = |p: &Vec3| {
            let h = field.value(p.as_dvec3());
            (0.0..=1.0).contains(&h) && stratum(h) == n
        };
        positions_in_cells(field, &own, within, (count, AT_HAND), (seed, u64::from(n) + 1))
    };
    (0..strata).map(of).collect()
}

#[allow(clippy::cast_possible_truncation, reason = "positions are f32, indices below 2³²")]
fn positions_in(field: &Field, strategy: &Strategy, count: u64, seed: u64, most: usize) -> Result<Vec<Vec3>> {
    let far = field.lattice().far();
    let on_sweep = |p: &Vec3| (0.0..=1.0).contains(&field.value(p.as_dvec3()));
    let uniform = |i: usize| {
        let set = Sobol::set(seed, Stage::Sample, (i >> 32) as u64);
        let [x, y] = set.point2(i as u32, 0);
        far * DVec3::new(x, y, set.coordinate(i as u32, 2))
    };
    match strategy {
        Strategy::Uniform => Ok(positions_in_cells(field, &field.cells_on_sweep(), on_sweep, (count, most), (seed, 0))),
        Strategy::Planes(planes) => Ok(in_batches(count, most, |i| {
            // Across (1,1,1) in units of Ω, all planes alike: their projection onto z = 0 scales all areas alike.
            let p = uniform(i) / far;
            let plane = ((p.z * *planes as f64).floor() + 0.5) / *planes as f64;
            let q = DVec3::new(p.x, p.y, 3.0 * plane - p.x - p.y);
            let q = (0.0..=1.0).contains(&q.z).then(|| (q * far).as_vec3())?;
            on_sweep(&q).then_some(q)
        })),
        Strategy::LevelSets(isovalues) => level_set_positions(field, isovalues, count, seed),
    }
}

/// The first `count` of `most` positions even over `cells` of which `wanted` is true, in the lattice's order; by the
/// numbers of `set`, of all sets of a seed.
#[allow(clippy::cast_possible_truncation, reason = "positions are f32, indices below 2³²")]
fn positions_in_cells(
    field: &Field,
    cells: &[usize],
    wanted: impl Fn(&Vec3) -> bool + Sync,
    (count, most): (u64, usize),
    (seed, set): (u64, u64),
) -> Vec<Vec3> {
    if cells.is_empty() {
        return Vec::new();
    }
    let in_cell = |i: usize| {
        let set = Sobol::set(seed, Stage::Sample, set << 32 | (i >> 32) as u64);
        let cell = cells[(set.coordinate(i as u32, 3) * cells.len() as f64) as usize];
        let corner = DVec3::from_array(field.cell_corner(cell).map(|i| i as f64));
        let [x, y] = set.point2(i as u32, 0);
        (corner + DVec3::new(x, y, set.coordinate(i as u32, 2))).as_vec3()
    };
    let mut found = in_batches(count, most, |i| Some(in_cell(i)).filter(&wanted));
    // Neighbours one after another: their rays read the same memory.
    found.par_sort_by_key(|p| [p.z as u32, p.y as u32, p.x as u32]);
    found
}

/// The first `count` points that `point` gives for 0, 1, 2 …, tried in batches until there are enough or `most` were
/// tried.
#[allow(clippy::cast_possible_truncation, reason = "counts of what fits memory")]
fn in_batches(count: u64, most: usize, point: impl Fn(usize) -> Option<Vec3> + Sync) -> Vec<Vec3> {
    let batch = (2 * count.min(1 << 20) as usize).clamp(1 << 12, 1 << 20);
    let mut found: Vec<Vec3> = Vec::new();
    for first in (0..most).step_by(batch) {
        found.par_extend((first..(first + batch).min(most)).into_par_iter().filter_map(&point));
        if found.len() as u64 >= count {
            found.truncate(count as usize);
            break;
        }
    }
    found
}

/// Points uniform by world area over the triangles of the level sets, then moved along ∇h onto the trilinear surface.
#[allow(clippy::cast_possible_truncation, reason = "positions and isovalues are f32")]
fn level_set_positions(field: &Field, isovalues: &[f64], count: u64, seed: u64) -> Result<Vec<Vec3>> {
    let lattice = field.lattice();
    let mut corners: Vec<([DVec3; 3], f64)> = Vec::new();
    let mut cumulative: Vec<f64> = Vec::new();
    let mut total = 0.0;
    for &c in isovalues {
        let mesh = isosurface::extract(lattice.dims(), field.samples(), c as f32)?;
        for t in &mesh.triangles {
            let v = t.map(|i| mesh.vertices[i as usize]);
            let w = v.map(|p| lattice.to_world(p));
            total += 0.5 * (w[1] - w[0]).cross(w[2] - w[0]).length();
            corners.push((v, c));
            cumulative.push(total);
        }
    }
    if corners.is_empty() {
        return Ok(Vec::new());
    }
    Ok((0..count as usize)
        .into_par_iter()
        .map(|i| {
            let mut rng = Rng::stream(seed, Stage::Sample, i as u64);
            let x = (i as f64 + rng.unit()) / count as f64 * total;
            let ([a, b, c], isovalue) = corners[cumulative.partition_point(|&s| s <= x).min(corners.len() - 1)];
            let [s, t] = crate::warp::triangle(rng.unit2());
            let mut p = a + s * (b - a) + t * (c - a);
            for _ in 0..4 {
                let (h, g) = field.value_and_gradient(p);
                let step = (h - isovalue) / g.length_squared();
                if step.is_finite() {
                    // Never farther than a cell: beyond, the linear model of h means nothing.
                    let d = lattice.direction_to_index(-g * step);
                    p += d * (1.0 / d.abs().max_element()).min(1.0);
                    p = p.clamp(DVec3::ZERO, lattice.far());
                }
            }
            p.as_vec3()
        })
        // A level set at the sweep's very end keeps the half of its points that rounding puts beyond.
        .filter(|p| (-1e-4..=1.0 + 1e-4).contains(&field.value(p.as_dvec3())))
        .collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Sweep;
    use crate::stats::{normal_quantile, sidak};
    use crate::volume::{Lattice, Samples, Volume};

    /// The first cell is one as any other.
    #[test]
    fn cells_are_counted_from_the_first() {
        let lattice = Lattice::aligned([2; 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let samples = (0..8).map(|o| o as f32).collect();
        let volume = Volume::new("x", lattice, Samples::F32(samples)).unwrap();
        let on = |lo, hi| Field::new(&volume, Sweep::new(lo, hi).unwrap()).unwrap().cells_on_sweep();
        assert_eq!(on(2.0, 3.0), [0]);
    }

    /// Of 10⁶ points one lies on such a sweep: a search for all would take minutes.
    #[test]
    fn what_is_at_hand_takes_no_search() {
        let lattice = Lattice::aligned([9; 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[2] as f32).collect();
        let field = Field::made(lattice, Samples::F32(samples), 3.5, 3.500_001);
        let found = positions_at_hand(&field, &Strategy::Uniform, 4096, 1).unwrap();
        assert!(found.len() < 100, "{}", found.len());
    }

    /// Uniform samples of a sweep whose ends cut cells: as many in every block as its share of the sweep's volume,
    /// which the midpoint rule knows; noise of random points is the most that is allowed.
    #[test]
    fn uniform_samples_fill_the_sweep_evenly() {
        let lattice = Lattice::aligned([9, 8, 7], DVec3::ZERO, DVec3::new(1.0, 2.0, 0.5)).unwrap();
        let h = |[x, y, z]: [usize; 3]| (x * x) as f32 / 64.0 + 0.3 * (y as f32 - 2.0).sin() + 0.05 * z as f32;
        let samples = (0..lattice.len()).map(|o| h(lattice.ijk(o))).collect();
        let field = Field::made(lattice, Samples::F32(samples), 0.31, 0.83);
        let far = field.lattice().far();
        let block = |p: DVec3| (0..3).fold(0, |b, a| b * 4 + ((4.0 * p[a] / far[a]) as usize).min(3));
        const FINE: usize = 96;
        let mut share = [0.0; 64];
        for i in 0..FINE.pow(3) {
            let at = [i % FINE, i / FINE % FINE, i / FINE / FINE].map(|i| (i as f64 + 0.5) / FINE as f64);
            let p = far * DVec3::from_array(at);
            share[block(p)] += f64::from((0.0..=1.0).contains(&field.value(p)));
        }
        let total: f64 = share.iter().sum();
        assert!(total > 0.2 * FINE.pow(3) as f64 && total < 0.6 * FINE.pow(3) as f64);
        const COUNT: usize = 50_000;
        let found = positions(&field, &Strategy::Uniform, COUNT as u64, 7).unwrap();
        assert_eq!(found.len(), COUNT);
        let mut counts = [0.0; 64];
        for p in &found {
            assert!((0.0..=1.0).contains(&field.value(p.as_dvec3())));
            counts[block(p.as_dvec3())] += 1.0;
        }
        let limit = normal_quantile(sidak(1e-3, 64));
        for (n, (count, share)) in counts.into_iter().zip(share).enumerate() {
            let expected = COUNT as f64 * share / total;
            // The midpoint rule errs by less than a thousandth of a block.
            let z = (count - expected) / (expected + (1e-3 * COUNT as f64 / 64.0).powi(2)).sqrt().max(1.0);
            assert!(z.abs() < limit, "block {n}: {count} samples, {expected} expected");
        }
    }
}
