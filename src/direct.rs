//! Direct light at a receiver: closed-form irradiance times the visible share, by shadow rays.

use crate::flattened::{Departure, FlattenedRay, Side};
use crate::luminaire::{Aim, unoccluded};
use crate::rng::{Key, Rng};
use crate::scene::Scene;
use crate::tracer::Tracer;
use glam::{DVec3, Vec3};

/// A point that receives light in one hyperplane.
#[derive(Clone, Copy, Debug)]
pub struct Receiver {
    /// Where, local frame.
    pub position: Vec3,
    /// Unit normal in the world, towards the lit side.
    pub normal: DVec3,
    /// Its hyperplane.
    pub isovalue: f32,
    /// What rays from it start on.
    pub departure: Departure,
}

impl Receiver {
    /// On the level set at `isovalue` through local `p`, on `side`; `None` where ∇h vanishes.
    #[inline]
    pub fn on_level_set(scene: &Scene, p: DVec3, isovalue: f32, side: Side) -> Option<Self> {
        let position = p.as_vec3();
        let normal = scene.normal(position.as_dvec3(), side)?;
        Some(Self { position, normal, isovalue, departure: Departure::Surface(side) })
    }

    /// The ray that asks whether world point `y` of luminaire `l` is seen.
    #[inline]
    pub fn shadow_ray(&self, scene: &Scene, y: DVec3, l: u32) -> FlattenedRay {
        let direction = scene.lattice().to_index(y).as_vec3() - self.position;
        FlattenedRay {
            reach: 1.0,
            departure: self.departure,
            target: Some(l),
            ..FlattenedRay::free(self.position, direction, self.isovalue)
        }
    }
}

/// A mean with the variance of its luminance, and the rays it cost.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Estimate {
    /// Mean per channel.
    pub mean: DVec3,
    /// Variance of the mean's luminance, as if its samples were independent: an upper bound for stratified ones.
    pub variance: f64,
    /// Rays traced.
    pub rays: u64,
    /// Of them, gather rays that landed where the cache holds nothing.
    pub misses: u64,
}

/// Luminance of linear RGB with sRGB's primaries. \[BT.709\]
#[inline]
pub fn luminance(rgb: DVec3) -> f64 {
    rgb.dot(DVec3::new(0.2126, 0.7152, 0.0722))
}

/// Luminous reflectance: the share of the luminance of `light` that `albedo` reflects; of no light, that of white
/// light. Variances of luminance become those of reflected light by its square: exactly, where noise is coloured as the
/// light.
#[inline]
pub fn luminous_reflectance(albedo: DVec3, light: DVec3) -> f64 {
    // Noise may leave a little less than nothing in a channel.
    let light = light.max(DVec3::ZERO);
    let arrives = luminance(light);
    if arrives > 0.0 { luminance(albedo * light) / arrives } else { luminance(albedo) }
}

/// Irradiance that all luminaires would give without obstacles at `p` (local frame) with unit normal `n` (world).
/// \[Lambert1760\]
pub fn open_irradiance(scene: &Scene, p: DVec3, n: DVec3) -> DVec3 {
    let x = scene.lattice().to_world(p);
    let lights = scene.luminaires().iter();
    lights.map(|light| light.emission * unoccluded(light, x, n)).sum()
}

/// No budget is cut below this.
const LEAST_RAYS: u32 = 8;
/// Fewer rays that agree do not speak for the rest: ending there takes slivers of light away and brings none back.
pub(crate) const LEAST_UNANIMOUS: u32 = 64;

/// Shadow rays for a receiver that may get the irradiance `open` (of its brightest channel, as E₀ is), of at most
/// `shadow_rays`: all from half the scene's E₀ on, and down to an eighth where there is less to get, so that light is
/// equally certain everywhere.
fn budget(reference_irradiance: f64, open: f64, shadow_rays: u32) -> u32 {
    let mut rays = shadow_rays;
    let mut full = 0.5 * reference_irradiance;
    while rays / 2 >= LEAST_RAYS && rays > shadow_rays / 8 && open < full {
        (rays, full) = (rays / 2, full / 2.0);
    }
    rays
}

