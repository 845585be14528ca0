//! Photons counted in bins, and irradiance as a local linear fit to the bins' densities.
//!
//! What a bin needs beside its photons' power, the measure ∫|∇h| dV of level sets in it with their mean isovalue,
//! receiver normal and place, does not depend on the photons: it is integrated once. Level sets that face different
//! octants have bins of their own, so that the sides of a thin sheet do not mix. The light around a bin at x minimises
//! Σ K A D (P/D − a − b·(y − x))² over the bins (power P, measure D, centroid y) that it accepts (A): a + b·(z − x) at
//! z. At a border or a crease, where bins lie on one side only, the slope b keeps their mean from standing for x. The
//! kernel is a ball in coordinates of the bins, so that coarse slices of a volume blur no further than they must.
//! \[Loader99\]
//!
//! That, too, is found once per bin, as light is at the photons of \[Christensen99\]: an estimate blends what the bins
//! of the eight cells around it say of its place.

use super::cells::Cells;
use super::measure::{self, Bin};
use super::{EstimateSettings, Irradiance};
use crate::direct::luminance;
use crate::field::Field;
use crate::isa::{Isa, Work};
use crate::linear_fit::{NormalMatrix, Sums};
use crate::photon::{SurfacePhoton, octant};
use crate::scene::Scene;
use glam::{DVec3, DVec4, Vec3, Vec4};
use rayon::prelude::*;
use std::ops::Range;

/// The photons of a bin, power per [`unit`](crate::volume::Lattice::unit) squared as its measure is.
#[derive(Clone, Copy, Debug, Default)]
struct Tally {
    /// Σ w.
    power: Vec3,
    /// Its luminance.
    luminance: f32,
    /// Σ luminance(w)².
    squares: f32,
}

/// Irradiance around a bin: a linear function of the place.
#[derive(Clone, Copy, Debug, Default)]
struct Light {
    /// At the bin's centroid.
    value: Vec3,
    /// Per bin along each axis.
    slope: [Vec3; 3],
    /// Of the value's luminance.
    variance: f32,
    /// Of the ball that it was fitted in, in bins.
    radius: f32,
}

/// A bin beside another.
#[derive(Clone, Copy, Default)]
struct Neighbour {
    number: u32,
    /// The square of its distance, and its offset, in bins.
    d2: f32,
    d: Vec3,
}

/// The photons of one side in bins.
#[derive(Debug)]
pub(super) struct PhotonDensity<'a> {
    field: &'a Field,
    settings: EstimateSettings,
    cells: Cells,
    /// First bin of each cell, x fastest; one more entry than cells.
    starts: Vec<u32>,
    bins: Vec<Bin>,
    /// As many as bins.
    light: Vec<Light>,
    /// The mean measure of a bin.
    enough: f32,
}

/// Radii in bins: the least, which reaches the next bins, the largest.
const LEAST: f32 = 1.05;
const MOST: f32 = 5.0;
/// Photons are first counted within this times the radius of the bin before: neighbours want radii that are alike.
const MARGIN: f32 = 1.15;
/// Bins in a run. Each run begins anew, so that results do not depend on the number of threads …
const RUN: usize = 512;
/// … with this radius, in bins, since its first bin has none before it.
const FIRST: f32 = 1.75;
/// What radii grow by where bins are few.
const WIDER: f32 = 1.5;
/// Photons of an estimate per photon of a bin.
const SHARE: f64 = 8.0;
/// How many photons bins are meant to hold on average, least and most. Fewer would take longer to fit than to trace.
const FILL: [f64; 2] = [4.0, 8.0];

/// Bins one after the other whose light is to be found.
struct RunOfBins<'a> {
    density: &'a PhotonDensity<'a>,
    bins: &'a [Bin],
    tallies: &'a [Tally],
    near: &'a mut Vec<Neighbour>,
    light: &'a mut [Light],
}

impl Work for RunOfBins<'_> {
    type Output = ();

    #[inline(always)]
    fn work(self) {
        let mut before = FIRST;
        for (light, bin) in self.light.iter_mut().zip(self.bins) {
            *light = self.density.fitted(bin, self.tallies, MARGIN * before, self.near);
            before = light.radius;
        }
    }
}

