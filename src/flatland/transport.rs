//! Light on a height field, one code for both transports: receivers, directions, direct light, paths.

use super::{FlatScene, GraphSurface, LevelCurves, Solution, Transport};
use crate::embree::Device;
use crate::error::Result;
use crate::flattened::{Departure, FlattenedRay, Side, Target};
use crate::luminaire::{point_term, unoccluded};
use crate::polygon::Polygon;
use crate::rng::{Key, Rng, Sobol, Stage};
use crate::tracer::Tracer;
use crate::warp::{Frame, cosine_hemisphere};
use glam::{DVec2, DVec3, Vec3};
use std::fmt;

/// Bisections of the edge of a shadow: 2⁻¹² of a stratum.
const BISECTIONS: usize = 12;

/// A scene under one transport, ready to be asked.
pub struct World {
    /// What is lit.
    pub scene: FlatScene,
    /// How.
    pub transport: Transport,
    tracer: Box<dyn Tracer + Send>,
    /// Luminaires with their upright rectangles (used when ordinary).
    lights: Vec<(u32, Polygon)>,
}

impl fmt::Debug for World {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("World").field("scene", &self.scene).field("transport", &self.transport).finish_non_exhaustive()
    }
}

/// A point that receives light.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Receiver {
    /// Local frame of the tracer: (x, y) in index units, then 0 when flattened, the height in sweep units when
    /// ordinary.
    pub position: Vec3,
    /// Its plane when flattened.
    pub isovalue: f32,
    /// Unit normal in the world, towards the lit side; horizontal when flattened. \[BB09 §2.1: N♭\]
    pub normal: DVec3,
    /// What rays from it start on.
    pub departure: Departure,
}

/// What a ray met, and where, in the coordinates that radiance is stored by.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Landing {
    /// Nothing, or a luminaire, whose light is counted apart.
    Dark,
    /// The graph above index coordinates (x, y).
    Graph(f32, f32, Side),
    /// A wall: number, place along it in [0, 1], height in units of the sweep.
    Wall(u16, f32, f32),
}

/// A vertex of a photon's path, for pictures.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathVertex {
    /// World position, the sweep's height on z.
    pub position: DVec3,
    /// What the path met there; dark at its start and where it left everything.
    pub landing: Landing,
}

/// Irradiance per unit radiance at `x` with unit normal `n` from the segment a–b, over 2: ½ (sin θ₂ − sin θ₁) of the
/// part above the horizon, from either face. 1 where the segment fills the half-plane. \[Heckbert92\]
pub fn unoccluded_share(ends: [DVec2; 2], x: DVec2, n: DVec2) -> f64 {
    sine_range(ends, x, n).map_or(0.0, |(lo, hi)| 0.5 * (hi - lo))
}

/// sin θ about `n` of the part of a segment above the horizon, ascending.
fn sine_range(ends: [DVec2; 2], x: DVec2, n: DVec2) -> Option<(f64, f64)> {
    let tangent = -n.perp();
    let [mut a, mut b] = ends.map(|p| DVec2::new(tangent.dot(p - x), n.dot(p - x)));
    if a.y <= 0.0 && b.y <= 0.0 {
        return None;
    }
    // The horizon's own sine is ±1: the clipped end's sign is the sign of its tangent coordinate.
    let clipped = |inner: DVec2, outer: DVec2| {
        let crossing = inner.x + (outer.x - inner.x) * (inner.y / (inner.y - outer.y));
        DVec2::new(crossing, 0.0)
    };
    if a.y < 0.0 {
        a = clipped(b, a);
    } else if b.y < 0.0 {
        b = clipped(a, b);
    }
    let sine = |p: DVec2| if p.length_squared() > 0.0 { p.x / p.length() } else { 0.0 };
    let (sa, sb) = (sine(a), sine(b));
    (sa != sb).then_some((sa.min(sb), sa.max(sb)))
}

