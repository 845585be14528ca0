//! Closed level sets seen from inside, with the sign oracle: a ray that starts where h ≥ c and leaves Ω where h < c
//! must meet the surface from the higher side, whatever the isovalue and however degenerate the ray.

use super::{Case, Tally, Trials, many};
use crate::embree::{Device, GraphTracer, SurfaceTracer};
use crate::error::Result;
use crate::field::{Field, Sweep};
use crate::flattened::{FlattenedRay, Side, Target};
use crate::progress::Progress;
use crate::rng::{Rng, Stage};
use crate::scene::{Boundary, Scene, Surface};
use crate::selftest::double::Double;
use crate::tracer::Tracer;
use crate::volume::{Lattice, Samples, Volume};
use crate::warp;
use glam::{DVec3, Vec3};

/// Isovalues at which triangles are extracted for comparison.
const TRIANGLE_ISOVALUES: u64 = 8;

/// A class of scenes.
#[derive(Debug)]
pub struct Class {
    /// Name in the table.
    pub name: &'static str,
    /// The scene.
    pub scene: Scene,
    /// Isovalues in units of the sweep that samples take: half of the rays travel at one of them.
    levels: Vec<f32>,
}

/// A scene without polygons of `value(ijk, random bits)` inside a shell of `low`, so that every level set above it is
/// closed.
///
/// # Errors
/// From the lattice or the field.
pub fn closed(
    dims: [usize; 3],
    [spacing, origin]: [DVec3; 2],
    sweep: [f64; 2],
    low: f64,
    value: impl Fn([usize; 3], u64) -> f64,
) -> Result<Scene> {
    let lattice = Lattice::aligned(dims, origin, spacing)?;
    let mut rng = Rng::stream(5, Stage::Test, dims[0] as u64);
    let samples = (0..lattice.len())
        .map(|o| {
            let ijk = lattice.ijk(o);
            let border = (0..3).any(|a| ijk[a] == 0 || ijk[a] == dims[a] - 1);
            let bits = rng.bits();
            if border { low } else { value(ijk, bits) }
        })
        .collect();
    let volume = Volume::new("self-test", lattice, Samples::F64(samples))?;
    let field = Field::new(&volume, Sweep::new(sweep[0], sweep[1])?)?;
    Scene::new(field, Surface::default(), Boundary::Open, Vec::new())
}

/// Random integers below `levels` inside a shell of zeros.
///
/// # Errors
/// As [`closed`].
pub fn noise(dims: [usize; 3], place: [DVec3; 2], levels: u64) -> Result<Scene> {
    closed(dims, place, [0.0, (levels - 1) as f64], 0.0, |_, bits| (bits % levels) as f64)
}

/// All classes.
///
/// # Errors
/// As [`closed`].
pub fn classes() -> Result<Vec<Class>> {
    let plain = [DVec3::ONE, DVec3::ZERO];
    let far = DVec3::new(148_376.0, 1234.0, -223_423.0);
    let flat = DVec3::new(1.0, 1.0, 50.0);
    let integers = |scene: &Scene, n: u64| (1..n).map(|i| scene.field.sweep().isovalue(i as f64)).collect::<Vec<_>>();
    let class = |name, scene: Scene, n| Class { name, levels: integers(&scene, n), scene };
    // The checkerboard's saddle value 1 stands on every face; a few samples differ, so that the faces do too.
    let saddle = closed([33, 34, 35], plain, [0.0, 2.0], 0.0, |[i, j, k], bits| match bits % 16 {
        0 => 1.0,
        1 => 0.5,
        _ => 2.0 * ((i + j + k) % 2) as f64,
    })?;
    let steps = [0.0, 1e-30, 1e-24, 1e-12, 0.125, 0.5, 1.0, 1e12, 1e30];
    let orders = closed([33, 34, 35], plain, [0.0, 1.0], 0.0, |_, bits| steps[(bits % 9) as usize])?;
    Ok(vec![
        class("u8 noise", noise([33, 34, 35], plain, 255)?, 255),
        class("plateaus: four grey levels", noise([33, 34, 35], plain, 4)?, 4),
        Class { name: "saddle cells", levels: vec![0.25, 0.5, 0.5, 1.0], scene: saddle },
        class("spacing 1:1:50", noise([20, 21, 22], [flat, DVec3::ZERO], 9)?, 9),
        class("origin (148376, 1234, −223423)", noise([33, 34, 35], [DVec3::ONE, far], 9)?, 9),
        class("borders of blocks of 4, 16, 64, 256", noise([262, 70, 19], plain, 33)?, 33),
        Class { name: "values 1e-30 … 1e30", levels: vec![1e-30, 1e-24, 1e-12, 0.125, 0.5, 1.0], scene: orders },
    ])
}

/// A start inside Ω: random, on a lattice plane, on an edge, or on a vertex; some of them on borders of blocks.
pub fn start(rng: &mut Rng, dims: [usize; 3]) -> DVec3 {
    let class = rng.bits() % 4;
    let block = [1.0, 1.0, 4.0, 16.0][(rng.bits() % 4) as usize];
    let mut p = DVec3::ZERO;
    for a in 0..3 {
        let last = dims[a] as f64 - 2.0;
        let free = 1.0 + rng.unit() * (last - 1.0);
        let snapped = ((free / block).round() * block).clamp(1.0, last);
        p[a] = if (a as u64) < class { snapped } else { free };
    }
    p
}

