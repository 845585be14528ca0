//! Sixteen neighbouring lines in lock-step: h and B along them, what they end on, and the next value ≥ h of every sample.

#![allow(clippy::needless_range_loop, reason = "a channel indexes several planes at once")]

use super::directions::Shear;
use super::flats::{Ends, Flats, Stop, fill_column};
use super::grid::Planes;

/// Lines in a pack.
pub(super) const LANES: usize = 16;
/// One number for each line of a pack.
pub(super) type Lanes = [f32; LANES];
/// h where a line is outside Ω.
pub(super) const OUTSIDE: f32 = f32::NEG_INFINITY;

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

    /// τ at which line (p, q) enters and leaves Ω; empty if it misses.
    pub(super) fn span(&self, p: f64, q: f64) -> [f64; 2] {
        let [nu, nv, na] = self.shear.layout.dims;
        let (mut from, mut to) = (0.0, na as f64 - 1.0);
        for (a, (number, n)) in [(p, nu), (q, nv)].into_iter().enumerate() {
            let (x, s, far) = (number + self.shear.offset[a], self.shear.slope[a], n as f64 - 1.0);
            if s == 0.0 {
                if !(x >= 0.0 && x <= far) {
                    return [1.0, 0.0];
                }
                continue;
            }
            let (t0, t1) = (-x / s, (far - x) / s);
            from = f64::max(from, t0.min(t1));
            to = f64::min(to, t0.max(t1));
        }
        [from, to]
    }
}

/// Numbers at four samples and their weights: any point of a face of a cell.
#[derive(Clone, Copy)]
struct Taps {
    at: [isize; 4],
    weight: [f32; 4],
}

impl Taps {
    #[inline(always)]
    fn one(&self, plane: &[f32], lane: isize) -> f32 {
        let s = |t: usize| self.weight[t] * plane[(self.at[t] + lane).unsigned_abs()];
        (s(0) + s(1)) + (s(2) + s(3))
    }

    /// Lanes `lo..hi` of a pack that starts at memory position `at + 0`.
    #[inline(always)]
    fn many(&self, plane: &[f32], lo: usize, hi: usize, out: &mut Lanes) {
        if lo == 0 && hi == LANES {
            let lanes = |t: usize| -> &[f32; LANES] {
                plane[self.at[t].unsigned_abs()..][..LANES].try_into().expect("sixteen lanes")
            };
            let (a, b, c, d) = (lanes(0), lanes(1), lanes(2), lanes(3));
            let w = self.weight;
            for l in 0..LANES {
                out[l] = (w[0] * a[l] + w[1] * b[l]) + (w[2] * c[l] + w[3] * d[l]);
            }
        } else {
            for (l, o) in out.iter_mut().enumerate().take(hi).skip(lo) {
                *o = self.one(plane, l as isize);
            }
        }
    }
}

/// A cut of one lane by a luminaire inside Ω: after which row, and what it shows to lines from before and behind.
#[derive(Clone, Copy)]
pub(super) struct Cut {
    pub row: usize,
    pub lane: usize,
    pub slots: [u32; 2],
}

/// How to scan.
#[derive(Clone, Copy, Debug)]
pub(super) struct Way {
    /// Rays run towards +τ.
    pub forward: bool,
    /// The next value must be greater, not only as great: the higher side.
    pub strict: bool,
    /// The sign h was read with.
    pub sign: f32,
}

/// The samples of sixteen lines. Row 0 and the last hold nothing but entry and exit points; row k + 1 is slice k. A
/// line's entry and exit through Ω's sides stand in the rows before its first and after its last slice.
pub(super) struct Pack {
    pub h: Vec<Lanes>,
    pub b: [Vec<Lanes>; 3],
    pub next: Vec<[u32; LANES]>,
    pub h_next: Vec<Lanes>,
    /// Rows that hold samples.
    pub rows: (usize, usize),
    pub cuts: Vec<Cut>,
    /// Radiance of ends over isovalues: slot = lane for + ends, 16 + lane for − ends, then cuts.
    pub columns: Vec<f32>,
    pub isovalues: usize,
    pub dark: bool,
    scratch: Vec<[Stop; 2]>,
}

impl Pack {
    pub(super) fn new(slices: usize, flats: &Flats) -> Self {
        Self { dark: flats.none(), ..Self::with_rows(slices + 2, flats.isovalues) }
    }

    /// Nothing, in so many rows, with ends that shine over `isovalues`.
    pub(super) fn with_rows(rows: usize, isovalues: usize) -> Self {
        let zero = || vec![[0.0; LANES]; rows];
        Self {
            h: vec![[OUTSIDE; LANES]; rows],
            b: [zero(), zero(), zero()],
            next: vec![[0; LANES]; rows],
            h_next: zero(),
            rows: (0, 0),
            cuts: Vec::new(),
            columns: vec![0.0; 2 * LANES * 3 * isovalues],
            isovalues,
            dark: false,
            scratch: Vec::new(),
        }
    }

