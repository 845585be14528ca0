//! What a user may set about a bake, and the presets.

use super::preset::Preset;
use super::{can_sweep, left_out};
use crate::error::{Error, Result};
use crate::illumination_grid::GridSize;
use crate::isovalue_axis::IsovalueAxis;
use crate::photon::PhotonSettings;
use crate::photon_map::{EstimateSettings, Estimator};
use crate::radiance_cache::CacheSettings;
use crate::sampling::Strategy;
use crate::scene::Scene;
use crate::sweep::SweepSettings;
use crate::volume::generate::bumps;
use serde::{Deserialize, Serialize};

/// More bands than this save nothing.
pub const MOST_BANDS: usize = 256;

/// Photons, and samples, at most: more than any machine holds, and so few that what they take can be estimated.
const MOST_COUNTED: u64 = 1 << 40;

/// How light is computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Engine {
    /// Line sweeps: every grid point and every isovalue at once.
    Sweep,
    /// BB09's photons and final gather, by exact rays.
    Photon,
}

/// The placement of samples, by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum StrategyName {
    /// Uniform over the volume.
    Uniform,
    /// On level sets 17.7 apart (in units of a sweep of 91.4), as BB09's strategy 1.
    LevelSet,
    /// On as many oblique parallel planes, as BB09's strategy 2.
    Planes,
    /// At the grid's points, without interpolation.
    Nodes,
}

impl StrategyName {
    /// How scattered samples are placed; `None` for those at the grid's points. BB09's level sets stand at the same
    /// fractions of any sweep, and there are as many planes.
    pub fn placed(self) -> Option<Strategy> {
        match self {
            Self::Uniform => Some(Strategy::Uniform),
            Self::Planes => Some(Strategy::Planes(bumps::level_sets().len())),
            Self::LevelSet => Some(Strategy::LevelSets(bumps::level_sets())),
            Self::Nodes => None,
        }
    }
}

/// How samples become grid values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Interpolation {
    /// Modified Shepard: the nearest samples blended, as BB09.
    Shepard,
    /// Least squares: the grid whose interpolation on isosurfaces is nearest to the samples.
    Fit,
    /// Irradiance caching: closed-form direct light times the visible share that the samples know, and their indirect
    /// light.
    #[default]
    Irradiance,
}

/// Options that mean nothing to sweeps.
const OF_PHOTONS: [&str; 10] = [
    "photons",
    "bounces",
    "estimator",
    "photons-per-estimate",
    "samples",
    "strategy",
    "smoothing",
    "neighbours",
    "interpolation",
    "bands",
];
/// Options of exact rays, of which sweeps cast a few where they end.
const OF_RAYS: [&str; 3] = ["tau", "shadow-rays", "gather"];
/// Options that mean nothing to photons.
const OF_SWEEPS: [&str; 2] = ["directions", "light-points"];
/// Options that mean nothing to samples at the grid's points.
const OF_SCATTERED: [&str; 3] = ["samples", "neighbours", "interpolation"];

