//! Samples that are not finite. The cells around them hold no surface: lines run through such gaps as they do outside
//! of Ω, and level sets end at their rims. A ray that comes out of a gap may do so inside the solid of its isovalue,
//! which it then sees from within.

use super::faces::lines_around;
use super::fans::{HIGHER, LOWER, sample};
use super::grid::ring;
use super::half::colour;
use super::pack::{LANES, OUTSIDE, Pack};
use super::scan::{Light, ScanRule};

/// Nodes beside gaps that are lit, by rows of memory.
pub(super) struct Rims {
    /// Where each row's nodes begin, and where the last one's end.
    starts: Vec<u32>,
    /// Places in their rows, in rising order.
    nodes: Vec<u32>,
}

impl Rims {
    /// Those of lit nodes of a lattice, in x, y, z order and in y, z, x order.
    #[allow(clippy::cast_possible_truncation, reason = "nodes are numbered in 32 bits")]
    pub(super) fn both([nx, ny, nz]: [usize; 3], h: &[f32], lit: impl Fn(usize) -> bool) -> [Self; 2] {
        let gaps: Vec<bool> = h.iter().map(|h| h.is_nan()).collect();
        let rims: Vec<u32> = ring([nx, ny, nz], &gaps).into_iter().filter(|&at| lit(at as usize)).collect();
        let mut turned: Vec<u32> = rims
            .iter()
            .map(|&at| {
                let (x, y, z) = (at as usize % nx, at as usize / nx % ny, at as usize / (nx * ny));
                ((x * nz + z) * ny + y) as u32
            })
            .collect();
        turned.sort_unstable();
        [Self::new(nx, ny * nz, &rims), Self::new(ny, nx * nz, &turned)]
    }

    #[allow(clippy::cast_possible_truncation, reason = "nodes are numbered in 32 bits")]
    fn new(nu: usize, rows: usize, places: &[u32]) -> Self {
        let start = |row: usize| places.partition_point(|&at| (at as usize) < row * nu) as u32;
        Self { starts: (0..=rows).map(start).collect(), nodes: places.iter().map(|at| at % nu as u32).collect() }
    }

    /// The places in `row` that lie in from..to.
    #[inline]
    pub(super) fn within(&self, row: usize, from: usize, to: usize) -> &[u32] {
        let nodes = &self.nodes[self.starts[row] as usize..self.starts[row + 1] as usize];
        let place = |x: usize| nodes.partition_point(|&at| (at as usize) < x);
        &nodes[place(from)..place(to)]
    }
}

/// Isovalues that level sets before gaps hide from the source of a fan, for each line of a row.
#[derive(Default)]
pub(super) struct HiddenRanges {
    /// What h spans from one gap to the next.
    ranges: Vec<Vec<[f32; 2]>>,
}

impl HiddenRanges {
    /// Nothing, from so many lines.
    pub(super) fn clear(&mut self, lines: usize) {
        self.ranges.iter_mut().for_each(Vec::clear);
        self.ranges.resize_with(lines, Vec::new);
    }

    /// What [`super::fans::march_row`] does not know of lines from number `first` on, of whose slice it has the same
    /// arguments: at a gap extrema begin anew, and beyond it what was hidden before stays so.
    pub(super) fn look(
        &mut self,
        row: &[f32],
        place: [f32; 2],
        first: usize,
        [most, least]: [&mut [f32]; 2],
        out: &mut [u8],
    ) {
        let lines = self.ranges[first..].iter_mut().zip(most).zip(least).zip(out).enumerate();
        for (n, (((ranges, most), least), out)) in lines {
            let h = sample(row, place, n);
            if h.is_nan() {
                if *least <= *most {
                    ranges.push([*least, *most]);
                    (*least, *most) = (f32::INFINITY, f32::NEG_INFINITY);
                }
            } else if ranges.iter().any(|[least, most]| *least < h && h <= *most) {
                *out &= !(LOWER | HIGHER);
            }
        }
    }
}

/// What a line weighs at least of those around a node some of which are missing: all may lie on the far side of it.
const LEAST: f32 = 1e-3;

/// The four lines around a node: two of a row of lines and two of the row before.
pub(super) struct FourLines {
    lines: [usize; 2],
    /// [row][line].
    weights: [[f32; 2]; 2],
}

