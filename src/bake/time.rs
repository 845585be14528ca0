//! How long a bake takes, before it takes it.

use super::{BakeSettings, Engine, StrategyName};
use crate::direct::{Receiver, direct_irradiance};
use crate::embree::{Device, GraphTracer, pyramids};
use crate::error::Result;
use crate::flat::{self, FlatLight, FlatTexture, Within};
use crate::illumination_grid::GridSize;
use crate::isovalue_axis::IsovalueAxis;
use crate::mask::{Mask, masks};
use crate::nearest::Neighbours;
use crate::node_set::NodeSet;
use crate::photon::{PhotonSettings, Photons, trace_photons};
use crate::photon_map::PhotonMap;
use crate::progress::{interrupted, unless_interrupted};
use crate::radiance::{Indirect, Sampler};
use crate::radiance_cache::{CacheSettings, RadianceCache};
use crate::rng::Stage;
use crate::sampling::{Strategy, positions_at_hand};
use crate::scene::Scene;
use crate::sweep::{self, SweepSettings};
use glam::DVec3;
use rayon::prelude::*;
use std::hint::black_box;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

/// Photons and samples tried: a second or so. Where these take more than so many rays in all samples are fewer, but no
/// fewer than the least.
const PHOTONS: u64 = 1 << 15;
const SAMPLES: u64 = 1 << 12;
const RAYS: u64 = 1 << 21;
const LEAST_SAMPLES: u64 = 1 << 6;

/// Directions and replicates that a sweep is tried with. The second one tells what a pass takes besides its directions,
/// and what walls take when their memory is no longer new.
const DIRECTIONS: usize = 16;
const REPLICATES: usize = 2;

/// A trial is repeated up to so many times while that takes no more than this many seconds.
const MOST_TRIES: usize = 5;
const SHORT: f64 = 0.2;
/// One that takes more than so many seconds is cut off: thousands of luminaires light every texel.
const LONG: f64 = 10.0;

/// Luminaire points that a sweep is tried with, and the fewest of each luminaire. Walls look at sixteen of one
/// together.
const LIGHT_POINTS: usize = 16;
const FEWEST_POINTS: usize = 4;

/// Lattices of more points than this are tried on a coarse copy of the field.
const MOST_POINTS: f64 = (1u64 << 21) as f64;

/// A sweep is tried with at most about this many texels, of 100 bytes: the walls of the standard preset.
const MOST_TEXELS: f64 = (1u64 << 20) as f64;

/// Photons' walls are tried with at most about this many texels, and with no fewer across than this.
const MOST_SHADOWED: f64 = (1u64 << 16) as f64;
const LEAST_ACROSS: usize = 8;

/// Estimated wall seconds of a bake, stage by stage, on as many threads as it will have.
#[derive(Clone, Debug, PartialEq)]
pub struct TimeEstimate {
    /// Name and seconds of each stage.
    pub stages: Vec<(&'static str, f64)>,
}

impl TimeEstimate {
    /// Does a small part of each stage and scales it up: right within a factor of about 2 on a machine that stays as
    /// busy as it is, if light settles after as many bounces of a sweep as it does as a rule. Interpolation of
    /// scattered samples, rays beside the ends of a sweep and export are left out.
    ///
    /// # Errors
    /// `Invalid` if the grid has too many points; `NotSupported` as [`sweep::sweep`]; `Embree`; `Interrupted`.
    pub fn new(scene: &Scene, settings: &BakeSettings, device: &Device) -> Result<Self> {
        match settings.engine {
            Engine::Sweep => Self::of_sweeps(scene, settings),
            Engine::Photon => Self::of_photons(scene, settings, device),
        }
    }

    fn of_sweeps(scene: &Scene, settings: &BakeSettings) -> Result<Self> {
        let mut all = 0.0;
        for number in 0..scene.fields() {
            let lit = scene.lit(number);
            let grid = settings.grid.lattice(lit.lattice())?;
            let shrink = (grid.len() as f64 / MOST_POINTS).cbrt().max(1.0);
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a part of a length")]
            let shrunk = |n: usize| ((n as f64 / shrink).round() as usize).max(2);
            let tried = GridSize::Points(grid.dims().map(shrunk)).lattice(&grid)?;
            let lit = lit.resampled(&tried);
            let pilot = |across: usize| {
                let points = (LIGHT_POINTS / lit.luminaires().len().max(1)).max(FEWEST_POINTS);
                let pilot = SweepSettings {
                    directions: settings.directions.min(DIRECTIONS),
                    light_points: settings.light_points.min(points),
                    max_bounces: 1,
                    replicates: REPLICATES,
                    flat_resolution: (across, settings.wall_isovalues),
                    ..settings.sweep()
                };
                sweep_seconds(&lit, &pilot, &settings.sweep())
            };
            // So that a wall's share of the work stays what it is.
            let walls = shrunk(settings.wall_resolution);
            let texels = |across: usize| sweep::texels(&lit, across, settings.wall_isovalues) as f64;
            let seconds = with_texels(walls, &texels, &pilot)?;
            all += seconds * grid.len() as f64 / tried.len() as f64;
        }
        Ok(Self { stages: vec![("sweep", all)] })
    }

