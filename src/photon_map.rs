//! Irradiance from photons on the graph.
//!
//! Photons that land on the graph have power density E(x)·|∇h(x)| per unit of *domain volume*, by the coarea formula
//! dA dc = |∇h| dV. So E = Σ w K / ∫ K |∇h| dV, both over what the estimate accepts: the ball ∩ Ω ∩ {|h − c| ≤ τ} ∩
//! normal cone. Normalising over the accepted set makes borders, thin sheets and τ unbiased.

mod cells;
mod slots;
mod shares;
mod measure;

mod density;
mod points;

use crate::direct::Receiver;
use crate::flattened::Side;
use crate::nearest::Neighbours;
use crate::photon::SurfacePhoton;
use crate::scene::Scene;
use density::PhotonDensity;
use glam::DVec3;
use points::PhotonPoints;
use serde::{Deserialize, Serialize};

/// How irradiance is estimated from photons.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EstimateSettings {
    /// Which photons an estimate looks at.
    pub estimator: Estimator,
    /// Photons per estimate: exactly, on average over the map, or at least.
    pub photons: usize,
    /// Largest radius, as a fraction of Ω's diagonal; [`Estimator::Splat`] takes what its bins need.
    pub max_radius: f64,
    /// Largest difference in isovalue, in units of the sweep.
    pub tau: f64,
    /// Least cosine between the level sets' normals at photon and receiver.
    pub cone: f64,
    /// What divides the photons' power; [`Estimator::Splat`] knows only the first.
    pub normalisation: Normalisation,
}

impl Default for EstimateSettings {
    fn default() -> Self {
        Self {
            estimator: Estimator::default(),
            photons: 64,
            max_radius: 0.05,
            tau: 0.1,
            cone: 0.7,
            normalisation: Normalisation::Accepted,
        }
    }
}

/// Which photons an estimate looks at, and through which kernel.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Estimator {
    /// The k nearest, as BB09 has it: the radius follows the photons' density.
    Nearest,
    /// All within one radius, the same everywhere.
    Radius,
    /// Photons counted in bins of the lattice, and a linear function fitted to those around each, once; an estimate
    /// blends these functions, so that its cost does not depend on the photons' number and a border does not bend it.
    #[default]
    Splat,
}

/// Ways to turn photon power into irradiance. The first is right; the other is kept for comparison.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Normalisation {
    /// Σ w K / ∫_A K |∇h| dV over the accepted set A.
    #[default]
    Accepted,
    /// Σ w K with the kernel normalised over the ball and no |∇h|: wrong by 0.1× to 1.9×, to show that the factor
    /// matters.
    WithoutGradient,
}

/// An irradiance with its spread.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Irradiance {
    /// Per channel.
    pub mean: DVec3,
    /// Variance of the luminance, from the accepted photons' powers (Poisson).
    pub variance: f64,
}

/// The photons of one side, arranged for estimates.
#[derive(Debug)]
pub struct PhotonMap<'a> {
    arrangement: Arrangement<'a>,
    side: Side,
}

#[derive(Debug)]
enum Arrangement<'a> {
    Points(PhotonPoints<'a>),
    Density(PhotonDensity<'a>),
}

impl<'a> PhotonMap<'a> {
    /// Maps the photons of `side` of the scene's own field that `keep` accepts.
    pub fn new(
        scene: &'a Scene,
        photons: &[SurfacePhoton],
        side: Side,
        keep: impl Fn(&SurfacePhoton) -> bool + Sync,
        settings: EstimateSettings,
    ) -> Self {
        let keep = |p: &SurfacePhoton| usize::from(p.field) == scene.number() && p.side == side && keep(p);
        let arrangement = match settings.estimator {
            Estimator::Splat => Arrangement::Density(PhotonDensity::new(scene, photons, keep, settings)),
            Estimator::Nearest | Estimator::Radius => {
                Arrangement::Points(PhotonPoints::new(scene, photons, keep, settings))
            }
        };
        Self { arrangement, side }
    }

    /// Irradiance at a receiver on a level set, whose normal is that of the map's side. `scratch` is reused between
    /// calls.
    #[inline]
    pub fn irradiance(&self, receiver: &Receiver, scratch: &mut Neighbours) -> Irradiance {
        let position = receiver.position.as_dvec3();
        match &self.arrangement {
            Arrangement::Points(points) => points.irradiance(position, f64::from(receiver.isovalue), scratch),
            Arrangement::Density(density) => {
                let falling = self.side.facing(receiver.normal);
                density.irradiance(position, receiver.isovalue, falling.as_vec3())
            }
        }
    }
}
