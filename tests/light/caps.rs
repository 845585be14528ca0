//! Capped boundaries, and which side is outside.

use crate::support::*;
use glam::{DVec3, Vec3};
use isolume::bake::{BakeOptions, BakeSettings, Engine};
use isolume::embree::{Device, GraphTracer};
use isolume::flattened::{Departure, Side, Target};
use isolume::landing::landing;
use isolume::luminaire::unoccluded;
use isolume::rng::{Rng, Stage};
use isolume::scene::{Boundary, Scene};
use isolume::stats::Moments;
use isolume::tracer::Tracer;
use isolume::warp::{Frame, cosine_hemisphere};

/// A solid 0 ≤ z ≤ 1 − c in [0, 1]³, moved off the origin so that faces are no round f32 numbers, lamps beyond two
/// faces.
fn solid() -> (Scene, DVec3) {
    let at = DVec3::new(0.137, -3.211, 7.713);
    let field = field(lattice([8; 3], at, at + 1.0), 0.0, 1.0, |x| 1.0 - (x - at).z);
    let right = rectangle("right", at + DVec3::new(1.6, 0.5, 0.5), 0.5 * DVec3::Z, 0.5 * DVec3::Y, 0.0, 1.0);
    let below = rectangle("below", at + DVec3::new(0.5, 0.5, -0.7), 0.4 * DVec3::X, 0.4 * DVec3::Y, 0.0, 2.0);
    (Scene::new(field, grey(0.5, Side::Lower), Boundary::Capped, vec![right, below]).unwrap(), at)
}

/// The textures of caps hold the closed form of direct light. Nothing else: caps of a convex solid do not see each
/// other, and no light comes back from the dark. 1e-5: f32 storage.
#[test]
fn caps_are_lit_like_walls() {
    let (scene, at) = solid();
    let bake = run(&scene, &BakeSettings { gather_rays: 0, bounces: 0, ..at_nodes(1) });
    let mut lit = 0;
    for face in 0..6u8 {
        let texture = &bake.flats[scene.polygons().len() + usize::from(face)].as_ref().unwrap().outside;
        let n = scene.face_normal(face);
        let flat = isolume::flat::flat(&scene, scene.polygons().len() + usize::from(face)).unwrap();
        let mut worst = 0f64;
        for (i, texel) in texture.texels.iter().enumerate() {
            let [u, v, c] = texture.centre(i);
            let x = flat.at([u, v]);
            if (x - at).z > 1.0 - c {
                continue;
            }
            let expected: f64 = scene.luminaires().iter().map(|p| p.emission.x * unoccluded(p, x, n)).sum();
            lit += usize::from(expected > 0.0);
            worst = worst.max((f64::from(texel[0]) - 0.5 * expected / std::f64::consts::PI).abs());
        }
        println!("face {face}, normal {n}: worst {worst:.1e}");
        assert!(worst < 1e-5);
    }
    println!("{lit} lit texels");
    assert!(lit > 10_000);
}

/// A capped solid is closed: photons from outside stay outside, whatever they bounce off, and what reflects from a cap
/// goes away from it.
#[test]
fn no_photon_gets_through_a_cap() {
    let (scene, _) = solid();
    let got = photons(&scene, &emission(1 << 17, 2));
    let through = got.surface.iter().filter(|p| p.side == Side::Higher).count();
    let caps = got.flat.iter().filter(|p| p.flat >= 2).count();
    let again = got.flat.iter().filter(|p| p.flat >= 2 && p.bounces > 0).count();
    println!(
        "{} landings on level sets, {through} from inside; {caps} on caps, {again} of them after a bounce",
        got.surface.len()
    );
    assert_eq!(through, 0);
    assert!(caps > 30_000);
    assert_eq!(again, 0, "faces of a convex solid do not see each other");
    // Rays from points a rounding off the face, both ways.
    let device = Device::new(1).unwrap();
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    for off in [-1e-6f32, 0.0, 1e-6] {
        for direction in [DVec3::new(1.0, 0.3, 0.2), DVec3::new(1e-9, 0.3, 0.2)] {
            let origin = Vec3::new(7.0 + off, 3.3, 1.1);
            let out = scene.ray(origin, direction, 0.5, Departure::Cap(3, Side::Lower));
            assert!(!matches!(tracer.intersect(&out), Some(h) if !matches!(h.target, Target::Polygon(_))), "{off}");
            // Off the next face, too: an edge is no way in.
            for origin in [origin, Vec3::new(7.0 + off, 7.0 + off, 1.1)] {
                let within = scene.ray(origin, -direction, 0.5, Departure::Cap(3, Side::Higher));
                let hit = tracer.intersect(&within).unwrap();
                let cap = matches!(hit.target, Target::Cap(3, _) | Target::Cap(_, Side::Lower));
                assert!(hit.t > 0.1 && !cap, "{origin}: {hit:?}");
            }
        }
    }
}

