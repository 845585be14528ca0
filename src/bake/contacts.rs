//! Grid points where level sets meet a wall on Ω's faces. Light falls like a power of the distance there, far below a
//! texel of the wall, and a point on the face itself would see a texel's mean at its very own place.
//!
//! At the contact the hemisphere of either surface is cut in two: directions into the wedge between them, and
//! directions that meet the other one at distance 0. With N the surface's normal, M the wall's, a share F = (1 − N·M)/2
//! of either irradiance comes from the other surface, so that E = D + F ρ_w E_w and E_w = D_w + F ρ E, D being what the
//! wedge brings: two equations for E and E_w. \[Lambert1760\]

use super::BakeSettings;
use super::grid_points::STAND_INS;
use crate::direct::{Receiver, direct_irradiance, luminance, luminous_reflectance};
use crate::flattened::{Departure, Side, SurfacePoint, Target};
use crate::gather::gathered_irradiance;
use crate::illumination_grid::IlluminationGrid;
use crate::mask::{Mask, local_position};
use crate::polygon::Polygon;
use crate::progress::Tick;
use crate::radiance::Counts;
use crate::radiance_cache::RadianceCache;
use crate::rng::Stage;
use crate::scene::{ON, Scene};
use crate::tracer::Tracer;
use crate::volume::Lattice;
use glam::DVec3;
use rayon::prelude::*;
use std::f64::consts::PI;

/// Walls that a point can lie on.
const MOST: usize = 3;
/// The share of light between two surfaces that they keep, at most.
const MOST_KEPT: f64 = 0.99;

/// Lattice points on walls that reflect.
pub(super) struct Contacts<'a> {
    scene: &'a Scene,
    lattice: &'a Lattice,
    /// Points in rising order, and the walls each lies on.
    points: Vec<(usize, [Option<u32>; MOST])>,
}

/// The shares of the engine's gather and shadow rays that a wall takes at a contact: only a part of what arrives there
/// is seen again.
const SHARES: [u32; 2] = [2, 4];

/// How light at contacts is gathered.
pub(super) struct Wedge<'a, T> {
    tracer: &'a T,
    cache: &'a RadianceCache,
    gather_rays: u32,
    shadow_rays: u32,
    seed: u64,
}

impl<'a, T> Wedge<'a, T> {
    pub(super) fn new(tracer: &'a T, cache: &'a RadianceCache, settings: &BakeSettings) -> Self {
        let [gather_rays, shadow_rays] =
            [settings.gather_rays / SHARES[0], settings.shadow_rays / SHARES[1]].map(|rays| rays.max(2));
        Self { tracer, cache, gather_rays, shadow_rays, seed: settings.seed }
    }
}

/// Whether a wall comes within a voxel of Ω's faces, or is outside.
fn is_by_a_face(wall: &Polygon, lattice: &Lattice) -> bool {
    let beside = |x: DVec3| x.cmplt(DVec3::ONE).any() || x.cmpgt(lattice.far() - 1.0).any();
    wall.vertices().iter().any(|&x| beside(lattice.to_index(x)))
}

/// What a white surface reflects at a contact.
struct Solved {
    light: DVec3,
    /// What errors of the light that was there before are multiplied by.
    gain: f64,
    /// The variance that is new, of the luminance that leaves.
    variance: f64,
}

impl<'a> Contacts<'a> {
    /// The points of `lattice` that `holds` picks and that lie on walls. None if Ω's faces are capped.
    #[allow(clippy::cast_possible_truncation, reason = "fewer than 2¹⁶ polygons")]
    pub(super) fn new(scene: &'a Scene, lattice: &'a Lattice, holds: impl Fn(usize) -> bool + Sync) -> Self {
        let near = ON * lattice.spacing().min_element();
        let dims = lattice.dims();
        let centre = lattice.to_world(0.5 * lattice.far());
        let walls: Vec<u32> = (0..scene.polygons().len() as u32)
            .filter(|&w| {
                let wall = &scene.polygons()[w as usize];
                wall.albedo != DVec3::ZERO && !scene.is_capped() && is_by_a_face(wall, lattice)
            })
            .collect();
        let touching = |o: usize| {
            let x = scene.lattice().to_world(local_position(&scene.field, lattice, o));
            let touches = |w: &u32| {
                let wall = &scene.polygons()[*w as usize];
                wall.is_nearer(x, near) && (centre - x).dot(wall.normal()) > 0.0
            };
            let mut touched = walls.iter().copied().filter(touches);
            let found: [Option<u32>; MOST] = std::array::from_fn(|_| touched.next());
            // Behind a luminaire that covers the wall it is dark.
            found[0].filter(|_| !scene.covers(x)).map(|_| (o, found))
        };
        let [nx, ny, nz] = dims;
        let rows = if walls.is_empty() { 0 } else { ny * nz };
        // Of a row within Ω both ends are on its faces.
        let on_faces = |row: usize| {
            let within = (1..ny - 1).contains(&(row % ny)) && (1..nz - 1).contains(&(row / ny));
            (0..nx).step_by(if within { nx - 1 } else { 1 }).map(move |i| row * nx + i)
        };
        let points = (0..rows).into_par_iter().with_min_len(16).flat_map_iter(on_faces);
        let points = points.filter(|&o| holds(o)).filter_map(touching).collect();
        Self { scene, lattice, points }
    }

    pub(super) fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether point `o` is one.
    pub(super) fn holds(&self, o: usize) -> bool {
        self.points.binary_search_by_key(&o, |p| p.0).is_ok()
    }

