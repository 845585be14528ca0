//! What the samples of sixteen lines meet: the next value ≥ their own, and the radiance there.

#![allow(clippy::needless_range_loop, reason = "a channel indexes several planes at once")]

use super::half::{Half4, colour, decode};
use super::pack::{Cut, LANES, OUTSIDE, Pack};
use crate::isovalue_axis::IsovalueAxis;

/// What rays meet.
#[derive(Clone, Copy)]
pub(super) struct Light<'a> {
    /// B of the nodes.
    pub b: &'a [Half4],
    /// B of the other side; nothing if that is dark.
    pub back: &'a [Half4],
    /// What stands at ends, as [`super::flats::Flats`] packs it, and its isovalues.
    pub flats: &'a [Half4],
    pub isovalues: usize,
    /// Where these stand.
    pub axis: &'a IsovalueAxis,
    /// How far behind a place of the ends lies what the other side of the level sets sees there.
    pub across: isize,
}

impl Light<'_> {
    /// What stands at a place of the ends on isovalue `c`.
    #[inline(always)]
    pub(super) fn end(&self, place: usize, c: f32) -> [f32; 3] {
        let (i, f) = isovalue(self.axis, self.isovalues, c);
        let (a, b) = (self.flats[place + i], self.flats[place + i + 1]);
        std::array::from_fn(|c| (1.0 - f) * decode(a[c]) + f * decode(b[c]))
    }

    /// The same as the other side of the level sets sees it; black, which comes first, is black.
    pub(super) fn other_end(&self, place: usize, c: f32) -> [f32; 3] {
        self.end(if place == 0 { 0 } else { place.wrapping_add_signed(self.across) }, c)
    }
}

/// How to scan.
#[derive(Clone, Copy, Debug)]
pub(super) struct ScanRule {
    /// The next value must be greater, not only as great: the higher side.
    pub strict: bool,
    /// The sign h was read with.
    pub sign: f32,
    /// Caps close Ω's faces, black from within.
    pub capped: bool,
}

impl Pack {
    /// For every sample, the radiance that its ray meets which leaves downhill: B where h is first back at the sample's
    /// value, or what stands at the end. \[BSV93: all nearest greater values, one line per lane\]
    ///
    /// Uphill the ray of the same line runs inside the solid. Whether downhill is +τ or −τ is decided by the samples
    /// beside it, as the receiver normal is. Writes slice k to `out` at k · width + start.
    pub(super) fn scan(&mut self, rule: ScanRule, light: Light, out: &mut [Vec<f32>], place: (usize, usize)) {
        self.link(rule, true);
        self.link(rule, false);
        self.look(rule, light, out, place);
    }

    /// Finds for every sample the next value ≥ its own towards +τ (`forward`) or −τ; with `strict` it must be greater.
    #[allow(clippy::cast_possible_truncation, reason = "places in a pack")]
    fn link(&mut self, rule: ScanRule, forward: bool) {
        let default: [u32; LANES] = std::array::from_fn(|lane| self.last(lane, forward));
        let (mut at, mut top) = (default, [f32::INFINITY; LANES]);
        let d = usize::from(!forward);
        for step in 0..self.awake.len() {
            let row = self.awake[if forward { self.awake.len() - 1 - step } else { step }] as usize;
            self.close(row, forward, |lane, place| (at[lane], top[lane]) = (place, f32::INFINITY));
            for lane in 0..LANES {
                let value = self.h[row][lane];
                if value == OUTSIDE {
                    (at[lane], top[lane]) = (default[lane], f32::INFINITY);
                    continue;
                }
                let (mut j, mut t) = (at[lane], top[lane]);
                while t < value || (rule.strict && t == value) {
                    t = self.h_next[d].as_flattened()[j as usize];
                    j = self.next[d].as_flattened()[j as usize];
                }
                self.next[d][row][lane] = j;
                self.h_next[d][row][lane] = t;
                (at[lane], top[lane]) = ((row * LANES + lane) as u32, value);
            }
        }
    }

    /// Calls `close` with the lanes of which cuts close what lies beyond them when a scan comes to `row`, and the place
    /// of what they show. Rows between that were not read count.
    #[inline(always)]
    pub(super) fn close(&self, row: usize, forward: bool, mut close: impl FnMut(usize, u32)) {
        if self.cuts.is_empty() {
            return;
        }
        let position = self.awake.binary_search(&u32::try_from(row).expect("a row")).expect("a row that was read");
        // Cuts after row r lie between r and r + 1; the nearest comes last.
        let (from, to) = if forward {
            (row, self.awake.get(position + 1).map_or(usize::MAX, |r| *r as usize))
        } else {
            (position.checked_sub(1).map_or(0, |p| self.awake[p] as usize), row)
        };
        let mut each = |cut: &Cut| {
            if (from..to).contains(&cut.row) {
                close(cut.lane, self.ends() as u32 + cut.places[usize::from(!forward)]);
            }
        };
        if forward {
            self.cuts.iter().rev().for_each(&mut each);
        } else {
            self.cuts.iter().for_each(&mut each);
        }
    }

    /// Reads the radiance that the samples' downhill rays meet.
    fn look(&self, rule: ScanRule, light: Light, out: &mut [Vec<f32>], (width, start): (usize, usize)) {
        let rows = self.h.len();
        for &row in &self.awake {
            let row = row as usize;
            if row == 0 || row == rows - 1 {
                continue;
            }
            for lane in 0..LANES {
                let value = self.h[row][lane];
                let mut rgb = [0f32; 3];
                if value != OUTSIDE {
                    // Beyond the first and the last slice there is nothing to compare with.
                    let forward = self.h[(row + 1).min(rows - 2)][lane] < self.h[(row - 1).max(1)][lane];
                    rgb = match self.first((row, lane), forward) {
                        Ok(node) => colour(light.b[node as usize]),
                        Err(place) => light.end(place, rule.sign * value),
                    };
                }
                for c in 0..3 {
                    out[c][(row - 1) * width + start + lane] = rgb[c];
                }
            }
        }
    }

    /// The node whose B stands for what the ray of a sample meets first, or the place of the end that it meets.
    #[inline(always)]
    pub(super) fn first(&self, (row, lane): (usize, usize), forward: bool) -> Result<u32, usize> {
        let d = usize::from(!forward);
        let (j, t) = (self.next[d][row][lane] as usize, self.h_next[d][row][lane]);
        if j >= self.ends() {
            return Err(j - self.ends());
        }
        let near = if forward { j - LANES } else { j + LANES };
        let h0 = self.h.as_flattened()[near];
        // The nearer of the two samples around the hit.
        let first = (self.h[row][lane] - h0) < 0.5 * (t - h0);
        Ok(self.node.as_flattened()[if first { near } else { j }])
    }
}

/// Between which of n ≥ 2 texels of an axis isovalue c stands, and how far: linear between texel centres.
#[inline]
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the texture")]
fn isovalue(axis: &IsovalueAxis, n: usize, c: f32) -> (usize, f32) {
    let x = (axis.place(c) * n as f32 - 0.5).max(0.0).min((n - 1) as f32);
    let i = (x as usize).min(n - 2);
    (i, x - i as f32)
}
