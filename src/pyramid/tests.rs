//! Agreement: SIMD with plain Rust, packets with single rays, all with a plain walk.

use super::*;
use crate::field::Sweep;
use crate::flattened::{Departure, Side};
use crate::rng::{Rng, Stage};
use crate::volume::{Lattice, Samples, Volume};
use crate::warp;
use glam::{DVec3, Vec3};

/// Smooth enough for long ways, with plateaus and a NaN.
fn field(dims: [usize; 3], levels: f64) -> Field {
    let lattice = Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap();
    let mut samples: Vec<f32> = (0..lattice.len())
        .map(|o| {
            let x = DVec3::from_array(lattice.ijk(o).map(|i| i as f64));
            let wave = (0.31 * x.x).sin() + (0.23 * x.y + 0.1 * x.z).cos() + (0.17 * x.z).sin();
            ((wave / 6.0 + 0.5) * levels).round() as f32
        })
        .collect();
    samples[lattice.offset(dims[0] / 2, 1, 1)] = f32::NAN;
    let volume = Volume::new("waves", lattice, Samples::F32(samples)).unwrap();
    Field::new(&volume, Sweep::new(0.0, levels).unwrap()).unwrap()
}

/// From inside, outside and the surface, on planes and along them.
fn ray(field: &Field, rng: &mut Rng, levels: f64) -> FlattenedRay {
    let far = field.lattice().far();
    let mut p = (DVec3::new(rng.unit(), rng.unit(), rng.unit()) * 1.4 - 0.2) * far;
    let mut d = warp::sphere(rng.unit2()) * 10f64.powf(4.0 * rng.unit() - 2.0);
    for a in 0..3 {
        match rng.bits() % 12 {
            0 => p[a] = p[a].round(),
            1 => d[a] = 0.0,
            2 => (p[a], d[a]) = (p[a].round(), 0.01),
            3 => d[a] = 1.0f64.copysign(d[a]),
            _ => {}
        }
    }
    let within = (0..3).all(|a| p[a] >= 0.0 && p[a] <= far[a]);
    let on = within && rng.bits().is_multiple_of(2);
    let c = if rng.bits().is_multiple_of(2) { (rng.unit() * levels).round() / levels } else { rng.unit() };
    let mut ray = FlattenedRay::free(p.as_vec3(), d.as_vec3(), c as f32);
    if on {
        ray.departure = Departure::Surface(if rng.bits().is_multiple_of(2) { Side::Lower } else { Side::Higher });
    }
    if ray.direction == Vec3::ZERO {
        ray.direction = Vec3::Z;
    }
    if rng.bits().is_multiple_of(4) {
        ray.reach = (30.0 * rng.unit()) as f32 / ray.direction.length();
    }
    ray
}

#[test]
fn with_and_without_simd_hits_are_the_same_bits() {
    // Below and above one node of the top level, thin, and off the grid of blocks.
    for (dims, levels) in [([70, 66, 67], 1e4), ([5, 4, 9], 7.0), ([300, 30, 21], 40.0), ([2, 101, 33], 1e3)] {
        let field = field(dims, levels);
        let mut rng = Rng::stream(3, Stage::Test, dims[0] as u64);
        for capped in [false, true] {
            let wide = Pyramid::new(&field, capped);
            let scalar = wide.clone().scalar();
            let mut hits = 0;
            for _ in 0..100_000 {
                let ray = ray(&field, &mut rng, levels);
                let hit = wide.intersect(&field, &ray, f64::from(ray.reach));
                assert_eq!(hit, scalar.intersect(&field, &ray, f64::from(ray.reach)), "{ray:?}");
                assert_eq!(hit.is_some(), wide.occluded(&field, &ray, f64::from(ray.reach)), "{ray:?}");
                hits += u32::from(hit.is_some());
            }
            assert!((5_000..95_000).contains(&hits), "{hits} hits of {dims:?} test nothing");
        }
    }
}

