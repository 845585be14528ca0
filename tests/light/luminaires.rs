//! Luminaires that reflect or stand behind walls, and light without an end.

use crate::support::*;
use glam::DVec3;
use isolume::bake::{BakeOptions, BakeSettings, Engine, Preset};
use isolume::direct::{Receiver, direct_irradiance, direct_once};
use isolume::embree::{Device, GraphTracer};
use isolume::flattened::{Departure, Side, SurfacePoint};
use isolume::gather::{KnownLight, gathered_irradiance};
use isolume::landing::MOST_LANDINGS;
use isolume::mask::Mask;
use isolume::polygon::Polygon;
use isolume::reference::PathTracer;
use isolume::rng::{Rng, Stage};
use isolume::scene::{Boundary, Scene, Surface};
use std::f64::consts::PI;

const RED: DVec3 = DVec3::new(9.0, 0.0, 0.0);
const BLUE: DVec3 = DVec3::new(0.0, 0.0, 9.0);

/// A square of ±`half` about the volume's middle at height z that faces up or down.
fn square(name: &str, half: f64, z: f64, up: bool, albedo: f64, emission: DVec3) -> Polygon {
    let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
    let at = |(x, y): (f64, f64)| DVec3::new(0.5 + half * x, 0.5 + half * if up { y } else { -y }, z);
    Polygon::new(name, corners.map(at).to_vec(), DVec3::splat(albedo), emission).unwrap()
}

/// Level planes z = c of the unit cube that a large white luminaire at 0.47 cuts into two worlds: it shines red on what
/// is above, where a ceiling reflects, and another one shines blue from below onto its back, which is black. Nothing
/// red gets below, nothing blue above: not by photons, gathers, lines or paths.
#[test]
fn nothing_passes_through_a_luminaire_that_reflects() {
    let planes = field(lattice([17; 3], DVec3::ZERO, DVec3::ONE), 0.05, 0.95, |x| x.z);
    let polygons = vec![
        square("middle", 1.5, 0.47, true, 0.8, RED),
        square("below", 0.4, -0.1, true, 0.8, BLUE),
        square("ceiling", 0.5, 1.1, false, 0.8, DVec3::ZERO),
    ];
    let scene = scene(planes, Surface { both_sides: true, ..grey(0.8, Side::Lower) }, polygons);
    let device = Device::new(0).unwrap();
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    for engine in [Engine::Photon, Engine::Sweep] {
        let bake = run(&scene, &BakeSettings { engine, photons: 1 << 15, gather_rays: 64, ..at_nodes(1) });
        // Brightest red and blue of each side above and below the luminaire, by the bake and by paths.
        let mut found = [[[[0.0f64; 2]; 2]; 2]; 2];
        for (side, grid) in &bake.sides {
            for o in (0..grid.mask.len()).filter(|&o| grid.mask[o] == Mask::Valid) {
                let x = world(&bake.lattice, o);
                let by_paths = o % 7 == 0;
                // A luminaire that stands in a cell hides what is there.
                if (x.z - 0.47).abs() < 0.07 {
                    continue;
                }
                let found = &mut found[side.index()][usize::from(x.z > 0.47)];
                let mut see = |by: usize, light: [f64; 3]| {
                    found[by] = [found[by][0].max(light[0]), found[by][1].max(light[2])];
                };
                see(0, grid.radiance[o].map(f64::from));
                if by_paths {
                    let receiver =
                        Receiver::on_level_set(&scene, scene.lattice().to_index(x), scene.field.samples()[o], *side);
                    let paths =
                        PathTracer::new(&scene, &tracer).outgoing(&receiver.unwrap(), 16, Stage::Path.key(1, o as u64));
                    see(1, paths.to_array());
                }
            }
        }
        println!("{engine:?}: {found:.3?}");
        let lit = |[red, blue]: [f64; 2]| [red > 0.1, blue > 0.1];
        // What lines gather is sharpened.
        let most = if engine == Engine::Sweep { 1e-3 } else { 0.0 };
        let dark = |[red, blue]: [f64; 2]| [red <= most, blue <= most];
        let [[lower_below, lower_above], [higher_below, higher_above]] = found;
        for by in [0, 1] {
            // Planes above look down on the red front, and those below on the blue one; from above, planes below the
            // luminaire see its back, and those above it the ceiling, which the red light reaches around them.
            assert_eq!((lit(lower_above[by]), dark(lower_above[by])), ([true, false], [false, true]));
            assert_eq!((lit(lower_below[by]), dark(lower_below[by])), ([false, true], [true, false]));
            assert_eq!((lit(higher_above[by]), dark(higher_above[by])), ([true, false], [false, true]));
            assert_eq!(dark(higher_below[by]), [true, true]);
        }
    }
}