impl FourLines {
    /// Those of node `i` of `nu`, as [`lines_around`] has them.
    pub(super) fn new(i: (usize, usize), line0: usize, weights: [f32; 2], extrapolates: bool) -> Self {
        let (lines, [f, fv]) = lines_around(i, line0, weights, extrapolates);
        Self { lines, weights: [1.0 - fv, fv].map(|row| [row * (1.0 - f), row * f]) }
    }

    /// The mean of `light`, of the lines that have a sample if some have none: those stand for the others.
    pub(super) fn mean(&self, light: [&[f32]; 2], gaps: [&[u16]; 2]) -> f32 {
        let each = || (0..4).map(|n| (n / 2, n % 2)).filter(|&(row, n)| self.weights[row][n] != 0.0);
        let there = |&(row, n): &(usize, usize)| {
            let line = self.lines[n];
            gaps[row][line / LANES] >> (line % LANES) & 1 == 0
        };
        let all = each().all(|line| there(&line));
        let (mut sum, mut weights) = (0.0, 0.0);
        for (row, n) in each().filter(there) {
            let weight = if all { self.weights[row][n] } else { self.weights[row][n].max(LEAST) };
            sum += weight * light[row][self.lines[n]];
            weights += weight;
        }
        if all { sum } else { sum / weights.max(LEAST) }
    }
}

/// Whether the level set of `value` between two samples is nearer to the first one.
#[inline(always)]
fn nearer(value: f32, old: f32, h: f32) -> bool {
    (value - old).abs() < 0.5 * (h - old).abs()
}

/// No row.
const NONE: u32 = u32::MAX;

/// A ray on one isovalue, from sample to sample.
pub(super) struct Crossing {
    value: f32,
    /// What counts as within the solid must be greater, not only as great.
    strict: bool,
    /// The sample before and its row; none in a gap.
    before: Option<(usize, f32)>,
    inside: bool,
}

impl Crossing {
    /// The ray comes from a gap, or from outside Ω.
    pub(super) fn new(value: f32, strict: bool) -> Self {
        Self { value, strict, before: None, inside: false }
    }

    /// Goes on to the sample of `row`. Where a level set lies between it and the one before, the row of the nearer of
    /// the two, and whether the ray comes from outside the solid.
    #[inline]
    pub(super) fn step(&mut self, row: usize, h: f32) -> Option<(usize, bool)> {
        if h == OUTSIDE {
            self.before = None;
            return None;
        }
        let above = if self.strict { h > self.value } else { h >= self.value };
        match self.before.replace((row, h)) {
            None => {
                self.inside = above;
                None
            }
            Some((old, old_h)) if above != self.inside => {
                Some((if nearer(self.value, old_h, h) { old } else { row }, above))
            }
            Some(_) => None,
        }
    }

    /// Whether the last sample was one within the solid.
    pub(super) fn is_within(&self) -> bool {
        self.before.is_some() && self.inside
    }
}

impl Pack {
    /// Lets lines run through gaps as they do outside Ω.
    #[inline(always)]
    pub(super) fn open_gaps(&mut self) {
        for &row in &self.awake {
            for (lane, h) in self.h[row as usize].iter_mut().enumerate() {
                let gap = h.is_nan();
                self.gapped |= u16::from(gap) << lane;
                *h = if gap { OUTSIDE } else { *h };
            }
        }
    }

