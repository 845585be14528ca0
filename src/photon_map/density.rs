//! Photons counted in bins, and irradiance as a local linear fit to the bins' densities.
//!
//! What a bin needs beside its photons' power, the measure ∫|∇h| dV of level sets in it with their mean isovalue, receiver
//! normal and place, does not depend on the photons: it is integrated once. Level sets that face different octants have bins of
//! their own, so that the sides of a thin sheet do not mix. The light around a bin at x minimises Σ K A D (P/D − a − b·(y − x))²
//! over the bins (power P, measure D, centroid y) that it accepts (A): a + b·(z − x) at z. At a border or a crease, where bins
//! lie on one side only, the slope b keeps their mean from standing for x. The kernel is a ball in coordinates of the
//! bins, so that coarse slices of a volume blur no further than they must. \[Loader99\]
//!
//! That, too, is found once per bin, as light is at the photons of \[Christensen99\]: an estimate blends what the bins of the
//! eight cells around it say of its place.

use super::measure::{self, Bin, Cells, octant};
use super::{EstimateSettings, Irradiance};
use crate::direct::luminance;
use crate::field::Field;
use crate::linear_fit::Moments;
use crate::photon::SurfacePhoton;
use crate::scene::Scene;
use glam::{DVec3, DVec4, Vec3};
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
struct Neighbour {
    number: u32,
    /// The square of its distance, and its offset, in bins.
    d2: f32,
    d: Vec3,
}

/// The photons of one side in bins.
pub(super) struct PhotonDensity<'a> {
    field: &'a Field,
    settings: EstimateSettings,
    cells: Cells,
    /// First bin of each cell, x fastest; one more entry than cells.
    starts: Vec<u32>,
    bins: Vec<Bin>,
    /// As many as bins.
    light: Vec<Light>,
    /// World edge of a cube of a cell's volume.
    edge: f64,
}

