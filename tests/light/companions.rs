//! Several fields in one scene: shadows and light across fields, whatever the lattices.

use crate::support::*;
use glam::{DMat3, DVec3};
use isolume::bake::{Bake, BakeSettings, bake_fields};
use isolume::embree::{Device, GraphTracer, SurfaceTracer};
use isolume::field::{Field, Sweep};
use isolume::flattened::{Departure, FlattenedHit, FlattenedRay, Side, Target};
use isolume::mask::Mask;
use isolume::polygon::Polygon;
use isolume::progress::Progress;
use isolume::reference::{Integrator, ReferenceSettings, SurfaceMapSettings, reference};
use isolume::rng::{Rng, Stage};
use isolume::scene::{Boundary, Member, Policy, Scene, Surface, cornell_box};
use isolume::stats::Moments;
use isolume::surface_mesh::SurfaceMesh;
use isolume::tracer::Tracer;
use isolume::volume::{Lattice, Samples, Volume};
use isolume::warp;
use std::f64::consts::PI;

pub(crate) fn member(name: &str, field: Field, surface: Surface) -> Member {
    Member { name: name.into(), field: field.into(), surface, boundary: Boundary::Open }
}

pub(crate) fn joint(members: Vec<Member>, polygons: Vec<Polygon>) -> Scene {
    Scene::with_members(members, Policy::Joint, polygons).unwrap()
}

fn run_fields(scene: &Scene, settings: &BakeSettings) -> Vec<Bake> {
    bake_fields(scene, settings, &Device::new(1).unwrap(), Progress::Quiet, None).unwrap()
}

/// Quick, by final gather, at the grid's nodes.
fn quick(seed: u64) -> BakeSettings {
    BakeSettings { shadow_rays: 16, gather_rays: 32, wall_resolution: 16, wall_isovalues: 8, ..at_nodes(seed) }
}

fn gauss(x: DVec3, m: [f64; 3], s: f64) -> f64 {
    (-(x - DVec3::from_array(m)).length_squared() / (2.0 * s * s)).exp()
}

/// A large bump.
fn large(x: DVec3) -> f64 {
    gauss(x, [0.5, 0.5, 0.3], 0.17)
}

/// Two small ones above it, which shadow it.
fn small(x: DVec3) -> f64 {
    gauss(x, [0.33, 0.45, 0.72], 0.08) + gauss(x, [0.65, 0.5, 0.7], 0.09)
}

pub(crate) fn unit(n: usize) -> Lattice {
    lattice([n; 3], DVec3::ZERO, DVec3::ONE)
}

pub(crate) fn coloured(albedo: [f64; 3]) -> Surface {
    Surface { albedo: DVec3::from_array(albedo).into(), ..Surface::default() }
}

/// Red under white, in the box, `white` on any lattice.
fn two(white: Lattice) -> Scene {
    let red = field(unit(25), 0.1, 0.9, large);
    let walls = cornell_box(red.lattice(), 0.0).unwrap();
    let white = field(white, 0.15, 0.9, small);
    joint(vec![member("red", red, coloured([0.8, 0.1, 0.1])), member("white", white, coloured([0.8, 0.8, 0.8]))], walls)
}

/// An oblique lattice that covers the two small bumps at the sweep's isovalues.
fn oblique() -> Lattice {
    let axes =
        DMat3::from_cols(DVec3::new(0.03, 0.008, 0.0), DVec3::new(-0.009, 0.03, 0.004), DVec3::new(0.0, -0.004, 0.03));
    let far = DVec3::new(29.0, 23.0, 19.0);
    Lattice::new([30, 24, 20], DVec3::new(0.49, 0.48, 0.71) - axes * far * 0.5, axes).unwrap()
}

