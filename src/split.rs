//! Light in two parts, so that direct light need not be interpolated: what is left without it, and the share that
//! arrives of what luminaires would give without obstacles.
//!
//! Between the points of a grid radiance changes most where normals turn, and with them direct light: over a blob that
//! is two voxels wide it goes from full to none within a cell. But what a luminaire gives a place and a normal is known
//! in closed form \[Lambert1760\], and whoever draws an isosurface knows both. What has to be interpolated is
//! smoother.

use crate::brdf::reflected;
use crate::direct::open_irradiance;
use crate::flattened::Side;
use crate::scene::Scene;
use glam::{DVec3, Vec3};

/// What stands for the radiance of one side at the points of a lattice: per channel, radiance = indirect + ρ/π ·
/// visible · E₀, with E₀ the irradiance of all luminaires without obstacles at the place and normal that are looked at.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Split {
    /// Radiance but for what is reflected of direct light, linear RGB; 0 where empty.
    pub indirect: Vec<[f32; 3]>,
    /// Direct irradiance over E₀, by channel; 0 where no luminaire is above the horizon. 0 to 1 where a point holds
    /// light of its own level set; where it is fitted to light around it, up to [`MOST_VISIBLE`].
    pub visible: Vec<[f32; 3]>,
}

/// No fitted point has more of the luminaires: few want more than all, beside tips narrower than a voxel, where it
/// takes that for what lies between them to come near it.
pub const MOST_VISIBLE: f32 = 2.0;

impl Split {
    /// Nothing at so many points.
    pub fn dark(points: usize) -> Self {
        Self { indirect: vec![[0.0; 3]; points], visible: vec![[0.0; 3]; points] }
    }
}

/// Light of one surface point in two parts.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Parts {
    /// As in [`Split`].
    pub indirect: Vec3,
    /// As in [`Split`].
    pub visible: Vec3,
    /// E₀.
    pub open: DVec3,
}

impl Parts {
    /// Of the `radiance` that leaves local position `p` on `side`, of which `direct` irradiance is a part. Together
    /// they are that radiance again, also where `direct` is somewhat more than E₀.
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    pub fn new(scene: &Scene, p: DVec3, side: Side, radiance: Vec3, direct: Vec3) -> Self {
        let Some(open) = open(scene, p, side) else { return Self { indirect: radiance, ..Self::default() } };
        let visible = share(direct, open).clamp(DVec3::ZERO, DVec3::ONE);
        let indirect = radiance - lit(scene, p, visible * open).as_vec3();
        Self { indirect, visible: visible.as_vec3(), open }
    }
}

/// The share of `open` irradiance that arrives as `direct`, by channel; 0 where none could. Of several luminaires that
/// light a channel one share stands for all.
pub fn share(direct: Vec3, open: DVec3) -> DVec3 {
    DVec3::select(open.cmpgt(DVec3::ZERO), direct.as_dvec3() / open, DVec3::ZERO)
}

/// The radiance of local position `p` on `side`, from both parts as they are interpolated there: not negative.
pub fn radiance(scene: &Scene, p: DVec3, side: Side, indirect: DVec3, visible: DVec3) -> DVec3 {
    let direct = open(scene, p, side).map_or(DVec3::ZERO, |open| lit(scene, p, visible * open));
    (indirect + direct).max(DVec3::ZERO)
}

/// E₀ at local position `p`; `None` where ∇h vanishes.
fn open(scene: &Scene, p: DVec3, side: Side) -> Option<DVec3> {
    Some(open_irradiance(scene, p, scene.normal(p, side)?))
}