/// Radii in bins: the least, which reaches the next bins, where photons are counted, the largest.
const LEAST: f32 = 1.05;
const FIRST: f32 = 2.0;
const MOST: f32 = 5.0;
/// Photons of an estimate per photon of a bin, and the most photons that bins are meant to hold on average.
const SHARE: f64 = 8.0;
const FULL: f64 = 8.0;

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
        let kept: Vec<&SurfacePhoton> = photons.iter().filter(|p| keep(p)).collect();
        let axes = lattice.axes();
        let spacing = DVec3::from_array(std::array::from_fn(|a| axes.col(a).length()));
        let volume = axes.determinant().abs();
        let passed = field.samples().par_iter().filter(|h| (0.0..=1.0).contains(*h)).count();
        let per_bin = (settings.photons as f64 / SHARE).clamp(1.0, FULL);
        let voxels = (per_bin * passed as f64 / kept.len().max(1) as f64).max(1.0);
        let wanted = (volume * voxels).cbrt();
        let dims = lattice.dims();
        let factor: [usize; 3] = std::array::from_fn(|a| ((wanted / spacing[a]).round() as usize).clamp(1, dims[a]));
        let cells = Cells::new(factor, dims);
        let (starts, bins) = measure::bins(field, &cells, settings.tau);
        let edge = (volume * factor.iter().product::<usize>() as f64).cbrt();
        let mut density = Self { field, settings, cells, starts, bins, light: Vec::new(), edge };
        let places: Vec<Option<usize>> =
            kept.par_iter().with_min_len(1024).map(|p| density.own(p.position.as_dvec3()).1).collect();
        // Squares of a photon's power, of the world's fourth power of length, do not fit f32.
        let unit = lattice.unit().powi(-2) as f32;
        let mut tallies = vec![Tally::default(); density.bins.len()];
        for (p, place) in kept.iter().zip(places) {
            let Some(bin) = place.map(|n| &mut tallies[n]) else { continue };
            let power = unit * p.power * p.foreshortening;
            bin.power += power;
            bin.squares += luminance(power.as_dvec3()).powi(2) as f32;
        }
        for tally in &mut tallies {
            tally.luminance = luminance(tally.power.as_dvec3()) as f32;
        }
        density.light = density
            .bins
            .par_iter()
            .with_max_len(4096)
            .map_init(Vec::new, |near, bin| density.fitted(bin, &tallies, near))
            .collect();
        density
    }

    /// The bins of cells `from` to `to` of row (j, k).
    #[inline]
    fn row(&self, from: usize, to: usize, j: usize, k: usize) -> Range<usize> {
        let row = (k * self.cells.dims[1] + j) * self.cells.dims[0];
        self.starts[row + from] as usize..self.starts[row + to + 1] as usize
    }

    /// The normal at a local position, and the bin it belongs to: of its octant, or the one that faces most alike.
    #[inline]
    fn own(&self, position: DVec3) -> (Vec3, Option<usize>) {
        let normal = self.field.falling_normal(position).unwrap_or_default();
        let normal = normal.as_vec3();
        let place = self.cells.place(position);
        let [i, j, k] = [0, 1, 2].map(|a| self.cells.cell(a, place[a]));
        let octant = octant(normal.into());
        let mut best = (f32::NEG_INFINITY, None);
        for n in self.row(i, i, j, k) {
            let bin = &self.bins[n];
            let alike = if bin.octant == octant { 2.0 } else { bin.normal.dot(normal) };
            if alike > best.0 {
                best = (alike, Some(n));
            }
        }
        (normal, best.1)
    }

    /// Calls `visit(bin, d², d)` for the numbers of the bins within `radius` of `place`, at offset d; all in bins.
    #[inline]
    fn around(&self, place: Vec3, radius: f32, mut visit: impl FnMut(usize, f32, Vec3)) {
        // How far a coordinate is from a cell's span.
        let beyond = |at: f32, cell: usize| (cell as f32 - at).max(at - cell as f32 - 1.0).max(0.0);
        let r2 = radius * radius;
        for k in self.cells.cell(2, place.z - radius)..=self.cells.cell(2, place.z + radius) {
            let left = r2 - beyond(place.z, k).powi(2);
            for j in self.cells.cell(1, place.y - radius)..=self.cells.cell(1, place.y + radius) {
                let left = left - beyond(place.y, j).powi(2);
                if left <= 0.0 {
                    continue;
                }
                let half = left.sqrt();
                for n in self.row(self.cells.cell(0, place.x - half), self.cells.cell(0, place.x + half), j, k) {
                    let d = self.bins[n].centroid - place;
                    let d2 = d.length_squared();
                    if d2 < r2 {
                        visit(n, d2, d);
                    }
                }
            }
        }
    }

    /// Whether light at `isovalue` and `normal` is `bin`'s.
    #[inline]
    fn accepts(&self, bin: &Bin, isovalue: f32, normal: Vec3) -> bool {
        (bin.isovalue - isovalue).abs() <= bin.reach && bin.normal.dot(normal) >= self.settings.cone as f32
    }

    /// The bins within `radius` of one that are alike.
    #[allow(clippy::cast_possible_truncation, reason = "numbers of bins are 32 bits wide")]
    fn alike(&self, at: &Bin, radius: f32, near: &mut Vec<Neighbour>) {
        near.clear();
        self.around(at.centroid, radius, |n, d2, d| {
            if self.accepts(&self.bins[n], at.isovalue, at.normal) {
                near.push(Neighbour { number: n as u32, d2, d });
            }
        });
    }

    /// The light that the bins around one that are alike have, within the radius that holds the photons asked for, so far as
    /// bins allow.
    #[allow(clippy::cast_possible_truncation, reason = "f32 does")]
    fn fitted(&self, at: &Bin, tallies: &[Tally], near: &mut Vec<Neighbour>) -> Light {
        let wanted = self.settings.photons as f32;
        // Photons of equal power that would be as noisy as those around.
        let count = |near: &[Neighbour]| {
            let (mut sum, mut squares) = (0.0f32, 0.0f32);
            for neighbour in near {
                let tally = &tallies[neighbour.number as usize];
                sum += tally.luminance;
                squares += tally.squares;
            }
            if squares > 0.0 { sum * sum / squares } else { 0.0 }
        };
        // Their number grows as the cube of the radius; where too few tell how fast, one more look.
        let mut known = FIRST;
        self.alike(at, known, near);
        let mut photons = count(near);
        if photons < 0.2 * wanted {
            known = MOST;
            self.alike(at, known, near);
            photons = count(near);
        }
        let radius = (known * (wanted / photons.max(1.0)).cbrt()).clamp(LEAST, MOST);
        if radius > known {
            self.alike(at, radius, near);
        }
        let scale = 1.0 / radius;
        let mut fit = Fit::default();
        for neighbour in near.iter().filter(|n| n.d2 < radius * radius) {
            let n = neighbour.number as usize;
            let kernel = 1.0 - neighbour.d2 * scale * scale;
            fit.add(self.bins[n].measure, &tallies[n], kernel, neighbour.d * scale);
        }
        let (value, slope, variance) = fit.solve();
        Light { value, slope: slope.map(|s| s * scale), variance, radius }
    }

    /// See [`super::PhotonMap::irradiance`]: the light of the bins around that are alike, by their part of the place.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "storage is f32; cells are clamped")]
    pub(super) fn irradiance(&self, position: DVec3, isovalue: f64) -> Irradiance {
        let (normal, own) = self.own(position);
        let place = self.cells.place(position);
        let low = (place - 0.5).floor();
        let high = place - 0.5 - low;
        let (mut mean, mut variance, mut weight) = (Vec3::ZERO, 0.0, 0.0);
        for corner in 0..8 {
            let step = Vec3::new((corner & 1) as f32, (corner >> 1 & 1) as f32, (corner >> 2) as f32);
            let cell = low + step;
            let part = (1.0 - (high - step).abs()).element_product();
            if part <= 0.0 || (0..3).any(|a| cell[a] < 0.0 || cell[a] as usize >= self.cells.dims[a]) {
                continue;
            }
            let [i, j, k] = cell.to_array().map(|x| x as usize);
            for n in self.row(i, i, j, k) {
                let bin = &self.bins[n];
                if self.accepts(bin, isovalue as f32, normal) {
                    let (light, d, w) = (&self.light[n], place - bin.centroid, part * bin.measure);
                    mean += w * (light.value + d.x * light.slope[0] + d.y * light.slope[1] + d.z * light.slope[2]);
                    variance += w * light.variance;
                    weight += w;
                }
            }
        }
        let own = own.map(|n| &self.light[n]);
        if weight > 0.0 {
            (mean, variance) = (mean / weight, variance / weight);
        } else if let Some(light) = own {
            // A tip or a crease, whose bin has another mean normal than the place itself.
            (mean, variance) = (light.value, light.variance);
        }
        Irradiance {
            mean: mean.max(Vec3::ZERO).as_dvec3(),
            variance: f64::from(variance),
            radius: f64::from(own.map_or(MOST, |l| l.radius)) * self.edge,
        }
    }
}