    /// Looks again along lanes with gaps, which [`Pack::scan`] takes for ends of Ω: beside one the sample itself stands
    /// for what is missing, as in the first and the last slice, and rays go on beyond. Writes down in `gaps` which
    /// lanes of a slice have no sample.
    #[inline(always)]
    pub(super) fn look_through_gaps(
        &mut self,
        rule: ScanRule,
        light: Light,
        out: &mut [Vec<f32>],
        gaps: &mut [u16],
        (width, start): (usize, usize),
    ) {
        let (rows, ends) = (self.h.len(), self.ends());
        let split = if self.gapped == 0 { 0 } else { self.find_reentries() };
        for row in self.awake.iter().map(|row| *row as usize).filter(|row| (1..rows - 1).contains(row)) {
            let (here, up, down) = (&self.h[row], &self.h[(row + 1).min(rows - 2)], &self.h[(row - 1).max(1)]);
            let next = [&self.next[0][row], &self.next[1][row]];
            let (mut missing, mut again) = (0u16, 0u16);
            for lane in 0..LANES {
                let beside = up[lane] == OUTSIDE || down[lane] == OUTSIDE;
                let ended = next[usize::from(!(up[lane] < down[lane]))][lane] as usize >= ends;
                missing |= u16::from(here[lane] == OUTSIDE) << lane;
                again |= u16::from(beside || ended && split >> lane & 1 == 1) << lane;
            }
            gaps[((row - 1) * width + start) / LANES] = missing;
            again &= self.gapped & !missing;
            while again != 0 {
                let lane = again.trailing_zeros() as usize;
                again &= again - 1;
                let rgb = self.look_again(rule, light, (row, lane));
                for c in 0..3 {
                    out[c][(row - 1) * width + start + lane] = rgb[c];
                }
            }
        }
    }

    /// Finds for every sample the first one beyond the next gap, either way. Returns the lanes that have any.
    fn find_reentries(&mut self) -> u16 {
        let mut split = 0;
        for (d, reentries) in self.reentries.iter_mut().enumerate() {
            reentries.resize(self.h.len(), [NONE; LANES]);
            // The nearest sample of the run at hand, and of the one beyond.
            let (mut nearest, mut beyond) = ([NONE; LANES], [NONE; LANES]);
            let count = self.awake.len();
            for step in 0..count {
                let row = self.awake[if d == 0 { count - 1 - step } else { step }];
                let (h, reentries) = (&self.h[row as usize], &mut reentries[row as usize]);
                for lane in 0..LANES {
                    let gap = h[lane] == OUTSIDE;
                    let new = gap && nearest[lane] != NONE;
                    beyond[lane] = if new { nearest[lane] } else { beyond[lane] };
                    nearest[lane] = if gap { NONE } else { row };
                    reentries[lane] = beyond[lane];
                    split |= u16::from(!gap && beyond[lane] != NONE) << lane;
                }
            }
        }
        split
    }

    /// The radiance that a sample's ray meets that leaves downhill, through gaps and beside them.
    fn look_again(&self, rule: ScanRule, light: Light, (row, lane): (usize, usize)) -> [f32; 3] {
        let value = self.h[row][lane];
        let beside = |row: usize| {
            let h = self.h[row.clamp(1, self.h.len() - 2)][lane];
            if h == OUTSIDE { value } else { h }
        };
        let forward = beside(row + 1) < beside(row - 1);
        let met = match self.first((row, lane), forward) {
            Ok(node) => Met::Front(node),
            // Cuts hide the gaps beyond.
            Err(end) if end != self.lasts[usize::from(!forward)][lane] as usize => Met::End(end),
            Err(_) if self.cuts.iter().any(|cut| cut.lane == lane) => self.step_beyond(rule, (row, lane), forward),
            Err(_) => self.beyond(rule, (row, lane), forward),
        };
        match met {
            Met::Front(node) => colour(light.b[node as usize]),
            Met::Back(node) => colour(light.back.get(node as usize).copied().unwrap_or_default()),
            Met::End(place) => light.end(place, rule.sign * value),
            Met::Within(place) => light.other_end(place, rule.sign * value),
            Met::Dark => [0.0; 3],
        }
    }

