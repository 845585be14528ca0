//! Slits: what is so closely behind a luminaire that no slice of nodes tells one from the other.

use super::ends::{self, Place, Standing};
use crate::polygon::LocalPolygon;
use crate::scene::{SLIT, Scene, voxel_along};
use glam::DVec3;

/// The slits behind all luminaires.
pub(super) struct Slits {
    /// Nodes within one, in rising order, and the node in front of the luminaire that each shows to lines instead of
    /// itself.
    pub hidden: Vec<(usize, usize)>,
    standing: Vec<Standing>,
}

impl Slits {
    pub(super) fn new(scene: &Scene) -> Self {
        let place = |inside| if inside { Place::Inside } else { Place::Outside };
        let stands = |inside| Standing { place: place(inside), covers: None };
        let mut standing: Vec<Standing> = ends::inside(scene).into_iter().map(stands).collect();
        let mut hidden = Vec::new();
        // Luminaires come first.
        for (number, standing) in (0..).zip(&mut standing[..scene.luminaires().len()]) {
            let nodes = hidden_by(scene, number);
            standing.covers = scene.covered_wall(number);
            if standing.place == Place::Inside && !nodes.is_empty() {
                standing.place = Place::Slit;
            }
            hidden.extend(nodes);
        }
        hidden.sort_unstable();
        Self { hidden, standing }
    }

    /// Where polygons stand.
    pub(super) fn standing(&self) -> &[Standing] {
        &self.standing
    }
}

/// Nodes less than [`SLIT`] voxels behind luminaire `number`, or in its plane, and the nodes in front of it.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "nodes of the lattice")]
fn hidden_by(scene: &Scene, number: u32) -> Vec<(usize, usize)> {
    let lattice = scene.lattice();
    let mut out = Vec::new();
    let light = &scene.polygons()[number as usize];
    let (axis, voxel) = voxel_along(lattice, light);
    let step = DVec3::AXES[axis] * lattice.axes().col(axis).dot(light.normal()).signum();
    let (lo, hi) = LocalPolygon::new(light, lattice).bounds();
    let lo = (lo - SLIT).ceil().max(DVec3::ZERO);
    let hi = (hi + SLIT).floor().min(lattice.far());
    let range = |a: usize| (0..).map(move |n| lo[a] + f64::from(n)).take_while(move |x| *x <= hi[a]);
    for z in range(2) {
        for (y, x) in range(1).flat_map(|y| range(0).map(move |x| (y, x))) {
            let node = DVec3::new(x, y, z);
            let front = node + step;
            // Voxels from the plane, along the axis.
            let world = lattice.to_world(node);
            let depth = -light.height(world) / voxel;
            let foot = lattice.to_world(node + depth * step);
            let within = front.cmpge(DVec3::ZERO).all() && front.cmple(lattice.far()).all();
            if (0.0..SLIT).contains(&depth) && light.contains(foot) && within {
                let at = |p: DVec3| lattice.offset(p.x as usize, p.y as usize, p.z as usize);
                out.push((at(node), at(front)));
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{Field, Sweep};
    use crate::scene::{Boundary, Surface, cornell_box};
    use crate::volume::{Lattice, Samples, Volume};

    /// The luminaire of the default box covers nodes 12 to 28 of 41, a thousandth of the box below the ceiling.
    #[test]
    fn nodes_closely_behind_a_luminaire_show_those_in_front() {
        for (up, depth) in [(true, 40), (false, 0)] {
            let step = DVec3::new(0.1, 0.1, if up { 0.1 } else { -0.1 });
            let lattice = Lattice::aligned([41; 3], DVec3::ZERO, DVec3::splat(0.1)).unwrap();
            let lattice =
                Lattice::new([41; 3], DVec3::ZERO, lattice.axes() * glam::DMat3::from_diagonal(step * 10.0)).unwrap();
            let walls = cornell_box(&lattice, 0.0).unwrap();
            let samples = Samples::F64((0..lattice.len()).map(|o| o as f64).collect());
            let volume = Volume::new("x", lattice.clone(), samples).unwrap();
            let field = Field::new(&volume, Sweep::new(0.0, 1.0).unwrap()).unwrap();
            let scene = Scene::new(field, Surface::default(), Boundary::Open, walls).unwrap();
            let hidden = hidden_by(&scene, 0);
            assert!((15 * 15..=17 * 17).contains(&hidden.len()), "{}", hidden.len());
            for (node, front) in hidden {
                let ([i, j, k], [x, y, z]) = (lattice.ijk(node), lattice.ijk(front));
                assert!((12..=28).contains(&i) && (12..=28).contains(&j) && k == depth);
                assert!((x, y) == (i, j) && z == depth.abs_diff(1), "{x} {y} {z}");
            }
        }
    }
}
