//! Unbiased path tracing with next-event estimation. \[Kajiya86\]

use crate::brdf::reflected;
use crate::direct::{Receiver, direct_once};
use crate::error::Result;
use crate::export::picture::Picture;
use crate::flattened::{FlattenedHit, FlattenedRay, Target};
use crate::landing::{Landing, MOST_LANDINGS, landing};
use crate::luminaire::{Aim, unoccluded};
use crate::progress::Progress;
use crate::render::{Camera, trace_picture};
use crate::rng::{Key, Rng, Sobol, Stage, folded};
use crate::scene::Scene;
use crate::tracer::Tracer;
use crate::warp::{Frame, cosine_hemisphere};
use glam::DVec3;

/// A path tracer that counts its rays.
#[derive(Debug)]
pub struct PathTracer<'a, T> {
    pub(super) scene: &'a Scene,
    pub(super) tracer: &'a T,
    /// Rays traced.
    pub rays: u64,
}

/// Shadow rays that choose the control variate of a receiver's direct light.
const PILOT: u32 = 16;

impl<'a, T: Tracer> PathTracer<'a, T> {
    /// A path tracer through `tracer`.
    pub fn new(scene: &'a Scene, tracer: &'a T) -> Self {
        Self { scene, tracer, rays: 0 }
    }

    /// Radiance that leaves the surface at `receiver`, from `samples` paths of `key`.
    pub fn outgoing(&mut self, receiver: &Receiver, samples: u32, key: Key) -> DVec3 {
        let scene = self.scene;
        let direct = self.direct(receiver, samples, key);
        let frame = Frame::new(receiver.normal);
        let set = key.set();
        let mut sum = DVec3::ZERO;
        for i in 0..samples {
            let mut rng = key.nth(i);
            let direction = frame.to_world(cosine_hemisphere(set.point2(i, 2)));
            sum +=
                self.incoming(scene.ray(receiver.position, direction, receiver.isovalue, receiver.departure), &mut rng);
        }
        let indirect = sum * (std::f64::consts::PI / f64::from(samples.max(1)));
        reflected(scene.surface.albedo.at(f64::from(receiver.isovalue)), direct + indirect) + scene.surface.emission
    }

    /// Direct irradiance by `samples` points of each luminaire (see [`Aim::new`]), each worth g:
    /// β E₀ + 1/n Σ g (V − β) with E₀ the closed form without blockers. Unbiased for every β; β is the visible share
    /// seen by a pilot of its own, so that what is fully lit or fully dark has no variance. `key` says seed and
    /// index; the stage is its own.
    pub fn direct(&mut self, receiver: &Receiver, samples: u32, key: Key) -> DVec3 {
        let scene = self.scene;
        let x = scene.lattice().to_world(receiver.position.as_dvec3());
        let mut total = DVec3::ZERO;
        for (l, light) in (0..).zip(scene.luminaires()) {
            if light.is_left(l, receiver.departure) {
                continue;
            }
            let open = unoccluded(light, x, receiver.normal);
            if open == 0.0 {
                continue;
            }
            let index = key.index * scene.luminaires().len() as u64 + u64::from(l);
            let set = |index| Stage::Direct.key(key.seed, index).set();
            let Some(aim) = Aim::new(light, x, receiver.normal) else { continue };
            let mut shares = |set: Sobol, count: u32| -> (f64, f64) {
                let (mut all, mut seen) = (0.0, 0.0);
                for i in 0..count {
                    let (y, g) = aim.sample(set.point2(i, 0));
                    all += g;
                    if g > 0.0 {
                        self.rays += 1;
                        seen += if self.tracer.occluded(&receiver.shadow_ray(scene, y, l)) { 0.0 } else { g };
                    }
                }
                (all, seen)
            };
            // The pilot's stream: another index of the same stage, far from all others.
            let (all, seen) = shares(set(!index), PILOT);
            let beta = if all > 0.0 { seen / all } else { 0.0 };
            let (all, seen) = shares(set(index), samples);
            let mean = (seen - beta * all) / f64::from(samples.max(1));
            total += light.emission * (beta * open + mean);
        }
        total
    }

    /// As [`direct_once`], counting its rays.
    pub(super) fn direct_once(&mut self, receiver: &Receiver, rng: &mut Rng) -> DVec3 {
        direct_once(self.scene, self.tracer, receiver, rng, &mut self.rays)
    }

    /// Indirect irradiance by one path.
    pub(super) fn indirect_once(&mut self, receiver: &Receiver, rng: &mut Rng) -> DVec3 {
        let direction = Frame::new(receiver.normal).to_world(cosine_hemisphere(rng.unit2()));
        let ray = self.scene.ray(receiver.position, direction, receiver.isovalue, receiver.departure);
        self.incoming(ray, rng) * std::f64::consts::PI
    }

    /// Radiance that arrives along `ray`, without what its first hit emits as a luminaire. Russian roulette keeps the
    /// largest channel; after [`MOST_LANDINGS`] the path ends.
    fn incoming(&mut self, mut ray: FlattenedRay, rng: &mut Rng) -> DVec3 {
        let (mut total, mut weight) = (DVec3::ZERO, DVec3::ONE);
        for _ in 0..MOST_LANDINGS {
            self.rays += 1;
            let Some(hit) = self.tracer.intersect(&ray) else { return total };
            let Some(Landing { receiver, albedo, emission, .. }) = landing(self.scene, &ray, hit) else { return total };
            total += weight * emission;
            let survival = (weight * albedo).max_element() / weight.max_element();
            if !(survival > 0.0) {
                return total;
            }
            total += weight * reflected(albedo, self.direct_once(&receiver, rng));
            if rng.unit() >= survival {
                return total;
            }
            weight *= albedo / survival;
            let direction = Frame::new(receiver.normal).to_world(cosine_hemisphere(rng.unit2()));
            ray = self.scene.ray(receiver.position, direction, ray.isovalue, receiver.departure);
        }
        total
    }
}

/// A picture of hyperplane `isovalue` (units of the sweep) by a path for every ray of the camera; luminaires are seen.
///
/// # Errors
/// `Invalid` for an impossible camera; `Interrupted`.
pub fn path_picture<T: Tracer>(
    scene: &Scene,
    tracer: &T,
    isovalue: f32,
    camera: &Camera,
    progress: Progress,
) -> Result<Picture> {
    // Paths are told apart by camera and ray: the same picture on any number of threads, and of two cameras that see
    // the same two with noise of their own.
    let camera_key = folded(0, camera.eye);
    let shade = |ray: &FlattenedRay, hit, direction: DVec3, _| {
        let key = folded(camera_key, direction);
        path_radiance(scene, tracer, ray, hit, &mut Rng::stream(1, Stage::Path, key))
    };
    trace_picture(scene, tracer, isovalue, camera, &shade, progress)
}

/// Radiance seen along `ray` of a picture, from one path; what a luminaire emits is seen.
fn path_radiance<T: Tracer>(scene: &Scene, tracer: &T, ray: &FlattenedRay, hit: FlattenedHit, rng: &mut Rng) -> DVec3 {
    let Some(Landing { receiver, albedo, mut emission, .. }) = landing(scene, ray, hit) else { return DVec3::ZERO };
    if let Target::Polygon(id) = hit.target
        && scene.sees_front(ray, id)
    {
        emission = scene.polygons()[id as usize].emission;
    }
    if albedo == DVec3::ZERO {
        return emission;
    }
    let mut paths = PathTracer::new(scene, tracer);
    let direct = paths.direct_once(&receiver, rng);
    emission + reflected(albedo, direct + paths.indirect_once(&receiver, rng))
}