/// Radiance means of a bake over random points of the world whose isovalue lies on the sweep: by quarter of the sweep
/// and channel.
fn means(bake: &Bake, scene: &Scene, inside: impl Fn(DVec3) -> bool) -> Vec<f64> {
    let (mut sums, mut counts) = (vec![0.0; 12], vec![0.0; 12]);
    for i in 0..100_000 {
        let mut rng = Rng::stream(5, Stage::Test, i);
        let x = DVec3::new(rng.unit(), rng.unit(), rng.unit());
        let p = scene.lattice().to_index(x);
        let s = scene.field.value(p);
        if !(0.05..0.95).contains(&s) || !inside(x) {
            continue;
        }
        let rgb = bake.sides[0].1.interpolate(&bake.lattice, p);
        for channel in 0..3 {
            let at = (s * 4.0) as usize * 3 + channel;
            (sums[at], counts[at]) = (sums[at] + rgb[channel], counts[at] + 1.0);
        }
    }
    sums.iter().zip(counts).map(|(s, n)| s / n).collect()
}

/// Random rays of all departures, seen from either field, hit what is nearest of what the fields alone give; one by one
/// and in packets.
#[test]
fn the_nearest_hit_of_all_fields_wins() {
    let device = Device::new(1).unwrap();
    // The second pair shares a lattice, and with it one callback.
    let scenes = [two(oblique()), two(unit(25))];
    for (scene, number) in [(&scenes[0], 0), (&scenes[0], 1), (&scenes[1], 0), (&scenes[1], 1)] {
        let seen = scene.seen_from(number);
        let tracer = GraphTracer::new(&device, &seen).unwrap();
        let companion = &seen.companions()[0];
        let walls = seen.polygons().to_vec();
        let own = Scene::new(seen.field.clone(), Surface::default(), Boundary::Open, walls).unwrap();
        let other = companion.member.field.clone();
        let other = Scene::new(other, Surface::default(), Boundary::Open, Vec::new()).unwrap();
        let (own_tracer, other_tracer) =
            (GraphTracer::new(&device, &own).unwrap(), GraphTracer::new(&device, &other).unwrap());
        let far = seen.lattice().far();
        let (mut rays, mut expected, mut met) = (Vec::new(), Vec::new(), [0; 3]);
        let mut cast = |ray: FlattenedRay| {
            let plain = FlattenedRay {
                departure: if matches!(ray.departure, Departure::Companion(..)) {
                    Departure::Free
                } else {
                    ray.departure
                },
                ..ray
            };
            let (a, b) = (own_tracer.intersect(&plain), other_tracer.intersect(&companion.ray_to_index(&ray)));
            let b = b.map(|h| FlattenedHit { target: companion.target(h.target), ..h });
            let nearest = match (a, b) {
                (Some(a), Some(b)) if b.t < a.t => Some(b),
                (None, b) => b,
                (a, _) => a,
            };
            rays.push(ray);
            expected.push(nearest);
            nearest
        };
        for i in 0..30_000 {
            let mut rng = Rng::stream(3, Stage::Test, i);
            let origin = (far * DVec3::new(rng.unit(), rng.unit(), rng.unit())).as_vec3();
            let mut ray = seen.ray(origin, warp::sphere(rng.unit2()), rng.unit() as f32, Departure::Free);
            // And on from what it met, as a photon goes.
            for _ in 0..3 {
                let Some(hit) = cast(ray) else { break };
                let p = ray.at(hit.t);
                let (normal, departure) = match hit.target {
                    Target::Surface(side) => (seen.normal(p, side), Departure::Surface(side)),
                    Target::Companion(n, side) => {
                        (seen.field_at(Some(n), p).normal(side), Departure::Companion(n, side))
                    }
                    Target::Polygon(id) => (Some(seen.polygons()[id as usize].normal()), Departure::Polygon(id)),
                    Target::Cap(..) => unreachable!("the scene is open"),
                };
                met[match departure {
                    Departure::Surface(_) => 0,
                    Departure::Companion(..) => 1,
                    _ => 2,
                }] += 1;
                let Some(normal) = normal else { break };
                let direction = warp::Frame::new(normal).to_world(warp::cosine_hemisphere(rng.unit2()));
                ray = seen.ray(p.as_vec3(), direction, ray.isovalue, departure);
            }
        }
        println!("seen from {number}: {} rays, hits of own, companion, walls {met:?}", rays.len());
        assert!(met.iter().all(|&n| n > 1000), "{met:?}");
        let mut many = vec![None; rays.len()];
        tracer.intersect_many(&rays, &mut many);
        let mut blocked = vec![false; rays.len()];
        tracer.occluded_many(&rays, &mut blocked);
        for (i, ray) in rays.iter().enumerate() {
            let hit = tracer.intersect(ray);
            assert_eq!(hit, expected[i], "{ray:?}");
            assert_eq!((many[i], blocked[i], tracer.occluded(ray)), (hit, hit.is_some(), hit.is_some()), "{ray:?}");
        }
    }
}

