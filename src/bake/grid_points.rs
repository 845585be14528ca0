//! Light at a grid's own points; where a point holds no level set of the sweep, at places around it, to which its value
//! is fitted.

use super::bands::Band;
use crate::brdf::reflected;
use crate::checkpoint::Saved;
use crate::direct::{luminance, luminous_reflectance};
use crate::fitted_grid::{FitSample, GridFit, draws};
use crate::flattened::Side;
use crate::illumination_grid::IlluminationGrid;
use crate::mask::{Mask, local_position, own_light, stand_ins};
use crate::node_set::NodeSet;
use crate::progress::Tick;
use crate::radiance::{BLOCK, RadianceSample, RadianceSamples, Sampler, sample_places};
use crate::scene::Scene;
use crate::smoothing::{Halves, Scattered, Smoothed, Smoothing, smooth, smooth_scattered};
use crate::split::{MOST_VISIBLE, Parts, Split};
use crate::tracer::Tracer;
use crate::volume::Lattice;
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::f64::consts::PI;
use std::ops::{AddAssign, Range};

/// Places around a point without a level set of its own.
pub(super) const STAND_INS: usize = 4;

/// The rays of such a place, of the gather and shadow rays of a point of the grid: points are fitted to places of their
/// own and of their neighbours.
pub(super) fn rays_beside([gather, shadow]: [u32; 2]) -> [u32; 2] {
    // Halves of as many rays are compared.
    [(gather / 4).next_multiple_of(2).max(gather.min(2)), (shadow / 8).max(shadow.min(2))]
}

/// What samples cost.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Counts {
    pub(super) rays: u64,
    pub(super) misses: u64,
    pub(super) samples: u64,
    pub(super) without_gradient: u64,
}

impl AddAssign for Counts {
    fn add_assign(&mut self, o: Self) {
        self.rays += o.rays;
        self.misses += o.misses;
        self.samples += o.samples;
        self.without_gradient += o.without_gradient;
    }
}

impl From<&RadianceSamples> for Counts {
    fn from(s: &RadianceSamples) -> Self {
        let &RadianceSamples { ref samples, rays, misses, without_gradient } = s;
        Self { rays, misses, samples: samples.len() as u64 - without_gradient, without_gradient }
    }
}

/// The points of a grid that hold light of their own level set.
pub(super) struct GridPoints<'a> {
    scene: &'a Scene,
    lattice: &'a Lattice,
    masks: &'a [Mask],
    set: NodeSet,
}

/// Light at such points of one side, as far as it is known.
pub(super) struct PointLight {
    /// Radiance as sampled; the standard error, or before smoothing what of the variance is not the gather's.
    grid: IlluminationGrid,
    /// Gathered light of the points, if it is to be smoothed.
    halves: Option<Vec<Packed>>,
    /// Direct irradiance, if light is to be split.
    direct: Option<Vec<[f32; 3]>>,
}

impl PointLight {
    /// Radiance as far as it is known.
    pub(super) fn grid(&mut self) -> &mut IlluminationGrid {
        &mut self.grid
    }
}

/// Two RGB irradiances in 14 bytes, to 1/65534 of the largest of their numbers: far below their noise.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Packed {
    /// In units of 2^exponent / 32767.
    numbers: [i16; 6],
    exponent: i16,
}

impl Packed {
    /// Nothing.
    const NONE: Self = Self { numbers: [0; 6], exponent: i16::MIN };

