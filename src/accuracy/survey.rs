//! A survey of all isosurfaces of a bake at random points: no references need be made first, and no isovalue chosen.
//! \[BB09 §3\]

use super::{display, percent};
use crate::direct::Receiver;
use crate::error::{Error, Result};
use crate::field::Field;
use crate::illumination_grid::IlluminationGrid;
use crate::mask::{Mask, local_position};
use crate::progress::Tick;
use crate::reference::PathTracer;
use crate::rng::{Rng, Stage};
use crate::sampling::positions_by_isovalue;
use crate::scene::Scene;
use crate::tracer::Tracer;
use crate::volume::Lattice;
use glam::{DVec3, Vec3};
use rayon::prelude::*;
use serde::Serialize;
use std::sync::atomic::{AtomicU64, Ordering};

/// How much work a survey is worth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SurveySettings {
    /// Points on isosurfaces of the sweep, and as many points of the grid; about a kilobyte each.
    pub points: usize,
    /// Paths of each of the two independent estimates that every point is compared with.
    pub paths: u32,
    /// Seed of points and paths.
    pub seed: u64,
}

impl Default for SurveySettings {
    fn default() -> Self {
        Self { points: 2000, paths: 256, seed: 1 }
    }
}

/// Percent RMS of isosurfaces of a part of the sweep.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Part {
    /// Isovalues from and to, source units.
    pub isovalues: [f64; 2],
    /// Points that took part.
    pub points: usize,
    /// As [`Survey::percent_rms`].
    pub percent_rms: f64,
}

/// How far a bake is from path tracing over all isosurfaces of its sweep. Percentages are of the display range [0, 1],
/// as those of [`super::Accuracy`].
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Survey {
    /// Points on isosurfaces that took part.
    pub points: usize,
    /// Paths of each of a point's two estimates.
    pub paths: u32,
    /// 100 √⟨(t − r₁)·(t − r₂)⟩ over points of which each isovalue has as many and each isosurface evenly by its area,
    /// where t is what the bake shows and r what paths find: without their noise, 0 where that is negative. Where they
    /// reach white noise is clamped on one side, and few paths make this too large.
    pub percent_rms: f64,
    /// The same where t is radiance as a 3D texture shows it: another number if the bake is split
    /// ([`crate::split::Split`]) or looked at by rays ([`crate::final_gather`]).
    pub percent_rms_texture: f64,
    /// The same per channel: / √3.
    pub percent_rms_sqrt3: f64,
    /// 95 % confidence interval of `percent_rms`, from the scatter over points (as if they were independent);
    /// of a single one, up to infinity.
    pub confidence: [f64; 2],
    /// Points of the grid that took part: those beside the others that hold light of their own level set.
    pub grid_points: usize,
    /// The error of these, each compared on its own level set: what is not due to interpolation; more where a fit chose
    /// what interpolates best. `None` without any.
    pub percent_rms_grid_points: Option<f64>,
    /// Its interval.
    pub confidence_grid_points: Option<[f64; 2]>,
    /// 100 ⟨t − r⟩ over channels: the sign of the error.
    pub bias: f64,
    /// The error in fifths of the sweep.
    pub parts: Vec<Part>,
    /// Share of the points that are as bright as can be displayed in all channels, by the bake and by paths: no error
    /// is seen there.
    pub clamped: f64,
    /// Points left out since ∇h vanishes there, or since a luminaire covers them.
    pub left_out: usize,
    /// Rays traced.
    pub rays: u64,
}

/// Parts of [`Survey::parts`].
const PARTS: usize = 5;

/// Isovalues that get as many points each.
const STRATA: u8 = 40;

/// Points to choose from for each that is chosen.
const CANDIDATES: u64 = 64;

/// What a bake shows of the outside.
#[derive(Clone, Copy)]
pub struct Shown<'a> {
    /// Its grid.
    pub grid: &'a IlluminationGrid,
    /// The grid's lattice, over the volume's.
    pub lattice: &'a Lattice,
    /// Radiance on isosurfaces, given index coordinates of `lattice` and the point's number.
    pub radiance: &'a (dyn Fn(DVec3, u64) -> DVec3 + Sync),
    /// rgb = radiance × this. That of the scene, as it is lit, may leave out volumes that were baked with it.
    pub exposure: f64,
}

