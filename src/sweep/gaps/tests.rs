use super::*;
use crate::isa::Isa;
use crate::isovalue_axis::IsovalueAxis;
use crate::rng::{Rng, Stage};
use crate::sweep::fans::{SAMPLED, march_row};
use crate::sweep::half::{Half4, decode, encode};
use crate::sweep::pack::Cut;

/// Samples of a line: small numbers, so that many are as great as others, and gaps.
fn line(rng: &mut Rng, gaps: f64) -> Vec<f32> {
    let step = |rng: &mut Rng| if rng.unit() < gaps { OUTSIDE } else { (rng.unit() * 9.0).floor() as f32 };
    (0..40).map(|_| step(rng)).collect()
}

/// Where the ray of isovalue `value` that comes to `samples` from a gap meets a level set: between two samples that
/// are on different sides, with no gap between.
fn crossing(samples: &[f32], value: f32) -> Option<(usize, bool)> {
    let at = (1..samples.len()).find(|&i| {
        let [a, b] = [samples[i - 1], samples[i]];
        a != OUTSIDE && b != OUTSIDE && (a >= value) != (b >= value)
    })?;
    Some((at, samples[at] >= value))
}

#[test]
fn rays_meet_level_sets_between_samples_without_a_gap() {
    let mut rng = Rng::stream(1, Stage::Test, 0);
    let mut met = [0; 2];
    for _ in 0..2000 {
        let (samples, value) = (line(&mut rng, 0.2), (rng.unit() * 9.0) as f32);
        let mut ray = Crossing::new(value, false);
        let found = samples.iter().enumerate().find_map(|(row, h)| ray.step(row, *h));
        let expected = crossing(&samples, value).map(|(at, front)| {
            let nearer = (value - samples[at - 1]).abs() < 0.5 * (samples[at] - samples[at - 1]).abs();
            met[usize::from(front)] += 1;
            (if nearer { at - 1 } else { at }, front)
        });
        assert_eq!(found, expected, "{value} in {samples:?}");
    }
    assert!(met[0] > 300 && met[1] > 300, "{met:?}");
}