impl<'a> PhotonDensity<'a> {
    /// Counts the photons that `keep` accepts. Cells hold whole voxels, as many as make for a few photons in each that
    /// level sets pass.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "storage is f32; sizes are small")]
    pub(super) fn new(
        scene: &'a Scene,
        photons: &[SurfacePhoton],
        keep: impl Fn(&SurfacePhoton) -> bool + Sync,
        settings: EstimateSettings,
    ) -> Self {
        let (field, lattice) = (&scene.field, scene.lattice());
        let kept = photons.par_iter().with_min_len(1024).filter(|p| keep(p)).count();
        let (spacing, volume) = (lattice.spacing(), lattice.cell_volume());
        let passed = field.samples().par_iter().filter(|h| (0.0..=1.0).contains(*h)).count();
        let per_bin = (settings.photons as f64 / SHARE).clamp(FILL[0], FILL[1]);
        let voxels = (per_bin * passed as f64 / kept.max(1) as f64).max(1.0);
        let wanted = (volume * voxels).cbrt();
        let dims = lattice.dims();
        let factor: [usize; 3] = std::array::from_fn(|a| ((wanted / spacing[a]).round() as usize).clamp(1, dims[a]));
        let cells = Cells::new(factor, dims);
        let (starts, bins) = measure::bins(field, &cells, settings.tau);
        // In f64: f32 would lose bins of a sum over millions.
        let enough = bins.iter().map(|bin| f64::from(bin.measure)).sum::<f64>() / bins.len().max(1) as f64;
        let enough = enough as f32;
        let mut density = Self { field, settings, cells, starts, bins, light: Vec::new(), enough };
        let tallies = density.tallies(photons, keep, lattice.unit().powi(-2) as f32);
        let (mut light, isa) = (vec![Light::default(); density.bins.len()], Isa::current());
        let runs = light.par_chunks_mut(RUN).zip(density.bins.par_chunks(RUN));
        runs.for_each_init(Vec::new, |near, (light, bins)| {
            isa.run(RunOfBins { density: &density, bins, tallies: &tallies, near, light });
        });
        density.light = light;
        density
    }

    /// What the photons that `keep` accepts carry into the bins. `scale`: of power.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32; numbers of bins are 32 bits wide")]
    fn tallies(
        &self,
        photons: &[SurfacePhoton],
        keep: impl Fn(&SurfacePhoton) -> bool + Sync,
        scale: f32,
    ) -> Vec<Tally> {
        let landing = |p: &SurfacePhoton| -> Option<(u32, Vec3)> {
            let position = p.position.as_dvec3();
            let normal = || self.field.falling_normal(position).unwrap_or_default().as_vec3();
            let own = self.own(position, p.octant, normal)?;
            // Squares of a photon's power, of the world's fourth power of length, do not fit f32.
            Some((own as u32, scale * p.power * p.foreshortening))
        };
        let landings: Vec<Vec<(u32, Vec3)>> = photons
            .par_chunks(1 << 12)
            .map(|photons| photons.iter().filter(|p| keep(p)).filter_map(landing).collect())
            .collect();
        let mut tallies = vec![Tally::default(); self.bins.len()];
        for (bin, power) in landings.into_iter().flatten() {
            let tally = &mut tallies[bin as usize];
            tally.power += power;
            tally.squares += luminance(power.as_dvec3()).powi(2) as f32;
        }
        for tally in &mut tallies {
            tally.luminance = luminance(tally.power.as_dvec3()) as f32;
        }
        tallies
    }

    /// The bins of cells `from` to `to` of row (j, k).
    #[inline]
    fn row(&self, from: usize, to: usize, j: usize, k: usize) -> Range<usize> {
        let row = (k * self.cells.dims[1] + j) * self.cells.dims[0];
        self.starts[row + from] as usize..self.starts[row + to + 1] as usize
    }