    /// Reads h and B along lines (first + lane, q). Returns whether any of them meets Ω.
    #[inline(always)]
    pub(super) fn read(&mut self, plan: &Plan, h: &[f32], b: &Planes, first: isize, q: isize) -> bool {
        let [nu, nv, na] = plan.shear.layout.dims;
        let [sv, sa] = plan.shear.layout.stride;
        let mut range = (usize::MAX, 0);
        let mut before: Option<(usize, usize)> = None;
        self.h[0] = [OUTSIDE; LANES];
        self.h[na + 1] = [OUTSIDE; LANES];
        for k in 0..na {
            let (uk, fu) = plan.shift[0][k];
            let (vk, fv) = plan.shift[1][k];
            let (i, j) = (first + uk, q + vk);
            // Lanes whose cell lies in Ω.
            #[allow(clippy::cast_sign_loss, reason = "clamped")]
            let mut lanes = ((-i).clamp(0, 16) as usize, (nu as isize - 1 - i).clamp(0, 16) as usize);
            if j < 0 || j > nv as isize - 2 || lanes.0 >= lanes.1 {
                lanes = (0, 0);
            }
            let row = k + 1;
            let (lo, hi) = lanes;
            if lo < hi {
                let at = k as isize * sa as isize + j * sv as isize + i;
                let taps = Taps {
                    at: [at, at + 1, at + sv as isize, at + sv as isize + 1],
                    weight: [(1.0 - fu) * (1.0 - fv), fu * (1.0 - fv), (1.0 - fu) * fv, fu * fv],
                };
                // Whole packs wherever memory allows: lanes outside Ω read a neighbouring row and are blanked.
                let whole = at >= 0 && at.unsigned_abs() + sv + 1 + LANES <= h.len();
                let (l0, l1) = if whole { (0, LANES) } else { (lo, hi) };
                let line = &mut self.h[row];
                Taps { weight: taps.weight.map(|w| w * plan.sign), ..taps }.many(h, l0, l1, line);
                for (l, x) in line.iter_mut().enumerate() {
                    *x = if lo <= l && l < hi { *x } else { OUTSIDE };
                }
                for c in 0..3 {
                    taps.many(&b[c], l0, l1, &mut self.b[c][row]);
                }
                range = (range.0.min(row), row);
            } else {
                self.h[row] = [OUTSIDE; LANES];
            }
            // Lanes that entered through a side get their entry point in the row before, those that left theirs here.
            let old = before.unwrap_or((0, 0));
            if lanes != old && k > 0 {
                for lane in 0..LANES {
                    let (was, is) = (old.0 <= lane && lane < old.1, lo <= lane && lane < hi);
                    if is && !was {
                        self.side(plan, h, b, (first + lane as isize, q), lane, k, false);
                        range.0 = range.0.min(row - 1);
                    } else if was && !is {
                        self.side(plan, h, b, (first + lane as isize, q), lane, k - 1, true);
                        range.1 = range.1.max(row);
                    }
                }
            }
            before = Some(lanes);
        }
        self.rows = if range.0 == usize::MAX { (0, 0) } else { (range.0, range.1 + 1) };
        self.rows.1 > 0
    }

    /// Adds the point where a line whose first or last slice is `k` meets Ω's side.
    #[allow(clippy::too_many_arguments, reason = "one caller")]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the lattice")]
    fn side(&mut self, plan: &Plan, h: &[f32], b: &Planes, pq: (isize, isize), lane: usize, k: usize, leaves: bool) {
        let [nu, nv, na] = plan.shear.layout.dims;
        let [sv, sa] = plan.shear.layout.stride;
        let span = plan.span(pq.0 as f64, pq.1 as f64);
        let near = k as f64 + if leaves { 1.0 } else { -1.0 };
        let tau = (if leaves { span[1] } else { span[0] }).clamp(near.min(k as f64), near.max(k as f64));
        let [x, y] = [(pq.0, nu, 0), (pq.1, nv, 1)].map(|(number, n, a)| {
            (number as f64 + plan.shear.offset[a] + plan.shear.slope[a] * tau).clamp(0.0, n as f64 - 1.0)
        });
        let cell = |x: f64, n: usize| (x as usize).min(n - 2);
        let (i, j, l) = (cell(x, nu), cell(y, nv), cell(tau.clamp(0.0, na as f64 - 1.0), na));
        let f = [x - i as f64, y - j as f64, tau - l as f64].map(|f| f as f32);
        let at = l * sa + j * sv + i;
        let value = |plane: &[f32]| {
            let lerp = |t: f32, a: f32, b: f32| a + t * (b - a);
            let edge = |o: usize| lerp(f[0], plane[o], plane[o + 1]);
            let face = |o: usize| lerp(f[1], edge(o), edge(o + sv));
            lerp(f[2], face(at), face(at + sa))
        };
        let row = if leaves { k + 2 } else { k };
        self.h[row][lane] = plan.sign * value(h);
        for c in 0..3 {
            self.b[c][row][lane] = value(&b[c]);
        }
    }