impl World {
    /// Builds the geometry.
    ///
    /// # Errors
    /// `Embree` if the library refuses.
    pub fn new(device: &Device, scene: FlatScene, transport: Transport) -> Result<Self> {
        let tracer: Box<dyn Tracer + Send> = match transport {
            Transport::Flattened => Box::new(LevelCurves::new(device, &scene)?),
            Transport::Ordinary => Box::new(GraphSurface::new(device, &scene)?),
        };
        let mut lights = Vec::new();
        for id in scene.luminaires() {
            let s = &scene.segments[id as usize];
            let [a, b] = s.ends;
            let corners = [(a, 0.0), (a, scene.height), (b, scene.height), (b, 0.0)].map(|(p, z)| p.extend(z)).to_vec();
            let mut light = Polygon::new(&s.name, corners.clone(), s.albedo, s.emission)?;
            if light.normal().truncate().dot(s.normal()) < 0.0 {
                light = Polygon::new(&s.name, corners.into_iter().rev().collect(), s.albedo, s.emission)?;
            }
            lights.push((id, light));
        }
        Ok(Self { scene, transport, tracer, lights })
    }

    /// The geometry.
    pub fn tracer(&self) -> &dyn Tracer {
        &*self.tracer
    }

    /// The receiver on `side` of the graph above index coordinates `p`; `None` where it has no normal (∇h = 0 when
    /// flattened) or no value.
    pub fn graph_receiver(&self, p: DVec2, side: Side) -> Option<Receiver> {
        let field = &self.scene.field;
        // As the ray will start, so that both agree where that is.
        let p = p.clamp(DVec2::ZERO, field.far()).as_vec2();
        let g = field.receiver_gradient(p.as_dvec2());
        let isovalue = field.value(p.as_dvec2());
        if !isovalue.is_finite() || !g.is_finite() {
            return None;
        }
        let scale = g.abs().max_element();
        let (falling, z) = match self.transport {
            Transport::Flattened if scale > 0.0 => ((-g / scale).normalize().extend(0.0), 0.0),
            Transport::Flattened => return None,
            Transport::Ordinary => {
                let (z, _) = super::tracer2::plane(field, p.as_dvec2(), DVec2::ZERO);
                ((-g * self.scene.height).extend(1.0).normalize(), z)
            }
        };
        let normal = side.facing(falling);
        Some(Receiver {
            position: p.extend(z as f32),
            isovalue: isovalue as f32,
            normal,
            departure: Departure::Surface(side),
        })
    }

    /// The receiver on the front of segment `id` at `u` along it and height `s` in units of the sweep.
    pub fn wall_receiver(&self, id: u32, u: f64, s: f64) -> Receiver {
        let segment = &self.scene.segments[id as usize];
        let z = if self.transport == Transport::Flattened { 0.0 } else { s };
        Receiver {
            position: self.scene.field.to_index(segment.at(u)).extend(z).as_vec3(),
            isovalue: s as f32,
            normal: segment.normal().extend(0.0),
            departure: Departure::Polygon(id),
        }
    }

    /// The receiver where a ray landed.
    pub fn landed(&self, landing: Landing) -> Option<Receiver> {
        match landing {
            Landing::Dark => None,
            Landing::Graph(x, y, side) => self.graph_receiver(DVec2::new(x.into(), y.into()), side),
            Landing::Wall(id, u, s) => Some(self.wall_receiver(id.into(), u.into(), s.into())),
        }
    }

    /// Albedo of what a ray landed on.
    pub fn albedo(&self, landing: Landing) -> DVec3 {
        match landing {
            Landing::Dark => DVec3::ZERO,
            Landing::Graph(..) => self.scene.albedo,
            Landing::Wall(id, ..) => self.scene.segments[usize::from(id)].albedo,
        }
    }

    /// World position of a local one; the height is the isovalue's when flattened.
    pub fn to_world(&self, p: Vec3, isovalue: f32) -> DVec3 {
        let s = if self.transport == Transport::Flattened { isovalue } else { p.z };
        self.scene.field.to_world(p.truncate().as_dvec2()).extend(f64::from(s) * self.scene.height)
    }

    /// A world vector in the local frame.
    #[inline]
    fn local_direction(&self, d: DVec3) -> Vec3 {
        let xy = d.truncate() / self.scene.field.spacing();
        xy.extend(if self.transport == Transport::Flattened { 0.0 } else { d.z / self.scene.height }).as_vec3()
    }

