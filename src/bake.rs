//! The main job: from a scene to its illumination grid, by either engine, with counts and seconds.

mod bands;
mod grid_points;
mod beside;
mod contacts;
mod memory;
mod photon_engine;
mod preset;
mod settings;
mod sweep_engine;
mod time;

pub use memory::MemoryEstimate;
pub use preset::Preset;
pub use settings::{BakeOptions, BakeSettings, Engine, Interpolation, MOST_BANDS, StrategyName};
pub(crate) use settings::{common_size, whole_number};
pub use time::TimeEstimate;

use crate::checkpoint::{Checkpoint, Saved};
use crate::embree::Device;
use crate::error::{Error, Result};
use crate::field::Field;
use crate::flat::FlatLight;
use crate::flattened::Side;
use crate::illumination_grid::{GridSize, IlluminationGrid};
use crate::isa::Isa;
use crate::mask::{Mask, masks, stand_ins, unknown_share};
use crate::photon::check_power;
use crate::progress::{Clock, Progress};
use crate::radiance::Counts;
use crate::scene::{Policy, Scene};
use crate::sweep;
use crate::volume::Lattice;
use photon_engine::Job;
use rayon::prelude::*;
use serde::Serialize;

/// Wall seconds per stage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
#[allow(missing_docs, reason = "the names of the stages")]
pub struct Seconds {
    pub load: f64,
    pub build: f64,
    pub photons: f64,
    pub cache: f64,
    pub sweep: f64,
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
    /// Seconds that all threads together worked, NaN where the system does not tell.
    pub processor_seconds: Seconds,
    /// Bands of isovalues that were baked one after another: at most as many as the settings ask for.
    pub bands: usize,
    /// Exact rays traced.
    pub rays: u64,
    /// Gather and visibility queries answered by sweeps.
    pub sweep_queries: u64,
    /// Bounces of sweeps, 0 by photons.
    pub sweep_bounces: usize,
    /// The share of all indirect light, up to 1, that further bounces of sweeps would bring or take, as far as that is
    /// known; NaN where it is not.
    pub unsettled: f64,
    /// Blocks of work that earlier runs had finished: rays and counts are of all, seconds and instruction set of this.
    pub resumed_blocks: usize,
    /// Rays and queries per second of the stages that trace them, NaN of a bake that was resumed.
    pub rays_per_second: f64,
    /// Photons.
    pub photons: PhotonCounts,
    /// Radiance samples, all sides.
    pub samples: u64,
    /// Samples left out because ∇h vanishes.
    pub samples_without_gradient: u64,
    /// Grid points without radiance of their own: outside the sweep, without gradient, or not finite.
    pub masked: u64,
    /// Those of them that hold light all the same: of their own level set closely outside the sweep, else fitted to
    /// samples nearby.
    pub filled: u64,
    /// Gather rays that landed where the cache held nothing: those of points just outside the sweep, far off what is in
    /// it.
    pub misses: u64,
    /// Grid points whose radiance or standard error was not finite, set to 0 and masked.
    pub non_finite: u64,
    /// Samples of the volume that are not finite.
    pub non_finite_voxels: u64,
    /// Threads.
    pub threads: usize,
    /// Instruction set of the vector kernels, one of [`Isa::NAMES`].
    pub isa: &'static str,
    /// Seed.
    pub seed: u64,
    /// Embree's version.
    pub embree: String,
    /// Commit of the program.
    pub commit: &'static str,
    /// Points of the illumination grid.
    pub grid: [usize; 3],
    /// Digest of what determines the bits.
    pub job: String,
    /// Settings.
    pub settings: BakeSettings,
}

/// A finished bake.
#[derive(Clone, Debug)]
pub struct Bake {
    /// The grid's lattice.
    pub lattice: Lattice,
    /// One grid per stored side, the outside first.
    pub sides: Vec<(Side, IlluminationGrid)>,
    /// Radiance of polygons and caps over (u, v, isovalue), by flat number; seen from within solids where that is
    /// stored and differs.
    pub flats: Vec<Option<FlatLight>>,
    /// Display exposure: rgb = radiance × exposure, then clamped and sRGB-encoded.
    pub exposure: f64,
    /// Counts and seconds. `load`, `export` and `total` are for the caller to fill.
    pub report: BakeReport,
}

/// What an engine gave.
#[derive(Default)]
struct Lit {
    /// The stored sides of each field.
    fields: Vec<Vec<(Side, IlluminationGrid)>>,
    flats: Vec<Option<FlatLight>>,
    seconds: Seconds,
    processor_seconds: Seconds,
    bands: usize,
    counts: Counts,
    sweep_queries: u64,
    sweep_bounces: usize,
    unsettled: f64,
    photons: PhotonCounts,
}

