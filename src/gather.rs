//! Final gather: one bounce of rays into light that is known, as a radiance cache holds it, more where surfaces of
//! several fields cross, within capped solids, and where none is known. \[Jensen01; Christensen99\]

use crate::direct::{Estimate, LEAST_UNANIMOUS, Receiver, direct_once, luminance};
use crate::flattened::{Departure, FlattenedHit, FlattenedRay, Side, SurfacePoint, Target};
use crate::landing::{Landing, MOST_LANDINGS, landing};
use crate::radiance_cache::RadianceCache;
use crate::rng::{Key, Rng};
use crate::scene::Scene;
use crate::stats::Moments;
use crate::tracer::Tracer;
use crate::warp::{Frame, cosine_hemisphere};
use glam::DVec3;
use std::f64::consts::PI;

/// Light that is known where gather rays land.
pub trait KnownLight: Sync {
    /// What hits nearer than this (cells of the scene's lattice) find is found by paths instead, and all that is near
    /// in a cavity ([`CAVITY`]); 0 trusts all.
    #[inline]
    fn least_distance(&self) -> f32 {
        0.0
    }

    /// Outgoing radiance where a ray landed, without what luminaires emit; `None` if that is not known. Counts up
    /// `misses` where there should be some but is not.
    fn radiance(&self, scene: &Scene, landed: SurfacePoint, misses: &mut u64) -> Option<DVec3>;
}

impl KnownLight for RadianceCache {
    #[inline]
    fn radiance(&self, scene: &Scene, landed: SurfacePoint, misses: &mut u64) -> Option<DVec3> {
        Some(self.lookup(scene, landed, misses))
    }
}

/// A gathered irradiance and its two halves.
#[derive(Clone, Copy, Debug, Default)]
pub struct Gathered {
    /// Of all rays.
    pub estimate: Estimate,
    /// Means of the first and the second half of the rays, well distributed each; both the mean of all if there is but
    /// one.
    pub halves: [DVec3; 2],
}

/// Hits on another field nearer than this many of its cells: surfaces of several fields cross, and light changes within
/// a cell of the cache where they do. Such hits find their own light, from the luminaires and along one ray more. A
/// field's own level sets never cross, so that the cache holds their light up close: the same errors at a tenth less
/// time.
const NEAR: f64 = 1.0;
/// Such hits in a row at most.
const CORNERS: usize = 4;
/// Of a receiver's rays that land so one in this many goes on, with the weight of all: Russian roulette on what light
/// in corners adds to what the cache says. \[Arvo90\]
const SHARE: u64 = 8;
/// A receiver's first rays, which show whether it is sealed off from all that is far.
const PILOT: u32 = 16;
/// A receiver whose first rays all end on level sets within this many cells is in a cavity, which may have closed or
/// opened between the isovalues that its light is interpolated from: nothing nearer than they are is trusted there.
pub const CAVITY: f32 = 16.0;

