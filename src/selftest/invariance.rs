//! What must not matter: units of h, units and origin of the world, how the lattice's axes run.
//!
//! Powers of two are exact in floating point, so there every bit must stay. Anything else rounds the samples or the
//! rays anew, and a hit may move by as much as that rounding over the slope along the ray.

use super::{Case, Tally, Trials, many};
use crate::bake::{Bake, BakeOptions, BakeSettings, Engine, bake};
use crate::embree::{Device, GraphTracer};
use crate::error::Result;
use crate::field::{Field, Sweep};
use crate::flat::FlatLight;
use crate::flattened::{FlattenedHit, FlattenedRay, Target};
use crate::mask::Mask;
use crate::progress::Progress;
use crate::rng::{Rng, Stage};
use crate::scene::{Boundary, Scene, Surface, cornell_box};
use crate::stats::{Moments, normal_quantile, sidak};
use crate::tracer::Tracer;
use crate::volume::{Lattice, Samples, Volume};
use crate::warp;
use glam::{DMat3, DVec3};

/// Largest relative change of t where bits may change.
const BOUND: f64 = 1e-5;

/// Samples along an axis of the field that rays cross.
const N: usize = 40;

/// A change of units and axes.
#[derive(Clone, Copy)]
struct Change {
    name: &'static str,
    /// h → a h + b.
    h: [f64; 2],
    /// x → scale x + shift.
    scale: f64,
    shift: DVec3,
    /// Lattice axis a runs along the first lattice's axis `order[a]`, backwards if `mirror[a]`.
    order: [usize; 3],
    mirror: [bool; 3],
    /// Whether every bit must stay.
    exact: bool,
}

const SAME: Change = Change {
    name: "",
    h: [1.0, 0.0],
    scale: 1.0,
    shift: DVec3::ZERO,
    order: [0, 1, 2],
    mirror: [false; 3],
    exact: false,
};

fn changes() -> Vec<Change> {
    let big = 2f64.powi(20);
    vec![
        Change { name: "h × 2¹⁰⁰", h: [2f64.powi(100), 0.0], exact: true, ..SAME },
        Change { name: "h × 2⁻¹⁰⁰", h: [2f64.powi(-100), 0.0], exact: true, ..SAME },
        Change { name: "h × 3.7 − 12.3", h: [3.7, -12.3], ..SAME },
        Change { name: "h × 1e-3 + 1000", h: [1e-3, 1000.0], ..SAME },
        Change { name: "world × 2²⁷", scale: 2f64.powi(27), exact: true, ..SAME },
        Change { name: "world × 2⁻²⁷", scale: 2f64.powi(-27), exact: true, ..SAME },
        Change { name: "world × 1e8", scale: 1e8, ..SAME },
        Change { name: "world × 1e-8", scale: 1e-8, ..SAME },
        Change { name: "world + (2²⁰, −2²⁰, 2²⁰)", shift: DVec3::new(big, -big, big), exact: true, ..SAME },
        Change {
            name: "world + (148376.1, 1234.2, −223423.3)",
            shift: DVec3::new(148376.1, 1234.2, -223423.3),
            ..SAME
        },
        Change { name: "axes z, x, y", order: [2, 0, 1], ..SAME },
        Change { name: "mirrored in x and z", mirror: [true, false, true], ..SAME },
        Change { name: "axes y, x, z, mirrored in y", order: [1, 0, 2], mirror: [false, true, false], ..SAME },
    ]
}

/// Smooth, with many level sets of all topologies.
fn value(x: DVec3) -> f64 {
    10.0 * ((9.0 * x.x).sin() + (7.0 * x.y + 4.0 * x.z).cos() + (8.0 * x.z - 3.0 * x.x).sin()) + 30.0
}

/// The field of [`value`] on `[0,1]³`, changed. Box coordinates are multiples of 2⁻¹⁰ so that translations are exact.
fn volume(n: usize, change: &Change) -> Result<Volume> {
    let step = 0.0234375; // 24/1024
    let column = |a: usize| {
        let mut v = DVec3::ZERO;
        v[change.order[a]] = if change.mirror[a] { -step } else { step };
        v * change.scale
    };
    let mut origin = DVec3::ZERO;
    for a in 0..3 {
        if change.mirror[a] {
            origin[change.order[a]] = (n - 1) as f64 * step;
        }
    }
    let axes = DMat3::from_cols(column(0), column(1), column(2));
    let lattice = Lattice::new([n; 3], origin * change.scale + change.shift, axes)?;
    let samples = (0..lattice.len())
        .map(|o| {
            let ijk = lattice.ijk(o);
            let mut at = [0; 3];
            for a in 0..3 {
                at[change.order[a]] = if change.mirror[a] { n - 1 - ijk[a] } else { ijk[a] };
            }
            let x = DVec3::from_array(at.map(|i| i as f64)) * step;
            // As files hold it: f32 first, so that every change sees the same function.
            #[allow(clippy::cast_possible_truncation, reason = "meant")]
            let h = f64::from(value(x) as f32);
            change.h[0] * h + change.h[1]
        })
        .collect();
    Volume::new("waves", lattice, Samples::F64(samples))
}

