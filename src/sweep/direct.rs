//! Direct light: the running maximum of h along fans of lines from low-discrepancy points of the luminaires. One line
//! answers for every isovalue it meets: a sample is lit on its own level set iff it exceeds everything before it.

use super::blockers::Blockers;
use super::clearance::Clearance;
use super::fans::Fans;
use super::flats::{self, Flats, capped};
use super::grid::Geometry;
use super::near;
use super::open_share::OpenShare;
use super::pack::LANES;
use super::planes::{Planes, Spare};
use super::points::Points;
use super::receivers::Emitter;
use super::segments::Segments;
use super::solid::FREE;
use crate::flat;
use crate::flattened::Side;
use crate::isa::Isa;
use crate::luminaire::{point_term, unoccluded};
use crate::polygon::Polygon;
use crate::rng::{Rng, Stage};
use crate::scene::Scene;
use crate::volume::Lattice;
use glam::DVec3;
use rayon::prelude::*;

/// Rows of nodes that a thread takes at a time, at least.
const ROWS: usize = 8;

/// How far segments to flats may step: from the lower side what is below the sweep hides nothing, however far below.
/// `None` where flats are seen from inside solids, too.
pub(super) fn clearance(scene: &Scene, geometry: &Geometry, sides: &[Side]) -> Option<Clearance> {
    let inside = sides.contains(&Side::Higher) && !capped(scene);
    (!inside).then(|| Clearance::new(geometry))
}

/// Luminaires are no farther away in the unit of length that nodes see them in.
const MOST_UNITS: f64 = 1e6;

/// The unit of length in which nodes see a luminaire: fourth powers of the world's lengths do not fit f32, nor those of
/// distances of more than 10⁹ voxels.
fn unit(lattice: &Lattice, light: &Polygon) -> f64 {
    let centre = lattice.to_world(0.5 * lattice.far());
    let farthest = light.vertices().iter().map(|v| v.distance(centre)).fold(0.0, f64::max);
    lattice.unit().max(farthest / MOST_UNITS)
}

