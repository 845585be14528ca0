//! BB09's engine: photons, a radiance cache, samples by exact rays, interpolation.

use super::bands::{Band, Levels, REACH};
use super::beside::{Beside, BesideLight, rays_beside};
use super::contacts::{Contacts, Wedge};
use super::grid_points::{GridPoints, PointLight};
use super::{BakeSettings, Context, Interpolation, Kept, Lit, PhotonCounts};
use crate::embree::{GraphTracer, pyramids};
use crate::error::{Error, Result};
use crate::fitted_grid::{GridFit, errors};
use crate::flat;
use crate::flattened::Side;
use crate::illumination_grid::{IlluminationGrid, shepard};
use crate::irradiance_caching::interpolate;
use crate::isovalue_axis::IsovalueAxis;
use crate::mask::Mask;
use crate::node_set::NodeSet;
use crate::photon::trace_photons;
use crate::progress::{Clock, Tick};
use crate::radiance::{BLOCK, Counts, Indirect, RadianceSample, Sampler, sample_places};
use crate::radiance_cache::{NodeBand, NodePhotons, RadianceCache};
use crate::sampling::{Strategy, positions};
use crate::scene::Scene;
use crate::volume::Lattice;
use glam::Vec3;
use std::time::Instant;

/// A field to light: the scene seen from it, its grid, and what the grid's points hold.
pub(super) struct Job {
    /// The field's number.
    pub(super) number: u32,
    pub(super) scene: Scene,
    pub(super) lattice: Lattice,
    pub(super) masks: Vec<Mask>,
}

/// Lights the fields of one 4D scene, `jobs` by number: the same photons, walls and cache serve all.
pub(super) fn light(jobs: &[Job], context: Context) -> Result<Lit> {
    let Context { settings, device, progress, .. } = context;
    let mut lit = Lit::default();
    let clock = Clock::start();
    let first = &jobs[0].scene;
    let pyramids = pyramids(first);
    let tracers =
        jobs.iter().map(|job| GraphTracer::with_pyramids(device, &job.scene, &pyramids)).collect::<Result<Vec<_>>>()?;
    lit.spend(clock, |s| &mut s.build);

    let clock = Clock::start();
    let stage = progress.stage("photons", settings.photons);
    let fields = std::iter::once(&first.field).chain(first.companions().iter().map(|c| &c.member.field));
    let axis = IsovalueAxis::of(fields.map(|field| field.samples()));
    let photons = trace_photons(first, &tracers[0], &settings.emission(axis), &|n| stage.tick(n));
    stage.end()?;
    lit.spend(clock, |s| &mut s.photons);
    lit.counts.rays = photons.rays;
    lit.photons = PhotonCounts {
        emitted: photons.emitted,
        stored: photons.stored(),
        without_gradient: photons.flat_gradient,
        energy_imbalance: photons.energy.iter().map(|e| e.imbalance()).fold(0.0, f64::max),
    };

    // The walls' light of all isovalues; what the nodes take from photons.
    let clock = Clock::start();
    let cache_settings = settings.cache(axis);
    let texels = flat::lit_texels(first, cache_settings.flat_resolution, cache_settings.isovalue_resolution) as u64;
    let stage = progress.stage("walls", texels);
    let estimate = settings.estimate();
    let gather = settings.gather_rays > 0;
    let mut cache = RadianceCache::new(first, &tracers[0], &photons, &cache_settings, &|n| stage.tick(n));
    let sources: Vec<NodePhotons> = jobs.iter().map(|job| NodePhotons::new(&job.scene, &photons, estimate)).collect();
    drop(photons);
    stage.end()?;
    lit.spend(clock, |s| &mut s.cache);

    let clock = Clock::start();
    let levels = Levels::new(jobs.iter().zip(&sources).map(|(job, source)| (&*job.scene.field, source.masks())), REACH);
    let bands = levels.bands(settings.bands);
    lit.bands = bands.len();
    let mut fields = jobs.iter().map(|job| FieldLight::new(job, settings)).collect::<Result<Vec<_>>>()?;
    lit.spend(clock, |s| &mut s.samples);
    // In rays.
    let node = u64::from(2 + settings.cache_shadow_rays);
    let nodes = if gather { sources.iter().map(NodePhotons::work).sum() } else { 0 };
    let samples: u64 = fields.iter().map(|field| field.work(settings)).sum();
    let stage = progress.stage("light", nodes * node + samples);
    for &band in &bands {
        let begun = Instant::now();
        let clock = Clock::start();
        for ((job, tracer), source) in jobs.iter().zip(&tracers).zip(&sources).filter(|_| gather) {
            let first = band.number * RadianceCache::blocks(&job.scene);
            let saved = context.saved(job.number, Kept::Cache).map(|saved| saved.starting_at(first));
            let nodes = NodeBand { range: band.range(), saved };
            cache.fill(&job.scene, tracer, source, &cache_settings, nodes, &|n| stage.tick(n * node));
        }
        lit.spend(clock, |s| &mut s.cache);
        let clock = Clock::start();
        for ((field, tracer), source) in fields.iter_mut().zip(&tracers).zip(&sources) {
            let counts = field.sample(band, tracer, (&cache, source), context, &|n| stage.tick(n));
            lit.counts += counts;
        }
        lit.spend(clock, |s| &mut s.samples);
        if bands.len() > 1 && !progress.stops() {
            let name = format!("band {} of {}", band.number + 1, bands.len());
            stage.note(&name, &format!("{:.2} s", begun.elapsed().as_secs_f64()));
        }
    }
    stage.end()?;
    progress.line("cache", lit.seconds.cache);
    progress.line("samples", lit.seconds.samples);
    lit.counts.rays += cache.rays;
    cache.forget_nodes();
    drop(sources);

    let clock = Clock::start();
    let stage = progress.stage("interpolate", fields.iter().map(|field| field.interpolation(settings)).sum());
    for field in fields {
        let sides = field.finish(settings, &|n| stage.tick(n));
        lit.fields.push(sides);
    }
    stage.end()?;
    lit.spend(clock, |s| &mut s.interpolate);
    lit.flats = cache.into_shown_flats();
    Ok(lit)
}