/// Irradiance from all luminaires: for each, Lambert's closed form × Σ V_i g_i / Σ g_i over at most `shadow_rays`
/// low-discrepancy points y_i of its part above the horizon, with g = cos θ cos θ′/r²; next to the luminaire uniform
/// over its solid angle, with g = cos θ, since of points spread over the area hardly any lies where a receiver looks.
/// Exact where all or none are visible: there a quarter of the points, but at least 64, settles it; the rest is spent
/// in penumbras. Receivers that could get less than half of E₀ ([`Scene::reference_irradiance`]) get fewer rays, in
/// proportion down to an eighth. The ratio's bias falls with 1/shadow_rays; of more than 64 rays, light or shadow below
/// a 64th of what is open may be missed.
/// Luminaire l of L takes the points of `key` with L · index + l for its index.
pub fn direct_irradiance<T: Tracer>(
    scene: &Scene,
    tracer: &T,
    receiver: &Receiver,
    shadow_rays: u32,
    key: Key,
) -> Estimate {
    let lattice = scene.lattice();
    let x = lattice.to_world(receiver.position.as_dvec3());
    let mut out = Estimate::default();
    for (l, light) in (0..).zip(scene.luminaires()) {
        if light.is_left(l, receiver.departure) {
            continue;
        }
        let open = unoccluded(light, x, receiver.normal);
        if open == 0.0 {
            continue;
        }
        let Some(aim) = Aim::best(light, x, receiver.normal) else { continue };
        let budget = budget(scene.reference_irradiance(), light.emission.max_element() * open, shadow_rays);
        let pilot = (budget / 4).max(LEAST_UNANIMOUS);
        let index = key.index.wrapping_mul(scene.luminaires().len() as u64).wrapping_add(u64::from(l));
        let set = Key { index, ..key }.set();
        let (mut sum, mut seen, mut squares, mut seen_squares) = (0.0, 0.0, 0.0, 0.0);
        for i in 0..budget {
            if i == pilot && (seen == 0.0 || seen == sum) {
                break;
            }
            let (y, g) = aim.sample(set.point2(i, 0));
            if g == 0.0 {
                continue;
            }
            out.rays += 1;
            sum += g;
            squares += g * g;
            if !tracer.occluded(&receiver.shadow_ray(scene, y, l)) {
                seen += g;
                seen_squares += g * g;
            }
        }
        if sum == 0.0 {
            continue;
        }
        let share = seen / sum;
        out.mean += light.emission * (open * share);
        // Σ g²(V − share)² / (Σ g)², the delta method for a ratio.
        let spread = (seen_squares * (1.0 - 2.0 * share) + squares * share * share) / (sum * sum);
        out.variance += (luminance(light.emission) * open).powi(2) * spread.max(0.0);
    }
    out
}

