//! Albedo by isovalue: every hyperplane has its own, in all that light does.

use crate::support::*;
use glam::DVec3;
use isolume::bake::{Bake, BakeSettings, Engine, supported};
use isolume::direct::luminance;
use isolume::embree::{Device, GraphTracer};
use isolume::flattened::Side;
use isolume::luminaire::unoccluded;
use isolume::mask::Mask;
use isolume::reference::{ReferenceSettings, reference};
use isolume::reflectance::Reflectance;
use isolume::scene::{Boundary, Scene, Surface, cornell_box};
use isolume::stats::Moments;
use isolume::surface_mesh::SurfaceMesh;
use std::f64::consts::PI;

/// Dark red, grey, light blue, and back: kinks at 0.3 and 0.6 of the sweep.
fn rainbow() -> Reflectance {
    let colour = |c, r, g, b| (c, DVec3::new(r, g, b));
    Reflectance::new(vec![
        colour(0.0, 0.3, 0.05, 0.0),
        colour(0.3, 0.5, 0.5, 0.5),
        colour(0.6, 0.1, 0.4, 0.9),
        colour(1.0, 0.3, 0.05, 0.0),
    ])
    .unwrap()
}

/// Black walls of radiance 1 give planes exactly ρ(c), node by node, by either engine.
#[test]
fn a_furnace_shows_the_albedo_of_every_isovalue() {
    let (lo, hi) = (DVec3::ZERO, DVec3::ONE);
    let planes = field(lattice([17; 3], lo, hi), 0.0, 1.0, |x| 0.2 * x.x + 0.3 * x.y + 0.5 * x.z);
    let surface = Surface { albedo: rainbow(), outside: Side::Higher, ..Surface::default() };
    let scene = scene(planes, surface, closed_box(lo, hi, 0.0, 1.0));
    let white = Surface { albedo: DVec3::ONE.into(), ..scene.surface.clone() };
    let white = Scene::new(scene.field.clone(), white, Boundary::Open, scene.polygons().to_vec()).unwrap();
    for engine in [Engine::Photon, Engine::Sweep] {
        let settings = BakeSettings { engine, gather_rays: 8, ..at_nodes(3) };
        let (bake, white_bake) = (run(&scene, &settings), run(&white, &settings));
        let (mut worst, mut count) = (0f64, 0);
        for (o, x, h, ..) in valid(&bake, &scene) {
            if within(x, lo, hi, 1e-6) {
                let radiance = |b: &Bake| DVec3::from_array(b.sides[0].1.radiance[o].map(f64::from));
                let expected = scene.surface.albedo.at(h);
                // What a sweep misses of the furnace, it misses of a white plane too.
                let light = if engine == Engine::Sweep { radiance(&white_bake) } else { DVec3::ONE };
                worst = worst.max((radiance(&bake) - expected * light).abs().max_element());
                count += 1;
            }
        }
        println!("{engine:?}: worst {worst:.1e} of {count} nodes");
        assert!(count > 3000 && worst < 2e-6, "{engine:?}");
    }
    assert!((bake_exposure(&scene) - 0.9).abs() < 1e-12, "the largest albedo of the sweep exposes");
}

/// ρ_max of the display's exposure.
fn bake_exposure(scene: &Scene) -> f64 {
    PI / (scene.exposure() * scene.reference_irradiance())
}

