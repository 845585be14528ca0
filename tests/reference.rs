//! The reference against answers known without it: hits of two tracers, closed forms, two integrators; and the numbers
//! that `compare` makes of it.

use glam::DVec3;
use isolume::accuracy::{ReferenceMesh, compare};
use isolume::brdf::reflected;
use isolume::direct::{Receiver, luminance};
use isolume::embree::{Device, GraphTracer, SurfaceTracer};
use isolume::export::ply::PlyMesh;
use isolume::field::{Field, Sweep};
use isolume::flattened::{Departure, FlattenedRay, Side, Target};
use isolume::polygon::Polygon;
use isolume::progress::Progress;
use isolume::reference::{Integrator, PathTracer, ReferenceSettings, path_picture, reference, subset};
use isolume::render::Camera;
use isolume::rng::{Rng, Stage};
use isolume::scene::{Boundary, Scene, Surface, cornell_box};
use isolume::stats::{normal_quantile, sidak};
use isolume::surface_mesh::SurfaceMesh;
use isolume::tracer::Tracer;
use isolume::volume::generate::Generator;
use isolume::volume::{Lattice, Samples, Volume};
use isolume::warp;

#[path = "reference/floor.rs"]
mod floor;

fn device() -> Device {
    Device::new(1).unwrap()
}

/// h = |x|² on [−1, 1]³, n³ samples, in the sweep [0, 1]: balls of radius √c, inside where h < c.
fn balls(n: usize, surface: Surface, polygons: Vec<Polygon>) -> Scene {
    let lattice = Lattice::aligned([n; 3], DVec3::splat(-1.0), DVec3::splat(2.0 / (n - 1) as f64)).unwrap();
    let samples = (0..lattice.len()).map(|o| lattice.to_world(lattice.point(o)).length_squared() as f32).collect();
    let volume = Volume::new("balls", lattice, Samples::F32(samples)).unwrap();
    let field = Field::new(&volume, Sweep::new(0.0, 1.0).unwrap()).unwrap();
    Scene::new(field, surface, Boundary::Open, polygons).unwrap()
}

fn bumps(n: usize) -> Scene {
    generated("bumps", n, [3.6, 95.0])
}

/// A generated field in the default box.
fn generated(name: &str, n: usize, [lo, hi]: [f64; 2]) -> Scene {
    let volume = Generator::from_name(name).unwrap().sample([n; 3]).unwrap();
    let field = Field::new(&volume, Sweep::new(lo, hi).unwrap()).unwrap();
    let polygons = cornell_box(field.lattice(), 0.0).unwrap();
    Scene::new(field, Surface::default(), Boundary::Open, polygons).unwrap()
}

/// Rays from random points in random directions: (share with the same target, mean and worst distance between the hits
/// of those that meet the surface at more than 20°, measured along the normal, in cells).
fn agreement(scene: &Scene, c: f32, refine: usize, rays: u64) -> (f64, f64, f64) {
    let device = device();
    let (triangles, graph) =
        (SurfaceTracer::new(&device, scene, c, refine).unwrap(), GraphTracer::new(&device, scene).unwrap());
    let far = scene.lattice().far();
    let (mut same, mut sum, mut worst, mut count) = (0u64, 0.0, 0f64, 0u64);
    for i in 0..rays {
        let mut rng = Rng::stream(1, Stage::Test, i);
        let origin = (far * DVec3::new(rng.unit(), rng.unit(), rng.unit())).as_vec3();
        let ray = FlattenedRay::free(origin, warp::sphere(rng.unit2()).as_vec3(), c);
        let (a, b) = (triangles.intersect(&ray), graph.intersect(&ray));
        assert_eq!(triangles.occluded(&ray), a.is_some(), "{ray:?}");
        let (Some(a), Some(b)) = (a, b) else {
            same += u64::from(a.is_none() && b.is_none());
            continue;
        };
        same += u64::from(a.target == b.target);
        if a.target != b.target || !matches!(a.target, Target::Surface(_)) {
            continue;
        }
        let cosine = scene.normal(ray.at(b.t), Side::Lower).unwrap().dot(ray.direction.as_dvec3()).abs();
        if cosine > 0.35 {
            let distance = f64::from((a.t - b.t).abs()) * cosine;
            (sum, worst, count) = (sum + distance, worst.max(distance), count + 1);
        }
    }
    (same as f64 / rays as f64, sum / count as f64, worst)
}

