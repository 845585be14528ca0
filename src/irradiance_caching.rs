//! Scattered samples onto a grid as irradiance caching does it: what changes slowly is interpolated, what is known in
//! closed form is not. \[Ward88\]
//!
//! Direct light at a grid point is what the luminaires would give its place and normal without obstacles, times the
//! visible share, which the samples around know. Indirect light comes from samples that face nearly where the point
//! does. Both are linear functions of place fitted to the samples \[Loader99\]. A mean of radiances, as Shepard's,
//! blends lit and turned-away samples wherever a surface bends within their distance, and flattens gradients.

use crate::brdf::reflected;
use crate::direct::{luminance, open_irradiance};
use crate::flattened::Side;
use crate::illumination_grid::{IlluminationGrid, from_nearest, point_grid};
use crate::linear_fit::{NormalMatrix, Sums};
use crate::mask::{Mask, local_position};
use crate::progress::Tick;
use crate::radiance::RadianceSample;
use crate::scene::Scene;
use crate::split::share;
use crate::volume::Lattice;
use glam::{DVec3, DVec4, Vec3};
use rayon::prelude::*;

/// Volume of a ball of radius 1.
const UNIT_BALL: f64 = 4.0 / 3.0 * std::f64::consts::PI;
/// Least cosine between the normals of a point and of samples that it takes indirect light from.
const CONE: f32 = 0.7;
/// With fewer samples in that cone, those of any normal count.
const FEW: usize = 4;

/// Bytes per sample that [`interpolate`] takes, besides the samples and the search among them.
pub(crate) const BYTES: u64 = size_of::<Known>() as u64;

/// What a sample knows.
#[derive(Clone, Copy)]
struct Known {
    /// Where, in the world relative to Ω's corner.
    place: Vec3,
    normal: Vec3,
    /// Visible share of direct light, by channel.
    share: Vec3,
    /// Luminance of direct irradiance without obstacles.
    open: f32,
    /// Direct and indirect irradiance.
    direct: Vec3,
    indirect: Vec3,
    /// Variance of the radiance's luminance.
    variance: f32,
}

/// The grid over `lattice` of `side`'s samples, from the `neighbours` nearest of them at each point that `masks` say
/// holds light, or from as many as lie within a step of the lattice on average if these are more. Points where ∇h
/// vanishes take direct light as the samples have it. With several luminaires one share stands for all. `tick(n)`
/// reports n points done; returning false stops early. The same bits on any number of threads. Takes about 100 bytes
/// per sample.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "storage is f32, counts are positive")]
pub fn interpolate(
    scene: &Scene,
    side: Side,
    lattice: &Lattice,
    masks: &[Mask],
    samples: &[RadianceSample],
    neighbours: usize,
    tick: Tick,
) -> IlluminationGrid {
    let field = &scene.field;
    let points = masks.iter().filter(|&&m| m != Mask::Empty).count();
    let neighbours = neighbours.max((UNIT_BALL * samples.len() as f64 / points.max(1) as f64) as usize);
    let grid = point_grid(field, samples);
    let known: Vec<Known> = grid.numbers().par_iter().map(|&n| Known::new(scene, side, &samples[n as usize])).collect();
    from_nearest(lattice, masks, (&grid, neighbours), tick, |o, place, found| {
        let p = local_position(field, lattice, o);
        let around = NearSamples::new(place, found, &known);
        let normal = scene.normal(p, side);
        let direct = normal.map_or_else(|| around.direct(), |n| around.share() * open_irradiance(scene, p, n));
        let indirect = around.indirect(normal.unwrap_or_default().as_vec3());
        let albedo = scene.surface.albedo.at(field.value(p).clamp(0.0, 1.0));
        let radiance = reflected(albedo, (direct + indirect).max(DVec3::ZERO)) + scene.surface.emission;
        (radiance.as_vec3().to_array(), around.std_error(normal.unwrap_or_default().as_vec3()))
    })
}

