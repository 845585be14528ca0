//! One fan: the lines of a source through the slices on one side of it.

use super::sample;
use crate::isa::Isa;
use crate::sweep::blocks::Blocks;
use crate::sweep::directions::Layout;
use crate::sweep::gaps::HiddenRanges;
use glam::DVec3;
use std::ops::Range;

/// The lines from a point through the unit lattice of the farthest slice of one of the six pyramids around it.
pub(in crate::sweep) struct Fan {
    pub layout: Layout,
    /// The source in (u, v, slice).
    pub source: [f64; 3],
    /// Slices from the source to the lattice's plane, with sign.
    pub depth: f64,
    /// First slice and their number, away from the source.
    pub slices: (usize, usize),
    /// First line and their number along u and v, numbered by where they meet the lattice's plane.
    pub first: [isize; 2],
    pub count: [usize; 2],
    /// What is kept of each slice, and of each row of lines.
    pub(super) kept: Vec<Kept>,
    pub(super) rows: Vec<Row>,
}

/// The lines that meet Ω in a slice, and next to it: what they see is kept. In others, as all of a long volume's lines
/// are but near the source, nobody asks.
#[derive(Clone, Copy)]
pub(in crate::sweep) struct Kept {
    /// First line and their number along u and v.
    pub first: [usize; 2],
    pub count: [usize; 2],
    /// Lines of one row in the slices before it, less the first; wraps around.
    place: usize,
}

impl Kept {
    /// Lines of one row in the slices before it.
    fn before(&self) -> usize {
        self.place.wrapping_add(self.first[0])
    }
}

/// The slices that a row of lines is kept in.
#[derive(Clone, Copy)]
pub(super) struct Row {
    first: usize,
    count: usize,
    /// Where what it sees begins, less what [`Kept::place`] says of the first; wraps around.
    begin: usize,
}

/// What the lines of a fan march through.
pub(super) struct Through<'a> {
    pub isa: Isa,
    /// In the order of the fan's layout.
    pub h: &'a [f32],
    /// What could be lit, of each side that is swept.
    pub awake: [Option<&'a Blocks>; 2],
    /// The greatest and the least h so far.
    pub start: [f32; 2],
    /// Added to what is seen.
    pub turn: u8,
}

/// A thread's memory for a row of lines.
#[derive(Default)]
pub(super) struct Scratch {
    /// Where samples are missing.
    pub hidden: Option<HiddenRanges>,
    /// The greatest and the least h of each line so far.
    pub most: Vec<f32>,
    pub least: Vec<f32>,
    /// A row of samples between two.
    pub mixed: Vec<f32>,
}

impl Fan {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the lattice")]
    pub(super) fn new(dims: [usize; 3], y: DVec3, axis: usize, up: bool) -> Option<Self> {
        let layout = Layout::new(dims, axis);
        let [u, v, a] = layout.axes;
        let source = [y[u], y[v], y[a]];
        let last = layout.dims[2] as f64 - 1.0;
        let plane = if up { last } else { 0.0 };
        let depth = plane - source[2];
        if if up { depth <= 1e-9 } else { depth >= -1e-9 } {
            return None;
        }
        // The nearest slice strictly beyond the source.
        let k0 = if up { (source[2] + 1e-9).ceil().max(0.0) } else { (source[2] - 1e-9).floor().min(last) };
        let slices = (k0 as usize, (plane - k0).abs() as usize + 1);
        // Where those meet the plane that meet Ω in a slice: of a source far away few of the pyramid's do.
        let nearest = (k0 - source[2]) / depth;
        let lines = [0, 1].map(|x| {
            let [low, high] = [0.0, layout.dims[x] as f64 - 1.0].map(|side| side - source[x]);
            let (low, high) = (low.min(low / nearest), high.max(high / nearest));
            [low.max(-depth.abs()), high.min(depth.abs())].map(|line| source[x] + line)
        });
        if lines.iter().any(|[low, high]| low > high) {
            return None;
        }
        let first = lines.map(|[low, _]| low.floor() as isize);
        // Two at least, to interpolate between.
        let count = [0, 1].map(|x| (lines[x][1].ceil() as isize - first[x]).max(1).unsigned_abs() + 1);
        let mut fan = Self { layout, source, depth, slices, first, count, kept: Vec::new(), rows: Vec::new() };
        let mut place = 0usize;
        for step in 0..slices.1 {
            let [us, vs] = [0, 1].map(|axis| fan.lines(axis, step));
            fan.kept.push(Kept { first: [us.0, vs.0], count: [us.1, vs.1], place: place.wrapping_sub(us.0) });
            place += us.1;
        }
        Some(fan)
    }