    #[allow(clippy::cast_possible_truncation, reason = "scaled to fit")]
    fn new([a, b]: Halves) -> Self {
        let all = [a.x, a.y, a.z, b.x, b.y, b.z];
        let most = all.iter().fold(0.0f32, |m, x| m.max(x.abs()));
        if !all.iter().all(|x| x.is_finite()) {
            return Self::NONE;
        }
        // The least power of two above, from the bits of an f64: f32 has denormals.
        let exponent = if most == 0.0 { 0 } else { (f64::from(most).to_bits() >> 52) as i16 - 1022 };
        let scale = 32767.0 * 2f64.powi(-i32::from(exponent));
        Self { numbers: all.map(|x| (f64::from(x) * scale).round() as i16), exponent }
    }

    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn unpack(self) -> Halves {
        if self == Self::NONE {
            return [Vec3::NAN; 2];
        }
        let scale = 2f64.powi(i32::from(self.exponent)) / 32767.0;
        let n = self.numbers.map(|x| (f64::from(x) * scale) as f32);
        [Vec3::new(n[0], n[1], n[2]), Vec3::new(n[3], n[4], n[5])]
    }
}

/// Blocks of samples at the points of one band: a block is the band's share of so many points of the lattice.
pub(super) fn blocks(lattice: &Lattice) -> usize {
    lattice.len().div_ceil(BLOCK)
}

impl<'a> GridPoints<'a> {
    /// Those on a level set of the sweep, and with `beyond` those just outside that light themselves.
    pub(super) fn new(scene: &'a Scene, lattice: &'a Lattice, masks: &'a [Mask], beyond: bool) -> Self {
        let set = NodeSet::new(masks.len(), own_light(&scene.field, lattice, masks, beyond));
        Self { scene, lattice, masks, set }
    }

    /// Whether a point is one of them.
    pub(super) fn contains(&self, o: usize) -> bool {
        self.set.contains(o)
    }

    /// Points.
    pub(super) fn len(&self) -> usize {
        self.set.len()
    }

    /// Darkness on one side; `smoothing`: whether what is gathered will be smoothed; `split`: whether light will be.
    pub(super) fn dark(&self, smoothing: bool, split: bool) -> PointLight {
        let n = self.lattice.len();
        let (radiance, std_error, mask) = (vec![[0.0; 3]; n], vec![0.0; n], vec![Mask::Empty; n]);
        PointLight {
            grid: IlluminationGrid { radiance, std_error, mask, split: None },
            halves: smoothing.then(|| vec![Packed::NONE; self.set.len()]),
            direct: split.then(|| vec![[0.0; 3]; n]),
        }
    }

    /// The isovalue of a point, or the nearest of the sweep.
    #[inline]
    #[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
    pub(super) fn isovalue(&self, o: usize) -> f32 {
        let h = if self.lattice == self.scene.lattice() {
            self.scene.field.samples()[o]
        } else {
            self.scene.field.value(local_position(&self.scene.field, self.lattice, o)) as f32
        };
        h.clamp(0.0, 1.0)
    }

