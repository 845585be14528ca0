//! Direct light on flats: along segments from each of their texels.

use super::Direct;
use super::staircases::Staircases;
use crate::flat::{self, Flat};
use crate::flattened::Side;
use crate::isovalue_axis::IsovalueAxis;
use crate::luminaire::{point_term, unoccluded};
use crate::polygon::Polygon;
use crate::rng::{Rng, Stage};
use crate::scene::ON;
use crate::sweep::blockers::Blockers;
use crate::sweep::flats::{self, Flats};
use crate::sweep::open_share::OpenShare;
use crate::sweep::pack::LANES;
use crate::sweep::segments::Segments;
use crate::sweep::solid::FREE;
use glam::DVec3;
use rayon::prelude::*;

/// The random stream of a flat's texel for one luminaire (below 2¹⁶) and replicate (below 2⁸): of flats below 2¹⁵ and
/// texels below 2²⁴ each has one of its own, which nodes do not use.
fn stream(replicate: usize, luminaire: u32, flat: usize, texel: usize) -> u64 {
    let [replicate, flat, texel] = [replicate, flat, texel].map(|n| n as u64);
    let low = u64::from(luminaire) | (texel & 0xffff) << 16 | replicate << 32 | (texel >> 16) << 40;
    low ^ flat << 48 ^ 1 << 63
}

impl Direct<'_> {
    /// Direct light of one luminaire on all flats: every texel looks from a point of its own along the segment to each
    /// luminaire point; it is lit at the isovalues above the greatest h there (and, inside solids, up to the least).
    pub(super) fn light_flats(&self, flats: &mut Flats, number: u32, share: &OpenShare) {
        let scene = self.scene;
        let light = &scene.polygons()[number as usize];
        let points = self.points.on(light, number);
        let (nc, axis) = (flats.isovalues, flats.axis);
        let corrections =
            Side::BOTH.map(|side| flats.centres.iter().map(|&c| share.correction(side, c)).collect::<Vec<f64>>());
        let even = [1.0; 2].map(|x| vec![x; nc]);
        let [lower, higher] = Side::BOTH.map(|s| self.sides.contains(&s));
        let higher = higher && !scene.is_capped();
        let (textures, others) = flats.textures.split_at_mut(flats.count);
        for (id, texture) in textures.iter_mut().enumerate() {
            let Some(texture) = texture else { continue };
            // What the higher side sees, if the sides are kept apart.
            let other = others.get_mut(id).and_then(Option::as_mut);
            let mut others: Vec<_> = other.map_or(Vec::new(), |t| t.direct.chunks_mut(3 * nc).map(Some).collect());
            others.resize_with(texture.direct.len() / (3 * nc), || None);
            let solid = flats.solid.get(id).and_then(Option::as_ref);
            let flat = flat::flat(scene, id).expect("textured flats exist");
            let corners: Vec<DVec3> = [[0., 0.], [1., 0.], [0., 1.], [1., 1.]].map(|uv| flat.at(uv)).to_vec();
            let blockers = Blockers::new(scene, number, &corners);
            let seer = Seer { direct: self, number, light, points: &points, blockers, axis, isovalues: nc, id, flat };
            let factors = if seer.is_cap() { &even } else { &corrections };
            let [nu, nv, _] = texture.dims;
            let texels = texture.direct.par_chunks_mut(3 * nc).zip(others).enumerate().with_max_len(32);
            texels.for_each(|(texel, (out, other))| {
                let (i, j) = (texel % nu, texel / nu);
                let place = |a: f64, b: f64| seer.flat.at([(i as f64 + a) / nu as f64, (j as f64 + b) / nv as f64]);
                let e = unoccluded(light, place(0.5, 0.5), seer.flat.normal);
                if e == 0.0 || light.is_left(number, seer.flat.departure) {
                    return;
                }
                let [lit, all] = seer.looks(texel, place);
                let rgb = (light.emission * e).to_array();
                let add = |out: &mut [f32], [lower, higher]: [bool; 2]| {
                    let lit = lit.sums(lower, higher, factors);
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
}

/// A flat, and the luminaire that its texels look at.
struct Seer<'a> {
    direct: &'a Direct<'a>,
    number: u32,
    light: &'a Polygon,
    points: &'a [DVec3],
    blockers: Blockers,
    axis: IsovalueAxis,
    isovalues: usize,
    id: usize,
    flat: Flat,
}

impl Seer<'_> {
    fn is_cap(&self) -> bool {
        self.id >= self.direct.scene.polygons().len()
    }

    /// What a texel sees of the luminaire, and what it would without obstacles: Σ g of what begins at each isovalue
    /// texel on the lower side, and of what ends before it on the higher one. `place` is a place of the texel.
    fn looks(&self, texel: usize, place: impl Fn(f64, f64) -> DVec3) -> [Staircases; 2] {
        let Self { direct, number, points, blockers, .. } = self;
        let Direct { scene, geometry, clearance, .. } = **direct;
        let (lattice, far) = (scene.lattice(), scene.lattice().far());
        let receiver = (!self.is_cap()).then(|| u32::try_from(self.id).expect("fewer than 2¹⁶ polygons"));
        let h = |p: DVec3| {
            if clearance.is_none() || geometry.reaches(p) { scene.field.value(p) as f32 } else { f32::NEG_INFINITY }
        };
        // Number of isovalue texels at or below h.
        let below = |h: f32| flats::below(&self.axis, self.isovalues, h);
        let stream = stream(direct.points.replicate, *number, self.id, texel);
        let mut rng = Rng::stream(direct.points.seed, Stage::Sweep, stream);
        let (mut lit, mut all) = (Staircases::new(self.isovalues), Staircases::new(self.isovalues));
        for points in points.chunks(LANES) {
            let mut segments = Segments::NONE;
            let mut seen = [(0.0, 0); LANES];
            for (lane, &y) in points.iter().enumerate() {
                let [a, b] = rng.unit2();
                let x = place(a, b);
                let g = point_term(x, self.flat.normal, y, self.light.normal());
                if g == 0.0 {
                    continue;
                }
                let (lx, ly) = (lattice.to_index(x), lattice.to_index(y));
                let on = lattice.nearest(lx, ON).filter(|_| !self.is_cap() && !scene.is_capped());
                let here = on.map_or(0, |on| below(h(on)));
                all.add(g, here, here);
                if blockers.block(*number, receiver, ly, lx) {
                    continue;
                }
                if self.is_cap() {
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
                    let caps = [y.clamp(DVec3::ZERO, far) != y, true].map(|outside| outside && scene.is_capped());
                    lit.add_beside(g, here, &segments.ranges(scene.field.samples(), lane, caps), below);
                }
                continue;
            }
            direct.isa.extrema(scene.field.samples(), &mut segments, clearance);
            for (lane, &(g, here)) in seen {
                let open = below(segments.most[lane]).max(here);
                lit.add(g, open, below(segments.least[lane]).min(open));
            }
        }
        [lit, all]
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
}