#[test]
fn triangles_and_the_trilinear_surface_are_hit_at_the_same_places() {
    // A chord of a sphere of R cells leaves it by at most (√3)²/8R within a cell; a factor 4 for the ray's own slope
    // and for saddles. Four times less with cells cut in two.
    let scene = balls(33, Surface::default(), Vec::new());
    let bound = |refine: f64| 4.0 * 3.0 / (8.0 * 0.8 * 16.0) / (refine * refine);
    for (refine, factor) in [(1, 1.0), (2, 2.0)] {
        let (same, mean, worst) = agreement(&scene, 0.64, refine, 50_000);
        assert!(same > 0.998 && worst < bound(factor), "ball, refine {refine}: {same} {mean} {worst}");
    }
    let scene = bumps(41);
    let c = scene.field.sweep().isovalue(47.0);
    let (coarse, fine) = (agreement(&scene, c, 1, 50_000), agreement(&scene, c, 3, 50_000));
    assert!(coarse.0 > 0.995 && fine.0 > 0.999, "targets: {coarse:?} {fine:?}");
    assert!(fine.1 < 0.3 * coarse.1 && coarse.1 < 0.03, "distances fall with refinement: {coarse:?} {fine:?}");
}

#[test]
fn starts_on_the_surface_meet_neither_it_nor_a_hole() {
    let scene = balls(25, Surface::default(), Vec::new());
    let device = device();
    let tracer = SurfaceTracer::new(&device, &scene, 0.64, 1).unwrap();
    let mesh = tracer.mesh().clone();
    let (mut rays, mut at_start, mut missed, mut hit_outside) = (0u64, 0u64, 0u64, 0u64);
    let mut cast = |p: DVec3, i: u64| {
        let mut rng = Rng::stream(2, Stage::Test, i);
        for (side, n) in [(Side::Lower, -1.0), (Side::Higher, 1.0)] {
            let normal = n * scene.lattice().to_world(p).normalize();
            let direction = warp::Frame::new(normal).to_world(warp::cosine_hemisphere(rng.unit2()));
            let ray = scene.ray(p.as_vec3(), direction, 0.64, Departure::Surface(side));
            let hit = tracer.intersect(&ray);
            assert_eq!(tracer.occluded(&ray), hit.is_some(), "{ray:?}");
            rays += 1;
            match (hit, side) {
                (Some(h), _) if h.t == 0.0 => at_start += 1,
                // Inside the ball every ray ends on it, where the chord says.
                (Some(h), Side::Lower) => {
                    let chord = 2.0 * 0.8 * direction.dot(normal);
                    assert!((f64::from(h.t) - chord).abs() < 0.05 + 0.02 / direction.dot(normal), "{h:?} {chord}");
                    assert_eq!(h.target, Target::Surface(Side::Lower));
                }
                (None, Side::Lower) => missed += 1,
                (Some(_), Side::Higher) => hit_outside += 1,
                (None, Side::Higher) => {}
            }
        }
    };
    for (i, &v) in mesh.vertices.iter().enumerate() {
        (0..10).for_each(|k| cast(v, (i * 10 + k) as u64));
    }
    for (i, t) in mesh.triangles.iter().enumerate() {
        let [a, b, c] = t.map(|v| mesh.vertices[v as usize]);
        let mut rng = Rng::stream(3, Stage::Test, i as u64);
        let [u, v] = warp::triangle(rng.unit2());
        // Middles of edges, too.
        (0..5).for_each(|k| cast(a + u * (b - a) + v * (c - a), (1 << 32) + (i * 5 + k) as u64));
        (0..5).for_each(|k| cast(0.5 * (a + b), (2 << 32) + (i * 5 + k) as u64));
    }
    // 0.1 %: marching cubes' triangles of a ball are not quite convex.
    assert_eq!(missed, 0, "of {rays} rays");
    assert!((hit_outside as f64) < 1e-3 * rays as f64, "{hit_outside} of {rays}");
    assert!((at_start as f64) < 0.03 * rays as f64, "{at_start} of {rays}");
}

