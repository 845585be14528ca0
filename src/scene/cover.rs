//! Luminaires that hang so closely before a wall that nothing fits between: what they hide of it lights nothing, and is
//! no part of what its texels show beside them.

use super::Scene;
use crate::polygon::Polygon;
use crate::volume::Lattice;
use glam::DVec3;

/// A slit is less than this share of a voxel wide.
pub(crate) const SLIT: f64 = 0.25;
/// A point this near to a wall, in voxels, lies on it.
pub(crate) const ON: f64 = 1e-3;

/// The lattice's axis that is nearest to the normal of a polygon, and how far apart its slices are along that.
pub(crate) fn voxel_along(lattice: &Lattice, polygon: &Polygon) -> (usize, f64) {
    let size = (lattice.axes().transpose() * polygon.normal()).abs();
    let axis = if size.z >= size.x && size.z >= size.y { 2 } else { usize::from(size.y >= size.x) };
    (axis, size[axis])
}

impl Scene {
    /// The wall less than a quarter of a voxel behind all of luminaire `number`, if it faces where that faces and the
    /// luminaire's back is opaque.
    #[allow(clippy::cast_possible_truncation, reason = "fewer than 2¹⁶ polygons")]
    pub fn covered_wall(&self, number: u32) -> Option<u32> {
        let light = &self.polygons()[number as usize];
        self.polygons().iter().position(|wall| self.hangs_before(light, wall)).map(|wall| wall as u32)
    }

    fn hangs_before(&self, light: &Polygon, wall: &Polygon) -> bool {
        let depth = |x: &DVec3| (*x - wall.vertices()[0]).dot(wall.normal());
        let reach = || SLIT * voxel_along(self.lattice(), light).1;
        light.opaque_back
            && light.normal().dot(wall.normal()) > 0.0
            && light.vertices().iter().all(|x| depth(x) > 0.0 && depth(x) < reach() && wall.contains(*x))
    }

    /// The luminaires that cover a part of polygon `wall`.
    pub fn covering(&self, wall: u32) -> impl Iterator<Item = &Polygon> {
        let covers = move |&(l, light): &(u32, &Polygon)| {
            self.hangs_before(light, &self.polygons()[wall as usize]) && self.covered_wall(l) == Some(wall)
        };
        (0..).zip(self.luminaires()).filter(covers).map(|(_, light)| light)
    }

    /// Whether world point `x` lies between a luminaire and the wall that it covers, where no light gets.
    #[inline]
    pub fn covers(&self, x: DVec3) -> bool {
        (0..).zip(self.luminaires()).any(|(l, light)| {
            let depth = (light.vertices()[0] - x).dot(light.normal());
            // Most places are far in front of every luminaire.
            depth >= 0.0
                && depth < SLIT * voxel_along(self.lattice(), light).1
                && light.contains(x)
                && self.covered_wall(l).is_some()
        })
    }
}
