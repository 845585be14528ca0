//! What flats show, as textures: direct light of every texel, and the density of photons of later landings on that part
//! of it that light reaches.

use super::Filler;
use super::binned::{Binned, GATHERED, SHOWN, Width};
use super::openings::{CoveredPart, Open, Solid, is_open};
use crate::brdf::reflected;
use crate::direct::{Estimate, Receiver, direct_irradiance};
use crate::flat::{self, Flat, FlatLight, FlatTexture, Texel, Within};
use crate::neighbourhood::neighbourhood;
use crate::photon::FlatPhoton;
use crate::progress::Tick;
use crate::rng::Stage;
use crate::tracer::Tracer;
use glam::DVec3;
use rayon::prelude::*;
use std::sync::atomic::Ordering;

/// Factor on the shadow rays of texels beside which a luminaire is seen in part: pictures show their noise, which
/// gathers average.
const PENUMBRA: u32 = 4;
/// Least shadow rays to which that factor applies.
const LEAST_FEW: u32 = 32;

/// A flat's textures; `None` of what reflects nothing.
#[derive(Default)]
pub(super) struct Filled {
    /// For gathers, smoothed little.
    pub gathered: Option<FlatLight>,
    /// For pictures, smoothed more.
    pub shown: Option<FlatLight>,
}

/// Direct light of texels and photons of later landings, on so many times the flat's area.
pub(super) fn fill_flat<T: Tracer>(
    filler: &Filler<'_, T>,
    number: usize,
    photons: impl Iterator<Item = FlatPhoton>,
    areas: f64,
) -> Filled {
    let Filler { scene, settings, .. } = *filler;
    let Some(flat) = flat::flat(scene, number).filter(|f| !f.albedo.black()) else { return Filled::default() };
    let dims = flat.resolution(settings.flat_resolution, settings.isovalue_resolution);
    let mut parts = flat.texels(dims);
    let hidden = CoveredPart::new(scene, number, &flat);
    hidden.take_off(dims, &mut parts);
    // What lights the hidden part is no light of what is left of a texel.
    let photons = photons.filter(|p| !hidden.holds([p.uvc[0], p.uvc[1]].map(f64::from)));
    let solid = Solid::new(scene, number, &flat);
    let open = solid.as_ref().and_then(|s| Open::new(s, dims, &settings.axis));
    // Where no solid stands, none holds photons.
    let solid = solid.filter(|_| open.is_some());
    let isovalues = settings.axis.centres(dims[2]);
    let raster = Raster { filler, number, flat: &flat, dims, isovalues, parts, open };
    let binned = raster.binned(photons, solid.as_ref(), areas);
    let known = raster.direct();
    let within = raster.within(&known);
    let direct = widened(&known, dims, &|i| raster.outer(i));
    let shown = raster.light(&direct, within.as_ref(), &binned, &SHOWN, DVec3::ZERO);
    // A texture to be averaged is not clamped at 0: that would brighten what few photons reach.
    let gathered = raster.light(&direct, within.as_ref(), &binned, &GATHERED, DVec3::NEG_INFINITY);
    Filled { gathered: Some(gathered), shown: Some(shown) }
}

/// A flat's texels: dims[0] × dims[1] parts of it at each of dims[2] isovalues. Texel i is part i mod their number.
struct Raster<'a, T> {
    filler: &'a Filler<'a, T>,
    number: usize,
    flat: &'a Flat,
    dims: [usize; 3],
    isovalues: Vec<f64>,
    parts: Vec<Texel>,
    /// Where solids leave it open; `None`: everywhere.
    open: Option<Open>,
}

/// What walls hold within solids that stand on them.
struct WithinSolids {
    /// Direct irradiance.
    direct: Vec<DVec3>,
    /// Whether a texel, or one beside it, is so in part.
    beside: Vec<bool>,
}