    /// A direction distributed by the cosine: sin θ uniform in (−1, 1) on the circle, Malley's on the sphere.
    #[inline]
    pub fn direction(&self, receiver: &Receiver, u: [f64; 2]) -> DVec3 {
        match self.transport {
            Transport::Flattened => {
                let sine = 2.0 * u[0] - 1.0;
                let n = receiver.normal.truncate();
                (-n.perp() * sine + n * (1.0 - sine * sine).max(0.0).sqrt()).extend(0.0)
            }
            Transport::Ordinary => Frame::new(receiver.normal).to_world(cosine_hemisphere(u)),
        }
    }

    /// The ray from a receiver along a world direction.
    #[inline]
    pub fn ray(&self, receiver: &Receiver, direction: DVec3) -> FlattenedRay {
        FlattenedRay {
            departure: receiver.departure,
            ..FlattenedRay::free(receiver.position, self.local_direction(direction), receiver.isovalue)
        }
    }

    /// What the ray from a receiver along a world direction meets.
    #[inline]
    pub fn trace(&self, receiver: &Receiver, direction: DVec3) -> Landing {
        let ray = self.ray(receiver, direction);
        self.tracer.intersect(&ray).map_or(Landing::Dark, |hit| self.landing(&ray, hit.t, hit.target))
    }

    /// The stored coordinates of a hit.
    pub fn landing(&self, ray: &FlattenedRay, t: f32, target: Target) -> Landing {
        let p = ray.at(t);
        match target {
            Target::Surface(side) => Landing::Graph(p.x as f32, p.y as f32, side),
            Target::Polygon(id) if !self.scene.segments[id as usize].emits() => {
                let [a, b] = self.scene.segments[id as usize].ends;
                let x = self.scene.field.to_world(p.truncate());
                let u = (x - a).dot(b - a) / (b - a).length_squared();
                let s = if self.transport == Transport::Flattened { ray.isovalue } else { p.z as f32 };
                Landing::Wall(id as u16, u.clamp(0.0, 1.0) as f32, s)
            }
            _ => Landing::Dark,
        }
    }

    /// Whether the receiver sees point `y` of luminaire `id`.
    #[inline]
    fn sees(&self, receiver: &Receiver, y: DVec3, id: u32) -> bool {
        let field = &self.scene.field;
        let z = if self.transport == Transport::Flattened { 0.0 } else { y.z / self.scene.height };
        let target = field.to_index(y.truncate()).extend(z).as_vec3();
        !self.tracer.occluded(&FlattenedRay {
            reach: 1.0,
            departure: receiver.departure,
            target: Some(id),
            ..FlattenedRay::free(receiver.position, target - receiver.position, receiver.isovalue)
        })
    }

    /// Direct irradiance over its full amount (2 or π times radiance): reflected light is albedo times this.
    ///
    /// Flattened, `rays` shadow rays stand at equal steps of sin θ and the edges of shadows between them are bisected:
    /// exact but for occluders thinner than a step. Ordinary: closed form × visible share, as in three dimensions.
    pub fn direct(&self, receiver: &Receiver, rays: u32, set: &Sobol) -> DVec3 {
        let x = self.to_world(receiver.position, receiver.isovalue);
        let mut sum = DVec3::ZERO;
        for (id, light) in &self.lights {
            if receiver.departure == Departure::Polygon(*id) {
                continue;
            }
            let share = match self.transport {
                Transport::Flattened => self.visible_sines(receiver, x.truncate(), *id, rays),
                Transport::Ordinary => {
                    let open = unoccluded(light, x, receiver.normal) / std::f64::consts::PI;
                    if open == 0.0 {
                        continue;
                    }
                    let (mut all, mut seen) = (0.0, 0.0);
                    for i in 0..rays {
                        let y = light.sample(set.point2(i, 0));
                        let g = point_term(x, receiver.normal, y, light.normal());
                        if g > 0.0 {
                            all += g;
                            seen += if self.sees(receiver, y, *id) { g } else { 0.0 };
                        }
                    }
                    if all > 0.0 { open * seen / all } else { 0.0 }
                }
            };
            sum += light.emission * share;
        }
        sum
    }

