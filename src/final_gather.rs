//! What a bake shows where one looks: its light between the points of its grid, or, by rays from the very place, direct
//! light past what really stands in its way and indirect light by one more final gather, into the bake.
//! \[Jensen01; Christensen99\]
//!
//! A 3D texture blurs light over a voxel. Where one looks, that is seen; where gather rays land, the next reflection
//! averages over it. What lands within a few voxels sees that blur as well as the eye does: such rays go on as paths.

use crate::brdf::reflected;
use crate::direct::{Estimate, Receiver, direct_irradiance};
use crate::error::{Error, Result};
use crate::export::bake_file::BakedVolume;
use crate::flat;
use crate::flattened::{Departure, FlattenedHit, FlattenedRay, Side, SurfacePoint, Target, split_face};
use crate::gather::{KnownLight, gathered_irradiance};
use crate::landing::{Landing, landing};
use crate::rng::Stage;
use crate::scene::{Policy, Scene};
use crate::tracer::Tracer;
use glam::DVec3;
use std::f64::consts::PI;
use std::sync::atomic::{AtomicU64, Ordering};

/// Rays from every place that is looked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FinalGatherSettings {
    /// Shadow rays per luminaire, the most, as those of a bake's samples.
    pub shadow_rays: u32,
    /// Gather rays; 0 takes indirect light from the grid of a split bake, and that of walls and caps from their
    /// textures. The more, the less of the bake is taken for true, so that what is off by interpolation ends: only what
    /// lands beyond √n / 4 cells.
    pub gather_rays: u32,
}

impl FinalGatherSettings {
    /// Refuses what `baked` has no light for.
    ///
    /// # Errors
    /// `NotSupported` without gather rays, if it does not hold indirect light by itself; if it does not hold all that
    /// lit it, or holds fields that gave each other no light.
    pub fn check(self, baked: &BakedVolume) -> Result<()> {
        baked.whole()?;
        if !baked.companions.is_empty() && baked.scene.policy() == Policy::Independent {
            return Err(Error::NotSupported(
                "holds several volumes that give each other no light, and rays see all; name the .vti of one of them"
                    .into(),
            ));
        }
        let split = |b: &BakedVolume| b.sides.iter().all(|(_, grid)| grid.split.is_some());
        if self.gather_rays == 0 && !(split(baked) && baked.companions.iter().all(split)) {
            return Err(Error::NotSupported(
                "holds direct and indirect light in one, of which --shadow-rays replaces a part; add --gather-rays 64, or \
                 bake with --split"
                    .into(),
            ));
        }
        Ok(())
    }

    /// Hits nearer than this (cells) go on as paths, which are noisy, but not off.
    fn least_distance(self) -> f32 {
        (self.gather_rays as f32).sqrt() / 4.0
    }
}

/// Light of a bake, found by rays where one looks. The same bits for the same places and indices, on any number of
/// threads.
#[derive(Debug)]
pub struct FinalGather<'a, T> {
    baked: &'a BakedVolume,
    tracer: &'a T,
    settings: FinalGatherSettings,
    rays: AtomicU64,
}

/// The seed of all rays: two pictures of a bake differ by what they show.
const SEED: u64 = 0;

impl<'a, T: Tracer> FinalGather<'a, T> {
    /// Into `baked`, whose scene `tracer` traces.
    ///
    /// # Errors
    /// As [`FinalGatherSettings::check`].
    pub fn new(baked: &'a BakedVolume, tracer: &'a T, settings: FinalGatherSettings) -> Result<Self> {
        settings.check(baked)?;
        Ok(Self { baked, tracer, settings, rays: AtomicU64::new(0) })
    }

