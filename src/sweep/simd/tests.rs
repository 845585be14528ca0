use super::*;
use crate::field::Field;
use crate::isovalue_axis::IsovalueAxis;
use crate::rng::{Rng, Stage};
use crate::sweep::clearance::tests::specks;
use crate::sweep::grid::Geometry;
use crate::sweep::half::Half4;
use crate::sweep::half::{decode, encode};
use crate::sweep::pack::{ASLEEP, LANES, OUTSIDE};
use crate::volume::{Lattice, Samples};
use glam::DVec3;

/// A pack of noise with plateaus, gaps, rows that were not read, ends outside and cuts.
fn noise(seed: u64) -> Pack {
    let mut rng = Rng::stream(seed, Stage::Test, 0);
    let rows = 50;
    let mut pack = Pack::with_rows(rows);
    for row in 0..rows {
        if row % 11 != 7 {
            pack.awake.push(row as u32);
        }
        for lane in 0..LANES {
            let x = (rng.unit() * 12.0).floor() as f32 / 12.0;
            let out = row < lane % 5 || row + lane % 3 >= rows;
            let kind = rng.unit();
            pack.h[row][lane] = if out || kind < 0.03 {
                OUTSIDE
            } else if row % 11 == 7 {
                ASLEEP
            } else {
                x
            };
            pack.node[row][lane] = (rng.unit() * 30.0) as u32;
        }
    }
    pack.lasts = std::array::from_fn(|_| std::array::from_fn(|_| (rng.unit() * 17.0) as u32));
    pack.cuts = (0..2)
        .map(|i| crate::sweep::pack::Cut { row: 17 + i, lane: 3, places: [3 + 2 * i as u32, 4 + 2 * i as u32] })
        .collect();
    pack
}

/// Numbers for thirty nodes, or five ends over four isovalues and more.
fn random(seed: u64) -> Vec<Half4> {
    let mut rng = Rng::stream(seed, Stage::Test, 0);
    (0..30).map(|_| std::array::from_fn(|_| encode(rng.unit() as f32))).collect()
}

#[test]
fn every_instruction_set_scans_to_the_same_bits() {
    for seed in 0..20 {
        for rule in 0..4 {
            let rule = ScanRule { strict: rule & 2 == 2, sign: if rule & 1 == 1 { 1.0 } else { -1.0 }, capped: false };
            let scan = |isa: Isa| {
                let mut out = vec![vec![0f32; 48 * LANES]; 3];
                let axis = IsovalueAxis::around([0.5, 0.02, 0.9][seed as usize % 3]);
                let light =
                    Light { b: &random(9), back: &[], flats: &random(10), isovalues: 4, axis: &axis, across: 0 };
                isa.scan(&mut noise(seed), rule, light, &mut out, (LANES, 0));
                out.iter().flatten().map(|x| x.to_bits()).collect::<Vec<_>>()
            };
            for isa in Isa::found() {
                assert_eq!(scan(Isa::PLAIN), scan(isa), "{rule:?}, {isa:?}");
            }
        }
    }
}

#[test]
fn every_instruction_set_marches_to_the_same_bits() {
    let mut rng = Rng::stream(5, Stage::Test, 0);
    for count in [1, 7, 8, 9, 15, 16, 17, 98, 99, 100] {
        let mut row: Vec<f32> = (0..40).map(|_| rng.unit() as f32).collect();
        row[13] = f32::NAN;
        let mut start: Vec<f32> = (0..count).map(|_| rng.unit() as f32).collect();
        // As great as the extrema, which only the higher side sees.
        if count == 15 {
            row.fill(0.5);
            start.fill(0.5);
        }
        // Places in the row, and beyond all integers.
        let places = match count {
            98 => [-0.3, 2.3],
            100 => [3e9, 1e30],
            _ => [-0.3, 0.371],
        };
        let run = |isa: Isa| {
            let (mut most, mut least, mut out) = (start.clone(), start.clone(), vec![9u8; count]);
            isa.march(&row, places, [&mut most, &mut least], &mut out, 24);
            (most.iter().chain(&least).map(|x| x.to_bits()).collect::<Vec<_>>(), out)
        };
        for isa in Isa::found() {
            assert_eq!(run(Isa::PLAIN), run(isa), "{count} lines, {isa:?}");
        }
    }
}

