//! Irradiance from photons on the graph.
//!
//! Photons that land on the graph have power density E(x)·|∇h(x)| per unit of *domain volume*, by the coarea formula
//! dA dc = |∇h| dV. So E = Σ w K / ∫ K |∇h| dV, both over what the estimate accepts: the ball ∩ Ω ∩ {|h − c| ≤ τ} ∩
//! normal cone. Normalising over the accepted set makes borders, thin sheets and τ unbiased.

use crate::field::Field;
use crate::flattened::Side;
use crate::nearest::{Neighbours, PointGrid};
use crate::photon::SurfacePhoton;
use crate::rng::{Sobol, Stage};
use crate::scene::Scene;
use crate::warp;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// How irradiance is estimated from photons.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EstimateSettings {
    /// Nearest photons per estimate.
    pub photons: usize,
    /// Largest radius, as a fraction of Ω's diagonal.
    pub max_radius: f64,
    /// Largest difference in isovalue, in units of the sweep.
    pub tau: f64,
    /// Least cosine between the level sets' normals at photon and receiver.
    pub cone: f64,
    /// What divides the photons' power.
    pub normalisation: Normalisation,
}

impl Default for EstimateSettings {
    fn default() -> Self {
        Self { photons: 64, max_radius: 0.05, tau: 0.1, cone: 0.7, normalisation: Normalisation::Accepted }
    }
}

/// Ways to turn photon power into irradiance. The first is right; the others are kept for comparison.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Normalisation {
    /// Σ w K / ∫_A K |∇h| dV over the accepted set A.
    #[default]
    Accepted,
    /// Σ w K/|∇h(x_i)| with a kernel normalised over the whole ball: unbounded variance, ½ at a face of Ω.
    PerPhoton,
    /// Σ w K with the kernel normalised over the ball and no |∇h|: wrong by 0.1× to 1.9×, to show that the factor
    /// matters.
    WithoutGradient,
}

/// Points of the unit ball for ∫_A: a step, the most, and how many accepted ones are enough. Where few are accepted (noise,
/// thin sheets) a fixed number would make the divisor, and with it the estimate, jump.
const FOOTPRINT_STEP: usize = 64;
const FOOTPRINT_POINTS: usize = 1024;
const FOOTPRINT_ENOUGH: usize = 32;
/// Several sets, so that neighbouring estimates do not share their pattern.
const FOOTPRINT_SETS: usize = 16;

/// The photons of one side, sorted for lookup.
pub struct PhotonMap<'a> {
    field: &'a Field,
    settings: EstimateSettings,
    origin: DVec3,
    radius: f32,
    grid: PointGrid,
    /// Slot order of `grid`: power, isovalue, unit gradient (cone test).
    photons: Vec<MappedPhoton>,
    footprints: Vec<Vec<DVec3>>,
}

#[derive(Clone, Copy, Debug)]
struct MappedPhoton {
    power: Vec3,
    isovalue: f32,
    normal: Vec3,
    slope: f32,
}

/// An irradiance with its spread.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Irradiance {
    /// Per channel.
    pub mean: DVec3,
    /// Variance of the luminance, from the accepted photons' powers (Poisson).
    pub variance: f64,
    /// Radius used, world units.
    pub radius: f64,
    /// Photons accepted.
    pub photons: usize,
}