#[test]
fn integrating_sphere() {
    // A small square light in the middle of a ball of radius R: the indirect part of E is ρΦ/(4πR²(1−ρ)) everywhere.
    let (rho, radius, half) = (0.5, 0.8, 0.01);
    let corner = |x: f64, y: f64| DVec3::new(x * half, y * half, 0.0);
    let square = vec![corner(-1., -1.), corner(-1., 1.), corner(1., 1.), corner(1., -1.)];
    let light = Polygon::new("light", square, DVec3::ZERO, DVec3::ONE).unwrap();
    let flux = std::f64::consts::PI * light.area();
    let scene = balls(49, Surface { albedo: DVec3::splat(rho).into(), ..Surface::default() }, vec![light]);
    let device = device();
    let c = (radius * radius) as f32;
    let tracer = SurfaceTracer::new(&device, &scene, c, 1).unwrap();
    let mesh = SurfaceMesh::extract(&scene, c, 1).unwrap();
    let expected = rho * flux / (4.0 * std::f64::consts::PI * radius * radius * (1.0 - rho));
    let mut moments = isolume::stats::Moments::default();
    for v in subset(mesh.local.len(), Some(300)) {
        let at = Receiver::on_level_set(&scene, mesh.local[v], c, Side::Lower).unwrap();
        let mut paths = PathTracer::new(&scene, &tracer);
        let total = paths.outgoing(&at, 256, Stage::Path.key(5, v as u64));
        let direct = paths.direct(&at, 256, Stage::Path.key(5, v as u64));
        moments.push((total - reflected(DVec3::splat(rho), direct)).x * std::f64::consts::PI / rho);
    }
    // 0.5 %: triangles cut corners (0.1 % of the area), the light blocks A/πR² = 0.02 %.
    let tolerance = 0.005 * expected + 4.0 * moments.std_error();
    assert!(
        (moments.mean() - expected).abs() < tolerance,
        "{} ± {}, expected {expected}",
        moments.mean(),
        moments.std_error()
    );
}

#[test]
fn furnaces() {
    // Inside a closed level set of emission 1 − ρ and albedo ρ the radiance is 1.
    let (device, c) = (device(), 0.5);
    let rho = DVec3::new(0.7, 0.3, 0.5);
    let scene = balls(25, Surface { albedo: rho.into(), emission: DVec3::ONE - rho, ..Surface::default() }, Vec::new());
    let tracer = SurfaceTracer::new(&device, &scene, c, 1).unwrap();
    let mesh = SurfaceMesh::extract(&scene, c, 1).unwrap();
    let settings = ReferenceSettings { samples: 512, batches: 16, vertices: Some(200), ..ReferenceSettings::default() };
    let result = reference(&scene, &tracer, &mesh, c, &settings, &|_| true).unwrap();
    let level = normal_quantile(sidak(0.01, 600));
    for v in (0..mesh.local.len()).filter(|&v| result.sampled[v]) {
        for k in 0..3 {
            let z = (result.radiance[v][k] - 1.0) / result.variance[v][k].sqrt().max(1e-6);
            assert!(z.abs() < 1.6 * level, "vertex {v}: {} ± {}", result.radiance[v], result.variance[v]);
        }
    }
    // A convex level set in a black box whose six walls emit 1 reflects exactly ρ: all of it direct light.
    let mut walls = Vec::new();
    for axis in 0..3 {
        for end in [-1.0, 1.0] {
            let point = |u: f64, v: f64| {
                let mut p = DVec3::splat(end);
                (p[(axis + 1) % 3], p[(axis + 2) % 3]) = (u, v);
                p
            };
            let mut v = vec![point(-1., -1.), point(1., -1.), point(1., 1.), point(-1., 1.)];
            if end > 0.0 {
                v.reverse();
            }
            walls.push(Polygon::new("wall", v, DVec3::ZERO, DVec3::ONE).unwrap());
        }
    }
    let surface = Surface { albedo: rho.into(), outside: Side::Higher, ..Surface::default() };
    let scene = balls(25, surface, walls);
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    let mesh = SurfaceMesh::extract(&scene, c, 1).unwrap();
    let result = reference(&scene, &tracer, &mesh, c, &settings, &|_| true).unwrap();
    for v in (0..mesh.local.len()).filter(|&v| result.sampled[v]) {
        let off = (result.radiance[v] - rho).abs().max_element();
        // 2 %: next-event points behind the trilinear surface's own horizon, which the shared normal does not know.
        assert!(off < 0.02, "vertex {v}: {} instead of {rho}", result.radiance[v]);
    }
}

