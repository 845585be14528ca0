//! Fitted grids: node values whose trilinear interpolation comes nearest to the radiance samples, instead of samples
//! blended at the nodes.
//!
//! What a viewer shows is the interpolation of node values on isosurfaces. By the coarea formula a surface point of any
//! isovalue stands for |∇h| dV, so the fit minimises Σ_j |∇h_j| (Σ_n φ_n(x_j) R_n − r_j)² over the samples: steep
//! edges, where isosurfaces crowd, count, and the noise of nearly flat regions beside them does not. A pull towards
//! Shepard's values holds nodes that few samples see, and noise. Solved by conjugate gradients from Shepard's values,
//! matrix-free.

use crate::field::Field;
use crate::illumination_grid::IlluminationGrid;
use crate::node_set::NodeSet;
use crate::progress::Tick;
use crate::radiance::RadianceSample;
use crate::rng::Stage;
use crate::volume::Lattice;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Strength of the pull towards the start, in units of the mean weight that samples put on a node, for samples as bakes
/// have them: noise of theirs that it holds back outweighs what it blurs. 0.01 lets noise through, 1 blurs.
const PULL: f32 = 0.2;
/// Conjugate-gradient steps at most, and the share of the residual's square (as preconditioned) at which they end:
/// the samples' noise is far above.
const STEPS: usize = 16;
const SETTLED: f64 = 1e-5;

/// What a place of the lattice should look like.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FitSample {
    /// Where, local frame.
    pub position: Vec3,
    /// Light that the fit is to have there.
    pub light: Vec3,
    /// How much it counts, among samples of equal |∇h|.
    pub weight: f32,
}

impl From<&RadianceSample> for FitSample {
    fn from(s: &RadianceSample) -> Self {
        Self { position: s.position, light: s.radiance, weight: 1.0 }
    }
}

/// Samples sorted by the cell of the grid they lie in.
struct Sorted {
    /// First sample of each row of cells; one more entry than rows.
    starts: Vec<usize>,
    samples: Vec<Placed>,
    dims: [usize; 3],
}

/// A sample inside its cell.
#[derive(Clone, Copy, Default)]
struct Placed {
    /// Its cell, x fastest.
    cell: u64,
    /// Position in the cell, [0, 1]³.
    u: Vec3,
    weight: f32,
    light: Vec3,
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

/// The least-squares fit described above. Its result does not depend on the number of threads.
#[derive(Clone, Copy)]
#[allow(missing_debug_implementations, reason = "holds a function")]
pub struct GridFit<'a> {
    field: &'a Field,
    lattice: &'a Lattice,
    /// The nodes that are fitted; the others stay as they are.
    free: &'a NodeSet,
    /// As [`PULL`].
    pull: f32,
    tick: Tick<'a>,
}

impl<'a> GridFit<'a> {
    /// A fit of light at the nodes of `lattice` that `free` holds. `tick(n)` reports n nodes done; returning false
    /// stops early.
    pub fn new(field: &'a Field, lattice: &'a Lattice, free: &'a NodeSet, tick: Tick<'a>) -> Self {
        Self { field, lattice, free, pull: PULL, tick }
    }

    /// Improves `start`, light at the nodes (Shepard's, say). Beside the grid it takes 84 bytes per free node and 114
    /// per sample.
    pub fn light(&self, samples: &[FitSample], mut start: Vec<[f32; 3]>) -> Vec<[f32; 3]> {
        let fitted = self.solve(samples, &|o| Vec3::from_array(start[o]));
        (self.tick)(self.lattice.len() as u64);
        for (o, light) in self.free.members(0..self.lattice.len()).zip(fitted) {
            // Light is not negative, but a fit through noise may be.
            start[o] = light.max(Vec3::ZERO).to_array();
        }
        start
    }

    /// The variance of what [`GridFit::light`] makes of the nodes, in rising order, if `errors` are [`draws`] of the
    /// samples' errors instead of their light and `start` tells those of the nodes that it started from. From samples
    /// in a cell's corner the fit extrapolates, and enlarges them. It is linear, so errors go through it as light does;
    /// three draws know the variance of one node to about 4/5, that of many nodes' light well.
    pub(crate) fn variances(&self, errors: &[FitSample], start: &(dyn Fn(usize) -> Vec3 + Sync)) -> Vec<f32> {
        let fitted = self.solve(errors, start);
        fitted.into_iter().map(|draws| draws.length_squared() / 3.0).collect()
    }

