//! How much memory a bake takes, before it takes it.

use super::grid_points::STAND_INS;
use super::{BakeSettings, Engine, StrategyName};
use crate::embree::{Device, GraphTracer};
use crate::error::{Error, Result};
use crate::flat;
use crate::flattened::Side;
use crate::mask::{Mask, masks};
use crate::photon::{FlatPhoton, PhotonSettings, SurfacePhoton, trace_photons};
use crate::radiance::RadianceSample;
use crate::scene::Scene;
use crate::sweep;
use crate::volume::Volume;

/// The program, its libraries and threads.
const PROGRAM: u64 = 24 << 20;

/// Photons traced to learn how often they land.
const PILOTS: u64 = 1 << 12;

/// Bytes per mapped photon while its map is built, and when it stands.
const MAPPING: f64 = 76.0;
const MAP: f64 = 50.0;

/// Bytes of the sweep engine per grid point (normals in two orders, h in the second, what direct light sees), per point and
/// swept side (direct and incoming light, one plane of it turned over, what lines read), and per point and stored side (sums
/// over replicates and their spread).
const SWEPT: u64 = 24;
const SWEPT_SIDE: u64 = 36;
const SUMMED_SIDE: u64 = 16;

/// Bytes per point and side that its checkpoint holds while a replicate is under way, besides the sums.
const KEPT_SIDE: u64 = 20;

/// Bytes per grid point while points beside edges are fitted: seven vectors of conjugate gradients (84), the cells' first
/// samples, and what the heap keeps of stages before. Measured at 64³ and 101³.
const FITTED: u64 = 140;

/// Bytes that writing holds at most: batches of raw and packed blocks.
const WRITER: u64 = 128 << 20;

/// Estimated peak memory of a bake, stage by stage, everything that lives then included.
#[derive(Clone, Debug, PartialEq)]
pub struct MemoryEstimate {
    /// Name and bytes of each stage.
    pub stages: Vec<(&'static str, u64)>,
}

impl MemoryEstimate {
    /// The estimate for a scene that is loaded. A few photons are traced to learn how often they land: in a closed white
    /// cavity that can be hundreds of times.
    ///
    /// # Errors
    /// `Invalid` if the grid has too many points; `Embree`.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "an estimate of positive numbers")]
    pub fn new(scene: &Scene, volumes: &[&Volume], settings: &BakeSettings, device: &Device) -> Result<Self> {
        let mut base = PROGRAM;
        // Of all fields; sides stored of any.
        let (mut voxels, mut points, mut filled, mut samples, mut grids, mut stored) = (0, 0, 0, 0, 0, 0);
        for (member, volume) in scene.members().iter().zip(volumes) {
            let lattice = settings.grid.lattice(member.field.lattice())?;
            let (own_voxels, own_points) = (member.field.lattice().len() as u64, lattice.len() as u64);
            // On the volume's own lattice: a finer one needs about the same share of its points.
            let masks = masks(&member.field, member.field.lattice());
            let needed = masks.iter().filter(|&&m| m != Mask::Empty).count() as u64;
            let own_filled = masks.iter().filter(|&&m| m == Mask::Filled).count() as u64;
            let sides = member.surface.stored_sides().len() as u64;
            let element = volume.samples().element_type().size() as u64;
            // Volume, field, the pyramid of min and max, and a mask.
            base += own_voxels * (element + 4) + own_voxels * 33 / 8 + own_points;
            samples += match (settings.strategy, settings.samples) {
                (StrategyName::Nodes, _) => {
                    needed * own_points / own_voxels + (STAND_INS as u64 - 1) * own_filled * own_points / own_voxels
                }
                (_, Some(n)) => n,
                (_, None) => (needed as f64 * settings.samples_per_point) as u64,
            };
            (voxels, points) = (voxels + own_voxels, points + own_points);
            (filled, grids, stored) = (filled + own_filled, grids + own_points * 17 * sides, sides.max(stored));
        }
        let texels = flat::texels(scene, settings.wall_resolution, settings.wall_isovalues) as u64;
        // As gathers and as pictures see them.
        let flats = 24 * texels;
        let sample = size_of::<Option<RadianceSample>>() as u64;
        // A sample: position, owner, result, checkpoint.
        let per_sample = 12 + 8 + sample + RadianceSample::SAVED as u64;
        let export = grids + flats + points * (4 + 13 * stored) + WRITER.min(points * (5 + 29 * stored) * 2);
        let sides = sweep::swept_sides(scene).len() as u64;
        let swept = SWEPT + sides * (SWEPT_SIDE + KEPT_SIDE) + 2 * stored * SUMMED_SIDE;
        let fitting = points * FITTED + STAND_INS as u64 * filled * (32 + 36);
        let stages = match settings.engine {
            Engine::Photon => {
                let [landings, mapped] = landings(scene, settings, device)?;
                let photon = size_of::<SurfacePhoton>().max(size_of::<FlatPhoton>()) as f64;
                let photons = (landings * photon) as u64;
                let gather = settings.gather_rays > 0;
                // Nodes of both sides, and the same in the checkpoint.
                let nodes = if gather { 4 * 12 * voxels } else { 0 };
                // Both halves, as gathered, fitted twice and blended; normal and isovalue.
                let smoothing = if gather && settings.smoothing { points * (3 * 24 + 16) } else { 0 }.max(fitting);
                let map = if gather { 0 } else { (mapped * MAP) as u64 };
                vec![
                    ("photons", base + photons * 9 / 8),
                    ("cache", base + photons + (mapped * MAPPING) as u64 + nodes + flats * 3),
                    ("samples", base + photons + map + nodes + flats + samples * per_sample + smoothing + grids),
                    ("export", base + export),
                ]
            }
            Engine::Sweep => vec![
                ("sweep", base + points * swept + flats * 4),
                (
                    "samples",
                    base + flats + points * (12 * 3 + 16) + STAND_INS as u64 * filled * per_sample + fitting + grids,
                ),
                ("export", base + export),
            ],
        };
        Ok(Self { stages })
    }

