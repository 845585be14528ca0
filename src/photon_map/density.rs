//! Photons counted in bins, and irradiance as a local linear fit to the bins' densities.
//!
//! What a bin needs beside its photons' power, the measure ∫|∇h| dV of level sets in it with their mean isovalue, normal
//! and place, does not depend on the photons: it is integrated once. The estimate at x minimises
//! Σ K A D (P/D − a − b·(y − x))² over the bins (power P, measure D, centroid y) that it accepts (A) and takes a: at a
//! border or a crease, where bins lie on one side only, the slope b keeps their mean from standing for x. The kernel is a
//! ball in coordinates of the bins, so that coarse slices of a volume blur no further than they must. \[Loader99\]

use super::{EstimateSettings, Irradiance};
use crate::direct::luminance;
use crate::field::Field;
use crate::linear_fit::Moments;
use crate::photon::SurfacePhoton;
use crate::scene::Scene;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// One bin: 12 floats.
#[derive(Clone, Copy, Debug, Default)]
struct Bin {
    /// Σ w.
    power: Vec3,
    /// Σ luminance(w)².
    squares: f32,
    /// ∫ |∇h| dV over what of the bin lies in Ω and in the sweep; 0: no level set.
    measure: f32,
    /// Mean isovalue by that measure.
    isovalue: f32,
    /// Mean unit gradient by that measure, normalised.
    normal: Vec3,
    /// Centroid by that measure, in coordinates of the bins.
    centroid: Vec3,
}

/// The photons of one side in bins.
pub(super) struct PhotonDensity<'a> {
    field: &'a Field,
    settings: EstimateSettings,
    /// Lattice steps per bin along each axis.
    factor: [usize; 3],
    dims: [usize; 3],
    bins: Vec<Bin>,
    /// World edge of a cube of a bin's volume.
    edge: f64,
}

/// Radii in bins: the least, where photons are counted, the largest.
const LEAST: f32 = 1.3;
const FIRST: f32 = 2.0;
const MOST: f32 = 5.0;

