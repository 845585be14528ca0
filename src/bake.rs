//! The main job: from a scene to its illumination grid, stage by stage, with counts and seconds.

use crate::embree::{Device, GraphTracer};
use crate::error::{Error, Result};
use crate::fitted_grid::fit;
use crate::flat::FlatTexture;
use crate::flattened::Side;
use crate::illumination_grid::{GridSize, IlluminationGrid, shepard};
use crate::mask::{Mask, masks, stand_ins};
use crate::photon::{PhotonSettings, trace_photons};
use crate::photon_map::{EstimateSettings, Normalisation, PhotonMap};
use crate::progress::Progress;
use crate::radiance::{Indirect, RadianceSample, sample_radiance};
use crate::radiance_cache::{CacheSettings, RadianceCache};
use crate::sampling::{Strategy, positions};
use crate::scene::Scene;
use crate::volume::Lattice;
use glam::Vec3;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// How much work a bake is worth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Preset {
    /// Seconds: a first look.
    Preview,
    /// Minutes: fit to publish.
    #[default]
    Standard,
    /// As long as it takes.
    Reference,
}

/// The placement of samples, by name.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum StrategyName {
    /// Uniform over the volume.
    #[default]
    Uniform,
    /// On level sets 17.7 apart (in units of a sweep of 91.4), as BB09's strategy 1.
    LevelSet,
    /// On as many oblique parallel planes, as BB09's strategy 2.
    Planes,
    /// At the grid's points, without interpolation.
    Nodes,
}

/// How samples become grid values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Interpolation {
    /// Modified Shepard: the nearest samples blended, as BB09.
    Shepard,
    /// Least squares: the grid whose interpolation on isosurfaces is nearest to the samples.
    #[default]
    Fit,
}

/// What a user may set about a bake, in a scene file's `[bake]` table or by flags of the same names. Unset values come
/// from the preset.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, clap::Args)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct BakeOptions {
    /// Amount of work: preview (seconds), standard (minutes) or reference
    #[arg(long)]
    pub preset: Option<Preset>,
    /// Photons to emit
    #[arg(long, value_name = "N")]
    pub photons: Option<u64>,
    /// Reflections after which a photon is cut off (default: Russian roulette only)
    #[arg(long, value_name = "N")]
    pub bounces: Option<u16>,
    /// Photons per irradiance estimate (k nearest)
    #[arg(long, value_name = "K")]
    pub photons_per_estimate: Option<usize>,
    /// Largest isovalue difference of a photon to its estimate, as a fraction of the sweep
    #[arg(long, value_name = "TAU")]
    pub tau: Option<f64>,
    /// Radiance samples per side
    #[arg(long, value_name = "N")]
    pub samples: Option<u64>,
    /// Where samples are placed
    #[arg(long)]
    pub strategy: Option<StrategyName>,
    /// Shadow rays per sample and luminaire
    #[arg(long, value_name = "N")]
    pub shadow_rays: Option<u32>,
    /// Final gather rays per sample; 0 takes indirect light straight from the photon map (BB09's mode)
    #[arg(long = "gather", value_name = "M")]
    #[serde(rename = "gather")]
    pub gather_rays: Option<u32>,
    /// Nearest samples that Shepard interpolation blends
    #[arg(long, value_name = "K")]
    pub neighbours: Option<usize>,
    /// How samples become grid values
    #[arg(long)]
    pub interpolation: Option<Interpolation>,
    /// Size of the illumination grid: a factor of the volume's such as 2x, or NX,NY,NZ points
    #[arg(long, value_name = "SIZE")]
    #[serde(default, with = "grid_text")]
    pub grid: Option<GridSize>,
    /// Texels along the longer edge of a wall
    #[arg(long, value_name = "N")]
    pub wall_resolution: Option<usize>,
    /// Seed of all random numbers
    #[arg(long)]
    pub seed: Option<u64>,
}

/// `grid` as text in files.
mod grid_text {
    use super::GridSize;
    use serde::{Deserialize, Deserializer, Serializer};