impl Lit {
    /// Adds the seconds of a clock to those of a stage.
    fn spend(&mut self, clock: Clock, stage: fn(&mut Seconds) -> &mut f64) {
        let [wall, processor] = clock.seconds();
        *stage(&mut self.seconds) += wall;
        *stage(&mut self.processor_seconds) += processor;
    }
}

/// What an engine works with, whatever it lights.
#[derive(Clone, Copy)]
struct Context<'a> {
    settings: &'a BakeSettings,
    device: &'a Device,
    progress: Progress<'a>,
    checkpoint: Option<&'a Checkpoint>,
}

impl<'a> Context<'a> {
    /// What is saved of `kept` of field `number`: a stage for each side.
    fn saved(&self, number: u32, kept: Kept) -> [Saved<'a>; 2] {
        let first = STAGES * number + 2 * kept as u32;
        [first, first + 1].map(|n| self.checkpoint.map_or(Saved::NOWHERE, |c| c.stage(n)))
    }
}

/// What a checkpoint keeps of a field.
#[derive(Clone, Copy)]
enum Kept {
    /// The radiance cache; of a sweep, in the first of its two stages, all.
    Cache,
    /// Light at the grid's points, or at scattered samples.
    Points,
    /// Light at places beside points.
    Beside,
}

/// Stages of a checkpoint that a field has.
const STAGES: u32 = 6;

/// Illuminates every isosurface of the sweep.
///
/// # Errors
/// `Invalid` if no level set of the sweep has a gradient anywhere, and for values of settings, surfaces and polygons
/// out of range, `NotSupported` for a scene the engine cannot light, `Embree`, or `Interrupted`.
pub fn bake(scene: &Scene, settings: &BakeSettings, device: &Device, progress: Progress) -> Result<Bake> {
    bake_fields(scene, settings, device, progress, None)?
        .into_iter()
        .next()
        .ok_or_else(|| Error::Invalid("the scene holds no field".into()))
}

/// As [`bake`], for each field of a scene by number. Fields that light each other share photons, walls and counts; the
/// reports differ in what belongs to a grid. Finished blocks of the long stages (radiance cache, radiance samples,
/// passes of sweeps) are kept in `checkpoint`, and what a run of the same [`job`] finished is taken from there: with
/// the same bits, counts included.
///
/// # Errors
/// As [`bake`]; `NotSupported` for several fields that light each other by the sweep engine.
pub fn bake_fields(
    scene: &Scene,
    settings: &BakeSettings,
    device: &Device,
    progress: Progress,
    checkpoint: Option<&Checkpoint>,
) -> Result<Vec<Bake>> {
    settings.check()?;
    scene.check()?;
    supported(scene, settings)?;
    let digest = digest(&job(scene, settings, &device.version()));
    let resumed_blocks = checkpoint.map_or(0, Checkpoint::blocks);
    let job = |number: u32| -> Result<Job> {
        let scene = scene.lit(number as usize);
        let lattice = grid_of(&scene, settings)?;
        let masks = masks_of(&scene, &lattice)?;
        Ok(Job { number, scene, lattice, masks })
    };
    let jobs = (0..).take(scene.fields()).map(job).collect::<Result<Vec<_>>>()?;
    let groups: Vec<&[Job]> = match scene.policy() {
        Policy::Joint => vec![&jobs],
        Policy::Independent => jobs.chunks(1).collect(),
    };
    let mut bakes = Vec::new();
    let context = Context { settings, device, progress, checkpoint };
    for group in groups {
        let lit = match settings.engine {
            Engine::Photon => photon_engine::light(group, context)?,
            Engine::Sweep => sweep_engine::light(&group[0], context)?,
        };
        bakes.extend(finish(group, lit, scene.exposure(), &digest, context)?);
    }
    if resumed_blocks > 0 {
        for Bake { report, .. } in &mut bakes {
            (report.resumed_blocks, report.rays_per_second) = (resumed_blocks, f64::NAN);
        }
    }
    Ok(bakes)
}

/// An error of one of several volumes, by name.
fn named(scene: &Scene, e: Error) -> Error {
    if scene.name.is_empty() { e } else { e.in_file(format!("volume '{}'", scene.name)) }
}

fn grid_of(scene: &Scene, settings: &BakeSettings) -> Result<Lattice> {
    settings.grid.lattice(scene.lattice()).map_err(|e| named(scene, e))
}