#[test]
fn a_furnace_at_the_line_where_surface_and_walls_meet() {
    // Above an oblique plane that cuts the walls, which reflect all: the radiance is 1 there, too. There is no floor,
    // so that a path that starts below the plane is dark.
    let rho = 0.5;
    let volume = Generator::from_name("linear:0.5,0.2,-1").unwrap().sample([17; 3]).unwrap();
    let field = Field::new(&volume, Sweep::new(-0.9, 0.6).unwrap()).unwrap();
    let lattice = field.lattice().clone();
    let corner = |i: [usize; 3]| lattice.to_world(lattice.far() * DVec3::from_array(i.map(|i| i as f64)));
    let centre = lattice.to_world(lattice.far() * 0.5);
    let wall = |(axis, end): (usize, usize)| {
        let point = |u: usize, v: usize| {
            let mut p = [end; 3];
            (p[(axis + 1) % 3], p[(axis + 2) % 3]) = (u, v);
            corner(p)
        };
        let mut v = vec![point(0, 0), point(1, 0), point(1, 1), point(0, 1)];
        if (v[1] - v[0]).cross(v[2] - v[0]).dot(centre - v[0]) < 0.0 {
            v.reverse();
        }
        Polygon::new("wall", v, DVec3::ONE, DVec3::ZERO).unwrap()
    };
    let walls = [(0, 0), (0, 1), (1, 0), (1, 1), (2, 1)].map(wall).to_vec();
    let surface = Surface { albedo: DVec3::splat(rho).into(), emission: DVec3::splat(1.0 - rho), ..Surface::default() };
    let scene = Scene::new(field, surface, Boundary::Open, walls).unwrap();
    let c = scene.field.sweep().isovalue(-0.1);
    let (device, far) = (device(), lattice.far());
    let mesh = SurfaceMesh::extract(&scene, c, 1).unwrap();
    let graph = GraphTracer::new(&device, &scene).unwrap();
    let triangles = SurfaceTracer::new(&device, &scene, c, 1).unwrap();
    let edge = |v: &usize| (0..3).any(|a| mesh.local[*v][a] == 0.0 || mesh.local[*v][a] == far[a]);
    let vertices: Vec<usize> = (0..mesh.local.len()).filter(edge).collect();
    assert!(vertices.len() > 30, "{} vertices", vertices.len());
    let level = normal_quantile(sidak(0.01, 2 * vertices.len()));
    let mut paths = (PathTracer::new(&scene, &graph), PathTracer::new(&scene, &triangles));
    for v in vertices {
        let at = Receiver::on_level_set(&scene, mesh.local[v], c, Side::Lower).unwrap();
        let mut moments = [isolume::stats::Moments::default(); 2];
        for i in 0..16 {
            moments[0].push(paths.0.outgoing(&at, 64, Stage::Path.key(3, v as u64 * 16 + i)).x);
            moments[1].push(paths.1.outgoing(&at, 64, Stage::Path.key(3, v as u64 * 16 + i)).x);
        }
        for (m, name) in moments.iter().zip(["graph", "triangles"]) {
            let z = (m.mean() - 1.0) / m.std_error().max(1e-6);
            assert!(z.abs() < 1.6 * level, "{name}, vertex {v} at {}: {} ± {}", mesh.local[v], m.mean(), m.std_error());
        }
    }
}

#[test]
fn a_rectangle_of_light() {
    // Known answers of the design: the light at z = 1 facing down, above an empty part of the volume.
    let v = [(-0.25, -0.25), (-0.25, 0.25), (0.25, 0.25), (0.25, -0.25)];
    let light = Polygon::new("light", v.map(|(x, y)| DVec3::new(x, y, 1.0)).to_vec(), DVec3::ZERO, DVec3::ONE).unwrap();
    let scene = balls(9, Surface::default(), vec![light]);
    let device = device();
    let tracer = SurfaceTracer::new(&device, &scene, 0.001, 1).unwrap();
    let cases = [
        (DVec3::new(0.2, 0.3, 0.1), DVec3::Z, 0.217_520_93),
        (DVec3::new(0.1, 0.1, 0.9), DVec3::new(0.3, 0.2, 1.0).normalize(), 2.292_566_50),
        (DVec3::new(-0.8, 0.2, 0.3), DVec3::new(1.0, 0.0, -0.35).normalize(), 0.063_425_42),
    ];
    for (x, normal, expected) in cases {
        let position = scene.lattice().to_index(x).as_vec3();
        let at = Receiver { position, normal, isovalue: 0.001, departure: Departure::Free };
        let e = PathTracer::new(&scene, &tracer).direct(&at, 64, Stage::Path.key(1, 1)).x;
        assert!((e - expected).abs() < 1e-6, "at {x}: {e}, expected {expected}");
    }
}

