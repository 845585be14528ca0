//! Walls, luminaires and caps: the (u, v, c) textures that answer where lines end on them.

#![allow(clippy::needless_range_loop, reason = "a channel indexes several planes at once")]

use super::half::{Half4, encode};
use super::incoming::{Incoming, Sink, texels_around};
use super::settling::Sums;
use super::solid::{FREE, solid};
use super::swept_sides;
use crate::flat::{self, Flat, FlatLight, FlatTexture, Within};
use crate::flattened::Side;
use crate::isovalue_axis::IsovalueAxis;
use crate::scene::Scene;
use rayon::prelude::*;
use std::f32::consts::PI;

/// Light of one flat: isovalues run fastest, then the channel, then u, then v.
#[derive(Clone, Debug)]
pub(super) struct Texture {
    /// Texels along u, v and isovalues.
    pub dims: [usize; 3],
    /// Diffuse reflectance at every isovalue.
    pub albedo: Vec<[f32; 3]>,
    /// Texels along u and v that lines report to, as [`sinks`].
    sink: [usize; 2],
    /// World area of one of these.
    pub sink_area: f64,
    /// Direct irradiance; where a texel lies inside the solid at an isovalue, that of its part outside.
    pub direct: Vec<f32>,
    /// Indirect irradiance of the last pass.
    pub indirect: Vec<f32>,
    /// Reflected radiance B.
    pub radiance: Vec<f32>,
    /// While light settles: B of the pass before the last.
    pub before: Vec<f32>,
    /// While light settles again: what many directions brought more than few. Empty otherwise.
    pub defect: Vec<f32>,
    /// Where the texture starts in [`Flats::packed`].
    pub start: usize,
    /// ∫cos dω as the pass has seen it, per texel and isovalue: π where no part of it is inside the solid.
    weight: Vec<f32>,
}

impl Texture {
    /// Isovalues.
    pub(super) fn isovalues(&self) -> usize {
        self.dims[2]
    }

    /// Adds to `sums`, in the channels that are `measured`, that B was `old`.
    fn count(&self, old: &[f32], measured: [bool; 3], sums: &mut Sums) {
        let [nu, nv, nc] = self.dims;
        let area = self.sink_area * (self.sink[0] * self.sink[1]) as f64 / (nu * nv) as f64;
        let channels = old.chunks(nc).zip(self.radiance.chunks(nc)).enumerate();
        for (n, (x, y)) in channels.filter(|(n, _)| measured[n % 3]) {
            x.iter().zip(y).for_each(|(x, y)| sums.count(n % 3, [*x, *y], area));
        }
    }

    /// Writes B at (u, v) for every isovalue to `out`: three channels of `isovalues()` numbers.
    #[inline(always)]
    pub(super) fn column(&self, uv: [f32; 2], out: &mut [f32]) {
        let n = 3 * self.dims[2];
        let [a, b, c, d] = texels_around(self.dims, uv).map(|(t, w)| (&self.radiance[t * n..][..n], w));
        for (i, o) in out[..n].iter_mut().enumerate() {
            *o = a.1 * a.0[i] + b.1 * b.0[i] + (c.1 * c.0[i] + d.1 * d.0[i]);
        }
    }
}

/// All flats of a scene; `None` where nothing is reflected.
pub(super) struct Flats {
    /// By flat number; where both sides of level sets end on flats what the lower one shows, then what the higher one
    /// does: light does not pass from side to side within a texel.
    pub textures: Vec<Option<Texture>>,
    /// How many flats there are.
    pub count: usize,
    /// Of each flat as [`solid`] has it, if the sides are kept apart.
    pub solid: Vec<Option<Vec<u32>>>,
    /// Isovalue texels of every texture.
    pub isovalues: usize,
    /// Where they stand.
    pub axis: IsovalueAxis,
    /// Their centres.
    pub centres: Vec<f32>,
    /// B of black and of all textures times the pass's scale, as lines read it: isovalues fastest.
    pub packed: Vec<Half4>,
}