/// A tilted lamp with two faces, each of which shines and reflects, alone: no place on it, whichever side of its plane
/// f32 rounds it to, gets light of the other face.
#[test]
fn a_lamp_with_two_faces_does_not_light_itself() {
    let planes = field(lattice([9; 3], DVec3::ZERO, DVec3::ONE), 0.05, 0.95, |x| x.z);
    let (s, t) = (DVec3::new(0.3, 0.05, 0.1), DVec3::new(-0.04, 0.25, 0.07));
    let lamp = rectangle("lamp", DVec3::new(0.47, 0.52, 1.4), s, t, 0.9, 1.0).both_faces();
    let scene = scene(planes, grey(0.5, Side::Lower), lamp.to_vec());
    let device = Device::new(0).unwrap();
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    let mut behind = [0; 2];
    for i in 0..2000 {
        let mut rng = Rng::stream(1, Stage::Test, i);
        let id = (i % 2) as u32;
        let p = &scene.polygons()[id as usize];
        let position = scene.lattice().to_index(p.sample(rng.unit2())).as_vec3();
        let height = (scene.lattice().to_world(position.as_dvec3()) - p.vertices()[0]).dot(p.normal());
        behind[usize::from(height < 0.0)] += 1;
        let receiver = Receiver { position, normal: p.normal(), isovalue: 0.5, departure: Departure::Polygon(id) };
        let mut paths = PathTracer::new(&scene, &tracer);
        let found = [
            direct_irradiance(&scene, &tracer, &receiver, 16, Stage::Direct.key(1, i)).mean,
            paths.direct(&receiver, 16, Stage::Path.key(1, i)),
            direct_once(&scene, &tracer, &receiver, &mut rng, &mut 0),
        ];
        assert_eq!(found, [DVec3::ZERO; 3], "{receiver:?}, {height:e}");
    }
    assert!(behind.iter().all(|&n| n > 500), "{behind:?}");
}

/// In the ceiling's plane a ray would meet lamp and ceiling at once. By shadow rays and lines, with and without a
/// margin between the ceiling and Ω, such a lamp lights what one just before the ceiling does; paths agree.
#[test]
fn a_lamp_in_the_plane_of_the_ceiling_shines() {
    let planes = field(lattice([9; 3], DVec3::ZERO, DVec3::ONE), 0.05, 0.95, |x| x.z);
    for margin in [0.0, 0.1] {
        let top = 1.0 + margin;
        let found = [top, top - 0.004].map(|z| {
            let lamp = square("lamp", 0.2, z, false, 0.5, DVec3::ONE);
            let ceiling = square("ceiling", 0.5 + margin, top, false, 0.5, DVec3::ZERO);
            let scene = scene(planes.clone(), grey(0.5, Side::Higher), vec![ceiling, lamp]);
            let tracer = GraphTracer::new(&Device::new(0).unwrap(), &scene).unwrap();
            [Engine::Photon, Engine::Sweep].map(|engine| {
                let bake = run(&scene, &BakeSettings { engine, gather_rays: 32, photons: 1 << 14, ..at_nodes(1) });
                let lit = valid(&bake, &scene);
                let paths = lit.iter().step_by(5).map(|&(o, x, h, ..)| {
                    let p = scene.lattice().to_index(x);
                    let receiver = Receiver::on_level_set(&scene, p, h as f32, Side::Higher).unwrap();
                    PathTracer::new(&scene, &tracer).outgoing(&receiver, 64, Stage::Path.key(1, o as u64)).x
                });
                let paths = paths.sum::<f64>() / lit.iter().step_by(5).len() as f64;
                [lit.iter().map(|v| v.3).sum::<f64>() / lit.len() as f64, paths]
            })
        });
        println!("margin {margin}: {found:.4?}");
        let [within, before] = found.map(|engines| engines.concat());
        for (a, b) in within.iter().zip(&before) {
            assert!(
                *a > 0.01 && (a / b - 1.0).abs() < 0.02,
                "margin {margin}: {within:?} in the plane, {before:?} before"
            );
        }
    }
}