    /// Finds what the lines end on and reads the radiance there. `first` and `q` as in [`Pack::read`].
    #[inline(always)]
    pub(super) fn end(&mut self, plan: &Plan, ends: &Ends, flats: &Flats, first: isize, q: isize) {
        self.cuts.clear();
        let n = 3 * self.isovalues;
        if self.dark && !ends.cut() {
            return;
        }
        self.columns.truncate(2 * LANES * n);
        for lane in 0..LANES {
            let (p, q) = ((first + lane as isize) as f64, q as f64);
            let span = plan.span(p, q);
            if !(span[0] <= span[1]) {
                continue;
            }
            for (slot, from, forward) in [(lane, span[1], true), (LANES + lane, span[0], false)] {
                let stop = ends.stop(p, q, from, forward, None);
                fill_column(flats, stop, &mut self.columns[slot * n..][..n]);
            }
            if ends.cut() {
                let mut scratch = std::mem::take(&mut self.scratch);
                ends.cuts(p, q, span[0], span[1], &mut scratch);
                for &[before, behind] in &scratch {
                    let slot = self.columns.len() / n;
                    self.columns.resize((slot + 2) * n, 0.0);
                    fill_column(flats, Some(before), &mut self.columns[slot * n..][..n]);
                    fill_column(flats, Some(behind), &mut self.columns[(slot + 1) * n..][..n]);
                    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a row of the pack")]
                    let (row, slot) = (before.tau.floor() as usize + 1, slot as u32);
                    self.cuts.push(Cut { row, lane, slots: [slot, slot + 1] });
                }
                self.scratch = scratch;
            }
        }
    }

    /// For every sample, the radiance its ray towards +τ (`forward`) or −τ meets: B where h is first back at the sample's
    /// value, or what stands at the end. \[BSV93: all nearest greater values, one line per lane\]
    ///
    /// Writes slice k to `out` at k · width + start. With `strict` the next value must be greater.
    #[allow(clippy::cast_possible_truncation, reason = "rows of a pack")]
    pub(super) fn scan(&mut self, way: Way, out: &mut [Vec<f32>], (width, start): (usize, usize)) {
        let Way { forward, strict, sign } = way;
        let rows = self.h.len();
        let end = rows as u32;
        let default = |lane: usize| end + (lane + if forward { 0 } else { LANES }) as u32;
        let mut at: [u32; LANES] = std::array::from_fn(default);
        let mut top = [f32::INFINITY; LANES];
        let (from, to) = self.rows;
        for step in 0..to - from {
            let row = if forward { to - 1 - step } else { from + step };
            // Cuts behind this row close what lies beyond them; the nearest comes last.
            let cut_row = if forward { row } else { row.wrapping_sub(1) };
            let mut reset = |cut: &Cut| {
                if cut.row == cut_row {
                    at[cut.lane] = end + cut.slots[usize::from(!forward)];
                    top[cut.lane] = f32::INFINITY;
                }
            };
            if forward {
                self.cuts.iter().rev().for_each(&mut reset);
            } else {
                self.cuts.iter().for_each(&mut reset);
            }
            let h = self.h[row];
            let mut light = [[0f32; LANES]; 3];
            for lane in 0..LANES {
                let value = h[lane];
                if value == OUTSIDE {
                    at[lane] = default(lane);
                    top[lane] = f32::INFINITY;
                    continue;
                }
                if value.is_nan() {
                    continue;
                }
                let (mut j, mut t) = (at[lane], top[lane]);
                while t < value || (strict && t == value) {
                    t = self.h_next[j as usize][lane];
                    j = self.next[j as usize][lane];
                }
                self.next[row][lane] = j;
                self.h_next[row][lane] = t;
                (at[lane], top[lane]) = (row as u32, value);
                if j >= end {
                    if !self.dark {
                        let column = &self.columns[(j - end) as usize * 3 * self.isovalues..][..3 * self.isovalues];
                        let rgb = at_isovalue(column, self.isovalues, sign * value);
                        (0..3).for_each(|c| light[c][lane] = rgb[c]);
                    }
                } else {
                    let j = j as usize;
                    let before = if forward { j - 1 } else { j + 1 };
                    let f = (value - self.h[before][lane]) / (t - self.h[before][lane]);
                    // Also where the sample before is missing (NaN): then the later one counts alone.
                    let f = if f < 1.0 { f.max(0.0) } else { 1.0 };
                    for c in 0..3 {
                        let b = &self.b[c];
                        light[c][lane] = (1.0 - f) * b[before][lane] + f * b[j][lane];
                    }
                }
            }
            if row > 0 && row < rows - 1 {
                for c in 0..3 {
                    out[c][(row - 1) * width + start..][..LANES].copy_from_slice(&light[c]);
                }
            }
        }
    }
}

/// A column of radiance at isovalue c: linear between texel centres.
#[inline]
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the texture")]
fn at_isovalue(column: &[f32], n: usize, c: f32) -> [f32; 3] {
    let x = (c * n as f32 - 0.5).clamp(0.0, (n - 1) as f32);
    let i = (x as usize).min(n.saturating_sub(2));
    let f = x - i as f32;
    let next = (i + 1).min(n - 1);
    std::array::from_fn(|ch| (1.0 - f) * column[ch * n + i] + f * column[ch * n + next])
}
