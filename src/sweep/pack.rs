//! Sixteen neighbouring lines in lock-step: h and nodes along them, and what they end on.

#![allow(clippy::needless_range_loop, reason = "a channel indexes several planes at once")]

#[cfg(test)]
mod tests;

use super::directions::Shear;
use super::ends::LineEnds;
use super::flats::{Flats, Stop};
use super::grid::Source;
use super::simd::prefetch;

/// Lines in a pack.
pub(super) const LANES: usize = 16;
/// How many slices ahead h is prefetched.
const AHEAD: usize = 6;
/// One number for each line of a pack.
pub(super) type Lanes = [f32; LANES];
/// h where a line is outside Ω, or in a cell that holds no surface.
pub(super) const OUTSIDE: f32 = f32::NEG_INFINITY;
/// h where it was not read, since nothing there reaches the sweep: below everything, so that no ray ends there.
pub(super) const ASLEEP: f32 = f32::MIN;

/// Everything about one family of lines that its rows share.
pub(super) struct Plan {
    pub shear: Shear,
    /// Whole and broken shifts of every slice along u and v.
    pub shift: [Vec<(isize, f32)>; 2],
    /// First line number along u and v that meets Ω, and how many do.
    pub first: [isize; 2],
    pub count: [usize; 2],
    /// `count[0]` rounded up to whole packs.
    pub width: usize,
    /// +1 to sweep the lower side, −1 for the higher one: the sign h is read with.
    pub sign: f32,
}

impl Plan {
    #[allow(clippy::cast_possible_truncation, reason = "lattice offsets")]
    pub(super) fn new(shear: Shear, sign: f32) -> Self {
        let [_, _, na] = shear.layout.dims;
        let shift = [0, 1].map(|a| -> Vec<(isize, f32)> {
            (0..na)
                .map(|k| {
                    let (whole, broken) = shear.shift(a, k as f64);
                    (whole, broken as f32)
                })
                .collect()
        });
        let first = [0, 1].map(|a| -shift[a].iter().map(|s| s.0).max().expect("at least two slices"));
        let count: [usize; 2] = std::array::from_fn(|a| {
            let last = shear.layout.dims[a] as isize - 2 - shift[a].iter().map(|s| s.0).min().expect("as above");
            (last - first[a] + 1).unsigned_abs()
        });
        let width = count[0].div_ceil(LANES) * LANES;
        Self { shear, shift, first, count, width, sign }
    }