    pub(super) fn serialize<S: Serializer>(grid: &Option<GridSize>, s: S) -> Result<S::Ok, S::Error> {
        match grid {
            Some(g) => s.collect_str(g),
            None => s.serialize_none(),
        }
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(d: D) -> Result<Option<GridSize>, D::Error> {
        String::deserialize(d)?.parse().map(Some).map_err(serde::de::Error::custom)
    }
}

impl BakeOptions {
    /// These options, with gaps filled from `other`.
    #[must_use]
    pub fn or(self, other: &Self) -> Self {
        Self {
            preset: self.preset.or(other.preset),
            photons: self.photons.or(other.photons),
            bounces: self.bounces.or(other.bounces),
            photons_per_estimate: self.photons_per_estimate.or(other.photons_per_estimate),
            tau: self.tau.or(other.tau),
            samples: self.samples.or(other.samples),
            strategy: self.strategy.or(other.strategy),
            shadow_rays: self.shadow_rays.or(other.shadow_rays),
            gather_rays: self.gather_rays.or(other.gather_rays),
            neighbours: self.neighbours.or(other.neighbours),
            interpolation: self.interpolation.or(other.interpolation),
            grid: self.grid.or(other.grid),
            wall_resolution: self.wall_resolution.or(other.wall_resolution),
            seed: self.seed.or(other.seed),
        }
    }
}

/// A bake fully decided.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BakeSettings {
    /// The preset that the rest started from.
    pub preset: Preset,
    /// Photons to emit.
    pub photons: u64,
    /// Reflections after which a photon is cut off.
    pub bounces: u16,
    /// Photons per estimate.
    pub photons_per_estimate: usize,
    /// Isovalue window of an estimate.
    pub tau: f64,
    /// Radiance samples per side; `None`: as many per grid point as the preset says.
    pub samples: Option<u64>,
    /// Samples per needed grid point where `samples` is `None`.
    pub samples_per_point: f64,
    /// Placement.
    pub strategy: StrategyName,
    /// Shadow rays per sample and luminaire.
    pub shadow_rays: u32,
    /// Gather rays per sample; 0: from the map.
    pub gather_rays: u32,
    /// Shadow rays per cached node and luminaire.
    pub cache_shadow_rays: u32,
    /// Samples blended per grid point.
    pub neighbours: usize,
    /// How samples become grid values.
    pub interpolation: Interpolation,
    /// Grid size, as text.
    #[serde(serialize_with = "grid_size_text")]
    pub grid: GridSize,
    /// Texels along the longer edge of a flat.
    pub wall_resolution: usize,
    /// Texels along the isovalue.
    pub wall_isovalues: usize,
    /// Shadow rays per texel and luminaire.
    pub wall_shadow_rays: u32,
    /// How photon power becomes irradiance.
    #[serde(skip)]
    pub normalisation: Normalisation,
    /// Seed.
    pub seed: u64,
}

fn grid_size_text<S: serde::Serializer>(grid: &GridSize, s: S) -> std::result::Result<S::Ok, S::Error> {
    s.collect_str(grid)
}