/// Generated fields with a sweep and an isovalue: bumps that shadow each other, two cylinders that nearly touch, an
/// oblique plane that fills the box.
const SCENES: [(&str, [f64; 2], f64); 3] =
    [("bumps", [3.6, 95.0], 47.0), ("two-cylinders", [0.1, 1.0], 0.5), ("linear:0.5,0.2,-1", [-0.9, 0.6], -0.1)];

#[test]
fn the_photon_map_agrees_with_the_path_tracer() {
    let device = device();
    let mut z = Vec::new();
    for (name, sweep, isovalue) in SCENES {
        let scene = generated(name, 33, sweep);
        let c = scene.field.sweep().isovalue(isovalue);
        let tracer = SurfaceTracer::new(&device, &scene, c, 1).unwrap();
        let mesh = SurfaceMesh::extract(&scene, c, 1).unwrap();
        let settings = |integrator, seed| ReferenceSettings {
            integrator,
            samples: 256,
            batches: 32,
            photons: 1 << 21,
            vertices: Some(400),
            seed,
            ..ReferenceSettings::default()
        };
        let photon = reference(&scene, &tracer, &mesh, c, &settings(Integrator::Photon, 1), &|_| true).unwrap();
        let path = reference(&scene, &tracer, &mesh, c, &settings(Integrator::Path, 2), &|_| true).unwrap();
        let of_scene: Vec<f64> = (0..mesh.local.len())
            .filter(|&v| path.sampled[v])
            .map(|v| {
                let difference = luminance(photon.radiance[v] - path.radiance[v]);
                // Luminance of standard deviations: the channels share their paths, so that this is an upper bound.
                let deviation = |r: &isolume::reference::Reference| luminance(r.variance[v].map(f64::sqrt));
                difference / deviation(&photon).hypot(deviation(&path)).max(1e-9)
            })
            .collect();
        let mean = of_scene.iter().sum::<f64>() / of_scene.len() as f64;
        println!(
            "{name}: {} vertices, mean z {mean:+.3}, {} rays began inside",
            of_scene.len(),
            tracer.inside_starts()
        );
        assert!(mean.abs() < 0.5, "{name}: no common bias worth half a standard deviation: {mean}");
        assert_eq!(of_scene.len(), 400, "{name}");
        z.extend(of_scene);
    }
    let level = normal_quantile(sidak(0.01, z.len()));
    let accepted = z.iter().filter(|z| z.abs() < level).count() as f64 / z.len() as f64;
    println!("{accepted} of {} accepted at |z| < {level:.2}", z.len());
    assert!(accepted >= 0.9975, "{accepted} of {} accepted", z.len());
}

/// A flat square of four vertices with its two triangles, all of radiance `r`.
fn flat(r: [f64; 4], variance: f64) -> ReferenceMesh {
    ReferenceMesh {
        positions: vec![DVec3::ZERO, DVec3::X, DVec3::new(1.0, 1.0, 0.0), DVec3::Y],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        radiance: r.map(DVec3::splat).to_vec(),
        variance: Some(vec![DVec3::splat(variance); 4]),
        sampled: vec![true; 4],
    }
}

