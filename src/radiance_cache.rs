//! The radiance that a gather ray finds where it lands: reflected light cached at the lattice's nodes, per side, and on
//! flats as (u, v, c) textures. Direct light by shadow rays plus photons without their first landings.
//! \[Christensen99\]

mod openings;
mod flats;
mod pools;

use crate::brdf::reflected;
use crate::checkpoint;
use crate::direct::{Receiver, direct_irradiance};
use crate::field::Field;
use crate::flat::{self, FlatTexture};
use crate::flattened::{Departure, Side, Target};
use crate::mask::{Mask, masks, stand_ins};
use crate::nearest::Neighbours;
use crate::node_set::NodeSet;
use crate::photon::{Photons, SurfacePhoton};
use crate::photon_map::{EstimateSettings, PhotonMap};
use crate::rng::Stage;
use crate::scene::Scene;
use crate::tracer::Tracer;
use flats::{ByFlat, fill_flat};
use glam::DVec3;
use pools::Pools;
use rayon::prelude::*;
use std::ops::RangeInclusive;
use std::sync::atomic::{AtomicU64, Ordering};

/// How the cache is filled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CacheSettings {
    /// Shadow rays per node and luminaire; with two, what is reflected among many surfaces is 3 % too dark.
    pub node_shadow_rays: u32,
    /// Shadow rays per texel of a flat and luminaire.
    pub flat_shadow_rays: u32,
    /// Texels along the longer edge of a flat.
    pub flat_resolution: usize,
    /// Texels along the isovalue.
    pub isovalue_resolution: usize,
    /// Seed of the run.
    pub seed: u64,
}

/// What a white surface would reflect at the nodes of a field's lattice, per side (lower, higher); `None` where nothing
/// looks.
type Nodes = [Option<Vec<[f32; 3]>>; 2];

/// The nodes of one field that are filled.
struct FieldNodes {
    /// Those that hold something.
    filled: NodeSet,
    /// Those that have room: if most are filled, all of them, which makes lookups faster.
    stored: NodeSet,
    sides: Nodes,
}