/// What a user may set about a bake, in a scene file's `[bake]` table or by flags of the same names. Unset values come
/// from the preset.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, clap::Args)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
pub struct BakeOptions {
    /// Amount of work: preview (seconds), standard (minutes, default) or reference
    #[arg(long)]
    pub preset: Option<Preset>,
    /// How light is computed (default: sweep, or photon for scenes that cannot be swept, for binary volumes, and with
    /// options that are its own)
    #[arg(long)]
    pub engine: Option<Engine>,
    /// Sweep engine: directions per pass and replicate (a power of two, 8 or more; by preset 64 / 256 / 512)
    #[arg(long, value_name = "N")]
    pub directions: Option<usize>,
    /// Sweep engine: points per luminaire and replicate (a power of two; by preset 16 / 64 / 128)
    #[arg(long, value_name = "N")]
    pub light_points: Option<usize>,
    /// Photons to emit (by preset 524288 / 4194304 / 16777216)
    #[arg(long, value_name = "N", value_parser = whole_number)]
    pub photons: Option<u64>,
    /// Reflections after which a photon is cut off (default: 65535, left to Russian roulette)
    #[arg(long, value_name = "N")]
    pub bounces: Option<u16>,
    /// Which photons an irradiance estimate looks at: bins of the lattice (splat, default), the k nearest, or all
    /// within a radius
    #[arg(long, value_name = "NAME")]
    pub estimator: Option<Estimator>,
    /// Photons per irradiance estimate (the bins': at least; within a radius: on average; default: 64, of bins without
    /// gather rays 1000)
    #[arg(long, value_name = "K")]
    pub photons_per_estimate: Option<usize>,
    /// Largest isovalue difference of a photon to its estimate, as a fraction of the sweep (default: 0.1)
    #[arg(long, value_name = "TAU")]
    pub tau: Option<f64>,
    /// Scattered radiance samples per side (default: one at each grid point)
    #[arg(long, value_name = "N", value_parser = whole_number)]
    pub samples: Option<u64>,
    /// Where samples are placed (default: nodes, or uniform if --samples is given)
    #[arg(long)]
    pub strategy: Option<StrategyName>,
    /// Shadow rays per sample and luminaire, at most (by preset 64 / 256 / 1024); fewer where there is little light to
    /// get, or once a quarter of them, but at least 64, agree
    #[arg(long, value_name = "N")]
    pub shadow_rays: Option<u32>,
    /// Final gather rays per sample (by preset 32 / 64 / 256); 0 takes indirect light straight from the photon map
    /// (BB09's mode)
    #[arg(long = "gather", value_name = "M")]
    #[serde(rename = "gather")]
    pub gather_rays: Option<u32>,
    /// Whether light gathered at the grid's points is smoothed over neighbouring ones where that lowers its error
    /// (default: true)
    #[arg(long, value_name = "BOOL")]
    pub smoothing: Option<bool>,
    /// Nearest samples that interpolation looks at (default: 8, by irradiance 16)
    #[arg(long, value_name = "K")]
    pub neighbours: Option<usize>,
    /// How scattered samples become grid values (default: irradiance)
    #[arg(long)]
    pub interpolation: Option<Interpolation>,
    /// Size of the illumination grid: a factor of the volume's such as 2x, one of each axis such as 1x,1x,4x, cubic
    /// (the factors that make cells nearest to cubes), or NX,NY,NZ points (default: 1x)
    #[arg(long, value_name = "SIZE")]
    #[serde(default, with = "grid_text")]
    pub grid: Option<GridSize>,
    /// Texels along the longer edge of a wall (by preset 32 / 64 / 128)
    #[arg(long, value_name = "N")]
    pub wall_resolution: Option<usize>,
    /// Also write `indirect` light and the `visible` share of the luminaires, so that pictures, meshes, pages and
    /// compare need not interpolate direct light, which takes off a tenth to a half of the error on data (default:
    /// false)
    #[arg(long, value_name = "BOOL", num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    pub split: Option<bool>,
    /// Seed of all random numbers (default: 1)
    #[arg(long)]
    pub seed: Option<u64>,
    /// Bands of isovalues baked one after another, which takes less memory (default: 1, or what --max-memory asks for)
    #[arg(long, value_name = "N")]
    pub bands: Option<usize>,
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
            engine: self.engine.or(other.engine),
            directions: self.directions.or(other.directions),
            light_points: self.light_points.or(other.light_points),
            photons: self.photons.or(other.photons),
            bounces: self.bounces.or(other.bounces),
            estimator: self.estimator.or(other.estimator),
            photons_per_estimate: self.photons_per_estimate.or(other.photons_per_estimate),
            tau: self.tau.or(other.tau),
            samples: self.samples.or(other.samples),
            strategy: self.strategy.or(other.strategy),
            shadow_rays: self.shadow_rays.or(other.shadow_rays),
            gather_rays: self.gather_rays.or(other.gather_rays),
            smoothing: self.smoothing.or(other.smoothing),
            neighbours: self.neighbours.or(other.neighbours),
            interpolation: self.interpolation.or(other.interpolation),
            grid: self.grid.or(other.grid),
            wall_resolution: self.wall_resolution.or(other.wall_resolution),
            split: self.split.or(other.split),
            seed: self.seed.or(other.seed),
            bands: self.bands.or(other.bands),
        }
    }

    /// The names of those that are set, as flags and files spell them.
    pub fn set(&self) -> Vec<String> {
        let all = serde_json::to_value(self).expect("options are plain data");
        let all = all.as_object().into_iter().flatten();
        all.filter(|(_, value)| !value.is_null()).map(|(name, _)| name.clone()).collect()
    }

    /// Those of `names` that are set.
    fn set_of(&self, names: &[&'static str]) -> Vec<&'static str> {
        let set = self.set();
        names.iter().copied().filter(|name| set.iter().any(|set| set == name)).collect()
    }

    /// What is set and changes nothing in a bake of `settings`, for people: a line for each cause.
    pub fn idle(&self, settings: &BakeSettings) -> Vec<String> {
        let scattered = settings.strategy != StrategyName::Nodes;
        let smoothing: &[&'static str] = if self.smoothing == Some(true) { &["smoothing"] } else { &[] };
        let of: &[(&[&'static str], &str)] = match (settings.engine, scattered) {
            (Engine::Sweep, _) => &[(&OF_PHOTONS, "engine = \"sweep\"")],
            (Engine::Photon, true) => &[(&OF_SWEEPS, "engine = \"photon\""), (smoothing, "scattered samples")],
            (Engine::Photon, false) => &[
                (&OF_SWEEPS, "engine = \"photon\""),
                (&OF_SCATTERED, "strategy = \"nodes\" (uniform, level-set and planes scatter samples)"),
                (if settings.gather_rays > 1 { &[] } else { smoothing }, "fewer than 2 gather rays"),
            ],
        };
        let line = |&(options, because): &(&[&'static str], &str)| {
            let set = self.set_of(options);
            let verb = if set.len() == 1 { "has" } else { "have" };
            (!set.is_empty()).then(|| format!("{} {verb} no effect with {because}", set.join(", ")))
        };
        of.iter().filter_map(line).collect()
    }

    /// The first options that are set and ask for photons and for sweeps.
    fn asks_for(&self) -> [Option<&'static str>; 2] {
        let first = |options: &[&'static str]| self.set_of(options).first().copied();
        [first(&OF_PHOTONS).or_else(|| first(&OF_RAYS)), first(&OF_SWEEPS)]
    }

    /// Whether nothing that is set asks for one of the engines.
    pub fn leaves_engine(&self) -> bool {
        self.engine.is_none() && self.asks_for() == [None; 2]
    }

    /// The engine for a scene: the one that is asked for; else sweeps, which are faster for the same error, unless
    /// options that only photons know are set, the scene cannot be swept, or sweeps would leave out what its surfaces
    /// reflect.
    fn engine(&self, scene: &Scene) -> Result<Engine> {
        let [photons, sweeps] = self.asks_for();
        match (self.engine, photons, sweeps) {
            (Some(engine), ..) => Ok(engine),
            (None, Some(photons), Some(sweeps)) => Err(Error::Invalid(format!(
                "{photons} is an option of the photon engine, {sweeps} of the sweep engine: say which with engine"
            ))),
            (None, Some(_), None) => Ok(Engine::Photon),
            (None, None, Some(_)) => Ok(Engine::Sweep),
            (None, None, None) => {
                let swept = can_sweep(scene).is_ok() && left_out(scene, &self.grid.unwrap_or(GridSize::OWN))?.is_none();
                Ok(if swept { Engine::Sweep } else { Engine::Photon })
            }
        }
    }
}

/// A bake fully decided.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct BakeSettings {
    /// The preset that the rest started from.
    pub preset: Preset,
    /// How light is computed.
    pub engine: Engine,
    /// Sweep directions per pass and replicate.
    pub directions: usize,
    /// Sweep points per luminaire and replicate.
    pub light_points: usize,
    /// Photons to emit.
    pub photons: u64,
    /// Reflections after which a photon is cut off.
    pub bounces: u16,
    /// Which photons an estimate looks at.
    pub estimator: Estimator,
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
    /// Whether gathered light is smoothed over the grid's points.
    pub smoothing: bool,
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
    /// Shadow rays per texel and luminaire; four times as many, of at least 32, beside texels that see one in part.
    pub wall_shadow_rays: u32,
    /// Whether light is split ([`crate::split`]).
    pub split: bool,
    /// Seed.
    pub seed: u64,
    /// Bands of isovalues baked one after another, at most. The light does not depend on it.
    pub bands: usize,
}

/// `size` for the volumes of a scene.
///
/// # Errors
/// `Invalid` if it is another of one volume than of another.
pub(crate) fn common_size(size: GridSize, scene: &Scene) -> Result<GridSize> {
    let mut sizes = scene.members().into_iter().map(|m| size.of(m.field.lattice()));
    let first = sizes.next().unwrap_or(size);
    match sizes.find(|other| *other != first) {
        None => Ok(first),
        Some(other) => Err(Error::Invalid(format!(
            "--grid {size}: is {first} of one volume and {other} of another; give all one of them"
        ))),
    }
}

fn grid_size_text<S: serde::Serializer>(grid: &GridSize, s: S) -> std::result::Result<S::Ok, S::Error> {
    s.collect_str(grid)
}

impl BakeSettings {
    /// Whether the photon engine smooths what it gathers: one ray has no two halves.
    pub(super) fn smooths(&self) -> bool {
        self.smoothing && self.gather_rays > 1
    }

    /// The preset with the options that are set, for a scene: it says whether it can be swept, which is the default.
    ///
    /// # Errors
    /// `Invalid` for values out of range, and for options of both engines if neither is named; the message names the
    /// option.
    pub fn new(o: &BakeOptions, scene: &Scene) -> Result<Self> {
        let settings = Self::with_engine(o, o.engine(scene)?)?;
        Ok(Self { grid: common_size(settings.grid, scene)?, ..settings })
    }

    /// As [`BakeSettings::new`], for an engine that is decided; a grid of cubes is left so.
    ///
    /// # Errors
    /// `Invalid` for values out of range; the message names the option.
    pub fn with_engine(o: &BakeOptions, engine: Engine) -> Result<Self> {
        let preset = o.preset.unwrap_or_default();
        let usual = preset.values();
        let estimator = o.estimator.unwrap_or_default();
        let gather_rays = o.gather_rays.unwrap_or(usual.gather_rays);
        // What no gather averages needs more photons; bins make them cheap.
        let per_estimate = if gather_rays == 0 && estimator == Estimator::Splat { 1000 } else { 64 };
        let interpolation = o.interpolation.unwrap_or_default();
        let settings = Self {
            preset,
            engine,
            directions: o.directions.unwrap_or(usual.directions),
            light_points: o.light_points.unwrap_or(usual.light_points),
            photons: o.photons.unwrap_or(usual.photons),
            bounces: o.bounces.unwrap_or(u16::MAX),
            estimator,
            photons_per_estimate: o.photons_per_estimate.unwrap_or(per_estimate),
            tau: o.tau.unwrap_or(EstimateSettings::default().tau),
            samples: o.samples,
            samples_per_point: usual.samples_per_point,
            // A number of samples asks for scattered ones.
            strategy: o.strategy.unwrap_or(if o.samples.is_some() {
                StrategyName::Uniform
            } else {
                StrategyName::Nodes
            }),
            shadow_rays: o.shadow_rays.unwrap_or(usual.shadow_rays),
            gather_rays,
            cache_shadow_rays: usual.cache_shadow_rays,
            smoothing: o.smoothing.unwrap_or(true),
            neighbours: o.neighbours.unwrap_or(if interpolation == Interpolation::Irradiance { 16 } else { 8 }),
            interpolation,
            grid: o.grid.unwrap_or(GridSize::OWN),
            wall_resolution: o.wall_resolution.unwrap_or(usual.wall_resolution),
            wall_isovalues: usual.wall_isovalues,
            wall_shadow_rays: usual.wall_shadow_rays,
            split: o.split.unwrap_or(false),
            seed: o.seed.unwrap_or(1),
            bands: o.bands.unwrap_or(1),
        };
        settings.check()?;
        Ok(settings)
    }

    /// Whether all values are in their ranges, and go together.
    ///
    /// # Errors
    /// `Invalid` if not; the message names the option.
    pub fn check(&self) -> Result<()> {
        let s = self;
        let samples = s.samples.unwrap_or(1);
        let checks: [(&str, &dyn std::fmt::Display, bool, &str); 12] = [
            (
                "directions",
                &s.directions,
                s.directions.is_power_of_two() && (8..=1 << 20).contains(&s.directions),
                "a power of two, 8 to 1048576",
            ),
            (
                "light-points",
                &s.light_points,
                s.light_points.is_power_of_two() && s.light_points <= 1 << 16,
                "a power of two, at most 65536",
            ),
            ("samples", &samples, (1..=MOST_COUNTED).contains(&samples), "1 to 1099511627776"),
            ("photons", &s.photons, s.photons <= MOST_COUNTED, "at most 1099511627776"),
            (
                "photons-per-estimate",
                &s.photons_per_estimate,
                (2..=4096).contains(&s.photons_per_estimate),
                "2 to 4096",
            ),
            ("neighbours", &s.neighbours, (1..=1024).contains(&s.neighbours), "1 to 1024"),
            ("shadow-rays", &s.shadow_rays, (1..=1 << 20).contains(&s.shadow_rays), "1 to 1048576"),
            ("gather", &s.gather_rays, s.gather_rays <= 1 << 20, "0 to 1048576"),
            ("bands", &s.bands, (1..=MOST_BANDS).contains(&s.bands), "1 to 256"),
            ("tau", &s.tau, s.tau > 0.0 && s.tau.is_finite(), "above 0 and finite"),
            ("wall-resolution", &s.wall_resolution, (2..=2048).contains(&s.wall_resolution), "2 to 2048"),
            ("wall_isovalues", &s.wall_isovalues, (2..=512).contains(&s.wall_isovalues), "2 to 512"),
        ];
        if s.engine == Engine::Sweep && s.bands > 1 {
            return Err(Error::Invalid(
                "bands: the lines of the sweep engine serve all isovalues at once; leave --bands out, or use the photon \
                 engine"
                    .into(),
            ));
        }
        if s.split && s.engine == Engine::Photon && s.strategy != StrategyName::Nodes {
            return Err(Error::Invalid(
                "split: only light of the grid's own points can be split, not that of scattered samples; leave strategy and \
                 samples out, or split"
                    .into(),
            ));
        }
        if let Some((name, value, _, range)) = checks.into_iter().find(|(_, _, ok, _)| !ok) {
            return Err(Error::Invalid(format!("{name} {value}: must be {range}")));
        }
        Ok(())
    }

    pub(super) fn sweep(&self) -> SweepSettings {
        SweepSettings {
            directions: self.directions,
            light_points: self.light_points,
            flat_resolution: (self.wall_resolution, self.wall_isovalues),
            direct: self.split,
            seed: self.seed,
            ..SweepSettings::default()
        }
    }

    pub(super) fn cache(&self, axis: IsovalueAxis) -> CacheSettings {
        CacheSettings {
            node_shadow_rays: self.cache_shadow_rays,
            flat_shadow_rays: self.wall_shadow_rays,
            flat_resolution: self.wall_resolution,
            isovalue_resolution: self.wall_isovalues,
            axis,
            seed: self.seed,
        }
    }

    /// How its photons are traced.
    pub(super) fn emission(&self, axis: IsovalueAxis) -> PhotonSettings {
        let (count, max_bounces, seed) = (self.photons, self.bounces, self.seed);
        PhotonSettings { count, max_bounces, seed, axis, fixed_isovalue: None }
    }

    pub(super) fn estimate(&self) -> EstimateSettings {
        EstimateSettings {
            estimator: self.estimator,
            photons: self.photons_per_estimate,
            tau: self.tau,
            ..EstimateSettings::default()
        }
    }
}

/// A number that may be written as `1e6`.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a whole number below 2⁵³")]
pub(crate) fn whole_number(text: &str) -> std::result::Result<u64, std::num::ParseIntError> {
    let short = text.parse::<f64>().ok().filter(|n| n.fract() == 0.0 && (0.0..9e15).contains(n));
    text.parse().or_else(|e| short.map(|n| n as u64).ok_or(e))
}

#[cfg(test)]
mod tests;