impl BakeSettings {
    /// The preset with the options that are set.
    ///
    /// # Errors
    /// `Invalid` for values out of range; the message names the option.
    pub fn new(o: &BakeOptions) -> Result<Self> {
        let preset = o.preset.unwrap_or_default();
        // photons, samples per point, shadow, gather, cache shadow, wall texels, wall isovalues, wall shadow
        let (photons, density, shadow, gather, cache, wall, isovalues, wall_shadow) = match preset {
            Preset::Preview => (1 << 19, 0.25, 8, 32, 2, 32, 16, 16),
            Preset::Standard => (1 << 22, 1.0, 16, 64, 4, 64, 32, 32),
            Preset::Reference => (1 << 24, 4.0, 64, 256, 16, 128, 64, 64),
        };
        let settings = Self {
            preset,
            photons: o.photons.unwrap_or(photons),
            bounces: o.bounces.unwrap_or(u16::MAX),
            photons_per_estimate: o.photons_per_estimate.unwrap_or(64),
            tau: o.tau.unwrap_or(EstimateSettings::default().tau),
            samples: o.samples,
            samples_per_point: density,
            strategy: o.strategy.unwrap_or_default(),
            shadow_rays: o.shadow_rays.unwrap_or(shadow),
            gather_rays: o.gather_rays.unwrap_or(gather),
            cache_shadow_rays: cache,
            neighbours: o.neighbours.unwrap_or(8),
            interpolation: o.interpolation.unwrap_or_default(),
            grid: o.grid.unwrap_or(GridSize::Factor(1)),
            wall_resolution: o.wall_resolution.unwrap_or(wall),
            wall_isovalues: isovalues,
            wall_shadow_rays: wall_shadow,
            normalisation: Normalisation::Accepted,
            seed: o.seed.unwrap_or(1),
        };
        let checks = [
            ("samples", settings.samples != Some(0), "at least 1"),
            ("photons-per-estimate", (2..=4096).contains(&settings.photons_per_estimate), "2 to 4096"),
            ("neighbours", (1..=1024).contains(&settings.neighbours), "1 to 1024"),
            ("shadow-rays", (1..=1 << 20).contains(&settings.shadow_rays), "1 to 1048576"),
            ("gather", settings.gather_rays <= 1 << 20, "0 to 1048576"),
            ("tau", settings.tau > 0.0 && settings.tau.is_finite(), "above 0"),
            ("wall-resolution", (2..=2048).contains(&settings.wall_resolution), "2 to 2048"),
        ];
        match checks.into_iter().find(|(_, ok, _)| !ok) {
            Some((name, _, range)) => Err(Error::Invalid(format!("{name}: must be {range}"))),
            None => Ok(settings),
        }
    }

    fn estimate(&self) -> EstimateSettings {
        EstimateSettings {
            photons: self.photons_per_estimate,
            tau: self.tau,
            normalisation: self.normalisation,
            ..EstimateSettings::default()
        }
    }
}

/// Wall seconds per stage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
#[allow(missing_docs, reason = "the names of the stages")]
pub struct Seconds {
    pub load: f64,
    pub build: f64,
    pub photons: f64,
    pub cache: f64,
    pub samples: f64,
    pub interpolate: f64,
    pub export: f64,
    pub total: f64,
}

/// Photon counts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct PhotonCounts {
    /// Emitted.
    pub emitted: u64,
    /// Landings stored.
    pub stored: u64,
    /// Landings where ∇h vanishes.
    pub without_gradient: u64,
    /// Largest relative imbalance of the energy over all isovalue bins.
    pub energy_imbalance: f64,
}

/// Everything a run says about itself.
#[derive(Clone, Debug, Serialize)]
pub struct BakeReport {
    /// Wall seconds.
    pub seconds: Seconds,
    /// Rays traced.
    pub rays: u64,
    /// Rays per second of the stages that trace them.
    pub rays_per_second: f64,
    /// Photons.
    pub photons: PhotonCounts,
    /// Radiance samples, all sides.
    pub samples: u64,
    /// Samples left out because ∇h vanishes.
    pub samples_without_gradient: u64,
    /// Grid points without radiance of their own: outside the sweep, without gradient, or not finite.
    pub masked: u64,
    /// Those of them that were filled from samples nearby.
    pub filled: u64,
    /// Gather rays that landed where the cache held nothing.
    pub misses: u64,
    /// Radiance values that were not finite, set to 0 and masked.
    pub non_finite: u64,
    /// Samples of the volume that are not finite.
    pub non_finite_voxels: u64,
    /// Threads.
    pub threads: usize,
    /// Seed.
    pub seed: u64,
    /// Embree's version.
    pub embree: String,
    /// Commit of the program.
    pub commit: &'static str,
    /// Points of the illumination grid.
    pub grid: [usize; 3],
    /// Settings.
    pub settings: BakeSettings,
}

/// A finished bake.
pub struct Bake {
    /// The grid's lattice.
    pub lattice: Lattice,
    /// One grid per stored side, the outside first.
    pub sides: Vec<(Side, IlluminationGrid)>,
    /// Radiance of polygons and caps over (u, v, isovalue), by flat number.
    pub flats: Vec<Option<FlatTexture>>,
    /// Display exposure: rgb = radiance × exposure, then clamped and sRGB-encoded.
    pub exposure: f64,
    /// Counts and seconds. `load`, `export` and `total` are for the caller to fill.
    pub report: BakeReport,
}