impl<T: Tracer> Raster<'_, T> {
    fn part(&self, i: usize) -> Texel {
        self.parts[i % self.parts.len()]
    }

    fn isovalue(&self, i: usize) -> f64 {
        self.isovalues[i / self.parts.len()]
    }

    /// Texels outside of solids, at least in part, and those beside.
    fn outer(&self, i: usize) -> bool {
        self.open.as_ref().is_none_or(|o| o.outer[i])
    }

    /// The share of a texel that is outside of solids.
    fn share(&self, i: usize) -> f64 {
        self.open.as_ref().map_or(1.0, |o| o.shares[i])
    }

    /// The texel that stands for one.
    fn source(&self, i: usize) -> usize {
        i - i % self.parts.len() + self.part(i).source
    }

    /// Direct irradiance of texel `i` at `at`, by at most `shadow_rays` a luminaire.
    fn estimate(&self, i: usize, at: [f64; 2], shadow_rays: u32) -> Estimate {
        let Filler { scene, tracer, settings, rays, .. } = *self.filler;
        #[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
        let receiver = Receiver {
            position: scene.lattice().to_index(self.flat.at(at)).as_vec3(),
            normal: self.flat.normal,
            isovalue: self.isovalue(i) as f32,
            departure: self.flat.departure,
        };
        let key = Stage::Cache.key(settings.seed, !(((self.number as u64) << 40) | i as u64));
        let direct = direct_irradiance(scene, tracer, &receiver, shadow_rays, key);
        rays.fetch_add(direct.rays, Ordering::Relaxed);
        direct
    }

    /// Shadow rays of most texels, and of those that see a luminaire in part or stand beside such.
    fn shadow_rays(&self) -> [u32; 2] {
        let few = self.filler.settings.flat_shadow_rays;
        [few, PENUMBRA * few.max(LEAST_FEW)]
    }

    /// Direct irradiance of each texel, outside of solids where it is so in part; `None` where there is no place.
    fn direct(&self) -> Vec<Option<DVec3>> {
        let place = |i: usize| match &self.open {
            _ if self.part(i).covered == 0.0 => None,
            Some(open) if open.outer[i] => open.place(i, true),
            _ => Some(self.part(i).at),
        };
        let estimate = |i: usize, rays: u32| Some(self.estimate(i, place(i).filter(|_| (self.filler.tick)(0))?, rays));
        direct_light(self.dims, estimate, self.shadow_rays(), self.filler.tick)
    }

    /// The same within the solids that stand on a wall; `None` if there are none.
    fn within(&self, known: &[Option<DVec3>]) -> Option<WithinSolids> {
        let open = self.open.as_ref().filter(|_| self.number < self.filler.scene.polygons().len())?;
        let [few, many] = self.shadow_rays();
        let solid = |i: usize| self.part(i).covered > 0.0 && open.shares[i] < 1.0 && (self.filler.tick)(0);
        let own = (0..known.len()).into_par_iter().with_min_len(256).map(|i| match solid(i) {
            true if self.outer(i) => open.place(i, false).map(|at| {
                let roughly = self.estimate(i, at, few);
                if roughly.variance > 0.0 { self.estimate(i, at, many) } else { roughly }.mean
            }),
            true => known[i],
            false => None,
        });
        let beside = |n: usize| neighbourhood(self.dims, self.source(n)).any(|mut run| run.any(solid));
        let beside: Vec<bool> = (0..known.len()).into_par_iter().with_min_len(256).map(beside).collect();
        Some(WithinSolids { direct: widened(&own.collect::<Vec<_>>(), self.dims, &solid), beside })
    }

    /// Later landings by texel, those outside of solids and those within, as irradiance on the part of it that is so.
    fn binned(&self, photons: impl Iterator<Item = FlatPhoton>, solid: Option<&Solid>, areas: f64) -> [Binned; 2] {
        let texels = self.isovalues.len() * self.parts.len();
        let bins = FlatTexture { axis: self.filler.settings.axis, ..FlatTexture::black(self.dims) };
        let mut powers = [(); 2].map(|()| vec![DVec3::ZERO; texels]);
        let mut counts = [0u64; 2];
        for p in photons.filter(|p| p.bounces > 0) {
            let [u, v, c] = p.uvc.map(f64::from);
            let n = usize::from(solid.is_some_and(|s| !is_open(s.opening([u, v]), c)));
            powers[n][self.source(bins.texel(p.uvc))] += p.power.as_dvec3();
            counts[n] += 1;
        }
        let texel = areas * self.flat.area() / self.parts.len() as f64;
        let edges = self.filler.settings.axis.edges(self.dims[2]);
        let sizes: Vec<f64> = edges.windows(2).map(|c| texel * (c[1] - c[0])).collect();
        let [outer, inner] = powers;
        [(outer, false), (inner, true)].map(|(powers, within)| {
            let density = |(i, p): (usize, DVec3)| p / sizes[i / self.parts.len()];
            let share = |i: usize| if within { 1.0 - self.share(i) } else { self.share(i) };
            Binned {
                densities: powers.into_iter().enumerate().map(density).collect(),
                shares: (0..texels).map(|i| self.part(i).covered * share(i)).collect(),
                count: counts[usize::from(within)],
            }
        })
    }

    /// Radiance of all texels, at `least` in each channel before it is reflected.
    fn light(
        &self,
        direct: &[DVec3],
        own: Option<&WithinSolids>,
        [outside, within]: &[Binned; 2],
        width: &Width,
        least: DVec3,
    ) -> FlatLight {
        let outside = outside.smoothed(self.dims, width);
        let within = (within.count > 0).then(|| within.smoothed(self.dims, width));
        let of_solids = |i: usize| within.as_ref().map_or(DVec3::ZERO, |w| w[self.source(i)]);
        let shown = |i: usize| {
            let indirect = if self.outer(i) { outside[self.source(i)] } else { of_solids(i) };
            (direct[self.source(i)] + indirect).max(least)
        };
        let within = own.map_or(Within::Same, |own| {
            let light = |i: usize| (own.direct[self.source(i)] + of_solids(i)).max(least);
            Within::Own(self.texture(&|i| if own.beside[i] { light(i) } else { shown(i) }))
        });
        FlatLight { outside: self.texture(&shown), within }
    }

    /// What texels reflect of an irradiance.
    fn texture(&self, irradiance: &dyn Fn(usize) -> DVec3) -> FlatTexture {
        let all = 0..self.isovalues.len() * self.parts.len();
        let texels = all.map(|i| reflected(self.flat.albedo.at(self.isovalue(i)), irradiance(i)));
        let texels = texels.map(|l| l.as_vec3().to_array()).collect();
        FlatTexture { dims: self.dims, axis: self.filler.settings.axis, texels }
    }
}

