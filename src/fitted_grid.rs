//! Fitted grids: node values whose trilinear interpolation comes nearest to the radiance samples, instead of samples
//! blended at the nodes.
//!
//! What a viewer shows is the interpolation of node values on isosurfaces. By the coarea formula a surface point of any
//! isovalue stands for |∇h| dV, so the fit minimises Σ_j |∇h_j| (Σ_n φ_n(x_j) R_n − r_j)² over the samples: steep edges,
//! where isosurfaces crowd, count, and the noise of nearly flat regions beside them does not. A weak pull towards
//! Shepard's values holds nodes that few samples see. Solved by conjugate gradients from Shepard's values, matrix-free.

use crate::field::Field;
use crate::illumination_grid::IlluminationGrid;
use crate::mask::Mask;
use crate::radiance::RadianceSample;
use crate::volume::Lattice;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Strength of the pull towards the start, in units of the mean weight that samples put on a node.
const PULL: f32 = 0.01;
/// Conjugate-gradient steps: the residual falls below the samples' noise well before.
const STEPS: usize = 16;

/// What a sample adds to its nodes: from the sample, its corner weights and its cell.
type Term<'a> = &'a (dyn Fn(&Placed, &[f32; 8], [usize; 3]) -> Vec3 + Sync);

/// Samples sorted by the cell of the grid they lie in.
struct Sorted {
    /// First sample of each cell; one more entry than cells.
    starts: Vec<u32>,
    samples: Vec<Placed>,
    cells: [usize; 3],
}

/// A sample inside its cell.
#[derive(Clone, Copy, Default)]
struct Placed {
    /// Position in the cell, [0, 1]³.
    u: Vec3,
    weight: f32,
    radiance: Vec3,
}

impl Placed {
    /// Trilinear weights of the cell's corners.
    #[inline]
    fn corners(&self) -> [f32; 8] {
        let (u, v) = (self.u, Vec3::ONE - self.u);
        let (a, b, c, d) = (v.x * v.y, u.x * v.y, v.x * u.y, u.x * u.y);
        [a * v.z, b * v.z, c * v.z, d * v.z, a * u.z, b * u.z, c * u.z, d * u.z]
    }
}