fn scene(n: usize, change: &Change, boxed: bool) -> Result<Scene> {
    let sweep = Sweep::new(change.h[0] * 4.0 + change.h[1], change.h[0] * 56.0 + change.h[1])?;
    let field = Field::new(&volume(n, change)?, sweep)?;
    let polygons = if boxed { cornell_box(field.lattice(), 0.0)? } else { Vec::new() };
    Scene::new(field, Surface::default(), Boundary::Open, polygons)
}

/// Ray `index` of the world, in a scene's local frame: from anywhere in the unchanged box, at a unit direction.
#[allow(clippy::cast_possible_truncation, reason = "coordinates of rays are f32")]
fn ray(scene: &Scene, change: &Change, index: u64) -> FlattenedRay {
    let mut rng = Rng::stream(6, Stage::Test, index);
    let edge = (N - 1) as f64 * 0.0234375;
    // 2⁻²⁰ of the box: what survives a translation by 2²⁰ in f64.
    let snap = |x: f64| (x * 2f64.powi(20)).round() * 2f64.powi(-20);
    let x = DVec3::new(rng.unit(), rng.unit(), rng.unit()).map(|x| snap(x * edge));
    let d = warp::sphere(rng.unit2()).as_vec3().as_dvec3();
    let c = (0.05 + 0.9 * rng.unit()) * 52.0 + 4.0;
    let origin = scene.lattice().to_index(x * change.scale + change.shift).as_vec3();
    let c = scene.field.sweep().isovalue(change.h[0] * c + change.h[1]);
    scene.ray(origin, d, c, crate::flattened::Departure::Free)
}

/// The change of a hit: the relative difference of t beyond what rounding over the slope explains.
fn compare(
    base: &Scene,
    ray: &FlattenedRay,
    change: &Change,
    a: Option<FlattenedHit>,
    b: Option<FlattenedHit>,
) -> Result<f64, String> {
    #[allow(clippy::cast_possible_truncation, reason = "a power of two")]
    let scaled = b.map(|h| FlattenedHit { t: (f64::from(h.t) / change.scale) as f32, ..h });
    let wrong = || Err(format!("{ray:?} found {a:?}, then {scaled:?}"));
    if change.exact {
        let bits = |h: Option<FlattenedHit>| h.map(|h| (h.t.to_bits(), h.target));
        return if bits(a) == bits(scaled) { Ok(0.0) } else { wrong() };
    }
    // Near a start within rounding of the surface, or where the ray is nearly tangent, the answer is rounding's.
    let touches = |t: f64| {
        let x = ray.origin.as_dvec3() + ray.direction.as_dvec3() * t;
        let slope = base.field.gradient(x).dot(base.lattice().axes() * ray.direction.as_dvec3()).abs();
        let off = (base.field.value(x) - f64::from(ray.isovalue)).abs();
        (slope, off)
    };
    match (a, scaled) {
        (None, None) => Ok(0.0),
        (Some(a), Some(b)) if a.target == b.target => {
            let (slope, _) = touches(f64::from(a.t));
            let (ta, tb) = (f64::from(a.t), f64::from(b.t));
            // Samples, isovalue, origin and direction are f32: a few 1e-7 of everything, over the slope.
            let rounding = 2e-6 / slope;
            Ok((((ta - tb).abs() - rounding).max(0.0)) / ta.max(tb).max(0.1))
        }
        _ => {
            let first = a.iter().chain(&scaled).map(|h| f64::from(h.t)).fold(f64::INFINITY, f64::min);
            let (slope, off) = touches(first);
            // A crossing that one of them does not see must be a touch: flat along the ray, or at its very start.
            if slope < 2e-2 || (first < 1e-4 && off < 1e-5) { Ok(0.0) } else { wrong() }
        }
    }
}

