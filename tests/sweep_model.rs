//! The parts of the model that the line-sweep engine must get right: energy, isolation, walls, caps, oblique axes,
//! holes in the data, several luminaires, and its own standard error.

use glam::{DMat3, DVec3};
use isolume::embree::{Device, GraphTracer};
use isolume::field::{Field, Sweep};
use isolume::flat::FlatLight;
use isolume::flattened::{Departure, Side, Target};
use isolume::luminaire::unoccluded;
use isolume::polygon::Polygon;
use isolume::rng::{Rng, Sobol, Stage};
use isolume::scene::{Boundary, Scene, Surface, cornell_box};
use isolume::sweep::{SweepResult, SweepSettings, sweep};
use isolume::tracer::Tracer;
use isolume::volume::{Lattice, Samples, Volume};
use isolume::warp::{Frame, cosine_hemisphere};
use rayon::prelude::*;
use std::f64::consts::PI;

fn field(lattice: Lattice, range: (f64, f64), f: impl Fn(DVec3) -> f64 + Sync) -> Field {
    let samples = (0..lattice.len()).into_par_iter().map(|o| f(lattice.to_world(lattice.point(o)))).collect();
    let volume = Volume::new("test", lattice, Samples::F64(samples)).unwrap();
    Field::new(&volume, Sweep::new(range.0, range.1).unwrap()).unwrap()
}

fn cube(n: usize, lo: f64, hi: f64) -> Lattice {
    Lattice::aligned([n; 3], DVec3::splat(lo), DVec3::splat((hi - lo) / (n - 1) as f64)).unwrap()
}

fn bumps(x: DVec3) -> f64 {
    let g = |m: [f64; 3], s: f64| (-(x - DVec3::from_array(m)).length_squared() / (2.0 * s * s)).exp();
    100.0 * g([0.5, 0.5, 0.38], 0.16)
        + 80.0 * (g([0.32, 0.40, 0.74], 0.05) + g([0.62, 0.35, 0.76], 0.05) + g([0.52, 0.66, 0.72], 0.05))
}

/// The six faces of a box around Ω, `margin` of its edges wide, facing in.
fn closed_box(lattice: &Lattice, margin: f64, albedo: f64, emission: f64) -> Vec<Polygon> {
    let far = lattice.far();
    let place = |p: DVec3| lattice.to_world((p * (1.0 + 2.0 * margin) - margin) * far);
    (0..6)
        .map(|face| {
            let (a, end) = (face % 3, (face / 3) as f64);
            let (b, c) = ((a + 1) % 3, (a + 2) % 3);
            let mut v = [(0., 0.), (1., 0.), (1., 1.), (0., 1.)]
                .map(|(s, t)| {
                    let mut p = DVec3::ZERO;
                    (p[a], p[b], p[c]) = (end, s, t);
                    place(p)
                })
                .to_vec();
            if (v[1] - v[0]).cross(v[3] - v[0]).dot(place(DVec3::splat(0.5)) - v[0]) < 0.0 {
                v.reverse();
            }
            Polygon::new(&format!("face {face}"), v, DVec3::splat(albedo), DVec3::splat(emission)).unwrap()
        })
        .collect()
}

