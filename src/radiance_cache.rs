//! The radiance that a gather ray finds where it lands: reflected light cached at the lattice's nodes, per side, and on
//! flats as (u, v, c) textures. Direct light by shadow rays plus photons without their first landings.
//! \[Christensen99\]

mod openings;
mod binned;
mod flats;
mod known;
mod pools;

use crate::brdf::reflected;
use crate::checkpoint::Saved;
use crate::direct::{Receiver, direct_irradiance};
use crate::field::Field;
use crate::flat::{self, FlatLight};
use crate::flattened::{Side, SurfacePoint, Target};
use crate::isovalue_axis::IsovalueAxis;
use crate::mask::{Mask, masks, stand_ins};
use crate::nearest::Neighbours;
use crate::node_set::NodeSet;
use crate::photon::{Photons, SurfacePhoton};
use crate::photon_map::{EstimateSettings, PhotonMap};
use crate::progress::Tick;
use crate::rng::Stage;
use crate::scene::{FieldAt, Scene};
use crate::sharpening::sharpen;
use crate::tracer::Tracer;
use flats::{ByFlat, fill_flat};
use glam::DVec3;
use known::Known;
use pools::Pools;
use rayon::prelude::*;
use std::ops::RangeInclusive;
use std::sync::atomic::{AtomicU64, Ordering};

/// How the cache is filled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CacheSettings {
    /// Shadow rays per node and luminaire; with two, what is reflected among many surfaces is 3 % too dark.
    pub node_shadow_rays: u32,
    /// Shadow rays per texel of a flat and luminaire; four times as many, of at least 32, beside texels that see one in
    /// part.
    pub flat_shadow_rays: u32,
    /// Texels along the longer edge of a flat.
    pub flat_resolution: usize,
    /// Texels along the isovalue.
    pub isovalue_resolution: usize,
    /// Where these stand.
    pub axis: IsovalueAxis,
    /// Seed of the run.
    pub seed: u64,
}

/// What a white surface would reflect at the nodes of a field's lattice, per side (lower, higher); `None` where nothing
/// looks.
type Nodes = [Option<Vec<[f32; 3]>>; 2];

/// The nodes of one field that are filled.
#[derive(Debug)]
struct FieldNodes {
    /// Those that have room: if most are filled, all of them, which makes lookups faster.
    stored: NodeSet,
    /// As they were filled, for the next band to take over.
    filled: Nodes,
    /// What gather rays find: sharpened.
    sides: Nodes,
}

/// From what a field's nodes are lit, besides luminaires: the photons that land later than first, per side (lower,
/// higher); `None` where nothing looks.
#[derive(Debug)]
pub struct NodePhotons<'a> {
    maps: [Option<PhotonMap<'a>>; 2],
    /// Of the field's lattice.
    masks: Vec<Mask>,
}

impl<'a> NodePhotons<'a> {
    /// Of the scene's own field. A side is filled if photons reach it, or light can: the outside always.
    pub fn new(scene: &'a Scene, photons: &Photons, estimate: EstimateSettings) -> Self {
        let masks = masks(&scene.field, scene.lattice());
        let own = |p: &SurfacePhoton| usize::from(p.field) == scene.number();
        let map = |side: Side| {
            let used = side == scene.surface.outside
                || scene.surface.both_sides
                || photons.surface.par_iter().any(|p| own(p) && p.side == side);
            used.then(|| PhotonMap::new(scene, &photons.surface, side, |p| p.bounces > 0, estimate))
        };
        // Counting photons is one thread's work.
        let (lower, higher) = rayon::join(|| map(Side::Lower), || map(Side::Higher));
        Self { maps: [lower, higher], masks }
    }