    /// ½ of the visible part of sin θ₂ − sin θ₁ of luminaire `id`.
    fn visible_sines(&self, receiver: &Receiver, x: DVec2, id: u32, rays: u32) -> f64 {
        let segment = &self.scene.segments[id as usize];
        let ([a, b], n) = (segment.ends, receiver.normal.truncate());
        if (x - a).dot(segment.normal()) <= 0.0 {
            return 0.0;
        }
        let Some((lo, hi)) = sine_range(segment.ends, x, n) else { return 0.0 };
        let visible = |f: f64| {
            let sine = lo + f * (hi - lo);
            let d = -n.perp() * sine + n * (1.0 - sine * sine).max(0.0).sqrt();
            let t = (a - x).perp_dot(b - a) / d.perp_dot(b - a);
            let y = x + d * t;
            self.sees(receiver, y.extend(0.0), id)
        };
        let at = |i: u32| if i == 0 { 1e-6 } else { ((f64::from(i) - 0.5) / f64::from(rays)).min(1.0 - 1e-6) };
        let (mut previous, mut f, mut seen) = (visible(at(0)), 0.0, 0.0);
        for i in 1..=rays + 1 {
            let next = at(i);
            let now = visible(next);
            if now != previous {
                let (mut l, mut h) = (f, next);
                for _ in 0..BISECTIONS {
                    let m = 0.5 * (l + h);
                    if visible(m) == previous { l = m } else { h = m }
                }
                let edge = 0.5 * (l + h);
                seen += if previous { edge - f } else { next - edge };
            } else if now {
                seen += next - f;
            }
            (previous, f) = (now, next);
        }
        if previous {
            seen += 1.0 - f;
        }
        0.5 * (hi - lo) * seen
    }

    /// Indirect light per albedo at a receiver: the mean over `gather` stratified directions of the solved radiance.
    pub fn gathered(&self, receiver: &Receiver, solved: &Solution, gather: u32, key: u64) -> DVec3 {
        let set = Sobol::set(solved.seed(), Stage::Gather, key);
        let mut sum = DVec3::ZERO;
        for i in 0..gather {
            sum += solved.radiance(self.trace(receiver, self.direction(receiver, set.point2(i, 0))));
        }
        sum / f64::from(gather.max(1))
    }

    /// Reflected light per albedo at a receiver, direct and indirect ([`World::gathered`]). The albedo times their sum
    /// is the outgoing radiance.
    pub fn reflected(&self, receiver: &Receiver, solved: &Solution, shadow: u32, gather: u32, key: u64) -> [DVec3; 2] {
        let set = Sobol::set(solved.seed(), Stage::Direct, key);
        [self.direct(receiver, shadow, &set), self.gathered(receiver, solved, gather, key)]
    }

    /// Indirect light per albedo at a receiver, by path `path` of `key`: next-event estimation
    /// with one shadow ray per vertex and Russian roulette after three reflections. Unbiased; no stored radiance.
    pub fn path(&self, receiver: &Receiver, path: u32, key: Key) -> DVec3 {
        let set = key.set();
        let rest = Key { seed: key.seed ^ 0x9e37, index: key.index << 32 | u64::from(path), ..key };
        let mut rng = rest.stream();
        let (mut at, mut weight, mut sum) = (*receiver, DVec3::ONE, DVec3::ZERO);
        for bounce in 0.. {
            let u = if bounce < 2 { set.point2(path, 2 * bounce) } else { rng.unit2() };
            let landing = self.trace(&at, self.direction(&at, u));
            let Some(next) = self.landed(landing) else { break };
            weight *= self.albedo(landing);
            if bounce >= 3 {
                let survive = weight.max_element().min(0.95);
                if !(rng.unit() < survive) {
                    break;
                }
                weight /= survive;
            }
            let v = if bounce == 0 { set.point2(path, 4) } else { rng.unit2() };
            sum += weight * self.one_shadow_ray(&next, v);
            // c never changes along a path.
            at = Receiver { isovalue: at.isovalue, ..next };
        }
        sum
    }