/// Improves `start` (Shepard's grid on `lattice`, say) by the least-squares fit described above at the nodes that `free`
/// picks by their mask; the others stay as they are. The result does not depend on the number of threads.
pub fn fit(
    field: &Field,
    lattice: &Lattice,
    samples: &[RadianceSample],
    start: IlluminationGrid,
    free: impl Fn(Mask) -> bool + Sync,
    tick: &(dyn Fn(u64) -> bool + Sync),
) -> IlluminationGrid {
    let sorted = Sorted::new(field, lattice, samples);
    let nodes: Vec<Vec3> = start.radiance.iter().map(|&r| Vec3::from_array(r)).collect();
    let dims = lattice.dims();
    let gather = |term: Term<'_>| -> Vec<Vec3> {
        let mut out = vec![Vec3::ZERO; nodes.len()];
        out.par_chunks_mut(dims[0]).enumerate().for_each(|(row, out)| {
            sorted.accumulate(dims, row % dims[1], row / dims[1], out, term);
        });
        out
    };
    let free: Vec<bool> = start.mask.iter().map(|&m| free(m)).collect();
    // Diagonal of the normal equations: preconditioner, and the scale of the pull.
    let diagonal = gather(&|s, _, _| Vec3::splat(s.weight));
    let seen = diagonal.par_iter().filter(|d| d.x > 0.0).count().max(1);
    let pull = PULL * diagonal.iter().map(|d| f64::from(d.x)).sum::<f64>() as f32 / seen as f32;
    let value = |x: &[Vec3], w: &[f32; 8], [i, j, k]: [usize; 3]| {
        let o = lattice.offset(i, j, k);
        let (y, z) = (dims[0], dims[0] * dims[1]);
        let at = [o, o + 1, o + y, o + y + 1, o + z, o + z + 1, o + z + y, o + z + y + 1];
        at.iter().zip(w).fold(Vec3::ZERO, |sum, (&n, &w)| sum + w * x[n])
    };
    let apply = |x: &[Vec3]| -> Vec<Vec3> {
        let mut y = gather(&|s, w, cell| s.weight * value(x, w, cell));
        y.par_iter_mut().zip(x).for_each(|(y, x)| *y += pull * *x);
        y
    };
    // A x = b with x = start + d: r = Σ w φ (r_j − interpolated start).
    let mut r = gather(&|s, w, cell| s.weight * (s.radiance - value(&nodes, w, cell)));
    let mut d = vec![Vec3::ZERO; nodes.len()];
    let precondition = |r: &[Vec3]| -> Vec<Vec3> {
        let step = |((r, d), &free): ((&Vec3, &Vec3), &bool)| {
            if free { *r / (d.x + pull).max(f32::MIN_POSITIVE) } else { Vec3::ZERO }
        };
        r.par_iter().zip(&diagonal).zip(&free).map(step).collect()
    };
    let mut z = precondition(&r);
    let mut p = z.clone();
    let mut rz = dot(&r, &z);
    for _ in 0..STEPS {
        if !tick(0) || rz.max_element() <= 0.0 {
            break;
        }
        let q = apply(&p);
        let alpha = divide(rz, dot(&p, &q));
        d.par_iter_mut().zip(&p).for_each(|(d, p)| *d += alpha * *p);
        r.par_iter_mut().zip(&q).for_each(|(r, q)| *r -= alpha * *q);
        z = precondition(&r);
        let next = dot(&r, &z);
        let beta = divide(next, rz);
        rz = next;
        p.par_iter_mut().zip(&z).for_each(|(p, z)| *p = *z + beta * *p);
        tick((nodes.len() / STEPS) as u64);
    }
    let mut grid = start;
    grid.radiance.par_iter_mut().zip(&free).zip(nodes.par_iter().zip(&d)).for_each(|((out, free), (x, d))| {
        if *free {
            // Radiance is not negative, but a fit through noise may be.
            *out = (*x + *d).max(Vec3::ZERO).to_array();
        }
    });
    grid
}

/// Sums per channel in f64, in fixed blocks.
fn dot(a: &[Vec3], b: &[Vec3]) -> DVec3 {
    a.par_chunks(1 << 14)
        .zip(b.par_chunks(1 << 14))
        .map(|(a, b)| a.iter().zip(b).fold(DVec3::ZERO, |s, (a, b)| s + (*a * *b).as_dvec3()))
        .collect::<Vec<_>>()
        .into_iter()
        .sum()
}

/// a / b per channel, 0 where b vanishes.
fn divide(a: DVec3, b: DVec3) -> Vec3 {
    let safe = |a: f64, b: f64| if b > 0.0 { a / b } else { 0.0 };
    DVec3::new(safe(a.x, b.x), safe(a.y, b.y), safe(a.z, b.z)).as_vec3()
}