/// A direction: random, with components ±0, ≤ 1e-7, denormal, or along a diagonal.
#[allow(clippy::cast_possible_truncation, reason = "16 bits")]
pub fn direction(rng: &mut Rng) -> DVec3 {
    let mut d = warp::sphere(rng.unit2());
    for a in 0..3 {
        match rng.bits() % 16 {
            0 => d[a] = 0.0,
            1 => d[a] = -0.0,
            2 => d[a] *= 1e-7,
            3 => d[a] = f64::from(f32::from_bits((rng.bits() % 1000) as u32)),
            4 => d[a] = 1f64.copysign(d[a]),
            5 => d[a] *= 1e-7 * rng.unit(),
            _ => {}
        }
    }
    if d.abs().max_element() < 1e-3 { DVec3::X } else { d }
}

/// Ray `index` of a class as a user's rays come: world coordinates, turned into the local frame. At `fixed`, or at an
/// isovalue of its own. `None` if it does not start inside, or within rounding of the surface.
#[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
fn ray(class: &Class, index: u64, fixed: Option<f32>) -> Option<FlattenedRay> {
    let mut rng = Rng::stream(1, Stage::Test, index);
    let lattice = class.scene.lattice();
    let p = start(&mut rng, lattice.dims());
    let origin = lattice.to_index(lattice.to_world(p)).as_vec3();
    let d = direction(&mut rng);
    let pick = rng.bits();
    let free = rng.unit() as f32;
    let on = class.levels[(pick / 2 % class.levels.len() as u64) as usize];
    let c = fixed.unwrap_or(if pick.is_multiple_of(2) { on } else { free });
    if c <= 0.0 || !inside(&class.scene, origin, c) {
        return None;
    }
    // A direction of the world that has these components in cells.
    let direction = lattice.direction_to_index(lattice.axes() * d).as_vec3();
    Some(FlattenedRay::free(origin, direction, c))
}

/// Whether h ≥ c at `origin` by exact arithmetic, and not within the rounding of an f64 evaluation unless h = c
/// exactly.
fn inside(scene: &Scene, origin: Vec3, c: f32) -> bool {
    let (cell, u) = scene.field.locate(origin.as_dvec3());
    let corners = scene.field.corners(cell);
    let above = Double::trilinear(corners, u.to_array().map(Double::from)) - Double::from(c);
    let size = corners.iter().fold(c, |m, s| m.max(s.abs()));
    above.hi == 0.0 && f64::from(size) < 1e6 || above.hi > 8.0 * f64::EPSILON * f64::from(size)
}

/// The rays of one class: misses of `intersect`, and disagreements of `occluded`.
///
/// # Errors
/// `Embree`, `Interrupted`.
pub fn misses(class: &Class, trials: &Trials, device: &Device, progress: Progress) -> Result<Tally> {
    let tracer = GraphTracer::new(device, &class.scene)?;
    many(progress, class.name, trials.watertight, trials.seconds, |i| {
        ray(class, i, None).map(|ray| judge(&tracer, &ray))
    })
}

fn judge<T: Tracer>(tracer: &T, ray: &FlattenedRay) -> Result<f64, String> {
    let hit = tracer.intersect(ray);
    if !matches!(hit, Some(h) if h.target == Target::Surface(Side::Higher) && h.t >= 0.0) {
        return Err(format!("{ray:?} starts inside and found {hit:?}"));
    }
    if !tracer.occluded(ray) {
        return Err(format!("{ray:?} hits, but `occluded` denies it"));
    }
    Ok(0.0)
}

/// Misses of Embree's triangles on the extracted mesh, at some of the isovalues, for those of the same rays that start
/// on a vertex above c: elsewhere the mesh, which is not the trilinear set, may have another opinion of what is inside.
///
/// # Errors
/// `Embree`, `Interrupted`.
pub fn triangle_misses(class: &Class, rays: u64, device: &Device, progress: Progress) -> Result<Tally> {
    let mut total = Tally::default();
    for k in 0..TRIANGLE_ISOVALUES {
        let mut rng = Rng::stream(2, Stage::Test, k);
        #[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
        let c = if k % 2 == 0 {
            class.levels[(rng.bits() % class.levels.len() as u64) as usize]
        } else {
            (0.05 + 0.9 * rng.unit()) as f32
        };
        let tracer = SurfaceTracer::new(device, &class.scene, c, 1)?;
        let count = rays.div_ceil(TRIANGLE_ISOVALUES);
        let tally = many(progress, "triangles", count, f64::INFINITY, |i| {
            let ray = ray(class, k * count + i, Some(c))?;
            let o = ray.origin;
            let vertex = o == o.round() && class.scene.field.value(o.as_dvec3()) > f64::from(c);
            vertex.then(|| judge(&tracer, &ray))
        })?;
        total = total.join(tally);
    }
    Ok(total)
}

/// The rows of the table: every class, with the triangles' misses beside it.
///
/// # Errors
/// `Embree`, `Interrupted`.
pub fn cases(trials: &Trials, device: &Device, progress: Progress) -> Result<Vec<Case>> {
    let mut cases = Vec::new();
    for class in classes()? {
        let tally = misses(&class, trials, device, progress)?;
        cases.push(tally.case("watertight", class.name, None, ""));
        let tally = triangle_misses(&class, trials.triangles, device, progress)?;
        let mut beside = tally.case("  triangles", class.name, None, "Embree on the extracted mesh, for comparison");
        beside.required = false;
        cases.push(beside);
    }
    Ok(cases)
}