/// Direct irradiance of the texels that `estimate` knows, by `few` shadow rays, and by `many` beside those that see a
/// luminaire in part. Each is told to `tick`.
fn direct_light(
    [nu, nv, nc]: [usize; 3],
    estimate: impl Fn(usize, u32) -> Option<Estimate> + Sync,
    [few, many]: [u32; 2],
    tick: Tick,
) -> Vec<Option<DVec3>> {
    let texels = nu * nv;
    let isovalue = |first: usize| {
        let each = (0..texels).into_par_iter().with_min_len(256);
        let roughly: Vec<Option<Estimate>> = each.clone().map(|n| estimate(first + n, few)).collect();
        let light = |n: usize| {
            let own = roughly[n]?;
            let differs =
                |other: Estimate| other.variance > 0.0 || (other.mean == DVec3::ZERO) != (own.mean == DVec3::ZERO);
            let mut around = neighbourhood([nu, nv, 1], n);
            let penumbra = around.any(|mut run| run.any(|m| roughly[m].is_some_and(differs)));
            if penumbra { estimate(first + n, many) } else { Some(own) }
        };
        let known = each.map(|n| {
            let found = light(n);
            tick(1);
            Some(found?.mean)
        });
        known.collect::<Vec<_>>()
    };
    (0..nc).into_par_iter().flat_map(|c| isovalue(c * texels)).collect()
}

/// Photons sorted by flat, in their order.
pub(super) struct ByFlat<'a> {
    photons: &'a [FlatPhoton],
    order: Vec<u32>,
    start: Vec<usize>,
}