    /// Samples the points of a band. What is gathered at those that are `apart` will not be smoothed.
    #[allow(clippy::cast_possible_truncation, reason = "positions are f32")]
    pub(super) fn sample<T: Tracer>(
        &self,
        sampler: &Sampler<'_, T>,
        band: Band,
        light: &mut PointLight,
        apart: &(dyn Fn(usize) -> bool + Sync),
        saved: Saved<'_>,
        tick: Tick,
    ) -> Counts {
        let PointLight { grid, halves, direct } = light;
        let smoothing = halves.is_some();
        let halves = match halves {
            Some(halves) => self.set.split(halves, BLOCK),
            None => (0..blocks(self.lattice)).map(|_| &mut [][..]).collect(),
        };
        let saved = saved.starting_at(band.number * blocks(self.lattice));
        let rows = grid.radiance.par_chunks_mut(BLOCK).zip(grid.std_error.par_chunks_mut(BLOCK));
        let direct: Vec<&mut [[f32; 3]]> = match direct {
            Some(direct) => direct.chunks_mut(BLOCK).collect(),
            None => (0..blocks(self.lattice)).map(|_| &mut [][..]).collect(),
        };
        let rows = rows.zip(grid.mask.par_chunks_mut(BLOCK)).zip(halves).zip(direct);
        let counts =
            rows.enumerate().with_max_len(1).map(|(block, ((((radiance, std_error), mask), halves), direct))| {
                let start = block * BLOCK;
                let range = start..start + radiance.len();
                let own: Vec<usize> = self.set.members(range).filter(|&o| band.holds(self.isovalue(o))).collect();
                if own.is_empty() || !tick(0) {
                    return Counts::default();
                }
                let place = |&o: &usize| {
                    let position = local_position(&self.scene.field, self.lattice, o).as_vec3();
                    ((STAND_INS * o) as u64, position)
                };
                let places: Vec<(u64, Vec3)> = own.iter().map(place).collect();
                let mut samples = vec![None; own.len()];
                let [rays, misses] = sampler.block(&places, &mut samples, saved, block);
                let before = self.set.before(start);
                for (&o, s) in own.iter().zip(&samples) {
                    let Some(s) = s else { continue };
                    radiance[o - start] = s.radiance.to_array();
                    mask[o - start] = self.masks[o];
                    direct.get_mut(o - start).into_iter().for_each(|d| *d = s.direct.to_array());
                    let smoothing = smoothing && !apart(o);
                    std_error[o - start] = match smoothing {
                        true => s.variance - s.indirect_variance,
                        false => s.variance.sqrt(),
                    };
                    if smoothing {
                        halves[self.set.before(o) - before] = Packed::new(s.indirect);
                    }
                }
                let without_gradient = samples.iter().filter(|s| s.is_none()).count() as u64;
                tick(own.len() as u64);
                Counts { rays, misses, samples: own.len() as u64 - without_gradient, without_gradient }
            });
        counts.reduce(Counts::default, |mut a, b| {
            a += b;
            a
        })
    }

    /// The grid, with gathered light smoothed over the points if it was kept for that ([`smooth`]).
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    pub(super) fn finish(
        &self,
        side: Side,
        tau: f64,
        PointLight { mut grid, halves, direct }: PointLight,
        tick: Tick,
    ) -> IlluminationGrid {
        if let Some(packed) = halves {
            self.smooth(side, tau, (&mut grid, &packed), tick);
        }
        grid.split = direct.map(|direct| split(self.scene, self.lattice, side, &grid, &direct));
        grid
    }

    /// Smooths what was gathered, in `packed` halves, over the points.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn smooth(&self, side: Side, tau: f64, (grid, packed): (&mut IlluminationGrid, &[Packed]), tick: Tick) {
        let halves = |o: usize| self.set.slot(o).map_or([Vec3::NAN; 2], |slot| packed[slot].unpack());
        let smoothing = Smoothing { scene: self.scene, side, tau };
        smooth(smoothing, self.lattice, &halves, &mut |z, smoothed| {
            if !tick(0) {
                return;
            }
            let area = smoothed.len();
            let slice = z * area..(z + 1) * area;
            let (radiance, std_error) = (&mut grid.radiance[slice.clone()], &mut grid.std_error[slice]);
            let points = radiance.par_iter_mut().zip(std_error).zip(smoothed).enumerate().with_min_len(1024);
            points.for_each(|(n, ((radiance, std_error), smoothed))| {
                let o = z * area + n;
                let [a, b] = halves(o);
                if a.is_nan() {
                    return;
                }
                let p = local_position(&self.scene.field, self.lattice, o).as_vec3();
                let (light, variance) = smoothed_light(self.scene, p, Vec3::from_array(*radiance), [a, b], smoothed);
                *radiance = light.to_array();
                *std_error = (*std_error + variance).max(0.0).sqrt();
            });
            tick(area as u64);
        });
    }
}