/// A small lamp in the middle of balls of every isovalue: indirect E = ρΦ/(4πR²(1 − ρ)) with ρ(c). Photons with
/// and without gather, sweeps and the path tracer must find each isovalue's own ρ.
#[test]
fn a_cavity_reflects_by_the_albedo_of_its_own_isovalue() {
    const N: usize = 33;
    let bulge = 0.5 * (2.5f64 / (N - 1) as f64).powi(2);
    let (lo, hi) = (0.49, 1.3225);
    let h = field(lattice([N; 3], DVec3::splat(-1.25), DVec3::splat(1.25)), lo, hi, |x| x.length_squared());
    let light = rectangle("lamp", DVec3::new(0.0, 0.0, 0.013), 0.03 * DVec3::X, 0.03 * DVec3::Y, 0.0, 1.0);
    let flux = PI * light.area();
    // A cell spans a sixth of the sweep, and light is interpolated in it: no kinks here.
    let stops = vec![(0.0, DVec3::new(0.3, 0.45, 0.6)), (1.0, DVec3::new(0.6, 0.4, 0.3))];
    let surface = Surface { albedo: Reflectance::new(stops).unwrap(), ..Surface::default() };
    let scene = scene(h, surface, vec![light.clone()]);
    // Indirect irradiance relative to its closed form, mean over channels.
    let ratio = |radiance: DVec3, x: DVec3, c: f64| {
        let albedo = scene.surface.albedo.at(c);
        let absorbed = 4.0 * PI * (lo + c * (hi - lo) - bulge) * (DVec3::ONE - albedo) + 2.0 * light.area() * albedo;
        let indirect = PI * radiance / albedo - unoccluded(&light, x, -x.normalize());
        (indirect * absorbed / (albedo * flux)).element_sum() / 3.0
    };
    let mut family = Family::new("a cavity of each colour", 0.015);
    let engines = [(Engine::Photon, 32), (Engine::Photon, 0), (Engine::Sweep, 32)];
    for (engine, gather_rays) in engines {
        // Away from the sweep's ends, where albedo is small and nodes light each other by colours they do not have.
        let mut shells = [Moments::default(); 4];
        for seed in 1..4 {
            let settings = BakeSettings { engine, photons: 1 << 18, gather_rays, shadow_rays: 4, ..at_nodes(seed) };
            let bake = run(&scene, &settings);
            let mut sums = [(0.0, 0.0); 4];
            for (o, x, c, ..) in valid(&bake, &scene) {
                if (0.2..0.8).contains(&c) {
                    let s = ((c - 0.2) / 0.15) as usize;
                    let r = ratio(DVec3::from_array(bake.sides[0].1.radiance[o].map(f64::from)), x, c);
                    sums[s] = (sums[s].0 + r, sums[s].1 + 1.0);
                }
            }
            sums.iter().zip(&mut shells).for_each(|((a, n), m)| m.push(a / n));
        }
        shells.iter().enumerate().for_each(|(s, m)| family.ratios(format!("{engine:?}, gather {gather_rays}, {s}"), m));
    }
    let device = Device::new(1).unwrap();
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    for c in [0.25f32, 0.75] {
        let mesh = SurfaceMesh::extract(&scene, c, 1).unwrap();
        let settings = ReferenceSettings { samples: 64, vertices: Some(400), ..ReferenceSettings::default() };
        let paths = reference(&scene, &tracer, &mesh, c, &settings, &|_| true).unwrap();
        let mut m = Moments::default();
        for v in (0..mesh.local.len()).filter(|&v| paths.sampled[v]) {
            m.push(ratio(paths.radiance[v], mesh.positions[v], f64::from(c)));
        }
        family.ratios(format!("path tracer at {c}"), &m);
    }
    family.accept();
}