/// Illuminates every isosurface of the sweep.
///
/// # Errors
/// `Invalid` if no level set of the sweep has a gradient anywhere, `Embree`, or `Interrupted`.
pub fn bake(scene: &Scene, settings: &BakeSettings, device: &Device, progress: Progress) -> Result<Bake> {
    let lattice = settings.grid.lattice(scene.lattice())?;
    let begun = Instant::now();
    let tracer = GraphTracer::new(device, scene)?;
    let mut seconds = Seconds { build: begun.elapsed().as_secs_f64(), ..Seconds::default() };

    let masks = masks(&scene.field, &lattice);
    let needed = masks.iter().filter(|&&m| m != Mask::Empty).count() as u64;
    if needed == 0 {
        return Err(Error::Invalid(
            "no isosurface of the sweep has a gradient anywhere: the volume is constant there; choose other isovalues"
                .into(),
        ));
    }

    let stage = progress.stage("photons", settings.photons);
    let photon_settings = PhotonSettings {
        count: settings.photons,
        max_bounces: settings.bounces,
        seed: settings.seed,
        fixed_isovalue: None,
    };
    let photons = trace_photons(scene, &tracer, &photon_settings, &|n| stage.tick(n));
    seconds.photons = stage.end()?;
    let mut rays = photons.rays;

    let stage = progress.stage("cache", RadianceCache::work(scene));
    let cache_settings = CacheSettings {
        node_shadow_rays: settings.cache_shadow_rays,
        flat_shadow_rays: settings.wall_shadow_rays,
        flat_resolution: settings.wall_resolution,
        isovalue_resolution: settings.wall_isovalues,
        seed: settings.seed,
    };
    let estimate = settings.estimate();
    let fill_nodes = settings.gather_rays > 0;
    let cache = RadianceCache::new(scene, &tracer, &photons, estimate, &cache_settings, fill_nodes, &|n| stage.tick(n));
    seconds.cache = stage.end()?;
    rays += cache.rays;

    let mut sides = Vec::new();
    let (mut sample_count, mut without_gradient, mut non_finite) = (0, 0, 0);
    for side in scene.surface.stored_sides() {
        let map;
        let indirect = if settings.gather_rays > 0 {
            Indirect::Gather(&cache, settings.gather_rays)
        } else {
            map = PhotonMap::new(scene, &photons.surface, side, |p| p.bounces > 0, estimate);
            Indirect::Map(&map)
        };
        let begun = Instant::now();
        let (at, owners) = place(scene, settings, &lattice, &masks, needed)?;
        let stage = progress.stage("samples", at.len() as u64);
        let sampled =
            sample_radiance(scene, &tracer, &indirect, &at, side, settings.shadow_rays, settings.seed, &|n| {
                stage.tick(n)
            });
        stage.end()?;
        seconds.samples += begun.elapsed().as_secs_f64();
        rays += sampled.rays;
        without_gradient += sampled.without_gradient;

        let passes = 1 + u64::from(settings.interpolation == Interpolation::Fit);
        let stage = progress.stage("interpolate", passes * lattice.len() as u64);
        let mut grid = match owners {
            Some(owners) => collect(&masks, &owners, &sampled.samples),
            None => {
                let samples: Vec<RadianceSample> = sampled.samples.into_iter().flatten().collect();
                sample_count += samples.len() as u64;
                let grid = shepard(&scene.field, &lattice, &masks, &samples, settings.neighbours, &|n| stage.tick(n));
                match settings.interpolation {
                    Interpolation::Shepard => grid,
                    Interpolation::Fit => fit(&scene.field, &lattice, &samples, grid, &|n| stage.tick(n)),
                }
            }
        };
        if settings.strategy == StrategyName::Nodes {
            sample_count += at.len() as u64 - sampled.without_gradient;
        }
        for (rgb, mask) in grid.radiance.iter_mut().zip(&mut grid.mask) {
            if !rgb.iter().all(|x| x.is_finite()) {
                (*rgb, *mask) = ([0.0; 3], Mask::Empty);
                non_finite += 1;
            }
        }
        seconds.interpolate += stage.end()?;
        sides.push((side, grid));
    }
    let count = |m: Mask| sides[0].1.mask.iter().filter(|&&x| x == m).count() as u64;
    let (empty, filled) = (count(Mask::Empty), count(Mask::Filled));
    let tracing = seconds.photons + seconds.cache + seconds.samples;
    let report = BakeReport {
        rays,
        rays_per_second: rays as f64 / tracing,
        photons: PhotonCounts {
            emitted: photons.emitted,
            stored: photons.stored(),
            without_gradient: photons.flat_gradient,
            energy_imbalance: photons.energy.iter().map(|e| e.imbalance()).fold(0.0, f64::max),
        },
        samples: sample_count,
        samples_without_gradient: without_gradient,
        masked: empty + filled,
        filled,
        misses: cache.misses(),
        non_finite,
        non_finite_voxels: scene.field.samples().iter().filter(|s| !s.is_finite()).count() as u64,
        threads: rayon::current_num_threads(),
        seed: settings.seed,
        embree: device.version(),
        commit: env!("ISOLUME_COMMIT"),
        grid: lattice.dims(),
        settings: settings.clone(),
        seconds,
    };
    Ok(Bake { lattice, sides, flats: cache.into_flats(), exposure: scene.exposure(), report })
}