impl Known {
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn new(scene: &Scene, side: Side, sample: &RadianceSample) -> Self {
        let p = sample.position.as_dvec3();
        let normal = scene.normal(p, side).unwrap_or_default();
        let open = open_irradiance(scene, p, normal);
        let [a, b] = sample.indirect;
        Self {
            place: (scene.lattice().axes() * p).as_vec3(),
            normal: normal.as_vec3(),
            share: share(sample.direct, open).as_vec3(),
            open: luminance(open) as f32,
            direct: sample.direct,
            indirect: 0.5 * (a + b),
            variance: sample.variance,
        }
    }
}

/// The samples around a point.
struct NearSamples<'a> {
    place: Vec3,
    /// Squared distance of each, and its number.
    found: &'a [(f32, u32)],
    known: &'a [Known],
    /// A little beyond the farthest.
    radius: f32,
}

impl<'a> NearSamples<'a> {
    fn new(place: Vec3, found: &'a [(f32, u32)], known: &'a [Known]) -> Self {
        let farthest = found.iter().map(|e| e.0).fold(0.0, f32::max);
        Self { place, found, known, radius: (farthest.sqrt() * 1.01).max(f32::MIN_POSITIVE) }
    }

    /// Offset of each sample in radii, its kernel's weight (Epanechnikov's), and what it knows.
    fn each(&self) -> impl Iterator<Item = (Vec3, f32, &'a Known)> {
        self.found.iter().map(|&(_, n)| {
            let k = &self.known[n as usize];
            let d = (k.place - self.place) / self.radius;
            (d, (1.0 - d.length_squared()).max(0.0), k)
        })
    }

    /// The linear function fitted to `value` of the samples by `weight`, at the point; 0 if all weights are 0.
    fn fit(&self, weight: impl Fn(&Known) -> f32, value: impl Fn(&Known) -> Vec3) -> DVec3 {
        let (mut matrix, mut sums) = (NormalMatrix::default(), Sums::default());
        for (d, kernel, k) in self.each() {
            let w = kernel * weight(k);
            matrix.add(w, d);
            sums.add(w * value(k), d);
        }
        if matrix.weight() <= 0.0 {
            return DVec3::ZERO;
        }
        sums.fitted(matrix.at_origin())
    }

    /// The visible share of direct light, by channel: samples count by the light they could get.
    fn share(&self) -> DVec3 {
        self.fit(|k| k.open, |k| k.share).clamp(DVec3::ZERO, DVec3::ONE)
    }

    /// Direct irradiance as the samples have it.
    fn direct(&self) -> DVec3 {
        self.fit(|_| 1.0, |k| k.direct)
    }

    /// Indirect irradiance of a point with unit `normal`.
    fn indirect(&self, normal: Vec3) -> DVec3 {
        self.fit(self.facing(normal), |k| k.indirect)
    }

    /// 1 for samples that face nearly as a point with unit `normal` does, or for all where those are few; 0 for others.
    fn facing(&self, normal: Vec3) -> impl Fn(&Known) -> f32 {
        let faces = move |k: &Known| k.normal.dot(normal) >= CONE;
        let few = self.each().filter(|(.., k)| faces(k)).take(FEW).count() < FEW;
        move |k| f32::from(few || faces(k))
    }

