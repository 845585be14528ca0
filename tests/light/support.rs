//! Scenes whose light is known, and the judges.

use glam::{DVec3, Vec3};
use isolume::bake::{Bake, BakeOptions, BakeSettings, Engine, StrategyName, bake};
use isolume::direct::Receiver;
use isolume::embree::{Device, GraphTracer};
use isolume::field::{Field, Sweep};
use isolume::flattened::Side;
use isolume::isovalue_axis::IsovalueAxis;
use isolume::mask::Mask;
use isolume::photon::{PhotonSettings, Photons, trace_photons};
use isolume::polygon::Polygon;
use isolume::progress::Progress;
use isolume::reference::PathTracer;
use isolume::rng::Stage;
use isolume::scene::{Boundary, Scene, Surface, cornell_box};
use isolume::stats::{Moments, normal_quantile, sidak};
use isolume::volume::{Lattice, Samples, Volume};
use rayon::prelude::*;

/// An axis-aligned lattice of `dims` samples from `lo` to `hi`.
pub(crate) fn lattice(dims: [usize; 3], lo: DVec3, hi: DVec3) -> Lattice {
    let cells = DVec3::from_array(dims.map(|n| (n - 1) as f64));
    Lattice::aligned(dims, lo, (hi - lo) / cells).unwrap()
}

/// World position of lattice point `o`.
pub(crate) fn world(lattice: &Lattice, o: usize) -> DVec3 {
    lattice.to_world(lattice.point(o))
}

/// h at the points of `lattice`, swept from `lo` to `hi`.
pub(crate) fn field(lattice: Lattice, lo: f64, hi: f64, h: impl Fn(DVec3) -> f64) -> Field {
    let samples = (0..lattice.len()).map(|o| h(world(&lattice, o))).collect();
    let volume = Volume::new("known", lattice, Samples::F64(samples)).unwrap();
    Field::new(&volume, Sweep::new(lo, hi).unwrap()).unwrap()
}

/// A parallelogram around `centre` that faces s × t.
pub(crate) fn rectangle(name: &str, centre: DVec3, s: DVec3, t: DVec3, albedo: f64, emission: f64) -> Polygon {
    let v = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|(a, b)| centre + a * s + b * t);
    Polygon::new(name, v.to_vec(), DVec3::splat(albedo), DVec3::splat(emission)).unwrap()
}

/// The six faces of a box, facing inwards.
pub(crate) fn closed_box(lo: DVec3, hi: DVec3, albedo: f64, emission: f64) -> Vec<Polygon> {
    let (centre, half) = (0.5 * (lo + hi), 0.5 * (hi - lo));
    (0..6)
        .map(|face| {
            let (a, sign) = (face % 3, if face < 3 { -1.0 } else { 1.0 });
            let axis = |b: usize| DVec3::AXES[b % 3] * half[b % 3];
            // s × t along +a for the near face, −a for the far one.
            let (s, t) = if face < 3 { (axis(a + 1), axis(a + 2)) } else { (axis(a + 2), axis(a + 1)) };
            rectangle(&format!("face {face}"), centre + sign * axis(a), s, t, albedo, emission)
        })
        .collect()
}

/// A grey surface.
pub(crate) fn grey(albedo: f64, outside: Side) -> Surface {
    Surface { albedo: DVec3::splat(albedo).into(), outside, ..Surface::default() }
}

/// An open scene.
pub(crate) fn scene(field: Field, surface: Surface, polygons: Vec<Polygon>) -> Scene {
    Scene::new(field, surface, Boundary::Open, polygons).unwrap()
}

/// Exact samples at the grid's nodes: no interpolation between truth and answer.
pub(crate) fn at_nodes(seed: u64) -> BakeSettings {
    BakeSettings {
        photons: 1 << 17,
        strategy: StrategyName::Nodes,
        ..BakeSettings::with_engine(&BakeOptions { seed: Some(seed), ..BakeOptions::default() }, Engine::Photon)
            .unwrap()
    }
}

/// One bake.
pub(crate) fn run(scene: &Scene, settings: &BakeSettings) -> Bake {
    bake(scene, settings, &Device::new(1).unwrap(), Progress::Quiet).unwrap()
}

/// Photons of a scene.
pub(crate) fn photons(scene: &Scene, settings: &PhotonSettings) -> Photons {
    let device = Device::new(1).unwrap();
    let tracer = GraphTracer::new(&device, scene).unwrap();
    trace_photons(scene, &tracer, settings, &|_| true)
}

/// `count` photons of any isovalue, cut off by roulette only.
pub(crate) fn emission(count: u64, seed: u64) -> PhotonSettings {
    PhotonSettings { count, max_bounces: u16::MAX, seed, axis: IsovalueAxis::EVEN, fixed_isovalue: None }
}

/// (node, world position, isovalue, green radiance, standard error) of the first side's valid points.
pub(crate) fn valid(bake: &Bake, scene: &Scene) -> Vec<(usize, DVec3, f64, f64, f64)> {
    let grid = &bake.sides[0].1;
    (0..grid.radiance.len())
        .filter(|&o| grid.mask[o] == Mask::Valid)
        .map(|o| {
            let h = f64::from(scene.field.samples()[o]);
            (o, world(&bake.lattice, o), h, f64::from(grid.radiance[o][1]), f64::from(grid.std_error[o]))
        })
        .collect()
}