    /// The map of one side.
    pub fn map(&self, side: Side) -> Option<&PhotonMap<'a>> {
        self.maps[side.index()].as_ref()
    }

    /// Nodes from which surfaces with isovalues in `band` are interpolated, and those and the ones beside them, against
    /// which they are sharpened.
    fn needed(&self, field: &Field, band: &RangeInclusive<f32>) -> [NodeSet; 2] {
        let (lo, hi) = (band.start() - MARGIN, band.end() + MARGIN);
        [1, 2].map(|steps| {
            let straddled = |o: usize| {
                let [least, most] = field.range_around(o, steps);
                least <= hi && most >= lo
            };
            NodeSet::new(self.masks.len(), |o| self.masks[o] != Mask::Empty && (whole(band) || straddled(o)))
        })
    }

    /// What the nodes of the field's own lattice hold.
    pub fn masks(&self) -> &[Mask] {
        &self.masks
    }

    /// Nodes of all sides that a sweep fills.
    pub fn work(&self) -> u64 {
        let nodes = self.masks.par_iter().filter(|&&m| m != Mask::Empty).count();
        (nodes * self.maps.iter().flatten().count()) as u64
    }
}

/// Isovalues whose nodes are filled at a time, in units of the sweep.
#[derive(Clone, Debug)]
pub struct NodeBand<'a> {
    /// From the lowest to the highest.
    pub range: RangeInclusive<f32>,
    /// Where blocks of the nodes of each side (lower, higher) are kept and looked for.
    pub saved: [Saved<'a>; 2],
}

impl NodeBand<'_> {
    /// The whole sweep, kept nowhere.
    pub const WHOLE: Self = NodeBand { range: 0.0..=1.0, saved: [Saved::NOWHERE; 2] };
}

/// Isovalues beyond a band, in units of the sweep, whose cells a hit may be rounded into.
const MARGIN: f32 = 1e-4;

/// Whether a band is the sweep.
fn whole(band: &RangeInclusive<f32>) -> bool {
    *band.start() <= 0.0 && *band.end() >= 1.0
}

/// Outgoing radiance (reflected and, for emitting level sets, emitted) wherever a gather ray can land.
#[derive(Debug)]
pub struct RadianceCache {
    /// Per field and side (lower, higher): what a white surface would reflect at each node, NaN where neither the node
    /// nor its surroundings hold a surface. The albedo is that of the hit: isovalues may differ much from node to node.
    nodes: Vec<Option<FieldNodes>>,
    /// What gather rays find: photons under the narrowest kernel, since many rays average their noise.
    flats: Vec<Option<FlatLight>>,
    /// What pictures show, if not the same: photons smoothed until their noise is not seen.
    shown: Option<Vec<Option<FlatLight>>>,
    /// Rays traced to fill it.
    pub rays: u64,
}

impl RadianceCache {
    /// A cache of what walls and caps show; its nodes are for [`RadianceCache::fill`]. `tick(n)` reports n of their
    /// [`flat::lit_texels`] done; returning false stops early.
    pub fn new<T: Tracer>(scene: &Scene, tracer: &T, photons: &Photons, settings: &CacheSettings, tick: Tick) -> Self {
        let rays = AtomicU64::new(0);
        let photons_of = ByFlat::new(&photons.flat, flat::count(scene));
        let pools = Pools::new(scene, settings.flat_resolution);
        let filler = Filler { scene, tracer, settings, rays: &rays, tick };
        let filled = (0..flat::count(scene)).into_par_iter().map(|n| {
            let photons = pools.of(n).flat_map(|m| photons_of.flat(m));
            let filled = fill_flat(&filler, n, photons, pools.area(scene, n));
            (filled.gathered, filled.shown)
        });
        let (flats, shown) = filled.unzip();
        let nodes = (0..scene.fields()).map(|_| None).collect();
        Self { nodes, flats, shown: Some(shown), rays: rays.into_inner() }
    }

