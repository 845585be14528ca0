//! The line-sweep engine against answers that are known without a reference, and against exact rays.

use glam::{DMat3, DVec3};
use isolume::checkpoint::Checkpoint;
use isolume::embree::{Device, GraphTracer};
use isolume::error::Error;
use isolume::field::{Field, Sweep};
use isolume::flat::FlatLight;
use isolume::flattened::{Departure, Side, Target};
use isolume::polygon::Polygon;
use isolume::rng::{Rng, Sobol, Stage};
use isolume::scene::{Boundary, Scene, Surface, cornell_box};
use isolume::sweep::{SweepResult, SweepSettings, sweep, sweep_resumable};
use isolume::tracer::Tracer;
use isolume::volume::{Lattice, Samples, Volume};
use isolume::warp::{Frame, cosine_hemisphere};
use rayon::prelude::*;
use std::f64::consts::PI;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::Duration;

mod bounces;
mod luminaires;

/// A field on `lattice` from a function of the world.
fn field(lattice: Lattice, range: (f64, f64), f: impl Fn(DVec3) -> f64 + Sync) -> Field {
    let samples = (0..lattice.len())
        .into_par_iter()
        .map(|o| {
            let [i, j, k] = lattice.ijk(o).map(|x| x as f64);
            f(lattice.to_world(DVec3::new(i, j, k)))
        })
        .collect();
    let volume = Volume::new("test", lattice, Samples::F64(samples)).unwrap();
    Field::new(&volume, Sweep::new(range.0, range.1).unwrap()).unwrap()
}

/// The bumps of the design's tables on n³ samples.
fn bumps(n: usize) -> Field {
    let lattice = Lattice::aligned([n; 3], DVec3::ZERO, DVec3::splat(1.0 / (n - 1) as f64)).unwrap();
    field(lattice, (3.6, 95.0), bumps_at)
}

fn bumps_at(x: DVec3) -> f64 {
    let g = |m: [f64; 3], s: f64| (-(x - DVec3::from_array(m)).length_squared() / (2.0 * s * s)).exp();
    100.0 * g([0.5, 0.5, 0.38], 0.16)
        + 80.0 * (g([0.32, 0.40, 0.74], 0.05) + g([0.62, 0.35, 0.76], 0.05) + g([0.52, 0.66, 0.72], 0.05))
}

fn run(scene: &Scene, settings: SweepSettings) -> SweepResult {
    sweep(scene, &settings, &|_| true).unwrap()
}

fn rms(errors: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = errors.fold((0.0, 0), |(s, n), e| (s + e * e, n + 1));
    (sum / f64::from(n.max(1))).sqrt()
}

/// Valid nodes at least `skin` nodes from Ω's faces.
fn nodes(scene: &Scene, skin: usize) -> Vec<usize> {
    let dims = scene.lattice().dims();
    (0..scene.lattice().len())
        .filter(|&o| {
            let ijk = scene.lattice().ijk(o);
            (0.0..=1.0).contains(&scene.field.samples()[o])
                && (0..3).all(|a| ijk[a] >= skin && ijk[a] + skin < dims[a])
                && scene.field.node_gradient(ijk) != DVec3::ZERO
        })
        .collect()
}

const ONE_BOUNCE: SweepSettings = SweepSettings {
    directions: 256,
    light_points: 16,
    max_bounces: 1,
    target: 1e-3,
    replicates: 1,
    flat_resolution: (16, 16),
    direct: false,
    seed: 1,
};

/// The share of the cosine-weighted hemisphere over a node that meets the level set itself, by exact rays.
fn exact_occlusion(tracer: &GraphTracer, scene: &Scene, o: usize, rays: u32) -> f64 {
    let ijk = scene.lattice().ijk(o).map(|x| x as f64);
    let p = DVec3::from_array(ijk);
    let n = scene.normal(p, Side::Lower).unwrap();
    let set = Sobol::set(3, Stage::Test, o as u64);
    let frame = Frame::new(n);
    let hits = (0..rays)
        .filter(|&i| {
            let d = frame.to_world(cosine_hemisphere(set.point2(i, 0)));
            let c = scene.field.samples()[o];
            let ray = scene.ray(p.as_vec3(), d, c, Departure::Surface(Side::Lower));
            matches!(tracer.intersect(&ray), Some(h) if matches!(h.target, Target::Surface(_)))
        })
        .count();
    hits as f64 / f64::from(rays)
}