impl<'a> ByFlat<'a> {
    pub(super) fn new(photons: &'a [FlatPhoton], flats: usize) -> Self {
        let mut start = vec![0; flats + 1];
        photons.iter().for_each(|p| start[p.flat as usize + 1] += 1);
        (0..flats).for_each(|n| start[n + 1] += start[n]);
        let (mut order, mut next) = (vec![0; photons.len()], start.clone());
        for (n, p) in (0..).zip(photons) {
            let at = &mut next[p.flat as usize];
            order[*at] = n;
            *at += 1;
        }
        Self { photons, order, start }
    }

    pub(super) fn flat(&self, n: usize) -> impl Iterator<Item = FlatPhoton> {
        self.order[self.start[n]..self.start[n + 1]].iter().map(|&i| self.photons[i as usize])
    }
}

/// Unknown texels become the mean of the `outer` ones around them that are known, or black.
fn widened(image: &[Option<DVec3>], dims: [usize; 3], outer: &(dyn Fn(usize) -> bool + Sync)) -> Vec<DVec3> {
    let mean = |i: usize| {
        let (sum, count) = neighbourhood(dims, i).fold((DVec3::ZERO, 0.0), |known, run| {
            let more = run.filter(|&j| outer(j)).filter_map(|j| image[j]);
            more.fold(known, |(sum, n), x| (sum + x, n + 1.0))
        });
        if count > 0.0 { sum / count } else { DVec3::ZERO }
    };
    (0..image.len()).into_par_iter().with_min_len(1024).map(|i| image[i].unwrap_or_else(|| mean(i))).collect()
}

#[cfg(test)]
mod tests {
    use super::super::CacheSettings;
    use super::*;
    use crate::field::{Field, Sweep};
    use crate::flattened::{FlattenedHit, FlattenedRay, Side};
    use crate::isovalue_axis::IsovalueAxis;
    use crate::rng::Rng;
    use crate::scene::{Boundary, Scene, Surface, cornell_box};
    use crate::volume::{Lattice, Samples, Volume};
    use glam::Vec3;
    use std::sync::atomic::AtomicU64;

    const SETTINGS: CacheSettings = CacheSettings {
        node_shadow_rays: 1,
        flat_shadow_rays: 64,
        flat_resolution: 24,
        isovalue_resolution: 12,
        axis: IsovalueAxis::EVEN,
        seed: 1,
    };

    /// Its level sets stand on the floor.
    fn wavy() -> Field {
        let lattice = Lattice::aligned([9; 3], DVec3::ZERO, DVec3::splat(0.125)).unwrap();
        let h = |o: usize| {
            let [i, j, k] = lattice.ijk(o).map(|x| x as f32 / 8.0);
            (3.0 * i).sin() * (2.0 * j + 0.3).cos() + 0.2 * k
        };
        let volume = Volume::new("h", lattice.clone(), Samples::F32((0..lattice.len()).map(h).collect())).unwrap();
        Field::new(&volume, Sweep::new(0.0, 1.0).unwrap()).unwrap()
    }

    fn filled<T: Tracer>(
        scene: &Scene,
        tracer: &T,
        number: usize,
        photons: impl Iterator<Item = FlatPhoton>,
        settings: &CacheSettings,
    ) -> Filled {
        let filler = Filler { scene, tracer, settings, rays: &AtomicU64::new(0), tick: &|_| true };
        fill_flat(&filler, number, photons, 1.0)
    }

    struct Nothing;

    impl Tracer for Nothing {
        fn intersect(&self, _: &FlattenedRay) -> Option<FlattenedHit> {
            None
        }
        fn occluded(&self, _: &FlattenedRay) -> bool {
            false
        }
    }

