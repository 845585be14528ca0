//! The second engine: **line sweeps**. Every point of a line lies on *some* level set, so one line answers for all
//! isovalues at once (design §7).
//!
//! * Direct light: along a line from a luminaire's point, a sample is lit on its own level set iff h there exceeds the
//!   running maximum. One fan of lines lights every node and every isovalue.
//! * Indirect light: along a line, the first hit of the ray that leaves sample k is the next value ≥ h_k
//!   (all nearest greater values, amortised O(1) with a stack \[BSV93\]). There h = h_k again, so the grid itself holds
//!   the right level set's radiance. A pass over all directions is one bounce for every node and isovalue; passes are
//!   iterated (Jacobi) until what is left out is small.
//!
//! Limits: between samples of a line h counts as linear (visibility agrees with exact rays on about 99 % of samples);
//! all nodes share directions and luminaire points, so what noise there is is smooth in space; polygons that stand
//! inside the volume are refused unless they are luminaires.

mod accumulate;
mod arrive;
mod blockers;
mod blocks;
mod clearance;
mod direct;
mod directions;
mod ends;
mod faces;
mod fans;
mod flats;
mod gaps;
mod gather;
mod grid;
mod half;
mod incoming;
mod lit_rows;
mod normals;
mod open_share;
mod pack;
mod planes;
mod points;
mod receivers;
mod reflect;
mod replicate;
mod scan;
mod segments;
mod settling;
#[allow(unsafe_code, reason = "vector instructions: measured to pay, chosen at run time")]
mod simd;
mod slits;
mod solid;
mod state;
mod totals;
mod work_queue;

use crate::checkpoint::Saved;
use crate::error::{Error, Result};
use crate::flat::FlatLight;
use crate::flattened::Side;
use crate::isa::Isa;
use crate::scene::Scene;
pub(crate) use arrive::reports;
use direct::Direct;
pub(crate) use fans::seen;
use flats::Flats;
pub(crate) use flats::texels;
pub(crate) use gather::workspace;
use glam::DVec3;
use grid::Geometry;
use lit_rows::LitRows;
use open_share::open_over_sweep;
use planes::PlanePool;
use points::Points;
use rayon::prelude::*;
pub(crate) use replicate::bright;
use slits::Slits;
use state::State;
use totals::{Deblur, Totals};

/// How to sweep.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SweepSettings {
    /// Directions over the sphere per full pass and replicate, a power of two; every line serves two.
    pub directions: usize,
    /// Points per luminaire and replicate, a power of two.
    pub light_points: usize,
    /// Indirect bounces; what is left beyond is cut off. Large values mean: until `target` is met.
    pub max_bounces: usize,
    /// The share of indirect light that may be missing when the bounces stop; rounding ends below 1e-4.
    pub target: f64,
    /// Repetitions with random numbers of their own, averaged; two or more give a standard error, which 4, 8 … know
    /// better. Their directions and luminaire points are parts of one low-discrepancy set.
    pub replicates: usize,
    /// Texels along the longer edge of a wall, and isovalues of its texture.
    pub flat_resolution: (usize, usize),
    /// Whether direct light is told apart: 12 bytes per node and stored side.
    pub direct: bool,
    /// Seed of the run.
    pub seed: u64,
}

impl Default for SweepSettings {
    fn default() -> Self {
        Self {
            directions: 64,
            light_points: 16,
            max_bounces: 512,
            target: 4e-3,
            replicates: 4,
            flat_resolution: (32, 32),
            direct: false,
            seed: 1,
        }
    }
}

/// Light on one stored side of every level set, at the lattice's nodes. Nodes that are not [`SweepResult::lit`] are 0.
#[derive(Clone, Debug)]
pub struct SweptSide {
    /// Which side.
    pub side: Side,
    /// Irradiance E (world, not divided by π), straight from luminaires and from everything else.
    pub irradiance: Vec<[f32; 3]>,
    /// What of it comes straight from luminaires; empty unless [`SweepSettings::direct`] asks for it.
    pub direct: Vec<[f32; 3]>,
    /// Standard error of the luminance of the reflected radiance ρE/π, from the spread of the replicates and how much
    /// better than independent ones they are together (measured at one node in sixteen or fewer; a bound unless they
    /// are 4, 8, 16 …). Empty with fewer than 2. What the grid cannot hold between its nodes is not part of it.
    pub std_error: Vec<f32>,
}