    /// What the ray of a sample meets that meets nothing up to the next gap, or up to the end of its line, along a lane
    /// without cuts: from run to run of samples, by links outside the solid.
    fn beyond(&self, rule: ScanRule, (row, lane): (usize, usize), forward: bool) -> Met {
        let d = usize::from(!forward);
        let value = self.h[row][lane];
        let above = |h: f32| if rule.strict { h > value } else { h >= value };
        let mut row = self.reentries[d][row][lane];
        let returned = row != NONE;
        while row != NONE {
            let mut at = row as usize;
            if !above(self.h[at][lane]) {
                let mut j = at * LANES + lane;
                while j < self.ends() && !above(self.h.as_flattened()[j]) {
                    j = self.next[d].as_flattened()[j] as usize;
                }
                if j < self.ends() {
                    let before = if forward { j - LANES } else { j + LANES };
                    return Met::Front(self.node.as_flattened()[self.nearer(value, before, j)]);
                }
            } else {
                // Inside the solid all slices were read.
                loop {
                    let next = if forward { at + 1 } else { at.wrapping_sub(1) };
                    if next >= self.h.len() || !self.was_read(next) {
                        return self.exit(rule, (value, returned), lane, forward);
                    }
                    let h = self.h[next][lane];
                    if h == OUTSIDE {
                        break;
                    }
                    if !above(h) {
                        let [before, j] = [at, next].map(|row| row * LANES + lane);
                        return Met::Back(self.node.as_flattened()[self.nearer(value, before, j)]);
                    }
                    at = next;
                }
            }
            row = self.reentries[d][row as usize][lane];
        }
        self.exit(rule, (value, returned), lane, forward)
    }

    /// What a ray of isovalue `value` meets that meets no level set, whether it came back from a gap (`returned`) or
    /// not: what stands at the end of its line; from within the solid a cap, which is black, or a wall as the other
    /// side sees it.
    fn exit(&self, rule: ScanRule, (value, returned): (f32, bool), lane: usize, forward: bool) -> Met {
        let end = self.lasts[usize::from(!forward)][lane] as usize;
        match self.border(lane, forward) {
            Some(h) if rule.capped && returned && h >= value => Met::Dark,
            Some(h) if returned && (h > value || !rule.strict && h == value) => Met::Within(end),
            _ => Met::End(end),
        }
    }

    /// Which of two samples with a level set between them is nearer to it: the second if in doubt.
    #[inline(always)]
    fn nearer(&self, value: f32, before: usize, at: usize) -> usize {
        let [old, h] = [before, at].map(|place| self.h.as_flattened()[place]);
        if nearer(value, old, h) { before } else { at }
    }

    /// The same along a lane with cuts, sample by sample.
    fn step_beyond(&self, rule: ScanRule, (row, lane): (usize, usize), forward: bool) -> Met {
        let d = usize::from(!forward);
        let (mut from, mut gone, mut returned) = (row, false, false);
        let value = self.h[from][lane];
        let mut crossing = Crossing::new(value, rule.strict);
        let mut position = self.awake.binary_search(&u32::try_from(row).expect("a row")).expect("a row that was read");
        loop {
            position = if forward { position + 1 } else { position.wrapping_sub(1) };
            let Some(&row) = self.awake.get(position) else { return self.exit(rule, (value, returned), lane, forward) };
            let row = row as usize;
            let between = from.min(row)..from.max(row);
            let mut cuts = self.cuts.iter().filter(|c| c.lane == lane && between.contains(&c.row));
            if let Some(cut) = if forward { cuts.next() } else { cuts.next_back() } {
                let place = cut.places[d] as usize;
                return if crossing.is_within() { Met::Within(place) } else { Met::End(place) };
            }
            let h = self.h[row][lane];
            gone |= h == OUTSIDE;
            returned |= gone && h != OUTSIDE;
            if gone && let Some((row, front)) = crossing.step(row, h) {
                let node = self.node[row][lane];
                return if front { Met::Front(node) } else { Met::Back(node) };
            }
            from = row;
        }
    }
}

/// What a ray meets beyond a gap: a level set from outside or from within the solid, by the node that stands for it, or
/// what is at a place of the ends, as this side of the level sets sees it or as the other one does, or nothing that
/// shines.
enum Met {
    Front(u32),
    Back(u32),
    End(usize),
    Within(usize),
    Dark,
}

#[cfg(test)]
mod tests {
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
            let light =
                Light { b: &front, back: &back, flats: &flats, isovalues: 4, axis: &IsovalueAxis::EVEN, across: 0 };
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
                let sum =
                    weights[0] * light[0][line - 1] + weights[1] * light[1][line] + weights[2] * light[1][line - 1];
                assert!((three - sum / weights.iter().sum::<f32>()).abs() < 1e-5, "{i}");
            }
            assert_eq!(around.mean(light, [&[u16::MAX; 3], &[u16::MAX; 3]]), 0.0);
        }
    }
}