#[test]
fn compare_computes_what_it_says() {
    // Exposure 2: references 0.4, 0.4, 0.002 (dark), 2 (clamped to 1); errors 0.1, 0, 0.004, and −0.2 after clamping.
    let reference = flat([0.2, 0.2, 0.001, 1.0], 1e-6);
    let texture = [0.25, 0.2, 0.003, 0.4].map(DVec3::splat);
    let (a, per_vertex) = compare(&texture, std::slice::from_ref(&reference), 2.0).unwrap();
    let squares = [3.0 * 0.01, 0.0, 3.0 * 1.6e-5, 3.0 * 0.04];
    let rms = |w: [f64; 4]| {
        let total: f64 = w.iter().sum();
        100.0 * (squares.iter().zip(w).map(|(s, w)| s * w).sum::<f64>() / total).sqrt()
    };
    let close = |x: f64, y: f64| assert!((x - y).abs() < 1e-9, "{x} {y}");
    close(a.percent_rms, rms([1.0; 4]));
    close(a.percent_rms_sqrt3, rms([1.0; 4]) / 3f64.sqrt());
    // Vertices 0 and 2 belong to both triangles.
    close(a.percent_rms_area, rms([2.0, 1.0, 2.0, 1.0]));
    close(a.percent_rms_lit, rms([1.0, 1.0, 0.0, 1.0]));
    close(a.lit, 0.75);
    // Noise of 0.002: all of it at 0.4, none at white, and one deviation above black that of max(−1, N), which is
    // 0.751035 (⟨z⟩ = φ(1) − Φ(−1) = 0.083315, ⟨z²⟩ = Φ(1) − φ(1) + Φ(−1) = 1 − φ(1) = 0.758029).
    let floor = 3.0 * 4e-6 * (2.0 + 0.758_029_275_480_856_6 - 0.083_315_470_587_686_3f64.powi(2)) / 4.0;
    close(a.noise_floor, 100.0 * floor.sqrt());
    let mean = squares.iter().sum::<f64>() / 4.0;
    close(a.percent_rms_without_noise, 100.0 * (mean - (a.noise_floor / 100.0).powi(2)).sqrt());
    let deviation = (squares.iter().map(|s| (s - mean).powi(2)).sum::<f64>() / 3.0 / 4.0).sqrt();
    let bounds = [-1.96, 1.96].map(|k| 100.0 * f64::max(mean + k * deviation, 0.0).sqrt());
    assert!(bounds[0] == 0.0 && bounds[1] > 0.0);
    close(a.confidence[0], bounds[0]);
    close(a.confidence[1], bounds[1]);
    close(a.max, 100.0 * 0.2 * 3f64.sqrt());
    close(a.mean, 100.0 * 3f64.sqrt() * (0.1 + 0.004 + 0.2) / 4.0);
    close(a.bias, 100.0 * (0.1 + 0.004 - 0.2) / 4.0);
    close(per_vertex[3], 0.2 * 3f64.sqrt());
    assert!(a.confidence[0] <= a.percent_rms && a.percent_rms <= a.confidence[1]);

    let refuses = |r: &[ReferenceMesh], word: &str| {
        let message = compare(&texture, r, 2.0).unwrap_err().to_string();
        assert!(message.contains(word), "{message}");
    };
    // Two vertices of nearly the same error have both bounds; noise above the error leaves nothing.
    let (near, texture_at) = (flat([0.2; 4], 1e-6), |t: [f64; 4]| t.map(DVec3::splat));
    let (b, _) = compare(&texture_at([0.25; 4]), std::slice::from_ref(&near), 2.0).unwrap();
    close(b.confidence[0], b.percent_rms);
    close(b.confidence[1], b.percent_rms);
    let (b, _) = compare(&texture_at([0.25, 0.26, 0.25, 0.26]), std::slice::from_ref(&near), 2.0).unwrap();
    // Squares 0.03 and 0.0432, twice: mean 0.0366, deviation of the mean 0.0066/√3.
    let deviation = 0.0066 / 3f64.sqrt();
    close(b.confidence[0], 100.0 * (0.0366f64 - 1.96 * deviation).sqrt());
    close(b.confidence[1], 100.0 * (0.0366f64 + 1.96 * deviation).sqrt());
    let (b, _) = compare(&texture_at([0.25; 4]), &[flat([0.2; 4], 0.004)], 2.0).unwrap();
    assert!(b.noise_floor > b.percent_rms && b.percent_rms_without_noise == 0.0, "{b:?}");

    refuses(&[], "no reference");
    refuses(&[reference.clone(), reference.clone()], "--seed");
    // References without variance are the same for every seed.
    let exact = flat([0.2; 4], 0.0);
    close(compare(&texture_at([0.25; 4]), &[exact.clone(), exact], 2.0).unwrap().0.percent_rms, 100.0 * 0.03f64.sqrt());
    // Whatever the seeds, which another one would not change.
    let black = flat([0.0; 4], 0.0);
    refuses(&[black.clone(), black.clone()], "both references are black");
    assert!(!compare(&texture, &[black.clone(), black.clone()], 2.0).unwrap_err().to_string().contains("--seed"));
    assert!(compare(&texture, &[black], 2.0).unwrap().0.percent_rms > 0.0, "one is enough");
    refuses(&[reference.clone(), ReferenceMesh { triangles: Vec::new(), ..reference.clone() }], "different meshes");
    refuses(&[ReferenceMesh { sampled: vec![false; 4], ..reference }], "no vertex");
}