    /// First line along u (`axis` 0) or v and their number that meet Ω in the slice at `step`, with two more on either
    /// side: two at least.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the fan")]
    fn lines(&self, axis: usize, step: usize) -> (usize, usize) {
        let (source, most) = (self.source[axis], self.count[axis]);
        let inverse = self.depth / (self.slice(step) as f64 - self.source[2]);
        let [low, high] = [0.0, self.layout.dims[axis] as f64 - 1.0]
            .map(|u| source + (u - source) * inverse - self.first[axis] as f64);
        let first = ((low.floor() - 2.0).max(0.0) as usize).min(most - 2);
        let end = ((high.ceil() + 3.0).max(0.0) as usize).clamp(first + 2, most);
        (first, end - first)
    }

    /// Finds a place for what is seen, from `begin` on; where the next fan's begins.
    pub(super) fn place(&mut self, mut begin: usize) -> usize {
        // The slices in which a row meets Ω follow one another.
        self.rows = vec![Row { first: usize::MAX, count: 0, begin: 0 }; self.count[1]];
        let of = |step: usize| self.kept.get(step).map_or(0..0, |kept| kept.first[1]..kept.first[1] + kept.count[1]);
        let mut before = 0..0;
        for step in 0..=self.kept.len() {
            let now = of(step);
            without(&now, &before).for_each(|n| self.rows[n].first = self.rows[n].first.min(step));
            without(&before, &now).for_each(|n| self.rows[n].count = step - self.rows[n].first);
            before = now;
        }
        for n in 0..self.rows.len() {
            if self.rows[n].count > 0 {
                self.rows[n].begin = begin.wrapping_sub(self.kept[self.rows[n].first].before());
                begin += self.length(n);
            }
        }
        begin
    }

    /// Bytes of row `n` of lines.
    pub(super) fn length(&self, n: usize) -> usize {
        let Row { first, count, .. } = self.rows[n];
        let Some(last) = count.checked_sub(1) else { return 0 };
        let last = &self.kept[first + last];
        last.before() + last.count[0] - self.kept[first].before()
    }

    /// What is kept of the slice at `step`.
    #[inline(always)]
    pub(in crate::sweep) fn kept(&self, step: usize) -> &Kept {
        &self.kept[step]
    }

    /// Where in [`Fans::seen`] line 0 of row `n` in the slice at `step` stands, or would stand were it kept; wraps
    /// around.
    #[inline(always)]
    pub(in crate::sweep) fn line_zero(&self, n: usize, step: usize) -> usize {
        self.rows[n].begin.wrapping_add(self.kept[step].place)
    }

    #[inline]
    pub(super) fn slice(&self, step: usize) -> usize {
        if self.depth > 0.0 { self.slices.0 + step } else { self.slices.0 - step }
    }

    /// One row of lines, all slices. Where neither side could be lit nothing is read: h below the sweep hides nothing.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the lattice")]
    pub(super) fn march(&self, through: &Through, row: usize, scratch: &mut Scratch, out: &mut [u8]) {
        let Through { isa, h, awake, start, turn } = *through;
        let Scratch { hidden, most, least, mixed } = scratch;
        let [nu, nv, _] = self.layout.dims;
        let [sv, sa] = self.layout.stride;
        let np = self.count[0];
        most.clear();
        least.clear();
        most.resize(np, start[0]);
        least.resize(np, start[1]);
        hidden.iter_mut().for_each(|hidden| hidden.clear(np));
        let q = (self.first[1] + row as isize) as f64;
        let Row { first, count, .. } = self.rows[row];
        if count == 0 {
            return;
        }
        let mut rest = out;
        for (step, kept) in (first..first + count).zip(&self.kept[first..]) {
            let out;
            (out, rest) = rest.split_at_mut(kept.count[0]);
            let k = self.slice(step);
            let ratio = (k as f64 - self.source[2]) / self.depth;
            let v = self.source[1] + (q - self.source[1]) * ratio;
            if !(v >= 0.0 && v <= (nv - 1) as f64) {
                continue;
            }
            let j = (v as usize).min(nv - 2);
            let fv = (v - j as f64) as f32;
            let Some((n0, n1)) =
                awake.iter().flatten().filter_map(|a| a.extent((k * sa + j * sv) / nu, sv / nu, nu)).reduce(join)
            else {
                continue;
            };
            // Lines with u in Ω, over nodes that matter.
            let p = |u: f64| self.source[0] + (u - self.source[0]) / ratio - self.first[0] as f64;
            let within = |n: usize| n.clamp(kept.first[0], kept.first[0] + kept.count[0]);
            let lo = within(p(n0 as f64).ceil().max(0.0) as usize);
            let hi = within((p((n1 - 1) as f64).floor().min(np as f64 - 1.0) + 1.0).max(0.0) as usize);
            let u0 = (self.source[0] + (self.first[0] as f64 - self.source[0]) * ratio) as f32;
            let du = ratio as f32;
            if lo >= hi {
                continue;
            }
            // The row of lines lies between two rows of samples: mixed once, for near slices hold many lines per
            // sample.
            let (i0, i1) =
                (((u0 + lo as f32 * du).max(0.0) as usize).min(nu - 2), ((u0 + hi as f32 * du) as usize + 2).min(nu));
            self.enter(h, (step, q), (lo, hi), [most, least], mixed);
            mix(mixed, [&h[k * sa + j * sv..][i0..i1], &h[k * sa + (j + 1) * sv..][i0..i1]], fv);
            let place = [u0 + lo as f32 * du - i0 as f32, du];
            let out = &mut out[lo - kept.first[0]..hi - kept.first[0]];
            isa.march(mixed, place, [&mut most[lo..hi], &mut least[lo..hi]], out, turn);
            if let Some(hidden) = hidden {
                hidden.look(mixed, place, lo, [&mut most[lo..hi], &mut least[lo..hi]], out);
            }
        }
    }