impl std::fmt::Debug for Shown<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shown").field("lattice", self.lattice).field("exposure", &self.exposure).finish_non_exhaustive()
    }
}

/// Compares what is `shown` with paths through `scene`, of whose field it is: at points on isosurfaces, and at the
/// grid's own what it holds. `tick(n)` reports n of 2 · points done; returning false stops early, with a result that is
/// worth nothing.
///
/// # Errors
/// `Invalid` if no isosurface of the sweep is found.
pub fn survey<T: Tracer>(
    scene: &Scene,
    tracer: &T,
    shown: Shown,
    settings: &SurveySettings,
    tick: Tick,
) -> Result<Survey> {
    let chosen = places(&scene.field, settings);
    if chosen.is_empty() {
        return Err(Error::Invalid("no isosurface of its sweep was found; bake a sweep that has some".into()));
    }
    let Shown { grid, lattice, radiance, exposure } = shown;
    let scale = lattice.far() / scene.lattice().far();
    let referee = Referee { scene, tracer, settings, exposure, rays: AtomicU64::new(0), tick };
    // On the isosurface, and at a point of the grid beside it.
    let found: Vec<[Option<Deviation>; 2]> = chosen
        .par_iter()
        .enumerate()
        .with_max_len(16)
        .map(|(i, &p)| {
            let between =
                referee.judge(p, [radiance(p * scale, i as u64), grid.interpolate(lattice, p * scale)], 2 * i);
            tick(1);
            let at = beside(lattice, grid, p * scale, &mut stream(settings, i as u64)).and_then(|o| {
                let texture = DVec3::from_array(grid.radiance[o].map(f64::from));
                referee.judge(local_position(&scene.field, lattice, o), [texture; 2], 2 * i + 1)
            });
            tick(1);
            [between, at]
        })
        .collect();
    let [all, at_points]: [Vec<Deviation>; 2] = [0, 1].map(|k| found.iter().filter_map(|f| f[k]).collect());
    let (square, confidence) = mean_square(&all);
    let of_grid_points = (!at_points.is_empty()).then(|| mean_square(&at_points));
    let sweep = scene.field.sweep();
    let parts = (0..PARTS).map(|n| {
        let ends = [n, n + 1].map(|i| i as f64 / PARTS as f64);
        let within = |d: &&Deviation| (ends[0]..ends[1]).contains(&d.isovalue) || (n + 1 == PARTS && d.isovalue >= 1.0);
        let own: Vec<Deviation> = all.iter().filter(within).copied().collect();
        Part {
            isovalues: ends.map(|u| sweep.from_unit(u)),
            points: own.len(),
            percent_rms: percent(mean_square(&own).0),
        }
    });
    let mean = |of: fn(&Deviation) -> f64| all.iter().map(of).sum::<f64>() / (all.len() as f64).max(1.0);
    Ok(Survey {
        points: all.len(),
        paths: settings.paths,
        percent_rms: percent(square),
        percent_rms_texture: percent(mean(|d| d.texture_square)),
        percent_rms_sqrt3: percent(square / 3.0),
        confidence: confidence.map(percent),
        grid_points: at_points.len(),
        percent_rms_grid_points: of_grid_points.map(|(square, _)| percent(square)),
        confidence_grid_points: of_grid_points.map(|(_, confidence)| confidence.map(percent)),
        bias: 100.0 * mean(|d| d.bias),
        parts: parts.collect(),
        clamped: mean(|d| f64::from(d.clamped)),
        left_out: chosen.len() - all.len(),
        rays: referee.rays.into_inner(),
    })
}

/// One point against paths.
#[derive(Clone, Copy)]
struct Deviation {
    /// In units of the sweep.
    isovalue: f64,
    /// (t − r₁)·(t − r₂), and the same of the texture.
    square: f64,
    texture_square: f64,
    /// t − r, mean over channels.
    bias: f64,
    /// See [`Survey::clamped`].
    clamped: bool,
}

