//! Agreement: SIMD with plain Rust, packets with single rays, all with a plain walk.

use super::*;
use crate::field::Sweep;
use crate::flattened::{Departure, FlattenedHit, Side};
use crate::rng::{Rng, Stage};
use crate::volume::{Lattice, Samples, Volume};
use crate::warp;
use glam::{DVec3, Vec3};

/// Smooth enough for long ways, with plateaus and a NaN.
fn field(dims: [usize; 3], levels: f64) -> Field {
    let lattice = Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap();
    let mut samples: Vec<f32> = (0..lattice.len())
        .map(|o| {
            let x = lattice.point(o);
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
    // Below and above one node of the top level along each axis, thin, and off the grid of blocks.
    let along = [([300, 30, 21], 40.0), ([21, 300, 30], 40.0), ([30, 21, 300], 40.0)];
    for (dims, levels) in [([70, 66, 67], 1e4), ([5, 4, 9], 7.0), ([2, 101, 33], 1e3)].into_iter().chain(along) {
        let field = field(dims, levels);
        let mut rng = Rng::stream(3, Stage::Test, dims[0] as u64);
        for capped in [false, true] {
            let pyramid = Pyramid::new(&field, capped);
            let others: Vec<Pyramid> = Isa::found().into_iter().map(|isa| pyramid.clone().with(isa)).collect();
            let mut hits = 0;
            for _ in 0..100_000 {
                let ray = ray(&field, &mut rng, levels);
                let reach = f64::from(ray.reach);
                let hit = pyramid.intersect(&field, &ray, reach);
                for other in &others {
                    assert_eq!(hit, other.intersect(&field, &ray, reach), "{:?}, {ray:?}", other.isa);
                    assert_eq!(hit.is_some(), other.occluded(&field, &ray, reach), "{:?}, {ray:?}", other.isa);
                }
                hits += u32::from(hit.is_some());
            }
            assert!((5_000..95_000).contains(&hits), "{hits} hits of {dims:?} test nothing");
        }
    }
}

/// Rays that enter Ω far from its first corner start between f32's numbers. A sheet across all of Ω stops them, also
/// those that cross lattice planes at a small angle just where they meet it, and where it is, wherever their reach
/// ends.
#[test]
fn rays_that_enter_along_planes_meet_the_sheet_in_their_way() {
    let across = |x: f64, z: f64| 1.3 * (0.7 * x).sin() + 0.9 * (0.5 * z + 0.3 * x).cos();
    for long in 0..3 {
        // Axes x, y, z of the sheet are those of the lattice from `long` on.
        let axis = |a: usize| (a + long) % 3;
        let turned = |v: [f64; 3]| {
            let mut out = DVec3::ZERO;
            (0..3).for_each(|a| out[axis(a)] = v[a]);
            out
        };
        let dims = turned([2000.0, 24.0, 8.0]).to_array().map(|n| n as usize);
        let lattice = Lattice::aligned(dims, DVec3::ZERO, DVec3::ONE).unwrap();
        let at = |o: usize| {
            let ijk = lattice.ijk(o).map(|i| i as f64);
            let [x, y, z] = [0, 1, 2].map(|a| ijk[axis(a)]);
            (y + across(x, z)) as f32
        };
        let samples = (0..lattice.len()).map(at).collect();
        let field = Field::made(lattice, Samples::F32(samples), 0.0, 20.0);
        let pyramid = Pyramid::new(&field, false);
        let mut rng = Rng::stream(8, Stage::Test, long as u64);
        for isa in Isa::found() {
            let pyramid = pyramid.clone().with(isa);
            for _ in 0..50_000 {
                let (x, z) = ((1000.0 + 990.0 * rng.unit()).floor(), 1.0 + 5.0 * rng.unit());
                let between = z - z.floor();
                let y = 9.0 - (1.0 - between) * across(x, z.floor()) - between * across(x, z.ceil());
                let slope = 10f64.powf(-5.0 + 3.0 * rng.unit()) * if rng.bits() & 1 == 0 { 1.0 } else { -1.0 };
                let (d, before) = ([slope, 1.0, 0.0], 100.0 + 2000.0 * rng.unit());
                let place = [x, y + 0.6 * rng.unit() - 0.3, z];
                let origin = turned([0, 1, 2].map(|a| place[a] - before * d[a]));
                let ray = FlattenedRay::free(origin.as_vec3(), turned(d).as_vec3(), 9.0 / 20.0);
                let case = || format!("{isa:?}, long axis {long}: {ray:?}");
                assert!(pyramid.occluded(&field, &ray, f64::INFINITY), "{}", case());
                let hit = pyramid.intersect(&field, &ray, f64::INFINITY);
                let Some(FlattenedHit { t, .. }) = hit else { panic!("no hit of {}", case()) };
                let value = field.value(ray.origin.as_dvec3() + f64::from(t) * ray.direction.as_dvec3());
                assert!((20.0 * value - 9.0).abs() < 1e-3, "{value} at {t}: {}", case());
                for beyond in [1e-3, 0.3, 3.0] {
                    let reach = f64::from(t) + beyond;
                    assert_eq!(pyramid.intersect(&field, &ray, reach), hit, "{}", case());
                    assert!(pyramid.occluded(&field, &ray, reach), "{}", case());
                }
            }
        }
    }
}

/// Embree asks with the reach that whatever it met first left over: a hit counts up to there and no farther, and is the
/// same wherever that is.
#[test]
fn where_the_reach_ends_does_not_move_a_hit() {
    // Long ways, and surfaces so curved that rays come back in the cell that they leave.
    let fields = [([70, 66, 67], 1e4), ([5, 4, 9], 7.0)];
    for ((dims, levels), capped) in fields.into_iter().flat_map(|field| [false, true].map(|capped| (field, capped))) {
        let field = field(dims, levels);
        let mut rng = Rng::stream(4, Stage::Test, dims[0] as u64);
        let pyramid = Pyramid::new(&field, capped);
        let mut hits = 0;
        for _ in 0..100_000 {
            let ray = FlattenedRay { reach: f32::INFINITY, ..ray(&field, &mut rng, levels) };
            let Some(hit) = pyramid.intersect(&field, &ray, f64::INFINITY) else { continue };
            let cell = 1.0 / ray.direction.length();
            for reach in [hit.t.next_up(), hit.t + 0.01 * cell, hit.t + 0.3 * cell] {
                let reach = f64::from(reach);
                assert_eq!(pyramid.intersect(&field, &ray, reach), Some(hit), "{reach}, {ray:?}");
                assert!(pyramid.occluded(&field, &ray, reach), "{reach}, {ray:?}");
            }
            let before = f64::from(hit.t) - f64::from(0.01 * cell + 1e-6 * hit.t);
            if before > 0.0 {
                assert_eq!(pyramid.intersect(&field, &ray, before), None, "{before}, {hit:?}, {ray:?}");
                assert!(!pyramid.occluded(&field, &ray, before), "{before}, {hit:?}, {ray:?}");
            }
            hits += 1;
        }
        assert!(hits > 5_000, "{hits}");
    }
}

/// A child too many would cost time only, so that no hit tells.
#[test]
fn every_instruction_set_finds_the_same_children() {
    let mut rng = Rng::stream(9, Stage::Test, 0);
    let mut sizes = [0u64; 65];
    for _ in 0..50_000 {
        let d = warp::sphere(rng.unit2()).as_vec3().extend(0.0);
        let backward = d.cmplt(Vec4::ZERO);
        let size = if rng.bits().is_multiple_of(2) { 1.0 } else { 4.0 };
        let base = Vec4::new(4.0, 8.0, 0.0, 0.0);
        let mut unit = || rng.unit() as f32;
        let o = base + size * (6.0 * Vec4::new(unit(), unit(), unit(), 0.5) - 1.0);
        let line = kernel::Line {
            // Some start on planes and edges.
            o: if rng.bits().is_multiple_of(3) { o.floor() } else { o },
            start: o,
            d,
            inv: 1.0 / d.with_w(1.0),
            far: Vec4::select(backward, Vec4::ZERO, Vec4::ONE),
            flip: (0..3).filter(|&a| backward.test(a)).fold(0, |flip, a| flip | 3 << (2 * a)),
            end: if rng.bits().is_multiple_of(4) { 20.0 * rng.unit() as f32 } else { f32::INFINITY },
            most_lo: 100 + (rng.bits() % 60) as u8,
            least_hi: 90 + (rng.bits() % 60) as u8,
        };
        let mut tile = Tile::EMPTY;
        for n in 0..64 {
            (tile.lo[n], tile.hi[n]) = ((rng.bits() % 200) as u8, 55 + (rng.bits() % 200) as u8);
        }
        let expected = Isa::PLAIN.children(&line, &tile, base, size);
        for isa in Isa::found() {
            assert_eq!(isa.children(&line, &tile, base, size), expected, "{isa:?}, {line:?}");
        }
        sizes[expected.count_ones() as usize] += 1;
    }
    assert!(sizes[2..].iter().sum::<u64>() > 5_000, "{sizes:?}");
}

/// Steps from node to node lead where the cell's numbers lead, on lattices of more than 2³² samples too.
#[test]
fn steps_lead_to_places() {
    for cells in [[2999, 2999, 2999], [255, 70, 13], [17, 3, 1]] {
        let dims = cells.map(|n| n + 1);
        let mut levels = Vec::new();
        let mut nodes = cells.map(|n: usize| n.div_ceil(4));
        while levels.len() < LEVELS {
            levels.push(Level { dims: nodes, tiles: Vec::new() });
            nodes = nodes.map(|n| n.div_ceil(4));
        }
        let all: Vec<Children> = (0..LEVELS).map(|level| children(dims, &levels, level)).collect();
        let mut rng = Rng::stream(12, Stage::Test, cells[0] as u64);
        for _ in 0..1000 {
            let cell = cells.map(|n| (rng.unit() * n as f64) as usize);
            // From the root that holds it, and from level to level its part.
            let mut here = place(dims, &levels, cell.map(|i| i >> 8 << 8));
            for level in (0..LEVELS).rev() {
                let [x, y, z] = cell.map(|i| i >> (2 * level) & 3);
                here = here.plus(&all[level].steps[x + 4 * y + 16 * z]);
                let [i, j, k] = cell.map(|i| i >> (2 * level));
                let expected = match level {
                    0 => (k * dims[1] + j) * dims[0] + i,
                    _ => levels[level - 1].at([i, j, k]),
                };
                assert_eq!(here.at[level], expected, "{cell:?}, level {level}");
            }
            assert_eq!(here.corner, Vec4::new(cell[0] as f32, cell[1] as f32, cell[2] as f32, 0.0));
        }
    }
}

/// Cells that are passed by hold nothing, wherever within its error the path lies; isovalues are close to what the path
/// meets.
#[test]
fn cells_are_passed_by_only_if_the_path_stays_on_one_side() {
    let mut rng = Rng::stream(10, Stage::Test, 0);
    let slack = 3e-4;
    let (mut passed, mut close) = (0, 0);
    for _ in 0..100_000 {
        let mut unit = || rng.unit();
        let (offset, range) = (unit() - 0.5, 10f64.powf(-4.0 * unit()));
        let corners: [f32; 8] = std::array::from_fn(|_| (offset + range * unit()) as f32);
        let ends = [0, 1].map(|_| Vec4::new(unit() as f32, unit() as f32, unit() as f32, 0.0));
        // Where it is indeed.
        let path = ends.map(|p| [0, 1, 2].map(|a| f64::from(p[a]) + f64::from(slack) / 6.0 * (2.0 * unit() - 1.0)));
        let h = |n: usize| {
            let mut s = corners.map(f64::from).to_vec();
            for a in 0..3 {
                let u = path[n >> a & 1][a];
                s = s.chunks_exact(2).map(|s| (1.0 - u) * s[0] + u * s[1]).collect();
            }
            s[0]
        };
        let along = [0, 1, 2, 3, 4, 5, 6, 7].map(h);
        let least = along.into_iter().fold(f64::INFINITY, f64::min);
        let most = along.into_iter().fold(f64::NEG_INFINITY, f64::max);
        let beside = range * f64::from(slack) * 10f64.powf(3.0 * unit() - 2.0) * if unit() < 0.5 { -1.0 } else { 1.0 };
        let c = if unit() < 0.5 { least - beside } else { most + beside } as f32;
        for isa in Isa::found() {
            if isa.clear(&corners, c, ends, slack) {
                let one_side = least > f64::from(c) || most < f64::from(c);
                assert!(one_side, "{isa:?}: {corners:?}, {ends:?}: {least} … {most} around {c}");
                passed += 1;
                close +=
                    u32::from((least - f64::from(c)).abs().min((most - f64::from(c)).abs()) < f64::from(slack) * range);
            }
        }
    }
    let found = Isa::found().len() - 1;
    assert!(passed >= 10_000 * found && close as usize >= 200 * found, "{passed}, {close}");
}

#[test]
fn packets_give_the_bits_of_single_rays() {
    for (dims, levels) in [([70, 66, 67], 1e4), ([300, 30, 21], 40.0), ([5, 4, 9], 7.0)] {
        let field = field(dims, levels);
        let mut rng = Rng::stream(5, Stage::Test, dims[0] as u64);
        for capped in [false, true] {
            for pyramid in Isa::found().into_iter().map(|isa| Pyramid::new(&field, capped).with(isa)) {
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
fn ranks_are_monotone_clamp_and_serve_flat_parts() {
    // Nine samples of ten in a hundredth of the sweep.
    let mut rng = Rng::stream(6, Stage::Test, 0);
    let samples: Vec<f32> =
        (0..200_000).map(|i| (if i % 10 == 0 { rng.unit() } else { 0.5 + 0.01 * rng.unit() }) as f32).collect();
    let ranks = Ranks::new(&samples);
    assert_eq!([f32::NAN, f32::NEG_INFINITY, -1.0, -0.25].map(|s| ranks.of(s)), [0; 4]);
    assert_eq!([1.25, 2.0, f32::INFINITY].map(|s| ranks.of(s)), [255; 3]);
    // Just outside the sweep, too, blocks are told apart.
    assert!(ranks.of(-0.1) > ranks.of(-0.2) && ranks.of(1.2) > ranks.of(1.1));
    let values = (0..=1_500_000u32).map(|i| ranks.of(i as f32 * 1e-6 - 0.25));
    assert!(values.clone().zip(values.skip(1)).all(|(a, b)| a <= b));
    let steps = |a: f32, b: f32| ranks.of(b) - ranks.of(a);
    assert!(steps(0.5, 0.51) > 100 && steps(0.0, 0.5) > 60, "{} {}", steps(0.5, 0.51), steps(0.0, 0.5));
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

/// Samples without any order: `levels` of them, from `low` on.
fn noise(levels: u64, low: f64) -> Field {
    let lattice = Lattice::aligned([33, 34, 35], DVec3::ZERO, DVec3::ONE).unwrap();
    let mut rng = Rng::stream(8, Stage::Test, levels);
    let samples = (0..lattice.len()).map(|_| low + (rng.bits() % levels) as f64).collect();
    let volume = Volume::new("noise", lattice, Samples::F64(samples)).unwrap();
    Field::new(&volume, Sweep::new(low, low + (levels - 1) as f64).unwrap()).unwrap()
}

/// Rays out of `count` whose first hit is not that of [`plain_walk`], and rays that hit.
fn wrong_hits(field: &Field, count: u64) -> (u64, u64) {
    let pyramid = Pyramid::new(field, false);
    let judge = |index: u64| {
        let mut rng = Rng::stream(4, Stage::Test, index);
        let mut ray = ray(field, &mut rng, 1e4);
        (ray.departure, ray.reach) = (Departure::Free, f32::INFINITY);
        ray.isovalue = rng.unit() as f32;
        let expected = plain_walk(field, &ray);
        let hit = pyramid.intersect(field, &ray, f64::INFINITY).map(|h| f64::from(h.t));
        let wrong = match (hit, expected) {
            (Some(t), Some(expected)) => (t - expected).abs() > 1e-6 * expected.max(1.0),
            (hit, expected) => hit.is_some() != expected.is_some(),
        };
        (u64::from(wrong), u64::from(hit.is_some()))
    };
    (0..count).into_par_iter().map(judge).reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1))
}

/// Smooth, also with several nodes of the top level, noise, plateaus of four levels, and a range that is a hundred
/// thousandth of its place.
fn hard_fields() -> [Field; 5] {
    [field([70, 66, 67], 1e4), field([21, 300, 300], 1e4), noise(255, 0.0), noise(4, 0.0), noise(255, 2.55e7)]
}

#[test]
fn first_hits_are_those_of_a_plain_walk_in_f64() {
    for (n, field) in hard_fields().iter().enumerate() {
        let (wrong, hits) = wrong_hits(field, 36_000);
        assert!(wrong == 0 && hits > 6_000, "field {n}: {wrong} of {hits} hits are wrong");
    }
}

/// What docs/performance.md promises; minutes: `cargo test --release --lib ten_million -- --ignored --nocapture`.
#[test]
#[ignore = "minutes"]
fn of_ten_million_first_hits_at_most_one_is_wrong() {
    let (mut wrong, mut hits) = (0, 0);
    for field in &hard_fields() {
        let found = wrong_hits(field, 2_500_000);
        println!("{} of {} hits are wrong", found.0, found.1);
        (wrong, hits) = (wrong + found.0, hits + found.1);
    }
    assert!(wrong <= 1, "{wrong} of {hits} hits among more than 10⁷ rays");
}