#[test]
fn packets_give_the_bits_of_single_rays() {
    for (dims, levels) in [([70, 66, 67], 1e4), ([300, 30, 21], 40.0), ([5, 4, 9], 7.0)] {
        let field = field(dims, levels);
        let mut rng = Rng::stream(5, Stage::Test, dims[0] as u64);
        for capped in [false, true] {
            let wide = Pyramid::new(&field, capped);
            for pyramid in [wide.clone().scalar(), wide] {
                for _ in 0..3_000 {
                    let rays: [FlattenedRay; 16] = std::array::from_fn(|_| ray(&field, &mut rng, levels));
                    let active = rng.bits() as u16 | rng.bits() as u16;
                    let mut hits = [None; 16];
                    pyramid.intersect16(&field, active, |n| rays[n], &mut hits);
                    let blocked = pyramid.occluded16(&field, active, |n| rays[n]);
                    for n in 0..16 {
                        let on = active >> n & 1 == 1;
                        let expected = pyramid.intersect(&field, &rays[n], f64::from(rays[n].reach));
                        assert_eq!(hits[n], expected.filter(|_| on), "{:?}", rays[n]);
                        assert_eq!(blocked >> n & 1 == 1, hits[n].is_some(), "{:?}", rays[n]);
                    }
                }
            }
        }
    }
}

#[test]
fn quantisation_is_monotone_and_clamps() {
    assert_eq!(
        [f32::NAN, f32::NEG_INFINITY, -1.0, 0.0, 1.0, 2.0, f32::INFINITY].map(quantise),
        [0, 0, 0, 0, 65535, 65535, 65535]
    );
    let values = (0..=1_000_000u32).map(|i| quantise(i as f32 * 1e-6));
    assert!(values.clone().zip(values.skip(1)).all(|(a, b)| a <= b && b - a <= 1));
}

/// Crosses every plane, looks at every cell.
fn plain_walk(field: &Field, ray: &FlattenedRay) -> Option<f64> {
    let (o, d) = (ray.origin.as_dvec3(), ray.direction.as_dvec3());
    let far = field.lattice().far();
    let mut times: Vec<f64> = (0..3)
        .flat_map(|a| (0..=far[a] as usize).map(move |k| (k as f64 - o[a]) / d[a]))
        .filter(|t| t.is_finite() && *t > 0.0)
        .collect();
    times.push(0.0);
    times.sort_by(f64::total_cmp);
    for pair in times.windows(2).filter(|pair| pair[1] > pair[0]) {
        let middle = o + d * (0.5 * (pair[0] + pair[1]));
        if !(middle.cmpge(DVec3::ZERO).all() && middle.cmple(far).all()) {
            continue;
        }
        let (cell, _) = field.locate(middle);
        let corners = crate::cell::Cell { s: field.corners(cell) };
        if corners.s.iter().any(|s| s.is_nan()) {
            continue;
        }
        let base = DVec3::from_array(cell.map(|i| i as f64));
        let cubic = corners.cubic(f64::from(ray.isovalue), o + d * pair[0] - base, d);
        let span = pair[1] - pair[0];
        if let Some(t) = cubic.first_crossing(span, cubic.value(0.0) >= 0.0, cubic.value(span) >= 0.0) {
            return Some(pair[0] + t);
        }
    }
    None
}

#[test]
fn first_hits_are_those_of_a_plain_walk_in_f64() {
    let field = field([70, 66, 67], 1e4);
    let pyramid = Pyramid::new(&field, false);
    let mut rng = Rng::stream(4, Stage::Test, 0);
    let (mut wrong, mut hits) = (0, 0);
    for _ in 0..50_000 {
        let mut ray = ray(&field, &mut rng, 1e4);
        (ray.departure, ray.reach) = (Departure::Free, f32::INFINITY);
        ray.isovalue = rng.unit() as f32;
        let expected = plain_walk(&field, &ray);
        let hit = pyramid.intersect(&field, &ray, f64::INFINITY).map(|h| f64::from(h.t));
        hits += u32::from(hit.is_some());
        wrong += u32::from(match (hit, expected) {
            (Some(t), Some(expected)) => (t - expected).abs() > 1e-6 * expected.max(1.0),
            (hit, expected) => hit.is_some() != expected.is_some(),
        });
    }
    assert_eq!(wrong, 0, "of {hits}");
    assert!(hits > 10_000);
}