#[test]
fn swept_occlusion_agrees_with_exact_rays() {
    let surface = Surface { albedo: DVec3::ZERO.into(), emission: DVec3::ONE, ..Surface::default() };
    let scene = Scene::new(bumps(101), surface, Boundary::Open, Vec::new()).unwrap();
    let device = Device::new(1).unwrap();
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    let all = nodes(&scene, 3);
    let mut rng = Rng::stream(1, Stage::Test, 0);
    let some: Vec<usize> = (0..1000).map(|_| all[(rng.unit() * all.len() as f64) as usize]).collect();
    let exact: Vec<f64> = some.par_iter().map(|&o| exact_occlusion(&tracer, &scene, o, 4096)).collect();
    for (directions, limit) in [(64, 0.014), (256, 0.0045), (1024, 0.0018)] {
        let start = std::time::Instant::now();
        let got = run(&scene, SweepSettings { directions, ..ONE_BOUNCE });
        let error = || some.iter().zip(&exact).map(|(&o, x)| f64::from(got.sides[0].irradiance[o][1]) / PI - x);
        let bias = error().sum::<f64>() / some.len() as f64;
        let seconds = start.elapsed().as_secs_f64();
        println!(
            "{directions} directions: RMS {:.5}, bias {bias:.5}, {seconds:.2} s, {:.1} M rays/s",
            rms(error()),
            got.counts.gather_rays as f64 / seconds * 1e-6
        );
        assert!(rms(error()) < limit, "{directions} directions: RMS {}", rms(error()));
    }
}

/// Level sets that run into all of Ω's faces: what nodes on a face see of them, half a voxel from the nearest lines,
/// and nothing beyond the face. While the lines' light went on linearly in all directions, the RMS was 1.4 to 1.7 times
/// that within, and 2.6 with a bias of 0.014 on the upper and lower face of voxels three times as high as wide.
#[test]
fn nodes_on_faces_see_as_much_as_exact_rays() {
    for height in [1.0, 3.0] {
        faces_see_as_much_as_exact_rays(height);
    }
}

fn faces_see_as_much_as_exact_rays(height: f64) {
    let lattice = Lattice::aligned([41; 3], DVec3::ZERO, DVec3::new(1.0, 1.0, height) / 40.0).unwrap();
    let gyroid = |x: DVec3| {
        let x = x / DVec3::new(1.0, 1.0, height);
        let [(sx, cx), (sy, cy), (sz, cz)] = (x * 9.0 + 0.4).to_array().map(f64::sin_cos);
        sx * cy + sy * cz + sz * cx
    };
    let surface = Surface { albedo: DVec3::ZERO.into(), emission: DVec3::ONE, ..Surface::default() };
    let scene = Scene::new(field(lattice, (-1.0, 1.0), gyroid), surface, Boundary::Open, Vec::new()).unwrap();
    let device = Device::new(1).unwrap();
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    let got = run(&scene, ONE_BOUNCE);
    let mut rng = Rng::stream(2, Stage::Test, 0);
    let mut off = |among: &[usize]| {
        let some: Vec<usize> = (0..150).map(|_| among[(rng.unit() * among.len() as f64) as usize]).collect();
        let exact: Vec<f64> = some.par_iter().map(|&o| exact_occlusion(&tracer, &scene, o, 1024)).collect();
        let error = || some.iter().zip(&exact).map(|(&o, x)| f64::from(got.sides[0].irradiance[o][1]) / PI - x);
        (rms(error()), error().sum::<f64>() / some.len() as f64)
    };
    let (within, _) = off(&nodes(&scene, 3));
    let all = nodes(&scene, 0);
    for (axis, end) in (0..3).flat_map(|axis| [(axis, 0), (axis, 40)]) {
        let face: Vec<usize> = all.iter().copied().filter(|&o| scene.lattice().ijk(o)[axis] == end).collect();
        let (rms, bias) = off(&face);
        println!("height {height}, axis {axis} at {end}: RMS {rms:.4}, bias {bias:.4}, within {within:.4}");
        assert!(rms < 1.45 * within && bias.abs() < 0.004, "axis {axis} at {end}: RMS {rms}, bias {bias}");
    }
}