/// Texels of walls are at most this share of the scene's narrowest extent: light that bounces between walls less than
/// two texels apart walks along them from texel to texel.
const NARROW: f64 = 1.0 / 16.0;

/// How long a texel of a scene's walls may be, but for walls too large to hold as many: no shorter than a voxel.
fn narrow(scene: &Scene) -> f64 {
    let lattice = scene.lattice();
    let [lo, hi] = scene.local_bounds();
    let inverse = lattice.axes().inverse();
    let width = |a: usize| (hi[a] - lo[a]) / inverse.row(a).length();
    (NARROW * (0..3).map(width).fold(f64::INFINITY, f64::min)).max(lattice.cell_volume().cbrt())
}

/// By flat number, what reflects and its texels along u and v.
pub(super) fn shapes(scene: &Scene, across: usize) -> impl Iterator<Item = Option<(Flat, [usize; 2])>> {
    let narrow = narrow(scene);
    (0..flat::count(scene)).map(move |number| {
        let flat = flat::flat(scene, number).filter(|flat| !flat.albedo.black())?;
        let [u, v, _] = flat.resolution(flat.across(across, narrow), 1);
        Some((flat, [u, v]))
    })
}

/// Texels that lines report to: half as many along each edge, since light that comes from everywhere has no edges.
pub(super) fn sinks(dims: [usize; 2]) -> [usize; 2] {
    dims.map(|n| n.div_ceil(2))
}

/// Texels of all flats of a scene, of both sides of the level sets where these may be kept apart.
pub(crate) fn texels(scene: &Scene, across: usize, isovalues: usize) -> usize {
    let sides = if scene.is_capped() { 1 } else { swept_sides(scene).len() };
    sides * shapes(scene, across).flatten().map(|(_, [u, v])| u * v * isovalues).sum::<usize>()
}

/// How many of `n` isovalues that stand along `axis` are at or below h.
#[inline(always)]
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped to the isovalues")]
pub(super) fn below(axis: &IsovalueAxis, n: usize, h: f32) -> usize {
    ((axis.place(h) * n as f32 + 0.5).floor().max(0.0) as usize).min(n)
}

impl Flats {
    #[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
    pub(super) fn new(scene: &Scene, sides: &[Side], across: usize, isovalues: usize) -> Self {
        let axis = IsovalueAxis::of([scene.field.samples()]);
        let centres = axis.centres(isovalues);
        let shapes: Vec<_> = shapes(scene, across).collect();
        let solid = |(flat, dims): &(Flat, _)| solid(scene, flat, *dims, &axis, isovalues);
        let solid: Vec<_> = match sides {
            [_, _] if !scene.is_capped() => shapes.iter().map(|shape| shape.as_ref().map(solid)).collect(),
            _ => Vec::new(),
        };
        let apart = solid.iter().flatten().flatten().any(|n| *n != FREE);
        // Black comes first.
        let mut next = isovalues;
        let textures = shapes.iter().cycle().take(if apart { 2 } else { 1 } * shapes.len());
        let textures = textures
            .map(|shape| {
                let (flat, [u, v]) = shape.as_ref()?;
                let texels = u * v;
                let n = 3 * texels * isovalues;
                next += texels * isovalues;
                let sink = sinks([*u, *v]);
                Some(Texture {
                    dims: [*u, *v, isovalues],
                    sink,
                    albedo: centres.iter().map(|&c| flat.albedo.at(c).as_vec3().to_array()).collect(),
                    sink_area: flat.area() / (sink[0] * sink[1]) as f64,
                    direct: vec![0.0; n],
                    indirect: vec![0.0; n],
                    radiance: vec![0.0; n],
                    before: Vec::new(),
                    defect: Vec::new(),
                    start: next - texels * isovalues,
                    weight: vec![0.0; texels * isovalues],
                })
            })
            .collect();
        let centres = centres.into_iter().map(|c| c as f32).collect();
        let (count, solid) = (shapes.len(), if apart { solid } else { Vec::new() });
        Self { textures, count, solid, isovalues, axis, centres, packed: vec![[0; 4]; next] }
    }