/// Direct irradiance of every node, one set of planes per side in `sides`; that of the flats is added to theirs at the
/// end. `tick` is asked before every point; false stops.
#[allow(clippy::cast_possible_truncation, reason = "irradiance is f32")]
pub(super) fn direct(
    scene: &Scene,
    (geometry, clearance, isa, spare): (&Geometry, Option<&Clearance>, Isa, &Spare),
    flats: &mut Flats,
    sides: &[Side],
    part: Points,
    tick: &mut dyn FnMut() -> bool,
) -> (Vec<Planes>, bool) {
    let (lit, lattice) = (geometry.lit_rows(), scene.lattice());
    let mut planes: Vec<Planes> = sides.iter().map(|_| spare.black(geometry.places())).collect();
    let [nx, ny, _] = geometry.dims;
    let corners = lattice.corners().map(|p| lattice.to_world(p));
    // 0 gives no light to a side that nobody asks for.
    let wanted: [f32; 2] = [Side::Lower, Side::Higher].map(|s| match s {
        s if !sides.contains(&s) => 0.0,
        _ => 1.0,
    });
    let shares: Vec<OpenShare> = (0..).zip(scene.luminaires()).map(|light| part.open_share(scene, light)).collect();
    for ((number, light), open) in (0..).zip(scene.luminaires()).zip(&shares) {
        let points = part.on(light, number);
        let unit = unit(lattice, light);
        let blockers = Blockers::new(scene, number, &corners);
        // Σ V g and Σ g of every side at every place of planes, whatever factor all g of one have.
        let per = sides.len();
        let mut sums = vec![[0f32; 2]; per * lit.len()];
        let place = [Side::Lower, Side::Higher].map(|s| sides.iter().position(|x| *x == s).unwrap_or(0));
        let mut fans = Fans::default();
        for &world in &points {
            if !tick() {
                return (planes, false);
            }
            let y = lattice.to_index(world);
            let inside = (0..3).all(|a| y[a] >= 0.0 && y[a] <= lattice.far()[a]);
            let start = if inside { scene.field.value(y) as f32 } else { f32::NAN };
            let start = match start.is_nan() {
                false => [start; 2],
                // Caps let no light into solids.
                true if !inside && capped(scene) => [f32::NEG_INFINITY; 2],
                true => [f32::NEG_INFINITY, f32::INFINITY],
            };
            fans.march((geometry, isa, sides), y, start);
            // The unit falls out.
            let emitter = Emitter {
                fans: &fans,
                number,
                blockers: &blockers,
                facing: light.normal().as_vec3().to_array(),
                step: (lattice.axes().x_axis / unit).as_vec3().to_array(),
                wanted,
                place,
            };
            let rows = lit.split(&mut sums, per).into_par_iter().enumerate().with_max_len(32);
            rows.filter(|(_, sums)| !sums.is_empty()).for_each(|(row, sums)| {
                let (j, k) = (row % ny, row / ny);
                let (first, run) = lit.run(row);
                let begin = DVec3::new(0.0, j as f64, k as f64);
                let to = ((world - lattice.to_world(begin)) / unit).as_vec3().to_array();
                geometry.lit_vectors(row, |a, b| {
                    let sums = &mut sums[per * (a - first)..per * (b - first)];
                    let normals = &geometry.normals[run.clone()][a - first..b - first];
                    isa.receive(&emitter, [a, j, k], to, normals, sums);
                });
            });
        }
        drop(fans);
        if !open.whole() {
            let rows = lit.split(&mut sums, per).into_par_iter().enumerate().with_min_len(ROWS);
            rows.for_each(|(row, sums)| {
                let (first, _) = lit.run(row);
                geometry.lit_nodes(row, |i| {
                    for (side, sum) in sides.iter().zip(&mut sums[(i - first) * per..]) {
                        if sum[0] > 0.0 {
                            sum[0] *= open.correction(*side, geometry.h[row * nx + i]) as f32;
                        }
                    }
                });
            });
        }
        near::look((scene, geometry, isa), (number, &blockers), sides, part, &mut sums);
        for (s, (side, planes)) in sides.iter().zip(&mut planes).enumerate() {
            let rows: (Vec<_>, Vec<_>, Vec<_>) = planes.each_mut().map(|plane| lit.split(plane, 1)).into();
            rows.into_par_iter().enumerate().with_min_len(ROWS).for_each(|(row, (r, g, b))| {
                let [y, z] = [row % ny, row / ny].map(|x| x as f64);
                let (first, run) = lit.run(row);
                geometry.lit_nodes(row, |i| {
                    let (at, place) = (row * nx + i, i - first);
                    let [seen, all] = sums[(run.start + place) * per + s];
                    if seen > 0.0 {
                        let normal = geometry.normal(at).expect("only nodes with a normal were lit");
                        let normal = side.facing(normal);
                        let e = unoccluded(light, lattice.to_world(DVec3::new(i as f64, y, z)), normal);
                        let e = (light.emission * (e * f64::from((seen / all).min(1.0)))).as_vec3();
                        (r[place], g[place], b[place]) = (r[place] + e.x, g[place] + e.y, b[place] + e.z);
                    }
                });
            });
        }
    }
    for (number, open) in (0..).zip(&shares) {
        walls((scene, geometry, clearance, isa), flats, sides, number, (part, open));
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

    /// `g` at all texels that no range of h of `hidden` hides, from texel `here` on on the lower side, before on the
    /// higher; `below`: the number of texels at or below h.
    fn add_beside(&mut self, g: f64, here: usize, hidden: &[[f32; 2]], below: impl Fn(f32) -> usize) {
        let n = self.from.len() - 1;
        let open = |t: &usize| !hidden.iter().any(|[least, most]| (below(*least)..below(*most)).contains(t));
        for t in (0..n).filter(open) {
            let (sums, begin, end) = if t < here { (&mut self.until, t + 1, t) } else { (&mut self.from, t, t + 1) };
            sums[begin] += g;
            sums[end] -= g;
        }
    }

    /// Light of each texel, of the sides that count, times the factors of the lower and the higher one.
    fn sums(&self, lower: bool, higher: bool, factors: &[Vec<f64>; 2]) -> Vec<f64> {
        let n = self.from.len() - 1;
        let mut out = vec![0.0; n];
        if lower {
            let mut sum = 0.0;
            for ((out, g), factor) in out.iter_mut().zip(&self.from).zip(&factors[0]) {
                sum += g;
                *out += factor * sum;
            }
        }
        if higher {
            let mut sum = 0.0;
            for ((out, g), factor) in out.iter_mut().zip(&self.until[1..]).zip(&factors[1]).rev() {
                sum += g;
                *out += factor * sum;
            }
        }
        out
    }
}

/// The random stream of a flat's texel for one luminaire (below 2¹⁶) and replicate (below 2⁸): of flats below 2¹⁵ and
/// texels below 2²⁴ each has one of its own, which nodes do not use.
fn stream(replicate: usize, luminaire: u32, flat: usize, texel: usize) -> u64 {
    let [replicate, flat, texel] = [replicate, flat, texel].map(|n| n as u64);
    let low = u64::from(luminaire) | (texel & 0xffff) << 16 | replicate << 32 | (texel >> 16) << 40;
    low ^ flat << 48 ^ 1 << 63
}

/// Direct light of one luminaire on all flats: every texel looks from a point of its own along the segment to each
/// luminaire point; it is lit at the isovalues above the greatest h there (and, inside solids, up to the least).
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the isovalues")]
fn walls(
    (scene, geometry, clearance, isa): (&Scene, &Geometry, Option<&Clearance>, Isa),
    flats: &mut Flats,
    sides: &[Side],
    number: u32,
    (part, share): (Points, &OpenShare),
) {
    let lattice = scene.lattice();
    let light = &scene.polygons()[number as usize];
    let points = part.on(light, number);
    let (nc, axis) = (flats.isovalues, flats.axis);
    let corrections = [Side::Lower, Side::Higher]
        .map(|side| flats.centres.iter().map(|&c| share.correction(side, c)).collect::<Vec<f64>>());
    let caps = scene.polygons().len();
    let [lower, higher] = [Side::Lower, Side::Higher].map(|s| sides.contains(&s));
    let higher = higher && !capped(scene);
    let far = lattice.far();
    let h = |p: DVec3| {
        if clearance.is_none() || geometry.reaches(p) { scene.field.value(p) as f32 } else { f32::NEG_INFINITY }
    };
    let (textures, others) = flats.textures.split_at_mut(flats.count);
    for (id, texture) in textures.iter_mut().enumerate() {
        let Some(texture) = texture else { continue };
        // What the higher side sees, if the sides are kept apart.
        let other = others.get_mut(id).and_then(Option::as_mut);
        let mut others: Vec<_> = other.map_or(Vec::new(), |t| t.direct.chunks_mut(3 * nc).map(Some).collect());
        others.resize_with(texture.direct.len() / (3 * nc), || None);
        let solid = flats.solid.get(id).and_then(Option::as_ref);
        let flat = flat::flat(scene, id).expect("textured flats exist");
        let receiver = (id < caps).then(|| u32::try_from(id).expect("fewer than 2¹⁶ polygons"));
        let corners: Vec<DVec3> = [[0., 0.], [1., 0.], [0., 1.], [1., 1.]].map(|uv| flat.at(uv)).to_vec();
        let blockers = Blockers::new(scene, number, &corners);
        let [nu, nv, _] = texture.dims;
        let texels = texture.direct.par_chunks_mut(3 * nc).zip(others).enumerate().with_max_len(32);
        texels.for_each(|(texel, (out, other))| {
            let (i, j) = (texel % nu, texel / nu);
            let place = |a: f64, b: f64| flat.at([(i as f64 + a) / nu as f64, (j as f64 + b) / nv as f64]);
            let e = unoccluded(light, place(0.5, 0.5), flat.normal);
            if e == 0.0 || light.is_left(number, flat.departure) {
                return;
            }
            let stream = stream(part.replicate, number, id, texel);
            let mut rng = Rng::stream(part.seed, Stage::Sweep, stream);
            // Number of isovalue texels at or below h.
            let below = |h: f32| flats::below(&axis, nc, h);
            // Σ g of what begins at each isovalue texel on the lower side, and of what ends before it on the higher
            // one.
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
                    let here = if lattice.holds(lx) && id < caps && !capped(scene) { below(h(lx)) } else { 0 };
                    all.add(g, here, here);
                    if blockers.block(number, receiver, ly, lx) {
                        continue;
                    }
                    if id >= caps {
                        lit.add(g, 0, 0);
                        continue;
                    }
                    segments.set(lane, lattice, h, ly, lx);
                    seen[lane] = (g, here);
                }
                let seen = seen.iter().enumerate().filter(|(_, s)| s.0 != 0.0);
                if geometry.has_gaps() {
                    for (lane, &(g, here)) in seen {
                        let y = lattice.to_index(points[lane]);
                        let caps = [y.clamp(DVec3::ZERO, far) != y, true].map(|outside| outside && capped(scene));
                        lit.add_beside(g, here, &segments.ranges(scene.field.samples(), lane, caps), below);
                    }
                    continue;
                }
                isa.extrema(scene.field.samples(), &mut segments, clearance);
                for (lane, &(g, here)) in seen {
                    let open = below(segments.most[lane]).max(here);
                    lit.add(g, open, below(segments.least[lane]).min(open));
                }
            }
            let even = [1.0; 2].map(|x| vec![x; nc]);
            let rgb = (light.emission * e).to_array();
            let add = |out: &mut [f32], [lower, higher]: [bool; 2]| {
                let lit = lit.sums(lower, higher, if id < caps { &corrections } else { &even });
                let all = all.sums(lower, higher, &even);
                for c in 0..3 {
                    for t in (0..nc).filter(|&t| all[t] > 0.0) {
                        out[c * nc + t] += (rgb[c] * lit[t].max(0.0) / all[t]) as f32;
                    }
                }
            };
            let apart = solid.is_some_and(|solid| solid[texel] != FREE);
            let [own, others] = if apart { [[true, false], [false, true]] } else { [[lower, higher]; 2] };
            add(out, own);
            other.into_iter().for_each(|out| add(out, others));
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texels_have_streams_of_their_own() {
        let all = [0, 1, 7].into_iter().flat_map(|replicate| {
            [0, 1, 32_767].into_iter().flat_map(move |flat| {
                let texels = [0, 1, 2, 65_535, 65_536, 65_537, 131_072, (1 << 22) - 1];
                let of = move |texel| [0, 1, 300].map(|luminaire| stream(replicate, luminaire, flat, texel));
                texels.into_iter().flat_map(of)
            })
        });
        let all: Vec<u64> = all.collect();
        let different: std::collections::BTreeSet<u64> = all.iter().copied().collect();
        assert_eq!(different.len(), all.len());
    }

    /// What one range hides lies between the steps from its greatest on and up to its least; two also leave what is
    /// between them.
    #[test]
    fn ranges_hide_texels() {
        const N: usize = 8;
        let even = [1.0; 2].map(|x| vec![x; N]);
        let below = |h: f32| (h.max(0.0) as usize).min(N);
        let beside = |here, hidden: &[[f32; 2]]| {
            [(true, false), (false, true)].map(|(lower, higher)| {
                let mut stairs = Staircases::new(N);
                stairs.add_beside(2.0, here, hidden, below);
                stairs.sums(lower, higher, &even)
            })
        };
        for (least, most, here) in [(2.0, 5.0, 3), (2.0, 5.0, 2), (2.0, 5.0, 5), (-1.0, 3.0, 0), (6.0, 99.0, 8)] {
            let expected = [(true, false), (false, true)].map(|(lower, higher)| {
                let mut stairs = Staircases::new(N);
                let open = below(most).max(here);
                stairs.add(2.0, open, below(least).min(open));
                stairs.sums(lower, higher, &even)
            });
            assert_eq!(beside(here, &[[least, most]]), expected, "{least} … {most}, {here}");
        }
        let [lower, higher] = beside(4, &[[1.0, 2.0], [5.0, 6.0]]);
        assert_eq!(lower, [0.0, 0.0, 0.0, 0.0, 2.0, 0.0, 2.0, 2.0]);
        assert_eq!(higher, [2.0, 0.0, 2.0, 2.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(beside(8, &[]), [vec![0.0; N], vec![2.0; N]]);
    }
}
