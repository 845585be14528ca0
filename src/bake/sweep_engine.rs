//! The fast engine: line sweeps light every node; exact rays fill points outside the sweep beside steep edges, and
//! those next to luminaires.

use super::bands::Band;
use super::beside::{Beside, rays_beside};
use super::contacts::{Contacts, Wedge};
use super::grid_points::{STAND_INS, split};
use super::photon_engine::Job;
use super::{Context, Kept, Lit};
use crate::brdf::reflected;
use crate::checkpoint::Saved;
use crate::embree::GraphTracer;
use crate::error::Result;
use crate::flattened::Side;
use crate::illumination_grid::IlluminationGrid;
use crate::mask::{Mask, local_position};
use crate::neighbourhood::neighbourhood;
use crate::node_set::NodeSet;
use crate::progress::Clock;
use crate::radiance::{Indirect, Sampler, sample_places};
use crate::radiance_cache::RadianceCache;
use crate::scene::{Scene, Surface};
use crate::sweep::{SweepResult, sweep_resumable};
use crate::volume::Lattice;
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// Resolution of the progress bar, since a sweep knows only fractions.
const STEPS: f64 = 1000.0;

/// Points nearer to a luminaire than this many voxels are sampled by exact rays: on its front light falls off within a
/// voxel, and what lies behind it is lit by lines that a sweep mixes a voxel further.
const NEAR: f64 = 1.5;

pub(super) fn light(Job { number, scene, lattice, masks }: &Job, context: Context) -> Result<Lit> {
    let Context { settings, device, progress, .. } = context;
    let mut lit = Lit::default();
    // Sweeps light the lattice they run on: a finer grid is a finer copy of the same field.
    let fine;
    let scene = if lattice == scene.lattice() {
        scene
    } else {
        fine = scene.resampled(lattice);
        &fine
    };
    let clock = Clock::start();
    let stage = progress.stage("sweep", STEPS as u64);
    let done = std::sync::atomic::AtomicU64::new(0);
    let [saved, _] = context.saved(*number, Kept::Cache);
    let swept = sweep_resumable(scene, &settings.sweep(), saved, &|fraction| {
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 … 1000")]
        let now = (fraction * STEPS) as u64;
        let before = done.fetch_max(now, std::sync::atomic::Ordering::Relaxed);
        stage.tick(now.saturating_sub(before))
    })?;
    stage.end()?;
    lit.spend(clock, |s| &mut s.sweep);
    lit.sweep_queries = swept.counts.gather_rays + swept.counts.shadow_rays;
    (lit.sweep_bounces, lit.unsettled) = (swept.bounces, swept.residual);

    let SweepResult { sides: mut swept, lit: own, flats, .. } = swept;
    swept.iter_mut().for_each(|s| whiten(&own, &mut s.irradiance));
    let clock = Clock::start();
    let tracer = GraphTracer::new(device, scene)?;
    lit.spend(clock, |s| &mut s.build);
    let clock = Clock::start();
    // Just outside the sweep, light on the point's own level set is a better end of interpolation than any fit.
    let fitted = |o: usize| masks[o] == Mask::Filled && !own[o];
    let beside = Beside::new(scene, lattice, fitted, settings.seed);
    let near = beside_luminaires(scene, masks);
    let contacts = Contacts::new(scene, scene.lattice(), |o| masks[o] == Mask::Valid && own[o]);
    // What the sweep knows is what rays from these points gather.
    let gathered = |side| swept.iter().find(|s| s.side == side && beside.len() + near.len() + contacts.len() > 0);
    let stored = RadianceCache::room(lattice.len(), |o| own[o] || masks[o] == Mask::Filled);
    let nodes = Side::BOTH.map(|side| Some(widened(lattice, &stored, (&own, masks), &gathered(side)?.irradiance)));
    let cache = RadianceCache::from_parts(nodes, stored, lattice.dims(), flats);
    let mut sides = Vec::new();
    for mut s in swept {
        let stage = progress.stage("samples", (beside.len() + near.len() + contacts.len()) as u64);
        let rays = [settings.gather_rays, settings.shadow_rays].map(|n| n.max(2));
        let [gather_rays, shadow_rays] = rays_beside(rays);
        let (indirect, seed) = (Indirect::Gather(&cache, gather_rays), settings.seed);
        let sampler = Sampler { scene, tracer: &tracer, indirect: &indirect, side: s.side, shadow_rays, seed };
        let saved = context.saved(*number, Kept::Beside)[s.side.index()];
        let mut light = beside.dark();
        let counts = beside.sample(&sampler, Band::WHOLE, &mut light, saved, &|n| stage.tick(n));
        lit.counts += counts;
        beside.smooth(s.side, settings.tau, &mut light, &|n| stage.tick(n));
        let (indirect, shadow_rays) = (Indirect::Gather(&cache, rays[0]), rays[1]);
        let sampler = Sampler { indirect: &indirect, shadow_rays, ..sampler };
        // Keys of a point beside; none of these is one.
        let place = |n: usize| ((STAND_INS * near[n]) as u64, local_position(&scene.field, lattice, near[n]).as_vec3());
        let sampled = sample_places(&sampler, near.len(), &place, Saved::NOWHERE, &|n| stage.tick(n));
        lit.counts += sampled.counts;
        let mut grid = swept_grid((&own, masks), outgoing(scene, &own, s.irradiance), s.std_error);
        for (&o, sample) in near.iter().zip(&sampled.samples) {
            if let Some(sample) = sample {
                grid.radiance[o] = sample.radiance.to_array();
                grid.std_error[o] = sample.variance.sqrt();
                s.direct.get_mut(o).into_iter().for_each(|d| *d = sample.direct.to_array());
            }
        }
        let wedge = Wedge::new(&tracer, &cache, settings);
        lit.counts += contacts.solve(&mut grid, |_| true, s.side, &wedge, &|n| stage.tick(n));
        stage.end()?;
        grid.split = settings.split.then(|| split(scene, lattice, s.side, &grid, &s.direct));
        drop(s.direct);
        sides.push((s.side, beside.fit(s.side, grid, &light)));
    }
    lit.fields.push(sides);
    lit.spend(clock, |s| &mut s.samples);
    lit.bands = 1;
    lit.flats = cache.into_shown_flats();
    Ok(lit)
}