#[test]
fn what_is_no_number_or_missing_is_no_reference() {
    let names =
        ["x", "y", "z", "radiance_r", "radiance_g", "radiance_b", "variance_r", "variance_g", "variance_b", "sampled"];
    let mesh = |name: &str, value: f64| PlyMesh {
        vertices: 3,
        properties: names
            .map(|n| (n.to_owned(), (0..3).map(|v| if n == name && v == 2 { value } else { 0.5 }).collect()))
            .to_vec(),
        triangles: vec![[0, 1, 2]],
        comments: Vec::new(),
    };
    ReferenceMesh::from_ply(&mesh("", 0.0)).unwrap();
    for name in names {
        for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            let Err(e) = ReferenceMesh::from_ply(&mesh(name, value)) else { panic!("{name} may be {value}") };
            let message = e.to_string();
            assert!(message.contains("vertex 2") && message.contains(name), "{name} {value}: {message}");
        }
    }
    let good = flat([0.2; 4], 1e-6);
    let texture = [DVec3::splat(0.3); 4];
    let refused = |texture: &[DVec3], bad: ReferenceMesh, what: &str| {
        let message = compare(texture, &[bad], 2.0).unwrap_err().to_string();
        assert!(message.contains(what), "{what}: {message}");
    };
    refused(&texture[..3], good.clone(), "3 colours");
    refused(&[DVec3::splat(0.3), DVec3::NAN, DVec3::ONE, DVec3::ONE], good.clone(), "vertex 1");
    refused(&texture, ReferenceMesh { radiance: vec![DVec3::ONE; 3], ..good.clone() }, "radiance");
    refused(&texture, ReferenceMesh { variance: Some(Vec::new()), ..good.clone() }, "variance");
    refused(&texture, ReferenceMesh { sampled: vec![true; 5], ..good.clone() }, "sampled");
    refused(&texture, ReferenceMesh { radiance: vec![DVec3::NAN; 4], ..good.clone() }, "radiance_r");
    refused(&texture, ReferenceMesh { positions: vec![DVec3::INFINITY; 4], ..good.clone() }, "x of vertex 0");
    refused(&texture, ReferenceMesh { triangles: vec![[0, 1, 4]], ..good }, "triangle 0");
}

#[test]
fn two_references_cancel_their_noise() {
    // Error 0.01 per channel under noise of 0.05: one reference reports √3·√(0.01² + 0.05²), two the error alone.
    let n = 40_000;
    let mut rng = Rng::stream(9, Stage::Test, 0);
    let mut noisy = || ReferenceMesh {
        positions: vec![DVec3::ZERO; n],
        triangles: Vec::new(),
        radiance: (0..n)
            .map(|_| DVec3::splat(0.5) + 0.05 * DVec3::new(rng.normal(), rng.normal(), rng.normal()))
            .collect(),
        variance: Some(vec![DVec3::splat(0.05 * 0.05); n]),
        sampled: vec![true; n],
    };
    let references = [noisy(), noisy()];
    let texture = vec![DVec3::splat(0.51); n];
    let (one, _) = compare(&texture, &references[..1], 1.0).unwrap();
    let (two, _) = compare(&texture, &references, 1.0).unwrap();
    let root3 = 3f64.sqrt();
    assert!((one.percent_rms - 100.0 * root3 * (0.01f64 * 0.01 + 0.05 * 0.05).sqrt()).abs() < 0.1, "{one:?}");
    assert!(two.confidence[0] < root3 && root3 < two.confidence[1], "{two:?}");
    assert!((two.percent_rms - root3).abs() < 0.25, "{two:?}");
    assert!((one.noise_floor - 100.0 * root3 * 0.05).abs() < 1e-9);
}

