//! Fans of lines from a luminaire's point through every slice of the lattice: along each the running extrema of h tell which
//! samples see the point on their own level set.

use super::directions::Layout;
use super::grid::{Blocks, Geometry};
use super::simd::Isa;
use crate::flattened::Side;
use glam::DVec3;
use rayon::prelude::*;

/// A sample of a fan that lies in Ω; what it sees of its source on either side.
pub(super) const SAMPLED: u8 = 1;
pub(super) const LOWER: u8 = 2;
pub(super) const HIGHER: u8 = 4;

/// The lines from a point through the unit lattice of the farthest slice of one of the six pyramids around it.
struct Fan {
    layout: Layout,
    /// The source in (u, v, slice).
    source: [f64; 3],
    /// Slices from the source to the lattice's plane, with sign.
    depth: f64,
    /// First slice and their number, away from the source.
    slices: (usize, usize),
    /// First line and their number along u and v, numbered by where they meet the lattice's plane.
    first: [isize; 2],
    count: [usize; 2],
}

/// What the lines of a fan see: [row][slice][line].
type Seen = Vec<u8>;

impl Fan {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the lattice")]
    fn new(dims: [usize; 3], y: DVec3, axis: usize, up: bool) -> Option<Self> {
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
        let first = [0, 1].map(|x| (source[x] - depth.abs()).floor() as isize);
        let count = [0, 1].map(|x| ((source[x] + depth.abs()).ceil() as isize - first[x] + 1).unsigned_abs());
        Some(Self { layout, source, depth, slices, first, count })
    }

    /// Bytes of a row of lines.
    fn row(&self) -> usize {
        self.count[0] * self.slices.1
    }

    #[inline]
    fn slice(&self, step: usize) -> usize {
        if self.depth > 0.0 { self.slices.0 + step } else { self.slices.0 - step }
    }

    /// One row of lines, all slices. Where neither side could be lit nothing is read: h below the sweep hides nothing.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the lattice")]
    #[allow(clippy::too_many_arguments, reason = "one caller")]
    fn march(
        &self,
        isa: Isa,
        h: &[f32],
        awake: [Option<&Blocks>; 2],
        start: f32,
        row: usize,
        [most, least, mixed]: &mut [Vec<f32>; 3],
        out: &mut [u8],
    ) {
        let [nu, nv, _] = self.layout.dims;
        let [sv, sa] = self.layout.stride;
        let np = self.count[0];
        most.clear();
        least.clear();
        most.resize(np, start);
        least.resize(np, if start.is_finite() { start } else { f32::INFINITY });
        let q = (self.first[1] + row as isize) as f64;
        for (step, out) in out.chunks_exact_mut(np).enumerate() {
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
            let lo = p(n0 as f64).ceil().max(0.0) as usize;
            let hi = (p((n1 - 1) as f64).floor().min(np as f64 - 1.0) + 1.0).max(0.0) as usize;
            let u0 = (self.source[0] + (self.first[0] as f64 - self.source[0]) * ratio) as f32;
            let du = ratio as f32;
            if lo >= hi {
                continue;
            }
            // The row of lines lies between two rows of samples: mixed once, for near slices hold many lines per sample.
            let (i0, i1) =
                (((u0 + lo as f32 * du).max(0.0) as usize).min(nu - 2), ((u0 + hi as f32 * du) as usize + 2).min(nu));
            let (near, far) = (&h[k * sa + j * sv..][i0..i1], &h[k * sa + (j + 1) * sv..][i0..i1]);
            mixed.clear();
            mixed.extend(near.iter().zip(far).map(|(a, b)| a + fv * (b - a)));
            let place = [u0 + lo as f32 * du - i0 as f32, du];
            isa.march(mixed, place, &mut most[lo..hi], &mut least[lo..hi], &mut out[lo..hi]);
        }
    }