/// The light of `side` at the points of `grid` that hold some, in two parts, of which `direct` irradiance is known.
pub(super) fn split(
    scene: &Scene,
    lattice: &Lattice,
    side: Side,
    grid: &IlluminationGrid,
    direct: &[[f32; 3]],
) -> Split {
    let mut split = Split::dark(lattice.len());
    let points = split.indirect.par_iter_mut().zip(&mut split.visible).enumerate().with_min_len(1024);
    points.filter(|(o, _)| grid.mask[*o] != Mask::Empty).for_each(|(o, (indirect, visible))| {
        let (radiance, direct) = (Vec3::from_array(grid.radiance[o]), Vec3::from_array(direct[o]));
        let parts = Parts::new(scene, local_position(&scene.field, lattice, o), side, radiance, direct);
        (*indirect, *visible) = (parts.indirect.to_array(), parts.visible.to_array());
    });
    split
}

/// The radiance at local position `p` with what was gathered there, in `halves`, replaced by what is `smoothed`; and
/// the variance that this part of its luminance has.
#[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
fn smoothed_light(scene: &Scene, p: Vec3, radiance: Vec3, [a, b]: Halves, smoothed: Smoothed) -> (Vec3, f32) {
    let albedo = scene.surface.albedo.at(f64::from(scene.field.value(p.as_dvec3()) as f32));
    // Of a gather below 0 the radiance holds nothing.
    let gathered = (0.5 * (a + b)).max(Vec3::ZERO);
    let change = reflected(albedo, (smoothed.mean - gathered).as_dvec3());
    let scale = (luminous_reflectance(albedo, smoothed.mean.as_dvec3()) / PI) as f32;
    ((radiance + change.as_vec3()).max(Vec3::ZERO), smoothed.variance * scale * scale)
}

/// Places beside the points of a grid that hold no level set of the sweep, while surfaces beside them do.
pub(super) struct Beside<'a> {
    scene: &'a Scene,
    lattice: &'a Lattice,
    positions: Vec<Vec3>,
    /// Of each position, the point it stands for, in rising order.
    owners: Vec<u64>,
    /// These points, and the first position of each; one more entry than points.
    points: NodeSet,
    starts: Vec<u32>,
}

/// Light at a place beside.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct BesideLight {
    radiance: Vec3,
    /// Of its luminance; negative where there is no light.
    variance: f32,
    /// The part of it that is the gather's, and the part that places around have in common: none before it is smoothed.
    indirect_variance: f32,
    common: f32,
    /// What was gathered.
    halves: Packed,
    /// Irradiance straight from luminaires.
    direct: Vec3,
}

impl BesideLight {
    const NONE: Self = Self {
        radiance: Vec3::ZERO,
        variance: -1.0,
        indirect_variance: 0.0,
        common: 0.0,
        halves: Packed::NONE,
        direct: Vec3::ZERO,
    };
}