/// Scans through gaps against looking at every sample of a line, both ways and on both sides, with cuts.
#[test]
fn what_lies_beyond_a_gap_is_seen() {
    const ROWS: usize = 42;
    let number = |i: usize| encode(1.0 + i as f32 / 256.0);
    let [front, back] = [0, 1000].map(|first| (0..ROWS).map(|i| [number(first + i); 4]).collect::<Vec<_>>());
    let flats: Vec<Half4> = (0..64).map(|i| [number(2000 + 4 * (i / 4)); 4]).collect();
    let mut counts = [0; 5];
    for seed in 0..60 {
        let mut rng = Rng::stream(seed, Stage::Test, 1);
        let mut pack = Pack::with_rows(ROWS);
        pack.read_all();
        for lane in 0..LANES {
            for (row, h) in line(&mut rng, 0.1).into_iter().enumerate() {
                // The first and the last row are outside Ω.
                pack.h[row + 1][lane] = if h == OUTSIDE { f32::NAN } else { h };
            }
        }
        (0..ROWS).for_each(|row| pack.node[row] = [row as u32; LANES]);
        pack.lasts = [[4; LANES], [8; LANES]];
        pack.spans = [[0.0; LANES], [(ROWS - 3) as f64; LANES]];
        pack.cuts = vec![Cut { row: 14, lane: 3, places: [12, 16] }, Cut { row: 27, lane: 3, places: [20, 24] }];
        pack.open_gaps();
        let rule = ScanRule { strict: seed % 2 == 1, sign: 1.0, capped: seed % 4 == 2 };
        let light = Light { b: &front, back: &back, flats: &flats, isovalues: 4, axis: &IsovalueAxis::EVEN, across: 0 };
        let mut out = vec![vec![0f32; (ROWS - 2) * LANES]; 3];
        pack.scan(rule, light, &mut out, (LANES, 0));
        let mut missing = [0; ROWS - 2];
        Isa::current().look_through_gaps(&mut pack, rule, light, &mut out, &mut missing, (LANES, 0));
        for (slice, missing) in missing.iter().enumerate() {
            let there = |lane: usize| missing >> lane & 1 == 0;
            assert!((0..LANES).all(|lane| there(lane) == (pack.h[slice + 1][lane] != OUTSIDE)), "slice {slice}");
        }
        for lane in 0..LANES {
            for row in 1..ROWS - 1 {
                let h = |row: usize| pack.h[row][lane];
                let value = h(row);
                if value == OUTSIDE {
                    continue;
                }
                let beside = |row: usize| if h(row) == OUTSIDE { value } else { h(row) };
                // Beyond the first and the last slice the sample itself stands for what is missing.
                let forward = beside((row + 1).min(ROWS - 2)) < beside((row - 1).max(1));
                let above = |row: usize| if rule.strict { h(row) > value } else { h(row) >= value };
                let rest: Vec<usize> = if forward { (row..ROWS).collect() } else { (0..=row).rev().collect() };
                let mut expected = flats[if forward { 4 } else { 8 }];
                let (mut gone, mut returned) = (false, false);
                for step in rest.windows(2) {
                    let (from, to) = (step[0], step[1]);
                    if lane == 3
                        && let Some(n) = [14, 27].iter().position(|&cut| cut == from.min(to))
                    {
                        expected = flats[12 + 8 * n + if forward { 0 } else { 4 }];
                        counts[3] += usize::from(gone);
                        break;
                    }
                    returned |= gone && h(to) != OUTSIDE;
                    gone |= h(to) == OUTSIDE;
                    // The ray leaves its own sample from outside the solid.
                    let from_above = from != row && above(from);
                    if h(from) != OUTSIDE && h(to) != OUTSIDE && above(to) != from_above {
                        let nearer = (value - h(from)).abs() < 0.5 * (h(to) - h(from)).abs();
                        let node = if nearer { from } else { to };
                        expected = if above(to) { front[node] } else { back[node] };
                        counts[usize::from(!above(to))] += usize::from(gone);
                        break;
                    }
                    if to == 0 || to == ROWS - 1 {
                        counts[2] += usize::from(gone);
                        if rule.capped && returned && h(from) != OUTSIDE && above(from) {
                            expected = [encode(0.0); 4];
                            counts[4] += 1;
                        }
                    }
                }
                let found = out[1][(row - 1) * LANES + lane];
                assert_eq!(found, decode(expected[0]), "seed {seed} lane {lane} row {row}");
            }
        }
    }
    assert!(counts.iter().all(|n| *n > 100), "{counts:?}");
}

/// Lines from a source through a slice after slice, against the ranges from gap to gap.
#[test]
fn what_lines_see_beyond_a_gap_is_what_no_range_before_hides() {
    let mut rng = Rng::stream(2, Stage::Test, 0);
    let mut seen = [0; 3];
    for _ in 0..300 {
        let lines: [Vec<f32>; 3] = std::array::from_fn(|_| line(&mut rng, 0.2));
        let (mut most, mut least) = (vec![f32::NEG_INFINITY; 3], vec![f32::INFINITY; 3]);
        let mut hidden = HiddenRanges::default();
        hidden.clear(3);
        for k in 0..lines[0].len() {
            let row: Vec<f32> =
                lines.iter().map(|l| if l[k] == OUTSIDE { f32::NAN } else { l[k] }).chain([0.0]).collect();
            // Lines at samples: what is beside them weighs nothing, but is not a number either.
            let row: Vec<f32> = row.iter().flat_map(|h| [*h, *h]).collect();
            let mut out = [0; 3];
            march_row(&row, [0.0, 2.0], 0, [&mut most, &mut least], &mut out, 0);
            hidden.look(&row, [0.0, 2.0], 0, [&mut most, &mut least], &mut out);
            for (line, out) in lines.iter().zip(out) {
                let h = line[k];
                if h == OUTSIDE {
                    assert_eq!(out, 0);
                    continue;
                }
                let parts: Vec<&[f32]> = line[..=k].split(|h| *h == OUTSIDE).collect();
                let (own, before) = parts.split_last().unwrap();
                let hidden = before.iter().any(|part| {
                    let above = |x: &f32| *x >= h;
                    !part.iter().all(above) && part.iter().any(above)
                });
                let own = &own[..own.len() - 1];
                let lower = !hidden && own.iter().all(|x| *x < h);
                let higher = !hidden && own.iter().all(|x| *x >= h);
                assert_eq!(out, SAMPLED + u8::from(lower) * LOWER + u8::from(higher) * HIGHER, "{line:?} at {k}");
                if before.len() > 1 {
                    seen[usize::from(lower) + usize::from(higher)] += 1;
                }
            }
        }
    }
    assert!(seen.iter().all(|n| *n > 300), "{seen:?}");
}

