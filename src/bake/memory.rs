//! How much memory a bake takes, before it takes it.

use super::bands::{Band, Levels, REACH};
use super::beside::BesideLight;
use super::grid_points::STAND_INS;
use super::{BakeSettings, Engine, Interpolation, MOST_BANDS, StrategyName};
use crate::checkpoint;
use crate::embree::{Device, GraphTracer};
use crate::error::{Error, Result};
use crate::fitted_grid::FitSample;
use crate::flat;
use crate::flattened::Side;
use crate::irradiance_caching;
use crate::isovalue_axis::IsovalueAxis;
use crate::mask::{Mask, masks, own_light};
use crate::node_set::NodeSet;
use crate::photon::{FlatPhoton, PhotonSettings, SurfacePhoton, trace_photons};
use crate::radiance::RadianceSample;
use crate::scene::{Member, Scene};
use crate::sweep;
use crate::volume::Volume;
use rayon::prelude::*;

/// The program, its libraries and threads.
const PROGRAM: u64 = 24 << 20;

/// Photons traced to learn how often they land.
const PILOTS: u64 = 1 << 12;

/// Bytes per mapped photon: its share of a bin (112 bytes while fitted, for 8 photons of the presets), or a photon in
/// its cell.
const MAP: f64 = 50.0;

/// Bytes per point of gathers kept for smoothing; and per point of a slice while they are smoothed.
const PACKED: u64 = 14;
const SLICES: u64 = 770;

/// Bytes per sample that stands in a list: position, key, result.
const SAMPLE: u64 = 12 + 8 + size_of::<Option<RadianceSample>>() as u64;

/// Bytes per scattered sample while Shepard blends them, besides the samples.
const SHEPARD: u64 = 12 + 16 + 12 + size_of::<RadianceSample>() as u64;
/// The same while irradiance caching looks at them.
const CACHING: u64 = 12 + 16 + irradiance_caching::BYTES;

/// Bytes per place beside the grid's points, and its light.
const PLACE: u64 = 12 + 8 + 4;
const BESIDE: u64 = size_of::<BesideLight>() as u64;

/// Bytes of them while they are fitted: the sample, and sorted by cells with what cells say. Smoothing before takes 80.
const FITTED_SAMPLE: u64 = size_of::<FitSample>() as u64;
const SORTED: u64 = 40 + 40 + 12;

/// Bytes per point and side of a grid (radiance, standard error, mask), of light that is split, and the direct
/// irradiance that it is split by, and of what gather rays find at a node.
const GRID: u64 = 17;
const SPLIT: u64 = 24 + 12;
const CACHED: u64 = 12;

/// Bytes of the sweep engine per grid point (h turned over, bits per block), and per point and swept side (what lines
/// read; the same of a pass before while light settles).
const SWEPT: u64 = 5;
const SWEPT_SIDE: u64 = 8;
const SETTLING_SIDE: u64 = 8;
/// Bytes per place of its planes (normals, one plane of a pass turned over), per place and swept side (direct light,
/// what a pass gathers; and sums over replicates), and per place and stored side (their spread, while it is written).
const PLACED: u64 = 8;
const PLACED_SIDE: u64 = 18;
const SUMMED_SIDE: u64 = 6;
const SPREAD_SIDE: u64 = 3;
/// Per place and swept side while luminaires' lines are followed, besides what these see.
const DIRECT_SIDE: u64 = 8;
/// Per place and swept side while light settles, before there are such sums: what lines read a pass before, in a
/// checkpoint.
const BEFORE_SIDE: u64 = 6;
/// The same where the level of light may be corrected: what few directions lack, here and in a checkpoint.
const LEVEL_SIDE: u64 = 12;

/// Bytes per place and side that its checkpoint holds while a replicate is under way, besides the sums; and per stored
/// side, when all are done.
const KEPT_SIDE: u64 = 12;
const DONE_SIDE: u64 = 15;

/// Bytes per fitted point: seven vectors of conjugate gradients, its number, and its error before.
const FITTED: u64 = 108;

/// Bytes that writing holds at most: two batches of packed blocks, and raw ones. Of points without light little is left
/// when they are packed.
const WRITER: u64 = 40 << 20;

/// What lowers the memory of a bake.
fn remedy(engine: Engine) -> &'static str {
    match engine {
        Engine::Photon => "lower --photons or --grid",
        Engine::Sweep => "lower --grid or --wall-resolution",
    }
}