/// Indirect irradiance at `receiver`: π/M Σ L over `rays` cosine-distributed directions. Luminaires count 0, since
/// direct light is counted apart; what leaves everything carries nothing. \[BB09 Eq. 2\] A receiver that sees nothing
/// but dark surfaces all around, as inside another field's solid, is known to be dark after a quarter of its rays, but
/// at least 64, if all `light` is trusted: paths find none now and then where there is some.
pub fn gathered_irradiance<T: Tracer, L: KnownLight>(
    scene: &Scene,
    tracer: &T,
    light: &L,
    receiver: &Receiver,
    rays: u32,
    key: Key,
) -> Gathered {
    let frame = Frame::new(receiver.normal);
    let set = key.set();
    let mut sums = [DVec3::ZERO; 2];
    let first = rays / 2;
    let mut moments = Moments::default();
    // Rays that landed, and of them those that found any light.
    let (mut landed, mut lit) = (0, 0);
    let turn = key.nth(0xF_FFFF).bits();
    let ray = |i: u32| {
        let direction = frame.to_world(cosine_hemisphere(set.point2(i, 0)));
        scene.ray(receiver.position, direction, receiver.isovalue, receiver.departure)
    };
    let trusted = light.least_distance() == 0.0;
    let mut pilot = [None; PILOT as usize];
    let mut least_distance = light.least_distance();
    if !trusted {
        let shown = (0..rays).zip(&mut pilot).map(|(i, hit)| {
            let ray = ray(i);
            *hit = tracer.intersect(&ray);
            hit.filter(|hit| is_level_set(hit.target)).map_or(f32::INFINITY, |hit| hit.t * ray.direction.length())
        });
        let farthest = shown.fold(0.0, f32::max);
        if farthest < CAVITY {
            least_distance = least_distance.max(farthest);
        }
    }
    let mut corners = Corners { scene, tracer, light, least_distance, turn, rays: 0, misses: 0 };
    for i in 0..rays {
        if trusted && i == LEAST_UNANIMOUS.max(rays / 4) && landed == i && lit == 0 {
            break;
        }
        corners.rays += 1;
        let ray = ray(i);
        let hit = if trusted || i >= PILOT { tracer.intersect(&ray) } else { pilot[i as usize] };
        let radiance = hit.map_or(DVec3::ZERO, |hit| {
            landed += 1;
            let mut rng = || key.nth(i);
            corners.radiance(ray, hit, &mut rng)
        });
        lit += u32::from(radiance != DVec3::ZERO);
        sums[usize::from(i >= first)] += radiance;
        moments.push(luminance(radiance));
    }
    let n = f64::from(rays.max(1));
    let mean = (sums[0] + sums[1]) * (PI / n);
    let half = |sum: DVec3, count: u32| if first > 0 { sum * (PI / f64::from(count)) } else { mean };
    let Corners { rays: traced, misses, .. } = corners;
    // Corrections by a few rays may take more than there is.
    let estimate =
        Estimate { mean: mean.max(DVec3::ZERO), variance: PI * PI * moments.variance() / n, rays: traced, misses };
    Gathered { estimate, halves: [half(sums[0], first), half(sums[1], rays - first)] }
}

/// Whether a hit is on another field than its ray left, within [`NEAR`] cells.
#[inline]
fn near(scene: &Scene, ray: &FlattenedRay, hit: FlattenedHit) -> bool {
    let other = match (ray.departure, hit.target) {
        (Departure::Surface(_), Target::Companion(n, _)) => Some(n),
        (Departure::Companion(..), Target::Surface(_)) => None,
        (Departure::Companion(m, _), Target::Companion(n, _)) if m != n => Some(n),
        _ => return false,
    };
    let (from, to) = (ray.origin.as_dvec3(), ray.at(hit.t));
    let cells = match other {
        None => to - from,
        Some(n) => {
            let companion = &scene.companions()[usize::from(n)];
            companion.to_index(to) - companion.to_index(from)
        }
    };
    cells.length_squared() < NEAR * NEAR
}

/// Whether a hit is on a level set of any field.
#[inline]
fn is_level_set(target: Target) -> bool {
    matches!(target, Target::Surface(_) | Target::Companion(..))
}

/// Whether a hit is on the inside of a cap, whose light nothing holds: few scenes have any.
#[inline]
fn is_cap_from_within(hit: FlattenedHit) -> bool {
    matches!(hit.target, Target::Cap(_, Side::Higher))
}

/// What gathers in corners know.
struct Corners<'a, T, L> {
    scene: &'a Scene,
    tracer: &'a T,
    light: &'a L,
    /// Hits nearer than this (cells) go on as paths.
    least_distance: f32,
    /// Counts the rays that landed near.
    turn: u64,
    /// Rays traced, and those that landed where the cache holds nothing.
    rays: u64,
    misses: u64,
}