    /// Photons as dense everywhere on a ceiling, behind its luminaire, too, where some get in from within solids: it
    /// shows the same irradiance all around, and no more behind. That was 10⁹ times as much.
    #[test]
    fn what_lights_a_hidden_part_shines_nowhere_else() {
        let lattice = Lattice::aligned([17; 3], DVec3::ZERO, DVec3::splat(0.0625)).unwrap();
        // The solid is one corner, far away.
        let samples = (0..lattice.len()).map(|o| f32::from(o == 0)).collect();
        let field = Field::made(lattice.clone(), Samples::F32(samples), 0.1, 1.0);
        let walls = cornell_box(field.lattice(), 0.0).unwrap();
        let scene = Scene::new(field, Surface::default(), Boundary::Open, walls).unwrap();
        let ceiling = scene.covered_wall(0).unwrap();
        let number = ceiling as usize;
        let flat = flat::flat(&scene, number).unwrap();
        let (irradiance, count) = (3.0, 200_000u64);
        let power = Vec3::splat((irradiance * flat.area() / count as f64) as f32);
        let photons = (0..count).map(|i| {
            let mut rng = Rng::stream(1, Stage::Test, i);
            FlatPhoton { flat: ceiling, uvc: [(); 3].map(|()| rng.unit() as f32), power, bounces: 1 }
        });
        let texture = filled(&scene, &Nothing, number, photons, &SETTINGS).gathered.unwrap().outside;
        let (hidden, expected) =
            (CoveredPart::new(&scene, number, &flat), reflected(flat.albedo.at(0.5), DVec3::ONE).x);
        let mut shown = [crate::stats::Moments::default(); 2];
        let mut most = 0f64;
        for i in 0..20_000 {
            let mut rng = Rng::stream(2, Stage::Test, i);
            let [u, v, c] = [(); 3].map(|()| rng.unit());
            let x = texture.lookup([u, v, c]).x / (irradiance * expected);
            shown[usize::from(hidden.holds([u, v]))].push(x);
            most = most.max(x);
        }
        println!("{:.4}, behind the luminaire {:.4}, most {most:.3}", shown[0].mean(), shown[1].mean());
        assert!((shown[0].mean() - 1.0).abs() < 0.01 && shown[1].count() > 500 && most < 2.0);
    }

    /// A half-plane shadows half of the floor: where that ends, eight shadow rays a texel are not the noise they were
    /// (5 % of all).
    #[test]
    fn borders_of_shadows_are_not_noise() {
        struct Edge;

        impl Tracer for Edge {
            fn intersect(&self, _: &FlattenedRay) -> Option<FlattenedHit> {
                None
            }
            fn occluded(&self, ray: &FlattenedRay) -> bool {
                let t = (4.0 - ray.origin.z) / ray.direction.z;
                ray.origin.x + t * ray.direction.x < 4.0
            }
        }

        let field = wavy();
        let walls = cornell_box(field.lattice(), 0.0).unwrap();
        let floor = walls.iter().position(|p| p.name == "z_min").unwrap();
        let scene = Scene::new(field, Surface::default(), Boundary::Open, walls).unwrap();
        let [few, many] = [8, 4096].map(|flat_shadow_rays| {
            let settings = CacheSettings { flat_shadow_rays, ..SETTINGS };
            let nothing = std::iter::empty();
            let filled = filled(&scene, &Edge, floor, nothing, &settings);
            filled.shown.unwrap().outside.texels
        });
        let sum = |square: &dyn Fn(usize) -> f32| (0..many.len()).map(square).sum::<f32>();
        let off = (sum(&|i| (few[i][0] - many[i][0]).powi(2)) / sum(&|i| many[i][0].powi(2))).sqrt();
        println!("{off}");
        assert!(off > 0.0 && off < 0.02, "{off}");
    }