    /// Fills the nodes of the scene's own field (of a scene of several, seen from each in turn) that surfaces with
    /// isovalues in `band` need, and forgets the others; what was filled before is not computed again. `tick(n)`
    /// reports n nodes done; returning false stops early.
    pub fn fill<T: Tracer>(
        &mut self,
        scene: &Scene,
        tracer: &T,
        source: &NodePhotons<'_>,
        settings: &CacheSettings,
        NodeBand { range: band, saved }: NodeBand<'_>,
        tick: Tick,
    ) {
        let rays = AtomicU64::new(0);
        let (points, dims) = (scene.lattice().len(), scene.lattice().dims());
        let [looked_at, filled] = source.needed(&scene.field, &band);
        // A band is to be small.
        let stored = if whole(&band) { room(points, &filled) } else { filled.clone() };
        let mut old = self.nodes[scene.number()].take();
        if let Some(old) = &mut old {
            old.sides = Nodes::default();
        }
        let filler = &Filler { scene, tracer, settings, rays: &rays, tick };
        let fill = Fill { filler, filled: &filled, stored: &stored };
        let mut light = Nodes::default();
        let sides = Side::BOTH.map(|side| {
            let before = old.as_mut().and_then(|old| old.filled[side.index()].take());
            let before = old.as_ref().zip(before.as_deref()).map(|(old, values)| (&old.stored, values));
            let filled = fill.side(side, source.map(side)?, before, saved[side.index()]);
            let sharpened = sharpen(&stored, &filled, &looked_at, dims, SHARPENING);
            light[side.index()] = (!whole(&band)).then_some(filled);
            Some(sharpened)
        });
        self.nodes[scene.number()] = Some(FieldNodes { stored, filled: light, sides });
        self.rays += rays.into_inner();
    }

    /// Blocks that a band may have.
    pub fn blocks(scene: &Scene) -> usize {
        scene.lattice().len().div_ceil(ROW)
    }

    /// Forgets all nodes: nothing is gathered from them any more.
    pub fn forget_nodes(&mut self) {
        self.nodes.iter_mut().for_each(|n| *n = None);
    }

    /// Which of `points` nodes to store if those are known that `known` picks: these, or all where they are so many
    /// that lookups without their numbers are worth the room.
    pub fn room(points: usize, known: impl Fn(usize) -> bool + Sync) -> NodeSet {
        room(points, &NodeSet::new(points, known))
    }

    /// A cache of light known already: per side (lower, higher) irradiance / π at those nodes of the scene's lattice,
    /// of `dims` nodes along x, y and z, that are `stored` (or it panics), NaN where unknown, and the flats' radiance.
    pub fn from_parts(nodes: Nodes, stored: NodeSet, dims: [usize; 3], flats: Vec<Option<FlatLight>>) -> Self {
        let known = nodes.iter().any(Option::is_some);
        let sides = nodes.map(|side| Some(sharpen(&stored, &side?, &stored, dims, SHARPENING)));
        let nodes = known.then(|| FieldNodes { stored, filled: Nodes::default(), sides });
        Self { nodes: vec![nodes], flats, shown: None, rays: 0 }
    }

    /// Outgoing radiance where a ray landed, without what luminaires emit. Counts up `misses` if no node of the cell is
    /// filled.
    pub fn lookup(&self, scene: &Scene, landed: SurfacePoint, misses: &mut u64) -> DVec3 {
        let SurfacePoint { target, within, position, isovalue } = landed;
        match target {
            Target::Surface(side) | Target::Companion(_, side) => {
                let at = scene.field_at(target.companion(), position);
                let white = self.white(at, side, isovalue, misses);
                at.surface.albedo.at(f64::from(isovalue)) * white + at.surface.emission
            }
            // Rays go on from there.
            Target::Cap(_, Side::Higher) => DVec3::ZERO,
            Target::Cap(face, Side::Lower) => {
                let uv = flat::face_texture(scene, face, position);
                self.flat(flat::cap(scene, face), false, uv, isovalue)
            }
            Target::Polygon(id) => {
                let uv = scene.polygons()[id as usize].texture(scene.lattice().to_world(position));
                self.flat(id as usize, within, uv, isovalue)
            }
        }
    }

    fn flat(&self, number: usize, within: bool, [u, v]: [f64; 2], isovalue: f32) -> DVec3 {
        // Where nobody looked for light nothing receives any.
        let texture = self.flats[number].as_ref().map(|light| light.seen(within).unwrap_or(&light.outside));
        texture.map_or(DVec3::ZERO, |texture| texture.lookup([u, v, f64::from(isovalue)]))
    }