/// Direct irradiance from one random point per luminaire, counting `rays`: noisy, unbiased and bounded.
pub fn direct_once<T: Tracer>(scene: &Scene, tracer: &T, receiver: &Receiver, rng: &mut Rng, rays: &mut u64) -> DVec3 {
    let x = scene.lattice().to_world(receiver.position.as_dvec3());
    let mut total = DVec3::ZERO;
    for (l, light) in (0..).zip(scene.luminaires()) {
        let u = rng.unit2();
        let (y, g) = Aim::new(light, x, receiver.normal).map_or((x, 0.0), |aim| aim.sample(u));
        if g > 0.0 && !light.is_left(l, receiver.departure) {
            *rays += 1;
            if !tracer.occluded(&receiver.shadow_ray(scene, y, l)) {
                total += light.emission * g;
            }
        }
    }
    total
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Field;
    use crate::flattened::FlattenedHit;
    use crate::polygon::Polygon;
    use crate::rng::Stage;
    use crate::scene::{Boundary, Surface, cornell_box};
    use crate::stats::Moments;
    use crate::volume::{Lattice, Samples};

    /// What hides a luminaire but for a strip of it.
    struct Slit<'a> {
        scene: &'a Scene,
        light: &'a Polygon,
        open: [f64; 2],
    }

    impl Tracer for Slit<'_> {
        fn intersect(&self, _: &FlattenedRay) -> Option<FlattenedHit> {
            None
        }

        fn occluded(&self, ray: &FlattenedRay) -> bool {
            let y = self.scene.lattice().to_world((ray.origin + ray.reach * ray.direction).as_dvec3());
            !(self.open[0]..self.open[1]).contains(&self.light.texture(y)[0])
        }
    }

    #[test]
    fn budgets_fall_with_what_there_is_to_get_but_not_below_eight_rays() {
        for (open, rays, expected) in
            [(0.6, 256, 256), (0.4, 256, 128), (0.0, 256, 32), (0.0, 32, 8), (0.0, 12, 12), (0.0, 18, 9), (0.0, 4, 4)]
        {
            assert_eq!(budget(1.0, open, rays), expected, "{open}, {rays}");
        }
    }

    /// Where noise is coloured as the light, the reflected luminance is a multiple of what arrives.
    #[test]
    fn luminance_is_reflected_by_the_light_that_there_is() {
        let (grey, blue) = (DVec3::splat(0.75), DVec3::new(0.0, 0.0, 0.75));
        assert!((luminous_reflectance(grey, DVec3::new(3.0, 0.1, 7.0)) - 0.75).abs() < 1e-12);
        assert!((luminous_reflectance(blue, DVec3::Z * 9.0) - 0.75).abs() < 1e-12);
        assert_eq!(luminous_reflectance(blue, DVec3::X), 0.0);
        let mixed = luminous_reflectance(DVec3::new(0.63, 0.065, 0.05), DVec3::new(0.3, -0.089, 0.0));
        assert!((mixed - 0.63).abs() < 1e-12, "{mixed}");
        assert!((luminous_reflectance(blue, DVec3::ZERO) - 0.75 * 0.0722).abs() < 1e-12);
    }

    /// Slivers of light and of shadow, in the mean over receivers' point sets, however many rays: what ended where the
    /// first rays agreed lost half of the narrowest.
    #[test]
    fn slivers_of_light_and_shadow_are_found_in_the_mean() {
        let lattice = Lattice::aligned([9; 3], DVec3::ZERO, DVec3::splat(0.125)).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[2] as f32).collect();
        let field = Field::made(lattice, Samples::F32(samples), 0.5, 7.5);
        let walls = cornell_box(field.lattice(), 0.0).unwrap();
        let scene = Scene::new(field, Surface::default(), Boundary::Open, walls).unwrap();
        let light = &scene.luminaires()[0];
        let x = DVec3::new(0.4, 0.55, 0.3);
        let receiver = Receiver {
            position: scene.lattice().to_index(x).as_vec3(),
            normal: DVec3::Z,
            isovalue: 0.5,
            departure: Departure::Free,
        };
        let whole = unoccluded(light, x, receiver.normal);
        for open in [[0.3, 0.32], [0.6, 0.7], [0.0, 0.97]] {
            let corners = [[open[0], 0.0], [open[1], 0.0], [open[1], 1.0], [open[0], 1.0]].map(|uv| light.at(uv));
            let strip = Polygon::new("strip", corners.to_vec(), DVec3::ZERO, light.emission).unwrap();
            let expected = unoccluded(&strip, x, receiver.normal).abs() / whole;
            for rays in [8, 16, 64, 256] {
                let slit = Slit { scene: &scene, light, open };
                let (mut found, mut told) = (Moments::default(), 0.0);
                let full = light.emission.x * whole;
                for index in 0..4000 {
                    let key = Stage::Test.key(1, index);
                    let light = direct_irradiance(&scene, &slit, &receiver, rays, key);
                    found.push(light.mean.x / full);
                    told += light.variance / (4000.0 * full * full);
                }
                // Of points that count nearly alike: low-discrepancy ones are better than is told.
                if open == [0.6, 0.7] && rays == 256 {
                    let of_random = expected * (1.0 - expected) / f64::from(rays);
                    assert!((told / of_random - 1.0).abs() < 0.3, "{told} {of_random}");
                }
                let off = (found.mean() - expected).abs();
                // The ratio's bias, and what 64 rays that agree may miss of more.
                let allowed = if rays > LEAST_UNANIMOUS { 0.25 / 64.0 } else { 0.003 * expected.min(1.0 - expected) };
                assert!(
                    off < 5.0 * found.std_error() + allowed,
                    "{rays} rays, open {open:?}: {} of {expected}",
                    found.mean()
                );
            }
        }
    }
}