    fn of_photons(scene: &Scene, settings: &BakeSettings, device: &Device) -> Result<Self> {
        let pyramids = pyramids(scene);
        let tracer = GraphTracer::with_pyramids(device, scene, &pyramids)?;
        let count = settings.photons.min(PHOTONS);
        let pilot = PhotonSettings { count, ..settings.emission(IsovalueAxis::EVEN) };
        let begun = Instant::now();
        let photons = trace_photons(scene, &tracer, &pilot, &|_| !interrupted());
        let all = begun.elapsed().as_secs_f64() * settings.photons as f64 / count.max(1) as f64;
        let (mut cache, mut samples) = (walls_seconds(scene, &tracer, &photons, settings), 0.0);
        for number in 0..scene.fields() {
            let seen = scene.seen_from(number);
            let tracer = GraphTracer::with_pyramids(device, &seen, &pyramids)?;
            let [nodes, sampled] = field_seconds(&seen, &tracer, &photons, settings)?;
            unless_interrupted()?;
            (cache, samples) = (cache + nodes, samples + sampled);
        }
        Ok(Self { stages: vec![("photons", all), ("cache", cache), ("samples", samples)] })
    }

    /// All stages together, seconds.
    pub fn total(&self) -> f64 {
        self.stages.iter().map(|s| s.1).sum()
    }
}

/// Seconds that `pilot` takes for walls of so many texels across, if need be from fewer: their work grows with
/// `texels`, and what half as many across take less tells how fast.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a part of a length")]
fn with_texels(walls: usize, texels: &dyn Fn(usize) -> f64, pilot: &dyn Fn(usize) -> Result<f64>) -> Result<f64> {
    let part = (MOST_TEXELS / texels(walls).max(1.0)).sqrt().min(1.0);
    let across = ((walls as f64 * part) as usize).clamp(walls.min(4), walls);
    let seconds = pilot(across)?;
    if across == walls {
        return Ok(seconds);
    }
    let fewer = across / 2;
    let per_texel = (seconds - pilot(fewer)?) / (texels(across) - texels(fewer)).max(1.0);
    // Walls take no more than all of it.
    let per_texel = per_texel.clamp(0.0, seconds / texels(across).max(1.0));
    Ok(seconds + per_texel * (texels(walls) - texels(across)))
}

/// Estimated seconds of a sweep, of which `pilot` does a small part: several times if that is short, since whatever
/// else the machine does adds to some of its parts only.
fn sweep_seconds(scene: &Scene, pilot: &SweepSettings, settings: &SweepSettings) -> Result<f64> {
    let mut parts = timed_sweep(scene, pilot)?;
    let begun = Instant::now();
    for _ in 1..MOST_TRIES {
        if begun.elapsed().as_secs_f64() + parts.total() > SHORT {
            break;
        }
        parts = parts.least(&timed_sweep(scene, pilot)?);
    }
    Ok(parts.seconds(pilot, settings))
}

/// The parts of a sweep, measured.
fn timed_sweep(scene: &Scene, pilot: &SweepSettings) -> Result<SweepParts> {
    let begun = Instant::now();
    // When luminaire points and families of lines began.
    let begins = Mutex::new([Vec::new(), Vec::new()]);
    sweep::sweep(scene, pilot, &|fraction| {
        if let Ok(mut begins) = begins.lock() {
            begins[usize::from(fraction > sweep::DIRECT_SHARE)].push(begun.elapsed().as_secs_f64());
        }
        true
    })?;
    let end = begun.elapsed().as_secs_f64();
    let [points, families] = begins.into_inner().unwrap_or_default();
    Ok(SweepParts::new(&points, &families, end))
}

/// Seconds of the parts of a sweep. Most of what walls take does not grow with directions.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct SweepParts {
    /// Once: reading the field before, and writing the result behind.
    once: f64,
    /// A replicate's luminaire points on the lattice.
    points: f64,
    /// A replicate's luminaire points on walls.
    walls: f64,
    /// A pass without its directions; what goes before the first one is about the same.
    pass: f64,
    /// The directions of a pass.
    directions: f64,
}