impl<T: Tracer, L: KnownLight> Corners<'_, T, L> {
    /// Radiance that arrives along `ray` from its `hit`: what is known if it is far away or nothing around it is lit,
    /// else on a path until it is. `rng` makes the random numbers of the path.
    #[inline]
    fn radiance(&mut self, ray: FlattenedRay, hit: FlattenedHit, rng: &mut dyn FnMut() -> Rng) -> DVec3 {
        let known = self.found(&ray, hit);
        let Some(there) = known else { return self.path(ray, hit, known, &mut rng()) };
        if there == DVec3::ZERO || !near(self.scene, &ray, hit) {
            return there;
        }
        self.turn = self.turn.wrapping_add(1);
        if !self.turn.is_multiple_of(SHARE) {
            return there;
        }
        there + (self.path(ray, hit, known, &mut rng()) - there) * SHARE as f64
    }

    /// What is known where a ray landed; `None` if nothing is, or it is too near to be trusted.
    #[inline]
    fn found(&mut self, ray: &FlattenedRay, hit: FlattenedHit) -> Option<DVec3> {
        let Self { scene, light, least_distance, .. } = *self;
        let near = least_distance > 0.0 && hit.t * ray.direction.length() < least_distance;
        if near || is_cap_from_within(hit) {
            return None;
        }
        // What is known of a luminaire is its front's.
        if let Target::Polygon(id) = hit.target
            && scene.polygons()[id as usize].opaque_back
            && !scene.sees_front(ray, id)
        {
            return Some(DVec3::ZERO);
        }
        let within = match (ray.departure, hit.target) {
            // Walls may stand in and out of solids.
            (Departure::Polygon(_) | Departure::Cap(..), Target::Polygon(_)) => scene.solid_holds(ray, hit.t),
            _ => scene.leaves_within(ray.departure),
        };
        let landed = SurfacePoint { target: hit.target, within, position: ray.at(hit.t), isovalue: ray.isovalue };
        light.radiance(scene, landed, &mut self.misses)
    }

    /// The same along a path from a `hit` that is near, or of which nothing is `known`. Russian roulette ends what goes
    /// on and on unknown. \[Arvo90\]
    #[cold]
    fn path(&mut self, mut ray: FlattenedRay, mut hit: FlattenedHit, mut known: Option<DVec3>, rng: &mut Rng) -> DVec3 {
        let Self { scene, tracer, .. } = *self;
        let (mut total, mut weight) = (DVec3::ZERO, DVec3::ONE);
        let mut corners = 0;
        for _ in 0..MOST_LANDINGS {
            if let Some(there) = known {
                if corners == CORNERS || there == DVec3::ZERO || !near(scene, &ray, hit) {
                    return total + weight * there;
                }
                corners += 1;
            }
            let Some(Landing { receiver, albedo, emission, .. }) = landing(scene, &ray, hit) else { return total };
            total += weight * emission;
            if albedo == DVec3::ZERO {
                return total;
            }
            weight *= albedo;
            total += weight * direct_once(scene, tracer, &receiver, rng, &mut self.rays) / PI;
            if known.is_none() {
                let survival = weight.max_element();
                if rng.unit() >= survival {
                    return total;
                }
                weight /= survival;
            }
            let direction = Frame::new(receiver.normal).to_world(cosine_hemisphere(rng.unit2()));
            ray = scene.ray(receiver.position, direction, ray.isovalue, receiver.departure);
            self.rays += 1;
            let Some(next) = tracer.intersect(&ray) else { return total };
            hit = next;
            known = self.found(&ray, hit);
        }
        total
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::Field;
    use crate::isovalue_axis::IsovalueAxis;
    use crate::photon::{FlatPhoton, Photons};
    use crate::radiance_cache::CacheSettings;
    use crate::rng::Stage;
    use crate::scene::{Boundary, Surface, cornell_box};
    use crate::volume::{Lattice, Samples};

    /// The floor, and nothing else.
    struct Floor(u32);

    impl Tracer for Floor {
        fn intersect(&self, ray: &FlattenedRay) -> Option<FlattenedHit> {
            let hit = FlattenedHit { t: -ray.origin.z / ray.direction.z, target: Target::Polygon(self.0) };
            (ray.direction.z < 0.0).then_some(hit)
        }
        fn occluded(&self, _: &FlattenedRay) -> bool {
            false
        }
    }

    /// Low on both sides of an upright level set, where a texel of the floor lies on both, too.
    #[test]
    fn either_side_gathers_its_own_light() {
        let lattice = Lattice::aligned([9; 3], DVec3::ZERO, DVec3::splat(0.125)).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[0] as f32).collect();
        let field = Field::made(lattice, Samples::F32(samples), 0.0, 8.0);
        let walls = cornell_box(field.lattice(), 0.0).unwrap();
        let floor = walls.iter().position(|p| p.name == "z_min").unwrap() as u32;
        // No luminaire: nothing is direct.
        let walls = walls.into_iter().filter(|p| p.emission == DVec3::ZERO).collect();
        let surface = Surface { both_sides: true, ..Surface::default() };
        let scene = Scene::new(field, surface, Boundary::Open, walls).unwrap();
        let photons = (0..400_000).filter_map(|i| {
            let mut rng = Rng::stream(1, Stage::Test, i);
            let [u, v, c] = [(); 3].map(|()| rng.unit());
            let x = scene.polygons()[floor as usize].at([u, v]).x;
            let uvc = [u, v, c].map(|x| x as f32);
            (x < c || rng.unit() < 0.25).then_some(FlatPhoton { flat: floor, uvc, power: glam::Vec3::ONE, bounces: 1 })
        });
        let photons = Photons { flat: photons.collect(), ..Photons::default() };
        let settings = CacheSettings {
            node_shadow_rays: 1,
            flat_shadow_rays: 1,
            flat_resolution: 16,
            isovalue_resolution: 8,
            axis: IsovalueAxis::EVEN,
            seed: 1,
        };
        let tracer = Floor(floor);
        let cache = RadianceCache::new(&scene, &tracer, &photons, &settings, &|_| true);
        let light = Side::BOTH.map(|side| {
            let position = DVec3::new(8.0 * 0.47, 4.0, 0.05);
            let normal = scene.normal(position, side).unwrap();
            let departure = Departure::Surface(side);
            let receiver = Receiver { position: position.as_vec3(), normal, isovalue: 0.47, departure };
            let found = gathered_irradiance(&scene, &tracer, &cache, &receiver, 1024, Stage::Gather.key(1, 1));
            let [a, b] = found.halves.map(|half| half.x);
            // Two halves, of which the whole is the mean.
            assert!(a != b && (0.5 * (a + b) / found.estimate.mean.x - 1.0).abs() < 1e-12, "{found:?}");
            found.estimate.mean.x
        });
        println!("{light:?}");
        assert!((light[0] / light[1] / 4.0 - 1.0).abs() < 0.05, "{light:?}");
    }

    /// A bright patch on a dark floor, which a ray in fifty finds: all that is known if nothing is too near.
    struct Patch(f32);

    impl KnownLight for Patch {
        fn least_distance(&self) -> f32 {
            self.0
        }
        fn radiance(&self, _: &Scene, landed: SurfacePoint, _: &mut u64) -> Option<DVec3> {
            let p = landed.position;
            Some(if (p.x - 4.0).abs() < 0.5 && (p.y - 4.0).abs() < 0.5 { DVec3::ONE } else { DVec3::ZERO })
        }
    }

    /// Where paths are in play, some rays that find none do not stand for the others.
    #[test]
    fn rare_light_counts_in_full() {
        let lattice = Lattice::aligned([9; 3], DVec3::ZERO, DVec3::splat(0.125)).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[0] as f32).collect();
        let field = Field::made(lattice, Samples::F32(samples), 0.0, 8.0);
        let mut walls = cornell_box(field.lattice(), 0.0).unwrap();
        walls.retain(|p| p.name == "z_min");
        let scene = Scene::new(field, Surface::default(), Boundary::Open, walls).unwrap();
        let position = DVec3::new(4.0, 4.0, 4.0).as_vec3();
        let receiver = Receiver { position, normal: -DVec3::Z, isovalue: 0.5, departure: Departure::Free };
        // Whoever trusts all light ends after 64 dark rays.
        for (trust, rays, count) in [(1e-6, 256, 2000), (0.0, 64, 4000)] {
            let found = |rays: u32, index: u64| {
                gathered_irradiance(&scene, &Floor(0), &Patch(trust), &receiver, rays, Stage::Gather.key(1, index))
                    .estimate
                    .mean
                    .x
            };
            let expected = found(1 << 18, 0);
            assert!((0.01..0.03).contains(&(expected / PI)), "{expected}");
            let mut few = Moments::default();
            (1..count).for_each(|index| few.push(found(rays, index)));
            assert!((few.mean() - expected).abs() < 4.5 * few.std_error(), "{trust}: {} {expected}", few.mean());
        }
    }
}