/// Paths that points are compared with.
struct Referee<'a, T> {
    scene: &'a Scene,
    tracer: &'a T,
    settings: &'a SurveySettings,
    exposure: f64,
    rays: AtomicU64,
    tick: Tick<'a>,
}

impl<T: Tracer> Referee<'_, T> {
    /// What is shown, and what the texture holds, at local `p`, by paths of their own for every `index`. `None` where
    /// ∇h vanishes, where a luminaire covers the place, and when time is up.
    fn judge(&self, p: DVec3, shown: [DVec3; 2], index: usize) -> Option<Deviation> {
        let Self { scene, settings, exposure, .. } = *self;
        #[allow(clippy::cast_possible_truncation, reason = "isovalues are f32")]
        let at = Receiver::on_level_set(scene, p, scene.field.value(p) as f32, scene.surface.outside)?;
        if scene.covers(scene.lattice().to_world(p)) || !(self.tick)(0) {
            return None;
        }
        let mut paths = PathTracer::new(scene, self.tracer);
        let found = [1, 2].map(|n| {
            display(paths.outgoing(&at, settings.paths, Stage::Path.key(seed(settings, n), index as u64)), exposure)
        });
        self.rays.fetch_add(paths.rays, Ordering::Relaxed);
        let off = |shown: DVec3| found.map(|r| display(shown, exposure) - r);
        let ([a, b], [c, d]) = (off(shown[0]), off(shown[1]));
        Some(Deviation {
            isovalue: f64::from(at.isovalue),
            square: a.dot(b),
            texture_square: c.dot(d),
            bias: (a + b).element_sum() / 6.0,
            clamped: found.into_iter().chain([display(shown[0], exposure)]).all(|c| c == DVec3::ONE),
        })
    }
}

/// The seeds of a survey: none that anybody gives a bake.
fn seed(settings: &SurveySettings, number: u64) -> u64 {
    settings.seed ^ (number << 62)
}

/// What chooses: stream `index`.
fn stream(settings: &SurveySettings, index: u64) -> Rng {
    Rng::stream(seed(settings, 3), Stage::Sample, index)
}

/// Mean of the squares, and its 95 % confidence interval: any, of a single one.
fn mean_square(all: &[Deviation]) -> (f64, [f64; 2]) {
    let n = all.len() as f64;
    let mean = all.iter().map(|d| d.square).sum::<f64>() / n.max(1.0);
    let scatter = all.iter().map(|d| (d.square - mean).powi(2)).sum::<f64>();
    let deviation = if n > 1.0 { (scatter / ((n - 1.0) * n)).sqrt() } else { f64::INFINITY };
    (mean, [mean - 1.96 * deviation, mean + 1.96 * deviation])
}

/// Points on isosurfaces of the sweep, local: as many for each isovalue, over each isosurface evenly by its area. Of
/// points even in the volume, whose measure is dV = dA dc / |∇h|, those with a greater |∇h| are chosen more often.
fn places(field: &Field, settings: &SurveySettings) -> Vec<DVec3> {
    // Of each isovalue as many to choose from, however little of Ω it takes: few would be chosen over and over.
    let count = (CANDIDATES * settings.points as u64).div_ceil(u64::from(STRATA)).max(1 << 11);
    let weighed = |p: &Vec3| {
        let p = p.as_dvec3();
        (p, field.value_and_gradient(p).1.length())
    };
    let strata = positions_by_isovalue(field, STRATA, count, seed(settings, 3)).into_iter().map(|candidates| {
        let weighed: Vec<(DVec3, f64)> = candidates.par_iter().map(weighed).filter(|(_, g)| g.is_finite()).collect();
        let area: f64 = weighed.iter().map(|(_, g)| g).sum();
        (weighed, area)
    });
    let strata: Vec<(Vec<(DVec3, f64)>, f64)> = strata.filter(|(_, area)| *area > 0.0).collect();
    // Every 1 / points of the running sum of weights, which end at 1.
    let mut chosen = Vec::with_capacity(settings.points);
    let offset = stream(settings, u64::MAX).unit();
    let mut sum = 0.0;
    for (candidates, area) in &strata {
        for (p, g) in candidates {
            sum += g / (area * strata.len() as f64) * settings.points as f64;
            while chosen.len() < settings.points && chosen.len() as f64 + offset < sum {
                chosen.push(*p);
            }
        }
    }
    chosen
}