/// A ray that leaves a cap where another one landed goes away from it, on either side of the cap: the place it starts
/// from may be a rounding within the solid, or outside of it.
#[test]
fn rays_leave_a_cap_where_others_landed() {
    let (scene, at) = solid();
    let device = Device::new(1).unwrap();
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    let mut rng = Rng::stream(7, Stage::Path, 0);
    let mut landed = [0; 2];
    for i in 0..1 << 14 {
        let mut unit = || DVec3::new(rng.unit(), rng.unit(), rng.unit());
        let (x, y) = (unit(), unit());
        let from = if i % 2 == 0 { 6.0 * x - 3.0 } else { 0.1 + 0.8 * x };
        let ray = scene.ray(local(&scene, at + from), at + y - (at + from), 0.0, Departure::Free);
        let Some(hit) = tracer.intersect(&ray) else { continue };
        let Target::Cap(_, side) = hit.target else { continue };
        let receiver = landing(&scene, &ray, hit).unwrap().receiver;
        let away = Frame::new(receiver.normal).to_world(cosine_hemisphere([rng.unit(), rng.unit()]));
        let ray = scene.ray(receiver.position, away, ray.isovalue, receiver.departure);
        let next = tracer.intersect(&ray);
        match side {
            Side::Lower => assert!(!matches!(next, Some(h) if !matches!(h.target, Target::Polygon(_))), "{next:?}"),
            Side::Higher => assert!(next.is_some_and(|h| h.t > 0.0 && h.target != hit.target), "{next:?}"),
        }
        landed[side.index()] += 1;
    }
    println!("{landed:?} rays landed on caps");
    assert!(landed[0] > 1000 && landed[1] > 1000, "{landed:?}");
}

/// Caps light what they see: both engines find what path tracing does, where samples are missing, too, so that light
/// gets into the solid and to the caps from within.
#[test]
fn capped_matter_is_lit_as_paths_say() {
    for gaps in [false, true] {
        let speck = |[i, j, k]: [usize; 3]| gaps && (i * 7919 + j * 104_729 + k * 1_299_709) % 97 == 0;
        let mut scene = waves(25, Boundary::Capped, false, speck);
        scene.surface.albedo = DVec3::splat(0.5).into();
        let inside = |o: &usize| (0.0..=1.0).contains(&scene.field.samples()[*o]) && scene.field.is_in_whole_cell(*o);
        let points: Vec<usize> = (0..scene.lattice().len()).filter(inside).step_by(7).collect();
        // Of path tracing itself 4 %.
        for (engine, bias, most) in [(Engine::Photon, 0.01, 0.06), (Engine::Sweep, 0.012, 0.08)] {
            let options = BakeOptions { engine: Some(engine), ..BakeOptions::default() };
            let baked = run(&scene, &BakeSettings::new(&options, &scene).unwrap());
            let (side, grid) = &baked.sides[0];
            let [mean, rms] = against_paths(&scene, *side, &grid.radiance, &points);
            println!("{engine:?}, gaps {gaps}: {} points, mean {mean:.4}, RMS {rms:.4}", points.len());
            assert!(points.len() > 2000 && mean.abs() < bias && rms < most, "{engine:?}, {gaps}: {mean} {rms}");
        }
    }
}

