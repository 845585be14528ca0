//! Photons as points: the k nearest or all within a radius, their kernel normalised over the accepted part of the ball.

use super::{EstimateSettings, Estimator, Irradiance, Normalisation};
use crate::field::Field;
use crate::nearest::{Neighbours, PointGrid};
use crate::photon::SurfacePhoton;
use crate::rng::{Sobol, Stage, folded};
use crate::scene::Scene;
use crate::warp;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Points of the unit ball for ∫_A: a step, the most, and how many accepted ones are enough. Where few are accepted
/// (noise, thin sheets) a fixed number would make the divisor, and with it the estimate, jump.
const FOOTPRINT_STEP: usize = 64;
const FOOTPRINT_POINTS: usize = 1024;
const FOOTPRINT_ENOUGH: f64 = 32.0;
/// Several sets, so that neighbouring estimates do not share their pattern.
const FOOTPRINT_SETS: usize = 16;

/// The photons of one side, sorted for lookup.
#[derive(Debug)]
pub(super) struct PhotonPoints<'a> {
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
}

impl<'a> PhotonPoints<'a> {
    /// Maps the photons that `keep` accepts.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    pub(super) fn new(
        scene: &'a Scene,
        photons: &[SurfacePhoton],
        keep: impl Fn(&SurfacePhoton) -> bool + Sync,
        settings: EstimateSettings,
    ) -> Self {
        let lattice = scene.lattice();
        let origin = scene.bounds()[0];
        let kept: Vec<&SurfacePhoton> = photons.iter().filter(|p| keep(p)).collect();
        // World metric relative to the scene's corner, so that f32 stays fine-grained.
        let positions: Vec<Vec3> =
            kept.par_iter().map(|p| (lattice.to_world(p.position.as_dvec3()) - origin).as_vec3()).collect();
        let grid = PointGrid::new(&positions, 3.0);
        let mapped = grid
            .numbers()
            .par_iter()
            .map(|&n| {
                let p = kept[n as usize];
                MappedPhoton {
                    power: p.power * p.foreshortening,
                    isovalue: p.isovalue,
                    normal: scene.field.gradient(p.position.as_dvec3()).normalize_or_zero().as_vec3(),
                }
            })
            .collect();
        let footprints = (0..FOOTPRINT_SETS)
            .map(|s| {
                let set = Sobol::set(0, Stage::Footprint, s as u64);
                (0..FOOTPRINT_POINTS as u32).map(|i| warp::ball(set.point2(i, 0), set.coordinate(i, 2))).collect()
            })
            .collect();
        let diagonal = lattice.diagonal();
        let mut radius = settings.max_radius * diagonal;
        if settings.estimator == Estimator::Radius {
            // As many photons on average over the part of Ω that the sweep's level sets fill.
            let volume = lattice.world_volume() * scene.field.share_on_sweep() * settings.photons as f64
                / kept.len().max(1) as f64;
            radius = radius.min((volume * 3.0 / (4.0 * std::f64::consts::PI)).cbrt());
        }
        let radius = radius as f32;
        Self { field: &scene.field, settings, origin, radius, grid, photons: mapped, footprints }
    }

    /// See [`super::PhotonMap::irradiance`].
    #[allow(clippy::cast_possible_truncation, reason = "distances are f32")]
    pub(super) fn irradiance(&self, position: DVec3, isovalue: f64, scratch: &mut Neighbours) -> Irradiance {
        let lattice = self.field.lattice();
        let world = lattice.to_world(position);
        let normal = self.field.gradient(position).normalize_or_zero().as_vec3();
        let (c, tau, cone) = (isovalue as f32, self.settings.tau as f32, self.settings.cone as f32);
        let accept = |slot: u32| {
            let p = &self.photons[slot as usize];
            (p.isovalue - c).abs() <= tau && p.normal.dot(normal) >= cone
        };
        let k = match self.settings.estimator {
            Estimator::Radius => usize::MAX,
            _ => self.settings.photons,
        };
        self.grid.nearest((world - self.origin).as_vec3(), k, self.radius, accept, scratch);
        let found = scratch.found();
        if found.is_empty() {
            return Irradiance::default();
        }
        let farthest = found.iter().map(|e| e.0).fold(0.0, f32::max);
        // The k-th photon sets the radius and, by its kernel weight 0, does not count: the estimate is unbiased.
        let radius = f64::from(if found.len() < k { self.radius } else { farthest.sqrt() }).max(1e-30);
        let r2 = (radius * radius) as f32;
        // Epanechnikov's kernel 1 − (d/r)²; ∫ over the ball = 8π r³/15. [Silverman86]
        let (mut power, mut squares) = (DVec3::ZERO, 0.0);
        for &(d2, slot) in found {
            let p = &self.photons[slot as usize];
            let w = f64::from((1.0 - d2 / r2).max(0.0));
            let contribution = p.power.as_dvec3() * w;
            power += contribution;
            squares += crate::direct::luminance(contribution).powi(2);
        }
        let measure = match self.settings.normalisation {
            Normalisation::Accepted => self.footprint(position, isovalue, normal, radius),
            Normalisation::WithoutGradient => 8.0 * std::f64::consts::PI * radius.powi(3) / 15.0,
        };
        if !(measure > 0.0) {
            return Irradiance::default();
        }
        Irradiance { mean: power / measure, variance: squares / (measure * measure) }
    }

    /// ∫_A K |∇h| dV over the accepted part of the ball, by low-discrepancy points. Each stands for as much of h as a
    /// ball spans of which there are [`FOOTPRINT_POINTS`] in the whole: where little of that is accepted (thin sweeps),
    /// points would else hit or miss it, and the mean of 1 / ∫ is not 1 / the mean.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a hash of the position")]
    fn footprint(&self, position: DVec3, isovalue: f64, normal: Vec3, radius: f64) -> f64 {
        let lattice = self.field.lattice();
        let hash = folded(0, position);
        let points = &self.footprints[(hash >> 60) as usize % FOOTPRINT_SETS];
        let far = lattice.far();
        // Only the sweep's hyperplanes carry photons.
        let (lo, hi) = ((isovalue - self.settings.tau).max(0.0), (isovalue + self.settings.tau).min(1.0));
        let own = radius / (FOOTPRINT_POINTS as f64).cbrt();
        let (mut sum, mut accepted, mut tried) = (0.0, 0.0, 0);
        for b in points {
            if tried % FOOTPRINT_STEP == 0 && accepted >= FOOTPRINT_ENOUGH {
                break;
            }
            tried += 1;
            let p = position + lattice.direction_to_index(*b * radius);
            if p.cmplt(DVec3::ZERO).any() || p.cmpgt(far).any() {
                continue;
            }
            let (h, g) = (self.field.value(p), self.field.gradient(p));
            let slope = g.length();
            let half = own * slope;
            let share = match half > 0.0 {
                true => ((h + half).min(hi) - (h - half).max(lo)) / (2.0 * half),
                false => f64::from((lo..=hi).contains(&h)),
            };
            if share > 0.0 && g.dot(normal.as_dvec3()) >= self.settings.cone * slope {
                sum += (1.0 - b.length_squared()) * slope * share;
                accepted += share;
            }
        }
        sum * (4.0 / 3.0 * std::f64::consts::PI * radius.powi(3)) / tried as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use crate::scene::{Boundary, Surface, cornell_box};
    use crate::volume::{Lattice, Samples};

    /// Planes: of a ball much thicker than the sweep ∫ K |∇h| dV = π r² / 2, and sweeps between two samples fill a part
    /// of Ω, too.
    #[test]
    fn thin_sweeps_have_a_measure() {
        for width in [0.5, 0.05, 0.005, 5e-5] {
            let lattice = Lattice::aligned([17; 3], DVec3::ZERO, DVec3::ONE).unwrap();
            let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[2] as f32).collect();
            let field = Field::made(lattice.clone(), Samples::F32(samples), 8.2, 8.2 + width);
            assert!((field.share_on_sweep() / (width / 16.0) - 1.0).abs() < 1e-3, "{width}");
            let walls = cornell_box(&lattice, 0.1).unwrap();
            let scene = Scene::new(field, Surface::default(), Boundary::Open, walls).unwrap();
            let points = PhotonPoints::new(&scene, &[], |_| true, EstimateSettings { tau: 1.0, ..Default::default() });
            let radius = 3.0;
            let exact = 0.5 * std::f64::consts::PI * radius * radius;
            let mut mean = 0.0;
            for n in 0..200 {
                let p = DVec3::new(6.0 + 0.01 * f64::from(n), 8.0, 8.2 + 0.5 * width);
                let found = points.footprint(p, 0.5, Vec3::Z, radius) / exact;
                mean += found / 200.0;
                assert!((found - 1.0).abs() < 0.25, "{width}: {found} of what it is");
            }
            assert!((mean - 1.0).abs() < 0.03, "{width}: {mean} of what it is");
        }
    }
}