    /// The share of the four lines around local `x` that see the source at their own isovalue there: lower, higher side.
    #[inline]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the fan")]
    fn visibility(&self, seen: &Seen, x: [f64; 3]) -> Option<[f32; 2]> {
        let [u, v, a] = self.layout.axes;
        let inverse = self.depth / (x[a] - self.source[2]);
        let p = self.source[0] + (x[u] - self.source[0]) * inverse - self.first[0] as f64;
        let q = self.source[1] + (x[v] - self.source[1]) * inverse - self.first[1] as f64;
        let step = (x[a] as usize).abs_diff(self.slices.0);
        let (i, j) = ((p as usize).min(self.count[0] - 2), (q as usize).min(self.count[1] - 2));
        let (f, g) = ((p - i as f64) as f32, (q - j as f64) as f32);
        let at = |dj: usize| &seen[((j + dj) * self.slices.1 + step) * self.count[0] + i..][..2];
        let (near, far) = (at(0), at(1));
        let mut sum = [0f32; 3];
        let lines =
            [(near[0], (1.0 - f) * (1.0 - g)), (near[1], f * (1.0 - g)), (far[0], (1.0 - f) * g), (far[1], f * g)];
        for (seen, w) in lines {
            for (s, bit) in sum.iter_mut().zip([SAMPLED, LOWER, HIGHER]) {
                *s += if seen & bit != 0 { w } else { 0.0 };
            }
        }
        (sum[0] > 0.0).then(|| [sum[1] / sum[0], sum[2] / sum[0]])
    }
}

/// The six fans of a point, and what their lines see.
pub(super) struct Fans {
    source: DVec3,
    fans: [Option<Fan>; 6],
    seen: [Seen; 6],
}

impl Fans {
    /// Marches along all lines of the fans of local point `y`, where h is `start`, side by side: the rows of one fan alone are too few
    /// for threads to share well.
    pub(super) fn march((geometry, isa, sides): (&Geometry, Isa, &[Side]), y: DVec3, start: f32) -> Self {
        let fans: [Option<Fan>; 6] = std::array::from_fn(|f| Fan::new(geometry.dims, y, f % 3, f >= 3));
        // Of the widest fans most lines miss Ω: what they would see stays untouched.
        let mut seen = fans.each_ref().map(|fan| vec![0; fan.as_ref().map_or(0, |fan| fan.count[1] * fan.row())]);
        let mut rows = Vec::new();
        for (fan, seen) in fans.iter().zip(&mut seen) {
            let Some(fan) = fan else { continue };
            rows.extend(seen.chunks_exact_mut(fan.row()).enumerate().map(|(row, out)| (fan, row, out)));
        }
        rows.into_par_iter().with_max_len(8).for_each_init(
            || [const { Vec::new() }; 3],
            |scratch, (fan, row, out)| {
                let awake: [Option<&Blocks>; 2] =
                    std::array::from_fn(|s| Some(geometry.awake(&fan.layout, *sides.get(s)?)));
                fan.march(isa, geometry.h(&fan.layout), awake, start, row, scratch, out);
            },
        );
        Self { source: y, fans, seen }
    }

    /// The share of the four lines around local `x` that see the source at their own isovalue there: lower, higher side. `None`
    /// where no line passes.
    #[inline(always)]
    pub(super) fn visibility(&self, x: [f64; 3]) -> Option<[f32; 2]> {
        let y = self.source;
        let [a, b, c] = [(x[0] - y.x).abs(), (x[1] - y.y).abs(), (x[2] - y.z).abs()];
        let axis = if c >= a && c >= b { 2 } else { usize::from(b >= a) };
        let f = axis + if x[axis] > y[axis] { 3 } else { 0 };
        self.fans[f].as_ref()?.visibility(&self.seen[f], x)
    }
}

/// The least range that holds two.
fn join(a: (usize, usize), b: (usize, usize)) -> (usize, usize) {
    (a.0.min(b.0), a.1.max(b.1))
}

/// What lines see that meet u = place\[0\] + n · place\[1\] (line n) in a row of samples; takes the row into their extrema.
#[inline(always)]
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the row")]
pub(super) fn march_row(row: &[f32], [u0, du]: [f32; 2], most: &mut [f32], least: &mut [f32], out: &mut [u8]) {
    let last = row.len() - 2;
    for (n, ((most, least), out)) in most.iter_mut().zip(least).zip(out).enumerate() {
        let u = (u0 + n as f32 * du).max(0.0);
        let i = (u as usize).min(last);
        let (a, b) = (row[i], row[i + 1]);
        let x = a + (u - i as f32) * (b - a);
        *out = if x.is_nan() { 0 } else { u8::from(x > *most) * LOWER + u8::from(x <= *least) * HIGHER + SAMPLED };
        // f32::max and min pass over NaN.
        *most = most.max(x);
        *least = least.min(x);
    }
}
