//! What lines bring to walls and caps: from a wall's point one line sees every isovalue at once, a staircase of the
//! running maximum of h.

use super::directions::Layout;
use super::ends::LineEnds;
use super::flats::{Flats, Stop, below, fill_column, shapes, sinks};
use super::gaps::Crossing;
use super::gather::{Bounce, Pass};
use super::half::{Half4, colour, decode};
use super::incoming::Arrivals;
use super::pack::{LANES, OUTSIDE, Pack, Plan};
use crate::flattened::Side;
use crate::rng::{Rng, Stage};
use crate::scene::Scene;
use crate::volume::Lattice;
use glam::DVec3;

/// Lines per texel edge that report to walls. Each reports to four texels, so that one reaches every texel from every
/// direction; half of one showed as a weave on the walls.
const LINES_PER_TEXEL: f64 = 1.0;

/// Of lines near Ω at least one in so many reports, however large texels are: what is seen there is not even.
const MOST_STRIDE: f64 = 8.0;

/// About so many lines of a family report at most for the sake of texels smaller than others: what they bring is kept
/// until it is told to the walls.
const MOST_REPORTING: f64 = 131_072.0;

/// Strides, in lines along u and v, of those that report near Ω and past it, to texels of these areas, of a family of
/// so many lines across slices of `axis`. Walls along that axis see lines as far apart as slices are.
fn strides(lattice: &Lattice, axis: usize, sinks: impl Iterator<Item = f64>, family: f64) -> [[f64; 2]; 2] {
    let spacing = lattice.spacing();
    let voxels = Layout::new(lattice.dims(), axis).axes.map(|a| LINES_PER_TEXEL * spacing[a].max(spacing[axis]));
    let (least, most) = sinks.fold((f64::INFINITY, 0.0f64), |(lo, hi), area| (lo.min(area), hi.max(area)));
    let many = (family / MOST_REPORTING).sqrt().ceil();
    let lines = [voxels[0], voxels[1]].map(|voxel| {
        let [least, most] = [least, most].map(|area| (area.sqrt() / voxel).floor().max(1.0));
        least.max(many.min(most))
    });
    // Two lines per texel edge where texels are large: one has 2 % more error.
    let past = |lines: f64| lines.min(MOST_STRIDE.max(0.5 * lines).min(f64::from(1 << 20)));
    [lines.map(|lines| lines.min(MOST_STRIDE)), lines.map(past)]
}

/// Bytes of what the lines of two families bring to walls of so many texels across, about at most: one is told to the
/// walls while the next is walked.
pub(crate) fn reports(scene: &Scene, across: usize, isovalues: usize) -> f64 {
    let [lo, hi] = scene.local_bounds();
    let far = scene.lattice().far();
    // Lines through a box, along the axis of most that report, at slopes of a half.
    let lines = |e: DVec3, c: usize| (e[(c + 1) % 3] + 0.5 * e[c]) * (e[(c + 2) % 3] + 0.5 * e[c]);
    let areas = || {
        shapes(scene, across).flatten().map(|(flat, dims)| flat.area() / sinks(dims).iter().product::<usize>() as f64)
    };
    let reporting = |c: usize| {
        let [volume, all] = [far, hi - lo].map(|e| lines(e + 1.0, c));
        let [near, past] = strides(scene.lattice(), c, areas(), all).map(|[u, v]| u * v);
        volume / near + (all - volume) / past
    };
    let reporting = (0..3).map(reporting).fold(0.0, f64::max);
    // At either end of a line may be a wall; RGB of each isovalue in f32, and where it ends.
    let ends = areas().count().min(2) as f64;
    2.0 * reporting * ends * (12 * isovalues + 40) as f64
}

/// A line that meets Ω.
#[derive(Clone, Copy)]
struct SampledLine<'a> {
    pack: &'a Pack,
    lane: usize,
    /// B of this side and the other.
    b: [&'a [Half4]; 2],
    /// τ where it enters Ω and leaves it.
    span: [f64; 2],
    /// Its place among the family's lines along u and v.
    pq: (f64, f64),
}

impl SampledLine<'_> {
    /// Whether Ω lies between two places of it.
    fn passes(&self, from: f64, to: f64) -> bool {
        from.min(to) < self.span[1] + 1e-6 && from.max(to) > self.span[0] - 1e-6
    }
}