    /// The number of the texture that a side of the level sets sees of a flat.
    #[allow(clippy::cast_possible_truncation, reason = "fewer than 2¹⁶ flats")]
    pub(super) fn number(&self, flat: u32, side: Side) -> u32 {
        let apart = !self.solid.is_empty() && side == Side::Higher;
        flat + if apart { self.count as u32 } else { 0 }
    }

    /// The number of the texture that the other side sees of the flat with texture `number`.
    #[allow(clippy::cast_possible_truncation, reason = "fewer than 2¹⁶ flats")]
    pub(super) fn other(&self, number: u32) -> u32 {
        let count = self.count as u32;
        match self.solid.is_empty() {
            true => number,
            false => (number + count) % (2 * count),
        }
    }

    /// How far in [`Flats::packed`] what the higher side sees lies behind what the lower one does.
    pub(super) fn across(&self) -> usize {
        if self.solid.is_empty() { 0 } else { (self.packed.len() - self.isovalues) / 2 }
    }

    /// Whether nothing reflects.
    pub(super) fn none(&self) -> bool {
        self.textures.iter().all(Option::is_none)
    }

    /// The greatest B.
    pub(super) fn greatest(&self) -> f32 {
        self.textures.iter().flatten().flat_map(|t| &t.radiance).fold(0.0, |m, x| m.max(*x))
    }

    /// Takes sums of radiance times `share` for the flats' own.
    pub(super) fn take(&mut self, sums: &[Option<Vec<f32>>], share: f32) {
        for (texture, sum) in self.textures.iter_mut().zip(sums) {
            if let (Some(t), Some(sum)) = (texture, sum) {
                t.radiance.iter_mut().zip(sum).for_each(|(b, s)| *b = share * s);
            }
        }
    }

    /// Makes B times `scale` what lines read.
    pub(super) fn pack(&mut self, scale: f32) {
        for t in self.textures.iter().flatten() {
            let nc = t.dims[2];
            let radiance = &t.radiance;
            self.packed[t.start..][..t.dims.iter().product()].par_chunks_mut(nc).enumerate().for_each(
                |(texel, out)| {
                    let b = &radiance[3 * texel * nc..][..3 * nc];
                    for (i, o) in out.iter_mut().enumerate() {
                        *o = [encode(scale * b[i]), encode(scale * b[nc + i]), encode(scale * b[2 * nc + i]), 0];
                    }
                },
            );
        }
    }

    /// Where in [`Flats::packed`] the B over isovalues starts of the four texels around a point of a flat that
    /// reflects, and what each weighs.
    pub(super) fn texels(&self, flat: u32, uv: [f32; 2]) -> Option<[(usize, f32); 4]> {
        let texture = self.textures[flat as usize].as_ref()?;
        Some(texels_around(texture.dims, uv).map(|(texel, weight)| (texture.start + texel * self.isovalues, weight)))
    }

    /// Where in [`Flats::packed`] the B of a stop over isovalues starts, as [`Flats::places`] has it; black of nothing.
    pub(super) fn place(&self, stop: Option<Stop>, random: f32) -> u32 {
        let flat = stop.and_then(|s| Some((s.flat?, s.uv)));
        flat.map_or(0, |(flat, uv)| self.places(flat, &uv.map(|x| [x]), &[random])[0])
    }

