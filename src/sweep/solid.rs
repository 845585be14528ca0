//! Where solids stand on flats: in Ω's faces light of either side of the level sets is kept apart.

use super::flats::below;
use crate::flat::Flat;
use crate::isovalue_axis::IsovalueAxis;
use crate::scene::{Scene, value_on};
use rayon::prelude::*;

/// Off Ω, and where samples are missing, there is one light for all.
pub(super) const FREE: u32 = u32::MAX;

/// How many of `n` isovalues along `axis` lie in the solid at the centre of each texel of a flat, or [`FREE`].
#[allow(clippy::cast_possible_truncation, reason = "isovalues are f32 and few")]
pub(super) fn solid(scene: &Scene, flat: &Flat, [nu, nv]: [usize; 2], axis: &IsovalueAxis, n: usize) -> Vec<u32> {
    let of = |texel: usize| {
        let uv = [((texel % nu) as f64 + 0.5) / nu as f64, ((texel / nu) as f64 + 0.5) / nv as f64];
        let p = scene.lattice().to_index(flat.at(uv));
        let h = value_on(&scene.field, p) as f32;
        if h.is_nan() { FREE } else { below(axis, n, h) as u32 }
    };
    (0..nu * nv).into_par_iter().with_min_len(256).map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{Field, Sweep};
    use crate::flattened::Side;
    use crate::scene::{Boundary, Surface, cornell_box};
    use crate::sweep::flats::Flats;
    use crate::volume::{Lattice, Samples, Volume};
    use glam::DVec3;

    /// Where level sets end on walls and both sides are swept, samples missing or not; not off Ω.
    #[test]
    fn sides_are_kept_apart_in_the_volumes_faces() {
        let flats = |sides: &[Side], margin: f64, gap: bool| {
            let lattice = Lattice::aligned([9; 3], DVec3::ZERO, DVec3::splat(0.125)).unwrap();
            let height = |o: usize| if gap && o == 360 { f32::NAN } else { lattice.ijk(o)[2] as f32 };
            let samples = Samples::F32((0..lattice.len()).map(height).collect());
            let volume = Volume::new("planes", lattice.clone(), samples).unwrap();
            let field = Field::new(&volume, Sweep::new(0.0, 8.0).unwrap()).unwrap();
            let walls = cornell_box(&lattice, margin).unwrap();
            let scene = Scene::new(field, Surface::default(), Boundary::Open, walls).unwrap();
            let left = scene.polygons().iter().position(|p| p.name == "x_min").unwrap();
            (Flats::new(&scene, sides, 8, 8), left)
        };
        let both = Side::BOTH;
        // Walls in the volume's faces, one of them by a box that a modeller wrote with six digits.
        for (margin, gap) in [(0.0, false), (0.0, true), (1e-5, false)] {
            let (apart, left) = flats(&both, margin, gap);
            assert_eq!(
                (apart.textures.len(), apart.number(3, Side::Higher)),
                (2 * apart.count, 3 + apart.count as u32)
            );
            let starts = |number: usize| apart.textures[number].as_ref().map(|t| t.start);
            for flat in (0..apart.count).filter(|&flat| starts(flat).is_some()) {
                assert_eq!(starts(flat + apart.count), starts(flat).map(|start| start + apart.across()), "{flat}");
            }
            // Eight rows of texels, each a step higher.
            let mut solid = apart.solid[left].clone().unwrap();
            solid.sort_unstable();
            solid.dedup();
            // But for the cells around the sample that is missing.
            let free = usize::from(gap);
            assert!(solid.len() == 8 + free && solid[..8].iter().all(|n| *n <= 8), "{solid:?}");
            assert!(solid[8..].iter().all(|n| *n == FREE));
        }
        for (sides, margin) in [(&both[..1], 0.0), (&both, 0.1)] {
            let (one, _) = flats(sides, margin, false);
            assert_eq!((one.textures.len(), one.number(3, Side::Higher)), (one.count, 3), "{sides:?} {margin}");
            assert_eq!(one.across(), 0);
        }
    }
}