#[test]
fn integrating_sphere() {
    // Inside a sphere of any radius the reflected light of a small source is the same everywhere: ρΦ/(4πR²(1−ρ)).
    let n = 65;
    let lattice = Lattice::aligned([n; 3], DVec3::splat(-1.0), DVec3::splat(2.0 / (n - 1) as f64)).unwrap();
    let field = field(lattice, (0.2, 0.9), |x| x.length_squared());
    let s = 0.01;
    let v = [(-s, -s), (-s, s), (s, s), (s, -s)].map(|(x, y)| DVec3::new(x, y, 0.004)).to_vec();
    let light = Polygon::new("light", v, DVec3::ZERO, DVec3::ONE).unwrap();
    let flux = PI * light.area();
    let surface = Surface { albedo: DVec3::new(0.5, 0.8, 0.2).into(), ..Surface::default() };
    let scene = Scene::new(field, surface, Boundary::Open, vec![light]).unwrap();
    let got =
        run(&scene, SweepSettings { directions: 128, light_points: 16, target: 1e-4, ..SweepSettings::default() });
    println!("bounces {} residual {}", got.bounces, got.residual);
    // The same points of the luminaire.
    let direct = run(&scene, SweepSettings { max_bounces: 0, light_points: 16, ..SweepSettings::default() });
    let indirect = |o: usize, c: usize| f64::from(got.sides[0].irradiance[o][c] - direct.sides[0].irradiance[o][c]);
    let all = nodes(&scene, 0);
    for (c, rho) in [0.5, 0.8, 0.2].into_iter().enumerate() {
        let errors: Vec<f64> = all
            .iter()
            .map(|&o| {
                let r2 = scene.field.sweep().from_unit(f64::from(scene.field.samples()[o]));
                let expected = rho * flux / (4.0 * PI * r2 * (1.0 - rho));
                indirect(o, c) / expected - 1.0
            })
            .collect();
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        let worst = errors.iter().fold(0.0, |m: f64, e| m.max(e.abs()));
        println!("ρ = {rho}: mean {mean:.5}, RMS {:.5}, worst {worst:.4}", rms(errors.iter().copied()));
        assert!(mean.abs() < 0.01 && rms(errors.iter().copied()) < 0.015, "ρ = {rho}");
    }
}

/// Closed spheres that emit 1 have 1 / (1 − ρ) on few samples, too. The largest ends two voxels inside Ω's faces:
/// beside those lie level sets that are open.
#[test]
fn coarse_hollows_keep_their_light() {
    let n = 12;
    let lattice = Lattice::aligned([n; 3], DVec3::splat(-1.0), DVec3::splat(2.0 / (n - 1) as f64)).unwrap();
    let field = field(lattice, (0.02, 0.4), |x| x.length_squared());
    let rho = DVec3::new(0.9, 0.5, 0.0);
    let surface = Surface { albedo: rho.into(), emission: DVec3::ONE, ..Surface::default() };
    let scene = Scene::new(field, surface, Boundary::Open, vec![]).unwrap();
    let got = run(&scene, SweepSettings { directions: 256, light_points: 1, ..SweepSettings::default() });
    let all = nodes(&scene, 0);
    assert!(all.len() > 150, "{} nodes", all.len());
    for c in 0..3 {
        let errors = all.iter().map(|&o| f64::from(got.sides[0].irradiance[o][c]) / PI * (1.0 - rho[c]) - 1.0);
        let worst = errors.fold(0.0, |m: f64, e| m.max(e.abs()));
        println!("ρ = {}: worst {worst:.6}", rho[c]);
        assert!(worst < 0.0015, "ρ = {}: {worst}", rho[c]);
    }
}