    /// Radiance that leaves where a picture's `ray` landed, with what luminaires emit. `index` tells places apart.
    /// `None` on a side that the bake does not hold, without gather rays.
    pub fn seen(&self, ray: &FlattenedRay, hit: FlattenedHit, index: u64) -> Option<DVec3> {
        let shown = || seen(self.baked, ray, hit);
        match hit.target {
            Target::Cap(_, Side::Higher) => return shown(),
            Target::Cap(..) | Target::Polygon(_) if self.settings.gather_rays == 0 => return shown(),
            _ => {}
        }
        let Some(landed) = landing(&self.baked.scene, ray, hit) else { return shown() };
        let Landing { receiver, albedo, emission, .. } = landed;
        let luminaire = match hit.target {
            Target::Polygon(id) if albedo != DVec3::ZERO => self.baked.scene.polygons()[id as usize].emission,
            Target::Polygon(_) => return shown(),
            _ => DVec3::ZERO,
        };
        Some(self.leaving(&receiver, albedo, emission, index)?.mean + luminaire)
    }

    /// Radiance that leaves `receiver`, which is no luminaire.
    fn leaving(&self, receiver: &Receiver, albedo: DVec3, emission: DVec3, index: u64) -> Option<Estimate> {
        let Self { baked, tracer, settings, .. } = *self;
        let scene = &baked.scene;
        let p = receiver.position.as_dvec3();
        // A luminaire's own front is what covers.
        let shines = |id: u32| scene.polygons()[id as usize].emission != DVec3::ZERO;
        let front = matches!(receiver.departure, Departure::Polygon(id) if shines(id));
        if !front && scene.covers(scene.lattice().to_world(p)) {
            return Some(Estimate { mean: emission, ..Estimate::default() });
        }
        let (rest, gathered) = match settings.gather_rays {
            0 => (indirect(baked, receiver.departure, p)?, Estimate::default()),
            gather_rays => {
                let known = BakedLight { baked, least_distance: settings.least_distance() };
                let light =
                    gathered_irradiance(scene, tracer, &known, receiver, gather_rays, Stage::Gather.key(SEED, index))
                        .estimate;
                (reflected(albedo, light.mean) + emission, light)
            }
        };
        let direct = direct_irradiance(scene, tracer, receiver, settings.shadow_rays, Stage::Direct.key(SEED, index));
        let rays = direct.rays + gathered.rays;
        self.rays.fetch_add(rays, Ordering::Relaxed);
        // No less than what colours make of it.
        let scale = albedo.max_element() / PI;
        Some(Estimate {
            mean: (reflected(albedo, direct.mean) + rest).max(DVec3::ZERO),
            variance: (direct.variance + gathered.variance) * scale * scale,
            rays,
            misses: gathered.misses,
        })
    }

    /// Radiance that leaves the outside of level set `isovalue` (units of the sweep) at local position `p`, and the
    /// variance that rays leave in it: not what the bake itself is off by. `None` as [`FinalGather::seen`].
    pub fn outside(&self, p: DVec3, isovalue: f32, index: u64) -> Option<Estimate> {
        let scene = &self.baked.scene;
        let side = scene.surface.outside;
        let Some(receiver) = Receiver::on_level_set(scene, p, isovalue, side) else {
            return Some(Estimate { mean: self.baked.radiance(side, p)?, ..Estimate::default() });
        };
        self.leaving(&receiver, scene.surface.albedo.at(f64::from(isovalue)), scene.surface.emission, index)
    }

    /// Rays traced so far.
    pub fn rays(&self) -> u64 {
        self.rays.load(Ordering::Relaxed)
    }
}

/// The bake that holds the level sets of companion `n`, or of the scene's own field, and local position `p` in its
/// frame.
fn holder(baked: &BakedVolume, n: Option<u8>, p: DVec3) -> (&BakedVolume, DVec3) {
    let Some(n) = n.map(usize::from) else { return (baked, p) };
    (&baked.companions[n], baked.scene.companions()[n].to_index(p))
}

/// What leaves a level set at local position `p`, but for what it reflects of direct light; `None` if that is not
/// stored.
fn indirect(baked: &BakedVolume, departure: Departure, p: DVec3) -> Option<DVec3> {
    let (n, side) = match departure {
        Departure::Surface(side) => (None, side),
        Departure::Companion(n, side) => (Some(n), side),
        Departure::Free | Departure::Polygon(_) | Departure::Cap(..) => return None,
    };
    let (own, p) = holder(baked, n, p);
    Some(own.grid(side)?.indirect_at(own.lattice(), p).unwrap_or_default())
}

