//! Direct light: the running maximum of h along fans of lines from low-discrepancy points of the luminaires. One line
//! answers for every isovalue it meets: a sample is lit on its own level set iff it exceeds everything before it.

use super::directions::Layout;
use super::flats::{Flats, capped};
use super::grid::{Blocks, Geometry, Planes, Spare};
use super::pack::LANES;
use super::segments::Segments;
use super::simd::Isa;
use crate::flat;
use crate::flattened::{Departure, Side};
use crate::luminaire::{point_term, unoccluded};
use crate::polygon::{LocalPolygon, Polygon};
use crate::rng::{Rng, Sobol, Stage};
use crate::scene::Scene;
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

/// Marches along all lines of the fans of one point, side by side: the rows of one fan alone are too few for threads to share
/// well.
fn march((geometry, isa, sides): (&Geometry, Isa, &[Side]), start: f32, fans: &[Option<Fan>; 6]) -> [Seen; 6] {
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
    seen
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

/// What stands between a luminaire and its receivers.
struct Blockers {
    polygons: Vec<(u32, LocalPolygon)>,
}

impl Blockers {
    /// Polygons that can hide luminaire `light` from a point of `receivers`: all but those that everything is in front of.
    fn new(scene: &Scene, light: u32, receivers: &[DVec3]) -> Self {
        let source = &scene.polygons()[light as usize];
        let polygons = scene.polygons().iter().enumerate().filter_map(|(i, p)| {
            let i = u32::try_from(i).expect("scenes hold fewer than 2¹⁶ polygons");
            let slack = 1e-6 * p.area().sqrt();
            let ahead = |x: &DVec3| (*x - p.vertices()[0]).dot(p.normal()) >= -slack;
            let all = source.vertices().iter().chain(receivers).all(ahead);
            (i != light && !all).then(|| (i, LocalPolygon::new(p, scene.lattice())))
        });
        Self { polygons: polygons.collect() }
    }

    fn block(&self, light: u32, receiver: Option<u32>, y: DVec3, x: DVec3) -> bool {
        self.polygons.iter().any(|(i, p)| {
            receiver != Some(*i)
                && p.intersect(*i, (Departure::Polygon(light), receiver), y, x - y, 1.0 - 1e-9).is_some()
        })
    }
}

/// A luminaire's points, low-discrepancy over its area: those of replicate `index`, together with those of the others too.
fn points(light: &Polygon, seed: u64, index: u64, number: u32, count: usize) -> Vec<DVec3> {
    let set = Sobol::set(seed, Stage::Sweep, 1 << 31 | u64::from(number));
    #[allow(clippy::cast_possible_truncation, reason = "a few thousand points")]
    let (first, count) = (index as u32 * count as u32, count as u32);
    (first..first + count).map(|i| light.sample(set.point2(i, 0))).collect()
}

/// Direct irradiance of every node, one set of planes per side in `sides`; that of the flats is added to theirs at the end. `index`
/// tells replicates apart. `tick` is asked before every point; false stops.
#[allow(clippy::cast_possible_truncation, reason = "irradiance is f32")]
pub(super) fn direct(
    scene: &Scene,
    (geometry, isa, spare): (&Geometry, Isa, &Spare),
    flats: &mut Flats,
    sides: &[Side],
    (seed, index, count): (u64, u64, usize),
    tick: &mut dyn FnMut() -> bool,
) -> (Vec<Planes>, bool) {
    let n = geometry.h.len();
    let lattice = scene.lattice();
    let mut planes: Vec<Planes> = sides.iter().map(|_| spare.black(n)).collect();
    let [nx, ny, _] = geometry.dims;
    let corners: Vec<DVec3> = (0..8)
        .map(|c| lattice.to_world(lattice.far() * DVec3::from_array([c & 1, c >> 1 & 1, c >> 2].map(f64::from))))
        .collect();
    // 0 gives no light to a side that nobody asks for.
    let wanted: [f32; 2] = [Side::Lower, Side::Higher].map(|s| match s {
        s if !sides.contains(&s) => 0.0,
        _ => 1.0,
    });
    for &number in scene.luminaires() {
        let light = &scene.polygons()[number as usize];
        let points = points(light, seed, index, number, count);
        let blockers = Blockers::new(scene, number, &corners);
        // Σ V g and Σ g of every node and side.
        let per = sides.len();
        let mut sums: Vec<[f32; 2]> = (0..per * n).into_par_iter().with_min_len(1 << 14).map(|_| [0.0; 2]).collect();
        let place = [Side::Lower, Side::Higher].map(|s| sides.iter().position(|x| *x == s).unwrap_or(0));
        for &world in &points {
            if !tick() {
                return (planes, false);
            }
            let y = lattice.to_index(world);
            let inside = (0..3).all(|a| y[a] >= 0.0 && y[a] <= lattice.far()[a]);
            let start = if inside { scene.field.value(y) as f32 } else { f32::NEG_INFINITY };
            let start = if start.is_nan() { f32::NEG_INFINITY } else { start };
            let fans: [Option<Fan>; 6] = std::array::from_fn(|f| Fan::new(geometry.dims, y, f % 3, f >= 3));
            let seen = march((geometry, isa, sides), start, &fans);
            let axes = lattice.axes();
            let step = axes.x_axis.as_vec3();
            let facing = light.normal().as_vec3();
            let (fans, seen) = (&fans, &seen);
            sums.par_chunks_mut(per * nx).enumerate().with_max_len(32).for_each(|(row, sums)| {
                let (j, k) = (row % ny, row / ny);
                let begin = DVec3::new(0.0, j as f64, k as f64);
                let start = (world - lattice.to_world(begin)).as_vec3();
                let across = [(j as f64 - y.y).abs(), (k as f64 - y.z).abs()];
                geometry.lit_nodes(row, |i| {
                    let normal = geometry.normal_f32(row * nx + i);
                    let to = start - i as f32 * step;
                    let (r2, cos_x, cos_y) = (to.length_squared(), to.dot(normal), -to.dot(facing));
                    // A side that nobody asks for counts as facing away.
                    if !(cos_y > 0.0) || cos_x * wanted[usize::from(cos_x < 0.0)] == 0.0 {
                        return;
                    }
                    let g = cos_x.abs() * cos_y / (r2 * r2);
                    let x = [i as f64, begin.y, begin.z];
                    let size = (x[0] - y.x).abs();
                    let axis =
                        if across[1] >= size && across[1] >= across[0] { 2 } else { usize::from(across[0] >= size) };
                    let f = axis + if x[axis] > y[axis] { 3 } else { 0 };
                    let Some(fan) = &fans[f] else { return };
                    let Some(v) = fan.visibility(&seen[f], x) else { return };
                    let s = usize::from(cos_x < 0.0);
                    let open = blockers.polygons.is_empty() || !blockers.block(number, None, y, DVec3::from_array(x));
                    let [seen, all] = &mut sums[i * per + place[s]];
                    *seen += if open { g * v[s] } else { 0.0 };
                    *all += g;
                });
            });
        }
        for (s, (side, planes)) in sides.iter().zip(&mut planes).enumerate() {
            let [r, g, b] = planes;
            (r, g, b).into_par_iter().with_min_len(1 << 10).enumerate().for_each(|(at, (r, g, b))| {
                let [seen, all] = sums[at * per + s];
                if seen > 0.0 {
                    let normal = geometry.normal(at).expect("only nodes with a normal were lit");
                    let normal = if *side == Side::Lower { normal } else { -normal };
                    let [i, j, k] = lattice.ijk(at).map(|x| x as f64);
                    let e = unoccluded(light, lattice.to_world(DVec3::new(i, j, k)), normal);
                    let e = (light.emission * (e * f64::from(seen / all))).as_vec3();
                    (*r, *g, *b) = (*r + e.x, *g + e.y, *b + e.z);
                }
            });
        }
    }
    for &number in scene.luminaires() {
        let points = points(&scene.polygons()[number as usize], seed, index, number, count);
        walls((scene, isa), flats, sides, number, &points, (seed, index));
    }
    (planes, true)
}

/// Light by isovalue texel as sums of steps: lit from a texel on, on the lower side, and up to one, on the higher.
struct Staircases {
    from: Vec<f64>,
    until: Vec<f64>,
}

impl Staircases {
    fn new(isovalues: usize) -> Self {
        Self { from: vec![0.0; isovalues + 1], until: vec![0.0; isovalues + 1] }
    }

    /// `g` at texels `from`.. on the lower side and ..`until` on the higher.
    #[inline]
    fn add(&mut self, g: f64, from: usize, until: usize) {
        self.from[from] += g;
        self.until[until] += g;
    }

    /// Light of each texel, of the sides that count.
    fn sums(self, lower: bool, higher: bool) -> Vec<f64> {
        let n = self.from.len() - 1;
        let mut out = vec![0.0; n];
        if lower {
            let mut sum = 0.0;
            for (out, g) in out.iter_mut().zip(&self.from) {
                sum += g;
                *out += sum;
            }
        }
        if higher {
            let mut sum = 0.0;
            for (out, g) in out.iter_mut().zip(&self.until[1..]).rev() {
                sum += g;
                *out += sum;
            }
        }
        out
    }
}

/// Direct light of one luminaire on all flats: every texel looks from a point of its own along the segment to each
/// luminaire point; it is lit at the isovalues above the greatest h there (and, inside solids, up to the least).
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the isovalues")]
fn walls(
    (scene, isa): (&Scene, Isa),
    flats: &mut Flats,
    sides: &[Side],
    number: u32,
    points: &[DVec3],
    key: (u64, u64),
) {
    let lattice = scene.lattice();
    let light = &scene.polygons()[number as usize];
    let nc = flats.isovalues;
    let caps = scene.polygons().len();
    let [lower, higher] = [Side::Lower, Side::Higher].map(|s| sides.contains(&s));
    let higher = higher && !capped(scene);
    let far = lattice.far();
    for (id, texture) in flats.textures.iter_mut().enumerate() {
        let Some(texture) = texture else { continue };
        let flat = flat::flat(scene, id).expect("textured flats exist");
        let receiver = (id < caps).then(|| u32::try_from(id).expect("fewer than 2¹⁶ polygons"));
        let corners: Vec<DVec3> = [[0., 0.], [1., 0.], [0., 1.], [1., 1.]].map(|uv| flat.at(uv)).to_vec();
        let blockers = Blockers::new(scene, number, &corners);
        let [nu, nv, _] = texture.dims;
        texture.direct.par_chunks_mut(3 * nc).enumerate().with_max_len(32).for_each(|(texel, out)| {
            let (i, j) = (texel % nu, texel / nu);
            let place = |a: f64, b: f64| flat.at([(i as f64 + a) / nu as f64, (j as f64 + b) / nv as f64]);
            let e = unoccluded(light, place(0.5, 0.5), flat.normal);
            if e == 0.0 {
                return;
            }
            let stream = (key.1 << 32 | u64::from(number)) ^ (id as u64) << 48 ^ (texel as u64) << 16;
            let mut rng = Rng::stream(key.0, Stage::Sweep, stream ^ 1 << 63);
            // Number of isovalue texels at or below h.
            let below = |h: f32| ((h * nc as f32 + 0.5).floor().max(0.0) as usize).min(nc);
            // Σ g of what begins at each isovalue texel on the lower side, and of what ends before it on the higher one.
            let (mut lit, mut all) = (Staircases::new(nc), Staircases::new(nc));
            for points in points.chunks(LANES) {
                let mut segments = Segments::NONE;
                let mut seen = [(0.0, 0); LANES];
                for (lane, &y) in points.iter().enumerate() {
                    let [a, b] = rng.unit2();
                    let x = place(a, b);
                    let g = point_term(x, flat.normal, y, light.normal());
                    if g == 0.0 {
                        continue;
                    }
                    let (lx, ly) = (lattice.to_index(x), lattice.to_index(y));
                    let within = (0..3).all(|a| lx[a] >= -1e-6 && lx[a] <= far[a] + 1e-6);
                    let here =
                        if within && id < caps && !capped(scene) { below(scene.field.value(lx) as f32) } else { 0 };
                    all.add(g, here, here);
                    if blockers.block(number, receiver, ly, lx) {
                        continue;
                    }
                    if id >= caps {
                        lit.add(g, 0, 0);
                        continue;
                    }
                    segments.set(lane, &scene.field, ly, lx);
                    seen[lane] = (g, here);
                }
                isa.extrema(scene.field.samples(), &mut segments);
                for (lane, &(g, here)) in seen.iter().enumerate().filter(|(_, s)| s.0 != 0.0) {
                    let open = below(segments.most[lane]).max(here);
                    lit.add(g, open, below(segments.least[lane]).min(open));
                }
            }
            let [lit, all] = [lit, all].map(|s| s.sums(lower, higher));
            let rgb = (light.emission * e).to_array();
            for c in 0..3 {
                for t in (0..nc).filter(|&t| all[t] > 0.0) {
                    out[c * nc + t] += (rgb[c] * lit[t] / all[t]) as f32;
                }
            }
        });
    }
}