    /// Photons as dense everywhere on that part of the floor where h < c: it shows the same irradiance up to the line
    /// where surfaces stand on it.
    #[test]
    fn density_does_not_fall_off_where_surfaces_stand_on_walls() {
        let field = wavy();
        let walls = cornell_box(field.lattice(), 0.0).unwrap();
        let floor = walls.iter().position(|p| p.name == "z_min").unwrap();
        // No luminaire: nothing is direct.
        let walls = walls.into_iter().filter(|p| p.emission == DVec3::ZERO).collect();
        let scene = Scene::new(field, Surface::default(), Boundary::Open, walls).unwrap();
        let flat = flat::flat(&scene, floor).unwrap();
        let solid = Solid::new(&scene, floor, &flat).unwrap();
        let (irradiance, count) = (3.0, 400_000);
        let power = Vec3::splat((irradiance * flat.area() / count as f64) as f32);
        let number = u32::try_from(floor).unwrap();
        let photons: Vec<FlatPhoton> = (0..count)
            .map(|i| {
                let mut rng = Rng::stream(1, Stage::Test, i as u64);
                let uvc = [(); 3].map(|()| rng.unit() as f32);
                FlatPhoton { flat: number, uvc, power, bounces: 1 }
            })
            .filter(|p| is_open(solid.opening([f64::from(p.uvc[0]), f64::from(p.uvc[1])]), f64::from(p.uvc[2])))
            .collect();
        assert!(photons.len() > 100_000 && photons.len() < 300_000, "{}", photons.len());
        let fill = |photons: &[FlatPhoton]| {
            filled(&scene, &Nothing, floor, photons.iter().copied(), &SETTINGS).gathered.unwrap().outside
        };
        let texture = fill(&photons);
        let expected = reflected(flat.albedo.at(0.5), DVec3::splat(irradiance)).x;
        // Where it is open, and within 0.03 of the surface.
        let (mut all, mut beside) = (crate::stats::Moments::default(), crate::stats::Moments::default());
        for i in 0..40_000 {
            let mut rng = Rng::stream(2, Stage::Test, i);
            let [u, v, c] = [(); 3].map(|()| rng.unit());
            let gap = c - solid.opening([u, v])[0];
            if gap > 0.0 {
                let x = texture.lookup([u, v, c]).x / expected;
                all.push(x);
                if gap < 0.03 {
                    beside.push(x);
                }
            }
        }
        println!("all {:.4}, beside surfaces {:.4} of {}", all.mean(), beside.mean(), beside.count());
        assert!(beside.count() > 500 && (beside.mean() - 1.0).abs() < 0.02 && (all.mean() - 1.0).abs() < 0.01);
        // Light within a solid is shown where all is solid, and nowhere else.
        let places = (0..400).map(|n| [f64::from(n % 20), f64::from(n / 20)].map(|x| (x + 0.5) / 20.0));
        let place = places.max_by(|p, q| solid.opening(*p)[0].total_cmp(&solid.opening(*q)[0])).unwrap();
        assert!(solid.opening(place)[0] > 0.9, "a solid at all isovalues but the highest");
        let [u, v] = place.map(|x| x as f32);
        let within = photons.iter().map(|p| FlatPhoton { uvc: [u, v, 0.2 + 0.6 * p.uvc[2]], ..*p });
        let lit = fill(&photons.iter().copied().chain(within).collect::<Vec<_>>());
        let deep = [place[0], place[1], 0.4];
        assert!(lit.lookup(deep).x > 3.0 * expected && texture.lookup(deep).x == 0.0, "{}", lit.lookup(deep));
        let open = Open::new(&solid, texture.dims, &texture.axis).unwrap();
        assert!((0..texture.texels.len()).filter(|&i| open.outer[i]).all(|i| texture.texels[i] == lit.texels[i]));
    }

    /// Lets light through to what lies within solids only, and photons land there a third as densely as outside: who
    /// gathers from within sees so much up to the line where surfaces stand on the floor, from outside none of it.
    #[test]
    fn light_within_solids_is_its_own_beside_surfaces() {
        struct Outside<'a>(&'a Field);