/// What is seen along a line from one τ towards another.
#[derive(Clone, Copy)]
struct View<'a> {
    line: SampledLine<'a>,
    from: f64,
    to: f64,
}

impl View<'_> {
    fn forward(&self) -> bool {
        self.to > self.from
    }

    /// τ where it enters Ω.
    fn entry(&self) -> f64 {
        self.line.span[usize::from(!self.forward())]
    }

    fn h(&self, row: usize) -> f32 {
        self.line.pack.h[row][self.line.lane]
    }

    fn node(&self, row: usize) -> usize {
        self.line.pack.node[row][self.line.lane] as usize
    }

    /// The rows of the pack that were read, in the order they are seen in: slice k is row k + 1, and the entry and exit
    /// rows belong to ends outside Ω.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to rows")]
    #[inline(always)]
    fn rows(&self) -> impl Iterator<Item = usize> {
        let Self { line: SampledLine { pack, span, .. }, from, to } = *self;
        let forward = self.forward();
        let bound = |tau: f64, up: bool| -> usize {
            if tau <= span[0] + 1e-6 {
                0
            } else if tau >= span[1] - 1e-6 {
                pack.h.len()
            } else {
                (if up { tau.floor() + 2.0 } else { tau.ceil() + 1.0 }) as usize
            }
        };
        let (near, far) = if forward { (from, to) } else { (to, from) };
        let (lo, hi) = (bound(near, true), bound(far, false));
        let count = pack.awake.len();
        let row = move |step: usize| pack.awake[if forward { step } else { count - 1 - step }] as usize;
        (0..count).map(row).filter(move |row| (lo..hi).contains(row))
    }
}

/// Which lines report: every so many along u and v, from `phase` on; none with strides of 0.
#[derive(Clone, Copy)]
struct Reporting {
    strides: [isize; 2],
    phase: [isize; 2],
    weight: f32,
}

impl Reporting {
    #[allow(clippy::cast_possible_truncation, reason = "below the stride, and a weight")]
    fn new(strides: [isize; 2], phase: [f64; 2], line: f64) -> Self {
        let phase = [0, 1].map(|a| (phase[a] * strides[a] as f64) as isize);
        Self { strides, phase, weight: (line * (strides[0] * strides[1]) as f64) as f32 }
    }

    /// Those of the rows, or with `axis` 0 of the lines of a row, from one to another; none if that is before it.
    fn along(&self, axis: usize, (first, last): (isize, isize)) -> impl Iterator<Item = isize> + use<> {
        let stride = self.strides[axis].max(1);
        let any = self.strides[axis] > 0 && first <= last;
        let start = if any { first + (self.phase[axis] - first).rem_euclid(stride) } else { 0 };
        (start..=if any { last } else { -1 }).step_by(stride.unsigned_abs())
    }

    fn row(&self, q: isize) -> bool {
        self.strides[1] > 0 && (q - self.phase[1]).rem_euclid(self.strides[1]) == 0
    }
}

/// The walls' part of one family of lines.
pub(super) struct Walls<'a> {
    plan: &'a Plan,
    ends: &'a LineEnds,
    flats: &'a Flats,
    /// Rows of lines that meet the box.
    rows: (isize, isize),
    columns: (isize, isize),
    /// Lines near Ω report, and …
    near: Reporting,
    /// … those that surely miss it, of which there may be many more than texels.
    past: Reporting,
    capped: bool,
    /// Whether all isovalues of lines without samples are this side's.
    primary: bool,
    /// Whether the box is wider than Ω, so that lines may miss Ω.
    margin: bool,
    caps: u32,
    /// What packed radiance is multiplied by.
    unit: f32,
}