/// What a sweep gave.
#[derive(Clone, Debug)]
pub struct SweepResult {
    /// The stored sides, in the order of [`crate::scene::Surface::stored_sides`].
    pub sides: Vec<SweptSide>,
    /// Nodes with light: those with ∇h ≠ 0 that hold a surface of the sweep, and those beside one whose own lies less
    /// than a quarter of the sweep outside it, unless h ends in a plateau there.
    pub lit: Vec<bool>,
    /// Reflected radiance of walls, luminaires and caps, by flat number; `None` where nothing is reflected.
    pub flats: Vec<Option<FlatLight>>,
    /// Indirect bounces of the replicate that took the most.
    pub bounces: usize,
    /// The share of all indirect light, up to 1, that later bounces would bring or take, as far as their decay is
    /// known; NaN where bounces were cut before it was.
    pub residual: f64,
    /// Counts for the report.
    pub counts: SweepCounts,
}

/// How much was done.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SweepCounts {
    /// Gather rays: pairs of a valid node and a direction above its horizon.
    pub gather_rays: u64,
    /// Visibility queries: pairs of a valid node and a luminaire point.
    pub shadow_rays: u64,
    /// Families of parallel lines.
    pub families: u64,
    /// Nodes that hold a surface of the sweep.
    pub valid: u64,
}

/// Points along an axis that a sweep takes: blocks of nodes are found by a reciprocal in 32 bits.
const MOST_ALONG: usize = 1 << 19;

/// Polygons that a sweep takes.
pub const MOST_POLYGONS: usize = 256;

/// The share of progress that is direct light.
pub(crate) const DIRECT_SHARE: f64 = 0.2;

/// Whether sweeps can light a scene.
///
/// # Errors
/// `NotSupported` as [`sweep`].
pub fn supported(scene: &Scene) -> Result<()> {
    if scene.fields() > 1 {
        return Err(Error::NotSupported(
            "engine = \"sweep\" lights one volume at a time; several that light each other need engine = \"photon\" (or \
             policy = \"independent\")"
                .into(),
        ));
    }
    let polygons = scene.polygons().len();
    if polygons > MOST_POLYGONS {
        return Err(Error::NotSupported(format!(
            "{polygons} polygons: sweeps test each line against all, {MOST_POLYGONS} at most; use --engine photon"
        )));
    }
    let [nx, ny, nz] = scene.lattice().dims();
    if nx.max(ny).max(nz) > MOST_ALONG {
        return Err(Error::NotSupported(format!(
            "{nx}×{ny}×{nz} points: sweeps take {MOST_ALONG} along an axis at most; take a coarser grid or --engine photon"
        )));
    }
    if !numbered([nx, ny, nz]) {
        return Err(Error::NotSupported(format!(
            "{nx}×{ny}×{nz} points: sweeps number points in 31 bits; take a coarser grid or --engine photon"
        )));
    }
    // Stored, or seen through gaps.
    let within = scene.surface.stored_sides().contains(&Side::Higher) && lit_within_solids(scene)
        || scene.field.has_gaps() && glows(scene);
    if scene.is_capped() && within {
        return Err(Error::NotSupported(
            "boundary = \"capped\": sweeps take caps for black from within, where this scene has light; use --engine photon"
                .into(),
        ));
    }
    let inside = ends::inside(scene);
    if let Some((_, p)) = inside.iter().zip(scene.polygons()).find(|(inside, p)| **inside && !p.opaque_back) {
        return Err(Error::NotSupported(format!(
            "polygon '{}' stands inside the volume, where sweeps cannot see it; use --engine photon",
            p.name
        )));
    }
    Ok(())
}

/// Whether there may be light within solids that nothing leaves open: of a luminaire in Ω, of surfaces that emit, or
/// through samples that are not finite.
pub fn lit_within_solids(scene: &Scene) -> bool {
    let inside = ends::inside(scene);
    let lamp = inside.iter().zip(scene.luminaires()).any(|(inside, _)| *inside);
    lamp || glows(scene) || scene.field.has_gaps()
}