/// A wall with one face between luminaire and volume: from its front nothing is seen of what is behind, from behind the
/// wall is not there. By lines, shadow rays, and photons, which would light the floor behind the wall.
#[test]
fn a_wall_hides_what_is_behind_from_those_before_it() {
    let facing = |name: &str, x: f64, half: f64, right: bool, emission: f64| {
        let (s, t) = (half * DVec3::Y, half * DVec3::Z);
        let (s, t) = if right { (s, t) } else { (t, s) };
        rectangle(name, DVec3::new(x, 0.5, 0.5), s, t, 0.0, emission)
    };
    let ball = field(lattice([17; 3], DVec3::ZERO, DVec3::ONE), 0.55, 0.8, |x| 1.0 - (x - 0.5).length());
    let floor = rectangle("floor", DVec3::new(0.85, 0.5, -0.1), DVec3::X, 2.0 * DVec3::Y, 0.8, 0.0);
    let mean = |engine: Engine, wall: Option<bool>, floor: Option<&Polygon>| {
        let mut polygons = vec![facing("lamp", -0.5, 0.3, true, 1.0)];
        polygons.extend(wall.map(|right| facing("wall", -0.2, 4.0, right, 0.0)));
        polygons.extend(floor.cloned());
        let scene = scene(ball.clone(), grey(0.5, Side::Lower), polygons);
        let bake = run(&scene, &BakeSettings { engine, gather_rays: 32, photons: 1 << 14, ..at_nodes(1) });
        let found = valid(&bake, &scene);
        found.iter().map(|v| v.3).sum::<f64>() / found.len() as f64
    };
    for engine in [Engine::Photon, Engine::Sweep] {
        let open = mean(engine, None, None);
        let behind = mean(engine, Some(false), None);
        let before = mean(engine, Some(true), Some(&floor));
        println!("{engine:?}: {open:.5} without a wall, {behind:.5} behind it, {before:.2e} before it");
        assert!(open > 0.005 && (behind / open - 1.0).abs() < 0.01 && before == 0.0);
    }
}

/// A black floor in the plane of Ω's lowest grid points, with two faces or with one that looks down: whatever the f32
/// of these points says, they are above it, and lit as without it.
#[test]
fn a_floor_in_the_volumes_face_is_below_its_points() {
    let planes = field(lattice([9; 3], DVec3::new(0.1, 0.2, 0.7), DVec3::new(1.1, 1.2, 1.7)), 0.65, 1.65, |x| x.z);
    let at = |name: &str, z: f64, up: bool, emission: DVec3| {
        let p = square(name, 1.0, z, up, 0.0, emission);
        Polygon::new(name, p.vertices().iter().map(|x| *x + DVec3::new(0.1, 0.2, 0.0)).collect(), DVec3::ZERO, emission)
    };
    let lamp = at("lamp", 2.5, false, DVec3::ONE).unwrap();
    let floor = at("floor", 0.7, true, DVec3::ZERO).unwrap();
    let below = at("floor", 0.7, false, DVec3::ZERO).unwrap();
    for engine in [Engine::Photon, Engine::Sweep] {
        let lit = |floor: &[Polygon]| {
            let scene = scene(planes.clone(), grey(0.5, Side::Higher), [std::slice::from_ref(&lamp), floor].concat());
            let bake = run(&scene, &BakeSettings { engine, photons: 1 << 12, gather_rays: 16, ..at_nodes(1) });
            valid(&bake, &scene).into_iter().map(|v| (v.1, v.3)).collect::<Vec<_>>()
        };
        let alone = lit(&[]);
        let lowest = alone.iter().filter(|(x, _)| x.z < 0.701).count();
        for floor in [&floor.clone().both_faces()[..], std::slice::from_ref(&below)] {
            let found = lit(floor);
            assert!(found.len() == alone.len() && lowest == 81, "{} {lowest}", found.len());
            for (&(x, expected), (_, light)) in alone.iter().zip(found) {
                assert!(expected > 0.1 && (light / expected - 1.0).abs() < 1e-5, "{engine:?} {x}: {light} {expected}");
            }
        }
    }
}

/// Knows nothing.
struct Unknown;