/// Triangles of both fields are hit where the trilinear surfaces are.
#[test]
fn two_meshes_are_hit_where_two_graphs_are() {
    let device = Device::new(1).unwrap();
    let flipped = {
        let l = unit(25);
        let axes = DMat3::from_cols(-l.axes().y_axis, l.axes().x_axis, l.axes().z_axis);
        // A reflection, too.
        let axes = axes * DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0));
        Lattice::new(l.dims(), DVec3::new(0.0, 1.0, 1.0), axes).unwrap()
    };
    let scene = two(flipped);
    for number in 0..2 {
        let seen = scene.seen_from(number);
        let (triangles, graph) =
            (SurfaceTracer::new(&device, &seen, 0.4, 2).unwrap(), GraphTracer::new(&device, &seen).unwrap());
        let (mut same, mut count, mut sides) = (0, 0, [0; 3]);
        for i in 0..20_000 {
            let mut rng = Rng::stream(4, Stage::Test, i);
            let origin = (seen.lattice().far() * DVec3::new(rng.unit(), rng.unit(), rng.unit())).as_vec3();
            let mut ray = seen.ray(origin, warp::sphere(rng.unit2()), 0.4, Departure::Free);
            for _ in 0..2 {
                let (a, b) = (triangles.intersect(&ray), graph.intersect(&ray));
                assert_eq!(triangles.occluded(&ray), a.is_some(), "{ray:?}");
                count += 1;
                same += u32::from(a.map(|h| h.target) == b.map(|h| h.target));
                let Some(hit) = b else { break };
                let p = ray.at(hit.t);
                let (normal, departure) = match hit.target {
                    Target::Surface(side) => (seen.normal(p, side), Departure::Surface(side)),
                    Target::Companion(n, side) => {
                        (seen.field_at(Some(n), p).normal(side), Departure::Companion(n, side))
                    }
                    _ => break,
                };
                sides[usize::from(matches!(departure, Departure::Companion(..)))] += 1;
                let Some(normal) = normal else { break };
                let direction = warp::Frame::new(normal).to_world(warp::cosine_hemisphere(rng.unit2()));
                ray = seen.ray(p.as_vec3(), direction, 0.4, departure);
            }
        }
        println!("seen from {number}: {same} of {count}, starts on own and companion {sides:?}");
        assert!(f64::from(same) > 0.995 * f64::from(count) && sides[0] > 500 && sides[1] > 500);
    }
}

#[test]
fn independent_fields_are_two_single_bakes() {
    let scene = two(oblique());
    let members = scene.members();
    let independent = Scene::with_members(members.clone(), Policy::Independent, scene.polygons().to_vec()).unwrap();
    let settings = BakeSettings { photons: 1 << 14, gather_rays: 8, ..quick(1) };
    let bakes = run_fields(&independent, &settings);
    assert_eq!(bakes.len(), 2);
    for (m, bake) in members.into_iter().zip(&bakes) {
        let alone = Scene::new(m.field, m.surface, m.boundary, scene.polygons().to_vec()).unwrap();
        let single = run(&alone, &settings);
        assert_eq!(single.sides[0].1.radiance, bake.sides[0].1.radiance, "{}", m.name);
        assert_eq!(single.sides[0].1.std_error, bake.sides[0].1.std_error);
        assert_eq!(single.flats, bake.flats);
    }
    // The same bits would mean that nothing is joint about joint.
    assert_ne!(run_fields(&scene, &settings)[0].sides[0].1.radiance, bakes[0].sides[0].1.radiance);
}