/// Weighted least squares of density against (1, d), d in radii.
#[derive(Default)]
struct Fit {
    /// Weighted by K D.
    measure: Moments,
    /// Weighted by K² Σ lum².
    noise: Moments,
    /// Σ K P (1, d).
    power: [Vec3; 4],
}

impl Fit {
    #[inline]
    fn add(&mut self, measure: f32, tally: &Tally, kernel: f32, d: Vec3) {
        self.measure.add(kernel * measure, d);
        self.noise.add(kernel * kernel * tally.squares, d);
        let p = tally.power * kernel;
        self.power[0] += p;
        self.power[1] += p * d.x;
        self.power[2] += p * d.y;
        self.power[3] += p * d.z;
    }

    /// The value at d = 0, its slope, and the variance of the value's luminance. A channel that the slope would drive below 0
    /// falls back to the mean.
    fn solve(&self) -> (Vec3, [Vec3; 3], f32) {
        let weight = self.measure.weight();
        if weight <= 0.0 {
            return Default::default();
        }
        let inverse = self.measure.inverse();
        let p = self.power.map(|p| p.as_dvec3());
        let of = |g: DVec4| (g.x * p[0] + g.y * p[1] + g.z * p[2] + g.w * p[3]).as_vec3();
        let value = of(inverse.x_axis);
        let lit = value.cmpge(Vec3::ZERO);
        let variance = inverse.x_axis.dot(self.noise.matrix() * inverse.x_axis).max(0.0);
        let slope = [inverse.y_axis, inverse.z_axis, inverse.w_axis].map(|g| Vec3::select(lit, of(g), Vec3::ZERO));
        (Vec3::select(lit, value, self.power[0] / weight), slope, variance as f32)
    }
}