        impl Tracer for Outside<'_> {
            fn intersect(&self, _: &FlattenedRay) -> Option<FlattenedHit> {
                None
            }
            fn occluded(&self, ray: &FlattenedRay) -> bool {
                self.0.value(ray.origin.as_dvec3()) < f64::from(ray.isovalue)
            }
        }

        let field = wavy();
        let walls = cornell_box(field.lattice(), 0.0).unwrap();
        let floor = walls.iter().position(|p| p.name == "z_min").unwrap();
        let scene = |both_sides: bool| {
            let surface = Surface { both_sides, ..Surface::default() };
            Scene::new(field.clone(), surface, Boundary::Open, walls.clone()).unwrap()
        };
        let (one, scene) = (scene(false), scene(true));
        let flat = flat::flat(&scene, floor).unwrap();
        let solid = Solid::new(&scene, floor, &flat).unwrap();
        let above = |u: f64, v: f64, c: f64| c - solid.opening([u, v])[0];
        let (dense, count, number) = (3.0, 400_000, u32::try_from(floor).unwrap());
        let power = Vec3::splat((dense * flat.area() / count as f64) as f32);
        let photons: Vec<FlatPhoton> = (0..count)
            .filter_map(|i| {
                let mut rng = Rng::stream(1, Stage::Test, i as u64);
                let uvc = [(); 3].map(|()| rng.unit());
                (above(uvc[0], uvc[1], uvc[2]) > 0.0 || rng.unit() < 1.0 / 3.0).then(|| FlatPhoton {
                    flat: number,
                    uvc: uvc.map(|x| x as f32),
                    power,
                    bounces: 1,
                })
            })
            .collect();
        let tracer = Outside(&scene.field);
        let fill = |scene: &Scene| filled(scene, &tracer, floor, photons.iter().copied(), &SETTINGS);
        let filled = fill(&scene).gathered.unwrap();
        assert_eq!(fill(&one).gathered.unwrap(), filled, "whatever else is stored");
        // Within 0.03 of the surface, and farther off: from within, and from outside.
        let mut found = [crate::stats::Moments::default(); 4];
        for i in 0..40_000 {
            let mut rng = Rng::stream(2, Stage::Test, i);
            let [u, v, c] = [(); 3].map(|()| rng.unit());
            let gap = above(u, v, c);
            let receiver = Receiver {
                position: scene.lattice().to_index(flat.at([u, v])).as_vec3(),
                normal: flat.normal,
                isovalue: c as f32,
                departure: flat.departure,
            };
            let direct = direct_irradiance(&scene, &Nothing, &receiver, 4, Stage::Test.key(3, i)).mean;
            let outside = gap > 0.0;
            let expected = if outside { DVec3::splat(dense) } else { direct + dense / 3.0 };
            let x = filled.seen(!outside).unwrap().lookup([u, v, c]).x / reflected(flat.albedo.at(c), expected).x;
            found[2 * usize::from(outside) + usize::from(gap.abs() > 0.03)].push(x);
        }
        println!("{:?}", found.map(|m| (m.mean(), m.count())));
        assert!(found.iter().all(|m| m.count() > 500 && (m.mean() - 1.0).abs() < 0.02));
    }

    /// Photons as dense everywhere on a cap: it shows the same irradiance up to its edges, whichever side is stored.
    #[test]
    fn caps_are_lit_up_to_their_edges() {
        let field = wavy();
        for outside in Side::BOTH {
            let surface = Surface { outside, both_sides: true, ..Surface::default() };
            let scene = Scene::new(field.clone(), surface, Boundary::Capped, Vec::new()).unwrap();
            // z = 0.
            let number = 2;
            let flat = flat::flat(&scene, number).unwrap();
            let depth = |[u, v, c]: [f64; 3]| field.value(field.lattice().to_index(flat.at([u, v]))) - c;
            let (irradiance, count) = (3.0, 400_000);
            let power = Vec3::splat((irradiance * flat.area() / count as f64) as f32);
            let place = |seed: u64, i: u64| {
                let mut rng = Rng::stream(seed, Stage::Test, i);
                [(); 3].map(|()| rng.unit())
            };
            let photons = (0..count).map(|i| place(1, i)).filter(|&p| depth(p) >= 0.0);
            let photons = photons.map(|p| FlatPhoton { flat: 2, uvc: p.map(|x| x as f32), power, bounces: 1 });
            let filled = filled(&scene, &Nothing, number, photons, &SETTINGS);
            let FlatLight { outside: texture, within } = filled.gathered.unwrap();
            assert_eq!(within, Within::Same, "no light is within");
            let expected = reflected(flat.albedo.at(0.5), DVec3::splat(irradiance)).x;
            let mut found = [crate::stats::Moments::default(); 2];
            for p in (0..40_000).map(|i| place(2, i)) {
                if depth(p) > 0.0 {
                    found[usize::from(depth(p) > 0.03)].push(texture.lookup(p).x / expected);
                }
            }
            println!("{outside:?}: {:?}", found.map(|m| (m.mean(), m.count())));
            assert!(found.iter().all(|m| m.count() > 500 && (m.mean() - 1.0).abs() < 0.02), "{outside:?}");
        }
    }
}