    /// Where in [`Flats::packed`] the B over isovalues starts at points of a flat: that of one of the four texels
    /// around each, as likely (over `random` ∈ [0, 1)) as bilinear interpolation weighs it.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, reason = "textures hold fewer than 2³² numbers")]
    pub(super) fn places<const N: usize>(&self, flat: u32, uv: &[[f32; N]; 2], random: &[f32; N]) -> [u32; N] {
        let mut places = [0; N];
        let Some(texture) = &self.textures[flat as usize] else { return places };
        for l in 0..N {
            let [a, b, c, d] = texels_around(texture.dims, [uv[0][l], uv[1][l]]);
            let left = [random[l] - a.1, random[l] - a.1 - b.1, random[l] - a.1 - b.1 - c.1];
            // Selected from the last to the first: an end at the first that fits would be a branch that nobody can
            // foretell.
            let mut texel = d.0;
            texel = if left[2] < 0.0 { c.0 } else { texel };
            texel = if left[1] < 0.0 { b.0 } else { texel };
            texel = if left[0] < 0.0 { a.0 } else { texel };
            places[l] = (texture.start + texel * self.isovalues) as u32;
        }
        places
    }

    /// Makes sums of direct light over so many replicates their mean.
    pub(super) fn average_direct(&mut self, replicates: usize) {
        let share = 1.0 / replicates.max(1) as f32;
        self.textures.iter_mut().flatten().flat_map(|t| &mut t.direct).for_each(|x| *x *= share);
    }

    /// B of direct light alone.
    pub(super) fn reflect_direct(&mut self) {
        for t in self.textures.iter_mut().flatten() {
            t.indirect.fill(0.0);
            t.weight.fill(0.0);
        }
        self.reflect();
    }

    /// Sums of B in the channels that are chosen.
    pub(super) fn light(&self, chosen: [bool; 3]) -> Sums {
        let mut sums = Sums::default();
        self.textures.iter().flatten().for_each(|t| t.count(&t.radiance, chosen, &mut sums));
        sums
    }

    /// As [`Flats::reflect`] while light settles, the defect included: goes ω times as far from what was before the
    /// pass's light, which is kept for the next one. \[GV61\] Returns sums over the channels that are `measured`.
    pub(super) fn settle(&mut self, omega: [f32; 3], measured: [bool; 3]) -> Sums {
        let mut sums = Sums::default();
        let light: Vec<Option<Vec<f32>>> =
            self.textures.iter().map(|t| t.as_ref().map(|t| t.radiance.clone())).collect();
        for t in self.textures.iter_mut().flatten() {
            let light = t.indirect.iter_mut().zip(&t.direct).zip(&t.defect);
            light.for_each(|((e, d), x)| *e = (*e + x).max(-d));
        }
        self.reflect();
        for (t, light) in self.textures.iter_mut().zip(light) {
            let (Some(t), Some(light)) = (t, light) else { continue };
            t.count(&light, measured, &mut sums);
            let before = std::mem::replace(&mut t.before, light);
            let nc = t.isovalues();
            let channels = t.radiance.chunks_mut(nc).zip(before.chunks(nc)).enumerate();
            for (c, (y, before)) in channels.filter(|c| omega[c.0 % 3] != 1.0) {
                y.iter_mut().zip(before).for_each(|(y, x)| *y = (x + omega[c % 3] * (*y - x)).max(0.0));
            }
        }
        sums
    }

    /// Indirect irradiance of the last pass.
    pub(super) fn indirect(&self) -> Vec<Vec<f32>> {
        self.textures.iter().flatten().map(|t| t.indirect.clone()).collect()
    }

    /// Keeps what the last pass brought more than `few` directions: while light settles it is added to what a pass
    /// brings.
    pub(super) fn correct(&mut self, few: Vec<Vec<f32>>) {
        for (t, mut defect) in self.textures.iter_mut().flatten().zip(few) {
            defect.iter_mut().zip(&t.indirect).for_each(|(x, y)| *x = y - *x);
            t.defect = defect;
        }
    }

    /// Forgets it.
    pub(super) fn no_defect(&mut self) {
        self.textures.iter_mut().flatten().for_each(|t| t.defect = Vec::new());
    }

