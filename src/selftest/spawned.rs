//! Rays that leave the surface they start on: they must not find their own start again, and those that go inside a
//! closed level set must not get out unseen.
//!
//! The judge divides the known root t = 0 out of the exact polynomial of the first cell: what is left, a quadratic,
//! says in double-double whether a hit in that cell is real. Beyond the first cell a hit must be a zero of h − c.

use super::double::Double;
use super::watertight::{closed, start};
use super::{Case, Trials, many};
use crate::embree::{Device, GraphTracer};
use crate::error::Result;
use crate::field::Field;
use crate::flattened::{Departure, FlattenedHit, FlattenedRay, Side, Target};
use crate::progress::Progress;
use crate::rng::{Rng, Stage};
use crate::scene::Scene;
use crate::tracer::Tracer;
use crate::warp;
use glam::{DVec3, Vec3};

/// A hit's t is f32: steps of it by which a real zero may be off.
const T_STEPS: f64 = 4.0;

/// Multiples of ε max|s| below which the sign of h − c means nothing.
const NOISE: f64 = 64.0;

struct Kind {
    name: &'static str,
    scene: Scene,
    /// Isovalues, units of the sweep.
    range: [f64; 2],
}

fn kinds() -> Result<Vec<Kind>> {
    let n = 33usize;
    let ball = move |[i, j, k]: [usize; 3]| {
        let x = DVec3::new(i as f64, j as f64, k as f64) / (n - 1) as f64 - 0.5;
        (1.0 - 4.0 * x.length_squared()).max(0.0)
    };
    let at = |scale: f64| [DVec3::splat(scale), DVec3::ZERO];
    let mut kinds = Vec::new();
    for (name, scale, value) in [
        ("ball", 1.0, 1.0),
        ("ball, scale 1e-8", 1e-8, 1.0),
        ("ball, scale 1e8", 1e8, 1.0),
        ("ball, values 1e-30", 1.0, 1e-30),
        ("ball, values 1e30", 1.0, 1e30),
    ] {
        let scene = closed([n; 3], at(scale), [0.0, value], 0.0, |ijk, _| value * ball(ijk))?;
        kinds.push(Kind { name, scene, range: [0.1, 0.95] });
    }
    let noise = closed([n, n + 1, n + 2], at(1.0), [0.0, 255.0], 0.0, |_, bits| (bits % 256) as f64)?;
    kinds.push(Kind { name: "u8 noise", scene: noise, range: [0.02, 0.98] });
    // Every fourth plane stands 2e-4 … 8e-4 above the isovalues around ½, its neighbours far below.
    let sheets = closed([n; 3], at(1.0), [0.0, 1.0], 0.0, |[_, _, k], bits| {
        if k.is_multiple_of(4) { 0.5 + 1e-4 * (bits % 7 + 2) as f64 } else { 0.0 }
    })?;
    kinds.push(Kind { name: "sheets 1e-3 voxel apart", scene: sheets, range: [0.5, 0.5001] });
    let steps = [0.0, 1e-30, 1e-20, 1e-10, 0.5, 1.0, 1e10, 1e20, 1e30];
    let orders = closed([n; 3], at(1.0), [0.0, 1.0], 0.0, |_, bits| steps[(bits % 9) as usize])?;
    kinds.push(Kind { name: "values 1e-30 … 1e30 side by side", scene: orders, range: [0.01, 0.99] });
    Ok(kinds)
}

/// The cell that a ray from `o` along `d` enters, as the walk chooses it, and the start inside it.
fn entered(field: &Field, o: Vec3, d: Vec3) -> ([usize; 3], [f64; 3]) {
    let cells = field.lattice().cells();
    let mut cell = [0; 3];
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "inside the lattice")]
    for a in 0..3 {
        let p = f64::from(o[a]);
        let below = d[a] < 0.0 && p == p.floor();
        cell[a] = (p.floor() - f64::from(below)).clamp(0.0, cells[a] as f64 - 1.0) as usize;
    }
    (cell, std::array::from_fn(|a| f64::from(o[a]) - cell[a] as f64))
}