fn run(scene: &Scene, settings: SweepSettings) -> SweepResult {
    sweep(scene, &settings, &|_| true).unwrap()
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

fn is_valid(scene: &Scene, o: usize) -> bool {
    (0.0..=1.0).contains(&scene.field.samples()[o]) && scene.field.node_gradient(scene.lattice().ijk(o)) != DVec3::ZERO
}

/// Valid nodes at least `skin` nodes from Ω's faces.
fn nodes(scene: &Scene, skin: usize) -> Vec<usize> {
    let dims = scene.lattice().dims();
    let deep = |o: usize| {
        let ijk = scene.lattice().ijk(o);
        (0..3).all(|a| ijk[a] >= skin && ijk[a] + skin < dims[a])
    };
    (0..scene.lattice().len()).filter(|&o| is_valid(scene, o) && deep(o)).collect()
}

fn mean_rms(x: &[f64]) -> (f64, f64) {
    let n = x.len() as f64;
    (x.iter().sum::<f64>() / n, (x.iter().map(|e| e * e).sum::<f64>() / n).sqrt())
}

fn walls_are_finite(got: &SweepResult) -> bool {
    let textures = got.flats.iter().flatten().flat_map(FlatLight::textures);
    textures.flat_map(|t| t.texels.as_flattened()).all(|x| x.is_finite())
}

/// E/π of the first stored side, green.
fn radiosity(got: &SweepResult, o: usize) -> f64 {
    f64::from(got.sides[0].irradiance[o][1]) / PI
}

#[test]
fn what_level_sets_send_is_what_walls_and_level_sets_gather() {
    // Level sets of bumps shine with radiance 1 on their outer sides in a closed box. Over all isovalues they send
    // π ∫|∇h| dV (coarea); it arrives on themselves, ∫E |∇h| dV, and on the walls, ∫∫E dA dc.
    let lattice = cube(61, 0.0, 1.0);
    // The sweep ends above what reaches Ω's faces, so that every level set is closed.
    let f = field(lattice, (20.0, 95.0), bumps);
    let surface = Surface { albedo: DVec3::ZERO.into(), emission: DVec3::ONE, ..Surface::default() };
    let walls = closed_box(f.lattice(), 0.0, 0.5, 0.0);
    let scene = Scene::new(f, surface, Boundary::Open, walls).unwrap();
    let cell = scene.lattice().cell_volume();
    let valid = nodes(&scene, 0);
    let gradient = |o: usize| scene.field.node_gradient(scene.lattice().ijk(o)).length();
    let sent: f64 = PI * cell * valid.iter().map(|&o| gradient(o)).sum::<f64>();
    let balance: Vec<f64> = (0..8)
        .map(|seed| {
            let got = run(&scene, SweepSettings { directions: 128, seed, flat_resolution: (24, 24), ..ONE_BOUNCE });
            let own: f64 = cell * valid.iter().map(|&o| PI * radiosity(&got, o) * gradient(o)).sum::<f64>();
            let mut walls = 0.0;
            for (t, p) in got.flats.iter().zip(scene.polygons()) {
                let texels = &t.as_ref().unwrap().outside.texels;
                // B = ρE/π.
                walls +=
                    texels.iter().map(|t| f64::from(t[1]) * PI / 0.5).sum::<f64>() / texels.len() as f64 * p.area();
            }
            assert!(own > 0.0 && walls > 0.8 * sent);
            (own + walls) / sent - 1.0
        })
        .collect();
    let (mean, _) = mean_rms(&balance);
    let spread = (balance.iter().map(|b| (b - mean).powi(2)).sum::<f64>() / 7.0 / 8.0).sqrt();
    println!("gathered / sent − 1: {mean:.5} ± {spread:.5}");
    // Sums over a lattice stand for integrals: they are good to about 1e-2 here.
    assert!(mean.abs() < 3.0 * spread + 0.01, "{mean} ± {spread}");
}

#[test]
fn a_convex_level_set_in_a_furnace_shows_its_albedo() {
    let (rho, lattice) = (0.3, cube(41, -1.0, 1.0));
    let f = field(lattice, (-0.8, -0.2), |x| -(x.length_squared() + 0.3 * x.x * x.x));
    let surface = Surface { albedo: DVec3::splat(rho).into(), ..Surface::default() };
    let walls = closed_box(f.lattice(), 0.0, 0.0, 1.0);
    let scene = Scene::new(f, surface, Boundary::Open, walls).unwrap();
    let got = run(&scene, SweepSettings { light_points: 64, ..ONE_BOUNCE });
    let errors: Vec<f64> = nodes(&scene, 0).iter().map(|&o| rho * (radiosity(&got, o) - 1.0)).collect();
    let (mean, rms) = mean_rms(&errors);
    println!("convex furnace: mean {mean:.5}, RMS {rms:.5}, {} nodes", errors.len());
    assert!(errors.len() > 5000 && mean.abs() < 0.002 && rms < 0.004);
}

#[test]
fn far_isovalues_do_not_light_each_other() {
    let lattice = cube(65, 0.0, 1.0);
    let h = |x: DVec3| {
        let g = |m: DVec3| (-(x - m).length_squared() / (2.0 * 0.25 * 0.25)).exp();
        g(DVec3::new(0.2, 0.5, 0.5)).max(0.0) + 0.8 * g(DVec3::new(0.8, 0.4, 0.5))
    };
    let (c, w) = (0.5, 0.35);
    // Monotone and the identity within w of c: no sample changes sides of an isovalue there.
    let squeezed = |x: DVec3| {
        let h = h(x);
        if h > c + w {
            c + w + 0.3 * (h - c - w)
        } else if h < c - w {
            c - w - 0.4 * (c - w - h)
        } else {
            h
        }
    };
    let light = {
        let v = [(-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0), (1.0, -1.0)]
            .map(|(x, y)| DVec3::new(0.5 + 0.3 * x, 0.5 + 0.3 * y, 1.2))
            .to_vec();
        Polygon::new("light", v, DVec3::ZERO, DVec3::ONE).unwrap()
    };
    let light_it = |f: Field| {
        let scene = Scene::new(f, Surface::default(), Boundary::Open, vec![light.clone()]).unwrap();
        let settings = SweepSettings { directions: 64, light_points: 4, ..ONE_BOUNCE };
        let direct = run(&scene, SweepSettings { max_bounces: 0, ..settings });
        let got = run(&scene, settings);
        (scene, [direct, got])
    };
    let (scene, one) = light_it(field(lattice.clone(), (0.0, 1.0), h));
    let (_, two) = light_it(field(lattice, (0.0, 1.0), squeezed));
    let differs = |o: usize| {
        let bits = |x: &[SweepResult; 2]| x.each_ref().map(|x| x.sides[0].irradiance[o].map(f32::to_bits));
        bits(&one) != bits(&two)
    };
    let (mut near, mut lit, mut far) = (0, 0, 0);
    for o in nodes(&scene, 1) {
        let d = (f64::from(scene.field.samples()[o]) - c).abs();
        if d < 0.05 {
            near += 1;
            lit += usize::from(one[1].sides[0].irradiance[o][1] > one[0].sides[0].irradiance[o][1]);
            assert!(!differs(o), "node {o} at {}", scene.field.samples()[o]);
        } else if d > w {
            far += usize::from(differs(o));
        }
    }
    println!("{near} nodes alike, {lit} of them lit by others; {far} far ones differ");
    assert!(near > 5000 && lit > 500 && far > 5000);
}

#[test]
fn a_floor_sees_a_long_wall_as_it_should() {
    // The floor is a polygon with a texture; the wall shines: x ≥ 50 + c up to z = height − c.
    for (k, height, expected) in [(0.6, 24.0, 0.071254), (2.0, 40.0, 0.276393), (10.0, 120.0, 0.450248)] {
        let lattice =
            Lattice::aligned([61, 31, height as usize + 12], DVec3::ZERO, DVec3::new(1.0, 20.0, 1.0)).unwrap();
        let f = field(lattice, (-2.0, 2.0), |x| (x.x - 50.0).min(height - x.z));
        let v = [(0., 0.), (60., 0.), (60., 600.), (0., 600.)].map(|(x, y)| DVec3::new(x, y, 0.0)).to_vec();
        let floor = Polygon::new("floor", v, DVec3::splat(0.5), DVec3::ZERO).unwrap();
        let surface = Surface { albedo: DVec3::ZERO.into(), emission: DVec3::ONE, ..Surface::default() };
        let scene = Scene::new(f, surface, Boundary::Open, vec![floor]).unwrap();
        // Few lines meet each texel: what counts is the mean.
        let settings = SweepSettings { directions: 1024, replicates: 8, flat_resolution: (150, 8), ..ONE_BOUNCE };
        let got = run(&scene, settings);
        let texture = &got.flats[0].as_ref().unwrap().outside;
        let errors: Vec<f64> = (0..50)
            .map(|y| {
                let at = DVec3::new(50.0 - height / k, 200.0 + 4.0 * f64::from(y), 0.0);
                let [u, v] = scene.polygons()[0].texture(at);
                // B = ρE/π, ρ = ½; c = 0.
                texture.lookup([u, v, 0.5]).y / 0.5 - expected
            })
            .collect();
        let (mean, rms) = mean_rms(&errors);
        println!("k = {k}: {expected}, error {mean:.5}, RMS {rms:.5}");
        assert!(mean.abs() < 0.006 && rms < 0.015, "k = {k}: {mean} {rms}");
    }
}

#[test]
fn oblique_axes_change_nothing() {
    // Bumps on a sheared, flipped lattice of uneven spacing, against exact rays.
    let axes = DMat3::from_cols(
        DVec3::new(-0.016, 0.002, 0.0),
        DVec3::new(0.005, 0.02, 0.001),
        DVec3::new(0.0, -0.004, 0.011),
    );
    let lattice = Lattice::new([71, 61, 91], DVec3::new(0.95, 0.15, 0.0), axes).unwrap();
    let surface = Surface { albedo: DVec3::ZERO.into(), emission: DVec3::ONE, ..Surface::default() };
    let scene = Scene::new(field(lattice, (3.6, 95.0), bumps), surface, Boundary::Open, Vec::new()).unwrap();
    let device = Device::new(1).unwrap();
    let tracer = GraphTracer::new(&device, &scene).unwrap();
    let got = run(&scene, SweepSettings { directions: 512, ..ONE_BOUNCE });
    let all = nodes(&scene, 3);
    let mut rng = Rng::stream(1, Stage::Test, 0);
    let some: Vec<usize> = (0..400).map(|_| all[(rng.unit() * all.len() as f64) as usize]).collect();
    let errors: Vec<f64> = some
        .par_iter()
        .map(|&o| {
            let p = scene.lattice().point(o);
            let frame = Frame::new(scene.normal(p, Side::Lower).unwrap());
            let set = Sobol::set(3, Stage::Test, o as u64);
            let hits = (0..1024u32).filter(|&i| {
                let d = frame.to_world(cosine_hemisphere(set.point2(i, 0)));
                let ray = scene.ray(p.as_vec3(), d, scene.field.samples()[o], Departure::Surface(Side::Lower));
                matches!(tracer.intersect(&ray), Some(h) if matches!(h.target, Target::Surface(_)))
            });
            radiosity(&got, o) - hits.count() as f64 / 1024.0
        })
        .collect();
    let (mean, rms) = mean_rms(&errors);
    println!("oblique axes: mean {mean:.5}, RMS {rms:.5}");
    assert!(mean.abs() < 0.002 && rms < 0.006);
}

#[test]
fn standard_errors_are_what_they_say() {
    let f = field(cube(29, 0.0, 1.0), (3.6, 95.0), bumps);
    let walls = cornell_box(f.lattice(), 0.0).unwrap();
    let scene = Scene::new(f, Surface::default(), Boundary::Open, walls).unwrap();
    let settings = SweepSettings { directions: 32, light_points: 4, max_bounces: 3, replicates: 8, ..ONE_BOUNCE };
    let luminance = |got: &SweepResult, o: usize| -> f64 {
        (0..3)
            .map(|c| {
                let e = f64::from(got.sides[0].irradiance[o][c]);
                [0.2126, 0.7152, 0.0722][c] * 0.75 * e / PI
            })
            .sum()
    };
    let truth = run(&scene, SweepSettings { replicates: 128, seed: 99, ..settings });
    let got = run(&scene, settings);
    // In the mean over nodes the squared error is the variance that is claimed (the truth has 1/16 of it, or less).
    // Node by node, few replicates beside shadows' edges see what others do not: there tails are longer than Student's.
    let (mut squared, mut said, mut within, mut count) = (0.0, 0.0, 0.0, 0.0);
    for o in nodes(&scene, 1) {
        let error2 = (luminance(&got, o) - luminance(&truth, o)).powi(2);
        let variance = 17.0 / 16.0 * f64::from(got.sides[0].std_error[o]).powi(2);
        squared += error2;
        said += variance;
        within += f64::from(error2 <= 2.365 * 2.365 * variance);
        count += 1.0;
    }
    println!("error² {squared:.4e}, claimed {said:.4e}, {:.3} within 95 % limits, {count} nodes", within / count);
    assert!(count > 3000.0 && (0.7..1.4).contains(&(squared / said)) && within / count > 0.8);
}

#[test]
fn caps_close_level_sets() {
    // A ramp in a furnace with a margin: level sets and Ω's faces bound a convex solid that shows its albedo
    // everywhere.
    let (rho, lattice) = (0.4, cube(25, 0.0, 1.0));
    let f = field(lattice, (0.2, 0.8), |x| x.x + 0.1 * x.y);
    let walls = closed_box(f.lattice(), 0.3, 0.0, 1.0);
    let surface = Surface { albedo: DVec3::splat(rho).into(), ..Surface::default() };
    let scene = Scene::new(f, surface, Boundary::Capped, walls).unwrap();
    let got = run(&scene, SweepSettings { light_points: 64, ..ONE_BOUNCE });
    let errors: Vec<f64> = nodes(&scene, 1).iter().map(|&o| rho * (radiosity(&got, o) - 1.0)).collect();
    let (mean, rms) = mean_rms(&errors);
    println!("capped: level sets {mean:.5}, RMS {rms:.5}");
    assert!(mean.abs() < 0.005 && rms < 0.01);
    // The cap on x = 1 (face 3) is covered at every isovalue.
    let cap = &got.flats[scene.polygons().len() + 3].as_ref().unwrap().outside;
    let errors: Vec<f64> = cap.texels.iter().map(|t| f64::from(t[1]) - rho).collect();
    let (mean, rms) = mean_rms(&errors);
    println!("capped: caps {mean:.5}, RMS {rms:.5}");
    assert!(mean.abs() < 0.005 && rms < 0.01);
    // Uncapped, the inside of the solid is open, but the outer side sees the same.
    assert!(walls_are_finite(&got));
}

/// Light from outside stays outside: the inside of capped solids is black, beside the luminaire too, and the outside as
/// if it alone were stored.
#[test]
fn the_inside_of_capped_solids_is_dark() {
    let holed = |both_sides: bool, emission: f64, hole: bool| {
        let missing = |x: DVec3| hole && x.length() < 0.1;
        let value = move |x: DVec3| if missing(x) { f64::NAN } else { bumps(x) };
        let f = field(cube(25, 0.0, 1.0), (3.6, 95.0), value);
        let walls = cornell_box(f.lattice(), 0.05).unwrap();
        let surface = Surface { both_sides, emission: DVec3::splat(emission), ..Surface::default() };
        Scene::new(f, surface, Boundary::Capped, walls).unwrap()
    };
    let scene = |both_sides: bool, emission: f64| holed(both_sides, emission, false);
    // Few points: they are far apart, so that nodes near the luminaire look at points of their own.
    let settings = SweepSettings { directions: 64, light_points: 4, max_bounces: 3, ..ONE_BOUNCE };
    let [both, one] = [true, false].map(|both| run(&scene(both, 0.0), settings));
    // Nodes near the luminaire take other points where both are stored.
    let apart: Vec<f64> =
        nodes(&scene(false, 0.0), 0).iter().map(|&o| radiosity(&both, o) - radiosity(&one, o)).collect();
    let (mean, rms) = mean_rms(&apart);
    let [most, inside] =
        [&one.sides[0], &both.sides[1]].map(|side| side.irradiance.iter().flatten().fold(0f32, |m, x| m.max(*x)));
    println!("outside {most}, apart {mean:.5}, RMS {rms:.5}, inside {inside}");
    assert!(most > 0.1 && mean.abs() < 1e-3 && rms < 5e-3 && inside == 0.0);
    // What shines there, or lets light in.
    for [lit, dark] in [[scene(true, 1.0), scene(false, 1.0)], [true, false].map(|both| holed(both, 0.0, true))] {
        let refused = sweep(&lit, &settings, &|_| true).unwrap_err().to_string();
        assert!(refused.contains("caps") && refused.contains("--engine photon"), "{refused}");
        assert!(sweep(&dark, &settings, &|_| true).is_ok());
    }
}

#[test]
fn holes_in_the_data_hold_no_surface_and_hide_nothing() {
    let f = |hole: bool| {
        field(cube(33, 0.0, 1.0), (3.6, 95.0), move |x| {
            // Where every level set is far.
            let in_hole = hole && x.x < 0.1 && x.y < 0.1 && x.z < 0.3;
            if in_hole { f64::NAN } else { bumps(x) }
        })
    };
    let light_it = |f: Field| {
        let walls = cornell_box(f.lattice(), 0.0).unwrap();
        let scene = Scene::new(f, Surface::default(), Boundary::Open, walls).unwrap();
        let got = run(&scene, SweepSettings { directions: 128, max_bounces: 2, ..ONE_BOUNCE });
        (scene, got)
    };
    let ((whole, one), (holed, two)) = (light_it(f(false)), light_it(f(true)));
    assert!(two.sides[0].irradiance.iter().flatten().all(|x| x.is_finite()));
    assert!(walls_are_finite(&two));
    let holes = (0..holed.lattice().len()).filter(|&o| holed.field.samples()[o].is_nan()).count();
    assert!(holes > 50);
    let errors: Vec<f64> = nodes(&whole, 0).iter().map(|&o| radiosity(&two, o) - radiosity(&one, o)).collect();
    let (mean, rms) = mean_rms(&errors);
    println!("holes: mean {mean:.6}, RMS {rms:.6}");
    assert!(mean.abs() < 1e-4 && rms < 1e-3);
}

/// Planes that glow, but for those in a gap in the middle of Ω: walls see those that there are from either side, and
/// nothing at the isovalues of the others.
#[test]
fn walls_see_nothing_in_a_gap() {
    let f = field(cube(21, 0.0, 1.0), (0.0, 1.0), |x| if (x.x - 0.5).abs() < 0.09 { f64::NAN } else { x.x });
    let walls = closed_box(f.lattice(), 0.0, 0.5, 0.0);
    let black = Surface { albedo: DVec3::ZERO.into(), emission: DVec3::ONE, ..Surface::default() };
    let scene = Scene::new(f, black, Boundary::Open, walls).unwrap();
    let got = run(&scene, SweepSettings { flat_resolution: (8, 20), ..ONE_BOUNCE });
    for (face, wall) in got.flats.iter().take(6).enumerate() {
        let wall = wall.as_ref().unwrap();
        let [nu, nv, nc] = wall.outside.dims;
        let polygon = &scene.polygons()[face];
        // As the side sees it that texels are on; where samples are missing both sides do.
        let mean = |t: usize| {
            let seen = (0..nu * nv).map(|texel| {
                let uv = [texel % nu, texel / nu].map(|i| (i as f64 + 0.5) / nu as f64);
                let [x, at] = [polygon.at(uv).x, (t as f64 + 0.5) / nc as f64];
                let [outside, own] =
                    [Some(&wall.outside), wall.own()].map(|w| w.map(|w| w.texels[t * nu * nv + texel]));
                assert!((x - 0.5).abs() > 0.05 || own.is_none_or(|own| Some(own) == outside), "{face}: {x}");
                own.filter(|_| x > at).or(outside).map_or(0.0, |b| f64::from(b[1]))
            });
            seen.sum::<f64>() / (nu * nv) as f64
        };
        let means: Vec<f64> = (0..nc).map(mean).collect();
        println!("face {face}: {means:.3?}");
        for (t, mean) in means.iter().enumerate() {
            // The rims lie at 0.4 and 0.6.
            let there = ((t as f64 + 0.5) / nc as f64 - 0.5).abs() > 0.1;
            assert!(if there { *mean > 0.05 } else { *mean == 0.0 }, "face {face}, texel {t}: {mean}");
        }
    }
}

/// A sample that is missing far away changes nothing of what is dark in a ball that stands on a wall.
#[test]
fn walls_in_closed_solids_are_dark_if_a_sample_is_missing_elsewhere() {
    let lit = |missing: bool| {
        let f = field(cube(21, 0.0, 1.0), (0.2, 0.8), |x| {
            if missing && x.min_element() > 0.99 {
                f64::NAN
            } else {
                (1.3 - 3.0 * (x - DVec3::new(0.0, 0.5, 0.4)).length()).max(0.0)
            }
        });
        let walls = cornell_box(f.lattice(), 0.0).unwrap();
        let surface = Surface { outside: Side::Higher, ..Surface::default() };
        run(&Scene::new(f, surface, Boundary::Open, walls).unwrap(), SweepSettings { max_bounces: 3, ..ONE_BOUNCE })
    };
    let [whole, holed] = [false, true].map(lit);
    for got in [&whole, &holed] {
        let most = got.sides[0].irradiance.iter().flatten().fold(0f32, |m, x| m.max(*x));
        assert!(got.sides[0].side == Side::Higher && most < 1e-3, "{most} within the ball");
    }
    // The wall that it stands on, as the inside sees it and as the outside does.
    let seen = |got: &SweepResult, inside: bool| {
        let light = got.flats.iter().flatten().find(|light| light.own().is_some()).expect("a wall with two sides");
        let texture = if inside { &light.outside } else { light.own().unwrap() };
        texture.texels.as_flattened().iter().map(|x| f64::from(*x)).sum::<f64>() / texture.texels.len() as f64
    };
    for inside in [false, true] {
        let [a, b] = [seen(&whole, inside), seen(&holed, inside)];
        assert!((a - b).abs() < 0.02 * seen(&whole, false), "{inside}: {a} {b}");
    }
    assert!(seen(&whole, true) < 0.5 * seen(&whole, false));
}

/// What stands beyond gaps shines from behind, too, whether light of its inside is stored or not.
#[test]
fn surfaces_that_glow_are_seen_from_behind_through_gaps() {
    let scene = |both_sides: bool| {
        let f = field(cube(17, 0.0, 1.0), (-0.9, 0.9), |x| {
            if (x.y - 0.5).abs() < 0.1 { f64::NAN } else { (5.0 * x.x + 1.0).sin() * (6.0 * x.y).sin() + 0.3 * x.z }
        });
        let surface = Surface { emission: DVec3::ONE, both_sides, ..Surface::default() };
        Scene::new(f, surface, Boundary::Open, Vec::new()).unwrap()
    };
    let [one, both] = [false, true].map(|both| run(&scene(both), ONE_BOUNCE));
    assert_eq!((one.sides.len(), both.sides.len()), (1, 2));
    assert!(one.sides[0].irradiance.iter().flatten().any(|x| *x > 0.0));
    assert_eq!(one.sides[0].irradiance, both.sides[0].irradiance);
    let capped = Scene::new((*scene(false).field).clone(), scene(false).surface, Boundary::Capped, Vec::new()).unwrap();
    assert!(sweep(&capped, &ONE_BOUNCE, &|_| true).is_err(), "caps are no black walls there");
}

/// The inside of capped solids is dark, but not the room around them.
#[test]
fn walls_and_caps_are_lit_if_the_inside_is_stored() {
    let lit = |outside: Side| {
        let f = field(cube(13, 0.0, 1.0), (0.2, 0.8), |x| x.x);
        let walls = cornell_box(f.lattice(), 0.3).unwrap();
        let surface = Surface { outside, ..Surface::default() };
        run(&Scene::new(f, surface, Boundary::Capped, walls).unwrap(), SweepSettings { max_bounces: 3, ..ONE_BOUNCE })
    };
    let [lower, higher] = Side::BOTH.map(lit);
    assert_eq!(higher.sides[0].side, Side::Higher);
    assert!(higher.sides[0].irradiance.iter().flatten().all(|x| *x == 0.0));
    // Walls and caps.
    let mean = |got: &SweepResult| -> Vec<f64> {
        let textures = got.flats.iter().flatten().map(|light| light.outside.texels.as_flattened());
        textures.map(|x| x.iter().map(|x| f64::from(*x)).sum::<f64>() / x.len() as f64).collect()
    };
    let [lower, higher] = [mean(&lower), mean(&higher)];
    println!("{lower:.4?} {higher:.4?}");
    // Five walls and five caps: the ramp is 0 in the sixth face.
    assert!(lower.len() == higher.len() && lower.iter().filter(|x| **x > 1e-5).count() >= 9);
    for (a, b) in lower.iter().zip(&higher) {
        assert!((a - b).abs() <= 0.02 * a, "{a} {b}");
    }
}

/// A hole in the face of a black capped solid shows walls what its cap does: nothing. Lines that come through it end on
/// the caps behind, not on the walls beyond them.
#[test]
fn walls_do_not_see_through_capped_solids_with_a_hole() {
    let lit = |hole: bool| {
        // Above the sweep but in one corner.
        let f = field(cube(17, 0.0, 1.0), (0.2, 0.8), |x| {
            let in_hole = hole && x.x < 0.2 && (x.y - 0.5).abs() < 0.2 && (x.z - 0.5).abs() < 0.2;
            if in_hole { f64::NAN } else { f64::from(x.min_element() < 0.99) }
        });
        let walls = closed_box(f.lattice(), 0.3, 0.5, 1.0);
        let black = Surface { albedo: DVec3::ZERO.into(), ..Surface::default() };
        run(&Scene::new(f, black, Boundary::Capped, walls).unwrap(), SweepSettings { max_bounces: 2, ..ONE_BOUNCE })
            .flats
    };
    let [whole, holed] = [false, true].map(lit);
    let (mut most, mut light) = (0f32, 0f32);
    for (one, other) in whole.iter().flatten().zip(holed.iter().flatten()) {
        let [one, other] = [one, other].map(|light| &light.outside);
        for (a, b) in one.texels.iter().flatten().zip(other.texels.iter().flatten()) {
            (most, light) = (most.max((a - b).abs()), light.max(*a));
        }
    }
    println!("{most:.1e} apart, {light} at most");
    assert!(light > 0.4 && most < 1e-3);
}

#[test]
fn luminaires_add_up() {
    let square = |name: &str, at: DVec3, to: DVec3| {
        let n = (to - at).normalize();
        let s = n.any_orthonormal_vector();
        let t = n.cross(s);
        let v = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|(a, b)| at + 0.2 * (a * s + b * t)).to_vec();
        Polygon::new(name, v, DVec3::ZERO, DVec3::ONE).unwrap()
    };
    let middle = DVec3::splat(0.5);
    let (a, b) = (square("a", DVec3::new(0.5, 0.5, 1.3), middle), square("b", DVec3::new(-0.4, 0.3, 0.6), middle));
    let light_it = |lights: Vec<Polygon>| {
        let f = field(cube(33, 0.0, 1.0), (3.6, 95.0), bumps);
        let scene = Scene::new(f, Surface::default(), Boundary::Open, lights).unwrap();
        let got = run(&scene, SweepSettings { directions: 256, light_points: 64, max_bounces: 2, ..ONE_BOUNCE });
        (scene, got)
    };
    let (scene, both) = light_it(vec![a.clone(), b.clone()]);
    let ((_, one), (_, two)) = (light_it(vec![a]), light_it(vec![b]));
    let all = nodes(&scene, 0);
    let sum = |o: usize| radiosity(&one, o) + radiosity(&two, o);
    let errors: Vec<f64> = all.iter().map(|&o| radiosity(&both, o) - sum(o)).collect();
    let (mean, rms) = mean_rms(&errors);
    let scale = mean_rms(&all.iter().map(|&o| sum(o)).collect::<Vec<_>>()).1;
    println!("two luminaires: mean {:.5}, RMS {:.5} of {scale:.4}", mean / scale, rms / scale);
    assert!(mean.abs() < 0.005 * scale && rms < 0.03 * scale);
}