impl<'a> Walls<'a> {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a few thousand lines")]
    pub(super) fn new(pass: &Pass, bounce: &Bounce<'a>, side: Side, plan: &'a Plan, ends: &'a LineEnds) -> Self {
        let (shear, flats) = (&plan.shear, bounce.flats);
        let [lo, hi] = pass.scene.local_bounds();
        let margin = pass.scene.has_margin();
        let axes = shear.layout.axes;
        // Lines that meet the box: bounds of p over its corners.
        let range = |a: usize| {
            let slope = shear.slope[a];
            let ends = [lo[axes[2]], hi[axes[2]]].map(|t| slope * t);
            let (least, most) = (ends[0].min(ends[1]), ends[0].max(ends[1]));
            let offset = shear.offset[a];
            ((lo[axes[a]] - most - offset).floor() as isize, (hi[axes[a]] - least - offset).ceil() as isize)
        };
        let mut rng =
            Rng::stream(shear.offset[0].to_bits() ^ shear.offset[1].to_bits().rotate_left(32), Stage::Sweep, 0);
        let phase = [0, 1].map(|_| rng.unit());
        let none = flats.none();
        // Only ratios of weights count.
        let area = shear.area / pass.scene.lattice().unit().powi(2);
        let line = 4.0 * std::f64::consts::PI / (2 * bounce.lines.len()) as f64 * area;
        let every = |strides: [f64; 2]| Reporting::new(strides.map(|s| if none { 0 } else { s as isize }), phase, line);
        let (rows, columns) = (range(1), range(0));
        let [across, along] = [rows, columns].map(|(least, most)| (most - least + 1) as f64);
        let areas = flats.textures.iter().flatten().map(|t| t.sink_area);
        let [near, past] = strides(pass.scene.lattice(), axes[2], areas, across * along);
        Self {
            plan,
            ends,
            flats,
            rows: if margin && !none { rows } else { (isize::MAX, isize::MIN) },
            columns,
            near: every(near),
            past: every(past),
            capped: pass.scene.is_capped(),
            primary: side == pass.sides[0],
            margin,
            caps: pass.scene.polygons().len() as u32,
            unit: 1.0 / bounce.light.unit,
        }
    }

    /// The rows below and above those from `first` to `last` in which lines report.
    pub(super) fn rows_beside(&self, (first, last): (isize, isize)) -> [Vec<isize>; 2] {
        let (least, most) = self.rows;
        [(least, most.min(first - 1)), (least.max(last + 1), most)].map(|range| self.past.along(1, range).collect())
    }

    /// Reports of lines (first + lane, q), whose samples are in `pack`, with B of this side and the other.
    #[inline(always)]
    pub(super) fn through(&self, pack: &Pack, b: [&[Half4]; 2], first: isize, q: isize, out: &mut Arrivals) {
        if !self.near.row(q) {
            return;
        }
        for p in self.near.along(0, (first, first + LANES as isize - 1)) {
            let lane = (p - first).unsigned_abs();
            let span = pack.spans.map(|tau| tau[lane]);
            // Lines through a corner of Ω that no slice cuts have no samples.
            if span[0].ceil() <= span[1].floor() {
                let line = SampledLine { pack, lane, b, span, pq: (p as f64, q as f64) };
                self.line(Some(line), (p, q), self.near.weight, out);
                if self.capped && self.plan.sign > 0.0 {
                    self.caps(line, out);
                }
            } else if self.margin {
                self.line(None, (p, q), self.near.weight, out);
            }
        }
    }

    /// Reports of the other lines of row q: those that miss Ω.
    pub(super) fn past(&self, q: isize, within: bool, out: &mut Arrivals) {
        if !self.margin || !self.past.row(q) {
            return;
        }
        let packs = self.plan.first[0]..self.plan.first[0] + self.plan.width as isize;
        for p in self.past.along(0, self.columns).filter(|p| !(within && packs.contains(p))) {
            self.line(None, (p, q), self.past.weight, out);
        }
    }