/// Bytes of the photons, and of their maps, at most, and samples that are counted: more than fits any machine, and so
/// few that no sum of what they take overflows.
const MOST: f64 = (1u64 << 56) as f64;
const MOST_SAMPLES: u64 = 1 << 46;

/// Estimated peak memory of a bake, stage by stage, everything that lives then included.
#[derive(Clone, Debug, PartialEq)]
pub struct MemoryEstimate {
    /// Name and bytes of each stage.
    pub stages: Vec<(&'static str, u64)>,
}

impl MemoryEstimate {
    /// The estimate for a scene that is loaded. A few photons are traced to learn how often they land: in a closed
    /// white cavity that can be hundreds of times.
    ///
    /// # Errors
    /// `Invalid` if the grid has too many points; `Embree`.
    pub fn new(scene: &Scene, volumes: &[&Volume], settings: &BakeSettings, device: &Device) -> Result<Self> {
        Ok(Parts::new(scene, volumes, settings, device)?.estimate(settings.bands))
    }

    /// The least number of bands whose estimate is at most `most` bytes, and that estimate; as many bands as `settings`
    /// ask for at least. If none fits, the least estimate there is.
    ///
    /// # Errors
    /// As [`MemoryEstimate::new`].
    pub fn within(
        most: u64,
        scene: &Scene,
        volumes: &[&Volume],
        settings: &BakeSettings,
        device: &Device,
    ) -> Result<(usize, Self)> {
        let parts = Parts::new(scene, volumes, settings, device)?;
        // A sweep's lines serve all isovalues at once.
        let counts = match settings.engine {
            Engine::Photon => settings.bands..=MOST_BANDS.max(settings.bands),
            Engine::Sweep => 1..=1,
        };
        let (mut bands, mut least) = (settings.bands, parts.estimate(settings.bands));
        for count in counts {
            let estimate = parts.estimate(count);
            if estimate.peak() <= most {
                return Ok((count, estimate));
            }
            if estimate.peak() < least.peak() {
                (bands, least) = (count, estimate);
            }
        }
        Ok((bands, least))
    }

    /// The largest stage.
    pub fn peak(&self) -> u64 {
        self.stages.iter().map(|s| s.1).max().unwrap_or(0)
    }

    /// Refuses a bake that needs several times what this machine has, if that is known. What is announced may never be
    /// touched, so that somewhat more is no reason.
    ///
    /// # Errors
    /// `Invalid` with both.
    pub fn check_machine(&self, engine: Engine) -> Result<()> {
        match machine_memory() {
            Some(there) if self.peak() / BEYOND > there => Err(Error::Invalid(format!(
                "the bake is estimated at {self}; this machine has {}; {}",
                size(there),
                remedy(engine)
            ))),
            _ => Ok(()),
        }
    }

    /// Refuses a bake by `engine` in so many bands that needs more than `most` bytes.
    ///
    /// # Errors
    /// `Invalid` with the estimate and what would lower it.
    pub fn check(&self, most: u64, engine: Engine, bands: usize) -> Result<()> {
        if self.peak() <= most {
            return Ok(());
        }
        let cut = if bands > 1 { format!(", cut into {bands} bands,") } else { String::new() };
        let remedy = remedy(engine);
        Err(Error::Invalid(format!(
            "--max-memory {}: the bake{cut} is estimated at {self}; {remedy}, or allow more",
            limit(most)
        )))
    }
}

/// Such a multiple of the machine's memory is too much.
const BEYOND: u64 = 4;

/// Memory and swap of this machine, bytes, where the system tells.
fn machine_memory() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let of = |key: &str| {
        let rest = text.lines().find_map(|l| l.strip_prefix(key))?;
        rest.trim_start_matches(':').split_whitespace().next()?.parse::<u64>().ok()?.checked_mul(1024)
    };
    Some(of("MemTotal")? + of("SwapTotal").unwrap_or(0))
}

/// What an estimate is made of: bytes, but where it says counts.
struct Parts {
    engine: Engine,
    /// The program, volumes, fields, pyramids and masks.
    base: u64,
    flats: u64,
    /// Photons as traced; maps of both sides.
    photons: u64,
    maps: u64,
    /// Sides that the radiance cache holds; 0 without gather.
    cached: u64,
    levels: Levels,
    /// Counts: nodes of the volumes, of them those of the cache; points of the grids.
    voxels: u64,
    points: u64,
    /// These grids, and what is kept of gathers to be smoothed.
    grids: u64,
    halves: u64,
    /// Smoothing's slices.
    slices: u64,
    /// Counts: places beside points, and points with such.
    beside: u64,
    filled: u64,
    /// What each place is fitted to.
    fitted: u64,
    /// Samples of all sides.
    samples: u64,
    /// Scattered samples and their interpolation.
    scattered: u64,
    scattering: u64,
    /// The sweep engine's own, and what is left of it while rays are cast.
    swept: u64,
    gathered: u64,
    export: u64,
}

