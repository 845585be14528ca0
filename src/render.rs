//! Pictures: the isosurface of a baked volume, coloured by its grid, inside its box.

use crate::digits::Shortest;
use crate::direct::luminance;
use crate::embree::{Device, GraphTracer};
use crate::error::{Error, Result};
use crate::export::bake_file::BakedVolume;
use crate::export::picture::Picture;
use crate::final_gather::{FinalGather, FinalGatherSettings, seen};
use crate::flattened::{Departure, FlattenedHit, FlattenedRay, Target};
use crate::progress::Progress;
use crate::rng::{Sobol, Stage};
use crate::scene::Scene;
use crate::tracer::Tracer;
use glam::DVec3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering};

/// A perspective camera in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Where it stands.
    pub eye: DVec3,
    /// What it looks at.
    pub target: DVec3,
    /// What is up.
    pub up: DVec3,
    /// Vertical field of view, degrees.
    pub fov: f64,
    /// Pixels across and down.
    pub size: [usize; 2],
    /// Rays per pixel.
    pub samples: u32,
}

impl Camera {
    /// Pixels across, and down, at most.
    pub const MOST: usize = 1 << 14;

    /// The default view: on the box's axis, looking along +y with z up, vertical field of view 40°, as far out as lets
    /// the front face just fill the frame; `height` pixels tall, aspect Lx : Lz, which may be wider than
    /// [`Camera::MOST`]; 16 rays per pixel.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "pixel counts")]
    pub fn facing(scene: &Scene, height: usize) -> Self {
        let [lo, hi] = scene.bounds();
        let (centre, size) = (0.5 * (lo + hi), hi - lo);
        let fov = 40.0;
        let distance = 0.5 * size.z / f64::to_radians(0.5 * fov).tan();
        let eye = DVec3::new(centre.x, lo.y - distance, centre.z);
        let width = ((height as f64 * size.x / size.z).round() as usize).max(1);
        Self { eye, target: centre, up: DVec3::Z, fov, size: [width, height], samples: 16 }
    }

    /// The unit direction of the view, and the steps of a pixel to the right and up on the plane one unit before the
    /// eye. Sums of these are directions of rays, of no unit length.
    ///
    /// # Errors
    /// `Invalid` if eye and target coincide or the view runs along up, for an impossible field of view, for a picture
    /// that is empty or larger than [`Camera::MOST`], and for no rays.
    fn basis(&self) -> Result<[DVec3; 3]> {
        let fail = || Error::Invalid("camera: the eye, the target and up must span a plane".into());
        let forward = (self.target - self.eye).try_normalize().ok_or_else(fail)?;
        // Any length will do: its cross product must neither overflow nor vanish.
        let up = self.up / self.up.abs().max_element();
        let right = forward.cross(up).try_normalize().ok_or_else(fail)?;
        let size = self.size.iter().all(|n| (1..=Self::MOST).contains(n));
        if !(size && self.fov > 0.0 && self.fov < 179.0) {
            return Err(Error::Invalid(format!(
                "camera: a field of view of {}° over {}×{} pixels; it must be above 0 and below 179, the picture 1 to {} \
                 pixels wide and tall",
                self.fov,
                self.size[0],
                self.size[1],
                Self::MOST
            )));
        }
        if self.samples == 0 {
            return Err(Error::Invalid("camera: 0 samples; a pixel needs one ray at least".into()));
        }
        let scale = f64::to_radians(0.5 * self.fov).tan() * 2.0 / self.size[1] as f64;
        Ok([forward, right * scale, right.cross(forward) * scale])
    }
}

/// How surfaces get their colours.
#[derive(Clone, Copy, Debug)]
pub enum Shading<'a> {
    /// By the baked radiance, or by rays into it; the scene drawn must be the bake's.
    Baked(&'a BakedVolume, Option<FinalGatherSettings>),
    /// By a headlight and a constant, what viewers do without a bake: radiance that this exposure brings to [0, 1].
    Local(f64),
}

/// What a picture says about itself.
#[derive(Clone, Debug)]
pub struct Rendered {
    /// Linear radiance.
    pub picture: Picture,
    /// Share of primary rays that met a side of the surface that was not baked.
    pub unbaked: f64,
    /// Rays traced from what was seen.
    pub rays: u64,
}