/// What the level set through local position `p` reflects of `irradiance`.
fn lit(scene: &Scene, p: DVec3, irradiance: DVec3) -> DVec3 {
    reflected(scene.surface.albedo.at(scene.field.value(p)), irradiance)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Field;
    use crate::polygon::Polygon;
    use crate::scene::{Boundary, Surface};
    use crate::volume::{Lattice, Samples};

    /// Spheres on [−1, 1]³ that reflect more the greater they are, between a red luminaire above and a green one at the
    /// right.
    fn scene() -> Scene {
        let lattice = Lattice::aligned([21; 3], DVec3::splat(-1.0), DVec3::splat(0.1)).unwrap();
        let radius = |o: usize| lattice.to_world(lattice.point(o)).length();
        let samples = (0..lattice.len()).map(|o| 1.0 - radius(o)).collect();
        let field = Field::made(lattice.clone(), Samples::F64(samples), 0.1, 0.9);
        let square = |name, at: DVec3, a: DVec3, b: DVec3, emission| {
            let corners = vec![at - a - b, at + a - b, at + a + b, at - a + b];
            Polygon::new(name, corners, DVec3::ZERO, emission).unwrap()
        };
        let lights = vec![
            square("above", 1.5 * DVec3::Z, 0.3 * DVec3::Y, 0.3 * DVec3::X, DVec3::new(2.0, 0.0, 0.1)),
            square("right", 1.5 * DVec3::X, 0.2 * DVec3::Z, 0.2 * DVec3::Y, DVec3::new(0.0, 3.0, 0.1)),
        ];
        let albedo = crate::reflectance::Reflectance::new(vec![(0.0, DVec3::splat(0.8)), (1.0, DVec3::splat(0.2))]);
        let surface = Surface { albedo: albedo.unwrap(), emission: DVec3::splat(0.05), ..Surface::default() };
        Scene::new(field, surface, Boundary::Open, lights).unwrap()
    }

    #[test]
    fn both_parts_are_the_whole_again() {
        let scene = scene();
        let mut seen = [0; 3];
        for i in 0..300u32 {
            let angle = f64::from(i) * 2.399_963;
            let z = 1.0 - 2.0 * (f64::from(i) + 0.5) / 300.0;
            let across = (1.0 - z * z).sqrt();
            let p = scene.lattice().to_index(0.5 * DVec3::new(across * angle.cos(), across * angle.sin(), z));
            let open = open(&scene, p, Side::Lower).unwrap();
            // A share of either luminaire, and what rounding makes of all of it.
            let shares = [DVec3::new(0.3, 1.0, 0.5), DVec3::splat(1.0 + 1e-6), DVec3::splat(2.0), DVec3::ZERO];
            for (n, share) in shares.into_iter().enumerate() {
                let whole = lit(&scene, p, share * open) + DVec3::new(0.1, 0.2, 0.3);
                let parts = Parts::new(&scene, p, Side::Lower, whole.as_vec3(), (share * open).as_vec3());
                let again = radiance(&scene, p, Side::Lower, parts.indirect.as_dvec3(), parts.visible.as_dvec3());
                assert!((again - whole).abs().max_element() < 1e-6, "{p} {share}: {again} {whole}");
                for c in 0..3 {
                    let expected = if open[c] > 0.0 { share[c].min(1.0) } else { 0.0 };
                    assert!((f64::from(parts.visible[c]) - expected).abs() < 1e-6, "{p} {share}: {parts:?}");
                    seen[c] += usize::from(n == 0 && open[c] > 0.0);
                }
                assert_eq!(parts.open, open);
            }
        }
        // Each of the first two channels belongs to one luminaire, whose horizon leaves out the far side.
        assert!(seen[0] > 120 && seen[0] < 240 && seen[1] > 120 && seen[1] < 240 && seen[2] > seen[0], "{seen:?}");
    }

    #[test]
    fn without_a_normal_all_is_indirect() {
        let scene = scene();
        let centre = scene.lattice().to_index(DVec3::ZERO);
        assert_eq!(scene.normal(centre, Side::Lower), None);
        let light = Vec3::new(0.1, 0.2, 0.3);
        let parts = Parts::new(&scene, centre, Side::Lower, light, Vec3::ONE);
        assert_eq!(parts, Parts { indirect: light, ..Parts::default() });
        let again = radiance(&scene, centre, Side::Lower, parts.indirect.as_dvec3(), DVec3::ONE);
        assert_eq!(again.as_vec3(), light);
        // What interpolation takes below zero is dark.
        assert_eq!(radiance(&scene, centre, Side::Lower, DVec3::new(-0.1, 0.0, 0.1), DVec3::ZERO).x, 0.0);
    }
}