/// Sample positions and, for samples at the grid's own points, the point that each belongs to.
#[allow(clippy::type_complexity, reason = "a pair")]
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "counts")]
fn place(
    scene: &Scene,
    settings: &BakeSettings,
    lattice: &Lattice,
    masks: &[Mask],
    needed: u64,
) -> Result<(Vec<Vec3>, Option<Vec<usize>>)> {
    let count = settings.samples.unwrap_or(((needed as f64 * settings.samples_per_point) as u64).max(1000));
    // BB09's level sets stand at 39.0 + 17.7 k of the bumps' sweep [3.6, 95]: the same fractions of any sweep.
    let fractions: Vec<f64> =
        (-2..=3).map(|k| (39.0 + 17.7 * f64::from(k) - 3.6) / 91.4).filter(|s| (0.0..=1.0).contains(s)).collect();
    let strategy = match settings.strategy {
        StrategyName::Uniform => Strategy::Uniform,
        StrategyName::Planes => Strategy::Planes(fractions.len()),
        StrategyName::LevelSet => Strategy::LevelSets(fractions),
        StrategyName::Nodes => {
            let (mut at, mut owners) = (Vec::new(), Vec::new());
            for o in (0..lattice.len()).filter(|&o| masks[o] != Mask::Empty) {
                for p in stand_ins(&scene.field, lattice, o, settings.seed).into_iter().flatten() {
                    at.push(p.as_vec3());
                    owners.push(o);
                }
            }
            return Ok((at, Some(owners)));
        }
    };
    let at = positions(&scene.field, &strategy, count, settings.seed)?;
    if at.is_empty() {
        return Err(Error::Invalid("no sample landed on an isosurface of the sweep; choose other isovalues".into()));
    }
    Ok((at, None))
}

/// The mean of the samples that each grid point owns.
#[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
fn collect(masks: &[Mask], owners: &[usize], samples: &[Option<RadianceSample>]) -> IlluminationGrid {
    let mut grid = IlluminationGrid {
        radiance: vec![[0.0; 3]; masks.len()],
        std_error: vec![0.0; masks.len()],
        mask: masks.iter().map(|&m| if m == Mask::Empty { m } else { Mask::Filled }).collect(),
    };
    let mut i = 0;
    while i < owners.len() {
        let owner = owners[i];
        let (mut sum, mut variance, mut n) = (Vec3::ZERO, 0.0, 0.0);
        while i < owners.len() && owners[i] == owner {
            if let Some(s) = &samples[i] {
                (sum, variance, n) = (sum + s.radiance, variance + s.variance, n + 1.0);
            }
            i += 1;
        }
        if n > 0.0 {
            grid.radiance[owner] = (sum / n).to_array();
            grid.std_error[owner] = variance.sqrt() / n;
            grid.mask[owner] = masks[owner];
        }
    }
    grid
}