#[test]
fn rims_are_the_lit_nodes_that_share_a_cell_with_a_gap() {
    let (dims, mut rng) = ([13, 7, 9], Rng::stream(3, Stage::Test, 0));
    let [nx, ny, nz] = dims;
    let h: Vec<f32> = (0..nx * ny * nz).map(|_| if rng.unit() < 0.02 { f32::NAN } else { 0.5 }).collect();
    let lit = |at: usize| !h[at].is_nan() && !at.is_multiple_of(5);
    let [along, across] = Rims::both(dims, &h, lit);
    let mut count = 0;
    for (x, y, z) in (0..nz).flat_map(|z| (0..ny).flat_map(move |y| (0..nx).map(move |x| (x, y, z)))) {
        let at = (z * ny + y) * nx + x;
        let near = crate::neighbourhood::neighbourhood(dims, at).flatten().any(|at| h[at].is_nan());
        let expected: &[u32] = if lit(at) && near { &[1] } else { &[] };
        assert_eq!(along.within(z * ny + y, x, x + 1).len(), expected.len(), "{x} {y} {z}");
        assert_eq!(across.within(x * nz + z, y, y + 1).len(), expected.len(), "{x} {y} {z}");
        count += expected.len();
    }
    assert!(count > 100 && along.within(3, 0, nx).is_sorted());
}

/// Light that is linear across lines is so at nodes, and goes on as it is where lines are missing.
#[test]
fn lines_with_samples_stand_for_those_without() {
    let light: [Vec<f32>; 2] = [0.0, 1.0].map(|row| (0..48).map(|line| 5.0 - line as f32 + 10.0 * row).collect());
    let light = [&light[0][..], &light[1][..]];
    let (whole, f) = ([0; 3], [0.25, 0.75]);
    for i in 0..20 {
        let around = FourLines::new((i, 20), 9, f, true);
        // Line 9 + i lies by 0.25 before node i, and so does row 0 by 0.75 behind the other.
        let expected = 5.0 - (9.0 + i as f32 - 0.25) + 7.5;
        assert!((around.mean(light, [&whole, &whole]) - expected).abs() < 1e-5, "{i}");
        let line = 9 + i;
        let mut gaps = [0u16; 3];
        gaps[line / LANES] = 1 << (line % LANES);
        if i > 0 && i < 19 {
            let three = around.mean(light, [&gaps, &whole]);
            let weights = [0.0625, 0.5625, 0.1875];
            let sum = weights[0] * light[0][line - 1] + weights[1] * light[1][line] + weights[2] * light[1][line - 1];
            assert!((three - sum / weights.iter().sum::<f32>()).abs() < 1e-5, "{i}");
        }
        assert_eq!(around.mean(light, [&[u16::MAX; 3], &[u16::MAX; 3]]), 0.0);
    }
}