/// Whether a point lies `margin` or more inside a box.
pub(crate) fn within(x: DVec3, lo: DVec3, hi: DVec3, margin: f64) -> bool {
    (x - lo).min_element() >= margin && (hi - x).min_element() >= margin
}

/// A point of space in the local frame as samples are placed.
pub(crate) fn local(scene: &Scene, x: DVec3) -> Vec3 {
    scene.lattice().to_index(x).as_vec3()
}

/// Quantities measured over independent runs or places, judged together: each must lie within `systematic` of its
/// expectation, give or take its own noise at Šidák's level for a family error of 1e-3.
pub(crate) struct Family {
    name: &'static str,
    systematic: f64,
    entries: Vec<(String, f64, f64)>,
}

impl Family {
    pub(crate) fn new(name: &'static str, systematic: f64) -> Self {
        Self { name, systematic, entries: Vec::new() }
    }

    /// `measured` ± `error` where `expected` is right.
    pub(crate) fn compare(&mut self, what: impl Into<String>, measured: f64, error: f64, expected: f64) {
        self.entries.push((what.into(), measured / expected - 1.0, error / expected.abs()));
    }

    /// Ratios that should average 1.
    pub(crate) fn ratios(&mut self, what: impl Into<String>, m: &Moments) {
        self.entries.push((what.into(), m.mean() - 1.0, m.std_error()));
    }

    /// The entries beyond what noise and `systematic` allow.
    pub(crate) fn rejected(&self) -> usize {
        let z = normal_quantile(sidak(1e-3, self.entries.len()));
        println!("{}: {} entries, |z| ≤ {z:.2}, systematic ≤ {:.2e}", self.name, self.entries.len(), self.systematic);
        let mut rejected = 0;
        for (what, off, error) in &self.entries {
            let excess = (off.abs() - self.systematic).max(0.0) / error.max(1e-12);
            let bad = !(excess <= z);
            rejected += usize::from(bad);
            println!("  {what:<28} off {:+.3} % ± {:.3} %{}", 100.0 * off, 100.0 * error, if bad { "  ✗" } else { "" });
        }
        rejected
    }

    /// All of them hold.
    pub(crate) fn accept(self) {
        assert!(!self.entries.is_empty(), "{}: nothing measured", self.name);
        let rejected = self.rejected();
        assert_eq!(rejected, 0, "{}: {rejected} of {} rejected", self.name, self.entries.len());
    }
}

/// Three bumps in the Cornell box on a lattice of n³ samples over [0, 1]³: shadows, colours, interreflection.
pub(crate) fn bumps(lattice: Lattice) -> Scene {
    let g = |x: DVec3, m: [f64; 3], s: f64| (-(x - DVec3::from_array(m)).length_squared() / (2.0 * s * s)).exp();
    let field = field(lattice, 10.0, 90.0, |x| {
        100.0 * g(x, [0.5, 0.5, 0.38], 0.18)
            + 80.0 * g(x, [0.33, 0.4, 0.74], 0.08)
            + 80.0 * g(x, [0.62, 0.36, 0.76], 0.08)
    });
    let walls = isolume::scene::cornell_box(field.lattice(), 0.0).unwrap();
    scene(field, Surface::default(), walls)
}

/// Curved matter all over a box with a margin, n³ samples over [0, 1]³ but those that `gap` says are missing.
pub(crate) fn waves(n: usize, boundary: Boundary, both_sides: bool, gap: impl Fn([usize; 3]) -> bool) -> Scene {
    let lattice = Lattice::aligned([n; 3], DVec3::ZERO, DVec3::splat(1.0 / (n - 1) as f64)).unwrap();
    let samples = (0..lattice.len()).map(|o| {
        let x = 0.5 * world(&lattice, o);
        let value = (17.0 * x.x + 3.0 * x.y).sin() * (13.0 * x.y - 5.0 * x.z).cos() + (11.0 * x.z).sin();
        if gap(lattice.ijk(o)) { f64::NAN } else { value }
    });
    let volume = Volume::new("waves", lattice.clone(), Samples::F64(samples.collect())).unwrap();
    let field = Field::new(&volume, Sweep::new(-2.0, 2.0).unwrap()).unwrap();
    let surface = Surface { both_sides, ..Surface::default() };
    Scene::new(field, surface, boundary, cornell_box(&lattice, 0.1).unwrap()).unwrap()
}

/// How far `radiance` at lattice points is from 512 paths each, of green light: the mean and the RMS, relative to the
/// mean.
pub(crate) fn against_paths(scene: &Scene, side: Side, radiance: &[[f32; 3]], points: &[usize]) -> [f64; 2] {
    let device = Device::new(0).unwrap();
    let tracer = GraphTracer::new(&device, scene).unwrap();
    let light: Vec<[f64; 2]> = points
        .par_iter()
        .map(|&o| {
            let place = scene.lattice().point(o);
            let receiver = Receiver::on_level_set(scene, place, scene.field.samples()[o], side).unwrap();
            let exact = PathTracer::new(scene, &tracer).outgoing(&receiver, 512, Stage::Path.key(5, o as u64));
            [f64::from(radiance[o][1]), exact.y]
        })
        .collect();
    let all = light.iter().map(|[_, exact]| exact).sum::<f64>();
    let mean = light.iter().map(|[got, exact]| got - exact).sum::<f64>() / all;
    let square = light.iter().map(|[got, exact]| (got - exact).powi(2)).sum::<f64>();
    [mean, (square * light.len() as f64).sqrt() / all]
}