/// The variance that a reference tells is that of its radiance over seeds.
#[test]
fn references_scatter_as_they_tell() {
    const SEEDS: u64 = 24;
    let (scene, device) = (bumps(17), device());
    let c = scene.field.sweep().isovalue(47.0);
    let tracer = SurfaceTracer::new(&device, &scene, c, 1).unwrap();
    let mesh = SurfaceMesh::extract(&scene, c, 1).unwrap();
    for (integrator, samples, batches) in [(Integrator::Path, 16, 8), (Integrator::Photon, 16, 4)] {
        let made: Vec<_> = (0..SEEDS)
            .map(|seed| {
                let settings = ReferenceSettings {
                    integrator,
                    samples,
                    batches,
                    photons: 1 << 14,
                    vertices: Some(120),
                    seed,
                    ..Default::default()
                };
                reference(&scene, &tracer, &mesh, c, &settings, &|_| true).unwrap()
            })
            .collect();
        let n = SEEDS as f64;
        let told: f64 = made.iter().flat_map(|r| &r.variance).map(|v| v.element_sum()).sum::<f64>() / n;
        let mean = |v: usize| made.iter().map(|r| r.radiance[v]).sum::<DVec3>() / n;
        let squares = |v: usize| made.iter().map(|r| (r.radiance[v] - mean(v)).length_squared()).sum::<f64>();
        let found: f64 = (0..mesh.local.len()).map(squares).sum::<f64>() / (n - 1.0);
        println!("{integrator:?}: scatter over what is told {:.3}", found / told);
        assert!((0.8..1.25).contains(&(found / told)), "{integrator:?}: {found} told {told}");
    }
}

#[test]
fn subsets_are_fixed_random_and_without_repeats() {
    let s = subset(1000, Some(100));
    assert!(s.len() == 100 && s.windows(2).all(|w| w[0] < w[1]) && s[99] < 1000);
    assert_eq!(s, subset(1000, Some(100)));
    assert_eq!(subset(5, Some(9)), [0, 1, 2, 3, 4]);
    let mean = s.iter().sum::<usize>() as f64 / 100.0;
    assert!((mean - 499.5).abs() < 4.0 * 28.9, "{mean}");
}

#[test]
fn the_same_bits_on_any_number_of_threads() {
    let (scene, device) = (bumps(17), device());
    let c = scene.field.sweep().isovalue(47.0);
    let tracer = SurfaceTracer::new(&device, &scene, c, 1).unwrap();
    let mesh = SurfaceMesh::extract(&scene, c, 1).unwrap();
    for integrator in [Integrator::Path, Integrator::Photon] {
        let settings = ReferenceSettings {
            integrator,
            samples: 8,
            batches: 2,
            photons: 4096,
            vertices: Some(64),
            ..Default::default()
        };
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| reference(&scene, &tracer, &mesh, c, &settings, &|_| true).unwrap()).radiance
        };
        assert_eq!(run(1), run(3));
    }
}

/// Pictures of two cameras that look the same way from places beside each other share no noise.
#[test]
fn pictures_from_beside_have_noise_of_their_own() {
    let scene = bumps(17);
    let device = device();
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    let facing = Camera::facing(&scene, 40);
    let beside = DVec3::new(0.003, 0.0, 0.0);
    let moved = Camera { eye: facing.eye + beside, target: facing.target + beside, ..facing };
    let picture = |camera: &Camera, samples| {
        let camera = Camera { samples, ..*camera };
        path_picture(&scene, &tracer, 0.5, &camera, Progress::Quiet).unwrap().rgb
    };
    let clean = picture(&facing, 256);
    // Where nothing begins or ends, which both pictures' rays meet or miss alike.
    let even = |&n: &usize| {
        let [x, y] = [n % 40, n / 40];
        let around = |m: usize| (clean[m][1] / clean[n][1] - 1.0).abs() < 0.1;
        (1..39).contains(&x) && (1..39).contains(&y) && [n - 1, n + 1, n - 40, n + 40].into_iter().all(around)
    };
    let pixels: Vec<usize> = (0..1600).filter(even).collect();
    assert!(pixels.len() > 150, "{}", pixels.len());
    let [a, b] = [&facing, &moved].map(|camera| {
        let noisy = picture(camera, 1);
        pixels.iter().map(|&n| f64::from(noisy[n][1] - clean[n][1])).collect::<Vec<_>>()
    });
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let correlation = dot(&a, &b) / (dot(&a, &a) * dot(&b, &b)).sqrt();
    println!("correlation {correlation:.3}");
    assert!(correlation.abs() < 0.3, "{correlation}");
}