/// Intersections under every change.
///
/// # Errors
/// `Embree`, `Interrupted`.
pub fn intersections(rays: u64, device: &Device, progress: Progress) -> Result<Vec<Case>> {
    let base = scene(N, &SAME, false)?;
    let tracer = GraphTracer::new(device, &base)?;
    changes()
        .iter()
        .map(|change| {
            let other = scene(N, change, false)?;
            let other_tracer = GraphTracer::new(device, &other)?;
            let tally = many(progress, "invariance", rays, f64::INFINITY, |i| {
                let a = ray(&base, &SAME, i);
                let b = ray(&other, change, i);
                Some(compare(&base, &a, change, tracer.intersect(&a), other_tracer.intersect(&b)))
            })?;
            let (bound, note) = if change.exact {
                (None, "every bit of every hit")
            } else {
                (Some(BOUND), "relative change of t beyond f32 rounding over the slope")
            };
            Ok(tally.case("invariance", change.name, bound, note))
        })
        .collect()
}

/// Rays that start on edges and corners of the box, where walls meet: under every change they find the wall of the same
/// name.
///
/// # Errors
/// `Embree`, `Interrupted`.
pub fn walls(rays: u64, device: &Device, progress: Progress) -> Result<Case> {
    let base = scene(N, &SAME, true)?;
    let tracer = GraphTracer::new(device, &base)?;
    let mut total = Tally::default();
    for change in &changes() {
        let other = scene(N, change, true)?;
        let other_tracer = GraphTracer::new(device, &other)?;
        let tally = many(progress, "walls", rays, f64::INFINITY, |i| {
            let mut rng = Rng::stream(7, Stage::Test, i);
            let last = (N - 1) as f64;
            let mut p = DVec3::new(rng.unit(), rng.unit(), rng.unit()) * last;
            p = p.round();
            let free = (rng.bits() % 4) as usize;
            (0..3).filter(|&a| a != free).for_each(|a| p[a] = if rng.bits() & 1 == 0 { 0.0 } else { last });
            let d = warp::sphere(rng.unit2()).as_vec3().as_dvec3();
            let find = |scene: &Scene, change: &Change, tracer: &GraphTracer| {
                let x = p * 0.0234375 * change.scale + change.shift;
                // Above every value: nothing but walls.
                let origin = scene.lattice().to_index(x).as_vec3();
                let ray = scene.ray(origin, d, 2.0, crate::flattened::Departure::Free);
                let name = |h: FlattenedHit| match h.target {
                    Target::Polygon(id) => scene.polygons()[id as usize].name.clone(),
                    other => format!("{other:?}"),
                };
                tracer.intersect(&ray).map(name)
            };
            let (a, b) = (find(&base, &SAME, &tracer), find(&other, change, &other_tracer));
            Some(if a == b { Ok(0.0) } else { Err(format!("{}: from {p} along {d}: {a:?}, then {b:?}", change.name)) })
        })?;
        total = total.join(tally);
    }
    Ok(total.case("invariance", "walls from the box's edges and corners", None, "the same wall under every change"))
}

/// A small bake.
fn baked(scene: &Scene, engine: Engine, seed: u64, device: &Device) -> Result<Bake> {
    let common = BakeOptions {
        engine: Some(engine),
        gather_rays: Some(16),
        shadow_rays: Some(16),
        wall_resolution: Some(8),
        seed: Some(seed),
        ..BakeOptions::default()
    };
    let options = match engine {
        Engine::Photon => BakeOptions { photons: Some(1 << 13), ..common },
        Engine::Sweep => BakeOptions { directions: Some(32), light_points: Some(8), ..common },
    };
    bake(scene, &BakeSettings::new(&options, scene)?, device, Progress::Quiet)
}

/// Mean luminance of the valid nodes of each octant of the *world*.
fn octants(scene: &Scene, bake: &Bake) -> [f64; 8] {
    let mut means = [Moments::default(); 8];
    let lattice = &bake.lattice;
    let centre = lattice.to_world(0.5 * lattice.far());
    let grid = &bake.sides[0].1;
    for o in (0..lattice.len()).filter(|&o| grid.mask[o] == Mask::Valid) {
        let x = lattice.to_world(lattice.point(o)) - centre;
        let step = 1e-6 * lattice.spacing().max_element();
        // Nodes on the middle planes belong to neither side.
        if x.abs().min_element() > step {
            let n = usize::from(x.x > 0.0) | usize::from(x.y > 0.0) << 1 | usize::from(x.z > 0.0) << 2;
            means[n].push(grid.radiance[o].iter().map(|&x| f64::from(x)).sum::<f64>() * scene.exposure());
        }
    }
    means.map(|m| m.mean())
}