/// What the fields of a scene hold, all together. Counts, but where it says bytes.
#[derive(Default)]
struct Census {
    /// Bytes of volumes, fields, pyramids and masks.
    held: u64,
    /// Nodes of the volumes.
    voxels: u64,
    /// Points of the grids, these for each stored side, those that hold light, and those that others around stand for.
    points: u64,
    side_points: u64,
    shown: u64,
    filled: u64,
    /// Sides that any field stores.
    stored: u64,
    /// Samples of a side.
    samples: u64,
    /// Bytes of what smoothing keeps of gathers, and of its slices.
    halves: u64,
    slices: u64,
    /// Of sweeps: places of nodes that they light, nodes that rays look at afterwards, bytes of what lines of
    /// luminaires see and of what a thread needs for its lines.
    places: u64,
    known: u64,
    seen: u64,
    workspace: u64,
}

impl Census {
    /// Counts a field, of whose own lattice `masks` tells the nodes: a finer grid needs about the same share of its
    /// points.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "an estimate of positive numbers")]
    fn add(
        &mut self,
        scene: &Scene,
        (member, volume): (&Member, &Volume),
        masks: &[Mask],
        settings: &BakeSettings,
    ) -> Result<()> {
        let field = &member.field;
        let lattice = settings.grid.lattice(field.lattice())?;
        let (voxels, points) = (field.lattice().len() as u64, lattice.len() as u64);
        let of_grid = |nodes: usize| (nodes as f64 / voxels as f64 * points as f64) as u64;
        let beyond = settings.engine == Engine::Sweep || settings.gather_rays > 0;
        let own_light = own_light(field, field.lattice(), masks, beyond);
        let lit: Vec<bool> = (0..masks.len()).into_par_iter().with_min_len(1 << 12).map(own_light).collect();
        let own = of_grid(lit.par_iter().filter(|lit| **lit).count());
        let shown = of_grid(masks.par_iter().filter(|mask| **mask != Mask::Empty).count());
        let filled = shown - own;
        if settings.engine == Engine::Sweep {
            self.places += of_grid(sweep::places(field.lattice().dims(), &lit));
            self.seen = sweep::seen(scene, &lattice).max(self.seen);
            self.workspace = sweep::workspace(&lattice).min(MOST as u64).max(self.workspace);
            self.known += if 2 * shown > points { points } else { shown };
        }
        let sides = member.surface.stored_sides().len() as u64;
        let element = volume.samples().element_type().size() as u64;
        // Volume, field, the pyramid of min and max, the masks of volume and grid.
        self.held += voxels * (element + 4 + 1) + voxels * 33 / 16 + points;
        let samples = match (settings.strategy, settings.samples) {
            (StrategyName::Nodes, _) => own + filled * STAND_INS as u64,
            (_, Some(n)) => n,
            (_, None) => (shown as f64 * settings.samples_per_point) as u64,
        };
        self.samples = samples.saturating_add(self.samples).min(MOST_SAMPLES);
        if settings.smooths() && settings.strategy == StrategyName::Nodes {
            self.halves += own * PACKED * sides;
            let [nx, ny, nz] = lattice.dims().map(|n| n as u64);
            self.slices = self.slices.max(nx * ny * SLICES.min(nz * 112));
        }
        self.voxels += voxels;
        self.points += points;
        self.side_points += points * sides;
        self.shown += shown;
        self.filled += filled;
        self.stored = sides.max(self.stored);
        Ok(())
    }

    /// Bytes of a sweep, at most.
    fn swept(&self, scene: &Scene, settings: &BakeSettings) -> u64 {
        let Self { points, places, stored, .. } = *self;
        let sides = sweep::swept_sides(scene).len() as u64;
        let settling = BEFORE_SIDE + if sweep::bright(scene) { LEVEL_SIDE } else { 0 };
        let summed = PLACED + 2 * stored * SPREAD_SIDE + sides * (PLACED_SIDE + KEPT_SIDE);
        let indirect = sides * (points * SETTLING_SIDE + places * settling).max(places * 2 * SUMMED_SIDE);
        let direct = sides * places * DIRECT_SIDE + self.seen;
        let walls = sweep::reports(scene, settings.wall_resolution, settings.wall_isovalues) as u64;
        let threads = self.workspace.saturating_mul(rayon::current_num_threads() as u64).min(MOST as u64);
        points * SWEPT + sides * points * SWEPT_SIDE + places * summed + indirect.max(direct) + walls + threads
    }