    /// What every front on one line sees along it.
    #[inline(always)]
    fn line(&self, sampled: Option<SampledLine>, (p, q): (isize, isize), weight: f32, out: &mut Arrivals) {
        let nc = self.flats.isovalues;
        let (pf, qf) = (p as f64, q as f64);
        for (wall, forward) in self.ends.fronts(pf, qf) {
            let Some(flat) = wall.flat else { continue };
            let next = self.ends.stop(pf, qf, wall.tau, forward, Some(wall.polygon));
            // What is covered shows to nobody: a texel is the mean of the rest.
            if next.is_some_and(|n| n.covers == Some(wall.polygon)) {
                continue;
            }
            let reach = next.map_or(if forward { f64::INFINITY } else { f64::NEG_INFINITY }, |s| s.tau);
            let values = out.room(nc);
            fill_column(self.flats, next, values);
            let range = match sampled {
                Some(line) if line.passes(wall.tau, reach) => {
                    let view = View { line, from: wall.tau, to: reach };
                    if line.pack.gapped >> line.lane & 1 == 1 {
                        self.staircase_with_gaps(view, next, values)
                    } else {
                        self.staircase(view, values)
                    }
                }
                _ if self.primary => (0, nc),
                _ => (0, 0),
            };
            out.push((flat, wall.uv), weight, nc, range);
        }
    }

    /// Replaces in `values` (what the far end shows) the isovalues that meet a level set first. Returns the isovalues
    /// that lie on this side where the view begins.
    #[inline(always)]
    fn staircase(&self, view: View, values: &mut [f32]) -> (usize, usize) {
        let nc = self.flats.isovalues;
        let [b, _] = view.line.b;
        let higher = self.plan.sign < 0.0;
        let ordinal = |t: usize| self.ordinal(t);
        let height = |t: usize| self.height(t);
        let mut t = 0;
        let mut first = None;
        let mut before: Option<(usize, f32)> = None;
        // Rows that were not read hold nothing at these isovalues.
        for row in view.rows() {
            let h = view.h(row);
            if h == OUTSIDE {
                continue;
            }
            match before {
                None => {
                    while t < nc && height(t) <= h {
                        t += 1;
                    }
                    first = Some(t);
                    if self.capped {
                        self.cap(view, t, values);
                    }
                }
                Some((old, h_old)) => {
                    while t < nc && height(t) <= h {
                        let f = ((height(t) - h_old) / (h - h_old)).clamp(0.0, 1.0);
                        let node = view.node(if f < 0.5 { old } else { row });
                        for c in 0..3 {
                            values[c * nc + ordinal(t)] = self.unit * decode(b[node][c]);
                        }
                        t += 1;
                    }
                }
            }
            before = Some((row, h));
            if t == nc {
                break;
            }
        }
        let first = first.unwrap_or(0);
        if self.capped {
            return if higher { (0, 0) } else { (0, nc) };
        }
        if higher { (0, nc - first) } else { (first, nc) }
    }

    /// [`Self::staircase`] along a line through samples that are not finite, towards `next`: beyond them isovalues may
    /// go on inside the solid, and meet level sets from there.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "slices in Ω")]
    fn staircase_with_gaps(&self, view: View, next: Option<Stop>, values: &mut [f32]) -> (usize, usize) {
        let nc = self.flats.isovalues;
        let SampledLine { pack, lane, b, span, .. } = view.line;
        let (forward, higher) = (view.forward(), self.plan.sign < 0.0);
        let mut beyond = Vec::new();
        let (first_slice, last_slice) = (span[0].ceil() as usize, span[1].floor() as usize);
        let start = pack.h[if forward { first_slice } else { last_slice } + 1][lane];
        let entry = view.rows().map(|row| view.h(row)).find(|h| *h != OUTSIDE);
        let asleep = (first_slice..=last_slice).any(|k| !pack.was_read(k + 1));
        // Isovalues whose solid the line enters Ω in. Where there are nothing but gaps, one side takes all.
        let inside = match entry {
            Some(h) => (0..nc).take_while(|&t| self.height(t) <= h).count(),
            None if asleep || self.primary => 0,
            None => nc,
        };
        // Caps close Ω, but no gaps.
        let mut first = inside;
        if self.capped {
            let covered = if start == OUTSIDE { 0 } else { inside };
            self.cap(view, covered, values);
            first = covered;
        }
        // Inside the solid lines end on a cap, black from within.
        let exit = if self.capped { pack.border(lane, forward) } else { None };
        for t in first..nc {
            let mut ray = Crossing::new(self.height(t), false);
            let met = view.rows().find_map(|row| ray.step(row, view.h(row)));
            if let Some((row, front)) = met {
                let radiance = colour(b[usize::from(!front)].get(view.node(row)).copied().unwrap_or_default());
                for c in 0..3 {
                    values[c * nc + self.ordinal(t)] = self.unit * radiance[c];
                }
            } else if exit.is_some_and(|h| self.height(t) <= h) {
                (0..3).for_each(|c| values[c * nc + self.ordinal(t)] = 0.0);
            } else if ray.is_within() && !self.capped {
                // What stands there as the other side sees it.
                if beyond.is_empty() {
                    beyond.resize(3 * nc, 0.0);
                    let across = next.map(|n| Stop { flat: n.flat.map(|flat| self.flats.other(flat)), ..n });
                    fill_column(self.flats, across, &mut beyond);
                }
                (0..3).map(|c| c * nc + self.ordinal(t)).for_each(|i| values[i] = beyond[i]);
            }
        }
        match (self.capped, higher) {
            (true, true) => (0, 0),
            (true, false) => (0, nc),
            (false, true) => (0, nc - inside),
            (false, false) => (inside, nc),
        }
    }