impl SweepParts {
    /// From when the points and the families of [`REPLICATES`] of one bounce began, and when the last one ended.
    fn new(points: &[f64], families: &[f64], end: f64) -> Self {
        let first = points.first().copied().unwrap_or(0.0);
        // From one step to the next, as a rule: what turns a lattice round, or the first steps from new memory, are
        // others.
        let step = |all: &[f64]| {
            let parts = all.chunks_exact((all.len() / REPLICATES).max(1));
            let mut steps: Vec<f64> = parts.flat_map(|part| part.windows(2).map(|w| w[1] - w[0])).collect();
            steps.sort_by(f64::total_cmp);
            steps.get(steps.len() / 2).copied().unwrap_or(0.0)
        };
        let (each, lit) = (families.len() / REPLICATES, points.len() / REPLICATES);
        if each == 0 || lit == 0 {
            return Self { once: end, ..Self::default() };
        }
        let (per_point, per_family) = (step(points), step(families));
        let directions = each as f64 * per_family;
        let pass = (families[each] - families[0] - directions).max(0.0);
        let new_walls = points[lit] - points[lit - 1] - per_point;
        let walls = (families[0] - points[points.len() - 1] - per_point - pass).max(0.0);
        let written = end - families[families.len() - 1] - per_family - pass;
        Self {
            once: first + (new_walls - walls).max(0.0) + written.max(0.0),
            points: lit as f64 * per_point,
            walls,
            pass,
            directions,
        }
    }

    /// All parts of two replicates.
    fn total(&self) -> f64 {
        self.once + REPLICATES as f64 * (self.points + self.walls + self.pass + self.directions)
    }

    /// Of each part the shorter one.
    fn least(&self, other: &Self) -> Self {
        Self {
            once: self.once.min(other.once),
            points: self.points.min(other.points),
            walls: self.walls.min(other.walls),
            pass: self.pass.min(other.pass),
            directions: self.directions.min(other.directions),
        }
    }

    /// All of a sweep, by the parts of its `pilot`.
    fn seconds(&self, pilot: &SweepSettings, settings: &SweepSettings) -> f64 {
        let ratio = |a: usize, b: usize| a as f64 / b.max(1) as f64;
        let points = ratio(settings.light_points, pilot.light_points);
        let packs = ratio(settings.light_points.max(LIGHT_POINTS), pilot.light_points.max(LIGHT_POINTS));
        let directions = ratio(settings.expected_directions(), pilot.directions);
        let replicates = settings.replicates.max(1);
        let direct = points * self.points + packs * self.walls;
        let passes = 1 + settings.expected_passes();
        self.once + replicates as f64 * direct + passes as f64 * self.pass + directions * self.directions
    }
}

/// Estimated seconds of the walls that photons light, from some of their texels: as few as photons are fewer, which
/// leaves as many to each.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a part of a length")]
fn walls_seconds(scene: &Scene, tracer: &GraphTracer<'_>, photons: &Photons, settings: &BakeSettings) -> f64 {
    let walls = settings.wall_resolution;
    let texels = |across: usize| flat::lit_texels(scene, across, settings.wall_isovalues) as f64;
    let all = texels(walls);
    let share = (photons.emitted as f64 / settings.photons.max(1) as f64).min(MOST_SHADOWED / all.max(1.0));
    let across = ((walls as f64 * share.sqrt()) as usize).clamp(walls.min(LEAST_ACROSS), walls);
    let tried = CacheSettings { flat_resolution: across, ..settings.cache(IsovalueAxis::EVEN) };
    let (begun, done) = (Instant::now(), AtomicU64::new(0));
    let seconds = || begun.elapsed().as_secs_f64();
    RadianceCache::new(scene, tracer, photons, &tried, &|n| {
        let go_on = !interrupted() && seconds() < LONG;
        done.fetch_add(if go_on { n } else { 0 }, Ordering::Relaxed);
        go_on
    });
    let done = if seconds() < LONG { texels(across) } else { done.into_inner() as f64 };
    seconds() * all / done.max(1.0)
}