impl<'a> PhotonDensity<'a> {
    /// Counts the photons that `keep` accepts. Bins hold whole voxels, as many as make for a photon in each on average.
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
        let per_bin = (lattice.len() as f64 / kept.len().max(1) as f64).max(1.0);
        let wanted = (volume * per_bin).cbrt();
        let dims = lattice.dims();
        let factor: [usize; 3] = std::array::from_fn(|a| ((wanted / spacing[a]).round() as usize).clamp(1, dims[a]));
        let bins: [usize; 3] = std::array::from_fn(|a| dims[a].div_ceil(factor[a]));
        let mut density = Self {
            field,
            settings,
            factor,
            dims: bins,
            bins: vec![Bin::default(); bins.iter().product()],
            edge: (volume * factor.iter().product::<usize>() as f64).cbrt(),
        };
        let measured: Vec<Bin> = (0..density.bins.len())
            .into_par_iter()
            .with_min_len(1024)
            .map(|n| density.measured([n % bins[0], n / bins[0] % bins[1], n / (bins[0] * bins[1])]))
            .collect();
        density.bins = measured;
        let places: Vec<u32> = kept
            .par_iter()
            .map(|p| density.offset(density.bin(density.place(p.position.as_dvec3()).as_vec3())) as u32)
            .collect();
        for (p, &place) in kept.iter().zip(&places) {
            let bin = &mut density.bins[place as usize];
            bin.power += p.power;
            bin.squares += luminance(p.power.as_dvec3()).powi(2) as f32;
        }
        density
    }

    /// Coordinates of the bins of a local position: bin n spans [n, n + 1].
    #[inline]
    fn place(&self, p: DVec3) -> DVec3 {
        (p + 0.5) / DVec3::from_array(self.factor.map(|f| f as f64))
    }

    /// The bin of such coordinates, or the nearest.
    #[inline]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the bins")]
    fn bin(&self, place: Vec3) -> [usize; 3] {
        std::array::from_fn(|a| (place[a] as usize).min(self.dims[a] - 1))
    }

    #[inline]
    fn offset(&self, [i, j, k]: [usize; 3]) -> usize {
        (k * self.dims[1] + j) * self.dims[0] + i
    }

    /// A bin without its photons: ∫ over the octants of its voxels, one point in each, eight where the sweep ends.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn measured(&self, bin: [usize; 3]) -> Bin {
        let lattice = self.field.lattice();
        let far = lattice.far();
        // Points per lattice step: a bin of many voxels needs fewer.
        let fine = |a: usize| if self.factor[a] < 3 { 2.0 } else { 1.0 };
        let step = DVec3::new(1.0 / fine(0), 1.0 / fine(1), 1.0 / fine(2));
        let cell = step.element_product() * lattice.axes().determinant().abs();
        let from = DVec3::from_array(std::array::from_fn(|a| (bin[a] * self.factor[a]) as f64 - 0.5));
        let count: [usize; 3] = std::array::from_fn(|a| self.factor[a] * fine(a) as usize);
        let (mut measure, mut isovalue, mut normal, mut centroid) = (0.0, 0.0, DVec3::ZERO, DVec3::ZERO);
        let mut add = |p: DVec3, h: f64, g: DVec3, weight: f64| {
            let w = g.length() * weight;
            if w > 0.0 {
                measure += w;
                isovalue += w * h;
                normal += g * weight;
                centroid += w * p;
            }
        };
        let to_steps = lattice.axes().transpose();
        for k in 0..count[2] {
            for j in 0..count[1] {
                for i in 0..count[0] {
                    let p = from + (DVec3::new(i as f64, j as f64, k as f64) + 0.5) * step;
                    if p.cmplt(DVec3::ZERO).any() || p.cmpgt(far).any() {
                        continue;
                    }
                    let (h, g) = (self.field.value(p), self.field.gradient(p));
                    // How far h goes within the octant.
                    let spread = 0.5 * (to_steps * g).abs().dot(step);
                    if h - spread >= 0.0 && h + spread <= 1.0 {
                        add(p, h, g, cell);
                    } else if h + spread >= 0.0 && h - spread <= 1.0 {
                        for corner in 0..8u32 {
                            let o =
                                DVec3::from_array([0, 1, 2].map(|a| if corner >> a & 1 == 1 { 0.25 } else { -0.25 }));
                            let q = p + o * step;
                            let h = self.field.value(q);
                            if (0.0..=1.0).contains(&h) {
                                add(q, h, self.field.gradient(q), cell / 8.0);
                            }
                        }
                    }
                }
            }
        }
        if !(measure > 0.0) {
            return Bin::default();
        }
        Bin {
            measure: measure as f32,
            isovalue: (isovalue / measure) as f32,
            normal: normal.normalize_or_zero().as_vec3(),
            centroid: self.place(centroid / measure).as_vec3(),
            ..Bin::default()
        }
    }

    /// Calls `visit(bin, d², d)` for the bins with level sets within `radius` of `place`, at offset d; all in bins.
    #[inline]
    fn around(&self, place: Vec3, radius: f32, mut visit: impl FnMut(&Bin, f32, Vec3)) {
        let (lo, hi) = (self.bin(place - radius), self.bin(place + radius));
        for k in lo[2]..=hi[2] {
            for j in lo[1]..=hi[1] {
                for bin in &self.bins[self.offset([lo[0], j, k])..=self.offset([hi[0], j, k])] {
                    let d = bin.centroid - place;
                    let d2 = d.length_squared();
                    if d2 < radius * radius && bin.measure > 0.0 {
                        visit(bin, d2, d);
                    }
                }
            }
        }
    }

    /// See [`super::PhotonMap::irradiance`].
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    pub(super) fn irradiance(&self, position: DVec3, isovalue: f64) -> Irradiance {
        let place = self.place(position).as_vec3();
        let normal = self.field.gradient(position).normalize_or_zero().as_vec3();
        let (c, tau, cone) = (isovalue as f32, self.settings.tau as f32, self.settings.cone as f32);
        let accepts = |b: &Bin| (b.isovalue - c).abs() <= tau && b.normal.dot(normal) >= cone;
        let wanted = self.settings.photons as f32;
        // Photons of equal power that would be as noisy as those within a radius.
        let count = |radius: f32| {
            let (mut sum, mut squares) = (0.0f32, 0.0f32);
            self.around(place, radius, |b, _, _| {
                if accepts(b) {
                    sum += luminance(b.power.as_dvec3()) as f32;
                    squares += b.squares;
                }
            });
            if squares > 0.0 { sum * sum / squares } else { 0.0 }
        };
        // Their number grows as the cube of the radius; where too few tell how fast, one more look.
        let mut n = count(FIRST);
        let mut radius = FIRST;
        if n < 0.2 * wanted {
            radius = MOST;
            n = count(MOST);
        }
        let radius = (radius * (wanted / n.max(1.0)).cbrt()).clamp(LEAST, MOST);
        let scale = 1.0 / radius;
        let mut fit = Fit::default();
        self.around(place, radius, |b, d2, d| {
            if accepts(b) {
                fit.add(b, 1.0 - d2 * scale * scale, d * scale);
            }
        });
        if !fit.any() {
            // A tip or a crease, whose bin has another mean normal than the place itself.
            let bin = &self.bins[self.offset(self.bin(place))];
            if bin.measure > 0.0 {
                fit.add(bin, 1.0, Vec3::ZERO);
            }
        }
        let (mean, variance) = fit.solve();
        Irradiance { mean, variance, radius: f64::from(radius) * self.edge }
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
    fn add(&mut self, bin: &Bin, kernel: f32, d: Vec3) {
        self.measure.add(kernel * bin.measure, d);
        self.noise.add(kernel * kernel * bin.squares, d);
        let p = bin.power * kernel;
        self.power[0] += p;
        self.power[1] += p * d.x;
        self.power[2] += p * d.y;
        self.power[3] += p * d.z;
    }

    fn any(&self) -> bool {
        self.measure.weight() > 0.0
    }

    /// The value at d = 0 and the variance of its luminance. A channel that the slope would drive below 0 falls back to
    /// the mean.
    fn solve(&self) -> (DVec3, f64) {
        if !self.any() {
            return (DVec3::ZERO, 0.0);
        }
        let g = self.measure.at_origin();
        let p = self.power.map(|p| p.as_dvec3());
        let flat = p[0] / f64::from(self.measure.weight());
        let fitted = g.x * p[0] + g.y * p[1] + g.z * p[2] + g.w * p[3];
        let variance = g.dot(self.noise.matrix() * g).max(0.0);
        (DVec3::select(fitted.cmpge(DVec3::ZERO), fitted, flat), variance)
    }
}
