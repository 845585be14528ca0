//! Closed level sets seen from inside, with the sign oracle: a ray that starts where h ≥ c and leaves Ω where h < c
//! must meet the surface from the higher side, whatever the isovalue and however degenerate the ray.

use glam::{DVec3, Vec3};
use isolume::embree::{Device, GraphTracer};
use isolume::field::{Field, Sweep};
use isolume::flattened::{Departure, FlattenedRay, Side, Target};
use isolume::rng::{Rng, Stage};
use isolume::scene::{Boundary, Scene, Surface, cornell_box};
use isolume::tracer::Tracer;
use isolume::volume::{Lattice, Samples, Volume};
use isolume::warp;
use rayon::prelude::*;

/// Random 8-bit noise inside a shell of zeros, so that every level set is closed.
fn noise(dims: [usize; 3], spacing: DVec3, origin: DVec3, levels: u8) -> Scene {
    let lattice = Lattice::aligned(dims, origin, spacing).unwrap();
    let mut rng = Rng::stream(5, Stage::Test, u64::from(levels));
    let samples = (0..lattice.len())
        .map(|o| {
            let ijk = lattice.ijk(o);
            let border = (0..3).any(|a| ijk[a] == 0 || ijk[a] == dims[a] - 1);
            if border { 0 } else { (rng.bits() % u64::from(levels)) as u8 }
        })
        .collect();
    let volume = Volume::new("noise", lattice, Samples::U8(samples)).unwrap();
    let field = Field::new(&volume, Sweep::new(0.0, f64::from(levels - 1)).unwrap()).unwrap();
    Scene::new(field, Surface::default(), Boundary::Open, Vec::new()).unwrap()
}

/// A start inside Ω: random, on a lattice plane, on an edge, or on a vertex.
fn start(rng: &mut Rng, dims: [usize; 3]) -> Vec3 {
    let class = rng.bits() % 4;
    let mut p = [0f32; 3];
    for (a, x) in p.iter_mut().enumerate() {
        let free = 1.0 + rng.unit() * (dims[a] as f64 - 3.0);
        *x = if (a as u64) < class { free.round() as f32 } else { free as f32 };
    }
    Vec3::from_array(p)
}

/// A direction: random, with components ±0, tiny, denormal, or along a diagonal.
fn direction(rng: &mut Rng) -> Vec3 {
    let mut d = warp::sphere(rng.unit2()).as_vec3();
    for a in 0..3 {
        match rng.bits() % 16 {
            0 => d[a] = 0.0,
            1 => d[a] = -0.0,
            2 => d[a] *= 1e-7,
            3 => d[a] = f32::from_bits((rng.bits() % 1000) as u32),
            4 => d[a] = 1.0f32.copysign(d[a]),
            _ => {}
        }
    }
    if d.abs().max_element() < 1e-3 { Vec3::X } else { d }
}

/// Rays of one scene; returns (tested, misses, disagreements of `occluded`).
fn misses(scene: &Scene, levels: u8, rays: u64, seed: u64) -> (u64, u64, u64) {
    let device = Device::new(1).unwrap();
    let tracer = GraphTracer::new(&device, scene).unwrap();
    let dims = scene.lattice().dims();
    (0..rays as usize)
        .into_par_iter()
        .with_min_len(4096)
        .map(|i| {
            let i = i as u64;
            let mut rng = Rng::stream(seed, Stage::Test, i);
            let origin = start(&mut rng, dims);
            // Half of the isovalues are integers, which the samples are too.
            let c = if i.is_multiple_of(2) {
                scene.field.sweep().isovalue((1 + rng.bits() % u64::from(levels - 1)) as f64)
            } else {
                rng.unit() as f32
            };
            let value = scene.field.value(origin.as_dvec3());
            if c <= 0.0 || value < f64::from(c) {
                return (0, 0, 0);
            }
            let ray = FlattenedRay::free(origin, direction(&mut rng), c);
            let hit = tracer.intersect(&ray);
            let missed = !matches!(hit, Some(h) if h.target == Target::Surface(Side::Higher) && h.t >= 0.0);
            (1, u64::from(missed), u64::from(tracer.occluded(&ray) != hit.is_some()))
        })
        .reduce(|| (0, 0, 0), |a, b| (a.0 + b.0, a.1 + b.1, a.2 + b.2))
}

#[test]
fn ten_million_rays_from_inside_all_hit() {
    let mut total = 0;
    let cases = [
        ("u8 noise", noise([33, 34, 35], DVec3::ONE, DVec3::ZERO, 255), 255u8, 18_000_000u64),
        ("four grey levels: plateaus", noise([33, 34, 35], DVec3::ONE, DVec3::ZERO, 4), 4, 6_000_000),
        (
            "1:1:50, far away",
            noise([20, 21, 22], DVec3::new(1.0, 1.0, 50.0), DVec3::new(148376.0, 1234.0, -223423.0), 9),
            9,
            6_000_000,
        ),
        ("across pyramid blocks", noise([140, 70, 19], DVec3::ONE, DVec3::ZERO, 33), 33, 4_000_000),
    ];
    for (name, scene, levels, rays) in cases {
        let (tested, misses, disagreements) = misses(&scene, levels, rays, 1);
        println!("{name}: {tested} rays, {misses} misses, {disagreements} disagreements of occluded");
        assert_eq!((misses, disagreements), (0, 0), "{name}");
        total += tested;
    }
    println!("{total} rays from inside");
    assert!(total >= 10_000_000, "only {total} rays started inside");
}