/// A shell with a dent: above half of its height level sets have a hole that lets light into the cavity, below it they
/// are closed, and the cavity, four voxels wide, is dark for them. All light there is what lines read of other level
/// sets, carried on by bounces of 0.9: 48 % of the mean of all nodes when they read any node around and light was
/// sharpened by a third of its blur, 16 % now.
#[test]
fn closed_cavities_stay_dark() {
    let lattice = Lattice::aligned([25; 3], DVec3::splat(-12.0), DVec3::ONE).unwrap();
    let shell = |x: DVec3| {
        let dent = 0.5 * (-((x.z / x.length().max(1e-9) - 1.0) / 0.15).powi(2)).exp();
        (1.0 - dent) * (-((x.length() - 4.0) / 1.4).powi(2)).exp()
    };
    let f = field(lattice, (0.03, 0.97), shell);
    let walls = cornell_box(f.lattice(), 0.0).unwrap();
    let scene =
        Scene::new(f, Surface { albedo: DVec3::splat(0.9).into(), ..Surface::default() }, Boundary::Open, walls)
            .unwrap();
    let got = run(&scene, SweepSettings { directions: 64, light_points: 16, ..SweepSettings::default() });
    let (mut dark, mut all) = ([0.0; 2], [0.0; 2]);
    for o in nodes(&scene, 0) {
        let x = scene.lattice().to_world(scene.lattice().point(o));
        let light = f64::from(got.sides[0].irradiance[o][1]);
        all = [all[0] + light, all[1] + 1.0];
        if x.length() < 4.0 && scene.field.samples()[o] < 0.45 {
            dark = [dark[0] + light, dark[1] + 1.0];
        }
    }
    let share = dark[0] / dark[1] / (all[0] / all[1]);
    println!("{} nodes in the cavity have {:.1} % of the mean of {}", dark[1], 100.0 * share, all[1]);
    assert!(dark[1] > 50.0 && share < 0.2, "{share}");
}

/// Walls on Ω's faces that all emit.
fn emissive_box(lattice: &Lattice, albedo: f64, emission: f64) -> Vec<Polygon> {
    let far = lattice.far();
    let mut all = Vec::new();
    for a in 0..3 {
        for end in [0.0, far[a]] {
            let (b, c) = ((a + 1) % 3, (a + 2) % 3);
            let corner = |s: f64, t: f64| {
                let mut p = DVec3::ZERO;
                (p[a], p[b], p[c]) = (end, s * far[b], t * far[c]);
                lattice.to_world(p)
            };
            let mut v = vec![corner(0., 0.), corner(1., 0.), corner(1., 1.), corner(0., 1.)];
            let middle = lattice.to_world(0.5 * far);
            if (v[1] - v[0]).cross(v[3] - v[0]).dot(middle - v[0]) < 0.0 {
                v.reverse();
            }
            all.push(Polygon::new(&format!("{a}{end}"), v, DVec3::splat(albedo), DVec3::splat(emission)).unwrap());
        }
    }
    all
}

#[test]
fn furnaces() {
    // Everything emits what it absorbs: radiance 1 everywhere, whatever the level sets look like.
    let rho = 0.6;
    let a = 0.5;
    let surface = Surface { albedo: DVec3::splat(rho).into(), emission: DVec3::splat(1.0 - rho), ..Surface::default() };
    let f = bumps(41);
    let walls = emissive_box(f.lattice(), a, 1.0 - a);
    let scene = Scene::new(f, surface, Boundary::Open, walls).unwrap();
    let got =
        run(&scene, SweepSettings { directions: 128, light_points: 64, replicates: 1, ..SweepSettings::default() });
    println!("bounces {} residual {}", got.bounces, got.residual);
    for skin in [0, 1, 3] {
        let errors: Vec<f64> =
            nodes(&scene, skin).iter().map(|&o| f64::from(got.sides[0].irradiance[o][0]) / PI - 1.0).collect();
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        println!("nodes {skin} from the faces: mean {mean:.5} RMS {:.5}", rms(errors.iter().copied()));
        assert!(mean.abs() < 0.01);
    }
    for t in got.flats.iter().flatten().flat_map(FlatLight::textures) {
        let mean = t.texels.iter().map(|t| f64::from(t[0])).sum::<f64>() / t.texels.len() as f64;
        println!("wall {mean:.4}, {a} expected; RMS {:.4}", rms(t.texels.iter().map(|t| f64::from(t[0]) - a)));
        assert!((mean - a).abs() < 0.01);
    }
}