    /// Empty sums for a pass.
    pub(super) fn open(&self) -> Incoming {
        let sink = |t: &Texture| Sink::new([t.sink[0], t.sink[1], t.isovalues()]);
        Incoming { sinks: self.textures.iter().map(|t| t.as_ref().map(sink)).collect() }
    }

    /// Ends a pass with its sums, interpolated between the centres of what received them.
    pub(super) fn close(&mut self, incoming: &Incoming) {
        for (t, sink) in self.textures.iter_mut().zip(&incoming.sinks) {
            let (Some(t), Some(sink)) = (t, sink) else { continue };
            let [nu, nv, nc] = t.dims;
            let sums = t.indirect.par_chunks_mut(3 * nc).zip(t.weight.par_chunks_mut(nc));
            sums.enumerate().for_each(|(texel, (indirect, weight))| {
                let at = |i: usize, n: usize| (i as f32 + 0.5) / n as f32;
                let around = texels_around(sink.dims, [at(texel % nu, nu), at(texel / nu, nv)]);
                let spread = |out: &mut [f32], from: &[f32]| {
                    let n = out.len();
                    let [a, b, c, d] = around.map(|(t, w)| (&from[t * n..][..n], w));
                    for i in 0..n {
                        out[i] = (a.1 * a.0[i] + b.1 * b.0[i]) + (c.1 * c.0[i] + d.1 * d.0[i]);
                    }
                };
                spread(indirect, &sink.indirect);
                spread(weight, &sink.weight);
            });
        }
        self.join();
        self.normalise();
    }

    /// Texels that no level set tells apart take what either side brings.
    fn join(&mut self) {
        let (lower, higher) = self.textures.split_at_mut(self.count);
        for ((lower, higher), solid) in lower.iter_mut().zip(higher).zip(&self.solid) {
            let (Some(lower), Some(higher), Some(solid)) = (lower, higher, solid) else { continue };
            let nc = lower.isovalues();
            for texel in (0..solid.len()).filter(|&texel| solid[texel] == FREE) {
                let both = |a: &mut [f32], b: &mut [f32]| {
                    a.iter_mut().zip(b).for_each(|(a, b)| {
                        *a += *b;
                        *b = *a;
                    })
                };
                let light = 3 * texel * nc..3 * (texel + 1) * nc;
                both(&mut lower.indirect[light.clone()], &mut higher.indirect[light]);
                let weights = texel * nc..(texel + 1) * nc;
                both(&mut lower.weight[weights.clone()], &mut higher.weight[weights]);
            }
        }
    }

    /// Radiances of the textures, of flats that keep sides apart of both; `sides`: those that were swept.
    pub(super) fn export(
        &self,
        radiance: &[Option<Vec<f32>>],
        sides: &[Side],
        outside: Side,
    ) -> Vec<Option<FlatLight>> {
        let one_for_all = if sides.len() == 2 { Within::Same } else { Within::Unknown };
        let of = |number: usize| {
            Some(self.textures.get(number)?.as_ref()?.export(self.axis, radiance.get(number)?.as_ref()?))
        };
        let light = |flat: usize| {
            let solid = self.solid.get(flat).and_then(Option::as_ref);
            let apart = solid.is_some_and(|solid| solid.iter().any(|n| *n != FREE));
            match (of(flat)?, of(self.count + flat).filter(|_| apart)) {
                (lower, Some(higher)) if outside == Side::Higher => {
                    Some(FlatLight { outside: higher, within: Within::Own(lower) })
                }
                (lower, Some(higher)) => Some(FlatLight { outside: lower, within: Within::Own(higher) }),
                (outside, None) => Some(FlatLight { outside, within: one_for_all.clone() }),
            }
        };
        (0..self.count).map(light).collect()
    }