/// A point of the grid around index coordinates `p` that holds light of its own level set, as likely as interpolation
/// weighs it; `None` without any.
fn beside(lattice: &Lattice, grid: &IlluminationGrid, p: DVec3, rng: &mut Rng) -> Option<usize> {
    let corners = lattice.around(p);
    let valid = || corners.into_iter().filter(|&(o, w)| w > 0.0 && grid.mask[o] == Mask::Valid);
    let mut left = rng.unit() * valid().map(|c| c.1).sum::<f64>();
    let chosen = valid().find(|&(_, w)| {
        left -= w;
        left < 0.0
    });
    chosen.map(|c| c.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::embree::{Device, GraphTracer};

    use crate::flattened::Side;
    use crate::scene::{Boundary, Surface, cornell_box};
    use crate::volume::Samples;

    const N: usize = 41;
    const GLOW: f64 = 0.5;

    /// Black surfaces that glow, in a Cornell box, on [−1, 1]³: every path says exactly the same.
    fn scene(h: impl Fn(DVec3) -> f64, sweep: [f64; 2]) -> Scene {
        let step = 2.0 / (N - 1) as f64;
        let lattice = Lattice::aligned([N; 3], DVec3::splat(-1.0), DVec3::splat(step)).unwrap();
        let samples = (0..lattice.len()).map(|o| h(place(&lattice, o))).collect();
        let field = Field::made(lattice.clone(), Samples::F64(samples), sweep[0], sweep[1]);
        let surface = Surface {
            albedo: DVec3::ZERO.into(),
            emission: DVec3::splat(GLOW),
            outside: Side::Lower,
            both_sides: false,
        };
        Scene::new(field, surface, Boundary::Open, cornell_box(&lattice, 0.0).unwrap()).unwrap()
    }

    fn place(lattice: &Lattice, o: usize) -> DVec3 {
        lattice.to_world(lattice.point(o))
    }

    /// A survey of a grid that is off by `error` (of the place) in all channels.
    fn surveyed(scene: &Scene, error: impl Fn(DVec3) -> f64, points: usize) -> Survey {
        let lattice = scene.lattice();
        let radiance = (0..lattice.len()).map(|o| [(GLOW + error(place(lattice, o))) as f32; 3]).collect();
        let grid = IlluminationGrid {
            radiance,
            std_error: vec![0.0; lattice.len()],
            mask: crate::mask::masks(&scene.field, lattice),
            split: None,
        };
        let device = Device::new(0).unwrap();
        let tracer = GraphTracer::new(&device, scene).unwrap();
        let settings = SurveySettings { points, paths: 1, seed: 3 };
        let radiance = |p, _| grid.interpolate(lattice, p);
        let shown = Shown { grid: &grid, lattice, radiance: &radiance, exposure: scene.exposure() };
        survey(scene, &tracer, shown, &settings, &|_| true).unwrap()
    }

    #[test]
    fn what_is_off_by_the_same_everywhere_is_off_by_that() {
        let scene = scene(|x| 1.0 - x.length(), [0.1, 0.7]);
        let s = surveyed(&scene, |_| 0.1, 300);
        let expected = 100.0 * 0.1 * 3f64.sqrt();
        for found in [s.percent_rms, s.percent_rms_grid_points.unwrap(), 3f64.sqrt() * s.percent_rms_sqrt3]
            .into_iter()
            .chain(s.confidence)
            .chain(s.parts.iter().map(|p| p.percent_rms))
        {
            assert!((found - expected).abs() < 1e-4, "{found}: {s:?}");
        }
        assert!((s.bias - 10.0).abs() < 1e-4 && s.points == 300 && s.left_out == 0, "{s:?}");
        // Outermost and innermost cells have corners beyond the sweep.
        assert!((250..=300).contains(&s.grid_points), "{s:?}");
        assert_eq!(s.parts.iter().map(|p| p.points).sum::<usize>(), 300);
        // How far one may be from the others it does not say.
        let [lo, hi] = surveyed(&scene, |_| 0.1, 1).confidence;
        assert!(lo == 0.0 && hi == f64::INFINITY, "{lo} {hi}");
        let right = surveyed(&scene, |_| 0.0, 300);
        assert!(right.percent_rms < 1e-4 && right.bias.abs() < 1e-4, "{right:?}");
    }

    /// Spheres that are off by 0.2 z: ⟨z²⟩ is r²/3 on each, and every radius has as many points. Were they as many as
    /// there is area, the error would be 1.13 times as large.
    #[test]
    fn every_isovalue_counts_as_much() {
        let s = surveyed(&scene(|x| 1.0 - x.length(), [0.1, 0.7]), |x| 0.2 * x.z, 6000);
        let square = |[a, b]: [f64; 2]| 0.04 * (b.powi(3) - a.powi(3)) / (3.0 * (b - a));
        let expected = 100.0 * square([0.3, 0.9]).sqrt();
        assert!((s.percent_rms / expected - 1.0).abs() < 0.03, "{} {expected}", s.percent_rms);
        assert!((s.confidence[0]..s.confidence[1]).contains(&expected), "{s:?}");
        assert!(s.bias.abs() < 0.5, "{s:?}");
        for part in &s.parts {
            let expected = 100.0 * square([1.0 - part.isovalues[1], 1.0 - part.isovalues[0]]).sqrt();
            assert!((part.percent_rms / expected - 1.0).abs() < 0.06, "{part:?} {expected}");
            assert!(part.points.abs_diff(1200) < 60, "{part:?}");
        }
    }

    /// A ball in the middle of a faint background, whose brightest fortieth takes 3 points of 10⁵ that are even in the
    /// volume: its isovalues have as many points as others, and not always the same.
    #[test]
    fn small_isosurfaces_have_points_of_their_own() {
        let field = scene(|x| (-12.0 * x.length_squared()).exp(), [0.01, 1.0]).field;
        let chosen = places(&field, &SurveySettings { points: 2000, paths: 1, seed: 1 });
        let mut strata = vec![Vec::new(); usize::from(STRATA)];
        for p in chosen {
            let n = (f64::from(STRATA) * field.value(p)) as usize;
            strata[n.min(usize::from(STRATA) - 1)].push(p.to_array());
        }
        for (n, mut points) in strata.into_iter().enumerate() {
            assert!(points.len().abs_diff(50) < 2, "{n}: {}", points.len());
            points.sort_by(|a, b| a.partial_cmp(b).unwrap());
            points.dedup();
            assert!(points.len() > 45, "{n}: {} different ones", points.len());
        }
    }

    /// Of a sweep between two samples no grid point holds light of its own level set.
    #[test]
    fn grid_points_without_light_of_their_own_do_not_count() {
        let s = surveyed(&scene(|x| x.x, [0.01, 0.04]), |_| 0.1, 200);
        assert_eq!((s.points, s.grid_points), (200, 0));
        assert_eq!((s.percent_rms_grid_points, s.confidence_grid_points), (None, None));
        let json = serde_json::to_value(&s).unwrap();
        assert!(json["percent_rms_grid_points"].is_null() && json["confidence_grid_points"].is_null(), "{json}");
    }

    /// A roof whose one side is four times as steep: each isosurface is two planes, one on either side, of the same
    /// area; of points even in the volume four fifths would lie on the other.
    #[test]
    fn isosurfaces_count_by_their_area() {
        let roof = |x: DVec3| if x.z < 0.6 { x.z - 0.6 } else { 4.0 * (0.6 - x.z) };
        let s = surveyed(&scene(roof, [-1.5, -0.25]), |x| if x.z > 0.6 { 0.1 } else { 0.0 }, 3000);
        let expected = 100.0 * (0.5 * 3.0 * 0.01f64).sqrt();
        assert!((s.percent_rms / expected - 1.0).abs() < 0.03, "{} {expected}", s.percent_rms);
        assert!((s.bias - 5.0).abs() < 0.3, "{s:?}");
    }
}