#[test]
fn rays_that_leave_the_surface_do_not_find_it_again() {
    // A sphere: from its outside no ray towards the outer half-space can meet it again, from inside every ray must,
    // once, on the far side.
    let n = 49;
    let lattice = Lattice::aligned([n; 3], DVec3::ZERO, DVec3::splat(1.0 / (n - 1) as f64)).unwrap();
    let samples = (0..lattice.len())
        .map(|o| {
            let [i, j, k] = lattice.ijk(o);
            let x = lattice.to_world(DVec3::new(i as f64, j as f64, k as f64)) - 0.5;
            1.0 - x.length_squared() as f32 * 4.0
        })
        .collect();
    let volume = Volume::new("ball", lattice, Samples::F32(samples)).unwrap();
    let field = Field::new(&volume, Sweep::new(0.0, 1.0).unwrap()).unwrap();
    let scene = Scene::new(field, Surface::default(), Boundary::Open, Vec::new()).unwrap();
    let device = Device::new(1).unwrap();
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    let (mut rehits, mut leaks, mut wrong_side) = (0, 0, 0);
    let trials = 400_000u64;
    for i in 0..trials {
        let mut rng = Rng::stream(2, Stage::Test, i);
        let c = (0.1 + 0.85 * rng.unit()) as f32;
        let d = warp::sphere(rng.unit2());
        let centre = Vec3::splat((n - 1) as f32 / 2.0);
        let first = FlattenedRay::free(centre, d.as_vec3(), c);
        let hit = tracer.intersect(&first).expect("the centre is inside");
        let origin = first.at(hit.t).as_vec3();
        // Grazing directions included: down to 1e-6 above the trilinear tangent plane.
        let g = scene.field.gradient(origin.as_dvec3()).normalize();
        let tangent = g.cross(warp::sphere(rng.unit2())).normalize();
        let rise = 10f64.powf(-6.0 * rng.unit());
        let out = (tangent - g * rise).as_vec3();
        let leave = FlattenedRay { departure: Departure::Surface(Side::Lower), ..FlattenedRay::free(origin, out, c) };
        // Cells are facets of hyperboloids, so a grazing ray can meet the next cell's bulge: only steep ones must not.
        if rise > 0.2 && tracer.intersect(&leave).is_some() {
            rehits += 1;
        }
        if matches!(tracer.intersect(&leave), Some(h) if h.t == 0.0) {
            rehits += 1;
        }
        let inward = (tangent + g * rise.max(0.05)).as_vec3();
        let through =
            FlattenedRay { departure: Departure::Surface(Side::Higher), ..FlattenedRay::free(origin, inward, c) };
        match tracer.intersect(&through) {
            Some(h) if h.target == Target::Surface(Side::Higher) && h.t > 0.0 => {}
            Some(_) => wrong_side += 1,
            None => leaks += 1,
        }
    }
    println!("{trials} spawned rays: {rehits} re-hits, {leaks} leaks, {wrong_side} on the wrong side");
    assert_eq!((rehits, leaks, wrong_side), (0, 0, 0));
}

#[test]
fn batches_find_what_single_rays_find() {
    let plain = noise([33, 34, 35], DVec3::ONE, DVec3::ZERO, 4);
    for (boundary, margin) in [(Boundary::Open, 0.0), (Boundary::Open, 0.2), (Boundary::Capped, 0.2)] {
        let polygons = cornell_box(plain.lattice(), margin).unwrap();
        let scene = Scene::new(plain.field.clone(), Surface::default(), boundary, polygons).unwrap();
        let device = Device::new(1).unwrap();
        let tracer = GraphTracer::new(&device, &scene).unwrap();
        let mut rng = Rng::stream(9, Stage::Test, 0);
        // Not a multiple of sixteen.
        let rays: Vec<_> = (0..50_003)
            .map(|_| {
                let origin = start(&mut rng, scene.lattice().dims());
                let mut ray = FlattenedRay::free(origin, direction(&mut rng), 0.9 * rng.unit() as f32);
                if rng.bits().is_multiple_of(4) {
                    ray.reach = (10.0 * rng.unit()) as f32;
                }
                ray
            })
            .collect();
        let mut hits = vec![None; rays.len()];
        let mut blocked = vec![false; rays.len()];
        tracer.intersect_many(&rays, &mut hits);
        tracer.occluded_many(&rays, &mut blocked);
        let mut kinds = [0; 3];
        for ((ray, hit), blocked) in rays.iter().zip(hits).zip(blocked) {
            assert_eq!(hit.is_some(), blocked, "{ray:?}");
            // Embree may ask for the volume with the reach that a polygon left over: t can differ in its last bit.
            let single = tracer.intersect(ray);
            assert_eq!(hit.map(|h| h.target), single.map(|h| h.target), "{ray:?}");
            let t = |h: Option<isolume::flattened::FlattenedHit>| h.map_or(0.0, |h| h.t);
            assert!((t(hit) - t(single)).abs() <= 1e-6 * t(single), "{ray:?}: {hit:?}, {single:?}");
            kinds[match hit.map(|h| h.target) {
                Some(Target::Polygon(_)) => 0,
                Some(_) => 1,
                None => 2,
            }] += 1;
        }
        assert!(kinds.iter().all(|&n| n > 100), "{kinds:?}: polygons, volume, nothing");
    }
}