/// Irradiance of the default box around bumps, with both sides stored and walls in a margin.
fn everything(n: usize, margin: f64, threads: usize) -> SweepResult {
    let f = bumps(n);
    let walls = cornell_box(f.lattice(), margin).unwrap();
    let surface = Surface { both_sides: true, ..Surface::default() };
    let scene = Scene::new(f, surface, Boundary::Open, walls).unwrap();
    let settings = SweepSettings {
        directions: 32,
        light_points: 4,
        replicates: 2,
        target: 0.05,
        flat_resolution: (8, 8),
        ..ONE_BOUNCE
    };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| run(&scene, SweepSettings { max_bounces: 7, ..settings }))
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    for margin in [0.0, 0.1] {
        let one = everything(25, margin, 1);
        assert_eq!((one.sides.len(), one.sides[0].std_error.len()), (2, 25 * 25 * 25));
        assert!(one.sides.iter().flat_map(|s| &s.irradiance).flatten().all(|x| x.is_finite() && *x >= 0.0));
        for threads in [2, 7, 16] {
            let other = everything(25, margin, threads);
            for (a, b) in one.sides.iter().zip(&other.sides) {
                assert!(a.irradiance == b.irradiance && a.std_error == b.std_error, "{threads} threads");
            }
            assert!(one.flats == other.flats, "{threads} threads: walls");
        }
    }
}

/// A floor and an infinitely long wall, both shining: the wall's share of the hemisphere is ½(1 − 1/√(1 + k²)).
#[test]
fn a_long_wall_occludes_as_it_should() {
    let (nx, nz, length) = (61, 61, 41);
    // y is the long axis: a spacing 1:40:1. One lattice is aligned, one flipped and permuted.
    let aligned = Lattice::aligned([nx, length, nz], DVec3::ZERO, DVec3::new(1.0, 40.0, 1.0)).unwrap();
    let axes = DMat3::from_cols(-DVec3::Z, DVec3::X, DVec3::new(0.0, -40.0, 0.0));
    let origin = DVec3::new(0.0, 40.0 * (length - 1) as f64, (nz - 1) as f64);
    let permuted = Lattice::new([nz, nx, length], origin, axes).unwrap();
    for lattice in [aligned, permuted] {
        // Inside: below z = 6 − c or behind x = 20 + c … up to z = 46: one kink, the same shape for every c.
        let f = field(lattice, (-2.0, 2.0), |x| (6.0 - x.z).max((x.x - 40.0).min(46.0 - x.z)));
        let surface = Surface { albedo: DVec3::ZERO.into(), emission: DVec3::ONE, ..Surface::default() };
        let scene = Scene::new(f, surface, Boundary::Open, Vec::new()).unwrap();
        let got = run(&scene, SweepSettings { directions: 2048, ..ONE_BOUNCE });
        let mut errors = Vec::new();
        for o in 0..scene.lattice().len() {
            let ijk = scene.lattice().ijk(o).map(|x| x as f64);
            let x = scene.lattice().to_world(DVec3::from_array(ijk));
            // Floor nodes at c = 6 − z, well in the middle of the length.
            let c = 6.0 - x.z;
            if !(-1.5..=1.5).contains(&c) || !(5.0..=32.0).contains(&x.x) || (x.y - 800.0).abs() > 100.0 {
                continue;
            }
            // At c the wall stands at x = 40 + c and ends at z = 46 − c.
            let k = (46.0 - c - x.z) / (40.0 + c - x.x);
            let expected = 0.5 * (1.0 - 1.0 / (1.0 + k * k).sqrt());
            errors.push(f64::from(got.sides[0].irradiance[o][0]) / PI - expected);
        }
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        println!("{} nodes, mean error {mean:.5}, RMS {:.5}", errors.len(), rms(errors.iter().copied()));
        assert!(errors.len() > 200 && mean.abs() < 0.004 && rms(errors.iter().copied()) < 0.012);
    }
}