    /// Differs from pack to pack and family to family.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "any bits do")]
    fn noise(&self, first: isize, q: f64) -> u32 {
        let family = (self.shear.offset[0].to_bits() ^ self.shear.offset[1].to_bits() >> 7) >> 12;
        let pack =
            (first as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (q as i64 as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
        ((family ^ pack).wrapping_mul(0xff51_afd7_ed55_8ccd) >> 32) as u32
    }

    /// The lanes of lines (first + lane, q) whose cell in slice `k` lies in Ω.
    #[inline(always)]
    pub(super) fn within(&self, k: usize, (first, q): (isize, isize)) -> (usize, usize) {
        let [nu, nv, _] = self.shear.layout.dims;
        let j = q + self.shift[1][k].0;
        if j < 0 || j > nv as isize - 2 {
            return (0, 0);
        }
        match lanes(first + self.shift[0][k].0, nu) {
            (lo, hi) if lo < hi => (lo, hi),
            _ => (0, 0),
        }
    }

    /// τ at which lines (p + lane, q) enter and leave Ω; nothing is between if they miss it.
    #[inline(always)]
    fn spans(&self, p: f64, q: f64) -> [[f64; LANES]; 2] {
        let [nu, nv, na] = self.shear.layout.dims;
        let (mut from, mut to) = ([0f64; LANES], [na as f64 - 1.0; LANES]);
        for (a, (number, step, n)) in [(p, 1.0, nu), (q, 0.0, nv)].into_iter().enumerate() {
            let (offset, s, far) = (self.shear.offset[a], self.shear.slope[a], n as f64 - 1.0);
            for l in 0..LANES {
                let x = number + l as f64 * step + offset;
                // Parallel to this pair of sides.
                if s == 0.0 {
                    (from[l], to[l]) = if x >= 0.0 && x <= far { (from[l], to[l]) } else { (1.0, 0.0) };
                    continue;
                }
                let (t0, t1) = (-x / s, (far - x) / s);
                from[l] = from[l].max(t0.min(t1));
                to[l] = to[l].min(t0.max(t1));
            }
        }
        [from, to]
    }
}

/// The lanes whose cell, from `i` on, lies in a row of `nu` nodes.
#[inline(always)]
#[allow(clippy::cast_sign_loss, reason = "clamped")]
fn lanes(i: isize, nu: usize) -> (usize, usize) {
    ((-i).clamp(0, LANES as isize) as usize, (nu as isize - 1 - i).clamp(0, LANES as isize) as usize)
}

/// ε of [`Pack::choose`]: of nodes that are off by less than a tenth of the usual none is much likelier than its
/// weight.
const LEVEL: f32 = 0.01;

/// `x`, or `most` if it is greater or no number.
#[inline(always)]
fn at_most(most: f32, x: f32) -> f32 {
    if x < most { x } else { most }
}

/// Weights of the four samples around a line, at those offsets.
#[derive(Clone, Copy)]
struct Taps {
    at: [isize; 4],
    weight: [f32; 4],
}

impl Taps {
    /// The samples of sixteen lines, those of lines outside Ω from a neighbouring row; `None` if memory ends amid them.
    #[inline(always)]
    fn rows<'a>(&self, h: &'a [f32]) -> Option<[&'a Lanes; 4]> {
        let [t0, t1, t2, t3] = self.at;
        let lanes = |t: isize| -> &Lanes { h[t.unsigned_abs()..][..LANES].try_into().expect("sixteen lanes") };
        (t0 >= 0 && t3.unsigned_abs() + LANES <= h.len()).then(|| [lanes(t0), lanes(t1), lanes(t2), lanes(t3)])
    }

    /// Copies of them, as far as memory goes.
    fn copies(&self, h: &[f32]) -> [Lanes; 4] {
        let last = h.len() as isize - 1;
        self.at.map(|t| std::array::from_fn(|l| h[(t + l as isize).clamp(0, last).unsigned_abs()]))
    }
}

/// Σ weight · x over four rows. (Loops, since closures given to the library are not compiled for the instruction set.)
#[inline(always)]
fn mix<const N: usize>(weight: [f32; 4], [a, b, c, d]: [&[f32; N]; 4], out: &mut [f32; N]) {
    for l in 0..N {
        out[l] = (weight[0] * a[l] + weight[1] * b[l]) + (weight[2] * c[l] + weight[3] * d[l]);
    }
}

/// Marks the lanes that are not in lo..hi.
#[inline(always)]
#[allow(clippy::cast_possible_truncation, reason = "lanes")]
fn blank(line: &mut Lanes, lo: usize, hi: usize) {
    let (lo, width) = (lo as u32, (hi - lo) as u32);
    for l in 0..LANES {
        line[l] = if (l as u32).wrapping_sub(lo) < width { line[l] } else { OUTSIDE };
    }
}

/// A cut of one lane by a luminaire inside Ω: after which row, and what it shows to lines from before and behind.
#[derive(Clone, Copy)]
pub(super) struct Cut {
    pub row: usize,
    pub lane: usize,
    pub places: [u32; 2],
}

/// The samples of sixteen lines. Row 0 and the last hold nothing but entry and exit points; row k + 1 is slice k. A
/// line's entry and exit through Ω's sides stand in the rows before its first and after its last slice.
pub(super) struct Pack {
    pub h: Vec<Lanes>,
    /// Which node's B stands for that of each sample: one of the four around the line, each the likelier the nearer it
    /// is, in place and above all in isovalue ([`Pack::choose`]). Neighbouring nodes differ little and every ray meets
    /// others, so that the mean is what interpolation gives at a quarter of the work.
    pub node: Vec<[u32; LANES]>,
    /// Per direction (+, −), the number 16 · row + lane of the sample that the ray from each sample meets, and h there;
    /// from [`Pack::ends`] on the place of an end in [`Flats::packed`], and ∞.
    pub next: [Vec<[u32; LANES]>; 2],
    pub h_next: [Vec<Lanes>; 2],
    /// The rows that were read, ascending: all that reach the sweep. In the others, but the first and the last, h is
    /// [`ASLEEP`].
    pub awake: Vec<u32>,
    is_awake: Vec<bool>,
    /// The slices where nodes beside the row of lines reach the sweep, and their blocks.
    stripe: Vec<(usize, u64)>,
    /// [`Plan::spans`] of the lines.
    pub spans: [[f64; LANES]; 2],
    pub cuts: Vec<Cut>,
    /// The lanes with samples in cells that hold no surface.
    pub gapped: u16,
    /// Per direction (+, −), the row of the first sample beyond the gap after each.
    pub reentries: [Vec<[u32; LANES]>; 2],
    /// Where in [`Flats::packed`] the ends of lines are, per direction (+, −).
    pub lasts: [[u32; LANES]; 2],
    scratch: Vec<(f64, [Stop; 2])>,
}

impl Pack {
    /// Makes room for lines through so many slices.
    pub(super) fn fit(&mut self, slices: usize) {
        if self.h.len() != slices + 2 {
            *self = Self::with_rows(slices + 2);
            self.h[1..=slices].fill([ASLEEP; LANES]);
        }
    }