/// The masks of a grid's lattice, some of which holds something.
fn masks_of(scene: &Scene, grid: &Lattice) -> Result<Vec<Mask>> {
    let masks = masks(&scene.field, grid);
    if nothing_in(&masks) { Err(named(scene, Error::Invalid(nothing_found(scene, grid)))) } else { Ok(masks) }
}

fn nothing_in(masks: &[Mask]) -> bool {
    masks.iter().all(|&m| m == Mask::Empty)
}

/// Why no point of a grid's lattice holds anything.
fn nothing_found(scene: &Scene, grid: &Lattice) -> String {
    // Finer lattices hold the volume's own points, or some within each of its cells.
    if grid == scene.lattice() || nothing_in(&masks(&scene.field, scene.lattice())) {
        return "no isosurface of the sweep has a gradient anywhere: the volume is constant there; choose other \
                isovalues"
            .into();
    }
    let [nx, ny, nz] = grid.dims();
    format!(
        "no isosurface of the sweep passes near a point of the grid: {nx}×{ny}×{nz} is too coarse for this volume; \
         refine --grid"
    )
}

/// Why no place near the points of a grid is on an isosurface.
fn too_thin() -> Error {
    let why = "no grid point lies on or beside an isosurface of the sweep: its values are too close together for this \
               volume; widen --isovalues, or refine --grid";
    Error::Invalid(why.into())
}

/// Whether a grid finds places on the sweep's isosurfaces: not if f32 tells too few apart within so thin a sweep.
fn has_places(field: &Field, grid: &Lattice, seed: u64) -> bool {
    if field.samples().par_iter().any(|h| (0.0..=1.0).contains(h)) {
        return true;
    }
    let masks = masks(field, grid);
    let place = |o: usize| stand_ins::<1>(field, grid, o, seed)[0].is_some();
    (0..masks.len()).into_par_iter().any(|o| masks[o] != Mask::Empty && place(o))
}

/// Whether the engine can light the scene, and the grid can hold its light.
///
/// # Errors
/// `NotSupported` as [`sweep::supported`]; `Invalid` as [`check_power`], for a grid so coarse that no isosurface passes
/// near its points, and for a sweep so thin that none of its isosurfaces has a place.
pub fn supported(scene: &Scene, settings: &BakeSettings) -> Result<()> {
    match settings.engine {
        Engine::Sweep => can_sweep(scene)?,
        Engine::Photon => check_power(scene, settings.photons)?,
    }
    // Grids as fine as the volume hold what it holds, and are looked at when their light is computed.
    (0..scene.fields()).try_for_each(|number| {
        let scene = scene.lit(number);
        let lattice = grid_of(&scene, settings)?;
        let coarse = lattice.len() < scene.lattice().len();
        let places = has_places(&scene.field, &lattice, settings.seed);
        if coarse || !places {
            masks_of(&scene, &lattice)?;
        }
        if places { Ok(()) } else { Err(named(&scene, too_thin())) }
    })
}

/// Whether sweeps can light the scene, all its fields.
fn can_sweep(scene: &Scene) -> Result<()> {
    match scene.policy() {
        Policy::Joint => sweep::supported(scene),
        Policy::Independent => (0..scene.fields()).try_for_each(|n| sweep::supported(&scene.lit(n))),
    }
}

/// What sweeps may not know of the points that surfaces need. Real volumes have 0.1 % at most, binary ones all.
const UNKNOWN: f64 = 0.05;

/// The share of the points that surfaces need where sweeps leave out what is reflected, because samples jump over the
/// whole sweep there, as in binary volumes; `None` if that is none to speak of.
///
/// # Errors
/// `Invalid` if the grid has too many points.
pub fn left_out(scene: &Scene, grid: &GridSize) -> Result<Option<f64>> {
    let mut most = 0.0f64;
    for member in scene.members() {
        let field = &member.field;
        let grid = grid.lattice(field.lattice())?;
        let share = unknown_share(field, field.lattice());
        // What a volume's own points know finer grids know, too.
        let known = grid == *field.lattice() || (share <= UNKNOWN && grid.len() > field.lattice().len());
        most = most.max(if known { share } else { unknown_share(field, &grid) });
    }
    Ok((most > UNKNOWN).then_some(most))
}