#[test]
fn every_instruction_set_finds_the_same_extrema() {
    let mut rng = Rng::stream(6, Stage::Test, 0);
    let lattice = Lattice::aligned([9, 14, 11], DVec3::ZERO, DVec3::ONE).unwrap();
    let mut samples: Vec<f64> = (0..lattice.len()).map(|_| rng.unit()).collect();
    samples[700] = f64::NAN;
    let field = Field::made(lattice, Samples::F64(samples), 0.0, 1.0);
    for _ in 0..200 {
        let mut segments = Segments::NONE;
        // Partly outside, and from nodes until enough is found; the last lanes stay empty.
        let mut point = |size: f64| DVec3::new(rng.unit(), rng.unit(), rng.unit()) * size;
        let h = |p: DVec3| field.value(p) as f32;
        (0..7).for_each(|lane| segments.set(lane, field.lattice(), h, point(20.0) - 4.0, point(20.0) - 4.0));
        for lane in 7..13 {
            let enough = point(1.0);
            let enough = [0.2 * enough.x as f32, 1.0 - 0.2 * enough.y as f32];
            let ends = [point(20.0) - 4.0, point(8.0).round()];
            segments.set_before(lane, field.lattice(), h, ends, enough);
        }
        let run = |isa: Isa| {
            let mut segments = segments.clone();
            isa.extrema(field.samples(), &mut segments, None);
            [segments.least, segments.most].map(|x| x.map(f32::to_bits))
        };
        for isa in Isa::found() {
            assert_eq!(run(Isa::PLAIN), run(isa), "{isa:?}");
        }
    }
}

/// Through a few specks: with clearances segments find what they find without, of what reaches the sweep.
#[test]
fn segments_step_over_what_is_below_the_sweep() {
    let mut rng = Rng::stream(7, Stage::Test, 0);
    let (mut found, mut lanes) = (0, 0);
    for (dims, share) in [([41, 30, 35], 5e-4), ([29, 33, 26], 5e-3), ([7, 40, 9], 0.1)] {
        let field = specks(dims, 8, share);
        let clearance = Clearance::new(&Geometry::new(&field));
        let far = field.lattice().far();
        for round in 0..200 {
            let mut segments = Segments::NONE;
            // Along diagonals, too, where places in slices are as far apart as slices.
            let along = DVec3::from_array([0, 1, 2].map(|a| if round >> a & 1 == 0 { 1.0 } else { -1.0 }));
            for lane in 0..LANES {
                let mut point = || DVec3::new(rng.unit(), rng.unit(), rng.unit()) * (far + 8.0) - 4.0;
                let (a, b) = (point(), point());
                let b = if lane % 4 == 0 { a.round() + 40.0 * along } else { b };
                let a = if lane % 4 == 0 { a.round() } else { a };
                segments.set(lane, field.lattice(), |p| field.value(p) as f32, a, b);
            }
            let run = |isa: Isa, clearance: Option<&Clearance>| {
                let mut segments = segments.clone();
                isa.extrema(field.samples(), &mut segments, clearance);
                segments.most
            };
            let all = run(Isa::PLAIN, None);
            for isa in Isa::found() {
                let stepping = run(isa, Some(&clearance));
                assert_eq!(stepping.map(|h| h.max(0.0)), all.map(|h| h.max(0.0)), "{isa:?}, {dims:?}");
                assert_eq!(stepping.map(f32::to_bits), run(Isa::PLAIN, Some(&clearance)).map(f32::to_bits), "{isa:?}");
            }
            found += all.iter().filter(|h| **h > 0.0).count();
            lanes += LANES;
        }
    }
    assert!(found > lanes / 20 && found < lanes / 2, "{found} of {lanes}");
}

#[test]
fn scans_find_the_next_greater_value() {
    // Against looking at every later sample: [BSV93] is only a faster way to do that.
    let mut pack = noise(7);
    pack.cuts.clear();
    let reference = noise(7);
    let mut out = vec![vec![0f32; 48 * LANES]; 3];
    let b = random(9);
    let axis = IsovalueAxis::EVEN;
    let light = Light { b: &b, back: &[], flats: &random(10), isovalues: 4, axis: &axis, across: 0 };
    Isa::current().scan(&mut pack, ScanRule { strict: false, sign: 1.0, capped: false }, light, &mut out, (LANES, 0));
    let mut found = [0; 2];
    let h = |row: usize, lane: usize| reference.h[row][lane];
    for lane in 0..LANES {
        for row in (1..49).filter(|r| r % 11 != 7) {
            let value = h(row, lane);
            let forward = h((row + 1).min(48), lane) < h((row - 1).max(1), lane);
            // Gaps are ends.
            let met = |r: &usize| h(*r, lane) >= value || h(*r, lane) == OUTSIDE;
            let next = if forward { (row + 1..50).find(met) } else { (0..row).rev().find(met) };
            if let (true, Some(r)) = (value != OUTSIDE, next.filter(|&r| h(r, lane) != OUTSIDE)) {
                let before = if forward { r - 1 } else { r + 1 };
                let h0 = h(before, lane);
                let first = (value - h0) < 0.5 * (h(r, lane) - h0);
                let node = reference.node[if first { before } else { r }][lane];
                let expected = decode(b[node as usize][1]);
                assert_eq!(out[1][(row - 1) * LANES + lane], expected, "lane {lane} row {row}");
                found[usize::from(forward)] += 1;
            }
        }
    }
    assert!(found[0] > 200 && found[1] > 200, "{found:?}");
}