    /// Nothing, in so many rows, with black ends.
    pub(super) fn with_rows(rows: usize) -> Self {
        let next = || vec![[0; LANES]; rows];
        let h_next = || vec![[0.0; LANES]; rows];
        Self {
            h: vec![[OUTSIDE; LANES]; rows],
            node: next(),
            next: [next(), next()],
            h_next: [h_next(), h_next()],
            awake: Vec::new(),
            is_awake: vec![false; rows],
            stripe: Vec::new(),
            spans: [[0.0; LANES]; 2],
            cuts: Vec::new(),
            gapped: 0,
            reentries: Default::default(),
            lasts: [[0; LANES]; 2],
            scratch: Vec::new(),
        }
    }

    /// Lets all rows count as read.
    #[cfg(test)]
    #[allow(clippy::cast_possible_truncation, reason = "rows of a pack")]
    pub(super) fn read_all(&mut self) {
        self.is_awake.fill(true);
        self.awake = (0..self.h.len() as u32).collect();
    }

    /// Places from here on are ends.
    pub(super) fn ends(&self) -> usize {
        self.h.len() * LANES
    }

    /// Prepares for row `q` of lines.
    pub(super) fn begin(&mut self, plan: &Plan, source: &Source, q: isize) {
        let [_, nv, na] = plan.shear.layout.dims;
        self.stripe.clear();
        for (k, (whole, _)) in plan.shift[1][..na].iter().enumerate() {
            let j = q + whole;
            if j >= 0 && j <= nv as isize - 2 {
                let bits = source.awake(k, j.unsigned_abs());
                if bits != 0 {
                    self.stripe.push((k, bits));
                }
            }
        }
    }

