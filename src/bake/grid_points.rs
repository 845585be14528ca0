//! Samples at the grid's own points; where a point holds no level set of the sweep, samples around it, to which its value is
//! fitted.

use crate::brdf::reflected;
use crate::direct::luminance;
use crate::field::Field;
use crate::fitted_grid::fit;
use crate::flattened::Side;
use crate::illumination_grid::IlluminationGrid;
use crate::mask::{Mask, stand_ins};
use crate::radiance::RadianceSample;
use crate::scene::Scene;
use crate::smoothing::smooth;
use crate::volume::Lattice;
use glam::Vec3;

/// Where the points of a grid are sampled.
pub(super) struct GridPoints<'a> {
    field: &'a Field,
    lattice: &'a Lattice,
    masks: &'a [Mask],
    positions: Vec<Vec3>,
    /// The point that each position stands for, in rising order.
    owners: Vec<usize>,
}

/// Samples around a point without a level set of its own.
pub(super) const STAND_INS: usize = 4;

impl<'a> GridPoints<'a> {
    /// Positions for the points of `lattice` whose mask `wanted` picks.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    pub(super) fn new(
        field: &'a Field,
        lattice: &'a Lattice,
        masks: &'a [Mask],
        seed: u64,
        wanted: impl Fn(Mask) -> bool,
    ) -> Self {
        let points = (0..lattice.len()).filter(|&o| wanted(masks[o]));
        let (positions, owners) = points
            .flat_map(|o| {
                stand_ins::<STAND_INS>(field, lattice, o, seed).into_iter().flatten().map(move |p| (p.as_vec3(), o))
            })
            .unzip();
        Self { field, lattice, masks, positions, owners }
    }

    /// Positions, local frame.
    pub(super) fn positions(&self) -> &[Vec3] {
        &self.positions
    }

    /// The mean of the samples of each point. Points of which no sample was found stay empty, which viewers and
    /// [`IlluminationGrid::interpolate`] leave out.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    pub(super) fn collect(&self, samples: &[Option<RadianceSample>]) -> IlluminationGrid {
        let n = self.masks.len();
        let mut grid =
            IlluminationGrid { radiance: vec![[0.0; 3]; n], std_error: vec![0.0; n], mask: vec![Mask::Empty; n] };
        for run in self.owners.chunk_by(|a, b| a == b).scan(0, |end, run| {
            *end += run.len();
            Some(*end - run.len()..*end)
        }) {
            let owner = self.owners[run.start];
            let (mut sum, mut variance, mut count) = (Vec3::ZERO, 0.0, 0.0);
            for s in samples[run].iter().flatten() {
                (sum, variance, count) = (sum + s.radiance, variance + s.variance, count + 1.0);
            }
            if count > 0.0 {
                grid.radiance[owner] = (sum / count).to_array();
                grid.std_error[owner] = variance.sqrt() / count;
                grid.mask[owner] = self.masks[owner];
            }
        }
        grid
    }

    /// Puts gathered light smoothed over the points in the place of each point's own ([`smooth`]); points without a level
    /// set of their own keep theirs.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    pub(super) fn smooth(
        &self,
        scene: &Scene,
        side: Side,
        tau: f64,
        grid: &mut IlluminationGrid,
        samples: &[Option<RadianceSample>],
    ) {
        let mut halves = vec![[Vec3::NAN; 2]; self.masks.len()];
        let valid = || self.owners.iter().zip(samples).filter(|(o, s)| self.masks[**o] == Mask::Valid && s.is_some());
        for (&o, s) in valid() {
            halves[o] = s.unwrap_or_default().indirect;
        }
        let smoothed = smooth(scene, self.lattice, side, tau, &halves);
        for (&o, s) in valid() {
            let s = s.unwrap_or_default();
            let change = (smoothed[o].mean - 0.5 * (s.indirect[0] + s.indirect[1])).as_dvec3();
            let albedo = scene.surface.albedo.at(f64::from(scene.field.value(s.position.as_dvec3()) as f32));
            grid.radiance[o] = (s.radiance + reflected(albedo, change).as_vec3()).max(Vec3::ZERO).to_array();
            let scale = (luminance(albedo) / std::f64::consts::PI) as f32;
            let variance = s.variance - s.indirect_variance + smoothed[o].variance * scale * scale;
            grid.std_error[o] = variance.max(0.0).sqrt();
        }
    }

    /// Gives the points without a level set of their own what makes interpolation come nearest to the samples in the cells
    /// around them: between the points of a steep edge there may be none with one.
    pub(super) fn fit_beside(&self, grid: IlluminationGrid, samples: &[Option<RadianceSample>]) -> IlluminationGrid {
        let beside = self.owners.iter().zip(samples).filter(|(o, _)| self.masks[**o] == Mask::Filled);
        let beside: Vec<RadianceSample> = beside.filter_map(|(_, s)| *s).collect();
        fit(self.field, self.lattice, &beside, grid, |m| m == Mask::Filled, &|_| true)
    }
}
