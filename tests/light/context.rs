//! Context geometry: polygons in the scene that are seen, lit and reflect from both sides.

use crate::support::*;
use glam::DVec3;
use isolume::bake::BakeSettings;
use isolume::direct::{Receiver, luminance};
use isolume::embree::{Device, GraphTracer};
use isolume::flattened::{Departure, Side};
use isolume::luminaire::unoccluded;
use isolume::polygon::Polygon;
use isolume::reference::PathTracer;
use isolume::rng::{Rng, Stage};
use isolume::scene::{Boundary, Placement, Scene, Surface, cornell_box, read_context};
use isolume::stats::Moments;
use isolume::volume::generate::Generator;
use std::f64::consts::PI;

/// The polygons of an OBJ text.
fn context(obj: &str, albedo: f64) -> Vec<Polygon> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("thing.obj");
    std::fs::write(&path, obj).unwrap();
    read_context(&path, &Placement { albedo: Some(DVec3::splat(albedo)), ..Placement::default() }).unwrap()
}

fn bumps_with(polygons: impl FnOnce(Vec<Polygon>) -> Vec<Polygon>) -> Scene {
    let volume = Generator::from_name("bumps").unwrap().sample([25; 3]).unwrap();
    let sweep = isolume::field::Sweep::new(3.6, 95.0).unwrap();
    let field = isolume::field::Field::new(&volume, sweep).unwrap();
    let walls = cornell_box(field.lattice(), 0.0).unwrap();
    Scene::new(field, Surface::default(), Boundary::Open, polygons(walls)).unwrap()
}

/// A floor from an OBJ file, whole or in triangles, is the box's own: every bit of the grid, and its light within
/// noise.
#[test]
fn a_rectangle_from_a_file_is_the_same_wall() {
    let grey = 0.7;
    let own = bumps_with(|mut walls| {
        walls.iter_mut().filter(|p| p.name == "z_min").for_each(|p| p.albedo = DVec3::splat(grey));
        walls
    });
    let settings = BakeSettings { photons: 1 << 17, gather_rays: 0, wall_resolution: 16, ..at_nodes(1) };
    let expected = run(&own, &settings);
    let floor = own.polygons().iter().position(|p| p.name == "z_min").unwrap();
    let corners = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n";
    for faces in ["f 1 2 3 4\n", "f 1 2 3\nf 1 3 4\n"] {
        let scene = bumps_with(|mut walls| {
            walls.retain(|p| p.name != "z_min");
            walls.extend(context(&[corners, faces].concat(), grey));
            walls
        });
        let got = run(&scene, &settings);
        assert!(got.sides[0].1.radiance == expected.sides[0].1.radiance, "{faces}: the grid's light is not the same");
        let (mut error, mut sum, mut sum_own, mut edge) = (Moments::default(), 0.0, 0.0, Moments::default());
        let mut rng = Rng::stream(1, Stage::Test, 0);
        for _ in 0..20_000 {
            let x = DVec3::new(rng.unit(), rng.unit(), 0.0);
            let c = rng.unit();
            let of = |bake: &isolume::bake::Bake, scene: &Scene, id: usize| {
                let [u, v] = scene.polygons()[id].texture(x);
                luminance(bake.flats[id].as_ref().unwrap().outside.lookup([u, v, c]))
            };
            let fronts = scene.polygons().iter().enumerate().filter(|(_, p)| p.other_face == 1 && p.contains(x));
            let (id, _) = fronts.into_iter().next().expect("the floor covers everything");
            let (a, b) = (of(&got, &scene, id), of(&expected, &own, floor));
            error.push((a - b).powi(2));
            (sum, sum_own) = (sum + a, sum_own + b);
            if (x.x - x.y).abs() < 0.02 {
                edge.push(a / b.max(1e-3));
            }
        }
        let rms = error.mean().sqrt() / (sum_own / 20_000.0);
        println!("{faces:?}: mean {:.4}, RMS {rms:.4}, along the diagonal {:.4}", sum / sum_own, edge.mean());
        assert!((sum / sum_own - 1.0).abs() < 0.01 && rms < 0.15 && (edge.mean() - 1.0).abs() < 0.03);
        for (id, p) in scene.polygons().iter().enumerate().filter(|(_, p)| p.other_face == -1) {
            let dark = got.flats[id].as_ref().unwrap().outside.texels.iter().all(|t| *t == [0.0; 3]);
            assert!(dark && p.normal().z < 0.0, "no light gets below the floor");
        }
    }
}