    /// Isovalue number `t` of the textures in ascending order of sign · c.
    fn ordinal(&self, t: usize) -> usize {
        if self.plan.sign < 0.0 { self.flats.isovalues - 1 - t } else { t }
    }

    /// Its sign · c.
    fn height(&self, t: usize) -> f32 {
        self.plan.sign * self.flats.centres[self.ordinal(t)]
    }

    /// The first `count` isovalues meet the cap where a view enters Ω.
    fn cap(&self, view: View, count: usize, values: &mut [f32]) {
        if count == 0 || self.plan.sign < 0.0 {
            return;
        }
        let stop = self.cap_stop(view.entry(), view.line.pq);
        let nc = self.flats.isovalues;
        let mut column = vec![0f32; 3 * nc];
        fill_column(self.flats, Some(stop), &mut column);
        for c in 0..3 {
            values[c * nc..][..count].copy_from_slice(&column[c * nc..][..count]);
        }
    }

    /// The cap at τ of a line, where it crosses a face of Ω.
    #[allow(clippy::cast_possible_truncation, reason = "texture coordinates, six caps")]
    fn cap_stop(&self, tau: f64, (p, q): (f64, f64)) -> Stop {
        let shear = &self.plan.shear;
        let mut local = DVec3::ZERO;
        let [u, v, a] = shear.layout.axes;
        local[u] = p + shear.offset[0] + shear.slope[0] * tau;
        local[v] = q + shear.offset[1] + shear.slope[1] * tau;
        local[a] = tau;
        let mut far = DVec3::ZERO;
        for (x, n) in shear.layout.axes.into_iter().zip(shear.layout.dims) {
            far[x] = n as f64 - 1.0;
        }
        // The face nearest to the point.
        let face = (0..6)
            .min_by(|&f, &g| {
                let gap = |f: usize| if f >= 3 { (local[f - 3] - far[f - 3]).abs() } else { local[f].abs() };
                gap(f).total_cmp(&gap(g))
            })
            .expect("six faces");
        let x = face % 3;
        let uv = [(x + 1) % 3, (x + 2) % 3].map(|b| (local[b] / far[b]).clamp(0.0, 1.0) as f32);
        let cap = self.caps + face as u32;
        Stop { tau, polygon: cap, flat: Some(cap), uv, covers: None }
    }