    /// Irradiance = π Σ w L / Σ w, which is exact for equal L however unevenly lines fell on the texels.
    fn normalise(&mut self) {
        for t in self.textures.iter_mut().flatten() {
            let nc = t.isovalues();
            let weight = &t.weight;
            t.indirect.par_chunks_mut(3 * nc).zip(weight.par_chunks(nc)).for_each(|(e, w)| {
                for c in 0..3 {
                    for i in 0..nc {
                        e[c * nc + i] = if w[i] > 0.0 { PI * e[c * nc + i] / w[i] } else { 0.0 };
                    }
                }
            });
        }
    }

    /// B = ρ/π (direct + indirect); texels that no line reached take the mean of neighbours that some did.
    pub(super) fn reflect(&mut self) {
        for t in self.textures.iter_mut().flatten() {
            let nc = t.isovalues();
            let (direct, indirect, albedo) = (&t.direct, &t.indirect, &t.albedo);
            t.radiance.par_chunks_mut(3 * nc).enumerate().for_each(|(texel, out)| {
                let light = 3 * texel * nc..3 * (texel + 1) * nc;
                let (direct, indirect) = (&direct[light.clone()], &indirect[light]);
                for c in 0..3 {
                    let channel = c * nc..(c + 1) * nc;
                    let light = direct[channel.clone()].iter().zip(&indirect[channel.clone()]);
                    for ((out, (d, e)), albedo) in out[channel].iter_mut().zip(light).zip(albedo) {
                        *out = albedo[c] / PI * (d + e);
                    }
                }
            });
            t.fill();
        }
    }
}

impl Texture {
    /// Copies B into texels that no line reached at an isovalue from those around them that some did.
    fn fill(&mut self) {
        let [nu, nv, nc] = self.dims;
        if self.weight.iter().all(|w| *w > 0.0) {
            return;
        }
        let old = std::mem::take(&mut self.radiance);
        let mut new = old.clone();
        let weight = &self.weight;
        new.par_chunks_mut(3 * nc).enumerate().for_each(|(texel, out)| {
            let (u, v) = (texel % nu, texel / nu);
            for i in 0..nc {
                if weight[texel * nc + i] > 0.0 {
                    continue;
                }
                let (mut sum, mut count) = ([0f32; 3], 0f32);
                for y in v.saturating_sub(1)..(v + 2).min(nv) {
                    for x in u.saturating_sub(1)..(u + 2).min(nu) {
                        let n = y * nu + x;
                        if weight[n * nc + i] > 0.0 {
                            (0..3).for_each(|c| sum[c] += old[(3 * n + c) * nc + i]);
                            count += 1.0;
                        }
                    }
                }
                if count > 0.0 {
                    (0..3).for_each(|c| out[c * nc + i] = sum[c] / count);
                }
            }
        });
        self.radiance = new;
    }

    /// The values (isovalues fastest) in the order of [`FlatTexture`].
    fn export(&self, axis: IsovalueAxis, values: &[f32]) -> FlatTexture {
        let [nu, nv, nc] = self.dims;
        let mut out = FlatTexture { axis, ..FlatTexture::black(self.dims) };
        for texel in 0..nu * nv {
            for i in 0..nc {
                out.texels[i * nu * nv + texel] = std::array::from_fn(|c| values[(3 * texel + c) * nc + i]);
            }
        }
        out
    }
}

/// Where a line meets a flat.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stop {
    /// τ along the line, in slices.
    pub tau: f64,
    /// The polygon.
    pub polygon: u32,
    /// The number of the texture that it shows, or `None` for a black back.
    pub flat: Option<u32>,
    /// Texture coordinates there.
    pub uv: [f32; 2],
    /// The wall closely behind it, if it is the back of what covers one.
    pub covers: Option<u32>,
}

/// The radiance of a stop over isovalues; black where it shows none.
#[inline(always)]
pub(super) fn fill_column(flats: &Flats, stop: Option<Stop>, out: &mut [f32]) {
    let texture = stop.and_then(|s| Some((flats.textures[s.flat? as usize].as_ref()?, s.uv)));
    match texture {
        Some((texture, uv)) => texture.column(uv, out),
        None => out.fill(0.0),
    }
}