/// A field behind the back wall, which nothing in the box sees, changes nothing: not a bit.
#[test]
fn a_field_that_nothing_sees_changes_nothing() {
    let red = || field(unit(25), 0.1, 0.9, large);
    let walls = || cornell_box(&unit(25), 0.0).unwrap();
    let hidden = field(lattice([9; 3], DVec3::new(0.3, 1.2, 0.3), DVec3::new(0.7, 1.6, 0.7)), 0.0, 0.5, |x| {
        (x - DVec3::new(0.5, 1.4, 0.5)).length()
    });
    let settings = BakeSettings { photons: 1 << 14, gather_rays: 8, ..quick(1) };
    let alone = run(&scene(red(), Surface::default(), walls()), &settings);
    let both = run_fields(
        &joint(vec![member("red", red(), Surface::default()), member("hidden", hidden, Surface::default())], walls()),
        &settings,
    );
    assert_eq!(alone.sides[0].1.radiance, both[0].sides[0].1.radiance);
    assert_eq!(alone.flats[..6], both[0].flats[..6]);
}

/// One field cut into two members along a lattice plane: the union of their surfaces is the same surface, so that all
/// light across the cut is light across fields.
#[test]
fn a_field_cut_in_two_has_the_same_light() {
    let whole = |x: DVec3| large(x) + 0.9 * small(x);
    let n = 25;
    let half = |far: bool| {
        let (lo, hi) = if far { (0.5, 1.0) } else { (0.0, 0.5) };
        lattice([n / 2 + 1, n, n], DVec3::new(lo, 0.0, 0.0), DVec3::new(hi, 1.0, 1.0))
    };
    let on = |l: Lattice| field(l, 0.1, 0.85, whole);
    let walls = || cornell_box(&unit(n), 0.0).unwrap();
    let surface = || coloured([0.9, 0.6, 0.3]);
    let single = scene(on(unit(n)), surface(), walls());
    let parts =
        joint(vec![member("near", on(half(false)), surface()), member("far", on(half(true)), surface())], walls());
    let mut ratios = vec![Moments::default(); 24];
    for seed in 1..=4 {
        let (a, b) = (run(&single, &quick(seed)), run_fields(&parts, &quick(seed + 10)));
        for (k, bake) in b.iter().enumerate() {
            // Receiver normals are one-sided at the cut itself.
            let side = |x: DVec3| (x.x - 0.5).abs() > 0.05 && (x.x > 0.5) == (k == 1);
            let (whole, part) = (means(&a, &single, side), means(bake, &parts.lit(k), side));
            (0..12).for_each(|i| ratios[12 * k + i].push(part[i] / whole[i]));
        }
    }
    let mut family = Family::new("cut in two", 0.004);
    ratios.iter().enumerate().for_each(|(i, m)| family.ratios(format!("{i}"), m));
    family.accept();
}

/// The second field on an oblique or a turned, reflected lattice gives what it gives on an aligned one.
#[test]
fn lattices_do_not_matter() {
    let turned = {
        let step = DMat3::from_diagonal(DVec3::splat(1.0 / 24.0));
        let axes = step * DMat3::from_cols(-DVec3::Y, DVec3::Z, DVec3::X);
        Lattice::new([25; 3], DVec3::new(0.0, 1.0, 0.0), axes).unwrap()
    };
    let aligned = two(unit(25));
    for (name, other, systematic) in [("turned", two(turned), 0.004), ("oblique", two(oblique()), 0.02)] {
        let mut ratios = vec![Moments::default(); 24];
        for seed in 1..=3 {
            let (a, b) = (run_fields(&aligned, &quick(seed)), run_fields(&other, &quick(seed + 10)));
            for k in 0..2 {
                // Where both lattices hold nodes.
                let inside = |x: DVec3| {
                    k == 0 || {
                        let p = oblique().to_index(x);
                        p.min_element() > 0.0 && (oblique().far() - p).min_element() > 0.0
                    }
                };
                let (x, y) = (means(&a[k], &aligned.seen_from(k), inside), means(&b[k], &other.seen_from(k), inside));
                (0..12).for_each(|i| ratios[12 * k + i].push(y[i] / x[i]));
            }
        }
        let mut family = Family::new(name, systematic);
        ratios.iter().enumerate().for_each(|(i, m)| family.ratios(format!("{i}"), m));
        family.accept();
    }
}