/// What leaves a level set at local position `p`; `None` if that is not stored, or no point around holds something.
fn stored(baked: &BakedVolume, n: Option<u8>, side: Side, p: DVec3) -> Option<DVec3> {
    let (own, p) = holder(baked, n, p);
    own.grid(side)?.known_at(&own.scene, own.lattice(), p, side)
}

/// Baked radiance where a picture's `ray` landed, with what luminaires emit; `None` on a side that is not stored.
pub fn seen(baked: &BakedVolume, ray: &FlattenedRay, hit: FlattenedHit) -> Option<DVec3> {
    let scene = &baked.scene;
    let p = ray.at(hit.t);
    match hit.target {
        Target::Surface(side) | Target::Companion(_, side) => {
            let (own, p) = holder(baked, hit.target.companion(), p);
            own.radiance(side, p)
        }
        Target::Cap(_, Side::Higher) => Some(DVec3::ZERO),
        // Beyond the outermost centres linear functions go on, below 0 where light ends.
        Target::Cap(face, Side::Lower) => cap(baked, face, p, ray.isovalue).map(|light| light.max(DVec3::ZERO)),
        Target::Polygon(id) => {
            let polygon = &scene.polygons()[id as usize];
            // From behind, only luminaires are seen: black.
            if !scene.sees_front(ray, id) {
                return Some(DVec3::ZERO);
            }
            match wall(baked, (id, scene.solid_holds(ray, hit.t)), p, ray.isovalue) {
                Some(light) => Some(polygon.emission + light.max(DVec3::ZERO)),
                None => Some(polygon.emission).filter(|emission| *emission != DVec3::ZERO),
            }
        }
    }
}

/// What polygon `id` reflects at local position `p` to what is within solids, or not; `None` if that is not stored.
fn wall(baked: &BakedVolume, (id, within): (u32, bool), p: DVec3, isovalue: f32) -> Option<DVec3> {
    // Those without a texture reflect nothing.
    let Some(light) = &baked.flats[id as usize] else { return Some(DVec3::ZERO) };
    let [u, v] = baked.scene.polygons()[id as usize].texture(baked.lattice().to_world(p));
    Some(light.seen(within)?.lookup([u, v, f64::from(isovalue)]))
}

/// What the texture of the cap on a face of Ω holds at local position `p`, if it has one: each bake holds its own.
fn cap(baked: &BakedVolume, face: u8, p: DVec3, isovalue: f32) -> Option<DVec3> {
    let scene = &baked.scene;
    let (companion, own) = split_face(face);
    let holder = companion.map_or(baked, |n| &baked.companions[usize::from(n)]);
    let light = holder.flats.get(scene.polygons().len() + usize::from(own))?.as_ref()?;
    let [u, v] = flat::face_texture(scene, face, p);
    Some(light.outside.lookup([u, v, f64::from(isovalue)]))
}

/// A bake where gather rays land. Rays go on where it holds nothing: from sides and cells that are not stored, from
/// caps within solids, and from walls there unless these hold light of their own.
struct BakedLight<'a> {
    baked: &'a BakedVolume,
    least_distance: f32,
}