    /// Standard error at a point with unit `normal`, as if all of the samples' were of indirect light. \[Loader99\]
    #[allow(clippy::cast_possible_truncation, reason = "storage is f32")]
    fn std_error(&self, normal: Vec3) -> f32 {
        let counts = self.facing(normal);
        let each = || self.each().map(|(d, kernel, k)| (d, kernel * counts(k), k.variance));
        let mut matrix = NormalMatrix::default();
        each().for_each(|(d, w, _)| matrix.add(w, d));
        if matrix.weight() <= 0.0 {
            return 0.0;
        }
        // What the fit's value at the point takes of each sample.
        let g = matrix.at_origin();
        let taken = each().filter(|e| e.1 > 0.0).map(|(d, w, variance)| {
            let share = f64::from(w) * g.dot(DVec4::new(1.0, d.x.into(), d.y.into(), d.z.into()));
            share * share * f64::from(variance)
        });
        taken.sum::<f64>().sqrt() as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Field;
    use crate::illumination_grid::shepard;
    use crate::mask::masks;
    use crate::polygon::Polygon;
    use crate::rng::{Sobol, Stage};
    use crate::scene::{Boundary, Surface};
    use crate::volume::Samples;

    /// Level sets of `distance` 0.25 to 5 from the middle under a square luminaire.
    fn scene(distance: impl Fn(DVec3) -> f64) -> Scene {
        let lattice = Lattice::aligned([13; 3], DVec3::splat(-6.0), DVec3::ONE).unwrap();
        let at = |o: usize| lattice.point(o) - 6.0;
        let samples = (0..lattice.len()).map(|o| -distance(at(o)) as f32).collect();
        let field = Field::made(lattice, Samples::F32(samples), -5.0, -0.25);
        let corner = |x: f64, y: f64| DVec3::new(x, y, 12.0);
        let vertices = [corner(-4.0, -4.0), corner(-4.0, 4.0), corner(4.0, 4.0), corner(4.0, -4.0)];
        let light = Polygon::new("lamp", vertices.to_vec(), DVec3::ZERO, DVec3::new(3.0, 2.0, 1.0)).unwrap();
        Scene::new(field, Surface::default(), Boundary::Open, vec![light]).unwrap()
    }

    /// Samples all over, lit by `share` of the luminaire and `indirect` light.
    fn samples(
        scene: &Scene,
        share: impl Fn(DVec3) -> f64,
        indirect: impl Fn(DVec3, DVec3) -> f64,
    ) -> Vec<RadianceSample> {
        let set = Sobol::set(1, Stage::Test, 0);
        let place = |i: u32| {
            let [x, y] = set.point2(i, 0);
            12.0 * DVec3::new(x, y, set.coordinate(i, 2))
        };
        let inside = |p: &DVec3| (0.0..=1.0).contains(&scene.field.value(*p));
        (0..1500)
            .map(place)
            .filter(inside)
            .filter_map(|p| {
                let n = scene.normal(p, Side::Lower)?;
                let direct = share(p) * open_irradiance(scene, p, n);
                let indirect = DVec3::splat(indirect(p, n));
                let radiance = reflected(scene.surface.albedo.at(0.5), direct + indirect).as_vec3();
                let [direct, indirect] = [direct, indirect].map(|e| e.as_vec3());
                Some(RadianceSample {
                    position: p.as_vec3(),
                    radiance,
                    direct,
                    indirect: [indirect; 2],
                    ..Default::default()
                })
            })
            .collect()
    }

    /// Root mean square relative errors at the points on level sets, of this interpolation and of Shepard's.
    fn errors(scene: &Scene, share: impl Fn(DVec3) -> f64, indirect: impl Fn(DVec3, DVec3) -> f64) -> [f64; 2] {
        let (lattice, field) = (scene.lattice(), &scene.field);
        let (masks, samples) = (masks(field, lattice), samples(scene, &share, &indirect));
        let ours = interpolate(scene, Side::Lower, lattice, &masks, &samples, 16, &|_| true);
        let theirs = shepard(field, lattice, &masks, &samples, 16, &|_| true);
        let (mut squares, mut total) = ([0.0; 2], 0.0);
        for o in (0..lattice.len()).filter(|&o| masks[o] == Mask::Valid) {
            let p = local_position(field, lattice, o);
            let n = scene.normal(p, Side::Lower).unwrap();
            let irradiance = share(p) * open_irradiance(scene, p, n) + indirect(p, n);
            let truth = reflected(scene.surface.albedo.at(0.5), irradiance);
            for (square, grid) in squares.iter_mut().zip([&ours, &theirs]) {
                *square += (Vec3::from_array(grid.radiance[o]).as_dvec3() - truth).length_squared();
            }
            total += truth.length_squared();
        }
        squares.map(|s: f64| (s / total).sqrt())
    }

    #[test]
    fn light_without_obstacles_is_exact() {
        let [ours, shepard] = errors(&scene(DVec3::length), |_| 1.0, |_, _| 0.0);
        println!("{ours} against {shepard}");
        assert!(ours < 1e-6 && shepard > 0.02);
    }

    #[test]
    fn shares_and_indirect_light_that_change_linearly_are_found() {
        let [ours, shepard] =
            errors(&scene(DVec3::length), |p| 0.5 + 0.03 * (p.x - 6.0), |p, _| 0.05 + 0.004 * (p.y - 6.0));
        println!("{ours} against {shepard}");
        assert!(ours < 0.005 && ours < 0.2 * shepard);
    }

    #[test]
    fn light_on_one_side_of_a_sheet_stays_there() {
        let [ours, shepard] = errors(&scene(|p| p.x.abs()), |_| 0.0, |_, n| n.x.max(0.0));
        println!("{ours} against {shepard}");
        assert!(ours < 1e-6 && shepard > 0.005);
    }

    #[test]
    fn one_sample_is_everywhere() {
        let scene = scene(DVec3::length);
        let masks = masks(&scene.field, scene.lattice());
        let p = DVec3::new(9.0, 6.0, 6.0);
        let sample = RadianceSample { position: p.as_vec3(), indirect: [Vec3::ONE; 2], ..RadianceSample::default() };
        let grid = interpolate(&scene, Side::Lower, scene.lattice(), &masks, &[sample], 16, &|_| true);
        let expected = reflected(scene.surface.albedo.at(0.5), DVec3::ONE).as_vec3();
        for (r, m) in grid.radiance.iter().zip(&masks) {
            let expected = if *m == Mask::Empty { Vec3::ZERO } else { expected };
            assert!((Vec3::from_array(*r) - expected).length() < 1e-5, "{r:?}");
        }
    }

    /// Samples in one half of space, with errors: the spread of many grids is what one tells, beyond them, too.
    #[test]
    fn errors_go_through_the_fits() {
        const GRIDS: usize = 40;
        let scene = scene(DVec3::length);
        let (lattice, masks) = (scene.lattice(), masks(&scene.field, scene.lattice()));
        let mut all = samples(&scene, |_| 1.0, |_, _| 1.0);
        all.retain(|s| s.position.x < 6.5);
        let over_pi = scene.surface.albedo.at(0.5).x / std::f64::consts::PI;
        let mut rng = crate::rng::Rng::stream(1, Stage::Test, 0);
        let near = |o: &usize| masks[*o] != Mask::Empty && lattice.ijk(*o)[0] < 9;
        let points: Vec<usize> = (0..lattice.len()).filter(near).collect();
        let (mut sums, mut told) = (vec![[0.0; 2]; points.len()], 0.0);
        for _ in 0..GRIDS {
            let mut noisy = all.clone();
            for s in &mut noisy {
                let off = 0.1 * rng.normal();
                s.indirect = s.indirect.map(|e| e + off as f32);
                s.radiance += (over_pi * off) as f32;
                s.variance = (over_pi * 0.1).powi(2) as f32;
            }
            let grid = interpolate(&scene, Side::Lower, lattice, &masks, &noisy, 16, &|_| true);
            for (sum, &o) in sums.iter_mut().zip(&points) {
                let x = f64::from(grid.radiance[o][1]);
                (sum[0], sum[1]) = (sum[0] + x, sum[1] + x * x);
                told += f64::from(grid.std_error[o]).powi(2) / (GRIDS * points.len()) as f64;
            }
        }
        let n = GRIDS as f64;
        let spread = sums.iter().map(|[x, xx]| (xx - x * x / n) / (n - 1.0)).sum::<f64>() / points.len() as f64;
        println!("{} points, spread {:.5}, told {:.5}", points.len(), spread.sqrt(), told.sqrt());
        assert!(((told / spread).sqrt() - 1.0).abs() < 0.1, "{} {}", told.sqrt(), spread.sqrt());
    }
}