impl Sorted {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "cells are clamped, weights are f32")]
    fn new(field: &Field, lattice: &Lattice, samples: &[RadianceSample]) -> Self {
        let cells = lattice.cells();
        let scale = lattice.far() / field.lattice().far();
        let placed: Vec<(u32, Placed)> = samples
            .par_iter()
            .map(|s| {
                let local = s.position.as_dvec3();
                let p = (local * scale).clamp(DVec3::ZERO, lattice.far());
                let cell = [0, 1, 2].map(|a| (p[a] as usize).min(cells[a] - 1));
                let u = p - DVec3::from_array(cell.map(|c| c as f64));
                let index = (cell[2] * cells[1] + cell[1]) * cells[0] + cell[0];
                let weight = field.gradient(local).length() as f32;
                (index as u32, Placed { u: u.as_vec3(), weight, radiance: s.radiance })
            })
            .collect();
        let mut starts = vec![0u32; cells.iter().product::<usize>() + 1];
        placed.iter().for_each(|(c, _)| starts[*c as usize + 1] += 1);
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        let mut next = starts.clone();
        let mut sorted = vec![Placed::default(); placed.len()];
        for (c, s) in placed {
            sorted[next[c as usize] as usize] = s;
            next[c as usize] += 1;
        }
        Self { starts, samples: sorted, cells }
    }

    /// Adds φ_n · `term` of every sample around each node of row (j, k) to `out`: each node gathers from its up to eight
    /// cells in a fixed order, so nothing is shared between threads.
    fn accumulate(&self, dims: [usize; 3], j: usize, k: usize, out: &mut [Vec3], term: Term<'_>) {
        for dz in 0..2 {
            for dy in 0..2 {
                // The cell whose far (d = 0) or near (d = 1) corner row this is.
                let (Some(cj), Some(ck)) = ((j + dy).checked_sub(1), (k + dz).checked_sub(1)) else { continue };
                if cj >= self.cells[1] || ck >= self.cells[2] {
                    continue;
                }
                let row = (ck * self.cells[1] + cj) * self.cells[0];
                for ci in 0..dims[0] - 1 {
                    let range = self.starts[row + ci] as usize..self.starts[row + ci + 1] as usize;
                    for s in &self.samples[range] {
                        let w = s.corners();
                        let t = term(s, &w, [ci, cj, ck]);
                        let corner = 2 * (1 - dy) + 4 * (1 - dz);
                        out[ci] += w[corner] * t;
                        out[ci + 1] += w[corner + 1] * t;
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Sweep;
    use crate::illumination_grid::shepard;
    use crate::mask::masks;
    use crate::rng::{Sobol, Stage};
    use crate::volume::{Samples, Volume};

    #[test]
    fn a_trilinear_radiance_is_recovered_where_shepard_blurs_it() {
        let lattice = Lattice::aligned([9, 8, 7], DVec3::ZERO, DVec3::ONE).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[0] as f32).collect();
        let volume = Volume::new("x", lattice, Samples::F32(samples)).unwrap();
        let field = Field::new(&volume, Sweep::new(0.0, 8.0).unwrap()).unwrap();
        let f = |p: DVec3| 1.0 + 0.1 * p.x + 0.2 * p.y * p.z;
        let set = Sobol::set(1, Stage::Test, 0);
        let samples: Vec<RadianceSample> = (0..8 * 7 * 6 * 8)
            .map(|i| {
                let [x, y] = set.point2(i, 0);
                let p = (field.lattice().far() * DVec3::new(x, y, set.coordinate(i, 2))).as_vec3();
                let radiance = Vec3::splat(f(p.as_dvec3()) as f32);
                RadianceSample { position: p, radiance, ..RadianceSample::default() }
            })
            .collect();
        let masks = masks(&field, field.lattice());
        let start = shepard(&field, field.lattice(), &masks, &samples, 8, &|_| true);
        // What a viewer sees: the interpolation at points that were not samples.
        let fresh = Sobol::set(2, Stage::Test, 0);
        let error = |g: &IlluminationGrid| {
            let squares: f64 = (0..4096)
                .map(|i| {
                    let [x, y] = fresh.point2(i, 0);
                    let p = field.lattice().far() * DVec3::new(x, y, fresh.coordinate(i, 2));
                    (g.interpolate(field.lattice(), p).y - f(p)).powi(2)
                })
                .sum();
            (squares / 4096.0).sqrt()
        };
        let before = error(&start);
        let after = error(&fit(&field, field.lattice(), &samples, start, |m| m != Mask::Empty, &|_| true));
        println!("RMS error: Shepard {before}, fitted {after}");
        assert!(before > 0.02 && after < 0.2 * before, "Shepard {before}, fitted {after}");
    }
}