    /// Improves a grid that blends `samples`, and its standard errors; the same blend of their [`errors`] is `blended`,
    /// since nodes begin with errors of the samples that they are fitted to.
    pub(crate) fn improve(&self, grid: &mut IlluminationGrid, samples: Vec<RadianceSample>, blended: &[[f32; 3]]) {
        let mut targets: Vec<FitSample> = samples.iter().map(FitSample::from).collect();
        let errors: Vec<f32> = samples.iter().map(|s| s.variance.sqrt()).collect();
        drop(samples);
        grid.radiance = self.light(&targets, std::mem::take(&mut grid.radiance));
        for ((n, target), &error) in (0..).zip(&mut targets).zip(&errors) {
            target.light = draws(n, error);
        }
        let variances = self.variances(&targets, &|o| Vec3::from_array(blended[o]));
        for (o, variance) in self.free.members(0..self.lattice.len()).zip(variances) {
            if grid.std_error[o].is_finite() {
                grid.std_error[o] = variance.sqrt();
            }
        }
    }

    /// Light at the nodes that are fitted, in rising order: what `start` tells of all nodes, made to fit the samples.
    fn solve(&self, samples: &[FitSample], start: &(dyn Fn(usize) -> Vec3 + Sync)) -> Vec<Vec3> {
        let Self { field, lattice, free, pull, tick } = *self;
        let sorted = &Sorted::new(field, lattice, samples);
        let [nx, ny, nz] = sorted.dims;
        let nodes = || free.members(0..nx * ny * nz);
        if free.is_empty() || sorted.samples.is_empty() {
            return nodes().map(start).collect();
        }
        // Σ φ w, the row sums of the normal equations: preconditioner, and the scale of the pull.
        let diagonal: Vec<f32> =
            sorted.gather(free, |n| Vec3::splat(sorted.samples[n].weight)).iter().map(|d| d.x).collect();
        let seen = diagonal.par_iter().filter(|d| **d > 0.0).count().max(1);
        let pull = pull * diagonal.iter().map(|d| f64::from(*d)).sum::<f64>() as f32 / seen as f32;
        // What each sample's cell says, from the values of its nodes two by two along x.
        let each = |pair: &(dyn Fn(usize) -> [Vec3; 2] + Sync)| -> Vec<Vec3> {
            sorted.samples.par_iter().with_min_len(1024).map(|s| sorted.value(s, pair)).collect()
        };
        let apply = |x: &[Vec3]| -> Vec<Vec3> {
            let said = each(&|o| free.pair(o).map(|slot| slot.map_or(Vec3::ZERO, |slot| x[slot])));
            let mut y = sorted.gather(free, |n| sorted.samples[n].weight * said[n]);
            y.par_iter_mut().zip(x).for_each(|(y, x)| *y += pull * *x);
            y
        };
        // A x = b with x = start + d: r = Σ w φ (r_j − interpolated start).
        let mut r = {
            let said = each(&|o| [o, o + 1].map(start));
            sorted.gather(free, |n| sorted.samples[n].weight * (sorted.samples[n].light - said[n]))
        };
        let mut d = vec![Vec3::ZERO; free.len()];
        let precondition = |r: &[Vec3]| -> Vec<Vec3> {
            r.par_iter().zip(&diagonal).map(|(r, d)| *r / (d + pull).max(f32::MIN_POSITIVE)).collect()
        };
        let mut z = precondition(&r);
        let mut p = z.clone();
        let mut rz = dot(&r, &z);
        let first = rz;
        for _ in 0..STEPS {
            if !tick(0) || !rz.cmpgt(SETTLED * first).any() {
                break;
            }
            let q = apply(&p);
            let alpha = divide(rz, dot(&p, &q));
            d.par_iter_mut().zip(&p).for_each(|(d, p)| *d += alpha * *p);
            r.par_iter_mut().zip(&q).for_each(|(r, q)| *r -= alpha * *q);
            z = precondition(&r);
            let next = dot(&r, &z);
            let beta = divide(next, rz);
            p.par_iter_mut().zip(&z).for_each(|(p, z)| *p = *z + beta * *p);
            rz = next;
        }
        d.iter_mut().zip(nodes()).for_each(|(d, o)| *d += start(o));
        d
    }
}

