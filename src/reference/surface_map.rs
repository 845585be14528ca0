//! A photon map of one isosurface in 3D: irradiance per area of mesh and walls, and final gather from it. \[Jensen01\]

use super::path::PathTracer;
use crate::brdf::reflected;
use crate::direct::Receiver;
use crate::field::Field;
use crate::flattened::{Departure, Side};
use crate::landing::{Landing, landing};
use crate::nearest::{Neighbours, PointGrid};
use crate::photon::Photons;
use crate::rng::{Key, Sobol, Stage};
use crate::scene::{Scene, value_on};
use crate::surface_mesh::SurfaceMesh;
use crate::tracer::Tracer;
use crate::warp::{self, Frame, cosine_hemisphere};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

/// How irradiance is estimated from photons on a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceMapSettings {
    /// Nearest photons per estimate.
    pub photons: usize,
    /// Largest radius, as a fraction of Ω's diagonal.
    pub max_radius: f64,
    /// Least cosine between normals.
    pub cone: f64,
}

impl Default for SurfaceMapSettings {
    fn default() -> Self {
        Self { photons: 64, max_radius: 0.05, cone: 0.7 }
    }
}

/// Points per triangle of the quadrature of ∫_A K dA: the centroids of a 4×4 subdivision.
const CUTS: usize = 4;
/// Points of the unit disk for walls.
const DISK: usize = 64;

/// Photons that were reflected before, on the mesh and on polygons.
#[derive(Debug)]
pub struct SurfaceMap {
    settings: SurfaceMapSettings,
    isovalue: f32,
    origin: DVec3,
    radius: f32,
    /// The scene's own surface, then its companions'.
    surfaces: Vec<MappedSurface>,
    /// One per polygon.
    walls: Vec<Share>,
    disk: Vec<[f64; 2]>,
}

/// Photons of one field's surface, and the surface's area.
#[derive(Debug)]
struct MappedSurface {
    /// One per side (lower, higher).
    sides: [Share; 2],
    area_grid: PointGrid,
    /// Slot order of `area_grid`: area and lower normal.
    areas: Vec<(f32, Vec3)>,
}

/// Photons of one side or polygon.
#[derive(Debug)]
struct Share {
    grid: PointGrid,
    /// Slot order.
    photons: Vec<Mapped>,
}

/// A photon.
#[derive(Clone, Copy, Debug)]
struct Mapped {
    power: Vec3,
    on: On,
}

/// What a photon landed on.
#[derive(Clone, Copy, Debug)]
enum On {
    /// A surface with this lower normal.
    Surface(Vec3),
    /// A wall, where it lies so of the level sets: see [`higher`].
    Wall(u32),
}

impl On {
    /// Whether photons there tell of what is here: a surface of a similar normal, or a wall on the same side of all
    /// level sets.
    fn tells_of(self, here: Self, cone: f32) -> bool {
        match (self, here) {
            (On::Surface(there), On::Surface(here)) => there.dot(here) >= cone,
            (On::Wall(there), On::Wall(here)) => there == here,
            _ => false,
        }
    }
}

/// On which side of each field's level set a local point lies, as bits.
fn higher(scene: &Scene, isovalue: f32, p: DVec3) -> u32 {
    let higher_in = |field: &Field, p: DVec3| value_on(field, p) >= f64::from(isovalue);
    let others = scene.companions().iter().map(|c| higher_in(&c.member.field, c.to_index(p)));
    others.fold(u32::from(higher_in(&scene.field, p)), |bits, higher| bits << 1 | u32::from(higher))
}

impl Share {
    /// Of photons and where they landed.
    fn new(items: &[(Vec3, Mapped)]) -> Self {
        let grid = PointGrid::new(&items.iter().map(|i| i.0).collect::<Vec<_>>(), 3.0);
        let photons = grid.numbers().iter().map(|&n| items[n as usize].1).collect();
        Self { grid, photons }
    }
}