/// Another colour at another isovalue changes no bit: of no photon path between stops that stay, and of no grid point
/// further from the change than the estimates reach (τ, and two cells, since nodes are sharpened against those beside).
/// Points on walls gather what the photon map says of the level set at the very place, with a millionth of what the
/// cell's other corners hold: they keep all but a little.
#[test]
fn colours_of_other_isovalues_change_nothing() {
    let with = |last: DVec3| {
        let grey = DVec3::splat(0.6);
        let albedo = Reflectance::new(vec![(0.6, grey), (0.7, last)]).unwrap();
        let h = field(lattice([21; 3], DVec3::ZERO, DVec3::ONE), 0.0, 0.4, |x| 0.4 - (x - 0.5).length_squared());
        let walls = cornell_box(h.lattice(), 0.0).unwrap();
        scene(h, Surface { albedo, ..Surface::default() }, walls)
    };
    let (a, b) = (with(DVec3::splat(0.6)), with(DVec3::new(0.9, 0.0, 0.1)));
    let below = |scene: &Scene| {
        let all = photons(scene, &emission(1 << 16, 5));
        let total = all.surface.len();
        let kept: Vec<_> = all.surface.into_iter().filter(|p| p.isovalue <= 0.6).collect();
        (total, kept)
    };
    let ((total_a, photons_a), (total_b, photons_b)) = (below(&a), below(&b));
    assert!(photons_a == photons_b && photons_a.len() > 10_000, "{} photons", photons_a.len());
    assert_ne!(total_a, total_b, "above, roulette decides otherwise");
    let settings = BakeSettings { photons: 1 << 18, gather_rays: 16, wall_resolution: 8, ..at_nodes(1) };
    let (bake_a, bake_b) = (run(&a, &settings), run(&b, &settings));
    let (mut same, mut changed) = (0, 0);
    for ((o, _, h, ..), _) in valid(&bake_a, &a).into_iter().zip(valid(&bake_b, &b)) {
        let equal = bake_a.sides[0].1.radiance[o] == bake_b.sides[0].1.radiance[o];
        // A cell spans up to 0.2 of the sweep here; walls have texels and a kernel in c.
        let on_wall = a.lattice().ijk(o).iter().any(|i| [0, 20].contains(i));
        if h < 0.1 {
            let [x, y] = [&bake_a, &bake_b].map(|bake| bake.sides[0].1.radiance[o]);
            let most = 0.01 * x.iter().sum::<f32>();
            let near = x.iter().zip(&y).all(|(x, y)| (x - y).abs() <= most);
            assert!(equal || on_wall && near, "node {o} at {h}: {x:?} {y:?}");
            same += 1;
        } else if !equal {
            changed += 1;
        }
    }
    println!("{same} points below keep every bit, {changed} above do not");
    assert!(same > 100 && changed > 1000, "{same} {changed}");
}

/// Light of one channel that surfaces take up in that alone is what white light is, ray by ray: as many of them, and
/// as uncertain.
#[test]
fn light_of_one_colour_is_as_certain_as_white() {
    let white = bumps(lattice([13; 3], DVec3::ZERO, DVec3::ONE));
    let found = |channels: DVec3| {
        let polygons = white.polygons().iter().cloned().map(|mut p| {
            p.albedo = DVec3::splat(0.75);
            p.emission *= channels;
            p
        });
        let surface = Surface { albedo: (0.75 * channels).into(), ..Surface::default() };
        let scene = Scene::new(white.field.clone(), surface, Boundary::Open, polygons.collect()).unwrap();
        let bake = run(&scene, &BakeSettings { gather_rays: 16, shadow_rays: 32, ..at_nodes(1) });
        let grid = &bake.sides[0].1;
        let points = || (0..grid.mask.len()).filter(|&o| grid.mask[o] == Mask::Valid);
        let light: f64 = points().map(|o| luminance(DVec3::from_array(grid.radiance[o].map(f64::from)))).sum();
        (bake.report.rays, points().map(|o| f64::from(grid.std_error[o])).sum::<f64>() / light)
    };
    let (rays, error) = found(DVec3::ONE);
    assert!(error > 0.005, "{error}");
    for channel in [DVec3::X, DVec3::Y, DVec3::Z] {
        let (own, told) = found(channel);
        println!("{channel}: {own} of {rays} rays, {told:.5} of {error:.5}");
        assert!((own as f64 / rays as f64 - 1.0).abs() < 1e-3 && (told / error - 1.0).abs() < 0.02, "{channel}");
    }
}

/// Photons whose power f32 does not hold were no light at all.
#[test]
fn photons_of_too_much_or_too_little_power_are_refused() {
    for (step, emission, fits) in
        [(1e13, 1e18, false), (1e-16, 1e-15, false), (1e16, 1.0, true), (1e-12, 1e-15, true), (1e-9, 1e18, true)]
    {
        let lattice = lattice([9; 3], DVec3::ZERO, DVec3::splat(8.0 * step));
        let planes = field(lattice, 0.0, 8.0 * step, |x| x.z);
        let mut walls = cornell_box(planes.lattice(), 0.0).unwrap();
        walls.iter_mut().filter(|p| p.emission != DVec3::ZERO).for_each(|p| p.emission = DVec3::splat(emission));
        let scene = Scene::new(planes, Surface::default(), Boundary::Open, walls).unwrap();
        let found = supported(&scene, &at_nodes(1)).map_err(|e| e.to_string());
        assert!(found.clone().err().is_none_or(|e| e.contains("do not fit 32-bit floats")), "{found:?}");
        assert_eq!(found.is_ok(), fits, "{step:e}, {emission:e}");
    }
}