    /// Bytes of scattered samples, and of their interpolation.
    fn scattered(&self, settings: &BakeSettings) -> [u64; 2] {
        if settings.strategy == StrategyName::Nodes || settings.engine == Engine::Sweep {
            return [0; 2];
        }
        let looked_at = match settings.interpolation {
            Interpolation::Shepard => self.samples * SHEPARD,
            // The samples' errors are blended, too.
            Interpolation::Fit => self.samples * (SHEPARD + SAMPLE) + self.points * (FITTED + 12),
            Interpolation::Irradiance => self.samples * CACHING,
        };
        [self.samples * self.stored * SAMPLE, self.samples * SAMPLE + looked_at + self.points * GRID]
    }
}

impl Parts {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "an estimate of positive numbers")]
    fn new(scene: &Scene, volumes: &[&Volume], settings: &BakeSettings, device: &Device) -> Result<Self> {
        let mut census = Census::default();
        let members = scene.members();
        let mut all_masks = Vec::new();
        for (member, volume) in members.iter().zip(volumes) {
            let masks = masks(&member.field, member.field.lattice());
            census.add(scene, (member, volume), &masks, settings)?;
            all_masks.push(masks);
        }
        let photon = settings.engine == Engine::Photon;
        let nodes = settings.strategy == StrategyName::Nodes || !photon;
        let steps = if photon { REACH } else { 0 };
        let levels = Levels::new(members.iter().zip(&all_masks).map(|(m, masks)| (&*m.field, &masks[..])), steps);
        let texels = if photon { flat::texels } else { sweep::texels };
        let texels = texels(scene, settings.wall_resolution, settings.wall_isovalues) as u64;
        let [landings, lower, higher] = if photon { landings(scene, settings, device)? } else { [0.0; 3] };
        let largest = size_of::<SurfacePhoton>().max(size_of::<FlatPhoton>()) as f64;
        let [scattered, scattering] = census.scattered(settings);
        let Census { voxels, points, side_points, shown, filled, stored, places, known, .. } = census;
        Ok(Self {
            engine: settings.engine,
            base: PROGRAM + census.held,
            // For gathers and for pictures, from outside solids and maybe from within.
            flats: texels * if photon { 48 } else { 24 },
            photons: (landings * largest).min(MOST) as u64,
            maps: ((lower + higher) * MAP).min(MOST) as u64,
            cached: if photon && settings.gather_rays > 0 { 2 } else { 0 },
            levels,
            voxels,
            points,
            grids: side_points * (GRID + if settings.split { SPLIT } else { 0 }),
            fitted: if settings.split { 3 * FITTED_SAMPLE } else { FITTED_SAMPLE },
            gathered: stored * (known * CACHED + places * DONE_SIDE) + known * CACHED,
            halves: census.halves,
            slices: census.slices,
            beside: if nodes { STAND_INS as u64 * filled } else { 0 },
            filled,
            samples: census.samples * stored,
            scattered,
            scattering,
            swept: census.swept(scene, settings),
            export: WRITER.min((points + shown) * (5 + 29 * stored)),
        })
    }

    fn estimate(&self, count: usize) -> MemoryEstimate {
        let bands = self.levels.bands(count);
        let needed: Vec<u64> = bands.iter().map(|&b| self.levels.needed(b)).collect();
        // Of a whole sweep most nodes are stored as a rule, and one side is there twice while it is sharpened. Bands
        // keep both; where they meet, a side of either is there.
        let most = |n: &[u64]| 2 * self.cached * n[0].max(n[1]) + n[0].min(n[1]);
        let stored = match needed[..] {
            [one] => (self.cached + self.cached.min(1)) * if 2 * one > self.voxels { self.voxels } else { one },
            _ => needed.windows(2).map(most).max().unwrap_or(0),
        };
        let cache = 12 * if self.cached > 0 { stored } else { 0 };
        let sets = 4 * NodeSet::bytes(self.voxels) + NodeSet::bytes(2 * self.points);
        let Self { base, flats, photons, maps, grids, halves, beside, .. } = *self;
        let fitting = beside * (self.fitted + SORTED) + self.filled * FITTED;
        let light = base + flats + grids + beside * (PLACE + BESIDE);
        let bands = bands.len() as u64;
        let waiting = checkpoint::MOST_WAITING as u64;
        let written = self.samples * RadianceSample::SAVED as u64 + self.cached * 12 * self.levels.needed(Band::WHOLE);
        let stages = match self.engine {
            Engine::Photon => vec![
                ("photons", base + photons * 9 / 8),
                ("walls", base + photons + maps + (maps / 50 * 8) + flats * 3),
                (
                    "light",
                    light
                        + maps
                        + halves
                        + cache
                        + sets
                        + beside / bands * SAMPLE
                        + self.scattered
                        + waiting.min(written),
                ),
                ("interpolate", light + (halves + self.slices).max(fitting).max(self.scattered + self.scattering)),
            ],
            Engine::Sweep => vec![
                ("sweep", base + self.swept + flats * 4),
                // What rays gather, which points are lit, and the sweep's light that waits to be written.
                ("samples", light + self.points + self.gathered + beside * SAMPLE + fitting),
            ],
        };
        let export = ("export", base + grids + flats + self.export);
        MemoryEstimate { stages: stages.into_iter().chain([export]).collect() }
    }
}