/// Within a solid that shines caps are walls like others: they reflect what they see, from cap to cap, too.
#[test]
fn caps_reflect_on_their_inside() {
    let mut scene = waves(25, Boundary::Capped, true, |_| false);
    (scene.surface.albedo, scene.surface.emission) = (DVec3::splat(0.5).into(), DVec3::splat(0.05));
    let inside = |o: &usize| (0.0..=1.0).contains(&scene.field.samples()[*o]);
    let points: Vec<usize> = (0..scene.lattice().len()).filter(inside).step_by(19).collect();
    let baked = run(&scene, &BakeSettings { gather_rays: 64, ..at_nodes(1) });
    let (side, grid) = &baked.sides[1];
    let [mean, rms] = against_paths(&scene, *side, &grid.radiance, &points);
    println!("{side:?}: {} points, mean {mean:.4}, RMS {rms:.4}", points.len());
    assert!(*side == Side::Higher && points.len() > 600 && mean.abs() < 0.01 && rms < 0.03, "{mean} {rms}");
}

/// With both sides stored, the inside of a capped solid without a lamp in it is black.
#[test]
fn the_inside_of_a_capped_solid_is_dark() {
    let (mut scene, _) = solid();
    scene.surface.both_sides = true;
    for gather_rays in [0, 16] {
        let bake = run(&scene, &BakeSettings { gather_rays, photons: 1 << 15, ..at_nodes(1) });
        let sums: Vec<f64> =
            bake.sides.iter().map(|s| s.1.radiance.iter().map(|rgb| f64::from(rgb[1])).sum::<f64>()).collect();
        println!("gather {gather_rays}: outside {:.3}, inside {}", sums[0], sums[1]);
        assert!(sums[0] > 0.1 && sums[1] == 0.0);
    }
}

/// −h with the other side outside is the same scene: the mean radiance of 4 shells agrees, nodes in Ω's faces included
/// (rays that leave Ω there once met the lower side of their own level set). Errors from 4 seeds each; systematic 0.3
/// %: `inside` takes h = c to different sides.
#[test]
fn mirrored_fields_give_the_same_light() {
    let build = |sign: f64, outside: Side| {
        let h = move |x: DVec3| sign * (x.z + 0.1 * (6.0 * x.x).sin() + 0.1 * (5.0 * x.y).cos());
        let (lo, hi) = if sign > 0.0 { (0.1, 0.8) } else { (-0.8, -0.1) };
        let field = field(lattice([17; 3], DVec3::ZERO, DVec3::ONE), lo, hi, h);
        let walls = isolume::scene::cornell_box(field.lattice(), 0.0).unwrap();
        scene(field, grey(0.6, outside), walls)
    };
    let mut family = Family::new("mirror", 0.003);
    let mut shells = [[Moments::default(); 4]; 2];
    for (which, scene) in [build(1.0, Side::Higher), build(-1.0, Side::Lower)].iter().enumerate() {
        for seed in 1..5 {
            let bake = run(
                scene,
                &BakeSettings {
                    photons: 1 << 18,
                    gather_rays: 16,
                    wall_resolution: 16,
                    wall_isovalues: 8,
                    ..at_nodes(seed + 10 * which as u64)
                },
            );
            let mut sums = [(0.0, 0.0); 4];
            for (_, _, h, radiance, _) in valid(&bake, scene) {
                let h = if which == 0 { h } else { 1.0 - h };
                let s = &mut sums[((h * 4.0) as usize).min(3)];
                *s = (s.0 + radiance, s.1 + 1.0);
            }
            sums.iter().zip(&mut shells[which]).for_each(|((a, n), m)| m.push(a / n));
        }
    }
    for (s, (a, b)) in shells[0].iter().zip(&shells[1]).enumerate() {
        family.compare(format!("shell {s}"), b.mean(), a.std_error().hypot(b.std_error()), a.mean());
    }
    family.accept();
}