impl MappedSurface {
    /// Maps the photons of the own field of `scene`; `mesh` is its isosurface.
    fn new(scene: &Scene, mesh: &SurfaceMesh, origin: DVec3, photons: &Photons) -> Self {
        let lattice = scene.lattice();
        let lower = |p: DVec3| scene.normal(p, Side::Lower).unwrap_or_default().as_vec3();
        let sides = Side::BOTH.map(|side| {
            let items: Vec<_> = photons
                .surface
                .par_iter()
                .filter(|p| p.bounces > 0 && p.side == side && usize::from(p.field) == scene.number())
                .map(|p| {
                    let at = p.position.as_dvec3();
                    ((lattice.to_world(at) - origin).as_vec3(), Mapped { power: p.power, on: On::Surface(lower(at)) })
                })
                .collect();
            Share::new(&items)
        });
        let mut points = Vec::with_capacity(mesh.triangles.len() * CUTS * CUTS);
        for t in &mesh.triangles {
            let [a, b, c] = t.map(|v| mesh.positions[v as usize] - origin);
            let [na, nb, nc] = t.map(|v| mesh.normals[v as usize]);
            #[allow(clippy::cast_possible_truncation, reason = "areas are f32")]
            let area = ((b - a).cross(c - a).length() / (2 * CUTS * CUTS) as f64) as f32;
            let outside = scene.surface.outside.facing(1.0);
            for i in 0..CUTS {
                for j in 0..CUTS - i {
                    let mut push = |u: f64, v: f64| {
                        let (u, v) = (u / CUTS as f64, v / CUTS as f64);
                        let n = na.as_dvec3() * (1.0 - u - v) + nb.as_dvec3() * u + nc.as_dvec3() * v;
                        let normal = (outside * n.normalize_or_zero()).as_vec3();
                        points.push(((a + u * (b - a) + v * (c - a)).as_vec3(), area, normal));
                    };
                    let (u, v) = (i as f64, j as f64);
                    push(u + 1.0 / 3.0, v + 1.0 / 3.0);
                    if i + j + 1 < CUTS {
                        push(u + 2.0 / 3.0, v + 2.0 / 3.0);
                    }
                }
            }
        }
        let area_grid = PointGrid::new(&points.iter().map(|p| p.0).collect::<Vec<_>>(), 3.0);
        let areas = area_grid.numbers().iter().map(|&n| (points[n as usize].1, points[n as usize].2)).collect();
        Self { sides, area_grid, areas }
    }
}

impl SurfaceMap {
    /// Maps the photons of one isovalue that were reflected at least once; `mesh` is its isosurface, `companions` are
    /// the scenes seen from each companion with theirs.
    pub fn new(
        scene: &Scene,
        mesh: &SurfaceMesh,
        companions: &[(Scene, SurfaceMesh)],
        isovalue: f32,
        photons: &Photons,
        settings: SurfaceMapSettings,
    ) -> Self {
        let lattice = scene.lattice();
        let origin = scene.bounds()[0];
        let own = MappedSurface::new(scene, mesh, origin, photons);
        let others = companions.iter().map(|(scene, mesh)| MappedSurface::new(scene, mesh, origin, photons));
        let surfaces = [own].into_iter().chain(others).collect();
        let mut landed = vec![Vec::new(); scene.polygons().len()];
        for p in photons.flat.iter().filter(|p| p.bounces > 0) {
            // Caps hold none.
            if let (Some(polygon), Some(items)) =
                (scene.polygons().get(p.flat as usize), landed.get_mut(p.flat as usize))
            {
                let x = polygon.at([f64::from(p.uvc[0]), f64::from(p.uvc[1])]);
                let on = On::Wall(higher(scene, isovalue, lattice.to_index(x)));
                items.push(((x - origin).as_vec3(), Mapped { power: p.power, on }));
            }
        }
        let walls = landed.par_iter().map(|items| Share::new(items)).collect();
        let set = Sobol::set(0, Stage::Footprint, 1 << 20);
        #[allow(clippy::cast_possible_truncation, reason = "64 points")]
        let disk = (0..DISK as u32).map(|i| warp::disk(set.point2(i, 0))).collect();
        let diagonal = lattice.diagonal();
        #[allow(clippy::cast_possible_truncation, reason = "distances are f32")]
        let radius = (settings.max_radius * diagonal) as f32;
        Self { settings, isovalue, origin, radius, surfaces, walls, disk }
    }

    /// Radiance that leaves the surface at `receiver`: direct light, and a final gather of `samples` rays that find
    /// direct light by a shadow ray and the rest in the map. A hit nearer than its kernel reaches would bring the
    /// kernel's bias whole (in a corner half of all rays find the same photons): such rays go on as paths, \[Jensen01\]
    /// and so do those that land on caps.
    pub fn outgoing<T: Tracer>(
        &self,
        paths: &mut PathTracer<'_, T>,
        receiver: &Receiver,
        samples: u32,
        key: Key,
    ) -> DVec3 {
        let (scene, tracer) = (paths.scene, paths.tracer);
        let direct = paths.direct(receiver, samples, key);
        let frame = Frame::new(receiver.normal);
        let set = key.set();
        let (mut scratch, mut sum) = (Neighbours::default(), DVec3::ZERO);
        for i in 0..samples {
            let mut rng = key.nth(i);
            let direction = frame.to_world(cosine_hemisphere(set.point2(i, 2)));
            let ray = scene.ray(receiver.position, direction, receiver.isovalue, receiver.departure);
            paths.rays += 1;
            let Some(hit) = tracer.intersect(&ray) else { continue };
            let Some(Landing { receiver: landed, on, albedo, emission }) = landing(scene, &ray, hit) else { continue };
            sum += emission;
            if albedo != DVec3::ZERO {
                let distance = (scene.lattice().axes() * ray.direction.as_dvec3()).length() * f64::from(hit.t);
                let surface = Receiver { departure: on, ..landed };
                let indirect = match self.irradiance(scene, &surface, &mut scratch) {
                    Some((mapped, radius)) if distance >= radius => mapped,
                    _ => paths.indirect_once(&landed, &mut rng),
                };
                sum += reflected(albedo, paths.direct_once(&landed, &mut rng) + indirect);
            }
        }
        let indirect = sum * (std::f64::consts::PI / f64::from(samples.max(1)));
        reflected(scene.surface.albedo.at(f64::from(receiver.isovalue)), direct + indirect) + scene.surface.emission
    }