/// Volumes in metres and in parsecs: what light does is the same, to the last bit in units of powers of two.
#[test]
fn light_does_not_depend_on_the_unit_of_length() {
    let settings = SweepSettings { directions: 32, light_points: 4, max_bounces: 3, ..ONE_BOUNCE };
    let lit = |unit: f64| {
        let lattice = Lattice::aligned([17, 16, 15], DVec3::splat(3.0 * unit), DVec3::splat(unit)).unwrap();
        let place = |x: DVec3| (x / unit - 3.0) / 16.0;
        let field = field(lattice, (3.6, 95.0), |x| bumps_at(place(x)));
        let walls = cornell_box(field.lattice(), 0.1).unwrap();
        run(&Scene::new(field, Surface::default(), Boundary::Open, walls).unwrap(), settings)
    };
    let bits = |result: SweepResult| -> Vec<u32> {
        let walls = result
            .flats
            .iter()
            .flatten()
            .flat_map(FlatLight::textures)
            .flat_map(|f| f.texels.iter().flatten())
            .copied()
            .collect::<Vec<_>>();
        let nodes = result.sides.into_iter().flat_map(|s| s.irradiance).flatten();
        nodes.chain(walls).map(f32::to_bits).collect()
    };
    let one = bits(lit(1.0));
    for unit in [2f64.powi(-50), 2f64.powi(-30), 2f64.powi(30), 2f64.powi(50)] {
        assert!(one == bits(lit(unit)), "cells {unit:e} wide");
    }
    let lattice = Lattice::aligned([9; 3], DVec3::ZERO, DVec3::splat(1e20)).unwrap();
    let scene = Scene::new(field(lattice, (0.0, 1.0), |x| x.x / 8e20), Surface::default(), Boundary::Open, Vec::new());
    assert!(scene.unwrap_err().to_string().contains("lengths"));
}

/// The number that files have where there are no data, on either side of the sweep, is as good as any other so far
/// away.
#[test]
fn the_farthest_numbers_are_only_far() {
    let settings = SweepSettings { directions: 32, light_points: 4, max_bounces: 2, replicates: 1, ..ONE_BOUNCE };
    let lit = |fill: f32| {
        let lattice = Lattice::aligned([17; 3], DVec3::ZERO, DVec3::splat(1.0 / 16.0)).unwrap();
        let samples = (0..lattice.len()).map(|o| {
            let x = lattice.to_world(lattice.point(o));
            // A block of several cells, where interpolation of equal numbers overflows.
            if x.min_element() > 0.4 && x.max_element() < 0.8 { fill } else { bumps_at(x) as f32 / 95.0 }
        });
        let volume = Volume::new("filled", lattice.clone(), Samples::F32(samples.collect())).unwrap();
        // In units of the sweep, too, it is that number.
        let field = Field::new(&volume, Sweep::new(0.0, 1.0).unwrap()).unwrap();
        let walls = cornell_box(&lattice, 0.0).unwrap();
        let surface = Surface { both_sides: true, ..Surface::default() };
        run(&Scene::new(field, surface, Boundary::Open, walls).unwrap(), settings)
    };
    for side in [-1.0, 1.0] {
        let (far, farthest) = (lit(side * 1e30), lit(side * f32::MAX));
        assert_eq!(far.lit, farthest.lit);
        let mut light = 0.0;
        for (far, farthest) in far.sides.iter().zip(&farthest.sides) {
            for (a, b) in far.irradiance.iter().flatten().zip(farthest.irradiance.iter().flatten()) {
                assert!((a - b).abs() <= 1e-4 * a.abs(), "{side}: {a} {b}");
                light += f64::from(*a);
            }
        }
        assert!(light > 0.0);
    }
}

#[test]
fn polygons_in_the_volume_are_refused() {
    let f = bumps(9);
    let v = [(0.2, 0.2), (0.4, 0.2), (0.4, 0.4), (0.2, 0.4)].map(|(x, y)| DVec3::new(x, y, 0.5)).to_vec();
    let shelf = Polygon::new("shelf", v, DVec3::ONE, DVec3::ZERO).unwrap();
    let scene = Scene::new(f, Surface::default(), Boundary::Open, vec![shelf]).unwrap();
    let error = sweep(&scene, &ONE_BOUNCE, &|_| true).unwrap_err().to_string();
    assert!(error.contains("shelf") && error.contains("photon"), "{error}");
}