impl<'a> PhotonMap<'a> {
    /// Maps the photons of `side` of the scene's own field that `keep` accepts.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    pub fn new(
        scene: &'a Scene,
        photons: &[SurfacePhoton],
        side: Side,
        keep: impl Fn(&SurfacePhoton) -> bool + Sync,
        settings: EstimateSettings,
    ) -> Self {
        let lattice = scene.lattice();
        let origin = scene.bounds()[0];
        let own = |p: &SurfacePhoton| usize::from(p.field) == scene.number() && p.side == side;
        let kept: Vec<&SurfacePhoton> = photons.iter().filter(|p| own(p) && keep(p)).collect();
        // World metric relative to the scene's corner, so that f32 stays fine-grained.
        let positions: Vec<Vec3> =
            kept.par_iter().map(|p| (lattice.to_world(p.position.as_dvec3()) - origin).as_vec3()).collect();
        let grid = PointGrid::new(&positions, 3.0);
        let mapped = grid
            .numbers()
            .par_iter()
            .map(|&n| {
                let p = kept[n as usize];
                let g = scene.field.gradient(p.position.as_dvec3());
                MappedPhoton {
                    power: p.power,
                    isovalue: p.isovalue,
                    normal: g.normalize_or_zero().as_vec3(),
                    slope: g.length() as f32,
                }
            })
            .collect();
        let footprints = (0..FOOTPRINT_SETS)
            .map(|s| {
                let set = Sobol::set(0, Stage::Footprint, s as u64);
                (0..FOOTPRINT_POINTS as u32).map(|i| warp::ball(set.point2(i, 0), set.coordinate(i, 2))).collect()
            })
            .collect();
        let diagonal = (lattice.axes() * lattice.far()).length();
        let radius = (settings.max_radius * diagonal) as f32;
        Self { field: &scene.field, settings, origin, radius, grid, photons: mapped, footprints }
    }

    /// Number of photons.
    pub fn len(&self) -> usize {
        self.photons.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.photons.is_empty()
    }

    /// Irradiance at local `position` on L(h, `isovalue`). `scratch` is reused between calls.
    #[allow(clippy::cast_possible_truncation, reason = "distances are f32")]
    pub fn irradiance(&self, position: DVec3, isovalue: f64, scratch: &mut Neighbours) -> Irradiance {
        let lattice = self.field.lattice();
        let world = lattice.to_world(position);
        let normal = self.field.gradient(position).normalize_or_zero().as_vec3();
        let (c, tau, cone) = (isovalue as f32, self.settings.tau as f32, self.settings.cone as f32);
        let accept = |slot: u32| {
            let p = &self.photons[slot as usize];
            (p.isovalue - c).abs() <= tau && p.normal.dot(normal) >= cone
        };
        let k = self.settings.photons;
        self.grid.nearest((world - self.origin).as_vec3(), k, self.radius, accept, scratch);
        let found = scratch.found();
        if found.is_empty() {
            return Irradiance { radius: f64::from(self.radius), ..Irradiance::default() };
        }
        let farthest = found.iter().map(|e| e.0).fold(0.0, f32::max);
        // The k-th photon sets the radius and, by its kernel weight 0, does not count: the estimate is unbiased.
        let radius = f64::from(if found.len() < k { self.radius } else { farthest.sqrt() }).max(1e-30);
        let r2 = (radius * radius) as f32;
        // Epanechnikov's kernel 1 − (d/r)²; ∫ over the ball = 8π r³/15. [Silverman86]
        let (mut power, mut squares) = (DVec3::ZERO, 0.0);
        for &(d2, slot) in found {
            let p = &self.photons[slot as usize];
            let mut w = f64::from((1.0 - d2 / r2).max(0.0));
            if self.settings.normalisation == Normalisation::PerPhoton {
                w /= f64::from(p.slope);
            }
            let contribution = p.power.as_dvec3() * w;
            power += contribution;
            squares += crate::direct::luminance(contribution).powi(2);
        }
        let full = 8.0 * std::f64::consts::PI * radius.powi(3) / 15.0;
        let measure = match self.settings.normalisation {
            Normalisation::Accepted => self.footprint(position, isovalue, normal, radius),
            Normalisation::PerPhoton | Normalisation::WithoutGradient => full,
        };
        if !(measure > 0.0) {
            return Irradiance { radius, photons: found.len(), ..Irradiance::default() };
        }
        Irradiance { mean: power / measure, variance: squares / (measure * measure), radius, photons: found.len() }
    }

    /// ∫_A K |∇h| dV over the accepted part of the ball, by low-discrepancy points.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a hash of the position")]
    fn footprint(&self, position: DVec3, isovalue: f64, normal: Vec3, radius: f64) -> f64 {
        let lattice = self.field.lattice();
        let hash = position.to_array().iter().fold(0u64, |h, x| (h ^ x.to_bits()).wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let points = &self.footprints[(hash >> 60) as usize % FOOTPRINT_SETS];
        let far = lattice.far();
        let (mut sum, mut accepted, mut tried) = (0.0, 0, 0);
        for b in points {
            if tried % FOOTPRINT_STEP == 0 && accepted >= FOOTPRINT_ENOUGH {
                break;
            }
            tried += 1;
            let p = position + lattice.direction_to_index(*b * radius);
            if p.cmplt(DVec3::ZERO).any() || p.cmpgt(far).any() {
                continue;
            }
            let h = self.field.value(p);
            // Only the sweep's hyperplanes carry photons.
            if !((h - isovalue).abs() <= self.settings.tau && (0.0..=1.0).contains(&h)) {
                continue;
            }
            let g = self.field.gradient(p);
            let slope = g.length();
            if g.dot(normal.as_dvec3()) >= self.settings.cone * slope {
                sum += (1.0 - b.length_squared()) * slope;
                accepted += 1;
            }
        }
        sum * (4.0 / 3.0 * std::f64::consts::PI * radius.powi(3)) / tried as f64
    }
}
