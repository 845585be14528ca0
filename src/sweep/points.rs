//! Low-discrepancy points of luminaires.

use super::open_share::OpenShare;
use crate::polygon::Polygon;
use crate::rng::{Sobol, Stage};
use crate::scene::Scene;
use glam::DVec3;
use std::ops::Range;

/// The luminaire points of one replicate of several.
#[derive(Clone, Copy, Debug)]
pub(super) struct Points {
    pub seed: u64,
    pub replicate: usize,
    pub replicates: usize,
    /// Per luminaire and replicate.
    pub count: usize,
}

impl Points {
    /// Those on luminaire `number`, low-discrepancy over its area, together with those of the other replicates too.
    pub(super) fn on(&self, light: &Polygon, number: u32) -> Vec<DVec3> {
        let first = self.replicate * self.count;
        self.range(light, number, first..first + self.count)
    }

    /// Those of all replicates.
    fn all(&self, light: &Polygon, number: u32) -> Vec<DVec3> {
        self.range(light, number, 0..self.replicates * self.count)
    }

    #[allow(clippy::cast_possible_truncation, reason = "a few thousand points")]
    fn range(&self, light: &Polygon, number: u32, range: Range<usize>) -> Vec<DVec3> {
        let set = Sobol::set(self.seed, Stage::Sweep, 1 << 31 | u64::from(number));
        range.map(|i| light.sample(set.point2(i as u32, 0))).collect()
    }

    /// How they misjudge the open share of luminaire `number`, which is `light`.
    pub(super) fn open_share(&self, scene: &Scene, (number, light): (u32, &Polygon)) -> OpenShare {
        let set = Sobol::set(self.seed, Stage::Sweep, 1 << 33 | u64::from(number));
        OpenShare::new(&scene.field, light, &self.all(light, number), &set)
    }
}