    /// What a white surface of a field would reflect where its level set `isovalue` is.
    fn white(&self, at: FieldAt, side: Side, isovalue: f32, misses: &mut u64) -> DVec3 {
        let FieldAt { number, field, place, .. } = at;
        let Some(nodes) = self.nodes.get(number).and_then(Option::as_ref) else { return DVec3::ZERO };
        let Some(values) = nodes.sides[side.index()].as_ref() else { return DVec3::ZERO };
        let known = Known { field, stored: &nodes.stored, values };
        let (cell, u) = field.locate(place);
        known.between(cell, u, isovalue).or_else(|| known.beside(cell)).unwrap_or_else(|| {
            *misses += 1;
            DVec3::ZERO
        })
    }

    /// The flats' light for pictures, without the rest; `None` for flats that reflect nothing.
    pub fn into_shown_flats(self) -> Vec<Option<FlatLight>> {
        self.shown.unwrap_or(self.flats)
    }
}

/// What a hit finds is interpolated between two nodes along every axis: on average over all places E + E″/12, too
/// bright in hollows, where the next bounce carries it on. So much of their second differences is taken off the nodes.
/// What they hold may be less than black: hits are averaged, and are to be right on average.
const SHARPENING: f32 = 1.0 / 12.0;

/// Nodes of the lattice per block.
const ROW: usize = 4096;

/// With what nodes and flats are filled.
struct Filler<'a, T> {
    scene: &'a Scene,
    tracer: &'a T,
    settings: &'a CacheSettings,
    /// Rays traced.
    rays: &'a AtomicU64,
    tick: Tick<'a>,
}

/// One filling of a field's nodes.
struct Fill<'a, T> {
    filler: &'a Filler<'a, T>,
    filled: &'a NodeSet,
    stored: &'a NodeSet,
}

impl<T: Tracer> Fill<'_, T> {
    /// The light of one side's nodes; what was there `before` is taken over.
    fn side(
        &self,
        side: Side,
        map: &PhotonMap<'_>,
        before: Option<(&NodeSet, &[[f32; 3]])>,
        saved: Saved<'_>,
    ) -> Vec<[f32; 3]> {
        let mut nodes = vec![[f32::NAN; 3]; self.stored.len()];
        let known = |o: usize| {
            let (old, values) = before?;
            Some(values[old.slot(o)?])
        };
        let Filler { scene, rays, tick, .. } = *self.filler;
        let points = scene.lattice().len();
        let rows = self.stored.split(&mut nodes, ROW);
        rows.into_par_iter().enumerate().with_max_len(1).for_each(|(row, out)| {
            if !tick(0) {
                return;
            }
            let range = row * ROW..points.min((row + 1) * ROW);
            let slot = |o: usize| self.stored.before(o) - self.stored.before(row * ROW);
            let mut new = Vec::new();
            for o in self.filled.members(range) {
                match known(o) {
                    Some(value) => out[slot(o)] = value,
                    None => new.push(o),
                }
            }
            if new.is_empty() {
                return;
            }
            if let Some(bytes) = saved.load(row, 8 + 12 * new.len()) {
                let (traced, values) = bytes.split_first_chunk().expect("8 bytes and more");
                rays.fetch_add(u64::from_le_bytes(*traced), Ordering::Relaxed);
                let mut numbers = values.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b));
                for &o in &new {
                    out[slot(o)] = std::array::from_fn(|_| numbers.next().unwrap_or(f32::NAN));
                }
            } else {
                let (mut scratch, mut traced) = (Neighbours::default(), 0);
                for &o in &new {
                    out[slot(o)] = self.node(o, side, map, &mut scratch, &mut traced);
                }
                rays.fetch_add(traced, Ordering::Relaxed);
                saved.save(row, || {
                    let values = new.iter().flat_map(|&o| out[slot(o)]).flat_map(f32::to_le_bytes);
                    traced.to_le_bytes().into_iter().chain(values).collect()
                });
            }
            tick(new.len() as u64);
        });
        nodes
    }

    /// What a white surface would reflect at one node, or beside it.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn node(
        &self,
        node: usize,
        side: Side,
        map: &PhotonMap<'_>,
        scratch: &mut Neighbours,
        traced: &mut u64,
    ) -> [f32; 3] {
        let Filler { scene, tracer, settings, .. } = *self.filler;
        let (mut sum, mut count) = (DVec3::ZERO, 0.0);
        let places = stand_ins::<2>(&scene.field, scene.lattice(), node, settings.seed);
        for (stand_in, p) in places.into_iter().flatten().enumerate() {
            let isovalue = scene.field.value(p.as_vec3().as_dvec3()) as f32;
            let Some(receiver) = Receiver::on_level_set(scene, p, isovalue, side) else { continue };
            let index = (node as u64 * 2 + stand_in as u64) * 2 + side.index() as u64;
            let key = Stage::Cache.key(settings.seed, index);
            let direct = direct_irradiance(scene, tracer, &receiver, settings.node_shadow_rays, key);
            *traced += direct.rays;
            let indirect = map.irradiance(&receiver, scratch).mean;
            sum += reflected(DVec3::ONE, direct.mean + indirect);
            count += 1.0;
        }
        if count > 0.0 { (sum / count).as_vec3().to_array() } else { [f32::NAN; 3] }
    }
}

