//! Light where a grid's point holds no level set of the sweep: at places around it, to which its value is fitted.

use super::bands::Band;
use super::grid_points::{Packed, STAND_INS, smoothed_light};
use crate::checkpoint::Saved;
use crate::direct::luminance;
use crate::fitted_grid::{FitSample, GridFit, draws};
use crate::flattened::Side;
use crate::illumination_grid::IlluminationGrid;
use crate::mask::{Mask, stand_ins};
use crate::node_set::NodeSet;
use crate::progress::Tick;
use crate::radiance::{BLOCK, Counts, RadianceSample, Sampler, sample_places};
use crate::scene::Scene;
use crate::smoothing::{Scattered, Smoothing, smooth_scattered};
use crate::split::{MOST_VISIBLE, Parts, Split};
use crate::tracer::Tracer;
use crate::volume::Lattice;
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use std::ops::Range;

/// The rays of such a place, of the gather and shadow rays of a point of the grid: points are fitted to places of their
/// own and of their neighbours.
pub(super) fn rays_beside([gather, shadow]: [u32; 2]) -> [u32; 2] {
    // Halves of as many rays are compared.
    [(gather / 4).next_multiple_of(2).max(gather.min(2)), (shadow / 8).max(shadow.min(2))]
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
        sampled.counts
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

    /// Two gather rays have two halves, whose difference is their noise; nobody gets more rays than are asked for.
    #[test]
    fn places_beside_take_fewer_rays() {
        for (rays, fewer) in
            [([64, 256], [16, 32]), ([9, 17], [2, 2]), ([2, 2], [2, 2]), ([1, 1], [1, 1]), ([0, 8], [0, 2])]
        {
            assert_eq!(rays_beside(rays), fewer, "{rays:?}");
        }
    }
}