    /// Solves for the light of `side` at those points of `grid` that `holds` picks and that hold light, which was
    /// gathered with walls as their textures show them, as the cache of `wedge` does. Of channels that points do not
    /// reflect nothing is known, nor needed.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    pub(super) fn solve<T: Tracer>(
        &self,
        grid: &mut IlluminationGrid,
        holds: impl Fn(usize) -> bool + Sync,
        side: Side,
        wedge: &Wedge<T>,
        tick: Tick,
    ) -> Counts {
        let surface = &self.scene.surface;
        let albedo = |o: usize| {
            let p = local_position(&self.scene.field, self.lattice, o);
            surface.albedo.at(self.scene.field.value(p))
        };
        let light = |o: usize| {
            let albedo = albedo(o);
            let reflected = (DVec3::from_array(grid.radiance[o].map(f64::from)) - surface.emission).max(DVec3::ZERO);
            let lit = grid.mask[o] != Mask::Empty && holds(o);
            lit.then(|| DVec3::select(albedo.cmpgt(DVec3::ZERO), reflected / albedo, DVec3::ZERO))
        };
        let mut total = Counts::default();
        for (o, Solved { light, gain, variance }, counts) in self.solved(side, wedge, light, tick) {
            grid.radiance[o] = (albedo(o) * light + surface.emission).as_vec3().to_array();
            grid.std_error[o] = (gain * f64::from(grid.std_error[o])).hypot(variance.sqrt()) as f32;
            total += counts;
        }
        total
    }

    /// Points for which `white` says what a white surface would reflect, and what it does.
    fn solved<T: Tracer>(
        &self,
        side: Side,
        wedge: &Wedge<T>,
        white: impl Fn(usize) -> Option<DVec3> + Sync,
        tick: Tick,
    ) -> Vec<(usize, Solved, Counts)> {
        let solve = |&(o, walls): &(usize, [Option<u32>; MOST])| {
            if !tick(1) {
                return None;
            }
            let mut counts = Counts::default();
            let mut solved = Solved { light: white(o)?, gain: 1.0, variance: 0.0 };
            for (n, wall) in walls.into_iter().flatten().enumerate() {
                let met = self.meet((o, side), (n, wall), wedge, solved.light, &mut counts)?;
                let variance = met.gain * met.gain * solved.variance + met.variance;
                solved = Solved { light: met.light, gain: solved.gain * met.gain, variance };
            }
            Some((o, solved, counts))
        };
        self.points.par_iter().with_max_len(64).filter_map(solve).collect()
    }

    /// What a white surface would reflect at point `o` on `wall`, the `n`th of its walls, if it would reflect `white`
    /// with that wall as its texture shows it, and the variance that this adds to the luminance that leaves. `None`
    /// where ∇h vanishes, or where a cell holds no surface, since a sample is not finite: what meets the wall there is
    /// no edge.
    #[allow(clippy::cast_possible_truncation, reason = "positions and isovalues are f32")]
    fn meet<T: Tracer>(
        &self,
        (o, side): (usize, Side),
        (n, wall): (usize, u32),
        wedge: &Wedge<T>,
        white: DVec3,
        counts: &mut Counts,
    ) -> Option<Solved> {
        let scene = self.scene;
        let Wedge { tracer, cache, gather_rays, shadow_rays, seed } = *wedge;
        let x = local_position(&scene.field, self.lattice, o);
        let isovalue = scene.field.is_whole_around(x).then(|| scene.field.value(x) as f32)?;
        let polygon = &scene.polygons()[wall as usize];
        // The share of either hemisphere that the other surface fills. \[Lambert1760\]
        let share = 0.5 * (1.0 - scene.normal(x, side)?.dot(polygon.normal()));
        let receiver = Receiver {
            position: x.as_vec3(),
            normal: polygon.normal(),
            isovalue,
            // The level set: what of the wall's hemisphere it fills is met at distance 0.
            departure: Departure::Surface(side),
        };
        let index = ((STAND_INS * o + 1 + n) * 2 + side.index()) as u64;
        let direct = direct_irradiance(scene, tracer, &receiver, shadow_rays, Stage::Direct.key(seed, index));
        let gathered =
            gathered_irradiance(scene, tracer, cache, &receiver, gather_rays, Stage::Gather.key(seed, index)).estimate;
        counts.rays += direct.rays + gathered.rays;
        counts.misses += gathered.misses;
        let within = scene.leaves_within(receiver.departure);
        let seen = |target| SurfacePoint { target, within, position: x, isovalue };
        let shown = cache.lookup(scene, seen(Target::Polygon(wall)), &mut counts.misses);
        let level_set = scene.surface.albedo.at(f64::from(isovalue));
        // D_w/π, without what the level set reflects onto the wall by what the cache says.
        let touched = cache.lookup(scene, seen(Target::Surface(side)), &mut counts.misses);
        let reflects = touched - scene.surface.emission;
        let opening = ((direct.mean + gathered.mean) / PI - share * reflects).max(DVec3::ZERO);
        // Of white surfaces that touch face to face nothing would ever be lost.
        let lost = 1.0 - (share * share * polygon.albedo * level_set).min(DVec3::splat(MOST_KEPT));
        let met = (white + share * (polygon.albedo * opening - shown)) / lost;
        let seen_again = level_set * share * polygon.albedo / lost;
        let variance_of = |e: DVec3, variance: f64| variance * (luminous_reflectance(seen_again, e) / PI).powi(2);
        // By the channels' shares of the light that is there.
        let (before, after) = (luminance(white), luminance(white / lost));
        let gain = if before > 0.0 { after / before } else { 1.0 };
        let variance = variance_of(direct.mean, direct.variance) + variance_of(gathered.mean, gathered.variance);
        Some(Solved { light: met.max(DVec3::ZERO), gain, variance })
    }
}