/// The nodes to store if `known` ones are: of a whole sweep most are known as a rule, and all are looked up faster.
fn room(points: usize, known: &NodeSet) -> NodeSet {
    if 2 * known.len() > points { NodeSet::all(points) } else { known.clone() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Sweep;
    use crate::scene::{Boundary, Surface};
    use crate::volume::{Lattice, Samples, Volume};

    /// A scene whose level sets are planes, a few in every cell.
    fn planes() -> Scene {
        let lattice = Lattice::aligned([9, 9, 9], DVec3::ZERO, DVec3::ONE).unwrap();
        let at = |o: usize| lattice.ijk(o).map(|i| i as f64);
        let samples = (0..lattice.len()).map(|o| (at(o)[0] + 0.9 * at(o)[1] + 1.1 * at(o)[2]) as f32).collect();
        let field = Field::made(lattice.clone(), Samples::F32(samples), 0.0, 24.0);
        Scene::new(field, Surface { albedo: DVec3::ONE.into(), ..Surface::default() }, Boundary::Open, vec![]).unwrap()
    }

    fn on_surface(position: DVec3, isovalue: f32) -> SurfacePoint {
        SurfacePoint { target: Target::Surface(Side::Lower), within: false, position, isovalue }
    }

    /// On one level set light is read between nodes as it is, along each axis alike.
    #[test]
    fn light_is_linear_between_nodes_of_one_isovalue() {
        let lattice = Lattice::aligned([4, 5, 6], DVec3::ZERO, DVec3::ONE).unwrap();
        let volume = Volume::new("x", lattice.clone(), Samples::F32(vec![0.5; lattice.len()])).unwrap();
        let field = Field::new(&volume, Sweep::new(0.0, 1.0).unwrap()).unwrap();
        let scene =
            Scene::new(field, Surface { albedo: DVec3::ONE.into(), ..Surface::default() }, Boundary::Open, vec![]);
        let scene = scene.unwrap();
        let light = |p: DVec3| 1.0 + p.dot(DVec3::new(0.1, 0.3, 0.7));
        let at = |o: usize| lattice.point(o);
        let nodes: Vec<_> = (0..lattice.len()).map(|o| [light(at(o)) as f32; 3]).collect();
        let stored = NodeSet::all(nodes.len());
        let field = FieldNodes { stored, filled: Nodes::default(), sides: [Some(nodes), None] };
        let cache = RadianceCache { nodes: vec![Some(field)], flats: vec![], shown: None, rays: 0 };
        for p in [DVec3::new(0.2, 0.3, 0.9), DVec3::new(2.9, 1.5, 2.1), DVec3::new(1.5, 3.9, 4.5)] {
            let found = cache.lookup(&scene, on_surface(p, 0.5), &mut 0).x;
            assert!((found - light(p)).abs() < 2e-5, "{p}: {found} {}", light(p));
        }
    }

    /// Σ|found − there| and Σ|trilinear − there| over places whose light is a function of the isovalue.
    fn off(light: impl Fn(f64) -> f64) -> [f64; 2] {
        let scene = planes();
        let nodes: Vec<_> = scene.field.samples().iter().map(|h| [light(f64::from(*h)) as f32; 3]).collect();
        let stored = NodeSet::all(nodes.len());
        let field = FieldNodes { stored, filled: Nodes::default(), sides: [Some(nodes.clone()), None] };
        let cache = RadianceCache { nodes: vec![Some(field)], flats: vec![], shown: None, rays: 0 };
        let mut rng = crate::rng::Rng::stream(5, Stage::Test, 0);
        let (mut sums, mut misses) = ([0.0; 2], 0);
        for _ in 0..20_000 {
            let x = 8.0 * DVec3::new(rng.unit(), rng.unit(), rng.unit());
            let h = scene.field.value(x);
            let found = cache.lookup(&scene, on_surface(x, h as f32), &mut misses).x;
            let ([i, j, k], u) = scene.field.locate(x);
            let trilinear: f64 = (0..8)
                .map(|n| {
                    let at = [n & 1, n >> 1 & 1, n >> 2];
                    let w: f64 = (0..3).map(|a| if at[a] == 1 { u[a] } else { 1.0 - u[a] }).product();
                    w * f64::from(nodes[scene.lattice().offset(i + at[0], j + at[1], k + at[2])][0])
                })
                .sum();
            sums[0] += (found - light(h)).abs();
            sums[1] += (trilinear - light(h)).abs();
        }
        assert_eq!(misses, 0);
        sums
    }

    /// Where one level set is lit and the next one is not a hit finds the light of its own; what grows evenly is found
    /// about as closely as by trilinear weights.
    #[test]
    fn hits_find_the_light_of_their_own_level_set() {
        let edge = off(|h| if h < 0.5 { 0.0 } else { 1.0 });
        let even = off(|h| h.powi(6));
        println!("off by {edge:.1?} at an edge, {even:.1?} of what grows evenly (without and with trilinear weights)");
        assert!(edge[0] < 0.6 * edge[1], "{edge:?}");
        assert!(even[0] < 1.5 * even[1], "{even:?}");
    }

    /// Light at two nodes of a row: beside them their mean, nearest first, and nothing farther off.
    #[test]
    fn cells_beside_filled_nodes_find_the_nearest() {
        let lattice = Lattice::aligned([30, 3, 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let samples = (0..lattice.len()).map(|o| (o % 30) as f32).collect();
        let field = Field::made(lattice.clone(), Samples::F32(samples), 0.0, 29.0);
        let surface = Surface { albedo: DVec3::ONE.into(), ..Surface::default() };
        let scene = Scene::new(field, surface, Boundary::Open, Vec::new()).unwrap();
        let mut nodes = vec![[f32::NAN; 3]; lattice.len()];
        nodes[lattice.offset(9, 1, 1)] = [1.0; 3];
        nodes[lattice.offset(9, 2, 1)] = [3.0; 3];
        let stored = NodeSet::all(nodes.len());
        let cache = RadianceCache::from_parts([Some(nodes), None], stored, scene.lattice().dims(), Vec::new());
        let look = |x: f64| {
            let mut misses = 0;
            let at = DVec3::new(x, 0.5, 0.5);
            let found = cache.lookup(&scene, on_surface(at, 0.5), &mut misses).x;
            (found, misses)
        };
        // In the cell; one step off; both nodes in reach; out of reach.
        assert_eq!([8.5, 10.5, 12.5, 14.5, 15.5].map(look), [(1.0, 0), (2.0, 0), (2.0, 0), (2.0, 0), (0.0, 1)]);
    }
}