/// Landings to be expected of all photons, and those in the photon maps of the lower and the higher side: on level
/// sets, first landings left out.
fn landings(scene: &Scene, settings: &BakeSettings, device: &Device) -> Result<[f64; 3]> {
    let tracer = GraphTracer::new(device, scene)?;
    let pilot = PhotonSettings { count: PILOTS.min(settings.photons), ..settings.emission(IsovalueAxis::EVEN) };
    let pilots = trace_photons(scene, &tracer, &pilot, &|_| true);
    let each = settings.photons as f64 / pilots.emitted.max(1) as f64;
    let of = |side: Side| pilots.surface.iter().filter(|p| p.side == side && p.bounces > 0).count() as f64 * each;
    Ok([pilots.stored() as f64 * each, of(Side::Lower), of(Side::Higher)])
}

/// Bytes as --max-memory reads them: in its largest unit of which they are a short number without a remainder.
fn limit(bytes: u64) -> String {
    let tenths = 10 * u128::from(bytes);
    let in_unit = |(shift, unit): (u32, &str)| {
        let short = (10..100_000).contains(&(tenths >> shift)) && tenths.trailing_zeros() >= shift;
        short.then(|| format!("{}{unit}", (tenths >> shift) as f64 / 10.0))
    };
    [(40, "T"), (30, "G"), (20, "M"), (10, "K")].into_iter().find_map(in_unit).unwrap_or_else(|| bytes.to_string())
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bake::BakeOptions;
    use crate::field::{Field, Sweep};
    use crate::scene::{Boundary, Surface, cornell_box};
    use crate::volume::generate::Generator;

    #[test]
    fn estimates_of_too_much_are_large_however_much_it_is() {
        let bumps = Generator::from_name("bumps").unwrap().sample([8; 3]).unwrap();
        let field = Field::new(&bumps, Sweep::new(3.6, 95.0).unwrap()).unwrap();
        let walls = cornell_box(field.lattice(), 0.0).unwrap();
        let scene = Scene::new(field, Surface::default(), Boundary::Open, walls).unwrap();
        let device = Device::new(1).unwrap();
        let options = BakeOptions { strategy: Some(StrategyName::Uniform), ..BakeOptions::default() };
        let of = |photons: Option<u64>, samples: Option<u64>, interpolation| {
            let mut settings = BakeSettings::with_engine(&options, Engine::Photon).unwrap();
            settings.photons = photons.unwrap_or(1000);
            (settings.samples, settings.interpolation) = (samples.or(Some(1000)), interpolation);
            MemoryEstimate::new(&scene, &[&bumps], &settings, &device).unwrap().peak()
        };
        for interpolation in [Interpolation::Shepard, Interpolation::Fit, Interpolation::Irradiance] {
            let little = of(None, None, interpolation);
            assert!(little < 1 << 30, "{little}");
            for most in [1 << 40, 1 << 62, u64::MAX] {
                let [photons, samples] = [of(Some(most), None, interpolation), of(None, Some(most), interpolation)];
                assert!(photons > 1 << 40 && samples > 1 << 40, "{most}: {photons} {samples}");
            }
        }
    }
}