impl KnownLight for Unknown {
    fn radiance(&self, _: &Scene, _: SurfacePoint, _: &mut u64) -> Option<DVec3> {
        None
    }
}

/// In a closed cavity that emits 1 and absorbs nothing paths go on until they are cut.
#[test]
fn paths_among_white_surfaces_end() {
    let cavity = field(lattice([25; 3], DVec3::NEG_ONE, DVec3::ONE), 0.16, 0.81, |x| x.length_squared());
    let white = Surface { emission: DVec3::ONE, ..grey(1.0, Side::Lower) };
    let scene = scene(cavity, white, Vec::new());
    let device = Device::new(0).unwrap();
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    let receiver = Receiver::on_level_set(
        &scene,
        DVec3::new(20.0, 12.0, 12.0),
        scene.field.value(DVec3::new(20.0, 12.0, 12.0)) as f32,
        Side::Lower,
    );
    let receiver = receiver.unwrap();
    let path = PathTracer::new(&scene, &tracer).outgoing(&receiver, 2, Stage::Path.key(1, 1)).x;
    let gathered =
        gathered_irradiance(&scene, &tracer, &Unknown, &receiver, 2, Stage::Gather.key(1, 1)).estimate.mean.x / PI;
    println!("{path}, {gathered}");
    let landings = f64::from(MOST_LANDINGS);
    assert!((path / (landings + 1.0) - 1.0).abs() < 1e-9 && (gathered / landings - 1.0).abs() < 1e-9);
}

/// Steps of 8-bit data that emit: most of the volume is a plateau on the sweep's end, beside whose slopes there are
/// normals, but which emits nothing. A photon of no power would never be absorbed.
#[test]
fn plateaus_emit_nothing() {
    let steps = field(lattice([12; 3], DVec3::ZERO, DVec3::ONE), 0.0, 1.0, |x| if x.x > 0.5 { 1.0 } else { 0.0 });
    for outside in Side::BOTH {
        let surface = Surface { emission: DVec3::ONE, ..grey(0.5, outside) };
        let scene = scene(steps.clone(), surface, Vec::new());
        let photons = photons(&scene, &emission(1 << 12, 1));
        let total = photons.total_energy();
        println!("{outside:?}: {} landings, {} rays, {total:?}", photons.stored(), photons.rays);
        assert!(total.emitted > 0.0 && total.imbalance() < 1e-12);
        assert!(photons.rays <= 2 * photons.emitted, "{} rays", photons.rays);
    }
}

/// A luminaire whose light does not reach the middle of the volume counts as any other, where points are fitted, too.
#[test]
fn light_that_the_middle_does_not_see_is_split() {
    let lattice = lattice([20; 3], DVec3::ZERO, DVec3::splat(19.0));
    let middle = DVec3::splat(9.5);
    // A ball with a front of less than a step.
    let ball = field(lattice, 0.2, 0.8, |x| (0.5 + (6.0 - x.distance(middle))).clamp(0.0, 1.0));
    let lamp = rectangle("lamp", DVec3::new(25.5, 9.5, 11.0), 4.5 * DVec3::X, 9.5 * DVec3::Y, 0.0, 1.0);
    let surface = Surface { outside: Side::Lower, ..Surface::default() };
    let scene = Scene::new(ball, surface, Boundary::Open, vec![lamp]).unwrap();
    assert_eq!(scene.reference_irradiance(), 0.0);
    for engine in [Engine::Photon, Engine::Sweep] {
        let options = BakeOptions {
            engine: Some(engine),
            preset: Some(Preset::Preview),
            split: Some(true),
            photons: Some(1 << 14),
            ..BakeOptions::default()
        };
        let settings = BakeSettings::new(&options, &scene).unwrap();
        let baked = run(&scene, &settings);
        let grid = &baked.sides[0].1;
        let split = grid.split.as_ref().unwrap();
        let lit = |o: &usize| grid.mask[*o] == Mask::Filled && grid.radiance[*o][1] > 0.01;
        let filled: Vec<usize> = (0..grid.mask.len()).filter(lit).collect();
        let seen = filled.iter().filter(|&&o| split.visible[o][1] > 0.0).count();
        println!("{engine:?}: {seen} of {} filled points see the luminaire", filled.len());
        assert!(filled.len() > 50 && seen * 10 >= filled.len() * 9);
    }
}