/// The light of one field while it is gathered.
struct FieldLight<'a> {
    job: &'a Job,
    sampled: Sampled<'a>,
}

/// Where a field is sampled, and what is known there on each side.
enum Sampled<'a> {
    /// At its grid's points and beside them.
    Grid(Box<GridPlaces<'a>>, Vec<GridSide>),
    /// Anywhere.
    Scattered(Vec<Vec3>, Vec<(Side, Vec<Option<RadianceSample>>)>),
}

struct GridPlaces<'a> {
    points: GridPoints<'a>,
    beside: Beside<'a>,
    /// Which of the points lie on walls.
    contacts: Contacts<'a>,
}

struct GridSide {
    side: Side,
    at_points: PointLight,
    at_beside: Vec<BesideLight>,
}

impl<'a> FieldLight<'a> {
    fn new(job: &'a Job, settings: &BakeSettings) -> Result<Self> {
        let Job { scene, lattice, masks, .. } = job;
        let sides = scene.surface.stored_sides().into_iter();
        let sampled = match settings.strategy.placed() {
            Some(strategy) => {
                let at = scatter(scene, settings, masks, &strategy)?;
                let sides = sides.map(|side| (side, vec![None; at.len()])).collect();
                Sampled::Scattered(at, sides)
            }
            None => {
                // The photon map knows nothing beyond the sweep; what gather rays find there goes on.
                let points = GridPoints::new(scene, lattice, masks, settings.gather_rays > 0);
                let fitted = |o: usize| masks[o] == Mask::Filled && !points.contains(o);
                let beside = Beside::new(scene, lattice, fitted, settings.seed);
                // Only a cache knows what walls show there.
                let gathers = settings.gather_rays > 0;
                let contacts = Contacts::new(scene, lattice, |o| gathers && masks[o] == Mask::Valid);
                let sides = sides.map(|side| {
                    let at_points = points.dark(settings);
                    GridSide { side, at_points, at_beside: beside.dark() }
                });
                let sides = sides.collect();
                Sampled::Grid(Box::new(GridPlaces { points, beside, contacts }), sides)
            }
        };
        Ok(Self { job, sampled })
    }

    /// Ticks of [`FieldLight::sample`]: rays of all sides, about.
    fn work(&self, settings: &BakeSettings) -> u64 {
        let rays = [settings.gather_rays, settings.shadow_rays];
        let each = match &self.sampled {
            Sampled::Grid(places, _) => {
                let at_points = (places.points.len() + places.contacts.len()) as u64 * rays_of(rays);
                at_points + places.beside.len() as u64 * rays_of(rays_beside(rays))
            }
            Sampled::Scattered(at, _) => at.len() as u64 * rays_of(rays),
        };
        each * self.sides() as u64
    }

    fn sides(&self) -> usize {
        self.job.scene.surface.stored_sides().len()
    }

    /// Ticks of [`FieldLight::finish`].
    fn interpolation(&self, settings: &BakeSettings) -> u64 {
        let passes = match (&self.sampled, settings.interpolation) {
            // The samples' errors are blended, too.
            (Sampled::Scattered(..), Interpolation::Fit) => 3,
            _ => 2,
        };
        passes * (self.job.lattice.len() * self.sides()) as u64
    }