    /// Reads h along lines (first + lane, q), where they reach the sweep. Returns whether any does.
    #[inline(always)]
    pub(super) fn read(&mut self, plan: &Plan, source: &Source, first: isize, q: isize) -> bool {
        let nu = plan.shear.layout.dims[0];
        let [sv, sa] = plan.shear.layout.stride;
        let node = plan.shear.layout.node;
        let last = source.h.len() - 1;
        let seed = plan.noise(first, q as f64);
        for &row in &self.awake {
            self.h[row as usize] = [ASLEEP; LANES];
            self.is_awake[row as usize] = false;
        }
        self.awake.clear();
        let mut inside = true;
        for n in 0..self.stripe.len() {
            let (k, bits) = self.stripe[n];
            let (uk, fu) = plan.shift[0][k];
            let (vk, fv) = plan.shift[1][k];
            let (i, j) = (first + uk, q + vk);
            let (lo, hi) = lanes(i, nu);
            if lo >= hi || {
                let from = (i + lo as isize).unsigned_abs();
                !source.meets(bits, from, from + hi - lo + 1)
            } {
                continue;
            }
            if let Some(&(k, _)) = self.stripe.get(n + AHEAD) {
                let (i, j) = (first + plan.shift[0][k].0, q + plan.shift[1][k].0);
                let at = k as isize * sa as isize + j * sv as isize + i;
                for at in [at, at + sv as isize] {
                    let h = source.h.get(at.max(0).unsigned_abs()..).unwrap_or_default();
                    prefetch(&h[..h.len().min(LANES + 1)]);
                }
            }
            let at = k as isize * sa as isize + j * sv as isize + i;
            let taps = Taps {
                at: [at, at + 1, at + sv as isize, at + sv as isize + 1],
                weight: [(1.0 - fu) * (1.0 - fv), fu * (1.0 - fv), (1.0 - fu) * fv, fu * fv],
            };
            let place = i * node[0] as isize + j * node[1] as isize + (k * node[2]) as isize;
            let copies;
            let rows = if let Some(rows) = taps.rows(source.h) {
                rows
            } else {
                copies = taps.copies(source.h);
                copies.each_ref()
            };
            self.take(&taps.weight, plan.sign, rows, k + 1, (lo, hi));
            let random = dither(seed, 2 * LANES + k);
            self.choose(&taps.weight, plan.sign, rows, (place, [node[0], node[1], last]), random, k + 1);
            self.is_awake[k + 1] = true;
            inside &= hi - lo == LANES && self.beside(plan, k, (first, q)) == [(0, LANES); 2];
        }
        self.spans = plan.spans(first as f64, q as f64);
        // Lines that enter through a side between two slices get that point in the row before, those that leave in the
        // row behind.
        if !inside {
            self.sides(plan, source, (first, q));
        }
        #[allow(clippy::cast_possible_truncation, reason = "rows of a pack")]
        self.awake.extend(self.is_awake.iter().enumerate().filter(|(_, a)| **a).map(|(row, _)| row as u32));
        self.gapped = 0;
        if source.gaps {
            self.open_gaps();
        }
        !self.awake.is_empty()
    }

    /// The lanes that lie in Ω in slices k − 1 and k + 1; all where there is no such slice.
    #[inline(always)]
    fn beside(&self, plan: &Plan, k: usize, line: (isize, isize)) -> [(usize, usize); 2] {
        let last = plan.shear.layout.dims[2] - 1;
        [
            if k > 0 { plan.within(k - 1, line) } else { (0, LANES) },
            if k < last { plan.within(k + 1, line) } else { (0, LANES) },
        ]
    }

    /// Adds the points where lines meet Ω's sides beside slices that were read.
    #[inline(always)]
    fn sides(&mut self, plan: &Plan, source: &Source, (first, q): (isize, isize)) {
        for n in 0..self.stripe.len() {
            let k = self.stripe[n].0;
            if !self.is_awake[k + 1] {
                continue;
            }
            let (lo, hi) = plan.within(k, (first, q));
            let beside = self.beside(plan, k, (first, q));
            for (leaves, (from, to)) in [false, true].into_iter().zip(beside) {
                let row = if leaves { k + 2 } else { k };
                // The lanes of lo..hi that are not in from..to.
                for lanes in [lo..hi.min(from), lo.max(to)..hi] {
                    if !lanes.is_empty() && !self.is_awake[row] {
                        self.is_awake[row] = true;
                        blank(&mut self.h[row], from, to);
                    }
                    for lane in lanes {
                        self.side(plan, source, (first + lane as isize, q), lane, k, leaves);
                    }
                }
            }
        }
    }

