//! Luminaires that hang so closely before a wall that nothing fits between: what they hide of it lights nothing, and is
//! no part of what its texels show beside them. A luminaire in the plane of a wall is hung before it, so that the same
//! is seen everywhere: which of the two a ray meets first would be up to rounding.

use super::Scene;
use crate::field::Field;
use crate::polygon::{Polygon, clip, convex_area};
use crate::volume::Lattice;
use glam::DVec3;

/// A slit is less than this share of a voxel wide.
pub(crate) const SLIT: f64 = 0.25;
/// A point this near to a wall, in voxels, lies on it.
pub(crate) const ON: f64 = 1e-3;

/// A luminaire this near to a wall's plane, in voxels, stands in it: as near as f32 rounds places.
const FLUSH: f64 = 2e-4;
/// Such a share of a voxel before a wall a luminaire hangs that stood in its plane: within [`SLIT`] on grids four times
/// as fine, too, and farther than positions are rounded.
const HUNG: f64 = 0.05;

/// h where a flat stands that is in Ω or lies on its faces; NaN off Ω.
#[inline]
pub(crate) fn value_on(field: &Field, p: DVec3) -> f64 {
    field.lattice().nearest(p, ON).map_or(f64::NAN, |p| field.value(p))
}

/// Moves the luminaires, the first `emitting` of `polygons`, out of the planes of walls that face where they face and
/// that they hide a part of. Of one with two faces either is then a luminaire with an opaque back: what shines into
/// the wall would light nothing else.
pub(super) fn hang(polygons: &mut [Polygon], emitting: usize, lattice: &Lattice) {
    let before = |light: &Polygon| {
        let wall = polygons[emitting..].iter().find(|wall| lies_on(light, wall, lattice))?;
        Some(HUNG * voxel_along(lattice, light).1 * wall.normal())
    };
    let moves: Vec<Option<DVec3>> = polygons[..emitting].iter().map(before).collect();
    for (n, by) in moves.into_iter().enumerate() {
        let Some(by) = by else { continue };
        polygons[n].translate(by);
        let faces = [n, n.wrapping_add_signed(polygons[n].other_face as isize)];
        for face in faces {
            polygons.get_mut(face).into_iter().for_each(|p| (p.other_face, p.opaque_back) = (0, true));
        }
    }
}

/// Whether `light` lies in the plane of `wall`, faces where that faces, and hides a part of it.
fn lies_on(light: &Polygon, wall: &Polygon, lattice: &Lattice) -> bool {
    let normal = wall.normal();
    let near = || FLUSH * voxel_along(lattice, light).1;
    if light.normal().dot(normal) <= 0.0 || light.vertices().iter().any(|x| wall.height(*x).abs() > near()) {
        return false;
    }
    // What is left of the luminaire within all of the wall's edges.
    let mut shared = light.vertices().to_vec();
    let corners = wall.vertices();
    for (i, &a) in corners.iter().enumerate() {
        let inwards = normal.cross(corners[(i + 1) % corners.len()] - a);
        let whole = std::mem::take(&mut shared);
        clip(whole.len(), |n| whole[n], |x| (x - a).dot(inwards), |x| shared.push(x));
    }
    convex_area(&shared) > 1e-6 * light.area()
}

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
        let reach = || SLIT * voxel_along(self.lattice(), light).1;
        light.opaque_back
            && light.normal().dot(wall.normal()) > 0.0
            && light.vertices().iter().all(|&x| wall.height(x) > 0.0 && wall.height(x) < reach() && wall.contains(x))
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
            let depth = -light.height(x);
            // Most places are far in front of every luminaire.
            depth >= 0.0
                && depth < SLIT * voxel_along(self.lattice(), light).1
                && light.contains(x)
                && self.covered_wall(l).is_some()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A square of the ceiling's plane z = 1, facing down unless `up`.
    fn square(x: [f64; 2], y: [f64; 2], z: f64, up: bool, emission: f64) -> Polygon {
        let mut v: Vec<DVec3> =
            [(0, 0), (1, 0), (1, 1), (0, 1)].map(|(i, j): (usize, usize)| DVec3::new(x[i], y[j], z)).to_vec();
        if !up {
            v.reverse();
        }
        Polygon::new("square", v, DVec3::ZERO, DVec3::splat(emission)).unwrap()
    }

    #[test]
    fn luminaires_are_hung_before_what_they_hide() {
        let lattice = Lattice::aligned([11; 3], DVec3::ZERO, DVec3::splat(0.1)).unwrap();
        let lamp = |z: f64, up: bool| square([0.4, 0.6], [0.4, 0.6], z, up, 1.0);
        let height = |lights: &[Polygon], walls: &[Polygon]| {
            let mut all = [lights, walls].concat();
            hang(&mut all, lights.len(), &lattice);
            assert!(all[lights.len()..] == *walls);
            all[..lights.len()].iter().map(|p| p.at([0.5; 2]).z).collect::<Vec<_>>()
        };
        let hung = 1.0 - HUNG * 0.1;
        let ceiling = square([0.0, 1.0], [0.0, 1.0], 1.0, false, 0.0);
        let of = |light: Polygon| height(&[light], std::slice::from_ref(&ceiling))[0];
        // Rounded to either side of the plane; at a distance; facing away; beside the ceiling; in part before it.
        for (z, expected) in
            [(1.0, hung), (1.00001, hung + 1e-5), (0.99999, hung - 1e-5), (0.9999, 0.9999), (1.0001, 1.0001)]
        {
            assert!((of(lamp(z, false)) - expected).abs() < 1e-12, "{z}");
        }
        assert_eq!(of(lamp(1.0, true)), 1.0);
        assert_eq!(of(square([1.0, 1.2], [0.4, 0.6], 1.0, false, 1.0)), 1.0);
        assert!((of(square([0.9, 1.2], [0.4, 0.6], 1.0, false, 1.0)) - hung).abs() < 1e-12);
        // Fitted into a hole between four walls.
        let hole = [
            square([0.0, 0.4], [0.0, 1.0], 1.0, false, 0.0),
            square([0.6, 1.0], [0.0, 1.0], 1.0, false, 0.0),
            square([0.4, 0.6], [0.0, 0.4], 1.0, false, 0.0),
            square([0.4, 0.6], [0.6, 1.0], 1.0, false, 0.0),
        ];
        assert_eq!(height(&[lamp(1.0, false)], &hole), [1.0]);
        // Of two faces the one before the ceiling goes; before a ceiling with two faces either does, its own way.
        let faces = lamp(1.0, true).both_faces();
        let ceilings = square([0.0, 1.0], [0.0, 1.0], 1.0, false, 0.0).both_faces();
        for (walls, expected) in [(&ceilings[..1], [1.0, hung]), (&ceilings[..], [2.0 - hung, hung])] {
            let mut all = [&faces[..], walls].concat();
            hang(&mut all, 2, &lattice);
            let found = [0, 1].map(|n| all[n].at([0.5; 2]).z);
            assert!(found.iter().zip(expected).all(|(z, expected)| (z - expected).abs() < 1e-12), "{found:?}");
            assert!(all[..2].iter().all(|p| p.opaque_back && p.other_face == 0));
        }
    }
}