    /// The bin that a local position belongs to: of the octant of its normal, or the one that faces most alike.
    #[inline]
    fn own(&self, position: DVec3, octant: u8, normal: impl FnOnce() -> Vec3) -> Option<usize> {
        let place = self.cells.place(position);
        let [i, j, k] = [0, 1, 2].map(|a| self.cells.cell(a, place[a]));
        let mut bins = self.row(i, i, j, k);
        if bins.len() < 2 {
            return bins.next();
        }
        if let Some(own) = bins.clone().find(|&n| self.bins[n].octant == octant) {
            return Some(own);
        }
        let normal = normal();
        bins.map(|n| (self.bins[n].normal.dot(normal), n)).max_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, n)| n)
    }

    /// Whether light at `isovalue` and `normal` is `bin`'s.
    #[inline(always)]
    fn accepts(&self, bin: &Bin, isovalue: f32, normal: Vec3) -> bool {
        ((bin.isovalue - isovalue).abs() <= bin.reach) & (bin.normal.dot(normal) >= self.settings.cone as f32)
    }

    /// The bins within `radius` of one that are alike.
    #[allow(clippy::cast_possible_truncation, reason = "numbers of bins are 32 bits wide")]
    #[inline(always)]
    fn alike(&self, at: &Bin, radius: f32, near: &mut Vec<Neighbour>) {
        // How far a coordinate is from a cell's span.
        let beyond = |at: f32, cell: usize| (cell as f32 - at).max(at - cell as f32 - 1.0).max(0.0);
        let (place, r2) = (at.centroid, radius * radius);
        let cells = |axis: usize| [place[axis] - radius, place[axis] + radius].map(|at| self.cells.cell(axis, at));
        let [across, rows, layers] = [0, 1, 2].map(cells);
        let mut found = 0;
        for k in layers[0]..=layers[1] {
            let left = r2 - beyond(place.z, k).powi(2);
            for j in rows[0]..=rows[1] {
                if left <= beyond(place.y, j).powi(2) {
                    continue;
                }
                // How far the ball goes along a row costs more than the few bins beyond it.
                let row = self.row(across[0], across[1], j, k);
                if near.len() < found + row.len() {
                    near.resize(2 * found + row.len(), Neighbour::default());
                }
                // Which are alike is hard to foretell: each is written down, and the next over it if it is not.
                for (n, bin) in (row.start..).zip(&self.bins[row]) {
                    let d = bin.centroid - place;
                    let d2 = d.length_squared();
                    near[found] = Neighbour { number: n as u32, d2, d };
                    found += usize::from((d2 < r2) & self.accepts(bin, at.isovalue, at.normal));
                }
            }
        }
        near.truncate(found);
    }

    /// The light that the bins around one that are alike have, within the radius that holds the photons asked for, so
    /// far as bins allow. `first`: where photons are counted first.
    #[inline(always)]
    fn fitted(&self, at: &Bin, tallies: &[Tally], first: f32, near: &mut Vec<Neighbour>) -> Light {
        let wanted = self.settings.photons as f32;
        // Photons of equal power that would be as noisy as those around.
        let count = |near: &[Neighbour]| {
            // Squares of sums do not fit f32 where light is bright.
            let (mut sum, mut squares) = (0f64, 0f64);
            for neighbour in near {
                let tally = &tallies[neighbour.number as usize];
                sum += f64::from(tally.luminance);
                squares += f64::from(tally.squares);
            }
            if squares > 0.0 { (sum * sum / squares) as f32 } else { 0.0 }
        };
        // Their number grows as the cube of the radius; where too few tell how fast, look farther.
        let mut known = first.min(MOST);
        self.alike(at, known, near);
        let mut photons = count(near);
        while photons < 0.2 * wanted && known < MOST {
            known = (2.0 * known).min(MOST);
            self.alike(at, known, near);
            photons = count(near);
        }
        let mut radius = (known * (wanted / photons.max(1.0)).cbrt()).clamp(LEAST, MOST);
        if radius > known {
            self.alike(at, radius, near);
        }
        near.retain(|n| n.d2 < radius * radius);
        // Of a bin that level sets hardly touch a few points do not tell the measure: many photons on little of it may
        // be as many on more.
        while radius < MOST && near.iter().map(|n| self.bins[n.number as usize].measure).sum::<f32>() < self.enough {
            radius = (WIDER * radius).min(MOST);
            self.alike(at, radius, near);
        }
        let scale = 1.0 / radius;
        let kernel = |d2: f32| 1.0 - d2 * scale * scale;
        let mut fit = Fit::default();
        for neighbour in near.iter() {
            let n = neighbour.number as usize;
            fit.add(self.bins[n].measure, tallies[n].power, kernel(neighbour.d2), neighbour.d * scale);
        }
        let Some((value, slope, weights)) = fit.solve() else { return Light { radius, ..Light::default() } };
        // Σ l² σ² of what is linear in the photons' power. \[Loader99\]
        let variance = near.iter().map(|neighbour| {
            let d = neighbour.d * scale;
            let weight = kernel(neighbour.d2) * weights.dot(Vec4::new(1.0, d.x, d.y, d.z));
            weight * weight * tallies[neighbour.number as usize].squares
        });
        Light { value, slope: slope.map(|s| s * scale), variance: variance.sum(), radius }
    }

    /// The two cells that a place lies between along an axis, and its part of each: 0 of one that is not there.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "cells are small")]
    fn beside(&self, axis: usize, at: f32) -> [(usize, f32); 2] {
        let (count, above) = (self.cells.dims[axis], at + 0.5);
        let upper = above as usize;
        let high = above - upper as f32;
        let [low, high] = [if upper > 0 { 1.0 - high } else { 0.0 }, if upper < count { high } else { 0.0 }];
        [(upper.saturating_sub(1), low), (upper, high)]
    }

    /// See [`super::PhotonMap::irradiance`]: the light of the bins around that are alike, by their part of the place.
    /// `normal` is towards falling h.
    pub(super) fn irradiance(&self, position: DVec3, isovalue: f32, normal: Vec3) -> Irradiance {
        let place = self.cells.place(position);
        let (mut mean, mut variance, mut weight) = (Vec3::ZERO, 0.0, 0.0);
        let [across, rows, layers] = [self.beside(0, place.x), self.beside(1, place.y), self.beside(2, place.z)];
        for (k, z) in layers {
            for (j, y) in rows {
                for (i, x) in across {
                    let part = x * y * z;
                    if part <= 0.0 {
                        continue;
                    }
                    for n in self.row(i, i, j, k) {
                        let (bin, light) = (&self.bins[n], &self.light[n]);
                        if !self.accepts(bin, isovalue, normal) {
                            continue;
                        }
                        let (d, w) = (place - bin.centroid, part * bin.measure);
                        mean += w * (light.value + d.x * light.slope[0] + d.y * light.slope[1] + d.z * light.slope[2]);
                        variance += w * light.variance;
                        weight += w;
                    }
                }
            }
        }
        if weight > 0.0 {
            (mean, variance) = (mean / weight, variance / weight);
        } else if let Some(own) = self.own(position, octant(normal), || normal) {
            // A tip or a crease, whose bin has another mean normal than the place itself.
            Light { value: mean, variance, .. } = self.light[own];
        }
        Irradiance { mean: mean.max(Vec3::ZERO).as_dvec3(), variance: f64::from(variance) }
    }
}