fn glows(scene: &Scene) -> bool {
    scene.surface.emission != DVec3::ZERO
}

/// Numbers of a plane of light, on a lattice of `dims` whose lit nodes are these.
pub(crate) fn places(dims: [usize; 3], lit: &[bool]) -> usize {
    grid::lit_rows(dims, lit).1.iter().map(LitRows::len).max().unwrap_or(0)
}

/// Whether 31 bits number all points, and those that the sixteen lines of a pack would meet beyond the last.
fn numbered([nx, ny, nz]: [usize; 3]) -> bool {
    let stride = nx.saturating_mul(ny).max(ny.saturating_mul(nz)).max(nx.saturating_mul(nz));
    nx.saturating_mul(ny).saturating_mul(nz).saturating_add(stride.saturating_mul(16)) <= i32::MAX as usize
}

/// Lights every node of the lattice for every isovalue of the sweep. `tick` receives the fraction done (an estimate
/// while bounces converge), and ends the work by returning false.
///
/// # Errors
/// `Interrupted` if `tick` ended it. `NotSupported` for several fields that light each other, if a polygon that is not
/// a luminaire stands inside the volume, if there are more than [`MOST_POLYGONS`], or about 2³¹ points or more, and for
/// the inside of capped solids if there may be light in it: that needs the photon engine.
pub fn sweep(scene: &Scene, settings: &SweepSettings, tick: &(dyn Fn(f64) -> bool + Sync)) -> Result<SweepResult> {
    sweep_resumable(scene, settings, Saved::NOWHERE, tick)
}

/// As [`sweep`], keeping what is finished in `saved` (whole passes, whenever the checkpoint is due or `tick` ends the
/// work) and going on from there: with the same bits.
///
/// # Errors
/// As [`sweep`].
pub fn sweep_resumable(
    scene: &Scene,
    settings: &SweepSettings,
    saved: Saved,
    tick: &(dyn Fn(f64) -> bool + Sync),
) -> Result<SweepResult> {
    supported(scene)?;
    let geometry = Geometry::new(&scene.field);
    let slits = Slits::new(scene);
    let stored = scene.surface.stored_sides();
    let sides = swept_sides(scene);
    let replicates = settings.replicates.max(1);
    let (across, isovalues) = settings.flat_resolution;
    let mut flats = Flats::new(scene, &sides, across.max(2), isovalues.max(2));
    let size = [geometry.h.len(), geometry.places()];
    let mut state = State::new(Totals::new(&sides, stored.len(), size, replicates));
    let mut passes = saved.read(0, |bytes| state.restore(bytes, sides.len(), &mut flats)).flatten();
    if state.counts.valid == 0 {
        let nodes = geometry.h.len();
        state.counts.valid =
            (0..nodes).into_par_iter().with_min_len(1 << 14).filter(|&at| geometry.valid(at)).count() as u64;
    }
    let pool = PlanePool::default();
    let isa = Isa::current();
    let run = Run { scene, settings, geometry: &geometry, slits: &slits, sides: &sides, isa, saved, pool: &pool };
    let dims = scene.lattice().dims();
    run.direct(&mut state, &mut flats, tick).ok_or(Error::Interrupted)?;
    while state.done() < replicates {
        let done = state.done() as f64;
        let progress = |x: f64| tick(DIRECT_SHARE + (1.0 - DIRECT_SHARE) * (done + x) / replicates as f64);
        let indirect = run.replicate(&mut state, passes.take(), &mut flats, &progress).ok_or(Error::Interrupted)?;
        let deblur = Deblur { dims, lit: &geometry.all_lit() };
        state.add(&indirect, &flats, (scene, geometry.lit_rows(), &deblur));
        pool.keep(indirect.into_iter().flatten());
    }
    pool.clear();
    let (lit, rows) = (geometry.all_lit(), geometry.into_lit_rows());
    saved.save(0, || state.bytes(None, &flats));
    let State { total, flats: mut sums, bounces, residual, counts, .. } = state;
    sums.iter_mut().flatten().flatten().for_each(|x| *x /= replicates as f32);
    let flats = flats.export(&sums, &sides, scene.surface.outside);
    let mut sides = total.finish(&rows, &Deblur { dims, lit: &lit }, settings.direct);
    let world = |o: usize| scene.lattice().to_world(scene.lattice().point(o));
    let dark = slits.hidden.iter().map(|hidden| hidden.0).filter(|&o| scene.covers(world(o)));
    for o in dark {
        for side in &mut sides {
            side.irradiance[o] = [0.0; 3];
            side.direct.get_mut(o).into_iter().for_each(|d| *d = [0.0; 3]);
            side.std_error.get_mut(o).into_iter().for_each(|e| *e = 0.0);
        }
    }
    Ok(SweepResult { sides, lit, flats, bounces, residual, counts })
}