/// Bakes with their reports from what an engine gave.
fn finish(
    jobs: &[Job],
    mut lit: Lit,
    exposure: f64,
    digest: &str,
    Context { settings, device, .. }: Context,
) -> Result<Vec<Bake>> {
    let s = lit.seconds;
    let fields = std::mem::take(&mut lit.fields);
    let bake = |(job, mut sides): (&Job, Vec<(Side, IlluminationGrid)>)| {
        if sides.iter().all(|(_, grid)| nothing_in(&grid.mask)) {
            return Err(too_thin());
        }
        let non_finite = sides.iter_mut().map(|(_, grid)| grid.clear_non_finite()).sum::<u64>();
        let count = |m: Mask| sides[0].1.mask.par_iter().filter(|&&x| x == m).count() as u64;
        let (empty, filled) = (count(Mask::Empty), count(Mask::Filled));
        let report = BakeReport {
            seconds: s,
            processor_seconds: lit.processor_seconds,
            bands: lit.bands,
            rays: lit.counts.rays,
            sweep_queries: lit.sweep_queries,
            sweep_bounces: lit.sweep_bounces,
            unsettled: lit.unsettled,
            resumed_blocks: 0,
            rays_per_second: (lit.counts.rays + lit.sweep_queries) as f64 / (s.photons + s.cache + s.sweep + s.samples),
            photons: lit.photons,
            samples: lit.counts.samples,
            samples_without_gradient: lit.counts.without_gradient,
            masked: empty + filled,
            filled,
            misses: lit.counts.misses,
            non_finite,
            non_finite_voxels: job.scene.field.samples().par_iter().filter(|s| !s.is_finite()).count() as u64,
            threads: rayon::current_num_threads(),
            isa: Isa::current().name(),
            seed: settings.seed,
            embree: device.version(),
            commit: env!("ISOLUME_COMMIT"),
            grid: job.lattice.dims(),
            job: digest.to_owned(),
            settings: settings.clone(),
        };
        // Each bake stands for itself: walls, and the caps of its own field.
        let walls = job.scene.polygons().len();
        let caps = walls + 6 * job.scene.number();
        let flats = lit.flats[..walls].iter().chain(&lit.flats[caps..caps + 6]).cloned().collect();
        Ok(Bake { lattice: job.lattice.clone(), sides, flats, exposure, report })
    };
    jobs.iter().zip(fields).map(bake).collect()
}

/// A [`job`] in eight letters.
pub fn digest(job: &str) -> String {
    let mut crc = flate2::Crc::new();
    crc.update(job.as_bytes());
    format!("{:08x}", crc.sum())
}

/// What determines a bake's bits, as lines of `key: value`: for [`Checkpoint::new`]. `embree` is the version of the
/// library that is loaded ([`Device::version`]): others round otherwise.
pub fn job(scene: &Scene, settings: &BakeSettings, embree: &str) -> String {
    let (version, commit) = (env!("CARGO_PKG_VERSION"), env!("ISOLUME_COMMIT"));
    format!("version: {version} ({commit})\nembree: {embree}\n") + &settings_job(settings) + &scene_job(scene)
}

/// The part of a [`job`] that settings determine.
pub(crate) fn settings_job(settings: &BakeSettings) -> String {
    let mut text = String::new();
    let mut add = |key: &str, value: String| text.push_str(&format!("{key}: {value}\n"));
    if let Ok(serde_json::Value::Object(settings)) = serde_json::to_value(settings) {
        settings.iter().for_each(|(key, value)| add(key, value.to_string()));
    }
    text
}

/// The part of a [`job`] that the scene determines, with all its volumes' samples.
pub(crate) fn scene_job(scene: &Scene) -> String {
    let mut text = String::new();
    let mut add = |key: &str, value: String| text.push_str(&format!("{key}: {value}\n"));
    add("policy", format!("{:?}", scene.policy()));
    for member in scene.members() {
        let lattice = member.field.lattice();
        add("volume", member.name);
        add("lattice", format!("{:?} {:?} {:?}", lattice.dims(), lattice.origin(), lattice.axes()));
        add("isovalues", member.field.sweep().to_string());
        let mut crc = flate2::Crc::new();
        let part = |samples: &[f32]| {
            let mut crc = flate2::Crc::new();
            let bytes = |s: &[f32]| s.iter().flat_map(|s| s.to_le_bytes()).collect::<Vec<u8>>();
            samples.chunks(1 << 12).for_each(|s| crc.update(&bytes(s)));
            crc
        };
        let parts: Vec<flate2::Crc> = member.field.samples().par_chunks(1 << 18).map(part).collect();
        parts.iter().for_each(|part| crc.combine(part));
        add("samples' checksum", format!("{:08x}", crc.sum()));
        add("surface", format!("{:?}", member.surface));
        add("boundary", format!("{:?}", member.boundary));
    }
    for p in scene.polygons() {
        add(&format!("polygon '{}'", p.name), format!("{:?} {} {}", p.vertices(), p.albedo, p.emission));
    }
    text
}