/// From what a field's nodes are lit, besides luminaires: the photons that land later than first, per side (lower,
/// higher); `None` where nothing looks.
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

    /// Nodes from which surfaces with isovalues in `band` are interpolated.
    fn needed(&self, field: &Field, band: &RangeInclusive<f32>) -> NodeSet {
        let whole = *band.start() <= 0.0 && *band.end() >= 1.0;
        let (lo, hi) = (band.start() - MARGIN, band.end() + MARGIN);
        let straddled = |o: usize| {
            let [least, most] = field.range_around(o);
            least <= hi && most >= lo
        };
        NodeSet::new(self.masks.len(), |o| self.masks[o] != Mask::Empty && (whole || straddled(o)))
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

/// Isovalues beyond a band, in units of the sweep, whose cells a hit may be rounded into.
const MARGIN: f32 = 1e-4;

/// Outgoing radiance (reflected and, for emitting level sets, emitted) wherever a gather ray can land.
pub struct RadianceCache {
    /// Per field and side (lower, higher): what a white surface would reflect at each node, NaN where neither the node
    /// nor its surroundings hold a surface. The albedo is that of the hit: isovalues may differ much from node to node.
    nodes: Vec<Option<FieldNodes>>,
    /// What gather rays find: photons under the narrowest kernel, since many rays average their noise.
    flats: Vec<Option<FlatTexture>>,
    /// What those from within solids find, if not the same.
    within: Vec<Option<FlatTexture>>,
    /// What pictures show, if not the same: photons smoothed until their noise is not seen.
    shown: Option<Vec<Option<FlatTexture>>>,
    /// Rays traced to fill it.
    pub rays: u64,
}

impl RadianceCache {
    /// Fills the cache: flats always, nodes if `with_nodes` (a gather needs them, pictures of walls do not). `tick(n)`
    /// reports n nodes done; returning false stops early. `saved`: where the blocks of nodes of each side (lower,
    /// higher) are kept and looked for.
    #[allow(clippy::too_many_arguments, reason = "one call per bake")]
    pub fn new<T: Tracer>(
        scene: &Scene,
        tracer: &T,
        photons: &Photons,
        estimate: EstimateSettings,
        settings: &CacheSettings,
        with_nodes: bool,
        saved: [checkpoint::Stage<'_>; 2],
        tick: &(dyn Fn(u64) -> bool + Sync),
    ) -> Self {
        let rays = AtomicU64::new(0);
        let photons_of = ByFlat::new(&photons.flat, flat::count(scene));
        let pools = Pools::new(scene, settings.flat_resolution);
        let filled = (0..flat::count(scene)).into_par_iter().map(|n| {
            let photons = pools.of(n).flat_map(|m| photons_of.flat(m));
            let filled = fill_flat(scene, tracer, n, photons, pools.area(scene, n), settings, &rays);
            (filled.gathered, (filled.within, filled.shown))
        });
        let (flats, (within, shown)) = filled.unzip();
        let nodes = (0..scene.fields()).map(|_| None).collect();
        let mut cache = Self { nodes, flats, within, shown: Some(shown), rays: rays.into_inner() };
        if with_nodes {
            cache.fill(scene, tracer, photons, estimate, settings, saved, tick);
        }
        cache
    }

    /// Fills the nodes of the scene's own field; of a scene of several, seen from each in turn.
    #[allow(clippy::too_many_arguments, reason = "one call per bake and field")]
    pub fn fill<T: Tracer>(
        &mut self,
        scene: &Scene,
        tracer: &T,
        photons: &Photons,
        estimate: EstimateSettings,
        settings: &CacheSettings,
        saved: [checkpoint::Stage<'_>; 2],
        tick: &(dyn Fn(u64) -> bool + Sync),
    ) {
        let source = NodePhotons::new(scene, photons, estimate);
        self.fill_band(scene, tracer, &source, 0.0..=1.0, settings, saved, 0, tick);
    }

    /// Fills the nodes that surfaces with isovalues in `band` need, and forgets the others; what was filled before is
    /// not computed again. `first` is the number of the band's first block.
    #[allow(clippy::too_many_arguments, reason = "one call per band and field")]
    pub fn fill_band<T: Tracer>(
        &mut self,
        scene: &Scene,
        tracer: &T,
        source: &NodePhotons<'_>,
        band: RangeInclusive<f32>,
        settings: &CacheSettings,
        saved: [checkpoint::Stage<'_>; 2],
        first: usize,
        tick: &(dyn Fn(u64) -> bool + Sync),
    ) {
        let rays = AtomicU64::new(0);
        let points = scene.lattice().len();
        let filled = source.needed(&scene.field, &band);
        // Of a whole sweep most nodes are filled as a rule; a band is to be small.
        let stored = match band.contains(&0.0) && band.contains(&1.0) && 2 * filled.len() > points {
            true => NodeSet::all(points),
            false => filled.clone(),
        };
        let mut old = self.nodes[scene.number()].take();
        let fill = Fill { scene, tracer, settings, filled: &filled, stored: &stored, first, tick, rays: &rays };
        let sides = [Side::Lower, Side::Higher].map(|side| {
            let before = old.as_mut().and_then(|old| old.sides[side.index()].take());
            let before = old.as_ref().zip(before.as_deref());
            Some(fill.side(side, source.map(side)?, before, saved[side.index()]))
        });
        self.nodes[scene.number()] = Some(FieldNodes { filled, stored, sides });
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

    /// A cache of light known already: per side (lower, higher) irradiance / π at the nodes of the scene's lattice, NaN
    /// where unknown, and the flats' radiance.
    pub fn from_parts(nodes: Nodes, flats: Vec<Option<FlatTexture>>) -> Self {
        let points = nodes.iter().flatten().map(Vec::len).next();
        let nodes = points.map(|n| FieldNodes { filled: NodeSet::all(n), stored: NodeSet::all(n), sides: nodes });
        let within = vec![None; flats.len()];
        Self { nodes: vec![nodes], flats, within, shown: None, rays: 0 }
    }

    /// Outgoing radiance where a ray of hyperplane `isovalue` landed, without what luminaires emit. `within`: whether
    /// it comes from within a solid, where flats have light of their own. Counts up `misses` if no node of the cell is
    /// filled.
    pub fn lookup(
        &self,
        scene: &Scene,
        (target, within): (Target, bool),
        position: DVec3,
        isovalue: f32,
        misses: &mut u64,
    ) -> DVec3 {
        match target {
            Target::Surface(side) => {
                let surface = &scene.surface;
                let white = self.white(scene.number(), &scene.field, side, position, misses);
                surface.albedo.at(f64::from(isovalue)) * white + surface.emission
            }
            Target::Companion(n, side) => {
                let c = &scene.companions()[usize::from(n)];
                let surface = &c.member.surface;
                let white = self.white(c.number, &c.member.field, side, c.to_index(position), misses);
                surface.albedo.at(f64::from(isovalue)) * white + surface.emission
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
        let within = if within { self.within[number].as_ref() } else { None };
        within.or(self.flats[number].as_ref()).map_or(DVec3::ZERO, |t| t.lookup([u, v, f64::from(isovalue)]))
    }

    /// What a white surface of field `number` would reflect: trilinear over the filled nodes of the cell.
    fn white(&self, number: usize, field: &Field, side: Side, position: DVec3, misses: &mut u64) -> DVec3 {
        let Some(nodes) = self.nodes.get(number).and_then(Option::as_ref) else { return DVec3::ZERO };
        let Some(values) = nodes.sides[side.index()].as_ref() else { return DVec3::ZERO };
        let ([i, j, k], u) = field.locate(position);
        let (mut sum, mut weight) = (DVec3::ZERO, 0.0);
        for row in 0..4 {
            let [y, z] = [row & 1, row >> 1];
            let across = (if y == 1 { u.y } else { 1.0 - u.y }, if z == 1 { u.z } else { 1.0 - u.z });
            let slots = nodes.stored.pair(field.lattice().offset(i, j + y, k + z));
            for (slot, along) in slots.into_iter().zip([1.0 - u.x, u.x]) {
                let Some(value) = slot.map(|slot| values[slot]).filter(|v| !v[0].is_nan()) else { continue };
                // 1e-6 keeps a hit at a node without surface on the others.
                let w = along * across.0 * across.1 + 1e-6;
                sum += w * DVec3::from_array(value.map(f64::from));
                weight += w;
            }
        }
        if weight > 0.0 {
            return sum / weight;
        }
        // Level sets just outside the sweep run beside its cells.
        for reach in 1..=BESIDE {
            let dims = field.lattice().dims();
            let range = |a: usize, n: usize| a.saturating_sub(reach)..=(a + 1 + reach).min(n - 1);
            for z in range(k, dims[2]) {
                for y in range(j, dims[1]) {
                    for x in range(i, dims[0]) {
                        let slot = nodes.stored.slot(field.lattice().offset(x, y, z));
                        if let Some(value) = slot.map(|slot| values[slot]).filter(|v| !v[0].is_nan()) {
                            sum += DVec3::from_array(value.map(f64::from));
                            weight += 1.0;
                        }
                    }
                }
            }
            if weight > 0.0 {
                return sum / weight;
            }
        }
        *misses += 1;
        DVec3::ZERO
    }

    /// The flats' radiance textures; `None` for flats that reflect nothing.
    pub fn flats(&self) -> &[Option<FlatTexture>] {
        &self.flats
    }

    /// The flats' textures for pictures, without the rest.
    pub fn into_shown_flats(self) -> Vec<Option<FlatTexture>> {
        self.shown.unwrap_or(self.flats)
    }
}

/// So many steps beside a cell without filled nodes some are looked for. (A fluid's points just outside the sweep send
/// a few rays in a hundred beyond 2 steps, one in a hundred beyond 5.)
const BESIDE: usize = 5;

/// Nodes of the lattice per block.
const ROW: usize = 4096;

/// One filling of a field's nodes.
struct Fill<'a, T> {
    scene: &'a Scene,
    tracer: &'a T,
    settings: &'a CacheSettings,
    filled: &'a NodeSet,
    stored: &'a NodeSet,
    first: usize,
    tick: &'a (dyn Fn(u64) -> bool + Sync),
    rays: &'a AtomicU64,
}

impl<T: Tracer> Fill<'_, T> {
    /// The light of one side's nodes; what was there `before` is taken over.
    fn side(
        &self,
        side: Side,
        map: &PhotonMap<'_>,
        before: Option<(&FieldNodes, &[[f32; 3]])>,
        saved: checkpoint::Stage<'_>,
    ) -> Vec<[f32; 3]> {
        let mut nodes = vec![[f32::NAN; 3]; self.stored.len()];
        let known = |o: usize| {
            let (old, values) = before.filter(|(old, _)| old.filled.contains(o))?;
            Some(values[old.stored.slot(o)?])
        };
        let points = self.scene.lattice().len();
        let rows = self.stored.split(&mut nodes, ROW);
        rows.into_par_iter().enumerate().with_max_len(1).for_each(|(row, out)| {
            if !(self.tick)(0) {
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
            let block = self.first + row;
            if let Some(bytes) = saved.load(block, 8 + 12 * new.len()) {
                let (traced, values) = bytes.split_first_chunk().expect("8 bytes and more");
                self.rays.fetch_add(u64::from_le_bytes(*traced), Ordering::Relaxed);
                let mut numbers = values.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b));
                for &o in &new {
                    out[slot(o)] = std::array::from_fn(|_| numbers.next().unwrap_or(f32::NAN));
                }
            } else {
                let (mut scratch, mut traced) = (Neighbours::default(), 0);
                for &o in &new {
                    out[slot(o)] = self.node(o, side, map, &mut scratch, &mut traced);
                }
                self.rays.fetch_add(traced, Ordering::Relaxed);
                saved.save(block, || {
                    let values = new.iter().flat_map(|&o| out[slot(o)]).flat_map(f32::to_le_bytes);
                    traced.to_le_bytes().into_iter().chain(values).collect()
                });
            }
            (self.tick)(new.len() as u64);
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
        let Self { scene, settings, .. } = *self;
        let (mut sum, mut count) = (DVec3::ZERO, 0.0);
        let places = stand_ins::<2>(&scene.field, scene.lattice(), node, settings.seed);
        for (stand_in, p) in places.into_iter().flatten().enumerate() {
            let position = p.as_vec3();
            let Some(normal) = scene.normal(position.as_dvec3(), side) else { continue };
            let isovalue = scene.field.value(position.as_dvec3()) as f32;
            let receiver = Receiver { position, normal, isovalue, departure: Departure::Surface(side) };
            let index = (node as u64 * 2 + stand_in as u64) * 2 + side.index() as u64;
            let key = (settings.seed, Stage::Cache, index);
            let direct = direct_irradiance(scene, self.tracer, &receiver, settings.node_shadow_rays, key);
            *traced += direct.rays;
            let indirect = map.irradiance(&receiver, scratch).mean;
            sum += reflected(DVec3::ONE, direct.mean + indirect);
            count += 1.0;
        }
        if count > 0.0 { (sum / count).as_vec3().to_array() } else { [f32::NAN; 3] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Sweep;
    use crate::scene::{Boundary, Surface};
    use crate::volume::{Lattice, Samples, Volume};

    /// Light at two nodes of a row: beside them their mean, nearest first, and nothing farther off.
    #[test]
    fn cells_beside_filled_nodes_find_the_nearest() {
        let lattice = Lattice::aligned([30, 3, 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let samples = (0..lattice.len()).map(|o| (o % 30) as f32).collect();
        let volume = Volume::new("x", lattice.clone(), Samples::F32(samples)).unwrap();
        let field = Field::new(&volume, Sweep::new(0.0, 29.0).unwrap()).unwrap();
        let surface = Surface { albedo: DVec3::ONE.into(), ..Surface::default() };
        let scene = Scene::new(field, surface, Boundary::Open, Vec::new()).unwrap();
        let mut nodes = vec![[f32::NAN; 3]; lattice.len()];
        nodes[lattice.offset(9, 1, 1)] = [1.0; 3];
        nodes[lattice.offset(9, 2, 1)] = [3.0; 3];
        let cache = RadianceCache::from_parts([Some(nodes), None], Vec::new());
        let look = |x: f64| {
            let mut misses = 0;
            let at = DVec3::new(x, 0.5, 0.5);
            let found = cache.lookup(&scene, (Target::Surface(Side::Lower), false), at, 0.5, &mut misses).x;
            (found, misses)
        };
        // In the cell; one step off; both nodes in reach; out of reach.
        assert_eq!([8.5, 10.5, 12.5, 14.5, 15.5].map(look), [(1.0, 0), (2.0, 0), (2.0, 0), (2.0, 0), (0.0, 1)]);
    }
}