/// How many times its mean a fit may be. Light that is linear and nowhere below 0 has 2.2 times the kernel's mean
/// at the corner of an eighth of a ball, 1.5 times at the edge of half of it: what is far above is noise.
const FAR_ABOVE: f32 = 4.0;

/// Weighted least squares of density against (1, d), d in radii.
#[derive(Default)]
struct Fit {
    /// Weighted by K D.
    measure: NormalMatrix,
    /// Of the bins' power, weighted by K.
    power: Sums,
}

impl Fit {
    #[inline(always)]
    fn add(&mut self, measure: f32, power: Vec3, kernel: f32, d: Vec3) {
        self.measure.add(kernel * measure, d);
        self.power.add(kernel * power, d);
    }

    /// The value at d = 0, its slope, and what to multiply K P (1, d) with for a place's part of the value; `None`
    /// without measure. A channel that the slope would drive below 0 or far above the mean falls back to the mean.
    fn solve(&self) -> Option<(Vec3, [Vec3; 3], Vec4)> {
        let weight = self.measure.weight();
        if weight <= 0.0 {
            return None;
        }
        let mean = self.power.total() / weight;
        let inverse = self.measure.inverse();
        let of = |g: DVec4| self.power.fitted(g).as_vec3();
        let value = of(inverse.x_axis);
        let lit = value.cmpge(Vec3::ZERO) & value.cmple(FAR_ABOVE * mean);
        let slope = [inverse.y_axis, inverse.z_axis, inverse.w_axis].map(|g| Vec3::select(lit, of(g), Vec3::ZERO));
        Some((Vec3::select(lit, value, mean), slope, inverse.x_axis.as_vec4()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::direct::Receiver;

    use crate::flattened::{Departure, Side};
    use crate::nearest::Neighbours;
    use crate::photon_map::{Estimator, PhotonMap};
    use crate::rng::{Rng, Stage};
    use crate::scene::{Boundary, Surface};
    use crate::volume::{Lattice, Samples};

    /// A ramp along x over `steps` steps of each axis.
    fn ramp(steps: usize) -> Scene {
        let lattice = Lattice::aligned([steps + 1; 3], DVec3::ZERO, DVec3::splat(0.5)).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[0] as f64 / steps as f64).collect();
        let field = Field::made(lattice, Samples::F64(samples), 0.0, 1.0);
        Scene::new(field, Surface::default(), Boundary::Open, Vec::new()).unwrap()
    }

    /// `count` photons of equal power anywhere in a ramp, a quarter as many where it is not `bright`.
    fn landed(seed: u64, steps: usize, count: usize, bright: impl Fn(DVec3) -> bool) -> Vec<SurfacePhoton> {
        let (mut rng, far) = (Rng::stream(seed, Stage::Test, 0), steps as f64);
        let mut landed = Vec::new();
        while landed.len() < count {
            let position = DVec3::from_array(std::array::from_fn(|_| far * rng.unit()));
            if bright(position) || rng.unit() < 0.25 {
                landed.push(SurfacePhoton {
                    position: position.as_vec3(),
                    isovalue: (position.x / far) as f32,
                    power: Vec3::ONE,
                    foreshortening: 1.0,
                    field: 0,
                    bounces: 1,
                    side: Side::Lower,
                    octant: octant(-Vec3::X),
                });
            }
        }
        landed
    }

    fn splat(photons: usize) -> EstimateSettings {
        EstimateSettings { estimator: Estimator::Splat, photons, tau: 1.0, ..EstimateSettings::default() }
    }

    /// Very bright light is that of dim light, bit for bit.
    #[test]
    fn radii_do_not_depend_on_power() {
        let (scene, dim) = (ramp(21), landed(7, 21, 20_000, |p| p.x < 10.5));
        // In units of the lattice 2⁵⁹: the square of 64 photons does not fit f32, that of one does.
        let factor = (59f64.exp2() * scene.lattice().unit().powi(2)) as f32;
        let bright: Vec<SurfacePhoton> = dim.iter().map(|p| SurfacePhoton { power: factor * p.power, ..*p }).collect();
        let [dim, bright] = [dim, bright].map(|landed| PhotonDensity::new(&scene, &landed, |_| true, splat(64)));
        assert!(dim.light.iter().zip(&bright.light).all(|(a, b)| a.radius == b.radius && factor * a.value == b.value));
        assert!(dim.light.iter().filter(|light| light.radius > LEAST).count() > 100);
    }

    /// Behind the last cell of a row of bins comes the first of the next, where it is bright.
    #[test]
    fn light_at_a_border_is_its_own() {
        // Two samples to a bin: places at the border are nearer to where a next bin would be than to the middle of the
        // last.
        let (scene, mut rng) = (ramp(41), Rng::stream(5, Stage::Test, 0));
        let mut sums = [0.0; 2];
        for seed in 1..=8 {
            let landed = landed(seed, 41, 70_000, |p| p.x < 20.5);
            let density = PhotonDensity::new(&scene, &landed, |_| true, splat(64));
            assert_eq!(density.cells.factor, [2; 3]);
            for (sum, [from, to]) in sums.iter_mut().zip([[0.0, 0.5], [40.5, 41.0]]) {
                for _ in 0..1000 {
                    let p = DVec3::new(from, 4.0, 4.0)
                        + DVec3::new(to - from, 33.0, 33.0) * DVec3::from_array(std::array::from_fn(|_| rng.unit()));
                    *sum += luminance(density.irradiance(p, (p.x / 41.0) as f32, -Vec3::X).mean) / 8000.0;
                }
            }
        }
        for (sum, share) in sums.into_iter().zip([0.8, 0.2]) {
            // Power per isovalue, of which there is half, on all of a level set.
            let off = sum / (70_000.0 * share / 0.5 / 20.5f64.powi(2)) - 1.0;
            assert!(off.abs() < 0.08, "{share}: {off}");
        }
    }

    /// Light on one flank of a ridge within a bin is not on the other, whichever side of surfaces it lands on.
    #[test]
    fn flanks_of_a_ridge_keep_their_light_on_either_side() {
        let lattice = Lattice::aligned([17; 3], DVec3::ZERO, DVec3::splat(0.5)).unwrap();
        let samples = (0..lattice.len()).map(|o| 1.0 - (lattice.ijk(o)[0] as f64 - 8.0).abs() / 8.0).collect();
        let field = Field::made(lattice, Samples::F64(samples), 0.0, 1.0);
        let scene = Scene::new(field, Surface::default(), Boundary::Open, Vec::new()).unwrap();
        let mut rng = Rng::stream(8, Stage::Test, 0);
        for side in Side::BOTH {
            let photons: Vec<SurfacePhoton> = landed(9, 16, 80_000, |_| true)
                .into_iter()
                .filter(|p| p.position.x < 8.0)
                .map(|p| SurfacePhoton { side, isovalue: p.position.x / 8.0, ..p })
                .collect();
            let map = PhotonMap::new(&scene, &photons, side, |_| true, splat(64));
            let mut light = |from: f64, to: f64| {
                let each = (0..2000).map(|_| {
                    let p = DVec3::new(from, 3.0, 3.0)
                        + DVec3::new(to - from, 10.0, 10.0) * DVec3::from_array(std::array::from_fn(|_| rng.unit()));
                    let receiver = Receiver {
                        position: p.as_vec3(),
                        normal: scene.normal(p, side).unwrap(),
                        isovalue: scene.field.value(p) as f32,
                        departure: Departure::Surface(side),
                    };
                    luminance(map.irradiance(&receiver, &mut Neighbours::default()).mean)
                });
                each.sum::<f64>() / 2000.0
            };
            let [slope, lit, dark] = [light(3.0, 6.0), light(7.6, 7.9), light(8.1, 8.4)];
            println!("{side:?}: {slope} below, {lit} beside the ridge, {dark} behind it");
            assert!((lit / slope - 1.0).abs() < 0.1 && dark < 0.02 * slope);
        }
    }

    #[test]
    fn every_instruction_set_and_number_of_threads_fits_the_same_light() {
        let (scene, landed) = (ramp(30), landed(7, 30, 150_000, |p| p.z < 11.0));
        let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let density = one.install(|| PhotonDensity::new(&scene, &landed, |_| true, splat(128)));
        assert!(density.bins.len() > 4 * RUN && !density.bins.len().is_multiple_of(RUN));
        let light = |density: &PhotonDensity<'_>| format!("{:?}", density.light);
        let three = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
        let again = three.install(|| PhotonDensity::new(&scene, &landed, |_| true, splat(128)));
        assert_eq!(light(&again), light(&density));
        let tallies = density.tallies(&landed, |_| true, scene.lattice().unit().powi(-2) as f32);
        for isa in Isa::found() {
            let mut found = vec![Light::default(); density.bins.len()];
            for (light, bins) in found.chunks_mut(RUN).zip(density.bins.chunks(RUN)) {
                let near = &mut Vec::new();
                isa.run(RunOfBins { density: &density, bins, tallies: &tallies, near, light });
            }
            // Numbers are written so that no two are alike.
            assert_eq!(format!("{found:?}"), light(&density), "{}", isa.name());
        }
    }

    /// Photons of equal power anywhere in a ramp, fewer in half of it: as noisy as that many photons are, on either
    /// side.
    #[test]
    fn estimates_are_as_noisy_as_the_photons_asked_for() {
        let scene = ramp(40);
        let bright = |p: DVec3| p.y < 20.0;
        for (seed, photons, count) in [(1, 32, 60_000), (2, 32, 300_000), (3, 128, 60_000), (4, 128, 300_000)] {
            let (mut rng, landed) = (Rng::stream(seed, Stage::Test, 1), landed(seed, 40, count, bright));
            let density = PhotonDensity::new(&scene, &landed, |_| true, splat(photons));
            for side in [true, false] {
                // Power to a level set's area, of which either half has 200.
                let expected = count as f64 * if side { 0.8 } else { 0.2 } / 200.0;
                let (mut sums, mut told, mut asked) = ([0.0; 2], 0.0, 0.0);
                for _ in 0..20_000 {
                    let p = DVec3::from_array(std::array::from_fn(|_| 8.0 + 24.0 * rng.unit()));
                    let p = DVec3::new(p.x, if side { p.y * 0.25 + 3.0 } else { p.y * 0.25 + 29.0 }, p.z);
                    let found = density.irradiance(p, (p.x / 40.0) as f32, -Vec3::X);
                    let off = luminance(found.mean) / expected - 1.0;
                    sums = [sums[0] + off, sums[1] + off * off];
                    told += found.variance / expected.powi(2);
                    asked += 1.0;
                }
                let (mean, variance, told) = (sums[0] / asked, sums[1] / asked, told / asked);
                let noise = variance * photons as f64;
                // Epanechnikov's kernel in space leaves 1.43, few bins more; a half has some 40 places apart.
                let as_asked = (0.7..3.5).contains(&noise) && (0.5..1.6).contains(&(told / variance));
                assert!(
                    as_asked && mean.abs() < 0.06,
                    "{photons} of {count}, {side}: {noise}, {told}, {variance}, {mean}"
                );
            }
        }
    }
}