    /// Takes h into the extrema of lines lo..hi of row `q` where they enter Ω through a side, between the slice at
    /// `step` and the one before: a level set that is cut open there is hidden by what lies before the first slice.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the lattice")]
    fn enter(
        &self,
        h: &[f32],
        (step, q): (usize, f64),
        (lo, hi): (usize, usize),
        [most, least]: [&mut [f32]; 2],
        mixed: &mut Vec<f32>,
    ) {
        let [nu, nv, na] = self.layout.dims;
        let [sv, sa] = self.layout.stride;
        let [su, sq, sk] = self.source;
        let side = |x: f64, n: usize| x.clamp(0.0, (n - 1) as f64);
        let [u, v] = [side(su, nu), side(sq, nv)];
        // From beyond the first slice lines enter there.
        if u == su && v == sq || step == 0 && side(sk, na) != sk {
            return;
        }
        // Ratios, as in `march`, where the slice before and the one side are passed.
        let before = if step == 0 { 0.0 } else { (self.slice(step - 1) as f64 - sk) / self.depth };
        let row = if v == sq { 0.0 } else { (v - sq) / (q - sq) };
        let cell = |x: f64, n: usize| {
            let i = (x as usize).min(n - 2);
            (i, (x - i as f64) as f32)
        };
        let slices = |ratio: f64| cell(side(sk + self.depth * ratio, na), na);
        // f32::max and min pass over NaN.
        let mut take = |n: usize, x: f32| (most[n], least[n]) = (most[n].max(x), least[n].min(x));
        // The row as a whole, but for lines beyond the other sides still.
        if row > before {
            let (k, f) = slices(row);
            let at = k * sa + v as usize * sv;
            mix(mixed, [&h[at..][..nu], &h[at + sa..][..nu]], f);
            let p = |u: f64| (su + (u - su) / row - self.first[0] as f64).clamp(lo as f64, hi as f64);
            let u0 = (su + (self.first[0] as f64 - su) * row) as f32;
            let last = p((nu - 1) as f64).floor() as usize;
            for n in p(0.0).ceil() as usize..(last + 1).min(hi) {
                take(n, sample(mixed, [u0, row as f32], n));
            }
        }
        if u == su {
            return;
        }
        // The others one by one: those that are still outside where the row, or the slice before, is passed.
        let late = su + (u - su) / row.max(before) - self.first[0] as f64;
        let lines = if su < 0.0 {
            lo..(late.ceil().clamp(lo as f64, hi as f64) as usize)
        } else {
            (late.floor() + 1.0).clamp(lo as f64, hi as f64) as usize..hi
        };
        for n in lines {
            let ratio = (u - su) / (self.first[0] as f64 + n as f64 - su);
            let (j, g) = cell(side(sq + (q - sq) * ratio, nv), nv);
            let (k, f) = slices(ratio);
            let at = k * sa + j * sv + u as usize;
            let [near, far] = [at, at + sa].map(|at| h[at] + g * (h[at + sv] - h[at]));
            take(n, near + f * (far - near));
        }
    }
}

/// What is in one range and not in another.
fn without(range: &Range<usize>, other: &Range<usize>) -> impl Iterator<Item = usize> {
    let (start, end) = (other.start.min(range.end), other.end.max(range.start));
    (range.start..start).chain(end..range.end)
}

/// The row between two, `f` from the first.
fn mix(mixed: &mut Vec<f32>, [near, far]: [&[f32]; 2], f: f32) {
    mixed.clear();
    mixed.extend(near.iter().zip(far).map(|(a, b)| a + f * (b - a)));
}

/// The least range that holds two.
fn join(a: (usize, usize), b: (usize, usize)) -> (usize, usize) {
    (a.0.min(b.0), a.1.max(b.1))
}