/// A glowing ball, one field, in a cavity, another: with concentric spheres of radii a and R and albedos ρb and ρ,
/// E (4πR²) = Φ + ρ (1 − F) E 4πR² + ρb ρ E 4πa² with F = a²/R², at every s of its own.
#[test]
fn an_integrating_sphere_of_one_field_around_a_source_of_another() {
    let (albedo, ball_albedo, glow) = (0.7, 0.5, 1.0);
    let squares = |l: Lattice, lo: f64, hi: f64| field(l, lo, hi, |x| x.length_squared());
    // On trilinear cells |x|² is raised by ½ Δ² on average.
    let shell_step: f64 = 2.6 / 32.0;
    let ball_step: f64 = 1.0 / 24.0;
    let cavity = |lo: f64, hi: f64| squares(lattice([33; 3], DVec3::splat(-1.3), DVec3::splat(1.3)), lo, hi);
    let ball = |lo: f64, hi: f64| squares(lattice([25; 3], DVec3::splat(-0.5), DVec3::splat(0.5)), lo, hi);
    let source = Surface { emission: DVec3::splat(glow), outside: Side::Higher, ..coloured([ball_albedo; 3]) };
    let scene = joint(
        vec![
            member("cavity", cavity(0.7, 1.3), Surface { outside: Side::Lower, ..coloured([albedo; 3]) }),
            member("ball", ball(0.06, 0.16), source),
        ],
        Vec::new(),
    );
    let mut families = Family::new("sphere in sphere", 0.01);
    let mut moments = [Moments::default(); 8];
    for seed in 1..=3 {
        let bakes = run_fields(&scene, &BakeSettings { gather_rays: 64, ..quick(seed) });
        for (k, bake) in bakes.iter().enumerate() {
            let mut sums = [(0.0, 0.0); 4];
            // E grows with s; at the sweep's ends photons are found on one side only, which costs 2 % on so few cells.
            for (_, _, s, radiance, _) in
                valid(bake, &scene.seen_from(k)).into_iter().filter(|v| (0.12..0.88).contains(&v.2))
            {
                let r2 = 0.7 + s * 0.6 - 0.5 * shell_step * shell_step;
                let a2 = 0.06 + s * 0.1 - 0.5 * ball_step * ball_step;
                let view = a2 / r2;
                let e = PI * glow * view / (1.0 - albedo * (1.0 - view) - albedo * ball_albedo * view);
                let expected = if k == 0 { albedo * e / PI } else { glow + ball_albedo * albedo * e / PI };
                let bin = ((s * 4.0) as usize).min(3);
                sums[bin] = (sums[bin].0 + radiance / expected, sums[bin].1 + 1.0);
            }
            (0..4).for_each(|b| moments[4 * k + b].push(sums[b].0 / sums[b].1));
        }
    }
    moments
        .iter()
        .enumerate()
        .for_each(|(i, m)| families.ratios(["cavity", "ball"][i / 4].to_owned() + &format!(" {}", i % 4), m));
    families.accept();
}