/// Bakes by one engine under every change: the same bits where that is promised, else the same light in every octant by
/// z-tests over independent seeds at a family-wise level of 1e-3.
///
/// # Errors
/// From [`bake`].
pub fn bakes(engine: Engine, count: u64, device: &Device, progress: Progress) -> Result<Vec<Case>> {
    const SIZE: usize = 10;
    let base = scene(SIZE, &SAME, true)?;
    let runs = |scene: &Scene, first: u64| -> Result<[Moments; 8]> {
        let mut moments = [Moments::default(); 8];
        for k in 0..count {
            let means = octants(scene, &baked(scene, engine, first + k, device)?);
            moments.iter_mut().zip(means).for_each(|(m, x)| m.push(x));
        }
        Ok(moments)
    };
    let stage = progress.stage("bakes", 1 + changes().len() as u64);
    let first = runs(&base, 100)?;
    let reference = bits(&baked(&base, engine, 1, device)?);
    let changes = changes();
    // Several changes × 8 octants; Student's t with few seeds is wider than a normal, so the level is 1e-3 of that.
    let limit = student_limit(sidak(1e-3, 2 * 8 * (changes.len() + 1)), 2 * count - 2);
    let mut cases = Vec::new();
    // Nothing but other seeds: what the statistic is when nothing can matter.
    let control = Change { name: "nothing but other seeds", ..SAME };
    for (n, change) in [control].iter().chain(&changes).enumerate() {
        let other = scene(SIZE, change, true)?;
        let (mut tally, mut apart) = (Tally::default(), 0f64);
        let h_only = change.exact && change.scale == 1.0 && change.shift == DVec3::ZERO;
        if h_only {
            let same = bits(&baked(&other, engine, 1, device)?) == reference;
            tally.push(0, if same { Ok(0.0) } else { Err("a bake's bits change".into()) });
        } else {
            let second = runs(&other, 1000 * (n as u64 + 1))?;
            for (octant, (a, b)) in first.iter().zip(&second).enumerate() {
                let error = (a.std_error().powi(2) + b.std_error().powi(2)).sqrt();
                let difference = (a.mean() - b.mean()).abs();
                apart = apart.max(difference / a.mean());
                tally.push(octant as u64, Ok(difference / error));
            }
        }
        let note = if h_only {
            "every bit of the grid".to_owned()
        } else {
            format!("standard errors, light per octant; at most {:.2} % apart", 100.0 * apart)
        };
        let by = match engine {
            Engine::Photon => "bake, photons",
            Engine::Sweep => "bake, sweeps",
        };
        cases.push(tally.case(by, change.name, (!h_only).then_some(limit), &note));
        if !stage.tick(1) {
            break;
        }
    }
    stage.end()?;
    Ok(cases)
}

/// |t| that Student's t of `dof` degrees exceeds with probability `p`: the normal quantile by Cornish–Fisher
/// \[AS72 26.7.5\].
fn student_limit(p: f64, dof: u64) -> f64 {
    let (x, n) = (normal_quantile(p), dof as f64);
    let (x3, x5, x7) = (x.powi(3), x.powi(5), x.powi(7));
    let x9 = x.powi(9);
    x + (x3 + x) / (4.0 * n)
        + (5.0 * x5 + 16.0 * x3 + 3.0 * x) / (96.0 * n * n)
        + (3.0 * x7 + 19.0 * x5 + 17.0 * x3 - 15.0 * x) / (384.0 * n.powi(3))
        + (79.0 * x9 + 776.0 * x7 + 1482.0 * x5 - 1920.0 * x3 - 945.0 * x) / (92160.0 * n.powi(4))
}

fn bits(bake: &Bake) -> Vec<u32> {
    let mut bits = Vec::new();
    for (_, grid) in &bake.sides {
        bits.extend(grid.radiance.as_flattened().iter().chain(&grid.std_error).map(|x| x.to_bits()));
        bits.extend(grid.mask.iter().map(|&m| m as u32));
    }
    let textures = bake.flats.iter().flatten().flat_map(FlatLight::textures);
    bits.extend(textures.flat_map(|t| t.texels.as_flattened().iter().map(|x| x.to_bits())));
    bits
}

/// Intersections, then bakes.
///
/// # Errors
/// `Embree`, `Interrupted`.
pub fn cases(trials: &Trials, device: &Device, progress: Progress) -> Result<Vec<Case>> {
    let mut cases = intersections(trials.invariance, device, progress)?;
    cases.push(walls(trials.invariance / 10, device, progress)?);
    for engine in [Engine::Photon, Engine::Sweep] {
        cases.extend(bakes(engine, trials.bakes, device, progress)?);
    }
    Ok(cases)
}