    /// The largest stage.
    pub fn peak(&self) -> u64 {
        self.stages.iter().map(|s| s.1).max().unwrap_or(0)
    }

    /// Refuses a bake that needs more than `most` bytes.
    ///
    /// # Errors
    /// `Invalid` with the estimate.
    pub fn check(&self, most: u64) -> Result<()> {
        if self.peak() <= most {
            return Ok(());
        }
        Err(Error::Invalid(format!(
            "--max-memory {}: the bake is estimated at {self}; lower --photons or --grid, or allow more",
            size(most)
        )))
    }
}

/// Landings to be expected of all photons, and those in the largest photon map: one side of the level sets, first landings
/// left out.
fn landings(scene: &Scene, settings: &BakeSettings, device: &Device) -> Result<[f64; 2]> {
    let tracer = GraphTracer::new(device, scene)?;
    let pilot = PhotonSettings {
        count: PILOTS.min(settings.photons),
        max_bounces: settings.bounces,
        seed: settings.seed,
        fixed_isovalue: None,
    };
    let pilots = trace_photons(scene, &tracer, &pilot, &|_| true);
    let each = settings.photons as f64 / pilots.emitted.max(1) as f64;
    let of = |side: Side| pilots.surface.iter().filter(|p| p.side == side && p.bounces > 0).count();
    Ok([pilots.stored() as f64 * each, of(Side::Lower).max(of(Side::Higher)) as f64 * each])
}

/// Bytes for people.
fn size(bytes: u64) -> String {
    let bytes = bytes as f64;
    if bytes < 1e9 { format!("{:.0} MB", bytes / 1e6) } else { format!("{:.1} GB", bytes / 1e9) }
}

impl std::fmt::Display for MemoryEstimate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "about {} at its peak (", size(self.peak()))?;
        for (n, (name, bytes)) in self.stages.iter().enumerate() {
            write!(f, "{}{name} {}", if n > 0 { ", " } else { "" }, size(*bytes))?;
        }
        write!(f, ")")
    }
}
