//! Watertight curves, and no ray that meets what it starts on.

use super::*;
use crate::field::Sweep;
use crate::rng::{Rng, Stage};
use glam::Vec3;

/// Whole-number noise inside a border of zeros: closed curves, and isovalues that equal samples.
fn noise(levels: u64) -> FlatScene {
    let n = 41;
    let mut rng = Rng::stream(3, Stage::Test, levels);
    let values: Vec<f64> = (0..n * n)
        .map(|o| {
            let border = [o % n, o / n].iter().any(|&i| i == 0 || i == n - 1);
            if border { 0.0 } else { (rng.bits() % levels) as f64 }
        })
        .collect();
    let sweep = Sweep::new(0.0, levels as f64).unwrap();
    let field = HeightField::new([n, n], DVec2::ZERO, DVec2::new(0.5, 2.0), &values, sweep).unwrap();
    FlatScene::new(field, DVec3::ONE, Side::Lower, 1.0, Vec::new()).unwrap()
}

#[test]
fn closed_curves_let_no_ray_out() {
    let device = Device::new(1).unwrap();
    for levels in [2, 5, 200] {
        let scene = noise(levels);
        let tracer = LevelCurves::new(&device, &scene).unwrap();
        let mut rng = Rng::stream(4, Stage::Test, levels);
        let (mut tested, mut leaked, mut disagreed) = (0, 0, 0);
        for i in 0..100_000 {
            let mut p = [rng.unit() * 40.0, rng.unit() * 40.0].map(|x| x as f32);
            if i % 3 > 0 {
                p[i % 2] = p[i % 2].round();
            }
            let angle = rng.unit() * std::f64::consts::TAU;
            let mut d = [angle.cos() as f32, angle.sin() as f32];
            match i % 7 {
                0 => d[0] = -0.0,
                1 => d = [1.0, -1.0],
                2 => d[1] *= 1e-7,
                _ => {}
            }
            let c =
                scene.field.sweep().isovalue(if levels == 2 { 0.5 } else { (1 + rng.bits() % (levels - 2)) as f64 });
            let ray = FlattenedRay::free(Vec3::new(p[0], p[1], 0.0), Vec3::new(d[0], d[1], 0.0), c);
            if !(scene.field.value(DVec2::new(p[0].into(), p[1].into())) > f64::from(c)) {
                continue;
            }
            tested += 1;
            let hit = tracer.intersect(&ray);
            leaked += u32::from(hit.is_none_or(|h| h.target != Target::Surface(Side::Higher)));
            disagreed += u32::from(tracer.occluded(&ray) != hit.is_some());
        }
        assert!(tested > 10_000, "{tested}");
        assert_eq!((leaked, disagreed), (0, 0), "{levels} levels, of {tested}");
    }
}

#[test]
fn rays_leave_what_they_start_on() {
    // A paraboloid: convex, so that nothing that leaves its outside meets it again, in either geometry.
    let sweep = Sweep::new(0.0, 1.0).unwrap();
    let field = HeightField::sample(33, sweep, |x| 1.0 - (x - 0.5).length_squared()).unwrap();
    let scene = FlatScene::new(field, DVec3::ONE, Side::Lower, 1.0, Vec::new()).unwrap();
    let device = Device::new(1).unwrap();
    let (flat, solid) = (LevelCurves::new(&device, &scene).unwrap(), GraphSurface::new(&device, &scene).unwrap());
    let mut rng = Rng::stream(5, Stage::Test, 0);
    let (mut hits, mut back, mut own) = ([0; 2], [0; 2], [0; 2]);
    for i in 0..50_000 {
        let mut p = DVec2::new(rng.unit() * 32.0, rng.unit() * 32.0).as_vec2();
        if i % 4 > 1 {
            p = p.round();
        } else if i % 4 == 1 {
            p.x = p.x.round();
        }
        let xy = p.as_dvec2();
        let d = crate::warp::sphere(rng.unit2()).as_vec3();
        for (k, tracer) in [&flat as &dyn Tracer, &solid as &dyn Tracer].into_iter().enumerate() {
            let (z, slope) = solid.plane(xy, d.truncate().as_dvec2());
            let (origin, direction) = if k == 0 { (p.extend(0.0), d.with_z(0.0)) } else { (p.extend(z as f32), d) };
            let ray = FlattenedRay {
                departure: Departure::Surface(Side::Lower),
                ..FlattenedRay::free(origin, direction, scene.field.value(xy) as f32)
            };
            let rises = f64::from(d.z) - slope.dot(d.truncate().as_dvec2()) > 0.0;
            match tracer.intersect(&ray) {
                Some(h) if h.t == 0.0 => back[k] += 1,
                Some(_) => hits[k] += 1,
                None if k == 1 => own[k] += i32::from(!rises),
                None => {}
            }
            assert_eq!(tracer.occluded(&ray), tracer.intersect(&ray).is_some());
        }
    }
    assert!(back.iter().all(|&n| n > 15_000), "half of the directions go in: {back:?}");
    assert_eq!(own, [0, 0], "every ray that goes in meets the graph at 0");
    // The bilinear curves and the triangles are not quite convex: across cells a few grazing rays meet them again.
    assert!(hits.iter().all(|&n| n < 500), "{hits:?} of 50000");
}

#[test]
fn walls_that_meet_leave_no_slit() {
    let sweep = Sweep::new(0.0, 1.0).unwrap();
    let field = HeightField::sample(4, sweep, |x| x.x + x.y).unwrap();
    let walls = FlatScene::default_box(&field).unwrap();
    let device = Device::new(1).unwrap();
    let scene = FlatScene::new(field, DVec3::ONE, Side::Lower, 1.0, walls).unwrap();
    let tracer = LevelCurves::new(&device, &scene).unwrap();
    for i in 0..1000 {
        let o = Vec3::new(0.003 * i as f32, 1.1, 0.0);
        for corner in [Vec3::new(0.0, 3.0, 0.0), Vec3::new(3.0, 3.0, 0.0)] {
            let ray = FlattenedRay::free(o, corner - o, -1.0);
            assert!(tracer.intersect(&ray).is_some_and(|h| matches!(h.target, Target::Polygon(_))), "{o}");
        }
    }
}
