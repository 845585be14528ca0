//! Samples that are not finite. The cells around them hold no surface: lines run through such gaps as they do outside
//! of Ω, and level sets end at their rims. A ray that comes out of a gap may do so inside the solid of its isovalue,
//! which it then sees from within.

#[cfg(test)]
mod tests;

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