    /// Samples the isovalues of a band, on all sides.
    #[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
    fn sample(
        &mut self,
        band: Band,
        tracer: &GraphTracer<'_>,
        (cache, source): (&RadianceCache, &NodePhotons<'_>),
        context: Context,
        tick: Tick,
    ) -> Counts {
        let settings = context.settings;
        let Job { scene, number, .. } = self.job;
        let rays @ [gather_rays, shadow_rays] = [settings.gather_rays, settings.shadow_rays];
        let (seed, each) = (settings.seed, rays_of(rays));
        let indirect = |side: Side, rays: u32| {
            let map = source.map(side).filter(|_| settings.gather_rays == 0);
            map.map_or(Indirect::Gather(cache, rays), Indirect::Map)
        };
        let saved = |side: Side, kept: Kept| context.saved(*number, kept)[side.index()];
        let mut counts = Counts::default();
        match &mut self.sampled {
            Sampled::Grid(places, sides) => {
                let GridPlaces { points, beside, contacts } = &**places;
                let apart = |o: usize| contacts.holds(o);
                let own = |o: usize| band.holds(points.isovalue(o));
                let wedge = Wedge::new(tracer, cache, settings);
                for GridSide { side, at_points, at_beside } in sides {
                    let side = *side;
                    let gathered = indirect(side, gather_rays);
                    let sampler = Sampler { scene, tracer, indirect: &gathered, side, shadow_rays, seed };
                    counts += points
                        .sample(&sampler, band, at_points, &apart, saved(side, Kept::Points), &|n| tick(n * each));
                    counts += contacts.solve(at_points.grid(), own, side, &wedge, &|n| tick(n * each));
                    let fewer @ [gather_rays, shadow_rays] = rays_beside(rays);
                    let sampler = Sampler { indirect: &indirect(side, gather_rays), shadow_rays, ..sampler };
                    let tick = |n: u64| tick(n * rays_of(fewer));
                    counts += beside.sample(&sampler, band, at_beside, saved(side, Kept::Beside), &tick);
                }
            }
            Sampled::Scattered(at, sides) => {
                let isovalue = |p: Vec3| (scene.field.value(p.as_dvec3()) as f32).clamp(0.0, 1.0);
                let own: Vec<usize> = (0..at.len()).filter(|&n| band.holds(isovalue(at[n]))).collect();
                let place = |n: usize| (own[n] as u64, at[own[n]]);
                let first = band.number * at.len().div_ceil(BLOCK);
                for (side, samples) in sides {
                    let side = *side;
                    let gathered = indirect(side, gather_rays);
                    let sampler = Sampler { scene, tracer, indirect: &gathered, side, shadow_rays, seed };
                    let saved = saved(side, Kept::Points).starting_at(first);
                    let got = sample_places(&sampler, own.len(), &place, saved, &|n| tick(n * each));
                    counts += got.counts;
                    own.iter().zip(got.samples).for_each(|(&n, s)| samples[n] = s);
                }
            }
        }
        counts
    }

    /// The grids of all sides.
    fn finish(self, settings: &BakeSettings, tick: Tick) -> Vec<(Side, IlluminationGrid)> {
        match self.sampled {
            Sampled::Grid(places, sides) => {
                let fitted = |GridSide { side, at_points, mut at_beside }: GridSide| {
                    if settings.smooths() {
                        places.beside.smooth(side, settings.tau, &mut at_beside, tick);
                    }
                    let grid = places.points.finish(side, settings.tau, at_points, tick);
                    (side, places.beside.fit(side, grid, &at_beside))
                };
                sides.into_iter().map(fitted).collect()
            }
            Sampled::Scattered(_, sides) => {
                let interpolated = |(side, samples): (Side, Vec<Option<RadianceSample>>)| {
                    (side, scattered_grid(self.job, side, samples.into_iter().flatten().collect(), settings, tick))
                };
                sides.into_iter().map(interpolated).collect()
            }
        }
    }
}

/// The grid of one side, interpolated from scattered samples.
fn scattered_grid(
    Job { scene, lattice, masks, .. }: &Job,
    side: Side,
    samples: Vec<RadianceSample>,
    settings: &BakeSettings,
    tick: Tick,
) -> IlluminationGrid {
    let blended = || shepard(&scene.field, lattice, masks, &samples, settings.neighbours, tick);
    match settings.interpolation {
        Interpolation::Shepard => blended(),
        Interpolation::Irradiance => interpolate(scene, side, lattice, masks, &samples, settings.neighbours, tick),
        Interpolation::Fit => {
            let mut grid = blended();
            let free = NodeSet::new(lattice.len(), |o| grid.mask[o] != Mask::Empty);
            let errors = errors(&samples);
            let blended = shepard(&scene.field, lattice, masks, &errors, settings.neighbours, tick).radiance;
            drop(errors);
            GridFit::new(&scene.field, lattice, &free, tick).improve(&mut grid, samples, &blended);
            grid
        }
    }
}

/// Rays of a sample of so many gather and shadow rays, about: half of the shadow rays are spared as a rule.
fn rays_of([gather, shadow]: [u32; 2]) -> u64 {
    u64::from(2 + shadow / 2 + gather)
}

/// Positions of scattered samples.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "counts")]
fn scatter(scene: &Scene, settings: &BakeSettings, masks: &[Mask], strategy: &Strategy) -> Result<Vec<Vec3>> {
    let needed = masks.iter().filter(|&&m| m != Mask::Empty).count();
    let count = settings.samples.unwrap_or(((needed as f64 * settings.samples_per_point) as u64).max(1000));
    let at = positions(&scene.field, strategy, count, settings.seed)?;
    if at.is_empty() {
        return Err(Error::Invalid("no sample landed on an isosurface of the sweep; choose other isovalues".into()));
    }
    Ok(at)
}