/// Estimated seconds of the cache's nodes and of the samples of the scene's own field.
#[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
fn field_seconds(
    scene: &Scene,
    tracer: &GraphTracer<'_>,
    photons: &Photons,
    settings: &BakeSettings,
) -> Result<[f64; 2]> {
    let own = scene.lattice();
    let needed = masks(&scene.field, own).iter().filter(|&&m| m != Mask::Empty).count() as f64;
    let side = scene.surface.outside;
    let shadow_rays = u64::from(settings.shadow_rays) * scene.luminaires().len() as u64;
    let rays = u64::from(settings.gather_rays) + shadow_rays;
    let count = (RAYS / rays.max(1)).clamp(LEAST_SAMPLES, SAMPLES);
    let at = positions_at_hand(&scene.field, &Strategy::Uniform, count, settings.seed)?;
    let tried = at.len().max(1) as f64;
    let map = PhotonMap::new(scene, &photons.surface, side, |p| p.bounces > 0, settings.estimate());
    let begun = Instant::now();
    at.par_iter().enumerate().with_min_len(64).for_each_init(Neighbours::default, |scratch, (i, &position)| {
        let p = position.as_dvec3();
        let isovalue = scene.field.value(p) as f32;
        let Some(receiver) = Receiver::on_level_set(scene, p, isovalue, side) else { return };
        black_box(map.irradiance(&receiver, scratch));
        let key = Stage::Cache.key(settings.seed, i as u64);
        black_box(direct_irradiance(scene, tracer, &receiver, settings.cache_shadow_rays, key));
    });
    let per_node = begun.elapsed().as_secs_f64() / tried;
    // Light reaches the other side of most surfaces, too.
    let sides = if photons.surface.iter().any(|p| p.side != side) { 2.0 } else { 1.0 };
    let nodes = if settings.gather_rays > 0 { sides * needed } else { 0.0 };

    let begun = Instant::now();
    let (nowhere, dims) = (NodeSet::new(0, |_| false), scene.lattice().dims());
    // Where all that rays meet is black they end early.
    let mut shining = scene.clone();
    shining.surface.emission = DVec3::ONE;
    let white = FlatTexture { texels: vec![[1.0; 3]], ..FlatTexture::black([1; 3]) };
    let flats = vec![Some(FlatLight { outside: white, within: Within::Same }); flat::count(scene)];
    let cache = RadianceCache::from_parts([None, None], nowhere, dims, flats);
    let indirect = match settings.gather_rays {
        0 => Indirect::Map(&map),
        rays => Indirect::Gather(&cache, rays),
    };
    let (shadow_rays, seed) = (settings.shadow_rays, settings.seed);
    let sampler = Sampler { scene: &shining, tracer, indirect: &indirect, side, shadow_rays, seed };
    sampler.samples(&at, &|_| !interrupted());
    let seconds = begun.elapsed().as_secs_f64();
    // A finer grid needs about the same share of its points, and its masks may need more memory than there is.
    let points = needed * settings.grid.lattice(own)?.len() as f64 / own.len() as f64;
    let samples = match settings.strategy {
        StrategyName::Nodes => points,
        _ => settings.samples.map_or(points * settings.samples_per_point, |n| n as f64),
    };
    let per_sample = seconds / tried * scene.surface.stored_sides().len() as f64;
    Ok([per_node * nodes, per_sample * samples])
}