/// The floor of a solid x ≥ c: texels that it covers in part hold the light of the rest. (The lamp is in Ω's face;
/// beyond that, light would reach the solid's inside, too.)
#[test]
fn texels_that_solids_cover_in_part_are_as_bright_as_the_rest() {
    let polygon = |name: &str, v: [[f64; 3]; 4], albedo: f64, emission: f64| {
        let v = v.map(DVec3::from_array).to_vec();
        Polygon::new(name, v, DVec3::splat(albedo), DVec3::splat(emission)).unwrap()
    };
    let floor = [[0., 0., 0.], [1., 0., 0.], [1., 1., 0.], [0., 1., 0.]];
    let lamp = [[0.02, 0.45, 1.0], [0.02, 0.55, 1.0], [0.08, 0.55, 1.0], [0.08, 0.45, 1.0]];
    let polygons = vec![polygon("floor", floor, 0.5, 0.0), polygon("lamp", lamp, 0.0, 1.0)];
    let f = field(cube(41, 0.0, 1.0), (0.0, 1.0), |x| x.x);
    let scene = Scene::new(f, Surface::default(), Boundary::Open, polygons).unwrap();
    let settings = SweepSettings { light_points: 256, max_bounces: 0, flat_resolution: (8, 64), ..ONE_BOUNCE };
    let got = run(&scene, settings);
    let texture = &got.flats[1].as_ref().unwrap().outside;
    let [nu, nv, nc] = texture.dims;
    let (mut straddled, mut worst) = (0, 0f64);
    for (t, j, i) in (0..nc).flat_map(|t| (0..nv).flat_map(move |j| (0..nu).map(move |i| (t, j, i)))) {
        let [x, y] = [(i, nu), (j, nv)].map(|(n, count)| (n as f64 + 0.5) / count as f64);
        let at = DVec3::new(x, y, 0.0);
        let open = ((t as f64 + 0.5) / nc as f64 - i as f64 / nu as f64) * nu as f64;
        // The lamp's own place is beside the first texels.
        if i == 0 || open < 0.1 {
            continue;
        }
        straddled += usize::from(open < 0.9);
        let expected = 0.5 / PI * unoccluded(&scene.luminaires()[0], at, DVec3::Z);
        let off = f64::from(texture.texels[(t * nv + j) * nu + i][1]) / expected - 1.0;
        worst = worst.max(off.abs());
    }
    println!("{straddled} texels in part, off by {worst:.1e} at most");
    assert!(straddled > 300 && worst < 1e-3, "{straddled}: {worst}");
}