/// Renders the isosurface at `isovalue` (source units).
///
/// # Errors
/// `Invalid` for an isovalue outside the sweep or an impossible camera; `Embree`; `Interrupted`; as
/// [`FinalGather::new`].
pub fn render(
    scene: &Scene,
    isovalue: f64,
    camera: &Camera,
    shading: Shading<'_>,
    device: &Device,
    progress: Progress,
) -> Result<Rendered> {
    let sweep = scene.field.sweep();
    if !(isovalue >= sweep.lo() && isovalue <= sweep.hi()) {
        return Err(Error::Invalid(format!(
            "isovalue {} lies outside the sweep {sweep}; choose one inside, or a wider sweep",
            Shortest(isovalue)
        )));
    }
    let tracer = GraphTracer::new(device, scene)?;
    let c = sweep.isovalue(isovalue);
    let unbaked = AtomicU64::new(0);
    let gather = match shading {
        Shading::Baked(baked, Some(settings)) => Some(FinalGather::new(baked, &tracer, settings)?),
        _ => None,
    };
    let shade = |ray: &FlattenedRay, hit: FlattenedHit, direction: DVec3, index: u64| {
        let light = match (shading, &gather) {
            (Shading::Local(exposure), _) => Some(local(scene, ray, hit, direction) / exposure),
            (_, Some(gather)) => gather.seen(ray, hit, index),
            (Shading::Baked(baked, _), None) => seen(baked, ray, hit),
        };
        light.unwrap_or_else(|| {
            unbaked.fetch_add(1, Ordering::Relaxed);
            DVec3::ZERO
        })
    };
    let picture = trace_picture(scene, &tracer, c, camera, &shade, progress)?;
    let total = (camera.size[0] * camera.size[1]) as f64 * f64::from(camera.samples);
    let rays = gather.map_or(0, |g| g.rays());
    Ok(Rendered { picture, unbaked: unbaked.into_inner() as f64 / total, rays })
}

/// What stands for the radiance of a hit: of its ray, the ray's direction in the world, and the number of the ray in
/// the picture.
pub type Shade<'a> = dyn Fn(&FlattenedRay, FlattenedHit, DVec3, u64) -> DVec3 + Sync + 'a;

/// Sends stratified rays through each pixel of hyperplane `c` and averages what `shade` makes of the hits;
/// misses are black.
///
/// # Errors
/// `Invalid` for an impossible camera; `Interrupted`.
pub fn trace_picture<T: Tracer>(
    scene: &Scene,
    tracer: &T,
    c: f32,
    camera: &Camera,
    shade: &Shade<'_>,
    progress: Progress,
) -> Result<Picture> {
    let [forward, right, down] = camera.basis().map(|[f, r, u]| [f, r, -u])?;
    let ([width, height], samples) = (camera.size, camera.samples);
    let bounds = scene.bounds();
    let mut picture = Picture::new(width, height);
    let stage = progress.stage("picture", (width * height) as u64);
    picture.rgb.par_iter_mut().enumerate().with_min_len(64).for_each(|(i, pixel)| {
        if !stage.tick(1) {
            return;
        }
        let set = Sobol::set(0, Stage::Picture, i as u64);
        let mut sum = DVec3::ZERO;
        for s in 0..samples {
            let [x, y] = set.point2(s, 0);
            let (x, y) = ((i % width) as f64 + x - 0.5 * width as f64, (i / width) as f64 + y - 0.5 * height as f64);
            let direction = (forward + right * x + down * y).normalize();
            let start = camera.eye + approach(bounds, camera.eye, direction) * direction;
            let ray = scene.ray(scene.lattice().to_index(start).as_vec3(), direction, c, Departure::Free);
            if let Some(hit) = tracer.intersect(&ray) {
                sum += shade(&ray, hit, direction, i as u64 * u64::from(samples) + u64::from(s));
            }
        }
        *pixel = (sum / f64::from(samples)).as_vec3().to_array();
    });
    stage.end()?;
    Ok(picture)
}