/// h − h(start) along the ray in its first cell, divided by t: exact coefficients of a quadratic, by interpolation of
/// the exact product form.
fn deflated(s: [f32; 8], p: [f64; 3], d: Vec3) -> [Double; 3] {
    // h = Σ_corner s Π (1 − x or x) with x = p + t d: multiply the three linear factors as polynomials in t.
    let mut c = [Double::default(); 4];
    for (corner, &s) in s.iter().enumerate() {
        let mut product = [Double::from(s), Double::default(), Double::default(), Double::default()];
        for a in 0..3 {
            let (x, dx) = (Double::from(p[a]), Double::from(d[a]));
            let (k0, k1) = if corner >> a & 1 == 1 { (x, dx) } else { (Double::from(1.0) - x, -dx) };
            let old = product;
            for n in 0..4 {
                product[n] = old[n] * k0 + if n > 0 { old[n - 1] * k1 } else { Double::default() };
            }
        }
        for n in 0..4 {
            c[n] = c[n] + product[n];
        }
    }
    [c[1], c[2], c[3]]
}

/// Judges the answer to a ray that left the surface into `side`.
fn judge(field: &Field, ray: &FlattenedRay, side: Side, hit: Option<FlattenedHit>) -> Result<f64, String> {
    let wrong = |what: &str| Err(format!("{what}: {ray:?} found {hit:?}"));
    let (cell, p) = entered(field, ray.origin, ray.direction);
    let s = field.corners(cell);
    let size = f64::from(s.iter().fold(0f32, |m, s| m.max(s.abs())));
    let d = ray.direction.as_dvec3();
    let q = deflated(s, p, ray.direction);
    let up = if side == Side::Higher { 1.0 } else { -1.0 };
    let noise = |t: f64| {
        let d = d.abs().element_sum();
        NOISE * f64::EPSILON * size * d * (1.0 + t * d * (1.0 + t * d))
    };
    let Some(hit) = hit else {
        // From inside a closed level set nothing escapes.
        return if side == Side::Higher { wrong("leak") } else { Ok(0.0) };
    };
    if hit.target != Target::Surface(side) {
        return wrong("wrong side");
    }
    let t = f64::from(hit.t);
    if t == 0.0 {
        // Right if the ray goes to the other side at once.
        return if up * q[0].hi <= noise(0.0) { Ok(0.0) } else { wrong("re-hit at the start") };
    }
    let quadratic = |t: f64| {
        let t = Double::from(t);
        up * (q[0] + t * (q[1] + t * q[2])).hi
    };
    let leave = (0..3)
        .map(|a| if d[a] > 0.0 { (1.0 - p[a]) / d[a] } else { p[a] / -d[a] })
        .filter(|t| t.is_finite())
        .fold(f64::INFINITY, f64::min);
    let later = t * (1.0 + T_STEPS * f64::from(f32::EPSILON));
    if later < leave {
        // Within the first cell: the quadratic must have come to the other side by then, or touch it.
        let turn = -q[1].hi / (2.0 * q[2].hi);
        let lowest = [quadratic(later), if turn > 0.0 && turn < later { quadratic(turn) } else { f64::INFINITY }];
        if lowest.iter().all(|&v| v > noise(later)) && up * q[0].hi > noise(0.0) {
            return wrong("re-hit in the first cell");
        }
        return Ok(0.0);
    }
    // Elsewhere: h − c must vanish within the steps of t.
    let o = ray.origin.as_dvec3();
    let c = exact(field, o);
    let x = o + d * t;
    let h = exact(field, x) - c;
    // Positions in f64, t in f32: the hit may stand in a cell beside the one that x falls into.
    let slack =
        T_STEPS * f64::from(f32::EPSILON) * t * d.abs().element_sum() + 64.0 * f64::EPSILON * x.abs().max_element();
    let (mut steepest, mut size) = (0.0f64, size);
    for corner in 0..8 {
        let sign = DVec3::from_array([corner & 1, corner >> 1 & 1, corner >> 2].map(|b| f64::from(2 * b - 1)));
        let (cell, _) = field.locate(x + 2.0 * slack * sign);
        let s = field.corners(cell);
        let (lo, hi) = s.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), &s| (a.min(s), b.max(s)));
        steepest = steepest.max(f64::from(hi) - f64::from(lo));
        size = size.max(f64::from(lo.abs().max(hi.abs())));
    }
    if h.hi.abs() > 3.0 * steepest * slack + NOISE * f64::EPSILON * size {
        return wrong("a hit where h is not c");
    }
    Ok(0.0)
}