    /// What the caps at a line's entry and exit see outside Ω.
    fn caps(&self, line: SampledLine, out: &mut Arrivals) {
        let SampledLine { pack, lane, span, pq, .. } = line;
        let nc = self.flats.isovalues;
        for (end, h) in [false, true].map(|forward| pack.border(lane, forward)).into_iter().enumerate() {
            let Some(h) = h else { continue };
            let covered = below(&self.flats.axis, nc, h);
            if covered > 0 {
                let next = self.ends.stop(pq.0, pq.1, span[end], end == 1, None);
                let cap = self.cap_stop(span[end], pq);
                fill_column(self.flats, next, out.room(nc));
                out.push((cap.flat.expect("a cap"), cap.uv), self.near.weight, nc, (0, covered));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{Field, Sweep};
    use crate::polygon::Polygon;
    use crate::scene::{Boundary, Surface, cornell_box};
    use crate::volume::generate::Generator;
    use glam::DMat3;

    fn scene(walls: impl Fn(&Field) -> Vec<Polygon>) -> Scene {
        let volume = Generator::from_name("bumps").and_then(|g| g.sample([24; 3])).unwrap();
        let field = Field::new(&volume, Sweep::new(3.6, 95.0).unwrap()).unwrap();
        let walls = walls(&field);
        Scene::new(field, Surface::default(), Boundary::Open, walls).unwrap()
    }

    /// A wide floor with a small triangle on it had lines report for the triangle's texels: 4 GB.
    #[test]
    fn small_texels_do_not_ask_all_of_a_wide_floor() {
        let with = |crumb: bool| {
            scene(|field| {
                let far = 23.0 * field.lattice().spacing().x;
                let floor = [[-60.0, -60.0], [60.0, -60.0], [60.0, 60.0], [-60.0, 60.0]];
                let small = [[1.2, 0.5], [1.21, 0.5], [1.21, 0.51]];
                let [x, y, z] = field.lattice().origin().to_array();
                let flat = |name: &str, outline: &[[f64; 2]], height: f64, emission: f64| {
                    let place = |p: &[f64; 2]| DVec3::new(x + far * p[0], y + far * p[1], z + far * height);
                    let vertices = outline.iter().map(place).collect();
                    let albedo = DVec3::splat(if emission > 0.0 { 0.0 } else { 0.6 });
                    Polygon::new(name, vertices, albedo, DVec3::splat(emission)).unwrap()
                };
                let lamp = flat("lamp", &[[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]], 3.0, 10.0);
                let mut walls = vec![lamp, flat("floor", &floor, -0.5, 0.0)];
                walls.extend(crumb.then(|| flat("crumb", &small, 0.5, 0.0)));
                walls
            })
        };
        let [without, crumb] = [false, true].map(|crumb| reports(&with(crumb), 32, 16));
        assert!(without < 1e6, "{without:e}");
        assert!((2e7..5e8).contains(&crumb), "{crumb:e}");
    }

    /// Where all texels are alike, all of their lines report.
    #[test]
    fn walls_of_one_fineness_keep_their_lines() {
        let scene = scene(|field| cornell_box(field.lattice(), 0.0).unwrap());
        let lattice = scene.lattice();
        let voxel = lattice.spacing().max_element();
        for texel in [0.4, 1.0, 3.5, 20.0] {
            let area = (texel * voxel).powi(2);
            let lines = texel.floor().max(1.0);
            let all = [[lines.min(8.0); 2], [lines.min(10.0); 2]];
            assert_eq!(strides(lattice, 0, [area; 6].into_iter(), 1e9), all, "{texel}");
        }
        let voxels = |n: f64| (n * voxel).powi(2);
        assert_eq!(strides(lattice, 1, [voxels(1.0), voxels(40.5)].into_iter(), 1e8), [[8.0; 2], [14.0; 2]]);
        assert_eq!(strides(lattice, 2, [voxels(1.0), voxels(40.5)].into_iter(), 1e5), [[1.0; 2]; 2]);
    }

    /// Slices four times as far apart as the nodes in them: lines along x or y report for every texel of six nodes once
    /// along the slices and at every one across them, lines along z as often as slices meet walls.
    #[test]
    fn lines_report_by_their_own_distances() {
        let axes = DMat3::from_diagonal(DVec3::new(1.0, 1.0, -4.0));
        let lattice = Lattice::new([64, 64, 16], DVec3::ZERO, axes).unwrap();
        for (axis, near) in [(0, [6.0, 1.0]), (1, [6.0, 1.0]), (2, [1.0, 1.0])] {
            assert_eq!(strides(&lattice, axis, [36.0; 6].into_iter(), 1e4), [near; 2], "{axis}");
        }
        let reporting = Reporting::new([6, 2], [0.5, 0.5], 1.0);
        assert_eq!(reporting.along(0, (-4, 12)).collect::<Vec<_>>(), [-3, 3, 9]);
        let rows: Vec<isize> = (-2..5).filter(|&q| reporting.row(q)).collect();
        assert_eq!((&rows[..], reporting.weight), (&[-1, 1, 3][..], 12.0));
        assert_eq!(reporting.along(1, (-2, 4)).collect::<Vec<_>>(), rows);
    }
}
