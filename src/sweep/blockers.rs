//! Polygons between a luminaire and its receivers.

use crate::flattened::{Departure, Ends};
use crate::polygon::LocalPolygon;
use crate::scene::Scene;
use glam::DVec3;

/// What stands between a luminaire and its receivers.
pub(super) struct Blockers {
    polygons: Vec<(u32, LocalPolygon)>,
}

impl Blockers {
    /// Polygons that can hide luminaire `light` from a point of `receivers`: all but those that everything is in front
    /// of, and those with one face that everything is behind.
    pub(super) fn new(scene: &Scene, light: u32, receivers: &[DVec3]) -> Self {
        let source = &scene.polygons()[light as usize];
        let polygons = scene.polygons().iter().enumerate().filter_map(|(i, p)| {
            let i = u32::try_from(i).expect("scenes hold fewer than 2¹⁶ polygons");
            let slack = 1e-6 * p.area().sqrt();
            let heights = || source.vertices().iter().chain(receivers).map(|x| p.height(*x));
            let idle = heights().all(|h| h >= -slack) || (!p.opaque_back && heights().all(|h| h <= slack));
            (i != light && !idle).then(|| (i, LocalPolygon::new(p, scene.lattice())))
        });
        Self { polygons: polygons.collect() }
    }

    /// Whether nothing does.
    #[inline]
    pub(super) fn none(&self) -> bool {
        self.polygons.is_empty()
    }

    /// Whether one hides local point `y` of luminaire `light` from `x`, which lies on polygon `receiver`, if any. As
    /// seen from there: walls have one face.
    pub(super) fn block(&self, light: u32, receiver: Option<u32>, y: DVec3, x: DVec3) -> bool {
        let departure = receiver.map_or(Departure::Free, Departure::Polygon);
        let ends = Ends { departure, target: Some(light), with_light: false };
        self.polygons.iter().any(|(i, p)| p.intersect(*i, ends, x, y - x, 1.0 - 1e-9).is_some())
    }
}