/// A black plate between light and floor, whichever way it faces: E is Lambert's form for the part of the light that
/// its edge leaves, at every node of horizontal planes.
#[test]
fn a_plate_covers_its_part_of_the_light() {
    let (lo, hi) = (DVec3::ZERO, DVec3::ONE);
    let light = rectangle("light", DVec3::new(0.5, 0.5, 0.999), 0.2 * DVec3::Y, 0.2 * DVec3::X, 0.0, 1.0);
    assert!(light.normal().z < 0.0);
    let (edge, height) = (0.45, 0.9);
    for order in ["f 1 2 3 4\n", "f 4 3 2 1\n", "f 1 2 3\nf 1 3 4\n"] {
        let plate = format!("v {edge} -1 {height}\nv 2 -1 {height}\nv 2 2 {height}\nv {edge} 2 {height}\n{order}");
        let planes = field(lattice([9; 3], lo, hi), 0.0, 1.0, |x| x.z);
        let mut polygons = vec![light.clone()];
        polygons.extend(context(&plate, 0.0));
        let scene = scene(planes, grey(1.0, Side::Higher), polygons);
        let settings = BakeSettings { photons: 1 << 10, gather_rays: 0, shadow_rays: 1 << 14, ..at_nodes(1) };
        let bake = run(&scene, &settings);
        let (mut worst, mut partly, mut count) = (0f64, 0, 0);
        for (_, x, _, radiance, _) in valid(&bake, &scene).into_iter().filter(|n| n.1.z < height - 0.1) {
            // Where the line from x past the edge meets the light's plane.
            let shadow = x.x + (edge - x.x) * (0.999 - x.z) / (height - x.z);
            let (near, far) = (0.3, shadow.clamp(0.3, 0.7));
            let open = if far - near < 1e-9 {
                0.0
            } else {
                let centre = DVec3::new(0.5 * (near + far), 0.5, 0.999);
                let part = rectangle("part", centre, 0.2 * DVec3::Y, 0.5 * (far - near) * DVec3::X, 0.0, 1.0);
                unoccluded(&part, x, DVec3::Z)
            };
            partly += usize::from(shadow > 0.3 && shadow < 0.7);
            count += 1;
            worst = worst.max((PI * radiance - open).abs() / unoccluded(&light, x, DVec3::Z));
        }
        println!("{order:?}: worst {worst:.1e} of the whole light at {count} nodes, {partly} of them in the penumbra");
        assert!(count > 400 && partly > 80 && worst < 2e-3, "{worst}");
    }
}

/// A slanted sheet and an octahedron of triangles among bumps: what a bake finds on level sets and on both sides of
/// every face is what paths find there.
#[test]
fn light_to_and_from_context_agrees_with_paths() {
    let mut obj = String::from("v 0.08 0.1 0.2\nv 0.3 0.1 0.55\nv 0.3 0.7 0.55\nv 0.08 0.7 0.2\nf 1 2 3 4\n");
    for [x, y, z] in [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]] {
        let at = |n: i32, middle: f64| middle + 0.15 * f64::from(n);
        obj += &format!("v {} {} {}\n", at(x, 0.8), at(y, 0.25), at(z, 0.25));
    }
    for (x, y, z) in (0..8).map(|n| (5 + (n & 1), 7 + (n >> 1 & 1), 9 + (n >> 2))) {
        obj += &format!("f {x} {y} {z}\n");
    }
    let scene = bumps_with(|mut walls| {
        walls.extend(context(&obj, 0.8));
        walls
    });
    let device = Device::new(1).unwrap();
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    let mut paths = PathTracer::new(&scene, &tracer);
    let settings =
        BakeSettings { photons: 1 << 19, gather_rays: 64, shadow_rays: 32, wall_resolution: 64, ..at_nodes(1) };
    let bake = run(&scene, &settings);
    // Systematic 2 %: textures blur penumbras, nodes interpolate the light of a 25³ lattice.
    let mut family = Family::new("context", 0.02);
    let mut bins = [[Moments::default(); 2]; 4];
    for (o, _, h, ..) in valid(&bake, &scene).into_iter().step_by(7) {
        let position = scene.lattice().point(o);
        let Some(normal) = scene.normal(position, Side::Lower) else { continue };
        let (position, isovalue) = (position.as_vec3(), h as f32);
        let receiver = Receiver { position, normal, isovalue, departure: Departure::Surface(Side::Lower) };
        let exact = luminance(paths.outgoing(&receiver, 32, Stage::Path.key(3, o as u64)));
        let bin = &mut bins[((h * 4.0) as usize).min(3)];
        let baked = luminance(DVec3::from_array(bake.sides[0].1.radiance[o].map(f64::from)));
        bin[0].push(baked - exact);
        bin[1].push(exact);
    }
    for (n, [difference, exact]) in bins.iter().enumerate() {
        let (mean, error) = (exact.mean(), difference.std_error());
        family.compare(format!("level sets {n}"), mean + difference.mean(), error, mean);
    }
    let mut rng = Rng::stream(5, Stage::Test, 0);
    let (mut sheets, mut solid) = ([[Moments::default(); 2]; 2], [Moments::default(); 2]);
    for (id, p) in scene.polygons().iter().enumerate().filter(|(_, p)| p.other_face != 0) {
        let texture = &bake.flats[id].as_ref().unwrap().outside;
        let sheet = p.vertices().len() == 4;
        for i in 0..if sheet { 4000u64 } else { 600 } {
            let x = p.sample([rng.unit(), rng.unit()]);
            let c = rng.unit();
            let receiver = Receiver {
                position: local(&scene, x),
                normal: p.normal(),
                isovalue: c as f32,
                departure: Departure::Polygon(id as u32),
            };
            // `outgoing` reflects by the level sets' albedo.
            let exact =
                luminance(paths.outgoing(&receiver, 16, Stage::Path.key(4, (id as u64) << 32 | i))) * 0.8 / 0.75;
            let [u, v] = p.texture(x);
            let baked = luminance(texture.lookup([u, v, c]));
            let m = match (sheet, p.other_face) {
                (true, 1) => &mut sheets[0],
                (true, _) => &mut sheets[1],
                // Inside the octahedron it is dark, but for what starts on an edge to within rounding.
                (false, _) if exact == 0.0 && p.normal().dot(p.vertices()[0] - DVec3::new(0.8, 0.25, 0.25)) < 0.0 => {
                    assert!(baked < 1e-4, "{x}: {baked}");
                    continue;
                }
                _ => &mut solid,
            };
            m[0].push(baked - exact);
            m[1].push(exact);
        }
    }
    for (name, [difference, exact]) in [("sheet, above", sheets[0]), ("sheet, below", sheets[1]), ("octahedron", solid)]
    {
        let mean = exact.mean();
        family.compare(name.to_owned(), mean + difference.mean(), difference.std_error(), mean);
    }
    family.accept();
}