/// Cameras farther away than so many diagonals of the scene have rays that begin one diagonal before it.
const FAR: f64 = 16.0;

/// How far along the unit direction `d` from `o` a picture's ray begins: 32-bit floats tell the place of a hit as
/// roughly as it is far, so that rays from afar, as telephoto views have them, would end beside surfaces.
fn approach([lo, hi]: [DVec3; 2], o: DVec3, d: DVec3) -> f64 {
    let (a, b) = ((lo - o) / d, (hi - o) / d);
    // An axis that the ray does not move along says nothing, or NaN.
    let near = a.min(b).to_array().into_iter().filter(|t| t.is_finite()).fold(0.0, f64::max);
    let diagonal = (hi - lo).length();
    if near > FAR * diagonal { near - diagonal } else { 0.0 }
}

/// Headlight shading, already exposed: ρ (0.15 + 0.85 |cos|).
fn local(scene: &Scene, ray: &FlattenedRay, hit: FlattenedHit, direction: DVec3) -> DVec3 {
    let p = ray.at(hit.t);
    let isovalue = f64::from(ray.isovalue);
    let (albedo, normal) = match hit.target {
        Target::Surface(side) | Target::Companion(_, side) => {
            let at = scene.field_at(hit.target.companion(), p);
            (at.surface.albedo.at(isovalue), at.normal(side))
        }
        Target::Cap(face, _) => (scene.face_surface(face).albedo.at(isovalue), Some(scene.face_normal(face))),
        Target::Polygon(id) => {
            let polygon = &scene.polygons()[id as usize];
            if polygon.emission != DVec3::ZERO {
                let white = scene.sees_front(ray, id) && luminance(polygon.emission) > 0.0;
                return DVec3::splat(f64::from(white));
            }
            (polygon.albedo, Some(polygon.normal()))
        }
    };
    albedo * (0.15 + 0.85 * normal.map_or(0.0, |n| n.dot(direction).abs()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Field;
    use crate::flattened::Side;
    use crate::scene::{Boundary, Surface, cornell_box};
    use crate::volume::{Lattice, Samples};

    /// Telephoto views from farther and farther away show the same places of a ball, on its surface.
    #[test]
    fn far_cameras_see_surfaces_where_they_are() {
        let lattice = Lattice::aligned([24; 3], DVec3::splat(-1.0), DVec3::splat(2.0 / 23.0)).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.to_world(lattice.point(o)).length_squared() as f32).collect();
        let field = Field::made(lattice, Samples::F32(samples), 0.0, 1.0);
        let walls = cornell_box(field.lattice(), 0.1).unwrap();
        let surface = Surface { outside: Side::Higher, ..Surface::default() };
        let scene = Scene::new(field, surface, Boundary::Open, walls).unwrap();
        let device = Device::new(1).unwrap();
        let tracer = GraphTracer::new(&device, &scene).unwrap();
        let towards = DVec3::new(0.3, -1.0, 0.2).normalize();
        for distance in [4.0, 1e3, 1e6, 1e9] {
            let camera = Camera {
                eye: distance * towards,
                target: DVec3::ZERO,
                up: DVec3::Z,
                fov: 2.0 * (1.5 / distance).atan().to_degrees(),
                size: [32; 2],
                samples: 1,
            };
            let shade = |ray: &FlattenedRay, hit: FlattenedHit, _: DVec3, _: u64| match hit.target {
                Target::Surface(_) => DVec3::new(1.0, (scene.field.value(ray.at(hit.t)) - 0.49).abs(), 0.0),
                _ => DVec3::ZERO,
            };
            let picture = trace_picture(&scene, &tracer, 0.49, &camera, &shade, Progress::Quiet).unwrap();
            let hits = picture.rgb.iter().filter(|rgb| rgb[0] > 0.0).count();
            let off = picture.rgb.iter().fold(0f32, |most, rgb| most.max(rgb[1]));
            println!("{distance:e}: {hits} hits, off by {off:e}");
            // A disk of radius 0.7 of a square of 3, in 1024 pixels; nearer, it looks larger.
            assert!((150..200).contains(&hits), "{distance}: {hits}");
            assert!(off < 2e-5, "{distance}: {off}");
        }
    }
}