/// Samples that hold [`draws`] of their errors as light.
pub(crate) fn errors(samples: &[RadianceSample]) -> Vec<RadianceSample> {
    let drawn = (0..).zip(samples);
    drawn.map(|(n, s)| RadianceSample { radiance: draws(n, s.variance.sqrt()), ..*s }).collect()
}

/// Three draws of an error with mean 0 and this standard deviation; equal `index`, equal signs. None where it is not
/// finite: a fit would carry that everywhere.
#[inline]
pub(crate) fn draws(index: u64, deviation: f32) -> Vec3 {
    let deviation = if deviation.is_finite() { deviation } else { 0.0 };
    let bits = Stage::Noise.key(0, index).stream().bits();
    Vec3::from_array([0, 1, 2].map(|n| if bits >> n & 1 == 0 { deviation } else { -deviation }))
}

/// Sums per channel in f64, in fixed blocks.
fn dot(a: &[Vec3], b: &[Vec3]) -> DVec3 {
    a.par_chunks(1 << 14)
        .zip(b.par_chunks(1 << 14))
        .map(|(a, b)| a.iter().zip(b).fold(DVec3::ZERO, |s, (a, b)| s + a.as_dvec3() * b.as_dvec3()))
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
    fn new(field: &Field, lattice: &Lattice, samples: &[FitSample]) -> Self {
        let (dims, cells) = (lattice.dims(), lattice.cells());
        let scale = lattice.far() / field.lattice().far();
        let mut placed: Vec<Placed> = samples
            .par_iter()
            .map(|s| {
                let local = s.position.as_dvec3();
                let p = (local * scale).clamp(DVec3::ZERO, lattice.far());
                let cell = [0, 1, 2].map(|a| (p[a] as usize).min(cells[a] - 1));
                let u = p - DVec3::from_array(cell.map(|c| c as f64));
                let index = (cell[2] * cells[1] + cell[1]) * cells[0] + cell[0];
                let weight = s.weight * field.gradient(local).length() as f32;
                Placed { cell: index as u64, u: u.as_vec3(), weight, light: s.light }
            })
            .collect();
        // Stable: samples of one cell keep their order.
        placed.par_sort_by_key(|s| s.cell);
        let first = |row: usize| placed.partition_point(|s| s.cell < (row * cells[0]) as u64);
        let starts = (0..=cells[1] * cells[2]).into_par_iter().map(first).collect();
        Self { starts, samples: placed, dims }
    }

    /// Σ φ_n · `term` of every sample around each node n of `free`: each node gathers from its up to eight cells in a
    /// fixed order, so nothing is shared between threads.
    fn gather(&self, free: &NodeSet, term: impl Fn(usize) -> Vec3 + Sync) -> Vec<Vec3> {
        let [nx, ny, _] = self.dims;
        let mut out = vec![Vec3::ZERO; free.len()];
        let rows = free.split(&mut out, nx);
        rows.into_par_iter().enumerate().filter(|(_, out)| !out.is_empty()).for_each(|(row, out)| {
            let mut sums = vec![Vec3::ZERO; nx];
            self.accumulate(row % ny, row / ny, &mut sums, &term);
            for (out, o) in out.iter_mut().zip(free.members(row * nx..(row + 1) * nx)) {
                *out = sums[o - row * nx];
            }
        });
        out
    }

    /// Adds φ_n · `term` of every sample around each node of row (j, k) to `out`.
    fn accumulate(&self, j: usize, k: usize, out: &mut [Vec3], term: &(impl Fn(usize) -> Vec3 + Sync)) {
        let cells = self.dims.map(|n| n - 1);
        for dz in 0..2 {
            for dy in 0..2 {
                // The row of cells whose far (d = 0) or near (d = 1) nodes these are.
                let (Some(cj), Some(ck)) = ((j + dy).checked_sub(1), (k + dz).checked_sub(1)) else { continue };
                if cj >= cells[1] || ck >= cells[2] {
                    continue;
                }
                let row = ck * cells[1] + cj;
                for n in self.starts[row]..self.starts[row + 1] {
                    let s = &self.samples[n];
                    let (w, t, ci) = (s.corners(), term(n), s.cell as usize - row * cells[0]);
                    let corner = 2 * (1 - dy) + 4 * (1 - dz);
                    out[ci] += w[corner] * t;
                    out[ci + 1] += w[corner + 1] * t;
                }
            }
        }
    }

    /// Interpolation at a sample of node values that `pair` tells for two neighbours along x.
    #[inline]
    fn value(&self, s: &Placed, pair: &(dyn Fn(usize) -> [Vec3; 2] + Sync)) -> Vec3 {
        let [nx, ny, _] = self.dims;
        let (cx, cy) = (nx - 1, ny - 1);
        let cell = s.cell as usize;
        let o = (cell / (cx * cy) * ny + cell / cx % cy) * nx + cell % cx;
        let w = s.corners();
        [o, o + nx, o + nx * ny, o + nx * ny + nx].into_iter().enumerate().fold(Vec3::ZERO, |sum, (n, o)| {
            let [a, b] = pair(o);
            sum + w[2 * n] * a + w[2 * n + 1] * b
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use crate::illumination_grid::shepard;
    use crate::mask::{Mask, masks};
    use crate::rng::{Rng, Sobol};
    use crate::volume::Samples;

    #[test]
    fn a_trilinear_radiance_is_recovered_where_shepard_blurs_it() {
        let lattice = Lattice::aligned([9, 8, 7], DVec3::ZERO, DVec3::ONE).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[0] as f32).collect();
        let field = Field::made(lattice, Samples::F32(samples), 0.0, 8.0);
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
        let targets: Vec<FitSample> = samples.iter().map(FitSample::from).collect();
        let free = NodeSet::new(field.lattice().len(), |o| start.mask[o] != Mask::Empty);
        let with = |pull: f32| {
            let fit = GridFit { pull, ..GridFit::new(&field, field.lattice(), &free, &|_| true) };
            let radiance = fit.light(&targets, start.radiance.clone());
            error(&IlluminationGrid { radiance, ..start.clone() })
        };
        // These samples have no noise.
        let [after, held] = [0.01, PULL].map(with);
        println!("RMS error: Shepard {before}, fitted {after}, held against noise {held}");
        assert!(before > 0.02 && after < 0.2 * before, "Shepard {before}, fitted {after}");
        assert!(held < 0.5 * before, "Shepard {before}, fitted {held}");
    }

    /// Light and lengths in any unit: the same fit, times the unit.
    #[test]
    fn the_fit_has_no_unit() {
        let fitted = |spacing: f64, unit: f32| {
            let lattice = Lattice::aligned([7; 3], DVec3::ZERO, DVec3::splat(spacing)).unwrap();
            let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[0] as f32).collect();
            let field = Field::made(lattice.clone(), Samples::F32(samples), 0.0, 6.0);
            let free = NodeSet::new(lattice.len(), |_| true);
            let mut rng = Rng::stream(3, Stage::Test, 0);
            let mut next = || rng.unit() as f32;
            let targets: Vec<FitSample> = (0..3000)
                .map(|_| {
                    let position = 6.0 * Vec3::new(next(), next(), next());
                    FitSample { position, light: Vec3::splat(unit * (1.0 + position.y)), weight: 1.0 }
                })
                .collect();
            GridFit::new(&field, &lattice, &free, &|_| true).light(&targets, vec![[0.0; 3]; lattice.len()])
        };
        let plain = fitted(1.0, 1.0);
        // Nanometres in metres, and as much light as is taken.
        for (spacing, unit) in [(1e-9, 1e18), (1e9, 1e-15)] {
            for (a, b) in plain.iter().zip(fitted(spacing, unit)) {
                assert!((a[1] - b[1] / unit).abs() < 1e-4 * a[1], "{spacing} {unit}: {} {}", a[1], b[1] / unit);
            }
        }
    }

    /// Samples in one corner of their cells and nodes that are fixed, all with errors: the variance of many fits is
    /// what one tells.
    #[test]
    fn errors_go_through_the_fit() {
        let lattice = Lattice::aligned([12; 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[0] as f32).collect();
        let field = Field::made(lattice.clone(), Samples::F32(samples), 0.0, 11.0);
        let free = NodeSet::new(lattice.len(), |o| lattice.ijk(o)[0] % 2 == 1);
        let mut rng = Rng::stream(1, Stage::Test, 0);
        let errors: Vec<f32> = (0..4000).map(|_| 0.1 * rng.unit() as f32).collect();
        let at: Vec<Vec3> = errors
            .iter()
            .map(|_| {
                Vec3::from_array(
                    [11, 3, 2].map(|n| (f64::from(n) * rng.unit()).floor() as f32 + 0.4 * rng.unit() as f32),
                )
            })
            .collect();
        let targets = |light: &mut dyn FnMut(usize) -> Vec3| -> Vec<FitSample> {
            at.iter().enumerate().map(|(n, &position)| FitSample { position, light: light(n), weight: 1.0 }).collect()
        };
        let node = |o: usize| 0.03 + 0.02 * (o % 3) as f32;
        let drawn = |o: usize| draws((at.len() + o) as u64, node(o));
        let fit = GridFit::new(&field, &lattice, &free, &|_| true);
        let said = fit.variances(&targets(&mut |n| draws(n as u64, errors[n])), &drawn);
        let mut normal = |deviation: f32| Vec3::from_array([(); 3].map(|()| 5.0 + deviation * rng.normal() as f32));
        let mut found = vec![0.0; said.len()];
        const FITS: usize = 40;
        for _ in 0..FITS {
            let start = (0..lattice.len()).map(|o| normal(node(o)).to_array()).collect();
            let light = fit.light(&targets(&mut |n| normal(errors[n])), start);
            for (found, o) in found.iter_mut().zip(free.members(0..lattice.len())) {
                *found += (Vec3::from_array(light[o]) - 5.0).length_squared() / (3 * FITS) as f32;
            }
        }
        let mean = |of: &[f32]| f64::from(of.iter().sum::<f32>()) / of.len() as f64;
        let (said, found) = (mean(&said), mean(&found));
        println!("variance {said}, of many fits {found}");
        assert!((said / found - 1.0).abs() < 0.15, "{said} {found}");
    }

    /// Nodes begin with a blend of the samples that they are fitted to: the errors of both are the same ones.
    #[test]
    fn errors_of_samples_are_in_the_blend_and_in_the_fit() {
        let lattice = Lattice::aligned([9; 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[0] as f32).collect();
        let field = Field::made(lattice.clone(), Samples::F32(samples), 0.0, 8.0);
        let masks = masks(&field, &lattice);
        let mut rng = Rng::stream(5, Stage::Test, 0);
        let places: Vec<Vec3> = (0..729).map(|_| 8.0 * Vec3::from_array([(); 3].map(|()| rng.unit() as f32))).collect();
        let mut grids = |normal: bool| {
            let light = |rng: &mut Rng| if normal { 100.0 + rng.normal() as f32 } else { 100.0 };
            let sample = |&position| RadianceSample {
                position,
                radiance: Vec3::splat(light(&mut rng)),
                variance: 1.0,
                ..RadianceSample::default()
            };
            let samples: Vec<RadianceSample> = places.iter().map(sample).collect();
            let mut grid = shepard(&field, &lattice, &masks, &samples, 8, &|_| true);
            let blended = shepard(&field, &lattice, &masks, &errors(&samples), 8, &|_| true).radiance;
            let free = NodeSet::new(lattice.len(), |o| grid.mask[o] != Mask::Empty);
            GridFit::new(&field, &lattice, &free, &|_| true).improve(&mut grid, samples, &blended);
            grid
        };
        let told = grids(false).std_error.iter().map(|e| f64::from(*e).powi(2)).sum::<f64>() / lattice.len() as f64;
        let squares = |grid: IlluminationGrid| -> f64 {
            grid.radiance.iter().map(|r| f64::from(r[1] - 100.0).powi(2)).sum::<f64>() / lattice.len() as f64
        };
        let found = (0..24).map(|_| squares(grids(true))).sum::<f64>() / 24.0;
        println!("variance told {told}, found {found}");
        // Three draws know a mean of 729 nodes, whose errors their neighbours share, to a tenth or so.
        assert!((told / found - 1.0).abs() < 0.2, "{told} {found}");
    }
}