impl<'a> Beside<'a> {
    /// Places around the points that `stand_in` picks.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    pub(super) fn new(
        scene: &'a Scene,
        lattice: &'a Lattice,
        stand_in: impl Fn(usize) -> bool + Sync,
        seed: u64,
    ) -> Self {
        let points = lattice.len();
        let set = NodeSet::new(points, stand_in);
        assert!(STAND_INS * set.len() < u32::MAX as usize, "places are numbered in 32 bits");
        let mut found = vec![[None; STAND_INS]; set.len()];
        const ROW: usize = 4096;
        set.split(&mut found, ROW).into_par_iter().enumerate().for_each(|(row, found)| {
            for (found, o) in found.iter_mut().zip(set.members(row * ROW..points.min((row + 1) * ROW))) {
                *found = stand_ins::<STAND_INS>(&scene.field, lattice, o, seed).map(|p| p.map(|p: DVec3| p.as_vec3()));
            }
        });
        let count = found.iter().flatten().flatten().count();
        let (mut positions, mut owners) = (Vec::with_capacity(count), Vec::with_capacity(count));
        let mut starts = vec![0];
        for (o, found) in set.members(0..points).zip(&found) {
            positions.extend(found.iter().flatten());
            owners.resize(positions.len(), o as u64);
            starts.push(positions.len() as u32);
        }
        Self { scene, lattice, positions, owners, points: set, starts }
    }

    /// Places.
    pub(super) fn len(&self) -> usize {
        self.positions.len()
    }

    /// The points that have places, with the numbers of these.
    fn runs(&self) -> impl Iterator<Item = (usize, Range<usize>)> {
        let mut end = 0;
        self.owners.chunk_by(|a, b| a == b).map(move |run| {
            let start = end;
            end += run.len();
            (usize::try_from(run[0]).expect("a point's number"), start..end)
        })
    }

    /// Darkness at all of them.
    pub(super) fn dark(&self) -> Vec<BesideLight> {
        vec![BesideLight::NONE; self.len()]
    }

    /// Samples the places of a band.
    #[allow(clippy::cast_possible_truncation, reason = "isovalues are f32; places below 2³²")]
    pub(super) fn sample<T: Tracer>(
        &self,
        sampler: &Sampler<'_, T>,
        band: Band,
        light: &mut [BesideLight],
        saved: Saved<'_>,
        tick: Tick,
    ) -> Counts {
        let isovalue = |n: usize| (self.scene.field.value(self.positions[n].as_dvec3()) as f32).clamp(0.0, 1.0);
        let own: Vec<u32> =
            (0..self.len()).into_par_iter().filter(|&n| band.holds(isovalue(n))).map(|n| n as u32).collect();
        // Its number among its owner's tells them apart.
        let place = |n: usize| {
            let n = own[n] as usize;
            let owner = self.owners[n];
            let number = (1..STAND_INS).take_while(|&k| n >= k && self.owners[n - k] == owner).count();
            (STAND_INS as u64 * owner + number as u64, self.positions[n])
        };
        let saved = saved.starting_at(band.number * self.len().div_ceil(BLOCK));
        let sampled = sample_places(sampler, own.len(), &place, saved, tick);
        for (&n, s) in own.iter().zip(&sampled.samples) {
            if let Some(RadianceSample { radiance, variance, indirect, indirect_variance, direct, .. }) = *s {
                let halves = Packed::new(indirect);
                light[n as usize] = BesideLight { radiance, variance, indirect_variance, common: 0.0, halves, direct };
            }
        }
        Counts::from(&sampled)
    }

    /// Smooths what was gathered over the places around ([`smooth_scattered`]): where little arrives, few rays bring
    /// it, and the fit would show them as specks. Leaves all as it is if `tick` says stop.
    pub(super) fn smooth(&self, side: Side, tau: f64, light: &mut [BesideLight], tick: Tick) {
        let scattered =
            Scattered { lattice: self.lattice, owners: &self.points, starts: &self.starts, positions: &self.positions };
        let halves = |n: usize| light[n].halves.unpack();
        let smoothing = Smoothing { scene: self.scene, side, tau };
        let Some(smoothed) = smooth_scattered(smoothing, &scattered, &halves, tick) else { return };
        let places = light.par_iter_mut().zip(smoothed).zip(&self.positions).with_min_len(1024);
        places.filter(|((l, _), _)| l.halves != Packed::NONE).for_each(|((l, smoothed), &p)| {
            (l.radiance, l.common) = smoothed_light(self.scene, p, l.radiance, l.halves.unpack(), smoothed);
            l.variance = (l.variance - l.indirect_variance).max(0.0) + l.common;
        });
    }

    /// Gives the points without a level set of their own what makes interpolation come nearest to the light in the
    /// cells around them: between the points of a steep edge there may be none with one. Points around which no light
    /// was found stay empty, which viewers and [`IlluminationGrid::interpolate`] leave out. Points beside which are no
    /// places stay as they are. Both parts of light that is split are fitted each on its own.
    pub(super) fn fit(&self, side: Side, mut grid: IlluminationGrid, light: &[BesideLight]) -> IlluminationGrid {
        // Of the points that get light, its error where the fit starts: three draws of each place's own, and the
        // variance of what places have in common, which no fit enlarges.
        let (mut lit, mut errors) = (Vec::new(), Vec::new());
        let own = |n: usize| draws(n as u64, (light[n].variance - light[n].common).max(0.0).sqrt());
        for (owner, run) in self.runs() {
            let (mut sum, mut drawn, mut common, mut count) = (Vec3::ZERO, Vec3::ZERO, 0.0, 0.0);
            for n in run.clone().filter(|&n| light[n].variance >= 0.0) {
                (sum, drawn, common) = (sum + light[n].radiance, drawn + own(n), common + light[n].common);
                count += 1.0;
            }
            if count > 0.0 {
                grid.radiance[owner] = (sum / count).to_array();
                grid.mask[owner] = Mask::Filled;
                lit.push(owner);
                let unknown = light[run].iter().any(|l| l.variance == f32::INFINITY);
                errors.push((drawn / count, if unknown { f32::INFINITY } else { common / count }));
            }
        }
        let free = NodeSet::new(self.lattice.len(), |o| grid.mask[o] == Mask::Filled && lit.binary_search(&o).is_ok());
        let targets = |target: &(dyn Fn(usize) -> Vec3 + Sync)| -> Vec<FitSample> {
            let places = self.positions.par_iter().enumerate().filter(|(n, _)| light[*n].variance >= 0.0);
            places.map(|(n, &position)| FitSample { position, light: target(n), weight: 1.0 }).collect()
        };
        let places = self.len() as u64;
        let before = |o: usize| match free.slot(o) {
            Some(slot) => errors[slot].0,
            None => draws(places + o as u64, grid.std_error[o]),
        };
        let fit = GridFit::new(&self.scene.field, self.lattice, &free, &|_| true);
        let variances = fit.variances(&targets(&own), &before);
        for ((o, variance), (_, common)) in lit.into_iter().zip(variances).zip(errors) {
            grid.std_error[o] = (variance + common).sqrt();
        }
        let targets = targets(&|n| light[n].radiance);
        grid.radiance = fit.light(&targets, grid.radiance);
        grid.split = grid.split.map(|split| self.fit_parts(side, split, light, &free));
        grid
    }

    /// Fits both parts of light from their means at the places of each point. What is visible counts for as much as
    /// could be seen.
    fn fit_parts(&self, side: Side, split: Split, light: &[BesideLight], free: &NodeSet) -> Split {
        let places = self.positions.par_iter().zip(light).with_min_len(1024);
        let parts: Vec<Parts> = places
            .map(|(position, l)| Parts::new(self.scene, position.as_dvec3(), side, l.radiance, l.direct))
            .collect();
        let full = parts.iter().map(|parts| luminance(parts.open)).fold(f64::MIN_POSITIVE, f64::max);
        let places = self.positions.par_iter().zip(light).zip(parts).with_min_len(1024);
        let parts: Vec<[FitSample; 2]> = places
            .map(|((&position, l), parts)| {
                let lit = if l.variance >= 0.0 { 1.0 } else { 0.0 };
                #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
                let counts = lit * (luminance(parts.open) / full).powi(2) as f32;
                [(parts.indirect, lit), (parts.visible, counts)].map(|(light, weight)| FitSample {
                    position,
                    light,
                    weight,
                })
            })
            .collect();
        let Split { mut indirect, mut visible } = split;
        for (owner, run) in self.runs() {
            for (n, values) in [&mut indirect, &mut visible].into_iter().enumerate() {
                let own = parts[run.clone()].iter().map(|parts| parts[n]);
                let (sum, weight) =
                    own.fold((Vec3::ZERO, 0.0), |(sum, weight), w| (sum + w.weight * w.light, weight + w.weight));
                if weight > 0.0 {
                    values[owner] = (sum / weight).to_array();
                }
            }
        }
        let fitted = |n: usize, start| {
            let targets: Vec<FitSample> = parts.par_iter().map(|parts| parts[n]).filter(|w| w.weight > 0.0).collect();
            GridFit::new(&self.scene.field, self.lattice, free, &|_| true).light(&targets, start)
        };
        let (indirect, mut visible) = (fitted(0, indirect), fitted(1, visible));
        let shares = visible.as_flattened_mut().par_iter_mut().with_min_len(1 << 14);
        shares.for_each(|share| *share = share.min(MOST_VISIBLE));
        Split { indirect, visible }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{Field, Sweep};
    use crate::rng::{Rng, Stage};
    use crate::scene::{Boundary, Surface};
    use crate::volume::{Samples, Volume};

    /// Two gather rays have two halves, whose difference is their noise; nobody gets more rays than are asked for.
    #[test]
    fn places_beside_take_fewer_rays() {
        for (rays, fewer) in
            [([64, 256], [16, 32]), ([9, 17], [2, 2]), ([2, 2], [2, 2]), ([1, 1], [1, 1]), ([0, 8], [0, 2])]
        {
            assert_eq!(rays_beside(rays), fewer, "{rays:?}");
        }
    }

    /// Sharpened nodes may make a gather negative, of which radiance holds nothing: what is smoothed takes nothing off.
    #[test]
    fn gathers_below_zero_leave_no_specks() {
        let lattice = Lattice::aligned([3; 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[0] as f64).collect();
        let volume = Volume::new("x", lattice, Samples::F64(samples)).unwrap();
        let field = Field::new(&volume, Sweep::new(0.0, 2.0).unwrap()).unwrap();
        let surface = Surface { albedo: DVec3::splat(0.5).into(), ..Surface::default() };
        let scene = Scene::new(field, surface, Boundary::Open, Vec::new()).unwrap();
        let light = |radiance: f32, halves: [f32; 2], mean: f32| {
            let smoothed = Smoothed { mean: Vec3::splat(mean), variance: 4.0 };
            smoothed_light(&scene, Vec3::ONE, Vec3::splat(radiance), halves.map(Vec3::splat), smoothed)
        };
        let half = 0.5 / std::f32::consts::PI;
        let (dark, variance) = light(0.2, [-0.3, -0.1], 0.0);
        assert_eq!(dark, Vec3::splat(0.2));
        assert!((variance / (4.0 * half * half) - 1.0).abs() < 1e-6);
        assert!((light(0.2, [-0.3, 0.1], 0.2).0 - (0.2 + 0.2 * half)).abs().max_element() < 1e-7);
        assert!((light(0.2, [0.1, 0.3], 0.3).0 - (0.2 + 0.1 * half)).abs().max_element() < 1e-7);
    }

    #[test]
    fn packing_keeps_what_matters() {
        let mut rng = Rng::stream(1, Stage::Test, 0);
        for scale in [1e-44f32, 1e-30, 1e-3, 0.7, 1.0, 2.0, 1e9, 3e38] {
            for _ in 0..100 {
                let v: Halves = std::array::from_fn(|_| {
                    Vec3::from_array(std::array::from_fn(|_| scale * (2.0 * rng.unit() as f32 - 1.0)))
                });
                let (back, most) =
                    (Packed::new(v).unpack(), v.iter().map(|v| v.abs().max_element()).fold(0.0, f32::max));
                for (a, b) in v.iter().zip(back) {
                    assert!((*a - b).abs().max_element() <= most / 32767.0 + 2e-45, "{v:?} {back:?}");
                }
            }
        }
        assert_eq!(Packed::new([Vec3::ZERO; 2]).unpack(), [Vec3::ZERO; 2]);
        assert!(Packed::new([Vec3::ZERO, Vec3::new(0.0, f32::NAN, 0.0)]).unpack()[0].is_nan());
        assert_eq!(size_of::<Packed>(), 14);
    }
}