impl KnownLight for BakedLight<'_> {
    fn least_distance(&self) -> f32 {
        self.least_distance
    }

    fn radiance(&self, _: &Scene, landed: SurfacePoint, _: &mut u64) -> Option<DVec3> {
        let SurfacePoint { target, within, position, isovalue } = landed;
        match target {
            Target::Surface(side) | Target::Companion(_, side) => {
                stored(self.baked, target.companion(), side, position)
            }
            Target::Cap(_, Side::Higher) => None,
            Target::Cap(face, Side::Lower) => Some(cap(self.baked, face, position, isovalue).unwrap_or_default()),
            Target::Polygon(id) => {
                let one_for_all = self.baked.flats[id as usize].as_ref().is_some_and(|light| light.own().is_none());
                if within && one_for_all { None } else { wall(self.baked, (id, within), position, isovalue) }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bake::{BakeOptions, BakeSettings, Engine, bake};
    use crate::brdf::reflected;
    use crate::direct::open_irradiance;
    use crate::embree::{Device, GraphTracer};
    use crate::field::{Field, Sweep};
    use crate::flat::{FlatLight, FlatTexture, Within};
    use crate::polygon::Polygon;
    use crate::progress::Progress;
    use crate::rng::Rng;
    use crate::scene::{Boundary, Surface, cornell_box};
    use crate::split::Split;
    use crate::stats::Moments;
    use crate::volume::{Lattice, Samples, Volume};
    use glam::Vec3;
    use std::f64::consts::TAU;

    const ALBEDO: f64 = 0.5;
    const GLOW: f64 = 0.3;

    /// Spheres around the origin of [−1, 1]³, cells of 0.05, that are lit from within or from without.
    fn spheres(outside: Side, luminaires: Vec<Polygon>) -> Scene {
        let lattice = Lattice::aligned([41; 3], DVec3::splat(-1.0), DVec3::splat(0.05)).unwrap();
        let place = |o: usize| lattice.to_world(lattice.point(o));
        let samples = (0..lattice.len()).map(|o| place(o).length()).collect();
        let field = Field::made(lattice.clone(), Samples::F64(samples), 0.2, 0.9);
        let albedo = DVec3::splat(ALBEDO).into();
        let surface = Surface { albedo, emission: DVec3::splat(GLOW), outside, both_sides: false };
        Scene::new(field, surface, Boundary::Open, luminaires).unwrap()
    }

    /// A bake of `scene` whose light is the same everywhere.
    fn baked(scene: Scene, radiance: f32, split: Option<[f32; 2]>) -> BakedVolume {
        let options = BakeOptions {
            engine: Some(Engine::Photon),
            photons: Some(100),
            shadow_rays: Some(1),
            gather_rays: Some(1),
            wall_resolution: Some(4),
            ..BakeOptions::default()
        };
        let settings = BakeSettings::new(&options, &scene).unwrap();
        let bake = bake(&scene, &settings, &Device::new(1).unwrap(), Progress::Quiet).unwrap();
        let mut baked = BakedVolume::new(scene, bake);
        let grid = &mut baked.sides[0].1;
        grid.radiance.fill([radiance; 3]);
        let all = |x| vec![[x; 3]; grid.mask.len()];
        grid.split = split.map(|[indirect, visible]| Split { indirect: all(indirect), visible: all(visible) });
        baked
    }

    /// What leaves places all over a sphere, less what is expected there, and the mean of the variances that are said.
    fn found(
        baked: &BakedVolume,
        [shadow_rays, gather_rays]: [u32; 2],
        (radius, places): (f64, u32),
        expected: impl Fn(DVec3, DVec3) -> f64,
    ) -> (Moments, f64) {
        let device = Device::new(0).unwrap();
        let tracer = GraphTracer::new(&device, &baked.scene).unwrap();
        let gather = FinalGather::new(baked, &tracer, FinalGatherSettings { shadow_rays, gather_rays }).unwrap();
        let (mut off, mut said) = (Moments::default(), 0.0);
        for i in 0..places {
            let z = 1.0 - 2.0 * (f64::from(i) + 0.5) / f64::from(places);
            let turn = TAU * f64::from(i) * 0.618_034;
            let n = DVec3::new((1.0 - z * z).sqrt() * turn.cos(), (1.0 - z * z).sqrt() * turn.sin(), z);
            let p = baked.lattice().to_index(radius * n);
            let c = baked.scene.field.value(p) as f32;
            let light = gather.outside(p, c, u64::from(i)).unwrap();
            said += light.variance / f64::from(places);
            off.push(light.mean.x - expected(p, baked.scene.normal(p, baked.scene.surface.outside).unwrap()));
        }
        assert!(gather.rays() >= u64::from(places * gather_rays));
        (off, said)
    }

    /// Within a sphere that glows e and reflects ρ there is e / (1 − ρ) everywhere. Of a bake that is off by d a few
    /// rays, all of which it answers but grazing ones, see ρ d; many, all of which are too near to trust it, nothing;
    /// nor do few in a small sphere, which all end nearby.
    #[test]
    fn what_is_near_is_found_by_paths() {
        let within = GLOW / (1.0 - ALBEDO);
        for off in [0.0, 0.4] {
            let wrong = baked(spheres(Side::Lower, Vec::new()), (within + off) as f32, None);
            // √n / 4 is 1 cell, and the sphere 28 wide; 32 cells; 1 and 12.
            for (rays, radius, seen, most) in [(16, 0.7, off, 0.02), (16384, 0.7, 0.0, 0.004), (16, 0.3, 0.0, 0.04)] {
                let places = 400 / u32::ilog2(rays);
                let (off_by, said) = found(&wrong, [1, rays], (radius, places), |_, _| within + ALBEDO * seen);
                let allowed = 0.02 * seen + 4.5 * off_by.std_error();
                let right = allowed < most && off_by.mean().abs() < allowed;
                assert!(right, "{rays} rays, off by {off}: {} ± {allowed}", off_by.mean());
                // Not more than that of independent rays, which is known to √(2/n).
                let share = off_by.variance() / said;
                println!("{rays} rays, off by {off}: {share} of the variance that is said");
                let limit = 1.0 + 4.5 * (2.0 / f64::from(places)).sqrt();
                assert!(share > 0.05 && share < limit, "{rays} rays, off by {off}: {share} of {said}");
            }
        }
    }

    /// Nothing hides a luminaire from a sphere but its own horizon: shadow rays find the closed form, whatever the bake
    /// says is visible, and the rest as the bake has it.
    #[test]
    fn shadow_rays_replace_the_visible_share() {
        let corners = [[-0.3, -0.3], [0.3, -0.3], [0.3, 0.3], [-0.3, 0.3]].map(|[x, y]| DVec3::new(y, x, 1.4));
        let above = Polygon::new("above", corners.to_vec(), DVec3::ZERO, DVec3::splat(3.0)).unwrap();
        let scene = spheres(Side::Higher, vec![above]);
        let own = scene.clone();
        let split = baked(scene, 9.0, Some([0.25, 0.1]));
        let direct = |p, n| reflected(DVec3::splat(ALBEDO), open_irradiance(&own, p, n)).x;
        let (off, _) = found(&split, [64, 0], (0.7, 300), |p, n| 0.25 + direct(p, n));
        assert!(off.mean().abs() < 1e-3 && off.variance() < 1e-4, "{} {}", off.mean(), off.variance());
        let (lit, _) = found(&split, [64, 0], (0.7, 300), |_, _| 0.25);
        assert!(lit.mean() > 0.01, "{}", lit.mean());
    }

    /// A room half full of a solid, seen from far in front of it: its walls show each side's own light, whatever f32
    /// makes of where a ray lands; within the solid none, or that of all, if no other is known. So do gather rays.
    #[test]
    fn walls_show_the_side_that_is_seen() {
        let lattice = Lattice::aligned([17; 3], DVec3::splat(0.3), DVec3::splat(1.0 / 16.0)).unwrap();
        let samples = (0..lattice.len()).map(|o| lattice.ijk(o)[2] as f32).collect();
        let volume = Volume::new("planes", lattice.clone(), Samples::F32(samples)).unwrap();
        let room = |volume: &Volume, outside: Side| {
            let field = Field::new(volume, Sweep::new(0.0, 16.0).unwrap()).unwrap();
            let walls = cornell_box(&lattice, 0.0).unwrap();
            Scene::new(field, Surface { outside, ..Surface::default() }, Boundary::Open, walls).unwrap()
        };
        let device = Device::new(1).unwrap();
        let shows = |light: f32| {
            let black = FlatTexture::black([4, 4, 4]);
            FlatTexture { texels: vec![[light; 3]; black.texels.len()], ..black }
        };
        let cases = [(Within::Same, Some(1.0)), (Within::Own(shows(2.0)), Some(2.0)), (Within::Unknown, None)];
        for ((known, shown), outside) in cases.iter().flat_map(|case| [(case, Side::Lower), (case, Side::Higher)]) {
            let mut baked = baked(room(&volume, outside), 0.0, None);
            let light = FlatLight { outside: shows(1.0), within: known.clone() };
            baked.flats.iter_mut().flatten().for_each(|flat| *flat = light.clone());
            let scene = &baked.scene;
            let tracer = GraphTracer::new(&device, scene).unwrap();
            let (eye, mut walls) = (DVec3::new(0.61, -9.7, 0.77), [0; 2]);
            for i in 0..4000 {
                let mut rng = Rng::stream(1, Stage::Test, i);
                let target = lattice.to_world(lattice.far() * DVec3::new(rng.unit(), 1.0, rng.unit()));
                let (at, c) = (lattice.to_index(eye).as_vec3(), 0.25 + 0.5 * rng.unit() as f32);
                let ray = scene.ray(at, target - eye, c, Departure::Free);
                let Some(hit) = tracer.intersect(&ray) else { continue };
                let Target::Polygon(id) = hit.target else { continue };
                let height = ray.at(hit.t).z / 16.0 - f64::from(c);
                if height.abs() < 1e-4 || baked.flats[id as usize].is_none() {
                    continue;
                }
                let within = (height > 0.0) == (outside == Side::Lower);
                let expected = if within { shown.map(Vec3::splat) } else { Some(Vec3::ONE) };
                walls[usize::from(within)] += 1;
                let emission = scene.polygons()[id as usize].emission;
                let found = seen(&baked, &ray, hit).map(|light| (light - emission).as_vec3());
                assert_eq!(found, expected, "{known:?} {outside:?} {height}");
            }
            assert!(walls[0] > 500 && walls[1] > 500, "{walls:?}");
            // From the middle of a wall, above and below the level set.
            let x = scene.polygons().iter().position(|p| p.name == "x_min").unwrap() as u32;
            let [above, below] = [0.25, 0.75].map(|isovalue| {
                let (position, departure) = (Vec3::new(0.0, 8.0, 8.0), Departure::Polygon(x));
                let receiver = Receiver { position, normal: DVec3::X, isovalue, departure };
                gathered_irradiance(scene, &tracer, &Inside, &receiver, 256, Stage::Gather.key(1, 1)).estimate.mean.x
            });
            let [within, without] = if outside == Side::Lower { [above, below] } else { [below, above] };
            assert!(within > 1.5 && without == 0.0, "{outside:?}: {within} {without}");
            // All of a background is at its isovalue, whatever rounding makes of that between samples.
            let background = Samples::F32(vec![0.3; lattice.len() - 1].into_iter().chain([16.0]).collect());
            let background = Volume::new("background", lattice.clone(), background).unwrap();
            let scene = room(&background, outside);
            let rays = (0..1000).map(|i| {
                let mut rng = Rng::stream(1, Stage::Test, i);
                let target = lattice.to_world(lattice.far() * DVec3::new(0.9 * rng.unit(), 1.0, 0.9 * rng.unit()));
                scene.ray(lattice.to_index(eye).as_vec3(), target - eye, scene.field.samples()[0], Departure::Free)
            });
            assert!(rays.into_iter().all(|ray| !scene.solid_holds(&ray, 1.0)), "{outside:?}");
        }
    }

    /// Light on walls within solids only.
    struct Inside;

    impl KnownLight for Inside {
        fn radiance(&self, _: &Scene, landed: SurfacePoint, _: &mut u64) -> Option<DVec3> {
            Some(DVec3::splat(f64::from(landed.within)))
        }
    }

    #[test]
    fn what_the_bake_cannot_tell_is_refused() {
        let whole = baked(spheres(Side::Lower, Vec::new()), 1.0, None);
        let told = |settings: FinalGatherSettings| settings.check(&whole).map_err(|e| e.to_string());
        let refused = told(FinalGatherSettings { shadow_rays: 16, gather_rays: 0 }).unwrap_err();
        assert!(refused.contains("--gather-rays") && refused.contains("--split"), "{refused}");
        assert_eq!(told(FinalGatherSettings { shadow_rays: 16, gather_rays: 4 }), Ok(()));
    }
}
