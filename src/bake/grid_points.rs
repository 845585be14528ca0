//! Light at a grid's own points.

use super::BakeSettings;
use super::bands::Band;
use crate::brdf::reflected;
use crate::checkpoint::Saved;
use crate::direct::luminous_reflectance;
use crate::flattened::Side;
use crate::illumination_grid::IlluminationGrid;
use crate::mask::{Mask, local_position, own_light};
use crate::node_set::NodeSet;
use crate::progress::Tick;
use crate::radiance::{BLOCK, Counts, Sampler};
use crate::scene::Scene;
use crate::smoothing::{Halves, Smoothed, Smoothing, smooth};
use crate::split::{Parts, Split};
use crate::tracer::Tracer;
use crate::volume::Lattice;
use glam::Vec3;
use rayon::prelude::*;
use std::f64::consts::PI;

/// Places around a point without a level set of its own, and keys of random numbers that belong to every point.
pub(super) const STAND_INS: usize = 4;

/// The points of a grid that hold light of their own level set.
pub(super) struct GridPoints<'a> {
    scene: &'a Scene,
    lattice: &'a Lattice,
    masks: &'a [Mask],
    set: NodeSet,
}

/// Light at such points of one side, as far as it is known.
pub(super) struct PointLight {
    /// Radiance as sampled. Where `halves` are kept, `std_error` is a variance until [`GridPoints::finish`]: the part
    /// that is not the gather's; at points that stand apart it is a standard error all along.
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
pub(super) struct Packed {
    /// In units of 2^exponent / 32767.
    numbers: [i16; 6],
    exponent: i16,
}

impl Packed {
    /// Nothing.
    pub(super) const NONE: Self = Self { numbers: [0; 6], exponent: i16::MIN };

    #[allow(clippy::cast_possible_truncation, reason = "scaled to fit")]
    pub(super) fn new([a, b]: Halves) -> Self {
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
    pub(super) fn unpack(self) -> Halves {
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

    /// Darkness on one side, with room for what `settings` want kept.
    pub(super) fn dark(&self, settings: &BakeSettings) -> PointLight {
        let n = self.lattice.len();
        let (radiance, std_error, mask) = (vec![[0.0; 3]; n], vec![0.0; n], vec![Mask::Empty; n]);
        PointLight {
            grid: IlluminationGrid { radiance, std_error, mask, split: None },
            halves: settings.smooths().then(|| vec![Packed::NONE; self.set.len()]),
            direct: settings.split.then(|| vec![[0.0; 3]; n]),
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
        rows.enumerate()
            .with_max_len(1)
            .map(|(block, ((((radiance, std_error), mask), halves), direct))| {
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
                let counts = sampler.block(&places, &mut samples, saved, block);
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
                tick(own.len() as u64);
                counts
            })
            .sum()
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
pub(super) fn smoothed_light(
    scene: &Scene,
    p: Vec3,
    radiance: Vec3,
    [a, b]: Halves,
    smoothed: Smoothed,
) -> (Vec3, f32) {
    let albedo = scene.surface.albedo.at(f64::from(scene.field.value(p.as_dvec3()) as f32));
    // Of a gather below 0 the radiance holds nothing.
    let gathered = (0.5 * (a + b)).max(Vec3::ZERO);
    let change = reflected(albedo, (smoothed.mean - gathered).as_dvec3());
    let scale = (luminous_reflectance(albedo, smoothed.mean.as_dvec3()) / PI) as f32;
    ((radiance + change.as_vec3()).max(Vec3::ZERO), smoothed.variance * scale * scale)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Field;
    use crate::rng::{Rng, Stage};
    use crate::scene::{Boundary, Surface};
    use crate::volume::Samples;
    use glam::DVec3;

    /// Sharpened nodes may make a gather negative, of which radiance holds nothing: what is smoothed takes nothing off.
    #[test]
    fn gathers_below_zero_leave_no_specks() {
        let lattice = Lattice::aligned([3; 3], DVec3::ZERO, DVec3::ONE).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[0] as f64).collect();
        let field = Field::made(lattice, Samples::F64(samples), 0.0, 2.0);
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