#[test]
fn an_interrupted_sweep_goes_on_with_the_same_bits() {
    let settings = SweepSettings {
        directions: 32,
        light_points: 4,
        max_bounces: 12,
        replicates: 3,
        flat_resolution: (6, 6),
        ..SweepSettings::default()
    };
    // One side in the box; both, coupled around the rims by a margin; a bright room, whose level is corrected.
    for (margin, albedo) in [(0.0, 0.75), (0.2, 0.75), (0.0, 0.97)] {
        let field = bumps(13);
        let bright = albedo > 0.9;
        let settings = SweepSettings { max_bounces: if bright { 48 } else { settings.max_bounces }, ..settings };
        let walls = match bright {
            true => bounces::closed_box(field.lattice(), DVec3::splat(albedo)),
            false => cornell_box(field.lattice(), margin).unwrap(),
        };
        let surface = Surface { both_sides: margin > 0.0, albedo: DVec3::splat(albedo).into(), ..Surface::default() };
        let scene = Scene::new(field, surface, Boundary::Open, walls).unwrap();
        let bits = |result: &SweepResult| -> Vec<u32> {
            let nodes = result.sides.iter().flat_map(|s| {
                s.irradiance.iter().flatten().chain(&s.std_error).map(|x| x.to_bits()).collect::<Vec<_>>()
            });
            let walls = result
                .flats
                .iter()
                .flatten()
                .flat_map(FlatLight::textures)
                .flat_map(|f| f.texels.iter().flatten().map(|x| x.to_bits()));
            nodes.chain(walls).collect()
        };
        let ticks = AtomicU64::new(0);
        let whole = sweep(&scene, &settings, &|_| ticks.fetch_add(1, Relaxed) < u64::MAX).unwrap();
        assert!(whole.bounces > if bright { 30 } else { 4 });
        let all = ticks.load(Relaxed);
        let folder = tempfile::tempdir().unwrap();
        let (path, kept) = (folder.path().join("a.checkpoint"), folder.path().join("kept"));
        let (mut runs, mut done, mut repeated) = (0, 0, 0);
        // Ended after a third of the work each time, as SIGINT does (what is finished is saved on the way out) and as a
        // kill does (the file holds what was saved when it was due).
        for killed in [false, true] {
            loop {
                let every = if killed { Duration::ZERO } else { Duration::from_secs(3600) };
                let checkpoint = Checkpoint::new(&path, "job: a\n".into(), every).unwrap();
                checkpoint.resume().unwrap();
                ticks.store(0, Relaxed);
                let stage = checkpoint.stage(0);
                let tick = |_| {
                    // Writing takes no more than a share of the time, and a busy disk takes its own: kills wait for it.
                    while killed && !stage.due() {
                        std::thread::sleep(Duration::from_millis(1));
                    }
                    let go = ticks.fetch_add(1, Relaxed) < all / 3 + runs;
                    if !go && killed && path.exists() && !kept.exists() {
                        std::fs::copy(&path, &kept).unwrap();
                    }
                    go
                };
                let result = sweep_resumable(&scene, &settings, stage, &tick);
                (runs, done) = (runs + 1, done + ticks.load(Relaxed));
                assert!(runs < 60, "no progress");
                if !matches!(result, Err(Error::Interrupted)) {
                    let result = result.unwrap();
                    assert_eq!(bits(&result), bits(&whole), "margin {margin}, albedo {albedo}, killed {killed}");
                    assert_eq!((result.counts, result.bounces), (whole.counts, whole.bounces));
                    assert_eq!(result.residual.to_bits(), whole.residual.to_bits());
                    // What is finished is not done again.
                    checkpoint.save().unwrap();
                    let again =
                        sweep_resumable(&scene, &settings, checkpoint.stage(0), &|_| panic!("no work")).unwrap();
                    assert_eq!(bits(&again), bits(&whole));
                    checkpoint.remove();
                    break;
                }
                if killed {
                    std::fs::rename(&kept, &path).unwrap();
                } else {
                    assert!(checkpoint.save().unwrap());
                }
            }
            repeated += done;
            (done, runs) = (0, if killed { runs } else { 0 });
        }
        let share = repeated as f64 / (2 * all) as f64;
        println!("margin {margin}, albedo {albedo}: {runs} runs, {share:.2} of the work");
        assert!((1.0..2.0).contains(&share), "{share}");
    }
}