fn exact(field: &Field, x: DVec3) -> Double {
    let (cell, u) = field.locate(x);
    Double::trilinear(field.corners(cell), u.to_array().map(Double::from))
}

/// Ray `index`: from a point of the surface found from a random start inside, into `side`, at an angle to the tangent
/// plane down to 1e-6.
#[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
fn spawn<T: Tracer>(kind: &Kind, tracer: &T, index: u64) -> Option<(FlattenedRay, Side)> {
    let mut rng = Rng::stream(3, Stage::Test, index);
    let scene = &kind.scene;
    let lattice = scene.lattice();
    let c = (kind.range[0] + (kind.range[1] - kind.range[0]) * rng.unit()) as f32;
    let origin = start(&mut rng, lattice.dims()).as_vec3();
    if scene.field.value(origin.as_dvec3()) < f64::from(c) {
        return None;
    }
    let first = scene.ray(origin, warp::sphere(rng.unit2()) * lattice.spacing().x, c, Departure::Free);
    let hit = tracer.intersect(&first)?;
    let origin = first.at(hit.t).as_vec3();
    // The shell is 0: below 0 no level set is closed, and rounding to f32 may have left the surface by a lot where it
    // is steep.
    let here = scene.field.value(origin.as_dvec3());
    if !(here > 0.0) || !(0..3).all(|a| f64::from(origin[a]) >= 0.0 && f64::from(origin[a]) <= lattice.far()[a]) {
        return None;
    }
    let gradient = scene.field.gradient(origin.as_dvec3());
    let normal = (gradient / gradient.abs().max_element()).normalize();
    if !normal.is_finite() {
        return None;
    }
    let tangent = normal.cross(warp::sphere(rng.unit2())).normalize();
    let side = if rng.bits() & 1 == 0 { Side::Lower } else { Side::Higher };
    let rise = 10f64.powf(-6.0 * rng.unit()) * if side == Side::Higher { 1.0 } else { -1.0 };
    let direction = (tangent + normal * rise).normalize();
    if !direction.is_finite() {
        return None;
    }
    Some((scene.ray(origin, direction, here as f32, Departure::Surface(side)), side))
}

/// Rays, shared among the scenes.
///
/// # Errors
/// `Embree`, `Interrupted`.
pub fn cases(trials: &Trials, device: &Device, progress: Progress) -> Result<Vec<Case>> {
    let kinds = kinds()?;
    let share = trials.spawned.div_ceil(kinds.len() as u64);
    kinds
        .iter()
        .map(|kind| {
            let tracer = GraphTracer::new(device, &kind.scene)?;
            let tally = many(progress, "spawned", share, trials.seconds, |i| {
                let (ray, side) = spawn(kind, &tracer, i)?;
                let hit = tracer.intersect(&ray);
                if tracer.occluded(&ray) != hit.is_some() {
                    return Some(Err(format!("{ray:?} found {hit:?}, but `occluded` says otherwise")));
                }
                Some(judge(&kind.scene.field, &ray, side, hit))
            })?;
            Ok(tally.case("spawned", kind.name, None, "both sides, grazing to 1e-6 rad"))
        })
        .collect()
}