    /// Whether a row was read: in the others nothing reaches the sweep.
    pub(super) fn was_read(&self, row: usize) -> bool {
        self.is_awake[row]
    }

    /// h where a line that meets Ω leaves it, or enters it if not `forward`; `None` if samples are missing there.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "slices in Ω")]
    pub(super) fn border(&self, lane: usize, forward: bool) -> Option<f32> {
        let tau = self.spans[usize::from(forward)][lane];
        let row = 1 + if forward { tau.floor() } else { tau.ceil() } as usize;
        let side = if forward { row + 1 } else { row - 1 };
        [side, row].map(|row| self.h[row][lane]).into_iter().find(|h| *h != OUTSIDE)
    }

    /// Reads one row, lanes `lo..hi` of which lie in Ω.
    #[inline(always)]
    fn take(&mut self, weight: &[f32; 4], sign: f32, rows: [&Lanes; 4], row: usize, (lo, hi): (usize, usize)) {
        let line = &mut self.h[row];
        let [w0, w1, w2, w3] = *weight;
        mix([w0 * sign, w1 * sign, w2 * sign, w3 * sign], rows, line);
        if hi - lo < LANES {
            blank(line, lo, hi);
        }
    }

    /// Picks the nodes whose B the samples of a row have, from node `first` on: by the strides along u and v and the
    /// number of the last node there is. A node is as likely as w / (d² + ε Σ w d²), w being its bilinear weight and d
    /// how far its isovalue is from the sample's; so by w where all are as far off. Light mostly changes faster from
    /// level set to level set than along one, and what a bounce reads from others the next one carries on.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, reason = "lanes in Ω meet nodes in Ω")]
    #[allow(clippy::cast_sign_loss, reason = "as above")]
    fn choose(
        &mut self,
        weight: &[f32; 4],
        sign: f32,
        [h0, h1, h2, h3]: [&Lanes; 4],
        (first, [u, v, last]): (isize, [usize; 3]),
        random: f32,
        row: usize,
    ) {
        let (first, u, v, last) = (first as i32, u as i32, v as i32, last as i32);
        let [w0, w1, w2, w3] = *weight;
        let line = &self.h[row];
        let node = &mut self.node[row];
        for l in 0..LANES {
            let h = sign * line[l];
            let squared = |x: f32| at_most(1e30, x * x);
            let [d0, d1, d2, d3] = [squared(h0[l] - h), squared(h1[l] - h), squared(h2[l] - h), squared(h3[l] - h)];
            let mean = (w0 * d0 + w1 * d1) + (w2 * d2 + w3 * d3);
            let scale = 1.0 / (mean + f32::MIN_POSITIVE);
            // All times the product of the four, so that one division does.
            let off = |d: f32| at_most(1e9, d * scale) + LEVEL;
            let [d0, d1, d2, d3] = [off(d0), off(d1), off(d2), off(d3)];
            let (near, far) = (d0 * d1, d2 * d3);
            let [p0, p1, p2, p3] = [w0 * (d1 * far), w1 * (d0 * far), w2 * (near * d3), w3 * (near * d2)];
            let x = random * ((p0 + p1) + (p2 + p3));
            // Which it is nobody can foretell: counted, not searched for.
            let number = i32::from(x >= p0) + i32::from(x >= p0 + p1) + i32::from(x >= (p0 + p1) + p2);
            let at = first + (l as i32 + (number & 1)) * u + (number >> 1) * v;
            // Lanes outside Ω name any node.
            node[l] = at.max(0).min(last) as u32;
        }
    }