/// The bake of both fields against path tracing of two meshes, and the two integrators of the reference against each
/// other.
#[test]
fn cross_light_agrees_with_paths_between_two_meshes() {
    let device = Device::new(1).unwrap();
    let scene = two(unit(49));
    let bakes = run_fields(&scene, &BakeSettings { gather_rays: 64, photons: 1 << 19, ..quick(1) });
    let c = 0.35;
    for (k, bake) in bakes.iter().enumerate() {
        let seen = scene.seen_from(k);
        let tracer = SurfaceTracer::new(&device, &seen, c, 1).unwrap();
        let mesh = SurfaceMesh::extract(&seen, c, 1).unwrap();
        let settings = |integrator, seed| ReferenceSettings {
            integrator,
            samples: 256,
            batches: 8,
            photons: 1 << 19,
            vertices: Some(300),
            seed,
            ..ReferenceSettings::default()
        };
        let paths = [1, 2]
            .map(|seed| reference(&seen, &tracer, &mesh, c, &settings(Integrator::Path, seed), &|_| true).unwrap());
        let photons = reference(&seen, &tracer, &mesh, c, &settings(Integrator::Photon, 3), &|_| true).unwrap();
        let exposure = scene.exposure();
        let (mut square, mut bias, mut mean, mut n) = (0.0, DVec3::ZERO, DVec3::ZERO, 0.0);
        for v in (0..mesh.local.len()).filter(|&v| paths[0].sampled[v]) {
            let t = bake.sides[0].1.interpolate(&bake.lattice, mesh.local[v]) * exposure;
            let [a, b] = [0, 1].map(|i| paths[i].radiance[v] * exposure);
            square += (t - a).dot(t - b);
            bias += photons.radiance[v] * exposure - 0.5 * (a + b);
            mean += 0.5 * (a + b);
            n += 1.0;
        }
        let rms = 100.0 * f64::max(square / n, 0.0).sqrt();
        println!("field {k}: {rms:.2} % RMS; photons against paths {:.3?}", bias / mean);
        assert!(rms <= 2.0, "field {k}: {rms} %");
        assert!((bias / mean).abs().max_element() < 0.02, "field {k}: {:?}", bias / mean);
    }
    // Each sees the other: alone, the red field has no white shadows, and the white field no red light from below.
    let alone = Scene::with_members(scene.members(), Policy::Independent, scene.polygons().to_vec()).unwrap();
    let alone = run_fields(&alone, &quick(1));
    let sum = |bake: &Bake, of: fn([f32; 3]) -> f32| -> f64 {
        let grid = &bake.sides[0].1;
        (0..grid.mask.len()).filter(|&o| grid.mask[o] == Mask::Valid).map(|o| f64::from(of(grid.radiance[o]))).sum()
    };
    let shadow = 1.0 - sum(&bakes[0], |c| c[0]) / sum(&alone[0], |c| c[0]);
    let redness = |bake: &Bake| sum(bake, |c| c[0]) / sum(bake, |c| c[1]);
    let reddened = redness(&bakes[1]) / redness(&alone[1]) - 1.0;
    println!("white shadows take {:.1} % of red, red light reddens white by {:.1} %", 100.0 * shadow, 100.0 * reddened);
    assert!(shadow > 0.03 && reddened > 0.01, "{shadow} {reddened}");
}

/// Below a block with caps most of the light that is reflected comes from caps, which hold no photons.
#[test]
fn light_from_caps_is_in_references_by_photons() {
    let device = Device::new(1).unwrap();
    let white = coloured([0.9; 3]);
    let floor = field(unit(9), 0.1, 0.5, |x| x.z);
    let walls = cornell_box(floor.lattice(), 0.1).unwrap();
    let block = field(lattice([9; 3], DVec3::new(0.2, 0.2, 0.3), DVec3::new(0.8, 0.8, 0.9)), 0.1, 0.7, |x| x.x);
    let members = vec![
        member("floor", floor, Surface { outside: Side::Higher, ..white.clone() }),
        Member { boundary: Boundary::Capped, ..member("block", block, white) },
    ];
    let (scene, c) = (joint(members, walls), 0.3);
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    let mesh = SurfaceMesh::extract(&scene, c, 1).unwrap();
    // The sum over the vertices below the block, and its variance.
    let sum = |integrator, seed| {
        let settings = ReferenceSettings {
            integrator,
            samples: 1024,
            batches: 8,
            photons: 1 << 20,
            map: SurfaceMapSettings { photons: 32, ..SurfaceMapSettings::default() },
            seed,
            ..ReferenceSettings::default()
        };
        let found = reference(&scene, &tracer, &mesh, c, &settings, &|_| true).unwrap();
        let below = |v: &usize| (mesh.positions[*v] - DVec3::splat(0.5)).abs().truncate().max_element() < 0.3;
        let below: Vec<usize> = (0..mesh.local.len()).filter(below).collect();
        [&found.radiance, &found.variance].map(|values| below.iter().map(|&v| values[v].y).sum::<f64>())
    };
    let [photons, paths] = [sum(Integrator::Photon, 1), sum(Integrator::Path, 2)];
    let (ratio, noise) = (photons[0] / paths[0], (photons[1] + paths[1]).sqrt() / paths[0]);
    println!("photons : paths = {ratio:.4} ± {noise:.4}");
    assert!(noise < 0.05 && (ratio - 1.0).abs() < 3.3 * noise, "{ratio} ± {noise}");
}