impl std::fmt::Display for TimeEstimate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "about {:.0} s:", self.total().max(1.0))?;
        let mut separator = " ";
        for (name, seconds) in &self.stages {
            write!(f, "{separator}{name} {seconds:.1}")?;
            separator = ", ";
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{Field, Sweep};
    use crate::scene::{Boundary, Surface, cornell_box};
    use crate::volume::generate::Generator;

    fn scene(name: &str, range: [f64; 2]) -> Scene {
        let volume = Generator::from_name(name).unwrap().sample([24; 3]).unwrap();
        let field = Field::new(&volume, Sweep::new(range[0], range[1]).unwrap()).unwrap();
        let walls = cornell_box(field.lattice(), 0.0).unwrap();
        Scene::new(field, Surface::default(), Boundary::Open, walls).unwrap()
    }

    #[test]
    fn walls_too_fine_to_be_tried_are_scaled_by_their_texels() {
        let texels = |across: usize| 200.0 * (across * across) as f64;
        let seconds = |across: usize| 3.0 + 1e-6 * texels(across);
        for walls in [2, 3, 5, 64, 72, 73, 500, 2048] {
            let tried = Mutex::new(Vec::new());
            let pilot = |across: usize| {
                tried.lock().unwrap().push(across);
                Ok(seconds(across))
            };
            let estimate = with_texels(walls, &texels, &pilot).unwrap();
            assert!((estimate / seconds(walls) - 1.0).abs() < 1e-9, "{walls}: {estimate} for {}", seconds(walls));
            let tried = tried.into_inner().unwrap();
            assert!(tried.iter().all(|&across| texels(across) <= MOST_TEXELS), "{walls}: {tried:?}");
            assert!(walls > 72 || tried == [walls], "{walls}: {tried:?}");
        }
        // Noise makes nothing of walls that take no part, and no more than all of walls that do.
        for noise in [-1.0, 1.0] {
            let pilot = |across: usize| Ok(3.0 + if across > 40 { 0.0 } else { noise });
            let estimate = with_texels(500, &texels, &pilot).unwrap();
            assert!((3.0..=3.0 * texels(500) / texels(72)).contains(&estimate), "{noise}: {estimate}");
        }
    }

    /// A pilot of known parts, on a clock of its own: a sweep of other settings is their sum.
    #[test]
    fn a_sweep_is_the_sum_of_its_parts_as_often_as_it_has_them() {
        let parts = SweepParts { once: 7.0, points: 16.0 * 0.25, walls: 3.0, pass: 2.0, directions: 8.0 * 0.5 };
        // Walls take 2 longer at first.
        let points: Vec<f64> = (0..32).map(|n| 4.0 + 0.25 * f64::from(n) + f64::from(n / 16) * 5.0).collect();
        let gather = 4.0 + 2.0 * (4.0 + 3.0) + 2.0 + 2.0;
        let families: Vec<f64> = (0..16).map(|n| gather + 0.5 * f64::from(n) + 2.0 * f64::from(n / 8)).collect();
        let pilot =
            SweepSettings { directions: 16, light_points: 16, replicates: 2, max_bounces: 1, ..Default::default() };
        let end = gather + 2.0 * (4.0 + 2.0) + 1.0;
        assert_eq!(SweepParts::new(&points, &families, end), parts);
        assert_eq!(parts.seconds(&pilot, &pilot), end);
        let more = SweepSettings { directions: 64, light_points: 32, replicates: 4, max_bounces: 3, ..pilot };
        // Four times 32 points and walls, 4 × 3 passes of four times the directions.
        let seconds = 7.0 + 4.0 * (8.0 + 6.0) + 13.0 * 2.0 + 12.0 * 4.0 * 4.0;
        assert_eq!(parts.seconds(&pilot, &more), seconds);
        // Nothing is less than nothing, whatever noise says.
        let noise = SweepParts::new(&[1.0, 2.0, 2.1, 2.2], &[2.3, 2.4, 2.4, 2.5], 2.5);
        assert!([noise.once, noise.points, noise.walls, noise.pass, noise.directions].iter().all(|&x| x >= 0.0));
        assert_eq!(SweepParts::new(&[], &[], 2.0).seconds(&pilot, &pilot), 2.0);
    }

    /// Directions along lines and back, of one side, that a sweep took.
    fn taken(scene: &Scene, settings: &SweepSettings) -> f64 {
        let counts = sweep::sweep(scene, settings, &|_| true).unwrap().counts;
        2.0 * counts.families as f64 / sweep::swept_sides(scene).len() as f64
    }

    #[test]
    fn a_sweep_takes_about_the_directions_that_its_estimate_counts() {
        let (bumps, gap) = (scene("bumps", [3.6, 95.0]), scene("two-cylinders", [0.2, 0.8]));
        for (scene, directions, replicates) in [(&bumps, 64, 4), (&bumps, 256, 1), (&gap, 128, 2)] {
            let settings = SweepSettings { directions, replicates, light_points: 2, ..SweepSettings::default() };
            let ratio = taken(scene, &settings) / settings.expected_directions() as f64;
            println!("{directions} directions, {replicates} replicates: {ratio:.2} of the expected ones");
            assert!((0.6..1.6).contains(&ratio), "{directions} directions, {replicates} replicates: {ratio}");
        }
        let fixed =
            SweepSettings { directions: 32, replicates: 2, max_bounces: 3, light_points: 2, ..Default::default() };
        assert!((taken(&bumps, &fixed) - fixed.expected_directions() as f64).abs() < 1e-9);
    }
}