/// The sides that are swept: the stored ones, and the other one if light passes to it, if the luminaires mostly light
/// it, or if the stored one lies within caps: walls and caps are seen there.
pub(crate) fn swept_sides(scene: &Scene) -> Vec<Side> {
    // Only around the open rims of level sets: outside Ω, or beside samples that are not finite.
    let margin = scene.has_margin();
    let (open, lit) = (!scene.is_capped(), !scene.polygons().is_empty());
    // Surfaces that emit light what is beyond gaps without any luminaire.
    let coupled = open && (lit && (margin || scene.field.has_gaps()) || glows(scene) && scene.field.has_gaps());
    let walls = open && scene.polygons().iter().any(|p| p.albedo != DVec3::ZERO);
    let mut sides = scene.surface.stored_sides();
    if let [side] = sides[..]
        && (coupled || walls && lit_mostly_within(scene) || !open && lit && side == Side::Higher)
    {
        sides.push(side.opposite());
    }
    sides
}

/// Whether the luminaires stand mostly within solids, over the whole sweep.
pub fn lit_mostly_within(scene: &Scene) -> bool {
    open_over_sweep(scene, scene.surface.outside) < 0.5
}

/// What the replicates of one sweep share.
struct Run<'a> {
    scene: &'a Scene,
    settings: &'a SweepSettings,
    geometry: &'a Geometry<'a>,
    slits: &'a Slits,
    sides: &'a [Side],
    isa: Isa,
    saved: Saved<'a>,
    pool: &'a PlanePool,
}

impl Run<'_> {
    /// Direct light of all replicates, on the flats too: each has luminaire points of its own, and what bounces is
    /// their mean, so that no replicate spreads the light of few points. `None` if `tick` stopped it.
    fn direct(&self, state: &mut State, flats: &mut Flats, tick: &(dyn Fn(f64) -> bool + Sync)) -> Option<()> {
        let s = self.settings;
        let replicates = s.replicates.max(1);
        let points = s.light_points.max(1);
        let lights = points * self.scene.luminaires().len();
        let clearance = direct::clearance(self.scene, self.geometry, self.sides);
        let first = state.total.lit;
        while state.total.lit < replicates {
            let number = state.total.lit;
            if self.saved.due() {
                self.saved.save(0, || state.bytes(None, flats));
            }
            let mut step = number * lights;
            let mut ask = || {
                step += 1;
                tick(DIRECT_SHARE * step as f64 / (replicates * lights) as f64)
            };
            let direct = Direct {
                scene: self.scene,
                geometry: self.geometry,
                clearance: clearance.as_ref(),
                sides: self.sides,
                points: Points { seed: s.seed, replicate: number, replicates, count: points },
                isa: self.isa,
                pool: self.pool,
            };
            let Some(direct) = direct.light(flats, &mut ask) else {
                self.saved.save(0, || state.bytes(None, flats));
                return None;
            };
            state.counts.shadow_rays += state.counts.valid * lights as u64;
            let rest = state.total.add_direct(direct, self.scene, self.geometry.lit_rows());
            self.pool.keep(rest.into_iter().flatten());
        }
        if first < replicates {
            state.total.average_direct();
            // Passes need fewer planes.
            self.pool.clear();
            flats.average_direct(state.total.lit);
        }
        Some(())
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn what_31_bits_cannot_number_is_not_numbered() {
        assert!(super::numbered([1024; 3]) && super::numbered([1280, 1280, 1290]));
        // The last has fewer points than that, but packs of lines would go on beyond them.
        assert!(
            !super::numbered([1291; 3]) && !super::numbered([usize::MAX; 3]) && !super::numbered([11_000, 11_000, 17])
        );
    }
}