    /// Unbiased [`World::direct`] from one ray per luminaire.
    fn one_shadow_ray(&self, receiver: &Receiver, u: [f64; 2]) -> DVec3 {
        let x = self.to_world(receiver.position, receiver.isovalue);
        let mut sum = DVec3::ZERO;
        for (id, light) in &self.lights {
            let segment = &self.scene.segments[*id as usize];
            if receiver.departure == Departure::Polygon(*id) {
                continue;
            }
            match self.transport {
                Transport::Flattened => {
                    let (x, n) = (x.truncate(), receiver.normal.truncate());
                    let y = segment.at(u[0]);
                    let to = y - x;
                    let (cos, cos_y) = (to.dot(n), -to.dot(segment.normal()));
                    if cos > 0.0 && cos_y > 0.0 && self.sees(receiver, y.extend(0.0), *id) {
                        let length = (segment.ends[1] - segment.ends[0]).length();
                        sum += light.emission * (0.5 * length * cos * cos_y / to.length().powi(3));
                    }
                }
                Transport::Ordinary => {
                    let y = light.sample(u);
                    let g = point_term(x, receiver.normal, y, light.normal());
                    if g > 0.0 && self.sees(receiver, y, *id) {
                        sum += light.emission * (g * light.area() / std::f64::consts::PI);
                    }
                }
            }
        }
        sum
    }

    /// The vertices of photon `index`, from the first luminaire at height `s` (units of the sweep): emission ∝ cos θ,
    /// the next direction ∝ cos θ, survival with the albedo's mean, at most `bounces` reflections. \[BB09 Fig. 3\]
    pub fn photon_path(&self, seed: u64, index: u64, s: f64, bounces: usize) -> Vec<PathVertex> {
        let Some((id, _)) = self.lights.first() else { return Vec::new() };
        let mut rng = Rng::stream(seed, Stage::Photon, index);
        let mut at = self.wall_receiver(*id, rng.unit(), s);
        let mut path = vec![PathVertex { position: self.to_world(at.position, at.isovalue), landing: Landing::Dark }];
        for _ in 0..=bounces {
            let ray = self.ray(&at, self.direction(&at, rng.unit2()));
            let Some(hit) = self.tracer.intersect(&ray) else {
                // A stub shows where it leaves.
                let d = ray.direction / ray.direction.truncate().length().max(1e-9);
                let stub = ray.origin + d * (0.25 * self.scene.field.far().min_element() as f32);
                path.push(PathVertex { position: self.to_world(stub, at.isovalue), landing: Landing::Dark });
                break;
            };
            let landing = self.landing(&ray, hit.t, hit.target);
            path.push(PathVertex { position: self.to_world(ray.at(hit.t).as_vec3(), at.isovalue), landing });
            let survive = self.albedo(landing).element_sum() / 3.0;
            match self.landed(landing) {
                Some(next) if rng.unit() < survive => {
                    // The plane is the path's own, for ever. [BB09 §2.1]
                    at = Receiver { isovalue: at.isovalue, ..next };
                }
                _ => break,
            }
        }
        path
    }

    /// E₀ over its full amount: the unoccluded share of a point at the centre of the field, at mid-height, that faces
    /// the brightest luminaire; the largest channel of all luminaires. 0 without luminaires.
    fn reference_share(&self) -> f64 {
        let [lo, hi] = self.scene.field.bounds();
        let x = (0.5 * (lo + hi)).extend(0.5 * self.scene.height);
        let flux = |p: &Polygon| p.emission.max_element() * p.area();
        let Some((id, _)) = self.lights.iter().max_by(|a, b| flux(&a.1).total_cmp(&flux(&b.1))) else { return 0.0 };
        let Some(n) = (self.scene.segments[*id as usize].at(0.5) - x.truncate()).try_normalize() else { return 0.0 };
        let share = |id: u32, p: &Polygon| match self.transport {
            Transport::Flattened => unoccluded_share(self.scene.segments[id as usize].ends, x.truncate(), n),
            Transport::Ordinary => unoccluded(p, x, n.extend(0.0)) / std::f64::consts::PI,
        };
        self.lights.iter().map(|(id, p)| p.emission * share(*id, p)).sum::<DVec3>().max_element()
    }

    /// Display exposure: rgb = radiance / (ρ_max E₀ / 2), π for 2 when ordinary; 1 where that is undefined.
    pub fn exposure(&self) -> f64 {
        let scale = self.scene.albedo.max_element() * self.reference_share();
        if scale > 0.0 { 1.0 / scale } else { 1.0 }
    }
}