/// A volume held at an isovalue gives what it gives where it sweeps through that isovalue: in paths and in bakes.
#[test]
fn a_held_volume_lights_as_one_that_sweeps() {
    let dir = tempfile::tempdir().unwrap();
    let load = |range: &str| {
        let path = dir.path().join("scene.toml");
        let text = format!(
            "[[volume]]\nname = \"a\"\ngenerator = \"bumps\"\nsize = 25\nisovalues = [3.6, 95]\n\
             [[volume]]\nname = \"b\"\ngenerator = \"sphere\"\nsize = 13\norigin = [0.1, 0.25, 0.05]\nscale = 0.5\n{range}\n\
             albedo = [0.9, 0.1, 0.1]\noutside = \"higher\"\n"
        );
        std::fs::write(&path, text).unwrap();
        isolume::scene_file::load(&path, &Default::default()).unwrap().scene
    };
    let (held, sweeps) = (load("held = 0.1"), load("isovalues = [0.02, 0.18]"));
    assert_eq!((held.fields(), sweeps.fields()), (1, 2));
    let (device, c) = (Device::new(1).unwrap(), 0.5);
    let mean = |scene: &Scene, seed: u64| {
        let mesh = SurfaceMesh::extract(scene, c, 1).unwrap();
        let tracer = SurfaceTracer::new(&device, scene, c, 1).unwrap();
        let settings =
            ReferenceSettings { samples: 128, vertices: Some(400), seed, batches: 8, ..ReferenceSettings::default() };
        let paths = reference(scene, &tracer, &mesh, c, &settings, &|_| true).unwrap();
        let bake = run(scene, &quick(seed));
        let (mut sum, mut variance, mut baked, mut n) = (0.0, 0.0, 0.0, 0.0);
        for v in (0..mesh.local.len()).filter(|&v| paths.sampled[v]) {
            sum += paths.radiance[v].x;
            variance += paths.variance[v].x;
            baked += bake.sides[0].1.interpolate(&bake.lattice, mesh.local[v]).x;
            n += 1.0;
        }
        (sum / n, variance.sqrt() / n, baked / n)
    };
    let (a, b) = (mean(&held, 1), mean(&sweeps, 2));
    println!("paths {:.5} ± {:.5} and {:.5} ± {:.5}, bakes {:.5} and {:.5}", a.0, a.1, b.0, b.1, a.2, b.2);
    assert!((a.0 - b.0).abs() < 4.0 * a.1.hypot(b.1), "paths");
    assert!((a.2 / b.2 - 1.0).abs() < 0.01, "bakes");
}

#[test]
fn names_and_numbers_are_checked() {
    let m = |name: &str| member(name, field(unit(5), 0.1, 0.9, large), Surface::default());
    let error = |names: &[&str]| {
        let members = names.iter().map(|n| m(n)).collect();
        Scene::with_members(members, Policy::Joint, Vec::new()).unwrap_err().to_string()
    };
    assert!(error(&["a", "a"]).contains("twice"));
    assert!(error(&["a", ""]).contains("needs one"));
    assert!(error(&["a", "../b"]).contains("letters"));
    assert!(error(&[]).contains("volumes"));
    let scene = joint(vec![m("a"), m("b")], Vec::new());
    assert!(scene.field_named("c").unwrap_err().to_string().contains("a, b"));
    assert_eq!((scene.field_named("b").unwrap(), scene.seen_from(1).name.as_str()), (1, "b"));
    let volume = Volume::new("v", unit(5), Samples::F32((0..125).map(|x| x as f32).collect())).unwrap();
    assert!(Field::new(&volume, Sweep::new(0.0, 1.0).unwrap()).is_ok());
}