/// Outgoing radiance at lit nodes, of which `white` tells what a white surface would reflect.
fn outgoing(scene: &Scene, lit: &[bool], mut white: Vec<[f32; 3]>) -> Vec<[f32; 3]> {
    let Surface { albedo, emission, .. } = &scene.surface;
    let nodes = white.par_iter_mut().zip(scene.field.samples()).zip(lit).with_min_len(1 << 14);
    nodes.filter(|(_, lit)| **lit).for_each(|((x, &h), _)| {
        let radiance = albedo.at(f64::from(h)) * DVec3::from_array(x.map(f64::from)) + emission;
        *x = radiance.as_vec3().to_array();
    });
    white
}

/// Valid points less than [`NEAR`] voxels from a luminaire.
fn beside_luminaires(scene: &Scene, masks: &[Mask]) -> Vec<usize> {
    let lattice = scene.lattice();
    let reach = NEAR * lattice.spacing().max_element();
    let near = |&o: &usize| {
        masks[o] == Mask::Valid && {
            let x = lattice.to_world(local_position(&scene.field, lattice, o));
            scene.luminaires().iter().any(|light| light.is_nearer(x, reach))
        }
    };
    (0..masks.len()).into_par_iter().with_min_len(1 << 12).filter(near).collect()
}

/// Turns irradiance into what a white surface would reflect at lit nodes.
fn whiten(lit: &[bool], irradiance: &mut [[f32; 3]]) {
    let white = |e: [f32; 3]| reflected(DVec3::ONE, DVec3::from_array(e.map(f64::from))).as_vec3().to_array();
    let nodes = irradiance.par_iter_mut().zip(lit).with_min_len(1 << 14);
    nodes.filter(|(_, lit)| **lit).for_each(|(e, _)| *e = white(*e));
}

/// What a white surface would reflect at the nodes of `stored`: that of lit nodes; the mean of those around at others
/// that are filled, so that lookups in cells at the sweep's ends find something; NaN if there is none, and elsewhere.
fn widened(lattice: &Lattice, stored: &NodeSet, (lit, masks): (&[bool], &[Mask]), white: &[[f32; 3]]) -> Vec<[f32; 3]> {
    /// Nodes that a thread takes at a time.
    const RUN: usize = 1 << 12;
    let value = |o: usize| {
        if lit[o] || masks[o] != Mask::Filled {
            return if lit[o] { white[o] } else { [f32::NAN; 3] };
        }
        let (mut sum, mut n) = (Vec3::ZERO, 0.0);
        for o in neighbourhood(lattice.dims(), o).flatten().filter(|&o| lit[o]) {
            (sum, n) = (sum + Vec3::from_array(white[o]), n + 1.0);
        }
        if n > 0.0 { (sum / n).to_array() } else { [f32::NAN; 3] }
    };
    let mut values = vec![[f32::NAN; 3]; stored.len()];
    stored.split(&mut values, RUN).into_par_iter().enumerate().for_each(|(run, values)| {
        let nodes = stored.members(run * RUN..lattice.len().min((run + 1) * RUN));
        values.iter_mut().zip(nodes).for_each(|(v, o)| *v = value(o));
    });
    values
}

/// A grid of the points that are lit and that `masks` do not call empty; the others are dark as they come.
fn swept_grid(
    (lit, masks): (&[bool], &[Mask]),
    mut radiance: Vec<[f32; 3]>,
    mut std_error: Vec<f32>,
) -> IlluminationGrid {
    let own = |(&lit, &mask): (&bool, &Mask)| if lit { mask } else { Mask::Empty };
    let mask: Vec<Mask> = lit.par_iter().zip(masks).with_min_len(1 << 14).map(own).collect();
    // There is none of fewer than two replicates.
    std_error.resize(mask.len(), 0.0);
    let points = radiance.par_iter_mut().zip(&mut std_error).zip(lit.par_iter().zip(masks)).with_min_len(1 << 14);
    let empty = points.filter(|(_, (lit, mask))| **lit && **mask == Mask::Empty);
    empty.for_each(|((r, e), _)| (*r, *e) = ([0.0; 3], 0.0));
    IlluminationGrid { radiance, std_error, mask, split: None }
}