    /// Adds the point where a line whose first or last slice is `k` meets Ω's side.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the lattice")]
    fn side(&mut self, plan: &Plan, source: &Source, pq: (isize, isize), lane: usize, k: usize, leaves: bool) {
        let [nu, nv, na] = plan.shear.layout.dims;
        let [sv, sa] = plan.shear.layout.stride;
        let near = k as f64 + if leaves { 1.0 } else { -1.0 };
        let tau = self.spans[usize::from(leaves)][lane].clamp(near.min(k as f64), near.max(k as f64));
        let [x, y] = [(pq.0, nu, 0), (pq.1, nv, 1)].map(|(number, n, a)| {
            (number as f64 + plan.shear.offset[a] + plan.shear.slope[a] * tau).clamp(0.0, n as f64 - 1.0)
        });
        let cell = |x: f64, n: usize| (x as usize).min(n - 2);
        let (i, j, l) = (cell(x, nu), cell(y, nv), cell(tau.clamp(0.0, na as f64 - 1.0), na));
        let f = [x - i as f64, y - j as f64, tau - l as f64].map(|f| f as f32);
        let at = l * sa + j * sv + i;
        let h = source.h;
        let lerp = |t: f32, a: f32, b: f32| a + t * (b - a);
        let edge = |o: usize| lerp(f[0], h[o], h[o + 1]);
        let face = |o: usize| lerp(f[1], edge(o), edge(o + sv));
        let nearest = |x: f32| usize::from(x >= 0.5);
        let row = if leaves { k + 2 } else { k };
        self.h[row][lane] = plan.sign * lerp(f[2], face(at), face(at + sa));
        let place = [i + nearest(f[0]), j + nearest(f[1]), l + nearest(f[2])];
        self.node[row][lane] = (0..3).map(|a| place[a] * plan.shear.layout.node[a]).sum::<usize>() as u32;
    }

    /// Finds what the lines end on, and where its radiance is. `first` and `q` as in [`Pack::read`].
    #[inline(always)]
    pub(super) fn end(&mut self, plan: &Plan, ends: &LineEnds, flats: &Flats, first: isize, q: isize) {
        self.cuts.clear();
        if flats.none() && !ends.cut() {
            self.lasts = [[0; LANES]; 2];
            return;
        }
        let (p, q) = (first as f64, q as f64);
        let mut from = [[0.0; LANES]; 2];
        let mut random = [[0.0; LANES]; 2];
        let seed = plan.noise(first, q);
        for lane in 0..LANES {
            let hit = self.spans[0][lane] <= self.spans[1][lane];
            for d in 0..2 {
                from[d][lane] = if hit { self.spans[1 - d][lane] } else { 0.0 };
                random[d][lane] = dither(seed, lane + d * LANES);
            }
        }
        for (d, forward) in [(0, true), (1, false)] {
            ends.stops(flats, (p, q), &from[d], forward, &random[d], &mut self.lasts[d]);
        }
        if ends.cut() {
            let mut scratch = std::mem::take(&mut self.scratch);
            for lane in 0..LANES {
                ends.cuts(p + lane as f64, q, from[1][lane], from[0][lane], &mut scratch);
                for &(at, stops) in &scratch {
                    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a row of the pack")]
                    let row = (at.floor() + 1.0) as usize;
                    let places = stops.map(|s| flats.place(Some(s), dither(seed, lane)));
                    self.cuts.push(Cut { row, lane, places });
                }
            }
            self.scratch = scratch;
        }
    }

    /// The place of what a lane's rays meet that meet nothing else.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, reason = "places in a pack")]
    pub(super) fn last(&self, lane: usize, forward: bool) -> u32 {
        self.ends() as u32 + self.lasts[usize::from(!forward)][lane]
    }
}

/// A number in [0, 1) for a lane of a pack.
#[inline(always)]
fn dither(seed: u32, lane: usize) -> f32 {
    #[allow(clippy::cast_possible_truncation, reason = "lanes")]
    let x = (seed ^ lane as u32).wrapping_mul(0x9e37_79b1);
    let x = (x ^ x >> 15).wrapping_mul(0x85eb_ca77);
    ((x ^ x >> 13) >> 8) as f32 / (1 << 24) as f32
}