    /// Irradiance of reflected photons, and the kernel's radius r: Σ w K / ∫_A K dA with K = 1 − (d/r)², r the distance
    /// of the k-th photon and A what lies within r, on the same side, with a similar normal, on mesh or polygon. `None`
    /// on caps, which hold no photons.
    #[allow(clippy::cast_possible_truncation, reason = "distances are f32")]
    pub fn irradiance(&self, scene: &Scene, at: &Receiver, scratch: &mut Neighbours) -> Option<(DVec3, f64)> {
        let world = scene.lattice().to_world(at.position.as_dvec3());
        let q = (world - self.origin).as_vec3();
        let cone = self.settings.cone as f32;
        let own = &self.surfaces[0];
        let (surface, share, here) = match at.departure {
            Departure::Surface(side) => (own, &own.sides[side.index()], On::Surface(lower_normal(at, side))),
            Departure::Companion(n, side) => {
                let surface = &self.surfaces[usize::from(n) + 1];
                (surface, &surface.sides[side.index()], On::Surface(lower_normal(at, side)))
            }
            Departure::Polygon(id) => {
                (own, &self.walls[id as usize], On::Wall(higher(scene, self.isovalue, at.position.as_dvec3())))
            }
            Departure::Free | Departure::Cap(..) => return None,
        };
        let k = self.settings.photons;
        let accept = |slot: u32| share.photons[slot as usize].on.tells_of(here, cone);
        share.grid.nearest(q, k, self.radius, accept, scratch);
        let found = scratch.found();
        let most = match at.departure {
            // Beyond a small polygon there is nothing to find.
            Departure::Polygon(id) => {
                let [e, f] = scene.polygons()[id as usize].texture_edges();
                self.radius.min((e.length() + f.length()) as f32)
            }
            _ => self.radius,
        };
        // It is dark, as far as that.
        if found.is_empty() {
            return Some((DVec3::ZERO, f64::from(most)));
        }
        let farthest = found.iter().map(|e| e.0).fold(0.0, f32::max);
        let radius = if found.len() < k { most } else { farthest.sqrt() };
        if radius == 0.0 {
            return Some((DVec3::ZERO, 0.0));
        }
        let weight = |d2: f32| f64::from((1.0 - d2 / (radius * radius)).max(0.0));
        let power: DVec3 =
            found.iter().map(|&(d2, slot)| share.photons[slot as usize].power.as_dvec3() * weight(d2)).sum();
        let area = match at.departure {
            Departure::Polygon(id) => self.wall_area(scene, id, world, at, f64::from(radius)),
            _ => {
                let accept = |slot: u32| On::Surface(surface.areas[slot as usize].1).tells_of(here, cone);
                surface.area_grid.nearest(q, usize::MAX, radius, accept, scratch);
                let found = scratch.found();
                found.iter().map(|&(d2, slot)| f64::from(surface.areas[slot as usize].0) * weight(d2)).sum()
            }
        };
        Some((if area > 0.0 { power / area } else { DVec3::ZERO }, f64::from(radius)))
    }

    /// ∫ K dA over the part of the disk on polygon `id` that lies on the receiver's side of the level sets.
    fn wall_area(&self, scene: &Scene, id: u32, world: DVec3, at: &Receiver, radius: f64) -> f64 {
        let (polygon, lattice) = (&scene.polygons()[id as usize], scene.lattice());
        let frame = Frame::new(polygon.normal());
        let side = higher(scene, self.isovalue, at.position.as_dvec3());
        let sum: f64 = self
            .disk
            .iter()
            .filter(|[u, v]| {
                let x = world + frame.to_world(DVec3::new(*u, *v, 0.0)) * radius;
                polygon.contains(x) && higher(scene, self.isovalue, lattice.to_index(x)) == side
            })
            .map(|[u, v]| 1.0 - u * u - v * v)
            .sum();
        sum * std::f64::consts::PI * radius * radius / DISK as f64
    }
}

/// The normal towards the lower side at a receiver on `side`.
fn lower_normal(at: &Receiver, side: Side) -> Vec3 {
    side.facing(at.normal.as_vec3())
}
